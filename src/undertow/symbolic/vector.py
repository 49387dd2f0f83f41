"""Expressions to NumPy functions: every argument and result broadcasts over batches."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import sympy as sp
from sympy.printing.numpy import NumPyPrinter

from undertow.base import ModelError
from undertow.symbolic.names import SymbolNames, distinct
from undertow.symbolic.tape import Tape

#: A compiled tape: called with one array per input, returns one array per output.
VectorFunction = Callable[..., list[Any]]


class _Printer(NumPyPrinter):  # type: ignore[misc]  # SymPy is untyped
    """NumPy expressions in the names that are given."""

    def __init__(self, names: SymbolNames) -> None:
        super().__init__({"fully_qualified_modules": True, "allow_unknown_functions": False})
        self.names = names

    def _print_Symbol(self, expr: sp.Symbol) -> str:
        return self.names[expr]


def compile_numpy(
    tape: Tape, inputs: Sequence[sp.Symbol], outputs: Sequence[sp.Expr]
) -> VectorFunction:
    """Return a function of ``inputs`` (arrays that broadcast) giving a list of ``outputs``.

    Raises ModelError for a symbol that is neither an input nor on the tape.
    """
    given = {s: sp.Symbol(f"a{i}", real=True) for i, s in enumerate(distinct(inputs))}
    lines = tape.live(outputs)
    results = [sp.sympify(o) for o in outputs]
    needed: set[sp.Basic] = set().union(*(e.free_symbols for e in results))
    needed |= set().union(*(line.expression.free_symbols for line in lines))
    _refuse(needed - given.keys() - {line.symbol for line in lines})
    printer = _Printer(SymbolNames(tape, {s: s.name for s in given.values()}))

    def text(expression: sp.Expr) -> str:
        return str(printer.doprint(expression.xreplace(given)))

    body = [f"{line.symbol} = {text(line.expression)}" for line in lines]
    return _function([s.name for s in given.values()], body, [text(e) for e in results])


def compile_expressions(
    inputs: Sequence[sp.Symbol], outputs: Sequence[sp.Expr | float]
) -> VectorFunction:
    """Return a function of ``inputs`` giving ``outputs``, each evaluated as it is written.

    Where :func:`compile_numpy` shares what outputs have in common, this keeps the order of
    operations that SymPy prints. Raises ModelError for a symbol that is no input.
    """
    results = [sp.sympify(o) for o in outputs]
    _refuse(set().union(*(e.free_symbols for e in results)) - set(inputs))
    given = {s: f"a{i}" for i, s in enumerate(distinct(inputs))}
    printer = _Printer(SymbolNames(Tape(), given))
    return _function(list(given.values()), [], [printer.doprint(e) for e in results])


def _refuse(unknown: set[sp.Basic]) -> None:
    if unknown:
        raise ModelError(
            "expression to be compiled",
            value=f"unknown symbols {', '.join(sorted(map(str, unknown)))}",
            limit="those of its inputs",
            remedy="Use the symbols of the mechanism: coordinate.symbol, parameter.symbol",
        )


def _function(arguments: list[str], body: list[str], results: list[str]) -> VectorFunction:
    source = "\n    ".join(
        [f"def run({', '.join(arguments)}):", *body, f"return [{', '.join(results)}]"]
    )
    # SymPy prints Max and Min as functools.reduce over NumPy's ufuncs.
    scope: dict[str, Any] = {"numpy": np, "functools": functools}
    exec(compile(source, "<undertow tape>", "exec"), scope)
    function: VectorFunction = scope["run"]
    return function
