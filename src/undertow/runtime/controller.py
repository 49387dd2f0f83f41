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

from undertow.cascade import Cascade, CascadeState
from undertow.estimators.compensation import take_off
from undertow.estimators.interface import Estimator
from undertow.inner_loop import law_memory, law_module
from undertow.mechanism import FloatArray
from undertow.rig.interface import Measurement
from undertow.runtime.modes import Command, Mode, Signs, successor
from undertow.runtime.sensors import SensorWatch
from undertow.runtime.settings import Settings
from undertow.runtime.slow import Answer, Request, lanes_of
from undertow.runtime.steps import apart, confine, farthest, off_by, settle, sound
from undertow.swing_up import SwingUpAndCatch

__all__ = ["Controller", "Inputs", "Note"]

#: Least time from asking for a catch to its use, s; and how far the state may be off the one
#: it was made for, in units of 1 + |entry|.
CATCH_LEAD, CATCH_SURPRISE = 0.02, 0.1


@dataclass(slots=True)
class Inputs:
    """Everything that a step depends on besides the memory of the controller.

    Attributes
    ----------
    t
        Time of the step, s.
    measurement
        What the rig said, ``None`` when it failed.
    answer
        An answer of the slow loop that has arrived.
    command
        The operator's wish.
    alarm
        What the runtime itself found wrong (a stall, a failed write); stops the run.
    """

    t: float
    measurement: Measurement | None
    answer: Answer | None = None
    command: Command = Command.NONE
    alarm: str = ""


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
        Measurements to states.  What it knows of a matched disturbance is taken off the output.
    period
        Of the fast loop, s.
    settings
        Limits and patience.
    swing_up
        Brings the mechanism up, and says from where it may be caught; the slow loop is asked for
        the surface that catches it.  ``None``: the law waits until the mechanism is brought
        near its target.

    Attributes
    ----------
    u, x, s, demand
        Of the last step: output (m,), estimate (2n,), surface values (m,), unlimited law (m,).
    home
        The estimate less whole turns of freely turning joints: what the law acts on, (2n,).
    margin
        det Γ(q)/det Γ(0) of the last step, (1,).
    mode, stopped_by
        State, and why the last safe stop was made.
    notes
        What happened in the last step.
    request
        What the last step asks of the slow loop.
    gives_up
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
    ) -> None:
        mechanism = cascade.mechanism
        settings = Settings() if settings is None else settings
        n, m = mechanism.n, mechanism.m
        self.cascade, self.estimator, self.period = cascade, estimator, period
        self.settings, self.swing_up = settings, swing_up
        self.limits = settings.limits(mechanism)
        slew = settings.slew(mechanism) * period
        self.slew = np.where(np.isfinite(slew), slew, np.inf)
        self.u, self.x, self.home = np.zeros(m), np.zeros(2 * n), np.zeros(2 * n)
        law = law_memory(mechanism)
        self.demand, self.s, self.margin = law["demand"], law["s"], law["margin"]
        self._law = law_module(mechanism, cascade.reaching.switching).step
        self._block, self._limited = law.block, law["u"]
        self._turn, self._of_u = np.zeros(2 * n), np.r_[m:n, n + m : 2 * n]
        units = [c.unit for c in mechanism.coordinates]
        self._angles = np.array([i for i in range(m, n) if units[i] == "rad"], dtype=np.int64)
        self.mode, self.stopped_by = Mode.IDLE, ""
        self.memory = memory
        self.notes: list[Note] = []
        self.request: Request | None = None
        self.gives_up = False
        self.sensors = SensorWatch(mechanism, settings, period)
        self._wanted = np.zeros(m)
        self._signs = Signs(swings=swing_up is not None)
        self._install(memory, lanes_of(cascade, memory.plan))
        self._asked: Request | None = None
        self._pending: Answer | None = None
        self._arrived: Answer | None = None
        self._used: tuple[Answer, float, float, float] | None = None
        self._followed, self._free, self._t = True, False, 0.0
        self._sequence = memory.sequence
        self._sound = self._swinging = 0.0
        self._lead = settings.lead
        self._catch_lead = CATCH_LEAD

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
        self.request, self.gives_up = None, False
        self._t, self._free = inputs.t, False
        try:
            self._think(inputs)
        except Exception as error:  # whatever it was, the output goes to zero within its slew
            self._stop(f"{type(error).__name__}: {error}")
        confine(self._wanted, self.u, self.limits, self.slew)
        return self.u

    def follow_up(self) -> None:
        """Do what could wait: judge the answer that has arrived, or ask for the next one."""
        self._followed = True
        answer, self._arrived = self._arrived, None
        used, self._used = self._used, None
        try:
            if used is not None:
                self._tell(*used)
            if answer is not None:
                self._receive(self._t, answer)
            elif self._free:
                self._ask(self._t)
        except Exception as error:
            self._stop(f"{type(error).__name__}: {error}")

    def _think(self, inputs: Inputs) -> None:
        t, signs = inputs.t, self._signs
        self._arrived = inputs.answer
        fault = inputs.alarm or self._observe(inputs.measurement)
        caught = False
        pending = self._pending
        if pending is not None and t >= pending.use - 0.5 * self.period:
            caught = self._use(t, pending)  # and the law is evaluated
        else:
            self._evaluate(t)
            self._free = True
        mode, settings, home = self.mode, self.settings, self.home
        signs.command, signs.fault = inputs.command, fault
        self._sound = 0.0 if fault or self.sensors.missing else self._sound + self.period
        signs.ready = self._sound >= settings.settle
        margin = float(self.margin[0])
        allowed = margin > settings.margin
        signs.inside = caught if self.swing_up is not None else allowed
        swing, far = apart(home, self._of_u)
        signs.lost = not allowed or not far < settings.escape or self._thrown_out()
        signs.settled = swing <= settings.near * (2.0 if mode is Mode.BALANCE else 1.0)
        self._change(t, *successor(mode, signs))
        mode = self.mode
        if mode is Mode.CATCH or mode is Mode.BALANCE:
            take_off(self.demand, self.estimator.disturbance, self.limits, self._wanted)
            if self.sensors.probe:
                self._wanted += 2.0 * self.sensors.probe * self.sensors.band
        elif mode is Mode.SWING_UP and self.swing_up is not None:
            self._wanted[:] = self.swing_up.swing(self.x, self._choice(t))
        else:
            self._wanted[:] = 0.0
            self._free = False

    def _thrown_out(self) -> bool:
        """Whether a free angle is where no law holds it, or swinging up again is better."""
        lost = self.settings.lost if self.swing_up is None else self.swing_up.lost
        return farthest(self.home, self._angles) > lost

    def _observe(self, measurement: Measurement | None) -> str:
        """Update the estimate; return what is wrong with the sensors, or with the estimate."""
        if self.mode is Mode.IDLE:
            self.sensors.forget()
        checked, fault = self.sensors.check(measurement, self.x, self.u)
        if checked is None:
            return fault
        if self.sensors.first:
            start = np.zeros_like(self.x)
            start[: checked.q.shape[0]] = checked.q
            self.estimator.reset(start)
        x = self.estimator.estimate(checked, self.u)
        if not settle(x, self._turn, self.x, self.home):
            return fault or "the estimate is not finite"
        return fault or self.sensors.beyond(self.x)

    def _evaluate(self, t: float) -> None:
        """Evaluate the law in use at the estimate."""
        times = self._times
        if self._segment + 1 < len(times):
            elapsed = t - self.memory.since + 1e-9
            while self._segment + 1 < len(times) and elapsed >= times[self._segment + 1]:
                self._segment += 1
        self._law(self.home, self._lanes[self._segment], self._block)

    def _change(self, t: float, mode: Mode, reason: str) -> None:
        if mode is self.mode:
            return
        self.notes.append(Note("state", f"{self.mode.name} → {mode.name}: {reason}"))
        if mode is Mode.SAFE_STOP:
            self.stopped_by = reason
        elif mode is Mode.SWING_UP:
            self._swinging, self._pending = t, None
        elif mode is Mode.CATCH and self.mode is Mode.BRING_UP:
            self.memory = replace(self.memory, since=t)  # a schedule starts with the catch
            self._segment = 0
        self.mode = mode

    def _stop(self, reason: str) -> None:
        self._wanted[:] = 0.0
        self._free = False
        if self.mode is not Mode.SAFE_STOP:
            self._change(0.0, Mode.SAFE_STOP, reason)

    def _choice(self, t: float) -> int:
        """Which of the swing-up's gains are in use: others after a while without a catch."""
        assert self.swing_up is not None  # nothing else leads to this state
        return int((t - self._swinging) / self.swing_up.patience)

    # -- the slow loop ---------------------------------------------------------------------

    def _ask(self, t: float) -> None:
        """Ask for the next proposal, or give up on one that is long overdue."""
        if self._asked is not None:
            if t > self._asked.use + self.settings.silence:
                self.notes.append(Note("answer", f"{self._asked.sequence}: never came"))
                self._sequence = max(self._sequence, self._asked.sequence)
                self._asked, self.gives_up = None, True
                self._plan_ahead(1.5)
            return
        if self._pending is not None:
            return
        if self.memory.sequence != self._sequence:
            self.memory = replace(self.memory, sequence=self._sequence)
        if self.mode is not Mode.SWING_UP:
            self._asked = Request(t, self.home.copy(), t + self._lead, self.memory)
        elif self.swing_up is not None and self.swing_up.worth_asking(self.x):
            use = t + self._catch_lead
            self._asked = Request(t, self.x.copy(), use, self.memory, self._choice(t))
        self.request = self._asked

    def _plan_ahead(self, factor: float) -> None:
        """Change how far ahead proposals are computed, in whole steps of the predictions."""
        step, settings = self.cascade.step, self.settings
        most = max(settings.lead, settings.longest_lead)
        if self.mode is Mode.SWING_UP:
            lead = max(CATCH_LEAD, min(0.1, factor * self._catch_lead))
            self._catch_lead = math.ceil(lead / step - 1e-9) * step
            return
        lead = max(settings.lead, min(most, factor * self._lead))
        self._lead = math.ceil(lead / step - 1e-9) * step

    def _receive(self, t: float, answer: Answer) -> None:
        """Keep an answer for its time of use, or refuse it: the first line of defence."""
        fault = self._unfit(t, answer)
        if fault:
            self.notes.append(Note("answer", f"{answer.sequence}: refused, {fault}"))
            if self._asked is not None and answer.sequence == self._asked.sequence:
                if t > self._asked.use:
                    self._plan_ahead(1.5)
                self._sequence = max(self._sequence, answer.sequence)
                self._asked = None
        else:
            if answer.use - t > 0.5 * self._lead:
                self._plan_ahead(0.9)
            self._asked, self._pending = None, answer

    def _unfit(self, t: float, answer: Answer) -> str:
        if self._asked is None or answer.sequence != self._asked.sequence:
            known = answer.sequence <= self._sequence or self._pending is not None
            return "stale, out of order or twice" if known else "not asked for"
        if t > self._asked.use + 0.5 * self.period:
            return f"late by {1e3 * (t - self._asked.use):.1f} ms"
        lanes = answer.lanes
        plan = answer.memory.plan
        if lanes.shape != (len(plan.times), self._lanes.shape[1]) or not sound(lanes):
            return "not a plan for this mechanism"
        if answer.use != self._asked.use or answer.memory.sequence != answer.sequence:
            return "not what was asked for"
        if (answer.swing < 0) != (self.mode is not Mode.SWING_UP):
            return "for another state"
        return ""

    def _use(self, t: float, answer: Answer) -> bool:
        """Put an answer to use at its time, if the state is the one it was made for.

        The law in use afterwards is evaluated; whether it was a catch is returned.  What is
        to be told of it is told in :meth:`follow_up`.
        """
        self._pending = None
        swinging, most = answer.swing >= 0, self.settings.surprise
        if swinging:
            assert self.swing_up is not None  # else nothing was asked in this state
            self._turn[:] = self.swing_up.region.turns(self.x)
            settle(self.x, self._turn, self.x, self.home)
            most = CATCH_SURPRISE
        off, margin = off_by(self.home, answer.x), math.nan
        if answer.admission.accepted and off <= most:
            self._law(self.home, answer.lanes[0], self._block)
            margin = float(self.margin[0])
        self._used = answer, off, most, margin
        if margin > self.settings.margin:
            self._install(answer.memory, answer.lanes)
            return swinging
        self._evaluate(t)
        return False

    def _tell(self, answer: Answer, off: float, most: float, margin: float) -> None:
        """Note what became of an answer at its time of use."""
        self._sequence = max(self._sequence, answer.sequence)
        if not answer.admission.accepted:
            verdict = f"kept the old plan, {answer.admission.reason}"
        elif not off <= most:
            verdict = f"refused, the state is off its prediction by {off:.2g}"
        elif not margin > self.settings.margin:
            verdict = f"refused, det Γ(q)/det Γ(0) would be {margin:.2g}"
        else:
            verdict = f"applied, off by {off:.2g}"
        self.notes.append(Note("answer", f"{answer.sequence}: {verdict}"))

    def _install(self, memory: CascadeState, lanes: FloatArray) -> None:
        self.memory, self._lanes, self._times, self._segment = memory, lanes, memory.plan.times, 0
