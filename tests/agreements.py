"""Comparisons with exact values of what is compiled besides the quick ones, and odd names."""

from __future__ import annotations

import math
import subprocess
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import sympy as sp
from scipy.integrate import solve_ivp

import undertow as ut
from undertow.base import ModelError, SingularSurfaceError, UnstableSurfaceError
from undertow.cascade.swing_up import law as swing_law
from undertow.checks.agreement import Difference, Subject
from undertow.checks.exact import Number, evaluate, product, runge_kutta, solve
from undertow.estimators import kalman
from undertow.export import EmbeddedController, KalmanStep
from undertow.export.host import Build
from undertow.models import FloatArray
from undertow.plants.stepping import stepping
from undertow.proofs.region.motion import SurfaceMotion

STEP = 0.002


def exactly(values: Any) -> list[Number]:
    """Floats as exact numbers."""
    return [Number(float(v)) for v in np.ravel(values)]


def _moved(
    subject: Subject, x: FloatArray, u: FloatArray, damping: Sequence[Number] | None
) -> list[Number]:
    """A Runge-Kutta step of the plant under a held input."""
    n, held = subject.mechanism.n, exactly(u)

    def rates(stage: list[Number]) -> list[Number]:
        return [*stage[n:], *subject.model.accelerations(0.0, stage, held, damping)]

    return runge_kutta(STEP, exactly(x), rates)


def rig_stepping(subject: Subject) -> Iterator[Difference]:
    """q̈ with joint damping, M⁻¹, the diagonal of B and a step of the simulated rig."""
    mechanism, n, m = subject.mechanism, subject.mechanism.n, subject.mechanism.m
    module = stepping(mechanism)
    viscous = np.random.default_rng(1).uniform(0.0, 0.1, n)
    parameters, names = mechanism.parameter_values, [c.name for c in mechanism.coordinates]
    for x, u in zip(subject.states, subject.inputs(), strict=True):
        qdd, W, b, work = np.zeros(n), np.zeros(n * n), np.zeros(m), np.zeros((8, 2 * n))
        module.forward(0.0, x, u, viscous, parameters, qdd)
        damping = exactly(viscous)
        true = subject.model.accelerations(0.0, exactly(x), exactly(u), damping)
        yield from subject.compared("rig: q̈", x, qdd, true, names)
        module.mobility(x, parameters, W)
        M, _, B = subject.model.matrices(0.0, exactly(x))
        for i in range(n):
            unit = [[Number(int(i == j))] for j in range(n)]
            column = [row[0] for row in solve(M, unit)]
            yield from subject.compared(f"rig: M⁻¹ of {names[i]}", x, W.reshape(n, n)[:, i], column)
        module.gains(parameters, b)
        yield from subject.compared("rig: B", x, b, [B[i][i] for i in range(m)])
        after = x.copy()
        module.rk4_step(0.0, STEP, 1.0, n, after, u, viscous, parameters, *work[:3])
        true = _moved(subject, x, u, damping)
        yield from subject.compared("rig: next state", x, after, true, mechanism.state_names)


