"""Proved regions of attraction on the surface: sublevel sets, verified box by box.

The motion on the surface, in y = (q_u, q̇_u, w) with w = q_a + λ_a⁻¹ λ_u q_u, is

    q̇_a = −α_a⁻¹ (λ_a w + α_u q̇_u),      ẇ = q̇_a + λ_a⁻¹ λ_u q̇_u,
    E q̈_u = f_u + M_auᵀ α_a⁻¹ λ_a ẇ,     E = M_uu − M_auᵀ α_a⁻¹ α_u,

from the mechanism's own expressions.  The claim: with V an even polynomial without constant
term in x = T⁻¹ y, the component K of {V ≤ level} that contains 0 is compact, inside the
non-singular set, positively invariant, and every motion from it converges to 0.

The proof, in outward-rounded arithmetic over a box D around 0:

1. V > level on the boundary of D, so K is compact and inside D.
2. Wherever V ≤ level in D: E is invertible and V̇ < 0, but for a small cube around 0.
3. In that cube V̇ = ½ xᵀH(ζx)x with an interval Hessian H that is negative definite
   (V̇ and its gradient vanish at 0, because f and ∇V do).

V never grows in K, so motions cannot leave it, and LaSalle's theorem gives convergence.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import sympy as sp
from numpy.typing import ArrayLike, NDArray

from undertow.certify.batch import Interval, IntervalArithmetic
from undertow.certify.interval import OutwardFunction, compile_outward, derivative_tape
from undertow.certify.verdict import Verdict
from undertow.codegen import Tape, compile_numpy
from undertow.errors import InvalidInputError
from undertow.mechanism import TIME, Mechanism
from undertow.sliding import Surface, check_surface_shape

__all__ = ["LyapunovFunction", "SurfaceMotion", "verify_region"]

FloatArray = NDArray[np.float64]


def _exact(block: ArrayLike) -> sp.Matrix:
    array = np.asarray(block, dtype=float)
    return sp.Matrix(
        *array.shape, [sp.Rational(*float(v).as_integer_ratio()) for v in array.ravel()]
    )


@dataclass(frozen=True)
class LyapunovFunction:
    """V(y) = Σ c_k Π x_i^e_ki with y = T x; the set is {V ≤ 1}.

    Parameters
    ----------
    scale
        T, (N, N), invertible.
    exponents
        e, (K, N): whole numbers of even sum ≥ 2.
    coefficients
        c, (K,).
    """

    scale: FloatArray
    exponents: NDArray[np.int64]
    coefficients: FloatArray

    def __post_init__(self) -> None:
        """Refuse what is no even polynomial without constant term."""
        totals = np.asarray(self.exponents).sum(axis=1)
        if (totals % 2).any() or (totals < 2).any() or (np.asarray(self.exponents) < 0).any():
            raise InvalidInputError(
                "exponents of a Lyapunov function", limit="whole numbers of even sum ≥ 2"
            )
        if len(self.coefficients) != len(self.exponents):
            raise InvalidInputError(
                "coefficients of a Lyapunov function",
                value=len(self.coefficients),
                limit=f"{len(self.exponents)}, one per monomial",
            )

    def __call__(self, y: ArrayLike) -> FloatArray:
        """Return V at the points y, (…, N)."""
        x = np.asarray(y, dtype=float) @ np.linalg.inv(self.scale).T
        powers = np.prod(x[..., None, :] ** self.exponents, axis=-1)
        return np.asarray(powers @ self.coefficients)

    def times(self, factor: float) -> LyapunovFunction:
        """Return the function whose set is the smaller {V ≤ 1/factor} (for factor > 1)."""
        return LyapunovFunction(self.scale, self.exponents, self.coefficients * factor)


@dataclass(frozen=True, eq=False)
class SurfaceMotion:
    """The sliding dynamics of a mechanism in y = (q_u, q̇_u, w), of order N = 2n − m.

    Raises
    ------
    InvalidInputError
        For a surface of another size, with a singular λ_a, or a force that depends on time.
    """

    mechanism: Mechanism
    surface: Surface
    _cache: dict[str, Any] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        """Check sizes and that w exists."""
        check_surface_shape(self.mechanism, self.surface)
        if TIME in self.mechanism.force.free_symbols:
            raise InvalidInputError(
                f"force of '{self.mechanism.name}'",
                value="depends on time",
                limit="autonomous",
                remedy="Prove the region for the undisturbed mechanism",
            )
        if abs(np.linalg.det(self.surface.lambda_a)) < 1e-12:
            raise InvalidInputError(
                "surface for a region of attraction",
                value="λ_a singular",
                limit="λ_a invertible",
                remedy="With λ_a singular the actuated coordinates do not converge",
            )

    @property
    def size(self) -> int:
        """N = 2n − m."""
        return 2 * self.mechanism.n - self.mechanism.m

    @property
    def names(self) -> tuple[str, ...]:
        """Names of y."""
        c = self.mechanism.coordinates
        free = c[self.mechanism.m :]
        return (
            *(k.name for k in free),
            *(f"{k.name}_dot" for k in free),
            *(f"w_{k.name}" for k in c[: self.mechanism.m]),
        )

    def lay(self, tape: Tape, y: Sequence[sp.Expr]) -> tuple[list[sp.Expr], sp.Expr]:
        """Lay ẏ and det E on a tape, for y given as atoms."""
        mechanism, surface = self.mechanism, self.surface
        m, free = mechanism.m, mechanism.n - mechanism.m
        q_u, v_u, w = (
            sp.Matrix(y[:free]), sp.Matrix(y[free : 2 * free]), sp.Matrix(y[2 * free :])
        )  # fmt: skip
        inverse = _exact(surface.alpha_a).inv()
        ratio = _exact(surface.lambda_a).inv() * _exact(surface.lambda_u)
        q_a = tape.matrix(w - ratio * q_u)
        v_a = tape.matrix(-inverse * (_exact(surface.lambda_a) * w + _exact(surface.alpha_u) * v_u))
        w_dot = tape.matrix(v_a + ratio * v_u)
        rename = dict(zip(mechanism.x, [*q_a, *q_u, *v_a, *v_u], strict=True))
        rows = [*mechanism.mass_matrix[m:, :], *mechanism.force[m:, :]]
        atoms = tape.let_all([e.xreplace(rename) for e in rows])
        M = sp.Matrix(free, mechanism.n, atoms[: free * mechanism.n])
        f_u = sp.Matrix(atoms[free * mechanism.n :])
        pull = tape.matrix(M[:, :m] * inverse)
        E = tape.matrix(M[:, m:] - pull * _exact(surface.alpha_u))
        right = tape.matrix(f_u + pull * (_exact(surface.lambda_a) * w_dot))
        adjugate, determinant = tape.adjugate(E)
        reciprocal = tape.let(1 / determinant)
        acceleration = tape.matrix(tape.product(adjugate, right) * reciprocal)
        return [*v_u, *acceleration, *w_dot], determinant

    @cached_property
    def symbols(self) -> tuple[sp.Symbol, ...]:
        """Symbols of the N coordinates x or y."""
        return tuple(sp.Symbol(f"y_{i}", real=True) for i in range(self.size))

    @cached_property
    def _field(self) -> Any:
        tape = Tape()
        rates, determinant = self.lay(tape, self.symbols)
        return compile_numpy(
            tape, [*self.symbols, *self.mechanism.parameter_symbols], [*rates, determinant]
        )

    def __call__(self, y: ArrayLike) -> FloatArray:
        """Return ẏ at the points y: (…, N) to (…, N)."""
        columns = np.moveaxis(np.asarray(y, dtype=float), -1, 0)
        with np.errstate(all="ignore"):
            values = self._field(*columns, *self.mechanism.parameter_values)[:-1]
        return np.stack([np.broadcast_to(v, columns.shape[1:]) for v in values], axis=-1)

    def determinant(self, y: ArrayLike) -> FloatArray:
        """Return det E at the points y, (…,)."""
        columns = np.moveaxis(np.asarray(y, dtype=float), -1, 0)
        with np.errstate(all="ignore"):
            value = self._field(*columns, *self.mechanism.parameter_values)[-1]
        return np.asarray(np.broadcast_to(value, columns.shape[1:]))

    @cached_property
    def odd(self) -> bool:
        """Whether ẏ(−y) = −ẏ(y), decided on the mechanism's expressions."""
        flip = {s: -s for s in self.mechanism.x}
        even = self.mechanism.mass_matrix - self.mechanism.mass_matrix.xreplace(flip)
        odd = self.mechanism.force + self.mechanism.force.xreplace(flip)
        return all(sp.expand(e) == 0 for e in [*even, *odd])

    @cached_property
    def at_rest(self) -> bool:
        """Whether f_u(0, 0) = 0 for all parameter values, decided symbolically."""
        origin = dict.fromkeys(self.mechanism.x, 0)
        rest = self.mechanism.force[self.mechanism.m :, :].subs(origin)
        return all(sp.simplify(e) == 0 for e in rest)


