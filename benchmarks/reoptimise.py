"""One re-optimisation: how long it takes and how good it is, beside predictive control.

The tasks are those of cascade runs from several starts: a state every 0.1 s, with the surface
in use.  Rotary pendulum, d_e = 0.025, |u| ≤ 15 V, ‖x‖ ≤ 0.01 at the end, 60 s at most.

*undertow* is the optimiser of :class:`undertow.Cascade`: it searches the best surface,
warm-started from the one in use, with its default budget.  From cold its first answer is told
beside the one at the end of its global search.
*do-mpc* plans an input of 25 collocation intervals with IPOPT, warm-started from its last plan:
energy over 2.5 s with a quadratic cost-to-go, or free final time.  *CasADi* is our own multiple
shooting with a shifted plan, by IPOPT and by fatrop, with functions and derivatives that gcc has
compiled; without gcc there is no fatrop, and IPOPT runs uncompiled.  *acados*, where ``--acados``
names a Python that has it, plans the least energy of *CasADi*: by SQP from cold, then by one
real-time iteration each.  All but the latter solve to a tolerance of 1e-4.

*Within 1 %* is the part of the answers that cost at most 1.01 × the converged optimum of their
own kind: the best of long searches for a surface, IPOPT at 1e-8 for a plan (energy: or 0.1 % of
the run's first cost more, where little is left to gain).  Ours are costed by integrating the
answer to the end in steps of 2 ms, not by what the optimiser predicts; a real-time iteration's are
charged for the defects they leave.  What each is worth on the plant, closed_loop.py tells.

All run in turn in one process, on one thread; acados in a process of its own, with its own count of
the processor's time, without what the pipe costs.
"""

from __future__ import annotations

from harness import Clock, clock, command_line, percentiles, progress, table  # isort: skip

import os
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

import undertow as ut
from predictive import AcadosShooting
from rivals import DoMPC, ShootingMPC
from undertow.models import FloatArray

GCC = shutil.which("gcc") is not None
RIG = ut.mechanisms.rotary_pendulum(d_e=0.025)
STARTS = (20.0, 30.0, 35.0, 38.0, 40.0, 41.0, 42.0)
PERIOD = 0.1


@dataclass(frozen=True, eq=False)
class Task:
    """A state, the surface in use, the converged cost, and what counts as no difference."""

    t: float
    x: FloatArray
    incumbent: ut.Surface
    converged: float
    scale: float
    slack: float


@dataclass(eq=False)
class Score:
    """Seconds and costs of answers, in the order of the tasks."""

    seconds: list[float] = field(default_factory=list)
    costs: list[float] = field(default_factory=list)

    def add(self, seconds: float, cost: float) -> None:
        """Note one answer; its cost is infinite where there was none."""
        self.seconds.append(seconds)
        self.costs.append(cost)


Goal = Literal["energy", "time"]
WANTED = {
    ("energy", "cold"): "60",
    ("energy", "warm"): "1 and 3",
    ("time", "cold"): "60",
    ("time", "warm"): "3, any",
}
#: Our median over a peer's, at most.
AGAINST = {
    ("energy", "cold"): {"fatrop": 1.0},
    ("energy", "warm"): {"fatrop": 0.25, "acados": 0.5},
    ("time", "cold"): {"fatrop": 0.7},
    ("time", "warm"): {"fatrop": 0.25},
}
WORDS = {"fatrop": "fatrop's", "acados": "acados' real-time iteration"}
Runs = list[tuple[FloatArray, float, list[Task]]]


def collect(objective: ut.Objective, starts: tuple[float, ...], steps: int) -> Runs:
    """Return for each start its state, the cost of its first optimum, and its tasks."""
    cascade = ut.Cascade(RIG, objective, belief="exact")
    exact, optimiser = cascade.loop, cascade.optimiser
    runs: Runs = []
    for start in progress(starts, f"{objective.name}: tasks"):
        first = x = RIG.state(phi=ut.deg(start))
        surface, scale = best_of(exact, x, [optimiser.propose(x, sequence=j) for j in range(3)])
        assert surface is not None  # every start can be caught
        slack = 1e-3 * scale if objective.name == "energy" else 0.0
        tasks = []
        for k in range(1, steps):
            x = exact.simulate(x, surface, duration=PERIOD).x[-1]
            long = [
                optimiser.propose(
                    x, incumbent=surface, sequence=100 * k + j, budget=ut.Budget(6000)
                )
                for j in range(2)
            ]
            best, cost = best_of(exact, x, long)
            if best is None or cost < 1e-3 * scale:
                break
            tasks.append(Task(k * PERIOD, x, surface, cost, scale, slack))
            surface = best
        runs.append((first, scale, tasks))
    return runs


