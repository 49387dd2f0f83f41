"""Simulated rigs keep to mechanics: order, energy, stiction, delays; repeatable bit for bit."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import sympy as sp

import undertow as ut
from support import rest_slow
from undertow.base import InvalidInputError
from undertow.law import InnerLoop
from undertow.models import FloatArray
from undertow.plants import (
    Amplifier,
    Backlash,
    Bench,
    Encoder,
    Friction,
    IdealRig,
    Push,
    RealisticRig,
    Timing,
    plausible_rig,
    simulated,
    srv02_rig,
)
from undertow.plants.stepping import end_stops

COULOMB, BREAKAWAY = 0.03, 0.04


@pytest.fixture(scope="module")
def arm() -> ut.Mechanism:
    """The paper's rotary pendulum; hanging at rest it is an arm with a motor."""
    return ut.mechanisms.rotary_pendulum()


HANGING = [0.0, math.pi, 0.0, 0.0]


def _run(rig: RealisticRig, inputs: np.ndarray) -> np.ndarray:
    path = [rig.truth]
    for u in inputs:
        rig.write(np.atleast_1d(u))
        path.append(rig.truth)
    return np.array(path)


def test_an_ideal_rig_moves_like_the_sampled_closed_loop(
    arm: ut.Mechanism, base: ut.Surface
) -> None:
    x0, law = arm.state(phi=0.3), InnerLoop(arm, base)
    rig = IdealRig(arm, x0)
    for _ in range(1500):
        now = rig.read()
        assert now.v is not None
        rig.write(law(np.concatenate([now.q, now.v])))
    loop = ut.ClosedLoop(arm, step=0.001, zoh_steps=1)
    ideal = loop.simulate(x0, base, duration=1.5, terminal=0.0)
    np.testing.assert_allclose(rig.truth, ideal.x[-1], atol=1e-12)


@pytest.mark.parametrize("period", rest_slow([0.001, 0.01], 0.01))
def test_a_rig_with_a_fast_motor_moves_like_its_equations(period: float) -> None:
    """Damping that decays by thousands per second: Runge-Kutta's steps of a period blew up."""
    from scipy.integrate import solve_ivp

    cart = ut.mechanisms.cart_pendulum().with_parameters(b_c=4000.0).with_input_limit(1e4)
    rig = IdealRig(cart, cart.state(phi=0.1, x_dot=0.5), period)
    x = rig.truth
    for k in range(10):
        u = np.array([2000.0 * (-1) ** k])
        rig.write(u)

        def rates(_t: float, z: Any, u: FloatArray = u) -> Any:
            return np.append(z[2:], cart.accelerations(0.0, z, u))

        x = solve_ivp(rates, (0.0, period), x, "LSODA", rtol=1e-10, atol=1e-12).y[:, -1]
        np.testing.assert_allclose(rig.truth, x, rtol=1e-3, atol=1e-4)


def test_same_seed_same_bits_other_seed_other_motion(arm: ut.Mechanism) -> None:
    inputs = np.random.default_rng(5).normal(0.0, 5.0, 400)
    paths = [_run(RealisticRig(srv02_rig(), HANGING, seed), inputs) for seed in (3, 3, 4)]
    assert np.array_equal(paths[0], paths[1])
    assert not np.array_equal(paths[0], paths[2])


@pytest.mark.slow
def test_friction_takes_energy_and_never_gives_any() -> None:
    cart = ut.mechanisms.cart_pendulum(b_c=0.0, b_p=0.0)
    friction = {"x": Friction(0.3, 0.5), "phi": Friction(0.01, 0.02)}
    bench = Bench(cart, friction=friction, timing=Timing(0.001, steps=8))
    path = _run(RealisticRig(bench, cart.state(phi=2.0)), np.zeros(3000))
    energy = cart.energy(path)
    assert np.diff(energy).max() < 1e-6
    assert energy[-1] < energy[0] - 0.1
    without = _run(RealisticRig(replace(bench, friction={}), cart.state(phi=2.0)), np.zeros(3000))
    np.testing.assert_allclose(cart.energy(without), energy[0], rtol=1e-8)


