"""Tape to C99: straight-line assignments without loops, branches or calls but math.h's.

Products and powers associate as in the Python printers, so that a compiler that keeps to IEEE
arithmetic (no ``-ffast-math``, no contraction) differs from them by the rounding of sines and
cosines alone.  Names that begin with ``ut_`` are those of the templates of
:mod:`undertow.export`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np
import sympy as sp
from sympy.codegen.ast import float32, real
from sympy.printing.c import C99CodePrinter
from sympy.printing.codeprinter import CodePrinter, PrintMethodNotImplementedError

from undertow.base import ModelError
from undertow.symbolic.names import SymbolNames
from undertow.symbolic.scalar import Emitter, ScalarCode
from undertow.symbolic.tape import Tape

Real = Literal["double", "float"]


def literal(value: float, kind: Real) -> str:
    """Return a finite number as a C literal; in single precision no other zero but 0 itself."""
    if kind == "double":
        return repr(float(value))
    smallest = float(np.finfo(np.float32).tiny)
    if 0 < abs(value) < smallest:
        value = float(np.copysign(smallest, value))
    if not abs(value) <= float(np.finfo(np.float32).max):
        raise ModelError(
            "number in single precision",
            value=f"{value:g}",
            limit="below 3.4e38",
            remedy="Export in double precision",
        )
    return f"{float(str(np.float32(value)))!r}f"


class _Printer(ScalarCode, C99CodePrinter):  # type: ignore[misc]  # SymPy is untyped
    """C99 expressions on one line, every literal of the chosen precision."""

    def __init__(self, names: SymbolNames, kind: Real) -> None:
        settings: dict[str, object] = {"allow_unknown_functions": False, "strict": True}
        if kind == "float":
            settings["type_aliases"] = {real: float32}
        super().__init__(settings)
        self.names = names
        self.kind: Real = kind
        suffix = "f" * (kind == "float")
        self.functions = f"sqrt{suffix}", f"pow{suffix}", "ut_max", "ut_min"

    def literal(self, value: sp.Expr | float) -> str:
        """Return a number in the chosen precision."""
        return literal(float(value), self.kind)

    _print_NumberSymbol = _print_Pi = _print_Exp1 = ScalarCode._print_number  # noqa: N815

    def _print_sign(self, expr: sp.sign) -> str:
        return f"ut_sign({self._print(expr.args[0])})"

    def _print_Mod(self, expr: sp.Mod) -> str:
        # C's remainder has the sign of a, SymPy's and Python's that of b.
        a, b = map(self._print, expr.args)
        return f"ut_mod(fmod{'f' * (self.kind == 'float')}({a}, {b}), {b})"

    def _print_Piecewise(self, expr: sp.Piecewise) -> str:
        text = ""
        for value, condition in expr.args:
            if condition == sp.true:
                return f"({text}{self._print(value)})"
            text += f"({self._print(condition)}) ? {self._print(value)} : "
        raise ModelError(
            "piecewise expression in C",
            value=str(expr),
            limit="a value for every case",
            remedy="End it with (value, True)",
        )


class C99Emitter(Emitter):
    """Prints tape lines as C declarations of ``const ut_real``.

    Symbols from outside have C text in ``names``: an element of an array, a macro. ``kind``,
    ``"double"`` or ``"float"``, is that of literals and of math.h's functions.
    """

    def __init__(self, tape: Tape, names: Mapping[sp.Symbol, str], kind: Real = "double") -> None:
        self.kind: Real = kind
        super().__init__(tape, names)

    def language(self) -> CodePrinter:
        """Return the printer of C."""
        return _Printer(self.names, self.kind)

    def assign(self, name: str, text: str) -> str:
        """Return a declaration."""
        return f"const ut_real {name} = {text};"

    def sincos(self, index: int, argument: str, sine: bool, cosine: bool) -> list[str]:
        """Return calls of math.h, only those that are used."""
        suffix = "f" * (self.kind == "float")
        wanted = [name for name, asked in (("sin", sine), ("cos", cosine)) if asked]
        return [self.assign(f"_{name}_{index}", f"{name}{suffix}({argument})") for name in wanted]

    def text(self, expression: sp.Expr) -> str:
        """Print one expression.

        Raises ModelError for a function that C99 does not know.
        """
        try:
            return super().text(expression)
        except PrintMethodNotImplementedError as error:
            raise ModelError(
                "expression in C",
                value=str(expression),
                limit="functions of C99's math.h",
                remedy="Write the model with elementary functions",
            ) from error

    def statements(self, results: Mapping[str, sp.Expr]) -> str:
        """Return the code that computes expressions and stores each at a C place.

        Stores come last, so that a result may lie where an input lay.
        """
        code, _ = self.lines(results.values(), set())
        stores = [f"{place} = {self.text(value)};" for place, value in results.items()]
        return "\n".join(f"    {line}" for line in [*code, *stores])
