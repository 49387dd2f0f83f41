"""Lagrange's equations of a mechanism's energies, derived once and kept on disk.

f = −(Ṁ q̇ − ∂T/∂q) − ∂V/∂q − ∂D/∂q̇,     M = ∂²T/∂q̇²
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence

import sympy as sp

from undertow.base import ModelError
from undertow.symbolic import content_key, parse_expression, recall, remember


def derived(
    name: str,
    q: Sequence[sp.Symbol],
    qd: Sequence[sp.Symbol],
    kinetic: sp.Expr,
    potential: sp.Expr,
    dissipation: sp.Expr,
) -> tuple[sp.ImmutableDenseMatrix, sp.ImmutableDenseMatrix]:
    """Return M(q), (n, n), and f(q, q̇), (n, 1), of energies.

    They are taken from the disk where they were derived before:
    the key there holds the energies with the assumptions of their symbols, the order of the
    coordinates, the versions of Python and SymPy and this file's own text: a change of any of
    them derives afresh.

    T and V are in J, Rayleigh's function D(q, q̇) in W; ``name`` is for messages. Raises ModelError
    when T is not a quadratic form in the velocities.
    """
    key = content_key(*map(sp.srepr, (kinetic, potential, dissipation, [*q, *qd])))
    stored = recall("equations", key)
    if stored is not None:
        # Whatever is wrong with the file, the equations can be derived again.
        with contextlib.suppress(Exception):
            mass, force = (parse_expression(line) for line in stored.splitlines())
            return mass, force
    rows, speeds = sp.Matrix(q), sp.Matrix(qd)
    mass = quadratic_form(name, kinetic, qd, _tidy)
    coriolis = (mass * speeds).jacobian(rows) * speeds - sp.Matrix([kinetic]).jacobian(rows).T
    conservative = sp.Matrix([potential]).jacobian(rows).T
    damping = sp.Matrix([dissipation]).jacobian(speeds).T
    # Expanded again, for terms that cancel only between single angles.
    force = (-coriolis - conservative - damping).applyfunc(_tidy).applyfunc(sp.expand)
    mass, force = sp.ImmutableDenseMatrix(mass), sp.ImmutableDenseMatrix(force)
    remember("equations", key, f"{sp.srepr(mass)}\n{sp.srepr(force)}")
    return mass, force


def quadratic_form(
    name: str, kinetic: sp.Expr, qd: Sequence[sp.Symbol], tidy: Callable[[sp.Expr], sp.Expr]
) -> sp.Matrix:
    """Return M = ∂²T/∂q̇², (n, n), of tidy entries, where T is ½ q̇ᵀ M(q) q̇.

    Raises ModelError when T is not a quadratic form in the velocities.
    """
    mass = sp.hessian(kinetic, list(qd)).applyfunc(tidy)
    at_rest = dict.fromkeys(qd, 0)
    slope = sp.Matrix([kinetic]).jacobian(list(qd)).subs(at_rest)
    if (
        mass.free_symbols & set(qd)
        or sp.simplify(slope) != sp.zeros(1, len(qd))
        or sp.simplify(kinetic.subs(at_rest)) != 0
    ):
        raise ModelError(
            f"kinetic energy of '{name}'",
            value=str(kinetic)[:80],
            limit="a quadratic form in the velocities",
            remedy="Move velocity-free terms to the potential; gyroscopic terms to force",
        )
    return mass


def _tidy(expression: sp.Expr) -> sp.Expr:
    """Write trigonometry in the sines and cosines of single angles, expanded."""
    return sp.expand_trig(sp.expand(expression))
