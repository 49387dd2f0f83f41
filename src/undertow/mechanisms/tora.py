"""TORA, the translational oscillator with a rotating actuator (RTAC): a stable target.

A cart on a spring moves along x in the horizontal plane; a proof mass at eccentricity e turns
by θ on it.  Energies:

    T = ½ (m_c + m_p) ẋ² + m_p e cos θ ẋ θ̇ + ½ (J_p + m_p e²) θ̇²,     V = ½ k x²
"""

from __future__ import annotations

import math

import sympy as sp

from undertow.models import Coordinate, Input, Mechanism, Parameter

RTAC = (
    "Bupp, Bernstein, Coppola, A benchmark problem for nonlinear control design, "
    "Int. J. Robust Nonlinear Control 8 (1998) 307"
)


def tora(**values: float) -> Mechanism:
    """Return the TORA of the benchmark.

    Coordinates (θ, x), rad and m; one input, the torque on the proof mass, limited to ±0.1 N m; the
    cart's stroke is ±0.025 m. Parameters that ``values`` replace, SI units: ``m_c, m_p, J_p, e, k,
    b_c, b_p``.
    """
    parameters = (
        Parameter("m_c", 1.3608, "kg", "mass of the cart", 0, math.inf, RTAC),
        Parameter("m_p", 0.096, "kg", "mass of the proof mass", 0, math.inf, RTAC),
        Parameter("J_p", 0.0002175, "kg m²", "proof mass about its centre", 0, math.inf, RTAC),
        Parameter("e", 0.0592, "m", "eccentricity", 0, math.inf, RTAC),
        Parameter("k", 186.3, "N/m", "spring of the cart", 0, math.inf, RTAC),
        Parameter("b_c", 0.1, "N s/m", "damping of the cart", -1e-12, math.inf, "chosen"),
        Parameter("b_p", 1e-4, "N m s/rad", "damping of the axle", -1e-12, math.inf, "chosen"),
    )
    m_c, m_p, J_p, e, k, b_c, b_p = (p.symbol for p in parameters)
    theta = Coordinate("theta", "rad", "angle of the proof mass; 0 points across the cart's way")
    x = Coordinate("x", "m", "position of the cart", -0.025, 0.025)
    w, v = theta.velocity, x.velocity
    return Mechanism.from_energies(
        "tora",
        [theta, x],
        [Input("torque", "N m", 0.1)],
        kinetic=(m_c + m_p) * v**2 / 2
        + m_p * e * sp.cos(theta.symbol) * v * w
        + (J_p + m_p * e**2) * w**2 / 2,
        potential=k * x.symbol**2 / 2,
        dissipation=b_c * v**2 / 2 + b_p * w**2 / 2,
        parameters=parameters,
        start={"x": 0.02},
        description="cart on a spring, calmed by a rotating proof mass (RTAC)",
        source=RTAC,
    ).with_parameters(**values)
