"""The paper's appendix done right: (A14)-(A27) on the surface of the rotary pendulum.

With y = (φ, φ̇, θ + (λ_u/λ_a) φ), ε = −α_a c/(α_u b), α = α_u/α_a − λ_u/λ_a,
g = −α_a d/(α_u b) and ξ = 1/(1 − ε/cos y₁), the motion on the surface is

    ẏ₁ = y₂
    ẏ₂ = ξ [ (λ_a α/α_u) y₂ + (λ_a²/(α_u α_a)) y₃ − g tan y₁ − ε sin y₁ · θ̇² ]
    ẏ₃ = −α y₂ − (λ_a/α_a) y₃,             θ̇ = −(α + λ_u/λ_a) y₂ − (λ_a/α_a) y₃

and V = ½ yᵀPy − β ln((cos y₁ − ε)/(1 − ε)) with β = p₂₂ g has

    V̇ = −½ yᵀR(y₁)y − p₁₂ g ξ y₁ (tan y₁ − y₁) − ξ ε sin y₁ · θ̇² (p₁₂ y₁ + p₂₂ y₂).

R = R₀ + ξ R₁ is affine in ξ, and ξ grows with |y₁|, so R ≻ 0 on |y₁| ≤ w iff it is at the
two values ξ(0) and ξ(w): exact, no grid.  The last term of V̇ has no sign and is missing
in (A20): what R ≻ 0 proves is local stability.  Derivation: ``docs/appendix.md``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cache, cached_property
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from undertow.base import InvalidInputError, Verdict, inward, require, require_extra
from undertow.base.verdict import Kind
from undertow.law import Surface
from undertow.models.mechanism import FloatArray, Mechanism
from undertow.proofs.claims.stability import exact_linearisation

Matrix = list[list[Any]]
BallMatrix = NDArray[np.object_]

BITS = 200


@cache
def flint() -> Any:
    """Return the module python-flint.

    Raises MissingExtraError when it is not installed.
    """
    return require_extra("flint", "appendix", "ball arithmetic needs python-flint")


def ball(value: float | Fraction) -> Any:
    """Return an arb that contains a number."""
    exact = Fraction(value)
    return flint().arb(flint().fmpq(exact.numerator, exact.denominator))


def lower_float(value: Any) -> float:
    """Return a float that is not above the lower end of a ball."""
    return math.nextafter(float(value.lower()), -math.inf)


def upper_float(value: Any) -> float:
    """Return a float that is not below the upper end of a ball."""
    return math.nextafter(float(value.upper()), math.inf)


class Constants(NamedTuple):
    """b, c in kg m² and d in N m, exact."""

    b: Fraction
    c: Fraction
    d: Fraction

    @classmethod
    def of(cls, mechanism: Mechanism) -> Constants:
        """Read b = −M_au, c = M_uu and d = ∂f_u/∂φ off a pendulum at its target, exactly."""
        rows = exact_linearisation(mechanism)
        exact = all(v.exact for row in rows for v in row)
        if (mechanism.n, mechanism.m) != (2, 1) or not exact:
            raise InvalidInputError(
                "appendix constants", value=mechanism.name, limit="a pendulum, n = 2, m = 1"
            )
        M_au, M_uu, _, F_u = (v.low for v in rows[1][:4])
        return cls(-M_au, M_uu, F_u)


#: What the appendix computed with: its b, and the c that its five printed ε imply to four
#: digits.  (It prints c rounded to 0.0047; with that, ε and all five margins differ.)
PRINTED = Constants(Fraction("0.0033"), Fraction("0.004676"), Fraction("0.2054"))


class Lyapunov(NamedTuple):
    """The five entries of P, (A18); p₂₃ = 0."""

    p11: Fraction
    p12: Fraction
    p13: Fraction
    p22: Fraction
    p33: Fraction

    def matrix(self) -> list[list[Fraction]]:
        """P, 3 × 3."""
        p11, p12, p13, p22, p33 = self
        zero = Fraction(0)
        return [[p11, p12, p13], [p12, p22, zero], [p13, zero, p33]]


@dataclass(frozen=True)
class AppendixCase:
    """One of the five printed cases; ``half_width`` is that of Ĩ, rad."""

    number: int
    title: str
    alpha_a: Fraction
    lambda_a: Fraction
    alpha_u: Fraction
    lambda_u: Fraction
    P: Lyapunov
    half_width: Fraction
    epsilon: str
    beta: str

    @property
    def surface(self) -> Surface:
        """The surface in float64."""
        return Surface(
            float(self.alpha_a), float(self.lambda_a), float(self.alpha_u), float(self.lambda_u)
        )

    def reduced(self, constants: Constants) -> Reduced:
        """Return the dynamics on the surface for given constants."""
        return Reduced(self.alpha_a, self.lambda_a, self.alpha_u, self.lambda_u, constants)


def _case(number: int, title: str, row: str) -> AppendixCase:
    *numbers, epsilon, beta = row.split()
    la, au, lu, *P, width = (Fraction(v) for v in numbers)
    return AppendixCase(number, title, Fraction(-1), la, au, lu, Lyapunov(*P), width, epsilon, beta)


#: λ_a, α_u, λ_u, the entries of P, the half-width of Ĩ, and ε and β as printed.
CASES: tuple[AppendixCase, ...] = (
    _case(1, "base case", "-0.5 5 10 50 10 1 5 0.04 1.24 0.2834 62.2121"),
    _case(2, "one-time, energy", "-0.248 1.94 11.14 100 10 1 2 0.03 0.73 0.7304 64.1362"),
    _case(3, "cascade, energy", "-0.1 2.46 15.25 1000 70 3 10 0.02 0.95 0.4065 253.014"),
    _case(4, "one-time, time", "-1.59 1.96 12.1 100 10 7 2 1 0.52 0.723 63.511"),
    _case(5, "cascade, time", "-2.4 1.49 9.66 40 6 10 1 40 0.22 0.95 41.773"),
)


@dataclass(frozen=True)
class Reduced:
    """The reduced system (A14)-(A16), corrected, with exact coefficients.

    Raises InvalidInputError when ε is not in (0, 1), (A13), or λ_a = 0.
    """

    alpha_a: Fraction
    lambda_a: Fraction
    alpha_u: Fraction
    lambda_u: Fraction
    constants: Constants

    def __post_init__(self) -> None:
        """Refuse what the appendix does not treat."""
        if not (self.lambda_a and 0 < self.epsilon < 1):
            raise InvalidInputError(
                "surface for the appendix",
                value=f"λ_a = {float(self.lambda_a):g}, ε = {float(self.epsilon):g}",
                limit="λ_a ≠ 0 and 0 < ε < 1",
                remedy="Outside this range the surface is singular at or near the target",
            )

    @property
    def epsilon(self) -> Fraction:
        """ε = −α_a c/(α_u b), (A13) with its minus sign."""
        return -self.alpha_a * self.constants.c / (self.alpha_u * self.constants.b)

    @property
    def g(self) -> Fraction:
        """The stiffness g = −α_a d/(α_u b), 1/s²; β = p₂₂ g, (A19)."""
        return -self.alpha_a * self.constants.d / (self.alpha_u * self.constants.b)

    @property
    def alpha(self) -> Fraction:
        """α of (A10)."""
        return self.r - self.lambda_u / self.lambda_a

    @property
    def k(self) -> Fraction:
        """The rate λ_a/α_a of y₃, 1/s."""
        return self.lambda_a / self.alpha_a

    @property
    def r(self) -> Fraction:
        """The ratio α_u/α_a."""
        return self.alpha_u / self.alpha_a

    @property
    def drag(self) -> Fraction:
        """λ_a α/α_u, what ẏ₂ has of y₂."""
        return self.lambda_a * self.alpha / self.alpha_u

    @property
    def pull(self) -> Fraction:
        """λ_a²/(α_u α_a), what ẏ₂ has of y₃."""
        return self.lambda_a**2 / (self.alpha_u * self.alpha_a)

    @property
    def limit(self) -> float:
        """The singular angle arccos ε, rad."""
        return math.acos(float(self.epsilon))

    def R(self, P: Lyapunov) -> tuple[list[list[Fraction]], list[list[Fraction]]]:
        """Return R₀ and R₁ with R(ξ) = R₀ + ξ R₁, (A22), exact."""
        p11, p12, p13, p22, p33 = P
        k, drag, pull, a, g, zero = self.k, self.drag, self.pull, self.alpha, self.g, Fraction(0)
        R0 = [
            [zero, -p11 + a * p13, k * p13],
            [-p11 + a * p13, -2 * p12, -p13 + a * p33],
            [k * p13, -p13 + a * p33, 2 * k * p33],
        ]
        R1 = [
            [2 * p12 * g, -p12 * drag, -p12 * pull],
            [-p12 * drag, -2 * p22 * drag, -p22 * pull],
            [-p12 * pull, -p22 * pull, zero],
        ]
        return R0, R1

    def xi(self, y1: float | Fraction) -> Any:
        """Return ξ = 1/(1 − ε/cos y₁) as a ball."""
        return 1 / (1 - ball(self.epsilon) / ball(y1).cos())

    def R_curve(self, P: Lyapunov, y1: FloatArray) -> FloatArray:
        """Return λ_min(R(y₁)) in float64 for the plots of Figures 7-11."""
        R0, R1 = _doubles(self.R(P))
        xi = 1 / (1 - float(self.epsilon) / np.cos(y1))
        return np.asarray(np.linalg.eigvalsh(R0 + xi[:, None, None] * R1)[:, 0])

    @cached_property
    def numbers(self) -> dict[str, float]:
        """Float coefficients of the field, for simulation."""
        names = ("k", "drag", "pull", "alpha", "r", "g", "epsilon")
        return {name: float(getattr(self, name)) for name in names}

    @property
    def slowest_rate(self) -> float:
        """−max Re eig of the linearisation at y = 0, 1/s."""
        n = self.numbers
        xi = 1 / (1 - n["epsilon"])
        A = np.array(
            [
                [0.0, 1.0, 0.0],
                [-n["g"] * xi, n["drag"] * xi, n["pull"] * xi],
                [0.0, -n["alpha"], -n["k"]],
            ]
        )
        return float(-np.linalg.eigvals(A).real.max())


# -- the exact two-vertex test ---------------------------------------------------------------


def _positive(matrix: Matrix | BallMatrix) -> bool | None:
    """Sylvester's criterion on numbers or balls: True, False, or None (too wide)."""
    answer: bool | None = True
    for minor in _minors(matrix):
        if minor <= 0:
            return False
        if not minor > 0:
            answer = None
    return answer


