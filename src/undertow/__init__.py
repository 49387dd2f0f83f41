"""Undertow: optimal sliding-mode cascade control of underactuated mechanisms.

>>> import undertow as ut
>>> rig = ut.mechanisms.rotary_pendulum()
>>> run = ut.Cascade(rig, ut.MinimumTime()).simulate(phi=ut.deg(20))
>>> run.reached
True

``run.plot()``, ``run.animate(path)`` and ``run.trajectory`` show it; :func:`bound`,
:func:`certify`, :func:`verify`, :func:`export_c`, :func:`run` and :func:`compare` go on from there.
"""

# isort: off
import undertow.base  # noqa: F401 - first: Ctrl-C ends what follows, which takes a second

# isort: on
from importlib import import_module
from typing import TYPE_CHECKING, Any

from undertow import mechanisms
from undertow.cascade import Cascade, Policy, Run, policy
from undertow.checks import MechanismReport, check_mechanism
from undertow.closed_loop import ClosedLoop, Event, Trajectory
from undertow.estimators import Belief
from undertow.law import (
    Plan,
    ReachingLaw,
    Reference,
    SetPoints,
    SlidingModeLaw,
    Surface,
    check_surface,
    first_surface,
    placed_surface,
    surface_margins,
)
from undertow.models import Coordinate, Input, Mechanism, Parameter, deg
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

if TYPE_CHECKING:
    from undertow.bounds import bound
    from undertow.display.derivation import derivation
    from undertow.export import environment, export_c, loop_margins, nlsys, vector_environment
    from undertow.runtime import replay, run
    from undertow.studies.certification import certify, verify
    from undertow.studies.trials.compare import compare, lqr, nmpc

#: What takes longer to import than most need it: name to package, imported when first asked for.
_LATER = {
    "bound": "bounds",
    "certify": "studies.certification",
    "compare": "studies.trials.compare",
    "derivation": "display.derivation",
    "environment": "export",
    "export_c": "export",
    "loop_margins": "export",
    "lqr": "studies.trials.compare",
    "nlsys": "export",
    "nmpc": "studies.trials.compare",
    "replay": "runtime",
    "run": "runtime",
    "vector_environment": "export",
    "verify": "studies.certification",
}

__all__ = [
    "Belief",
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
    "Policy",
    "Proposal",
    "ReachingLaw",
    "Reference",
    "Run",
    "SetPoints",
    "SlidingModeLaw",
    "Surface",
    "Trajectory",
    "bound",
    "certify",
    "check_mechanism",
    "check_surface",
    "compare",
    "deg",
    "derivation",
    "environment",
    "export_c",
    "first_surface",
    "loop_margins",
    "lqr",
    "mechanisms",
    "modelling",
    "nlsys",
    "nmpc",
    "objective_for",
    "placed_surface",
    "policy",
    "replay",
    "run",
    "state_box",
    "surface_margins",
    "vector_environment",
    "verify",
]


def __getattr__(name: str) -> Any:
    """Import what is not needed at once when it is first asked for."""
    if name not in _LATER:
        raise AttributeError(f"module 'undertow' has no attribute {name!r}", name=name)
    found = getattr(import_module(f"undertow.{_LATER[name]}"), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    """List what there is for tab completion, imported or not."""
    return sorted({*globals(), *__all__})
