"""Estimators: exact where theory says so, quiet where it matters, robust to missing readings."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import undertow as ut
from runs import short_searches
from undertow.base import ArtefactError, InvalidInputError
from undertow.estimators import (
    Estimator,
    FilteredDerivative,
    KalmanFilter,
    Measured,
    SuperTwisting,
    compensated,
    run_recorded,
)
from undertow.estimators.recorded_run import Record, subtract_disturbance
from undertow.law import InnerLoop
from undertow.models import FloatArray
from undertow.plants import (
    Bench,
    IdealRig,
    Measurement,
    RealisticRig,
    RigWrapper,
    Timing,
    srv02_rig,
)
from undertow.runtime import Recipe

PERIOD = 1e-3


@pytest.fixture(scope="module")
def arm() -> ut.Mechanism:
    return ut.mechanisms.rotary_pendulum()


def _follow(estimator: Estimator, q: Callable[[float], float], seconds: float) -> np.ndarray:
    """Velocities that an estimator makes of q(t) for both coordinates, (N, 2)."""
    estimator.reset([q(0.0), q(0.0), 0.0, 0.0])
    out = []
    for k in range(round(seconds / PERIOD)):
        t = k * PERIOD
        measured = Measurement(t, np.array([q(t), q(t)]))
        out.append(estimator.estimate(measured, np.zeros(1))[2:].copy())
    return np.array(out)


def test_a_filtered_derivative_has_the_lag_of_its_time_constant(arm: ut.Mechanism) -> None:
    tau, slope = 0.02, 3.0
    v = _follow(FilteredDerivative(arm, time_constant=tau), lambda t: 0.5 * slope * t**2, 0.5)
    t = PERIOD * (len(v) - 1)
    np.testing.assert_allclose(v[-1], slope * (t - tau), rtol=1e-3)


def test_super_twisting_is_exact_below_its_bound_and_not_above(arm: ut.Mechanism) -> None:
    """Levant (1998): finite-time exact while |q̈| < L; here 40 rad/s² against 50 and 30."""
    w = 4.0
    q = lambda t: 2.5 * math.sin(w * t)  # noqa: E731
    t = PERIOD * np.arange(2000)
    true = 2.5 * w * np.cos(w * t)
    within = np.abs(_follow(SuperTwisting(arm, acceleration=50.0), q, 2.0)[1000:, 0] - true[1000:])
    beyond = np.abs(_follow(SuperTwisting(arm, acceleration=30.0), q, 2.0)[1000:, 0] - true[1000:])
    assert within.max() < 2 * 40.0 * PERIOD
    assert beyond.max() > 0.5


def test_super_twisting_does_not_chatter_on_a_still_encoder(arm: ut.Mechanism) -> None:
    v = _follow(SuperTwisting(arm, acceleration=500.0), lambda t: 0.3, 0.5)
    assert not v.any()


@pytest.mark.parametrize(
    "make", [lambda arm: FilteredDerivative(arm, time_constant=0.002), SuperTwisting]
)
def test_without_a_reading_a_coordinate_goes_on_at_its_last_velocity(
    make: Callable[[ut.Mechanism], Estimator], arm: ut.Mechanism
) -> None:
    """Of a ramp that is not seen for a while nothing is missed, and nothing jumps afterwards."""
    estimator, slope = make(arm), -0.7
    estimator.reset([0.0, 0.0, slope, slope])
    for k in range(1, 400):
        q = np.full(2, slope * k * PERIOD)
        seen = np.where([True, k < 200 or k > 300], q, np.nan)
        x = estimator.estimate(Measurement(k * PERIOD, seen), np.zeros(1))
        np.testing.assert_allclose(x, [*q, slope, slope], atol=1e-9)


def test_who_knows_no_covariance_says_so_in_the_right_shape(arm: ut.Mechanism) -> None:
    """No part of the state is uncertain: what is planned with it takes no risk into account."""
    estimator = Measured(arm)
    for covariance in (estimator.steady_covariance(), estimator.noise_covariance()):
        np.testing.assert_array_equal(covariance, np.zeros((4, 4)))


def test_the_kalman_filter_finds_the_state_of_its_own_model(arm: ut.Mechanism) -> None:
    """From a wrong velocity, on exact positions, with inputs and no surprise."""
    rig = IdealRig(arm, [0.1, 3.0, 0.5, -0.5])
    kalman = KalmanFilter(arm, position_noise=1e-6, acceleration_noise=1e-3)
    kalman.reset([0.1, 3.0, 0.0, 0.0])
    record = run_recorded(rig, kalman, lambda t, x: np.array([3.0 * math.sin(5 * t)]), 1.0)
    assert np.abs(record.x - record.truth)[200:].max() < 1e-7


def test_the_kalman_filter_follows_a_mode_that_is_faster_than_its_period() -> None:
    """The arm's speed decays by 364/s; at 100 Hz a step of the period made it grow."""
    arm, period = ut.mechanisms.rotary_pendulum(d_e=1.84).with_input_limit(1e3), 0.01
    rig = IdealRig(arm, [0.0, 0.1, 5.0, 0.0], period)
    for lead in (0, 2):
        kalman = KalmanFilter(
            arm, period, position_noise=1e-5, acceleration_noise=1e-2, delay=lead * period
        )
        kalman.reset(rig.truth)
        u = np.zeros(1)
        for k in range(40):
            found = kalman.estimate(rig.read(), u)
            if lead == 0 and k > 3:
                np.testing.assert_allclose(found, rig.truth, rtol=0.03, atol=0.03)
            u = np.array([400.0 * (-1) ** (k // 3)])
            rig.write(u)
        assert np.isfinite(kalman.covariance).all()
        assert np.linalg.eigvalsh(kalman.noise_covariance()).min() > -1e-12
        assert np.abs(kalman.noise_covariance()).max() < 1.0


@pytest.mark.slow
def test_the_covariance_of_the_kalman_filter_is_honest(arm: ut.Mechanism) -> None:
    """The errors that it makes have the variance it says: NEES within wide bounds."""
    rng = np.random.default_rng(0)
    noise, drift = 1e-3, 0.5
    scores = []
    for seed in range(10):
        kalman = KalmanFilter(arm, position_noise=noise, acceleration_noise=drift)
        kalman.reset([0.0, math.pi, 0.0, 0.0], spread=0.3)
        x = np.array([0.0, math.pi, *rng.normal(0, 0.3, 2)])
        for k in range(400):
            u = np.array([2.0 * math.sin(0.02 * k + seed)])
            y = x[:2] + noise * rng.standard_normal(2)
            estimate = kalman.estimate(Measurement(k * PERIOD, y), u)
            if k > 200 and k % 20 == 0:
                error = estimate - x
                scores.append(error @ np.linalg.solve(kalman.covariance, error))
            rig = IdealRig(arm, x)
            rig.write([2.0 * math.sin(0.02 * (k + 1) + seed)])
            x = rig.truth
            x[2:] += drift * math.sqrt(PERIOD) * rng.standard_normal(2)
    assert 2.5 < np.mean(scores) < 6.0


def test_a_matched_disturbance_is_found(arm: ut.Mechanism) -> None:
    """A torque where the motor's is, as 0.7 V more than was asked for would make it."""

    class Torque(RigWrapper):
        def write(self, u: FloatArray) -> None:
            super().write(u + 0.7)

    rig = Torque(RealisticRig(Bench(arm), [0.0, math.pi, 0.0, 0.0]))
    kalman = KalmanFilter(arm, disturbance_drift=5.0)
    kalman.reset([0.0, math.pi, 0.0, 0.0])
    run_recorded(rig, kalman, lambda t, x: np.zeros(1), 2.0)
    assert kalman.disturbance[0] == pytest.approx(0.7, abs=0.05)


@pytest.mark.slow
def test_the_observer_lowers_the_gain_that_is_needed(arm: ut.Mechanism, base: ut.Surface) -> None:
    """A constant matched force; with d̂ taken off, a quarter of η keeps |s| as small."""
    a_e = next(p.value for p in arm.parameters if p.name == "a_e")
    bench = Bench(arm.disturbed({"theta": 1.0 * a_e}))

    def offset(eta: float, observe: bool) -> float:
        kalman = KalmanFilter(arm, position_noise=1e-4, disturbance_drift=5.0)
        x0 = arm.state(phi=0.05)
        kalman.reset(x0)
        law = InnerLoop(arm, base, ut.ReachingLaw(eta, 0.1))

        def control(t: float, x: np.ndarray) -> np.ndarray:
            return np.clip(law(x) - observe * kalman.disturbance, -15.0, 15.0)

        record = run_recorded(RealisticRig(bench, x0), kalman, control, 3.0)
        return float(np.abs(base.s(record.truth[-500:])).max())

    assert offset(5.0, True) < 0.5 * offset(20.0, False)
    assert offset(5.0, False) > 2.0 * offset(20.0, False)


def test_a_known_delay_is_predicted_over(arm: ut.Mechanism) -> None:
    """With the delay known, the estimate is for when the input acts: hardly any error left."""
    late = Timing(0.001, input_delay=0.003, measurement_delay=0.002)
    errors = {}
    for delay in (0.0, 0.005):
        rig = RealisticRig(Bench(arm, timing=late), [0.0, 3.0, 0.0, 1.0])
        kalman = KalmanFilter(arm, position_noise=1e-5, delay=delay)
        kalman.reset([0.0, 3.0, 0.0, 1.0])
        record = run_recorded(rig, kalman, lambda t, x: np.array([4.0 * math.sin(9 * t)]), 1.0)
        errors[delay] = np.abs(record.x[500:-3] - record.truth[503:]).max()
    assert errors[0.005] < 0.05 * errors[0.0]


@pytest.mark.parametrize("kind", [FilteredDerivative, SuperTwisting, KalmanFilter])
def test_missing_readings_are_bridged(arm: ut.Mechanism, kind: type) -> None:
    estimator = kind(arm)
    estimator.reset([0.0, 0.0, 2.0, 2.0])
    for k in range(20):
        gone = 10 <= k < 15
        q = np.array([math.nan if gone else 2.0 * (k + 1) * PERIOD, math.nan])
        x = estimator.estimate(Measurement((k + 1) * PERIOD, q), np.zeros(1))
        assert np.isfinite(x).all()
        if gone:
            assert x[0] == pytest.approx(2.0 * (k + 1) * PERIOD, abs=2e-3)


KINDS = KalmanFilter, FilteredDerivative, SuperTwisting


@pytest.mark.parametrize("kind", KINDS)
def test_a_gap_is_as_long_as_the_clock_says(
    kind: Callable[[ut.Mechanism], Estimator], arm: ut.Mechanism
) -> None:
    """A recording of a swing without 0.3 s of it, and one at 8 Hz by an estimator of 1 kHz."""
    x0 = arm.state(phi=2.5)
    whole = _swing(arm, x0)
    for kept in (np.r_[0:1000, 1300:3000], np.arange(0, 3000, 125)):
        estimator, off = kind(arm), []
        estimator.reset(x0)
        for k in kept:
            x = estimator.estimate(Measurement(k * PERIOD, whole[k, :2]), np.zeros(1))
            off.append(np.abs(x - whole[k]).max())
        assert max(off) < 2.0  # rad/s: differentiators give the mean over the gap


def _swing(arm: ut.Mechanism, x0: np.ndarray) -> np.ndarray:
    """States of 3 s of free motion, (3000, 2n)."""
    rig, rows = IdealRig(arm, x0, period=PERIOD), []
    for _ in range(3000):
        rows.append(rig.truth.copy())
        rig.write(np.zeros(1))
    return np.array(rows)


@pytest.mark.parametrize("kind", KINDS)
def test_readings_may_be_made_of_anything_but_not_of_another_number(
    kind: Callable[[ut.Mechanism], Estimator], arm: ut.Mechanism
) -> None:
    """Lists, single precision; one too many once ended the process, an infinity the estimate."""
    expected = None
    makes: tuple[Any, ...] = np.array, list, np.float32
    for make in makes:
        estimator = kind(arm)
        estimator.reset([0.0, 0.25, 0.0, 0.0])
        for k in range(3):
            x = estimator.estimate(Measurement(k * PERIOD, make([0.0, 0.25])), make([0.5])).copy()
        expected = x if expected is None else expected
        np.testing.assert_array_equal(x, expected)
    for k in range(3, 6):
        estimator.estimate(Measurement(k * PERIOD, np.array([0.0, math.inf])), np.zeros(1))
    assert np.isfinite(estimator.estimate(Measurement(6e-3, x[:2]), np.zeros(1))).all()
    for q in ([0.0, 0.25, 0.0], [0.0], 0.25, [[0.0, 0.25]]):
        with pytest.raises(
            InvalidInputError, match=r"measured q: got shape .*must be shape \(2,\)"
        ):
            estimator.estimate(Measurement(7e-3, np.array(q)), np.zeros(1))


def test_inputs_of_another_number_are_refused(arm: ut.Mechanism) -> None:
    with pytest.raises(InvalidInputError, match="inputs written last"):
        KalmanFilter(arm).estimate(Measurement(0.0, np.zeros(2)), np.zeros(0))


def test_on_the_realistic_rig_the_model_is_worth_having(arm: ut.Mechanism) -> None:
    """Velocity errors in closed loop: Kalman filter < filtered derivative, super-twisting."""
    errors = {}
    x0 = arm.state(phi=0.35)
    for name, estimator in (
        ("derivative", FilteredDerivative(arm, time_constant=0.005)),
        ("twisting", SuperTwisting(arm, acceleration=100.0)),
        ("kalman", KalmanFilter(arm)),
    ):
        estimator.reset(x0)
        law = InnerLoop(arm, ut.first_surface(arm))
        rig = RealisticRig(srv02_rig(), x0, 1)
        record = run_recorded(rig, estimator, lambda t, x: law(x), 4.0)  # noqa: B023
        assert abs(record.truth[-1, 1]) < 0.02
        errors[name] = np.sqrt(np.mean((record.x - record.truth)[500:, 2:] ** 2))
    assert errors["kalman"] < 0.7 * min(errors["derivative"], errors["twisting"])


def test_measured_velocities_need_no_estimator(arm: ut.Mechanism) -> None:
    rig = IdealRig(arm)
    record = run_recorded(rig, Measured(arm), lambda t, x: np.zeros(1), 0.1)
    np.testing.assert_array_equal(record.x, record.truth)
    with pytest.raises(InvalidInputError, match="positions only"):
        Measured(arm).estimate(Measurement(0.0, np.zeros(2)), np.zeros(1))
    estimator, wrong = Measured(arm), np.array([np.nan, np.inf])
    estimator.reset([0.1, 0.2, 0.3, 0.4])
    x = estimator.estimate(Measurement(0.0, np.array([0.5, -np.inf]), wrong), np.zeros(1))
    np.testing.assert_array_equal(x, [0.5, 0.2, 0.3, 0.4])


def test_a_velocity_that_stays_away_is_no_state(arm: ut.Mechanism) -> None:
    """Its last value was taken for ever, and a run on it thrown out a second later."""
    estimator, none = Measured(arm), np.full(2, np.nan)
    for q, v in ((np.zeros(2), none), (none, none), (np.zeros(2), np.zeros(2))) * 2:
        for k in range(20):
            estimator.estimate(Measurement(1e-3 * k, q, v), np.zeros(1))
    lost = Measurement(0.1, np.zeros(2), np.array([0.0, np.nan]))
    for _ in range(20):
        estimator.estimate(lost, np.zeros(1))
    with pytest.raises(InvalidInputError, match=r"_dot: got no number for 0\.021 s"):
        estimator.estimate(lost, np.zeros(1))


def test_senseless_settings_are_refused(arm: ut.Mechanism) -> None:
    for make in (
        lambda: FilteredDerivative(arm, time_constant=0.0),
        lambda: SuperTwisting(arm, acceleration=[1.0, 2.0, 3.0]),
        lambda: KalmanFilter(arm, position_noise=-1.0),
        lambda: KalmanFilter(arm, delay=-1.0),
    ):
        with pytest.raises(InvalidInputError):
            make()
    name: Any = "arm"
    refused: list[tuple[Callable[[], Estimator], str]] = [
        (lambda: KalmanFilter(name), "mechanism of KalmanFilter: got 'arm'"),
        (lambda: Measured(name), "mechanism of Measured: got 'arm'"),
        (lambda: KalmanFilter(arm, belief=name), "belief of KalmanFilter: got 'arm'"),
        (lambda: KalmanFilter(arm, resolution=name), "resolution of KalmanFilter: got 'arm'"),
        (lambda: KalmanFilter(arm, delay=1e9), "delay of a Kalman filter: got 1e.12 periods"),
        (lambda: Measured(arm, longest_gap=math.nan), "longest gap of measured velocities"),
    ]
    for wrong, words in refused:
        with pytest.raises(InvalidInputError, match=words):
            wrong()


@pytest.mark.parametrize("kind", [Measured, FilteredDerivative, SuperTwisting, KalmanFilter])
def test_an_estimate_starts_from_a_state(arm: ut.Mechanism, kind: type[Estimator]) -> None:
    """Of 2n finite numbers: NaN stayed in the estimate for ever."""
    estimator = kind(arm)
    with pytest.raises(InvalidInputError, match=r"state 'phi' of .*got nan, must be a finite"):
        estimator.reset([0.0, math.nan, 0.0, 0.0])
    with pytest.raises(InvalidInputError, match=rf"state of '{arm.name}'"):
        estimator.reset([0.0, 0.0])


#: An estimator that knows of half a unit of disturbance.
def test_the_effort_of_a_run_is_that_of_its_inputs_held_from_sample_to_sample() -> None:
    """(40) of a stair: the last sample is held as long as the one before, a sole one not at all."""
    t, u = np.array([5.0, 5.1, 5.3]), np.array([[1.0], [2.0], [3.0]])
    nothing = np.full((3, 2), np.nan)
    assert Record(t, nothing, nothing, u, nothing).effort == pytest.approx(0.1 + 0.8 + 1.8)
    one = nothing[:1]
    assert Record(t[:1], one, one, u[:1], one).effort == 0


STILL: Any = SimpleNamespace(disturbance=np.array([0.5]))


@pytest.mark.parametrize("output", [[1.5], 1.5, np.array([[1.5]]), (1.5,)])
def test_a_controller_of_ones_own_returns_its_numbers_in_any_form(output: Any) -> None:
    """A list was an error of the compiler that was to take the disturbance off it."""
    steer = compensated(lambda _t, _x: output, STILL, np.array([10.0]))
    assert steer(0.0, np.zeros(4)).tolist() == [1.0]


@pytest.mark.parametrize(
    ("output", "word"),
    [([1.0, 2.0], r"2\.0\]"), ([math.nan], "nan"), (None, "None"), ("1", "'1'")],
)
def test_an_output_that_is_not_m_finite_numbers_is_refused(output: Any, word: str) -> None:
    steer = compensated(lambda _t, _x: output, STILL, np.array([10.0]))
    with pytest.raises(InvalidInputError, match=rf"output of a controller.*{word}"):
        steer(0.25, np.zeros(4))


class _AlphaBeta(Estimator):
    """A tracker of one's own, Benedict and Bordner's (1962): nothing of the library's but the face.

    Its errors are stated, so that the gate and the boundary layer count with them.
    """

    def reset(self, x0: np.typing.ArrayLike) -> None:
        self.x = np.array(x0, dtype=float)
        self.calls = 0

    def estimate(self, measurement: Measurement, u: np.ndarray) -> np.ndarray:
        n, h, alpha, beta = self.mechanism.n, self.period, 0.5, 0.5**2 / 1.5
        self.x[:n] += h * self.x[n:]
        error = np.where(np.isnan(measurement.q), 0.0, measurement.q - self.x[:n])
        self.x[:n] += alpha * error
        self.x[n:] += beta / h * error
        self.calls += 1
        return self.x

    def steady_covariance(self) -> np.ndarray:
        return np.diag([1e-12] * 2 + [1e-6] * 2)

    noise_covariance = steady_covariance


@pytest.mark.slow
@short_searches()
def test_an_estimator_of_ones_own_runs_on_a_rig_end_to_end(
    arm: ut.Mechanism, tmp_path: Path
) -> None:
    """It is all that a run asks for: first optimum, gate, slow loop, balance, verdict, replay."""
    made: list[_AlphaBeta] = []

    def make(mechanism: ut.Mechanism, bench: Bench) -> Estimator:
        made.append(_AlphaBeta(mechanism, bench.timing.period))
        return made[-1]

    cascade = ut.Cascade(arm, ut.objective_for(arm, "bench-energy"))
    rig, log = IdealRig(arm, arm.state(phi=0.2), PERIOD), tmp_path / "run.db"
    report = ut.run(cascade, rig, seconds=1.2, log=log, simulated=True, estimator=make, phi=0.2)
    assert str(report.verdict).startswith("balanced")
    assert max(one.calls for one in made if hasattr(one, "calls")) > 1000
    assert report.answers["applied"] > 5
    assert ut.replay(log, estimator=make).identical
    with pytest.raises(ArtefactError, match=r"own, must be.*replay\(path, estimator="):
        ut.replay(log)


def test_what_is_no_estimator_is_refused_at_the_door(arm: ut.Mechanism) -> None:
    class Alike:
        disturbance = np.zeros(1)

        def reset(self, x0: object) -> None: ...

        def estimate(self, measurement: Measurement, u: np.ndarray) -> np.ndarray:
            return np.zeros(4)

    for made in (Alike, lambda: _AlphaBeta.__new__(_AlphaBeta)):
        with pytest.raises(InvalidInputError, match=r"estimator of a run.*Derive your own"):
            Recipe(arm, start=(0, 0.1, 0, 0), estimator=lambda *_, made=made: made()).cascade  # noqa: B018


@pytest.mark.slow
@given(
    st.lists(st.floats(-1e300, 1e300), min_size=2, max_size=2),
    st.lists(st.floats(-1e300, 1e300), min_size=2, max_size=2),
)
def test_what_is_taken_off_keeps_to_its_share_and_to_the_limits(
    u: list[float], disturbance: list[float]
) -> None:
    limits, out = np.array([2.0, math.inf]), np.zeros(2)
    subtract_disturbance(np.array(u), np.array(disturbance), limits, out)
    assert abs(out[0]) <= 2.0
    free = min(max(u[0] - min(max(disturbance[0], -1.0), 1.0), -2.0), 2.0)
    assert out[0] == free
    assert out[1] == u[1] - disturbance[1]
