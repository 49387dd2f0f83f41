"""Branch and bound over a box with ball arithmetic: proved minima of smooth functions."""

from __future__ import annotations

import heapq
import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from undertow.base.verdict import Kind, Verdict
from undertow.proofs.intervals.interval import ball, lower_float, upper_float

#: A function of one ball per variable; NaN where it is undefined on some of the box.
BallFunction = Callable[[list[Any]], Any]


@dataclass(frozen=True)
class Minimum:
    """Enclosure of the minimum of a function over a box.

    ``lower`` is proved; ``value`` is the proved upper end of the value at ``point``; they
    differ by the tolerance, unless the number of boxes ran out (``finished`` is False,
    and ``stuck`` is the box with the lowest bound).
    """

    lower: float
    value: float
    point: tuple[float, ...]
    stuck: tuple[tuple[float, float], ...]
    boxes: int
    finished: bool

    def verdict(
        self, claim: str, names: Iterable[str], unit: str, method: str, held: bool | None
    ) -> Verdict:
        """State a claim of the function that holds, does not, or (None) was not decided."""
        kind: Kind = "undecided" if held is None else "proved" if held else "refuted"
        middle = tuple(0.5 * (a + b) for a, b in self.stuck)
        witness = dict(zip(names, middle if held is None else self.point, strict=True))
        method += ", gave up" if held is None else ""
        margin = self.lower if held else self.value
        return Verdict(claim, kind, margin, unit, witness, method, {"boxes": self.boxes})


def minimise_proved(
    function: BallFunction,
    box: Sequence[tuple[float, float]],
    *,
    tolerance: float = 1e-3,
    absolute: float = 1e-9,
    stop_below: float = -math.inf,
    stop_above: float = math.inf,
    max_boxes: int = 100_000,
) -> Minimum:
    """Enclose the minimum of ``function`` over a box, best bound first.

    Parameters
    ----------
    function
        Takes one ball per variable and returns one ball.
    box
        (low, high) per variable; points (low = high) are allowed.
    tolerance, absolute
        Stop when value − lower ≤ max(tolerance·|value|, absolute).
    stop_below
        Stop as soon as a point with a value proved ≤ this is met.
    stop_above
        Stop as soon as the lower bound is proved > this.
    max_boxes
        Give up after so many evaluations.
    """
    order = itertools.count()
    start = tuple((float(a), float(b)) for a, b in box)
    best, point = math.inf, tuple(0.5 * (a + b) for a, b in start)
    heap: list[tuple[float, int, tuple[tuple[float, float], ...]]] = []
    count = 0

    def probe(candidate: tuple[float, ...]) -> None:
        nonlocal best, point
        value = function([ball(v) for v in candidate])
        if value.is_finite() and upper_float(value) < best:
            best, point = upper_float(value), candidate

    def push(part: tuple[tuple[float, float], ...]) -> None:
        bound = function([ball(a, b) for a, b in part])
        low = lower_float(bound) if bound.is_finite() else -math.inf
        heapq.heappush(heap, (low, next(order), part))

    # The extremes of a mechanism's functions often sit at corners or at the target.
    moving = [i for i, (a, b) in enumerate(start) if b > a]
    if len(moving) <= 6:
        for corner in itertools.product(*start):
            probe(tuple(corner))
    probe(tuple(min(max(0.0, a), b) for a, b in start))
    probe(tuple(0.5 * (a + b) for a, b in start))
    push(start)
    while True:
        lower, _, part = heap[0]
        gap = max(tolerance * abs(best), absolute) if math.isfinite(best) else absolute
        done = best - lower <= gap or best <= stop_below or lower > stop_above
        width, axis = max((b - a, i) for i, (a, b) in enumerate(part))
        exhausted = count >= max_boxes or (not done and width <= 0)
        if done or exhausted:
            return Minimum(min(lower, best), best, point, part, count, done)
        heapq.heappop(heap)
        low, high = part[axis]
        middle = 0.5 * (low + high)
        if not low < middle < high:  # two neighbouring floats: no further split exists
            heapq.heappush(heap, (lower, next(order), part))
            return Minimum(min(lower, best), best, point, part, count, False)
        for half in ((low, middle), (middle, high)):
            child = (*part[:axis], half, *part[axis + 1 :])
            push(child)
            probe(tuple(0.5 * (a + b) for a, b in child))
        count += 2
