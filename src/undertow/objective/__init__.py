"""What is best: stage cost, horizon, terminal set and constraints; a word for each usual problem.

:class:`Objective` (:mod:`.objective`) takes a cost of your own; :mod:`.named` gives words a
meaning.
"""

from undertow.objective.named import USUAL, Goal, finite_limits, objective_for
from undertow.objective.objective import (
    TRAVEL,
    Constraint,
    MinimumEnergy,
    MinimumTime,
    Objective,
    check_travel,
    state_box,
)

__all__ = [
    "TRAVEL",
    "USUAL",
    "Constraint",
    "Goal",
    "MinimumEnergy",
    "MinimumTime",
    "Objective",
    "check_travel",
    "finite_limits",
    "objective_for",
    "state_box",
]
