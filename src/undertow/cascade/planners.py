"""Who is asked for plans, and on which predicted loop."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

from undertow.cascade.holding import Holding
from undertow.cascade.predictions import Predictions
from undertow.closed_loop import ClosedLoop
from undertow.law import ReferenceMotion
from undertow.optimiser import DecisionVariables, Optimiser, Planner

#: Relative tolerance of the linear tail in the optimiser's rollouts.
TAIL_RTOL = 2e-3

#: Largest step times rate of the boundary layer in the optimiser's rollouts.
RESOLVED = 1.0


def searched(loop: ClosedLoop, freedom: DecisionVariables) -> ClosedLoop:
    """Return a predicted loop as the optimiser integrates it: to its exact linear tail.

    Its steps are twice as long where that resolves the boundary layer: the gate integrates
    what it finds again.  A time of arrival is a matter of milliseconds, and is not searched
    for with longer steps than it is judged with.
    """
    end, step, mechanism = loop.linear_end, loop.step, loop.mechanism
    smooth = end is not None and end.counts_cost and not freedom.reaching
    eta, layer = loop.reaching.per_surface(mechanism.m)
    slow = 2 * step * float((eta / layer).max()) <= RESOLVED
    even = all(round(t / step) % 2 == 0 for t in freedom.times)
    larger = smooth and slow and even and not any(mechanism.disturbance_bounds)
    return loop.with_steps(step * (2 if larger else 1), TAIL_RTOL)


class Planners:
    """The optimisers of a cascade, by the loop that a plan is for; or a planner of one's own.

    Parameters
    ----------
    predictions
        The predicted loops.
    optimiser
        The cascade's.
    own
        Asked in its place, where there is one.
    recourse
        Whether the optimiser's plans are for the estimate alone.
    """

    def __init__(
        self, predictions: Predictions, optimiser: Optimiser, own: Planner | None, recourse: bool
    ) -> None:
        self.predictions, self.optimiser = predictions, optimiser
        self.own, self.recourse = own, recourse

    @cached_property
    def holding(self) -> Holding:
        """What says whether a target is held, and with what."""
        return Holding(self.predictions, self.optimiser.anchor)

    @cached_property
    def _robust(self) -> Optimiser:
        """The optimiser of plans that suit every plausible plant."""
        optimiser = self.optimiser
        if optimiser.loop.ensemble is not None or not self.recourse:
            return optimiser
        freedom = replace(optimiser.freedom, schedule=0.0)
        loop = searched(self.predictions.prior, optimiser.freedom)
        return replace(optimiser, loop=loop, freedom=freedom)

    def suited(self, loop: ClosedLoop) -> Optimiser:
        """The optimiser for one plant, or for an ensemble of plausible ones."""
        return self.optimiser if loop.ensemble is None else self._robust

    def optimiser_of(
        self, exact: ClosedLoop, target: ReferenceMotion | None, t: float
    ) -> Optimiser:
        """The optimiser of a predicted loop, about a target as it is at the time t, s."""
        optimiser = self.suited(exact)
        if exact is not self.predictions.prior:
            optimiser = optimiser.on(searched(exact, self.optimiser.freedom))
        if target is None:
            return optimiser
        return self.predictions.optimiser_about(optimiser, target, t)

    def of(
        self, exact: ClosedLoop, target: ReferenceMotion | None = None, t: float = 0.0
    ) -> Planner:
        """Who is asked for plans on a predicted loop, about a target."""
        return self.optimiser_of(exact, target, t) if self.own is None else self.own
