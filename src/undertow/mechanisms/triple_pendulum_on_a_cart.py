"""The triple pendulum on a cart: three links balanced by one force (n = 4, m = 1).

Links lean by φ_1, φ_2, φ_3 from the upright towards +x, all measured from the vertical.
"""

from __future__ import annotations

import math

from undertow.mechanisms.chain import links_on_a_cart
from undertow.models import Mechanism, Parameter

GLUECK = (
    "Glück, Eder, Kugi, Swing-up control of a triple pendulum on a cart with experimental "
    "validation, Automatica 49 (2013) 801"
)


def triple_pendulum_on_a_cart(**values: float) -> Mechanism:
    """Return the triple pendulum on a cart.

    Coordinates (x, φ_1, φ_2, φ_3), m and rad; one input, the force on the cart, limited to ±100 N.
    Parameters that ``values`` replace, SI units: ``m_c, m_1, m_2, m_3, l_1, l_2, a_1, a_2, a_3,
    J_1, J_2, J_3, b_c, b_1, b_2, b_3, g``.
    """
    inf = math.inf
    parameters = (
        Parameter("m_c", 1.0, "kg", "mass of the cart", 0, inf, "chosen"),
        Parameter("m_1", 0.876, "kg", "mass of link 1", 0, inf, GLUECK),
        Parameter("m_2", 0.938, "kg", "mass of link 2", 0, inf, GLUECK),
        Parameter("m_3", 0.553, "kg", "mass of link 3", 0, inf, GLUECK),
        Parameter("l_1", 0.323, "m", "length of link 1", 0, inf, GLUECK),
        Parameter("l_2", 0.419, "m", "length of link 2", 0, inf, GLUECK),
        Parameter("a_1", 0.215, "m", "joint to centre of link 1", 0, inf, GLUECK),
        Parameter("a_2", 0.269, "m", "joint to centre of link 2", 0, inf, GLUECK),
        Parameter("a_3", 0.226, "m", "joint to centre of link 3", 0, inf, GLUECK),
        Parameter("J_1", 0.013, "kg m²", "link 1 about its centre", 0, inf, GLUECK),
        Parameter("J_2", 0.024, "kg m²", "link 2 about its centre", 0, inf, GLUECK),
        Parameter("J_3", 0.018, "kg m²", "link 3 about its centre", 0, inf, GLUECK),
        Parameter("b_c", 0.1, "N s/m", "damping of the cart", -1e-12, inf, "chosen"),
        Parameter("b_1", 0.002, "N m s/rad", "damping of joint 1", -1e-12, inf, "chosen"),
        Parameter("b_2", 0.002, "N m s/rad", "damping of joint 2", -1e-12, inf, "chosen"),
        Parameter("b_3", 0.002, "N m s/rad", "damping of joint 3", -1e-12, inf, "chosen"),
        Parameter("g", 9.81, "m/s²", "gravity", 0, inf, "standard"),
    )
    return links_on_a_cart(
        "triple_pendulum_on_a_cart",
        100.0,
        parameters,
        start={"phi_1": math.radians(1), "phi_2": math.radians(1), "phi_3": math.radians(1)},
        description="triple pendulum on a cart (cart, damping, limit and range chosen)",
        source=GLUECK,
    ).with_parameters(**values)
