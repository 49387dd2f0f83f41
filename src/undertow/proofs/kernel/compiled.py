"""All compiled code of the kernel: interval arithmetic, the interpreter of graphs, Taylor steps.

**One convention.**  An interval is two doubles, low ≤ high, that hold every value on the box;
an end may be infinite, which means unbounded.  It is kept as one complex number, low + i·high, for
NumPy and numba pass that around as one value; none of its arithmetic is a complex number's.
NaN, NaN: the expression may be undefined somewhere on the box.  NaN is handed on by every operation
and no comparison with it is true, so it never proves anything.  IEEE 754 ``+ − × ÷ √`` err by half
a unit in the last place (or 2⁻¹⁰⁷⁵ where they underflow); every end is then moved outward by one to
two.  sin, cos, exp and log of a double are Taylor sums *in this very arithmetic*, their remainders
among the coefficients: nothing is assumed of a library's functions.

All of it is in one file because numba's cache of a function sees a change of the file that the
function is in, and not of what it calls: so no stale code is ever loaded.
"""

from __future__ import annotations

import math
from fractions import Fraction
from functools import partial
from typing import Any

import numba
import numpy as np

#: Operations of code; those that take two operands; SIN and COS name each other as the second.
ADD, SUB, MUL, DIV, MAX, MIN, NEG, SQR, SQRT, SIN, COS, EXP, LOG, ABS = range(14)

_STEP, _TINY, _MOST = 2.0**-52, 2.3e-308, 1.7976931348623157e308
_INF, _UNDEFINED = math.inf, complex(math.nan, math.nan)

#: No fast-math anywhere, and no functions for callers in C.
_njit: Any = partial(numba.njit, cache=True, nogil=True, error_model="numpy", no_cfunc_wrapper=True)


def _neighbours(value: Fraction) -> tuple[float, float]:
    """Return the double that a rational is, twice, or its two neighbours."""
    try:
        near = value.numerator / value.denominator
    except OverflowError:
        return (_MOST, _INF) if value > 0 else (-_INF, -_MOST)
    if Fraction(near) == value:
        return near, near
    below = near if Fraction(near) < value else math.nextafter(near, -_INF)
    return below, math.nextafter(below, _INF)


def hull(low: Fraction, high: Fraction | None = None) -> complex:
    """Return doubles around [low, high], or around one number: the number itself, if it is one."""
    return complex(_neighbours(low)[0], _neighbours(low if high is None else high)[1])


def hulls(values: Any) -> Any:
    """Return doubles around an array of rational numbers."""
    given = np.array(values, dtype=object)
    return np.array([hull(v) for v in given.flat], dtype=complex).reshape(given.shape)


def ends(boxes: Any) -> Any:
    """Return the ends, (N, 2), of doubles around intervals of rational numbers, N pairs."""
    around = [hull(low, high) for low, high in boxes]
    return np.array([(x.real, x.imag) for x in around]).reshape(-1, 2)


def between(low: Any, high: Any) -> Any:
    """Return the array of intervals with these ends."""
    out = np.empty(np.shape(low), dtype=complex)
    out.real, out.imag = low, high
    return out


_F = Fraction
_FACTORIAL = [math.factorial(k) for k in range(20)]
#: The last coefficient of each holds the remainder, for the ranges that arguments are reduced to.
_SIN = np.array([*(hull(_F((-1) ** k, _FACTORIAL[2 * k + 1])) for k in range(9)),
                 hull(_F(-1, _FACTORIAL[19]), _F(1, _FACTORIAL[19]))])  # fmt: skip
_COS = np.array([*(hull(_F((-1) ** k, _FACTORIAL[2 * k])) for k in range(9)),
                 hull(_F(-1, _FACTORIAL[18]), _F(1, _FACTORIAL[18]))])  # fmt: skip
_EXP = np.array([*(hull(_F(1, _FACTORIAL[k])) for k in range(14)),
                 hull(_F(2, 3 * _FACTORIAL[14]), _F(3, 2 * _FACTORIAL[14]))])  # fmt: skip
_LOG = np.array([*(hull(_F(1, 2 * k + 1)) for k in range(11)), hull(_F(0), _F(1, 22))])
#: π/2, π and log 2 to 40 digits: the next digits are not all nines.
_HALF_PI = hull(_F("1.5707963267948966192313216916397514420985"))
PI = hull(_F("3.1415926535897932384626433832795028841971"))
_LN2 = hull(_F("0.6931471805599453094172321214581765680755"))
#: π/2 minus its lower double, so that arguments are reduced without losing digits.
_HALF_PI_REST = hull(_F("1.5707963267948966192313216916397514420985") - _F(_HALF_PI.real))


