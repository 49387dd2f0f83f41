"""Search methods behind one ask/tell face, on the real task, at equal evaluations.

The task: the surface of least energy, or least time, for the rotary pendulum (d_e = 0.025) from
38°, in the optimiser's own search coordinates.  Every method starts from the same designed
surface with the same width, and may ask for the same number of rollouts; the costs it is told
are those of the kernel.  Repeated from several seeds.

* *ours*: undertow.optimiser.cma_es.CMAES, a whole population a call, and
  undertow.optimiser.trust_region.TrustRegion, 16 a call, restarted at random when it gains nothing
  any more.
* *cmaes*: the package of that name, told one member at a time.
* *SciPy …*: routines that call the cost themselves, turned inside out by a thread; differential
  evolution hands over populations, the others one point at a time, restarted at random when
  they end early.
* *random*: Gaussian draws around the best so far, their width halved when a generation fails.

*Best* is the best of the seeds, the converged cost the best of all.  *Overhead* is the time in
ask and tell; *rollouts* the time in the kernel, which works on 16 at a time, so that a method
that asks for one at a time pays for 16.  *µs* are per evaluation.
"""

from __future__ import annotations

from harness import Clock, clock, command_line, need, progress, table  # isort: skip

import queue
import sys
import threading
import warnings
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
import scipy.optimize

import undertow as ut
from undertow.cascade.planners import TAIL_RTOL
from undertow.closed_loop import LANES
from undertow.models import FloatArray
from undertow.optimiser import CMAES
from undertow.optimiser.trust_region import TrustRegion

Cost = Callable[[FloatArray], FloatArray]
POPULATION, WIDTH, REACH = 32, 0.5, 4.0


class Searcher(Protocol):
    """What every method looks like from outside."""

    def ask(self) -> FloatArray:
        """Return points to try, (N, d)."""

    def tell(self, x: FloatArray, f: FloatArray, /) -> None:
        """Take their costs, (N,)."""


Make = Callable[[FloatArray, int], Searcher]


def ours(start: FloatArray, seed: int) -> Searcher:
    """Return undertow's own."""
    return CMAES(start, WIDTH, POPULATION, np.random.default_rng(seed))


class Restarted:
    """The quadratic-model search; from another start once it gains nothing any more."""

    def __init__(self, start: FloatArray, seed: int) -> None:
        self._start, self._rng = start, np.random.default_rng(seed)
        self._begin(start)

    def _begin(self, start: FloatArray) -> None:
        self._search = TrustRegion(start, WIDTH, LANES, self._rng)
        self._best, self._fruitless = np.inf, 0

    def ask(self) -> FloatArray:
        """Return a batch."""
        return self._search.ask()

    def tell(self, x: FloatArray, f: FloatArray) -> None:
        """Learn; begin again elsewhere where nothing is left to learn."""
        self._search.tell(x, f)
        gained = self._search.best_f < (1 - 1e-4) * self._best
        self._fruitless = 0 if gained else self._fruitless + 1
        self._best = self._search.best_f
        if self._fruitless == 3:
            self._begin(self._start + WIDTH * self._rng.standard_normal(self._start.size))


class CmaesPackage:
    """The cmaes package, which asks for and is told one member at a time."""

    def __init__(self, start: FloatArray, seed: int) -> None:
        package = need("cmaes", "compare")
        self._search = package.CMA(start, WIDTH, population_size=POPULATION, seed=seed)

    def ask(self) -> FloatArray:
        """Return a population."""
        return np.array([self._search.ask() for _ in range(POPULATION)])

    def tell(self, x: FloatArray, f: FloatArray) -> None:
        """Update."""
        self._search.tell(list(zip(x, f.tolist(), strict=True)))


class Random:
    """Draws around the best so far; their width halves when a generation fails."""

    def __init__(self, start: FloatArray, seed: int) -> None:
        self._rng, self._best, self._cost, self._width = (
            np.random.default_rng(seed), start, np.inf, 2 * WIDTH,
        )  # fmt: skip

    def ask(self) -> FloatArray:
        """Return draws."""
        draws = self._rng.standard_normal((POPULATION, self._best.size))
        return np.asarray(self._best + self._width * draws)

    def tell(self, x: FloatArray, f: FloatArray) -> None:
        """Keep the best."""
        i = int(np.argmin(f))
        if f[i] < self._cost:
            self._best, self._cost = x[i], float(f[i])
        else:
            self._width = max(self._width / 2, 1e-3)


class Ended(Exception):  # noqa: N818  a signal, no error
    """The search is over: raised inside the routine to end its thread."""


class InsideOut:
    """A routine that calls its cost, turned into ask and tell by a thread of its own."""

    def __init__(self, routine: Callable[[Cost], None]) -> None:
        self._points: queue.Queue[FloatArray] = queue.Queue(1)
        self._costs: queue.Queue[FloatArray | None] = queue.Queue(1)
        self._thread = threading.Thread(target=self._run, args=(routine,), daemon=True)
        self._thread.start()

    def _run(self, routine: Callable[[Cost], None]) -> None:
        try:
            while True:  # one run after another until nobody asks any more
                routine(self._cost)
        except Ended:
            return

    def _cost(self, x: FloatArray) -> FloatArray:
        self._points.put(np.atleast_2d(x))
        f = self._costs.get()
        if f is None:
            raise Ended
        return f

    def ask(self) -> FloatArray:
        """Wait for the routine's next points."""
        return self._points.get()

    def tell(self, _x: FloatArray, f: FloatArray) -> None:
        """Let the routine go on."""
        self._costs.put(f)

    def close(self) -> None:
        """End the thread, at its next call of the cost."""
        self._points.get()
        self._costs.put(None)
        self._thread.join()


