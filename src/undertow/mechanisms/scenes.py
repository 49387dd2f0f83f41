"""MuJoCo scenes of the library's mechanisms, from the same parameters.

Written by hand, body by body, and not from the derived equations: an independent engine can so
check them, and serve as a plant.  Contacts and joint stops are switched off.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from undertow.base import InvalidInputError
from undertow.models import FloatArray, Mechanism

__all__ = ["Scene", "mujoco_scene"]

#: MuJoCo refuses moments of inertia of exactly zero.
_THIN = 1e-14


@dataclass(frozen=True, eq=False)
class Scene:
    """An MJCF document and how its joints read the coordinates.

    Attributes
    ----------
    xml
        The document; its actuators take the mechanism's inputs, in order.
    joints
        Matrix P, (n, n), with ``qpos = P q`` and ``qvel = P q̇``: MuJoCo's joints are relative
        and in the order of the bodies.
    """

    xml: str
    joints: FloatArray


def mujoco_scene(mechanism: Mechanism) -> Scene:
    """Return the MuJoCo scene of a mechanism of the library, with its present parameters.

    Raises
    ------
    InvalidInputError
        For a mechanism that is not of the library.
    """
    if mechanism.name not in _SCENES:
        raise InvalidInputError(
            "MuJoCo scene",
            value=repr(mechanism.name),
            limit=f"one of {', '.join(_SCENES)}",
            remedy="Bring an MJCF file of your own: undertow.models.importers.from_mjcf",
        )
    values = {p.name: p.value for p in mechanism.parameters}
    bodies, motors, joints = _SCENES[mechanism.name](values)
    limits = [
        f'ctrlrange="{-i.limit!r} {i.limit!r}"' if math.isfinite(i.limit) else ""
        for i in mechanism.inputs
    ]
    actuators = "".join(
        f'<motor name="{i.name}" {motor} {limit}/>'
        for i, motor, limit in zip(mechanism.inputs, motors, limits, strict=True)
    )
    tendons, bodies = bodies.split("|") if "|" in bodies else ("", bodies)
    xml = (
        f'<mujoco model="{mechanism.name}">'
        '<compiler angle="radian"/>'
        f'<option gravity="0 0 {-values.get("g", 0.0)!r}">'
        '<flag contact="disable" limit="disable"/></option>'
        "<default><geom contype='0' conaffinity='0' rgba='.3 .5 .8 1'/></default>"
        f"<worldbody><light pos='0 -2 3' dir='0 .5 -1'/>{bodies}</worldbody>"
        f"{tendons}<actuator>{actuators}</actuator></mujoco>"
    )
    return Scene(xml, np.asarray(joints, dtype=float))


Values = Mapping[str, float]
Parts = tuple[str, list[str], list[list[float]]]


def _hinge(name: str, axis: str, damping: float = 0.0) -> str:
    return f'<joint name="{name}" type="hinge" axis="{axis}" damping="{damping!r}"/>'


def _slide(name: str, axis: str, damping: float = 0.0, more: str = "") -> str:
    return f'<joint name="{name}" type="slide" axis="{axis}" damping="{damping!r}" {more}/>'


def _inertial(
    mass: float, moment: float, z: float = 0.0, y: float = 0.0, axial: float | None = None
) -> str:
    """Mass at (0, y, z), moments alike about all axes, or another one about the body's z."""
    J = max(moment, _THIN)
    K = J if axial is None else max(axial, _THIN)
    return f'<inertial pos="0 {y!r} {z!r}" mass="{mass!r}" diaginertia="{J!r} {J!r} {K!r}"/>'


