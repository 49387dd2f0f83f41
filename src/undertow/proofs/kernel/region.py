"""Sets from which motions on a surface converge, one function after another: 5.5, Lemma 7.

Boxes are taken in x: x_0 = y_0, and x_r = (G c)_r + G_r0 (κ y_0 − c_0) for r ≥ 1, κ = c_0(a)/a.
G is lower triangular, so that y follows from x.  On the guard {|G c| ≤ 1} |x_0| ≤ a, and since
q ≤ c_0(q) ≤ κ q for 0 ≤ q ≤ a, |x_r| ≤ 1 + |G_r0| (c_0(a) − a).
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from undertow.proofs.kernel import compiled as ops
from undertow.proofs.kernel.bound import Goal, Settled, halved, settle
from undertow.proofs.kernel.graph import FloatArray, Graph, Program, Span, hull
from undertow.proofs.kernel.model import Algebra, Law, Matrix, Model, Nodes, Sliding

#: Boxes that are looked at together, and points of them that are tried for a counterexample.
CHUNK, TRIED = 4096, 16


@dataclass(frozen=True)
class Function:
    """V = Σ_k c_k Π_i z_i^(e_ki), z = A c, inside the guard |G c| ≤ 1; G is lower triangular."""

    A: Matrix
    G: Matrix
    exponents: tuple[tuple[int, ...], ...]
    coefficients: tuple[Fraction, ...]


@dataclass(frozen=True)
class Stretch:
    """c = (I + Σ_j τ^j S_j) y, τ = y_0²/(L² − y_0²), for |y_0| < L; c = y without any S."""

    S: tuple[Matrix, ...]
    L: Fraction | None

    def first(self, q: Fraction) -> Fraction:
        """Return c_0 at y_0 = q; c_0/q ≥ 1 rises with |q|."""
        tau = q * q / (self.L * self.L - q * q) if self.L is not None else Fraction(0)
        return q * (1 + sum(S[0][0] * tau**j for j, S in enumerate(self.S, start=1)))

    def reach(self, g: Fraction) -> Fraction | None:
        """Return a number a < L with |g| c_0(a) ≥ 1: |g c_0| ≤ 1 implies |y_0| ≤ a; or None."""
        low, high = Fraction(0), 1 / abs(g) if self.L is None else self.L
        for _ in range(60 if self.S else 0):
            q = (low + high) / 2
            low, high = (low, q) if abs(g) * self.first(q) >= 1 else (q, high)
        return high if self.L is None or high < self.L else None


class _Chart:
    """The stretch on a graph at y_0 = q, a node: (I + Σ τ^j S_j) and its derivative by y_0."""

    def __init__(self, algebra: Algebra, stretch: Stretch, q: int, size: int) -> None:
        graph = algebra.graph
        self.algebra, make, number = algebra, graph.make, graph.number
        total = [[number(int(i == j)) for j in range(size)] for i in range(size)]
        if stretch.S and stretch.L is not None:
            square = make("sqr", q)
            tau = make("div", square, make("sub", number(stretch.L**2), square))
            for j, S in enumerate(stretch.S, start=1):
                part = [[make("mul", number(v), graph.power(tau, j)) for v in row] for row in S]
                total = algebra.each("add", total, part)
        slope = graph.tangents([v for row in total for v in row], {q: number(1)})
        self.total, self.slope = total, [slope[i * size : (i + 1) * size] for i in range(size)]

    def value(self, V: Function, c: Nodes, c_dot: Nodes) -> list[int]:
        """V, |G c|² and, where ċ is given, V̇."""
        graph, algebra = self.algebra.graph, self.algebra

        def times(A: Matrix, v: Nodes) -> list[int]:
            return [r[0] for r in algebra.times([[graph.number(a) for a in r] for r in A], v)]

        z = times(V.A, c)
        terms = dict(zip(V.exponents, V.coefficients, strict=True))
        value = _polynomial(graph, z, terms)
        guard = graph.sum(graph.make("sqr", v) for v in times(V.G, c))
        seeds = dict(zip(z, times(V.A, c_dot), strict=True)) if c_dot else {}
        return [value, guard, *(graph.tangents([value], seeds) if seeds else [])]


def _polynomial(graph: Graph, z: Sequence[int], terms: Mapping[tuple[int, ...], Fraction]) -> int:
    """Lay Σ coefficient · Π z_i^e_i by Horner's scheme, one variable after the other."""
    if not z:
        return graph.number(terms[()])
    total: int | None = None
    for power in range(max(e[0] for e in terms), -1, -1):
        rest = {e[1:]: c for e, c in terms.items() if e[0] == power}
        parts = [] if total is None else [graph.make("mul", total, z[0])]
        parts += [_polynomial(graph, z[1:], rest)] if rest else []
        total = graph.sum(parts)
    assert total is not None
    return total


