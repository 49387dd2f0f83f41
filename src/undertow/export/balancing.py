"""Balancing as a task of reinforcement learning: where it starts, what it costs, when it ends.

Nothing here needs Gymnasium; :mod:`undertow.export.gym` puts its classes around it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from undertow.base import (
    InvalidInputError,
    at_least,
    between,
    check_fields,
    checked,
    checked_names,
    floats,
    positive,
    require_extra,
)
from undertow.closed_loop import LANES, Event
from undertow.estimators import FilteredDerivative
from undertow.export.balancing_kernel import driven_plants
from undertow.mechanisms.named import named
from undertow.models import FloatArray, Mechanism, steps_in
from undertow.objective import Objective, objective_for
from undertow.plants import Bench, RealisticRig
from undertow.plants.bench import bench_for
from undertow.symbolic import compile_expressions

if TYPE_CHECKING:
    from undertow.export.gym import Environment, VectorEnvironment

#: Longest Runge-Kutta step of an ideal plant, s; a fast mode asks for shorter ones.
STEP = 0.0025

#: Horizon of the objective that is taken where none is given, or a word for one, s.
HORIZON = 10.0

#: Time constant of the filtered derivative that a realistic environment's velocities are, s.
FILTER = 0.005

#: Longest episode, in steps.
MOST_STEPS = 10_000_000

NEEDS = "environments need Gymnasium"


@checked_names
@dataclass(frozen=True, eq=False)
class BalancingTask:
    """What an environment asks: bring a mechanism to its target at the least cost.

    Parameters
    ----------
    mechanism
        What moves.
    objective
        Its stage cost is what is paid; its terminal set, constraints and horizon end an episode.
        By default that of :func:`undertow.objective_for`, within 10 s.
    bench
        What the mechanism's model leaves out, or ``None``: the model is the plant.
    period
        Time for which an action is held, s.
    penalty
        What a motion pays that breaks a constraint or is lost, in the cost's unit: without it, to
        fall soon would be cheap.  By default the horizon: as if Φ were 1 that long.
    escape
        ‖x‖₂ beyond which a motion is lost.

    Raises
    ------
    InvalidInputError
        For an input without a limit, a mechanism without a usual start, a bench of another
        mechanism, and a period that is no multiple of the bench's.
    """

    mechanism: Mechanism
    objective: Objective | None = None
    bench: Bench | None = None
    period: float = 0.005
    penalty: float | None = None
    escape: float = 200.0

    def __post_init__(self) -> None:
        """Check everything before a plant is compiled."""
        check_fields(self)
        positive("period of an environment, s", self.period, "5 ms suits most")
        positive("escape of an environment", self.escape, "Leave it out for the usual value")
        for given in self.mechanism.inputs:  # an action of 1 is the whole input
            what = f"limit of input '{given.name}' of '{self.mechanism.name}'"
            positive(what, given.limit, f"Give the mechanism an Input({given.name!r}, limit=…)")
        objective = self.objective
        if objective is None:
            objective = objective_for(self.mechanism, horizon=HORIZON)
        objective = objective.on(self.mechanism)
        object.__setattr__(self, "objective", objective)
        steps, remedy = objective.horizon / self.period, "Change the horizon, or the period"
        between("horizon of an environment", steps, 1, MOST_STEPS, "periods", remedy)
        if self.penalty is None:
            object.__setattr__(self, "penalty", objective.horizon)
        at_least("penalty of an environment", self.paid, 0, "0 pays nothing for falling")
        objective.check_start(self.mechanism, self.mechanism.usual_start)
        if self.bench is not None:
            self.mechanism.check_plant(self.bench.mechanism)
            count = self.period / self.bench.timing.period
            if not (count > 0.5 and abs(count - round(count)) < 1e-6):
                raise InvalidInputError(
                    "period of a realistic environment",
                    value=f"{self.period:g} s",
                    limit=f"a multiple of the bench's, {self.bench.timing.period:g} s",
                    remedy="Change one of them: bench.with_timing(period=…)",
                )

    @property
    def problem(self) -> Objective:
        """The objective, with the travel that the mechanism declares."""
        assert self.objective is not None  # __post_init__ sets it
        return self.objective

    @property
    def paid(self) -> float:
        """The penalty, in the cost's unit."""
        assert self.penalty is not None  # __post_init__ sets it
        return self.penalty

    @property
    def steps(self) -> int:
        """Steps until the horizon is over and an episode is truncated."""
        return round(self.problem.horizon / self.period)

    @cached_property
    def box(self) -> tuple[FloatArray, FloatArray]:
        """Bounds of what is observed, (2n,) each: travel that ends an episode, else ``escape``."""
        low = np.full(2 * self.mechanism.n, -self.escape)
        high = -low
        for i, c in enumerate(self.mechanism.coordinates if self.problem.travel else ()):
            low[i], high[i] = max(low[i], c.low), min(high[i], c.high)
        return low, high

    def start(self, rng: np.random.Generator) -> FloatArray:
        """Draw an initial state, (2n,): the usual one times r, ½ ≤ |r| ≤ 1.

        Of either sign, where the constraints allow both.
        """
        r = rng.uniform(-0.5, 0.5)
        r += math.copysign(0.5, r)
        return np.asarray(self.mechanism.usual_start * (r if self._mirrors else abs(r)))

    @cached_property
    def _mirrors(self) -> bool:
        """Whether an episode may begin at the mirror image of the usual start."""
        try:
            self.problem.check_start(self.mechanism, -self.mechanism.usual_start)
        except InvalidInputError:
            return False
        return True

    def inputs(self, actions: NDArray[Any], *count: int) -> FloatArray:
        """Return the inputs of actions in [−1, 1], (m,), or (N, m) of ``count`` N, in their units.

        Raises
        ------
        InvalidInputError
            For actions of another shape, and those that are no finite numbers.
        """
        shape, remedy = (*count, self.mechanism.m), "Give a number in [−1, 1] for each input"
        what = "actions of a vector environment" if count else "action of an environment"
        given = floats(what, actions, remedy)
        bad = ~np.isfinite(given)
        if given.shape != shape or bad.any():
            value = f"{given[bad][0]}" if given.shape == shape else f"shape {given.shape}"
            raise InvalidInputError(what, value=value, limit=f"finite, {shape}", remedy=remedy)
        return np.asarray(np.clip(given, -1.0, 1.0) * self.mechanism.input_limits)

    def events(self, x: FloatArray, margin: FloatArray) -> NDArray[np.int64]:
        """Return what became of states x, (N, 2n), with path margins (N,): HORIZON goes on."""
        square = np.einsum("ij,ij->i", x, x)
        event = np.full(len(x), int(Event.HORIZON))
        event[square <= self.problem.terminal_radius**2] = Event.REACHED
        event[~(margin >= 0.0)] = Event.CONSTRAINT
        event[~(square < self.escape**2)] = Event.DIVERGED
        return event

    def rewards(self, cost: FloatArray, event: NDArray[np.int64]) -> FloatArray:
        """Return the rewards of steps, (N,): −∫Φ(x, u) dt, less the penalty of what broke off."""
        lost = (event == Event.CONSTRAINT) | (event == Event.DIVERGED)
        return np.asarray(-cost - self.paid * lost)


