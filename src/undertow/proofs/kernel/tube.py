"""Validated integration: boxes of states that move with ẋ = F(x), by Taylor steps (Lemma 6).

A set is m + C ξ, ξ a box: the one that it started as, and those that steps have added since, each
carried on by the derivative of the flow as far as doubles hold it.  So nothing wraps but what is
folded: the smallest columns of C, where there are many.  The right-hand side is code; a corner of
the clip or of the layer shortens the formula of a step to the second order and, where no bounds are
found, the step.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np

from undertow.proofs.kernel import compiled as ops
from undertow.proofs.kernel.graph import (
    NOWHERE,
    FloatArray,
    Graph,
    Node,
    Program,
    Sides,
    corners,
)

Pair = tuple[FloatArray, FloatArray]

#: Coefficients of a step, the part of a step that may have a corner inside, and the shortest.
ORDER, SHORT, SHORTEST = 12, 2.0**-5, 2.0**-10

#: Coefficients of a step of a held input, up to a period of 1 ms and beyond.
HELD_ORDER, LONG_ORDER = 5, 8

#: Columns of C before the smallest are folded into a box, and how many are left then.
MOST_COLUMNS, KEPT_COLUMNS, FEW_COLUMNS = 300, 240, 8


class Field:
    """A right-hand side of the first inputs of a graph, and its analytic pieces.

    A max or min of it has two sides; where both are possible it stays in the piece.
    """

    def __init__(self, graph: Graph, rates: Sequence[Node]) -> None:
        self._graph, self._rates, self._pieces = graph, rates, dict[bytes, Program]()
        self._corners = corners(rates)
        self.whole = graph.program(rates)
        self.gaps = graph.program([k.of[0] - k.of[1] for k in self._corners])

    def piece(self, gaps: FloatArray) -> tuple[Program, bool]:
        """Return the rates where the gaps of corners lie in (K, 2), and whether all are decided."""
        first, second = gaps[:, 0] >= 0.0, gaps[:, 1] <= 0.0
        key = first.tobytes() + second.tobytes()
        if key not in self._pieces:
            ends = zip(self._corners, first, second, strict=True)
            sides = {k: k.of[int(a != (k.kind == "max"))] for k, a, b in ends if a or b}
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
                if part < SHORTEST:
                    return None
                continue
            whole = stay if whole is None else whole
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
        gaps = expanded(self.gaps, stay, tube.m, tube.fixed)
        program, decided = self.piece(ops.along(*gaps, tube.C, tube.xi, way))
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
        return stay if tube.move(rest, centre, around, np.array([h, h])) else None


class Sampled(NamedTuple):
    """A law on a set of states and at a point m of it, with derivatives by the states.

    Parameters
    ----------
    u, u_m
        Its values, (m, 2) each.
    L, L_m
        Its derivative on the set, which holds means of it too, and at m, (m N, 2) each, row by row.
    D
        The derivative of that one on the set, (m N, N, 2).
    """

    u: FloatArray
    u_m: FloatArray
    L: FloatArray
    L_m: FloatArray
    D: FloatArray


class Held:
    """ẋ = F(x, u), u = law(x) at the beginning of a period and the same until its end (Lemma 12).

    Inputs of the graph are x (N), Z (N N), L (m N), u (m): Z, the derivative of the motion by where
    it begins, of which the law's is L, moves with it.

    Parameters
    ----------
    rates, law
        Nodes of F (N), by x and u, and of the law (m), by x.
    """

    def __init__(self, graph: Graph, rates: Sequence[Node], law: Sequence[Node]) -> None:
        self.N, self.m = N, m = len(rates), len(law)
        self.graph, self.law, of = graph, law, [*graph.inputs[:N], *graph.inputs[-m:]]
        by = graph.inputs[N:-m].reshape(N + m, N).T
        columns = [graph.tangents(rates, dict(zip(of, column, strict=True))) for column in by]
        self.both = graph.program([*rates, *(c[i] for i in range(N) for c in columns)])
        self.flow, self.renewed = graph.program(rates), graph.program(law)
        self.start = ops.points(np.eye(N)).reshape(-1, 2)
        self._corners, self._pieces = corners(law), dict[tuple[int, ...], Program]()
        self.gaps = graph.program([k.of[0] - k.of[1] for k in self._corners])

    def by_states(self, nodes: Collection[Node], sides: Sides = NOWHERE) -> Program:
        """Return nodes, and their derivatives by x, row by row."""
        one, graph = self.graph.number(1), self.graph
        slopes = [graph.tangents(nodes, {x: one}, sides) for x in graph.inputs[: self.N]]
        return graph.program([*nodes, *(c[i] for i in range(len(nodes)) for c in slopes)], sides)

    def fixed(self, u: FloatArray | None = None, L: FloatArray | None = None) -> FloatArray:
        """Return the inputs besides x, where Z does not matter, nor what is not given."""
        none = np.zeros((self.m * (self.N + 1), 2))
        rest = none[: self.m] if u is None else u
        return np.vstack([self.start, none[self.m :] if L is None else L, rest])

    def input(self, tube: Tube) -> Sampled:
        """Enclose the law on a set.

        Where several pieces of the law may be met, derivatives are those of all, for a mean may be
        of several, and the same everywhere.
        """
        none, options, slopes = self.fixed(), list[list[int]](), list[FloatArray]()
        gaps = ops.along(*expanded(self.gaps, tube.hull, tube.m, none), *tube.parts)
        for (low, high), k in zip(gaps, self._corners, strict=True):
            larger = int(k.kind == "max")  # where the gap is below 0
            options.append([larger] if high <= 0.0 else [1 - larger] if low >= 0.0 else [0, 1])
        for piece in itertools.product(*options):
            if piece not in self._pieces:
                sides = {k: k.of[i] for k, i in zip(self._corners, piece, strict=True)}
                self._pieces[piece] = self.by_states(self.law, sides)
            own, at = expanded(self._pieces[piece], tube.hull, tube.m, none)
            slopes.append(ops.along(own, at, *tube.parts)[self.m :])
        every = np.array(slopes)
        L = np.stack([every[..., 0].min(axis=0), every[..., 1].max(axis=0)], axis=-1)
        L_m, D = at[self.m :], own[self.m :, 1:]
        if len(slopes) > 1:
            L_m, D = L, np.zeros_like(D)
        around, centre = expanded(self.renewed, tube.hull, tube.m, none)
        around[:, 1:] = L.reshape(self.m, self.N, 2)
        return Sampled(ops.along(around, centre, *tube.parts), centre, L, L_m, D)

    def _series(self, X: FloatArray, m: FloatArray, law: Sampled, order: int) -> Pair:
        """Coefficients of (x, Z) on a box, with derivatives by where motions begin, and at m."""
        nothing = np.zeros((len(self.start), self.N, 2))
        seeds = [ops.points(np.eye(self.N)), nothing, law.D, law.L.reshape(self.m, self.N, 2)]
        low, high = np.vstack([X, self.fixed(law.u, law.L)]).T.copy()
        whole = self.both.series(low, high, order - 1, np.concatenate(seeds))
        low, high = np.vstack([np.column_stack([m, m]), self.fixed(law.u_m, law.L_m)]).T.copy()
        return whole, self.both.series(low, high, order - 1)[:, :, 0]

    def advance(self, tube: Tube, h: FloatArray) -> FloatArray | None:
        """Move a set of x on by a period, whose ends are h (2,), in one step.

        Returns
        -------
        ndarray or None
            A box that all motions stay in on the way, (N, 2); None where they may leave the domain
            of F or the law, or no bounds are found.
        """
        n, order, law = self.N, _order(h), self.input(tube)
        fixed = self.fixed(law.u)
        stay = _stay(self.flow, tube.hull, fixed, h[1]) if np.isfinite(law.L).all() else None
        if stay is None:
            return None
        low, high = np.vstack([stay, fixed]).T.copy()
        rest = self.flow.series(low, high, order)[:, order, 0]
        whole, at = self._series(tube.hull, tube.m, law, order)
        part = whole[n:].reshape(-1, 1 + n, 2).copy()
        part[:, 1:] *= 0.5  # of the derivative's change, on the way
        around = np.zeros((n, order, 1 + n, 2))
        Z = ops.along(part, at[n:].reshape(-1, 2), *tube.coarse).reshape(n, n, order, 2)
        around[:, :, 1:] = Z.transpose(0, 2, 1, 3)
        return stay if tube.move(rest, at[:n], around, h) else None

    def derivative(self, X: FloatArray, m: FloatArray, law: Sampled, h: FloatArray) -> Pair | None:
        """Enclose the derivative of x(h) by x(0) on a box X with a point m, (N, N, 2).

        Also: a box that motions stay in.
        """
        n, order, fixed = self.N, _order(h), np.vstack([law.L, law.u])
        stay = _stay(self.both, np.vstack([X, self.start]), fixed, h[1])
        if stay is None:
            return None
        low, high = np.vstack([stay, fixed]).T.copy()
        end = self.both.series(low, high, order)[n:, order, 0]
        whole, at = self._series(X, m, law, order)
        for k in reversed(range(order)):
            own, _ = ops.mean_values(whole[n:, k].copy(), at[n:, k].copy(), *X.T.copy(), m)
            end = ops.carried(end, own, h)
        return end.reshape(n, n, 2), stay[:n]


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

    @classmethod
    def of(cls, fixed: FloatArray, box: FloatArray) -> Self:
        """Start from a box of doubles, (N, 2)."""
        middle = 0.5 * box[:, 0] + 0.5 * box[:, 1]
        xi = [ops.add(a, b, -v, -v) for (a, b), v in zip(box, middle, strict=True)]
        return cls(fixed, box.copy(), middle, np.eye(len(box)), np.array(xi)[:, None])

    def values(self, program: Program) -> Pair:
        """Enclose values and derivatives over the hull, (O, 1 + N, 2), and values at m, (O, 2)."""
        return expanded(program, self.hull, self.m, self.fixed)

    def image(self, program: Program) -> FloatArray:
        """Enclose values on the set, (O, 2)."""
        return np.asarray(ops.along(*self.values(program), *self.parts))

    def map(self, program: Program) -> bool:
        """Replace the set by its image; whether that is bounded."""
        around, centre = self.values(program)
        return self.move(np.zeros_like(self.hull), centre[:, None], around[:, None], np.ones(2))

    def restrict(self, k: int, low: float, high: float) -> None:
        """Let coordinate k be anywhere in [low, high], the others be as they are."""
        m, C, box, one = self.m.copy(), self.C.copy(), self.hull.copy(), np.eye(len(self.m), 1, -k)
        m[k], C[k], box[k] = 0.5 * low + 0.5 * high, 0.0, (low, high)
        self.m, self.C, self.hull = m, np.hstack([C, one]), box
        self.xi = np.concatenate([self.xi, [[ops.add(low, high, -m[k], -m[k])]]])

    @property
    def parts(self) -> tuple[FloatArray, ...]:
        """C and ξ, and no more: the set around m."""
        return self.C, self.xi, np.zeros((len(self.m), 1, 2))

    @property
    def coarse(self) -> tuple[FloatArray, ...]:
        """A set of few columns around this one, in place of :attr:`parts`."""
        return *_folded(self.C, self.xi, FEW_COLUMNS), np.zeros((len(self.m), 1, 2))

    def move(self, rest: FloatArray, centre: FloatArray, around: FloatArray, h: FloatArray) -> bool:
        """Replace the set by what a step makes of it, if that is bounded (Lemma 6)."""
        m, C = self.m.copy(), self.C.copy()
        added = ops.taylor_step(rest, centre, around, h, m, C, self.xi)
        if not np.isfinite(added).all():
            return False
        self.m, self.C = m, np.hstack([C, np.eye(len(m))])
        self.xi = np.concatenate([self.xi, added])
        if self.C.shape[1] > MOST_COLUMNS:
            self.C, self.xi = _folded(self.C, self.xi, KEPT_COLUMNS)
        self.hull = ops.hulled(self.m, self.C, self.xi)
        return True


def _folded(C: FloatArray, xi: FloatArray, kept: int) -> Pair:
    """Leave the columns of a set that are the most of its width somewhere; a box for the others."""
    if C.shape[1] <= kept + len(C):
        return C, xi
    part = np.abs(C) * np.abs(xi).max(axis=-1).T
    size = (part / (part.sum(axis=1, keepdims=True) + 1e-300)).max(axis=0)
    order = np.argsort(-size, kind="stable")
    most, others = np.sort(order[:kept]), order[kept:]
    box = ops.product(ops.points(C[:, others]), xi[others])
    return np.hstack([C[:, most], np.eye(len(C))]), np.concatenate([xi[most], box])


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


def expanded(program: Program, box: FloatArray, m: FloatArray, fixed: FloatArray) -> Pair:
    """Enclose values and derivatives over a box, (O, 1 + N, 2), and values at m, (O, 2)."""
    low, high = np.vstack([box, fixed]).T.copy()
    return program(low, high, len(m)), _ends(program, np.column_stack([m, m]), fixed)
