"""The tape: shared subexpressions, exact small linear algebra, and printing to NumPy."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest
import sympy as sp
from hypothesis import given, settings
from hypothesis import strategies as st

from undertow.models import FloatArray
from undertow.symbolic import Tape, compile_numpy
from undertow.symbolic.vector import VectorFunction

a, b, c = sp.symbols("a b c", real=True)


def symbol_matrix(rows: int, columns: int, stem: str = "e") -> sp.Matrix:
    return sp.Matrix(rows, columns, lambda i, j: sp.Symbol(f"{stem}_{i}_{j}", real=True))


def symmetric_symbols(n: int) -> sp.Matrix:
    entries = symbol_matrix(n, n)
    return sp.Matrix(n, n, lambda i, j: entries[min(i, j), max(i, j)])


def square_matrices(entries: st.SearchStrategy[int]) -> st.SearchStrategy[FloatArray]:
    def of_size(m: int) -> st.SearchStrategy[FloatArray]:
        return st.lists(entries, min_size=m * m, max_size=m * m).map(
            lambda v: np.array(v, dtype=float).reshape(m, m)
        )

    return st.integers(1, 4).flatmap(of_size)


# -- sharing ---------------------------------------------------------------------------------


def test_equal_expressions_share_one_assignment() -> None:
    tape = Tape()
    first = tape.let(a * sp.sin(b))
    assert tape.let(sp.sin(b) * a) is first
    assert tape.let(first) is first
    assert len(tape.assignments) == 1


def test_common_subexpressions_of_one_call_are_computed_once() -> None:
    tape = Tape()
    tape.let_all([sp.sin(a * b) + c, sp.sin(a * b) ** 2, sp.cos(a * b) * c])
    laid = [line.expression for line in tape.assignments]
    assert sum(e.count(sp.sin(sp.Wild("w"))) for e in laid) == 1
    assert laid.count(a * b) == 1


def test_assignments_refer_only_to_earlier_ones_and_to_inputs() -> None:
    tape = Tape()
    tape.cholesky(tape.matrix(symmetric_symbols(4))).solve(symbol_matrix(4, 2, "r"))
    laid: set[sp.Basic] = set()
    every = {line.symbol for line in tape.assignments}
    for line in tape.assignments:
        assert line.symbol not in laid
        assert line.expression.free_symbols & every <= laid
        laid.add(line.symbol)


def test_live_keeps_exactly_what_the_outputs_depend_on() -> None:
    tape = Tape()
    square = tape.let(a**2)
    tape.let(b**2)
    output = tape.let(square + c)
    assert [line.symbol for line in tape.live([output])] == [square, output]
    assert tape.live([a]) == []


@pytest.mark.parametrize("n", [2, 3, 4, 5, 6])
def test_code_of_a_solve_grows_with_n_cubed_and_not_with_the_entries(n: int) -> None:
    def operations(entry: sp.Expr) -> int:
        tape = Tape()
        matrix = symmetric_symbols(n).applyfunc(lambda e: entry.subs(a, e))
        atoms = tape.matrix(matrix)
        before = len(tape.assignments)
        tape.cholesky(atoms).solve(sp.Matrix(symbol_matrix(n, 1, "r")))
        return sum(line.expression.count_ops() for line in tape.assignments[before:])

    plain, rich = operations(a), operations(sp.sin(a) ** 3 + sp.exp(a) * a)
    assert rich == plain
    assert plain <= 2 * n**3 + 5 * n


# -- linear algebra --------------------------------------------------------------------------


@settings(max_examples=25)
@given(square_matrices(st.integers(-9, 9)))
def test_adjugate_times_matrix_is_the_determinant_times_the_identity(A: FloatArray) -> None:
    assert_adjugate(A)


@settings(max_examples=25)
@given(square_matrices(st.integers(-9, 9)), st.data())
def test_adjugate_exists_at_singular_matrices(A: FloatArray, data: st.DataObject) -> None:
    m = len(A)
    weights = data.draw(st.lists(st.integers(-2, 2), min_size=m - 1, max_size=m - 1))
    A[-1] = np.array(weights, dtype=float) @ A[:-1] if m > 1 else 0.0
    assert_adjugate(A)


def assert_adjugate(A: FloatArray) -> None:
    """A adj(A) = adj(A) A = det(A) I: without any error for m ≤ 2, else up to rounding."""
    m = len(A)
    *entries, determinant = compiled_adjugate(m)(*A.ravel())
    adjugate = np.array(entries, dtype=float).reshape(m, m)
    exact = int(sp.Matrix(m, m, [int(v) for v in A.ravel()]).det())
    rounding = 0.0 if m <= 2 else 1e-15 * (np.abs(A).sum() + 1) ** m
    assert abs(determinant - exact) <= rounding
    for product in (A @ adjugate, adjugate @ A):
        np.testing.assert_allclose(product, exact * np.eye(m), rtol=0, atol=rounding)


@lru_cache
def compiled_adjugate(m: int) -> VectorFunction:
    tape, symbols = Tape(), symbol_matrix(m, m)
    adjugate, determinant = tape.adjugate(symbols)
    return compile_numpy(tape, list(symbols), [*adjugate, determinant])


@pytest.mark.parametrize("m", [1, 2, 3])
def test_adjugate_is_the_symbolic_one(m: int) -> None:
    tape, symbols = Tape(), symbol_matrix(m, m)
    adjugate, determinant = tape.adjugate(symbols)
    assert (unfold(tape, adjugate) - symbols.adjugate()).expand() == sp.zeros(m)
    assert sp.expand(unfold(tape, sp.Matrix([determinant]))[0] - symbols.det()) == 0


def unfold(tape: Tape, matrix: sp.Matrix) -> sp.Matrix:
    """Put the tape's assignments back into the atoms of a matrix."""
    for line in reversed(tape.assignments):
        matrix = matrix.subs(line.symbol, line.expression)
    return matrix


