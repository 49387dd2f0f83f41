"""Conditions on the parts of a mechanism; each failure names the entry, the limit, the remedy."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet

import numpy as np
import sympy as sp
from sympy.core.relational import Relational

from undertow.errors import ModelError
from undertow.quantities import TIME, Coordinate, FloatArray

__all__ = [
    "check_definite",
    "check_names",
    "check_symbols",
    "check_symmetric",
    "kinks",
    "require_smooth",
]

#: Functions that are smooth wherever they are finite: a derivative of theirs is never wrong.
_SMOOTH = (
    sp.sin, sp.cos, sp.tan, sp.cot, sp.sec, sp.csc, sp.sinc, sp.atan, sp.acot,
    sp.sinh, sp.cosh, sp.tanh, sp.coth, sp.sech, sp.csch, sp.asinh, sp.exp, sp.erf, sp.erfc,
    sp.Add, sp.Mul, sp.Symbol, sp.Number, sp.NumberSymbol,
)  # fmt: skip

#: A point is on a kink that is not further from it than this.
_NEAR = 1e-9


def check_names(owner: str, names: Sequence[str]) -> None:
    """Refuse names that meet each other, the time's, or those of generated code."""
    every = [*names, TIME.name]
    repeated = sorted({name for name in every if every.count(name) > 1})
    if repeated:
        raise ModelError(
            f"a name of '{owner}' is used twice",
            value=", ".join(repeated),
            limit="unique among coordinates, inputs, parameters and the time t",
            remedy="Rename one of them",
        )
    private = sorted(name for name in every if name.startswith("_"))
    if private:
        raise ModelError(
            f"a name of '{owner}' starts with an underscore",
            value=", ".join(private),
            limit="a letter first",
            remedy="Rename it: such names are kept for generated code",
        )


def check_symbols(what: str, matrix: sp.Matrix, allowed: AbstractSet[sp.Symbol]) -> None:
    """Refuse symbols that nobody declared."""
    unknown = sorted(str(s) for s in matrix.free_symbols - allowed)
    if unknown:
        raise ModelError(
            f"{what} has unknown symbols",
            value=", ".join(unknown),
            limit=f"among {', '.join(sorted(str(s) for s in allowed))}",
            remedy="Declare them as parameters, or as coordinates, with real symbols",
        )


def check_symmetric(what: str, matrix: sp.Matrix) -> None:
    """Refuse a square matrix that differs from its transpose."""
    skew = matrix - matrix.T
    for j, i in itertools.combinations(range(matrix.rows), 2):
        if skew[i, j] != 0 and sp.simplify(skew[i, j]) != 0:
            raise ModelError(
                what,
                value=f"{matrix[j, i]} at [{j}, {i}] and {matrix[i, j]} at [{i}, {j}]",
                limit="symmetric",
                remedy="Derive M from the kinetic energy: Mechanism.from_energies",
            )


def check_definite(
    what: str, coordinates: Sequence[Coordinate], mass: Callable[[FloatArray], FloatArray]
) -> None:
    """Refuse an M(q) that is not positive definite at one of 16 positions, the target first."""
    rng = np.random.default_rng(0)
    spread = np.array([math.pi if c.unit == "rad" else 1.0 for c in coordinates])
    for trial in range(16):
        q = trial * rng.uniform(-spread, spread) / 15
        smallest = float(np.linalg.eigvalsh(mass(q))[0])
        if not smallest > 0:
            where = ", ".join(
                f"{c.name} = {v:.3g} {c.unit}" for c, v in zip(coordinates, q, strict=True)
            )
            raise ModelError(
                f"{what} at {where}",
                value=f"smallest eigenvalue {smallest:.3g}",
                limit="positive",
                remedy="Check masses, lengths and inertias: a massless link has no M > 0",
            )


