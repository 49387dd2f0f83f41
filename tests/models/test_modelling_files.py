"""URDF and MJCF: the trees that files describe move as MuJoCo says; the rest is refused."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import undertow as ut
from support import rest_slow
from undertow.base import ArtefactError, InvalidInputError, ModelError, UndertowError
from undertow.checks import check_mechanism
from undertow.mechanisms import LIBRARY
from undertow.mechanisms.named import named
from undertow.models import FloatArray
from undertow.models import importers as modelling
from undertow.models.importers.python_file import in_a_file
from undertow.plants.interface import rig_from_file
from undertow.plants.scenes import mujoco_scene

TIGHT = 1e-10

CART_URDF = """
<robot name="cart_pendulum">
  <link name="rail"/>
  <link name="cart">
    <inertial><mass value="0.5"/><inertia ixx="1" iyy="1" izz="1"/></inertial>
  </link>
  <link name="rod">
    <inertial>
      <origin xyz="0 0 0.3"/><mass value="0.2"/><inertia ixx="1" iyy="0.006" izz="1"/>
    </inertial>
  </link>
  <joint name="x" type="prismatic">
    <parent link="rail"/><child link="cart"/><axis xyz="1 0 0"/>
    <dynamics damping="0.1"/><limit effort="20" lower="-1.5" upper="1.5" velocity="9"/>
  </joint>
  <joint name="phi" type="continuous">
    <parent link="cart"/><child link="rod"/><axis xyz="0 1 0"/><dynamics damping="0.001"/>
  </joint>
  <transmission name="drive"><joint name="x"/><actuator name="motor"/></transmission>
</robot>
"""

CART_MJCF = """
<mujoco model="cart_pendulum">
  <option gravity="0 0 -9.8"/>
  <worldbody>
    <body name="cart">
      <joint name="x" type="slide" axis="1 0 0" damping="0.1" range="-1.5 1.5"/>
      <inertial mass="0.5" pos="0 0 0" diaginertia="1 1 1"/>
      <body name="rod">
        <joint name="phi" axis="0 1 0" damping="0.001"/>
        <inertial mass="0.2" pos="0 0 0.3" diaginertia="1 0.006 1"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="force" joint="x" ctrlrange="-20 20"/></actuator>
</mujoco>
"""


def states(n: int, count: int = 40) -> FloatArray:
    return np.random.default_rng(0).uniform(-2, 2, (count, 2 * n))


def test_urdf_mjcf_and_energies_agree() -> None:
    """Claim: the URDF and the MJCF of the cart pendulum give the M, f, B, ranges and limits of
    its energies, to 1e-10."""
    rig = ut.mechanisms.cart_pendulum()
    x = states(2)
    for read in (
        modelling.from_urdf(CART_URDF, gravity=(0, 0, -9.8)),
        modelling.from_mjcf(CART_MJCF),
    ):
        assert np.abs(read.M(x[:, :2]) - rig.M(x[:, :2])).max() < TIGHT
        assert np.abs(read.f(x) - rig.f(x)).max() < TIGHT
        assert read.input_matrix == rig.input_matrix
        assert read.input_limits.tolist() == [20.0]
        assert (read.coordinates[0].low, read.coordinates[0].high) == (-1.5, 1.5)
        assert read.coordinates[1].high == math.inf
        assert check_mechanism(read, compiled=False).passed
        heavier = read.with_parameters(rod_mass=0.3)
        same = rig.with_parameters(m_p=0.3)
        assert np.abs(heavier.f(x) - same.f(x)).max() < TIGHT


@pytest.mark.parametrize("name", rest_slow(sorted(LIBRARY), "rotary_pendulum", "gantry_crane"))
def test_mjcf_of_the_library_gives_its_equations(name: str) -> None:
    """Claim: every MuJoCo scene, read back, has the M, f and B of the energies to 1e-10."""
    rig = LIBRARY[name]()
    scene = mujoco_scene(rig)
    read = modelling.from_mjcf(scene.xml)
    joints = [joint.name for joint in modelling.read_mjcf(scene.xml).moving]
    own = {c.name: row for c, row in zip(rig.coordinates, np.eye(rig.n), strict=True)}
    of_joints = dict(zip(joints, scene.joints, strict=True))
    P = np.array([of_joints.get(c.name, own.get(c.name)) for c in read.coordinates])
    n, x = rig.n, states(rig.n)
    moved = np.hstack([x[:, :n] @ P.T, x[:, n:] @ P.T])
    M, f = rig.M(x[:, :n]), rig.f(x)
    assert np.abs(M - P.T @ read.M(moved[:, :n]) @ P).max() <= TIGHT * np.abs(M).max()
    assert np.abs(f - read.f(moved) @ P).max() <= TIGHT * np.abs(f).max()
    u = np.ones((len(x), rig.m))
    theirs = read.accelerations(0, moved, u) @ np.linalg.inv(P).T
    np.testing.assert_allclose(rig.accelerations(0, x, u), theirs, rtol=1e-6, atol=1e-8)
    assert read.input_limits.tolist() == rig.input_limits.tolist()


# -- against MuJoCo's own reading -------------------------------------------------------------

BRANCHED_URDF = """
<robot name="branched">
  <link name="base"/>
  <link name="turret"><inertial><origin xyz="0.02 -0.01 0.1" rpy="0.3 -0.2 0.5"/>
    <mass value="1.3"/>
    <inertia ixx="0.02" iyy="0.03" izz="0.025" ixy="0.002" ixz="-0.001" iyz="0.003"/>
  </inertial></link>
  <link name="bracket"><inertial><origin xyz="0 0.05 0"/><mass value="0.2"/>
    <inertia ixx="0.001" ixy="0" ixz="0" iyy="0.001" iyz="0" izz="0.001"/></inertial></link>
  <link name="arm"><inertial><origin xyz="0.1 0 0.2"/><mass value="0.7"/>
    <inertia ixx="0.01" ixy="0" ixz="0.001" iyy="0.012" iyz="0" izz="0.004"/></inertial></link>
  <link name="slider"><inertial><mass value="0.4"/>
    <inertia ixx="0.002" ixy="0" ixz="0" iyy="0.002" iyz="0" izz="0.003"/></inertial></link>
  <joint name="turn" type="revolute"><origin xyz="0 0 0.3" rpy="0.1 0 0.2"/>
    <parent link="base"/><child link="turret"/><axis xyz="0 0 1"/>
    <dynamics damping="0.2"/><limit effort="5" lower="-2" upper="2" velocity="1"/></joint>
  <joint name="weld" type="fixed"><origin xyz="0.1 0 0.2" rpy="0 1.2 0"/>
    <parent link="turret"/><child link="bracket"/></joint>
  <joint name="lift" type="continuous"><origin xyz="0 0.1 0" rpy="0.4 0.3 -0.2"/>
    <parent link="bracket"/><child link="arm"/><axis xyz="0.6 0 0.8"/></joint>
  <joint name="slide" type="prismatic"><origin xyz="-0.1 0.2 0.1" rpy="-0.5 0.1 0.9"/>
    <parent link="turret"/><child link="slider"/><axis xyz="1 2 -1"/>
    <dynamics damping="0.7"/><limit effort="3" lower="-1" upper="1" velocity="1"/></joint>
