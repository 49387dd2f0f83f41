"""Tape to a NumPy function: every argument and result broadcasts over batches."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import sympy as sp
from sympy.printing.numpy import NumPyPrinter

from undertow.codegen.tape import Tape

__all__ = ["compile_numpy"]

#: A compiled tape: called with one array per input, returns one array per output.
VectorFunction = Callable[..., list[Any]]


def compile_numpy(
    tape: Tape, inputs: Sequence[sp.Symbol], outputs: Sequence[sp.Expr]
) -> VectorFunction:
    """Return a function of ``inputs`` (arrays that broadcast) giving a list of ``outputs``."""
    printer = NumPyPrinter({"fully_qualified_modules": True, "allow_unknown_functions": False})
    names = {s: sp.Symbol(f"a{i}", real=True) for i, s in enumerate(inputs)}
    body = [
        f"    {line.symbol} = {printer.doprint(line.expression.xreplace(names))}"
        for line in tape.live(outputs)
    ]
    results = ", ".join(printer.doprint(sp.sympify(o).xreplace(names)) for o in outputs)
    source = "\n".join(
        [f"def run({', '.join(str(names[s]) for s in inputs)}):", *body, f"    return [{results}]"]
    )
    # SymPy prints Max and Min as functools.reduce over NumPy's ufuncs.
    scope: dict[str, Any] = {"numpy": np, "functools": functools}
    exec(compile(source, "<undertow tape>", "exec"), scope)
    function: VectorFunction = scope["run"]
    return function
