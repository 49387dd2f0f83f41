"""The closed loop from boxes of starts: tubes of (q, p, s) that end in a terminal set.

Coordinates and rates are those of Lemmas 8 and 10 of ``docs/certificate-format.md``.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property

import numpy as np

from undertow.proofs.kernel import compiled as ops
from undertow.proofs.kernel.graph import FloatArray, Graph, Program, Span, hull
from undertow.proofs.kernel.model import (
    Law,
    Matrix,
    Model,
    System,
    input_limits,
    scale_of,
    system,
)
from undertow.proofs.kernel.tube import Field, Held, Tube

#: Longest motion, s; steps of all tubes before the checker gives up; the thinnest part of starts.
LONGEST, MOST_STEPS, THINNEST = 15.625, 500_000, 2.0**-16

#: Steps of one tube.
MOST_OF_ONE = 50_000

#: Parts of a box of plants before a terminal set is not shown.
MOST_PLANTS = 512

Box = tuple[Fraction, Fraction]


@dataclass(frozen=True)
class Arrival:
    """Whether every tube arrived, where the first one that did not began, and what it took."""

    all: bool
    lost: FloatArray
    tubes: int
    steps: int
    latest: float


class Loop(ABC):
    """One closed loop, and the set {|W z| ≤ ρ} that its motions are to enter.

    Parameters
    ----------
    coordinates
        What moves, by a start.
    rows, radius
        W z, and the ends of ρ.
    """

    coordinates: Program
    rows: Program
    radius: tuple[float, float]

    @abstractmethod
    def tube(self, box: FloatArray) -> Tube:
        """Return a box of starts, (N, 2)."""

    @abstractmethod
    def advance(self, tube: Tube, step: float) -> tuple[float, bool]:
        """Move a set on: by how much, s, and whether it stays where model and law are regular."""

    def follow(self, box: FloatArray, step: float) -> tuple[int, float, bool]:
        """Return how many steps a tube from a box of starts (N, 2) takes, when, and if it ends."""
        tube, k, t = self.tube(box), 0, 0.0
        good = tube.map(self.coordinates)
        while good:
            if ops.norm(tube.image(self.rows)) <= self.radius[0]:
                return k, t, True
            taken, good = self.advance(tube, step)
            k, t = k + 1, t + taken
            good = good and t <= LONGEST and k < MOST_OF_ONE
        return k, t, False


class ContinuousLoop(Loop):
    """The loop whose input is renewed at every instant, and {|W x| ≤ radius}."""

    def __init__(self, model: Model, law: Law, W: Matrix, radius: Fraction) -> None:
        own, plain = System(model, law, momenta=True), system(model, law)
        graph = own.graph
        self.field, self.fixed = Field(graph, own.sliding()), own.fixed()
        self.rows, self.radius = graph.program(_times(graph, W, own.x)), hull(radius, radius)
        self.regular = graph.program(own.regular)
        self.coordinates = plain.graph.program(plain.momentum_and_surface())

    def tube(self, box: FloatArray) -> Tube:
        """Return a box of x, (2n, 2)."""
        return Tube.of(self.fixed, box)

    def advance(self, tube: Tube, step: float) -> tuple[float, bool]:
        """Move a set of (q, p, s) on by a step."""
        stay = self.field.advance(tube, step)
        if stay is None:
            return step, False
        low, high = np.vstack([stay, self.fixed]).T.copy()
        return step, _regular(self.regular(low, high)[:, 0])


class HeldLoop(Loop):
    """The loop with a held input and a plant in a box: what moves are z = (q, p, s) and the box."""

    def __init__(self, model: Model, law: Law, period: Fraction, plant: Mapping[str, Box]) -> None:
        n, m = model.n, model.m
        self.size, self.model, self.law = 2 * n, model, law
        self.period = np.array(hull(period, period))
        varied = [p for p in model.parameters if p.name in plant]
        self.varied = [p.name for p in varied]
        self.plant = [plant[p.name] for p in varied]
        states = 2 * n + len(varied)
        graph, start = Graph(states + states * (states + m) + m), Graph(states)
        self.graph, self.start, u = graph, start, graph.inputs[-m:]

        def lay(graph: Graph, momenta: bool) -> System:
            own = dict(zip(varied, graph.inputs[2 * n :], strict=False))
            p = [own[k] if k in own else graph.number(k.value or 0) for k in model.parameters]
            leaves = [*graph.inputs[: 2 * n], *p]
            return System(model, law, momenta=momenta, graph=graph, leaves=leaves)

        self.at = lay(graph, True)
        p_hat = [graph.number(p.value or 0) for p in model.parameters]
        self.known = System(model, law, graph=graph, leaves=[*self.at.x, *p_hat])
        self.known.s = self.at.s
        inside, renewed = (self.known.loop(self.known.push(layer=v))[1] for v in (True, False))
        self.demand = inside
        clipped = [
            d if i.value is None else graph.clip(d, graph.number(i.value))
            for d, i in zip(renewed, model.inputs, strict=True)
        ]
        self.rates = [*self.at.sliding(u), *([graph.number(0)] * len(varied))]
        self.field = Held(graph, self.rates, clipped)
        self.regular = graph.program([*self.at.regular, *self.known.regular])
        plain = lay(start, False)
        self.coordinates = start.program([*plain.momentum_and_surface(), *start.inputs[2 * n :]])

    def aim(self, W: Matrix, radius: Fraction) -> None:
        """Take {|W (q, D p, s)| ≤ radius} as the set."""
        n, m = self.model.n, self.model.m
        scale = [*([Fraction(1)] * n), *scale_of(self.model), *([Fraction(1)] * m)]
        W = tuple(tuple(w * c for w, c in zip(row, scale, strict=True)) for row in W)
        self.rows = self.start.program(_times(self.start, W, self.start.inputs[: self.size]))
        self.W = np.array([[hull(v, v) for v in row] for row in W])
        self.radius = hull(radius, radius)

    def tube(self, box: FloatArray) -> Tube:
        """Return a box of x and of the parameters that vary, (N, 2)."""
        return Tube.of(np.empty((0, 2)), box)

    def advance(self, tube: Tube, step: float) -> tuple[float, bool]:
        """Move a set on by a period."""
        stay = self.field.advance(tube, self.period)
        return float(self.period[1]), stay is not None and self._kept(stay)

    @cached_property
    def inside(self) -> Program:
        """The demand inside the layer and its derivative by the states, row by row."""
        one, graph = self.graph.number(1), self.graph
        slopes = [graph.tangents(self.demand, {x: one}) for x in graph.inputs[: self.field.N]]
        return graph.program([*self.demand, *(c[i] for i in range(self.model.m) for c in slopes)])

    @cached_property
    def no_equilibrium(self) -> str:
        """Why the target is not shown to be at rest with u = 0 for every plant, if it is not."""
        rest = [Span(0)] * (len(self.graph.inputs) - self.size - len(self.plant))
        at = [*([Span(0)] * self.size), *(Span(*ends) for ends in self.plant), *rest]
        try:
            values = self.graph.exact([*self.rates, *self.demand], at)
        except ArithmeticError as error:
            return f"at the target: {error}"
        return "" if all(v.zero for v in values) else "f(0, 0) = 0 is not shown exactly"

    def _kept(self, stay: FloatArray) -> bool:
        fixed = self.field.fixed(np.zeros((self.model.m, 2)))
        ends = self.regular(*np.vstack([stay, fixed]).T.copy())[:, 0]
        half = len(ends) // 2
        return _regular(ends[:half]) and _regular(ends[half:])

    def terminal(self) -> tuple[str, float]:
        """Decide Lemma 11 of the set: what is not shown, or nothing, and a margin."""
        n, m = self.model.n, self.model.m
        if self.no_equilibrium:
            return self.no_equilibrium, -np.inf
        V = ops.inverse(self.W)
        half = np.array([ops.up(ops.norm(row) * self.radius[1]) for row in V])
        if not np.isfinite(half).all():
            return "W is not shown to be invertible", -np.inf
        layer = [hull(v, v)[0] for v in self.law.layer]
        if not (half[2 * n - m :] <= layer).all():
            return "the boundary layer is left", -np.inf
        whole = np.array([hull(*ends) for ends in self.plant]).reshape(-1, 2)
        todo, tried, least = [whole], 0, np.inf
        while todo:
            part, tried = todo.pop(), tried + 1
            why, margin = self._contracts(V, np.vstack([np.column_stack([-half, half]), part]))
            least = least if why else min(least, margin)
            if why and (not len(part) or tried > MOST_PLANTS):
                return why, margin
            if why:
                width = (part[:, 1] - part[:, 0]) / (whole[:, 1] - whole[:, 0] + 1e-300)
                todo += _halves(part, int(width.argmax()))
        return "", least

    def slopes(self, X: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return x = 0 at the middle of plants, and the demand's derivative on X: (m, N, 2)."""
        m = self.model.m
        middle = np.append(np.zeros(self.size), X[self.size :].mean(axis=1))
        none = self.field.fixed(np.zeros((m, 2)))
        low, high = np.vstack([X, none]).T.copy()
        over = self.inside(low, high, len(X))
        low, high = np.vstack([np.column_stack([middle, middle]), none]).T.copy()
        at = self.inside(low, high)[:, 0]
        own = ops.mean_values(over, at, X[:, 0].copy(), X[:, 1].copy(), middle)[0]
        return middle, own[m:].reshape(m, len(X), 2)

    def _contracts(self, V: FloatArray, X: FloatArray) -> tuple[str, float]:
        """Decide Lemma 11 for a part of the plants: X (N, 2) is a box around the set, and it."""
        m, size = self.model.m, self.size
        middle, slopes = self.slopes(X)
        rows = ops.product(slopes[:, :size].copy(), V)
        most = np.array([ops.up(ops.norm(row) * self.radius[1]) for row in rows])
        if not (most <= input_limits(self.model)).all():
            return "an input limit is met", -np.inf
        u = np.column_stack([-most, most])
        found = self.field.derivative(X, middle, u, np.zeros((m, 2)), slopes, self.period)
        if found is None:
            return "motions over a period have no bounds", -np.inf
        P, stay = found
        if not self._kept(stay):
            return "model and law are not shown to be regular", -np.inf
        P = P[:size, :size].copy()
        for i in range(size):
            P[i, i] = ops.add(*P[i, i], -1.0, -1.0)
        margin = ops.decrease(ops.product(ops.product(self.W, P), V), True)
        return ("" if margin > 0.0 else "|W z| is not shown to fall"), margin


