"""Interval programs: a tape run by one compiled interpreter, with gradients, outward-rounded.

:mod:`undertow.proofs.intervals.interval` makes Python functions of a tape; here the tape becomes
data (opcodes and registers) for one numba kernel, which is compiled once for all mechanisms and
evaluates values and first derivatives over one box in some microseconds: fast enough for the
admission gate.

Why it is sound: the arithmetic of :mod:`undertow.proofs.intervals.outward`.  Derivatives follow
the chain rule in intervals; where |·|, max or min may switch, they are the hull of both sides
(Clarke), so that f(x) − f(y) ∈ [∂f](x − y) over a box.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import sympy as sp
from numpy.typing import NDArray

from undertow.base.errors import InvalidInputError
from undertow.models.mechanism import FloatArray
from undertow.proofs.intervals import outward as ops
from undertow.proofs.intervals.interval import exact_fraction
from undertow.symbolic import Tape
from undertow.symbolic.machine import numba

__all__ = ["Program"]

_UNARY = {
    sp.sin: ops.SIN,
    sp.cos: ops.COS,
    sp.exp: ops.EXP,
    sp.log: ops.LOG,
    sp.tanh: ops.TANH,
    sp.Abs: ops.ABS,
}


@dataclass(frozen=True, eq=False)
class Program:
    """Straight-line interval code.

    Parameters
    ----------
    variables, inputs
        Number of inputs that are differentiated by, and of all inputs; variables come first.
    code
        (K, 3): opcode and two operands; line k writes register ``inputs + constants + k``.
    constants
        (C, 2): enclosures of the numbers that occur.
    outputs
        Registers of the results, (O,).
    """

    variables: int
    inputs: int
    code: NDArray[np.int64]
    constants: FloatArray
    outputs: NDArray[np.int64]

    @classmethod
    def of(
        cls,
        tape: Tape,
        variables: Sequence[sp.Symbol],
        others: Sequence[sp.Symbol],
        outputs: Sequence[sp.Expr],
    ) -> Program:
        """Lower the part of a tape that ``outputs`` depend on.

        Raises
        ------
        InvalidInputError
            For a function that has no outward-rounded form here.
        """
        return _Lowering(tape, [*variables, *others], outputs).program(len(variables))

    def __call__(self, low: FloatArray, high: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Evaluate over a box.

        Parameters
        ----------
        low, high
            Ends of the inputs, (inputs,).

        Returns
        -------
        values
            (O, 2): enclosures of the outputs.
        gradients
            (O, V, 2): enclosures of their derivatives by the variables.
        """
        return run(self.code, self.constants, self.outputs, self.variables, low, high)  # type: ignore[no-any-return]


class _Lowering:
    """SymPy expressions to three-address code."""

    def __init__(self, tape: Tape, inputs: Sequence[sp.Symbol], outputs: Sequence[sp.Expr]) -> None:
        self.lines: list[tuple[int, tuple[str, int], tuple[str, int]]] = []
        self.constants: dict[tuple[float, float], int] = {}
        self.known: dict[sp.Expr, tuple[str, int]] = {s: ("input", i) for i, s in enumerate(inputs)}
        self.count = len(inputs)
        for line in tape.live(outputs):
            self.known[line.symbol] = self.lower(line.expression)
        self.results = [self.lower(sp.sympify(o)) for o in outputs]

    def program(self, variables: int) -> Program:
        base = {"input": 0, "constant": self.count, "line": self.count + len(self.constants)}

        def place(operand: tuple[str, int]) -> int:
            kind, index = operand
            return index if kind == "raw" else base[kind] + index

        code = [(op, place(a), place(b)) for op, a, b in self.lines]
        return Program(
            variables,
            self.count,
            np.array(code, dtype=np.int64).reshape(-1, 3),
            np.array(list(self.constants), dtype=float).reshape(-1, 2),
            np.array([place(r) for r in self.results], dtype=np.int64),
        )

    def line(self, op: int, a: tuple[str, int], b: tuple[str, int] = ("raw", 0)) -> tuple[str, int]:
        self.lines.append((op, a, b))
        return ("line", len(self.lines) - 1)

    def number(self, low: float, high: float) -> tuple[str, int]:
        return ("constant", self.constants.setdefault((low, high), len(self.constants)))

    def lower(self, e: sp.Expr) -> tuple[str, int]:
        if e not in self.known:
            self.known[e] = self.fresh(e)
        return self.known[e]

    def fresh(self, e: sp.Expr) -> tuple[str, int]:
        if e.is_Rational or e.is_Float:
            value = exact_fraction(e)
            near = value.numerator / value.denominator
            if near.as_integer_ratio() == (value.numerator, value.denominator):
                return self.number(near, near)
            return self.number(math.nextafter(near, -math.inf), math.nextafter(near, math.inf))
        if e is sp.pi:
            return self.number(math.pi, math.nextafter(math.pi, 4.0))
        if e.is_Add:
            return self.fold(ops.ADD, e.args)
        if e.is_Mul:
            if e.args[0] == -1:
                return self.line(ops.NEG, self.lower(sp.Mul(*e.args[1:])))
            return self.fold(ops.MUL, e.args)
        if e.is_Pow:
            return self.power(*e.args)
        if e.func in _UNARY:
            return self.line(_UNARY[e.func], self.lower(e.args[0]))
        if e.func is sp.tan:
            return self.lower(sp.sin(*e.args) * (1 / sp.cos(*e.args)))
        if e.func in (sp.Max, sp.Min):
            return self.fold(ops.MAX if e.func is sp.Max else ops.MIN, e.args)
        raise InvalidInputError(
            "expression for an interval program",
            value=str(e.func),
            limit="+ − × ÷, powers, sin, cos, tan, exp, log, tanh, sqrt, |·|, max, min",
        )

    def fold(self, op: int, args: Sequence[sp.Expr]) -> tuple[str, int]:
        total = self.lower(args[0])
        for other in args[1:]:
            total = self.line(op, total, self.lower(other))
        return total

    def power(self, base: sp.Expr, exponent: sp.Expr) -> tuple[str, int]:
        if exponent.is_Integer and int(exponent) != 0:
            inner, k = self.lower(base), abs(int(exponent))
            if k > 1:
                inner = self.line(ops.POWER, inner, ("raw", k))
            return inner if exponent > 0 else self.line(ops.RECIPROCAL, inner)
        if exponent in (sp.Rational(1, 2), sp.Rational(-1, 2)):
            root = self.line(ops.SQRT, self.lower(base))
            return root if exponent > 0 else self.line(ops.RECIPROCAL, root)
        raise InvalidInputError(
            "exponent in an interval program", value=str(exponent), limit="an integer or ±½"
        )


