"""Whether the law exists all over a region of positions.

α_a − α_u M_uu⁻¹ M_auᵀ must be invertible there.  The kernel decides by how much; here the largest
numbers that it proves are looked for.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from fractions import Fraction

from undertow.base.arguments import one_of, require
from undertow.base.verdict import Verdict, inward
from undertow.law import ReachingLaw, Surface, check_surface_shape
from undertow.models.mechanism import Mechanism
from undertow.proofs.claims.claim import Box, Claim
from undertow.proofs.claims.model_data import law_of, model_of
from undertow.proofs.claims.words import region_words, sentence, verdict_on
from undertow.proofs.kernel import claims as kernel
from undertow.proofs.kernel.model import Model

#: The least ratio that is asked for.
TINY = 1e-9

#: Relative, of the margin; and the largest factor by which a region may grow.
MARGIN, LARGEST = 1e-4, 1e3

#: Effort of a decision before it gives up, and of one that is not worth as much.
MOST_BOXES, FEW = 20_000, 100

#: Largest and smallest factor on the first guess that are tried.
FAR = 1e9


def exact_region(mechanism: Mechanism, region: Box) -> dict[str, tuple[Fraction, Fraction]]:
    """Return the rational numbers that the ends of a region of positions are.

    Raises InvalidInputError for an unknown coordinate or an interval that is empty, not finite or
    leaves out the target, from which the non-singular set must be connected.
    """
    names = [c.name for c in mechanism.coordinates]
    for name, (low, high) in region.items():
        one_of("region of positions", name, names)
        good = math.isfinite(low) and math.isfinite(high) and low <= 0 <= high
        limit = "finite, with low ≤ 0 ≤ high: the target must be inside"
        require(good, f"region of '{name}'", (low, high), limit)
    return {k: (Fraction(float(a)), Fraction(float(b))) for k, (a, b) in region.items()}


@dataclass(frozen=True)
class Largest:
    """The largest number for which something was proved.

    ``proved``: that number, 0 for none and ``inf`` where it has no end. ``refuted``: the smallest
    for which it is false, ``inf`` where none was found. ``failed``: the decision at the smallest
    number for which it was not proved.
    """

    proved: float
    refuted: float
    failed: kernel.Decision | None


def largest(
    decide: Callable[[float], kernel.Decision],
    guess: float,
    tolerance: float,
    limit: float = math.inf,
) -> Largest:
    """Return the largest number up to a limit, to a relative tolerance, that is proved."""
    low, high, refuted, failed = 0.0, math.inf, math.inf, None
    value = min(guess, limit)
    while not low or math.isinf(high) or high - low > tolerance * high:
        found = decide(value)
        if found.kind == "proved":
            low = value
            if low >= limit or low > FAR * guess:
                return Largest(low if low >= limit else math.inf, math.inf, None)
        else:
            high, failed = value, found
            if found.kind == "refuted":
                refuted = value
            if high < guess / FAR:
                return Largest(0.0, refuted, failed)
        if math.isinf(high):
            value = min(2 * low, limit)
        else:
            value = 0.5 * (low + high) if low else 0.25 * high
    return Largest(low, refuted, failed)


def nonsingular(
    mechanism: Mechanism, surface: Surface, region: Box, *, max_boxes: int = MOST_BOXES
) -> Verdict:
    """Decide whether the law exists all over a region, the general form of (37).

    Parameters
    ----------
    region
        Coordinate name to (low, high), SI units, the target inside; coordinates left out
        stay at the target.
    max_boxes
        Effort of a decision before it gives up.

    Returns
    -------
    Verdict
        ``margin`` is a proved lower bound of det Γ(q)/det Γ(0) over the region, with
        Γ = α_a − α_u M_uu⁻¹ M_auᵀ; ``refuted``: Γ is singular on the way to the witness.
    """
    check_surface_shape(mechanism, surface)
    box = exact_region(mechanism, region)
    model, law = model_of(mechanism), law_of(mechanism, surface, ReachingLaw())

    def decide(ratio: float, boxes: int = max_boxes) -> kernel.Decision:
        return kernel.decide(model, law, kernel.Nonsingular(box, Fraction(ratio)), boxes)

    # A Γ that does not depend on the position keeps all of it, to rounding.
    whole = (ratio for ratio in (1.0, 1 - 1e-12) if decide(ratio, FEW).kind == "proved")
    margin = next(whole, 0.0)
    if not margin and decide(TINY).kind == "proved":
        margin = largest(decide, 0.5, MARGIN, 1.0).proved or TINY
    found, claim = decide(margin or TINY), kernel.Nonsingular(box, Fraction(margin or TINY))
    if found.kind == "undecided":
        found = replace(found, why=f"{found.why}, gave up")
    return verdict_on(claim, model, found, margin if found.kind == "proved" else math.nan)


def singular_distance(
    mechanism: Mechanism, surface: Surface, region: Box, *, tolerance: float = 1e-6
) -> tuple[float, float]:
    """Return by what factor a region may grow: proved non-singular, and refuted.

    Parameters
    ----------
    tolerance
        Relative gap between the two factors.

    Returns
    -------
    proved, refuted : float
        The region scaled by ``proved`` is non-singular; scaled by ``refuted`` it is not
        (``inf`` where no singularity is within the largest factor tried: 1000, or where an angle
        is ±π, beyond which nothing is new).
    """
    limit, box = LARGEST, exact_region(mechanism, region)
    for c in mechanism.coordinates:
        reach = [float(abs(v)) for v in box.get(c.name, ()) if v]
        if c.unit == "rad" and reach:
            limit = min(limit, math.pi / min(reach))
    model, law = model_of(mechanism), law_of(mechanism, surface, ReachingLaw())

    def decide(factor: float) -> kernel.Decision:
        exact = Fraction(factor)
        scaled = {k: (a * exact, b * exact) for k, (a, b) in box.items()}
        return kernel.decide(model, law, kernel.Nonsingular(scaled, Fraction(TINY)), MOST_BOXES)

    found = largest(decide, 1.0, tolerance, limit)
    return found.proved, found.refuted


@dataclass(frozen=True)
class NonsingularClaim(Claim):
    """The law exists all over a region of positions.

    ``region``: coordinate name to (low, high), SI units; coordinates left out stay at the target.
    """

    region: Box

    def decide(self, mechanism: Mechanism, surface: Surface, law: ReachingLaw) -> Verdict:
        """Decide it as :func:`nonsingular` does."""
        return nonsingular(mechanism, surface, self.region)

    def stated(self, mechanism: Mechanism, verdict: Verdict) -> kernel.Claim:
        """Return it with the ratio that was proved."""
        return kernel.Nonsingular(exact_region(mechanism, self.region), Fraction(verdict.margin))


@sentence.register
def _(claim: kernel.Nonsingular, model: Model) -> str:
    where = region_words(model.positions, claim.region)
    return (
        f"the law exists {where}: M is positive definite, B and α_a − α_u M_uu⁻¹ M_auᵀ are "
        f"non-singular, whose determinant keeps {inward(claim.ratio, 6)} of that at the target"
    )
