"""Rig, estimator and controller in one loop of simulated time, recorded.

What an estimator knows of a matched disturbance is taken off the controller's output.  What
enters where the input does (dry friction of a driven joint, a motor that is weaker than its data
sheet, a cable that pulls) can be undone by the input itself, as far as it is known.  An observer
that keeps counting while a joint sticks also sets it free: integral action.  (Ohnishi's
disturbance observer; Chen, Yang, Guo, Li, *IEEE Trans. Ind. Electronics* 63(2), 2016.)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from undertow.base import InvalidInputError, between, floats
from undertow.estimators.interface import Estimator
from undertow.models import FloatArray
from undertow.plants import Measurement, Rig, control_loop
from undertow.symbolic import brief

#: What steers: (t, x̂) to the inputs, (m,).
StateFeedback = Callable[[float, FloatArray], FloatArray]


@dataclass(frozen=True, eq=False)
class Record:
    """What happened on a rig, sample by sample.

    ``t``: times on the rig's clock, (N,), s; ``q``: measured positions, (N, n); ``x``: estimated
    states, (N, 2n); ``u``: inputs written, (N, m); ``truth``: true states, (N, 2n), of simulated
    rigs, else NaN.
    """

    t: FloatArray
    q: FloatArray
    x: FloatArray
    u: FloatArray
    truth: FloatArray

    @property
    def effort(self) -> float:
        """∫ uᵀu dt of the inputs written, held from sample to sample, (40)."""
        span = np.diff(self.t, append=self.t[-1] + np.diff(self.t[-2:]).sum())
        return float((self.u**2).sum(axis=1) @ span)

    @property
    def chatter(self) -> float:
        """Total variation of the inputs, in their unit."""
        return float(np.abs(np.diff(self.u, axis=0)).sum())

    def last(self) -> Record:
        """Return the last sample alone: where many runs are kept."""
        return Record(*(column[-1:] for column in (self.t, self.q, self.x, self.u, self.truth)))


def run_recorded(
    rig: Rig, estimator: Estimator, controller: StateFeedback, seconds: float
) -> Record:
    """Run a controller on a rig for some time, as fast as it goes.

    With hardware the loop keeps no pace: the rig's own ``read`` must. It takes ``seconds`` on the
    rig's clock; the record has one line per sample.
    """
    count = round(seconds / rig.period)
    between("samples of a run on a rig", count, 1, 10_000_000)
    last: FloatArray = np.zeros(estimator.mechanism.m)
    nothing = np.full(1, np.nan)
    rows: list[tuple[float, FloatArray, FloatArray, FloatArray, FloatArray]] = []

    def step(measurement: Measurement) -> FloatArray:
        nonlocal last
        x = estimator.estimate(measurement, last)
        last = np.array(controller(measurement.t, x))
        truth = getattr(rig, "truth", nothing)
        rows.append((measurement.t, measurement.q, x.copy(), last, truth))
        return last

    for _ in control_loop(rig, step, count):
        pass
    t, q, x, u, truth = (np.asarray(column) for column in zip(*rows, strict=True))
    return Record(t, q, x, u, np.broadcast_to(truth, x.shape))


#: Largest part of an input's limit that an estimated disturbance may claim: of a sensor or an
#: actuator that has failed an observer believes anything.
SHARE = 0.5


@brief()
def subtract_disturbance(
    u: FloatArray, disturbance: FloatArray, limits: FloatArray, out: FloatArray
) -> None:
    """Write u − d̂, (m,), into ``out``: |d̂| at most ``SHARE`` of the limits, the sum within them."""
    for i in range(u.shape[0]):
        most = SHARE * limits[i]
        wanted = u[i] - max(-most, min(most, disturbance[i]))
        out[i] = max(-limits[i], min(limits[i], wanted))


def compensated(
    controller: StateFeedback,
    estimator: Estimator,
    limits: FloatArray,
    when: Callable[[], bool] = lambda: True,
) -> StateFeedback:
    """Return a controller whose output lacks what the estimator knows of the disturbance.

    ``limits`` are the largest |u_i|, (m,); ``when`` is asked after each step of the controller:
    whether its output shall lack it.

    Raises
    ------
    InvalidInputError
        At a step, for an output that is not m finite numbers.
    """
    out = np.zeros_like(limits)

    def both(t: float, x: FloatArray) -> FloatArray:
        u = floats("output of a controller", controller(t, x)).ravel()
        if u.shape != limits.shape or not np.isfinite(u).all():
            raise InvalidInputError(
                f"output of a controller at {t:g} s",
                value=u.tolist(),
                limit=f"{len(limits)} finite, one for each input",
                remedy="Return numpy.array([...]) whatever the state is",
            )
        if not when():
            return u
        subtract_disturbance(u, estimator.disturbance, limits, out)
        return out

    return both
