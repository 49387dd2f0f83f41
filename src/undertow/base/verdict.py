"""Verdicts: what is claimed, how strong the evidence is, by what margin, with what witness."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from decimal import ROUND_CEILING, ROUND_DOWN, ROUND_FLOOR, Context, Decimal
from fractions import Fraction
from typing import Any, Literal

#: ``proved``: exact or outward-rounded arithmetic over the whole set.  ``sampled``: a
#: statement about random trials with its confidence.  ``refuted``: a counterexample.
#: ``undecided``: the method gave up; the witness says where.
Kind = Literal["proved", "sampled", "refuted", "undecided"]


def inward(value: float | Fraction, digits: int = 4) -> str:
    """Return a margin or extent as text, rounded towards 0, so that it claims no more.

    Examples
    --------
    >>> inward(3.71689), inward(0.5), inward(1e-9 / 3)
    ('3.716', '0.5', '3.333e-10')
    """
    return _rounded(value, digits, ROUND_DOWN)


def within(low: float | Fraction, high: float | Fraction) -> str:
    """Return an interval as text, its ends rounded inwards, or exactly where it has no room."""
    ends = _rounded(low, 6, ROUND_CEILING), _rounded(high, 6, ROUND_FLOOR)
    if not low <= Fraction(ends[0]) <= Fraction(ends[1]) <= high:
        ends = exactly(low), exactly(high)
    return f"[{ends[0]}, {ends[1]}]"


def exactly(value: float | Fraction) -> str:
    """Return a number as the decimal or the double that it is, else as a fraction.

    Examples
    --------
    >>> exactly(0.1), exactly(Fraction(1, 1000)), exactly(Fraction(1, 3))
    ('0.1', '0.001', '1/3')
    """
    near = float(value) + 0.0
    is_it = not math.isfinite(near) or Fraction(value) in (Fraction(near), Fraction(repr(near)))
    return repr(near) if is_it else str(value)


def _rounded(value: float | Fraction, digits: int, rounding: str) -> str:
    """Round to some digits; a double that its shortest decimal names in as many stays as it is."""
    try:
        near = float(value) + 0.0  # −0 is 0
    except OverflowError:
        near = 0.0
    if not math.isfinite(near):
        return f"{near:g}"
    exact = value if isinstance(value, Fraction) else Fraction(near)
    if Fraction(near) == exact:
        short = Decimal(repr(near)).normalize()
        if len(short.as_tuple().digits) <= digits:
            return f"{near:.{digits}g}"
    context = Context(prec=digits, rounding=rounding)
    rounded = context.divide(Decimal(exact.numerator), Decimal(exact.denominator))
    return f"{float(rounded):.{digits}g}"


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
