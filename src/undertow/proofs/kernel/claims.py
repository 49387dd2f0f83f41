"""The rules: each kind of claim with its statement and its decision.

Statements and lemmas are those of ``docs/certificate-format.md``, section 5, under the same names.
"""

from __future__ import annotations

import itertools
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any, ClassVar, Self

import numpy as np

from undertow.proofs.kernel import compiled as ops
from undertow.proofs.kernel.bound import Goal, settle
from undertow.proofs.kernel.graph import Array, Graph, Node, Span
from undertow.proofs.kernel.loop import ContinuousLoop, HeldLoop, Loop, ellipsoid
from undertow.proofs.kernel.model import Law, Matrix, Model, Sliding, System, characteristic, system
from undertow.proofs.kernel.reader import Document, box, fields, matrix, number, numbers, require
from undertow.proofs.kernel.region import Function, Stage, Stretch, on_the_line

Region = Mapping[str, tuple[Fraction, Fraction]]

#: Boxes of a branch and bound before it gives up.
MOST_BOXES = 200_000


@dataclass(frozen=True)
class Decision:
    """What the checker says of one claim: ``proved``, ``refuted`` or ``undecided``, and why.

    ``witness`` is the point where a refuted claim is false, or where the checker gave up.
    """

    kind: str
    why: str
    witness: Mapping[str, float] = field(default_factory=dict)
    details: Mapping[str, Any] = field(default_factory=dict)


class Settlement(Exception):  # noqa: N818
    """A verdict that leaves nothing else to be decided, and why."""


def show(good: bool, what: str) -> None:
    """Leave a claim undecided for what is not good."""
    if not good:
        raise Settlement("undecided", what)


#: The kinds of claims.
KINDS: dict[str, type[Claim]] = {}


class Claim(ABC):
    """Numbers with a statement about a model and a law, and their keys in a file."""

    kind: ClassVar[str]
    keys: ClassVar[tuple[str, ...]]

    def __init_subclass__(cls, kind: str, keys: tuple[str, ...]) -> None:
        """Enter it among the kinds."""
        cls.kind, cls.keys = kind, keys
        KINDS[kind] = cls

    @classmethod
    @abstractmethod
    def read(cls, data: Mapping[str, Any], model: Model) -> Self:
        """Read it from an object with its keys."""

    @abstractmethod
    def decide(self, model: Model, law: Law, max_boxes: int) -> Decision:
        """Decide the statement, or say by :func:`show` what is not shown."""


# -- linear algebra on exact numbers --------------------------------------------------------------


def _routh(coefficients: list[Span]) -> bool | None:
    """Lemma 3: whether a polynomial, its first coefficient > 0, is Hurwitz, if it is known."""
    first, second = coefficients[::2], coefficients[1::2]
    while second:
        if not second[0].low > 0:
            return False if second[0].high <= 0 else None
        factor = first[0] / second[0]
        padded = second + [Span(0)] * (len(first) - len(second))
        third = [first[i + 1] - factor * padded[i + 1] for i in range(len(first) - 1)]
        first, second = second, third
    return True


# -- 5.1 ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Stability(Claim, kind="stability", keys=("rate",)):
    """Every eigenvalue of the motion on the surface, at the target, is left of −rate, 1/s."""

    rate: Fraction

    @classmethod
    def read(cls, data: Mapping[str, Any], model: Model) -> Self:
        """Read it from an object with its keys."""
        rate = number(data["rate"])
        require(rate >= 0, "a rate ≥ 0")
        return cls(rate)

    def decide(self, model: Model, law: Law, max_boxes: int) -> Decision:
        """Decide the statement."""
        matrix = _sliding_matrix(model, law)
        exact = all(v.exact for v in matrix.flat)
        method = f"Routh array in {'exact rationals' if exact else 'rational intervals'}"
        diagonal = np.diag_indices(len(matrix))
        matrix[diagonal] = matrix[diagonal] + Span(self.rate)
        stable = _routh(characteristic(matrix, Span)[0])
        return Decision({True: "proved", False: "refuted", None: "undecided"}[stable], method)