def _minors(M: Matrix | BallMatrix) -> list[Any]:
    """Leading principal minors of a symmetric 3 × 3 matrix."""
    two = M[0][0] * M[1][1] - M[0][1] * M[0][1]
    three = (
        M[2][2] * two
        - M[1][2] * (M[0][0] * M[1][2] - M[0][1] * M[0][2])
        + M[0][2] * (M[0][1] * M[1][2] - M[0][2] * M[1][1])
    )
    return [M[0][0], two, three]


def _balls(matrix: Matrix) -> BallMatrix:
    return np.array([[ball(v) for v in row] for row in matrix], dtype=object)


def _diagonal(value: Any) -> BallMatrix:
    return np.diag(np.array([value] * 3, dtype=object))


def _at(R: tuple[Matrix, Matrix], xi: Any) -> BallMatrix:
    """R₀ + ξ R₁ in balls."""
    M: BallMatrix = _balls(R[0]) + _balls(R[1]) * xi
    return M


def _doubles(R: tuple[Matrix, Matrix]) -> tuple[FloatArray, FloatArray]:
    return np.array(R[0], dtype=float), np.array(R[1], dtype=float)


def _smallest(R: tuple[Matrix, Matrix], xi: Any) -> float:
    """Float estimate of λ_min."""
    R0, R1 = _doubles(R)
    return float(np.linalg.eigvalsh(R0 + float(xi.mid()) * R1)[0])


