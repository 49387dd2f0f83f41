"""Whether the law exists all over a region of positions.

α_a − α_u M_uu⁻¹ M_auᵀ must be invertible there.  Branch and bound in ball arithmetic looks for the
least determinant, relative to the target; the kernel decides that it is no less.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

from undertow.base.arguments import one_of
from undertow.base.verdict import Kind, Verdict, inward, within
from undertow.law import ReachingLaw, Surface, check_surface_shape
from undertow.models.mechanism import Mechanism
from undertow.proofs.claims.claim import Box, Claim
from undertow.proofs.claims.model_data import law_of, model_of
from undertow.proofs.intervals.branch import BallFunction, minimise_proved
from undertow.proofs.intervals.exact_model import exact_matrix, exact_mechanism
from undertow.proofs.intervals.interval import ball, compile_outward
from undertow.proofs.intervals.require import require
from undertow.proofs.kernel import claims as kernel
from undertow.symbolic import Tape


def region_box(mechanism: Mechanism, region: Box) -> list[tuple[float, float]]:
    """Return the box of positions, one (low, high) per coordinate.

    Raises
    ------
    InvalidInputError
        For an unknown coordinate or an interval that is empty, not finite or leaves out
        the target, from which the non-singular set must be connected.
    """
    names = [c.name for c in mechanism.coordinates]
    box = [(0.0, 0.0)] * mechanism.n
    for name, (low, high) in region.items():
        one_of("region of positions", name, names)
        good = math.isfinite(low) and math.isfinite(high) and low <= 0 <= high
        limit = "finite, with low ≤ 0 ≤ high: the target must be inside"
        require(good, f"region of '{name}'", (low, high), limit)
        box[names.index(name)] = (float(low), float(high))
    return box


def region_words(mechanism: Mechanism, region: Box) -> str:
    """Return a region of positions in words, its ends rounded inwards."""
    units = {c.name: c.unit for c in mechanism.coordinates}
    parts = [
        f"|{k}| ≤ {inward(b, 6)} {units[k]}" if a == -b else f"{k} in {within(a, b)} {units[k]}"
        for k, (a, b) in region.items()
        if (a, b) != (0.0, 0.0)
    ]
    if not parts:
        return "at the target"
    rest = len(parts) < mechanism.n
    return f"for {', '.join(parts)}" + (", the other coordinates at the target" if rest else "")


#: A ratio that is claimed of a region where none was found.
TINY = 1e-9


def exact_box(region: Box) -> dict[str, tuple[Fraction, Fraction]]:
    """Return the rational numbers that the ends of a region are."""
    return {k: (Fraction(float(a)), Fraction(float(b))) for k, (a, b) in region.items()}


def _gamma(mechanism: Mechanism, surface: Surface) -> tuple[BallFunction, BallFunction]:
    """Return det Γ(q)/det Γ(0) and a lower bound of Γ's smallest singular value."""
    tape = Tape()
    mechanism = exact_mechanism(mechanism)
    part = mechanism.partition(tape)
    gamma = tape.matrix(exact_matrix(surface.alpha_a) - exact_matrix(surface.alpha_u) * part.X)
    _, determinant = tape.adjugate(gamma)
    frobenius = tape.let(sum(entry**2 for entry in gamma))
    run = compile_outward(
        tape, [*mechanism.q, *mechanism.parameter_symbols], [determinant, frobenius]
    )
    parameters = [ball(v) for v in mechanism.parameter_values]
    m, zero = mechanism.m, ball(0.0)

    def evaluate(q: list[Any]) -> list[Any]:
        # A Γ that does not depend on the position comes back as whole numbers.
        return [zero + value for value in run(*q, *parameters)]

    target = evaluate([zero] * mechanism.n)[0]

    def ratio(q: list[Any]) -> Any:
        return evaluate(q)[0] / target

    def distance(q: list[Any]) -> Any:
        # |det| = Π σ_i and the AM-GM inequality on the m − 1 larger ones.
        value, square = evaluate(q)
        size = abs(value)
        return size if m == 1 else size / ((square / (m - 1)).sqrt() ** (m - 1))

    return ratio, distance


