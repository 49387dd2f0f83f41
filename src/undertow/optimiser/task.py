"""One running optimisation of the surface: the best plan so far at any moment.

A population search over the coordinates of :mod:`undertow.optimiser.search_space`.  Unstable
surfaces are not rolled out; inadmissible motions get a graded penalty, see
:meth:`undertow.closed_loop.trajectory.Batch.score`.  Minimum time with at least 2n free parameters
is left to :mod:`undertow.optimiser.shooting` in the end.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from undertow.base import UndertowError
from undertow.closed_loop import INADMISSIBLE, ClosedLoop, Event
from undertow.law import Margin, Plan, Surface, first_surface, stability_margin
from undertow.models import FloatArray
from undertow.optimiser.cma_es import CMAES, minimise
from undertow.optimiser.proposal import Budget, Proposal, Status, motion_margins
from undertow.optimiser.search_space import DecisionVariables, SearchSpace
from undertow.optimiser.shooting import Shooting
from undertow.optimiser.trust_region import TrustRegion
from undertow.symbolic import LANES, numba

__all__ = ["Optimisation", "Problem"]

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

#: Stands for a final state of a motion that broke off.
MISSED = 1e3


@dataclass(frozen=True, eq=False)
class Problem:
    """What stays the same from one optimisation to the next.

    Parameters
    ----------
    loop
        The predicted closed loop.
    first
        Surface to start from.
    freedom
        What may be chosen.
    population
        Candidates per generation.
    """

    loop: ClosedLoop
    first: Surface
    freedom: DecisionVariables
    population: int

    @cached_property
    def decision(self) -> SearchSpace:
        """The coordinates of the search."""
        return SearchSpace(self.loop, self.first, self.freedom)

    @cached_property
    def counts_time(self) -> bool:
        """Whether the cost is the time of arrival, a discontinuous function of the plan."""
        end = self.loop.linear_end
        if end is None or end.stage is None:
            return False
        return end.stage.rest > 0 and not end.counts_cost

    @cached_property
    def shoots(self) -> bool:
        """Whether this is a minimum-time task with enough parameters to aim with."""
        return self.counts_time and self.decision.size >= 2 * self.loop.mechanism.n


class Optimisation:
    """The state of one running optimisation: the best plan so far at any moment."""

    def __init__(
        self,
        problem: Problem,
        x: FloatArray,
        horizon: float,
        budget: Budget,
        resolution: float,
        began: float,
        rng: np.random.Generator,
    ) -> None:
        self.problem, self.x, self.horizon = problem, x, horizon
        self.budget, self.resolution, self.began, self.rng = budget, resolution, began, rng
        self.decision = problem.decision
        self.probe = problem.loop.probe(x, problem.freedom.times, horizon)
        self.warm = False
        self.evaluations = 0
        self.best_cost = math.inf
        self.best_z: FloatArray | None = None
        self._best: Plan | None = None
        self.incumbent_cost = math.inf
        self._last = began
        self._pace = 0.0

    # -- budget ----------------------------------------------------------------------------

    def late(self) -> bool:
        """Whether another batch, taking as long as the last one, would overrun the time."""
        now = time.perf_counter()
        self._pace, self._last = now - self._last, now
        return now - self.began + self._pace + ANSWERING >= self.budget.seconds

    @property
    def left(self) -> int:
        """Evaluations that are left."""
        return self.budget.evaluations - self.evaluations

    # -- evaluation ------------------------------------------------------------------------

    def cost(
        self, z: FloatArray, incumbent: Plan | None = None, *, hopeless: float = HOPELESS
    ) -> FloatArray:
        """Score coordinates (N, d), keeping the best plan; the incumbent goes in place of z[0].

        Rollouts that cost ``hopeless`` times as much as the best one are given up.

        What is returned guides a search: admissible plans at their cost; unstable ones at
        1e10, others at 1e9 up, see ``Batch.score``; those that just miss the terminal set or
        the deadline a little above what they would cost without the miss, which keeps the
        score continuous where the best plans lie.
        """
        vectors, gains = self.decision.decode(z)
        if incumbent is not None:
            vectors[0] = incumbent.vectors
            if gains is not None:
                gains[0] = incumbent.gains(self.problem.loop.reaching)
        scores, guide = self._score(vectors, gains, self.problem.freedom.times, hopeless)
        if incumbent is not None:
            self._adopt(incumbent, z[0].copy(), float(scores[0]))
        best = int(np.argmin(scores))
        if scores[best] < self.best_cost:
            self.best_cost, self.best_z = float(scores[best]), z[best].copy()
            self._best = None
        return guide

    def _adopt(self, incumbent: Plan, here: FloatArray, score: float) -> None:
        self._best, self.best_z = incumbent, here
        self.best_cost, self.incumbent_cost = score, score

    @property
    def best(self) -> Plan | None:
        """The best plan so far."""
        if self._best is None and self.best_z is not None:
            vectors, gains = self.decision.decode(self.best_z[None])
            self._best = self.decision.plan(vectors[0], None if gains is None else gains[0])
        return self._best

    def _score(
        self,
        vectors: FloatArray,
        gains: FloatArray | None,
        times: Sequence[float],
        hopeless: float = HOPELESS,
    ) -> tuple[FloatArray, FloatArray]:
        """Return scores, below ``INADMISSIBLE`` only where admissible, and the guide."""
        loop, known = self.problem.loop, self.best_cost < INADMISSIBLE
        # An incumbent, which comes first, is held to the small steps of those that follow.
        seek = self.problem.counts_time and (known or (self.warm and not self.evaluations))
        self.evaluations += len(vectors)
        cap = math.inf
        if known:
            cap = (NEARLY if seek else hopeless) * self.best_cost + self.resolution
        if loop.linear_end is None:
            stable = stability_margin(loop.mechanism, vectors[:, -1]) > 0
            if not stable.all():
                return self._stable_only(vectors, gains, times, stable)
        probe = self.probe
        if times != self.problem.freedom.times:
            probe = loop.probe(self.x, times, self.horizon)
        batch = probe(vectors, gains, cap=cap, stable_only=True, seek=seek)
        scores = batch.score(self.horizon)
        guide = scores.copy()
        _guide(
            batch.event, batch.cost, batch.radius, batch.closest, batch.closest_time,
            loop.objective.terminal_radius, self.best_cost, seek, guide,
        )  # fmt: skip
        return scores, guide

    def _stable_only(
        self,
        vectors: FloatArray,
        gains: FloatArray | None,
        times: Sequence[float],
        stable: NDArray[np.bool_],
    ) -> tuple[FloatArray, FloatArray]:
        """Score the stable ones alone, where the rollout cannot tell them by itself."""
        scores, guide = np.full(len(vectors), 1e10), np.full(len(vectors), 1e10)
        self.evaluations -= int(stable.sum())
        if stable.any():
            some = None if gains is None else gains[stable]
            scores[stable], guide[stable] = self._score(vectors[stable], some, times)
        return scores, guide

    # -- search ----------------------------------------------------------------------------

    def _descend(self, z: FloatArray, sigma: float, evaluations: int, tolerance: float) -> bool:
        search = CMAES(z, sigma, self.problem.population, self.rng)
        minimise(
            search,
            self.cost,
            evaluations=min(evaluations, self.left),
            tolerance=tolerance,
            # Times of arrival improve in jumps: a pause is no sign that the search is done.
            resolution=0.0 if self.problem.counts_time else self.resolution,
            stop=self.late,
        )
        return search.converged

    def global_search(self) -> bool:
        """Sample widely, then descend from the three best; refine the winner."""
        problem, rng = self.problem, self.rng
        anchor = self.decision.encode(Plan.of(problem.first))
        total = self.budget.evaluations
        if problem.shoots:  # leave the rest to shooting
            total = min(total, 3072)
        draws = max(problem.population, total // 6)
        draw = anchor + self.decision.steps(rng, np.ones(draws))
        z = np.vstack([anchor, *self._designs(16), draw])
        scores = self.cost(z[: max(1, self.left)])
        starts = z[np.argsort(scores, kind="stable")[:3]]
        share = (total - len(z)) // 4
        for start in starts:
            self._descend(start, 0.3, share, 3e-3)
        converged = self._descend(self._centre(), 0.03, share, 1e-4)
        while not problem.shoots and self.left >= problem.population and not self.late():
            start = self._centre() + self.decision.steps(rng, np.ones(1))[0]
            self._descend(start, 0.3, self.left, 3e-3)
        return converged

    def local_search(self, incumbent: Plan) -> bool:
        """Start from the incumbent; look further away where that gains nothing."""
        here = self.decision.encode(incumbent)
        known = self._know(incumbent, here)
        if known is not None and (self.problem.counts_time or self.left < 2 * LANES or self.late()):
            self.cost(here[None], known)
            known = None
        if self.problem.counts_time:
            return self._along_the_ridge(here)
        if here.size > MODEL_SIZE:
            if known is not None:
                self.cost(here[None], known)
            self._look_around(here)
            return self._descend(self._centre(), 0.1, self.left, 1e-3)
        search = TrustRegion(here, 0.1, LANES, self.rng)
        self._run(search, known)
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
                search = TrustRegion(self._centre(), 0.1, LANES, self.rng)
                self._run(search, None)
                fruitless = 0
        return fruitless == LOOKS or search.converged

    def _centre(self) -> FloatArray:
        """Coordinates of the best plan so far."""
        assert self.best_z is not None  # cost() has run before
        return self.best_z

    def _know(self, incumbent: Plan, here: FloatArray) -> Plan | None:
        """Score an incumbent that the coordinates cannot express; return one that they can."""
        freedom, law = self.problem.freedom, self.problem.loop.reaching
        plain = freedom.reaching or incumbent.reaching is None
        if plain and incumbent.times == freedom.times:
            return incumbent
        gains = None if incumbent.reaching is None else incumbent.gains(law)[None]
        scores, _ = self._score(incumbent.vectors[None], gains, incumbent.times)
        self._adopt(incumbent, here, float(scores[0]))
        return None

    def _run(self, search: TrustRegion, incumbent: Plan | None) -> None:
        """Run a model search; its first candidate may stand for the incumbent."""
        first = [incumbent]
        minimise(
            search,
            lambda z: self.cost(z, first.pop() if first else None),
            evaluations=self.left,
            tolerance=1e-4,
            resolution=self.resolution,
            relative=WORTHWHILE,
            patience=2,
            stop=self.late,
        )
        if first and incumbent is not None:  # no time for a single generation
            self.cost(search.mean[None], incumbent)

    def _along_the_ridge(self, here: FloatArray) -> bool:
        """Search for an earlier arrival along the thin set of plans that arrive directly.

        Across that set the closest approach moves away from 0 at once, along it hardly: the
        first population is shaped by ∂(closest state)/∂z.
        """
        most = min(self.left, 1024) if self.problem.shoots else self.left
        if not self.best_cost < INADMISSIBLE:
            self._look_around(here)
            return self._descend(self._centre(), 0.1, most, 1e-3)
        d, loop = here.size, self.problem.loop
        if self.best_cost <= loop.step:  # all but there
            return True
        if self.left < 2 * d + LANES or self.late():
            return False
        vectors, gains = self.decision.decode(here + 1e-4 * np.vstack([np.eye(d), -np.eye(d)]))
        self.evaluations += len(vectors)
        near = loop.batch(
            self.x,
            vectors,
            reaching=gains,
            switch_times=self.problem.freedom.times,
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
            stop=self.late,
        )
        return search.converged

    def _look_around(self, here: FloatArray) -> None:
        wide = min(self.left, LANES)
        if wide > 0:
            around = here + self.decision.steps(self.rng, np.geomspace(0.1, 1.0, wide))
            self.cost(around, hopeless=1.0)

    def shoot(self) -> bool:
        """Shrink the time of arrival from a fresh start, then from the best plan; and so on."""
        loop, rng = self.problem.loop, self.rng
        aim = Shooting(self._miss, 0.9 * loop.objective.terminal_radius, loop.step, self._exhausted)
        fresh = True
        while not self._exhausted():
            before = self.best_cost
            shot = self._fresh(aim) if fresh else self._again(aim)
            if shot is not None:
                z, _ = aim.hop(*aim.shrink(*shot), lambda z: self._mutants(z, 256), rng, 15)
                self.cost(z[None])
            fresh = not fresh and self.best_cost >= before
        return False

    def _fresh(self, aim: Shooting) -> tuple[FloatArray, float] | None:
        """Return a shot from far and wide that arrives earlier than the best one."""
        problem = self.problem
        known = self.best_cost if self.best_cost < INADMISSIBLE else self.horizon
        T = aim.on_grid(known * self.rng.uniform(0.5, 1.0))
        anchors = np.stack([self.decision.encode(Plan.of(problem.first)), self._centre()])
        spread = 10 ** self.rng.uniform(-0.5, 0.3, 512)
        z = np.concatenate([a + self.decision.steps(self.rng, spread) for a in anchors])
        return aim.nearest(z, T, 4)

    def _again(self, aim: Shooting) -> tuple[FloatArray, float] | None:
        """Return the best plan so far as a shot at its own time of arrival."""
        if not self.best_cost < INADMISSIBLE:
            return None
        return aim.nearest(self._centre()[None], aim.on_grid(self.best_cost), 1)

    def _mutants(self, z: FloatArray, count: int) -> FloatArray:
        """Return copies of a plan in each of which one of its surfaces is drawn anew."""
        rng, segments = self.rng, self.decision.segments
        copies = np.repeat(z.reshape(1, segments, -1), count, axis=0)
        size = 10 ** rng.uniform(-0.7, 0.5, (count, 1))
        drawn = size * rng.standard_normal((count, copies.shape[2]))
        copies[np.arange(count), rng.integers(segments, size=count)] += drawn
        return copies.reshape(count, -1)

    def _exhausted(self) -> bool:
        return self.left < 4 * self.decision.size or self.late()

    def _miss(self, z: FloatArray, T: float) -> FloatArray:
        """Final states at T, (N, 2n); a motion that breaks off counts as far away."""
        vectors, gains = self.decision.decode(z)
        self.evaluations += len(z)
        batch = self.problem.loop.batch(
            self.x,
            vectors,
            reaching=gains,
            switch_times=self.problem.freedom.times,
            duration=T,
            terminal=0.0,
        )
        sound = (batch.event == Event.HORIZON) & np.isfinite(batch.x).all(axis=1)
        return np.where(sound[:, None], batch.x, MISSED)

    def _designs(self, count: int) -> list[FloatArray]:
        """Quadratic designs with random weights: all of them locally stable."""
        mechanism = self.problem.loop.mechanism
        designs = []
        for weights in 10 ** self.rng.uniform(-2, 2, (count, 2 * mechanism.n)):
            try:
                surface = first_surface(mechanism, list(weights))
            except UndertowError:
                continue
            designs.append(self.decision.encode(Plan.of(surface)))
        return designs

    def answer(self, converged: bool, sequence: int, computed_for: float) -> Proposal:
        """Pack the best admissible plan with its margins."""
        found = self.best_cost < INADMISSIBLE
        margins: tuple[Margin, ...] = ()
        message = remedy = ""
        if self.best is not None and not (found and self.warm):
            margins, message, remedy = motion_margins(
                self.problem.loop, self.best, self.x, self.horizon
            )
        status: Status = "infeasible"
        if found:
            status = "converged" if converged else "budget spent"
        return Proposal(
            self.best if found else None,
            status,
            self.best_cost if found else math.inf,
            self.incumbent_cost if self.incumbent_cost < INADMISSIBLE else math.inf,
            margins,
            self.evaluations,
            time.perf_counter() - self.began,
            sequence,
            computed_for,
            "" if found else message,
            "" if found else remedy,
        )


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _guide(  # type: ignore[no-untyped-def]
    event, cost, radius, closest, closest_time, terminal, best, seek, guide
):
    """Continue the score of admissible motions to those that miss by a little.

    In a search for an earlier arrival, to motions given up for costing more (event 5), by
    their closest approach; else to those that are late (event 0), never below the best admissible
    cost: late motions may cost next to nothing.
    """
    if best >= INADMISSIBLE:
        return
    for i in range(len(guide)):
        if seek and event[i] == 5:
            miss = max(closest[i] / terminal - 1.0, 0.0)
            guide[i] = closest_time[i] + MISS_PRICE * best * miss
        elif not seek and event[i] == 0 and radius[i] < 100.0 * terminal:
            lateness = math.log(max(radius[i] / terminal, 1.0))
            guide[i] = max(cost[i], best) * (1.0 + LATE_PRICE * lateness)
