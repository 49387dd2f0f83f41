"""The linear algebra of a Kalman filter, compiled once, in place."""

from __future__ import annotations

from undertow.models import FloatArray
from undertow.symbolic import numba

__all__ = ["measurement_update", "predict_covariance"]


@numba.njit(cache=True, error_model="numpy")
def predict_covariance(
    F: FloatArray, P: FloatArray, A: FloatArray, noise: FloatArray, h: float
) -> None:
    """Turn P into F P Fᵀ + h diag(noise), exactly symmetric; A, of P's size, is scratch."""
    size = P.shape[0]
    for i in range(size):
        for j in range(size):
            total = 0.0
            for k in range(size):
                total += F[i, k] * P[k, j]
            A[i, j] = total
    for i in range(size):
        for j in range(i + 1):
            total = 0.0
            for k in range(size):
                total += A[i, k] * F[j, k]
            P[i, j] = total
            P[j, i] = total
        P[i, i] += h * noise[i]


@numba.njit(cache=True, error_model="numpy")
def measurement_update(
    x: FloatArray, P: FloatArray, q: FloatArray, variance: FloatArray, column: FloatArray
) -> None:
    """Take in positions one by one, nothing inverted; a missing one (NaN) is left out."""
    size = x.shape[0]
    for i in range(q.shape[0]):
        if q[i] != q[i]:
            continue
        spread = P[i, i] + variance[i]
        error = q[i] - x[i]
        for k in range(size):
            column[k] = P[k, i]
        for k in range(size):
            x[k] += column[k] * (error / spread)
            for j in range(size):
                P[k, j] -= column[k] * column[j] / spread
