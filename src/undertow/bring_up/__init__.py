"""Bring-up of a rig: what is wired wrongly, how late it is, what its parameters are.

:mod:`.wizard` goes through the steps, as ``undertow bench`` shows them: small motions
(:mod:`.motion`), signs and scales (:mod:`.wiring`), then parameters with confidence intervals
(:mod:`.identify`, by the least squares of :mod:`.fit`). :mod:`.faults` wires a simulated rig
wrongly.
"""

from undertow.bring_up.faults import Miswired, miswired, rubbing
from undertow.bring_up.identify import Estimate, Identification, identify
from undertow.bring_up.motion import GuardError, MotionRecord, doublets, perform, rest_state
from undertow.bring_up.wiring import Wiring, explain
from undertow.bring_up.wizard import BringUp, RigFinding, bring_up

__all__ = [
    "BringUp",
    "Estimate",
    "GuardError",
    "Identification",
    "Miswired",
    "MotionRecord",
    "RigFinding",
    "Wiring",
    "bring_up",
    "doublets",
    "explain",
    "identify",
    "miswired",
    "perform",
    "rest_state",
    "rubbing",
]
