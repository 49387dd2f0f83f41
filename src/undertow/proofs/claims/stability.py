"""Stability on the surface, decided exactly for any n and m.

The matrix of the sliding dynamics (see :mod:`undertow.law.stability`) is formed in exact rational
arithmetic (every float parameter is the binary number that it is) and the Routh array of its
characteristic polynomial decides.  Shifting the matrix by σ proves the margin.  Where the model is
not rational at the target, balls take the place.
"""

from __future__ import annotations

import itertools
import math
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, ClassVar, cast

import numpy as np
import sympy as sp

from undertow.base.verdict import Verdict
from undertow.law import ReachingLaw, Surface, check_surface_shape
from undertow.law.stability import sliding_matrix
from undertow.models.mechanism import TIME, Mechanism
from undertow.proofs.claims.claim import Claim
from undertow.proofs.intervals.exact_model import exact_mechanism, exact_number, vanishes
from undertow.proofs.intervals.interval import compile_outward, flint
from undertow.symbolic import Tape

__all__ = ["StabilityClaim", "exact_linearisation", "hurwitz"]

_BITS = 300


def _precision(bits: int = _BITS) -> AbstractContextManager[None]:
    return cast(AbstractContextManager[None], flint().ctx.workprec(bits))


def exact_linearisation(mechanism: Mechanism) -> tuple[list[list[Any]], bool]:
    """Return [M | F | D] at the target, n rows of 3n numbers, and whether they are exact.

    ``M q̈ = F q + D q̇`` near x = 0; entries are rationals (fmpq) where the model is rational
    at the target with its float parameters taken as the binary numbers that they are, else
    all are balls (arb) of 300 bits.

    Raises
    ------
    ModelError
        For a model that is not smooth.
    """
    model = exact_mechanism(mechanism)
    origin = dict.fromkeys(model.x, sp.Integer(0)) | {TIME: sp.Integer(0)}
    jacobian = sp.Matrix(model.force).jacobian(list(model.x))
    symbolic = sp.Matrix.hstack(sp.Matrix(model.mass_matrix), jacobian)
    entries = [e.subs(origin).subs(_exact_values(model)) for e in symbolic]
    exact = all(e.is_Rational for e in entries)
    module = flint()
    if exact:
        numbers = [module.fmpq(int(e.p), int(e.q)) for e in entries]
    else:
        tape = Tape()
        with _precision():
            numbers = compile_outward(tape, [], tape.let_all(entries))()
            numbers = [module.arb(v) for v in numbers]
    columns = symbolic.cols
    return [numbers[i : i + columns] for i in range(0, len(numbers), columns)], exact


def _exact_values(mechanism: Mechanism) -> dict[sp.Symbol, sp.Rational]:
    return {p.symbol: exact_number(p.value) for p in mechanism.parameters}


def _no_equilibrium(mechanism: Mechanism) -> str:
    """Why the target is not shown to be an equilibrium on the surface, or nothing."""
    model = exact_mechanism(mechanism)
    if TIME in model.force.free_symbols:
        return "the force depends on time"
    rows = [e.subs(_exact_values(model)) for e in model.force[model.m :, :]]
    return "" if vanishes(rows, model.x) else "f_u(0, 0) = 0 is not shown exactly"


def _sliding_matrix_exact(mechanism: Mechanism, surface: Surface) -> tuple[Any, bool]:
    """Return A_s as fmpq_mat, or as arb_mat, and whether it is exact."""
    module = flint()
    rows, exact = exact_linearisation(mechanism)
    n, m = mechanism.n, mechanism.m
    free = n - m

    def number(v: float) -> Any:
        q = module.fmpq(*float(v).as_integer_ratio())
        return q if exact else module.arb(q)

    def matrix(block: Any) -> Any:
        lines = [[number(v) if isinstance(v, float) else v for v in line] for line in block]
        return module.fmpq_mat(lines) if exact else module.arb_mat(lines)

    M_ua = matrix([row[:m] for row in rows[m:]])
    M_uu = matrix([row[m:n] for row in rows[m:]])
    F_u = matrix([row[n : 2 * n] for row in rows[m:]])
    D_ua = matrix([row[2 * n : 2 * n + m] for row in rows[m:]])
    D_uu = matrix([row[2 * n + m :] for row in rows[m:]])
    inverse = matrix(surface.alpha_a.tolist()).inv()
    alpha_u, lambda_a, lambda_u = (
        matrix(b.tolist()) for b in (surface.alpha_u, surface.lambda_a, surface.lambda_u)
    )
    # G = −α_a⁻¹ [λ_a, λ_u, α_u] in its three blocks, then E q̈_u = … column block by block.
    G = [-(inverse * block) for block in (lambda_a, lambda_u, alpha_u)]
    E_inverse = (M_uu - M_ua * inverse * alpha_u).inv()
    pull = M_ua * inverse
    through = [D_ua * g + pull * lambda_a * g for g in G]
    F_ua = matrix([F_u.tolist()[i][:m] for i in range(free)])
    F_uu = matrix([F_u.tolist()[i][m:] for i in range(free)])
    lower = [
        E_inverse * (F_ua + through[0]),
        E_inverse * (F_uu + through[1]),
        E_inverse * (D_uu + pull * lambda_u + through[2]),
    ]

    def join(blocks: list[Any]) -> list[list[Any]]:
        lists = [b.tolist() for b in blocks]
        return [list(itertools.chain(*parts)) for parts in zip(*lists, strict=True)]

    middle = [[0.0] * n + [1.0 if i == j else 0.0 for j in range(free)] for i in range(free)]
    return matrix([*join(G), *middle, *join(lower)]), exact


