"""Parameters learnt from motions that SciPy integrates, which knows nothing of the filter."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import sympy as sp
from scipy.integrate import solve_ivp

import undertow as ut
from undertow.base import InvalidInputError
from undertow.estimators import Belief
from undertow.estimators.belief import EVEN, LEAST, SLIP_OF_SURFACE, SLIPS, _signs
from undertow.law import LawLayout
from undertow.models import FloatArray, full_accelerations

SPREAD = {"m": 0.2, "l": 0.05, "I_e": 0.2, "a_e": 0.1, "d_e": 0.5}


@pytest.fixture(scope="module")
def belief() -> Belief:
    """The rotary pendulum, five parameters uncertain."""
    return Belief.relative(ut.mechanisms.rotary_pendulum(), **SPREAD)


def drawn(belief: Belief, rng: np.random.Generator) -> ut.Mechanism:
    """Return a plant from within the tolerances."""
    value = {p.name: p.value for p in belief.mechanism.parameters}
    changed = {k: value[k] + t * rng.uniform(-1, 1) for k, t in belief.tolerances.items()}
    return belief.mechanism.with_parameters(**changed)


def motion(
    plant: ut.Mechanism, rng: np.random.Generator, seconds: float = 0.2, period: float = 0.002
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return t, x, u of a motion under an input that wanders, by SciPy's DOP853."""
    size, shift = rng.uniform(1.0, 4.0, 3), rng.uniform(0.0, 6.0, 3)

    def u(t: FloatArray) -> FloatArray:
        waves = size * np.sin(np.multiply.outer(t, (9.0, 23.0, 51.0)) + shift)
        return np.asarray(waves.sum(axis=-1))

    def rate(t: float, x: FloatArray) -> FloatArray:
        return np.concatenate([x[2:], plant.accelerations(t, x, [u(np.asarray(t))])])

    t = np.arange(0.0, seconds + 1e-9, period)
    x0 = [0.0, rng.uniform(-0.6, 0.6), rng.uniform(-2, 2), rng.uniform(-2, 2)]
    run = solve_ivp(rate, (0, t[-1]), x0, "DOP853", t, rtol=1e-10, atol=1e-10)
    return t, run.y.T, u(t)[:, None]


def error(
    belief: Belief, offset: FloatArray, plant: ut.Mechanism, x: FloatArray, u: FloatArray
) -> float:
    """Root mean square of the accelerations that a believed plant gets wrong, rad/s²."""
    believed = belief.mechanism.with_values(belief.values(offset))
    return float(np.std(believed.accelerations(0.0, x, u) - plant.accelerations(0.0, x, u)))


def test_accelerations_are_learnt_within_a_fifth_of_a_second(belief: Belief) -> None:
    """On motions that were not learnt from, a tenth of the error is left in the median."""
    left = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        plant = drawn(belief, rng)
        estimate = belief.learn(belief.prior, *motion(plant, rng))
        _, x, u = motion(plant, rng)
        before = error(belief, belief.prior.offset, plant, x, u)
        left.append(error(belief, estimate.offset, plant, x, u) / before)
    assert np.median(left) < 0.1
    assert max(left) < 0.5


def test_pieces_are_as_good_as_the_whole(belief: Belief) -> None:
    """What ten pieces teach in turn is what the whole motion teaches."""
    rng = np.random.default_rng(3)
    plant = drawn(belief, rng)
    t, x, u = motion(plant, rng)
    whole = pieces = belief.prior
    whole = belief.learn(whole, t, x, u)
    for k in range(0, 100, 10):
        part = slice(k, k + 11)
        pieces = belief.learn(pieces, t[part], x[part], u[part])
    assert pieces.samples == whole.samples == 100
    assert np.abs(pieces.offset - whole.offset) == pytest.approx(0, abs=0.3)
    assert pieces.deviation == pytest.approx(whole.deviation, rel=0.2)
    _, y, v = motion(plant, rng)
    assert (
        error(belief, pieces.offset, plant, y, v)
        < 2 * error(belief, whole.offset, plant, y, v) + 0.3
    )


