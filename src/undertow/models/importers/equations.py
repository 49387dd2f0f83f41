"""Mechanisms from equations of motion: from M, f and B, or from energies, in any coordinates.

:class:`~undertow.models.Mechanism` itself takes M, f and B with the actuated coordinates
first and the target at x = 0.  The functions here take the equations as they come: inputs
through a constant (n, m) matrix, coordinates in any order, a target that is not zero.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import sympy as sp

from undertow.base import InvalidInputError, ModelError, checked, one_of
from undertow.models.importers.coordinates import actuate, exact_angle, tidy
from undertow.models.lagrange import quadratic_form
from undertow.models.linearisation import AT_REST, force_scale
from undertow.models.mechanism import (
    TIME,
    Coordinate,
    FloatArray,
    Input,
    Mechanism,
    Parameter,
    energies,
    matrix_of,
)
from undertow.models.quantities import in_degrees, number_of
from undertow.models.validity import by_names, check_parts, check_symbols, expression_of, vocabulary
from undertow.symbolic import Tape, compile_numpy

#: How far an equilibrium may be from a target and still be the one that was meant, rad or m.
NEAR = 0.5


@checked
def from_matrices(
    name: str,
    coordinates: Sequence[Coordinate],
    inputs: Sequence[Input],
    mass_matrix: sp.Matrix,
    force: sp.Matrix,
    input_matrix: sp.Matrix,
    *,
    parameters: Sequence[Parameter] = (),
    potential: sp.Expr | None = None,
    equilibrium: Mapping[str, float] | None = None,
    actuated: Sequence[Coordinate | None] | None = None,
    gains: Sequence[sp.Expr | None] | None = None,
    disturbance_bounds: Sequence[float] = (),
    start: Mapping[str, float] | None = None,
    description: str = "",
    source: str = "",
) -> Mechanism:
    """Build a mechanism from ``M(q) q̈ = f(q, q̇) + B u`` with a constant (n, m) matrix B.

    Parameters
    ----------
    name, inputs, parameters, description, source
        As for :class:`~undertow.models.Mechanism`.
    coordinates
        The n coordinates q, in any order.
    mass_matrix, force
        M(q), (n, n), and f(q, q̇), (n,), without the inputs.
    input_matrix
        B, (n, m), constant (parameters are allowed), of rank m.
    potential
        V(q), J, where there is one.
    equilibrium
        The target, coordinate name to value in rad or m; zero where left out.  The
        coordinates of the result are errors from it.
    actuated, gains
        Names of the coordinates that the inputs act on, where these are combinations of the
        given ones, and their scales; see :func:`~undertow.models.importers.actuate`.
    disturbance_bounds
        |g_i| ≤ bound in the given coordinates, (n,).
    start
        A usual initial state by the names of the result's states (errors from the target).

    Returns
    -------
    Mechanism
        In coordinates of which the first m are acted upon; the target is x = 0.

    Raises
    ------
    ModelError
        When M is not symmetric positive definite, B depends on the state or lacks rank, or
        ``equilibrium`` is none.
    InvalidInputError
        For an equilibrium of unknown coordinates.
    """
    check_parts(name, coordinates, inputs, parameters)
    coordinates = tuple(coordinates)
    values = {p.symbol: p.value for p in parameters}
    data = vocabulary(parameters=parameters, time=False)
    places = vocabulary(coordinates, velocities=False, time=False) | data
    for what, matrix, known in (
        ("mass_matrix", mass_matrix, places | {TIME: "undertow.models.mechanism.TIME"}),
        ("force", force, vocabulary(coordinates, parameters=parameters)),
        ("input_matrix", input_matrix, vocabulary(coordinates, parameters=parameters, time=False)),
    ):
        check_symbols(f"{what} of '{name}'", matrix_of(f"{what} of '{name}'", matrix), known)
    if potential is not None:
        potential = expression_of(f"potential of '{name}'", potential)
        check_symbols(f"potential of '{name}'", [potential], places)
    M = _symmetric(name, sp.Matrix(mass_matrix), coordinates, values)
    f = sp.Matrix(force)
    if f.shape != (n := len(coordinates), 1):
        raise ModelError(f"force of '{name}'", value=f"shape {f.shape}", limit=f"({n}, 1)")
    if equilibrium:
        coordinates, (M, f, potential) = shifted(name, coordinates, equilibrium, M, f, potential)
    form = actuate(
        coordinates,
        M,
        f,
        input_matrix,
        potential=potential,
        values=values,
        actuated=actuated,
        gains=gains,
    )
    bounds = form.bounds(disturbance_bounds, values) if len(disturbance_bounds) else ()
    mechanism = Mechanism(
        name,
        form.coordinates,
        tuple(inputs),
        form.mass_matrix,
        form.force,
        form.input_matrix,
        parameters=tuple(parameters),
        disturbance_bounds=tuple(bounds),
        potential=form.potential,
        start=dict(start or {}),
        description=description,
        source=source,
    )
    if equilibrium:
        check_balanced(mechanism, equilibrium)
    return mechanism


def check_balanced(mechanism: Mechanism, given: Mapping[str, float]) -> None:
    """Refuse a target that is no equilibrium: f_u(0, 0) ≠ 0, which no input can balance.

    ``given``: the position that was given for it, rad or m; an angle of many turns was meant in
    degrees. Raises ModelError with the largest force and the coordinate that it acts on.
    """
    n, m = mechanism.n, mechanism.m
    residual = np.abs(mechanism.f(np.zeros(2 * n))[m:])
    limit = AT_REST * force_scale(mechanism)
    if not residual.max() <= limit:
        worst = mechanism.coordinates[m + int(np.argmax(residual))].name
        q = np.array([given.get(c.name, 0.0) for c in mechanism.coordinates])
        turned = in_degrees(mechanism.coordinates, m, q)
        raise ModelError(
            f"target of '{mechanism.name}'",
            value=f"a force of {residual.max():.4g} on '{worst}', which no input balances",
            limit=f"an equilibrium, |f_u| ≤ {limit:.2g}",
            remedy=turned or nearest_equilibrium(mechanism, "add this to what was given"),
        )


def nearest_equilibrium(mechanism: Mechanism, then: str = "") -> str:
    """Return a remedy for a target that is no equilibrium: the one that is found near it.

    Values are errors from the target, in the mechanism's own coordinates.  ``then`` is what to do
    about it; by default to move the target of this mechanism.
    """
    q, left = _newton(mechanism)
    if not (left <= AT_REST and np.abs(q).max() <= NEAR):
        return (
            f"No equilibrium was found within {NEAR} rad or m: give a guess to "
            "undertow.modelling.find_equilibrium(mechanism, ...)"
        )
    free = zip(mechanism.coordinates, q, strict=True)
    named = ", ".join(f"{c.name}={float(v)!r}" for c, v in list(free)[mechanism.m :])
    then = then or f"take undertow.modelling.move_target(mechanism, {named})"
    return f"The nearest equilibrium that was found is off by {named}: {then}"


def _newton(mechanism: Mechanism) -> tuple[FloatArray, float]:
    """Solve f_u(q, 0) = 0 for the free coordinates, from the target on, by Newton's method.

    Without SciPy's solvers: the verifier of proofs checks targets too, and imports no solver.
    Returns positions, (n,), and the |f_u| that is left, relative to :func:`force_scale`.
    """
    n, m, scale = mechanism.n, mechanism.m, force_scale(mechanism)
    x, steps = np.zeros(2 * n), 1e-6 * np.eye(2 * n)[m:n]
    try:
        for _ in range(30):
            slope = (mechanism.f(x + steps) - mechanism.f(x - steps))[:, m:].T / 2e-6
            x[m:n] -= np.linalg.solve(slope, mechanism.f(x)[m:])
        return x[:n], float(np.abs(mechanism.f(x)[m:] / scale).max())
    except (InvalidInputError, np.linalg.LinAlgError):  # the iteration left the domain of f
        return x[:n], math.inf


@checked
def from_energies(
    name: str,
    coordinates: Sequence[Coordinate],
    inputs: Sequence[Input],
    kinetic: sp.Expr,
    potential: sp.Expr,
    input_matrix: sp.Matrix,
    *,
    dissipation: sp.Expr | float = 0,
    **rest: Any,
) -> Mechanism:
    """Build a mechanism from energies, with inputs through a constant (n, m) matrix.

    :meth:`Mechanism.from_energies <undertow.models.mechanism.Mechanism.from_energies>` is the
    shorter way where the actuated coordinates come first and the target is zero.

    Parameters
    ----------
    name, coordinates, inputs, input_matrix, **rest
        As for :func:`from_matrices`.
    kinetic
        T(q, q̇), J, a quadratic form in the velocities.
    potential
        V(q), J.
    dissipation
        Rayleigh's function D(q, q̇), W; its force is −∂D/∂q̇.

    Raises
    ------
    ModelError
        When T is not a quadratic form in the velocities; for symbols that are not of this
        mechanism, and kinks, whose derivatives are not what SymPy says; or as for
        :func:`from_matrices`.
    """
    kinetic, potential, dissipation = energies(
        name, coordinates, inputs, rest.get("parameters", ()), kinetic, potential, dissipation
    )
    velocities = [c.velocity for c in coordinates]
    mass = quadratic_form(name, sp.expand(kinetic), velocities, tidy)
    force = lagrange_force(coordinates, mass, potential, dissipation)
    return from_matrices(
        name, coordinates, inputs, mass, force, input_matrix, potential=potential, **rest
    )


def lagrange_force(
    coordinates: Sequence[Coordinate],
    mass: sp.Matrix,
    potential: sp.Expr,
    dissipation: sp.Expr | float = 0,
) -> sp.Matrix:
    """Return f(q, q̇) = −(Ṁ q̇ − ½ ∂(q̇ᵀM q̇)/∂q) − ∂V/∂q − ∂D/∂q̇, (n, 1)."""
    q = sp.Matrix([c.symbol for c in coordinates])
    qd = sp.Matrix([c.velocity for c in coordinates])
    n = len(q)
    slopes = [[[sp.diff(mass[i, j], q[k]) for k in range(n)] for j in range(n)] for i in range(n)]
    V, D = sp.sympify(potential), sp.sympify(dissipation)
    force = []
    for i in range(n):
        inertial = sum(
            (slopes[i][j][k] - slopes[j][k][i] / 2) * qd[j] * qd[k]
            for j in range(n)
            for k in range(n)
        )
        force.append(tidy(-inertial - sp.diff(V, q[i]) - sp.diff(D, qd[i])))
    return sp.Matrix(force)


def unit_inputs(coordinates: Sequence[Coordinate], actuated: Sequence[str]) -> sp.Matrix:
    """Return the (n, m) input matrix of inputs that act on single coordinates, by name.

    Raises InvalidInputError for a name that does not exist, or one that occurs twice.
    """
    names = [c.name for c in coordinates]
    for joint in actuated:
        one_of("actuated coordinate", joint, names, "Check the spelling, and that the joint moves")
        if list(actuated).count(joint) > 1:
            raise InvalidInputError(
                "actuated coordinate",
                value=f"{joint!r} named twice",
                limit="once each",
                remedy="Name every actuated joint once",
            )
    B = sp.zeros(len(names), len(actuated))
    for j, joint in enumerate(actuated):
        B[names.index(joint), j] = 1
    return B


def shifted(
    name: str,
    coordinates: tuple[Coordinate, ...],
    equilibrium: Mapping[str, float],
    *expressions: Any,
) -> tuple[tuple[Coordinate, ...], list[Any]]:
    """Replace q by q* + e; the errors e keep the coordinates' names."""
    known = {c.name: c for c in coordinates}
    equilibrium = by_names(f"equilibrium of '{name}'", equilibrium)
    for joint, value in equilibrium.items():
        one_of(f"equilibrium of '{name}'", joint, known, "Name the coordinates as the equations do")
        if not np.isfinite(number_of(f"equilibrium of '{name}', {joint}", value)):
            raise InvalidInputError(
                f"equilibrium of '{name}', {joint}", value=value, limit="a finite number"
            )
    shift = {
        c.symbol: c.symbol + (exact_angle(v) if c.unit == "rad" else sp.Float(v))
        for c in coordinates
        if (v := float(equilibrium.get(c.name, 0.0)))
    }
    offsets = [equilibrium.get(c.name, 0.0) for c in coordinates]
    moved = tuple(
        replace(c, low=c.low - offset, high=c.high - offset)
        for c, offset in zip(coordinates, offsets, strict=True)
    )

    def there(expression: Any) -> Any:
        if isinstance(expression, sp.MatrixBase):
            return expression.xreplace(shift).applyfunc(tidy)
        return None if expression is None else tidy(expression.xreplace(shift))

    return moved, [there(expression) for expression in expressions]


