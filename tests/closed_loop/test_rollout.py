"""Rollouts: right numbers at the right order, batches, schedules, sampling, events and costs."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import sympy as sp
from scipy.integrate import simpson, solve_ivp

import undertow as ut
from support import (
    derivative,
    interpreted,
    observed_order,
    random_mechanism,
    random_states,
    random_surface,
    runge_kutta,
)
from undertow.base import InvalidInputError
from undertow.closed_loop import INADMISSIBLE, UNSTABLE, Event, RolloutBuffers, simulate_along
from undertow.closed_loop.trajectory import PENALTY, Batch
from undertow.law import Plan
from undertow.models import TIME, FloatArray
from undertow.plants import IdealRig

PUSH = ut.Parameter("push", 0.05, "N m", "size of the disturbance")


@pytest.fixture(scope="module")
def loop(rig: ut.Mechanism) -> ut.ClosedLoop:
    return ut.ClosedLoop(rig)


@pytest.fixture(scope="module")
def starts(rig: ut.Mechanism) -> FloatArray:
    x = random_states(rig, 37, position=0.9, speed=1.5)
    x[:, 0] *= 0.1
    return x


@pytest.fixture(scope="module")
def surfaces(quick: ut.Surface) -> list[ut.Surface]:
    rng = np.random.default_rng(4)
    scale = rng.uniform(0.8, 1.2, (37, 4))
    return [ut.Surface.from_vector(quick.vector * row, 2, 1).normalised() for row in scale]


def assert_same(one: Batch, two: Batch) -> None:
    """Bit for bit the same results."""
    for name in ("cost", "time", "event", "radius", "singular", "input", "path", "x"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name), err_msg=name)


# -- against other integrators ---------------------------------------------------------------


@pytest.mark.parametrize("phi", [0.25, 0.8])
def test_kernel_agrees_with_scipy(rig: ut.Mechanism, quick: ut.Surface, phi: float) -> None:
    """Saturation law, from 0.8 rad with the 15 V limit met: 1e-7 against DOP853 at 1e-11."""
    loop = ut.ClosedLoop(rig, step=2e-5)
    x0 = rig.state(phi=phi, theta_dot=-0.4)
    run = loop.simulate(x0, quick, duration=1.0, terminal=0.0, every=2500)
    assert (np.abs(run.u).max() == 15.0) == (phi == 0.8)
    law = ut.SlidingModeLaw(rig, quick)
    exact = solve_ivp(
        lambda t, x: derivative(rig, t, x, law(t, x).u),
        (0, 1.0),
        x0,
        method="DOP853",
        rtol=1e-11,
        atol=1e-12,
        max_step=0.01,
        t_eval=run.t,
    )
    np.testing.assert_allclose(run.x, exact.y.T, rtol=0, atol=1e-7)


@pytest.mark.slow  # compiling it takes longer than all else in this file
def test_kernel_with_four_coordinates_and_two_inputs_agrees_with_scipy() -> None:
    mechanism, surface = random_mechanism(4, 2), random_surface(4, 2)
    reaching = ut.ReachingLaw(eta=(6.0, 9.0), layer=(0.5, 0.8))
    loop = ut.ClosedLoop(mechanism, reaching=reaching, step=1e-4)
    x0 = random_states(mechanism, 1, position=0.3, speed=0.5)[0]
    run = loop.simulate(x0, surface, duration=0.4, terminal=0.0, every=500)
    law = ut.SlidingModeLaw(mechanism, surface, reaching)
    exact = solve_ivp(
        lambda t, x: derivative(mechanism, t, x, law(t, x).u),
        (0, 0.4),
        x0,
        method="DOP853",
        rtol=1e-9,
        atol=1e-10,
        t_eval=run.t,
    )
    np.testing.assert_allclose(run.x, exact.y.T, rtol=0, atol=1e-6)
    np.testing.assert_allclose(run.s[:-1], surface.s(run.x[:-1]), atol=1e-10)


def test_runge_kutta_converges_with_order_four(rig: ut.Mechanism, quick: ut.Surface) -> None:
    """On a smooth piece (tanh, wide layer, no limit met) the error falls as step⁴."""
    free = rig.with_input_limit(1e6)
    reaching = ut.ReachingLaw(layer=1.0, switching="tanh")

    def end(step: float) -> FloatArray:
        loop = interpreted(ut.ClosedLoop(free, reaching=reaching, step=step, rtol=0.0))
        x0 = free.state(phi=0.4, phi_dot=-0.5)
        return np.asarray(loop.simulate(x0, quick, duration=0.128, terminal=0.0).x[-1])

    exact = end(2.5e-4)
    steps = np.array([0.008, 0.004, 0.002])
    errors = np.array([np.abs(end(h) - exact).max() for h in steps])
    assert observed_order(steps, errors) == pytest.approx(4.0, abs=0.15)
    assert errors[-1] < 1e-7


def test_uncontrolled_rollouts_conserve_energy_to_order_four(rig: ut.Mechanism) -> None:
    """No damping, an actuator without strength: |E − E(0)| falls as step⁴ or faster."""
    free = rig.with_parameters(d_e=0.0).with_input_limit(1e-300)
    alone = ut.Surface(-1, -1, 0, 1)  # α_u = 0: Γ = α_a, so the motion is never stopped
    x0 = free.state(phi=0.6, theta_dot=2.0, phi_dot=1.0)
    steps, drifts = np.array([0.008, 0.004, 0.002]), []
    for h in steps:
        loop = ut.ClosedLoop(free, step=h, rtol=0.0)
        run = loop.simulate(x0, alone, duration=2.0, terminal=0.0)
        assert run.event == ut.Event.HORIZON
        assert np.abs(run["phi"]).max() > 3.0  # it swings right through
        energy = free.energy(run.x)
        drifts.append(np.abs(energy - energy[0]).max())
    assert observed_order(steps, np.array(drifts)) > 3.8
    assert drifts[-1] < 1e-6 * np.abs(energy[0])


# -- batches and schedules -------------------------------------------------------------------


@pytest.mark.parametrize("hold", [0, 4])
def test_a_batch_equals_a_loop_bit_for_bit(
    rig: ut.Mechanism, starts: FloatArray, surfaces: list[ut.Surface], hold: int
) -> None:
    """Neither the place in the batch nor its size matters: 37 lanes, reversed, alone."""
    loop = ut.ClosedLoop(rig, zoh_steps=hold)
    together = loop.batch(starts, surfaces, duration=3.0)
    backwards = loop.batch(starts[::-1], surfaces[::-1], duration=3.0)
    assert len(set(together.event.tolist())) >= 2  # lanes end differently, at different times
    assert len(set(together.time.tolist())) > 10
    for i in range(37):
        alone = loop.batch(starts[i], [surfaces[i]], duration=3.0)
        for name in ("cost", "time", "event", "radius", "singular", "input", "path", "x"):
            value = getattr(together, name)[i]
            np.testing.assert_array_equal(getattr(alone, name)[0], value, err_msg=name)
            np.testing.assert_array_equal(getattr(backwards, name)[36 - i], value, err_msg=name)


def test_a_batch_broadcasts_states_against_surfaces(
    loop: ut.ClosedLoop, starts: FloatArray, surfaces: list[ut.Surface]
) -> None:
    one_state = loop.batch(starts[0], surfaces, duration=1.0)
    assert_same(one_state, loop.batch(np.tile(starts[0], (37, 1)), surfaces, duration=1.0))
    one_surface = loop.batch(starts, [surfaces[0]], duration=1.0)
    assert_same(one_surface, loop.batch(starts, surfaces[0].vector, duration=1.0))
    assert_same(one_surface, loop.batch(starts, [surfaces[0]] * 37, duration=1.0))


@pytest.mark.parametrize("rtol", [0.0, 1e-9])
def test_simulate_and_batch_are_one_rollout(
    loop: ut.ClosedLoop, starts: FloatArray, surfaces: list[ut.Surface], rtol: float
) -> None:
    loop = replace(loop, rtol=rtol)
    for i in range(4):
        run = loop.simulate(starts[i], surfaces[i], duration=6.0)
        batch = loop.batch(starts[i], [surfaces[i]], duration=6.0, precise=True)
        assert run.cost == batch.cost[0]
        assert run.time == batch.time[0]
        assert run.event == batch.event[0]
        np.testing.assert_array_equal(run.x[-1], batch.x[0])
        np.testing.assert_array_equal(run.x[0], starts[i])
        # A margin is looked at where steps end, and rows lie elsewhere.
        assert run.margin[:-1].min() == pytest.approx(batch.singular[0], rel=1e-3 if rtol else 0)


def test_each_rollout_may_have_its_own_reaching_law(
    rig: ut.Mechanism, loop: ut.ClosedLoop, starts: FloatArray, quick: ut.Surface
) -> None:
    reaching = np.array([[[20.0, 0.1]], [[12.0, 0.4]], [[35.0, 0.2]]])
    vectors = np.tile(quick.vector, (3, 1))
    together = loop.batch(starts[:3], vectors, reaching=reaching, duration=3.0)
    for i, (eta, layer) in enumerate(reaching[:, 0]):
        own = ut.ClosedLoop(rig, reaching=ut.ReachingLaw(eta, layer))
        alone = own.batch(starts[i], [quick], duration=3.0)
        assert together.cost[i] == alone.cost[0]
        np.testing.assert_array_equal(together.x[i], alone.x[0])


@pytest.mark.parametrize("zoh_steps", [0, 1])
def test_a_motion_of_no_length_has_two_rows_like_any_other(
    rig: ut.Mechanism, quick: ut.Surface, zoh_steps: int
) -> None:
    """A length below the rounding of a step gave one time to two states: no plot, no table."""
    loop = ut.ClosedLoop(rig, zoh_steps=zoh_steps)
    for length in (0.0, 1e-9):
        run = loop.simulate(rig.state(phi=0.1), quick, duration=length)
        assert len(run.t) == len(run.x) == 2
        assert len(run.columns["phi"][0]) == 2
        run.plot()


def test_a_schedule_equals_its_pieces(
    loop: ut.ClosedLoop, starts: FloatArray, surfaces: list[ut.Surface]
) -> None:
    """Switching inside one rollout and starting anew at each switch give the same bits of x."""
    loop, times = replace(loop, rtol=0.0), (0.0, 0.1, 0.25, 0.3)
    whole = loop.simulate(starts[0], surfaces[:4], switch_times=times, duration=0.5, terminal=0.0)
    x, pieces = starts[0], []
    for surface, begin, end in zip(surfaces[:4], times, (*times[1:], 0.5), strict=True):
        piece = loop.simulate(x, surface, duration=end - begin, start=begin, terminal=0.0)
        x = piece.x[-1]
        pieces.append(piece)
    joined = ut.Trajectory.join(pieces)
    np.testing.assert_array_equal(whole.x, joined.x)
    np.testing.assert_array_equal(whole.s[:-1], joined.s[:-1])
    np.testing.assert_allclose(whole.t, joined.t, atol=1e-12)
    np.testing.assert_allclose(whole.cost, joined.cost, rtol=1e-12)
    assert np.abs(np.diff(whole.s[:, 0])).max() > 0.05  # s jumps: a new reaching phase
    batch = loop.batch(
        starts[0],
        np.stack([s.vector for s in surfaces[:4]])[None],
        switch_times=times,
        duration=0.5,
    )
    np.testing.assert_array_equal(batch.x[0], whole.x[-1])


# -- belief and truth, sampling, noise, time -------------------------------------------------


@pytest.fixture(scope="module")
def wrong_belief(rig: ut.Mechanism) -> ut.Mechanism:
    """A plant that is heavier than believed and pushed about in time."""
    return rig.with_parameters(m=0.15, d_e=0.04).disturbed(
        {"theta": PUSH.symbol * sp.sin(9 * TIME), "phi": 0.1 * PUSH.symbol * sp.cos(5 * TIME)},
        [PUSH],
    )


@pytest.mark.parametrize("truthful", [True, False])
def test_sampled_loops_equal_a_plain_reference(
    rig: ut.Mechanism, wrong_belief: ut.Mechanism, quick: ut.Surface, truthful: bool
) -> None:
    """Law on the believed model and the measured state, held; plant on its own equations."""
    loop = ut.ClosedLoop(rig, plant=None if truthful else wrong_belief, zoh_steps=4, rtol=0.0)
    loop = loop if truthful else interpreted(loop)
    x0, samples = rig.state(phi=0.4, theta=0.1), 10
    noise = np.random.default_rng(6).normal(0, 2e-3, (samples, 4))
    run = loop.simulate(x0, quick, duration=0.08, terminal=0.0, noise=noise, start=0.7)
    law = ut.SlidingModeLaw(rig, quick)

    def sampled(t: float, x: FloatArray) -> FloatArray:
        return law(t, x + noise[round((t - 0.7) / 0.008)]).u

    expected = runge_kutta(loop.truth, sampled, x0, 0.002, 40, hold=4, start=0.7)
    np.testing.assert_allclose(run.x, expected, rtol=1e-9, atol=1e-9)
    held = run.u[:-1, 0].reshape(samples, 4)
    np.testing.assert_array_equal(held, np.repeat(held[:, :1], 4, axis=1))
    quiet, silent = (
        loop.simulate(x0, quick, duration=0.08, terminal=0.0, start=0.7, noise=none)
        for none in (None, np.zeros((samples, 4)))
    )
    np.testing.assert_array_equal(quiet.x, silent.x)
    assert np.abs(quiet.x - run.x).max() > 1e-4


def test_noise_that_runs_out_keeps_its_last_sample(rig: ut.Mechanism, quick: ut.Surface) -> None:
    loop, x0 = ut.ClosedLoop(rig, zoh_steps=4), rig.state(phi=0.3)
    short = np.array([[0.0, 0.0, 0.0, 0.0], [0.0, 0.01, 0.0, 0.1]])
    long = np.vstack([short, np.tile(short[1], (8, 1))])
    one, two = (
        loop.simulate(x0, quick, duration=0.08, terminal=0.0, noise=noise)
        for noise in (short, long)
    )
    np.testing.assert_array_equal(one.x, two.x)


def test_sampled_batches_without_noise_read_none(rig: ut.Mechanism, quick: ut.Surface) -> None:
    """A batch far larger than a block: every lane starts alike and so must end alike."""
    loop = ut.ClosedLoop(rig, zoh_steps=4)
    batch = loop.batch(np.tile(rig.state(phi=0.3), (20_000, 1)), [quick], duration=0.02)
    np.testing.assert_array_equal(batch.x, np.broadcast_to(batch.x[0], batch.x.shape))
    assert set(batch.event) == {ut.Event.HORIZON}


def test_sampling_ever_faster_approaches_the_continuous_law(
    rig: ut.Mechanism, quick: ut.Surface
) -> None:
    """Zero-order hold errs in the first order of its period."""
    x0 = rig.state(phi=0.2)

    def end(step: float, hold: int) -> FloatArray:
        loop = ut.ClosedLoop(rig, step=step, zoh_steps=hold)
        return np.asarray(loop.simulate(x0, quick, duration=0.4, terminal=0.0).x[-1])

    exact = end(2.5e-4, 0)
    periods = np.array([0.004, 0.002, 0.001])
    errors = np.array([np.abs(end(2.5e-4, round(p / 2.5e-4)) - exact).max() for p in periods])
    assert observed_order(periods, errors) == pytest.approx(1.0, abs=0.15)


def test_a_plant_like_the_belief_changes_nothing_but_rounding(
    rig: ut.Mechanism, wrong_belief: ut.Mechanism, quick: ut.Surface
) -> None:
    right = wrong_belief.with_parameters(m=0.125, d_e=0.025, push=0.0)
    x0 = rig.state(phi=0.4)
    one = ut.ClosedLoop(rig, zoh_steps=4, rtol=0.0).simulate(x0, quick, duration=0.08)
    twin = interpreted(ut.ClosedLoop(rig, plant=right, zoh_steps=4))
    two = twin.simulate(x0, quick, duration=0.08)
    np.testing.assert_allclose(one.x, two.x, atol=1e-12)


# -- reaching and the boundary layer ---------------------------------------------------------


def test_a_discontinuous_law_slides_in_continuous_time_and_chatters_where_it_is_held(
    rig: ut.Mechanism, quick: ut.Surface
) -> None:
    """s reaches 0 in ‖s(0)‖/η and stays there, whatever the step; held for h it is off by h η."""
    reaching, x0 = ut.ReachingLaw(eta=20.0, switching="sign"), rig.state(phi=0.05)
    reached = float(np.abs(quick.s(x0)[0])) / 20.0
    ends = {}
    for step, hold in ((0.002, 0), (0.001, 0), (0.002, 1)):
        loop = interpreted(ut.ClosedLoop(rig, reaching=reaching, step=step, zoh_steps=hold))
        run = loop.simulate(x0, quick, duration=reached + 0.06, terminal=0.0)
        assert np.abs(run.u).max() < 15.0  # within limits, where (16) holds
        late = np.abs(run.s[(run.t > reached + 0.04) & (run.t < run.t[-1]), 0])
        assert (late < 1e-5).all() if hold == 0 else late.max() > 0.3 * step * 20.0
        ends[step, hold] = run.x[-1]
    off = np.linalg.norm(ends[0.002, 0] - ends[0.001, 0])
    assert off < 1e-3 * np.linalg.norm(ends[0.001, 0])


@pytest.mark.slow  # a kernel of its own; in test_sliding.py NumPy proves the same for any n, m
def test_sign_switching_reaches_the_surface_within_16_under_disturbance(
    rig: ut.Mechanism, quick: ut.Surface
) -> None:
    """‖s‖ falls to the chatter of the step by ‖s(0)‖₂ / min η, pushed by the declared bounds."""
    believed = rig.with_disturbance_bounds(0.05, 0.005).with_input_limit(1e4)
    plant = rig.with_input_limit(1e4).disturbed(
        {"theta": PUSH.symbol * sp.sin(9 * TIME), "phi": 0.1 * PUSH.symbol * sp.cos(5 * TIME)},
        [PUSH],
    )
    eta, step = 20.0, 5e-5
    reaching = ut.ReachingLaw(eta=eta, switching="sign")
    loop = ut.ClosedLoop(believed, reaching=reaching, plant=plant, step=step)
    for x0 in (
        rig.state(phi=0.3, phi_dot=1.0),
        rig.state(phi=-0.2, theta_dot=3.0),
        rig.state(theta=1.0, phi=0.1),
    ):
        bound = float(np.linalg.norm(quick.s(x0))) / eta
        run = loop.simulate(x0, quick, duration=bound + 0.05, terminal=0.0)
        assert np.abs(run.u).max() < 1e4
        gains = ut.SlidingModeLaw(believed, quick, reaching)(0.0, run.x).gains
        chatter = 2 * step * gains.max()
        s = np.abs(run.s[:-1, 0])
        assert s[0] > 50 * chatter
        assert s[run.t[:-1] >= bound].max() <= chatter
        # Before that it never falls more slowly than η, (16).
        reached = int(np.argmax(s <= chatter))
        assert (np.diff(s[:reached]) <= -eta * step * (1 - 1e-3)).all()


def test_inside_the_layer_a_matched_disturbance_leaves_s_below_its_bound(
    rig: ut.Mechanism, quick: ut.Surface
) -> None:
    """|s| ≤ ε (K − η) / K: the layer's answer to the most that the gains are sized for."""
    believed = rig.with_disturbance_bounds(PUSH.value, 0.0)
    plant = rig.disturbed({"theta": PUSH.symbol}, [PUSH])
    law = ut.SlidingModeLaw(believed, quick)
    step, x0 = 1e-3, rig.state(phi=0.1)
    x = runge_kutta(plant, lambda t, x: law(t, x).demand, x0, step, 600)
    gains = law(0.0, x).gains[:, 0]
    limit = 0.1 * ((gains - 20.0) / gains).max()
    s = np.abs(quick.s(x)[:, 0])
    inside = int(np.argmax(s < 0.1))
    settled = s[inside + round(0.1 / step) :]
    assert s[0] > 0.1
    assert settled.max() <= limit
    assert settled.max() > 0.2 * limit  # constant at its bound, it uses up a good part
    assert limit < 0.1


