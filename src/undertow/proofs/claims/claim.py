"""What a claim is.  Each kind has a file of this folder: its numbers, its sentence, its decision.

A new kind is a subclass of :class:`Claim` in a file of its own, named in
:data:`undertow.proofs.claims.verify.CLAIMS`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from fractions import Fraction
from typing import Any, ClassVar, Self

import numpy as np

from undertow.base.verdict import Verdict
from undertow.law import ReachingLaw, Surface
from undertow.law.surface import ProvedSet
from undertow.models.mechanism import FloatArray, Mechanism
from undertow.proofs.kernel import claims as kernel

#: Names of positions or parameters to (low, high), SI units.
Box = Mapping[str, tuple[float, float]]
Readers = Mapping[str, Callable[[Any], Any]]


class Claim(ABC):
    """Numbers that state something of a surface and its reaching law, and can be decided."""

    #: Its name in a certificate.
    kind: ClassVar[str]

    #: How each of its numbers is read from JSON values, by the names of its fields.
    reads: ClassVar[Readers] = {}

    def to_dict(self) -> dict[str, Any]:
        """Return its numbers as JSON values."""
        return {name: _data(getattr(self, name)) for name in self.reads}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """Rebuild from :meth:`to_dict`.

        Raises
        ------
        LookupError, TypeError, ValueError, AttributeError, ArithmeticError
            For data that are incomplete or hold numbers that cannot be computed with.
        """
        return cls(**{name: read(data[name]) for name, read in cls.reads.items()})

    @abstractmethod
    def decide(
        self, mechanism: Mechanism, surface: Surface, law: ReachingLaw, *, seconds: float = 600.0
    ) -> Verdict:
        """Decide it from its numbers and the mechanism alone, within an effort in s.

        The verdict's sentence is made here, from the numbers that were decided on.
        """

    def stated(self, mechanism: Mechanism, verdict: Verdict) -> kernel.Claim | None:
        """Return what the kernel decides of it, for a certificate; None for kinds it does not."""
        return None

    def proved_set(
        self, mechanism: Mechanism, surface: Surface, law: ReachingLaw
    ) -> ProvedSet | None:
        """Return the region of the full closed loop that it proves where it holds, if any."""
        return None


def box_of(data: Mapping[str, Any]) -> dict[str, tuple[float, float]]:
    """Read a box from JSON values."""
    return {str(k): (float(a), float(b)) for k, (a, b) in data.items()}


def floats_of(data: Iterable[Any]) -> tuple[float, ...]:
    """Read a row of numbers from JSON values."""
    return tuple(float(v) for v in data)


def matrix_of(data: Any) -> FloatArray:
    """Read a matrix from JSON values."""
    return np.array(data, dtype=np.float64)


def _data(value: Any) -> Any:
    """Return one of a claim's numbers as JSON values."""
    if isinstance(value, Mapping):
        return {k: list(v) for k, v in value.items()}
    if isinstance(value, tuple):
        return [_data(v) for v in value]
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, Fraction):
        return str(value)
    return value.to_dict() if hasattr(value, "to_dict") else value
