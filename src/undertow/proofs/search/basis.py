"""What the searches for Lyapunov functions share: monomials, rays, the slowest rate."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from undertow.base.errors import UnstableSurfaceError
from undertow.models.mechanism import FloatArray
from undertow.proofs.region.lyapunov import LyapunovFunction
from undertow.proofs.region.motion import SurfaceMotion

#: Candidate sets keep det f / det f(0) above this, and |y_0| below this part of the pole.
CLEARANCE, POLE_PART = 0.01, 0.985

#: A set reaches far enough with this, m or rad: the region of a linear motion has no end.
FARTHEST = 100.0


class Basis:
    """Monomials of z and their rates along the motion."""

    def __init__(self, motion: SurfaceMotion, chart: LyapunovFunction, degree: int) -> None:
        """Take the coordinates of ``chart``."""
        self.motion, self.chart = motion, chart
        self.size = motion.size
        self.exponents = even_exponents(self.size, degree)

    def _table(self, z: FloatArray) -> FloatArray:
        top = int(self.exponents.max())
        return np.array([z**k for k in range(top + 1)])  # (power, B, N)

    def values(self, z: FloatArray) -> FloatArray:
        """Return the monomials, (B, N) to (B, K)."""
        table = self._table(z)
        out = np.ones((len(z), len(self.exponents)))
        for j in range(self.size):
            out *= table[self.exponents[:, j], :, j].T
        return out

    def flow(self, z: FloatArray) -> FloatArray:
        """Return ż, (B, N)."""
        y = self.chart.points(z)
        return self.chart.coordinate_rates(y, self.motion(y))

    def rates(self, z: FloatArray, z_dot: FloatArray) -> FloatArray:
        """Return the time derivatives of the monomials, (B, K)."""
        table = self._table(z)
        out = np.zeros((len(z), len(self.exponents)))
        for j in range(self.size):
            lowered = self.exponents.copy()
            lowered[:, j] = np.maximum(lowered[:, j] - 1, 0)
            term = self.exponents[:, j] * z_dot[:, j : j + 1]
            for k in range(self.size):
                term = term * table[lowered[:, k], :, k].T
            out += term
        return out

    def function(self, coefficients: FloatArray) -> LyapunovFunction:
        """Return the polynomial with these coefficients."""
        return self.chart.replaced(coefficients, self.exponents)


def even_exponents(size: int, degree: int) -> NDArray[np.int64]:
    """Return those of all monomials of even degree, up to one, without the constant, (K, N)."""
    return np.array(
        [
            e
            for total in range(2, degree + 1, 2)
            for e in itertools.product(range(total, -1, -1), repeat=size)
            if sum(e) == total
        ]
    )


def linear_part(motion: SurfaceMotion, chart: LyapunovFunction) -> FloatArray:
    """Return the linearisation in z, (N, N)."""
    return np.asarray(np.linalg.solve(chart.scale, motion.jacobian @ chart.scale))


def slowest_rate(motion: SurfaceMotion) -> float:
    """Return the slowest decay of the linearisation, 1/s.

    Raises UnstableSurfaceError where it does not decay.
    """
    rate = float(-np.linalg.eigvals(motion.jacobian).real.max())
    if not rate > 0:
        raise UnstableSurfaceError(
            f"region of attraction of {motion.surface}",
            value=f"slowest rate {rate:.4g} 1/s",
            limit="> 0",
            remedy="Start from undertow.first_surface(mechanism)",
        )
    return rate
