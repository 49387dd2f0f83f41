"""The controllers that Undertow is compared with, each written as well as we can.

* :func:`riccati`, :func:`tuned` and :meth:`Plant.regulated`: linear-quadratic feedback, clipped,
  evaluated continuously.
* :class:`ShootingMPC`: nonlinear model predictive control by multiple shooting in CasADi, solved
  by IPOPT or fatrop with exact derivatives and warm-started with the shifted plan.
* :class:`DoMPC`: the same tasks in do-mpc, by collocation, solved by IPOPT; with an ensemble of
  plants it is scenario (multi-stage) predictive control.

All of them take the equations of motion from the same mechanism.  predictive.py has the real-time
iteration.
"""

from __future__ import annotations

import contextlib
import math
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal

import numpy as np
import scipy.linalg
import sympy as sp

import undertow as ut
from harness import Clock, need, progress
from undertow.bounds.expressions import translate
from undertow.models import TIME, FloatArray, linearise
from undertow.symbolic import Tape

__all__ = ["Box", "DoMPC", "Outcome", "Plant", "Regulator", "ShootingMPC", "riccati", "tuned"]

#: Weight of ‖x‖² beside u² that stands for minimum energy: the infinite-horizon problem without
#: any has no optimum where a mode neither grows nor decays.
SLOW = 1e-2

#: How CasADi compiles what it generates, in a folder that goes by itself.
GCC = {"compiler": "gcc", "flags": ["-O3", "-march=native"], "cleanup": False}
COMPILED = {"jit": True, "compiler": "shell", "jit_options": GCC, "jit_cleanup": False}


#: Names of coordinates and how far each may go, (low, high).
Box = Mapping[str, tuple[float, float]]


def ends(mechanism: ut.Mechanism, box: Box) -> tuple[FloatArray, FloatArray]:
    """Return the lowest and the highest state that a box allows, (2n,) each."""
    low, high = np.full(2 * mechanism.n, -np.inf), np.full(2 * mechanism.n, np.inf)
    for index, coordinate in enumerate(mechanism.coordinates):
        low[index], high[index] = box.get(coordinate.name, (-np.inf, np.inf))
    return low, high


def parameters(mechanism: ut.Mechanism, names: Sequence[str]) -> FloatArray:
    """Return the values of some parameters, (p,)."""
    values = {p.name: p.value for p in mechanism.parameters}
    return np.array([values[name] for name in names])


def rates(
    ca: Any, mechanism: ut.Mechanism, x: Any, u: Any, free: Mapping[str, Any] | None = None
) -> Any:
    """Return ẋ = (q̇, M⁻¹(f + B u)) in CasADi's symbols; ``free`` parameters by their names."""
    tape = Tape()
    outputs = mechanism.partition(tape).accelerations(sp.Matrix(mechanism.u))
    known: dict[sp.Basic, Any] = {TIME: 0.0, **mechanism.substitution}
    known |= {p.symbol: free[p.name] for p in mechanism.parameters if free and p.name in free}
    known |= zip(mechanism.x, ca.vertsplit(x), strict=True)
    known |= zip(mechanism.u, ca.vertsplit(u), strict=True)
    for line in tape.live(outputs):
        known[line.symbol] = translate(ca, line.expression, known)
    return ca.vertcat(x[mechanism.n :], *(translate(ca, o, known) for o in outputs))


def dynamics(ca: Any, mechanism: ut.Mechanism, names: Sequence[str] = ()) -> Any:
    """Return the CasADi function (x, u) -> ẋ, or (x, u, p) -> ẋ where parameters are named."""
    x, u = ca.SX.sym("x", 2 * mechanism.n), ca.SX.sym("u", mechanism.m)
    if not names:
        return ca.Function("rates", [x, u], [rates(ca, mechanism, x, u)])
    p = ca.SX.sym("p", len(names))
    free = dict(zip(names, ca.vertsplit(p), strict=True))
    return ca.Function("rates", [x, u, p], [rates(ca, mechanism, x, u, free)])


