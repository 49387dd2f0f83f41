"""The exact linear end of a closed loop, and what a rollout sees between its steps."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import scipy.linalg
import sympy as sp

import undertow as ut
from support import SHAPES, random_mechanism, random_surface, rest_slow
from undertow.cascade.planners import TAIL_RTOL
from undertow.closed_loop import ClosedLoop, Ensemble, Event, RolloutBuffers
from undertow.closed_loop.linear_model import NOBODY, Prepared, TerminalLinearModel, _solve
from undertow.closed_loop.work_array import LANES
from undertow.law import gains_at_target, pack_law_parameters, sliding_matrix
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


@pytest.mark.parametrize(
    ("n", "m", "members"),
    rest_slow([(n, m, members) for n, m in SHAPES for members in (0, 2)], (2, 1, 0)),
)
def test_linear_models_are_those_of_the_law_and_the_plant(n: int, m: int, members: int) -> None:
    """A by central differences of plant and law, xᵀQx by the stage cost along the law, any n, m.

    With gains (13) at work, two surfaces of which the last counts, and plants unlike the belief.
    """
    belief = random_mechanism(n, m).with_disturbance_bounds(*(0.2,) * n)
    rng = np.random.default_rng([n, m])
    root = rng.uniform(-1, 1, (2 * n + m, 2 * n + m))

    def cost(v: Any) -> sp.Expr:
        z = sp.Matrix(root) * sp.Matrix([*v.states, *v.inputs])
        return 2.0 + (z.T * z)[0] + v.inputs[0] ** 4

    plants = [belief.with_parameters(scale=1.3 + k, friction=0.05 + 0.3 * k) for k in (1, 2)]
    ensemble = None
    if members:
        ensemble = Ensemble(belief, np.stack([plant.parameter_values for plant in plants]))
    objective = ut.Objective("quadratic", cost)
    end = TerminalLinearModel(belief, objective, ensemble)
    assert end.stage is not None
    assert end.stage.rest == pytest.approx(2.0)
    blocks: Any = SimpleNamespace(double=lambda *_: None)  # the model alone
    end._blocks = blocks
    reaching = ut.ReachingLaw(tuple(2.0 + k for k in range(m)), tuple(0.5 + k for k in range(m)))
    surfaces = [random_surface(n, m, seed) for seed in range(LANES)]
    law_vectors = np.stack(
        [pack_law_parameters(ut.SlidingModeLaw(belief, s, reaching)) for s in surfaces]
    )
    lanes = np.stack([law_vectors[::-1], law_vectors], axis=1)
    gains = gains_at_target(
        belief, np.stack([s.vector for s in surfaces]), np.tile(reaching.eta, (LANES, 1))
    )
    member = np.arange(LANES) % 2 if members else NOBODY
    room = end.buffers(LANES)
    end.prepare(lanes, gains, room, member)
    h = 1e-5
    for lane in (0, 1, 2):
        law = ut.SlidingModeLaw(belief, surfaces[lane], reaching)
        plant = plants[lane % 2] if members else belief
        steps = h * np.vstack([np.eye(2 * n), -np.eye(2 * n)])
        rates = plant.accelerations(0.0, steps, law(0.0, steps).demand)
        A = ((rates[: 2 * n] - rates[2 * n :]) / (2 * h)).T
        np.testing.assert_allclose(room.A[lane], A, rtol=1e-6, atol=1e-6 * np.abs(A).max())
        x = rng.uniform(-1, 1, (20, 2 * n))
        u = (law(0.0, h * x).demand - law(0.0, -h * x).demand) / (2 * h)
        exact = (np.hstack([x, u]) @ root.T) ** 2
        quadratic = np.einsum("ki,ij,kj->k", x, room.Q[lane], x)
        np.testing.assert_allclose(quadratic, exact.sum(1), rtol=1e-5)


@pytest.mark.parametrize("size", [1, 2, 3, 5])
def test_small_systems_are_solved_with_their_largest_pivots(size: int) -> None:
    """Zeros and tiny numbers on the diagonal do no harm."""
    rng = np.random.default_rng(size)
    for _ in range(20):
        a, b = rng.standard_normal((size, size)), rng.standard_normal((size, 4))
        a[np.diag_indices(size)] *= rng.choice([0.0, 1e-15, 1.0], size) if size > 1 else 1.0
        if np.linalg.cond(a) > 1e4:
            continue
        found = b.copy()
        _solve(a.copy(), found)
        np.testing.assert_allclose(found, np.linalg.solve(a, b), rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize(
    ("cost", "smooth"),
    [
        (lambda v: 1 + v.phi**2 + v.voltage**2 * (2 + sp.cos(v.phi)), True),
        (lambda v: sp.Abs(v.phi), False),  # a corner
        (lambda v: (v.phi + 0.1) ** 2, False),  # a slope
        (lambda v: sp.sqrt(v.phi**2 + v.theta**2), False),
        (lambda v: (v.phi**2) ** sp.Float(0.7), False),  # no second derivative
    ],
)
def test_costs_without_a_second_order_model_take_small_steps(
    rig: ut.Mechanism, cost: Callable[[Any], sp.Expr], smooth: bool
) -> None:
    loop = ClosedLoop(rig, ut.Objective("own", cost), tail_rtol=TAIL_RTOL)
    assert loop.takes_large_steps == smooth
    assert loop.linear_end is not None
    assert (loop.linear_end.stage is not None) == smooth


def test_who_takes_large_steps(rig: ut.Mechanism) -> None:
    """A continuous law with a layer, on its own belief or an ensemble, if they are asked for."""
    loop = ClosedLoop(rig, ut.MinimumEnergy(), tail_rtol=TAIL_RTOL)
    members = Ensemble(rig, np.tile(rig.parameter_values, (2, 1)))
    rubbing = rig.disturbed({"phi": -0.01 * sp.sign(rig.coordinates[1].velocity)})
    sign = ut.ReachingLaw(switching="sign")
    assert loop.takes_large_steps
    assert replace(loop, ensemble=members).takes_large_steps
    assert replace(loop, reaching=ut.ReachingLaw(switching="tanh")).takes_large_steps
    assert not replace(loop, tail_rtol=0.0).takes_large_steps
    assert replace(loop, tail_rtol=0.0).linear_end is not None
    for other in (
        replace(loop, zoh_steps=2),
        replace(loop, reaching=sign),
        replace(loop, plant=rig.with_parameters(m=0.2)),
        replace(loop, ensemble=Ensemble(rubbing, members.values)),
    ):
        assert other.linear_end is None
        assert not other.takes_large_steps


def test_large_steps_leave_alone_what_has_ended(rig: ut.Mechanism) -> None:
    """Arrived at once or on the way, singular, lost, unstable: bit for bit as in small steps."""
    quick, base = ut.Surface(-1, -1.59, 1.96, 12.1), ut.Surface(-1, -0.5, 5, 10)
    unstable = ut.Surface(-1, -0.5, 1.0, 0.5)
    cases = [
        (rig.state(phi=0.009), quick),
        (rig.state(theta=0.005, phi=0.002), quick),
        (rig.state(phi=math.radians(80)), base),
        (rig.state(phi=math.radians(70), phi_dot=6.0), base),
        (rig.state(phi=0.1, theta_dot=1e200), quick),
        (rig.state(phi=0.3), unstable),
        (rig.state(phi=0.0005, phi_dot=0.012), quick),
    ]
    states = np.array([x for x, _ in cases])
    small = ClosedLoop(rig, ut.MinimumEnergy())
    exact, large = (
        replace(small, tail_rtol=tail).batch(states, [s for _, s in cases], stable_only=True)
        for tail in (0.0, TAIL_RTOL)
    )
    assert {Event.REACHED, Event.SINGULAR, Event.DIVERGED, Event.UNSTABLE} <= set(exact.event)
    ended = exact.time < 0.03  # before a lane may hand over
    assert ended.sum() >= 6
    for name in ("cost", "time", "event", "radius", "singular", "x", "steps"):
        np.testing.assert_array_equal(getattr(large, name)[ended], getattr(exact, name)[ended])


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

    taken = []

    def etd_integrate(*args: FloatArray) -> None:
        tried.append(float(args[-1][0, 1]))
        exact._kernels.etd_integrate(*args)
        taken.append(float(args[-1][0, -1]))

    kernels = SimpleNamespace(rollout=exact._kernels.rollout, etd_integrate=etd_integrate)
    object.__setattr__(loop, "_kernels", kernels)
    small, large = exact.batch(x, surface), loop.batch(x, surface)
    assert len(tried) == 2  # in vain, and again half a second later
    assert tried[0] + 0.4 < tried[1]
    assert large.steps[0] == sum(taken)  # those in vain were taken, too
    assert small.reached[0]
    assert large.cost[0] == pytest.approx(small.cost[0], rel=TAIL_RTOL)
    assert large.time[0] == pytest.approx(small.time[0], rel=TAIL_RTOL)
    assert large.steps[0] < 0.5 * small.steps[0]


def test_what_breaks_a_bound_is_not_tried_again(rig: ut.Mechanism) -> None:
    """An end in small steps is an end: one call of each kernel, and the event is kept."""
    box = ut.state_box(phi=0.5)
    loop = ClosedLoop(rig, ut.MinimumEnergy(constraints=box), tail_rtol=TAIL_RTOL)
    assert loop.takes_large_steps
    kernels, calls = loop._kernels, list[str]()

    def rollout(*args: Any) -> None:
        calls.append("small")
        kernels.rollout.py_func(*args)

    def etd_integrate(*args: Any) -> None:
        calls.append("large")
        kernels.etd_integrate.py_func(*args)

    counted = SimpleNamespace(rollout=rollout, etd_integrate=etd_integrate)
    object.__setattr__(loop, "_kernels", counted)
    quick = ut.Surface(-1, -1.59, 1.96, 12.1)
    found = loop.batch(rig.state(phi=0.6), quick, duration=2.0)
    assert found.event[0] == Event.CONSTRAINT
    assert found.time[0] == 0.0
    assert calls == ["small", "large"]


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


def test_the_clock_at_the_start_does_not_matter_to_what_is_autonomous(rig: ut.Mechanism) -> None:
    """Times are counted from the start: of the end and of the closest approach."""
    loop, x = ClosedLoop(rig, ut.MinimumTime()), rig.state(phi=ut.deg(38))
    surface = ut.Surface(-1, -3.6, 1.38, 9.07)
    motion = loop.simulate(x, surface, terminal=0.0, duration=3.0)
    radii = np.linalg.norm(motion.x, axis=1)
    least = next(k for k in range(1, 1500) if radii[k] < min(radii[:k].min(), radii[k + 1]))
    duration = round(float(motion.t[least]) + 0.02, 3)
    early, late = (
        loop.roll_out(
            RolloutBuffers(loop, 1, 1).fill(x, surface.vector),
            (0.0,),
            duration,
            start=start,
            terminal=0.0,
            seek=True,
        )
        for start in (0.0, 5.0)
    )
    assert early.closest_time[0] == pytest.approx(motion.t[least], abs=loop.step)
    assert late.closest_time[0] == pytest.approx(early.closest_time[0], abs=1e-9)
    assert late.time[0] == pytest.approx(duration, abs=1e-9)
    np.testing.assert_allclose(late.x, early.x, atol=1e-12)


def test_the_closest_approach_is_that_of_the_recorded_motion(rig: ut.Mechanism) -> None:
    """Smallest ‖x‖, when and where: no larger than any sample, and on the motion."""
    loop = ClosedLoop(rig, ut.MinimumTime(), rtol=0.0)
    surface = ut.Surface(-1, -3.6, 1.38, 9.07)
    x = rig.state(phi=ut.deg(35))
    batch = loop.batch(x, surface, terminal=0.0, duration=2.0, seek=True)
    motion = loop.simulate(x, surface, terminal=0.0, duration=2.0)
    radii = np.linalg.norm(motion.x, axis=1)
    assert batch.closest[0] <= radii.min()
    assert batch.closest[0] == pytest.approx(np.linalg.norm(batch.closest_x[0]))
    place = [np.interp(batch.closest_time[0], motion.t, column) for column in motion.x.T]
    np.testing.assert_allclose(batch.closest_x[0], place, atol=1e-9)
