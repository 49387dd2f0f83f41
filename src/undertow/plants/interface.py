"""What every rig offers, simulated or real: read a measurement, write an input."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from undertow.models import FloatArray

__all__ = ["Measurement", "OutputOnError", "Rig"]


class OutputOnError(OSError):
    """Raised by a rig that is closed and knows that its inputs are not at zero."""


@dataclass(slots=True, eq=False)
class Measurement:
    """What the sensors say at one instant.

    Attributes
    ----------
    t
        When, s, on the rig's clock.
    q
        Measured positions, (n,), rad or m; NaN where the sensor gave nothing.
    v
        Measured velocities, (n,), rad/s or m/s; ``None`` where positions alone are measured.
    """

    t: float
    q: FloatArray
    v: FloatArray | None = None


class Rig(Protocol):
    """A plant to meet: the whole of what a driver of one's own must have.

    Attributes
    ----------
    period
        Period of the inner loop, s.
    """

    period: float

    def read(self) -> Measurement:
        """Return the present measurement."""
        ...

    def write(self, u: FloatArray) -> None:
        """Apply the inputs u, (m,), held until the next write.

        A simulated rig then advances by one period.
        """
        ...

    def close(self) -> None:
        """Let go of the rig; inputs go to zero.

        Raises
        ------
        OutputOnError
            When it is known that they did not.
        """
        ...
