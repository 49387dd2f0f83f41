"""A batch of intervals in NumPy float64 with outward-rounded endpoints, for branch and bound.

Why :class:`Interval` is sound
------------------------------
IEEE 754 ``+ - * /`` and ``sqrt`` return the true value rounded to nearest, an error of at
most half a unit in the last place, or 2⁻¹⁰⁷⁵ where they underflow.  Every endpoint ``v`` is
then moved outward by ``|v|·2⁻⁵² + 2.3e-308``: one to two units in the last place, so the
rounding of the move itself (which is monotone) cannot come back past the true value.
``sin``, ``cos`` and ``log`` do not trust the C library: they are Taylor sums whose
truncation and whose a-priori rounding error (Horner's γ₂ₙ·Σ|c_k||t|^k) lie below the pad
that is added.  An operation without a finite answer gives NaN, and no comparison with NaN
is true, so it never proves anything.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator, Sequence
from fractions import Fraction
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from undertow.models.mechanism import FloatArray

_F = TypeVar("_F", bound=Callable[..., Any])

_STEP = 2.0**-52
_TINY = 2.3e-308


class IntervalArithmetic:
    """Constants as :class:`Interval`."""

    def rational(self, value: Fraction) -> Interval:
        """Return a point where the number is a float, else its two neighbours."""
        nearest = value.numerator / value.denominator
        if Fraction(nearest) == value:
            return Interval(nearest, nearest)
        return Interval(math.nextafter(nearest, -math.inf), math.nextafter(nearest, math.inf))

    def pi(self) -> Interval:
        """Return [π⁻, π⁺]: the float below π and the one above."""
        return Interval(math.pi, math.nextafter(math.pi, 4.0))


def _quiet(function: _F) -> _F:
    """Overflow and 0·∞ end as NaN or ∞, which prove nothing: no warning is due."""

    @functools.wraps(function)
    def wrapped(*args: Any) -> Any:
        with np.errstate(all="ignore"):
            return function(*args)

    return cast(_F, wrapped)


def _down(v: FloatArray) -> FloatArray:
    return v - (np.abs(v) * _STEP + _TINY)


def _up(v: FloatArray) -> FloatArray:
    return v + (np.abs(v) * _STEP + _TINY)


class Interval:
    """A batch of closed intervals [lo, hi] with outward-rounded float64 endpoints.

    Parameters
    ----------
    lo, hi
        Endpoints, arrays that broadcast; ``hi`` is ``lo`` where left out.

    Examples
    --------
    >>> x = Interval(-1.0, 2.0)
    >>> bool((x**2).lo == 0), bool(((x**2).hi >= 4) & ((x**2).hi < 4.0001))
    (True, True)
    """

    __slots__ = ("hi", "lo")
    __array_ufunc__ = None

    def __init__(self, lo: ArrayLike, hi: ArrayLike | None = None) -> None:
        self.lo: FloatArray = np.asarray(lo, dtype=np.float64)
        self.hi: FloatArray = self.lo if hi is None else np.asarray(hi, dtype=np.float64)

    def __repr__(self) -> str:
        """Show the endpoints."""
        return f"Interval({self.lo!r}, {self.hi!r})"

    def __getitem__(self, index: Any) -> Interval:
        """Return a part of the batch, indexed like an array."""
        return Interval(self.lo[index], self.hi[index])

    def __iter__(self) -> Iterator[Interval]:
        """Go through the rows, like an array."""
        return (self[i] for i in range(len(self.lo)))

    def __setitem__(self, index: Any, value: Interval) -> None:
        """Write a part of the batch, indexed like an array."""
        self.lo[index], self.hi[index] = value.lo, value.hi

    def reshape(self, *shape: int) -> Interval:
        """Return the batch in another shape, like an array."""
        return Interval(self.lo.reshape(shape), self.hi.reshape(shape))

    @staticmethod
    def of(value: Any) -> Interval:
        """Return an interval for a number: floats and small integers are exact."""
        return value if isinstance(value, Interval) else Interval(float(value))

    @staticmethod
    def zeros(*shape: int) -> Interval:
        """Return points 0 that can be written to."""
        return Interval(np.zeros(shape), np.zeros(shape))

    @staticmethod
    def concatenate(parts: Sequence[Interval], axis: int = 0) -> Interval:
        """Join batches along an axis that they have, like arrays."""
        return Interval(
            np.concatenate([p.lo for p in parts], axis), np.concatenate([p.hi for p in parts], axis)
        )

    @property
    def shape(self) -> tuple[int, ...]:
        """Of the batch, like an array's."""
        return self.lo.shape

    @property
    def middle(self) -> FloatArray:
        """A float in or next to each interval's middle."""
        return 0.5 * (self.lo + self.hi)

    @property
    def magnitude(self) -> FloatArray:
        """Largest absolute value."""
        return np.maximum(np.abs(self.lo), np.abs(self.hi))

    def contains(self, value: float | FloatArray) -> NDArray[np.bool_]:
        """Whether each interval contains the float ``value``."""
        return np.asarray((self.lo <= value) & (value <= self.hi))

    def intersect(self, other: Interval) -> Interval:
        """Return the intersection of two enclosures of the same thing.

        A NaN endpoint of one gives way to the other's.
        """
        return Interval(np.fmax(self.lo, other.lo), np.fmin(self.hi, other.hi))

    def __neg__(self) -> Interval:
        """Exact."""
        return Interval(-self.hi, -self.lo)

    @_quiet
    def __add__(self, other: Any) -> Interval:
        """Sum."""
        if isinstance(other, int | float):
            if other == 0:
                return self
            return Interval(_down(self.lo + other), _up(self.hi + other))
        return Interval(_down(self.lo + other.lo), _up(self.hi + other.hi))

    __radd__ = __add__

    def __sub__(self, other: Any) -> Interval:
        """Difference."""
        return cast(Interval, self + (-other))

    def __rsub__(self, other: Any) -> Interval:
        """Difference."""
        return cast(Interval, -self + other)

    @_quiet
    def __mul__(self, other: Any) -> Interval:
        """Product."""
        if isinstance(other, int | float):
            if other == -1:
                return -self
            a, b = self.lo * other, self.hi * other
            return Interval(_down(np.minimum(a, b)), _up(np.maximum(a, b)))
        if other is self:
            return cast(Interval, self**2)
        a, b = self.lo * other.lo, self.lo * other.hi
        c, d = self.hi * other.lo, self.hi * other.hi
        return Interval(
            _down(np.minimum(np.minimum(a, b), np.minimum(c, d))),
            _up(np.maximum(np.maximum(a, b), np.maximum(c, d))),
        )

    __rmul__ = __mul__

    @_quiet
    def __truediv__(self, other: Any) -> Interval:
        """Quotient; the whole line where the divisor contains zero."""
        return self * (1 / Interval.of(other))

    @_quiet
    def __rtruediv__(self, other: Any) -> Interval:
        """Reciprocal times a number."""
        crosses = ~((self.lo > 0) | (self.hi < 0))
        low = np.where(crosses, -np.inf, _down(1 / self.hi))
        high = np.where(crosses, np.inf, _up(1 / self.lo))
        reciprocal = Interval(low, high)
        return reciprocal if other == 1 else reciprocal * other

    @_quiet
    def __pow__(self, k: int) -> Interval:
        """Integer power k ≥ 1: exact range, even powers are ≥ 0."""
        if k == 1:
            return self
        a, b = np.abs(self.lo), np.abs(self.hi)
        if k % 2 == 0:
            big, small = np.maximum(a, b), np.minimum(a, b)
            small = np.where((self.lo <= 0) & (self.hi >= 0), 0.0, small)
            return Interval(_chain_down(small, k), _chain_up(big, k))
        low = np.where(self.lo < 0, -_chain_up(a, k), _chain_down(a, k))
        high = np.where(self.hi < 0, -_chain_down(b, k), _chain_up(b, k))
        # np.where picks a branch on NaN: put the NaN back.
        bad = np.isnan(self.lo) | np.isnan(self.hi)
        return Interval(np.where(bad, np.nan, low), np.where(bad, np.nan, high))

    @_quiet
    def __abs__(self) -> Interval:
        """Magnitude."""
        a, b = np.abs(self.lo), np.abs(self.hi)
        small = np.where((self.lo <= 0) & (self.hi >= 0), 0.0, np.minimum(a, b))
        return Interval(small, np.maximum(a, b))

    def max(self, other: Any) -> Interval:
        """Larger of the two, point by point."""
        second = Interval.of(other)
        return Interval(np.maximum(self.lo, second.lo), np.maximum(self.hi, second.hi))

    def min(self, other: Any) -> Interval:
        """Smaller of the two, point by point."""
        second = Interval.of(other)
        return Interval(np.minimum(self.lo, second.lo), np.minimum(self.hi, second.hi))

    @_quiet
    def sqrt(self) -> Interval:
        """Square root; NaN where the interval reaches below zero."""
        low, high = np.sqrt(self.lo), np.sqrt(self.hi)
        return Interval(_down(low), np.where(np.isnan(low), np.nan, _up(high)))

    def sin(self) -> Interval:
        """Sine: [−1, 1] where the interval leaves [−π, π]."""
        low, high = _sin_points(self.lo), _sin_points(self.hi)
        return self._turning(low, high, crest=_HALF_PI, trough=-_HALF_PI)

    def cos(self) -> Interval:
        """Cosine: [−1, 1] where the interval leaves [−π, π]."""
        low, high = _cos_points(self.lo), _cos_points(self.hi)
        return self._turning(low, high, crest=0.0, trough=None)

    def _turning(
        self, low: FloatArray, high: FloatArray, crest: float, trough: float | None
    ) -> Interval:
        """Range from the values at both ends, padded, and the extremes between them."""
        bottom, top = np.minimum(low, high) - _TRIG_PAD, np.maximum(low, high) + _TRIG_PAD
        slack = 1e-15  # π/2 is no float: count an extreme that close as inside
        top = np.where((self.lo <= crest + slack) & (self.hi >= crest - slack), 1.0, top)
        if trough is not None:
            inside = (self.lo <= trough + slack) & (self.hi >= trough - slack)
            bottom = np.where(inside, -1.0, bottom)
        wide = (self.lo < -math.pi) | (self.hi > math.pi)
        return Interval(
            np.where(wide, -1.0, np.maximum(bottom, -1.0)),
            np.where(wide, 1.0, np.minimum(top, 1.0)),
        )

    def tan(self) -> Interval:
        """Tangent; the whole line where the cosine reaches zero."""
        return self.sin() / self.cos()

    @_quiet
    def log(self) -> Interval:
        """Natural logarithm; NaN where the interval reaches zero."""
        low, high = _log_points(self.lo), _log_points(self.hi)
        high = np.where(np.isnan(low), np.nan, high)
        return Interval(low - _log_pad(low), high + _log_pad(high))