# -- the checker -----------------------------------------------------------------------------


class _Enclosures:
    """V, V̇ and their derivatives in x as outward-rounded functions."""

    def __init__(
        self,
        motion: SurfaceMotion,
        V: LyapunovFunction,
        parameters: Mapping[str, tuple[float, float]],
    ) -> None:
        tape, x = Tape(), motion.symbols
        T = _exact(V.scale)
        y = tape.matrix(T * sp.Matrix(x))
        rates, _ = motion.lay(tape, list(y))
        x_dot = tape.matrix(T.inv() * sp.Matrix(rates))
        terms = [
            sp.Rational(*float(c).as_integer_ratio())
            * sp.Mul(*[s ** int(k) for s, k in zip(x, e, strict=True)])
            for c, e in zip(V.coefficients, V.exponents, strict=True)
        ]
        whole = sp.Add(*terms)
        slope = tape.let_all([sp.diff(whole, s) for s in x])
        value = tape.let(whole)
        rate = tape.let(sum(a * b for a, b in zip(slope, x_dot, strict=True)))
        gradient = derivative_tape(tape, x, rate)
        inputs = [*x, *motion.mechanism.parameter_symbols]
        self.point = self._compile(tape, inputs, [value, rate])
        self.box = self._compile(tape, inputs, [value, rate, *slope, *gradient])
        self._tape, self._inputs, self._gradient = tape, inputs, gradient
        self._x = x
        self.parameters = []
        for p in motion.mechanism.parameters:
            low, high = parameters.get(p.name, (p.value, p.value))
            self.parameters.append(Interval(low, high))

    @staticmethod
    def _compile(
        tape: Tape, inputs: Sequence[sp.Symbol], outputs: Sequence[sp.Expr]
    ) -> OutwardFunction:
        return compile_outward(tape, inputs, outputs, IntervalArithmetic())

    def hessian(self, x: list[Interval]) -> list[list[Interval]]:
        """Interval Hessian of V̇ over a box."""
        size = len(self._x)
        rows = [derivative_tape(self._tape, self._x, g) for g in self._gradient]
        run = self._compile(self._tape, self._inputs, [e for row in rows for e in row])
        flat = [Interval.of(v) for v in run(*x, *self.parameters)]
        return [flat[i * size : (i + 1) * size] for i in range(size)]

    def over(self, low: FloatArray, high: FloatArray) -> tuple[Interval, Interval, FloatArray]:
        """V and V̇ over boxes (N, B): natural and mean-value forms, and where to split."""
        size = len(low)
        middle = 0.5 * (low + high)
        box = [Interval(low[i], high[i]) for i in range(size)]
        away = [box[i] - Interval(middle[i]) for i in range(size)]
        at = self.point(*[Interval(middle[i]) for i in range(size)], *self.parameters)
        value, rate, *slopes = (Interval.of(v) for v in self.box(*box, *self.parameters))
        mean_value, mean_rate = at
        spread = []
        for i in range(size):
            mean_value = mean_value + slopes[i] * away[i]
            part = slopes[size + i] * away[i]
            mean_rate = mean_rate + part
            spread.append(np.broadcast_to(part.hi - part.lo, low.shape[1:]))
        return value.intersect(mean_value), rate.intersect(mean_rate), np.array(spread)


