"""Catch and hand-over: from the energy law to the sliding-mode law, and back if thrown out.

What counts in a swing-up is the hand-over: only from a state from which the law is *proved*
to bring the mechanism home, or else *predicted* to, with the clip and the end stops in place,
and from disturbed copies of that state too.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from undertow.base import InvalidInputError, UndertowError, require
from undertow.cascade.swing_up.attempts import Attempts, unclipped
from undertow.cascade.swing_up.law import SwingUp, periods
from undertow.closed_loop import ClosedLoop
from undertow.estimators import Estimator
from undertow.law import InnerLoop, ProvedSet, ReachingLaw, Surface, first_surface
from undertow.models import FloatArray, Mechanism
from undertow.objective import MinimumTime, state_box
from undertow.plants.simulated import IdealRig

#: What catches is home within this time, s, from so many disturbed copies of a state, too.
SECONDS, COPIES = 8.0, 7

#: Proves regions of attraction for some of a mechanism's surfaces under a reaching law.
Prove = Callable[[Mechanism, Sequence[Surface], ReachingLaw], Iterable[ProvedSet]]


class CatchRegion:
    """From where the sliding-mode law brings the mechanism home: proved, or else sampled.

    Inside a set that is proved for one of the surfaces that surface catches.  From elsewhere
    several surfaces are rolled out at once, from the state and from disturbed copies of it; a
    surface catches when all of its copies come home: no proof, but a prediction with a margin.

    Parameters
    ----------
    mechanism
        The controller's belief.
    surfaces
        Candidates; by default quadratic designs of several rates.
    reaching
        Reaching law.
    spread
        Standard deviations of the copies, (2n,), SI units: 0.01 rad or m, 0.1 rad/s or m/s by
        default.
    prove
        Called with mechanism, surfaces and reaching law: returns regions of attraction that are
        proved for some of the surfaces, as :func:`undertow.proofs.terminal_sets` does.  The
        first that holds a state counts.

    Raises
    ------
    InvalidInputError
        When the shape of ``spread`` does not fit, or a proved set is of another reaching law.
    """

    def __init__(
        self,
        mechanism: Mechanism,
        surfaces: Sequence[Surface] | None = None,
        *,
        reaching: ReachingLaw | None = None,
        spread: FloatArray | None = None,
        prove: Prove | None = None,
    ) -> None:
        n = mechanism.n
        self.mechanism = mechanism
        self.surfaces = tuple(surfaces or _candidates(mechanism))
        self.reaching = reaching or ReachingLaw()
        ranges = {
            c.name: 0.97 * min(-c.low, c.high)
            for c in mechanism.coordinates
            if 0 < min(-c.low, c.high) < math.inf
        }
        goal = replace(
            MinimumTime(horizon=SECONDS, terminal_radius=0.1), constraints=state_box(**ranges)
        )
        self.loop = ClosedLoop(mechanism, goal, self.reaching)
        if spread is None:
            spread = np.repeat([0.01, 0.1], n)
        limit = f"({2 * n},)"
        require(np.shape(spread) == (2 * n,), "spread of a catch region", np.shape(spread), limit)
        self.proved: tuple[ProvedSet, ...] = ()
        if prove is not None:
            self.proved = tuple(prove(mechanism, self.surfaces, self.reaching))
        if any(known.reaching != self.reaching for known in self.proved):
            raise InvalidInputError(
                "reaching law of a proved set",
                value=[known.reaching for known in self.proved],
                limit=f"{self.reaching}, the catch region's",
                remedy="Prove the set for the law that catches",
            )
        rng = np.random.default_rng(0)
        shifts = rng.standard_normal((COPIES, 2 * n)) * spread
        self._shifts = np.vstack([np.zeros(2 * n), shifts])
        self._vectors = np.repeat([s.vector for s in self.surfaces], COPIES + 1, axis=0)
        self._P, self._level, _ = unclipped(mechanism)
        self._periods = periods(mechanism)

    def turns(self, x: FloatArray) -> FloatArray:
        """Return whole turns of the freely turning joints, as a state to take off, (2n,)."""
        n, offset = self.mechanism.n, np.zeros(len(x))
        free = self._periods > 0
        offset[:n][free] = self._periods[free] * np.round(x[:n][free] / self._periods[free])
        return offset

    def worth_asking(self, x: FloatArray) -> bool:
        """Whether x, turns taken off, is within reach at all: a cheap test before the rollouts."""
        return bool(x @ self._P @ x <= 100.0 * self._level)

    def surface(self, x: FloatArray) -> Surface | None:
        """Return the surface that catches from x, turns taken off; ``None``: outside.

        Where nothing is proved it is the one that is predicted to be home soonest.
        """
        if not np.isfinite(x).all():
            return None
        for known in self.proved:
            if known.contains(x):
                return known.surface
        count = len(self._shifts)
        batch = self.loop.batch(np.tile(x + self._shifts, (len(self.surfaces), 1)), self._vectors)
        reached = batch.reached.reshape(-1, count).all(axis=1)
        if not reached.any():
            return None
        worst = np.where(reached, batch.time.reshape(-1, count).max(axis=1), math.inf)
        return self.surfaces[int(np.argmin(worst))]


#: Designs of the surfaces that catch: rate, weights of the driven positions, their velocities
#: and the free velocities; a free position weighs ten.  The first catch from furthest away.
DESIGNS = (
    (0.0, 0.001, 0.001, 1.0), (0.0, 0.01, 0.001, 0.1), (0.0, 1.0, 1.0, 1.0),
    (0.0, 1.0, 0.1, 0.1), (0.0, 0.1, 0.1, 0.1), (1.0, 0.1, 0.1, 0.1),
)  # fmt: skip


def _candidates(mechanism: Mechanism) -> list[Surface]:
    """Quadratic designs of several rates and weights, as far as they exist."""
    found: list[Surface] = []
    n, m = mechanism.n, mechanism.m
    for rate, place, speed, free in DESIGNS:
        weights = [place] * m + [10.0] * (n - m) + [speed] * m + [free] * (n - m)
        with contextlib.suppress(UndertowError):
            found.append(first_surface(mechanism, weights, rate))
    return found


@dataclass
class SwingUpAndCatch:
    """Swings up, hands over inside the catch region, goes back when thrown out.

    Parameters
    ----------
    swing, region
        The two halves.
    every
        Time between two tests of the region, s.
    patience
        Time after which a swing-up that has not led to a catch goes on with other gains, s.
    again
        Time between two looks ahead, s: with an estimator that learns, see :meth:`listen`.
    lost
        Free coordinates further than this from the target have been thrown out, rad or m.

    Attributes
    ----------
    events
        (t, "catch" or "lost") in order.
    """

    swing: SwingUp
    region: CatchRegion
    every: float = 0.005
    patience: float = 4.0
    again: float = 1.0
    lost: float = math.radians(60.0)
    events: list[tuple[float, str]] = field(default_factory=list)
    _law: InnerLoop | None = None
    _learning: Estimator | None = None
    _offset: FloatArray = field(default_factory=lambda: np.zeros(0), repr=False)
    _next: float = 0.0
    _look: float = 0.0
    _since: float | None = None
    _choice: int = 0

    def listen(self, estimator: Estimator) -> None:
        """Go by the parameters that an estimator learns, if it is for the same mechanism.

        They balance, and they say, every now and then, which gains bring home the plant that is
        there: no gains suit all plants, and on one that is a little heavier those that suit the
        model leave a second link hanging.
        """
        if estimator.belief is not None:
            same = estimator.mechanism.fingerprint == self.region.mechanism.fingerprint
            self._learning = estimator if same else None

    def __call__(self, t: float, x: FloatArray) -> FloatArray:
        """Return the input at (t, x), (1,)."""
        m, n = self.region.mechanism.m, self.region.mechanism.n
        if self._law is not None:
            home = x - self._offset
            if np.abs(home[m:n]).max() <= self.lost:
                return self._balanced(home)
            self._law, self._since = None, None
            self.events.append((t, "lost"))
        if self._since is None:
            self._since = t
        self._choose(t, self._since, x)
        offset = self.region.turns(x)
        if t >= self._next and self.worth_asking(x):
            self._next = t + self.every
            surface = self.region.surface(x - offset)
            if surface is not None:
                self._law = InnerLoop(self.region.mechanism, surface, self.region.reaching)
                self._offset = offset
                self.events.append((t, "catch"))
                return self._balanced(x - offset)
        return self.swing(x, self._choice)

    def _choose(self, t: float, since: float, x: FloatArray) -> None:
        """Go on with the next gains after a while in vain, or with others that arrive sooner.

        What is to arrive is left alone until it should have.
        """
        tired = t - since > self.patience
        choice = self._choice + tired
        if self._learning is not None and (tired or t >= self._look):
            self._look = t + self.again
            choice = self.choice(x, self._choice, self._learning.parameters, tired=tired)
        if tired or choice != self._choice:
            self._since, self._choice = t, choice

    def choice(
        self, x: FloatArray, used: int, parameters: FloatArray, *, tired: bool = False
    ) -> int:
        """Return which gains to go on with from x, (2n,), on a plant with these parameters, (P,).

        Those in use, unless they do not arrive from there and others do: then the soonest.  When
        ``tired`` those in use were to arrive by now, if at all, and the next ones come in turn.
        """
        gains = self.swing.gains
        times = self._attempts.times(gains, x - self.region.turns(x), parameters)
        if tired:
            times[used % len(gains)] = math.inf
        if math.isfinite(times[used % len(gains)]) or not np.isfinite(times).any():
            return used + tired
        return int(np.argmin(times))

    @cached_property
    def _attempts(self) -> Attempts:
        return Attempts(self.region.mechanism)

    def _balanced(self, home: FloatArray) -> FloatArray:
        """Return the input of the law, with what has been learnt by now, (1,)."""
        assert self._law is not None  # it was asked for
        if self._learning is not None:
            self._law.believe(self._learning.parameters, home)
        return self._law(home)

    def worth_asking(self, x: FloatArray) -> bool:
        """Whether a catch from x is worth the rollouts that answer it: a cheap test."""
        m, n = self.region.mechanism.m, self.region.mechanism.n
        home = x - self.region.turns(x)
        return bool(np.abs(home[m:n]).max() <= 0.8 * self.lost) and self.region.worth_asking(home)

    def ahead(self, x: FloatArray, seconds: float, choice: int = 0) -> FloatArray:
        """Return where the swing-up, with one choice of its gains, brings x in a while, (2n,)."""
        rig = IdealRig(self.region.mechanism, x)
        for _ in range(round(seconds / rig.period)):
            rig.write(self.swing(rig.truth, choice))
        return rig.truth

    @property
    def balancing(self) -> bool:
        """Whether the law is in charge."""
        return self._law is not None

    @property
    def offset(self) -> FloatArray:
        """Whole turns that count as the target, (2n,)."""
        return self._offset if self.balancing else np.zeros(2 * self.region.mechanism.n)