class Lanes:
    """Ideal plants, many at once: integrated in blocks by one compiled call.

    ``task``: whose plants. ``count``: how many, N. ``u``: inputs to be held during the next step,
    (m, N), in their units.
    """

    def __init__(self, task: BalancingTask, count: int) -> None:
        n, m = task.mechanism.n, task.mechanism.m
        padded = -(-count // LANES) * LANES
        self._task, self.count = task, count
        self._advance = driven_plants(task.mechanism, task.problem).advance
        self._x, self._inputs = np.zeros((2 * n, padded)), np.zeros((m, padded))
        self._t, self._cost, self._margin = np.zeros((3, padded))
        self.u = self._inputs[:, :count]
        self._values = task.mechanism.parameter_values
        self._steps = steps_in(task.mechanism, task.period, STEP)

    @property
    def x(self) -> FloatArray:
        """States, (N, 2n), a copy."""
        return np.array(self._x[:, : self.count].T, order="C")

    def place(self, i: int, x: FloatArray) -> None:
        """Put plant i to a state, (2n,), and its clock to 0."""
        self._x[:, i], self._t[i] = x, 0.0

    def step(self) -> tuple[FloatArray, FloatArray]:
        """Hold the inputs for a period: cost and margin of each plant, (N,)."""
        h = self._task.period / self._steps
        self._advance(
            self._x, self._inputs, self._t, self._cost, self._margin, self._values, h, self._steps
        )
        self._t += self._task.period
        return self._cost[: self.count], self._margin[: self.count]


class IdealPlant:
    """One plant that is its model, observed exactly."""

    def __init__(self, task: BalancingTask) -> None:
        self._lanes = Lanes(task, 1)

    def reset(self, x: FloatArray, rng: np.random.Generator) -> None:
        """Begin at a state, (2n,)."""
        del rng  # nothing here is random
        self._lanes.place(0, x)

    @property
    def x(self) -> FloatArray:
        """The state, (2n,)."""
        return np.asarray(self._lanes.x[0])

    @property
    def observation(self) -> FloatArray:
        """What is observed, (2n,)."""
        return self.x

    def step(self, u: FloatArray) -> tuple[float, float]:
        """Hold inputs, (m,), for a period: its cost, and the smallest margin at its end."""
        self._lanes.u[:, 0] = u
        cost, margin = self._lanes.step()
        return float(cost[0]), float(margin[0])


class BenchPlant:
    """One plant on a simulated bench: parameters drawn, friction, delay, positions in counts.

    Velocities are filtered differences of the positions measured.  What is paid, and when an
    episode ends, goes by the true state.
    """

    def __init__(self, task: BalancingTask, bench: Bench) -> None:
        self._task, self._bench = task, bench
        self._samples = round(task.period / bench.timing.period)
        mechanism, problem = task.mechanism, task.problem
        outputs = [problem.stage_cost(mechanism), *problem.path_margins(mechanism)]
        self._look = compile_expressions(
            [*mechanism.x, *mechanism.u], [e.xreplace(mechanism.substitution) for e in outputs]
        )
        self._estimator = FilteredDerivative(mechanism, bench.timing.period, FILTER)

    def reset(self, x: FloatArray, rng: np.random.Generator) -> None:
        """Begin with another rig of the bench where a hand means a state, (2n,)."""
        self._rig = RealisticRig(self._bench, x, seed=int(rng.integers(2**31)))
        self._estimator.reset(np.append(self._rig.read().q, np.zeros(len(x) // 2)))
        self._observe(np.zeros(self._task.mechanism.m))

    def _observe(self, u: FloatArray) -> None:
        self.observation = self._estimator.estimate(self._rig.read(), u).copy()

    @property
    def x(self) -> FloatArray:
        """The true state, (2n,)."""
        return self._rig.truth

    def step(self, u: FloatArray) -> tuple[float, float]:
        """Hold inputs, (m,), for a period: its cost by the trapezoidal rule, and the margin.

        Of an input counts what the bench's actuator can give.
        """
        limits = self._bench.mechanism.input_limits
        u = np.clip(u, -limits, limits)
        rates = [self._rate(u)[0]]
        for _ in range(self._samples):
            self._rig.write(u)
            self._observe(u)
            rates.append(self._rate(u)[0])
        return float(np.trapezoid(rates, dx=self._rig.period)), self._rate(u)[1]

    def _rate(self, u: FloatArray) -> tuple[float, float]:
        """Return Φ and the smallest margin of the path constraints at the true state."""
        stage, *margins = (float(value) for value in self._look(*self._rig.truth, *u))
        return stage, min(margins, default=math.inf)


@checked
def environment(
    mechanism: Mechanism | str,
    objective: Objective | str | None = None,
    *,
    realistic: bool | Bench = False,
    period: float = 0.005,
    penalty: float | None = None,
    render_mode: str | None = None,
) -> Environment:
    """Return a Gymnasium environment in which a mechanism is to be balanced.

    Parameters
    ----------
    mechanism
        The mechanism, or its name as on the command line.
    objective
        What is paid, or a word of :func:`undertow.objective_for`; by default the effort,
        ∫ (Σ (u/u_max)² + 0.01 xᵀx) dt to ‖x‖ ≤ 0.01 within 10 s.
    realistic
        False: the model is the plant, and its state (q, q̇) is observed.  True: a bench with
        friction, delay and encoders, with parameters drawn for each episode
        (:func:`undertow.plants.plausible_rig`, of the paper's mechanism
        :func:`undertow.plants.srv02_rig`); or a bench of one's own.  Observed are
        positions in counts and their filtered derivatives.
    period
        Time for which an action is held, s.
    penalty
        What a motion pays that breaks a constraint or is lost; by default the horizon, as if
        Φ were 1 that long.
    render_mode
        ``"rgb_array"``, or ``None``.

    Returns
    -------
    Environment
        Actions are inputs over their limits, (m,), in [−1, 1]; observations (2n,), SI units.

    Raises
    ------
    MissingExtraError
        Without Gymnasium.
    InvalidInputError
        For what :class:`undertow.export.BalancingTask` refuses.
    """
    require_extra("gymnasium", "gym", NEEDS)
    from undertow.export.gym import Environment

    task = _task(mechanism, objective, realistic, period, penalty)
    return Environment(task, render_mode=render_mode)


@checked
def vector_environment(
    mechanism: Mechanism | str,
    objective: Objective | str | None = None,
    *,
    num_envs: int = 1024,
    period: float = 0.005,
    penalty: float | None = None,
) -> VectorEnvironment:
    """Return many ideal environments at once, for Gymnasium: one compiled call moves them all.

    Parameters
    ----------
    mechanism, objective, period, penalty
        As for :func:`undertow.environment`.
    num_envs
        How many, N.

    Returns
    -------
    VectorEnvironment
        Actions (N, m), observations (N, 2n); each behaves, to the last bit, as one alone does.

    Raises
    ------
    MissingExtraError
        Without Gymnasium.
    InvalidInputError
        For what :class:`undertow.export.BalancingTask` refuses.
    """
    require_extra("gymnasium", "gym", NEEDS)
    from undertow.export.gym import VectorEnvironment

    return VectorEnvironment(_task(mechanism, objective, False, period, penalty), int(num_envs))


def _task(
    mechanism: Mechanism | str,
    objective: Objective | str | None,
    realistic: bool | Bench,
    period: float,
    penalty: float | None,
) -> BalancingTask:
    moved = named(mechanism) if isinstance(mechanism, str) else mechanism
    if isinstance(objective, str):
        objective = objective_for(moved, objective, horizon=HORIZON)
    bench = realistic if isinstance(realistic, Bench) else bench_for(moved) if realistic else None
    return BalancingTask(moved, objective, bench, period, penalty)
