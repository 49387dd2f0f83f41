"""Arithmetic of quadratic Taylor models: what :mod:`.taylor` compiles.

Why it is sound.  Write |g| and |h| for the sums of magnitudes and s = |c| + |g| + |h| ≥ the
range of the polynomial.  The product of two models has, besides its quadratic part, the terms
G₁H₂ + H₁G₂ + H₁H₂ + e₁(s₂ + e₂) + e₂ s₁, bounded by magnitudes; a function φ of a model is
φ(c) + φ'(c)δ + ½φ''(c)δ² and a third-order remainder.  Each coefficient is a float sum of few
products, whose rounding errors are together below γ s₁s₂ with γ some units of 1.2e-16: ``ROUND``
s₁s₂ is added to e, and e, a sum of terms ≥ 0, is raised by a part ``GROW`` that is above its own
relative rounding error, and by ``TINY`` for underflow.  Overflow, and whatever is undefined on
a box, makes e infinite or NaN, which proves nothing.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from undertow.proofs.intervals import outward as ops
from undertow.symbolic.machine import numba

__all__ = ["LOAD", "SCALE", "SHIFT", "bounds", "excluded", "run", "spreads"]

#: Ops besides those of :mod:`undertow.proofs.intervals.program`: one operand is a constant.
SCALE, SHIFT, LOAD = 14, 15, 16

#: For sums of at most 60 terms.
ROUND, GROW, TINY = 8e-15, 1.0 + 4e-14, 1e-300

#: Reciprocals, roots and logarithms outside [1/FAR, FAR] have no bounds: powers of them would
#: underflow or overflow unseen.
FAR = 1e60

#: Boxes that go through the code together.
LANES = 32

# T[row, lane] is one model: rows c, g, h, e, then |g| and |h|.

_njit: Any = numba.njit(cache=True, nogil=True, error_model="numpy")


@_njit
def _sums(C, V):  # type: ignore[no-untyped-def]
    """|g| and |h|."""
    E = 1 + V + V * (V + 1) // 2
    C[E + 1 : E + 3] = 0.0
    for i in range(1, 1 + V):
        for lane in range(LANES):
            C[E + 1, lane] += abs(C[i, lane])
    for k in range(1 + V, E):
        for lane in range(LANES):
            C[E + 2, lane] += abs(C[k, lane])


@_njit
def _add(A, B, C, V):  # type: ignore[no-untyped-def]
    """A + B."""
    E = 1 + V + V * (V + 1) // 2
    for k in range(E):
        for lane in range(LANES):
            C[k, lane] = A[k, lane] + B[k, lane]
    _sums(C, V)
    for lane in range(LANES):
        s = abs(C[0, lane]) + C[E + 1, lane] + C[E + 2, lane]
        C[E, lane] = (A[E, lane] + B[E, lane] + ROUND * s) * GROW + TINY


@_njit
def _mul(A, B, C, V, mask):  # type: ignore[no-untyped-def]
    """A × B, which depends on the variables of the mask alone."""
    E = 1 + V + V * (V + 1) // 2
    for lane in range(LANES):
        na, ma, ea = A[E + 1, lane], A[E + 2, lane], A[E, lane]
        nb, mb, eb = B[E + 1, lane], B[E + 2, lane], B[E, lane]
        sa, sb = abs(A[0, lane]) + na + ma, abs(B[0, lane]) + nb + mb
        rest = na * mb + ma * nb + ma * mb + ea * (sb + eb) + eb * sa
        C[E, lane] = (rest + ROUND * (sa * sb)) * GROW + TINY
        C[0, lane] = A[0, lane] * B[0, lane]
    k = 1 + V
    for i in range(V):
        if not (mask >> i) & 1:
            C[1 + i] = 0.0
            C[k : k + V - i] = 0.0
            k += V - i
            continue
        for lane in range(LANES):
            C[1 + i, lane] = A[0, lane] * B[1 + i, lane] + A[1 + i, lane] * B[0, lane]
            C[k, lane] = (
                A[0, lane] * B[k, lane] + A[k, lane] * B[0, lane] + A[1 + i, lane] * B[1 + i, lane]
            )
        k += 1
        for j in range(i + 1, V):
            if (mask >> j) & 1:
                for lane in range(LANES):
                    C[k, lane] = (
                        A[0, lane] * B[k, lane]
                        + A[k, lane] * B[0, lane]
                        + A[1 + i, lane] * B[1 + j, lane]
                        + A[1 + j, lane] * B[1 + i, lane]
                    )
            else:
                C[k] = 0.0
            k += 1
    _sums(C, V)


@_njit
def _scale(A, low, high, C, V):  # type: ignore[no-untyped-def]
    """A × [low, high]."""
    E = 1 + V + V * (V + 1) // 2
    w = (high - low) * GROW
    for k in range(E):
        for lane in range(LANES):
            C[k, lane] = A[k, lane] * low
    for lane in range(LANES):
        s = abs(A[0, lane]) + A[E + 1, lane] + A[E + 2, lane]
        rest = (abs(low) + w) * A[E, lane] + w * s + ROUND * (abs(low) * s)
        C[E, lane] = rest * GROW + TINY
    _sums(C, V)


@_njit
def _shift(A, low, high, C, V):  # type: ignore[no-untyped-def]
    """A + [low, high]."""
    E = 1 + V + V * (V + 1) // 2
    C[1 : E + 3] = A[1 : E + 3]
    for lane in range(LANES):
        c = A[0, lane] + low
        C[0, lane] = c
        C[E, lane] = (A[E, lane] + (high - low) + ROUND * abs(c)) * GROW + TINY


@_njit
def _constant(C, low, high, V):  # type: ignore[no-untyped-def]
    """A model of an interval alone."""
    E = 1 + V + V * (V + 1) // 2
    C[:] = 0.0
    C[0] = low
    C[E] = (high - low) * GROW + TINY


@_njit
def _negate(A, C, V):  # type: ignore[no-untyped-def]
    """−A, exactly."""
    E = 1 + V + V * (V + 1) // 2
    for k in range(E):
        for lane in range(LANES):
            C[k, lane] = -A[k, lane]
    C[E:] = A[E:]


@_njit
def _point(op, c, r):  # type: ignore[no-untyped-def]
    """φ(c), φ'(c), ½φ''(c), one bound for the errors of the three, and of |φ'''|/6 within r.

    ROUND of the caller holds what the few roundings of f_1 and f_2 from f_0 add.
    """
    none = np.inf
    if op == ops.RECIPROCAL:
        gap = (abs(c) - r * GROW) * (1.0 - 1e-15)
        if not (gap > 1.0 / FAR and abs(c) < FAR):
            return 0.0, 0.0, 0.0, none, none
        f = 1.0 / c
        return f, -f * f, f * f * f, 0.0, abs(f * f * f) / gap * GROW
    if op in (ops.SIN, ops.COS):
        if not abs(c) <= 3.1415926:
            return 0.0, 0.0, 0.0, 1.0, 1.0
        p, q = ops.sine(c, c)
        s, ds = 0.5 * (p + q), q - p
        p, q = ops.cosine(c, c)
        k, dk = 0.5 * (p + q), q - p
        if op == ops.SIN:
            return s, k, -0.5 * s, max(ds, dk), 0.16666666666666669
        return k, -s, -0.5 * k, max(ds, dk), 0.16666666666666669
    if op == ops.SQRT:
        gap = (c - r * GROW) * (1.0 - 1e-15)
        if not (gap > 1.0 / FAR and c < FAR):
            return 0.0, 0.0, 0.0, none, none
        f = np.sqrt(c)
        return f, 0.5 / f, -0.125 / (c * f), 0.0, 0.0625 / (gap * gap * np.sqrt(gap)) * GROW
    if op == ops.EXP:
        p, q = ops.exponential(c, c)
        _, top = ops.exponential(c, c + r * GROW)
        return 0.5 * (p + q), 0.5 * (p + q), 0.25 * (p + q), q - p, top / 6.0 * GROW
    if op == ops.LOG:
        gap = (c - r * GROW) * (1.0 - 1e-15)
        if not (gap > 1.0 / FAR and c < FAR):
            return 0.0, 0.0, 0.0, none, none
        p, q = ops.logarithm(c, c)
        return 0.5 * (p + q), 1.0 / c, -0.5 / (c * c), q - p, GROW / (3.0 * gap * gap * gap)
    p, q = ops.tangent_h(c, c)  # TANH: φ' = 1 − φ², φ'' = −2φφ', |φ'''| ≤ 2
    f, d = 0.5 * (p + q), q - p
    slope = 1.0 - f * f
    return f, slope, -f * slope, 4.0 * d + 1e-15, 0.33333333333333337


@_njit
def _function(op, A, C, V):  # type: ignore[no-untyped-def]
    """φ(A) by Taylor's formula of second order."""
    E = 1 + V + V * (V + 1) // 2
    for lane in range(LANES):
        n, m, e = A[E + 1, lane], A[E + 2, lane], A[E, lane]
        r = (n + m + e) * GROW
        f0, f1, f2, d, f3 = _point(op, A[0, lane], r)
        square = 2.0 * n * m + m * m + (2.0 * (n + m) + e) * e
        rest = abs(f1) * e + abs(f2) * square + f3 * r * r * r + d * (1.0 + r + r * r)
        near = abs(f0) + abs(f1) * r + abs(f2) * r * r
        C[E, lane] = (rest + ROUND * near) * GROW + TINY
        C[0, lane] = f0
        k = 1 + V
        for i in range(V):
            C[1 + i, lane] = f1 * A[1 + i, lane]
            C[k, lane] = f1 * A[k, lane] + f2 * A[1 + i, lane] * A[1 + i, lane]
            k += 1
            for j in range(i + 1, V):
                C[k, lane] = f1 * A[k, lane] + 2.0 * f2 * A[1 + i, lane] * A[1 + j, lane]
                k += 1
    _sums(C, V)