def _chain_up(v: FloatArray, k: int) -> FloatArray:
    result = v
    for _ in range(k - 1):
        result = _up(result * v)
    return result


def _chain_down(v: FloatArray, k: int) -> FloatArray:
    result = v
    for _ in range(k - 1):
        result = np.maximum(_down(result * v), 0.0)
    return result


_HALF_PI = math.pi / 2

#: Sixteen Taylor terms on |x| ≤ π: truncation ≤ π³³/33! < 1e-19; Horner in t = x² errs by
#: at most γ₅₀·cosh(π) < 50·1.2e-16·11.6 < 7e-14, the rounding of x² and of the
#: coefficients included.
_TRIG_PAD = 2e-13
_SIN = [(-1) ** k / math.factorial(2 * k + 1) for k in range(16)]
_COS = [(-1) ** k / math.factorial(2 * k) for k in range(17)]


@_quiet
def _horner(coefficients: list[float], t: FloatArray) -> FloatArray:
    total = np.full_like(t, coefficients[-1])
    for c in reversed(coefficients[:-1]):
        total = total * t + c
    return total


def _sin_points(x: FloatArray) -> FloatArray:
    return x * _horner(_SIN, np.minimum(x * x, 10.0))


def _cos_points(x: FloatArray) -> FloatArray:
    return _horner(_COS, np.minimum(x * x, 10.0))


