"""Plain lines past numba's front end: the same bits as numba's own, for any function."""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import Any, TypeVar

import numba
import numpy as np
import pytest

from support import rest_slow
from undertow.symbolic import compiled, load_module
from undertow.symbolic.compiler import UNSUITED

HEAD = """import math
import numpy as np
from undertow.symbolic.compiler import brief, compiled
from undertow.symbolic.primitives import select

TABLE = np.array([[0.5, -1.25], [3.0, 0.1]])
WHOLE = 3
"""


#: A line, or lines.
Written = TypeVar("Written")


class Program:
    """Writes a function of two arrays of reals, one of whole numbers, a real and a whole number."""

    def __init__(self, seed: int) -> None:
        self.random = random.Random(seed)
        self.reals, self.wholes = ["r", "p"], ["k"]
        self.depth, self.turns = 0, 0

    def source(self) -> str:
        """Return its text, without a decorator."""
        body = [
            "p, q, w, kept = 0.5, 1, 2, 0.0",
            *self.lines(7),
            f"return kept, q, {self.real(2)}, {self.truth(1)}",
        ]
        self.wholes += ["q", "w"]
        return "def f(a, b, n, r, k):\n" + "\n".join(f"    {line}" for line in body) + "\n"

    def pick(self, *choices: Callable[[], Written]) -> Written:
        """Return what one of several writes."""
        return self.random.choice(choices)()

    def real(self, depth: int) -> str:
        """Return an expression of reals."""
        if depth == 0:
            return self.pick(
                lambda: self.random.choice(self.reals),
                lambda: repr(self.random.choice([0.0, -1.5, 2.0, 1e-3, 7.25])),
                lambda: f"a[{self.place(4)}]",
                lambda: f"b[{self.place(3)}, {self.place(2)}]",
                lambda: f"TABLE[{self.place(2)}, 1]",
                lambda: "math.inf",
                lambda: self.random.choice(["k", "WHOLE", "q", "len(a)", "b.shape[1]", "a.size"]),
            )

        def one() -> str:
            return self.real(depth - 1)

        return self.pick(
            lambda: f"({one()} {self.random.choice('+-*/')} {one()})",
            lambda: f"-{one()}",
            lambda: f"({one()} if {self.truth(1)} else {one()})",
            lambda: f"select({self.truth(1)}, {one()}, {one()})",
            lambda: f"{self.random.choice(['max', 'min'])}({one()}, {one()})",
            lambda: f"{self.random.choice(['abs', 'math.sin', 'np.floor', 'float'])}({one()})",
            lambda: f"math.sqrt(abs({one()}))",
            lambda: f"abs({one()}) ** 1.5",
        )

    def whole(self) -> str:
        """Return an expression of whole numbers."""
        return self.pick(
            lambda: self.random.choice(["k", "q", "w", "WHOLE", "2", "-1", "n[0]", "n[1]"]),
            lambda: f"(k {self.random.choice('+-*')} {self.random.choice(['q', '2', 'n[1]'])})",
            lambda: f"(q {self.random.choice(['//', '%'])} {self.random.choice(['3', '-2', '5'])})",
            lambda: f"int({self.random.choice(['p', 'r', '2.75'])})",
        )

    def place(self, size: int) -> str:
        """Return an index that is inside, some from the end."""
        return self.pick(
            lambda: str(self.random.randrange(-size, size)),
            lambda: f"abs({self.whole()}) % {size}",
            lambda: f"-1 - abs({self.whole()}) % {size}",
        )

    def truth(self, depth: int) -> str:
        """Return a test."""
        sign = self.random.choice(["<", "<=", ">", ">=", "==", "!="])
        if depth == 0:
            return f"{self.real(0)} {sign} {self.real(0)}"
        return self.pick(
            lambda: f"({self.truth(depth - 1)} and {self.truth(depth - 1)})",
            lambda: f"({self.truth(depth - 1)} or {self.truth(depth - 1)})",
            lambda: f"(not {self.truth(depth - 1)})",
            lambda: f"({self.whole()} {sign} {self.whole()})",
            lambda: f"({self.real(0)} < {self.real(0)} <= {self.real(0)})",
        )

    def lines(self, count: int, *, loop: bool = False) -> list[str]:
        """Return lines; ``loop``: inside of a loop."""
        made: list[str] = []
        for _ in range(count):
            made += self.line(loop=loop)
        return made

    def line(self, *, loop: bool) -> list[str]:
        """Return a line with all that belongs to it."""
        simple: list[Callable[[], list[str]]] = [
            lambda: [f"p = {self.real(2)}"],
            lambda: [f"kept += {self.real(2)}"],
            lambda: [f"q = {self.whole()}"],
            lambda: [f"p, w = {self.real(1)}, {self.whole()}"],
            lambda: [f"a[{self.place(4)}] = {self.real(2)}"],
            lambda: [f"b[{self.place(3)}, {self.place(2)}] -= {self.real(1)}"],
            lambda: [f"n[{self.place(2)}] = ({self.whole()}) % 7"],
            lambda: [f"row = b[{self.place(3)}]", f"kept = row[{self.place(2)}]"],
            lambda: [f"view = a[{self.random.randrange(3)} :]", "kept += view[0]"],
            lambda: [f"y = {self.real(1)}", f"a[{self.place(4)}] = y * y"],
            lambda: [f"y = {self.real(0)}", f"if {self.truth(0)}:", "    y = 2.0", "kept -= y"],
        ]
        nested: list[Callable[[], list[str]]] = [
            lambda: self.block(f"if {self.truth(1)}:", loop=loop, other=True),
            lambda: self.block(f"for {self.counter()} in range({self.range()}):", loop=True),
            self.loop_while,
        ]
        if self.depth >= 3:
            nested = []
        if loop:
            nested.append(self.leave)
        return self.pick(*simple, *nested)

    def leave(self) -> list[str]:
        """Return a test after which a turn of a loop is over, or the loop."""
        return [f"if {self.truth(0)}:", f"    {self.random.choice(['break', 'continue'])}"]

    def loop_while(self) -> list[str]:
        """Return a loop that ends after four turns at the latest."""
        self.turns += 1
        turns, test = f"turns_{self.turns}", self.truth(0)
        inner = self.block(f"while {turns} < 4 and {test}:", loop=True, first=[f"{turns} += 1"])
        return [f"{turns} = 0", *inner]

    def counter(self) -> str:
        """Return a loop's counter."""
        return self.random.choice(["i", "j", "q"])

    def range(self) -> str:
        """Return the limits of a loop."""
        limits = ["4", "len(a)", "k", "1, 5", "5, -1, -2", "0, 6, 3", "b.shape[0]"]
        return self.random.choice(limits)

    def block(
        self, head: str, *, loop: bool, other: bool = False, first: list[str] | None = None
    ) -> list[str]:
        """Return a line that holds lines."""
        self.depth += 1
        made = [head, *(f"    {line}" for line in [*(first or []), *self.lines(3, loop=loop)])]
        if other and self.random.random() < 0.5:
            made += ["else:", *(f"    {line}" for line in self.lines(2, loop=loop))]
        self.depth -= 1
        return made


