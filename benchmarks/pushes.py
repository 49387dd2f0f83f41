"""Pushes during motions of least time: how long each re-optimisation takes, and what is lost.

A cascade with schedules of surfaces, its model exact, moves from the mechanism's usual start.  At a
decision the rate of each joint jumps, up or down, by a part of the largest one of the planned
motion.  Every decision from then on is timed, and the arrival after the push is compared with the
earliest arrival of any input near the run (``undertow.optimiser.open_loop``, a local optimum; a
test compares it with collocation).  Decisions without a push are in the table too, as 0 %.
"""

from __future__ import annotations

from harness import Clock, clock, command_line, percentiles, progress, table  # isort: skip

import math
import sys
from dataclasses import dataclass, field

import numpy as np

import undertow as ut
from undertow.cascade import CascadeState
from undertow.models import FloatArray
from undertow.optimiser.open_loop import EarliestArrival, OpenLoopMotion

FREE = ut.DecisionVariables(reaching=True, schedule=0.1)
NAMES = (
    "rotary_pendulum", "cart_pendulum", "overhead_crane", "pendubot", "acrobot", "ball_and_beam",
    "double_pendulum_on_a_cart",
)  # fmt: skip

#: Longest motion after a push, s.
LONGEST = 5.0

#: When it is pushed, in parts of the planned motion.
WHEN = (0.3, 0.6)


@dataclass
class Pushed:
    """What came of the pushes of one size: seconds of decisions, and arrivals over the earliest."""

    seconds: list[float] = field(default_factory=list)
    ratios: list[float] = field(default_factory=list)
    lost: int = 0


def onward(
    cascade: ut.Cascade, state: CascadeState, x: FloatArray, t: float, now: Clock,
    seconds: list[float],
) -> ut.Trajectory:  # fmt: skip
    """Decide and move on until the target is reached, or lost; return the motion."""
    period, pushed, pieces = cascade.period, t, list[ut.Trajectory]()
    while t < pushed + LONGEST:
        began = now()
        proposal = cascade.propose(state, x, t)
        state, _ = cascade.apply_gate(state, proposal, x)
        seconds.append(now() - began)
        since = round(t - pushed, 9)
        pieces.append(cascade.loop.simulate(x, state.at(t), duration=period, start=since))
        if pieces[-1].event.name != "HORIZON":
            break
        x, t = pieces[-1].x[-1], round(t + period, 9)
    return ut.Trajectory.join(pieces)


def earliest(cascade: ut.Cascade, guess: ut.Trajectory) -> float:
    """Return the least time of any input near a motion, from where that begins, s."""
    rig, radius = cascade.mechanism, cascade.objective.terminal_radius
    task = EarliestArrival(rig, radius, *cascade.loop.objective.range_of(rig))
    found = task.improve(OpenLoopMotion.of(guess, guess.time))
    return math.nan if found is None else found.time


def main() -> int:
    """Push each mechanism, print both tables."""
    parser = command_line(__doc__, "--names rotary_pendulum --sizes 0 2 5 --clock cpu")
    parser.add_argument("--names", nargs="+", default=list(NAMES), help="mechanisms")
    parser.add_argument("--sizes", nargs="+", type=float, default=[0.0, 1.0, 3.0, 10.0],
                        help="pushes, %% of the largest rate of each joint (0 1 3 10)")  # fmt: skip
    options = parser.parse_args()
    names = options.names[:1] if options.quick else options.names
    now, rng = clock(options.clock), np.random.default_rng(0)
    every: list[float] = []
    rows, firsts = [], []
    for name in progress(names, "mechanisms"):
        rig = getattr(ut.mechanisms, name)()
        n, x0 = rig.n, rig.usual_start
        cascade = ut.Cascade(rig, ut.MinimumTime(), belief="exact", freedom=FREE)
        cascade.optimiser.propose(x0, budget=ut.Budget(600))  # compile, warm up
        began, answers = now(), list[tuple[float, ut.Proposal]]()
        for answer in cascade.optimiser.improve(x0):
            answers.append((now() - began, answer))
        whole, last = now() - began, answers[-1][1]
        assert last.plan is not None  # each usual start has one
        least = earliest(cascade, cascade.loop.simulate(x0, last.plan))
        soon = next((f"{t:.2f}" for t, some in answers if some.cost <= 1.05 * least), "—")
        firsts.append([name, f"{least:.4f}", f"{last.cost:.4f}", soon, f"{whole:.2f}"])
        start, _ = cascade.start(x0)
        planned = cascade.loop.simulate(x0, start.plan)
        most = np.abs(planned.x[:, n:]).max(axis=0)
        for size in options.sizes:
            made = Pushed()
            for part in WHEN:
                t = cascade.period * math.floor(part * planned.time / cascade.period)
                x = cascade.loop.simulate(x0, start.plan, duration=max(t, 0.002)).x[-1] if t else x0
                x = x.copy()
                x[n:] += size / 100 * rng.choice([-1, 1], n) * most
                run = onward(cascade, start, x, t, now, made.seconds)
                if run.event.name == "REACHED":
                    made.ratios.append(run.time / earliest(cascade, run))
                else:
                    made.lost += 1
            every += made.seconds
            ratios = " ".join("—" if math.isnan(r) else f"{r:.3f}" for r in made.ratios)
            rows.append([name, f"{size:g} %", *percentiles(made.seconds), ratios or "—",
                         str(made.lost or "")])  # fmt: skip
    table("first plans: seconds to one within 5 % of the earliest arrival, and of the whole search",
          ["", "earliest, s", "plan, s", "within 5 %", "whole"], firsts)  # fmt: skip
    table("decisions after a push, ms, and the arrival over the earliest",
          ["", "push", "median", "p99", "worst", "arrival / earliest", "lost"], rows)  # fmt: skip
    middle, high = np.quantile(1e3 * np.array(every), [0.5, 0.99])
    print(f"\n{len(every)} decisions: median {middle:.1f} ms, p99 {high:.1f} ms "
          "(wanted: 50 ms, 100 ms)")  # fmt: skip
    return 0


if __name__ == "__main__":
    sys.exit(main())
