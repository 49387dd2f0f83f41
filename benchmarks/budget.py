"""A budget in seconds: whether it is kept, and whether an answer is ever worse than the incumbent.

Random states around a run of the rotary pendulum (d_e = 0.025), each with the surface that was
in use there; the optimiser is asked for an answer within the budget.  *Late* is the time after
the budget at which the answer was there (negative: before).  Both costs, of the answer and of
the incumbent, are integrated afresh to the end without the linear tail; the answer may not be
dearer by more than the tail's tolerance.
"""

from __future__ import annotations

from harness import clock, command_line, progress, table  # isort: skip

import sys
from dataclasses import replace

import numpy as np

import undertow as ut
from undertow.cascade.planners import TAIL_RTOL
from undertow.models import FloatArray

RIG = ut.mechanisms.rotary_pendulum(d_e=0.025)
START = ut.deg(38)
PERIOD = 0.1


def situations(objective: ut.Objective, count: int) -> list[tuple[FloatArray, ut.Surface]]:
    """Return states near those of a cascade run with the surface in use, all of them feasible."""
    exact = ut.ClosedLoop(RIG, objective)
    run = ut.Cascade(RIG, objective, period=PERIOD, belief="exact").simulate(
        phi=START, duration=1.0
    )
    rng = np.random.default_rng(0)
    found: list[tuple[FloatArray, ut.Surface]] = []
    while len(found) < count:
        for update in run.updates:
            x = update.x * (1 + 0.05 * rng.standard_normal(update.x.size))
            motion = exact.batch(x, update.surface)
            if motion.reached[0] and motion.time[0] < 0.99 * objective.horizon:
                found.append((x, update.surface))
    return found[:count]


def main() -> int:
    """Ask many times and print how late and how good the answers are."""
    parser = command_line(__doc__, "--calls 2000 --budget-ms 1")
    parser.add_argument("--calls", type=int, help="how often to ask (10,000; --quick: 1000)")
    parser.add_argument("--budget-ms", type=float, default=2.0, help="budget, ms (2)")
    options = parser.parse_args()
    calls, now = options.calls or (1000 if options.quick else 10_000), clock(options.clock)
    seconds = 1e-3 * options.budget_ms
    rows, kept = [], True
    for objective in (ut.MinimumEnergy(), ut.MinimumTime()):
        loop = ut.ClosedLoop(RIG, objective, tail_rtol=TAIL_RTOL)
        exact = replace(loop, tail_rtol=0.0)
        optimiser = ut.Optimiser(loop)
        tasks = situations(objective, min(calls, 500))
        budget = ut.Budget(1_000_000, seconds)
        optimiser.propose(tasks[0][0], incumbent=tasks[0][1], budget=budget)  # compile
        late, gains, evaluations, worse = [], [], [], 0
        for k in progress(range(calls), f"{objective.name}: calls"):
            x, incumbent = tasks[k % len(tasks)]
            began = now()
            answer = optimiser.propose(x, incumbent=incumbent, sequence=k, budget=budget)
            late.append(now() - began - seconds)
            evaluations.append(answer.evaluations)
            plan = answer.plan
            if plan is None:
                worse += 1
                continue
            old, new = exact.batch(x, [ut.Plan((incumbent,)), plan]).score(objective.horizon)
            gains.append(1 - new / old)
            worse += bool(new > (1 + TAIL_RTOL) * old)
        ms = 1e3 * np.array(late)
        kept &= worse == 0 and float(np.quantile(ms, 0.99)) <= 0.5
        rows.append(
            [objective.name, *(f"{v:.3f}" for v in (*np.quantile(ms, (0.5, 0.99)), ms.max())),
             f"{np.median(evaluations):.0f}", f"{100 * np.median(gains):.1f} %",
             f"{100 * min(gains):.3f} %", str(worse)]
        )  # fmt: skip
    table(
        f"{calls} calls with a budget of {options.budget_ms:g} ms: how late, ms",
        ["", "p50", "p99", "worst", "evaluations", "gain, median", "least", "worse than before"],
        rows,
    )
    met = "yes" if kept else "no"
    print(f"\n99 % at most 0.5 ms late, and never worse than the incumbent (wanted: yes): {met}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
