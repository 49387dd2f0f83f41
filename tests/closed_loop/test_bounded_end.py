"""Large steps of loops with bounds of states: they never decide whether a bound is kept."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
from numpy.typing import NDArray

import undertow as ut
from undertow.cascade.planners import TAIL_RTOL
from undertow.closed_loop import ClosedLoop, Event
from undertow.closed_loop.linear_blocks import STEP_SIZES, UNIT
from undertow.closed_loop.linear_model import Prepared
from undertow.closed_loop.work_array import LANES
from undertow.models import FloatArray

#: A cart that may overshoot by little.
OVERSHOOT = ut.state_box(x=(-1.4, 0.1))


def _prepared(loop: ClosedLoop, surfaces: FloatArray) -> Prepared:
    """Linear ends of one loop for every surface, a multiple of the lanes."""
    law = np.repeat(loop.reaching.vector(loop.mechanism.m)[None], len(surfaces), axis=0)
    lanes = np.hstack([surfaces, law, np.ones((len(surfaces), 1))])[:, None]
    end = loop.linear_end
    assert end is not None
    prepared = end.buffers(len(surfaces))
    end.prepare(lanes, None, prepared)
    return prepared


def _whole(rows: FloatArray) -> FloatArray:
    """A of ẋ = A x, (C, 2n, 2n), from the rows of its accelerations."""
    count, n = rows.shape[:2]
    upper = np.broadcast_to(np.hstack([np.zeros((n, n)), np.eye(n)]), (count, n, 2 * n))
    return np.concatenate([upper, rows], axis=1)


def _around(mechanism: ut.Mechanism, count: int, spread: float, seed: int) -> FloatArray:
    """Random surfaces around the designed one, (count, 2mn)."""
    base = ut.first_surface(mechanism).normalised().vector
    drawn = np.random.default_rng(seed).standard_normal((count, base.size))
    return np.asarray(base * np.exp(spread * drawn))


def test_the_reach_of_a_step_bounds_what_scipy_integrates() -> None:
    """F̄ is no smaller than |∫ e^{As} ds| at any time of the step, for a place and for a speed."""
    rig = ut.mechanisms.cart_pendulum()
    box = ut.state_box(x=1.4, phi_dot=8.0)
    loop = ClosedLoop(rig, ut.MinimumEnergy(constraints=box), tail_rtol=TAIL_RTOL)
    prepared = _prepared(loop, _around(rig, LANES, 0.1, seed=4))
    reach = prepared.reach.reshape(STEP_SIZES, 2, 4, LANES)
    for lane, A in list(enumerate(_whole(prepared.A)))[::4]:
        chain = np.zeros((8, 8))
        chain[:4, :4], chain[:4, 4:] = A, np.eye(4)
        for level in range(STEP_SIZES):
            span = UNIT * 2**level
            for s in np.linspace(0.0, span, 9)[1:]:
                exact = np.abs(scipy.linalg.expm(s * chain)[[0, 3], 4:])
                assert (exact <= reach[level, :, :, lane] * (1 + 1e-6) + 1e-12).all()
            if level == 0:  # and not far from it
                assert reach[level, 0, 0, lane] <= 1.1 * exact[0, 0]


def _agree(loop: ClosedLoop, seen: FloatArray, exact: FloatArray) -> None:
    """Smallest margins up to the spare part of a bound are the same, and no margin is smaller."""
    spare = np.array([spare for _, spare in loop.objective.boxes(loop.mechanism)])
    np.testing.assert_array_equal(np.minimum(seen, spare), np.minimum(exact, spare))
    looked = np.isfinite(exact)  # not so where a motion was never begun
    np.testing.assert_array_equal(np.isfinite(seen), looked)
    assert (seen[looked] >= exact[looked] - TAIL_RTOL * np.abs(exact[looked])).all()


@pytest.mark.slow  # kernels of their own
@pytest.mark.parametrize("goal", [ut.MinimumEnergy(), ut.MinimumTime()])
def test_a_loop_with_travel_ends_in_large_steps(goal: ut.Objective) -> None:
    """Verdicts are those of small steps, costs agree to 0.1 %; far fewer steps.

    Margins within which a bound may be met are the same, wider ones are seen at fewer instants.
    """
    rig = ut.mechanisms.cart_pendulum()
    rng = np.random.default_rng(11)
    states = rng.uniform([-1.42, -0.3, -0.5, -0.5], [1.42, 0.3, 0.5, 0.5], (400, 4))
    surfaces = _around(rig, 400, 0.5, seed=12)
    exact = ClosedLoop(rig, goal)
    assert [c.state for c in exact.objective.constraints] == ["x"]
    small = exact.batch(states, surfaces, stable_only=True)
    large = replace(exact, tail_rtol=TAIL_RTOL).batch(states, surfaces, stable_only=True)
    np.testing.assert_array_equal(large.event, small.event)
    _agree(exact, large.path, small.path)
    assert (small.event == Event.CONSTRAINT).sum() > 20
    both = small.reached
    assert both.sum() > 60
    # A motion that passes the terminal set closely arrives now, or a swing later.
    radius = exact.objective.terminal_radius
    first, last = (
        exact.batch(states, surfaces, stable_only=True, terminal=part * radius)
        for part in (1.001, 0.999)
    )
    for what in ("cost", "time"):
        answer, least, most = (getattr(b, what)[both] for b in (large, first, last))
        assert (answer >= 0.999 * least).all()
        assert (answer <= 1.001 * most).all()
    assert large.steps[both].sum() < 0.5 * small.steps[both].sum()


def _swinging(loop: ClosedLoop, count: int) -> FloatArray:
    """Surfaces whose slowest mode swings, so that a motion overshoots again and again."""
    surfaces = _around(loop.mechanism, 40 * LANES * (count // LANES + 1), 1.0, seed=0)
    A = _whole(_prepared(loop, surfaces).A)
    sound = np.asarray(np.isfinite(A).all(axis=(1, 2)))
    modes = np.linalg.eigvals(np.where(sound[:, None, None], A, np.eye(A.shape[1])))
    slowest = np.take_along_axis(modes, modes.real.argmax(axis=1)[:, None], axis=1)[:, 0]
    swings = np.abs(slowest.imag) > 0.5 * np.abs(slowest.real)
    calm = (slowest.real < -0.05) & (np.abs(modes).max(axis=1) < 300)
    return np.asarray(surfaces[swings & calm][:count])


@pytest.mark.slow  # kernels of their own
@pytest.mark.parametrize("name", ["cart_pendulum", "overhead_crane"])
def test_a_late_touch_is_seen_and_a_near_miss_is_none(name: str) -> None:
    """Starts scaled until an overshoot meets the bound, then by 1e-9 to 0.3 less and more."""
    rig: ut.Mechanism = getattr(ut.mechanisms, name)()
    exact = ClosedLoop(rig, ut.MinimumEnergy(constraints=OVERSHOOT))
    ended = replace(exact, tail_rtol=TAIL_RTOL)
    surfaces = _swinging(ended, 100)
    rng = np.random.default_rng(1)
    ray = 0.01 * rng.standard_normal((len(surfaces), 4))
    ray[:, 0] = rng.uniform(-0.35, -0.18, len(surfaces))

    def breaks(scale: FloatArray) -> NDArray[np.bool_]:
        return np.asarray(exact.batch(ray * scale[:, None], surfaces).event == Event.CONSTRAINT)

    kept, broken = np.full(len(ray), 0.05), np.full(len(ray), np.nan)
    for scale in np.geomspace(0.1, 3.5, 8):
        broken[np.isnan(broken) & breaks(np.full(len(ray), scale))] = scale
        kept[np.isnan(broken)] = scale
    meet = ~np.isnan(broken)
    ray, surfaces, kept, broken = ray[meet], surfaces[meet], kept[meet], broken[meet]
    for _ in range(36):
        middle = (kept + broken) / 2
        too_far = breaks(middle)
        broken, kept = np.where(too_far, middle, broken), np.where(too_far, kept, middle)
    touch = exact.batch(ray * broken[:, None], surfaces)
    assert (touch.time > 1.0).sum() > 30
    shorter = 0
    for part in (-0.1, -0.01, -1e-3, -1e-5, -1e-9, 0.0, 1e-9, 1e-5, 1e-3, 0.01, 0.1, 0.3):
        scale = (broken if part > 0 else kept) * (1 + part)
        small = exact.batch(ray * scale[:, None], surfaces)
        large = ended.batch(ray * scale[:, None], surfaces)
        np.testing.assert_array_equal(large.event, small.event)
        _agree(exact, large.path, small.path)
        both = small.reached
        np.testing.assert_allclose(large.cost[both], small.cost[both], rtol=1e-3)
        shorter += int((large.steps < 0.9 * small.steps).sum())
    assert shorter > 100


@pytest.mark.slow
def test_a_constraint_of_another_kind_keeps_small_steps() -> None:
    """A formula of the user's own is tested in every small step, and so is a bound of an input."""
    rig = ut.mechanisms.cart_pendulum()
    swing = ut.Constraint("tip above the cart", lambda v: v.phi**2 - 1.0)
    push = ut.MinimumEnergy(constraints=ut.state_box(force=15.0))
    assert not ClosedLoop(rig, push, tail_rtol=TAIL_RTOL).takes_large_steps
    assert ClosedLoop(
        rig, ut.MinimumEnergy(constraints=OVERSHOOT), tail_rtol=TAIL_RTOL
    ).takes_large_steps
    loop = ClosedLoop(rig, ut.MinimumEnergy(constraints=(*OVERSHOOT, swing)))
    states, surfaces = np.tile(rig.usual_start, (32, 1)), _around(rig, 32, 0.3, seed=2)
    small, large = (replace(loop, tail_rtol=t).batch(states, surfaces) for t in (0.0, TAIL_RTOL))
    np.testing.assert_array_equal(large.steps, small.steps)
    np.testing.assert_array_equal(large.cost, small.cost)
