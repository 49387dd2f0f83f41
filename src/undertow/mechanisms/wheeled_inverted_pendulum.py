"""The wheeled inverted pendulum (Segway-like), in its plane: two wheels in step, voltage-driven.

The body leans by ψ from the upright; the wheels have turned by θ and roll without slip.  The
motors sit on the body and turn the wheels *against* it, so that their torque acts on
φ = θ − ψ alone: the actuated coordinate.  With x = R θ, two wheels of mass m_w:

    T = m_w ẋ² + J_w θ̇² + ½ m_b (ẋ² + 2 ẋ l cos ψ ψ̇ + l² ψ̇²) + ½ J_b ψ̇²,   V = m_b g l cos ψ

and the rotors' 2 J_m φ̇² / 2, back-EMF and friction come with the drive.
"""

from __future__ import annotations

import math

import sympy as sp

from undertow.models import Coordinate, Input, Mechanism, Parameter
from undertow.models.importers.drives import DCMotor, voltage_driven

NXT = "Yamamoto, NXTway-GS Model-Based Design, MATLAB Central File Exchange 19147 (2008)"

#: Both motors at one voltage: half the resistance, twice the friction and rotor.
MOTORS = DCMotor(
    torque_constant=0.317,
    back_emf_constant=0.468,
    resistance=6.69 / 2,
    viscous_friction=2 * 0.0022,
    rotor_inertia=2 * 1e-5,
    voltage_limit=8.0,
    source=f"{NXT}, two motors in parallel; limit chosen for its battery",
)


def wheeled_inverted_pendulum(**values: float) -> Mechanism:
    """Return the NXTway-GS robot in its plane.

    Coordinates (φ, ψ), rad; one input, the voltage of both motors, limited to ±8 V. Parameters that
    ``values`` replace, SI units: ``m_b, m_w, R, l, J_b, J_w, g`` and the motors' ``torque_k_t,
    torque_R``, …
    """
    parameters = (
        Parameter("m_b", 0.6, "kg", "mass of the body", 0, math.inf, NXT),
        Parameter("m_w", 0.03, "kg", "mass of one wheel", 0, math.inf, NXT),
        Parameter("R", 0.04, "m", "radius of the wheels", 0, math.inf, NXT),
        Parameter("l", 0.072, "m", "axle to centre of the body", 0, math.inf, NXT),
        Parameter("J_b", 0.0010368, "kg m²", "body about its centre, m_b l²/3", 0, math.inf, NXT),
        Parameter("J_w", 2.4e-5, "kg m²", "one wheel, m_w R²/2", 0, math.inf, NXT),
        Parameter("g", 9.81, "m/s²", "gravity", 0, math.inf, NXT),
    )
    m_b, m_w, R, l, J_b, J_w, g = (p.symbol for p in parameters)  # noqa: E741
    phi = Coordinate("phi", "rad", "turn of the wheels against the body")
    psi = Coordinate("psi", "rad", "lean of the body from the upright, forwards")
    lean = psi.velocity
    wheel = phi.velocity + lean
    v = R * wheel
    rig = Mechanism.from_energies(
        "wheeled_inverted_pendulum",
        [phi, psi],
        [Input("torque", "N m")],
        kinetic=m_w * v**2
        + J_w * wheel**2
        + m_b * (v**2 + 2 * v * l * sp.cos(psi.symbol) * lean + l**2 * lean**2) / 2
        + J_b * lean**2 / 2,
        potential=m_b * g * l * sp.cos(psi.symbol),
        parameters=parameters,
        start={"psi": math.radians(8)},
        description="two-wheeled balancing robot in its plane, voltage-driven",
        source=NXT,
    )
    return voltage_driven(rig, MOTORS).with_parameters(**values)
