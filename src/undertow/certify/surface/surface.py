"""Surface certificates for any n and m: stability on the surface, and non-singularity.

*Stability.*  The matrix of the sliding dynamics (see :mod:`undertow.law.stability`) is formed
in exact rational arithmetic (every float parameter is the binary number that it is) and
the Routh array of its characteristic polynomial decides.  Shifting the matrix by σ proves
the margin.  Where the model is not rational at the target, balls take the place.

*Non-singularity.*  α_a − α_u M_uu⁻¹ M_auᵀ must be invertible all over a region of
positions; its determinant, relative to the target, is bounded from below by branch and
bound in ball arithmetic.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import sympy as sp

from undertow.base.errors import InvalidInputError
from undertow.base.verdict import Verdict, inward, within
from undertow.certify.intervals.branch import BallFunction, Minimum, minimise_proved
from undertow.certify.intervals.exact_model import exact_mechanism, vanishes
from undertow.certify.intervals.interval import ball, compile_outward, flint
from undertow.law.sliding import Surface, check_surface_shape
from undertow.law.stability import sliding_matrix
from undertow.models.mechanism import TIME, Mechanism
from undertow.symbolic import Tape

__all__ = [
    "CriticalMode",
    "Region",
    "closed_forms",
    "critical_mode",
    "exact_linearisation",
    "hurwitz",
    "nonsingular",
    "region_box",
    "region_words",
    "singular_distance",
]

#: Coordinate name to (low, high), SI units; coordinates left out stay at the target.
Region = Mapping[str, tuple[float, float]]

_BITS = 300


def _precision(bits: int = _BITS) -> AbstractContextManager[None]:
    return cast(AbstractContextManager[None], flint().ctx.workprec(bits))


# -- stability on the surface ----------------------------------------------------------------


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
    return {p.symbol: sp.Rational(*p.value.as_integer_ratio()) for p in mechanism.parameters}


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


@dataclass(frozen=True)
class CriticalMode:
    """The slowest mode on the surface, in float64.

    Parameters
    ----------
    eigenvalue
        1/s and rad/s.
    shape
        State names of z = (q_a, q_u, q̇_u) to the magnitude of the eigenvector's entry.
    """

    eigenvalue: complex
    shape: Mapping[str, float]


def critical_mode(mechanism: Mechanism, surface: Surface) -> CriticalMode:
    """Return the mode with the largest real part, which sets the margin."""
    eigenvalues, vectors = np.linalg.eig(sliding_matrix(mechanism, surface))
    worst = int(np.argmax(eigenvalues.real))
    names = (
        mechanism.state_names[: mechanism.n] + mechanism.state_names[mechanism.n + mechanism.m :]
    )
    shape = np.abs(vectors[:, worst]) / np.abs(vectors[:, worst]).max()
    return CriticalMode(complex(eigenvalues[worst]), dict(zip(names, shape.tolist(), strict=True)))


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
        mode = critical_mode(exact_mechanism(mechanism), surface)
        estimate = -mode.eigenvalue.real
        witness = {"Re eigenvalue": mode.eigenvalue.real, "Im eigenvalue": mode.eigenvalue.imag}
        details = {"critical mode": mode.shape}
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


def closed_forms(mechanism: Mechanism, surface: Surface) -> tuple[Verdict, ...]:
    """Return the four closed-form conditions for (n, m) = (2, 1), exactly.

    The characteristic polynomial a₃s³ + a₂s² + a₁s + a₀ of the sliding dynamics has

        a₃ = α_a M_uu − α_u M_au,                a₂ = λ_a M_uu − λ_u M_au − α_a D_u + α_u D_a,
        a₁ = −α_a F_u + α_u F_a − λ_a D_u + λ_u D_a,        a₀ = −λ_a F_u + λ_u F_a

    and is Hurwitz iff a₂/a₃ > 0, a₀/a₃ > 0 and a₂a₁ > a₃a₀ (in units of a₃).  For a pendulum
    with a cyclic, undamped actuated coordinate these are (35)-(37) at φ = 0.

    Raises
    ------
    InvalidInputError
        For another n or m.
    """
    check_surface_shape(mechanism, surface)
    if (mechanism.n, mechanism.m) != (2, 1):
        raise InvalidInputError(
            "closed-form stability conditions",
            value=f"n = {mechanism.n}, m = {mechanism.m}",
            limit="n = 2, m = 1",
            remedy="Use certify.hurwitz, which decides for any n and m",
        )
    with _precision():
        rows, exact = exact_linearisation(mechanism)
        M_a, M_u, F_a, F_u, D_a, D_u = rows[1]
        module = flint()
        alpha_a, lambda_a, alpha_u, lambda_u = (
            module.fmpq(*float(v).as_integer_ratio()) for v in surface.vector
        )
        a3 = alpha_a * M_u - alpha_u * M_a
        a2 = lambda_a * M_u - lambda_u * M_a - alpha_a * D_u + alpha_u * D_a
        a1 = -alpha_a * F_u + alpha_u * F_a - lambda_a * D_u + lambda_u * D_a
        a0 = -lambda_a * F_u + lambda_u * F_a
        method = "closed form, " + ("exact rationals" if exact else "balls")
        side = 1 if a3 > 0 else -1
        conditions = [("a₃ ≠ 0: the law exists at the target, (37)", a3 * side, "")]
        if a3 * side > 0:
            conditions += [
                ("a₂/a₃ > 0", a2 / a3, "1/s"),
                ("a₀/a₃ > 0", a0 / a3, "1/s³"),
                ("(a₂a₁ − a₃a₀)/a₃² > 0", (a2 * a1 - a3 * a0) / (a3 * a3), "1/s³"),
            ]
        verdicts = []
        for claim, value, unit in conditions:
            exact_value = module.arb(value)
            kind = "proved" if value > 0 else "refuted" if value <= 0 else "undecided"
            verdicts.append(
                Verdict(claim, kind, float(exact_value.mid()), unit, method=method)  # type: ignore[arg-type]
            )
    return tuple(verdicts)


# -- non-singularity over a region -----------------------------------------------------------


def region_box(mechanism: Mechanism, region: Region) -> list[tuple[float, float]]:
    """Return the box of positions, one (low, high) per coordinate.

    Raises
    ------
    InvalidInputError
        For an unknown coordinate or an interval that is empty, not finite or leaves out
        the target, from which the non-singular set must be connected.
    """
    names = [c.name for c in mechanism.coordinates]
    box = [(0.0, 0.0)] * mechanism.n
    for name, (low, high) in region.items():
        if name not in names:
            raise InvalidInputError(
                "region of positions", value=repr(name), limit=f"one of {', '.join(names)}"
            )
        if not (math.isfinite(low) and math.isfinite(high) and low <= 0 <= high):
            raise InvalidInputError(
                f"region of '{name}'",
                value=(low, high),
                limit="finite, with low ≤ 0 ≤ high: the target must be inside",
            )
        box[names.index(name)] = (float(low), float(high))
    return box


def region_words(mechanism: Mechanism, region: Region) -> str:
    """Return a region of positions in words, its ends rounded inwards."""
    units = {c.name: c.unit for c in mechanism.coordinates}
    parts = [
        f"|{k}| ≤ {inward(b, 6)} {units[k]}" if a == -b else f"{k} in {within(a, b)} {units[k]}"
        for k, (a, b) in region.items()
        if (a, b) != (0.0, 0.0)
    ]
    if not parts:
        return "at the target"
    rest = len(parts) < mechanism.n
    return f"for {', '.join(parts)}" + (", the other coordinates at the target" if rest else "")


def _gamma(mechanism: Mechanism, surface: Surface) -> tuple[BallFunction, BallFunction]:
    """Return det Γ(q)/det Γ(0) and a lower bound of Γ's smallest singular value."""
    tape = Tape()
    mechanism = exact_mechanism(mechanism)
    part = mechanism.partition(tape)
    exact = {
        name: sp.Matrix(*b.shape, [sp.Rational(*float(v).as_integer_ratio()) for v in b.ravel()])
        for name, b in (("a", surface.alpha_a), ("u", surface.alpha_u))
    }
    gamma = tape.matrix(exact["a"] - exact["u"] * part.X)
    _, determinant = tape.adjugate(gamma)
    frobenius = tape.let(sum(entry**2 for entry in gamma))
    run = compile_outward(
        tape, [*mechanism.q, *mechanism.parameter_symbols], [determinant, frobenius]
    )
    parameters = [ball(v) for v in mechanism.parameter_values]
    target = run(*[ball(0.0)] * mechanism.n, *parameters)[0]
    m = mechanism.m

    def ratio(q: list[Any]) -> Any:
        return run(*q, *parameters)[0] / target

    def distance(q: list[Any]) -> Any:
        # |det| = Π σ_i and the AM-GM inequality on the m − 1 larger ones.
        value, square = run(*q, *parameters)
        size = abs(value)
        return size if m == 1 else size / ((square / (m - 1)).sqrt() ** (m - 1))

    return ratio, distance