def _motion(
    algebra: Algebra, model: Model, law: Law, y: Nodes, p: Sequence[int]
) -> tuple[Nodes, list[int]]:
    """ẏ of the motion on the surface, y = (q_u, v_u, w), and the pivots of M."""
    graph, free = algebra.graph, model.n - model.m
    lambda_a, lambda_u = (
        [[graph.number(v) for v in row] for row in block] for block in (law.lambda_a, law.lambda_u)
    )
    ratio = algebra.times(algebra.inverse(lambda_a)[0], lambda_u)
    q_u, v_u, w = y[:free], y[free : 2 * free], y[2 * free :]
    q = [*algebra.each("sub", w, algebra.times(ratio, q_u)), *q_u]
    on = Sliding.of(algebra, model, law, q, algebra.times(lambda_a, w), v_u, p)
    w_dot = algebra.each("add", on.v_a, algebra.times(ratio, v_u))
    return [*v_u, *on.v_u_dot, *w_dot], on.pivots


def on_the_line(stretch: Stretch, V: Function, end: Sequence[Fraction], max_boxes: int) -> Settled:
    """Decide whether V ≤ 1 and |G c| ≤ 1 on the line from 0 to a point y."""
    graph = Graph(1)
    algebra = Algebra(graph)
    y = [[graph.make("mul", graph.inputs[0], graph.number(v))] for v in end]
    chart = _Chart(algebra, stretch, y[0][0], len(y))
    nodes = chart.value(V, algebra.times(chart.total, y), [])
    goals = [Goal(f"{what} ≤ 1 on the line", -1, (-1.0, -1.0), False) for what in ("V", "|G c|²")]
    box = [(Fraction(0), Fraction(1))]
    return settle(graph.program(nodes), box, np.empty((0, 2)), goals, max_boxes)


