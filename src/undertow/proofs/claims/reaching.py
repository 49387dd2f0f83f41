"""The reaching condition (16): what disturbance a given K still overcomes, proved.

Under the law, ``ṡ = −K sign(s) + W_a g_a + W_u g_u`` with Γ = α_a − α_u X,

    W_a = Γ S⁻¹,        W_u = α_u M_uu⁻¹ − Γ S⁻¹ Xᵀ,

which is (8)-(9) put into α_a g̃_a + α_u g̃_u.  (16), V̇ ≤ −Σ η_i |s_i|, holds for every
disturbance |g_j| ≤ ḡ_j iff Σ_j |W_ij(q)| ḡ_j ≤ k_i(q) − η_i for all i and all positions.
The gains (13) use norms instead and are therefore larger than need be.

Where the law does not exist there is nothing that it could overcome, so a region is proved
non-singular first.  Not covered: an error in M (it makes g depend on u), saturation of the input,
and the boundary layer, inside of which |s_i| ≤ ε_s · (bound/k_i) is what remains.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import reduce
from operator import sub
from typing import Any

import numpy as np
import sympy as sp
from numpy.typing import ArrayLike

from undertow.base.errors import InvalidInputError
from undertow.base.verdict import Verdict, inward
from undertow.law import (
    LawSymbols,
    ReachingLaw,
    Surface,
    build_law_graph,
    check_surface_shape,
)
from undertow.models.mechanism import Mechanism
from undertow.proofs.claims.claim import Box, Claim
from undertow.proofs.claims.model_data import law_of, model_of
from undertow.proofs.claims.nonsingular import exact_box, nonsingular, region_box, region_words
from undertow.proofs.intervals.branch import BallFunction, Minimum, minimise_proved
from undertow.proofs.intervals.exact_model import exact_mechanism
from undertow.proofs.intervals.interval import ball, compile_outward
from undertow.proofs.kernel import claims as kernel
from undertow.proofs.kernel.model import Law
from undertow.symbolic import Tape

#: Of one ball per coordinate.
BallFunctions = Callable[[list[Any]], list[Any]]


@dataclass(frozen=True)
class DisturbanceBound:
    """The largest disturbance on one coordinate, alone, that K still overcomes.

    Parameters
    ----------
    coordinate
        On which it acts.
    matched
        Whether the coordinate is actuated.
    proved
        (16) is proved for |g| ≤ this, N m (or N for a coordinate in metres).
    refuted
        (16) fails for a constant disturbance of this size at ``witness``.
    unit
        Unit of both.
    witness
        The position where it is hardest.
    as_input
        ``proved`` as a disturbance at the input, in its unit (matched ones, B diagonal).
    input_unit
        That unit, "" where there is none.
    """

    coordinate: str
    matched: bool
    proved: float
    refuted: float
    unit: str
    witness: dict[str, float]
    as_input: float = math.nan
    input_unit: str = ""

    def __str__(self) -> str:
        """One line for people."""
        kind = "matched" if self.matched else "unmatched"
        text = f"{kind} disturbance on {self.coordinate}: up to {self.proved:.4g} {self.unit}"
        return text + (f" ({self.as_input:.4g} {self.input_unit})" if self.input_unit else "")


@dataclass(frozen=True)
class ReachingCertificate:
    """What (16) guarantees over a region.

    Parameters
    ----------
    verdict
        Whether (16) holds for the disturbance bounds that were declared, all acting at
        once; the margin is k_i − η_i − Σ|W_ij| ḡ_j at its smallest, in units of s per s.
    largest
        Per coordinate, the largest disturbance acting alone.
    scale
        All declared bounds may grow together by this proved factor (inf if all are 0).
    """

    verdict: Verdict
    largest: tuple[DisturbanceBound, ...]
    scale: float


def reaching(
    mechanism: Mechanism,
    surface: Surface,
    region: Box,
    gains: ArrayLike | ReachingLaw | None = None,
    *,
    eta: ArrayLike = 0.0,
    disturbance: Sequence[float] | None = None,
    tolerance: float = 1e-3,
    max_boxes: int = 20_000,
) -> ReachingCertificate:
    """Prove the reaching condition (16) over a region of positions.

    Parameters
    ----------
    region
        Coordinate name to (low, high), SI units, as for ``certify.nonsingular``.
    gains
        K as constants (one number, or m), or a reaching law, whose gains (13) for the
        mechanism's declared disturbance bounds are then used; ``ReachingLaw()`` by default.
    eta
        Reaching rate η_i ≥ 0 that (16) must leave, (m,) or one number.
    disturbance
        Bounds |g_j| ≤ ḡ_j to be decided, (n,), N m or N; the mechanism's own by default.
    tolerance
        Relative gap between proved and refuted figures.

    Returns
    -------
    ReachingCertificate

    Raises
    ------
    InvalidInputError
        For gains, rates or bounds that are negative or have the wrong length.
    ModelError
        For a model that is not smooth.
    """
    mechanism = exact_mechanism(mechanism)
    check_surface_shape(mechanism, surface)
    n, m = mechanism.n, mechanism.m
    box = region_box(mechanism, region)
    names = [c.name for c in mechanism.coordinates]
    rate = _row("reaching rate η", eta, m)
    bounds = _row(
        "disturbance bounds",
        mechanism.disturbance_bounds if disturbance is None else disturbance,
        n,
    )
    balance = _Balance.of(mechanism, surface, box, gains, rate, tolerance, max_boxes)
    rows = [balance.minimum(balance.margin(i, bounds)) for i in range(m)]
    lower = min(r.lower for r in rows)
    worst = replace(min(rows, key=lambda r: r.value), lower=lower)
    claim = _claim(mechanism, bounds, rate, region_words(mechanism, region))
    decided = kernel.decide(
        model_of(mechanism),
        _law(mechanism, surface, gains),
        kernel.Reaching(
            exact_box(region), tuple(map(Fraction, bounds)), tuple(map(Fraction, rate))
        ),
        max_boxes,
    )
    method, kinds = decided.why, {"proved": True, "refuted": False}
    held = kinds.get(decided.kind)
    verdict = worst.verdict(claim, names, "1/s", method, held)
    exists = nonsingular(mechanism, surface, region, max_boxes=max_boxes)
    largest = tuple(balance.alone(j) for j in range(n))
    if not exists:
        why = f"the law is not shown to exist there: {exists.method}"
        verdict = replace(exists, claim=claim, unit="", method=why)
        none = [replace(b, proved=0.0, as_input=0.0 * b.as_input) for b in largest]
        return ReachingCertificate(verdict, tuple(none), 0.0)
    if verdict.kind == "refuted":
        does = "; ".join(str(bound) for bound in largest)
        short = f"K falls short by {-verdict.margin:.4g} 1/s; alone it overcomes: {does}"
        verdict = replace(verdict, method=f"{method}; {short}")
    return ReachingCertificate(verdict, largest, balance.factor(bounds)[0] if held else 0.0)


def _law(mechanism: Mechanism, surface: Surface, gains: ArrayLike | ReachingLaw | None) -> Law:
    """Return the kernel's law with these gains: those of (13), or constants."""
    own = gains if isinstance(gains, ReachingLaw) else ReachingLaw()
    law = law_of(mechanism, surface, own)
    if gains is None or isinstance(gains, ReachingLaw):
        return law
    constant = tuple(map(Fraction, _row("gains K", gains, mechanism.m)))
    return replace(law, eta=constant, disturbance=(Fraction(0),) * mechanism.n)