def test_a_joint_sticks_below_breakaway_and_not_above(arm: ut.Mechanism) -> None:
    bench = Bench(arm, friction={"theta": Friction(COULOMB, BREAKAWAY)})
    a_e = next(p.value for p in arm.parameters if p.name == "a_e")
    held = _run(RealisticRig(bench, HANGING), np.full(2000, 0.99 * BREAKAWAY / a_e))
    assert not held[:, [0, 2]].any()
    moving = _run(RealisticRig(bench, HANGING), np.full(2000, 1.01 * BREAKAWAY / a_e))
    assert moving[-1, 0] > 1e-3


def test_sliding_stops_in_the_time_that_coulomb_friction_takes() -> None:
    """A cart with a rigid load: v(t) = v0 − F_c t / m exactly, then rest."""
    cart = ut.mechanisms.cart_pendulum(b_c=0.0, b_p=0.0, g=1e-9, J_p=1e6)
    bench = Bench(cart, friction={"x": Friction(0.7)})
    x0 = cart.state(x_dot=0.5)
    path = _run(RealisticRig(bench, x0), np.zeros(800))
    mass = 0.5 + 0.2
    np.testing.assert_allclose(path[:400, 2], 0.5 - np.arange(400) * 1e-3 * 0.7 / mass, atol=1e-5)
    assert path[-1, 2] == 0.0
    assert path[-1, 0] == pytest.approx(0.5**2 * mass / (2 * 0.7), rel=1e-3)


def test_stick_and_slip_need_a_breakaway_above_coulomb_friction() -> None:
    """A mass drawn slowly through a spring jerks if it breaks away late, else it glides."""
    cart = ut.mechanisms.cart_pendulum(b_c=0.0, g=1e-9, J_p=1e6)

    def standstill(breakaway: float) -> float:
        bench = Bench(cart, friction={"x": Friction(0.5, breakaway, 0.01, viscous=1.0)})
        rig, moving = RealisticRig(bench, cart.state()), []
        for k in range(8000):
            rig.write([50.0 * (0.02 * 1e-3 * k - rig.truth[0])])
            moving.append(rig.truth[2])
        return float(np.mean(np.array(moving[3000:]) == 0.0))

    assert standstill(1.0) > 0.3
    assert standstill(0.5) == 0.0


def test_end_stops_hold_without_a_rebound() -> None:
    cart = ut.mechanisms.cart_pendulum()
    rig = RealisticRig(Bench(cart), cart.state(phi=math.pi))
    path = _run(rig, np.full(1500, 15.0))
    assert path[:, 0].max() == cart.coordinates[0].high
    assert path[-1, 2] == 0.0
    assert rig.stops_hit > 0


@pytest.mark.parametrize("n", [1, 2, 3])
def test_a_stop_takes_what_runs_into_it_by_an_impulse_there_and_nothing_else(n: int) -> None:
    """M Δq̇ is of the joints outside alone, takes energy and never gives any; who turned back goes.

    Inertia matrices are drawn at random, coupled.
    """
    rng = np.random.default_rng(n)
    for _ in range(200):
        root = rng.standard_normal((n, n))
        inertia = root @ root.T + 0.1 * np.eye(n)
        x = rng.uniform(-1.5, 1.5, 2 * n)
        q, v = x[:n].copy(), x[n:].copy()
        mobility = np.asarray(np.linalg.inv(inertia).ravel(), np.float64)
        hits = end_stops(x, np.tile([-1.0, 1.0], (n, 1)), mobility)
        outside, outward = np.abs(q) > 1.0, q * v > 0.0
        np.testing.assert_array_equal(x[:n], np.clip(q, -1.0, 1.0))
        impulse = inertia @ (x[n:] - v)
        np.testing.assert_allclose(impulse[~outside], 0.0, atol=1e-10)
        assert x[n:] @ inertia @ x[n:] <= v @ inertia @ v + 1e-10
        if outside.sum() < 2:  # a second impact may set a joint going that has come to rest
            assert hits == (outside & outward).sum()
            assert not x[n:][outside & outward].any()
        if not (outside & outward).any() and outside.sum() < 2:
            np.testing.assert_array_equal(x[n:], v)


def test_an_input_acts_after_its_delay_and_a_reading_has_its_age(arm: ut.Mechanism) -> None:
    still = Bench(arm, timing=Timing(0.001, input_delay=0.003))
    path = _run(RealisticRig(still, HANGING), np.full(8, 5.0))
    assert np.abs(path[3, 2:]).max() < 1e-12
    assert path[4, 2] > 0.01
    late = Timing(0.001, measurement_delay=0.002)
    aged = RealisticRig(Bench(arm, tachometers={}, timing=late), HANGING)
    seen, true = [], []
    for _ in range(50):
        now = aged.read()
        assert now.v is not None
        true.append(aged.truth)
        seen.append(np.concatenate([now.q, now.v]))
        aged.write([5.0])
    np.testing.assert_array_equal(seen[2:], true[:-2])


