"""The closed loop from boxes of starts: tubes of (q, p, s) that end in a terminal set.

Coordinates and rates are those of Lemmas 8 and 10 of ``docs/certificate-format.md``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property

import numpy as np

from undertow.proofs.kernel import compiled as ops
from undertow.proofs.kernel.graph import Array, FloatArray, Graph, Intervals, Program, Span
from undertow.proofs.kernel.model import Law, Matrix, Model, System, is_regular, scale_of, system
from undertow.proofs.kernel.tube import Field, Held, Sampled, Tube

#: Longest motion, s; steps of one tube, and of all before the checker gives up.
LONGEST, MOST_OF_ONE, MOST_STEPS = 15.625, 50_000, 500_000

#: The thinnest part of the starts; parts of a box of plants before a terminal set is not shown.
THINNEST, MOST_PLANTS = 2.0**-16, 512

#: How far inside the layer, of its width, a set is cut at its edge: a part of one piece.
EDGE = 2.0**-10

#: What may not be shown of a terminal set.
SINGULAR, IRREGULAR = "W is not shown to be invertible", "model and law are not shown to be regular"
LAYER_LEFT, LIMIT_MET = "the boundary layer is left", "an input limit is met"


def ellipsoid(
    program: Program, fixed: Intervals, W: Intervals, radius: float, C: Intervals,
    layer: FloatArray, limits: FloatArray, centre: Intervals | None = None,
) -> tuple[str, float, FloatArray]:  # fmt: skip
    """Decide Lemma 5 for {|W x| ≤ radius}: what is not shown, or "", margin, half-sides of Q.

    W (2n, 2n) and C (m, 2n) are intervals, radius is rounded up, layer and limits down.
    Outputs of the program are q̈ (n), the demand (m) and what is regular (n + 2); ``centre`` are
    their values at x = 0, where they are known already.
    """
    V, size, m = ops.inverse(W), len(W), len(layer)
    half, n = ops.extents(V, radius), size // 2
    if not np.isfinite(half).all():
        return SINGULAR, -np.inf, np.zeros(size)
    if centre is None:
        centre = program(np.concatenate([np.zeros(size), fixed]))[:, 0]
    whole = program(np.concatenate([ops.between(-half, half), fixed]), size)
    if np.isnan(whole).any() or not is_regular(whole[n + m :, 0], n):
        return IRREGULAR, -np.inf, half
    if not (ops.extents(ops.product(C, V), radius) <= layer).all():
        return LAYER_LEFT, -np.inf, half
    slopes = whole[:, 1:].copy()
    most = ops.extents(ops.product(slopes[n : n + m], V), radius)
    demand = ops.sums(centre[n : n + m], ops.between(-most, most))
    if not ((-limits <= demand.real) & (demand.imag <= limits)).all():
        return LIMIT_MET, -np.inf, half
    F = np.vstack([ops.points(np.eye(n, size, n)), slopes[:n]])
    margin = ops.decrease(ops.product(ops.product(W, F), V), False)
    return "" if margin > 0.0 else "V̇ < 0 is not shown", margin, half


@dataclass(frozen=True)
class Arrival:
    """Whether every tube arrived, where the first one that did not began, and what it took."""

    all: bool
    lost: FloatArray
    tubes: int
    steps: int
    latest: float


class Loop:
    """One closed loop, and the set {|W z| ≤ ρ} that its motions are to enter.

    Attributes
    ----------
    field, fixed, step
        How states move, inputs of its graph besides them, (F,), and by how much at once, s.
    coordinates
        States, by a start.
    rows, radius
        W z, and the ends of ρ.
    """

    model: Model
    law: Law
    field: Field
    fixed: Intervals
    step: complex
    coordinates: Program
    regular: Program
    rows: Program
    radius: complex

    def tube(self, box: FloatArray) -> Tube:
        """Return a box of starts, (N, 2)."""
        return Tube.of(self.fixed, box)

    def advance(self, tube: Tube) -> bool:
        """Move a set on by a step; whether it stays where model and law are regular.

        Across an edge of the layer s_i moves by parts too (Lemma 13).
        """
        reach = dict[int, Intervals]()
        for k, layer in enumerate(self.law.layer, 2 * self.model.n - self.model.m):
            edge, ends = float(layer) * (1 - EDGE), (tube.hull[k].real, tube.hull[k].imag)
            cuts = sorted({*ends, *np.clip([-edge, edge], *ends)})
            parts = [replace(tube) for _ in cuts[1:]]
            for part, low, high in zip(parts, cuts, cuts[1:], strict=False):
                part.restrict(k, low, high)
            if len(parts) > 1 and all(map(self._advance, parts)):
                reach[k] = np.array([part.hull[k] for part in parts])
        if not self._advance(tube):
            return False
        for k, after in reach.items():
            own = tube.hull[k]
            low, high = np.clip([after.real.min(), after.imag.max()], own.real, own.imag)
            if high - low < own.imag - own.real:
                tube.restrict(k, low, high)
        return True

    def _advance(self, tube: Tube) -> bool:
        stay = self.field.advance(tube, self.step.imag)
        return stay is not None and self.kept(stay, self.fixed)

    def kept(self, stay: Intervals, fixed: Intervals) -> bool:
        """Whether model and law are regular on a box."""
        values = self.regular(np.concatenate([stay, fixed]))[:, 0]
        return all(is_regular(v, self.model.n) for v in values.reshape(-1, self.model.n + 2))

    def aim(self, graph: Graph, x: Array, W: Matrix, radius: Fraction) -> None:
        """Take {|W x| ≤ radius} as the set."""
        self.W, self.radius = ops.hulls(W), ops.hull(radius)
        self.rows = graph.program(graph.numbers(W) @ x)

    def follow(self, box: FloatArray, most: int = MOST_OF_ONE) -> tuple[int, bool]:
        """Return how many steps a tube from a box of starts (N, 2) takes, and whether it ends."""
        tube, most = self.tube(box), min(int(LONGEST / self.step.imag), most)
        good, k = tube.map(self.coordinates), 0
        while good and k <= most:
            if ops.norm(tube.image(self.rows)) <= self.radius.real:
                return k, True
            good, k = self.advance(tube), k + 1
        return k, False

    def arrive(self, boxes: FloatArray) -> Arrival:
        """Follow boxes (K, N, 2), halved across the relatively widest side where they are lost."""
        size = np.maximum(boxes[..., 1].max(axis=0) - boxes[..., 0].min(axis=0), 1e-300)
        todo, tubes, steps, latest, unit = [*boxes], 0, 0, 0, self.step.imag
        while todo:
            part, tubes = todo.pop(), tubes + 1
            taken, there = self.follow(part)
            steps += taken
            if there:
                latest = max(latest, taken)
                continue
            width = part[:, 1] - part[:, 0]
            at = int((width / size).argmax())
            if steps > MOST_STEPS or not width[at] > size[at] * THINNEST:
                return Arrival(False, part.mean(axis=1), tubes, steps, latest * unit)
            todo += halves(part, at)
        return Arrival(True, np.empty(0), tubes, steps, latest * unit)


class ContinuousLoop(Loop):
    """The loop whose input is renewed at every instant, and {|W x| ≤ radius}."""

    def __init__(self, model: Model, law: Law, W: Matrix, radius: Fraction, step: Fraction) -> None:
        own, plain = System(model, law, momenta=True), system(model, law)
        self.model, self.law = model, law
        self.field, self.fixed = Field(own.graph, own.sliding()), own.fixed()
        self.step = ops.point(float(step))
        self.aim(own.graph, own.x, W, radius)
        self.regular = own.graph.program(own.regular)
        self.coordinates = plain.graph.program(plain.momentum_and_surface())


class HeldLoop(Loop):
    """The loop with a held input and a plant in a box: states are (q, p, s) and what varies."""

    def __init__(
        self,
        model: Model,
        law: Law,
        period: Fraction,
        plant: Mapping[str, tuple[Fraction, Fraction]],
    ) -> None:
        n, m = model.n, model.m
        self.size, self.model, self.law = 2 * n, model, law
        varied = [p for p in model.parameters if p.name in plant]
        self.varied, self.plant = [p.name for p in varied], [plant[p.name] for p in varied]
        states = 2 * n + len(varied)
        graph, start = Graph(states + states * (states + m) + m), Graph(states)
        self.graph, self.start = graph, start

        def lay(graph: Graph, momenta: bool) -> System:
            own = dict(zip(varied, graph.inputs[2 * n : states], strict=True))
            p = [own[k] if k in own else graph.number(k.value or 0) for k in model.parameters]
            leaves = [*graph.inputs[: 2 * n], *p]
            return System(model, law, momenta=momenta, graph=graph, leaves=leaves)

        at, plain = lay(graph, True), lay(start, False)
        p_hat = [graph.number(p.value or 0) for p in model.parameters]
        known = System(model, law, graph=graph, leaves=[*at.x, *p_hat])
        known.s = at.s  # the coordinate itself
        renewed = known.loop(known.push(layer=False))[1]
        clipped = [
            d if i.value is None else graph.clip(d, i.value)
            for d, i in zip(renewed, model.inputs, strict=True)
        ]
        self.rates = [*at.sliding(graph.inputs[-m:]), *([graph.number(0)] * len(varied))]
        self.held = Held(graph, self.rates, clipped)
        self.fixed, self.step = np.empty(0, dtype=complex), ops.hull(period)
        self.demand = known.loop(known.push(layer=True))[1]
        self.inside = self.held.by_states(self.demand)
        self.regular = graph.program([*at.regular, *known.regular])
        self.coordinates = start.program([*plain.momentum_and_surface(), *start.inputs[2 * n :]])

    def _advance(self, tube: Tube) -> bool:
        stay = self.held.advance(tube, self.step)
        return stay is not None and self.kept(stay, self.held.fixed())

    def take(self, W: Matrix, radius: Fraction) -> None:
        """Take {|W (q, D p, s)| ≤ radius} as the set."""
        n, m = self.model.n, self.model.m
        scale = [*([Fraction(1)] * n), *scale_of(self.model), *([Fraction(1)] * m)]
        W = tuple(tuple(w * c for w, c in zip(row, scale, strict=True)) for row in W)
        self.aim(self.start, self.start.inputs[: self.size], W, radius)

    @cached_property
    def no_equilibrium(self) -> str:
        """Why the target is not shown to be at rest with u = 0 for every plant, if it is not."""
        rest = [Span(0)] * (len(self.graph.inputs) - self.size - len(self.plant))
        at = [*([Span(0)] * self.size), *(Span(*ends) for ends in self.plant), *rest]
        return self.graph.not_zero([*self.rates, *self.demand], at, "f(0, 0) = 0")

    def terminal(self) -> tuple[str, float]:
        """Decide Lemma 11 of the set: what is not shown, or nothing, and a margin."""
        if self.no_equilibrium:
            return self.no_equilibrium, -np.inf
        V, least = ops.inverse(self.W), np.inf
        half = ops.extents(V, self.radius.imag)
        if not np.isfinite(half).all():
            return SINGULAR, -np.inf
        if not (half[self.size - self.model.m :] <= ops.hulls(self.law.layer).real).all():
            return LAYER_LEFT, -np.inf
        whole = ops.ends(self.plant)
        box, todo, tried = np.column_stack([-half, half]), [whole], 0
        while todo:
            part, tried = todo.pop(), tried + 1
            why, margin = self._contracts(V, ops.between(*np.vstack([box, part]).T))
            if not why:
                least = min(least, margin)
                continue
            if not len(part) or tried > MOST_PLANTS:
                return why, margin
            width = (part[:, 1] - part[:, 0]) / (whole[:, 1] - whole[:, 0] + 1e-300)
            todo += halves(part, int(width.argmax()))
        return "", least

    def slopes(self, X: Intervals) -> tuple[FloatArray, Sampled]:
        """Return z = 0 at the middle of plants, and the demand's derivatives on X."""
        m, none, plant = self.model.m, np.zeros(self.model.m, dtype=complex), X[self.size :]
        middle = np.append(np.zeros(self.size), 0.5 * (plant.real + plant.imag))
        over, at = self.inside.expanded(X, middle, self.held.fixed())
        L = ops.mean_values(over, at, X, middle)
        return middle, Sampled(none, none, L[m:], at[m:], over[m:, 1:])

    def _contracts(self, V: Intervals, X: Intervals) -> tuple[str, float]:
        """Decide Lemma 11 for a part of the plants: X (N,) is a box around the set, and it."""
        size, (middle, law) = self.size, self.slopes(X)
        rows = ops.product(law.L.reshape(-1, len(X))[:, :size].copy(), V)
        most = ops.extents(rows, self.radius.imag)
        if not (most <= self.model.limits).all():
            return LIMIT_MET, -np.inf
        law = law._replace(u=ops.between(-most, most))
        found = self.held.derivative(X, middle, law, self.step)
        if found is None:
            return "motions over a period have no bounds", -np.inf
        if not self.kept(found[1], self.held.fixed()):
            return IRREGULAR, -np.inf
        E = ops.sums(found[0][:size, :size].copy(), ops.points(-np.eye(size)))
        margin = ops.decrease(ops.product(ops.product(self.W, E), V), True)
        return ("" if margin > 0.0 else "|W z| is not shown to fall"), margin


def halves(box: FloatArray, at: int) -> list[FloatArray]:
    """Return a box (N, 2) cut across one side."""
    lower, upper = box.copy(), box.copy()
    lower[at, 1] = upper[at, 0] = 0.5 * box[at, 0] + 0.5 * box[at, 1]
    return [lower, upper]
