"""The model that a proof is about: smooth, with every float the rational number that it is.

SymPy computes with floats of 53 bits: 2⁵³ + 1 − 2⁵³ is 0, and then an equilibrium seems to be
where there is none.  It gives a derivative to what has none: that of |x| at 0 is 0.  So a model
is made exact, and what is not smooth is refused, before anything symbolic is done with it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from fractions import Fraction
from functools import lru_cache

import numpy as np
import sympy as sp
from numpy.typing import ArrayLike

from undertow.base.arguments import require
from undertow.base.errors import InvalidInputError
from undertow.models.mechanism import TIME, Mechanism
from undertow.models.validity import require_smooth


def exact_fraction(expression: sp.Expr) -> Fraction:
    """Return the exact value of a SymPy number: a Float counts as the binary number it is.

    Raises InvalidInputError for a number that is not rational.
    """
    if expression.is_Float:
        sign, mantissa, exponent, _ = expression._mpf_
        return Fraction((-1) ** sign * int(mantissa)) * Fraction(2) ** int(exponent)
    if expression.is_Rational:
        return Fraction(int(expression.p), int(expression.q))
    raise InvalidInputError("exact value", value=str(expression), limit="a rational number")


def exact_number(value: float) -> sp.Rational:
    """Return the rational number that a float is."""
    return sp.Rational(*float(value).as_integer_ratio())


def exact_matrix(block: ArrayLike) -> sp.Matrix:
    """Return a matrix of the rational numbers that the floats are."""
    array = np.asarray(block, dtype=float)
    return sp.Matrix(*array.shape, [exact_number(v) for v in array.ravel()])


def exact_expression(expression: sp.Expr) -> sp.Expr:
    """Replace floats by the rational numbers that they are."""
    floats = expression.atoms(sp.Float)
    exact = {f: sp.Rational(*exact_fraction(f).as_integer_ratio()) for f in floats}
    return expression.xreplace(exact)


@lru_cache(maxsize=64)
def exact_mechanism(mechanism: Mechanism) -> Mechanism:
    """Return the mechanism with exact expressions; itself where they hold no floats.

    Raises ModelError for expressions that are not smooth, everywhere or at the target.
    """
    blocks = ("mass_matrix", "force", "input_matrix")
    values = {p.symbol: p.value for p in mechanism.parameters}
    target = dict.fromkeys((*mechanism.x, TIME), 0.0) | values
    exact = {name: getattr(mechanism, name).applyfunc(exact_expression) for name in blocks}
    for name, matrix in exact.items():
        what = f"{name} of '{mechanism.name}'"
        require_smooth(what, matrix, mechanism.x, orders=2)
        require_smooth(what, matrix, mechanism.x, at=target, orders=2)
    changed = {k: v for k, v in exact.items() if v != getattr(mechanism, k)}
    return replace(mechanism, **changed) if changed else mechanism


def is_odd(
    odd: Iterable[sp.Expr], symbols: Iterable[sp.Symbol], even: Iterable[sp.Expr] = ()
) -> bool:
    """Whether expressions change their sign with that of the symbols, and others do not at all."""
    flip = {x: -x for x in symbols}
    rest = [e - e.xreplace(flip) for e in even] + [e + e.xreplace(flip) for e in odd]
    return all(sp.expand(e) == 0 for e in rest)


def require_autonomous(mechanism: Mechanism, proved: str) -> None:
    """Refuse a force that depends on time."""
    remedy = f"Prove the {proved} for the undisturbed mechanism"
    good = TIME not in mechanism.force.free_symbols
    require(good, f"force of '{mechanism.name}'", "depends on time", "autonomous", remedy)
