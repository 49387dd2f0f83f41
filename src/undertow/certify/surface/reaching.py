"""The reaching condition (16): what disturbance a given K still overcomes, proved.

Under the law, ``ṡ = −K sign(s) + W_a g_a + W_u g_u`` with Γ = α_a − α_u X,

    W_a = Γ S⁻¹,        W_u = α_u M_uu⁻¹ − Γ S⁻¹ Xᵀ,

which is (8)-(9) put into α_a g̃_a + α_u g̃_u.  (16), V̇ ≤ −Σ η_i |s_i|, holds for every
disturbance |g_j| ≤ ḡ_j iff Σ_j |W_ij(q)| ḡ_j ≤ k_i(q) − η_i for all i and all positions.
The gains (13)-(14) use norms instead and are therefore larger than need be.

Where the law does not exist there is nothing that it could overcome, so a region is proved
non-singular first.  Not covered: an error in M (it makes g depend on u), saturation of the input,
and the boundary layer, inside of which |s_i| ≤ ε_s · (bound/k_i) is what remains.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import sympy as sp
from numpy.typing import ArrayLike

from undertow.base.errors import InvalidInputError
from undertow.base.verdict import Verdict, inward
from undertow.certify.intervals.branch import BallFunction, Minimum, minimise_proved
from undertow.certify.intervals.exact_model import exact_mechanism
from undertow.certify.intervals.interval import ball, compile_outward
from undertow.certify.surface.surface import Region, nonsingular, region_box, region_words
from undertow.law.sliding import (
    LawSymbols,
    ReachingLaw,
    Surface,
    build_law_graph,
    check_surface_shape,
)
from undertow.models.mechanism import Mechanism
from undertow.symbolic import Tape

__all__ = ["DisturbanceBound", "ReachingCertificate", "reaching"]


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
    region: Region,
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
    spare, weights = _balance(mechanism, surface, gains, rate)
    method = "(16) by ball arithmetic, branch and bound over positions"

    def margin(i: int) -> BallFunction:
        def value(q: list[Any]) -> Any:
            w = weights(q)
            total = spare(q)[i]
            for j in range(n):
                if bounds[j]:
                    total = total - abs(w[i * n + j]) * ball(bounds[j])
            return total

        return value

    rows = [
        minimise_proved(margin(i), box, tolerance=tolerance, max_boxes=max_boxes) for i in range(m)
    ]
    worst = min(rows, key=lambda r: r.value)
    lower = min(r.lower for r in rows)
    units = [_unit(c.unit) for c in mechanism.coordinates]
    claim = _claim(names, units, bounds, rate, region_words(mechanism, region))
    verdict = _verdict(claim, names, worst, lower, method)
    exists = nonsingular(mechanism, surface, region, max_boxes=max_boxes)
    largest = tuple(
        _alone(mechanism, j, spare, weights, box, tolerance, max_boxes) for j in range(n)
    )
    if not exists:
        why = f"the law is not shown to exist there: {exists.method}"
        verdict = replace(exists, claim=claim, unit="", method=why)
        none = [replace(b, proved=0.0, as_input=0.0 * b.as_input) for b in largest]
        return ReachingCertificate(verdict, tuple(none), 0.0)
    if verdict.kind == "refuted":
        does = "; ".join(str(bound) for bound in largest)
        short = f"K falls short by {-verdict.margin:.4g} 1/s; alone it overcomes: {does}"
        verdict = replace(verdict, method=f"{method}; {short}")
    scale = 0.0
    if lower >= 0:
        scale = _factor(spare, weights, box, bounds, m, tolerance, max_boxes)[0]
    return ReachingCertificate(verdict, largest, scale)


def _unit(coordinate: str) -> str:
    """Unit of the generalised force on a coordinate."""
    return "N m" if coordinate == "rad" else "N"


def _row(what: str, values: ArrayLike, size: int) -> list[float]:
    row = np.atleast_1d(np.asarray(values, dtype=float))
    if row.size not in (1, size) or not (np.isfinite(row).all() and (row >= 0).all()):
        raise InvalidInputError(what, value=values, limit=f"1 or {size} finite numbers ≥ 0")
    return [float(v) for v in np.broadcast_to(row, (size,))]


def _balance(
    mechanism: Mechanism,
    surface: Surface,
    gains: ArrayLike | ReachingLaw | None,
    rate: list[float],
) -> tuple[Any, Any]:
    """Return functions of position balls: k_i(q) − η_i, (m,), and W(q), (mn,)."""
    n, m = mechanism.n, mechanism.m
    tape = Tape()
    part = mechanism.partition(tape)
    symbols = LawSymbols.of(n, m)
    law = build_law_graph(part, mechanism.x, symbols, "sign", mechanism.disturbance_bounds)
    entries = list(symbols.surface)
    alpha_a = sp.Matrix(m, m, entries[: m * m])
    alpha_u = sp.Matrix(m, n - m, entries[2 * m * m : m * m + m * n])
    gamma = tape.matrix(alpha_a - alpha_u * part.X)
    W_a = tape.product(gamma, tape.cholesky(part.S).solve(sp.eye(m)))
    inverse = tape.cholesky(part.M_uu).solve(sp.eye(n - m))
    W_u = tape.matrix(alpha_u * inverse - W_a * part.X.T)
    W = sp.Matrix.hstack(W_a, W_u)
    inputs = [*mechanism.q, *symbols.surface, *mechanism.parameter_symbols]
    fixed = [ball(float(v)) for v in (*surface.vector, *mechanism.parameter_values)]
    run_w = compile_outward(tape, inputs, list(W))

    def weights(q: list[Any]) -> list[Any]:
        return run_w(*q, *fixed)

    if gains is None or isinstance(gains, ReachingLaw):
        own = (ReachingLaw() if gains is None else gains).vector(m)[:m]
        run_k = compile_outward(tape, [*inputs, *symbols.eta], law.gains)
        more = [ball(float(v)) for v in own]

        def spare(q: list[Any]) -> list[Any]:
            return [k - ball(r) for k, r in zip(run_k(*q, *fixed, *more), rate, strict=True)]

    else:
        constant = [ball(k) - ball(r) for k, r in zip(_row("gains K", gains, m), rate, strict=True)]

        def spare(q: list[Any]) -> list[Any]:
            return constant

    return spare, weights


def _claim(
    names: list[str], units: list[str], bounds: list[float], rate: list[float], where: str
) -> str:
    loads = ", ".join(
        f"{k}: {inward(v, 6)} {unit}" for k, v, unit in zip(names, bounds, units, strict=True) if v
    )
    what = f"overcomes every disturbance on {loads} at most," if loads else "reaches the surface"
    left = ", ".join(inward(r, 6) for r in rate)
    return f"the law {what} {where}: (16) with η = {left}, the inputs not limited"


def _verdict(claim: str, names: list[str], worst: Minimum, lower: float, method: str) -> Verdict:
    witness = dict(zip(names, worst.point, strict=True))
    details = {"boxes": worst.boxes}
    if lower >= 0:
        return Verdict(claim, "proved", lower, "1/s", witness, method, details)
    if worst.value < 0:
        return Verdict(claim, "refuted", worst.value, "1/s", witness, method, details)
    stuck = {k: 0.5 * (a + b) for k, (a, b) in zip(names, worst.stuck, strict=True)}
    return Verdict(claim, "undecided", worst.value, "1/s", stuck, method + ", gave up", details)


def _factor(
    spare: Any,
    weights: Any,
    box: list[tuple[float, float]],
    bounds: list[float],
    m: int,
    tolerance: float,
    max_boxes: int,
) -> tuple[float, float, tuple[float, ...]]:
    """Largest factor on ``bounds``: proved, refuted, and where it is hardest."""
    proved, refuted, point = math.inf, math.inf, tuple(0.0 for _ in box)
    n = len(bounds)
    for i in range(m):

        def load(q: list[Any], i: int = i) -> Any:
            w = weights(q)
            total = sum(abs(w[i * n + j]) * ball(bounds[j]) for j in range(n) if bounds[j])
            return -total / spare(q)[i]

        if not any(bounds):
            continue
        found = minimise_proved(load, box, tolerance=tolerance, max_boxes=max_boxes)
        low = 1 / -found.lower * (1 - 1e-15) if found.lower < 0 else math.inf
        if not math.isfinite(found.lower):
            low = 0.0
        proved = min(proved, low)
        high = 1 / -found.value * (1 + 1e-15) if found.value < 0 else math.inf
        if high < refuted:
            refuted, point = high, found.point
    return proved, refuted, point


def _alone(
    mechanism: Mechanism,
    j: int,
    spare: Any,
    weights: Any,
    box: list[tuple[float, float]],
    tolerance: float,
    max_boxes: int,
) -> DisturbanceBound:
    n, m = mechanism.n, mechanism.m
    unit_load = [1.0 if k == j else 0.0 for k in range(n)]

    def least(i: int) -> float:
        return minimise_proved(
            lambda q: spare(q)[i], box, stop_above=0.0, stop_below=0.0, max_boxes=max_boxes
        ).lower

    positive = all(least(i) > 0 for i in range(m))
    proved, refuted, point = 0.0, 0.0, tuple(0.0 for _ in box)
    if positive:
        proved, refuted, point = _factor(spare, weights, box, unit_load, m, tolerance, max_boxes)
    coordinate = mechanism.coordinates[j]
    names = [c.name for c in mechanism.coordinates]
    matched = j < m
    as_input, input_unit = math.nan, ""
    B = np.array(mechanism.input_matrix.subs(mechanism.substitution), dtype=float)
    if matched and np.count_nonzero(B - np.diag(np.diag(B))) == 0:
        as_input, input_unit = proved / abs(float(B[j, j])), mechanism.inputs[j].unit
    return DisturbanceBound(
        coordinate.name,
        matched,
        proved,
        refuted,
        _unit(coordinate.unit),
        dict(zip(names, point, strict=True)),
        as_input,
        input_unit,
    )
