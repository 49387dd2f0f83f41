"""References on a rig: fed forward from step to step, searched and judged along, replayed."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import undertow as ut
from runs import run, run_until, short_searches
from undertow.base import InvalidInputError
from undertow.cascade import CascadeState
from undertow.law import ReferenceMotion
from undertow.runtime import Recipe, Request, Settings, send_target, session
from undertow.runtime.encoding import memory_from, memory_to, reference_from, reference_to
from undertow.runtime.workers import Packer

SINE = ut.Reference.sine(0.25, theta=ut.deg(20))
RECIPE = Recipe(start=(0.0, 0.1, 0.0, 0.0), evaluations=64, horizon=8.0, target=SINE, duration=8.0)


def motion() -> ReferenceMotion:
    assert RECIPE.reference is not None
    return RECIPE.reference


@cache
def first() -> CascadeState:
    """What a run begins with."""
    with short_searches():
        return RECIPE.first()


def off(log: Path, after: float) -> tuple[float, float]:
    """How far arm and pendulum of a run were off the reference after a time, rms, degrees."""
    found = ut.replay(log)
    assert found.identical
    assert found.misjudged == 0
    book = found.recording
    asked = motion().rows(book["t"])[:, :2]
    error = np.column_stack([book["theta"], book["phi"]]) - asked
    arm, pendulum = np.degrees(np.sqrt((error[book["t"] > after] ** 2).mean(axis=0)))
    return float(arm), float(pendulum)


@pytest.mark.slow
def test_a_run_follows_a_sine_and_is_replayed_to_the_same_bits(tmp_path: Path) -> None:
    """The arm swings by 20°; answers are asked for, judged along the reference and used."""
    log = tmp_path / "run.db"
    with session(RECIPE, log=log, simulated=True) as runtime:
        report = runtime.run(4.0)
    assert report.mode_before_stop.name == "BALANCE"
    assert report.answers["applied"] > 5
    arm, pendulum = off(log, 3.0)
    assert arm < 4.0
    assert pendulum < 0.3


@pytest.mark.slow
def test_while_it_follows_a_reference_it_is_given_a_set_point(tmp_path: Path) -> None:
    """Rest, from a motion; on the realistic rig, in simulated time."""
    log, recipe, found = tmp_path / "run.db", replace(RECIPE, rig="realistic"), []
    with session(recipe, log=log, simulated=True) as runtime:
        read = runtime.rig.read

        def reading() -> object:
            if runtime.report.steps == 3000:
                found.append(runtime.target)
                runtime.retarget({"theta": 0.5})
            return read()

        runtime.rig.read = reading  # type: ignore[method-assign, assignment]
        report = runtime.run(12.0)
    assert report.verdict.ending == "balanced"
    assert found[0].now["theta"] == pytest.approx(ut.deg(-20), abs=0.01)
    replayed = ut.replay(log)
    assert replayed.identical
    assert abs(replayed.recording["theta"][-1] - 0.5) < 0.15


@pytest.mark.slow
def test_after_a_swing_up_it_follows_the_reference(tmp_path: Path) -> None:
    log = tmp_path / "run.db"
    recipe = Recipe(
        rig="realistic", swing_up=True, evaluations=64, target=SINE, duration=14.0
    )  # fmt: skip
    with session(recipe, log=log, simulated=True) as runtime:
        report = runtime.run(14.0)
    assert report.verdict.ending == "balanced"
    found = ut.replay(log)
    assert found.identical
    late = found.recording["t"] > 10.0
    asked = motion().rows(found.recording["t"][late] % 4.0)[:, 0]
    assert np.degrees(np.abs(found.recording["theta"][late] - asked).max()) < 8.0


@pytest.mark.slow
def test_against_the_clock_processes_share_the_reference(tmp_path: Path) -> None:
    """Until answers were used, however late a busy machine makes them."""
    log = tmp_path / "run.db"
    with session(replace(RECIPE, seconds=0.03), log=log, processes=1) as runtime:
        report = run_until(
            runtime, lambda report: report.steps > 5000 and report.answers["applied"] > 3
        )
        assert runtime.controller.memory.target is runtime.controller.reference
    assert not report.lockstep_mismatches
    arm, _ = off(log, 4.0)
    assert arm < 3.0
    with pytest.raises(ut.base.ArtefactError):
        send_target(log, {"theta": 0.0})


@pytest.mark.slow
def test_the_slow_loop_predicts_along_the_reference() -> None:
    """On it the error stays zero to the next use, while the target moves on by degrees."""
    memory = first()
    assert memory.target is motion()
    answer = RECIPE.respond(Request(1.0, np.zeros(4), 1.3, memory))
    moved = motion().state(1.3) - motion().state(1.0)
    assert abs(np.degrees(moved[0])) > 0.5
    assert np.abs(answer.x).max() < 1e-4
    assert answer.memory.target is motion()


def test_what_both_processes_have_goes_by_number() -> None:
    """A request is as short with an hour's reference as without one; what comes is the object."""
    memory = first()
    packer, plain = Packer([motion()]), Packer()
    request = Request(0.0, np.zeros(4), 0.1, memory)
    packed = packer.pack(request)
    assert len(packed) < 0.2 * len(plain.pack(request))
    assert packer.unpack(packed).memory.target is motion()
    again = plain.unpack(plain.pack(request)).memory.target
    assert np.array_equal(again.q, motion().q)


