"""From measurements to states: the face that all estimators share."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from undertow.base import InvalidInputError
from undertow.models import FloatArray, Mechanism
from undertow.plants.interface import Measurement

__all__ = ["Estimator", "Measured"]


class Estimator(Protocol):
    """What turns measurements into states, one sample after another.

    Attributes
    ----------
    disturbance
        Estimated matched disturbance, (m,), in the inputs' units: what a controller may take
        off its output; zeros where none is estimated.  The next call writes it over.
    """

    disturbance: FloatArray

    def reset(self, x0: ArrayLike) -> None:
        """Start again from the state x0, (2n,)."""
        ...

    def estimate(self, measurement: Measurement, u: FloatArray) -> FloatArray:
        """Return the state x = (q, q̇), (2n,), after a measurement.

        Parameters
        ----------
        measurement
            The newest one.  Where a position is NaN the estimate goes on without it.
        u
            The inputs written last, (m,).

        Returns
        -------
        numpy.ndarray
            The estimator's own array: the next call writes it over.
        """
        ...


class Measured:
    """No estimator at all: for rigs that measure velocities too.

    Raises
    ------
    InvalidInputError
        At the first measurement without velocities.
    """

    def __init__(self, mechanism: Mechanism) -> None:
        self._x = np.zeros(2 * mechanism.n)
        self.disturbance = np.zeros(mechanism.m)

    def reset(self, x0: ArrayLike) -> None:
        """Start again from the state x0, (2n,)."""
        self._x[:] = x0

    def estimate(self, measurement: Measurement, u: FloatArray) -> FloatArray:
        """Return the measured state; what is NaN keeps its last value."""
        if measurement.v is None:
            raise InvalidInputError(
                "measurement",
                value="positions only",
                limit="positions and velocities",
                remedy="Use undertow.estimators.KalmanFilter",
            )
        n = len(measurement.q)
        for i in range(n):
            for place, value in ((i, measurement.q[i]), (n + i, measurement.v[i])):
                if not np.isnan(value):
                    self._x[place] = value
        return self._x


def positive(what: str, values: ArrayLike, n: int) -> FloatArray:
    """Return one positive number per coordinate, (n,), from one or n of them."""
    array = np.asarray(values, dtype=float)
    if array.shape not in ((), (n,)) or not ((array > 0).all() and np.isfinite(array).all()):
        raise InvalidInputError(
            what,
            value=values,
            limit=f"one number or {n}, finite and > 0",
            remedy="One number serves all coordinates",
        )
    return np.array(np.broadcast_to(array, (n,)))
