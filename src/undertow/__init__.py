"""Undertow: optimal sliding-mode cascade control of underactuated mechanisms."""

from undertow.interrupt import at_once

at_once()

# ruff: noqa: E402 - what follows takes a second to import
from math import radians as deg

from undertow import mechanisms, modelling
from undertow.cascade import Cascade, Run
from undertow.check import MechanismReport, check_mechanism
from undertow.decision import Freedom
from undertow.mechanism import Coordinate, Input, Mechanism, Parameter
from undertow.motion import Event, Trajectory
from undertow.objective import Constraint, MinimumEnergy, MinimumTime, Objective, state_box
from undertow.objectives import objective_for
from undertow.optimiser import Optimiser
from undertow.plan import Plan
from undertow.proposal import Budget, Proposal
from undertow.rollout import ClosedLoop
from undertow.sliding import SlidingModeLaw
from undertow.stability import check_surface, first_surface, placed_surface, surface_margins
from undertow.surface import ReachingLaw, Surface

__all__ = [
    "Budget",
    "Cascade",
    "ClosedLoop",
    "Constraint",
    "Coordinate",
    "Event",
    "Freedom",
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
