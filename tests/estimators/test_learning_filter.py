"""The Kalman filter that learns parameters: against a dense one in NumPy, and on plants."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest

import undertow as ut
from support import rest_slow
from undertow.base import InvalidInputError
from undertow.closed_loop import ClosedLoop
from undertow.estimators import Belief, KalmanFilter
from undertow.law import InnerLoop
from undertow.mechanisms.named import named
from undertow.models import FloatArray, Mechanism
from undertow.plants import Bench, Encoder, Friction, IdealRig, Measurement, RealisticRig

PERIOD, NOISE = 0.001, 2e-4


@pytest.fixture(scope="module")
def arm() -> Mechanism:
    return ut.mechanisms.rotary_pendulum(d_e=0.073)


def _learning(arm: Mechanism, **settings: float) -> KalmanFilter:
    return KalmanFilter(arm, PERIOD, position_noise=NOISE, belief=Belief.usual(arm), **settings)


def _reference(
    arm: Mechanism, belief: Belief, readings: FloatArray, inputs: FloatArray, drifts: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The textbook's extended filter of (q, q̇, θ), dense, all positions taken in at once."""
    n, known = arm.n, len(belief.tolerances)
    size = 2 * n + known

    moves = arm.function("dynamics")

    def rates(z: FloatArray, u: FloatArray) -> FloatArray:
        x, offset = z[: 2 * n], z[2 * n :]
        return np.array([*x[n:], *moves(0.0, *x, *u, *belief.values(offset)), *(0.0 * offset)])

    z, P = np.zeros(size), np.diag([NOISE**2] * n + [1.0] * n + [1.0 / 3.0] * known)
    z[:n] = readings[0]
    C, R = np.eye(n, size), NOISE**2 * np.eye(n)
    for q, u in zip(readings, inputs, strict=True):
        A = np.column_stack(
            [(rates(z + e, u) - rates(z - e, u)) / 2e-6 for e in 1e-6 * np.eye(size)]
        )
        F = np.eye(size) + PERIOD * A + 0.5 * (PERIOD * A) @ (PERIOD * A)
        k1 = rates(z, u)
        k2 = rates(z + 0.5 * PERIOD * k1, u)
        k3 = rates(z + 0.5 * PERIOD * k2, u)
        k4 = rates(z + PERIOD * k3, u)
        z = z + PERIOD / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        P = F @ P @ F.T + PERIOD * np.diag(drifts**2)
        gain = P @ C.T @ np.linalg.inv(C @ P @ C.T + R)
        z = z + gain @ (q - C @ z)
        P = P - gain @ C @ P
    return z, P


def test_it_is_the_textbooks_filter_of_state_and_parameters(
    arm: Mechanism, monkeypatch: pytest.MonkeyPatch
) -> None:
    """20 samples of a motion of another plant; it learns from each."""
    monkeypatch.setattr("undertow.estimators.kalman.EXCITED", 0.0)
    belief, rng = Belief.usual(arm), np.random.default_rng(4)
    plant = arm.with_parameters(m=1.1 * 0.125)
    kalman = _learning(arm)
    rig, rows, inputs = IdealRig(plant, arm.state(phi=0.4), PERIOD), [], []
    u = np.zeros(1)
    for k in range(20):
        seen = rig.read()
        q = seen.q + NOISE * rng.standard_normal(2)
        rows.append(q)
        inputs.append(u)
        if k == 0:
            kalman.reset(np.concatenate([q, np.zeros(2)]))
        kalman.estimate(Measurement(k * PERIOD, q), u)
        u = np.array([8.0 + np.sin(0.2 * k)])
        rig.write(u)
    drifts = np.array([0.0] * 2 + [0.5] * 2 + [0.1] * len(belief.tolerances))
    z, P = _reference(arm, belief, np.array(rows), np.array(inputs), drifts)
    learnt = kalman.learnt
    assert learnt is not None
    np.testing.assert_allclose(kalman.covariance[:4, :4], P[:4, :4], rtol=1e-4, atol=1e-12)
    np.testing.assert_allclose(learnt.deviation**2, np.diag(P)[4:], rtol=1e-4)
    np.testing.assert_allclose(learnt.offset, z[4:], atol=1e-4)
    assert np.abs(learnt.offset).max() > 0.01


