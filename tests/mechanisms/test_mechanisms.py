"""The library: every mechanism moves as an independent engine says, and keeps its energy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

import undertow as ut
from undertow import mechanisms
from undertow.base import InvalidInputError
from undertow.law import stability_margin
from undertow.mechanisms import LIBRARY
from undertow.mechanisms.rotary_pendulum import PARAMETER_SETS
from undertow.models import FloatArray
from undertow.plants.scenes import mujoco_scene

NAMES = sorted(LIBRARY)


@cache
def library(name: str) -> ut.Mechanism:
    return LIBRARY[name]()


def perturbed(mechanism: ut.Mechanism, seed: int) -> ut.Mechanism:
    """The mechanism with every parameter changed by up to 20 %, inside its bounds."""
    rng = np.random.default_rng(seed)
    values = {
        p.name: float(np.clip(p.value * rng.uniform(0.8, 1.2), p.low + 1e-9, p.high - 1e-13))
        for p in mechanism.parameters
    }
    return mechanism.with_parameters(**values)


def random_motion(mechanism: ut.Mechanism, count: int, seed: int) -> tuple[FloatArray, FloatArray]:
    """Random states (count, 2n) and inputs (count, m): all angles, the ranges, speeds up to 3."""
    rng = np.random.default_rng(seed)
    reach = np.array(
        [np.pi if c.unit == "rad" else min(1.0, c.high) for c in mechanism.coordinates]
    )
    q = rng.uniform(-reach, reach, (count, mechanism.n))
    qd = rng.uniform(-3, 3, (count, mechanism.n))
    u = rng.uniform(-1, 1, (count, mechanism.m)) * mechanism.input_limits
    return np.hstack([q, qd]), u


def mujoco_accelerations(mechanism: ut.Mechanism, x: FloatArray, u: FloatArray) -> FloatArray:
    """q̈ by MuJoCo, in the mechanism's coordinates."""
    mujoco: Any = pytest.importorskip("mujoco")
    scene = mujoco_scene(mechanism)
    model = mujoco.MjModel.from_xml_string(scene.xml)
    data = mujoco.MjData(model)
    n = mechanism.n
    result = np.empty((len(x), n))
    for k, (state, push) in enumerate(zip(x, u, strict=True)):
        data.qpos[:] = scene.joints @ state[:n]
        data.qvel[:] = scene.joints @ state[n:]
        data.ctrl[:] = push
        mujoco.mj_forward(model, data)
        result[k] = np.linalg.solve(scene.joints, data.qacc)
    return result


@pytest.mark.parametrize("name", NAMES)
def test_accelerations_agree_with_mujoco(name: str) -> None:
    """Claim: q̈ agrees with MuJoCo to 1e-8 relative at 100 random states, and does so again
    with every parameter changed: all of them mean the same to both."""
    for mechanism in (library(name), perturbed(library(name), 1)):
        x, u = random_motion(mechanism, 100, 2)
        theirs = mujoco_accelerations(mechanism, x, u)
        ours = mechanism.accelerations(0.0, x, u)
        error = np.linalg.norm(ours - theirs, axis=1) / np.linalg.norm(theirs, axis=1)
        assert error.max() < 1e-8


@pytest.mark.parametrize("name", sorted(PARAMETER_SETS))
def test_parameter_sets_of_the_rotary_pendulum_agree_with_mujoco(name: str) -> None:
    """Claim: the Quanser rigs run on the same equations."""
    mechanism = mechanisms.rotary_pendulum(name)
    x, u = random_motion(mechanism, 20, 3)
    theirs = mujoco_accelerations(mechanism, x, u)
    error = np.linalg.norm(mechanism.accelerations(0.0, x, u) - theirs, axis=1)
    assert (error / np.linalg.norm(theirs, axis=1)).max() < 1e-8


def test_a_scene_that_is_wrong_is_noticed() -> None:
    """Claim: the comparison can fail: 1 % more mass on one side shows."""
    mechanism = library("cart_pendulum")
    x, u = random_motion(mechanism, 5, 4)
    heavier = mechanism.with_parameters(m_p=0.202)
    gap = mujoco_accelerations(heavier, x, u) - mechanism.accelerations(0.0, x, u)
    assert np.abs(gap).max() > 1e-3