_njit: Any = numba.njit(cache=True, nogil=True, error_model="numpy")


@_njit
def run(code, constants, outputs, variables, low, high):  # type: ignore[no-untyped-def]
    """Run a program over a box: values (O, 2) and gradients (O, V, 2)."""
    first = len(low)
    lines = first + len(constants)
    total = lines + len(code)
    v = np.zeros((total, 2))
    g = np.zeros((total, variables, 2))
    moves = np.zeros(total, dtype=np.bool_)
    for i in range(first):
        v[i, 0], v[i, 1] = low[i], high[i]
        if i < variables:
            g[i, i, 0] = g[i, i, 1] = 1.0
            moves[i] = True
    for i in range(len(constants)):
        v[first + i, 0], v[first + i, 1] = constants[i, 0], constants[i, 1]
    for k in range(len(code)):
        op, a, b = code[k, 0], code[k, 1], code[k, 2]
        r = lines + k
        a0, a1 = v[a, 0], v[a, 1]
        two = op in ops.BINARY
        b0, b1 = (v[b, 0], v[b, 1]) if two else (0.0, 0.0)
        moves[r] = moves[a] or (two and moves[b])
        square = op == ops.MUL and a == b
        r0, r1 = ops.apply(ops.POWER if square else op, a0, a1, b0, b1, 2 if square else b)
        v[r, 0], v[r, 1] = r0, r1
        # The two factors of the chain rule g = da·∂a + db·∂b.
        da0, da1, db0, db1 = 1.0, 1.0, 0.0, 0.0
        if op == ops.ADD:
            db0, db1 = 1.0, 1.0
        elif op == ops.MUL:
            da0, da1, db0, db1 = b0, b1, a0, a1
        elif op == ops.NEG:
            da0, da1 = -1.0, -1.0
        elif op == ops.RECIPROCAL:
            s0, s1 = ops.power(r0, r1, 2)
            da0, da1 = -s1, -s0
        elif op == ops.POWER:
            s0, s1 = ops.power(a0, a1, b - 1)
            da0, da1 = ops.mul(float(b), float(b), s0, s1)
        elif op == ops.SQRT:
            da0, da1 = ops.reciprocal(2.0 * r0, 2.0 * r1)
        elif op == ops.SIN:
            da0, da1 = ops.cosine(a0, a1)
        elif op == ops.COS:
            s0, s1 = ops.sine(a0, a1)
            da0, da1 = -s1, -s0
        elif op == ops.EXP:
            da0, da1 = r0, r1
        elif op == ops.LOG:
            da0, da1 = ops.reciprocal(a0, a1)
        elif op == ops.TANH:
            s0, s1 = ops.power(r0, r1, 2)
            da0, da1 = ops.add(1.0, 1.0, -s1, -s0)
        elif op == ops.ABS:
            da0 = 1.0 if a0 >= 0.0 else -1.0
            da1 = -1.0 if a1 <= 0.0 else 1.0
        elif (a0 >= b1) if op == ops.MAX else (a1 <= b0):  # the first wins
            db0, db1 = 0.0, 0.0
        elif (b0 >= a1) if op == ops.MAX else (b1 <= a0):
            da0, da1, db0, db1 = 0.0, 0.0, 1.0, 1.0
        else:
            for j in range(variables):
                g[r, j, 0] = min(g[a, j, 0], g[b, j, 0])
                g[r, j, 1] = max(g[a, j, 1], g[b, j, 1])
            continue
        if not moves[r]:
            continue
        for j in range(variables):
            low_part, high_part = ops.mul(da0, da1, g[a, j, 0], g[a, j, 1])
            if two and not (db0 == 0.0 and db1 == 0.0):
                c, d = ops.mul(db0, db1, g[b, j, 0], g[b, j, 1])
                low_part, high_part = ops.add(low_part, high_part, c, d)
            g[r, j, 0], g[r, j, 1] = low_part, high_part
    return v[outputs], g[outputs]
