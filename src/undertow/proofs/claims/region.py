"""The claim that motions on the surface converge from a region that contains a stated start.

The kernel decides it; here a chain of Lyapunov functions is written in the kernel's numbers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import cast

import numpy as np
from numpy.typing import ArrayLike

from undertow.base.arguments import require
from undertow.base.verdict import Kind, Verdict, exactly, inward, within
from undertow.law import ReachingLaw, Surface
from undertow.models.mechanism import Mechanism
from undertow.proofs.claims.claim import Box, Claim
from undertow.proofs.claims.model_data import law_of, model_of
from undertow.proofs.claims.words import sentence, verdict_on
from undertow.proofs.claims.written import claim_data
from undertow.proofs.kernel import claims as kernel
from undertow.proofs.kernel.model import Matrix, Model
from undertow.proofs.kernel.region import Function, Stage, Stretch, on_the_line
from undertow.proofs.region.lyapunov import LyapunovFunction
from undertow.proofs.region.motion import SurfaceMotion


@dataclass(frozen=True, eq=False)
class RegionClaim(Claim):
    """Motions on the surface converge from a set that contains a start.

    ``functions``: a chain of V from the innermost set to the outermost. ``start``: a point y =
    (q_u, q̇_u, w) inside, (N,); the line to it from 0 is inside too. ``parameters``: parameters
    that are only known to lie in [low, high], SI units.
    """

    functions: tuple[LyapunovFunction, ...]
    start: tuple[float, ...]
    parameters: Box = field(default_factory=dict)

    def decide(self, mechanism: Mechanism, surface: Surface, law: ReachingLaw) -> Verdict:
        """Let the kernel decide it; the margin is the start's distance from 0."""
        model = model_of(mechanism)
        own = kernel.read_claim(claim_data(self._own()), model)
        answer = kernel.decide(model, law_of(mechanism, surface, law), own)
        reach = float(np.linalg.norm(self.start)) * (1 - 1e-12)
        margin = reach if answer.kind == "proved" else float("nan")
        return verdict_on(own, model, answer, margin, mechanism.coordinates[mechanism.m].unit)

    def stated(self, mechanism: Mechanism, verdict: Verdict) -> kernel.Claim:
        """Return the kernel's claim."""
        return self._own()

    def _own(self) -> kernel.SurfaceRegion:
        functions = tuple(_function(V) for V in self.functions)
        stretch = _stretch(self.functions[0])
        alike = all(_stretch(V) == stretch for V in self.functions)
        require(
            alike and None not in functions, "functions of a region", limit="bounded, one stretch"
        )
        return kernel.SurfaceRegion(
            stretch, cast(tuple[Function, ...], functions), tuple(map(Fraction, self.start)),
            _exact(self.parameters),
        )  # fmt: skip


def _rows(matrix: ArrayLike) -> Matrix:
    return tuple(tuple(map(Fraction, row)) for row in np.asarray(matrix, dtype=float).tolist())


def _exact(box: Box) -> dict[str, tuple[Fraction, Fraction]]:
    return {k: (Fraction(low), Fraction(high)) for k, (low, high) in box.items()}


def _stretch(V: LyapunovFunction) -> Stretch:
    if V.stretch is None:
        return Stretch((), None)
    return Stretch(tuple(_rows(S) for S in V.stretch), Fraction(V.pole))


def _function(V: LyapunovFunction) -> Function | None:
    """V in the kernel's numbers, with GᵀG = the guard's matrix and G lower triangular."""
    if V.guard is None:
        return None
    inverse = np.linalg.inv(V.guard.scale)
    G = np.linalg.cholesky((inverse.T @ inverse)[::-1, ::-1])[::-1, ::-1].T
    exponents = tuple(tuple(row) for row in np.asarray(V.exponents).tolist())
    coefficients = tuple(map(Fraction, np.asarray(V.coefficients, dtype=float).tolist()))
    return Function(_rows(np.linalg.inv(V.scale)), _rows(np.tril(G)), exponents, coefficients)


