"""The gantry crane with a load that swings both ways: a spherical pendulum (n = 4, m = 2).

The bridge moves along x with the trolley on it, the trolley along y; the load hangs at l on a
universal joint, swung by θ_x towards +x about the fixed axis, then by θ_y towards +y:

    p = (x + l sin θ_x cos θ_y,  y + l sin θ_y,  −l cos θ_x cos θ_y)

The load is a ball, so its spin adds ½ J_p (θ̇_x² + θ̇_y²): the joint's two axes are
perpendicular.
"""

from __future__ import annotations

import math

import sympy as sp

from undertow.models import Coordinate, Input, Mechanism, Parameter

FANG = (
    "Fang, Dixon, Dawson, Zergeroglu, Nonlinear coupling control laws for an underactuated "
    "overhead crane system, IEEE/ASME Trans. Mechatronics 8 (2003) 418"
)


def gantry_crane(**values: float) -> Mechanism:
    """Return the gantry crane.

    Coordinates (x, y, θ_x, θ_y), m and rad; two inputs, the forces on bridge and trolley, limited
    to ±30 N and ±10 N. The target is the load hanging at rest at x = y = 0. Parameters that
    ``values`` replace, SI units: ``m_r, m_c, m_p, l, J_p, b_x, b_y, b_p, g``.
    """
    parameters = (
        Parameter("m_r", 6.4, "kg", "mass of the bridge", 0, math.inf, FANG),
        Parameter("m_c", 1.06, "kg", "mass of the trolley", 0, math.inf, FANG),
        Parameter("m_p", 0.73, "kg", "mass of the load", 0, math.inf, FANG),
        Parameter("l", 0.7, "m", "rope: trolley to centre of the load", 0, math.inf, FANG),
        Parameter("J_p", 0.005, "kg m²", "load about its centre", 0, math.inf, FANG),
        Parameter("b_x", 4.0, "N s/m", "damping of the bridge", -1e-12, math.inf, "chosen"),
        Parameter("b_y", 1.0, "N s/m", "damping of the trolley", -1e-12, math.inf, "chosen"),
        Parameter("b_p", 0.01, "N m s/rad", "damping of the swing", -1e-12, math.inf, "chosen"),
        Parameter("g", 9.81, "m/s²", "gravity", 0, math.inf, "standard"),
    )
    m_r, m_c, m_p, l, J_p, b_x, b_y, b_p, g = (p.symbol for p in parameters)  # noqa: E741
    x = Coordinate("x", "m", "bridge position", -1.5, 1.5)
    y = Coordinate("y", "m", "trolley position", -1.5, 1.5)
    theta_x = Coordinate("theta_x", "rad", "swing towards +x")
    theta_y = Coordinate("theta_y", "rad", "swing towards +y")
    v_x, v_y = x.velocity, y.velocity
    s, c = theta_x.symbol, theta_y.symbol
    w_s, w_c = theta_x.velocity, theta_y.velocity
    # The load's velocity: v² with sin² + cos² = 1 used by hand keeps M short.
    swing_x = l * (sp.cos(s) * sp.cos(c) * w_s - sp.sin(s) * sp.sin(c) * w_c)
    swing_y = l * sp.cos(c) * w_c
    swing = l**2 * (sp.cos(c) ** 2 * w_s**2 + w_c**2)
    load = v_x**2 + v_y**2 + 2 * v_x * swing_x + 2 * v_y * swing_y + swing
    return Mechanism.from_energies(
        "gantry_crane",
        [x, y, theta_x, theta_y],
        [Input("force_x", "N", 30.0), Input("force_y", "N", 10.0)],
        kinetic=(m_r + m_c) * v_x**2 / 2
        + m_c * v_y**2 / 2
        + m_p * load / 2
        + J_p * (w_s**2 + w_c**2) / 2,
        potential=-m_p * g * l * sp.cos(s) * sp.cos(c),
        dissipation=b_x * v_x**2 / 2 + b_y * v_y**2 / 2 + b_p * (w_s**2 + w_c**2) / 2,
        parameters=parameters,
        start={"x": -0.5, "y": 0.3},
        description="gantry crane whose load swings both ways (limits and ranges chosen)",
        source=FANG,
    ).with_parameters(**values)
