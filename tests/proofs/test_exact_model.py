"""The model that a proof is about: floats are the rational numbers that they are."""

from __future__ import annotations

import math

import pytest
import sympy as sp

from undertow.base import ModelError
from undertow.proofs.claims.model_data import _Writer
from undertow.proofs.exact_model import is_odd
from undertow.proofs.kernel.reader import number


def test_parity_is_shown_symbolically() -> None:
    x, y = sp.symbols("x y", real=True)
    assert is_odd([sp.sin(x), x**3 * y**2], [x, y], [sp.cos(x), x * y])
    assert not is_odd([sp.sin(x), x**2], [x, y])
    assert not is_odd([sp.sin(x)], [x, y], [x])
    assert is_odd([sp.sin(x) * y], [x])


@pytest.mark.parametrize("exponent", ["3", "-1", "-2", "1/2", "-1/2", "-5/2"])
def test_whole_and_half_powers_are_written_as_what_they_are(exponent: str) -> None:
    """Of either sign, alone and as a factor: evaluated node by node they give the same number."""
    x = sp.Symbol("x", real=True)
    power = (x + 2) ** sp.Rational(exponent)
    for expression in (power, x * power):
        graph = _Writer({x: ["x"]}, {})
        last = graph.of(expression)
        values: list[float] = []
        for word, *data in graph.nodes:
            values.append(_value(word, data, values))
        assert values[last] == pytest.approx(float(expression.subs(x, 0.25)), rel=1e-15)


@pytest.mark.parametrize("exponent", ["1/3", "3/4", "-3/4", "65"])
def test_other_powers_are_refused(exponent: str) -> None:
    x = sp.Symbol("x", real=True)
    with pytest.raises(ModelError, match="whole or half"):
        _Writer({x: ["x"]}, {}).of((x + 2) ** sp.Rational(exponent))


def _value(word: str, data: list[int], values: list[float]) -> float:
    """The value of a node of a graph at x = 0.25."""
    if word == "x":
        return 0.25
    if word == "number":
        return float(number(data[0]))
    if word == "pow":
        return math.pow(values[data[0]], data[1])
    a, b = values[data[0]], values[data[-1]]
    return {"add": a + b, "mul": a * b, "div": a / b, "sqrt": math.sqrt(a)}[word]
