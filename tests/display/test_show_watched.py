"""A run that is watched: its log read as it grows, and the page that shows it meanwhile."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from runs import RECIPE, run, short_searches
from undertow.base import ArtefactError, InvalidInputError
from undertow.display.live import Message
from undertow.display.live.page import encoded
from undertow.runtime import (
    Columns,
    GrowingLog,
    InlineWorker,
    Log,
    Runtime,
    SimulatedClock,
    about,
)
from undertow.studies.live import Watched, of_log
from undertow.studies.live.window import Window

COLUMNS = Columns.of(RECIPE.belief)


@pytest.fixture(scope="module")
def meta() -> dict[str, object]:
    with short_searches():
        return about(RECIPE.make_controller(RECIPE.first()), RECIPE)


def write(book: Log, first: int, count: int) -> None:
    """Write steps into a log, as a run does, and have them in the file."""
    for k in range(first, first + count):
        book.row[:] = 0.0
        book.row[COLUMNS.k], book.row[COLUMNS.t] = k, 1e-3 * k
        book.commit_row()
    book.flush()


@pytest.fixture
def book(tmp_path: Path, meta: dict[str, object]) -> Iterator[Log]:
    with Log(tmp_path / "run.db", COLUMNS, meta, threaded=False) as book:
        yield book


def test_each_look_finds_what_is_new(book: Log) -> None:
    """Every fifth step, once; events and answers, once; nothing where nothing was written."""
    growing = GrowingLog(book.path)
    assert not growing.over
    assert len(growing.news().steps) == 0
    write(book, 0, 12)
    book.event(3, 0.003, "state", "IDLE → CATCH")
    book.flush()
    found = growing.news(every=5)
    assert found.steps[:, COLUMNS.k].tolist() == [0, 5, 10]
    assert [text for *_, text in found.events] == ["IDLE → CATCH"]
    write(book, 12, 14)
    found = growing.news(every=5)
    assert found.steps[:, COLUMNS.k].tolist() == [15, 20, 25]
    assert found.events == ()
    assert len(growing.news(every=5).steps) == 0
    assert GrowingLog(book.path).news(most=4).steps[:, COLUMNS.k].tolist() == [22, 23, 24, 25]
    assert not growing.over
    book.close()
    assert growing.over
    assert not Path(f"{book.path}-wal").exists()


def test_a_log_that_goes_on_in_another_file_is_followed(
    tmp_path: Path, meta: dict[str, object], monkeypatch: pytest.MonkeyPatch
) -> None:
    """All steps in their order over three parts, and over only where the last one is closed."""
    monkeypatch.setattr("undertow.runtime.log.SYNC_INTERVAL", 0.0)
    with Log(tmp_path / "run.db", COLUMNS, meta, threaded=False, part_bytes=1) as book:
        growing, seen = GrowingLog(book.path), list[float]()
        for k in range(3):
            write(book, 10 * k, 10)
            seen += growing.news().steps[:, COLUMNS.k].tolist()
            assert not growing.over
    seen += growing.news().steps[:, COLUMNS.k].tolist()
    assert seen == list(range(30))
    assert (tmp_path / "run.db-3").exists()
    assert growing.over


def test_a_killed_run_is_over_after_a_while(book: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    growing = GrowingLog(book.path)
    monkeypatch.setattr("undertow.runtime.recording.SILENCE", 0.0)
    assert not growing.over  # it has not begun
    write(book, 0, 2)
    growing.news()
    assert growing.over


def test_what_is_no_log_is_refused(tmp_path: Path) -> None:
    (tmp_path / "run.db").write_bytes(b"SQLite format 3\0" + bytes(84))
    with pytest.raises(ArtefactError, match=r"run\.db"):
        GrowingLog(tmp_path / "run.db").news()


def frames(messages: list[Message]) -> list[Message]:
    return [one for one in messages if one["kind"] == "frame"]


@short_searches()
def test_a_run_is_shown_while_it_goes_on_and_then_recorded(
    tmp_path: Path, meta: dict[str, object]
) -> None:
    """Pictures and decisions as the log has them; a viewer changes nothing; then the time bar."""
    log, memory = tmp_path / "run.db", RECIPE.first()
    controller = RECIPE.make_controller(memory)
    with Log(log, COLUMNS, about(controller, RECIPE), threaded=False) as book:
        show = Watched(log)
        hello = show.hello()
        assert (hello["live"], hello["watched"], hello["frames"]) == (True, True, [])
        runtime = Runtime(
            controller, RECIPE.make_rig(), InlineWorker(RECIPE.respond), clock=SimulatedClock(),
            log=book,
        )  # fmt: skip
        runtime.run(0.6)
        book.flush()
        told = show.advance(1.0)
        times = [one["t"] for one in frames(told)]
        assert np.allclose(np.diff(times), 0.017, atol=1e-6)  # sixty a second, of whole steps
        assert times[-1] == pytest.approx(0.6, abs=0.03)
        assert show.hello()["frames"] == frames(told)
        decided = [one for one in show.hello()["plans"] if one["kind"] == "plan"]
        assert len(decided) >= 3
        with pytest.raises(InvalidInputError, match="looked at"):
            show.hear({"do": "push", "side": 1}, 1)
        assert show.advance(1.0) == []
        assert not show.over
    (recording,) = show.advance(1.0)
    assert show.over
    assert show.hello() is recording
    assert encoded(recording) == encoded(of_log(log))
    assert [one for one in recording["plans"] if one["kind"] == "plan"] == decided
    at = {one["t"]: encoded(one) for one in frames(told)}
    same = [encoded(one) == at[one["t"]] for one in recording["frames"] if one["t"] in at]
    assert len(same) > 2  # both are even, at other times
    assert all(same)


def test_a_log_that_is_removed_ends_the_show(book: Log) -> None:
    show = Watched(book.path)
    for end in ("", "-wal", "-shm"):
        Path(f"{book.path}{end}").unlink(missing_ok=True)
    (note,) = show.advance(1.0)
    assert note["kind"] == "note"
    assert show.over


def test_simulated_time_is_not_watched() -> None:
    code, _, err = run("run", "rotary_pendulum", "--simulated", "--show")
    assert code == 2
    assert "--show: got with --simulated" in err
    assert "undertow show run.db" in err


@pytest.mark.slow
def test_a_run_is_watched_from_another_process(tmp_path: Path) -> None:
    """``undertow run --show``: live pictures, refusals, a recording; the run ends as without."""
    client = pytest.importorskip("websockets.sync.client")
    command = [sys.executable, "-u", "-m", "undertow", "run", "rotary_pendulum", "--seconds", "4",
               "--show", "--log", str(tmp_path / "run.db")]  # fmt: skip
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stdin=subprocess.DEVNULL, text=True,
        env={**os.environ, "COLUMNS": "200"},
    ) as process:  # fmt: skip
        assert process.stdout is not None
        found = re.search(r"http://\S+", process.stdout.readline())
        assert found is not None
        address = found[0]
        origin = address[: address.index("/", 8)]
        where = address.replace("http", "ws") + "socket"
        with client.connect(where, origin=origin, proxy=None, max_size=None) as socket:
            socket.send('{"do":"push","side":1}')
            messages = []
            for text in socket:
                messages.append(json.loads(text))
                if len(messages) > 1 and messages[-1]["kind"] == "hello":
                    break
        printed = process.stdout.read()
    assert messages[0]["watched"]
    assert len(frames(messages)) > 60
    assert any("looked at" in one.get("text", "") for one in messages)
    assert not messages[-1]["live"]
    assert messages[-1]["frames"][-1]["t"] == pytest.approx(4.0, abs=0.1)
    assert "Verdict: " in printed
    assert process.returncode in (0, 3, 6)  # held: settled or not, and on a machine that is busy
    assert "identical" in run("replay", str(tmp_path / "run.db"), "--no-decisions")[1]


def test_a_window_begins_beside_a_stranger_and_a_lost_one_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A signal.py in the working directory ended its process, and the run without a word."""
    (tmp_path / "signal.py").write_text("raise SystemExit")
    monkeypatch.chdir(tmp_path)
    with Window() as window:
        process = vars(window)["_process"]
        process.join(1.0)
        assert process.exitcode is None
        process.kill()
        process.join()
        with pytest.raises(ArtefactError, match="its process has ended"):
            window.open(tmp_path / "run.db")
