"""Expressions as a graph with exact leaves: made, evaluated exactly, lowered to code.

A node is a tuple: a leaf ``("input", i)`` or ``("number", Fraction)`` or ``("pi",)``, or an
operation with the indices of earlier nodes.  Equal nodes are one.  Numbers are folded exactly, and
x + 0, x · 1 and the like fall away; 0 · x does only if x is defined everywhere.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import reduce
from typing import Any

import numpy as np
from numpy.typing import NDArray

from undertow.proofs.kernel import compiled as ops

NOWHERE: Mapping[int, int] = {}
_NONE, _NO_SEEDS = np.empty(0, dtype=np.int64), np.empty((0, 0, 2))

FloatArray = NDArray[np.float64]
Node = tuple[Any, ...]

_OPS = {
    "add": ops.ADD, "sub": ops.SUB, "mul": ops.MUL, "div": ops.DIV, "max": ops.MAX, "min": ops.MIN,
    "neg": ops.NEG, "sqr": ops.SQR, "sqrt": ops.SQRT, "sin": ops.SIN, "cos": ops.COS,
    "exp": ops.EXP, "log": ops.LOG, "abs": ops.ABS,
}  # fmt: skip

#: Digits from which a rational number is enclosed in doubles instead.
_MOST_BITS = 40_000

#: Functions with a rational value at a rational number: (where, value).
_KNOWN = {"sin": (0, 0), "cos": (0, 1), "exp": (0, 1), "log": (1, 0)}


def hull(low: Fraction, high: Fraction) -> tuple[float, float]:
    """Return doubles around [low, high]: the number itself, twice, where it is one."""
    return ops.enclose(low)[0], ops.enclose(high)[1]


class Span:
    """An interval with rational ends; a number where they are equal, and all of it is exact."""

    __slots__ = ("high", "low")

    def __init__(self, low: Fraction | int, high: Fraction | int | None = None) -> None:
        self.low = Fraction(low)
        self.high = self.low if high is None else Fraction(high)
        if self.exact:
            return
        if max(self.low.denominator.bit_length(), self.high.denominator.bit_length()) > 1200:
            grid = 2**600  # ends of many digits are rounded outward
            self.low = Fraction(math.floor(self.low * grid), grid)
            self.high = Fraction(math.ceil(self.high * grid), grid)

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


def _applied(kind: str, x: Span, y: Span | None = None) -> Span:
    """Enclose an operation: exactly where it is rational, else by the compiled arithmetic."""
    if y is not None:
        if kind in ("add", "sub"):
            return x + y if kind == "add" else x - y
        if kind in ("mul", "div"):
            return x * y if kind == "mul" else x / y
        raise ArithmeticError(f"{kind}: not smooth")
    if kind in ("neg", "sqr"):
        return -x if kind == "neg" else x * x
    if x.exact and kind in _KNOWN and x.low == _KNOWN[kind][0]:
        return Span(_KNOWN[kind][1])
    if kind == "sqrt" and x.low > 0:
        low, high = (_root(v) for v in (x.low, x.high))
        return Span(low[0], high[1])
    low, high = ops.apply(_OPS[kind], *hull(x.low, x.high), 0.0, 0.0)
    if not (math.isfinite(low) and math.isfinite(high)):
        raise ZeroDivisionError(f"{kind} of a number where it may be undefined")
    return Span(Fraction(low), Fraction(high))


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
    inputs
        Number of inputs, which come first.
    code
        (K, 3): operation and two registers.
    constants
        (C, 2): enclosures of the numbers.
    outputs
        Registers of the results, (O,).
    """

    inputs: int
    code: NDArray[np.int64]
    constants: FloatArray
    outputs: NDArray[np.int64]

    def __call__(self, low: FloatArray, high: FloatArray, variables: int = 0) -> FloatArray:
        """Enclose over a box (inputs,): values and derivatives by the first, (O, 1 + V, 2)."""
        seeds = ops.points(np.eye(variables))
        jets = ops.jets(self.code, self.constants, low, high, _NONE, 0, seeds)
        return np.asarray(jets[self.outputs, 0])

    def series(
        self, low: FloatArray, high: FloatArray, order: int, seeds: FloatArray = _NO_SEEDS
    ) -> FloatArray:
        """Enclose Taylor coefficients of motions ẋ = outputs of the first N inputs.

        Returns (N, order + 1, 1 + V, 2): each with its derivatives by V variables; ``seeds``,
        (S, V, 2), are those of the first inputs at time 0.
        """
        rates = self.outputs
        jets = ops.jets(self.code, self.constants, low, high, rates, order, seeds)
        return np.asarray(jets[: len(rates)])


