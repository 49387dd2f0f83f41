"""Verdicts: what is claimed, how strong the evidence is, by what margin, with what witness."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

__all__ = ["Kind", "Verdict"]

#: ``proved``: exact or outward-rounded arithmetic over the whole set.  ``sampled``: a
#: statement about random trials with its confidence.  ``refuted``: a counterexample.
#: ``undecided``: the method gave up; the witness says where.
Kind = Literal["proved", "sampled", "refuted", "undecided"]


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
            text += f" (margin {f'{self.margin:.4g} {self.unit}'.rstrip()})"
        if self.witness and self.kind != "proved":
            text += " at " + ", ".join(f"{k} = {v:.6g}" for k, v in self.witness.items())
        return text
