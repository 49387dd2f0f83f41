"""Outward-rounded evaluation of expressions: balls (python-flint) and batches of intervals.

A tape becomes a Python function that uses nothing but ``+ - * / **`` and methods such as
``.sin()``; it runs on any number type that has them:

* python-flint's ``arb``: a ball of any precision that contains the true value;
* :class:`undertow.proofs.intervals.batch.Interval`: a batch of intervals in NumPy float64, for
  branch and bound.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import Any, Protocol, cast

import sympy as sp

from undertow.base.errors import InvalidInputError, MissingExtraError
from undertow.symbolic import Tape
from undertow.symbolic.tape import Assignment

#: One call's arguments and results: arb balls, or Intervals.
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


# -- expressions to functions of outward-rounded numbers ---------------------------------


class Arithmetic(Protocol):
    """Makes the constants of one number type."""

    def rational(self, value: Fraction) -> Any:
        """Return an enclosure of a rational number."""

    def pi(self) -> Any:
        """Return an enclosure of π."""


class BallArithmetic:
    """Constants as arb balls, at the precision set in ``flint.ctx``."""

    def rational(self, value: Fraction) -> Any:
        """Return an arb."""
        return ball(value)

    def pi(self) -> Any:
        """Return an arb."""
        return flint().arb.pi()


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

    def __init__(self, arithmetic: Arithmetic, names: dict[sp.Symbol, str]) -> None:
        self.arithmetic = arithmetic
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
            return self.constant(key, self.arithmetic.rational(value))
        if e is sp.pi:
            return self.constant("c_pi", self.arithmetic.pi())
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
    arithmetic: Arithmetic | None = None,
) -> OutwardFunction:
    """Return a function of ``inputs`` (arb balls by default) giving a list of ``outputs``.

    Parameters
    ----------
    tape
        The program; only what the outputs depend on runs.
    inputs
        Symbols that stay arguments, in the order of the call.
    outputs
        Atoms of the tape, or small expressions of them.
    arithmetic
        Balls by default; ``IntervalArithmetic()`` for batches.

    Raises
    ------
    MissingExtraError
        For balls without python-flint.
    InvalidInputError
        For a function that has no outward-rounded form here.
    """
    kind = BallArithmetic() if arithmetic is None else arithmetic
    if arithmetic is None:
        flint()
    names = {s: f"a{i}" for i, s in enumerate(inputs)}
    printer = _Printer(kind, names)
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


def derivative_tape(tape: Tape, variables: Sequence[sp.Symbol], output: sp.Expr) -> list[sp.Expr]:
    """Lay ∂output/∂variables on the same tape by forward differentiation of its lines.

    The chain rule on the short lines keeps the code short where differentiating the
    whole expression would not.

    Returns
    -------
    list of sympy.Expr
        One atom (or 0) per variable.
    """
    lines: list[Assignment] = tape.live([output])
    gradients = []
    for variable in variables:
        known: dict[sp.Symbol, sp.Expr] = {variable: sp.Integer(1)}
        for symbol, expression in lines:
            total = sp.Integer(0)
            for inner in sorted(expression.free_symbols & known.keys(), key=str):
                total += sp.diff(expression, inner) * known[inner]
            if total != 0:
                known[symbol] = tape.let(total)
        gradients.append(tape.let(_chain(output, known)))
    return gradients


def _chain(output: sp.Expr, known: dict[sp.Symbol, sp.Expr]) -> sp.Expr:
    output = sp.sympify(output)
    symbols = sorted(output.free_symbols & known.keys(), key=str)
    return sum((sp.diff(output, s) * known[s] for s in symbols), sp.Integer(0))
