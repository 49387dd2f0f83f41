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
from dataclasses import dataclass
from multiprocessing.context import ForkProcess
from pathlib import Path

import numpy as np

from undertow.base import ArtefactError
from undertow.models import FloatArray
from undertow.plants.interface import Measurement, Rig
from undertow.runtime.drill import drill_recipe
from undertow.runtime.faults import Witness
from undertow.runtime.keeper import SupervisedRig
from undertow.runtime.log import Columns, Recording, read_log
from undertow.runtime.loop import Runtime
from undertow.runtime.modes import Mode
from undertow.runtime.processes import fork
from undertow.runtime.recipe import Recipe
from undertow.runtime.replay import replay
from undertow.runtime.session import session
from undertow.runtime.slow import BackgroundWorker
from undertow.runtime.verdict import EXIT_CODES, Report

__all__ = [
    "ATTEMPTS",
    "LIVE",
    "Killed",
    "LiveOutcome",
    "kill_drill",
    "kill_run",
    "kill_running",
    "live_drill",
]


@dataclass(frozen=True)
class LiveOutcome:
    """What happened in one run against the clock: what fails, how, what happened, verdict."""

    part: str
    name: str
    happened: str
    passed: bool


class _Blocking:
    """A rig whose read does not return for a while."""

    def __init__(self, rig: Rig, since: float, seconds: float) -> None:
        self.rig, self.period, self.seconds = rig, rig.period, seconds
        self.left, self.let_go = round(since / rig.period), 0.0
        self.blocked = 0.0

    def read(self) -> Measurement:
        self.left -= 1
        if self.left == 0:
            self.blocked = time.perf_counter()
            time.sleep(self.seconds)
        return self.rig.read()

    def write(self, u: FloatArray) -> None:
        self.rig.write(u)

    def close(self) -> None:
        self.let_go = self.let_go or time.perf_counter()
        self.rig.close()


def _children(runtime: Runtime) -> list[int]:
    worker = runtime.worker
    assert isinstance(worker, BackgroundWorker)
    return worker.processes


def _hurt_optimiser(number: signal.Signals) -> tuple[Report, Witness]:
    """Send a signal to the process that optimises, half a second into a run."""
    recipe = drill_recipe()
    rig = recipe.make_rig()
    limits = recipe.settings.limits(recipe.belief)
    witness = Witness(rig, limits, recipe.settings.slew(recipe.belief) * recipe.period)
    with session(recipe, rig=witness, processes=2) as runtime:
        (victim, *_) = _children(runtime)
        timer = threading.Timer(0.5, os.kill, (victim, number))
        timer.start()
        return runtime.run(2.5), witness


def _optimiser(number: signal.Signals) -> LiveOutcome:
    report, witness = _hurt_optimiser(number)
    gave_up = report.answers["never came"]
    later = [t for t, _, text in report.events if "applied" in text and t > 1.3]
    held = report.stopped_by == "operator: stop" and not witness.faults
    happened = (
        f"{'held to the end' if held else report.stopped_by}; {gave_up} never came, the one "
        f"standing by gave {len(later)} more"
    )
    name = "process killed" if number == signal.SIGKILL else "process stands still"
    return LiveOutcome("optimiser", name, happened, held and gave_up == 1 and len(later) > 0)


def _blocking_read() -> LiveOutcome:
    recipe = drill_recipe()
    rig = _Blocking(recipe.make_rig(), 0.5, 1.0)
    with session(recipe, rig=rig, processes=1) as runtime:
        report = runtime.run(2.0)
    after = rig.let_go - rig.blocked
    happened = f"{report.stopped_by}; the rig was let go of after {1e3 * after:.0f} ms"
    return LiveOutcome("rig", "a read blocks for 1 s", happened, 0 < after < 0.5)


def _keeper() -> LiveOutcome:
    """Stop the keeper for a while: the controller is blind, and must not go on."""
    recipe = drill_recipe()
    limits = recipe.settings.limits(recipe.belief)
    slew = recipe.settings.slew(recipe.belief) * recipe.period
    recipe.make_rig().write(np.zeros_like(limits))
    rig = SupervisedRig(recipe.make_rig, recipe.period, limits, slew)
    pid = rig.process.pid or 0
    with session(recipe, rig=rig, processes=1) as runtime:
        for after, number in ((0.5, signal.SIGSTOP), (0.9, signal.SIGCONT)):
            threading.Timer(after, os.kill, (pid, number)).start()
        report = runtime.run(2.0)
    told = "keeper does not answer" in report.stopped_by
    gone = not rig.process.is_alive()
    return LiveOutcome("keeper", "stands still", report.stopped_by, told and gone)


