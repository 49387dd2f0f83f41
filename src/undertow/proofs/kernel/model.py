"""The mechanism and the law of a file, and the closed loop that the kernel makes of them itself.

Formulas and Lemmas 1 and 2 of ``docs/certificate-format.md``, section 4.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property, lru_cache, partial, reduce
from typing import Any

import numpy as np

from undertow.proofs.kernel.compiled import hull, hulls
from undertow.proofs.kernel.graph import Array, FloatArray, Graph, Intervals, Node, Program, Span

Matrix = tuple[tuple[Fraction, ...], ...]


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

    @property
    def limits(self) -> FloatArray:
        """Lower bounds of the input limits, (m,), ∞ for none."""
        return np.array([math.inf if i.value is None else hull(i.value).real for i in self.inputs])

    def lay(self, graph: Graph, leaves: Sequence[Node] | Array) -> tuple[Array, Array, Array]:
        """Lay M (n, n), f (n,) and B (m, m) on a graph: x and then p are these nodes."""
        n, at = self.n, list[Node]()
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
        nodes = np.array(at, dtype=object)
        mass = [[self.M[max(i, j)][min(i, j)] for j in range(n)] for i in range(n)]
        return nodes[mass], nodes[list(self.f)], nodes[list(map(list, self.B))]


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
    def rows(self) -> Intervals:
        """C of s = C x, enclosed, (m, 2n)."""
        blocks = self.lambda_a, self.lambda_u, self.alpha_a, self.alpha_u
        return np.hstack([hulls(block) for block in blocks])


# -- matrices of nodes, (…,) ----------------------------------------------------------------------


def identity(size: int, number: Callable[[int], Any]) -> Array:
    """Return I, of nodes or of other numbers."""
    return np.array([[number(int(i == j)) for j in range(size)] for i in range(size)], dtype=object)


def factor(A: Array) -> tuple[Array, list[Node]]:
    """L and D of A = L D Lᵀ, symmetric."""
    n, D = len(A), list[Node]()
    L = identity(n, A[0, 0].graph.number)
    for j in range(n):
        D.append(A[j, j] - sum(L[j, k] * L[j, k] * D[k] for k in range(j)))
        for i in range(j + 1, n):
            L[i, j] = (A[i, j] - sum(L[i, k] * L[j, k] * D[k] for k in range(j))) / D[j]
    return L, D


def solve(factors: tuple[Array, list[Node]], B: Array) -> Array:
    """A⁻¹ B from the factors of A, for a matrix or a vector."""
    (L, D), z, n = factors, list[Any](), len(B)
    for i in range(n):
        z.append(B[i] - sum(L[i, k] * z[k] for k in range(i)))
    z = [v / d for v, d in zip(z, D, strict=True)]
    for i in reversed(range(n)):
        z[i] = z[i] - sum(L[k, i] * z[k] for k in range(i + 1, n))
    return np.array(z, dtype=object)


def characteristic(A: Array, number: Callable[[Any], Any]) -> tuple[list[Any], Array]:
    """Coefficients of det(x − A), highest power first, and adj A (Faddeev and LeVerrier).

    A is of nodes or of other numbers, and ``number`` makes one.
    """
    size, out = len(A), [number(1)]
    N, diagonal = identity(size, number), np.diag_indices(size)
    for k in range(1, size + 1):
        step = A @ N
        out.append(number(Fraction(-1, k)) * step.trace())
        if k < size:
            N = step
            N[diagonal] = N[diagonal] + out[-1]
    return out, N * number((-1) ** (size - 1))


def adjugate(A: Array) -> tuple[Array, Node]:
    """Adj A and det A, without a division by entries."""
    number = A[0, 0].graph.number
    coefficients, out = characteristic(A, number)
    return out, number((-1) ** len(A)) * coefficients[-1]


def inverse(A: Array) -> tuple[Array, Node]:
    """A⁻¹, undefined where det A = 0, and det A."""
    out, determinant = adjugate(A)
    return out * (1 / determinant), determinant


@dataclass(frozen=True)
class Sliding:
    """The motion on the surface (5.1): v_a, v̇_u, pivots of M ≻ 0, and det α_a and det E."""

    v_a: Array
    v_u_dot: Array
    pivots: list[Node]
    determinants: list[Node]

    @classmethod
    def of(
        cls, graph: Graph, model: Model, law: Law, q: Array, pull: Array, v_u: Array,
        p: Sequence[Node],
    ) -> Sliding:  # fmt: skip
        """Lay it on a graph, of nodes q, pull = λ_a q_a + λ_u q_u, v_u and parameters."""
        n, m = model.n, model.m
        lambda_a, lambda_u = graph.numbers(law.lambda_a), graph.numbers(law.lambda_u)
        alpha_u = graph.numbers(law.alpha_u)
        alpha, first = inverse(graph.numbers(law.alpha_a))
        v_a = -(alpha @ (pull + alpha_u @ v_u))
        M, f, _ = model.lay(graph, [*q, *v_a, *v_u, *p])
        order = [*range(m, n), *range(m)]
        _, pivots = factor(M[np.ix_(order, order)])
        thrown = M[m:, :m] @ alpha
        back, second = inverse(M[m:, m:] - thrown @ alpha_u)
        right = f[m:] + thrown @ (lambda_a @ v_a + lambda_u @ v_u)
        return cls(v_a, back @ right, pivots, [first, second])


class System:
    """The plant and the law on one graph: everything that claims are about.

    The inputs are x = (q, q̇) and then the parameters; ``leaves`` are other nodes for them, of their
    own ``graph``, of which the law's numbers may be nodes too.  With ``momenta`` the first of them
    are (q, p, s) instead, and ``x`` are nodes of them.
    """

    def __init__(
        self,
        model: Model,
        law: Law,
        momenta: bool = False,
        graph: Graph | None = None,
        leaves: Sequence[Node] | Array = (),
    ) -> None:
        n, m = model.n, model.m
        if graph is None:
            graph = Graph(2 * n + len(model.parameters))
            leaves = graph.inputs
        self.model, self.law, self.graph = model, law, graph
        self.alpha_a, self.lambda_a = graph.numbers(law.alpha_a), graph.numbers(law.lambda_a)
        self.alpha_u, self.lambda_u = graph.numbers(law.alpha_u), graph.numbers(law.lambda_u)
        self.eta, self.layer = graph.numbers(law.eta), graph.numbers(law.layer)
        self.x = np.array(leaves[: 2 * n], dtype=object)
        self.M, self.f, self.B = model.lay(graph, leaves)
        self.M_au, M_uu = self.M[:m, m:], self.M[m:, m:]
        self.uu = factor(M_uu)
        self.X = solve(self.uu, self.M[m:, :m])
        S = self.M[:m, :m] - self.M_au @ self.X
        self.S = np.where(np.tri(m, dtype=bool), S, S.T)
        self.ss = factor(self.S)
        self.gamma = self.alpha_a - self.alpha_u @ self.X
        self.gamma_adjugate, self.gamma_determinant = adjugate(self.gamma)
        self.B_adjugate, self.B_determinant = adjugate(self.B)
        if momenta:
            self._slide(leaves)

    def _slide(self, leaves: Sequence[Node] | Array) -> None:
        """Take the inputs for (q, p, s): q̇ from M_ua v_a + M_uu v_u = D p, and s."""
        n, m = self.model.n, self.model.m
        q_a, q_u, p, self.s = np.split(self.x, [m, n, 2 * n - m])
        y = solve(self.uu, self.scale * p)
        right = self.s - self.alpha_u @ y - self.lambda_a @ q_a - self.lambda_u @ q_u
        v_a = self.gamma_adjugate @ right / self.gamma_determinant
        self.x = np.concatenate([q_a, q_u, v_a, y - self.X @ v_a])
        _, self.f, _ = self.model.lay(self.graph, [*self.x, *leaves[2 * n :]])

    @cached_property
    def scale(self) -> Array:
        """D, (n − m,), near the diagonal of M_uu at the target: p is of the size of a rate."""
        return self.graph.numbers(scale_of(self.model))

    def momentum_and_surface(self) -> list[Node]:
        """Return (q, p, s) by x."""
        q, v = np.split(self.x, 2)
        return [*q, *(self.M[self.model.m :] @ v / self.scale), *self.s]

    def sliding(self, u: Array | None = None) -> list[Node]:
        """Return the rates of (q, p, s), of the loop with its layer and its clip (Lemma 8).

        With other inputs u, nodes, those of the plant with them (Lemma 10).
        """
        graph, m = self.graph, self.model.m
        q, v = np.split(self.x, 2)
        speeds = dict(zip(q, v, strict=True))
        turned = np.array([graph.tangents(row, speeds) for row in self.M[m:]], dtype=object)
        p_dot = (self.f[m:] + turned @ v) / self.scale
        push = graph.numbers([0] * m) if u is not None else self.push(layer=False)
        demand = self.loop(push)[1]
        clip = [self._beyond(*pair) for pair in zip(demand, self.model.inputs, strict=True)]
        over = np.array(clip, dtype=object) if u is None else demand - u  # d − u
        lost = self.gamma @ solve(self.ss, self.B @ over)
        return [*v, *p_dot, *(-(push + lost))]

    def _beyond(self, demand: Node, own: Quantity) -> Node:
        """What the clip takes off a demand."""
        if own.value is None:
            return self.graph.number(0)
        make = self.graph.make
        return make("max", demand - own.value, 0) + make("min", demand + own.value, 0)

    @property
    def regular(self) -> list[Node]:
        """What :func:`is_regular` asks of: pivots of M (Lemma 2), then det B and det Γ."""
        return [*self.uu[1], *self.ss[1], self.B_determinant, self.gamma_determinant]

    @property
    def odd(self) -> bool:
        """Whether M and B are shown to be even in x, and f odd: motions come in pairs (Lemma 9)."""
        even = [*self.M.flat, *self.B.flat]
        shown = self.graph.parities([*even, *self.f], 2 * self.model.n)
        return all((k >= len(even)) in parity for k, parity in enumerate(shown))

    @property
    def thrust(self) -> Array:
        """[α_a α_u] M⁻¹, (m, n): what a force adds to ṡ (Lemma 1)."""
        m, number = self.model.m, self.graph.number
        actuated = self.gamma @ solve(self.ss, identity(m, number))
        rest = self.alpha_u - actuated @ self.M_au
        return np.hstack([actuated, rest @ solve(self.uu, identity(self.model.n - m, number))])

    @cached_property
    def s(self) -> Array:
        """s, (m,)."""
        n, m = self.model.n, self.model.m
        q_a, q_u, v_a, v_u = np.split(self.x, [m, n, n + m])
        on = self.alpha_a @ v_a + self.lambda_a @ q_a + self.alpha_u @ v_u + self.lambda_u @ q_u
        return np.asarray(on)

    @cached_property
    def gains(self) -> Array:
        """k, (m,)."""
        graph, m, n = self.graph, self.model.m, self.model.n
        if not any(self.law.disturbance):
            return self.eta
        g_a, g_u = np.split(graph.numbers(self.law.disturbance), [m])
        X = abs(self.X)
        S_inverse = abs(solve(self.ss, identity(m, graph.number)))
        uu_inverse = abs(solve(self.uu, identity(n - m, graph.number)))
        a = S_inverse @ (g_a + X.T @ g_u)
        b = uu_inverse @ g_u + X @ a
        k = self.eta
        for rows, column in ((self.alpha_a, a), (self.alpha_u, b)):
            k = k + abs(rows).sum(axis=1) * reduce(partial(graph.make, "max"), column)
        return k

    def push(self, *, layer: bool) -> Array:
        """K σ, (m,), with s_i/ε_i in place of its saturation if ``layer``, as inside of it."""
        graph, ratio = self.graph, self.s / self.layer
        if self.law.switching == "tanh":
            ratio = np.array([graph.tanh(r) for r in ratio], dtype=object)
        elif not layer:
            ratio = np.array([graph.clip(r, 1) for r in ratio], dtype=object)
        return np.asarray(self.gains * ratio)

    def loop(self, push: Array) -> tuple[list[Node], Array]:
        """Return q̈ (n,) and the demand d (m,) of the loop whose input is it, with K σ = push."""
        n, m = self.model.n, self.model.m
        v_a, v_u = np.split(self.x[n:], [m])
        y = solve(self.uu, self.f[m:])
        h = self.f[:m] - self.M_au @ y
        drive = self.alpha_u @ y + self.lambda_a @ v_a + self.lambda_u @ v_u + push
        w = -(self.gamma_adjugate @ drive / self.gamma_determinant)
        demand = self.B_adjugate @ (self.S @ w - h) / self.B_determinant
        return [*w, *(y - self.X @ w)], demand

    @cached_property
    def within_layer(self) -> Program:
        """q̈, the demand and what is regular, of the loop inside the layer."""
        q_dd, demand = self.loop(self.push(layer=True))
        return self.graph.program([*q_dd, *demand, *self.regular])

    def fixed(self) -> Intervals:
        """Enclosures of the parameters."""
        return np.asarray(hulls([p.value for p in self.model.parameters]))

    def origin(self) -> list[Span]:
        """Exact inputs at x = 0."""
        values = [Span(p.value) for p in self.model.parameters if p.value is not None]
        return [*([Span(0)] * (2 * self.model.n)), *values]


def is_regular(values: Intervals, n: int) -> bool:
    """Whether enclosures of :attr:`System.regular` show it: n pivots > 0, determinants not 0."""
    positive = values.real > 0.0
    return bool(positive[:n].all() and (positive | (values.imag < 0.0)).all())


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
    at = graph.exact(mass.diagonal()[model.m :], [Span(0)] * (2 * model.n))
    return tuple(Fraction(float(v.low)) for v in at)


@lru_cache(maxsize=64)
def system(model: Model, law: Law) -> System:
    """Return the system of a model and a law; equal ones share it."""
    return System(model, law)
