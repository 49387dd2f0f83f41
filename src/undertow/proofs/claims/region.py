"""The claim that motions on the surface converge from a region that contains a stated start."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Self

import numpy as np
import sympy as sp

from undertow.base.verdict import Verdict, inward, within
from undertow.law import ReachingLaw, Surface
from undertow.models.mechanism import Mechanism
from undertow.proofs.claims.claim import Box, Claim, Readers, box_of, floats_of
from undertow.proofs.intervals.exact_model import exact_number
from undertow.proofs.intervals.taylor import TaylorProgram
from undertow.proofs.intervals.taylor_kernel import bounds
from undertow.proofs.region.lyapunov import LyapunovFunction
from undertow.proofs.region.motion import SurfaceMotion
from undertow.proofs.region.region import verify_region
from undertow.symbolic import Tape

__all__ = ["RegionClaim", "reaches"]

#: Functions of one region that are read.
LONGEST_CHAIN = 200


def _chain(listed: Sequence[Mapping[str, Any]]) -> tuple[LyapunovFunction, ...]:
    if not 0 < len(listed) <= LONGEST_CHAIN:
        raise ValueError(f"a chain of {len(listed)} functions")
    return tuple(LyapunovFunction.from_dict(item) for item in listed)


@dataclass(frozen=True, eq=False)
class RegionClaim(Claim):
    """The component of {V ≤ 1} around 0 is a region of attraction and contains a start.

    Parameters
    ----------
    functions
        A chain of V from the innermost set to the outermost, for
        :func:`undertow.proofs.verify_region`.
    start
        A point y = (q_u, q̇_u, w) inside, (N,); the line to it from 0 is inside too.
    parameters
        Parameters that are only known to lie in [low, high], SI units.
    """

    kind: ClassVar[str] = "surface region"
    reads: ClassVar[Readers] = {"functions": _chain, "start": floats_of, "parameters": box_of}
    functions: tuple[LyapunovFunction, ...]
    start: tuple[float, ...]
    parameters: Box = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """Return its numbers as JSON values, the box only where there is one."""
        data = super().to_dict()
        return {k: v for k, v in data.items() if k != "parameters" or v}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """Rebuild from :meth:`to_dict`, or from one function alone."""
        listed = {} if "functions" in data else {"functions": [data["function"]]}
        return super().from_dict({"parameters": {}, **data, **listed})

    def sentence(self, motion: SurfaceMotion) -> str:
        """Return in words what is claimed.

        The line from 0 to the start is inside: with one entry it may be rounded towards 0.
        """
        away = {n: v for n, v in zip(motion.names, self.start, strict=True) if v}
        points = [f"{n} = {inward(v, 6) if len(away) == 1 else repr(v)}" for n, v in away.items()]
        ranges = "".join(f", for every {n} in {within(*v)}" for n, v in self.parameters.items())
        return (
            "a region of attraction on the surface, non-singular and compact, contains "
            f"{', '.join(points) or 'the target'}{ranges}, the inputs not limited"
        )

    def decide(
        self, mechanism: Mechanism, surface: Surface, law: ReachingLaw, *, seconds: float = 600.0
    ) -> Verdict:
        """Decide it; the margin is the start's distance from 0."""
        motion = SurfaceMotion(mechanism, surface)
        own = {p.name: p.value for p in mechanism.parameters}
        for name, (low, high) in self.parameters.items():
            if not low <= own[name] <= high:
                raise ValueError(f"a box [{low:g}, {high:g}] of {name} without its {own[name]:g}")
        claim = self.sentence(motion)
        verdict = verify_region(
            motion, self.functions, parameters=self.parameters, max_seconds=seconds
        )
        verdict = replace(verdict, claim=claim)
        if not verdict:
            return verdict
        if not reaches(self.functions[-1], self.start):
            return Verdict(claim, "undecided", method="the stated start is not shown inside")
        return replace(
            verdict,
            margin=float(np.linalg.norm(self.start)),
            witness=dict(zip(motion.names, self.start, strict=True)),
        )


def reaches(V: LyapunovFunction, point: Sequence[float], pieces: int = 512) -> bool:
    """Whether V < 1 on the whole line from 0 to a point, outward-rounded: same component as 0.

    Pieces of the line on which it is not seen are cut, some times.
    """
    size = len(V.scale)
    if len(point) != size or (V.stretch is not None and abs(point[0]) >= V.pole):
        return False
    part = sp.Symbol("_part", real=True)
    tape = Tape()
    y = tape.matrix(sp.Matrix([exact_number(v) * part for v in point]))
    value, _ = V.build_graph(tape, list(y), [sp.Integer(0)] * size)
    program = TaylorProgram.of(tape, [part], [], [value])
    ends = np.linspace(0.0, 1.0, pieces + 1)
    low, high = ends[:-1], ends[1:]
    for _ in range(12):
        _, above = bounds(program(low[None], high[None]), 1)
        left = ~(above[0] < 1.0)
        if not left.any():
            return True
        low, high = low[left], high[left]
        middle = 0.5 * (low + high)
        low, high = np.concatenate([low, middle]), np.concatenate([middle, high])
    return False