</robot>
"""

BRANCHED_MJCF = """
<mujoco model="branched">
  <compiler angle="degree" eulerseq="XYz"/>
  <option gravity="0.5 -1 -9.7"><flag contact="disable" limit="disable"/></option>
  <default>
    <joint damping="0.05"/>
    <default class="heavy">
      <geom density="3000"/>
      <joint armature="0.02" damping="0.3"/>
      <default class="heavier"><geom density="5000"/></default>
    </default>
  </default>
  <worldbody>
    <geom type="plane" size="1 1 .1"/>
    <body name="mast" pos="0.1 0 1" euler="20 -35 15" childclass="heavy">
      <joint name="swing" type="hinge" axis="0.3 1 0.2" pos="0.05 0.02 -0.1" ref="15"
             stiffness="3" springref="40" range="-90 90"/>
      <joint name="pull" type="slide" axis="1 0 1" stiffness="20" springref="0.1" ref="0.2"/>
      <geom type="capsule" size="0.04" fromto="0 0 0 0.3 0.1 0.5"/>
      <geom type="box" size="0.1 0.05 0.02" pos="0.1 0.1 0" quat="0.9 0.1 -0.3 0.2" mass="0.6"/>
      <body pos="0.3 0.1 0.5" axisangle="1 1 0 50">
        <geom type="sphere" size="0.07" pos="0 0 0.1" class="heavier"/>
        <body name="rod" xyaxes="1 0.2 0 0 1 0.5">
          <joint name="nod" axis="0 1 0" frictionloss="0" class="main"/>
          <joint name="roll" axis="0 0 1" pos="0 0.1 0"/>
          <geom type="cylinder" size="0.03 0.2" pos="0 0.1 0.2" zaxis="0.2 0.1 1"/>
          <geom type="ellipsoid" size="0.05 0.08 0.1" pos="0.1 0 0" mass="0.3"/>
        </body>
      </body>
      <body name="box" pos="0 -0.2 0">
        <inertial mass="0.8" pos="0 0.1 0" euler="10 20 30" diaginertia="0.01 0.02 0.015"/>
      </body>
    </body>
  </worldbody>
  <tendon>
    <fixed name="both" damping="0.4" stiffness="2" armature="0.01" springlength="0.3">
      <joint joint="nod" coef="1.5"/><joint joint="roll" coef="-0.7"/>
    </fixed>
  </tendon>
  <actuator>
    <motor name="m_1" joint="pull" gear="3" ctrlrange="-4 4"/>
    <motor name="m_2" tendon="both" gear="2" ctrlrange="-1 2"/>
  </actuator>
</mujoco>
"""


def compare_with_mujoco(
    tree: modelling.Tree, read: ut.Mechanism, text: str, actuated: bool
) -> None:
    """The mechanism and MuJoCo's own reading of the file accelerate alike, to 1e-8."""
    mujoco: Any = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_string(text)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_LIMIT
    data = mujoco.MjData(model)
    kinds = mujoco.mjtObj.mjOBJ_JOINT
    order = [mujoco.mj_id2name(model, kinds, j) for j in range(model.njnt)]
    assert sorted(order) == sorted(joint.name for joint in tree.moving)
    couplings = {c.name: c.coefficients for c in tree.couplings}
    # Rows: the coordinates as combinations of MuJoCo's joints.
    J = np.zeros((len(order), len(order)))
    for row, c in enumerate(read.coordinates):
        for joint, coefficient in couplings.get(c.name, {c.name: 1.0}).items():
            J[row, order.index(joint)] = coefficient
    rng = np.random.default_rng(1)
    for _ in range(25):
        q, qd = rng.uniform(-2, 2, len(order)), rng.uniform(-2, 2, len(order))
        u = rng.uniform(-1, 1, read.m) if actuated else np.zeros(read.m)
        data.qpos[:], data.qvel[:] = q, qd
        if actuated:
            data.ctrl[:] = u
        mujoco.mj_forward(model, data)
        ours = read.accelerations(0.0, np.concatenate([J @ q, J @ qd]), u)
        theirs = J @ data.qacc
        assert np.linalg.norm(ours - theirs) < 1e-8 * np.linalg.norm(theirs)


