"""Pushes during motions of least time: how long each re-optimisation takes, and what is lost.

A cascade with schedules of surfaces, its model exact, moves from the mechanism's usual start.  At a
decision the rate of each joint jumps, up or down, by a part of the largest one of the planned
motion.  Every decision from then on is timed, and the arrival after the push is compared with the
bound from the pushed state (collocation, with the run and without as guesses: a local optimum).
Decisions without a push are in the table too, as 0 %.
"""

from __future__ import annotations

from harness import Clock, clock, command_line, need, percentiles, progress, table  # isort: skip

import math
import sys
from dataclasses import dataclass, field

import numpy as np

import undertow as ut
from undertow.base import InfeasibleError
from undertow.models import FloatArray

FREE = ut.DecisionVariables(reaching=True, schedule=0.1)
NAMES = (
    "rotary_pendulum", "cart_pendulum", "overhead_crane", "pendubot", "acrobot", "ball_and_beam",
    "double_pendulum_on_a_cart",
)  # fmt: skip

#: When it is pushed, in parts of the planned motion.
WHEN = (0.3, 0.6)


@dataclass
class Pushed:
    """What came of the pushes of one size: seconds of decisions, arrivals, and bounds, s."""

    seconds: list[float] = field(default_factory=list)
    ratios: list[float] = field(default_factory=list)
    lost: int = 0
    hopeless: int = 0


def onward(
    cascade: ut.Cascade, state: ut.cascade.CascadeState, x: FloatArray, t: float, now: Clock,
    seconds: list[float],
) -> float:  # fmt: skip
    """Decide and move on until the target is reached; return when, s, or infinity."""
    period, end = cascade.period, t + 5.0
    while t < end:
        began = now()
        proposal = cascade.propose(state, x, t)
        state, _ = cascade.apply_gate(state, proposal, x)
        seconds.append(now() - began)
        piece = cascade.loop.simulate(x, state.at(t), duration=period)
        if piece.event.name == "REACHED":
            return t + piece.time
        if piece.event.name != "HORIZON":
            return math.inf
        x, t = piece.x[-1], round(t + period, 9)
    return math.inf


def bound_from(rig: ut.Mechanism, x: FloatArray) -> float:
    """Return the least time of any input from a state, s; infinite where none was found."""
    from undertow.bounds import bound

    try:
        return bound(rig, ut.MinimumTime(), x, intervals=60).cost
    except InfeasibleError:
        return math.inf


def main() -> int:
    """Push each mechanism, print both tables."""
    parser = command_line(__doc__, "--names rotary_pendulum --sizes 0 2 5 --clock cpu")
    parser.add_argument("--names", nargs="+", default=list(NAMES), help="mechanisms")
    parser.add_argument("--sizes", nargs="+", type=float, default=[0.0, 1.0, 3.0, 10.0],
                        help="pushes, % of the largest rate of each joint (0 1 3 10)")  # fmt: skip
    options = parser.parse_args()
    need("casadi", "bounds")
    names = options.names[:1] if options.quick else options.names
    now, rng = clock(options.clock), np.random.default_rng(0)
    every: list[float] = []
    rows, firsts = [], []
    for name in progress(names, "mechanisms"):
        rig = getattr(ut.mechanisms, name)()
        n, x0 = rig.n, rig.usual_start
        cascade = ut.Cascade(rig, ut.MinimumTime(), belief="exact", freedom=FREE)
        cascade.optimiser.propose(x0, budget=ut.Budget(600))  # compile, warm up
        began, soon = now(), math.nan
        least = bound_from(rig, x0)
        began = now()
        for answer in cascade.optimiser.improve(x0):
            if math.isnan(soon) and answer.cost <= 1.05 * least:
                soon = now() - began
        whole = now() - began
        firsts.append(
            [name, f"{least:.4f}", f"{answer.cost:.4f}", f"{100 * (answer.cost / least - 1):.1f} %",
             "—" if math.isnan(soon) else f"{soon:.2f}", f"{whole:.2f}"]
        )  # fmt: skip
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
                arrival = onward(cascade, start, x, t, now, made.seconds) - t
                floor = bound_from(rig, x)
                if math.isfinite(arrival):
                    made.ratios.append(arrival / floor if math.isfinite(floor) else math.nan)
                else:
                    made.lost += 1
            every += made.seconds
            ratios = " ".join("—" if math.isnan(r) else f"{r:.3f}" for r in made.ratios)
            rows.append([name, f"{size:g} %", *percentiles(made.seconds), ratios or "—",
                         str(made.lost or "")])  # fmt: skip
    table("first plans: seconds to one within 5 % of the bound, and of the whole search",
          ["", "bound, s", "plan, s", "gap", "within 5 %", "whole"], firsts)  # fmt: skip
    table("decisions after a push, ms, and the arrival over the bound",
          ["", "push", "median", "p99", "worst", "arrival / bound", "lost"], rows)  # fmt: skip
    middle, high = np.quantile(1e3 * np.array(every), [0.5, 0.99])
    print(f"\n{len(every)} decisions: median {middle:.1f} ms, p99 {high:.1f} ms "
          "(wanted: 50 ms, 100 ms)")  # fmt: skip
    return 0


if __name__ == "__main__":
    sys.exit(main())
