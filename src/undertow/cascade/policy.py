"""A controller in the words of stable-baselines3: an object with ``predict(observation)``.

An agent's policy is a function of what is observed; a cascade also remembers.  What it remembers
goes in and out as ``state``, one entry for each episode, as that of a recurrent policy does.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from undertow.base import InvalidInputError, checked, positive
from undertow.cascade.cascade import Cascade
from undertow.cascade.robustness import DelayGate
from undertow.cascade.simulation import LEARNING, is_news
from undertow.cascade.state import CascadeState
from undertow.closed_loop import ClosedLoop
from undertow.closed_loop.gate import cost_gate
from undertow.estimators import ParameterEstimate
from undertow.law import InnerLoop, Plan, Surface, check_surface_shape
from undertow.models import FloatArray, Mechanism


class Episode(Protocol):
    """A controller on its way through one episode: states, one a period, to inputs, (m,)."""

    def __call__(self, x: FloatArray) -> FloatArray:
        """Return the inputs of the next period."""
        ...


class Policy:
    """A controller as a policy: observations to actions, for one episode or for many at once.

    Parameters
    ----------
    mechanism
        Whose states (q, q̇) are observed.
    begin
        Makes what steers an episode.
    period
        Time between two calls, s.
    """

    def __init__(self, mechanism: Mechanism, begin: Callable[[], Episode], period: float) -> None:
        self.mechanism, self.period, self._begin = mechanism, period, begin

    def __repr__(self) -> str:
        """Show what it balances, and how often it is asked."""
        return f"Policy({self.mechanism.name}, every {self.period:g} s)"

    @checked
    def predict(
        self,
        observation: ArrayLike,
        state: Sequence[Any] | None = None,
        episode_start: ArrayLike | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[np.float64], tuple[Episode, ...]]:
        """Return actions and the state to hand back with the next observation.

        Parameters
        ----------
        observation
            (q, q̇), SI units, (2n,) or of N episodes (N, 2n).
        state
            What the last call returned; ``None``: all episodes begin.
        episode_start
            Which episodes begin, a bool or (N,) of them.
        deterministic
            Taken for stable-baselines3's sake: the policy always is.

        Returns
        -------
        action, state
            Inputs over their limits, (m,) or (N, m), in [−1, 1].

        Raises
        ------
        InvalidInputError
            For observations of another shape, and for a state of other episodes.
        InfeasibleError
            Where a cascade that begins finds no admissible surface.
        """
        del deterministic
        x = np.array(self.mechanism.check_state(observation))  # who observes may reuse the array
        rows = np.atleast_2d(x)
        begins = np.atleast_1d(np.asarray(False if episode_start is None else episode_start))
        if rows.ndim != 2 or begins.shape not in ((1,), (len(rows),)):
            raise InvalidInputError(
                "episodes of a policy",
                value=f"observations {x.shape}, episode_start {begins.shape}",
                limit="(2n,), or (N, 2n) and one bool for each",
                remedy="Leave episode_start out where none begins",
            )
        if state is not None and len(state) != len(rows):
            raise InvalidInputError(
                "state of a policy",
                value=f"of {len(state)} episodes",
                limit=f"one for each of {len(rows)} observations",
                remedy="Hand back what predict() returned, or None where episodes begin",
            )
        begins = np.broadcast_to(begins, len(rows))
        episodes = tuple(
            self._begin() if state is None or begin else state[i] for i, begin in enumerate(begins)
        )
        if not all(map(callable, episodes)):
            raise InvalidInputError(
                "state of a policy",
                value=repr(state),
                limit="what predict() returned",
                remedy="Leave it out where episodes begin",
            )
        u = np.stack([episode(row) for episode, row in zip(episodes, rows, strict=True)])
        return (u / self.mechanism.input_limits).reshape(*x.shape[:-1], -1), episodes


class _PlanEpisode:
    """The law of a loop along a plan."""

    def __init__(self, loop: ClosedLoop, plan: Plan, period: float) -> None:
        self._plan, self._period, self._k = plan, period, 0
        self._reaching = loop.reaching
        self._law = InnerLoop(loop.mechanism, plan.surfaces[0], loop.reaching)

    def __call__(self, x: FloatArray) -> FloatArray:
        self._law.follow(self._plan, self._k * self._period, self._reaching)
        self._k += 1
        return self._law(x).copy()


class _CascadeEpisode:
    """The cascade: decisions fall in the periods in which they are due, and take no time.

    As in :meth:`undertow.Cascade.simulate` what moves is learnt some times between two of them, and
    what is learnt may call for another one; and the task is to be done within the horizon of the
    objective, from the beginning of the episode or from when it was last at the target.
    """

    def __init__(self, cascade: Cascade, period: float) -> None:
        self._cascade, self._period = cascade, period
        self._memory: CascadeState | None = None
        self._planned_with: ParameterEstimate | None = None
        self._x: list[FloatArray] = []
        self._u: list[FloatArray] = []
        self._k, self._since = 0, 0.0
        self._decides, self._learns = (
            max(1, round(span / period)) for span in (cascade.period, LEARNING)
        )

    def __call__(self, x: FloatArray) -> FloatArray:
        cascade, t = self._cascade, self._k * self._period
        if self._memory is None:
            self._memory, _ = cascade.start(x)
            self._planned_with = self._memory.estimate
        elif self._k % self._learns == 0 or self._k % self._decides == 0:
            self._memory = self._learnt(self._memory)
            due = self._k % self._decides == 0
            due = due or is_news(self._planned_with, self._memory.estimate)
            if due or not cascade.survives(self._memory, x, t):
                left = self._left(x, t)
                proposal = cascade.propose(self._memory, x, t, left)
                self._memory, _ = cascade.apply_gate(self._memory, proposal, x, left)
                self._planned_with = self._memory.estimate
        u = cascade.control(self._memory, t, x).u
        self._x.append(x)
        self._u.append(u)
        self._k += 1
        return u

    def _left(self, x: FloatArray, t: float) -> float:
        """Return the time that is left for the task, s: where it is over another one begins."""
        objective = self._cascade.objective
        left = objective.horizon - (t - self._since)
        if np.linalg.norm(x) > objective.terminal_radius and left > 0.5 * self._cascade.step:
            return left
        self._since = t
        return objective.horizon

    def _learnt(self, memory: CascadeState) -> CascadeState:
        """Return the memory with what the motion since the last time shows of the plant."""
        x, u = np.array(self._x), np.array(self._u)
        t = (self._k - len(x) + np.arange(len(x))) * self._period
        self._x, self._u = self._x[-1:], self._u[-1:]
        return self._cascade.learn(memory, t, x, u, held=True)


@checked
def policy(
    controller: ClosedLoop | Cascade,
    surfaces: Surface | Plan | None = None,
    *,
    period: float = 0.005,
) -> Policy:
    """Return a controller as a policy, with stable-baselines3's ``predict(observation)``.

    Parameters
    ----------
    controller
        A cascade, which from the second surface on admits what bears a period of delay while inputs
        are held, unless it has a gate of its own; or a closed loop, whose law keeps to
        ``surfaces``.
    surfaces
        What a loop slides on.
    period
        Time for which an action is held, s: that of the environment.

    Returns
    -------
    Policy
        Of the environments of :func:`undertow.environment`.

    Raises
    ------
    InvalidInputError
        For a loop without a surface or with one of another shape, a cascade with one, an input
        without a limit, and a period that the law cannot bear or that does not divide the
        cascade's.

    Examples
    --------
    >>> import undertow as ut
    >>> rig = ut.mechanisms.rotary_pendulum()
    >>> act = policy(ut.ClosedLoop(rig), ut.first_surface(rig))
    >>> action, state = act.predict(rig.state(phi=0.1))
    >>> action.shape
    (1,)
    """
    positive("period of a policy, s", period, "5 ms suits most")
    cascade = controller if isinstance(controller, Cascade) else None
    if (cascade is None) == (surfaces is None):
        raise InvalidInputError(
            "surfaces of a policy",
            value="none, for a closed loop" if surfaces is None else "some, beside a cascade",
            limit="what a closed loop slides on; none for a cascade",
            remedy="ut.policy(loop, surface), or ut.policy(cascade)",
        )
    mechanism = controller.mechanism
    for given in mechanism.inputs:
        what = f"limit of input '{given.name}' of '{mechanism.name}'"
        remedy = f"Give it an Input({given.name!r}, limit=…): an action of 1 is the whole input"
        positive(what, given.limit, remedy)
    plan = None if surfaces is None else Plan.of(surfaces)
    for surface in () if plan is None else plan.surfaces:
        check_surface_shape(mechanism, surface)
    for law in [controller.reaching] if plan is None else plan.laws(controller.reaching):
        law.check_period("period of a policy", period, mechanism.m)
    if cascade is not None:
        count = cascade.period / period
        if abs(count - round(count)) > 1e-6:
            raise InvalidInputError(
                "period of a policy",
                value=f"{period:g} s",
                limit=f"a whole part of the cascade's, {cascade.period:g} s",
                remedy="Change one of them",
            )
        if cascade.gate is cost_gate:  # what it predicts is not held
            cascade = replace(cascade, gate=DelayGate(period, period))
        return Policy(mechanism, partial(_CascadeEpisode, cascade, period), period)
    assert isinstance(controller, ClosedLoop)  # no cascade
    assert plan is not None  # no cascade
    begin = partial(_PlanEpisode, controller, plan, period)
    return Policy(mechanism, begin, period)