@pytest.mark.slow
def test_a_branched_urdf_moves_as_mujoco_says() -> None:
    """Claim: rotated inertias, fixed links with mass, branches, tilted axes and normalisation
    are read as MuJoCo reads them."""
    tree, transmitted = modelling.read_urdf(BRANCHED_URDF, (0.0, 0.0, -9.81))
    assert transmitted == ()
    read = modelling.from_urdf(BRANCHED_URDF, actuated=["slide", "turn"])
    assert [c.name for c in read.coordinates] == ["slide", "turn", "lift"]
    assert read.input_limits.tolist() == [3.0, 5.0]
    assert [i.unit for i in read.inputs] == ["N", "N m"]
    compare_with_mujoco(tree, read, BRANCHED_URDF, actuated=False)
    # Away from an equilibrium the class conditions fail; the identities must not.
    report = check_mechanism(read, compiled=False)
    assert all("target" in check.name for check in report.failures)


@pytest.mark.slow
def test_a_branched_mjcf_moves_as_mujoco_says() -> None:
    """Claim: geom inertias, defaults, classes, offsets, references, springs, several joints a
    body, unnamed bodies, tendons and gears are read as MuJoCo reads them."""
    tree = modelling.read_mjcf(BRANCHED_MJCF)
    read = modelling.from_mjcf(BRANCHED_MJCF)
    assert [c.name for c in read.coordinates][:2] == ["pull", "both"]
    assert read.input_limits.tolist() == [4.0, 1.0]
    compare_with_mujoco(tree, read, BRANCHED_MJCF, actuated=True)
    swing = next(c for c in read.coordinates if c.name == "swing")
    assert swing.high == pytest.approx(math.pi / 2)


def test_actuated_joints_in_place_of_the_files_motors() -> None:
    """Claim: naming the actuated joints overrides the file's actuators, in the order given, and
    limits can be set."""
    scene = mujoco_scene(ut.mechanisms.two_motor_three_link()).xml
    read = modelling.from_mjcf(scene, actuated=["q_3", "q_1"], effort={"q_3": 2.5})
    assert [c.name for c in read.coordinates] == ["q_3", "q_1", "q_2"]
    assert read.input_limits.tolist() == [2.5, math.inf]


def test_the_furuta_pendulum_from_urdf() -> None:
    """Claim: a spatial mechanism in URDF, its target upright at π, gives the paper's M and f."""
    rig = ut.mechanisms.rotary_pendulum()
    p = {p.name: p.value for p in rig.parameters}
    moment = p["m"] * p["l"] ** 2 / 3
    text = f"""
    <robot name="furuta"><link name="base"/>
      <link name="arm"><inertial><mass value="1"/>
        <inertia ixx="1" iyy="1" izz="{p["I_e"]!r}"/></inertial></link>
      <link name="rod"><inertial><origin xyz="0 0 {-p["l"]!r}"/><mass value="{p["m"]!r}"/>
        <inertia ixx="{moment!r}" iyy="{moment!r}" izz="0"/></inertial></link>
      <joint name="theta" type="continuous"><parent link="base"/><child link="arm"/>
        <axis xyz="0 0 1"/><dynamics damping="{p["d_e"]!r}"/></joint>
      <joint name="phi" type="continuous"><origin xyz="{p["r_o"]!r} 0 0"/>
        <parent link="arm"/><child link="rod"/><axis xyz="1 0 0"/></joint>
    </robot>"""
    read = modelling.from_urdf(text, actuated=["theta"], equilibrium={"phi": math.pi})
    x = states(2)
    assert np.abs(read.M(x[:, :2]) - rig.M(x[:, :2])).max() < TIGHT
    assert np.abs(read.f(x) - rig.f(x)).max() < TIGHT
    assert check_mechanism(read, compiled=False).passed


def test_a_joint_that_its_motor_cannot_move_is_refused() -> None:
    """With more dry friction than the motor has force, a simulation without it had balanced."""
    for friction, refused in ((19.9, False), (20.1, True)):
        text = changed(CART_MJCF, 'damping="0.1"', f'damping="0.1" frictionloss="{friction}"')
        if not refused:
            assert modelling.from_mjcf(text).disturbance_bounds == (friction, 0.0)
            continue
        with pytest.raises(ModelError, match=r"dry friction of joint 'x': got 20.1 N, .* 20 N"):
            modelling.from_mjcf(text)


def test_dry_friction_becomes_a_disturbance_bound() -> None:
    """Claim: friction is no smooth force; it bounds the disturbance of (1) and so the gains."""
    text = CART_URDF.replace('damping="0.001"', 'damping="0.001" friction="0.02"')
    assert modelling.from_urdf(text).disturbance_bounds == (0.0, 0.02)
    text = CART_MJCF.replace('damping="0.1"', 'damping="0.1" frictionloss="0.5"')
    assert modelling.from_mjcf(text).disturbance_bounds == (0.5, 0.0)


def test_motors_named_after_their_joints() -> None:
    """Claim: a motor may bear its joint's name, as files often have it."""
    text = changed(CART_MJCF, 'name="force"', 'name="x"')
    assert [i.name for i in modelling.from_mjcf(text).inputs] == ["x_motor"]