def exact_cost(loop: ut.ClosedLoop, x: FloatArray, answer: ut.Proposal) -> float:
    """Return what the surface of an answer costs, integrated to its end."""
    if answer.surface is None:
        return np.inf
    return float(loop.batch(x, answer.surface).score(loop.objective.horizon)[0])


def best_of(
    loop: ut.ClosedLoop, x: FloatArray, answers: list[ut.Proposal]
) -> tuple[ut.Surface | None, float]:
    """Return the best surface among some answers, and its exact cost."""
    costs = [exact_cost(loop, x, answer) for answer in answers]
    best = int(np.argmin(costs))
    return answers[best].surface, costs[best]


def ours(cascade: ut.Cascade, runs: Runs, now: Clock, number: int) -> tuple[Score, Score, Score]:
    """Return cold and warm scores of one pass over all tasks, and those of first answers."""
    optimiser = cascade.optimiser
    cold, warm, first = Score(), Score(), Score()
    given: list[tuple[Score, float, FloatArray, ut.Proposal]] = []
    for x, _, tasks in runs:
        began = now()
        answers = [(answer, now() - began) for answer in optimiser.improve(x, sequence=number)]
        for score, (answer, seconds) in ((first, answers[0]), (cold, answers[-1])):
            given.append((score, seconds, x, answer))
        for task in tasks:
            number += 1
            began = now()
            answer = optimiser.propose(
                task.x,
                incumbent=task.incumbent,
                sequence=number,
                resolution=1e-4 * task.scale,
            )
            given.append((warm, now() - began, task.x, answer))
    for score, seconds, x, answer in given:  # afterwards, so as not to disturb the timing
        score.add(seconds, exact_cost(cascade.loop, x, answer))
    return cold, warm, first


def theirs(mpc: DoMPC | ShootingMPC, runs: Runs) -> tuple[Score, Score]:
    """Return the same for a predictive controller, by its own clock."""
    cold, warm = Score(), Score()
    for x, _, tasks in runs:
        mpc.forget()
        for score, t, state in ((cold, 0.0, x), *((warm, task.t, task.x) for task in tasks)):
            solved = mpc.plan(t, state)
            score.add(mpc.seconds[-1], mpc.cost if solved else np.inf)
    return cold, warm


def peers(goal: Goal, acados: str | None, now: Clock) -> dict[str, DoMPC | ShootingMPC]:
    """Return the predictive controllers that can be had here, by their names."""
    ipopt = ShootingMPC(RIG, goal, now=now, compiled=GCC)
    count = len(ipopt.grid)
    words = "IPOPT, compiled" if GCC else "IPOPT"
    found: dict[str, DoMPC | ShootingMPC] = {
        f"do-mpc, IPOPT, N = {DoMPC.INTERVALS}": DoMPC(RIG, goal, now=now),
        f"CasADi, {words}, N = {count}": ipopt,
    }
    if GCC:
        fatrop = ShootingMPC(RIG, goal, now=now, solver="fatrop", compiled=True)
        found[f"CasADi, fatrop, compiled, N = {count}"] = fatrop
    if acados and goal == "energy":
        found[f"acados, N = {count}"] = AcadosShooting(acados, RIG)
    return found