def _sliding_matrix(model: Model, law: Law) -> Array:
    """Return A of ż = A z, z = (q_a, q_u, v_u)."""
    n, m, size = model.n, model.m, 2 * model.n - model.m
    graph = Graph(size)
    q, v_u = np.split(graph.inputs, [n])
    pull = graph.numbers(law.lambda_a) @ q[:m] + graph.numbers(law.lambda_u) @ q[m:]
    own = [graph.number(p.value or 0) for p in model.parameters]
    on = Sliding.of(graph, model, law, q, pull, v_u, own)
    rates, at = [*on.v_a, *v_u, *on.v_u_dot], [Span(0)] * size
    none = "det(M_uu − M_ua α_a⁻¹ α_u) = 0 at the target, or det α_a = 0: no sliding dynamics"
    definite = all(v.low > 0 for v in graph.exact(on.pivots, at))
    show(definite, "M is not shown to be positive definite at the target")
    for k in on.determinants:
        (value,) = graph.exact([k], at)
        if value.zero:
            raise Settlement("refuted", none)
        show(bool(_sign(value)), f"not excluded: {none}")
    values, one = graph.exact(rates, at), graph.number(1)
    slopes = [graph.exact(graph.tangents(rates, {k: one}), at) for k in graph.inputs]
    show(all(v.zero for v in values), "f_u(0, 0) = 0 is not shown exactly")
    return np.array(slopes, dtype=object).T


# -- 5.2, 5.3 -------------------------------------------------------------------------------------


def _read_region(data: Any, model: Model) -> dict[str, Any]:
    return box(data, {p.name: Fraction(0) for p in model.positions})


def _sign(value: Span) -> int:
    return 1 if value.low > 0 else -1 if value.high < 0 else 0


def _regular(own: System) -> tuple[list[Node], list[Goal], Span]:
    """Nodes and goals of regularity, and det Γ(0)."""
    drive, gamma = own.graph.exact([own.B_determinant, own.gamma_determinant], own.origin())
    show(bool(_sign(drive) and _sign(gamma)), "det B or det Γ may be 0 at the target")
    goals = [Goal(f"pivot {k + 1} of M is > 0") for k in range(own.model.n)]
    goals += [Goal("det B keeps its sign", _sign(drive)), Goal("Γ is non-singular", _sign(gamma))]
    return own.regular, goals, gamma


def _over_region(
    own: System, box: Region, nodes: Sequence[Node], goals: Sequence[Goal], max_boxes: int
) -> Decision:
    names = [p.name for p in own.model.positions]
    ends = [box.get(name, (Fraction(0), Fraction(0))) for name in names]
    fixed = np.concatenate([np.zeros(own.model.n), own.fixed()])
    found = settle(own.graph.program(nodes), ends, fixed, goals, max_boxes)
    outcome = {"proved": "", "refuted": f"; false: {found.why}"}
    why = outcome.get(found.kind, f": {found.why}, not shown")
    witness = dict(zip(names, found.point, strict=False))
    method = f"intervals and mean values, branch and bound{why}"
    return Decision(found.kind, method, witness, {"boxes": found.boxes})


@dataclass(frozen=True)
class Nonsingular(Claim, kind="nonsingular", keys=("region", "ratio")):
    """The law exists all over a region, where det Γ(q)/det Γ(0) ≥ ratio."""

    region: Region
    ratio: Fraction

    @classmethod
    def read(cls, data: Mapping[str, Any], model: Model) -> Self:
        """Read it from an object with its keys."""
        ratio = number(data["ratio"])
        require(ratio > 0, "a ratio > 0")
        return cls(_read_region(data["region"], model), ratio)

    def decide(self, model: Model, law: Law, max_boxes: int) -> Decision:
        """Decide the statement."""
        own = system(model, law)
        nodes, goals, gamma = _regular(own)
        least = gamma * Span(_sign(gamma) * self.ratio)
        least_double = ops.hull(least.low, least.high)
        bound = Goal("det Γ/det Γ(0) is as stated", _sign(gamma), least_double, strict=False)
        return _over_region(own, self.region, [*nodes, nodes[-1]], [*goals, bound], max_boxes)