def runge_kutta(f: Callable[[Any], Any], z: Any, h: Any) -> Any:
    """One classical Runge-Kutta step of ż = f(z)."""
    k1 = f(z)
    k2 = f(z + h / 2 * k1)
    k3 = f(z + h / 2 * k2)
    k4 = f(z + h * k3)
    return z + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def riccati(mechanism: ut.Mechanism, weight: float) -> tuple[FloatArray, FloatArray]:
    """Return P and K of the regulator that minimises ∫ uᵀu + weight·xᵀx dt, u = −K x."""
    lin = linearise(mechanism)
    B = lin.input
    Q, R = weight * np.eye(2 * mechanism.n), np.eye(mechanism.m)
    P = np.asarray(scipy.linalg.solve_continuous_are(lin.A, B, Q, R), dtype=float)
    return P, B.T @ P


@dataclass(frozen=True, eq=False)
class Outcome:
    """A closed-loop run until ‖x‖ ≤ ν: energy ∫uᵀu dt, time, and where it stood at the end.

    ``lost``: it left its box, or went beyond all reason.
    """

    energy: float
    time: float
    radius: float
    reached: bool
    lost: bool = False

    @property
    def event(self) -> str:
        """How it ended."""
        return "REACHED" if self.reached else "CONSTRAINT" if self.lost else "HORIZON"


Control = Callable[[float, FloatArray], FloatArray]

#: ‖x‖ from which on a run is given up.
LOST = 1e3


class Plant:
    """The truth: Runge-Kutta steps of 2 ms, until the terminal set or the horizon."""

    STEP = 0.002

    def __init__(
        self, mechanism: ut.Mechanism, radius: float, horizon: float, box: Box | None = None
    ) -> None:
        self.ca = need("casadi", "compare")
        self.mechanism, self.radius, self.horizon = mechanism, radius, horizon
        self._low, self._high = ends(mechanism, box or {})
        self.limits = mechanism.input_limits
        ca, n, m = self.ca, 2 * mechanism.n, mechanism.m
        self._rates = dynamics(ca, mechanism)
        x, u = ca.SX.sym("x", n), ca.SX.sym("u", m)
        held = runge_kutta(lambda y: self._rates(y, u), x, self.STEP)
        self._held = ca.Function("held", [x, u], [held])
        z, K = ca.SX.sym("z", n + 1), ca.SX.sym("K", m, n)

        def regulated(y: Any) -> Any:
            u = ca.fmax(-self.limits, ca.fmin(self.limits, -K @ y[:n]))
            return ca.vertcat(self._rates(y[:n], u), ca.sumsqr(u))

        step = ca.Function("regulated", [z, K], [runge_kutta(regulated, z, self.STEP)])
        self._regulated = step.mapaccum(500)

    def held(self, x0: FloatArray, control: Control) -> Outcome:
        """Apply ``control(t, x)``, held for each step."""
        x, energy, radius = np.array(x0), 0.0, math.inf
        steps = round(self.horizon / self.STEP)
        for k in range(steps):
            u = np.clip(control(k * self.STEP, x), -self.limits, self.limits)
            x = np.array(self._held(x, u)).ravel()
            energy += float(u @ u) * self.STEP
            radius = float(np.linalg.norm(x))
            if radius <= self.radius or self._gone(x):
                break
        return self._outcome(energy, (k + 1) * self.STEP, x)

    def _gone(self, x: FloatArray) -> Any:
        """Whether states, (…, 2n), are outside the box or beyond all reason; NaN is."""
        inside = (x >= self._low) & (x <= self._high)
        return ~(inside.all(axis=-1) & (np.linalg.norm(x, axis=-1) < LOST))

    def _outcome(self, energy: float, t: float, x: FloatArray) -> Outcome:
        radius = float(np.linalg.norm(x))
        reached = radius <= self.radius
        return Outcome(energy, t, radius, reached, not reached and bool(self._gone(x)))

    def regulated(self, x0: FloatArray, K: FloatArray) -> Outcome:
        """Apply u = −K x, clipped, at every stage of every step."""
        n, state, t = 2 * self.mechanism.n, np.append(x0, 0.0), 0.0
        while t < self.horizon - 1e-9:
            path = np.array(self._regulated(state, np.tile(K, 500))).T
            distance = np.linalg.norm(path[:, :n], axis=1)
            over = np.flatnonzero((distance <= self.radius) | self._gone(path[:, :n]))
            last = int(over[0]) if over.size else len(path) - 1
            t, state = t + (last + 1) * self.STEP, path[last]
            if over.size:
                break
        return self._outcome(float(state[n]), t, state[:n])


