"""Lyapunov functions as plain numbers: an even polynomial in stretched coordinates.

Why stretched.  On the surface, with one unactuated coordinate q, the motion is
q̈ = F₀(q) + F₂(q) q̇² + (terms with the slow coordinate η and damping).  Its conserved part has
the energy ½ μ q̇² + ∫ −F₀ μ dq with μ = exp(−2 ∫ F₂ dq), and μ grows without bound towards the
singular angle ±L.  A polynomial in y itself follows that badly; one of low degree in
(√(2∫−F₀μ), √μ q̇, η) follows it well.  So V is a polynomial in

    z = T⁻¹ (I + Σ_j τ^j S_j) y,       τ = y₀²/(L² − y₀²),

where powers of τ with fitted matrices S_j stand for those functions.  The fit need not be
good: whatever V is, the checker decides.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from undertow.base.arguments import require
from undertow.models.mechanism import FloatArray


@dataclass(frozen=True)
class LyapunovFunction:
    """V(y) = Σ c_k Π z_i^e_ki with z = T⁻¹ (I + Σ_j τ^j S_j) y; the set is {V ≤ 1}.

    Parameters
    ----------
    scale
        T, (N, N), invertible.
    exponents
        e, (K, N): whole numbers of even sum ≥ 2.
    coefficients
        c, (K,).
    stretch
        S, (J, N, N), or None for z = T⁻¹ y.  The first row of each S_j has only a first
        entry, ≥ 0, so that z_0's part grows with y_0.
    pole
        L > 0; V is a function on |y_0| < L.

    Raises
    ------
    InvalidInputError
        For what is no even polynomial without constant term, or numbers that do not fit.
    """

    scale: FloatArray
    exponents: NDArray[np.int64]
    coefficients: FloatArray
    stretch: FloatArray | None = None
    pole: float = np.inf

    def __post_init__(self) -> None:
        """Refuse what is no even polynomial without constant term."""
        exponents = np.asarray(self.exponents)
        totals = exponents.sum(axis=1)
        size, of = exponents.shape[1], "of a Lyapunov function"
        even = not (totals % 2).any() and (totals >= 2).all() and (exponents >= 0).all()
        require(even, f"exponents {of}", limit="whole numbers of even sum ≥ 2")
        count, shape = len(self.coefficients), np.shape(self.scale)
        wanted = f"{len(exponents)}, one per monomial"
        require(count == len(exponents), f"coefficients {of}", count, wanted)
        require(shape == (size, size), f"scale {of}", shape, (size, size))
        if self.stretch is None:
            return
        S = np.asarray(self.stretch)
        good = S.shape[1:] == (size, size) and (S[:, 0, 1:] == 0).all() and (S[:, 0, 0] >= 0).all()
        require(good, f"stretch {of}", limit=f"(J, {size}, {size}), first rows (≥ 0, 0, …)")
        require(0 < self.pole < np.inf, f"pole {of}", self.pole, "> 0 and finite")

    @classmethod
    def quadratic(
        cls, scale: FloatArray, stretch: FloatArray | None = None, pole: float = np.inf
    ) -> Self:
        """Make V = |z|²."""
        size = len(scale)
        return cls(scale, 2 * np.eye(size, dtype=np.int64), np.ones(size), stretch, pole)

    @cached_property
    def _inverse(self) -> FloatArray:
        return np.asarray(np.linalg.inv(self.scale))

    def _tau(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """τ and ∂τ/∂q."""
        square = self.pole**2
        gap = square - q * q
        return q * q / gap, 2 * q * square / (gap * gap)

    def stretched(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return I + Σ τ^j S_j and its derivative by q, (…, N, N)."""
        assert self.stretch is not None
        tau, slope = self._tau(q)
        size = len(self.scale)
        shape = (*q.shape, size, size)
        total, rate = np.broadcast_to(np.eye(size), shape), np.zeros(shape)
        for j, S in enumerate(self.stretch, start=1):
            total = total + (tau**j)[..., None, None] * S
            rate = rate + (j * tau ** (j - 1) * slope)[..., None, None] * S
        return total, rate

    def coordinates(self, y: ArrayLike) -> FloatArray:
        """Return z at the points y, (…, N); |y_0| < L."""
        c = np.asarray(y, dtype=float)
        if self.stretch is not None:
            c = np.einsum("...ij,...j->...i", self.stretched(c[..., 0])[0], c)
        return np.asarray(c @ self._inverse.T)

    def coordinate_rates(self, y: FloatArray, y_dot: FloatArray) -> FloatArray:
        """Return ż at the points y that move with ẏ, (…, N)."""
        c_dot = y_dot
        if self.stretch is not None:
            total, slope = self.stretched(y[..., 0])
            c_dot = np.einsum("...ij,...j->...i", total, y_dot)
            c_dot = c_dot + np.einsum("...ij,...j->...i", slope, y) * y_dot[..., :1]
        return np.asarray(c_dot @ self._inverse.T)

    def points(self, z: ArrayLike) -> FloatArray:
        """Return y with coordinates z, (…, N): y_0 by Newton, then a linear system."""
        c = np.asarray(z, dtype=float) @ self.scale.T
        if self.stretch is None:
            return np.asarray(c)
        aim = np.abs(c[..., 0])
        low, high = np.zeros_like(aim), np.full_like(aim, self.pole)
        q = np.minimum(aim, 0.5 * self.pole)
        with np.errstate(all="ignore"):
            for _ in range(22):  # Newton's steps, or bisection where they leave the bracket
                tau, slope = self._tau(q)
                value, rate = np.ones_like(q), np.zeros_like(q)
                for j, S in enumerate(self.stretch, start=1):
                    value = value + S[0, 0] * tau**j
                    rate = rate + S[0, 0] * j * tau ** (j - 1) * slope
                error = q * value - aim
                low, high = np.where(error <= 0, q, low), np.where(error >= 0, q, high)
                step = q - error / (value + q * rate)
                q = np.where((step >= low) & (step <= high), step, 0.5 * (low + high))
        total = self.stretched(np.minimum(q, np.nextafter(self.pole, 0)) * np.sign(c[..., 0]))[0]
        return np.asarray(np.linalg.solve(total, c[..., None])[..., 0])

    def __call__(self, y: ArrayLike) -> FloatArray:
        """Return V at the points y, (…, N); inf where |y_0| ≥ L."""
        points = np.asarray(y, dtype=float)
        outside = np.abs(points[..., 0]) >= self.pole
        z = self.coordinates(np.where(outside[..., None], 0.0, points))
        values = self.monomials(z) @ self.coefficients
        return np.asarray(np.where(outside, np.inf, values))

    def monomials(self, z: FloatArray) -> FloatArray:
        """Return Π z_i^e_ki, (…, N) to (…, K)."""
        out = np.ones((*z.shape[:-1], len(self.exponents)))
        for i, column in enumerate(self.exponents.T):
            powers = [np.ones(z.shape[:-1])]
            for _ in range(int(column.max())):
                powers.append(powers[-1] * z[..., i])
            out *= np.stack(powers, axis=-1)[..., column]
        return out

    def times(self, factor: float) -> LyapunovFunction:
        """Return the function whose set is the smaller {V ≤ 1/factor} (for factor > 1)."""
        return self.replaced(self.coefficients * factor)

    def replaced(
        self, coefficients: FloatArray, exponents: NDArray[np.int64] | None = None
    ) -> LyapunovFunction:
        """Return another polynomial in the same coordinates."""
        e = self.exponents if exponents is None else exponents
        return LyapunovFunction(self.scale, e, coefficients, self.stretch, self.pole)

    @cached_property
    def guard(self) -> LyapunovFunction | None:
        """A quadratic in the same coordinates whose set holds {V ≤ 1} with room, by rays.

        Of some sizes the one on whose surface V is greatest at its least; None where V does
        not reach 1 on some ray.  The checker decides whether V > 1 on that surface.
        """
        size = len(self.scale)
        rays = directions(np.random.default_rng(0), 20000, size)
        radius = first_crossing(self, rays)
        if not np.isfinite(radius).all():
            return None
        edge = rays * radius[:, None]
        root = np.linalg.cholesky(edge.T @ edge / len(edge))
        root = root * np.linalg.norm(np.linalg.solve(root, edge.T), axis=0).max()
        guards = [
            LyapunovFunction.quadratic(self.scale @ (room * root), self.stretch, self.pole)
            for room in (1.03, 1.06, 1.1, 1.15, 1.2)
        ]
        least = [float(self(g.points(rays)).min()) for g in guards]
        return guards[int(np.argmax(least))]