@dataclass(frozen=True)
class Reaching(Claim, kind="reaching", keys=("region", "disturbance", "rate")):
    """The law overcomes disturbances over a region, and leaves a rate of reaching."""

    region: Region
    disturbance: tuple[Fraction, ...]
    rate: tuple[Fraction, ...]

    @classmethod
    def read(cls, data: Mapping[str, Any], model: Model) -> Self:
        """Read it from an object with its keys."""
        bounds, rate = numbers(data["disturbance"], model.n), numbers(data["rate"], model.m)
        require(min(*bounds, *rate) >= 0, "disturbances and rates ≥ 0")
        return cls(_read_region(data["region"], model), bounds, rate)

    def decide(self, model: Model, law: Law, max_boxes: int) -> Decision:
        """Decide the statement."""
        show(law.switching != "tanh", "tanh is less than 1 everywhere: (16) is not stated of it")
        own = system(model, law)
        nodes, goals, _ = _regular(own)
        for i, row in enumerate(own.thrust):
            left = own.gains[i] - self.rate[i]
            for weight, bound in zip(row, self.disturbance, strict=True):
                left = left - abs(weight) * bound
            if left.number is not None and left.number < 0:
                why = f"k_{i + 1} − η̃_{i + 1} = {float(left.number):.4g} < 0"
                return Decision("refuted", why)
            if left.number is None:
                nodes, goals = [*nodes, left], [*goals, Goal(f"row {i + 1} of (16)", strict=False)]
        return _over_region(own, self.region, nodes, goals, max_boxes)


# -- 5.4 ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class TerminalEllipsoid(Claim, kind="terminal ellipsoid", keys=("W", "radius")):
    """{|W x| ≤ radius} is a terminal set of the closed loop, inside layer and input limits."""

    W: Matrix
    radius: Fraction

    @classmethod
    def read(cls, data: Mapping[str, Any], model: Model) -> Self:
        """Read it from an object with its keys."""
        radius = number(data["radius"])
        require(radius > 0, "a radius > 0")
        return cls(matrix(data["W"], 2 * model.n, 2 * model.n), radius)

    def decide(self, model: Model, law: Law, max_boxes: int) -> Decision:
        """Decide the statement."""
        show(law.switching != "sign", "with sign(s) there is no layer to be inside of")
        own = system(model, law)
        moves = own.graph.not_zero(own.f[model.m :], own.origin(), "f_u(0, 0) = 0")
        show(not moves, moves)  # and if it is, q̈ = 0
        why, margin, half = ellipsoid(
            own.within_layer, own.fixed(), ops.hulls(self.W), ops.hull(self.radius).imag,
            law.rows, ops.hulls(law.layer).real.copy(), model.limits,
        )  # fmt: skip
        details = {"margin": margin, "box": half.tolist()}
        witness = dict(zip(model.states, half.tolist(), strict=True))
        method = "interval Jacobian over the ellipsoid's box, diagonal dominance"
        method, kind = (f"{method}: {why}", "undecided") if why else (method, "proved")
        return Decision(kind, method, witness, details)


# -- 5.5 ------------------------------------------------------------------------------------------


def _whole_rows(data: Any, columns: int) -> tuple[tuple[int, ...], ...]:
    good = isinstance(data, list) and 0 < len(data) <= 5000
    good = good and all(isinstance(row, list) and len(row) == columns for row in data)
    require(good and all(isinstance(v, int) and 0 <= v <= 24 for row in data for v in row),
            f"exponents: 1 to 5000 rows of {columns} whole numbers up to 24")  # fmt: skip
    even = all(sum(row) >= 2 and sum(row) % 2 == 0 for row in data)
    require(even and len({*map(tuple, data)}) == len(data), "different rows of an even sum ≥ 2")
    return tuple(map(tuple, data))


def _function(data: Any, size: int) -> Function:
    fields(data, "a function", {"A", "G", "exponents", "coefficients"})
    G, exponents = matrix(data["G"], size, size), _whole_rows(data["exponents"], size)
    lower = all(v == 0 for i, row in enumerate(G) for v in row[i + 1 :])
    require(lower and all(G[i][i] for i in range(size)), "G lower triangular, its diagonal not 0")
    coefficients = numbers(data["coefficients"], len(exponents))
    return Function(matrix(data["A"], size, size), G, exponents, coefficients)


def _read_plant(data: Any, model: Model) -> dict[str, Any]:
    return box(data, {p.name: p.value for p in model.parameters})