def _routh(coefficients: list[Any]) -> bool | None:
    """Whether a polynomial (highest power first) is Hurwitz; None where balls are too wide."""
    if coefficients[0] < 0:
        coefficients = [-c for c in coefficients]
    first, second = coefficients[::2], coefficients[1::2]
    column = [first[0]]
    while second:
        column.append(second[0])
        if not second[0] > 0:
            return False if second[0] <= 0 else None
        factor = first[0] / second[0]
        padded = second + [second[0] * 0] * (len(first) - len(second))
        third = [first[i + 1] - factor * padded[i + 1] for i in range(len(first) - 1)]
        first, second = second, third
    return True if column[0] > 0 else None


def _is_hurwitz(matrix: Any, shift: float, exact: bool) -> bool | None:
    module = flint()
    size = matrix.nrows()
    value = module.fmpq(*float(shift).as_integer_ratio())
    rows = matrix.tolist()
    for i in range(size):
        rows[i][i] = rows[i][i] + (value if exact else module.arb(value))
    polynomial = (module.fmpq_mat(rows) if exact else module.arb_mat(rows)).charpoly()
    return _routh([polynomial[i] for i in range(size, -1, -1)])


def _slowest_mode(mechanism: Mechanism, surface: Surface) -> tuple[complex, dict[str, float]]:
    """The eigenvalue with the largest real part, in float64, and its mode.

    The mode: state names of z = (q_a, q_u, q̇_u) to the magnitude of the eigenvector's entry.
    """
    eigenvalues, vectors = np.linalg.eig(sliding_matrix(mechanism, surface))
    worst = int(np.argmax(eigenvalues.real))
    names = (
        mechanism.state_names[: mechanism.n] + mechanism.state_names[mechanism.n + mechanism.m :]
    )
    shape = np.abs(vectors[:, worst]) / np.abs(vectors[:, worst]).max()
    return complex(eigenvalues[worst]), dict(zip(names, shape.tolist(), strict=True))


def hurwitz(mechanism: Mechanism, surface: Surface) -> Verdict:
    """Decide local exponential stability on the surface, exactly, for any n and m.

    Returns
    -------
    Verdict
        ``proved`` with a proved decay rate (every eigenvalue left of −margin, 1/s),
        ``refuted`` with the offending eigenvalue as witness, or ``undecided`` (where the
        target is not shown to be an equilibrium, or the model is not rational there and balls
        cannot tell).

    Raises
    ------
    InvalidInputError
        When the surface has another n or m than the mechanism.
    ModelError
        For a model that is not smooth.
    MissingExtraError
        Without python-flint.
    """
    check_surface_shape(mechanism, surface)
    claim = "motions on the surface near the target converge to it exponentially"
    if why := _no_equilibrium(mechanism):
        return Verdict(claim, "undecided", unit="1/s", method=why)
    with _precision():
        try:
            matrix, exact = _sliding_matrix_exact(mechanism, surface)
        except ZeroDivisionError:
            return Verdict(
                claim,
                "refuted",
                -math.inf,
                "1/s",
                method="det(M_uu − M_auᵀ α_a⁻¹ α_u) = 0 at the target: no sliding dynamics",
            )
        stable = _is_hurwitz(matrix, 0.0, exact)
        method = f"Routh array in {'exact rationals' if exact else f'{_BITS}-bit balls'}"
        eigenvalue, shape = _slowest_mode(exact_mechanism(mechanism), surface)
        estimate = -eigenvalue.real
        witness = {"Re eigenvalue": eigenvalue.real, "Im eigenvalue": eigenvalue.imag}
        details = {"critical mode": shape}
        if stable is None:
            return Verdict(claim, "undecided", estimate, "1/s", witness, method, details)
        if not stable:
            return Verdict(claim, "refuted", min(estimate, 0.0), "1/s", witness, method, details)
        margin = 0.0
        # Rounding moves an eigenvalue of multiplicity k by the k-th root of 1e-16.
        for slack in (1e-12, 1e-9, 1e-6, 1e-4, 1e-2, 0.1, 0.5):
            if estimate > 0 and _is_hurwitz(matrix, estimate * (1 - slack), exact):
                margin = estimate * (1 - slack)
                break
        return Verdict(claim, "proved", margin, "1/s", witness, method, details)


@dataclass(frozen=True)
class StabilityClaim(Claim):
    """Motions on the surface near the target converge to it exponentially."""

    kind: ClassVar[str] = "stability"

    def decide(
        self, mechanism: Mechanism, surface: Surface, law: ReachingLaw, *, seconds: float = 600.0
    ) -> Verdict:
        """Decide it as :func:`hurwitz` does."""
        return hurwitz(mechanism, surface)
