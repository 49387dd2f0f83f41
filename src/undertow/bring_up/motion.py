"""Small safe motions: doublets, played on a rig and recorded."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from undertow.base import UndertowError
from undertow.models import FloatArray
from undertow.plants.interface import Rig

__all__ = ["GuardError", "Record", "doublets", "perform", "ramp"]


class GuardError(UndertowError):
    """A coordinate left the range that was allowed to it; the inputs were set to zero."""


@dataclass(frozen=True, eq=False)
class Record:
    """What was written to a rig and what it measured.

    Attributes
    ----------
    t
        Times of the samples, (N,), s.
    q
        Measured positions, (N, n); ``q[k]`` was read before ``u[k]`` was written.
    u
        Inputs written, (N, m).
    """

    t: FloatArray
    q: FloatArray
    u: FloatArray

    def __len__(self) -> int:
        """Number of samples."""
        return len(self.t)

    @property
    def moved(self) -> FloatArray:
        """Positions relative to their mean before the first input, (N, n)."""
        driven = np.flatnonzero(np.abs(self.u).max(axis=1) > 0)
        still = max(1, int(driven[0]) if len(driven) else len(self))
        return np.asarray(self.q - self.q[:still].mean(axis=0))


def perform(
    rig: Rig,
    u: FloatArray,
    guard: Sequence[float] | FloatArray,
    until: FloatArray | None = None,
) -> Record:
    """Write a sequence of inputs, (N, m), and record what is measured.

    Parameters
    ----------
    guard
        How far each coordinate may go from where it is now, (n,).
    until
        Stop once a coordinate has gone so far, (n,).

    Raises
    ------
    GuardError
        When one goes further, or is not measured any more: the inputs are zero then.
    """
    times, positions = np.empty(len(u)), []
    home: FloatArray | None = None
    try:
        for k, inputs in enumerate(u):
            measured = rig.read()
            times[k] = measured.t
            positions.append(np.array(measured.q, dtype=float))
            if home is None:
                home = positions[0]
            away = np.abs(positions[-1] - home)
            if not (away <= guard).all():
                worst = int(np.argmax(~(away <= guard)))
                raise GuardError(
                    f"coordinate {worst} of the rig",
                    value=f"{away[worst]:.3g} from where it began",
                    limit=f"up to {guard[worst]:.3g}",
                    remedy="The inputs are zero now: look at the rig before going on",
                )
            if until is not None and (away > until).any():
                rig.write(np.zeros_like(inputs))
                break
            rig.write(inputs)
    except BaseException:  # a guard, a driver that fails, Ctrl-C
        with contextlib.suppress(Exception):
            rig.write(np.zeros(u.shape[1]))
        raise
    count = len(positions)
    return Record(times[:count], np.array(positions), np.array(u[:count]))


def doublets(amplitude: float, widths: Sequence[float], pause: float, period: float) -> FloatArray:
    """Return pushes to and fro, each of some width with a pause after it, (N,).

    A doublet of width w is +A for w, −A for w: it moves the joint and brings it to rest again
    near where it was.  Every second one begins the other way.
    """
    still = np.zeros(round(pause / period))
    parts = [still]
    for k, width in enumerate(widths):
        side = amplitude * (1 if k % 2 == 0 else -1)
        half = np.full(max(1, round(width / period)), side)
        parts += [half, -half, still]
    return np.concatenate(parts)


def ramp(level: float, seconds: float, period: float) -> FloatArray:
    """Return a slow rise from nothing to a level, (N,)."""
    return np.linspace(0.0, level, max(2, round(seconds / period)))