#: log m = 2 Σ r^(2k+1)/(2k+1), r = (m−1)/(m+1), |r| ≤ 0.172 for m in [√½, √2].
_LOG = [2.0 / (2 * k + 1) for k in range(13)]


@_quiet
def _log_points(x: FloatArray) -> FloatArray:
    mantissa, exponent = np.frexp(np.where(x > 0, x, np.nan))
    small = mantissa < math.sqrt(0.5)
    mantissa = np.where(small, 2 * mantissa, mantissa)
    exponent = exponent - small
    r = (mantissa - 1) / (mantissa + 1)
    return np.asarray(r * _horner(_LOG, r * r) + exponent * math.log(2))


def _log_pad(value: FloatArray) -> FloatArray:
    """Rounding of a sum of ≤ 30 operations on numbers ≤ |value| + 1, times ten."""
    return (np.abs(value) + 1) * 1e-14


def bisected(a: FloatArray, b: FloatArray, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return ends of the two halves of boxes [a, b], (N, L), cut across where ``weight`` is most.

    The lower halves come first.
    """
    axis, columns = np.argmax(weight, axis=0), np.arange(a.shape[1])
    cut = 0.5 * (a[axis, columns] + b[axis, columns])
    left, right = b.copy(), a.copy()
    left[axis, columns] = cut
    right[axis, columns] = cut
    return np.concatenate([a, right], axis=1), np.concatenate([left, b], axis=1)