@dataclass(frozen=True, eq=False)
class Regulator:
    """A linear-quadratic regulator: u = −K x, its weights Q, and P of what is left to pay."""

    K: FloatArray
    Q: FloatArray
    P: FloatArray


@cache
def tuned(
    mechanism: ut.Mechanism,
    start: tuple[float, ...],
    radius: float,
    horizon: float,
    box: tuple[tuple[str, tuple[float, float]], ...] = (),
) -> dict[str, Regulator]:
    """Return the regulators of least energy and of least time on the model; of 39, by hindsight."""
    lin, plant = linearise(mechanism), Plant(mechanism, radius, horizon, dict(box))
    found: list[tuple[Outcome, Regulator]] = []
    grid = [(w, a) for w in np.logspace(-3, 3, 13) for a in (0.1, 1.0, 10.0)]
    for weight, actuated in progress(grid, "LQR weights"):
        Q = weight * np.eye(2 * mechanism.n)
        Q[: mechanism.m, : mechanism.m] *= actuated
        P = scipy.linalg.solve_continuous_are(lin.A, lin.input, Q, np.eye(mechanism.m))
        regulator = Regulator(np.asarray(lin.input.T @ P, dtype=float), Q, P)
        outcome = plant.regulated(np.array(start), regulator.K)
        if outcome.reached:
            found.append((outcome, regulator))
    if not found:
        return {}
    return {
        "energy": min(found, key=lambda pair: pair[0].energy)[1],
        "time": min(found, key=lambda pair: pair[0].time)[1],
    }


