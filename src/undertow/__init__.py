"""Undertow: optimal sliding-mode cascade control of underactuated mechanisms."""

# isort: off
import undertow.base  # noqa: F401 - first: Ctrl-C ends what follows, which takes a second

# isort: on
from math import radians as deg

from undertow import mechanisms
from undertow.cascade import Cascade, Run
from undertow.checks import MechanismReport, check_mechanism
from undertow.closed_loop import ClosedLoop, Event, Trajectory
from undertow.law import (
    Plan,
    ReachingLaw,
    SlidingModeLaw,
    Surface,
    check_surface,
    first_surface,
    placed_surface,
    surface_margins,
)
from undertow.models import Coordinate, Input, Mechanism, Parameter
from undertow.models import importers as modelling
from undertow.objective import (
    Constraint,
    MinimumEnergy,
    MinimumTime,
    Objective,
    objective_for,
    state_box,
)
from undertow.optimiser import Budget, DecisionVariables, Optimiser, Proposal

__all__ = [
    "Budget",
    "Cascade",
    "ClosedLoop",
    "Constraint",
    "Coordinate",
    "DecisionVariables",
    "Event",
    "Input",
    "Mechanism",
    "MechanismReport",
    "MinimumEnergy",
    "MinimumTime",
    "Objective",
    "Optimiser",
    "Parameter",
    "Plan",
    "Proposal",
    "ReachingLaw",
    "Run",
    "SlidingModeLaw",
    "Surface",
    "Trajectory",
    "check_mechanism",
    "check_surface",
    "deg",
    "first_surface",
    "mechanisms",
    "modelling",
    "objective_for",
    "placed_surface",
    "state_box",
    "surface_margins",
]