def _negative_definite(H: list[list[Interval]]) -> bool:
    """Whether every symmetric matrix in an interval matrix is negative definite.

    A float congruence brings the middle near −I; then Gershgorin's discs decide, in
    outward-rounded arithmetic.
    """
    size = len(H)
    middle = np.array([[float(0.5 * (h.lo + h.hi)) for h in row] for row in H])
    if not np.isfinite(middle).all():
        return False
    values, vectors = np.linalg.eigh(-0.5 * (middle + middle.T))
    if not values[0] > 0:
        return False
    S = vectors / np.sqrt(values)
    for i in range(size):
        worst = Interval(0.0)
        for j in range(size):
            entry = Interval(0.0)
            for a, b in itertools.product(range(size), repeat=2):
                both = 0.5 * (H[a][b] + H[b][a])  # the Hessian is symmetric
                entry = entry + both * (Interval(S[a, i]) * Interval(S[b, j]))
            worst = worst + (entry if i == j else abs(entry))
        if not float(worst.hi) < 0:
            return False
    # S must be invertible for the congruence: its determinant, in intervals.
    D = Interval(0.0)
    for order in itertools.permutations(range(size)):
        sign = np.linalg.det(np.eye(size)[list(order)])
        product = Interval(float(round(sign)))
        for i, j in enumerate(order):
            product = product * Interval(S[i, j])
        D = D + product
    return bool((D.lo > 0) | (D.hi < 0))