class Graph:
    """Nodes, each made of earlier ones, over a number of inputs."""

    def __init__(self, inputs: int) -> None:
        self.nodes: list[Node] = []
        self.total: list[bool] = []
        self._known: dict[Node, int] = {}
        self.inputs = [self._new(("input", i), True) for i in range(inputs)]

    def _new(self, node: Node, total: bool) -> int:
        if node not in self._known:
            self._known[node] = len(self.nodes)
            self.nodes.append(node)
            self.total.append(total)
        return self._known[node]

    def number(self, value: Fraction | int) -> int:
        """Return the node of a rational number."""
        return self._new(("number", Fraction(value)), True)

    def value(self, k: int) -> Fraction | None:
        """Return the number that a node is, if it is one."""
        node = self.nodes[k]
        return node[1] if node[0] == "number" else None

    def make(self, kind: str, a: int = 0, b: int = 0) -> int:
        """Return the node of an operation, folded where that is exact."""
        if kind == "pi":
            return self._new(("pi",), True)
        if kind == "neg" and self.nodes[a][0] == "neg":
            return int(self.nodes[a][1])
        two = _OPS[kind] in ops.BINARY
        x, y = self.value(a), self.value(b) if two else None
        known = x is not None and (y is not None or not two) and (kind != "div" or y != 0)
        if known and x is not None and (folded := _folded(kind, x, y)) is not None:
            return self.number(folded)
        if two and (simple := self._simpler(kind, a, b, x, y)) is not None:
            return simple
        safe = kind not in ("div", "sqrt", "log") or (kind == "div" and bool(y))
        total = self.total[a] and (not two or self.total[b]) and safe
        return self._new((kind, a, b) if two else (kind, a), total)

    def _simpler(
        self, kind: str, a: int, b: int, x: Fraction | None, y: Fraction | None
    ) -> int | None:
        if kind == "add" and (x == 0 or y == 0):
            return b if x == 0 else a
        if kind == "sub" and y == 0:
            return a
        if kind == "sub" and x == 0:
            return self.make("neg", b)
        if kind == "mul":
            if (x == 0 and self.total[b]) or (y == 0 and self.total[a]):
                return self.number(0)
            if 1 in (x, y):
                return b if x == 1 else a
            if -1 in (x, y):
                return self.make("neg", b if x == -1 else a)
            if a == b:
                return self.make("sqr", a)
        if kind == "div" and y == 1:
            return a
        if kind == "div" and x == 0 and y:
            return self.number(0)
        return None

    # -- what is written in terms of it --------------------------------------------------------

    def sum(self, terms: Iterable[int]) -> int:
        """Return the sum of nodes."""
        return reduce(lambda a, b: self.make("add", a, b), terms, self.number(0))

    def power(self, a: int, k: int) -> int:
        """Return aᵏ, k ≥ 1, of squares."""
        if k == 1:
            return a
        half = self.make("sqr", self.power(a, k // 2))
        return self.make("mul", half, a) if k % 2 else half

    def tanh(self, a: int) -> int:
        """Return tanh a = 1 − 2/(e^2a + 1); 0 at the number 0."""
        one, two = self.number(1), self.number(2)
        e = self.make("exp", self.make("mul", two, a))
        return self.make("sub", one, self.make("div", two, self.make("add", e, one)))

    def clip(self, a: int, limit: int) -> int:
        """Return min(max(a, −limit), limit)."""
        return self.make("min", self.make("max", a, self.make("neg", limit)), limit)

    def depends(self, roots: Iterable[int], sides: Mapping[int, int] = NOWHERE) -> list[int]:
        """Return the nodes that some depend on, in order, themselves included."""
        needed, todo = set[int](), list(roots)
        while todo:
            k = todo.pop()
            if k not in needed:
                needed.add(k)
                todo += [sides[k]] if k in sides else self._operands(k)
        return sorted(needed)

    def _operands(self, k: int) -> list[int]:
        node = self.nodes[k]
        return [] if node[0] in ("input", "number", "pi") else [int(v) for v in node[1:]]

    def tangents(
        self, roots: Sequence[int], seeds: Mapping[int, int], sides: Mapping[int, int] = NOWHERE
    ) -> list[int]:
        """Return derivatives of nodes along seeds (node to its derivative), by the chain rule.

        ``sides`` has an operand for a max or min: the one that it is known to be.
        """
        known = dict(seeds)
        for k in self.depends(roots, sides):
            operands = self._operands(k)
            if k in sides and sides[k] in known:
                known[k] = known[sides[k]]
            if k in known or k in sides or not any(j in known for j in operands):
                continue
            pairs = zip(self._slopes(k), operands, strict=True)
            known[k] = self.sum(self.make("mul", s, known[j]) for s, j in pairs if j in known)
        return [known.get(k, self.number(0)) for k in roots]

    def _slopes(self, k: int) -> list[int]:
        """Derivatives of a smooth operation by its operands."""
        make, number, one = self.make, self.number, self.number(1)
        kind, a, b = self.nodes[k][0], self.nodes[k][1], self.nodes[k][-1]
        if kind in ("add", "sub"):
            return [one, one if kind == "add" else number(-1)]
        if kind == "mul":
            return [b, a]
        if kind == "div":
            return [make("div", one, b), make("neg", make("div", k, b))]
        if kind == "sqrt":
            return [make("div", number(Fraction(1, 2)), k)]
        if kind in ("sin", "cos"):
            return [make("cos", a) if kind == "sin" else make("neg", make("sin", a))]
        if kind in ("neg", "exp"):
            return [k if kind == "exp" else number(-1)]
        if kind not in ("sqr", "log"):
            raise ArithmeticError(f"{kind}: not smooth")
        return [make("mul", number(2), a) if kind == "sqr" else make("div", one, a)]

    def parities(self, roots: Iterable[int], variables: int) -> list[set[int]]:
        """Which of even (0) and odd (1) in the first inputs nodes are shown to be."""
        found = dict[int, set[int]]()
        for k in self.depends(roots):
            kind, of = self.nodes[k][0], [found[j] for j in self._operands(k)]
            if kind == "input":
                found[k] = {int(self.nodes[k][1] < variables)}
            elif kind in ("mul", "div"):
                found[k] = {(i + j) % 2 for i in of[0] for j in of[1]}
            elif kind in ("sqr", "cos", "abs"):
                found[k] = {0} if of[0] else set()
            elif kind in ("add", "sub", "neg", "sin"):
                found[k] = of[0] & of[-1]
            else:
                found[k] = {0, 1} if self.value(k) == 0 else set.intersection({0}, *of)
        return [found[k] for k in roots]

    # -- its values ------------------------------------------------------------------------------

    def exact(self, roots: Sequence[int], at: Sequence[Span]) -> list[Span]:
        """Evaluate nodes at exact values of inputs.

        Raises
        ------
        ZeroDivisionError
            Where an expression is, or may be, undefined.
        ArithmeticError
            For numbers with absurdly many digits, or what is not smooth.
        """
        found = dict[int, Span]()
        for k in self.depends(roots):
            kind, *rest = self.nodes[k]
            if kind == "input":
                found[k] = at[rest[0]]
            elif kind == "number":
                found[k] = Span(rest[0])
            elif kind == "pi":
                found[k] = Span(*(Fraction(v) for v in ops.PI))
            else:
                found[k] = _applied(kind, *(found[j] for j in rest))
            low = found[k].low
            if max(low.numerator.bit_length(), low.denominator.bit_length()) > _MOST_BITS:
                raise ArithmeticError(f"a number of more than {_MOST_BITS} bits")
        return [found[k] for k in roots]

    def corners(self, roots: Iterable[int]) -> list[int]:
        """Return the max and min that nodes depend on."""
        return [k for k in self.depends(roots) if self.nodes[k][0] in ("max", "min")]

    def program(self, roots: Sequence[int], sides: Mapping[int, int] = NOWHERE) -> Program:
        """Lower what some nodes depend on; every input stays one.

        ``sides`` has an operand for a max or min: the one that it is known to be.
        """
        needed = self.depends(roots, sides)
        count = len(self.inputs)
        place = {k: int(self.nodes[k][1]) for k in self.inputs}
        constants: list[tuple[float, float]] = []
        for k in needed:
            node = self.nodes[k]
            if node[0] in ("number", "pi"):
                place[k] = count + len(constants)
                constants.append(ops.PI if node[0] == "pi" else ops.enclose(node[1]))
        base, lines = count + len(constants), list[tuple[int, int, int]]()
        partner = dict[tuple[str, int], int]()  # sin and cos of one operand stand together
        for k in needed:
            node = self.nodes[k]
            if k in place:
                continue
            if k in sides:
                place[k] = place[sides[k]]
                continue
            kind, operands = str(node[0]), [place[j] for j in self._operands(k)]
            if kind in ("sin", "cos"):
                a = operands[0]
                if (kind, a) not in partner:
                    here = base + len(lines)
                    partner["sin", a], partner["cos", a] = here, here + 1
                    lines += [(ops.SIN, a, here + 1), (ops.COS, a, here)]
                place[k] = partner[kind, a]
                continue
            place[k] = base + len(lines)
            lines.append((_OPS[kind], operands[0], operands[-1]))
        return Program(
            count,
            np.array(lines, dtype=np.int64).reshape(-1, 3),
            np.array(constants, dtype=float).reshape(-1, 2),
            np.array([place[k] for k in roots], dtype=np.int64),
        )


def _folded(kind: str, x: Fraction, y: Fraction | None) -> Fraction | None:
    """The exact value of an operation on numbers, if it has a rational one."""
    if kind in ("max", "min", "abs"):
        return abs(x) if y is None else max(x, y) if kind == "max" else min(x, y)
    try:
        found = _applied(kind, *(Span(v) for v in (x, y) if v is not None))
    except ArithmeticError:
        return None
    return found.low if found.exact and found.low.denominator.bit_length() < _MOST_BITS else None
