"""Systematic faults: the n-th call of every kind fails, once or from then on, for every n.

A run without a fault counts how often a short run makes each call.  Then every case is a run of
its own, and judged: what the device accepted last is zero, or the verdict says that it did not
accept it; the log opens, and its replay is identical.

The rigs are the ideal one and the realistic one; and the realistic one kept by a process of its
own (:mod:`undertow.runtime.supervisor`).  What happens at every step fails in simulated time;
forks, threads, files and syncs fail in a session against the clock, and so does all that
concerns the log where the rig is kept.
"""

from __future__ import annotations

import contextlib
import gc
import mmap
import multiprocessing
import signal
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field, replace
from functools import partial
from multiprocessing.process import BaseProcess
from pathlib import Path
from types import FrameType

import numpy as np

from undertow.base import Progress, UndertowError, each, error_text, no_progress, require
from undertow.cascade import CascadeState
from undertow.models import FloatArray
from undertow.plants import Measurement, Rig, RigWrapper
from undertow.runtime import (
    Answer,
    Columns,
    InlineWorker,
    Log,
    Recipe,
    Report,
    Request,
    Runtime,
    SimulatedClock,
    SupervisedRig,
    about,
    read_log,
    replay_controller,
    session,
    supervisor,
)
from undertow.runtime import log as logs
from undertow.runtime.processes import Background
from undertow.studies.fault_injection.cases import OutputMonitor
from undertow.studies.fault_injection.failing_calls import OPERATIONS, Fault, Tally, failing
from undertow.studies.fault_injection.simulated import drill_recipe

#: The rigs; the last one is kept by a process of its own.
RIGS = ("ideal", "realistic", "kept")

#: What fails in a session against the clock, on all rigs and on the kept one besides.
LIVE, LIVE_KEPT = ("fork", "thread", "open", "fsync"), ("insert", "disk")

#: Length of a run, s: in simulated time, and against the clock.
SECONDS, LIVE_SECONDS = 0.35, 0.25

#: The longest that a case may take, s.
CASE_TIMEOUT = 20.0

#: How long a supervisor asks a rig again to take zero, s, and how long it waits for its controller.
_ZERO_TIMEOUT, _SILENCE = 0.02, 5.0

#: Rows of a transaction in simulated time: few, so that there are many.
_BATCH = 8

#: Of the calls of a kind that fail: the first, the last, and spread between.
FIRST, LAST, BETWEEN = 200, 50, 50


#: What a run must not leave behind.
_Worker = BaseProcess | Background


def is_live(operation: str, rig: str) -> bool:
    """Whether a fault comes in a session against the clock, not in simulated time."""
    return operation in LIVE or (rig == "kept" and operation in LIVE_KEPT)


def chosen(count: int) -> tuple[int, ...]:
    """Return which of ``count`` calls fail in turn: all, or the first, the last, some between."""
    if count <= FIRST + LAST + BETWEEN:
        return tuple(range(1, count + 1))
    between = np.linspace(FIRST, count - LAST + 1, BETWEEN + 2)[1:-1]
    picked = {*range(1, FIRST + 1), *between.round().astype(int).tolist()}
    return tuple(sorted(picked | set(range(count - LAST + 1, count + 1))))


class Device:
    """A rig that remembers what it accepted, in memory that forked processes share, and fails.

    ``make`` makes the rig of this period, s, and ``m`` inputs, in the process where it is first
    used; ``tally`` counts the calls, and says which of them fail. ``last`` is what was accepted
    last, (m,).
    """

    def __init__(self, make: Callable[[], Rig], period: float, m: int, tally: Tally) -> None:
        self.make, self.period, self.tally = make, period, tally
        self._rig: Rig | None = None
        self._shared = np.frombuffer(mmap.mmap(-1, 8 * (m + 1)), dtype=float)
        self.last = self._shared[:m]

    @property
    def driven(self) -> bool:
        """Whether an output other than zero was ever accepted."""
        return bool(self._shared[-1])

    @property
    def rig(self) -> Rig:
        """The rig itself."""
        if self._rig is None:
            self._rig = self.make()
        return self._rig

    def read(self) -> Measurement:
        """Return the measurement, or fail."""
        self.tally.check("read")
        return self.rig.read()

    def write(self, u: FloatArray) -> None:
        """Accept the output; fail before, or after it."""
        with self._unsure("write"):
            self.rig.write(u)
            self.last[:] = u
            self._shared[-1] += float(u.any())

    def close(self) -> None:
        """Let go of the rig; fail before, or after it."""
        with self._unsure("close"):
            self.rig.close()

    @contextlib.contextmanager
    def _unsure(self, what: str) -> Iterator[None]:
        taken = self.tally.due(f"{what}-taken")
        self.tally.check(what)
        yield
        if taken:
            raise OSError("no confirmation")


class _InStep(RigWrapper):
    """A kept rig whose controller waits for its answers: simulated time has no other pace."""

    def read(self) -> Measurement:
        deadline = time.monotonic() + _SILENCE
        while True:
            try:
                return self.rig.read()
            except TimeoutError:
                if time.monotonic() > deadline:
                    raise


