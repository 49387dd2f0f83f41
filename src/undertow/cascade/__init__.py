"""The controller: law, optimiser and gate at two rates; robustness; swing-up and catch."""

from undertow.cascade.cascade import Cascade, CascadeState
from undertow.cascade.policy import Policy, policy
from undertow.cascade.robustness import derate_actuator, noise_share, robustness_gate
from undertow.cascade.simulation import Run, Update
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