def estimator(subject: Subject) -> Iterator[Difference]:
    """The Kalman filter's prediction and the linear model of its covariance."""
    mechanism, n, m = subject.mechanism, subject.mechanism.n, subject.mechanism.m
    module = kalman._module(mechanism)
    parameters, names, small = mechanism.parameter_values, mechanism.state_names, 1e-6
    for x, u in zip(subject.states, subject.inputs(), strict=True):
        stage, total, qdd, base, viscous, driven = np.zeros((6, 2 * n))
        F, A = np.zeros((2, 2 * n, 2 * n))
        after, none = x.copy(), np.zeros(0)
        module.move(STEP, after, u, n, m, False, parameters, stage, total, qdd, viscous, driven)
        yield from subject.compared(
            "estimator: prediction", x, after, _moved(subject, x, u, None), names
        )
        module.jacobian(
            STEP, x.copy(), u, np.zeros(m), n, m, False, parameters, none, none, F, A, qdd, base,
            viscous, driven,
        )  # fmt: skip
        here = subject.model.accelerations(0.0, exactly(x), exactly(u))
        slopes = [[Number(int(j == n + i)) for j in range(2 * n)] for i in range(n)]
        columns = []
        for j in range(2 * n):
            ahead = x.copy()
            ahead[j] += small
            there = subject.model.accelerations(0.0, exactly(ahead), exactly(u))
            columns.append([(a - b) / Number(small) for a, b in zip(there, here, strict=True)])
        slopes += [list(row) for row in zip(*columns, strict=True)]
        square = product(slopes, slopes)
        h, half = Number(STEP), Number(0.5) * Number(STEP) * Number(STEP)
        for i in range(2 * n):
            true = [
                Number(int(i == j)) + h * slopes[i][j] + half * square[i][j] for j in range(2 * n)
            ]
            yield from subject.compared(f"estimator: F, row of {names[i]}", x, F[i], true, names)


def swing_up(subject: Subject) -> Iterator[Difference]:
    """Energies and blocks of the swing-up's law."""
    mechanism, n = subject.mechanism, subject.mechanism.n
    assert mechanism.potential is not None
    module, parameters = swing_law._module(mechanism), mechanism.parameter_values
    rest = evaluate(mechanism.potential, subject.model.known(0.0, exactly(np.zeros(2 * n))))
    for x in subject.states:
        energies, blocks = np.zeros(2), np.zeros(4)
        module.energies(x, parameters, energies)
        module.blocks(x, parameters, blocks)
        known = subject.model.known(0.0, exactly(x))
        M, f, B = subject.model.matrices(0.0, exactly(x))
        kinetic = Number(0)
        for i in range(n):
            for j in range(n):
                kinetic = kinetic + M[i][j] * exactly(x)[n + i] * exactly(x)[n + j] / Number(2)
        total = kinetic + evaluate(mechanism.potential, known) - rest
        yield from subject.compared("swing-up: energy", x, energies, [kinetic, total])
        # S = 1/(M⁻¹)₁₁ and h = S (M⁻¹ f)₁: neither needs the elimination of M_uu.
        unit = [[Number(int(i == 0)), v] for i, v in enumerate(f)]
        inverse, moved = solve(M, unit)[0]
        S = Number(1) / inverse
        coupling = Number(0)
        for i in range(1, n):
            coupling = coupling + M[0][i] * exactly(x)[n + i]
        true = [S, S * moved, B[0][0], coupling]
        yield from subject.compared("swing-up: S, h, B, M_au q̇_u", x, blocks, true)


def sliding_motion(subject: Subject) -> Iterator[Difference]:
    """The motion on the surface that regions of attraction are proved with."""
    mechanism, n, m = subject.mechanism, subject.mechanism.n, subject.mechanism.m
    motion, surface = SurfaceMotion(mechanism, subject.surface), subject.surface
    rng = np.random.default_rng(2)
    for y in rng.uniform(-0.4, 0.4, (8, motion.size)):
        free = n - m
        q_u, v_u, w = np.split(y, [free, 2 * free])
        turn = solve(*map(_rows, (surface.lambda_a, surface.lambda_u)))
        back = product(turn, _rows(q_u[:, None]))
        q_a = [Number(float(a)) - b[0] for a, b in zip(w, back, strict=True)]
        position = [[v] for v in (*q_a, *exactly(q_u))]
        pull = product(_rows(surface.position_row), position)
        push = product(_rows(surface.alpha_u), _rows(v_u[:, None]))
        right = [[-(a[0] + b[0])] for a, b in zip(pull, push, strict=True)]
        v_a = [r[0] for r in solve(_rows(surface.alpha_a), right)]
        x = [*q_a, *exactly(q_u), *v_a, *exactly(v_u)]
        held = subject.model.law(surface, subject.reaching, x)
        # On the surface s = 0 but for 50 digits: the switching function is 0 there.
        qdd = subject.model.accelerations(0.0, x, held.demand)
        along = product(turn, _rows(v_u[:, None]))
        w_dot = [a + b[0] for a, b in zip(v_a, along, strict=True)]
        true = [*exactly(v_u), *qdd[m:], *w_dot]
        at = np.array([float(v) for v in x])
        yield from subject.compared("sliding motion", at, motion(y), true, motion.names)