def verify_region(
    motion: SurfaceMotion,
    V: LyapunovFunction | Sequence[LyapunovFunction],
    *,
    parameters: Mapping[str, tuple[float, float]] | None = None,
    max_boxes: int = 2_000_000,
    proved: int = 0,
) -> Verdict:
    """Decide by the kernel whether motions on a surface converge from {V ≤ 1} around the target.

    Parameters
    ----------
    motion
        The sliding dynamics.
    V
        The function, or a chain of functions from the innermost set to the outermost.
    parameters
        Parameters that are only known to lie in [low, high], SI units; the set is
        then one for every constant value in the box (with the surface as it is).
    max_boxes
        Effort for each function.
    proved
        So many functions at the head of the chain were proved before, with these very
        parameters: they are taken for granted.  For searches; a proof leaves it at 0.

    Returns
    -------
    Verdict
        ``refuted``: at the witness V ≤ 1, and V does not fall though the function before is
        > 1, or the model is not regular.  ``undecided``: the witness is where it got stuck.
        ``details["stage"]`` counts the function that it is about, from 1.

    Raises
    ------
    InvalidInputError
        For an unknown parameter, an empty interval, no function, or one of another size.
    """
    chain = [V] if isinstance(V, LyapunovFunction) else list(V)
    box = dict(parameters or {})
    require(chain, "chain of Lyapunov functions", "empty", "one or more")
    for W in chain:
        size = W.exponents.shape[1]
        require(size == motion.size, "size of a Lyapunov function", size, motion.size)
    unknown = set(box) - {p.name for p in motion.parameters}
    require(not unknown, "parameter box", ", ".join(sorted(unknown)))
    for name, (low, high) in box.items():
        good = np.isfinite([low, high]).all() and low <= high
        require(good, f"parameter box of '{name}'", (low, high), "finite, low ≤ high")
    model = model_of(motion.mechanism)
    law = law_of(motion.mechanism, motion.surface, ReachingLaw())
    claim = "motions on the surface converge from {V ≤ 1} around the target"
    method, boxes, before = "quadratic Taylor models, branch and bound", 0, None
    varied = [p.name for p in motion.parameters if p.name in box]
    for k, W in enumerate(chain, start=1):
        function, stretch, details = _function(W), _stretch(W), {"stage": k, "boxes": boxes}
        if k > 1 and stretch != _stretch(chain[k - 2]):
            why = f"{method}: functions {k - 1} and {k} have different stretches"
            return Verdict(claim, "undecided", method=why, details=details)
        if function is None:
            why = f"{method}: no ellipsoid was found that holds {{V ≤ 1}}"
            return Verdict(claim, "undecided", method=why, details=details)
        if k > proved:
            found = Stage(model, law, stretch, function, before, _exact(box)).decide(max_boxes)
            boxes += found.boxes
            if found.kind != "proved":
                witness = dict(zip([*motion.names, *varied], found.point, strict=False))
                kind, why = cast(Kind, found.kind), f"{method}: {found.why}"
                details["boxes"] = boxes
                return Verdict(claim, kind, witness=witness, method=why, details=details)
        before = function
    return Verdict(claim, "proved", method=method, details={"stage": k, "boxes": boxes})


def reaches(V: LyapunovFunction, point: Sequence[float]) -> bool:
    """Whether V ≤ 1 on the whole line from 0 to a point, inside the guard."""
    function, stretch = _function(V), _stretch(V)
    inside = stretch.L is None or abs(Fraction(point[0])) < stretch.L
    if function is None or not inside or len(point) != len(V.scale):
        return False
    return on_the_line(stretch, function, list(map(Fraction, point)), 10_000).kind == "proved"


@sentence.register
def _(claim: kernel.SurfaceRegion, model: Model) -> str:
    names = kernel.surface_names(model)
    away = {k: v for k, v in zip(names, claim.contains, strict=True) if v}
    exact = len(away) > 1  # with one entry the point may be rounded towards 0
    points = [f"{k} = {exactly(v) if exact else inward(v, 6)}" for k, v in away.items()]
    others = "".join(f"{k} = " for k in names if k not in away)
    rest = f" with {others}0" if others else ""
    where = f"{', '.join(points)}{rest}, w = q_a + λ_a⁻¹ λ_u q_u," if points else "it"
    ranges = "".join(f", for every {k} in {within(*ends)}" for k, ends in claim.plant.items())
    return (
        "every motion on the surface from a compact set around the target that contains "
        f"{where} converges to the target{ranges}, non-singular all the way, in the "
        f"union of {len(claim.functions)} such sets; the plant else the model, no "
        "other force, the inputs not limited"
    )