def _symmetric(
    name: str, mass: sp.Matrix, coordinates: Sequence[Coordinate], values: Mapping[sp.Symbol, float]
) -> sp.Matrix:
    """Return the upper half mirrored, after a numeric look at M − Mᵀ where it is not plain."""
    n = len(coordinates)
    if mass.shape != (n, n):
        raise ModelError(f"mass_matrix of '{name}'", value=mass.shape, limit=f"shape {(n, n)}")
    symbols = [c.symbol for c in coordinates]
    unknown = mass.free_symbols - {*symbols, *values}
    if mass != mass.T and not unknown:
        tape = Tape()
        gap = compile_numpy(tape, [*symbols, *values], tape.let_all([*(mass - mass.T), *mass]))
        q = np.random.default_rng(0).uniform(-1, 1, (n, 16))
        entries = [np.broadcast_to(e, 16) for e in gap(*q, *values.values())]
        worst = float(np.abs(entries[: n * n]).max())
        if worst > 1e-10 * float(np.abs(entries[n * n :]).max()):
            raise ModelError(
                f"mass_matrix of '{name}'",
                value=f"|M − Mᵀ| up to {worst:.3g}",
                limit="symmetric",
                remedy="Multiply the equations so that they are Lagrange's, row by row",
            )
    if TIME in mass.free_symbols:
        raise ModelError(f"mass_matrix of '{name}'", value="a function of time", limit="of q only")
    return sp.Matrix(n, n, lambda i, j: mass[min(i, j), max(i, j)])