def test_an_encoder_is_off_by_half_a_count_at_most(arm: ut.Mechanism) -> None:
    count = 2 * math.pi / 4096
    bench = Bench(arm, encoders={"theta": Encoder(count)})
    rig = RealisticRig(bench, HANGING, seed=2)
    errors = []
    for _ in range(500):
        now = rig.read()
        errors.append(now.q[0] - rig.truth[0])
        assert now.q[1] == rig.truth[1]
        rig.write([1.0])
    assert np.abs(errors).max() <= count / 2 * (1 + 1e-9)
    assert np.std(errors) == pytest.approx(count / math.sqrt(12), rel=0.15)


def test_lateness_is_bounded_and_does_not_add_up(arm: ut.Mechanism) -> None:
    rig = RealisticRig(Bench(arm, timing=Timing(0.001, jitter=2e-4)), HANGING)
    times = []
    for _ in range(2000):
        rig.write([0.0])
        times.append(rig.read().t)
    late = np.array(times) - 1e-3 * np.arange(1, 2001)
    assert late.min() >= 0.0
    assert 1.9e-4 < late.max() <= 2e-4


def test_a_push_changes_the_momentum_by_its_impulse(arm: ut.Mechanism) -> None:
    bench = Bench(arm, pushes=(Push(0.0102, "phi", 0.003),))
    path = _run(RealisticRig(bench, HANGING), np.zeros(11))
    momentum = arm.M(path[-1, :2]) @ path[-1, 2:]
    assert np.abs(path[10, 2:]).max() < 1e-12
    np.testing.assert_allclose(momentum, [0.0, 0.003], atol=5e-5)


@pytest.mark.parametrize("jitter", [0.0, 1e-4])
def test_every_push_comes_once(arm: ut.Mechanism, jitter: float) -> None:
    """Also where it falls on the border of two steps, whose times are rounded."""
    pushes = tuple(Push(k * 1e-3, "theta", 1e-6) for k in range(-1, 600))
    bench = Bench(arm.with_parameters(d_e=0.0), timing=Timing(0.001, jitter), pushes=pushes)
    last = _run(RealisticRig(bench, HANGING), np.zeros(601))[-1]
    momentum = arm.M(last[:2])[0] @ last[2:]
    assert momentum / 1e-6 == pytest.approx(600, abs=0.1)


def test_backlash_lets_the_motor_turn_before_the_joint(arm: ut.Mechanism) -> None:
    tight, loose = (
        _run(RealisticRig(Bench(arm, backlash=backlash), HANGING), np.full(60, 2.0))
        for backlash in ({}, {"theta": Backlash(0.02, 0.0017)})
    )
    crossing = math.sqrt(2 * 0.01 * 0.0017 / (0.1285 * 2.0))
    first = np.argmax(loose[:, 2] > 0) * 1e-3
    assert first == pytest.approx(crossing, abs=2e-3)
    assert 0 < loose[-1, 0] < tight[-1, 0]


def test_a_rotor_that_crosses_the_gap_brings_its_momentum_along() -> None:
    """Without friction a cart behind a gap has, once taken along, the speed F t/m exactly.

    Rotor and cart share their momentum when the force turns round, too; where dry friction
    stops the cart meanwhile it does not.
    """
    cart = ut.mechanisms.cart_pendulum(b_c=0.0, b_p=0.0, g=1e-9, J_p=1e6)
    mass, force = 0.5 + 0.2, 3.0
    bench = Bench(cart, backlash={"x": Backlash(0.01, 0.2)}, timing=Timing(0.001, steps=8))
    inputs = force * np.where(np.arange(300) < 150, 1.0, -1.0)
    loose = _run(RealisticRig(bench, cart.state()), inputs)
    momentum = np.concatenate([[0.0], np.cumsum(inputs)]) * 1e-3
    crossing = math.ceil(1e3 * math.sqrt(2 * 0.005 * 0.2 / force))
    assert loose[crossing - 2, 2] == 0.0
    np.testing.assert_allclose(loose[crossing + 1 : 150, 2], momentum[crossing + 1 : 150] / mass)
    # The way across the whole gap: the rotor alone is slowed down, the cart goes on.
    back = math.ceil(1e3 * math.sqrt(2 * 0.01 * 0.2 / force))
    np.testing.assert_allclose(loose[152 : 150 + back - 1, 2], loose[152, 2])
    np.testing.assert_allclose(loose[152 + back :, 2], momentum[152 + back :] / mass, atol=1e-9)