def _proved_smallest(R: tuple[Matrix, Matrix], vertices: Sequence[Any]) -> float | None:
    """A proved lower bound of λ_min(R) at the vertices, if positive."""
    estimate = min(_smallest(R, xi) for xi in vertices)
    size = max(float(np.abs(m).max()) for m in _doubles(R))
    for slack in (1e-6, 1e-3, 0.1, 1.0):
        bound = (1 - slack) * estimate if estimate > 1e-14 * size else 0.0
        if all(_positive(_at(R, xi) - _diagonal(ball(bound))) for xi in vertices):
            return bound
    return None


def two_vertex(reduced: Reduced, P: Lyapunov, half_width: float | Fraction) -> Verdict:
    """Decide P ≻ 0 and R(y₁) ≻ 0 for all |y₁| ≤ half_width, exactly.

    ``half_width``: half-width of Ĩ, rad, ≥ 0; a fraction or float is taken as it is. The
    margin is a proved lower bound of inf λ_min(R) over the interval; a refutation's witness is an
    angle (and, within R, a direction) where it fails.
    """
    width = float(half_width)
    require(width >= 0, "half-width of Ĩ", width, "≥ 0 rad")
    if Fraction(width) > half_width:
        width = math.nextafter(width, 0.0)
    claim = f"P ≻ 0 and R(y₁) ≻ 0 for |y₁| ≤ {inward(width, 6)} rad"
    method = f"R is affine in ξ: two vertices, Sylvester minors in {BITS}-bit balls"
    with flint().ctx.workprec(BITS):
        # The cosine falls up to π alone: beyond 3 the interval holds 3, where R does not exist.
        if not ball(Fraction(min(half_width, 3))).cos() > ball(reduced.epsilon):
            return Verdict(
                claim, "refuted", -math.inf, "", {"y1": reduced.limit}, "R does not exist there"
            )
        smallest = float(np.linalg.eigvalsh(np.array(P.matrix(), dtype=float))[0])
        if _positive(P.matrix()) is not True:
            return Verdict(claim, "refuted", smallest, "", {}, "P is not positive")
        R = reduced.R(P)
        ends = [(0.0, reduced.xi(0)), (width, reduced.xi(Fraction(half_width)))]
        bound = _proved_smallest(R, [xi for _, xi in ends])
        where, xi = min(ends, key=lambda e: _smallest(R, e[1]))
        value = _smallest(R, xi)
        if bound is not None:
            return Verdict(claim, "proved", bound, "", {"y1": where}, method)
        direction = _negative_direction(R, xi)
        if direction is None:
            return Verdict(claim, "undecided", value, "", {"y1": where}, method)
        witness = {"y1": where} | {f"direction {i + 1}": v for i, v in enumerate(direction)}
        return Verdict(claim, "refuted", value, "", witness, method)