class ShootingMPC:
    """Multiple shooting with inputs held on the intervals of a grid; re-planned every period.

    Parameters
    ----------
    mechanism
        The controller's belief.
    goal
        ``"energy"``: ∫ uᵀu dt + xᵀPx at the end of 5 s, P from the Riccati equation.
        ``"time"``: the least T with ‖x(T)‖ ≤ ν/2, in 30 equal intervals.
    radius
        ν of the terminal set.
    tolerance
        The solver's.
    now
        Clock for the seconds of each planning.
    period
        Time between plannings, s.
    hold
        How long an input is held: the mean of what is planned for that time, s.
    box
        How far coordinates may go at the nodes of a plan.
    names
        Parameters whose ``values`` may change from planning to planning.
    solver
        ``"ipopt"``, or ``"fatrop"``, which makes use of the order of stages.
    compiled
        Whether functions and derivatives are compiled by gcc, or run by CasADi's virtual machine.
    """

    #: Energy: short intervals first, because the next 0.1 s are what is applied.
    GRID = np.repeat([0.02, 0.05, 0.1, 0.2, 0.3], [5, 8, 10, 10, 5])
    EQUAL = np.full(30, 1 / 30)

    def __init__(
        self,
        mechanism: ut.Mechanism,
        goal: Literal["energy", "time"],
        radius: float = 0.01,
        tolerance: float = 1e-4,
        now: Clock = time.perf_counter,
        period: float = 0.1,
        hold: float = Plant.STEP,
        box: Box | None = None,
        names: Sequence[str] = (),
        solver: Literal["ipopt", "fatrop"] = "ipopt",
        compiled: bool = False,
    ) -> None:
        self.ca, self._now = need("casadi", "compare"), now
        self.mechanism, self.goal, self.radius = mechanism, goal, radius
        self.period, self.hold = period, hold
        self.names = tuple(names)
        self._ends = ends(mechanism, box or {})
        self.limits = mechanism.input_limits
        self.P, self.K = riccati(mechanism, SLOW if goal == "energy" else 1.0)
        self.grid = self.GRID if goal == "energy" else self.EQUAL
        self.seconds: list[float] = []
        self.iterations: list[int] = []
        self.failures = 0
        self._build(solver, tolerance, compiled)
        self.forget()

    def _build(self, solver: str, tolerance: float, compiled: bool) -> None:
        ca, n, m = self.ca, 2 * self.mechanism.n, self.mechanism.m
        p = ca.SX.sym("p", len(self.names))
        moved = dynamics(ca, self.mechanism, self.names)
        count, timed = len(self.grid), self.goal == "time"

        def f(x: Any, u: Any) -> Any:
            return moved(x, u, p) if self.names else moved(x, u)

        width = n + timed  # the final time is one more state, which does not change
        z, u, h = ca.SX.sym("z", width), ca.SX.sym("u", m), ca.SX.sym("h")
        span = h * z[n] if timed else h
        end = z[:n]
        for _ in range(2):
            end = runge_kutta(lambda y: f(y, u), end, span / 2)
        self._move = move = ca.Function("move", [z, u, h, p], [ca.vertcat(end, z[n:])])
        Z = [ca.MX.sym(f"z{k}", width) for k in range(count + 1)]
        U = [ca.MX.sym(f"u{k}", m) for k in range(count)]
        start, haste = ca.MX.sym("start", n), ca.MX.sym("haste")
        values = ca.MX.sym("values", len(self.names))
        constraints: list[Any] = []
        equal: list[bool] = []
        effort: Any = 0
        for k, length in enumerate(self.grid):
            constraints.append(Z[k + 1] - move(Z[k], U[k], length, values))
            equal += [True] * width
            effort += length * ca.sumsqr(U[k] / (self.limits if timed else 1.0))
            if k == 0:
                constraints.append(Z[0][:n] - start)
                equal += [True] * n
        if timed:
            constraints.append(1 - ca.sumsqr(Z[-1][:n]) / (0.5 * self.radius) ** 2)
            equal.append(False)
            cost = haste * Z[-1][n] + (1 - haste) * effort
        else:
            cost = effort + ca.bilin(self.P, Z[-1], Z[-1])
        self._lower = np.zeros(len(equal))
        self._upper = np.where(equal, 0.0, np.inf)
        unknowns = ca.vertcat(*(part for pair in zip(Z, U, strict=False) for part in pair), Z[-1])
        options: dict[str, Any] = {
            "print_time": False,
            "error_on_fail": False,
            "show_eval_warnings": False,
            "expand": not compiled,  # gcc takes a minute for what is expanded, and it is no faster
        }
        if solver == "ipopt":
            options["ipopt"] = {"print_level": 0, "sb": "yes", "tol": tolerance, "max_iter": 100}
        else:
            options |= {
                "structure_detection": "auto",
                "equality": equal,
                "fatrop": {
                    "print_level": 0, "tolerance": tolerance, "max_iter": 100, "mu_init": 1e-3,
                },
            }  # fmt: skip
        if compiled:
            options |= COMPILED
        programme = {"x": unknowns, "f": cost, "g": ca.vertcat(*constraints),
                     "p": ca.vertcat(start, haste, values)}  # fmt: skip
        with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
            self._solver = ca.nlpsol("mpc", solver, programme, options)

    # -- a plan: states (N+1, 2n) and inputs (N, m) on the grid, and its length ------------------

    def forget(self) -> None:
        """Drop the plan and what was learnt: the next one is found from cold."""
        self.values = parameters(self.mechanism, self.names)
        self._plan: tuple[FloatArray, FloatArray, float] | None = None
        self._since = 0.0

    def _solve(
        self, x: FloatArray, guess: tuple[FloatArray, FloatArray, float], free: bool
    ) -> tuple[FloatArray, FloatArray, float] | None:
        states, inputs, T = guess
        n, m, count = states.shape[1], inputs.shape[1], len(self.grid)
        timed = self.goal == "time"
        states = np.column_stack([states, np.full(count + 1, T)]) if timed else states
        low, high = (0.05 * T, 3.0 * T) if free else (T, T)
        lows, highs = self._ends
        box = np.concatenate([highs, [high]]) if timed else highs
        floor = np.concatenate([lows, [low]]) if timed else lows
        rows = np.hstack([states[:-1], inputs]).ravel()
        repeated = np.tile(np.concatenate([box, self.limits]), count)
        lowest = np.tile(np.concatenate([floor, -self.limits]), count)
        repeated[:n], lowest[:n] = np.inf, -np.inf  # where it is now is not for it to choose
        found = self._solver(
            x0=np.concatenate([rows, states[-1]]),
            p=np.concatenate([x, [1.0 if free else 0.0], self.values]),
            lbx=np.concatenate([lowest, floor]),
            ubx=np.concatenate([repeated, box]),
            lbg=self._lower,
            ubg=self._upper,
        )
        statistics = self._solver.stats()
        self.iterations[-1] += int(statistics["iter_count"])
        self.cost = float(found["f"])
        if not statistics["success"]:
            return None
        values = np.array(found["x"]).ravel()
        width = n + timed
        body = values[:-width].reshape(count, width + m)
        ends = np.vstack([body[:, :width], values[-width:]])
        return ends[:, :n], body[:, width:], float(ends[-1, n]) if timed else T

    def _cold(self, x: FloatArray) -> tuple[FloatArray, FloatArray, float] | None:
        count = len(self.grid)
        fade = 1 - np.concatenate([[0.0], np.cumsum(self.grid)]) / self.grid.sum()
        inputs = np.zeros((count, self.mechanism.m))
        if self.goal == "energy":
            return self._solve(x, (x * fade[:, None] ** 4, inputs, 0.0), True)
        for T in (0.5, 1.0, 2.0, 4.0):  # least effort at a fixed time first, then the time is free
            slow = self._solve(x, (x * fade[:, None], inputs, T), False)
            quick = None if slow is None else self._solve(x, slow, True)
            if quick is not None:
                return quick
        return None

    def plan(self, t: float, x: FloatArray) -> bool:
        """Plan from x, warm-started with what is left of the last plan.

        False: none found; the last plan stays in use while it covers the next period.
        """
        began = self._now()
        self.iterations.append(0)
        found = None
        if self._plan is not None:
            guess = self._shifted(t - self._since)
            found = self._solve(x, guess, True)
            if found is None and self.goal == "time":  # with a little more time, and then less
                slow = self._solve(x, (*guess[:2], 1.1 * guess[2]), False)
                found = None if slow is None else self._solve(x, slow, True)
        if found is None and self._left(t) < self.period:
            found = self._cold(x)
        self.seconds.append(self._now() - began)
        if found is None:
            self.failures += 1
            return False
        self._plan, self._since = found, t
        return True

    def _times(self, T: float) -> FloatArray:
        nodes = np.concatenate([[0.0], np.cumsum(self.grid)])
        return nodes * T if self.goal == "time" else nodes

    def _shifted(self, by: float) -> tuple[FloatArray, FloatArray, float]:
        assert self._plan is not None
        states, inputs, T = self._plan
        nodes, rest = self._times(T), max(T - by, 0.02)
        later = self._times(rest) + by
        moved = np.column_stack([np.interp(later, nodes, column) for column in states.T])
        middles = (later[:-1] + later[1:]) / 2
        index = np.clip(np.searchsorted(nodes, middles, side="right") - 1, 0, len(inputs) - 1)
        return moved, inputs[index], rest

    def __call__(self, t: float, x: FloatArray) -> FloatArray:
        """Return the input at t: planned afresh every period; past its end, linear feedback.

        A plan that has less than a fifth of a period to go is carried out.
        """
        if self.due(t) and not 0.0 < self._left(t) < self.period / 5:
            self.plan(t, x)
        if self._plan is not None:
            _, inputs, T = self._plan
            nodes = self._times(T)
            since = t - self._since
            if since < nodes[-1] - 1e-9:
                # The mean over what is held: switches fall between steps of the plant.
                area = np.vstack([np.zeros(inputs.shape[1]), np.cumsum(
                    np.diff(nodes)[:, None] * inputs, axis=0)])  # fmt: skip
                since = self.hold * math.floor(since / self.hold + 1e-6)
                span = [since, since + self.hold]
                spent = np.stack([np.interp(span, nodes, column) for column in area.T])
                return np.asarray(np.diff(spent, axis=1)[:, 0] / self.hold)
        return np.asarray(-self.K @ x)

    def _left(self, t: float) -> float:
        """Time until the end of the plan, s; 0 without one."""
        return 0.0 if self._plan is None else self._since + self._times(self._plan[2])[-1] - t

    def due(self, t: float) -> bool:
        """Whether it is planned anew at t."""
        return abs(t / self.period - round(t / self.period)) < 1e-6


