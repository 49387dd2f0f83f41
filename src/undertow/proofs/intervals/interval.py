"""Outward-rounded evaluation of expressions in python-flint's ``arb``, balls of any precision.

A tape becomes a Python function that uses nothing but ``+ - * / **`` and methods such as
``.sin()``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import Any, cast

import sympy as sp

from undertow.base.errors import InvalidInputError, MissingExtraError
from undertow.symbolic import Tape

#: One call's arguments and results: arb balls.
OutwardFunction = Callable[..., list[Any]]


def flint() -> Any:
    """Import python-flint, or say in one line what to install.

    Raises
    ------
    MissingExtraError
        When python-flint is not there.
    """
    try:
        import flint as module
    except ImportError as error:
        raise MissingExtraError(
            "ball arithmetic needs python-flint",
            remedy="Install the extra: pip install 'undertow[certify]'",
        ) from error
    return module


def ball(low: float | Fraction, high: float | Fraction | None = None) -> Any:
    """Return an arb that contains [low, high], or the single number ``low``."""
    module = flint()
    first = module.arb(_fmpq(low))
    return first if high is None or high == low else first.union(module.arb(_fmpq(high)))


def _fmpq(value: float | Fraction) -> Any:
    exact = Fraction(value)
    return flint().fmpq(exact.numerator, exact.denominator)


def lower_float(value: Any) -> float:
    """Return a float that is not above the lower end of a ball."""
    return math.nextafter(float(value.lower()), -math.inf)


def upper_float(value: Any) -> float:
    """Return a float that is not below the upper end of a ball."""
    return math.nextafter(float(value.upper()), math.inf)


def exact_fraction(expression: sp.Expr) -> Fraction:
    """Return the exact value of a SymPy number: a Float counts as the binary number it is.

    Raises
    ------
    InvalidInputError
        For a number that is not rational.
    """
    if expression.is_Float:
        sign, mantissa, exponent, _ = expression._mpf_
        return Fraction((-1) ** sign * int(mantissa)) * Fraction(2) ** int(exponent)
    if expression.is_Rational:
        return Fraction(int(expression.p), int(expression.q))
    raise InvalidInputError("exact value", value=str(expression), limit="a rational number")


# -- expressions to functions of balls -------------------------------------------------------


_METHODS = {
    sp.sin: "sin",
    sp.cos: "cos",
    sp.tan: "tan",
    sp.exp: "exp",
    sp.log: "log",
    sp.tanh: "tanh",
    sp.Abs: "__abs__",
}


class _Printer:
    """SymPy to source made of operators and methods; constants are collected apart."""

    def __init__(self, names: dict[sp.Symbol, str]) -> None:
        self.names = names
        self.constants: dict[str, Any] = {}

    def constant(self, key: str, value: Any) -> str:
        self.constants[key] = value
        return key

    def text(self, e: sp.Expr) -> str:
        if e.is_Symbol:
            return self.names[e]
        if e.is_Integer and abs(int(e)) < 2**53:
            return f"({int(e)})"
        if e.is_Rational or e.is_Float:
            value = exact_fraction(e)
            key = f"c{value.numerator}_{value.denominator}".replace("-", "m")
            return self.constant(key, ball(value))
        if e is sp.pi:
            return self.constant("c_pi", flint().arb.pi())
        if e.is_Add:
            return "(" + " + ".join(self.text(a) for a in e.args) + ")"
        if e.is_Mul:
            return "(" + "*".join(self.text(a) for a in e.args) + ")"
        if e.is_Pow:
            return self.power(*e.args)
        if e.func in _METHODS:
            return f"{self.text(self.lift(e.args[0]))}.{_METHODS[e.func]}()"
        if e.func in (sp.Max, sp.Min):
            method = "max" if e.func is sp.Max else "min"
            first, *rest = (self.text(self.lift(a)) for a in e.args)
            return first + "".join(f".{method}({other})" for other in rest)
        raise InvalidInputError(
            "expression for outward-rounded evaluation",
            value=str(e.func),
            limit="+ − × ÷, powers, sin, cos, tan, exp, log, tanh, sqrt, |·|, max, min",
        )

    def lift(self, e: sp.Expr) -> sp.Expr:
        """An integer that a method is called on must be of the type, not a Python int."""
        return sp.Float(int(e), 60) if e.is_Integer else e

    def power(self, base: sp.Expr, exponent: sp.Expr) -> str:
        if exponent.is_Integer:
            inner, k = self.text(base), int(exponent)
            if k == -1:
                return f"(1/{inner})"
            return f"({inner}**{k})" if k > 0 else f"(1/{inner}**{-k})"
        if exponent in (sp.Rational(1, 2), sp.Rational(-1, 2)):
            root = f"{self.text(self.lift(base))}.sqrt()"
            return root if exponent > 0 else f"(1/{root})"
        raise InvalidInputError(
            "exponent for outward-rounded evaluation",
            value=str(exponent),
            limit="an integer or ±½",
        )


def compile_outward(
    tape: Tape,
    inputs: Sequence[sp.Symbol],
    outputs: Sequence[sp.Expr],
) -> OutwardFunction:
    """Return a function of ``inputs``, arb balls, giving a list of ``outputs``.

    Parameters
    ----------
    tape
        The program; only what the outputs depend on runs.
    inputs
        Symbols that stay arguments, in the order of the call.
    outputs
        Atoms of the tape, or small expressions of them.

    Raises
    ------
    MissingExtraError
        Without python-flint.
    InvalidInputError
        For a function that has no outward-rounded form here.
    """
    flint()
    names = {s: f"a{i}" for i, s in enumerate(inputs)}
    printer = _Printer(names)
    body = []
    for line in tape.live(outputs):
        text = printer.text(line.expression)
        names[line.symbol] = f"w{len(names)}"
        body.append(f"    {names[line.symbol]} = {text}")
    results = [printer.text(sp.sympify(o)) for o in outputs]
    source = "\n".join(
        [
            f"def run({', '.join(names[s] for s in inputs)}):",
            *body,
            f"    return [{', '.join(results)}]",
        ]
    )
    scope: dict[str, Any] = dict(printer.constants)
    exec(compile(source, "<undertow outward>", "exec"), scope)
    return cast(OutwardFunction, scope["run"])
