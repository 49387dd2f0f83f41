"""A closed loop without checks: what searches call thousands of times.

Rollouts are read from buffers and written there (:mod:`undertow.closed_loop.buffers`).  They go in
small Runge-Kutta steps until the law is in its boundary layer and then, where the loop has a
linear model, in large ones (:mod:`undertow.symbolic.settle`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from undertow.base import InvalidInputError
from undertow.closed_loop.buffers import NOTHING, RolloutBuffers, Shape
from undertow.closed_loop.kernel import compile_loop
from undertow.closed_loop.terminal_model import Prepared, TerminalLinearModel
from undertow.closed_loop.trajectory import Batch
from undertow.law import ReachingLaw, coupling, gains_at_target, has_linear_model
from undertow.models import FloatArray, Mechanism
from undertow.objective import MinimumEnergy, Objective
from undertow.symbolic import UNSETTLED

__all__ = ["RolloutEvaluator", "UncheckedLoop"]

#: Small steps before large ones are tried again, s; each time as long again as all before.
CALMER = 0.5


class _Numbers(NamedTuple):
    """Plant and belief parameters, input limits, η and ε of the loop."""

    plant: FloatArray
    belief: FloatArray
    limits: FloatArray
    law: FloatArray


@dataclass(frozen=True, eq=False)
class UncheckedLoop:
    """Law and plant, compiled; the parameters are those of :class:`undertow.ClosedLoop`."""

    mechanism: Mechanism
    objective: Objective = MinimumEnergy()
    reaching: ReachingLaw = ReachingLaw()
    plant: Mechanism | None = None
    step: float = 0.002
    hold: int = 0
    escape: float = 200.0
    tail: float = 0.0

    def __getstate__(self) -> dict[str, Any]:
        """What it was made from: a copy compiles, or finds, the same kernels."""
        made = {field.name: getattr(self, field.name) for field in fields(self)}
        return made | {"objective": self.objective.written(self.mechanism)}

    @property
    def truth(self) -> Mechanism:
        """The plant that moves."""
        return self.mechanism if self.plant is None else self.plant

    @cached_property
    def _kernels(self) -> Any:
        return compile_loop(
            self.mechanism, self.plant, self.objective, self.reaching.switching, self.hold > 0
        )

    @cached_property
    def _numbers(self) -> _Numbers:
        belief, truth = self.mechanism, self.truth
        return _Numbers(
            truth.parameter_values,
            belief.parameter_values,
            truth.input_limits,
            self.reaching.vector(belief.m),
        )

    @cached_property
    def _shape(self) -> Shape:
        belief = self.mechanism
        return Shape(
            belief.n,
            belief.m,
            len(self.objective.constraints),
            coupling(belief, np.zeros(belief.n)),
            self.linear_end,
            self.hold > 0,
        )

    @cached_property
    def linear_end(self) -> TerminalLinearModel | None:
        """The linear model of this loop at the target, where it has one."""
        if self.hold or self.reaching.switching == "sign" or self.plant is not None:
            return None
        if not has_linear_model(self.mechanism):
            return None
        return TerminalLinearModel(self.mechanism, self.objective)

    @cached_property
    def _hands_over(self) -> bool:
        """Whether rollouts may end in the linear model."""
        problem = self.objective
        if not self.tail > 0 or (problem.constraints and not problem.boxes(self.mechanism)):
            return False
        end = self.linear_end
        return end is not None and end.stage is not None

    def _prepare(self, buffers: RolloutBuffers) -> Prepared | None:
        """Linearise the last surface of every lane."""
        if self.linear_end is None or buffers.ends is None:
            return None
        gains = None
        if any(self.mechanism.disturbance_bounds):
            surfaces, eta = (
                buffers.lanes[:, -1, : buffers.width],
                buffers.lanes[:, -1, buffers.width :],
            )
            gains = gains_at_target(self.mechanism, surfaces, eta[:, : self.mechanism.m])
        self.linear_end.prepare(buffers.lanes, gains, buffers.ends)
        return buffers.ends

    def _launch(
        self,
        buffers: RolloutBuffers,
        switches: NDArray[np.int64],
        steps: int,
        *,
        start: float = 0.0,
        terminal: float | None = None,
        every: int = 0,
        seek: bool = False,
        **options: Any,
    ) -> Batch:
        """Roll out what the buffers hold; the results live there too."""
        end_radius = self.objective.terminal_radius if terminal is None else terminal
        # Large steps see no closest approach, and leave nothing to record.
        calm_from = 0 if self._hands_over and not every and not seek else steps
        self._roll(buffers, switches, steps, calm_from, start, end_radius, seek, every, **options)
        return buffers.batch(start)

    def _roll(
        self,
        buffers: RolloutBuffers,
        switches: NDArray[np.int64],
        steps: int,
        calm_from: int,
        start: float,
        terminal: float,
        seek: bool,
        every: int,
        *,
        cap: float = math.inf,
        stable_only: bool = False,
        record: FloatArray = NOTHING,
        noise: FloatArray | None = None,
    ) -> None:
        """Call the kernel; from the step ``calm_from`` on, lanes may go on in large steps."""
        numbers, live, out = self._numbers, buffers.live, buffers.out
        live.fill(1.0)
        self._check_gains(buffers.lanes, live, stable_only)
        hands_over = calm_from < steps
        prepared = self._prepare(buffers) if hands_over or stable_only else None
        if prepared is not None and stable_only:
            live *= prepared.stable
        self._kernels.rollout(
            buffers.states, live, buffers.lanes, switches, numbers.plant, numbers.belief,
            numbers.limits, buffers.quiet if noise is None else noise, start, self.step, steps,
            max(1, self.hold), terminal, self.escape, cap, 1.0 if seek else 0.0, calm_from,
            every, record, out,
        )  # fmt: skip
        if not hands_over or prepared is None or self.linear_end is None:
            return
        self._kernels.settle(
            buffers.lanes, numbers.plant, numbers.belief, numbers.limits, start + steps * self.step,
            terminal, self.escape, self.tail, 1.0 if self.linear_end.counts_cost else 0.0,
            prepared.A, prepared.P, prepared.powers, prepared.forced, prepared.reach, out,
        )  # fmt: skip
        again = np.flatnonzero(out[: buffers.count, 2] == UNSETTLED)
        if not len(again):
            return
        # Too fast for large steps, or at a limit again: small steps until later.
        part = buffers.part(again)
        failed = round((float(out[again, 1].max()) - start) / self.step)
        later = failed + max(round(CALMER / self.step), calm_from)
        self._roll(
            part, switches, steps, min(later, steps), start, terminal, seek, every,
            cap=cap, stable_only=stable_only,
        )  # fmt: skip
        part.out[:, -1] += np.resize(out[again, -1], len(part.out))
        out[again] = part.out[: len(again)]

    def _check_gains(self, lanes: FloatArray, live: FloatArray, stable_only: bool) -> None:
        """Refuse gains (13) that this step cannot follow, or switch their lanes off."""
        if not any(self.mechanism.disturbance_bounds) or self.reaching.switching == "sign":
            return
        n, m = self.mechanism.n, self.mechanism.m
        flat = lanes.reshape(-1, lanes.shape[-1])
        surfaces, eta, layer = np.split(flat[:, :-1], [2 * m * n, 2 * m * n + m], axis=1)
        gains = gains_at_target(self.mechanism, surfaces, eta)
        rate = (gains / layer).max(axis=1).reshape(lanes.shape[:2]).max(axis=1)
        period = self.step * max(1, self.hold)
        fast = rate * period >= 2.0
        if stable_only:
            live[fast] = 0.0
        elif fast.any():
            raise InvalidInputError(
                "step for the gains (13) that the disturbance bounds ask for",
                value=f"{period:g} s at k/ε = {rate.max():.4g} 1/s",
                limit=f"below 2 ε/k = {2 / rate.max():.3g} s",
                remedy="Use a shorter step, a thicker boundary layer or smaller bounds",
            )


class RolloutEvaluator:
    """Rollouts of many plans from one state, unchecked and in the same buffers: for searches.

    Parameters
    ----------
    loop
        The closed loop.
    x
        State, (2n,).
    switches, steps
        Switch times of the plans and length, in steps.
    """

    def __init__(
        self, loop: UncheckedLoop, x: FloatArray, switches: NDArray[np.int64], steps: int
    ) -> None:
        self.loop, self.x, self.switches, self.steps = loop, x, switches, steps
        self._buffers: dict[int, RolloutBuffers] = {}

    def __call__(self, surfaces: FloatArray, laws: FloatArray | None, **options: Any) -> Batch:
        """Roll out surfaces (N, S, 2mn) with reaching laws (N, S, 2m).

        What is returned is valid until the next call.  Options are those of
        :meth:`undertow.ClosedLoop.batch`: ``terminal``, ``cap``, ``stable_only``, ``seek``.
        """
        count = len(surfaces)
        buffers = self._buffers.get(count)
        if buffers is None:
            buffers = self._buffers[count] = RolloutBuffers(
                self.loop._shape, count, len(self.switches)
            )
        buffers.fill(self.x, surfaces, self.loop._numbers.law if laws is None else laws)
        return self.loop._launch(buffers, self.switches, self.steps, **options)
