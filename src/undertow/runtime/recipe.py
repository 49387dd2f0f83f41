"""A run as data: what it takes to build its controller again, from the command line or a log."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import cached_property
from typing import Any, Literal, Self

import numpy as np

from undertow import mechanisms
from undertow.cascade import Cascade, CascadeState
from undertow.delay import delay_gate
from undertow.errors import InvalidInputError
from undertow.estimators import KalmanFilter
from undertow.mechanism import FloatArray, Mechanism
from undertow.objective import MinimumEnergy, MinimumTime, Objective, state_box
from undertow.optimiser import Budget
from undertow.rig import Bench, IdealRig, RealisticRig, plausible_rig, srv02_rig
from undertow.runtime.controller import Controller
from undertow.runtime.settings import Settings

__all__ = ["Recipe"]


#: Weight of the state in minimum energy; radius of the ball in which a motion ends.
STATE_WEIGHT, TERMINAL = 0.05, 0.05

#: Periods of delay that an admitted surface must bear.
BEARS = 6


@dataclass(frozen=True)
class Recipe:
    """How to build cascade, estimator, controller and simulated rig of a run.

    Parameters
    ----------
    mechanism
        Name in the library.
    parameters
        Values that differ from the library's, SI units.
    start
        Initial state, (2n,); the mechanism's usual one by default.
    objective
        ``"energy"`` or ``"time"``.
    horizon
        Longest prediction, s.
    rig
        ``"ideal"``, or ``"realistic"``: friction, encoders, delay, jitter, spread.
    seed
        Of the rig and of the optimiser.
    evaluations, seconds
        Budget of a re-optimisation; without ``seconds`` it depends on the seed alone.
    period
        Of the fast loop, s.
    settings
        Limits and patience.

    Raises
    ------
    InvalidInputError
        For a name that the library does not have, or a value that cannot be used.
    """

    mechanism: str = "rotary_pendulum"
    parameters: Mapping[str, float] = field(default_factory=dict)
    start: tuple[float, ...] = ()
    objective: Literal["energy", "time"] = "energy"
    horizon: float = 20.0
    rig: Literal["ideal", "realistic"] = "ideal"
    seed: int = 0
    evaluations: int = 1024
    seconds: float = math.inf
    period: float = 0.001
    settings: Settings = field(default_factory=Settings)

    @cached_property
    def belief(self) -> Mechanism:
        """The controller's model."""
        if self.mechanism not in mechanisms.LIBRARY:
            raise InvalidInputError(
                "mechanism of a run",
                value=repr(self.mechanism),
                limit=f"one of {', '.join(mechanisms.LIBRARY)}",
                remedy="A mechanism of your own is run from Python: undertow.runtime.Runtime",
            )
        return mechanisms.LIBRARY[self.mechanism]().with_parameters(**self.parameters)

    @cached_property
    def x0(self) -> FloatArray:
        """Initial state, (2n,)."""
        if self.start:
            return self.belief.check_state(self.start)
        return self.belief.state(**self.belief.start)

    @cached_property
    def cascade(self) -> Cascade:
        """Law, optimiser and gate."""
        ends = {
            c.name: 0.95 * min(-c.low, c.high)
            for c in self.belief.coordinates
            if math.isfinite(min(-c.low, c.high))
        }
        goal: Objective = MinimumEnergy(
            horizon=self.horizon,
            state_weight=STATE_WEIGHT,
            terminal_radius=TERMINAL,
            constraints=state_box(**ends),
        )
        if self.objective == "time":
            goal = MinimumTime(
                horizon=self.horizon, terminal_radius=TERMINAL, constraints=state_box(**ends)
            )
        warm = Budget(self.evaluations, self.seconds)
        gate = delay_gate(BEARS * self.period, self.period)
        return Cascade(self.belief, goal, warm=warm, gate=gate, seed=self.seed)

    @cached_property
    def bench(self) -> Bench:
        """What the realistic rig is like."""
        if self.mechanism == "rotary_pendulum" and not self.parameters:
            return srv02_rig()
        return plausible_rig(self.belief)

    def make_rig(self) -> RealisticRig:
        """Return the simulated rig, at the start."""
        if self.rig == "ideal":
            return IdealRig(self.belief, self.x0, self.period)
        return RealisticRig(self.bench.with_timing(period=self.period), self.x0, self.seed)

    def make_estimator(self) -> KalmanFilter:
        """Return the estimator that suits the rig's sensors and delays."""
        if self.rig == "ideal":
            return KalmanFilter(self.belief, self.period, position_noise=1e-6)
        bench, names = self.bench, [c.name for c in self.belief.coordinates]
        counts = [bench.encoders[name].resolution for name in names]
        delay = bench.timing.input_delay + bench.timing.measurement_delay
        limit = float(np.min(self.belief.input_limits))
        return KalmanFilter(
            self.belief,
            self.period,
            position_noise=np.array(counts) / math.sqrt(12),
            disturbance_drift=limit / 3 if math.isfinite(limit) else 1.0,
            delay=delay,
        )

    def make_controller(self, memory: CascadeState) -> Controller:
        """Return the controller, idle."""
        return Controller(
            self.cascade,
            memory,
            self.make_estimator(),
            period=self.period,
            settings=self.settings,
        )

    def as_dict(self) -> dict[str, Any]:
        """JSON values from which :meth:`from_dict` makes the recipe again."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """Return the recipe that was written to a log."""
        return cls(
            **{
                **values,
                "start": tuple(values["start"]),
                "settings": Settings(**values["settings"]),
            }
        )