def energy_error(mechanism: ut.Mechanism, x0: FloatArray, step: float, end: float) -> float:
    """|E(end) − E(0) − ∫ power of damping|, J, of passive motion by Runge-Kutta 4."""
    n = mechanism.n
    u = np.zeros(mechanism.m)

    def rate(y: FloatArray) -> FloatArray:
        x = y[:-1]
        back = np.concatenate([x[:n], -x[n:]])
        damping = (mechanism.f(x) - mechanism.f(back)) / 2
        qdd = mechanism.accelerations(0.0, x, u)
        return np.concatenate([x[n:], qdd, [x[n:] @ damping]])

    y = np.append(x0, 0.0)
    for _ in range(round(end / step)):
        k1 = rate(y)
        k2 = rate(y + step / 2 * k1)
        k3 = rate(y + step / 2 * k2)
        k4 = rate(y + step * k3)
        y = y + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    gained = mechanism.energy(y[:-1]) - mechanism.energy(x0)
    return abs(float(gained) - float(y[-1]))


@pytest.mark.parametrize("name", NAMES)
def test_energy_drifts_at_the_order_of_the_integrator(name: str) -> None:
    """Claim: energy changes by the work of damping alone: what is left of the balance falls at
    fourth order with the step."""
    mechanism = library(name)
    (x0,), _ = random_motion(mechanism, 1, 5)
    coarse, fine = (energy_error(mechanism, x0, h, 0.2) for h in (0.004, 0.002))
    assert fine < 1e-12 * (1 + abs(float(mechanism.energy(x0)))) or coarse / fine > 2**3.7


def test_the_names_of_the_library() -> None:
    """Claim: the library has the thirteen mechanisms, each named as its function."""
    assert sorted(mechanisms.__all__) == NAMES
    assert all(library(name).name == name for name in NAMES)
    shapes = {name: (library(name).n, library(name).m) for name in NAMES}
    assert len(shapes) == 13
    assert shapes["double_pendulum_on_a_cart"] == (3, 1)
    assert shapes["two_motor_three_link"] == (3, 2)
    assert shapes["gantry_crane"] == (4, 2)
    assert shapes["triple_pendulum_on_a_cart"] == (4, 1)


@pytest.mark.parametrize("name", NAMES)
def test_data_are_complete(name: str) -> None:
    """Claim: every parameter says what it is and where it comes from; inputs have limits; a
    start state is declared; units are SI."""
    mechanism = library(name)
    for parameter in mechanism.parameters:
        assert parameter.description
        assert parameter.source
    assert np.isfinite(mechanism.input_limits).all()
    assert mechanism.start
    assert mechanism.description
    assert mechanism.source
    assert all(c.description and c.unit in ("rad", "m") for c in mechanism.coordinates)


@pytest.mark.parametrize("name", NAMES)
def test_parameters_are_replaced_by_name(name: str) -> None:
    """Claim: values are replaced by keyword, and an unknown one is refused."""
    first = library(name).parameters[0]
    changed = LIBRARY[name](**{first.name: first.value * 1.1})
    assert changed.parameters[0].value == pytest.approx(first.value * 1.1)
    with pytest.raises(InvalidInputError, match="unknown parameter"):
        LIBRARY[name](no_such_parameter=1.0)


@pytest.mark.parametrize("name", NAMES)
def test_a_first_surface_exists(name: str) -> None:
    """Claim: every target can be stabilised: the quadratic design gives a stable surface."""
    surface = ut.first_surface(library(name))
    assert stability_margin(library(name), surface) > 0


@pytest.mark.parametrize("set_name", sorted(PARAMETER_SETS))
def test_quanser_rigs_move_as_their_manuals_say(set_name: str) -> None:
    """Claim: the equivalent uniform rod has the M, gravity and drive of the rig's own data:
    a = J_r + η_g K_g² J_m + m_p L_r², b = m_p L_r l_p, c = J_p + m_p l_p², d = m_p g l_p."""
    rig = PARAMETER_SETS[set_name]
    mechanism = mechanisms.rotary_pendulum(set_name)
    q = np.array([0.3, 0.7])
    c = rig.J_p + rig.m_p * rig.l_p**2
    a = rig.J_r + rig.motor.reflected_inertia + rig.m_p * rig.L_r**2
    M_au = -rig.m_p * rig.L_r * rig.l_p * np.cos(0.7)
    expected = [[a + c * np.sin(0.7) ** 2, M_au], [M_au, c]]
    np.testing.assert_allclose(mechanism.M(q), expected, rtol=1e-12)
    x = np.array([0.3, 0.7, 2.0, 0.0])
    rest = mechanism.f(mechanism.state(phi=0.7))[1]
    assert rest == pytest.approx(rig.m_p * 9.81 * rig.l_p * np.sin(0.7))
    drag = mechanism.f(x)[0] - mechanism.f(x * [1, 1, -1, 1])[0]
    assert drag == pytest.approx(-2 * 2.0 * (rig.B_r + rig.motor.damping))


