"""Designs of a mechanism: what energy, time and robustness its parameters allow."""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np

from undertow.base import InfeasibleError, ModelError, require
from undertow.cascade import Cascade, Run
from undertow.closed_loop import ClosedLoop, Ensemble, Event, RolloutBuffers
from undertow.law import Plan
from undertow.models import FloatArray, Mechanism
from undertow.objective import objective_for
from undertow.studies.campaign.definition import Settings
from undertow.studies.campaign.study import Arrays, Study, Variable, axes_of, start_of


class Designs(Study):
    """Parameters of a mechanism on a grid: the cascade's energy and time, and how robust it is.

    Robust is the part of random plants, their parameters off by up to ``spread``, on which the
    surface of least energy that the design is given for its own model comes home when it is kept.

    Settings: ``axes``, parameters by name; ``start``, states by name, by default the mechanism's;
    ``horizon``, s; ``plants`` and ``spread`` of the random ones; ``seed``; ``shard``, designs in
    each.
    """

    kind: ClassVar[str] = "designs"

    def __init__(self, mechanism: Mechanism, settings: Settings) -> None:
        self.mechanism = mechanism
        self.axes = axes_of(settings, {p.name: p.unit for p in mechanism.parameters})
        names = ", ".join(p.name for p in mechanism.parameters)
        require(self.axes, settings.what("axes"), "none", f"among {names}")
        self.horizon = settings.number("horizon", 60.0, low=1e-3, high=1e4)
        self.plants = settings.count("plants", 64, high=10**5)
        self.spread = settings.number("spread", 0.2, low=0.0, high=0.9)
        self.seed = settings.count("seed", 0, low=0)
        self.start = start_of(mechanism, settings)
        self.most = settings.count("shard", 1, high=10**6)
        for corner in (0, -1):  # bounds of the parameters are refused before any work
            mechanism.with_parameters(**{a.name: float(a.values[corner]) for a in self.axes})
        unit = objective_for(mechanism, "energy").unit or "1"
        self.variables = {
            "energy": Variable(unit, "cost of the cascade for least energy"),
            "time": Variable("s", "when the cascade for least time comes home"),
            "robust": Variable("1", "part of random plants that the kept surface brings home"),
        }

    def compute(self, shard: int) -> Arrays:
        """Optimise the designs of a shard, one after the other."""
        shape, values = self.points(shard)
        rows = []
        for entry in zip(*values, strict=True):
            named = {axis.name: float(v) for axis, v in zip(self.axes, entry, strict=True)}
            rows.append(self._design(self.mechanism.with_parameters(**named)))
        return self.arrays(shape, np.array(rows).T)

    def _design(self, mechanism: Mechanism) -> tuple[float, float, float]:
        energy, time = (self._run(mechanism, goal) for goal in ("energy", "time"))
        costs = [math.nan if r is None or not r.reached else r.cost for r in (energy, time)]
        robust = 0.0 if energy is None else self._robust(mechanism, energy.updates[0].plan)
        return costs[0], costs[1], robust

    def _run(self, mechanism: Mechanism, goal: str) -> Run | None:
        objective = objective_for(mechanism, goal, horizon=self.horizon)
        try:
            cascade = Cascade(mechanism, objective, seed=self.seed, belief="exact")
            return cascade.simulate(self.start)
        except (InfeasibleError, ModelError):  # nothing brings this design home
            return None

    def _robust(self, mechanism: Mechanism, plan: Plan) -> float:
        objective = objective_for(mechanism, "energy", horizon=self.horizon)
        plants = Ensemble(mechanism, self._off(mechanism))
        loop = ClosedLoop(mechanism, objective, ensemble=plants)
        buffers = RolloutBuffers(loop, 1, len(plan.times))
        members = buffers.fill(self.start, plan.vectors, plan.gains(loop.reaching)).spread()
        batch = loop.roll_out(members, plan.times, self.horizon)
        return float(np.mean(batch.event == Event.REACHED))

    def _off(self, mechanism: Mechanism) -> FloatArray:
        """Return the parameters of random plants, (K, P): the same changes for every design."""
        rng = np.random.default_rng(self.seed)
        off = self.spread * rng.uniform(-1.0, 1.0, (self.plants, len(mechanism.parameters)))
        off[:, [p.is_gravity for p in mechanism.parameters]] = 0.0
        low, high = np.array([(p.low, p.high) for p in mechanism.parameters]).T
        values: FloatArray = np.clip(mechanism.parameter_values * (1.0 + off), low, high)
        return values
