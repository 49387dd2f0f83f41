"""How often the default cold search finds the best basin: against many long searches.

Random starts (angles, rates, damping) of the rotary pendulum and of the cart pendulum, for least
energy and for least time, with the three plain parameters and with the reaching law free too.  The
default search is the one of a cascade without further settings and with an exact model; the long
ones, by turns, are

* *ours*: another seed and ten times the budget,
* *many*: ten of the default ones in a row, from other seeds,
* *cmaes*: the package of that name, begun again from another random surface when it has converged,
* *evolution*: SciPy's differential evolution,
* *annealing*: SciPy's dual annealing,

the last three with ten times the default's rollouts, on their score.  Every answer is simulated to
a tolerance, and that cost counts.  A default search *misses* where the best of all is more than 1 %
below it, or where only others arrive; starts from which nothing arrives are counted apart.  It
says itself how sure it is (``Proposal.confidence``): of what it was sure of, how much was right?

Every search is kept in the ledger as soon as it is finished: the same command, or one with more
starts or searches, goes on where it was interrupted.  A ledger is of one seed and one version of
the package: remove it after a change.
"""

from __future__ import annotations

from harness import command_line, need, progress, table  # isort: skip

import math
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy.optimize
from scipy.stats import binomtest

import undertow as ut
from undertow.closed_loop.figures import state_words
from undertow.models import FloatArray
from undertow.objective import objective_for
from undertow.optimiser import Budget, DecisionVariables
from undertow.studies.ledger import Ledger

GOALS = ("energy", "time")
FREEDOMS = {
    "three": DecisionVariables(),
    "free": DecisionVariables(reaching=True),
}

#: How much longer a long search is, and how far its random surfaces lie apart.
LONGER, WIDTH, REACH = 10, 1.5, 4.0

#: Costs within this of the best are as good, and the share of starts where they should be.
WITHIN, WANTED = 0.01, 0.97

#: Answers with at least this confidence are counted by themselves.
SURE = 0.9

#: Long searches from every start, and starts of every kind; the same of a quick run.
SEARCHES, STARTS = 50, 200
QUICK = (2, 1)

#: Name of the default search.
DEFAULT = "default"

Cost = Callable[[FloatArray], FloatArray]


class Start(NamedTuple):
    """A mechanism and a state."""

    mechanism: ut.Mechanism
    x0: FloatArray


class Place(NamedTuple):
    """One search: ``default``, or a long one's method and number."""

    mechanism: str
    goal: str
    freedom: str
    start: int
    search: str


class Kind(NamedTuple):
    """What is tallied together."""

    mechanism: str
    goal: str
    freedom: str


@dataclass(frozen=True)
class Found:
    """Simulated cost, ``inf`` where nothing arrives, processor time, s, and confidence."""

    cost: float
    seconds: float
    confidence: float | None = None


# -- starts ----------------------------------------------------------------------------------------


def rotary(rng: np.random.Generator) -> Start:
    """Return a rotary pendulum of random damping from 5° to 42° on either side, moving."""
    rig = ut.mechanisms.rotary_pendulum(d_e=rng.uniform(0.0, 0.073))
    angle = rng.choice([-1, 1]) * rng.uniform(5.0, 42.0)
    rates = rng.uniform(-1.0, 1.0, 2) * (2.0, 1.0)
    state = {"theta": rng.uniform(-1.0, 1.0), "phi": ut.deg(angle)}
    return Start(rig, rig.state(**state, theta_dot=rates[0], phi_dot=rates[1]))


def cart(rng: np.random.Generator) -> Start:
    """Return a cart pendulum of random damping from 3° to 35° on either side, moving."""
    plant = ut.mechanisms.cart_pendulum(
        b_c=rng.uniform(0.0, 0.5), b_p=10.0 ** rng.uniform(-4.0, -2.0)
    )
    angle = rng.choice([-1, 1]) * rng.uniform(3.0, 35.0)
    rates = rng.uniform(-1.0, 1.0, 2) * (0.3, 0.5)
    state = {"x": rng.uniform(-0.3, 0.3), "phi": ut.deg(angle)}
    return Start(plant, plant.state(**state, x_dot=rates[0], phi_dot=rates[1]))


DRAWS = {"rotary_pendulum": rotary, "cart_pendulum": cart}


