"""What a free rate η/ε is worth: cascades for `effort` with exact states, over each plant's bound.

Every mechanism of the library from its usual start, with the rate of the given reaching law and
with one that is searched with the surface (``DecisionVariables(rate=...)``), over the bound of
optimal control; and on random plants within the tolerances that the cascade assumes, where it
learns: the cost with a free rate over that with the given one.

    python benchmarks/rates.py [--names NAME ...] [--plants 12]
"""

from __future__ import annotations

import math
import sys

import numpy as np

import undertow as ut
from harness import clock, command_line, progress, table


def cost(cascade: ut.Cascade, plant: ut.Mechanism | None = None) -> float:
    """Cost of the run from the usual start; infinite where it does not arrive."""
    try:
        run = cascade.simulate(plant=plant)
    except ut.InfeasibleError:
        return math.inf
    return run.cost if run.reached else math.inf


def main() -> int:
    """Run both cascades on the listed plant, then on random ones; print the table."""
    parser = command_line(__doc__, "--names overhead_crane acrobot --plants 4 --clock cpu")
    parser.add_argument("--names", nargs="+", default=list(ut.mechanisms.LIBRARY))
    parser.add_argument("--plants", type=int, default=12, help="random plants of each (12)")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    names, plants = options.names, options.plants
    if options.quick:
        names, plants = names[:1], 1
    now, rows = clock(options.clock), []
    for name in progress(names, "mechanisms"):
        mechanism = getattr(ut.mechanisms, name)()
        least = ut.bound(mechanism, ut.objective_for(mechanism)).cost
        tolerances = ut.Belief.usual(mechanism).tolerances
        drawn = []
        for k in range(plants):
            rng = np.random.default_rng([options.seed, k])
            moved = {p: t * rng.uniform(-1.0, 1.0) for p, t in tolerances.items()}
            values = {p.name: p.value + moved.get(p.name, 0.0) for p in mechanism.parameters}
            drawn.append(mechanism.with_parameters(**values))
        found, seconds = [], []
        for rate in (False, True):
            cascade = ut.Cascade(mechanism, freedom=ut.DecisionVariables(rate=rate))
            cost(cascade)  # compile, warm up
            began = now()
            found.append([cost(cascade)])
            seconds.append(now() - began)
            found[-1] += [cost(cascade, plant) for plant in drawn]
        given, free = np.array(found)
        both = np.isfinite(given[1:]) & np.isfinite(free[1:])
        ratios = free[1:][both] / given[1:][both]
        rows.append([
            name, f"{given[0] / least:.3f}", f"{free[0] / least:.3f}",
            *(f"{lost.sum():.0f}" for lost in (np.isinf(given[1:]), np.isinf(free[1:]))),
            *(f"{part(ratios):.3f}" if len(ratios) else "—" for part in (np.median, np.max)),
            f"{seconds[1] / seconds[0]:.2f}",
        ])  # fmt: skip
    table(
        f"cost over the bound; {plants} random plants: lost, and the cost with a free rate over "
        "that with the given one; time of a run, the same",
        ["", "given", "free", "lost, given", "free", "median", "worst", "time"], rows,
    )  # fmt: skip
    return 0


if __name__ == "__main__":
    sys.exit(main())
