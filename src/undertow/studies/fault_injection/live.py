"""The part of the drill that needs real time: processes that hang or die, calls that block."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from multiprocessing.context import ForkProcess
from pathlib import Path

import numpy as np

from undertow.base import ArtefactError, Progress, each, no_progress
from undertow.models import FloatArray
from undertow.plants import Measurement, Rig, RigWrapper
from undertow.runtime import (
    EXIT_CODES,
    BackgroundWorker,
    Columns,
    Mode,
    Reason,
    Recipe,
    Recording,
    Settings,
    SupervisedRig,
    read_log,
    replay,
    session,
)
from undertow.runtime.processes import fork
from undertow.studies.fault_injection.cases import OutputMonitor
from undertow.studies.fault_injection.simulated import drill_recipe


@dataclass(frozen=True)
class LiveResult:
    """What happened in one run against the clock: what fails, how, what happened, verdict."""

    part: str
    name: str
    happened: str
    passed: bool


#: What happened in words, and whether that is as it should be.
Happened = tuple[str, bool]


class _Struck(RigWrapper):
    """A rig to which something happens when it is read half a second into a run."""

    def __init__(self, rig: Rig) -> None:
        super().__init__(rig)
        self._left = round(0.5 / rig.period)

    def happen(self) -> None:
        """Let it happen."""
        raise NotImplementedError

    def read(self) -> Measurement:
        self._left -= 1
        if self._left == 0:
            self.happen()
        return self.rig.read()


class _Blocking(_Struck):
    """A rig whose read does not return for a second."""

    blocked = let_go = 0.0

    def happen(self) -> None:
        self.blocked = time.perf_counter()
        time.sleep(1.0)

    def close(self) -> None:
        self.let_go = self.let_go or time.perf_counter()
        self.rig.close()


def _patient_recipe() -> Recipe:
    """Return the drill's run for faults that are not about time: a busy host does not end it."""
    return replace(drill_recipe(), settings=Settings(max_step_interval=1.0))


def _optimiser(number: signal.Signals) -> Happened:
    """Send a signal to the process that optimises, half a second into a run."""
    recipe = _patient_recipe()
    monitor = OutputMonitor(recipe.make_rig(), *recipe.output_bounds)
    with session(recipe, rig=monitor, processes=2) as runtime:
        assert isinstance(runtime.worker, BackgroundWorker)
        threading.Timer(0.5, os.kill, (runtime.worker.processes[0], number)).start()
        report = runtime.run(2.5).unless_interrupted()
    gave_up = report.answers["never came"]
    later = [t for t, _, text in report.events if "applied" in text and t > 1.3]
    held = report.stopped_by == Reason.END.text and not monitor.faults
    happened = (
        f"{'held to the end' if held else report.stopped_by}; {gave_up} never came, the one "
        f"standing by gave {len(later)} more"
    )
    return happened, held and gave_up == 1 and len(later) > 0


def _blocking_read() -> Happened:
    recipe = drill_recipe()
    rig = _Blocking(recipe.make_rig())
    with session(recipe, rig=rig, processes=1) as runtime:
        report = runtime.run(2.0).unless_interrupted()
    after = rig.let_go - rig.blocked
    happened = f"{report.stopped_by}; the rig was let go of after {1e3 * after:.0f} ms"
    return (happened, 0 < after < 0.5)


class _StandsStill(_Struck):
    """A rig whose supervisor is stopped for 0.4 s."""

    def __init__(self, rig: SupervisedRig) -> None:
        super().__init__(rig)
        self.process = rig.process

    def happen(self) -> None:
        assert self.process.pid is not None  # it has begun
        os.kill(self.process.pid, signal.SIGSTOP)
        threading.Timer(0.4, os.kill, (self.process.pid, signal.SIGCONT)).start()


def _supervisor() -> Happened:
    """Stop the supervisor for a while: the controller is blind, and must not go on."""
    recipe = drill_recipe()
    recipe.make_rig().write(np.zeros(recipe.belief.m))
    rig = _StandsStill(SupervisedRig(recipe.make_rig, recipe.period, *recipe.output_bounds))
    with session(recipe, rig=rig, processes=1) as runtime:
        report = runtime.run(2.0).unless_interrupted()
    told = "supervisor does not answer" in report.stopped_by
    gone = not rig.process.is_alive()
    return (report.stopped_by, told and gone)


