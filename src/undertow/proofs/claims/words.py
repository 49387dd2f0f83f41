"""What a claim states, in words that are made of the numbers that the kernel decides.

Extents, rates and radii are rounded towards 0, ends of intervals inwards, so that no sentence says
more than what is decided; a file's own texts are never printed.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from functools import singledispatch

import numpy as np

from undertow.base.verdict import exactly, inward, within
from undertow.proofs.kernel import claims as kernel
from undertow.proofs.kernel.claims import Region
from undertow.proofs.kernel.model import Model, Quantity


def region(positions: Sequence[Quantity], box: Region) -> str:
    """Return a region of positions in words."""
    units = {p.name: p.unit for p in positions}
    parts = [
        f"|{k}| ≤ {inward(b, 6)} {units[k]}".rstrip() if a == -b
        else f"{k} in {within(a, b)} {units[k]}".rstrip()
        for k, (a, b) in box.items()
        if a != 0 or b != 0
    ]  # fmt: skip
    if not parts:
        return "at the target"
    rest = ", the other coordinates at the target" if len(parts) < len(positions) else ""
    return f"for {', '.join(parts)}{rest}"


def limits(model: Model) -> str:
    """Return the input limits in words, each as it is."""
    parts = [
        f"|{i.name}| ≤ {'inf' if i.value is None else exactly(i.value)} {i.unit}".rstrip()
        for i in model.inputs
    ]
    return ", ".join(parts)


# -- of each kind of claim ------------------------------------------------------------------------


@singledispatch
def sentence(claim: kernel.Claim, model: Model) -> str:
    """Return the statement of a claim about a model, in words."""
    raise TypeError(f"no words for a claim of the kind {claim.kind!r}")


@sentence.register
def _(claim: kernel.Stability, model: Model) -> str:
    return (
        "motions on the surface near the target converge to it exponentially, at a rate of at "
        f"least {inward(claim.rate, 6)} 1/s, the plant the model and no other force; how near is "
        "not said, and the input is not limited"
    )


@sentence.register
def _(claim: kernel.Nonsingular, model: Model) -> str:
    where = region(model.positions, claim.region)
    return (
        f"the law exists {where}: M is positive definite, B and α_a − α_u M_uu⁻¹ M_auᵀ are "
        f"non-singular, whose determinant keeps {inward(claim.ratio, 6)} of that at the target"
    )


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
        f"the law {what} {region(model.positions, claim.region)}: (16) with η = {rates}, "
        "wherever |s_i| ≥ ε_i, the plant the model, the inputs renewed at every instant and not "
        "limited; motions that leave these positions are not covered"
    )


@sentence.register
def _(claim: kernel.TerminalEllipsoid, model: Model) -> str:
    inside = inward(Fraction(ball(claim)), 3)
    return (
        "every motion of the full closed loop, its input renewed at every instant, the plant the "
        f"model and no other force, from {{|W x| ≤ ρ}}, which holds the ball ‖x‖ ≤ {inside}, "
        f"stays there and converges, inside the layer and {limits(model)}"
    )


@sentence.register
def _(claim: kernel.SurfaceRegion, model: Model) -> str:
    names = kernel.surface_names(model)
    away = {k: v for k, v in zip(names, claim.contains, strict=True) if v}
    exact = len(away) > 1  # with one entry the point may be rounded towards 0
    points = [f"{k} = {exactly(v) if exact else inward(v, 6)}" for k, v in away.items()]
    ranges = "".join(f", for every {k} in {within(*ends)}" for k, ends in claim.plant.items())
    return (
        "every motion on the surface from a compact set around the target that contains "
        f"{', '.join(points) or 'it'} converges to the target{ranges}, non-singular all the "
        f"way, in the union of {len(claim.functions)} such sets; the plant else the model, no "
        "other force, the inputs not limited"
    )


@sentence.register
def _(claim: kernel.ClosedLoop, model: Model) -> str:
    rates = [Quantity(f"{p.name}_dot", f"{p.unit}/s") for p in model.positions]
    starts = region([*model.positions, *rates], claim.starts).replace("for ", "with ", 1)
    end = f"‖x‖ ≤ {inward(claim.ball, 6)}" if claim.ball else "the target"
    held = f"held for {exactly(claim.period)} s" if claim.period else "renewed at every instant"
    varied = ", ".join(f"{k} in {within(*ends)}" for k, ends in claim.plant.items())
    plant = f"any with {varied}" if varied else "the model"
    loads = ", ".join(inward(v, 6) for v in claim.disturbance)
    return (
        f"every motion from starts {starts}, exists for ever and converges to {end}, the law "
        f"with its layer, its input clipped to {limits(model)} and {held}, the plant {plant}, "
        f"{f'forces up to {loads}' if any(claim.disturbance) else 'no other force'}"
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
