"""Plants that are all plausible, and what a plan is worth on them together.

A closed loop with an ensemble rolls every plan out on every member, in the lanes of one kernel,
and hands back one result for each plan, as if there were one plant: inadmissible on one member is
inadmissible, and the cost is a risk measure over the members.  Searches and gates need not know.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal, get_args

import numpy as np

from undertow.base import InvalidInputError, check_fields, floats, one_of
from undertow.closed_loop.trajectory import Event
from undertow.models import FloatArray, Mechanism
from undertow.symbolic import compiled

#: How the costs of a plan on the members count: their mean, the mean of the dearest third
#: (conditional value at risk), or the dearest.
Risk = Literal["mean", "cvar", "worst"]

#: The weight of the dearest members that a risk is the mean of; 0: the dearest alone.
TAIL: dict[Risk, float] = {"mean": 1.0, "cvar": 1.0 / 3.0, "worst": 0.0}


@dataclass(frozen=True, eq=False)
class Ensemble:
    """Plants of one structure, by their parameters.

    Parameters
    ----------
    plant
        Their structure; its own parameter values do not count.
    values
        Parameter values of the members, (K, P), SI units, in the order of
        ``plant.parameters``.
    risk
        ``"mean"``, ``"cvar"`` (mean of the dearest third) or ``"worst"`` of the costs.
    weights
        How much each member counts in the mean and in the dearest third, (K,), none negative; all
        alike by default.  A member without weight still has to arrive.
    surface_errors
        How far each member's surfaces are off the plan's, as a part of every entry, (K, 2mn); none
        by default.
    state_errors
        How far each member's initial state is off, (K, 2n); none by default.
    state_error_part
        Such an error is this part of the initial state's norm at most; infinite: it is as given.

    Raises
    ------
    InvalidInputError
        For values or weights of another shape, or that are not finite.
    """

    plant: Mechanism
    values: FloatArray
    risk: Risk = "mean"
    weights: FloatArray = field(default_factory=lambda: np.empty(0))
    surface_errors: FloatArray = field(default_factory=lambda: np.empty((0, 0)))
    state_errors: FloatArray = field(default_factory=lambda: np.empty((0, 0)))
    state_error_part: float = math.inf

    def __post_init__(self) -> None:
        """Check shapes and words."""
        check_fields(self)
        one_of("risk of an ensemble", self.risk, get_args(Risk))
        values = np.ascontiguousarray(self.values, dtype=float)
        names = [p.name for p in self.plant.parameters]
        if values.ndim != 2 or len(values) == 0 or values.shape[1] != len(names):
            raise InvalidInputError(
                f"members of an ensemble of '{self.plant.name}'",
                value=f"shape {values.shape}",
                limit=f"(at least 1, {len(names)}), in the order {', '.join(names)}",
            )
        if not np.isfinite(values).all():
            row, column = np.argwhere(~np.isfinite(values))[0]
            raise InvalidInputError(
                f"parameter '{names[column]}' of member {row} of an ensemble",
                value=values[row, column],
                limit="a finite number",
            )
        object.__setattr__(self, "values", values)
        weights = floats("weights of an ensemble", self.weights)
        good = weights.shape == (len(values),) and np.isfinite(weights).all()
        if len(weights) and not (good and (weights >= 0).all() and weights.sum() > 0):
            raise InvalidInputError(
                "weights of an ensemble",
                value=weights,
                limit=f"{len(values)} numbers ≥ 0, not all of them 0",
            )

        part = self.state_error_part
        if not part > 0:
            raise InvalidInputError("state_error_part of an ensemble", value=part, limit="> 0")
        n, m = self.plant.n, self.plant.m
        for name, size in (("surface_errors", 2 * m * n), ("state_errors", 2 * n)):
            errors = floats(f"{name} of an ensemble", getattr(self, name))
            if errors.size and not (
                errors.shape == (len(values), size) and np.isfinite(errors).all()
            ):
                raise InvalidInputError(
                    f"{name} of an ensemble",
                    value=f"shape {errors.shape}",
                    limit=f"({len(values)}, {size}), finite",
                )

    @cached_property
    def shares(self) -> FloatArray:
        """The weights, their sum 1, (K,)."""
        weights = self.weights if len(self.weights) else np.ones(len(self))
        return np.asarray(weights / weights.sum(), dtype=np.float64)

    @property
    def first(self) -> Ensemble:
        """The first member alone."""
        return replace(
            self,
            values=self.values[:1],
            weights=np.empty(0),
            surface_errors=self.surface_errors[:1],
            state_errors=self.state_errors[:1],
        )

    def __len__(self) -> int:
        """Return the number of members."""
        return len(self.values)


@compiled()
def summarise(member_out, weights, tail, margins, out):  # type: ignore[no-untyped-def]
    """Write one result for each plan from those of its members, row after row.

    Columns are those of the kernel: cost, time, event, radius, smallest margins, closest approach
    with its time and state, final state, steps.  All members must arrive; otherwise the result is
    that of the member that failed first, and only one that is merely late or dear counts as late
    or dear.  The closest approach is that of the member that stays farthest away, the final state
    that of the first member.  The cost is the mean of the dearest members, those that weigh
    ``tail`` together.
    """
    count, columns = out.shape
    members = len(weights)
    costs, times = np.empty(members), np.empty(members)
    for plan in range(count):
        first = plan * members
        worst, farthest, arrived = first, first, 0
        for k in range(members):
            row = first + k
            costs[k], times[k] = member_out[row, 0], member_out[row, 1]
            if int(member_out[row, 2]) == Event.REACHED:
                arrived += 1
            if _precedes(member_out[row], member_out[worst]):
                worst = row
            if member_out[row, 4 + margins] > member_out[farthest, 4 + margins]:
                farthest = row
        for column in range(columns):
            out[plan, column] = member_out[worst, column]
        if arrived == members:
            out[plan, 0] = _dearest(costs, weights, tail)
            out[plan, 1] = times[0]
            for k in range(1, members):
                out[plan, 1] = max(out[plan, 1], times[k])
        for column in range(4, 4 + margins):
            low = member_out[first, column]
            for k in range(1, members):
                low = min(low, member_out[first + k, column])
            out[plan, column] = low
        half = (columns - 7 - margins) // 2  # of a state: 2n
        for column in range(4 + margins, 6 + margins + half):
            out[plan, column] = member_out[farthest, column]
        for column in range(6 + margins + half, columns - 1):
            out[plan, column] = member_out[first, column]
        steps = 0.0
        for k in range(members):
            steps += member_out[first + k, columns - 1]
        out[plan, columns - 1] = steps


@compiled()
def _precedes(a, b):  # type: ignore[no-untyped-def]
    """Whether a member's result a stands for the plan rather than b.

    One that breaks off before one that is late or too dear, the earlier before the later; a late
    one before one that arrives, the farther before the nearer.
    """
    grade_a, grade_b = _grade(int(a[2])), _grade(int(b[2]))
    if grade_a != grade_b:
        return grade_a > grade_b
    if grade_a == 2:
        return a[1] < b[1]
    return a[3] > b[3]


@compiled()
def _grade(event):  # type: ignore[no-untyped-def]
    if event == Event.REACHED:
        return 0
    late = event == Event.HORIZON
    return 1 if late or event == Event.COSTLY else 2


@compiled()
def _dearest(costs, weights, tail):  # type: ignore[no-untyped-def]
    """Return the mean of the dearest members, those that weigh ``tail`` together.

    Found one by one: of a few members, and a sort of NumPy's takes a second to compile.
    """
    left, total = tail, 0.0
    counted = np.zeros(len(costs), dtype=np.bool_)
    for _ in range(len(costs)):
        k = -1
        for j in range(len(costs)):
            if not counted[j] and (k < 0 or costs[j] > costs[k]):
                k = j
        if tail <= 0.0:
            return costs[k]
        part = min(weights[k], left)
        total += part * costs[k]
        left -= part
        counted[k] = True
    return total / tail