def _process_stands_still() -> Happened:
    """Stop controller and clock of a run for 40 ms, as a busy host does."""
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "run.db"
        recipe = drill_recipe()
        victim = fork(_victim, (recipe, log, log.with_suffix(".json")), "victim", daemon=False)
        first, pid = _first_line(log, victim), victim.pid or 0
        for moment, number in (
            (0.5, signal.SIGSTOP),
            (0.54, signal.SIGCONT),
            (1.0, signal.SIGTERM),
        ):
            time.sleep(max(0.0, first + moment - time.perf_counter()))
            os.kill(pid, number)
        victim.join(10.0)
        victim.kill()
        recording = read_log(log)
        gap = float(np.diff(recording["clock"]).max())
        reason = _ending(recording, Columns.of(recipe.belief))
        same = replay(log).identical
    held = reason == Reason.STOP.text
    happened = f"no step for {1e3 * gap:.0f} ms; {'held to the end' if held else reason}"
    right = held if gap <= recipe.settings.max_step_interval else reason.startswith("no step for")
    return (happened, right and same and gap > 0.03)


def _unwritable_log() -> Happened:
    recipe = drill_recipe()
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / "file"
        place.write_text("not a folder")
        try:
            with session(recipe, log=place / "run.db", simulated=True):
                return ("the run began", False)
        except ArtefactError as error:
            return (f"refused before the run: {error}", True)


#: Runs that may stop safely by themselves before one can be killed while it goes on.
ATTEMPTS = 10


@dataclass(frozen=True)
class KillResult:
    """What was left of a run whose controller was killed.

    It was killed ``moment``, s, after its first step; the log has ``steps``, and the replay is
    ``identical`` if it is so bit for bit. ``missing``: time from the last step in the log to the
    last output that the supervisor heard, s: the steps that were made and are not in the log.
    ``idle``: time from that output to the kill, s, in which the controller said nothing.
    ``to_zero``: time from that output until the supervisor had brought it to zero, s.
    ``stopped_by``: why the run had ended before the kill, in a safe stop of its own with the output
    at zero, as its log tells; empty when the kill ended it.
    """

    moment: float
    steps: int
    missing: float
    idle: float
    identical: bool
    to_zero: float
    stopped_by: str = ""

    @property
    def passed(self) -> bool:
        """Whether the log is whole, the replay identical, and the output at zero soon.

        Of a run that was going on at most 0.1 s may be missing; the log of one that had stopped
        tells of its stop.
        """
        whole = bool(self.stopped_by) or self.missing <= 0.1
        return whole and self.identical and self.to_zero <= 0.1


def _victim(recipe: Recipe, log: Path, record: Path) -> None:
    recipe.make_rig().write(np.zeros(recipe.belief.m))  # compiles what the supervisor needs
    rig = SupervisedRig(recipe.make_rig, recipe.period, *recipe.output_bounds, record=record)
    with session(recipe, rig=rig, log=log, processes=1) as runtime:
        runtime.run(60.0)


def kill_run(recipe: Recipe, moment: float, folder: Path) -> KillResult:
    """Run a controller in a process of its own, its rig kept by another, and kill it.

    The recipe is compiled already, so that its process starts at once; it is killed ``moment``, s,
    after its log has its first line. The folder is for the log and the supervisor's record.
    """
    log, record = folder / "killed.db", folder / "supervisor.json"
    victim = fork(_victim, (recipe, log, record), "undertow victim", daemon=False)
    try:
        first = _first_line(log, victim)
        time.sleep(max(0.0, first + moment - time.perf_counter()))
    finally:  # also where Ctrl-C ends the drill: nobody writes into the folder after that
        victim.kill()
        killed = time.perf_counter()
        victim.join()
        while not record.exists() and time.perf_counter() < killed + 5.0:
            time.sleep(0.01)
    time.sleep(0.01)
    recording = read_log(log)
    facts = json.loads(record.read_text())
    return KillResult(
        killed - first,
        len(recording.steps),
        facts["heard"] - float(recording["clock"][-1]),
        killed - facts["heard"],
        replay(log).identical,
        facts["zero"] - facts["heard"] if not any(facts["u"]) else float("inf"),
        _ending(recording, Columns.of(recipe.belief)),
    )


def _ending(recording: Recording, columns: Columns) -> str:
    """Why the run of a log had ended in a safe stop, its output at zero; empty if it had not."""
    if recording["mode"][-1] != Mode.SAFE_STOP or recording.steps[-1, columns.u].any():
        return ""
    reasons = [text for _, _, kind, text in recording.events if kind == "state"]
    return reasons[-1].partition("SAFE_STOP: ")[2] or "no reason in the log"


def _first_line(log: Path, victim: ForkProcess) -> float:
    """Wait until the log has its first step; return when that was made, s."""
    deadline = time.perf_counter() + 120.0
    while time.perf_counter() < deadline and victim.is_alive():
        with contextlib.suppress(ArtefactError):
            recording = read_log(log)
            if len(recording.steps):
                return float(recording["clock"][0])
        time.sleep(0.02)
    value = "no step within two minutes" if victim.is_alive() else "no step: the run has failed"
    raise ArtefactError(f"log '{log}'", value=value)


