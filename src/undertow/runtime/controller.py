"""The fast step as a pure state machine: what went in decides what comes out.

It holds no clock, no thread and no file.  The runtime gives it a time, a measurement, an
answer of the slow loop, the operator's wish and an alarm; all of these are in the log, so
that the log can be replayed bit for bit.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from undertow.cascade import Cascade, CascadeState
from undertow.estimators.interface import Estimator
from undertow.inner_loop import law_module
from undertow.mechanism import FloatArray
from undertow.rig.interface import Measurement
from undertow.runtime.modes import Command, Mode, Signs, successor
from undertow.runtime.sensors import SensorWatch
from undertow.runtime.settings import Settings
from undertow.runtime.slow import Answer, Request, lanes_of
from undertow.runtime.steps import confine, off_by, sound

__all__ = ["Controller", "Inputs", "Note"]


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


@dataclass(frozen=True, slots=True)
class Note:
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
        Measurements to states.
    period
        Of the fast loop, s.
    settings
        Limits and patience.
    swing_up
        u = swing_up(t, x), used outside the region of the law; ``None``: the law waits
        until the mechanism is brought there.
    region
        Whether the law may take over at x; by default wherever it exists with the margin
        of the settings.

    Attributes
    ----------
    u, x, s, demand
        Of the last step: output (m,), estimate (2n,), surface values (m,), unlimited law (m,).
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
        swing_up: Callable[[float, FloatArray], FloatArray] | None = None,
        region: Callable[[FloatArray], bool] | None = None,
    ) -> None:
        mechanism = cascade.mechanism
        settings = Settings() if settings is None else settings
        n, m = mechanism.n, mechanism.m
        self.cascade, self.estimator, self.period = cascade, estimator, period
        self.settings, self.swing_up, self.region = settings, swing_up, region
        self.limits = settings.limits(mechanism)
        slew = settings.slew(mechanism) * period
        self.slew = np.where(np.isfinite(slew), slew, np.inf)
        self.u, self.demand, self.s, self.margin = (np.zeros(k) for k in (m, m, m, 1))
        self.x = np.zeros(2 * n)
        self._of_u, self._swing = np.r_[m:n, n + m : 2 * n], np.zeros(2 * (n - m))
        self.mode, self.stopped_by = Mode.IDLE, ""
        self.memory = memory
        self.notes: list[Note] = []
        self.request: Request | None = None
        self.gives_up = False
        self.sensors = SensorWatch(mechanism, settings, period)
        self._law = law_module(mechanism, cascade.reaching.switching).step
        self._law_limits, self._parameters = mechanism.input_limits, mechanism.parameter_values
        self._wanted, self._zero = np.zeros(m), np.zeros(m)
        self._scratch = (np.zeros(m), np.zeros(m), np.zeros(m), np.zeros(1))
        self._signs = Signs(swings=swing_up is not None)
        self._install(memory, lanes_of(cascade, memory.plan))
        self._asked: Request | None = None
        self._pending: Answer | None = None
        self._sound = 0.0
        self._lead = settings.lead

    # -- one step --------------------------------------------------------------------------

    def step(self, inputs: Inputs) -> FloatArray:
        """Return the output of this step, (m,); never raises, never NaN, within limits.

        The array is written over by the next step.
        """
        self.notes.clear()
        self.request, self.gives_up = None, False
        try:
            self._think(inputs)
        except Exception as error:  # whatever it was, the output goes to zero within its slew
            self._stop(f"{type(error).__name__}: {error}")
        confine(self._wanted, self.u, self.limits, self.slew)
        return self.u

    def _think(self, inputs: Inputs) -> None:
        t, signs = inputs.t, self._signs
        fault = inputs.alarm or self._observe(inputs.measurement)
        np.take(self.x, self._of_u, out=self._swing)
        self._evaluate(t)
        free = True  # one thing a step: what is rare is also slow
        if self._pending is not None and t >= self._pending.use - 0.5 * self.period:
            self._use(self._pending)
            self._evaluate(t)
            free = False
        if inputs.answer is not None:
            self._receive(t, inputs.answer)
            free = False
        radius = math.sqrt(float(self.x @ self.x))
        margin = self.margin[0]
        signs.command, signs.fault = inputs.command, fault
        self._sound = 0.0 if fault or self.sensors.missing else self._sound + self.period
        signs.ready = self._sound >= self.settings.settle
        allowed = margin > self.settings.margin
        signs.inside = allowed and (self.region is None or self.region(self.x))
        signs.lost = not allowed or not radius < self.cascade.loop.escape
        near = self.settings.near * (2.0 if self.mode == Mode.BALANCE else 1.0)
        signs.settled = float(self._swing @ self._swing) <= near * near
        self._change(t, *successor(self.mode, signs))
        self._wanted[:] = self._zero
        if self.mode in (Mode.CATCH, Mode.BALANCE):
            np.multiply(self.sensors.band, 2.0 * self.sensors.probe, out=self._wanted)
            self._wanted += self.demand
            if free:
                self._ask(t)
        elif self.mode == Mode.SWING_UP and self.swing_up is not None:
            self._wanted[:] = self.swing_up(t, self.x)

    def _observe(self, measurement: Measurement | None) -> str:
        """Update the estimate; return what is wrong with the sensors, or with the estimate."""
        if self.mode == Mode.IDLE:
            self.sensors.forget()
        checked, fault = self.sensors.check(measurement, self.x, self.u)
        if checked is None:
            return fault
        if self.sensors.first:
            start = np.zeros_like(self.x)
            start[: checked.q.shape[0]] = checked.q
            self.estimator.reset(start)
        x = self.estimator.estimate(checked, self.u)
        if not math.isfinite(float(x @ x)):
            return fault or "the estimate is not finite"
        self.x[:] = x
        return fault or self.sensors.beyond(self.x)

    def _evaluate(self, t: float) -> None:
        """Evaluate the law in use at the estimate."""
        elapsed = t - self.memory.since + 1e-9
        times = self._times
        while self._segment + 1 < len(times) and elapsed >= times[self._segment + 1]:
            self._segment += 1
        self._law(
            self.x,
            self._lanes[self._segment],
            self._parameters,
            self._law_limits,
            self._scratch[0],
            self.demand,
            self.s,
            self.margin,
        )

    def _change(self, t: float, mode: Mode, reason: str) -> None:
        if mode == self.mode:
            return
        self.notes.append(Note("state", f"{self.mode.name} → {mode.name}: {reason}"))
        if mode == Mode.SAFE_STOP:
            self.stopped_by = reason
        if mode == Mode.CATCH and self.mode in (Mode.BRING_UP, Mode.SWING_UP):
            self.memory = replace(self.memory, since=t)  # a schedule starts with the catch
            self._segment = 0
        self.mode = mode

    def _stop(self, reason: str) -> None:
        self._wanted[:] = 0.0
        if self.mode != Mode.SAFE_STOP:
            self._change(0.0, Mode.SAFE_STOP, reason)

    # -- the slow loop ---------------------------------------------------------------------

    def _ask(self, t: float) -> None:
        """Ask for the next proposal, or give up on one that is long overdue."""
        if self._asked is not None:
            if t > self._asked.use + self.settings.silence:
                self.notes.append(Note("answer", f"{self._asked.sequence}: never came"))
                self._number(self._asked.sequence)
                self._asked, self.gives_up = None, True
                self._plan_ahead(1.5)
            return
        if self._pending is None:
            self._asked = self.request = Request(t, self.x.copy(), t + self._lead, self.memory)

    def _plan_ahead(self, factor: float) -> None:
        """Change how far ahead proposals are computed, in whole steps of the predictions."""
        step, settings = self.cascade.step, self.settings
        most = max(settings.lead, settings.longest_lead)
        lead = max(settings.lead, min(most, factor * self._lead))
        self._lead = math.ceil(lead / step - 1e-9) * step

    def _number(self, sequence: int) -> None:
        """Let the next request have a higher number."""
        self.memory = replace(self.memory, sequence=max(self.memory.sequence, sequence))

    def _receive(self, t: float, answer: Answer) -> None:
        """Keep an answer for its time of use, or refuse it: the first line of defence."""
        fault = self._unfit(t, answer)
        if fault:
            self.notes.append(Note("answer", f"{answer.sequence}: refused, {fault}"))
            if self._asked is not None and answer.sequence == self._asked.sequence:
                if t > self._asked.use:
                    self._plan_ahead(1.5)
                self._number(answer.sequence)
                self._asked = None
        else:
            if answer.use - t > 0.5 * self._lead:
                self._plan_ahead(0.9)
            self._asked, self._pending = None, answer

    def _unfit(self, t: float, answer: Answer) -> str:
        if self._asked is None or answer.sequence != self._asked.sequence:
            known = answer.sequence <= self.memory.sequence or self._pending is not None
            return "stale, out of order or twice" if known else "not asked for"
        if t > self._asked.use + 0.5 * self.period:
            return f"late by {1e3 * (t - self._asked.use):.1f} ms"
        lanes = answer.lanes
        plan = answer.memory.plan
        if lanes.shape != (len(plan.times), self._lanes.shape[1]) or not sound(lanes):
            return "not a plan for this mechanism"
        if answer.use != self._asked.use or answer.memory.sequence != answer.sequence:
            return "not what was asked for"
        return ""

    def _use(self, answer: Answer) -> None:
        """Put an answer to use at its time, if the state is the one it was made for."""
        self._pending = None
        off = off_by(self.x, answer.x)
        u, demand, s, margin = self._scratch
        self._law(self.x, answer.lanes[0], self._parameters, self._law_limits, u, demand, s, margin)
        if not answer.admission.accepted:
            verdict = f"kept the old plan, {answer.admission.reason}"
        elif not off <= self.settings.surprise:
            verdict = f"refused, the state is off its prediction by {off:.2g}"
        elif not margin[0] > self.settings.margin:
            verdict = f"refused, det Γ(q)/det Γ(0) would be {margin[0]:.2g}"
        else:
            self._install(answer.memory, answer.lanes)
            self.notes.append(Note("answer", f"{answer.sequence}: applied, off by {off:.2g}"))
            return
        self._number(answer.sequence)
        self.notes.append(Note("answer", f"{answer.sequence}: {verdict}"))

    def _install(self, memory: CascadeState, lanes: FloatArray) -> None:
        self.memory, self._lanes, self._times, self._segment = memory, lanes, memory.plan.times, 0