# -- events ----------------------------------------------------------------------------------


def test_a_motion_ends_where_the_terminal_set_is_reached(
    loop: ut.ClosedLoop, rig: ut.Mechanism, quick: ut.Surface
) -> None:
    """(31): ‖x‖₂ ≤ ν for the first time."""
    run = loop.simulate(rig.state(phi=0.5), quick)
    radius = np.linalg.norm(run.x, axis=1)
    assert run.event == ut.Event.REACHED
    assert radius[-1] <= 0.01 < radius[:-1].min()
    assert run.t[-2] < run.time <= run.t[-2] + loop.step


def test_a_motion_that_starts_in_the_terminal_set_costs_nothing(
    loop: ut.ClosedLoop, rig: ut.Mechanism, quick: ut.Surface
) -> None:
    run = loop.simulate(rig.state(phi=0.009), quick)
    assert run.event == ut.Event.REACHED
    assert run.time == 0.0
    assert run.cost == 0.0
    np.testing.assert_array_equal(run.x[-1], rig.state(phi=0.009))


def test_a_motion_without_end_stops_at_the_horizon(
    loop: ut.ClosedLoop, rig: ut.Mechanism, quick: ut.Surface
) -> None:
    run = loop.simulate(rig.state(phi=0.5), quick, duration=0.5)
    assert run.event == ut.Event.HORIZON
    assert run.time == pytest.approx(0.5, abs=1e-12)
    assert len(run.t) == 251


