"""Closed loops in batches: law and plant, continuous or sampled, with costs and events.

The controller's *belief* (the model its law was derived from) and the *truth* (the plant
that moves) are separate arguments everywhere; by default they are the same.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from undertow.base import InvalidInputError, check_fields, checked, floats
from undertow.closed_loop.buffers import RolloutBuffers
from undertow.closed_loop.trajectory import Batch, Event, Trajectory
from undertow.closed_loop.unchecked import RolloutEvaluator, UncheckedLoop
from undertow.law import Plan, Surface, check_surface_shape
from undertow.models import FloatArray, require_mechanism
from undertow.objective import require_objective
from undertow.symbolic import LANES

__all__ = ["ClosedLoop"]

#: Longest rollout, in steps.
MOST_STEPS = 10_000_000

#: Switch steps of a single surface.
_AT_ONCE = np.zeros(1, dtype=np.int64)


@dataclass(frozen=True, eq=False)
class ClosedLoop(UncheckedLoop):
    """A mechanism under its sliding-mode law, compiled for batches of rollouts.

    Parameters
    ----------
    mechanism
        The controller's belief, from which the law is derived.
    objective
        Stage cost, terminal set, constraints; the travel that the belief declares joins them, see
        :meth:`undertow.Objective.on`.
    reaching
        Reaching law; its gains can be overridden for each rollout.
    plant
        The truth.  The belief itself by default; must have as many coordinates and inputs.
    step
        Runge-Kutta step, s.
    hold
        Sampled inner loop: the law is evaluated every ``hold`` steps and held.
        0: continuous law, evaluated in every Runge-Kutta stage.
    escape
        ‖x‖₂ beyond which a motion counts as diverged.
    tail
        Relative tolerance of the large steps that a batch takes once the law is in its
        boundary layer, see :mod:`undertow.symbolic.settle`; 0: small steps to the end.  Used by
        :meth:`batch` where belief and truth agree, the loop is continuous, all path
        constraints are bounds of states and the stage cost has a second-order model.

    Examples
    --------
    >>> import undertow as ut
    >>> rig = ut.mechanisms.rotary_pendulum(d_e=0.025)
    >>> loop = ClosedLoop(rig, ut.MinimumEnergy())
    >>> run = loop.simulate(rig.state(phi=0.5), ut.Surface(-1, -1.59, 1.96, 12.1))
    >>> run.event.name
    'REACHED'
    """

    def __post_init__(self) -> None:
        """Refuse steps that the boundary layer cannot bear and plants of another shape."""
        check_fields(self)
        require_mechanism("mechanism of a closed loop", self.mechanism)
        if self.plant is not None:
            require_mechanism("plant of a closed loop", self.plant)
        require_objective(self.objective)
        object.__setattr__(self, "objective", self.objective.on(self.mechanism))
        for name, low in (("escape", 0.0), ("tail", 0.0)):
            value = getattr(self, name)
            if not value >= low:
                raise InvalidInputError(
                    f"{name} of a closed loop",
                    value=value,
                    limit="a number ≥ 0",
                    remedy="Leave it out for the usual value",
                )
        if not (math.isfinite(self.step) and self.step > 0):
            raise InvalidInputError("rollout step", value=self.step, limit="finite and > 0 s")
        if self.hold < 0 or self.hold != int(self.hold):
            raise InvalidInputError(
                "rollout hold",
                value=self.hold,
                limit="a whole number ≥ 0 of steps",
                remedy="0 is the continuous law",
            )
        vector = self.reaching.vector(self.mechanism.m)
        if self.reaching.switching != "sign":
            eta, layer = np.split(vector, 2)
            period = self.step * max(1, self.hold)
            limit = float(np.min(2 * layer / eta))
            if period >= limit:
                raise InvalidInputError(
                    "sample period of the inner loop" if self.hold else "rollout step",
                    value=f"{period:g} s",
                    limit=f"below 2 ε/η = {limit:g} s",
                    remedy="Use a shorter step, a thicker boundary layer or a smaller η",
                )
        plant = self.truth
        if (plant.n, plant.m) != (self.mechanism.n, self.mechanism.m):
            raise InvalidInputError(
                f"plant '{plant.name}'",
                value=f"n = {plant.n}, m = {plant.m}",
                limit=f"n = {self.mechanism.n}, m = {self.mechanism.m} like the belief",
            )

    def __repr__(self) -> str:
        """Show belief, truth where it is another one, and objective."""
        plant = "" if self.plant is None else f", plant={self.plant.name}"
        return (
            f"ClosedLoop({self.mechanism.name}, {self.objective.name}{plant}, step={self.step:g} s)"
        )

    def _switch_steps(self, switch_times: Sequence[float]) -> NDArray[np.int64]:
        """Return the steps at which surfaces take over; the kernel meets them one by one."""
        if len(switch_times) == 1 and switch_times[0] == 0:
            return _AT_ONCE
        steps = np.array([round(t / self.step) for t in switch_times], dtype=np.int64)
        if steps[0] != 0 or not (np.diff(steps) > 0).all():
            raise InvalidInputError(
                "switch_times",
                value=list(switch_times),
                limit=f"0 first, each later than the one before by a step of {self.step:g} s",
                remedy="Leave out the surfaces that never act",
            )
        return steps

    def _run(
        self,
        x0: FloatArray,
        surfaces: FloatArray,
        *,
        reaching: FloatArray | None = None,
        switch_times: Sequence[float] = (0.0,),
        duration: float | None = None,
        start: float = 0.0,
        every: int = 0,
        **options: Any,
    ) -> tuple[Batch, FloatArray]:
        """Roll out states (N, 2n) and surfaces (N, S, 2mn), or one of either, in new buffers."""
        steps = self._steps(self.objective.horizon if duration is None else duration)
        buffers = RolloutBuffers(self._shape, max(len(x0), len(surfaces)), surfaces.shape[1])
        buffers.fill(x0, surfaces, self._numbers.law if reaching is None else reaching)
        columns = 2 * self.mechanism.n + 2 * self.mechanism.m + 2
        shape = (buffers.padded, -(-steps // every), columns) if every else (0, 0, 0)
        record = np.zeros(shape)
        switches = self._switch_steps(switch_times)
        batch = self._launch(
            buffers, switches, steps, start=start, every=every, record=record, **options
        )
        return batch, record

    def probe(
        self, x: FloatArray, times: Sequence[float] = (0.0,), horizon: float = 0.0
    ) -> RolloutEvaluator:
        """Return a function that rolls out plans from x, again and again, without checks.

        Parameters
        ----------
        x
            State, (2n,).
        times
            Switch times of the plans, s.
        horizon
            Length, s.
        """
        return RolloutEvaluator(self, x, self._switch_steps(times), self._steps(horizon))

    @checked
    def batch(
        self,
        x0: ArrayLike,
        surfaces: ArrayLike | Surface | Plan | Sequence[Surface | Plan],
        *,
        reaching: FloatArray | None = None,
        switch_times: Sequence[float] = (0.0,),
        duration: float | None = None,
        terminal: float | None = None,
        cap: float = math.inf,
        stable_only: bool = False,
        seek: bool = False,
    ) -> Batch:
        """Roll out a batch: many surfaces or plans, many initial states, or both.

        Parameters
        ----------
        x0
            (2n,) or (N, 2n).
        surfaces
            Surfaces or plans, one for each rollout; or vectors: (2mn,), (N, 2mn), or
            (N, S, 2mn) for S surfaces that take over at ``switch_times``.
        reaching
            With vectors: (N, S, 2m) or broadcastable, η and ε of each.
        switch_times
            With vectors: S times, s, the first 0.
        duration
            Length, s; the objective's horizon by default.
        terminal
            Terminal radius; the objective's by default; 0 never ends.
        cap
            Cost beyond which a rollout is given up (``COSTLY``).
        stable_only
            Do not roll out surfaces that are unstable at the target (``UNSTABLE``); for
            loops with a linear model, see :attr:`linear_end`.
        seek
            Also find where the motion comes closest to the target.
        """
        self._check_duration(duration)
        plans = _plans(surfaces)
        if plans:
            if reaching is not None or tuple(switch_times) != (0.0,):
                raise InvalidInputError(
                    "batch of surfaces or plans",
                    value="reaching= or switch_times= besides",
                    limit="plans alone, or vectors with both",
                    remedy="Put times and reaching laws into undertow.Plan",
                )
            switch_times, vectors, reaching = Plan.align(plans, self.reaching)
        else:
            vectors = np.atleast_2d(floats("surface vectors of a batch", surfaces))  # type: ignore[arg-type]
            if vectors.ndim == 2:
                vectors = vectors[:, None, :]
        states = np.atleast_2d(self.mechanism.check_state(x0))
        expected = 2 * self.mechanism.m * self.mechanism.n
        if vectors.shape[-1] != expected or vectors.shape[1] != len(switch_times):
            raise InvalidInputError(
                "surface vectors of a batch",
                value=f"shape {vectors.shape}",
                limit=f"(N, {len(switch_times)}, {expected})",
            )
        if vectors.shape[0] == 0:
            raise InvalidInputError("batch of rollouts", value="no surface", limit="at least one")
        if not np.isfinite(vectors).all():
            raise InvalidInputError(
                "surface vectors of a batch",
                value="NaN or infinity",
                limit="finite numbers",
                remedy="An earlier computation went wrong: look at where they come from",
            )
        if reaching is not None and not (np.asarray(reaching) > 0).all():
            raise InvalidInputError(
                "reaching gains of a batch",
                value=float(np.min(reaching)),
                limit="> 0",
                remedy="η and ε are positive",
            )
        if not (terminal is None or terminal >= 0) or not cap >= 0:
            raise InvalidInputError(
                "terminal and cap of a batch",
                value=(terminal, cap),
                limit="both ≥ 0",
                remedy="Leave them out for the usual values",
            )
        count = max(states.shape[0], vectors.shape[0])
        if states.ndim != 2 or {states.shape[0], vectors.shape[0]} - {1, count}:
            raise InvalidInputError(
                "batch of rollouts",
                value=f"{states.shape[:-1]} states and {vectors.shape[0]} surfaces",
                limit="equal numbers, or one of either",
                remedy="Repeat the states or the surfaces",
            )
        return self._run(
            states,
            vectors,
            reaching=reaching,
            switch_times=switch_times,
            duration=duration,
            terminal=terminal,
            cap=cap,
            stable_only=stable_only,
            seek=seek,
        )[0]

    @checked
    def simulate(
        self,
        x0: ArrayLike,
        surfaces: Surface | Plan | Sequence[Surface],
        *,
        switch_times: Sequence[float] = (0.0,),
        duration: float | None = None,
        start: float = 0.0,
        terminal: float | None = None,
        every: int = 1,
        noise: FloatArray | None = None,
    ) -> Trajectory:
        """Simulate and record one motion, with one surface, several of them, or a plan.

        Parameters
        ----------
        x0
            Initial state, (2n,).
        surfaces
            A plan, a surface, or one surface for each of ``switch_times``.
        switch_times
            When each takes over, s after the start; the first is 0.
        duration
            Length, s; the objective's horizon by default.
        start
            Clock at the start, s (for time-dependent disturbances).
        terminal
            Terminal radius; the objective's by default; 0 never ends.
        every
            Record every so many steps.
        noise
            Measurement noise added to the state that the law sees, (samples, 2n), SI
            units; for a sampled inner loop only.
        """
        self._check_duration(duration)
        if every < 1:
            raise InvalidInputError("every", value=every, limit="≥ 1", remedy="Record each step: 1")
        plan = Plan.of(surfaces, switch_times)
        for surface in plan.surfaces:
            check_surface_shape(self.mechanism, surface)
        if noise is not None:
            if not self.hold:
                raise InvalidInputError(
                    "measurement noise",
                    value="a continuous inner loop",
                    limit="a sampled one",
                    remedy="Build the loop with hold ≥ 1",
                )
            noise = np.asarray(noise, dtype=float)
            if noise.ndim != 2 or noise.shape[1] != 2 * self.mechanism.n or noise.size == 0:
                raise InvalidInputError(
                    "measurement noise",
                    value=f"shape {noise.shape}",
                    limit=f"(samples, {2 * self.mechanism.n})",
                )
            noise = np.repeat(self.mechanism.check_state(noise)[:, None, :], LANES, axis=1)
        x0 = self.mechanism.check_state(x0)
        if x0.ndim != 1:
            raise InvalidInputError(
                "initial state of a simulation",
                value=f"shape {x0.shape}",
                limit=f"({2 * self.mechanism.n},)",
                remedy="ClosedLoop.batch takes many starts",
            )
        batch, record = self._run(
            x0[None],
            plan.vectors[None],
            reaching=plan.gains(self.reaching)[None],
            switch_times=plan.times,
            duration=duration,
            start=start,
            terminal=terminal,
            every=every,
            noise=noise,
        )
        last = self._ending(plan, batch, start)
        return self._trajectory(batch, record[0], last, start, every)

    def _steps(self, duration: float) -> int:
        """Return the number of steps of a rollout, refusing what memory or patience forbid."""
        self._check_duration(duration)
        steps = round(duration / self.step)
        if steps > MOST_STEPS or (steps < 1 and duration > 0):
            raise InvalidInputError(
                "length of a rollout",
                value=f"{duration:g} s",
                limit=f"{self.step:g} s to {MOST_STEPS * self.step:g} s, 1 to {MOST_STEPS} steps",
                remedy="Change the horizon, or the step",
            )
        return steps

    def _check_duration(self, duration: float | None) -> None:
        if duration is not None and not (math.isfinite(duration) and duration >= 0):
            raise InvalidInputError(
                "duration of a rollout",
                value=f"{duration} s",
                limit="finite and ≥ 0",
                remedy="Leave it out for the objective's horizon",
            )

    def _ending(self, plan: Plan, batch: Batch, start: float) -> FloatArray | None:
        """Return the line of a record for the end of a motion, where the law acts there."""
        if self.hold or not np.isfinite(batch.x).all():
            return None
        end = float(batch.time[0])
        surface, law = plan.at(end)
        _, record = self._run(
            batch.x,
            surface.vector[None, None],
            reaching=(law or self.reaching).vector(self.mechanism.m)[None, None],
            duration=self.step,
            start=start + end,
            terminal=0.0,
            every=1,
        )
        line = record[0, 0]
        return line if np.isfinite(line).all() else None

    def _trajectory(
        self, batch: Batch, record: FloatArray, last: FloatArray | None, start: float, every: int
    ) -> Trajectory:
        n, m = self.mechanism.n, self.mechanism.m
        end = float(batch.time[0])
        times = np.arange(len(record)) * (every * self.step)
        rows = record[times < end - 1e-12]
        if last is None:  # a held input is still the last one
            lines = [*rows[-1:], *record[:1], np.zeros(2 * n + 2 * m + 2)]
            last = lines[0].copy()
        last[: 2 * n], last[2 * n + 2 * m] = batch.x[0], batch.cost[0]
        if len(rows) == 0:
            rows = record[:1] if len(record) else last[None]
            if end == 0.0:
                rows[0, : 2 * n] = batch.x[0]
        rows = np.vstack([rows, last])
        t = np.append(times[: len(rows) - 1], end)
        x, u, s, cost, margin = np.split(
            rows, [2 * n, 2 * n + m, 2 * n + 2 * m, 2 * n + 2 * m + 1], axis=1
        )
        return Trajectory(
            self.truth, t + start, x, u, s, cost[:, 0], margin[:, 0], Event(int(batch.event[0]))
        )


def _plans(what: object) -> list[Plan]:
    """Return the plans that were given as such or as surfaces; [] for plain numbers."""
    if isinstance(what, Surface | Plan):
        return [Plan.of(what)]
    if isinstance(what, Sequence) and all(isinstance(item, Surface | Plan) for item in what):
        return [Plan.of(item) for item in what]
    return []
