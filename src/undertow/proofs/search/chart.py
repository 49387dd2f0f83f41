"""Coordinates in which a low-degree Lyapunov function can follow the motion on a surface.

With one unactuated coordinate q the motion at η = 0 (η is the slow coordinate w − κq) is
q̈ = F₀(q) + F₁(q) q̇ + F₂(q) q̇².  Without the damping F₁ it keeps ½ μ q̇² + ∫ −F₀ μ dq with
μ = exp(−2 ∫ F₂ dq), which grows without bound towards the singular angle.  The coordinates
(√(2∫−F₀μ), √μ q̇, η) are fitted by powers of τ = q²/(L² − q²); see
:mod:`undertow.proofs.region.lyapunov`.  All in float64: a heuristic for the search.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.integrate import cumulative_simpson
from scipy.optimize import nnls

from undertow.models.mechanism import FloatArray
from undertow.proofs.region.motion import SurfaceMotion


def singular_distance_on_axis(motion: SurfaceMotion, limit: float) -> float:
    """Return the smallest |y_0| ≤ limit at which the motion is singular, other y at 0."""

    def ratio(q: FloatArray) -> FloatArray:
        y = np.zeros((*np.shape(q), motion.size))
        y[..., 0] = q
        return motion.margin(y)

    grid = np.linspace(0.0, limit, 4001)
    bad = ~(ratio(grid) > 0)
    if not bad.any():
        return limit
    high = float(grid[bad.argmax()])
    low = high - float(grid[1])
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if ratio(np.array(middle)) > 0 else (low, middle)
    return low


#: J of a natural stretch, and the part of L that its fit covers.
POWERS, FITTED = 2, 0.93


def natural_stretch(
    motion: SurfaceMotion, *, slow: bool = False
) -> tuple[FloatArray, float] | None:
    """Return S, (J, 3, 3), and L for one unactuated and one actuated coordinate.

    ``slow``: third coordinate η, not w: often better with |λ_a| large against the other rates.
    Returns ``None`` where the motion has no such form: several unactuated coordinates, no
    singularity within reach, or a force that does not restore.
    """
    if (motion.mechanism.n, motion.mechanism.m) != (2, 1):
        return None
    far = math.pi if motion.mechanism.coordinates[1].unit == "rad" else 100.0
    pole = singular_distance_on_axis(motion, far)
    if pole >= far:
        return None
    q = np.linspace(0.0, FITTED * pole, 2001)
    h = 1e-2
    kappa = float(motion.slow[0, 0])

    def acceleration(v: float) -> FloatArray:
        return motion(np.stack([q, np.full_like(q, v), kappa * q], axis=1))[:, 1]

    F_0 = acceleration(0.0)
    F_2 = (acceleration(h) + acceleration(-h) - 2 * F_0) / (2 * h * h)
    mu = np.exp(-2 * cumulative_simpson(F_2, x=q, initial=0))
    energy = cumulative_simpson(-F_0 * mu, x=q, initial=0)
    stiffness = -F_0[1] / q[1]
    if not (stiffness > 0 and (np.diff(energy) > 0).all()):
        return None
    zeta = np.sqrt(2 * energy[1:] / stiffness) / q[1:]
    tau = (q**2 / (pole**2 - q**2))[1:]
    S = np.zeros((POWERS, 3, 3))
    for i, shape in enumerate((zeta, np.sqrt(mu[1:]))):
        columns = np.stack([tau**j for j in range(1, POWERS + 1)], axis=1) / shape[:, None]
        S[:, i, i] = nnls(columns, 1 - 1 / shape)[0]  # relative least squares, all ≥ 0
    if slow:  # c_2 − κ c_0 = w − κ q = η in c = y + Σ τ^j S_j y
        S[:, 2, 0] = kappa * S[:, 0, 0]
    return S, pole
