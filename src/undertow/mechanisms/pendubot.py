"""The Pendubot: two links, the motor at the shoulder, balanced upright.

Link 1 leans by q_1 from the upright, link 2 by q_2 against link 1.  A motor at the shoulder
turns link 1 against the frame, so its torque acts on q_1 alone.
"""

from __future__ import annotations

import math

from undertow.mechanisms.chain import standing_links
from undertow.models import Input, Mechanism, Parameter

PILCO = (
    "Deisenroth, McHutchon, Hall, Rasmussen, PILCO code v0.9, dynamics_pendubot.m and its scenario"
)


def pendubot(**values: float) -> Mechanism:
    """Return the Pendubot at its top position.

    Coordinates (q_1, q_2), rad; one input, the shoulder torque, limited to ±3.5 N m. Parameters
    that ``values`` replace, SI units: ``m_1, m_2, l_1, a_1, a_2, J_1, J_2, b_1, b_2, g``.
    """
    rod = "uniform rod"
    parameters = (
        Parameter("m_1", 0.5, "kg", "mass of link 1", 0, math.inf, PILCO),
        Parameter("m_2", 0.5, "kg", "mass of link 2", 0, math.inf, PILCO),
        Parameter("l_1", 0.5, "m", "length of link 1", 0, math.inf, PILCO),
        Parameter("a_1", 0.25, "m", "joint to centre of link 1", 0, math.inf, rod),
        Parameter("a_2", 0.25, "m", "joint to centre of link 2", 0, math.inf, rod),
        Parameter("J_1", 1 / 96, "kg m²", "link 1 about its centre", 0, math.inf, rod),
        Parameter("J_2", 1 / 96, "kg m²", "link 2 about its centre", 0, math.inf, rod),
        Parameter("b_1", 0.01, "N m s/rad", "damping of joint 1", -1e-12, math.inf, "chosen"),
        Parameter("b_2", 0.01, "N m s/rad", "damping of joint 2", -1e-12, math.inf, "chosen"),
        Parameter("g", 9.82, "m/s²", "gravity", 0, math.inf, PILCO),
    )
    return standing_links(
        "pendubot",
        {1: Input("torque", "N m", 3.5)},
        parameters,
        start={"q_1": math.radians(5), "q_2": math.radians(-5)},
        description="two links, the motor at the shoulder, balanced upright",
        source=PILCO,
    ).with_parameters(**values)
