"""Error against cost: simulated motions beside a reference that shares no code with them.

Every mechanism of the library from its usual start, least energy and least time, and the paper's
cases: continuous law, model and plant alike, the plan that the cascade's first search finds (or the
paper prints), kept to the end.  Each is simulated as ``simulate`` does by default, with other
tolerances, and in fixed steps of several lengths.

The reference takes M, f and B as SymPy prints them, solves (1) and the law (5), (12), (39) with
NumPy in every evaluation, and integrates by SciPy's DOP853 (relative tolerance 1e-12).  Between
corners the law is a smooth function, and so is what is integrated: whether each surface is in its
layer or beyond, and each input free or at a limit, is held; where that changes, as where the motion
arrives, SciPy finds the moment, and the next piece begins.  *reference* is by how much it
differs from itself, integrated by another method, at another tolerance.

Errors are relative to the whole: of cost, of the time of arrival, and of the state along the
motion, each entry by its largest modulus on the way.  *ms* is processor time of one simulation.
"""

from __future__ import annotations

from harness import command_line, progress, table  # isort: skip

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import sympy as sp
from scipy.integrate import solve_ivp

import undertow as ut
from undertow.law import Plan
from undertow.mechanisms import LIBRARY
from undertow.models import FloatArray
from undertow.objective import objective_for
from undertow.studies.paper import CONDITIONS, PRINTED

#: Wanted of the errors of cost and arrival at default settings, relative.
WANTED = 1e-5
#: Tolerances, and fixed steps, s.
TOLERANCES = (1e-6, 1e-8, 1e-10)
STEPS = (0.004, 0.002, 0.001, 0.0005)
#: Rows of a motion that are compared.
ROWS = 400


@dataclass(frozen=True)
class Case:
    """A motion: mechanism, objective, initial state (2n,) and what is slid on."""

    name: str
    mechanism: ut.Mechanism
    objective: ut.Objective
    x0: FloatArray
    plan: Plan


@dataclass(frozen=True)
class Exact:
    """A motion as the reference has it; ``states`` are x at times t, (N,) to (N, 2n)."""

    cost: float
    time: float
    states: Callable[[FloatArray], FloatArray]


