"""Sets from which motions on a surface converge, one function after another: 5.5, Lemma 7.

Boxes are taken in x: x_0 = y_0, and x_r = (G c)_r + G_r0 (κ y_0 − c_0) for r ≥ 1, κ = c_0(a)/a.
G is lower triangular, so that y follows from x.  On the guard {|G c| ≤ 1} |x_0| ≤ a, and since
q ≤ c_0(q) ≤ κ q for 0 ≤ q ≤ a, |x_r| ≤ 1 + |G_r0| (c_0(a) − a).
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial
from typing import Any

import numpy as np

from undertow.proofs.kernel import compiled as ops
from undertow.proofs.kernel.bound import TRIED, Bools, Goal, Point, Rule, Settled, branch, settle
from undertow.proofs.kernel.graph import Array, FloatArray, Graph, Intervals, Node, Program, Span
from undertow.proofs.kernel.model import Law, Matrix, Model, Sliding, identity, inverse

#: Boxes that are looked at together; the longest side of one that is not halved any more, and the
#: part of the longest below which a side is not, each relative to the whole box.
CHUNK, TINY, SLIM = 4096, 1e-7, 0.02


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

    def __init__(self, graph: Graph, stretch: Stretch, q: Node, size: int) -> None:
        self.graph, total = graph, identity(size, graph.number)
        if stretch.S and stretch.L is not None:
            tau = q * q / (stretch.L**2 - q * q)
            for j, S in enumerate(stretch.S, start=1):
                total = total + graph.numbers(S) * graph.power(tau, j)
        slope = graph.tangents(total.ravel(), {q: graph.number(1)})
        self.total, self.slope = total, np.array(slope, dtype=object).reshape(size, size)

    def value(self, V: Function, c: Array, c_dot: Array | None = None) -> list[Node]:
        """V, |G c|² and, where ċ is given, V̇."""
        graph, A = self.graph, self.graph.numbers(V.A)
        z = A @ c
        value = _polynomial(graph, z, dict(zip(V.exponents, V.coefficients, strict=True)))
        guard = sum(v * v for v in graph.numbers(V.G) @ c)
        seeds = {} if c_dot is None else dict(zip(z, A @ c_dot, strict=True))
        return [value, guard, *(graph.tangents([value], seeds) if seeds else [])]


def _polynomial(graph: Graph, z: Array, terms: Mapping[tuple[int, ...], Fraction]) -> Node:
    """Lay Σ coefficient · Π z_i^e_i by Horner's scheme, one variable after the other."""
    if not len(z):
        return graph.number(terms[()])
    total: Any = None
    for power in range(max(e[0] for e in terms), -1, -1):
        rest = {e[1:]: c for e, c in terms.items() if e[0] == power}
        part = _polynomial(graph, z[1:], rest) if rest else 0
        total = part if total is None else total * z[0] + part
    assert isinstance(total, Node)
    return total


def _motion(
    graph: Graph, model: Model, law: Law, y: Array, p: Sequence[Node]
) -> tuple[Array, list[Node]]:
    """ẏ of the motion on the surface, y = (q_u, v_u, w), and the pivots of M."""
    free = model.n - model.m
    lambda_a = graph.numbers(law.lambda_a)
    ratio = inverse(lambda_a)[0] @ graph.numbers(law.lambda_u)
    q_u, v_u, w = np.split(y, [free, 2 * free])
    q = np.concatenate([w - ratio @ q_u, q_u])
    on = Sliding.of(graph, model, law, q, lambda_a @ w, v_u, p)
    return np.concatenate([v_u, on.v_u_dot, on.v_a + ratio @ v_u]), on.pivots


def on_the_line(stretch: Stretch, V: Function, end: Sequence[Fraction], max_boxes: int) -> Settled:
    """Decide whether V ≤ 1 and |G c| ≤ 1 on the line from 0 to a point y."""
    graph = Graph(1)
    y = graph.inputs[0] * graph.numbers(end)
    chart = _Chart(graph, stretch, y[0], len(y))
    nodes = chart.value(V, chart.total @ y)
    most = ops.point(-1.0)  # V ≤ 1 as −V ≥ −1
    goals = [Goal(f"{what} ≤ 1 on the line", -1, most, False) for what in ("V", "|G c|²")]
    box = [(Fraction(0), Fraction(1))]
    return settle(graph.program(nodes), box, np.empty(0, dtype=complex), goals, max_boxes)