class _Hungry(_Struck):
    """A rig that takes all memory that there is, and keeps it."""

    def __init__(self, rig: Rig) -> None:
        super().__init__(rig)
        self.taken: list[bytearray] = []
        self.closed = False  # by another thread, when a read takes too long
        self.u = np.zeros(1)

    def happen(self) -> None:
        import resource

        pages = int(Path("/proc/self/statm").read_text().split()[0])
        limit = pages * resource.getpagesize() + (1 << 20)
        resource.setrlimit(resource.RLIMIT_AS, (limit, resource.RLIM_INFINITY))
        size = 1 << 20
        while size > 32 and not self.closed:
            try:
                self.taken.append(bytearray(size))
            except MemoryError:
                size //= 2

    def write(self, u: FloatArray) -> None:
        self.rig.write(u)
        self.u[:] = u

    def close(self) -> None:
        import resource

        self.closed = True
        resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
        self.taken.clear()
        self.rig.close()


def _starved(recipe: Recipe, record: Path) -> None:
    rig = _Hungry(recipe.make_rig())
    with session(recipe, rig=rig, processes=1) as runtime:
        report = runtime.run(1.5).unless_interrupted()
    verdict = report.verdict
    facts = {"text": str(verdict), "code": verdict.exit_code, "off": verdict.output_zero}
    record.write_text(json.dumps({**facts, "u": rig.u.tolist()}))


def _no_memory() -> Happened:
    """Leave no memory in a process of its own: held or stopped, and the output off."""
    if not Path("/proc/self/statm").exists():
        return ("left out: needs /proc", True)
    with tempfile.TemporaryDirectory() as folder:
        record = Path(folder) / "facts.json"
        child = fork(_starved, (_patient_recipe(), record), "undertow starved", daemon=False)
        child.join(120.0)
        code = child.exitcode
        child.kill()
        if not record.exists():
            happened = f"no word from it, exit code {code}"
            return (happened, False)
        facts = json.loads(record.read_text())
    off = facts["off"] and not any(facts["u"])
    happened = f"{facts['text']}; exit code {facts['code']}"
    return (happened, off and facts["code"] != EXIT_CODES["output on"])


def _process_killed() -> Happened:
    *stopped, killed = kill_running(drill_recipe(), 0.7)
    happened = (
        f"killed at {killed.moment:.2f} s: the supervisor had the output at zero "
        f"{1e3 * killed.to_zero:.0f} ms after the last one; the log misses "
        f"{1e3 * killed.missing:.0f} ms; replay {'identical' if killed.identical else 'differs'}"
    )
    if stopped:
        happened += f"; {len(stopped)} had stopped by themselves: {stopped[-1].stopped_by}"
    passed = not killed.stopped_by and all(one.passed for one in (*stopped, killed))
    return (happened, passed)


def kill_running(recipe: Recipe, moment: float) -> tuple[KillResult, ...]:
    """Kill a run that is going on, see :func:`kill_run`.

    One that had stopped safely by itself is followed by another, to be killed at the same
    moment: the last of those returned is the one that was going on, if there was any.
    """
    killed: list[KillResult] = []
    while not killed or (killed[-1].stopped_by and len(killed) < ATTEMPTS):
        with tempfile.TemporaryDirectory() as folder:
            killed.append(kill_run(recipe, moment, Path(folder)))
    return tuple(killed)


def kill_drill(
    count: int, *, seed: int = 0, progress: Progress = no_progress
) -> tuple[KillResult, ...]:
    """Kill ``count`` runs that are going on at random moments of their first two seconds.

    Those that had stopped safely by themselves before are returned with them.
    """
    recipe, rng = drill_recipe(seed), np.random.default_rng(seed)
    recipe.cascade.start(recipe.x0)  # what the runs share is compiled once
    killed: list[KillResult] = []
    for number, moment in enumerate(rng.uniform(0.0, 2.0, count)):
        progress(f"kill {number + 1} of {count}, at {moment:.2f} s", number / count)
        killed += kill_running(recipe, float(moment))
    return tuple(killed)


#: The live part of the drill: what fails and how, to a run.
LIVE: dict[tuple[str, str], Callable[[], Happened]] = {
    ("optimiser", "process killed"): lambda: _optimiser(signal.SIGKILL),
    ("optimiser", "process stands still"): lambda: _optimiser(signal.SIGSTOP),
    ("rig", "a read blocks for 1 s"): _blocking_read,
    ("log", "cannot be made"): _unwritable_log,
    ("supervisor", "stands still"): _supervisor,
    ("process", "stands still, 40 ms"): _process_stands_still,
    ("process", "takes all memory"): _no_memory,
    ("process", "controller killed"): _process_killed,
}


def live_drill(progress: Progress = no_progress) -> tuple[LiveResult, ...]:
    """Run the live part of the drill."""
    return tuple(LiveResult(*fault, *LIVE[fault]()) for fault in each(LIVE, progress, ": ".join))
