"""A straight-line program of small SymPy assignments, with unrolled linear algebra.

Formulas are written once as SymPy expressions and laid on a :class:`Tape`.  Equal
subexpressions share one assignment.  Linear solves are unrolled on the *entries* as
scalars, so the length of the code grows with n³ and not with the expressions inside.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import sympy as sp


class Assignment(NamedTuple):
    """One line of a tape: ``symbol := expression``."""

    symbol: sp.Symbol
    expression: sp.Expr


class Tape:
    """Ordered assignments in which every distinct expression is computed once.

    Examples
    --------
    >>> import sympy as sp
    >>> a, b = sp.symbols("a b")
    >>> tape = Tape()
    >>> tape.let(a * b) is tape.let(b * a)
    True
    """

    def __init__(self) -> None:
        self.assignments: list[Assignment] = []
        self._known: dict[sp.Expr, sp.Symbol] = {}

    def let(self, expression: sp.Expr | float) -> sp.Expr:
        """Lay one expression on the tape and return the atom that holds its value."""
        return self.let_all([expression])[0]

    def let_all(self, expressions: Iterable[sp.Expr | float]) -> list[sp.Expr]:
        """Lay several expressions at once, sharing their common subexpressions."""
        replacements, reduced = sp.cse(
            [sp.sympify(e) for e in expressions],
            symbols=sp.numbered_symbols("_cse_", real=True),
            order="canonical",
        )
        local: dict[sp.Symbol, sp.Expr] = {}
        for symbol, expression in replacements:
            local[symbol] = self._assign(expression.xreplace(local))
        return [self._assign(e.xreplace(local)) for e in reduced]

    def _assign(self, expression: sp.Expr) -> sp.Expr:
        if expression.is_Atom:
            return expression
        if expression not in self._known:
            symbol = sp.Symbol(f"_v{len(self.assignments)}", real=True)
            self.assignments.append(Assignment(symbol, expression))
            self._known[expression] = symbol
        return self._known[expression]

    def live(self, outputs: Iterable[sp.Expr]) -> list[Assignment]:
        """Return the assignments that ``outputs`` depend on, in order."""
        needed: set[sp.Basic] = set().union(*(sp.sympify(o).free_symbols for o in outputs))
        kept = []
        for assignment in reversed(self.assignments):
            if assignment.symbol in needed:
                kept.append(assignment)
                needed |= assignment.expression.free_symbols
        return kept[::-1]

    def with_reciprocals(self, constants: Iterable[sp.Symbol]) -> Tape:
        """Return this tape with products for quotients by ``constants`` and by what they determine.

        Their reciprocals have lines of their own: a division takes a processor as long as a
        dozen products.
        """
        tape, fixed = Tape(), {*constants}
        for line in self.assignments:
            if line.expression.free_symbols <= fixed:
                fixed.add(line.symbol)
                tape.assignments.append(line)
                continue
            powers = [p for p in line.expression.atoms(sp.Pow) if p.exp.is_negative]
            inverse = {p: tape._reciprocal(p) for p in powers if p.base in fixed}
            tape.assignments.append(Assignment(line.symbol, line.expression.xreplace(inverse)))
        return tape

    def _reciprocal(self, power: sp.Pow) -> sp.Symbol:
        if power not in self._known:
            symbol = sp.Symbol(f"_inverse{len(self._known)}", real=True)
            self.assignments.append(Assignment(symbol, power))
            self._known[power] = symbol
        return self._known[power]

    # -- linear algebra on entries ------------------------------------------------------

    def product(self, a: sp.Matrix, b: sp.Matrix) -> sp.Matrix:
        """Return the product of two matrices of atoms, entry by entry on the tape."""
        return sp.Matrix(a.rows, b.cols, self.let_all(list(a * b)))

    def matrix(self, a: sp.Matrix) -> sp.Matrix:
        """Lay the entries of a matrix on the tape."""
        return sp.Matrix(a.rows, a.cols, self.let_all(list(a)))

    def cholesky(self, a: sp.Matrix) -> Cholesky:
        """Factor a symmetric positive definite matrix of atoms as L D Lᵀ (square-root free)."""
        n = a.rows
        lower = sp.eye(n)
        pivots: list[sp.Expr] = []
        inverse_pivots: list[sp.Expr] = []
        for j in range(n):
            pivot = self.let(a[j, j] - sum(lower[j, k] ** 2 * pivots[k] for k in range(j)))
            pivots.append(pivot)
            inverse_pivots.append(self.let(1 / pivot))
            for i in range(j + 1, n):
                entry = a[i, j] - sum(lower[i, k] * lower[j, k] * pivots[k] for k in range(j))
                lower[i, j] = self.let(entry * inverse_pivots[j])
        return Cholesky(self, lower, tuple(pivots), tuple(inverse_pivots))

    def adjugate(self, a: sp.Matrix) -> tuple[sp.Matrix, sp.Expr]:
        """Return the adjugate and the determinant of a general square matrix of atoms.

        Faddeev-LeVerrier: polynomial in the entries, so it is exact at a singular
        matrix, where the determinant is returned as zero and nothing divides by it.
        """
        m = a.rows
        identity = sp.eye(m)
        auxiliary = identity
        for k in range(1, m):
            step = self.product(a, auxiliary)
            coefficient = self.let(-step.trace() / k)
            auxiliary = self.matrix(step + coefficient * identity)
        determinant = self.let(self.product(a, auxiliary).trace() / m * (-1) ** (m - 1))
        return self.matrix(auxiliary * (-1) ** (m - 1)), determinant


@dataclass(frozen=True, eq=False)
class Cholesky:
    """An unrolled L D Lᵀ factorisation on a tape."""

    tape: Tape
    lower: sp.Matrix
    pivots: Sequence[sp.Expr]
    inverse_pivots: Sequence[sp.Expr]

    def solve(self, b: sp.Matrix) -> sp.Matrix:
        """Return A⁻¹ b for a matrix b of atoms, (n, k)."""
        n, tape = self.lower.rows, self.tape
        columns = []
        for c in range(b.cols):
            y: list[sp.Expr] = []
            for i in range(n):
                y.append(tape.let(b[i, c] - sum(self.lower[i, k] * y[k] for k in range(i))))
            z = [tape.let(y[i] * self.inverse_pivots[i]) for i in range(n)]
            for i in reversed(range(n)):
                tail = sum(self.lower[k, i] * z[k] for k in range(i + 1, n))
                z[i] = tape.let(z[i] - tail)
            columns.append(sp.Matrix(z))
        return sp.Matrix.hstack(*columns)