def compare(
    objective: ut.Objective, goal: Goal, runs: Runs, rounds: int, now: Clock, acados: str | None
) -> list[str]:
    """Print both tables of one objective; return what to say of the wanted figures."""
    cascade = ut.Cascade(RIG, objective, belief="exact")
    rivals = peers(goal, acados, now)
    names = ["undertow", *rivals, "undertow, first answer"]
    entrants: list[Callable[[int], tuple[Score, ...]]] = [
        lambda k: ours(cascade, runs, now, k),
        *(lambda _, mpc=mpc: theirs(mpc, runs) for mpc in rivals.values()),
    ]
    for run in entrants:  # compile, warm up
        run(10_000)
    best = {
        mpc: [score.costs for score in theirs(mpc(RIG, goal, tolerance=1e-8), runs)]
        for mpc in (DoMPC, ShootingMPC)
    }
    converged = [
        [
            [scale for _, scale, _ in runs],
            [task.converged for _, _, tasks in runs for task in tasks],
        ],
        *(best[DoMPC if isinstance(mpc, DoMPC) else ShootingMPC] for mpc in rivals.values()),
    ]
    slack = [task.slack for _, _, tasks in runs for task in tasks]
    mine = (Score(), Score(), Score())
    scores: list[tuple[Score, ...]] = [mine, *((Score(), Score()) for _ in rivals)]
    for k in progress(range(rounds), f"{objective.name}: rounds"):
        for both, run in zip(scores, entrants, strict=True):
            for total, part in zip(both, run(1000 * k), strict=True):
                total.seconds += part.seconds
                total.costs += part.costs
    scores.append((mine[2],))
    converged.append(converged[0])
    findings = []
    for index, kind in enumerate(("cold", "warm")):
        rows, reference = [], float(np.median(scores[0][index].seconds))
        for name, both, goals in zip(names, scores, converged, strict=True):
            if index == len(both):  # first answers are cold
                continue
            score, own = both[index], goals[index]
            times = float(np.median(score.seconds)) / reference
            if kind == "warm" and name.startswith("do-mpc"):
                findings.append(
                    f"{goal}, warm: do-mpc's median is {times:.1f} times ours (wanted: 10)"
                )
            for peer, most in AGAINST[goal, kind].items():
                if peer in name:
                    words = f"{1 / times:.2f} times {WORDS[peer]} (wanted: {most:g})"
                    if kind == "cold":
                        soon = float(np.median(mine[2].seconds) / np.median(score.seconds))
                        words = f"{soon:.2f}, at the end {words}"
                    findings.append(f"{goal}, {kind}: {words}")
            allowed = 1.01 * np.array(own) + (slack if kind == "warm" else 0.0)
            good = np.array(score.costs) <= np.tile(allowed, rounds)
            rows.append([name, *percentiles(score.seconds), f"{times:.2f}", f"{good.mean():.0%}"])
        count = len(scores[0][index].seconds)
        table(
            f"{objective.name}, {kind}: {count} answers each, ms",
            ["", "median", "p99", "worst", "ratio", "within 1 %"],
            rows,
        )
        ms = 1e3 * np.array(scores[0][index].seconds)
        findings.append(
            f"{goal}, {kind}: median {np.median(ms):.2f} ms, p99 {np.quantile(ms, 0.99):.2f} ms "
            f"(wanted: {WANTED[goal, kind]})"
        )
    return findings


def main() -> int:
    """Collect tasks, compare, and say how the wanted figures came out."""
    parser = command_line(__doc__, "--clock cpu --goal energy", "--starts 35 41", "--acados PYTHON")
    parser.add_argument("--goal", choices=("energy", "time", "both"), default="both")
    parser.add_argument("--starts", nargs="+", type=float, metavar="DEGREES", help="φ(0)")
    parser.add_argument("--rounds", type=int, help="passes over all tasks")
    parser.add_argument("--acados", help="a Python that has acados; $UNDERTOW_ACADOS")
    options = parser.parse_args()
    starts = tuple(options.starts or (STARTS[-2:] if options.quick else STARTS))
    now = clock(options.clock)
    acados = options.acados or os.environ.get("UNDERTOW_ACADOS")
    if not GCC:
        print("there is no gcc: fatrop is left out, and IPOPT is not compiled")
    objectives: dict[Goal, ut.Objective] = {"energy": ut.MinimumEnergy(), "time": ut.MinimumTime()}
    summary: list[str] = []
    for name, objective in objectives.items():
        if options.goal in (name, "both"):
            runs = collect(objective, starts, 4 if options.quick else 8)
            rounds = options.rounds or (1 if options.quick else 5)
            summary += compare(objective, name, runs, rounds, now, acados)
    print()
    for line in summary:
        print(line)
    return 0


if __name__ == "__main__":
    sys.exit(main())
