"""The reaction-wheel pendulum: a motor at the tip spins a wheel; the target is the upright.

The pendulum leans by φ from the upright; the wheel turns by ψ against it, so that the motor's
torque acts on ψ alone.  Energies:

    T = ½ (J_p + m_p l_p² + m_r l_r²) φ̇² + ½ J_r (φ̇ + ψ̇)²,
    V = (m_p l_p + m_r l_r) g cos φ

Erratum: copies of the book's table are in circulation with J_p = 2.333e-4 kg m².  The same table
has the inertia about the pivot, J = J_p + m_p l_p² + m_r l_r² = 4.572e-3 kg m², which gives
2.233e-4, the value taken here; with the other, J would be 4.582e-3.
"""

from __future__ import annotations

import math

import sympy as sp

from undertow.models import Coordinate, Input, Mechanism, Parameter
from undertow.models.importers.drives import DCMotor, voltage_driven

BOOK = "Block, Åström, Spong, The Reaction Wheel Pendulum, Morgan & Claypool 2007"

#: Motor on the wheel's axle.
MOTOR = DCMotor(
    torque_constant=0.0274, resistance=12.1, voltage_limit=10.0, source=f"{BOOK}; limit chosen"
)


def reaction_wheel_pendulum(**values: float) -> Mechanism:
    """Return the reaction-wheel pendulum at its top position, driven by its motor's voltage.

    Coordinates (ψ, φ), rad; one input, the voltage, limited to ±10 V: 0.023 N m, enough to hold a
    lean of 3.7°. Parameters that ``values`` replace, SI units: ``m_p, m_r, l_p, l_r, J_p, J_r, b_p,
    b_r, g`` and the motor's ``torque_k_t, torque_R``, …
    """
    parameters = (
        Parameter("m_p", 0.2164, "kg", "mass of the pendulum", 0, math.inf, BOOK),
        Parameter("m_r", 0.0850, "kg", "mass of the wheel", 0, math.inf, BOOK),
        Parameter("l_p", 0.1173, "m", "pivot to centre of the pendulum", 0, math.inf, BOOK),
        Parameter("l_r", 0.1270, "m", "pivot to axle of the wheel", 0, math.inf, BOOK),
        Parameter("J_p", 2.233e-4, "kg m²", "pendulum about its centre", 0, math.inf, BOOK),
        Parameter("J_r", 2.495e-5, "kg m²", "wheel about its axle", 0, math.inf, BOOK),
        Parameter("b_p", 1e-4, "N m s/rad", "damping of the pivot", -1e-12, math.inf, "chosen"),
        Parameter("b_r", 1e-6, "N m s/rad", "damping of the axle", -1e-12, math.inf, "chosen"),
        Parameter("g", 9.81, "m/s²", "gravity", 0, math.inf, "standard"),
    )
    m_p, m_r, l_p, l_r, J_p, J_r, b_p, b_r, g = (p.symbol for p in parameters)
    psi = Coordinate("psi", "rad", "angle of the wheel against the pendulum")
    phi = Coordinate("phi", "rad", "lean of the pendulum from the upright")
    spin, lean = psi.velocity, phi.velocity
    swinging = J_p + m_p * l_p**2 + m_r * l_r**2
    rig = Mechanism.from_energies(
        "reaction_wheel_pendulum",
        [psi, phi],
        [Input("torque", "N m")],
        kinetic=swinging * lean**2 / 2 + J_r * (lean + spin) ** 2 / 2,
        potential=(m_p * l_p + m_r * l_r) * g * sp.cos(phi.symbol),
        dissipation=b_p * lean**2 / 2 + b_r * spin**2 / 2,
        parameters=parameters,
        start={"phi": math.radians(2)},
        description="pendulum balanced by a reaction wheel, voltage-driven",
        source=BOOK,
    )
    return voltage_driven(rig, MOTOR).with_parameters(**values)