def test_it_finds_the_plant_that_moves(arm: Mechanism) -> None:
    """Of twelve plants the accelerations come nearer than the model's; within what it says.

    Which of six parameters it was, a motion of half a second does not tell.
    """
    belief, rng = Belief.usual(arm), np.random.default_rng(5)
    law = InnerLoop(arm, ut.first_surface(arm))
    model, learned, sizes = [], [], []
    for _ in range(12):
        truth = rng.uniform(-1, 1, len(belief.tolerances))
        plant = arm.with_values(belief.values(truth))
        rig, kalman, u = IdealRig(plant, arm.state(phi=0.4), PERIOD), _learning(arm), np.zeros(1)
        kalman.reset(arm.state(phi=0.4))
        for _ in range(500):
            seen = rig.read()
            q = seen.q + NOISE * rng.standard_normal(2)
            u = law(kalman.estimate(Measurement(seen.t, q), u)).copy()
            rig.write(u)
        learnt = kalman.learnt
        assert learnt is not None
        off = learnt.offset - truth
        sizes.append(off @ learnt.information @ off)
        x, push = arm.state(phi=0.3, theta_dot=1.0, phi_dot=-1.0), np.array([5.0])
        true = plant.accelerations(0.0, x, push)
        model.append(arm.accelerations(0.0, x, push) - true)
        learned.append(belief.believed(learnt).accelerations(0.0, x, push) - true)
    assert np.sqrt(np.mean(np.square(learned))) < 0.3 * np.sqrt(np.mean(np.square(model)))
    assert np.mean(sizes) < 2.0 * len(belief.tolerances)  # χ² of so many numbers


def test_at_rest_nothing_is_learnt_and_a_reset_forgets(arm: Mechanism) -> None:
    """What dry friction does near rest would be taken for parameters."""
    kalman, rng = _learning(arm), np.random.default_rng(6)
    kalman.reset(np.zeros(4))
    first = kalman.learnt
    for k in range(300):
        kalman.estimate(Measurement(k * PERIOD, NOISE * rng.standard_normal(2)), np.zeros(1))
    rest = kalman.learnt
    assert first is not None
    assert rest is not None
    np.testing.assert_array_equal(rest.offset, first.offset)
    np.testing.assert_allclose(rest.information, first.information, rtol=1e-9)
    for k in range(100):  # nonsense
        kalman.estimate(Measurement(0.3 + k * PERIOD, rng.standard_normal(2)), np.array([10.0]))
    moved = kalman.learnt
    assert moved is not None
    assert np.abs(moved.offset).max() > 0.01
    room = Belief.usual(arm).room
    assert (np.abs(moved.offset) <= room).all()
    assert (kalman.parameters > [p.low for p in arm.parameters]).all()
    kalman.reset(np.zeros(4))
    np.testing.assert_array_equal(kalman.parameters, arm.parameter_values)


def test_noise_of_the_estimate_at_rest(arm: Mechanism) -> None:
    """Predicted from the filter's gain, and sampled from 30 s of white noise; with a delay too."""
    for delay in (0.0, 0.003):
        kalman = KalmanFilter(arm, PERIOD, position_noise=NOISE, disturbance_drift=0.5, delay=delay)
        kalman.reset(np.zeros(4))
        law, rng = np.zeros(1), np.random.default_rng(7)
        rows = []
        for k in range(30_000):
            seen = Measurement(k * PERIOD, NOISE * rng.standard_normal(2))
            rows.append(kalman.estimate(seen, law).copy())
        sampled = np.cov(np.array(rows[1000:]).T)
        predicted = kalman.noise_covariance()
        scale = np.sqrt(np.diag(predicted))
        np.testing.assert_allclose(
            sampled / np.outer(scale, scale), predicted / np.outer(scale, scale), atol=0.1
        )


