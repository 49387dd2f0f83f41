"""What a claim is, as a search finds it and before a certificate states it.

Each kind has a file of this folder, a subclass of :class:`Claim`; the kernel has the rule by which
it is decided, and reads it from files.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping

from undertow.base.verdict import Verdict
from undertow.law import ReachingLaw, Surface
from undertow.models.mechanism import Mechanism
from undertow.proofs.kernel import claims as kernel

#: Names of positions or parameters to (low, high), SI units.
Box = Mapping[str, tuple[float, float]]


class Claim(ABC):
    """Numbers that state something of a surface and its reaching law, and can be decided."""

    @abstractmethod
    def decide(self, mechanism: Mechanism, surface: Surface, law: ReachingLaw) -> Verdict:
        """Decide it from its numbers and the mechanism alone.

        The verdict's sentence is made here, from the numbers that were decided on.
        """

    @abstractmethod
    def stated(self, mechanism: Mechanism, verdict: Verdict) -> kernel.Claim:
        """Return what the kernel decides of it, for a certificate."""