def test_crossing_the_singular_angle_is_an_event_and_never_a_nan(
    loop: ut.ClosedLoop, rig: ut.Mechanism, base: ut.Surface
) -> None:
    """(37): outward through 78° the law ceases to exist, and the rollout says so."""
    run = loop.simulate(rig.state(phi=math.radians(70), phi_dot=6.0), base, duration=2.0)
    assert run.event == ut.Event.SINGULAR
    assert 0 < run.time < 0.5
    assert np.isfinite(run.x).all()
    assert (run.margin[:-1] > 0).all()
    M = rig.M([0, 0])
    edge = math.acos(-M[1, 1] / (M[0, 1] * 5.0))
    assert run["phi"][-2] < edge <= run["phi"][-1] + 1e-12
    beyond = loop.batch(rig.state(phi=math.radians(80)), [base])
    assert beyond.event[0] == ut.Event.SINGULAR
    assert beyond.time[0] == 0.0
    assert beyond.singular[0] < 0


def test_a_fall_is_an_event(rig: ut.Mechanism) -> None:
    """Beyond the escape radius a motion counts as diverged."""
    loop = ut.ClosedLoop(rig, escape=5.0)
    run = loop.simulate(rig.state(phi=0.5), ut.Surface(-1, -1, 0, 1), duration=20.0)
    radius = np.linalg.norm(run.x, axis=1)
    assert run.event == ut.Event.DIVERGED
    assert radius[:-1].max() < 5.0 <= radius[-1]


