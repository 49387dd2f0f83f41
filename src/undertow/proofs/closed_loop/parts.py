"""The parts of the closed loop's equations over boxes, with what is known of the points in them.

Values are met with mean value forms around a middle; slopes for uncertain parameters with mean
value forms around the law's own values.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from undertow.models.mechanism import FloatArray, Mechanism
from undertow.proofs.closed_loop.pieces import Reader, saturation, through_switch
from undertow.proofs.closed_loop.program import LoopFunctions
from undertow.proofs.closed_loop.tube import Paths, matmul
from undertow.proofs.intervals.batch import Interval
from undertow.proofs.intervals.interval import OutwardFunction


class LoopParts(NamedTuple):
    """What the equations are made of, over boxes, with slopes in z and in k parameters.

    ``slow`` (2n − m, L), the ``demand`` (m, L), ``W`` = Γ S⁻¹ B (m, m, L), and the ``gap``
    (m, L): the demand less what it would be if the law knew the plant.  The slopes of demand
    and gap have m more columns, for sat(s/ε).
    """

    slow: Interval
    slow_slope: Interval
    demand: Interval
    demand_slope: Interval
    W: Interval
    W_slope: Interval
    gap: Interval
    gap_slope: Interval


@dataclass(frozen=True, eq=False)
class LoopEquations:
    """The equations over boxes.

    Parameters
    ----------
    mechanism
        Model of the law; its parameters are the law's own.
    program
        The compiled equations.
    layer
        ε, (m,).
    spread
        How far each of the k uncertain parameters may be from the law's own value.
    """

    mechanism: Mechanism
    program: LoopFunctions
    layer: FloatArray
    spread: Mapping[str, float]

    @property
    def size(self) -> int:
        """N = 2n."""
        return 2 * self.mechanism.n

    @property
    def slow(self) -> int:
        """Number of slow coordinates: 2n − m."""
        return 2 * self.mechanism.n - self.mechanism.m

    @cached_property
    def radii(self) -> FloatArray:
        """ρ, (k,)."""
        return np.array(list(self.spread.values()))

    def _parameters(self, middle: bool) -> list[Interval]:
        """Plant parameters as intervals, in the mechanism's order."""
        values = []
        for p in self.mechanism.parameters:
            radius = 0.0 if middle else self.spread.get(p.name, 0.0)
            one = Interval(p.value)
            values.append(one + Interval(-radius, radius) if radius else one)
        return values

    def parts(
        self,
        z: Interval,
        switch: Sequence[Interval],
        bend: Sequence[Interval],
        *,
        middle: bool = False,
        paths: Paths | None = None,
    ) -> LoopParts:
        """Enclose the parts of the equations over boxes z, (N, L), for sat(s/ε) in ``switch``.

        ``bend`` holds the slopes of ``switch`` in s; ``middle`` and ``paths`` as for
        :meth:`undertow.proofs.closed_loop.loop.LoopMotion.over`.  Slopes of
        u and gap come back in z and the parameters alone.
        """
        m, slow, k = self.mechanism.m, self.slow, len(self.radii)
        parts = self._blocks(z, switch, middle)
        if k and middle:  # the law knows a plant that is its own model
            zero = Interval.zeros(m, z.shape[1])
            parts = parts._replace(gap=zero, gap_slope=_in_parameters(parts.gap_slope, k, m))
        elif k:
            parts = self._around(parts, z, switch)
        columns = self.size + k
        parts = parts._replace(
            demand_slope=through_switch(parts.demand_slope, bend, columns, slow),
            gap_slope=through_switch(parts.gap_slope, bend, columns, slow),
        )
        if middle:
            return parts
        # Mean value forms: the natural ones lose much to cancellation.
        known = _Known.of(z, self.radii) if paths is None else paths
        rate, u, gap = self._sharpen(
            known,
            (parts.slow, parts.slow_slope),
            (parts.demand, parts.demand_slope),
            (parts.gap, parts.gap_slope),
        )
        return parts._replace(slow=rate, demand=u, gap=gap)

    def _read(self, run: OutwardFunction, middle: bool, *inputs: Iterable[Interval]) -> Reader:
        rows = [row for part in inputs for row in part]
        return Reader(run(*rows, *self._parameters(middle)), rows[0].lo.shape[0])

    def _blocks(self, z: Interval, switch: Sequence[Interval], middle: bool) -> LoopParts:
        m, slow, columns = self.mechanism.m, self.slow, self.size + len(self.radii)
        get = self._read(self.program.boxes, middle, z, switch)
        return LoopParts(
            get.block(slow), get.block(slow, columns),
            get.block(m), get.block(m, columns + m),
            get.block(m, m), get.block(m, m, columns),
            get.block(m), get.block(m, columns + m),
        )  # fmt: skip

    def _around(self, wide: LoopParts, z: Interval, switch: Sequence[Interval]) -> LoopParts:
        """Meet enclosures for unknown parameters with those around the law's own values.

        f(z, p) ∈ f(z, p̂) + ∂f/∂p (p − p̂) for a slope f too; the gap vanishes at p̂.  Natural
        enclosures of it would subtract two large numbers that hardly differ.
        """
        k, m, slow, own = (
            len(self.radii),
            self.mechanism.m,
            self.slow,
            self._blocks(z, switch, True),
        )
        columns = self.size + k
        get = self._read(self.program.mixed, False, z, switch)
        unknown = Interval(-self.radii[:, None], self.radii[:, None])

        def change(block: Interval) -> Interval:
            """Last axis but one counts parameters."""
            total = block[..., 0, :] * unknown[0]
            for j in range(1, k):
                total = total + block[..., j, :] * unknown[j]
            return total

        gap_own = _in_parameters(own.gap_slope, k, m)
        slow_slope = own.slow_slope + change(get.block(slow, columns, k))
        demand_slope = own.demand_slope + change(get.block(m, columns + m, k))
        W_slope = own.W_slope + change(get.block(m, m, columns, k))
        gap_slope = gap_own + change(get.block(m, columns + m, k))
        gap_slope = wide.gap_slope.intersect(gap_slope)
        W = own.W + change(wide.W_slope[:, :, -k:])
        return LoopParts(
            wide.slow,
            wide.slow_slope.intersect(slow_slope),
            wide.demand,
            wide.demand_slope.intersect(demand_slope),
            wide.W.intersect(W),
            wide.W_slope.intersect(W_slope),
            wide.gap.intersect(change(gap_slope[:, self.size : columns])),
            gap_slope,
        )

    def _sharpen(self, known: Paths, *pairs: tuple[Interval, Interval]) -> tuple[Interval, ...]:
        """Meet enclosures over boxes with values at a middle plus slopes times the way from it."""
        z = Interval(known.middle)
        switch = [saturation(z[self.slow + i], float(e))[0] for i, e in enumerate(self.layer)]
        get = self._read(self.program.points, True, z, switch)
        return tuple(
            value.intersect(get.block(len(value.lo)) + known.way(slope)) for value, slope in pairs
        )

    def slow_rates(self, z: Interval, middle: bool) -> tuple[Interval, Interval]:
        """Enclose the slow rows of ż, (2n − m, L), and their slopes."""
        if len(self.radii):
            switch = [Interval(np.zeros(z.lo.shape[1]))] * self.mechanism.m
            parts = self.parts(z, switch, switch, middle=middle)
            return parts.slow, parts.slow_slope
        rate, slope = self._slow_rates(z)
        if middle:
            return rate, slope
        known = _Known.of(z, self.radii)
        return rate.intersect(self._slow_rates(Interval(known.middle))[0] + known.way(slope)), slope

    def _slow_rates(self, z: Interval) -> tuple[Interval, Interval]:
        get = self._read(self.program.slow, True, z)
        return get.block(self.slow), get.block(self.slow, self.size)

    def jerk(self, z: Interval, speed: Interval, middle: bool) -> Interval:
        """Enclose s̈ for a held input, (m, L), over boxes z (N, L) and ṡ (m, L).

        With ``middle`` for the law's own parameters alone.
        """
        return self._read(self.program.jerk, middle, z, speed).block(self.mechanism.m)

    def jerk_slope(self, z: Interval, speed: Interval) -> tuple[Interval, Interval]:
        """Enclose s̈ and its slopes in (z, ṡ, parameters), (m, N + m + k, L)."""
        m = self.mechanism.m
        get = self._read(self.program.jerk_slope, False, z, speed)
        return get.block(m), get.block(m, self.size + m + len(self.radii))

    def bend(self, z: Interval, rate: Interval) -> Interval:
        """Enclose d/dt of the slow rows of the slopes, (2n − m, N + k, L).

        Over boxes z (N, L) for velocities ż in ``rate`` (N, L).  The slow rows do not hold
        the input, so they are smooth where sat and clip have their corners.
        """
        get = self._read(self.program.second, False, z, rate)
        return get.block(self.slow, self.size + len(self.radii))


@dataclass(frozen=True)
class _Known:
    """Points of boxes: middle + away, parameters p̂ + unknown."""

    middle: FloatArray
    away: Interval

    @classmethod
    def of(cls, z: Interval, radii: FloatArray) -> _Known:
        unknown = np.repeat(radii[:, None], z.shape[1], axis=1)
        away = [z - Interval(z.middle), Interval(-unknown, unknown)]
        return cls(z.middle, Interval.concatenate(away))

    def way(self, slope: Interval) -> Interval:
        return matmul(slope, self.away[:, None])[:, 0]


def _in_parameters(slope: Interval, k: int, m: int) -> Interval:
    """Return slopes (…, C + k + m, L) that vanish in z and in sat."""
    out = Interval.zeros(*slope.shape)
    at = slice(slope.shape[1] - k - m, slope.shape[1] - m)
    out[:, at] = slope[:, at]
    return out
