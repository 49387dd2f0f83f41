"""Interval pieces of the closed loop: sat, clip and their generalised slopes, over boxes.

sat and clip are Lipschitz, not smooth: their slopes are enclosed by intervals that hold every
slope between two points of the box (Clarke's generalised derivative), which is all that a mean
value form needs.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from undertow.certify.intervals.batch import Interval

__all__ = ["Reader", "excess", "put_boxes", "saturation", "stacked", "through_switch", "zeros"]

FloatArray = NDArray[np.float64]


class Reader:
    """Takes blocks off a flat list of results, all broadcast to L boxes."""

    def __init__(self, flat: Sequence[Any], lanes: int) -> None:
        self.flat, self.lanes, self.at = [Interval.of(v) for v in flat], lanes, 0

    def block(self, *shape: int) -> Interval:
        """Return the next results as an array of boxes, (*shape, L)."""
        count = int(np.prod(shape))
        part = self.flat[self.at : self.at + count]
        self.at += count
        lo = np.array([np.broadcast_to(v.lo, self.lanes) for v in part])
        hi = np.array([np.broadcast_to(v.hi, self.lanes) for v in part])
        return Interval(lo.reshape(*shape, self.lanes), hi.reshape(*shape, self.lanes))


def zeros(*shape: int) -> Interval:
    """Return zeros whose ends are arrays of their own, to be written to."""
    return Interval(np.zeros(shape), np.zeros(shape))


def stacked(parts: Sequence[Interval]) -> Interval:
    """Return rows as one block."""
    return Interval(np.array([v.lo for v in parts]), np.array([v.hi for v in parts]))


def put_boxes(whole: tuple[Any, ...], lanes: NDArray[np.intp], part: tuple[Any, ...]) -> list[Any]:
    """Return entries, intervals or masks whose last axis counts boxes, with some replaced."""

    def one(old: Any, new: Any) -> Any:
        copy = old.copy()
        copy[..., lanes] = new
        return copy

    return [
        Interval(one(a.lo, b.lo), one(a.hi, b.hi)) if isinstance(a, Interval) else one(a, b)
        for a, b in zip(whole, part, strict=True)
    ]


def saturation(s: Interval, layer: float) -> tuple[Interval, Interval]:
    """Return sat(s/ε) and its slopes in s, over boxes."""
    ratio = s * (1 / Interval(layer))
    value = Interval(np.clip(ratio.lo, -1.0, 1.0), np.clip(ratio.hi, -1.0, 1.0))
    inside = (ratio.lo >= -1) & (ratio.hi <= 1)
    outside = (ratio.lo >= 1) | (ratio.hi <= -1)
    slope = 1 / Interval(layer)
    return value, Interval(np.where(inside, slope.lo, 0.0), np.where(outside, 0.0, slope.hi))


def excess(u: Interval, limits: FloatArray) -> tuple[Interval, Interval]:
    """Return clip(u) − u and its slopes in u, over boxes (m, L)."""
    limit = limits[:, None]
    free = (u.lo >= -limit) & (u.hi <= limit)
    clipped = (u.lo >= limit) | (u.hi <= -limit)
    # Decreasing in u: its extremes are at the ends.
    low = Interval(np.clip(u.lo, -limit, limit)) - Interval(u.lo)
    high = Interval(np.clip(u.hi, -limit, limit)) - Interval(u.hi)
    value = Interval(np.where(free, 0.0, high.lo), np.where(free, 0.0, low.hi))
    return value, Interval(np.where(free, 0.0, -1.0), np.where(clipped, -1.0, 0.0))


def through_switch(slope: Interval, bend: Sequence[Interval], columns: int, slow: int) -> Interval:
    """Turn derivatives in (z, parameters, sw) into those in (z, parameters): sw = sat(s)."""
    lo, hi = slope.lo[:, :columns].copy(), slope.hi[:, :columns].copy()
    for i, b in enumerate(bend):
        at = slow + i
        more = Interval(lo[:, at], hi[:, at]) + b * Interval(
            slope.lo[:, columns + i], slope.hi[:, columns + i]
        )
        lo[:, at], hi[:, at] = more.lo, more.hi
    return Interval(lo, hi)
