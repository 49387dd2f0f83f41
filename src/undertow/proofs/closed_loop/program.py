"""The equations of the whole closed loop on a tape, compiled for floats and for boxes.

Coordinates and equations are those of :mod:`undertow.proofs.closed_loop.loop`.  sat(s/ε) enters
as m variables of its own, so that everything here is smooth.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import sympy as sp

from undertow.law import Surface
from undertow.models.mechanism import FloatArray, Mechanism
from undertow.proofs.intervals.batch import IntervalArithmetic
from undertow.proofs.intervals.exact_model import exact_matrix, exact_number
from undertow.proofs.intervals.interval import OutwardFunction, compile_outward, derivative_tape
from undertow.symbolic import Tape, compile_numpy


@dataclass(frozen=True, eq=False)
class _Equations:
    """What the equations are made of; ``lower`` and ``pull`` are N M_l and N f_u.

    N scales the unactuated rows: M_uu at the target, inverted.  Where plant parameters are
    uncertain it is diagonal and made of the plant's own symbols, so that a common factor such
    as a mass cancels before anything is enclosed.
    """

    mechanism: Mechanism
    surface: Surface
    eta: FloatArray
    lower: sp.Matrix
    pull: sp.Matrix

    @classmethod
    def of(
        cls, mechanism: Mechanism, surface: Surface, eta: FloatArray, uncertain: Collection[str]
    ) -> _Equations:
        m, mass = mechanism.m, mechanism.mass_matrix
        own = {p.symbol for p in mechanism.parameters if p.name in uncertain}
        if not own:
            scale = exact_matrix(mechanism.M(np.zeros(mechanism.n))[m:, m:]).inv()
            return cls(mechanism, surface, eta, scale * mass[m:, :], scale * mechanism.force[m:, :])
        at_target = mass[m:, m:].subs(dict.fromkeys(mechanism.q, 0))
        scale = sp.diag(*(1 / at_target[i, i] for i in range(at_target.rows)))
        return cls(
            mechanism,
            surface,
            eta,
            (scale * mass[m:, :]).applyfunc(sp.cancel),
            (scale * mechanism.force[m:, :]).applyfunc(sp.cancel),
        )


class LoopFunctions:
    """The equations as float and as interval functions.

    Parameters
    ----------
    mechanism, surface, eta
        The law's model and numbers; η (m,).
    uncertain
        Names of plant parameters that are not the law's own: k of them.

    Attributes
    ----------
    floats, points, boxes
        Functions of (z, sw, parameters): (slow, u, W); (slow, u, gap); and (slow, u, W, gap),
        each block followed by its derivatives.  Derivatives are in z and the k parameters, those
        of u and gap in sw too.
    second
        Function of (z, ż, parameters): d/dt of the slow rows' derivatives.
    """

    def __init__(
        self,
        mechanism: Mechanism,
        surface: Surface,
        eta: FloatArray,
        uncertain: Collection[str] = (),
    ) -> None:
        n, m = mechanism.n, mechanism.m
        subject = _Equations.of(mechanism, surface, eta, uncertain)
        # No name of a user's has a full stop in it.
        z = tuple(sp.Symbol(f"z.{i}", real=True) for i in range(2 * n))
        sw = tuple(sp.Symbol(f"sw.{i}", real=True) for i in range(m))
        tape = Tape()
        slow, q_dot = _slow_rates(tape, subject, z)
        state = dict(zip(mechanism.x, [*z[:n], *q_dot], strict=True))
        # Unknown parameters are the plant's; the law keeps its own numbers.
        own = {p.symbol: exact_number(p.value) for p in mechanism.parameters}
        free = [p.symbol for p in mechanism.parameters if p.name in uncertain]
        u, W = _law(tape, subject, state, q_dot, sw)
        still, _ = _law(tape, subject, state, q_dot, [sp.Integer(0)] * m)
        gap: list[sp.Expr] = [sp.Integer(0)] * m
        if free:
            believed, _ = _law(tape, subject, {**state, **own}, q_dot, sw)
            gap = tape.let_all([a - b for a, b in zip(believed, u, strict=True)])
            u = believed
        self._tape, self._free = tape, free
        self._held = (z, slow, still, W, mechanism.parameter_symbols)
        self._inputs = [*z, *sw, *mechanism.parameter_symbols]
        self.floats = compile_numpy(tape, self._inputs, [*slow, *u, *W])
        state_like = [*z, *free]
        with_switch = [*z, *free, *sw]
        blocks = [(slow, state_like), (u, with_switch), (W, state_like), (gap, with_switch)]
        slopes = [self._slopes(block, variables) for block, variables in blocks]
        self._all = [d for part in slopes for d in part]
        self.points = self._outward(self._inputs, [*slow, *u, *gap])
        self.boxes = self._outward(
            self._inputs, [e for (b, _), d in zip(blocks, slopes, strict=True) for e in (*b, *d)]
        )
        speeds = [sp.Symbol(f"dz.{i}", real=True) for i in range(2 * n)]
        first = self._slopes(slow, z)
        change = tape.let_all(
            sum(d * v for d, v in zip(first[i * 2 * n : (i + 1) * 2 * n], speeds, strict=True))
            for i in range(len(slow))
        )
        self.second = self._outward(
            [*z, *speeds, *mechanism.parameter_symbols], self._slopes(change, state_like)
        )

    @cached_property
    def mixed(self) -> OutwardFunction:
        """∂/∂(k parameters) of each derivative in ``boxes``, one after another."""
        return self._outward(self._inputs, self._slopes(self._all, self._free))

    @cached_property
    def slow(self) -> OutwardFunction:
        """Function of (z, parameters): the slow rows and their derivatives."""
        z, slow, *_, parameters = self._held
        return self._outward([*z, *parameters], [*slow, *self._slopes(slow, [*z, *self._free])])

    @cached_property
    def jerk(self) -> OutwardFunction:
        """Function of (z, ṡ, parameters): s̈ for a held input.

        ṡ = W (v − u°) with v̇ = 0 gives s̈ = Ẇ W⁻¹ ṡ − W u̇°.
        """
        return self._outward(*self._jerk)

    @cached_property
    def jerk_slope(self) -> OutwardFunction:
        """As ``jerk``, and the derivatives in z, ṡ and the k parameters."""
        inputs, jerk = self._jerk
        variables = [*inputs[: len(inputs) - len(self._held[-1])], *self._free]
        return self._outward(inputs, [*jerk, *self._slopes(jerk, variables)])

    @cached_property
    def _jerk(self) -> tuple[list[sp.Symbol], list[sp.Expr]]:
        tape, (z, slow, still, W, parameters) = self._tape, self._held
        m = len(still)
        speeds = [sp.Symbol(f"ds.{i}", real=True) for i in range(m)]
        rates = [*slow, *speeds]
        slopes = self._slopes([*still, *W], z)
        change = tape.let_all(
            sum(d * v for d, v in zip(slopes[i * len(z) : (i + 1) * len(z)], rates, strict=True))
            for i in range(m + m * m)
        )
        matrix, turned = sp.Matrix(m, m, W), sp.Matrix(m, m, change[m:])
        adjugate, determinant = tape.adjugate(matrix)
        spare = tape.matrix(adjugate * sp.Matrix(speeds) * tape.let(1 / determinant))
        jerk = tape.let_all(list(turned * spare - matrix * sp.Matrix(change[:m])))
        return [*z, *speeds, *parameters], jerk

    def _slopes(self, outputs: Sequence[sp.Expr], variables: Sequence[sp.Symbol]) -> list[sp.Expr]:
        return [d for e in outputs for d in _derivatives(self._tape, variables, e)]

    def _outward(self, inputs: Sequence[sp.Symbol], outputs: Sequence[sp.Expr]) -> OutwardFunction:
        return compile_outward(self._tape, inputs, outputs, IntervalArithmetic())


def _derivatives(tape: Tape, variables: Sequence[sp.Symbol], e: sp.Expr) -> list[sp.Expr]:
    if not sp.sympify(e).free_symbols:
        return [sp.Integer(0)] * len(variables)
    return derivative_tape(tape, variables, e)


def _slow_rates(
    tape: Tape, motion: _Equations, z: Sequence[sp.Symbol]
) -> tuple[list[sp.Expr], list[sp.Expr]]:
    """Lay (q̇, ṗ) on the tape; q̇ apart as atoms."""
    mechanism, surface = motion.mechanism, motion.surface
    n, m = mechanism.n, mechanism.m
    q, p, s = sp.Matrix(z[:n]), sp.Matrix(z[n : 2 * n - m]), sp.Matrix(z[2 * n - m :])
    where = dict(zip(mechanism.q, q, strict=True))
    lower = motion.lower
    rows = sp.Matrix(n - m, n, tape.let_all([e.xreplace(where) for e in lower]))
    inverse = exact_matrix(surface.alpha_a).inv()
    alpha_u = exact_matrix(surface.alpha_u)
    r = tape.matrix(
        s - exact_matrix(surface.lambda_a) * q[:m, :] - exact_matrix(surface.lambda_u) * q[m:, :]
    )
    pull = tape.matrix(rows[:, :m] * inverse)
    E = tape.matrix(rows[:, m:] - pull * alpha_u)
    adjugate, determinant = tape.adjugate(E)
    reciprocal = tape.let(1 / determinant)
    right = tape.matrix(p - pull * r)
    v_u = tape.matrix(tape.product(adjugate, right) * reciprocal)
    v_a = tape.matrix(inverse * (r - alpha_u * v_u))
    q_dot = [*v_a, *v_u]
    rates = sp.zeros(n - m, n)
    for symbol, speed in zip(mechanism.q, q_dot, strict=True):
        rates += lower.diff(symbol).applyfunc(lambda e: e.xreplace(where)) * speed
    state = {**where, **dict(zip(mechanism.x[n:], q_dot, strict=True))}
    force = sp.Matrix([e.xreplace(state) for e in motion.pull])
    p_dot = tape.matrix(force + rates * sp.Matrix(q_dot))
    return [*q_dot, *p_dot], q_dot


def _law(
    tape: Tape,
    motion: _Equations,
    rename: Mapping[sp.Symbol, sp.Expr],
    q_dot: Sequence[sp.Expr],
    switch: Sequence[sp.Symbol],
) -> tuple[list[sp.Expr], list[sp.Expr]]:
    """Lay the demand u, (5) with (12), and Γ S⁻¹ B on the tape."""
    mechanism, surface = motion.mechanism, motion.surface
    m = mechanism.m

    def laid(block: sp.Matrix) -> sp.Matrix:
        return tape.matrix(block.applyfunc(lambda e: e.xreplace(dict(rename))))

    mass, force, B = mechanism.mass_matrix, mechanism.force, laid(mechanism.input_matrix)
    adjugate, determinant = tape.adjugate(laid(motion.lower[:, m:]))
    inverse = tape.matrix(adjugate * tape.let(1 / determinant))
    X = tape.product(inverse, laid(motion.lower[:, :m]))
    y = tape.product(inverse, laid(motion.pull))
    upper = laid(mass[:m, m:])
    S = tape.matrix(laid(mass[:m, :m]) - tape.product(upper, X))
    h = tape.matrix(laid(force[:m, :]) - tape.product(upper, y))
    alpha_u = exact_matrix(surface.alpha_u)
    gamma = tape.matrix(exact_matrix(surface.alpha_a) - alpha_u * X)
    adjugate, determinant = tape.adjugate(gamma)
    reciprocal = tape.let(1 / determinant)
    v = sp.Matrix(q_dot)
    push = sp.Matrix([exact_number(k) * w for k, w in zip(motion.eta, switch, strict=True)])
    drive = tape.matrix(
        alpha_u * y
        + exact_matrix(surface.lambda_a) * v[:m, :]
        + exact_matrix(surface.lambda_u) * v[m:, :]
        + push
    )
    wanted = tape.matrix(-tape.product(adjugate, drive) * reciprocal)
    force = tape.matrix(S * wanted - h)
    b_adjugate, b_determinant = tape.adjugate(B)
    u = tape.let_all(list(b_adjugate * force / b_determinant))
    W = tape.product(gamma, tape.cholesky(S).solve(B))
    return u, list(W)