def nonsingular(
    mechanism: Mechanism, surface: Surface, region: Region, *, max_boxes: int = 20_000
) -> Verdict:
    """Decide whether the law exists all over a region, the general form of (37).

    Parameters
    ----------
    region
        Coordinate name to (low, high), SI units, the target inside; coordinates left out
        stay at the target.
    max_boxes
        Effort before giving up.

    Returns
    -------
    Verdict
        ``margin`` is a proved lower bound of det Γ(q)/det Γ(0) over the region, with
        Γ = α_a − α_u M_uu⁻¹ M_auᵀ; ``refuted``: the ratio is ≤ 0 at the witness, so Γ is
        singular on the way there.  ``details["smallest singular value"]`` bounds the
        2-norm distance of Γ from the singular matrices, all over the region.
    """
    check_surface_shape(mechanism, surface)
    box = region_box(mechanism, region)
    names = [c.name for c in mechanism.coordinates]
    words = region_words(mechanism, region)
    claim = f"the law exists {words}: α_a − α_u M_uu⁻¹ M_auᵀ is non-singular"
    method = "ball arithmetic, branch and bound"
    ratio, distance = _gamma(mechanism, surface)
    found = minimise_proved(ratio, box, stop_below=0.0, max_boxes=max_boxes)
    witness = dict(zip(names, found.point, strict=True))
    details: dict[str, Any] = {"boxes": found.boxes}
    if found.lower > 0:
        near = minimise_proved(distance, box, max_boxes=max_boxes)
        details["smallest singular value"] = max(near.lower, 0.0)
        return Verdict(claim, "proved", found.lower, "", witness, method, details)
    if found.value <= 0:
        return Verdict(claim, "refuted", found.value, "", witness, method, details)
    stuck = _stuck(names, found)
    return Verdict(claim, "undecided", found.value, "", stuck, method + ", gave up", details)


