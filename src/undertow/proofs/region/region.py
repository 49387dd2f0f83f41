"""Proved regions of attraction: sublevel sets, verified box by box.

On a surface the motion, in y = (q_u, q̇_u, w) with w = q_a + λ_a⁻¹ λ_u q_u, is

    q̇_a = −α_a⁻¹ (λ_a w + α_u q̇_u),      ẇ = q̇_a + λ_a⁻¹ λ_u q̇_u,
    E q̈_u = f_u + M_auᵀ α_a⁻¹ λ_a ẇ,     E = M_uu − M_auᵀ α_a⁻¹ α_u,

from the mechanism's own expressions (:class:`undertow.proofs.region.motion.SurfaceMotion`).  The
claim: the component K of {V ≤ 1} that contains 0 is compact, inside the non-singular set, and
every motion from it converges to 0 and stays in K, or for a chain (below) in the union of its sets.

The proof, in outward-rounded arithmetic over a box D around 0:

1. V > 1 on the boundary of D, so K is compact and inside D.
2. Wherever V ≤ 1 in D: E is invertible and V̇ < 0, but for a small cube around 0.
3. In that cube V̇ = ½ xᵀH(ζx)x with an interval Hessian H that is negative definite
   (V̇ and its gradient vanish at 0, because f and ∇V do).

So V falls along every motion in K, which therefore cannot leave K, and V → 0.  Since V̇ < 0
all over K but 0, V has its minimum over K there: V > 0 elsewhere, and the motion goes to 0.

**Chains.**  One polynomial that falls everywhere is too much to ask of a large set.  In a chain
V_1, V_2, … only V_1 is asked for all of the above; V_k has to fall on {V_k ≤ 1} without
{V_(k-1) ≤ 1}.  A motion from {V_k ≤ 1} cannot leave it before it enters {V_(k-1) ≤ 1}, and does
that in finite time, because V̇_k is bounded away from 0 on a compact set.  So by induction
{V_k ≤ 1} is a region of attraction too.  It need not be invariant by itself: a motion may leave it
within {V_(k-1) ≤ 1}.  The union of the chain's sets is.

D is a guard {U ≤ 1}, |y_0| < L, inside a box: a quadratic U in the coordinates of V, around its
set.  U > 1 is shown on the faces of the box, so that D, which is connected, is inside; and
V > 1 where U = 1.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from undertow.base.verdict import Kind, Verdict
from undertow.models.mechanism import FloatArray
from undertow.proofs.intervals.batch import Interval, bisected
from undertow.proofs.intervals.require import require
from undertow.proofs.region.lyapunov import LyapunovFunction, directions, first_crossing
from undertow.proofs.region.motion import AutonomousSystem
from undertow.proofs.region.stage import Chart, Stage, stretched_alike

__all__ = ["verify_region"]


def _negative_definite(H: list[list[Interval]]) -> bool:
    """Whether every symmetric matrix in an interval matrix is negative definite.

    A float congruence brings the middle near −I; then Gershgorin's discs decide, in
    outward-rounded arithmetic.
    """
    size = len(H)
    with np.errstate(invalid="ignore"):  # an unbounded entry: no proof
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
    motion: AutonomousSystem,
    V: LyapunovFunction | Sequence[LyapunovFunction],
    *,
    parameters: Mapping[str, tuple[float, float]] | None = None,
    max_boxes: int = 20_000_000,
    max_seconds: float = 600.0,
    chunk: int = 4096,
    proved: int = 0,
) -> Verdict:
    """Decide whether {V ≤ 1} is a region of attraction.

    Parameters
    ----------
    motion
        The sliding dynamics, or any vector field.
    V
        The function; the set is the component of {V ≤ 1} that contains 0.  Or a chain of
        functions from the innermost set to the outermost, whose {V ≤ 1} is decided.
    parameters
        Parameters that are only known to lie in [low, high], SI units; the set is
        then one for every constant value in the box (with the surface as it is).
    max_boxes, max_seconds
        Effort before giving up.
    proved
        So many functions at the head of the chain were proved before, with these very
        parameters: they are taken for granted.  For searches; a proof leaves it at 0.

    Returns
    -------
    Verdict
        ``proved``: every motion from the set avoids the singularity and converges.  With one
        function it stays in the set; with a chain only the union of the chain's sets is
        invariant.  ``refuted``: at the witness V ≤ 1 and V̇ > 0, proved in intervals.
        ``undecided``: the witness is the box where it got stuck, or where {V ≤ 1} meets the
        boundary of the box D, so that it may be unbounded or reach the singularity.
        ``details["stage"]`` counts the function that it is about, from 1.

    Raises
    ------
    InvalidInputError
        For an unknown parameter, an empty interval, no function, or one of another size.
    """
    chain = [V] if isinstance(V, LyapunovFunction) else list(V)
    started, used = time.monotonic(), time.process_time()
    claim = "{V ≤ 1} is a region of attraction, non-singular and compact"
    method = "branch and bound, outward-rounded quadratic Taylor models in float64"
    box_parameters = dict(parameters or {})
    _check(motion, chain, box_parameters)
    if not motion.at_rest:
        return Verdict(claim, "undecided", method="f(0) = 0 cannot be shown symbolically")
    boxes, core = 0, np.zeros(motion.size)
    for k in range(proved, len(chain)):
        if k and chain[k - 1].stretch is not None and not stretched_alike(chain[k], chain[k - 1]):
            why = f": functions {k} and {k + 1} have different stretches"
            return Verdict(claim, "undecided", method=method + why, details={"stage": k + 1})
        frame = _frame(motion, chain[max(k - 1, 0) : k + 1])
        if frame is None:
            far = dict(zip(motion.names, _far_point(chain[k]).tolist(), strict=True))
            why = "no box was found that holds {V ≤ 1}"
            return Verdict(claim, "undecided", witness=far, method=why)
        proof = _Proof(motion, chain[k], chain[k - 1] if k else None, frame, box_parameters)
        left = max_seconds - (time.monotonic() - started)
        kind, why, witness, count = proof.decide(max_boxes - boxes, left, chunk)
        boxes += count
        core = proof.core if k == 0 else core
        if kind != "proved":
            break
    details = {
        "stage": k + 1,
        "boxes": boxes,
        "seconds": time.monotonic() - started,
        "process_seconds": time.process_time() - used,
        "core": core.tolist(),
        "box": proof.reach.tolist(),
        "parameters": box_parameters,
    }
    return Verdict(claim, kind, witness=witness, method=method + why, details=details)


class _Proof:
    """One function, over the box |x| ≤ reach."""

    def __init__(
        self,
        motion: AutonomousSystem,
        V: LyapunovFunction,
        inner: LyapunovFunction | None,
        frame: tuple[Chart, FloatArray],
        parameters: Mapping[str, tuple[float, float]],
    ) -> None:
        self.motion, self.V, self.inner = motion, V, inner
        self.chart, self.reach = frame
        self.stage = Stage(motion, V, inner, self.chart, parameters)
        self.names = [p.name for p in motion.parameters if p.name in parameters]
        self.ends = np.array([parameters[k] for k in self.names], dtype=float).reshape(-1, 2).T
        self.core = np.zeros(motion.size)

    def decide(
        self, max_boxes: int, max_seconds: float, chunk: int
    ) -> tuple[Kind, str, dict[str, float], int]:
        """Kind, a remark, the witness and the boxes that it took."""
        if self.inner is None and not self._find_core():
            return "undecided", ": V̇ is not negative definite at 0, as far as seen", {}, 0
        suspect = self._sampled_witness()
        if suspect is not None:
            return "refuted", "", self._named(suspect), 0
        return self._branch(max_boxes, time.monotonic() + max_seconds, chunk)

    def _find_core(self) -> bool:
        """A cube where V̇ = ½ xᵀHx with H ≺ 0, the parameters in slices that share their ends."""
        ends, names = self.ends.T, self.names
        cuts = [np.linspace(a, b, 17 if len(names) == 1 else 5) for a, b in ends]
        slices = list(
            itertools.product(*([Interval(a, b) for a, b in itertools.pairwise(c)] for c in cuts))
        )
        self.core = 0.25 * self.reach
        for _ in range(24):
            cube = [Interval(-c, c) for c in self.core]
            if all(_negative_definite(self.stage.hessian([*cube, *part])) for part in slices):
                return True
            self.core = self.core / 1.6
        return False

    def _named(self, x: FloatArray) -> dict[str, float]:
        size = self.motion.size
        y = self.chart.y(x[:size]).tolist()
        return dict(zip([*self.motion.names, *self.names], [*y, *x[size:].tolist()], strict=True))

    def _wrong(self, x: FloatArray, parts: Sequence[Interval]) -> NDArray[np.bool_]:
        """Points, with V ≤ 1 and V̇ > 0 for certain, that no other function answers for."""
        value, rate, guard = parts[:3]
        wrong = (value.hi <= 1.0) & (rate.lo > 0.0) & (guard.hi <= 1.0)
        if self.inner is not None:
            return np.asarray(wrong & (parts[3].lo > 1.0))
        return np.asarray(wrong & (np.abs(x[: len(self.core)]) > self.core[:, None]).any(0))

    def _done(
        self,
        a: FloatArray,
        b: FloatArray,
        face: NDArray[np.bool_],
        parts: Sequence[Interval],
        settled: NDArray[np.bool_],
    ) -> NDArray[np.bool_]:
        """Boxes that are settled; NaN settles nothing."""
        value, rate, guard = parts[:3]
        outside = (guard.lo > 1.0) | (~face & (value.lo > 1.0))
        if self.inner is None:
            home = (np.maximum(np.abs(a), np.abs(b))[: len(self.core)] <= self.core[:, None]).all(0)
            falls = settled | (rate.hi < 0.0)
        else:
            falls = (settled & (parts[4].hi < 1.0)) | (rate.hi < 0.0)
            home = (parts[3].hi < 1.0) & (parts[4].hi < 1.0)
        return np.asarray(outside | (~face & (guard.hi < 1.0) & (falls | home)))

    def _branch(
        self, max_boxes: int, deadline: float, chunk: int
    ) -> tuple[Kind, str, dict[str, float], int]:
        reach = self.reach
        low, high, face = self._start()
        unit = np.append(reach, 0.5 * (self.ends[1] - self.ends[0]))
        unit[unit == 0] = 1.0
        count = 0
        while low.shape[1]:
            # Depth first: the newest boxes, which are the smallest, at the end of the arrays.
            a, b, f = low[:, -chunk:], high[:, -chunk:], face[-chunk:]
            low, high, face = low[:, :-chunk], high[:, :-chunk], face[:-chunk]
            count += a.shape[1]
            parts, settled, spread = self.stage.over(a, b)
            done = self._done(a, b, f, parts, settled)
            if done.all():
                continue
            a, b, f, spread = a[:, ~done], b[:, ~done], f[~done], spread[:, ~done]
            tiny = ((b - a) / unit[:, None]).max(axis=0) < 1e-7
            suspects = np.flatnonzero(tiny) if tiny.any() else np.arange(min(len(f), 64))
            middle = 0.5 * (a[:, suspects] + b[:, suspects])
            at = self.stage.point(middle)
            wrong = self._wrong(middle, at) & ~f[suspects]
            if wrong.any():
                return "refuted", "", self._named(middle[:, int(wrong.argmax())]), count
            through = f[suspects] & (at[2].hi <= 1.0)
            if through.any():
                where = self._named(middle[:, int(through.argmax())])
                return "undecided", ", the guard meets the boundary of the box", where, count
            if tiny.any() or count > max_boxes or time.monotonic() > deadline:
                k = int(tiny.argmax())
                why = ", stuck in a tiny box" if tiny.any() else ", effort ran out"
                return "undecided", why, self._named(0.5 * (a[:, k] + b[:, k])), count
            # Split where V̇ varies most; where that is not finite, the longest side.
            width = np.where(b > a, (b - a) / unit[:, None], 0.0)
            weight = np.where(np.isfinite(spread).all(axis=0) & ~f, spread, width)
            weight = np.where(width > 0.02 * width.max(axis=0), weight, 0.0)
            below, above = bisected(a, b, weight)
            low, high = np.concatenate([low, below], axis=1), np.concatenate([high, above], axis=1)
            face = np.concatenate([face, f, f])
        return "proved", "", {}, count

    def _start(self) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
        """Boxes to do: the inside, and the faces, where only V > 1 or U > 1 will do."""
        size, reach, ends = self.motion.size, self.reach, self.ends
        start = [(-reach, reach, False)]
        if self.motion.odd:  # V is even: half of D will do
            half = reach.copy()
            half[-1] = 0.0
            start = [(-reach, half, False)]
        for i, end in itertools.product(range(size), (-1, 1)):
            a, b = -reach.copy(), reach.copy()
            a[i] = b[i] = end * reach[i]
            start.append((a, b, True))
        low = np.array([np.append(s[0], ends[0]) for s in start]).T
        high = np.array([np.append(s[1], ends[1]) for s in start]).T
        return low, high, np.array([s[2] for s in start])

    def _sampled_witness(self) -> FloatArray | None:
        """A point of the set's star around 0 that is wrong in intervals; None where none was met.

        Samples and a few rounds of samples near the worst ones: many sets that are too large
        are refuted here, long before branch and bound meets the place.
        """
        rng = np.random.default_rng(1)
        size, count = self.motion.size, 20_000
        rays = directions(rng, count, size)
        z = rays * (first_crossing(self.V, rays) * rng.random(count) ** 0.3)[:, None]
        p = rng.uniform(self.ends[0], self.ends[1], (count, len(self.names)))
        for width in (0.1, 0.03, 0.01, 0.003, 0.0):
            length = np.linalg.norm(z, axis=1)
            near = length <= first_crossing(self.V, z / length[:, None])
            z, p = z[near], p[near]
            x = np.vstack([self.chart.x(self.V.points(z)).T, p.T])
            parts = self.stage.point(x)
            wrong = self._wrong(x, parts)
            if wrong.any():
                return np.asarray(x[:, int(wrong.argmax())])
            score = parts[1].hi / np.sum(z * z, axis=1)
            if self.inner is not None:
                score = np.where(parts[3].hi > 1.0, score, -np.inf)
            worst = np.argsort(np.nan_to_num(score, nan=-np.inf))[-200:]
            z, p = np.repeat(z[worst], 20, axis=0), np.repeat(p[worst], 20, axis=0)
            z = z + width * rng.normal(size=z.shape) * np.linalg.norm(z, axis=1, keepdims=True)
        return None


def _check(
    motion: AutonomousSystem,
    chain: Sequence[LyapunovFunction],
    parameters: Mapping[str, tuple[float, float]],
) -> None:
    """Refuse what does not fit together."""
    require(chain, "chain of Lyapunov functions", "empty", "one or more")
    for V in chain:
        size = V.exponents.shape[1]
        require(size == motion.size, "size of a Lyapunov function", size, motion.size)
    unknown = set(parameters) - {p.name for p in motion.parameters}
    require(not unknown, "parameter box", ", ".join(sorted(unknown)))
    for name, (low, high) in parameters.items():
        good = np.isfinite([low, high]).all() and low <= high
        require(good, f"parameter box of '{name}'", (low, high), "finite, low ≤ high")


def _frame(
    motion: AutonomousSystem, chain: Sequence[LyapunovFunction]
) -> tuple[Chart, FloatArray] | None:
    """A chart and half-sides in x of a box that holds {U ≤ 1} with room.

    By rays in float64: the checker's faces decide whether it is so.  A triangular B keeps
    x_0 parallel to y_0, so that the box can end before the singularity and V's pole.
    """
    rays = directions(np.random.default_rng(0), 20000, motion.size)
    edges = []
    chart = Chart(chain[-1], chain[0] if len(chain) > 1 else None)
    for V in chain:
        if V.guard is None:
            return None
        edges.append(chart.x(V.guard.points(rays)))
    covariance = np.cov(edges[-1].T, bias=True).reshape(motion.size, motion.size)
    chart.B = np.asarray(np.linalg.cholesky(covariance))
    reach = np.abs(np.linalg.solve(chart.B, np.vstack(edges).T)).max(axis=1)
    room = 0.04 * reach
    ahead = np.zeros(motion.size)
    ahead[0] = 1.0
    limit = _clear(motion, chain[-1], ahead) / chart.B[0, 0]
    if limit > reach[0]:
        room[0] = min(room[0], 0.3 * (limit - reach[0]))
    return chart, np.asarray(reach + room)


def _far_point(V: LyapunovFunction) -> FloatArray:
    """A point of {V ≤ 1} on a ray along which V does not reach 1, else the farthest edge."""
    rays = directions(np.random.default_rng(0), 20000, len(V.scale))
    radius = first_crossing(V, rays)
    bounded = np.isfinite(radius)
    limit = 3.0 * float(np.median(radius[bounded])) if bounded.any() else 1.0
    k = int(np.argmax(radius))
    return np.asarray(V.points(rays[k] * min(float(radius[k]), limit)))


def _clear(motion: AutonomousSystem, V: LyapunovFunction, way: FloatArray) -> float:
    """How far along ±way the motion is non-singular and V is defined, in float64."""
    far = V.pole if np.isfinite(V.pole) else 10.0 * np.abs(V.scale).max()
    steps = far * np.linspace(0.0, 1.0, 2001)[:-1]
    bad = ~(motion.margin(steps[:, None] * way) > 0)
    return float(steps[bad.argmax()]) if bad.any() else float(V.pole)
