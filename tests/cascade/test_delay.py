"""A surface bears the delay that is said, and no more; gates refuse what bears too little."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg

import undertow as ut
from undertow.base import InvalidInputError
from undertow.cascade import noise_share, robustness_gate
from undertow.cascade.robustness import DelayGate, _exponential, delay_margin
from undertow.law import InnerLoop, Plan
from undertow.objective import objective_for
from undertow.plants import Bench, RealisticRig, Timing, plausible_rig, srv02_rig
from undertow.runtime.controller_defaults import NOISE, estimator_for, reaching_for

#: Nearly singular (37): excellent on the model, enormous gains.
KEEN = ut.Surface(-1, -3.561, 1.051, 8.234)


@pytest.fixture(scope="module")
def arm() -> ut.Mechanism:
    return ut.mechanisms.rotary_pendulum()


@pytest.mark.parametrize("kind", ["calm", "keen"])
def test_the_sampled_loop_diverges_beyond_its_margin_and_not_before(
    arm: ut.Mechanism, kind: str
) -> None:
    surface = KEEN if kind == "keen" else ut.first_surface(arm)
    margin = delay_margin(arm, surface)

    def late(delay: float) -> float:
        timing = Timing(0.001, input_delay=delay, steps=2)
        rig = RealisticRig(Bench(arm, tachometers={}, timing=timing), arm.state(phi=1e-5))
        law = InnerLoop(arm, surface)
        for _ in range(4000):
            now = rig.read()
            assert now.v is not None
            rig.write(law(np.concatenate([now.q, now.v])))
        return float(np.abs(rig.truth).max())

    assert late(margin) < 1e-4
    assert late(margin + 0.001) > 1e-3


def test_the_feedback_is_that_of_the_law(arm: ut.Mechanism, base: ut.Surface) -> None:
    law = InnerLoop(arm, base)
    x = np.array([1e-4, -2e-4, 1e-3, 5e-4])
    demand = InnerLoop(arm, base)(x)
    np.testing.assert_allclose(law.feedback() @ x, demand, rtol=1e-4)


def test_gates_refuse_what_bears_too_little(arm: ut.Mechanism, base: ut.Surface) -> None:
    loop = ut.ClosedLoop(arm, ut.MinimumTime())
    old, keen, x = Plan.of(base), Plan.of(KEEN), arm.state(phi=0.1)
    refused = DelayGate(0.006)(loop, old, keen, x, 60.0)
    assert not refused.accepted
    assert "delay" in refused.reason
    assert DelayGate(0.001)(loop, old, keen, x, 60.0).accepted
    assert refused.cost == pytest.approx(float(loop.batch(x, base).cost[0]))


def test_what_an_estimator_does_not_know_comes_out_as_input(
    arm: ut.Mechanism, base: ut.Surface
) -> None:
    """The share is the spread of the law over errors drawn from P; near (37) it is too much."""
    P = estimator_for(arm, srv02_rig()).steady_covariance()[:4, :4]
    rng = np.random.default_rng(0)
    for surface in (base, KEEN):
        errors = rng.multivariate_normal(np.zeros(4), 1e-8 * P, 4000)
        demand = ut.SlidingModeLaw(arm, surface)(0.0, errors).demand
        share = noise_share(arm, surface, P)
        assert 1e4 * np.std(demand) / 15.0 == pytest.approx(share, rel=0.05)
    assert noise_share(arm, base, P) < 0.2 < noise_share(arm, KEEN, P)
    loop, x = ut.ClosedLoop(arm, ut.MinimumTime()), arm.state(phi=0.1)
    plans = Plan.of(base), Plan.of(KEEN)
    refused = robustness_gate(0.001, 0.0, covariance=P)(loop, *plans, x, 60.0)
    assert not refused.accepted
    assert "noise" in refused.reason
    assert robustness_gate(0.001, 0.0, covariance=P, noise=9.0)(loop, *plans, x, 60.0).accepted


@pytest.mark.slow
def test_the_boundary_layer_is_as_thick_as_the_sensors_need(arm: ut.Mechanism) -> None:
    """The paper's where that is quiet; else the thinnest that is, of halves."""
    assert reaching_for(estimator_for(arm, srv02_rig())) == ut.ReachingLaw()
    crane = ut.mechanisms.overhead_crane()
    estimator = estimator_for(crane, plausible_rig(crane))
    law, P = reaching_for(estimator), estimator.steady_covariance()[:4, :4]
    surface = ut.first_surface(crane)
    thinner = ut.ReachingLaw(layer=float(np.max(law.layer)) / 2)
    assert noise_share(crane, surface, P, law) <= NOISE < noise_share(crane, surface, P, thinner)


def test_a_weaker_motor_must_do(arm: ut.Mechanism) -> None:
    """Where the whole input is needed, a gate that wants a reserve refuses the plan."""
    edge = arm.state(phi=ut.deg(44))
    first = ut.first_surface(arm)
    loop = ut.ClosedLoop(arm, objective_for(arm, "bench-energy"))  # others have its kernels
    better = ut.Optimiser(loop).require(edge).plan
    assert better is not None
    old = Plan.of(first)
    assert robustness_gate(0.001, 0.0)(loop, old, better, edge, 60.0).accepted
    refused = robustness_gate(0.001, 0.2)(loop, old, better, edge, 60.0)
    assert not refused.accepted
    assert "less input" in refused.reason
    near = arm.state(phi=ut.deg(10))
    assert robustness_gate(0.001, 0.2)(replace(loop), old, old, near, 60.0).accepted


def test_senseless_periods_are_refused(arm: ut.Mechanism, base: ut.Surface) -> None:
    with pytest.raises(InvalidInputError, match="period"):
        delay_margin(arm, base, period=0.0)


def test_the_exponential_is_scipys() -> None:
    """200 matrices of norms from 10⁻⁴ to 10, and one of zeros."""
    rng = np.random.default_rng(0)
    for size in 10 ** rng.uniform(-4, 1, 200):
        A = size * rng.normal(size=(5, 5))
        exact = scipy.linalg.expm(A)
        np.testing.assert_allclose(_exponential(A), exact, atol=1e-11 * np.abs(exact).max())
    np.testing.assert_array_equal(_exponential(np.zeros((3, 3))), np.eye(3))
