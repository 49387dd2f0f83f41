"""Branch and bound: whether outputs of a program keep on one side of a bound all over a box."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from undertow.proofs.kernel import compiled as ops
from undertow.proofs.kernel.graph import FloatArray, Intervals, Program

#: Boxes that are looked at together, and points of them that are tried for a counterexample.
CHUNK, TRIED = 512, 16


@dataclass(frozen=True)
class Goal:
    """sign · output ≥ bound, or > bound where ``strict``; the bound is an enclosure."""

    what: str
    sign: int = 1
    bound: complex = complex(0.0, 0.0)
    strict: bool = True


@dataclass(frozen=True)
class Settled:
    """What was decided, of which goal, at which point, in how many boxes."""

    kind: str
    why: str
    point: tuple[float, ...]
    boxes: int


def over_boxes(
    program: Program, low: FloatArray, high: FloatArray, fixed: Intervals
) -> tuple[Intervals, FloatArray]:
    """Enclose outputs over boxes (V, N) with fixed inputs (F,): (O, N), (O, V, N).

    The second is how much each output varies with each variable: a guess for splitting.
    """
    V, boxes = low.shape
    values = np.empty((len(program.outputs), boxes), dtype=complex)
    spreads = np.empty((len(program.outputs), V, boxes))
    for k in range(boxes):
        box, m = ops.between(low[:, k], high[:, k]), 0.5 * low[:, k] + 0.5 * high[:, k]
        whole, centre = program.expanded(box, m, fixed)
        values[:, k], spreads[:, :, k] = ops.mean_values(whole, centre, box, m)
    return values, spreads


def halved(
    a: FloatArray, b: FloatArray, axis: NDArray[np.int64], low: FloatArray, high: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return boxes low to high (V, N), and behind them both halves of boxes a to b by its axis."""
    middle, upper, lower, every = 0.5 * a + 0.5 * b, b.copy(), a.copy(), np.arange(a.shape[1])
    upper[axis, every] = lower[axis, every] = middle[axis, every]
    return np.concatenate([low, a, lower], axis=1), np.concatenate([high, upper, b], axis=1)


def settle(
    program: Program,
    box: Sequence[tuple[Fraction, Fraction]],
    fixed: Intervals,
    goals: Sequence[Goal],
    max_boxes: int,
) -> Settled:
    """Decide whether every goal holds all over a box of the first inputs.

    Parameters
    ----------
    program
        Its outputs are those of the goals.
    box
        (low, high) of the first V inputs.
    fixed
        Enclosures of the others, (F,).
    """
    ends = ops.ends(box)
    low, high = ends[:, :1], ends[:, 1:]
    corners = np.array(list(itertools.product(*ends))).T if len(box) <= 10 else low
    count = 0
    signs = np.array([g.sign for g in goals])

    def missed(
        a: FloatArray, b: FloatArray
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_], FloatArray]:
        """Goals that are not shown, and that are shown false, (O, N), with spreads."""
        values, spread = over_boxes(program, a, b, fixed)
        below = np.where(signs[:, None] > 0, values.real, -values.imag)
        above = np.where(signs[:, None] > 0, values.imag, -values.real)
        shown, wrong = np.empty(below.shape, bool), np.empty(below.shape, bool)
        for k, goal in enumerate(goals):
            start, end = goal.bound.real, goal.bound.imag
            shown[k] = below[k] > end if goal.strict else below[k] >= end
            wrong[k] = above[k] <= start if goal.strict else above[k] < start
        return ~shown, wrong, spread

    def false_at(points: FloatArray) -> Settled | None:
        """A goal that is false at one of some points of the box, (V, N)."""
        _, wrong, _ = missed(points, points)
        for at in np.flatnonzero(wrong.any(axis=0)):
            point = tuple(points[:, at].tolist())
            if all(a <= Fraction(v) <= b for v, (a, b) in zip(point, box, strict=True)):
                why = goals[int(wrong[:, at].argmax())].what
                return Settled("refuted", why, point, count)
        return None

    if (found := false_at(corners)) is not None:
        return found
    while low.shape[1]:
        a, b, low, high = low[:, -CHUNK:], high[:, -CHUNK:], low[:, :-CHUNK], high[:, :-CHUNK]
        count += a.shape[1]
        left, _, spread = missed(a, b)
        todo = left.any(axis=0)
        if not todo.any():
            continue
        a, b, left, spread = a[:, todo], b[:, todo], left[:, todo], spread[:, :, todo]
        middle = 0.5 * a + 0.5 * b
        if (found := false_at(middle[:, -TRIED:])) is not None:
            return found
        width = b - a
        tiny = width.max(axis=0) < 1e-13 * (ends[:, 1] - ends[:, 0]).max()
        if count > max_boxes or tiny.any() or not width.any():
            at = int(tiny.argmax())
            why = goals[int(left[:, at].argmax())].what
            return Settled("undecided", why, tuple(middle[:, at].tolist()), count)
        # Across the side that an open goal varies most with, by its derivatives.
        weight = np.where(left[:, None, :], spread, 0.0).max(axis=0)
        weight = np.where(np.isfinite(weight).all(axis=0) & weight.any(axis=0), weight, width)
        low, high = halved(a, b, np.where(width > 0, weight, -1.0).argmax(axis=0), low, high)
    return Settled("proved", "", (), count)