def test_two_motors_on_one_joint_are_named() -> None:
    """They count as one input; of two joints it was said that they were fully actuated."""
    pytest.importorskip("mujoco")
    two = changed(CART_MJCF, "<actuator>", '<actuator><motor name="aux" joint="x" gear="3"/>')
    with pytest.raises(ModelError, match=r"joint 'x' .*two motors, aux and .*FILE:x"):
        modelling.from_mjcf(two)
    assert modelling.from_mjcf(two, actuated=["x"]).m == 1


def test_a_servo_whose_force_is_limited_is_said_to_be() -> None:
    """MuJoCo clips it with its own spring and damper in it, a mechanism its input alone."""
    mujoco = pytest.importorskip("mujoco")
    motor = '<motor name="force" joint="x" ctrlrange="-20 20"/>'
    servo = '<velocity name="servo" joint="x" kv="5" ctrlrange="-1 1"/>'
    text = changed(CART_MJCF, motor, servo)
    clipped = changed(text, 'kv="5"', 'kv="5" forcerange="-2 2"')
    free, limited = modelling.from_mjcf(text), modelling.from_mjcf(clipped)
    said = "the force limit of servo on its own spring and damper"
    assert said in limited.description
    assert said not in free.description
    model = mujoco.MjModel.from_xml_string(clipped)
    data = mujoco.MjData(model)
    data.qvel[0] = 1.0
    mujoco.mj_forward(model, data)
    assert data.actuator_force[0] == -2.0  # -5 by its damper: what is said to be left out


def test_a_range_that_is_not_symmetric_is_said_to_be_cut() -> None:
    """The limit of an input is one magnitude: the smaller side, and the rest is named."""
    pytest.importorskip("mujoco")
    motor = '<motor name="force" joint="x" ctrlrange="-20 20"/>'
    text = changed(CART_MJCF, motor, motor.replace("-20 20", "-20 12"))
    assert "beyond" not in modelling.from_mjcf(CART_MJCF).description
    cut = modelling.from_mjcf(text)
    assert cut.inputs[0].limit == 12.0
    assert "ctrlrange -20 to 12 of force beyond ±12" in cut.description


def test_the_force_limit_of_a_tendon_limits_its_motor() -> None:
    """Its input was without limit, or the file refused for a motion that was not MuJoCo's."""
    mujoco = pytest.importorskip("mujoco")
    tendon = (
        '<tendon><fixed name="rope" actuatorfrcrange="-6 9"><joint joint="x" coef="2"/></fixed>'
        "</tendon><actuator>"
    )
    text = changed(CART_MJCF, "<actuator>", tendon)
    for ctrl, limit in (("", 2.0), ('ctrlrange="-20 20"', 2.0), ('ctrlrange="-1 1"', 1.0)):
        motor = f'<motor name="force" tendon="rope" gear="3" {ctrl}/>'
        given = changed(text, '<motor name="force" joint="x" ctrlrange="-20 20"/>', motor)
        assert modelling.from_mjcf(given).input_limits.tolist() == [limit]
        model = mujoco.MjModel.from_xml_string(given)
        data = mujoco.MjData(model)
        pushed = []
        for u in (limit, 0.99 * limit):
            data.ctrl[0] = -u
            mujoco.mj_forward(model, data)
            pushed.append(-float(data.qfrc_actuator[0]))
        assert pushed == pytest.approx([6 * limit, 5.94 * limit])


def test_names_that_differ_in_punctuation_only_are_refused() -> None:
    """Claim: two links that would share a parameter are refused, not merged."""
    text = changed(CART_URDF, '"rod"', '"cart."')
    assert modelling.from_urdf(text).n == 2
    both = changed(text.replace('"cart"', '"cart-"'), '"rail"', '"rail"')
    with pytest.raises(ModelError, match="punctuation"):
        modelling.from_urdf(both)


def test_the_outermost_default_class_is_the_main_one() -> None:
    """Claim: defaults apply whatever the outermost class is called."""
    text = changed(
        CART_MJCF, "<worldbody>", '<default class="own"><joint armature="2"/></default><worldbody>'
    )
    rig, read = modelling.from_mjcf(CART_MJCF), modelling.from_mjcf(text)
    assert np.allclose(read.M(np.zeros(2)) - rig.M(np.zeros(2)), 2 * np.eye(2))


def test_a_target_that_is_no_equilibrium_is_refused() -> None:
    """Claim: a pose that gravity moves is no target."""
    with pytest.raises(ModelError, match="on 'phi', which no input balances"):
        modelling.from_urdf(CART_URDF, equilibrium={"phi": 1.0})


def test_files_are_read_from_disk(tmp_path: Path) -> None:
    """Claim: a path works as the text does; one that is not there is named."""
    path = tmp_path / "cart.urdf"
    path.write_text(CART_URDF, encoding="utf-8")
    assert modelling.from_urdf(path).source == str(path)
    with pytest.raises(ArtefactError, match=r"nowhere\.xml"):
        modelling.from_mjcf(tmp_path / "nowhere.xml")


# -- refusals ---------------------------------------------------------------------------------


def changed(text: str, old: str, new: str) -> str:
    assert old in text
    return text.replace(old, new)


def link(name: str) -> str:
    inertia = '<inertia ixx="1" iyy="1" izz="1"/>'
    return f'<link name="{name}"><inertial><mass value="1"/>{inertia}</inertial></link>'


def joint(name: str, parent: str, child: str, kind: str = "continuous") -> str:
    ends = f'<parent link="{parent}"/><child link="{child}"/>'
    return f'<joint name="{name}" type="{kind}">{ends}<axis xyz="0 1 0"/></joint>'


