"""A surface bears the delay that is said, and no more; gates refuse what bears too little."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
import scipy.linalg

import undertow as ut
from undertow.base import InvalidInputError
from undertow.cascade import (
    CascadeState,
    cost_gate,
    derate_actuator,
    noise_share,
    robustness_gate,
)
from undertow.cascade.robustness import (
    BenchGate,
    DelayGate,
    _exponential,
    delay_margin,
    sticking_distance,
)
from undertow.closed_loop import Event
from undertow.law import InnerLoop, Plan
from undertow.objective import objective_for
from undertow.plants import Bench, RealisticRig, Timing, plausible_rig, srv02_rig
from undertow.runtime import controller_defaults
from undertow.runtime.controller_defaults import (
    NOISE,
    default_gate,
    estimator_for,
    reaching_for,
)

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
    assert refused.cost == pytest.approx(cost_gate(loop, old, old, x, 60.0).cost, rel=1e-12)


@pytest.mark.slow
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
    beam = ut.mechanisms.ball_and_beam()
    estimator = estimator_for(beam, plausible_rig(beam))
    law, P = reaching_for(estimator), estimator.steady_covariance()[:4, :4]
    surface = ut.first_surface(beam)
    thinner = ut.ReachingLaw(layer=float(np.max(law.layer)) / 2)
    assert noise_share(beam, surface, P, law) <= NOISE < noise_share(beam, surface, P, thinner)


@pytest.mark.slow
def test_where_no_layer_bears_the_delay_noise_decides(monkeypatch: pytest.MonkeyPatch) -> None:
    """The beam's layer is thick for its noise alone: it bears the delay at any thickness."""
    beam = ut.mechanisms.ball_and_beam()
    estimator = estimator_for(beam, plausible_rig(beam))
    law = reaching_for(estimator)
    assert law != ut.ReachingLaw()
    monkeypatch.setattr(controller_defaults, "delay_margin", lambda *_, **__: -1.0)
    assert reaching_for(estimator) == law


@pytest.mark.parametrize("period", [0.0005, 0.001, 0.002, 0.005, 0.01])
def test_the_boundary_layer_suits_the_samples(arm: ut.Mechanism, period: float) -> None:
    """Held for a whole period, the first surface bears the delay that its gate asks for."""
    estimator = estimator_for(arm, srv02_rig().with_timing(period=period))
    gate, law = default_gate(estimator), reaching_for(estimator)
    assert isinstance(gate, BenchGate)
    least = gate.late.least
    assert delay_margin(arm, ut.first_surface(arm), law, period=period) >= least - 1e-9
    assert least >= 2 * period


@pytest.mark.slow
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


def test_a_joint_sticks_until_the_others_are_off_by_what_is_said(arm: ut.Mechanism) -> None:
    """The arm held still by 2 V and by what was taken off for as much the other way before."""
    surface, strong = ut.first_surface(arm), ut.ReachingLaw(160.0, 0.8)
    off = sticking_distance(arm, surface, np.array([2.0]), strong)
    law = InnerLoop(arm, surface, strong)
    assert abs(law(arm.state(phi=1.02 * off))[0]) > 4.0 > abs(law(arm.state(phi=0.98 * off))[0])
    assert sticking_distance(arm, surface, np.zeros(1)) == 0.0
    for wrong in (np.zeros(2), np.array([np.nan])):
        with pytest.raises(InvalidInputError, match="disturbance that holds a joint"):
            sticking_distance(arm, surface, wrong)


@pytest.mark.slow
def test_while_friction_is_large_soft_surfaces_are_refused(arm: ut.Mechanism) -> None:
    """What is admitted without friction is not with 3 V; nor is a soft one kept."""
    objective = objective_for(arm, "bench-energy")
    cascade = ut.Cascade(arm, objective)
    soft, x = ut.Surface(-1, -0.3, 4.83, 13.0), arm.state(phi=0.02)
    proposal = ut.Proposal(Plan.of(soft), "converged", 0.0, 0.0, (), 1, 0.0, 1, 0.0)
    free = CascadeState(cascade.reserve[0], x=tuple(x))
    after, admission = cascade.apply_gate(free, proposal, x)
    assert admission.accepted
    assert after.surface == soft
    rough = replace(free, disturbance=(3.0,))
    after, admission = cascade.apply_gate(rough, proposal, x)
    assert not admission.accepted
    assert "sticks" in admission.reason
    assert after.plan == rough.plan
    failed = replace(proposal, plan=None, status="failed")
    after, admission = cascade.apply_gate(replace(rough, plan=Plan.of(soft)), failed, x)
    assert admission.accepted
    assert "in reserve" in admission.reason
    assert after.plan in cascade.reserve