def _bar(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> str:
    return f'<geom type="capsule" size=".01" fromto="0 0 0 {x!r} {y!r} {z!r}"/>'


def _link(name: str, p: Values, i: int, below: float, inner: str = "") -> str:
    """One link of an upright chain, with parameters m_i, J_i, a_i, b_i."""
    m, J, a, b = (p[f"{letter}_{i}"] for letter in "mJab")
    return (
        f'<body name="link_{i}" pos="0 0 {below!r}">{_hinge(name, "0 1 0", b)}'
        f"{_inertial(m, J, a)}{_bar(z=p.get(f'l_{i}', 2 * a))}{inner}</body>"
    )


def _cart(p: Values, inner: str, mass: float, damping: float) -> str:
    return (
        f'<body name="cart">{_slide("x", "1 0 0", damping)}{_inertial(mass, 1.0)}'
        f'<geom type="box" size=".08 .05 .03"/>{inner}</body>'
    )


def _rotary_pendulum(p: Values) -> Parts:
    m, l = p["m"], p["l"]  # noqa: E741
    rod = (
        f'<body name="pendulum" pos="{p["r_o"]!r} 0 0">{_hinge("phi", "1 0 0")}'
        f"{_inertial(m, m * l**2 / 3, l, axial=0.0)}{_bar(z=2 * l)}</body>"
    )
    arm = (
        f'<body name="arm">{_hinge("theta", "0 0 1", p["d_e"])}'
        f"{_inertial(1.0, p['I_e'])}{_bar(x=p['r_o'])}{rod}</body>"
    )
    return arm, [f'joint="theta" gear="{p["a_e"]!r}"'], [[1, 0], [0, 1]]


def _cart_pendulum(p: Values) -> Parts:
    rod = (
        f'<body name="pendulum">{_hinge("phi", "0 1 0", p["b_p"])}'
        f"{_inertial(p['m_p'], p['J_p'], p['l'])}{_bar(z=2 * p['l'])}</body>"
    )
    return _cart(p, rod, p["m_c"], p["b_c"]), ['joint="x"'], [[1, 0], [0, 1]]


def _overhead_crane(p: Values) -> Parts:
    # The load hangs: turning about −y takes it from −z towards +x.
    load = (
        f'<body name="load">{_hinge("theta", "0 -1 0", p["b_p"])}'
        f"{_inertial(p['m_p'], p['J_p'], -p['l'])}{_bar(z=-p['l'])}</body>"
    )
    return _cart(p, load, p["m_c"], p["b_c"]), ['joint="x"'], [[1, 0], [0, 1]]


def _two_links(p: Values) -> str:
    second = _link("q_2", p, 2, p["l_1"])
    return _link("q_1", p, 1, 0.0, second)


def _pendubot(p: Values) -> Parts:
    return _two_links(p), ['joint="q_1"'], [[1, 0], [0, 1]]


def _acrobot(p: Values) -> Parts:
    return _two_links(p), ['joint="q_2"'], [[0, 1], [1, 0]]


def _motor(p: Values) -> tuple[float, float, float]:
    """Gain, damping and rotor inertia at the joint of a drive named ``torque``."""
    ratio, efficiency = p["torque_K_g"], p["torque_eta_g"] * p["torque_eta_m"]
    gain = efficiency * ratio * p["torque_k_t"] / p["torque_R"]
    damping = p["torque_beta"] + gain * p["torque_k_m"] * ratio
    return gain, damping, p["torque_eta_g"] * ratio**2 * p["torque_J_m"]


def _reaction_wheel_pendulum(p: Values) -> Parts:
    gain, damping, rotor = _motor(p)
    wheel = (
        f'<body name="wheel" pos="0 0 {p["l_r"]!r}">'
        f'<joint name="psi" axis="0 1 0" damping="{p["b_r"] + damping!r}" armature="{rotor!r}"/>'
        f"{_inertial(p['m_r'], p['J_r'])}"
        '<geom type="cylinder" size=".05 .005" zaxis="0 1 0"/></body>'
    )
    pendulum = (
        f'<body name="pendulum">{_hinge("phi", "0 1 0", p["b_p"])}'
        f"{_inertial(p['m_p'], p['J_p'], p['l_p'])}{_bar(z=p['l_r'])}{wheel}</body>"
    )
    return pendulum, [f'joint="psi" gear="{gain!r}"'], [[0, 1], [1, 0]]


def _tora(p: Values) -> Parts:
    # At θ = 0 the proof mass points to −y, so that turning it about z moves it towards +x.
    proof = (
        f'<body name="proof">{_hinge("theta", "0 0 1", p["b_p"])}'
        f"{_inertial(p['m_p'], p['J_p'], y=-p['e'])}{_bar(y=-p['e'])}</body>"
    )
    spring = f'stiffness="{p["k"]!r}"'
    cart = (
        f'<body name="cart">{_slide("x", "1 0 0", p["b_c"], spring)}{_inertial(p["m_c"], 1.0)}'
        f'<geom type="box" size=".1 .1 .02"/>{proof}</body>'
    )
    return cart, ['joint="theta"'], [[0, 1], [1, 0]]


def _ball_and_beam(p: Values) -> Parts:
    rolling = f'armature="{p["J_b"] / p["R_b"] ** 2!r}"'
    ball = (
        f'<body name="ball">{_slide("r", "1 0 0", p["b_r"], rolling)}'
        f'{_inertial(p["m_b"], p["J_b"])}<geom size="{p["R_b"]!r}" pos="0 0 {p["R_b"]!r}"/></body>'
    )
    # Turning about −y lifts the +x end.
    beam = (
        f'<body name="beam">{_hinge("theta", "0 -1 0", p["b_t"])}{_inertial(1.0, p["J"])}'
        f'<geom type="box" size=".5 .02 .002"/>{ball}</body>'
    )
    return beam, ['joint="theta"'], [[1, 0], [0, 1]]


def _wheeled_inverted_pendulum(p: Values) -> Parts:
    # The axle slides by x = R (φ + ψ); the wheels' spin counts as mass that moves with it, and
    # the motors act on the tendon φ = x/R − ψ.
    gain, damping, rotor = _motor(p)
    R = p["R"]
    body = (
        f'<body name="body">{_hinge("psi", "0 1 0")}'
        f"{_inertial(p['m_b'], p['J_b'], p['l'])}{_bar(z=2 * p['l'])}</body>"
    )
    spin = f'armature="{2 * p["J_w"] / R**2!r}"'
    axle = (
        f'<body name="axle" pos="0 0 {R!r}">{_slide("x", "1 0 0", 0.0, spin)}'
        f'{_inertial(2 * p["m_w"], 1.0)}<geom type="cylinder" size="{R!r} .07" zaxis="0 1 0"/>'
        f"{body}</body>"
    )
    tendon = (
        f'<tendon><fixed name="phi" damping="{damping!r}" armature="{rotor!r}">'
        f'<joint joint="x" coef="{1 / R!r}"/><joint joint="psi" coef="-1"/></fixed></tendon>'
    )
    return f"{tendon}|{axle}", [f'tendon="phi" gear="{gain!r}"'], [[R, R], [0, 1]]


def _double_pendulum_on_a_cart(p: Values) -> Parts:
    second = _link("phi_2", p, 2, p["l_1"])
    first = _link("phi_1", p, 1, 0.0, second)
    joints: list[list[float]] = [[1, 0, 0], [0, 1, 0], [0, -1, 1]]
    return _cart(p, first, p["m_c"], p["b_c"]), ['joint="x"'], joints


def _triple_pendulum_on_a_cart(p: Values) -> Parts:
    third = _link("phi_3", p, 3, p["l_2"])
    second = _link("phi_2", p, 2, p["l_1"], third)
    first = _link("phi_1", p, 1, 0.0, second)
    joints: list[list[float]] = [[1, 0, 0, 0], [0, 1, 0, 0], [0, -1, 1, 0], [0, 0, -1, 1]]
    return _cart(p, first, p["m_c"], p["b_c"]), ['joint="x"'], joints


def _two_motor_three_link(p: Values) -> Parts:
    third = _link("q_3", p, 3, p["l_2"])
    second = _link("q_2", p, 2, p["l_1"], third)
    first = _link("q_1", p, 1, 0.0, second)
    return first, ['joint="q_2"', 'joint="q_3"'], [[0, 0, 1], [1, 0, 0], [0, 1, 0]]


def _gantry_crane(p: Values) -> Parts:
    load = (
        f'<body name="load">{_hinge("theta_x", "0 -1 0", p["b_p"])}'
        f"{_hinge('theta_y', '1 0 0', p['b_p'])}"
        f"{_inertial(p['m_p'], p['J_p'], -p['l'])}{_bar(z=-p['l'])}</body>"
    )
    trolley = (
        f'<body name="trolley">{_slide("y", "0 1 0", p["b_y"])}{_inertial(p["m_c"], 1.0)}'
        f'<geom type="box" size=".08 .08 .03"/>{load}</body>'
    )
    bridge = (
        f'<body name="bridge">{_slide("x", "1 0 0", p["b_x"])}{_inertial(p["m_r"], 1.0)}'
        f'<geom type="box" size=".03 1 .02"/>{trolley}</body>'
    )
    return bridge, ['joint="x"', 'joint="y"'], np.eye(4).tolist()


_SCENES: dict[str, Callable[[Values], Parts]] = {
    build.__name__[1:]: build
    for build in (
        _rotary_pendulum,
        _cart_pendulum,
        _overhead_crane,
        _pendubot,
        _acrobot,
        _reaction_wheel_pendulum,
        _tora,
        _ball_and_beam,
        _wheeled_inverted_pendulum,
        _double_pendulum_on_a_cart,
        _two_motor_three_link,
        _gantry_crane,
        _triple_pendulum_on_a_cart,
    )
}
