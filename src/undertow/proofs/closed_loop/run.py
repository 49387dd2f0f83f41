"""Tubes from neighbouring boxes of starts at rest, followed until they lie in a terminal set."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from undertow.base.arguments import one_of
from undertow.models.mechanism import FloatArray
from undertow.proofs.closed_loop.loop import LoopMotion, LoopRates
from undertow.proofs.closed_loop.sampled_data import SampledDataLoop
from undertow.proofs.closed_loop.terminal_set import TerminalSet, exact_inverse
from undertow.proofs.closed_loop.tube import Tubes, bracket
from undertow.proofs.intervals.batch import Interval


class TubeEnd(NamedTuple):
    """What became of L tubes.

    ``entered`` (L,) is the time at which each was inside the terminal set, NaN if it was not;
    ``peak`` (L, m) bounds the demand on the way; ``steps`` counts steps of the longest; ``lost``
    (L,) marks those that burst.
    """

    entered: FloatArray
    peak: FloatArray
    steps: int
    lost: NDArray[np.bool_]


def start_tubes(motion: LoopMotion, coordinate: str, edges: Sequence[float] | FloatArray) -> Tubes:
    """Return the sets of starts at rest between neighbouring edges.

    Raises
    ------
    InvalidInputError
        For a coordinate that the mechanism does not have.
    """
    names = [c.name for c in motion.mechanism.coordinates]
    one_of(f"coordinate of '{motion.mechanism.name}'", coordinate, names)
    index = names.index(coordinate)
    grid = np.asarray(edges, dtype=float)
    middle, radius = bracket(grid[:-1], grid[1:])
    lanes, size, slow = len(middle), motion.size, motion.slow
    centre, spread = np.zeros((size, lanes)), np.zeros((size, 1, lanes))
    centre[index], spread[index, 0] = middle, radius
    rest = Interval.zeros(size, lanes)
    for i, weight in enumerate(motion.surface.position_row[:, index]):
        # s = λ q: what rounding loses goes to the remainder.
        one = Interval(float(weight))
        centre[slow + i] = weight * middle
        spread[slow + i, 0] = weight * radius
        rest[slow + i] = (one * Interval(middle) - Interval(centre[slow + i])) + (
            one * Interval(radius) - Interval(spread[slow + i, 0])
        ) * Interval(-1.0, 1.0)
    return Tubes.of(motion, centre, spread, rest)


def run_tubes(
    motion: LoopMotion,
    tubes: Tubes,
    terminal: TerminalSet,
    step: float,
    horizon: float,
    *,
    max_seconds: float = math.inf,
    stop_early: bool = True,
    progress: Callable[[str], None] | None = None,
) -> TubeEnd:
    """Follow tubes until they lie in the terminal set, at a sample where the input is held.

    Parameters
    ----------
    stop_early
        Give up on all once one is lost: a claim needs every one.
    progress
        Called with a line of text now and then.
    """
    started = time.process_time()
    lanes, m = tubes.middle.shape[1], motion.mechanism.m
    entered, peak = np.full(lanes, np.nan), np.zeros((lanes, m))
    lost = np.zeros(lanes, dtype=bool)
    active = np.arange(lanes)
    slow = motion.slow
    rows = Interval.zeros(motion.size, motion.size + (m if motion.period else 0))
    rows[:slow, :slow] = exact_inverse(terminal.scale)
    for i in range(slow, motion.size):
        rows[i, i] = Interval(1.0)
    held = SampledDataLoop(motion) if motion.period else None
    parts = max(1, round(motion.period / step))
    if held is not None:
        tubes = held.begin(tubes)
    k, count = 0, max(1, round(horizon / step))
    while k < count and len(active):
        if time.process_time() - started > max_seconds:
            break
        u = None
        if held is not None and k % parts == 0:
            tubes, u = held.sample(tubes)
        tubes, _, rates, moved = tubes.advance(step)
        k += 1
        if held is None:
            u = cast(LoopRates, rates).demand
        if u is not None:
            peak[active] = np.maximum(peak[active], u.magnitude.T)
        inside = moved & _inside(tubes.image(rows), motion.slow, terminal.widths)
        inside &= k % parts == 0
        entered[active[inside]] = k * step
        lost[active[~moved]] = True
        keep = moved & ~inside
        if not moved.all() and stop_early:
            break
        if not keep.all():
            tubes, active = tubes.take(keep), active[keep]
        if progress is not None and k % 100 == 0:
            progress(f"{k * step:.3f} s: {len(active)} of {lanes} tubes on their way")
    return TubeEnd(entered, peak, k, lost)


def _inside(image: Interval, slow: int, widths: FloatArray) -> NDArray[np.bool_]:
    """Whether (x, s) boxes lie in {‖x‖ ≤ 1, |s_i| ≤ σ_i}."""
    square = Interval(0.0)
    for i in range(slow):
        square = square + image[i] ** 2
    s = image[slow:].magnitude
    return np.asarray((square.hi <= 1.0) & (s <= widths[:, None]).all(axis=0))
