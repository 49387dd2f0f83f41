"""The inverted pendulum on a cart, pushed by a force; the target is the upright.

A cart of mass m_c moves along x; a pendulum of mass m_p with its centre of mass at l leans
by φ from the upright towards +x.  Energies:

    T = ½ (m_c + m_p) ẋ² + m_p l cos φ ẋ φ̇ + ½ (J_p + m_p l²) φ̇²,     V = m_p g l cos φ
"""

from __future__ import annotations

import math

from undertow.mechanisms.chain import chain_energies
from undertow.models import Coordinate, Input, Mechanism, Parameter

CTMS = "University of Michigan, Control Tutorials for MATLAB and Simulink, Inverted Pendulum"


def cart_pendulum(**values: float) -> Mechanism:
    """Return the cart pendulum of the Control Tutorials.

    Coordinates (x, φ), m and rad; one input, the force on the cart, limited to ±20 N. Parameters
    that ``values`` replace, SI units: ``m_c, m_p, l, J_p, b_c, b_p, g``.
    """
    parameters = (
        Parameter("m_c", 0.5, "kg", "mass of the cart", 0, math.inf, CTMS),
        Parameter("m_p", 0.2, "kg", "mass of the pendulum", 0, math.inf, CTMS),
        Parameter("l", 0.3, "m", "joint to centre of mass", 0, math.inf, CTMS),
        Parameter("J_p", 0.006, "kg m²", "pendulum about its centre", -1e-12, math.inf, CTMS),
        Parameter("b_c", 0.1, "N s/m", "damping of the cart", -1e-12, math.inf, CTMS),
        Parameter("b_p", 0.001, "N m s/rad", "damping of the joint", -1e-12, math.inf, "chosen"),
        Parameter("g", 9.8, "m/s²", "gravity", 0, math.inf, CTMS),
    )
    m_c, m_p, l, J_p, b_c, b_p, g = (p.symbol for p in parameters)  # noqa: E741
    x = Coordinate("x", "m", "cart position", -1.5, 1.5)
    phi = Coordinate("phi", "rad", "lean of the pendulum from the upright, towards +x")
    v, w = x.velocity, phi.velocity
    link = {"m_1": m_p, "J_1": J_p, "a_1": l, "g": g}
    kinetic, potential = chain_energies(link, [phi.symbol], [w], v)
    return Mechanism.from_energies(
        "cart_pendulum",
        [x, phi],
        [Input("force", "N", 20.0)],
        kinetic=kinetic + m_c * v**2 / 2,
        potential=potential,
        dissipation=b_c * v**2 / 2 + b_p * w**2 / 2,
        parameters=parameters,
        start={"phi": math.radians(20)},
        description="inverted pendulum on a cart, driven by a force (limit and range chosen)",
        source=CTMS,
    ).with_parameters(**values)