@dataclass(frozen=True)
class FaultResult:
    """What came of one fault.

    ``wrong``: what is not as it should be, in words; empty when all is.
    """

    fault: Fault
    wrong: tuple[str, ...]
    happened: str
    steps: int = 0

    @property
    def passed(self) -> bool:
        """Whether all is as it should be."""
        return not self.wrong


@dataclass
class _Run:
    """One run: what was seen of it."""

    device: Device
    log: Path
    refused: str = ""
    report: Report | None = None
    log_failure: str = ""
    unsound: list[str] = field(default_factory=list)


class Systematic:
    """Runs with one fault each, on two rigs; what they share is computed once.

    ``seed``: of the rig and of the optimiser.
    """

    def __init__(self, seed: int = 0) -> None:
        short = replace(drill_recipe(seed), evaluations=32, horizon=10.0)
        ideal, kept = replace(short, rig="ideal"), replace(short)
        self.recipes: dict[str, Recipe] = {"ideal": ideal, "realistic": short, "kept": kept}
        self.memory: CascadeState = self.recipes[RIGS[0]].first()
        self._answers: dict[tuple[str, bytes, float, int], Answer] = {}
        self._judged_again: set[tuple[object, ...]] = set()
        for rig, recipe in self.recipes.items():
            recipe.precompile(self.memory)
            vars(recipe)["first"] = lambda: self.memory  # a session finds it done
            vars(recipe)["precompile"] = lambda memory, jumps=False: None
            self._tallied(rig, live=False)  # compiles the rest
        self.counts: dict[str, dict[str, int]] = {}

    def count(self) -> dict[str, dict[str, int]]:
        """Return how often a run without a fault makes each call: rig, then operation."""
        if not self.counts:
            for rig in RIGS:
                self.counts[rig] = {}
                for live in (False, True):
                    for operation, n in self._tallied(rig, live=live).items():
                        if is_live(operation, rig) == live:
                            self.counts[rig][operation] = n
        return self.counts

    def _tallied(self, rig: str, *, live: bool) -> dict[str, int]:
        """Make a run without a fault, and return how often each call was made."""
        tally = Tally()
        with tempfile.TemporaryDirectory() as folder:
            self._made(rig, tally, Path(folder) / "log.db", live=live)
        return dict(zip(OPERATIONS, tally.counts.tolist(), strict=True))

    def faults(self) -> tuple[Fault, ...]:
        """Return every fault, the quick ones first."""
        counts = self.count()
        return tuple(
            Fault(operation, n, always, rig)
            for live in (False, True)
            for operation in OPERATIONS
            for rig in RIGS
            if is_live(operation, rig) == live
            for n in chosen(counts[rig][operation])
            for always in (False, True)
        )

    def run(self, fault: Fault) -> FaultResult:
        """Make one run with a fault, and judge it.

        Raises InvalidInputError for a rig that there is none of.
        """
        require(fault.rig in RIGS, "rig of a fault", fault.rig, " or ".join(RIGS))
        tally, before = Tally(fault), _running()
        with tempfile.TemporaryDirectory() as folder:
            log = Path(folder) / "log.db"
            try:
                with _time_limit():
                    run = self._made(
                        fault.rig, tally, log, live=is_live(fault.operation, fault.rig)
                    )
            except _TimedOut:
                _end_children()
                return FaultResult(fault, (f"still going after {CASE_TIMEOUT:g} s",), "it hung")
            except Exception as error:  # whatever came through is a finding
                _end_children()
                return FaultResult(fault, (error_text(error),), "it raised")
            return self._judged(fault, tally, run, before)

    def drill(
        self, faults: Sequence[Fault] | None = None, progress: Progress = no_progress
    ) -> tuple[FaultResult, ...]:
        """Run faults, all by default, in turn."""
        asked = self.faults() if faults is None else faults
        told = each(asked, progress, lambda fault: f"{fault.operation}, {fault.rig} rig")
        return tuple(map(self.run, told))

    # -- one run -----------------------------------------------------------------------------

    def _made(self, rig: str, tally: Tally, log: Path, *, live: bool) -> _Run:
        recipe = self.recipes[rig]
        device = Device(recipe.make_rig, recipe.period, recipe.belief.m, tally)
        run = _Run(device, log)
        gc.collect(1)  # what earlier runs left open is not this one's
        with _shortened(), failing(tally):
            try:
                (self._against_the_clock if live else self._simulated)(rig, run)
            except UndertowError as error:
                run.refused = str(error)
        return run

    def _simulated(self, name: str, run: _Run) -> None:
        """Run in simulated time, as the drill does."""
        recipe = self.recipes[name]
        controller = recipe.make_controller(self.memory)
        rig = self._rig(name, run.device, in_step=True)
        monitor = OutputMonitor(rig, controller.limits, controller.slew)
        worker = InlineWorker(lambda request: self._answered(recipe, request))
        meta = about(controller, recipe)
        try:
            book = Log(run.log, Columns.of(recipe.belief), meta, threaded=False)
        except UndertowError:
            rig.close()
            raise
        with book:
            runtime = Runtime(controller, monitor, worker, clock=SimulatedClock(), log=book)
            run.report = runtime.run(SECONDS).unless_interrupted()
        run.log_failure, run.unsound = book.failure, monitor.faults

    def _against_the_clock(self, name: str, run: _Run) -> None:
        """Run a session as ``undertow run`` does."""
        recipe = self.recipes[name]
        rig = self._rig(name, run.device, in_step=False)
        try:
            with session(recipe, rig=rig, log=run.log, processes=2) as runtime:
                run.report = runtime.run(LIVE_SECONDS).unless_interrupted()
        finally:
            with contextlib.suppress(Exception):
                rig.close()
        assert runtime.log is not None
        run.log_failure = runtime.log.failure

    def _rig(self, name: str, device: Device, *, in_step: bool) -> Rig:
        if name != "kept":
            return device
        recipe = self.recipes[name]
        make = partial(SupervisedRig, lambda: device, recipe.period, *recipe.output_bounds)
        return _InStep(make(controller_timeout=_SILENCE)) if in_step else make()

    def _answered(self, recipe: Recipe, request: Request) -> Answer:
        """Answer a request; one that was made in an earlier run has the answer that it had."""
        key = recipe.rig, request.x.tobytes(), request.use, request.sequence
        if key not in self._answers:
            self._answers[key] = recipe.respond(request)
        return self._answers[key]

    # -- and its judgement -------------------------------------------------------------------

    def _judged(
        self, fault: Fault, tally: Tally, run: _Run, before: AbstractSet[_Worker]
    ) -> FaultResult:
        """Say what is wrong with a run, if anything; ``before`` it, these were running."""
        wrong = list(run.unsound)
        device, report = run.device, run.report
        if report is None:
            if device.driven or device.last.any():
                wrong.append(f"refused, with the output at {device.last.tolist()}")
        else:
            if device.last.any() and report.verdict.output_zero:
                wrong.append(f"the output stays at {device.last.tolist()}, and nothing says so")
            wrong += self._log_faults(fault.rig, run)
        wrong += _left_behind(before)
        if report is None:
            happened = f"refused: {run.refused}"
        else:
            happened = str(report.verdict)
            if not tally.failed:
                happened += "; the call was not made"
        return FaultResult(fault, tuple(wrong), happened, 0 if report is None else report.steps)

    def _log_faults(self, rig: str, run: _Run) -> list[str]:
        """Open and replay the log of a run that was made."""
        try:
            recording = read_log(run.log)
        except UndertowError as error:
            return [f"the log does not open: {error}"]
        answers = {
            (rig, *(v for name, v in row.items() if name not in ("k", "seconds")))
            for row in recording.answers
        }
        new = not answers <= self._judged_again  # the gate's decisions are functions of these
        controller = self.recipes[rig].make_controller(self.memory)
        again = replay_controller(recording, controller, decisions=new)
        if again.identical:
            self._judged_again |= answers
            return []
        if again.steps == 0:
            return [] if run.log_failure else ["no step in the log, and nothing says why"]
        return [f"the replay differs: {again.differing} steps, {again.misjudged} decisions"]


