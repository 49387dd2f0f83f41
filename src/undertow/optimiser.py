"""One optimisation of the surface: global the first time, warm-started afterwards.

A population search over the coordinates of :mod:`undertow.decision`.  Unstable surfaces
are not rolled out; inadmissible motions get a graded penalty, see
:meth:`undertow.rollout.Batch.score`.  Minimum time with at least 2n free parameters is
left to :mod:`undertow.shooting` in the end.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from undertow.decision import Decision, Freedom
from undertow.errors import InfeasibleError, InvalidInputError, SingularSurfaceError, UndertowError
from undertow.mechanism import FloatArray
from undertow.plan import Plan
from undertow.rollout import ClosedLoop, Event
from undertow.search import CMAES, minimise
from undertow.shooting import Shooting
from undertow.sliding import Surface
from undertow.stability import (
    Margin,
    check_surface,
    first_surface,
    stability_margin,
    surface_margins,
)

__all__ = ["Budget", "Optimiser", "Proposal", "Status"]

Status = Literal["converged", "budget spent", "infeasible", "failed"]

#: Costs from here on mark inadmissible motions (see ``Batch.score``).
INADMISSIBLE = 1e8

#: Rollouts are given up when their cost exceeds the best one so far by this factor.
HOPELESS = 3.0

#: Stands for a final state of a motion that broke off.
MISSED = 1e3


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
        Signed margins of the surface and of its predicted motion, ≥ 0 is satisfied.
    evaluations, seconds
        What it took.
    sequence
        Running number of the proposal.
    computed_for
        Time for which ``x`` was given, s.
    message, remedy
        What went wrong, and what could help, in words.
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

    @property
    def surface(self) -> Surface | None:
        """The first surface of the plan."""
        return None if self.plan is None else self.plan.surfaces[0]


@dataclass(eq=False)
class Optimiser:
    """Selects the plan that minimises the predicted cost of a closed loop.

    Parameters
    ----------
    loop
        The predicted closed loop (the controller's belief).
    first
        Surface to start from; designed by :func:`undertow.first_surface` by default.
    cold, warm
        Budgets of a global optimisation and of a re-optimisation from an incumbent; by
        default as the method needs.
    freedom
        What may be chosen besides the paper's surface parameters.
    population
        Candidates per generation.
    seed
        Seed of all randomness.  A proposal depends on the seed and its sequence number,
        not on earlier calls, so a recorded run can be replayed.
    """

    loop: ClosedLoop
    first: Surface | None = None
    cold: Budget | None = None
    warm: Budget | None = None
    freedom: Freedom = Freedom()
    population: int = 32
    seed: int = 0

    def __post_init__(self) -> None:
        """Design the first surface and the coordinates of the search around it."""
        if self.first is None:
            self.first = first_surface(self.loop.mechanism)
        check_surface(self.loop.mechanism, self.first)
        if self.population < 4:
            raise InvalidInputError(
                "population of the optimiser",
                value=self.population,
                limit="≥ 4",
                remedy="32 fills two blocks of rollouts",
            )
        self.decision = Decision(self.loop, self.first, self.freedom)

    @property
    def counts_time(self) -> bool:
        """Whether the cost is the time of arrival, a discontinuous function of the plan."""
        end = self.loop.linear_end
        if end is None or end.stage is None:
            return False
        return end.stage.rest > 0 and not end.counts_cost

    @property
    def shoots(self) -> bool:
        """Whether this is a minimum-time task with enough parameters to aim with."""
        return self.counts_time and self.decision.size >= 2 * self.loop.mechanism.n

    def _budget(self, warm: bool) -> Budget:
        given = self.warm if warm else self.cold
        if given is not None:
            return given
        if self.shoots:
            return Budget(40_000 if warm else 160_000)
        if warm:
            return Budget(1024)
        # 3072 for the three of n = 2; a covariance takes as long to learn as it has entries.
        n, m = self.loop.mechanism.n, self.loop.mechanism.m
        return Budget(1024 * (2 * m * n - m * m) ** 2 // 3)

    @property
    def _promptness(self) -> float:
        """Part of the horizon to plan for: the linear end may be late by its tolerance."""
        return 1.0 - min(0.5 * self.loop.tail, 0.1)

    def propose(
        self,
        x: ArrayLike,
        *,
        incumbent: Surface | Plan | None = None,
        horizon: float | None = None,
        sequence: int = 0,
        computed_for: float = 0.0,
        resolution: float = 0.0,
        budget: Budget | None = None,
    ) -> Proposal:
        """Optimise the plan from the state x.

        Parameters
        ----------
        x
            State, (2n,).
        incumbent
            The plan in use, shifted to now: warm start, and the answer is never worse.
            ``None``: global optimisation.
        horizon
            Longest prediction, s; the objective's by default.
        sequence, computed_for
            Number and time stamp of the proposal.
        resolution
            Differences in cost below this are not worth a search.
        budget
            Overrides ``warm`` or ``cold``.

        Returns
        -------
        Proposal
            Always; an infeasible task is a status and not an exception.
        """
        began = time.perf_counter()
        state = self.loop.mechanism.check_state(x)
        task = _Task(
            self,
            state,
            (self.loop.objective.horizon if horizon is None else horizon) * self._promptness,
            budget or self._budget(incumbent is not None),
            resolution,
            began,
            np.random.default_rng([self.seed, sequence]),
        )
        if incumbent is None:
            converged = task.global_search()
        else:
            converged = task.local_search(Plan.of(incumbent))
        if self.shoots:
            converged = task.shoot()
        return task.answer(converged, sequence, computed_for)

    def require(self, x: ArrayLike) -> Proposal:
        """Return a global optimum from x, or raise with the evidence.

        Raises
        ------
        InfeasibleError
            When no candidate was admissible; says what the best of them broke.
        """
        proposal = self.propose(x)
        if proposal.plan is None:
            raise InfeasibleError(
                f"no admissible surface for '{self.loop.mechanism.name}' "
                f"({self.loop.objective.name}) among {proposal.evaluations}",
                value=proposal.message,
                limit="every margin ≥ 0 and the terminal set reached within "
                f"{self.loop.objective.horizon:g} s",
                remedy=proposal.remedy,
            )
        return proposal


class _Task:
    """The state of one running optimisation: the best plan so far at any moment."""

    def __init__(
        self,
        owner: Optimiser,
        x: FloatArray,
        horizon: float,
        budget: Budget,
        resolution: float,
        began: float,
        rng: np.random.Generator,
    ) -> None:
        self.owner, self.x, self.horizon = owner, x, horizon
        self.budget, self.resolution, self.began, self.rng = budget, resolution, began, rng
        self.decision = owner.decision
        self.evaluations = 0
        self.best_cost = math.inf
        self.best: Plan | None = None
        self.incumbent_cost = math.inf
        self._last = began
        self._pace = 0.0

    # -- budget ----------------------------------------------------------------------------

    def late(self) -> bool:
        """Whether another batch, taking as long as the last one, would overrun the time."""
        now = time.perf_counter()
        self._pace, self._last = now - self._last, now
        return now - self.began + self._pace >= self.budget.seconds

    @property
    def left(self) -> int:
        """Evaluations that are left."""
        return self.budget.evaluations - self.evaluations

    # -- evaluation ------------------------------------------------------------------------

    def cost(self, z: FloatArray) -> FloatArray:
        """Score coordinates (N, d), keeping the best: unstable 1e10, inadmissible 1e9 up."""
        vectors, gains = self.decision.decode(z)
        scores = self._score(vectors, gains, self.owner.freedom.times)
        best = int(np.argmin(scores))
        if scores[best] < self.best_cost:
            self.best_cost = float(scores[best])
            self.best = self.decision.plan(vectors[best], None if gains is None else gains[best])
        return scores

    def _score(
        self, vectors: FloatArray, gains: FloatArray | None, times: Sequence[float]
    ) -> FloatArray:
        loop = self.owner.loop
        self.evaluations += len(vectors)
        cap = math.inf
        if self.best_cost < INADMISSIBLE:
            cap = HOPELESS * self.best_cost + self.resolution
        scores = np.full(len(vectors), 1e10)
        stable = np.full(len(vectors), True)
        if loop.linear_end is None:
            stable = stability_margin(loop.mechanism, vectors[:, -1]) > 0
        if stable.any():
            scores[stable] = loop.batch(
                self.x,
                vectors[stable],
                reaching=None if gains is None else gains[stable],
                switch_times=times,
                duration=self.horizon,
                cap=cap,
                slack=self.resolution,
                stable_only=True,
            ).score(self.horizon)
        return scores

    # -- search ----------------------------------------------------------------------------

    def _descend(self, z: FloatArray, sigma: float, evaluations: int, tolerance: float) -> bool:
        search = CMAES(z, sigma, self.owner.population, self.rng)
        minimise(
            search,
            self.cost,
            evaluations=min(evaluations, self.left),
            tolerance=tolerance,
            # Times of arrival improve in jumps: a pause is no sign that the search is done.
            resolution=0.0 if self.owner.counts_time else self.resolution,
            stop=self.late,
        )
        return search.converged

    def global_search(self) -> bool:
        """Sample widely, then descend from the three best; refine the winner."""
        owner, rng = self.owner, self.rng
        assert owner.first is not None
        anchor = self.decision.encode(Plan.of(owner.first))
        total = self.budget.evaluations
        if owner.shoots:  # leave the rest to shooting
            total = min(total, 3072)
        draws = max(owner.population, total // 6)
        draw = anchor + self.decision.steps(rng, np.ones(draws))
        z = np.vstack([anchor, *self._designs(16), draw])
        scores = self.cost(z[: max(1, self.left)])
        starts = z[np.argsort(scores, kind="stable")[:3]]
        share = (total - len(z)) // 4
        for start in starts:
            self._descend(start, 0.3, share, 3e-3)
        assert self.best is not None  # cost() has run at least once
        converged = self._descend(self.decision.encode(self.best), 0.03, share, 1e-4)
        while not owner.shoots and self.left >= owner.population and not self.late():
            start = self.decision.encode(self.best) + self.decision.steps(rng, np.ones(1))[0]
            self._descend(start, 0.3, self.left, 3e-3)
        return converged

    def local_search(self, incumbent: Plan) -> bool:
        """Start from the incumbent: a wide look around, then descend from the best."""
        law = self.owner.loop.reaching
        gains = None if incumbent.reaching is None else incumbent.gains(law)[None]
        score = float(self._score(incumbent.vectors[None], gains, incumbent.times)[0])
        self.best, self.best_cost, self.incumbent_cost = incumbent, score, score
        here = self.decision.encode(incumbent)
        wide = min(self.left, self.owner.population)
        if wide < 1:
            return False
        self.cost(here + self.decision.steps(self.rng, np.geomspace(0.03, 1.0, wide)))
        most = min(self.left, 1024) if self.owner.shoots else self.left
        return self._descend(self.decision.encode(self.best), 0.1, most, 1e-3)

    def shoot(self) -> bool:
        """Shrink the time of arrival; starts are the best plan and random ones."""
        loop, rng = self.owner.loop, self.rng
        aim = Shooting(self._miss, 0.9 * loop.objective.terminal_radius, loop.step, self._exhausted)
        while not self._exhausted():
            known = self.best_cost if self.best_cost < INADMISSIBLE else self.horizon
            assert self.best is not None  # a search has run before
            start = self._start(self.decision.encode(self.best), known, rng)
            z = aim.correct(*start, 20)
            if z is not None:
                shortest, _ = aim.kick(*aim.shrink(z, start[1]), rng, 20)
                self.cost(shortest[None])
        return False

    def _start(
        self, best: FloatArray, known: float, rng: np.random.Generator
    ) -> tuple[FloatArray, float]:
        """Draw parameters around the best ones and a time at which they nearly arrive."""
        step = self.owner.loop.step
        T = max(1, round(known * rng.uniform(0.5, 1.0) / step)) * step
        z = best + self.decision.steps(rng, 10 ** rng.uniform(-1.0, 0.2, 128))
        miss = np.linalg.norm(self._miss(z, T), axis=1)
        nearest = int(np.argmin(miss))
        return z[nearest], T

    def _exhausted(self) -> bool:
        return self.left < 4 * self.decision.size or self.late()

    def _miss(self, z: FloatArray, T: float) -> FloatArray:
        """Final states at T, (N, 2n); a motion that breaks off counts as far away."""
        vectors, gains = self.decision.decode(z)
        self.evaluations += len(z)
        batch = self.owner.loop.batch(
            self.x,
            vectors,
            reaching=gains,
            switch_times=self.owner.freedom.times,
            duration=T,
            terminal=0.0,
        )
        sound = (batch.event == Event.HORIZON) & np.isfinite(batch.x).all(axis=1)
        return np.where(sound[:, None], batch.x, MISSED)

    def _designs(self, count: int) -> list[FloatArray]:
        """Quadratic designs with random weights: all of them locally stable."""
        mechanism = self.owner.loop.mechanism
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
        if self.best is not None:
            margins, message, remedy = motion_margins(
                self.owner.loop, self.best, self.x, self.horizon
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


def motion_margins(
    loop: ClosedLoop, plan: Plan, x: FloatArray, horizon: float
) -> tuple[tuple[Margin, ...], str, str]:
    """Return the margins of a plan and of its predicted motion, how it ends, and a remedy."""
    objective = loop.objective
    try:
        margins = list(surface_margins(loop.mechanism, plan.surfaces[-1]))
    except SingularSurfaceError as error:
        return (), str(error), error.remedy
    batch = loop.batch(x, plan, duration=horizon)
    margins.append(
        Margin(
            "(37) along the motion: min det Γ(q)/det Γ(0)",
            float(batch.singular[0]),
            "",
            "Start closer to the target",
        )
    )
    if objective.hard_input:
        margins.append(
            Margin(
                "(38) hard input limit: min u_max − |demand|",
                float(batch.input[0]),
                loop.mechanism.inputs[0].unit,
                "Raise the actuator limit, start closer to the target, lower η, or let the "
                "actuator clip (hard_input=False)",
            )
        )
    margins += [
        Margin(constraint.name, float(value), "", "Relax the constraint or start elsewhere")
        for constraint, value in zip(objective.constraints, batch.path[0], strict=True)
    ]
    event = Event(int(batch.event[0]))
    worst = min(margins, key=lambda m: m.value)
    ending = {
        Event.REACHED: f"reaches the terminal set at {batch.time[0]:.3g} s",
        Event.HORIZON: f"is still at ‖x‖ = {batch.radius[0]:.3g} after {batch.time[0]:.3g} s",
        Event.UNSTABLE: "is unstable",
        Event.COSTLY: "costs too much",
        Event.DIVERGED: f"diverges at {batch.time[0]:.3g} s",
        Event.SINGULAR: f"meets the singularity (37) at {batch.time[0]:.3g} s",
        Event.CONSTRAINT: f"breaks '{worst.name}' by {-worst.value:.3g} {worst.unit} "
        f"at {batch.time[0]:.3g} s",
    }[event]
    remedy = {
        Event.HORIZON: "Lengthen the horizon, widen the terminal set, or spend a larger budget",
        Event.COSTLY: "Spend a larger budget",
        Event.CONSTRAINT: worst.remedy,
    }.get(event, "Start closer to the target, or spend a larger budget")
    return tuple(margins), f"the best candidate {ending}", remedy
