"""The nonlinear programme: separated Hermite-Simpson collocation, solved by IPOPT."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np
import scipy.interpolate
import sympy as sp

from undertow.base import InvalidInputError
from undertow.bounds.expressions import dynamics, smooth
from undertow.bounds.guesses import Guess, rests, time_scale
from undertow.bounds.mesh import adapted_mesh, defects, first_mesh
from undertow.models import FloatArray, Mechanism, require_smooth
from undertow.models.importers import holding_input
from undertow.objective import Objective, finite_limits

#: Largest defect (see ``Bound.defect``) that a result may have: coarse meshes let a
#: programme "move" in ways that the mechanism cannot.
DEFECT = 1e-3

#: Relative change in cost below which the mesh is not refined further.
SETTLED = 5e-4

#: Refinements after the first mesh; the number of intervals grows by GROWTH each time.
REFINEMENTS = 6
GROWTH = 1.4

#: Where a least cost is this part of the unit of the tolerances, it is the unit from then on.
CHEAP = 0.1

#: IPOPT's iterations per solve.  Problems that have a solution need 15 to 60, few 150.
ITERATIONS = 200

#: Iterations for trying whether a motion can be run twice as fast: mostly 10 to 45.
HASTE = 60

#: How much faster a motion that may end early is run, until that costs so much more: of what swings
#: about its target the cost has a valley in each swing.
QUICKER, DEARER, SWINGING = 1.25, 1.05, 2.0

#: Mean of (u_i/u_max,i)² below which a motion could clearly be run faster.
IDLE = 0.05

#: In which parts of its limit an input is an unknown: with whole limits, which are small beside
#: states in rad and 1/s, the interior-point method loses its way to the acrobot's least time.
PARTS = 10.0

#: IPOPT's barrier where the guess is a motion of the mechanism already.  With its usual 0.1 the
#: first iterations leave such a guess for the middle of all bounds, and end in another valley, or
#: in none.
BARRIER = 1e-4

_IPOPT = {"print_level": 0, "sb": "yes", "tol": 1e-8}
_STATUS: dict[str, Literal["optimal", "acceptable"]] = {
    "Solve_Succeeded": "optimal",
    "Solved_To_Acceptable_Level": "acceptable",
}


@dataclass(frozen=True, eq=False)
class Solution:
    """A solved programme: nodes and midpoints in turn, as in ``Bound``."""

    name: str
    status: Literal["optimal", "acceptable"] | None
    message: str
    cost: float
    times: FloatArray
    x: FloatArray
    u: FloatArray
    violation: float
    stationarity: float
    iterations: int
    defect: float = math.inf
    change: float = math.inf

    @property
    def time(self) -> float:
        """Final time, s."""
        return float(self.times[-1])

    @property
    def mesh(self) -> FloatArray:
        """The nodes, scaled to [0, 1]."""
        return self.times[::2] / self.time

    @property
    def nodes(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Times (N+1,), states (N+1, 2n) and inputs (N+1, m) at the nodes."""
        return self.times[::2], self.x[::2], self.u[::2]

    def until(self, radius: float) -> Solution:
        """Return the motion until the first node in the ball of a radius, as the terminal set."""
        first = int(np.argmax(np.linalg.norm(self.x[::2], axis=1) <= radius * (1 + 1e-6)))
        count = 2 * first + 1 if first else len(self.times)
        return replace(self, times=self.times[:count], x=self.x[:count], u=self.u[:count])

    def as_guess(self, pace: float = 1.0) -> Guess:
        """Return the motion, run ``pace`` times as fast, as a guess for another programme."""
        n = self.x.shape[1] // 2
        times = self.times / pace
        faster = np.concatenate([self.x[:, :n], self.x[:, n:] * pace], axis=1)
        x = scipy.interpolate.make_interp_spline(times, faster, k=1)
        u = scipy.interpolate.make_interp_spline(times, self.u, k=1)
        return Guess(self.name, self.time / pace, x, u)


