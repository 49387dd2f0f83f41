"""What the admission gate with verdicts costs: evidence and cost check for each proposal of a run.

The cascade runs on the rotary pendulum (d_e = 0.025) from 40°, minimum energy and minimum time;
every question that its gate was asked is asked again, in turn, of

- the cost gate alone (stable, feasible, not dearer), integrated to the target and with the exact
  linear end that the optimiser uses;
- the evidence alone: a terminal set around the present state, or dual mode, proofs included;
- the certified gate: both, with the linear end.

Nothing is cached but what depends on the surface alone (its modes); that part is shown apart, as
the first look at a surface.  Wanted: the certified gate, ≤ 1 ms at the median.
"""

from __future__ import annotations

from harness import Clock, clock, command_line, percentiles, table  # isort: skip

import sys
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

import undertow as ut
from undertow.cascade import cost_gate
from undertow.cascade.planners import TAIL_RTOL
from undertow.proofs.gate import GatePolicy, assess, certified_gate
from undertow.proofs.search.terminal_ellipsoid import search_for

RIG = ut.mechanisms.rotary_pendulum(d_e=0.025)


def questions(objective: ut.Objective, budget: ut.Budget) -> list[Any]:
    """Return what the gate of one run was asked: loop, old plan, new plan, state, horizon."""
    asked: list[Any] = []
    gate = certified_gate(tail=TAIL_RTOL)

    def listening(*question: Any) -> Any:
        asked.append(question)
        return gate(*question)

    cascade = ut.Cascade(
        RIG, objective, gate=listening, cold=ut.Budget(1024), warm=budget, belief="exact"
    )
    cascade.simulate(phi=ut.deg(40), duration=8.0)
    return [q for q in asked if q[1] != q[2]]


def timed(
    now: Clock, asked: list[Any], rounds: int, answers: dict[str, Callable[..., Any]]
) -> dict[str, list[float]]:
    """Time each answer to each question in turn; the quickest of the rounds, s."""
    found: dict[str, list[float]] = {name: [] for name in answers}
    for question in asked:
        best = dict.fromkeys(answers, float("inf"))
        for _ in range(rounds):
            for name, answer in answers.items():
                began = now()
                answer(*question)
                best[name] = min(best[name], now() - began)
        for name, value in best.items():
            found[name].append(value)
    return found


def main() -> int:
    """Print the table; 1 where more is spent than is wanted."""
    options = command_line(__doc__).parse_args()
    now = clock(options.clock)
    sizes, rounds = ((32, 64, 128, 256), 1) if options.quick else ((256,), 5)
    ended = certified_gate(tail=TAIL_RTOL)
    met, judged = True, True
    for objective in (ut.MinimumEnergy(), ut.MinimumTime()):
        # The smallest search that proposes anything: a quick run must judge something too.
        asked: list[Any] = []
        for size in sizes:
            asked = asked or questions(objective, ut.Budget(size))
        if not asked:
            print(f"minimum {objective.name}: no proposal to judge with {sizes[-1]} rollouts")
            met = judged = False
            continue
        quick = replace(asked[0][0], tail_rtol=TAIL_RTOL)

        def modes(loop: Any, old: Any, new: Any, x: Any, horizon: float) -> None:
            search_for.__wrapped__(RIG, new.surfaces[-1], loop.reaching)

        answers: dict[str, Callable[..., Any]] = {
            "cost gate, integrated": cost_gate,
            "cost gate, linear end": lambda loop, *rest, q=quick: cost_gate(q, *rest),
            "first look at a surface": modes,
            "evidence": lambda loop, old, new, x, h: assess(loop, new, x, h, GatePolicy()),
            "certified gate": ended,
        }
        found = timed(now, asked, rounds, answers)
        admitted = sum(ended(*q).accepted for q in asked)
        title = f"minimum {objective.name}: {len(asked)} proposals, {admitted} admitted"
        rows = [[name, *percentiles(values)] for name, values in found.items()]
        table(title, ["ms", "median", "99 %", "worst"], rows)
        middle = 1e3 * float(np.median(found["certified gate"]))
        met = met and middle <= 1.0
        verdict = "yes" if middle <= 1.0 else "no"
        name = objective.name
        print(f"\nminimum {name}: {middle:.2f} ms at the median (wanted: 1 ms): {verdict}")
    return 0 if met or (options.quick and judged) else 1


if __name__ == "__main__":
    sys.exit(main())