def robot(*parts: str) -> str:
    return f'<robot name="bad">{"".join(parts)}</robot>'


def test_a_urdf_with_a_loop_is_refused() -> None:
    """Claim: both kinds of loop, a link with two parents and a ring without a root, are refused
    by name with the remedy."""
    parts = [link("base"), link("a"), link("b")]
    joints = [joint("j_1", "base", "a"), joint("j_2", "base", "b"), joint("j_3", "a", "b")]
    with pytest.raises(ModelError, match="link 'b' of 'bad' closes a loop") as caught:
        modelling.from_urdf(robot(*parts, *joints), actuated=["j_1"])
    assert "j_2" in str(caught.value)
    assert "Cut the loop" in str(caught.value)
    ring = [joint("j_1", "base", "a"), joint("j_2", "a", "b"), joint("j_3", "b", "base")]
    with pytest.raises(ModelError, match="tree rooted in the fixed frame"):
        modelling.from_urdf(robot(*parts, *ring), actuated=["j_1"])


@pytest.mark.parametrize(
    ("text", "error", "match"),
    [
        ("<robot><link name='a'></robot>", InvalidInputError, "line 1, column"),
        ("<robot name=bad/>", InvalidInputError, "well-formed"),
        ("<sdf/>", ModelError, "root <sdf>"),
        ("<!DOCTYPE r [<!ENTITY a 'b'>]><robot/>", InvalidInputError, "entity"),
        ("<robot name='empty'/>", ModelError, "no link"),
    ],
)
def test_broken_xml_is_refused(text: str, error: type[Exception], match: str) -> None:
    """Claim: what is no URDF is refused, broken XML with line and column."""
    with pytest.raises(error, match=match):
        modelling.from_urdf(text)


def test_what_mjcf_includes_is_no_model_by_itself() -> None:
    """MuJoCo says the same; with other words it was a fault in the text."""
    with pytest.raises(ModelError, match="root <mujocoinclude>, must be <mujoco>"):
        modelling.from_mjcf("<mujocoinclude/>")


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("<mujoco><worldbody></mujoco>", "well-formed"),
        ("<robot/>", "root <robot>"),
        ("<!DOCTYPE m [<!ENTITY a 'b'>]><mujoco/>", "entity"),
        ("<mujoco><worldbody><body><joint size='no'/></body></worldbody></mujoco>", "compiler"),
        ("<mujoco><include file='inner.xml'/></mujoco>", "well-formed"),
    ],
)
def test_a_refusal_names_the_file_that_is_broken(tmp_path: Path, text: str, match: str) -> None:
    """Claim: of an included file it is that one, at whatever stage it is refused."""
    pytest.importorskip("mujoco")
    (tmp_path / "inner.xml").write_text("<mujoco><worldbody></mujoco>", encoding="utf-8")
    (tmp_path / "outer.xml").write_text(text, encoding="utf-8")
    with pytest.raises(UndertowError, match=match) as caught:
        modelling.from_mjcf(tmp_path / "outer.xml")
    broken = "inner.xml" if "include" in text else "outer.xml"
    assert f"model file '{tmp_path / broken}'" in str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ('name="phi"', 'name="x"', "named twice.*x"),
        ('<link name="rod">', '<link name="cart">', "named twice.*cart"),
        ('<parent link="cart"/>', '<parent link="wagon"/>', "'wagon'"),
        ('type="continuous"', 'type="floating"', r"Remark 3\).*frozen=.*FILE:-NAME"),
        ('type="continuous"', 'type="spherical"', "one of revolute"),
        ('<axis xyz="0 1 0"/>', '<axis xyz="0 0 0"/>', "axis of joint 'phi'"),
        ('<axis xyz="0 1 0"/>', '<axis xyz="0 1"/>', "3 numbers"),
        ('value="0.2"', 'value="heavy"', "numbers"),
        ('value="0.2"', 'value="nan"', "finite"),
        ('value="0.2"', 'value="-0.2"', "mass ≥ 0"),
        ('<mass value="0.2"/>', "", "no <mass>"),
        ('<mass value="0.2"/>', "<mass/>", "value of <mass> of 'rod'.*missing"),
        ('<axis xyz="0 1 0"/>', '<mimic joint="x"/>', "mimic"),
        ('<joint name="phi"', "<joint", "no name"),
    ],
)
def test_urdfs_that_mean_nothing_are_refused(old: str, new: str, match: str) -> None:
    """Claim: each slip in a URDF is refused by its name."""
    with pytest.raises((ModelError, InvalidInputError), match=match):
        modelling.from_urdf(changed(CART_URDF, old, new))


def test_a_transmission_to_a_joint_that_is_not_there_is_no_slip_of_who_reads() -> None:
    """Of part of a robot: the file is refused for it, unless the driven joints are named."""
    text = changed(CART_URDF, '<joint name="x"/>', '<joint name="shoulder"/>')
    with pytest.raises(ModelError, match=r"transmission.*'shoulder'.*one of phi, x") as refusal:
        modelling.from_urdf(text)
    assert "FILE.urdf:JOINT" in refusal.value.remedy
    assert modelling.from_urdf(text, actuated=["x"]).m == 1


