"""Error against cost: simulated motions beside a reference that shares no code with them.

Every mechanism of the library from its usual start, least energy and least time, and the paper's
cases: continuous law, model and plant alike, the plan that the cascade starts with (or the paper
prints), kept to the end.  Each is simulated as ``simulate`` does by default, with other tolerances,
and in fixed steps of several lengths, as searches take them.

The reference takes M, f and B as SymPy prints them, solves (1) and the law (5), (12), (39) with
NumPy in every evaluation, and integrates by SciPy's DOP853 (relative tolerance 1e-12).  Between
corners the law is a smooth function, and so is what is integrated: whether each surface is in its
layer or beyond, and each input free or at a limit, is held; where that changes, as where the motion
arrives or is lost, SciPy finds the moment, and the next piece begins.  *reference* is by how much
it differs from itself, integrated by another method at another tolerance (LSODA, 1e-10).

Errors are relative to the whole: of cost, of the time of arrival, and of the state along the
motion, each entry by its largest modulus on the way.  A motion that ends otherwise has missed: its
errors are infinite.  *ms* is processor time of one simulation, all of its rows recorded.
"""

from __future__ import annotations

from harness import command_line, progress, table  # isort: skip

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import sympy as sp
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

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
#: Mechanisms of a quick run.
QUICK = ("rotary_pendulum", "two_motor_three_link")

#: SciPy's own types know no events with attributes.
solve: Any = solve_ivp


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
    reached: bool
    states: Callable[[FloatArray], FloatArray]


class Point(NamedTuple):
    """What the reference sees at a state.

    Rates of (x, cost); s/ε and demand/limit, (m,) each; the margins of (37) and of the path.
    """

    rates: FloatArray
    into: FloatArray
    part: FloatArray
    margins: FloatArray


