"""Logs, certificates, ledgers and models are data: nothing that one says is run or waited for."""

from __future__ import annotations

import json
import math
import os
import shutil
import sqlite3
import threading
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

import undertow as ut
from undertow.base import (
    ArtefactError,
    InvalidInputError,
    UndertowError,
    parse_json,
    read_file,
)
from undertow.cascade import CascadeState
from undertow.cli import app
from undertow.law import Plan
from undertow.models import importers as modelling
from undertow.runtime import (
    Columns,
    InlineWorker,
    Log,
    Recipe,
    Runtime,
    SimulatedClock,
    about,
    read_log,
    replay,
)
from undertow.runtime.slow_loop import respond
from undertow.studies.ledger import Ledger
from undertow.studies.rigs.bring_up import coverage
from undertow.studies.trials.trial import Result

MEMORY = CascadeState(Plan.of(ut.Surface(alpha_a=-1, lambda_a=-0.25, alpha_u=1.6, lambda_u=17.3)))


def make(path: Path, recipe: Recipe, seconds: float = 0.15) -> None:
    """The log of a short run in simulated time."""
    controller = recipe.make_controller(MEMORY)
    worker = InlineWorker(lambda request: respond(recipe.cascade, request))
    with Log(path, Columns.of(recipe.belief), about(controller, recipe), threaded=False) as log:
        rig, clock = recipe.make_rig(), SimulatedClock()
        Runtime(controller, rig, worker, clock=clock, log=log).run(seconds)


Change = str | tuple[str, tuple[str | int, ...], object]


def change(path: Path, *changes: Change) -> None:
    """Do what queries say, and set values (key, where, value) in a log's meta."""
    with closing(sqlite3.connect(path, isolation_level=None)) as file:
        for one in changes:
            if isinstance(one, str):
                file.execute(one)
                continue
            key, (*where, last), value = one
            (text,) = file.execute("SELECT value FROM meta WHERE key = ?", (key,)).fetchone()
            document = part = json.loads(text)
            for step in where:
                part = part[step]
            part[last] = value
            file.execute("UPDATE meta SET value = ? WHERE key = ?", (json.dumps(document), key))