def test_what_noise_costs_is_its_share_of_the_input(arm: Mechanism) -> None:
    """tr(R K P Kᵀ) per second for a quarter of the time, K by differences of the law."""
    rng = np.random.default_rng(8)
    root = 0.01 * rng.normal(size=(4, 4))
    P = root @ root.T
    surfaces = [ut.first_surface(arm), ut.Surface(-1, -1.59, 1.96, 12.1)]
    x, belief = arm.state(phi=0.3), Belief.relative(arm, m=0.1)
    for ensemble in (None, belief.ensemble(belief.prior)):
        for tolerance in (0.0, 1e-4):
            plain = ClosedLoop(arm, ut.MinimumEnergy(), tail_rtol=tolerance, ensemble=ensemble)
            noisy = ClosedLoop(
                arm, ut.MinimumEnergy(), tail_rtol=tolerance, ensemble=ensemble, covariance=P
            )
            before, after = plain.batch(x, surfaces), noisy.batch(x, surfaces)
            costs, times = before.cost.copy(), before.time.copy()
            K = np.array([InnerLoop(arm, surface).feedback() for surface in surfaces])
            rate = 0.25 * np.einsum("cij,jk,cik->c", K, P, K)
            if ensemble is None:
                np.testing.assert_allclose(after.cost - costs, rate * times, rtol=1e-4)
            else:  # members arrive at other times, and some have other surfaces
                np.testing.assert_allclose(after.cost - costs, rate * times, rtol=0.3)
            assert (after.cost > costs).all()


def test_senseless_beliefs_are_refused(arm: Mechanism) -> None:
    other = Belief.usual(ut.mechanisms.rotary_pendulum(d_e=0.025))
    with pytest.raises(InvalidInputError, match="about another"):
        KalmanFilter(arm, belief=other)
    with pytest.raises(InvalidInputError, match="parameter_drift"):
        KalmanFilter(arm, belief=Belief.usual(arm), parameter_drift=-1.0)


@lru_cache(maxsize=4)
def _knocked(
    arm: Mechanism, knock: float, bad: int = -1
) -> tuple[KalmanFilter, FloatArray, FloatArray, FloatArray]:
    """After a run in which φ̇ jumps at 0.4 s and reading ``bad`` of φ is 0.03 rad off.

    The filter; the offsets before and after; how far the rates are off 5 ms after the jump.
    """
    rng, kalman, u = np.random.default_rng(6), _learning(arm, disturbance_drift=1.5), np.zeros(1)
    law, x = InnerLoop(arm, ut.first_surface(arm)), arm.state(phi=0.3)
    kalman.reset(x)
    rig = IdealRig(arm, x, PERIOD)
    before, off = np.empty(0), np.empty(0)
    for k in range(600):
        if k == 400:
            assert kalman.learnt is not None
            before = kalman.learnt.offset
            x = x + np.array([0.0, 0.0, 0.4 * knock, knock])
            rig = IdealRig(arm, x, PERIOD)
        q = x[:2] + NOISE * rng.standard_normal(2) + (0.03 if k == bad else 0.0)
        estimate = kalman.estimate(Measurement(k * PERIOD, q), u)
        if k == 405:
            off = estimate[2:] - x[2:]
        u = law(estimate).copy()
        rig.write(u)
        seen = rig.read()
        assert seen.v is not None
        x = np.concatenate([seen.q, seen.v])
    assert kalman.learnt is not None
    return kalman, before, kalman.learnt.offset, off


@pytest.mark.parametrize("knock", rest_slow([-2.0, 6.0, 1.2, -3.0], 6.0, 1.2))
def test_a_knock_is_a_jump_of_the_velocities_and_no_parameter(arm: Mechanism, knock: float) -> None:
    """Velocities are found within 5 ms; parameters move no farther than without the knock.

    What 15 V do in 5 ms, 1.8 rad/s, and a little more is no reason to give up what was planned.
    """
    calm, before, after, off = _knocked(arm, 0.0)
    assert calm.jumps == 0
    usual = np.abs(after - before).max()
    kalman, before, after, off = _knocked(arm, knock)
    assert kalman.jumps == (1 if abs(knock) > 2.5 else 0)
    assert np.abs(off).max() < 0.3
    assert np.abs(after - before).max() < max(0.2, 2.0 * usual)


def test_a_single_bad_reading_is_left_out(arm: Mechanism) -> None:
    kalman, before, after, off = _knocked(arm, 0.0, bad=404)
    assert kalman.jumps == 0
    assert np.abs(off).max() < 0.1
    assert np.abs(after - before).max() < 0.2


COUNT = 2 * np.pi / 4096


