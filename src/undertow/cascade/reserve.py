"""Plans that are there without a search, and when one of them takes over."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache

import numpy as np

from undertow.closed_loop import INADMISSIBLE, ClosedLoop
from undertow.law import Plan, ReachingLaw, Surface
from undertow.models import FloatArray

#: How many times the reaching gains and layers of the plans in reserve are the cascade's: near the
#: target all are the same feedback, far from it each asks for more input before it saturates.
STRONGER = (1.0, 2.0, 4.0, 8.0)

#: Part of the time left in which a plan in reserve is to bring every plausible plant home, if
#: another is in use: what has to hurry in the end costs much more than what is mended sooner.
ROOM = 0.8

#: Impulses after which plans are compared, on each coordinate and either way: parts of what would
#: carry it, at the rate of the fastest mode, as far as the start is.  Few plans bear the
#: larger ones, which tell apart what bears much.
JUMPS = (0.25, 0.5, 1.0, 2.0, 4.0)


def ever_stronger(plan: Plan, reaching: ReachingLaw) -> tuple[Plan, ...]:
    """Return a plan with ``STRONGER`` times its reaching gains and layers, else ``reaching``'s."""
    m = plan.surfaces[0].m
    gains = [(law, *law.per_surface(m)) for law in plan.laws(reaching)]
    return tuple(
        replace(
            plan,
            reaching=tuple(
                replace(law, eta=tuple(c * eta), layer=tuple(c * layer))
                for law, eta, layer in gains
            ),
        )
        for c in STRONGER
    )


def stiffer(plan: Plan, reaching: ReachingLaw) -> tuple[Plan, ...]:
    """Return a plan with ever thinner layers, down to those of ``reaching`` for its gains."""
    if plan.reaching is None:
        return ()
    m = plan.surfaces[0].m
    eta, layer = reaching.per_surface(m)
    plans, rates = [], eta / layer
    for k in range(1, 1 + math.ceil(math.log2(max(1.0, float(rates.max()))))):
        laws = []
        for law in plan.reaching:
            own, wide = law.per_surface(m)
            thin = own / np.maximum(np.minimum(own / wide * 2.0**k, rates), own / wide)
            laws.append(replace(law, eta=tuple(own.tolist()), layer=tuple(thin.tolist())))
        if plans and tuple(laws) == plans[-1].reaching:
            break
        plans.append(replace(plan, reaching=tuple(laws)))
    return tuple(plans)


class Reserve:
    """The first surface, reached ever more strongly.

    It bears what it was designed for, and a large s brings its law to the limits of the input
    at once, where the cascade's own reaching law is content with η.

    Parameters
    ----------
    first
        The surface.
    reaching
        The cascade's law.
    period
        Time between two decisions, s.
    """

    def __init__(self, first: Surface, reaching: ReachingLaw, period: float) -> None:
        self.reaching, self.period = reaching, period
        self.plans = ever_stronger(Plan.of(first), reaching)
        self._better = lru_cache(maxsize=2)(self._compare)

    def better(
        self, loop: ClosedLoop, plan: Plan, error: FloatArray, span: float, sticks: bool,
        others: tuple[Plan, ...] = (),
    ) -> Plan | None:  # fmt: skip
        """The plan that is better than one in use, which may stick; ``None``: none is.

        A decision asks twice, for the search and for the gate: the latest answers are kept.
        """
        return self._better(loop, plan, error.tobytes(), span, sticks, others)

    def _compare(
        self, loop: ClosedLoop, plan: Plan, error: bytes, span: float, sticks: bool,
        others: tuple[Plan, ...],
    ) -> Plan | None:  # fmt: skip
        x = np.frombuffer(error).reshape(-1, 2 * loop.mechanism.n)
        if not sticks and loop.batch(x, plan, duration=span).score(span)[0] < INADMISSIBLE:
            return None
        plans = [plan, *others, *self.plans]
        scores = loop.batch(x, plans, duration=span).score(span)
        ranks = [(score >= INADMISSIBLE, False, score) for score in scores]
        ranks[0] = (scores[0] >= INADMISSIBLE, sticks, scores[0])
        best = min(range(len(ranks)), key=ranks.__getitem__)
        return plans[best] if best else None

    def after_jump(self, loop: ClosedLoop, first: Plan, error: FloatArray) -> Plan:
        """The plan to go on with when velocities have jumped: one of these, or the first optimum.

        That, too, may be reached more strongly.  It is the one that brings home from most of the
        ``JUMPS`` at rest, and of those the cheapest in sum.  The plan in use is none of them: at
        rest that was chosen for hardly any cost, and what it does elsewhere nobody asked.
        """
        mechanism, n = loop.mechanism, loop.mechanism.n
        far = float(np.abs(error[:n]).max())
        if not far > 0:
            return self.plans[-1]
        inverse = np.linalg.inv(mechanism.M(np.zeros(n)))
        jump = mechanism.linearise().fastest * far * (inverse / np.diag(inverse)).T
        knocks = np.zeros((2 * len(JUMPS) * n, 2 * n))
        knocks[:, n:] = np.vstack([sign * part * jump for part in JUMPS for sign in (1, -1)])
        plans = [*reversed(self.plans), *ever_stronger(first, self.reaching)]
        span = loop.objective.horizon
        ranks = []
        for plan in plans:
            scores = loop.batch(knocks, plan).score(span)
            lost = scores >= INADMISSIBLE
            ranks.append((int(lost.sum()), float(scores[~lost].sum())))
        return plans[min(range(len(plans)), key=ranks.__getitem__)]

    def recovers(self, loop: ClosedLoop, error: FloatArray, span: float, plan: Plan) -> bool:
        """Whether a plan may be in use as far as every plausible plant is concerned.

        One of these, after a period of the plan, brings them home: where a smooth cost uses all the
        time that there is, in ``ROOM`` of it; or the plan itself does.
        """
        then = [plan.followed_by(last, self.period, self.reaching) for last in self.plans]
        left = None if loop.price_of_time > 0 else ROOM * span
        return bool(
            loop.batch(error, then, duration=left).reached.any()
            or loop.batch(error, plan, duration=span).reached[0]
        )
