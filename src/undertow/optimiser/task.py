"""One running optimisation of the surface: the best plan so far at any moment.

A population search over the coordinates of :mod:`undertow.optimiser.search_space`.  Unstable
surfaces are not rolled out; inadmissible motions get a graded penalty, see
:meth:`undertow.closed_loop.trajectory.Batch.score`.  A global search first improves the best of
some quadratic designs, which is an answer already, and then looks elsewhere: for a smooth cost by
descents from the best of many draws, for the time of arrival by
:mod:`undertow.optimiser.arrival`.  Of a smooth cost the best single surface comes first, where
there may be several one after another: its copies are what they are improved from.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from undertow.closed_loop import INADMISSIBLE, LANES, UNSTABLE, Event, RolloutBuffers
from undertow.law import Margin, Plan, stability_margin
from undertow.models import FloatArray
from undertow.optimiser.arrival import SHORTER, ArrivalSearch
from undertow.optimiser.cma_es import CMAES, minimise
from undertow.optimiser.fitting import fits
from undertow.optimiser.following import SHORTEST, Follower, refined
from undertow.optimiser.open_loop import EarliestArrival, OpenLoopMotion
from undertow.optimiser.proposal import Budget, Proposal, Status, motion_margins
from undertow.optimiser.search_space import SearchSpace
from undertow.optimiser.trust_region import TrustRegion
from undertow.symbolic import compiled

if TYPE_CHECKING:
    from undertow.optimiser import Optimiser

#: Rollouts are given up when their cost exceeds the best one so far by this factor.
HOPELESS = 3.0

#: The same in a search for an earlier arrival, where all that counts is near the best one.
NEARLY = 1.1

#: What a closest approach of twice the terminal radius costs, as a part of the best time.
MISS_PRICE = 0.1

#: What a radius e times the terminal one at the deadline costs, as a part of the cost.
LATE_PRICE = 0.3

#: Improvements below this part of the cost do not keep a model search going.
WORTHWHILE = 1e-3

#: Largest number of coordinates for a model search: its model has 55 terms then.
MODEL_SIZE = 9

#: Fruitless looks around that end a re-optimisation.
LOOKS = 2

#: Time that packing an answer takes, s.
ANSWERING = 1e-4

#: Generations that end a search along a ridge, where gains come in jumps, unless together they
#: gain this part of the time.
PATIENCE, GAIN = 8, 3e-3

#: Widest spread of a first population along a ridge.
FAR = 0.25

#: Evaluations at most that improve a plan along its ridge: of a first answer, and where searches
#: for an earlier arrival lead nowhere.
POLISH = 512

#: A search for arrivals far and wide: its members, draws for each of them, the spread of these, and
#: between which parts of the best time it begins: what arrives late may lead to what arrives early.
CROWD, DRAWS, WIDE, BEGINS = 96, 16, 1.5, (1.0, 2.0)

#: The same around the best plan: the spread is between two powers of ten; and how many of these
#: searches in turn may lead nowhere before the next one far and wide.  With few parameters arrivals
#: are isolated, and one is enough.
FEW, AROUND, NEAR_AND_FAR, FRUITLESS = 24, 8, (-1.5, 0.3), 6

#: A schedule as early as this many times the earliest arrival needs no other search; how often
#: one is looked for that follows it.
AS_EARLY, TRIES = 1.02, 3

#: When a schedule in use is to arrive: in parts of its arrival where it is kept, else of what it
#: promised; and whether the search begins from the designs.
SOONER = ((0.6, True), (0.75, True), (0.88, False), (0.97, False))
LATER = ((1.0, False), (1.1, False), (1.25, False), (1.6, True), (2.5, True), (4.0, True))

#: T after an arrival, as a part of the one before, at first and in the end; members that remain;
#: ways to sway a schedule, and how far they go; evaluations for a single surface where all fails,
#: and twice as many without any plan.
HURRY, UNHURRIED = 0.9, 0.98
FEWEST, WAYS, SWAY, ALONE = 4, 3, (0.02, 0.5), 1024

#: What a motion integrated to the tolerance counts as, in evaluations: it takes as long.
EXACT = 16

#: Plans of one batch, at most, that are scored again where they promise an earlier arrival; and
#: the part of a promised time by which a motion is late that does not arrive then at all.
DOUBTED, GRAZES = 4, 0.01

#: A single surface is divided into so many, the first but one of which takes over after this part
#: of the time in which nearly all of the cost, this part, is spent, each later one after twice the
#: time; and the evaluations that improving them may take, per coordinate of a single one.
DIVIDED, SOON, NEARLY_ALL, FINE = 5, 1 / 8, 0.95, 10240

#: Draws of a schedule's surfaces: the largest factor of their gain, as its logarithm.
STRONG = 5.0

#: Time constants of the first surface after which, without any plan, an arrival is looked for.
LONG = 10.0


class Optimisation:
    """The state of one running optimisation: the best plan so far at any moment.

    Parameters
    ----------
    optimiser
        What is optimised, and how.
    x
        State, (2n,).
    horizon
        Longest prediction, s.
    budget
        What may be spent.
    resolution
        Differences in cost below this are not worth a search.
    sequence
        Number of the proposal: with the optimiser's seed it decides all randomness.
    warm
        Whether there is a plan in use.
    """

    def __init__(
        self,
        optimiser: Optimiser,
        x: FloatArray,
        horizon: float,
        budget: Budget,
        *,
        resolution: float,
        sequence: int,
        warm: bool,
    ) -> None:
        self.began = self._last = time.perf_counter()
        self.optimiser, self.loop, self.space = optimiser, optimiser.loop, optimiser.space
        self.x, self.horizon, self.budget = x, horizon, budget
        self.resolution, self.sequence, self.warm = resolution, sequence, warm
        self.rng = np.random.default_rng([optimiser.seed, sequence])
        self.evaluations = 0
        self.best_cost = math.inf
        self.best_z: FloatArray | None = None
        self._best: Plan | None = None
        self.incumbent_cost = math.inf
        self._unscored: Plan | None = None
        self._pace = 0.0
        self._kept = 0
        self._buffers: dict[int, RolloutBuffers] = {}

    # -- budget ----------------------------------------------------------------------------

    def late(self) -> bool:
        """Whether another batch, taking as long as the last one, would overrun the time."""
        now = time.perf_counter()
        self._pace, self._last = now - self._last, now
        return now - self.began + self._pace + ANSWERING >= self.budget.seconds

    @property
    def left(self) -> int:
        """Evaluations that are left, but for those that are kept for later."""
        return self.budget.evaluations - self.evaluations - self._kept

    @property
    def firsts(self) -> FloatArray:
        """Search coordinates of the designs, (N, d)."""
        size = self.space.size // self.space.segments
        return np.tile(self.optimiser.firsts[:, :size], self.space.segments)

    def _switch_at(self, times: tuple[float, ...]) -> None:
        """Search from now on for surfaces that take over at these times, s."""
        best, self.space = self.best, self.space.at(times)
        self._buffers.clear()
        if best is not None:
            self._best, self.best_z = best, self.space.encode(best)

    # -- evaluation ------------------------------------------------------------------------

    def cost(self, z: FloatArray, *, hopeless: float = HOPELESS) -> FloatArray:
        """Score coordinates (N, d), keeping the best plan.

        An incumbent that has no score yet goes in place of z[0].
        Rollouts that cost ``hopeless`` times as much as the best one are given up.

        What is returned guides a search: admissible plans at their cost; unstable ones at
        ``UNSTABLE``, others at 1e9 up, see ``Batch.score``; those that just miss the terminal set
        or the deadline a little above what they would cost without the miss, which keeps the
        score continuous where the best plans lie.
        """
        loop, known = self.loop, self.best_cost < INADMISSIBLE
        vectors, gains = self.space.decode(z)
        incumbent, self._unscored = self._unscored, None
        if incumbent is not None:
            vectors[0] = incumbent.vectors
            if gains is not None:
                gains[0] = incumbent.gains(loop.reaching)
        seek = self._seeks()
        self.evaluations += len(z)
        cap = math.inf
        if known:
            cap = (NEARLY if seek else hopeless) * self.best_cost + self.resolution
        stable = None
        # The rollouts of a loop with a linear model tell by themselves what is unstable.
        if loop.linear_end is None:
            stable = np.flatnonzero(stability_margin(loop.mechanism, vectors[:, -1]) > 0)
            vectors, gains = vectors[stable], None if gains is None else gains[stable]
        scores = guide = np.empty(0)
        if len(vectors):
            batch = loop.roll_out(
                self._filled(vectors, gains), self.space.freedom.times, self.horizon,
                cap=cap, stable_only=True, seek=seek,
            )  # fmt: skip
            scores = batch.score(self.horizon)
            guide = scores.copy()
            _guide(
                batch.event, batch.cost, batch.radius, batch.closest, batch.closest_time,
                loop.objective.terminal_radius, self.best_cost, seek, guide,
            )  # fmt: skip
        if stable is not None:
            scores, guide = _among(len(z), stable, scores), _among(len(z), stable, guide)
        if incumbent is not None:
            self._adopt(incumbent, z[0].copy(), float(scores[0]))
        best = self._believed(z, scores, guide) if self._doubts else int(np.argmin(scores))
        if scores[best] < self.best_cost:
            self.best_cost, self.best_z = float(scores[best]), z[best].copy()
            self._best = None
        return guide

    @property
    def _doubts(self) -> bool:
        """Whether a first answer could promise an arrival that only the steps of a search see.

        A motion that grazes the terminal set arrives there with one step and not with another.
        """
        return self.optimiser.counts_time and not self.warm and self.loop.adapts

    def _believed(self, z: FloatArray, scores: FloatArray, guide: FloatArray) -> int:
        """Score those that better the best plan again, precisely, until one does; return which.

        Such rollouts are few, and count as one each.
        """
        broken = False
        for k in np.argsort(scores, kind="stable")[:DOUBTED]:
            if not scores[k] < self.best_cost:
                return int(k)
            if self.budget.evaluations <= self.evaluations:
                if not self.best_cost < INADMISSIBLE:  # a plan that may graze, or none at all
                    return int(k)
                break
            vectors, gains = self.space.decode(z[k : k + 1])
            batch = self.loop.batch(
                self.x, vectors, reaching=gains, switch_times=self.space.freedom.times,
                duration=self.horizon, stable_only=True, precise=True,
            )  # fmt: skip
            self.evaluations += 1
            promised, scores[k] = scores[k], batch.score(self.horizon)[0]
            if scores[k] > (1.0 + GRAZES) * promised:
                broken, guide[k] = True, max(guide[k], scores[k])
            if scores[k] < self.best_cost:
                return int(k)
        better = scores < self.best_cost
        scores[better] = math.inf
        if broken:  # like those before
            guide[better] = INADMISSIBLE
        return int(np.argmin(scores))

    def _seeks(self) -> bool:
        """Whether rollouts look for where they come closest to the target.

        An incumbent, which comes first, is held to the small steps of those that follow.
        """
        known = self.best_cost < INADMISSIBLE
        return self.optimiser.counts_time and (known or (self.warm and not self.evaluations))

    def _filled(self, vectors: FloatArray, gains: FloatArray | None) -> RolloutBuffers:
        """Return buffers with decoded plans, from the state x: the same for the same number."""
        count = len(vectors)
        if count not in self._buffers:
            self._buffers[count] = RolloutBuffers(self.loop, count, vectors.shape[1])
        return self._buffers[count].fill(self.x, vectors, gains)

    def _adopt(self, incumbent: Plan, here: FloatArray, score: float) -> None:
        self._best, self.best_z = incumbent, here
        self.best_cost, self.incumbent_cost = score, score

    @property
    def best(self) -> Plan | None:
        """The best plan so far."""
        if self._best is None and self.best_z is not None:
            vectors, gains = self.space.decode(self.best_z[None])
            self._best = self.space.plan(vectors[0], None if gains is None else gains[0])
        return self._best

    # -- search ----------------------------------------------------------------------------

    def _descend(self, z: FloatArray, sigma: float, evaluations: int, tolerance: float) -> bool:
        search = CMAES(z, sigma, self.optimiser.population, self.rng)
        minimise(
            search,
            self.cost,
            evaluations=min(evaluations, self.left),
            tolerance=tolerance,
            # Times of arrival improve in jumps: a pause is no sign that the search is done.
            resolution=0.0 if self.optimiser.counts_time else self.resolution,
            stop=lambda: self.left < search.population or self.late(),
        )
        return search.converged

    def global_search(self) -> Iterator[bool]:
        """Improve the best of the designs, then look elsewhere; yields whether it has converged."""
        several = len(self.space.freedom.times) > 1 or self.optimiser.freedom.schedule > 0
        several &= not self.optimiser.counts_time
        if several:
            self._switch_at((0.0,))
            self._kept = min(FINE * self.space.size, 3 * self.left // 4)
        z = self.firsts[: max(1, self.left)]
        scores = self.cost(z)
        if self.optimiser.counts_time:
            yield self._earlier(min(POLISH, self.left))
            again, done = self.optimiser.freedom.schedule > 0, False
            if again:
                for done in self.follow_earliest(self.left // 2):
                    yield done
            if done:
                return
            self.arrive_earlier(wide=True, keep=POLISH + again * (self.left // 2))
            yield self._earlier(POLISH if again else self.left)
            if again:
                yield from self.follow_earliest()
            return
        if self._centre().size <= MODEL_SIZE:
            self._model_search(self._centre())
            yield False
        optimiser, rng, total = self.optimiser, self.rng, self.evaluations + self.left
        draws = max(optimiser.population, total // 6)
        drawn = self.firsts[0] + self.space.steps(rng, np.ones(draws))
        drawn = drawn[: max(1, self.left)]
        z, scores = np.vstack([z, drawn]), np.concatenate([scores, self.cost(drawn)])
        starts = z[np.argsort(scores, kind="stable")[:3]]
        share = (total - len(z)) // 4
        for start in starts:
            self._descend(start, 0.3, share, 3e-3)
        converged = self._descend(self._centre(), 0.03, share, 1e-4)
        while self.left >= optimiser.population and not self.late():
            start = self._centre() + self.space.steps(rng, np.ones(1))[0]
            self._descend(start, 0.3, self.left, 3e-3)
        yield converged
        if several:
            self._kept = 0
            self._switch_at(self._division())
            yield self._descend(self._centre(), 0.1, self.left, 1e-4)

    def _division(self) -> tuple[float, ...]:
        """When each of several surfaces is to take over from the best single one, s."""
        period, best = self.optimiser.freedom.schedule, self.best
        if not period:
            return self.optimiser.freedom.times
        assert best is not None  # cost() has run before
        motion = self.loop.simulate(self.x, best, duration=self.horizon)
        spent = np.searchsorted(motion.accumulated_cost, NEARLY_ALL * motion.cost)
        first = period * max(1, round(SOON * float(motion.t[spent]) / period))
        times = (round(first * 2**k, 9) for k in range(DIVIDED - 1))
        return (0.0, *(t for t in times if t < self.horizon))

    def local_search(self, incumbent: Plan) -> bool:
        """Start from the incumbent; look further away where that gains nothing."""
        if self.optimiser.freedom.schedule:
            self._switch_at(incumbent.times)
        here = self._begin(incumbent)
        if self._unscored is not None and (self.left < 2 * LANES or self.late()):
            self.cost(here[None])
        if here.size > MODEL_SIZE:
            if self._unscored is not None:
                self.cost(here[None])
            self._look_around(here)
            return self._descend(self._centre(), 0.1, self.left, 1e-3)
        search = self._model_search(here)
        if not self.best_cost < INADMISSIBLE:
            self._look_around(here)
            return self._descend(self._centre(), 0.3, self.left, 1e-3)
        # Look further away, and go where that leads, until it leads nowhere any more.
        fruitless = 0
        while fruitless < LOOKS and self.left >= LANES and not self.late():
            before = self.best_cost
            self._look_around(self._centre())
            fruitless += 1
            if self.best_cost < (1.0 - WORTHWHILE) * before - self.resolution:
                search = self._model_search(self._centre())
                fruitless = 0
        return fruitless == LOOKS or search.converged

    def _centre(self) -> FloatArray:
        """Coordinates of the best plan so far."""
        assert self.best_z is not None  # cost() has run before
        return self.best_z

    def _begin(self, incumbent: Plan) -> FloatArray:
        """Return the coordinates of the incumbent; where they cannot express it, score it."""
        here = self.space.encode(incumbent)
        loop, freedom = self.loop, self.space.freedom
        plain = freedom.reaching or incumbent.reaching is None
        if plain and incumbent.times == freedom.times:
            self._unscored = incumbent
            return here
        schedule = self.optimiser.freedom.schedule > 0
        batch = loop.batch(
            self.x, incumbent, duration=self.horizon, stable_only=True,
            seek=self._seeks() and not schedule, precise=schedule,
        )  # fmt: skip
        stable = loop.linear_end or stability_margin(loop.mechanism, incumbent.surfaces[-1]) > 0
        self.evaluations += 1
        self._adopt(incumbent, here, float(batch.score(self.horizon)[0]) if stable else UNSTABLE)
        return here

    def _model_search(self, here: FloatArray) -> TrustRegion:
        """Follow a quadratic model of the cost from some coordinates on."""
        search = TrustRegion(here, 0.1, LANES, self.rng)
        minimise(
            search,
            self.cost,
            evaluations=self.left,
            tolerance=1e-4,
            resolution=self.resolution,
            relative=WORTHWHILE,
            patience=2,
            stop=self.late,
        )
        if self._unscored is not None:  # no time for a single generation
            self.cost(here[None])
        return search

    def search_earlier(self, incumbent: Plan) -> bool:
        """Search for an earlier arrival along the thin set of plans that arrive directly.

        Across that set the closest approach moves away from 0 at once, along it hardly: the
        first population is shaped by ∂(closest state)/∂z.
        """
        here = self._begin(incumbent)
        if self._unscored is not None:
            self.cost(here[None])
        if self.optimiser.freedom.schedule:
            if self.lead_back(incumbent):
                return True
            alone = ALONE if self.best_cost < INADMISSIBLE else 2 * ALONE
            self.arrive_earlier(keep=max(0, self.left - alone))
            found = self.best
            return found is not None and found is not incumbent and self.lead_back(found)
        if not self.best_cost < INADMISSIBLE:
            self._look_around(here)
        if not self.optimiser.aims:
            return self._earlier(self.left)
        self._earlier(min(POLISH, self.left))
        return self.arrive_earlier()

    def _earlier(self, most: int) -> bool:
        """Search from the best plan along its ridge, with so many evaluations at most."""
        here = self._centre()
        if not self.best_cost < INADMISSIBLE:
            return self._descend(here, 0.1, most, 1e-3)
        d, loop = here.size, self.loop
        if self.best_cost <= loop.step:  # all but there
            return True
        if most < 2 * d + LANES or self.late():
            return False
        vectors, gains = self.space.decode(here + 1e-4 * np.vstack([np.eye(d), -np.eye(d)]))
        self.evaluations += len(vectors)
        near = loop.batch(
            self.x,
            vectors,
            reaching=gains,
            switch_times=self.space.freedom.times,
            duration=1.05 * self.best_cost,
            terminal=0.0,
            seek=True,
        ).closest_x
        slope = (near[:d] - near[d:]) / 2e-4
        if not np.isfinite(slope).all():
            return self._descend(here, 0.1, most, 1e-3)
        across, steepness, _ = np.linalg.svd(slope)
        spread = np.full(d, FAR)
        tight = loop.objective.terminal_radius / np.maximum(steepness, 1e-12)
        spread[: len(tight)] = np.minimum(tight, FAR)
        search = CMAES(here, 1.0, LANES, self.rng, (across * spread**2) @ across.T)
        minimise(
            search,
            self.cost,
            evaluations=min(most, self.left),
            tolerance=1e-4,
            relative=GAIN,
            patience=PATIENCE,
            stop=lambda: self.left < search.population or self.late(),
        )
        return search.converged

    def _look_around(self, here: FloatArray) -> None:
        wide = min(self.left, LANES)
        if wide > 0:
            around = here + self.space.steps(self.rng, np.geomspace(0.1, 1.0, wide))
            self.cost(around, hopeless=1.0)

    def arrive_earlier(self, wide: bool = False, keep: int = 0) -> bool:
        """Search for earlier arrivals around the best plan, or first far and wide.

        And far and wide again when that leads nowhere any more; so many evaluations are left over.
        """
        rng, space, spent = self.rng, self.space, -1
        search = ArrivalSearch(
            self._states,
            self._admits,
            0.9 * self.loop.objective.terminal_radius,
            lambda evaluations: self.left < evaluations + keep or self.late(),
        )
        most = FRUITLESS if self.optimiser.aims else 1
        fruitless = most if wide else 0
        while self.left > keep and not self.late() and self.evaluations > spent:
            before, spent = self.best_cost, self.evaluations
            if before <= self.loop.step:  # all but there
                return True
            if not before < INADMISSIBLE or fruitless == most:
                z = self.firsts[0] + space.steps(rng, np.full(CROWD * DRAWS, WIDE))
                known = before < INADMISSIBLE
                search.run(z, rng.uniform(*BEGINS) * before if known else self._long(), CROWD)
                fruitless = 0
                continue
            spread = 10.0 ** rng.uniform(*NEAR_AND_FAR, FEW * AROUND)
            search.run(self._centre() + space.steps(rng, spread), SHORTER * before, FEW)
            fruitless += 1
            if self.best_cost < (1.0 - WORTHWHILE) * before:
                fruitless = 0
            elif fruitless == 1:
                self._earlier(min(POLISH, self.left - keep))
        return False

    # -- schedules that follow the earliest arrival ---------------------------------------------

    def follow_earliest(self, keep: int = 0) -> Iterator[bool]:
        """Look for the earliest arrival over all inputs, and for a schedule that follows it.

        Starts from the motion of the best plan, and then elsewhere: what is found is a local
        optimum.  Yields after each whether the plan is as early by now.  So many evaluations are
        left over.
        """
        loop, best, long = self.loop, self.best, self.best_cost
        if best is None or not np.isfinite(loop.mechanism.input_limits).all():
            return
        if not long < INADMISSIBLE:
            long = float(loop.batch(self.x, best, duration=self.horizon, seek=True).closest_time[0])
        if long <= loop.step:
            return
        recorded = loop.simulate(self.x, best, duration=long)
        arrival = self._arrival(keep)
        motion = arrival.improve(OpenLoopMotion.of(recorded, long))
        if motion is None:
            return
        earliest = motion.time
        self._follow(motion, keep)
        yield self.best_cost <= AS_EARLY * earliest
        for guess in (motion.faster(), motion.mirrored()):
            other = arrival.improve(guess)
            if other is not None and other.time < earliest / AS_EARLY:
                earliest = other.time
                self._follow(other, keep)
                yield self.best_cost <= AS_EARLY * earliest

    def _arrival(self, keep: int) -> EarliestArrival:
        """The task over all inputs, as long as more evaluations than these are left."""
        loop = self.loop
        low, high = loop.objective.range_of(loop.mechanism)
        radius = loop.objective.terminal_radius
        return EarliestArrival(
            loop.mechanism, radius, low, high, lambda: self.left <= keep or self.late()
        )

    def _follow(self, motion: OpenLoopMotion, keep: int) -> None:
        """Look for a schedule that follows a motion, where that is earlier than the best plan.

        So many evaluations are left over.
        """
        if motion.time < (1.0 - WORTHWHILE) * self.best_cost - self.resolution:
            for _ in range(TRIES):
                plan = self._schedule(self._arrival(keep), motion)
                if plan is not None:
                    self._consider(plan)
                    self.lead_back(plan)
                    break

    def lead_back(self, incumbent: Plan) -> bool:
        """Look for earlier arrivals of a plan in use, moving all its surfaces together.

        Where it arrives no more as promised, because the state was pushed, later arrivals than that
        come first.  Returns whether it was kept or there is an arrival now.
        """
        promised, before = incumbent.times[-1], self.best_cost
        kept = before <= promised or (not promised and before < INADMISSIBLE)
        if not (kept or promised) or before <= SHORTEST * self.loop.step:  # nothing, all but there
            return kept
        first, tries = (before, SOONER) if kept else (promised, LATER)
        for part, designs in tries:
            T = min(part * first, self.horizon)
            self._lead_back(incumbent, T, HURRY, designs)
            if self.best_cost < before:
                break
        while self.best is not None and self.best_cost < (1.0 - WORTHWHILE) * before:
            before = self.best_cost
            self._lead_back(self.best, UNHURRIED * before, UNHURRIED)
        return kept or self.best_cost <= T

    def _lead_back(self, incumbent: Plan, T: float, shorter: float, designs: bool = False) -> None:
        """Search for arrivals until T, s, around a plan and the same plan, stretched.

        Or around the designs.
        """
        loop, period = self.loop, self.optimiser.freedom.schedule
        T = max(T, 2 * loop.step)
        times = refined([t for t in incumbent.times[:-1] if t < T], period, T, loop.step)
        space = self.space.at(times)
        laws, end = incumbent.laws(loop.reaching), max(1, len(incumbent.times) - 1)
        moving = Plan(incumbent.surfaces[:end], incumbent.times[:end], laws[:end])
        slower = T / max(incumbent.times[-1], loop.step) if end > 1 else 1.0
        stretched = replace(moving, times=tuple(t * slower for t in moving.times))
        z = np.array([space.encode(moving), space.encode(stretched)])
        near = np.geomspace(*SWAY, WAYS)
        z = np.vstack([z, z.repeat(WAYS, axis=0) + space.steps(self.rng, np.tile(near, len(z)))])
        if designs:
            z = np.tile(self.optimiser.firsts, space.segments)

        def admits(z: FloatArray) -> NDArray[np.bool_]:
            self.evaluations += EXACT * len(z)
            vectors, gains = space.decode(z)
            batch = loop.batch(
                self.x, vectors, reaching=gains, switch_times=times, duration=T, precise=True
            )
            arrives = np.asarray(batch.reached)
            if arrives.any():
                best = int(np.argmin(np.where(arrives, batch.time, np.inf)))
                assert gains is not None  # the reaching law of a schedule is free
                plan = space.plan(vectors[best], gains[best])
                self._consider(self._ended(plan, float(batch.time[best])))
            return arrives

        search = ArrivalSearch(
            partial(self._states, space=space),
            admits,
            0.9 * loop.objective.terminal_radius,
            lambda evaluations: self.left < evaluations or self.late(),
            shorter,
            FEWEST,
        )
        search.run(z, T, FEWEST)

    def _ended(self, plan: Plan, arrives: float) -> Plan:
        """Return a plan with the first design taking over at the next multiple of the period."""
        period = self.optimiser.freedom.schedule
        end = round(period * math.ceil(arrives / period - 1e-9), 9)
        count = sum(t < end - 1e-9 for t in plan.times)
        vectors, gains = self.space.decode(self.optimiser.firsts[:1])
        anchor = self.space.plan(vectors[0], None if gains is None else gains[0])
        laws = plan.laws(self.loop.reaching)[:count] + anchor.laws(self.loop.reaching)
        return Plan(plan.surfaces[:count] + anchor.surfaces, (*plan.times[:count], end), laws)

    def _schedule(self, arrival: EarliestArrival, motion: OpenLoopMotion) -> Plan | None:
        """Return surfaces that follow a motion, the last but one of which arrives.

        From the next multiple of the period on the first design takes over: that is stable, as the
        last surface of a plan must be.
        """
        loop, space, period = self.loop, self.space, self.optimiser.freedom.schedule
        m = loop.mechanism.m

        def draw(count: int, before: FloatArray | None) -> FloatArray:
            z = self.firsts[0] + space.steps(self.rng, np.full(count, WIDE))
            z[:, -2 * m : -m] += self.rng.uniform(0.0, STRONG, (count, m))
            if before is not None:
                near = np.geomspace(1e-3, 1.0, count // 8)
                z[: len(near)] = before + space.steps(self.rng, near)
            return np.asarray(z)

        def states(x: FloatArray, z: FloatArray, time: float) -> FloatArray:
            self.evaluations += math.ceil(len(z) * time / motion.time)
            buffers = RolloutBuffers(loop, len(z), 1).fill(x, *space.decode(z))
            batch = loop.roll_out(buffers, (0.0,), time, terminal=0.0)
            sound = (batch.event == Event.HORIZON) & np.isfinite(batch.x).all(axis=1)
            return np.where(sound[:, None], batch.x, np.inf)

        def exact(x: FloatArray, z: FloatArray, time: float) -> FloatArray:
            self.evaluations += math.ceil(len(z) * time / motion.time)
            vectors, gains = space.decode(z)
            batch = loop.batch(
                x, vectors, reaching=gains, duration=time, terminal=0.0, precise=True
            )
            sound = (batch.event == Event.HORIZON) & np.isfinite(batch.x).all(axis=1)
            return np.where(sound[:, None], batch.x, np.inf)

        fit = partial(fits, space, self.optimiser.anchor)
        follower = Follower(draw, fit, states, exact, arrival, period, loop.step)
        found = follower.follow(motion)
        if found is None:
            return None
        z, times, end = found
        whole = space.at(times)
        vectors, gains = whole.decode(z.reshape(1, -1))
        assert gains is not None  # the reaching law of a schedule is free
        return self._ended(whole.plan(vectors[0], gains[0]), end)

    def _consider(self, plan: Plan) -> None:
        """Score a plan that the coordinates cannot express, and keep it where it is the best."""
        batch = self.loop.batch(self.x, plan, duration=self.horizon, stable_only=True, precise=True)
        self.evaluations += EXACT
        score = float(batch.score(self.horizon)[0])
        if score < self.best_cost and stability_margin(self.loop.mechanism, plan.surfaces[-1]) > 0:
            self._best, self.best_z, self.best_cost = plan, self.space.encode(plan), score

    def _long(self) -> float:
        """A time, s, in which something should have arrived."""
        anchor = self.optimiser.anchor
        rate = float(stability_margin(self.loop.mechanism, anchor.vector[None])[0])
        return min(self.horizon, LONG / max(rate, LONG / self.horizon))

    def _states(
        self, z: FloatArray, T: float, space: SearchSpace | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """States at T, (N, 2n), or where a motion came closest, if it arrived before; and when.

        They are infinite where a motion broke off.  An ensemble's first member stands for all.
        """
        loop, space = self.loop, space or self.space
        T = max(T, loop.step)
        self.evaluations += len(z)
        buffers = RolloutBuffers(loop, len(z), space.segments, plants=loop.ensemble is not None)
        if loop.ensemble is not None:
            buffers.lanes[:, :, buffers.layout.size :] = loop.ensemble.values[0]
        buffers.fill(self.x, *space.decode(z))
        batch = loop.roll_out(buffers, space.freedom.times, T, terminal=0.0, seek=True)
        sound = (batch.event == Event.HORIZON) & np.isfinite(batch.x).all(axis=1)
        early = sound & (batch.closest < loop.objective.terminal_radius)
        x = np.where(early[:, None], batch.closest_x, batch.x)
        return np.where(sound[:, None], x, np.inf), np.where(early, batch.closest_time, T)

    def _admits(self, z: FloatArray) -> NDArray[np.bool_]:
        """Score plans that arrive on the first plant."""
        return np.asarray(self.cost(z) < INADMISSIBLE)

    def fall_back(self) -> None:
        """Where nothing suits every plausible plant, also try designs, whatever is left to spend.

        The best plan is then the one that all plants survive longest, and it is answered.
        """
        if not self.best_cost < INADMISSIBLE:
            self.cost(self.firsts)

    def answer(self, converged: bool, computed_for: float, *, judged: bool = True) -> Proposal:
        """Pack the best admissible plan; a first one that is to be judged, with its margins."""
        found = self.best_cost < INADMISSIBLE
        margins: tuple[Margin, ...] = ()
        message = remedy = ""
        if self.best is not None and not (found and (self.warm or not judged)):
            margins, message, remedy = motion_margins(self.loop, self.best, self.x, self.horizon)
        status: Status = "infeasible"
        if found:
            status = "converged" if converged else "budget spent"
        best_effort = self.warm and self.loop.ensemble is not None
        return Proposal(
            self.best if found or best_effort else None,
            status,
            self.best_cost if found else math.inf,
            self.incumbent_cost if self.incumbent_cost < INADMISSIBLE else math.inf,
            margins,
            self.evaluations,
            time.perf_counter() - self.began,
            self.sequence,
            computed_for,
            "" if found else message,
            "" if found else remedy,
        )


def _among(count: int, stable: NDArray[np.intp], scores: FloatArray) -> FloatArray:
    """Return the scores of the stable ones among all."""
    every = np.full(count, UNSTABLE)
    every[stable] = scores
    return every


@compiled()
def _guide(  # type: ignore[no-untyped-def]
    event, cost, radius, closest, closest_time, terminal, best, seek, guide
):
    """Continue the score of admissible motions to those that miss by a little.

    In a search for an earlier arrival, to motions given up for costing more, by
    their closest approach; else to those that are late, never below the best admissible
    cost: late motions may cost next to nothing.
    """
    if best >= INADMISSIBLE:
        return
    for i in range(len(guide)):
        if seek and event[i] == Event.COSTLY:
            miss = max(closest[i] / terminal - 1.0, 0.0)
            guide[i] = closest_time[i] + MISS_PRICE * best * miss
        elif not seek and event[i] == Event.HORIZON and radius[i] < 100.0 * terminal:
            lateness = math.log(max(radius[i] / terminal, 1.0))
            guide[i] = max(cost[i], best) * (1.0 + LATE_PRICE * lateness)
