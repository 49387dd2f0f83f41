"""An extended Kalman filter on the mechanism's own model, compiled for it.

The mean moves by a Runge-Kutta step of the model; the covariance by the step's Jacobian,
``I + hA + ½h²A²`` with A from differences of the compiled dynamics; positions come in one
by one, so that nothing is inverted and a missing one is left out.  Optionally a matched
disturbance d, in the units of the inputs, is estimated with the state as a random walk:
a disturbance observer, whose estimate the controller can take off its output.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from undertow.base import InvalidInputError
from undertow.estimators.interface import positive
from undertow.models import FloatArray, Mechanism, require_smooth
from undertow.plants import Measurement
from undertow.plants.stepping import compiled_module
from undertow.symbolic import BRIEF, COMPILED, Workspace, numba, unpacked


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
        column[:size] = P[:, i]
        for k in range(size):
            x[k] += column[k] * (error / spread)
            for j in range(size):
                P[k, j] -= column[k] * column[j] / spread


#: What the filter remembers: ``size`` numbers are estimated, inputs act ``lead`` periods late.
_LAYOUT = {
    "x": "size", "out": "size", "noise": "size", "variance": "n", "limits": "m",
    "parameters": "p", "count": "1", "past": "lead + 1, m", "P": "size, size",
    "F": "size, size", "A": "size, size", "work": "6, size",
}  # fmt: skip

_BODY = f"""
{COMPILED}
def move(h, x, u, n, m, parameters, stage, total, qdd, viscous, driven):
    # Runge-Kutta's step of the mean; x may end with the estimated disturbance.
    for i in range(m):
        driven[i] = u[i] + (x[2 * n + i] if x.shape[0] > 2 * n else 0.0)
    rk4_step(0.0, h, 0.0, n, x, driven, viscous, parameters, stage, total, qdd)


{COMPILED}
def jacobian(h, x, u, n, m, parameters, F, A, qdd, base, viscous, driven):
    # I + hA + h²A²/2, A by differences of the accelerations.
    size = x.shape[0]
    for i in range(m):
        driven[i] = u[i] + (x[2 * n + i] if size > 2 * n else 0.0)
    forward(0.0, x, driven, viscous, parameters, base)
    A[:] = 0.0
    for i in range(n):
        A[i, n + i] = 1.0
    for j in range(size):
        small = 1e-6
        if j < 2 * n:
            kept = x[j]
            x[j] = kept + small
            forward(0.0, x, driven, viscous, parameters, qdd)
            x[j] = kept
        else:
            kept = driven[j - 2 * n]
            driven[j - 2 * n] = kept + small
            forward(0.0, x, driven, viscous, parameters, qdd)
            driven[j - 2 * n] = kept
        for i in range(n):
            A[n + i, j] = (qdd[i] - base[i]) / small
    for i in range(size):
        for j in range(size):
            total = 0.0
            for k in range(2 * n):
                total += A[i, k] * A[k, j]
            F[i, j] = (1.0 if i == j else 0.0) + h * A[i, j] + 0.5 * h * h * total


{BRIEF}
def estimate(h, q, u, block, size, lead):
{unpacked(_LAYOUT)}
    start = int(count[0])
    stage, total, qdd, base, viscous, driven = (
        work[0], work[1], work[2], work[3], work[4], work[5]
    )
    for i in range(m):
        past[start % (lead + 1), i] = max(-limits[i], min(limits[i], u[i]))
    then = past[(start + 1) % (lead + 1)]
    jacobian(h, x, then, n, m, parameters, F, A, qdd, base, viscous, driven)
    move(h, x, then, n, m, parameters, stage, total, qdd, viscous, driven)
    predict_covariance(F, P, A, noise, h)
    measurement_update(x, P, q, variance, total)
    count[0] = start + 1.0
    out[:] = x
    for k in range(lead):
        then = past[(start + 2 + k) % (lead + 1)]
        move(h, out, then, n, m, parameters, stage, total, qdd, viscous, driven)
