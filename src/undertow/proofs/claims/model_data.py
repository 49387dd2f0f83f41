"""A mechanism, a surface and a reaching law as the data of a certificate, and as the kernel's.

Nothing here is trusted: the kernel reads what comes out as it would read it from a file.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable
from fractions import Fraction
from functools import lru_cache
from typing import Any

import sympy as sp

from undertow.base.errors import CertificateError, ModelError
from undertow.law import ReachingLaw, Surface, check_surface_shape
from undertow.models.mechanism import TIME, Mechanism
from undertow.proofs.claims.written import number_text
from undertow.proofs.exact_model import exact_mechanism, exact_number, require_autonomous
from undertow.proofs.kernel.model import Law, Model
from undertow.proofs.kernel.reader import Refused, read_law, read_model

_PLAIN = {sp.sin: "sin", sp.cos: "cos", sp.exp: "exp", sp.log: "log", sp.tanh: "tanh"}

#: Functions that are written in terms of others.
_WRITTEN: dict[Any, Callable[[sp.Expr], sp.Expr]] = {
    sp.tan: lambda x: sp.sin(x) / sp.cos(x),
    sp.cot: lambda x: sp.cos(x) / sp.sin(x),
    sp.sec: lambda x: 1 / sp.cos(x),
    sp.csc: lambda x: 1 / sp.sin(x),
    sp.sinh: lambda x: (sp.exp(x) - sp.exp(-x)) / 2,
    sp.cosh: lambda x: (sp.exp(x) + sp.exp(-x)) / 2,
}


class _Writer:
    """SymPy expressions to nodes, each distinct one once."""

    def __init__(
        self, leaves: dict[sp.Symbol, list[Any]], values: dict[sp.Symbol, sp.Rational]
    ) -> None:
        self._values = values
        self.nodes: list[list[Any]] = []
        self._known: dict[tuple[Any, ...], int] = {}
        self._done: dict[sp.Expr, int] = {}
        self._leaves = leaves

    def node(self, *data: Any) -> int:
        if data not in self._known:
            self._known[data] = len(self.nodes)
            self.nodes.append(list(data))
        return self._known[data]

    def of(self, e: sp.Expr) -> int:
        if e not in self._done:
            self._done[e] = self._fresh(e)
        return self._done[e]

    def number(self, value: sp.Rational) -> int:
        return self.node("number", number_text(Fraction(int(value.p), int(value.q))))

    def _fresh(self, e: sp.Expr) -> int:
        if e in self._leaves:
            return self.node(*self._leaves[e])
        if e.is_Rational:
            return self.number(e)
        if e is sp.pi:
            return self.node("pi")
        if e is sp.E:
            return self.node("exp", self.node("number", "1"))
        if e.is_Add:
            return self._sum(e.args)
        if e.is_Mul:
            return self._product(e)
        if e.is_Pow:
            return self._power(*e.args)
        if e.func in _PLAIN:
            return self.node(_PLAIN[e.func], self.of(e.args[0]))
        if e.func in _WRITTEN:
            return self.of(_WRITTEN[e.func](e.args[0]))
        if e.free_symbols <= {*self._values}:  # a kink of parameters alone is none: a number
            value = e.subs(self._values)
            if value.is_Rational:
                return self.number(value)
        raise ModelError(
            "model of a certificate",
            value=str(e)[:60],
            limit="+ − × ÷, whole and half powers, sin, cos, tan, exp, log, tanh, sinh, cosh",
            remedy="Rewrite it in these, or without kinks",
        )

    def _sum(self, terms: Iterable[sp.Expr]) -> int:
        total: int | None = None
        for term in sorted(terms, key=lambda t: t.could_extract_minus_sign()):
            if total is None:
                total = self.of(term)
            elif term.could_extract_minus_sign():
                total = self.node("sub", total, self.of(-term))
            else:
                total = self.node("add", total, self.of(term))
        assert total is not None
        return total

    def _product(self, e: sp.Expr) -> int:
        if e.args[0] == -1:
            return self.node("neg", self.of(-e))
        above, below = list[sp.Expr](), list[sp.Expr]()
        for factor in e.args:
            down = factor.is_Pow and factor.exp.is_Rational and factor.exp < 0
            (below if down else above).append(1 / factor if down else factor)
        total = self._factors(above)
        return self.node("div", total, self._factors(below)) if below else total

    def _factors(self, factors: list[sp.Expr]) -> int:
        total = self.of(factors[0]) if factors else self.node("number", "1")
        for factor in factors[1:]:
            total = self.node("mul", total, self.of(factor))
        return total

    def _power(self, base: sp.Expr, exponent: sp.Expr) -> int:
        twice = 2 * exponent
        if not (twice.is_Integer and 0 < abs(int(twice)) <= 128):
            if base is sp.E or not exponent.is_Rational:
                return self.node("exp", self.of(exponent * sp.log(base)))
            raise ModelError(
                "exponent in a model of a certificate", value=str(exponent), limit="whole or half"
            )
        if exponent < 0:
            return self.node("div", self.node("number", "1"), self.of(base**-exponent))
        root = self.of(base) if exponent.is_Integer else self.node("sqrt", self.of(base))
        k = int(exponent) if exponent.is_Integer else int(twice)
        return root if k == 1 else self.node("pow", root, k)


@lru_cache(maxsize=64)
def _graph(mechanism: Mechanism) -> tuple[Any, ...]:
    """Nodes, M, f and B of an exact mechanism."""
    n, m = mechanism.n, mechanism.m
    leaves: dict[sp.Symbol, list[Any]] = {}
    for i in range(n):
        leaves[mechanism.x[i]], leaves[mechanism.x[n + i]] = ["position", i], ["velocity", i]
    for k, symbol in enumerate(mechanism.parameter_symbols):
        leaves[symbol] = ["parameter", k]
    values = {p.symbol: exact_number(p.value) for p in mechanism.parameters}
    writer = _Writer(leaves, values)
    M = [[writer.of(mechanism.mass_matrix[i, j]) for j in range(i + 1)] for i in range(n)]
    f = [writer.of(e) for e in mechanism.force]
    B = [[writer.of(mechanism.input_matrix[i, j]) for j in range(m)] for i in range(m)]
    return writer.nodes, M, f, B


def model_data(mechanism: Mechanism) -> dict[str, Any]:
    """Return the ``model`` of a certificate.

    Raises InvalidInputError for a force that depends on time; ModelError for a model that is not
    smooth, or has a function that no node stands for.
    """
    exact = exact_mechanism(mechanism)
    require_autonomous(exact, "certificate")
    assert TIME not in exact.force.free_symbols
    nodes, M, f, B = _graph(exact)
    return {
        "name": _holds(mechanism.name, "mechanism", r'[^\\"\x00-\x1f]{1,64}'),
        "positions": [
            {"name": _holds(c.name, f"q_{k}"), "unit": c.unit}
            for k, c in enumerate(mechanism.coordinates)
        ],
        "inputs": [
            {
                "name": _holds(i.name, f"u_{k}"),
                "unit": i.unit,
                "limit": number_text(i.limit) if math.isfinite(i.limit) else None,
            }
            for k, i in enumerate(mechanism.inputs)
        ],
        "parameters": [
            {"name": _holds(p.name, f"p_{k}"), "unit": p.unit, "value": number_text(p.value)}
            for k, p in enumerate(mechanism.parameters)
        ],
        "nodes": nodes,
        "M": M,
        "f": f,
        "B": B,
    }


def _holds(name: str, otherwise: str, what: str = r"[^\W\d]\w{0,63}") -> str:
    """A name as a certificate can hold it: as it is, or by its number."""
    return name if re.fullmatch(what, name) else otherwise


@lru_cache(maxsize=64)
def model_of(mechanism: Mechanism) -> Model:
    """Return the kernel's model of a mechanism.

    Raises InvalidInputError or ModelError as :func:`model_data`; CertificateError for names or
    sizes that a certificate cannot hold.
    """
    try:
        return read_model(model_data(mechanism))
    except Refused as error:
        raise CertificateError(
            f"model '{mechanism.name}' of a certificate",
            value=str(error),
            limit="what one can hold",
        ) from error


def law_data(mechanism: Mechanism, surface: Surface, law: ReachingLaw) -> dict[str, Any]:
    """Return the ``law`` of a certificate's subject."""
    check_surface_shape(mechanism, surface)

    def rows(block: Any) -> Any:
        return [[number_text(float(v)) for v in row] for row in block]

    eta, layer = law.per_surface(surface.m)
    return {
        **{k: rows(getattr(surface, k)) for k in ("alpha_a", "lambda_a", "alpha_u", "lambda_u")},
        "eta": [number_text(float(v)) for v in eta],
        "layer": [number_text(float(v)) for v in layer],
        "switching": law.switching,
        "disturbance": [number_text(float(v)) for v in mechanism.disturbance_bounds],
    }


def law_of(mechanism: Mechanism, surface: Surface, law: ReachingLaw) -> Law:
    """Return the kernel's law of a surface and a reaching law."""
    return read_law(law_data(mechanism, surface, law), model_of(mechanism))