@dataclass(frozen=True)
class SurfaceRegion(
    Claim, kind="surface region", keys=("stretch", "pole", "functions", "contains", "plant")
):
    """Motions on the surface converge from a set, shown by one function after another."""

    stretch: Stretch
    functions: tuple[Function, ...]
    contains: tuple[Fraction, ...]
    plant: Region = field(default_factory=dict)

    @classmethod
    def read(cls, data: Mapping[str, Any], model: Model) -> Self:
        """Read it from an object with its keys."""
        size, (S, listed) = 2 * model.n - model.m, (data[k] for k in ("stretch", "functions"))
        require(isinstance(S, list) and len(S) <= 12, "a stretch of at most 12 matrices")
        require(isinstance(listed, list) and 0 < len(listed) <= 200, "1 to 200 functions")
        stretch = Stretch(
            tuple(matrix(v, size, size) for v in S), number(data["pole"]) if S else None
        )
        require(bool(S) or data["pole"] is None, "a pole of null without a stretch")
        first = [v[0] for v in stretch.S]
        require(all(row[0] >= 0 and not any(row[1:]) for row in first), "first rows (≥ 0, 0, …)")
        contains = numbers(data["contains"], size)
        pole = stretch.L
        require(pole is None or 0 <= abs(contains[0]) < pole, "a pole > 0 beyond what is contained")
        functions = tuple(_function(v, size) for v in listed)
        return cls(stretch, functions, contains, _read_plant(data["plant"], model))

    def decide(self, model: Model, law: Law, max_boxes: int) -> Decision:
        """Decide the statement."""
        varied = [p.name for p in model.parameters if p.name in self.plant]
        names = *surface_names(model), *varied
        show(len(names) <= 8, f"{len(names)} variables; 8 at most")
        method, boxes = "quadratic Taylor models, branch and bound", 0
        before: Function | None = None
        for k, V in enumerate(self.functions, start=1):
            stage = Stage(model, law, self.stretch, V, before, self.plant)
            found = stage.decide(10 * max_boxes)  # a model settles more than intervals do
            boxes, before = boxes + found.boxes, V
            if found.kind != "proved":
                why = f"{method}; function {k}: {found.why}"
                witness = dict(zip(names, found.point, strict=False))
                return Decision(found.kind, why, witness, {"boxes": boxes, "function": k})
        line = on_the_line(self.stretch, self.functions[-1], self.contains, max_boxes)
        why = method if line.kind == "proved" else f"{method}; {line.why}, not so"
        witness = dict(zip(names, map(float, self.contains), strict=False))
        return Decision(line.kind, why, witness, {"boxes": boxes + line.boxes})


def surface_names(model: Model) -> tuple[str, ...]:
    """Names of y = (q_u, v_u, w)."""
    names, m = [p.name for p in model.positions], model.m
    return (*names[m:], *(f"{k}_dot" for k in names[m:]), *(f"w_{k}" for k in names[:m]))


# -- 5.6 ------------------------------------------------------------------------------------------

#: Step of the tubes where no hint gives another, s.
STEP = Fraction(1, 128)

#: States, and parameters that vary, of one loop with a held input.
MOST_STATES = 12


