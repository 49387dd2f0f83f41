"""Objectives: stage cost, horizon, terminal set and constraints; names for the usual ones.

:class:`Objective` (:mod:`.objective`) takes a cost of your own; :mod:`.named` has those that
commands know by name.
"""

from undertow.objective.named import ERROR_PRICE, USUAL, Goal, finite_limits, objective_for
from undertow.objective.objective import (
    TRAVEL,
    Constraint,
    MinimumEnergy,
    MinimumTime,
    Objective,
    check_travel,
    range_words,
    state_box,
)

__all__ = [
    "ERROR_PRICE",
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
    "range_words",
    "state_box",
]
