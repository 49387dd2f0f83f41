"""The fast step as a pure state machine: what went in decides what comes out.

It holds no clock, no thread and no file.  The runtime gives it a time, a measurement, an
answer of the slow loop, the operator's wish and an alarm; all of these are in the log, so
that the log can be replayed bit for bit.

A step has two parts.  :meth:`Controller.decide` gives the output.  What can wait until that is
written comes after it, in :meth:`Controller.follow_up`: to judge an answer that has arrived
(its time of use is later), to ask for the next one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from undertow.base import error_text
from undertow.cascade import Admission, Cascade, CascadeState, Legs
from undertow.cascade.swing_up import SwingUpAndCatch
from undertow.estimators import Estimator
from undertow.law import InnerLoop, ReferenceMotion
from undertow.law.reference import reference_row
from undertow.models import FloatArray, error_dynamics
from undertow.optimiser import Proposal
from undertow.plants import Measurement
from undertow.plants.interface import copy_numbers
from undertow.runtime.modes import Command, Mode, Reason
from undertow.runtime.plan_check import PlanCheck
from undertow.runtime.sensors import LAST_HARMLESS, SensorMonitor
from undertow.runtime.settings import Settings
from undertow.runtime.slow_loop import Answer, LeadTime, Request, law_vectors_of
from undertow.runtime.steps import (
    BEYOND_TRAVEL,
    all_finite,
    limit_output,
    relative_error,
    step_memory,
    step_module,
)

#: Least and longest time from asking for a catch to its use, s; and how far the state may be off
#: the one it was made for, in units of 1 + |entry|.
CATCH_LEAD, MOST_CATCH_LEAD, CATCH_PREDICTION_ERROR = 0.02, 0.1, 0.1

#: Time from asking for the first plan to another target to its use, s: a global search; and the
#: most that it grows to, when answers are late.
JUMP_LEAD, MOST_JUMP_LEAD = 1.0, 8.0

#: Time after which a target is asked for again for which no plan was found, s.
JUMP_RETRY = 1.0

#: Least time from a jump of the velocities to the use of the next plan, s: one search.
EARLY_LEAD = 0.02

#: How the reason begins for which an answer is refused that no sound slow loop gives.
UNSOUND = "unsound: "


@dataclass(slots=True)
class Inputs:
    """Everything that a step depends on besides the memory of the controller.

    ``t``: time of the step, s. ``measurement``: ``None`` when the rig failed. ``answer``: of the
    slow loop, one that has arrived. ``alarm``: what the runtime itself found wrong (a stall, failed
    writes, deadlines missed, a clock that runs wrong); stops the run. ``target``: another one that
    was asked for meanwhile: when it jumps, s after this step, and where to. It takes the place of
    what was asked for before and has not been reached.
    """

    t: float
    measurement: Measurement | None
    answer: Answer | None = None
    command: Command = Command.NONE
    alarm: str = ""
    target: Legs = ()


class Note(NamedTuple):
    """Something that happened in a step: a change of state, a verdict on an answer."""

    kind: str
    text: str


class Controller:
    """The controller of a run.

    Parameters
    ----------
    cascade
        Law, optimiser and gate.
    memory
        What the cascade starts with, from :meth:`undertow.Cascade.start`.
    estimator
        Measurements to states.  What it knows of a matched disturbance is taken off the output;
        the parameters that it learns are the law's, and what the next request is planned with.
    period
        Of the fast loop, s.
    settings
        Limits and timeouts.
    swing_up
        Brings the mechanism up, and says from where it may be caught; the slow loop is asked for
        the surface that catches it.  ``None``: the law waits until the mechanism is brought
        near its target.
    legs
        When the target jumps, s, and where to, the first at 0: what the cascade started with.  One
        of them may move: its acceleration is fed forward from step to step.  The
        target jumps when the first plan to it is there, not before; with a swing-up not before it
        balances at x = 0, and the first of them, too.

    Attributes
    ----------
    u, x, s, demand
        Of the last step: output (m,), estimate (2n,), surface values (m,), unlimited law (m,).
    wrapped
        The estimate less whole turns of freely turning joints: what the law acts on, (2n,).
    margin
        det Γ(q)/det Γ(0) of the last step, (1,).
    mode, stopped_by
        State, and why the last safe stop was made.
    reference
        The target that moves, if one does.
    notes
        What happened in the last step.
    request
        What the last step asks of the slow loop.
    optimiser_timed_out
        Whether the last step gave up on the present computation of the slow loop.
    """

    def __init__(
        self,
        cascade: Cascade,
        memory: CascadeState,
        estimator: Estimator,
        *,
        period: float,
        settings: Settings | None = None,
        swing_up: SwingUpAndCatch | None = None,
        legs: Legs = (),
    ) -> None:
        mechanism = cascade.mechanism
        settings = Settings() if settings is None else settings
        self.cascade, self.estimator, self.period = cascade, estimator, period
        self.settings, self.swing_up = settings, swing_up
        lost = math.inf if swing_up is None else swing_up.lost
        self._fall_angle = min(settings.fall_angle, lost)
        moving = [motion for _, motion in legs if motion.moves]
        self.reference = moving[0] if moving else None
        acted_on = error_dynamics(mechanism) if moving else mechanism
        fast = step_memory(acted_on, settings, period, self._fall_angle)
        self._block = fast.block
        own = len(mechanism.parameters)
        self._parameters: FloatArray = fast["parameters"][:own]
        self._row: FloatArray = fast["parameters"][own:]
        self._learning: Estimator | None = None
        self._jumps, self._early = 0, False
        if cascade.learns_from(estimator):
            self._learning = estimator
            self._bears = InnerLoop(mechanism, memory.surface, cascade.reaching)
        self.u: FloatArray = fast["output"]
        self.x, self.wrapped, self.s = fast["x"], fast["wrapped"], fast["s"]
        self.demand, self.margin = fast["demand"], fast["margin"]
        self.limits, self.slew = fast["limits"], fast["slew"]
        self._turn, self._wanted = fast["turn"], fast["wanted"]
        limit_output(
            self._wanted, self.u, self.limits, self.slew
        )  # compiled before a stop needs it
        self._act = step_module(acted_on, cascade.reaching.switching).act
        self._swings = swing_up is not None
        self.mode, self.stopped_by = Mode.IDLE, ""
        self.memory = memory
        self.notes: list[Note] = []
        self.request: Request | None = None
        self.optimiser_timed_out = False
        self.sensors = SensorMonitor(mechanism, settings, period)
        self._names = [c.name for c in mechanism.coordinates]
        self._plans = PlanCheck(mechanism, cascade.reaching)
        self._law_vectors, self._times = law_vectors_of(cascade, memory), memory.plan.times
        self._segment, self._law_vector = 0, self._law_vectors[0]
        self._next = memory, self._law_vectors, self._times
        self._packed = self._law_vectors
        self._since = fast["since"]
        self._expected, self._off = fast["expected"], fast["off"]
        self._estimate, self._disturbance = np.zeros_like(self.x), np.zeros_like(self.u)
        self._max_error = self._due = 0.0
        self._asked: Request | None = None
        self._pending: Answer | None = None
        self._arrived: Answer | None = None
        self._used: Answer | None = None
        self._followed, self._free, self._t = True, False, 0.0
        self._sequence, self._began = memory.sequence, 0.0
        self._gains, self._swinging, self._look = 0, 0.0, 0.0
        most = max(settings.lead_time, settings.max_lead_time)
        self._lead = LeadTime(settings.lead_time, most, cascade.step)
        self._catch_lead = LeadTime(CATCH_LEAD, MOST_CATCH_LEAD, cascade.step)
        self._jump_lead = JUMP_LEAD
        self._jump_error = relative_error(self.x, self.x)  # compiled before a step needs it
        self._ahead, self._not_before = list(legs[1:]), 0.0
        if swing_up is not None and legs and legs[0][1].q.any():
            self._ahead.insert(0, legs[0])
        self._turns: FloatArray = np.zeros_like(self.x)
        self._told: Legs = ()
        if memory.target is not None:
            self._turn[:] = memory.target.state(0.0)
        if self.reference is not None:
            self._follow(0.0, memory.target or self.reference)  # compiled before a step needs it

    # -- one step --------------------------------------------------------------------------

    def step(self, inputs: Inputs) -> FloatArray:
        """Return the output of this step, (m,): :meth:`decide`, then :meth:`follow_up`."""
        self.decide(inputs)
        self.follow_up()
        return self.u

    def decide(self, inputs: Inputs) -> FloatArray:
        """Return the output of this step, (m,); never raises, never NaN, within limits.

        The array is written over by the next step.
        """
        if not self._followed:
            self.follow_up()
        self._followed = False
        if self.notes:
            self.notes.clear()
        self.request, self.optimiser_timed_out = None, False
        self._t, self._free, self._told = inputs.t, False, inputs.target
        try:
            self._compute(inputs)
        except Exception as error:  # whatever it was, the output goes to zero within its slew
            self._stop(error_text(error))
            limit_output(self._wanted, self.u, self.limits, self.slew)
        return self.u

    def follow_up(self) -> None:
        """Do what could wait: judge the answer that has arrived, or ask for the next one."""
        self._followed = True
        answer, self._arrived = self._arrived, None
        used, self._used = self._used, None
        try:
            if used is not None:
                self._note_outcome(used)
            if self._learning is not None:
                self._believe(self._learning.parameters)
            if self._jumped():
                self._take_reserve(self._t)
            if self._told:
                self._retarget(self._t, self._told)
            if answer is not None:
                self._take_answer(self._t, answer)
            elif self._free:
                self._ask(self._t)
        except Exception as error:
            self._stop(error_text(error))

    def _jumped(self) -> bool:
        """Whether velocities have jumped in this step."""
        before, self._jumps = self._jumps, self.estimator.jumps
        return self._jumps > before and self.mode in (Mode.CATCH, Mode.BALANCE)

    def _take_reserve(self, t: float) -> None:
        """Have the next step go on with the plan in reserve; another one comes soon.

        What was asked for before is for a motion that is no more.  A plan for another target, which
        takes a while, is waited for.
        """
        asked, pending = self._asked, self._pending
        if (asked is not None and asked.target is not None) or (
            pending is not None and pending.jump
        ):
            return
        if asked is not None:
            self._close(asked.sequence)
        number, use = self._sequence + 1, t + self.period
        plan = self.cascade.after_jump(self.memory, self.wrapped)
        before, why = self.memory, "a plan in reserve: the velocities have jumped"
        memory = replace(before, plan=plan, since=use, sequence=number, x=())
        proposal = Proposal(plan, "budget spent", math.inf, math.inf, (), 0, 0.0, number, use)
        self._packed, self._early = self._plans.pack(plan), True
        self._pending = Answer(
            number, use, self.wrapped.copy(), proposal, Admission(True, why, math.inf), before,
            memory, self._packed, 0.0,
        )  # fmt: skip
        self._make_ready(self._pending)
        self.notes.append(Note("jump", "the velocities have jumped: a plan in reserve takes over"))

    def _believe(self, learnt: FloatArray) -> None:
        """Have the next step go on with what is learnt, if the surface in use bears it."""
        if math.isfinite(self.margin[0]):
            self._bears.lane[:] = self._law_vector
            if self._bears.believe(learnt, self.wrapped, self.settings.min_margin):
                self._parameters[:] = learnt

    def _compute(self, inputs: Inputs) -> None:
        t, sensors, mode, pending = inputs.t, self.sensors, self.mode, self._pending
        self._arrived = inputs.answer
        if mode is Mode.IDLE:
            sensors.forget()
        accepted, found, sensor = sensors.check(inputs.measurement, self.x, self.u)
        estimate = self.x
        if accepted is not None:
            if sensors.first:
                self.estimator.reset(np.concatenate([accepted.q, np.zeros_like(accepted.q)]))
            estimate = self._estimate  # one's own estimator may return anything
            copy_numbers(self.estimator.estimate(accepted, self.u), estimate, "estimated state")
            copy_numbers(self.estimator.disturbance, self._disturbance, "estimated disturbance")
            if self._learning is not None and sensors.first:
                values = self.cascade.mechanism.parameter_values
                self._parameters[:] = self._bears.parameters[:] = values
        if self._segment + 1 < len(self._times):
            self._proceed(t)
        new, most, jumps = self._law_vector, -1.0, False
        due = pending is not None and t >= self._due
        if due:
            new, most = self._next[1][0], self._max_error
            if mode is Mode.SWING_UP and self.swing_up is not None:
                self._turns[:] = self._turn[:] = self.swing_up.region.turns(estimate)
            if pending is not None and pending.jump:
                jumps = self._aim(pending, estimate)
                most = most if jumps else -1.0
        if self.reference is not None:
            self._follow(t, self._next[0].target if jumps else self.memory.target)
        waited = ""
        if mode is Mode.BRING_UP and t - self._began > self.settings.bring_up_timeout:
            waited = self._waiting()
        used, number, why, wrong, place = self._act(
            estimate,
            self._disturbance,
            self._law_vector,
            new,
            most,
            self._block,
            mode.value,
            inputs.command.value,
            found > LAST_HARMLESS or waited != "" or inputs.alarm != "",
            sensors.missing > 0,
            self._swings,
            sensors.probe,
        )
        self._free = not due
        if due:
            self._used, self._pending = pending, None
            if used:
                self.memory, self._law_vectors, self._times = self._next
                self._segment, self._law_vector = 0, new
            self._landed(pending, used)
        if why:
            reason = Reason(why).text
            if why == Reason.FAULT:
                reason = inputs.alarm or sensors.describe(found, sensor)
                reason = reason or waited or self._describe(wrong, place)
            elif why == Reason.THROWN_OUT:
                reason = f"{reason}: {self._why_thrown_out()}"
            self._change(t, Mode(number), reason)
            mode = self.mode
        if mode is Mode.SWING_UP:
            assert self.swing_up is not None  # else nothing leads to this state
            self._wanted[:] = self.swing_up.swing(self.x, self._gains_in_use(t))
            limit_output(self._wanted, self.u, self.limits, self.slew)
        elif mode is not Mode.BALANCE and mode is not Mode.CATCH:
            self._free = False

    def _aim(self, answer: Answer, estimate: FloatArray) -> bool:
        """Count the state from the new target, if it is near the one that the answer is for."""
        target = answer.memory.target
        assert target is not None  # a jump brings one
        there = self._turns + target.state(answer.use)
        self._jump_error = relative_error(estimate - there, self._expected)
        near = self._jump_error <= self._max_error
        if near:
            self._turn[:] = there
        return near

    def _landed(self, answer: Answer | None, used: bool) -> None:
        """Note that the target has jumped, or count from the old one again."""
        if answer is None or not answer.jump:
            return
        if used:
            begin, _ = self._ahead.pop(0)
            self.notes.append(Note("target", f"jumps, asked for at {begin:g} s"))
        else:
            target = self.memory.target
            self._turn[:] = self._turns + (0.0 if target is None else target.state(self._t))

    def _follow(self, t: float, target: ReferenceMotion | None) -> None:
        """Count the state from where a reference is at the time t, and feed its motion forward."""
        self._row[:] = 0.0
        if target is not None and self.mode is not Mode.SWING_UP:
            reference_row(t, target.t, target.q, target.v, target.a, self._row)
            self._turn[:] = self._turns
            self._turn += self._row[: len(self._turn)]

    @property
    def aim(self) -> FloatArray:
        """Positions of the target that was asked for last and whose time has come, (n,)."""
        due = [motion for begin, motion in tuple(self._ahead) if begin <= self._t]
        target = due[-1] if due else self.memory.target
        return np.zeros(len(self.x) // 2) if target is None else np.array(target.position(self._t))

    @property
    def ahead(self) -> Legs:
        """When the target was asked to jump, or will be, s, and where to: what is still to come."""
        return tuple(self._ahead)

    def _retarget(self, t: float, legs: Legs) -> None:
        """Go for what was asked for meanwhile; what is planned for another jump is given up."""
        self._told = ()
        self._ahead, self._not_before = [(t + begin, motion) for begin, motion in legs], t
        asked, pending = self._asked, self._pending
        if asked is not None and asked.target is not None:
            self._close(asked.sequence)
        if pending is not None and pending.jump:
            self._sequence, self._pending = max(self._sequence, pending.sequence), None
        for begin, motion in self._ahead:
            places = zip(self._names, motion.position(begin), strict=True)
            where = ", ".join(f"{name} = {value:g}" for name, value in places if value)
            self.notes.append(Note("target", f"asked for at {begin:g} s: {where or 'x = 0'}"))

    def _describe(self, wrong: int, place: int) -> str:
        """Return in words what a step found wrong with the estimate."""
        if wrong == BEYOND_TRAVEL:
            return f"'{self._names[place]}' at {self.x[place]:.3g}, past its travel"
        return "the estimate is not finite"

    def _waiting(self) -> str:
        """Return in words what a bring-up waited for in vain."""
        settings = self.settings
        what = f"no {1e3 * settings.sensor_settling_time:g} ms of sound readings"
        if self._since[0] >= settings.sensor_settling_time:
            what = f"not where the law can take over, {self._free_positions()}"
        lacking = self.sensors.worst(self._t - self._began)
        what = f"{what} within {settings.bring_up_timeout:g} s"
        return f"bring-up: {what}{lacking and f'; {lacking}'}"

    def _why_thrown_out(self) -> str:
        """Return in words what the law cannot hold at the present state."""
        m = len(self.u)
        coordinates, away = self.cascade.mechanism.coordinates[m:], np.abs(self.wrapped[m:])
        for c, angle in zip(coordinates, away, strict=False):
            if c.unit == "rad" and angle > self._fall_angle:
                return f"{c.name} is {angle:.3g} rad off the target, past {self._fall_angle:.3g}"
        norm = float(np.linalg.norm(self.wrapped))
        if not norm < self.settings.max_state_norm:
            return f"‖x‖ = {norm:.3g}, past {self.settings.max_state_norm:g}"
        return f"the law is singular at {self._free_positions()}, (37)"

    def _free_positions(self) -> str:
        """Return in words where the coordinates are that are not driven."""
        m = len(self.u)
        pairs = zip(self._names[m:], self.wrapped[m:], strict=False)
        return ", ".join(f"{name} = {value:.3g}" for name, value in pairs)

    def _proceed(self, t: float) -> None:
        """Go on to the surface of a schedule that is in force at the time t."""
        elapsed, times = t - self.memory.since + 1e-9, self._times
        while self._segment + 1 < len(times) and elapsed >= times[self._segment + 1]:
            self._segment += 1
        self._law_vector = self._law_vectors[self._segment]

    def _change(self, t: float, mode: Mode, reason: str) -> None:
        if mode is self.mode:
            return
        self.notes.append(Note("state", f"{self.mode.name} → {mode.name}: {reason}"))
        if mode is Mode.SAFE_STOP:
            self.stopped_by = reason
        elif mode is Mode.BRING_UP:
            self._began = t
        elif mode is Mode.SWING_UP:
            self._swinging, self._look, self._pending = t, t, None
            if self.memory.target is not None:  # what catches does so at x = 0
                self._ahead.insert(0, (t, self.memory.target))
        elif mode is Mode.CATCH and self.mode is Mode.BRING_UP:
            self.memory = replace(self.memory, since=t)  # a schedule starts with the catch
            self._segment, self._law_vector = 0, self._law_vectors[0]
        self.mode = mode

    def _stop(self, reason: str) -> None:
        self._wanted[:] = 0.0
        self._free = False
        if self.mode is not Mode.SAFE_STOP:
            self._change(0.0, Mode.SAFE_STOP, reason)

    def _gains_in_use(self, t: float) -> int:
        """Which of the swing-up's gains are in use: others after a while without a catch."""
        assert self.swing_up is not None  # nothing else leads to this state
        if t - self._swinging > self.swing_up.patience:
            self._look = t
            self._go_on_with(self._gains + 1, t)
        return self._gains

    def _go_on_with(self, gains: int, t: float) -> None:
        """Go on with other gains of the swing-up."""
        assert self.swing_up is not None  # as above
        self._gains, self._swinging = gains, t
        count = len(self.swing_up.swing.gains)
        self.notes.append(Note("swing-up", f"goes on with gains {gains % count + 1} of {count}"))

    # -- the slow loop ---------------------------------------------------------------------

    def _ask(self, t: float) -> None:
        """Ask for the next proposal, or give up on one that is long overdue."""
        if self._asked is not None:
            if t > self._asked.use + self.settings.optimiser_timeout:
                self.notes.append(Note("answer", f"{self._asked.sequence}: never came"))
                self._was_late()
                self._close(self._asked.sequence)
                self.optimiser_timed_out = True
            return
        if self._pending is not None:
            return
        if self._learning is not None:
            learnt, felt = self._learning.learnt, tuple(self._learning.felt.tolist())
            self.memory = replace(
                self.memory, sequence=self._sequence, estimate=learnt, disturbance=felt
            )
        elif self.memory.sequence != self._sequence:
            self.memory = replace(self.memory, sequence=self._sequence)
        if self._jumps_next(t):
            begin, motion = self._ahead[0]
            step = self.cascade.step
            use = t + math.ceil(max(self._jump_lead, begin - t) / step - 1e-9) * step
            self._asked = Request(t, self.wrapped.copy(), use, self.memory, -1, motion)
        elif self.mode is not Mode.SWING_UP:
            lead = EARLY_LEAD if self._early else self._lead.seconds
            self._asked, self._early = Request(t, self.wrapped.copy(), t + lead, self.memory), False
        elif self.swing_up is not None and self._asks_in_a_swing(t, self.swing_up):
            use = t + self._catch_lead.seconds
            self._asked = Request(t, self.x.copy(), use, self.memory, self._gains_in_use(t))
        self.request = self._asked

    def _asks_in_a_swing(self, t: float, swing_up: SwingUpAndCatch) -> bool:
        """Whether a catch is within reach, or it is time to ask which gains lead to one."""
        if swing_up.worth_asking(self.x):
            return True
        if self._learning is None or t < self._look:
            return False
        self._look = t + swing_up.again
        return True

    def _jumps_next(self, t: float) -> bool:
        """Whether the next request is for a plan to another target."""
        if not self._ahead or t < self._not_before or self.mode is Mode.SWING_UP:
            return False
        early = t < self._ahead[0][0] - self._jump_lead - 2 * self._lead.seconds
        return not early and (self.swing_up is None or self.mode is Mode.BALANCE)

    @property
    def _lead_in_use(self) -> LeadTime:
        return self._catch_lead if self.mode is Mode.SWING_UP else self._lead

    def _was_late(self) -> None:
        """Ask the next time farther ahead for what came late this time."""
        if self._ahead and self._asked is not None and self._asked.target is not None:
            self._jump_lead = min(MOST_JUMP_LEAD, 2 * self._jump_lead)
        else:
            self._lead_in_use.late()

    def _close(self, number: int) -> None:
        """Ask for nothing any more: what had this number is answered, or given up."""
        self._sequence, self._asked = max(self._sequence, number), None

    def _take_answer(self, t: float, answer: Answer) -> None:
        """Keep an answer for its time of use, or refuse it: the first line of defence."""
        try:
            fault = self._mismatch(t, answer) or self._invalid(answer)
        except Exception as error:  # what came may be anything
            fault = f"{UNSOUND}{error_text(error)}"
        if fault:
            self.notes.append(Note("answer", f"{answer.sequence}: refused, {fault}"))
            if self._asked is not None and answer.sequence == self._asked.sequence:
                if t > self._asked.use:
                    self._was_late()
                self._close(answer.sequence)
        elif self._asked is not None and self._asked.target is not None and not answer.jump:
            self._close(answer.sequence)
            self._not_before = t + JUMP_RETRY
            why = answer.proposal.message
            self.notes.append(Note("answer", f"{answer.sequence}: kept the old plan, {why}"))
            self.notes.append(Note("target", f"stays, there is no plan for another: {why}"))
        else:
            if answer.use - t > 0.5 * self._lead.seconds and not answer.jump:
                self._lead_in_use.early()
            self._asked, self._pending = None, answer
            self._make_ready(answer)

    def _make_ready(self, answer: Answer) -> None:
        """Bring what the step of its use needs of an answer to where that step finds it."""
        memory = answer.memory
        self._due = answer.use - 0.5 * self.period
        self._next = memory, self._packed, memory.plan.times
        self._expected[:] = answer.x
        allowed = self.settings.max_prediction_error
        most = CATCH_PREDICTION_ERROR if answer.swing >= 0 else allowed
        self._max_error = most if answer.admission.accepted else -1.0

    def _mismatch(self, t: float, answer: Answer) -> str:
        if self._asked is None or answer.sequence != self._asked.sequence:
            known = answer.sequence <= self._sequence or self._pending is not None
            return "stale, out of order or twice" if known else "not asked for"
        if t > self._asked.use + 0.5 * self.period:
            return f"late by {1e3 * (t - self._asked.use):.1f} ms"
        law_vectors = answer.law_vectors
        plan = answer.memory.plan
        shape = len(plan.times), self._law_vectors.shape[1]
        if (
            law_vectors.shape != shape
            or answer.x.shape != self.x.shape
            or not all_finite(law_vectors)
        ):
            return f"{UNSOUND}not a plan for this mechanism"
        if answer.use != self._asked.use or answer.memory.sequence != answer.sequence:
            return f"{UNSOUND}not what was asked for"
        if (answer.swing < 0) != (self.mode is not Mode.SWING_UP):
            return "for another state"
        return ""

    def _invalid(self, answer: Answer) -> str:
        """Pack the law's numbers anew from the plan that was judged, and test its stability.

        What runs are these numbers: those that came must be the same.  det Γ(0), their last,
        is not compared, for it is not taken from the answer at all.
        """
        if not answer.admission.accepted:
            return ""  # its plan is not used
        if answer.memory.since != answer.use:
            return f"{UNSOUND}its plan is of another time"
        if not self._is_asked_target(answer):
            return f"{UNSOUND}its plan is for another target"
        plan, known = answer.memory.plan, self.cascade.known
        asked = None if self._asked is None else self._asked.memory.estimate
        if known is not None and asked is not None:
            self._plans.believe(known.values(asked.offset))
        self._packed = self._plans.pack(plan)
        if not np.array_equal(self._packed[:, :-1], answer.law_vectors[:, :-1]):
            return f"{UNSOUND}its numbers are not those of its plan"
        fault = self._plans.fault(self._packed)
        return fault and f"{UNSOUND}{fault}"

    def _is_asked_target(self, answer: Answer) -> bool:
        """Whether an answer's plan is for the target that was asked for, to the bit."""
        found, asked = answer.memory.target, self._asked
        if asked is None or answer.jump != (asked.target is not None):
            return False
        wanted = asked.target if answer.jump else asked.memory.target
        if answer.swing >= 0:  # what catches does so at x = 0
            wanted = None
        if found is None or wanted is None:
            return found is wanted
        pairs = ((found.t, wanted.t), (found.q, wanted.q), (found.v, wanted.v), (found.a, wanted.a))
        return found is wanted or all(np.array_equal(a, b) for a, b in pairs)

    def _note_outcome(self, answer: Answer) -> None:
        """Note what became of an answer at its time of use."""
        if answer.gains != answer.swing == self._gains and self.mode is Mode.SWING_UP:
            self._go_on_with(answer.gains, self._t)
        (off, margin), most = self._off.tolist(), self._max_error
        if answer.jump and not self._jump_error <= most:
            off = self._jump_error
        self._sequence = max(self._sequence, answer.sequence)
        if not answer.admission.accepted:
            verdict = f"kept the old plan, {answer.admission.reason}"
        elif not off <= most:
            verdict = f"refused, the state is off its prediction by {off:.2g}"
            self._early = answer.swing < 0 and not answer.jump
        elif not margin > self.settings.min_margin:
            verdict = f"refused, det Γ(q)/det Γ(0) would be {margin:.2g}"
        else:
            verdict = f"applied, off by {off:.2g}"
        self.notes.append(Note("answer", f"{answer.sequence}: {verdict}"))
