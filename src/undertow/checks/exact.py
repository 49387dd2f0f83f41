"""A mechanism's equations and its law, evaluated exactly: what compiled code must agree with.

Expressions are walked as SymPy keeps them, in 50 digits, with every float taken as the binary
number that it is.  Nothing here is shared with what turns expressions into code: no tape, no
elimination of common parts, no printer.  The law is not taken from (5) with (12) either; it is
solved for: the u that makes ṡ = −K sw(s/ε) under ``M q̈ = f + (B u, 0)``.

With each value comes its *size*: in units of a float's rounding, how far any sensible evaluation
in float64 may be off, to first order (running error analysis: Higham, *Accuracy and Stability of
Numerical Algorithms*, SIAM 2002, ch. 3).  A difference is judged relative to it, so that a
tolerance means the same near the target, near a singularity and far away.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Any, NamedTuple, cast

import numpy as np
import sympy as sp
from mpmath import MPContext
from numpy.typing import ArrayLike

from undertow.base import ModelError
from undertow.law import ReachingLaw, Surface
from undertow.models import TIME, Mechanism

_MP: Any = MPContext()
_MP.dps = 50

#: A jump is at a number that is so near to it in units of its size, relative.
_NEAR = 1e-11


class Number:
    """A value to 50 digits, and its size, to which its rounding error in float64 is relative.

    A float is taken as the binary number that it is; the size is |value| by default.

    Examples
    --------
    >>> third = Number(1.0) / Number(3.0)
    >>> third.off(1 / 3) < 1e-16, third.off(0.33333333) > 1e-9
    (True, True)
    """

    __slots__ = ("near", "size", "value")

    def __init__(self, value: Any, size: float | None = None) -> None:
        self.value = _real(value)
        self.near = float(self.value)
        self.size = abs(self.near) if size is None else size

    @classmethod
    def _of(cls, value: Any, size: float) -> Number:
        """Wrap a number of 50 digits."""
        made = object.__new__(cls)
        made.value, made.near, made.size = value, float(value), size
        return made

    def __float__(self) -> float:
        """The nearest float."""
        return self.near

    def off(self, computed: float) -> float:
        """Return |computed − value| relative to the size; infinite for what is no number."""
        if not math.isfinite(computed):
            return math.inf
        gap = float(abs(_MP.mpf(computed) - self.value))
        return gap / self.size if self.size > 0 else (0.0 if gap == 0 else math.inf)

    def inside(self, low: float, high: float) -> bool:
        """Whether the value lies within [low, high]."""
        return bool(low <= self.value <= high)

    def __neg__(self) -> Number:
        """−a."""
        return Number._of(-self.value, self.size)

    def __add__(self, other: Number) -> Number:
        """A + b."""
        return Number._of(self.value + other.value, self.size + other.size)

    def __sub__(self, other: Number) -> Number:
        """A − b."""
        return Number._of(self.value - other.value, self.size + other.size)

    def __mul__(self, other: Number) -> Number:
        """A b."""
        size = abs(self.near) * other.size + abs(other.near) * self.size
        return Number._of(self.value * other.value, size)

    def __truediv__(self, other: Number) -> Number:
        """A / b."""
        value = _real(self.value / other.value if other.value else _MP.inf)
        size = self.size + abs(float(value)) * other.size
        return Number._of(value, size / (abs(other.near) or math.nan))

    def __abs__(self) -> Number:
        """|a|."""
        return Number._of(abs(self.value), self.size)

    def clip(self, limit: float) -> Number:
        """Return the value within ±limit; of its own size where rounding decides."""
        if not abs(self.near) + self.size * _NEAR > limit:
            return self
        end = Number(math.copysign(limit, self.near))
        if abs(self.near) - self.size * _NEAR > limit:
            return end
        return self if abs(self.value) <= limit else Number._of(end.value, self.size)

    def sign(self) -> Number:
        """−1, 0 or 1; of unlimited size where rounding decides."""
        sure = (self.value == 0 and self.size == 0) or abs(self.near) > _NEAR * self.size
        return Number(_MP.sign(self.value), 1.0 if sure else math.inf)


def _real(value: Any) -> Any:
    """Return a real number of 50 digits, or say that there is none."""
    if isinstance(value, _MP.mpc) or not _MP.isfinite(value):
        raise ModelError(
            "exact value",
            value=str(value),
            limit="a real number",
            remedy="The model is not defined there: a root, logarithm or quotient has no value",
        )
    return _MP.mpf(value)


def _smooth(name: str, slope: Callable[[Any], Any], least: float = 0.0) -> Any:
    function = getattr(_MP, name)

    def apply(a: Number) -> Number:
        value = _real(function(a.value))
        own = max(abs(float(value)), least if abs(a.near) > math.pi / 4 else 0.0)
        return Number(value, abs(float(slope(a.value))) * a.size + own)

    return apply


#: Sines and cosines come out of a reduction by π/2: their error is absolute.
_FUNCTIONS: Mapping[Any, Callable[[Number], Number]] = {
    sp.sin: _smooth("sin", _MP.cos, 1.0),
    sp.cos: _smooth("cos", _MP.sin, 1.0),
    sp.tan: _smooth("tan", lambda v: 1 / _MP.cos(v) ** 2),
    sp.asin: _smooth("asin", lambda v: 1 / _MP.sqrt(1 - v * v)),
    sp.acos: _smooth("acos", lambda v: 1 / _MP.sqrt(1 - v * v)),
    sp.atan: _smooth("atan", lambda v: 1 / (1 + v * v)),
    sp.sinh: _smooth("sinh", _MP.cosh),
    sp.cosh: _smooth("cosh", _MP.sinh),
    sp.tanh: _smooth("tanh", lambda v: 1 - _MP.tanh(v) ** 2),
    sp.asinh: _smooth("asinh", lambda v: 1 / _MP.sqrt(v * v + 1)),
    sp.acosh: _smooth("acosh", lambda v: 1 / _MP.sqrt(v * v - 1)),
    sp.atanh: _smooth("atanh", lambda v: 1 / (1 - v * v)),
    sp.erf: _smooth("erf", lambda v: 2 * _MP.exp(-v * v) / _MP.sqrt(_MP.pi)),
    sp.exp: _smooth("exp", _MP.exp),
    sp.log: _smooth("log", lambda v: 1 / v),
    sp.floor: lambda a: Number(_MP.floor(a.value)),
    sp.ceiling: lambda a: Number(_MP.ceil(a.value)),
    sp.Heaviside: lambda a: (a.sign() + Number(1)) * Number(0.5),
    sp.sec: lambda a: Number(1) / _FUNCTIONS[sp.cos](a),
    sp.csc: lambda a: Number(1) / _FUNCTIONS[sp.sin](a),
    sp.cot: lambda a: _FUNCTIONS[sp.cos](a) / _FUNCTIONS[sp.sin](a),
    sp.coth: lambda a: Number(1) / _FUNCTIONS[sp.tanh](a),
    sp.sech: lambda a: Number(1) / _FUNCTIONS[sp.cosh](a),
    sp.csch: lambda a: Number(1) / _FUNCTIONS[sp.sinh](a),
    sp.acot: lambda a: _FUNCTIONS[sp.atan](Number(1) / a),
    sp.sinc: lambda a: _FUNCTIONS[sp.sin](a) / a if a.value else Number(1),
    sp.frac: lambda a: a - Number(_MP.floor(a.value)),
    sp.Abs: abs,
    sp.sign: Number.sign,
}


def evaluate(expression: sp.Basic, known: dict[sp.Basic, Number]) -> Number:
    """Return the value of an expression; ``known`` starts with its symbols, and remembers.

    Raises ModelError for a symbol without a value, or a function that is not known here.
    """
    e = sp.sympify(expression)
    if e not in known:
        known[e] = _fresh(e, known)
    return known[e]


def _fresh(e: sp.Basic, known: dict[sp.Basic, Number]) -> Number:
    if e.is_Float:
        return Number(_MP.make_mpf(e._mpf_))
    if e.is_Rational:
        return Number(_MP.mpf(int(e.p)) / int(e.q))
    if e.is_NumberSymbol:
        return Number(_MP.make_mpf(e._as_mpf_val(_MP.prec)))
    if isinstance(e, sp.Piecewise):
        return next(evaluate(v, known) for v, condition in e.args if _holds(condition, known))
    args = [] if e.is_Symbol else [evaluate(a, known) for a in e.args]
    if e.is_Add or e.is_Mul:
        total = args[0]
        for other in args[1:]:
            total = total + other if e.is_Add else total * other
        return total
    if e.is_Pow:
        return _power(args[0], args[1], e.exp)
    if e.func in _FUNCTIONS:
        return _FUNCTIONS[e.func](args[0])
    if e.func in (sp.Max, sp.Min):
        return (max if e.func is sp.Max else min)(args, key=lambda a: a.value)
    if e.func is sp.atan2:
        y, x = args
        below = float(x.value**2 + y.value**2)
        size = (abs(float(x)) * y.size + abs(float(y)) * x.size) / below
        return Number(_MP.atan2(y.value, x.value), size + math.pi)
    if e.func is sp.Mod:
        return args[0] - args[1] * Number(_MP.floor((args[0] / args[1]).value))
    raise ModelError(
        "exact value",
        value=str(e),
        limit="of declared symbols and elementary functions",
        remedy="Write the model with coordinate.symbol, parameter.symbol and SymPy's functions",
    )


def _power(base: Number, exponent: Number, written: sp.Expr) -> Number:
    value = _real(base.value**exponent.value if base.value or exponent.value > 0 else _MP.inf)
    if written.is_number:
        slope = exponent.value * value / base.value if base.value else _MP.mpf(0)
        return Number(value, abs(float(slope)) * base.size + abs(float(value)))
    relative = abs(exponent.near) * base.size / abs(base.near)
    relative += abs(float(_MP.log(abs(base.value)))) * exponent.size
    return Number(value, abs(float(value)) * (1.0 + relative))


def _holds(condition: sp.Basic, known: dict[sp.Basic, Number]) -> bool:
    if condition in (sp.true, sp.false):
        return bool(condition)
    if isinstance(condition, sp.And | sp.Or):
        each = [_holds(part, known) for part in condition.args]
        return all(each) if isinstance(condition, sp.And) else any(each)
    if isinstance(condition, sp.Not):
        return not _holds(condition.args[0], known)
    left, right = (evaluate(side, known).value for side in condition.args)
    return bool(condition.func(sp.Integer(int(_MP.sign(left - right))), 0))


# -- linear algebra: NumPy adds and multiplies what stands in its arrays, exact numbers too ------

Matrix = np.ndarray[Any, np.dtype[np.object_]]
_Matrices = tuple[Matrix, Matrix, Matrix]
_Rows = Sequence[Any] | Matrix


def solve(A: _Rows, b: _Rows) -> Matrix:
    """Return A⁻¹ b by elimination with row exchanges, (n, n) and (n, k) to (n, k)."""
    rows = np.hstack([np.array(A, dtype=object), np.array(b, dtype=object)])
    n = len(rows)
    for j in range(n):
        best = max(range(j, n), key=lambda i: abs(rows[i, j].value))
        rows[[j, best]] = rows[[best, j]]
        for i in range(n):
            if i != j and rows[i, j].value != 0:
                rows[i, j + 1 :] -= rows[j, j + 1 :] * (rows[i, j] / rows[j, j])
    return np.asarray(rows[:, n:] / rows.diagonal()[:, None])


def determinant(A: Matrix) -> Number:
    """Return the determinant by expansion along the first row."""
    if len(A) == 1:
        return cast(Number, A[0, 0])
    total = Number(0)
    for j, entry in enumerate(A[0]):
        minor = determinant(np.delete(A[1:], j, axis=1))
        total = total - entry * minor if j % 2 else total + entry * minor
    return total


def product(A: _Rows, b: _Rows) -> Matrix:
    """Return A b."""
    return np.asarray(np.array(A, dtype=object) @ np.array(b, dtype=object))


def _numbers(block: ArrayLike) -> Matrix:
    """Return floats as exact numbers."""
    return np.asarray(np.vectorize(lambda v: Number(float(v)), otypes=[object])(block))


# -- the model -----------------------------------------------------------------------------------


class ExactLaw(NamedTuple):
    """What the law says at a state: input within limits, demand, s, gains (m,), margin."""

    u: list[Number]
    demand: list[Number]
    s: list[Number]
    gains: list[Number]
    margin: Number


class ExactModel:
    """A mechanism's own expressions, with its parameters, in 50 digits.

    Raises ModelError when one symbol stands for two of its coordinates, inputs and parameters.
    """

    def __init__(self, mechanism: Mechanism) -> None:
        self.mechanism = mechanism
        symbols = [TIME, *mechanism.x, *mechanism.u, *mechanism.parameter_symbols]
        repeated = sorted({str(s) for s in symbols if symbols.count(s) > 1})
        if repeated:
            raise ModelError(
                f"symbols of '{mechanism.name}'",
                value=f"{', '.join(repeated)} twice",
                limit="one meaning each",
                remedy="Rename a coordinate, an input or a parameter",
            )
        self._last: tuple[Any, _Matrices] | None = None
        self._parameters = {p.symbol: Number(float(p.value)) for p in mechanism.parameters}

    def known(self, t: float, x: Sequence[Number]) -> dict[sp.Basic, Number]:
        """Return the values of the symbols at (t, x)."""
        state = dict(zip(self.mechanism.x, x, strict=True))
        return {TIME: Number(t), **state, **self._parameters}

    def matrices(self, t: float, x: Sequence[Number]) -> _Matrices:
        """Return M (n, n), f (n,) and B (m, m)."""
        key = (t, *((v.value, v.size) for v in x))
        if self._last is None or self._last[0] != key:
            known, model = self.known(t, x), self.mechanism
            mass, force, push = (
                np.array([evaluate(e, known) for e in matrix], dtype=object).reshape(matrix.shape)
                for matrix in (model.mass_matrix, model.force, model.input_matrix)
            )
            self._last = key, (mass, force.ravel(), push)
        return self._last[1]

    def accelerations(
        self,
        t: float,
        x: Sequence[Number],
        u: Sequence[Number],
        damping: Sequence[Number] | None = None,
    ) -> list[Number]:
        """Return q̈ (n,) under the input u; ``damping`` acts on each joint besides."""
        n, m = self.mechanism.n, self.mechanism.m
        M, f, B = self.matrices(t, x)
        total = f + np.append(product(B, u), [Number(0)] * (n - m))
        if damping is not None:
            total = total - np.array(damping, dtype=object) * np.array(x[n:], dtype=object)
        return list(solve(M, total[:, None])[:, 0])

    def law(self, surface: Surface, reaching: ReachingLaw, x: Sequence[Number]) -> ExactLaw:
        """Return the sliding-mode law at x: the u for which ṡ = −K sw(s/ε), (5) with (12)."""
        n, m = self.mechanism.n, self.mechanism.m
        M, f, B = self.matrices(0.0, x)
        position, velocity = _numbers(surface.position_row), _numbers(surface.velocity_row)
        s = product(position, x[:n]) + product(velocity, x[n:])
        eta, layer = (_numbers(v) for v in reaching.per_surface(m))
        gains = self._gains(surface, M, eta)
        pushes = np.vstack([B, _numbers(np.zeros((n - m, m)))])
        moves = solve(M, np.column_stack([f, pushes]))
        switch = [_switch(a, e, reaching.switching) for a, e in zip(s, layer, strict=True)]
        wanted = -(gains * switch) - velocity @ moves[:, 0] - product(position, x[n:])
        demand = solve(velocity @ moves[:, 1:], wanted[:, None])[:, 0]
        limits = self.mechanism.input_limits.tolist()
        here, target = (determinant(self._gamma(surface, mass)) for mass in (M, self._at_target))
        clipped = [a.clip(b) for a, b in zip(demand, limits, strict=True)]
        return ExactLaw(clipped, list(demand), list(s), list(gains), here / target)

    @cached_property
    def _at_target(self) -> Matrix:
        return self.matrices(0.0, [Number(0)] * (2 * self.mechanism.n))[0]

    def _coupling(self, M: Matrix) -> Matrix:
        m = self.mechanism.m
        return solve(M[m:, m:], M[m:, :m])

    def _gamma(self, surface: Surface, M: Matrix) -> Matrix:
        """Γ = α_a − α_u M_uu⁻¹ M_auᵀ."""
        through = _numbers(surface.alpha_u) @ self._coupling(M)
        return np.asarray(_numbers(surface.alpha_a) - through)

    def _gains(self, surface: Surface, M: Matrix, eta: Matrix) -> Matrix:
        """K of (13): η, and what the declared disturbances ask for."""
        bounds, m = _numbers(self.mechanism.disturbance_bounds), self.mechanism.m
        if not any(b.value for b in bounds):
            return eta

        def inverse(A: Matrix) -> Matrix:
            return np.abs(solve(A, _numbers(np.eye(len(A)))))

        X = self._coupling(M)
        S, X = M[:m, :m] - M[:m, m:] @ X, np.abs(X)
        driven = inverse(S) @ (bounds[:m] + X.T @ bounds[m:])
        free = inverse(M[m:, m:]) @ bounds[m:] + X @ driven
        own, other = (max(part, key=lambda v: v.value) for part in (driven, free))
        weights = np.abs(_numbers(surface.velocity_row))
        return np.asarray(
            eta + weights[:, :m].sum(axis=1) * own + weights[:, m:].sum(axis=1) * other
        )


def runge_kutta(
    h: float, x: Sequence[Number], rates: Callable[[list[Number]], list[Number]]
) -> list[Number]:
    """Return x after one step of Runge and Kutta's fourth order, of length h."""
    stage, total = list(x), [Number(0)] * len(x)
    for weight, reach in ((1, 0.5), (2, 0.5), (2, 1.0), (1, 0.0)):
        slope = rates(stage)
        total = [a + Number(weight) * b for a, b in zip(total, slope, strict=True)]
        stage = [a + Number(reach) * Number(h) * b for a, b in zip(x, slope, strict=True)]
    part = Number(h) / Number(6)
    return [a + part * b for a, b in zip(x, total, strict=True)]


def _switch(s: Number, layer: Number, switching: str) -> Number:
    """sw(s/ε): saturation (39), tanh, or sign (12)."""
    if switching == "sign":
        return s.sign()
    ratio = s / layer
    return _FUNCTIONS[sp.tanh](ratio) if switching == "tanh" else ratio.clip(1.0)