@_njit
def _switch(op, A, B, C, V):  # type: ignore[no-untyped-def]
    """|·|, max, min: one side where that is sure, the interval of the values where not."""
    E = 1 + V + V * (V + 1) // 2
    for lane in range(LANES):
        a0, a1 = _ends(A[:, lane], V)
        if op == ops.ABS:
            b0, b1 = -a1, -a0
        else:
            b0, b1 = _ends(B[:, lane], V)
        first = a1 <= b0 if op == ops.MIN else a0 >= b1
        second = b1 <= a0 if op == ops.MIN else b0 >= a1
        if first or second:
            for k in range(E + 3):
                if first:
                    C[k, lane] = A[k, lane]
                elif op == ops.ABS:
                    C[k, lane] = -A[k, lane] if k < E else A[k, lane]
                else:
                    C[k, lane] = B[k, lane]
        else:
            p = min(a0, b0) if op == ops.MIN else max(a0, b0)
            q = min(a1, b1) if op == ops.MIN else max(a1, b1)
            for k in range(E + 3):
                C[k, lane] = 0.0
            C[0, lane] = p
            C[E, lane] = (q - p) * GROW + TINY
            if not (a0 - a0 == 0.0 and a1 - a1 == 0.0 and b0 - b0 == 0.0 and b1 - b1 == 0.0):
                C[0, lane], C[E, lane] = 0.0, np.inf


