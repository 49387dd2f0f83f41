"""Scalar interval arithmetic for numba kernels: pairs (low, high), outward-rounded.

IEEE 754 ``+ - * /`` and ``sqrt`` err by half a unit in the last place; every endpoint is moved
outward by one to two.  ``sin``, ``cos``, ``exp`` and ``log`` are Taylor sums, padded by more
than their truncation and rounding.  Whatever is undefined or not finite becomes [−∞, ∞].

numba's cache of the kernels that use this does not notice a change here: after an edit, delete
``__pycache__``.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from undertow.symbolic.machine import numba

__all__ = [
    "add",
    "apply",
    "cosine",
    "down",
    "exponential",
    "magnitude",
    "mul",
    "reciprocal",
    "sine",
    "up",
]

# No fast-math anywhere: the bounds rest on IEEE arithmetic.

_STEP = 2.0**-52
_TINY = 2.3e-308
_INF = math.inf
#: See :mod:`undertow.proofs.intervals.batch`: sixteen Taylor terms on |x| ≤ π err by less.
_TRIG_PAD = 2e-13
_SIN = np.array([(-1) ** k / math.factorial(2 * k + 1) for k in range(16)])
_COS = np.array([(-1) ** k / math.factorial(2 * k) for k in range(17)])
#: Twenty terms on |x| ≤ ½: truncation < 1e-24.
_EXP = np.array([1.0 / math.factorial(k) for k in range(20)])
_LOG = np.array([2.0 / (2 * k + 1) for k in range(13)])

_njit: Any = numba.njit(cache=True, nogil=True, error_model="numpy")


@_njit
def down(v):  # type: ignore[no-untyped-def]
    """Move an endpoint outward."""
    return v - (abs(v) * _STEP + _TINY)


@_njit
def up(v):  # type: ignore[no-untyped-def]
    """Move an endpoint outward."""
    return v + (abs(v) * _STEP + _TINY)


@_njit
def whole(low, high):  # type: ignore[no-untyped-def]
    """Return the interval, or the line where an endpoint is no finite number."""
    if low - low == 0.0 and high - high == 0.0 and low <= high:
        return low, high
    return -_INF, _INF


@_njit
def add(a, b, c, d):  # type: ignore[no-untyped-def]
    """[a, b] + [c, d]."""
    if a == 0.0 and b == 0.0:
        return c, d
    if c == 0.0 and d == 0.0:
        return a, b
    return whole(down(a + c), up(b + d))


@_njit
def mul(a, b, c, d):  # type: ignore[no-untyped-def]
    """[a, b] × [c, d]; an exact zero stays one, whatever it meets."""
    if (a == 0.0 and b == 0.0) or (c == 0.0 and d == 0.0):
        return 0.0, 0.0
    p, q, r, s = a * c, a * d, b * c, b * d
    if not (p - p == 0.0 and q - q == 0.0 and r - r == 0.0 and s - s == 0.0):
        return -_INF, _INF
    return whole(down(min(p, q, r, s)), up(max(p, q, r, s)))


@_njit
def reciprocal(a, b):  # type: ignore[no-untyped-def]
    """1/[a, b]; the line where zero is inside."""
    if not (a > 0.0 or b < 0.0):
        return -_INF, _INF
    return whole(down(1.0 / b), up(1.0 / a))


@_njit
def power(a, b, k):  # type: ignore[no-untyped-def]
    """[a, b]ᵏ for a whole k ≥ 1."""
    if not (a - a == 0.0 and b - b == 0.0):
        return -_INF, _INF
    big, small = max(abs(a), abs(b)), min(abs(a), abs(b))
    if a <= 0.0 <= b:
        small = 0.0
    up_big, down_small, up_small, down_big = big, small, small, big
    for _ in range(k - 1):
        up_big, up_small = up(up_big * big), up(up_small * small)
        down_small = max(down(down_small * small), 0.0)
        down_big = max(down(down_big * big), 0.0)
    if k % 2 == 0:
        return whole(down_small, up_big)
    if a >= 0.0:
        return whole(down_small, up_big)
    if b <= 0.0:
        return whole(-up_big, -down_small)
    # 0 inside: each end from its own magnitude.
    low, high = -a, b
    for _ in range(k - 1):
        low, high = up(low * -a), up(high * b)
    return whole(-low, high)


@_njit
def _horner(c, t):  # type: ignore[no-untyped-def]
    total = c[-1]
    for k in range(len(c) - 2, -1, -1):
        total = total * t + c[k]
    return total


@_njit
def sine(a, b):  # type: ignore[no-untyped-def]
    """Return sin [a, b]; [−1, 1] where the interval leaves [−π, π]."""
    if not (a >= -math.pi and b <= math.pi):
        return -1.0, 1.0
    p, q = a * _horner(_SIN, a * a), b * _horner(_SIN, b * b)
    low, high = min(p, q) - _TRIG_PAD, max(p, q) + _TRIG_PAD
    half, slack = 0.5 * math.pi, 1e-15
    if a <= half + slack and b >= half - slack:
        high = 1.0
    if a <= -half + slack and b >= -half - slack:
        low = -1.0
    return max(low, -1.0), min(high, 1.0)


@_njit
def cosine(a, b):  # type: ignore[no-untyped-def]
    """Return cos [a, b]; [−1, 1] where the interval leaves [−π, π]."""
    if not (a >= -math.pi and b <= math.pi):
        return -1.0, 1.0
    p, q = _horner(_COS, a * a), _horner(_COS, b * b)
    low, high = min(p, q) - _TRIG_PAD, max(p, q) + _TRIG_PAD
    if a <= 1e-15 and b >= -1e-15:
        high = 1.0
    return max(low, -1.0), min(high, 1.0)


@_njit
def _exp_end(x, sign):  # type: ignore[no-untyped-def]
    """e^x rounded down (sign −1) or up (+1): argument halved ten times, result squared."""
    small = x / 1024.0  # exact
    value = _horner(_EXP, small)
    value *= 1.0 + sign * 1e-14
    for _ in range(10):
        value = down(value * value) if sign < 0 else up(value * value)
    return value


@_njit
def exponential(a, b):  # type: ignore[no-untyped-def]
    """Return e^[a, b] for |·| ≤ 512; beyond, what is known without computing."""
    if not (a >= -512.0 and b <= 512.0):
        return (0.0, 2.5e222) if b <= 512.0 else (-_INF, _INF)
    return whole(max(_exp_end(a, -1.0), 0.0), _exp_end(b, 1.0))


@_njit
def logarithm(a, b):  # type: ignore[no-untyped-def]
    """Return log [a, b]; the line where the interval reaches zero."""
    if not (a > 1e-300 and b < 1e300):
        return -_INF, _INF
    low, high = 0.0, 0.0
    for end in range(2):
        mantissa, exponent = math.frexp(a if end == 0 else b)
        if mantissa < math.sqrt(0.5):
            mantissa, exponent = 2.0 * mantissa, exponent - 1
        r = (mantissa - 1.0) / (mantissa + 1.0)
        value = r * _horner(_LOG, r * r) + exponent * math.log(2.0)
        pad = (abs(value) + 1.0) * 1e-14
        if end == 0:
            low = value - pad
        else:
            high = value + pad
    return whole(low, high)


@_njit
def tangent_h(a, b):  # type: ignore[no-untyped-def]
    """Return tanh [a, b] = 1 − 2/(e^2x + 1), which grows."""
    low, high = exponential(2.0 * a, 2.0 * b)
    if high - high != 0.0:
        high = 1e300
    p, q = reciprocal(*add(max(low, 0.0), high, 1.0, 1.0))
    p, q = add(1.0, 1.0, -2.0 * q, -2.0 * p)
    return max(p, -1.0), min(q, 1.0)


@_njit
def root(a, b):  # type: ignore[no-untyped-def]
    """√[a, b]; the line where the interval reaches below zero."""
    if not a >= 0.0:
        return -_INF, _INF
    return whole(max(down(math.sqrt(a)), 0.0), up(math.sqrt(b)))


@_njit
def magnitude(a, b):  # type: ignore[no-untyped-def]
    """|[a, b]|."""
    if a >= 0.0:
        return a, b
    if b <= 0.0:
        return -b, -a
    return 0.0, max(-a, b)


#: Operations of interval programs, and those that take two intervals.
ADD, MUL, NEG, RECIPROCAL, POWER, SQRT, SIN, COS, EXP, LOG, TANH, ABS, MAX, MIN = range(14)
BINARY = (ADD, MUL, MAX, MIN)


@_njit
def apply(op, a, b, c, d, k):  # type: ignore[no-untyped-def]
    """Apply an operation to [a, b], and to [c, d] or the power k where it takes one."""
    if op == ADD:
        return add(a, b, c, d)
    if op == MUL:
        return mul(a, b, c, d)
    if op == NEG:
        return -b, -a
    if op == RECIPROCAL:
        return reciprocal(a, b)
    if op == POWER:
        return power(a, b, k)
    if op == SQRT:
        return root(a, b)
    if op == SIN:
        return sine(a, b)
    if op == COS:
        return cosine(a, b)
    if op == EXP:
        return exponential(a, b)
    if op == LOG:
        return logarithm(a, b)
    if op == TANH:
        return tangent_h(a, b)
    if op == ABS:
        return magnitude(a, b)
    if op == MAX:
        return max(a, c), max(b, d)
    return min(a, c), min(b, d)