def test_the_amplifier_counts_clips_and_lags(arm: ut.Mechanism) -> None:
    bench = Bench(arm, amplifiers={"voltage": Amplifier(10.0, 0.5, 0.3, 0.002)})
    rig = RealisticRig(bench, HANGING)
    for u, final in ((12.0, 10.0), (0.29, 0.0), (1.3, 1.5), (-1.3, -1.5)):
        rig.write([u])
        assert abs(rig.applied[0] - final) > 0.1
        for _ in range(40):
            rig.write([u])
        assert rig.applied[0] == pytest.approx(final, abs=1e-3)


def test_parameters_and_the_hand_vary_within_what_is_declared(arm: ut.Mechanism) -> None:
    bench = srv02_rig()
    rigs = [RealisticRig(bench, arm.state(phi=0.6), seed) for seed in range(40)]
    names = [p.name for p in arm.parameters]
    ratio = np.array([r.mechanism.parameter_values for r in rigs]) / arm.parameter_values
    for name, column in zip(names, ratio.T, strict=True):
        width = bench.tolerance.get(name, 0.0)
        assert np.abs(column - 1).max() <= width + 1e-12
        assert np.abs(column - 1).max() >= 0.8 * width
    starts = np.array([r.truth[1] for r in rigs])
    assert np.std(starts) == pytest.approx(bench.hand["phi"], rel=0.4)


@pytest.mark.slow  # kernels of their own
@pytest.mark.parametrize("name", ["gantry_crane", "triple_pendulum_on_a_cart"])
def test_a_usual_bench_can_be_made_of_any_mechanism(name: str) -> None:
    mechanism = ut.mechanisms.LIBRARY[name]()
    rig = RealisticRig(plausible_rig(mechanism), seed=1)
    path = _run(rig, np.zeros((50, mechanism.m)))
    assert np.isfinite(path).all()


def test_the_friction_of_a_plausible_rig_is_of_what_drives_the_joint() -> None:
    """2 % of the inputs' limits, through B, in whatever order they come."""
    q = [ut.Coordinate(name, "m") for name in ("x", "y", "ride")]
    T, V = sum(c.velocity**2 for c in q) / 2, (q[2].symbol - q[0].symbol) ** 2 / 2
    inputs = [ut.Input("on_y", "N", 4.0), ut.Input("on_both", "N", 15.0)]
    B = sp.Matrix([[0, 2], [1, -1]])
    pair = ut.Mechanism.from_energies("pair", q, inputs, T, V, input_matrix=B)
    found = {name: part.coulomb for name, part in plausible_rig(pair).friction.items()}
    assert found == pytest.approx({"x": 0.02 * 30, "y": 0.02 * (4 + 15)})


def test_a_plausible_rig_has_the_parameters_that_are_known() -> None:
    """Gravity is known by its unit, not by its name; a tolerance below 3 % counts."""
    x, phi = ut.Coordinate("x", "m"), ut.Coordinate("phi")
    given = [
        ut.Parameter("a", 9.81, "m/s^2"),
        ut.Parameter("g", 5.0, "", "gear"),
        ut.Parameter("mass", 2.0, "kg", tolerance=0.02),
        ut.Parameter("bob", 0.5, "kg", tolerance=0.25),
        ut.Parameter("l", 0.3, "m", tolerance=0.0),
    ]
    a, gear, mass, bob, rod = (p.symbol for p in given)
    v, w = x.velocity, phi.velocity
    T = mass * v**2 / 2 + bob * (v**2 / 2 + rod * sp.cos(phi.symbol) * v * w + (rod * w) ** 2 / 2)
    V = bob * a * rod * sp.cos(phi.symbol)
    cart = ut.Mechanism.from_energies(
        "cart", [x, phi], [ut.Input("u", "N m", 4.0)], T, V,
        input_matrix=sp.Matrix([gear]), parameters=given,
    )  # fmt: skip
    assert plausible_rig(cart).tolerance == pytest.approx({"g": 0.03, "mass": 0.01, "bob": 0.03})


