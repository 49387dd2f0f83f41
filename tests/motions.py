"""Motions of a closed loop as power series in t, by ball arithmetic of 60 digits.

The reference that validated tubes are compared with.  It shares nothing with them: the model's
own matrices, the law as the linear equations that it stands for, M q̈ = f + B u with
α_a q̈_a + α_u q̈_u + λ_a q̇_a + λ_u q̇_u = −η sat(s/ε), solved in every coefficient of the series.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import flint
import numpy as np
import sympy as sp

import undertow as ut

BITS, ORDER = 220, 26
flint.ctx.cap = ORDER  # of series; python-flint cuts them after ten terms by itself


def exact(value: float) -> Any:
    """A float as a ball without radius."""
    return flint.arb(flint.fmpq(*float(value).as_integer_ratio()))


def solve(A: list[list[Any]], b: list[Any]) -> list[Any]:
    """Gaussian elimination for numbers or series, the largest pivot of each column first."""
    size = len(b)
    rows = [[*row, right] for row, right in zip(A, b, strict=True)]
    for i in range(size):
        best = max(range(i, size), key=lambda k: abs(float(first(rows[k][i]).mid())))
        rows[i], rows[best] = rows[best], rows[i]
        for k in range(i + 1, size):
            factor = rows[k][i] / rows[i][i]
            rows[k] = [v - factor * w for v, w in zip(rows[k], rows[i], strict=True)]
    x: list[Any] = [None] * size
    for i in reversed(range(size)):
        rest = rows[i][size]
        for j in range(i + 1, size):
            rest = rest - rows[i][j] * x[j]
        x[i] = rest / rows[i][i]
    return x


def first(value: Any) -> Any:
    """The number itself, or a series' value at 0."""
    return value[0] if isinstance(value, flint.arb_series) else value


class Reference:
    """A mechanism under its law, on one piece of sat and clip at a time."""

    def __init__(self, mechanism: ut.Mechanism, surface: ut.Surface, law: ut.ReachingLaw) -> None:
        self.mechanism, self.n, self.m = mechanism, mechanism.n, mechanism.m
        blocks = [*mechanism.mass_matrix, *mechanism.force, *mechanism.input_matrix]
        fractions = sorted(
            {r for e in blocks for r in sp.sympify(e).atoms(sp.Rational) if not r.is_Integer},
            key=str,
        )
        names = {r: sp.Symbol(f"fraction_{i}") for i, r in enumerate(fractions)}
        self.run = sp.lambdify(
            [*mechanism.x, *mechanism.parameter_symbols, *names.values()],
            [sp.sympify(e).xreplace(names) for e in blocks],
            modules=[{k: lambda v, k=k: getattr(v, k)() for k in ("sin", "cos")}],
            cse=True,
        )
        self.fixed = [exact(v) for v in mechanism.parameter_values]
        with flint.ctx.workprec(BITS):
            self.fixed += [flint.arb(flint.fmpq(int(r.p), int(r.q))) for r in fractions]
        m = self.m
        self.velocity = [
            [exact(v) for v in row] for row in np.hstack([surface.alpha_a, surface.alpha_u])
        ]
        self.position = [
            [exact(v) for v in row] for row in np.hstack([surface.lambda_a, surface.lambda_u])
        ]
        self.eta, self.layer = ([exact(v) for v in part] for part in np.split(law.vector(m), 2))

    def matrices(self, q: Sequence[Any], v: Sequence[Any]) -> tuple[Any, Any, Any]:
        n, m = self.n, self.m
        zero = q[0] * 0
        flat = [zero + e for e in self.run(*q, *v, *self.fixed)]
        M = [flat[i * n : (i + 1) * n] for i in range(n)]
        B = [flat[n * n + n + i * m :][:m] for i in range(m)]
        return M, flat[n * n : n * n + n], B

    def s(self, x: Sequence[Any]) -> list[Any]:
        q, v = x[: self.n], x[self.n :]
        return [
            sum(a * b for a, b in zip(row, q, strict=True))
            + sum(a * b for a, b in zip(more, v, strict=True))
            for row, more in zip(self.position, self.velocity, strict=True)
        ]

    def demand(self, x: Sequence[Any], piece: Sequence[int]) -> tuple[list[Any], list[Any]]:
        """(q̈, u) unclipped, with s inside the layer (0) or beyond it on one side (±1)."""
        n, m = self.n, self.m
        M, f, B = self.matrices(x[:n], x[n:])
        zero = x[0] * 0
        rows = [[*M[i], *([-b for b in B[i]] if i < m else [zero] * m)] for i in range(n)]
        rows += [[*(zero + w for w in row), *[zero] * m] for row in self.velocity]
        pull = []
        for i, s in enumerate(self.s(x)):
            switch = s / self.layer[i] if piece[i] == 0 else zero + piece[i]
            moved = sum(a * b for a, b in zip(self.position[i], x[n:], strict=True))
            pull.append(-self.eta[i] * switch - moved)
        answer = solve(rows, [*f, *pull])
        return answer[:n], answer[n:]

    def clipped(self, u: Sequence[Any], clip: Sequence[int]) -> list[Any]:
        limits = [exact(v) for v in self.mechanism.input_limits]
        return [
            v * 0 + side * top if side else v for v, side, top in zip(u, clip, limits, strict=True)
        ]

    def rate(
        self,
        x: Sequence[Any],
        piece: Sequence[int],
        clip: Sequence[int],
        held: Sequence[Any] | None = None,
    ) -> list[Any]:
        """(q̇, q̈), with some inputs at a limit, or all of them held."""
        n, m = self.n, self.m
        if held is None and not any(clip):
            return [*x[n:], *self.demand(x, piece)[0]]
        u = self.clipped(self.demand(x, piece)[1], clip) if held is None else held
        M, f, B = self.matrices(x[:n], x[n:])
        force = [f[i] + (sum(B[i][j] * u[j] for j in range(m)) if i < m else 0) for i in range(n)]
        return [*x[n:], *solve(M, force)]

    def pieces(self, x: Sequence[Any]) -> tuple[list[int], list[int]]:
        """On which piece of sat and of clip each surface and input is."""
        ratio = [float((v / e).mid()) for v, e in zip(self.s(x), self.layer, strict=True)]
        piece = [0 if abs(r) < 1 else int(np.sign(r)) for r in ratio]
        u = [float(v.mid()) for v in self.demand(x, piece)[1]]
        limits = self.mechanism.input_limits
        return piece, [
            0 if abs(v) < top else int(np.sign(v)) for v, top in zip(u, limits, strict=True)
        ]

    def motion(self, x0: Sequence[Any], rate: Callable[[Any], Sequence[Any]]) -> list[Any]:
        """Coefficients in t of x(t) = x(0) + ∫ f(x), one more with every turn."""
        series = [flint.arb_series([v], prec=1) for v in x0]
        for k in range(1, ORDER):
            speeds = rate(series)
            series = [
                flint.arb_series([v, *(r[i] / (i + 1) for i in range(k))], prec=k + 1)
                for v, r in zip(x0, speeds, strict=True)
            ]
        return series