@_njit
def _ends(column, V):  # type: ignore[no-untyped-def]
    """Lower and upper bound of one model."""
    total, low, high = abs(column[0]), column[0], column[0]
    k = 1 + V
    for i in range(V):
        g, h = abs(column[1 + i]), column[k]
        total += g + abs(h)
        high += g * (g / (-4.0 * h)) if 2.0 * h < -g else g + h
        low -= g * (g / (4.0 * h)) if 2.0 * h > g else g - h
        k += 1
        for _ in range(i + 1, V):
            cross = abs(column[k])
            total += cross
            high += cross
            low -= cross
            k += 1
    rest = (column[k] + ROUND * total) * GROW + TINY
    return low - rest, high + rest


@_njit
def run(code, constants, registers, outputs, low, high):  # type: ignore[no-untyped-def]
    """Models over all boxes: (O, 2 + V + V(V+1)/2, B)."""
    V, boxes = low.shape
    E = 1 + V + V * (V + 1) // 2
    out = np.empty((len(outputs), E + 1, boxes))
    T = np.zeros((registers, E + 3, LANES))
    for start in range(0, boxes, LANES):
        for i in range(V):
            T[i] = 0.0
            for lane in range(LANES):
                at = min(start + lane, boxes - 1)
                a, b = low[i, at], high[i, at]
                middle = 0.5 * (a + b)
                radius = max(b - middle, middle - a) * GROW
                T[i, 0, lane], T[i, 1 + i, lane], T[i, E + 1, lane] = middle, radius, radius
                T[i, E, lane] = TINY
        for line in range(len(code)):
            op, c, a, b, mask = code[line]
            if op == ops.MUL:
                _mul(T[a], T[b], T[c], V, mask)
            elif op == ops.ADD:
                _add(T[a], T[b], T[c], V)
            elif op == SCALE:
                _scale(T[a], constants[b, 0], constants[b, 1], T[c], V)
            elif op == SHIFT:
                _shift(T[a], constants[b, 0], constants[b, 1], T[c], V)
            elif op == LOAD:
                _constant(T[c], constants[b, 0], constants[b, 1], V)
            elif op == ops.NEG:
                _negate(T[a], T[c], V)
            elif op in (ops.ABS, ops.MAX, ops.MIN):
                _switch(op, T[a], T[b], T[c], V)
            else:
                _function(op, T[a], T[c], V)
        for o in range(len(outputs)):
            lanes = min(LANES, boxes - start)
            out[o, :, start : start + lanes] = T[outputs[o], : E + 1, :lanes]
    return out