def nonsingular(
    mechanism: Mechanism, surface: Surface, region: Box, *, max_boxes: int = 20_000
) -> Verdict:
    """Decide whether the law exists all over a region, the general form of (37).

    Parameters
    ----------
    region
        Coordinate name to (low, high), SI units, the target inside; coordinates left out
        stay at the target.
    max_boxes
        Effort before giving up.

    Returns
    -------
    Verdict
        ``margin`` is a proved lower bound of det Γ(q)/det Γ(0) over the region, with
        Γ = α_a − α_u M_uu⁻¹ M_auᵀ; ``refuted``: the ratio is ≤ 0 at the witness, so Γ is
        singular on the way there.  ``details["smallest singular value"]`` bounds the
        2-norm distance of Γ from the singular matrices, all over the region.
    """
    check_surface_shape(mechanism, surface)
    box = region_box(mechanism, region)
    names = [c.name for c in mechanism.coordinates]
    words = region_words(mechanism, region)
    claim = f"the law exists {words}: α_a − α_u M_uu⁻¹ M_auᵀ is non-singular"
    method = "ball arithmetic, branch and bound"
    ratio, distance = _gamma(mechanism, surface)
    found = minimise_proved(ratio, box, stop_below=0.0, max_boxes=max_boxes)
    held = True if found.lower > 0 else False if found.value <= 0 else None
    verdict = found.verdict(claim, names, "", method, held)
    model, law = model_of(mechanism), law_of(mechanism, surface, ReachingLaw())
    for slack in (1e-13, 1e-9, 1e-6):
        least = found.lower * (1 - slack) if held else TINY
        stated = kernel.Nonsingular(exact_box(region), Fraction(least))
        decided = kernel.decide(model, law, stated, max_boxes)
        if decided.kind == "proved" or not held:
            break
    method = decided.why
    if decided.kind != verdict.kind or not held:
        margin = min(verdict.margin, least) if held else verdict.margin
        witness = decided.witness or verdict.witness
        kind: Kind = "refuted" if decided.kind == "refuted" else "undecided"
        return replace(
            verdict, kind=kind, margin=margin, witness=witness, method=f"{method}, gave up"
            if kind == "undecided" else method,
        )  # fmt: skip
    verdict = replace(verdict, margin=least, method=method)
    near = minimise_proved(distance, box, max_boxes=max_boxes)
    details = {**verdict.details, "smallest singular value": max(near.lower, 0.0)}
    return replace(verdict, details=details)


def singular_distance(
    mechanism: Mechanism,
    surface: Surface,
    region: Box,
    *,
    limit: float = 1e3,
    tolerance: float = 1e-6,
    max_boxes: int = 20_000,
) -> tuple[float, float]:
    """Return by what factor a region may grow: proved non-singular, and refuted.

    Parameters
    ----------
    limit
        Largest factor tried.  Angles beyond ±π add nothing new, so it is also cut there.
    tolerance
        Relative gap between the two factors.

    Returns
    -------
    proved, refuted : float
        The region scaled by ``proved`` is non-singular; scaled by ``refuted`` it is not
        (``inf`` where no singularity is within the limit).
    """
    box = region_box(mechanism, region)
    for c, (a, b) in zip(mechanism.coordinates, box, strict=True):
        if c.unit == "rad" and max(-a, b) > 0:
            limit = min(limit, math.pi / min(v for v in (-a, b) if v > 0))
    ratio, _ = _gamma(mechanism, surface)

    def holds(factor: float) -> bool | None:
        scaled = [(a * factor, b * factor) for a, b in box]
        found = minimise_proved(
            ratio, scaled, stop_below=0.0, stop_above=0.0, absolute=0.0, max_boxes=max_boxes
        )
        return True if found.lower > 0 else False if found.value <= 0 else None

    low, high = 0.0, limit
    if holds(limit):
        return limit, math.inf
    refuted = math.inf
    while high - low > tolerance * high:
        middle = 0.5 * (low + high)
        answer = holds(middle)
        low, high = (middle, high) if answer else (low, middle)
        if answer is False:
            refuted = middle
    return low, refuted


@dataclass(frozen=True)
class NonsingularClaim(Claim):
    """The law exists all over a region of positions.

    Parameters
    ----------
    region
        Coordinate name to (low, high), SI units; coordinates left out stay at the target.
    """

    region: Box

    def decide(self, mechanism: Mechanism, surface: Surface, law: ReachingLaw) -> Verdict:
        """Decide it as :func:`nonsingular` does."""
        return nonsingular(mechanism, surface, self.region)

    def stated(self, mechanism: Mechanism, verdict: Verdict) -> kernel.Claim:
        """Return it with the ratio that was proved."""
        return kernel.Nonsingular(exact_box(self.region), Fraction(verdict.margin))