@pytest.fixture(scope="module")
def logged(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("library") / "run.db"
    make(path, Recipe(start=(0.0, 0.2, 0.0, 0.0), evaluations=16))
    return path


@pytest.fixture
def log(logged: Path, tmp_path: Path) -> Path:
    return Path(shutil.copy(logged, tmp_path / "run.db"))


# -- a mechanism of one's own --------------------------------------------------------------------

MODEL = """
import undertow as ut
from pathlib import Path

def arm():
    mark = Path(__file__).with_name("mark")
    mark.touch()
    return ut.mechanisms.rotary_pendulum()
"""


@pytest.fixture(scope="module")
def first_own(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a model and a log of it."""
    folder = tmp_path_factory.mktemp("own")
    (folder / "model.py").write_text(MODEL)
    name = f"{folder / 'model.py'}:arm"
    make(folder / "own.db", Recipe(mechanism=name, start=(0.0, 0.2, 0.0, 0.0), evaluations=16))
    (folder / "mark").unlink()
    return folder


@pytest.fixture
def own(first_own: Path, tmp_path: Path) -> tuple[Path, str]:
    """A log of a mechanism in a file, and the name of a copy of that."""
    shutil.copytree(first_own, tmp_path, dirs_exist_ok=True)
    return tmp_path / "own.db", f"{tmp_path / 'model.py'}:arm"


def test_a_log_does_not_run_the_file_that_it_names(first_own: Path) -> None:
    path, name = first_own / "own.db", f"{first_own / 'model.py'}:arm"
    with pytest.raises(ArtefactError, match="what a log names is not run") as refused:
        replay(path)
    assert name in str(refused.value.remedy)
    answer = CliRunner().invoke(app, ["replay", str(path)])
    assert answer.exit_code == 1
    assert "--mechanism" in answer.output
    assert not path.with_name("mark").exists()


def test_a_mechanism_that_is_named_is_run_and_its_hash_compared(own: tuple[Path, str]) -> None:
    path, name = own
    same = replay(path, mechanism=name)
    assert same.identical
    assert same.remarks == ()
    model = path.with_name("model.py")
    model.write_text(MODEL + "# another line\n")
    changed = replay(path, mechanism=name)
    assert changed.identical
    assert "has changed since" in changed.remarks[0]
    answer = CliRunner().invoke(app, ["replay", str(path), "--mechanism", name])
    assert "has changed since" in " ".join(answer.output.split())
    assert answer.exit_code == 0
    assert replay(path, mechanism=ut.mechanisms.rotary_pendulum()).identical
    model.write_text(MODEL.replace("pendulum()", "pendulum(d_e=0.02)"))
    with pytest.raises(ArtefactError, match="other equations or numbers"):
        replay(path, mechanism=name)


def test_a_wrong_word_for_the_mechanism_is_not_taken_for_a_damaged_log(
    own: tuple[Path, str],
) -> None:
    with pytest.raises(UndertowError, match="no name 'arms'") as refused:
        replay(own[0], mechanism=f"{own[1]}s")
    assert "damaged" not in str(refused.value)


def test_a_log_of_before_hashes_were_kept_says_so(own: tuple[Path, str]) -> None:
    path, name = own
    change(path, "DELETE FROM meta WHERE key = 'source'")
    assert "no hash" in replay(path, mechanism=name).remarks[0]


def test_a_replay_says_that_the_processor_is_another(log: Path) -> None:
    assert replay(log, decisions=False).build == {}
    change(
        log,
        "UPDATE meta SET value = json_set(value, '$.processor', 'Some other', "
        "'$.features', json_extract(value, '$.features') || ' amx') WHERE key = 'versions'",
    )
    build = replay(log, decisions=False).build
    assert set(build) == {"processor", "features"}
    assert build["processor"][0] == "Some other"
    assert build["features"] == ("amx", None)
    answer = CliRunner().invoke(app, ["replay", str(log), "--no-decisions"])
    assert "another processor" in answer.output
    assert "Some other then" in " ".join(answer.output.split())


# -- logs that are none ----------------------------------------------------------------------------


BAD: dict[str, tuple[Change, ...]] = {
    "a later layout": ("PRAGMA user_version = 4",),
    "a later recipe": (("recipe", ("tempo",), 3),),
    "later settings": (
        (
            "recipe",
            (
                "settings",
                "tempo",
            ),
            3,
        ),
    ),
    "no JSON": ("UPDATE meta SET value = '{' WHERE key = 'recipe'",),
    "JSON of another kind": ("UPDATE meta SET value = '7' WHERE key = 'recipe'",),
    "a repeated key": ("UPDATE meta SET value = '{\"a\": 1, \"a\": 2}' WHERE key = 'memory'",),
    "deep JSON": (f"UPDATE meta SET value = '{'[' * 100000}' WHERE key = 'memory'",),
    "an endless number": (f"UPDATE meta SET value = '{'9' * 5000}' WHERE key = 'memory'",),
    "a period for ever": (("recipe", ("period",), 1e-300),),
    "a period of nothing": (("recipe", ("period",), 0),),
    "a horizon for ever": (("recipe", ("horizon",), 1e300),),
    "a text for a number": (("recipe", ("period",), "0.001"),),
    "a rig of no kind": (("recipe", ("rig",), "file:///x"),),
    "a start of texts": (("recipe", ("start",), ["a", 0, 0, 0]),),
    "no memory": ("DELETE FROM meta WHERE key = 'memory'",),
    "a plan of nothing": (
        (
            "memory",
            (
                "plan",
                "surfaces",
            ),
            [],
        ),
    ),
    "a plan of texts": (
        (
            "memory",
            (
                "plan",
                "surfaces",
                0,
                "alpha_a",
            ),
            "x",
        ),
    ),
    "no fingerprint": ("DELETE FROM meta WHERE key = 'fingerprint'",),
    "a step of text": ("UPDATE steps SET phi = 'x' WHERE k = 5",),
    "a column too few": ("ALTER TABLE steps DROP COLUMN margin",),
    "no answers": ("DROP TABLE answers",),
    "a command of no kind": ("UPDATE events SET text = 'FIRE' WHERE kind = 'command'",),
    "an answer that is none": ("UPDATE answers SET body = 'null'",),
    "an answer without": ("UPDATE answers SET body = replace(body, 'before', 'later')",),
    "a huge value": ("UPDATE meta SET value = zeroblob(70000000) WHERE key = 'units'",),
    "a view": (
        "DROP TABLE steps",
        "CREATE VIEW steps AS WITH RECURSIVE r(k) AS (SELECT 1 UNION ALL SELECT k + 1 FROM r) "
        "SELECT k FROM r",
    ),
    "a trigger": ("CREATE TRIGGER t AFTER INSERT ON steps BEGIN SELECT load_extension('x'); END",),
    "a virtual table": ("DROP TABLE events", "CREATE VIRTUAL TABLE events USING fts5(k, t)"),
    "a computed column": ("ALTER TABLE events ADD COLUMN c AS (hex(zeroblob(1e8))) VIRTUAL",),
}


@pytest.mark.parametrize("what", BAD)
def test_a_log_that_is_damaged_or_of_later_times_is_refused_at_once(log: Path, what: str) -> None:
    """A condition with what was met and what to do; at 09076aa a TypeError, or none for ever."""
    change(log, *BAD[what])
    began = time.process_time()
    with pytest.raises(ArtefactError) as refused:
        replay(log)
    assert time.process_time() - began < 10.0
    assert refused.value.value or refused.value.limit


def test_a_log_that_is_refused_is_one_line_on_the_command_line(log: Path) -> None:
    change(log, *BAD["a later recipe"])
    answer = CliRunner().invoke(app, ["replay", str(log)])
    assert answer.exit_code == 1
    assert "error: log" in answer.output
    assert "another version" in answer.output


def test_what_a_log_says_does_not_reach_the_terminal_as_commands(log: Path) -> None:
    change(log, "UPDATE meta SET value = json_quote('\x1b]0;owned\x07[red]') WHERE key='mechanism'")
    answer = CliRunner().invoke(app, ["replay", str(log), "--no-decisions"])
    assert "\x1b" not in answer.output
    assert "[red]" in answer.output


# -- what is no file -----------------------------------------------------------------------------

READERS: dict[str, Callable[[Path], object]] = {
    "log": read_log,
    "replay": replay,
    "certificate": lambda path: __import__(
        "undertow.proofs.claims.certificate", fromlist=["x"]
    ).read_certificate(path),
    "urdf": modelling.from_urdf,
    "mjcf": modelling.from_mjcf,
    "ledger": lambda path: Ledger(path, tuple[str, Result], {}),
    "coverage": lambda path: Ledger(path, coverage(1).line, {}),
}


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="pipes with names")
@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("what", ["pipe", "device", "folder", "link to a pipe"])
def test_what_is_no_plain_file_is_refused_and_not_waited_for(
    tmp_path: Path, reader: str, what: str
) -> None:
    """At 09076aa ``verify`` waited on a pipe for ever."""
    path = tmp_path / "x"
    if what == "device":
        path = Path("/dev/zero")
    elif what == "folder":
        path.mkdir()
    else:
        os.mkfifo(path)
    if what == "link to a pipe":
        (tmp_path / "link").symlink_to(path)
        path = tmp_path / "link"
    said: list[BaseException] = []

    def read() -> None:
        try:
            READERS[reader](path)
        except BaseException as error:
            said.append(error)

    thread = threading.Thread(target=read, daemon=True)
    thread.start()
    thread.join(10.0)
    assert not thread.is_alive()
    assert isinstance(said[0], ArtefactError)
    assert "plain file" in str(said[0])


def test_a_file_is_read_up_to_its_limit(tmp_path: Path) -> None:
    path = tmp_path / "x"
    path.write_bytes(b"12345")
    assert read_file(path, "thing", most=5) == b"12345"
    with pytest.raises(ArtefactError, match="got 5 bytes, must be at most 4"):
        read_file(path, "thing", most=4)
    with pytest.raises(ArtefactError, match="thing"):
        read_file(Path("a\0b"), "thing", most=4)


@pytest.mark.parametrize(
    "text", ['{"a": 1, "a": 2}', "NaN", "1e999", "[" * 100_000, "9" * 41, "{", '"\ud800']
)
def test_json_means_one_thing_or_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"."):
        parse_json(text)


def test_json_of_logs_may_have_numbers_that_are_none() -> None:
    assert parse_json("[1.5, Infinity]", finite=False) == [1.5, float("inf")]


# -- models ----------------------------------------------------------------------------------------


def mjcf(body: str) -> str:
    return f"<mujoco><worldbody>{body}</worldbody></mujoco>"


BODY = '<body name="{0}"><joint name="x" type="slide"/><geom size="{1}" {2}/></body>'

MODELS: dict[str, tuple[str, type[UndertowError]]] = {
    "nested 3,000 deep": (mjcf("<body>" * 3000 + "</body>" * 3000), InvalidInputError),
    "too many elements": (mjcf("<body/>" * 30_000), InvalidInputError),
    "a body that is the world": (mjcf(BODY.format("world", "1", "")), InvalidInputError),
    "a size too few": (mjcf(BODY.format("a", "1", 'type="capsule"')), InvalidInputError),
    "a size of nothing": (mjcf(BODY.format("a", "0 0", 'type="capsule"')), InvalidInputError),
    "a size beyond all": (mjcf(BODY.format("a", "1e200 1e200", 'type="capsule"')), UndertowError),
    "entities": ('<!DOCTYPE m [<!ENTITY a "b">]><mujoco/>', InvalidInputError),
}


@pytest.mark.parametrize("what", MODELS)
def test_a_model_that_is_none_is_refused_at_once(what: str) -> None:
    """The first was a RecursionError at 09076aa, the third had no end."""
    text, kind = MODELS[what]
    began = time.process_time()
    with pytest.raises(kind):
        modelling.from_mjcf(text)
    assert time.process_time() - began < 10.0


# -- ledgers ---------------------------------------------------------------------------------------

LINE: list[Any] = [
    "cascade", "delay", 0.5,
    {"seed": 1, "balanced": True, "caught": True, "settled": "inf", "cost": 1.0, "effort": 1.0,
     "chatter": 1.0},
]  # fmt: skip


@pytest.mark.parametrize(
    "line",
    [7, [1, 2, 3], ["a", "b", 1.0, []], ["a", "b", "x", LINE[3]], [["a"], "b", 1.0, LINE[3]],
     ["a", "b", 1.0, {**LINE[3], "more": 1}], ["a", "b", 1.0, {**LINE[3], "balanced": "yes"}],
     ["a", "b", 1.0, {**LINE[3], "seed": [1]}], ["a", "b", 1.0, {**LINE[3], "cost": "1.0"}],
     ["a", "b", 1.0, {**LINE[3], "cost": None}], ["a", "b", True, LINE[3]]],
)  # fmt: skip
def test_a_line_that_is_no_result_is_refused(tmp_path: Path, line: Any) -> None:
    path = tmp_path / "ledger.jsonl"
    kind = tuple[str, str, float, Result]
    Ledger(path, kind, {"angle": 0.5})
    with path.open("a") as file:
        file.write(json.dumps(LINE) + "\n")
    again: Ledger[Result] = Ledger(path, kind, {"angle": 0.5})
    assert again.known["cascade", "delay", 0.5].settled == math.inf
    with path.open("a") as file:
        file.write(json.dumps(line) + "\n")
    with pytest.raises(ArtefactError, match="ledger"):
        Ledger(path, kind, {"angle": 0.5})