def test_a_massless_link_of_a_file_is_refused() -> None:
    """Claim: a moving link without mass is refused with link and joint, in both formats."""
    start, end = (
        CART_URDF.index("<inertial>\n"),
        CART_URDF.index("</inertial>\n  </link>\n  <joint"),
    )
    text = CART_URDF[:start] + CART_URDF[end + len("</inertial>") :]
    with pytest.raises(ModelError, match=r"link 'rod'.*moved by joint 'phi'.*massless"):
        modelling.from_urdf(text)
    bare = '<inertial mass="0.2" pos="0 0 0.3" diaginertia="1 0.006 1"/>'
    with pytest.raises(ModelError, match=r"link 'rod'.*massless"):
        modelling.from_mjcf(changed(CART_MJCF, bare, ""))


def test_actuated_joints_that_do_not_exist_are_refused() -> None:
    """Claim: unknown, fixed and doubled names are refused; so is a file that names none."""
    with pytest.raises(InvalidInputError, match=r"'psi'.*one of x, phi"):
        modelling.from_urdf(CART_URDF, actuated=["psi"])
    with pytest.raises(InvalidInputError, match="named twice"):
        modelling.from_urdf(CART_URDF, actuated=["x", "x"])
    with pytest.raises(InvalidInputError, match="'weld'"):
        modelling.from_urdf(BRANCHED_URDF, actuated=["weld"])
    with pytest.raises(ModelError, match="names no actuator"):
        modelling.from_urdf(BRANCHED_URDF.replace("effort", "hardly"))
    with pytest.raises(ModelError, match="not underactuated"):
        modelling.from_urdf(CART_URDF, actuated=["x", "phi"])
    with pytest.raises(InvalidInputError, match="effort"):
        modelling.from_urdf(CART_URDF, actuated=["x"], effort={"phi": 1.0})
    with pytest.raises(InvalidInputError, match=r"effort .*got x.*with_input_limit"):
        modelling.from_mjcf(CART_MJCF, effort={"x": 1.0})
    with pytest.raises(InvalidInputError, match="equilibrium"):
        modelling.from_urdf(CART_URDF, equilibrium={"psi": 1.0})


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ('<joint name="phi" axis="0 1 0" damping="0.001"/>', "<freejoint/>", "FILE:-NAME"),
        ('<joint name="phi" axis="0 1 0"', '<joint name="phi" type="ball"', "'ball'"),
        ("<actuator>", '<equality><weld body1="cart"/></equality><actuator>', "closed loop"),
        ("<motor ", "<cylinder ", "Use <motor>"),
        ("</worldbody>", '</worldbody><include file="a.xml"/>', "included"),
        ("<actuator>", "<tendon><spatial/></tendon><actuator>", "tendon ''"),
        ('gravity="0 0 -9.8"', 'gravity="0 0 -9.8" density="1.2"', "density"),
        ('<body name="rod">', '<body name="rod" gravcomp="1">', "gravcomp"),
        ('<body name="rod">', '<body name="rod"><plugin/>', "'plugin' nor 'instance'"),
        (
            '<body name="rod">',
            '<body name="rod" euler="0 0 0" quat="1 0 0 0">',
            "multiple orientation",
        ),
        ('axis="0 1 0"', 'axis="0 1 0" class="soft"', "default class name 'soft'"),
        ('joint="x" ctrl', 'joint="y" ctrl', "'y'"),
        ('joint="x" ctrl', 'site="tip" ctrl', "target 'tip' not found"),
        ("<worldbody>", '<option actuatorgroupdisable="0"/><worldbody>', "'force' .*switched off"),
        ('damping="0.001"', 'stiffness="3" springyield="1"', "'phi' that yields"),
    ],
)
def test_mjcf_that_is_not_understood_is_refused(old: str, new: str, match: str) -> None:
    """Claim: what would change the motion and is not read is refused, never passed over."""
    with pytest.raises((ModelError, InvalidInputError), match=match):
        modelling.from_mjcf(changed(CART_MJCF, old, new))


def test_meshes_without_inertia_are_refused() -> None:
    """Claim: a body whose inertia hangs on a mesh needs an <inertial>."""
    bare = '<inertial mass="0.2" pos="0 0 0.3" diaginertia="1 0.006 1"/>'
    text = changed(CART_MJCF, bare, '<geom type="mesh" mesh="rod"/>')
    with pytest.raises(ModelError, match="mesh"):
        modelling.from_mjcf(text)


# -- what cannot be a body, and what nobody could wait for ---------------------------------------

ROD = '<inertial mass="0.2" pos="0 0 0.3" diaginertia="1 0.006 1"/>'


