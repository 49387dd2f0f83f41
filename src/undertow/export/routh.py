"""The polynomial of the motion on a surface at the target, for Routh's criterion in C.

With s = 0 in place of the driven equations, ``det [α s + λ; (M s² − D s − F)_u] = 0``: of degree
2n − m in s, its coefficients sums of products of m numbers of the surface, each from another row.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import sympy as sp

from undertow.law import LawLayout
from undertow.models import Mechanism, linearise

#: A polynomial in s: coefficients, the constant first.
_Polynomial = list[sp.Expr]


def characteristic_polynomial(mechanism: Mechanism, surface: Sequence[sp.Symbol]) -> list[sp.Expr]:
    """Return the coefficients, the highest power first, (2n − m + 1,), scaled to at most 1.

    The belief is linearised at its target with its parameters' values; ``surface`` are the symbols
    of its numbers, (2mn,), as they lie in its vector.
    """
    n, m, lin = mechanism.n, mechanism.m, linearise(mechanism)
    vector = np.array(surface, dtype=object)
    alpha_a, lambda_a, alpha_u, lambda_u = LawLayout(n, m).blocks(vector)
    alpha, lambda_ = np.hstack([alpha_a, alpha_u]), np.hstack([lambda_a, lambda_u])
    rows = [[[lambda_[i, j], alpha[i, j]] for j in range(n)] for i in range(m)]
    rows += [
        [[sp.Float(-lin.F[i, j]), sp.Float(-lin.D[i, j]), sp.Float(lin.M[i, j])] for j in range(n)]
        for i in range(m, n)
    ]
    coefficients = [sp.expand(c) for c in _determinant(rows)][2 * n - m :: -1]
    factors = [abs(f) for c in coefficients for f in c.as_coefficients_dict().values()]
    return [sp.expand(c / max(factors)) for c in coefficients]


def _determinant(rows: list[list[_Polynomial]]) -> _Polynomial:
    """Return the determinant of a matrix of polynomials, by its last row."""
    if not rows:
        return [sp.Integer(1)]
    *above, last = rows
    total: _Polynomial = []
    for j, entry in enumerate(last):
        minor = _determinant([[*row[:j], *row[j + 1 :]] for row in above])
        sign = (-1) ** (len(last) - 1 - j)
        term = [sp.Integer(0)] * (len(minor) + len(entry) - 1)
        for a, left in enumerate(entry):
            for b, right in enumerate(minor):
                term[a + b] += sign * left * right
        longer = max(len(total), len(term))
        total += [sp.Integer(0)] * (longer - len(total))
        total = [sp.expand(t + (term[k] if k < len(term) else 0)) for k, t in enumerate(total)]
    return total