class Stage:
    """One function over the box of its guard, and the one before, which holds what is inside."""

    def __init__(
        self, model: Model, law: Law, stretch: Stretch, V: Function, inner: Function | None,
        plant: Mapping[str, tuple[Fraction, Fraction]],
    ) -> None:  # fmt: skip
        self.size = size = 2 * model.n - model.m
        self.inner, self.plant = inner, [plant[p.name] for p in model.parameters if p.name in plant]
        self.graph = graph = Graph(size + len(self.plant))
        algebra, make, number = Algebra(graph), graph.make, graph.number
        varied = iter(graph.inputs[size:])
        p = [next(varied) if k.name in plant else number(k.value or 0) for k in model.parameters]
        self.half = half = stretch.reach(V.G[0][0])
        top = Fraction(0) if half is None else stretch.first(half)
        chord = Fraction(1) if half is None else top / half
        self.sides = [half or 0, *(1 + abs(row[0]) * (top - (half or 0)) for row in V.G[1:])]
        q = graph.inputs[0]
        chart = _Chart(algebra, stretch, q, size)
        c = [make("mul", chart.total[0][0], q)]
        for r in range(1, size):
            known = [make("mul", number(V.G[r][j] / V.G[r][r]), c[j]) for j in range(1, r)]
            known.append(make("mul", number(V.G[r][0] * chord / V.G[r][r]), q))
            own = make("mul", number(1 / V.G[r][r]), graph.inputs[r])
            c.append(make("sub", own, graph.sum(known)))
        right = [[make("sub", c[r], make("mul", chart.total[r][0], q))] for r in range(1, size)]
        rest, _ = algebra.inverse([row[1:] for row in chart.total[1:]])
        y = [[q], *algebra.times(rest, right)]
        y_dot, self.pivots = _motion(algebra, model, law, y, p)
        bend = [[make("mul", v[0], y_dot[0][0])] for v in algebra.times(chart.slope, y)]
        c_dot = algebra.each("add", algebra.times(chart.total, y_dot), bend)
        column = [[v] for v in c]
        value, guard, self.rate = chart.value(V, column, c_dot)
        before = [] if inner is None else chart.value(inner, column, [])
        self.rates = [row[0] for row in y_dot]
        nodes = [self.rate, value, *before[:1], guard, *before[1:], *self.pivots]
        self.program, self.y = graph.program(nodes), graph.program([row[0] for row in y])
        self.even = all(0 in p for p in graph.parities(nodes, size))

    def decide(self, max_boxes: int) -> Settled:
        """Decide (1) to (3) of the statement for this function."""
        try:
            at = [Span(0)] * self.size + [Span(*ends) for ends in self.plant]
            if not all(v.zero for v in self.graph.exact(self.rates, at)):
                return Settled("undecided", "F(0) = 0 is not shown exactly", (), 0)
        except ArithmeticError as error:
            return Settled("undecided", f"at the target: {error}", (), 0)
        if self.half is None:
            return Settled("undecided", "the guard reaches the pole", (), 0)
        side = np.array([hull(Fraction(v), Fraction(v))[1] for v in self.sides])
        ends = np.array([hull(*e) for e in self.plant]).reshape(-1, 2)
        core = np.zeros(self.size)
        if self.inner is None:
            found = self._core(0.25 * side, ends)
            if found is None:
                return Settled("undecided", "V̇ is not shown negative definite at 0", (), 0)
            core = found
        return self._branch(side, ends, core, max_boxes)

    def _core(self, cube: FloatArray, ends: FloatArray) -> FloatArray | None:
        """A cube where M ≻ 0 and V̇ = ½ xᵀ H(ζ x) x with H ≺ 0, the plant in slices."""
        graph, N, one = self.graph, self.size, self.graph.number(1)
        slopes = [graph.tangents([self.rate], {x: one})[0] for x in graph.inputs[:N]]
        slope, pivots = graph.program(slopes), graph.program(self.pivots)
        cuts = [np.linspace(a, b, 17 if len(ends) == 1 else 5) for a, b in ends]
        slices = [
            np.array(part).reshape(-1, 2)
            for part in itertools.product(*(list(itertools.pairwise(c)) for c in cuts))
        ]

        def falls(part: FloatArray) -> bool:
            low, high = np.append(-cube, part[:, 0]), np.append(cube, part[:, 1])
            H = slope(low, high, N)[:, 1:]
            return bool((pivots(low, high)[:, 0, 0] > 0).all()) and _negative_definite(H)

        for _ in range(24):
            if all(falls(part) for part in slices):
                return cube
            cube = cube / 1.6
        return None

    def _false(self, a: FloatArray) -> str:
        """What is false for certain at a point, if anything."""
        values = self.program(a, a)[:, 0]
        count = 2 if self.inner is None else 3
        outside = self.inner is None or values[2, 0] > 1.0
        if values[1, 1] <= 1.0 and values[count, 1] <= 1.0:
            if outside and values[0, 0] > 0.0:
                return "V̇ < 0"
            if (values[-len(self.pivots) :, 1] <= 0.0).any():
                return "M ≻ 0"
        return ""

    def _done(
        self, a: FloatArray, b: FloatArray, core: FloatArray
    ) -> tuple[NDArray[np.bool_], FloatArray]:
        """Boxes that are settled, and how much V̇ varies with each variable, (B, V)."""
        V, n = len(a), len(self.pivots)
        program: Program = self.program
        models = ops.models(program.code, program.constants, program.outputs, a, b)
        values, spread = ops.ranges(models, V)
        low, high = values[..., 0], values[..., 1]
        count = 2 if self.inner is None else 3  # then the guards
        ring = models[:, :3].copy()
        if self.inner is None:
            ring[:, 2], ring[:, 2, 0] = 0.0, 1.0
            far = np.maximum(abs(a), abs(b))[: self.size]
            home = np.asarray((far <= core[:, None]).all(axis=0))
            near = np.ones(a.shape[1], dtype=bool)
        else:
            near = high[:, 4] < 1.0
            home = near & (high[:, 2] < 1.0)
        falls = (high[:, 0] < 0.0) | (near & ops.excluded(ring, V))
        inside = (high[:, count] < 1.0) & (home | (falls & (low[:, -n:] > 0.0).all(axis=1)))
        return (low[:, 1] > 1.0) | (low[:, count] > 1.0) | inside, spread[:, 0]

    def _branch(
        self, side: FloatArray, ends: FloatArray, core: FloatArray, max_boxes: int
    ) -> Settled:
        start = np.append(-side, ends[:, 0])[:, None], np.append(side, ends[:, 1])[:, None]
        low, high = start
        if self.even:  # half of the box will do
            high = high.copy()
            high[self.size - 1] = 0.0
        unit = start[1] - start[0]
        unit[unit == 0.0] = 1.0
        count = 0
        while low.shape[1]:
            a, b, low, high = low[:, -CHUNK:], high[:, -CHUNK:], low[:, :-CHUNK], high[:, :-CHUNK]
            count += a.shape[1]
            done, spread = self._done(np.ascontiguousarray(a), np.ascontiguousarray(b), core)
            if done.all():
                continue
            a, b, spread = a[:, ~done], b[:, ~done], spread[~done].T
            width, middle = (b - a) / unit, 0.5 * a + 0.5 * b
            tiny = width.max(axis=0) < 1e-7
            for at in [*range(min(len(tiny), TRIED)), *np.flatnonzero(tiny)[:1]]:
                point = np.ascontiguousarray(middle[:, at])
                if why := self._false(point):
                    return Settled("refuted", why, self._named(point), count)
            if tiny.any() or count > max_boxes:
                point = np.ascontiguousarray(middle[:, int(tiny.argmax())])
                why = "stuck in a tiny box" if tiny.any() else f"more than {max_boxes} boxes"
                return Settled("undecided", why, self._named(point), count)
            weight = np.where(np.isfinite(spread).all(axis=0), spread, width)
            weight = np.where(width > 0.02 * width.max(axis=0), weight, 0.0)
            low, high = halved(a, b, weight.argmax(axis=0), low, high)
        return Settled("proved", "", (), count)

    def _named(self, point: FloatArray) -> tuple[float, ...]:
        return (*self.y(point, point)[:, 0].mean(axis=1).tolist(), *point[self.size :].tolist())


def _negative_definite(H: FloatArray) -> bool:
    """Whether every symmetric matrix in H (N, N, 2) is: −Sᵀ H S ≻ 0, then S is invertible too."""
    middle = 0.5 * (H[..., 0] + H[..., 1])
    if not np.isfinite(middle).all():
        return False
    values, vectors = np.linalg.eigh(-0.5 * (middle + middle.T))
    if not values[0] > 0:
        return False
    S = ops.points(vectors / np.sqrt(values))
    turned = ops.product(ops.product(np.ascontiguousarray(S.transpose(1, 0, 2)), H), S)
    return bool(ops.dominance(np.ascontiguousarray(-turned[..., ::-1])) > 0.0)