def drawn(mechanism: str, number: int, seed: int) -> Start:
    """Return a start by its number: the same for the same seed, whatever else is run."""
    return DRAWS[mechanism](np.random.default_rng([seed, list(DRAWS).index(mechanism), number]))


# -- searches --------------------------------------------------------------------------------------


class Task:
    """One start and kind, and the searches from there."""

    def __init__(self, start: Start, goal: str, freedom: str) -> None:
        self.x0 = start.x0
        objective = objective_for(start.mechanism, goal)
        free = FREEDOMS[freedom]
        self.optimiser = ut.Cascade(
            start.mechanism, objective, belief="exact", freedom=free
        ).optimiser
        self.loop, self.space = self.optimiser.loop, self.optimiser.space

    def run(self, search: str) -> Found:
        """Run a search by its name."""
        began = time.process_time()
        if search == DEFAULT:
            answer = self._answer(0)
            cost = math.inf if answer.plan is None else self.simulated(answer.plan)
            return Found(cost, time.process_time() - began, answer.confidence)
        costs = [self.simulated(plan) for plan in self._long(*search.split())]
        return Found(min(costs, default=math.inf), time.process_time() - began)

    def simulated(self, plan: ut.Plan) -> float:
        """Cost of a plan, simulated to a tolerance; ``inf`` where it does not arrive."""
        longest = 1.001 * self.loop.objective.horizon  # the best energy is spent until the end
        batch = self.loop.batch(self.x0, plan, duration=longest, stable_only=True, precise=True)
        return float(batch.cost[0]) if batch.reached[0] else math.inf

    def _answer(self, seed: int, longer: int = 1) -> ut.Proposal:
        return replace(self.optimiser, seed=seed).propose(self.x0, budget=self._budget(longer))

    def _default(self, seed: int, longer: int = 1) -> Iterator[ut.Plan]:
        found = self._answer(seed, longer)
        if found.plan is not None:
            yield found.plan

    def _budget(self, longer: int) -> Budget:
        return Budget(longer * self.optimiser._budget(warm=False).evaluations)

    def _long(self, method: str, number: str) -> Iterator[ut.Plan]:
        return METHODS[method](self, int(number))

    def ours(self, seed: int) -> Iterator[ut.Plan]:
        """Ten times the budget, another seed."""
        return self._default(seed, LONGER)

    def many(self, seed: int) -> Iterator[ut.Plan]:
        """Ten default searches in a row, other seeds."""
        for k in range(LONGER):
            yield from self._default(1000 * seed + k)

    def cmaes(self, seed: int) -> Iterator[ut.Plan]:
        """The cmaes package, restarted."""
        package = need("cmaes", "compare")

        def routine(cost: Cost, rng: np.random.Generator) -> None:
            while True:
                search = package.CMA(self._anywhere(rng), 0.5, population_size=32,
                                     seed=int(rng.integers(1 << 31)))  # fmt: skip
                while not search.should_stop():
                    x = np.array([search.ask() for _ in range(32)])
                    search.tell(list(zip(x, cost(x).tolist(), strict=True)))

        return self._by(routine, seed)

    def evolution(self, seed: int) -> Iterator[ut.Plan]:
        """SciPy's differential evolution, restarted."""

        def routine(cost: Cost, rng: np.random.Generator) -> None:
            evolve: Any = scipy.optimize.differential_evolution
            first = np.array([self._anywhere(rng) for _ in range(48)])
            evolve(
                lambda x: cost(x.T), self._box(), vectorized=True, updating="deferred", rng=rng,
                init=np.clip(first, *self._box().T), polish=False, maxiter=10**6, tol=1e-3,
            )  # fmt: skip

        return self._by(routine, seed)

    def annealing(self, seed: int) -> Iterator[ut.Plan]:
        """SciPy's dual annealing, restarted."""

        def routine(cost: Cost, rng: np.random.Generator) -> None:
            anneal: Any = scipy.optimize.dual_annealing
            anneal(lambda x: float(cost(x[None])[0]), self._box(), rng=rng, maxiter=1000,
                   x0=np.clip(self._anywhere(rng), *self._box().T))  # fmt: skip

        return self._by(routine, seed)

    def _anywhere(self, rng: np.random.Generator) -> FloatArray:
        return np.asarray(self.optimiser.firsts[0] + self.space.steps(rng, np.array([WIDTH]))[0])

    def _box(self) -> FloatArray:
        centre = self.optimiser.firsts[0]
        return np.column_stack([centre - REACH, centre + REACH])

    def _by(self, routine: Callable[[Cost, np.random.Generator], None], seed: int
            ) -> Iterator[ut.Plan]:  # fmt: skip
        """Repeat a routine until the rollouts are spent; yield the best plan."""
        rng, left = np.random.default_rng(seed), self._budget(LONGER).evaluations
        best, best_z = math.inf, self.optimiser.firsts[0]
        horizon = self.loop.objective.horizon

        def cost(z: FloatArray) -> FloatArray:
            nonlocal best, best_z, left
            if left <= 0:
                raise _SpentError
            left -= len(z)
            z = np.asarray(z, dtype=float)
            batch = self.space.batch(self.x0, z, duration=horizon, stable_only=True)
            f = np.asarray(batch.score(horizon))
            if f.min() < best:
                best, best_z = float(f.min()), np.array(z[int(f.argmin())], dtype=float)
            return f

        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                while left > 0:
                    routine(cost, rng)
            except _SpentError:
                pass
        yield self.space.plan(best_z)


