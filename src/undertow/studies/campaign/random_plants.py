"""Controllers side by side on random plants that none of them knows."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from rich.console import RenderableType

from undertow.base import number, table
from undertow.cascade import Cascade
from undertow.models import Mechanism
from undertow.objective import USUAL
from undertow.plants import Bench
from undertow.plants.bench import bench_for
from undertow.studies.campaign.definition import Settings, objective_of
from undertow.studies.campaign.study import Arrays, Axis, Study, Variable, start_of, tolerances
from undertow.studies.trials.steering import cascade_and_kept, clipped_regulator
from undertow.studies.trials.trial import MakeController, trial

#: Contenders by the word for each.
CONTROLLERS = ("cascade", "kept", "lqr")


class RandomPlants(Study):
    """Trials on random benches: estimator, encoders, friction and delay are in.

    The contenders are the cascade, its first optimum kept, and a clipped linear-quadratic
    regulator.  All believe the mechanism as it is and have the same kind of estimator, and the
    first two are fit for the usual bench, see :func:`undertow.runtime.for_rig`.  A plant
    differs in its parameters, friction and delay, drawn from (``seed``, its number).

    Settings: ``plants``, how many; ``controllers``, a list of ``cascade``, ``kept``, ``lqr``;
    ``spread``, half-width of the parameters, as a part of each; ``friction``, the most that it is
    of the bench's; ``delay``, the longest in all, s; ``objective``, ``horizon``, s; ``start``,
    states by name, by default the mechanism's; ``seconds`` of a trial; ``seed``; ``shard``,
    plants in each.
    """

    kind: ClassVar[str] = "plants"

    def __init__(self, mechanism: Mechanism, settings: Settings) -> None:
        self.mechanism = mechanism
        self.objective = objective_of(mechanism, settings, 60.0, USUAL)
        self.controllers = settings.words("controllers", CONTROLLERS)
        self.spread = settings.number("spread", 0.2, low=0.0, high=0.9)
        self.friction = settings.number("friction", 2.0, low=0.0, high=100.0)
        self.delay = settings.number("delay", 0.005, low=0.0, high=1.0)
        self.length = settings.number("seconds", 10.0, low=0.01, high=1e4)
        self.seed = settings.count("seed", 0, low=0)
        self.start = start_of(mechanism, settings)
        self.most = settings.count("shard", 4, high=10**6)
        plants = np.arange(settings.count("plants", 200))
        self.axes = (Axis("plant", plants, "1"),)
        self.bench = bench_for(mechanism)
        self.variables = {}
        for name in self.controllers:
            self.variables |= {
                f"{name}_balanced": Variable("1", f"{name}: home for the last second", "int8"),
                f"{name}_settled": Variable("s", f"{name}: time after which it stayed home"),
                f"{name}_cost": Variable(self.objective.unit or "1", f"{name}: cost of the motion"),
                f"{name}_chatter": Variable("1/s", f"{name}: variation of the inputs"),
            }

    def plant(self, number: int) -> Bench:
        """Return the bench of a number, but for what its own seed draws."""
        rng = np.random.default_rng([self.seed, number])
        bench = self.bench.with_friction(rng.uniform(0.0, self.friction))
        varied = (p for p in self.mechanism.parameters if p.name in bench.tolerance)
        return replace(
            bench.with_delay(rng.uniform(0.0, self.delay)),
            tolerance=tolerances(varied, self.spread),
        )

    @cached_property
    def _optimised(self) -> tuple[MakeController, MakeController]:
        cascade = Cascade(self.mechanism, self.objective, seed=self.seed)
        return cascade_and_kept(cascade, self.bench, self.start)

    def controller(self, name: str) -> MakeController:
        """Return what makes a contender for one trial."""
        if name == "lqr":
            return clipped_regulator(self.mechanism)
        cascade, kept = self._optimised
        return cascade if name == "cascade" else kept

    def compute(self, shard: int) -> Arrays:
        """Try every contender on the plants of a shard."""
        (part,) = self.part(shard)
        numbers = range(part.start, part.stop)
        found = self.unknown((len(numbers),))
        for name in self.controllers:
            make = self.controller(name)
            for row, own in enumerate(numbers):
                bench = self.plant(own)
                outcome = trial(
                    self.mechanism, bench, make, self.start, self.length, own,
                    objective=self.objective, told=self.bench,
                )  # fmt: skip
                for what in ("balanced", "settled", "cost", "chatter"):
                    found[f"{name}_{what}"][row] = getattr(outcome, what)
        return found

    def report(self, data: Any) -> list[RenderableType]:
        """Return the contenders side by side: numbers but the first are of balanced runs alone."""
        unit, rows = self.objective.unit or "1", []
        for name in self.controllers:
            balanced = np.asarray(data[f"{name}_balanced"])
            home = balanced == 1
            numbers = [
                np.asarray(data[f"{name}_{what}"])[home] for what in ("settled", "cost", "chatter")
            ]
            cells = [float(np.median(v)) if len(v) else np.nan for v in numbers]
            worst = float(numbers[1].max()) if home.any() else np.nan
            cells.insert(2, worst)
            tried = int((balanced >= 0).sum())
            shown = [number(v, ".4g") for v in cells]
            rows.append([name, f"{int(home.sum())} of {tried}", *shown])
        heads = ["", "balanced", "settled, s", f"cost, {unit}", "worst", "chatter, 1/s"]
        title = f"{data.attrs['title']}: medians over balanced runs"
        return [table(heads, rows, title=title, whole=heads)]