def _rows(block: FloatArray) -> list[list[Number]]:
    return [exactly(row) for row in block]


def exported_law(subject: Subject, folder: Path, real: Any = "double") -> Iterator[Difference]:
    """The law of the exported C on a stable surface; its own test must pass, observer and all."""
    subject = Subject(subject.mechanism, ut.first_surface(subject.mechanism), count=1)
    mechanism, m = subject.mechanism, subject.mechanism.m
    controller = EmbeddedController(
        mechanism, subject.surface, subject.reaching, differentiator=KalmanStep(), real=real
    )
    build = Build(controller, folder)
    passed, said = build.self_test()
    assert passed, said
    lines = "".join("l " + " ".join(map(repr, row)) + "\n" for row in subject.states.tolist())
    done = subprocess.run([build.pipe()], input=lines, capture_output=True, text=True, check=True)
    for x, line, law in zip(subject.states, done.stdout.splitlines(), subject.laws, strict=True):
        demand, s, margin = np.split(np.array(line.split(), dtype=float), [m, 2 * m])
        names = [i.name for i in mechanism.inputs]
        yield from subject.compared("C: demand", x, demand, law.demand, names)
        yield from subject.compared("C: s", x, s, law.s)
        yield from subject.compared("C: margin", x, margin, [law.margin])


#: Relative tolerance of the large steps that are compared, how far results may be off, relative
#: to time, cost and the size of the first state, and the longest motion, s.
FINE, SETTLED, LONGEST = 1e-5, 1e-4, 10.0


def settling(subject: Subject, objective: ut.Objective | None = None) -> Iterator[Difference]:
    """Compare the end of motions in large steps: where, when and at what cost they arrive.

    Beside it stands the closed loop written out in NumPy from the model's own expressions and
    integrated by SciPy: nothing of it is generated here.  From two states inside the boundary
    layer motions go to a terminal set, and for half of that time.  A loop without a stable surface
    or a linear model has no large steps.
    """
    mechanism, names = subject.mechanism, subject.mechanism.state_names
    goal = objective or ut.MinimumEnergy(travel=False)
    try:
        surface = ut.first_surface(mechanism)
    except (ModelError, SingularSurfaceError, UnstableSurfaceError):
        return
    reference = _Written(mechanism, surface, subject.reaching, goal)
    # Small steps come first, as long as s changes fast: the check's own comparison judges them.
    loop = ut.ClosedLoop(mechanism, goal, subject.reaching, step=1e-3, tail_rtol=FINE)
    if not loop.takes_large_steps:
        return
    starts = np.array([reference.calm(x) for x in _motions(subject)])
    radius = 0.1 * float(np.linalg.norm(starts, axis=1).min())
    ends = [reference.motion(x, LONGEST, radius) for x in starts]
    half = 0.5 * min(time for _, time, _ in ends)
    for what, span in (("arrival", LONGEST), ("on the way", half)):
        steps = round(span / loop.step)
        found = loop.batch(starts, surface, duration=span, terminal=radius)
        for k, x in enumerate(starts):
            late = float(found.time[k])
            state, time, cost = ends[k]
            if not time < span:  # it ends with its last large step, which may be later
                time = max(late, steps * loop.step)
                state, _, cost = reference.motion(x, time, 0.0)
            size = float(np.linalg.norm(x))
            rows = [("time", late, time, time), ("cost", float(found.cost[k]), cost, cost)]
            if what == "arrival" and found.steps[k] > 0.9 * late / loop.step:  # they were given up
                rows.append(("number of steps", float(found.steps[k]), 0.0, 1.0))
            rows += [(name, found.x[k, i], state[i], size) for i, name in enumerate(names)]
            for name, got, true, scale in rows:
                off = abs(got - true) / scale
                yield Difference(
                    f"large steps: {what} [{name}]", subject.where(x), float(got), float(true),
                    off if math.isfinite(off) else math.inf,
                )  # fmt: skip


