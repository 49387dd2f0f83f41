"""Quadratic Taylor models over batches of boxes, outward-rounded: enclosures of third order.

Over a box x = m + r ε, |ε_i| ≤ 1, every quantity is held as

    c + Σ g_i ε_i + Σ_{i≤j} h_ij ε_i ε_j + e·[−1, 1]

with floats c, g, h and one bound e for all that the polynomial leaves out: higher orders and
every rounding error.  What the terms of a sum have in common cancels, so that the bounds err
by the third power of the width of the box, where intervals err by the first and mean-value
forms by the second.

Why it is sound: see :mod:`undertow.proofs.intervals.taylor_kernel`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import sympy as sp
from numpy.typing import NDArray

from undertow.base.errors import InvalidInputError
from undertow.models.mechanism import FloatArray
from undertow.proofs.intervals import outward as ops
from undertow.proofs.intervals.program import Program
from undertow.proofs.intervals.taylor_kernel import LOAD, SCALE, SHIFT, run
from undertow.symbolic import Tape

__all__ = ["TaylorProgram"]

#: Sums of coefficients have at most 60 terms, see ``GROW``.
MOST_VARIABLES = 8

#: Where a value is: the line that computes it, or the interval of a number.
Place = int | tuple[float, float]


@dataclass(frozen=True, eq=False)
class TaylorProgram:
    """Straight-line code on Taylor models.

    Parameters
    ----------
    variables
        V, the inputs.
    code
        (K, 5): opcode, register of the result, two operands, and the set of variables that
        the result depends on, as bits.
    constants
        (C, 2): enclosures of the numbers that occur.
    registers
        How many are in use at once; the first V are the inputs.
    outputs
        Registers of the results, (O,).
    """

    variables: int
    code: NDArray[np.int64]
    constants: FloatArray
    registers: int
    outputs: NDArray[np.int64]

    @classmethod
    def of(
        cls,
        tape: Tape,
        variables: Sequence[sp.Symbol],
        fixed: Sequence[tuple[sp.Symbol, float]],
        outputs: Sequence[sp.Expr],
    ) -> TaylorProgram:
        """Lower the part of a tape that ``outputs`` depend on; ``fixed`` symbols are numbers.

        Raises
        ------
        InvalidInputError
            For more than eight variables, or a function without outward-rounded form.
        """
        if len(variables) > MOST_VARIABLES:
            raise InvalidInputError(
                "variables of a Taylor model", value=len(variables), limit=f"≤ {MOST_VARIABLES}"
            )
        program = Program.of(tape, variables, [s for s, _ in fixed], outputs)
        return _Folding(program, [v for _, v in fixed]).result()

    def __call__(self, low: FloatArray, high: FloatArray) -> FloatArray:
        """Models of the outputs over boxes, (V, B) each, as rows: (O, 2 + V + V(V+1)/2, B).

        The rows are c, g_0 …, h_00, h_01, …, h_11, … and e.
        """
        return run(  # type: ignore[no-any-return]
            self.code, self.constants, self.registers, self.outputs, low, high
        )


class _Folding:
    """A program with its numbers folded, each value computed once, and registers reused."""

    def __init__(self, program: Program, fixed: Sequence[float]) -> None:
        self.variables = program.variables
        self.numbers: dict[tuple[float, float], int] = {}
        self.lines: list[tuple[int, int, int, int]] = []  # op, operands, mask
        self.seen: dict[tuple[int, int, int], int] = {}
        places: list[Place] = list(range(program.variables))
        places += [(float(v), float(v)) for v in fixed]
        places += [(float(a), float(b)) for a, b in program.constants]
        for op, a, b in program.code.tolist():
            two = op in ops.BINARY
            places.append(self.place(op, places[a], places[b] if two else b))
        self.outputs = [self.register(places[int(o)]) for o in program.outputs]

    def place(self, op: int, a: Place, b: Any) -> Place:
        """A value: the interval of a number, or a line."""
        two = op in ops.BINARY
        if isinstance(a, tuple) and (isinstance(b, tuple) or not two):
            return self.number(op, a, b)
        if op in (ops.MAX, ops.MIN):
            return self.line(op, self.register(a), self.register(b))
        if isinstance(a, tuple):
            a, b = b, a
        assert isinstance(a, int)
        if op == ops.POWER:
            return self.power(a, b)
        if two and isinstance(b, tuple):
            if b == ((0.0, 0.0) if op == ops.ADD else (1.0, 1.0)):
                return a
            return self.line(SHIFT if op == ops.ADD else SCALE, a, self.constant(b))
        return self.line(op, a, b if two else 0)

    def power(self, a: int, k: int) -> int:
        """By squares."""
        if k == 1:
            return a
        half = self.power(a, k // 2)
        square = self.line(ops.MUL, half, half)
        return self.line(ops.MUL, square, a) if k % 2 else square

    def number(self, op: int, a: tuple[float, float], b: Any) -> tuple[float, float]:
        second, k = (b, 0) if op in ops.BINARY else ((0.0, 0.0), b)
        low, high = ops.apply(op, *a, *second, k)
        return float(low), float(high)

    def constant(self, number: tuple[float, float]) -> int:
        return self.numbers.setdefault(number, len(self.numbers))

    def register(self, place: Place) -> int:
        if isinstance(place, tuple):
            return self.line(LOAD, 0, self.constant(place))
        return place

    def line(self, op: int, a: int, b: int) -> int:
        if op in ops.BINARY and b < a:
            a, b = b, a
        key = (op, a, b)
        if key not in self.seen:
            mask = 0 if op == LOAD else self.mask(a)
            if op in ops.BINARY:
                mask |= self.mask(b)
            self.seen[key] = self.variables + len(self.lines)
            self.lines.append((*key, mask))
        return self.seen[key]

    def mask(self, value: int) -> int:
        return 1 << value if value < self.variables else self.lines[value - self.variables][3]

    def result(self) -> TaylorProgram:
        """Registers by last use."""
        last = dict.fromkeys(self.outputs, len(self.lines))
        for k in range(len(self.lines) - 1, -1, -1):
            for operand in self._operands(k):
                last.setdefault(operand, k)
        home = {i: i for i in range(self.variables)}
        free: list[int] = []
        count, code = self.variables, []
        for k, (op, a, b, mask) in enumerate(self.lines):
            value = self.variables + k
            if value not in last:
                continue
            if free:
                home[value] = free.pop()
            else:
                home[value], count = count, count + 1
            second = home[b] if op in ops.BINARY else b
            code.append((op, home[value], 0 if op == LOAD else home[a], second, mask))
            # The inputs keep their registers.
            free += [
                home[v] for v in set(self._operands(k)) if last[v] == k and v >= self.variables
            ]
        return TaylorProgram(
            self.variables,
            np.array(code, dtype=np.int64).reshape(-1, 5),
            np.array(list(self.numbers), dtype=float).reshape(-1, 2),
            count,
            np.array([home[o] for o in self.outputs], dtype=np.int64),
        )

    def _operands(self, k: int) -> tuple[int, ...]:
        op, a, b, _ = self.lines[k]
        if op == LOAD:
            return ()
        return (a, b) if op in ops.BINARY else (a,)
