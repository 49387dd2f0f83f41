"""Claims about toy mechanisms that are false, or true, by a hair.

What makes a claim false is thin: a crest of some width around a position that is no double, a hole
where a term is undefined though it is multiplied by 0, a number beyond its limit by one part in so
many.  The limits come from mpmath and exact fractions, and know nothing of the checkers.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

import mpmath as mp

Document = dict[str, Any]

#: By how much of itself a number is beyond its limit, and how wide a crest is.
HAIRS = [Fraction(1, 10**k) for k in (1, 2, 4, 8, 12, 16, 24, 40)]
WIDTHS = [Fraction(1, 10**k) for k in (1, 2, 3, 4, 5, 6)]


@dataclass
class Toy:
    """Two positions a and b, one input: nodes of a, b and their rates, then what is put on them."""

    source: random.Random
    nodes: list[list[Any]] = field(
        default_factory=lambda: [
            ["position", 0], ["position", 1], ["velocity", 0], ["velocity", 1],
            ["number", "0"], ["number", "1"],
        ]
    )  # fmt: skip

    def put(self, *node: Any) -> int:
        self.nodes.append(list(node))
        return len(self.nodes) - 1

    def number(self, value: Fraction | int) -> int:
        return self.put("number", str(value))

    def times(self, node: int, factor: Fraction | int) -> int:
        return self.put("mul", self.number(factor), node)

    def some(self, low: float, high: float) -> Fraction:
        return Fraction(self.source.randint(int(101 * low), int(101 * high)), 101)

    def spring(self) -> int:
        return self.put("neg", 1)

    def crest(self) -> tuple[int, Any]:
        """A node that is 1 at some b and falls on both sides of it; what it is at the target."""
        width, at = self.source.choice(WIDTHS), self.some(-1, 1) + Fraction(1, 10**6 + 3)
        ratio = self.times(self.put("sub", 1, self.number(at)), 1 / width)
        square, x = self.put("pow", ratio, 2), exact(-at / width)
        kind = self.source.choice(["quotient", "gauss", "tanh"])
        if kind == "quotient":
            return self.put("div", 5, self.put("add", 5, square)), 1 / (1 + x * x)
        if kind == "gauss":
            return self.put("exp", self.put("neg", square)), mp.exp(-x * x)
        slope = self.put("pow", self.put("tanh", ratio), 2)
        return self.put("sub", 5, slope), 1 - mp.tanh(x) ** 2

    def document(
        self, claim: Document, mass: tuple[int, int, int] = (5, 4, 5), force: int | None = None,
        drive: int = 5, limit: Fraction | None = None, **law: Fraction | int,
    ) -> Document:  # fmt: skip
        own = {"alpha_a": 1, "lambda_a": 1, "alpha_u": 0, "lambda_u": 0} | law
        eta, layer = own.pop("eta", 20), own.pop("layer", Fraction(1, 10))
        f_u = self.spring() if force is None else force
        bound = None if limit is None else str(limit)
        return {
            "format": "undertow-certificate", "version": 2, "made_with": {},
            "model": {
                "name": "toy", "positions": [{"name": k, "unit": "m"} for k in "ab"],
                "inputs": [{"name": "u", "unit": "N", "limit": bound}], "parameters": [],
                "nodes": self.nodes, "M": [[mass[0]], [*mass[1:]]], "f": [4, f_u], "B": [[drive]],
            },
            "subjects": [{
                "law": {k: [[str(v)]] for k, v in own.items()} | {
                    "eta": [str(eta)], "layer": [str(layer)], "switching": "saturation",
                    "disturbance": ["0", "0"],
                },
                "claims": [claim],
            }],
        }  # fmt: skip


def exact(value: Fraction) -> Any:
    return mp.mpf(value.numerator) / value.denominator


def decimal(value: Any) -> Fraction:
    return Fraction(mp.nstr(value, 50, min_fixed=-mp.inf, max_fixed=mp.inf))


WIDE = {"b": ["-2", "2"]}


def ratio(toy: Toy, more: Fraction) -> Document:
    """Γ = 1 − h·crest is claimed to stay above its least value, and more."""
    node, here = toy.crest()
    h = toy.some(0.2, 0.8)
    least = decimal((1 - exact(h)) / (1 - exact(h) * here) * (1 + exact(more)))
    claim = {"kind": "nonsingular", "region": WIDE, "ratio": str(least)}
    return toy.document(claim, (toy.number(5), toy.times(node, h), 5), alpha_u=1)


def pivot(toy: Toy, more: Fraction) -> Document:
    """1 − (1 + more) crest is a pivot of M, or B."""
    node, _ = toy.crest()
    dip = toy.put("sub", 5, toy.times(node, 1 + more))
    claim = {"kind": "nonsingular", "region": WIDE, "ratio": f"1/1{'0' * 60}"}
    mass, drive = toy.source.choice([((dip, 4, 5), 5), ((5, 4, dip), 5), ((5, 4, 5), dip)])
    return toy.document(claim, mass, drive=drive)


def reach(toy: Toy, more: Fraction) -> Document:
    """η is what forces and rate need where S = 1 − h·crest is least, or less."""
    node, _ = toy.crest()
    h, alpha_u = toy.some(0.1, 0.9), toy.some(-2, 2)
    loads, rate = (toy.some(0.1, 1), toy.some(0, 1)), toy.some(0, 1)
    needed = loads[0] / (1 - h) + abs(alpha_u) * loads[1] + rate
    claim = {"kind": "reaching", "region": WIDE, "disturbance": [*map(str, loads)],
             "rate": [str(rate)]}  # fmt: skip
    mass = toy.put("sub", 5, toy.times(node, h)), 4, 5
    return toy.document(claim, mass, alpha_u=alpha_u, eta=needed * (1 - more))


def rate(toy: Toy, more: Fraction) -> Document:
    """The slowest of q̈_b = −k b − d ḃ, overdamped, and ȧ = −λ a."""
    slow, fast, own = toy.some(0.1, 2), toy.some(2.1, 5), toy.some(0.1, 5)
    pull = toy.put("sin", toy.times(1, -slow * fast))
    force = toy.put("sub", pull, toy.times(3, slow + fast))
    claim = {"kind": "stability", "rate": str(min(slow, own) * (1 + more))}
    return toy.document(claim, force=force, lambda_a=own)


def limit(toy: Toy, more: Fraction) -> Document:
    """The demand −3 s + a, s = ȧ + a, on |W x| ≤ ρ, where W₁ = a and W₃ = 7/4 s."""
    force = toy.put("sub", toy.spring(), toy.times(3, Fraction(3, 2)))
    W = [
        ["1", "0", "0", "0"],
        ["0", "1", "0", "1/4"],
        ["7/4", "0", "7/4", "0"],
        ["0", "0", "0", "1"],
    ]
    radius = toy.some(0.1, 1)
    claim = {"kind": "terminal ellipsoid", "W": W, "radius": str(radius)}
    most = decimal(exact(radius) * mp.sqrt(1 + mp.mpf(144) / 49) * (1 - exact(more)))
    return toy.document(claim, force=force, limit=most, eta=20, layer=10)


def start(toy: Toy, more: Fraction) -> Document:
    """V = 2 (k + d²/2) b² + 2 d b ḃ + 2 ḃ² + 2 w² is 1 on the axis of b at what is contained."""
    k, d = toy.some(1, 3), toy.some(0.5, 2)
    force = toy.put("sub", toy.times(1, -k), toy.times(3, d))
    size = 2 * (k + d * d / 2)
    eye = [[str(int(i == j)) for j in range(3)] for i in range(3)]
    function = {
        "A": eye, "G": [["1/4", "0", "0"], ["0", "1/8", "0"], ["0", "0", "1/4"]],
        "exponents": [[2, 0, 0], [1, 1, 0], [0, 2, 0], [0, 0, 2]],
        "coefficients": [str(size), str(2 * d), "2", "2"],
    }  # fmt: skip
    end = str(decimal((1 + exact(more)) / mp.sqrt(exact(size))))
    claim: Document = {
        "kind": "surface region", "stretch": [], "pole": None, "functions": [function],
        "contains": [end, "0", "0"], "plant": {},
    }  # fmt: skip
    return toy.document(claim, force=force)


def hole(toy: Toy, _: Fraction) -> Document:
    """0 · 1/x, 0 · log x², x/x² …: undefined at one position, or at the end of the region."""
    at = toy.some(0.1, 1) + Fraction(1, 10**6 + 3)
    x = toy.put("sub", 1, toy.number(at))
    square = toy.put("pow", x, 2)
    bad = toy.put(*toy.source.choice([("div", 5, x), ("div", x, square), ("log", square),
                                      ("sqrt", square)]))  # fmt: skip
    nothing = toy.put(*toy.source.choice([("mul", 4, bad), ("sub", bad, bad)]))
    one = toy.put("add", 5, nothing)
    high = toy.source.choice([at, at, Fraction(2)])
    claim = {"kind": "nonsingular", "region": {"b": ["-1/2", str(high)]}, "ratio": "1/1000"}
    mass, drive = toy.source.choice([((5, 4, one), 5), ((one, 4, 5), 5), ((5, 4, 5), one)])
    return toy.document(claim, mass, drive=drive)


MAKERS: dict[str, Callable[[Toy, Fraction], Document]] = {
    "ratio": ratio, "pivot": pivot, "reach": reach, "rate": rate, "limit": limit, "start": start,
    "hole": hole,
}  # fmt: skip


def made(name: str, source: random.Random, false: bool, hair: Fraction) -> Document:
    """Return a document with one claim of a kind that is false, or true, by a hair."""
    with mp.workdps(60):
        return MAKERS[name](Toy(source), hair if false else -hair)
