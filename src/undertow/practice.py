"""What a controller is set to where it meets a rig: one home for runs, drills and trials.

Nothing here is fitted to a rig.  Estimator, gate and objectives follow from the limits and
ranges of the mechanism, from the sampling period, and from what a bench tells of its sensors
and of its delays.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np
import sympy as sp

from undertow.cascade import Gate
from undertow.delay import bench_gate, noise_share
from undertow.errors import MissingExtraError
from undertow.estimators import KalmanFilter
from undertow.mechanism import FloatArray, Mechanism
from undertow.objective import MinimumEnergy, Names, Objective, state_box
from undertow.rig import Bench, Encoder
from undertow.sliding import ReachingLaw
from undertow.stability import first_surface
from undertow.surface import ProvedSet, Surface

__all__ = ["Goal", "estimator_for", "gate_for", "goal_for", "provable", "reaching_for"]

#: ``energy``: Φ = uᵀu + w xᵀx.  ``time``: Φ = 1 + r Σ (u_i/u_max,i)².  ``effort``: the same for
#: every mechanism, Φ = Σ (u_i/u_max,i)² + 0.01 xᵀx.
Goal = Literal["energy", "time", "effort"]

#: w of minimum energy: Theorem 1 holds and the driven coordinates come home.
STATE_WEIGHT = 0.05
#: r of minimum time, 0.01/V² at 15 V: keeps surfaces from asking what no sampled, delayed loop
#: can do.
ENERGY_PRICE = 2.25
#: Radius of the ball in which a motion ends: a rig with stiction and counting encoders stays
#: in no smaller one.
TERMINAL = 0.05

#: What every admitted surface must bear: periods of delay, and so much less of the input; and
#: the part of the input that noise of the sensors may take, standard deviation.
BEARS, RESERVE, NOISE = 6, 0.15, 0.2

#: The paper's boundary layer ε, and how often it may be doubled for the noise: η/ε from 200 to
#: 25 per second.
LAYER, DOUBLED = 0.1, 3

#: Density of the drift of a matched disturbance, parts of the smallest input limit per √s.
DRIFT = 0.1

#: Standard deviation of a position that is read as it is, rad or m.
EXACT = 1e-6


def _limits(mechanism: Mechanism) -> FloatArray:
    """Input limits, 1 where there is none, (m,)."""
    limits = mechanism.input_limits
    return np.where(np.isfinite(limits), limits, 1.0)


def estimator_for(belief: Mechanism, bench: Bench, drift: float | None = None) -> KalmanFilter:
    """Return the Kalman filter that knows a bench's encoders, period and delays, nothing else.

    Parameters
    ----------
    belief
        The controller's model.
    bench
        The bench.
    drift
        Density of the matched disturbance's drift, input units per √s; ``DRIFT`` of the
        smallest limit by default.  0 estimates none.
    """
    sigmas = []
    for c in belief.coordinates:
        encoder = bench.encoders.get(c.name, Encoder())
        sigmas.append(max(math.hypot(encoder.resolution / math.sqrt(12), encoder.noise), EXACT))
    timing = bench.timing
    return KalmanFilter(
        belief,
        timing.period,
        position_noise=sigmas,
        disturbance_drift=DRIFT * float(_limits(belief).min()) if drift is None else drift,
        delay=timing.input_delay + timing.measurement_delay,
    )


def gate_for(estimator: KalmanFilter) -> Gate:
    """Return the gate that a surface must pass before a rig may meet it.

    Parameters
    ----------
    estimator
        That of the rig: its period, and what it does not know of the state at the target.
    """
    period, size = estimator.period, 2 * estimator.mechanism.n
    covariance = estimator.settled()[:size, :size]
    return bench_gate(BEARS * period, RESERVE, period=period, covariance=covariance, noise=NOISE)


def reaching_for(estimator: KalmanFilter) -> ReachingLaw:
    """Return the paper's reaching law, its boundary layer as thick as the sensors need.

    The gains near the target go with η/ε: ε is doubled until what the estimator does not know
    takes no more than ``NOISE`` of the input on the first surface, ``DOUBLED`` times at most.
    """
    mechanism, size = estimator.mechanism, 2 * estimator.mechanism.n
    covariance, surface = estimator.settled()[:size, :size], first_surface(estimator.mechanism)
    laws = [ReachingLaw(layer=LAYER * 2**k) for k in range(DOUBLED + 1)]
    quiet = (law for law in laws if noise_share(mechanism, surface, covariance, law) <= NOISE)
    return next(quiet, laws[-1])


def goal_for(mechanism: Mechanism, goal: Goal, *, horizon: float = 60.0) -> Objective:
    """Return an objective that suits a bench; finite ranges of travel are kept to 95 %.

    Parameters
    ----------
    mechanism
        The controller's model.
    goal
        See :data:`Goal`.
    horizon
        Longest prediction, s.
    """
    ranges = _ranges(mechanism)
    if goal == "energy":
        return MinimumEnergy(
            horizon=horizon,
            terminal_radius=TERMINAL,
            state_weight=STATE_WEIGHT,
            constraints=state_box(**ranges),
        )
    limits = _limits(mechanism).tolist()

    def effort(v: Names) -> sp.Expr:
        return sum((u / limit) ** 2 for u, limit in zip(v.inputs, limits, strict=True))

    if goal == "time":
        return Objective(
            "time",
            lambda v: 1 + ENERGY_PRICE * effort(v),
            "s",
            horizon,
            TERMINAL,
            state_box(**ranges),
        )
    return Objective(
        "effort and error",
        lambda v: effort(v) + 0.01 * (v.states.T * v.states)[0],
        "s",
        horizon,
        0.02,
        state_box(**ranges),
    )


def _ranges(mechanism: Mechanism) -> Mapping[str, float]:
    """Return 95 % of the nearer end of each coordinate's range, where it has one around 0."""
    nearest = {c.name: min(-c.low, c.high) for c in mechanism.coordinates}
    return {name: 0.95 * end for name, end in nearest.items() if 0 < end < math.inf}


def provable(
    mechanism: Mechanism, surfaces: Sequence[Surface], reaching: ReachingLaw
) -> tuple[ProvedSet, ...]:
    """Return the sets that are proved for a catch: none can be without ``undertow[certify]``."""
    from undertow.certify import terminal_sets

    with contextlib.suppress(MissingExtraError):
        return terminal_sets(mechanism, surfaces, reaching)
    return ()
