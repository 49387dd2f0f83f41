"""The closed loops that a cascade predicts with, by what is known of the plant and the target."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cached_property, lru_cache

import numpy as np

from undertow.cascade.state import CascadeState
from undertow.cascade.targets import LoopsAbout
from undertow.closed_loop import ClosedLoop, Event, simulate_along
from undertow.estimators import Belief, ParameterEstimate
from undertow.law import Plan, ReferenceMotion
from undertow.models import FloatArray
from undertow.objective import Objective
from undertow.optimiser import Optimiser


class Predictions:
    """The predicted closed loops of a cascade; the latest are kept.

    Parameters
    ----------
    prior
        The loop before anything was learnt, about x = 0.
    belief
        What is not known of its mechanism; ``None`` where it is exact.
    objective
        Of the task, whose constraints are about absolute positions.
    """

    def __init__(self, prior: ClosedLoop, belief: Belief | None, objective: Objective) -> None:
        self.prior, self.belief = prior, belief
        self._targets = LoopsAbout(prior.mechanism, objective)
        self.plausible = lru_cache(maxsize=2)(self._plausible)
        self.estimated = lru_cache(maxsize=2)(self._estimated)

    def _plausible(self, estimate: ParameterEstimate | None) -> ClosedLoop:
        """The loop on every plant that an estimate leaves plausible."""
        belief, prior = self.belief, self.prior
        if belief is None or estimate is None or estimate is belief.prior:
            return prior
        return prior.believing(belief.believed(estimate), belief.ensemble(estimate))

    def single(self, estimate: ParameterEstimate | None) -> ClosedLoop | None:
        """The plausible loop with the estimate for its only member; ``None``: nothing is open.

        It needs nothing compiled that the ensemble has not.
        """
        if self.belief is None or estimate is None:
            return None
        whole = self.plausible(estimate)
        return whole.believing(whole.mechanism, self.belief.single(estimate))

    def _estimated(self, estimate: ParameterEstimate | None) -> ClosedLoop:
        """The loop of an estimate taken for the plant."""
        return self._alone.believing(self.plausible(estimate).mechanism)

    @cached_property
    def _alone(self) -> ClosedLoop:
        return replace(self.prior, ensemble=None)

    def about(self, loop: ClosedLoop, target: ReferenceMotion | None, t: float) -> ClosedLoop:
        """A loop about a target, as it is at the time t, s."""
        return loop if target is None else self._targets.loop(loop, target.position(t))

    def optimiser_about(self, optimiser: Optimiser, target: ReferenceMotion, t: float) -> Optimiser:
        """An optimiser of plans for a target, as it is at the time t, s."""
        return self._targets.optimiser(optimiser, target.position(t))

    def at(self, state: CascadeState, t: float) -> ClosedLoop:
        """The loop with what is known by now of the plant, about the target at the time t, s."""
        return self.about(self.plausible(state.estimate), state.target, t)

    def estimated_at(self, state: CascadeState) -> ClosedLoop:
        """The loop of the estimate taken for the plant, about the target."""
        return self.about(self.estimated(state.estimate), state.target, state.since)

    def error_at(
        self, state: CascadeState, error: FloatArray, t: float, until: float
    ) -> FloatArray:
        """How far off the target the plan in use leaves, at ``until``, what is so far off at t."""
        plan, target = state.at(t), state.target
        if target is None or not target.moves:
            batch = self.at(state, t).batch(error, plan, duration=until - t, terminal=0.0)
            return np.asarray(batch.x[0])
        loop, x = self.plausible(state.estimate), state.absolute(t, error)
        motion = simulate_along(loop, x, plan, target, duration=until - t, start=t)
        if motion.event not in (Event.HORIZON, Event.REACHED):
            return np.full_like(error, math.nan)
        return state.error(until, motion.x[-1])


def costs_along(
    loop: ClosedLoop, error: FloatArray, plans: list[Plan], target: ReferenceMotion, t: float,
    span: float,
) -> list[float]:  # fmt: skip
    """What each plan costs along a reference from t on, s; infinite where the motion breaks off."""
    x = error + target.state(t)
    runs = [simulate_along(loop, x, plan, target, duration=span, start=t) for plan in plans]
    return [run.cost if run.event in (Event.HORIZON, Event.REACHED) else math.inf for run in runs]
