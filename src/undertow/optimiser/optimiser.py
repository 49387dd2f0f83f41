"""Selection of the surface: global the first time, warm-started afterwards."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from undertow.base import InfeasibleError, at_least, check_fields, checked
from undertow.closed_loop import ClosedLoop
from undertow.law import Plan, Surface, check_surface, first_surface
from undertow.models import FloatArray
from undertow.optimiser.proposal import Budget, Proposal
from undertow.optimiser.search_space import DecisionVariables
from undertow.optimiser.task import Optimisation, Problem

__all__ = ["Optimiser", "Planner"]


@runtime_checkable
class Planner(Protocol):
    """Whatever proposes plans to a cascade: :class:`Optimiser`, or one of your own."""

    def require(self, x: FloatArray, /) -> Proposal:
        """Return the first plan from the state x, (2n,), or raise."""
        ...

    def propose(
        self,
        x: FloatArray,
        /,
        *,
        incumbent: Surface | Plan | None,
        horizon: float | None,
        sequence: int,
        computed_for: float,
        resolution: float,
    ) -> Proposal:
        """Return a plan for the state x, see :meth:`Optimiser.propose`."""
        ...


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
    freedom: DecisionVariables = DecisionVariables()
    population: int = 32
    seed: int = 0

    def __post_init__(self) -> None:
        """Design the first surface and the coordinates of the search around it."""
        check_fields(self)
        if self.first is None:
            self.first = first_surface(self.loop.mechanism)
        check_surface(self.loop.mechanism, self.first)
        at_least(
            "population of the optimiser", self.population, 4, "32 fills two blocks of rollouts"
        )
        at_least("seed", self.seed, 0)
        self.problem = Problem(self.loop, self.first, self.freedom, self.population)

    def _budget(self, warm: bool) -> Budget:
        given = self.warm if warm else self.cold
        if given is not None:
            return given
        if self.problem.shoots:
            return Budget(40_000 if warm else 800_000)
        if warm:
            return Budget(576 if self.problem.counts_time else 1024)
        # 3072 for the three of n = 2; a covariance takes as long to learn as it has entries.
        n, m = self.loop.mechanism.n, self.loop.mechanism.m
        return Budget(1024 * (2 * m * n - m * m) ** 2 // 3)

    @property
    def _promptness(self) -> float:
        """Part of the horizon to plan for: a prediction may be early by its tolerance."""
        return 1.0 - min(0.5 * self.loop.tail, 0.1)

    @checked
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
        at_least("sequence of a proposal", sequence, 0)
        state = self.loop.mechanism.check_state(x)
        task = Optimisation(
            self.problem,
            state,
            (self.loop.objective.horizon if horizon is None else horizon) * self._promptness,
            budget or self._budget(incumbent is not None),
            resolution,
            began,
            np.random.default_rng([self.seed, sequence]),
        )
        task.warm = incumbent is not None
        if incumbent is None:
            converged = task.global_search()
        else:
            converged = task.local_search(Plan.of(incumbent))
        if self.problem.shoots:
            converged = task.shoot()
        return task.answer(converged, sequence, computed_for)

    @checked
    def require(self, x: ArrayLike) -> Proposal:
        """Return a global optimum from x, or raise with the evidence.

        Raises
        ------
        InvalidInputError
            For a start that breaks a path constraint itself.
        InfeasibleError
            When no candidate was admissible; says what the best of them broke.
        """
        mechanism = self.loop.mechanism
        self.loop.objective.check_start(mechanism, mechanism.check_state(x))
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
