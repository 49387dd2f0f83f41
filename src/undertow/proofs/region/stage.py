"""One function of a proof over boxes: V, V̇ and the guards in coordinates that follow the set.

The sets of :mod:`undertow.proofs.region.region` bend with the stretch of their functions; boxes
in y fit them badly.  So boxes are taken in x with (y_0, c_1, c_2, …) = B x, c = (I + Σ τ^j S_j) y,
in which V is a polynomial but for y_0.  Where the functions of a stage have different stretches, or
none, y = B x.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import sympy as sp
from numpy.typing import NDArray

from undertow.models.mechanism import FloatArray
from undertow.proofs.intervals.batch import Interval, IntervalArithmetic
from undertow.proofs.intervals.exact_model import exact_matrix
from undertow.proofs.intervals.interval import OutwardFunction, compile_outward, derivative_tape
from undertow.proofs.intervals.taylor import TaylorProgram
from undertow.proofs.intervals.taylor_kernel import bounds, excluded, spreads
from undertow.proofs.region.lyapunov import LyapunovFunction
from undertow.proofs.region.motion import AutonomousSystem
from undertow.symbolic import Tape

__all__ = ["Chart", "Stage", "stretched_alike"]


def stretched_alike(V: LyapunovFunction, inner: LyapunovFunction) -> bool:
    """Whether the sets of two functions are described in the same coordinates z of y.

    The z of a stretched function is one to one up to its pole alone: beyond, its formula says
    nothing of its set.
    """
    if inner.stretch is None or V.stretch is None:
        return inner.stretch is V.stretch
    S, T = np.asarray(inner.stretch), np.asarray(V.stretch)
    return inner.pole == V.pole and np.array_equal(S, T)


class Chart:
    """Coordinates x, with B lower triangular so that x_0 is y_0 over B_00."""

    def __init__(self, V: LyapunovFunction, inner: LyapunovFunction | None) -> None:
        """For the stretch that both functions have, if they have one; B is the unit matrix."""
        same = inner is None or (inner.stretch is not None and stretched_alike(V, inner))
        self.bent = V if V.stretch is not None and same and len(V.scale) > 1 else None
        self.B: FloatArray = np.eye(len(V.scale))

    def x(self, y: FloatArray) -> FloatArray:
        """Points y, (K, N), in these coordinates."""
        c = y
        if self.bent is not None:
            c = self.bent.coordinates(y) @ self.bent.scale.T
            c[:, 0] = y[:, 0]
        return np.asarray(np.linalg.solve(self.B, c.T).T)

    def y(self, x: FloatArray) -> FloatArray:
        """The inverse of :meth:`x`, for one point or (K, N)."""
        c = x @ self.B.T
        if self.bent is None:
            return np.asarray(c)
        q = c[..., 0]
        total, _ = self.bent.stretched(q)
        c = c.copy()
        c[..., 0] = q * total[..., 0, 0]
        return np.asarray(np.linalg.solve(total, c[..., None])[..., 0])

    def build_graph(
        self, tape: Tape, x: tuple[sp.Symbol, ...], motion: AutonomousSystem
    ) -> tuple[tuple[sp.Matrix, sp.Matrix], tuple[sp.Matrix, sp.Matrix] | None]:
        """(y, ẏ) and, where it is bent, (c, ċ) on a tape."""
        c = tape.matrix(exact_matrix(self.B) * sp.Matrix(x))
        if self.bent is None:
            y = c
            rates, _ = motion.build_graph(tape, list(y))
            return (y, sp.Matrix(rates)), None
        q = c[0]
        total, slope = self.bent.build_stretch_graph(tape, q)
        adjugate, determinant = tape.adjugate(total[1:, 1:])
        inverse = tape.matrix(adjugate * tape.let(1 / determinant))
        rest = tape.matrix(inverse * tape.matrix(c[1:, :] - total[1:, :1] * q))
        y = sp.Matrix([q, *rest])
        rates, _ = motion.build_graph(tape, list(y))
        y_dot = sp.Matrix(rates)
        c_dot = tape.matrix(total * y_dot + slope * y * y_dot[0])
        c[0] = tape.let(total[0, 0] * q)
        return (y, y_dot), (c, c_dot)


class Stage:
    """V, V̇, V's guard, and the set inside with its guard, in this order."""

    def __init__(
        self,
        motion: AutonomousSystem,
        V: LyapunovFunction,
        inner: LyapunovFunction | None,
        chart: Chart,
        parameters: Mapping[str, tuple[float, float]],
    ) -> None:
        tape, x = Tape(), motion.symbols
        (y, y_dot), bent = chart.build_graph(tape, x, motion)

        def graph(W: LyapunovFunction, rates: bool) -> tuple[sp.Expr, sp.Expr]:
            if bent is None:
                return W.build_graph(
                    tape, list(y), list(y_dot) if rates else [sp.Integer(0)] * len(y)
                )
            return W.build_polynomial_graph(tape, bent[0], bent[1] if rates else 0 * bent[1])

        others = [W for W in (V.guard, inner, inner and inner.guard) if W is not None]
        parts = [*graph(V, True), *(graph(W, False)[0] for W in others)]
        free = [p.symbol for p in motion.parameters if p.name in parameters]
        fixed = [p for p in motion.parameters if p.name not in parameters]
        variables = [*x, *free]
        self._constants = [Interval(p.value) for p in fixed]
        self._tape, self._inputs, self._x = tape, [*variables, *(p.symbol for p in fixed)], x
        self._rate = parts[1]
        self._point = compile_outward(tape, self._inputs, parts, IntervalArithmetic())
        self._models = TaylorProgram.of(
            tape, variables, [(p.symbol, p.value) for p in fixed], parts
        )
        self._hessian: OutwardFunction | None = None

    def point(self, x: FloatArray) -> list[Interval]:
        """Enclosures at points (N + P, K)."""
        values = self._point(*[Interval(row) for row in x], *self._constants)
        return [Interval.of(v) for v in values]

    def hessian(self, box: list[Interval]) -> list[list[Interval]]:
        """Interval Hessian of V̇ in x over a box."""
        size = len(self._x)
        if self._hessian is None:
            gradient = derivative_tape(self._tape, self._x, self._rate)
            rows = [derivative_tape(self._tape, self._x, g) for g in gradient]
            self._hessian = compile_outward(
                self._tape, self._inputs, [e for row in rows for e in row], IntervalArithmetic()
            )
        flat = [Interval.of(v) for v in self._hessian(*box, *self._constants)]
        return [flat[i * size : (i + 1) * size] for i in range(size)]

    def over(
        self, low: FloatArray, high: FloatArray
    ) -> tuple[list[Interval], NDArray[np.bool_], FloatArray]:
        """Over boxes (N + P, K).

        Returns
        -------
        parts
            Enclosures.
        settled
            Boxes without a point in the set, outside the set inside, where V does not fall.
        spread
            How much of V̇'s variation is due to each variable, (N + P, K).
        """
        models = self._models(np.ascontiguousarray(low), np.ascontiguousarray(high))
        parts = [Interval(a, b) for a, b in zip(*bounds(models, len(low)), strict=True)]
        ring = models[[1, 0, min(3, len(parts) - 1)]]
        if len(parts) < 4:  # no set inside: the constant 1
            ring[2], ring[2, 0] = 0.0, 1.0
        return parts, excluded(ring, len(low)), spreads(models[1:2], len(low))[0]