@_njit
def down(v):  # type: ignore[no-untyped-def]
    """Move a lower end outward; a sum that overflowed upward is at least the largest double."""
    w = v - (abs(v) * _STEP + _TINY)
    return w if w == w else (_MOST if v > 0.0 else v)


@_njit
def up(v):  # type: ignore[no-untyped-def]
    """Move an upper end outward."""
    return -down(-v)


@_njit
def point(v):  # type: ignore[no-untyped-def]
    """A double."""
    return complex(v, v)


@_njit
def middle(x):  # type: ignore[no-untyped-def]
    """A double near the middle."""
    return 0.5 * (x.real + x.imag)


@_njit
def magnitude(x):  # type: ignore[no-untyped-def]
    """The largest |x|."""
    return max(abs(x.real), abs(x.imag))


@_njit
def neg(x):  # type: ignore[no-untyped-def]
    """Return −x."""
    return complex(-x.imag, -x.real)


@_njit
def add(x, y):  # type: ignore[no-untyped-def]
    """Return x + y."""
    if x == 0.0:
        return y
    if y == 0.0:
        return x
    return complex(down(x.real + y.real), up(x.imag + y.imag))


@_njit
def _real(v):  # type: ignore[no-untyped-def]
    """A product of ends: 0 × unbounded is 0, for values are real."""
    return v if v == v else 0.0


@_njit
def mul(x, y):  # type: ignore[no-untyped-def]
    """Return x · y; 0 × unbounded is 0, but 0 × undefined is not."""
    a, b, c, d = x.real, x.imag, y.real, y.imag
    if a != a or c != c:
        return _UNDEFINED
    if x == 0.0 or y == 0.0:
        return complex(0.0, 0.0)
    p, q, r, s = _real(a * c), _real(a * d), _real(b * c), _real(b * d)
    return complex(down(min(p, q, r, s)), up(max(p, q, r, s)))


@_njit
def reciprocal(x):  # type: ignore[no-untyped-def]
    """1/x; undefined where zero is inside."""
    if not (x.real > 0.0 or x.imag < 0.0):
        return _UNDEFINED
    return complex(down(1.0 / x.imag), up(1.0 / x.real))


@_njit
def div(x, y):  # type: ignore[no-untyped-def]
    """Return x / y."""
    if not (y.real > 0.0 or y.imag < 0.0) or x != x:
        return _UNDEFINED
    if x == 0.0:
        return complex(0.0, 0.0)
    if y.real == y.imag and math.isfinite(y.real) and math.isfinite(magnitude(x)):
        p, q = x.real / y.real, x.imag / y.real
        return complex(down(min(p, q)), up(max(p, q)))
    return mul(x, reciprocal(y))


@_njit
def sqr(x):  # type: ignore[no-untyped-def]
    """Return x²."""
    if x != x:
        return _UNDEFINED
    small, big = min(abs(x.real), abs(x.imag)), magnitude(x)
    if x.real <= 0.0 <= x.imag:
        return complex(0.0, up(big * big) if big > 0.0 else 0.0)
    return complex(max(down(small * small), 0.0), up(big * big))


@_njit
def _horner(table, x):  # type: ignore[no-untyped-def]
    """Σ c_k xᵏ by Horner's scheme."""
    out = table[-1]
    for k in range(len(table) - 2, -1, -1):
        out = add(mul(out, x), table[k])
    return out


@_njit
def _turn(x, quarter):  # type: ignore[no-untyped-def]
    """Enclose sin(x + quarter·π/2) at a double.

    x = k π/2 + r: any k will do, for r is enclosed; with |r| ≤ 0.9 the tables' remainders hold.
    """
    if not abs(x) <= 1e6:
        return complex(-1.0, 1.0)
    k, r = np.rint(x / _HALF_PI.real), point(x)
    if k != 0.0:
        r = add(r, mul(point(-k), _HALF_PI))
        r = add(r, mul(point(-k), _HALF_PI_REST))
    if not (r.real >= -0.9 and r.imag <= 0.9):
        return complex(-1.0, 1.0)
    turn = (int(k) + quarter) % 4
    out = _horner(_SIN if turn % 2 == 0 else _COS, sqr(r))
    if turn % 2 == 0:
        out = mul(out, r)
    if turn >= 2:
        out = neg(out)
    return complex(max(out.real, -1.0), min(out.imag, 1.0))


