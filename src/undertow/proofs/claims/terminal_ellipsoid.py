"""Terminal sets of the full closed loop: ellipsoids inside the layer, proved in a millisecond.

The rule is the kernel's (Lemma 5 of ``docs/certificate-format.md``); here it is prepared for many
laws of one mechanism, whose numbers are inputs of one program, as a search and the gate need it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import lru_cache
from typing import Any, Self, cast

import numpy as np
from numpy.typing import ArrayLike

from undertow.base.arguments import require
from undertow.base.verdict import Verdict, inward
from undertow.law import LawLayout, ProvedSet, ReachingLaw, Surface, check_surface_shape
from undertow.models.mechanism import FloatArray, Mechanism
from undertow.proofs.claims.claim import Claim
from undertow.proofs.claims.model_data import law_of, model_of
from undertow.proofs.claims.words import limits_words, sentence, verdict_on
from undertow.proofs.exact_model import require_autonomous
from undertow.proofs.kernel import claims as kernel
from undertow.proofs.kernel.compiled import between
from undertow.proofs.kernel.graph import Graph, Intervals, Span
from undertow.proofs.kernel.loop import ellipsoid
from undertow.proofs.kernel.model import Law, Model, System


@dataclass(frozen=True, eq=False)
class TerminalEllipsoid(Claim):
    """The ellipsoid {x : |W x| ≤ radius} of the full state x = (q, q̇) as a terminal set.

    ``W``: (2n, 2n), invertible. ``U``: (2n, 2n), close to W⁻¹ up to a scaling: the witness of the
    proof. ``radius``: ρ > 0.
    """

    W: FloatArray
    U: FloatArray
    radius: float

    @classmethod
    def of(cls, claim: kernel.TerminalEllipsoid) -> Self:
        """Return the ellipsoid that a certificate states."""
        W = np.array(claim.W, dtype=float)
        return cls(W, np.linalg.inv(W), float(claim.radius))

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

    def decide(self, mechanism: Mechanism, surface: Surface, law: ReachingLaw) -> Verdict:
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
        ClosedLoopProgram.of(mechanism, law.switching)
        model, own = model_of(mechanism), self.stated(mechanism, None)
        found = kernel.decide(model, law_of(mechanism, surface, law), own)
        margin = found.details.get("margin", math.nan)
        details = {"ball": self.ball, "box": found.details.get("box")}
        return verdict_on(own, model, replace(found, details=details), margin)

    def stated(self, mechanism: Mechanism, verdict: Verdict | None) -> kernel.TerminalEllipsoid:
        """Return it as the kernel decides it; U is a guess of the search, and not needed."""
        W = tuple(tuple(Fraction(float(v)) for v in row) for row in self.W)
        return kernel.TerminalEllipsoid(W, Fraction(self.radius))

    def proved_set(self, mechanism: Mechanism, surface: Surface, law: ReachingLaw) -> ProvedSet:
        """Return it with the closed loop that it is of."""
        return ProvedSet(surface, law, self, mechanism.fingerprint)


class ClosedLoopProgram:
    """The unsaturated closed loop inside the layer, for any surface and reaching law.

    Inputs: x (2n), then the mechanism's parameters, the surface, η and ε.  Outputs: q̈ (n), the
    input demand (m), the pivots of M (n), det B, det Γ.
    """

    def __init__(self, mechanism: Mechanism, switching: str = "saturation") -> None:
        model = model_of(mechanism)
        self.n, self.m = n, m = model.n, model.m
        bounds = tuple(Fraction(float(v)) for v in mechanism.disturbance_bounds)
        fixed, layout = 2 * n + len(model.parameters), LawLayout(n, m)
        graph = Graph(fixed + layout.reaching.stop)
        numbers = graph.inputs[fixed:]
        parts = *layout.blocks(numbers), numbers[layout.eta], numbers[layout.layer]
        law = Law(*cast(Any, (*parts, switching, bounds)))
        own = System(model, law, graph=graph, leaves=graph.inputs[:fixed])
        self.program = own.within_layer
        self.own = own

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
        return np.concatenate([mechanism.parameter_values, surface.vector, reaching.vector(self.m)])

    def rows(self, numbers: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return C with s = C x, (m, 2n), and the layer's half-widths, (m,)."""
        layout = LawLayout(self.n, self.m)
        law = numbers[len(self.own.model.parameters) :]
        alpha_a, lambda_a, alpha_u, lambda_u = layout.blocks(law)
        return np.hstack([lambda_a, lambda_u, alpha_a, alpha_u]), law[layout.layer]

    def at_rest(self, mechanism: Mechanism) -> bool:
        """Whether f_u(0, 0) = 0 is shown exactly for a mechanism of these equations."""
        values = [Span(0)] * (2 * self.n) + [
            Span(Fraction(float(v))) for v in mechanism.parameter_values
        ]
        return not self.own.graph.not_zero(self.own.f[self.m :], values, "f_u(0, 0) = 0")

    def over(self, low: FloatArray, high: FloatArray, variables: int = 0) -> FloatArray:
        """Enclose the outputs over a box of inputs, (O, 1 + variables, 2)."""
        found = self.program(between(low, high), variables)
        return np.stack([found.real, found.imag], axis=-1)

    def at_target(self, numbers: FloatArray) -> FloatArray:
        """Return enclosures of the outputs and of their gradients at x = 0, (O, 1 + 2n, 2)."""
        point = np.concatenate([np.zeros(2 * self.n), numbers])
        return self.over(point, point, 2 * self.n)


