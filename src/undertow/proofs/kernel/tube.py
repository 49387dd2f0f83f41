"""Validated integration: boxes of states that move with ẋ = F(x), by Taylor steps (Lemma 6).

A set is m + C ξ + Q r: ξ the box that it started as, C the derivative of the flow as far as
doubles carry it, Q orthonormal (Lohner), r the box of what has been added since.  The right-hand
side is code; a corner of the clip or of the layer shortens the formula of a step to the second
order and, where no bounds are found, the step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from undertow.proofs.kernel import compiled as ops
from undertow.proofs.kernel.graph import FloatArray, Graph, Program

#: Coefficients of a step, the part of a step that may have a corner inside, and the shortest.
ORDER, SHORT, SHORTEST = 12, 2.0**-5, 2.0**-10

#: Columns of C, more of which than those of the start come from corners, before a tube is lost.
MOST_COLUMNS = 600


class Field:
    """A right-hand side of the first inputs of a graph, and its analytic pieces.

    A max or min of it has two sides; where both are possible it stays in the piece.
    """

    def __init__(self, graph: Graph, rates: Sequence[int]) -> None:
        self._graph, self._rates, self._pieces = graph, rates, dict[bytes, Program]()
        self._corners = graph.corners(rates)
        operands = [graph.nodes[k][1:] for k in self._corners]
        self.whole = graph.program(rates)
        self.gaps = graph.program([graph.make("sub", a, b) for a, b in operands])

    def piece(self, gaps: FloatArray) -> tuple[Program, bool]:
        """Return the rates where the gaps of corners lie in (K, 2), and whether all are decided."""
        first, second = gaps[:, 0] >= 0.0, gaps[:, 1] <= 0.0
        key = first.tobytes() + second.tobytes()
        if key not in self._pieces:
            sides = dict[int, int]()
            for k, a, b in zip(self._corners, first, second, strict=True):
                kind, x, y = self._graph.nodes[k]
                if a or b:
                    sides[k] = x if a == (kind == "max") else y
            self._pieces[key] = self._graph.program(self._rates, sides)
        return self._pieces[key], bool((first | second).all())


@dataclass
class Tube:
    """One set of states on its way.

    Parameters
    ----------
    field
        F, (N,), of its first N inputs.
    fixed
        Enclosures of its other inputs, (F, 2).
    hull
        A box around the set now, (N, 2).
    """

    field: Field
    fixed: FloatArray
    hull: FloatArray
    m: FloatArray
    C: FloatArray
    xi: FloatArray
    Q: FloatArray
    r: FloatArray

    @classmethod
    def of(cls, field: Field, fixed: FloatArray, box: FloatArray) -> Self:
        """Start from a box of doubles, (N, 2)."""
        n = len(box)
        middle = 0.5 * box[:, 0] + 0.5 * box[:, 1]
        xi = np.array([ops.add(a, b, -v, -v) for (a, b), v in zip(box, middle, strict=True)])
        return cls(
            field, fixed, box.copy(), middle, np.eye(n), xi.reshape(n, 1, 2), np.eye(n),
            np.zeros((n, 1, 2)),
        )  # fmt: skip

    def advance(self, h: float, order: int = ORDER) -> FloatArray | None:
        """Move on by h, in shorter steps where one is not shown.

        Returns
        -------
        ndarray or None
            A box that all motions stay in on the way, (N, 2); None where they may leave the domain
            of F, or no bounds are found.
        """
        whole: FloatArray | None = None
        done, part = 0.0, 1.0
        while done < 1.0:  # parts are powers of two: h · part and their sum are exact
            stay = self._step(h * part, order, part <= SHORT)
            if stay is None:
                part *= 0.5
                if part < SHORTEST or self.C.shape[1] > MOST_COLUMNS:
                    return None
                continue
            if whole is None:
                whole = stay
            low, high = np.minimum(whole[:, 0], stay[:, 0]), np.maximum(whole[:, 1], stay[:, 1])
            whole = np.column_stack([low, high])
            done += part
            while part < 1.0 and done % (2.0 * part) == 0.0:
                part *= 2.0
        self.hull = ops.hulled(self.m, self.C, self.xi, self.Q, self.r)
        return whole

    def values(self, program: Program) -> tuple[FloatArray, FloatArray]:
        """Enclose values and derivatives over the hull, (O, 1 + N, 2), and values at m, (O, 2)."""
        return _around(program, self.hull, self.m, self.fixed)

    def image(self, program: Program) -> FloatArray:
        """Enclose values on the set, (O, 2)."""
        still = np.zeros((len(self.m), 1, 2))
        return np.asarray(ops.along(*self.values(program), self.C, self.xi, self.Q, self.r, still))

    def map(self, program: Program) -> bool:
        """Replace the set by its image; whether that is bounded."""
        around, centre = self.values(program)
        state, none = (self.m, self.C, self.xi, self.Q, self.r), np.zeros_like(self.hull)
        good = bool(ops.taylor_step(none, centre[:, None], around[:, None], 1.0, *state))
        self.hull = ops.hulled(*state)
        return good

    def _step(self, h: float, order: int, short: bool) -> FloatArray | None:
        """Move on by h; the box that motions stay in, or None where nothing is shown."""
        X, n = ops.hulled(self.m, self.C, self.xi, self.Q, self.r), len(self.m)
        stay = self._stay(X, h)
        if stay is None:
            return None
        rates = _ends(self.field.whole, stay, self.fixed)
        way = ops.reached(np.zeros_like(X), rates, h).reshape(n, 1, 2)
        gaps = _around(self.field.gaps, stay, self.m, self.fixed)
        program, decided = self.field.piece(ops.along(*gaps, self.C, self.xi, self.Q, self.r, way))
        if not decided and not short:
            return None
        low, high = np.vstack([stay, self.fixed]).T.copy()
        rest = program.series(low, high, order)[:, order, 0]
        if np.isnan(rest).any():  # a corner is inside: the short formula, Clarke's derivatives
            order = 2
            rest = program.series(low, high, order)[:, order, 0]
        low[:n] = high[:n] = self.m
        centre = program.series(low, high, order - 1)[:, :, 0]
        low[:n], high[:n] = X.T
        around = program.series(low, high, order - 1, n)
        state = [v.copy() for v in (self.m, self.C, self.Q, self.r)]
        m, C, Q, r = state
        if not ops.taylor_step(rest, centre, around, h, m, C, self.xi, Q, r):
            return None
        if decided:
            self.m, self.C, self.Q, self.r = state
        else:  # what a corner adds is carried like a part of the start
            self.C, self.xi = np.hstack([C, Q]), np.concatenate([self.xi, r])
            self.m, self.Q, self.r = m, np.eye(n), np.zeros((n, 1, 2))
        return stay

    def _stay(self, X: FloatArray, h: float) -> FloatArray | None:
        """A box that motions from X stay in for h (Lemma 6), (N, 2), or None."""
        stay = X.copy()
        for attempt in range(12):
            rates = _ends(self.field.whole, stay, self.fixed)
            reach = ops.reached(X, rates, h)
            if not np.isfinite(reach).all():
                return None
            left = np.column_stack([reach[:, 0] < stay[:, 0], reach[:, 1] > stay[:, 1]])
            for i, side in zip(*np.nonzero(left), strict=True) if attempt else ():
                face = stay.copy()
                face[i] = stay[i, side]
                rate = _ends(self.field.whole, face, self.fixed)[i]
                left[i, side] = not (rate[1] < 0.0 if side else rate[0] > 0.0)
            if not left.any():
                return stay
            room = (0.1 if attempt < 6 else 0.5) * (reach[:, 1] - reach[:, 0]) + 1e-300
            wider = np.column_stack([reach[:, 0] - room, reach[:, 1] + room])
            stay = np.where(left, wider, stay)
        return None


def _ends(program: Program, box: FloatArray, fixed: FloatArray) -> FloatArray:
    """Enclose values over a box of the first inputs, (O, 2)."""
    low, high = np.vstack([box, fixed]).T.copy()
    return program(low, high)[:, 0]


def _around(
    program: Program, box: FloatArray, m: FloatArray, fixed: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Enclose values and derivatives over a box, (O, 1 + N, 2), and values at m, (O, 2)."""
    low, high = np.vstack([box, fixed]).T.copy()
    return program(low, high, len(m)), _ends(program, np.column_stack([m, m]), fixed)