def _given() -> tuple[Any, ...]:
    a = np.array([0.5, -2.0, np.nan, 1e3])
    return a, np.arange(6.0).reshape(3, 2) - 2.5, np.array([1, 5]), 0.75, 3


def _bits(function: Any) -> list[Any]:
    given = _given()
    result = function(*given)
    return [np.asarray(each, dtype=float).tobytes() for each in (*result, *given[:3])]


@pytest.mark.parametrize("seed", rest_slow(range(40), 0))
def test_random_programs_give_the_bits_that_numba_gives(seed: int) -> None:
    """Loops, branches, elements and rows of arrays, whole numbers and reals, no numbers among them.

    Where numba itself refuses a program there is nothing to compare.
    """
    source = f"{HEAD}\n\n{Program(seed).source()}"
    plain = load_module(f"plain_{seed}", source).f
    usual = numba.njit(error_model="numpy")(plain)
    try:
        expected = _bits(usual)
    except numba.core.errors.NumbaError:
        pytest.skip("numba refuses it")
    before = len(UNSUITED)
    assert _bits(compiled(cache=False)(plain)) == expected, source
    assert UNSUITED[before:] == [], source


def test_rows_of_any_layout_are_read_and_written_but_not_those_that_are_read_only() -> None:
    """What needs more than parts do is numba's again, with numba's refusal."""
    rows = load_module(
        "rows",
        f"""{HEAD}
@compiled(cache=False)
def double(table, place):
    total = 0.0
    for i in range(table.shape[0]):
        row = table[i]
        for j in range(len(row)):
            row[j] *= 2.0
            total += row[j] * place[i % 2]
    return total
""",
    ).double
    place = np.array([1.0, 10.0])
    for table in (np.arange(6.0).reshape(3, 2), np.asfortranarray(np.arange(6.0).reshape(3, 2))):
        expected = 2.0 * (table.sum(axis=1) * [1.0, 10.0, 1.0]).sum()
        assert rows(table, place) == expected
        np.testing.assert_array_equal(table.ravel(), 2.0 * np.arange(6.0))
    fixed = np.arange(6.0).reshape(3, 2)
    fixed.flags.writeable = False
    with pytest.raises(numba.core.errors.TypingError, match="Cannot modify readonly array"):
        rows(fixed, place)
    assert "double" in UNSUITED.pop()


def test_what_a_turn_that_ends_early_leaves_is_read_in_the_next_one() -> None:
    """Although the lines behind would assign it: between them is one that numba keeps."""
    function = load_module(
        "early",
        f"""{HEAD}
@compiled(cache=False)
def total(a):
    x, total = 1.0, 0.0
    for i in range(len(a)):
        total += x
        x = 2.0 * a[i] + 1.0 - 0.5 * a[0]
        view = a[i:]
        if view[0] > 0.0:
            continue
        x = 0.0
    return total
""",
    ).total
    a = np.array([1.0, -1.0, 2.0, 3.0])
    assert function(a) == function.py_func(a)
