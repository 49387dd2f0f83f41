"""What an optimisation of the surface may spend, and what it answers."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from undertow.base import (
    InfeasibleError,
    InvalidInputError,
    SingularSurfaceError,
    check_fields,
    checked_names,
)
from undertow.closed_loop import ClosedLoop, Event
from undertow.law import Margin, Plan, Surface, surface_margins
from undertow.models import FloatArray, Mechanism, in_degrees
from undertow.models.importers import holding_input, least_peak

Status = Literal["converged", "budget spent", "infeasible", "failed"]


#: How a search is given more to spend: in Python, and at the commands that have the option.
LARGER_BUDGET = (
    "search longer: cold=undertow.Budget(...) in Python, --evaluations of simulate and optimise"
)


@checked_names
@dataclass(frozen=True)
class Budget:
    """What one optimisation may spend; it returns its best answer when either is used up.

    Parameters
    ----------
    evaluations
        Rollouts.  With ``seconds`` infinite the answer depends on the seed alone.
    seconds
        Wall-clock time, s.
    """

    evaluations: int
    seconds: float = math.inf

    def __post_init__(self) -> None:
        """Refuse budgets that allow nothing."""
        check_fields(self)
        whole = isinstance(self.evaluations, int | np.integer) and self.evaluations >= 1
        if not whole or not self.seconds > 0:
            raise InvalidInputError(
                "budget of an optimisation",
                value=f"{self.evaluations} evaluations, {self.seconds} s",
                limit="at least 1 evaluation, whole, and more than 0 s",
                remedy="Budget(1024) is usual for a re-optimisation",
            )


@dataclass(frozen=True, eq=False)
class Proposal:
    """An answer of the optimiser, with what is needed to judge it.

    Attributes
    ----------
    plan
        The best plan found, ``None`` when there is none.
    status
        ``converged``, ``budget spent``, ``infeasible`` (no admissible surface) or
        ``failed`` (the optimiser raised; see ``message``).
    cost
        Predicted cost from ``x`` on; ``inf`` without an admissible surface.
    incumbent_cost
        Predicted cost of keeping the old surface; ``inf`` at the first optimisation.
    margins
        Signed margins of the surface and of its predicted motion, ≥ 0 is satisfied.  A
        re-optimisation that found a plan leaves them out, and so do the answers of
        :meth:`Optimiser.improve`: a gate judges for itself, and :func:`motion_margins` tells them.
    evaluations, seconds
        What it took.
    sequence
        Running number of the proposal.
    computed_for
        Time for which ``x`` was given, s.
    message, remedy
        What went wrong, and what could help, in words.
    confidence
        How likely no plan of the same kind costs over 1 % less, 0 to 1, from where searches from
        independent random starts ended, see :mod:`undertow.optimiser.confidence`.  ``None`` for
        a re-optimisation, for schedules, and where the budget allows fewer than two of these.
    """

    plan: Plan | None
    status: Status
    cost: float
    incumbent_cost: float
    margins: tuple[Margin, ...]
    evaluations: int
    seconds: float
    sequence: int
    computed_for: float
    message: str = ""
    remedy: str = ""
    confidence: float | None = None

    def __repr__(self) -> str:
        """Show the answer: the plan, its cost, how it was found, how sure that it is the best."""
        plan = self.message if self.plan is None else self.plan
        sure = "" if self.confidence is None else f"confidence {self.confidence:.0%}, "
        return (
            f"Proposal({self.status}, cost {self.cost:.6g}, {sure}"
            f"{self.evaluations} evaluations, {plan})"
        )

    @property
    def surface(self) -> Surface | None:
        """The first surface of the plan."""
        return None if self.plan is None else self.plan.surfaces[0]

    def required(self, loop: ClosedLoop, x: FloatArray) -> Proposal:
        """Return it as it is, or raise with the evidence where there is no plan from x, (2n,).

        Raises
        ------
        InfeasibleError
            When no candidate was admissible; says what the best of them broke.
        """
        if self.plan is None:
            check_held(loop)
            raise InfeasibleError(
                f"no admissible surface for '{loop.mechanism.name}' "
                f"({loop.objective.name}) among {self.evaluations}",
                value=self.message,
                limit="every margin ≥ 0 and the terminal set reached within "
                f"{loop.objective.horizon:g} s",
                remedy=in_degrees(loop.mechanism.coordinates, loop.mechanism.m, x)
                or _turned(loop.mechanism, x) + _too_far(loop, x) + self.remedy,
            )
        return self


def _turned(mechanism: Mechanism, x: FloatArray) -> str:
    """What to do where a free joint begins more than half a turn off, if a turn changes nothing."""
    for i, c in enumerate(mechanism.coordinates[mechanism.m :], mechanism.m):
        if c.unit == "rad" and abs(x[i]) > math.pi + 1e-6:
            states = np.random.default_rng(0).uniform(-1.0, 1.0, (4, 2 * mechanism.n))
            turned = states + 2 * math.pi * np.eye(2 * mechanism.n)[i]
            still = np.zeros((4, mechanism.m))
            before, after = (mechanism.accelerations(0.0, at, still) for at in (states, turned))
            if np.allclose(before, after, rtol=1e-9, atol=1e-9):
                given, nearer = math.degrees(x[i]), math.degrees(math.remainder(x[i], 2 * math.pi))
                return (
                    f"{c.name} = {given:.4g}° is {nearer:.4g}° but for a turn, which it would have "
                    "to undo: where it may turn freely, start there. "
                )
    return ""


def check_held(loop: ClosedLoop) -> None:
    """Refuse a target that the inputs cannot hold: no start comes home to stay.

    Raises InfeasibleError with the input, what it would have to be there, and its limit.
    """
    held = np.abs(holding_input(loop.mechanism))
    for given, u, limit in zip(loop.mechanism.inputs, held, loop.input_limits, strict=True):
        if u >= limit:
            raise InfeasibleError(
                f"input '{given.name}' that holds the target of '{loop.mechanism.name}'",
                value=f"{u:.3g} {given.unit}".rstrip(),
                limit=f"below its limit of {limit:.3g}",
                remedy="Choose a stronger actuator, or another target",
            )


def _too_far(loop: ClosedLoop, x: FloatArray) -> str:
    """What the linear model at the target needs from a start; empty where it has enough."""
    needed = least_peak(loop.mechanism, x)
    few = f"The linear model at the target needs {needed:.3g} times the inputs' limits from there. "
    return few if needed > 1 else ""


def motion_margins(
    loop: ClosedLoop, plan: Plan, x: FloatArray, horizon: float
) -> tuple[tuple[Margin, ...], str, str]:
    """Return the margins of a plan and of its predicted motion, how it ends, and a remedy."""
    objective = loop.objective
    try:
        margins = list(surface_margins(loop.mechanism, plan.surfaces[-1]))
    except SingularSurfaceError as error:
        return (), str(error), error.remedy
    batch = loop.with_steps(loop.step, 0.0).batch(x, plan, duration=horizon)
    what, least = "(37) along the motion: min det Γ(q)/det Γ(0)", float(batch.singular[0])
    margins.append(Margin(what, least, "", "Start closer to the target"))
    if objective.hard_input:
        margins.append(
            Margin(
                "(38) hard input limit: min u_max − |demand|",
                float(batch.input[0]),
                " or ".join(dict.fromkeys(i.unit for i in loop.mechanism.inputs)),
                "Raise the actuator limit, start closer to the target, lower η, or let the "
                "actuator clip (hard_input=False)",
            )
        )
    remedy = "Relax the constraint or start elsewhere"
    margins += [
        Margin(constraint.name, float(value), constraint.unit, remedy)
        for constraint, value in zip(objective.constraints, batch.path[0], strict=True)
    ]
    event = Event(int(batch.event[0]))
    broken = next((m for m in margins if not m.value >= 0), margins[-1])
    ending = {
        Event.REACHED: f"reaches the terminal set at {batch.time[0]:.3g} s",
        Event.HORIZON: f"is still at ‖x‖ = {batch.radius[0]:.3g} after {batch.time[0]:.3g} s",
        Event.UNSTABLE: "is unstable",
        Event.COSTLY: "costs too much",
        Event.DIVERGED: f"diverges at {batch.time[0]:.3g} s",
        Event.SINGULAR: f"meets the singularity (37) at {batch.time[0]:.3g} s",
        Event.CONSTRAINT: f"breaks '{broken.name}' by {-broken.value:.3g} {broken.unit}".rstrip()
        + f" at {batch.time[0]:.3g} s",
    }[event]
    remedy = {
        Event.HORIZON: f"Lengthen the horizon, widen the terminal set, or {LARGER_BUDGET}",
        Event.COSTLY: f"{LARGER_BUDGET[0].upper()}{LARGER_BUDGET[1:]}",
        Event.CONSTRAINT: broken.remedy,
    }.get(event, f"Start closer to the target, or {LARGER_BUDGET}")
    return tuple(margins), f"the best candidate {ending}", remedy
