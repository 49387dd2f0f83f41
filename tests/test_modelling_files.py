"""URDF and MJCF: the trees that files describe move as MuJoCo says; the rest is refused."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import undertow as ut
from undertow import modelling
from undertow.check import check_mechanism
from undertow.errors import ArtefactError, InvalidInputError, ModelError
from undertow.mechanism import FloatArray
from undertow.mechanisms import LIBRARY
from undertow.mechanisms.scenes import mujoco_scene

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
        assert check_mechanism(read).passed
        heavier = read.with_parameters(rod_mass=0.3)
        same = rig.with_parameters(m_p=0.3)
        assert np.abs(heavier.f(x) - same.f(x)).max() < TIGHT


@pytest.mark.parametrize("name", sorted(LIBRARY))
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
    report = check_mechanism(read)
    assert all("target" in check.name for check in report.failures)


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
    assert check_mechanism(read).passed


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


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ('name="phi"', 'name="x"', "named twice.*x"),
        ('<link name="rod">', '<link name="cart">', "named twice.*cart"),
        ('<parent link="cart"/>', '<parent link="wagon"/>', "'wagon'"),
        ('type="continuous"', 'type="floating"', "Remark 3"),
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
        modelling.from_urdf(BRANCHED_URDF)
    with pytest.raises(ModelError, match="not underactuated"):
        modelling.from_urdf(CART_URDF, actuated=["x", "phi"])
    with pytest.raises(InvalidInputError, match="effort"):
        modelling.from_urdf(CART_URDF, actuated=["x"], effort={"phi": 1.0})
    with pytest.raises(InvalidInputError, match="equilibrium"):
        modelling.from_urdf(CART_URDF, equilibrium={"psi": 1.0})


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ('<joint name="phi" axis="0 1 0" damping="0.001"/>', "<freejoint/>", "Remark 3"),
        ('<joint name="phi" axis="0 1 0"', '<joint name="phi" type="ball"', "'ball'"),
        ("<actuator>", '<equality><weld body1="cart"/></equality><actuator>', "closed loop"),
        ("<motor ", "<position ", "Use <motor>"),
        ("</worldbody>", '</worldbody><include file="a.xml"/>', "<include>"),
        ("<actuator>", "<tendon><spatial/></tendon><actuator>", "spatial"),
        ('gravity="0 0 -9.8"', 'gravity="0 0 -9.8" density="1.2"', "density"),
        ("<option", '<compiler boundmass="1"/><option', "boundmass"),
        ("<option", '<compiler balanceinertia="true"/><option', "balanceinertia"),
        ('<body name="rod">', '<body name="rod" gravcomp="1">', "gravcomp"),
        ('<body name="rod">', '<body name="rod"><plugin/>', "<plugin>"),
        ('<body name="rod">', '<body name="rod" euler="0 0 0" quat="1 0 0 0">', "one of them"),
        ('axis="0 1 0"', 'axis="0 1 0" class="soft"', "declared in <default>"),
        ('joint="x" ctrl', 'joint="y" ctrl', "'y'"),
        ('joint="x" ctrl', 'site="tip" ctrl', "neither joint"),
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
