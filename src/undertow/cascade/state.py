"""What a cascade remembers between steps."""

from __future__ import annotations

import math
from dataclasses import dataclass

from undertow.estimators import ParameterEstimate
from undertow.law import Plan, ReferenceMotion, Surface
from undertow.models import FloatArray


@dataclass(frozen=True)
class CascadeState:
    """What the cascade remembers between steps.

    ``plan`` is in use since the time ``since``; ``sequence`` is the number of the last
    proposal considered; ``predicted`` is the predicted cost J̃_k at the last decision;
    ``scale`` that of the first; ``x`` the state at ``since``, empty where it is not known;
    ``estimate`` what is known of the plant's parameters, where the cascade learns them;
    ``target`` where the target is, where it is not at x = 0: ``x`` is counted from it;
    ``disturbance`` how large a matched disturbance is, in the inputs' units, (m,), where it is
    estimated; ``ahead`` what will be best for the estimate at the decision after the first, a plan
    from then on, which that begins with; ``after_jump`` what takes over when the velocities jump,
    by the speeds up to which it does, see :meth:`.Cascade.prepared`.
    """

    plan: Plan
    sequence: int = 0
    predicted: float = math.inf
    scale: float = 0.0
    since: float = 0.0
    x: tuple[float, ...] = ()
    estimate: ParameterEstimate | None = None
    target: ReferenceMotion | None = None
    disturbance: tuple[float, ...] = ()
    ahead: Plan | None = None
    after_jump: tuple[tuple[float, Plan], ...] = ()

    @property
    def surface(self) -> Surface:
        """The first surface of the plan in use."""
        return self.plan.surfaces[0]

    def at(self, t: float) -> Plan:
        """Return what is left of the plan in use at time t, s."""
        return self.plan.shifted(t - self.since)

    def error(self, t: float, x: FloatArray) -> FloatArray:
        """Return how far a state x, (…, 2n), is off the target at time t, s."""
        return x if self.target is None else x - self.target.state(t)

    def absolute(self, t: float, error: FloatArray) -> FloatArray:
        """Return the state that is so far off the target at time t, s: the inverse."""
        return error if self.target is None else error + self.target.state(t)


def as_numbers(x: FloatArray) -> tuple[float, ...]:
    """Return a state as plain numbers; several of them are none."""
    return tuple(x.tolist()) if x.ndim == 1 else ()
