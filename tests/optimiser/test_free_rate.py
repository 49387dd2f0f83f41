"""Rates at which surfaces are reached: within their bounds, optimal near the target."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import sympy as sp
from scipy.linalg import solve_continuous_are

import undertow as ut
from support import rest_slow
from undertow.base import InvalidInputError
from undertow.cascade.reserve import stiffer
from undertow.cascade.robustness import sticking_distance
from undertow.law import ReachingLaw
from undertow.objective.objective import Names
from undertow.optimiser import DecisionVariables
from undertow.plants.bench import bench_for
from undertow.runtime import estimator_for, for_rig

RIG = ut.mechanisms.rotary_pendulum()
FREE = DecisionVariables(rate=True)
EFFORT = ut.objective_for(RIG, "effort")


@pytest.mark.slow
def test_near_the_target_a_free_rate_reaches_the_regulator_s_optimum() -> None:
    """xᵀPx of Riccati's equation, which no feedback goes below; three parameters stay above it."""
    crane = ut.mechanisms.overhead_crane()
    lin, limit = crane.linearise(), crane.input_limits[0]
    P = solve_continuous_are(lin.A, lin.input, 0.01 * np.eye(4), np.eye(1) / limit**2)
    x = crane.state(x=0.1)
    loop = ut.ClosedLoop(crane, ut.objective_for(crane, "effort"))
    given = ut.Optimiser(loop).propose(x, budget=ut.Budget(256)).cost  # more find no better
    free = ut.Optimiser(loop, freedom=FREE).propose(x).cost
    least = float(x @ P @ x)
    assert given > 1.1 * least
    assert 0.98 * least < free < 1.005 * least  # the motion ends at ‖x‖ = 0.01, a little to pay


def test_rates_keep_between_what_falls_and_the_given_law() -> None:
    """Gains stay, numbers far outside come back as the bound, and coordinates as themselves."""
    space = ut.Optimiser(ut.ClosedLoop(RIG, EFFORT), freedom=FREE).space
    assert space.rate
    assert space.size == 4
    z = np.random.default_rng(0).normal(0.0, 3.0, (64, 4))
    z[0, 3], z[1, 3] = -50.0, 50.0
    vectors, gains = space.decode(z)
    assert gains is not None
    rates = gains[:, 0, 0] / gains[:, 0, 1]
    falls = np.linalg.eigvals(RIG.linearise().A).real.max()
    assert (gains[:, 0, 0] == 20.0).all()
    assert rates[0] == rates.min() == pytest.approx(2 * falls)
    assert rates[1] == rates.max() == pytest.approx(200.0)
    others, same = space.decode(np.array([space.encode(space.plan(one)) for one in z]))
    assert same is not None
    np.testing.assert_allclose(others, vectors, rtol=1e-9)
    np.testing.assert_allclose(same, gains, rtol=1e-9)


def test_a_thick_layer_leaves_rates_no_room() -> None:
    """Then the search has the three parameters that it had."""
    slow = ut.ClosedLoop(RIG, EFFORT, reaching=ReachingLaw(layer=2.0))
    space = ut.Optimiser(slow, freedom=FREE).space
    assert not space.rate
    assert space.size == 3
    assert space.decode(np.zeros((1, 3)))[1] is None


def test_rates_go_with_no_free_reaching_law() -> None:
    """Which has its own."""
    with pytest.raises(InvalidInputError, match="reaching=True, rate=True"):
        DecisionVariables(reaching=True, rate=True)
    assert DecisionVariables(alpha_a=True, rate=True).plainer == DecisionVariables(rate=True)
    assert DecisionVariables(rate=True).plainer is None


