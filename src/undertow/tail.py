"""The infinite horizon done exactly: the linear end of a closed loop.

Inside the boundary layer, unsaturated and near the target, the closed loop is ẋ = A x and
the stage cost is Φ₀ + xᵀQx to second order.  The rest of the cost and of the time then
needs no integration: with AᵀP + PA = −Q,

    ∫ xᵀQx dt from x to x_f  =  xᵀPx − x_fᵀPx_f,

and x_f is where e^{At}x first enters the terminal set.  A rollout may hand over to this
end as soon as the nonlinear residual r = ẋ − A x can no longer matter: V = xᵀPx changes by
at most ∫ 2|Px|ᵀ|r| dt because of it, and r, being of second order at least, decays faster
than the slowest mode σ.  The hand-over asks for 2|Px|ᵀ|r| ≤ δ σ (V + cost so far).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import sympy as sp

from undertow.codegen.machine import numba
from undertow.mechanism import FloatArray, Mechanism, numbers
from undertow.objective import Objective
from undertow.stability import linearise

__all__ = ["LinearEnd", "QuadraticStage", "quadratic_stage"]


@dataclass(frozen=True, eq=False)
class QuadraticStage:
    """Second-order model of a stage cost at the target.

    Φ ≈ ``rest`` + xᵀ ``xx`` x + 2 xᵀ ``xu`` u + uᵀ ``uu`` u.
    """

    rest: float
    xx: FloatArray
    xu: FloatArray
    uu: FloatArray


def quadratic_stage(mechanism: Mechanism, objective: Objective) -> QuadraticStage | None:
    """Return the second-order model of Φ at the target; ``None`` where there is none.

    There is none when Φ is not twice differentiable at 0 (|u|, say) or has a slope there.
    """
    symbols = [*mechanism.x, *mechanism.u]
    origin = dict.fromkeys(symbols, 0)
    stage = objective.stage_cost(mechanism).subs(mechanism.substitution)
    if stage.atoms(sp.Abs, sp.Max, sp.Min, sp.sign, sp.Piecewise):
        return None
    slope = sp.Matrix([stage]).jacobian(symbols).subs(origin)
    hessian = sp.hessian(stage, symbols).subs(origin)
    values = [*slope, *hessian, stage.subs(origin)]
    if not all(v.is_finite and v.is_real for v in values) or any(slope):
        return None
    half = numbers(hessian) / 2
    k = 2 * mechanism.n
    return QuadraticStage(
        float(stage.subs(origin)), half[:k, :k].copy(), half[:k, k:].copy(), half[k:, k:].copy()
    )


class Prepared(NamedTuple):
    """Linear ends of N closed loops.

    ``A`` (N, n, 2n) acceleration rows; ``P`` (N, 2n, 2n); ``rate`` (N,), a lower estimate
    of the slowest decay rate, 1/s; ``stable`` (N,).
    """

    A: FloatArray
    P: FloatArray
    rate: FloatArray
    stable: FloatArray


class LinearEnd:
    """The linear ends of all closed loops of one mechanism and objective.

    Parameters
    ----------
    mechanism, objective
        The closed loop's.

    Attributes
    ----------
    stage
        Second-order model of the stage cost; ``None`` where it has none, and then only
        stability can be read off.
    """

    def __init__(self, mechanism: Mechanism, objective: Objective) -> None:
        lin = linearise(mechanism)
        m = mechanism.m
        self.objective = objective
        self.stage = quadratic_stage(mechanism, objective)
        n = mechanism.n
        self._weights = self.stage or QuadraticStage(
            0.0, np.zeros((2 * n, 2 * n)), np.zeros((2 * n, m)), np.zeros((m, m))
        )
        M_uu, M_au = lin.M[m:, m:], lin.M[:m, m:]
        forces = np.hstack([lin.F, lin.D])
        self.X = np.ascontiguousarray(np.linalg.solve(M_uu, M_au.T))
        self.Y = np.ascontiguousarray(np.linalg.solve(M_uu, forces[m:]))
        self.H = np.ascontiguousarray(forces[:m] - M_au @ self.Y)
        self.S = lin.M[:m, :m] - M_au @ self.X
        self.B_inverse = np.linalg.inv(lin.B)
        # Where Φ has no quadratic part (minimum time) the state itself must be exact.
        self.counts_cost = bool(np.abs(self._weights.xx).max() + np.abs(self._weights.uu).max() > 0)

    def prepare(self, surfaces: FloatArray, gains: FloatArray, layers: FloatArray) -> Prepared:
        """Linearise the closed loops of N surfaces and solve their Lyapunov equations.

        Parameters
        ----------
        surfaces
            Surface vectors, (N, 2mn).
        gains, layers
            k_i at the target and ε_i, (N, m).
        """
        count, n, m = len(surfaces), self.X.shape[0] + self.X.shape[1], self.X.shape[1]
        out = Prepared(
            np.empty((count, n, 2 * n)),
            np.empty((count, 2 * n, 2 * n)),
            np.empty(count),
            np.empty(count),
        )
        stage = self._weights
        _prepare(
            np.ascontiguousarray(surfaces), gains / layers, self.X, self.Y, self.H, self.S,
            self.B_inverse, stage.xx, stage.xu, stage.uu, self.counts_cost, m,
            out.A, out.P, out.rate, out.stable,
        )  # fmt: skip
        return out

    def complete(self, prepared: Prepared, out: FloatArray, horizon: float) -> None:
        """Add the linear ends to the kernel's results, (N, columns), in place.

        Lanes that handed over (code −1) become reached (1), with the cost still to come
        added and the time at which the terminal set is entered, or run into the
        horizon (0).
        """
        _complete(
            prepared.A, prepared.P, out, horizon, self.objective.terminal_radius,
            self._weights.rest, self.counts_cost,
        )  # fmt: skip


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _prepare(  # type: ignore[no-untyped-def]
    surfaces, ratio, X, Y, H, S, B_inverse, xx, xu, uu, counts_cost, m, A, P, rate, stable
):
    count = surfaces.shape[0]
    free = X.shape[0]
    n = m + free
    N = 2 * n
    size = N * (N + 1) // 2
    index = np.empty((N, N), np.int64)
    k = 0
    for i in range(N):
        for j in range(i, N):
            index[i, j] = k
            index[j, i] = k
            k += 1
    full = np.zeros((N, N))
    K = np.empty((m, N))
    work = np.empty((size, size))
    right = np.empty((size, 2))
    for lane in range(count):
        p = surfaces[lane]
        alpha_a = p[: m * m].reshape(m, m)
        lambda_a = p[m * m : 2 * m * m].reshape(m, m)
        alpha_u = p[2 * m * m : m * m + m * n].reshape(m, free)
        lambda_u = p[m * m + m * n :].reshape(m, free)
        gamma = alpha_a - alpha_u @ X
        drive = alpha_u @ Y
        for i in range(m):
            for j in range(m):
                drive[i, j] += ratio[lane, i] * lambda_a[i, j]
                drive[i, n + j] += ratio[lane, i] * alpha_a[i, j] + lambda_a[i, j]
            for j in range(free):
                drive[i, m + j] += ratio[lane, i] * lambda_u[i, j]
                drive[i, n + m + j] += ratio[lane, i] * alpha_u[i, j] + lambda_u[i, j]
        if abs(np.linalg.det(gamma)) < 1e-12:
            stable[lane] = 0.0
            rate[lane] = 0.0
            A[lane] = 0.0
            P[lane] = 0.0
            continue
        V = -np.linalg.solve(gamma, drive)
        A[lane, :m] = V
        A[lane, m:] = Y - X @ V
        K = B_inverse @ (S @ V - H)
        Q = xx + xu @ K + K.T @ xu.T + K.T @ uu @ K
        full[:] = 0.0
        for i in range(n):
            full[i, n + i] = 1.0
        full[n:] = A[lane]
        # AᵀP + PA = −Q, entry by entry of the upper triangle; second right side: Q = I.
        work[:] = 0.0
        for i in range(N):
            for j in range(i, N):
                row = index[i, j]
                for k in range(N):
                    work[row, index[k, j]] += full[k, i]
                    work[row, index[i, k]] += full[k, j]
                right[row, 0] = -Q[i, j]
                right[row, 1] = -1.0 if i == j else 0.0
        _solve(work, right)
        # P_I > 0 if and only if A is Hurwitz (Lyapunov); its trace bounds the slowest rate.
        trace = 0.0
        definite = True
        L = np.zeros((N, N))
        for i in range(N):
            trace += right[index[i, i], 1]
            for j in range(i + 1):
                value = right[index[i, j], 1]
                for k in range(j):
                    value -= L[i, k] * L[j, k]
                if i == j:
                    if not value > 0.0:
                        definite = False
                        break
                    L[i, i] = np.sqrt(value)
                else:
                    L[i, j] = value / L[j, j]
            if not definite:
                break
        stable[lane] = 1.0 if definite else 0.0
        rate[lane] = 0.5 / trace if definite else 0.0
        which = 0 if counts_cost else 1
        for i in range(N):
            for j in range(N):
                P[lane, i, j] = right[index[i, j], which]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _complete(A, P, out, horizon, terminal, rest, counts_cost):  # type: ignore[no-untyped-def]
    count, n = A.shape[0], A.shape[1]
    N = 2 * n
    first = out.shape[1] - N
    full, E, square = np.zeros((N, N)), np.empty((N, N)), np.empty((N, N))
    here, following = np.empty(N), np.empty(N)
    for lane in range(count):
        if out[lane, 2] != -1.0:
            continue
        full[:] = 0.0
        for i in range(n):
            full[i, n + i] = 1.0
        full[n:] = A[lane]
        # Steps of 5 ms resolve the fast modes; they grow with the time that has passed,
        # because by then only slower modes are left.
        step = 0.005
        _exponential(full * step, E, square)
        here[:] = out[lane, first:]
        t = out[lane, 1]
        radius = np.sqrt(np.sum(here * here))
        taken = 0
        while radius > terminal and t < horizon:
            new = 0.0
            for i in range(N):
                following[i] = 0.0
                for j in range(N):
                    following[i] += E[i, j] * here[j]
                new += following[i] * following[i]
            new = np.sqrt(new)
            taken += 1
            if new <= terminal:
                part = np.log(radius / terminal) / np.log(radius / new) if new > 0.0 else 1.0
                here += part * (following - here)
                t += part * step
                radius = terminal
                break
            here[:] = following
            radius = new
            t += step
            if taken == 32:
                taken = 16
                _multiply(E, E, square)
                E[:] = square
                step *= 2.0
        total = rest * (t - out[lane, 1])
        if counts_cost:
            for i in range(N):
                for j in range(N):
                    begin = out[lane, first + i] * out[lane, first + j]
                    total += P[lane, i, j] * (begin - here[i] * here[j])
        out[lane, 0] += total
        out[lane, 1] = t
        out[lane, 2] = 1.0 if radius <= terminal and t <= horizon else 0.0
        out[lane, 3] = radius
        out[lane, first:] = here


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _solve(a, b):  # type: ignore[no-untyped-def]
    """Overwrite b with a⁻¹ b: Gaussian elimination with partial pivoting; a is spoilt."""
    size, columns = b.shape
    for k in range(size):
        pivot = k
        for i in range(k + 1, size):
            if abs(a[i, k]) > abs(a[pivot, k]):
                pivot = i
        if pivot != k:
            for j in range(k, size):
                a[k, j], a[pivot, j] = a[pivot, j], a[k, j]
            for j in range(columns):
                b[k, j], b[pivot, j] = b[pivot, j], b[k, j]
        inverse = 1.0 / a[k, k]
        for i in range(k + 1, size):
            factor = a[i, k] * inverse
            if factor != 0.0:
                for j in range(k + 1, size):
                    a[i, j] -= factor * a[k, j]
                for j in range(columns):
                    b[i, j] -= factor * b[k, j]
    for k in range(size - 1, -1, -1):
        for j in range(columns):
            value = b[k, j]
            for i in range(k + 1, size):
                value -= a[k, i] * b[i, j]
            b[k, j] = value / a[k, k]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _multiply(a, b, out):  # type: ignore[no-untyped-def]
    """Write a b to ``out``; for matrices so small that a library call costs more."""
    N = a.shape[0]
    for i in range(N):
        for j in range(N):
            value = 0.0
            for k in range(N):
                value += a[i, k] * b[k, j]
            out[i, j] = value


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _exponential(A, out, work):  # type: ignore[no-untyped-def]
    """Write e^A to ``out``: scaling and squaring with a Taylor polynomial of degree 12."""
    N = A.shape[0]
    norm = 0.0
    for i in range(N):
        row = 0.0
        for j in range(N):
            row += abs(A[i, j])
        norm = max(norm, row)
    squarings = 0
    while norm > 0.5:
        norm *= 0.5
        squarings += 1
    factor = 0.5**squarings
    for i in range(N):
        for j in range(N):
            out[i, j] = 1.0 if i == j else 0.0
    for k in range(12, 0, -1):
        _multiply(A, out, work)
        for i in range(N):
            for j in range(N):
                out[i, j] = work[i, j] * factor / k + (1.0 if i == j else 0.0)
    for _ in range(squarings):
        _multiply(out, out, work)
        out[:] = work
