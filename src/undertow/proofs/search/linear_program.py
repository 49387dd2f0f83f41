"""A small dense linear program: few unknowns, very many inequalities.

Mehrotra's predictor-corrector method on the normal equations (Nocedal and Wright, *Numerical
Optimization*, ch. 14).  With 50 unknowns and 20,000 rows an iteration costs milliseconds,
where general sparse solvers take half a minute.  What has threads is NumPy's alone: SciPy brings
a BLAS of its own, and the threads of two that take turns wait for each other, many times the work.
"""

from __future__ import annotations

import numpy as np
import scipy.linalg

from undertow.models.mechanism import FloatArray

#: Residuals and gap, relative, at which a solution is one.
TOLERANCE = 1e-8


@np.errstate(all="ignore")  # an infeasible program overflows, and ends as None
def minimise_linear(
    c: FloatArray, A: FloatArray, b: FloatArray, *, iterations: int = 60
) -> FloatArray | None:
    """Minimise c·x subject to A x ≤ b.

    Returns x, or ``None`` where no solution was reached (infeasible, unbounded, or too ill
    conditioned).  It feeds a search whose result is verified elsewhere.
    """
    rows = np.abs(A).max(axis=1)
    columns = np.abs(A).max(axis=0)
    columns[columns == 0] = 1.0
    rows[rows == 0] = 1.0
    A, b, c = A / columns / rows[:, None], b / rows, c / columns
    m, n = A.shape
    x, z = np.zeros(n), np.ones(m)
    s = np.maximum(b, 1.0)
    for _ in range(iterations):
        primal, dual, gap = A @ x + s - b, A.T @ z + c, float(s @ z) / m
        error = max(
            np.abs(primal).max() / (1 + np.abs(b).max()),
            np.abs(dual).max() / (1 + np.abs(c).max()),
            gap / (1 + abs(float(c @ x))),
        )
        if error < TOLERANCE:
            return np.asarray(x / columns)
        H = (A * (z / s)[:, None]).T @ A
        H[np.diag_indices(n)] += 1e-13 * np.trace(H) / n
        if not np.isfinite(H).all():
            break
        try:
            factor = np.linalg.cholesky(H, upper=True), False
        except np.linalg.LinAlgError:
            break
        centring = -s * z
        for corrector in (False, True):
            dx = scipy.linalg.cho_solve(
                factor, -dual - A.T @ ((centring + z * primal) / s), check_finite=False
            )
            ds = -primal - A @ dx
            dz = (centring - z * ds) / s
            reach = 0.995 if corrector else 1.0
            step_p = min(1.0, reach * _longest(s, ds))
            step_d = min(1.0, reach * _longest(z, dz))
            if not corrector:
                after = float((s + step_p * ds) @ (z + step_d * dz)) / m
                centring = centring - ds * dz + (after / gap) ** 3 * gap
        x, s, z = x + step_p * dx, s + step_p * ds, z + step_d * dz
        if not np.isfinite(np.concatenate([x, s, z])).all() or np.abs(x).max() > 1e12:
            return None
    return np.asarray(x / columns) if np.max(A @ x - b) < 1e-7 else None


def _longest(v: FloatArray, dv: FloatArray) -> float:
    return float(np.min(np.where(dv < 0, -v / dv, np.inf)))
