"""URDF and MJCF as people have them: what is in the files of others, in small ones of our own."""

from __future__ import annotations

import math
import re
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import undertow as ut
from runs import run
from undertow.base import (
    ArtefactError,
    InvalidInputError,
    MissingExtraError,
    ModelError,
    UndertowError,
)
from undertow.cli.parsing import aimed
from undertow.estimators import Belief
from undertow.mechanisms.named import DataName, from_anywhere, named, origin
from undertow.models import FloatArray, controllability
from undertow.models import importers as modelling
from undertow.models.importers import equilibrium, mjcf_document, mujoco_compiler
from undertow.models.importers.formats import format_of
from undertow.models.importers.mujoco_compiler import AGREEMENT, agreement
from undertow.runtime import Recipe
from undertow.runtime.session import rig_named
from undertow.studies.model_files import files_of, model_files, refused_groups, summary

LOOK = """<mujoco>
  <asset><texture name="grid" type="2d" builtin="checker" width="9" height="9"/>
    <material name="steel" texture="grid"/></asset>
  <visual><map znear="0.1"/></visual>
</mujoco>"""

POLE = """<!-- a pole that leans: its upright is 0.2 deg off zero -->
<mujoco model="leaning pole">
  <include file="./common/look.xml"/>
  <compiler inertiafromgeom="true"/>
  <size nstack="3000"/>
  <default><joint damping="0.2"/><geom material="steel"/>
    <default class="pole"><joint axis="0 1 0" damping="0.001"/></default></default>
  <worldbody>
    <light pos="0 0 3"/>
    <geom type="plane" size="4 4 .1"/>
    <body name="cart">
      <joint name="slider" type="slide" axis="1 0 0" range="-1 1"/>
      <geom type="box" size="0.1 0.1 0.05" mass="1"/>
      <body name="pole" childclass="pole">
        <joint name="hinge" range="-80 200"/>
        <geom type="capsule" fromto="0 0 0 0.002 0 0.6" size="0.03" mass="0.3"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="slide" joint="slider" gear="50" ctrlrange="-3 3"/></actuator>
  <sensor><jointpos joint="hinge"/></sensor>
</mujoco>"""

LEAN = math.atan2(0.001, 0.3)


@pytest.fixture
def pole(tmp_path: Path) -> Path:
    (tmp_path / "common").mkdir()
    (tmp_path / "common" / "look.xml").write_text(LOOK)
    path = tmp_path / "pole.xml"
    path.write_text(POLE)
    return path


@pytest.fixture
def mujoco() -> Any:
    return pytest.importorskip("mujoco")


def states(n: int) -> FloatArray:
    return np.random.default_rng(0).uniform(-2, 2, (20, 2 * n))


def same(one: ut.Mechanism, other: ut.Mechanism, tight: float = 1e-12) -> None:
    x = states(one.n)
    scale = np.abs(one.f(x)).max()
    assert np.abs(one.M(x[:, : one.n]) - other.M(x[:, : one.n])).max() < tight
    assert np.abs(one.f(x) - other.f(x)).max() < tight * scale
    assert one.input_matrix == other.input_matrix
    assert one.input_limits.tolist() == other.input_limits.tolist()


# -- the compiler ---------------------------------------------------------------------------------


def test_what_mujoco_compiled_agrees_with_it(pole: Path, mujoco: Any) -> None:
    """Claim: includes, default classes and materials are read; accelerations agree to 1e-8."""
    assert 0 < float(agreement(modelling.from_mjcf(pole))) < AGREEMENT


