"""Terminal sets of the full closed loop: ellipsoids inside the layer, proved in a millisecond.

Inside the boundary layer and below the input limits the nominal closed loop is smooth,
ẋ = f(x) with f(0) = 0, in the full state x = (q, q̇).  Over a box around 0 let [J] enclose the
Jacobian of f; then f(x) ∈ [J] x, and with V(x) = |W x|², P = WᵀW,

    V̇ = xᵀ (P J + Jᵀ P) x  for some J in [J].

The claim: {V ≤ ρ²} is positively invariant, every motion from it converges to 0, and on it the
law exists, |s_i| ≤ ε_i and |u_i| ≤ the limit.  The proof, in outward-rounded arithmetic: the
ellipsoid lies in the box (its half-sides are those of the ellipsoid itself); on the box
det Γ(q)/det Γ(0) > 0; the largest |s_i| and |u_i| on the ellipsoid are below their limits (u −
u(0) ∈ [K] x with [K] its gradient); and −Uᵀ(P J + Jᵀ P)U has a positive, strictly dominant
diagonal for all J in [J], with any U: such a matrix is positive definite, and U invertible.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, ClassVar

import numpy as np
import sympy as sp
from numpy.typing import ArrayLike

from undertow.base.verdict import Verdict, inward
from undertow.law import (
    LawLayout,
    LawSymbols,
    ReachingLaw,
    Surface,
    build_law_graph,
    check_surface_shape,
)
from undertow.models.mechanism import FloatArray, Mechanism
from undertow.proofs.claims.claim import Claim, Readers, matrix_of
from undertow.proofs.intervals.exact_model import exact_mechanism, vanishes
from undertow.proofs.intervals.outward import add, down, magnitude, mul, up
from undertow.proofs.intervals.program import Program, run
from undertow.proofs.intervals.require import require, require_autonomous
from undertow.symbolic import Tape
from undertow.symbolic.machine import numba

__all__ = [
    "ClosedLoopProgram",
    "ProvedEllipsoid",
    "TerminalEllipsoid",
    "limits_in_words",
]

#: Why a set is not proved, by the kernel's code.
REASONS = (
    "proved",
    "W and U are not close enough to inverses",
    "the law's determinant reaches zero",
    "the boundary layer is left",
    "an input limit is met",
    "V̇ < 0 is not shown",
)


@dataclass(frozen=True, eq=False)
class TerminalEllipsoid(Claim):
    """The ellipsoid {x : |W x| ≤ radius} of the full state x = (q, q̇) as a terminal set.

    Parameters
    ----------
    W
        (2n, 2n), invertible.
    U
        (2n, 2n), close to W⁻¹ up to a scaling: the witness of the proof.
    radius
        ρ > 0.
    """

    kind: ClassVar[str] = "terminal ellipsoid"
    reads: ClassVar[Readers] = {"W": matrix_of, "U": matrix_of, "radius": float}
    W: FloatArray
    U: FloatArray
    radius: float

    def level(self, x: ArrayLike) -> FloatArray:
        """Return |W x| / ρ at the states x, (…, 2n): at most 1 inside."""
        z = np.asarray(x, dtype=float) @ self.W.T
        return np.asarray(np.sqrt(np.sum(z * z, axis=-1)) / self.radius)

    def contains(self, x: ArrayLike) -> bool:
        """Whether the state is inside, rounding of this very test included."""
        state = np.asarray(x, dtype=float)
        slack = 1e-13 * float(np.sum(np.abs(self.W) @ np.abs(state)))
        return bool(float(self.level(state)) + slack / self.radius < 1.0)

    @property
    def ball(self) -> float:
        """Radius of the largest ball ‖x‖₂ ≤ r inside."""
        return float(self.radius / np.linalg.norm(self.W, 2))

    def sentence(self, mechanism: Mechanism) -> str:
        """Return in words what is claimed."""
        return (
            "every motion of the full closed loop, its input renewed at every instant, from "
            f"{{|W x| ≤ ρ}}, which holds the ball ‖x‖ ≤ {inward(self.ball * (1 - 1e-12), 3)}, "
            f"converges, inside the layer and {limits_in_words(mechanism)}"
        )

    def decide(
        self, mechanism: Mechanism, surface: Surface, law: ReachingLaw, *, seconds: float = 600.0
    ) -> Verdict:
        """Decide whether it is a region of attraction of the full closed loop.

        The continuous law (5) with (12), inside the layer and unclipped, belief equal to plant.

        Returns
        -------
        Verdict
            ``proved``, with what is left of the diagonal dominance as margin (1: all), or
            ``undecided`` with the condition that could not be shown.

        Raises
        ------
        InvalidInputError
            For arrays of the wrong shape or that are not finite, and as for the program.
        """
        check_surface_shape(mechanism, surface)
        size = 2 * mechanism.n
        for name, matrix in (("W", self.W), ("U", self.U)):
            shape, limit = np.shape(matrix), f"({size}, {size}), finite"
            good = shape == (size, size) and np.isfinite(matrix).all()
            require(good, f"{name} of a terminal set", f"shape {shape}", limit)
        sound = math.isfinite(self.radius) and self.radius > 0
        require(sound, "radius of a terminal set", self.radius, "> 0")
        program = ClosedLoopProgram.of(mechanism, law.switching)
        claim = self.sentence(mechanism)
        method = "interval Jacobian over the ellipsoid's box, diagonal dominance, float64 outward"
        if not program.at_rest:
            return Verdict(claim, "undecided", method="f_u(0, 0) = 0 cannot be shown symbolically")
        numbers = program.numbers(mechanism, surface, law)
        code, margin, point = prove(
            program, numbers, program.rows(numbers), program.limits(mechanism, numbers), self
        )
        witness = dict(zip(mechanism.state_names, point.tolist(), strict=True))
        if code == 0:
            details = {"ball": self.ball, "box": point.tolist()}
            return Verdict(claim, "proved", margin, "", witness, method, details)
        return Verdict(claim, "undecided", margin, "", witness, f"{method}: {REASONS[code]}")

    def proved_set(
        self, mechanism: Mechanism, surface: Surface, law: ReachingLaw
    ) -> ProvedEllipsoid:
        """Return it with the closed loop that it is of."""
        return ProvedEllipsoid(surface, law, self, mechanism.fingerprint)


@dataclass(frozen=True)
class ProvedEllipsoid:
    """A terminal ellipsoid, proved, and the closed loop that it is of.

    ``model`` is the mechanism's fingerprint; empty where nobody said it.
    """

    surface: Surface
    reaching: ReachingLaw
    ellipsoid: TerminalEllipsoid
    model: str = ""

    def contains(self, x: ArrayLike) -> bool:
        """Whether the state is inside for certain."""
        return self.ellipsoid.contains(x)


def limits_in_words(mechanism: Mechanism) -> str:
    """Return the input limits, each as it is."""
    parts = [f"|{i.name}| ≤ {float(i.limit)!r} {i.unit}".rstrip() for i in mechanism.inputs]
    return ", ".join(parts)


class ClosedLoopProgram:
    """Interval code of the unsaturated closed loop inside the layer, for any surface.

    Inputs: x (2n), then the surface, η, ε and the mechanism's parameters.  Outputs: q̈ (n), the
    input demand (m), det Γ(q).
    """

    def __init__(self, mechanism: Mechanism, switching: str = "saturation") -> None:
        mechanism = exact_mechanism(mechanism)
        n, m = mechanism.n, mechanism.m
        tape = Tape()
        part = mechanism.partition(tape)
        symbols = LawSymbols.of(n, m)
        law = build_law_graph(part, mechanism.x, symbols, "sign", mechanism.disturbance_bounds)
        alpha_a, lambda_a, alpha_u, lambda_u = symbols.blocks
        ratio = [s / e for s, e in zip(law.s, symbols.layer, strict=True)]
        if switching == "tanh":
            ratio = [sp.tanh(r) for r in ratio]
        push = sp.Matrix([k * r for k, r in zip(law.gains, ratio, strict=True)])
        qd_a, qd_u = sp.Matrix(mechanism.x[n : n + m]), sp.Matrix(mechanism.x[n + m :])
        gamma = tape.matrix(alpha_a - alpha_u * part.X)
        adjugate, determinant = tape.adjugate(gamma)
        drive = tape.matrix(alpha_u * part.y + lambda_a * qd_a + lambda_u * qd_u + push)
        # (12); with it the linearised q̈_a is v, and q̈_u = y − X v.
        v = tape.matrix(-(tape.matrix(adjugate * drive)) / determinant)
        q_dd = [*v, *tape.matrix(part.y - part.X * v)]
        force = tape.matrix(part.S * v - part.h)
        b_adjugate, b_determinant = tape.adjugate(part.B)
        demand = tape.matrix(b_adjugate * force / b_determinant)
        others = [*symbols.surface, *symbols.eta, *symbols.layer, *mechanism.parameter_symbols]
        self.n, self.m = n, m
        self.program = Program.of(tape, mechanism.x, others, [*q_dd, *demand, determinant])
        self.at_rest = vanishes(mechanism.force[m:, :], mechanism.x)
        self.needs_no_input = self.at_rest and vanishes(mechanism.force[:m, :], mechanism.x)

    @classmethod
    def of(cls, mechanism: Mechanism, switching: str = "saturation") -> ClosedLoopProgram:
        """Return the program of a mechanism's equations; equal ones share it.

        Raises
        ------
        InvalidInputError
            For a force that depends on time, or a switching function that is not smooth at 0.
        ModelError
            For a model that is not smooth.
        """
        require_autonomous(mechanism, "set")
        require(
            switching in ("saturation", "tanh"),
            "switching function of a terminal set",
            repr(switching),
            "'saturation' or 'tanh'",
            "With sign(s) the closed loop has no linear model at the target",
        )
        return _program(_ByStructure(mechanism), switching)

    def numbers(self, mechanism: Mechanism, surface: Surface, reaching: ReachingLaw) -> FloatArray:
        """Return the inputs besides x."""
        return np.concatenate([surface.vector, reaching.vector(self.m), mechanism.parameter_values])

    def rows(self, numbers: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return C with s = C x, (m, 2n), and the layer's half-widths, (m,)."""
        layout = LawLayout(self.n, self.m)
        alpha_a, lambda_a, alpha_u, lambda_u = layout.blocks(numbers)
        return np.hstack([lambda_a, lambda_u, alpha_a, alpha_u]), numbers[layout.layer]

    def at_target(self, numbers: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return enclosures of the outputs and of their gradients at x = 0."""
        point = np.concatenate([np.zeros(2 * self.n), numbers])
        return self.program(point, point)

    def limits(self, mechanism: Mechanism, numbers: FloatArray) -> FloatArray:
        """Return what the input limits leave besides the input that holds the target, (m,)."""
        if self.needs_no_input:
            return mechanism.input_limits
        held, _ = self.at_target(numbers)
        largest = np.abs(held[self.n : self.n + self.m]).max(axis=1)
        return np.asarray((mechanism.input_limits - largest) * (1 - 1e-15))


class _ByStructure:
    """A mechanism that compares by its equations."""

    def __init__(self, mechanism: Mechanism) -> None:
        self.mechanism = mechanism

    def __hash__(self) -> int:
        return hash(self.mechanism.structure)

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, _ByStructure)
            and self.mechanism.structure == other.mechanism.structure
        )


@lru_cache(maxsize=64)
def _program(key: _ByStructure, switching: str) -> ClosedLoopProgram:
    return ClosedLoopProgram(key.mechanism, switching)


def prove(
    loop: ClosedLoopProgram,
    numbers: FloatArray,
    rows: tuple[FloatArray, FloatArray],
    limits: FloatArray,
    found: TerminalEllipsoid,
) -> tuple[int, float, FloatArray]:
    """Run the kernel: the index into :data:`REASONS`, the margin, the box's half-sides."""
    p = loop.program
    code, margin, point = prove_kernel(
        p.code, p.constants, p.outputs, numbers, *rows, limits,
        found.W, found.U, found.radius, loop.n,
    )  # fmt: skip
    return int(code), float(margin), np.asarray(point)


_njit: Any = numba.njit(cache=True, nogil=True, error_model="numpy")


@_njit
def _dot(a, b):  # type: ignore[no-untyped-def]
    """Interval inner product of intervals (K, 2) and floats (K,)."""
    low, high = 0.0, 0.0
    for k in range(len(b)):
        c, d = mul(a[k, 0], a[k, 1], b[k], b[k])
        low, high = add(low, high, c, d)
    return low, high


@_njit
def _norm(row):  # type: ignore[no-untyped-def]
    """Upper bound of the 2-norm of an interval vector (K, 2)."""
    total = 0.0
    for k in range(len(row)):
        _, big = magnitude(row[k, 0], row[k, 1])
        total = up(total + up(big * big))
    return up(math.sqrt(total))


@_njit
def _product(A, B):  # type: ignore[no-untyped-def]
    """Interval product of intervals (I, K, 2) and floats (K, J)."""
    out = np.empty((A.shape[0], B.shape[1], 2))
    for i in range(A.shape[0]):
        for j in range(B.shape[1]):
            out[i, j, 0], out[i, j, 1] = _dot(A[i], B[:, j])
    return out


@_njit
def _points(A):  # type: ignore[no-untyped-def]
    """Floats (I, K) as intervals."""
    out = np.empty((A.shape[0], A.shape[1], 2))
    out[:, :, 0], out[:, :, 1] = A, A
    return out


@_njit
def prove_kernel(  # type: ignore[no-untyped-def]
    code, constants, outputs, numbers, C, layer, limits, W, U, radius, n
):
    """The proof: index into REASONS, margin, half-sides of the ellipsoid's box."""
    size, m = 2 * n, len(limits)
    half = np.zeros(size)
    # R = W U; x = U R⁻¹ (W x), and |R⁻¹ z| ≤ |z|/(1 − δ) with δ = ‖D‖ < 1, R = (I + D) Δ, Δ
    # the diagonal scaling of U, which is divided out first.
    point = _points(W)
    pair = _product(point, U)
    inverse = np.empty((size, size))
    for j in range(size):
        scale = 0.5 * (pair[j, j, 0] + pair[j, j, 1])
        if not scale > 0.0:
            return 1, -1e300, half
        inverse[:, j] = U[:, j] / scale  # U Δ⁻¹, rounded: this is the matrix used below
    pair = _product(point, inverse)
    for i in range(size):
        pair[i, i, 0], pair[i, i, 1] = add(pair[i, i, 0], pair[i, i, 1], -1.0, -1.0)
    delta = _norm(pair.reshape(size * size, 2))
    if not delta < 0.5:
        return 1, -1e300, half
    reach = up(radius / (1.0 - 1.0000001 * delta))
    low, high = np.empty(size + len(numbers)), np.empty(size + len(numbers))
    sides = _points(inverse)
    for i in range(size):
        half[i] = up(_norm(sides[i]) * reach)
        low[i], high[i] = -half[i], half[i]
    low[size:], high[size:] = numbers, numbers
    values, gradients = run(code, constants, outputs, size, low, high)
    # The law exists: det Γ keeps its sign, on a box around the target.
    if not (values[n + m, 0] > 0.0 or values[n + m, 1] < 0.0):
        return 2, -1e300, half
    s, u = _product(_points(C), inverse), _product(gradients[n : n + m], inverse)
    for i in range(m):
        if not up(_norm(s[i]) * reach) <= layer[i]:
            return 3, -1e300, half
    for i in range(m):
        if not up(_norm(u[i]) * reach) <= limits[i]:
            return 4, -1e300, half
    # G = W [J] U and F = W U, then −(FᵀG + GᵀF).
    J = np.zeros((size, size, 2))
    for i in range(n):
        J[i, n + i, 0] = J[i, n + i, 1] = 1.0
        J[n + i] = gradients[i]
    right, F = _product(J, U), _product(point, U)
    G = np.empty((size, size, 2))
    for i in range(size):
        for j in range(size):
            G[i, j, 0], G[i, j, 1] = _dot(right[:, j], W[i])
    margin = 1.0
    S = np.empty((size, size, 2))
    for i in range(size):
        for j in range(size):
            a, b = 0.0, 0.0
            for k in range(size):
                c, d = mul(F[k, i, 0], F[k, i, 1], G[k, j, 0], G[k, j, 1])
                a, b = add(a, b, c, d)
                c, d = mul(G[k, i, 0], G[k, i, 1], F[k, j, 0], F[k, j, 1])
                a, b = add(a, b, c, d)
            S[i, j, 0], S[i, j, 1] = -b, -a
    for i in range(size):
        off = 0.0
        for j in range(size):
            if j != i:
                _, big = magnitude(S[i, j, 0], S[i, j, 1])
                off = up(off + big)
        # With U as the search scales it S is near 2 I: the margin is the part that is left.
        row_margin = 0.5 * down(S[i, i, 0] - off)
        if not row_margin > -1e300:
            return 5, -1e300, half
        margin = min(margin, row_margin)
    return (0 if margin > 0.0 else 5), margin, half
