"""Selection of the surface: global the first time, warm-started afterwards."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np
import sympy as sp
from numpy.typing import ArrayLike

from undertow.base import InvalidInputError, at_least, between, check_fields, checked, checked_names
from undertow.closed_loop import ClosedLoop
from undertow.law import (
    Plan,
    ReachingLaw,
    Surface,
    check_surface,
    first_surface,
    quadratic_designs,
    stability_margin,
)
from undertow.models import FloatArray
from undertow.optimiser.proposal import Budget, Proposal, check_held
from undertow.optimiser.search import (
    CLOSE_BY,
    FINE,
    descend_close_by,
    global_search,
    local_search,
    restart_budget,
    search_earlier,
    single_budget,
)
from undertow.optimiser.search_space import DecisionVariables, SearchSpace
from undertow.optimiser.task import Optimisation

#: Quadratic designs that a global search begins with.
DESIGNS = 31

#: Rates at which a surface is reached gently, in multiples of the rate of its slowest sliding mode;
#: and the boundary layer of such a law, in multiples of it, too: so wide that motions stay within.
GENTLE, LINEAR = (1.0, 3.0, 10.0), 20.0


class Planner(Protocol):
    """Whatever proposes plans to a cascade: :class:`Optimiser`, or one of your own."""

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
        """Return a plan for the state x, the first one without an incumbent.

        See :meth:`Optimiser.propose`.
        """
        ...


@checked_names
@dataclass(frozen=True, eq=False)
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
        """Check the settings, and that the first surface can be used."""
        check_fields(self)
        check_surface(self.loop.mechanism, self.anchor)
        at_least(
            "population of the optimiser", self.population, 4, "32 fills two blocks of rollouts"
        )
        at_least("seed", self.seed, 0)

    def on(self, loop: ClosedLoop) -> Optimiser:
        """Return this optimiser for a loop of the same structure, with the same first surface."""
        return self._with(loop=loop)

    def _with(self, **changed: object) -> Optimiser:
        """Return this optimiser with some fields changed, and the same first surface."""
        other = object.__new__(type(self))
        derived = ("space", "firsts", "aims", "plainer", "in_seconds")
        kept = {k: v for k, v in vars(self).items() if k not in derived}
        other.__dict__.update(kept, anchor=self.anchor, designs=self.designs, **changed)
        return other

    @cached_property
    def plainer(self) -> Optimiser | None:
        """The optimiser of a plainer set of decision variables; ``None`` for the plainest."""
        freedom = self.freedom.plainer
        return None if freedom is None else self._with(freedom=freedom, cold=None)

    @cached_property
    def anchor(self) -> Surface:
        """The surface to start from, given or designed."""
        return self.first or first_surface(self.loop.mechanism)

    @cached_property
    def space(self) -> SearchSpace:
        """The coordinates of the search, around that surface."""
        return SearchSpace(self.loop, self.anchor, self.freedom)

    @property
    def counts_time(self) -> bool:
        """Whether the cost is the time of arrival, a discontinuous function of the plan."""
        return self.loop.price_of_time > 0

    @cached_property
    def in_seconds(self) -> Optimiser:
        """The optimiser itself; where the cost is that of time, the one whose seconds cost 1."""
        price, given = self.loop.price_of_time, self.loop.objective
        if price in (0.0, 1.0):
            return self
        seconds = replace(given, stage=lambda v: sp.sympify(given.stage(v)) / sp.Float(price))
        return self._with(loop=replace(self.loop, objective=seconds))

    @cached_property
    def aims(self) -> bool:
        """Whether this is a minimum-time task with enough parameters to aim with."""
        return self.counts_time and self.space.size >= 2 * self.loop.mechanism.n

    @cached_property
    def designs(self) -> tuple[Surface, ...]:
        """The first surface, and quadratic designs of random weights: all locally stable."""
        mechanism, rng = self.loop.mechanism, np.random.default_rng(self.seed)
        weights = 10 ** rng.uniform(-2, 2, (DESIGNS, 2 * mechanism.n))
        return (self.anchor, *quadratic_designs(mechanism, weights))

    @cached_property
    def firsts(self) -> FloatArray:
        """Search coordinates of the designs, (N, d); the first one is the anchor's.

        Where the reaching law is free and the cost smooth, each is reached gently, too: as a linear
        feedback, at rates near those at which it slides.
        """
        plans = [Plan.of(design) for design in self.designs]
        if self.space.frees_law and not self.counts_time:
            m, switching = self.loop.mechanism.m, self.loop.reaching.switching
            for design in self.designs:
                slides = float(stability_margin(self.loop.mechanism, design))
                layer = LINEAR * slides
                for rate in (faster * slides for faster in GENTLE):
                    law = ReachingLaw((layer * rate,) * m, (layer,) * m, switching)
                    plans.append(Plan((design,), (0.0,), (law,)))
        return np.vstack([self.space.encode(plan) for plan in plans])

    def _budget(self, warm: bool) -> Budget:
        given = self.warm if warm else self.cold
        if given is not None:
            return given
        if not warm:
            return self.usual_cold
        if self.freedom.schedule and self.counts_time:
            return Budget(16384 // self.loop.mechanism.n)
        return Budget(4096 if self.aims else 576 if self.counts_time else 1024)

    @property
    def usual_cold(self) -> Budget:
        """What a global optimisation needs, those with plainer sets of variables included."""
        plainer = 0 if self.plainer is None else self.plainer.usual_cold.evaluations
        size = self.space.size
        if self.counts_time:
            return Budget(plainer + 16384 * size)
        size //= self.space.segments
        several = self.freedom.schedule > 0 or self.space.segments > 1
        more = FINE * size if several else restart_budget(size)
        return Budget(plainer + single_budget(size) + more)

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
        admits: Callable[[Plan], bool] | None = None,
        asking: int = 0,
        part: float = 1.0,
        promised: float = math.inf,
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
        admits
            Whether a plan that arrives is admissible besides, asked of each that is better than
            all before; where the incumbent is not, the answer may be worse.
        asking
            What asking ``admits`` counts as, in evaluations: it takes as long.
        part
            What part of the evaluations of its budget the search may take, in (0, 1].
        promised
            What the incumbent was to cost, in a search for an earlier arrival: where nothing near
            it does, a single surface is looked for far and wide, too.

        Returns
        -------
        Proposal
            Always; an infeasible task is a status and not an exception.
        """
        warm = incumbent is not None
        longest = self.loop.objective.horizon if horizon is None else horizon
        between("part of the evaluations of a search", part, 0.0, 1.0, remedy="1 is usual")
        at_least("evaluations that asking counts as", asking, 0)
        given = budget or self._budget(warm)
        given = replace(given, evaluations=math.ceil(part * given.evaluations))
        task = self._task(x, longest, given, resolution, sequence, warm)
        task.admits, task.asking, task.promised = admits, asking, promised / task.unit
        task.usual = budget is None and self.warm is None
        if incumbent is None:
            *_, converged = global_search(task)
        elif self.counts_time:
            converged = search_earlier(task, Plan.of(incumbent))
        else:
            converged = local_search(task, Plan.of(incumbent))
        if warm and self.loop.ensemble is not None:
            task.fall_back()
        return task.answer(converged, computed_for)

    @checked
    def repair(self, x: ArrayLike, proposal: Proposal, *, horizon: float | None = None) -> Proposal:
        """Look close by for what is admissible, and as good, where a plan is not.

        For a plan that was searched for on a loop in larger steps: at its optimum a bound is
        active, and smaller steps find it broken by a hair.

        Parameters
        ----------
        x
            State, (2n,).
        proposal
            With the plan, and with the confidence that the answer takes over.
        horizon
            Longest prediction, s; the objective's by default.

        Returns
        -------
        Proposal
            Infeasible where nothing close by is admissible.
        """
        plan, longest = proposal.plan, self.loop.objective.horizon if horizon is None else horizon
        if plan is None:
            return proposal
        task = self._task(x, longest, Budget(CLOSE_BY), 0.0, proposal.sequence, False)
        converged = descend_close_by(task, plan)
        answer = task.answer(converged, proposal.computed_for)
        return replace(answer, confidence=proposal.confidence)

    @checked
    def improve(
        self, x: ArrayLike, *, sequence: int = 0, budget: Budget | None = None
    ) -> Iterator[Proposal]:
        """Optimise the plan from the state x from cold: one answer soon, and better ones later.

        The first one is the best of some designs, improved; the last one is what :meth:`propose`
        returns, without its margins.  Until the next one is asked for, nothing is computed.

        Parameters
        ----------
        x
            State, (2n,).
        sequence
            Number of the proposals.
        budget
            Overrides ``cold``, for all answers together.
        """
        longest = self.loop.objective.horizon
        task = self._task(x, longest, budget or self._budget(False), 0.0, sequence, False)
        return (task.answer(done, 0.0, judged=False) for done in global_search(task))

    def _task(
        self, x: ArrayLike, horizon: float, budget: Budget, resolution: float, sequence: int,
        warm: bool,
    ) -> Optimisation:  # fmt: skip
        at_least("sequence of a proposal", sequence, 0)
        if self.freedom.schedule and self.counts_time and self.loop.ensemble is not None:
            raise InvalidInputError(
                "schedule",
                value=f"{self.freedom.schedule:g} s",
                limit="for least time, one plant",
                remedy="Leave the ensemble out, or schedule",
            )
        early = 1.0 - min(0.5 * self.loop.tail_rtol, 0.1)  # a prediction may be, by its tolerance
        unit = self.loop.price_of_time or 1.0
        return Optimisation(
            self.in_seconds, self.loop.mechanism.check_state(x), horizon * early, budget,
            resolution=resolution / unit, sequence=sequence, warm=warm, unit=unit,
        )  # fmt: skip

    @checked
    def require(self, x: ArrayLike) -> Proposal:
        """Return a global optimum from x, or raise with the evidence.

        Raises
        ------
        InvalidInputError
            For a start that breaks a path constraint itself.
        InfeasibleError
            When no candidate was admissible, with what the best of them broke; before any search
            where the inputs cannot hold the target.
        """
        loop = self.loop
        loop.objective.check_start(loop.mechanism, loop.mechanism.check_state(x))
        check_held(loop)
        return self.propose(x).required(loop, loop.mechanism.check_state(x))