def test_without_mujoco_the_extra_is_named(pole: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(MissingExtraError, match=r"undertow\[mujoco\]"):
        modelling.from_mjcf(pole)


@pytest.mark.parametrize(
    "given",
    ["diaginertia='0 1 1'", "diaginertia='0.5 0.3 0.805'", "fullinertia='2 2.05 1.5 0 1 0'"],
)
@pytest.mark.parametrize("turn", ["", "euler='20 30 0'"])
def test_inertias_that_mujoco_refuses(given: str, turn: str, mujoco: Any) -> None:
    """Claim: thin rods and rounded moments, which the compiler refuses, are read as the file has
    them, R I Rᵀ in the axes of the body, and moved as MuJoCo's engine then has them."""
    if "full" in given:
        turn = ""  # it takes no axes of its own
    text = f"""<mujoco><worldbody><body name="cart">
      <joint name="x" type="slide" axis="1 0 0"/><geom size="0.1" mass="1"/>
      <body name="rod"><joint name="phi" axis="0 1 0"/>
        <inertial mass="0.2" pos="0.1 0 0.3" {given} {turn}/></body></body></worldbody>
      <actuator><motor name="push" joint="x"/></actuator></mujoco>"""
    with pytest.raises(ValueError, match="inertia"):
        mujoco.MjModel.from_xml_string(text)
    numbers = [float(word) for word in given.partition("'")[2].rstrip("'").split()]
    tensor = np.diag(numbers[:3])
    if len(numbers) == 6:
        for (i, j), value in zip([(0, 1), (0, 2), (1, 2)], numbers[3:], strict=True):
            tensor[i, j] = tensor[j, i] = value
    a, b = np.radians([20, 30] if turn else [0, 0])
    about_x = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    about_y = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    axes = about_x @ about_y
    rod = modelling.read_mjcf(text).links[-1]
    assert np.allclose(rod.inertia, axes @ tensor @ axes.T, rtol=0, atol=1e-12)
    assert rod.mass == 0.2
    assert float(agreement(modelling.from_mjcf(text))) < AGREEMENT


def test_what_was_read_is_said_in_five_lines(pole: Path) -> None:
    lines = named(str(pole)).description.splitlines()
    assert [line.split()[0] for line in lines] == ["MJCF", "joints", "inputs", "left", "target"]
    assert lines[1] == "joints slider (-1 to 1 m), hinge (-80 to 200°)"
    assert lines[2] == "inputs slide × 50 on slider, |slide| ≤ 3"


def test_a_difference_from_mujoco_is_refused(
    pole: Path, mujoco: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Claim: what moves the bodies and is not read does not go unnoticed: here, half a damping."""
    true = mujoco_compiler._Compiled._joint

    def halved(self: Any, *given: Any) -> Any:
        joint = true(self, *given)
        object.__setattr__(joint, "damping", 0.5 * joint.damping)
        return joint

    monkeypatch.setattr(mujoco_compiler._Compiled, "_joint", halved)
    with pytest.raises(ModelError, match=r"from MuJoCo's, relative.*at most 1e-08"):
        modelling.from_mjcf(pole)


SERVO = """<mujoco model="servo">
  <compiler angle="radian"/>
  <worldbody><body name="a"><joint name="slider" type="slide" axis="1 0 0" damping="0.1"/>
    <inertial mass="1" pos="0 0 0" diaginertia="1 1 1"/>
    <frame euler="0 0.3 0"><body name="b" pos="0 0 0.1"><joint name="hinge" axis="0 1 0"/>
      <geom type="mesh" mesh="tip"/></body></frame></body></worldbody>
  <asset><mesh name="tip" vertex="0 0 0  .1 0 0  0 .1 0  0 0 .4"/></asset>
  <tendon><fixed name="belt"><joint joint="slider" coef="2"/></fixed></tendon>
  <actuator>
    <position name="drive" tendon="belt" gear="3" kp="7" kv="0.5" ctrlrange="-1 1"/>
  </actuator>
</mujoco>"""


def test_servos_tendons_of_one_joint_frames_and_meshes(mujoco: Any) -> None:
    """Claim: the spring and damper of a servo become the mechanism's, gears and coefficients
    multiply, and a mesh gives its inertia; the comparison with MuJoCo is made at once."""
    read = modelling.from_mjcf(SERVO)
    assert float(agreement(read)) < AGREEMENT
    assert [c.name for c in read.coordinates] == ["slider", "hinge"]
    assert float(read.input_matrix[0, 0]) == pytest.approx(7 * 3 * 2)
    push = read.f([0.1, 0.0, 0.0, 0.0])[0] - read.f([0.0, 0.0, 0.0, 0.0])[0]
    assert push == pytest.approx(-7 * (3 * 2) ** 2 * 0.1)
    brake = read.f([0.0, 0.0, 1.0, 0.0])[0] - read.f([0.0, 0.0, 0.0, 0.0])[0]
    assert brake == pytest.approx(-0.1 - 0.5 * (3 * 2) ** 2)


BRANCHES = """<mujoco><worldbody>
  <body><joint axis="0 1 0"/><geom pos="0 0 .2" size=".1"/></body>
  <body pos="0 1 0"><joint name="k" axis="0 1 0"/><geom pos="0 0 .5" size=".1"/>
    <body pos="0 0 .5"><joint axis="0 1 0"/><geom pos="0 0 .5" size=".1"/></body></body>
  <body><joint axis="1 0 0"/><geom pos="0 .3 .2" size=".1"/></body>
</worldbody><actuator><motor joint="k"/></actuator></mujoco>"""


def test_joints_without_names_in_several_branches(mujoco: Any) -> None:
    """Claim: they are compared with MuJoCo's own, whose order is that of the file."""
    read = modelling.from_mjcf(BRANCHES)
    assert float(agreement(read)) < AGREEMENT
    assert read.n == 4


def test_what_mujoco_has_and_no_mechanism_can_have_is_refused(mujoco: Any) -> None:
    limited = POLE.replace('<include file="./common/look.xml"/>', "").replace(
        ' material="steel"', ""
    )
    for old, new, match in (
        ("<actuator>", '<actuator><intvelocity joint="hinge" kp="1" actrange="-1 1"/>', "states"),
        ("<actuator>", '<actuator><muscle joint="hinge"/>', "states of its own"),
        ('ctrlrange="-3 3"', 'ctrlrange="0 3"', "one way only"),
        ("<worldbody>", '<option density="1"/><worldbody>', "density"),
        ("<actuator>", '<tendon><fixed name="t" range="0 1"><joint joint="slider" coef="1"/>'
         "</fixed></tendon><actuator>", "limits on tendon"),
        ('<body name="pole"', '<body name="pole" gravcomp="1"', "gravcomp"),
        ('joint="slider" gear="50"', 'joint="slider" gear="0"', "gear of actuator"),
        ('ctrlrange="-3 3"', 'ctrlrange="-3 3" delay="0.02" nsample="4"', "'slide' that acts late"),
        ("<worldbody>", '<asset><model name="m" file="robot.xml"/></asset><worldbody>', "to_xml"),
        ('name="hinge" range', 'name="hinge" strength="1" range', "unrecognized attribute"),
    ):  # fmt: skip
        assert old in limited
        with pytest.raises(UndertowError, match=match):
            modelling.from_mjcf(limited.replace(old, new))


def test_frames_of_the_world_are_read(mujoco: Any) -> None:
    """Claim: ``coordinate="global"``, which MuJoCo reads no more, gives the same equations."""
    head = '<mujoco><compiler {}/><worldbody><body name="a" pos="0.1 0 0.2">'
    ends = '<actuator><motor joint="p"/></actuator></mujoco>'
    local = head.format('angle="radian"') + (
        '<joint name="p" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 1" size=".05"/>'
        '<body name="b" pos="0 0 1"><joint name="q" axis="0 1 0" pos="0 0 0.05"/>'
        '<geom type="capsule" fromto="0 0 0 0.3 0 0.5" size=".05"/></body></body></worldbody>'
    )
    world = head.format('angle="radian" coordinate="global"') + (
        '<joint name="p" axis="0 1 0"/>'
        '<geom type="capsule" fromto="0.1 0 0.2 0.1 0 1.2" size=".05"/>'
        '<body name="b"><joint name="q" axis="0 1 0" pos="0.1 0 1.25"/>'
        '<geom type="capsule" fromto="0.1 0 1.2 0.4 0 1.7" size=".05"/></body></body></worldbody>'
    )
    same(modelling.from_mjcf(local + ends), modelling.from_mjcf(world + ends), 1e-11)


def test_a_compilers_warnings_stay_away(
    tmp_path: Path, mujoco: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Claim: MuJoCo leaves no log file in the folder where somebody works."""
    monkeypatch.chdir(tmp_path)
    text = SERVO.replace('angle="radian"', 'angle="radian" settotalmass="3"')
    assert modelling.from_mjcf(text).n == 2
    assert list(tmp_path.iterdir()) == []


# -- files are data --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("element", "match"),
    [
        ('<include file="/etc/passwd"/>', "relative to the model's own file"),
        ('<include file="C:\\\\look.xml"/>', "relative to the model's own file"),
        ('<include file="pole.xml"/>', "include itself"),
        ('<include file=""/>', "relative"),
        ('<include file="nowhere.xml"/>', r"nowhere\.xml"),
        ('<include file="common"/>', "plain file"),
    ],
)
def test_includes_are_relative_and_end(pole: Path, element: str, match: str) -> None:
    pole.write_text(POLE.replace('<include file="./common/look.xml"/>', element))
    with pytest.raises(UndertowError, match=match):
        modelling.from_mjcf(pole)


def test_a_text_has_no_folder_to_include_from() -> None:
    with pytest.raises(InvalidInputError, match="Give the model as a file"):
        modelling.from_mjcf(POLE)


def test_what_is_included_counts(pole: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Claim: the limits of size are those of the whole document."""
    pole.with_name("common").joinpath("look.xml").write_text(f"<mujoco>{'<asset/>' * 40}</mujoco>")
    assert modelling.from_mjcf(pole).n == 2
    monkeypatch.setattr(mjcf_document, "MOST", 50)
    with pytest.raises(InvalidInputError, match="with what it includes"):
        modelling.from_mjcf(pole)


@pytest.mark.parametrize("file", ["/tip.stl", "tip.stl"])
def test_a_mesh_that_an_inertia_needs_is_relative_and_there(pole: Path, file: str) -> None:
    mesh = f'<asset><mesh name="tip" file="{file}"/></asset><worldbody>'
    text = POLE.replace("<worldbody>", mesh)
    pole.write_text(text)
    assert modelling.from_mjcf(pole).n == 2  # nothing needs it
    pole.write_text(text.replace('type="capsule" fromto="0 0 0 0.002 0 0.6" size="0.03"',
                                 'type="mesh" mesh="tip"'))  # fmt: skip
    with pytest.raises(UndertowError, match="relative" if file[0] == "/" else "an <inertial>"):
        modelling.from_mjcf(pole)


# -- equilibria ------------------------------------------------------------------------------------


def test_the_nearest_equilibrium_is_found_and_taken(pole: Path) -> None:
    """Claim: an upright that leans needs no word; it is the target, and named."""
    rig = named(str(pole))
    assert f"target the nearest equilibrium: slider = 0 m, hinge = {math.degrees(-LEAN):.4g}°" in (
        rig.description
    )
    assert np.abs(rig.f(np.zeros(4))[1]) < 1e-12
    assert rig.coordinates[1].low == pytest.approx(math.radians(-80) + LEAN)
    assert dict(rig.start) == {"hinge": math.radians(5)}
    assert controllability(rig) > 1e-4
    known = modelling.from_mjcf(pole, equilibrium={"hinge": -LEAN}) if LEAN else rig
    same(rig, known, 1e-9)


def test_equilibria_by_name(pole: Path) -> None:
    up, down = named(f"{pole}@upright"), named(f"{pole}@hanging")
    turned = [0.0, math.pi]
    same(up, named(f"{pole}@nearest"))
    assert np.abs(up.M(turned) - down.M([0, 0])).max() < 1e-9
    same(down, named(f"{pole}@hinge=170deg"), 1e-9)
    same(down, modelling.from_mjcf(pole, equilibrium="hanging"))
    assert "hanging" in down.description
    with pytest.raises(InvalidInputError, match="one of upright, hanging, nearest"):
        modelling.from_mjcf(pole, equilibrium="sideways")
    with pytest.raises(InvalidInputError, match="JOINT=VALUE with its unit"):
        named(f"{pole}@hinge=170")
    pole.write_text(POLE.replace('range="-80 200"', 'range="-80 80"'))
    with pytest.raises(ModelError, match=r"hanging equilibrium.*one of slider = 0 m, hinge = -0"):
        named(f"{pole}@hanging")


def test_a_rig_in_mujoco_stands_where_the_mechanism_does(pole: Path, mujoco: Any) -> None:
    """Claim: on the scene of the same file zero is the equilibrium that is the target."""
    for word in ("", "@hanging"):
        name = f"{pole}{word}"
        x = np.array([0.1, 0.2, 0.0, 0.0])
        recipe = Recipe(mechanism=name, start=tuple(x.tolist()), rig="ideal")
        plain = POLE.replace('<include file="./common/look.xml"/>', "")
        scene = pole.with_name("scene.xml")
        scene.write_text(plain.replace('<geom material="steel"/>', ""))
        rig: Any = rig_named(str(scene), recipe, supervised=False)
        at = origin(name)
        own: Any = rig_named(
            "mujoco", replace(recipe, mechanism=f"{scene}{word}"), supervised=False
        )
        assert own._data.qpos.tolist() == rig._data.qpos.tolist()
        assert rig._data.qpos.tolist() == pytest.approx([0.1, 0.2 + at["hinge"]])
        assert at["hinge"] == pytest.approx(math.pi - LEAN if word else -LEAN)


def test_an_equilibrium_that_the_inputs_cannot_hold_is_none(pole: Path) -> None:
    """Claim: on a slope of 30 degrees a force of m g sin(30 deg) holds the cart, or nothing."""
    text = POLE.replace("<worldbody>", '<option gravity="4.905 0 -8.496"/><worldbody>')
    pole.write_text(text)
    assert "held by slide = -0.12" in named(str(pole)).description
    pole.write_text(text.replace('ctrlrange="-3 3"', 'ctrlrange="-.1 .1"'))
    with pytest.raises(ModelError, match="which the inputs hold within limits"):
        named(str(pole))


def test_zero_is_no_target_where_the_mechanism_cannot_rest_there(tmp_path: Path) -> None:
    """A rail from 0 or 0.5 to 2 m, and a level arm too heavy for its motor: zero was the target."""
    text = """<mujoco><worldbody><body><joint name="slide" type="slide" axis="1 0 0" range="LOW 2"/>
<geom type="sphere" size="0.1" mass="1"/><body><joint name="hinge" axis="0 1 0"/><geom mass="0.1"
type="capsule" fromto="0 0 0 0 0 0.5" size="0.01"/></body></body></worldbody><actuator>
<motor name="push" joint="slide" gear="10" ctrlrange="-1 1"/></actuator></mujoco>"""
    file = tmp_path / "cart.xml"
    for low, middle in (("-1", 0.0), ("0", 1.0), ("0.5", 1.25)):
        file.write_text(text.replace("LOW", low))
        assert origin(str(file)) == {"slide": middle, "hinge": 0.0}
    arm = """<mujoco><worldbody><body><joint name="arm" axis="0 1 0"/><geom type="capsule" mass="2"
fromto="0 0 0 1 0 0" size="0.02"/><body pos="1 0 0"><joint name="rod" axis="0 1 0"/><geom mass="0.1"
type="capsule" fromto="0 0 0 0 0 -0.5" size="0.01"/></body></body></worldbody><actuator><motor
name="push" joint="arm" ctrlrange="-MOST MOST"/></actuator></mujoco>"""
    for most, level in (("20", True), ("5", False)):
        file.write_text(arm.replace("MOST", most))
        rig = named(f"{file}@nearest")
        assert ("target zero" in rig.description) == level
        assert np.abs(rig.f(np.zeros(4))[0]) < rig.input_limits[0]


def test_a_servo_rests_where_its_input_is_zero(pole: Path) -> None:
    """Claim: on that slope a servo too weak to hold zero gives way until its spring bears the
    cart, by (m + M) g sin(30 deg) / kp; where the travel does not reach there, what would hold
    zero is said. Where zero is outside the travel, its middle is tried."""
    text = POLE.replace("<worldbody>", '<option gravity="4.905 0 -8.496"/><worldbody>')
    motor = '<motor name="slide" joint="slider" gear="50" ctrlrange="-3 3"/>'
    servo = '<position name="slide" joint="slider" kp="20" ctrlrange="-.01 .01"/>'
    pole.write_text(text.replace(motor, servo))
    given = named(f"{pole}@hanging")
    assert f"slider = {1.3 * 4.905 / 20:.4g} m, hinge = 149." in given.description
    assert "held by" not in given.description
    pole.write_text(text.replace(motor, servo.replace("20", "5")))
    with pytest.raises(ModelError, match=r"none: slider = 0 m, .* takes slide = -1\.28, limited"):
        named(str(pole))
    pole.write_text(POLE.replace('range="-1 1"', 'range="1 3"'))
    assert "slider = 2 m" in named(f"{pole}@upright").description
    pole.write_text(POLE.replace('range="-80 200"', 'range="20 80"'))
    with pytest.raises(ModelError, match=r"hinge = \S+ is outside the travel of hinge"):
        named(f"{pole}@upright")


def test_a_start_is_within_what_the_inputs_reach(pole: Path) -> None:
    """Claim: a motor too weak for 5 degrees says by how much, and its start is closer: so much
    that the linear model needs half of it."""
    strong = named(str(pole))
    pole.write_text(POLE.replace('ctrlrange="-3 3"', 'ctrlrange="-.001 .001"'))
    weak = named(str(pole))
    needed = float(weak.description.rpartition("needs ")[2].split()[0])
    lin = strong.linearise()
    rates, modes = np.linalg.eig(lin.A.T)
    k = int(np.argmax(rates.real))  # alone: z = wᵀx is held by |wᵀb| u ≥ λ |z|
    push = abs(modes[:, k] @ lin.input[:, 0]) * 0.001
    assert needed == pytest.approx(
        rates[k].real * abs(modes[1, k]) * math.radians(5) / push, rel=0.02
    )
    assert weak.start["hinge"] == pytest.approx(0.5 * math.radians(5) / needed, rel=1e-2)


def test_what_is_needed_of_the_limits_is_known_of_the_smallest_ones() -> None:
    """Of limits that are 1e-8 of what is needed nothing was said: they were taken for zero."""
    cart = ut.mechanisms.cart_pendulum()
    start, (limit,) = cart.state(phi=ut.deg(20.0)), cart.input_limits.tolist()
    needed = modelling.least_peak(cart, start)
    for part in (1e-6, 1e-9, 1e-12):
        weak = cart.with_input_limit(part * limit)
        assert part * modelling.least_peak(weak, start) == pytest.approx(needed, rel=1e-9)


def test_parameters_that_would_move_the_target_are_known(pole: Path) -> None:
    """Claim: where a centre of mass is off the axis, learning it would move the equilibrium."""
    names = set(Belief.usual(named(str(pole))).tolerances)
    assert "pole_mass" in names
    assert not names & {"pole_com_x", "pole_com_z"}
    straight = POLE.replace("0.002 0 0.6", "0 0 0.6")
    pole.write_text(straight)
    assert "pole_com_z" in Belief.usual(named(str(pole))).tolerances


# -- joints that do not belong ---------------------------------------------------------------------

REACHER = """<body name="target"><joint name="target-x" type="slide" axis="1 0 0"/>
  <joint name="target-y" type="slide" axis="0 1 0"/><geom type="sphere" size="0.02"/></body>
</worldbody>"""


def test_joints_that_nothing_ties_to_the_motors_are_frozen_by_name(pole: Path) -> None:
    pole.write_text(POLE.replace("</worldbody>", REACHER))
    with pytest.raises(ModelError, match="freeze them, FILE:-target_x,-target_y"):
        named(str(pole))
    frozen = named(f"{pole}:-target-x,-target-y")
    assert "frozen target-x, target-y" in frozen.description
    pole.write_text(POLE)
    same(frozen, named(str(pole)))
    with pytest.raises(InvalidInputError, match="frozen joint"):
        named(f"{pole}:-elbow")


def test_what_falls_is_refused_before_equations_are_derived(pole: Path) -> None:
    pole.write_text(POLE.replace('type="slide" axis="1 0 0"', 'type="slide" axis="0 0 1"')
                    .replace('joint="slider"', 'joint="hinge"'))  # fmt: skip
    with pytest.raises(ModelError, match=r"'slider'.*a slide along which the mechanism falls"):
        named(str(pole))
    assert modelling.from_mjcf(pole).n == 2  # to look at, it may


# -- URDF ----------------------------------------------------------------------------------------

URDF = """
<!-- generated -->
<?xml version="1.0"?>
<robot name="cart">
  <link name="rail"/>
  <link name="box"><visual><geometry><mesh filename="package://none/box.dae"/></geometry></visual>
    <inertial><origin xyz="0, 0, 0 0" rpy="$(optenv TILT 0 0 0)"/><mass value="1"/>
    <inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
  <link name="pole"><inertial><origin xyz="0 0 0.5"/><mass value="0.1"/>
    <inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/></inertial></link>
  <link name="tip"><inertial><mass value="0"/>
    <inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
  <joint name="slide" type="prismatic"><parent link="rail"/><child link="box"/>
    <axis xyz="1 0 0"/><limit effort="30" lower="-2.0." upper="2" velocity="5"/></joint>
  <joint name="turn" type="continuous"><parent link="box"/><child link="pole"/>
    <axis xyz="0 1 0"/></joint>
  <joint name="end" type="fixed"><parent link="pole"/><child link="tip"/></joint>
</robot>
\0"""


def test_a_urdf_as_people_have_it(tmp_path: Path) -> None:
    """Claim: commas, surplus zeros, a late declaration, ROS' defaults, a stop too many, meshes that
    are nowhere and a zero at the end hinder nobody; the joint with an effort is the driven one;
    a link without mass that is fixed to another turns with no inertia."""
    path = tmp_path / "cart.urdf"
    path.write_text(URDF)
    rig = named(str(path))
    assert [c.name for c in rig.coordinates] == ["slide", "turn"]
    assert [i.name for i in rig.inputs] == ["slide_force"]
    assert (rig.coordinates[0].low, rig.input_limits.tolist()) == (-2.0, [30.0])
    assert rig.M([0.0, 0.0])[1, 1] == pytest.approx(0.01 + 0.1 * 0.25)
    if mujoco_compiler.engine():
        assert float(agreement(rig)) < AGREEMENT
    path.write_text(URDF.replace('effort="30"', 'effort="0"'))
    with pytest.raises(ModelError, match="names no actuator"):
        named(str(path))
    assert named(f"{path}:slide@hanging").n == 2
    frozen = modelling.from_urdf(URDF.replace("</robot>", LIMB), frozen=["wrist"])
    same(frozen, modelling.from_urdf(URDF))
    assert frozen.n == 2


def test_a_urdf_of_ros_2_and_one_that_xacro_is_yet_to_make() -> None:
    """Claim: joints with a command interface are driven; macros that are left are refused, the
    name of their space alone is not; a mimic joint may be frozen; products of inertia that are left
    out are zero, in the comparison too."""
    bare = URDF.replace('effort="30"', 'effort="0"').replace(' ixy="0" ixz="0"', "")
    driven = """<ros2_control name="r" type="system"><joint name="slide">
      <command_interface name="effort"/><state_interface name="position"/></joint>
      <joint name="turn"><state_interface name="position"/></joint></ros2_control></robot>"""
    read = modelling.from_urdf(bare.replace("</robot>", driven))
    assert [c.name for c in read.coordinates] == ["slide", "turn"]
    assert [i.name for i in read.inputs] == ["slide_force"]
    if mujoco_compiler.engine():
        assert float(agreement(read)) < AGREEMENT
    space = URDF.replace("<robot", '<robot xmlns:xacro="http://www.ros.org/wiki/xacro"')
    same(modelling.from_urdf(space), modelling.from_urdf(URDF))
    for left in (space.replace("</robot>", '<xacro:arm n="2"/></robot>'),
                 URDF.replace('<mass value="0.1"/>', '<mass value="${m}"/>')):  # fmt: skip
        with pytest.raises(InvalidInputError, match=r"xacro FILE\.xacro > FILE\.urdf"):
            modelling.from_urdf(left)
    mimic = LIMB.replace("</joint>", '<mimic joint="turn"/></joint>')
    with pytest.raises(ModelError, match=r"mimic.*frozen=\['wrist'\]"):
        modelling.from_urdf(URDF.replace("</robot>", mimic))
    still = modelling.from_urdf(URDF.replace("</robot>", mimic), frozen=["wrist"])
    same(still, modelling.from_urdf(URDF))


LIMB = """<link name="stick"/><joint name="wrist" type="continuous"><parent link="rail"/>
  <child link="stick"/><axis xyz="0 1 0"/></joint></robot>"""


# -- names and commands ----------------------------------------------------------------------------


def test_names_of_mechanisms_in_files(tmp_path: Path) -> None:
    name = DataName.of("a b/robot.urdf:one,-two@one=90deg,two=0.5m")
    assert name is not None
    assert (name.file, name.actuated, name.frozen) == (Path("a b/robot.urdf"), ("one",), ("two",))
    assert name.equilibrium == {"one": pytest.approx(math.pi / 2), "two": 0.5}
    assert DataName.of("rotary_pendulum") is None
    assert DataName.of("file.py:name") is None
    assert from_anywhere("robot.urdf:one@upright").endswith("/robot.urdf:one@upright")
    assert from_anywhere("robot.urdf:one@upright").startswith("/")


def test_words_of_the_option_target(pole: Path) -> None:
    """Claim: words about equilibria go into the name; where the cart may rest anywhere, a place is
    a set-point, and elsewhere it is an equilibrium."""
    assert aimed(str(pole), ["upright"]) == (f"{pole}@upright", [])
    assert aimed(str(pole), ["hanging", "slider=0.2m"]) == (f"{pole}@hanging", ["slider=0.2m"])
    assert aimed(str(pole), ["slider=0.2m"]) == (str(pole), ["slider=0.2m"])
    assert aimed(str(pole), ["hinge=180deg"]) == (f"{pole}@hinge=180deg", [])
    assert aimed("tora", ["x=1m"]) == ("tora", ["x=1m"])
    assert aimed("tora", None) == ("tora", [])
    for name, words in (("tora", ["upright"]), (f"{pole}@hanging", ["upright"])):
        with pytest.raises(InvalidInputError, match="target"):
            aimed(name, words)


def test_a_folder_of_files(pole: Path, tmp_path: Path) -> None:
    """Claim: one command says of every file what was read, or what it was refused for."""
    (tmp_path / "note.xml").write_text("<note/>")
    (tmp_path / "free.xml").write_text(
        '<mujoco><worldbody><body><freejoint/><geom size="1"/></body></worldbody></mujoco>'
    )
    (tmp_path / "broken.urdf").write_text("<robot>")
    (tmp_path / "two.urdf").write_text(URDF.replace('effort="30"', 'effort="0"'))
    rows = {row.name: row for row in model_files(tmp_path, simulate=False).run()}
    assert set(rows) == {"broken.urdf", "common/look.xml", "free.xml", "note.xml", "pole.xml",
                         "two.urdf:slide"}  # fmt: skip
    refused = {name: row.refused for name, row in rows.items()}
    assert refused == {
        "broken.urdf": "the text",
        "common/look.xml": "mechanics",
        "free.xml": "mechanics",
        "note.xml": "no model",
        "pole.xml": "",
        "two.urdf:slide": "",
    }
    assert (rows["pole.xml"].n, rows["pole.xml"].m, rows["pole.xml"].balanced) == (2, 1, None)
    assert summary(tuple(rows.values())).startswith("6 files: 2 read; refused 2 for mechanics")
    assert sum(count for *_, count in refused_groups(tuple(rows.values()))) == 4
    assert b"| two.urdf:slide | 2 | 1 |" in files_of(tuple(rows.values()))["models.md"]
    code, out, _ = run("models", str(tmp_path), "--no-simulate")
    assert code == 0
    assert "6 files: 2 read" in out
    for place, said in (("nowhere", "no such folder"), ("pole.xml", "a file"), ("none", "0 files")):
        (tmp_path / "none").mkdir(exist_ok=True)
        with pytest.raises(ArtefactError, match=f"got {said}, must be"):
            model_files(tmp_path / place)


@pytest.mark.slow  # kernels of its own
def test_a_file_is_simulated_without_another_word(pole: Path) -> None:
    """Claim: from 5 degrees off the nearest equilibrium to it, within the travel of the cart."""
    code, out, _ = run("simulate", str(pole), "--control", "one-time", "--objective", "effort")
    assert code == 0, out
    assert "start          hinge = 5°" in out
    assert "reached the target" in out
    assert "95 % of the travel" in out.replace("\n", " ")


@pytest.mark.parametrize("name", ["robot.sdf", "robot.sdf:hip@upright", "a.b/robot.txt"])
def test_a_file_of_another_format_is_refused_with_the_list(name: str) -> None:
    file = Path(name.partition(":")[0])
    refusal = f"format of '{file.name}': got '{file.suffix}', must be one of .urdf, .xml, .mjcf"
    with pytest.raises(InvalidInputError, match=re.escape(refusal)):
        named(name)


def test_two_equilibria_are_refused_with_both() -> None:
    with pytest.raises(InvalidInputError, match="hanging and upright, must be one equilibrium"):
        aimed("robot.urdf", ["hanging", "upright"])


def test_an_equilibrium_is_named_without_whole_turns() -> None:
    """From 90° Newton's step goes 13 half turns away, and 2340° was the target's name."""
    link = """<link name="l{0}"><inertial><origin xyz="0 0 0.25"/><mass value="{1}"/>
        <inertia ixx="0.02" iyy="0.02" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
    joint = """<joint name="j{0}" type="continuous"><parent link="{1}"/><child link="l{0}"/>
        <axis xyz="0 1 0"/><origin xyz="0 0 {2}"/></joint>"""
    parts = link.format(1, 1.0), link.format(2, 0.5), joint.format(1, "base", 0.0)
    text = (
        f"<robot name='arm'><link name='base'/>{''.join(parts)}{joint.format(2, 'l1', 0.5)}</robot>"
    )
    arm = modelling.from_urdf(text, actuated=["j1"])
    guess = {"j1": 0.0, "j2": math.pi / 2}
    assert abs(modelling.find_equilibrium(arm, **guess)["j2"]) > 2 * math.pi
    at, _ = equilibrium.where(arm, guess)
    assert abs(at["j2"] - math.pi / 2) <= math.pi
    assert np.abs(arm.f(np.array([*at.values(), 0, 0]))[arm.m :]).max() < 1e-9


def test_an_input_without_a_unit_has_a_cost_without_one() -> None:
    """An MJCF motor's input is a number; ∫ u² dt was in "² s"."""
    cart = ut.mechanisms.cart_pendulum()
    bare = replace(cart, inputs=(replace(cart.inputs[0], unit=""),))
    assert ut.MinimumEnergy().on(bare).unit == "s"


def test_the_end_of_a_name_counts_in_capitals_too(tmp_path: Path) -> None:
    missing = tmp_path / "ROBOT.URDF"
    assert format_of(missing).name == "URDF"
    with pytest.raises(ArtefactError, match=r"ROBOT\.URDF.*no such file"):
        named(f"{missing}:hip@upright")