def verify_region(
    motion: SurfaceMotion,
    V: LyapunovFunction,
    *,
    parameters: Mapping[str, tuple[float, float]] | None = None,
    max_boxes: int = 20_000_000,
    max_seconds: float = 600.0,
    chunk: int = 4096,
) -> Verdict:
    """Decide whether {V ≤ 1} is a region of attraction on the surface.

    Parameters
    ----------
    motion
        The sliding dynamics.
    V
        The function; the set is the component of {V ≤ 1} that contains 0.
    parameters
        Plant parameters that are only known to lie in [low, high], SI units; the set is
        then one for every plant in the box (with the surface as it is).
    max_boxes, max_seconds
        Effort before giving up.

    Returns
    -------
    Verdict
        ``proved``: every motion from the set stays in it, avoids the singularity and
        converges (on the surface).  ``refuted``: at the witness V ≤ 1 and V̇ > 0, proved
        in intervals.  ``undecided``: the witness is the box where it got stuck.
    """
    started = time.monotonic()
    claim = "{V ≤ 1} is a region of attraction on the surface, non-singular and compact"
    method = "branch and bound, outward-rounded float64 intervals, mean-value form"
    box_parameters = dict(parameters or {})
    unknown = set(box_parameters) - {p.name for p in motion.mechanism.parameters}
    if unknown:
        raise InvalidInputError("parameter box", value=", ".join(sorted(unknown)))
    if not motion.at_rest:
        return Verdict(claim, "undecided", method="f_u(0, 0) = 0 cannot be shown symbolically")
    reach = _reach(V)
    if reach is None:
        return Verdict(claim, "undecided", method="no box was found that holds {V ≤ 1}")
    enclosures = _Enclosures(motion, V, box_parameters)
    size = motion.size

    core = 0.25 * reach
    for _ in range(14):
        cube = [Interval(-c, c) for c in core]
        if _negative_definite(enclosures.hessian(cube)):
            break
        core = core / 1.6
    else:
        return Verdict(claim, "undecided", method="V̇ is not negative definite at 0, as far as seen")

    def finish(kind: Any, witness: FloatArray | None, boxes: int, why: str = "") -> Verdict:
        point = {} if witness is None else dict(
            zip(motion.names, (V.scale @ witness).tolist(), strict=True)
        )  # fmt: skip
        details = {
            "boxes": boxes,
            "seconds": time.monotonic() - started,
            "core": core.tolist(),
            "box": reach.tolist(),
            "parameters": box_parameters,
        }
        return Verdict(claim, kind, witness=point, method=method + why, details=details)

    # Boxes still to do: the inside, and the faces of D, where only V > 1 will do.
    start = [(-reach, reach, False)]
    if motion.odd:
        half = -reach.copy()
        half[-1] = 0.0
        start = [(half, reach, False)]
    for i, end in itertools.product(range(size), (-1, 1)):
        a, b = -reach.copy(), reach.copy()
        a[i] = b[i] = end * reach[i]
        start.append((a, b, True))
    low = np.array([s[0] for s in start]).T
    high = np.array([s[1] for s in start]).T
    face = np.array([s[2] for s in start])
    count = 0
    while low.shape[1]:
        # Depth first: the newest boxes, which are the smallest, at the end of the arrays.
        a, b, f = low[:, -chunk:], high[:, -chunk:], face[-chunk:]
        low, high, face = low[:, :-chunk], high[:, :-chunk], face[:-chunk]
        count += a.shape[1]
        value, rate, spread = enclosures.over(a, b)
        inside_core = (np.abs(a) <= core[:, None]).all(0) & (np.abs(b) <= core[:, None]).all(0)
        done = (value.lo > 1.0) | (~f & ((rate.hi < 0.0) | inside_core))
        if done.all():
            continue
        a, b, f, spread = a[:, ~done], b[:, ~done], f[~done], spread[:, ~done]
        tiny = (b - a).max(axis=0) < 1e-7 * reach.max()
        effort = count > max_boxes or time.monotonic() - started > max_seconds
        suspects = np.flatnonzero(tiny) if tiny.any() else np.arange(min(len(f), 64))
        middle = 0.5 * (a[:, suspects] + b[:, suspects])
        at_value, at_rate = enclosures.point(
            *[Interval(row) for row in middle], *enclosures.parameters
        )
        wrong = (at_value.hi <= 1.0) & (f[suspects] | (at_rate.lo > 0.0))
        outside = (np.abs(middle) > core[:, None]).any(0)
        if (wrong & outside).any():
            k = int(np.flatnonzero(wrong & outside)[0])
            return finish("refuted", middle[:, k], count)
        if tiny.any() or effort:
            k = int(np.flatnonzero(tiny)[0]) if tiny.any() else 0
            why = ", stuck in a tiny box" if tiny.any() else ", effort ran out"
            return finish("undecided", 0.5 * (a[:, k] + b[:, k]), count, why)
        # Split where V̇ varies most; where that is not finite, the longest side.
        width = np.where(b > a, (b - a) / reach[:, None], 0.0)
        weight = np.where(np.isfinite(spread).all(axis=0) & ~f, spread, width)
        weight = np.where(width > 0.02 * width.max(axis=0), weight, 0.0)
        axis = np.argmax(weight, axis=0)
        columns = np.arange(a.shape[1])
        cut = 0.5 * (a[axis, columns] + b[axis, columns])
        left, right = b.copy(), a.copy()
        left[axis, columns] = cut
        right[axis, columns] = cut
        low = np.concatenate([low, a, right], axis=1)
        high = np.concatenate([high, left, b], axis=1)
        face = np.concatenate([face, f, f])
    return finish("proved", None, count)


