"""The command line: help with examples, refusals in one line, results where they are said."""

from __future__ import annotations

import csv
import errno
import io
import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sympy as sp
import typer
from typer.main import get_command

import undertow as ut
from runs import run, short_searches
from support import rest_slow
from undertow.base import ArtefactError, InvalidInputError, table, write_file
from undertow.cli import _ORDER, _place, app, main, terminal
from undertow.cli.parsing import (
    aimed,
    mechanism_named,
    objective_named,
    parse_start,
    parse_surface,
    parse_target,
    parse_values,
)
from undertow.cli.terminal import carry_out, progress_bar, show
from undertow.closed_loop import Event, Trajectory
from undertow.closed_loop.trajectory import recorded
from undertow.objective import USUAL
from undertow.proofs import read_certificate
from undertow.studies.certification import decide
from undertow.studies.experiment import Experiment
from undertow.studies.ledger import Key
from undertow.studies.motion import ended

RIG = "rotary_pendulum"
SURFACE = "lambda_a=-1.59 alpha_u=1.96 lambda_u=12.1"
CRANE = "overhead_crane"


# -- help ------------------------------------------------------------------------------------


def leaves(command: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """All commands with their words, those of groups too."""
    for name, child in getattr(command, "commands", {}).items():
        yield from leaves(child, (*path, name))
    if path and not hasattr(command, "commands"):
        yield path, command


COMMANDS = dict(leaves(get_command(app)))


@pytest.mark.parametrize("path", COMMANDS, ids=" ".join)
def test_help_ends_with_examples_that_parse_as_they_stand(path: tuple[str, ...]) -> None:
    """Pasted into a shell, folded lines and all, each example is a call of this command."""
    code, out, _ = run(*path, "--help")
    assert code == 0
    shown = out.split("Examples")[1].replace("\\\n", "").strip()
    found = [shlex.split(line) for line in shown.splitlines() if line.strip()]
    assert found
    for words in found:
        assert words[: len(path) + 1] == ["undertow", *path]
        COMMANDS[path].make_context(path[-1], words[len(path) + 1 :])


@pytest.mark.parametrize("words", [("--seconds", "5"), ("--loop",)])
def test_of_a_run_no_more_is_proved_than_is_said(words: tuple[str, ...]) -> None:
    """Options that were passed over without a word are refused, before any work."""
    code, _, err = run("certify", RIG, "--run", *words)
    assert code == 2
    assert f"error: {words[0]}: got" in err
    assert "with --run, must be left out" in err


def test_a_group_of_commands_has_examples() -> None:
    """Each is a call of a command in it."""
    _, out, _ = run("export", "--help")
    for line in out.split("Examples")[1].strip().splitlines():
        _, *words = shlex.split(line)
        COMMANDS[tuple(words[:2])].make_context(words[1], words[2:])


def test_long_examples_are_folded_for_a_terminal_of_80_columns() -> None:
    """No line is longer."""
    for command in COMMANDS.values():
        for line in command.epilog.splitlines():
            assert len(line) <= 78


@pytest.mark.parametrize("path", COMMANDS, ids=" ".join)
def test_every_option_is_explained_and_nothing_else_is(path: tuple[str, ...]) -> None:
    """Each option and argument has help, and each one in the docstring is one of the command's."""
    command = COMMANDS[path]
    helps = {param.name: param.help for param in command.params}
    assert all(helps.values())
    own = re.findall(r"^    (\w+)(?: : \S+)?\n {8}\S", command.callback.__doc__, re.MULTILINE)
    assert own == [name for name in helps if name in own]
    assert ("Parameters\n" in command.callback.__doc__) == bool(own)


def test_help_shows_every_command_in_an_order_that_cannot_break() -> None:
    """Every command has its place; one that is in no list comes last and breaks nothing."""
    names = {path[0] for path in COMMANDS if len(path) == 1}
    assert names == set(_ORDER)
    assert _place("not in the list") == len(_ORDER) > _place("doctor")


def test_flags_show_no_type() -> None:
    """A flag takes no value, and its help does not look as if it did."""
    _, out, _ = run("simulate", "--help")
    assert "--hard-input" in out
    assert "<bool>" not in out


def test_version_and_bare_call() -> None:
    """``--version`` names the version; no command at all shows the commands."""
    code, out, _ = run("--version")
    assert code == 0
    assert out.startswith("undertow ")
    _, out, _ = run()
    assert all(command in out for command in ("reproduce", "simulate", "optimise"))


# -- refusals: exit code, value, limit, remedy ---------------------------------------------------


@pytest.mark.parametrize(
    ("words", "value", "limit"),
    [
        (("simulate", "piano"), "'piano'", "rotary_pendulum"),
        (("simulate", RIG, "--start", "phi=40"), "'40'", "deg or rad"),
        (("simulate", RIG, "--start", "phi=40m"), "'40m'", "deg or rad"),
        (("simulate", RIG, "--start", "phi_dot=4deg"), "'4deg'", "deg/s or rad/s"),
        (("simulate", RIG, "--start", "psi=4deg"), "'psi'", "theta, phi"),
        (("simulate", RIG, "--start", "phi=nandeg"), "'nandeg'", "a number with its unit"),
        (("simulate", RIG, "--start", "phi"), "'phi'", "name=value"),
        (("simulate", RIG, "--set", "m=-1"), "-1", "inside (0, inf) kg"),
        (("simulate", RIG, "--set", "m=0.2kg"), "'0.2kg'", "the number alone"),
        (("simulate", RIG, "--set", "mass=1"), "'mass'", "d_e"),
        (("simulate", RIG, "--set", "m=nan"), "'nan'", "finite"),
        (("simulate", RIG, "--plant", "q=1"), "'q'", "one of"),
        (("simulate", RIG, "--limit", "current=3"), "'current'", "one of voltage"),
        (("optimise", RIG, "--limit", "voltage=-3"), "-3 V", "positive"),
        (("optimise", RIG, "--limit", "voltage=nan"), "'nan'", "finite"),
        (("optimise", RIG, "--box", "theta=60"), "'60'", "deg or rad"),
        (("optimise", RIG, "--box", "theta=60m"), "'60m'", "deg or rad"),
        (("optimise", RIG, "--box", "theta=-60deg"), "'-60deg'", "> 0"),
        (("optimise", RIG, "--box", "theta=9deg:20deg"), "'9deg:20deg'", "LOW < 0 < HIGH"),
        (("optimise", RIG, "--box", "theta=-1rad:0rad:1rad"), "'-1rad:0rad:1rad'", "LOW:HIGH"),
        (("optimise", RIG, "--box", "psi=-1rad:1rad"), "'psi'", "theta, phi"),
        (("optimise", RIG, "--box", "phi=1rad", "--box", "phi=2rad"), "'phi' twice", "once"),
        (("optimise", RIG, "--set", "m=0.1", "--set", "m=0.2"), "'m' twice", "once"),
        (("optimise", RIG, "--start", "phi=1deg", "--start", "phi=2deg"), "'phi' twice", "once"),
        (("animate", RIG, "--start", "phi=20deg", "--box", "phi=10deg"), "-0.1745 rad", "≥ 0"),
        (("simulate", RIG, "--horizon", "-1"), "-1", "finite and > 0"),
        (("simulate", RIG, "--period", "0.0333"), "0.0333", "multiple"),
        (("simulate", RIG, "--surface", "alpha_u=5"), "'alpha_u=5'", "missing"),
        (("simulate", RIG, "--surface", "beta=5"), "'beta'", "one of"),
        (("simulate", RIG, "--surface", "lambda_a=0.5 alpha_u=5 lambda_u=10"), "-0.5", "> 0"),
        (("simulate", RIG, "--surface", "lambda_a=-5 alpha_u=5 lambda_u=10"), "-3", "> 0"),
        (
            ("simulate", RIG, "--start", "phi=60deg", "--control", "designed"),
            "-0.2",
            "> 0",
        ),
        (("optimise", RIG, "--evaluations", "0"), "0 evaluations", "at least 1"),
        (("simulate", RIG, "--evaluations", "0"), "0 evaluations", "at least 1"),
        (("simulate", RIG, "--control", "designed", "--evaluations", "9"), "9", "a cascade"),
        # What is typed out is refused where nothing uses it, its default, too.
        (("simulate", RIG, "--surface", SURFACE, "--period", ".1"), "0.1, with one", "the cascade"),
        (("simulate", RIG, "--control", "designed", "--schedule", "0"), "0, with one", "cascade"),
        (("simulate", RIG, "--control", "designed", "--seed", "0"), "0, without a s", "--control"),
        (("certify", RIG, "--objective", "energy"), "energy, without --run", "with --run"),
        (("certify", RIG, "--horizon", "60"), "60, without --run", "with --run"),
        (("certify", RIG, "--seed", "2"), "2, without --run", "with --run"),
        (("certify", RIG, "--hold", "0"), "0, without --loop", "loop's proof"),
        (("certify", RIG, "--bench", "srv02", "--hold", "1"), "1, with --bench", "left out"),
        (("certify", "cart_pendulum", "--bench", "srv02"), "of 'cart_pendulum'", "--bench usual"),
        (("verify", "none.json", "--seconds", "600"), "600, without --both", "second checker"),
        (("show", "run.db", "--objective", "effort"), "effort, with a log", "for a mechanism"),
        (("show", "run.db", "--seed", "0"), "0, with a log", "for a mechanism"),
        (("show", RIG, "--save", "page.html", "--port", "0"), "0, with --save", "is served"),
        (("show", RIG, "--save", "page.html", "--no-browser"), "with --save", "is served"),
        (("run", RIG, "--simulated", "--worker", "thread"), "thread, with --sim", "the clock"),
        (("run", RIG, "--simulated", "--no-lockstep"), "with --simulated", "the clock"),
        (("bench", RIG, "--rig", "ideal", "--seed", "0"), "0, with --rig ideal", "realistic rig"),
        (("export", "c", RIG, "--check", "--objective", "energy"), "energy, without", "one-time"),
        (("export", "c", RIG, "--check", "--seed", "0"), "0, without a search", "one-time"),
        (("export", "c", RIG, "--check", "--states", "100000"), "100000, without", "--report"),
        (("export", "c", RIG, "--out", "c", "--compiler", "gcc"), "gcc, where nothing", "--check"),
        (("models", "robots", "--no-simulate", "--seed", "0"), "0, with --no-sim", "motions"),
        (("drill", "--kills", "3", "--no-live"), "with another drill", "single faults"),
        (("simulate", RIG, "--start", "phi=1e300rad"), "1e+300 rad", "±4.5e+13 rad"),
        (("optimise", RIG, "--start", "theta_dot=1e14rad/s"), "1e+14 rad/s", "±4.5e+13 rad/s"),
        (("show", RIG, "--save", "page.html", "--start", "phi=1e300rad"), "1e+300", "±4.5e+13"),
        (("simulate", CRANE, "--target", "x=2m"), "x = 2 m", "95 % of the travel"),
        (
            ("simulate", CRANE, "--target", "x=2"),
            "'2'",
            "a number with its unit, m. Write for instance --target x=2m",
        ),
        (("simulate", RIG, "--start", "phi=20"), "'20'", "for instance --start phi=20deg"),
        (("simulate", CRANE, "--target", "x=1m@2min"), "'2min'", "s or Hz"),
        (("simulate", CRANE, "--target", "x_dot=1m/s"), "x_dot = 1", "velocity 0"),
        (("simulate", CRANE, "--target", "theta=5deg"), "theta = 0.0872665", "along x"),
        (("simulate", CRANE, "--target", "x=1m", "--target", "x=.1m"), "'x' twice", "once"),
        (("simulate", CRANE, "--target", "x=1m", "--target", "x=.1m@2Hz"), "x=1m", "one frequency"),
        (("simulate", CRANE, "--target", "x=1m", "--control", "designed"), "designed", "cascade"),
        (("run", CRANE, "--simulated", "--target", "x=2m"), "x = 2 m", "95 % of the travel"),
        (("simulate", RIG, "--control", "designed", "--accept", "local"), "local", "the cascade"),
        (("simulate", RIG, "--control", "one-time", "--belief", "usual"), "usual", "the cascade"),
        (
            ("simulate", RIG, "--control", "designed", "--schedule", ".1"),
            "0.1, with one surface",
            "the cascade",
        ),
        (
            ("simulate", RIG, "--surface", SURFACE, "--period", ".2"),
            "0.2, with one surface",
            "the cascade",
        ),
        (("simulate", RIG, "--schedule", "99"), "99 s", "0 s to 60 s"),
        (("certify", RIG, "--objective", "time"), "time, without --run", "with --run"),
        (("certify", RIG, "--horizon", "3"), "3, without --run", "with --run"),
        (("certify", "--appendix", "--surface", SURFACE), "lambda_a", "left out"),
        (("certify", "--appendix", "--start", "phi=5deg"), "phi=5deg", "left out"),
        (("certify", "--appendix", "--run"), "with --appendix", "left out"),
        (("verify", "none.json", "--seconds", "9"), "9, without --both", "second checker"),
        (("drill", "--systematic", "--kills", "3"), "3, with --systematic", "one of them"),
        (("show", "run.db", "--objective", "time"), "time", "for a mechanism"),
        (("show", "run.db", "--period", "0.2"), "0.2, with a log", "for a mechanism"),
        (("show", "run.db", "--seed", "1"), "1", "for a mechanism"),
        (("animate", RIG, "--speed", "0"), "0.0", "> 0"),
        (("animate", RIG, "--longest", "-1"), "-1.0", "> 0"),
        (("derive", "robot.sdf"), "'.sdf'", ".urdf, .xml, .mjcf"),
        (("bench", RIG, "--quick", "--delay", "0.002"), "0.002, with --quick", "left out"),
        (("bench", RIG, "--delay", "-1"), "-1", "≥ 0"),
        (("export", "c", RIG, "--check", "--objective", "speed"), "'speed'", "bench-time"),
        (("export", "c", RIG, "--check", "--objective", "time"), "time", "--control one-time"),
        (("export", "c", RIG, "--check", "--start", "psi=1deg"), "'psi'", "theta, phi"),
        (("export", "c", RIG, "--check", "--start", "phi=1deg"), "phi=1deg", "one-time"),
        (("export", "c", RIG, "--check", "--states", "9"), "9, without a report", "--report"),
        (("export", "c", RIG, "--check", "--velocity", "slow"), "'slow'", "derivative, super"),
        (
            ("export", "c", RIG, "--check", "--velocity", "kalman", "--time-constant", "0.1"),
            "0.1, with --velocity kalman",
            "--velocity derivative",
        ),
        (("export", "c", RIG, "--check", "--period", "0"), "0.0", "> 0, < 1 s"),
        (
            ("campaign", "none.toml", "--out", "s.zarr", "--proof", "p.json"),
            "p.json, without --picture",
            "shows",
        ),
        (
            ("campaign", "none.toml", "--out", "s.zarr", "--status", "--threads", "2"),
            "2, with --status",
            "for a run",
        ),
    ],
)
def test_bad_input_is_refused_with_value_and_limit(
    words: tuple[str, ...], value: str, limit: str
) -> None:
    """Exit code 2, one line on standard error, no traceback, the value and its limit."""
    code, out, err = run(*words)
    assert code == 2
    assert out == ""
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert f"got {value}" in err or value in err
    assert limit in err


@pytest.mark.parametrize(
    ("words", "belief"), [((), "exact"), (("--belief", "usual"), "usual")], ids=str
)
def test_a_schedule_goes_with_either_belief(
    words: tuple[str, ...], belief: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As in Python; the model is taken for the plant unless the command says otherwise."""

    def asked(*_: object, **more: Any) -> None:
        raise InvalidInputError(f"{more['belief']}, {more['freedom'].schedule:g} s")

    monkeypatch.setattr("undertow.cli.control.Cascade", asked)
    _, _, err = run("simulate", RIG, "--objective", "time", "--schedule", "0.1", *words)
    assert err == f"error: {belief}, 0.1 s.\n"


@short_searches()
def test_a_target_on_the_command_line() -> None:
    """Set-points one after another; the report says which, and what was reached."""
    short = ("--objective", "time", "--start", "phi=0deg", "--belief", "exact")
    targets = ("--target", "theta=20deg", "--target", "theta=0deg@0.5s")
    code, out, _ = run("simulate", RIG, *short, *targets)
    assert code == 0
    assert "theta=20deg, theta=0deg@0.5s" in out
    assert "begin another task" in " ".join(out.split())


def test_a_file_of_another_kind_is_not_written_over(tmp_path: Path) -> None:
    """A definition, a log or a driver that is named by mistake stays what it is."""
    mine, page = tmp_path / "mine.py", tmp_path / "page.html"
    mine.write_text("import undertow\n", encoding="utf-8")
    with pytest.raises(ArtefactError, match="one of another kind, which is there already"):
        write_file(mine, b"<!doctype html>")
    assert mine.read_text(encoding="utf-8") == "import undertow\n"
    for content in (b"<!doctype html>1", b"<!doctype html>2"):
        assert write_file(page, content).read_bytes() == content
    assert sorted(p.name for p in tmp_path.iterdir()) == ["mine.py", "page.html"]
    page.write_bytes(b'{"compact": 1}')
    assert write_file(page, b'{\n "laid": 2}').read_bytes().startswith(b"{\n")


def _pushed(end: list[float], event: Event) -> Trajectory:
    """A motion of a crane that ends there after 2 s."""
    crane = ut.mechanisms.overhead_crane()
    x = np.array([[0.0] * 4, end])
    zero = np.zeros((2, 1))
    return Trajectory(crane, np.array([0.0, 2.0]), x, zero, zero, np.zeros(2), np.ones(2), event)


def test_how_far_a_motion_is_off_counts_from_its_target() -> None:
    """Of a set-point at 1 m, 0.6 mm away is 0.0006, not ‖x‖ = 1; a reference is followed."""
    goal, there = ut.MinimumTime(horizon=4.0), ut.SetPoints({"x": 1.0})
    late = ended(_pushed([1.03, 0.0, 0.0, 0.0], Event.HORIZON), goal, there)
    assert late.startswith("had not reached ‖x − x_r‖ ≤ 0.01 by the horizon: ‖x − x_r‖ = 0.03")
    assert "reached the target, ‖x − x_r‖ ≤ 0.01" in ended(
        _pushed([1.0006, 0.0, 0.0, 0.0], Event.REACHED), goal, there
    )
    sine = ut.Reference.sine(0.5, x=0.1)
    ((_, leg),) = sine.legs(ut.mechanisms.overhead_crane(), 4.0)
    followed = ended(_pushed(leg.state(2.0).tolist(), Event.REACHED), goal, sine)
    assert followed == "followed the reference to the end, where ‖x − x_r‖ ≤ 0.01, at 2.000 s"
    off = ended(_pushed([0.0, 0.0, 0.0, 0.0], Event.HORIZON), goal, sine)
    assert f"‖x − x_r‖ = {np.linalg.norm(leg.state(2.0)):.3g}, not" in off


def test_a_path_may_have_an_equals_sign(tmp_path: Path) -> None:
    way = tmp_path / "run=3" / "way.csv"
    way.parent.mkdir()
    way.write_text("t (s), x (m)\n0,0\n2,0.5\n", encoding="utf-8")
    crane = ut.mechanisms.overhead_crane()
    assert parse_target(crane, [str(way)]) == ut.Reference.through([0, 2], x=[0, 0.5])
    assert aimed("crane.urdf", [str(way)]) == ("crane.urdf", [str(way)])


def test_start_without_unit_is_told_what_to_write() -> None:
    """The remedy is a word that can be pasted."""
    _, _, err = run("simulate", RIG, "--start", "phi=40")
    assert "--start phi=40deg" in err


def test_unknown_option_and_choice_exit_2() -> None:
    """Typer's own refusals have the same exit code."""
    assert run("simulate", RIG, "--objective", "joy")[0] == 2
    assert run("simulate", RIG, "--nope")[0] == 2
    assert run("simulate")[0] == 2


@pytest.mark.slow
def test_infeasible_task_exits_1_with_the_evidence() -> None:
    """No admissible surface from 70°: says what the best candidate met, and what helps."""
    code, _, err = run(
        "optimise", RIG, "--start", "phi=70deg", "--objective", "time", "--evaluations", "300"
    )
    assert code == 1
    assert "no admissible surface" in err
    assert "the best candidate" in err
    assert "--evaluations of simulate and optimise" in err
    for name in ("simulate", "optimise"):
        assert any("--evaluations" in one.opts for one in COMMANDS[name,].params)


def test_folder_that_cannot_be_written_is_refused_before_the_work(tmp_path: Path) -> None:
    """A file in the way of the folder: exit 1, named, with the remedy."""
    (tmp_path / "taken").write_text("here first")
    code, _, err = run("simulate", RIG, "--out", str(tmp_path / "taken" / "deeper"))
    assert code == 1
    assert "taken" in err
    assert "--out" in err
    code, out, _ = run("reproduce", "--out", str(tmp_path / "taken"))
    assert (code, out) == (1, "")
    code, _, err = run("show", RIG, "--save", str(tmp_path / "taken" / "page.html"))
    assert code == 1
    assert "Name another one with --save" in err
    assert "--out" not in err


# -- work --------------------------------------------------------------------------------------


def test_simulate_writes_the_motion_that_the_library_gives(tmp_path: Path) -> None:
    """motion.csv holds the library's own trajectory; the manifest the request and versions."""
    code, out, _ = run(
        "simulate", RIG, "--start", "phi=20deg", "--objective", "time", "--set", "d_e=0.025",
        "--surface", SURFACE, "--out", str(tmp_path),
    )  # fmt: skip
    assert code == 0
    assert "reached the target" in out
    assert f"{tmp_path}" in out.replace("\n", "")
    rig = ut.mechanisms.rotary_pendulum(d_e=0.025)
    expected = ut.ClosedLoop(rig, ut.MinimumTime()).simulate(
        rig.state(phi=ut.deg(20)), parse_surface(rig, SURFACE)
    )
    with (tmp_path / "motion.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(expected.t)
    found = [float(row["phi"]) for row in rows]
    np.testing.assert_allclose(found, expected["phi"], rtol=1e-8, atol=1e-12)
    manifest = json.loads((tmp_path / "manifest.json").read_text())
    assert manifest["cost"] == pytest.approx(expected.cost)
    assert manifest["request"]["setting"] == ["d_e=0.025"]
    assert manifest["versions"]["numpy"]
    assert (tmp_path / "motion.png").read_bytes().startswith(b"\x89PNG")


def test_earlier_results_are_kept_and_said_where(tmp_path: Path) -> None:
    """A second run into the same folder moves the first one's files aside."""
    words = ("simulate", RIG, "--start", "phi=10deg", "--surface", SURFACE, "--out", str(tmp_path))
    run(*words)
    first = (tmp_path / "motion.csv").read_bytes()
    (tmp_path / "notes.txt").write_text("mine")
    _, out, _ = run(*words[:3], "phi=15deg", *words[4:])
    assert "earlier-1" in out
    assert (tmp_path / "earlier-1" / "motion.csv").read_bytes() == first
    assert (tmp_path / "motion.csv").read_bytes() != first
    assert (tmp_path / "notes.txt").read_text() == "mine"
    run(*words)
    assert (tmp_path / "earlier-2" / "motion.csv").exists()


@pytest.mark.slow  # as test_words and the quick start of the README do
def test_simulate_with_no_further_choice_runs_the_cascade() -> None:
    """A name and a start are enough: it designs, optimises and arrives."""
    code, out, _ = run(
        "simulate", RIG, "--start", "phi=20deg", "--objective", "time", "--set", "d_e=0.025"
    )
    assert code == 0
    assert "reached the target" in out
    assert "admitted" in out


ARM = """<robot name="arm">
 <link name="base"/>
 <link name="arm"><inertial><origin xyz="0.1 0 0"/><mass value="0.1"/>
  <inertia ixx="1e-4" iyy="3e-4" izz="3e-4" ixy="0" ixz="0" iyz="0"/></inertial></link>
 <link name="rod"><inertial><origin xyz="0 0 0.15"/><mass value="0.05"/>
  <inertia ixx="4e-4" iyy="4e-4" izz="1e-5" ixy="0" ixz="0" iyz="0"/></inertial></link>
 <joint name="shoulder" type="continuous"><parent link="base"/><child link="arm"/>
  <axis xyz="0 0 1"/><limit effort="0.6" velocity="50"/>
  <dynamics friction="0.06" damping="0.001"/></joint>
 <joint name="hinge" type="continuous"><origin xyz="0.2 0 0"/><parent link="arm"/>
  <child link="rod"/><axis xyz="1 0 0"/></joint>
</robot>"""


@pytest.mark.parametrize("control", rest_slow(["designed", "cascade"], "designed"))  # its kernel
def test_a_model_file_with_dry_friction_gets_the_layer_that_it_asks_for(
    tmp_path: Path, control: str
) -> None:
    """A tenth of the motor's torque: 'run' balanced it, 'simulate' refused it for its gains."""
    (tmp_path / "arm.urdf").write_text(ARM)
    words = ["--control", control, *(["--belief", "exact"] if control == "cascade" else [])]
    code, out, err = run("simulate", f"{tmp_path}/arm.urdf:shoulder", *words)
    assert (code, "error" in err) == (0, False)
    said = " ".join(out.split())
    assert "boundary layer 0.2, 2 times as thick as usual" in said
    assert "simulated without disturbances" in said
    assert "shoulder, 10%" in said


def test_the_exported_c_begins_with_the_layer_that_friction_asks_for(tmp_path: Path) -> None:
    (tmp_path / "arm.urdf").write_text(ARM.replace("0.06", "0.2"))
    for words, wanted in (((), 0), (("--layer", "0.1"), 2)):
        out = str(tmp_path / "firmware")
        model = f"{tmp_path}/arm.urdf:shoulder"
        code, _, _ = run("export", "c", model, "--period", "0.002", "--out", out, *words)
        assert code == wanted


def test_a_surface_that_export_looks_for_is_said_with_its_cost(tmp_path: Path) -> None:
    with short_searches():
        words = ("--control", "one-time", "--out", str(tmp_path / "firmware"))
        code, said, _ = run("export", "c", RIG, *words)
    assert code == 0
    written = re.search(r"\{\{(-1\.0, .*?)\}", (tmp_path / "firmware" / f"{RIG}.c").read_text())
    assert written is not None
    assert f"lambda_u={float(written[1].split(', ')[3]):.4g}" in said
    assert re.search(r"predicted cost +0\.\d+ s", said)


def test_a_verb_of_python_that_is_no_command_is_told_of() -> None:
    code, _, err = run("compare")
    assert code == 2
    assert "In Python: undertow.compare" in " ".join(err.split())


def test_what_is_proved_before_an_interruption_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-C in the search for a region left nothing of the claims before it."""

    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(decide, "prove_region", interrupted)
    code, out, err = run("certify", RIG, "--surface", SURFACE, "--out", str(tmp_path))
    assert code == 130
    assert "the law exists for" in out
    assert "claims had been proved, they are in" in err
    kinds = [one.kind for one in read_certificate(tmp_path / "certificate.json").subjects[0].claims]
    assert kinds[:2] == ["stability", "terminal ellipsoid"]


def test_what_needs_no_start_is_proved_without_one(tmp_path: Path) -> None:
    """A mechanism of one's own without a usual start was refused, in Python it was not."""
    (tmp_path / "bare.py").write_text(
        "from dataclasses import replace\nimport undertow as ut\n"
        "bare = replace(ut.mechanisms.rotary_pendulum(), start={})\n"
    )
    code, out, _ = run("certify", f"{tmp_path}/bare.py:bare", "--seconds", "0")
    assert code == 0
    assert "motions on the surface near the target converge" in " ".join(out.split())


def test_a_prediction_that_fails_costs_no_proof(monkeypatch: pytest.MonkeyPatch) -> None:
    """Gains too fast for its step ended the command, and with it all that was proved."""

    def refused(*_: object, **__: object) -> None:
        raise InvalidInputError("step for the gains", value="0.002 s", limit="less")

    monkeypatch.setattr(decide, "assess", refused)
    code, out, _ = run("certify", RIG, "--surface", SURFACE, "--seconds", "0")
    assert code == 0
    assert "step for the gains: got 0.002 s" in " ".join(out.split())


@pytest.mark.parametrize("heard", [True, False])
def test_a_polite_kill_shows_what_is_finished(
    capfd: pytest.CaptureFixture[str], heard: bool
) -> None:
    """SIGTERM, with which batch systems end what takes too long, lost every finished row.

    A job in the background does not hear Ctrl-C: shells start it so.
    """
    usual = signal.default_int_handler if heard else signal.SIG_IGN
    before = signal.signal(signal.SIGINT, usual)

    def killed() -> float:
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(1.0)
        return 2.0

    tasks: dict[Key, Callable[[], float]] = {("one",): lambda: 1.0, ("two",): killed}
    work: Experiment[float, Any] = Experiment(
        "numbers", tuple[str, float], tasks, {}, lambda found: [f"finished: {found}"]
    )
    try:
        with pytest.raises(typer.Exit) as ending:
            carry_out(work, None)
    finally:
        signal.signal(signal.SIGINT, before)
    assert ending.value.exit_code == 130
    out, err = capfd.readouterr()
    assert "finished: (1.0,)" in out
    assert "interrupted: 1 of 2 are done" in err
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


def test_simulate_on_a_plant_that_the_controller_does_not_know() -> None:
    """``--plant`` changes the truth alone: another motion under the same surface."""
    words = ("simulate", RIG, "--start", "phi=20deg", "--surface", SURFACE)
    same, other = run(*words), run(*words, "--plant", "m=0.14")
    assert same[0] == other[0] == 0
    assert same[1] != other[1]


def test_simulate_that_fails_says_so_and_exits_1() -> None:
    """From beyond the catch limit: the ending in words, and a status for scripts."""
    code, out, _ = run(
        "simulate", RIG, "--start", "phi=39deg",
        "--surface", "lambda_a=-0.5 alpha_u=5 lambda_u=10",
    )  # fmt: skip
    assert code == 1
    assert "singularity (37)" in out


@pytest.mark.slow  # kernels of its own
def test_a_hard_limit_binds_the_law_before_it_is_clipped() -> None:
    """With ``--hard-input`` the answer asks for less than ``--limit``; without, for more."""
    words = (
        "optimise", RIG, "--start", "phi=20deg", "--objective", "time", "--set", "d_e=0.025",
        "--evaluations", "400", "--limit", "voltage=9",
    )  # fmt: skip
    code, out, _ = run(*words, "--hard-input")
    assert code == 0
    assert "|voltage| ≤ 9 V before clipping" in out
    found = re.search(r"hard input limit.*?([-\d.]+) +V", out)
    assert found is not None
    assert float(found[1]) >= 0
    code, free, _ = run(*words)
    assert code == 0
    assert "clipping" not in free
    assert cost(free) < cost(out)


def cost(out: str) -> float:
    found = re.search(r"cost +([\d.]+)", out)
    assert found is not None
    return float(found[1])


@pytest.mark.slow  # kernels of their own
def test_a_box_binds_the_motion_and_one_that_breaks_is_named() -> None:
    """The optimum of a box that binds costs more, and its margin is in degrees."""
    words = ("--start", "phi=20deg", "--set", "d_e=0.025", "--objective", "energy")
    _, free, _ = run("optimise", RIG, *words)
    code, out, _ = run("optimise", RIG, *words, "--box", "theta=60deg")
    assert code == 0
    found = re.search(r"\|theta\| ≤ 60° +([-+\d.e]+) +°", out)
    assert found is not None
    assert 0 <= float(found[1]) < 10
    assert cost(out) > cost(free)
    code, out, _ = run("simulate", RIG, *words, "--surface", SURFACE, "--box", "theta=5deg")
    assert code == 1
    assert "broke |theta| ≤ 5°, at" in out


def test_the_end_of_a_motion_names_what_it_broke(rig: ut.Mechanism) -> None:
    """The states outside their boxes, else the hard limit: for people."""
    goal = objective_named("time", rig, 5.0, ["theta=5deg", "phi=-90deg:90deg"], hard_input=True)

    def motion(**state: float) -> ut.Trajectory:
        row = np.append(rig.state(**state), np.zeros(2 * rig.m + 2))[None]
        return recorded(rig, np.array([0.25]), row, ut.Event.CONSTRAINT, goal)

    assert ended(motion(theta=0.1), goal) == "broke |theta| ≤ 5°, at 0.250 s"
    both = ended(motion(theta=0.1, phi=-1.6), goal)
    assert both == "broke |theta| ≤ 5° and -90° ≤ phi ≤ 90°, at 0.250 s"
    assert ended(motion(theta=0.01), goal) == "broke the hard input limit, at 0.250 s"


def test_optimise_prints_the_surface_with_its_margins(tmp_path: Path) -> None:
    """The answer on the screen and in proposal.json is the optimiser's."""
    code, out, _ = run(
        "optimise", RIG, "--start", "phi=20deg", "--objective", "time", "--set", "d_e=0.025",
        "--evaluations", "400", "--seed", "3", "--out", str(tmp_path),
    )  # fmt: skip
    assert code == 0
    assert "(37)" in out
    answer = json.loads((tmp_path / "proposal.json").read_text())
    rig = ut.mechanisms.rotary_pendulum(d_e=0.025)
    expected = ut.Optimiser(
        ut.ClosedLoop(rig, ut.MinimumTime()), cold=ut.Budget(400), seed=3
    ).require(rig.state(phi=ut.deg(20)))
    assert expected.surface is not None
    assert answer["surface"]["alpha_u"] == expected.surface.alpha_u.tolist()
    assert answer["cost"] == expected.cost
    assert answer["evaluations"] <= 400


# -- words to values -----------------------------------------------------------------------------


def test_start_words_become_si() -> None:
    """Degrees and radians, angles and rates; what is not named is zero."""
    rig = ut.mechanisms.rotary_pendulum()
    x = parse_start(rig, ["phi=90deg", "theta=-0.5rad", "phi_dot=180deg/s", "theta_dot=1e-1rad/s"])
    np.testing.assert_allclose(x, [-0.5, np.pi / 2, 0.1, np.pi])
    np.testing.assert_array_equal(parse_start(rig, []), rig.state(**rig.start))


def test_box_words_become_constraints_in_si() -> None:
    """One bound is a modulus, two are an interval; the margin is in the unit that it names."""
    rig = ut.mechanisms.rotary_pendulum()
    words = ["theta=60deg", "phi_dot=-4rad/s:180deg/s", "phi=-0.5rad:90deg"]
    objective = objective_named("time", rig, 5.0, words, hard_input=True)
    assert objective.hard_input
    assert [(c.name, c.unit) for c in objective.constraints] == [
        ("|theta| ≤ 60°", "rad"),
        ("-4 rad/s ≤ phi_dot ≤ 180°/s", "rad/s"),
        ("-0.5 rad ≤ phi ≤ 90°", "rad"),
    ]
    at = dict(zip(rig.x, rig.state(theta=-1.0, phi=-0.4, phi_dot=3.0), strict=True))
    margins = [float(margin.subs(at)) for margin in objective.path_margins(rig)]
    np.testing.assert_allclose(margins, [np.pi / 3 - 1.0, np.pi - 3.0, 0.1])


def test_a_mechanism_of_a_file_is_one_like_any_other(tmp_path: Path) -> None:
    """``FILE.py:NAME`` serves where a name of the library does, with parameters and limits."""
    file = tmp_path / "model.py"
    file.write_text("import undertow as ut\nmine = ut.mechanisms.cart_pendulum()\n")
    found = mechanism_named(f"{file}:mine", ["l=0.4"], ["force=7"])
    assert found.substitution[sp.Symbol("l", real=True)] == 0.4
    assert found.input_limits == [7.0]
    code, out, _ = run("derive", f"{file}:mine")
    assert code == 0
    assert "M₁₂ = l m_p cos(φ)" in out
    code, out, err = run("derive", f"{file}:yours")
    assert (code, out) == (2, "")
    assert "yours" in err
    code, _, err = run("simulate", f"{tmp_path}/none.py:mine")
    assert code == 1
    assert "none.py" in err


def test_limit_words_replace_the_named_inputs_alone() -> None:
    """Of two motors the one that is named gets another limit."""
    pair = mechanism_named("two_motor_three_link")
    first, second = pair.inputs
    changed = mechanism_named("two_motor_three_link", limits=[f"{second.name}=0.25"])
    np.testing.assert_array_equal(changed.input_limits, [first.limit, 0.25])


def test_surface_words_of_several_inputs() -> None:
    """Commas join a row, semicolons rows; α_a is −I unless given."""
    pair = ut.mechanisms.two_motor_three_link()
    text = "lambda_a=-2,0.5;0,-3 alpha_u=1;2 lambda_u=4;5"
    surface = parse_surface(pair, text)
    np.testing.assert_array_equal(surface.lambda_a, [[-2, 0.5], [0, -3]])
    np.testing.assert_array_equal(surface.alpha_a, -np.eye(2))
    for printed in (str(surface), repr(surface), str(surface).replace(", ", ",\n ")):
        assert parse_surface(pair, printed) == surface
    with pytest.raises(InvalidInputError, match="not equally long"):
        parse_surface(pair, "lambda_a=-2,0.5;0 alpha_u=1;2 lambda_u=4;5")
    with pytest.raises(InvalidInputError, match="'lambda_a' twice"):
        parse_surface(pair, f"{text} lambda_a=-1,0;0,-1")
    for wrong, size in (("alpha_u=1,2", "1×2, must be 2×1"), ("lambda_a=-2", "1×1, must be 2×2")):
        with pytest.raises(InvalidInputError, match=f"{size}. Write for instance {wrong[:7]}"):
            parse_surface(pair, f"{wrong} lambda_u=4;5")


@pytest.mark.slow
def test_quick_reproduction_end_to_end(tmp_path: Path) -> None:
    """``reproduce --quick`` prints both tables and writes tables, figures and manifest."""
    code, out, _ = run("reproduce", "--quick", "--out", str(tmp_path))
    assert code == 0
    assert "Table 1" in out
    assert "Table 2" in out
    names = {path.name for path in tmp_path.iterdir()}
    assert {"tables.csv", "manifest.json", "figure-3-repeats.png", "figure-5-phase.png"} <= names


def test_the_doctor_tells_what_is_here_and_what_could_be() -> None:
    """Every extra that a user may want stands there with what it adds, or how to get it."""
    from undertow.studies import doctor

    code, out, _ = run("doctor", "--no-test")
    assert code == 0
    for extra in doctor.extras():
        assert extra.name in out
        assert extra.adds
        if extra.missing:
            assert f"undertow[{extra.name}]" in out.replace("\n", "")
    text = Path(__file__).parents[2].joinpath("pyproject.toml").read_text(encoding="utf-8")
    named = set(tomllib.loads(text)["project"]["optional-dependencies"])
    assert named == {*doctor.ADDS, *doctor.OWN}


def test_the_doctor_says_what_is_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    """A test that breaks off, or finds a difference, fails the command; the others go on."""
    from undertow.studies import doctor

    def broken(*_: object) -> tuple[bool, str]:
        raise ZeroDivisionError("of a broken machine")

    names = ("_formulas", "_motion", "_balance", "_proof", "_c", "_clock")
    for name in names:
        monkeypatch.setattr(doctor, name, lambda _: (True, "fine"))
    assert run("doctor")[0] == 0
    monkeypatch.setattr(doctor, "_motion", broken)
    monkeypatch.setattr(doctor, "_c", lambda _: (False, "7 apart"))
    code, out, _ = run("doctor")
    assert code == 1
    assert out.count("\nFAIL ") == 2
    assert "ZeroDivisionError: of a broken machine" in out
    assert out.count("ok  ") == 4


def test_the_doctor_does_not_call_a_late_machine_well(monkeypatch: pytest.MonkeyPatch) -> None:
    """Periods missed, but not half of them: the test passes, and the last line says what of it."""
    from undertow.studies import doctor

    for name in ("_formulas", "_motion", "_balance", "_proof", "_c"):
        monkeypatch.setattr(doctor, name, lambda _: (True, "fine"))

    class Late:
        missed_deadlines, skipped_periods, steps = 40, 5, 2000
        response_times = wakeup_delays = type("Times", (), {"quantile": lambda *_: 1e-4})()

    monkeypatch.setattr(doctor, "run", lambda *_, **__: Late())
    code, out, _ = run("doctor")
    words = " ".join(out.split())
    assert code == 0
    assert "45 of 2000 periods missed" in words
    assert f"All tests pass, but {doctor.TOO_LATE}." in words
    assert "All is well" not in out


@pytest.mark.slow
def test_the_doctor_passes_here() -> None:
    """All six tests, on this machine."""
    code, out, _ = run("doctor")
    assert code == 0, out
    assert out.count("ok  ") == 6


def test_without_arguments_it_says_what_to_try() -> None:
    """Each line that it proposes is a command that there is."""
    _, out, _ = run()
    tried = [line.split() for line in out.splitlines() if line.startswith(" undertow ")]
    assert len(tried) >= 4
    assert {words[1] for words in tried} <= {path[0] for path in COMMANDS}
    assert "doctor" in {words[1] for words in tried}


def test_progress_says_how_much_time_is_left(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """By what was done since it was first told: what a resumed run had already counts not."""
    clock = iter((100.0, 110.0, 111.0, 130.0))
    monkeypatch.setattr("undertow.cli.terminal.time.monotonic", lambda: next(clock))
    with progress_bar() as tell:
        for what, part in (("a", 0.2), ("b", 0.4), ("b", 0.41), ("c", 1.0)):
            tell(what, part)
    assert capsys.readouterr().err.splitlines() == ["… a", "… b, 30 s left", "… c"]


@pytest.mark.parametrize(
    ("times", "told", "lines"),
    [
        pytest.param(
            (100.0, 160.0, 170.0), (("search", 0.0), ("b", 0.0), ("c", 0.5)),
            ["… search", "… b", "… c, 10 s left"],
            id="a first search of a minute made ten seconds of motion look like ten minutes",
        ),
        pytest.param(
            (100.0, 105.0, 150.0), (("a", 0.0), ("b", 0.01), ("c", 0.5)),
            ["… a", "… b", "… c, 50 s left"],
            id="five seconds of compiling for the first hundredth are no pace",
        ),
    ],
)  # fmt: skip
def test_time_left_is_told_by_what_is_done_of_it(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch,
    times: tuple[float, ...], told: tuple[tuple[str, float], ...], lines: list[str],
) -> None:  # fmt: skip
    """What comes before any of it is done is no pace, nor is what little is done at first."""
    clock = iter(times)
    monkeypatch.setattr("undertow.cli.terminal.time.monotonic", lambda: next(clock))
    with progress_bar() as tell:
        for what, part in told:
            tell(what, part)
    assert capsys.readouterr().err.splitlines() == lines


def test_a_cascade_says_that_it_searches_before_it_does(monkeypatch: pytest.MonkeyPatch) -> None:
    """It said nothing until the first plan was there, which takes half a minute of compiling."""

    def searching(*_: object, progress: Callable[[float, float], None], **_more: object) -> None:
        progress(0.0, 1.0)
        progress(0.02, 1.0)
        raise InvalidInputError("end of the test")

    monkeypatch.setattr("undertow.cli.control.Cascade.simulate", searching)
    _, _, err = run("simulate", RIG)
    assert err.splitlines()[:2] == ["… searching for the first plan", "… cascade"]


def test_a_table_wider_than_the_terminal_is_not_cut(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Names stay whole; what may be broken into lines still is."""
    monkeypatch.setenv("COLUMNS", "40")
    heads = ["", *(f"entrant_{k}" for k in range(9))]
    row = ["double pendulum on a cart", *map(str, range(9))]
    show(table(heads, [row]), table(["", "what"], [["a name", "words " * 20]]))
    wide, *rest = capsys.readouterr().out.splitlines()
    assert wide.split() == heads[1:]
    assert rest[0].split()[-9:] == row[1:]
    assert max(len(line.rstrip()) for line in rest[1:]) <= 40


# -- where the output goes -----------------------------------------------------------------------


def _typed(*words: str, **how: Any) -> subprocess.CompletedProcess[bytes]:
    """Type a command in a process of its own, with standard streams of one's own."""
    code = "import sys; from undertow.cli import main; sys.argv[0] = 'undertow'; main()"
    command = [sys.executable, "-c", code, *words]
    return subprocess.run(command, stderr=subprocess.PIPE, timeout=120, check=False, **how)


@pytest.mark.slow
def test_a_terminal_that_cannot_show_a_letter_costs_no_result() -> None:
    """A result of minutes ended in UnicodeEncodeError on a terminal without ‖ or ≤."""
    ended = _typed("simulate", RIG, "--help", stdout=subprocess.PIPE,
                   env={**os.environ, "PYTHONIOENCODING": "ascii"})  # fmt: skip
    assert ended.returncode == 0
    assert ended.stderr == b""
    assert b"?x?" in ended.stdout


@pytest.mark.slow
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk_behind_a_redirection_is_one_line() -> None:
    with open("/dev/full", "wb") as full:
        ended = _typed("mechanisms", stdout=full)
    assert ended.returncode == 1
    assert ended.stderr.startswith(b"error: the output: got No space left on device")
    assert ended.stderr.count(b"\n") == 1


@pytest.mark.slow
def test_who_reads_the_output_may_leave() -> None:
    """`undertow … | head -1`: the exit status is the command's own, and nothing is said of it."""
    reader, writer = os.pipe()
    os.close(reader)
    ended = _typed("mechanisms", stdout=writer)
    os.close(writer)
    assert ended.returncode == 0
    assert ended.stderr == b""


@pytest.mark.slow
def test_no_output_at_all_is_none() -> None:
    """`>&-`: nothing to write to, and nothing to flush."""
    ended = _typed("--version", preexec_fn=lambda: os.close(1))
    assert ended.returncode == 0
    assert ended.stderr == b""


def test_streams_that_are_closed_are_nowhere(monkeypatch: pytest.MonkeyPatch) -> None:
    """Python has ``None`` in their place, and whatever asked them something failed."""
    for name in ("stdin", "stderr"):
        monkeypatch.setattr(sys, name, None)
    monkeypatch.setattr(sys, "argv", ["undertow", "--version"])
    monkeypatch.setenv("COLUMNS", "0")  # nothing would be shown
    with pytest.raises(SystemExit) as left:
        main()
    assert left.value.code == 0
    assert "COLUMNS" not in os.environ
    assert sys.stderr.writable()
    assert not sys.stdin.isatty()
    for stream in (sys.stdin, sys.stderr):
        stream.close()


def test_help_on_a_full_disk_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:

    class Full(io.StringIO):
        def write(self, _: str) -> int:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(sys, "stdout", Full())
    monkeypatch.setattr(sys, "argv", ["undertow", "simulate", "--help"])
    with pytest.raises(SystemExit) as left:
        main()
    assert left.value.code == 1
    assert capsys.readouterr().err.startswith("error: the output: got No space left on device")


def test_what_was_found_is_shown_where_it_cannot_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After a search of minutes a full disk left nothing of it."""

    def full(*_: object) -> None:
        raise ArtefactError("results", value="No space left on device")

    monkeypatch.setattr(terminal, "write_files", full)
    code, out, err = run("optimise", RIG, "--evaluations", "64", "--out", str(tmp_path))
    assert (code, err.splitlines()[-1]) == (1, "error: results: got No space left on device.")
    assert "predicted cost" in out


def test_a_port_that_is_none_is_refused_before_the_page_is_made() -> None:
    code, _, err = run("show", RIG, "--no-browser", "--port", "70000")
    assert code == 2
    assert "65535" in err
    assert "making ready" not in err


def test_every_command_minimises_the_same_where_nobody_says() -> None:
    """What `simulate --control one-time` finds is what `export c --control one-time` writes."""
    usual = {
        words: option.default
        for words, command in COMMANDS.items()
        for option in command.params
        if option.name == "objective" and words != ("survey",)  # which has several
    }
    assert ("export", "c") in usual
    assert set(usual.values()) == {USUAL}


def test_a_unit_that_is_typed_is_not_said_to_be_wanted_in_si() -> None:
    """Claim: the refusal asks for the unit that the mechanism gives, which need not be SI (kN)."""
    with pytest.raises(InvalidInputError, match="unit that the mechanism gives") as refused:
        parse_values(["drive=5kN"], "limit of input")
    assert "SI" not in str(refused.value)


def test_a_quick_trial_does_what_is_asked_for_beside_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """``--seeds 7 --quick`` made three, and ``--limits --quick`` none."""
    from undertow.studies.trials import experiments

    asked: list[dict[str, object]] = []

    def balance(seeds: int = 20, angle: float = 0.6, limits: bool = True) -> None:
        asked.append({"seeds": seeds, "limits": limits})

    monkeypatch.setitem(experiments.EXPERIMENTS, "balance", balance)
    monkeypatch.setattr("undertow.cli.trials.carry_out", lambda *_: None)
    run("trials", "balance", "--quick")
    run("trials", "balance", "--quick", "--seeds", "7", "--limits")
    assert asked == [{"seeds": 3, "limits": False}, {"seeds": 7, "limits": True}]
