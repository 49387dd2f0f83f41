"""The cascade: the law inside, the optimiser outside, a gate between; and swing-up before it.

Begin at :class:`Cascade` (:mod:`.cascade`), which remembers a :class:`CascadeState`. What it
predicts with is in :mod:`.predictions`, whom it asks for plans in :mod:`.planners`, how in
:mod:`.planning`; :mod:`.judge` decides what is admitted, and falls back on :mod:`.reserve`. What a
simulated run is made of is in :mod:`.simulation`, targets that lie elsewhere in :mod:`.targets`;
:mod:`.robustness` asks what delay and noise a surface bears, :mod:`.swing_up` brings the mechanism
up first.
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
