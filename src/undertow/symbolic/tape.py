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

    Symbols that change seldom are ``constants``. What they alone determine gets lines of its own,
    to be computed as seldom: coefficients and terms of sums, factors of products, divisors, whose
    reciprocals become factors.

    Examples
    --------
    >>> import sympy as sp
    >>> a, b = sp.symbols("a b")
    >>> tape = Tape()
    >>> tape.let(a * b) is tape.let(b * a)
    True
    """

    def __init__(self, constants: Iterable[sp.Symbol] = ()) -> None:
        self.assignments: list[Assignment] = []
        self._known: dict[sp.Expr, sp.Symbol] = {}
        self._constants: set[sp.Basic] = {*constants}

    def let(self, expression: sp.Expr | float) -> sp.Expr:
        """Lay one expression on the tape and return the atom that holds its value."""
        return self.let_all([expression])[0]

    def let_all(self, expressions: Iterable[sp.Expr | float]) -> list[sp.Expr]:
        """Lay several expressions at once, sharing their common subexpressions."""
        replacements, reduced = sp.cse(
            [self._collect(sp.sympify(e)) for e in expressions],
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
        fixed = self._is_constant(expression)
        expression = expression if fixed else self._apart(expression)
        if expression not in self._known:
            symbol = sp.Symbol(f"_v{len(self.assignments)}", real=True)
            self.assignments.append(Assignment(symbol, expression))
            self._known[expression] = symbol
            if fixed:
                self._constants.add(symbol)
        return self._known[expression]

    def _is_constant(self, expression: sp.Expr) -> bool:
        return bool(self._constants) and expression.free_symbols <= self._constants

    def _collect(self, expression: sp.Expr) -> sp.Expr:
        """Add up the constant coefficients of equal terms of a sum, on lines of their own."""
        if not self._constants:
            return expression
        coefficients: dict[sp.Expr, list[sp.Expr]] = {}
        for term in sp.Add.make_args(expression):
            factors = sp.Mul.make_args(term)
            fixed = [factor for factor in factors if self._is_constant(factor)]
            other = [factor for factor in factors if not self._is_constant(factor)]
            coefficients.setdefault(sp.Mul(*other), []).append(sp.Mul(*fixed))
        terms = []
        for term, parts in coefficients.items():
            total = sp.Add(*parts)
            sign = -1 if total.could_extract_minus_sign() else 1
            terms.append(sign * self._assign(sign * total) * term)
        return sp.Add(*terms)

    def _apart(self, expression: sp.Expr) -> sp.Expr:
        """Give lines of their own to what constants alone determine of an expression."""
        if expression.is_Atom or not expression.free_symbols:
            return expression
        if self._is_constant(expression):
            return self._assign(expression)
        known = [a for a in expression.args if self._is_constant(a) and a != -1]
        if len(known) > 1 and isinstance(expression, sp.Add | sp.Mul):
            rest = [a for a in expression.args if a not in known]
            return expression.func(self._apart(expression.func(*known)), *map(self._apart, rest))
        return expression.func(*map(self._apart, expression.args))

    def live(self, outputs: Iterable[sp.Expr]) -> list[Assignment]:
        """Return the assignments that ``outputs`` depend on, in order."""
        needed: set[sp.Basic] = set().union(*(sp.sympify(o).free_symbols for o in outputs))
        kept = []
        for assignment in reversed(self.assignments):
            if assignment.symbol in needed:
                kept.append(assignment)
                needed |= assignment.expression.free_symbols
        return kept[::-1]

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
