"""Loops whose names are assigned once: the same values, and what must stay stays."""

from __future__ import annotations

import ast

import numpy as np

from undertow.symbolic import PRIMITIVES, load_module
from undertow.symbolic.single_assignment import single_assignment

SOURCE = f"""import math
import numba
{PRIMITIVES}

@numba.njit
def straight(x, out):
    total, last, kept = 0.0, 0.0, 0.0
    for i in range(len(x)):
        y = x[i]
        y = y / 2.0 if y > 0.0 and y < 3.0 else -y
        last = y if y > last else last
        a, b = y, x[i]
        a, b = b, a
        total += a
        out[i] += b - 2.0 * a
    for i in range(len(x)):
        y = 1.0 if x[i] < 0.0 or x[i] > 2.0 else 0.0
        kept = y
        total += y
    return total, last, kept
"""


def test_values_stay() -> None:
    """In compiled code as in plain Python: sums, the largest, exchanged names, and arrays."""
    plain: dict[str, object] = {}
    exec(SOURCE.replace("@numba.njit", "").replace(PRIMITIVES, ""), plain)
    compiled = load_module("straight", single_assignment(SOURCE)).straight
    x = np.array([0.5, -1.0, 2.5, 4.0, -0.25])
    first, second = np.ones(5), np.ones(5)
    assert plain["straight"](x, first) == compiled(x, second)  # type: ignore[operator]
    assert (first == second).all()


def test_names_of_a_loop_are_assigned_once() -> None:
    """Except sums, and names that are read behind the loop."""
    tree = ast.parse(single_assignment(SOURCE))
    stored = [
        node.id
        for node in ast.walk(tree)
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)
    ]
    assert {name for name in stored if stored.count(name) > 1} == {"total", "last", "kept"}
    assert not any(isinstance(node, ast.IfExp | ast.BoolOp) for node in ast.walk(tree))


def test_memory_holds_numbers_until_a_function_returns() -> None:
    """In compiled code as in plain Python, two of them apart."""
    source = f"""import numba
{PRIMITIVES}

@compiled(cache=False)
def turned(x):
    first, second, total = memory(24), memory(3), 0.0
    for i in range(24):
        first[i] = x[i]
    for i in range(3):
        second[i] = -1.0
    for i in range(24):
        total += first[23 - i] * x[i] + second[i % 3]
    return total
"""
    module = load_module("memory", source)
    x = np.arange(24.0)
    assert module.turned(x) == module.turned.py_func(x) == x @ x[::-1] - 24
