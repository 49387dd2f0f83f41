"""Proved regions of attraction: sublevel sets, verified box by box.

On a surface the motion, in y = (q_u, q̇_u, w) with w = q_a + λ_a⁻¹ λ_u q_u, is

    q̇_a = −α_a⁻¹ (λ_a w + α_u q̇_u),      ẇ = q̇_a + λ_a⁻¹ λ_u q̇_u,
    E q̈_u = f_u + M_auᵀ α_a⁻¹ λ_a ẇ,     E = M_uu − M_auᵀ α_a⁻¹ α_u,

from the mechanism's own expressions (:class:`undertow.certify.motion.SurfaceMotion`).  The
claim: the component K of {V ≤ 1} that contains 0 is compact, inside the non-singular set,
positively invariant, and every motion from it converges to 0.

The proof, in outward-rounded arithmetic over a box D around 0:

1. V > 1 on the boundary of D, so K is compact and inside D.
2. Wherever V ≤ 1 in D: E is invertible and V̇ < 0, but for a small cube around 0.
3. In that cube V̇ = ½ xᵀH(ζx)x with an interval Hessian H that is negative definite
   (V̇ and its gradient vanish at 0, because f and ∇V do).

So V falls along every motion in K, which therefore cannot leave K, and V → 0.  Since V̇ < 0
all over K but 0, V has its minimum over K there: V > 0 elsewhere, and the motion goes to 0.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import sympy as sp
from numpy.typing import NDArray

from undertow.certify.batch import Interval, IntervalArithmetic
from undertow.certify.interval import OutwardFunction, compile_outward, derivative_tape
from undertow.certify.lyapunov import LyapunovFunction, first_crossing
from undertow.certify.motion import Motion, SurfaceMotion, VectorField, exact_matrix
from undertow.certify.verdict import Verdict
from undertow.codegen import Tape
from undertow.errors import InvalidInputError

__all__ = ["LyapunovFunction", "SurfaceMotion", "VectorField", "first_crossing", "verify_region"]

FloatArray = NDArray[np.float64]


class _Enclosures:
    """V, V̇ and their derivatives as outward-rounded functions of x (y = B x) and of p."""

    def __init__(
        self,
        motion: Motion,
        V: LyapunovFunction,
        B: FloatArray,
        parameters: Mapping[str, tuple[float, float]],
    ) -> None:
        tape, x = Tape(), motion.symbols
        y = list(tape.matrix(exact_matrix(B) * sp.Matrix(x)))
        rates, _ = motion.lay(tape, y)
        value, rate = V.lay(tape, y, rates)
        free = [p.symbol for p in motion.parameters if p.name in parameters]
        fixed = [p for p in motion.parameters if p.name not in parameters]
        variables = [*x, *free]
        slope = derivative_tape(tape, variables, value)
        gradient = derivative_tape(tape, variables, rate)
        inputs = [*variables, *(p.symbol for p in fixed)]
        self._constants = [Interval(p.value) for p in fixed]
        self.point = self._compile(tape, inputs, [value, rate])
        self.box = self._compile(tape, inputs, [value, rate, *slope, *gradient])
        self._tape, self._inputs, self._gradient, self._x = tape, inputs, gradient, x
        self._second: OutwardFunction | None = None

    def _compile(
        self, tape: Tape, inputs: Sequence[sp.Symbol], outputs: Sequence[sp.Expr]
    ) -> OutwardFunction:
        run = compile_outward(tape, inputs, outputs, IntervalArithmetic())
        return lambda *variables: run(*variables, *self._constants)

    def hessian(self, box: list[Interval]) -> list[list[Interval]]:
        """Interval Hessian of V̇ in x over a box."""
        size = len(self._x)
        if self._second is None:
            rows = [derivative_tape(self._tape, self._x, g) for g in self._gradient[:size]]
            self._second = self._compile(self._tape, self._inputs, [e for row in rows for e in row])
        flat = [Interval.of(v) for v in self._second(*box)]
        return [flat[i * size : (i + 1) * size] for i in range(size)]

    def over(self, low: FloatArray, high: FloatArray) -> tuple[Interval, Interval, FloatArray]:
        """V and V̇ over boxes (N + P, B): natural and mean-value forms, and where to split."""
        size = len(low)
        middle = 0.5 * (low + high)
        box = [Interval(low[i], high[i]) for i in range(size)]
        away = [box[i] - Interval(middle[i]) for i in range(size)]
        at = self.point(*[Interval(middle[i]) for i in range(size)])
        value, rate, *slopes = (Interval.of(v) for v in self.box(*box))
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
    motion: Motion,
    V: LyapunovFunction,
    *,
    parameters: Mapping[str, tuple[float, float]] | None = None,
    max_boxes: int = 20_000_000,
    max_seconds: float = 600.0,
    chunk: int = 4096,
) -> Verdict:
    """Decide whether {V ≤ 1} is a region of attraction.

    Parameters
    ----------
    motion
        The sliding dynamics, or any vector field.
    V
        The function; the set is the component of {V ≤ 1} that contains 0.
    parameters
        Parameters that are only known to lie in [low, high], SI units; the set is
        then one for every constant value in the box (with the surface as it is).
    max_boxes, max_seconds
        Effort before giving up.

    Returns
    -------
    Verdict
        ``proved``: every motion from the set stays in it, avoids the singularity and
        converges.  ``refuted``: at the witness V ≤ 1 and V̇ > 0, proved in intervals.
        ``undecided``: the witness is the box where it got stuck, or where {V ≤ 1} meets the
        boundary of the box D, so that it may be unbounded or reach the singularity.

    Raises
    ------
    InvalidInputError
        For an unknown parameter, an empty interval, or a V of another size.
    """
    started, used = time.monotonic(), time.process_time()
    claim = "{V ≤ 1} is a region of attraction on the surface, non-singular and compact"
    method = "branch and bound, outward-rounded float64 intervals, mean-value form"
    box_parameters = dict(parameters or {})
    _check(motion, V, box_parameters)
    if not motion.at_rest:
        return Verdict(claim, "undecided", method="f(0) = 0 cannot be shown symbolically")
    frame = _frame(motion, V)
    if frame is None:
        return Verdict(claim, "undecided", method="no box was found that holds {V ≤ 1}")
    B, reach = frame
    enclosures = _Enclosures(motion, V, B, box_parameters)
    size = motion.size
    names = [p.name for p in motion.parameters if p.name in box_parameters]
    ends = np.array([box_parameters[k] for k in names], dtype=float).reshape(-1, 2).T

    # The parameters in slices that cover their box: neighbours share their end.
    cuts = [np.linspace(*box_parameters[k], 17 if len(names) == 1 else 5) for k in names]
    slices = list(
        itertools.product(*([Interval(a, b) for a, b in itertools.pairwise(c)] for c in cuts))
    )
    core = 0.25 * reach
    for _ in range(24):
        cube = [Interval(-c, c) for c in core]
        if all(_negative_definite(enclosures.hessian([*cube, *part])) for part in slices):
            break
        core = core / 1.6
    else:
        return Verdict(claim, "undecided", method="V̇ is not negative definite at 0, as far as seen")

    def finish(kind: Any, witness: FloatArray | None, boxes: int, why: str = "") -> Verdict:
        point = {}
        if witness is not None:
            point = dict(zip(motion.names, (B @ witness[:size]).tolist(), strict=True))
            point |= dict(zip(names, witness[size:].tolist(), strict=True))
        details = {
            "boxes": boxes,
            "seconds": time.monotonic() - started,
            "process_seconds": time.process_time() - used,
            "core": core.tolist(),
            "box": reach.tolist(),
            "parameters": box_parameters,
        }
        return Verdict(claim, kind, witness=point, method=method + why, details=details)

    suspect = _sampled_witness(V, B, core, ends, enclosures)
    if suspect is not None:
        return finish("refuted", suspect, 0)

    # Boxes still to do: the inside, and the faces of D, where only V > 1 will do.
    start = [(-reach, reach, False)]
    if motion.odd:  # V is even: half of D will do
        half = reach.copy()
        half[-1] = 0.0
        start = [(-reach, half, False)]
    for i, end in itertools.product(range(size), (-1, 1)):
        a, b = -reach.copy(), reach.copy()
        a[i] = b[i] = end * reach[i]
        start.append((a, b, True))
    low = np.array([np.append(s[0], ends[0]) for s in start]).T
    high = np.array([np.append(s[1], ends[1]) for s in start]).T
    face = np.array([s[2] for s in start])
    unit = np.append(reach, 0.5 * (ends[1] - ends[0]))
    unit[unit == 0] = 1.0
    count = 0
    while low.shape[1]:
        # Depth first: the newest boxes, which are the smallest, at the end of the arrays.
        a, b, f = low[:, -chunk:], high[:, -chunk:], face[-chunk:]
        low, high, face = low[:, :-chunk], high[:, :-chunk], face[:-chunk]
        count += a.shape[1]
        value, rate, spread = enclosures.over(a, b)
        inside_core = (np.maximum(np.abs(a), np.abs(b))[:size] <= core[:, None]).all(0)
        done = (value.lo > 1.0) | (~f & ((rate.hi < 0.0) | inside_core))
        if done.all():
            continue
        a, b, f, spread = a[:, ~done], b[:, ~done], f[~done], spread[:, ~done]
        tiny = ((b - a) / unit[:, None]).max(axis=0) < 1e-7
        effort = count > max_boxes or time.monotonic() - started > max_seconds
        suspects = np.flatnonzero(tiny) if tiny.any() else np.arange(min(len(f), 64))
        middle = 0.5 * (a[:, suspects] + b[:, suspects])
        at_value, at_rate = enclosures.point(*[Interval(row) for row in middle])
        wrong = (at_value.hi <= 1.0) & ~f[suspects] & (at_rate.lo > 0.0)
        outside = (np.abs(middle[:size]) > core[:, None]).any(0)
        if (wrong & outside).any():
            k = int(np.flatnonzero(wrong & outside)[0])
            return finish("refuted", middle[:, k], count)
        if (f[suspects] & (at_value.hi <= 1.0)).any():
            k = int(np.flatnonzero(f[suspects] & (at_value.hi <= 1.0))[0])
            return finish("undecided", middle[:, k], count, ", V ≤ 1 on the boundary of the box")
        if tiny.any() or effort:
            k = int(np.flatnonzero(tiny)[0]) if tiny.any() else 0
            why = ", stuck in a tiny box" if tiny.any() else ", effort ran out"
            return finish("undecided", 0.5 * (a[:, k] + b[:, k]), count, why)
        # Split where V̇ varies most; where that is not finite, the longest side.
        width = np.where(b > a, (b - a) / unit[:, None], 0.0)
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


def _check(
    motion: Motion, V: LyapunovFunction, parameters: Mapping[str, tuple[float, float]]
) -> None:
    """Refuse what does not fit together."""
    if V.exponents.shape[1] != motion.size:
        raise InvalidInputError(
            "size of a Lyapunov function", value=V.exponents.shape[1], limit=motion.size
        )
    unknown = set(parameters) - {p.name for p in motion.parameters}
    if unknown:
        raise InvalidInputError("parameter box", value=", ".join(sorted(unknown)))
    for name, (low, high) in parameters.items():
        if not (np.isfinite([low, high]).all() and low <= high):
            raise InvalidInputError(
                f"parameter box of '{name}'", value=(low, high), limit="finite, low ≤ high"
            )


def _frame(motion: Motion, V: LyapunovFunction) -> tuple[FloatArray, FloatArray] | None:
    """B, lower triangular, and half-sides in x = B⁻¹y of a box that holds {V ≤ 1} with room.

    By rays in float64: the checker's faces decide whether it is so.  A triangular B keeps
    x_0 parallel to y_0, so that the box can end before the singularity and V's pole.
    """
    rng = np.random.default_rng(0)
    rays = rng.normal(size=(20000, motion.size))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    radius = first_crossing(V, rays)
    if not np.isfinite(radius).all():
        return None
    edge = V.points(rays * radius[:, None])
    B = np.linalg.cholesky(np.cov(edge.T, bias=True) + 1e-300 * np.eye(motion.size)).reshape(
        motion.size, motion.size
    )
    reach = np.abs(np.linalg.solve(B, edge.T)).max(axis=1)
    room = 0.04 * reach
    ahead = np.zeros(motion.size)
    ahead[0] = 1.0
    limit = _clear(motion, V, ahead) / B[0, 0]
    if limit > reach[0]:
        room[0] = min(room[0], 0.3 * (limit - reach[0]))
    return np.asarray(B), np.asarray(reach + room)


def _sampled_witness(
    V: LyapunovFunction,
    B: FloatArray,
    core: FloatArray,
    ends: FloatArray,
    enclosures: _Enclosures,
) -> FloatArray | None:
    """A point of the set's star around 0 where V̇ > 0 in intervals; None where none was met.

    Samples and a few rounds of samples near the worst ones: most sets that are too large
    are refuted here, long before branch and bound meets the place.
    """
    rng = np.random.default_rng(1)
    size = len(B)

    def worst(z: FloatArray, p: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray | None]:
        radius = first_crossing(V, z / np.linalg.norm(z, axis=1, keepdims=True))
        z = z[np.linalg.norm(z, axis=1) <= radius]
        p = p[: len(z)]
        x = np.vstack([np.linalg.solve(B, V.points(z).T), p.T])
        value, rate = enclosures.point(*[Interval(row) for row in x])
        wrong = (value.hi <= 1.0) & (rate.lo > 0.0) & (np.abs(x[:size]) > core[:, None]).any(0)
        witness = x[:, int(np.flatnonzero(wrong)[0])] if wrong.any() else None
        score = np.nan_to_num(rate.hi / np.sum(z * z, axis=1), nan=-np.inf)
        best = np.argsort(score)[-200:]
        return z[best], p[best], witness

    count = 20_000
    rays = rng.normal(size=(count, size))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    z = rays * (first_crossing(V, rays) * rng.random(count) ** 0.3)[:, None]
    p = rng.uniform(ends[0], ends[1], (count, ends.shape[1]))
    for width in (0.1, 0.03, 0.01, 0.003, 0.0):
        z, p, witness = worst(z, p)
        if witness is not None:
            return witness
        z, p = np.repeat(z, 20, axis=0), np.repeat(p, 20, axis=0)
        z = z + width * rng.normal(size=z.shape) * np.linalg.norm(z, axis=1, keepdims=True)
    return None


def _clear(motion: Motion, V: LyapunovFunction, way: FloatArray) -> float:
    """How far along ±way the motion is non-singular and V is defined, in float64."""
    far = V.pole if np.isfinite(V.pole) else 10.0 * np.abs(V.scale).max()
    steps = far * np.linspace(0.0, 1.0, 2001)[:-1]
    ratio = motion.determinant(steps[:, None] * way) / motion.determinant(0.0 * way)
    bad = ~(ratio > 0)
    return float(steps[bad.argmax()]) if bad.any() else float(V.pole)