def _running() -> set[_Worker]:
    """Return the processes and threads of ours that run now."""
    threads = (t for t in threading.enumerate() if isinstance(t, Background))
    return {*multiprocessing.active_children(), *threads}


def _left_behind(before: AbstractSet[_Worker]) -> list[str]:
    """Return what still runs of a run that is over; it is given a moment, and then ended."""
    deadline = time.monotonic() + 2.0
    while True:
        left = sorted(f"{type(r).__name__} {r.name}" for r in _running() - before)
        if not left:
            return []
        if time.monotonic() > deadline:
            _end_children()
            return [f"left behind: {', '.join(left)}"]
        time.sleep(0.002)


def _end_children() -> None:
    for process in multiprocessing.active_children():
        process.kill()
        process.join(1.0)


@contextlib.contextmanager
def _shortened() -> Iterator[None]:
    """Let the log write often, and the supervisor wait briefly: there are thousands of runs."""
    before = logs.BATCH_ROWS, supervisor.ZERO_TIMEOUT
    logs.BATCH_ROWS, supervisor.ZERO_TIMEOUT = _BATCH, _ZERO_TIMEOUT
    try:
        yield
    finally:
        logs.BATCH_ROWS, supervisor.ZERO_TIMEOUT = before


class _TimedOut(BaseException):
    """A case takes too long."""


@contextlib.contextmanager
def _time_limit() -> Iterator[None]:
    """Interrupt what takes too long, in the main thread of a system that can."""
    main = threading.current_thread() is threading.main_thread()
    if not main or not hasattr(signal, "setitimer"):
        yield
        return

    def over(_number: int, _frame: FrameType | None) -> None:
        raise _TimedOut

    before = signal.signal(signal.SIGALRM, over)
    signal.setitimer(signal.ITIMER_REAL, CASE_TIMEOUT)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