def _unit(coordinate: str) -> str:
    """Unit of the generalised force on a coordinate."""
    return "N m" if coordinate == "rad" else "N"


def _row(what: str, values: ArrayLike, size: int) -> list[float]:
    row = np.atleast_1d(np.asarray(values, dtype=float))
    if row.size not in (1, size) or not (np.isfinite(row).all() and (row >= 0).all()):
        raise InvalidInputError(what, value=values, limit=f"1 or {size} finite numbers ≥ 0")
    return [float(v) for v in np.broadcast_to(row, (size,))]


def _claim(mechanism: Mechanism, bounds: list[float], rate: list[float], where: str) -> str:
    loads = ", ".join(
        f"{c.name}: {inward(v, 6)} {_unit(c.unit)}"
        for c, v in zip(mechanism.coordinates, bounds, strict=True)
        if v
    )
    what = f"overcomes every disturbance on {loads} at most," if loads else "reaches the surface"
    left = ", ".join(inward(r, 6) for r in rate)
    return f"the law {what} {where}: (16) with η = {left}, the inputs not limited"


@dataclass(frozen=True, eq=False)
class _Balance:
    """k_i(q) − η_i, (m,), and W(q), (mn,), as functions of position balls, over a box."""

    mechanism: Mechanism
    box: list[tuple[float, float]]
    spare: BallFunctions
    weights: BallFunctions
    tolerance: float
    max_boxes: int

    @classmethod
    def of(
        cls,
        mechanism: Mechanism,
        surface: Surface,
        box: list[tuple[float, float]],
        gains: ArrayLike | ReachingLaw | None,
        rate: list[float],
        tolerance: float,
        max_boxes: int,
    ) -> _Balance:
        n, m = mechanism.n, mechanism.m
        tape = Tape()
        part = mechanism.partition(tape)
        symbols = LawSymbols.of(n, m)
        law = build_law_graph(part, mechanism.x, symbols, "sign", mechanism.disturbance_bounds)
        alpha_a, _, alpha_u, _ = symbols.blocks
        gamma = tape.matrix(alpha_a - alpha_u * part.X)
        W_a = tape.product(gamma, tape.cholesky(part.S).solve(sp.eye(m)))
        inverse = tape.cholesky(part.M_uu).solve(sp.eye(n - m))
        W_u = tape.matrix(alpha_u * inverse - W_a * part.X.T)
        inputs = [*mechanism.q, *symbols.surface, *mechanism.parameter_symbols]
        fixed = [ball(float(v)) for v in (*surface.vector, *mechanism.parameter_values)]
        run_w = compile_outward(tape, inputs, list(sp.Matrix.hstack(W_a, W_u)))
        if gains is None or isinstance(gains, ReachingLaw):
            own = (ReachingLaw() if gains is None else gains).per_surface(m)[0]
            run_k = compile_outward(tape, [*inputs, *symbols.eta], law.gains)
            more = [*fixed, *(ball(float(v)) for v in own)]
        else:
            constant = [ball(k) for k in _row("gains K", gains, m)]
            run_k, more = (lambda *_: constant), []

        def spare(q: list[Any]) -> list[Any]:
            return [k - ball(r) for k, r in zip(run_k(*q, *more), rate, strict=True)]

        return cls(mechanism, box, spare, lambda q: run_w(*q, *fixed), tolerance, max_boxes)

    def minimum(self, function: BallFunction, **stops: float) -> Minimum:
        """Enclose a function's minimum over the box."""
        return minimise_proved(
            function, self.box, tolerance=self.tolerance, max_boxes=self.max_boxes, **stops
        )

    def _loads(self, i: int, q: list[Any], bounds: list[float]) -> Iterator[Any]:
        n, weights = len(bounds), self.weights(q)
        return (abs(weights[i * n + j]) * ball(bounds[j]) for j in range(n) if bounds[j])

    def margin(self, i: int, bounds: list[float]) -> BallFunction:
        """What the disturbances leave of row i of (16)."""
        return lambda q: reduce(sub, self._loads(i, q, bounds), self.spare(q)[i])

    def factor(self, bounds: list[float]) -> tuple[float, float, tuple[float, ...]]:
        """Largest factor on ``bounds``: proved, refuted, and where it is hardest."""
        proved, refuted, point = math.inf, math.inf, tuple(0.0 for _ in self.box)
        for i in range(self.mechanism.m if any(bounds) else 0):

            def load(q: list[Any], i: int = i) -> Any:
                return -sum(self._loads(i, q, bounds)) / self.spare(q)[i]

            found = self.minimum(load)
            low = 1 / -found.lower * (1 - 1e-15) if found.lower < 0 else math.inf
            proved = min(proved, low if math.isfinite(found.lower) else 0.0)
            high = 1 / -found.value * (1 + 1e-15) if found.value < 0 else math.inf
            if high < refuted:
                refuted, point = high, found.point
        return proved, refuted, point

    def alone(self, j: int) -> DisturbanceBound:
        """What is overcome of a disturbance on coordinate j alone."""
        mechanism, stops = self.mechanism, {"stop_above": 0.0, "stop_below": 0.0}
        proved, refuted, point = 0.0, 0.0, tuple(0.0 for _ in self.box)

        def least(i: int) -> float:
            return self.minimum(lambda q: self.spare(q)[i], **stops).lower

        if all(least(i) > 0 for i in range(mechanism.m)):
            proved, refuted, point = self.factor([float(k == j) for k in range(mechanism.n)])
        coordinate = mechanism.coordinates[j]
        as_input, input_unit = math.nan, ""
        B = mechanism.B
        if j < mechanism.m and np.count_nonzero(B - np.diag(np.diag(B))) == 0:
            as_input, input_unit = proved / abs(float(B[j, j])), mechanism.inputs[j].unit
        names = (c.name for c in mechanism.coordinates)
        witness = dict(zip(names, point, strict=True))
        return DisturbanceBound(
            coordinate.name,
            j < mechanism.m,
            proved,
            refuted,
            _unit(coordinate.unit),
            witness,
            as_input,
            input_unit,
        )


@dataclass(frozen=True)
class ReachingClaim(Claim):
    """The law overcomes disturbances over a region of positions, and reaches the surface.

    Parameters
    ----------
    region
        Coordinate name to (low, high), SI units; coordinates left out stay at the target.
    eta
        Reaching rate η_i ≥ 0 that (16) leaves, (m,).
    disturbance
        Bounds |g_j| ≤ ḡ_j, all acting at once, (n,), N m or N.
    """

    region: Box
    eta: tuple[float, ...]
    disturbance: tuple[float, ...]

    def decide(self, mechanism: Mechanism, surface: Surface, law: ReachingLaw) -> Verdict:
        """Decide it as :func:`reaching` does for the gains of the reaching law."""
        return reaching(
            mechanism, surface, self.region, law, eta=self.eta, disturbance=self.disturbance
        ).verdict

    def stated(self, mechanism: Mechanism, verdict: Verdict) -> kernel.Claim:
        """Return it as the kernel decides it."""
        bounds, rate = (tuple(map(Fraction, v)) for v in (self.disturbance, self.eta))
        return kernel.Reaching(exact_box(self.region), bounds, rate)