def test_overflow_counts_as_diverged(rig: ut.Mechanism, quick: ut.Surface) -> None:
    loop = ut.ClosedLoop(rig)
    batch = loop.batch(rig.state(theta_dot=1e200, phi=0.1), [quick], duration=1.0)
    assert batch.event[0] == ut.Event.DIVERGED
    assert batch.time[0] <= loop.step * (1 + 1e-12)


@pytest.fixture(scope="module")
def watched(rig: ut.Mechanism) -> ut.Objective:
    """Hard input limit, a state box, a mixed constraint, and a cost of several terms."""
    return ut.Objective(
        "watched",
        lambda v: v.voltage**2 + 3 * sp.Abs(v.phi) + v.theta_dot**2 * v.d_e,
        horizon=8.0,
        constraints=(
            *ut.state_box(theta=math.radians(60)),
            ut.Constraint("power", lambda v: v.voltage * v.theta_dot - 40),
        ),
        hard_input=True,
    )


def test_a_motion_ends_with_what_the_law_does_there(rig: ut.Mechanism) -> None:
    """The last row is of the last state: input, surface value and margin, also after a switch."""
    first, second = ut.Surface(-1, -1.59, 1.96, 12.1), ut.Surface(-1, -0.7, 1.5, 9.0)
    loop = ut.ClosedLoop(rig, ut.MinimumEnergy())
    run = loop.simulate(
        rig.state(phi=0.5), (first, second), switch_times=(0.0, 0.1), duration=0.1503
    )
    end = ut.SlidingModeLaw(rig, second, loop.reaching)(run.t[-1], run.x[-1])
    assert run.t[-1] == pytest.approx(0.15, abs=2e-3)
    np.testing.assert_allclose(run.u[-1], end.u, rtol=1e-9)
    np.testing.assert_allclose(run.s[-1], end.s, rtol=1e-9, atol=1e-12)
    assert run.margin[-1] == pytest.approx(float(end.margin), rel=1e-9)


def test_constraints_end_a_motion_and_margins_are_the_smallest_met(
    rig: ut.Mechanism, watched: ut.Objective, quick: ut.Surface
) -> None:
    """(25) and (38): signed margins along the way, and the first break ends the rollout."""
    loop = ut.ClosedLoop(rig, watched, rtol=0.0)
    law = ut.SlidingModeLaw(rig, quick)

    def margins(run: ut.Trajectory) -> FloatArray:
        x, u = run.x[:-1], run.u[:-1, 0]
        return np.array(
            [
                (15.0 - np.abs(law(0.0, x).demand[:, 0])).min(),
                (math.radians(60) - np.abs(x[:, 0])).min(),
                (40 - u * x[:, 2]).min(),
            ]
        )

    calm = rig.state(phi=0.15)
    run, batch = loop.simulate(calm, quick), loop.batch(calm, [quick])
    assert (run.event, run.broken) == (ut.Event.REACHED, "")
    found = np.array([batch.input[0], *batch.path[0]])
    np.testing.assert_allclose(found, margins(run), rtol=1e-9)
    assert (found > 0).all()

    # Too far out, the law asks for more than 15 V; from an arm turned away, for too much arm.
    turned = rig.state(theta=1.0, theta_dot=2.0)
    for x0, which, word in ((rig.state(phi=0.8), 0, "input"), (turned, 1, "theta")):
        batch = loop.batch(x0, [quick])
        assert batch.event[0] == ut.Event.CONSTRAINT
        found = np.array([batch.input[0], *batch.path[0]])
        assert found[which] < 0
        assert batch.time[0] < 0.5
        run = loop.simulate(x0, quick)
        assert run.event == ut.Event.CONSTRAINT
        assert word in run.broken


def test_a_hard_input_limit_is_tight(
    rig: ut.Mechanism, watched: ut.Objective, quick: ut.Surface
) -> None:
    """Admissible with the limit just above the largest demand, not with it just below."""
    x0 = rig.state(phi=0.15)
    peak = 15.0 - float(ut.ClosedLoop(rig, watched).batch(x0, [quick]).input[0])
    for limit, event in ((1.0001, ut.Event.REACHED), (0.9999, ut.Event.CONSTRAINT)):
        loop = ut.ClosedLoop(rig.with_input_limit(limit * peak), watched)
        assert loop.batch(x0, [quick]).event[0] == event


# -- costs -----------------------------------------------------------------------------------


def test_running_costs_are_quadratures_of_the_recorded_motion(
    rig: ut.Mechanism, loop: ut.ClosedLoop, watched: ut.Objective, quick: ut.Surface
) -> None:
    """∫Φ dt by the kernel and by Simpson's rule on its record."""
    x0 = rig.state(phi=0.15)
    for objective in (loop.objective, watched):
        run = ut.ClosedLoop(rig, objective, step=2e-4).simulate(x0, quick, duration=1.5)
        stage = sp.lambdify(
            [*rig.x, *rig.u], objective.stage_cost(rig).subs(rig.substitution), "numpy"
        )
        x, u = run.x[:-1], run.u[:-1]
        expected = simpson(stage(*x.T, *u.T), x=run.t[:-1])
        assert run.accumulated_cost[-2] == pytest.approx(expected, rel=1e-5)
        assert (np.diff(run.accumulated_cost) >= 0).all()


def test_time_and_cost_at_the_end_do_not_jump_with_the_step(
    rig: ut.Mechanism, quick: ut.Surface
) -> None:
    """The end is interpolated inside the last step: t_f errs as step², not as step."""

    def end(step: float) -> tuple[float, float]:
        batch = ut.ClosedLoop(rig, step=step).batch(rig.state(phi=0.3), [quick])
        assert batch.event[0] == ut.Event.REACHED
        return float(batch.time[0]), float(batch.cost[0])

    time, cost = end(2e-5)
    steps = np.array([0.004, 0.003, 0.002, 0.0015, 0.001, 0.0005])
    ends = np.array([end(h) for h in steps])
    late = np.abs(ends[:, 0] - time)
    assert (late <= 0.01 * steps).all()
    assert (late <= 3 * steps**2).all()
    np.testing.assert_allclose(ends[:, 1], cost, rtol=2e-5)


