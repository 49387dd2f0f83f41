"""Validated integration: boxes of states that move with ẋ = F(x), by Taylor steps (Lemma 6).

A set is m + C ξ + Q r: ξ the box that it started as, C the derivative of the flow as far as
doubles carry it, Q orthonormal (Lohner), r the box of what has been added since.  The right-hand
side is code; a corner of the clip or of the layer shortens the formula of a step to the second
order and, where no bounds are found, the step.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from undertow.proofs.kernel import compiled as ops
from undertow.proofs.kernel.graph import FloatArray, Graph, Program

#: Coefficients of a step, the part of a step that may have a corner inside, and the shortest.
ORDER, SHORT, SHORTEST = 12, 2.0**-5, 2.0**-10

#: Coefficients of a step of a held input, up to a period of 1 ms and beyond.
HELD_ORDER, LONG_ORDER = 5, 8

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

    def advance(self, tube: Tube, h: float, order: int = ORDER) -> FloatArray | None:
        """Move a set on by h, in shorter steps where one is not shown.

        Returns
        -------
        ndarray or None
            A box that all motions stay in on the way, (N, 2); None where they may leave the domain
            of F, or no bounds are found.
        """
        whole: FloatArray | None = None
        done, part = 0.0, 1.0
        while done < 1.0:  # parts are powers of two: h · part and their sum are exact
            stay = self._step(tube, h * part, order, part <= SHORT)
            if stay is None:
                part *= 0.5
                if part < SHORTEST or tube.C.shape[1] > MOST_COLUMNS:
                    return None
                continue
            if whole is None:
                whole = stay
            low, high = np.minimum(whole[:, 0], stay[:, 0]), np.maximum(whole[:, 1], stay[:, 1])
            whole = np.column_stack([low, high])
            done += part
            while part < 1.0 and done % (2.0 * part) == 0.0:
                part *= 2.0
        return whole

    def _step(self, tube: Tube, h: float, order: int, short: bool) -> FloatArray | None:
        """Move a set on by h; the box that motions stay in, or None where nothing is shown."""
        X, n = tube.hull, len(tube.m)
        stay = _stay(self.whole, X, tube.fixed, h)
        if stay is None:
            return None
        rates = _ends(self.whole, stay, tube.fixed)
        way = ops.reached(np.zeros_like(X), rates, h).reshape(n, 1, 2)
        gaps = _around(self.gaps, stay, tube.m, tube.fixed)
        program, decided = self.piece(ops.along(*gaps, tube.C, tube.xi, tube.Q, tube.r, way))
        if not decided and not short:
            return None
        low, high = np.vstack([stay, tube.fixed]).T.copy()
        rest = program.series(low, high, order)[:, order, 0]
        if np.isnan(rest).any():  # a corner is inside: the short formula, Clarke's derivatives
            order = 2
            rest = program.series(low, high, order)[:, order, 0]
        low[:n] = high[:n] = tube.m
        centre = program.series(low, high, order - 1)[:, :, 0]
        low[:n], high[:n] = X.T
        around = program.series(low, high, order - 1, ops.points(np.eye(n)))
        return stay if tube.move(rest, centre, around, np.array([h, h]), decided) else None


class Held:
    """ẋ = F(x, u), u = law(x) at the beginning of a period and the same until its end (Lemma 10).

    Inputs of the graph are x (N), Y (N (N + m)), u (m): Y, the derivative of the motion by where it
    begins and by u, moves with it.

    Parameters
    ----------
    rates, law
        Nodes of F (N), by x and u, and of the law (m), by x.
    """

    def __init__(self, graph: Graph, rates: Sequence[int], law: Sequence[int]) -> None:
        self.N, self.m = len(rates), len(law)
        self.graph, self.law, both = graph, law, self.N + self.m
        x, u = graph.inputs[: self.N], graph.inputs[-self.m :]
        Y = [graph.inputs[self.N + i * both : self.N + (i + 1) * both] for i in range(self.N)]
        columns = []
        for j in range(both):
            seeds = {x[i]: Y[i][j] for i in range(self.N)}
            seeds |= {u[j - self.N]: graph.number(1)} if j >= self.N else {}
            columns.append(graph.tangents(rates, seeds))
        self.flow = graph.program(rates)
        self.both = graph.program([*rates, *(c[i] for i in range(self.N) for c in columns)])
        self.start = ops.points(np.eye(self.N, both)).reshape(-1, 2)
        self.renewed = graph.program(law)
        self._corners = graph.corners(law)
        operands = [graph.nodes[k][1:] for k in self._corners]
        self.gaps = graph.program([graph.make("sub", a, b) for a, b in operands])
        self._pieces = dict[tuple[bool, ...], Program]()

    def fixed(self, u: FloatArray) -> FloatArray:
        """Return the inputs besides x, where Y does not matter."""
        return np.vstack([self.start, u])

    def _piece(self, second: tuple[bool, ...]) -> Program:
        """The law and its derivative by x, row by row, where corners are these operands."""
        if second not in self._pieces:
            graph, one = self.graph, self.graph.number(1)
            sides = {
                k: graph.nodes[k][2 if b else 1] for k, b in zip(self._corners, second, strict=True)
            }
            slopes = [graph.tangents(self.law, {x: one}, sides) for x in graph.inputs[: self.N]]
            rows = [c[i] for i in range(self.m) for c in slopes]
            self._pieces[second] = graph.program([*self.law, *rows], sides)
        return self._pieces[second]

    def input(self, tube: Tube) -> tuple[FloatArray, FloatArray, FloatArray, bool]:
        """Enclose the law on a set and at its m (m, 2), and its slopes from m to points of the set.

        Slopes are (m, N, 2), of all pieces that are not excluded on the set.  Also: whether that
        is one.
        """
        none, set_ = np.zeros((self.m, 2)), tube.parts
        around, centre = _around(self.gaps, tube.hull, tube.m, self.fixed(none))
        gaps = ops.along(around, centre, *set_)
        options = []
        for (low, high), k in zip(gaps, self._corners, strict=True):
            largest = self.graph.nodes[k][0] == "max"
            options.append(
                [largest] if high <= 0.0 else [not largest] if low >= 0.0 else [False, True]
            )
        pieces = [*itertools.product(*options)]
        slopes = np.empty((0, 0))
        for piece in pieces:
            around, centre = _around(self._piece(piece), tube.hull, tube.m, self.fixed(none))
            if len(pieces) == 1:  # the mean of a derivative on the way is half as far off
                around[:, 1:] *= 0.5
            own = ops.along(around, centre, *set_)[self.m :].reshape(self.m, self.N, 2)
            if slopes.size:
                own = np.stack(
                    [
                        np.minimum(own[..., 0], slopes[..., 0]),
                        np.maximum(own[..., 1], slopes[..., 1]),
                    ],
                    -1,
                )
            slopes = own
        around, centre = _around(self.renewed, tube.hull, tube.m, self.fixed(none))
        u = ops.along(np.concatenate([around[:, :1], slopes], axis=1), centre, *set_)
        return u, centre, slopes, len(pieces) == 1

    def advance(self, tube: Tube, h: FloatArray) -> FloatArray | None:
        """Move a set of x on by a period, whose ends are h (2,), in one step.

        Returns
        -------
        ndarray or None
            A box that all motions stay in on the way, (N, 2); None where they may leave the domain
            of F or the law, or no bounds are found.
        """
        n, X, order = self.N, tube.hull, _order(h)
        u, centre, slopes, one = self.input(tube)
        if not (np.isfinite(u).all() and np.isfinite(slopes).all()):
            return None
        stay = _stay(self.flow, X, self.fixed(u), h[1])
        if stay is None:
            return None
        low, high = np.vstack([stay, self.fixed(u)]).T.copy()
        rest = self.flow.series(low, high, order)[:, order, 0]
        low[:n], high[:n] = X.T
        unit = ops.points(np.eye(n))
        seeds = np.concatenate([unit, np.zeros((len(self.start), n, 2)), slopes])
        whole = self.both.series(low, high, order - 1, seeds)
        low, high = np.vstack([np.column_stack([tube.m, tube.m]), self.fixed(centre)]).T.copy()
        at = self.both.series(low, high, order - 1)[:, :, 0]
        part = whole[n:].reshape(-1, 1 + n, 2).copy()
        part[:, 1:] *= 0.5
        Y = ops.along(part, at[n:].reshape(-1, 2), *tube.parts).reshape(n, n + self.m, order, 2)
        around, way = np.zeros((n, order, 1 + n, 2)), np.concatenate([unit, slopes])
        for k in range(order):
            around[:, k, 1:] = ops.product(np.ascontiguousarray(Y[:, :, k]), way)
        return stay if tube.move(rest, at[:n], around, h, one) else None

    def derivative(
        self,
        X: FloatArray,
        m: FloatArray,
        u: FloatArray,
        u_m: FloatArray,
        slopes: FloatArray,
        h: FloatArray,
    ) -> tuple[FloatArray, FloatArray] | None:
        """Enclose the derivative of x(h) by x(0) on a box, (N, N, 2), and where motions stay.

        Parameters
        ----------
        X, m
            The box, (N, 2), and a point of it, (N,).
        u, u_m, slopes
            The law on it, (m, 2), at m, (m, 2), and its derivative on it, (m, N, 2).
        """
        n, both, order = self.N, np.vstack([X, self.start]), _order(h)
        stay = _stay(self.both, both, u, h[1])
        if stay is None:
            return None
        low, high = np.vstack([stay, u]).T.copy()
        rest = self.both.series(low, high, order)[n:, order, 0]
        low, high = np.vstack([both, u]).T.copy()
        unit = ops.points(np.eye(n))
        seeds = np.concatenate([unit, np.zeros((len(self.start), n, 2)), slopes])
        whole = self.both.series(low, high, order - 1, seeds)[n:]
        low, high = np.vstack([np.column_stack([m, m]), self.start, u_m]).T.copy()
        at = self.both.series(low, high, order - 1)[n:, :, 0]
        end = rest
        for k in range(order - 1, -1, -1):
            own, _ = ops.mean_values(
                np.ascontiguousarray(whole[:, k]),
                np.ascontiguousarray(at[:, k]),
                X[:, 0].copy(),
                X[:, 1].copy(),
                m,
            )
            end = ops.carried(end, own, h)
        Y = end.reshape(n, n + self.m, 2)
        return ops.product(Y, np.concatenate([unit, slopes])), stay[:n]


@dataclass
class Tube:
    """One set of states on its way.

    Parameters
    ----------
    fixed
        Enclosures of the inputs besides states, (F, 2).
    hull
        A box around the set now, (N, 2).
    """

    fixed: FloatArray
    hull: FloatArray
    m: FloatArray
    C: FloatArray
    xi: FloatArray
    Q: FloatArray
    r: FloatArray

    @classmethod
    def of(cls, fixed: FloatArray, box: FloatArray) -> Self:
        """Start from a box of doubles, (N, 2)."""
        n = len(box)
        middle = 0.5 * box[:, 0] + 0.5 * box[:, 1]
        xi = np.array([ops.add(a, b, -v, -v) for (a, b), v in zip(box, middle, strict=True)])
        return cls(
            fixed, box.copy(), middle, np.eye(n), xi.reshape(n, 1, 2), np.eye(n),
            np.zeros((n, 1, 2)),
        )  # fmt: skip

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
        good = bool(ops.taylor_step(none, centre[:, None], around[:, None], np.ones(2), *state))
        self.hull = ops.hulled(*state)
        return good

    @property
    def parts(self) -> tuple[FloatArray, ...]:
        """C, ξ, Q, r, and no more: the set around m."""
        return self.C, self.xi, self.Q, self.r, np.zeros((len(self.m), 1, 2))

    def move(
        self, rest: FloatArray, centre: FloatArray, around: FloatArray, h: FloatArray, smooth: bool
    ) -> bool:
        """Replace the set by what a step makes of it, if that is bounded (Lemma 6)."""
        state = [v.copy() for v in (self.m, self.C, self.Q, self.r)]
        m, C, Q, r = state
        if not ops.taylor_step(rest, centre, around, h, m, C, self.xi, Q, r):
            return False
        if smooth:
            self.m, self.C, self.Q, self.r = state
        else:  # what a corner adds is carried like a part of the start
            self.C, self.xi = np.hstack([C, Q]), np.concatenate([self.xi, r])
            self.m, self.Q, self.r = m, np.eye(len(m)), np.zeros((len(m), 1, 2))
        self.hull = ops.hulled(self.m, self.C, self.xi, self.Q, self.r)
        return True


def _stay(program: Program, X: FloatArray, fixed: FloatArray, h: float) -> FloatArray | None:
    """A box that motions from X stay in for h (Lemma 6), (N, 2), or None."""
    stay = X.copy()
    for attempt in range(12):
        reach = ops.reached(X, _ends(program, stay, fixed), h)
        if not np.isfinite(reach).all():
            return None
        left = np.column_stack([reach[:, 0] < stay[:, 0], reach[:, 1] > stay[:, 1]])
        for i, side in zip(*np.nonzero(left), strict=True) if attempt else ():
            face = stay.copy()
            face[i] = stay[i, side]
            rate = _ends(program, face, fixed)[i]
            left[i, side] = not (rate[1] < 0.0 if side else rate[0] > 0.0)
        if not left.any():
            return stay
        room = (0.1 if attempt < 6 else 0.5) * (reach[:, 1] - reach[:, 0]) + 1e-300
        wider = np.column_stack([reach[:, 0] - room, reach[:, 1] + room])
        stay = np.where(left, wider, stay)
    return None


def _order(h: FloatArray) -> int:
    return HELD_ORDER if h[1] < 1.0001e-3 else LONG_ORDER


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
