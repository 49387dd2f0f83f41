"""Every call fails in turn, resources run out, signals come at any moment: a safe end in all."""

from __future__ import annotations

import contextlib
import os
import resource
import signal
import sqlite3
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from support import rest_slow
from undertow.base import ArtefactError, InvalidInputError, ResourceError
from undertow.mechanisms import rotary_pendulum
from undertow.models import FloatArray
from undertow.plants import Measurement
from undertow.runtime import Columns, background_worker, processes, workers
from undertow.runtime import log as logs
from undertow.runtime.log import Log
from undertow.runtime.loop import Runtime
from undertow.runtime.processes import Background, check_resources, fork, pipe
from undertow.runtime.recording import read_log
from undertow.runtime.replay import replay_controller
from undertow.runtime.session import session
from undertow.studies.fault_injection.failing_calls import (
    OPERATIONS,
    Fault,
    Tally,
    failing,
    intercepts_sqlite,
)
from undertow.studies.fault_injection.report import systematic_table
from undertow.studies.fault_injection.systematic import (
    RIGS,
    Device,
    FaultResult,
    Systematic,
    chosen,
    is_live,
)


@pytest.fixture(scope="module")
def campaign() -> Systematic:
    return Systematic()


# -- the n-th call fails ----------------------------------------------------------------------


def sample(campaign: Systematic, size: int, *, live: bool, seed: int = 0) -> list[Fault]:
    """At most ``size`` faults of every operation on every rig, as many once as for good."""
    rng = np.random.default_rng(seed)
    groups: dict[tuple[str, str, bool], list[Fault]] = {}
    for fault in campaign.faults():
        if is_live(fault.operation, fault.rig) == live:
            groups.setdefault((fault.operation, fault.rig, fault.always), []).append(fault)
    return [
        group[int(place)]
        for group in groups.values()
        for place in rng.choice(len(group), min(size, len(group)), replace=False)
    ]


def failed(cases: tuple[FaultResult, ...]) -> list[str]:
    return [f"{case.fault}: {case.wrong}, {case.happened}" for case in cases if not case.passed]


def test_which_calls_fail_in_turn() -> None:
    """All where there are few; else the first 200, the last 50, and 50 spread between."""
    assert chosen(0) == ()
    assert chosen(300) == tuple(range(1, 301))
    picked = chosen(5000)
    assert len(picked) == 300
    assert picked[:200] == tuple(range(1, 201))
    assert picked[-50:] == tuple(range(4951, 5001))
    gaps = np.diff(picked[199:251])
    assert 80 < gaps.min() <= gaps.max() < 110


def test_a_fault_is_read_back_from_its_name() -> None:
    fault = Fault("write-taken", 17, True, "ideal")
    assert Fault.parse(str(fault)) == fault
    for wrong in ("", "write:17", "write:0:once:ideal", "write:1:twice:ideal", "fly:1:once:ideal"):
        with pytest.raises(InvalidInputError, match="OPERATION"):
            Fault.parse(wrong)


@pytest.mark.slow
def test_a_run_makes_every_call(campaign: Systematic) -> None:
    """Nothing that is to fail is out of reach: else a campaign proves nothing of it."""
    for rig, counts in campaign.count().items():
        for operation in OPERATIONS:
            assert counts[operation] > 0 or (operation == "disk" and not intercepts_sqlite()), (
                rig,
                operation,
            )
        assert counts["write"] > 300


@pytest.mark.slow
def test_after_any_call_that_fails_at_every_step_the_output_is_off_or_not_said_to_be(
    campaign: Systematic,
) -> None:
    """And the log opens, and its replay is identical; a fault of every kind."""
    faults = sample(campaign, 1, live=False)
    assert {fault.rig for fault in faults} == set(RIGS)
    assert failed(campaign.drill(faults)) == []


LACKING = ["thread:1:once:ideal", "open:3:once:kept"]


@pytest.mark.parametrize("text", rest_slow(["fork:1:always:kept", *LACKING], *LACKING))
def test_a_session_that_lacks_something_is_refused_before_the_rig_is_touched(
    campaign: Systematic, text: str
) -> None:
    case = campaign.run(Fault.parse(text))
    assert failed((case,)) == []
    assert case.happened.startswith("refused: ")
    assert case.steps == 0


