"""Blocks of small linear systems: e^{At}, Lyapunov integrals and arrival, in SIMD lanes.

For ẋ = A x with x ∈ ℝᴺ, sixteen systems at a time, everything comes from doubling:
e^{A2t} = (e^{At})² and P(2t) = P(t) + e^{Aᵀt} P(t) e^{At} with P(t) = ∫₀ᵗ e^{Aᵀτ} Q e^{Aτ} dτ,
begun with Taylor polynomials of degree 10.  A product of N×N matrices is written out for the
given N, so that its innermost loop runs over the lanes alone.
"""

from __future__ import annotations

from undertow.codegen.block import LANES

__all__ = ["LEVELS", "UNIT", "linear_source"]

#: Time of the first stored power e^{At}, s; level k stands for 2ᵏ units.
UNIT = 0.005

#: Stored powers: the last one is e^{A t} at 164 s.
LEVELS = 16


def linear_source(size: int) -> str:
    """Return the source of a module with functions ``double`` and ``arrive``.

    ``double(A, Q, P, rate, stable, powers)`` takes A (C, n, N), the lower half of a system of
    second order, and Q (C, N, N), or (1, N, N) for all; C is a multiple of the lanes.  It
    writes P (C, N, N), the decay ``rate`` (C,) of the slowest mode, 1/s, whether e^{At} decays
    at all, ``stable`` (C,), and ``powers`` (C/16, LEVELS, N·N·16).

    ``arrive(powers, P, out, horizon, terminal, rest, counted)`` completes the lanes of ``out``
    with code −1.

    Parameters
    ----------
    size
        N.
    """
    N = size
    area = N * N * LANES
    # Each matrix is an array of its own and a row is done at once: that way LLVM sees vectors.
    read = [f"a_{k} = a[(r * {N} + {k}) * {LANES} + i]" for k in range(N)]
    read_turned = [f"a_{k} = a[({k} * {N} + r) * {LANES} + i]" for k in range(N)]
    entries = [
        " + ".join(f"a_{k} * b[{(k * N + c) * LANES} + i]" for k in range(N)) for c in range(N)
    ]
    places = [f"(r * {N} + {c}) * {LANES} + i" for c in range(N)]
    product = [
        *read,
        *(f"o[{e}] = add[{e}] + factor * ({v})" for e, v in zip(places, entries, strict=True)),
    ]
    turned = [
        *read_turned,
        *(f"o[{e}] = add[{e}] + {v}" for e, v in zip(places, entries, strict=True)),
    ]
    image = " + ".join(
        f"powers[block, level, (r * {N} + {k}) * {LANES} + i] * X[{k * LANES} + i]"
        for k in range(N)
    )
    radius = " + ".join(f"Y[{k * LANES} + i] * Y[{k * LANES} + i]" for k in range(N))
    return f'''"""Linear systems of order {N}; generated, do not edit."""

import math

import numba
import numpy as np

FAST = {{"contract", "nsz", "arcp"}}


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=FAST)
def _product(a, b, add, factor, o):
    for r in range({N}):
        for i in range({LANES}):
{_indented(product)}


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=FAST)
def _turned(a, b, add, o):
    for r in range({N}):
        for i in range({LANES}):
{_indented(turned)}


@numba.njit(cache=True, nogil=True, error_model="numpy")
def double(A, Q, P, rate, stable, powers):
    half = {N // 2}
    W = np.zeros((9, {area}))
    zero, one, scaled, E, X, T, U, V, Z = W[0], W[1], W[2], W[3], W[4], W[5], W[6], W[7], W[8]
    for r in range({N}):
        for i in range({LANES}):
            one[(r * {N} + r) * {LANES} + i] = 1.0
    now, before = np.empty({LANES}), np.empty({LANES})
    for block in range(A.shape[0] // {LANES}):
        first = block * {LANES}
        worst = 1.0
        for i in range({LANES}):
            norm = 0.0
            for r in range(half):
                row = 0.0
                for c in range({N}):
                    row += abs(A[first + i, r, c])
                norm = max(norm, row)
            sound = norm < 1e7
            stable[first + i] = 1.0 if sound else 0.0
            rate[first + i] = 0.0
            if sound:
                worst = max(worst, norm)
            for r in range({N}):
                for c in range({N}):
                    value = 1.0 if c == r + half else 0.0
                    if r >= half:
                        value = A[first + i, r - half, c] if sound else 0.0
                    scaled[(r * {N} + c) * {LANES} + i] = value
                    which = first + i if Q.shape[0] > 1 else 0
                    U[(r * {N} + c) * {LANES} + i] = Q[which, r, c]
        t = {UNIT}
        halvings = 0
        while t * worst > 0.5:
            t *= 0.5
            halvings += 1
        for e in range({area}):
            scaled[e] *= t
            E[e] = one[e]
            X[e] = U[e]
        for k in range(10, 0, -1):
            _product(scaled, E, one, 1.0 / k, T)
            _product(X, scaled, zero, 1.0 / (k + 1), V)
            for r in range({N}):
                for c in range({N}):
                    e, m = (r * {N} + c) * {LANES}, (c * {N} + r) * {LANES}
                    for i in range({LANES}):
                        X[e + i] = U[e + i] + V[e + i] + V[m + i]
            E, T = T, E
        for e in range({area}):
            X[e] *= t
        for level in range(-halvings, {LEVELS}):
            if level >= 0:
                for i in range({LANES}):
                    now[i] = 0.0
                for e in range({N * N}):
                    for i in range({LANES}):
                        value = E[e * {LANES} + i]
                        powers[block, level, e * {LANES} + i] = value
                        now[i] += value * value
                if level > 0:
                    for i in range({LANES}):
                        if before[i] > 1e-16 and now[i] > 0.0:
                            rate[first + i] = 0.5 * math.log(before[i] / now[i]) / (0.5 * t)
                for i in range({LANES}):
                    before[i] = now[i]
            if level + 1 < {LEVELS}:
                _product(X, E, zero, 1.0, T)
                _turned(E, T, X, Z)
                _product(E, E, zero, 1.0, T)
                E, T, X, Z = T, E, Z, X
                t *= 2.0
        for i in range({LANES}):
            if not before[i] < 1.0:
                stable[first + i] = 0.0
            for r in range({N}):
                for c in range({N}):
                    P[first + i, r, c] = X[(r * {N} + c) * {LANES} + i]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def arrive(powers, P, out, horizon, terminal, rest, counted):
    state = out.shape[1] - {N}
    X, Y = np.empty({N * LANES}), np.empty({N * LANES})
    t, radius, active = np.empty({LANES}), np.empty({LANES}), np.empty({LANES})
    for block in range(powers.shape[0]):
        first = block * {LANES}
        going = 0.0
        for i in range({LANES}):
            t[i] = out[first + i, 1]
            radius[i] = out[first + i, 3]
            active[i] = 1.0 if out[first + i, 2] == -1.0 else 0.0
            going += active[i]
            for k in range({N}):
                X[k * {LANES} + i] = out[first + i, state + k]
        if going == 0.0:
            continue
        for i in range({LANES}):
            radius[i] = math.sqrt(sum_of_squares(X, i))
            active[i] = 1.0 if active[i] > 0.0 and radius[i] > terminal and t[i] < horizon else 0.0
        # By bisection where the cost counts and the time hardly matters; else step by step, and
        # then steps grow with the time that has passed, because only slower modes are left.
        bisect = {LEVELS} - 1 if counted else -1
        level, taken, step = max(bisect, 0), 0, {UNIT} * 2.0 ** max(bisect, 0)
        while True:
            going = 0.0
            for i in range({LANES}):
                going += active[i]
            if going == 0.0:
                break
            for r in range({N}):
                for i in range({LANES}):
                    Y[r * {LANES} + i] = {image}
            for i in range({LANES}):
                new = math.sqrt({radius})
                inside = new <= terminal
                moves = active[i] > 0.0
                part = 1.0
                if bisect >= 0:
                    moves = moves and not inside and t[i] + step < horizon
                elif inside and new > 0.0:
                    part = math.log(radius[i] / terminal) / math.log(radius[i] / new)
                if moves:
                    for k in range({N}):
                        X[k * {LANES} + i] += part * (Y[k * {LANES} + i] - X[k * {LANES} + i])
                    t[i] += part * step
                    radius[i] = terminal if inside else new
                    active[i] = 0.0 if inside or not t[i] < horizon else 1.0
            if bisect >= 0:
                bisect -= 1
                level, step = max(bisect, 0), {UNIT} * 2.0 ** max(bisect, 0)
                continue
            taken += 1
            if taken == 32 and level + 1 < {LEVELS}:
                level, taken, step = level + 1, 16, 2.0 * step
        for i in range({LANES}):
            lane = first + i
            if out[lane, 2] != -1.0:
                continue
            total = rest * (t[i] - out[lane, 1])
            if counted:
                for r in range({N}):
                    for c in range({N}):
                        begin = out[lane, state + r] * out[lane, state + c]
                        end = X[r * {LANES} + i] * X[c * {LANES} + i]
                        total += P[lane, r, c] * (begin - end)
            out[lane, 0] += total
            out[lane, 1] = t[i]
            out[lane, 2] = 1.0 if radius[i] <= terminal and t[i] <= horizon else 0.0
            out[lane, 3] = radius[i]
            for k in range({N}):
                out[lane, state + k] = X[k * {LANES} + i]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def sum_of_squares(X, i):
    total = 0.0
    for k in range({N}):
        total += X[k * {LANES} + i] * X[k * {LANES} + i]
    return total
'''


def _indented(lines: list[str]) -> str:
    """Return lines at the depth of a lane loop within a loop over rows."""
    return "\n".join(" " * 12 + line for line in lines)