@pytest.mark.parametrize(
    ("word", "freedom", "rate"),
    [
        ("effort", DecisionVariables(), True),
        ("effort", DecisionVariables(rate=False), False),
        ("effort", DecisionVariables(reaching=True), None),
        ("energy", DecisionVariables(), False),
        ("bench-energy", DecisionVariables(), False),
        ("bench-energy", FREE, True),
        ("time", DecisionVariables(), False),
        ("bench-time", DecisionVariables(), False),
    ],
)
def test_a_cascade_frees_rates_where_errors_cost_what_they_do_in_effort(
    word: str, freedom: DecisionVariables, rate: bool | None
) -> None:
    """With exact states and on a rig; what was chosen stays."""
    cascade = ut.Cascade(RIG, ut.objective_for(RIG, word), freedom=freedom)
    suited = for_rig(cascade, estimator_for(RIG, bench_for(RIG)))
    for one in (cascade, suited):
        assert one.freedom is freedom
        assert one.optimiser.freedom.rate is rate


@pytest.mark.slow
@pytest.mark.parametrize(("name", "belief"), [("overhead_crane", "exact"), ("acrobot", "usual")])
def test_a_cascade_costs_what_the_best_of_all_inputs_does(name: str, belief: Any) -> None:
    """By the bound's collocation; with the given rate it is 14 % above, and more."""
    pytest.importorskip("casadi")
    mechanism = ut.mechanisms.LIBRARY[name]()
    least = ut.bound(mechanism, ut.objective_for(mechanism)).cost
    cascade = ut.Cascade(mechanism, belief=belief, cold=ut.Budget(512), warm=ut.Budget(128))
    assert cascade.simulate().cost < 1.01 * least


@pytest.mark.parametrize(
    "name", rest_slow(["overhead_crane", "rotary_pendulum"], "rotary_pendulum")
)
def test_a_cost_of_one_s_own_frees_rates_where_it_weighs_every_coordinate(name: str) -> None:
    """A hundredth of the full input's cost for each unit of error, on cranes as on pendulums."""
    mechanism = ut.mechanisms.LIBRARY[name]()
    limit = mechanism.input_limits[0]

    def weighing(place: float, angle: float) -> ut.Objective:
        def stage(v: Names) -> sp.Expr:
            effort = (v.inputs[0] / limit) ** 2
            return effort + place * v.states[0] ** 2 + angle * v.states[1] ** 2

        return ut.Objective("own", stage)

    for place, angle, rate in ((0.01, 0.01, True), (0.02, 0.005, False), (0.0, 1.0, False)):
        cascade = ut.Cascade(mechanism, weighing(place, angle))
        assert cascade.optimiser.freedom.rate is rate


def test_a_plan_that_sticks_is_reached_faster_up_to_the_given_rate() -> None:
    """Twice as fast each time; the distance at which a joint sticks falls with it."""
    soft = ReachingLaw(20.0, 20.0 / 16.0)
    plan = ut.Plan((ut.Surface(-1, -1.59, 1.96, 12.1),), (0.0,), (soft,))
    plans = stiffer(plan, ReachingLaw())
    laws = [one.laws(soft)[0] for one in plans]
    rates = [float(eta[0] / layer[0]) for eta, layer in (law.per_surface(1) for law in laws)]
    assert rates == pytest.approx([32.0, 64.0, 128.0, 200.0])
    off = [sticking_distance(RIG, plan.surfaces[0], np.ones(1), law) for law in (soft, *laws)]
    assert off == sorted(off, reverse=True)
    assert off[-1] < 0.5 * off[0]
    assert stiffer(ut.Plan.of(plan.surfaces[0]), ReachingLaw()) == ()


def test_nothing_falls_while_a_load_hangs() -> None:
    """So no joint that sticks lets it: the crane's cart may stand, the pendulum's may not."""
    size = np.array([1.0])
    crane, cart = ut.mechanisms.overhead_crane(), ut.mechanisms.cart_pendulum()
    assert sticking_distance(crane, ut.first_surface(crane), size) == 0.0
    assert sticking_distance(cart, ut.first_surface(cart), size) > 0.0
