"""The overhead crane: a trolley with a hanging load; a stable target.

A trolley of mass m_c moves along x; the load of mass m_p hangs at l below it and swings by θ
towards +x.  Energies:

    T = ½ (m_c + m_p) ẋ² + m_p l cos θ ẋ θ̇ + ½ (J_p + m_p l²) θ̇²,     V = −m_p g l cos θ
"""

from __future__ import annotations

import math

import sympy as sp

from undertow.models import Coordinate, Input, Mechanism, Parameter

FANG = (
    "trolley, load and rope of the laboratory crane in Fang, Dixon, Dawson, Zergeroglu, "
    "IEEE/ASME Trans. Mechatronics 8 (2003) 418"
)


def overhead_crane(**values: float) -> Mechanism:
    """Return the overhead crane.

    Coordinates (x, θ), m and rad; one input, the force on the trolley, limited to ±10 N. The target
    is the trolley at rest at x = 0 with the load hanging. Parameters that ``values`` replace, SI
    units: ``m_c, m_p, l, J_p, b_c, b_p, g``.
    """
    parameters = (
        Parameter("m_c", 1.06, "kg", "mass of the trolley", 0, math.inf, FANG),
        Parameter("m_p", 0.73, "kg", "mass of the load", 0, math.inf, FANG),
        Parameter("l", 0.7, "m", "rope: trolley to centre of the load", 0, math.inf, FANG),
        Parameter("J_p", 0.005, "kg m²", "load about its centre", -1e-12, math.inf, FANG),
        Parameter("b_c", 1.0, "N s/m", "damping of the trolley", -1e-12, math.inf, "chosen"),
        Parameter("b_p", 0.01, "N m s/rad", "damping of the swing", -1e-12, math.inf, "chosen"),
        Parameter("g", 9.81, "m/s²", "gravity", 0, math.inf, "standard"),
    )
    m_c, m_p, l, J_p, b_c, b_p, g = (p.symbol for p in parameters)  # noqa: E741
    x = Coordinate("x", "m", "trolley position", -1.5, 1.5)
    theta = Coordinate("theta", "rad", "swing of the load from the vertical, towards +x")
    v, w, s = x.velocity, theta.velocity, theta.symbol
    return Mechanism.from_energies(
        "overhead_crane",
        [x, theta],
        [Input("force", "N", 10.0)],
        kinetic=(m_c + m_p) * v**2 / 2
        + m_p * l * sp.cos(s) * v * w
        + (J_p + m_p * l**2) * w**2 / 2,
        potential=-m_p * g * l * sp.cos(s),
        dissipation=b_c * v**2 / 2 + b_p * w**2 / 2,
        parameters=parameters,
        start={"x": -0.5},
        description="overhead crane with a hanging load (limit and range chosen)",
        source=FANG,
    ).with_parameters(**values)
