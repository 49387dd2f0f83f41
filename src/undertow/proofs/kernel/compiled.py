"""All compiled code of the kernel: interval arithmetic, the interpreter of graphs, Taylor steps.

**One convention.**  An interval is two doubles, low ≤ high, that hold every value on the box;
an end may be infinite, which means unbounded.  NaN, NaN: the expression may be undefined
somewhere on the box.  NaN is handed on by every operation and no comparison with it is true, so
it never proves anything.  IEEE 754 ``+ − × ÷ √`` err by half a unit in the last place (or 2⁻¹⁰⁷⁵
where they underflow); every end is then moved outward by one to two.  sin, cos, exp and log of a
double are Taylor sums *in this very arithmetic*, their remainders among the coefficients: nothing
is assumed of a library's functions.

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

__all__ = ["ABS", "ADD", "BINARY", "COS", "DIV", "EXP", "LOG", "MAX", "MIN", "MUL", "NEG", "PI",
           "SIN", "SQR", "SQRT", "SUB", "add", "along", "apply", "carried", "decrease", "ellipsoid",
           "enclose", "excluded", "hulled", "inverse", "jets", "mean_values", "models", "norm",
           "ranges", "reached", "taylor_step", "up"]  # fmt: skip


#: Operations of code; those that take two operands; SIN and COS name each other as the second.
ADD, SUB, MUL, DIV, MAX, MIN, NEG, SQR, SQRT, SIN, COS, EXP, LOG, ABS = range(14)
BINARY = (ADD, SUB, MUL, DIV, MAX, MIN)

_STEP, _TINY, _MOST = 2.0**-52, 2.3e-308, 1.7976931348623157e308
_NAN, _INF = math.nan, math.inf

#: No fast-math anywhere, and no functions for callers in C.
_njit: Any = partial(numba.njit, cache=True, nogil=True, error_model="numpy", no_cfunc_wrapper=True)


def enclose(value: Fraction) -> tuple[float, float]:
    """Return the double that a rational is, twice, or its two neighbours."""
    try:
        near = value.numerator / value.denominator
    except OverflowError:
        return (_MOST, _INF) if value > 0 else (-_INF, -_MOST)
    if Fraction(near) == value:
        return near, near
    below = near if Fraction(near) < value else math.nextafter(near, -_INF)
    return below, math.nextafter(below, _INF)


def _table(*values: Fraction | tuple[Fraction, Fraction]) -> Any:
    ends = [v if isinstance(v, tuple) else (v, v) for v in values]
    return np.array([(enclose(a)[0], enclose(b)[1]) for a, b in ends])


_F = Fraction
_FACTORIAL = [math.factorial(k) for k in range(20)]
#: The last coefficient of each holds the remainder, for the ranges that arguments are reduced to.
_SIN = _table(*(_F((-1) ** k, _FACTORIAL[2 * k + 1]) for k in range(9)),
              (_F(-1, _FACTORIAL[19]), _F(1, _FACTORIAL[19])))  # fmt: skip
_COS = _table(*(_F((-1) ** k, _FACTORIAL[2 * k]) for k in range(9)),
              (_F(-1, _FACTORIAL[18]), _F(1, _FACTORIAL[18])))  # fmt: skip
_EXP = _table(*(_F(1, _FACTORIAL[k]) for k in range(14)),
              (_F(2, 3 * _FACTORIAL[14]), _F(3, 2 * _FACTORIAL[14])))  # fmt: skip
_LOG = _table(*(_F(1, 2 * k + 1) for k in range(11)), (_F(0), _F(1, 22)))
#: π/2, π and log 2 to 40 digits: the next digits are not all nines.
_HALF_PI = _table(_F("1.5707963267948966192313216916397514420985"))[0]
_PI = _table(_F("3.1415926535897932384626433832795028841971"))[0]
PI = float(_PI[0]), float(_PI[1])
_LN2 = _table(_F("0.6931471805599453094172321214581765680755"))[0]
#: π/2 minus its lower double, so that arguments are reduced without losing digits.
_HALF_PI_REST = _table(_F("1.5707963267948966192313216916397514420985") - _F(_HALF_PI[0]))[0]


@_njit
def down(v):  # type: ignore[no-untyped-def]
    """Move a lower end outward; a sum that overflowed upward is at least the largest double."""
    w = v - (abs(v) * _STEP + _TINY)
    return w if w == w else (_MOST if v > 0.0 else v)


@_njit
def up(v):  # type: ignore[no-untyped-def]
    """Move an upper end outward."""
    w = v + (abs(v) * _STEP + _TINY)
    return w if w == w else (-_MOST if v < 0.0 else v)


@_njit
def add(a, b, c, d):  # type: ignore[no-untyped-def]
    """[a, b] + [c, d]."""
    if a == 0.0 and b == 0.0:
        return c, d
    if c == 0.0 and d == 0.0:
        return a, b
    return down(a + c), up(b + d)


@_njit
def mul(a, b, c, d):  # type: ignore[no-untyped-def]
    """[a, b] × [c, d]; 0 × unbounded is 0, for values are real, but 0 × undefined is not."""
    if a != a or c != c:
        return _NAN, _NAN
    if (a == 0.0 and b == 0.0) or (c == 0.0 and d == 0.0):
        return 0.0, 0.0
    p, q, r, s = a * c, a * d, b * c, b * d
    if p != p:
        p = 0.0
    if q != q:
        q = 0.0
    if r != r:
        r = 0.0
    if s != s:
        s = 0.0
    return down(min(p, q, r, s)), up(max(p, q, r, s))


@_njit
def reciprocal(a, b):  # type: ignore[no-untyped-def]
    """1/[a, b]; undefined where zero is inside."""
    if not (a > 0.0 or b < 0.0):
        return _NAN, _NAN
    return down(1.0 / b), up(1.0 / a)


@_njit
def div(a, b, c, d):  # type: ignore[no-untyped-def]
    """[a, b] / [c, d]."""
    if not (c > 0.0 or d < 0.0) or a != a:
        return _NAN, _NAN
    if a == 0.0 and b == 0.0:
        return 0.0, 0.0
    if c == d and c - c == 0.0 and a - a == 0.0 and b - b == 0.0:
        p, q = a / c, b / c
        return down(min(p, q)), up(max(p, q))
    p, q = reciprocal(c, d)
    return mul(a, b, p, q)


@_njit
def sqr(a, b):  # type: ignore[no-untyped-def]
    """[a, b]²."""
    if a != a:
        return _NAN, _NAN
    small, big = min(abs(a), abs(b)), max(abs(a), abs(b))
    if a <= 0.0 <= b:
        return 0.0, up(big * big) if big > 0.0 else 0.0
    return max(down(small * small), 0.0), up(big * big)


@_njit
def _horner(table, a, b):  # type: ignore[no-untyped-def]
    """Σ c_k [a, b]ᵏ by Horner's scheme, in intervals."""
    low, high = table[-1, 0], table[-1, 1]
    for k in range(len(table) - 2, -1, -1):
        low, high = mul(low, high, a, b)
        low, high = add(low, high, table[k, 0], table[k, 1])
    return low, high


