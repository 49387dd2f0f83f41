"""States from measured positions by the model itself: one step of an observer of fixed gain.

Between samples the state moves as the model says under the last output; each measured position
then corrects it.  The gain is that to which the Kalman filter of
:class:`undertow.estimators.KalmanFilter` settles at the target, K = P Hᵀ R⁻¹ (Kalman, *Journal of
Basic Engineering* 82(1), 1960), so nothing is inverted on the target.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import sympy as sp
from numpy.typing import ArrayLike

from undertow.estimators import KalmanFilter
from undertow.estimators.interface import positive
from undertow.export.status import LARGEST
from undertow.models import FloatArray, Mechanism
from undertow.plants import Measurement
from undertow.symbolic import Tape

__all__ = ["KalmanStep", "Observer", "lay_accelerations"]


@dataclass(frozen=True)
class KalmanStep:
    """The observer of fixed gain: a step of the model, corrected by the positions.

    ``x⁻ = (q + T v + ½ T² q̈(x, u), v + T q̈(x, u))``, ``x⁺ = x⁻ + K (q_measured − q⁻)``.

    Parameters
    ----------
    position_noise
        Standard deviation of a position, rad or m, one or one for each coordinate; an encoder
        of resolution r has r/√12.
    acceleration_noise
        Density of what the model does not know of the accelerations, rad/s²/√Hz or m/s²/√Hz,
        one or one for each coordinate.
    """

    position_noise: float | tuple[float, ...] = 4.5e-4
    acceleration_noise: float | tuple[float, ...] = 0.5

    @property
    def description(self) -> str:
        """What it is, in a few words."""
        return "Kalman filter of fixed gain on the model"

    @property
    def meaning(self) -> str:
        """What the gains are."""
        return "state on position, rows of the state"

    def noises(self, n: int) -> tuple[FloatArray, FloatArray]:
        """Return the noises of positions and accelerations, (n,) each; both must be positive."""
        return (
            positive("position_noise", self.position_noise, n),
            positive("acceleration_noise", self.acceleration_noise, n),
        )

    def gains(self, mechanism: Mechanism, period: float) -> FloatArray:
        """Return K, (2n, n), settled at the target."""
        n = mechanism.n
        noise, unknown = self.noises(n)
        filter_ = KalmanFilter(mechanism, period, position_noise=noise, acceleration_noise=unknown)
        return np.asarray(filter_.settled()[: 2 * n, :n] / noise**2)

    def estimator(self, mechanism: Mechanism, period: float) -> Observer:
        """Return the same in Python."""
        return Observer(mechanism, period, self.gains(mechanism, period))


class Observer:
    """What the exported observer must agree with: an :class:`undertow.estimators.Estimator`."""

    def __init__(self, mechanism: Mechanism, period: float, gains: FloatArray) -> None:
        self.mechanism, self.period, self.gains = mechanism, period, gains
        self.disturbance = np.zeros(mechanism.m)
        self._x = np.zeros(2 * mechanism.n)

    def reset(self, x0: ArrayLike) -> None:
        """Start again from the state x0, (2n,)."""
        self._x = np.array(x0, dtype=float)

    def estimate(self, measurement: Measurement, u: FloatArray) -> FloatArray:
        """Return the state after a measurement that is whole, (2n,)."""
        n, T, q = self.mechanism.n, self.period, measurement.q
        rate = self.mechanism.accelerations(0.0, self._x, u)
        v = self._x[n:]
        ahead = np.concatenate([self._x[:n] + T * (v + 0.5 * T * rate), v + T * rate])
        x: FloatArray = ahead + self.gains @ (q - ahead[:n])
        if not (np.abs(x) < LARGEST).all():
            x = np.concatenate([q, np.zeros(n)])
        self._x = x
        return x


def lay_accelerations(mechanism: Mechanism, tape: Tape) -> list[sp.Expr]:
    """Return q̈(x, u), (3)-(4), on a tape."""
    n, m = mechanism.n, mechanism.m
    M = sp.Matrix(n, n, tape.let_all(list(mechanism.mass_matrix)))
    factor = tape.cholesky(sp.Matrix(n, n, lambda i, j: M[min(i, j), max(i, j)]))
    driven = mechanism.input_matrix * sp.Matrix(mechanism.u)
    total = [f + (driven[i] if i < m else 0) for i, f in enumerate(mechanism.force)]
    return list(factor.solve(sp.Matrix(tape.let_all(total))))
