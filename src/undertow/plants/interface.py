"""What every rig offers, simulated or real: read, write, close; and the plainest control loop."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from numbers import Real
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from undertow.base import (
    ArtefactError,
    InvalidInputError,
    UndertowError,
    a_kind,
    error_text,
    raised_at,
)
from undertow.models import FloatArray, Mechanism
from undertow.models.importers.python_file import object_from_file


class OutputOnError(OSError):
    """Raised by a rig that is closed where its inputs are not at zero, or may not be."""


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


@contextmanager
def driver_errors(what: str, limit: str, remedy: str) -> Iterator[None]:
    """Turn what a driver raises, which may be anything, into one condition.

    Raises ArtefactError with the driver's own words, and where it raised.
    """
    try:
        yield
    except UndertowError:  # said already
        raise
    except Exception as error:
        said = f"{error_text(error)}{raised_at(error)}"
        raise ArtefactError(what, value=said, limit=limit, remedy=remedy) from error


def copy_numbers(values: ArrayLike, place: FloatArray, what: str) -> None:
    """Copy what a rig or its user said into its place, (k,), whatever it is made of.

    Raises InvalidInputError when it is not k numbers.
    """
    if getattr(values, "shape", None) != place.shape and np.shape(values) != place.shape:
        raise InvalidInputError(
            what,
            value=f"shape {np.shape(values)}",
            limit=f"shape {place.shape}",
            remedy="NaN stands for what is not known",
        )
    place[:] = values


def copied(measurement: Measurement, n: int) -> Measurement:
    """Return a copy that the rig cannot change any more, of n numbers each.

    Raises InvalidInputError when it is not n positions, and n velocities if any.
    """
    q, v = np.empty(n), None if measurement.v is None else np.empty(n)
    copy_numbers(measurement.q, q, "measured q")
    if v is not None and measurement.v is not None:
        copy_numbers(measurement.v, v, "measured v")
    return Measurement(float(measurement.t), q, v)


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


class RigWrapper:
    """A rig before another one, ``rig``: what a subclass does not change is passed on."""

    def __init__(self, rig: Rig) -> None:
        self.rig, self.period = rig, rig.period

    def read(self) -> Measurement:
        """Return the measurement."""
        return self.rig.read()

    def write(self, u: FloatArray) -> None:
        """Apply the inputs u, (m,)."""
        self.rig.write(u)

    def close(self) -> None:
        """Let go of the rig."""
        self.rig.close()


class Paced(RigWrapper):
    """A rig whose steps come one period of the wall clock apart.

    A simulated rig advances when it is written to, hardware by itself: here each
    :meth:`write` waits until the next reading is due.  After a late one the pace starts anew.

    Examples
    --------
    >>> import undertow as ut
    >>> from undertow.plants import IdealRig
    >>> rig = Paced(IdealRig(ut.mechanisms.rotary_pendulum()))
    >>> rig.write([0.0])
    >>> rig.read().t
    0.001
    """

    def __init__(self, rig: Rig) -> None:
        super().__init__(rig)
        self._due = time.perf_counter()

    def write(self, u: FloatArray) -> None:
        """Apply the inputs u, (m,), and wait until the next reading is due."""
        self.rig.write(u)
        self._due += self.period
        rest = self._due - time.perf_counter()
        if rest > 0:
            time.sleep(rest)
        else:
            self._due -= rest


def control_loop(
    rig: Rig, controller: Callable[[Measurement], FloatArray], periods: int
) -> Iterator[tuple[Measurement, FloatArray]]:
    """Let a controller steer a rig, as fast as the rig's own calls return.

    The one loop of simulations, trials and bring-up.  :class:`undertow.runtime.Runtime` has its
    own: it keeps to a clock, and goes on when a rig fails.

    Parameters
    ----------
    rig
        Simulated, or hardware whose calls keep the pace, as behind
        :class:`undertow.plants.Paced`.
    controller
        Measurement to inputs, (m,).
    periods
        How many.

    Yields
    ------
    Measurement, numpy.ndarray
        Of each period, before its inputs are written: who leaves the loop there writes none.
    """
    for _ in range(periods):
        measurement = rig.read()
        u = controller(measurement)
        yield measurement, u
        rig.write(u)


def rig_from_file(text: str, mechanism: Mechanism) -> Rig:
    """Load a rig of one's own: ``FILE.py:NAME``, a class or function that makes one, or a rig.

    It is called without arguments, and read once.

    Raises
    ------
    ArtefactError
        When the file cannot be read or fails, or the rig cannot be read.
    InvalidInputError
        When what is there has not what a rig has, see :class:`undertow.plants.Rig`.
    """
    rig: Rig = object_from_file(text, "rig", lambda v: callable(v) or hasattr(v, "read"))
    try:
        check_rig(rig, mechanism, text)
    except UndertowError:
        with suppress(Exception):  # it may be no rig at all
            rig.close()
        raise
    return rig


def check_rig(rig: Rig, mechanism: Mechanism, name: str = "rig of one's own") -> None:
    """Refuse what is no rig of a mechanism, before it moves; it is read once.

    Raises
    ------
    ArtefactError
        When it cannot be read.
    InvalidInputError
        When it has not what a rig has, see :class:`undertow.plants.Rig`; when it simulates another
        mechanism.
    """
    lacking = [part for part in ("read", "write", "close") if not callable(getattr(rig, part, 0))]
    period = getattr(rig, "period", None)
    if not isinstance(period, Real) or not 0 < float(period) < math.inf:
        lacking.append("period > 0, s")
    if lacking:
        raise InvalidInputError(
            f"'{name}', {a_kind(rig)}",
            value=f"without {', '.join(lacking)}",
            limit="read(), write(u), close() and a period",
            remedy="See undertow.plants.Rig and examples/serial_rig.py",
        )
    modelled = getattr(rig, "mechanism", None)
    if isinstance(modelled, Mechanism):
        mechanism.check_plant(modelled)
    first = f"first reading of '{name}'"
    with driver_errors(
        first, "an undertow.plants.Measurement", "Is it connected, and switched on?"
    ):
        measurement: Any = rig.read()
    try:
        copied(measurement, mechanism.n)
    except Exception as error:  # a driver may say anything
        said = error_text(error)
        if isinstance(error, InvalidInputError):
            said = f"{error.what} of {error.value}"
        names = ", ".join(c.name for c in mechanism.coordinates)
        raise InvalidInputError(
            first,
            value=f"{type(measurement).__name__}, {said}",
            limit=f"undertow.plants.Measurement with q = ({names})",
            remedy="Positions in rad or m, in that order, NaN where a sensor gave nothing, and the "
            "rig's time, s",
        ) from error
