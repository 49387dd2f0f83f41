"""The search for the appendix's P: semidefinite programs at the two vertices (Clarabel).

What is found is rounded to decimals and proved by :mod:`undertow.studies.paper.appendix`, which
shares nothing with the search.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from fractions import Fraction

import numpy as np

from undertow.base import InfeasibleError, require_extra
from undertow.base.verdict import Verdict
from undertow.models import FloatArray
from undertow.studies.paper.appendix import (
    BITS,
    Lyapunov,
    Reduced,
    decay_rate,
    flint,
    gamma_factor,
    two_vertex,
)


def _solve_sdp(
    objective: FloatArray, blocks: Sequence[tuple[FloatArray, FloatArray]]
) -> FloatArray:
    """Minimise objective·x subject to C + Σ x_i A_i ⪰ 0 for blocks (C, A), A (k, 3, 3)."""
    clarabel = require_extra("clarabel", "appendix", "the search for P needs Clarabel")
    from scipy import sparse

    def svec(M: FloatArray) -> FloatArray:
        # Clarabel's triangle: columns of the upper half, off-diagonals times √2.
        return np.array(
            [M[i, j] * (1.0 if i == j else math.sqrt(2)) for j in range(3) for i in range(j + 1)]
        )

    A = np.vstack([-np.column_stack([svec(a) for a in matrices]) for _, matrices in blocks])
    b = np.concatenate([svec(constant) for constant, _ in blocks])
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    size = len(objective)
    solution = clarabel.DefaultSolver(
        sparse.csc_matrix((size, size)),
        objective,
        sparse.csc_matrix(A),
        b,
        [clarabel.PSDTriangleConeT(3)] * len(blocks),
        settings,
    ).solve()
    if "Solved" not in str(solution.status):
        raise InfeasibleError(
            "search for P", value=str(solution.status), limit="a solved semidefinite program"
        )
    return np.asarray(solution.x, dtype=float)


_UNITS = [Lyapunov(*(Fraction(int(i == j)) for j in range(5))) for i in range(5)]


def _attempt(reduced: Reduced, width: float, sigma: float) -> Lyapunov | None:
    """A P with P ≻ 0 and R(ξ) ≻ σ P̃ at both vertices, as far inside as can be."""
    with flint().ctx.workprec(BITS):
        factor = float(gamma_factor(reduced, Fraction(width)).mid())
        xis = [float(reduced.xi(0).mid()), float(reduced.xi(width).mid())]
    # A congruence makes entries comparable: ẏ ~ √g y₁, y₃ ~ (λ_u/λ_a) y₁.
    n = reduced.numbers
    scale = np.array([1.0, math.sqrt(n["g"]), abs(float(reduced.lambda_u / reduced.lambda_a))])
    D = np.outer(scale, scale)
    basis = [np.array(unit.matrix(), dtype=float) for unit in _UNITS]
    full = [B + (factor * np.diag([1.0, 0, 0]) if i == 3 else 0) for i, B in enumerate(basis)]
    forms = [tuple(np.array(m, dtype=float) for m in reduced.R(unit)) for unit in _UNITS]
    zero, one = np.zeros((3, 3)), np.eye(3)
    blocks = [
        # Each vertex is divided by ξ, which grows without limit at the singularity.
        (
            zero,
            np.array(
                [
                    *(
                        D * (R[0] + xi * R[1] - sigma * B) / xi
                        for R, B in zip(forms, full, strict=True)
                    ),
                    -one,
                ]
            ),
        )
        for xi in xis
    ]
    blocks.append((one, np.array([*(-D * B for B in full), zero])))
    blocks.append((zero, np.array([*(D * B for B in basis), -1e-3 * one])))
    try:
        x = _solve_sdp(np.array([0, 0, 0, 0, 0, -1.0]), blocks)
    except InfeasibleError:
        return None
    return _rounded(x[:5])


#: Part of the interval that is searched at which a bisection ends.
TOLERANCE = 1e-3


def search_rate(reduced: Reduced, half_width: float | Fraction) -> tuple[Lyapunov, Verdict]:
    """Find the P of form (A18) with the largest proved decay rate on |y₁| ≤ half_width.

    For each σ a semidefinite program at the two vertices (γ is linear in p₂₂); bisection on σ below
    twice the slowest rate of the linearisation; each P is rounded to 12 digits and its rate is then
    proved by :func:`decay_rate`. Raises InfeasibleError when no P serves; MissingExtraError without
    Clarabel or python-flint.
    """
    low, high = 0.0, 2 * reduced.slowest_rate
    best: tuple[Lyapunov, Verdict] | None = None
    ceiling = high
    while high - low > TOLERANCE * ceiling:
        middle = 0.5 * (low + high)
        P = _attempt(reduced, float(half_width), middle)
        verdict = None if P is None else decay_rate(reduced, P, half_width)
        if P is None or verdict is None or not verdict or verdict.margin < low:
            high = middle
            continue
        low = max(middle, verdict.margin) if verdict.margin >= middle else verdict.margin
        high = high if verdict.margin >= middle else middle
        best = (P, verdict)
    if best is None:
        raise InfeasibleError(
            f"search for P of form (A18) on |y₁| ≤ {float(half_width):.4g} rad",
            value="none found",
            limit="R ≻ 0 at both vertices",
            remedy="Ask for a narrower interval",
        )
    return best


def search_interval(reduced: Reduced) -> tuple[float, Lyapunov, Verdict]:
    """Find the P of form (A18) with R ≻ 0 on the widest interval, by bisection.

    Returns the widest proved half-width, to :data:`TOLERANCE` of arccos ε. Raises InfeasibleError
    when no P serves even at y₁ = 0.
    """

    def attempt(width: float) -> tuple[Lyapunov, Verdict] | None:
        P = _attempt(reduced, width, 0.0)
        verdict = None if P is None else two_vertex(reduced, P, width)
        return (P, verdict) if P is not None and verdict else None

    low, best, high = 0.0, attempt(0.0), reduced.limit
    if best is None:
        raise InfeasibleError(
            "search for P of form (A18)", value="no P at y₁ = 0", limit="P ≻ 0 and R(0) ≻ 0"
        )
    while high - low > TOLERANCE * reduced.limit:
        middle = 0.5 * (low + high)
        found = attempt(middle)
        if found is None:
            high = middle
        else:
            low, best = middle, found
    return low, *best


def _rounded(values: FloatArray) -> Lyapunov:
    """P to 12 digits, scaled to p₁₁ = 1: nothing depends on its scale."""
    scale = values[0] if values[0] > 0 else 1.0
    return Lyapunov(*(Fraction(f"{v / scale:.12g}") for v in values))
