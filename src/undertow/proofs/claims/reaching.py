"""The reaching condition (16): what disturbance a given K still overcomes, proved.

Under the law, ``ṡ = −K sign(s) + W_a g_a + W_u g_u`` with Γ = α_a − α_u X,

    W_a = Γ S⁻¹,        W_u = α_u M_uu⁻¹ − Γ S⁻¹ Xᵀ,

which is (8)-(9) put into α_a g̃_a + α_u g̃_u.  (16), V̇ ≤ −Σ η_i |s_i|, holds for every
disturbance |g_j| ≤ ḡ_j iff Σ_j |W_ij(q)| ḡ_j ≤ k_i(q) − η_i for all i and all positions.
The gains (13) use norms instead and are therefore larger than need be.

The kernel decides it; here the largest numbers that it proves are looked for.  Where the law does
not exist there is nothing that it could overcome, so a region is proved non-singular first.  Not
covered: an error in M (it makes g depend on u), saturation of the input, and the boundary layer,
inside of which |s_i| ≤ ε_s · (bound/k_i) is what remains.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
from numpy.typing import ArrayLike

from undertow.base.arguments import checked_names
from undertow.base.errors import InvalidInputError
from undertow.base.verdict import Verdict, inward
from undertow.law import ReachingLaw, Surface, check_surface_shape
from undertow.models.mechanism import FloatArray, Mechanism
from undertow.proofs.claims.claim import Box, Claim
from undertow.proofs.claims.model_data import law_of, model_of
from undertow.proofs.claims.nonsingular import (
    MOST_BOXES,
    Largest,
    exact_region,
    largest,
    nonsingular,
)
from undertow.proofs.claims.words import region_words, sentence, verdict_on
from undertow.proofs.kernel import claims as kernel
from undertow.proofs.kernel.model import Law, Model


@checked_names
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
        The position where it fails.
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

    ``verdict``: whether (16) holds for the disturbance bounds that were declared, all acting at
    once; the margin is k_i − η_i − Σ|W_ij| ḡ_j at its smallest, in units of s per s. ``largest``:
    per coordinate, the largest disturbance acting alone. ``scale``: all declared bounds may grow
    together by this proved factor (inf if all are 0).
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
    check_surface_shape(mechanism, surface)
    rate = _row("reaching rate η", eta, mechanism.m)
    own = mechanism.disturbance_bounds if disturbance is None else disturbance
    bounds = _row("disturbance bounds", own, mechanism.n)
    condition = _Condition.of(mechanism, surface, region, gains, tolerance)
    exists = nonsingular(mechanism, surface, region)
    if not exists:
        why = f"the law is not shown to exist there: {exists.method}"
        said = sentence(condition.stated(bounds, rate), condition.model)
        verdict = replace(exists, claim=said, method=why)
        none = [condition.bound(j, 0.0, 0.0, {}) for j in range(mechanism.n)]
        return ReachingCertificate(verdict, tuple(none), 0.0)
    verdict = condition.verdict(bounds, rate)
    alone = tuple(condition.alone(j, rate) for j in range(mechanism.n))
    if verdict.kind == "refuted":
        does = "; ".join(str(bound) for bound in alone)
        short = f"K falls short by {-verdict.margin:.4g} 1/s; alone it overcomes: {does}"
        verdict = replace(verdict, method=f"{verdict.method}; {short}")
    scale = math.inf if verdict else 0.0
    if verdict and any(bounds):
        scale = condition.largest(np.array(bounds), rate).proved
    return ReachingCertificate(verdict, alone, scale)


def _law(mechanism: Mechanism, surface: Surface, gains: ArrayLike | ReachingLaw | None) -> Law:
    """Return the kernel's law with these gains: those of (13), or constants."""
    own = gains if isinstance(gains, ReachingLaw) else ReachingLaw()
    law = law_of(mechanism, surface, own)
    if gains is None or isinstance(gains, ReachingLaw):
        return law
    constant = tuple(map(Fraction, _row("gains K", gains, mechanism.m)))
    return replace(law, eta=constant, disturbance=(Fraction(0),) * mechanism.n)


def _row(what: str, values: ArrayLike, size: int) -> list[float]:
    row = np.atleast_1d(np.asarray(values, dtype=float))
    if row.size not in (1, size) or not (np.isfinite(row).all() and (row >= 0).all()):
        raise InvalidInputError(what, value=values, limit=f"1 or {size} finite numbers ≥ 0")
    return [float(v) for v in np.broadcast_to(row, (size,))]


def _at_target(mechanism: Mechanism, surface: Surface) -> FloatArray:
    """Return |W| = |(α_a, α_u) M⁻¹| at the target, (m, n): where a search begins."""
    n = mechanism.n
    return np.asarray(np.abs(surface.matrix[:, n:] @ np.linalg.inv(mechanism.M(np.zeros(n)))))