def test_a_copy_of_a_rig_goes_on_by_itself() -> None:
    """The same inputs give the same bits, noise and delays included, and leave the other alone."""
    bench = replace(srv02_rig(), tachometers={"theta": 0.01}, pushes=(Push(0.2, "phi", 0.001),))
    rig, inputs = RealisticRig(bench, seed=2), np.sin(np.arange(400.0))[:, None]
    _run(rig, inputs[:100])
    twin, before = rig.copied(), rig.truth
    path = _run(twin, inputs[100:])
    assert np.array_equal(rig.truth, before)
    assert np.array_equal(_run(rig, inputs[100:]), path)
    assert rig.read().q.tolist() == twin.read().q.tolist()


def test_a_rig_is_compiled_when_it_is_made(
    arm: ut.Mechanism, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its first period is as short as others: in a run it has to be kept; and it has not moved."""
    made: list[float] = []

    class Slow:
        signatures: tuple[object, ...] = ()

        def __call__(self, t: float, *_: object) -> None:
            made.append(t)

    monkeypatch.setattr(simulated, "stepping", lambda _: SimpleNamespace(advance=Slow()))
    rig = IdealRig(arm, HANGING)
    assert made == [0.0]
    assert rig.t == 0.0
    assert rig.truth.tolist() == HANGING


def test_numbers_carry_their_sources() -> None:
    bench = srv02_rig()
    groups = (bench.friction, bench.encoders, bench.amplifiers)
    parts = [bench, bench.timing, *(part for group in groups for part in group.values())]
    assert "4096" in bench.encoders["theta"].source
    assert all(part.source for part in parts)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda m: Bench(m, friction={"wheel": Friction()}), "friction of a bench"),
        (lambda m: Bench(m, tolerance={"a_e": 1.5}), "tolerance"),
        (lambda m: Friction(0.2, 0.1), "breakaway"),
        (lambda m: Encoder(-1.0), "resolution"),
        (lambda m: Timing(0.001, jitter=0.002), "jitter"),
        (lambda m: Timing(0.001, input_delay=3.0), "delay of a rig"),
        (lambda m: Backlash(0.1, 0.0), "inertia"),
        (
            lambda m: RealisticRig(Bench(m, backlash={"theta": Backlash(0.1, 1.0)})),
            "below the joint's own",
        ),
        (lambda m: RealisticRig(Bench(m), seed=-1), "seed"),
        (lambda m: RealisticRig(Bench(m)).write([math.nan]), "finite"),
    ],
)
def test_what_no_bench_has_is_refused(arm: ut.Mechanism, make: object, message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        make(arm)  # type: ignore[operator]


def test_a_knock_changes_momentum_once() -> None:
    """q̇⁺ = q̇ + M⁻¹ p at the next period, and nothing in the one after."""
    cart = ut.mechanisms.cart_pendulum()
    rig, other = (IdealRig(cart, cart.state(phi=0.2)) for _ in range(2))
    impulse = np.array([0.3, -0.02])
    rig.knock(impulse)
    for one in (rig, other):
        one.write([0.0])
    change = np.linalg.solve(cart.M([0.0, 0.2]), impulse)
    np.testing.assert_allclose((rig.truth - other.truth)[2:], change, rtol=2e-3)
    before = rig.truth
    rig.write([0.0])
    assert np.abs((rig.truth - before)[2:]).max() < 0.05 * np.abs(change).max()


def test_a_delay_is_shared_out_and_nothing_is_lost(arm: ut.Mechanism) -> None:
    """From a measurement to its effect it takes what was asked for, whatever stood there before."""
    bench = Bench(arm).with_timing(period=0.002, input_delay=0.004).with_delay(0.005)
    timing = bench.timing
    assert timing.input_delay + timing.measurement_delay == pytest.approx(0.005, rel=1e-15)
    assert min(timing.input_delay, timing.measurement_delay) > 0
    assert timing.period == 0.002


@pytest.mark.parametrize("u", [[1.0, 2.0], "a", None, [math.nan]])
def test_what_is_no_input_is_refused_by_a_rig(u: Any) -> None:
    rig = ut.mechanisms.rotary_pendulum()
    with pytest.raises(InvalidInputError, match=r"input written to a rig.*finite numbers"):
        IdealRig(rig, rig.state(phi=0.1)).write(u)
