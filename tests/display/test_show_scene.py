"""Figures for the page: derivatives, what a mouse takes hold of, stick figures of one's own."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import undertow as ut
from undertow.display.animation import evaluator
from undertow.display.live import Scene
from undertow.display.sketches import Disc, Label, Line, sketch
from undertow.display.tree_sketch import sketch_named
from undertow.mechanisms import LIBRARY
from undertow.mechanisms.named import named
from undertow.studies.live.messages import described

URDF = """<robot name="lever"><link name="base"/>
<link name="arm"><inertial><origin xyz="0 0 0.25"/><mass value="0.5"/>
<inertia ixx="0.0104" iyy="0.0104" izz="0.0001" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="rod"><inertial><origin xyz="0 0 0.3"/><mass value="0.4"/>
<inertia ixx="0.012" iyy="0.012" izz="0.0001" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="shoulder" type="continuous"><parent link="base"/><child link="arm"/>
<axis xyz="0 1 0"/></joint>
<joint name="elbow" type="continuous"><parent link="arm"/><child link="rod"/>
<origin xyz="0 0 0.5"/><axis xyz="0 1 0"/></joint></robot>"""

MJCF = """<mujoco><worldbody><body name="cart"><joint name="x" type="slide" axis="1 0 0"/>
<geom type="sphere" size="0.1" mass="1"/><body name="pole"><joint name="phi" type="hinge"
axis="0 1 0"/><geom type="sphere" size="0.1" pos="0 0 0.5" mass="1"/></body></body></worldbody>
<actuator><motor joint="x" ctrllimited="true" ctrlrange="-9 9"/></actuator></mujoco>"""

FROZEN = """<mujoco><worldbody><body name="cart"><joint name="cart" type="slide" axis="1 0 0"/>
<geom type="sphere" size="0.1" mass="1"/><body name="pole"><joint name="phi" type="hinge"
axis="0 1 0"/><geom type="sphere" size="0.1" pos="0 0 0.3" mass="1"/><body name="wheel"
pos="0 0 0.6"><joint name="wheel" axis="0 1 0"/><geom type="cylinder" size="0.1 0.01" mass="0.2"/>
</body></body></body></worldbody></mujoco>"""


@pytest.mark.parametrize("name", LIBRARY)
def test_every_mechanism_is_drawn_and_slopes_are_derivatives(name: str) -> None:
    """Thirteen figures of one's own kind; ∂p/∂q agrees with differences; it fits the window."""
    mechanism = LIBRARY[name]()
    figure = sketch(mechanism)
    assert not any(isinstance(part, Label) for part in figure.parts)  # no dials
    scene, values = Scene(mechanism, figure), mechanism.parameter_values
    rng = np.random.default_rng(1)
    q = rng.uniform(-0.4, 0.4, mechanism.n)
    places = scene.places(q, values)[: 2 * scene.count].reshape(-1, 2)
    grip = scene.nearest(q, values, places[-1])
    assert grip is not None
    step = 1e-6
    for i in range(mechanism.n):
        ahead, behind = q.copy(), q.copy()
        ahead[i] += step
        behind[i] -= step
        slope = (scene.held(ahead, values, grip) - scene.held(behind, values, grip)) / (2 * step)
        np.testing.assert_allclose(scene.slopes(q, values, grip)[:, i], slope, atol=1e-8)
    start = scene.places(mechanism.usual_start[: mechanism.n], values)
    left, right, bottom, top = scene.window
    tip = start[2 * scene.count - 2 : 2 * scene.count]
    assert bottom < tip[1] < top
    assert max(right - left, top - bottom) < 10


def test_it_is_drawn_as_films_draw_it() -> None:
    """The same points as the frames of a film, in the same plane."""
    mechanism = ut.mechanisms.cart_pendulum()
    figure = sketch(mechanism)
    q = np.array([0.2, -0.3])
    _, _, tip = evaluator(mechanism, figure)(q[None])
    scene = Scene(mechanism, figure)
    places = scene.places(q, mechanism.parameter_values)
    np.testing.assert_allclose(places[2 * scene.count - 2 : 2 * scene.count], tip[0][[0, 2]])


def test_the_nearest_part_that_moves_is_held() -> None:
    """A point beside the rod holds the rod there; one far away holds nothing."""
    mechanism = ut.mechanisms.cart_pendulum()
    scene, values = Scene(mechanism, sketch(mechanism)), mechanism.parameter_values
    q = np.array([0.0, 0.0])
    half = float(mechanism.substitution[next(p.symbol for p in mechanism.parameters
                                             if p.name == "l")])  # fmt: skip
    grip = scene.nearest(q, values, [0.03, half])
    assert grip is not None
    np.testing.assert_allclose(scene.held(q, values, grip), [0.0, half], atol=1e-12)
    assert scene.nearest(q, values, [5.0, 5.0], 0.3) is None


