"""Terminal sets of the whole loop: invariant, unsaturated, every motion from them converges.

With y = (q, p) = T x the set is {W ≤ 1}, W = max(‖x‖, |s_i|/σ_i): an ellipsoid in the slow
coordinates and a thin box in s.  W decreases strictly, but at 0, if for all 0 < ‖x‖ ≤ 1:

1. d/dt ‖x‖² < 0 for all |s_i| ≤ σ_i ‖x‖ (there ‖x‖ is the larger part of W);
2. |u_i| ≤ u_max for |s_i| ≤ σ_i, so the clip is not met and ṡ_i = −k_i sat(s_i/ε_i) + D_i + e_i,
   with D = 0 where the law knows the plant and e = 0 where it acts at every instant; if both are
   0, |s_i| decreases by itself;
3. else |D_i| + |e_i| < k_i sat(σ_i r/ε_i) for |s_i| = σ_i r ≥ σ_i ‖x‖.

A continuous positive definite W on a compact set that decreases strictly along every motion but
0 proves convergence (a limit set would be invariant with W constant).  The set is convex and the
coordinates exist all over it, so it lies in the non-singular set.

**A held input.**  With u renewed at t_k = k T and held, e(t) = W(z(t)) (u(z(t_k)) − u(z(t))), so
|e(t)| ≤ T |W| sup |u̇| over [t_k, t].  Let r be the largest W so far since t_k.  All these z are in
{W ≤ r}, where u̇ = u_y ẏ + u_s ṡ is bounded by r times a constant: ẏ vanishes at 0, and
|ṡ_i| ≤ r (k_i σ_i/ε_i + b_i), b_i r = k_i sat(σ_i r/ε_i) being what |D_i| + |e_i| is below (e is 0
at t_k, and the first instant at which that failed would contradict the bound).  With 3. shown
for this e, W falls whenever it equals its largest value since t_k: hence W(t) ≤ W(t_k) up to
t_{k+1}, and W(t_{k+1}) < W(t_k) but at 0, for to come back to W(t_k) it would have to rise where
it falls.  z(t_k) ↦ z(t_{k+1}) is continuous, so a limit point other than 0 is impossible, and
motions converge, between samples too.

The check is branch and bound over x in outward-rounded arithmetic with mean-value forms; near 0
all three conditions are homogeneous and are decided on matrices (exactly, by rationals).
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from undertow.base.errors import InvalidInputError
from undertow.base.verdict import Verdict
from undertow.models.mechanism import FloatArray
from undertow.proofs.closed_loop.loop import LoopMotion
from undertow.proofs.closed_loop.terminal_set import TerminalSet, exact_inverse, negative_by
from undertow.proofs.closed_loop.tube import matmul
from undertow.proofs.intervals.batch import Interval, bisected

#: Part of the pull k sat(σ r/ε) left to a held input where the plant is uncertain too.
HOLD_SHARE = 0.7


class _Enclosures:
    """The three conditions over boxes of x."""

    def __init__(self, motion: LoopMotion, terminal: TerminalSet) -> None:
        self.motion, self.terminal = motion, terminal
        self.m, self.slow = motion.mechanism.m, motion.slow
        self.T = Interval(terminal.scale)
        self.inverse = exact_inverse(terminal.scale)
        self.limit = motion.mechanism.input_limits
        eta, layer = motion.gains
        sigma = terminal.widths
        # k sat(σ r/ε) ≥ r · stiff for r ≤ 1, by concavity.
        self.stiff = Interval(eta) * (Interval(sigma) / Interval(layer)).min(1.0)
        # |ṡ_i|/σ_i ≤ fast_i r.
        self.fast = Interval(eta) / Interval(layer) + self.stiff / Interval(sigma)
        self.held, self.unknown = motion.period > 0, len(motion.radii) > 0
        self.share = 1.0 if not self.unknown else HOLD_SHARE if self.held else 0.0
        self.reach = self._reach() if self.held else np.zeros((self.m, self.m))

    def _reach(self) -> FloatArray:
        """Upper bounds of T |W_ij| over the set, (m, m)."""
        parts = max(2, round(4000 ** (1 / self.slow)))
        ends = np.linspace(-1.0, 1.0, parts + 1)
        low = np.stack(np.meshgrid(*[ends[:-1]] * self.slow, indexing="ij")).reshape(self.slow, -1)
        high = np.stack(np.meshgrid(*[ends[1:]] * self.slow, indexing="ij")).reshape(self.slow, -1)
        keep = _total(Interval(low, high) ** 2).lo <= 1.0
        W = self.motion.over(self.z(Interval(low[:, keep], high[:, keep]), 1.0)).W
        return np.asarray((Interval(self.motion.period) * abs(W)).hi.max(axis=-1))

    def z(self, x: Interval, width: float) -> Interval:
        """Boxes of z that hold T x and |s| ≤ σ width."""
        y = matmul(self.T[:, :, None], x[:, None])[:, 0]
        s = np.repeat(width * self.terminal.widths[:, None], x.lo.shape[1], axis=1)
        return Interval.concatenate([y, Interval(-s, s)])

    def slopes(self, x: Interval) -> tuple[Interval, ...]:
        """Slopes over {x in the box, |s| ≤ σ}, in (x, s, parameters), and rates."""
        rates = self.motion.over(self.z(x, 1.0))
        turn = self.T[:, :, None]
        inverse = self.inverse[:, :, None]
        slow, end = self.slow, self.motion.size

        def in_x(slope: Interval) -> Interval:
            """Columns (y, s, p) to (x, σ-scaled s, ρ-scaled p)."""
            first = matmul(slope[:, :slow], turn)
            second = slope[:, slow:end] * Interval(self.terminal.widths)[None, :, None]
            third = slope[:, end:] * Interval(self.motion.radii)[None, :, None]
            return Interval.concatenate([first, second, third], axis=1)

        x_slope = in_x(matmul(inverse, rates.slope[:slow]))
        x_rate = matmul(inverse, rates.rate[:slow, None])[:, 0]
        return x_rate, x_slope, rates.demand, in_x(rates.demand_slope), in_x(rates.push_slope)

    def over(self, low: FloatArray, high: FloatArray) -> tuple[Any, ...]:
        """Return (‖x‖² lower bound, decided, V̇ upper bound, |u| excess, split weights)."""
        middle = 0.5 * (low + high)
        x, centre = Interval(low, high), Interval(middle)
        away = x - centre
        square = _total(x**2)
        radius = np.sqrt(np.minimum(np.nextafter(_total(x**2).hi, np.inf), 1.0)) * (1 + 1e-15)
        floor = np.maximum(np.sqrt(np.maximum(square.lo, 0.0)) * (1 - 1e-15), 0.0)
        rate, slope, u, u_slope, push = self.slopes(x)
        here = self.motion.over(self.z(centre, 0.0), middle=True)
        rate_c = matmul(self.inverse[:, :, None], here.rate[: self.slow, None])[:, 0]
        slow, m = self.slow, self.m
        unit = Interval(-radius, radius)
        one = Interval(-1.0, 1.0)
        k = len(self.motion.radii)
        # Rates over the box by the mean value form, then V̇/2 = x·ẋ by another.
        moved = [away[i] for i in range(slow)] + [unit] * m + [one] * k
        better = rate_c
        for j, part in enumerate(moved):
            better = better + slope[:, j] * part
        rate = rate.intersect(better)
        natural = _total_of(x[i] * rate[i] for i in range(slow))
        mean = _total_of(centre[i] * rate_c[i] for i in range(slow))
        weights = []
        for j in range(slow):
            gradient = rate[j] + _total_of(x[i] * slope[i, j] for i in range(slow))
            part = gradient * away[j]
            mean = mean + part
            weights.append(np.broadcast_to(part.hi - part.lo, radius.shape))
        for j in range(slow, slow + m + k):
            mean = mean + _total_of(x[i] * slope[i, j] for i in range(slow)) * moved[j]
        decrease = natural.intersect(mean).hi
        demand = here.demand
        for j, part in enumerate(moved):
            demand = demand + u_slope[:, j] * (one if slow <= j < slow + m else part)
        demand = demand.intersect(u)
        over = demand.magnitude - self.limit[:, None]
        spare = self._spare(push, here, moved, floor)
        if self.held:
            still = self._on_surface(rate_c, slope, moved)
            creep = matmul(u_slope[:, :slow], still[:, None])[:, 0]
            lag = np.einsum("ij,jl->il", self.reach, abs(creep).hi) * (1 + 1e-12)
            left = self._left(slope, u_slope) * Interval(floor) - Interval(lag)
            spare = np.minimum(spare, np.nan_to_num(left.lo, nan=-np.inf).min(axis=0))
        return square.lo, decrease, over.max(axis=0), spare, np.array(weights)

    def _on_surface(self, value: Interval, slope: Interval, moved: list[Interval]) -> Interval:
        """Add what the way from the middle adds, but for that of s."""
        for j, part in enumerate(moved):
            if not self.slow <= j < self.motion.size:
                value = value + slope[:, j] * part
        return value

    def _left(self, slope: Interval, u_slope: Interval) -> Interval:
        """Lower bound of the pull left to a held input, per r, but for u_y ẏ(x, 0), (m, L)."""
        slow, m = self.slow, self.m
        left = Interval(self.share) * self.stiff[:, None]
        drift = matmul(u_slope[:, :slow], slope[:, slow : slow + m])
        for j in range(m):
            fast = abs(drift[:, j]) + abs(u_slope[:, slow + j]) * self.fast[j]
            left = left - Interval(np.einsum("ij,jl->il", self.reach, fast.hi) * (1 + 1e-12))
        return left

    def _spare(
        self, push: Interval, here: Any, moved: list[Interval], floor: FloatArray
    ) -> FloatArray:
        """Lower bound of (stiff − Σ|∂D/∂s|σ)‖x‖ − |D(x, 0)|; ∞ where D is 0."""
        if not self.unknown:
            return np.full(floor.shape, np.inf)
        slow, m = self.slow, self.m
        value = self._on_surface(here.push, push, moved)
        rest = self._pull()[:, None]
        for j in range(slow, slow + m):
            rest = rest - abs(push[:, j])
        spare = rest * Interval(floor) - abs(value)
        return np.asarray(np.min(np.where(rest.lo > 0, spare.lo, -np.inf), axis=0))

    def _pull(self) -> Interval:
        """Pull that is left to what the law does not know, per r, (m,)."""
        return Interval(1.0 - self.share) * self.stiff if self.held else self.stiff

    def _falls(self, slope: Interval) -> bool:
        """Whether ‖x‖ falls for slopes of ẋ at one box, (slow, slow + m + k, 1), |s_j| ≤ σ_j ‖x‖.

        d/dt ½‖x‖² = xᵀMx + Σ_j x·c_j s_j/σ_j, and |x·c| ‖x‖ ≤ ½ (τ (x·c)² + ‖x‖²/τ) for any τ.
        """
        slow, m = self.slow, self.m
        if not (np.isfinite(slope.lo).all() and np.isfinite(slope.hi).all()):
            return False
        M = slope[:, :slow, 0]
        columns = [slope[:, j, 0] for j in range(slow, slow + m)]
        for stretch in (1.0, 4.0, 16.0):
            total, slack = M, Interval(0.0)
            for c in columns:
                size = max(float(_norm(c).hi), 1e-300)
                tau = Interval(stretch) / Interval(size)
                total = total + Interval(0.5) * tau * (c[:, None] * c[None])
                slack = slack + Interval(0.5) / tau
            if negative_by(total, float(slack.hi)):
                return True
        return False

    def core(self, half: float) -> bool:
        """Whether all conditions but 2 hold in the cube |x_i| ≤ half, by homogeneity."""
        ones = np.full((self.slow, 1), half)
        _, slope, _, u_slope, push = self.slopes(Interval(-ones, ones))
        slow, m = self.slow, self.m
        if not self._falls(slope):
            return False
        if self.held:
            creep = matmul(u_slope[:, :slow], slope[:, :slow])
            lag = np.array([_norm(creep[j]).hi for j in range(m)])
            lag = np.einsum("ij,jl->il", self.reach, lag) * (1 + 1e-12)
            if not bool((self._left(slope, u_slope).lo > lag).all()):
                return False
        if not self.unknown:
            return True
        for i in range(m):
            gain = _norm(push[i, :slow])
            rest = self._pull()[i] - gain
            for j in range(slow, slow + m):
                rest = rest - abs(push[i, j])
            if not bool((rest.lo > 0).all()):
                return False
        return True


def _norm(v: Interval) -> Interval:
    """Euclidean norm over the first axis; a sum of squares is not below 0, whatever rounding."""
    square = _total(v**2)
    return Interval(np.maximum(square.lo, 0.0), square.hi).sqrt()


def _total(v: Interval) -> Interval:
    return _total_of(v[i] for i in range(len(v.lo)))


def _total_of(parts: Any) -> Interval:
    total = Interval(0.0)
    for part in parts:
        total = total + part
    return total


#: Boxes of one verification, at most, and of one step of it.
MAX_BOXES, CHUNK = 4_000_000, 4096


def verify_terminal(
    motion: LoopMotion,
    terminal: TerminalSet,
    *,
    max_seconds: float = 600.0,
) -> Verdict:
    """Decide whether a set is invariant, unsaturated and attracted to the target.

    Parameters
    ----------
    motion
        The loop, with its uncertain parameters.
    terminal
        The set.
    max_seconds
        Effort before giving up.

    Returns
    -------
    Verdict
        ``proved``; ``refuted``: at the witness, inside the set, the demand exceeds the limit
        or ‖x‖ grows, proved in intervals; ``undecided``: where it got stuck.

    Raises
    ------
    InvalidInputError
        When the set has another size than the loop.
    """
    started = time.process_time()
    claim = "{W ≤ 1} is invariant, non-singular, within the input limits, and converges"
    method = "branch and bound, outward-rounded float64 intervals, mean-value form"
    size, m = motion.slow, motion.mechanism.m
    if terminal.scale.shape != (size, size) or terminal.widths.shape != (m,):
        shapes = f"{terminal.scale.shape}, {terminal.widths.shape}"
        limit = f"({size}, {size}) and ({m},) for '{motion.mechanism.name}'"
        raise InvalidInputError("terminal set", value=shapes, limit=limit)
    if not motion.at_rest:
        return Verdict(claim, "undecided", method="f(0, 0) = 0 cannot be shown symbolically")
    checker = _Enclosures(motion, terminal)
    half = 0.5
    while not checker.core(half):
        half /= 1.6
        if half < 1e-4:
            return Verdict(claim, "undecided", method="no decrease near 0, as far as seen")

    count = 0

    def finish(kind: Any, point: FloatArray | None, why: str = "") -> Verdict:
        witness: dict[str, float] = {}
        if point is not None:
            z = [*(terminal.scale @ point).tolist(), *([0.0] * m)]
            witness = dict(zip(motion.names, z, strict=True))
        details = {"boxes": count, "seconds": time.process_time() - started, "core": half}
        return Verdict(claim, kind, witness=witness, method=method + why, details=details)

    low, high = -np.ones((size, 1)), np.ones((size, 1))
    if motion.odd:
        low[-1] = 0.0
    while low.shape[1]:
        a, b = low[:, -CHUNK:], high[:, -CHUNK:]
        low, high = low[:, :-CHUNK], high[:, :-CHUNK]
        count += a.shape[1]
        square, decrease, over, spare, weights = checker.over(a, b)
        near = np.all((np.abs(a) <= half) & (np.abs(b) <= half), axis=0)
        moving = near | ((decrease < 0) & (spare > 0))
        done = (square > 1.0) | (moving & (over <= 0))
        if done.all():
            continue
        a, b, weights, near = a[:, ~done], b[:, ~done], weights[:, ~done], near[~done]
        tiny = (b - a).max(axis=0) < 1e-6
        spent = count > MAX_BOXES or time.process_time() - started > max_seconds
        index = np.flatnonzero(tiny)[:64] if tiny.any() else np.arange(min(64, a.shape[1]))
        wrong = _wrong(checker, 0.5 * (a[:, index] + b[:, index]))
        if wrong is not None:
            return finish("refuted", wrong)
        if tiny.any() or spent:
            where = 0.5 * (a[:, index[0]] + b[:, index[0]])
            return finish("undecided", where, ", effort ran out" if spent else ", stuck")
        width = b - a
        weight = np.where(np.isfinite(weights).all(axis=0) & ~near, weights, width)
        weight = np.where(width > 0.02 * width.max(axis=0), weight, 0.0)
        below, above = bisected(a, b, weight)
        low, high = np.concatenate([low, below], axis=1), np.concatenate([high, above], axis=1)
    return finish("proved", None)


def _wrong(checker: _Enclosures, points: FloatArray) -> FloatArray | None:
    """Return a point inside the set, s = 0, where a condition fails, proved in intervals."""
    x = Interval(points)
    here = checker.motion.over(checker.z(x, 0.0), middle=True)
    rate = matmul(checker.inverse[:, :, None], here.rate[: checker.slow, None])[:, 0]
    grows = _total_of(x[i] * rate[i] for i in range(checker.slow)).lo > 0
    limit = checker.limit[:, None]
    clips = np.any((here.demand.lo > limit) | (here.demand.hi < -limit), axis=0)
    away = np.any(np.abs(points) > 1e-9, axis=0)
    bad = np.flatnonzero((_total(x**2).hi <= 1.0) & (grows | clips) & away)
    return np.asarray(points[:, bad[0]]) if len(bad) else None
