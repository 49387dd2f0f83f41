"""The cascade: the law inside, the optimiser outside, a gate between; and swing-up before it.

Begin at :class:`Cascade` (:mod:`.cascade`), whose memory is a :class:`CascadeState`. It predicts
with :mod:`.predictions` and obtains plans from :mod:`.planners`, by way of :mod:`.planning`;
:mod:`.judge` decides what is admitted, and falls back on :mod:`.reserve`. Simulated runs are in
:mod:`.simulation`, targets other than x = 0 in :mod:`.targets`, the delay and noise that a surface
bears in :mod:`.robustness`, swing-up in :mod:`.swing_up`.
"""

from undertow.cascade.cascade import Cascade
from undertow.cascade.policy import Policy, policy
from undertow.cascade.robustness import derate_actuator, noise_share, robustness_gate
from undertow.cascade.simulation import Run, Update
from undertow.cascade.state import CascadeState
from undertow.cascade.targets import Legs, legs_of
from undertow.closed_loop.gate import Admission, Gate, cost_gate, gate_words, problem_words

__all__ = [
    "Admission",
    "Cascade",
    "CascadeState",
    "Gate",
    "Legs",
    "Policy",
    "Run",
    "Update",
    "cost_gate",
    "derate_actuator",
    "gate_words",
    "legs_of",
    "noise_share",
    "policy",
    "problem_words",
    "robustness_gate",
]
