"""What is decided of a plan: it stays, gives way to one in reserve, or is replaced."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache

import numpy as np

from undertow.base import InvalidInputError, a_kind
from undertow.cascade.predictions import Predictions, costs_along
from undertow.cascade.reserve import Reserve, stiffer
from undertow.cascade.robustness import sticking_distance
from undertow.cascade.state import CascadeState, as_numbers
from undertow.closed_loop import INADMISSIBLE, ClosedLoop, Event
from undertow.closed_loop.gate import Admission, Gate, broken_by
from undertow.law import Plan
from undertow.models import FloatArray
from undertow.objective import Objective
from undertow.optimiser import Proposal

#: How far positions may be off what the plan in use predicted for them before an admission says
#: so: this much, rad or m, and this part of how far the plan was to move them meanwhile.  A target
#: that jumps shows in positions at once; what a model does not know shows in velocities first.
JUMP, PART = 0.1, 0.5

#: What part of a motion may be left unexplained, as one is whose parameters are being learnt; how
#: much sooner a plan to be mended is to be home where all of it is; and what part of the distance
#: left is no motion.
UNEXPLAINED, SOONER, STILL = 0.03, 5.0, 1e-3

#: Where the last prediction was off by more than this part of the cost, states being estimated,
#: another plan has to gain as large a part of what it was off: less is within the errors of
#: prediction, and every change of a surface shakes the mechanism.
DOUBTFUL = 0.3

#: How much more a plan may cost the estimate, as a factor, that takes over from one which does not
#: suit every plausible plant, and can be left a period later: by then more is known of the plant.
PATIENT = 1.1


class Judge:
    """Decides on plans, with a cascade's gate and what every plausible plant asks for.

    Parameters
    ----------
    predictions, reserve, gate
        The cascade's.
    objective
        Of the task, as the user gave it.
    recourse
        Whether plans are for the estimate alone, and later decisions mend them.
    """

    def __init__(
        self,
        predictions: Predictions,
        reserve: Reserve,
        gate: Gate,
        objective: Objective,
        recourse: bool,
    ) -> None:
        self.predictions, self.reserve, self.gate = predictions, reserve, gate
        self.objective, self.recourse = objective, recourse
        self.reaching, self.period = reserve.reaching, reserve.period
        guarded = objective.hard_input or predictions.prior.objective != objective
        on_bench = predictions.belief is not None and predictions.prior.covariance is not None
        self._doubts = on_bench and not recourse
        self._bounds_input = predictions.belief is not None and guarded
        # A decision asks twice, for the search and for the gate.
        self._moved = lru_cache(maxsize=2)(_moved)

    def standing(
        self, state: CascadeState, loop: ClosedLoop, plan: Plan, error: FloatArray, span: float,
        soon: float,
    ) -> Plan:  # fmt: skip
        """The plan in use, or where it does not suit every plausible plant the best in reserve.

        A plan with which a joint sticks suits none.  One that can be mended need not suit all: it
        stays as long as there is time to take one in reserve a period later.
        """
        if loop.ensemble is None:
            return plan
        sticks = self._sticks(state, loop, plan) > 0
        if not sticks and self.mendable(state, loop, plan, error, soon):
            return plan
        stiffer = self._stiffer(state, loop, plan) if sticks else ()
        better = self.reserve.better(loop, plan, error, span, sticks, stiffer)
        if better is None:
            return plan
        asked = sticks or self.recourse  # with recourse it was asked above
        return plan if not asked and self._can_wait(state, loop, plan, error, soon) else better

    def mendable(
        self, state: CascadeState, loop: ClosedLoop, plan: Plan, error: FloatArray, span: float
    ) -> bool:
        """Whether a plan is to be judged on the estimate, as one that later decisions mend."""
        return self.recourse and self._can_wait(state, loop, plan, error, span)

    def _can_wait(
        self, state: CascadeState, loop: ClosedLoop, plan: Plan, error: FloatArray, span: float
    ) -> bool:
        """Whether a plan brings the estimate home, and may be mended for the plant later on."""
        estimated = self.predictions.estimated_at(state)
        arrives = estimated.batch(error, plan, duration=span, precise=True).reached[0]
        return bool(arrives) and self.reserve.recovers(loop, error, span, plan)

    def soon(self, state: CascadeState, error: FloatArray, t: float, span: float) -> float:
        """The time in which a plan that waits to be mended is to be home, of the ``span`` left, s.

        What no parameter of the model explains, as friction that it does not have, makes a motion
        late: the more of the last one is unexplained, the more room a plan leaves.  With recourse
        one of least time leaves none.
        """
        least_time = self.recourse and self.predictions.prior.price_of_time > 0
        if self.predictions.belief is None or least_time:
            return span
        rest = self.unexplained(state, error, t)
        return span / (1.0 + SOONER * max(0.0, rest - UNEXPLAINED))

    def unexplained(self, state: CascadeState, error: FloatArray, t: float) -> float:
        """What part of the motion since the last decision the estimate does not explain.

        How far positions are off where it says that the plan in use moved them, beside that way.
        Along a reference that moves nothing is said: 0.
        """
        there = self._expected(state, t)
        if there is None:
            return 0.0
        n, start = len(there) // 2, np.array(state.x)
        off, way, left = (np.linalg.norm(d[:n]) for d in (error - there, there - start, error))
        way += STILL * left
        return float(off / way) if math.isfinite(off) and way > 0.0 else 0.0

    def _expected(self, state: CascadeState, t: float) -> FloatArray | None:
        """Where the estimate says that the plan in use has moved the last decision's state by t.

        ``None`` along a reference that moves, and where that decision is not known or long past.
        """
        past, moves = t - state.since, state.target is not None and state.target.moves
        if moves or not state.x or not 0.0 < past <= self.objective.horizon:
            return None
        return self._moved(self.predictions.estimated_at(state), state.plan, state.x, past)

    def _gains_little(
        self, state: CascadeState, loop: ClosedLoop, cost: float, x: FloatArray,
        there: FloatArray | None, span: float,
    ) -> str:  # fmt: skip
        """Say so where a plan gains little beside what the last prediction was off, in cost.

        ``there`` is where the estimate says that x would be by now; ``None``: nobody doubts it.
        """
        if there is None or not np.isfinite(there).all():
            return ""
        old, starts = state.plan, np.array([there, x])
        foreseen, now = loop.batch(starts, [old, old], duration=span, precise=True).score(span)
        off = min(abs(foreseen - now), now)  # a plan that saves much of the cost is always better
        resolved = off <= DOUBTFUL * now or now - cost >= DOUBTFUL * off
        if max(foreseen, now) >= INADMISSIBLE or resolved:
            return ""
        if math.isfinite(self.breaks(state, [old], x, span)[0][0]):
            return ""
        return f"gains {now - cost:.3g}, when the last prediction was {off:.3g} off"

    def _in_haste(
        self, state: CascadeState, loop: ClosedLoop, old: Plan, new: Plan, error: FloatArray,
        span: float, soon: float,
    ) -> str:  # fmt: skip
        """Say so where a plan that suits all costs much more than one that can wait for it."""
        if self.recourse or loop.ensemble is None:
            return ""
        if loop.batch(error, old, duration=span).score(span)[0] < INADMISSIBLE:
            return ""
        estimated = self.predictions.estimated_at(state)
        motions = estimated.batch(error, [old, new], duration=span, precise=True)
        cost, found = motions.score(span)
        if found <= PATIENT * cost or not self._can_wait(state, loop, old, error, soon):
            return ""
        return f"costs the estimate {found:.3g}, not {cost:.3g}, and the plan in use can wait"

    def _frees_too_late(self, state: CascadeState, loop: ClosedLoop, new: Plan) -> str:
        """Say so where a joint sticks farther off with a new plan than with the one in use."""
        off = self._sticks(state, loop, new)
        if not off > self._sticks(state, loop, state.plan):
            return ""
        most = f"{self.objective.terminal_radius:g} at most"
        return f"a joint that sticks is freed by {off:.3g} of the others, {most}"

    def frees(self, state: CascadeState, loop: ClosedLoop, plan: Plan) -> bool:
        """Whether no joint sticks farther off with a plan than with the one in use."""
        return not self._frees_too_late(state, loop, plan)

    def _breaks_sooner(self, state: CascadeState, new: Plan, error: FloatArray, span: float) -> str:
        """Say so where a plan breaks a constraint on the estimate before the one in use does."""
        (before, _), (end, name) = self.breaks(state, [state.plan, new], error, span)
        return f"breaks {name} between two steps, at {end:.3g} s" if end < before else ""

    def breaks(
        self, state: CascadeState, plans: list[Plan], error: FloatArray, span: float
    ) -> list[tuple[float, str]]:
        """When each plan breaks a constraint on the estimate, s, and which; infinite: none does.

        An input that changes with the plan may pass its bound and be back within a step: what suits
        every plausible plant at the steps of an ensemble is integrated to the tolerance on one.
        """
        if not self._bounds_input:
            return [(math.inf, "")] * len(plans)
        loop = self.predictions.estimated_at(state)
        motions = loop.batch(error, plans, duration=span, precise=True)
        names = [broken_by(loop, motions, k) for k in range(len(plans))]
        ends = zip(motions.time.tolist(), names, strict=True)
        return [(t if name else math.inf, name) for t, name in ends]

    def _sticks(self, state: CascadeState, loop: ClosedLoop, plan: Plan) -> float:
        """How far off a joint sticks on the last surface of a plan; 0 within the terminal set."""
        if not state.disturbance or loop.ensemble is None:
            return 0.0
        law = plan.laws(self.reaching)[-1]
        size = np.array(state.disturbance)
        off = sticking_distance(loop.mechanism, plan.surfaces[-1], size, law)
        return off if off > self.objective.terminal_radius else 0.0

    def _stiffer(self, state: CascadeState, loop: ClosedLoop, plan: Plan) -> tuple[Plan, ...]:
        """The plan itself, its surfaces reached sooner, as far as no joint sticks with it."""
        plans = stiffer(plan, self.reaching)
        return tuple(one for one in plans if not self._sticks(state, loop, one))

    def ask(self, loop: ClosedLoop, old: Plan, new: Plan, x: FloatArray, span: float) -> Admission:
        """What the gate says of a plan, in the place of an old one."""
        said = self.gate(loop, old, new, x, span)
        if not isinstance(said, Admission):
            raise InvalidInputError(
                "what the gate of the cascade returned",
                value=f"{said!r}, {a_kind(said)}",
                limit="an undertow.cascade.Admission",
                remedy="Return one: of undertow.cascade.cost_gate, with conditions of your own",
            )
        return said

    def first(self, state: CascadeState, error: FloatArray, span: float) -> Admission:
        """Put the first plan before the gate: there is no other, so it is used all the same."""
        loop, plan = self.predictions.at(state, state.since), state.plan
        if self.mendable(state, loop, plan, error, span):
            loop = self.predictions.estimated_at(state)
        asked = self.ask(loop, plan, plan, error, span)
        reason = "first optimum" if asked.accepted else f"first optimum, although {asked.reason}"
        return Admission(True, reason, state.predicted, asked.verdict)

    def decide(
        self, state: CascadeState, proposal: Proposal, error: FloatArray, span: float
    ) -> tuple[CascadeState, Admission]:
        """Return the state with the plan that stays in use, and what is said of the proposal.

        ``error`` is how far the present state is off the target.
        """
        t = proposal.computed_for
        jump = self._jump(state, t, error)
        loop = self.predictions.at(state, t)
        used, soon = state.at(t), self.soon(state, error, t, span)
        there = self._expected(state, t) if self._doubts else None
        old = self.standing(replace(state, since=t), loop, used, error, span, soon)
        state = replace(
            state, plan=old, since=t, sequence=proposal.sequence, x=as_numbers(error), ahead=None
        )
        mends, mended = (
            plan is not None and self.mendable(state, loop, plan, error, soon)
            for plan in (old, proposal.plan)
        )
        judge = self.predictions.estimated_at(state) if mends or mended else loop
        if proposal.plan is None or (mends and not mended):
            kept = self.ask(judge, old, old, error, span)
            reason = f"{proposal.status}: {proposal.message or 'no surface'}{jump}"
            if proposal.plan is not None:
                reason = f"some plausible plant would not come home after another period{jump}"
            admission = replace(kept, accepted=False, reason=reason)
            predicted = self._predicted(state, old, error, span, kept.cost)
            return replace(state, predicted=predicted), _reserved(admission, old, used)
        admission = self.ask(judge, old, proposal.plan, error, span)
        if admission.accepted:
            doubted = there if old is used else None
            words = (
                self._gains_little(state, judge, admission.cost, error, doubted, span)
                or self._in_haste(state, loop, old, proposal.plan, error, span, soon)
                or self._frees_too_late(state, loop, proposal.plan)
                or self._breaks_sooner(state, proposal.plan, error, span)
            )
            if words:
                cost = self.ask(loop, old, old, error, span).cost
                admission = Admission(False, words, cost)
        if state.target is not None and state.target.moves:
            admission = self._along(state, old, proposal.plan, admission, span)
        admission = replace(admission, reason=f"{admission.reason}{jump}")
        plan = proposal.plan if admission.accepted else old
        predicted = self._predicted(state, plan, error, span, admission.cost)
        return replace(state, plan=plan, predicted=predicted), _reserved(admission, plan, used)

    def _predicted(
        self, state: CascadeState, plan: Plan, error: FloatArray, span: float, cost: float
    ) -> float:
        """What a plan in use is predicted to cost: on the estimate where it does not suit all."""
        if cost < math.inf:
            return cost
        return self.ask(self.predictions.estimated_at(state), plan, plan, error, span).cost

    def _along(
        self, state: CascadeState, old: Plan, new: Plan, admission: Admission, span: float
    ) -> Admission:
        """Judge again what the gate admitted: both plans along the reference, as it will move."""
        assert state.target is not None  # there is no reference without one
        loop, error = self.predictions.plausible(state.estimate), np.array(state.x)
        plans = [old, new] if admission.accepted else [old]
        costs = costs_along(loop, error, plans, state.target, state.since, span)
        if not admission.accepted:
            return replace(admission, cost=costs[0])
        cost, found = costs
        if found <= cost and found < math.inf:
            return replace(admission, cost=found)
        words = f"raises the cost along the reference: {found:.6g} > {cost:.6g}"
        return Admission(False, words, cost, admission.verdict)

    def _jump(self, state: CascadeState, t: float, x: FloatArray) -> str:
        """Say how far a state is off what the plan in use predicted for it, where it is far."""
        if not state.x or not 0 <= t - state.since <= self.objective.horizon:
            return ""
        step = self.predictions.prior.step
        span = round((t - state.since) / step) * step
        loop = self.predictions.at(state, state.since)
        ahead = loop.batch(state.x, state.plan, duration=span, terminal=0.0).x[0]
        n = len(x) // 2
        off = float(np.linalg.norm((x - ahead)[:n]))
        moved = float(np.linalg.norm((ahead - state.x)[:n]))
        if not off > JUMP + PART * moved:  # a prediction that ended in NaN says nothing
            return ""
        return f"; the state is {off:.3g} off the plan's prediction: after a jump, call start again"

    def survives(self, loop: ClosedLoop, error: FloatArray, plan: Plan) -> bool:
        """Whether every plausible plant lives to see the next decisions with a plan."""
        event = loop.batch(error, plan, duration=2 * self.period).event[0]
        return event in (Event.HORIZON, Event.REACHED)


def _moved(loop: ClosedLoop, plan: Plan, x: tuple[float, ...], past: float) -> FloatArray:
    """Where a plan brings the state x, (2n,), in a time, s; NaN where the motion breaks off."""
    motion = loop.batch(np.array(x), plan, duration=past, terminal=0.0, precise=True)
    return np.asarray(motion.x[0])


def _reserved(admission: Admission, plan: Plan, used: Plan) -> Admission:
    """The admission of the plan that stays; where one in reserve took over, that is admitted."""
    if admission.accepted or plan is used:
        return admission
    return replace(admission, accepted=True, reason=f"a plan in reserve: {admission.reason}")
