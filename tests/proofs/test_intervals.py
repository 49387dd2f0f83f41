"""Branch and bound and terminal sets in intervals: they hold what is exact, and hardly more."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import mpmath
import numpy as np
import pytest
import sympy as sp

pytest.importorskip("flint", reason="ball arithmetic is the extra undertow[certify]")

from undertow.base import InvalidInputError
from undertow.proofs.closed_loop.terminal_set import TerminalSet, exact_inverse, negative_by
from undertow.proofs.intervals.batch import Interval
from undertow.proofs.intervals.branch import minimise_proved
from undertow.proofs.intervals.exact_model import is_odd, vanishes

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


# -- exact matrices ---------------------------------------------------------------------------


@pytest.mark.parametrize("size", [1, 2, 3, 5])
def test_inverses_of_float_matrices_are_enclosed_to_the_last_place(size: int) -> None:
    rng = np.random.default_rng(size)
    for _ in range(5):
        T = rng.standard_normal((size, size))
        T[0, 0] = 0.0 if size > 1 else T[0, 0]
        inverse = exact_inverse(T)
        with mpmath.workdps(50):
            exact = mpmath.matrix(T.tolist()) ** -1
            for i in range(size):
                for j in range(size):
                    low, high = inverse.lo[i, j], inverse.hi[i, j]
                    assert low <= exact[i, j] <= high
                    assert high - low <= 4 * np.spacing(abs(high))
    with pytest.raises(InvalidInputError, match="singular"):
        exact_inverse(np.ones((2, 2)))


def test_a_matrix_is_negative_by_its_largest_eigenvalue() -> None:
    """For floats to rounding; for intervals by what their widths may add; never for NaN."""
    rng = np.random.default_rng(1)
    for size in (1, 2, 4):
        root = rng.standard_normal((size, size))
        matrix = -(root @ root.T) - 0.1 * np.eye(size)
        largest = float(np.linalg.eigvalsh(matrix)[-1])
        assert negative_by(Interval(matrix), -largest * (1 - 1e-9))
        assert not negative_by(Interval(matrix), -largest * (1 + 1e-9))
        skew = np.triu(rng.standard_normal((size, size)), 1)
        assert negative_by(Interval(matrix + skew - skew.T), -largest * (1 - 1e-6))
        half = 0.01
        wide = Interval(matrix - half, matrix + half)
        assert negative_by(wide, -largest - size * half * (1 + 1e-9)) or size * half > -largest
        assert not negative_by(wide, -largest - 0.5 * half)
    assert not negative_by(Interval(np.array([[math.nan]])), 0.0)
    assert not negative_by(Interval(np.array([[-INF]]), np.array([[-1.0]])), 0.0)
    assert not negative_by(Interval(np.zeros((2, 2))), 0.0)


def test_a_terminal_set_is_an_ellipsoid_with_a_band() -> None:
    """W(z) = max(‖T⁻¹x‖, |s_i|/σ_i), 1 on its edge; grown it is smaller by as much."""
    T = np.array([[2.0, 1.0], [0.0, 0.5]])
    terminal = TerminalSet(T, [0.25, 0.5])
    for angle in (0.0, 1.0, 2.5):
        x = T @ [math.cos(angle), math.sin(angle)]
        assert terminal.value([*x, 0.0, 0.0]) == pytest.approx(1.0)
        assert terminal.value([*(0.3 * x), 0.1, -0.4]) == pytest.approx(0.8)
        assert terminal.value([*(0.3 * x), -0.15, 0.0]) == pytest.approx(0.6)
        assert terminal.times(2.0).value([*x, 0.5, 0.0]) == pytest.approx(1.0)
    assert TerminalSet.from_dict(terminal.to_dict()).to_dict() == terminal.to_dict()
    assert TerminalSet(1e-60 * np.eye(2), 0.1).value([1e-60, 0, 0]) == pytest.approx(1.0)
    for scale, widths, what in (
        (np.ones((2, 3)), 0.1, "square"),
        ([1.0, 2.0], 0.1, "square"),
        ([[math.nan]], 0.1, "square"),
        (np.ones((2, 2)), 0.1, "invertible"),
        (T, [0.1, 0.0], "> 0"),
        (T, [0.1, -0.1], "> 0"),
        (T, [0.1, INF], "finite"),
    ):
        with pytest.raises(InvalidInputError, match=what):
            TerminalSet(scale, widths)


# -- exact models -----------------------------------------------------------------------------


def test_parity_and_zeros_are_shown_symbolically() -> None:
    x, y = sp.symbols("x y", real=True)
    assert is_odd([sp.sin(x), x**3 * y**2], [x, y], [sp.cos(x), x * y])
    assert not is_odd([sp.sin(x), x**2], [x, y])
    assert not is_odd([sp.sin(x)], [x, y], [x])
    assert is_odd([sp.sin(x) * y], [x])
    assert vanishes([sp.sin(x) ** 2 + sp.cos(x) ** 2 - 1 + y, x * y], [y])
    assert not vanishes([x * y, x], [y])
