"""The quadratic Lyapunov function that the search for a chain starts from."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from undertow.models.mechanism import FloatArray
from undertow.proofs.region.lyapunov import LyapunovFunction, directions
from undertow.proofs.region.motion import SurfaceMotion
from undertow.proofs.search.basis import CLEARANCE, FARTHEST, POLE_PART, slowest_rate

Start = Literal["far", "round", "balanced"]


def quadratic(
    motion: SurfaceMotion,
    stretch: tuple[FloatArray, float] | None,
    way: FloatArray,
    rng: np.random.Generator,
    start: Start,
) -> LyapunovFunction:
    """V = |z|², whose set {V ≤ 1} reaches far along the direction."""
    slowest_rate(motion)
    A, size = motion.jacobian, motion.size
    S, pole = stretch if stretch is not None else (None, np.inf)
    # Units in which the linear motion is about round.
    base = scipy.linalg.solve_continuous_lyapunov(A.T, -np.eye(size))
    units = 1 / np.sqrt(np.diag(base))
    rays = directions(rng, 500, size)

    def largest(T: FloatArray, stretched: bool) -> LyapunovFunction:
        """V = |z|², as large as samples allow; the search itself goes without the stretch."""
        bend = (S, pole) if stretched else (None, np.inf)
        r = _quadratic_radius(motion, LyapunovFunction.quadratic(T, *bend), rays, way)
        return LyapunovFunction.quadratic(r * T, *bend)

    if start == "balanced":
        B, D = scipy.linalg.matrix_balance(A, permute=False)
        P = scipy.linalg.solve_continuous_lyapunov(B.T, -np.eye(size))
        return largest(D @ _root(P), stretched=True)
    if start == "round":
        return largest(_root(base), stretched=True)
    best, root, width = -1.0, np.eye(size), 0.8
    chosen: LyapunovFunction | None = None
    # A (1+1) evolution strategy over the square root of Q, with the 1/5 success rule.
    for k in range(240):
        change = width * rng.normal(size=(size, size))
        attempt = (
            np.diag(np.exp(rng.normal(size=size)))
            if k < 40
            else scipy.linalg.expm(0.5 * (change + change.T)) @ root
        )
        Q = (attempt.T @ attempt + 1e-6 * np.eye(size)) / np.outer(units, units)
        V = largest(_root(scipy.linalg.solve_continuous_lyapunov(A.T, -Q)), stretched=False)
        reach = 1 / float(np.linalg.norm(np.linalg.solve(V.scale, way)))
        if k >= 40:
            width *= 1.25 if reach > best else 0.94
        if reach > best:
            best, chosen, root = reach, V, attempt
    assert chosen is not None
    return largest(chosen.scale, stretched=True)


def _root(P: NDArray[Any]) -> FloatArray:
    """T with P = (T Tᵀ)⁻¹, lower triangular."""
    return np.asarray(np.linalg.cholesky(np.linalg.inv(0.5 * (P + P.T))))


def _quadratic_radius(
    motion: SurfaceMotion, V: LyapunovFunction, rays: FloatArray, way: FloatArray
) -> float:
    """Largest r with V̇ < 0 at samples of |z| ≤ r, inside the non-singular set.

    Where the motion is linear all r are as good: then as far along ``way`` as anybody asks for.
    """
    most = FARTHEST * float(np.linalg.norm(np.linalg.solve(V.scale, way)))

    def holds(r: float) -> bool:
        y = V.points(r * rays)
        rate = np.sum(rays * V.coordinate_rates(y, motion(y)), axis=1)
        return bool(
            (rate < 0).all()
            and (motion.margin(y) > CLEARANCE).all()
            and (np.abs(y[:, 0]) < POLE_PART * V.pole).all()
        )

    r = min(1.0, most)
    while not holds(r) and r > 1e-9:
        r /= 2
    grow = r * 1.1
    while grow < most and holds(grow):
        r, grow = grow, grow * 1.1
    return r
