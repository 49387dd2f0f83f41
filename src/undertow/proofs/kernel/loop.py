"""The closed loop from boxes of starts: tubes of (q, p, s) that end in a terminal ellipsoid.

Coordinates and rates are those of Lemma 8 of ``docs/certificate-format.md``.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from undertow.proofs.kernel import compiled as ops
from undertow.proofs.kernel.graph import FloatArray, hull
from undertow.proofs.kernel.model import Law, Matrix, Model, System, system
from undertow.proofs.kernel.tube import Field, Tube

#: Steps of one tube, and of all before the checker gives up; the thinnest part of the starts.
LONGEST, MOST_STEPS, THINNEST = 2000, 500_000, 2.0**-16


@dataclass(frozen=True)
class Arrival:
    """Whether every tube arrived, where the first one that did not began, and what it took."""

    all: bool
    lost: FloatArray
    tubes: int
    steps: int
    latest: float


class Loop:
    """One closed loop, and the set {|W x| ≤ radius} that its motions are to enter."""

    def __init__(self, model: Model, law: Law, W: Matrix, radius: Fraction) -> None:
        own, plain = System(model, law, momenta=True), system(model, law)
        graph = own.graph
        self.field, self.fixed = Field(graph, own.sliding()), own.fixed()
        rows = [
            graph.sum(
                graph.make("mul", graph.number(w), x) for w, x in zip(row, own.x, strict=True)
            )
            for row in W
        ]
        self.rows, self.radius = graph.program(rows), hull(radius, radius)[0]
        self.regular = graph.program([*own.pivots, own.B_determinant, own.gamma_determinant])
        self.coordinates = plain.graph.program(plain.momentum_and_surface())

    def inside(self, tube: Tube) -> bool:
        """Whether a set of (q, p, s) lies in the set that is to be entered."""
        return bool(ops.norm(tube.image(self.rows)) <= self.radius)

    def follow(self, box: FloatArray, step: float) -> tuple[int, bool]:
        """Return how many steps a tube from a box of x (2n, 2) takes, and whether it arrives."""
        tube = Tube.of(self.field, self.fixed, box)
        if not tube.map(self.coordinates):
            return 0, False
        pivots = len(self.regular.outputs) - 2
        for k in range(LONGEST):
            if self.inside(tube):
                return k, True
            stay = tube.advance(step)
            if stay is None:
                return k, False
            low, high = np.vstack([stay, self.fixed]).T.copy()
            ends = self.regular(low, high)[:, 0]
            kept = (ends[:, 0] > 0.0) | (ends[:, 1] < 0.0)
            if not (kept.all() and (ends[:pivots, 0] > 0.0).all()):
                return k, False
        return LONGEST, False

    def arrive(self, boxes: FloatArray, step: float) -> Arrival:
        """Follow boxes (K, 2n, 2), halved across the relatively widest side where they are lost."""
        size = np.maximum(boxes[..., 1].max(axis=0) - boxes[..., 0].min(axis=0), 1e-300)
        todo, tubes, steps, latest = [*boxes], 0, 0, 0
        while todo:
            part, tubes = todo.pop(), tubes + 1
            taken, there = self.follow(part, step)
            steps += taken
            if there:
                latest = max(latest, taken)
                continue
            width = part[:, 1] - part[:, 0]
            at = int((width / size).argmax())
            middle = 0.5 * part[at, 0] + 0.5 * part[at, 1]
            if steps > MOST_STEPS or not width[at] > size[at] * THINNEST:
                return Arrival(False, part.mean(axis=1), tubes, steps, latest * step)
            lower, upper = part.copy(), part.copy()
            lower[at, 1] = upper[at, 0] = middle
            todo += [lower, upper]
        return Arrival(True, np.empty(0), tubes, steps, latest * step)
