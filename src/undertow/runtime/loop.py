"""The fast loop against the clock: read, think, write, log; and a watchdog beside it."""

from __future__ import annotations

import contextlib
import gc
import math
import sys
import threading
from collections import deque
from collections.abc import Iterator, Mapping
from functools import partial

import numpy as np

from undertow.base import InvalidInputError, a_kind, checked, error_text
from undertow.cascade import Legs
from undertow.law import SetPoints
from undertow.models import FloatArray, invariant_coordinates
from undertow.plants import Measurement, OutputOnError, Rig
from undertow.plants.interface import copied
from undertow.runtime.clock import (
    SECOND,
    YIELD,
    Clock,
    FailureRatio,
    RigClock,
    WallClock,
    locked_memory,
    real_time_priority,
)
from undertow.runtime.controller import UNSOUND, Controller, Inputs
from undertow.runtime.encoding import TOLD, Stamps, answer_row, legs_to
from undertow.runtime.log import Log
from undertow.runtime.modes import Command, Mode
from undertow.runtime.processes import Background, resource_errors
from undertow.runtime.slow_loop import Answer, Request, is_answer
from undertow.runtime.steps import limit_output, stage_module
from undertow.runtime.targets import RunTarget, legs_from_here, named_positions
from undertow.runtime.verdict import Report
from undertow.runtime.workers import Worker

#: How long before a step is due the lockstep check makes the last one again, s.
LOCKSTEP_TIME = 1.5e-4

#: Steps between two collections of what is young.
COLLECT = 10_000

#: Events that are kept at most.
EVENTS = 10_000

#: Memory that is held back for the way to zero, bytes.
RESERVE = 4 << 20


