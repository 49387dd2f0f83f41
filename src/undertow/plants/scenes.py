"""MuJoCo scenes of the library's mechanisms, from the same parameters.

Written by hand, body by body, and not from the derived equations: an independent engine can so
check them, and serve as a plant.  Contacts and joint stops are switched off.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from undertow.base import one_of, require
from undertow.mechanisms import LIBRARY
from undertow.models import FloatArray, Mechanism

#: MuJoCo refuses moments of inertia of exactly zero.
_THIN = 1e-14


@dataclass(frozen=True, eq=False)
class Scene:
    """An MJCF document and how its joints read the coordinates.

    The actuators of the document take the mechanism's inputs, in order. ``joints`` is the matrix P,
    (n, n), with ``qpos = P q`` and ``qvel = P q̇``: MuJoCo's joints are relative and in the order
    of the bodies.
    """

    xml: str
    joints: FloatArray


def mujoco_scene(mechanism: Mechanism) -> Scene:
    """Return the MuJoCo scene of a mechanism of the library, with its present parameters.

    Raises InvalidInputError for a mechanism that is not of the library, whatever it is called.
    """
    own = (
        "Bring an MJCF file of your own: undertow.modelling.from_mjcf(FILE), and "
        "MuJoCoRig(scene=FILE) or undertow run --rig FILE.xml"
    )
    one_of("MuJoCo scene", mechanism.name, _SCENES, own)
    known = LIBRARY[mechanism.name]()
    parts = ("q", "parameter_symbols", "mass_matrix", "force", "input_matrix")
    require(
        all(getattr(mechanism, part) == getattr(known, part) for part in parts),
        f"MuJoCo scene for '{mechanism.name}'",
        "a mechanism of that name with other equations",
        "the library's",
        own,
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


def _body(name: str, *parts: str, pos: str = "") -> str:
    where = f' pos="{pos}"' if pos else ""
    return f'<body name="{name}"{where}>{"".join(parts)}</body>'


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


def _box(size: str) -> str:
    return f'<geom type="box" size="{size}"/>'


def _link(name: str, p: Values, i: int, below: float, inner: str = "") -> str:
    """One link of an upright chain, with parameters m_i, J_i, a_i, b_i."""
    m, J, a, b = (p[f"{letter}_{i}"] for letter in "mJab")
    bar = _bar(z=p.get(f"l_{i}", 2 * a))
    hinge, pos = _hinge(name, "0 1 0", b), f"0 0 {below!r}"
    return _body(f"link_{i}", hinge, _inertial(m, J, a), bar, inner, pos=pos)


def _chain(p: Values, names: Sequence[str]) -> str:
    """An upright chain of links, the first one on the ground or on a cart."""
    inner = ""
    for i in range(len(names), 0, -1):
        inner = _link(names[i - 1], p, i, p[f"l_{i - 1}"] if i > 1 else 0.0, inner)
    return inner


def _cart(p: Values, inner: str) -> str:
    slide = _slide("x", "1 0 0", p["b_c"])
    return _body("cart", slide, _inertial(p["m_c"], 1.0), _box(".08 .05 .03"), inner)


def _rotary_pendulum(p: Values) -> Parts:
    m, l = p["m"], p["l"]  # noqa: E741
    inertia, pos = _inertial(m, m * l**2 / 3, l, axial=0.0), f"{p['r_o']!r} 0 0"
    rod = _body("pendulum", _hinge("phi", "1 0 0"), inertia, _bar(z=2 * l), pos=pos)
    joint, inertia = _hinge("theta", "0 0 1", p["d_e"]), _inertial(1.0, p["I_e"])
    arm = _body("arm", joint, inertia, _bar(x=p["r_o"]), rod)
    return arm, [f'joint="theta" gear="{p["a_e"]!r}"'], [[1, 0], [0, 1]]


def _cart_pendulum(p: Values) -> Parts:
    joint, inertia = _hinge("phi", "0 1 0", p["b_p"]), _inertial(p["m_p"], p["J_p"], p["l"])
    rod = _body("pendulum", joint, inertia, _bar(z=2 * p["l"]))
    return _cart(p, rod), ['joint="x"'], [[1, 0], [0, 1]]


def _overhead_crane(p: Values) -> Parts:
    # The load hangs: turning about −y takes it from −z towards +x.
    joint, inertia = _hinge("theta", "0 -1 0", p["b_p"]), _inertial(p["m_p"], p["J_p"], -p["l"])
    load = _body("load", joint, inertia, _bar(z=-p["l"]))
    return _cart(p, load), ['joint="x"'], [[1, 0], [0, 1]]


def _pendubot(p: Values) -> Parts:
    return _chain(p, ("q_1", "q_2")), ['joint="q_1"'], [[1, 0], [0, 1]]


def _acrobot(p: Values) -> Parts:
    return _chain(p, ("q_1", "q_2")), ['joint="q_2"'], [[0, 1], [1, 0]]


def _motor(p: Values) -> tuple[float, float, float]:
    """Gain, damping and rotor inertia at the joint of a drive named ``torque``."""
    ratio, efficiency = p["torque_K_g"], p["torque_eta_g"] * p["torque_eta_m"]
    gain = efficiency * ratio * p["torque_k_t"] / p["torque_R"]
    damping = p["torque_beta"] + gain * p["torque_k_m"] * ratio
    return gain, damping, p["torque_eta_g"] * ratio**2 * p["torque_J_m"]


def _reaction_wheel_pendulum(p: Values) -> Parts:
    gain, damping, rotor = _motor(p)
    wheel = _body(
        "wheel",
        f'<joint name="psi" axis="0 1 0" damping="{p["b_r"] + damping!r}" armature="{rotor!r}"/>',
        _inertial(p["m_r"], p["J_r"]),
        '<geom type="cylinder" size=".05 .005" zaxis="0 1 0"/>',
        pos=f"0 0 {p['l_r']!r}",
    )
    joint, inertia = _hinge("phi", "0 1 0", p["b_p"]), _inertial(p["m_p"], p["J_p"], p["l_p"])
    pendulum = _body("pendulum", joint, inertia, _bar(z=p["l_r"]), wheel)
    return pendulum, [f'joint="psi" gear="{gain!r}"'], [[0, 1], [1, 0]]


def _tora(p: Values) -> Parts:
    # At θ = 0 the proof mass points to −y, so that turning it about z moves it towards +x.
    joint, inertia = _hinge("theta", "0 0 1", p["b_p"]), _inertial(p["m_p"], p["J_p"], y=-p["e"])
    proof = _body("proof", joint, inertia, _bar(y=-p["e"]))
    slide = _slide("x", "1 0 0", p["b_c"], f'stiffness="{p["k"]!r}"')
    cart = _body("cart", slide, _inertial(p["m_c"], 1.0), _box(".1 .1 .02"), proof)
    return cart, ['joint="theta"'], [[0, 1], [1, 0]]


def _ball_and_beam(p: Values) -> Parts:
    slide = _slide("r", "1 0 0", p["b_r"], f'armature="{p["J_b"] / p["R_b"] ** 2!r}"')
    shape = f'<geom size="{p["R_b"]!r}" pos="0 0 {p["R_b"]!r}"/>'
    ball = _body("ball", slide, _inertial(p["m_b"], p["J_b"]), shape)
    # Turning about −y lifts the +x end.
    hinge, inertia = _hinge("theta", "0 -1 0", p["b_t"]), _inertial(1.0, p["J"])
    return (
        _body("beam", hinge, inertia, _box(".5 .02 .002"), ball),
        ['joint="theta"'],
        [[1, 0], [0, 1]],
    )


def _wheeled_inverted_pendulum(p: Values) -> Parts:
    # The axle slides by x = R (φ + ψ); the wheels' spin counts as mass that moves with it, and
    # the motors act on the tendon φ = x/R − ψ.
    gain, damping, rotor = _motor(p)
    R = p["R"]
    inertia = _inertial(p["m_b"], p["J_b"], p["l"])
    body = _body("body", _hinge("psi", "0 1 0"), inertia, _bar(z=2 * p["l"]))
    slide = _slide("x", "1 0 0", 0.0, f'armature="{2 * p["J_w"] / R**2!r}"')
    wheels = f'<geom type="cylinder" size="{R!r} .07" zaxis="0 1 0"/>'
    axle = _body("axle", slide, _inertial(2 * p["m_w"], 1.0), wheels, body, pos=f"0 0 {R!r}")
    tendon = (
        f'<tendon><fixed name="phi" damping="{damping!r}" armature="{rotor!r}">'
        f'<joint joint="x" coef="{1 / R!r}"/><joint joint="psi" coef="-1"/></fixed></tendon>'
    )
    return f"{tendon}|{axle}", [f'tendon="phi" gear="{gain!r}"'], [[R, R], [0, 1]]


def _double_pendulum_on_a_cart(p: Values) -> Parts:
    joints: list[list[float]] = [[1, 0, 0], [0, 1, 0], [0, -1, 1]]
    return _cart(p, _chain(p, ("phi_1", "phi_2"))), ['joint="x"'], joints


def _triple_pendulum_on_a_cart(p: Values) -> Parts:
    joints: list[list[float]] = [[1, 0, 0, 0], [0, 1, 0, 0], [0, -1, 1, 0], [0, 0, -1, 1]]
    return _cart(p, _chain(p, ("phi_1", "phi_2", "phi_3"))), ['joint="x"'], joints


def _two_motor_three_link(p: Values) -> Parts:
    joints: list[list[float]] = [[0, 0, 1], [1, 0, 0], [0, 1, 0]]
    return _chain(p, ("q_1", "q_2", "q_3")), ['joint="q_2"', 'joint="q_3"'], joints


def _gantry_crane(p: Values) -> Parts:
    hinges = _hinge("theta_x", "0 -1 0", p["b_p"]), _hinge("theta_y", "1 0 0", p["b_p"])
    load = _body("load", *hinges, _inertial(p["m_p"], p["J_p"], -p["l"]), _bar(z=-p["l"]))
    slide, inertia = _slide("y", "0 1 0", p["b_y"]), _inertial(p["m_c"], 1.0)
    trolley = _body("trolley", slide, inertia, _box(".08 .08 .03"), load)
    slide, inertia = _slide("x", "1 0 0", p["b_x"]), _inertial(p["m_r"], 1.0)
    bridge = _body("bridge", slide, inertia, _box(".03 1 .02"), trolley)
    return bridge, ['joint="x"', 'joint="y"'], np.eye(4).tolist()


_SCENES: dict[str, Callable[[Values], Parts]] = {
    "rotary_pendulum": _rotary_pendulum,
    "cart_pendulum": _cart_pendulum,
    "overhead_crane": _overhead_crane,
    "pendubot": _pendubot,
    "acrobot": _acrobot,
    "reaction_wheel_pendulum": _reaction_wheel_pendulum,
    "tora": _tora,
    "ball_and_beam": _ball_and_beam,
    "wheeled_inverted_pendulum": _wheeled_inverted_pendulum,
    "double_pendulum_on_a_cart": _double_pendulum_on_a_cart,
    "two_motor_three_link": _two_motor_three_link,
    "gantry_crane": _gantry_crane,
    "triple_pendulum_on_a_cart": _triple_pendulum_on_a_cart,
}
