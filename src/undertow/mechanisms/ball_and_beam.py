"""The ball and beam: the beam is turned, the ball rolls; the target is its centre, level.

The beam is tilted by θ; the ball sits at r from the pivot, up the slope for positive θ.
Energies, with the usual simplification that the ball's spin counts through r alone:

    T = ½ (J + J_b + m_b r²) θ̇² + ½ (m_b + J_b / R_b²) ṙ²,     V = m_b g r sin θ
"""

from __future__ import annotations

import math

import sympy as sp

from undertow.models import Coordinate, Input, Mechanism, Parameter

HAUSER = (
    "Hauser, Sastry, Kokotović, Nonlinear control via approximate input-output linearization: "
    "the ball and beam example, IEEE Trans. Automatic Control 37 (1992) 392"
)


def ball_and_beam(**values: float) -> Mechanism:
    """Return the ball and beam.

    Coordinates (θ, r), rad and m; one input, the torque on the beam, limited to ±0.5 N m.
    Parameters that ``values`` replace, SI units: ``m_b, R_b, J, J_b, b_t, b_r, g``.
    """
    parameters = (
        Parameter("m_b", 0.05, "kg", "mass of the ball", 0, math.inf, HAUSER),
        Parameter("R_b", 0.01, "m", "radius of the ball", 0, math.inf, HAUSER),
        Parameter("J", 0.02, "kg m²", "beam about its pivot", 0, math.inf, HAUSER),
        Parameter("J_b", 2e-6, "kg m²", "ball about its centre", 0, math.inf, HAUSER),
        Parameter("b_t", 0.01, "N m s/rad", "damping of the pivot", -1e-12, math.inf, "chosen"),
        Parameter("b_r", 0.001, "N s/m", "rolling drag", -1e-12, math.inf, "chosen"),
        Parameter("g", 9.81, "m/s²", "gravity", 0, math.inf, HAUSER),
    )
    m_b, R_b, J, J_b, b_t, b_r, g = (p.symbol for p in parameters)
    theta = Coordinate("theta", "rad", "tilt of the beam")
    r = Coordinate("r", "m", "ball from the pivot, up the slope for positive tilt", -0.5, 0.5)
    w, v = theta.velocity, r.velocity
    return Mechanism.from_energies(
        "ball_and_beam",
        [theta, r],
        [Input("torque", "N m", 0.5)],
        kinetic=(J + J_b + m_b * r.symbol**2) * w**2 / 2 + (m_b + J_b / R_b**2) * v**2 / 2,
        potential=m_b * g * r.symbol * sp.sin(theta.symbol),
        dissipation=b_t * w**2 / 2 + b_r * v**2 / 2,
        parameters=parameters,
        start={"r": 0.2},
        description="ball rolling on a beam that is turned (limit and range chosen)",
        source=HAUSER,
    ).with_parameters(**values)