def test_scores_rank_admissible_then_slow_then_broken(
    loop: ut.ClosedLoop, rig: ut.Mechanism, quick: ut.Surface, base: ut.Surface
) -> None:
    """Penalties fall with survival and with the final distance; any admissible cost is lower."""
    x0 = np.array([rig.state(phi=0.3), rig.state(phi=1.2, phi_dot=1.0), rig.state(phi=1.36)])
    x0 = np.vstack([x0, rig.state(phi=1.5)])
    batch = loop.batch(x0, [quick, base, base, base], duration=10.0)
    scores = batch.score(10.0)
    assert batch.event.tolist()[:1] == [ut.Event.REACHED]
    assert scores[0] == batch.cost[0] < INADMISSIBLE
    broken = batch.event == ut.Event.SINGULAR
    assert broken.sum() >= 2
    assert (scores[broken] >= 2 * PENALTY).all()
    order = np.argsort(batch.time[broken])
    assert (np.diff(scores[broken][order]) <= 0).all()
    slow = loop.batch(np.array([rig.state(phi=0.1), rig.state(phi=0.6)]), [quick], duration=0.4)
    assert slow.event.tolist() == [ut.Event.HORIZON] * 2
    assert PENALTY < slow.score(0.4).min() < slow.score(0.4).max() <= 2 * PENALTY
    assert slow.score(0.4).argmax() == slow.radius.argmax()


def test_scores_grade_every_end() -> None:
    """Costs as they are; late 1 to 2 penalties by distance; broken 2 to 3 by time, unstable."""
    late, broken = Event.HORIZON, [Event.CONSTRAINT, Event.SINGULAR, Event.DIVERGED, Event.COSTLY]
    events = [Event.REACHED, *[late] * 5, *broken * 3, Event.UNSTABLE]
    count = len(events)
    radius = np.array([0.01, 0.0, 0.5, 3.0, np.inf, np.nan, *[1.0] * 13])
    times = np.array([1.5, *[8.0] * 5, *[0.0] * 4, *[2.0] * 4, *[8.0] * 4, 0.0])
    nothing = np.zeros(count)
    batch = Batch(
        np.full(count, 7.5), times, np.array(events), radius, nothing, nothing,
        nothing[:, None], nothing, nothing, nothing[:, None], nothing[:, None], nothing,
    )  # fmt: skip
    scores = batch.score(8.0)
    parts = scores / PENALTY
    assert scores[0] == 7.5
    np.testing.assert_allclose(parts[1:6] - 1, [0, *np.tanh([0.5, 3]), 1, 1])
    np.testing.assert_allclose(parts[6:10], 3)
    np.testing.assert_allclose(parts[10:14], 2.75)
    np.testing.assert_allclose(parts[14:18], 2)
    assert scores[18] == UNSTABLE > 3 * PENALTY
    assert (batch.reached == (scores < INADMISSIBLE)).all()
    assert (scores[~batch.reached] > INADMISSIBLE).all()


def test_a_rollout_is_given_up_where_it_costs_too_much(
    loop: ut.ClosedLoop, rig: ut.Mechanism, quick: ut.Surface
) -> None:
    """With a cap just above its cost it arrives; with one just below it is given up at the end."""
    x0 = rig.state(phi=0.4)
    whole = loop.batch(x0, quick)
    cost, time = float(whole.cost[0]), float(whole.time[0])
    assert loop.batch(x0, quick, cap=cost * (1 + 1e-9)).event[0] == Event.REACHED
    given_up = loop.batch(x0, quick, cap=0.5 * cost)
    run = loop.simulate(x0, quick)
    assert given_up.event[0] == Event.COSTLY
    first = int(np.argmax(run.accumulated_cost > 0.5 * cost))
    assert given_up.time[0] == pytest.approx(run.t[first])
    assert given_up.time[0] < time
    assert not given_up.reached[0]


# -- trajectories and refusals ---------------------------------------------------------------


def test_recording_less_often_keeps_the_ends(
    loop: ut.ClosedLoop, rig: ut.Mechanism, quick: ut.Surface
) -> None:
    x0 = rig.state(phi=0.4)
    fine, coarse = (loop.simulate(x0, quick, every=every) for every in (1, 7))
    np.testing.assert_array_equal(coarse.x[:-1], fine.x[:-1][::7])
    np.testing.assert_array_equal(coarse.t[:-1], fine.t[:-1][::7])
    np.testing.assert_array_equal(coarse.x[-1], fine.x[-1])
    assert (coarse.cost, coarse.time, coarse.event) == (fine.cost, fine.time, fine.event)
    np.testing.assert_array_equal(fine["phi"], fine.x[:, 1])


