"""From measurements to states: the face that all estimators share, and those without a model."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from undertow.base import InvalidInputError, checked, one_for_each, positive
from undertow.models import FloatArray, Mechanism
from undertow.plants import Bench, Measurement
from undertow.plants.interface import copy_numbers
from undertow.symbolic import numba

if TYPE_CHECKING:
    from undertow.estimators.belief import Belief, ParameterEstimate


#: The longest time between two measurements that an estimator bridges, s.
LONGEST_GAP = 1.0


class Estimator(ABC):
    """What turns measurements into states, one sample after another; all that a run asks of it.

    One of your own derives from this class and defines :meth:`reset` and :meth:`estimate`; the rest
    is as for states that are exact and a model that is known, until it says otherwise.

    Parameters
    ----------
    mechanism
        Whose coordinates they are.
    period
        Usual time between samples, s.

    Attributes
    ----------
    disturbance
        Estimated matched disturbance, (m,), in the inputs' units: what a controller may take
        off its output; zeros where none is estimated.  The next call writes it over.
    felt
        Its size, averaged over the last second, (m,); written over.
    belief
        What is not known of the mechanism's parameters and is estimated with the state; ``None``:
        they are exact.
    parameters
        Values of all parameters of the mechanism that it goes by, (P,), SI units; written over.

    Examples
    --------
    >>> import undertow as ut
    >>> class AtRest(Estimator):
    ...     def reset(self, x0):
    ...         self.x = np.array(x0, dtype=float)
    ...     def estimate(self, measurement, u):
    ...         return np.concatenate([measurement.q, np.zeros(self.mechanism.n)])
    >>> AtRest(ut.mechanisms.rotary_pendulum()).steady_covariance().any()
    np.False_
    """

    belief: Belief | None = None

    @checked
    def __init__(self, mechanism: Mechanism, period: float = 0.001) -> None:
        positive("period of an estimator", period)
        self.mechanism, self.period = mechanism, float(period)
        self._q: FloatArray = np.zeros(mechanism.n)
        self._u: FloatArray = np.zeros(mechanism.m)
        self._t = math.nan
        self.disturbance: FloatArray = np.zeros(mechanism.m)
        self.felt: FloatArray = np.zeros(mechanism.m)
        self.parameters: FloatArray = mechanism.parameter_values.copy()

    @property
    def jumps(self) -> int:
        """How often velocities have been knocked: what was planned is for another motion."""
        return 0

    @property
    def learnt(self) -> ParameterEstimate | None:
        """What is known by now of the uncertain parameters; ``None`` without a belief."""
        return None

    def steady_covariance(self) -> FloatArray:
        """Return what it does not know of the state, at rest at the target, (2n, 2n)."""
        return np.zeros((2 * self.mechanism.n, 2 * self.mechanism.n))

    def noise_covariance(self) -> FloatArray:
        """Return what the sensors' noise alone makes of the estimate at the target, (2n, 2n)."""
        return np.zeros((2 * self.mechanism.n, 2 * self.mechanism.n))

    @abstractmethod
    def reset(self, x0: ArrayLike) -> None:
        """Start again from the state x0, (2n,)."""

    @abstractmethod
    def estimate(self, measurement: Measurement, u: FloatArray) -> FloatArray:
        """Return the state x = (q, q̇), (2n,), after a measurement.

        Parameters
        ----------
        measurement
            The newest one.  Where a position is no finite number the estimate goes on without it.
            Of its time the difference from the last one counts; where that is negative, or more
            than ``LONGEST_GAP``, a period: :meth:`reset` is for another motion.
        u
            The inputs written last, (m,).

        Returns
        -------
        numpy.ndarray
            The estimator's own array: the next call writes it over.

        Raises
        ------
        InvalidInputError
            For another number of positions than the mechanism's, or of inputs where they are used.
        """

    def _elapsed(self, t: float) -> float:
        """Return the time since the last measurement, s; one period where that makes no sense."""
        h = t - self._t
        self._t = t
        return h if 0.0 < h <= max(LONGEST_GAP, self.period) else self.period

    def _positions(self, measurement: Measurement) -> FloatArray:
        """Return the measured positions, (n,), as compiled code takes them."""
        copy_numbers(measurement.q, self._q, "measured q")
        return self._q


#: What makes the estimator of a belief for a bench.
MakeEstimator: TypeAlias = Callable[[Mechanism, Bench], Estimator]


class Measured(Estimator):
    """No estimator at all: for rigs that measure velocities too.

    ``longest_gap``: how long a velocity may be missing while its position comes, s.

    Raises
    ------
    InvalidInputError
        At the first measurement without velocities, and when one is missing for longer.
    """

    @checked
    def __init__(
        self, mechanism: Mechanism, period: float = 0.001, longest_gap: float = 0.02
    ) -> None:
        super().__init__(mechanism, period)
        positive("longest gap of measured velocities, s", longest_gap, zero=True, infinite=True)
        self._x, self._v = np.zeros(2 * mechanism.n), np.zeros(mechanism.n)
        self._missed, self._longest = [0] * mechanism.n, longest_gap

    def reset(self, x0: ArrayLike) -> None:
        """Start again from the state x0, (2n,)."""
        self._x[:] = self.mechanism.check_state(x0)
        self._missed = [0] * self.mechanism.n

    def estimate(self, measurement: Measurement, u: FloatArray) -> FloatArray:
        """Return the measured state; what is no finite number keeps its last value."""
        if measurement.v is None:
            raise InvalidInputError(
                "measurement",
                value="positions only",
                limit="positions and velocities",
                remedy="Use undertow.estimators.KalmanFilter",
            )
        q, n = self._positions(measurement), self.mechanism.n
        copy_numbers(measurement.v, self._v, "measured v")
        for i in range(n):
            for place, value in ((i, q[i]), (n + i, self._v[i])):
                if math.isfinite(value):
                    self._x[place] = value
            if math.isfinite(self._v[i]):
                self._missed[i] = 0
            elif math.isfinite(q[i]):
                self._missed[i] += 1
                if self._missed[i] * self.period > self._longest + 1e-9:
                    raise InvalidInputError(
                        f"measured {self.mechanism.state_names[n + i]}",
                        value=f"no number for {self._missed[i] * self.period:g} s",
                        limit=f"one in {self._longest:g} s",
                        remedy="Look at its sensor, or use undertow.estimators.KalmanFilter",
                    )
        return self._x


