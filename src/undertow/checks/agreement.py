"""Comparison of compiled code with exact values of the same expressions.

Every function here runs one compiled thing at states of all kinds (near the target, at the edge
of the boundary layer, where the input saturates, far away) and returns its worst
:class:`Difference` from :mod:`undertow.checks.exact`.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from undertow.base import InvalidInputError, ModelError
from undertow.checks.exact import ExactLaw, ExactModel, Matrix, Number, evaluate, runge_kutta
from undertow.closed_loop import ClosedLoop, RolloutBuffers, compile_loop
from undertow.law import InnerLoop, ReachingLaw, SlidingModeLaw, Surface, coupling
from undertow.models import TIME, FloatArray, Mechanism
from undertow.objective import MinimumEnergy
from undertow.proofs import ClosedLoopProgram

#: Largest difference, relative to what the rounding of each value scales with.
LIMIT = 1e-13

#: An enclosure that is wider, relative to the same, says too little.
WIDEST = 1e-9

#: Length of the kernel's step, s.
STEP = 1e-3


@dataclass(frozen=True)
class Difference:
    """One number of compiled code beside its exact value.

    ``what``, ``where``: which number of what, at which state, in words. ``relative``: the
    difference relative to the exact value's :class:`size <undertow.checks.exact.Number>`; infinite
    where what was computed is no number, or a proved enclosure misses.
    """

    what: str
    where: str
    computed: float
    exact: float
    relative: float

    def __str__(self) -> str:
        """One line: what differs, at which state, by how much."""
        return (
            f"{self.what} is {self.computed:.15g}, exactly {self.exact:.15g} "
            f"(off by {self.relative:.3g}), at {self.where}"
        )


def worst(differences: Iterable[Difference]) -> Difference | None:
    """Return the largest of some differences; none of none."""
    return max(differences, key=lambda d: d.relative, default=None)


class Subject:
    """A mechanism, a law for it and states: what compiled code is tried at.

    By default the surface has random entries, all different, so that none can stand in for another.
    There are ``count`` states of each kind.
    """

    def __init__(
        self,
        mechanism: Mechanism,
        surface: Surface | None = None,
        reaching: ReachingLaw = ReachingLaw(),
        count: int = 2,
        seed: int = 0,
    ) -> None:
        self.mechanism, self.reaching = mechanism, reaching
        self.model = ExactModel(mechanism)
        self._rng, self._count = np.random.default_rng(seed), count
        self.autonomous = TIME not in mechanism.force.free_symbols
        self.surface = surface or self._any_surface()
        kinds = [self._spread(scale) for scale in (1e-6, 1e-2, 0.3, 1.0, 10.0)]
        if self.autonomous:
            kinds += [self._layer_edge(), self._saturation()]
        self.states: FloatArray = np.array([x for x in np.vstack(kinds) if self._defined(x)])
        if len(self.states) < self._count:
            raise ModelError(
                f"M, f and B of '{mechanism.name}'",
                value=f"real numbers at {len(self.states)} random states",
                limit=f"at least {self._count}",
                remedy="Declare the ranges of travel in which the model is defined",
            )

    def _defined(self, x: FloatArray) -> bool:
        with contextlib.suppress(ModelError):
            self.model.matrices(0.0, [Number(float(v)) for v in x])
            return True
        return False

    def _any_surface(self) -> Surface:
        """Return a surface with |det Γ| ≥ 0.1 at the target."""
        n, m = self.mechanism.n, self.mechanism.m
        X = coupling(self.mechanism, np.zeros(n))
        size = 1.0
        while True:
            a, b = self._rng.uniform(0.2, 1.0, (2, m, m))
            c, d = self._rng.uniform(0.2, 1.0, (2, m, n - m))
            alpha_a = -np.eye(m) - 0.2 * a
            if not abs(np.linalg.det(alpha_a - size * c @ X)) < 0.1:
                return Surface(alpha_a, -b - np.eye(m), size * c, 3.0 * d)
            size *= 0.8

    def _spread(self, scale: float) -> FloatArray:
        """Random states of one scale, positions within the ranges of travel."""
        reach = np.array([math.pi if c.unit == "rad" else 1.0 for c in self.mechanism.coordinates])
        turns = [c.unit == "rad" for c in self.mechanism.coordinates]
        reach = reach * np.where(turns, scale, min(scale, 1.0))
        low = np.maximum([c.low for c in self.mechanism.coordinates], -reach)
        high = np.minimum([c.high for c in self.mechanism.coordinates], reach)
        shape = (self._count, self.mechanism.n)
        q = self._rng.uniform(np.minimum(low, high), np.maximum(low, high), shape)
        return np.hstack([q, 3.0 * scale * self._rng.uniform(-1.0, 1.0, shape)])

    def _layer_edge(self) -> FloatArray:
        """States with |s_i| = ε_i, a rounding off on either side."""
        C, m = self.surface.matrix, self.mechanism.m
        edge = self.reaching.per_surface(m)[1] * self._rng.choice([-1.0, 1.0], (self._count, m))
        x = self._spread(0.1)
        return np.asarray(x + np.linalg.lstsq(C, (edge - x @ C.T).T, rcond=None)[0].T)

    def _saturation(self) -> FloatArray:
        """States at which a demand meets its limit, found on rays from the target."""
        limits = self.mechanism.input_limits
        law = SlidingModeLaw(self.mechanism, self.surface, self.reaching)
        low, high = np.zeros((self._count, 1)), np.ones((self._count, 1))
        ray = self._spread(1.0)
        for _ in range(50):
            middle = 0.5 * (low + high)
            beyond = (np.abs(law(0.0, middle * ray).demand) > limits).any(axis=1, keepdims=True)
            low, high = np.where(beyond, low, middle), np.where(beyond, middle, high)
        return np.asarray(high * ray)

    @cached_property
    def laws(self) -> list[ExactLaw]:
        """The law at each state."""
        return [self.model.law(self.surface, self.reaching, row) for row in self.numbers]

    @cached_property
    def numbers(self) -> list[list[Number]]:
        """The states as exact numbers."""
        return [[Number(float(v)) for v in row] for row in self.states]

    def where(self, x: FloatArray) -> str:
        """Return a state in words."""
        names = self.mechanism.state_names
        return ", ".join(f"{name} = {v:.17g}" for name, v in zip(names, x, strict=True))

    def compared(
        self, what: str, x: FloatArray, computed: Sequence[float] | FloatArray,
        exact: Sequence[Number] | Matrix, names: Sequence[str] = (),
    ) -> Iterator[Difference]:  # fmt: skip
        """Compare numbers at a state, one by one."""
        entries = names or [str(i + 1) for i in range(len(exact))]
        for name, value, true in zip(entries, computed, exact, strict=True):
            yield Difference(
                f"{what} [{name}]", self.where(x), float(value), float(true), true.off(float(value))
            )

    def compared_law(
        self, of: str, x: FloatArray, exact: ExactLaw, u: FloatArray, demand: FloatArray | None,
        s: FloatArray, margin: float,
    ) -> Iterator[Difference]:  # fmt: skip
        """Compare what a law gives at a state."""
        inputs = [i.name for i in self.mechanism.inputs]
        yield from self.compared(f"{of}: input", x, u, exact.u, inputs)
        if demand is not None:
            yield from self.compared(f"{of}: demand", x, demand, exact.demand, inputs)
        yield from self.compared(f"{of}: s", x, s, exact.s)
        yield from self.compared(f"{of}: det Γ(q)/det Γ(0)", x, [margin], [exact.margin])

    def inputs(self) -> FloatArray:
        """Random inputs within limits, one row for each state."""
        limits = np.minimum(self.mechanism.input_limits, 1e3)
        return self._rng.uniform(-1.0, 1.0, (len(self.states), self.mechanism.m)) * limits


def numpy_functions(subject: Subject) -> Iterator[Difference]:
    """Compare M, f, q̈ and the law as NumPy functions."""
    mechanism, model, n = subject.mechanism, subject.model, subject.mechanism.n
    names = [c.name for c in mechanism.coordinates]
    t = 0.0 if subject.autonomous else 0.7
    for x, exact, u in zip(subject.states, subject.numbers, subject.inputs(), strict=True):
        M, f, _ = model.matrices(t, exact)
        qdd = model.accelerations(t, exact, [Number(float(v)) for v in u])
        for i in range(n):
            row = mechanism.M(x[:n])[i]
            yield from subject.compared(f"M, row of {names[i]}", x, row, M[i], names)
        yield from subject.compared("f", x, mechanism.f(x, t), f, names)
        yield from subject.compared("q̈", x, mechanism.accelerations(t, x, u), qdd, names)
    if subject.autonomous:
        law = SlidingModeLaw(mechanism, subject.surface, subject.reaching)
        for x, exact_law in zip(subject.states, subject.laws, strict=True):
            got = law(0.0, x)
            yield from subject.compared("law: gain", x, got.gains, exact_law.gains)
            yield from subject.compared_law(
                "law", x, exact_law, got.u, got.demand, got.s, float(got.margin)
            )


def inner_loop(subject: Subject) -> Iterator[Difference]:
    """Compare the compiled step of the fast loop."""
    step = InnerLoop(subject.mechanism, subject.surface, subject.reaching)
    for x, exact in zip(subject.states, subject.laws, strict=True):
        step(x)
        yield from subject.compared_law(
            "inner loop", x, exact, step.u, step.demand, step.s, float(step.margin[0])
        )


def kernel(subject: Subject, *, sampled: bool = False) -> Iterator[Difference]:
    """Compare one step of the rollout kernel: the law, the next state, the cost.

    With ``sampled`` that of a sampled loop, which holds its input over the step.
    """
    mechanism, model = subject.mechanism, subject.model
    n, m, objective = mechanism.n, mechanism.m, MinimumEnergy().on(mechanism)
    loop = ClosedLoop(mechanism, objective, subject.reaching, step=STEP, zoh_steps=int(sampled))
    kernels = compile_loop(loop.equations)
    buffers = RolloutBuffers(loop, len(subject.states), 1)
    buffers.fill(subject.states, subject.surface.vector)
    record = np.zeros((buffers.padded, 1, 2 * n + 2 * m + 2))
    parameters, limits = mechanism.parameter_values, mechanism.input_limits
    prices = np.zeros(len(objective.constraints))
    kernels.rollout(
        0, buffers.padded, buffers.states, buffers.live, buffers.lanes, np.zeros(1, dtype=np.int64),
        parameters, parameters, limits, buffers.quiet,
        0.0, STEP, 1, 1, 0.0, math.inf, math.inf, 0.0, prices, 1, 1, record, buffers.out,
    )  # fmt: skip
    after = buffers.batch(0.0)
    stage = objective.stage_cost(mechanism)

    def rates(x: list[Number], held: list[Number]) -> list[Number]:
        u = held if sampled else model.law(subject.surface, subject.reaching, x[:-1]).u
        known = model.known(0.0, x[:-1]) | dict(zip(mechanism.u, u, strict=True))
        return [*x[n : 2 * n], *model.accelerations(0.0, x[:-1], u), evaluate(stage, known)]

    for k, (x, exact, law) in enumerate(
        zip(subject.states, subject.numbers, subject.laws, strict=True)
    ):
        _, u, s, margin = np.split(record[k, 0], [2 * n, 2 * n + m, 2 * n + 2 * m])
        yield from subject.compared_law("kernel", x, law, u, None, s, float(margin[-1]))
        if float(law.margin) < 1e-6 or (after.path[k] < 0).any():
            continue  # it stops there
        *state, cost = runge_kutta(STEP, [*exact, Number(0)], partial(rates, held=law.u))
        names = mechanism.state_names
        yield from subject.compared("kernel: next state", x, after.x[k], state, names)
        yield from subject.compared("kernel: cost of a step", x, [after.cost[k]], [cost])


def proof_programme(subject: Subject) -> Iterator[Difference]:
    """Compare the interval programme of the closed loop: it must enclose, and closely.

    It is that of the loop inside its layer and limits: states outside are left out.  A model that
    no proof can be about (time-dependent, not smooth, of other functions) has none.
    """
    mechanism, m = subject.mechanism, subject.mechanism.m
    try:
        programme = ClosedLoopProgram.of(mechanism)
    except (InvalidInputError, ModelError):
        return
    numbers = programme.numbers(mechanism, subject.surface, subject.reaching)
    names = [
        *(f"q̈ of {c.name}" for c in mechanism.coordinates),
        *(f"demand of {i.name}" for i in mechanism.inputs),
    ]
    layer = subject.reaching.per_surface(m)[1]
    rows = []
    for x, state, law in zip(subject.states, subject.numbers, subject.laws, strict=True):
        if all(abs(float(s)) < e for s, e in zip(law.s, layer, strict=True)):
            point = np.concatenate([x, numbers])
            found = programme.over(point, point)[: len(names), 0]
            values = [*subject.model.accelerations(0.0, state, law.demand), *law.demand]
            rows.append((x, found, values))
    # Enclosures of sines are as wide near the target as anywhere.
    usual = [max(v.size for v in column) for column in zip(*(r[2] for r in rows), strict=True)]
    for x, found, values in rows:
        for name, (low, high), true, size in zip(names, found, values, usual, strict=True):
            end = low if true.off(low) >= true.off(high) else high
            width = (high - low) / size
            off = (0.0 if width <= WIDEST else width) if true.inside(low, high) else math.inf
            yield Difference(f"proof programme: {name}", subject.where(x), end, float(true), off)


#: What is quick enough to be part of every check of a mechanism.
QUICK: dict[str, Callable[[Subject], Iterator[Difference]]] = {
    "NumPy functions M, f, q̈ and law": numpy_functions,
    "inner loop": inner_loop,
    "rollout kernel": kernel,
    "proof programme": proof_programme,
}
