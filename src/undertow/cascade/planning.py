"""The searches for the first plan of a task, for the next ones, and for what holds a target."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from undertow.base import InvalidInputError, a_kind, error_text
from undertow.cascade.judge import Judge
from undertow.cascade.planners import Planners
from undertow.cascade.predictions import costs_along
from undertow.cascade.state import CascadeState, as_numbers
from undertow.closed_loop import INADMISSIBLE, ClosedLoop, Event
from undertow.estimators import ParameterEstimate
from undertow.law import Plan, ReferenceMotion
from undertow.models import FloatArray
from undertow.optimiser import Optimiser, Proposal
from undertow.optimiser.proposal import check_held

#: How much more a first plan may cost than the search found, as a factor, before it is searched for
#: again in smaller steps; and how much smaller they are.
AGREES, FINER = 1.01, 4

#: What part of the usual evaluations a search for an earlier arrival with a free reaching law takes
#: after one in the same decision whose plan cannot be mended, and one for what suits every plant
#: after that, whose evaluations take longer: all of a decision is to take less than its period.
AGAIN, LAST = 0.5, 0.125


class Search(NamedTuple):
    """A search for a first plan: on what loop, and how.

    In steps of ``fixed`` where that is given; ``repairs``: the plan of the search before is
    repaired, where there is one, instead of a search from nothing.
    """

    loop: ClosedLoop
    fixed: ClosedLoop | None = None
    repairs: bool = False


class Found(NamedTuple):
    """An answer to the search for a first plan, and the cost of its plan where it was judged.

    ``rank`` is 0 where it is good, 1 if it is for every plausible plant, 2 if it is for the
    estimate, 3 where there is none.
    """

    rank: int
    cost: float
    proposal: Proposal


class Planning:
    """The searches of a cascade.

    Parameters
    ----------
    planners, judge
        Who is asked for plans, and who decides on them.
    resolution
        Differences in cost below this part of the first cost are not worth a search.
    """

    def __init__(self, planners: Planners, judge: Judge, resolution: float) -> None:
        self.planners, self.judge, self.resolution = planners, judge, resolution
        self.predictions = planners.predictions
        optimiser = planners.optimiser
        self._hurries = planners.recourse and optimiser.aims and not optimiser.freedom.schedule

    def first(
        self,
        x: FloatArray,
        target: ReferenceMotion | None = None,
        t: float = 0.0,
        before: CascadeState | None = None,
        longest: float = math.inf,
    ) -> tuple[CascadeState, Proposal]:
        """Search for the first plan from a state x at the time t, to a target that was checked.

        The plan is to arrive within ``longest``, s, where one does, else within the objective's
        horizon.  What ``before`` remembers of the plant is kept.

        Raises
        ------
        InfeasibleError
            When no admissible plan was found, or the inputs cannot hold the target.
        """
        planners, judge, predictions = self.planners, self.judge, self.predictions
        belief = predictions.belief
        absolute, horizon = x, min(longest, judge.objective.horizon)
        short = horizon < judge.objective.horizon
        if target is not None:
            x = predictions.prior.mechanism.check_state(x) - target.state(t)
        number, known = 0, None if belief is None else belief.prior
        if before is not None:
            number, known = before.sequence + 1, before.estimate or known
        whole = predictions.plausible(known)
        here = predictions.about(whole, target, t)
        here.objective.check_start(here.mechanism, x)
        check_held(predictions.prior)
        # Where nothing suits every plausible plant, what brings home the estimate, without room for
        # any error: to learn which of the plants it is takes less time than to fall.
        single = predictions.single(known)
        last = [] if single is None else [Search(single)]
        tries: list[Found] = []
        kept = False  # whether the last plan does what the search said of it
        for loop, fixed, repairs in [*self._searches(known), *last]:
            found = tries[-1].proposal if tries else None
            if loop is single and found is not None and found.plan is not None:
                break
            if fixed is not None and not here.price_of_time > 0 and kept:
                continue  # smaller steps find nothing else
            about, planner = predictions.about(loop, target, t), planners.of(loop, target, t)
            if fixed is not None:
                planner = planners.suited(fixed).on(predictions.about(fixed, target, t))
            span = horizon if short else None
            if repairs and found is not None and isinstance(planner, Optimiser):
                proposal = planner.repair(x, found, horizon=span)
            else:
                proposal = planner.propose(
                    x, incumbent=None, horizon=span, sequence=0, computed_for=t, resolution=0.0
                )
            if not isinstance(proposal, Proposal):  # a planner of one's own
                raise InvalidInputError(
                    "answer of the cascade's planner",
                    value=a_kind(proposal),
                    limit="an undertow.Proposal",
                    remedy="undertow.Optimiser.propose shows what a proposal holds",
                )
            plan = proposal.plan
            if plan is None:
                kept = False
                tries.append(Found(3, math.inf, proposal))
                continue
            cost = float(about.batch(x, plan, duration=horizon, precise=True).score(horizon)[0])
            cost = cost if cost < INADMISSIBLE else math.inf
            kept = math.isfinite(cost) and cost <= AGREES * proposal.cost
            begun = CascadeState(plan, number, cost, cost, t, as_numbers(x), known, target)
            good = math.isfinite(cost) and math.isinf(judge.breaks(begun, [plan], x, horizon)[0][0])
            if loop is not whole:  # every plausible plant lives to see the next decision
                if loop.ensemble is not None:
                    good &= judge.survives(here, x, plan)
                else:
                    good &= judge.reserve.recovers(here, x, horizon, plan)
            if loop.ensemble is None and planners.own is None:
                good &= kept
            tries.append(Found(0 if good else 1 if loop is whole else 2, cost, proposal))
            if good:
                break
        best = min(tries, key=lambda one: (one.rank, one.cost))
        if best.proposal.plan is None and short:
            return self.first(absolute, target, t, before)
        cost, proposal = best.cost, best.proposal
        plan = proposal.required(here, x).plan
        assert plan is not None  # required
        if target is not None and target.moves:  # or the designed surface, where that is better
            plans = [plan, Plan.of(planners.optimiser.anchor)]
            costs = costs_along(whole, x, plans, target, t, horizon)
            k = int(np.argmin(costs))
            plan, cost = plans[k], costs[k]
        begun = CascadeState(plan, number, cost, cost, t, as_numbers(x), known, target)
        mends = planners.recourse and here.price_of_time > 0
        if mends and best.rank < 3 and not (target is not None and target.moves):
            begun = replace(begun, ahead=self._ahead(begun, x, horizon))
        return begun, replace(proposal, sequence=number)

    def _ahead(self, begun: CascadeState, x: FloatArray, span: float) -> Plan | None:
        """What will be best for the estimate at the next decision; ``None`` without any such plan.

        That decision has no time to search for it from nothing.
        """
        predictions, period = self.predictions, self.judge.period
        estimated = predictions.estimated_at(begun)
        motion = estimated.batch(x, begun.plan, duration=period, terminal=0.0)
        there = motion.radius[0] <= self.judge.objective.terminal_radius
        if there or motion.event[0] != Event.HORIZON or span <= period:
            return None
        known = predictions.estimated(begun.estimate)
        optimiser = self.planners.optimiser_of(known, begun.target, begun.since)
        return optimiser.propose(motion.x[0], horizon=span - period).plan

    def _searches(self, estimate: ParameterEstimate | None) -> list[Search]:
        """What the first plan is to be best on, one after the other.

        Before anything has moved, what suits every plausible plant suits none of them well: the
        estimate alone comes first, for a plan that the next decision replaces; a schedule, and a
        smooth cost with a free reaching law, for it without any error before.  Where its plan does
        not do what it promised, small steps throughout follow: for one plant, which is integrated
        to the tolerance, smaller ones than usual.  With many plants and a smooth cost that plan is
        repaired first: what costs least goes up to a bound, and small steps may find it broken by a
        hair.
        """
        planners, predictions = self.planners, self.predictions
        belief = predictions.belief
        whole = predictions.plausible(estimate)
        if planners.own is not None:
            return [Search(whole)]
        loops = [whole]
        if belief is not None and estimate is not None:
            loops.insert(0, whole.believing(whole.mechanism, belief.alone(estimate)))
        optimiser = planners.optimiser
        gently = optimiser.space.frees_law and not optimiser.counts_time
        if planners.recourse and (optimiser.freedom.schedule or gently):
            loops.insert(0, predictions.estimated(estimate))

        def smaller(loop: ClosedLoop) -> ClosedLoop:
            adapts = loop.ensemble is None and not loop.zoh_steps
            return loop.with_steps(predictions.prior.step / FINER, 0.0) if adapts else loop

        searches = []
        for loop in loops:
            small = smaller(loop)
            smooth = loop.ensemble is not None and not loop.price_of_time
            repaired = [Search(loop, small, repairs=True)] if smooth else []
            searches += [Search(loop), *repaired, Search(loop, small)]
        return searches

    def hold(self, state: CascadeState, error: FloatArray, t: float) -> Proposal | None:
        """The plan that holds what was reached, at no cost; ``None``: see :class:`Holding`.

        A planner of one's own decides for itself.
        """
        own = self.planners.own
        plan = None if own is not None else self.planners.holding.best(state, error, t)
        if plan is None:
            return None
        return Proposal(plan, "converged", 0.0, 0.0, (), 1, 0.0, state.sequence + 1, t)

    def next(self, state: CascadeState, x: ArrayLike, t: float, horizon: float | None) -> Proposal:
        """Re-optimise from a state x at the time t; an exception becomes a status.

        See :meth:`undertow.Cascade.propose`.
        """
        planners, judge, predictions = self.planners, self.judge, self.predictions
        sequence = state.sequence + 1
        try:
            error = state.error(t, predictions.prior.mechanism.check_state(x))
            span = judge.objective.horizon if horizon is None else horizon
            soon = judge.soon(state, error, t, span)
            ask: dict[str, Any] = {
                "sequence": sequence,
                "computed_for": t,
                "resolution": self.resolution * state.scale,
            }
            horizons = [soon, horizon] if planners.recourse and soon < span else [horizon]
            asks = [ask | {"horizon": longest} for longest in horizons]
            mended = self._mended(state, error, t, soon, asks[0])
            if mended is not None:
                return mended
            # What suits every plausible plant may be near what is late on one of them.
            used, loop = state.at(t), predictions.at(state, t)
            standing = judge.standing(replace(state, since=t), loop, used, error, span, soon)
            planner = planners.of(predictions.plausible(state.estimate), state.target, t)
            near: list[Proposal] = []
            # A planner of one's own has no recourse, and is not told.
            less: dict[str, Any] = {"part": LAST} if self._hurries else {}
            if planners.own is None and planners.optimiser.space.rate:
                less["admits"] = partial(judge.frees, state, loop)
            for ask in asks:
                for plan in [standing] if standing is used else [standing, used]:
                    near.append(planner.propose(error, incumbent=plan, **ask, **less))
                if len(asks) == 1 or any(found.plan for found in near):
                    break
            return _best_of(near, near)
        except Exception as error:  # the inner loop must survive whatever the outer loop does
            said = error_text(error)
            return Proposal(None, "failed", math.inf, math.inf, (), 0, 0.0, sequence, t, said)

    def _mended(
        self, state: CascadeState, error: FloatArray, t: float, soon: float, ask: dict[str, Any]
    ) -> Proposal | None:
        """The best plan for the estimate that can be mended; ``None``: what suits all is better.

        Before the first decision of a smooth cost it is: one period shows little of the plant, and
        what suits all costs less then than a guess.
        """
        planners, judge, predictions = self.planners, self.judge, self.predictions
        price = predictions.prior.price_of_time
        first = state.predicted == state.scale  # nothing was decided since
        if not planners.recourse or (first and not price > 0):
            return None
        loop = predictions.at(state, t)
        optimiser = planners.optimiser_of(predictions.estimated(state.estimate), state.target, t)
        used, now = state.at(t), replace(state, since=t)
        begins = [(used, 0.0 if first else state.predicted - (t - state.since) * price)]
        if state.ahead is not None:
            begins.append((state.ahead, math.inf))
        admits = partial(judge.reserve.recovers, loop, error, soon)
        if self._hurries and loop.ensemble is not None:
            ask = ask | {"asking": len(loop.ensemble.values) * len(judge.reserve.plans)}
        answers: list[Proposal] = []
        mended: list[Proposal] = []
        # Of single surfaces the best one mostly is admissible; asking all takes long.
        for asked in (admits,) if optimiser.freedom.schedule else (None, admits):
            for plan, cost in begins if not mended else ():
                part = AGAIN if self._hurries and answers else 1.0
                found = optimiser.propose(
                    error, incumbent=plan, admits=asked, promised=cost, part=part, **ask
                )
                answers.append(found)
                if found.plan and judge.mendable(now, loop, found.plan, error, soon):
                    mended.append(found)
        if mended or judge.mendable(now, loop, used, error, soon):
            return _best_of(mended or answers[:1], answers)
        return None


def _best_of(answers: list[Proposal], asked: list[Proposal]) -> Proposal:
    """The cheapest of some answers, with what was spent on all that were asked for.

    The cost of the incumbent is that of the first one's.
    """
    if len(asked) == 1:  # whatever a planner of one's own has said
        return asked[0]
    return replace(
        min(answers, key=lambda one: one.cost),
        incumbent_cost=asked[0].incumbent_cost,
        evaluations=sum(one.evaluations for one in asked),
        seconds=sum(one.seconds for one in asked),
    )
