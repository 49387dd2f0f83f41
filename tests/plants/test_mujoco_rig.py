"""MuJoCo as a rig: the same motion as the model's, from another engine."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest
import sympy as sp

import undertow as ut
from undertow.base import InvalidInputError
from undertow.plants import IdealRig, MuJoCoRig
from undertow.plants.scenes import Scene, mujoco_scene

pytest.importorskip("mujoco")


@pytest.mark.parametrize(
    "name",
    ["rotary_pendulum", pytest.param("double_pendulum_on_a_cart", marks=pytest.mark.slow)],
)
def test_both_engines_move_alike(name: str) -> None:
    mechanism = ut.mechanisms.LIBRARY[name]()
    x0 = mechanism.state(**mechanism.start)
    rigs = MuJoCoRig(mechanism, x0), IdealRig(mechanism, x0)
    for k in range(300):
        for rig in rigs:
            rig.write(np.array([0.3 * mechanism.inputs[0].limit * math.sin(0.05 * k)]))
    np.testing.assert_allclose(rigs[0].truth, rigs[1].truth, rtol=1e-6, atol=1e-6)
    assert rigs[0].read().t == pytest.approx(0.3)
    assert rigs[0].read().v is None


def test_inputs_are_clipped_by_the_rig() -> None:
    arm = ut.mechanisms.rotary_pendulum()
    strong, limit = (MuJoCoRig(arm, [0, math.pi, 0, 0]) for _ in range(2))
    for _ in range(50):
        strong.write(np.array([100.0]))
        limit.write(np.array([15.0]))
    np.testing.assert_array_equal(strong.truth, limit.truth)


def test_a_scene_of_another_mechanism_is_refused() -> None:
    arm = ut.mechanisms.rotary_pendulum()
    scene = mujoco_scene(ut.mechanisms.double_pendulum_on_a_cart())
    with pytest.raises(InvalidInputError, match="3 joints"):
        MuJoCoRig(arm, scene=scene)
    with pytest.raises(InvalidInputError, match="period"):
        MuJoCoRig(arm, period=0.0)
    assert isinstance(scene, Scene)


ARM = """<mujoco><compiler angle="radian"/><worldbody>
  <body name="first"><joint name="free" axis="0 1 0" damping="0.01"/>
    <inertial pos="0 0 0.2" mass="0.3" diaginertia="0.004 0.004 0.0001"/>
    <body name="second" pos="0 0 0.4"><joint name="elbow-1" axis="0 1 0" ref="0.1"/>
      <inertial pos="0 0 0.2" mass="0.2" diaginertia="0.003 0.003 0.0001"/>
      <body name="third" pos="0 0 0.4"><joint name="wrist" axis="0 1 0" damping="0.02"/>
        <inertial pos="0 0 0.1" mass="0.1" diaginertia="0.001 0.001 0.0001"/>
      </body></body></body></worldbody>
  <actuator>
    <motor name="w" joint="wrist" gear="-2" ctrlrange="-3 3"/>
    <motor name="e" joint="elbow-1" gear="3" ctrlrange="-2 2"/>
  </actuator></mujoco>"""


def test_joints_and_motors_of_a_file_are_found_by_their_names(tmp_path: Path) -> None:
    """Another order, gears, a reference, a target: the engine moves as the model of the file."""
    (tmp_path / "arm.xml").write_text(ARM)
    target = {"elbow_1": 0.1}
    read = ut.modelling.from_mjcf(tmp_path / "arm.xml", equilibrium=target)
    assert [c.name for c in read.coordinates] == ["wrist", "elbow_1", "free"]
    turned = ut.Mechanism(
        read.name, read.coordinates, read.inputs[::-1], read.mass_matrix, read.force,
        read.input_matrix[:, ::-1], read.parameters,
    )  # fmt: skip
    x0 = read.state(free=0.2, elbow_1=-0.1, wrist_dot=0.5)
    u, T = np.array([1.0, -0.7]), 1e-6
    for mechanism, inputs in ((read, u), (turned, u[::-1])):
        rig = MuJoCoRig(mechanism, x0, scene=tmp_path / "arm.xml", target=target, period=T)
        np.testing.assert_allclose(rig.read().q, x0[:3], atol=1e-12)
        rig.write(inputs)
        moved = (rig.truth[3:] - x0[3:]) / T
        np.testing.assert_allclose(moved, read.accelerations(0.0, x0, u), rtol=1e-4)
    # Without the inputs' names, motors are those of the actuated joints.
    nameless = ARM.replace('name="w"', "").replace('name="e"', "")
    rig = MuJoCoRig(read, x0, scene=nameless, target=target, period=T)
    rig.write(u)
    np.testing.assert_allclose((rig.truth[3:] - x0[3:]) / T, moved, rtol=1e-6)


def test_motors_are_found_by_joints_where_inputs_come_in_another_order() -> None:
    """Two sliders and a rider: the first input is the second slider's, by B."""
    x, y, ride = (ut.Coordinate(name, "m") for name in ("x", "y", "ride"))
    T = sum(c.velocity**2 for c in (x, y, ride)) / 2
    V = (ride.symbol - x.symbol) ** 2 / 2
    inputs = [ut.Input("on_y", "N", 9.0), ut.Input("on_x", "N", 9.0)]
    B = sp.Matrix([[0, 1], [1, 0]])
    pair = ut.Mechanism.from_energies("pair", [x, y, ride], inputs, T, V, input_matrix=B)
    body = """<body><joint name="{0}" type="slide" axis="1 0 0"/>
        <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body>"""
    scene = f"""<mujoco><worldbody>{"".join(map(body.format, ("x", "y", "ride")))}</worldbody>
        <actuator><motor name="a" joint="x"/><motor name="b" joint="y"/></actuator></mujoco>"""
    rig = MuJoCoRig(pair, np.zeros(6), scene=scene)
    rig.write(np.array([1.0, 0.0]))
    assert rig.read().q[1] > 0.0 == rig.read().q[0]