class Reference:
    """A mechanism under its law, evaluated from the formulas by NumPy, number by number."""

    def __init__(self, case: Case, reaching: ut.ReachingLaw | None = None) -> None:
        rig = case.mechanism
        assert not any(rig.disturbance_bounds)  # the gains (13) are η
        self.case, self.n, self.m = case, rig.n, rig.m
        self.law = reaching or ut.ReachingLaw()
        self._last: tuple[object, Point] | None = None
        self.limit, values = rig.input_limits, rig.substitution
        self.M, self.f, self.B = (
            sp.lambdify(rig.x, sp.Matrix(matrix).subs(values).tolist(), "math", cse=True)
            for matrix in (rig.mass_matrix, rig.force, rig.input_matrix)
        )
        M = np.array(self.M(*np.zeros(2 * rig.n)))
        self.coupling = np.linalg.solve(M[rig.m :, rig.m :], M[rig.m :, : rig.m])
        problem = case.objective.on(rig)
        self.stage, self.path = (
            sp.lambdify([*rig.x, *rig.u], sp.sympify(formula).subs(values), "math")
            for formula in (problem.stage_cost(rig), sp.Tuple(*problem.path_margins(rig)))
        )

    def evaluate(
        self, x: FloatArray, surface: ut.Surface, law: FloatArray, modes: tuple[int, ...]
    ) -> Point:
        """Evaluate plant and law at (x, cost); modes as of :meth:`modes`."""
        key = x.tobytes(), surface, modes
        if self._last is None or self._last[0] != key:  # every event asks for the same
            self._last = key, self._evaluated(x, surface, law, modes)
        return self._last[1]

    def _evaluated(
        self, x: FloatArray, surface: ut.Surface, law: FloatArray, modes: tuple[int, ...]
    ) -> Point:
        n, m, state = self.n, self.m, x[:-1]
        M, f, B = (np.array(g(*state)) for g in (self.M, self.f, self.B))
        f, (eta, layer) = f[:, 0], np.split(law, 2)
        q_a, q_u, v_a, v_u = np.split(state, [m, n, n + m])
        s = surface.alpha_a @ v_a + surface.lambda_a @ q_a
        s = s + surface.alpha_u @ v_u + surface.lambda_u @ q_u
        into, beyond = s / layer, np.array(modes[:m], dtype=float)
        push = eta * np.where(beyond != 0, beyond, into)
        X, drift = np.split(np.linalg.solve(M[m:, m:], np.c_[M[m:, :m], f[m:]]), [m], axis=1)
        gamma, drift = surface.alpha_a - surface.alpha_u @ X, drift[:, 0]
        drive = surface.alpha_u @ drift + surface.lambda_a @ v_a + surface.lambda_u @ v_u + push
        wanted = -np.linalg.solve(gamma, drive)
        inertia = M[:m, :m] - M[:m, m:] @ X
        demand = np.linalg.solve(B, inertia @ wanted - f[:m] + M[:m, m:] @ drift)
        at = np.array(modes[m:], dtype=float)
        u = np.where(at != 0, at * self.limit, demand)
        accelerations = np.linalg.solve(M, f + np.concatenate([B @ u, np.zeros(n - m)]))
        rates = np.array([*state[n:], *accelerations, self.stage(*state, *u)])
        at_target = surface.alpha_a - surface.alpha_u @ self.coupling
        singular = np.linalg.det(gamma) / np.linalg.det(at_target)
        return Point(rates, into, demand / self.limit, np.array([singular, *self.path(*state, *u)]))

    def modes(self, x: FloatArray, surface: ut.Surface, law: FloatArray) -> tuple[int, ...]:
        """Return for each surface and each input −1, 0 or 1: below, within or above its edges."""
        beyond = _side(self.evaluate(x, surface, law, (0,) * (2 * self.m)).into)
        point = self.evaluate(x, surface, law, (*beyond, *(0,) * self.m))
        return (*beyond, *_side(point.part))

    def motion(self, *, rtol: float = 1e-12, method: str = "DOP853") -> Exact:
        """Integrate the motion until it arrives or is lost, or the horizon."""
        plan, ends = self.case.plan, [*self.case.plan.times[1:], self.case.objective.horizon]
        x, t, pieces = np.append(self.case.x0, 0.0), 0.0, list[tuple[float, Any]]()
        for k, end in enumerate(ends):
            surface = plan.surfaces[k]
            law = (self.law if plan.reaching is None else plan.reaching[k]).vector(self.m)
            modes = self.modes(x, surface, law)
            while t < end:
                corners = self._corners(surface, law, modes)
                found = solve(
                    lambda _, x: self.evaluate(x, surface, law, modes).rates,  # noqa: B023
                    (t, end), x, method=method, rtol=rtol, atol=1e-2 * rtol, dense_output=True,
                    events=[self._nearest(surface, law, modes), *corners],
                    first_step=min(1e-4, end - t),
                )  # fmt: skip
                assert found.success, found.message
                pieces.append((t, found.sol))
                arrival = self._arrival(found.sol, [t, *found.t_events[0], found.t[-1]])
                if arrival is not None:
                    return self._exact(pieces, found.sol(arrival), arrival, True)
                t, x = float(found.t[-1]), found.y[:, -1]
                for corner, times in zip(corners, found.t_events[1:], strict=True):
                    if len(times) and corner.index is None:
                        return self._exact(pieces, x, t, False)
                    if len(times):
                        changed = list(modes)
                        changed[corner.index] = corner.beyond
                        modes = tuple(changed)
        return self._exact(pieces, x, t, False)

    def _exact(
        self, pieces: list[tuple[float, Any]], x: FloatArray, t: float, reached: bool
    ) -> Exact:
        begins = np.array([begin for begin, _ in pieces])

        def states(times: FloatArray) -> FloatArray:
            which = np.maximum(np.searchsorted(begins, times, side="right") - 1, 0)
            return np.array([pieces[k][1](at)[:-1] for k, at in zip(which, times, strict=True)])

        return Exact(float(x[-1]), t, reached, states)

    def _outside(self, x: FloatArray) -> float:
        return float(np.linalg.norm(x[:-1])) - self.case.objective.terminal_radius

    def _arrival(self, motion: Any, instants: list[float]) -> float | None:
        """Return when a piece first enters the terminal set; instants are its ends and minima."""
        for before, after in pairwise(instants):
            if self._outside(motion(after)) <= 0:
                inside = lambda t: self._outside(motion(t))  # noqa: E731
                return float(brentq(inside, before, after, xtol=1e-15, rtol=1e-15))
        return None

    def _nearest(self, surface: ut.Surface, law: FloatArray, modes: tuple[int, ...]) -> Any:
        """The event of being nearest to the target, for a while."""

        def nearest(_: float, x: FloatArray) -> float:
            return float(x[:-1] @ self.evaluate(x, surface, law, modes).rates[:-1])

        nearest.direction = 1.0  # type: ignore[attr-defined]  # as SciPy wants it
        return nearest

    def _corners(self, surface: ut.Surface, law: FloatArray, modes: tuple[int, ...]) -> list[Any]:
        """Return the events at which a mode changes, with its index and what it becomes.

        And those that end a motion: arrival, and no index where it is lost.
        """

        def event(value: Callable[[Point], float], direction: float, **kind: Any) -> Any:
            def at(_: float, x: FloatArray) -> float:
                return value(self.evaluate(x, surface, law, modes))

            vars(at).update(terminal=True, direction=direction, **kind)
            return at

        def edge(index: int, place: float, beyond: int, direction: float) -> Any:
            return event(
                lambda point: float([*point.into, *point.part][index]) - place, direction,
                index=index, beyond=beyond,
            )  # fmt: skip

        def lost(margin: int) -> Any:
            return event(lambda point: float(point.margins[margin]), -1.0, index=None)

        found = [
            lost(margin) for margin in range(1 + len(self.path(*np.ones(2 * self.n + self.m))))
        ]
        for index, mode in enumerate(modes):
            if mode == 0:
                found += [edge(index, 1.0, 1, 1.0), edge(index, -1.0, -1, -1.0)]
            else:
                found.append(edge(index, float(mode), 0, -float(mode)))
        return found


def _side(part: FloatArray) -> tuple[int, ...]:
    return tuple(int(p > 1) - int(p < -1) for p in part)