class _SpentError(Exception):
    """The rollouts are spent: ends a routine from within its cost."""


METHODS: dict[str, Callable[[Task, int], Iterator[ut.Plan]]] = {
    "ours": Task.ours,
    "many": Task.many,
    "cmaes": Task.cmaes,
    "evolution": Task.evolution,
    "annealing": Task.annealing,
}


def named_searches(count: int, methods: Sequence[str]) -> list[str]:
    """Return the default search and so many long ones, of the methods by turns."""
    turns = (f"{methods[k % len(methods)]} {1 + k // len(methods)}" for k in range(count))
    return [DEFAULT, *turns]


# -- what was found --------------------------------------------------------------------------------


def ledger(path: Path | None, seed: int) -> Ledger[Found]:
    """Return what is known already."""
    return Ledger(path, tuple[str, str, str, int, str, Found], {"basins": True, "seed": seed})


def fill(
    kept: Ledger[Found],
    kinds: Sequence[Kind],
    starts: int,
    searches: Sequence[str],
    seed: int,
) -> None:
    """Run every search that is not known, start by start."""
    for number, kind in progress(list(product(range(starts), kinds)), "starts and kinds"):
        places = [Place(*kind, number, search) for search in searches]
        wanting = [place for place in places if place not in kept.known]
        if not wanting:
            continue
        task = Task(drawn(kind.mechanism, number, seed), kind.goal, kind.freedom)
        for place in wanting:
            found = task.run(place.search)
            kept.keep(place, found)


class Tally(NamedTuple):
    """What the searches from one start found: costs by their names."""

    kind: Kind
    start: int
    costs: dict[str, float]
    confidence: float | None

    @property
    def best(self) -> float:
        """Cost of the best search."""
        return min(self.costs.values())

    @property
    def loss(self) -> float:
        """What the default search costs beyond the best, relative; NaN where nothing arrives."""
        return self.costs[DEFAULT] / self.best - 1.0 if math.isfinite(self.best) else math.nan

    @property
    def missed(self) -> bool:
        """Whether the default search missed the best basin."""
        return self.loss > WITHIN


def tallies(
    known: Mapping[Any, Found], kinds: Sequence[Kind], starts: int, searches: Sequence[str]
) -> list[Tally]:
    """Gather the costs of every start and kind."""
    return [
        Tally(
            kind,
            number,
            {s: known[Place(*kind, number, s)].cost for s in searches},
            known[Place(*kind, number, DEFAULT)].confidence,
        )
        for kind in kinds
        for number in range(starts)
    ]


def share(some: Sequence[Tally]) -> tuple[int, int, float, float]:
    """Return starts within 1 %, starts from which something arrives, and Wilson's 95 % interval."""
    decided = [t for t in some if math.isfinite(t.best)]
    good = sum(not t.missed for t in decided)
    if not decided:
        return 0, 0, math.nan, math.nan
    interval = binomtest(good, len(decided)).proportion_ci(method="wilson")
    return good, len(decided), float(interval.low), float(interval.high)