@dataclass(frozen=True, eq=False)
class _Condition:
    """(16) over a region, for any disturbance and rate."""

    mechanism: Mechanism
    model: Model
    law: Law
    region: dict[str, tuple[Fraction, Fraction]]
    weights: FloatArray
    tolerance: float

    @classmethod
    def of(
        cls,
        mechanism: Mechanism,
        surface: Surface,
        region: Box,
        gains: ArrayLike | ReachingLaw | None,
        tolerance: float,
    ) -> _Condition:
        """Write it for the kernel."""
        model, law = model_of(mechanism), _law(mechanism, surface, gains)
        box, weights = exact_region(mechanism, region), _at_target(mechanism, surface)
        return cls(mechanism, model, law, box, weights, tolerance)

    def decide(
        self, bounds: Sequence[float] | FloatArray, rate: Sequence[float], more: float = 0.0
    ) -> kernel.Decision:
        """Decide it for these bounds and rates, with ``more`` gain in every row."""
        law = self.law
        if more:
            law = replace(law, eta=tuple(k + Fraction(more) for k in law.eta))
        return kernel.decide(self.model, law, self.stated(bounds, rate), MOST_BOXES)

    def stated(
        self, bounds: Sequence[float] | FloatArray, rate: Sequence[float]
    ) -> kernel.Reaching:
        """Return it as the kernel decides it."""
        loads, rates = (tuple(map(Fraction, v)) for v in (bounds, rate))
        return kernel.Reaching(self.region, loads, rates)

    def largest(self, load: FloatArray, rate: Sequence[float]) -> Largest:
        """Return the largest factor on a load that is overcome."""
        least = self.decide(0.0 * load, rate)
        if least.kind != "proved":
            return Largest(0.0, 0.0, least)
        spare = np.array([float(k) for k in self.law.eta]) - rate
        pushed = self.weights @ load
        ratios = spare[pushed > 0] / pushed[pushed > 0]
        guess = float(ratios.min(initial=math.inf)) * 0.9
        usable = math.isfinite(guess) and guess > 0
        return largest(lambda t: self.decide(t * load, rate), guess if usable else 1.0,
                       self.tolerance)  # fmt: skip

    def verdict(self, bounds: Sequence[float], rate: Sequence[float]) -> Verdict:
        """Decide it; the margin is what is left of (16) at its smallest, or the gain it lacks."""
        found = self.decide(bounds, rate)
        guess = max(0.1 * float(max(self.law.eta)), 1e-3)
        if found.kind == "proved":
            margin = largest(
                lambda more: self.decide(bounds, [r + more for r in rate]), guess, self.tolerance
            ).proved
        else:
            short = largest(
                lambda inverse: self.decide(bounds, rate, 1 / inverse), 1 / guess, self.tolerance
            )
            margin = -1 / short.proved if short.proved else math.nan
            if short.proved and short.failed and short.failed.kind == found.kind:
                found = replace(found, witness=short.failed.witness)
        return verdict_on(self.stated(bounds, rate), self.model, found, margin, "1/s")

    def alone(self, j: int, rate: Sequence[float]) -> DisturbanceBound:
        """What is overcome of a disturbance on coordinate j alone."""
        found = self.largest(np.eye(self.mechanism.n)[j], rate)
        witness = dict(found.failed.witness) if found.failed else {}
        return self.bound(j, found.proved, found.refuted, witness)

    def bound(
        self, j: int, proved: float, refuted: float, witness: dict[str, float]
    ) -> DisturbanceBound:
        """Return these figures of coordinate j with their units."""
        mechanism = self.mechanism
        coordinate, B, m = mechanism.coordinates[j], mechanism.B, mechanism.m
        as_input, input_unit = math.nan, ""
        if j < m and np.count_nonzero(B - np.diag(np.diag(B))) == 0:
            as_input, input_unit = proved / abs(float(B[j, j])), mechanism.inputs[j].unit
        return DisturbanceBound(
            coordinate.name, j < m, proved, refuted, mechanism.force_units[j], witness, as_input,
            input_unit,
        )  # fmt: skip


@dataclass(frozen=True)
class ReachingClaim(Claim):
    """The law overcomes disturbances over a region of positions, and reaches the surface.

    ``region``: coordinate name to (low, high), SI units; coordinates left out stay at the target.
    ``eta``: reaching rate η_i ≥ 0 that (16) leaves, (m,). ``disturbance``: bounds |g_j| ≤ ḡ_j, all
    acting at once, (n,), N m or N.
    """

    region: Box
    eta: tuple[float, ...]
    disturbance: tuple[float, ...]

    def decide(self, mechanism: Mechanism, surface: Surface, law: ReachingLaw) -> Verdict:
        """Decide it as :func:`reaching` does for the gains of the reaching law."""
        condition = _Condition.of(mechanism, surface, self.region, law, 1e-3)
        return condition.verdict(self.disturbance, self.eta)

    def stated(self, mechanism: Mechanism, verdict: Verdict) -> kernel.Claim:
        """Return it as the kernel decides it."""
        bounds, rate = (tuple(map(Fraction, v)) for v in (self.disturbance, self.eta))
        return kernel.Reaching(exact_region(mechanism, self.region), bounds, rate)


@sentence.register
def _(claim: kernel.Reaching, model: Model) -> str:
    loads = ", ".join(
        f"{p.name}: {inward(v, 6)} {'N m' if p.unit == 'rad' else 'N'}"
        for p, v in zip(model.positions, claim.disturbance, strict=True)
        if v
    )
    what = f"overcomes every disturbance on {loads} at most," if loads else "reaches the surface"
    rates = ", ".join(inward(v, 6) for v in claim.rate)
    return (
        f"the law {what} {region_words(model.positions, claim.region)}: (16) with η = {rates}, "
        "wherever |s_i| ≥ ε_i, the plant the model, the inputs renewed at every instant and not "
        "limited; motions that leave these positions are not covered"
    )