@pytest.mark.parametrize(("suffix", "text"), [("urdf", URDF), ("xml", MJCF)])
def test_a_file_of_bodies_gets_a_stick_figure(tmp_path: Path, suffix: str, text: str) -> None:
    """Links from joint to joint, not dials; the mass is where the potential energy says."""
    file = tmp_path / f"own.{suffix}"
    file.write_text(text)
    name = f"{file}:shoulder" if suffix == "urdf" else str(file)
    mechanism = named(name)
    figure = sketch_named(name, mechanism)
    assert not any(isinstance(part, Label | Disc) for part in figure.parts)
    scene, values = Scene(mechanism, figure), mechanism.parameter_values
    for q in np.random.default_rng(2).uniform(-2, 2, (5, 2)):
        points = scene.places(q, values)[: 2 * scene.count].reshape(-1, 2)
        x = np.concatenate([q, 0 * q])
        if suffix == "urdf":  # half way along each link, as the file says
            order = [c.name for c in mechanism.coordinates]
            shoulder, elbow = (q[order.index(c)] for c in ("shoulder", "elbow"))
            end = 0.5 * np.array([np.sin(shoulder), np.cos(shoulder)])
            tip = end + 0.6 * np.array([np.sin(shoulder + elbow), np.cos(shoulder + elbow)])
            energy = 9.81 * (0.5 * end[1] / 2 + 0.4 * (end[1] + tip[1]) / 2)
        else:
            pivot = np.array([q[0], 0.0])
            tip = pivot + np.array([np.sin(q[1]), np.cos(q[1])])
            energy = 9.81 * 0.5 * tip[1]
        np.testing.assert_allclose(points[-1], tip, atol=1e-12)
        assert float(mechanism.energy(x)) - float(mechanism.energy(0 * x)) == pytest.approx(
            energy - (9.81 * (0.125 + 0.4 * 0.8) if suffix == "urdf" else 9.81 * 0.5), abs=1e-9
        )


def test_a_file_is_drawn_at_its_target_with_what_is_frozen(tmp_path: Path) -> None:
    """Every target of a file was drawn as the file is, upright; a frozen joint left dials."""
    file = tmp_path / "own.urdf"
    file.write_text(URDF)
    for target, height in (("upright", 1.1), ("hanging", -1.1), ("elbow=180deg", -0.1)):
        name = f"{file}:shoulder@{target}"
        mechanism = named(name)
        scene = Scene(mechanism, sketch_named(name, mechanism))
        tip = scene.points(np.zeros(2), mechanism.parameter_values)[-1]
        np.testing.assert_allclose(tip, [0.0, height], atol=1e-9)
    frozen = tmp_path / "own.xml"
    frozen.write_text(FROZEN)
    name = f"{frozen}:cart,-wheel@hanging"
    mechanism = named(name)
    figure = sketch_named(name, mechanism)
    assert not any(isinstance(part, Label) for part in figure.parts)
    tip = Scene(mechanism, figure).points(np.zeros(2), mechanism.parameter_values)[-1]
    np.testing.assert_allclose(tip, [0.0, -0.6], atol=1e-9)


def test_a_mechanism_of_the_library_about_another_target_is_not_drawn_upright() -> None:
    """Its figure is that of the library's target; its description says where it is now."""
    rig = ut.mechanisms.rotary_pendulum(d_e=0.025).with_disturbance_bounds(0.1, 0.0)
    assert not any(isinstance(part, Label) for part in sketch(rig).parts)
    hanging = ut.modelling.move_target(rig, phi=np.pi)
    assert any(isinstance(part, Label) for part in sketch(hanging).parts)
    assert hanging.description.endswith("target theta = 0°, phi = 180° of the old one")


def test_what_has_no_kinematics_gets_labelled_dials() -> None:
    """Equations alone say nothing of places: a dial or rail a coordinate, each with its name."""
    a, b = ut.Coordinate("a"), ut.Coordinate("b", "m")
    mechanism = ut.Mechanism.from_energies(
        "own", [a, b], [ut.Input("u", "N m", 1.0)],
        kinetic=a.velocity**2 + b.velocity**2 + a.velocity * b.velocity / 2,
        potential=-(b.symbol**2) / 2,
    )  # fmt: skip
    parts = sketch_named("own.py:own", mechanism).parts
    assert [part.text for part in parts if isinstance(part, Label)] == ["a, °", "b, m"]
    assert any(isinstance(part, Line) for part in parts)


def test_a_description_of_several_lines_is_one_sentence_on_the_page() -> None:
    """What was read of a file ran together there, for HTML takes line ends for spaces."""
    rig = replace(named("overhead_crane"), description="one\ntwo, three")
    assert described(rig, Scene(rig, sketch(rig)))["about"] == "one; two, three"
