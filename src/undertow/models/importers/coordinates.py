"""Changes of coordinates: the actuated ones first, and errors from a target.

The equations of a mechanism are often written in coordinates q in which the inputs act
through a constant (n, m) matrix, ``M q̈ = f + B u``: a motor that turns one link against
another, a differential, or simply coordinates in another order.  A constant change of
coordinates ``q = T z`` with ``Tᵀ B = (B̂, 0)`` brings them to the form of (1).  Since the
inputs do work on ``y = Bᵀ q``, the new actuated coordinates are those (scaled) outputs, and
the free ones are n − m of the old ones.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import sympy as sp

from undertow.base import InvalidInputError, ModelError, checked
from undertow.models.mechanism import Coordinate, FloatArray, matrix_of
from undertow.models.validity import expression_of

#: Expressions of more operations than this are left as they are.
_EXPANDABLE = 400


@dataclass(frozen=True, eq=False)
class ActuatedForm:
    """Equations ``M q̈ = f + (B u, 0)`` in coordinates z with ``q = T z``.

    The n ``coordinates`` are z, actuated first; M(z), (n, n); f(z, ż), (n, 1); B, (m, m), is
    invertible; T, (n, n), is constant, and generalised forces change with Tᵀ; ``potential`` is
    V(z), J, where one was given.
    """

    coordinates: tuple[Coordinate, ...]
    mass_matrix: sp.Matrix
    force: sp.Matrix
    input_matrix: sp.Matrix
    transform: sp.Matrix
    potential: sp.Expr | None

    @checked
    def bounds(self, q_bounds: Sequence[float], values: Mapping[sp.Symbol, float]) -> list[float]:
        """Return bounds on generalised forces in z, given those in q: |g_z| ≤ |Tᵀ| |g_q|."""
        T = np.array(self.transform.subs(values), dtype=np.float64)
        if len(q_bounds) != len(self.coordinates):
            raise InvalidInputError(
                "bounds on generalised forces",
                value=len(q_bounds),
                limit=f"{len(self.coordinates)} numbers, one per coordinate",
                remedy="Give 0 where nothing acts",
            )
        return [float(b) for b in np.abs(T.T) @ np.asarray(q_bounds, dtype=float)]


@checked
def actuate(
    coordinates: Sequence[Coordinate],
    mass_matrix: sp.Matrix,
    force: sp.Matrix,
    input_matrix: sp.Matrix,
    *,
    potential: sp.Expr | None = None,
    values: Mapping[sp.Symbol, float] | None = None,
    actuated: Sequence[Coordinate | None] | None = None,
    gains: Sequence[sp.Expr | None] | None = None,
) -> ActuatedForm:
    """Change to coordinates of which the first m are actuated, each by one input.

    Parameters
    ----------
    coordinates
        The n coordinates q of the given equations, in any order.
    mass_matrix, force
        M(q), (n, n), and f(q, q̇), (n, 1).
    input_matrix
        B, (n, m), of rank m; may contain parameters, but neither q nor q̇.
    potential
        V(q), carried along.
    values
        Numbers of the parameters, for the rank of B.
    actuated
        Names, units and descriptions of the m new coordinates, in the order of the inputs;
        derived from the old ones by default, or where None.  A coordinate that an input acts
        on alone keeps its name; so do m coordinates that m inputs act on together.
    gains
        Factors k_j, one per input, so that column j of B is k_j d_j and the new coordinate is
        d_jᵀ q; by default (or where None) the column's largest entry.

    Returns
    -------
    ActuatedForm
        The equations in z.

    Raises
    ------
    ModelError
        When B depends on the state, or when two inputs push the same way.

    Warns
    -----
    UserWarning
        Of travel that is not kept: that of a coordinate in whose place a combination stands.

    Examples
    --------
    The elbow motor of a two-link arm, written in the absolute angles of its links:

    >>> import sympy as sp
    >>> q = [Coordinate("q_1"), Coordinate("q_2")]
    >>> form = actuate(q, sp.eye(2), sp.zeros(2, 1), sp.Matrix([-1, 1]))
    >>> [c.name for c in form.coordinates], form.transform
    (['q_2_minus_q_1', 'q_1'], Matrix([
    [0, 1],
    [1, 1]]))
    """
    coordinates = tuple(coordinates)
    n = len(coordinates)
    B = sp.Matrix(matrix_of("input matrix", input_matrix))
    m = B.cols
    if B.rows != n:
        raise ModelError("input matrix", value=f"shape {B.shape}", limit=f"({n}, m)")
    equations = []
    for what, given, shape in (("mass matrix", mass_matrix, (n, n)), ("force", force, (n, 1))):
        equations.append(matrix_of(what, given))
        if equations[-1].shape != shape:
            raise ModelError(
                what,
                value=f"shape {equations[-1].shape}",
                limit=f"{shape}",
                remedy="Give one row per coordinate",
            )
    energy = None if potential is None else expression_of("potential", potential)
    moving = {c.symbol for c in coordinates} | {c.velocity for c in coordinates}
    if B.free_symbols & moving:
        raise ModelError(
            "input matrix",
            value=f"a function of {', '.join(sorted(str(s) for s in B.free_symbols & moving))}",
            limit="constant",
            remedy="Choose coordinates along which the inputs act, or redefine the inputs",
        )
    numbers = np.array(B.subs(values or {}), dtype=np.float64)
    pivots = _pivots(numbers)
    scales = [B[_leading(numbers[:, j]), j] for j in range(m)]
    if gains is not None:
        if len(gains) != m:
            raise InvalidInputError(
                "gains of the inputs",
                value=len(gains),
                limit=f"{m}, one per input",
                remedy="None where the column's largest entry will do",
            )
        scales = [
            s if k is None else expression_of("gain of an input", k)
            for s, k in zip(scales, gains, strict=True)
        ]
    directions = sp.Matrix.hstack(*((B[:, j] / scales[j]).applyfunc(number) for j in range(m)))
    driven = sp.diag(*scales)
    acted = [i for i in range(n) if any(entry != 0 for entry in B[i, :])]
    if len(acted) == m and actuated is None and gains is None:
        directions, driven = sp.eye(n)[:, pivots], B[pivots, :]
    kept = [i for i in range(n) if i not in pivots]
    J = sp.Matrix.vstack(directions.T, *(sp.eye(n)[i, :] for i in kept))
    T = J.inv()
    new = (*_named(coordinates, directions, actuated), *(coordinates[i] for i in kept))
    old_q = [c.symbol for c in coordinates]
    old_v = [c.velocity for c in coordinates]
    new_q = T * sp.Matrix([c.symbol for c in new])
    new_v = T * sp.Matrix([c.velocity for c in new])
    change = dict(zip([*old_q, *old_v], [*new_q, *new_v], strict=True))
    for i in pivots if actuated is None else ():
        if (c := coordinates[i]) not in new and math.isfinite(min(c.high, -c.low)):
            warnings.warn(
                f"the travel of '{c.name}', {c.low:g} to {c.high:g} {c.unit}, is not kept: "
                f"{c.name} = {new_q[i]} is no coordinate of the result. Bound it by an "
                "undertow.Constraint, or name what the inputs act on with its travel, actuated=",
                stacklevel=2,
            )
    plain = all(entry in (0, 1) for entry in T)

    def substitute(matrix: sp.Matrix) -> sp.Matrix:
        moved = sp.Matrix(matrix).xreplace(change)
        return moved if plain else moved.applyfunc(tidy)

    # Mirror the upper half, so that symmetry is kept to the letter.
    mass = T.T * substitute(equations[0]) * T
    mass = sp.Matrix(n, n, lambda i, j: mass[min(i, j), max(i, j)])
    return ActuatedForm(
        coordinates=new,
        mass_matrix=mass if plain else mass.applyfunc(tidy),
        force=T.T * substitute(equations[1]),
        input_matrix=driven,
        transform=T,
        potential=None if energy is None else energy.xreplace(change),
    )


def _leading(column: FloatArray) -> int:
    """Index of the largest entry; of equally large ones, a positive one."""
    return int(np.argmax(np.abs(column) * (1 + 1e-9 * (column > 0))))


def _pivots(B: FloatArray) -> list[int]:
    """Rows of B that carry its rank, found by elimination with column pivots."""
    work, pivots = B.copy(), []
    scale = np.abs(B).max(initial=0.0)
    for j in range(B.shape[1]):
        row = _leading(work[:, j])
        if not abs(work[row, j]) > 1e-12 * scale:
            raise ModelError(
                "input matrix",
                value=f"input {j + 1} pushes the way that earlier inputs do, or not at all",
                limit=f"rank {B.shape[1]}",
                remedy="Merge inputs that act on the same joint",
            )
        pivots.append(row)
        for k in range(j + 1, B.shape[1]):
            work[:, k] -= work[:, j] * (work[row, k] / work[row, j])
    return pivots


def _named(
    coordinates: Sequence[Coordinate],
    directions: sp.Matrix,
    actuated: Sequence[Coordinate | None] | None,
) -> list[Coordinate]:
    """Names for the actuated coordinates ``directionsᵀ q``."""
    m = directions.cols
    if actuated is not None and len(actuated) != m:
        raise InvalidInputError(
            "names of the actuated coordinates", value=len(actuated), limit=f"{m} coordinates"
        )
    named = []
    for j in range(m):
        column = list(directions[:, j])
        nonzero = [i for i, entry in enumerate(column) if entry != 0]
        wanted = None if actuated is None else actuated[j]
        if len(nonzero) == 1 and column[nonzero[0]] == 1:
            named.append(coordinates[nonzero[0]])
        elif wanted is not None:
            named.append(wanted)
        else:
            plus = [coordinates[i].name for i in nonzero if column[i] == 1]
            minus = [coordinates[i].name for i in nonzero if column[i] == -1]
            simple = len(plus) + len(minus) == len(nonzero)
            name = "_plus_".join(plus) + "".join(f"_minus_{k}" for k in minus)
            text = " + ".join(plus) + "".join(f" - {k}" for k in minus)
            if not simple:
                text = sp.sstr(sum(column[i] * coordinates[i].symbol for i in nonzero))
            leading = next((i for i in nonzero if column[i] == 1), nonzero[0])
            unit = coordinates[leading].unit
            named.append(Coordinate(name if simple else f"stroke_{j + 1}", unit, text))
    return named


def exact_angle(value: float) -> sp.Expr:
    """Return the value as a multiple of π/12 where it is one, so that sines stay exact."""
    twelfths = value * 12 / np.pi
    nearest = round(twelfths)
    if abs(twelfths - nearest) < 1e-12 * max(1.0, abs(twelfths)):
        return sp.Rational(nearest, 12) * sp.pi
    return sp.Float(value)


def number(value: sp.Expr | float) -> sp.Expr:
    """Return a float that is whole within rounding as an integer; all else unchanged."""
    value = sp.sympify(value)
    if value.is_Float and abs(value - round(value)) < 1e-14:
        return sp.Integer(round(value))
    return value


def tidy(expression: sp.Expr) -> sp.Expr:
    """Expand, with trigonometry in single angles, where that makes an expression no longer.

    Planar mechanisms get short formulas by expanding; spatial ones with tilted axes would
    explode, and are kept nested.  Terms whose numbers cancelled to rounding are dropped.
    """
    expression = sp.sympify(expression)
    if expression.is_Atom:
        return expression
    size = sp.count_ops(expression)
    if size > _EXPANDABLE:
        return expression
    expanded = sp.expand_trig(sp.expand(expression))
    if expanded.has(sp.Float):
        expanded = sp.Add(*(t for t in sp.Add.make_args(expanded) if not _negligible(t)))
    return expanded if sp.count_ops(expanded) <= size else expression


def _negligible(term: sp.Expr) -> bool:
    coefficient = term.as_coeff_Mul()[0]
    return bool(coefficient.is_Float and abs(coefficient) < 1e-15)
