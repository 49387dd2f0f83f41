"""The exact linear end of a closed loop, and what a rollout sees between its steps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.linalg

import undertow as ut
from undertow.cascade.cascade import TAIL_RTOL
from undertow.closed_loop import ClosedLoop
from undertow.closed_loop.linear_model import Prepared, TerminalLinearModel
from undertow.closed_loop.work_array import LANES
from undertow.law import sliding_matrix
from undertow.models import FloatArray


def _prepared(loop: ClosedLoop, spread: float) -> tuple[Prepared, TerminalLinearModel]:
    """Prepare the ends of a block of surfaces around the designed one."""
    rig, rng = loop.mechanism, np.random.default_rng(3)
    base = ut.first_surface(rig).normalised().vector
    surfaces = base * np.exp(spread * rng.standard_normal((LANES, base.size)))
    end = loop.linear_end
    assert end is not None
    law = np.repeat(loop.reaching.vector(rig.m)[None], LANES, axis=0)
    lanes = np.hstack([surfaces, law, np.ones((LANES, 1))])[:, None]
    prepared = end.buffers(LANES)
    end.prepare(lanes, None, prepared)
    return prepared, end


def _full(rows: FloatArray) -> FloatArray:
    n = len(rows)
    return np.vstack([np.hstack([np.zeros((n, n)), np.eye(n)]), rows])


@pytest.mark.parametrize(
    "build",
    [
        ut.mechanisms.rotary_pendulum,
        pytest.param(ut.mechanisms.double_pendulum_on_a_cart, marks=pytest.mark.slow),
    ],
)
def test_linear_ends_agree_with_scipy(build: Callable[[], ut.Mechanism]) -> None:
    """Lyapunov integrals, decay rates, stability and e^{At} of sixteen loops at once."""
    prepared, _ = _prepared(ClosedLoop(build(), ut.MinimumTime(), tail_rtol=1e-3), 0.1)
    stable = 0
    for lane in range(LANES):
        A = _full(prepared.A[lane])
        slowest = -np.linalg.eigvals(A).real.max()
        assert (slowest > 0) == (prepared.stable[lane] > 0)
        if slowest < 0.05:
            continue
        stable += 1
        P = scipy.linalg.solve_continuous_lyapunov(A.T, -np.eye(len(A)))
        np.testing.assert_allclose(prepared.P[lane], P, rtol=1e-8, atol=1e-8 * np.abs(P).max())
        power = prepared.powers[0, 5].reshape(len(A), len(A), LANES)[:, :, lane]
        np.testing.assert_allclose(power, scipy.linalg.expm(0.16 * A), atol=1e-7)
        # ∫ e^{As} ds and ∫ e^{A(t−s)} s/t ds, from the exponential of one larger matrix.
        n = len(A)
        chain = np.zeros((3 * n, 3 * n))
        chain[:n, :n], chain[:n, n : 2 * n] = A, np.eye(n)
        chain[n : 2 * n, 2 * n :] = np.eye(n)
        whole = scipy.linalg.expm(0.16 * chain)[:n]
        forced = prepared.forced[0, 5].reshape(2, n, n, LANES)[..., lane]
        np.testing.assert_allclose(forced[0], whole[:, n : 2 * n], atol=1e-7)
        np.testing.assert_allclose(forced[1], whole[:, 2 * n :] / 0.16, atol=1e-7)
    assert stable >= LANES // 2


def _drawn(count: int) -> tuple[FloatArray, FloatArray]:
    """Random surfaces and states of the rotary pendulum, many of them admissible."""
    rng = np.random.default_rng(5)
    entries = np.array([-1.5, 1.7, 12.0]) * np.exp(0.5 * rng.standard_normal((count, 3)))
    vectors = np.column_stack([-np.ones(count), entries])
    return rng.uniform([-1, -0.5, -1, -1], [1, 0.5, 1, 1], (count, 4)), vectors


@pytest.mark.parametrize("objective", [ut.MinimumEnergy(), ut.MinimumTime()])
def test_large_steps_agree_with_small_ones(rig: ut.Mechanism, objective: ut.Objective) -> None:
    """Cost and arrival to 0.1 % on random surfaces and states, in a fifth of the steps or less."""
    states, vectors = _drawn(200)
    exact = ClosedLoop(rig, objective)
    whole = exact.batch(states, vectors, stable_only=True)
    ended = replace(exact, tail_rtol=TAIL_RTOL).batch(states, vectors, stable_only=True)
    assert whole.reached.sum() > 60
    np.testing.assert_array_equal(whole.reached, ended.reached)
    both = whole.reached
    np.testing.assert_allclose(ended.cost[both], whole.cost[both], rtol=1e-3)
    np.testing.assert_allclose(ended.time[both], whole.time[both], rtol=1e-3)
    assert ended.steps[both].sum() < 0.2 * both.sum() * objective.horizon / exact.step


def test_large_steps_of_a_lane_are_its_own(rig: ut.Mechanism) -> None:
    """A rollout does not depend on what else is in its block, to rounding."""
    states, vectors = _drawn(40)
    loop = ClosedLoop(rig, ut.MinimumEnergy(), tail_rtol=TAIL_RTOL)
    together = loop.batch(states, vectors, stable_only=True)
    for k in range(0, 40, 7):
        alone = loop.batch(states[k], vectors[k], stable_only=True)
        assert alone.cost[0] == pytest.approx(together.cost[k], rel=1e-9, nan_ok=True)
        assert alone.time[0] == pytest.approx(together.time[k], rel=1e-9)


def test_what_is_too_fast_for_large_steps_takes_small_ones_first(rig: ut.Mechanism) -> None:
    """A sliding mode at −200/s takes small steps until it is calm, and large ones from there."""
    surface = ut.Surface(-1, -1.841, 1.078, 10.076)
    x = np.array([0.04, 0.21, 1.96, -0.92])
    assert np.linalg.eigvals(sliding_matrix(rig, surface)).real.min() < -150
    exact = ClosedLoop(rig, ut.MinimumEnergy())
    loop = replace(exact, tail_rtol=TAIL_RTOL)
    tried = []

    def etd_integrate(*args: FloatArray) -> None:
        tried.append(float(args[-1][0, 1]))
        exact._kernels.etd_integrate(*args)

    kernels = SimpleNamespace(rollout=exact._kernels.rollout, etd_integrate=etd_integrate)
    object.__setattr__(loop, "_kernels", kernels)
    small, large = exact.batch(x, surface), loop.batch(x, surface)
    assert len(tried) == 2  # in vain, and again half a second later
    assert tried[0] + 0.4 < tried[1]
    assert small.reached[0]
    assert large.cost[0] == pytest.approx(small.cost[0], rel=TAIL_RTOL)
    assert large.time[0] == pytest.approx(small.time[0], rel=TAIL_RTOL)
    assert large.steps[0] < 0.5 * small.steps[0]


def test_a_fast_pass_through_the_terminal_set_is_seen(rig: ut.Mechanism) -> None:
    """The chord of a step counts: a pass between two samples is an arrival, whatever the step."""
    surface = ut.Surface(-1, -3.6, 1.38, 9.07)
    x = rig.state(phi=ut.deg(38))
    near = ClosedLoop(rig, ut.MinimumTime()).batch(
        x, surface, terminal=0.0, duration=3.0, seek=True
    )
    radius = 1.05 * float(near.closest[0])
    for step in (0.002, 0.004):
        loop = ClosedLoop(rig, ut.MinimumTime(terminal_radius=radius), step=step)
        batch = loop.batch(x, surface, duration=3.0)
        assert batch.reached[0]
        assert batch.time[0] == pytest.approx(near.closest_time[0], abs=0.02)
        assert np.linalg.norm(batch.x[0]) == pytest.approx(radius, rel=1e-6)


def test_the_closest_approach_is_that_of_the_recorded_motion(rig: ut.Mechanism) -> None:
    """Smallest ‖x‖, when and where: no larger than any sample, and on the motion."""
    loop = ClosedLoop(rig, ut.MinimumTime())
    surface = ut.Surface(-1, -3.6, 1.38, 9.07)
    x = rig.state(phi=ut.deg(35))
    batch = loop.batch(x, surface, terminal=0.0, duration=2.0, seek=True)
    motion = loop.simulate(x, surface, terminal=0.0, duration=2.0)
    radii = np.linalg.norm(motion.x, axis=1)
    assert batch.closest[0] <= radii.min()
    assert batch.closest[0] == pytest.approx(np.linalg.norm(batch.closest_x[0]))
    place = [np.interp(batch.closest_time[0], motion.t, column) for column in motion.x.T]
    np.testing.assert_allclose(batch.closest_x[0], place, atol=1e-9)
