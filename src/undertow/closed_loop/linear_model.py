"""The infinite horizon done exactly: the linear model of a closed loop, and what goes with it.

Inside the boundary layer, unsaturated and near the target, the closed loop is ẋ = A x and
the stage cost is Φ₀ + xᵀQx to second order.  With AᵀP + PA = −Q,

    ∫ xᵀQx dt from x to x_f  =  xᵀPx − x_fᵀPx_f.

A rollout that has come into its boundary layer goes on from there in large steps that take A
and P exactly, and what they leave over by quadrature:
:mod:`undertow.closed_loop.exponential_integrator`.
"""

from __future__ import annotations

import math
from copy import copy
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import sympy as sp
from numpy.typing import NDArray

from undertow.closed_loop.ensemble import Ensemble
from undertow.closed_loop.linear_blocks import STEP_SIZES, UNIT, linear_blocks
from undertow.closed_loop.work_array import LANES
from undertow.law import LawLayout
from undertow.models import (
    FloatArray,
    Mechanism,
    is_smooth,
    linear_accelerations,
    linearise,
    numbers,
)
from undertow.objective import Objective
from undertow.symbolic import compiled

#: Terms of the series of e^{|A|t} before a loop is too fast to bound.
TERMS = 60


@dataclass(frozen=True, eq=False)
class QuadraticStage:
    """Second-order model of a stage cost at the target.

    Φ ≈ ``rest`` + xᵀ ``xx`` x + 2 xᵀ ``xu`` u + uᵀ ``uu`` u.
    """

    rest: float
    xx: FloatArray
    xu: FloatArray
    uu: FloatArray

    @property
    def quadratic(self) -> bool:
        """Whether state or input cost anything near the target."""
        return bool(np.abs(self.xx).max() + np.abs(self.uu).max() > 0)


def quadratic_stage(mechanism: Mechanism, stage: sp.Expr) -> QuadraticStage | None:
    """Return the second-order model of a Φ at the target; ``None`` where there is none.

    There is none when Φ is not twice differentiable at 0 (|u|, say) or has a slope there.
    """
    return _second_order(stage.subs(mechanism.substitution), mechanism.x, mechanism.u)


@lru_cache(maxsize=64)
def _second_order(
    stage: sp.Expr, x: tuple[sp.Symbol, ...], u: tuple[sp.Symbol, ...]
) -> QuadraticStage | None:
    symbols = [*x, *u]
    origin = dict.fromkeys(symbols, 0)
    if not is_smooth(stage):
        return None
    slope = sp.Matrix([stage]).jacobian(symbols).subs(origin)
    hessian = sp.hessian(stage, symbols).subs(origin)
    values = [*slope, *hessian, stage.subs(origin)]
    if not all(v.is_finite and v.is_real for v in values) or any(slope):
        return None
    half = numbers(hessian) / 2
    k = len(x)
    return QuadraticStage(
        float(stage.subs(origin)), half[:k, :k].copy(), half[:k, k:].copy(), half[k:, k:].copy()
    )


#: Stands for gains that are η.
_SAME = np.empty((0, 0))

#: Of lanes that bring no plant.
NOBODY = np.zeros(0, dtype=np.int64)

#: Stands for the plants of a law that acts on its own belief.
_ITSELF = np.empty((0, 0, 0)), np.empty((0, 0, 0))


class Prepared(NamedTuple):
    """Linear ends of C closed loops.

    ``A`` (C, n, 2n) acceleration rows; ``Q`` (C, 2n, 2n) stage cost, or (1, 2n, 2n) for all;
    ``P`` (C, 2n, 2n); ``stable`` (C,), 1 or 0; ``feedback`` K (C, m, 2n) of u = K x, zeros where
    the cost needs none; ``powers`` of e^{At} and ``forced`` responses, see
    :mod:`.linear_blocks`; ``reach`` of bounded states (C/16, STEP_SIZES, w·2n·16), see
    :mod:`.exponential_integrator`.
    """

    A: FloatArray
    Q: FloatArray
    P: FloatArray
    stable: FloatArray
    feedback: FloatArray
    powers: FloatArray
    forced: FloatArray
    reach: FloatArray


