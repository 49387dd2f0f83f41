"""The log opens after anything, with other tools too; its replay is the run, bit for bit."""

from __future__ import annotations

import contextlib
import errno
import itertools
import json
import math
import multiprocessing
import os
import shutil
import sqlite3
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
import pytest
import sympy as sp

import undertow as ut
from undertow.base import ArtefactError, ResourceError, UndertowError
from undertow.cascade import CascadeState
from undertow.estimators import KalmanFilter, Measured
from undertow.law import Plan
from undertow.plants import Measurement
from undertow.plants.interface import RigWrapper
from undertow.runtime import (
    Columns,
    InlineWorker,
    Log,
    Recipe,
    Report,
    Runtime,
    SimulatedClock,
    about,
    column_units,
    read_log,
    replay,
    replay_controller,
    respond,
)
from undertow.runtime import log as log_module
from undertow.runtime.encoding import answer_from, answer_row, memory_from, memory_to
from undertow.runtime.log import part_path
from undertow.runtime.replay import build
from undertow.runtime.slow_loop import Request
from undertow.studies.rigs.figures import pictures

RECIPE = Recipe(rig="realistic", evaluations=64, start=(0.0, 0.2, 0.0, 0.0))
MEMORY = CascadeState(Plan.of(ut.Surface(alpha_a=-1, lambda_a=-0.25, alpha_u=1.6, lambda_u=17.3)))
COLUMNS = Columns.of(RECIPE.belief)


def make(path: Path, seconds: float = 0.6) -> Report:
    """A short run on the realistic rig in simulated time."""
    controller = RECIPE.make_controller(MEMORY)
    worker = InlineWorker(lambda request: respond(RECIPE.cascade, request))
    with Log(path, COLUMNS, about(controller, RECIPE), threaded=False) as log:
        rig, clock = RECIPE.make_rig(), SimulatedClock()
        return Runtime(controller, rig, worker, clock=clock, log=log).run(seconds)


