"""Rig, estimator and controller in one loop of simulated time, recorded."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from undertow.base import InvalidInputError
from undertow.estimators.interface import Estimator
from undertow.models import FloatArray
from undertow.plants.interface import Rig

__all__ = ["Controller", "Record", "drive"]

#: What steers: (t, x̂) to the inputs, (m,).
Controller = Callable[[float, FloatArray], FloatArray]


@dataclass(frozen=True, eq=False)
class Record:
    """What happened on a rig, sample by sample.

    Attributes
    ----------
    t
        Times on the rig's clock, (N,), s.
    q
        Measured positions, (N, n).
    x
        Estimated states, (N, 2n).
    u
        Inputs written, (N, m).
    truth
        True states, (N, 2n), of simulated rigs; else NaN.
    """

    t: FloatArray
    q: FloatArray
    x: FloatArray
    u: FloatArray
    truth: FloatArray

    @property
    def effort(self) -> float:
        """∫ uᵀu dt of the inputs written, held from sample to sample, (40)."""
        span = np.diff(self.t, append=2 * self.t[-1] - self.t[-2] if len(self.t) > 1 else 0.0)
        return float((self.u**2).sum(axis=1) @ span)

    @property
    def chatter(self) -> float:
        """Total variation of the inputs, in their unit."""
        return float(np.abs(np.diff(self.u, axis=0)).sum())

    def last(self) -> Record:
        """Return the last sample alone: where many runs are kept."""
        return Record(*(column[-1:] for column in (self.t, self.q, self.x, self.u, self.truth)))


def drive(rig: Rig, estimator: Estimator, controller: Controller, seconds: float) -> Record:
    """Run a controller on a rig for some time, as fast as it goes.

    Parameters
    ----------
    rig
        A plant; of hardware the loop keeps no pace: the rig's own ``read`` must.
    estimator
        Gives the states; :class:`undertow.estimators.Measured` where velocities are measured.
    controller
        (t, x̂) to the inputs.
    seconds
        How long, on the rig's clock.

    Returns
    -------
    Record
        One line per sample.
    """
    count = round(seconds / rig.period)
    if not 1 <= count <= 10_000_000:
        raise InvalidInputError(
            "length of a run on a rig",
            value=f"{seconds:g} s",
            limit=f"{rig.period:g} s to {1e7 * rig.period:g} s, 1 to 10000000 samples",
        )
    u: FloatArray = np.zeros(0)
    rows: list[tuple[float, FloatArray, FloatArray, FloatArray, FloatArray]] = []
    nothing = np.full(1, np.nan)
    for _ in range(count):
        measurement = rig.read()
        x = estimator.estimate(measurement, u)
        u = np.array(controller(measurement.t, x))
        truth = getattr(rig, "truth", nothing)
        rows.append((measurement.t, measurement.q, x.copy(), u, truth))
        rig.write(u)
    t, q, x, u, truth = (np.asarray(column) for column in zip(*rows, strict=True))
    return Record(t, q, x, u, np.broadcast_to(truth, x.shape))
