"""Random rigs that no controller was told of: who still balances, and what breaks whom.

Every rig is the SRV02 bench with masses within ±20 %, friction between nothing and twice as
much, up to 5 ms of delay in all, and a knock on the pendulum on the way.  The controllers
know the bench they were made for, and nothing of this.  NMPC joins where CasADi is installed.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg

from undertow.errors import MissingExtraError
from undertow.mechanism import FloatArray, Mechanism
from undertow.rig import Bench, Friction, Push, srv02_rig
from undertow.stability import linearise
from undertow.trials.balance import OBJECTIVES, controllers
from undertow.trials.nmpc import NMPC, predictive
from undertow.trials.trial import MakeController, Outcome, estimator_for, trial

__all__ = [
    "FACTORS",
    "Breaking",
    "RobustnessResult",
    "breaking_point",
    "clipped_regulator",
    "random_bench",
    "robustness",
]

Progress = Callable[[str, float], None]

#: Half-width of the masses; scale of friction; delay in all, s; impulse, N m s.
MASSES, FRICTION, DELAY, IMPULSE = 0.20, 2.0, 0.005, 0.004


def clipped_regulator(belief: Mechanism) -> MakeController:
    """Return a linear-quadratic regulator, its output clipped: Q of the first surface."""
    lin = linearise(belief)
    n, m = belief.n, belief.m
    limit = belief.input_limits
    Q = np.diag([1.0] * m + [10.0] * (n - m) + [0.1] * n)
    R = np.diag(1.0 / limit**2)
    P = scipy.linalg.solve_continuous_are(lin.A, lin.input, Q, R)
    k = -np.linalg.solve(R, lin.input.T @ P)
    return lambda _: lambda t, x: np.clip(k @ x, -limit, limit)


def _scaled(friction: Friction, factor: float) -> Friction:
    return replace(
        friction,
        coulomb=factor * friction.coulomb,
        breakaway=factor * friction.F_s,
        viscous=factor * friction.viscous,
    )


def _with_friction(bench: Bench, factor: float) -> Bench:
    return replace(bench, friction={k: _scaled(f, factor) for k, f in bench.friction.items()})


def _with_delay(bench: Bench, delay: float) -> Bench:
    return bench.with_timing(input_delay=0.6 * delay, measurement_delay=0.4 * delay)


def _with_mass(bench: Bench, change: float) -> Bench:
    values = {p.name: p.value for p in bench.mechanism.parameters}
    heavier = {name: values[name] * (1 + change) for name in ("m", "I_e")}
    return replace(bench, mechanism=bench.mechanism.with_parameters(**heavier))


def _with_push(bench: Bench, impulse: float) -> Bench:
    return replace(bench, pushes=(Push(5.0, "phi", impulse),))


#: Name to how a bench is changed, the largest change looked for, unit, and its factor.
FACTORS: dict[str, tuple[Callable[[Bench, float], Bench], float, str, float]] = {
    "Coulomb friction of the arm": (
        lambda bench, value: _with_friction(bench, value / 0.03), 0.6, "N m", 1.0,
    ),
    "delay in all": (_with_delay, 0.030, "ms", 1e3),
    "mass and inertia above": (_with_mass, 3.0, "%", 100.0),
    "mass and inertia below": (lambda bench, value: _with_mass(bench, -value), 0.95, "%", 100.0),
    "knock on the pendulum": (_with_push, 0.060, "mN m s", 1e3),
}  # fmt: skip


def random_bench(bench: Bench, seed: int) -> Bench:
    """Return a bench that differs from a given one in all respects at once."""
    rng = np.random.default_rng([seed, 2])
    changed = _with_friction(bench, rng.uniform(0.0, FRICTION))
    changed = _with_delay(changed, rng.uniform(0.0, DELAY))
    push = Push(rng.uniform(3.0, 6.0), "phi", IMPULSE * rng.uniform(-1.0, 1.0))
    tolerance = dict(bench.tolerance) | {"m": MASSES, "I_e": MASSES}
    return replace(changed, pushes=(push,), tolerance=tolerance)


@dataclass(frozen=True)
class Breaking:
    """The largest change that a controller survives on all seeds, and the seed that breaks it.

    ``seed`` is the first one that fails at ``broken``, the smallest change known to be too
    much; ``None`` when the largest change looked for was survived.
    """

    survived: float
    broken: float
    seed: int | None


@dataclass(frozen=True, eq=False)
class RobustnessResult:
    """Outcomes by controller, and breaking points by (controller, factor)."""

    outcomes: dict[str, list[Outcome]]
    breaking: dict[tuple[str, str], Breaking]
    seconds: float


def breaking_point(
    run: Callable[[float, int], bool], largest: float, *, seeds: int, bisections: int = 6
) -> Breaking:
    """Find the largest change survived on all seeds, by bisection from nothing.

    Parameters
    ----------
    run
        (change, seed) to whether it balanced.
    largest
        Where to start from.
    seeds
        Rigs.
    bisections
        The interval is halved so often.
    """

    def first_failure(value: float) -> int | None:
        return next((seed for seed in range(seeds) if not run(value, seed)), None)

    low, high = 0.0, largest
    seed = first_failure(high)
    if seed is None:
        return Breaking(high, math.inf, None)
    for _ in range(bisections):
        middle = 0.5 * (low + high)
        failed = first_failure(middle)
        if failed is None:
            low = middle
        else:
            high, seed = middle, failed
    return Breaking(low, high, seed)


def robustness(
    *,
    rigs: int = 200,
    seeds: int = 5,
    angle: float = math.radians(35),
    seconds: float = 10.0,
    budget: int = 256,
    progress: Progress = lambda _what, _fraction: None,
) -> RobustnessResult:
    """Run every controller on the same random rigs, then look for what breaks each.

    Parameters
    ----------
    rigs
        Random rigs.
    seeds
        Rigs on which a single change must be survived; 0 looks for no breaking points.
    angle
        φ(0), rad, at rest.
    seconds
        Length of a run, s.
    budget
        Rollouts that one re-optimisation may spend.
    progress
        Called with what is being done and the part done.
    """
    bench = srv02_rig()
    belief = bench.mechanism
    x0: FloatArray = belief.state(phi=angle)
    objective = OBJECTIVES["energy"]
    made = controllers(belief, objective, x0, budget=budget)
    makers = {
        "cascade": made["cascade"],
        "fixed surface": made["one-time"],
        "clipped LQR": clipped_regulator(belief),
    }
    with contextlib.suppress(MissingExtraError):  # then there is nothing to compare with
        NMPC(belief, objective)
        makers["NMPC, 10 Hz"] = predictive(belief, objective)

    def once(name: str, truth: Bench, seed: int) -> Outcome:
        known = estimator_for(belief, bench)
        return trial(
            belief, truth, makers[name], x0, seconds, seed, objective=objective, estimator=known
        )

    outcomes: dict[str, list[Outcome]] = {}
    parts = len(makers) * (1 + (len(FACTORS) if seeds else 0))
    done = 0
    for name in makers:
        runs = []
        for seed in range(rigs):
            progress(f"{rigs} random rigs, {name}", (done + seed / rigs) / parts)
            outcome = once(name, random_bench(bench, seed), seed)
            runs.append(replace(outcome, record=outcome.record.last()))
        outcomes[name] = runs
        done += 1
    breaking: dict[tuple[str, str], Breaking] = {}
    for factor, (change, largest, _, _) in FACTORS.items() if seeds else ():
        for name in makers:
            progress(f"{factor}, {name}", done / parts)

            def survives(
                value: float,
                seed: int,
                name: str = name,
                change: Callable[[Bench, float], Bench] = change,
            ) -> bool:
                return once(name, change(bench, value), seed).balanced

            breaking[name, factor] = breaking_point(survives, largest, seeds=seeds)
            done += 1
    return RobustnessResult(outcomes, breaking, seconds)
