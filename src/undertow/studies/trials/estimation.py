"""Estimators side by side: the same law on the same rigs, positions measured only."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import numpy as np

from undertow.estimators import Estimator, KalmanFilter, MakeEstimator, Measured
from undertow.export.estimate import STEPS
from undertow.law import first_surface
from undertow.models import FloatArray, Mechanism
from undertow.plants import Bench, Measurement, srv02_rig
from undertow.runtime import estimator_for
from undertow.studies.trials.steering import keeping
from undertow.studies.trials.trial import Outcome, trial

#: What nothing but exact states would give: the model itself, sampled.
EXACT = "exact states"

#: Length of a run, s.
SECONDS = 8.0


def _exported(name: str, gain: float) -> MakeEstimator:
    """Return what makes the estimator that the exported C has under a name."""
    return lambda belief, bench: STEPS[name](gain).estimator(belief, bench.timing.period)


#: The estimators that are compared, by name, each made for a belief and a bench.
ESTIMATORS: dict[str, MakeEstimator] = {
    EXACT: lambda belief, _: Measured(belief),
    "filtered derivative": _exported("derivative", 0.005),
    "super-twisting": _exported("super-twisting", 100.0),
    "Kalman": lambda belief, bench: KalmanFilter(belief, bench.timing.period),
    "Kalman, delay": lambda belief, bench: estimator_for(belief, bench, drift=0.0),
    "Kalman, delay and d̂": estimator_for,
}


@dataclass(frozen=True)
class EstimatorRow:
    """One estimator: its errors, its processor time and the runs with it.

    ``errors``: root mean square of q̇̂ − q̇ while balancing, (n,), rad/s or m/s. ``effort``,
    ``chatter``: ∫u² dt, and the total variation of u per second, means over the balanced runs.
    ``microseconds``: processor time of one estimate.
    """

    name: str
    balanced: int
    seeds: int
    errors: FloatArray
    effort: float
    chatter: float
    microseconds: float


def _cost(estimator: Estimator, belief: Mechanism, calls: int = 5000) -> float:
    """Return the processor time of one estimate, µs."""
    estimator.reset(np.zeros(2 * belief.n))
    u, q = np.zeros(belief.m), np.zeros(belief.n)
    seen = [Measurement(1e-3 * k, q) for k in range(calls)]
    estimator.estimate(seen[0], u)
    began = time.process_time()
    for measurement in seen:
        estimator.estimate(measurement, u)
    return 1e6 * (time.process_time() - began) / calls


def compared(name: str, *, seeds: int) -> EstimatorRow:
    """Balance the SRV02 with the designed surface and one of the ``ESTIMATORS``."""
    bench = srv02_rig()
    belief = bench.mechanism
    x0 = belief.state(phi=math.radians(20))
    law = keeping(belief, first_surface(belief))
    exact = name == EXACT
    ideal = Bench(belief, tachometers={})
    make = ESTIMATORS[name]
    runs = [
        trial(
            belief, ideal if exact else bench, law, x0, SECONDS, seed, estimator=make(belief, bench)
        )
        for seed in range(seeds)
    ]
    good = [run for run in runs if run.balanced]
    errors = [_error(belief, run) for run in good]
    return EstimatorRow(
        name,
        len(good),
        seeds,
        np.mean(errors, axis=0) if good else np.full(belief.n, math.nan),
        float(np.mean([run.effort for run in good])) if good else math.nan,
        float(np.mean([run.chatter for run in good])) if good else math.nan,
        math.nan if exact else _cost(make(belief, bench), belief),
    )


def _error(belief: Mechanism, run: Outcome) -> FloatArray:
    """Root mean square of the velocity errors after the first half second, (n,)."""
    late = run.record.t > 0.5
    off = (run.record.x - run.record.truth)[late, belief.n :]
    return np.asarray(np.sqrt(np.mean(off**2, axis=0)))
