"""Whether the trust region earns its place: warm re-optimisations with it, and by CMA-ES alone.

Each mechanism of the library with at most nine search coordinates is brought from its usual
start to its target by the cascade of least energy, once as it is and once with the trust region
left out, so that CMA-ES makes each re-optimisation, from the same seeds.  *Cost* is that of the
closed loop, the median of the seeds, with the trust region relative to without it; *evaluations*
and *ms* are medians of the re-optimisations of all seeds.
"""

from __future__ import annotations

from harness import command_line, progress, table  # isort: skip

import sys
from unittest import mock

import numpy as np

import undertow as ut
from undertow.mechanisms import LIBRARY
from undertow.optimiser import search

#: The quick ones.
FEW = ("rotary_pendulum", "cart_pendulum")


def cascade_with(mechanism: ut.Mechanism, model: bool, seed: int) -> tuple[float, list[ut.Update]]:
    """Return the cost of one cascade and its re-optimisations."""
    size = search.MODEL_SIZE if model else -1
    with mock.patch.object(search, "MODEL_SIZE", size):
        run = ut.Cascade(
            mechanism, ut.objective_for(mechanism, "energy"), seed=seed, belief="exact"
        ).simulate(mechanism.usual_start)
    return (run.cost if run.reached else np.inf), list(run.updates[1:])


def main() -> int:
    """Run both over the library and print the comparison."""
    parser = command_line(__doc__, "--seeds 5")
    parser.add_argument("--seeds", type=int, help="how many (3; --quick: 1)")
    parser.add_argument("--only", metavar="A,B", help="mechanisms; all by default")
    options = parser.parse_args()
    names = options.only.split(",") if options.only else FEW if options.quick else list(LIBRARY)
    seeds = options.seeds or (1 if options.quick else 3)
    rows = []
    for name in progress(list(names), "mechanisms"):
        mechanism = LIBRARY[name]()
        size = ut.Cascade(
            mechanism, ut.objective_for(mechanism, "energy"), belief="exact"
        ).optimiser.space.size
        if size > search.MODEL_SIZE:
            continue
        cost: dict[bool, list[float]] = {True: [], False: []}
        spent: dict[bool, list[tuple[int, float]]] = {True: [], False: []}
        for seed in range(seeds):
            for model in (True, False):
                total, updates = cascade_with(mechanism, model, seed)
                cost[model].append(total)
                spent[model] += [(u.proposal.evaluations, u.proposal.seconds) for u in updates]
        with_it, without = (np.median(np.array(spent[model]), axis=0) for model in (True, False))
        ratio = np.median(cost[True]) / np.median(cost[False])
        rows.append(
            [name, str(size), f"{ratio:.3f}", f"{with_it[0]:.0f}", f"{without[0]:.0f}",
             f"{1e3 * with_it[1]:.2f}", f"{1e3 * without[1]:.2f}",
             f"{without[1] / with_it[1]:.2f}"]
        )  # fmt: skip
    table(
        f"Re-optimisations with the trust region and by CMA-ES alone, {seeds} seeds",
        ["", "coordinates", "cost, ratio", "evaluations, with", "without", "ms, with", "without",
         "ms, ratio"],
        rows,
    )  # fmt: skip
    worst = max(float(row[2]) for row in rows)
    fastest = sorted(float(row[7]) for row in rows)
    print(
        "\nWithout the trust region a re-optimisation takes "
        f"{fastest[len(fastest) // 2]:.2f} times as long in the median of {len(rows)} mechanisms; "
        f"with it the dearest motion costs {worst:.3f} times as much"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