def test_the_paper_stays_the_default() -> None:
    """Claim: the paper's parameters are what one gets unasked; unknown sets are refused."""
    assert mechanisms.rotary_pendulum().input_limits.tolist() == [15.0]
    assert mechanisms.rotary_pendulum().substitution == library("rotary_pendulum").substitution
    with pytest.raises(InvalidInputError, match="srv02"):
        mechanisms.rotary_pendulum("srv03")


def test_the_srv02_set_is_close_to_the_paper() -> None:
    """Claim: the manual's high gear gives the paper's a_e and d_e within 3 %."""
    manual = {p.name: p.value for p in mechanisms.rotary_pendulum("srv02").parameters}
    paper = {p.name: p.value for p in library("rotary_pendulum").parameters}
    assert manual["a_e"] == pytest.approx(paper["a_e"], rel=0.03)
    assert manual["d_e"] == pytest.approx(paper["d_e"], rel=0.03)


def test_scenes_of_unknown_mechanisms_are_refused() -> None:
    """Claim: a mechanism that is not of the library has no scene, and the error says so."""
    stranger = replace(library("tora"), name="stranger")
    with pytest.raises(InvalidInputError, match="from_mjcf"):
        mujoco_scene(stranger)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_the_first_surface_brings_it_home(name: str) -> None:
    """Claim: each mechanism's closed loop compiles, and its first surface alone brings it from
    the declared start to ‖x‖ ≤ 0.01 within its limits."""
    mechanism = library(name)
    loop = ut.ClosedLoop(mechanism, ut.MinimumEnergy(horizon=60.0))
    run = loop.simulate(mechanism.state(**mechanism.start), ut.first_surface(mechanism))
    assert run.event is ut.Event.REACHED
    assert np.linalg.norm(run.x[-1]) <= 0.0101
    assert (np.abs(run.u) <= mechanism.input_limits * (1 + 1e-12)).all()


def _damping(build: Callable[..., ut.Mechanism]) -> list[str]:
    return [p.name for p in build().parameters if "damping" in p.description]


@pytest.mark.parametrize("name", ["cart_pendulum", "acrobot", "gantry_crane", "tora"])
def test_without_damping_energy_is_kept(name: str) -> None:
    """Claim: damping can be switched off, and then the energy itself is conserved."""
    names = _damping(LIBRARY[name])
    assert names
    mechanism = library(name).with_parameters(**dict.fromkeys(names, 0.0))
    (x0,), _ = random_motion(mechanism, 1, 6)
    x, u = x0, np.zeros(mechanism.m)
    n, h = mechanism.n, 1e-3
    for _ in range(200):

        def rate(state: FloatArray) -> FloatArray:
            return np.concatenate([state[n:], mechanism.accelerations(0.0, state, u)])

        k1 = rate(x)
        k2 = rate(x + h / 2 * k1)
        k3 = rate(x + h / 2 * k2)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + rate(x + h * k3))
    assert float(mechanism.energy(x)) == pytest.approx(float(mechanism.energy(x0)), abs=1e-8)


def test_reaction_wheel_has_the_inertia_about_the_pivot_that_its_source_prints() -> None:
    """Claim: J_p + m_p l_p² + m_r l_r² = 4.572e-3 kg m² as printed; with J_p = 2.333e-4, which
    copies of the table have, it would not be."""
    printed = 4.572e-3
    v = {p.name: p.value for p in library("reaction_wheel_pendulum").parameters}
    shift = v["m_p"] * v["l_p"] ** 2 + v["m_r"] * v["l_r"] ** 2
    assert round(v["J_p"] + shift, 6) == printed
    assert round(2.333e-4 + shift, 6) != printed
