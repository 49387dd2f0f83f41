"""Five mechanisms as a user writes them: energies, numbers and a start.

    undertow simulate examples/mechanisms.py:furuta
    undertow survey --only examples/mechanisms.py:ball_on_a_wheel

Nothing in the package was chosen with them in mind; ``python benchmarks/grid.py`` measures how
far from the optimal-control bound they stay.  Numbers without a source are chosen.
"""

from __future__ import annotations

import sympy as sp

import undertow as ut

G = 9.81  # m/s²


def _rotary(name: str, p: dict[str, float], torque: float, **rest: object) -> ut.Mechanism:
    """Arm turned by a motor, pendulum at its tip; θ of the arm, φ from the upright.

    ``arm`` and ``pendulum`` are moments of inertia about the motor's axis and about the pivot,
    kg m²; ``r`` the arm's length and ``l`` pivot to centre, m; ``d_1``, ``d_2`` N m s/rad.
    """
    parameters = tuple(ut.Parameter(key, value, UNITS[key], low=0) for key, value in p.items())
    arm, J, m, r, l, d_1, d_2 = (q.symbol for q in parameters)  # noqa: E741
    theta = ut.Coordinate("theta", "rad", "arm about the vertical")
    phi = ut.Coordinate("phi", "rad", "pendulum from the upright")
    a, v, w = phi.symbol, theta.velocity, phi.velocity
    return ut.Mechanism.from_energies(
        name, [theta, phi], [ut.Input("torque", "N m", torque)],
        kinetic=(arm + m * r**2 + J * sp.sin(a) ** 2) * v**2 / 2
        + m * r * l * sp.cos(a) * v * w + J * w**2 / 2,
        potential=m * G * l * sp.cos(a),
        dissipation=d_1 * v**2 / 2 + d_2 * w**2 / 2,
        parameters=parameters, **rest,
    )  # fmt: skip


UNITS = {
    "arm": "kg m²", "pendulum": "kg m²", "m": "kg", "r": "m", "l": "m",
    "d_1": "N m s/rad", "d_2": "N m s/rad",
}  # fmt: skip


def furuta() -> ut.Mechanism:
    """A Furuta pendulum driven by a torque of at most 0.45 N m.

    Numbers of acados' example ``furuta_pendulum`` (``furuta_model.py``).
    """
    pendulum = 7.653e-4 + 0.192 * 0.0955**2
    numbers = {
        "arm": 6.1375e-4, "pendulum": pendulum, "m": 0.192, "r": 0.1035, "l": 0.0955,
        "d_1": 4e-3, "d_2": 0.196 * pendulum,
    }  # fmt: skip
    return _rotary("furuta", numbers, 0.45, start={"phi": ut.deg(25)})


def qube() -> ut.Mechanism:
    """A Quanser QUBE-Servo 2 with its pendulum, driven by up to 10 V.

    Numbers of Quanser's ``qube2_rotpen_param.m``; the limit is chosen.
    """
    numbers = {
        "arm": 0.095 * 0.085**2 / 3, "pendulum": 0.024 * 0.129**2 / 3, "m": 0.024, "r": 0.085,
        "l": 0.0645, "d_1": 1.5e-3, "d_2": 5e-4,
    }  # fmt: skip
    motor = ut.modelling.DCMotor(
        torque_constant=0.042, resistance=8.4, rotor_inertia=4e-6, voltage_limit=10.0
    )
    rig = _rotary("qube", numbers, 1.0, start={"phi": ut.deg(20)})
    return ut.modelling.voltage_driven(rig, motor)


def long_short_pendubot() -> ut.Mechanism:
    """A pendubot whose second link is a third of the first: 0.6 m and 0.2 m, uniform rods."""
    q1 = ut.Coordinate("q1", "rad", "first link from the upright")
    q2 = ut.Coordinate("q2", "rad", "second link against the first")
    m1, m2, l1, l2, d = 0.9, 0.25, 0.6, 0.2, 0.02  # kg, m, N m s/rad
    a, b, v, w = q1.symbol, q1.symbol + q2.symbol, q1.velocity, q1.velocity + q2.velocity
    middle = (l1 * v) ** 2 + (l2 / 2 * w) ** 2 + l1 * l2 * sp.cos(q2.symbol) * v * w
    return ut.Mechanism.from_energies(
        "long_short_pendubot", [q1, q2], [ut.Input("torque", "N m", 6.0)],
        kinetic=m1 * (l1 * v) ** 2 / 6 + m2 * middle / 2 + m2 * (l2 * w) ** 2 / 24,
        potential=(m1 / 2 + m2) * G * l1 * sp.cos(a) + m2 * G * l2 / 2 * sp.cos(b),
        dissipation=d * v**2 / 2 + 1e-3 * q2.velocity**2 / 2,
        start={"q1": ut.deg(6), "q2": ut.deg(-8)},
    )  # fmt: skip


def ball_on_a_wheel() -> ut.Mechanism:
    """A solid rubber ball that rolls, without slip, on the rim of a wheel turned by a motor."""
    turn = ut.Coordinate("turn", "rad", "wheel")
    lean = ut.Coordinate("lean", "rad", "ball's centre from above the wheel's")
    m, r, R, J = 0.12, 0.03, 0.15, 0.012  # kg, m, m, kg m²: ball, wheel
    spin = ((R + r) * lean.velocity - R * turn.velocity) / r
    return ut.Mechanism.from_energies(
        "ball_on_a_wheel", [turn, lean], [ut.Input("torque", "N m", 0.6)],
        kinetic=J * turn.velocity**2 / 2 + m * ((R + r) * lean.velocity) ** 2 / 2
        + m * r**2 / 5 * spin**2,
        potential=m * G * (R + r) * sp.cos(lean.symbol),
        dissipation=2e-3 * turn.velocity**2 / 2 + 2e-4 * (lean.velocity - turn.velocity) ** 2 / 2,
        start={"lean": ut.deg(7)},
    )  # fmt: skip


def pendulum_on_an_inclined_rail() -> ut.Mechanism:
    """A uniform rod on a cart whose rail climbs by 15°; a counterweight over a pulley holds it."""
    x = ut.Coordinate("x", "m", "cart, up the rail", -0.6, 0.6)
    lean = ut.Coordinate("lean", "rad", "rod from the upright, towards the upper end")
    mc, mp, l, slope = 0.6, 0.2, 0.25, sp.pi / 12  # kg, kg, m to the rod's centre, rad  # noqa: E741
    weight = (mc + mp) * sp.sin(slope)  # sinks where the cart climbs
    v, w, a = x.velocity, lean.velocity, lean.symbol
    return ut.Mechanism.from_energies(
        "pendulum_on_an_inclined_rail", [x, lean], [ut.Input("force", "N", 8.0)],
        kinetic=(mc + mp + weight) * v**2 / 2 + mp * l * sp.cos(a + slope) * v * w
        + sp.Rational(2, 3) * mp * l**2 * w**2,
        potential=(mc + mp) * G * sp.sin(slope) * x.symbol - weight * G * x.symbol
        + mp * G * l * sp.cos(a),
        dissipation=0.5 * v**2 / 2,
        start={"lean": ut.deg(15)},
    )  # fmt: skip