def _negative_direction(R: tuple[Matrix, Matrix], xi: Any) -> list[float] | None:
    """A direction with vᵀRv ≤ 0 proved, or nothing."""
    R0, R1 = _doubles(R)
    vector = np.linalg.eigh(R0 + float(xi.mid()) * R1)[1][:, 0].tolist()
    return vector if _form(_at(R, xi), [ball(c) for c in vector]) <= 0 else None


def _form(M: BallMatrix, v: Any) -> Any:
    return sum(M[i, j] * v[i] * v[j] for i in range(3) for j in range(3))


def largest_interval(reduced: Reduced, P: Lyapunov) -> tuple[float, float]:
    """Return half-widths of Ĩ, rad, for which R ≻ 0 is proved and refuted (0, 0 if never)."""
    low, high = 0.0, reduced.limit
    if not two_vertex(reduced, P, 0.0):
        return 0.0, 0.0
    while high - low > 1e-9:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if two_vertex(reduced, P, middle) else (low, middle)
    return low, high


def gamma_factor(reduced: Reduced, half_width: float | Fraction) -> Any:
    """γ/p₂₂ of (A24) as a ball: the smallest γ that serves on the interval.

    −ln((cos y − ε)/(1 − ε))/y² grows with |y|: its derivative's log has derivative
    cot y − 1/y + sin y/(cos y − ε) > 2/sin 2y − 1/y > 0.  So the end of Ĩ decides.
    """
    y = ball(Fraction(half_width))
    if not half_width:  # the limit at 0
        return ball(reduced.g) / (1 - ball(reduced.epsilon))
    barrier = -((y.cos() - ball(reduced.epsilon)) / (1 - ball(reduced.epsilon))).log()
    return 2 * ball(reduced.g) * barrier / (y * y)


def _full(reduced: Reduced, P: Lyapunov, half_width: float | Fraction) -> BallMatrix:
    """P̃ with γ p₂₂ added to its first entry."""
    full = _balls(P.matrix())
    full[0, 0] += gamma_factor(reduced, half_width) * ball(P.p22)
    return full