@pytest.mark.parametrize("every", [1, 3])
def test_the_last_input_of_a_sampled_loop_is_the_one_held(
    rig: ut.Mechanism, quick: ut.Surface, every: int
) -> None:
    """The last row is of the last state with the input, s and margin of the sample before."""
    loop, x0 = ut.ClosedLoop(rig, zoh_steps=4), rig.state(phi=0.3)
    run = loop.simulate(x0, quick, duration=0.05, terminal=0.0, every=every, start=2.0)
    batch = loop.batch(x0, quick, duration=0.05, terminal=0.0, precise=True)
    np.testing.assert_array_equal(run.x[-1], batch.x[0])
    assert run.cost == batch.cost[0]
    for column in (run.u, run.s, run.margin):
        np.testing.assert_array_equal(column[-1], column[-2])
    np.testing.assert_allclose(run.t[:-1], 2.0 + 0.002 * every * np.arange(len(run.t) - 1))
    assert run.time == pytest.approx(2.05, abs=1e-12)
    assert len(run.t) == -(-25 // every) + 1


@pytest.mark.parametrize("hold", [0, 4])
@pytest.mark.parametrize("duration", [None, 0.0, 0.0015])
def test_the_shortest_motions_have_a_beginning_and_an_end(
    rig: ut.Mechanism, quick: ut.Surface, hold: int, duration: float | None
) -> None:
    """In the terminal set at once, of no length, of one step: no cost but that of a step."""
    loop = ut.ClosedLoop(rig, zoh_steps=hold)
    x0 = rig.state(phi=0.009 if duration is None else 0.3)
    run = loop.simulate(x0, quick, duration=duration)
    assert run.event == (Event.REACHED if duration is None else Event.HORIZON)
    np.testing.assert_array_equal(run.x[0], x0)
    assert (run.t[0], run.accumulated_cost[0]) == (0.0, 0.0)
    assert run.time == (duration or 0.0)
    assert (run.cost > 0.0) == bool(duration)
    for row in run.x[1:] if not duration else ():
        np.testing.assert_array_equal(row, x0)
    law = ut.SlidingModeLaw(rig, quick)(0.0, x0)
    if hold == 0 or duration:
        assert run.u[0] == pytest.approx(law.u, rel=1e-9)


def test_pieces_of_a_motion_are_joined_at_their_ends(
    loop: ut.ClosedLoop, rig: ut.Mechanism, quick: ut.Surface
) -> None:
    """Each instant once, in order, costs added up, and the end of the last."""
    x0 = rig.state(phi=0.4)
    whole = loop.simulate(x0, quick, duration=0.3, terminal=0.0)
    pieces, x = [], x0
    for k in range(3):
        pieces.append(loop.simulate(x, quick, duration=0.1, terminal=0.0, start=0.1 * k))
        x = pieces[-1].x[-1]
    joined = ut.Trajectory.join(pieces)
    np.testing.assert_allclose(joined.t, whole.t, atol=1e-12)
    np.testing.assert_allclose(joined.x, whole.x, atol=1e-7)  # steps begin anew with each piece
    np.testing.assert_allclose(joined.accumulated_cost, whole.accumulated_cost, rtol=1e-7)
    assert (joined.event, joined.cost_unit) == (pieces[-1].event, whole.cost_unit)
    assert ut.Trajectory.join(pieces[:1]).time == pieces[0].time
    with pytest.raises(InvalidInputError, match="number of pieces"):
        ut.Trajectory.join([])


def test_a_notebook_shows_the_first_and_the_last_rows(
    loop: ut.ClosedLoop, rig: ut.Mechanism, quick: ut.Surface
) -> None:
    """All rows of a short motion; three at either end of a long one with an ellipsis between."""
    for steps in (5, 6, 50):
        run = loop.simulate(rig.state(phi=0.4), quick, duration=0.002 * steps, terminal=0.0)
        html = run._repr_html_()
        rows = re.findall(r"<tr>(<td>.*?)</tr>", html)
        cells = [re.findall(r"<td>(.*?)</td>", row) for row in rows]
        indices = range(len(run.t)) if steps == 5 else (0, 1, 2, -1, -3, -2, -1)
        assert len(rows) == len(indices)
        for place, (index, row) in enumerate(zip(indices, cells, strict=True)):
            if steps > 5 and place == 3:
                assert set(row) == {"…"}
            else:
                shown = [run.t[index], *run.x[index], *run.u[index], *run.s[index]]
                shown += [run.accumulated_cost[index], run.margin[index]]
                assert row == [f"{value:.4g}" for value in shown]
        assert "<th>phi<br>rad</th>" in html
        assert "<th>phi_dot<br>rad/s</th>" in html
        assert "<th>s_0</th>" in html


def test_columns_of_equal_names_are_told_apart() -> None:
    """A mechanism may call a coordinate ``cost`` and its input ``margin``: nothing is hidden."""
    mechanism = random_mechanism(2, 1)
    rng, names = np.random.default_rng(0), ("s_0", "cost")
    named = ut.Mechanism(
        "names",
        tuple(ut.Coordinate(name, "m") for name in names),
        (ut.Input("margin", "N"),),
        sp.ImmutableDenseMatrix(mechanism.M([0, 0])),
        sp.ImmutableDenseMatrix([0, 0]),
    )
    x, (u, s, cost, margin) = rng.random((3, 4)), rng.random((4, 3))
    run = ut.Trajectory(
        named, np.arange(3.0), x, u[:, None], s[:, None], cost, margin, Event.HORIZON, "J"
    )
    columns = run.columns
    expected = [*x.T, u, s, cost, margin]
    assert list(columns) == [
        "s_0", "cost", "s_0_dot", "cost_dot", "margin", "s_0_", "cost_", "margin_"
    ]  # fmt: skip
    assert [unit for _, unit in columns.values()] == ["m", "m", "m/s", "m/s", "N", "", "J", ""]
    for (values, _), wanted in zip(columns.values(), expected, strict=True):
        np.testing.assert_array_equal(values, wanted)
    np.testing.assert_array_equal(run["cost_dot"], x[:, 3])


def test_gains_that_the_step_cannot_follow_are_refused_or_switched_off(
    rig: ut.Mechanism, quick: ut.Surface, base: ut.Surface
) -> None:
    """(13) at the target: k/ε times the period of the law below 2, of the worst of all surfaces."""
    believed = rig.with_disturbance_bounds(2.0, 0.01)
    law = ut.SlidingModeLaw(believed, base)
    each = [ut.SlidingModeLaw(believed, s)(0.0, np.zeros(4)).gains[0] for s in (quick, base)]
    rate = max(each) / 0.1
    assert rate > float(law.reaching.vector(1)[0]) / 0.1
    x0, plan = rig.state(phi=0.1), Plan((quick, base), (0.0, 1.0))
    for hold in (0, 3):
        period = 2 / rate
        step = period / max(1, hold)
        slow = ut.ClosedLoop(believed, step=1.0001 * step, zoh_steps=hold)
        with pytest.raises(InvalidInputError, match=r"gains \(13\)"):
            slow.batch(x0, [plan], duration=10 * slow.step)
        good = interpreted(ut.ClosedLoop(believed, step=0.9999 * step, zoh_steps=hold))
        assert good.batch(x0, [quick], duration=good.step).event[0] == Event.HORIZON
        found = interpreted(slow).batch(x0, [quick, base], duration=slow.step, stable_only=True)
        worst = int(np.argmax(each))
        assert found.event[worst] == Event.UNSTABLE
        assert found.event[1 - worst] == Event.HORIZON
        buffers = RolloutBuffers(slow, 2, 1).fill(x0, np.array([[quick.vector], [base.vector]]))
        searched = interpreted(slow).roll_out(buffers, (0.0,), slow.step)
        assert searched.event.tolist() == found.event.tolist()  # a search goes on with the others
    sign = ut.ClosedLoop(believed, step=1.0, reaching=ut.ReachingLaw(switching="sign"))
    assert not sign._fastest(np.empty((1, 1, 7))).any()  # no layer, no limit


def test_a_step_may_be_as_long_as_the_layer_bears(rig: ut.Mechanism) -> None:
    """Below 2 ε/η of the worst input; a law without a layer has no such limit."""
    assert ut.ClosedLoop(rig, step=0.0099).step == 0.0099
    assert ut.ClosedLoop(rig, step=0.0049, zoh_steps=2).zoh_steps == 2
    assert ut.ClosedLoop(rig, step=0.5, reaching=ut.ReachingLaw(switching="sign")).step == 0.5
    two = random_mechanism(4, 2)
    uneven = ut.ReachingLaw((1.0, 10.0), (0.5, 0.1))  # 1 s and 0.02 s
    assert ut.ClosedLoop(two, reaching=uneven, step=0.019).step == 0.019
    with pytest.raises(InvalidInputError, match="rollout step"):
        ut.ClosedLoop(two, reaching=uneven, step=0.021)


def test_the_laws_of_a_plan_are_held_to_the_sample_period(
    rig: ut.Mechanism, quick: ut.Surface
) -> None:
    """They were simulated whatever they were: η/ε = 2000 1/s and an input once in 2 ms."""
    loop = ut.ClosedLoop(rig, zoh_steps=1)
    fast = ut.Plan((quick,), reaching=(ut.ReachingLaw(eta=200.0, layer=0.1),))
    with pytest.raises(InvalidInputError, match=r"sample period.*0\.002 s.*2 ε/η = 0\.001 s"):
        loop.simulate(rig.state(phi=0.3), fast)


def test_the_usual_values_are_the_documented_ones(
    loop: ut.ClosedLoop, rig: ut.Mechanism, quick: ut.Surface
) -> None:
    """Without them a batch is one at time 0, to the objective's horizon and terminal set."""
    x0 = rig.state(phi=0.3)
    spelt = ut.ClosedLoop(
        rig, step=0.002, zoh_steps=0, escape=200.0, tail_rtol=0.0, reaching=ut.ReachingLaw()
    )
    goal = spelt.objective
    assert_same(
        loop.batch(x0, quick),
        spelt.batch(
            x0, quick.vector, reaching=np.array([20.0, 0.1]), switch_times=(0.0,),
            duration=goal.horizon, terminal=goal.terminal_radius, cap=math.inf, stable_only=False,
            seek=False,
        ),
    )  # fmt: skip
    for radius, event in ((199.0, Event.HORIZON), (201.0, Event.DIVERGED)):
        far = loop.batch(rig.state(theta=radius), ut.Surface(-1, -1e-9, 0, 1), duration=0.002)
        assert far.event[0] == event


def test_a_motion_goes_on_where_learnt_parameters_raise_the_gains_beyond_the_step(
    rig: ut.Mechanism, quick: ut.Surface
) -> None:
    """What was looked at with the parameters that were given is not refused in its midst."""
    believed, x0 = rig.with_disturbance_bounds(2.0, 0.01), rig.state(phi=0.1)
    gains = ut.SlidingModeLaw(believed, quick)(0.0, np.zeros(4)).gains[0]
    loop = ut.ClosedLoop(believed, step=0.999 * 2 * 0.1 / gains)
    learnt = loop.believing(believed.with_parameters(m=0.1))
    assert learnt._fastest(RolloutBuffers(learnt, 1, 1).fill(x0, quick.vector).lanes)[0] > 2
    kernel = learnt._kernels.rollout.py_func  # what no plan is chosen by is not worth compiling
    vars(learnt)["_kernels"] = SimpleNamespace(rollout=kernel)
    assert learnt.batch(x0, quick).event[0] == Event.UNSTABLE  # no plan to be chosen
    motion = learnt.simulate(x0, quick, duration=5 * loop.step)
    assert motion.event == Event.HORIZON
    assert np.isfinite(motion.x).all()


def refusals(rig: ut.Mechanism, s: ut.Surface) -> dict[str, tuple[Callable[[], object], str]]:
    loop = ut.ClosedLoop(rig)
    sampled = ut.ClosedLoop(rig, zoh_steps=4)
    x0 = rig.state(phi=0.1)
    return {
        "step": (lambda: ut.ClosedLoop(rig, step=0.01), r"0\.01 s.*2 ε/η = 0\.01"),
        "period": (lambda: ut.ClosedLoop(rig, step=0.002, zoh_steps=5), r"sample period.*0\.01 s"),
        "NaN step": (lambda: ut.ClosedLoop(rig, step=math.nan), "nan.*finite"),
        "negative hold": (lambda: ut.ClosedLoop(rig, zoh_steps=-1), "zoh_steps.*-1"),
        "plant": (
            lambda: ut.ClosedLoop(rig, plant=random_mechanism(3, 1)),
            r"theta \(rad\), phi \(rad\), voltage \(V\), in this order",
        ),
        "NaN state": (lambda: loop.simulate([0.0, math.nan, 0.0, 0.0], s), "phi.*nan"),
        "surface": (lambda: loop.simulate(x0, random_surface(3, 1)), "n = 3, m = 1"),
        "vector": (lambda: loop.batch(x0, np.ones(5)), r"\(1, 1, 5\)"),
        "no surface": (lambda: loop.batch(x0, np.ones((0, 4))), "at least one"),
        "late start": (lambda: loop.simulate(x0, s, switch_times=(0.1,)), r"times.*\[0\.1\]"),
        "falling times": (
            lambda: loop.simulate(x0, [s, s, s], switch_times=(0.0, 0.2, 0.1)),
            r"\[0\.0, 0\.2, 0\.1\]",
        ),
        "times in one step": (
            lambda: loop.batch(x0, np.ones((1, 2, 4)), switch_times=(0.0, 0.0005)),
            r"0\.0005.*0\.002",
        ),
        "too few surfaces": (
            lambda: loop.simulate(x0, [s], switch_times=(0.0, 0.2)),
            r"\[0\.0, 0\.2\]",
        ),
        "noise on a continuous loop": (
            lambda: loop.simulate(x0, s, noise=np.zeros((3, 4))),
            "continuous.*sampled",
        ),
        "noise of another width": (
            lambda: sampled.simulate(x0, s, noise=np.zeros((3, 3))),
            r"\(3, 3\).*\(samples, 4\)",
        ),
        "no noise at all": (lambda: sampled.simulate(x0, s, noise=np.zeros((0, 4))), r"\(0, 4\)"),
        "NaN noise": (lambda: sampled.simulate(x0, s, noise=np.full((3, 4), math.nan)), "nan"),
        "noise of one sample": (lambda: sampled.simulate(x0, s, noise=np.zeros(4)), r"\(4,\)"),
        "negative escape": (lambda: ut.ClosedLoop(rig, escape=-1.0), "escape.*-1"),
        "negative tolerance": (lambda: ut.ClosedLoop(rig, tail_rtol=-1e-3), "tail_rtol"),
        "no step": (lambda: ut.ClosedLoop(rig, step=0.0), "rollout step"),
        "no objective": (
            lambda: ut.ClosedLoop(rig, 3.0),  # type: ignore[arg-type]
            "objective of ClosedLoop.*3",
        ),
        "vectors that are NaN": (lambda: loop.batch(x0, [-1, math.nan, 2, 3]), "NaN"),
        "η of zero": (lambda: loop.batch(x0, s.vector, reaching=np.array([0.0, 0.1])), "gains.*0"),
        "a negative terminal set": (lambda: loop.batch(x0, s, terminal=-0.1), "terminal.*-0.1"),
        "a negative cap": (lambda: loop.batch(x0, s, cap=-1.0), "cap.*-1"),
        "a negative duration": (lambda: loop.batch(x0, s, duration=-1.0), "duration.*-1"),
        "a duration of NaN": (lambda: loop.simulate(x0, s, duration=math.nan), "duration.*nan"),
        "less than a step": (lambda: loop.batch(x0, s, duration=0.0009), r"0\.0009.*0\.002 s"),
        "too many steps": (lambda: loop.batch(x0, s, duration=3e4), "30000 s.*20000 s"),
        "states and surfaces": (
            lambda: loop.batch(np.tile(x0, (2, 1)), [s, s, s]),
            r"2.* states and 3 surfaces",
        ),
        "states of states": (lambda: loop.batch(np.tile(x0, (2, 2, 1)), s), r"\(2, 2\) states"),
        "plans and laws": (
            lambda: loop.batch(x0, s, reaching=np.array([20.0, 0.1])),
            "plans alone",
        ),
        "plans and times": (lambda: loop.batch(x0, s, switch_times=(0.0, 0.1)), "plans alone"),
        "nothing recorded": (lambda: loop.simulate(x0, s, every=0), "every.*0"),
        "a late first switch": (
            lambda: loop.batch(x0, np.ones((1, 1, 4)), switch_times=(0.1,)),
            r"switch_times.*\[0\.1\]",
        ),
        "name of a series": (
            lambda: interpreted(loop).simulate(x0, s, duration=0.004)["psi"],
            "'psi'.*theta, phi",
        ),
    }


def test_bad_input_is_refused_with_value_and_limit(rig: ut.Mechanism, quick: ut.Surface) -> None:
    for what, (attempt, message) in refusals(rig, quick).items():
        with pytest.raises(InvalidInputError) as caught:
            attempt()
        assert re.search(message, str(caught.value)), (what, str(caught.value))
        assert caught.value.value is not None, what
        assert caught.value.limit is not None, what


@pytest.mark.parametrize("rtol", [0.0, 1e-9])
def test_a_controller_asks_for_no_more_than_it_believes_the_motor_can_give(
    rig: ut.Mechanism, quick: ut.Surface, rtol: float
) -> None:
    """The law clips at the belief's limit, the plant's motor at its own: what the belief allows."""
    x, weak, goal = rig.state(phi=0.3), rig.with_input_limit(3.0), ut.MinimumEnergy(horizon=10.0)
    alone = ut.ClosedLoop(weak, goal, rtol=rtol).simulate(x, quick)
    strong = ut.ClosedLoop(weak, goal, plant=rig, rtol=rtol).simulate(x, quick)
    assert abs(alone.u).max() == abs(strong.u).max() == 3.0
    np.testing.assert_allclose(strong.x, alone.x, rtol=0, atol=1e-8)
    deceived = ut.ClosedLoop(rig, goal, plant=weak, rtol=rtol).simulate(x, quick)
    np.testing.assert_allclose(deceived.x, alone.x, rtol=0, atol=1e-8)
    batch = ut.ClosedLoop(weak, goal, plant=rig, rtol=rtol).batch(x, quick)
    assert batch.time[0] == pytest.approx(alone.time, rel=1e-4)


@pytest.mark.slow  # a kernel of its own
def test_along_a_reference_a_controller_keeps_to_its_belief_s_limit(
    rig: ut.Mechanism, quick: ut.Surface
) -> None:
    ((_, motion),) = ut.Reference.sine(0.5, theta=0.8).legs(rig, 2.0)
    loop = ut.ClosedLoop(rig.with_input_limit(1.5), plant=rig)
    moved = simulate_along(loop, rig.state(phi=0.2), Plan.of(quick), motion, duration=1.0)
    assert abs(moved.u).max() == 1.5


@pytest.mark.parametrize("other", ["cart_pendulum", "acrobot", "ball_and_beam"])
def test_a_plant_that_is_another_mechanism_is_refused(rig: ut.Mechanism, other: str) -> None:
    """Two coordinates and one input, too: a law for the one does nothing sensible to the other."""
    plant = getattr(ut.mechanisms, other)()
    there = IdealRig(rig)
    there.mechanism = plant  # as a rig of that mechanism says it, and nothing is compiled for it
    for made in (
        lambda: ut.ClosedLoop(rig, plant=plant),
        lambda: ut.compare(rig, [ut.lqr(rig)], plants=[plant], phi=0.1),
        lambda: ut.run(ut.Cascade(rig), there, phi=0.1, simulated=True),
    ):
        with pytest.raises(InvalidInputError, match=r"must be theta .rad., phi .rad., voltage"):
            made()


@pytest.mark.slow
def test_a_motion_that_begins_outside_of_a_constraint_may_come_back_once() -> None:
    """It pays ∫ Φ(0, u_max) w/|w(0)| dt until it is inside; after that the constraint counts.

    Against the motions of the same loop without constraints, and the trapezoidal rule.
    """
    cart = ut.mechanisms.cart_pendulum()
    edge = 0.3
    objective = ut.MinimumEnergy(constraints=ut.state_box(x=edge))
    strict = ut.ClosedLoop(cart, objective, tail_rtol=1e-3)
    returning = replace(strict, returning=True)
    free = ut.ClosedLoop(cart, ut.MinimumEnergy(travel=False))
    rng = np.random.default_rng(1)
    base = ut.first_surface(cart).vector
    surfaces = base * (1 + 0.3 * rng.standard_normal((48, base.size)))
    x = cart.state(x=edge + 0.02, phi=0.05, x_dot=0.2)
    seen = set()
    motions = [free.simulate(x, ut.Surface(*vector)) for vector in surfaces]
    for precise in (False, True):
        assert (strict.batch(x, surfaces, precise=precise).time == 0).all()
        batch = returning.batch(x, surfaces, precise=precise)
        for k, motion in enumerate(motions):
            excess = np.maximum(np.abs(motion["x"]) - edge, 0.0)
            inside = np.flatnonzero(excess == 0)
            back = inside[0] if len(inside) else len(excess)
            again = (excess[back:] > 1e-6).any()
            if motion.event == Event.REACHED and not again:
                assert batch.event[k] == Event.REACHED
                price = 20.0**2 / edge * np.trapezoid(excess[: back + 1], motion.t[: back + 1])
                rel = 1e-5 if precise else 5e-3
                assert batch.cost[k] == pytest.approx(motion.cost + price, rel=rel)
                assert -batch.path[k, 0] == pytest.approx(excess.max(), rel=5e-3)
            elif again:
                assert batch.event[k] == Event.CONSTRAINT
                assert batch.time[k] > motion.t[back]
            seen.add(int(batch.event[k]))
    assert {int(Event.REACHED), int(Event.CONSTRAINT)} <= seen


def test_a_motion_that_begins_outside_of_a_constraint_on_the_input_ends_there(
    rig: ut.Mechanism, watched: ut.Objective, quick: ut.Surface
) -> None:
    """What the input does is the plan's own choice: no price lets it break w(x, u) ≤ 0."""
    loop = ut.ClosedLoop(rig, replace(watched, hard_input=False), returning=True)
    turning = rig.state(phi=0.8, theta_dot=-4.0)
    assert ut.SlidingModeLaw(rig, quick)(0.0, turning).u[0] * -4.0 > 40.0  # W: the power
    slow = interpreted(loop)
    for precise in (False, True):
        batch = slow.batch(turning, [quick], duration=0.004, precise=precise)
        assert batch.event[0] == Event.CONSTRAINT
        assert batch.time[0] == 0.0


def test_a_batch_divides_its_step_beside_a_mode_that_is_faster() -> None:
    """A weight on a damped spring, 2000 1/s: in steps of 2 ms it would be gone for ever."""
    x, w = ut.Coordinate("x", "m"), ut.Coordinate("w", "m")
    m, rate = 0.05, 2000.0
    T = x.velocity**2 / 2 + m * (x.velocity + w.velocity) ** 2 / 2
    V, D = m * rate**2 * w.symbol**2 / 2, m * rate * w.velocity**2
    carriage = ut.Mechanism.from_energies(
        "carriage", [x, w], [ut.Input("force", "N", 10.0)], T, V, dissipation=D
    )
    surface, x0 = ut.first_surface(carriage), carriage.state(x=0.1)
    loop = interpreted(ut.ClosedLoop(carriage))
    assert loop.substeps == 4
    assert loop.with_steps(1e-4, 0.0).substeps == 1
    batch = loop.batch(x0, surface, duration=0.03)
    law = ut.SlidingModeLaw(carriage, surface)

    def slope(_t: float, at: Any) -> Any:
        return np.append(at[2:], carriage.accelerations(0.0, at, law(0.0, at).u))

    true = solve_ivp(slope, (0.0, 0.03), x0, "LSODA", rtol=1e-9, atol=1e-12).y[:, -1]
    np.testing.assert_allclose(batch.x[0], true, atol=1e-5)  # corners of the law
    rows = loop.simulate(x0, surface, duration=0.03)
    np.testing.assert_allclose(np.diff(rows.t), 0.002, rtol=1e-9)
    np.testing.assert_array_equal(rows.x[-1], batch.x[0])