@dataclass(frozen=True)
class Errors:
    """Errors of cost, arrival and state, relative, and processor time, s."""

    cost: float
    time: float
    state: float
    seconds: float = 0.0


def errors(motion: ut.Trajectory, exact: Exact, seconds: float = 0.0) -> Errors:
    """Return how far a simulated motion is off a reference."""
    if not (exact.reached and motion.event == ut.Event.REACHED):
        return Errors(np.inf, np.inf, np.inf, seconds)
    rows = np.flatnonzero(motion.t <= min(motion.time, exact.time))
    rows = rows[:: max(1, len(rows) // ROWS)]
    off = _off(motion.x[rows], exact.states(motion.t[rows]))
    return Errors(
        abs(motion.cost / exact.cost - 1), abs(motion.time / exact.time - 1), off, seconds
    )


def _off(states: FloatArray, exact: FloatArray) -> float:
    """Return the largest difference of states, each entry by its largest modulus."""
    largest = np.abs(exact).max(axis=0)
    moves = largest > 0
    return float((np.abs(states - exact).max(axis=0)[moves] / largest[moves]).max())


def of_itself(reference: Reference, exact: Exact) -> Errors:
    """Return how far the reference is off itself by another method."""
    other = reference.motion(rtol=1e-10, method="LSODA")
    t = np.linspace(0.0, min(exact.time, other.time), ROWS)
    off = _off(other.states(t), exact.states(t))
    return Errors(abs(other.cost / exact.cost - 1), abs(other.time / exact.time - 1), off)


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
            cascade = ut.Cascade(rig, objective_for(rig, goal), belief="exact")
            plan = cascade.start(rig.usual_start)[0].plan
            yield Case(f"{name}, {goal}", rig, cascade.objective, rig.usual_start, plan)


def paper() -> Iterator[Case]:
    """Yield the cases of the paper's tables, in the condition that matches."""
    matched = CONDITIONS["matched"]
    for (goal, which), printed in PRINTED.items():
        objective = objective_for(matched.mechanism, goal)
        plan = Plan(printed.surfaces, printed.switch_times)
        yield Case(f"paper, {goal}, {which}", matched.mechanism, objective, matched.start, plan)


def against_cost(name: str, found: Sequence[Errors]) -> list[str]:
    """Return a line of the table of error against cost: of several motions, and their time."""
    shown = []
    for values in ([e.cost for e in found], [e.time for e in found]):
        shown += [f"{np.median(values):.0e}", f"{np.max(values):.0e}"]
    missed = sum(not np.isfinite(e.cost) for e in found)
    off = sum(not max(e.cost, e.time) <= WANTED for e in found)
    ms = [1e3 * e.seconds for e in found]
    return [name, *shown, str(off), str(missed), f"{np.median(ms):.2f}", f"{np.max(ms):.2f}"]


def main() -> None:
    """Run the study and print its tables."""
    parser = command_line(__doc__, "--only acrobot tora", clocks=False)
    parser.add_argument("--only", nargs="+", metavar="NAME", choices=tuple(LIBRARY),
                        help="mechanisms, without the paper's cases; all by default")  # fmt: skip
    asked = parser.parse_args()
    names = asked.only or (QUICK if asked.quick else tuple(LIBRARY))
    settings: dict[str, dict[str, float]] = {"default": {}}
    settings |= {f"rtol = {rtol:g}": {"rtol": rtol} for rtol in TOLERANCES}
    settings |= {f"steps of {1e3 * h:g} ms": {"rtol": 0.0, "step": h} for h in STEPS}
    found: dict[str, list[Errors]] = {name: [] for name in settings}
    rows, steps = [], f"steps of {1e3 * ut.ClosedLoop.step:g} ms"
    cases = [*library(names), *([] if asked.only else paper())]
    for case in progress(cases, "motions"):
        reference = Reference(case)
        exact = reference.motion()
        for name, setting in settings.items():
            motion, seconds = simulated(case, **setting)
            found[name].append(errors(motion, exact, seconds))
        usual, fixed, own = found["default"][-1], found[steps][-1], of_itself(reference, exact)
        cells = [[f"{e.cost:.0e}", f"{e.time:.0e}", f"{e.state:.0e}"] for e in (usual, fixed, own)]
        rows.append([case.name, *cells[0], *cells[1], *cells[2][:2]])
    head = ["cost", "arrival", "state"]
    table(
        f"relative errors at default settings, in {steps}, and of the reference",
        ["", *head, *(f"{word}, fixed" for word in head), "cost, ref.", "arrival, ref."],
        rows,
    )
    table(
        f"error against cost, {len(cases)} motions",
        ["", "cost, median", "worst", "arrival, median", "worst", f"> {WANTED:g}", "missed",
         "ms, median", "worst"],
        [against_cost(name, some) for name, some in found.items()],
    )  # fmt: skip
    worst = max(max(e.cost, e.time) for e in found["default"])
    print(f"\nworst error of cost or arrival at default settings {worst:.1e} (wanted: {WANTED:g})")


if __name__ == "__main__":
    main()
