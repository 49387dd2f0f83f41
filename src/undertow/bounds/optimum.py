"""The question and its answer: :func:`bound` and the :class:`Bound` that it returns."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from undertow.base import (
    InfeasibleError,
    InvalidInputError,
    at_least,
    checked,
    positive,
    require_extra,
)
from undertow.bounds.guesses import built_in, recorded
from undertow.bounds.mesh import hermite
from undertow.bounds.programme import Programme, Solution
from undertow.closed_loop import Trajectory
from undertow.models import FloatArray, Mechanism, StateLike, in_degrees
from undertow.objective import Objective


@dataclass(frozen=True, eq=False)
class Bound:
    """An optimal-control bound with the motion that attains it and how good it is.

    Attributes
    ----------
    mechanism
        The plant that moves.
    cost
        The least cost found, in the objective's unit.
    time
        Final time t_f, s.
    status
        ``"optimal"`` (IPOPT's tolerances met) or ``"acceptable"`` (its looser ones).
    message
        IPOPT's own words.
    guess
        The initial guess that led here.
    t
        Nodes and midpoints of the mesh in turn, (2N+1,), s; nodes have even indices.
    x
        States there, (2N+1, 2n), SI units.
    u
        Inputs there, (2N+1, m); linear between nodes.
    defect
        Distance from the equations of motion *between* the nodes: the largest
        ∫|ẋ̃ − f(x̃, u)| dt over an interval and a state, over 1 + max |x_i|.  Computed from
        the mechanism itself by Gauss quadrature, not from the programme's own constraints.
    violation
        Largest violation of any constraint of the programme.
    stationarity
        Largest entry of the gradient of the Lagrangian, over max |∇ cost|, or over 1 or a
        cheap motion's cost where that is more.
    change
        Relative change in cost at the last mesh refinement: an estimate of the
        discretisation error.
    iterations
        IPOPT's iterations in all, failed guesses and coarser meshes included.
    seconds
        Wall time in all, s.
    """

    mechanism: Mechanism
    cost: float
    time: float
    status: Literal["optimal", "acceptable"]
    message: str
    guess: str
    t: FloatArray
    x: FloatArray
    u: FloatArray
    defect: float
    violation: float
    stationarity: float
    change: float
    iterations: int
    seconds: float

    def __repr__(self) -> str:
        """Show the cost, the time and how good the number is."""
        return (
            f"Bound({self.mechanism.name}, cost {self.cost:.6g}, time {self.time:.4g} s, "
            f"{self.status}, {self.intervals} intervals, last refinement {self.change:.1e})"
        )

    @property
    def intervals(self) -> int:
        """Number of intervals N of the final mesh."""
        return len(self.t) // 2

    def input(self, t: ArrayLike) -> FloatArray:
        """Return u at the times t: (…) to (…, m); piecewise linear, held after the end."""
        times = np.asarray(t, dtype=float)
        return np.stack(
            [np.interp(times, self.t[::2], column[::2]) for column in self.u.T], axis=-1
        )

    def state(self, t: ArrayLike) -> FloatArray:
        """Return x at the times t: (…) to (…, 2n); cubic between nodes, held after the end."""
        if len(self.t) == 1:
            return np.broadcast_to(self.x[0], (*np.shape(t), self.x.shape[1])).copy()
        return np.asarray(self._spline(np.clip(t, self.t[0], self.t[-1])))

    @cached_property
    def _spline(self) -> Any:
        return hermite(self.mechanism, self.t[::2], self.x[::2], self.u[::2])


@checked
def bound(
    mechanism: Mechanism,
    objective: Objective,
    x0: StateLike | None = None,
    *,
    horizon: float | None = None,
    intervals: int = 100,
    guess: Trajectory | Sequence[Trajectory] | None = None,
    swing: bool = False,
    **state: float,
) -> Bound:
    """Return the optimal-control bound on an objective from a state.

    Parameters
    ----------
    mechanism
        The model, with its input limits; any n and m.
    objective
        Stage cost Φ, terminal radius ν and path constraints, which hold at nodes and
        midpoints.
    x0
        Initial state (q, q̇), (2n,), SI units; or give its non-zero entries by name
        (``phi=0.7``).  With neither, the mechanism's usual ``start``.
    horizon
        Longest final time, s; the objective's by default.
    intervals
        Intervals of the first mesh; it is refined where the motion needs it.
    guess
        Recorded motions to start from besides the built-in guesses, e.g. a simulated
        closed loop.
    swing
        Also start from motions that let each unactuated angle fall to its far side and
        swing back.

    Returns
    -------
    Bound
        The cheapest motion found from all guesses.

    Raises
    ------
    InvalidInputError
        For a state, horizon, mesh or guess that cannot be used.
    MissingExtraError
        When CasADi is not installed.
    ModelError
        For a cost, a constraint or a force with kinks, but for the moduli of a box.
    InfeasibleError
        When no guess led to an admissible motion.  That proves nothing: other guesses may.

    Notes
    -----
    *Final time.*  The cost is counted until the terminal set is first reached, as in the
    rollouts, and t_f ≤ horizon is free.  Where rest at the target costs something (minimum
    time: Φ = 1, or energy where an input u_e has to hold a load), shorter is mostly better.
    Where it costs nothing, Φ(0, u_e) = 0 (minimum energy without a load), more time mostly
    helps and t_f is the horizon; but a motion that is held inside the terminal set until
    then pays for it, about ν² λ_max(P) with P of the linear-quadratic regulator of least
    effort, and may be cheaper when it ends where it arrives: 0.8 % from a pendubot's small
    angles.  Gains below 5e-4 of the cost are none: then t_f is the horizon.  Of a mechanism
    that swings about its target every swing has a valley of its own; they are tried one by
    one.

    *Basins.*  The built-in guesses go straight to the target.  A mechanism may have other,
    far cheaper ways: a rotary pendulum at 41° that is let fall, swings through the bottom
    and comes up again needs about a twentieth of the energy, and even a little less time
    (``swing=True`` finds that).  No stable sliding surface can do so, since (37) confines it
    to less than a right angle; to bound *its* cost, ask the same of every input:
    ``constraints=state_box(phi=math.pi / 2)``.

    Examples
    --------
    >>> import undertow as ut
    >>> rig = ut.mechanisms.rotary_pendulum(d_e=0.025)
    >>> found = bound(rig, ut.MinimumTime(), phi=ut.deg(41))
    >>> round(found.cost, 2)
    0.51
    """
    began = time.perf_counter()
    objective = objective.on(mechanism)
    start = mechanism.initial_state(x0, state)
    longest = _check(mechanism, objective, start, horizon, intervals)
    if float(np.linalg.norm(start)) <= objective.terminal_radius:
        return _bound(mechanism, _at_target(mechanism, start), began)
    given = recorded(mechanism, guess)
    casadi = require_extra("casadi", "bounds", "optimal-control bounds need CasADi")
    programme = Programme(casadi, mechanism, objective, start, longest)
    candidates: list[Solution] = []
    failures: list[str] = []
    iterations = 0
    guesses = (*given, *built_in(mechanism, start, programme.scale, longest, swing))
    recordings = (programme.near(motion, intervals) for motion in given)
    for tried in (*filter(None, recordings), *(programme.first(g, intervals) for g in guesses)):
        iterations += tried.iterations
        if tried.status is None:
            failures.append(f"{tried.name}: {tried.message}")
        else:
            candidates.append(tried)
    best: Solution | None = None
    for candidate in sorted(candidates, key=lambda c: c.cost):
        if best is not None and best.cost <= candidate.cost:
            break
        refined = programme.refine(candidate)
        iterations += refined.iterations
        if refined.status is None:
            failures.append(f"{candidate.name}: {refined.message}")
        elif best is None or refined.cost < best.cost:
            best = refined
    if best is None or best.status is None:
        raise InfeasibleError(
            f"no optimal control found for '{mechanism.name}', {objective.name}",
            value="; ".join(failures),
            limit=f"a motion from x0 to ‖x‖ ≤ {objective.terminal_radius:g} "
            f"within {longest:g} s and the input limits",
            remedy=in_degrees(mechanism.coordinates, mechanism.m, start)
            or "Pass guess= a motion that arrives, try swing=True, or relax the limits",
        )
    return _bound(mechanism, replace(best, iterations=iterations), began)


def _bound(mechanism: Mechanism, found: Solution, began: float) -> Bound:
    shared = {f.name: getattr(found, f.name) for f in fields(Bound) if hasattr(found, f.name)}
    seconds = time.perf_counter() - began
    return Bound(mechanism, guess=found.name, t=found.times, seconds=seconds, **shared)


def _check(
    mechanism: Mechanism,
    objective: Objective,
    start: FloatArray,
    horizon: float | None,
    intervals: int,
) -> float:
    """Refuse what cannot be solved before any long work; return the horizon."""
    travels = mechanism.coordinates if objective.travel else ()
    for coordinate, value in zip(travels, start, strict=False):
        if not coordinate.low <= value <= coordinate.high:
            raise InvalidInputError(
                f"initial {coordinate.name} of '{mechanism.name}'",
                value=f"{value:g} {coordinate.unit}",
                limit=f"in its range [{coordinate.low:g}, {coordinate.high:g}]",
            )
    longest = objective.horizon if horizon is None else float(horizon)
    positive("horizon of the bound, s", longest)
    at_least("intervals of the first mesh", intervals, 10)
    objective.check_start(mechanism, start)
    return longest


def _at_target(mechanism: Mechanism, start: FloatArray) -> Solution:
    return Solution(
        name="none needed",
        status="optimal",
        message="the initial state is inside the terminal set",
        cost=0.0,
        times=np.zeros(1),
        x=start[None],
        u=np.zeros((1, mechanism.m)),
        violation=0.0,
        stationarity=0.0,
        iterations=0,
        defect=0.0,
        change=0.0,
    )
