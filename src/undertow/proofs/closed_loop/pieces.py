"""Interval pieces of the closed loop: sat, clip and their generalised slopes, over boxes.

sat and clip are Lipschitz, not smooth: their slopes are enclosed by intervals that hold every
slope between two points of the box (Clarke's generalised derivative), which is all that a mean
value form needs.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from undertow.models.mechanism import FloatArray
from undertow.proofs.intervals.batch import Interval

_T = TypeVar("_T")


class Reader:
    """Takes blocks off a flat list of results, all broadcast to L boxes."""

    def __init__(self, flat: Sequence[Any], lanes: int) -> None:
        self.flat, self.lanes, self.at = [Interval.of(v) for v in flat], lanes, 0

    def block(self, *shape: int) -> Interval:
        """Return the next results as an array of boxes, (*shape, L)."""
        count = int(np.prod(shape))
        part = self.flat[self.at : self.at + count]
        self.at += count
        return stacked(part, self.lanes).reshape(*shape, self.lanes)


def stacked(parts: Sequence[Interval], lanes: int) -> Interval:
    """Put rows on top of each other, each for so many boxes."""
    return Interval(
        np.array([np.broadcast_to(v.lo, lanes) for v in parts]),
        np.array([np.broadcast_to(v.hi, lanes) for v in parts]),
    )


def put_boxes(whole: _T, lanes: NDArray[np.intp], part: _T) -> _T:
    """Return a record of intervals or masks whose last axis counts boxes, with some replaced."""

    def one(old: Any, new: Any) -> Any:
        copy = old.copy()
        copy[..., lanes] = new
        return copy

    fields = [
        Interval(one(a.lo, b.lo), one(a.hi, b.hi)) if isinstance(a, Interval) else one(a, b)
        for a, b in zip(cast(Any, whole), cast(Any, part), strict=True)
    ]
    return cast(_T, cast(Any, type(whole))(*fields))


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
    out = Interval(slope.lo[:, :columns].copy(), slope.hi[:, :columns].copy())
    for i, b in enumerate(bend):
        out[:, slow + i] = out[:, slow + i] + b * slope[:, columns + i]
    return out
