"""The log opens after anything, with other tools too; its replay is the run, bit for bit."""

from __future__ import annotations

import json
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import undertow as ut
from undertow.cascade import CascadeState
from undertow.errors import ArtefactError
from undertow.plan import Plan
from undertow.runtime import (
    Columns,
    InlineWorker,
    Log,
    Recipe,
    Report,
    Runtime,
    SimulatedClock,
    about,
    read_log,
    replay,
    replay_controller,
    respond,
)
from undertow.runtime.encoding import answer_from, answer_row, memory_from, memory_to
from undertow.runtime.figures import chatter_figure, latency_figure, motion_figure
from undertow.runtime.replay import build
from undertow.runtime.slow import Request

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
from undertow.plan import Plan
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


def fill(log: Log, count: int) -> None:
    for _ in range(count):
        log.row[:] = log.row[0]
        log.commit_row()
        log.row[0] += 1


def test_a_full_disk_ends_the_log_and_not_the_run(tmp_path: Path) -> None:
    """What was written before can be read; the rest is counted."""
    log = Log(tmp_path / "full.db", COLUMNS, {}, threaded=False, most_bytes=100_000)
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


def test_an_earlier_log_is_kept(tmp_path: Path) -> None:
    for _ in range(3):
        Log(tmp_path / "run.db", COLUMNS, {}, threaded=False).close()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["run.db", "run.db.1", "run.db.2"]


@pytest.mark.parametrize("what", ["a log in use", "a folder", "a text"])
def test_what_is_in_use_or_no_log_is_left_alone(tmp_path: Path, what: str) -> None:
    """Two runs must not write to one another's files, nor a log push other things aside."""
    path = tmp_path / "run.db"
    first = Log(path, COLUMNS, {}, threaded=False) if what == "a log in use" else None
    if what == "a folder":
        path.mkdir()
    elif what == "a text":
        path.write_text("not a database, by any means" * 20)
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


KILLED = """
import sys, time
import numpy as np
from pathlib import Path
sys.path.insert(0, {source!r})
from undertow.mechanisms import rotary_pendulum
from undertow.runtime.log import Columns, Log
columns = Columns.of(rotary_pendulum())
log = Log(Path({path!r}), columns, {{}})
began = time.perf_counter()
for k in range(100_000):
    while time.perf_counter() < began + 1e-3 * k:
        time.sleep(2e-4)
    log.row[:] = k
    log.commit_row()
    if k % 50 == 0:
        print(k, flush=True)
"""


def test_a_log_whose_writer_was_killed_opens(tmp_path: Path) -> None:
    """SIGKILL in the middle of writing: the file is sound, and no row is missing between."""
    path = tmp_path / "killed.db"
    script = KILLED.format(source=str(Path(ut.__file__).parents[1]), path=str(path))
    process = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    said = [int(process.stdout.readline()) for _ in range(9)]
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    process.stdout.close()
    rows = read_log(path).steps
    np.testing.assert_array_equal(rows[:, 0], np.arange(len(rows)))
    assert len(rows) >= said[0]


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
    np.testing.assert_array_equal(again.lanes, answer.lanes)
    np.testing.assert_array_equal(again.x, answer.x)


def test_the_pictures_of_a_log_are_pictures(logged: Path) -> None:
    recording = read_log(logged)
    for figure in (motion_figure, latency_figure, chatter_figure):
        assert figure(recording).startswith(b"\x89PNG")
