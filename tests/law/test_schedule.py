"""Plans: which surface is in use when, what is left of a plan, and plans side by side."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

import undertow as ut
from support import random_surface
from undertow.base import InvalidInputError
from undertow.law import Plan, rising_from_zero

#: Four surfaces of two inputs and three coordinates, with reaching laws that are all different.
SURFACES = tuple(random_surface(3, 2, seed) for seed in range(4))
LAWS = tuple(ut.ReachingLaw((5.0 + k, 8.0), 0.2 + 0.1 * k) for k in range(4))
TIMES = (0.0, 0.1, 0.25, 0.3)

#: What a plan without laws of its own is reached by.
USUAL = ut.ReachingLaw(20.0, 0.1)


def index(t: float) -> int:
    """Which of the surfaces is in use at t: the last that has taken over."""
    return max([k for k, begins in enumerate(TIMES) if begins <= t], default=0)


@pytest.mark.parametrize("laws", [None, LAWS])
def test_a_surface_is_in_use_until_the_next_takes_over(
    laws: tuple[ut.ReachingLaw, ...] | None,
) -> None:
    """Also before the start and after the last switch; half a nanosecond early is on time."""
    plan = Plan(SURFACES, TIMES, laws)
    for t in (-1.0, 0.0, 0.0995, 0.1, 0.1001, 0.2, 0.25, 0.27, 0.3, 5.0):
        surface, law = plan.at(t)
        assert surface is SURFACES[index(t)]
        assert law is (None if laws is None else laws[index(t)])
    for k in (1, 2, 3):
        assert plan.at(TIMES[k] - 0.5e-9)[0] is SURFACES[k]
        assert plan.at(TIMES[k] - 2e-9)[0] is SURFACES[k - 1]


@pytest.mark.parametrize("laws", [None, LAWS])
@pytest.mark.parametrize("passed", [0.0, 0.04, 0.1, 0.17, 0.25, 0.3, 0.9])
def test_what_is_left_of_a_plan_goes_on_as_the_plan_does(
    laws: tuple[ut.ReachingLaw, ...] | None, passed: float
) -> None:
    """At every later instant the same surface and law, and nothing that is over is kept."""
    plan = Plan(SURFACES, TIMES, laws)
    left = plan.shifted(passed)
    for later in np.arange(0.0, 0.5, 0.01) + 0.005:
        assert left.at(later) == plan.at(passed + later)
    assert left.surfaces == SURFACES[index(passed) :]
    assert len(left.times) == len(left.surfaces)
    np.testing.assert_allclose(left.times[1:], np.array(TIMES[index(passed) + 1 :]) - passed)


@pytest.mark.parametrize("laws", [None, LAWS])
@pytest.mark.parametrize("passed", [0.05, 0.1, 0.2, 0.9])
def test_a_plan_is_followed_by_another(
    laws: tuple[ut.ReachingLaw, ...] | None, passed: float
) -> None:
    """Until then the one, from then on the other, as from its start."""
    plan, other = Plan(SURFACES, TIMES, laws), Plan(SURFACES[1::2], (0.0, 0.15), LAWS[:2])
    both = plan.followed_by(other, passed, USUAL)
    for t in np.arange(0.0, 1.5, 0.01) + 0.005:
        one, since = (plan, t) if t < passed else (other, t - passed)
        surface, law = one.at(since)
        assert both.at(t) == (surface, law or USUAL)
    assert both.times[-1] == pytest.approx(passed + 0.15)


def test_shifted_times_are_whole_nanoseconds() -> None:
    """Shifts add up to what one shift gives: no rounding of 0.1 s is kept."""
    plan = Plan(SURFACES[:2], (0.0, 0.7))
    steps = plan
    for _ in range(6):
        steps = steps.shifted(0.1)
    assert steps.times == plan.shifted(0.6).times == (0.0, 0.1)
    assert plan.shifted(2e-10).times == plan.times
    assert Plan.of(SURFACES[0]).shifted(3.0).times == (0.0,)


def test_plans_side_by_side_have_common_times() -> None:
    """Every plan says at each of the common times what it says alone; law where it has none."""
    plans = [
        Plan(SURFACES, TIMES, LAWS),
        Plan.of(SURFACES[2]),
        Plan(SURFACES[1:3], (0.0, 0.2)),
        Plan(SURFACES[:2], (0.0, 0.25), LAWS[2:]),
    ]
    times, vectors, gains = Plan.align(plans, USUAL)
    assert times == (0.0, 0.1, 0.2, 0.25, 0.3)
    for plan, rows, laws in zip(plans, vectors, gains, strict=True):
        for t, row, law in zip(times, rows, laws, strict=True):
            surface, own = plan.at(t)
            np.testing.assert_array_equal(row, surface.vector)
            np.testing.assert_array_equal(law, (own or USUAL).vector(2))
    alone = Plan.align(plans[1:2], USUAL)
    assert alone[0] == (0.0,)
    assert alone[1].shape == (1, 1, 12)


def test_a_plan_lists_its_surfaces_and_gains_in_order() -> None:
    for laws in (None, LAWS):
        plan = Plan(SURFACES, TIMES, laws)
        used = laws or (USUAL,) * 4
        np.testing.assert_array_equal(plan.vectors, [s.vector for s in SURFACES])
        np.testing.assert_array_equal(plan.gains(USUAL), [law.vector(2) for law in used])
        assert plan.laws(USUAL) == used


def test_a_plan_is_made_of_a_surface_of_several_or_of_a_plan() -> None:
    plan = Plan(SURFACES, TIMES, LAWS)
    assert Plan.of(plan) is plan
    assert Plan.of(SURFACES[1]) == Plan((SURFACES[1],))
    assert Plan.of(list(SURFACES), iter(TIMES)) == Plan(SURFACES, TIMES)
    with pytest.raises(InvalidInputError, match="its own times"):
        Plan.of(plan, TIMES)


@pytest.mark.parametrize(
    ("times", "good"),
    [
        ((0.0,), True),
        ((0, 1), True),
        ((0.0, 0.5, 0.7), True),
        ((), False),
        ((0.1,), False),
        ((-0.1, 0.0), False),
        ((0.0, 0.5, 0.5), False),
        ((0.0, 0.5, 0.4), False),
        ((0.0, math.inf), False),
        ((0.0, 1.0, math.inf), False),
        ((0.0, math.nan), False),
        ((math.nan,), False),
    ],
)
def test_times_begin_at_zero_and_rise(times: tuple[float, ...], good: bool) -> None:
    assert rising_from_zero(times) == good
    surfaces = (SURFACES * 2)[: len(times)]
    if good:
        assert Plan(surfaces, times).times == times
    else:
        what = "times" if times else "surfaces"
        with pytest.raises(InvalidInputError, match=f"{what} of a plan"):
            Plan(surfaces, times)


#: What a loop that is compiled for the saturation does not follow.
ANOTHER = Plan(SURFACES[:1], reaching=(ut.ReachingLaw((5.0, 8.0), 0.2, "tanh"),))

REFUSALS: dict[str, tuple[Callable[[], object], str]] = {
    "of two kinds": (lambda: Plan((SURFACES[0], random_surface(2, 1)), (0.0, 1.0)), "surfaces of"),
    "no surface": (lambda: Plan((SURFACES[0], 3.0), (0.0, 1.0)), "surfaces of"),  # type: ignore[arg-type]
    "alone no surface": (lambda: Plan((3.0,)), "surfaces of"),  # type: ignore[arg-type]
    "too many times": (lambda: Plan(SURFACES[:1], (0.0, 1.0)), "times of"),
    "too few times": (lambda: Plan(SURFACES, TIMES[:3]), "times of"),
    "too few laws": (lambda: Plan(SURFACES, TIMES, LAWS[:3]), "reaching laws of"),
    "laws that are none": (lambda: Plan(SURFACES[:1], reaching=(0.5,)), "reaching of Plan"),  # type: ignore[arg-type]
    "no plans": (lambda: Plan.align([], USUAL), "number of plans"),
    "a law that switches otherwise": (lambda: ANOTHER.gains(USUAL), "one that switches by 'tanh'"),
    "the same, beside others": (
        lambda: Plan.align([Plan.of(SURFACES[2]), ANOTHER], USUAL),
        "one that switches by 'tanh'",
    ),
}


@pytest.mark.parametrize("what", REFUSALS)
def test_what_is_no_plan_is_refused(what: str) -> None:
    attempt, message = REFUSALS[what]
    with pytest.raises(InvalidInputError, match=message) as caught:
        attempt()
    assert caught.value.limit is not None


def test_a_plan_keeps_tuples_of_its_own() -> None:
    """Lists and arrays could be changed after they were checked, and have no hash."""
    surface, times = ut.Surface(-1, -0.5, 5, 10), np.array([0.0, 0.1])
    plan = ut.Plan([surface, surface], times)  # type: ignore[arg-type]
    times[:] = np.nan
    assert plan == ut.Plan((surface, surface), (0.0, 0.1))
    assert hash(plan) == hash(ut.Plan((surface, surface), (0.0, 0.1)))
    with pytest.raises(InvalidInputError, match=r"one undertow\.Surface or more"):
        ut.Plan(())
