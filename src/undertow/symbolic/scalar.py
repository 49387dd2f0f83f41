"""Tape lines to scalar Python code that numba turns into vector arithmetic.

Sines and cosines are inlined as polynomials: numba's wheels bring no vector library, and a
call would keep the lane loops from being vectorised.  After a two-part reduction to
|r| ≤ π/4 the polynomials are fdlibm's kernels, summed by pairs (Estrin's scheme) so that fewer
operations wait for one another; the error stays below 2e-15 for |angle| up to 1e5 rad.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import reduce
from typing import Any

import sympy as sp
from sympy.printing.codeprinter import CodePrinter
from sympy.printing.pycode import PythonCodePrinter

from undertow.symbolic.names import SymbolNames
from undertow.symbolic.tape import Tape

#: Template of one sine-cosine evaluation: ``_sin_{i}`` and ``_cos_{i}`` of ``{arg}``.
SINCOS = """
k_{i} = np.floor({arg} * 0.6366197723675814 + 0.5)
r_{i} = ({arg} - k_{i} * 1.5707963267341256) - k_{i} * 6.077100506506192e-11
z_{i} = r_{i} * r_{i}
zz_{i} = z_{i} * z_{i}
ps_{i} = r_{i} + r_{i} * z_{i} * ((-0.16666666666666632 + z_{i} * 0.00833333333332249) + zz_{i} * ((-0.0001984126982985795 + z_{i} * 2.7557313707070068e-06) + zz_{i} * (-2.5050760253406863e-08 + z_{i} * 1.58969099521155e-10)))
pc_{i} = (1.0 - 0.5 * z_{i}) + zz_{i} * ((0.0416666666666666 + z_{i} * -0.001388888888887411) + zz_{i} * ((2.480158728947673e-05 + z_{i} * -2.7557314351390663e-07) + zz_{i} * (2.087572321298175e-09 + z_{i} * -1.1359647557788195e-11)))
h_{i} = np.floor(k_{i} * 0.5)
o_{i} = k_{i} - 2.0 * h_{i}
g_{i} = 1.0 - 2.0 * (h_{i} - 2.0 * np.floor(h_{i} * 0.5))
_sin_{i} = g_{i} * (ps_{i} if o_{i} == 0.0 else pc_{i})
_cos_{i} = g_{i} * (1.0 - 2.0 * o_{i}) * (pc_{i} if o_{i} == 0.0 else ps_{i})
""".strip()  # noqa: E501


class ScalarCode:
    """Scalar arithmetic as a printer of SymPy's writes it: powers multiplied out, names by place.

    ``names``: of symbols. ``functions``: the language's square root, power, maximum and minimum of
    two.
    """

    names: SymbolNames
    functions: tuple[str, str, str, str]
    _print: Any
    parenthesize: Any

    def literal(self, value: sp.Expr | float) -> str:
        """Return a number as the language writes it."""
        return f"{int(value)}.0" if isinstance(value, sp.Integer) else repr(float(value))

    def _print_Pow(self, expr: sp.Pow, **_: object) -> str:
        base, exponent = expr.args
        root, power, *_more = self.functions
        one = self.literal(1.0)
        if exponent == sp.Rational(1, 2):
            return f"{root}({self._print(base)})"
        if exponent == sp.Rational(-1, 2):
            return f"({one} / {root}({self._print(base)}))"
        if exponent.is_Integer and 0 < abs(int(exponent)) <= 16:
            product = " * ".join([self.parenthesize(base, 100)] * abs(int(exponent)))
            return f"({product})" if int(exponent) > 0 else f"({one} / ({product}))"
        return f"{power}({self._print(base)}, {self._print(exponent)})"

    def _print_Symbol(self, expr: sp.Symbol) -> str:
        return self.names[expr]

    def _print_number(self, expr: sp.Expr) -> str:
        return self.literal(expr)

    _print_Integer = _print_Rational = _print_Float = _print_number  # noqa: N815 - SymPy's names

    def _print_Max(self, expr: sp.Max) -> str:
        return self._nest(self.functions[2], expr.args)

    def _print_Min(self, expr: sp.Min) -> str:
        return self._nest(self.functions[3], expr.args)

    def _nest(self, name: str, args: Sequence[sp.Expr]) -> str:
        return reduce(
            lambda text, arg: f"{name}({text}, {self._print(arg)})",
            args[1:],
            str(self._print(args[0])),
        )


class _Printer(ScalarCode, PythonCodePrinter):  # type: ignore[misc]  # SymPy is untyped
    """Python code that numba turns into vector arithmetic."""

    functions = "math.sqrt", "math.pow", "max", "min"

    def __init__(self, names: SymbolNames) -> None:
        super().__init__({"fully_qualified_modules": True})
        self.names = names

    def _print_Abs(self, expr: sp.Abs) -> str:
        return f"abs({self._print(expr.args[0])})"

    def _print_sign(self, expr: sp.sign) -> str:
        x = self._print(expr.args[0])
        return f"((1.0 if {x} > 0.0 else 0.0) - (1.0 if {x} < 0.0 else 0.0))"

    def _print_frac(self, expr: sp.frac) -> str:
        # SymPy leaves out the brackets: x*frac(y) becomes (x*y) % 1.
        return f"(({self._print(expr.args[0])}) % 1.0)"


class Emitter:
    """Prints tape lines with one sine-cosine evaluation per distinct angle.

    A printer for another language overrides :meth:`language`, :meth:`assign` and :meth:`sincos`.

    Symbols in ``given`` have their text already; the others get names by their place, see
    :class:`undertow.symbolic.names.SymbolNames`.
    """

    def __init__(self, tape: Tape, given: Mapping[sp.Symbol, str] | None = None) -> None:
        self.tape = tape
        self.names = SymbolNames(tape, given or {})
        self.printer = self.language()
        self.angles: dict[sp.Expr, int] = {}

    def language(self) -> CodePrinter:
        """Return the printer of expressions."""
        return _Printer(self.names)

    def lines(
        self, outputs: Iterable[sp.Expr], given: set[sp.Symbol]
    ) -> tuple[list[str], set[sp.Symbol]]:
        """Return code lines for all live assignments that are not ``given``."""
        outputs = [sp.sympify(o) for o in outputs]
        needed: set[sp.Basic] = set().union(*(o.free_symbols for o in outputs))
        kept = []
        for line in reversed(self.tape.assignments):
            if line.symbol in needed and line.symbol not in given:
                kept.append(line)
                needed |= line.expression.free_symbols
        wanted = {call for line in kept for call in line.expression.atoms(sp.sin, sp.cos)}
        code: list[str] = []
        done: set[sp.Expr] = set()
        for line in reversed(kept):
            expression = line.expression
            for call in sorted(expression.atoms(sp.sin, sp.cos), key=str):
                angle = call.args[0]
                index = self.angles.setdefault(angle, len(self.angles))
                if angle not in done:
                    done.add(angle)
                    argument = self.text(angle)
                    if not angle.is_Symbol:
                        code.append(self.assign(f"angle_{index}", argument))
                        argument = f"angle_{index}"
                    code += self.sincos(
                        index, argument, sp.sin(angle) in wanted, sp.cos(angle) in wanted
                    )
                name = "sin" if isinstance(call, sp.sin) else "cos"
                value = sp.Symbol(f"_{name}_{index}", real=True)
                self.names.own(value)
                expression = expression.xreplace({call: value})
            code.append(self.assign(self.names[line.symbol], self.text(expression)))
        return code, {s for s in needed if isinstance(s, sp.Symbol)}

    def assign(self, name: str, text: str) -> str:
        """Return the line that gives a new name to a value."""
        return f"{name} = {text}"

    def sincos(self, index: int, argument: str, sine: bool, cosine: bool) -> list[str]:
        """Return the lines that define ``_sin_{index}`` and ``_cos_{index}``, as asked for."""
        del sine, cosine  # the polynomials come together; what is not used is dropped later
        return SINCOS.format(i=index, arg=argument).splitlines()

    def text(self, expression: sp.Expr) -> str:
        """Print one expression."""
        return str(self.printer.doprint(sp.sympify(expression)))