def _stuck(names: list[str], found: Minimum) -> dict[str, float]:
    return {k: 0.5 * (a + b) for k, (a, b) in zip(names, found.stuck, strict=True)}


def singular_distance(
    mechanism: Mechanism,
    surface: Surface,
    region: Region,
    *,
    limit: float = 1e3,
    tolerance: float = 1e-6,
    max_boxes: int = 20_000,
) -> tuple[float, float]:
    """Return by what factor a region may grow: proved non-singular, and refuted.

    Parameters
    ----------
    limit
        Largest factor tried.  Angles beyond ±π add nothing new, so it is also cut there.
    tolerance
        Relative gap between the two factors.

    Returns
    -------
    proved, refuted : float
        The region scaled by ``proved`` is non-singular; scaled by ``refuted`` it is not
        (``inf`` where no singularity is within the limit).
    """
    box = region_box(mechanism, region)
    for c, (a, b) in zip(mechanism.coordinates, box, strict=True):
        if c.unit == "rad" and max(-a, b) > 0:
            limit = min(limit, math.pi / min(v for v in (-a, b) if v > 0))
    ratio, _ = _gamma(mechanism, surface)

    def holds(factor: float) -> bool | None:
        scaled = [(a * factor, b * factor) for a, b in box]
        found = minimise_proved(
            ratio, scaled, stop_below=0.0, stop_above=0.0, absolute=0.0, max_boxes=max_boxes
        )
        return True if found.lower > 0 else False if found.value <= 0 else None

    low, high = 0.0, limit
    if holds(limit):
        return limit, math.inf
    refuted = math.inf
    while high - low > tolerance * high:
        middle = 0.5 * (low + high)
        answer = holds(middle)
        low, high = (middle, high) if answer else (low, middle)
        if answer is False:
            refuted = middle
    return low, refuted
