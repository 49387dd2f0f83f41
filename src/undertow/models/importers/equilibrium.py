"""Target equilibria: found from a guess, and made the origin of error coordinates."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import sympy as sp

from undertow.base import InvalidInputError, ModelError, checked, floats, one_of
from undertow.models.importers.equations import BALANCE, check_balanced, force_scale, shifted
from undertow.models.mechanism import FloatArray, Mechanism
from undertow.models.quantities import number_of
from undertow.models.validity import by_names


@checked
def holding_input(mechanism: Mechanism, q: FloatArray | None = None) -> FloatArray:
    """Return the input that holds the mechanism at rest at q, −B⁻¹ f_a(q, 0), (m,).

    Parameters
    ----------
    q
        Positions, (n,); the target x = 0 by default.
    """
    n, m = mechanism.n, mechanism.m
    x = np.zeros(2 * n)
    if q is not None:
        x = mechanism.check_state(np.append(floats("positions", q), np.zeros(n)))
    B = np.array(mechanism.input_matrix.subs(mechanism.substitution), dtype=np.float64)
    return np.asarray(-np.linalg.solve(B, mechanism.f(x)[:m]))


@checked
def find_equilibrium(mechanism: Mechanism, /, **guess: float) -> dict[str, float]:
    """Find an equilibrium near a guess: f_u(q, 0) = 0 with the actuated coordinates as given.

    Parameters
    ----------
    mechanism
        The model.
    **guess
        Coordinate values, rad or m; zero where left out.  The m actuated ones are kept, the
        n − m free ones are solved for.

    Returns
    -------
    dict
        All n coordinates, by name.

    Raises
    ------
    ModelError
        When no equilibrium is found near the guess, with the force that is left.
    InvalidInputError
        For an unknown coordinate.

    Examples
    --------
    >>> import undertow as ut
    >>> rig = ut.mechanisms.rotary_pendulum()
    >>> round(find_equilibrium(rig, phi=3.0)["phi"], 6)
    3.141593
    """
    q, relative = _solved(mechanism, _positions(mechanism, guess))
    if not relative <= BALANCE:
        scale = force_scale(mechanism)
        raise ModelError(
            f"equilibrium of '{mechanism.name}' near {dict(guess)}",
            value=f"|f_u| = {scale * relative:.3g} left",
            limit=f"below {BALANCE * scale:.3g}",
            remedy="Start from another guess, or hold the actuated coordinates elsewhere",
        )
    names = [c.name for c in mechanism.coordinates]
    return dict(zip(names, (float(v) for v in q), strict=True))


def _solved(mechanism: Mechanism, q: FloatArray) -> tuple[FloatArray, float]:
    """Solve f_u(q, 0) = 0 for the free coordinates, from q on; the actuated ones are kept.

    Returns
    -------
    numpy.ndarray, float
        Positions, (n,), and the |f_u| that is left, relative to :func:`force_scale`.
    """
    from scipy.optimize import root  # slow to import

    n, m, scale = mechanism.n, mechanism.m, force_scale(mechanism)

    def force(q_u: FloatArray) -> FloatArray:
        x = np.zeros(2 * n)
        x[:m], x[m:n] = q[:m], q_u
        return np.asarray(mechanism.f(x)[m:] / scale)

    try:
        found = root(force, q[m:], tol=1e-14).x
        return np.concatenate([q[:m], found]), float(np.abs(force(found)).max())
    except InvalidInputError:  # the search left what can be computed
        return q, math.inf


@checked
def move_target(mechanism: Mechanism, /, **equilibrium: float) -> Mechanism:
    """Return the mechanism in error coordinates from another equilibrium.

    Parameters
    ----------
    mechanism
        The model.
    **equilibrium
        The new target in the coordinates of ``mechanism``, rad or m; zero where left out.

    Returns
    -------
    Mechanism
        Its coordinates keep their names and read zero at the new target.  The start state is
        dropped: it belonged to the old one.

    Raises
    ------
    ModelError
        When it is no equilibrium of the free coordinates, f_u ≠ 0.
    """
    _positions(mechanism, equilibrium)
    coordinates, (mass, force, potential) = shifted(
        mechanism.name,
        mechanism.coordinates,
        equilibrium,
        sp.Matrix(mechanism.mass_matrix),
        sp.Matrix(mechanism.force),
        mechanism.potential,
    )
    moved = replace(
        mechanism,
        coordinates=coordinates,
        mass_matrix=mass,
        force=force,
        potential=potential,
        start={},
    )
    check_balanced(moved)
    return moved


def _positions(mechanism: Mechanism, values: Mapping[str, float]) -> FloatArray:
    names = [c.name for c in mechanism.coordinates]
    values = by_names(f"coordinates of '{mechanism.name}'", values)
    for name in values:
        whose = f"coordinate of '{mechanism.name}'"
        one_of(whose, name, names, "Name the coordinates of the mechanism")
    q = np.array([number_of(f"coordinate '{name}'", values.get(name, 0.0)) for name in names])
    if not np.isfinite(q).all():
        raise InvalidInputError(
            f"coordinates of '{mechanism.name}'", value=dict(values), limit="finite numbers"
        )
    return q
