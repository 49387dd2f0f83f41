"""Plans that are there without a search, and when one of them takes over."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache

import numpy as np

from undertow.closed_loop import INADMISSIBLE, ClosedLoop
from undertow.law import Plan, ReachingLaw, Surface
from undertow.models import FloatArray, Mechanism

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
                replace(law, eta=tuple((c * eta).tolist()), layer=tuple((c * layer).tolist()))
                for law, eta, layer in gains
            ),
        )
        for c in STRONGER
    )


def stiffer(plan: Plan, reaching: ReachingLaw) -> tuple[Plan, ...]:
    """Return a plan reached twice as fast, and so on up to the rates η/ε of ``reaching``."""
    m = plan.surfaces[0].m
    eta, layer = reaching.per_surface(m)
    laws = [(law, *law.per_surface(m)) for law in plan.laws(reaching)]
    most = max(float((eta / layer * wide / own).max()) for _, own, wide in laws)
    plans = []
    for k in range(1, 1 + math.ceil(math.log2(max(1.0, most)))):
        thin = [
            np.maximum(wide / 2.0**k, np.minimum(wide, own * layer / eta)) for _, own, wide in laws
        ]
        faster = zip(laws, thin, strict=True)
        plans.append(
            replace(
                plan,
                reaching=tuple(replace(law, layer=tuple(e.tolist())) for (law, _, _), e in faster),
            )
        )
    return tuple(plans)


@lru_cache(maxsize=32)
def _knocks(mechanism: Mechanism) -> FloatArray:
    """Velocities after an impulse on each coordinate that gives it 1 m/s or rad/s, by row."""
    inverse = np.linalg.inv(mechanism.M(np.zeros(mechanism.n)))
    return np.asarray((inverse / np.diag(inverse)).T)


def speed_of(mechanism: Mechanism, velocities: FloatArray) -> float:
    """The speed of the fastest coordinate after the impulses that velocities, (n,), come from.

    Of each impulse alone, at the target, m/s or rad/s.
    """
    return float(np.abs(np.linalg.solve(_knocks(mechanism).T, velocities)).max())


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

    def after_jump(
        self, loop: ClosedLoop, first: Plan, error: FloatArray
    ) -> tuple[tuple[float, Plan], ...]:
        """The plans to go on with when velocities have jumped, and up to which speed each does.

        One of these, or the first optimum, which may be reached more strongly, too: of those that
        bring home from most of the ``JUMPS`` at rest up to the next larger one, the cheapest for
        its own.  The plan in use is none of them: at rest that was chosen for hardly any cost, and
        what it does elsewhere nobody asked.  Speeds are those of :func:`speed_of`.
        """
        mechanism, n = loop.mechanism, loop.mechanism.n
        far = float(np.abs(error[:n]).max())
        if not far > 0:
            return ()
        speeds = mechanism.linearise().fastest * far * np.array(JUMPS)
        knock = _knocks(mechanism)
        knocks = np.zeros((len(JUMPS), 2 * n, 2 * n))
        knocks[:, :, n:] = speeds[:, None, None] * np.vstack([knock, -knock])
        plans = [*reversed(self.plans), *ever_stronger(first, self.reaching)]
        span, shape = loop.objective.horizon, (len(plans), len(JUMPS), 2 * n)
        scores = [loop.batch(knocks.reshape(-1, 2 * n), plan).score(span) for plan in plans]
        costs = np.reshape(scores, shape)
        lost = costs >= INADMISSIBLE
        chosen = []
        for k, speed in enumerate(speeds.tolist()):
            missed = lost[:, : k + 2].sum(axis=(1, 2))
            cost = np.where(lost[:, k], 0.0, costs[:, k]).sum(axis=1)
            best = min(range(len(plans)), key=lambda i: (missed[i], cost[i]))
            chosen.append((speed, plans[best]))
        return tuple(chosen)

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
