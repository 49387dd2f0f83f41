"""Random rigs that no controller was told of: who still balances, and what breaks whom.

Every rig is the SRV02 bench with masses within ±20 %, friction between nothing and twice as
much, up to 5 ms of delay in all, and a knock on the pendulum on the way.  The controllers
know the bench they were made for, and nothing of this.  All have the same estimator, and what
it knows of a matched disturbance is taken off the output of each.  NMPC joins where CasADi is
installed.  Single changes are then made larger and larger, on the bench with its usual spread,
until one of the rigs is lost.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import scipy.linalg

from undertow.base import MissingExtraError
from undertow.law import linearise
from undertow.models import FloatArray, Mechanism
from undertow.objective import objective_for
from undertow.plants import Bench, Push, srv02_rig
from undertow.runtime.controller_defaults import estimator_for
from undertow.studies.trials.balance import controllers
from undertow.studies.trials.ledger import Ledger
from undertow.studies.trials.nmpc import predictive
from undertow.studies.trials.trial import MakeController, Result, trial

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

#: When a knock comes, s; and the length of a run with a single change, which leaves a slow
#: surface the time to bring the arm home afterwards.
KNOCK, SINGLE = 5.0, 20.0

#: Names in the tables.
NAMES = ("cascade", "fixed surface", "clipped LQR", "NMPC, 10 Hz")


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


def _with_delay(bench: Bench, delay: float) -> Bench:
    return bench.with_timing(input_delay=0.6 * delay, measurement_delay=0.4 * delay)


def _with_mass(bench: Bench, change: float) -> Bench:
    values = {p.name: p.value for p in bench.mechanism.parameters}
    heavier = {name: values[name] * (1 + change) for name in ("m", "I_e")}
    return replace(bench, mechanism=bench.mechanism.with_parameters(**heavier))


def _with_push(bench: Bench, impulse: float) -> Bench:
    return replace(bench, pushes=(Push(KNOCK, "phi", impulse),))


#: Name to how a bench is changed, the largest change looked for, unit, and its factor.
FACTORS: dict[str, tuple[Callable[[Bench, float], Bench], float, str, float]] = {
    "Coulomb friction of the arm": (
        lambda bench, value: bench.with_friction(value / 0.03, ("theta",)), 1.28, "mN m", 1e3,
    ),
    "delay in all": (_with_delay, 0.032, "ms", 1e3),
    "pendulum and arm heavier": (_with_mass, 3.2, "%", 100.0),
    "pendulum and arm lighter": (lambda bench, value: _with_mass(bench, -value), 0.96, "%", 100.0),
    "knock on the pendulum": (_with_push, 0.064, "mN m s", 1e3),
}  # fmt: skip


def random_bench(bench: Bench, seed: int) -> Bench:
    """Return a bench that differs from a given one in all respects at once."""
    rng = np.random.default_rng([seed, 2])
    changed = bench.with_friction(rng.uniform(0.0, FRICTION))
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
    """Results by controller, and breaking points by (controller, factor).

    ``seeds`` is the number of rigs on which a single change must be survived.
    """

    outcomes: dict[str, list[Result]]
    breaking: dict[tuple[str, str], Breaking]
    seeds: int


def breaking_point(
    run: Callable[[float, int], bool], largest: float, *, seeds: int, bisections: int = 5
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


def _makers(
    belief: Mechanism, bench: Bench, x0: FloatArray, budget: int
) -> dict[str, MakeController]:
    """Return the controllers by name; NMPC where CasADi is there."""
    objective = objective_for(belief, "bench-energy")
    made = controllers(belief, bench, objective, x0, budget=budget)
    makers = dict(
        zip(NAMES, (made["cascade"], made["one-time"], clipped_regulator(belief)), strict=False)
    )
    with contextlib.suppress(MissingExtraError):  # then there is nothing to compare with
        makers[NAMES[-1]] = predictive(belief, objective)
    return makers


def robustness(
    *,
    rigs: int = 200,
    seeds: int = 3,
    angle: float = math.radians(35),
    seconds: float = 10.0,
    budget: int = 256,
    ledger: Path | None = None,
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
        Length of a run on a random rig, s.
    budget
        Rollouts that one re-optimisation may spend.
    ledger
        A file that keeps every run as it is made: what it holds already is not run again.
    progress
        Called with what is being done and the part done.

    Raises
    ------
    ArtefactError
        When the ledger is of another version or of other settings.
    """
    bench = srv02_rig()
    belief = bench.mechanism
    x0: FloatArray = belief.state(phi=angle)
    objective = objective_for(belief, "bench-energy")
    makers = _makers(belief, bench, x0, budget)
    settings = {"angle": angle, "seconds": [seconds, SINGLE], "budget": budget}
    book = Ledger(ledger, settings | {"fingerprint": belief.fingerprint})

    def once(name: str, what: str, value: float, seed: int, truth: Bench) -> Result:
        known = book.find(name, what, value, seed)
        if known is not None:
            return known
        told, length = estimator_for(belief, bench), seconds if what == "random" else SINGLE
        outcome = trial(
            belief, truth, makers[name], x0, length, seed, objective=objective, estimator=told
        )
        return book.keep(name, what, value, outcome)

    parts = len(makers) * (1 + (len(FACTORS) if seeds else 0))
    done = 0
    outcomes: dict[str, list[Result]] = {}
    for name in makers:
        outcomes[name] = []
        for seed in range(rigs):
            progress(f"{rigs} random rigs, {name}", (done + seed / rigs) / parts)
            outcomes[name].append(once(name, "random", 0.0, seed, random_bench(bench, seed)))
        done += 1
    breaking: dict[tuple[str, str], Breaking] = {}
    for factor, (change, largest, _, _) in FACTORS.items() if seeds else ():
        for name in makers:
            progress(f"{factor}, {name}", done / parts)

            def survives(
                value: float,
                seed: int,
                name: str = name,
                factor: str = factor,
                change: Callable[[Bench, float], Bench] = change,
            ) -> bool:
                return once(name, factor, value, seed, change(bench, value)).balanced

            breaking[name, factor] = breaking_point(survives, largest, seeds=seeds)
            done += 1
    return RobustnessResult(outcomes, breaking, seeds)