class DoMPC:
    """The same tasks in do-mpc: N intervals, Radau collocation, IPOPT.

    ``"energy"``: N = 25 intervals of 0.1 s, ∫ uᵀu dt + xᵀPx at their end.
    ``"time"``: N = 25 intervals whose lengths are inputs too; least sum, in a box inside the
    terminal set at the end.

    Parameters
    ----------
    mechanism
        The controller's model.
    goal
        ``"energy"`` or ``"time"``.
    radius
        ν of the terminal set.
    tolerance
        IPOPT's.
    now
        Clock for the seconds of each planning.
    members
        Values of the parameters ``names`` on plants that are plausible, (K, p): the plan is then
        a tree of K scenarios that part after the first interval (robust horizon 1), and their
        mean cost counts.
    names
        What they are values of.
    box
        How far coordinates may go, softly.
    regulator
        Least energy: what x costs, besides, on the way and at the end.
    """

    INTERVALS, PERIOD = 25, 0.1

    def __init__(
        self,
        mechanism: ut.Mechanism,
        goal: Literal["energy", "time"],
        radius: float = 0.01,
        tolerance: float = 1e-4,
        now: Clock = time.perf_counter,
        members: FloatArray | None = None,
        names: Sequence[str] = (),
        box: Box | None = None,
        regulator: Regulator | None = None,
    ) -> None:
        self.ca, do_mpc = need("casadi", "compare"), need("do_mpc", "compare")
        self._now = now
        if hasattr(self.ca.GlobalOptions, "setNumpyMode"):
            self.ca.GlobalOptions.setNumpyMode(-1)  # what do-mpc was written for
        self.mechanism, self.goal = mechanism, goal
        P, K = riccati(mechanism, SLOW)
        self.regulator = regulator or Regulator(K, np.zeros_like(P), P)
        self.seconds: list[float] = []
        self.iterations: list[int] = []
        self.failures = 0
        ca, n, m, timed = self.ca, 2 * mechanism.n, mechanism.m, goal == "time"
        model = do_mpc.model.Model("continuous", "SX")
        x, u = model.set_variable("_x", "x", (n, 1)), model.set_variable("_u", "u", (m, 1))
        pace = model.set_variable("_u", "pace") if timed else 1.0
        free = {name: model.set_variable("_p", name) for name in names}
        model.set_rhs("x", pace * rates(ca, mechanism, x, u, free))
        model.setup()
        mpc = do_mpc.controller.MPC(model)
        mpc.settings.n_horizon = self.INTERVALS
        mpc.settings.t_step = 1 / self.INTERVALS if timed else self.PERIOD
        mpc.settings.store_full_solution = False
        mpc.settings.collocation_deg = 3
        mpc.settings.supress_ipopt_output()
        mpc.settings.nlpsol_opts.update({"ipopt.tol": tolerance, "ipopt.max_iter": 200})
        if members is not None:
            mpc.settings.n_robust = 1
            tree = mpc.get_p_template(len(members))
            for index, values in enumerate(members):
                tree["_p", index] = values
            mpc.set_p_fun(lambda _t: tree)
        for low, high, state in zip(*ends(mechanism, box or {}), ca.vertsplit(x), strict=True):
            for sign, end in ((1, high), (-1, -low)):
                if math.isfinite(end):
                    mpc.set_nl_cons(
                        f"{state.name()}{'< >'[sign + 1]}", sign * state, ub=end,
                        soft_constraint=True, penalty_term_cons=self._penalty(end),
                    )  # fmt: skip
        limits = mechanism.input_limits[:, None]
        mpc.bounds["lower", "_u", "u"], mpc.bounds["upper", "_u", "u"] = -limits, limits
        if timed:
            mpc.set_objective(lterm=model.u["pace"] / self.INTERVALS, mterm=ca.DM(0))
            mpc.bounds["lower", "_u", "pace"], mpc.bounds["upper", "_u", "pace"] = 0.02, 10.0
            inside = np.full((n, 1), 0.99 * radius / math.sqrt(n))
            mpc.terminal_bounds["lower", "x"] = -inside
            mpc.terminal_bounds["upper", "x"] = inside
            mpc.set_rterm(u=0.0, pace=0.0)
        else:
            P, Q = self.regulator.P, self.regulator.Q
            X, U = model.x["x"], model.u["u"]
            stage = ca.sumsqr(U) + ca.bilin(Q, X, X)
            mpc.set_objective(lterm=self.PERIOD * stage, mterm=ca.bilin(P, X, X))
            mpc.set_rterm(u=0.0)
        mpc.setup()
        self.mpc = mpc
        self.forget()

    def forget(self) -> None:
        """Start from cold: the present state, repeated, and no input."""
        self.mpc.reset_history()
        self._cold = True

    @property
    def cost(self) -> float:
        """The objective of the last plan."""
        plan, count = self.mpc.opt_x_num, self.INTERVALS
        inputs = np.array([np.array(plan["_u", k, 0]).ravel() for k in range(count)])
        if self.goal == "time":
            return float(inputs[:, -1].mean())
        end = np.array(plan["_x", count, 0, -1]).ravel()
        return float(self.PERIOD * np.sum(inputs**2) + end @ self.regulator.P @ end)

    def _penalty(self, end: float) -> float:
        """Return what leaving the box costs: a tenth of its width as much as the full input."""
        return float(np.sum(self.mechanism.input_limits**2) / end * 10)

    def plan(self, _t: float, x: FloatArray) -> bool:
        """Plan from x; False when IPOPT failed."""
        began = self._now()
        state = np.asarray(x)[:, None]
        if self._cold:
            self.mpc.x0 = state
            if self.goal == "time":
                self.mpc.u0["pace"] = 1.0
            self.mpc.set_initial_guess()
            self._cold = False
        self.u = np.asarray(self.mpc.make_step(state)).ravel()[: self.mechanism.m]
        self.seconds.append(self._now() - began)
        self.iterations.append(int(self.mpc.solver_stats["iter_count"]))
        success = bool(self.mpc.solver_stats["success"])
        self.failures += not success
        return success

    def __call__(self, t: float, x: FloatArray) -> FloatArray:
        """Return the input at t, planned afresh every 0.1 s and held."""
        if abs(t / self.PERIOD - round(t / self.PERIOD)) < 1e-6:
            self.plan(t, x)
        return np.asarray(self.u)
