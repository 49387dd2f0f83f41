"""The mechanism and the law of a file, and the closed loop that the kernel makes of them itself.

Formulas and Lemmas 1 and 2 of ``docs/certificate-format.md``, section 4.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from undertow.proofs.kernel.graph import FloatArray, Graph, Span, hull

Matrix = tuple[tuple[Fraction, ...], ...]
Nodes = list[list[int]]


@dataclass(frozen=True)
class Quantity:
    """A position, an input or a parameter: name and unit, and its limit or value if it has one."""

    name: str
    unit: str
    value: Fraction | None = None


@dataclass(frozen=True)
class Model:
    """M(q; p) q̈ = f(q, q̇; p) + [B(q; p); 0] u, as a graph.

    Parameters
    ----------
    positions, inputs, parameters
        n, m and P of them; the first m positions are actuated.  An input's value is its limit.
    nodes
        (kind, operands …), as in the file, numbers as rationals.
    M, f, B
        Indices of nodes: row i of M has i + 1.
    """

    name: str
    positions: tuple[Quantity, ...]
    inputs: tuple[Quantity, ...]
    parameters: tuple[Quantity, ...]
    nodes: tuple[tuple[Any, ...], ...]
    M: tuple[tuple[int, ...], ...]
    f: tuple[int, ...]
    B: tuple[tuple[int, ...], ...]

    @property
    def n(self) -> int:
        """Number of positions."""
        return len(self.positions)

    @property
    def m(self) -> int:
        """Number of inputs."""
        return len(self.inputs)

    @property
    def states(self) -> tuple[str, ...]:
        """Names of x = (q, q̇)."""
        names = [p.name for p in self.positions]
        return (*names, *(f"{name}_dot" for name in names))

    def lay(
        self, graph: Graph, leaves: Sequence[int] | None = None
    ) -> tuple[Nodes, list[int], Nodes]:
        """Lay M, f and B on a graph; x and then p are its first inputs, or other nodes."""
        n, at = self.n, list[int]()
        leaves = graph.inputs if leaves is None else leaves
        first = {"position": 0, "velocity": n, "parameter": 2 * n}
        for kind, *rest in self.nodes:
            if kind == "number":
                at.append(graph.number(rest[0]))
            elif kind in first:
                at.append(leaves[first[kind] + rest[0]])
            elif kind == "pow":
                at.append(graph.power(at[rest[0]], rest[1]))
            elif kind == "tanh":
                at.append(graph.tanh(at[rest[0]]))
            else:
                at.append(graph.make(kind, *(at[k] for k in rest)))
        mass = [[at[self.M[max(i, j)][min(i, j)]] for j in range(n)] for i in range(n)]
        return mass, [at[k] for k in self.f], [[at[k] for k in row] for row in self.B]


@dataclass(frozen=True)
class Law:
    """A surface, its reaching law, and the disturbance that its gains are for."""

    alpha_a: Matrix
    lambda_a: Matrix
    alpha_u: Matrix
    lambda_u: Matrix
    eta: tuple[Fraction, ...]
    layer: tuple[Fraction, ...]
    switching: str
    disturbance: tuple[Fraction, ...]

    @property
    def numbers(self) -> tuple[Fraction, ...]:
        """α_a, λ_a, α_u, λ_u row by row, η, ε."""
        blocks = (self.alpha_a, self.lambda_a, self.alpha_u, self.lambda_u)
        return (*(v for b in blocks for row in b for v in row), *self.eta, *self.layer)


class Algebra:
    """Matrices of nodes."""

    def __init__(self, graph: Graph) -> None:
        self.graph = graph

    def times(self, A: Nodes, B: Nodes) -> Nodes:
        """A B."""
        make = self.graph.make
        return [
            [self.graph.sum(make("mul", a, row[j]) for a, row in zip(r, B, strict=True))
             for j in range(len(B[0]))]
            for r in A
        ]  # fmt: skip

    def each(self, kind: str, A: Nodes, B: Nodes | None = None) -> Nodes:
        """Apply an operation entry by entry."""
        if B is None:
            return [[self.graph.make(kind, a) for a in row] for row in A]
        return [
            [self.graph.make(kind, a, b) for a, b in zip(r, s, strict=True)]
            for r, s in zip(A, B, strict=True)
        ]

    def factor(self, A: Nodes) -> tuple[Nodes, list[int]]:
        """L and D of A = L D Lᵀ, symmetric."""
        make, n = self.graph.make, len(A)
        L = [[self.graph.number(int(i == j)) for j in range(n)] for i in range(n)]
        D: list[int] = []
        for j in range(n):
            part = self.graph.sum(make("mul", make("sqr", L[j][k]), D[k]) for k in range(j))
            D.append(make("sub", A[j][j], part))
            for i in range(j + 1, n):
                part = self.graph.sum(
                    make("mul", make("mul", L[i][k], L[j][k]), D[k]) for k in range(j)
                )
                L[i][j] = make("div", make("sub", A[i][j], part), D[j])
        return L, D

    def solve(self, factor: tuple[Nodes, list[int]], B: Nodes) -> Nodes:
        """A⁻¹ B from the factors of A."""
        (L, D), make, n = factor, self.graph.make, len(B)
        out: Nodes = [[0] * len(B[0]) for _ in range(n)]
        for c in range(len(B[0])):
            z: list[int] = []
            for i in range(n):
                part = self.graph.sum(make("mul", L[i][k], z[k]) for k in range(i))
                z.append(make("sub", B[i][c], part))
            z = [make("div", v, d) for v, d in zip(z, D, strict=True)]
            for i in reversed(range(n)):
                part = self.graph.sum(make("mul", L[k][i], z[k]) for k in range(i + 1, n))
                z[i] = make("sub", z[i], part)
            for i in range(n):
                out[i][c] = z[i]
        return out

    def adjugate(self, A: Nodes) -> tuple[Nodes, int]:
        """Adj A and det A, without a division by entries (Faddeev and LeVerrier)."""
        make, number, m = self.graph.make, self.graph.number, len(A)
        N: Nodes = [[number(int(i == j)) for j in range(m)] for i in range(m)]
        for k in range(1, m + 1):
            step = self.times(A, N)
            trace = self.graph.sum(step[i][i] for i in range(m))
            c = make("mul", number(Fraction(-1, k)), trace)
            if k == m:
                break
            N = [[make("add", v, c) if i == j else v for j, v in enumerate(row)]
                 for i, row in enumerate(step)]  # fmt: skip
        sign = number((-1) ** (m - 1))
        return [[make("mul", sign, v) for v in row] for row in N], make("mul", number((-1) ** m), c)

    def inverse(self, A: Nodes) -> tuple[Nodes, int]:
        """A⁻¹, undefined where det A = 0, and det A."""
        adjugate, determinant = self.adjugate(A)
        once = self.graph.make("div", self.graph.number(1), determinant)
        return [[self.graph.make("mul", v, once) for v in row] for row in adjugate], determinant


@dataclass(frozen=True)
class Sliding:
    """The motion on the surface (5.1): v_a, v̇_u, pivots of M ≻ 0, and det α_a and det E."""

    v_a: Nodes
    v_u_dot: Nodes
    pivots: list[int]
    determinants: list[int]

    @classmethod
    def of(
        cls, algebra: Algebra, model: Model, law: Law, q: Nodes, pull: Nodes, v_u: Nodes,
        p: Sequence[int],
    ) -> Sliding:  # fmt: skip
        """Lay it on a graph, of nodes q, pull = λ_a q_a + λ_u q_u, v_u and parameters."""
        graph, m = algebra.graph, model.m
        lambda_a, lambda_u, alpha_a, alpha_u = (
            [[graph.number(v) for v in row] for row in block]
            for block in (law.lambda_a, law.lambda_u, law.alpha_a, law.alpha_u)
        )
        alpha, first = algebra.inverse(alpha_a)
        pull = algebra.each("add", pull, algebra.times(alpha_u, v_u))
        v_a = algebra.each("neg", algebra.times(alpha, pull))
        M, f, _ = model.lay(graph, [*(r[0] for r in (*q, *v_a, *v_u)), *p])
        order = [*range(m, model.n), *range(m)]
        _, pivots = algebra.factor([[M[i][j] for j in order] for i in order])
        thrown = algebra.times([row[:m] for row in M[m:]], alpha)
        E = algebra.each("sub", [row[m:] for row in M[m:]], algebra.times(thrown, alpha_u))
        drift = algebra.each("add", algebra.times(lambda_a, v_a), algebra.times(lambda_u, v_u))
        right = algebra.each("add", [[v] for v in f[m:]], algebra.times(thrown, drift))
        back, second = algebra.inverse(E)
        return cls(v_a, algebra.times(back, right), pivots, [first, second])


class System:
    """The plant and the law on one graph: everything that claims are about.

    The inputs are x = (q, q̇), then the parameters, then, where ``law`` is None, the numbers of
    a law as :attr:`Law.numbers` gives them; else they are exact in the graph.  ``leaves`` are other
    nodes for x and the parameters, of their own ``graph``.  With ``momenta`` the first of them are
    (q, p, s) instead, and ``x`` are nodes of them.
    """

    def __init__(
        self,
        model: Model,
        law: Law | None,
        switching: str = "saturation",
        disturbance: Sequence[Fraction] = (),
        momenta: bool = False,
        graph: Graph | None = None,
        leaves: Sequence[int] = (),
    ) -> None:
        n, m = model.n, model.m
        self.model, self.law = model, law
        self.switching = law.switching if law is not None else switching
        bounds = law.disturbance if law is not None else disturbance
        fixed = 2 * n + len(model.parameters)
        if graph is None:
            graph = Graph(fixed + (2 * m * n + 2 * m if law is None else 0))
            leaves = graph.inputs[:fixed]
        self.graph = graph
        nodes = graph.inputs[fixed:] if law is None else [graph.number(v) for v in law.numbers]
        given = iter(nodes)

        def block(rows: int, columns: int) -> Nodes:
            return [[next(given) for _ in range(columns)] for _ in range(rows)]

        self.alpha_a, self.lambda_a = block(m, m), block(m, m)
        self.alpha_u, self.lambda_u = block(m, n - m), block(m, n - m)
        self.eta, self.layer = block(1, m)[0], block(1, m)[0]
        self.x = list(leaves[: 2 * n])
        self.M, self.f, self.B = model.lay(graph, leaves)
        self.algebra = algebra = Algebra(graph)
        M_aa, self.M_au = [r[:m] for r in self.M[:m]], [r[m:] for r in self.M[:m]]
        self.M_ua, M_uu = [r[:m] for r in self.M[m:]], [r[m:] for r in self.M[m:]]
        self.uu = algebra.factor(M_uu)
        self.X = algebra.solve(self.uu, self.M_ua)
        self.S = algebra.each("sub", M_aa, algebra.times(self.M_au, self.X))
        self.S = [[self.S[max(i, j)][min(i, j)] for j in range(m)] for i in range(m)]
        self.ss = algebra.factor(self.S)
        self.gamma = algebra.each("sub", self.alpha_a, algebra.times(self.alpha_u, self.X))
        self.gamma_adjugate, self.gamma_determinant = algebra.adjugate(self.gamma)
        self.B_adjugate, self.B_determinant = algebra.adjugate(self.B)
        self.bounds = [graph.number(v) for v in bounds]
        if momenta:
            self._slide(leaves)

    def _slide(self, z: Sequence[int]) -> None:
        """Take the inputs for (q, p, s): q̇ from M_ua v_a + M_uu v_u = D p, and s."""
        graph, algebra, n, m = self.graph, self.algebra, self.model.n, self.model.m
        p = [graph.make("mul", d, v) for d, v in zip(self.scale, z[n : 2 * n - m], strict=True)]
        y = algebra.solve(self.uu, self._column(p))
        self.s = list(z[2 * n - m : 2 * n])
        right = algebra.each("sub", self._column(self.s), algebra.times(self.alpha_u, y))
        for A, q in ((self.lambda_a, z[:m]), (self.lambda_u, z[m:n])):
            right = algebra.each("sub", right, algebra.times(A, self._column(q)))
        v_a = algebra.times(self.gamma_adjugate, right)
        v_a = [[graph.make("div", row[0], self.gamma_determinant)] for row in v_a]
        v_u = algebra.each("sub", y, algebra.times(self.X, v_a))
        self.x = [*z[:n], *(row[0] for row in (*v_a, *v_u))]
        _, self.f, _ = self.model.lay(graph, [*self.x, *z[2 * n :]])

    @cached_property
    def scale(self) -> list[int]:
        """D, (n − m,), near the diagonal of M_uu at the target: p is of the size of a rate."""
        return [self.graph.number(v) for v in scale_of(self.model)]

    def momentum_and_surface(self) -> list[int]:
        """Return (q, p, s) by x."""
        n, m = self.model.n, self.model.m
        p = [row[0] for row in self.algebra.times(self.M[m:], self._column(self.x[n:]))]
        p = [self.graph.make("div", a, d) for a, d in zip(p, self.scale, strict=True)]
        return [*self.x[:n], *p, *self.s]

    def sliding(self, u: Sequence[int] | None = None) -> list[int]:
        """Return the rates of (q, p, s), of the loop with its layer and its clip (Lemma 8).

        With other inputs u, nodes, those of the plant with them (Lemma 10).
        """
        graph, algebra, n, m = self.graph, self.algebra, self.model.n, self.model.m
        make, zero, v = graph.make, graph.number(0), self.x[n:]
        speeds = dict(zip(self.x[:n], v, strict=True))
        turned = [graph.tangents(row, speeds) for row in self.M[m:]]
        force = algebra.each(
            "add", self._column(self.f[m:]), algebra.times(turned, self._column(v))
        )
        p_dot = [make("div", row[0], d) for row, d in zip(force, self.scale, strict=True)]
        push = [zero] * m if u is not None else self.push(layer=False)
        over: Nodes = []  # d − u
        for i, (d, limit) in enumerate(zip(self.loop(push)[1], self.model.inputs, strict=True)):
            if u is not None:
                over.append([make("sub", d, u[i])])
                continue
            end = graph.number(limit.value or 0)
            above = make("max", make("sub", d, end), zero)
            below = make("min", make("add", d, end), zero)
            over.append([zero if limit.value is None else make("add", above, below)])
        lost = algebra.times(self.gamma, algebra.solve(self.ss, algebra.times(self.B, over)))
        pairs = zip(push, lost, strict=True)
        return [*v, *p_dot, *(make("neg", make("add", a, row[0])) for a, row in pairs)]

    @property
    def regular(self) -> list[int]:
        """Pivots of M, which are to be > 0, then det B and det Γ, which are not to be 0."""
        return [*self.pivots, self.B_determinant, self.gamma_determinant]

    @property
    def odd(self) -> bool:
        """Whether M and B are shown to be even in x, and f odd: motions come in pairs (Lemma 9)."""
        even = [v for row in (*self.M, *self.B) for v in row]
        shown = self.graph.parities([*even, *self.f], 2 * self.model.n)
        return all((k >= len(even)) in parity for k, parity in enumerate(shown))

    @property
    def pivots(self) -> list[int]:
        """Those of M with the unactuated block first: all > 0 iff M is positive definite."""
        return [*self.uu[1], *self.ss[1]]

    def _absolute(self, A: Nodes) -> Nodes:
        return self.algebra.each("abs", A)

    def _one(self, k: int) -> Nodes:
        return [[self.graph.number(int(i == j)) for j in range(k)] for i in range(k)]

    def _column(self, nodes: Sequence[int]) -> Nodes:
        return [[v] for v in nodes]

    @cached_property
    def s(self) -> list[int]:
        """s, (m,)."""
        graph, n, m = self.graph, self.model.n, self.model.m
        x = self.x
        parts = (
            (self.alpha_a, x[n : n + m]), (self.lambda_a, x[:m]),
            (self.alpha_u, x[n + m : 2 * n]), (self.lambda_u, x[m:n]),
        )  # fmt: skip
        products = [self.algebra.times(A, self._column(v)) for A, v in parts]
        return [graph.sum(p[i][0] for p in products) for i in range(m)]

    @cached_property
    def gains(self) -> list[int]:
        """k, (m,)."""
        graph, algebra, m, n = self.graph, self.algebra, self.model.m, self.model.n
        if not any(graph.value(b) != 0 for b in self.bounds):
            return self.eta
        g_a, g_u = self._column(self.bounds[:m]), self._column(self.bounds[m:])
        X = self._absolute(self.X)
        transposed = [list(r) for r in zip(*X, strict=True)]
        S_inverse = self._absolute(algebra.solve(self.ss, self._one(m)))
        uu_inverse = self._absolute(algebra.solve(self.uu, self._one(n - m)))
        a = algebra.times(S_inverse, algebra.each("add", g_a, algebra.times(transposed, g_u)))
        b = algebra.each("add", algebra.times(uu_inverse, g_u), algebra.times(X, a))
        largest = []
        for column in (a, b):
            top = column[0][0]
            for row in column[1:]:
                top = graph.make("max", top, row[0])
            largest.append(top)
        k = []
        for i in range(m):
            total = self.eta[i]
            for rows, top in ((self.alpha_a, largest[0]), (self.alpha_u, largest[1])):
                weight = graph.sum(graph.make("abs", v) for v in rows[i])
                total = graph.make("add", total, graph.make("mul", weight, top))
            k.append(total)
        return k

    def push(self, *, layer: bool) -> list[int]:
        """K σ, (m,), with s_i/ε_i in place of its saturation if ``layer``, as inside of it."""
        graph, push = self.graph, []
        for s, e, k in zip(self.s, self.layer, self.gains, strict=True):
            ratio = graph.make("div", s, e)
            if self.switching == "tanh":
                ratio = graph.tanh(ratio)
            elif not layer:
                ratio = graph.clip(ratio, graph.number(1))
            push.append(graph.make("mul", k, ratio))
        return push

    def loop(self, push: Sequence[int]) -> tuple[list[int], list[int]]:
        """Return q̈ (n,) and the demand d (m,) of the loop whose input is it, with K σ = push."""
        graph, algebra, n, m = self.graph, self.algebra, self.model.n, self.model.m
        make = graph.make
        y = algebra.solve(self.uu, self._column(self.f[m:]))
        h = algebra.each("sub", self._column(self.f[:m]), algebra.times(self.M_au, y))
        x = self.x
        drive = algebra.times(self.alpha_u, y)
        for A, v in ((self.lambda_a, x[n : n + m]), (self.lambda_u, x[n + m : 2 * n])):
            drive = algebra.each("add", drive, algebra.times(A, self._column(v)))
        drive = algebra.each("add", drive, self._column(push))
        w = [
            [make("neg", make("div", row[0], self.gamma_determinant))]
            for row in algebra.times(self.gamma_adjugate, drive)
        ]
        force = algebra.each("sub", algebra.times(self.S, w), h)
        demand = [
            make("div", row[0], self.B_determinant) for row in algebra.times(self.B_adjugate, force)
        ]
        free = algebra.each("sub", y, algebra.times(self.X, w))
        return [row[0] for row in (*w, *free)], demand

    def fixed(self) -> FloatArray:
        """Enclosures of the parameters."""
        values = [p.value for p in self.model.parameters]
        return np.array([hull(v, v) for v in values if v is not None]).reshape(-1, 2)

    def origin(self) -> list[Span]:
        """Exact inputs at x = 0."""
        values = [Span(p.value) for p in self.model.parameters if p.value is not None]
        return [*([Span(0)] * (2 * self.model.n)), *values]


def input_limits(model: Model) -> FloatArray:
    """Lower bounds of the input limits, (m,), ∞ for none."""
    ends = [math.inf if i.value is None else hull(i.value, i.value)[0] for i in model.inputs]
    return np.array(ends)


@lru_cache(maxsize=64)
def scale_of(model: Model) -> tuple[Fraction, ...]:
    """Doubles near the diagonal of M_uu at the target, (n − m,).

    Raises
    ------
    ArithmeticError
        Where M may not be defined there.
    """
    graph = Graph(2 * model.n)
    leaves = [*graph.inputs, *(graph.number(p.value or 0) for p in model.parameters)]
    mass, _, _ = model.lay(graph, leaves)
    at = graph.exact([mass[i][i] for i in range(model.m, model.n)], [Span(0)] * (2 * model.n))
    return tuple(Fraction(float(v.low)) for v in at)


@lru_cache(maxsize=64)
def system(model: Model, law: Law) -> System:
    """Return the system of a model and a law; equal ones share it."""
    return System(model, law)
