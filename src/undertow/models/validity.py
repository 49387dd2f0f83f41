"""Checks of the parts of a mechanism; each error names the entry, the limit and the remedy."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
import sympy as sp
from sympy.core.function import Application, AppliedUndef
from sympy.core.relational import Relational
from sympy.logic.boolalg import Boolean

from undertow.base import REMEDIES, InvalidInputError, ModelError, a_kind, near
from undertow.models.quantities import (
    TIME,
    Coordinate,
    FloatArray,
    Input,
    Parameter,
    code_points,
    normal_name,
)

T = TypeVar("T")

#: Functions that are smooth wherever they are finite: SymPy's derivatives of them are right.
_SMOOTH = (
    sp.sin, sp.cos, sp.sinc, sp.atan, sp.sinh, sp.cosh, sp.tanh, sp.sech, sp.asinh, sp.exp,
    sp.Add, sp.Mul, sp.Symbol, sp.Number, sp.NumberSymbol,
)  # fmt: skip

#: Functions that go to infinity at isolated points, and what is zero there.
_POLES: Mapping[Any, Callable[[sp.Expr], sp.Expr]] = {
    sp.tan: sp.cos, sp.sec: sp.cos, sp.cot: sp.sin, sp.csc: sp.sin,
    sp.coth: lambda e: e, sp.csch: lambda e: e,
}  # fmt: skip

#: Functions without a derivative at isolated points, where SymPy's is not finite either.
_SINGULAR = (
    sp.Pow, sp.log, sp.asin, sp.acos, sp.atan2, sp.acosh, sp.atanh, *_POLES,
)  # fmt: skip

#: Functions with kinks and jumps for which code can be generated; conditions of Piecewise.
#: SymPy's acot jumps at 0, from −π/2 to π/2; its derivative there is −1 all the same.
_BROKEN = (
    sp.acot, sp.Abs, sp.sign, sp.Max, sp.Min, sp.Piecewise, sp.Heaviside, sp.floor, sp.ceiling,
    sp.frac, sp.Mod, Boolean,
)  # fmt: skip

#: Placeholders for expressions that are not given.
_UNDEFINED = (AppliedUndef, sp.Derivative, sp.Integral)

#: A point closer to a kink than this is on it.
_NEAR = 1e-9


def check_names(owner: str, names: Sequence[str]) -> None:
    """Refuse names that clash with each other, with the time t, or with generated code.

    ``owner``: whose names. ``names``: as they were spelt: two that are the same to Python (in
    Unicode's form NFKC) clash.
    """
    every = [*names, TIME.name]
    normal = sorted(map(normal_name, names))
    unique = "unique among coordinates, inputs, parameters and the time t"
    another = "another one: v.states and v.inputs are all of them in a stage cost"
    kept = "Rename it: such names are kept for generated code"
    vectors = ", ".join(name for name in normal if name in ("inputs", "states"))
    private = ", ".join(name for name in normal if name.startswith("_"))
    for wrong, found, limit, remedy in (
        ("is used twice", repeated_names(every), unique, "Rename one of them"),
        ("is that of a vector", vectors, another, "Rename it"),
        ("starts with an underscore", private, "a letter first", kept),
    ):
        if found:
            raise ModelError(
                f"a name of '{owner}' {wrong}", value=found, limit=limit, remedy=remedy
            )


def repeated_names(names: Sequence[str]) -> str:
    """Return the names that occur twice, or are the same to Python; empty where none do.

    >>> repeated_names(["x", "y", "x"])
    'x'
    >>> repeated_names(["µ", "x", "μ"])
    "µ (U+00B5) and μ (U+03BC), which are one name in Unicode's form NFKC"
    """
    groups: dict[str, list[str]] = {}
    for name in names:
        groups.setdefault(normal_name(name), []).append(name)
    said = []
    for _, group in sorted(groups.items()):
        spelt = sorted(set(group))
        if len(spelt) > 1:
            shown = " and ".join(code_points(name) for name in spelt)
            said.append(f"{shown}, which are one name in Unicode's form NFKC")
        elif len(group) > 1:
            said.append(group[0])
    return ", ".join(said)


def by_names(what: str, values: Mapping[str, T]) -> dict[str, T]:
    """Return values by their names in Python's spelling, NFKC.

    Raises
    ------
    InvalidInputError
        For two names that are the same to Python, and for keys that are not text.

    Examples
    --------
    >>> by_names("forces", {"µ": 1.0}) == {"μ": 1.0}
    True
    """
    odd = [name for name in values if not isinstance(name, str)]
    repeated = "" if odd else repeated_names(list(values))
    if odd or repeated:
        raise InvalidInputError(
            what,
            value=f"{odd[0]!r}, {a_kind(odd[0])}" if odd else repeated,
            limit="names as text, each once",
            remedy="Write coordinate.name for a coordinate" if odd else "Keep one",
        )
    return {normal_name(name): value for name, value in values.items()}


def check_parts(
    owner: str,
    coordinates: Sequence[Coordinate],
    inputs: Sequence[Input],
    parameters: Sequence[Parameter],
) -> None:
    """Check that the parts are coordinates, inputs and parameters whose names do not clash.

    Raises InvalidInputError for a part of another kind, text for instance; ModelError for names
    that clash, see :func:`check_names`.
    """
    for what, kind, parts in (
        ("coordinates", Coordinate, coordinates),
        ("inputs", Input, inputs),
        ("parameters", Parameter, parameters),
    ):
        several = isinstance(parts, Collection) and not isinstance(parts, str)
        wrong = [p for p in parts if not isinstance(p, kind)] if several else [parts]
        if wrong:
            raise InvalidInputError(
                f"{what} of '{owner}'",
                value=f"{wrong[0]!r}, {a_kind(wrong[0])}",
                limit=f"a sequence of undertow.{kind.__name__}",
                remedy=REMEDIES[kind.__name__],
            )
    spelt = [c.spelling for c in coordinates]
    channels = [i.spelling for i in inputs]
    data = [p.spelling for p in parameters]
    check_names(owner, [*spelt, *(f"{name}_dot" for name in spelt), *channels, *data])


def vocabulary(
    coordinates: Sequence[Coordinate] = (),
    inputs: Sequence[Input] = (),
    parameters: Sequence[Parameter] = (),
    *,
    velocities: bool = True,
    time: bool = True,
) -> dict[sp.Symbol, str]:
    """Return the symbols that an expression may hold, each with how to write it."""
    known = {c.symbol: "coordinate.symbol" for c in coordinates}
    if velocities:
        known |= {c.velocity: "coordinate.velocity" for c in coordinates}
    known |= {i.symbol: "input.symbol" for i in inputs}
    known |= {p.symbol: "parameter.symbol" for p in parameters}
    return known | ({TIME: "undertow.models.mechanism.TIME"} if time else {})


def expression_of(what: str, value: object) -> sp.Expr:
    """Return a number or an expression as SymPy's; refuse text, which SymPy would evaluate.

    Raises
    ------
    ModelError
        For anything that is not an expression.
    """
    try:
        expression = sp.sympify(value, strict=True)
    except (sp.SympifyError, TypeError, AttributeError, ValueError):
        expression = None
    if isinstance(expression, sp.MatrixBase) and expression.shape == (1, 1):
        expression = expression[0, 0]
    if not isinstance(expression, sp.Expr) or isinstance(expression, sp.MatrixBase):
        raise ModelError(
            what,
            value=f"{shortened(value)}, {a_kind(value)}",
            limit="a SymPy expression, or a number",
            remedy="Build it of coordinate.symbol, coordinate.velocity and parameter.symbol",
        )
    return expression


def check_symbols(
    what: str, expressions: Iterable[sp.Expr] | sp.MatrixBase, known: Mapping[sp.Symbol, str]
) -> None:
    """Refuse undeclared symbols, undefined functions, and values that are not real and finite.

    To SymPy ``Symbol("a")`` and ``Symbol("a", real=True)`` are different variables: the derivative
    of one by the other is zero, and terms with the wrong one would drop out of the equations.

    ``what`` says whose expressions these are, for the message; ``known`` is what they may hold, see
    :func:`vocabulary`.

    Raises
    ------
    ModelError
        With the unknown symbols, and what was probably meant.
    """
    unknown: set[sp.Basic] = set()
    for expression in expressions:
        parts = expression.atoms(sp.Expr, Boolean)
        odd = {part for part in parts if isinstance(part, _UNDEFINED)}
        strange = expression.atoms(sp.nan.func, sp.zoo.func, sp.oo.func, type(-sp.oo), type(sp.I))
        written = _SMOOTH + _SINGULAR + _BROKEN
        unwritten = [f for f in parts - odd - strange if not isinstance(f, written)]
        if unwritten:
            raise ModelError(
                what,
                value=", ".join(sorted(map(shortened, unwritten))),
                limit="functions that code is written for, sin, exp, sqrt, Abs and the like",
                remedy="Put an expression of them in its place, or an approximation",
            )
        inside = set().union(*(part.free_symbols for part in odd))
        unknown |= odd | ((expression.free_symbols - set(known)) - inside)
        if strange:
            raise ModelError(
                what,
                value=f"{', '.join(sorted(map(str, strange)))} in {shortened(expression)}",
                limit="real and finite",
                remedy="Something was divided by zero, or a root taken of a negative number",
            )
    if unknown:
        raise ModelError(
            f"{what} has unknown symbols",
            value=", ".join(sorted(code_points(str(s)) for s in unknown)),
            limit=f"among {', '.join(sorted(str(s) for s in known))}",
            remedy=_meant(unknown, known),
        )


def shortened(value: object) -> str:
    """Return a value as text on one line, cut after 60 characters."""
    text = " ".join(str(value).split())
    return text if len(text) <= 60 else f"{text[:57]}..."


def _meant(unknown: Iterable[sp.Basic], known: Mapping[sp.Symbol, str]) -> str:
    """Return a remedy: the symbol of the same name, a near name, or to declare it."""
    by_name = {s.name: way for s, way in known.items()}
    for symbol in sorted(unknown, key=str):
        name = normal_name(_plain(symbol))
        if name in by_name:
            return (
                f"Did you mean {by_name[name]} of '{name}'? It is Symbol({name!r}, real=True): to "
                "SymPy every other one is another variable"
            )
        hint = near(name, by_name)
        if hint:
            return f"{hint} Else declare it as a parameter"
    return "Declare them as parameters, or as coordinates, with real symbols"


def _plain(part: sp.Basic) -> str:
    """Name of a symbol, a function of time, or the velocity of one."""
    if isinstance(part, sp.Derivative):
        return f"{_plain(part.expr)}_dot"
    return str(part.func) if isinstance(part, AppliedUndef) else str(part)


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
    places = np.arange(16)[:, None] / 15 * rng.uniform(-spread, spread, (16, len(spread)))
    try:
        least = np.linalg.eigvalsh(mass(places))[:, 0]
    except np.linalg.LinAlgError:  # of a matrix that holds no numbers
        least = np.array([_least_eigenvalue(mass(q)) for q in places])
    for q, smallest in zip(places, least, strict=True):
        if not smallest > 0:
            where = ", ".join(
                f"{c.name} = {v + 0.0:.3g} {c.unit}" for c, v in zip(coordinates, q, strict=True)
            )
            raise ModelError(
                f"{what} at {where}",
                value=f"smallest eigenvalue {smallest:.3g}",
                limit="positive",
                remedy="Check masses, lengths and inertias: a massless link has no M > 0",
            )


def _least_eigenvalue(mass: FloatArray) -> float:
    try:
        return float(np.linalg.eigvalsh(mass)[0])
    except np.linalg.LinAlgError:
        return math.nan


def require_smooth(
    what: str,
    expressions: Iterable[sp.Expr] | sp.MatrixBase,
    variables: Iterable[sp.Symbol],
    *,
    at: Mapping[sp.Symbol, float] | None = None,
    orders: int = 1,
) -> None:
    """Refuse expressions that have no derivative where one is about to be taken.

    SymPy also differentiates expressions with kinks, and returns a slope that does not exist:
    0 for |x| at 0.

    The point ``at``, all symbols to numbers, is where the derivative is wanted: a kink elsewhere,
    as that of |x − 1| at 0, does no harm. Without it the derivative is wanted everywhere.
    ``orders`` derivatives are taken one after the other: x |x| has one, and no second. ``what`` is
    for the message.

    Raises
    ------
    ModelError
        With the first expression that is not smooth.
    """
    found = next(kinks(expressions, variables, at=at, orders=orders), None)
    if found is not None:
        raise ModelError(
            f"{what} is not smooth",
            value=found,
            limit="differentiable " + ("at the target" if at is not None else "everywhere"),
            remedy="Put a smooth function in its place: sqrt(x**2 + e**2) for Abs(x), tanh(x/e) "
            "for sign(x), with a small e. A simulation needs no derivative where the surface is "
            "given",
        )


def is_smooth(expression: sp.Basic) -> bool:
    """Whether an expression is made of smooth functions only, roots and the like left aside."""
    return all(isinstance(f, _SMOOTH + _SINGULAR) for f in expression.atoms(Application))


def kinks(
    expressions: Iterable[sp.Expr] | sp.MatrixBase,
    variables: Iterable[sp.Symbol],
    *,
    at: Mapping[sp.Symbol, float] | None = None,
    orders: int = 1,
) -> Iterator[sp.Basic]:
    """Yield the parts of expressions that have no derivative, as :func:`require_smooth` says.

    Where no point is given, roots, logarithms and inverse sines count as smooth: where they are
    not, their derivatives are not finite, and cannot be mistaken for correct ones.
    """
    moving = set(variables)
    values = None if at is None else {s: sp.Rational(float(v)) for s, v in at.items()}
    waiting: list[tuple[sp.Basic, tuple[sp.Expr, ...]]]
    waiting = [(sp.sympify(e), ()) for e in expressions][::-1]
    while waiting:
        part, factors = waiting.pop()
        if not isinstance(part, _SMOOTH):
            if not part.free_symbols & moving:
                continue
            edges = _edges(part)
            helped = factors if orders == 1 else ()
            if edges is None or any(_breaks(part, edge, helped, values) for edge in edges):
                yield part
                continue
        waiting += _inside(part, factors)[::-1]


def _inside(
    part: sp.Basic, factors: tuple[sp.Expr, ...]
) -> list[tuple[sp.Basic, tuple[sp.Expr, ...]]]:
    """Return the arguments of an expression, each with the factors that it is multiplied by."""
    if isinstance(part, sp.Mul):
        others = [(*part.args[:i], *part.args[i + 1 :]) for i in range(len(part.args))]
        return [(arg, (*factors, *rest)) for arg, rest in zip(part.args, others, strict=True)]
    if isinstance(part, sp.Pow) and part.exp.is_number and part.exp > 1:
        return [(part.base, (*factors, part.base))]
    if isinstance(part, sp.Piecewise):
        return [(branch.expr, ()) for branch in part.args]
    return [(arg, factors) for arg in part.args]


def _edges(part: sp.Basic) -> list[sp.Expr] | None:
    """Return what is zero where ``part`` is not smooth; None where that is not known."""
    if isinstance(part, sp.Pow):
        smooth = part.exp.is_Integer and part.exp.is_nonnegative
        return [] if smooth or not part.base.free_symbols else [part.base]
    if isinstance(part, sp.Abs | sp.sign | sp.Heaviside | sp.DiracDelta | sp.log | sp.acot):
        return [part.args[0]]
    if part.func in _POLES:
        return [_POLES[part.func](part.args[0])]
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


def _breaks(
    part: sp.Basic,
    edge: sp.Expr,
    factors: Sequence[sp.Expr],
    values: Mapping[sp.Symbol, sp.Rational] | None,
) -> bool:
    """Whether a function that is not smooth where an edge is zero has no derivative for it.

    A continuous one has, times a factor that is zero there: (g h)' = g' h where g = 0.
    """
    if values is None:
        if isinstance(part, _SINGULAR):
            return False
        zeros = (edge.is_Symbol and f.subs(edge, 0) == 0 for f in factors)
    else:
        # Of a root the base is asked for, e² in √(x² + e²): only zero itself is refused.
        if not _zero(edge, values, 1e-25 if isinstance(part, _SINGULAR) else _NEAR):
            return False
        zeros = (_zero(f, values, _NEAR) for f in factors)
    return not (isinstance(part, sp.Abs | sp.Max | sp.Min) and any(zeros))


def _zero(expression: sp.Expr, values: Mapping[sp.Symbol, sp.Rational], tolerance: float) -> bool:
    """Whether an expression is zero, or no real number, at a point."""
    exact = {number: sp.Rational(number) for number in expression.atoms(sp.Float)}
    try:
        return not abs(float(expression.xreplace(exact | dict(values)).evalf(30))) > tolerance
    except (TypeError, ValueError):  # zoo, complex, or symbols that are left
        return True
