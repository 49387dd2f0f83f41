"""Plans: which surface, reached how, from when on. One surface for all time, or a schedule.

The paper optimises one surface at a time and re-plans.  A plan may also hold several that
take over one after another (move blocking), each with a reaching law of its own, so that
switching is planned and not only re-planned.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Self

import numpy as np

from undertow.base import InvalidInputError, at_least, check_fields, checked, checked_names
from undertow.law.surface import ReachingLaw, Surface
from undertow.models import FloatArray


def rising_from_zero(times: Sequence[float]) -> bool:
    """Whether times begin at 0 and rise, all of them finite."""
    rising = all(a < b for a, b in pairwise(times))
    return len(times) > 0 and times[0] == 0 and rising and math.isfinite(times[-1])


@checked_names
@dataclass(frozen=True)
class Plan:
    """Surfaces that take over one after another.

    Parameters
    ----------
    surfaces
        One or more, in order.
    times
        When each takes over, s from the start of the plan; the first is 0, and they rise.
    reaching
        The reaching law of each; ``None``: that of the closed loop it is used in.

    Raises
    ------
    InvalidInputError
        When the lengths differ, or the times do not rise from 0.

    Examples
    --------
    >>> a, b = Surface(-1, -0.5, 5, 10), Surface(-1, -0.248, 1.94, 11.14)
    >>> plan = Plan((a, b), (0.0, 0.1))
    >>> plan.at(0.05) == (a, None), plan.shifted(0.1).surfaces == (b,)
    (True, True)
    """

    surfaces: tuple[Surface, ...]
    times: tuple[float, ...] = (0.0,)
    reaching: tuple[ReachingLaw, ...] | None = None

    def __post_init__(self) -> None:
        """Check lengths, times and shapes; keep tuples."""
        check_fields(self)
        object.__setattr__(self, "surfaces", tuple(self.surfaces))
        object.__setattr__(self, "times", tuple(map(float, self.times)))
        if self.reaching is not None:
            object.__setattr__(self, "reaching", tuple(self.reaching))
        shapes = {(s.n, s.m) for s in self.surfaces if isinstance(s, Surface)}
        if len(shapes) != 1 or not all(isinstance(s, Surface) for s in self.surfaces):
            raise InvalidInputError(
                "surfaces of a plan",
                value=[type(s).__name__ for s in self.surfaces],
                limit="one undertow.Surface or more, all with the same n and m",
                remedy="Build each with undertow.Surface(alpha_a, lambda_a, alpha_u, lambda_u)",
            )
        if not (len(self.times) == len(self.surfaces) and rising_from_zero(self.times)):
            raise InvalidInputError(
                "times of a plan",
                value=list(self.times),
                limit=f"{len(self.surfaces)} rising, finite times from 0, one for each surface",
                remedy="Give each surface the time at which it takes over",
            )
        if self.reaching is not None and len(self.reaching) != len(self.surfaces):
            raise InvalidInputError(
                "reaching laws of a plan",
                value=len(self.reaching),
                limit=f"{len(self.surfaces)}, one for each surface",
                remedy="Leave reaching out to use the closed loop's law throughout",
            )

    @classmethod
    @checked
    def of(cls, what: Surface | Plan | Sequence[Surface], times: Iterable[float] = (0.0,)) -> Plan:
        """Return a plan made of a surface, of several with their times, or as it is."""
        times = tuple(times)
        if isinstance(what, Plan):
            if times != (0.0,):
                raise InvalidInputError(
                    "plan with times besides",
                    value=list(times),
                    limit="a plan alone",
                    remedy="A plan has its own times: leave switch_times out",
                )
            return what
        surfaces = (what,) if isinstance(what, Surface) else tuple(what)
        return cls(surfaces, times)

    def _index(self, t: float) -> int:
        """Index of the surface in use at t; a nanosecond early counts as on time."""
        return max(0, int(np.searchsorted(self.times, t + 1e-9, side="right")) - 1)

    @checked
    def at(self, t: float) -> tuple[Surface, ReachingLaw | None]:
        """Return the surface in use t seconds after the start, and its reaching law."""
        k = self._index(t)
        return self.surfaces[k], None if self.reaching is None else self.reaching[k]

    @checked
    def shifted(self, t: float) -> Self:
        """Return what is left of the plan t seconds after its start."""
        k = self._index(t)
        if k == 0 and len(self.surfaces) == 1:
            return self
        times = (0.0, *(round(later - t, 9) for later in self.times[k + 1 :]))
        laws = None if self.reaching is None else self.reaching[k:]
        return replace(self, surfaces=self.surfaces[k:], times=times, reaching=laws)

    @checked
    def followed_by(self, other: Plan, t: float, otherwise: ReachingLaw) -> Self:
        """Return this plan until t > 0, s, and another one from then on.

        ``otherwise`` is the reaching law of those surfaces that have none.
        """
        k = sum(begin < t - 1e-9 for begin in self.times)
        return replace(
            self,
            surfaces=self.surfaces[:k] + other.surfaces,
            times=(*self.times[:k], *(round(t + later, 9) for later in other.times)),
            reaching=self.laws(otherwise)[:k] + other.laws(otherwise),
        )

    @staticmethod
    @checked
    def align(
        plans: Sequence[Plan], otherwise: ReachingLaw
    ) -> tuple[tuple[float, ...], FloatArray, FloatArray]:
        """Return common times (S), surface vectors (N, S, 2mn) and gains (N, S, 2m)."""
        at_least("number of plans", len(plans), 1, "Give at least one")
        times = tuple(sorted({t for plan in plans for t in plan.times}))
        rows = [(plan, [plan._index(t) for t in times]) for plan in plans]
        vectors = [plan.vectors[places] for plan, places in rows]
        gains = [plan.gains(otherwise)[places] for plan, places in rows]
        return times, np.array(vectors), np.array(gains)

    @property
    def vectors(self) -> FloatArray:
        """Surface vectors, (S, 2mn)."""
        return np.stack([surface.vector for surface in self.surfaces])

    @checked
    def laws(self, otherwise: ReachingLaw) -> tuple[ReachingLaw, ...]:
        """Return the reaching law of each surface, ``otherwise`` where none is given.

        Raises
        ------
        InvalidInputError
            For a law that switches by another function than ``otherwise``: a loop is compiled for
            one.
        """
        laws = self.reaching or (otherwise,) * len(self.surfaces)
        for law in laws:
            if law.switching != otherwise.switching:
                raise InvalidInputError(
                    "reaching laws of a plan",
                    value=f"one that switches by '{law.switching}'",
                    limit=f"'{otherwise.switching}' throughout, as what the plan is used in",
                    remedy=f"Give that reaching=ReachingLaw(switching='{law.switching}'), too",
                )
        return laws

    @checked
    def gains(self, otherwise: ReachingLaw) -> FloatArray:
        """Return η and ε of each surface, (S, 2m), with ``otherwise`` where none is given."""
        m = self.surfaces[0].m
        return np.stack([law.vector(m) for law in self.laws(otherwise)])