def _reach(V: LyapunovFunction) -> FloatArray | None:
    """Half-sides of a box in x that holds {V ≤ 1} with room, by rays in float64."""
    size = V.exponents.shape[1]
    rng = np.random.default_rng(0)
    rays = rng.normal(size=(20000, size))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    radius = first_crossing(V, rays)
    if not np.isfinite(radius).all():
        return None
    return np.asarray(1.04 * np.abs(rays * radius[:, None]).max(axis=0))


def first_crossing(V: LyapunovFunction, rays: FloatArray, level: float = 1.0) -> FloatArray:
    """Return the first r > 0 with V(T r·ray) = level along rays in x, inf where none.

    Along a ray V is a polynomial in r²: a scan in 3 % steps finds the crossing (a narrower
    double crossing is missed, which a search can bear), and bisection refines it.
    """
    totals = V.exponents.sum(axis=1)
    powers = np.ones((len(rays), len(V.exponents)))
    for j in range(rays.shape[1]):
        table = rays[:, j, None] ** np.arange(V.exponents.max() + 1)
        powers *= table[:, V.exponents[:, j]]
    parts = {
        int(d): powers[:, totals == d] @ V.coefficients[totals == d] for d in np.unique(totals)
    }

    def value(r: FloatArray) -> FloatArray:
        square = r * r
        total = np.zeros(np.broadcast_shapes(r.shape, (len(rays),)))
        for d in sorted(parts, reverse=True):
            total = total + parts[d] * square ** (d // 2)
        return np.asarray(total)

    size = 1.0 / np.sqrt(max(1e-300, float(np.median(np.abs(parts[2]))) if 2 in parts else 1.0))
    grid = size * np.sqrt(level) * np.geomspace(0.02, 40.0, 257)
    above = value(grid[:, None]) >= level
    first = above.argmax(axis=0)
    high = np.where(above.any(axis=0), grid[first], np.inf)
    low = np.where(first > 0, grid[np.maximum(first - 1, 0)], 0.0)
    finite = np.isfinite(high)
    upper, lower = np.where(finite, high, 1.0), np.where(finite, low, 0.0)
    for _ in range(40):
        middle = 0.5 * (lower + upper)
        up = value(middle) >= level
        upper, lower = np.where(up, middle, upper), np.where(up, lower, middle)
    return np.where(finite, upper, np.inf)
