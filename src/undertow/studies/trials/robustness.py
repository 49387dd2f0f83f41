"""Random rigs unknown to the controllers: which ones still balance, and what makes each fail.

Every rig is the SRV02 bench with masses within ±20 %, friction between nothing and twice as
much, up to 5 ms of delay in all, and a knock on the pendulum on the way.  The controllers
know the bench they were made for, and nothing of this.  All have the same estimator, and what
it knows of a matched disturbance is taken off the output of each.  NMPC joins where CasADi is
installed.  Single changes are then made larger and larger, on the bench with its usual spread,
until one of the rigs is lost.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import product

import numpy as np

from undertow.base import versions
from undertow.objective import objective_for
from undertow.plants import Bench, Push, srv02_rig
from undertow.studies.ledger import Key
from undertow.studies.trials.balance import makers
from undertow.studies.trials.steering import clipped_regulator, predictive
from undertow.studies.trials.trial import MakeController, Result, trial

#: Half-width of the masses; scale of friction; delay in all, s; impulse, N m s.
MASSES, FRICTION, DELAY, IMPULSE = 0.20, 2.0, 0.005, 0.004

#: When a knock comes, s; the length of a run on a random rig, and of one with a single change,
#: which leaves a slow surface the time to bring the arm home afterwards.
KNOCK, SECONDS, SINGLE = 5.0, 10.0, 20.0

#: φ(0), rad, at rest; rollouts that one re-optimisation may spend; rigs of a single change.
ANGLE, BUDGET, SEEDS = math.radians(35), 256, 3

#: What the random rigs are among changes; names in the tables.
RANDOM = "random"
NAMES = ("cascade", "fixed surface", "clipped LQR", "NMPC, 10 Hz")


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
    "delay in all": (Bench.with_delay, 0.032, "ms", 1e3),
    "pendulum and arm heavier": (_with_mass, 3.2, "%", 100.0),
    "pendulum and arm lighter": (lambda bench, value: _with_mass(bench, -value), 0.96, "%", 100.0),
    "knock on the pendulum": (_with_push, 0.064, "mN m s", 1e3),
}  # fmt: skip


def random_bench(bench: Bench, seed: int) -> Bench:
    """Return a bench that differs from a given one in all respects at once."""
    rng = np.random.default_rng([seed, 2])
    changed = bench.with_friction(rng.uniform(0.0, FRICTION))
    changed = changed.with_delay(rng.uniform(0.0, DELAY))
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


def breaking_point(
    run: Callable[[float, int], bool], largest: float, *, seeds: int, bisections: int = 5
) -> Breaking:
    """Find the largest change survived on all seeds, by bisection from nothing.

    ``run`` takes (change, seed) and says whether it balanced; the interval is halved ``bisections``
    times.
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


@cache
def _maker(name: str) -> MakeController:
    belief = srv02_rig().mechanism
    if name == NAMES[2]:
        return clipped_regulator(belief)
    if name == NAMES[3]:
        return predictive(belief, objective_for(belief, "bench-energy"))
    return makers("bench-energy", ANGLE, BUDGET)["cascade" if name == NAMES[0] else "one-time"]


def run(name: str, truth: Bench, seconds: float, seed: int) -> Result:
    """Run a controller on a rig that it does not know, from rest at ``ANGLE``."""
    bench = srv02_rig()
    belief = bench.mechanism
    return trial(
        belief, truth, _maker(name), belief.state(phi=ANGLE), seconds, seed,
        objective=objective_for(belief, "bench-energy"), told=bench,
    ).numbers  # fmt: skip


def on_random_rig(name: str, seed: int) -> Result:
    """Run a controller on a random rig."""
    return run(name, random_bench(srv02_rig(), seed), SECONDS, seed)


def broken_by(name: str, factor: str) -> Breaking:
    """Find what a controller survives of one of the ``FACTORS``."""
    change, largest, _, _ = FACTORS[factor]

    def survived(value: float, seed: int) -> bool:
        return run(name, change(srv02_rig(), value), SINGLE, seed).balanced

    return breaking_point(survived, largest, seeds=SEEDS)


def robustness(rigs: int = 200, single: bool = True) -> dict[Key, Callable[[], Result | Breaking]]:
    """Return every controller on the same random rigs, then the search for what breaks each.

    By controller, what is changed, and seed. There are ``rigs`` random ones; with ``single`` a
    single change is looked for that is not survived on all of ``SEEDS``.
    """
    names = NAMES if versions()["casadi"] else NAMES[:-1]
    factors = product(FACTORS if single else (), names)
    return {
        (name, RANDOM, seed): partial(on_random_rig, name, seed)
        for name, seed in product(names, range(rigs))
    } | {(name, what, SEEDS): partial(broken_by, name, what) for what, name in factors}