def _process_stands_still() -> LiveOutcome:
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
    held = reason == "operator: stop"
    happened = f"no step for {1e3 * gap:.0f} ms; {'held to the end' if held else reason}"
    right = held if gap <= recipe.settings.stall else reason.startswith("no step for")
    return LiveOutcome("process", "stands still, 40 ms", happened, right and same and gap > 0.03)


def _unwritable_log() -> LiveOutcome:
    recipe = drill_recipe()
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / "file"
        place.write_text("not a folder")
        try:
            with session(recipe, log=place / "run.db", simulated=True):
                return LiveOutcome("log", "cannot be made", "the run began", False)
        except ArtefactError as error:
            return LiveOutcome("log", "cannot be made", f"refused before the run: {error}", True)


#: Runs that may stop safely by themselves before one can be killed while it goes on.
ATTEMPTS = 10


@dataclass(frozen=True)
class Killed:
    """What was left of a run whose controller was killed.

    Attributes
    ----------
    moment
        When it was killed, s after its first step.
    steps
        Steps in the log.
    missing
        Time from the last step in the log to the last output that the keeper heard, s: the steps
        that were made and are not in the log.
    idle
        Time from that output to the kill, s, in which the controller said nothing.
    identical
        Whether the log's replay is identical, bit for bit.
    to_zero
        Time from the last output of the controller until the keeper had brought it to zero, s.
    stopped_by
        Why the run had ended before the kill, in a safe stop of its own with the output at zero,
        as its log tells; empty when the kill ended it.
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
    limits = recipe.settings.limits(recipe.belief)
    slew = recipe.settings.slew(recipe.belief) * recipe.period
    recipe.make_rig().write(np.zeros_like(limits))  # compiles what the keeper needs
    rig = SupervisedRig(recipe.make_rig, recipe.period, limits, slew, record=record)
    with session(recipe, rig=rig, log=log, processes=1) as runtime:
        runtime.run(60.0)


def kill_run(recipe: Recipe, moment: float, folder: Path) -> Killed:
    """Run a controller in a process of its own, its rig kept by another, and kill it.

    Parameters
    ----------
    recipe
        The run; compiled already, so that its process starts at once.
    moment
        When to kill it, s after its log has its first line.
    folder
        For the log and the keeper's record.
    """
    log, record = folder / "killed.db", folder / "keeper.json"
    victim = fork(_victim, (recipe, log, record), "undertow victim", daemon=False)
    first = _first_line(log, victim)
    time.sleep(max(0.0, first + moment - time.perf_counter()))
    victim.kill()
    killed = time.perf_counter()
    victim.join()
    recording = read_log(log)
    deadline = time.perf_counter() + 5.0
    while not record.exists() and time.perf_counter() < deadline:
        time.sleep(0.01)
    time.sleep(0.01)
    facts = json.loads(record.read_text())
    return Killed(
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


def _first_line(log: Path, victim: ForkProcess, patience: float = 120.0) -> float:
    """Wait until the log has its first step; return when that was made, s."""
    deadline = time.perf_counter() + patience
    while time.perf_counter() < deadline and victim.is_alive():
        with contextlib.suppress(ArtefactError):
            recording = read_log(log)
            if len(recording.steps):
                return float(recording["clock"][0])
        time.sleep(0.02)
    value = "no step within two minutes" if victim.is_alive() else "no step: the run has failed"
    raise ArtefactError(f"log '{log}'", value=value)


class _Hungry:
    """A rig that takes all memory that there is, half a second into a run, and keeps it."""

    def __init__(self, rig: Rig, after: float) -> None:
        self.rig, self.period, self.left = rig, rig.period, round(after / rig.period)
        self.taken: list[bytearray] = []
        self.u = np.zeros(1)

    def read(self) -> Measurement:
        self.left -= 1
        if self.left == 0:
            self._eat()
        return self.rig.read()

    def _eat(self) -> None:
        import resource

        pages = int(Path("/proc/self/statm").read_text().split()[0])
        limit = pages * resource.getpagesize() + (1 << 20)
        resource.setrlimit(resource.RLIMIT_AS, (limit, resource.RLIM_INFINITY))
        size = 1 << 20
        while size > 32:
            try:
                self.taken.append(bytearray(size))
            except MemoryError:
                size //= 2

    def write(self, u: FloatArray) -> None:
        self.rig.write(u)
        self.u[:] = u

    def close(self) -> None:
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
        self.taken.clear()
        self.rig.close()


def _starved(recipe: Recipe, record: Path) -> None:
    rig = _Hungry(recipe.make_rig(), 0.5)
    with session(recipe, rig=rig, processes=1) as runtime:
        report = runtime.run(1.5)
    verdict = report.verdict
    facts = {"text": str(verdict), "code": verdict.exit_code, "off": verdict.off}
    record.write_text(json.dumps({**facts, "u": rig.u.tolist()}))


def _no_memory() -> LiveOutcome:
    """Leave no memory in a process of its own: held or stopped, and the output off."""
    name = "takes all memory"
    if not Path("/proc/self/statm").exists():
        return LiveOutcome("process", name, "left out: needs /proc", True)
    with tempfile.TemporaryDirectory() as folder:
        record = Path(folder) / "facts.json"
        child = fork(_starved, (drill_recipe(), record), "undertow starved", daemon=False)
        child.join(120.0)
        code = child.exitcode
        child.kill()
        if not record.exists():
            happened = f"no word from it, exit code {code}"
            return LiveOutcome("process", name, happened, False)
        facts = json.loads(record.read_text())
    off = facts["off"] and not any(facts["u"])
    happened = f"{facts['text']}; exit code {facts['code']}"
    return LiveOutcome("process", name, happened, off and facts["code"] != EXIT_CODES["output on"])


def _process_killed() -> LiveOutcome:
    *stopped, killed = kill_running(drill_recipe(), 0.7)
    happened = (
        f"killed at {killed.moment:.2f} s: the keeper had the output at zero "
        f"{1e3 * killed.to_zero:.0f} ms after the last one; the log misses "
        f"{1e3 * killed.missing:.0f} ms; replay {'identical' if killed.identical else 'differs'}"
    )
    if stopped:
        happened += f"; {len(stopped)} had stopped by themselves: {stopped[-1].stopped_by}"
    passed = not killed.stopped_by and all(one.passed for one in (*stopped, killed))
    return LiveOutcome("process", "controller killed", happened, passed)


def kill_running(recipe: Recipe, moment: float) -> tuple[Killed, ...]:
    """Kill a run that is going on, see :func:`kill_run`.

    One that had stopped safely by itself is followed by another, to be killed at the same
    moment: the last of those returned is the one that was going on, if there was any.
    """
    killed: list[Killed] = []
    while not killed or (killed[-1].stopped_by and len(killed) < ATTEMPTS):
        with tempfile.TemporaryDirectory() as folder:
            killed.append(kill_run(recipe, moment, Path(folder)))
    return tuple(killed)


def kill_drill(
    count: int, *, seed: int = 0, progress: Callable[[str, float], None] | None = None
) -> tuple[Killed, ...]:
    """Kill ``count`` runs that are going on at random moments of their first two seconds.

    Those that had stopped safely by themselves before are returned with them.
    """
    recipe, rng = drill_recipe(seed), np.random.default_rng(seed)
    recipe.cascade.start(recipe.x0)  # what the runs share is compiled once
    killed: list[Killed] = []
    for number, moment in enumerate(rng.uniform(0.0, 2.0, count)):
        if progress is not None:
            progress(f"kill {number + 1} of {count}, at {moment:.2f} s", number / count)
        killed += kill_running(recipe, float(moment))
    return tuple(killed)


#: The live part of the drill.
LIVE: tuple[tuple[str, Callable[[], LiveOutcome]], ...] = (
    ("optimiser: process killed", lambda: _optimiser(signal.SIGKILL)),
    ("optimiser: process stands still", lambda: _optimiser(signal.SIGSTOP)),
    ("rig: a read blocks", _blocking_read),
    ("log: cannot be made", _unwritable_log),
    ("keeper: stands still", _keeper),
    ("process: stands still, 40 ms", _process_stands_still),
    ("process: takes all memory", _no_memory),
    ("process: controller killed", _process_killed),
)


def live_drill(progress: Callable[[str, float], None] | None = None) -> tuple[LiveOutcome, ...]:
    """Run the live part of the drill."""
    outcomes = []
    for number, (name, run) in enumerate(LIVE):
        if progress is not None:
            progress(name, number / len(LIVE))
        outcomes.append(run())
    return tuple(outcomes)
