"""Validated integration: boxes of states that move with ẋ = F(x), by Taylor steps (Lemma 6).

A set is m + C ξ, ξ a box: the one that it started as, and those that steps have added since, each
carried on by the derivative of the flow as far as doubles hold it.  So nothing wraps but what is
folded: the smallest columns of C, where there are many.  The right-hand side is code; a corner of
the clip or of the layer shortens the formula of a step to the second order and, where no bounds are
found, the step.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple, Self

import numpy as np

from undertow.proofs.kernel import compiled as ops
from undertow.proofs.kernel.graph import (
    NOWHERE,
    FloatArray,
    Graph,
    Intervals,
    Node,
    Pair,
    Program,
    Sides,
    corners,
)

#: Coefficients of a step, the part of a step that may have a corner inside, and the shortest.
ORDER, SHORT, SHORTEST = 12, 2.0**-5, 2.0**-10

#: Coefficients of a step of a held input, up to a period of 1 ms and beyond.
HELD_ORDER, LONG_ORDER = 5, 8

#: Columns of C before the smallest are folded into a box, and how many are left then.
MOST_COLUMNS, KEPT_COLUMNS, FEW_COLUMNS = 300, 240, 8


class Pieces:
    """Nodes with max and min in them: where these change, and the programs of either side."""

    def __init__(
        self, graph: Graph, nodes: Sequence[Node], lower: Callable[[Sequence[Node], Sides], Program]
    ) -> None:
        self.corners = corners(nodes)
        self.gaps = graph.program([k.of[0] - k.of[1] for k in self.corners])
        #: What is made of the nodes where some corners, pairs with an operand, are that operand.
        self.program = cache(lambda *sides: lower(nodes, dict(sides)))

    def options(self, gaps: Intervals) -> list[list[tuple[Node, Node]]]:
        """Return the operands that each corner may be, where differences of operands are gaps."""
        out = []
        for k, gap in zip(self.corners, gaps, strict=True):
            larger, smaller = k.of if k.kind == "max" else k.of[::-1]
            sure = [larger] if gap.real >= 0.0 else [smaller] if gap.imag <= 0.0 else k.of
            out.append([(k, operand) for operand in sure])
        return out


class Field:
    """A right-hand side of the first inputs of a graph, and its analytic pieces.

    A max or min of it has two sides; where both are possible it stays in the piece.
    """

    def __init__(self, graph: Graph, rates: Sequence[Node]) -> None:
        self.whole, self.pieces = graph.program(rates), Pieces(graph, rates, graph.program)

    def advance(self, tube: Tube, h: float, order: int = ORDER) -> Intervals | None:
        """Move a set on by h, in shorter steps where one is not shown.

        Returns
        -------
        ndarray or None
            A box that all motions stay in on the way, (N,); None where they may leave the domain
            of F, or no bounds are found.
        """
        whole: Intervals | None = None
        done, part = 0.0, 1.0
        while done < 1.0:  # parts are powers of two: h · part and their sum are exact
            stay = self._step(tube, h * part, order, part <= SHORT)
            if stay is None:
                part *= 0.5
                if part < SHORTEST:
                    return None
                continue
            whole = stay if whole is None else whole
            low, high = np.minimum(whole.real, stay.real), np.maximum(whole.imag, stay.imag)
            whole = ops.between(low, high)
            done += part
            while part < 1.0 and done % (2.0 * part) == 0.0:
                part *= 2.0
        return whole

    def _step(self, tube: Tube, h: float, order: int, short: bool) -> Intervals | None:
        """Move a set on by h; the box that motions stay in, or None where nothing is shown."""
        X, n = tube.hull, len(tube.m)
        stay = _stay(self.whole, X, tube.fixed, h)
        if stay is None:
            return None
        box = np.concatenate([stay, tube.fixed])
        way = ops.moved(np.zeros_like(X), self.whole(box)[:, 0], complex(0.0, h))[:, None]
        gaps = self.pieces.gaps.expanded(stay, tube.m, tube.fixed)
        moved = np.hstack([tube.C, np.eye(n)]), np.concatenate([tube.xi, way])
        options = self.pieces.options(ops.along(*gaps, *moved))
        sure = [sides[0] for sides in options if len(sides) == 1]
        if len(sure) < len(options) and not short:
            return None
        program = self.pieces.program(*sure)
        rest = program.series(box, order)[:, order, 0]
        if np.isnan(rest).any():  # a corner is inside: the short formula, Clarke's derivatives
            order = 2
            rest = program.series(box, order)[:, order, 0]
        centre = np.concatenate([ops.between(tube.m, tube.m), tube.fixed])
        centre = program.series(centre, order - 1)[:, :, 0]
        box = np.concatenate([X, tube.fixed])
        around = program.series(box, order - 1, ops.points(np.eye(n)))
        return stay if tube.move(rest, centre, around, ops.point(h)) else None


class Sampled(NamedTuple):
    """A law on a set of states and at a point m of it, with derivatives by the states.

    Parameters
    ----------
    u, u_m
        Its values, (m,) each.
    L, L_m
        Its derivative on the set, which holds means of it too, and at m, (m N,) each, row by row.
    D
        The derivative of that one on the set, (m N, N).
    """

    u: Intervals
    u_m: Intervals
    L: Intervals
    L_m: Intervals
    D: Intervals


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
        self.start = ops.points(np.eye(N)).ravel()
        self.pieces = Pieces(graph, law, self.by_states)

    def by_states(self, nodes: Collection[Node], sides: Sides = NOWHERE) -> Program:
        """Return nodes, and their derivatives by x, row by row."""
        one, graph = self.graph.number(1), self.graph
        slopes = [graph.tangents(nodes, {x: one}, sides) for x in graph.inputs[: self.N]]
        return graph.program([*nodes, *(c[i] for i in range(len(nodes)) for c in slopes)], sides)

    def fixed(self, u: Intervals | None = None, L: Intervals | None = None) -> Intervals:
        """Return the inputs besides x, where Z does not matter, nor what is not given."""
        none = np.zeros(self.m * (self.N + 1), dtype=complex)
        rest = none[: self.m] if u is None else u
        return np.concatenate([self.start, none[self.m :] if L is None else L, rest])

    def input(self, tube: Tube) -> Sampled:
        """Enclose the law on a set.

        Where several pieces of the law may be met, derivatives are those of all, for a mean may be
        of several, and the same everywhere.
        """
        none, slopes = self.fixed(), list[Intervals]()
        gaps = ops.along(*self.pieces.gaps.expanded(tube.hull, tube.m, none), *tube.parts)
        for piece in itertools.product(*self.pieces.options(gaps)):
            own, at = self.pieces.program(*piece).expanded(tube.hull, tube.m, none)
            slopes.append(ops.along(own, at, *tube.parts)[self.m :])
        every = np.array(slopes)
        L = ops.between(every.real.min(axis=0), every.imag.max(axis=0))
        L_m, D = at[self.m :], own[self.m :, 1:]
        if len(slopes) > 1:
            L_m, D = L, np.zeros_like(D)
        around, centre = self.renewed.expanded(tube.hull, tube.m, none)
        around[:, 1:] = L.reshape(self.m, self.N)
        return Sampled(ops.along(around, centre, *tube.parts), centre, L, L_m, D)

    def _series(self, X: Intervals, m: FloatArray, law: Sampled, order: int) -> Pair:
        """Coefficients of (x, Z) on a box, with derivatives by where motions begin, and at m."""
        nothing = np.zeros((len(self.start), self.N))
        seeds = [ops.points(np.eye(self.N)), nothing, law.D, law.L.reshape(self.m, self.N)]
        box = np.concatenate([X, self.fixed(law.u, law.L)])
        whole = self.both.series(box, order - 1, np.concatenate(seeds))
        at = np.concatenate([ops.between(m, m), self.fixed(law.u_m, law.L_m)])
        return whole, self.both.series(at, order - 1)[:, :, 0]

    def advance(self, tube: Tube, h: complex) -> Intervals | None:
        """Move a set of x on by a period, enclosed by h, in one step.

        Returns
        -------
        ndarray or None
            A box that all motions stay in on the way, (N,); None where they may leave the domain
            of F or the law, or no bounds are found.
        """
        n, order, law = self.N, _order(h), self.input(tube)
        fixed = self.fixed(law.u)
        stay = _stay(self.flow, tube.hull, fixed, h.imag) if np.isfinite(law.L).all() else None
        if stay is None:
            return None
        rest = self.flow.series(np.concatenate([stay, fixed]), order)[:, order, 0]
        whole, at = self._series(tube.hull, tube.m, law, order)
        part = whole[n:].reshape(-1, 1 + n).copy()
        half = part[:, 1:]  # of the derivative's change, on the way
        part[:, 1:] = ops.between(0.5 * half.real, 0.5 * half.imag)
        around = np.zeros((n, order, 1 + n), dtype=complex)
        Z = ops.along(part, at[n:].ravel(), *tube.coarse).reshape(n, n, order)
        around[:, :, 1:] = Z.transpose(0, 2, 1)
        return stay if tube.move(rest, at[:n], around, h) else None

    def derivative(self, X: Intervals, m: FloatArray, law: Sampled, h: complex) -> Pair | None:
        """Enclose the derivative of x(h) by x(0) on a box X with a point m, (N, N).

        Also: a box that motions stay in.
        """
        n, order, fixed = self.N, _order(h), np.concatenate([law.L, law.u])
        stay = _stay(self.both, np.concatenate([X, self.start]), fixed, h.imag)
        if stay is None:
            return None
        end = self.both.series(np.concatenate([stay, fixed]), order)[n:, order, 0].copy()
        whole, at = self._series(X, m, law, order)
        for k in reversed(range(order)):
            own = ops.mean_values(whole[n:, k].copy(), at[n:, k].copy(), X, m)
            end = ops.moved(own, end, h)
        return end.reshape(n, n), stay[:n]


@dataclass
class Tube:
    """One set of states on its way.

    Parameters
    ----------
    fixed
        Enclosures of the inputs besides states, (F,).
    hull
        A box around the set now, (N,).
    """

    fixed: Intervals
    hull: Intervals
    m: FloatArray
    C: FloatArray
    xi: Intervals

    @classmethod
    def of(cls, fixed: Intervals, box: FloatArray) -> Self:
        """Start from a box of doubles, (N, 2)."""
        hull, m = ops.between(*box.T), 0.5 * box[:, 0] + 0.5 * box[:, 1]
        xi = [ops.add(x, ops.point(-v)) for x, v in zip(hull, m, strict=True)]
        return cls(fixed, hull, m, np.eye(len(box)), np.array(xi)[:, None])

    def values(self, program: Program) -> Pair:
        """Enclose values and derivatives over the hull, (O, 1 + N), and values at m, (O,)."""
        return program.expanded(self.hull, self.m, self.fixed)

    def image(self, program: Program) -> Intervals:
        """Enclose values on the set, (O,)."""
        return np.asarray(ops.along(*self.values(program), *self.parts))

    def map(self, program: Program) -> bool:
        """Replace the set by its image; whether that is bounded."""
        around, centre = self.values(program)
        return self.move(np.zeros_like(self.hull), centre[:, None], around[:, None], ops.point(1.0))

    def restrict(self, k: int, low: float, high: float) -> None:
        """Let coordinate k be anywhere in [low, high], the others be as they are."""
        m, C, box, one = self.m.copy(), self.C.copy(), self.hull.copy(), np.eye(len(self.m), 1, -k)
        m[k], C[k], box[k] = 0.5 * low + 0.5 * high, 0.0, complex(low, high)
        self.m, self.C, self.hull = m, np.hstack([C, one]), box
        self.xi = np.concatenate([self.xi, [[ops.add(box[k], ops.point(-m[k]))]]])

    @property
    def parts(self) -> tuple[FloatArray, Intervals]:
        """C and ξ: the set around m."""
        return self.C, self.xi

    @property
    def coarse(self) -> tuple[FloatArray, Intervals]:
        """C and ξ of few columns, of a set around this one."""
        return _folded(self.C, self.xi, FEW_COLUMNS)

    def move(self, rest: Intervals, centre: Intervals, around: Intervals, h: complex) -> bool:
        """Replace the set by what a step makes of it, if that is bounded (Lemma 6)."""
        m, C = self.m.copy(), self.C.copy()
        rest = np.ascontiguousarray(rest)  # one layout, compiled once
        added = ops.taylor_step(rest, centre, around, h, m, C, self.xi)
        if not np.isfinite(added).all():
            return False
        self.m, self.C = m, np.hstack([C, np.eye(len(m))])
        self.xi = np.concatenate([self.xi, added])
        if self.C.shape[1] > MOST_COLUMNS:
            self.C, self.xi = _folded(self.C, self.xi, KEPT_COLUMNS)
        spread = ops.product(ops.points(self.C), self.xi)[:, 0]
        self.hull = ops.sums(ops.points(self.m), spread)
        return True


def _folded(C: FloatArray, xi: Intervals, kept: int) -> tuple[FloatArray, Intervals]:
    """Leave the columns of a set that are the most of its width somewhere; a box for the others."""
    if C.shape[1] <= kept + len(C):
        return C, xi
    part = np.abs(C) * np.maximum(np.abs(xi.real), np.abs(xi.imag)).T
    size = (part / (part.sum(axis=1, keepdims=True) + 1e-300)).max(axis=0)
    order = np.argsort(-size, kind="stable")
    most, others = np.sort(order[:kept]), order[kept:]
    box = ops.product(ops.points(C[:, others]), xi[others])
    return np.hstack([C[:, most], np.eye(len(C))]), np.concatenate([xi[most], box])


def _stay(program: Program, X: Intervals, fixed: Intervals, h: float) -> Intervals | None:
    """A box that motions from X stay in for h (Lemma 6), (N,), or None."""

    def rates(box: Intervals) -> Intervals:
        return program(np.concatenate([box, fixed]))[:, 0]

    stay = X.copy()
    for attempt in range(12):
        reach = ops.moved(X, rates(stay), complex(0.0, h))
        if not np.isfinite(reach).all():
            return None
        left = np.column_stack([reach.real < stay.real, reach.imag > stay.imag])
        for i, side in zip(*np.nonzero(left), strict=True) if attempt else ():
            face = stay.copy()
            face[i] = ops.point(stay[i].imag if side else stay[i].real)
            rate = rates(face)[i]
            left[i, side] = not (rate.imag < 0.0 if side else rate.real > 0.0)
        if not left.any():
            return stay
        room = (0.1 if attempt < 6 else 0.5) * (reach.imag - reach.real) + 1e-300
        low = np.where(left[:, 0], reach.real - room, stay.real)
        stay = ops.between(low, np.where(left[:, 1], reach.imag + room, stay.imag))
    return None


def _order(h: complex) -> int:
    return HELD_ORDER if h.imag < 1.0001e-3 else LONG_ORDER