@_njit
def _turn(x, quarter):  # type: ignore[no-untyped-def]
    """Enclose sin(x + quarter·π/2) at a double.

    x = k π/2 + r: any k will do, for r is enclosed; with |r| ≤ 0.9 the tables' remainders hold.
    """
    if not abs(x) <= 1e6:
        return -1.0, 1.0
    k = np.rint(x / _HALF_PI[0])
    a, b = x, x
    if k != 0.0:
        p, q = mul(-k, -k, _HALF_PI[0], _HALF_PI[0])
        a, b = add(a, b, p, q)
        p, q = mul(-k, -k, _HALF_PI_REST[0], _HALF_PI_REST[1])
        a, b = add(a, b, p, q)
    if not (a >= -0.9 and b <= 0.9):
        return -1.0, 1.0
    t0, t1 = sqr(a, b)
    turn = (int(k) + quarter) % 4
    low, high = _horner(_SIN if turn % 2 == 0 else _COS, t0, t1)
    if turn % 2 == 0:
        low, high = mul(low, high, a, b)
    if turn >= 2:
        low, high = -high, -low
    return max(low, -1.0), min(high, 1.0)


@_njit
def _wave(a, b, quarter):  # type: ignore[no-untyped-def]
    """Sin of [a, b] + quarter·π/2: its ends, and every crest (j even) and trough (j odd) inside.

    They are at x = π/2 + jπ − quarter·π/2; the j that may be inside are counted outward.
    """
    if a != a:
        return _NAN, _NAN
    if not (a >= -1e6 and b <= 1e6 and b - a < 6.0):
        return -1.0, 1.0
    low, high = 1.0, -1.0
    for end in (a, b):
        p, q = _turn(end, quarter)
        low, high = min(low, p), max(high, q)
    shift = 0.5 * (quarter - 1)
    p, q = div(a, b, _PI[0], _PI[1])
    first, last = math.ceil(down(p + shift)), math.floor(up(q + shift))
    for j in range(first, last + 1):
        if j % 2 == 0:
            high = 1.0
        else:
            low = -1.0
    return low, high