@pytest.mark.slow
def test_the_truth_is_as_far_off_as_the_deviations_say(belief: Belief) -> None:
    """Noise of the stated size on each velocity: errors are no larger than the deviations say."""
    ratios = []
    for seed in range(200):
        rng = np.random.default_rng(1000 + seed)
        plant = drawn(belief, rng)
        t, x, u = motion(plant, rng)
        noisy = x.copy()
        noisy[:, 2:] += rng.normal(0.0, 0.004 / np.sqrt(2), noisy[:, 2:].shape)
        estimate = belief.learn(belief.prior, t, noisy, u)
        truth = (plant.parameter_values - belief.mechanism.parameter_values)[belief.places]
        off = truth / belief._scale - estimate.offset
        ratios.append(off @ estimate.information @ off / len(off))
    assert 0.1 < np.mean(ratios) < 1.3
    assert np.mean(np.array(ratios) < 4.0) > 0.99


def test_a_plant_that_changes_is_followed(belief: Belief) -> None:
    """A pendulum that becomes a fifth heavier after half a second is believed to be so."""
    rng = np.random.default_rng(5)
    value = {p.name: p.value for p in belief.mechanism.parameters}
    light = belief.mechanism.with_parameters(m=0.85 * value["m"], I_e=0.85 * value["I_e"])
    heavy = belief.mechanism.with_parameters(m=1.15 * value["m"], I_e=1.15 * value["I_e"])
    estimate = belief.prior
    for plant in (light, light, light, heavy, heavy):
        estimate = belief.learn(estimate, *motion(plant, rng))
    _, x, u = motion(heavy, rng)
    assert error(belief, estimate.offset, heavy, x, u) < 0.3 * error(
        belief, belief.prior.offset, heavy, x, u
    )


def test_nothing_leaves_the_tolerances_that_they_explain(belief: Belief) -> None:
    """Of plants at their edge, estimate and members stay within, whatever noise says."""
    rng = np.random.default_rng(6)
    value = {p.name: p.value for p in belief.mechanism.parameters}
    edge = {k: value[k] + t * rng.choice([-0.99, 0.99]) for k, t in belief.tolerances.items()}
    t, x, u = motion(belief.mechanism.with_parameters(**edge), rng)
    x[:, 2:] += 0.004 * rng.standard_normal((len(t), 2))
    estimate = belief.learn(belief.prior, t, x, u)
    assert np.abs(estimate.offset).max() <= 1.0
    members = belief.ensemble(estimate)
    low, high = belief.values(-np.ones(5)), belief.values(np.ones(5))
    assert (members.values >= low - 1e-12).all()
    assert (members.values <= high + 1e-12).all()


def test_a_plant_beyond_its_tolerances_is_found_all_the_same(belief: Belief) -> None:
    """Twice the mass, within the intervals that parameters have: accelerations come out right."""
    rng = np.random.default_rng(6)
    value = {p.name: p.value for p in belief.mechanism.parameters}
    plant = belief.mechanism.with_parameters(m=2.0 * value["m"], I_e=2.0 * value["I_e"])
    t, x, u = motion(plant, rng)
    estimate = belief.learn(belief.prior, t, x, u)
    assert np.abs(estimate.offset).max() > 1.0
    kept = np.clip(estimate.offset, -1.0, 1.0)
    assert error(belief, estimate.offset, plant, x, u) < 0.1 * error(belief, kept, plant, x, u)
    for p, row in zip(belief.mechanism.parameters, belief.ensemble(estimate).values.T, strict=True):
        assert ((p.low < row) & (row < p.high)).all()


def test_the_design_of_the_ensemble(belief: Belief) -> None:
    """The estimate first; at the prior each parameter, and each pair, is as often high as low."""
    ensemble = belief.ensemble(belief.prior)
    members, nominal = ensemble.values, belief.mechanism.parameter_values
    assert (members[: 1 + SLIPS] == nominal).all()
    for errors in (ensemble.surface_errors, ensemble.state_errors):  # of the estimate, in pairs
        assert not errors[0].any()
        assert not errors[1 + SLIPS :].any()
        assert errors[1 : 1 + SLIPS].any(axis=1).all()
        assert errors.sum(axis=0) == pytest.approx(0.0, abs=1e-15)
    assert not ensemble.surface_errors[:, 0].any()  # α_a stays −1
    off = (members[1 + SLIPS :] - nominal)[:, belief.places] / belief._scale
    assert np.abs(off) == pytest.approx(np.sqrt(1 / 3 + 0.2**2))
    assert off.T @ off == pytest.approx(len(off) * np.eye(5) * (1 / 3 + 0.2**2), abs=1e-12)


