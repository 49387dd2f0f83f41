"""The arithmetic of the fast loop that is the same for every mechanism, compiled."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from undertow.codegen.machine import numba
from undertow.mechanism import FloatArray

IntArray = NDArray[np.int64]

__all__ = ["apart", "confine", "farthest", "off_by", "settle", "sound"]


@numba.njit(cache=True, error_model="numpy")
def confine(wanted: FloatArray, u: FloatArray, limits: FloatArray, slew: FloatArray) -> None:
    """Bring u, (m,), towards ``wanted`` within limits and within ``slew`` of where it was.

    Whatever is no number counts as zero.
    """
    for i in range(u.shape[0]):
        aim = wanted[i] if math.isfinite(wanted[i]) else 0.0
        aim = max(u[i] - slew[i], min(u[i] + slew[i], aim))
        u[i] = max(-limits[i], min(limits[i], aim)) + 0.0  # no −0: a log does not keep its sign


@numba.njit(cache=True, error_model="numpy")
def off_by(x: FloatArray, expected: FloatArray) -> float:
    """Return the largest |x_i − e_i| / (1 + |e_i|); infinite where that is no number."""
    worst = 0.0
    for i in range(x.shape[0]):
        part = abs(x[i] - expected[i]) / (1.0 + abs(expected[i]))
        if not part <= worst:
            worst = part if part < math.inf else math.inf
    return worst


@numba.njit(cache=True, error_model="numpy")
def sound(numbers: FloatArray) -> bool:
    """Whether all numbers, (S, …), are finite, and so is their sum."""
    size = 0.0
    for value in numbers.flat:
        size += abs(value)
    return size < math.inf


@numba.njit(cache=True, error_model="numpy")
def settle(estimate: FloatArray, turn: FloatArray, x: FloatArray, home: FloatArray) -> bool:
    """Copy a finite estimate into x, and less ``turn`` into ``home``; whether it was finite."""
    size = 0.0
    for i in range(x.shape[0]):
        size += abs(estimate[i])
    if not size < math.inf:
        return False
    for i in range(x.shape[0]):
        x[i] = estimate[i]
        home[i] = estimate[i] - turn[i]
    return True


@numba.njit(cache=True, error_model="numpy")
def apart(x: FloatArray, some: IntArray) -> tuple[float, float]:
    """Return the norms of some entries of x, and of all of them."""
    part = whole = 0.0
    for value in x:
        whole += value * value
    for i in some:
        part += x[i] * x[i]
    return math.sqrt(part), math.sqrt(whole)


@numba.njit(cache=True, error_model="numpy")
def farthest(x: FloatArray, some: IntArray) -> float:
    """Return the largest |x_i| of some entries, 0 of none."""
    worst = 0.0
    for i in some:
        worst = max(worst, abs(x[i]))
    return worst
