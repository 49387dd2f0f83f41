"""Three links with motors at the two upper joints, balanced upright (n = 3, m = 2).

A gymnast on a bar, or a leg on a free ankle: link 1 leans by q_1 from the upright and turns
freely about the fixed joint; motors turn link 2 by q_2 against link 1 and link 3 by q_3
against link 2, so that each torque acts on one coordinate.
"""

from __future__ import annotations

import math

from undertow.mechanisms.chain import standing_links
from undertow.models import Input, Mechanism, Parameter


def two_motor_three_link(**values: float) -> Mechanism:
    """Return the three-link robot with a passive first joint.

    Coordinates (q_2, q_3, q_1), rad; two inputs, the torques at joints 2 and 3, limited to ±30 N m
    and ±20 N m. All numbers are chosen: uniform rods of 1 kg and 0.5 m. Parameters that ``values``
    replace, SI units: ``m_1, m_2, m_3, l_1, l_2, a_1, a_2, a_3, J_1, J_2, J_3, b_1, b_2, b_3, g``.
    """
    inf = math.inf
    links = (1, 2, 3)
    parameters = (
        *(Parameter(f"m_{i}", 1.0, "kg", f"mass of link {i}", 0, inf, "chosen") for i in links),
        *(Parameter(f"l_{i}", 0.5, "m", f"length of link {i}", 0, inf, "chosen") for i in (1, 2)),
        *(
            Parameter(f"a_{i}", 0.25, "m", f"joint to centre of link {i}", 0, inf, "uniform rod")
            for i in links
        ),
        *(
            Parameter(
                f"J_{i}", 1 / 48, "kg m²", f"link {i} about its centre", 0, inf, "uniform rod"
            )
            for i in links
        ),
        *(
            Parameter(f"b_{i}", 0.02, "N m s/rad", f"damping of joint {i}", -1e-12, inf, "chosen")
            for i in links
        ),
        Parameter("g", 9.81, "m/s²", "gravity", 0, inf, "standard"),
    )
    return standing_links(
        "two_motor_three_link",
        {2: Input("torque_2", "N m", 30.0), 3: Input("torque_3", "N m", 20.0)},
        parameters,
        start={"q_1": math.radians(4), "q_2": math.radians(-6)},
        description="three links on a free joint, two motors, balanced upright (all chosen)",
        source="chosen",
    ).with_parameters(**values)