@pytest.mark.parametrize(
    ("moments", "whole"),
    [((1, 0.006, 1.1), False), ((1, 1, 3), False), ((0, 0, 1), False), ((0, 1, 1), True),
     ((0.5, 0.5, 1.004), True), ((1, 1, 2), True), ((1e-9, 1e-9, 2.2e-9), False)],
)  # fmt: skip
def test_principal_moments_that_no_body_has_are_refused(
    moments: tuple[float, float, float], whole: bool
) -> None:
    """Claim: none exceeds the sum of the others, but for what files round; in both formats and
    any axes."""
    a, b, c = moments
    rotated = np.array([[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, 1]])
    tensor = rotated @ np.diag(moments) @ rotated.T
    tilted = " ".join(
        repr(float(tensor[i])) for i in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
    )
    inertia = f'<inertia ixx="{a}" iyy="{b}" izz="{c}"/>'
    texts = (
        (
            modelling.from_urdf,
            changed(CART_URDF, '<inertia ixx="1" iyy="0.006" izz="1"/>', inertia),
        ),
        (modelling.from_mjcf, changed(CART_MJCF, "1 0.006 1", f"{a} {b} {c}")),
        (
            modelling.from_mjcf,
            changed(CART_MJCF, 'diaginertia="1 0.006 1"', f'fullinertia="{tilted}"'),
        ),
    )
    for read, text in texts:
        if whole:
            assert read(text).n == 2
        else:
            with pytest.raises(ModelError, match=r"link 'rod'.*sum of the others"):
                read(text)


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ("1 0.006 1", "1 -0.006 1", "no negative moment"),
        (ROD, '<geom type="box" size="0.1"/>', "size 1 must be positive"),
        (ROD, '<geom type="capsule" size="0 0"/>', "size 0 must be positive"),
        (ROD, '<geom type="sphere" size="1e308"/>', "size of a sphere|up to 1e"),
        (ROD, '<geom type="sphere" size="0.1" density="-1000"/>', "density are negative"),
        (ROD, '<geom type="sphere" size="0.1" mass="-1"/>', "mass, .* are negative"),
        ('<body name="rod">', '<body name="rod" quat="1e308 1e308 0 0">', "quaternion"),
        ('<body name="rod">', '<body name="world">', "repeated name 'world'"),
        ('mass="0.2"', 'mass="1e300"', "up to 1e"),
        ('mass="0.2"', 'mass="1_0"', "bad format in attribute 'mass'"),
        ('mass="0.2"', 'mass="\u0663"', "bad format in attribute 'mass'"),
        ('joint="x" ctrl', 'joint="x" gear="0" ctrl', "gear"),
        ('axis="0 1 0" damp', 'axis="0 0 0" damp', "axis of joint 'phi'"),
        ('axis="0 1 0" damp', 'axis="nan 0 0" damp', "finite"),
        ('name="phi"', 'name="\uff58"', r"named twice.*x and .*U\+FF58"),
        ('name="rod"', 'name="\u03d5"', "parameter|named twice|identifier"),
    ],
)
def test_mjcf_that_cannot_be_is_refused(old: str, new: str, match: str) -> None:
    """Claim: numbers that no body has, and names that Python takes for one, are refused."""
    text = changed(CART_MJCF, old, new)
    if "\u03d5" in new:  # a second link of that name, in another spelling
        text = changed(text, 'name="cart"', 'name="\u03c6"')
    with pytest.raises(UndertowError, match=match) as refusal:
        modelling.from_mjcf(text)
    assert refusal.value.remedy


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ('effort="20"', 'effort="-20"', "effort of joint 'x'"),
        ('lower="-1.5" upper="1.5"', 'lower="1.5" upper="-1.5"', "limits of joint 'x'"),
        ('izz="1"/>\n    </inertial>', 'izz="1e308"/>\n    </inertial>', "up to 1e"),
        ('<axis xyz="0 1 0"/>', '<axis xyz="1e200 0 0"/>', "axis of 'phi'"),
        ('name="phi"', 'name="x "', "identifiers"),
        ('<parent link="cart"/>', '<parent link="cat"/>', "Did you mean cart"),
    ],
)
def test_urdf_that_cannot_be_is_refused(old: str, new: str, match: str) -> None:
    text = changed(CART_URDF, old, new)
    if new == 'name="x "':
        text = changed(text, 'name="x" type', 'name="x_" type').replace(
            'joint name="x"/>', 'joint name="x_"/>'
        )
    with pytest.raises(UndertowError, match=match) as refusal:
        modelling.from_urdf(text)
    assert refusal.value.remedy


def test_a_lone_name_in_another_spelling_works() -> None:
    """Claim: a joint µ of a file is the coordinate μ, by both spellings."""
    read = modelling.from_urdf(changed(CART_URDF, 'name="phi"', 'name="\u00b5"'))
    assert read.coordinates[1].name == "\u03bc"
    assert read.state(**{"\u00b5": 0.1})[1] == 0.1


def test_an_input_that_nothing_limits_is_said() -> None:
    """Claim: a file without a limit gives an infinite one, and the mechanism says so."""
    for read in (
        modelling.from_urdf(changed(CART_URDF, 'effort="20" ', "")),
        modelling.from_mjcf(changed(CART_MJCF, ' ctrlrange="-20 20"', "")),
    ):
        assert read.input_limits.tolist() == [math.inf]
        (name,) = (i.name for i in read.inputs)
        assert f"{name} without limit" in read.description
        check = check_mechanism(read, compiled=False)["inputs without a limit"]
        assert name in check.name
        assert check.passed
    with pytest.raises(StopIteration):
        _ = check_mechanism(modelling.from_urdf(CART_URDF), compiled=False)[
            "inputs without a limit"
        ]


def chain(count: int, axes: tuple[str, ...] = ("0 1 0",), tilt: str = "0 0 0") -> str:
    links = "".join(link(f"l_{i}") for i in range(count))
    ends = [("base", "l_0"), *((f"l_{i - 1}", f"l_{i}") for i in range(1, count))]
    joints = "".join(
        f'<joint name="j_{i}" type="continuous"><origin xyz="0.1 0.02 0.2" rpy="{tilt}"/>'
        f'<parent link="{a}"/><child link="{b}"/><axis xyz="{axes[i % len(axes)]}"/></joint>'
        for i, (a, b) in enumerate(ends)
    )
    return robot('<link name="base"/>', links, joints)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        pytest.param(chain(12), "12 moving joints.*at most 8000", marks=pytest.mark.slow),
        pytest.param(
            chain(12, ("1 0 0", "0 1 0", "0 0 1"), "0.3 0.2 0.1"),
            "12 moving joints.*at most 8000",
            marks=pytest.mark.slow,
        ),
        (chain(17), "moving joints of 'bad'.*got 17.*at most 16"),
        (robot('<link name="base"/>', *(link(f"l_{i}") for i in range(300)), *(
            joint(f"j_{i}", "base", f"l_{i}", "fixed") for i in range(300))), "links.*at most 200"),
    ],
    ids=["a chain", "askew", "too many", "links"],
)  # fmt: skip
def test_what_nobody_could_wait_for_is_refused_before_the_work(text: str, match: str) -> None:
    """Claim: the mass matrix of a long chain is refused while it grows, in a second or two."""
    start = time.process_time()
    with pytest.raises(ModelError, match=match):
        modelling.from_urdf(text, actuated=["j_0"])
    assert time.process_time() - start < 8.0


