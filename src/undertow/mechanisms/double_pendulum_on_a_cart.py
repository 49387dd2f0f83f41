"""The double pendulum on a cart: two links balanced upright by one force (n = 3, m = 1).

Links lean by φ_1 and φ_2 from the upright towards +x, both measured from the vertical.
"""

from __future__ import annotations

import math

from undertow.mechanisms.chain import links_on_a_cart
from undertow.models import Mechanism, Parameter

GRAICHEN = (
    "Graichen, Treuer, Zeitz, Swing-up of the double pendulum on a cart by feedforward and "
    "feedback control with experimental validation, Automatica 43 (2007) 63"
)


def double_pendulum_on_a_cart(**values: float) -> Mechanism:
    """Return the double pendulum on a cart.

    Coordinates (x, φ_1, φ_2), m and rad; one input, the force on the cart, limited to ±40 N.
    Parameters that ``values`` replace, SI units: ``m_c, m_1, m_2, l_1, a_1, a_2, J_1, J_2, b_c,
    b_1, b_2, g``.
    """
    parameters = (
        Parameter("m_c", 1.0, "kg", "mass of the cart", 0, math.inf, "chosen"),
        Parameter("m_1", 0.853, "kg", "mass of link 1", 0, math.inf, GRAICHEN),
        Parameter("m_2", 0.510, "kg", "mass of link 2", 0, math.inf, GRAICHEN),
        Parameter("l_1", 0.323, "m", "length of link 1", 0, math.inf, GRAICHEN),
        Parameter("a_1", 0.215, "m", "joint to centre of link 1", 0, math.inf, GRAICHEN),
        Parameter("a_2", 0.223, "m", "joint to centre of link 2", 0, math.inf, GRAICHEN),
        Parameter("J_1", 0.013, "kg m²", "link 1 about its centre", 0, math.inf, GRAICHEN),
        Parameter("J_2", 0.019, "kg m²", "link 2 about its centre", 0, math.inf, GRAICHEN),
        Parameter("b_c", 0.1, "N s/m", "damping of the cart", -1e-12, math.inf, "chosen"),
        Parameter("b_1", 0.005, "N m s/rad", "damping of joint 1", -1e-12, math.inf, GRAICHEN),
        Parameter("b_2", 0.005, "N m s/rad", "damping of joint 2", -1e-12, math.inf, GRAICHEN),
        Parameter("g", 9.81, "m/s²", "gravity", 0, math.inf, "standard"),
    )
    return links_on_a_cart(
        "double_pendulum_on_a_cart",
        40.0,
        parameters,
        start={"phi_1": math.radians(4), "phi_2": math.radians(4)},
        description="double pendulum on a cart (cart, limit and range chosen)",
        source=GRAICHEN,
    ).with_parameters(**values)