def _off_by_counts(
    wheel: Mechanism, belief: Belief, seed: int, **reading: float
) -> tuple[float, float]:
    """Learn another plant from its encoders for 4 s while the law for the model balances it.

    The squared error in what the filter says of it, per parameter; the worst one, in tolerances.
    """
    rng = np.random.default_rng([seed, 9])
    truth = rng.uniform(-0.2, 0.2, len(belief.tolerances))
    plant = wheel.with_values(belief.values(truth))
    law = InnerLoop(wheel, ut.first_surface(wheel), ut.ReachingLaw(40.0, 1.6))
    counts = {c.name: Encoder(COUNT) for c in wheel.coordinates}
    rig = RealisticRig(Bench(plant, encoders=counts), wheel.state(phi=0.02), seed)
    kalman, u = KalmanFilter(wheel, PERIOD, belief=belief, **reading), np.zeros(1)
    for k in range(4000):
        seen = rig.read()
        if k == 0:
            kalman.reset(np.concatenate([seen.q, np.zeros(2)]))
        u = law(kalman.estimate(seen, u)).copy()
        rig.write(u)
    assert abs(rig.truth[1]) < 0.05
    learnt = kalman.learnt
    assert learnt is not None
    off = learnt.offset - truth
    return float(off @ learnt.information @ off) / len(off), float(np.abs(off).max())


@pytest.mark.slow
def test_counts_teach_no_more_than_they_say() -> None:
    """A slow pendulum stays within a count for tens of readings, which all have the same error.

    Taken for as many independent ones they teach a plant that is none: by more than it can be off,
    and by many times what the filter says.
    """
    wheel = ut.mechanisms.reaction_wheel_pendulum()
    belief = Belief.usual(wheel)
    counted = [
        _off_by_counts(wheel, belief, seed, position_noise=1e-6, resolution=COUNT)
        for seed in range(3)
    ]
    assert max(size for size, _ in counted) < 2.0
    assert max(worst for _, worst in counted) < 1.5
    white = _off_by_counts(wheel, belief, 0, position_noise=COUNT / np.sqrt(12))
    assert white[0] > 50.0
    assert white[1] > 3.0


@pytest.mark.parametrize(("late", "jumps"), [(0.0, True), (3e-5, False)])
def test_readings_of_another_moment_are_no_jump(arm: Mechanism, late: float, jumps: bool) -> None:
    """The arm turns at 100 rad/s, and each reading is some 30 µs early or late."""
    rng, kalman = np.random.default_rng(10), KalmanFilter(
        arm, PERIOD, position_noise=NOISE, time_noise=late
    )  # fmt: skip
    rig = IdealRig(arm, arm.state(theta_dot=100.0), PERIOD)
    kalman.reset(rig.truth)
    for _ in range(300):
        rig.write([0.0])
        seen, x = rig.read(), rig.truth
        q = seen.q + 3e-5 * rng.standard_normal() * x[2:] + NOISE * rng.standard_normal(2)
        kalman.estimate(Measurement(seen.t, q), np.zeros(1))
    assert (kalman.jumps > 0) is jumps


def test_senseless_readings_are_refused(arm: Mechanism) -> None:
    with pytest.raises(InvalidInputError, match="resolution"):
        KalmanFilter(arm, resolution=[COUNT, -COUNT])
    with pytest.raises(InvalidInputError, match="time_noise"):
        KalmanFilter(arm, time_noise=-1e-5)


