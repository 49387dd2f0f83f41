"""Branch and bound: whether outputs of a program keep on one side of a bound all over a box."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from undertow.proofs.kernel import compiled as ops
from undertow.proofs.kernel.graph import FloatArray, Intervals, Program

Bools = NDArray[np.bool_]
Point = tuple[float, ...]

#: Open boxes of which the middle is tried for a counterexample.
TRIED = 16


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
    point: Point
    boxes: int


class Rule(NamedTuple):
    """How boxes are halved.

    Parameters
    ----------
    chunk
        Boxes that are looked at together.
    unit
        What sides are measured by, (V,) or one number.
    tiny
        The longest side of a box that is not halved any more.
    slim
        Part of its longest side below which a side is not halved.
    most
        Boxes before it is given up.
    """

    chunk: int
    unit: FloatArray | float
    tiny: float
    slim: float
    most: int


def branch(
    low: FloatArray,
    high: FloatArray,
    rule: Rule,
    judge: Callable[[FloatArray, FloatArray], tuple[Bools, FloatArray]],
    false_at: Callable[[FloatArray, Bools], tuple[str, Point] | None],
    names: Sequence[str] = (),
) -> Settled:
    """Settle a box, (V,) and (V,), by halves of it.

    Parameters
    ----------
    judge
        Of boxes (V, N), (V, N): goals that are not shown, (O, N), and how much they vary with each
        variable, (V, N), a guess for splitting.
    false_at
        Of middles of open boxes, (V, N), and whether these are tiny: what is false there, if so.
    names
        Of the goals.
    """
    low, high, unit, count = low[:, None], high[:, None], np.reshape(rule.unit, (-1, 1)), 0
    while low.shape[1]:
        a, b = (np.ascontiguousarray(v[:, -rule.chunk :]) for v in (low, high))
        low, high = low[:, : -rule.chunk], high[:, : -rule.chunk]
        count += a.shape[1]
        left, spread = judge(a, b)
        todo = left.any(axis=0)
        if not todo.any():
            continue
        a, b, left, spread = a[:, todo], b[:, todo], left[:, todo], spread[:, todo]
        width, middle = (b - a) / unit, 0.5 * a + 0.5 * b
        tiny = width.max(axis=0) < rule.tiny
        if false := false_at(middle, tiny):
            return Settled("refuted", *false, count)
        if tiny.any() or count > rule.most:
            at = int(tiny.argmax())
            why = "stuck in a tiny box" if tiny.any() else f"more than {rule.most} boxes"
            why = names[int(left[:, at].argmax())] if names else why
            return Settled("undecided", why, tuple(middle[:, at].tolist()), count)
        known = np.isfinite(spread).all(axis=0) & spread.any(axis=0)
        weight = np.where(known, spread, width)
        weight = np.where(width > rule.slim * width.max(axis=0), weight, -1.0)
        axis, every = weight.argmax(axis=0), np.arange(a.shape[1])
        lower, upper = a.copy(), b.copy()
        upper[axis, every] = lower[axis, every] = middle[axis, every]
        low = np.concatenate([low, a, lower], axis=1)
        high = np.concatenate([high, upper, b], axis=1)
    return Settled("proved", "", (), count)


@np.errstate(invalid="ignore")  # a slope without bounds, across a side of width 0
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
    bound, sign = np.array([g.bound for g in goals]), np.array([g.sign for g in goals])
    strict = np.array([g.strict for g in goals])

    def compared(a: FloatArray, b: FloatArray) -> tuple[Bools, Bools, FloatArray]:
        """Goals that are not shown, and that are shown false, (N, O), with spreads (N, O, V)."""
        found, spreads = [], []
        for low, high in zip(a.T, b.T, strict=True):
            side, m = ops.between(low, high), 0.5 * low + 0.5 * high
            whole, centre = program.expanded(side, m, fixed)
            found.append(ops.mean_values(whole, centre, side, m))
            size = np.maximum(abs(whole[:, 1:].real), abs(whole[:, 1:].imag))
            spreads.append(size * (high - low))
        values, spread = np.array(found), np.array(spreads)
        below = np.where(sign > 0, values.real, -values.imag)
        above = np.where(sign > 0, values.imag, -values.real)
        shown = np.where(strict, below > bound.imag, below >= bound.imag)
        wrong = np.where(strict, above <= bound.real, above < bound.real)
        return ~shown, wrong, spread

    def judge(a: FloatArray, b: FloatArray) -> tuple[Bools, FloatArray]:
        left, _, spread = compared(a, b)
        return left.T, np.where(left[:, :, None], spread, 0.0).max(axis=1).T

    def false_at(points: FloatArray, _: Bools | None = None) -> tuple[str, Point] | None:
        """A goal that is false at one of the last points (V, N) that are in the box."""
        tried = points[:, -TRIED:]
        for wrong, at in zip(compared(tried, tried)[1], tried.T.tolist(), strict=True):
            inside = (a <= Fraction(v) <= b for v, (a, b) in zip(at, box, strict=True))
            if wrong.any() and all(inside):
                return goals[int(wrong.argmax())].what, tuple(at)
        return None

    corners = np.array(list(itertools.product(*ends))).T if len(box) <= 10 else ends[:, :1]
    for first in range(0, corners.shape[1], TRIED):
        if false := false_at(corners[:, first : first + TRIED]):
            return Settled("refuted", *false, 0)
    rule = Rule(512, float(np.ptp(ends, axis=1).max()) or 1.0, 1e-13, 0.0, max_boxes)
    return branch(ends[:, 0], ends[:, 1], rule, judge, false_at, [g.what for g in goals])
