"""How far the surfaces reach: singular angles, catch limits, and how sharply totals change."""

from __future__ import annotations

from dataclasses import dataclass
from math import acos, radians

import numpy as np

from undertow.closed_loop import ClosedLoop
from undertow.law import Surface
from undertow.mechanisms import rotary_pendulum
from undertow.models import Mechanism
from undertow.objective import MinimumTime, Objective
from undertow.optimiser import Budget, Optimiser
from undertow.studies.paper.data import OBJECTIVES, PRINTED, Condition


@dataclass(frozen=True)
class Limit:
    """How far a printed surface reaches, rad, from rest.

    ``singular`` is where (37) fails; ``caught`` the first φ(0) that is not caught, for each
    damping d_e, N m s/rad.
    """

    case: str
    singular: float
    caught: dict[float, float]


@dataclass(frozen=True)
class Sensitivity:
    """How the base case's totals, *matched*, change per degree of φ(0) and per 1 % of d_e."""

    energy_per_degree: float
    energy_per_percent: float
    time_per_degree: float
    time_per_percent: float


def singular_angle(mechanism: Mechanism, surface: Surface) -> float:
    """Return where (37) fails, arccos(ε) with ε = −α_a c/(α_u b) > 0, rad.

    π/2 or more means that the law exists wherever the pendulum is above the horizontal.
    """
    M = mechanism.M(np.zeros(2))
    b, c = -M[0, 1], M[1, 1]
    ratio = -surface.alpha_a[0, 0] * c / (surface.alpha_u[0, 0] * b)
    return acos(float(np.clip(ratio, -1.0, 1.0)))


def catch_limit(mechanism: Mechanism, surface: Surface) -> float:
    """Return the first φ(0), rad, at rest, from which the motion does not come to the target.

    A grid of 0.25° finds the first failure, and finer grids bisect it to 0.001°.  Given
    200 s, so that a slow surface is not taken for one that fails.
    """
    loop = ClosedLoop(mechanism, MinimumTime(horizon=200.0))
    low, step, count = 0.0, radians(0.25), 352
    while True:
        angles = low + step * np.arange(1, count + 1)
        starts = np.zeros((count, 2 * mechanism.n))
        starts[:, mechanism.state_names.index("phi")] = angles
        failed = np.flatnonzero(~loop.batch(starts, surface).reached)
        if failed.size == 0 or step < radians(0.001):
            return float(angles[failed[0]] if failed.size else angles[-1])
        low += step * float(failed[0])
        step, count = step / 16, 16


def own_reach(mechanism: Mechanism, *, seed: int, budget: Budget) -> float:
    """Return the largest φ(0), rad, for which our search finds an admissible surface.

    Bisection to 0.1°.  A search that finds none proves nothing: this is what it can do.
    """
    # Ten seconds are plenty for a catch; slow surfaces are of no use here.
    loop = ClosedLoop(mechanism, MinimumTime(horizon=10.0))
    optimiser = Optimiser(loop, cold=budget, seed=seed)
    low, high = radians(40.0), radians(60.0)
    if optimiser.propose(mechanism.state(phi=high)).surface is not None:
        return high
    while high - low > radians(0.1):
        middle = (low + high) / 2
        found = optimiser.propose(mechanism.state(phi=middle)).surface is not None
        low, high = (middle, high) if found else (low, middle)
    return low


def base_sensitivity(condition: Condition) -> Sensitivity:
    """Return how the printed base case's totals change with φ(0) and d_e, by differences."""
    step = 0.05

    def slope(objective: Objective, d_e: float, angle: float) -> float:
        def total(sign: int) -> float:
            rig = rotary_pendulum(d_e=condition.d_e * (1 + sign * d_e))
            start = rig.state(phi=condition.phi + sign * angle)
            return ClosedLoop(rig, objective).simulate(start, PRINTED["time", "base"].surfaces).cost

        return (total(1) - total(-1)) / (2 * step)

    energy, duration = OBJECTIVES["energy"], OBJECTIVES["time"]
    percent, degree = 0.01 * step, radians(step)
    return Sensitivity(
        slope(energy, 0.0, degree),
        slope(energy, percent, 0.0),
        slope(duration, 0.0, degree),
        slope(duration, percent, 0.0),
    )