@_njit
def bounds(models, V):  # type: ignore[no-untyped-def]
    """Lower and upper bounds of models (O, rows, B): two arrays (O, B)."""
    count, _, boxes = models.shape
    low, high = np.empty((count, boxes)), np.empty((count, boxes))
    for o in range(count):
        for box in range(boxes):
            low[o, box], high[o, box] = _ends(models[o, :, box], V)
    return low, high


@_njit
def spreads(models, V):  # type: ignore[no-untyped-def]
    """How much of each model's variation is due to each variable, (O, V, B): for splitting."""
    count, _, boxes = models.shape
    out = np.zeros((count, V, boxes))
    for o in range(count):
        for box in range(boxes):
            k = 1 + V
            for i in range(V):
                out[o, i, box] += abs(models[o, 1 + i, box]) + abs(models[o, k, box])
                k += 1
                for j in range(i + 1, V):
                    out[o, i, box] += 0.5 * abs(models[o, k, box])
                    out[o, j, box] += 0.5 * abs(models[o, k, box])
                    k += 1
    return out


@_njit
def _combined(models, box, factors, shift, V):  # type: ignore[no-untyped-def]
    """Upper bound over a box of shift + Σ factor · model."""
    E = 1 + V + V * (V + 1) // 2
    total = np.zeros(E + 1)
    total[0] = shift
    size = abs(shift)
    for o in range(len(factors)):
        f = factors[o]
        if f == 0.0:
            continue
        for k in range(E):
            part = f * models[o, k, box]
            total[k] += part
            size += abs(part)
        total[E] += abs(f) * models[o, E, box]
    total[E] = (total[E] + ROUND * size) * GROW
    return _ends(total, V)[1]


@_njit
def excluded(models, V):  # type: ignore[no-untyped-def]
    """Boxes on which f ≥ 0, a ≤ 1 and b ≥ 1 are never true at once; the models are f, a and b.

    Where they are, f + λ(1 − a) + μ(b − 1) ≥ 0 for all λ, μ ≥ 0, and so is (1 − a) + μ(b − 1).
    The factors that are tried take the slopes out; whatever they are, the bound decides.
    """
    boxes = models.shape[2]
    out = np.zeros(boxes, dtype=np.bool_)
    trial = np.zeros(3)
    for box in range(boxes):
        fa = fb = aa = ab = bb = 0.0
        for i in range(1, 1 + V):
            f, a, b = models[0, i, box], models[1, i, box], models[2, i, box]
            fa, fb, aa, ab, bb = fa + f * a, fb + f * b, aa + a * a, ab + a * b, bb + b * b
        for kind in range(4):
            trial[0], trial[1], trial[2] = 1.0, 0.0, 0.0
            if kind == 0:
                trial[1] = -max(fa / (aa + TINY), 0.0)
            elif kind == 1:
                trial[2] = max(-fb / (bb + TINY), 0.0)
            elif kind == 2:
                gap = aa * bb - ab * ab + TINY
                trial[1] = -max((fa * bb - fb * ab) / gap, 0.0)
                trial[2] = max((fa * ab - fb * aa) / gap, 0.0)
            else:
                trial[0], trial[1], trial[2] = 0.0, -1.0, max(ab / (bb + TINY), 0.0)
            if _combined(models, box, trial, -trial[1] - trial[2], V) < 0.0:
                out[box] = True
                break
    return out
