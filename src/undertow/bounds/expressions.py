"""SymPy expressions to CasADi ones, dynamics too, and absolute values to smooth constraints."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import reduce
from itertools import product
from typing import Any

import sympy as sp

from undertow.base import InvalidInputError
from undertow.models import TIME, Mechanism
from undertow.symbolic import Tape

_SAME = "acos asin atan atan2 cos cosh exp log sign sin sinh tan tanh"
FUNCTIONS = {
    **{getattr(sp, name): name for name in _SAME.split()},
    **{sp.Abs: "fabs", sp.Max: "fmax", sp.Min: "fmin"},
    **{sp.Lt: "lt", sp.Le: "le", sp.Gt: "gt", sp.Ge: "ge", sp.Eq: "eq", sp.Ne: "ne"},
    **{sp.And: "logic_and", sp.Or: "logic_or", sp.Not: "logic_not"},
}


def translate(ca: Any, expression: sp.Basic, known: dict[sp.Basic, Any]) -> Any:
    """Return a SymPy expression as a CasADi one; ``known`` maps its symbols."""
    if expression in known:
        return known[expression]
    if isinstance(expression, sp.Expr) and expression.is_number:
        return float(expression)
    if expression in (sp.true, sp.false):
        return float(bool(expression))
    if isinstance(expression, sp.Piecewise):
        value: Any = math.nan
        for branch, condition in reversed(expression.args):
            test, then = (translate(ca, e, known) for e in (condition, branch))
            value = ca.if_else(test, then, value)
        return value
    arguments = [translate(ca, argument, known) for argument in expression.args]
    if isinstance(expression, sp.Add):
        return reduce(lambda a, b: a + b, arguments)
    if isinstance(expression, sp.Mul):
        return reduce(lambda a, b: a * b, arguments)
    if isinstance(expression, sp.Pow):
        base, exponent = arguments
        return ca.sqrt(base) if exponent == 0.5 else base**exponent
    name = FUNCTIONS.get(expression.func)
    if name is None:
        raise InvalidInputError(
            "function in the problem of the bound",
            value=str(expression),
            limit=f"one of {', '.join(sorted(f.__name__ for f in FUNCTIONS))}",
        )
    function = getattr(ca, name)
    return reduce(function, arguments) if len(arguments) > 1 else function(*arguments)


def smooth(margin: sp.Expr) -> list[sp.Expr]:
    """Split a margin c − Σ k_i |e_i|, k_i > 0, into the smooth margins c ∓ k_i e_i."""
    absolute = sorted(margin.atoms(sp.Abs), key=sp.default_sort_key)
    stand_ins = [sp.Dummy(real=True) for _ in absolute]
    plain = margin.xreplace(dict(zip(absolute, stand_ins, strict=True)))
    slopes = [sp.diff(plain, z) for z in stand_ins]
    if not all(slope.is_number and slope.is_negative for slope in slopes):
        return [margin]
    signs = product((1, -1), repeat=len(absolute))
    return [
        plain.xreplace({z: s * a.args[0] for z, s, a in zip(stand_ins, row, absolute, strict=True)})
        for row in signs
    ]


def dynamics(ca: Any, mechanism: Mechanism, stage: sp.Expr, margins: Sequence[sp.Expr] = ()) -> Any:
    """Return the CasADi function (t, x, u) -> (ẋ, Φ, margins)."""
    tape = Tape()
    outputs = mechanism.partition(tape).accelerations(sp.Matrix(mechanism.u))
    outputs += tape.let_all([stage, *margins])
    t = ca.SX.sym("t")
    x, u = ca.SX.sym("x", 2 * mechanism.n), ca.SX.sym("u", mechanism.m)
    known: dict[sp.Basic, Any] = {TIME: t, **mechanism.substitution}
    known |= zip(mechanism.x, ca.vertsplit(x), strict=True)
    known |= zip(mechanism.u, ca.vertsplit(u), strict=True)
    for line in tape.live(outputs):
        known[line.symbol] = translate(ca, line.expression, known)
    values = [translate(ca, output, known) for output in outputs]
    n = mechanism.n
    rates = ca.vertcat(x[n:], *values[:n])
    return ca.Function("dynamics", [t, x, u], [rates, values[n], ca.vertcat(*values[n + 1 :])])