def sure(some: Sequence[Tally]) -> list[Tally]:
    """Return those with an answer of which the default search was sure."""
    return [t for t in some if t.confidence is not None and t.confidence >= SURE]


def report(every: Sequence[Tally], kinds: Sequence[Kind], seed: int) -> None:
    """Print a table of the kinds, what was missed, and the sentence."""
    rows = []
    for kind in kinds:
        some = [t for t in every if t.kind == kind]
        good, count, low, high = share(some)
        losses = [max(t.loss, 0.0) for t in some if not math.isnan(t.loss)]
        cells = ["—"] * 3
        if losses:
            cells = [f"{100 * low:.0f} to {100 * high:.0f}"]
            cells += [_percent(float(f(losses))) for f in (np.median, np.max)]
        certain = sure(some)
        right = sum(not t.missed for t in certain)
        counts = [str(len(some)), str(len(some) - count), f"{right} of {len(certain)}"]
        counts += [f"{good} of {count}"]
        rows.append([", ".join(kind), *counts, *cells])
    header = [
        "",
        "starts",
        "none",
        "of the sure",
        "within 1 %",
        "95 %, %",
        "median loss, %",
        "worst, %",
    ]
    table("the default cold search against the best of all", header, rows)
    rows = []
    for t in every:
        if t.missed:
            mechanism, x0 = drawn(t.kind.mechanism, t.start, seed)
            by = [s for s, cost in t.costs.items() if cost <= (1 + WITHIN) * t.best]
            costs = [f"{t.costs[DEFAULT]:.5g}", f"{t.best:.5g}", f"{len(by)} of {len(t.costs)}"]
            methods = ", ".join(dict.fromkeys(s.split()[0] for s in by))
            start = [str(t.start), state_words(mechanism, x0)]
            rows.append([", ".join(t.kind), *start, *costs, methods])
    if rows:
        table("missed", ["", "start", "from", "default", "best", "found", "by"], rows)
    good, count, low, high = share(every)
    print(
        f"\nWithin 1 % of the best: {good} of {count} starts, {100 * good / max(count, 1):.1f} %, "
        f"95 % interval {100 * low:.1f} to {100 * high:.1f} % (wanted: {100 * WANTED:g} %)"
    )
    certain = sure(every)
    right = sum(not t.missed for t in certain)
    print(
        f"Said with at least {SURE:.0%} confidence: {len(certain)} of {len(every)} answers, "
        f"{right} of them within 1 %"
    )


def _percent(loss: float) -> str:
    return "fails" if math.isinf(loss) else f"{100 * loss:.2f}"


def main() -> int:
    """Run what is not known, then print."""
    parser = command_line(
        __doc__, "--starts 25 --searches 10 --ledger basins.jsonl", "--only rotary_pendulum",
        clocks=False,
    )  # fmt: skip
    parser.add_argument("--starts", type=int, help=f"starts of each kind ({STARTS}; --quick: 2)")
    parser.add_argument("--searches", type=int, help=f"long ones from each ({SEARCHES}; 1)")
    parser.add_argument("--only", choices=list(DRAWS), help="this mechanism only")
    parser.add_argument("--methods", nargs="+", choices=list(METHODS), help="of the long ones")
    parser.add_argument("--goal", choices=GOALS, help="this goal only")
    parser.add_argument("--seed", type=int, default=0, help="seed of the starts (0)")
    parser.add_argument("--ledger", type=Path, help="file of finished searches, continued")
    options = parser.parse_args()
    usual = QUICK if options.quick else (STARTS, SEARCHES)
    starts, searches = (
        default if given is None else given
        for given, default in zip((options.starts, options.searches), usual, strict=True)
    )
    if starts < 1 or searches < 1:
        parser.error(f"--starts {starts} --searches {searches}: at least 1 each")
    need("cmaes", "compare")
    mechanisms = [options.only] if options.only else list(DRAWS)
    goals = [options.goal] if options.goal else list(GOALS)
    kinds = [Kind(*kind) for kind in product(mechanisms, goals, FREEDOMS)]
    kept = ledger(options.ledger, options.seed)
    names = named_searches(searches, options.methods or list(METHODS))
    fill(kept, kinds, starts, names, options.seed)
    report(tallies(kept.known, kinds, starts, names), kinds, options.seed)
    return 0


if __name__ == "__main__":
    sys.exit(main())