@pytest.mark.parametrize(
    "reference",
    [
        SINE,
        ut.Reference.ramp(2.0, theta=(0.1, 0.5)),
        ut.Reference.through([0, 1, 2], theta=[0, 0.3, 0.1]),
    ],
)
def test_a_recipe_with_a_reference_is_data(reference: ut.Reference) -> None:
    """Through JSON values and back; functions of one's own are none, and have no recipe."""
    recipe = replace(RECIPE, target=reference)
    assert Recipe.from_dict(recipe.as_dict()) == recipe
    named = recipe.in_names()
    assert named is not None
    assert named.reference is not None
    values = reference_to(reference)
    assert values is not None
    assert reference_from(values) == reference
    own = ut.Reference.of(theta=lambda t: 0.1 * np.sin(t))
    assert reference_to(own) is None
    assert replace(RECIPE, target=own).in_names() is None


def test_a_log_of_a_target_that_moves_needs_the_reference() -> None:
    memory = first()
    written = memory_to(memory)
    assert written["target"] == "reference"
    assert memory_from(written, motion()).target is motion()
    with pytest.raises(ValueError, match="a target that moves, in a run without one"):
        memory_from(written)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"settings": Settings(max_travel=0.3)}, "≤ 16.33°: 95 % of the max_travel of the run"),
        ({"duration": 7200.0}, "got 7200 s, must be > 0, ≤ 3600 s"),
        ({"target": ut.Reference.sine(1.0, phi=0.1)}, "got 'phi'"),
    ],
)
def test_a_reference_that_cannot_be_followed_is_refused(
    changed: dict[str, object], words: str
) -> None:
    """Before the rig is read."""
    with pytest.raises(InvalidInputError, match=words):
        replace(RECIPE, **changed)  # type: ignore[arg-type]


@pytest.mark.slow
def test_references_on_the_command_line(tmp_path: Path) -> None:
    """A sine, and a path from a file, with its log."""
    path, log = tmp_path / "path.csv", tmp_path / "run.db"
    path.write_text("t (s), theta (deg)\n0, 0\n0.5, 4\n1, 5\n")
    words = ("run", "rotary_pendulum", "--start", "phi=2deg", "--simulated", "--seconds", "1.2")
    code, out, err = run(*words, "--target", str(path), "--log", str(log))
    assert code == 0, out + err
    assert ut.replay(log).identical
    code, out, err = run(*words, "--target", "theta=3deg@0.5Hz")
    assert code == 0, out + err
