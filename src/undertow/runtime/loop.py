"""The fast loop against the clock: read, think, write, log; and a watchdog beside it."""

from __future__ import annotations

import contextlib
import gc
import math
import sys
import threading
from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from undertow.errors import InvalidInputError
from undertow.mechanism import FloatArray
from undertow.rig.interface import Measurement, Rig
from undertow.runtime.clock import YIELD, Clock, Histogram, WallClock, prompt
from undertow.runtime.controller import Controller, Inputs
from undertow.runtime.encoding import answer_row
from undertow.runtime.log import Log
from undertow.runtime.modes import Command, Mode
from undertow.runtime.slow import Answer, Worker, is_answer

__all__ = ["Report", "Runtime"]


#: Time before a step is due at which the shadow rehearses, s.
REHEARSAL = 1.5e-4

#: Steps between two collections of what is young.
COLLECT = 10_000

#: Events that are kept at most.
EVENTS = 10_000


@dataclass(eq=False)
class Report:
    """What came of a run.

    Attributes
    ----------
    steps, missed
        Steps made, and steps that ended after their period: output, what follows it, log.
    asleep
        Missed steps that took less than a period, but were woken too late.
    skipped
        Periods in which no step was made, because an earlier one took too long.
    think, whole, late, rest
        Time of the fast step's own computation between reading and writing; from when the
        step was due to when its output was written; to when it began; and what follows the
        output: answers judged, requests made, rows of the log copied.
    shadowed, disagreed
        Steps that the shadow made again, and those in which its output was another.
    mode, stopped_by
        State at the end, and why the run stopped, if it did.
    entered
        How often each state was entered.
    answers
        Verdicts on the answers of the slow loop, in a few words each, with their numbers.
    events
        Everything that happened: (t, what, text).
    variation
        Total variation of the inputs, Σ|u_k − u_{k−1}|, (m,).
    """

    steps: int = 0
    missed: int = 0
    asleep: int = 0
    skipped: int = 0
    think: Histogram = field(default_factory=Histogram)
    whole: Histogram = field(default_factory=Histogram)
    late: Histogram = field(default_factory=Histogram)
    rest: Histogram = field(default_factory=Histogram)
    shadowed: int = 0
    disagreed: int = 0
    mode: Mode = Mode.IDLE
    stopped_by: str = ""
    entered: Counter[str] = field(default_factory=Counter)
    answers: Counter[str] = field(default_factory=Counter)
    events: list[tuple[float, str, str]] = field(default_factory=list)
    variation: FloatArray = field(default_factory=lambda: np.zeros(0))


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
    shadow
        A second controller, built as the first.  It makes every step again, one step behind,
        in the last moments before the next one is due: that brings code and data back into
        the processor's caches, and shows at once when the same inputs give other outputs.

    Raises
    ------
    InvalidInputError
        For a rig with another period than the controller.
    """

    def __init__(
        self,
        controller: Controller,
        rig: Rig,
        worker: Worker,
        *,
        clock: Clock | None = None,
        log: Log | None = None,
        shadow: Controller | None = None,
    ) -> None:
        if not math.isclose(rig.period, controller.period, rel_tol=1e-9):
            raise InvalidInputError(
                "period of the rig",
                value=f"{rig.period:g} s",
                limit=f"that of the controller, {controller.period:g} s",
                remedy="Give both the same one: Recipe(period=...)",
            )
        self.shadow = shadow
        self._behind: deque[tuple[Inputs, FloatArray]] = deque(maxlen=1000)
        self.controller, self.rig, self.worker = controller, rig, worker
        self.clock = WallClock() if clock is None else clock
        self.log = log
        self.report = Report(variation=np.zeros_like(controller.u))
        self._stopping, self._silent = False, ""
        self._unread = self._unwritten = 0.0
        self._beat = self._origin = self.clock.now()

    def stop(self) -> None:
        """Ask for a safe stop, as an operator does: from anywhere, also before the run."""
        self._stopping = True

    def run(self, seconds: float) -> Report:
        """Run from start to a safe stop; the operator's stop comes after ``seconds``.

        The loop ends once a safe stop has brought the output to zero.

        Raises
        ------
        InvalidInputError
            When it has run already: its rig has been let go of.
        """
        if self.report.steps:
            raise InvalidInputError(
                "second run of a runtime",
                value=f"stopped by {self.report.stopped_by}",
                limit="one run: the rig has been let go of",
                remedy="Make another session",
            )
        with _quiet_interpreter(self.clock), self._watchdog():
            try:
                self._loop(seconds)
            finally:
                self._beat = float("inf")
                with contextlib.suppress(Exception):  # a rig that failed may fail again
                    self.rig.close()
        report, controller = self.report, self.controller
        report.mode, report.stopped_by = controller.mode, controller.stopped_by
        return report

    def _loop(self, seconds: float) -> None:
        clock, period, report = self.clock, self.controller.period, self.report
        think, whole, late, rest = report.think, report.whole, report.late, report.rest
        stall = self.controller.settings.stall
        origin = self._origin = clock.now()
        k, slot, alarm, before = 0, 0, "", self.controller.u.copy()
        while True:
            due = origin + slot * period
            self._wait(due)
            last, began = self._beat, clock.now()
            self._beat = began
            t = began - origin
            if k > 0 and began - last > stall:
                alarm = f"no step for {1e3 * (began - last):.0f} ms"
            command = Command.START if k == 0 else Command.NONE
            if (self._stopping or t >= seconds) and self.controller.mode != Mode.SAFE_STOP:
                command = Command.STOP
            measurement, alarm = self._read(alarm)
            read = clock.now()
            inputs = Inputs(t, measurement, self._take(t), command, alarm)
            u = self.controller.decide(inputs)
            thought = clock.now()
            alarm = self._write(u)
            written = clock.now()
            self.controller.follow_up()
            try:
                self._after(k, inputs)
                if self.log is not None:
                    self._record(self.log, k, began, due, (read, thought, written), inputs)
            except Exception as error:  # the output must come to zero before the loop may end
                alarm = alarm or f"{type(error).__name__}: {error}"
            if self.shadow is not None:
                self._behind.append((inputs, u.copy()))
            np.abs(u - before, out=before)
            report.variation += before
            before[:] = u
            late.add(began - due)
            think.add(thought - read)
            whole.add(written - due)
            ended = clock.now()
            rest.add(ended - written)
            k += 1
            report.steps = k
            if k % COLLECT == 0 and not clock.simulated:
                gc.collect(0)  # what an exception leaves behind; some microseconds
            if self.controller.mode == Mode.SAFE_STOP and (self._silent or not u.any()):
                break
            slot += 1
            over = (ended - origin) / period - slot
            if over > 0:
                report.missed += 1
                report.asleep += ended - began < period
                report.skipped += int(over)
                slot += int(over)

    def _wait(self, due: float) -> None:
        """Wait for the next step; shortly before, let the shadow make the last one again."""
        shadow, clock, behind = self.shadow, self.clock, self._behind
        if shadow is None:
            clock.sleep_until(due)
            return
        clock.sleep_until(due - REHEARSAL)
        while behind and clock.now() < due - 0.4 * REHEARSAL:
            inputs, u = behind.popleft()
            self.report.shadowed += 1
            self.report.disagreed += not np.array_equal(shadow.step(inputs), u)
        clock.spin_until(due)

    def _read(self, alarm: str) -> tuple[Measurement | None, str]:
        """Read the rig; one that fails gives nothing, and one that keeps failing is an alarm."""
        if not self._silent:  # else the watchdog has let go of it
            try:
                measurement = _own(self.rig.read(), self.controller.x.shape[0] // 2)
                self._unread = 0.0
                return measurement, self._silent or alarm
            except Exception as error:
                what = f"read: {type(error).__name__}: {error}"
            self._unread += self.controller.period
            self._tell("rig", what)
            if self._unread > self.controller.settings.patience:
                alarm = alarm or f"the rig gave nothing for {1e3 * self._unread:.0f} ms, {what}"
        return None, self._silent or alarm

    def _take(self, t: float) -> Answer | None:
        """Take an answer of the slow loop; what is none is not looked at."""
        try:
            answer = self.worker.take(t)
        except Exception as error:
            self._tell("optimiser", f"{type(error).__name__}: {error}")
            return None
        if answer is None or is_answer(answer):
            return answer
        self._tell("optimiser", f"no whole answer, a {type(answer).__name__}")
        return None

    def _write(self, u: FloatArray) -> str:
        """Write to the rig; one that keeps failing is an alarm for the next step."""
        if self._silent:
            return self._silent
        try:
            self.rig.write(u.copy())  # the rig may keep it, or change it
        except Exception as error:
            self._unwritten += self.controller.period
            what = f"write: {type(error).__name__}: {error}"
            self._tell("rig", what)
            return what if self._unwritten > self.controller.settings.patience else ""
        self._unwritten = 0.0
        return ""

    def _tell(self, what: str, text: str) -> None:
        t, events = self._beat - self._origin, self.report.events
        if len(events) < EVENTS:
            events.append((t, what, text))
        if self.log is not None:
            self.log.event(self.report.steps, t, what, text)

    def _after(self, k: int, inputs: Inputs) -> None:
        """Hand requests to the slow loop, and keep what happened."""
        controller, report, log = self.controller, self.report, self.log
        try:
            if controller.gives_up and not self.worker.replace():
                self._tell("optimiser", "nobody is left to take over: the last plan stays")
            if controller.request is not None:
                self.worker.ask(controller.request)
        except Exception as error:
            self._tell("optimiser", f"{type(error).__name__}: {error}")
        if log is not None:
            if inputs.command:
                log.event(k, inputs.t, "command", inputs.command.name)
            if inputs.alarm:
                log.event(k, inputs.t, "alarm", inputs.alarm)
            if inputs.answer is not None:
                log.answer(partial(answer_row, k, inputs.answer))
        for note in controller.notes:
            self._tell(note.kind, note.text)
            if note.kind == "state":
                report.entered[controller.mode.name] += 1
            else:
                report.answers[note.text.split(": ", 1)[1].split(",")[0].split(" by ")[0]] += 1

    def _record(
        self,
        log: Log,
        k: int,
        began: float,
        due: float,
        stamps: tuple[float, float, float],
        inputs: Inputs,
    ) -> None:
        row, at, controller = log.row, log.columns, self.controller
        measurement = inputs.measurement
        row[0], row[1], row[2] = k, inputs.t, began
        row[3], row[4] = controller.mode, controller.memory.sequence
        if measurement is None:
            row[5] = row[at.q] = row[at.v] = np.nan
        else:
            row[5] = measurement.t
            row[at.q] = measurement.q
            row[at.v] = np.nan if measurement.v is None else measurement.v
        row[at.x], row[at.s] = controller.x, controller.s
        row[at.demand], row[at.u] = controller.demand, controller.u
        read, thought, written = stamps
        row[-5], row[-4] = controller.margin[0], 1e6 * (began - due)
        row[-3], row[-2] = 1e6 * (read - began), 1e6 * (thought - read)
        row[-1] = 1e6 * (written - thought)
        log.commit_row()

    @contextlib.contextmanager
    def _watchdog(self) -> Iterator[None]:
        """Watch the heart of the fast loop from another thread; let go of a rig that hangs."""
        if self.clock.simulated:
            yield
            return
        over, stall = threading.Event(), self.controller.settings.stall

        def watch() -> None:
            while not over.wait(0.25 * stall):
                silence = self.clock.now() - self._beat
                if silence > 2.0 * stall:
                    self._silent = f"watchdog: the fast loop was silent for {1e3 * silence:.0f} ms"
                    with contextlib.suppress(Exception):
                        self.rig.close()
                    return

        thread = threading.Thread(target=watch, name="undertow watchdog", daemon=True)
        self._beat = self.clock.now()
        thread.start()
        try:
            yield
        finally:
            over.set()


def _own(measurement: Measurement, n: int) -> Measurement:
    """Return a copy that the rig cannot change any more, of numbers in the right shape."""
    q = np.array(measurement.q, dtype=float)
    v = None if measurement.v is None else np.array(measurement.v, dtype=float)
    for values in (q,) if v is None else (q, v):
        if values.shape != (n,):
            message = f"a measurement of shape {values.shape}, not ({n},)"
            raise ValueError(message)
    return Measurement(float(measurement.t), q, v)


@contextlib.contextmanager
def _quiet_interpreter(clock: Clock) -> Iterator[None]:
    """Keep the interpreter from pausing the loop: no collections but those that the loop makes.

    Old objects are frozen; other threads yield quickly, and wait while the loop works.
    The fast loop also asks for a real-time priority, where the system grants it.
    """
    if clock.simulated:
        yield
        return
    interval, collecting = sys.getswitchinterval(), gc.isenabled()
    sys.setswitchinterval(YIELD)  # the clock goes on with it
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        with prompt():
            yield
    finally:
        gc.unfreeze()
        if collecting:
            gc.enable()
        sys.setswitchinterval(interval)