def test_the_campaign_finds_a_loop_that_leaves_its_output_on(
    campaign: Systematic, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As the one that stopped without a successful zero write did, and said nothing of it."""

    def careless(runtime: Runtime) -> None:
        if not runtime._released:
            runtime._released, runtime.report.output_zero = True, True
            runtime.report.mode = runtime.controller.mode
            with contextlib.suppress(Exception):
                runtime.rig.close()

    monkeypatch.setattr(Runtime, "_release_rig", careless)
    (wrong,) = campaign.run(Fault("write", 60, True, "ideal")).wrong
    assert "the output stays at" in wrong


def test_the_campaign_finds_a_log_that_loses_a_row(
    campaign: Systematic, monkeypatch: pytest.MonkeyPatch
) -> None:
    honest = logs.Log.commit_row

    def careless(log: logs.Log) -> None:
        log.row[log.columns.u] += 1e-9 * (log.row[0] == 200)
        honest(log)

    monkeypatch.setattr(logs.Log, "commit_row", careless)
    (wrong,) = campaign.run(Fault("read", 300, False, "ideal")).wrong
    assert "the replay differs: 1 steps" in wrong


def test_the_campaign_finds_what_hangs_and_what_raises(
    campaign: Systematic, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("undertow.studies.fault_injection.systematic.CASE_TIMEOUT", 0.2)
    monkeypatch.setattr(Runtime, "run", lambda *_: time.sleep(5.0))
    assert campaign.run(Fault("read", 1, False, "ideal")).wrong == ("still going after 0.2 s",)
    monkeypatch.setattr(Runtime, "run", lambda *_: 1 / 0)
    (wrong,) = campaign.run(Fault("read", 1, False, "ideal")).wrong
    assert wrong.startswith("ZeroDivisionError")


def test_calls_of_sqlite_fail_below_it(tmp_path: Path) -> None:
    """A write that the disk refuses is SQLite's own error, and the file stays whole."""
    if not intercepts_sqlite():
        pytest.skip("the library of SQLite is out of reach")

    def write(path: Path) -> None:
        with contextlib.closing(sqlite3.connect(path, isolation_level=None)) as file:
            file.execute("CREATE TABLE numbers (n INTEGER)")
            for n in range(5):
                file.execute("BEGIN")
                file.executemany("INSERT INTO numbers VALUES (?)", [(n,)] * 10)
                file.execute("COMMIT")

    whole = Tally()
    with failing(whole):
        write(tmp_path / "whole.db")
    counts = dict(zip(OPERATIONS, whole.counts.tolist(), strict=True))
    assert counts["insert"] == 5
    assert counts["fsync"] > 5
    assert counts["disk"] > 10
    for operation, said in (("disk", "full"), ("fsync", "disk I/O error"), ("open", "unable")):
        path = tmp_path / f"{operation}.db"
        last = counts[operation] if operation == "open" else counts[operation] // 2
        error = pytest.raises(sqlite3.OperationalError, match=said)
        with failing(Tally(Fault(operation, last, True, ""))), error:
            write(path)
        with contextlib.closing(sqlite3.connect(path)) as file:
            assert file.execute("PRAGMA integrity_check").fetchone() == ("ok",)
    with contextlib.closing(sqlite3.connect(tmp_path / "after.db")) as file:
        file.execute("CREATE TABLE numbers (n INTEGER)")  # nothing fails any more


def test_a_log_opens_whichever_of_its_syncs_fail(tmp_path: Path) -> None:
    """Those of its closing too, which may leave a journal that is to be undone."""
    if not intercepts_sqlite():
        pytest.skip("the library of SQLite is out of reach")
    columns, left = Columns.of(rotary_pendulum()), 0

    def write(path: Path) -> int:
        with Log(path, columns, {}, threaded=False) as log:
            for k in range(300):
                log.row[0] = k
                log.commit_row()
        return log.dropped

    whole = Tally()
    with failing(whole):
        assert write(tmp_path / "0.db") == 0
    for n in range(1, int(whole.counts[OPERATIONS.index("fsync")]) + 1):
        path = tmp_path / f"{n}.db"
        with failing(Tally(Fault("fsync", n, True, ""))):
            try:
                dropped = write(path)
            except ArtefactError:
                continue  # it could not be made, and says so
        left += Path(f"{path}-journal").exists()
        assert read_log(path).steps[:, 0].tolist() == list(range(300 - dropped))
    assert left > 0


def test_the_table_counts_by_operation_and_names_what_failed() -> None:
    good, bad = Fault("read", 1, False, "ideal"), Fault("write", 17, True, "kept")
    cases = (FaultResult(good, (), "fine"), FaultResult(bad, ("the output stays at 1",), "stopped"))
    table, line = systematic_table(cases).renderables
    assert table.row_count == 2  # type: ignore[union-attr]
    assert str(line) == "write:17:always:kept: the output stays at 1 (stopped)"


@pytest.mark.slow
def test_after_more_calls_that_fail_the_output_is_off_or_not_said_to_be(
    campaign: Systematic,
) -> None:
    """Also against the clock: forks, threads, files, syncs, and all that concerns a log."""
    faults = sample(campaign, 8, live=False, seed=1) + sample(campaign, 3, live=True)
    assert failed(campaign.drill(faults)) == []


# -- lack of resources --------------------------------------------------------------------------


class SilentChildError(Exception):
    """A child did not say anything."""


def in_a_child(work: Callable[[], str], seconds: float = 20.0) -> str:
    """Return what a function says in a process of its own: it may spoil it."""
    ours, theirs = pipe()

    def tell() -> None:
        try:
            said = work()
        except BaseException as error:
            said = f"{type(error).__name__}: {error}"
        for name in ("RLIMIT_AS", "RLIMIT_NOFILE"):
            _, hard = resource.getrlimit(getattr(resource, name))
            resource.setrlimit(getattr(resource, name), (hard, hard))
        theirs.send(said)

    child = fork(tell, (), "child of a test", daemon=False)
    theirs.close()
    try:
        if not ours.poll(seconds):
            raise SilentChildError(f"nothing within {seconds:g} s")
        return str(ours.recv())
    except EOFError as error:
        child.join(5.0)
        raise SilentChildError(f"exit code {child.exitcode}") from error
    finally:
        child.join(5.0)
        child.kill()
        ours.close()


def device_of(campaign: Systematic, rig: str = "ideal") -> Device:
    recipe = campaign.recipes[rig]
    return Device(recipe.make_rig, recipe.period, recipe.belief.m, Tally())


def lower(name: str, soft: int) -> None:
    number = getattr(resource, name)
    resource.setrlimit(number, (soft, resource.getrlimit(number)[1]))


def used(what: str) -> int:
    if what == "memory":
        return int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    return len(os.listdir("/proc/self/fd"))


def run_short(campaign: Systematic, device: Any, log: Path | None, seconds: float = 0.15) -> str:
    recipe = campaign.recipes["ideal"]
    with session(recipe, rig=device, log=log, processes=2) as runtime:
        report = runtime.run(seconds)
    return str(report.verdict)


linux = pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="limits as Linux has them")