def differential_evolution(start: FloatArray, seed: int) -> Searcher:
    """SciPy's, a population a call, in a box around the start."""
    rng = np.random.default_rng(seed)
    bounds = scipy.optimize.Bounds(start - REACH, start + REACH)

    def routine(cost: Cost) -> None:
        first = start + WIDTH * rng.standard_normal((POPULATION, start.size))
        evolve: Any = scipy.optimize.differential_evolution
        evolve(
            lambda x: cost(x.T), bounds, vectorized=True, updating="deferred", rng=rng,
            init=np.clip(first, bounds.lb, bounds.ub), polish=False, maxiter=10**6, tol=0.0,
        )  # fmt: skip

    return InsideOut(routine)


def restarted(method: str) -> Make:
    """Return a method of scipy.optimize.minimize, restarted at random when it ends."""

    def make(start: FloatArray, seed: int) -> Searcher:
        rng, first = np.random.default_rng(seed), [True]

        def routine(cost: Cost) -> None:
            begin = start + (0 if first[0] else WIDTH) * rng.standard_normal(start.size)
            first[0] = False
            simplex = begin + WIDTH * np.vstack([np.zeros(start.size), np.eye(start.size)])
            extra: dict[str, Any] = {"initial_simplex": simplex} if method[0] == "N" else {}
            minimise: Any = scipy.optimize.minimize
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                minimise(lambda x: float(cost(x)[0]), begin, method=method, options=extra)

        return InsideOut(routine)

    return make


METHODS: dict[str, Make] = {
    "ours, CMA-ES": ours,
    "ours, quadratic model": Restarted,
    "cmaes, CMA-ES": CmaesPackage,
    "random, shrinking": Random,
    "SciPy differential evolution": differential_evolution,
    "SciPy Nelder-Mead, restarts": restarted("Nelder-Mead"),
    "SciPy Powell, restarts": restarted("Powell"),
    "SciPy COBYQA, restarts": restarted("COBYQA"),
}


def run(
    make: Make, start: FloatArray, seed: int, cost: Cost, budget: int, now: Clock
) -> tuple[float, float, float]:
    """Search once; return the best cost, seconds in ask and tell, and seconds in the kernel."""
    searcher = make(start, seed)
    best, spent, inside, rolling = np.inf, 0, 0.0, 0.0
    while spent < budget:
        a = now()
        asked = searcher.ask()
        x = asked[: budget - spent]
        b = now()
        f = cost(x)
        c = now()
        best, spent = min(best, float(f.min())), spent + len(x)
        if spent < budget:
            searcher.tell(x, f)
        inside, rolling = inside + b - a + now() - c, rolling + c - b
    if isinstance(searcher, InsideOut):
        searcher.tell(asked, np.concatenate([f, np.full(len(asked) - len(x), np.inf)]))
        searcher.close()
    return best, inside, rolling


def main() -> int:
    """Race the methods and print a table for each objective."""
    parser = command_line(__doc__, "--evaluations 600 2400 --seeds 7 --methods ours cmaes")
    parser.add_argument("--evaluations", nargs="+", type=int, help="budgets (600 2400)")
    parser.add_argument("--seeds", type=int, help="number of seeds (7; --quick: 2)")
    parser.add_argument("--methods", nargs="+", help="first words of the methods to run")
    options = parser.parse_args()
    budgets = options.evaluations or ([320] if options.quick else [600, 2400])
    seeds = options.seeds or (2 if options.quick else 7)
    chosen = {
        name: make
        for name, make in METHODS.items()
        if not options.methods or any(name.startswith(m) for m in options.methods)
    }
    if not chosen:
        parser.error(f"--methods: none of {', '.join(METHODS)} starts with {options.methods}")
    need("cmaes", "compare")
    now = clock(options.clock)
    rig = ut.mechanisms.rotary_pendulum(d_e=0.025)
    x0 = rig.state(phi=ut.deg(38))
    for objective in (ut.MinimumEnergy(), ut.MinimumTime()):
        loop = ut.ClosedLoop(rig, objective, tail_rtol=TAIL_RTOL)
        decision = ut.Optimiser(loop).space
        start = decision.encode(ut.Plan((ut.first_surface(rig),)))

        def cost(z: FloatArray, loop: ut.ClosedLoop = loop, decision: Any = decision) -> FloatArray:
            vectors, _ = decision.decode(np.asarray(z, dtype=float))
            return loop.batch(x0, vectors, stable_only=True).score(loop.objective.horizon)

        for make in chosen.values():  # compile
            run(make, start, 0, cost, 64, now)
        found = {
            (name, budget): [
                run(make, start, seed, cost, budget, now)
                for seed in progress(range(seeds), f"{objective.name}, {name}, {budget}: seeds")
            ]
            for budget in budgets
            for name, make in chosen.items()
        }
        converged = min(min(best for best, _, _ in results) for results in found.values())
        rows = []
        for (name, budget), results in found.items():
            costs = np.array([best for best, _, _ in results])
            inside, rolling = (1e6 * np.median([r[i] for r in results]) / budget for i in (1, 2))
            shown = [f"{v:.4f}" if v < 1e8 else "none" for v in
                     (costs.min(), float(np.median(costs)), costs.max())]  # fmt: skip
            rows.append(
                [name, str(budget), *shown, f"{np.mean(costs <= 1.01 * converged):.0%}",
                 f"{inside:.1f}", f"{rolling:.1f}"]
            )  # fmt: skip
        table(
            f"{objective.name}: {seeds} seeds, best of all {converged:.4f}",
            ["", "evaluations", "best", "median", "worst", "within 1 %", "overhead, µs",
             "rollouts, µs"],
            rows,
        )  # fmt: skip
    return 0


if __name__ == "__main__":
    sys.exit(main())
