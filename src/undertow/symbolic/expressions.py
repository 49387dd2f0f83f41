"""SymPy's ``srepr`` read back as data: a grammar of names and numbers, and nothing that runs."""

from __future__ import annotations

import ast
from typing import Any

import sympy as sp
from sympy.core.function import FunctionClass

#: What takes texts: names, and decimal digits.  Everything else would hand a text to SymPy's
#: parser, which evaluates it.
_OF_TEXT = ("Symbol", "Dummy", "Float")

_MATRICES = ("ImmutableDenseMatrix", "MutableDenseMatrix")


def parse_expression(text: str) -> Any:
    """Return the expression or matrix that ``sympy.srepr`` wrote.

    The text is calls of SymPy's own classes on numbers, texts and lists, nested. Raises ValueError
    for anything else.
    """
    return _made(ast.parse(text.strip(), mode="eval").body)


def _made(node: ast.expr) -> Any:
    match node:
        case ast.Call(func=ast.Name(id=name)):
            return _called(name, node)
        case ast.Name(id=name):
            return _constant(name)
        case ast.List(elts=parts):
            return [_made(part) for part in parts]
        case ast.Tuple(elts=parts):
            return tuple(_made(part) for part in parts)
        case ast.UnaryOp(op=ast.USub(), operand=ast.Constant(value=int() | float() as value)):
            return -value
        case ast.Constant(value=int() | float() as value):  # truth values are numbers too
            return value
    raise ValueError(f"no part of an expression: {ast.dump(node)[:80]}")


def _called(name: str, node: ast.Call) -> Any:
    made: Any = getattr(sp, name, None)
    plain = isinstance(made, FunctionClass) or (
        isinstance(made, type) and issubclass(made, sp.Basic)
    )
    if not (plain or name in _MATRICES):
        raise ValueError(f"no class of expressions: {name}")
    arguments = [
        part.value
        if name in _OF_TEXT and isinstance(part, ast.Constant) and isinstance(part.value, str)
        else _made(part)
        for part in node.args
    ]
    return made(*arguments, **{word.arg or "": _made(word.value) for word in node.keywords})


def _constant(name: str) -> Any:
    """Return one of SymPy's constants, such as pi, E, oo or true."""
    value = getattr(sp, name, None)
    if not isinstance(value, sp.Basic):
        raise ValueError(f"no constant: {name}")
    return value