"""


@lru_cache(maxsize=64)
def _module(mechanism: Mechanism) -> Any:
    parts = "from undertow.estimators.kalman import predict_covariance, measurement_update\n"
    return compiled_module(mechanism, "kalman", "Kalman filter", _BODY, parts)


class KalmanFilter:
    """Extended Kalman filter on the mechanism's own model, positions measured only.

    Parameters
    ----------
    mechanism
        The controller's belief.
    period
        Usual time between samples, s.
    position_noise
        Standard deviation of a position, rad or m, one or one per coordinate; an encoder of
        resolution r has r/√12.
    acceleration_noise
        Density of what the model does not know of the accelerations, rad/s²/√Hz or
        m/s²/√Hz, one or one per coordinate.
    disturbance_drift
        Density of the drift of a matched disturbance, in units of the input per √s; 0:
        no disturbance is estimated.
    delay
        Known delay of measurement and input together, s, rounded to periods: the estimate is
        for the moment when the answer to it acts.

    Attributes
    ----------
    disturbance
        The estimated matched disturbance, in units of the inputs, (m,); written over.

    Raises
    ------
    InvalidInputError
        For noises that are not positive.
    ModelError
        For a model that is not smooth: the covariance moves by its derivatives.

    Examples
    --------
    >>> import undertow as ut
    >>> rig = ut.mechanisms.rotary_pendulum()
    >>> KalmanFilter(rig, position_noise=4e-4).disturbance.tolist()
    [0.0]
    """

    def __init__(
        self,
        mechanism: Mechanism,
        period: float = 0.001,
        *,
        position_noise: ArrayLike = 5e-4,
        acceleration_noise: ArrayLike = 0.5,
        disturbance_drift: float = 0.0,
        delay: float = 0.0,
    ) -> None:
        require_smooth(
            f"a Kalman filter's model, M or f of '{mechanism.name}',",
            [*mechanism.force, *mechanism.mass_matrix],
            mechanism.x,
        )
        n, m = mechanism.n, mechanism.m
        if not (0 <= disturbance_drift < math.inf and 0 <= delay < math.inf):
            raise InvalidInputError(
                "disturbance_drift and delay of a Kalman filter",
                value=(disturbance_drift, delay),
                limit="finite and ≥ 0",
                remedy="0 turns either off",
            )
        self._arguments: dict[str, Any] = {
            "mechanism": mechanism, "period": period, "position_noise": position_noise,
            "acceleration_noise": acceleration_noise, "disturbance_drift": disturbance_drift,
            "delay": delay,
        }  # fmt: skip
        self.mechanism = mechanism
        self.period = float(positive("period of an estimator", [period], 1)[0])
        size = 2 * n + (m if disturbance_drift > 0 else 0)
        self._size, self._lead = size, round(delay / period)
        memory = Workspace(
            _LAYOUT, n=n, m=m, p=len(mechanism.parameters), size=size, lead=self._lead
        )
        self._block, self._count, self._past = memory.block, memory["count"], memory["past"]
        self._x, self._out = memory["x"], memory["out"]
        self._P: FloatArray = memory["P"]
        self._variance = memory["variance"]
        self._variance[:] = positive("position_noise", position_noise, n) ** 2
        memory["noise"][n : 2 * n] = positive("acceleration_noise", acceleration_noise, n) ** 2
        memory["noise"][2 * n :] = disturbance_drift**2
        memory["limits"][:] = self._limits = mechanism.input_limits
        memory["parameters"][:] = mechanism.parameter_values
        self._state: FloatArray = self._out[: 2 * n]
        self.disturbance = self._x[2 * n :] if size > 2 * n else np.zeros(m)
        self._estimate = _module(mechanism).estimate
        self.reset(np.zeros(2 * n))

    def reset(self, x0: ArrayLike, spread: float = 1.0) -> None:
        """Start again from the state x0, (2n,), at rest as far as is known.

        ``spread`` is the standard deviation of the velocities, rad/s or m/s; that of the
        positions is a measurement's, and the disturbance may be a tenth of its limit.
        """
        n = self.mechanism.n
        self._x[:] = 0.0
        self._x[: 2 * n] = x0
        self._P[:] = 0.0
        variances = np.zeros(len(self._x))
        variances[:n], variances[n : 2 * n] = self._variance, spread**2
        if len(self._x) > 2 * n:
            variances[2 * n :] = np.minimum(0.1 * self._limits, 1.0) ** 2
        np.fill_diagonal(self._P, variances)
        self._past[:], self._count[0], self._t = 0.0, 0, math.nan
        self._out[:] = self._x

    def estimate(self, measurement: Measurement, u: FloatArray) -> FloatArray:
        """Return the state after a measurement, (2n,); see :class:`Estimator`."""
        h = measurement.t - self._t
        self._t = measurement.t
        if not 0.0 < h < 100.0 * self.period:
            h = self.period
        self._estimate(h, measurement.q, u, self._block, self._size, self._lead)
        return self._state

    def steady_covariance(self, seconds: float = 0.5) -> FloatArray:
        """Return the covariance that a filter like this one comes to, at rest at the target.

        It is the filter's own, after so long, s.
        """
        double = KalmanFilter(**self._arguments)
        n, m = self.mechanism.n, self.mechanism.m
        double.reset(np.zeros(2 * n))
        for k in range(round(seconds / self.period)):
            double.estimate(Measurement(k * self.period, np.zeros(n)), np.zeros(m))
        return double.covariance

    @property
    def covariance(self) -> FloatArray:
        """Covariance of the state (and of the disturbance) at the measurement."""
        return self._P.copy()