def directions(rng: np.random.Generator, count: int, size: int) -> FloatArray:
    """Return random unit vectors, (count, size)."""
    return unit(rng.normal(size=(count, size)))


def unit(z: FloatArray) -> FloatArray:
    """Return the rows, each over its length."""
    return np.asarray(z / np.linalg.norm(z, axis=1, keepdims=True))


def first_crossing(V: LyapunovFunction, rays: FloatArray, level: float = 1.0) -> FloatArray:
    """Return the first r > 0 with V = level at z = r·ray, inf where there is none.

    Along a ray V is a polynomial in r²: a scan in 4 % steps finds the crossing (a narrower
    double crossing is missed, which a search can bear), and bisection refines it.
    """
    totals = V.exponents.sum(axis=1)
    powers = V.monomials(rays)
    parts = {
        int(d): powers[:, totals == d] @ V.coefficients[totals == d] for d in np.unique(totals)
    }

    def value(r: FloatArray) -> FloatArray:
        square = r * r
        total = np.zeros(np.broadcast_shapes(r.shape, (len(rays),)))
        for d in range(max(parts), 0, -2):  # Horner's scheme
            if d in parts:
                total += parts[d]
            total *= square
        return total

    size = 1.0 / np.sqrt(max(1e-300, float(np.median(np.abs(parts[2]))) if 2 in parts else 1.0))
    grid = size * np.sqrt(level) * np.geomspace(0.02, 80.0, 193)
    above = value(grid[:, None]) >= level
    first = above.argmax(axis=0)
    high = np.where(above.any(axis=0), grid[first], np.inf)
    low = np.where(first > 0, grid[np.maximum(first - 1, 0)], 0.0)
    finite = np.isfinite(high)
    upper, lower = np.where(finite, high, 1.0), np.where(finite, low, 0.0)
    for _ in range(26):
        middle = 0.5 * (lower + upper)
        up = value(middle) >= level
        upper, lower = np.where(up, middle, upper), np.where(up, lower, middle)
    return np.where(finite, upper, np.inf)


def extent(V: LyapunovFunction, direction: ArrayLike) -> float:
    """Return the first r > 0 with V(r·direction) ≥ 1, in float64 (y, not z); inf if none."""
    way = np.asarray(direction, dtype=float)
    base = float(np.linalg.norm(V.coordinates(1e-6 * way)) * 1e6)
    grid = np.geomspace(1e-3, 200.0, 6000) / base
    if way[0] and np.isfinite(V.pole):
        grid = np.append(grid[grid < V.pole / abs(way[0])], V.pole / abs(way[0]))
    above = V(grid[:, None] * way) >= 1.0
    if not above.any():
        return float("inf")
    first = int(above.argmax())
    low, high = (grid[first - 1] if first else 0.0), grid[first]
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if V(middle * way) >= 1.0 else (middle, high)
    return float(low)