def test_what_is_known_weighs_more(belief: Belief) -> None:
    """Corners count as the estimate's own uncertainty does; the margin around it costs nothing."""
    before = belief.ensemble(belief.prior).shares
    estimate = slice(0, 1 + SLIPS)
    assert before[estimate].sum() == pytest.approx(1 - EVEN**2 / (EVEN**2 + LEAST**2))
    assert np.ptp(before[1 + SLIPS :]) == 0
    known = replace(belief.prior, information=1e8 * np.eye(len(belief.tolerances)))
    after = belief.ensemble(known).shares
    assert after[estimate].sum() > 0.999
    assert after.sum() == pytest.approx(1.0)


def test_broken_samples_teach_nothing(belief: Belief) -> None:
    """NaN, or a single row: the estimate stays."""
    t, x, u = motion(belief.mechanism, np.random.default_rng(0))
    assert belief.learn(belief.prior, t[:1], x[:1], u[:1]) is belief.prior
    x[3, 2] = np.nan
    assert belief.learn(belief.prior, t, x, u) is belief.prior


def test_what_makes_no_belief() -> None:
    """Unknown names; tolerances that are not positive or leave what makes sense; noise; words."""
    rig = ut.mechanisms.rotary_pendulum()
    with pytest.raises(InvalidInputError, match="uncertain parameter"):
        Belief(rig, {"mass": 0.1})
    with pytest.raises(InvalidInputError, match="uncertain parameter"):
        Belief.relative(rig, mass=0.1)
    for tolerance in (0.0, -0.1, np.nan, 10.0):
        with pytest.raises(InvalidInputError, match="tolerance of"):
            Belief(rig, {"m": tolerance})
    with pytest.raises(InvalidInputError, match="noise"):
        Belief(rig, {"m": 0.01}, noise=0.0)
    with pytest.raises(InvalidInputError, match="confidence"):
        Belief(rig, {"m": 0.01}, confidence=-1.0)
    with pytest.raises(InvalidInputError, match="risk"):
        Belief(rig, {"m": 0.01}, risk="median")  # type: ignore[arg-type]
    with pytest.raises(InvalidInputError, match="another object"):
        ut.Cascade(rig, belief=Belief(ut.mechanisms.rotary_pendulum(), {"m": 0.01}))


def test_noise_has_the_scale_of_each_coordinate() -> None:
    """By default a part of what full inputs do in 2 ms; where they do nothing, a number."""
    rig = ut.mechanisms.overhead_crane()
    full = rig.accelerations(0.0, np.zeros(4), rig.input_limits)
    np.testing.assert_allclose(Belief(rig, {}).deviations, 1e-5 * np.abs(full), rtol=1e-12)
    assert Belief(ut.mechanisms.ball_and_beam(), {}).deviations[1] == 0.004
    np.testing.assert_array_equal(Belief(rig, {}, noise=0.01).deviations, [0.01, 0.01])


def test_an_input_without_a_limit_counts_as_one_unit() -> None:
    """What the full inputs do is finite, and that of one unit; so is the noise that follows."""
    cart = ut.mechanisms.cart_pendulum()
    one, unlimited = (Belief.usual(cart.with_input_limit(v)) for v in (1.0, math.inf))
    full = [full_accelerations(belief.mechanism) for belief in (one, unlimited)]
    np.testing.assert_allclose(full[0], full[1])
    np.testing.assert_allclose(unlimited.deviations, one.deviations)


@pytest.mark.parametrize("make", [lambda m: ut.Belief(m, {"m": 5.0}), ut.Belief.usual])
def test_a_tolerance_that_leaves_no_mechanism_is_refused(
    make: Callable[[ut.Mechanism], ut.Belief],
) -> None:
    """A negative mass was one of the plausible plants where a parameter has no interval."""
    x, p = ut.Coordinate("x", "m"), ut.Coordinate("p")
    mass = ut.Parameter("m", 0.2, "kg", tolerance=5.0)
    kinetic = x.velocity**2 + mass.symbol * (
        (x.velocity + 0.5 * sp.cos(p.symbol) * p.velocity) ** 2
        + (0.5 * sp.sin(p.symbol) * p.velocity) ** 2
    )
    rig = ut.Mechanism.from_energies(
        "cart", [x, p], [ut.Input("force", "N", 10.0)], kinetic,
        5 * mass.symbol * sp.cos(p.symbol), parameters=[mass],
    )  # fmt: skip
    with pytest.raises(InvalidInputError, match=r"tolerance of parameter 'm'.*with m = -4\.8"):
        make(rig)
    assert ut.Belief(rig, {"m": 0.1}).tolerances == {"m": 0.1}