class _Transcription(NamedTuple):
    """A programme in CasADi's symbols: equations = 0, inequalities ≥ 0."""

    unknowns: Any
    cost: Any
    equations: Any
    inequalities: Any


class Programme:
    """The nonlinear programme of one problem, on any mesh."""

    def __init__(
        self, ca: Any, mechanism: Mechanism, objective: Objective, x0: FloatArray, longest: float
    ) -> None:
        self.ca, self.mechanism, self.x0, self.longest = ca, mechanism, x0, longest
        self.radius = objective.terminal_radius
        stage = objective.stage_cost(mechanism)
        _check_impulses(mechanism, stage)
        held = dict(zip(mechanism.u, holding_input(mechanism).tolist(), strict=True))
        target = mechanism.substitution | dict.fromkeys(mechanism.x, 0) | held
        self.rest_costs = float(stage.subs(target)) > 1e-12
        #: Whether another place may cost less than the target: a motion may wait there.
        self.waits = not self.rest_costs or any(stage.diff(u).subs(target) != 0 for u in held)
        self.scale = time_scale(mechanism, longest)
        limits = finite_limits(mechanism)
        self.units = limits / PARTS  # of the inputs as unknowns
        # ∫ effort dt weighs every input, from the one that holds the target, by its limit.
        effort = sum(((u - held[u]) / limit) ** 2 for u, limit in zip(held, limits, strict=True))
        margins = [w for m in objective.path_margins(mechanism) for w in smooth(m)]
        # IPOPT's derivatives of a kink are as wrong as anybody's, and it would call "optimal" what
        # is not even a local optimum.
        for what, expressions in (
            (f"stage cost of '{objective.name}', to be optimised,", [stage]),
            (f"a constraint of '{objective.name}', to be optimised,", margins),
            (f"force of '{mechanism.name}', to be optimised,", mechanism.force),
        ):
            require_smooth(what, expressions, (*mechanism.x, *mechanism.u))
        self.cost = dynamics(ca, mechanism, stage, margins)
        #: The cost that IPOPT's tolerances, which are absolute, take for one: at most 1.
        self.unit = 1.0
        self.effort = dynamics(ca, mechanism, sp.sympify(effort) / mechanism.m, margins)
        self._held: list[float] = []  # costs of motions until the horizon, each released once

    def _interval(self, dynamics: Any) -> Any:
        """One interval: its defects (4n), its cost, and the margins at its midpoint and end."""
        ca, n, m = self.ca, 2 * self.mechanism.n, self.mechanism.m
        t, h = ca.SX.sym("t"), ca.SX.sym("h")
        a, c, b = (ca.SX.sym(name, n) for name in ("x_start", "x_middle", "x_end"))
        u_a, u_b = (ca.SX.sym(name, m) for name in ("u_start", "u_end"))
        rate_a, cost_a, _ = dynamics(t, a, u_a)
        rate_c, cost_c, margin_c = dynamics(t + h / 2, c, (u_a + u_b) / 2)
        rate_b, cost_b, margin_b = dynamics(t + h, b, u_b)
        simpson = b - a - h / 6 * (rate_a + 4 * rate_c + rate_b)
        hermite = c - (a + b) / 2 - h / 8 * (rate_a - rate_b)
        cost = h / 6 * (cost_a + 4 * cost_c + cost_b)
        outputs = [ca.vertcat(hermite, simpson), cost, ca.vertcat(margin_c, margin_b)]
        return ca.Function("interval", [t, h, a, c, b, u_a, u_b], outputs)

    def _transcribe(self, mesh: FloatArray, dynamics: Any) -> _Transcription:
        """Write the programme on a mesh in [0, 1]; the final time is its last unknown.

        Inputs are in tenths of their limits: whether N or mN, and which of them is small, must not
        count.
        """
        ca, n, m, count = self.ca, 2 * self.mechanism.n, self.mechanism.m, len(mesh) - 1
        x, c = ca.MX.sym("x", n, count + 1), ca.MX.sym("c", n, count)
        u, end = ca.MX.sym("u", m, count + 1), ca.MX.sym("t_f")
        starts, steps = ca.DM(mesh[:-1]).T * end, ca.DM(np.diff(mesh)).T * end
        inputs = ca.DM(self.units) * u
        each = (starts, steps, x[:, :-1], c, x[:, 1:], inputs[:, :-1], inputs[:, 1:])
        defects, costs, margins = self._interval(dynamics).map(count)(*each)
        at_start = dynamics(0.0, x[:, 0], inputs[:, 0])[2]
        reach = 1 - ca.sumsqr(x[:, -1]) / self.radius**2  # of order 1, as the tolerances expect
        return _Transcription(
            unknowns=ca.vertcat(ca.vec(x), ca.vec(c), ca.vec(u), end),
            cost=ca.sum2(costs),
            equations=ca.vec(defects),
            inequalities=ca.vertcat(reach, at_start, ca.vec(margins)),
        )

    def solve(
        self,
        mesh: FloatArray,
        guess: Guess,
        dynamics: Any,
        *,
        fixed: float | None,
        patience: int = ITERATIONS,
        moves: bool = False,
    ) -> Solution:
        """Solve on a mesh in [0, 1], at a fixed final time or a free one near the guess's.

        ``moves``: the guess is a motion of the mechanism, and what is looked for is close by.

        Where rest costs something near is anywhere up to the horizon: shorter is always better.
        Where it costs nothing the cost is flat in a time that is too long, and the search for the
        time must not leave the valley that the guess lies in.  What is far cheaper than the unit of
        the tolerances is solved again in its own: the optimum must not depend on the cost's unit.
        """
        ca, n, m, count = self.ca, 2 * self.mechanism.n, self.mechanism.m, len(mesh) - 1
        written = self._transcribe(mesh, dynamics)
        constraints = ca.vertcat(written.equations, written.inequalities)
        equal, unequal = written.equations.numel(), written.inequalities.numel()

        limits = self.mechanism.input_limits
        if fixed is not None:
            shortest = longest = fixed
        elif self.rest_costs:
            shortest, longest = 1e-3 * guess.time, self.longest
        else:
            shortest, longest = guess.time / QUICKER, min(QUICKER * guess.time, self.longest)
        end = min(max(guess.time, shortest), longest)
        wide = np.concatenate(
            [np.full(2 * n * count, np.inf), np.tile(limits / self.units, count + 1)]
        )
        lower = np.concatenate([self.x0, -wide, [shortest]])
        upper = np.concatenate([self.x0, wide, [longest]])

        middles = (mesh[:-1] + mesh[1:]) / 2
        first = [guess.x(mesh * end), guess.x(middles * end), guess.u(mesh * end)]
        first[0][0], first[2] = self.x0, np.clip(first[2], -limits, limits) / self.units
        scaling = 1.0 / self.unit if dynamics is self.cost else 1.0
        ipopt = {**_IPOPT, "max_iter": patience, "obj_scaling_factor": scaling}
        if moves:
            ipopt["mu_init"] = BARRIER
        programme = {"x": written.unknowns, "f": written.cost, "g": constraints}
        options = {"print_time": False, "show_eval_warnings": False, "ipopt": ipopt}
        solver = ca.nlpsol("bound", "ipopt", programme, options)
        found = solver(
            x0=np.concatenate([*(part.ravel() for part in first), [end]]),
            lbx=lower,
            ubx=upper,
            lbg=np.zeros(equal + unequal),
            ubg=np.concatenate([np.zeros(equal), np.full(unequal, np.inf)]),
        )
        statistics = solver.stats()
        report = str(statistics["return_status"])
        solution, residual = (np.array(found[key]).ravel() for key in ("x", "g"))
        broken = (
            np.abs(residual[:equal]).max(),
            -residual[equal:].min(),
            (lower - solution).max(),
            (solution - upper).max(),
        )
        nodes, centres, controls, last = np.split(
            solution, np.cumsum([n * (count + 1), n * count, m * (count + 1)])
        )
        u, cost, iterations = (
            controls.reshape(-1, m) * self.units,
            float(found["f"]),
            statistics["iter_count"],
        )
        if dynamics is self.cost and report in _STATUS and 0 < cost < CHEAP * self.unit:
            self.unit = cost
            again = self.solve(mesh, guess, dynamics, fixed=fixed, patience=patience, moves=moves)
            return replace(again, iterations=again.iterations + iterations)
        return Solution(
            name=guess.name,
            status=_STATUS.get(report),
            message=report.replace("_", " ").lower(),
            cost=cost,
            times=_weave(mesh, middles) * float(last[0]),
            x=_weave(nodes.reshape(-1, n), centres.reshape(-1, n)),
            u=_weave(u, (u[:-1] + u[1:]) / 2),
            violation=max(0.0, *(float(b) for b in broken)),
            stationarity=self._stationarity(written, constraints, found),
            iterations=int(iterations),
        )

    def _stationarity(self, written: _Transcription, constraints: Any, found: Any) -> float:
        """Largest entry of the gradient of the Lagrangian, relative to the cost's own."""
        ca = self.ca
        multipliers = ca.MX.sym("multipliers", constraints.numel())
        lagrangian = written.cost + ca.dot(multipliers, constraints)
        gradients = ca.Function(
            "gradients",
            [written.unknowns, multipliers],
            [ca.gradient(f, written.unknowns) for f in (lagrangian, written.cost)],
        )
        slope, steepness = gradients(found["x"], found["lam_g"])
        largest = np.abs(np.array(slope + found["lam_x"])).max()
        return float(largest / max(self.unit, np.abs(np.array(steepness)).max()))

    def first(self, guess: Guess, count: int) -> Solution:
        """Solve on the first mesh.

        Where rest costs something, see :meth:`_hurried`.  Where it costs nothing, or less
        elsewhere, the motion until the horizon comes first, and its time is released where it
        first arrives.
        """
        hurried = [self._hurried(guess, count)] if self.rest_costs else []
        waiting = [self._waiting(guess, count)] if self.waits else []
        found = hurried + waiting
        best = min(found, key=lambda s: math.inf if s.status is None else s.cost)
        return replace(best, iterations=sum(s.iterations for s in found))

    def _waiting(self, guess: Guess, count: int) -> Solution:
        """Solve until the horizon, and release the final time."""
        mesh = first_mesh(count, 1.0 if rests(self.mechanism) else self.scale / self.longest)
        held = self.solve(mesh, guess, self.cost, fixed=self.longest)
        known = np.isclose(held.cost, self._held, rtol=1e-7, atol=0.0).any()
        if held.status is not None and not known:
            self._held.append(held.cost)
            held = self._released(held, count)
        return held

    def _hurried(self, guess: Guess, count: int) -> Solution:
        """Solve for a free final time where rest costs something.

        It collapses when it starts far from its optimum.  So the motion of least effort at a fixed
        time comes first; the time is halved while the inputs have much to spare, and only then
        released.
        """
        spent = 0
        mesh = np.linspace(0.0, 1.0, count + 1)
        durations = {min(guess.time, 2.0 * self.scale), guess.time, 3.0 * guess.time}
        for duration in sorted({min(d, self.longest) for d in durations}):
            tried = self.solve(mesh, guess, self.effort, fixed=duration)
            spent += tried.iterations
            shorter = tried
            while shorter.status is not None and shorter.cost < IDLE * shorter.time:
                tried = shorter
                faster, half = tried.as_guess(pace=2.0), tried.time / 2.0
                shorter = self.solve(mesh, faster, self.effort, fixed=half, patience=HASTE)
                spent += shorter.iterations
            if shorter.status is not None:
                tried = shorter
            if tried.status is not None:
                tried = self.solve(mesh, tried.as_guess(), self.cost, fixed=None, moves=True)
                spent += tried.iterations
            if tried.status is not None:
                break
        return replace(tried, iterations=spent)

    def _released(self, held: Solution, count: int) -> Solution:
        """Let the final time of a motion go from where it first arrives, if that is early.

        The cost hardly depends on a final time that is much too long, so ever shorter ones are
        tried first, until the cost has risen; gains within the meshes' own error are none.  Of
        what swings about its target each swing is a valley, and the best one of all is looked for.
        """
        arrives, swings = held.until(self.radius), rests(self.mechanism)
        if arrives.time >= held.time and not swings:
            return held
        mesh, spent = np.linspace(0.0, 1.0, count + 1), held.iterations
        best, next_guess = held, arrives.as_guess()
        dearer = SWINGING if swings else DEARER
        while next_guess.time > 1e-3 * arrives.time:
            time = next_guess.time
            for fixed in (None, time) if swings else (time,):
                tried = self.solve(mesh, next_guess, self.cost, fixed=fixed)
                spent += tried.iterations
                if tried.status is not None:
                    break
            if tried.status is None or tried.cost > dearer * best.cost:
                break
            best = min(best, tried, key=lambda s: s.cost)
            next_guess = tried.as_guess(pace=QUICKER * tried.time / time)
        if best.cost >= (1.0 - SETTLED) * held.cost:
            return replace(held, iterations=spent)
        freed = self.solve(mesh, best.as_guess(), self.cost, fixed=None, moves=True)
        if freed.status is not None and freed.cost < best.cost:
            best = freed
        return replace(best, iterations=spent + freed.iterations)

    def near(self, guess: Guess, count: int) -> Solution | None:
        """Solve at a free final time near that of a motion that arrives; None for another one."""
        end = guess.x(np.array([0.0, guess.time]))[-1]
        if guess.time > self.longest or np.linalg.norm(end) > self.radius * (1 + 1e-6):
            return None
        mesh = np.linspace(0.0, 1.0, count + 1)
        return self.solve(mesh, guess, self.cost, fixed=None, moves=True)

    def refine(self, solution: Solution) -> Solution:
        """Adapt and refine the mesh until cost and defects have settled."""
        spent, held = 0, solution.time >= self.longest
        errors = defects(self.mechanism, *solution.nodes)
        for _ in range(REFINEMENTS):
            count = math.ceil(GROWTH * (len(solution.mesh) - 1))
            mesh = adapted_mesh(solution.mesh, errors, solution.u[::2], count)
            fixed = self.longest if held else None
            finer = self.solve(mesh, solution.as_guess(), self.cost, fixed=fixed, moves=True)
            spent += finer.iterations
            if finer.status is None:
                return replace(finer, iterations=spent)
            errors = defects(self.mechanism, *finer.nodes)
            solution = replace(
                finer,
                defect=float(errors.max()),
                change=abs(finer.cost - solution.cost) / (abs(finer.cost) or 1.0),
            )
            if solution.defect <= DEFECT and solution.change <= SETTLED:
                break
        solution = replace(solution, iterations=spent)
        if solution.defect > DEFECT:
            message = f"not resolved by {len(solution.mesh) - 1} intervals, {solution.defect:.1e}"
            return replace(solution, status=None, message=message)
        return solution


def _check_impulses(mechanism: Mechanism, stage: sp.Expr) -> None:
    """Refuse an input that is neither limited nor paid for: its optimum is an impulse."""
    for given in mechanism.inputs:
        if math.isinf(given.limit) and given.symbol not in stage.free_symbols:
            raise InvalidInputError(
                f"input '{given.name}' of '{mechanism.name}' has no cost",
                value="no limit",
                limit="finite",
                remedy="Give it one with mechanism.with_input_limit(…)",
            )


def _weave(nodes: FloatArray, middles: FloatArray) -> FloatArray:
    """Return nodes and midpoints in turn."""
    out = np.empty((len(nodes) + len(middles), *nodes.shape[1:]))
    out[::2], out[1::2] = nodes, middles
    return out
