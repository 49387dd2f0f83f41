"""The equations of motion on a tape, ``M_uu`` eliminated: (1)-(4) for all later use."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Self

import sympy as sp

from undertow.symbolic import Tape, compile_numpy


@dataclass(frozen=True, eq=False)
class Partition:
    """The blocks of (1) on a tape, with ``M_uu`` eliminated once for all later use.

    ``X = M_uu⁻¹ M_auᵀ``, ``y = M_uu⁻¹ f_u``, ``S = M_aa − M_au X`` (2) and
    ``h = f_a − M_au y``, so that ``S q̈_a = h + B u`` (4) and ``q̈_u = y − X q̈_a`` (3).
    """

    tape: Tape
    M_au: sp.Matrix
    M_uu: sp.Matrix
    f_u: sp.Matrix
    B: sp.Matrix
    X: sp.Matrix
    y: sp.Matrix
    S: sp.Matrix
    h: sp.Matrix

    @classmethod
    def of(
        cls, tape: Tape, mass: Sequence[sp.Expr], force: Sequence[sp.Expr], gain: Sequence[sp.Expr]
    ) -> Self:
        """Record the entries of M, f and B on a tape, row by row, and eliminate ``M_uu``."""
        n, m = len(force), math.isqrt(len(gain))
        atoms = tape.let_all([*mass, *force, *gain])
        M = sp.Matrix(n, n, atoms[: n * n])
        M = sp.Matrix(n, n, lambda i, j: M[min(i, j), max(i, j)])
        f = sp.Matrix(atoms[n * n : n * n + n])
        B = sp.Matrix(m, m, atoms[n * n + n :])
        M_aa, M_au, M_uu = M[:m, :m], M[:m, m:], M[m:, m:]
        f_a, f_u = f[:m, :], f[m:, :]
        factor = tape.cholesky(M_uu)
        X, y = factor.solve(M_au.T), factor.solve(f_u)
        S = tape.matrix(M_aa - M_au * X)
        S = sp.Matrix(m, m, lambda i, j: S[min(i, j), max(i, j)])
        h = tape.matrix(f_a - M_au * y)
        return cls(tape, M_au, M_uu, f_u, B, X, y, S, h)

    def accelerations(self, u: sp.Matrix) -> list[sp.Expr]:
        """Return q̈ = (q̈_a, q̈_u) for the inputs u, equations (3)-(4), as tape atoms."""
        tape = self.tape
        force = tape.matrix(self.h + self.B * u)
        qdd_a = tape.cholesky(self.S).solve(force)
        qdd_u = tape.matrix(self.y - self.X * qdd_a)
        return [*qdd_a, *qdd_u]


@lru_cache(maxsize=256)
def compiled(
    matrix: sp.ImmutableDenseMatrix, arguments: tuple[sp.Symbol, ...]
) -> Callable[..., list[Any]]:
    """Return the entries of a matrix as a NumPy function; shared by equal matrices."""
    tape = Tape()
    return compile_numpy(tape, arguments, tape.let_all(list(matrix)))