def require_smooth(
    what: str,
    expressions: Iterable[sp.Expr] | sp.MatrixBase,
    variables: Iterable[sp.Symbol],
    *,
    at: Mapping[sp.Symbol, float] | None = None,
) -> None:
    """Refuse expressions that have no derivative where one is about to be taken.

    SymPy differentiates what has a kink, too, and gives it a slope there that it has not:
    that of |x| at 0 is 0.

    Parameters
    ----------
    what
        What is differentiated, for the message.
    expressions
        Expressions, or a matrix of them.
    variables
        By which they are differentiated.
    at
        The point where, all symbols to numbers: a kink elsewhere, as that of |x − 1| at 0, does
        no harm.  Without it the derivative is wanted everywhere.

    Raises
    ------
    ModelError
        With the first expression that is not smooth.
    """
    found = next(kinks(expressions, variables, at=at), None)
    if found is not None:
        raise ModelError(
            f"{what} is not smooth",
            value=found,
            limit="differentiable " + ("at the target" if at is not None else "everywhere"),
            remedy="Put a smooth function in its place: sqrt(x**2 + e**2) for Abs(x), tanh(x/e) "
            "for sign(x), with a small e. A simulation needs no derivative where the surface is "
            "given",
        )


def kinks(
    expressions: Iterable[sp.Expr] | sp.MatrixBase,
    variables: Iterable[sp.Symbol],
    *,
    at: Mapping[sp.Symbol, float] | None = None,
) -> Iterator[sp.Basic]:
    """Yield the parts of expressions that have no derivative, as :func:`require_smooth` says.

    Where no point is given, roots, logarithms and inverse sines count as smooth: where they are
    not, their derivatives are no numbers, and so cannot pass for right ones.
    """
    moving = set(variables)
    values = None if at is None else {s: sp.Rational(float(v)) for s, v in at.items()}
    waiting = [sp.sympify(e) for e in expressions][::-1]
    while waiting:
        part = waiting.pop()
        if not part.free_symbols & moving:
            continue
        if not isinstance(part, _SMOOTH):
            edges = _edges(part)
            if (
                edges is None
                or (values is None and not isinstance(part, _SINGULAR))
                or (values is not None and any(_meets(part, e, values) for e in edges))
            ):
                yield part
                continue
        branches = isinstance(part, sp.Piecewise)
        waiting += [arg.expr if branches else arg for arg in part.args][::-1]


#: What has no derivative at isolated points, and none there that is a number.
_SINGULAR = (sp.Pow, sp.log, sp.asin, sp.acos, sp.atan2, sp.acosh, sp.atanh)


def _edges(part: sp.Basic) -> list[sp.Expr] | None:
    """Return what is zero where ``part`` is not smooth; None where that is not known."""
    if isinstance(part, sp.Pow):
        smooth = part.exp.is_Integer and part.exp.is_nonnegative
        return [] if smooth or not part.base.free_symbols else [part.base]
    if isinstance(part, sp.Abs | sp.sign | sp.Heaviside | sp.DiracDelta | sp.log):
        return [part.args[0]]
    if isinstance(part, sp.asin | sp.acos | sp.acosh | sp.atanh):
        return [1 - part.args[0] ** 2]
    if isinstance(part, sp.atan2):
        y, x = part.args
        return [sp.sqrt(x**2 + y**2) + x]
    if isinstance(part, sp.Max | sp.Min):
        return [a - b for a, b in itertools.combinations(part.args, 2)]
    if isinstance(part, sp.Piecewise):
        relations = [c.atoms(Relational) for _, c in part.args if c != sp.true]
        if all(relations):
            return [r.lhs - r.rhs for group in relations for r in group]
    return None


def _meets(part: sp.Basic, edge: sp.Expr, values: Mapping[sp.Symbol, sp.Rational]) -> bool:
    """Whether a point lies on an edge, or where that is no real number."""
    exact = {number: sp.Rational(number) for number in edge.atoms(sp.Float)}
    try:
        distance = abs(float(edge.xreplace(exact | dict(values)).evalf(30)))
    except (TypeError, ValueError):  # zoo, complex, or symbols that are left
        return True
    # Of a root the base is asked for, e² in √(x² + e²): only zero itself is refused.
    return not distance > (1e-25 if isinstance(part, _SINGULAR) else _NEAR)