@dataclass(frozen=True)
class ClosedLoop(
    Claim, kind="closed loop", keys=("starts", "period", "plant", "disturbance", "ball")
):
    """Every motion from a box of starts converges, layer and clip and all."""

    starts: Region
    period: Fraction
    plant: Region
    disturbance: tuple[Fraction, ...]
    ball: Fraction
    terminal: TerminalEllipsoid | None = None
    cuts: Mapping[str, tuple[Fraction, ...]] = field(default_factory=dict)
    step: Fraction = STEP

    @classmethod
    def read(cls, data: Mapping[str, Any], model: Model) -> Self:
        """Read it from an object with its keys."""
        starts = box(data["starts"], dict.fromkeys(model.states))
        bounds, period = numbers(data["disturbance"], model.n), number(data["period"])
        ball, hint = number(data["ball"]), data.get("hint", {})
        require(min(*bounds, period, ball) >= 0, "a period, bounds of disturbances and a ball ≥ 0")
        require(ball == 0 or any(bounds), "a ball of 0 without a disturbance")
        fields(hint, "hint", (), {"terminal", "step", "boxes"})
        cuts = hint.get("boxes", {})
        plant = _read_plant(data["plant"], model)
        known = {*starts, *plant}
        require(isinstance(cuts, dict) and cuts.keys() <= known, "boxes: what varies at the start")
        require(all(isinstance(v, list) for v in cuts.values()), "boxes: lists")
        cuts = {name: numbers(v, len(v)) for name, v in cuts.items()}
        require(math.prod(1 + len(v) for v in cuts.values()) <= 20_000, "at most 20000 boxes")
        step = number(hint["step"]) if "step" in hint else STEP
        require(0 < step <= 1, "a step of 0 to 1 s")
        terminal = hint.get("terminal")
        if terminal is not None:
            fields(terminal, "terminal", TerminalEllipsoid.keys)
            terminal = TerminalEllipsoid.read(terminal, model)
        return cls(starts, period, plant, bounds, ball, terminal, cuts, step)

    def decide(self, model: Model, law: Law, max_boxes: int) -> Decision:
        """Decide the statement."""
        forces = "forces, and other plants under an input that is not held: not decided here"
        show(not any(self.disturbance) and (not self.plant or self.period > 0), forces)
        terminal, plain = self.terminal, law.switching == "saturation" and not any(law.disturbance)
        if terminal is None or not plain:
            needed = "saturation, constant gains and a terminal set are needed"
            raise Settlement("undecided", needed)
        few = 2 * model.n + len(self.plant) <= MOST_STATES
        show(few, f"more than {MOST_STATES} states and parameters that vary")
        loop = self._loop(model, law, terminal)
        box = {x: self.starts.get(x, (Fraction(0), Fraction(0))) for x in model.states}
        wide = [x for x, (low, high) in box.items() if low < high]
        if wide and system(model, law).odd and all(low == -high for low, high in box.values()):
            box[wide[0]] = Fraction(0), box[wide[0]][1]
        box |= {p.name: self.plant[p.name] for p in model.parameters if p.name in self.plant}
        pieces = []
        for name, (low, high) in box.items():
            cuts = sorted({v for v in self.cuts.get(name, ()) if low < v < high})
            pieces.append(ops.ends(itertools.pairwise([low, *cuts, high])))
        end = loop.arrive(np.array([*itertools.product(*pieces)]))
        method = "validated tubes into an ellipsoid that is proved to be a terminal set"
        details = {"tubes": end.tubes, "steps": end.steps, "latest": end.latest}
        if not end.all:
            witness = dict(zip(box, end.lost.tolist(), strict=True))
            return Decision("undecided", f"{method}: a tube is lost", witness, details)
        return Decision("proved", method, details=details)

    def _loop(self, model: Model, law: Law, end: TerminalEllipsoid) -> Loop:
        """The loop with its terminal set."""
        if not self.period:
            found = decide(model, law, end)
            show(found.kind == "proved", f"the terminal set: {found.why}")
            return ContinuousLoop(model, law, end.W, end.radius, self.step)
        loop = HeldLoop(model, law, self.period, self.plant)
        loop.take(end.W, end.radius)
        why, _ = loop.terminal()
        show(not why, f"the terminal set: {why}")
        return loop


# -- all of them ----------------------------------------------------------------------------------


def read_claim(data: Mapping[str, Any], model: Model) -> Claim:
    """Read a claim of a file.

    Raises
    ------
    Refused
        For a kind that is not known, or numbers that do not fit the model.
    """
    kind = data.get("kind")
    require(
        isinstance(kind, str) and kind in KINDS, f"a claim of the unknown kind {str(kind)[:40]!r}"
    )
    known = KINDS[str(kind)]
    fields(data, f"claim '{known.kind}'", {"kind", *known.keys}, {"hint"})
    require(isinstance(data.get("hint", {}), dict), "hint: an object")
    return known.read(data, model)


def decide(model: Model, law: Law, claim: Claim, max_boxes: int = MOST_BOXES) -> Decision:
    """Decide a claim about a model and a law."""
    try:
        return claim.decide(model, law, max_boxes)
    except Settlement as reason:
        return Decision(*reason.args)
    except ArithmeticError as error:
        return Decision("undecided", f"at the target: {error}")


def check(
    document: Document,
    progress: Callable[[str, float], None] | None = None,
) -> list[tuple[Law, Claim, Decision]]:
    """Decide all claims of a certificate, in its order.

    Raises
    ------
    Refused
        For a claim that cannot be read.
    """
    tasks = [
        (subject.law, read_claim(data, document.model))
        for subject in document.subjects
        for data in subject.claims
    ]
    done = []
    for index, (law, claim) in enumerate(tasks):
        if progress is not None:
            progress(claim.kind, index / len(tasks))
        done.append((law, claim, decide(document.model, law, claim)))
    return done