class _Written:
    """A closed loop as the equations say, in NumPy: (1)-(5), (10), (12), (38), (39)."""

    def __init__(
        self,
        mechanism: ut.Mechanism,
        surface: ut.Surface,
        reaching: ut.ReachingLaw,
        goal: ut.Objective,
    ) -> None:
        values, x = mechanism.substitution, mechanism.x
        self.n, self.m, self.surface = mechanism.n, mechanism.m, surface
        self._terms = sp.lambdify([x], [
            entry.subs(values) for entry in (mechanism.mass_matrix, mechanism.force)
        ], "numpy", cse=True, dummify=True)  # fmt: skip
        self._B = np.array(mechanism.input_matrix.subs(values), dtype=float)
        cost = goal.stage_cost(mechanism).subs(values)
        self._cost = sp.lambdify([x, mechanism.u], cost, "numpy", dummify=True)
        self._eta, self._layer = np.split(reaching.vector(mechanism.m), 2)
        self._limit = mechanism.input_limits

    def law(self, x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return M, f, s and the input that is asked for."""
        m, n, c = self.m, self.n, self.surface
        M, f = self._terms(x)
        M, f = np.asarray(M, dtype=float), np.ravel(f)
        X, y = np.linalg.solve(M[m:, m:], M[m:, :m]), np.linalg.solve(M[m:, m:], f[m:])
        s = c.matrix @ x
        push = self._eta * np.clip(s / self._layer, -1.0, 1.0)
        drift = c.alpha_u @ y + c.lambda_a @ x[n : n + m] + c.lambda_u @ x[n + m :] + push
        v = -np.linalg.solve(c.alpha_a - c.alpha_u @ X, drift)
        u = np.linalg.solve(self._B, M[:m, :m] @ v - M[:m, m:] @ X @ v - f[:m] + M[:m, m:] @ y)
        return M, f, s, u

    def calm(self, x: FloatArray) -> FloatArray:
        """Return a state near x's shadow on the surface, well inside the layer and the limits."""
        C = self.surface.matrix
        x = x - np.linalg.pinv(C) @ (C @ x - 0.3 * self._layer)
        while True:
            _, _, s, u = self.law(x)
            if (np.abs(s) < 0.5 * self._layer).all() and (np.abs(u) < 0.5 * self._limit).all():
                return x
            x = 0.8 * x

    def motion(self, x: FloatArray, span: float, radius: float) -> tuple[FloatArray, float, float]:
        """Return where a motion ends, when, and its cost: in the terminal set, or at a time."""

        def rates(_: float, row: FloatArray) -> FloatArray:
            M, f, _s, u = self.law(row[:-1])
            u = np.clip(u, -self._limit, self._limit)
            forced: FloatArray = np.append(self._B @ u, np.zeros(self.n - self.m)) + f
            return np.hstack(
                [row[self.n : -1], np.linalg.solve(M, forced), self._cost(row[:-1], u)]
            )

        def outside(_: float, row: FloatArray) -> float:
            return float(np.linalg.norm(row[:-1])) - radius

        outside.terminal = True  # type: ignore[attr-defined]
        found = solve_ivp(
            rates, (0.0, span), np.append(x, 0.0), "DOP853", rtol=1e-10, atol=1e-13, events=outside
        )
        end: FloatArray = found.y[:, -1]
        return end[:-1], float(found.t[-1]), float(end[-1])


def _motions(subject: Subject) -> FloatArray:
    """Two random states from which motions begin."""
    rng = np.random.default_rng(subject._count)
    return rng.uniform(-0.3, 0.3, (2, 2 * subject.mechanism.n))


# -- names ---------------------------------------------------------------------------------------

#: Names that generators, languages or SymPy use themselves, and some that are merely odd.
ODD_NAMES = (
    "z_1", "sw_0", "dz_0", "ds_0", "x", "u", "x_0", "u_0", "m_0", "self", "lambda", "int",
    "double", "float", "const", "static", "ut_step", "ut_real", "UT_N", "NAN", "h", "numba", "np",
    "math", "numpy", "pi", "E", "I", "S", "N", "O", "Q", "gamma", "beta", "zeta", "True", "None",
    "α", "µ", "φ", "W", "b", "i", "out", "plant", "belief", "limits", "lanes", "record", "step",
    "law", "parameters", "margin", "demand", "a0", "a1", "w0", "v0", "k_0", "r_0", "o_0", "g_0",
    "angle_0", "part", "sigma", "alpha_a", "lambda_u", "M_11", "f_1", "s", "x_dot2", "class",
    "n" * 200, "n" * 199 + "m", "sin", "cos", "sqrt", "range", "max", "abs", "w_q", "p_q", "time",
)  # fmt: skip


def named(
    names: Sequence[str], like: ut.Mechanism | None = None, title: str = "odd names"
) -> ut.Mechanism:
    """A mechanism of the library under other names: coordinates, inputs, then parameters.

    Where names are too few, parameters keep theirs.
    """
    base = like or ut.mechanisms.cart_pendulum()
    n, m = base.n, base.m
    old = [*(c.name for c in base.coordinates), *(i.name for i in base.inputs)]
    old += [p.name for p in base.parameters]
    new = [*names[: len(old)], *old[len(names) :]]
    coordinates = [
        ut.Coordinate(name, c.unit, "", c.low, c.high)
        for name, c in zip(new[:n], base.coordinates, strict=True)
    ]
    inputs = [
        ut.Input(name, i.unit, i.limit) for name, i in zip(new[n : n + m], base.inputs, strict=True)
    ]
    parameters = [
        ut.Parameter(name, p.value, p.unit)
        for name, p in zip(new[n + m :], base.parameters, strict=True)
    ]
    rename = {
        **dict(zip(base.q, (c.symbol for c in coordinates), strict=True)),
        **dict(zip(base.x[n:], (c.velocity for c in coordinates), strict=True)),
        **dict(zip(base.parameter_symbols, (p.symbol for p in parameters), strict=True)),
    }

    def moved(matrix: sp.Matrix) -> sp.ImmutableDenseMatrix:
        return sp.ImmutableDenseMatrix(matrix.applyfunc(lambda e: e.xreplace(rename)))

    return ut.Mechanism(
        title,
        tuple(coordinates),
        tuple(inputs),
        moved(base.mass_matrix),
        moved(base.force),
        moved(base.input_matrix),
        parameters=tuple(parameters),
        potential=None if base.potential is None else base.potential.xreplace(rename),
        start={coordinates[-1].name: 0.1},
    )


def bypassing_the_door(mechanism: ut.Mechanism, rename: dict[str, str]) -> ut.Mechanism:
    """The mechanism with some names changed and nothing checked."""
    symbols = {sp.Symbol(a, real=True): sp.Symbol(b, real=True) for a, b in rename.items()}
    made = object.__new__(ut.Mechanism)
    made.__dict__.update(
        {k: v for k, v in mechanism.__dict__.items() if k in ut.Mechanism.__dataclass_fields__}
    )
    for part in ("mass_matrix", "force", "input_matrix"):
        value = getattr(mechanism, part).xreplace(symbols)
        made.__dict__[part] = sp.ImmutableDenseMatrix(value)
    made.__dict__["potential"] = None
    made.__dict__["parameters"] = tuple(
        _renamed(p, rename.get(p.name, p.name)) for p in mechanism.parameters
    )
    return made


def _renamed(parameter: ut.Parameter, name: str) -> ut.Parameter:
    made = object.__new__(ut.Parameter)
    made.__dict__.update(parameter.__dict__)
    made.__dict__["name"] = name
    return made
