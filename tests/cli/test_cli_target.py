"""The command target: what a person says to a run that goes on."""

from __future__ import annotations

import contextlib
import math
import re
from pathlib import Path

import pytest

import undertow as ut
from runs import run
from undertow.base import InvalidInputError
from undertow.cli.parsing import parse_new_target
from undertow.runtime import RunTarget
from undertow.runtime.targets import Listener

UNITS = {"x": "m", "theta": "rad"}


class Steered:
    """A run that takes what it is asked for, but for 2 m."""

    target = RunTarget("tora", UNITS, 3.25, {"theta": math.pi / 4}, ((9.0, {"x": 0.1}),), "jumps")

    def retarget(self, target: ut.SetPoints) -> RunTarget:
        if target.pairs[0][1].get("x") == 2.0:
            raise InvalidInputError("target", value="x = 2 m", limit="x ≤ 1 m", remedy="Try 1 m")
        ahead = tuple((3.25 + t, q) for t, q in target.pairs)
        return RunTarget("tora", UNITS, 3.25, {}, ahead)


def test_help_has_examples_that_parse() -> None:
    code, out, _ = run("target", "--help")
    assert code == 0
    _, examples = out.split("Examples")
    assert examples.count("undertow target run.db") == 3
    assert not re.findall(r"--[a-z-]+", examples)


def test_what_is_typed_reaches_the_run_and_what_it_says_the_person(tmp_path: Path) -> None:
    """Units in, units out; the run's own reason where it refuses; where it is, without words."""
    log = tmp_path / "run.db"
    with contextlib.closing(Listener(Steered(), log)):
        code, out, _ = run("target", str(log))
        assert code == 0
        assert out.splitlines() == [
            "tora, 3.2 s: the target is theta = 45°",
            "asked for, from 9.0 s on: x = 0.1 m",
            "last said of it: jumps",
        ]
        code, out, _ = run("target", str(log), "x=0.25m", "theta=-90deg@8s")
        assert code == 0
        assert out.splitlines() == [
            "tora, 3.2 s: the target is x = 0",
            "asked for, at once: x = 0.25 m",
            "asked for, from 11.2 s on: theta = -90°",
        ]
        code, out, err = run("target", str(log), "x=2m")
        assert (code, out) == (2, "")
        assert "error: target: got x = 2 m, must be x ≤ 1 m. Try 1 m" in err
        code, out, err = run("target", str(log), "x=2")
        assert (code, out) == (2, "")
        assert "a number with its unit, m. Write for instance x=2m" in err
    code, out, err = run("target", str(log), "x=0.25m")
    assert (code, out) == (1, "")
    assert "no such log" in err
    assert "--log run.db" in err


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["y=1m"], "got 'y', must be one of x, theta"),
        (["x=1deg"], "a number with its unit, m"),
        (["x=1m@2Hz"], "set-points: x=2m, x=-1m@5s"),
        (["path.csv"], "NAME=VALUE|name=value|x=1m"),
        (["x=1m", "x=2m"], "each name once at a time"),
    ],
)
def test_words_that_are_no_set_points_are_refused(words: list[str], reason: str) -> None:
    with pytest.raises(InvalidInputError, match=reason):
        parse_new_target(UNITS, words)


def test_a_run_whose_target_cannot_move_says_so() -> None:
    with pytest.raises(InvalidInputError, match="x = 0: the mechanism's equations depend on all"):
        parse_new_target({}, ["x=1m"])


@pytest.mark.slow
def test_a_run_says_how_it_is_steered(tmp_path: Path) -> None:
    """With a log, against the clock; and a swing-up goes on to the set-points."""
    log = tmp_path / "run.db"
    words = ("--start", "phi=5deg", "--seconds", "0.2", "--worker", "thread", "--log", str(log))
    _, _, err = run("run", "rotary_pendulum", *words)
    assert f"Another target while it runs: undertow target {log} theta=10deg" in " ".join(
        err.split()
    ).replace("- ", "-")
    swing = ("--swing-up", "--rig", "realistic", "--simulated", "--target", "theta=30deg")
    code, out, _ = run("run", "rotary_pendulum", *swing, "--seconds", "7")
    assert code == 0, out