def test_errors_of_state_are_small_beside_the_travel() -> None:
    """The usual 0.2 mm would put every plausible motion of a small cart beyond its ends."""
    cart = ut.mechanisms.cart_pendulum()

    def slips(low: float, high: float) -> FloatArray:
        rail = replace(cart.coordinates[0], low=low, high=high)
        moved = replace(cart, coordinates=(rail, cart.coordinates[1]))
        belief = Belief.usual(moved)
        most: FloatArray = np.abs(belief.ensemble(belief.prior).state_errors).max(axis=0)
        return most

    np.testing.assert_allclose(slips(-1.5, 1.5)[:2], [2e-4, 2e-3])
    np.testing.assert_allclose(slips(-1e-4, 3e-4)[:2], [1e-6, 2e-3])
    np.testing.assert_allclose(slips(0.0, 3e-4)[:2], [3e-6, 2e-3])


def test_small_errors_have_all_patterns_of_signs() -> None:
    """Any three of up to eight; and where there are more, no two always agree or disagree."""
    for rig in (ut.mechanisms.rotary_pendulum(), ut.mechanisms.double_pendulum_on_a_cart()):
        belief = Belief.usual(rig)
        ensemble = belief.ensemble(belief.prior)
        errors = np.hstack([ensemble.surface_errors[:, 1:], ensemble.state_errors[:, : rig.n]])
        signs = np.sign(errors[1 : 1 + SLIPS])
        assert signs.shape[1] <= 8
        for three in itertools.combinations(signs.T, 3):
            assert len({*zip(*three, strict=True)}) == 8
    many = _signs(16)
    together = many.T @ many / len(many)
    assert (np.abs(together - np.eye(16)) <= 0.5).all()


def test_errors_of_state_and_surface_come_in_pairs_of_one_size(belief: Belief) -> None:
    """The members after the estimate have them, with either sign; α_a, which only scales, none."""
    ensemble = belief.ensemble(belief.prior)
    half = SLIPS // 2
    for errors in (ensemble.surface_errors, ensemble.state_errors):
        np.testing.assert_array_equal(errors[1 : 1 + half], -errors[1 + half : 1 + SLIPS])
        assert not errors[0].any()
        assert not errors[1 + SLIPS :].any()
    alpha_a, *others = LawLayout(2, 1).blocks(ensemble.surface_errors)
    assert not alpha_a.any()
    for block in others:
        assert (np.abs(block[1 : 1 + SLIPS]) == SLIP_OF_SURFACE).all()


@pytest.mark.parametrize("t", [[0.1, 0.0], [0.0, math.nan]])
def test_nothing_is_learnt_from_rows_out_of_order(t: list[float]) -> None:
    belief = Belief.relative(ut.mechanisms.rotary_pendulum(), m=0.2)
    with pytest.raises(InvalidInputError, match="times of a motion to learn from"):
        belief.learn(belief.prior, t, np.zeros((2, 4)), np.zeros((2, 1)))


def test_of_a_held_input_nothing_is_learnt_that_is_not_so(belief: Belief) -> None:
    """SciPy integrates from one sample to the next; taken as straight, an input comes too early."""
    rig = belief.mechanism
    times = np.arange(0.0, 0.401, 0.002)
    u = 5.0 * np.sin(7.0 * times) + 4.0 * np.sin(45.0 * times + 1.0)
    states = [np.array([0.0, 0.4, 0.0, 1.0])]
    for held in u[:-1]:

        def rate(_: float, x: FloatArray, held: float = held) -> FloatArray:
            return np.concatenate([x[2:], rig.accelerations(0.0, x, [held])])

        states.append(solve_ivp(rate, (0, 0.002), states[-1], rtol=1e-10, atol=1e-10).y[:, -1])
    motion = times, np.array(states), u[:, None]
    learnt = belief.learn(belief.prior, *motion, held=True)
    assert learnt.samples == len(times) - 1
    assert np.abs(learnt.offset).max() < 0.01
    assert np.abs(belief.learn(belief.prior, *motion).offset).max() > 0.05
    t, x, v = (np.repeat(part[:1], 3, axis=0) for part in motion)  # no time passes
    assert belief.learn(belief.prior, t, x, v) is belief.prior
