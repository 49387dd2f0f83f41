"""One optimisation of the surface: global the first time, warm-started afterwards.

The search runs in symmetric-logarithmic coordinates z with p = w sinh z, entry by entry,
around a first surface: entries may change sign, and small and large values are resolved
alike.  Unstable surfaces never reach the rollout; inadmissible motions get a graded
penalty, see :meth:`undertow.rollout.Batch.score`.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from undertow.errors import InfeasibleError, InvalidInputError, SingularSurfaceError, UndertowError
from undertow.mechanism import FloatArray
from undertow.rollout import ClosedLoop, Event
from undertow.search import CMAES, minimise
from undertow.sliding import Surface
from undertow.stability import Margin, first_surface, stability_margin, surface_margins

__all__ = ["Budget", "Optimiser", "Proposal", "Status"]

Status = Literal["converged", "budget spent", "infeasible", "failed"]

#: Costs from here on mark inadmissible motions (see ``Batch.score``).
INADMISSIBLE = 1e8

#: Rollouts are given up when their cost exceeds the best one so far by this factor.
HOPELESS = 3.0


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
        if self.evaluations < 1 or not self.seconds > 0:
            raise InvalidInputError(
                "budget of an optimisation",
                value=f"{self.evaluations} evaluations, {self.seconds} s",
                limit="at least 1 evaluation and more than 0 s",
            )


@dataclass(frozen=True, eq=False)
class Proposal:
    """An answer of the optimiser, with what is needed to judge it.

    Attributes
    ----------
    surface
        The best surface found, ``None`` when there is none.
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
    message
        What went wrong, in words.
    """

    surface: Surface | None
    status: Status
    cost: float
    incumbent_cost: float
    margins: tuple[Margin, ...]
    evaluations: int
    seconds: float
    sequence: int
    computed_for: float
    message: str = ""


@dataclass(eq=False)
class Optimiser:
    """Selects the surface that minimises the predicted cost of a closed loop.

    Parameters
    ----------
    loop
        The predicted closed loop (the controller's belief).
    first
        Surface to start from; designed by :func:`undertow.first_surface` by default.
    cold
        Budget of a global optimisation.
    warm
        Budget of a re-optimisation from an incumbent.
    population
        Candidates per generation.
    seed
        Seed of all randomness.  A proposal depends on the seed and its sequence number,
        not on earlier calls, so a recorded run can be replayed.
    """

    loop: ClosedLoop
    first: Surface | None = None
    cold: Budget = field(default_factory=lambda: Budget(3072))
    warm: Budget = field(default_factory=lambda: Budget(1024))
    population: int = 32
    seed: int = 0

    def __post_init__(self) -> None:
        """Design the first surface and the scale of the search around it."""
        if self.first is None:
            self.first = first_surface(self.loop.mechanism)
        self._anchor = self.first.normalised().vector[self._fixed :]
        scale = np.abs(self._anchor)
        self._width = 0.1 * np.maximum(scale, 0.05 * scale.max())

    @property
    def _promptness(self) -> float:
        """Part of the horizon to plan for: the linear end may be late by its tolerance."""
        return 1.0 - min(0.5 * self.loop.tail, 0.1)

    @property
    def _fixed(self) -> int:
        return self.loop.mechanism.m**2

    def encode(self, surface: Surface) -> FloatArray:
        """Return the search coordinates of a surface, (2mn − m²,)."""
        return np.asarray(np.arcsinh(surface.normalised().vector[self._fixed :] / self._width))

    def decode(self, z: FloatArray) -> FloatArray:
        """Return the surface vectors at search coordinates: (N, 2mn − m²) to (N, 2mn)."""
        alpha_a = -np.eye(self.loop.mechanism.m).ravel()
        free = self._width * np.sinh(np.clip(z, -20.0, 20.0))
        return np.hstack([np.broadcast_to(alpha_a, (len(z), alpha_a.size)), free])

    def propose(
        self,
        x: ArrayLike,
        *,
        incumbent: Surface | None = None,
        horizon: float | None = None,
        sequence: int = 0,
        computed_for: float = 0.0,
        resolution: float = 0.0,
        budget: Budget | None = None,
    ) -> Proposal:
        """Optimise the surface from the state x.

        Parameters
        ----------
        x
            State, (2n,).
        incumbent
            The surface in use: warm start, and the answer is never worse than it.
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
        if budget is None:
            budget = self.cold if incumbent is None else self.warm
        task = _Task(
            self,
            state,
            (self.loop.objective.horizon if horizon is None else horizon) * self._promptness,
            budget,
            resolution,
            began,
            np.random.default_rng([self.seed, sequence]),
        )
        converged = task.global_search() if incumbent is None else task.local_search(incumbent)
        return task.answer(converged, sequence, computed_for)

    def require(self, x: ArrayLike) -> Proposal:
        """Return a global optimum from x, or raise with the evidence.

        Raises
        ------
        InfeasibleError
            When no candidate was admissible; says what the best of them broke.
        """
        proposal = self.propose(x)
        if proposal.surface is None:
            worst = min(proposal.margins, key=lambda m: m.value, default=None)
            raise InfeasibleError(
                f"no admissible surface for '{self.loop.mechanism.name}' "
                f"({self.loop.objective.name}) among {proposal.evaluations}",
                value=proposal.message,
                limit="every margin ≥ 0 and the terminal set reached within "
                f"{self.loop.objective.horizon:g} s",
                remedy=worst.remedy if worst else "Start closer to the target",
            )
        return proposal


class _Task:
    """The state of one running optimisation."""

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
        self.evaluations = 0
        self.best_cost, self.best_vector = math.inf, None
        self.incumbent_cost = math.inf

    def cost(self, z: FloatArray) -> FloatArray:
        return self.evaluate(self.owner.decode(z))

    def evaluate(self, vectors: FloatArray) -> FloatArray:
        """Score surface vectors, keeping the best: unstable 1e10, inadmissible 1e9 and up."""
        loop = self.owner.loop
        self.evaluations += len(vectors)
        cap = math.inf
        if self.best_cost < INADMISSIBLE:
            cap = HOPELESS * self.best_cost + self.resolution
        scores = np.full(len(vectors), 1e10)
        stable = np.full(len(vectors), True)
        if loop.linear_end is None:
            stable = stability_margin(loop.mechanism, vectors) > 0
        if stable.any():
            scores[stable] = loop.batch(
                self.x,
                vectors[stable],
                duration=self.horizon,
                cap=cap,
                slack=self.resolution,
                stable_only=True,
            ).score(self.horizon)
        best = int(np.argmin(scores))
        if scores[best] < self.best_cost:
            self.best_cost, self.best_vector = float(scores[best]), vectors[best].copy()
        return np.asarray(scores)

    def late(self) -> bool:
        return time.perf_counter() - self.began >= self.budget.seconds

    @property
    def left(self) -> int:
        return self.budget.evaluations - self.evaluations

    def _descend(self, z: FloatArray, sigma: float, evaluations: int, tolerance: float) -> bool:
        search = CMAES(z, sigma, self.owner.population, self.rng)
        minimise(
            search,
            self.cost,
            evaluations=evaluations,
            tolerance=tolerance,
            resolution=self.resolution,
            stop=self.late,
        )
        return search.converged

    def global_search(self) -> bool:
        """Sample widely, then descend from the three best; refine the winner."""
        owner, rng = self.owner, self.rng
        assert owner.first is not None
        anchor = owner.encode(owner.first)
        draws = max(owner.population, self.budget.evaluations // 6)
        z = np.vstack(
            [anchor, *self._designs(16), anchor + rng.standard_normal((draws, anchor.size))]
        )
        scores = self.cost(z)
        starts = z[np.argsort(scores, kind="stable")[:3]]
        share = self.left // 4
        for start in starts:
            self._descend(start, 0.3, share, 3e-3)
        return self._descend(self._best_z(), 0.03, self.left, 1e-4)

    def local_search(self, incumbent: Surface) -> bool:
        """Start from the incumbent: a wide look around, then descend from the best."""
        vector = incumbent.normalised().vector
        self.incumbent_cost = float(self.evaluate(vector[None])[0])
        here = self.owner.encode(incumbent)
        wide = min(self.left, self.owner.population)
        if wide == 0:
            return False
        steps = np.geomspace(0.03, 1.0, wide)[:, None]
        self.cost(here + steps * self.rng.standard_normal((wide, here.size)))
        return self._descend(self._best_z(), 0.1, self.left, 1e-3)

    def _best_z(self) -> FloatArray:
        assert self.best_vector is not None  # evaluate() has run at least once
        mechanism = self.owner.loop.mechanism
        return self.owner.encode(Surface.from_vector(self.best_vector, mechanism.n, mechanism.m))

    def _designs(self, count: int) -> list[FloatArray]:
        """Quadratic designs with random weights: all of them locally stable."""
        mechanism = self.owner.loop.mechanism
        designs = []
        for weights in 10 ** self.rng.uniform(-2, 2, (count, 2 * mechanism.n)):
            try:
                designs.append(self.owner.encode(first_surface(mechanism, list(weights))))
            except UndertowError:
                continue
        return designs

    def answer(self, converged: bool, sequence: int, computed_for: float) -> Proposal:
        """Pack the best admissible surface with its margins."""
        mechanism = self.owner.loop.mechanism
        found = self.best_vector is not None and self.best_cost < INADMISSIBLE
        surface, margins, message = None, (), ""
        if self.best_vector is not None:
            candidate = Surface.from_vector(self.best_vector, mechanism.n, mechanism.m)
            margins, message = motion_margins(self.owner.loop, candidate, self.x, self.horizon)
            if found:
                surface, message = candidate, ""
        status: Status = "infeasible"
        if found:
            status = "converged" if converged else "budget spent"
        return Proposal(
            surface,
            status,
            self.best_cost if found else math.inf,
            self.incumbent_cost if self.incumbent_cost < INADMISSIBLE else math.inf,
            margins,
            self.evaluations,
            time.perf_counter() - self.began,
            sequence,
            computed_for,
            message,
        )


def motion_margins(
    loop: ClosedLoop, surface: Surface, x: FloatArray, horizon: float
) -> tuple[tuple[Margin, ...], str]:
    """Return the margins of a surface and of its predicted motion, and how that ends."""
    objective = loop.objective
    try:
        margins = list(surface_margins(loop.mechanism, surface, x[: loop.mechanism.n]))
    except SingularSurfaceError as error:
        return (), str(error)
    batch = loop.batch(x, [surface], duration=horizon)
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
    return tuple(margins), f"the best candidate {ending}"