@_njit
def _exp_end(x):  # type: ignore[no-untyped-def]
    """Enclose e^x at a double: x = k log 2 + r, |r| ≤ 0.36."""
    if x != x:
        return _NAN, _NAN
    if x > 709.0:
        return 8.2e307, _INF
    if x < -700.0:
        return 0.0, 1e-300
    k = np.rint(x / _LN2[0])
    p, q = mul(-k, -k, _LN2[0], _LN2[1])
    a, b = add(x, x, p, q)
    low, high = _horner(_EXP, a, b)
    scale = math.ldexp(1.0, int(k) // 2)
    rest = math.ldexp(1.0, int(k) - int(k) // 2)
    return low * scale * rest, high * scale * rest  # exact: neither under- nor overflows


@_njit
def _log_end(x):  # type: ignore[no-untyped-def]
    """Enclose log x at a positive double: x = 2ᵉ m, log m = 2 Σ r^(2k+1)/(2k+1)."""
    if x == _INF:
        return 709.0, _INF
    mantissa, e = math.frexp(x)
    if mantissa < 0.7071:
        mantissa, e = 2.0 * mantissa, e - 1
    p, q = add(mantissa, mantissa, 1.0, 1.0)
    a, b = add(mantissa, mantissa, -1.0, -1.0)
    a, b = div(a, b, p, q)  # |r| ≤ 0.1716, r² ≤ 0.0295
    t0, t1 = sqr(a, b)
    low, high = _horner(_LOG, t0, t1)
    low, high = mul(low, high, 2.0 * a, 2.0 * b)
    p, q = mul(float(e), float(e), _LN2[0], _LN2[1])
    return add(low, high, p, q)


@_njit
def apply(op, a, b, c, d):  # type: ignore[no-untyped-def]
    """Apply an operation to [a, b], and to [c, d] where it takes two."""
    if a != a or (op < NEG and c != c):
        return _NAN, _NAN
    if op == ADD:
        return add(a, b, c, d)
    if op == SUB:
        return add(a, b, -d, -c)
    if op == MUL:
        return mul(a, b, c, d)
    if op == DIV:
        return div(a, b, c, d)
    if op == MAX:
        return max(a, c), max(b, d)
    if op == MIN:
        return min(a, c), min(b, d)
    if op == NEG:
        return -b, -a
    if op == SQR:
        return sqr(a, b)
    if op == SQRT:
        if not a > 0.0:
            return _NAN, _NAN
        return max(down(math.sqrt(a)), 0.0), up(math.sqrt(b))
    if op in (SIN, COS):
        return _wave(a, b, op - SIN)
    if op == LOG and not a > 0.0:
        return _NAN, _NAN
    if op in (EXP, LOG):
        low, high = _INF, -_INF
        for end in (a, b):
            p, q = _exp_end(end) if op == EXP else _log_end(end)
            low, high = min(low, p), max(high, q)
        return low, high
    if a >= 0.0:  # ABS
        return a, b
    if b <= 0.0:
        return -b, -a
    return 0.0, max(-a, b)


# -- the interpreter ------------------------------------------------------------------------------

# A jet of a register is (order + 1, 1 + V, 2): Taylor coefficients in time, each with its value and
# its derivatives by the V variables.


@_njit
def _gain(J, r, k, x, i, y, h, scale):  # type: ignore[no-untyped-def]
    """J[r, k] += scale · J[x, i] · J[y, h], derivatives too; scale is exact."""
    x0, x1 = J[x, i, 0, 0], J[x, i, 0, 1]
    y0, y1 = J[y, h, 0, 0], J[y, h, 0, 1]
    for j in range(J.shape[2]):
        a, b = mul(x0, x1, J[y, h, j, 0], J[y, h, j, 1])
        if j > 0:
            c, d = mul(J[x, i, j, 0], J[x, i, j, 1], y0, y1)
            a, b = add(a, b, c, d)
        if scale != 1.0:
            a, b = mul(a, b, scale, scale)
        J[r, k, j, 0], J[r, k, j, 1] = add(J[r, k, j, 0], J[r, k, j, 1], a, b)


@_njit
def _over(J, r, k, y, scale):  # type: ignore[no-untyped-def]
    """J[r, k] ← J[r, k] / (scale · J[y, 0]), derivatives too: (out' − w y')/y with w = out/y."""
    c, d = mul(J[y, 0, 0, 0], J[y, 0, 0, 1], scale, scale)
    for j in range(J.shape[2]):
        a, b = J[r, k, j, 0], J[r, k, j, 1]
        if j > 0:
            e, f = mul(J[y, 0, j, 0], J[y, 0, j, 1], scale, scale)
            e, f = mul(e, f, J[r, k, 0, 0], J[r, k, 0, 1])
            a, b = add(a, b, -f, -e)
        J[r, k, j, 0], J[r, k, j, 1] = div(a, b, c, d)


@_njit
def _scaled(J, r, k, c, d):  # type: ignore[no-untyped-def]
    """J[r, k] ← J[r, k] · [c, d]."""
    for j in range(J.shape[2]):
        J[r, k, j, 0], J[r, k, j, 1] = mul(J[r, k, j, 0], J[r, k, j, 1], c, d)


@_njit
def _switch(J, op, r, k, a, b):  # type: ignore[no-untyped-def]
    """|x|, max(x, y), min(x, y): the side that is sure on the whole box, by its values.

    |x| is max(x, −x).  Where no side is sure, value and derivatives hold both (Clarke), and so
    does the first coefficient in time, which a motion through the corner has almost everywhere.
    """
    u0, u1, v0, v1 = J[a, 0, 0, 0], J[a, 0, 0, 1], J[b, 0, 0, 0], J[b, 0, 0, 1]
    if op == ABS:
        v0, v1 = -u1, -u0
    first, second = u0 >= v1, v0 >= u1
    if op == MIN:
        first, second = second, first
    for j in range(J.shape[2]):
        x0, x1, y0, y1 = J[a, k, j, 0], J[a, k, j, 1], J[b, k, j, 0], J[b, k, j, 1]
        if op == ABS:
            y0, y1 = -x1, -x0
        if first:
            p, q = x0, x1
        elif second:
            p, q = y0, y1
        elif k > 1 or (k == 1 and j > 0) or x0 != x0 or y0 != y0:
            p, q = _NAN, _NAN
        elif j == 0 and k == 0:
            p, q = max(x0, y0), max(x1, y1)
            if op == MIN:
                p, q = min(x0, y0), min(x1, y1)
            elif op == ABS:
                p = max(p, 0.0)
        else:
            p, q = min(x0, y0), max(x1, y1)
        J[r, k, j, 0], J[r, k, j, 1] = p, q


@_njit
def _slope(op, a, b, w0, w1):  # type: ignore[no-untyped-def]
    """The derivative of a function over [a, b], where it is [w0, w1]."""
    if op == EXP:
        return w0, w1
    if op in (SQRT, LOG):
        return reciprocal(2.0 * w0, 2.0 * w1) if op == SQRT else reciprocal(a, b)
    c, d = _wave(a, b, COS - op)
    return (-d, -c) if op == COS else (c, d)


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
            p, q = J[a, k, j, 0], J[a, k, j, 1]
            if op == NEG:
                p, q = -q, -p
            elif op == ADD:
                p, q = add(p, q, J[b, k, j, 0], J[b, k, j, 1])
            else:
                p, q = add(p, q, -J[b, k, j, 1], -J[b, k, j, 0])
            J[r, k, j, 0], J[r, k, j, 1] = p, q
        return
    if op in (MAX, MIN, ABS):
        _switch(J, op, r, k, a, b)
        return
    if k == 0 and op in (SQRT, SIN, COS, EXP, LOG):
        u0, u1 = J[a, 0, 0, 0], J[a, 0, 0, 1]
        w0, w1 = apply(op, u0, u1, 0.0, 0.0)
        J[r, 0, 0, 0], J[r, 0, 0, 1] = w0, w1
        if V > 1:
            c, d = _slope(op, u0, u1, w0, w1)
            for j in range(1, V):
                J[r, 0, j, 0], J[r, 0, j, 1] = mul(J[a, 0, j, 0], J[a, 0, j, 1], c, d)
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
        J[r, k, j, 0] = J[a, k, j, 0] if op in (DIV, SQRT) else 0.0
        J[r, k, j, 1] = J[a, k, j, 1] if op in (DIV, SQRT) else 0.0
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
        J[r, k, 0, 0], J[r, k, 0, 1] = sqr(J[a, 0, 0, 0], J[a, 0, 0, 1])
    if op in (LOG, SIN, COS, EXP):
        c, d = reciprocal(float(k), float(k))
        _scaled(J, r, k, c, d)
    if op == LOG:
        for j in range(V):
            p, q = add(J[r, k, j, 0], J[r, k, j, 1], J[a, k, j, 0], J[a, k, j, 1])
            J[r, k, j, 0], J[r, k, j, 1] = p, q
    if op in (DIV, SQRT, LOG):
        _over(J, r, k, b if op == DIV else r if op == SQRT else a, 2.0 if op == SQRT else 1.0)


@_njit
def jets(code, constants, low, high, rates, order, seeds):  # type: ignore[no-untyped-def]
    """Run code over one box: the jets of all registers, (R, order + 1, 1 + V, 2).

    Registers are the inputs, the constants, then one for each line of code.  ``seeds`` (S, V, 2)
    are the derivatives of the first inputs by V variables.  ``rates`` are the registers of ẋ for
    the first inputs x, whose coefficients follow from x' = ẋ; other inputs are constant.
    """
    inputs, first = len(low), len(low) + len(constants)
    J = np.zeros((first + len(code), order + 1, 1 + seeds.shape[1], 2))
    for i in range(inputs):
        J[i, 0, 0, 0], J[i, 0, 0, 1] = low[i], high[i]
        for v in range(seeds.shape[1] if i < len(seeds) else 0):
            J[i, 0, 1 + v, 0], J[i, 0, 1 + v, 1] = seeds[i, v]
    for i in range(len(constants)):
        J[inputs + i, 0, 0, 0], J[inputs + i, 0, 0, 1] = constants[i]
    for k in range(order + 1):
        for i in range(len(rates) if k else 0):
            for v in range(J.shape[2]):
                J[i, k, v, 0], J[i, k, v, 1] = J[rates[i], k - 1, v]
            _scaled(J, i, k, *reciprocal(float(k), float(k)))
        for line in range(len(code)):
            _line(J, code[line, 0], first + line, k, code[line, 1], code[line, 2])
    return J


@_njit
def mean_values(whole, centre, a, b, m):  # type: ignore[no-untyped-def]
    """Values over a box, by their intervals and by f(m) + ∂f (x − m), both of which hold: (O, 2).

    ``whole`` are values and derivatives over the box [a, b], (O, 1 + V, 2), ``centre`` values at
    doubles m inside, (O, 2).  Also: how much of each output is due to each variable, (O, V).
    """
    out, spread = np.empty((len(whole), 2)), np.empty((len(whole), len(a)))
    for o in range(len(whole)):
        p, q = whole[o, 0]
        c, d = centre[o]
        for i in range(len(a)):
            g0, g1 = whole[o, 1 + i]
            e, f = mul(g0, g1, down(a[i] - m[i]), up(b[i] - m[i]))
            c, d = add(c, d, e, f)
            spread[o, i] = max(abs(g0), abs(g1)) * (b[i] - a[i])
        if p == p and c == c:
            p, q = max(p, c), min(q, d)
        out[o, 0], out[o, 1] = p, q
    return out, spread


# -- interval matrices ----------------------------------------------------------------------------


@_njit
def product(A, B):  # type: ignore[no-untyped-def]
    """Product of interval matrices (I, K, 2) and (K, J, 2)."""
    out = np.zeros((A.shape[0], B.shape[1], 2))
    for i in range(A.shape[0]):
        for j in range(B.shape[1]):
            for k in range(A.shape[1]):
                a, b = mul(A[i, k, 0], A[i, k, 1], B[k, j, 0], B[k, j, 1])
                out[i, j, 0], out[i, j, 1] = add(out[i, j, 0], out[i, j, 1], a, b)
    return out


@_njit
def points(A):  # type: ignore[no-untyped-def]
    """A matrix of doubles as intervals."""
    out = np.empty((*A.shape, 2))
    for (i, j), value in np.ndenumerate(A):
        out[i, j, 0], out[i, j, 1] = value, value
    return out


@_njit
def inverse(A):  # type: ignore[no-untyped-def]
    """Enclose the inverse of every matrix in A (N, N, 2); NaN where that is not shown.

    With a double R near the inverse of the middle and ‖I − R A‖ ≤ e < 1 (largest row sum),
    A⁻¹ = (I − E)⁻¹ R, and (I − E)⁻¹ − I is at most e/(1 − e) in each entry.
    """
    n = len(A)
    middle = 0.5 * (A[..., 0] + A[..., 1])
    if not np.isfinite(middle).all() or np.linalg.det(middle) == 0.0:
        return np.full((n, n, 2), _NAN)
    R = points(np.linalg.inv(middle))
    E = product(R, A)
    worst = 0.0
    for i in range(n):
        total = 0.0
        for j in range(n):
            c = 1.0 if i == j else 0.0
            a, b = add(E[i, j, 0], E[i, j, 1], -c, -c)
            total = up(total + max(abs(a), abs(b)))
        worst = max(worst, total) if total == total else _INF
    if not worst < 0.5:
        return np.full((n, n, 2), _NAN)
    e = up(worst / down(1.0 - worst))
    near = np.empty((n, n, 2))
    for i in range(n):
        for j in range(n):
            c = 1.0 if i == j else 0.0
            near[i, j, 0], near[i, j, 1] = down(c - e), up(c + e)
    return product(near, R)


@_njit
def norm(row):  # type: ignore[no-untyped-def]
    """Upper bound of the Euclidean norm of an interval vector (K, 2)."""
    total = 0.0
    for k in range(len(row)):
        big = max(abs(row[k, 0]), abs(row[k, 1]))
        total = up(total + up(big * big))
    return up(math.sqrt(total)) if total == total else _INF


@_njit
def dominance(S):  # type: ignore[no-untyped-def]
    """A lower bound of the dominance of the diagonal of S (N, N, 2): > 0 proves S ≻ 0, S = Sᵀ."""
    least = _INF
    for i in range(len(S)):
        off = 0.0
        for j in range(len(S)):
            if j != i:
                off = up(off + max(abs(S[i, j, 0]), abs(S[i, j, 1])))
        room = down(S[i, i, 0] - off)
        least = min(least, room) if room == room else -_INF
    return least


# -- one validated Taylor step --------------------------------------------------------------------


@_njit
def reached(X, rates, h):  # type: ignore[no-untyped-def]
    """X + [0, h] · rates, all (N, 2)."""
    out = np.empty_like(X)
    for i in range(len(X)):
        a, b = mul(rates[i, 0], rates[i, 1], 0.0, h)
        out[i, 0], out[i, 1] = add(X[i, 0], X[i, 1], a, b)
    return out


@_njit
def carried(end, part, h):  # type: ignore[no-untyped-def]
    """One step of Horner's scheme: h · end + part, all (N, 2), h (2,)."""
    out = np.empty_like(end)
    for i in range(len(end)):
        a, b = mul(end[i, 0], end[i, 1], h[0], h[1])
        out[i, 0], out[i, 1] = add(a, b, part[i, 0], part[i, 1])
    return out


@_njit
def along(whole, centre, C, xi, moved):  # type: ignore[no-untyped-def]
    """Values at m + C ξ + moved (N, 1, 2), by their intervals and their mean values, (O, 2).

    ``whole`` are values and derivatives over a box that holds them, (O, 1 + N, 2), ``centre``
    values at m, (O, 2).
    """
    out, slope = whole[:, 0].copy(), np.ascontiguousarray(whole[:, 1:])
    first, second = product(product(slope, points(C)), xi), product(slope, moved)
    for o in range(len(whole)):
        a, b = centre[o]
        for part in (first, second):
            a, b = add(a, b, part[o, 0, 0], part[o, 0, 1])
        if a == a and out[o, 0] == out[o, 0]:
            out[o, 0], out[o, 1] = max(a, out[o, 0]), min(b, out[o, 1])
    return out


@_njit
def hulled(m, C, xi):  # type: ignore[no-untyped-def]
    """The box around m + C ξ, (N, 2)."""
    X = product(points(C), xi)[:, 0].copy()
    for i in range(len(m)):
        X[i, 0], X[i, 1] = add(m[i], m[i], X[i, 0], X[i, 1])
    return X


@_njit
def taylor_step(rest, centre, around, h, m, C, xi):  # type: ignore[no-untyped-def]
    """{m + C ξ} after h, Lemma 6: new m and C into theirs; the box (N, 1, 2) that is to be added.

    ``rest`` (N, 2) is the last coefficient over a box that motions stay in, ``centre`` (N, K, 2)
    the others at m, ``around`` (N, K, 1 + N, 2) the others over the set with their derivatives.
    C (N, L) are doubles, ξ (L, 1, 2) is a box, h (2,) an interval.  NaN where nothing is bounded.
    """
    n = len(m)
    end, S = rest.copy(), np.zeros((n, n, 2))
    for k in range(centre.shape[1] - 1, -1, -1):  # Horner in h; the remainder comes first
        for i in range(n):
            a, b = mul(end[i, 0], end[i, 1], h[0], h[1])
            end[i, 0], end[i, 1] = add(a, b, centre[i, k, 0], centre[i, k, 1])
            for j in range(n):
                a, b = mul(S[i, j, 0], S[i, j, 1], h[0], h[1])
                c, d = around[i, k, 1 + j]
                S[i, j, 0], S[i, j, 1] = add(a, b, c, d)
    drift = np.full((n, 1, 2), _NAN)
    if not (np.isfinite(end).all() and np.isfinite(S).all()):
        return drift
    carried = product(S, points(C))
    for i in range(n):
        m[i] = 0.5 * (end[i, 0] + end[i, 1])
        drift[i, 0, 0], drift[i, 0, 1] = add(end[i, 0], end[i, 1], -m[i], -m[i])
        for j in range(C.shape[1]):
            C[i, j] = 0.5 * (carried[i, j, 0] + carried[i, j, 1])
            a, b = add(carried[i, j, 0], carried[i, j, 1], -C[i, j], -C[i, j])
            a, b = mul(a, b, xi[j, 0, 0], xi[j, 0, 1])
            drift[i, 0, 0], drift[i, 0, 1] = add(drift[i, 0, 0], drift[i, 0, 1], a, b)
    return drift


# -- a terminal ellipsoid -------------------------------------------------------------------------


@_njit
def decrease(A, held):  # type: ignore[no-untyped-def]
    """Dominance of −(A + Aᵀ), or of −(A + Aᵀ + AᵀA) if held: > 0 proves it positive definite.

    A (N, N, 2) is W J W⁻¹ with the derivative J of ẋ, or of x(T) − x(0).
    """
    size = len(A)
    S, turned, scale = np.empty((size, size, 2)), np.empty((size, size, 2)), np.ones(size)
    for (i, j, end), value in np.ndenumerate(A):
        turned[j, i, end] = value
    square = product(turned, A)
    for i in range(size):
        for j in range(size):
            a, b = add(A[i, j, 0], A[i, j, 1], A[j, i, 0], A[j, i, 1])
            if held:
                a, b = add(a, b, square[i, j, 0], square[i, j, 1])
            S[i, j, 0], S[i, j, 1] = -b, -a
        middle = 0.5 * (S[i, i, 0] + S[i, i, 1])
        if middle > 1e-100:
            scale[i] = 1.0 / math.sqrt(middle)
    for i in range(size):  # a congruence with a positive diagonal: any will do
        for j in range(size):
            a, b = mul(S[i, j, 0], S[i, j, 1], scale[i], scale[i])
            S[i, j, 0], S[i, j, 1] = mul(a, b, scale[j], scale[j])
    return dominance(S)


@_njit
def ellipsoid(V, whole, centre, W, radius, C, layer, limits):  # type: ignore[no-untyped-def]
    """Decide Lemma 5 for {|W x| ≤ radius}: what is not shown (0: all is), and a margin.

    W (2n, 2n, 2), V around its inverse and C (m, 2n, 2) are intervals, radius is rounded up, layer
    and limits down.  ``whole`` are values and derivatives over the box Q, (O, 1 + 2n, 2),
    ``centre`` values at 0, (O, 2), of q̈ (n), the demand (m), pivots (n) > 0, and what keeps its
    sign: det B, det Γ.
    """
    size, m = len(W), len(layer)
    n = size // 2
    for i in range(n + m, len(whole)):
        a, b = whole[i, 0]
        if not (a > 0.0 or (b < 0.0 and i >= n + m + n)):
            return 2, -_INF
    moved, demand = product(C, V), product(whole[n : n + m, 1:], V)
    for i in range(m):
        if not up(norm(moved[i]) * radius) <= layer[i]:
            return 3, -_INF
    for i in range(m):
        a, b = centre[n + i]
        if not up(max(abs(a), abs(b)) + up(norm(demand[i]) * radius)) <= limits[i]:
            return 4, -_INF
    F = np.zeros((size, size, 2))
    for i in range(n):
        F[i, n + i] = 1.0
        for j in range(size):
            F[n + i, j, 0], F[n + i, j, 1] = whole[i, 1 + j]
    margin = decrease(product(product(W, F), V), False)
    return (0 if margin > 0.0 else 5), margin


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
def _multiple(A, low, high, C, V):  # type: ignore[no-untyped-def]
    """A · [low, high], a number."""
    E = C.shape[0] - 3
    width = (high - low) * _GROW
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
        J[0, 0, 0, 0], J[0, 0, 0, 1], J[0, 1, 0, 0], J[0, 1, 0, 1], d = c, c, 1.0, 1.0, 0.0
        for last in range(2):
            if last:
                J[0, 0, 0, 0], J[0, 0, 0, 1] = down(c - r), up(c + r)
            if op == DIV:
                p, q = reciprocal(J[0, 0, 0, 0], J[0, 0, 0, 1])
                s, t = sqr(p, q)
                J[2, 0, 0, 0], J[2, 0, 0, 1], J[2, 1, 0, 0], J[2, 1, 0, 1] = p, q, -t, -s
                J[2, 2, 0, 0], J[2, 2, 0, 1] = mul(p, q, s, t)
                J[2, 3, 0, 0], J[2, 3, 0, 1] = sqr(s, t)
            elif last and op in (SIN, COS):
                J[2, 3, 0, 0], J[2, 3, 0, 1] = 1.0 / 6.0 + 1e-16, 1.0 / 6.0 + 1e-16
            else:
                for k in range(4 if last else 3):
                    for at in range(2, 4 if op in (SIN, COS) else 3):  # those stand together
                        _line(J, op if at == 2 else SIN + COS - op, at, k, 0, 5 - at)
            for k in range(0 if last else 3):
                f[k] = 0.5 * (J[2, k, 0, 0] + J[2, k, 0, 1])
                d += J[2, k, 0, 1] - J[2, k, 0, 0]
        f[3] = max(abs(J[2, 3, 0, 0]), abs(J[2, 3, 0, 1]))
        square = 2.0 * n * m + m * m + (2.0 * (n + m) + e) * e
        rest = abs(f[1]) * e + abs(f[2]) * square + f[3] * r * r * r + d * (1.0 + r + r * r)
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
    T, J = np.zeros((first + len(code) + 1, E + 3, LANES)), np.zeros((4, 4, 1, 2))
    for i in range(len(constants)):
        T[V + i, 0] = constants[i, 0]
        T[V + i, E] = (constants[i, 1] - constants[i, 0]) * _GROW + _LITTLE
    out = np.empty((boxes, len(outputs), E + 1))
    for start in range(0, boxes, LANES):
        for i in range(V):
            for lane in range(LANES):
                at = min(start + lane, boxes - 1)
                a, b = low[i, at], high[i, at]
                middle = 0.5 * a + 0.5 * b
                radius = max(b - middle, middle - a) * _GROW
                T[i, 0, lane], T[i, 1 + i, lane], T[i, E + 1, lane] = middle, radius, radius
                T[i, E, lane] = _LITTLE
        for line in range(len(code)):
            op, a, b = code[line]
            C = T[first + line]
            if op in (MUL, SQR):
                if op == MUL and V <= a < first:
                    a, b = b, a
                if op == MUL and V <= b < first:
                    _multiple(T[a], constants[b - V, 0], constants[b - V, 1], C, V)
                else:
                    _times(T[a], T[b if op == MUL else a], C, V)
            elif op in (ADD, SUB):
                _plus(T[a], T[b], 1.0 if op == ADD else -1.0, C, V)
            elif op == NEG:
                _multiple(T[a], -1.0, -1.0, C, V)
            elif op in (DIV, SQRT, SIN, COS, EXP, LOG):
                _composed(op, T[b if op == DIV else a], T[-1] if op == DIV else C, V, J)
                if op == DIV:
                    _times(T[a], T[-1], C, V)
            else:
                C[:] = _NAN
        for lane in range(min(LANES, boxes - start)):
            for o in range(len(outputs)):
                for k in range(E + 1):
                    out[start + lane, o, k] = T[outputs[o], k, lane]
    return out


@_njit
def _ends(model, V):  # type: ignore[no-untyped-def]
    """Lower and upper bound of one model."""
    total, low, high = abs(model[0]), model[0], model[0]
    k = 1 + V
    for i in range(V):
        g, h = abs(model[1 + i]), model[k]
        total += g + abs(h)
        high += g * (g / (-4.0 * h)) if 2.0 * h < -g else g + h
        low -= g * (g / (4.0 * h)) if 2.0 * h > g else g - h
        for _ in range(i + 1, V):
            k += 1
            cross = abs(model[k])
            total, high, low = total + cross, high + cross, low - cross
        k += 1
    rest = (model[k] + _ROUND * total) * _GROW + _LITTLE
    return low - rest, high + rest


@_njit
def ranges(models, V):  # type: ignore[no-untyped-def]
    """Bounds of models (B, O, 2), and how much of them is due to each variable (B, O, V)."""
    boxes, count, _ = models.shape
    out, spread = np.empty((boxes, count, 2)), np.zeros((boxes, count, V))
    for box in range(boxes):
        for o in range(count):
            out[box, o, 0], out[box, o, 1] = _ends(models[box, o], V)
            k = 1 + V
            for i in range(V):
                spread[box, o, i] += abs(models[box, o, 1 + i])
                for j in range(i, V):
                    part = 0.5 * abs(models[box, o, k])
                    spread[box, o, i] += part
                    spread[box, o, j] += part
                    k += 1
    return out, spread


@_njit
def excluded(models, V):  # type: ignore[no-untyped-def]
    """Boxes on which f ≥ 0, a ≤ 1 and b ≥ 1 are never true at once; models (B, 3, …) of f, a, b.

    Where they are, f + λ(1 − a) + μ(b − 1) ≥ 0 for all λ, μ ≥ 0, and so is (1 − a) + μ(b − 1).
    The factors that are tried take the slopes out; whatever they are, the bound decides.
    """
    out = np.zeros(len(models), dtype=np.bool_)
    trial, total = np.zeros(3), np.zeros(models.shape[2])
    for box in range(len(models)):
        f, a, b = models[box, :, 1 : 1 + V]
        fa, fb, aa = (f * a).sum(), (f * b).sum(), (a * a).sum()
        ab, bb = (a * b).sum(), (b * b).sum()
        gap = aa * bb - ab * ab + _LITTLE
        for kind in range(4):
            trial[0], trial[1], trial[2] = 1.0, 0.0, 0.0
            if kind == 0:
                trial[1] = -max(fa / (aa + _LITTLE), 0.0)
            elif kind == 1:
                trial[2] = max(-fb / (bb + _LITTLE), 0.0)
            elif kind == 2:
                trial[1] = -max((fa * bb - fb * ab) / gap, 0.0)
                trial[2] = max((fa * ab - fb * aa) / gap, 0.0)
            else:
                trial[0], trial[1], trial[2] = 0.0, -1.0, max(ab / (bb + _LITTLE), 0.0)
            shift = -trial[1] - trial[2]
            total[:] = 0.0
            total[0], size = shift, abs(trial[1]) + abs(trial[2])
            for o in range(3):
                for k in range(models.shape[2] - 1):
                    part = trial[o] * models[box, o, k]
                    total[k] += part
                    size += abs(part)
                total[-1] += abs(trial[o]) * models[box, o, -1]
            total[-1] = (total[-1] + _ROUND * size) * _GROW
            if _ends(total, V)[1] < 0.0:
                out[box] = True
                break
    return out
