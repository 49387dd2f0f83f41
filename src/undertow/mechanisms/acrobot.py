"""The Acrobot: two links, the motor at the elbow, balanced upright.

Link 1 leans by q_1 from the upright and turns freely about the shoulder; the motor turns
link 2 by q_2 against link 1, so its torque acts on q_2 alone: the actuated coordinate, and
the first one here.
"""

from __future__ import annotations

import math

from undertow.mechanisms.chain import standing_links
from undertow.models import Input, Mechanism, Parameter

SPONG = "Spong, The swing up control problem for the Acrobot, IEEE Control Systems 15 (1995) 49"
DRAKE = "Drake, examples/acrobot (Russ Tedrake and the Drake Development Team)"


def acrobot(**values: float) -> Mechanism:
    """Return the Acrobot at its top position.

    Coordinates (q_2, q_1), rad, the elbow first; one input, the elbow torque, limited to ±30 N m.
    Parameters that ``values`` replace, SI units: ``m_1, m_2, l_1, a_1, a_2, J_1, J_2, b_1, b_2,
    g``.
    """
    parameters = (
        Parameter("m_1", 1.0, "kg", "mass of link 1", 0, math.inf, SPONG),
        Parameter("m_2", 1.0, "kg", "mass of link 2", 0, math.inf, SPONG),
        Parameter("l_1", 1.0, "m", "length of link 1", 0, math.inf, SPONG),
        Parameter("a_1", 0.5, "m", "joint to centre of link 1", 0, math.inf, SPONG),
        Parameter("a_2", 1.0, "m", "joint to centre of link 2", 0, math.inf, SPONG),
        Parameter("J_1", 0.083, "kg m²", "link 1 about its centre", 0, math.inf, SPONG),
        Parameter("J_2", 0.33, "kg m²", "link 2 about its centre", 0, math.inf, SPONG),
        Parameter("b_1", 0.1, "N m s/rad", "damping of the shoulder", -1e-12, math.inf, DRAKE),
        Parameter("b_2", 0.1, "N m s/rad", "damping of the elbow", -1e-12, math.inf, DRAKE),
        Parameter("g", 9.81, "m/s²", "gravity", 0, math.inf, "standard"),
    )
    return standing_links(
        "acrobot",
        {2: Input("torque", "N m", 30.0)},
        parameters,
        start={"q_1": math.radians(3), "q_2": math.radians(-3)},
        description="two links, the motor at the elbow, balanced upright (limit chosen)",
        source=SPONG,
    ).with_parameters(**values)
