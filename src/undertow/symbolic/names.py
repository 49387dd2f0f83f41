"""Names of symbols in generated code: by their place, never by what a user calls them.

A name that a user chose may be a word of the language, a name that a template uses, longer than
a compiler reads, or one that Python takes for another (it compares identifiers by their NFKC
form).  None of them is therefore ever printed.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import sympy as sp

from undertow.base import ModelError
from undertow.symbolic.tape import Tape


class SymbolNames:
    """Symbols to their names in one piece of generated code.

    The symbols of the tape's lines, and those that are declared with :meth:`own`, keep their
    names: generators made them up.  ``given`` ones have the text that is given; all others are
    ``_p0``, ``_p1``, … in the order in which they are first asked for.

    Examples
    --------
    >>> import sympy as sp
    >>> a, b = sp.symbols("lambda µ")
    >>> tape = Tape()
    >>> names = SymbolNames(tape, {})
    >>> names[tape.let(a * b)], names[b], names[a], names[b]
    ('_v0', '_p0', '_p1', '_p0')
    """

    def __init__(self, tape: Tape, given: Mapping[sp.Symbol, str]) -> None:
        self._tape, self._given = tape, given
        self._own: set[sp.Symbol] = set()
        self._lines = 0
        self._others: dict[sp.Symbol, str] = {}

    def own(self, symbol: sp.Symbol) -> None:
        """Let a symbol that a generator made up keep its name."""
        self._own.add(symbol)

    def __getitem__(self, symbol: sp.Symbol) -> str:
        """Return the name of a symbol."""
        if symbol in self._given:
            return self._given[symbol]
        for line in self._tape.assignments[self._lines :]:
            self._own.add(line.symbol)
        self._lines = len(self._tape.assignments)
        if symbol in self._own:
            return str(symbol.name)
        return self._others.setdefault(symbol, f"_p{len(self._others)}")


def distinct(symbols: Iterable[sp.Symbol]) -> list[sp.Symbol]:
    """Return the inputs of generated code, refusing a symbol that would stand for two of them.

    Raises ModelError with the symbol that occurs twice.
    """
    listed = list(symbols)
    repeated = sorted({str(s) for s in listed if listed.count(s) > 1})
    if repeated:
        raise ModelError(
            "inputs of generated code",
            value=f"{', '.join(repeated)} twice",
            limit="a symbol for each",
            remedy="Give coordinates, inputs and parameters different names",
        )
    return listed


def docstring(text: str) -> str:
    r"""Return words, whatever they hold, as the docstring of a generated module.

    >>> docstring('rig of "a"')
    '\'rig of "a"\'\n\n'
    """
    return f"{text!a}\n\n"
