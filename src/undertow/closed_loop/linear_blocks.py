"""Blocks of small linear systems: e^{At}, responses and Lyapunov integrals, in SIMD lanes.

For ẋ = A x with x ∈ ℝᴺ, sixteen systems at a time, everything comes from doubling:
e^{A2t} = (e^{At})²; P(2t) = P(t) + e^{Aᵀt} P(t) e^{At} for P(t) = ∫₀ᵗ e^{Aᵀτ} Q e^{Aτ} dτ;
F(2t) = F(t) + e^{At} F(t) for F(t) = ∫₀ᵗ e^{As} ds; 2 G(2t) = G(t) + F(t) + e^{At} G(t) for
G(t) = ∫₀ᵗ e^{A(t−s)} s/t ds.  Taylor polynomials of degree 10 begin.  A row of a product of N×N
matrices is written out for the given N, so that its innermost loop runs over the lanes alone.
"""

from __future__ import annotations

from functools import lru_cache
from types import ModuleType

from undertow.closed_loop.work_array import LANES
from undertow.symbolic import PRIMITIVES, content_key, generated

#: Time of the first stored power e^{At}, s; level k stands for 2ᵏ units.
UNIT = 0.005

#: Doublings of the unit: P is taken at 164 s.
LEVELS = 16

#: So many powers and responses are stored: for steps of up to 1.28 s.
STEP_SIZES = 9


@lru_cache(maxsize=8)
def linear_blocks(size: int) -> ModuleType:
    """Return the module with the function ``double`` for N = ``size``, from the cache if known.

    ``double(A, Q, P, stable, powers, forced)`` takes A (C, n, N), the lower half of a system of
    second order, and Q (C, N, N), or (1, N, N) for all; C is a multiple of the lanes.  It writes
    P (C, N, N), whether e^{At} decays at all, ``stable`` (C,), ``powers`` of e^{At}
    (C/16, STEP_SIZES, N·N·16) and ``forced``, F and G (C/16, STEP_SIZES, 2, N·N·16).
    """
    return generated("linear", str(size), content_key(str(size)), lambda: _source(size))


def _source(N: int) -> str:
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
    return f'''"""Linear systems of order {N}; generated, do not edit."""

{PRIMITIVES}
inner = compiled(no_cpython_wrapper=True, fastmath={{"contract", "nsz", "arcp"}})


@inner
def _product(a, b, add, factor, o):
    for r in range({N}):
        for i in range({LANES}):
{_indented(product)}


@inner
def _turned(a, b, add, o):
    for r in range({N}):
        for i in range({LANES}):
{_indented(turned)}


@compiled()
def double(A, Q, P, stable, powers, forced):
    half = {N // 2}
    zero, one, scaled = memory({area}), memory({area}), memory({area})
    E, X, T = memory({area}), memory({area}), memory({area})
    U, V, Z = memory({area}), memory({area}), memory({area})
    F, G, Y = memory({area}), memory({area}), memory({area})
    for e in range({area}):
        zero[e] = 0.0
        one[e] = 0.0
    for r in range({N}):
        for i in range({LANES}):
            one[(r * {N} + r) * {LANES} + i] = 1.0
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
            F[e] = one[e]
            G[e] = one[e]
        for k in range(10, 0, -1):
            _product(scaled, F, one, 1.0 / (k + 1), T)
            F, T = T, F
            _product(scaled, G, one, 1.0 / (k + 2), T)
            G, T = T, G
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
            F[e] *= t
            G[e] *= 0.5 * t
        for level in range(-halvings, {LEVELS}):
            if 0 <= level < {STEP_SIZES}:
                for e in range({area}):
                    powers[block, level, e] = E[e]
                    forced[block, level, 0, e] = F[e]
                    forced[block, level, 1, e] = G[e]
            if level + 1 < {STEP_SIZES}:
                _product(E, G, F, 1.0, T)
                for e in range({area}):
                    G[e] = 0.5 * (G[e] + T[e])
                _product(E, F, F, 1.0, Y)
                F, Y = Y, F
            if level + 1 < {LEVELS}:
                _product(X, E, zero, 1.0, T)
                _turned(E, T, X, Z)
                _product(E, E, zero, 1.0, T)
                E, T, X, Z = T, E, Z, X
                t *= 2.0
        for i in range({LANES}):
            norm = 0.0
            for e in range({N * N}):
                norm += E[e * {LANES} + i] * E[e * {LANES} + i]
            if not norm < 1.0:
                stable[first + i] = 0.0
            for r in range({N}):
                for c in range({N}):
                    P[first + i, r, c] = X[(r * {N} + c) * {LANES} + i]
'''


def _indented(lines: list[str]) -> str:
    """Return lines at the depth of a lane loop within a loop over rows."""
    return "\n".join(" " * 12 + line for line in lines)