@numba.njit(cache=True, nogil=True)
def _filtered(x: FloatArray, last: FloatArray, q: FloatArray, h: float, rest: FloatArray) -> None:
    """Tustin's form of s/(τ s + 1), coordinate by coordinate."""
    n = q.shape[0]
    for i in range(n):
        if abs(q[i]) < math.inf:
            x[i] = q[i]
            tau = rest[i]
            v = x[n + i]
            x[n + i] = ((2.0 * tau - h) * v + 2.0 * (q[i] - last[i])) / (2.0 * tau + h)
            last[i] = q[i]
        else:
            x[i] += h * x[n + i]
            last[i] = x[i]


@numba.njit(cache=True, nogil=True)
def _twisted(x: FloatArray, q: FloatArray, h: float, bound: FloatArray) -> None:
    """Implicit Euler step of Levant's differentiator, λ₀ = 1.1, λ₁ = 1.5."""
    n = q.shape[0]
    for i in range(n):
        ahead = x[i] + h * x[n + i]
        if not abs(q[i]) < math.inf:
            x[i] = ahead
            continue
        error = ahead - q[i]
        step = 1.1 * h * h * bound[i]
        if abs(error) <= step:
            x[i] = q[i]
            x[n + i] -= error / h
            continue
        slope = 1.5 * h * math.sqrt(bound[i])
        root = 0.5 * (math.sqrt(slope * slope + 4.0 * (abs(error) - step)) - slope)
        side = 1.0 if error > 0.0 else -1.0
        x[i] = q[i] + side * root * root
        x[n + i] -= side * step / h


class _Differentiator(Estimator):
    """What both share: a state, and the time of the last measurement."""

    def __init__(self, mechanism: Mechanism, period: float) -> None:
        super().__init__(mechanism, period)
        self._x = np.zeros(2 * mechanism.n)

    def reset(self, x0: ArrayLike) -> None:
        """Start again from the state x0, (2n,)."""
        self._x[:] = self.mechanism.check_state(x0)
        self._t = math.nan


class FilteredDerivative(_Differentiator):
    """Differences behind a first-order filter, s/(τ s + 1).

    Parameters
    ----------
    mechanism
        Whose coordinates they are.
    period
        Usual time between samples, s.
    time_constant
        τ, s, one or one per coordinate: a longer one is quieter and later.
    """

    @checked
    def __init__(
        self, mechanism: Mechanism, period: float = 0.001, time_constant: ArrayLike = 0.01
    ) -> None:
        super().__init__(mechanism, period)
        self._rest = one_for_each("time_constant of a derivative", time_constant, mechanism.n)
        self._last = np.zeros(mechanism.n)

    def reset(self, x0: ArrayLike) -> None:
        """Start again from the state x0, (2n,)."""
        super().reset(x0)
        self._last[:] = self._x[: self.mechanism.n]

    def estimate(self, measurement: Measurement, u: FloatArray) -> FloatArray:
        """Return (q measured, q̇ filtered); the inputs are not used."""
        h = self._elapsed(measurement.t)
        _filtered(self._x, self._last, self._positions(measurement), h, self._rest)
        return self._x


class SuperTwisting(_Differentiator):
    """Levant's robust exact differentiator, ẑ̇₀ = z₁ − λ₁ √(L|e|) sign e, ż₁ = −λ₀ L sign e.

    Exact after a finite time for noiseless positions whose acceleration stays below L
    (Levant, *Automatica* 34(3), 1998).  Discretised by the implicit Euler method, which does
    not chatter (Mojallizadeh, Brogliato, Acary, *Int. J. Robust Nonlinear Control* 31(17),
    2021): the step has a closed form.

    Parameters
    ----------
    mechanism
        Whose coordinates they are.
    period
        Usual time between samples, s.
    acceleration
        L, rad/s² or m/s², one or one per coordinate: a larger one follows faster and lets
        more noise through.
    """

    @checked
    def __init__(
        self, mechanism: Mechanism, period: float = 0.001, acceleration: ArrayLike = 200.0
    ) -> None:
        super().__init__(mechanism, period)
        self._bound = one_for_each("acceleration of a differentiator", acceleration, mechanism.n)

    def estimate(self, measurement: Measurement, u: FloatArray) -> FloatArray:
        """Return the differentiator's (z₀, z₁); the inputs are not used."""
        _twisted(self._x, self._positions(measurement), self._elapsed(measurement.t), self._bound)
        return self._x