@pytest.fixture(scope="module")
def logged(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("log") / "run.db"
    make(path)
    return path


# -- replay ----------------------------------------------------------------------------------


def test_the_replay_of_a_run_is_the_run_bit_for_bit(logged: Path) -> None:
    """Outputs, estimates, surface values, states, and every decision of the gate."""
    result = replay(logged)
    assert result.identical
    assert result.steps == len(result.recording.steps) > 600
    assert result.judged >= 4
    assert result.gap is None
    np.testing.assert_array_equal(result.u[:, 0], result.recording["voltage"])


def test_velocities_that_were_lost_are_lost_in_the_replay(tmp_path: Path) -> None:
    """A step without any came back as of a rig that measures none, which ``Measured`` refuses."""

    class Lossy(RigWrapper):
        def read(self) -> Measurement:
            measured = super().read()
            assert measured.v is not None
            lost = math.nan if round(1e3 * measured.t) % 10 < 3 else 1.0
            return Measurement(measured.t, measured.q, lost * measured.v)

    recipe = replace(RECIPE, rig="ideal", estimator=lambda model, _: Measured(model))
    controller, path = recipe.make_controller(MEMORY), tmp_path / "lossy.db"
    worker = InlineWorker(lambda request: respond(recipe.cascade, request))
    with Log(path, COLUMNS, about(controller, recipe), threaded=False) as log:
        rig, clock = Lossy(recipe.make_rig()), SimulatedClock()
        assert Runtime(controller, rig, worker, clock=clock, log=log).run(0.1).steps > 90
    assert replay(path, estimator=recipe.estimator, decisions=False).identical


@pytest.mark.parametrize("column", ["phi_measured", "voltage", "theta_dot"])
def test_a_single_bit_is_noticed(logged: Path, tmp_path: Path, column: str) -> None:
    """A number in the middle of the log, changed in its last bit, is found in its step."""
    copy = tmp_path / "changed.db"
    copy.write_bytes(logged.read_bytes())
    with sqlite3.connect(copy) as file:
        (value,) = file.execute(f"SELECT {column} FROM steps WHERE k = 300").fetchone()
        changed = float(np.nextafter(value, np.inf))
        file.execute(f"UPDATE steps SET {column} = ? WHERE k = 300", (changed,))
    file.close()
    result = replay(copy, decisions=False)
    assert not result.identical
    assert result.first == 300


def test_a_lost_row_ends_the_replay_there(logged: Path, tmp_path: Path) -> None:
    copy = tmp_path / "gap.db"
    copy.write_bytes(logged.read_bytes())
    with sqlite3.connect(copy) as file:
        file.execute("DELETE FROM steps WHERE k = 200")
    file.close()
    result = replay(copy, decisions=False)
    assert (result.gap, result.steps, result.differing) == (200, 200, 0)


def test_a_controller_with_another_belief_is_refused(logged: Path) -> None:
    other = Recipe(parameters={"d_e": 0.02})
    with pytest.raises(ArtefactError, match="other equations or numbers"):
        replay_controller(read_log(logged), other.make_controller(MEMORY))


def test_a_replay_says_that_the_sources_have_changed(
    logged: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert replay(logged, decisions=False).build == {}
    now = build()
    module = sys.modules["undertow.runtime.replay"]  # the package has a function of that name
    monkeypatch.setattr(module, "build", lambda: {**now, "sources": "others"})
    assert replay(logged, decisions=False).build == {"sources": (now["sources"], "others")}


def test_same_seed_same_log(logged: Path, tmp_path: Path) -> None:
    make(tmp_path / "again.db")
    first, again = read_log(logged), read_log(tmp_path / "again.db")
    np.testing.assert_array_equal(first.steps, again.steps)


HASHED = """
import hashlib
import undertow as ut
from undertow.cascade import CascadeState
from undertow.law.schedule import Plan
from undertow.runtime import Command, Inputs, Recipe
recipe = Recipe(rig="realistic", start=(0.0, 0.2, 0.0, 0.0))
surface = ut.Surface(alpha_a=-1, lambda_a=-0.25, alpha_u=1.6, lambda_u=17.3)
controller = recipe.make_controller(CascadeState(Plan.of(surface)))
rig, digest = recipe.make_rig(), hashlib.sha256()
for k in range(400):
    u = controller.step(Inputs(1e-3 * k, rig.read(), None, Command(1 if k == 0 else 0)))
    digest.update(u.tobytes() + controller.x.tobytes())
    rig.write(u.copy())
assert u.any()
print(digest.hexdigest())
"""


@pytest.mark.slow
def test_what_compiles_and_what_loads_the_compiled_gives_the_same_bits(tmp_path: Path) -> None:
    """The first run on a machine can be replayed by the processes after it."""
    here = {**os.environ, "UNDERTOW_CACHE": str(tmp_path), "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-c", HASHED]
    said = [
        subprocess.run(command, env=here, check=True, capture_output=True, text=True).stdout
        for _ in range(2)
    ]
    assert said[0] == said[1]
    assert len(said[0]) == 65


# -- the file ---------------------------------------------------------------------------------


def test_the_file_opens_with_plain_sqlite(logged: Path) -> None:
    """One file, no companions, columns named after the mechanism, numbers as numbers."""
    assert [path.name for path in logged.parent.iterdir()] == ["run.db"]
    with sqlite3.connect(logged) as file:
        rows = file.execute("SELECT k, t, phi, voltage, mode FROM steps ORDER BY k").fetchall()
        (integrity,) = file.execute("PRAGMA integrity_check").fetchone()
        meta = {k: json.loads(v) for k, v in file.execute("SELECT * FROM meta")}
    file.close()
    assert integrity == "ok"
    assert [row[0] for row in rows] == list(range(len(rows)))
    assert all(isinstance(row[3], float) for row in rows)
    assert meta["mechanism"] == "rotary_pendulum"
    assert Recipe.from_dict(meta["recipe"]) == RECIPE


def test_an_estimator_that_the_run_did_not_have_is_refused(logged: Path) -> None:
    with pytest.raises(ArtefactError, match=r"library's estimator.*Leave estimator out"):
        replay(logged, estimator=lambda model, bench: KalmanFilter(model, bench.timing.period))


def fill(log: Log, count: int) -> None:
    for _ in range(count):
        log.row[:] = log.row[0]
        log.commit_row()
        log.row[0] += 1


def test_a_full_disk_ends_the_log_and_not_the_run(tmp_path: Path) -> None:
    """What was written before can be read; the rest is counted."""
    log = Log(tmp_path / "full.db", COLUMNS, {}, threaded=False, max_bytes=100_000)
    fill(log, 3000)
    log.close()
    assert "full" in log.failure
    rows = read_log(tmp_path / "full.db").steps
    assert 0 < len(rows) < 3000
    assert log.dropped == 3000 - len(rows)
    np.testing.assert_array_equal(rows[:, 0], np.arange(len(rows)))


def test_a_ring_that_overflows_drops_and_counts_and_does_not_wait(tmp_path: Path) -> None:
    log = Log(tmp_path / "ring.db", COLUMNS, {}, threaded=False)
    log._thread = object()  # type: ignore[assignment]  # a writer that never comes
    fill(log, 9000)
    assert log.dropped == 9000 - 8192
    log._thread = None
    log.close()
    assert len(read_log(tmp_path / "ring.db").steps) == 8192


def test_names_that_a_log_has_itself_get_columns_of_their_own(tmp_path: Path) -> None:
    """An input T was the column t to SQLite, and a state s_1 a surface value to figures."""
    names = {"x": "s_1", "x_dot": "s_1_dot", "phi": "K", "phi_dot": "K_dot"}
    cart = ut.mechanisms.cart_pendulum()
    renamed = {sp.Symbol(k, real=True): sp.Symbol(v, real=True) for k, v in names.items()}
    mine = ut.Mechanism(
        "mine",
        (ut.Coordinate("s_1", "m"), ut.Coordinate("K", "rad")),
        (ut.Input("T", "N", 10.0),),
        cart.mass_matrix.subs(renamed),
        cart.force.subs(renamed),
        parameters=cart.parameters,
    )
    columns = Columns.of(mine)
    assert len({name.lower() for name in columns.names}) == len(columns.names)
    Log(tmp_path / "run.db", columns, {}, threaded=False).close()
    groups = Columns.groups(columns.names)
    assert groups["state"] == ["s_1", "K_", "s_1_dot", "K_dot"]
    assert groups["input"] == ["T_"]
    assert groups["surface"] == ["s_0", "margin", "surface"]
    recording = replace(read_log(tmp_path / "run.db"), meta={
        "coordinates": {"s_1": "m", "K": "rad"}, "units": {"T": "N"},
    })  # fmt: skip
    units = column_units(recording)
    assert (units["T_"], units["K_"], units["K_dot"], units["s_1"]) == ("N", "rad", "rad/s", "m")
    assert Columns.of(cart).names[6:8] == ("x_measured", "phi_measured")


def test_an_earlier_log_is_kept(tmp_path: Path) -> None:
    for earlier in (None, tmp_path / "run.db.1", tmp_path / "run.db.2"):
        log = Log(tmp_path / "run.db", COLUMNS, {}, threaded=False)
        log.close()
        assert log.earlier == earlier
    assert sorted(p.name for p in tmp_path.iterdir()) == ["run.db", "run.db.1", "run.db.2"]


@pytest.mark.parametrize("what", ["a log in use", "a folder", "a text", "a word", "a database"])
def test_what_is_in_use_or_no_log_is_left_alone(tmp_path: Path, what: str) -> None:
    """Two runs must not write to one another's files, nor a log push other things aside."""
    path = tmp_path / "run.db"
    first = Log(path, COLUMNS, {}, threaded=False) if what == "a log in use" else None
    if what == "a folder":
        path.mkdir()
    elif what == "a text":
        path.write_text("not a database, by any means" * 20)
    elif what == "a word":  # SQLite takes so few bytes for an empty database
        path.write_text("x")
    elif what == "a database":
        with contextlib.closing(sqlite3.connect(path)) as file:
            file.execute("CREATE TABLE addresses (name TEXT)")
    with pytest.raises(ArtefactError, match=r"still writes|not a log"):
        Log(path, COLUMNS, {}, threaded=False)
    if first is not None:
        fill(first, 300)
        first.close()
        assert len(read_log(path).steps) == 300
    assert [p.name for p in tmp_path.iterdir()] == ["run.db"]


def test_a_log_that_was_removed_says_so(tmp_path: Path) -> None:
    log = Log(tmp_path / "sub" / "run.db", COLUMNS, {}, threaded=False)
    fill(log, 300)
    shutil.rmtree(tmp_path / "sub")
    fill(log, 300)
    log.close()
    assert "removed" in log.failure
    assert log.dropped == 600


def test_a_text_that_no_file_can_hold_costs_no_rows(tmp_path: Path) -> None:
    """What a driver says of itself may be any bytes."""
    log = Log(tmp_path / "run.db", COLUMNS, {}, threaded=False)
    log.event(0, 0.0, "rig", "\udcff broke")
    fill(log, 100)
    log.close()
    recording = read_log(tmp_path / "run.db")
    assert (log.failure, len(recording.steps)) == ("", 100)
    assert recording.events == ((0, 0.0, "rig", "? broke"),)


@pytest.mark.parametrize("what", ["nothing", "text", "empty"])
def test_what_is_no_log_is_refused(tmp_path: Path, what: str) -> None:
    path = tmp_path / "x.db"
    if what == "text":
        path.write_text("not a database, by any means")
    elif what == "empty":
        path.touch()
    with pytest.raises(ArtefactError, match=r"log '.*x\.db'"):
        read_log(path)


def write_for_ever(path: Path, said: Connection) -> None:
    """Write a row each millisecond, and tell of every fiftieth."""
    log, began = Log(path, COLUMNS, {}), time.perf_counter()
    for k in itertools.count():
        while time.perf_counter() < began + 1e-3 * k:
            time.sleep(2e-4)
        log.row[:] = k
        log.commit_row()
        if k % 50 == 0:
            said.send(k)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="the writer is a forked process")
def test_a_log_whose_writer_was_killed_opens(tmp_path: Path) -> None:
    """SIGKILL in the middle of writing: the file is sound, and no row is missing between."""
    path = tmp_path / "killed.db"
    heard, telling = multiprocessing.Pipe(duplex=False)
    process = multiprocessing.get_context("fork").Process(
        target=write_for_ever, args=(path, telling), daemon=True
    )
    process.start()
    said = [heard.recv() for _ in range(9)]
    process.kill()
    process.join()
    heard.close()
    telling.close()
    rows = read_log(path).steps
    np.testing.assert_array_equal(rows[:, 0], np.arange(len(rows)))
    assert len(rows) >= said[0]


# -- power, parts, privacy ----------------------------------------------------------------------


def modes(folder: Path) -> set[int]:
    return {path.stat().st_mode & 0o777 for path in folder.iterdir() if path.is_file()}


@pytest.mark.skipif(os.name != "posix", reason="modes of POSIX")
def test_a_log_is_its_owners_alone(tmp_path: Path) -> None:
    """With what lies beside it while it is written, and its further parts."""
    before = os.umask(0)
    try:
        log = Log(tmp_path / "run.db", COLUMNS, {}, threaded=False, part_bytes=1)
        fill(log, 300)
        assert {"run.db", "run.db-wal"} <= {path.name for path in tmp_path.iterdir()}
        assert modes(tmp_path) == {0o600}
        log._synced -= 1.0
        fill(log, 300)
        log.close()
        assert part_path(tmp_path / "run.db", 2).exists()
        assert modes(tmp_path) == {0o600}
    finally:
        os.umask(before)


def test_the_log_is_on_the_disk_after_half_a_second(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And its write-ahead log does not grow: both where nobody reads it, and where one does."""
    path, beside = tmp_path / "run.db", tmp_path / "run.db-wal"
    synced: list[Path] = []
    monkeypatch.setattr(log_module, "_sync_file", synced.append)
    with Log(path, COLUMNS, {}, threaded=False) as log:
        sizes = []
        for _ in range(20):
            fill(log, 500)
            log._synced -= 1.0  # as if half a second had passed
            log.flush()
            fill(log, 1)
            log._unsynced = True
            log.flush()
            sizes.append(beside.stat().st_size)
        assert path.stat().st_size > 10 * max(sizes[5:]) / 4
        assert max(sizes) == max(sizes[:5])
        assert synced == []
        with contextlib.closing(sqlite3.connect(path)) as reader:
            reader.execute("BEGIN")
            reader.execute("SELECT count(*) FROM steps").fetchone()
            fill(log, 500)
            log._synced -= 1.0
            log.flush()
            assert synced == [beside]  # the reader keeps it from being moved, not from the disk


def test_a_thread_syncs_by_itself(tmp_path: Path) -> None:
    """What was written half a second ago has left the write-ahead log."""
    path = tmp_path / "run.db"
    with Log(path, COLUMNS, {}) as log:
        fill(log, 2000)
        deadline = time.monotonic() + 10.0
        while time.monotonic() < deadline and path.stat().st_size < 100_000:
            time.sleep(0.02)
        assert path.stat().st_size > 100_000


def test_a_log_goes_on_in_further_files_and_is_read_as_one(tmp_path: Path) -> None:
    """Its replay too is the run; one part by itself is refused, and so is a part of another run."""
    path = tmp_path / "run.db"
    controller = RECIPE.make_controller(MEMORY)
    worker = InlineWorker(lambda request: respond(RECIPE.cascade, request))
    meta = about(controller, RECIPE)
    with Log(path, COLUMNS, meta, threaded=False, part_bytes=30_000) as log:
        log._keep_safe = _always(log)  # type: ignore[method-assign]
        rig, clock = RECIPE.make_rig(), SimulatedClock()
        report = Runtime(controller, rig, worker, clock=clock, log=log).run(0.6)
    parts = [p.name for p in sorted(tmp_path.iterdir())]
    assert parts[:2] == ["run.db", "run.db-2"]
    recording = read_log(path)
    assert len(recording.steps) == report.steps
    assert replay(path, decisions=False).identical
    with pytest.raises(ArtefactError, match="part 2 of a log"):
        read_log(part_path(path, 2))
    with contextlib.closing(sqlite3.connect(part_path(path, 2))) as file:
        file.execute("UPDATE meta SET value = '\"other\"' WHERE key = 'run'")
        file.commit()
    assert len(read_log(path).steps) < report.steps
    part_path(path, 2).unlink()
    rest = replay(path, decisions=False)
    assert rest.gap == rest.steps > 0


def _always(log: Log) -> Callable[[], None]:
    """Half a second has always passed."""

    def keep_safe() -> None:
        log._synced -= 1.0
        Log._keep_safe(log)

    return keep_safe


def test_an_earlier_log_is_kept_with_its_parts(tmp_path: Path) -> None:
    path = tmp_path / "run.db"
    for _ in range(2):
        with Log(path, COLUMNS, {}, threaded=False, part_bytes=1) as log:
            log._keep_safe = _always(log)  # type: ignore[method-assign]
            fill(log, 750)
    names = {p.name for p in tmp_path.iterdir()}
    assert {"run.db", "run.db-2", "run.db.1", "run.db.1-2"} <= names
    assert len(read_log(path).steps) == len(read_log(tmp_path / "run.db.1").steps) == 750


@pytest.mark.parametrize("writable", [True, False])
def test_to_read_a_killed_log_changes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, writable: bool
) -> None:
    """Neither the file nor what lies beside it; also where nothing can be written."""
    path = tmp_path / "run.db"
    with Log(path, COLUMNS, {}, threaded=False) as log:
        fill(log, 1000)
        left = tmp_path / "left"
        left.mkdir()
        for end in ("", "-wal"):
            shutil.copy(f"{path}{end}", left / f"run.db{end}")
    before = {p.name: p.read_bytes() for p in left.iterdir()}
    if not writable:
        monkeypatch.setattr(os, "access", lambda *_: False)
    assert len(read_log(left / "run.db").steps) == 1000
    assert {n: (left / n).read_bytes() for n in before} == before
    if not writable:
        assert {p.name for p in left.iterdir()} == set(before)


def test_a_log_that_was_cut_off_while_it_was_closed_is_read(tmp_path: Path) -> None:
    """Its journal, which tells how the file was, is followed beside a copy."""
    path = tmp_path / "run.db"
    with Log(path, COLUMNS, {}, threaded=False) as log:
        fill(log, 500)
    left = tmp_path / "left"
    left.mkdir()
    with contextlib.closing(sqlite3.connect(path, isolation_level=None)) as file:
        file.execute("PRAGMA cache_size = 1")
        file.execute("BEGIN")
        file.execute("UPDATE steps SET phi = 7.0")  # more than its memory holds: it writes
        for end in ("", "-journal"):
            shutil.copy(f"{path}{end}", left / f"run.db{end}")
        file.execute("ROLLBACK")
    before = {p.name: p.read_bytes() for p in left.iterdir()}
    assert before["run.db"] != path.read_bytes()
    np.testing.assert_array_equal(read_log(left / "run.db").steps, read_log(path).steps)
    assert {p.name: p.read_bytes() for p in left.iterdir()} == before


def test_a_journal_that_names_a_file_does_not_remove_it(tmp_path: Path) -> None:
    """SQLite would: it takes the file for one that ties several journals together."""
    path, victim = tmp_path / "run.db", tmp_path / "victim"
    with Log(path, COLUMNS, {}, threaded=False) as log:
        fill(log, 500)
    victim.write_text("of value")
    name = str(victim).encode()
    with contextlib.closing(sqlite3.connect(path, isolation_level=None)) as file:
        file.execute("PRAGMA cache_size = 1")
        file.execute("BEGIN")
        file.execute("UPDATE steps SET phi = 7.0")
        journal = Path(f"{path}-journal").read_bytes()
        file.execute("ROLLBACK")
    tail = struct.pack(">I", 0) + name + struct.pack(">II", len(name), sum(name))
    Path(f"{path}-journal").write_bytes(journal + tail + log_module.JOURNAL)
    with pytest.raises(ArtefactError, match="names another"):
        read_log(path)
    assert victim.read_text() == "of value"


def test_companions_that_others_left_are_not_used(tmp_path: Path) -> None:
    """Anybody may have made them, in a folder that all can write, to read what is logged."""
    path = tmp_path / "run.db"
    theirs = tmp_path / "theirs"
    theirs.touch(mode=0o666)
    for end in ("-wal", "-shm", "-journal"):
        Path(f"{path}{end}").symlink_to(theirs)
    with Log(path, COLUMNS, {}, threaded=False) as log:
        fill(log, 500)
    assert theirs.stat().st_size == 0
    assert len(read_log(path).steps) == 500


def test_a_file_in_the_way_of_a_part_is_moved_aside(tmp_path: Path) -> None:
    path = tmp_path / "run.db"
    with Log(path, COLUMNS, {}, threaded=False, part_bytes=1) as log:
        log._keep_safe = _always(log)  # type: ignore[method-assign]
        with contextlib.closing(sqlite3.connect(part_path(path, 2))) as file:
            file.execute("CREATE TABLE mine (a)")
        fill(log, 750)
    assert log.failure == ""
    assert len(read_log(path).steps) == 750
    assert Path(f"{path}-2.1").exists()


@pytest.mark.parametrize("what", ["full", "no handles", "no threads"])
def test_a_log_for_which_something_lacks_is_refused_before_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    path = tmp_path / "run.db"
    if what == "full":
        usage = shutil.disk_usage(tmp_path)._replace(free=1000)
        monkeypatch.setattr(shutil, "disk_usage", lambda _: usage)
    elif what == "no handles":

        def refuse(*_args: object) -> int:
            raise OSError(errno.EMFILE, "Too many open files")

        monkeypatch.setattr(os, "open", refuse)
    else:

        def unable(_thread: threading.Thread) -> None:
            raise RuntimeError("can't start new thread")

        monkeypatch.setattr(threading.Thread, "start", unable)
    refusal: type[UndertowError] = ArtefactError
    named = r"run\.db"
    if what == "no threads":
        refusal, named = ResourceError, "thread 'undertow log'"
    with pytest.raises(refusal, match=named):
        Log(path, COLUMNS, {})


def test_a_disk_that_refuses_a_sync_ends_the_log_and_not_the_run(tmp_path: Path) -> None:
    log = Log(tmp_path / "run.db", COLUMNS, {}, threaded=False)
    fill(log, 500)

    def refuse() -> None:
        raise OSError(errno.EIO, "Input/output error")

    log._keep_safe = refuse  # type: ignore[method-assign]
    fill(log, 500)
    log.close()
    assert "Input/output error" in log.failure
    rows = read_log(tmp_path / "run.db").steps
    np.testing.assert_array_equal(rows[:, 0], np.arange(len(rows)))
    assert len(rows) + log.dropped == 1000


# -- encoding ---------------------------------------------------------------------------------


def test_answers_and_memories_survive_the_log_exactly() -> None:
    """A schedule of surfaces with reaching laws of their own, too."""
    quick = ut.Surface(alpha_a=-1, lambda_a=-1.0 / 3.0, alpha_u=1.96, lambda_u=12.1)
    law = ut.ReachingLaw(eta=20.0 / 3.0, layer=(0.1,))
    plan = Plan((MEMORY.surface, quick), (0.0, 0.1), (law, ut.ReachingLaw()))
    memory = CascadeState(plan, 3, 1.0 / 7.0, 0.1, 0.3)
    assert memory_from(json.loads(json.dumps(memory_to(memory)))) == memory
    answer = respond(RECIPE.cascade, Request(0.0, RECIPE.x0, 0.1, MEMORY))
    names = (
        "k", "sequence", "use", "accepted", "reason", "status", "cost", "incumbent_cost",
        "predicted", "evaluations", "seconds", "body",
    )  # fmt: skip
    again = answer_from(dict(zip(names, answer_row(7, answer), strict=True)))
    assert again.memory == answer.memory
    assert again.proposal.plan == answer.proposal.plan
    assert again.admission.cost == answer.admission.cost
    np.testing.assert_array_equal(again.law_vectors, answer.law_vectors)
    np.testing.assert_array_equal(again.x, answer.x)


def test_the_pictures_of_a_log_are_pictures(logged: Path) -> None:
    recording = read_log(logged)
    drawn = pictures(recording)
    assert set(drawn) == {"motion.png", "latency.png", "chatter.png"}
    assert all(content.startswith(b"\x89PNG") for content in drawn.values())


def test_a_zero_byte_in_the_name_of_a_log_is_said(tmp_path: Path) -> None:
    """It was a ValueError, after the first optimum."""
    with pytest.raises(ArtefactError, match="a zero byte in its name"):
        log_module.check_log(tmp_path / "run\0.db")
