"""Undertow: optimal sliding-mode cascade control of underactuated mechanisms."""

from math import radians as deg

from undertow import mechanisms
from undertow.mechanism import Coordinate, Input, Mechanism, Parameter
from undertow.objective import Constraint, MinimumEnergy, MinimumTime, Objective, state_box
from undertow.rollout import ClosedLoop, Event, Trajectory
from undertow.sliding import ReachingLaw, SlidingModeLaw, Surface

__all__ = [
    "ClosedLoop",
    "Constraint",
    "Coordinate",
    "Event",
    "Input",
    "Mechanism",
    "MinimumEnergy",
    "MinimumTime",
    "Objective",
    "Parameter",
    "ReachingLaw",
    "SlidingModeLaw",
    "Surface",
    "Trajectory",
    "deg",
    "mechanisms",
    "state_box",
]