class TerminalLinearModel:
    """The linear ends of all closed loops of one mechanism and objective.

    ``mechanism``, ``objective``: the closed loop's. ``ensemble``: plants that the law of
    ``mechanism`` acts on, instead of it. ``stage``: second-order model of the stage cost; ``None``
    where it has none, and then only stability can be read off.
    """

    def __init__(
        self, mechanism: Mechanism, objective: Objective, ensemble: Ensemble | None = None
    ) -> None:
        self.objective = objective
        stage = objective.stage_cost(mechanism)
        self._one_stage = stage.free_symbols.isdisjoint(mechanism.parameter_symbols)
        self.stage = quadratic_stage(mechanism, stage)
        n, m = mechanism.n, mechanism.m
        self._layout = LawLayout(n, m)
        self._weights = self.stage or QuadraticStage(
            0.0, np.zeros((2 * n, 2 * n)), np.zeros((2 * n, m)), np.zeros((m, m))
        )
        # Where Φ has no quadratic part (minimum time) the state itself must be exact.
        self.counts_cost = self._weights.quadratic
        self._bounded = np.array([i for i, _ in objective.boxes(mechanism)], dtype=np.int64)
        self._blocks = linear_blocks(2 * n)
        self._take(mechanism, ensemble)

    def _take(self, mechanism: Mechanism, ensemble: Ensemble | None) -> None:
        """Keep the numbers of a mechanism and of the plants that its law acts on."""
        lin, m = linearise(mechanism), mechanism.m
        M_uu, M_au = lin.M[m:, m:], lin.M[:m, m:]
        forces = np.hstack([lin.F, lin.D])
        self.X = np.ascontiguousarray(np.linalg.solve(M_uu, M_au.T))
        self.Y = np.ascontiguousarray(np.linalg.solve(M_uu, forces[m:]))
        self.H = np.ascontiguousarray(forces[:m] - M_au @ self.Y)
        self.S = lin.M[:m, :m] - M_au @ self.X
        self.B_inverse = np.linalg.inv(lin.B)
        self._plants = (
            _ITSELF if ensemble is None else linear_accelerations(ensemble.plant, ensemble.values)
        )

    def believing(self, mechanism: Mechanism, ensemble: Ensemble | None) -> TerminalLinearModel:
        """Return this model with other parameters, and with another ensemble."""
        if not self._one_stage:
            return TerminalLinearModel(mechanism, self.objective, ensemble)
        other = copy(self)
        other._take(mechanism, ensemble)
        return other

    def buffers(self, count: int) -> Prepared:
        """Return room for the ends of ``count`` closed loops, a multiple of the lanes."""
        n = self.X.shape[0] + self.X.shape[1]
        N = 2 * n
        return Prepared(
            np.empty((count, n, N)),
            np.empty((count, N, N)) if self.counts_cost else np.eye(N)[None],
            np.empty((count, N, N)),
            np.empty(count),
            np.zeros((count, self.X.shape[1], N)),
            np.empty((count // LANES, STEP_SIZES, N * N * LANES)),
            np.empty((count // LANES, STEP_SIZES, 2, N * N * LANES)),
            np.empty((count // LANES, STEP_SIZES, len(self._bounded) * N * LANES)),
        )

    def noise_cost(self, ends: Prepared, covariance: FloatArray) -> FloatArray:
        """Return tr(R K P Kᵀ) of closed loops, (C,), cost per second.

        What an estimator does not know of the state, with the covariance P, (2n, 2n), becomes input
        near the target; R is what the stage cost has of uuᵀ.
        """
        K, R = ends.feedback, self._weights.uu
        rate: FloatArray = np.einsum("cij,jk,clk,il->c", K, covariance, K, R)
        return rate

    def prepare(
        self,
        lanes: FloatArray,
        gains: FloatArray | None,
        into: Prepared,
        member: NDArray[np.int64] = NOBODY,
    ) -> None:
        """Linearise closed loops and integrate what their linear ends need.

        ``lanes``: law vectors, (C, S, 2mn + 2m + 1), see :class:`undertow.law.LawLayout`, of each
        of S surfaces, of which the last counts. ``gains``: k_i at the target, (C, m), where that is
        not η_i. ``into``: what is filled, see :meth:`buffers`. ``member``: which plant of the
        ensemble each lane has, (C,).
        """
        stage, known = self._weights, _SAME if gains is None else np.ascontiguousarray(gains)
        _close(
            lanes, self._layout.starts, known, self.X, self.Y, self.H,
            self.S, self.B_inverse, stage.xx, stage.xu, stage.uu, self.counts_cost, member,
            *self._plants, into.A, into.Q, into.feedback,
        )  # fmt: skip
        self._blocks.double(into.A, into.Q, into.P, into.stable, into.powers, into.forced)
        if len(self._bounded):
            _reach(into.A, into.powers, into.forced, self._bounded, into.reach)


@compiled()
def _close(  # type: ignore[no-untyped-def]
    lanes,
    starts,
    gains,
    X,
    Y,
    H,
    S,
    B_inverse,
    xx,
    xu,
    uu,
    counts_cost,
    member,
    drift,
    push,
    A,
    Q,
    feedback,
):
    """Write the acceleration rows A and stage cost Q of each closed loop, and its feedback K.

    NaN where it is singular.

    The law is that of the belief; with a ``member`` for each lane it acts on that plant, whose
    accelerations are ``drift`` x + ``push`` u.
    """
    free, m = X.shape
    n = m + free
    N = 2 * n
    _, lambda_a, alpha_u, lambda_u, eta, layer = starts
    gamma, drive = np.empty((m, m)), np.empty((m, N))
    D = np.empty((m, N))
    for lane in range(lanes.shape[0]):
        p = lanes[lane, lanes.shape[1] - 1]
        for i in range(m):
            rate = (p[eta + i] if gains.size == 0 else gains[lane, i]) / p[layer + i]
            for j in range(m):
                value = p[i * m + j]
                for f in range(free):
                    value -= p[alpha_u + i * free + f] * X[f, j]
                gamma[i, j] = value
            for j in range(N):
                value = 0.0
                for f in range(free):
                    value += p[alpha_u + i * free + f] * Y[f, j]
                drive[i, j] = -value
            for j in range(m):
                drive[i, j] -= rate * p[lambda_a + i * m + j]
                drive[i, n + j] -= rate * p[i * m + j] + p[lambda_a + i * m + j]
            for f in range(free):
                drive[i, m + f] -= rate * p[lambda_u + i * free + f]
                drive[i, n + m + f] -= rate * p[alpha_u + i * free + f] + p[lambda_u + i * free + f]
        _solve(gamma, drive)
        for j in range(N):
            for i in range(m):
                A[lane, i, j] = drive[i, j]
            for f in range(free):
                value = Y[f, j]
                for i in range(m):
                    value -= X[f, i] * drive[i, j]
                A[lane, m + f, j] = value
        if not counts_cost and member.size == 0:
            continue
        K = feedback[lane]
        for i in range(m):
            for j in range(N):
                value = -H[i, j]
                for k in range(m):
                    value += S[i, k] * drive[k, j]
                D[i, j] = value
        for i in range(m):
            for j in range(N):
                K[i, j] = 0.0
                for k in range(m):
                    K[i, j] += B_inverse[i, k] * D[k, j]
        if member.size > 0:
            which = member[lane]
            for i in range(n):
                for j in range(N):
                    value = drift[which, i, j]
                    for k in range(m):
                        value += push[which, i, k] * K[k, j]
                    A[lane, i, j] = value
        if not counts_cost:
            continue
        for i in range(N):
            for j in range(N):
                value = xx[i, j]
                for k in range(m):
                    value += xu[i, k] * K[k, j] + xu[j, k] * K[k, i]
                    for j2 in range(m):
                        value += K[k, i] * uu[k, j2] * K[j2, j]
                Q[lane, i, j] = value


@compiled()
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


@compiled()
def _reach(A, powers, forced, bounded, reach):  # type: ignore[no-untyped-def]
    """Write bounds of |F_ij(s)| for all 0 ≤ s ≤ t, for the times t of the ``powers``.

    F(s) = ∫₀ˢ e^{Aτ} dτ.  Over the first the series of ∫₀ᵗ e^{|A|τ} dτ bounds them; over twice as
    long a time the moduli of F(t + s) = F(s) e^{At} + F(t) do.
    """
    n, N = A.shape[1], A.shape[2]
    row, term, after = np.empty(N), np.empty(N), np.empty(N)
    for lane in range(A.shape[0]):
        block, i = lane // LANES, lane % LANES
        for b in range(len(bounded)):
            bound = bounded[b]
            for j in range(N):
                row[j] = term[j] = UNIT if j == bound else 0.0
            for order in range(2, TERMS + 1):
                for j in range(N):
                    value = term[j - n] if j >= n else 0.0
                    for a in range(n):
                        value += term[n + a] * abs(A[lane, a, j])
                    after[j] = value * UNIT / order
                rest = total = 0.0
                for j in range(N):
                    term[j] = after[j]
                    row[j] += after[j]
                    rest += term[j]
                    total += row[j]
                if rest <= 1e-9 * total:
                    break
            else:
                row[:] = math.inf
            for level in range(STEP_SIZES):
                for j in range(N):
                    reach[block, level, (b * N + j) * LANES + i] = row[j]
                    value = abs(forced[block, level, 0, (bound * N + j) * LANES + i])
                    for k in range(N):
                        value += row[k] * abs(powers[block, level, (k * N + j) * LANES + i])
                    after[j] = max(row[j], value)
                for j in range(N):
                    row[j] = after[j]