def arrive(loop: Loop, boxes: FloatArray, step: float) -> Arrival:
    """Follow boxes (K, N, 2), halved across the relatively widest side where they are lost."""
    size = np.maximum(boxes[..., 1].max(axis=0) - boxes[..., 0].min(axis=0), 1e-300)
    todo, tubes, steps, latest = [*boxes], 0, 0, 0.0
    while todo:
        part, tubes = todo.pop(), tubes + 1
        taken, when, there = loop.follow(part, step)
        steps += taken
        if there:
            latest = max(latest, when)
            continue
        width = part[:, 1] - part[:, 0]
        at = int((width / size).argmax())
        if steps > MOST_STEPS or not width[at] > size[at] * THINNEST:
            return Arrival(False, part.mean(axis=1), tubes, steps, latest)
        todo += _halves(part, at)
    return Arrival(True, np.empty(0), tubes, steps, latest)


def _halves(box: FloatArray, at: int) -> list[FloatArray]:
    """Return a box (N, 2) cut across one side."""
    lower, upper = box.copy(), box.copy()
    lower[at, 1] = upper[at, 0] = 0.5 * box[at, 0] + 0.5 * box[at, 1]
    return [lower, upper]


def _times(graph: Graph, W: Matrix, x: Sequence[int]) -> list[int]:
    return [
        graph.sum(graph.make("mul", graph.number(w), k) for w, k in zip(row, x, strict=True))
        for row in W
    ]


def _regular(ends: FloatArray) -> bool:
    """Whether pivots are > 0, and det B and det Γ not 0, by their enclosures (n + 2, 2)."""
    kept = (ends[:, 0] > 0.0) | (ends[:, 1] < 0.0)
    return bool(kept.all() and (ends[:-2, 0] > 0.0).all())