def test_counts_of_a_joint_that_runs_are_white_noise(arm: Mechanism) -> None:
    """It crosses one at each reading: the filter is that of a count/√12, to 1e-9."""
    both = [
        KalmanFilter(arm, PERIOD, position_noise=1e-6, resolution=1e-4),
        KalmanFilter(arm, PERIOD, position_noise=np.sqrt(1e-12 + 1e-8 / 12)),
    ]
    states = []
    for kalman in both:
        kalman.reset([0.0, 0.0, 5.0, 5.0])
        for k in range(1, 51):
            q = np.array([5.0, 5.0]) * k * PERIOD
            states.append(kalman.estimate(Measurement(k * PERIOD, q), np.zeros(1)).copy())
    np.testing.assert_allclose(states[:50], states[50:], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(both[0].noise_covariance(), both[1].noise_covariance(), rtol=1e-9)


@pytest.mark.parametrize("late", rest_slow([0.0, 0.0045, 0.009, 0.016], 0.0045, 0.016))
@pytest.mark.parametrize(
    "name", rest_slow(["rotary_pendulum", "cart_pendulum", "overhead_crane"], "rotary_pendulum")
)
def test_a_delay_that_nobody_told_is_found(name: str, late: float) -> None:
    """Within 3 ms after half a second, of a rig with encoders that is later than was told."""
    model = named(name)
    counts = {c.name: Encoder(2e-4) for c in model.coordinates}
    bench = Bench(model, encoders=counts).with_delay(0.001 + late)
    rig = RealisticRig(bench, 0.5 * model.usual_start, 3)
    kalman = KalmanFilter(
        model, PERIOD, position_noise=1e-6, resolution=2e-4, acceleration_noise=0.1,
        delay=0.001, delay_tolerance=0.004,
    )  # fmt: skip
    law = InnerLoop(model, ut.first_surface(model))
    kalman.reset(0.5 * model.usual_start)
    rng, u, shake = np.random.default_rng(1), np.zeros(model.m), np.zeros(model.m)
    limits = np.minimum(model.input_limits, 1e3)
    for k in range(500):
        seen = rig.read()
        x = kalman.estimate(seen, u)
        if k % 20 == 0:
            shake = 0.1 * limits * rng.uniform(-1.0, 1.0, model.m)
        u = np.clip(law(x) + shake, -limits, limits)
        rig.write(u)
    assert abs(kalman.estimated_delay - 0.001 - late) < 0.003
    kalman.reset(np.zeros(2 * model.n))
    assert kalman.estimated_delay == 0.001


def test_how_soon_the_motion_answers_is_the_derivative_by_the_delay(arm: Mechanism) -> None:
    """Of a mean that goes on for a sample with a delay, against two filters of other delays."""
    inputs = 8.0 * np.sin(0.1 * np.arange(30))

    def gone_on(late: float) -> FloatArray:
        """Where the states are that a filter with that delay, of whole periods, predicts."""
        kalman = KalmanFilter(arm, PERIOD, position_noise=NOISE, delay=late)
        kalman.reset(arm.state(phi=0.2))
        for k, u in enumerate(inputs):
            kalman.estimate(Measurement(k * PERIOD, np.full(2, np.nan)), np.array([u]))
        return np.array(kalman._x[:4])

    free = KalmanFilter(arm, PERIOD, position_noise=NOISE, delay=0.003, delay_tolerance=1e-6)
    free.reset(arm.state(phi=0.2))
    for k, u in enumerate(inputs):
        free.estimate(Measurement(k * PERIOD, np.full(2, np.nan)), np.array([u]))
    slope = (gone_on(0.004) - gone_on(0.003)) / PERIOD
    tells = free.covariance[:4, 4] / free.covariance[4, 4]  # ∂x/∂τ, drift besides
    np.testing.assert_allclose(tells, slope, rtol=0.02)


@pytest.mark.parametrize("volts", [1.0, 3.0])
def test_dry_friction_that_turns_over_is_followed(arm: Mechanism, volts: float) -> None:
    """30 ms after the arm has turned the disturbance has the sign of what resists."""
    friction = volts * arm.parameter_values[[p.name for p in arm.parameters].index("a_e")]
    bench = Bench(arm, friction={"theta": Friction(coulomb=float(friction))})
    rig = RealisticRig(bench, np.zeros(4), 2)
    kalman = KalmanFilter(
        arm, PERIOD, position_noise=NOISE, disturbance_drift=1.5, belief=Belief.usual(arm)
    )
    kalman.reset(np.zeros(4))
    u, turned, right, seen_turns = np.zeros(1), -1.0, 0, 0
    before = 0.0
    for k in range(4000):
        kalman.estimate(rig.read(), u)
        u = np.array([8.0 * np.sin(2 * np.pi * 1.5 * k * PERIOD)])
        rig.write(u)
        speed = rig.truth[2]
        if k > 1500 and speed * before < 0.0:
            turned = k * PERIOD
        before = speed or before
        if turned > 0.0 and abs(k * PERIOD - turned - 0.030) < 0.5 * PERIOD:
            seen_turns += 1
            right += kalman.disturbance[0] * speed < 0.0
    assert seen_turns >= 5
    assert right >= seen_turns - 1