def paper_rate(reduced: Reduced, P: Lyapunov, half_width: float | Fraction) -> Verdict:
    """Prove σ = inf λ_min(R)/λ_max(P̃) of (A27), 1/s, with P̃ and not the printed P.

    A statement about the quadratic part only (see the module's text).
    """
    claim = f"(A27) with σ > 0 for |y₁| ≤ {inward(float(half_width), 6)} rad, velocity term aside"
    test = two_vertex(reduced, P, half_width)
    if not test:
        return Verdict(claim, test.kind, math.nan, "1/s", test.witness, test.method)
    with flint().ctx.workprec(BITS):
        full = _full(reduced, P, half_width)
        top = float(np.linalg.eigvalsh(_floats(full))[-1]) * (1 + 1e-9)
        if _positive(_diagonal(ball(top)) - full) is not True:
            return Verdict(claim, "undecided", math.nan, "1/s", {}, test.method)
        sigma = lower_float(ball(test.margin) / ball(top))
    return Verdict(claim, "proved", sigma, "1/s", test.witness, test.method)


def decay_rate(reduced: Reduced, P: Lyapunov, half_width: float | Fraction) -> Verdict:
    """Prove the largest σ, 1/s, with R(y₁) ⪰ σ P̃ for all |y₁| ≤ half_width.

    Then −½ yᵀRy ≤ −σ V as in (A27), without the loss of going through eigenvalues.  A
    statement about the quadratic part only (see the module's text).
    """
    width = float(half_width)
    claim = f"R(y₁) ⪰ σ P̃ with σ > 0 for |y₁| ≤ {inward(width, 6)} rad, velocity term aside"
    test = two_vertex(reduced, P, half_width)
    if not test:
        return Verdict(claim, test.kind, math.nan, "1/s", test.witness, test.method)
    with flint().ctx.workprec(BITS):
        full, R = _full(reduced, P, half_width), reduced.R(P)
        vertices = [_at(R, xi) for xi in (reduced.xi(0), reduced.xi(Fraction(half_width)))]
        rates = [scipy.linalg.eigvalsh(_floats(v), _floats(full))[0] for v in vertices]
        estimate = float(min(rates))
        for slack in (1e-9, 1e-6, 1e-3, 0.1, 0.5):
            sigma = estimate * (1 - slack)
            if sigma > 0 and all(_positive(v - full * ball(sigma)) for v in vertices):
                return Verdict(claim, "proved", sigma, "1/s", test.witness, test.method)
    return Verdict(claim, "undecided", estimate, "1/s", test.witness, test.method)


def _floats(matrix: BallMatrix) -> FloatArray:
    return np.array([[float(v.mid()) for v in row] for row in matrix])


def false_bound(reduced: Reduced, P: Lyapunov, y: Sequence[float]) -> Verdict:
    """Decide (A20), V̇ ≤ −½ yᵀR y, at one point y in balls: ``refuted`` where it fails.

    ``details`` holds V̇ and the bound that the paper claims.
    """
    claim = f"(A20) at y = ({', '.join(f'{v:g}' for v in y)})"
    with flint().ctx.workprec(BITS):
        y1, y2, y3 = (ball(float(v)) for v in y)
        xi, epsilon, g = reduced.xi(float(y[0])), ball(reduced.epsilon), ball(reduced.g)
        k, a, r = ball(reduced.k), ball(reduced.alpha), ball(reduced.r)
        drag, pull = ball(reduced.drag), ball(reduced.pull)
        theta_dot = -r * y2 - k * y3
        tangent = y1.sin() / y1.cos()
        acceleration = xi * (
            drag * y2 + pull * y3 - g * tangent - epsilon * y1.sin() * theta_dot * theta_dot
        )
        v = np.array([y1, y2, y3], dtype=object)
        v_dot = np.array([y2, acceleration, -a * y2 - k * y3], dtype=object)
        barrier = ball(P.p22) * g * y1.sin() / (y1.cos() - epsilon) * y2
        rate = (_balls(P.matrix()) @ v) @ v_dot + barrier
        bound = -_form(_at(reduced.R(P), xi), v) / 2
        gap = bound - rate
        details = {"V̇": float(rate.mid()), "claimed bound": float(bound.mid())}
        kind: Kind = "refuted" if upper_float(gap) < 0 else "proved" if gap >= 0 else "undecided"
        witness = {f"y{i + 1}": float(c) for i, c in enumerate(y)}
        return Verdict(claim, kind, float(gap.mid()), "", witness, f"{BITS}-bit balls", details)