class Runtime:
    """Runs a controller on a rig.

    Parameters
    ----------
    controller
        The pure fast step.
    rig
        The plant.
    worker
        Who answers the requests of the fast step; closed by the caller.
    clock
        The wall clock by default.
    log
        Where everything goes; closed by the caller.
    lockstep
        A second controller, built as the first.  It makes every step again, one step behind,
        in the last moments before the next one is due: that brings code and data back into
        the processor's caches, and shows at once when the same inputs give other outputs.

    Attributes
    ----------
    deaf
        Why it takes no targets from other processes; empty where it does.

    Raises
    ------
    InvalidInputError
        For a rig with another period than the controller.
    """

    def __init__(
        self,
        controller: Controller,
        rig: Rig,
        worker: Worker[Request, Answer],
        *,
        clock: Clock | None = None,
        log: Log | None = None,
        lockstep: Controller | None = None,
    ) -> None:
        if not math.isclose(rig.period, controller.period, rel_tol=1e-9):
            raise InvalidInputError(
                "period of the rig",
                value=f"{rig.period:g} s",
                limit=f"that of the controller, {controller.period:g} s",
                remedy="Give both the same one: Recipe(period=...)",
            )
        self.lockstep = lockstep
        self._behind: deque[tuple[Inputs, FloatArray]] = deque(maxlen=1000)
        self.controller, self.rig, self.worker = controller, rig, worker
        self.clock = WallClock() if clock is None else clock
        self.log = log
        settings, period = controller.settings, controller.period
        self.report = Report(
            total_variation=np.zeros_like(controller.u),
            target_radius=settings.target_radius,
            convergence_time=settings.convergence_time,
            unit=controller.cascade.objective.unit,
            log=log,
        )
        self._stopping, self._watchdog_alarm = False, ""
        self._asked_for: deque[Legs] = deque()
        self._asking = threading.Lock()
        self._said_of_target = ""
        self.deaf = "a run listens that has a log, against the wall clock"
        self._time_without_reading = self._time_without_write = 0.0
        self._reads, self._writes = (FailureRatio(settings.fault_window, period) for _ in range(2))
        self._overruns, self._rig_clock = FailureRatio(SECOND, period), RigClock(settings, period)
        self._written, self._released, self._lost = np.zeros_like(controller.u), False, 0
        mechanism = controller.cascade.mechanism
        self._stage = stage_module(mechanism, controller.cascade.objective).stage
        self._parameters = np.array(mechanism.parameter_values, dtype=float)
        self._rate, self._since, self._balanced = np.zeros(1), 0.0, 0.0
        self._reserve = b""
        self._heartbeat = self._origin = self.clock.now()
        self._waiting_since = math.inf

    @property
    def hangs(self) -> bool:
        """Whether the rig holds the run up: in its close, or since the watchdog let go of it."""
        return self.clock.now() - self._waiting_since > self.controller.settings.zero_output_timeout

    def stop(self) -> None:
        """Ask for a safe stop, as an operator does: from anywhere, also before the run."""
        self._stopping = True

    @checked
    def retarget(self, target: Mapping[str, float] | SetPoints) -> RunTarget:
        """Ask for another target, from another thread, while the run goes on or before.

        The fast loop takes it with its next step, and the target jumps once there is a plan for it.
        Another process asks by :func:`undertow.runtime.send_target`.

        Parameters
        ----------
        target
            Coordinates to positions, rad or m, or :class:`undertow.SetPoints` whose times count
            from now.  Coordinates that are not named stay where the target is; what was asked for
            before and has not been reached is given up.

        Raises
        ------
        InvalidInputError
            For a target that cannot be one, and when the run is over: nothing has changed then.
        """
        goal = target if isinstance(target, SetPoints) else SetPoints(target)
        controller, cascade = self.controller, self.controller.cascade
        with self._asking:
            if self._released or self._stopping or controller.mode is Mode.SAFE_STOP:
                raise InvalidInputError(
                    "target of a run",
                    value=f"the run has stopped: {controller.stopped_by or 'operator'}",
                    limit="one that goes on",
                    remedy="Start another one, with --target or target=",
                )
            before = self._asked_for
            here = before[-1][-1][1].q[0] if before else controller.aim
            legs = legs_from_here(
                cascade.mechanism, cascade.objective, controller.settings, here, goal
            )
            before.append(legs)
            return self._steered(legs)

    @property
    def target(self) -> RunTarget:
        """Where the run is steered: where the target is, and where it is to jump to."""
        return self._steered(())

    def _steered(self, new: Legs) -> RunTarget:
        controller, mechanism = self.controller, self.controller.cascade.mechanism
        t = max(0.0, min(self._heartbeat, self.clock.now()) - self._origin)
        target = controller.memory.target
        now = None if target is None else np.array(target.position(t))
        ahead = tuple((t + begin, motion) for begin, motion in new) or controller.ahead
        free = invariant_coordinates(mechanism)
        return RunTarget(
            mechanism.name,
            {c.name: c.unit for c in mechanism.coordinates if c.name in free},
            t,
            {} if now is None else named_positions(mechanism, now),
            tuple(
                (begin, named_positions(mechanism, np.array(motion.position(begin))))
                for begin, motion in ahead
            ),
            "" if new else self._said_of_target,
        )

    def run(self, seconds: float) -> Report:
        """Run from start to a safe stop, which comes after ``seconds`` by itself.

        The run ends once a safe stop has brought the output to zero: the device is asked to take
        zero until it does, for ``Settings.zero_output_timeout`` at most, and is closed.  Whether it
        did is in the report and in its verdict.  An interrupt that a driver lets through counts as
        the operator's stop; other ways out of the interpreter are taken after the safe stop.

        Raises
        ------
        InvalidInputError
            When it has run already: its rig has been let go of.
        ResourceError
            When the system has no thread or memory left for the run.
        """
        if self.report.steps or self._released:
            raise InvalidInputError(
                "second run of a runtime",
                value=f"stopped by {self.report.stopped_by}",
                limit="one run: the rig has been let go of",
                remedy="Make another session",
            )
        try:
            with (
                resource_errors("a run"),
                _quiet_interpreter(self.clock) as self.report.system,
                self._watchdog(),
            ):
                self._reserve = bytes(RESERVE)
                try:
                    self._say_system()
                    self._loop(seconds)
                except BaseException as error:
                    self._loop_failed(error)
                    if not isinstance(error, Exception | KeyboardInterrupt):
                        raise
                finally:
                    self._release_rig()
        finally:
            self._release_rig()
        return self.report

    def _say_system(self) -> None:
        for text in self.report.system:
            self._log_event("system", text)

    def _loop_failed(self, error: BaseException) -> None:
        """Take down what ended the loop itself: its output comes to zero without it."""
        self._reserve = b""
        report, controller = self.report, self.controller
        reason = f"loop: {error_text(error)}"
        if isinstance(error, KeyboardInterrupt):
            reason, report.interrupted = "operator: interrupt", True
        if controller.mode is not Mode.SAFE_STOP:
            report.mode_before_stop = controller.mode
            controller.mode, controller.stopped_by = Mode.SAFE_STOP, reason
            self._log_event("state", f"{report.mode_before_stop.name} → SAFE_STOP: {reason}")

    def _release_rig(self) -> None:
        """Bring the output to zero, insist on it for a while, close the rig, and take down how.

        Also after the loop has failed, without its memory: nothing here needs much.
        """
        if self._released:
            return
        self._released, self._reserve = True, b""
        report, controller = self.report, self.controller
        failure = ""
        try:
            failure = self._bring_to_zero() if not report.output_zero else ""
        except BaseException as error:  # an interrupt: the rig is closed all the same
            failure = error_text(error)
        self._heartbeat = float("inf")
        output = (
            [] if report.output_zero else [f"the device did not take an output of zero: {failure}"]
        )
        if self._watchdog_alarm and report.output_zero:
            output.append(self._watchdog_alarm)
        self._waiting_since = self.clock.now()
        try:
            self.rig.close()
        except BaseException as error:  # a rig that failed may fail again
            output.append(f"close: {error_text(error)}")
            report.output_zero = report.output_zero and not isinstance(error, OutputOnError)
        self._waiting_since = math.inf
        report.output_problem = "; ".join(output)
        report.mode, report.stopped_by = controller.mode, controller.stopped_by
        report.final_error = float(np.linalg.norm(controller.wrapped))
        if report.output_problem:
            self._log_event("output", report.output_problem)

    def _bring_to_zero(self) -> str:
        """Write outputs down to zero within the slew rate until the device has taken zero.

        Returns what failed at last, once it was asked for ``Settings.zero_output_timeout`` in vain.
        """
        controller, clock, u = self.controller, self.clock, self._written
        zero, failure = np.zeros_like(u), ""
        due = began = clock.now()
        while True:
            if self._watchdog_alarm:
                return self._watchdog_alarm
            limit_output(zero, u, controller.limits, controller.slew)
            self._heartbeat = clock.now()
            try:
                self.rig.write(u.copy())
            except BaseException as error:  # it must come to zero whatever a driver does
                failure = error_text(error)
            else:
                if not u.any():
                    self.report.output_zero = True
                    return ""
            if not u.any() and clock.now() - began > controller.settings.zero_output_timeout:
                break
            due += controller.period
            clock.sleep_until(due)
        return f"asked for {controller.settings.zero_output_timeout:g} s, {failure}"

    def _loop(self, seconds: float) -> None:
        clock, period, report = self.clock, self.controller.period, self.report
        stall = self.controller.settings.max_step_interval
        origin = self._origin = clock.now()
        k, slot, alarm, before = 0, 0, "", self.controller.u.copy()
        limits = self.controller.settings
        while True:
            due = origin + slot * period
            self._wait(due)
            last, began = self._heartbeat, clock.now()
            self._heartbeat = began
            t = began - origin
            if k > 0 and began - last > stall:
                alarm = f"no step for {1e3 * (began - last):.0f} ms"
            command = Command.START if k == 0 else Command.NONE
            if (self._stopping or t >= seconds) and self.controller.mode != Mode.SAFE_STOP:
                command = Command.END if t >= seconds else Command.STOP
            measurement, alarm = self._read(alarm)
            read = clock.now()
            told = self._asked_for.popleft() if self._asked_for else ()
            inputs = Inputs(t, measurement, self._take(t), command, alarm, told)
            u = self.controller.decide(inputs)
            computed = clock.now()
            alarm = self._write(u)
            written = clock.now()
            self.controller.follow_up()
            try:
                self._follow_up(k, inputs)
                if self.log is not None:
                    stamps = Stamps(due, began, read, computed, written)
                    self.log.columns.fill(self.log.row, k, stamps, inputs, self.controller)
                    self.log.commit_row()
            except Exception as error:  # the output must come to zero before the loop may end
                alarm = alarm or error_text(error)
            if self.lockstep is not None:
                self._behind.append((inputs, u.copy()))
            np.abs(u - before, out=before)
            report.total_variation += before
            before[:] = u
            report.wakeup_delays.add(began - due)
            report.computation_times.add(computed - read)
            report.response_times.add(written - due)
            ended = clock.now()
            report.followup_times.add(ended - written)
            k += 1
            report.steps = k
            if k % COLLECT == 0 and not clock.simulated:
                gc.collect(0)  # what an exception leaves behind; some microseconds
            if self.controller.mode == Mode.SAFE_STOP and (self._watchdog_alarm or not u.any()):
                break  # and insist on zero, if the device has not taken it
            slot += 1
            over = (ended - origin) / period - slot
            skipped = int(over) if over > 0 else 0
            if over > 0:
                report.missed_deadlines += 1
                report.late_wakeups += ended - began < period
                report.skipped_periods += skipped
                slot += skipped
            self._overruns.add((over > 0) + skipped, 1 + skipped)
            if self._overruns.value > limits.max_deadline_miss_ratio:
                alarm = alarm or (
                    f"deadlines missed in {self._overruns.value:.0%} of the last second, "
                    f"the last step took {1e3 * (ended - began):.2g} ms of {1e3 * period:g} ms"
                )

    def _wait(self, due: float) -> None:
        """Wait for the next step; shortly before, make the last one again in lockstep."""
        lockstep, clock, behind = self.lockstep, self.clock, self._behind
        if lockstep is None:
            clock.sleep_until(due)
            return
        clock.sleep_until(due - LOCKSTEP_TIME)
        while behind and clock.now() < due - 0.4 * LOCKSTEP_TIME:
            inputs, u = behind.popleft()
            self.report.lockstep_steps += 1
            self.report.lockstep_mismatches += not np.array_equal(lockstep.step(inputs), u)
        clock.spin_until(due)

    def _read(self, alarm: str) -> tuple[Measurement | None, str]:
        """Read the rig; one that fails gives nothing, and one that fails much is an alarm."""
        if self._watchdog_alarm:  # the watchdog has let go of it
            return None, self._watchdog_alarm
        settings, measurement, what = self.controller.settings, None, ""
        try:
            measurement = copied(self.rig.read(), self.controller.x.shape[0] // 2)
        except Exception as error:
            what = f"read: {error_text(error)}"
            self._log_event("rig", what)
        if measurement is not None:
            self._time_without_reading = 0.0
            alarm = alarm or self._rig_clock.check(
                measurement.t, self._heartbeat, self.report.steps
            )
        else:
            self._time_without_reading += self.controller.period
            self.report.failed_reads += 1
        self._reads.add(measurement is None)
        if self._time_without_reading > settings.sensor_timeout:
            alarm = (
                alarm
                or f"the rig gave nothing for {1e3 * self._time_without_reading:.0f} ms, {what}"
            )
        elif self._reads.value > settings.max_failure_ratio and measurement is None:
            alarm = alarm or f"{self._reads.value:.0%} of the reads failed, {what}"
        return measurement, self._watchdog_alarm or alarm

    def _take(self, t: float) -> Answer | None:
        """Take an answer of the slow loop; what is none is not looked at."""
        try:
            answer = self.worker.take(t)
        except Exception as error:
            self._unreached(error_text(error))
            return None
        if answer is None or is_answer(answer):
            return answer
        self.report.invalid_answers += 1
        self._log_event("optimiser", f"no whole answer, {a_kind(answer)}")
        return None

    def _write(self, u: FloatArray) -> str:
        """Write to the rig; one that fails much is an alarm for the next step."""
        if self._watchdog_alarm:
            return self._watchdog_alarm
        report, settings, zero = self.report, self.controller.settings, not u.any()
        self._written[:] = u
        report.output_zero = (
            report.output_zero and zero
        )  # one that fails may have taken it all the same
        try:
            self.rig.write(u.copy())  # the rig may keep it, or change it
        except Exception as error:
            what = f"write: {error_text(error)}"
        else:
            self._time_without_write, report.output_zero = 0.0, zero
            self._writes.add(0)
            return ""
        self._time_without_write += self.controller.period
        self._writes.add(1)
        report.failed_writes += 1
        self._log_event("rig", what)
        if self._time_without_write > settings.sensor_timeout:
            return what
        if self._writes.value > settings.max_failure_ratio:
            return f"{self._writes.value:.0%} of the writes failed, {what}"
        return ""

    def _unreached(self, text: str) -> None:
        self.report.optimiser_failures += 1
        self._log_event("optimiser", text)

    def _log_event(self, what: str, text: str) -> None:
        t, events = self._heartbeat - self._origin, self.report.events
        if len(events) < EVENTS:
            events.append((t, what, text))
        if self.log is not None:
            try:
                self.log.event(self.report.steps, t, what, text)
            except Exception:  # what is said of a fault must not be another one
                self.log.dropped += 1

    def _follow_up(self, k: int, inputs: Inputs) -> None:
        """Hand requests to the slow loop, and keep what happened."""
        controller, report, log = self.controller, self.report, self.log
        try:
            if controller.optimiser_timed_out and not self.worker.replace():
                self._unreached("nobody is left to take over: the last plan stays")
            if controller.request is not None:
                self.worker.ask(controller.request)
        except Exception as error:
            self._unreached(error_text(error))
        if log is not None:
            if inputs.command:
                log.event(k, inputs.t, "command", inputs.command.name)
            if inputs.alarm:
                log.event(k, inputs.t, "alarm", inputs.alarm)
            if inputs.target:
                log.event(k, inputs.t, TOLD, legs_to(inputs.target))
            if inputs.answer is not None:
                log.answer(partial(answer_row, k, inputs.answer))
        for note in controller.notes:
            self._log_event(note.kind, note.text)
            if note.kind == "state":
                report.entered[controller.mode.name] += 1
                self._note_transition(note.text, inputs.t)
            elif note.kind == "target":
                self._said_of_target = note.text
            elif note.kind == "answer":
                report.invalid_answers += UNSOUND in note.text
                report.answers[note.text.split(": ", 1)[1].split(",")[0].split(" by ")[0]] += 1

        report.steps_with_missing_readings += controller.sensors.missing > 0
        report.cost += float(self._rate[0]) * (inputs.t - self._since)
        self._since = inputs.t
        self._stage(controller.wrapped, controller.u, self._parameters, self._rate)
        if log is not None and log.dropped > self._lost:
            if not self._lost:
                self._log_event("log", f"rows are lost: {log.failure or 'too slow a disk'}")
            self._lost = log.dropped

    def _note_transition(self, change: str, t: float) -> None:
        """Keep from a change of state what the verdict needs."""
        report, mode = self.report, self.controller.mode
        if mode is Mode.BALANCE:
            self._balanced = t
        elif mode is Mode.SAFE_STOP:
            report.mode_before_stop = Mode[change.partition(" → ")[0]]
            report.settled_time = (
                t - self._balanced if report.mode_before_stop is Mode.BALANCE else 0.0
            )

    @contextlib.contextmanager
    def _watchdog(self) -> Iterator[None]:
        """Watch the heart of the fast loop from another thread; let go of a rig that hangs."""
        if self.clock.simulated:
            yield
            return
        over, stall = threading.Event(), self.controller.settings.max_step_interval

        def watch() -> None:
            while not over.wait(0.25 * stall):
                silence = self.clock.now() - self._heartbeat
                if silence > 2.0 * stall:
                    self._watchdog_alarm = (
                        f"watchdog: the fast loop was silent for {1e3 * silence:.0f} ms"
                    )
                    self._waiting_since = self.clock.now()
                    with contextlib.suppress(Exception):
                        self.rig.close()
                    return

        self._heartbeat = self.clock.now()
        Background(watch, "undertow watchdog")
        try:
            yield
        finally:
            over.set()


@contextlib.contextmanager
def _quiet_interpreter(clock: Clock) -> Iterator[tuple[str, ...]]:
    """Keep the interpreter from pausing the loop: no collections but those that the loop makes.

    Old objects are frozen, until the end where nothing was frozen before; other threads yield
    quickly, and wait while the loop works.
    The fast loop also asks for a real-time priority and for its memory to stay where it is;
    yields what the system said to that.
    """
    if clock.simulated:
        yield ()
        return
    interval, collecting, frozen = sys.getswitchinterval(), gc.isenabled(), gc.get_freeze_count()
    sys.setswitchinterval(YIELD)  # the clock goes on with it
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        with real_time_priority() as priority, locked_memory() as memory:
            yield priority, memory
    finally:
        if not frozen:
            gc.unfreeze()
        if collecting:
            gc.enable()
        sys.setswitchinterval(interval)
