"""How an optimisation grows: with the mechanism, with the horizon, with the population.

Mechanisms: pendulums with one, two and three links on a cart (n = 2, 3, 4; one input), each from
its usual start, minimum energy.  A re-optimisation is warm-started 0.1 s into the motion of the
first optimum, with the default budget, on rails without ends, so that the end of a motion is taken
in large steps for all of them.  All mechanisms take turns, round after round; ratios are
of medians to n = 2.  *Step* is what one Runge-Kutta step of one rollout costs in a batch of 256,
in small steps throughout.

The horizon and the population are varied on the rotary pendulum (d_e = 0.025, 38°), with the
other settings as usual.  A re-optimisation fits a model to batches of 16; the population is that
of the global optimisation.
"""

from __future__ import annotations

from harness import Clock, clock, command_line, progress, race, table  # isort: skip

import sys
from collections.abc import Callable
from dataclasses import replace

import numpy as np

import undertow as ut
from undertow.cascade.planners import TAIL_RTOL
from undertow.models import FloatArray

FAMILY: dict[int, Callable[[], ut.Mechanism]] = {
    2: ut.mechanisms.cart_pendulum,
    3: ut.mechanisms.double_pendulum_on_a_cart,
    4: ut.mechanisms.triple_pendulum_on_a_cart,
}


class Task:
    """A re-optimisation 0.1 s after a first optimum."""

    def __init__(self, rig: ut.Mechanism, x0: FloatArray, horizon: float = 60.0) -> None:
        exact = ut.ClosedLoop(rig, ut.MinimumEnergy(horizon=horizon, travel=False))
        self.loop = replace(exact, tail_rtol=TAIL_RTOL)
        self.optimiser = ut.Optimiser(self.loop)
        first = self.optimiser.require(x0)
        assert first.surface is not None  # require() raises otherwise
        self.surface = first.surface
        self.x = exact.simulate(x0, self.surface, duration=0.1).x[-1]
        self.scale, self.number = first.cost, 0
        self.evaluations: list[int] = []
        self.costs: list[float] = []
        self.reoptimise()  # compile what is not yet compiled

    def reoptimise(self) -> None:
        """Run one re-optimisation, another one each time."""
        self._propose(self.surface)

    def optimise(self) -> None:
        """Run one global optimisation, another one each time."""
        self._propose(None)

    def _propose(self, incumbent: ut.Surface | None) -> None:
        self.number += 1
        answer = self.optimiser.propose(
            self.x, incumbent=incumbent, sequence=self.number, resolution=1e-4 * self.scale
        )
        self.evaluations.append(answer.evaluations)
        self.costs.append(answer.cost)


def dimensions(rounds: int, now: Clock) -> float:
    """Print the growth with n; return the ratio of n = 4 to n = 2."""
    tasks = {}
    for n in progress(list(FAMILY), "first optima"):
        rig = FAMILY[n]()
        tasks[n] = Task(rig, rig.state(**rig.start))
    steps = 500

    def stepping(task: Task) -> Callable[[], object]:
        loop = replace(task.loop, tail_rtol=0.0)
        vectors = np.tile(task.surface.vector, (256, 1))

        def run() -> object:
            return loop.batch(task.x, vectors, duration=steps * loop.step, terminal=0.0)

        run()
        return run

    whole = race({str(n): task.reoptimise for n, task in tasks.items()}, rounds, now, "n")
    single = race({str(n): stepping(task) for n, task in tasks.items()}, rounds, now, "steps")
    medians = {n: float(np.median(whole[str(n)])) for n in tasks}
    rows = []
    for n, task in tasks.items():
        step = float(np.median(single[str(n)])) / (256 * steps)
        base = float(np.median(single["2"])) / (256 * steps)
        rows.append(
            [f"{n}  {task.loop.mechanism.name}", str(task.optimiser.space.size),
             f"{np.median(task.evaluations):.0f}", f"{1e3 * medians[n]:.2f}",
             f"{medians[n] / medians[2]:.2f}", f"{1e9 * step:.1f}", f"{step / base:.2f}"]
        )  # fmt: skip
    table(
        "growth with n",
        ["n", "searched", "evaluations", "re-optimisation, ms", "ratio", "step, ns", "ratio"],
        rows,
    )
    return medians[4] / medians[2]


