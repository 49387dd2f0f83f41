"""Swing-up and catch: the formula's Lyapunov function falls; hand-over only where the law holds."""

from __future__ import annotations

import math
from dataclasses import astuple

import numpy as np
import pytest

import undertow as ut
from undertow.errors import ModelError
from undertow.rig import Bench, Push, RealisticRig, srv02_rig
from undertow.swing_up import CatchRegion, Gains, SwingUp, SwingUpAndCatch, _tried, hanging
from undertow.trials.trial import trial


@pytest.fixture(scope="module")
def arm() -> ut.Mechanism:
    return ut.mechanisms.rotary_pendulum()


@pytest.fixture(scope="module")
def region(arm: ut.Mechanism) -> CatchRegion:
    return CatchRegion(arm)


def test_the_lyapunov_function_of_the_swing_up_falls(arm: ut.Mechanism) -> None:
    """Fantoni and Lozano: dV/dt = −k_V q̇_a² with an input that does not clip."""
    free = arm.with_parameters(d_e=0.0).with_input_limit(1e9)
    gains = Gains(0.03, 0.05, 0.02)
    swing = SwingUp(free, (gains,))
    top = float(free.energy(np.zeros(4)))
    rng = np.random.default_rng(0)
    step = 1e-6

    def V(x: np.ndarray) -> float:
        missing = float(free.energy(x)) - top
        inertia, stiffness = gains.on_acceleration, gains.on_position
        return 0.5 * (missing**2 + inertia * float(x[2]) ** 2 + stiffness * float(x[0]) ** 2)

    for _ in range(50):
        x = rng.uniform(-1, 1, 4) * [2.0, math.pi, 3.0, 3.0]
        x[2:] += np.sign(x[2:])  # at rest it pushes instead
        qdd = free.accelerations(0.0, x, swing(x))
        rate = np.concatenate([x[2:], qdd])
        slope = (V(x + step * rate) - V(x - step * rate)) / (2 * step)
        assert slope == pytest.approx(-gains.on_velocity * x[2] ** 2, rel=1e-4, abs=1e-6)


def test_it_hangs_where_the_energy_is_lowest() -> None:
    assert hanging(ut.mechanisms.cart_pendulum()).tolist() == [0.0, math.pi, 0.0, 0.0]
    assert hanging(ut.mechanisms.pendubot()).tolist() == [math.pi, 0.0, 0.0, 0.0]
    with pytest.raises(ModelError, match="upright"):
        hanging(ut.mechanisms.overhead_crane())


def test_what_the_formula_does_not_cover_is_refused() -> None:
    with pytest.raises(ModelError, match="one input"):
        SwingUp(ut.mechanisms.two_motor_three_link(), (Gains(1, 1, 1),))


def test_the_catch_region_is_where_the_law_comes_home(
    arm: ut.Mechanism, region: CatchRegion
) -> None:
    """Inside: the loop it names arrives.  Outside, past the singularity (37): none does."""
    for angle in (5.0, 25.0, 35.0):
        x = arm.state(phi=ut.deg(angle))
        surface = region.surface(x)
        assert surface is not None
        assert region.loop.batch(x, surface).reached[0]
    assert region.surface(arm.state(phi=ut.deg(60))) is None
    assert region.surface(np.full(4, math.nan)) is None
    wide = CatchRegion(arm, spread=np.array([0.01, 0.3, 0.1, 3.0]))
    assert wide.surface(arm.state(phi=ut.deg(35))) is None


def test_turns_are_taken_off_freely_turning_joints_alone() -> None:
    cart = ut.mechanisms.cart_pendulum()
    region = CatchRegion(cart)
    offset = region.turns(np.array([7.0, 4 * math.pi + 0.1, 0.0, 0.0]))
    np.testing.assert_allclose(offset, [0.0, 4 * math.pi, 0.0, 0.0])


def test_from_hanging_to_balanced_and_again_after_a_knock(
    arm: ut.Mechanism, region: CatchRegion
) -> None:
    """On the realistic rig; at 6 s the pendulum is knocked off its feet."""
    bench = Bench(**{**vars(srv02_rig()), "pushes": (Push(6.0, "phi", 0.08),)})
    controller = SwingUpAndCatch(SwingUp.designed(arm), region)
    run = trial(arm, bench, lambda _: controller, hanging(arm), 14.0, 1)
    kinds = [what for _, what in controller.events]
    assert kinds[0] == "catch"
    assert controller.events[0][0] < 6.0
    assert "lost" in kinds
    assert kinds[-1] == "catch"
    final = run.record.truth[-1000:] - controller.offset
    assert np.abs(final[:, 1]).max() < ut.deg(2)
    assert np.abs(run.record.u).max() <= 15.0


@pytest.mark.slow
def test_the_cart_stays_on_its_track() -> None:
    from undertow.trials.upright import swing_trials

    result = swing_trials(ut.mechanisms.cart_pendulum(), seeds=5, seconds=12.0)
    assert sum(o.balanced for o in result.outcomes) == 5
    assert result.stops == 0


def test_nothing_moves_without_a_swing(arm: ut.Mechanism) -> None:
    """What the trial must overcome: with zero input the pendulum hangs."""
    rig = RealisticRig(srv02_rig(), hanging(arm), 0)
    for _ in range(2000):
        rig.write([0.0])
    assert abs(rig.truth[1] - math.pi) < 0.1


@pytest.mark.parametrize("name", ["rotary_pendulum", "cart_pendulum", "pendubot"])
def test_gains_that_were_tried_are_those_of_the_library(name: str) -> None:
    """A mechanism whose numbers change has a new fingerprint, and is searched for again."""
    mechanism = getattr(ut.mechanisms, name)()
    found = SwingUp.designed(mechanism)
    assert [list(astuple(gains)) for gains in found.gains] == _tried()[mechanism.fingerprint]
    other = mechanism.with_parameters(g=9.7)
    assert other.fingerprint not in _tried()
