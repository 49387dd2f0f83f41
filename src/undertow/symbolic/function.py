"""Tape to one scalar numba function: arrays in, arrays filled, nothing allocated.

For code that runs once a sample, where :mod:`undertow.closed_loop.kernel_source` is for batches.
"""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from types import ModuleType

import sympy as sp

from undertow.symbolic.names import distinct, docstring
from undertow.symbolic.scalar import Emitter
from undertow.symbolic.store import content_key, generated
from undertow.symbolic.tape import Tape

#: Head of a generated module.
PREAMBLE = (
    "import math\n\nimport numba\nimport numpy as np\n"
    "from undertow.symbolic.compiler import brief, compiled\n"
)

#: Decorator of every function that is compiled: no lock of the interpreter, no exceptions.  What
#: another one calls is inlined there: else the process that compiles it calls it in its own
#: library, later ones the copy that was stored with its caller, and the two round otherwise.  Every
#: operation is rounded by itself: which ones a compiler would fuse depends on what went before.
COMPILED = "@compiled(forceinline=True, small=True)"


def function_source(
    name: str,
    tape: Tape,
    inputs: Mapping[str, Sequence[sp.Symbol] | sp.Symbol],
    outputs: Mapping[str, Sequence[sp.Expr]],
) -> str:
    """Return the source of ``name(*inputs, *outputs)``, compiled by numba when it is imported.

    ``inputs`` take the name of an argument to the symbols that its entries stand for, in order, or
    to the one symbol that it stands for as a number; ``outputs`` to the expressions that fill its
    entries: one-dimensional float arrays, written last, so that an output may be the same array as
    an input.
    """
    places = [place for group in inputs.items() for place in _places(*group)]
    distinct(symbol for symbol, _ in places)
    emit = Emitter(tape)
    wanted = [expression for group in outputs.values() for expression in group]
    code, needs = emit.lines(wanted, set())
    loads = [f"{emit.text(symbol)} = {place}" for symbol, place in places if symbol in needs]
    stores = [
        f"{argument}[{j}] = {emit.text(expression)}"
        for argument, group in outputs.items()
        for j, expression in enumerate(group)
    ]
    body = "\n".join([*loads, *code, *stores])
    arguments = ", ".join([*inputs, *outputs])
    return f"{COMPILED}\ndef {name}({arguments}):\n{textwrap.indent(body, '    ')}\n"


def scalar_module(
    kind: str,
    title: str,
    name: str,
    depends: Iterable[str],
    functions: Callable[[], Iterable[str]],
    head: str = "",
) -> ModuleType:
    """Import a module of scalar functions, writing its source only where none is kept.

    ``kind``, and the ``name`` of the mechanism, are the module's; the ``title`` begins its
    docstring.  ``depends``: texts, all that its source depends on besides the name; ``head``:
    further imports, and constants; ``functions`` returns the sources of its functions.
    """
    key = content_key(*depends, name)

    def write() -> str:
        # numba's cache does not notice that an imported function has changed: the key does.
        stamp = f" {key[:16]}" if "import" in head else ""
        words = docstring(f"{title} of {name}; generated, do not edit.{stamp}")
        return "\n\n".join([f"{words}{PREAMBLE}{head}", *functions()])

    return generated(kind, name, key, write)


def _places(argument: str, symbols: Sequence[sp.Symbol] | sp.Symbol) -> list[tuple[sp.Symbol, str]]:
    """Return the symbols of an argument, each with where it is found."""
    if isinstance(symbols, sp.Symbol):
        return [(symbols, argument)]
    return [(symbol, f"{argument}[{j}]") for j, symbol in enumerate(symbols)]
