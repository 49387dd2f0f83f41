"""Estimators side by side: the same law on the same rigs, positions measured only."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from undertow.estimators import Estimator, FilteredDerivative, KalmanFilter, Measured, SuperTwisting
from undertow.law import InnerLoop, first_surface
from undertow.models import FloatArray, Mechanism
from undertow.plants import Bench, Measurement, srv02_rig
from undertow.runtime import estimator_for
from undertow.studies.trials.steering import steady
from undertow.studies.trials.trial import Outcome, balanced, trial, undisturbed


def estimators_for(belief: Mechanism, bench: Bench) -> dict[str, Callable[[], Estimator]]:
    """Return the estimators that are compared, by name."""
    period = bench.timing.period
    return {
        "filtered derivative": lambda: FilteredDerivative(belief, period, 0.005),
        "super-twisting": lambda: SuperTwisting(belief, period, 100.0),
        "Kalman": lambda: KalmanFilter(belief, period),
        "Kalman, delay": lambda: estimator_for(belief, bench, drift=0.0),
        "Kalman, delay and d̂": lambda: estimator_for(belief, bench),
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


def compared(
    *,
    seeds: int = 5,
    seconds: float = 8.0,
    done: Callable[[EstimatorRow], None] = lambda _row: None,
) -> list[EstimatorRow]:
    """Balance the SRV02 with the designed surface and each of the estimators.

    The first row is what nothing but exact states would give: the model itself, sampled.
    ``done`` is called with each row as it is finished.
    """
    bench = srv02_rig()
    belief = bench.mechanism
    x0 = belief.state(phi=math.radians(20))
    surface = first_surface(belief)
    law = lambda _: steady(InnerLoop(belief, surface))  # noqa: E731
    ideal = Bench(belief, tachometers={}, timing=undisturbed(belief).timing)
    rows = []
    made: dict[str, Callable[[], Estimator]] = {"exact states": lambda: Measured(belief)}
    for name, make in (made | estimators_for(belief, bench)).items():
        truth = ideal if name in made else bench
        runs = [
            trial(belief, truth, law, x0, seconds, seed, estimator=make()) for seed in range(seeds)
        ]
        errors = [_error(belief, run) for run in runs if run.balanced]
        good = [run for run in runs if run.balanced]
        rows.append(
            EstimatorRow(
                name,
                balanced(runs),
                seeds,
                np.mean(errors, axis=0) if errors else np.full(belief.n, math.nan),
                float(np.mean([run.effort for run in good])) if good else math.nan,
                float(np.mean([run.chatter for run in good])) if good else math.nan,
                math.nan if name in made else _cost(make(), belief),
            )
        )
        done(rows[-1])
    return rows


def _error(belief: Mechanism, run: Outcome) -> FloatArray:
    """Root mean square of the velocity errors after the first half second, (n,)."""
    late = run.record.t > 0.5
    off = (run.record.x - run.record.truth)[late, belief.n :]
    return np.asarray(np.sqrt(np.mean(off**2, axis=0)))
