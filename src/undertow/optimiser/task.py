"""One running optimisation of the surface: the best plan so far at any moment.

What it costs to follow a plan, for the searches of :mod:`undertow.optimiser.search` over the
coordinates of :mod:`undertow.optimiser.search_space`.  Unstable surfaces are not rolled out;
inadmissible motions get a graded penalty, see :meth:`undertow.closed_loop.trajectory.Batch.score`.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from undertow.closed_loop import INADMISSIBLE, UNSTABLE, Event, RolloutBuffers
from undertow.closed_loop.trajectory import Batch
from undertow.law import Margin, Plan, stability_margin
from undertow.models import FloatArray
from undertow.optimiser.confidence import confidence
from undertow.optimiser.proposal import Budget, Proposal, Status, motion_margins
from undertow.optimiser.search_space import SearchSpace
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

#: Time that packing an answer takes, s.
ANSWERING = 1e-4

#: What a motion integrated to the tolerance counts as, in evaluations: it takes as long.
EXACT = 16

#: From which part of a time on an approach counts: the start may be closer than any of them.
LATER = 0.3

#: Plans of one batch, at most, that are scored again where they promise an earlier arrival; and
#: the part of a promised time by which a motion is late that does not arrive then at all.
DOUBTED, GRAZES = 4, 0.01


class Optimisation:
    """The state of one running optimisation: the best plan so far at any moment.

    ``optimiser``: what is optimised, and how. ``x``: state, (2n,). ``horizon``: longest prediction,
    s. ``budget``: what may be spent. ``resolution``: differences in cost below this are not worth a
    search. ``sequence``: number of the proposal: with the optimiser's seed it decides all
    randomness. ``warm``: whether there is a plan in use. ``unit``: what costs are answered in, of
    those of the optimiser: a search for least time is one in s.
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
        unit: float = 1.0,
    ) -> None:
        self.unit = unit
        self.began = self._last = time.perf_counter()
        self.optimiser, self.loop, self.space = optimiser, optimiser.loop, optimiser.space
        self.plants = 1 if self.loop.ensemble is None else len(self.loop.ensemble)
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
        self.kept = 0
        self.admits: Callable[[Plan], bool] | None = None
        self.asking = 0
        self.promised, self.usual = math.inf, False
        self.minima: list[float] = []
        self.found: list[tuple[Plan, int]] = []  # minima, and how often each was found
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
        return self.budget.evaluations - self.evaluations - self.kept

    @property
    def firsts(self) -> FloatArray:
        """Search coordinates of the designs, (N, d)."""
        size = self.space.size // self.space.segments
        return np.tile(self.optimiser.firsts[:, :size], self.space.segments)

    def plainer(self) -> Optimisation | None:
        """Divide the budget: the task of a plainer set of decision variables has what is left over.

        Or a quarter of it, where that is more.
        """
        optimiser, budget = self.optimiser.plainer, self.budget
        if optimiser is None:
            return None
        own = self.optimiser.usual_cold.evaluations - optimiser.usual_cold.evaluations
        most = max(budget.evaluations - own, budget.evaluations // 4, 1)
        self.budget = Budget(max(budget.evaluations - most, 1), budget.seconds)
        return self._from_cold(optimiser, most)

    def for_one_plant(self) -> Optimisation | None:
        """The task for the first member alone, a single surface; ``None`` where it is the only one.

        It may take half of what is left.
        """
        if self.plants == 1:
            return None
        assert self.loop.ensemble is not None  # of which there are several
        optimiser = self.optimiser.on(replace(self.loop, ensemble=self.loop.ensemble.first))
        if optimiser.space.segments > 1 or optimiser.freedom.schedule:
            assert optimiser.plainer is not None  # a single surface
            optimiser = optimiser.plainer
        most = max(self.budget.evaluations, optimiser.usual_cold.evaluations)
        half = self.left * self.plants // 2
        return self._from_cold(optimiser, max(1, min(most, half)), 0.5)

    def _from_cold(self, optimiser: Optimiser, evaluations: int, part: float = 1.0) -> Optimisation:
        """The task of another optimiser, from nothing, in a part of the time that is left."""
        left = max(part * (self.budget.seconds - (time.perf_counter() - self.began)), ANSWERING)
        return Optimisation(
            optimiser, self.x, self.horizon, Budget(evaluations, left),
            resolution=self.resolution, sequence=self.sequence, warm=False,
        )  # fmt: skip

    def take_time_of(self, one: Optimisation) -> None:
        """Count the evaluations of a task for one plant as what they are of this one's."""
        self.evaluations += one.evaluations // self.plants

    def switch_at(self, times: tuple[float, ...]) -> None:
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
        ``UNSTABLE``, others below it, see ``Batch.score``; those that just miss the terminal set
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
        if self._doubts:
            best = self._believed(z, scores, guide)
        elif self.admits is not None:
            best = self._admitted(z, scores, guide, self.admits)
        else:
            best = int(np.argmin(scores))
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
            batch = self.space.batch(
                self.x, z[k : k + 1], duration=self.horizon, stable_only=True, precise=True
            )
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

    def _admitted(
        self, z: FloatArray, scores: FloatArray, guide: FloatArray, admits: Callable[[Plan], bool]
    ) -> int:
        """Ask whether those that better the best plan are admitted, until one is; return which."""
        for k in np.argsort(scores, kind="stable")[:DOUBTED]:
            if not scores[k] < self.best_cost:
                return int(k)
            self.evaluations += self.asking
            if admits(self.space.plan(z[k])):
                return int(k)
            scores[k], guide[k] = math.inf, max(guide[k], INADMISSIBLE)
        scores[scores < self.best_cost] = math.inf
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
            self._best = self.space.plan(self.best_z)
        return self._best

    @property
    def centre(self) -> FloatArray:
        """Coordinates of the best plan so far."""
        assert self.best_z is not None  # cost() has run before
        return self.best_z

    def begin(self, incumbent: Plan) -> FloatArray:
        """Return the coordinates of the incumbent; where they cannot express it, score it."""
        here = self.space.encode(incumbent)
        loop, freedom = self.loop, self.space.freedom
        plain = self.space.frees_law or incumbent.reaching is None
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
        score = float(batch.score(self.horizon)[0]) if stable else UNSTABLE
        admitted = score >= INADMISSIBLE or self.admits is None or self.admits(incumbent)
        self._adopt(incumbent, here, score if admitted else UNSTABLE)
        return here

    def score_incumbent(self, here: FloatArray) -> None:
        """Score the incumbent, whose coordinates these are, unless it has a score."""
        if self._unscored is not None:
            self.cost(here[None])

    def consider(self, plan: Plan) -> bool:
        """Score a plan that the coordinates cannot express, and keep it where it is the best.

        Returns whether it is admissible, or none the better for it.
        """
        batch = self.loop.batch(self.x, plan, duration=self.horizon, stable_only=True, precise=True)
        self.evaluations += EXACT
        score = float(batch.score(self.horizon)[0])
        if score < self.best_cost and stability_margin(self.loop.mechanism, plan.surfaces[-1]) > 0:
            if self.admits is not None and not self.admits(plan):
                return False
            self._best, self.best_z, self.best_cost = plan, self.space.encode(plan), score
        return True

    def states(
        self, z: FloatArray, T: float, space: SearchSpace | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """States where motions come closest until T, (N, 2n), and when; at T if that is too early.

        They are infinite where one broke off before.  An ensemble's first member stands for all.
        """
        loop, space = self.loop, space or self.space
        T = max(T, loop.step)
        self.evaluations += len(z)
        buffers = RolloutBuffers(loop, len(z), space.segments, plants=loop.ensemble is not None)
        if loop.ensemble is not None:
            buffers.lanes[:, :, buffers.layout.size :] = loop.ensemble.values[0]
        buffers.fill(self.x, *space.decode(z))
        batch = loop.roll_out(buffers, space.freedom.times, T, terminal=0.0, seek=True)
        x = ends(batch)
        there = batch.closest < loop.objective.terminal_radius
        early = np.isfinite(batch.closest_x[:, 0]) & (there | (batch.closest_time > LATER * T))
        x = np.where(early[:, None], batch.closest_x, x)
        return x, np.where(early, batch.closest_time, T)

    # -- answer ----------------------------------------------------------------------------

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
            self.best_cost * self.unit if found else math.inf,
            self.incumbent_cost * self.unit if self.incumbent_cost < INADMISSIBLE else math.inf,
            margins,
            self.evaluations,
            time.perf_counter() - self.began,
            self.sequence,
            computed_for,
            "" if found else message,
            "" if found else remedy,
            None if self.warm or not found else confidence(self.minima),
        )


def ends(batch: Batch) -> FloatArray:
    """States at the end of motions, (N, 2n): infinite where one broke off."""
    sound = (batch.event == Event.HORIZON) & np.isfinite(batch.x).all(axis=1)
    return np.where(sound[:, None], batch.x, np.inf)


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