@_njit
def _wave(x, quarter):  # type: ignore[no-untyped-def]
    """Sin of x + quarter·π/2: its ends, and every crest (j even) and trough (j odd) inside.

    They are at x = π/2 + jπ − quarter·π/2; the j that may be inside are counted outward.
    """
    if x != x:
        return _UNDEFINED
    if not (x.real >= -1e6 and x.imag <= 1e6 and x.imag - x.real < 6.0):
        return complex(-1.0, 1.0)
    first, last = _turn(x.real, quarter), _turn(x.imag, quarter)
    low, high = min(first.real, last.real), max(first.imag, last.imag)
    turns, shift = div(x, PI), 0.5 * (quarter - 1)
    for j in range(math.ceil(down(turns.real + shift)), math.floor(up(turns.imag + shift)) + 1):
        if j % 2 == 0:
            high = 1.0
        else:
            low = -1.0
    return complex(low, high)


@_njit
def _exp_end(x):  # type: ignore[no-untyped-def]
    """Enclose e^x at a double: x = k log 2 + r, |r| ≤ 0.36."""
    if x > 709.0:
        return complex(8.2e307, _INF)
    if x < -700.0:
        return complex(0.0, 1e-300)
    k = np.rint(x / _LN2.real)
    out = _horner(_EXP, add(point(x), mul(point(-k), _LN2)))
    scale = math.ldexp(1.0, int(k) // 2)
    rest = math.ldexp(1.0, int(k) - int(k) // 2)
    return complex(out.real * scale * rest, out.imag * scale * rest)  # exact, within the range


@_njit
def _log_end(x):  # type: ignore[no-untyped-def]
    """Enclose log x at a positive double: x = 2ᵉ m, log m = 2 Σ r^(2k+1)/(2k+1)."""
    if x == _INF:
        return complex(709.0, _INF)
    m, e = math.frexp(x)
    if m < 0.7071:
        m, e = 2.0 * m, e - 1
    r = div(add(point(m), point(-1.0)), add(point(m), point(1.0)))  # |r| ≤ 0.1716, r² ≤ 0.0295
    out = mul(_horner(_LOG, sqr(r)), r + r)  # the sum is exact
    return add(out, mul(point(float(e)), _LN2))


@_njit
def apply(op, x, y):  # type: ignore[no-untyped-def]
    """Apply an operation to x, and to y where it takes two."""
    if x != x or (op < NEG and y != y):
        return _UNDEFINED
    if op == ADD:
        return add(x, y)
    if op == SUB:
        return add(x, neg(y))
    if op == MUL:
        return mul(x, y)
    if op == DIV:
        return div(x, y)
    if op == MAX:
        return complex(max(x.real, y.real), max(x.imag, y.imag))
    if op == MIN:
        return complex(min(x.real, y.real), min(x.imag, y.imag))
    if op == NEG:
        return neg(x)
    if op == SQR:
        return sqr(x)
    if op in (SQRT, LOG) and not x.real > 0.0:
        return _UNDEFINED
    if op == SQRT:
        return complex(max(down(math.sqrt(x.real)), 0.0), up(math.sqrt(x.imag)))
    if op in (SIN, COS):
        return _wave(x, op - SIN)
    if op == EXP:
        return complex(_exp_end(x.real).real, _exp_end(x.imag).imag)
    if op == LOG:
        return complex(_log_end(x.real).real, _log_end(x.imag).imag)
    if x.real >= 0.0:  # ABS
        return x
    return neg(x) if x.imag <= 0.0 else complex(0.0, magnitude(x))


# -- the interpreter ------------------------------------------------------------------------------

# A jet of a register is (order + 1, 1 + V): Taylor coefficients in time, each with its value and
# its derivatives by the V variables.


@_njit
def _gain(J, r, k, x, i, y, h, scale):  # type: ignore[no-untyped-def]
    """J[r, k] += scale · J[x, i] · J[y, h], derivatives too; scale is exact."""
    for j in range(J.shape[2]):
        part = mul(J[x, i, 0], J[y, h, j])
        if j > 0:
            part = add(part, mul(J[x, i, j], J[y, h, 0]))
        if scale != 1.0:
            part = mul(part, point(scale))
        J[r, k, j] = add(J[r, k, j], part)


@_njit
def _over(J, r, k, y, scale):  # type: ignore[no-untyped-def]
    """J[r, k] ← J[r, k] / (scale · J[y, 0]), derivatives too: (out' − w y')/y with w = out/y."""
    below = mul(J[y, 0, 0], point(scale))
    for j in range(J.shape[2]):
        part = J[r, k, j]
        if j > 0:
            part = add(part, neg(mul(mul(J[y, 0, j], point(scale)), J[r, k, 0])))
        J[r, k, j] = div(part, below)


@_njit
def _scaled(J, r, k, factor):  # type: ignore[no-untyped-def]
    """J[r, k] ← J[r, k] · factor."""
    for j in range(J.shape[2]):
        J[r, k, j] = mul(J[r, k, j], factor)


@_njit
def _switch(J, op, r, k, a, b):  # type: ignore[no-untyped-def]
    """|x|, max(x, y), min(x, y): the side that is sure on the whole box, by its values.

    |x| is max(x, −x).  Where no side is sure, value and derivatives hold both (Clarke), and so
    does the first coefficient in time, which a motion through the corner has almost everywhere.
    """
    u = J[a, 0, 0]
    v = neg(u) if op == ABS else J[b, 0, 0]
    first, second = u.real >= v.imag, v.real >= u.imag
    if op == MIN:
        first, second = second, first
    for j in range(J.shape[2]):
        x = J[a, k, j]
        y = neg(x) if op == ABS else J[b, k, j]
        if first:
            out = x
        elif second:
            out = y
        elif k > 1 or (k == 1 and j > 0) or x != x or y != y:
            out = _UNDEFINED
        elif j == 0 and k == 0:
            out = apply(op, x, y)
        else:
            out = complex(min(x.real, y.real), max(x.imag, y.imag))
        J[r, k, j] = out


@_njit
def _slope(op, x, w):  # type: ignore[no-untyped-def]
    """The derivative of a function over x, where it is w."""
    if op == EXP:
        return w
    if op in (SQRT, LOG):
        return reciprocal(w + w if op == SQRT else x)  # the sum is exact
    out = _wave(x, COS - op)
    return neg(out) if op == COS else out


@_njit
def _line(J, op, r, k, a, b):  # type: ignore[no-untyped-def]
    """Coefficient k of register r = op(a, b), from those of a and b up to k, of r up to k − 1.

    The recurrences are Moore's: of w = u/v, w v = u; of w = √u, w² = u; of w = e^u, w' = u' w; of
    w = log u, w' u = u'; and sin' = u' cos, cos' = −u' sin, where b is the partner.  Each is a sum
    of products, times 1/k or plus u_k, over a first coefficient.
    """
    V = J.shape[2]
    if op in (ADD, SUB, NEG):
        for j in range(V):
            x, y = J[a, k, j], J[b, k, j]
            J[r, k, j] = neg(x) if op == NEG else add(x, y if op == ADD else neg(y))
        return
    if op in (MAX, MIN, ABS):
        _switch(J, op, r, k, a, b)
        return
    if k == 0 and op in (SQRT, SIN, COS, EXP, LOG):
        u = J[a, 0, 0]
        J[r, 0, 0] = apply(op, u, u)
        if V > 1:
            slope = _slope(op, u, J[r, 0, 0])
            for j in range(1, V):
                J[r, 0, j] = mul(J[a, 0, j], slope)
        return
    # Σ weight · left_i · right_(k−i) for first ≤ i ≤ last
    left, right, first, last = r, r, 1, k - 1
    if op in (MUL, SQR):
        left, right, first, last = a, b if op == MUL else a, 0, k
    elif op == DIV:
        left, right, first = r, b, 0
    elif op == LOG:
        left, right = r, a
    elif op != SQRT:  # EXP, SIN, COS
        left, right, last = a, r if op == EXP else b, k
    for j in range(V):
        J[r, k, j] = J[a, k, j] if op in (DIV, SQRT) else complex(0.0, 0.0)
    for i in range(first, last + 1):
        scale = 1.0
        if op in (DIV, SQRT):
            scale = -1.0
        elif op == SQR:  # symmetric: half of it, twice
            scale = 2.0 if 2 * i < k else 1.0
            if 2 * i > k:
                break
        elif op in (LOG, COS):
            scale = -float(i)
        elif op in (SIN, EXP):
            scale = float(i)
        _gain(J, r, k, left, i, right, k - i, scale)
    if op == SQR and k == 0:
        J[r, k, 0] = sqr(J[a, 0, 0])
    if op in (LOG, SIN, COS, EXP):
        _scaled(J, r, k, reciprocal(point(float(k))))
    if op == LOG:
        for j in range(V):
            J[r, k, j] = add(J[r, k, j], J[a, k, j])
    if op in (DIV, SQRT, LOG):
        _over(J, r, k, b if op == DIV else r if op == SQRT else a, 2.0 if op == SQRT else 1.0)


@_njit
def jets(code, constants, box, rates, order, seeds):  # type: ignore[no-untyped-def]
    """Run code over one box: the jets of all registers, (R, order + 1, 1 + V).

    Registers are the inputs, the constants, then one for each line of code.  ``seeds`` (S, V)
    are the derivatives of the first inputs by V variables.  ``rates`` are the registers of ẋ for
    the first inputs x, whose coefficients follow from x' = ẋ; other inputs are constant.
    """
    inputs, first = len(box), len(box) + len(constants)
    J = np.zeros((first + len(code), order + 1, 1 + seeds.shape[1]), np.complex128)
    for i in range(inputs):
        J[i, 0, 0] = box[i]
        for v in range(seeds.shape[1] if i < len(seeds) else 0):
            J[i, 0, 1 + v] = seeds[i, v]
    for i in range(len(constants)):
        J[inputs + i, 0, 0] = constants[i]
    for k in range(order + 1):
        for i in range(len(rates) if k else 0):
            for v in range(J.shape[2]):
                J[i, k, v] = J[rates[i], k - 1, v]
            _scaled(J, i, k, reciprocal(point(float(k))))
        for line in range(len(code)):
            _line(J, code[line, 0], first + line, k, code[line, 1], code[line, 2])
    return J


# -- mean values ----------------------------------------------------------------------------------


@_njit
def along(whole, centre, C, xi):  # type: ignore[no-untyped-def]
    """Values at m + C ξ, by their intervals and their mean values, both of which hold: (O,).

    ``whole`` are values and derivatives over a box that holds them, (O, 1 + N), ``centre``
    values at m, (O,).
    """
    slopes = product(np.ascontiguousarray(whole[:, 1:]), points(C))
    out = sums(centre, product(slopes, xi)[:, 0])
    for o, x in enumerate(whole[:, 0]):
        y = out[o]
        out[o] = complex(max(x.real, y.real), min(x.imag, y.imag)) if x == x and y == y else x
    return out


def mean_values(whole: Any, centre: Any, box: Any, m: Any) -> Any:
    """Values over a box (N,), m inside, as :func:`along` has them, (O,)."""
    return along(whole, centre, np.eye(len(m)), sums(box, points(-m))[:, None])


# -- interval matrices ----------------------------------------------------------------------------


@_njit
def product(A, B):  # type: ignore[no-untyped-def]
    """Product of interval matrices (I, K) and (K, J)."""
    out = np.zeros((A.shape[0], B.shape[1]), np.complex128)
    for i in range(A.shape[0]):
        for j in range(B.shape[1]):
            for k in range(A.shape[1]):
                out[i, j] = add(out[i, j], mul(A[i, k], B[k, j]))
    return out


@_njit
def points(A):  # type: ignore[no-untyped-def]
    """An array of doubles as intervals."""
    return A * complex(1.0, 1.0)


@_njit
def sums(A, B):  # type: ignore[no-untyped-def]
    """A + B, arrays of one shape."""
    out = np.empty(A.shape, np.complex128)
    for at, x in np.ndenumerate(A):
        out[at] = add(x, B[at])
    return out


@_njit
def multiples(A, y):  # type: ignore[no-untyped-def]
    """A · y, an array and one interval."""
    out = np.empty(A.shape, np.complex128)
    for at, x in np.ndenumerate(A):
        out[at] = mul(x, y)
    return out


@_njit
def inverse(A):  # type: ignore[no-untyped-def]
    """Enclose the inverse of every matrix in A (N, N); NaN where that is not shown.

    With a double R near the inverse of the middle and E = R A − I, ‖E‖ ≤ e < 1 (Frobenius),
    A⁻¹ = (I + E)⁻¹ R, and (I + E)⁻¹ − I is at most e/(1 − e) in each entry.
    """
    near, none, one = middle(A), np.full(A.shape, _UNDEFINED), np.eye(len(A))
    if not np.isfinite(near).all() or np.linalg.det(near) == 0.0:
        return none
    R = points(np.linalg.inv(near))
    e = norm(sums(product(R, A), points(-one)).ravel())
    if not e < 0.5:
        return none
    e = up(e / down(1.0 - e))
    return product(sums(points(one), np.full(A.shape, complex(-e, e))), R)


@_njit
def norm(row):  # type: ignore[no-untyped-def]
    """Upper bound of the Euclidean norm of an interval vector (K,)."""
    total = 0.0
    for x in row:
        total = up(total + up(magnitude(x) * magnitude(x)))
    return up(math.sqrt(total)) if total == total else _INF


@_njit
def extents(rows, radius):  # type: ignore[no-untyped-def]
    """Upper bounds of |row · z| over |z| ≤ radius, (K,), for interval rows (K, N)."""
    out = np.empty(len(rows))
    for i in range(len(rows)):
        out[i] = up(norm(rows[i]) * radius)
    return out


@_njit
def dominance(S):  # type: ignore[no-untyped-def]
    """A lower bound of the dominance of the diagonal of S (N, N): > 0 proves S ≻ 0, S = Sᵀ."""
    least = _INF
    for i in range(len(S)):
        off = 0.0
        for j in range(len(S)):
            if j != i:
                off = up(off + magnitude(S[i, j]))
        room = down(S[i, i].real - off)
        least = min(least, room) if room == room else -_INF
    return least


@_njit
def decrease(A, held):  # type: ignore[no-untyped-def]
    """Dominance of −(A + Aᵀ), or of −(A + Aᵀ + AᵀA) if held: > 0 proves it positive definite.

    A (N, N) is W J W⁻¹ with the derivative J of ẋ, or of x(T) − x(0).
    """
    S = sums(A, A.T)
    if held:
        S = sums(S, product(A.T, A))
    scale = np.ones(len(A))  # of a congruence with a positive diagonal: any will do
    for i in range(len(A)):
        if middle(S[i, i]) < -1e-100:
            scale[i] = 1.0 / math.sqrt(-middle(S[i, i]))
    for (i, j), x in np.ndenumerate(S):
        S[i, j] = mul(mul(neg(x), point(scale[i])), point(scale[j]))
    return dominance(S)


# -- one validated Taylor step --------------------------------------------------------------------


@_njit
def moved(X, rates, h):  # type: ignore[no-untyped-def]
    """X + h · rates, (N,)."""
    return sums(X, multiples(rates, h))


@_njit
def taylor_step(rest, centre, around, h, m, C, xi):  # type: ignore[no-untyped-def]
    """{m + C ξ} after h, Lemma 6: new m and C into theirs; the box (N, 1) that is to be added.

    ``rest`` (N,) is the last coefficient over a box that motions stay in, ``centre`` (N, K)
    the others at m, ``around`` (N, K, 1 + N) the others over the set with their derivatives.
    C (N, L) are doubles, ξ (L, 1) is a box, h an interval.  NaN where nothing is bounded.
    """
    n = len(m)
    end, slopes = rest.copy(), np.zeros((n, n), np.complex128)
    for k in range(centre.shape[1] - 1, -1, -1):  # Horner in h; the remainder comes first
        end = moved(centre[:, k], end, h)
        slopes = moved(around[:, k, 1:], slopes, h)
    if not (np.isfinite(end).all() and np.isfinite(slopes).all()):
        return np.full((n, 1), _UNDEFINED)
    carried = product(slopes, points(C))
    m[:], C[:] = middle(end), middle(carried)
    off = product(sums(carried, points(-C)), xi)
    return sums(sums(end, points(-m)).reshape(n, 1), off)


# -- quadratic Taylor models ----------------------------------------------------------------------

# Over a box x = m + r ε, |ε_i| ≤ 1, a quantity is c + Σ g_i ε_i + Σ_{i≤j} h_ij ε_i ε_j ± e: c, g,
# h and one bound e of all that the polynomial leaves out, higher orders and rounding.
# T[row, lane] is one model: rows c, g, h, e, then |g| and |h|, the sums of magnitudes.  With s =
# |c| + |g| + |h| every coefficient of a product is a sum of few products, whose roundings are
# together below γ s₁s₂, γ some units of 1.2e-16: ROUND s₁s₂ is added to e.  e, a sum of terms ≥ 0,
# is raised by a part GROW above its own rounding, and by LITTLE for underflow.  Overflow and what
# is undefined on a box make e infinite or NaN, which proves nothing.
_ROUND, _GROW, _LITTLE, LANES = 8e-15, 1.0 + 4e-14, 1e-300, 16


@_njit
def _sums(C, V):  # type: ignore[no-untyped-def]
    """|g| and |h|."""
    E = C.shape[0] - 3
    C[E + 1 :] = 0.0
    for k in range(1, E):
        for lane in range(LANES):
            C[E + 1 if k <= V else E + 2, lane] += abs(C[k, lane])


@_njit
def _plus(A, B, sign, C, V):  # type: ignore[no-untyped-def]
    """A ± B."""
    E = C.shape[0] - 3
    for k in range(E):
        for lane in range(LANES):
            C[k, lane] = A[k, lane] + sign * B[k, lane]
    _sums(C, V)
    for lane in range(LANES):
        s = abs(C[0, lane]) + C[E + 1, lane] + C[E + 2, lane]
        C[E, lane] = (A[E, lane] + B[E, lane] + _ROUND * s) * _GROW + _LITTLE


@_njit
def _times(A, B, C, V):  # type: ignore[no-untyped-def]
    """A · B: what is beyond second order is bounded by magnitudes."""
    E = C.shape[0] - 3
    for lane in range(LANES):
        na, ma, ea = A[E + 1, lane], A[E + 2, lane], A[E, lane]
        nb, mb, eb = B[E + 1, lane], B[E + 2, lane], B[E, lane]
        sa, sb = abs(A[0, lane]) + na + ma, abs(B[0, lane]) + nb + mb
        rest = na * mb + ma * nb + ma * mb + ea * (sb + eb) + eb * sa
        C[E, lane] = (rest + _ROUND * (sa * sb)) * _GROW + _LITTLE
        C[0, lane] = A[0, lane] * B[0, lane]
    for k in range(1, E):
        for lane in range(LANES):
            C[k, lane] = A[0, lane] * B[k, lane] + A[k, lane] * B[0, lane]
    k = 1 + V
    for i in range(1, 1 + V):
        for lane in range(LANES):
            C[k, lane] += A[i, lane] * B[i, lane]
        k += 1
        for j in range(i + 1, 1 + V):
            for lane in range(LANES):
                C[k, lane] += A[i, lane] * B[j, lane] + A[j, lane] * B[i, lane]
            k += 1
    _sums(C, V)


@_njit
def _multiple(A, x, C, V):  # type: ignore[no-untyped-def]
    """A · x, a number."""
    E = C.shape[0] - 3
    low, width = x.real, (x.imag - x.real) * _GROW
    for k in range(E):
        for lane in range(LANES):
            C[k, lane] = A[k, lane] * low
    for lane in range(LANES):
        s = abs(A[0, lane]) + A[E + 1, lane] + A[E + 2, lane]
        rest = (abs(low) + width) * A[E, lane] + width * s + _ROUND * (abs(low) * s)
        C[E, lane] = rest * _GROW + _LITTLE
    _sums(C, V)


@_njit
def _composed(op, A, C, V, J):  # type: ignore[no-untyped-def]
    """φ(A), or 1/A for DIV: φ(c) + φ'δ + ½φ''δ², with φ'''/6 over [c − r, c + r] for the rest.

    The derivatives are the Taylor coefficients of φ(c + t), by the recurrences of graphs;
    those of sin and cos are at most 1/6, of 1/x its powers.
    """
    E = C.shape[0] - 3
    f, d = np.empty(4), 0.0
    for lane in range(LANES):
        c, n, m, e = A[0, lane], A[E + 1, lane], A[E + 2, lane], A[E, lane]
        r = (n + m + e) * _GROW
        J[0, 0, 0], J[0, 1, 0], d = point(c), point(1.0), 0.0
        for last in range(2):
            if last:
                J[0, 0, 0] = complex(down(c - r), up(c + r))
            if op == DIV:
                once = reciprocal(J[0, 0, 0])
                square = sqr(once)
                J[2, 0, 0], J[2, 1, 0] = once, neg(square)
                J[2, 2, 0], J[2, 3, 0] = mul(once, square), sqr(square)
            elif last and op in (SIN, COS):
                J[2, 3, 0] = point(1.0 / 6.0 + 1e-16)
            else:
                for k in range(4 if last else 3):
                    for at in range(2, 4 if op in (SIN, COS) else 3):  # those stand together
                        # at - at: of a literal 0 numba would compile a version apart
                        _line(J, op if at == 2 else SIN + COS - op, at, k, at - at, 5 - at)
            for k in range(0 if last else 3):
                f[k] = middle(J[2, k, 0])
                d += J[2, k, 0].imag - J[2, k, 0].real
        f[3] = magnitude(J[2, 3, 0])
        second = 2.0 * n * m + m * m + (2.0 * (n + m) + e) * e
        rest = abs(f[1]) * e + abs(f[2]) * second + f[3] * r * r * r + d * (1.0 + r + r * r)
        near = abs(f[0]) + abs(f[1]) * r + abs(f[2]) * r * r
        C[E, lane] = (rest + _ROUND * near) * _GROW + _LITTLE
        C[0, lane] = f[0]
        for k in range(1, E):
            C[k, lane] = f[1] * A[k, lane]
        k = 1 + V
        for i in range(1, 1 + V):
            for j in range(i, 1 + V):
                C[k, lane] += (1.0 if i == j else 2.0) * f[2] * A[i, lane] * A[j, lane]
                k += 1
    _sums(C, V)


@_njit
def models(code, constants, outputs, low, high):  # type: ignore[no-untyped-def]
    """Models of outputs over boxes (V, B), every input a variable: (B, O, 2 + V + V(V + 1)/2).

    For code of +, −, ·, /, squares, roots, sin, cos, exp and log; of others nothing is known.
    """
    V, boxes = low.shape
    first, E = V + len(constants), 1 + V + V * (V + 1) // 2
    T, J = np.zeros((first + len(code) + 1, E + 3, LANES)), np.zeros((4, 4, 1), np.complex128)
    for i in range(len(constants)):
        T[V + i, 0] = constants[i].real
        T[V + i, E] = (constants[i].imag - constants[i].real) * _GROW + _LITTLE
    out = np.empty((boxes, len(outputs), E + 1))
    for start in range(0, boxes, LANES):
        lanes = np.minimum(np.arange(start, start + LANES), boxes - 1)
        left, right = low[:, lanes], high[:, lanes]
        middle = 0.5 * left + 0.5 * right
        radius = np.maximum(right - middle, middle - left) * _GROW
        for i in range(V):
            T[i, 0], T[i, 1 + i], T[i, E + 1], T[i, E] = middle[i], radius[i], radius[i], _LITTLE
        for line in range(len(code)):
            op, a, b = code[line]
            C = T[first + line]
            if op in (MUL, SQR):
                if op == MUL and V <= a < first:
                    a, b = b, a
                if op == MUL and V <= b < first:
                    _multiple(T[a], constants[b - V], C, V)
                else:
                    _times(T[a], T[b if op == MUL else a], C, V)
            elif op in (ADD, SUB):
                _plus(T[a], T[b], 1.0 if op == ADD else -1.0, C, V)
            elif op == NEG:
                _multiple(T[a], point(-1.0), C, V)
            elif op in (DIV, SQRT, SIN, COS, EXP, LOG):
                _composed(op, T[b if op == DIV else a], T[-1] if op == DIV else C, V, J)
                if op == DIV:
                    _times(T[a], T[-1], C, V)
            else:
                C[:] = math.nan
        for lane in range(min(LANES, boxes - start)):
            for o in range(len(outputs)):
                for k in range(E + 1):
                    out[start + lane, o, k] = T[outputs[o], k, lane]
    return out


@_njit
def ranges(models, V):  # type: ignore[no-untyped-def]
    """Bounds of models (B, O), and how much of them is due to each variable (B, O, V)."""
    boxes, count, _ = models.shape
    out, spread = np.empty((boxes, count), np.complex128), np.zeros((boxes, count, V))
    for box in range(boxes):
        for o in range(count):
            model, due, k = models[box, o], spread[box, o], 1 + V
            total, low, high = abs(model[0]), model[0], model[0]
            for i in range(V):
                g, h = abs(model[1 + i]), model[k]
                total += g + abs(h)
                high += g * (g / (-4.0 * h)) if 2.0 * h < -g else g + h
                low -= g * (g / (4.0 * h)) if 2.0 * h > g else g - h
                due[i] += g + abs(h)
                for j in range(i + 1, V):
                    k += 1
                    cross = abs(model[k])
                    total, high, low = total + cross, high + cross, low - cross
                    due[i] += 0.5 * cross
                    due[j] += 0.5 * cross
                k += 1
            rest = (model[k] + _ROUND * total) * _GROW + _LITTLE
            out[box, o] = complex(low - rest, high + rest)
    return out, spread


@np.errstate(all="ignore")
def excluded(models: Any, V: int) -> Any:
    """Boxes on which f ≥ 0, a ≤ 1 and b ≥ 1 are never true at once; models (B, 3, …) of f, a, b.

    Where they are, f + λ(1 − a) + μ(b − 1) ≥ 0 for all λ, μ ≥ 0, and so is (1 − a) + μ(b − 1).
    The factors that are tried take the slopes out; whatever they are, the bound decides.
    """
    f, a, b = np.moveaxis(models[:, :, 1 : 1 + V], 1, 0)
    fa, fb, aa, ab, bb = ((x * y).sum(axis=1) for x, y in ((f, a), (f, b), (a, a), (a, b), (b, b)))
    gap, one, none = aa * bb - ab * ab + _LITTLE, np.ones(len(f)), np.zeros(len(f))
    out = np.zeros(len(f), dtype=bool)
    for weight, less, more in (  # of f, of 1 − a and of b − 1; the last two are to be ≥ 0
        (one, np.maximum(fa / (aa + _LITTLE), 0.0), none),
        (one, none, np.maximum(-fb / (bb + _LITTLE), 0.0)),
        (one, *np.maximum(((fa * bb - fb * ab) / gap, (fa * ab - fb * aa) / gap), 0.0)),
        (none, one, np.maximum(ab / (bb + _LITTLE), 0.0)),
    ):
        part = np.stack([weight, -less, more], axis=1)[:, :, None] * models
        total, size = part.sum(axis=1), abs(part[:, :, :-1]).sum(axis=(1, 2)) + less + more
        total[:, 0] += less - more
        total[:, -1] = (abs(part[:, :, -1]).sum(axis=1) + _ROUND * size) * _GROW
        out |= ranges(total[:, None], V)[0][:, 0].imag < 0.0
    return out