class _ByStructure:
    """A mechanism that compares by its equations."""

    def __init__(self, mechanism: Mechanism) -> None:
        self.mechanism = mechanism
        model = model_of(mechanism)
        self.key = (model.nodes, model.M, model.f, model.B, tuple(mechanism.disturbance_bounds))

    def __hash__(self) -> int:
        return hash(self.key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _ByStructure) and self.key == other.key


@lru_cache(maxsize=64)
def _program(key: _ByStructure, switching: str) -> ClosedLoopProgram:
    return ClosedLoopProgram(key.mechanism, switching)


def prove(
    loop: ClosedLoopProgram,
    numbers: FloatArray,
    rows: tuple[FloatArray, FloatArray],
    limits: FloatArray,
    found: TerminalEllipsoid,
    centre: Intervals | None = None,
) -> tuple[str, float, FloatArray]:
    """Run the kernel's rule: what is not shown, if anything, the margin, the box's half-sides."""
    (C, layer), W = rows, found.W
    return ellipsoid(
        loop.program, between(numbers, numbers), between(W, W), found.radius, between(C, C), layer,
        limits, centre,
    )  # fmt: skip


@sentence.register
def _(claim: kernel.TerminalEllipsoid, model: Model) -> str:
    inside = inward(Fraction(ball(claim)), 3)
    return (
        "every motion of the full closed loop, its input renewed at every instant, the plant the "
        f"model and no other force, from {{|W x| ≤ ρ}}, which holds the ball ‖x‖ ≤ {inside}, "
        f"stays there and converges, inside the layer and {limits_words(model)}"
    )


def ball(claim: kernel.TerminalEllipsoid) -> float:
    """A radius of a ball ‖x‖ ≤ r inside: ρ/c where c² − WᵀW is shown positive definite.

    W is taken of doubles, which are off by 2⁻⁵³ of themselves: so is ‖W‖, by 1e-15 at most.
    """
    W = np.array(claim.W, dtype=float)
    size = float(np.linalg.norm(W, 2))
    for slack in (1e-12, 1e-6, 1.0) if 1e-290 < size < 1e290 else ():
        c = Fraction(size * (1 + slack))
        columns = [list(map(Fraction, column)) for column in W.T.tolist()]
        rest = [
            [c * c * int(i == j) - sum(a * b for a, b in zip(p, q, strict=True))
             for j, q in enumerate(columns)]
            for i, p in enumerate(columns)
        ]  # fmt: skip
        if _positive(rest):
            return float(min(claim.radius / c, Fraction(10**300))) * (1 - 1e-14)
    return 0.0


def _positive(A: list[list[Fraction]]) -> bool:
    """Whether a symmetric rational matrix is positive definite, by its pivots."""
    for j, row in enumerate(A):
        if row[j] <= 0:
            return False
        for i in range(j + 1, len(A)):
            factor = A[i][j] / row[j]
            A[i] = [a - factor * b for a, b in zip(A[i], row, strict=True)]
    return True
