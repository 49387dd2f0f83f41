"""Random rigs unknown to the controllers: which ones still balance, and what makes each fail.

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
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from undertow.base import MissingExtraError, Progress, no_progress, versions
from undertow.estimators import Belief
from undertow.models import FloatArray, Mechanism
from undertow.objective import objective_for
from undertow.plants import Bench, Push, srv02_rig
from undertow.runtime import estimator_for
from undertow.studies.ledger import Ledger
from undertow.studies.trials.balance import controllers
from undertow.studies.trials.steering import clipped_regulator, predictive
from undertow.studies.trials.trial import MakeController, Outcome, Result, trial

#: Half-width of the masses; scale of friction; delay in all, s; impulse, N m s.
MASSES, FRICTION, DELAY, IMPULSE = 0.20, 2.0, 0.005, 0.004

#: When a knock comes, s; and the length of a run with a single change, which leaves a slow
#: surface the time to bring the arm home afterwards.
KNOCK, SINGLE = 5.0, 20.0

#: φ(0), rad, at rest; and rollouts that one re-optimisation may spend.
ANGLE, BUDGET = math.radians(35), 256

#: Names in the tables.
NAMES = ("cascade", "fixed surface", "clipped LQR", "NMPC, 10 Hz")


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


#: Types of the numbers of a result.
_KINDS: Mapping[str, tuple[type, ...]] = {
    field.name: {"int": (int,), "bool": (bool,)}.get(str(field.type), (int, float))
    for field in fields(Result)
}

#: Controller, what was changed, by how much, and seed.
RunKey = tuple[str, str, float, int]
RunLedger = Ledger[RunKey, Result]


def run_ledger(path: Path | None, settings: Mapping[str, Any]) -> RunLedger:
    """Return the ledger of runs with some settings, JSON values."""
    return Ledger(path, {"settings": settings, "versions": versions()}, _read)


def keep_run(ledger: RunLedger, name: str, what: str, value: float, outcome: Outcome) -> Result:
    """Keep the numbers of a run."""
    result = Result(**{name: getattr(outcome, name) for name in _KINDS})
    numbers = {k: v if math.isfinite(v) else None for k, v in asdict(result).items()}
    return ledger.keep((name, what, value, outcome.seed), result, [name, what, value, numbers])


def _read(
    line: tuple[str, str, float, dict[str, Any]],
) -> tuple[tuple[str, str, float, int], Result]:
    name, what, value, numbers = line
    kept: dict[str, Any] = {k: math.inf if v is None else v for k, v in numbers.items()}
    result = Result(**kept)
    whole = all(type(getattr(result, key)) in kinds for key, kinds in _KINDS.items())
    if not (isinstance(name, str) and isinstance(what, str) and whole):
        raise ValueError(f"a line that is no result: {str(line)[:80]}")
    return (name, what, float(value), result.seed), result


def _makers(belief: Mechanism, bench: Bench, x0: FloatArray) -> dict[str, MakeController]:
    """Return the controllers by name; NMPC where CasADi is there."""
    objective = objective_for(belief, "bench-energy")
    made = controllers(belief, bench, objective, x0, budget=BUDGET)
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
    seconds: float = 10.0,
    ledger: Path | None = None,
    progress: Progress = no_progress,
) -> RobustnessResult:
    """Run every controller on the same random rigs, then look for what breaks each.

    There are ``rigs`` random ones, and ``seeds`` on which a single change must be survived (0 looks
    for no breaking points). A run on a random rig begins at rest at ``ANGLE`` and takes
    ``seconds``, s. ``ledger`` is a file that keeps every run as it is made: what it holds already
    is not run again.

    Raises
    ------
    ArtefactError
        When the ledger is of another version or of other settings.
    """
    bench = srv02_rig()
    belief = bench.mechanism
    x0: FloatArray = belief.state(phi=ANGLE)
    objective = objective_for(belief, "bench-energy")
    makers = _makers(belief, bench, x0)
    settings = {"angle": ANGLE, "seconds": [seconds, SINGLE], "budget": BUDGET}
    book = run_ledger(ledger, settings | {"fingerprint": belief.fingerprint})

    def once(name: str, what: str, value: float, seed: int, truth: Bench) -> Result:
        known = book.known.get((name, what, value, seed))
        if known is not None:
            return known
        told = estimator_for(belief, bench, known=Belief.usual(belief))
        length = seconds if what == "random" else SINGLE
        outcome = trial(
            belief, truth, makers[name], x0, length, seed, objective=objective, estimator=told
        )
        return keep_run(book, name, what, value, outcome)

    def survived(
        name: str, factor: str, change: Callable[[Bench, float], Bench], value: float, seed: int
    ) -> bool:
        return once(name, factor, value, seed, change(bench, value)).balanced

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

            run = partial(survived, name, factor, change)
            breaking[name, factor] = breaking_point(run, largest, seeds=seeds)
            done += 1
    return RobustnessResult(outcomes, breaking, seeds)