def horizons(values: list[float], rounds: int, now: Clock) -> None:
    """Print the growth with the longest prediction, in large steps at the end and in small ones."""
    rig = ut.mechanisms.rotary_pendulum(d_e=0.025)
    x = rig.state(phi=ut.deg(38))
    tasks = {h: Task(rig, x, h) for h in progress(values, "horizons")}
    plain = {h: Task(rig, x, h) for h in values}
    for task in plain.values():
        task.optimiser = replace(task.optimiser, loop=replace(task.loop, tail_rtol=0.0))
        task.reoptimise()
    entrants = {f"{h} end": task.reoptimise for h, task in tasks.items()}
    entrants |= {f"{h} plain": task.reoptimise for h, task in plain.items()}
    times = race(entrants, rounds, now, "horizons")
    rows = []
    for h, task in tasks.items():
        end, without = (float(np.median(times[f"{h} {kind}"])) for kind in ("end", "plain"))
        rows.append(
            [f"{h:g}", f"{np.median(task.costs):.3f}", f"{1e3 * end:.2f}", f"{1e3 * without:.2f}",
             f"{without / end:.2f}"]
        )  # fmt: skip
    table(
        "growth with the horizon",
        ["horizon, s", "cost", "large steps, ms", "small ones, ms", "ratio"],
        rows,
    )


def populations(rounds: int, now: Clock) -> None:
    """Print what a batch costs as it grows, and what a larger population gains."""
    rig = ut.mechanisms.rotary_pendulum(d_e=0.025)
    task = Task(rig, rig.state(phi=ut.deg(38)))
    rng = np.random.default_rng(0)
    sizes = (1, 16, 64, 256, 1024)
    z = task.optimiser.space.encode(ut.Plan((task.surface,)))
    vectors, _ = task.optimiser.space.decode(z + 0.1 * rng.standard_normal((max(sizes), z.size)))

    def batch(size: int) -> Callable[[], object]:
        return lambda: task.loop.batch(task.x, vectors[:size], stable_only=True)

    times = race({str(s): batch(s) for s in sizes}, rounds, now, "batches")
    rows = []
    for s in sizes:
        ms = 1e3 * float(np.median(times[str(s)]))
        rows.append([str(s), f"{ms:.3f}", f"{1e3 * ms / s:.2f}"])
    table("growth of one batch of rollouts", ["rollouts", "ms", "µs each"], rows)

    searches = {}
    for population in (8, 16, 32, 64, 128):
        other = Task(rig, rig.state(phi=ut.deg(38)))
        other.optimiser = replace(other.optimiser, population=population)
        other.costs.clear()
        other.evaluations.clear()
        searches[population] = other
    times = race({str(p): t.optimise for p, t in searches.items()}, rounds, now, "populations")
    rows = [
        [str(p), f"{np.median(t.evaluations):.0f}", f"{1e3 * np.median(times[str(p)]):.2f}",
         f"{np.median(t.costs):.4f}", f"{max(t.costs):.4f}"]
        for p, t in searches.items()
    ]  # fmt: skip
    table(
        "growth of one global optimisation with the population",
        ["population", "evaluations", "ms", "cost, median", "worst"],
        rows,
    )


def main() -> int:
    """Print the three tables."""
    parser = command_line(__doc__, "--rounds 8 --clock cpu")
    parser.add_argument("--rounds", type=int, help="rounds of each race (25; --quick: 5)")
    options = parser.parse_args()
    now, rounds = clock(options.clock), options.rounds or (5 if options.quick else 25)
    ratio = dimensions(rounds, now)
    horizons([5.0, 60.0] if options.quick else [2.0, 5.0, 10.0, 30.0, 60.0, 120.0], rounds, now)
    populations(rounds, now)
    print(f"\nn = 4 costs {ratio:.1f} times n = 2 (wanted: below 10)")
    return 0


if __name__ == "__main__":
    sys.exit(main())
