"""The commands run, replay and drill."""

from __future__ import annotations

import re
import sqlite3
from pathlib import Path

import pytest
from typer.testing import CliRunner

from undertow.cli import app

runner = CliRunner()


def run(*words: str) -> tuple[int, str, str]:
    result = runner.invoke(app, list(words), env={"COLUMNS": "120", "TERM": "dumb"})
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, result.stdout, result.stderr


@pytest.mark.parametrize("command", ["run", "replay", "drill"])
def test_help_has_examples_that_parse(command: str) -> None:
    code, out, _ = run(command, "--help")
    assert code == 0
    before, examples = out.split("Examples")
    assert f"undertow {command}" in examples
    options = set(re.findall(r"--[a-z-]+", before))
    assert set(re.findall(r"--[a-z-]+", examples)) <= options


def test_a_run_is_logged_and_its_replay_is_identical(tmp_path: Path) -> None:
    """The log of ``run``, through ``replay``, with pictures; a changed output is found."""
    log = tmp_path / "run.db"
    words = ("--start", "phi=15deg", "--seconds", "0.5", "--simulated", "--log", str(log))
    code, out, _ = run("run", "rotary_pendulum", *words)
    assert code == 0
    assert "operator: stop" in out
    code, out, _ = run("replay", str(log), "--out", str(tmp_path / "figures"))
    assert code == 0
    assert "identical, bit for bit" in out
    names = {path.name for path in (tmp_path / "figures").iterdir()}
    assert names == {"motion.png", "latency.png", "chatter.png"}
    with sqlite3.connect(log) as file:
        file.execute("UPDATE steps SET voltage = voltage + 1 WHERE k = 100")
    file.close()
    code, out, _ = run("replay", str(log), "--no-decisions")
    assert code == 1
    assert "1 steps differ, the first is 100" in out


@pytest.mark.parametrize(
    ("words", "value"),
    [
        (("run", "piano"), "'piano'"),
        (("run", "rotary_pendulum", "--start", "phi=40"), "'40'"),
        (("run", "rotary_pendulum", "--lead", "-1"), "-1"),
    ],
)
def test_bad_words_are_refused_in_one_line(words: tuple[str, ...], value: str) -> None:
    code, out, err = run(*words)
    assert code == 2
    assert out == ""
    assert value in err
    assert len(err.strip().splitlines()) == 1


def test_a_missing_log_is_refused(tmp_path: Path) -> None:
    code, _, err = run("replay", str(tmp_path / "none.db"))
    assert code == 1
    assert "no such file" in err
