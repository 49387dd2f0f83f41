"""Expressions as a graph with exact leaves: made, evaluated exactly, lowered to code.

A node is a leaf (an input, a number or π) or an operation on earlier nodes; equal ones are one
object.  + − × ÷ of nodes are nodes, and so they are of NumPy's arrays of them.  Numbers are folded
exactly, and x + 0, x · 1 and the like fall away; 0 · x does only if x is defined everywhere.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from undertow.proofs.kernel import compiled as ops

_NONE, _NO_SEEDS = np.empty(0, dtype=np.int64), np.empty((0, 0), dtype=complex)

FloatArray = NDArray[np.float64]
Intervals = NDArray[np.complex128]  # as ``compiled`` has them
Pair = tuple[Intervals, Intervals]
Array = NDArray[Any]  # of nodes

_OPS = {
    "add": ops.ADD, "sub": ops.SUB, "mul": ops.MUL, "div": ops.DIV, "max": ops.MAX, "min": ops.MIN,
    "neg": ops.NEG, "sqr": ops.SQR, "sqrt": ops.SQRT, "sin": ops.SIN, "cos": ops.COS,
    "exp": ops.EXP, "log": ops.LOG, "abs": ops.ABS,
}  # fmt: skip

_RATIONAL: Mapping[str, Callable[..., Span]] = {
    "add": operator.add, "sub": operator.sub, "mul": operator.mul, "div": operator.truediv,
    "neg": operator.neg,
}  # fmt: skip

#: What changes nothing, as the second operand; of sums and products as the first one, too.
_NEUTRAL = {"add": 0, "sub": 0, "mul": 1, "div": 1}

_ORDERED: Mapping[str, Callable[..., Fraction]] = {"max": max, "min": min, "abs": abs}

#: Binary digits of numerators and denominators: more are refused, before they eat all memory.
_MOST_BITS = 40_000

#: Functions with a rational value at a rational number: (where, value).
_KNOWN = {"sin": (0, 0), "cos": (0, 1), "exp": (0, 1), "log": (1, 0)}


class Span:
    """An interval with rational ends; a number where they are equal, and all of it is exact.

    Raises
    ------
    ArithmeticError
        For absurdly many digits.
    """

    __slots__ = ("high", "low")

    def __init__(self, low: Fraction | int, high: Fraction | int | None = None) -> None:
        self.low = Fraction(low)
        self.high = self.low if high is None else Fraction(high)
        if not self.exact and max(v.denominator.bit_length() for v in (self.low, self.high)) > 1200:
            grid = 2**600  # ends of many digits are rounded outward
            self.low = Fraction(math.floor(self.low * grid), grid)
            self.high = Fraction(math.ceil(self.high * grid), grid)
        ends = self.low, self.high
        if max(max(abs(v.numerator), v.denominator).bit_length() for v in ends) > _MOST_BITS:
            raise ArithmeticError(f"a number of more than {_MOST_BITS} bits")

    @property
    def exact(self) -> bool:
        """Whether it is one number."""
        return self.low == self.high

    @property
    def zero(self) -> bool:
        """Whether it is the number 0."""
        return self.low == 0 == self.high

    def __add__(self, other: Span) -> Span:
        return Span(self.low + other.low, self.high + other.high)

    def __sub__(self, other: Span) -> Span:
        return Span(self.low - other.high, self.high - other.low)

    def __neg__(self) -> Span:
        return Span(-self.high, -self.low)

    def __mul__(self, other: Span) -> Span:
        if self.exact and other.exact:
            return Span(self.low * other.low)
        ends = [a * b for a in (self.low, self.high) for b in (other.low, other.high)]
        return Span(min(ends), max(ends))

    def __truediv__(self, other: Span) -> Span:
        if other.low <= 0 <= other.high:
            raise ZeroDivisionError("a divisor that may be 0")
        return self * Span(1 / other.high, 1 / other.low)


def _applied(kind: str, *of: Span) -> Span:
    """Enclose an operation: exactly where it is rational, else by the compiled arithmetic."""
    if kind in _RATIONAL:
        return _RATIONAL[kind](*of)
    if kind in ("max", "min"):
        raise ArithmeticError(f"{kind}: not smooth")
    (x,) = of
    if kind == "sqr":
        return x * x
    if x.exact and kind in _KNOWN and x.low == _KNOWN[kind][0]:
        return Span(_KNOWN[kind][1])
    if kind == "sqrt" and x.low > 0:
        return Span(_root(x.low)[0], _root(x.high)[1])
    near = ops.hull(x.low, x.high)
    found = ops.apply(_OPS[kind], near, near)
    if not np.isfinite(found):
        raise ZeroDivisionError(f"{kind} of a number where it may be undefined")
    return Span(Fraction(found.real), Fraction(found.imag))


def _root(x: Fraction) -> tuple[Fraction, Fraction]:
    """Return √x twice where it is rational, else two numbers around it, 2⁻⁴⁰⁰ apart."""
    above, below = math.isqrt(x.numerator), math.isqrt(x.denominator)
    if (above * above, below * below) == (x.numerator, x.denominator):
        return Fraction(above, below), Fraction(above, below)
    scaled = math.isqrt(x.numerator * x.denominator * 4**400)
    step = x.denominator * 2**400
    return Fraction(scaled, step), Fraction(scaled + 1, step)


@dataclass(frozen=True)
class Program:
    """Code for :func:`undertow.proofs.kernel.compiled.jets`, and registers of what it is about.

    Parameters
    ----------
    code
        (K, 3): operation and two registers.
    constants
        (C,): enclosures of the numbers.
    outputs
        Registers of the results, (O,).
    """

    code: NDArray[np.int64]
    constants: Intervals
    outputs: NDArray[np.int64]

    def __call__(self, box: Intervals, variables: int = 0) -> Intervals:
        """Enclose over a box (inputs,): values and derivatives by the first, (O, 1 + V)."""
        seeds = ops.points(np.eye(variables))
        jets = ops.jets(self.code, self.constants, box, _NONE, 0, seeds)
        return np.asarray(jets[self.outputs, 0])

    def expanded(self, box: Intervals, m: FloatArray, fixed: Intervals) -> Pair:
        """Enclose values and derivatives by the first inputs, (O, 1 + N), and values at m, (O,).

        Over a box of them, (N,), m inside; ``fixed`` are the other inputs.
        """
        whole = self(np.concatenate([box, fixed]), len(m))
        return whole, self(np.concatenate([ops.between(m, m), fixed]))[:, 0]

    def series(self, box: Intervals, order: int, seeds: Intervals = _NO_SEEDS) -> Intervals:
        """Enclose Taylor coefficients of motions ẋ = outputs of the first N inputs.

        Returns (N, order + 1, 1 + V): each with its derivatives by V variables; ``seeds``,
        (S, V), are those of the first inputs at time 0.
        """
        rates = self.outputs
        jets = ops.jets(self.code, self.constants, box, rates, order, seeds)
        return np.asarray(jets[: len(rates)])


def _operators(kind: str) -> tuple[Callable[[Node, Other], Node], Callable[[Node, Other], Node]]:
    """An operation on a node and what follows it, and on a node and what precedes it."""
    return (
        lambda node, other: node.graph.make(kind, node, other),
        lambda node, other: node.graph.make(kind, other, node),
    )


class Node:
    """An expression: operation and operands, its number if it is one, whether always defined."""

    __slots__ = ("graph", "index", "kind", "number", "of", "total")

    def __init__(
        self, graph: Graph, kind: str, of: tuple[Node, ...], number: Fraction | None, total: bool
    ) -> None:
        self.graph, self.index, self.kind = graph, graph.size, kind
        self.of, self.number, self.total = of, number, total
        graph.size += 1

    __add__, __radd__ = _operators("add")
    __sub__, __rsub__ = _operators("sub")
    __mul__, __rmul__ = _operators("mul")
    __truediv__, __rtruediv__ = _operators("div")

    def __neg__(self) -> Node:
        return self.graph.make("neg", self)

    def __abs__(self) -> Node:
        return self.graph.make("abs", self)


Other = Node | Fraction | int
Sides = Mapping[Node, Node]
NOWHERE: Sides = {}


class Graph:
    """Nodes, each made of earlier ones, over a number of inputs."""

    def __init__(self, inputs: int) -> None:
        self.size = 0
        self._known: dict[Any, Node] = {}
        leaves = [Node(self, "input", (), None, True) for _ in range(inputs)]
        self.inputs: Array = np.array(leaves, dtype=object)

    def _new(self, kind: str, of: tuple[Node, ...], number: Fraction | None, total: bool) -> Node:
        key = kind, number, of
        if key not in self._known:
            self._known[key] = Node(self, kind, of, number, total)
        return self._known[key]

    def number(self, value: Fraction | int) -> Node:
        """Return the node of a rational number."""
        return self._new("number", (), Fraction(value), True)

    def numbers(self, values: Sequence[Any]) -> Array:
        """Return an array of rational numbers, or of nodes, as one of nodes."""
        given = np.array(values, dtype=object)
        nodes = [v if isinstance(v, Node) else self.number(v) for v in given.flat]
        return np.array(nodes, dtype=object).reshape(given.shape)

    def make(self, kind: str, *operands: Other) -> Node:
        """Return the node of an operation on nodes or numbers, folded where that is exact."""
        if any(isinstance(v, np.ndarray) for v in operands):
            return NotImplemented  # type: ignore[no-any-return]
        of = tuple(v if isinstance(v, Node) else self.number(v) for v in operands)
        if kind == "neg" and of[0].kind == "neg":
            return of[0].of[0]
        numbers = [k.number for k in of if k.number is not None]
        if of and len(numbers) == len(of) and (folded := _folded(kind, numbers)) is not None:
            return self.number(folded)
        if len(of) == 2 and (simple := self._simpler(kind, *of)) is not None:
            return simple
        safe = kind not in ("div", "sqrt", "log") or (kind == "div" and bool(of[1].number))
        return self._new(kind, of, None, safe and all(k.total for k in of))

    def _simpler(self, kind: str, a: Node, b: Node) -> Node | None:
        x, y, neutral = a.number, b.number, _NEUTRAL.get(kind)
        if kind == "mul" and ((x == 0 and b.total) or (y == 0 and a.total)):
            return self.number(0)
        if y is not None and y == neutral:
            return a
        if x is not None and x == neutral and kind in ("add", "mul"):
            return b
        if (kind == "sub" and x == 0) or (kind == "mul" and x == -1):
            return -b
        if kind == "mul" and y == -1:
            return -a
        return self.make("sqr", a) if kind == "mul" and a is b else None

    # -- what is written in terms of it --------------------------------------------------------

    def power(self, a: Node, k: int) -> Node:
        """Return aᵏ, k ≥ 1, of squares."""
        if k == 1:
            return a
        half = self.make("sqr", self.power(a, k // 2))
        return half * a if k % 2 else half

    def tanh(self, a: Node) -> Node:
        """Return tanh a = 1 − 2/(e^2a + 1); 0 at the number 0."""
        return 1 - 2 / (self.make("exp", 2 * a) + 1)

    def clip(self, a: Node, limit: Node | Fraction | int) -> Node:
        """Return min(max(a, −limit), limit)."""
        return self.make("min", self.make("max", a, -limit), limit)

    def tangents(
        self, roots: Collection[Node], seeds: Mapping[Node, Node], sides: Sides = NOWHERE
    ) -> list[Node]:
        """Return derivatives of nodes along seeds (node to its derivative), by the chain rule.

        ``sides`` has an operand for a max or min: the one that it is known to be.
        """
        known: dict[Node, Any] = dict(seeds)
        for k in depends(roots, sides):
            if k in sides and sides[k] in known:
                known[k] = known[sides[k]]
            if k in known or k in sides or not any(j in known for j in k.of):
                continue
            pairs = zip(_slopes(k), k.of, strict=True)
            known[k] = sum(s * known[j] for s, j in pairs if j in known)
        return [known.get(k, self.number(0)) for k in roots]

    def parities(self, roots: Collection[Node], variables: int) -> list[set[int]]:
        """Which of even (0) and odd (1) in the first inputs nodes are shown to be."""
        found = dict[Node, set[int]]()
        for k in depends(roots):
            kind, of = k.kind, [found[j] for j in k.of]
            if kind == "input":
                found[k] = {int(k.index < variables)}
            elif kind in ("mul", "div"):
                found[k] = {(i + j) % 2 for i in of[0] for j in of[1]}
            elif kind in ("sqr", "cos", "abs"):
                found[k] = {0} if of[0] else set()
            elif kind in ("add", "sub", "neg", "sin"):
                found[k] = of[0] & of[-1]
            else:
                found[k] = {0, 1} if k.number == 0 else set.intersection({0}, *of)
        return [found[k] for k in roots]

    # -- its values ------------------------------------------------------------------------------

    def exact(self, roots: Collection[Node], at: Sequence[Span]) -> list[Span]:
        """Evaluate nodes at exact values of inputs.

        Raises
        ------
        ZeroDivisionError
            Where an expression is, or may be, undefined.
        ArithmeticError
            For numbers with absurdly many digits, or what is not smooth.
        """
        found = dict[Node, Span]()
        for k in depends(roots):
            if k.kind == "input":
                found[k] = at[k.index]
            elif k.number is not None:
                found[k] = Span(k.number)
            elif k.kind == "pi":
                found[k] = Span(Fraction(ops.PI.real), Fraction(ops.PI.imag))
            else:
                found[k] = _applied(k.kind, *(found[j] for j in k.of))
        return [found[k] for k in roots]

    def not_zero(self, roots: Collection[Node], at: Sequence[Span], what: str) -> str:
        """Why nodes are not shown to be 0 at exact values of inputs, if they are not."""
        try:
            zero = all(v.zero for v in self.exact(roots, at))
        except ArithmeticError as error:
            return f"at the target: {error}"
        return "" if zero else f"{what} is not shown exactly"

    def program(self, roots: Collection[Node], sides: Sides = NOWHERE) -> Program:
        """Lower what some nodes depend on; every input stays one.

        ``sides`` has an operand for a max or min: the one that it is known to be.
        """
        needed, place = depends(roots, sides), {k: k.index for k in self.inputs}
        numbers = [k for k in needed if k.kind in ("number", "pi")]
        constants = [ops.PI if k.number is None else ops.hull(k.number) for k in numbers]
        place |= {k: i for i, k in enumerate(numbers, len(self.inputs))}
        base, lines = len(place), list[tuple[int, int, int]]()
        sines = dict[int, int]()  # sin and cos of one operand stand together
        for k in needed:
            here = base + len(lines)
            if k in place:
                continue
            if k in sides:
                place[k] = place[sides[k]]
                continue
            of = [place[j] for j in k.of]
            if k.kind in ("sin", "cos"):
                if of[0] not in sines:
                    sines[of[0]] = here
                    lines += [(ops.SIN, of[0], here + 1), (ops.COS, of[0], here)]
                place[k] = sines[of[0]] + (k.kind == "cos")
                continue
            place[k] = here
            lines.append((_OPS[k.kind], of[0], of[-1]))
        return Program(
            np.array(lines, dtype=np.int64).reshape(-1, 3),
            np.array(constants, dtype=complex),
            np.array([place[k] for k in roots], dtype=np.int64),
        )


def depends(roots: Iterable[Node], sides: Sides = NOWHERE) -> list[Node]:
    """Return the nodes that some depend on, in order, themselves included."""
    needed, todo = set[Node](), list(roots)
    while todo:
        k = todo.pop()
        if k not in needed:
            needed.add(k)
            todo += [sides[k]] if k in sides else k.of
    return sorted(needed, key=operator.attrgetter("index"))


def corners(roots: Iterable[Node]) -> list[Node]:
    """Return the max and min that nodes depend on."""
    return [k for k in depends(roots) if k.kind in ("max", "min")]


def _slopes(k: Node) -> tuple[Other, ...]:
    """Derivatives of a smooth operation by its operands."""
    a, b, make = k.of[0], k.of[-1], k.graph.make
    slopes: Mapping[str, Callable[[], tuple[Other, ...]]] = {
        "add": lambda: (1, 1), "sub": lambda: (1, -1), "neg": lambda: (-1,),
        "mul": lambda: (b, a), "div": lambda: (1 / b, -(k / b)), "sqr": lambda: (2 * a,),
        "sqrt": lambda: (Fraction(1, 2) / k,), "exp": lambda: (k,), "log": lambda: (1 / a,),
        "sin": lambda: (make("cos", a),), "cos": lambda: (-make("sin", a),),
    }  # fmt: skip
    if k.kind not in slopes:
        raise ArithmeticError(f"{k.kind}: not smooth")
    return slopes[k.kind]()


def _folded(kind: str, numbers: Sequence[Fraction]) -> Fraction | None:
    """The exact value of an operation on numbers, if it has a rational one."""
    if kind in _ORDERED:
        return _ORDERED[kind](*numbers)
    try:
        found = _applied(kind, *map(Span, numbers))
    except ArithmeticError:
        return None
    return found.low if found.exact else None