@linux
@pytest.mark.parametrize(
    ("name", "more", "option"),
    [
        ("RLIMIT_NOFILE", 5, "ulimit -n"),
        ("RLIMIT_AS", 100 << 20, "ulimit -v"),
        ("RLIMIT_FSIZE", 1 << 20, "ulimit -f"),
    ],
)
def test_a_limit_that_is_too_low_is_an_error_that_names_it(
    campaign: Systematic, tmp_path: Path, name: str, more: int, option: str
) -> None:
    """Within seconds, with value, limit and remedy, and nothing is written to the rig."""
    device = device_of(campaign)

    def work() -> str:
        base = {"RLIMIT_NOFILE": used("files"), "RLIMIT_AS": used("memory")}.get(name, 0)
        lower(name, base + more)
        return run_short(campaign, device, tmp_path / "run.db")

    said = in_a_child(work)
    assert said.startswith("ResourceError")
    assert option in said
    assert "got " in said
    assert "must be " in said
    assert not device.driven


def test_an_optimiser_whose_process_ends_at_once_is_an_error(
    campaign: Systematic, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As when the system kills it for lack of memory; those before it are ended."""
    begun: list[Any] = []
    honest = workers._serve

    def serve(*args: Any) -> None:
        if len(begun) == 1:
            os._exit(9)
        honest(*args)

    def child(*args: Any, **options: Any) -> Any:
        process = fork(*args, **options)
        begun.append(process)
        return process

    monkeypatch.setattr(workers, "_serve", serve)
    monkeypatch.setattr(workers, "fork", child)
    with pytest.raises(ResourceError, match="ended with exit code 9"):
        background_worker(campaign.recipes["ideal"].respond, processes=3)
    assert len(begun) == 2
    for process in begun:
        process.join(5.0)
        assert not process.is_alive()


@linux
@pytest.mark.skipif(os.name == "posix" and os.getuid() != 0, reason="counts all of this user's")
@pytest.mark.parametrize("more", [0, 1, 2, 3])
def test_a_user_who_may_have_no_process_or_thread_more_is_told_so(
    campaign: Systematic, more: int
) -> None:
    """A session against the clock needs two processes and three threads."""
    device = device_of(campaign)

    def work() -> str:
        os.setresuid(54321, 54321, 54321)  # root is bound by no such limit
        resource.setrlimit(resource.RLIMIT_NPROC, (1 + more, 1 + more))
        return run_short(campaign, device, None)

    said = in_a_child(work)
    assert said.startswith("ResourceError")
    assert f"at most {1 + more} (ulimit -u)" in said
    assert not device.driven


def test_a_thread_that_does_not_begin_is_an_error_in_bounded_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As when the system made it, but it has no memory to begin with."""
    monkeypatch.setattr(processes, "START_TIMEOUT", 0.1)
    monkeypatch.setattr(Background, "_bootstrap", lambda _: None)
    began = time.monotonic()
    with pytest.raises(ResourceError, match=r"has not begun after 0\.1 s"):
        Background(lambda: None, "undertow test")
    assert time.monotonic() - began < 10.0


def test_a_thread_of_ours_begins_works_and_ends() -> None:
    done, go = threading.Event(), threading.Event()

    def work() -> None:
        go.wait(5.0)
        done.set()

    thread = Background(work, "undertow test")
    assert thread.is_alive()
    go.set()
    thread.join(5.0)
    assert not thread.is_alive()
    assert done.is_set()


def test_a_machine_without_memory_is_found_before_a_session(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(processes, "_available", lambda: 50.0 * 2**20)
    with pytest.raises(ResourceError, match=r"50 MiB free, must be .* MiB free"):
        check_resources(processes=3)


@linux
@pytest.mark.slow  # a run against the clock each
@pytest.mark.parametrize("name", ["RLIMIT_AS", "RLIMIT_NOFILE", "RLIMIT_FSIZE"])
def test_a_limit_that_is_met_in_a_run_ends_safely(
    campaign: Systematic, tmp_path: Path, name: str
) -> None:
    """Nothing is to be had from some moment on: zero at the end, and a log that opens."""
    device, log = device_of(campaign), tmp_path / "run.db"

    class Starved:
        period, left = device.period, 100

        def read(self) -> Measurement:
            self.left -= 1
            if self.left == 0:
                lower(name, {"RLIMIT_AS": used("memory"), "RLIMIT_NOFILE": 0}.get(name, 4096))
            return device.read()

        def write(self, u: FloatArray) -> None:
            device.write(u)

        def close(self) -> None:
            device.close()

    said = in_a_child(lambda: run_short(campaign, Starved(), log, 0.4))
    assert said.startswith(("balanced", "caught", "stopped", "degraded")), said
    assert device.driven
    assert not device.last.any()
    recording = read_log(log)
    assert len(recording.steps) > 50
    controller = campaign.recipes["ideal"].make_controller(campaign.memory)
    assert replay_controller(recording, controller).identical


# -- signals at any moment ------------------------------------------------------------------------


MOMENTS = ["first", "warming up", "ready", "between", "read", "close", "log", "worker"]


@pytest.mark.parametrize(
    "moment",
    [pytest.param(m, marks=() if m == "ready" else pytest.mark.slow) for m in MOMENTS],
)
def test_two_signals_at_any_moment_of_a_session_end_safely(
    campaign: Systematic, tmp_path: Path, moment: str
) -> None:
    """While it is prepared, before the run, in it, while it is closed: zero, and one file left."""
    device, log = device_of(campaign), tmp_path / "run.db"
    recipe = campaign.recipes["ideal"]

    def ask(*_: Any) -> None:
        for number in (signal.SIGTERM, signal.SIGINT):
            os.kill(os.getpid(), number)

    def before(honest: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **options: Any) -> Any:
            ask()
            return honest(*args, **options)

        return call

    def work() -> str:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        if moment == "first":
            vars(recipe)["first"] = before(recipe.first)
        elif moment in ("read", "close"):
            setattr(device, moment, before(getattr(device, moment)))
        elif moment == "log":
            logs.Log.close = before(logs.Log.close)  # type: ignore[method-assign]

        def progress(what: str, _fraction: float) -> None:
            if what == moment:
                ask()

        with session(recipe, rig=device, log=log, processes=2, progress=progress) as runtime:
            if moment == "worker":
                runtime.worker.close = before(runtime.worker.close)  # type: ignore[method-assign]
            if moment == "between":
                ask()
            report = runtime.run(0.15)
        return str(report.verdict)

    said = in_a_child(work)
    prepared = moment not in ("first", "warming up", "ready")
    assert said.startswith(("stopped", "caught", "degraded") if prepared else "KeyboardInterrupt")
    assert not device.last.any()
    if not prepared:
        assert not device.driven
    assert [p.name for p in tmp_path.iterdir()] == (
        ["run.db"] if prepared or moment == "ready" else []
    )
    if prepared:
        assert len(read_log(log).steps) > 0


def test_what_is_closed_is_not_disturbed() -> None:
    """And what a signal did before it does again."""
    heard: list[int] = []
    before = signal.signal(signal.SIGTERM, lambda number, _: heard.append(number))
    try:
        with processes.signals_ignored():
            os.kill(os.getpid(), signal.SIGTERM)
        assert heard == []
        os.kill(os.getpid(), signal.SIGTERM)
        assert heard == [signal.SIGTERM]
    finally:
        signal.signal(signal.SIGTERM, before)


@pytest.mark.slow
def test_a_stop_while_processes_are_made_leaves_none(campaign: Systematic) -> None:
    """At every seventh line that Python runs meanwhile, our own and its library's."""
    number, beyond = 1, False
    while not beyond:
        ours, theirs = processes.pipe()

        def work(number: int = number, say: Any = theirs) -> None:
            left, process = number, os.getpid()
            signal.signal(signal.SIGTERM, signal.default_int_handler)

            def trace(*_: object) -> Any:
                nonlocal left
                left -= 1
                if left == 0 and os.getpid() == process:
                    sys.settrace(None)
                    os.kill(process, signal.SIGTERM)
                return trace if left > 0 and os.getpid() == process else None

            sys.settrace(trace)
            try:
                workers.background_worker(campaign.recipes["ideal"].respond, processes=2).close()
            finally:
                sys.settrace(None)
                say.send(left > 0)

        child = fork(work, (), "child of a test", daemon=False)
        child.join(10.0)
        assert not child.is_alive(), number
        beyond, number = ours.recv(), number + 7
        ours.close()
        theirs.close()
    assert number > 700


@pytest.mark.slow
def test_two_signals_at_random_moments_end_safely(campaign: Systematic, tmp_path: Path) -> None:
    rng, recipe = np.random.default_rng(0), campaign.recipes["ideal"]
    for number in range(25):
        device, log = device_of(campaign), tmp_path / str(number) / "run.db"

        def work(device: Device = device, log: Path = log) -> None:
            run_short(campaign, device, log, 0.3)

        child = fork(work, (), "child of a test", daemon=False)
        for pause in rng.uniform(0.02, 0.5, 2):
            time.sleep(float(pause))
            if child.is_alive():
                os.kill(child.pid or 0, signal.SIGTERM)
        child.join(15.0)
        assert not child.is_alive()
        assert not device.last.any()
        if log.exists():
            assert not log.with_name("run.db-wal").exists()
            controller = recipe.make_controller(campaign.memory)
            again = replay_controller(read_log(log), controller)
            assert again.identical or again.steps == 0