@pytest.mark.parametrize("n", [1, 2, 3, 4, 5])
def test_cholesky_solves_and_factors_as_numpy_does(n: int) -> None:
    tape, matrix, right = Tape(), symmetric_symbols(n), symbol_matrix(n, 2, "r")
    factor = tape.cholesky(matrix)
    inputs = [matrix[i, j] for i in range(n) for j in range(i, n)]
    run = compile_numpy(
        tape, [*inputs, *right], [*factor.solve(right), *factor.lower, *factor.pivots]
    )
    rng = np.random.default_rng(n)
    root = rng.standard_normal((50, n, n))
    A = root @ np.swapaxes(root, 1, 2) + 0.1 * np.eye(n)
    B = rng.standard_normal((50, n, 2))
    upper = [A[:, i, j] for i in range(n) for j in range(i, n)]
    values = run(*upper, *np.moveaxis(B.reshape(50, 2 * n), -1, 0))
    stacked = np.stack([np.broadcast_to(v, 50) for v in values], axis=-1)
    X, L, D = np.split(stacked, [2 * n, 2 * n + n * n], axis=-1)
    np.testing.assert_allclose(X.reshape(50, n, 2), np.linalg.solve(A, B), rtol=1e-9, atol=1e-10)
    L = L.reshape(50, n, n)
    np.testing.assert_allclose(L * D[:, None, :] @ np.swapaxes(L, 1, 2), A, rtol=1e-11, atol=1e-12)
    assert (D > 0).all()


def test_a_matrix_that_is_not_positive_definite_shows_in_its_pivots() -> None:
    tape, matrix = Tape(), symmetric_symbols(2)
    factor = tape.cholesky(matrix)
    run = compile_numpy(tape, [matrix[0, 0], matrix[0, 1], matrix[1, 1]], list(factor.pivots))
    assert min(run(1.0, 2.0, 1.0)) < 0 < min(run(1.0, 0.5, 1.0))


# -- printing to NumPy -----------------------------------------------------------------------

FORMULAS: dict[str, sp.Expr] = {
    "polynomial": a**3 - 2 * a * b + sp.Rational(1, 3) * c,
    "trigonometry": sp.sin(a) * sp.cos(b - c) + sp.tan(c / 4),
    "roots and powers": sp.sqrt(1 + a**2) + (1 + b**2) ** sp.Rational(-1, 2) + 1 / (2 + c**2),
    "saturation": sp.Max(-1, sp.Min(1, a / (1 + b**2))),
    "three-way extremes": sp.Max(a, b, c) - sp.Min(a, b, c),
    "sign and modulus": sp.sign(a) * sp.Abs(b) - sp.Abs(c),
    "hyperbolic": sp.tanh(a) + sp.exp(-(b**2)) + sp.log(1 + c**2),
    "cases": sp.Piecewise((a, a > 0), (b, c > 0), (sp.Float(0.5), True)),
}
numbers = st.floats(-8, 8, allow_nan=False)


@settings(max_examples=15)
@given(numbers, numbers, numbers)
def test_compiled_tape_equals_sympy_substitution(x: float, y: float, z: float) -> None:
    values = compiled_formulas()(x, y, z)
    for (name, formula), value in zip(FORMULAS.items(), values, strict=True):
        expected = float(formula.subs({a: x, b: y, c: z}))
        assert float(value) == pytest.approx(expected, rel=1e-12, abs=1e-13), name


def test_compiled_tape_broadcasts_over_batches() -> None:
    grid = np.linspace(-3, 3, 5)
    x, y = np.meshgrid(grid, grid)
    batch = compiled_formulas()(x, y, 0.25)
    for formula, values in zip(FORMULAS.values(), batch, strict=True):
        expected = [[float(formula.subs({a: u, b: v, c: 0.25})) for u in grid] for v in grid]
        np.testing.assert_allclose(
            np.broadcast_to(values, (5, 5)), expected, rtol=1e-12, atol=1e-13
        )


@lru_cache
def compiled_formulas() -> VectorFunction:
    tape = Tape()
    return compile_numpy(tape, [a, b, c], tape.let_all(FORMULAS.values()))


def test_inputs_may_carry_any_name_even_a_keyword() -> None:
    """A coordinate may be called 'lambda': inputs are renamed before they are printed."""
    lam = sp.Symbol("lambda", real=True)
    tape = Tape()
    assert compile_numpy(tape, [lam], [tape.let(lam**2)])(3.0) == [9.0]
