"""Region maps: which states of a slice come home, how long it takes, and at what cost."""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np

from undertow.base import InvalidInputError, require
from undertow.closed_loop import ClosedLoop, Event
from undertow.law import Surface, first_surface, matrix_at_target
from undertow.models import FloatArray, Mechanism, fastest_rate
from undertow.studies.campaign.definition import Settings, objective_of
from undertow.studies.campaign.study import Arrays, Study, Variable, axes_of

#: Relative tolerance of the large steps near the target.
TAIL = 1e-4

#: Rollouts that are computed together, whatever the shard: they fill some 100 MB.
TOGETHER = 8192

#: Words for why a motion ended.
EVENTS = tuple(event.name.lower() for event in Event)


class RegionMap(Study):
    """The states of a slice under one surface, input limits in, on the block kernel.

    Settings: ``axes``, states by name; ``at``, the states that stay as they are, 0 by default;
    ``sliding``, whether the velocities of the driven coordinates are those on the surface, s = 0;
    ``surface``, its (2mn,) numbers, by default the designed one; ``objective``, ``horizon``, s;
    ``step`` of the integration, s; ``shard``, rollouts in each.
    """

    kind: ClassVar[str] = "region"
    threaded: ClassVar[bool] = True

    def __init__(self, mechanism: Mechanism, settings: Settings) -> None:
        self.mechanism = mechanism
        n, m = mechanism.n, mechanism.m
        objective = objective_of(mechanism, settings, 20.0)
        given = settings.numbers("surface", 2 * m * n)
        self.surface = (
            first_surface(mechanism)
            if given is None
            else Surface.from_vector(np.array(given), n, m)
        )
        step = settings.number("step", 0.002, low=1e-6, high=1.0)
        self.loop = ClosedLoop(mechanism, objective, step=step, tail_rtol=TAIL)
        fastest = self._fastest()
        if not step * fastest <= 1.0:
            raise InvalidInputError(
                settings.what("step"),
                value=f"{step:g} s",
                limit=f"at most {1.0 / fastest:.2g} s, the time constant of the fastest mode",
                remedy="Longer steps are unstable, and states that come home would seem not to",
            )
        self.sliding = settings.flag("sliding")
        names = mechanism.state_names
        driven = names[n : n + m] if self.sliding else ()
        units = zip(names, mechanism.state_units, strict=True)
        free = {name: unit for name, unit in units if name not in driven}
        self.axes = axes_of(settings, free)
        fixed = settings.table("at").by_name([k for k in free if k not in self._names])
        require(self.axes, settings.what("axes"), "none", f"states among {', '.join(free)}")
        self.at = mechanism.state(**fixed)
        self.places = [names.index(axis.name) for axis in self.axes]
        self.most = settings.count("shard", 16384, high=1 << 20)
        self.seed = 0
        self.variables = {
            "event": Variable("1", "why the motion ended", "int8", EVENTS),
            "time": Variable("s", "when the motion came home", "float32"),
            "cost": Variable(objective.unit or "1", "what it cost to come home", "float32"),
        }

    def _fastest(self) -> float:
        """Return the largest |λ| of the linear models, 1/s: the inputs held, and under the law.

        0 where there is no linear model.
        """
        rate = fastest_rate(self.mechanism)
        if not rate > 0:
            return rate
        under = matrix_at_target(self.mechanism, self.surface, self.loop.reaching)
        return max(rate, float(np.abs(np.linalg.eigvals(under)).max()))

    @property
    def _names(self) -> list[str]:
        return [axis.name for axis in self.axes]

    def states(self, shard: int) -> tuple[tuple[int, ...], FloatArray]:
        """Return the size of a shard and its initial states, (N, 2n)."""
        shape, values = self.points(shard)
        states = np.tile(self.at, (math.prod(shape), 1))
        for place, column in zip(self.places, values, strict=True):
            states[:, place] = column
        if self.sliding:
            n, m, surface = self.mechanism.n, self.mechanism.m, self.surface
            q_a, q_u, v_u = states[:, :m], states[:, m:n], states[:, n + m :]
            rest = q_a @ surface.lambda_a.T + v_u @ surface.alpha_u.T + q_u @ surface.lambda_u.T
            states[:, n : n + m] = -np.linalg.solve(surface.alpha_a, rest.T).T
        return shape, states

    def compute(self, shard: int) -> Arrays:
        """Roll out the states of a shard."""
        shape, states = self.states(shard)
        rows = []
        for first in range(0, len(states), TOGETHER):
            batch = self.loop.batch(states[first : first + TOGETHER], self.surface)
            home = batch.event == Event.REACHED
            came = [np.where(home, v, np.nan) for v in (batch.time, batch.cost)]
            rows.append([batch.event.astype(float), *came])
        return self.arrays(shape, np.concatenate(rows, axis=1))
