"""A terminal set as numbers, and exact decisions on small matrices.

What is claimed of it and how it is decided: :mod:`undertow.proofs.closed_loop.terminal`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from undertow.models.mechanism import FloatArray
from undertow.proofs.intervals.batch import Interval
from undertow.proofs.intervals.require import require


@dataclass(frozen=True, eq=False)
class TerminalSet:
    """{‖T⁻¹(q, p)‖ ≤ 1, |s_i| ≤ σ_i}.

    Parameters
    ----------
    scale
        T, (2n − m, 2n − m), invertible.
    widths
        σ, (m,), > 0, in units of s.

    Raises
    ------
    InvalidInputError
        For a singular or not finite T, or widths that are not positive.
    """

    scale: FloatArray
    widths: FloatArray

    def __init__(self, scale: ArrayLike, widths: ArrayLike) -> None:
        T = np.array(scale, dtype=float)
        sigma = np.atleast_1d(np.array(widths, dtype=float))
        square = T.ndim == 2 and T.shape[0] == T.shape[1] and np.isfinite(T).all()
        require(square, "scale of a terminal set", T.shape, "square, finite")
        good = np.isfinite(sigma).all() and (sigma > 0).all()
        require(good, "widths of a terminal set", widths, "finite and > 0")
        regular = not abs(np.linalg.det(T)) < 1e-300
        require(regular, "scale of a terminal set", "singular", "invertible")
        object.__setattr__(self, "scale", T)
        object.__setattr__(self, "widths", sigma)

    def value(self, z: ArrayLike) -> FloatArray:
        """Return W at points z = (q, p, s), (…, N), in float64: ≤ 1 inside."""
        points = np.asarray(z, dtype=float)
        size = len(self.scale)
        x = points[..., :size] @ np.linalg.inv(self.scale).T
        part = np.abs(points[..., size:]) / self.widths
        return np.asarray(np.maximum(np.linalg.norm(x, axis=-1), part.max(axis=-1)))

    def times(self, factor: float) -> Self:
        """Return the set grown by a factor in all coordinates."""
        return type(self)(self.scale * factor, self.widths * factor)

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers."""
        return {"scale": self.scale.tolist(), "widths": self.widths.tolist()}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """Rebuild from :meth:`to_dict`."""
        return cls(data["scale"], data["widths"])


def exact_inverse(T: FloatArray) -> Interval:
    """Enclose T⁻¹ of a float matrix by exact elimination over the rationals.

    Raises
    ------
    InvalidInputError
        For a singular matrix.
    """
    size = len(T)
    rows = [
        [Fraction(float(v)) for v in row] + [Fraction(int(i == j)) for j in range(size)]
        for i, row in enumerate(T)
    ]
    for k in range(size):
        pivot = max(range(k, size), key=lambda i: abs(rows[i][k]))
        require(rows[pivot][k] != 0, "matrix", "singular", "invertible")
        rows[k], rows[pivot] = rows[pivot], rows[k]
        rows[k] = [v / rows[k][k] for v in rows[k]]
        for i in range(size):
            if i != k and rows[i][k]:
                rows[i] = [a - rows[i][k] * b for a, b in zip(rows[i], rows[k], strict=True)]
    near = np.array([[float(v) for v in row[size:]] for row in rows])
    return Interval(np.nextafter(near, -np.inf), np.nextafter(near, np.inf))


def _positive_definite(rows: list[list[Fraction]]) -> bool:
    """Decide by exact elimination whether a symmetric rational matrix is positive definite."""
    a = [list(row) for row in rows]
    for k in range(len(a)):
        if a[k][k] <= 0:
            return False
        for i in range(k + 1, len(a)):
            factor = a[i][k] / a[k][k]
            a[i] = [x - factor * y for x, y in zip(a[i], a[k], strict=True)]
    return True


def negative_by(matrix: Interval, slack: float) -> bool:
    """Whether xᵀMx ≤ −slack ‖x‖² for every M in an interval matrix (N, N)."""
    if not (np.isfinite(matrix.lo).all() and np.isfinite(matrix.hi).all()):
        return False
    middle = matrix.middle
    middle = 0.5 * (middle + middle.T)
    symmetric = 0.5 * (matrix + Interval(matrix.lo.T, matrix.hi.T))
    away = symmetric - Interval(middle)
    # ‖N‖₂ ≤ ‖N‖_∞ for symmetric N.
    worst = max(math.fsum(row) for row in away.magnitude) * (1 + 1e-12)
    shift = Fraction(worst) + Fraction(slack)
    size = len(middle)
    return _positive_definite(
        [
            [-Fraction(middle[i, j]) - (shift if i == j else 0) for j in range(size)]
            for i in range(size)
        ]
    )
