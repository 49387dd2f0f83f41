"""The whole closed loop with a held input: u(t) = clip(u(z(t_k))) for t_k ≤ t < t_k + T.

The state is (z, w) with w_i = ṡ_i ε_i/k_i.  Between two samples ṡ = W(z) (v − u°(z)) with the
held v and the u° that would keep s where it is, so that with a = ṡ

    ȧ = Ẇ W⁻¹ a − W u̇°,

without sat and clip: the motion is smooth.  At a sample a becomes what it is in the continuous
loop, −K sat(s/ε) + push(z): a Lipschitz map, applied to a tube by its mean value form.  Nothing is
lost: a tube holds the motions of the sampled loop itself and not those of a continuous loop
with an error bound.  With v instead of a the same equations hold, but tubes burst: v − u° is a
small difference of numbers that depend on z strongly, and intervals do not see that.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from undertow.models.mechanism import FloatArray
from undertow.proofs.closed_loop.loop import LoopMotion
from undertow.proofs.closed_loop.tube import Paths, Tubes, stack
from undertow.proofs.intervals.batch import Interval


class HeldRates(NamedTuple):
    """The loop between samples over boxes; see :class:`undertow.proofs.closed_loop.tube.Rates`."""

    rate: Interval
    slope: Interval
    kinked: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class SampledDataLoop:
    """The loop between samples, in (z, w), of order N + m.

    Parameters
    ----------
    motion
        The loop.
    """

    motion: LoopMotion

    @property
    def radii(self) -> FloatArray:
        """Radii of the uncertain parameters."""
        return self.motion.radii

    @property
    def times(self) -> FloatArray:
        """ε_i/k_i, (m,), s: w = times · ṡ is of the size of s."""
        eta, layer = self.motion.gains
        return np.asarray(layer / eta)

    def over(
        self,
        y: Interval,
        *,
        middle: bool = False,
        paths: Paths | None = None,
        brief: bool = False,
    ) -> HeldRates:
        """Enclose ẏ and its slopes over boxes (N + m, L); ``paths`` has nothing to add."""
        motion = self.motion
        size, slow, m = motion.size, motion.slow, motion.mechanism.m
        lanes, k = y.lo.shape[1], len(motion.radii)
        z, times = y[:size], Interval(self.times[:, None])
        speed = y[size:] / times
        there, there_slope = motion.equations.slow_rates(z, middle)
        if brief or middle:
            jerk = motion.equations.jerk(z, speed, middle)
            jerk_slope = Interval.zeros(m, size + m + k, lanes)
        else:
            jerk, jerk_slope = motion.equations.jerk_slope(z, speed)
        rate = stack(stack(there, speed), times * jerk)
        slope = Interval.zeros(size + m, size + m + k, lanes)
        slope[:slow] = _widened(there_slope, size, m)
        per = 1 / times[:, 0]
        for i in range(m):
            slope[slow + i, size + i] = per[i]
        rows = times[:, None] * jerk_slope
        slope[size:] = rows
        slope[size:, size : size + m] = rows[:, size : size + m] * per[None, :, None]
        return HeldRates(rate, slope, np.zeros(lanes, dtype=bool))

    def bend(self, y: Interval, rate: Interval) -> Interval:
        """Enclose d/dt of the slow rows of the slopes, (2n − m, N + m + k, L)."""
        motion = self.motion
        size, m = motion.size, motion.mechanism.m
        return _widened(motion.bend(y[:size], rate[:size]), size, m)

    def begin(self, tubes: Tubes) -> Tubes:
        """Return sets of z as sets of (z, w), not sampled yet."""
        m, lanes = self.motion.mechanism.m, tubes.middle.shape[1]
        size, columns = tubes.spread.shape[:2]
        basis = np.zeros((size + m, size + m, lanes))
        basis[:size, :size] = tubes.basis
        for i in range(m):
            basis[size + i, size + i] = 1.0
        return Tubes(
            self,
            np.concatenate([tubes.middle, np.zeros((m, lanes))]),
            np.concatenate([tubes.spread, np.zeros((m, columns, lanes))]),
            basis,
            stack(tubes.rest, Interval.zeros(m, lanes)),
        )

    def sample(self, tubes: Tubes) -> tuple[Tubes, Interval]:
        """Return the sets with the input renewed, and the demand on them, (m, L)."""
        motion = self.motion
        size, slow, m = motion.size, motion.slow, motion.mechanism.m
        lanes, k = tubes.middle.shape[1], len(motion.radii)
        inner = _Inner(tubes, size)
        here = motion.over(Interval(inner.middle), middle=True)
        there = motion.over(tubes.hull[:size], paths=inner)
        slope = Interval.zeros(size + m, size + m + k, lanes)
        for i in range(size):
            slope[i, i] = Interval(1.0)
        times = Interval(self.times[:, None])
        slope[size:] = _widened(times[:, None] * there.slope[slow:], size, m)
        value = stack(Interval(inner.middle), times * here.rate[slow:])
        return tubes.mapped(value, slope), there.demand


@dataclass(frozen=True)
class _Inner:
    """The first N coordinates of sets, as :class:`undertow.proofs.closed_loop.tube.Paths`."""

    tubes: Tubes
    size: int

    @property
    def middle(self) -> FloatArray:
        return self.tubes.middle[: self.size]

    def way(self, slope: Interval) -> Interval:
        more = len(self.tubes.middle) - self.size
        return self.tubes.way(_widened(slope, self.size, more))


def _widened(slope: Interval, size: int, more: int) -> Interval:
    """Return slopes in (z, p) as slopes in (z, w, p)."""
    nothing = Interval.zeros(len(slope.lo), more, slope.shape[2])
    return Interval.concatenate([slope[:, :size], nothing, slope[:, size:]], axis=1)