def test_a_range_in_the_file_is_an_end_stop(tmp_path: Path) -> None:
    """What the engine knows besides the equations acts."""
    cart = ut.mechanisms.cart_pendulum()
    xml = mujoco_scene(cart).xml.replace('limit="disable"', "")
    xml = xml.replace('name="x" type="slide"', 'name="x" type="slide" range="-0.1 0.1"')
    rig = MuJoCoRig(cart, cart.state(phi=math.pi), scene=xml)
    for _ in range(1500):
        rig.write(np.array([5.0]))
    assert rig.truth[0] == pytest.approx(0.1, abs=0.01)


@pytest.mark.parametrize(
    ("scene", "words"),
    [
        (ARM, "3 joints with 3 positions, 2 motors, must be 2 hinge or slide joints, 1 motors"),
        ("<mujoco><worldbody>", "MJCF that MuJoCo loads"),
        ("none.xml", "none.xml"),
        (
            mujoco_scene(ut.mechanisms.overhead_crane()).xml,
            "got x, theta, must be the names x, phi",
        ),
    ],
)
def test_a_file_that_is_another_mechanism_is_refused(scene: str, words: str) -> None:
    with pytest.raises(InvalidInputError, match=re.escape(words)):
        MuJoCoRig(ut.mechanisms.cart_pendulum(), scene=scene)


def test_a_target_with_another_name_is_refused() -> None:
    cart = ut.mechanisms.cart_pendulum()
    with pytest.raises(InvalidInputError, match="among x, phi"):
        MuJoCoRig(cart, scene=mujoco_scene(cart).xml, target={"y": 1.0})


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["rotary_pendulum", "cart_pendulum", "double_pendulum_on_a_cart", "acrobot"]
)
def test_the_cascade_balances_in_mujoco_without_retuning(name: str) -> None:
    from undertow.studies.trials.upright import engine_trial

    assert engine_trial(name, seconds=6.0, budget=128).outcome.balanced


def test_a_mechanism_of_ones_own_under_a_name_of_the_library_has_no_scene() -> None:
    """It would have been moved as the library's, or ended in a KeyError."""
    plain = ut.mechanisms.cart_pendulum()
    mujoco_scene(plain.with_parameters(b_p=0.1).with_disturbance_bounds(0.1, 0.0))
    other = ut.Mechanism(
        "cart_pendulum", plain.coordinates, plain.inputs, mass_matrix=plain.mass_matrix,
        force=plain.force + sp.Matrix([-(plain.q[0] ** 3), 0]), input_matrix=plain.input_matrix,
        parameters=plain.parameters,
    )  # fmt: skip
    for own in (other, ut.mechanisms.acrobot(), plain):
        named = ut.Mechanism(
            "cart_pendulum", own.coordinates, own.inputs, mass_matrix=own.mass_matrix,
            force=own.force, input_matrix=own.input_matrix, parameters=own.parameters,
        )  # fmt: skip
        if own is plain:
            assert mujoco_scene(named).xml == mujoco_scene(plain).xml
        else:
            with pytest.raises(InvalidInputError, match="with other equations"):
                mujoco_scene(named)
