"""Verdicts: what is claimed, how strong the evidence is, by what margin, with what witness."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from decimal import ROUND_CEILING, ROUND_DOWN, ROUND_FLOOR, Context, Decimal
from typing import Any, Literal

#: ``proved``: exact or outward-rounded arithmetic over the whole set.  ``sampled``: a
#: statement about random trials with its confidence.  ``refuted``: a counterexample.
#: ``undecided``: the method gave up; the witness says where.
Kind = Literal["proved", "sampled", "refuted", "undecided"]


def inward(value: float, digits: int = 4) -> str:
    """Return a margin or extent as text, rounded towards 0, so that it claims no more.

    Examples
    --------
    >>> inward(3.71689), inward(0.5), inward(1e-9 / 3)
    ('3.716', '0.5', '3.333e-10')
    """
    return _rounded(value, digits, ROUND_DOWN)


def within(low: float, high: float, digits: int = 6) -> str:
    """Return an interval as text, its ends rounded inwards, or exactly where it has no room."""
    ends = _rounded(low, digits, ROUND_CEILING), _rounded(high, digits, ROUND_FLOOR)
    if not low <= float(ends[0]) <= float(ends[1]) <= high:
        ends = repr(float(low)), repr(float(high))
    return f"[{ends[0]}, {ends[1]}]"


def _rounded(value: float, digits: int, rounding: str) -> str:
    """Round to a number of decimal digits; a value with fewer digits stays as it is."""
    if not math.isfinite(value):
        return f"{value:g}"
    shortest = Decimal(repr(float(value)))
    return f"{float(Context(prec=digits, rounding=rounding).plus(shortest)):.{digits}g}"


@dataclass(frozen=True)
class Verdict:
    """The answer to one claim.

    Parameters
    ----------
    claim
        What is claimed, in words, with its numbers.
    kind
        How strong the evidence is.
    margin
        Signed distance to the claim's limit, ≥ 0 where it holds; for ``proved`` a proved
        lower bound, for ``refuted`` the (negative) value at the witness.
    unit
        Unit of the margin.
    witness
        ``refuted``: the counterexample; ``undecided``: where the method got stuck;
        ``proved`` and ``sampled``: the worst point that was met.  Names to SI numbers.
    method
        The arithmetic and the theorem that the verdict rests on.
    details
        Further figures (boxes examined, seconds, mode, …).

    Examples
    --------
    >>> verdict = Verdict("1 < 2", "proved", 1.0)
    >>> bool(verdict), str(verdict)
    (True, 'proved: 1 < 2 (margin 1)')
    """

    claim: str
    kind: Kind
    margin: float = math.nan
    unit: str = ""
    witness: Mapping[str, float] = field(default_factory=dict)
    method: str = ""
    details: Mapping[str, Any] = field(default_factory=dict)

    def __bool__(self) -> bool:
        """Whether the claim is proved."""
        return self.kind == "proved"

    def __str__(self) -> str:
        """One line for people."""
        text = f"{self.kind}: {self.claim}"
        if not math.isnan(self.margin):
            text += f" (margin {f'{inward(self.margin)} {self.unit}'.rstrip()})"
        if self.witness and self.kind != "proved":
            text += " at " + ", ".join(f"{k} = {v:.6g}" for k, v in self.witness.items())
        return text