class Stage:
    """One function over the box of its guard, and the one before, which holds what is inside."""

    def __init__(
        self, model: Model, law: Law, stretch: Stretch, V: Function, inner: Function | None,
        plant: Mapping[str, tuple[Fraction, Fraction]],
    ) -> None:  # fmt: skip
        self.size = size = 2 * model.n - model.m
        self.inner, self.plant = inner, [plant[p.name] for p in model.parameters if p.name in plant]
        self.graph = graph = Graph(size + len(self.plant))
        varied = iter(graph.inputs[size:])
        own = [(k, graph.number(k.value or 0)) for k in model.parameters]
        p = [next(varied) if k.name in plant else value for k, value in own]
        self.half = half = stretch.reach(V.G[0][0])
        top = Fraction(0) if half is None else stretch.first(half)
        chord = Fraction(1) if half is None else top / half
        self.sides = [half or 0, *(1 + abs(row[0]) * (top - (half or 0)) for row in V.G[1:])]
        q = graph.inputs[0]
        chart = _Chart(graph, stretch, q, size)
        c = [chart.total[0, 0] * q]
        for r in range(1, size):
            known = [V.G[r][j] / V.G[r][r] * c[j] for j in range(1, r)]
            known.append(V.G[r][0] * chord / V.G[r][r] * q)
            c.append(1 / V.G[r][r] * graph.inputs[r] - sum(known))
        column = np.array(c, dtype=object)
        rest, _ = inverse(chart.total[1:, 1:])
        y = np.array([q, *(rest @ (column[1:] - chart.total[1:, 0] * q))], dtype=object)
        y_dot, self.pivots = _motion(graph, model, law, y, p)
        c_dot = chart.total @ y_dot + chart.slope @ y * y_dot[0]
        value, guard, self.rate = chart.value(V, column, c_dot)
        self.rates = list(y_dot)
        none = [graph.number(2), graph.number(0)]  # S_0 is empty
        before, inside = none if inner is None else chart.value(inner, column)
        nodes = [self.rate, value, before, guard, inside, *self.pivots]
        self.program, self.y = graph.program(nodes), graph.program(list(y))
        self.even = all(0 in p for p in graph.parities(nodes, size))

    def decide(self, max_boxes: int) -> Settled:
        """Decide (1) to (3) of the statement for this function."""
        at = [Span(0)] * self.size + [Span(*ends) for ends in self.plant]
        if why := self.graph.not_zero(self.rates, at, "F(0) = 0"):
            return Settled("undecided", why, (), 0)
        if self.half is None:
            return Settled("undecided", "the guard reaches the pole", (), 0)
        side, ends = ops.hulls(self.sides).imag, ops.ends(self.plant)
        low, high = np.append(-side, ends[:, 0]), np.append(side, ends[:, 1])
        unit = np.where(high > low, high - low, 1.0)
        core = self._core(0.25 * side, ends) if self.inner is None else np.full(self.size, -1.0)
        if core is None:
            return Settled("undecided", "V̇ is not shown negative definite at 0", (), 0)
        if self.even:  # half of the box will do
            high[self.size - 1] = 0.0
        rule = Rule(CHUNK, unit, TINY, SLIM, max_boxes)
        found = branch(low, high, rule, partial(self._left, core), self._false)
        return replace(found, point=self._named(found.point)) if found.point else found

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
            box = ops.between(np.append(-cube, part[:, 0]), np.append(cube, part[:, 1]))
            H = slope(box, N)[:, 1:]
            return bool((pivots(box).real > 0).all()) and _negative_definite(H)

        for _ in range(24):
            if all(falls(part) for part in slices):
                return cube
            cube = cube / 1.6
        return None

    def _false(self, middle: FloatArray, tiny: Bools) -> tuple[str, Point] | None:
        """What is false for certain at a point, (V, N), if anything."""
        for at in [*range(min(len(tiny), TRIED)), *np.flatnonzero(tiny)[:1]]:
            x = middle[:, at]
            rate, value, before, guard, _, *pivots = self.program(ops.between(x, x))[:, 0]
            if value.imag > 1.0 or guard.imag > 1.0:
                continue
            if before.real > 1.0 and rate.real > 0.0:
                return "V̇ < 0", tuple(x.tolist())
            if any(pivot.imag <= 0.0 for pivot in pivots):
                return "M ≻ 0", tuple(x.tolist())
        return None

    def _left(self, core: FloatArray, a: FloatArray, b: FloatArray) -> tuple[Bools, FloatArray]:
        """Boxes that are not settled, (1, B), and how much V̇ varies with each variable, (V, B)."""
        program: Program = self.program
        models = ops.models(program.code, program.constants, program.outputs, a, b)
        values, spread = ops.ranges(models, len(a))
        low, high = values.T.real, values.T.imag
        outside, near, falls = (low[1] > 1.0) | (low[3] > 1.0), high[4] < 1.0, high[0] < 0.0
        open_yet = near & ~(outside | falls)
        falls[open_yet] = ops.excluded(models[open_yet, :3], len(a))
        far = np.maximum(abs(a), abs(b))[: self.size]
        home = (far <= core[:, None]).all(axis=0) | (near & (high[2] < 1.0))
        inside = (high[3] < 1.0) & (home | (falls & (low[5:] > 0.0).all(axis=0)))
        return ~(outside | inside)[None], spread[:, 0].T

    def _named(self, point: Sequence[float]) -> Point:
        x = np.array(point)
        y = self.y(ops.between(x, x))[:, 0]
        return (*(0.5 * (y.real + y.imag)).tolist(), *point[self.size :])


def _negative_definite(H: Intervals) -> bool:
    """Whether every symmetric matrix in H (N, N) is: −Sᵀ H S ≻ 0, then S is invertible too."""
    if not np.isfinite(H).all():
        return False
    middle = 0.5 * H.real + 0.5 * H.imag
    values, vectors = np.linalg.eigh(-0.5 * (middle + middle.T))
    if not values[0] > 0:
        return False
    S = ops.points(vectors / np.sqrt(values))
    turned = ops.product(ops.product(np.ascontiguousarray(S.T), H), S)
    return bool(ops.dominance(ops.between(-turned.imag, -turned.real)) > 0.0)