@pytest.mark.parametrize(
    "attempt",
    [
        lambda: modelling.from_urdf(3),  # type: ignore[arg-type]
        lambda: modelling.from_urdf(b"<robot/>"),  # type: ignore[arg-type]
        lambda: modelling.from_urdf(CART_URDF, gravity=9.81),  # type: ignore[arg-type]
        lambda: modelling.from_urdf(CART_URDF, gravity=(0, 0, "a")),  # type: ignore[arg-type]
        lambda: modelling.from_urdf(CART_URDF, actuated=[3]),  # type: ignore[list-item]
        lambda: modelling.from_urdf(CART_URDF, actuated=["x"], effort={"x": "a"}),  # type: ignore[dict-item]
        lambda: modelling.from_urdf(CART_URDF, equilibrium={"phi": "0"}),  # type: ignore[dict-item]
    ],
)
def test_arguments_of_another_kind_are_refused(attempt: Callable[[], object]) -> None:
    with pytest.raises(UndertowError) as refusal:
        attempt()
    assert refusal.value.remedy


# -- Python files of one's own -------------------------------------------------------------------

OWN = """
import undertow as ut
from undertow.mechanisms import tora

mine = ut.mechanisms.cart_pendulum()
def make():
    return ut.mechanisms.rotary_pendulum()
def refused():
    return ut.Coordinate("a b")
def fails():
    return 1 / 0
class Silent:
    period = 0.001
    def read(self):
        raise OSError("no such port")
    def write(self, u): ...
    def close(self): ...
"""


@pytest.mark.parametrize(
    ("name", "error", "facts"),
    [
        ("mak", InvalidInputError, ("one of mine, make", "Did you mean make")),
        ("zzz", InvalidInputError, ("no name 'zzz'", "mine, make")),
        (
            "tora_",
            InvalidInputError,
            ("no name", "one of mine"),
        ),  # what was imported is not offered
        ("refused", InvalidInputError, ("own.py line 9", "'a b'", "identifier")),
        ("fails", ArtefactError, ("own.py line 11", "ZeroDivisionError")),
    ],
)
def test_errors_of_ones_own_file_name_file_and_line(
    name: str, error: type[Exception], facts: tuple[str, ...], tmp_path: Path
) -> None:
    """Claim: a wrong name lists the right ones; what fails inside says where."""
    path = tmp_path / "own.py"
    path.write_text(OWN, encoding="utf-8")
    assert modelling.mechanism_from_file(f"{path}:mine").name == "cart_pendulum"
    assert modelling.mechanism_from_file(f"{path}:make").name == "rotary_pendulum"
    with pytest.raises(error) as refusal:
        modelling.mechanism_from_file(f"{path}:{name}")
    for fact in facts:
        assert fact in str(refusal.value)
    assert "tora," not in str(refusal.value)


def test_a_file_without_a_name_behind_it_lists_its_names(tmp_path: Path) -> None:
    """``simulate own.py``: those of the file, not those of the library."""
    path = tmp_path / "own.py"
    path.write_text(OWN, encoding="utf-8")
    with pytest.raises(InvalidInputError, match=r"no name behind it.*one of mine, make") as refusal:
        named(str(path))
    assert f"{path}:mine" in refusal.value.remedy
    assert "tora" not in str(refusal.value)
    assert in_a_file(str(path))  # and so a log's word for it is not run


@pytest.mark.parametrize(
    ("text", "fact"),
    [
        ("x = (\n", "line 1"),
        ("raise SystemExit(0)", "SystemExit"),
        ("import numppy", "line 1"),
    ],
)
def test_files_that_do_not_run_say_where(text: str, fact: str, tmp_path: Path) -> None:
    path = tmp_path / "own.py"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ArtefactError, match=fact) as refusal:
        modelling.mechanism_from_file(f"{path}:mine")
    assert refusal.value.remedy


def test_a_driver_that_fails_says_where(tmp_path: Path) -> None:
    path = tmp_path / "own.py"
    path.write_text(OWN, encoding="utf-8")
    rig = ut.mechanisms.rotary_pendulum()
    with pytest.raises(ArtefactError, match=r"no such port.*own\.py line 15"):
        rig_from_file(f"{path}:Silent", rig)
    with pytest.raises(InvalidInputError, match="Did you mean Silent"):
        rig_from_file(f"{path}:Silnt", rig)


def test_a_wrong_name_of_the_library_lists_the_near_ones() -> None:
    with pytest.raises(InvalidInputError, match="Did you mean rotary_pendulum"):
        named("rotary_pendlum")


def test_a_file_that_is_missing_is_told_in_words(tmp_path: Path) -> None:
    with pytest.raises(ArtefactError, match=r"got no such file or directory, must be a file that"):
        modelling.mechanism_from_file(f"{tmp_path}/bar.py:bar")