class Reference:
    """A mechanism under its law, evaluated from the formulas by NumPy, number by number."""

    def __init__(self, case: Case, reaching: ut.ReachingLaw | None = None) -> None:
        rig = case.mechanism
        assert not any(rig.disturbance_bounds)  # the gains (13) are η
        self.case, self.n, self.m = case, rig.n, rig.m
        self.law = reaching or ut.ReachingLaw()
        values, state = rig.substitution, [*rig.x]
        self.M, self.f, self.B = (
            sp.lambdify(state, sp.Matrix(matrix).subs(values).tolist(), "math", cse=True)
            for matrix in (rig.mass_matrix, rig.force, rig.input_matrix)
        )
        stage = case.objective.stage_cost(rig).subs(values)
        self.stage = sp.lambdify([*state, *rig.u], stage, "math")
        self.limit = rig.input_limits

    def evaluate(
        self, x: FloatArray, surface: ut.Surface, law: FloatArray, modes: tuple[int, ...]
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return rates of (x, cost), s/ε and demand/limit; modes as of :meth:`modes`."""
        n, m = self.n, self.m
        M, f, B = (np.array(g(*x[: 2 * n])) for g in (self.M, self.f, self.B))
        f, (eta, layer) = f[:, 0], np.split(law, 2)
        q_a, q_u, v_a, v_u = x[:m], x[m:n], x[n : n + m], x[n + m : 2 * n]
        s = surface.alpha_a @ v_a + surface.lambda_a @ q_a
        s = s + surface.alpha_u @ v_u + surface.lambda_u @ q_u
        into, beyond = s / layer, np.array(modes[:m], dtype=float)
        push = eta * np.where(beyond != 0, beyond, into)
        X, drift = np.linalg.solve(M[m:, m:], M[m:, :m]), np.linalg.solve(M[m:, m:], f[m:])
        gamma = surface.alpha_a - surface.alpha_u @ X
        drive = surface.alpha_u @ drift + surface.lambda_a @ v_a + surface.lambda_u @ v_u + push
        wanted = -np.linalg.solve(gamma, drive)
        force = (M[:m, :m] - M[:m, m:] @ X) @ wanted - f[:m] + M[:m, m:] @ drift
        demand = np.linalg.solve(B, force)
        at = np.array(modes[m:], dtype=float)
        u = np.where(at != 0, at * self.limit, demand)
        load = f + np.concatenate([B @ u, np.zeros(n - m)])
        rates = [*x[n : 2 * n], *np.linalg.solve(M, load), self.stage(*x[: 2 * n], *u)]
        return np.array(rates), into, demand / self.limit

    def modes(self, x: FloatArray, surface: ut.Surface, law: FloatArray) -> tuple[int, ...]:
        """Return for each surface and each input −1, 0 or 1: below, within or above its edges."""
        beyond: tuple[int, ...] = (0,) * (2 * self.m)
        _, into, _ = self.evaluate(x, surface, law, beyond)
        beyond = (*_side(into), *beyond[self.m :])
        _, _, part = self.evaluate(x, surface, law, beyond)
        return (*beyond[: self.m], *_side(part))

    def motion(self, *, rtol: float = 1e-12, method: str = "DOP853") -> Exact:
        """Integrate the motion until it arrives, or the horizon."""
        case, n = self.case, self.n
        ends = [*case.plan.times[1:], case.objective.horizon]
        x, t, pieces = np.append(case.x0, 0.0), 0.0, []
        for k, end in enumerate(ends):
            surface = case.plan.surfaces[k]
            law = (self.law if case.plan.reaching is None else case.plan.reaching[k]).vector(self.m)
            modes = self.modes(x, surface, law)
            while t < end:
                events = [self._arrival, *self._corners(surface, law, modes)]
                found: Any = solve_ivp(
                    lambda _, x: self.evaluate(x, surface, law, modes)[0],  # noqa: B023
                    (t, end), x, method=method, rtol=rtol, atol=1e-2 * rtol, events=events,
                    dense_output=True, first_step=min(1e-4, end - t),
                )  # fmt: skip
                assert found.success, found.message
                pieces.append((t, found.sol))
                t, x = float(found.t[-1]), found.y[:, -1]
                if len(found.t_events[0]):
                    return self._exact(pieces, x, t)
                for corner, times in zip(events[1:], found.t_events[1:], strict=True):
                    if len(times):
                        modes = (
                            *modes[: corner.index], corner.beyond, *modes[corner.index + 1 :]
                        )  # fmt: skip
        return self._exact(pieces, x, t)

    def _exact(self, pieces: list[tuple[float, Any]], x: FloatArray, t: float) -> Exact:
        begins = np.array([begin for begin, _ in pieces])

        def states(times: FloatArray) -> FloatArray:
            which = np.maximum(np.searchsorted(begins, times, side="right") - 1, 0)
            rows = [pieces[k][1](at)[: 2 * self.n] for k, at in zip(which, times, strict=True)]
            return np.array(rows)

        return Exact(float(x[-1]), t, states)

    def _arrival(self, _: float, x: FloatArray) -> float:
        return float(np.linalg.norm(x[: 2 * self.n])) - self.case.objective.terminal_radius

    _arrival.terminal = True  # type: ignore[attr-defined]  # as SciPy wants it
    _arrival.direction = -1  # type: ignore[attr-defined]

    def _corners(
        self, surface: ut.Surface, law: FloatArray, modes: tuple[int, ...]
    ) -> Iterator[Any]:
        """Yield the events at which a mode changes, each with its index and the mode beyond."""

        def event(index: int, edge: float, beyond: int, direction: float) -> Any:
            def at(_: float, x: FloatArray) -> float:
                _, into, part = self.evaluate(x, surface, law, modes)
                return float([*into, *part][index]) - edge

            at.terminal, at.direction = True, direction  # type: ignore[attr-defined]
            at.index, at.beyond = index, beyond  # type: ignore[attr-defined]
            return at

        for index, mode in enumerate(modes):
            if mode == 0:
                yield event(index, 1.0, 1, 1.0)
                yield event(index, -1.0, -1, -1.0)
            else:
                yield event(index, float(mode), 0, -float(mode))


def _side(part: FloatArray) -> tuple[int, ...]:
    return tuple(int(p > 1) - int(p < -1) for p in part)


@dataclass(frozen=True)
class Errors:
    """Errors of a simulation, relative, and its processor time, s."""

    cost: float
    time: float
    state: float
    seconds: float = 0.0


def errors(motion: ut.Trajectory, exact: Exact, seconds: float = 0.0) -> Errors:
    """Return how far a simulated motion is off a reference."""
    shared = motion.t <= min(motion.time, exact.time)
    rows = np.flatnonzero(shared)
    rows = rows[:: max(1, len(rows) // ROWS)]
    states = exact.states(motion.t[rows])
    largest = np.abs(states).max(axis=0)
    off = np.abs(motion.x[rows] - states).max(axis=0)
    return Errors(
        abs(motion.cost - exact.cost) / exact.cost,
        abs(motion.time - exact.time) / exact.time,
        float((off[largest > 0] / largest[largest > 0]).max()),
        seconds,
    )


def reference_error(reference: Reference, exact: Exact) -> Errors:
    """Return how far the reference is off itself by another method."""
    other = reference.motion(rtol=1e-10, method="LSODA")
    t = np.linspace(0.0, min(exact.time, other.time), ROWS)
    states = exact.states(t)
    off = np.abs(other.states(t) - states).max(axis=0) / np.abs(states).max(axis=0)
    cost, arrival = abs(other.cost / exact.cost - 1), abs(other.time / exact.time - 1)
    return Errors(cost, arrival, float(np.nanmax(off)))


def simulated(case: Case, **settings: float) -> tuple[ut.Trajectory, float]:
    """Return a simulation and its processor time, s, the least of three."""
    loop = ut.ClosedLoop(case.mechanism, case.objective, **settings)  # type: ignore[arg-type]
    motion, spent = loop.simulate(case.x0, case.plan), []
    for _ in range(3):
        began = time.process_time()
        loop.simulate(case.x0, case.plan)
        spent.append(time.process_time() - began)
    return motion, min(spent)


def library(names: Sequence[str]) -> Iterator[Case]:
    """Yield every mechanism at its usual start, with the first plan of the cascade."""
    for name in names:
        rig = LIBRARY[name]()
        for goal in ("energy", "time"):
            objective = objective_for(rig, goal)
            cascade = ut.Cascade(rig, objective, belief="exact")
            plan = cascade.start(rig.usual_start)[0].plan
            yield Case(f"{name}, {goal}", rig, cascade.loop.objective, rig.usual_start, plan)


def paper() -> Iterator[Case]:
    """Yield the cases of the paper's tables that arrive, in the condition that matches."""
    matched = CONDITIONS["matched"]
    for (goal, row), printed in PRINTED.items():
        objective = objective_for(matched.mechanism, goal)
        plan = Plan(printed.surfaces, printed.switch_times)
        yield Case(f"paper, {goal}, {row}", matched.mechanism, objective, matched.start, plan)


def row(name: str, found: Errors, seconds: bool = True) -> list[str]:
    """Return a line of a table."""
    values = [f"{value:.1e}" for value in (found.cost, found.time, found.state)]
    return [name, *values, f"{1e3 * found.seconds:.2f}" if seconds else "—"]
