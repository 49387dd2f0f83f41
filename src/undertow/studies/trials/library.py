"""Every mechanism of the library through the runtime, on realistic rigs, in simulated time."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np

from undertow.runtime import Reason, Recipe, session


@dataclass(frozen=True)
class LibraryRow:
    """Runs of one mechanism.

    ``layer``: boundary layer ε that its rig's sensors need. ``held``: runs in which the law held it
    to the end; ``ends``: why the others were stopped, and how often. ``applied``: answers of the
    optimiser that were put to use, per run that was held. ``chatter``: total variation per second
    of the input that varies most, in parts of its limit.
    """

    name: str
    inputs: int
    layer: float
    held: int
    runs: int
    ends: dict[str, int]
    applied: float
    chatter: float


#: Length of a run, s, and rollouts that a re-optimisation may spend.
SECONDS, BUDGET = 10.0, 256


def through_the_runtime(name: str, *, seeds: int) -> LibraryRow:
    """Run a mechanism from its usual start on so many of its realistic rigs."""
    ends: Counter[str] = Counter()
    applied, chatter = [], []
    for seed in range(seeds):
        recipe = Recipe(mechanism=name, rig="realistic", seed=seed, evaluations=BUDGET)
        with session(recipe, simulated=True) as runtime:
            report = runtime.run(SECONDS).unless_interrupted()
        if report.stopped_by != Reason.END.text:
            ends[report.stopped_by] += 1
            continue
        applied.append(report.answers.get("applied", 0))
        limits = recipe.settings.limits(recipe.belief)
        chatter.append(float((report.total_variation / limits).max() / SECONDS))
    return LibraryRow(
        name,
        recipe.belief.m,
        float(np.max(recipe.cascade.reaching.layer)),
        seeds - ends.total(),
        seeds,
        dict(ends),
        float(np.mean(applied)) if applied else 0.0,
        float(np.mean(chatter)) if chatter else float("nan"),
    )
