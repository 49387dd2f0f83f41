"""Branch and bound in balls: it holds what is exact, and hardly more."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
import sympy as sp

pytest.importorskip("flint", reason="ball arithmetic is the extra undertow[certify]")

from undertow.proofs.intervals.branch import minimise_proved
from undertow.proofs.intervals.exact_model import is_odd

INF = math.inf

# -- branch and bound -------------------------------------------------------------------------


def bowl(balls: list[Any]) -> Any:
    """(x − 1)² + (y + ½)² + 2: 2 at (1, −½)."""
    x, y = balls
    return (x - 1) ** 2 + (y + 0.5) ** 2 + 2


BOX = [(-2.0, 3.7), (-1.1, 2.3)]


def test_a_minimum_is_enclosed_to_its_tolerance() -> None:
    for tolerance in (1e-2, 1e-4):
        found = minimise_proved(bowl, BOX, tolerance=tolerance)
        assert found.finished
        assert found.lower <= 2.0 <= found.value
        assert found.value - found.lower <= tolerance * found.value
        assert found.point == pytest.approx((1.0, -0.5), abs=math.sqrt(tolerance) * 3)
        assert bowl(list(found.point)) <= found.value
    coarse = minimise_proved(bowl, BOX, tolerance=0.0, absolute=0.5)
    assert 0.1 < coarse.value - coarse.lower <= 0.5
    assert coarse.boxes < found.boxes


def test_a_search_for_a_sign_stops_when_it_is_known() -> None:
    """As soon as a value is low enough, or all of them are shown to be high enough."""
    whole = minimise_proved(bowl, BOX, tolerance=1e-9)
    below = minimise_proved(bowl, BOX, stop_below=2.5)
    assert below.finished
    assert 2.0 <= below.value <= 2.5
    above = minimise_proved(bowl, BOX, stop_above=1.0, tolerance=0.0, absolute=0.0)
    assert above.finished
    assert 1.0 < above.lower <= 2.0
    assert max(below.boxes, above.boxes) < whole.boxes / 4
    neither = minimise_proved(bowl, BOX, stop_below=1.9, stop_above=2.1)
    assert neither.finished
    assert neither.lower <= 2.0 <= neither.value


def test_effort_is_counted_and_runs_out() -> None:
    calls = 0

    def counted(balls: list[Any]) -> Any:
        nonlocal calls
        calls += 1
        return bowl(balls)

    found = minimise_proved(counted, BOX, tolerance=1e-12, absolute=0.0, max_boxes=50)
    assert not found.finished
    assert found.boxes == 50
    assert calls == 2 * 50 + 4 + 2 + 1  # each box and its middle; corners, target, middle, all
    assert found.lower <= 2.0 <= found.value
    stuck = found.stuck
    assert all(low <= a < b <= high for (a, b), (low, high) in zip(stuck, BOX, strict=True))
    point = minimise_proved(counted, [(0.25, 0.25), (0.5, 0.5)])
    assert point.finished
    assert point.value == pytest.approx(bowl([0.25, 0.5]))
    assert point.lower == pytest.approx(point.value)


def test_extremes_at_corners_and_at_the_target_are_tried_first() -> None:
    """In up to six variables the corners, and always the point of the box nearest to 0."""

    def low_at(place: list[float]) -> Callable[[list[Any]], Any]:
        return lambda balls: sum(
            ((b - p) ** 2 for b, p in zip(balls, place, strict=True)), start=1 * balls[0] * 0
        )

    for size in (1, 3, 6):
        for corner in ([-1.0] * size, [2.0] * size, [-1.0, *[2.0] * (size - 1)]):
            found = minimise_proved(low_at(corner), [(-1.0, 2.0)] * size, stop_below=1e-12)
            assert found.boxes == 0
            assert found.point == tuple(corner)
    calls = 0

    def flat(balls: list[Any]) -> Any:
        nonlocal calls
        calls += 1
        return 1.0 + 0 * balls[0]

    minimise_proved(flat, [(-1.0, 2.0)] * 7)
    assert calls == 3  # the target, the middle, all of it
    for low, high, nearest in ((-1.0, 2.0, 0.0), (0.5, 2.0, 0.5), (-2.0, -0.5, -0.5)):
        found = minimise_proved(low_at([nearest] * 8), [(low, high)] * 8, stop_below=1e-12)
        assert (found.boxes, found.point) == (0, (nearest,) * 8)


def test_what_is_undefined_somewhere_is_not_bounded_there() -> None:
    """1/x over 0: no lower bound and no end, whatever is found elsewhere."""
    found = minimise_proved(lambda balls: 1 / balls[0], [(-1.0, 1.0)], max_boxes=40)
    assert not found.finished
    assert found.lower == -INF
    assert found.value <= -1.0


def test_a_minimum_becomes_a_verdict() -> None:
    """Proved with its bound, refuted with its point, undecided with the box it stuck in."""
    found = minimise_proved(bowl, BOX, max_boxes=20)
    proved, refuted, neither = (
        found.verdict("f > 0", ("x", "y"), "m", "balls", held) for held in (True, False, None)
    )
    assert (proved.kind, refuted.kind, neither.kind) == ("proved", "refuted", "undecided")
    assert (proved.margin, refuted.margin) == (found.lower, found.value)
    assert refuted.witness == {"x": found.point[0], "y": found.point[1]}
    (a, b), _ = found.stuck
    assert neither.witness["x"] == 0.5 * (a + b)
    assert "gave up" in neither.method
    assert "gave up" not in proved.method


# -- exact models -----------------------------------------------------------------------------


def test_parity_is_shown_symbolically() -> None:
    x, y = sp.symbols("x y", real=True)
    assert is_odd([sp.sin(x), x**3 * y**2], [x, y], [sp.cos(x), x * y])
    assert not is_odd([sp.sin(x), x**2], [x, y])
    assert not is_odd([sp.sin(x)], [x, y], [x])
    assert is_odd([sp.sin(x) * y], [x])
