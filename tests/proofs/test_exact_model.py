"""The model that a proof is about: floats are the rational numbers that they are."""

from __future__ import annotations

import sympy as sp

from undertow.proofs.exact_model import is_odd


def test_parity_is_shown_symbolically() -> None:
    x, y = sp.symbols("x y", real=True)
    assert is_odd([sp.sin(x), x**3 * y**2], [x, y], [sp.cos(x), x * y])
    assert not is_odd([sp.sin(x), x**2], [x, y])
    assert not is_odd([sp.sin(x)], [x, y], [x])
    assert is_odd([sp.sin(x) * y], [x])
