"""A mechanism seen from a reference that moves, and where it may rest besides x = 0.

With q = q̃ + q_r(t) the equations M(q) q̈ = f(q, q̇) + B u become, exactly,

    M(q̃ + q_r) q̃̈  =  f(q̃ + q_r, q̃̇ + q̇_r) − M(q̃ + q_r) q̈_r + B u,

again a mechanism, with q_r, q̇_r and q̈_r among its parameters.  Along a coordinate on which neither
M nor f depends its q_r drops out: what is at rest there is at rest wherever it stands, and is
steered there as it is steered to 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np
import sympy as sp

from undertow.models.mechanism import Mechanism
from undertow.models.quantities import FloatArray, Parameter


def invariant_coordinates(mechanism: Mechanism) -> tuple[str, ...]:
    """Return the names of the coordinates on which neither M nor f depends.

    Their derivatives are taken symbolically, and are zero for all values of the parameters.  Where
    there is a potential its slopes do not depend on them either: it may rise along a cart's track.

    Examples
    --------
    >>> import undertow as ut
    >>> invariant_coordinates(ut.mechanisms.rotary_pendulum())
    ('theta',)
    >>> invariant_coordinates(ut.mechanisms.gantry_crane())
    ('x', 'y')
    >>> invariant_coordinates(ut.mechanisms.pendubot())
    ()
    """
    equations = mechanism.mass_matrix, mechanism.force, mechanism.potential
    free = _drops_out(*equations, mechanism.q)
    return tuple(c.name for c, drops in zip(mechanism.coordinates, free, strict=True) if drops)


@lru_cache(maxsize=64)
def _drops_out(
    mass: sp.ImmutableDenseMatrix,
    force: sp.ImmutableDenseMatrix,
    potential: sp.Expr | None,
    q: tuple[sp.Symbol, ...],
) -> tuple[bool, ...]:
    """For each coordinate whether it drops out of equations, which many mechanisms share."""
    slopes = [] if potential is None else [sp.diff(potential, symbol) for symbol in q]
    entries = [*mass, *force, *slopes]
    return tuple(all(_independent(entry, symbol) for entry in entries) for symbol in q)


def _independent(entry: sp.Expr, symbol: sp.Symbol) -> bool:
    if symbol not in entry.free_symbols:
        return True
    slope = sp.diff(entry, symbol)
    names = sorted(slope.free_symbols, key=str)
    somewhere = slope.xreplace({s: sp.Rational(11 + k, 19) for k, s in enumerate(names)}).evalf()
    if somewhere.is_Float and abs(somewhere) > 1e-9:  # digits enough, however much cancels
        return False
    return bool(sp.simplify(slope) == 0)


def with_positions(mechanism: Mechanism, names: Sequence[str]) -> Mechanism:
    """Return the mechanism with a parameter ``<name>_target`` for each of these coordinates.

    Its equations are those of the mechanism: they know nothing of where an invariant coordinate
    stands.  Constraints on absolute positions do, see :meth:`undertow.Objective.about`.
    """
    return replace(
        mechanism,
        parameters=(
            *mechanism.parameters,
            *(
                Parameter(f"{c.name}_target", 0.0, c.unit, f"target of {c.name}")
                for c in mechanism.coordinates
                if c.name in names
            ),
        ),
    )


def reference_names(mechanism: Mechanism) -> tuple[str, ...]:
    """Return the names of the parameters that :func:`error_dynamics` adds: q_r, q̇_r, q̈_r, (3n,)."""
    names = [c.name for c in mechanism.coordinates]
    return tuple(f"{name}_reference{dots}" for dots in ("", "_dot", "_ddot") for name in names)


#: What was derived, for every structure with its input limits.
_DERIVED: dict[object, Mechanism] = {}


def error_dynamics(mechanism: Mechanism, reference: FloatArray | None = None) -> Mechanism:
    """Return the mechanism of the error q̃ = q − q_r.

    ``reference`` holds q_r, q̇_r and q̈_r, (3n,): the last parameters of what is returned, named by
    :func:`reference_names`; zero by default.
    """
    key = mechanism.structure, mechanism.name, mechanism.input_limits.tobytes()
    if key not in _DERIVED:
        _DERIVED[key] = _derive(mechanism)
    still = np.zeros(3 * mechanism.n) if reference is None else reference
    return _DERIVED[key].with_values(np.append(mechanism.parameter_values, still))


def _derive(mechanism: Mechanism) -> Mechanism:
    n = mechanism.n
    units = [c.unit + rate for rate in ("", "/s", "/s²") for c in mechanism.coordinates]
    added = tuple(
        Parameter(name, 0.0, unit, "reference")
        for name, unit in zip(reference_names(mechanism), units, strict=True)
    )
    symbols = [p.symbol for p in added]
    moved = {s: s + r for s, r in zip(mechanism.x, symbols[: 2 * n], strict=True)}
    mass = sp.Matrix(mechanism.mass_matrix).xreplace(moved)
    force = sp.Matrix(mechanism.force).xreplace(moved) - mass * sp.Matrix(symbols[2 * n :])
    return replace(
        mechanism,
        mass_matrix=sp.ImmutableDenseMatrix(mass),
        force=sp.ImmutableDenseMatrix(force),
        parameters=(*mechanism.parameters, *added),
        potential=None,
        start={},
    )