@pytest.mark.parametrize("belief", ["usual", "exact"])
def test_a_derated_loop_moves_the_plant_with_weaker_motors(
    belief: Literal["usual", "exact"], arm: ut.Mechanism
) -> None:
    """Of an ensemble it is the believed plant alone; other kernels, of a plant given, say so."""
    objective, plan = ut.MinimumEnergy(), Plan.of(ut.first_surface(arm))
    loop = ut.Cascade(arm, objective, belief=belief).loop
    weak = derate_actuator(loop, 0.3)
    plant = arm.with_input_limit(*0.7 * arm.input_limits)
    given = ut.ClosedLoop(arm, objective, loop.reaching, plant=plant)
    whole = ut.ClosedLoop(arm, objective, loop.reaching)
    for phi in (0.6, 0.7, 0.9):
        x = arm.state(phi=phi)
        ends = [one.batch(x, plan, duration=0.2, terminal=0.0) for one in (weak, given, whole)]
        assert ends[0].event[0] == ends[1].event[0]
        assert ends[0].x == pytest.approx(ends[1].x, rel=1e-9, abs=1e-12)
        assert ends[0].x != pytest.approx(ends[2].x, rel=1e-3)


@pytest.mark.slow
def test_a_plan_that_is_lost_later_stays_while_one_in_reserve_can_take_over(
    arm: ut.Mechanism,
) -> None:
    """On one plausible plant it meets the singularity a second on: there is time to plan again."""
    cascade = ut.Cascade(arm, objective_for(arm, "bench-energy"), covariance=1e-8 * np.eye(4))
    soft, x = Plan.of(ut.Surface(-1, -0.32, 7.64, 39.6)), np.array([-3.04, -0.075, 0.34, 0.28])
    motion = cascade.loop.batch(x, soft)
    assert motion.event[0] == Event.SINGULAR
    assert motion.time[0] > 10 * cascade.period
    failed = ut.Proposal(None, "failed", np.inf, np.inf, (), 0, 0.0, 1, 0.0, "for the test")
    after, admission = cascade.apply_gate(CascadeState(soft, x=tuple(x)), failed, x)
    assert not admission.accepted
    assert after.plan == soft
    alone = ut.ClosedLoop(arm, cascade.objective).batch(x, soft).cost[0]
    assert after.predicted == pytest.approx(alone, rel=1e-3)
    assert cascade.loop.batch(x, cascade.reserve[0]).cost[0] > 2 * alone


@pytest.mark.slow
def test_a_plan_in_reserve_takes_over_where_the_one_in_use_falls(arm: ut.Mechanism) -> None:
    """From the state after a knock that a soft surface does not bear; an exact belief keeps it."""
    objective = objective_for(arm, "bench-energy")
    soft = Plan.of(ut.Surface(-1, -0.4, 12.0, 30.0))
    x = arm.state(theta=-0.27, phi=0.15, theta_dot=2.3, phi_dot=5.3)
    failed = ut.Proposal(None, "failed", np.inf, np.inf, (), 0, 0.0, 1, 0.0, "for the test")
    usual, exact = ut.Cascade(arm, objective), ut.Cascade(arm, objective, belief="exact")
    for cascade, stays in ((usual, False), (exact, True)):
        after, admission = cascade.apply_gate(CascadeState(soft, x=tuple(x)), failed, x)
        assert (after.plan == soft) == stays
        if not stays:
            assert after.plan in cascade.reserve
            assert np.isfinite(admission.cost)


def test_the_plans_in_reserve_are_one_feedback_near_the_target(arm: ut.Mechanism) -> None:
    cascade = ut.Cascade(arm)
    laws = [plan.laws(cascade.reaching)[0] for plan in cascade.reserve]
    near = [
        InnerLoop(arm, plan.surfaces[0], law).feedback()
        for plan, law in zip(cascade.reserve, laws, strict=True)
    ]
    for other in near[1:]:
        np.testing.assert_allclose(other, near[0], rtol=1e-6)
    assert [law.vector(1)[0] for law in laws] == [20.0, 40.0, 80.0, 160.0]
