"""Mechanisms from SymPy's own mechanics: ``LagrangesMethod`` and ``KanesMethod`` objects.

Coordinates and inputs are ``dynamicsymbols`` there; they become the plain symbols of a
:class:`~undertow.models.Mechanism`, and the inputs are recognised as what the equations
are linear in.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import sympy as sp

from undertow.base import InvalidInputError, ModelError, a_kind, at_least, checked, one_of
from undertow.models.importers.coordinates import tidy
from undertow.models.importers.equations import from_matrices
from undertow.models.mechanism import Coordinate, Input, Mechanism, Parameter
from undertow.models.validity import (
    by_names,
    check_parts,
    expression_of,
    repeated_names,
    require_smooth,
)


@checked
def from_lagrange(
    name: str,
    method: Any,
    inputs: Mapping[Any, Input],
    *,
    parameters: Sequence[Parameter] = (),
    units: Mapping[str, str] | None = None,
    **rest: Any,
) -> Mechanism:
    """Build a mechanism from a ``sympy.physics.mechanics.LagrangesMethod``.

    Parameters
    ----------
    name
        Short identifier.
    method
        With its coordinates, forces and Lagrangian; ``form_lagranges_equations`` is called
        where it has not been.
    inputs
        The symbol (or dynamicsymbol) of each input in the forces, to its
        :class:`~undertow.models.mechanism.Input`, in the order wanted.
    parameters
        All other symbols of the equations, by name.
    units
        Coordinate name to ``"m"`` where it is not ``"rad"``.
    **rest
        ``equilibrium``, ``actuated``, ``start``, … of
        :func:`~undertow.models.importers.from_matrices`.

    Raises
    ------
    ModelError
        For constraints, inputs that do not enter linearly, or a direction of action that
        changes with the state.
    InvalidInputError
        For a symbol that is neither coordinate, input nor parameter.

    Examples
    --------
    >>> import sympy as sp
    >>> from sympy.physics.mechanics import LagrangesMethod, dynamicsymbols
    >>> x, p, F = dynamicsymbols("x phi F")
    >>> M, m, l, g = sp.symbols("m_c m_p l g")
    >>> L = (M + m) * x.diff() ** 2 / 2 + m * l * sp.cos(p) * x.diff() * p.diff()
    >>> L += m * l**2 * p.diff() ** 2 / 2 - m * g * l * sp.cos(p)
    >>> N = sp.physics.mechanics.ReferenceFrame("N")
    >>> P = sp.physics.mechanics.Point("P"); P.set_vel(N, x.diff() * N.x)
    >>> method = LagrangesMethod(L, [x, p], forcelist=[(P, F * N.x)], frame=N)
    >>> numbers = {"m_c": 1.0, "m_p": 0.1, "l": 0.5, "g": 9.81}
    >>> data = [Parameter(k, v, "") for k, v in numbers.items()]
    >>> rig = from_lagrange("cart", method, {F: Input("F", "N")}, parameters=data, units={"x": "m"})
    >>> rig.state_names
    ('x', 'phi', 'x_dot', 'phi_dot')
    """
    _require(name, method, "LagrangesMethod")
    if getattr(method, "coneqs", None):
        raise _constrained(name, "LagrangesMethod")
    if method.eom is None:
        method.form_lagranges_equations()
    q = list(method.q)
    resting = dict.fromkeys((c.diff(_time()) for c in q), 0)
    # The only place where SymPy keeps the Lagrangian, as a (1, 1) matrix.
    lagrangian = sp.Matrix([method._L])[0]
    _check_plain(name, [lagrangian, *method.forcing], q, inputs, parameters)
    states = {c.diff(_time()): sp.Dummy(f"{_plain(c)}_dot", real=True) for c in q}
    states |= {c: sp.Dummy(_plain(c), real=True) for c in q}
    require_smooth(f"Lagrangian of '{name}'", [lagrangian.subs(states)], states.values())
    potential = -lagrangian.subs(resting)
    return _build(
        name, q, method.mass_matrix, method.forcing, potential, inputs, parameters, units, rest
    )


@checked
def from_kane(
    name: str,
    method: Any,
    inputs: Mapping[Any, Input],
    *,
    parameters: Sequence[Parameter] = (),
    units: Mapping[str, str] | None = None,
    potential: sp.Expr | None = None,
    **rest: Any,
) -> Mechanism:
    """Build a mechanism from a ``sympy.physics.mechanics.KanesMethod``.

    Generalised speeds may be any invertible combination of the q̇, ``u = G(q) q̇``; the
    equations are brought back to ``Gᵀ M G q̈ = Gᵀ (f − M Ġ q̇)``.

    Parameters
    ----------
    method
        After ``kanes_equations``; without dependent coordinates or speeds.
    potential
        V(q), J, where it is known (Kane's method does not keep one).
    name, inputs, parameters, units, **rest
        As for :func:`from_lagrange`.

    Raises
    ------
    ModelError
        For dependent speeds (constraints), or as for :func:`from_lagrange`.
    """
    _require(name, method, "KanesMethod")
    if len(method.u) != len(method.q) or getattr(method, "_udep", None):
        raise _constrained(name, "KanesMethod")
    t = _time()
    q, u = list(method.q), list(method.u)
    rates = sp.Matrix([method.kindiffdict()[c.diff(t)] for c in q])
    Y = rates.jacobian(u)
    drift = (rates - Y * sp.Matrix(u)).applyfunc(sp.simplify)
    if drift != sp.zeros(len(q), 1):
        raise ModelError(
            f"kinematic equations of '{name}'",
            value=drift.T.tolist(),
            limit="linear in the speeds, q̇ = Y(q) u",
            remedy="Use coordinates in which nothing moves on its own",
        )
    G = Y.inv()
    if sp.eye(len(q)) != Y:
        G = G.applyfunc(sp.simplify)
    qd = sp.Matrix([c.diff(t) for c in q])
    speeds = dict(zip(u, G * qd, strict=True))
    mass, forcing = method.mass_matrix, method.forcing.subs(speeds)
    inertial = mass * G.diff(t) * qd
    _check_plain(name, [*mass, *forcing], q, inputs, parameters)
    return _build(
        name,
        q,
        G.T * mass * G,
        G.T * (forcing - inertial),
        potential,
        inputs,
        parameters,
        units,
        rest,
    )


def _check_plain(
    name: str,
    expressions: Sequence[sp.Expr],
    q: Sequence[Any],
    inputs: Mapping[Any, Input],
    parameters: Sequence[Parameter],
) -> None:
    """Refuse plain symbols that would meet others when dynamicsymbols become plain ones, too.

    SymPy's mechanics takes every plain symbol for a constant: ``coordinate.symbol`` in a
    Lagrangian has no derivative there, and would be the coordinate here.
    """
    coordinates = [Coordinate(_plain(c)) for c in q]
    check_parts(name, coordinates, list(inputs.values()), parameters)
    own = {s for c in coordinates for s in (c.symbol, c.velocity)}
    own |= {given.symbol for given in inputs.values()}
    free = set().union(*(expression.free_symbols for expression in expressions))
    mixed = ", ".join(sorted(str(s) for s in free & own - set(inputs)))
    alike = repeated_names(sorted({s.name for s in free}))
    if mixed or alike:
        raise ModelError(
            f"symbols of '{name}'",
            value=f"{mixed} as plain symbols" if mixed else alike,
            limit="dynamicsymbols for what moves, and a name of its own for each constant",
            remedy="SymPy's mechanics takes plain symbols for constants: use the dynamicsymbol"
            if mixed
            else "Rename one of them",
        )


def _build(
    name: str,
    q: Sequence[Any],
    mass: sp.Matrix,
    forcing: sp.Matrix,
    potential: sp.Expr | None,
    inputs: Mapping[Any, Input],
    parameters: Sequence[Parameter],
    units: Mapping[str, str] | None,
    rest: Mapping[str, Any],
) -> Mechanism:
    """Translate symbols, take the inputs out of the forcing, and build."""
    at_least(f"number of inputs of '{name}'", len(inputs), 1, "Name what acts on it")
    t = _time()
    units = by_names(f"units of '{name}'", units or {})
    coordinates = [Coordinate(_plain(c)) for c in q]
    names = [c.name for c in coordinates]
    for coordinate in units:
        one_of(f"units of '{name}'", coordinate, names)
    coordinates = [replace(c, unit=units.get(c.name, "rad")) for c in coordinates]
    translate: dict[Any, Any] = {}
    for symbol, c in zip(q, coordinates, strict=True):
        translate |= {symbol.diff(t): c.velocity, symbol: c.symbol}
    translate |= {symbol: given.symbol for symbol, given in inputs.items()}
    by_name = {n: p.symbol for p in parameters for n in (p.name, p.spelling)}

    def plain(expression: Any) -> sp.Expr:
        moved = expression_of(f"an expression of '{name}'", expression).subs(translate)
        free = {s for s in moved.free_symbols if s.name in by_name}
        return moved.xreplace({s: by_name[s.name] for s in free})

    pushes = [given.symbol for given in inputs.values()]
    force = forcing.applyfunc(plain)
    B = force.jacobian(pushes).applyfunc(lambda e: sp.trigsimp(tidy(e)))
    if B.free_symbols & set(pushes):
        raise ModelError(
            f"inputs of '{name}'",
            value="forces that are not linear in them",
            limit="M q̈ = f + B u",
            remedy="Redefine the input, for example the force of an actuator, not its command",
        )
    passive = force.subs(dict.fromkeys(pushes, 0)).applyfunc(tidy)
    M = mass.applyfunc(plain).applyfunc(tidy)
    known = {*by_name.values(), *(c.symbol for c in coordinates)}
    known |= {c.velocity for c in coordinates}
    stray = (M.free_symbols | passive.free_symbols | B.free_symbols) - known
    stray |= {f for e in (*M, *passive, *B) for f in e.atoms(sp.Function) if f.has(t)}
    if stray:
        raise InvalidInputError(
            f"symbols of '{name}'",
            value=", ".join(sorted(str(s) for s in stray)),
            limit="coordinates, inputs or parameters",
            remedy="Declare them in parameters= or inputs=",
        )
    return from_matrices(
        name,
        coordinates,
        list(inputs.values()),
        M,
        passive,
        B,
        parameters=parameters,
        potential=None if potential is None else plain(potential),
        **rest,
    )


def _time() -> sp.Symbol:
    """SymPy's symbol of time, by which its dynamicsymbols are functions."""
    from sympy.physics.mechanics import dynamicsymbols

    return dynamicsymbols._t


def _plain(symbol: Any) -> str:
    """Name of a dynamicsymbol without its (t)."""
    return str(symbol.func.__name__ if symbol.args else symbol.name)


def _constrained(name: str, method: str) -> ModelError:
    return ModelError(
        f"'{name}' from a {method}",
        value="constraints between its coordinates or speeds",
        limit="independent coordinates",
        remedy="Eliminate the constraints first; closed loops and rolling need minimal coordinates",
    )


def _require(name: str, method: object, kind: str) -> None:
    """Refuse what is no method of that kind."""
    from sympy.physics import mechanics  # slow to import

    if not isinstance(method, getattr(mechanics, kind)):
        raise InvalidInputError(
            f"method of '{name}'",
            value=f"{method!r}, {a_kind(method)}",
            limit=f"a sympy.physics.mechanics.{kind}",
            remedy=f"Form its equations first, then give the {kind} itself",
        )
