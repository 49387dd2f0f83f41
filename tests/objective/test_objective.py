"""Objectives: stage costs, terminal sets and constraints in the mechanism's own names."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
import sympy as sp

import undertow as ut
from support import interpreted, random_mechanism
from undertow.base import InvalidInputError
from undertow.models.importers import holding_input
from undertow.objective import Goal, objective_for
from undertow.objective.objective import Names, travel_box


def test_minimum_energy_is_the_sum_of_squared_inputs(rig: ut.Mechanism) -> None:
    """Φ = uᵀu, (40), for any number of inputs."""
    (voltage,) = rig.u
    assert ut.MinimumEnergy().stage_cost(rig) == voltage**2
    two = random_mechanism(4, 2)
    assert sp.expand(ut.MinimumEnergy().stage_cost(two) - sum(u**2 for u in two.u)) == 0


def test_state_weight_makes_the_energy_cost_obey_27_and_28(rig: ut.Mechanism) -> None:
    """Φ = uᵀu + w xᵀx is positive definite; without w it vanishes wherever u = 0 does."""
    weighted = ut.MinimumEnergy(state_weight=0.3).stage_cost(rig)
    expected = rig.u[0] ** 2 + 0.3 * sum(s**2 for s in rig.x)
    assert sp.expand(weighted - expected) == 0
    symbols = [*rig.x, *rig.u]
    smallest = {
        w: np.linalg.eigvalsh(
            np.array(
                sp.hessian(ut.MinimumEnergy(state_weight=w).stage_cost(rig), symbols), dtype=float
            )
        )[0]
        for w in (0.0, 0.3)
    }
    assert smallest[0.0] == 0.0
    assert smallest[0.3] == pytest.approx(0.6)


def test_minimum_time_costs_what_the_motion_lasts(rig: ut.Mechanism, quick: ut.Surface) -> None:
    """∫ 1 dt = t_f, (29): to rounding, although t_f lies inside a step."""
    assert ut.MinimumTime().stage_cost(rig) == 1
    way = ut.ClosedLoop(rig).simulate(rig.state(phi=0.3), quick, duration=1.0)
    late = way.x[-1]  # sliding home by now, ever closer
    radius = 0.9 * float(np.linalg.norm(late))
    loop = interpreted(ut.ClosedLoop(rig, ut.MinimumTime(terminal_radius=radius)))
    run = loop.simulate(late, quick, duration=0.1)
    assert run.event == ut.Event.REACHED
    assert 0 < run.time < 0.1
    assert run.cost == pytest.approx(run.time, rel=1e-12)


def test_the_compiled_stage_cost_is_the_formula() -> None:
    """Φ of a state and an input, parameters of another cost in it: as SymPy has it."""
    rig = ut.mechanisms.rotary_pendulum()
    goal = ut.Objective("work", lambda v: (v.voltage * v.theta_dot) ** 2 + v.m * v.phi**2)
    numbers = np.random.default_rng(3).normal(size=5)
    at = dict(zip([*rig.x, *rig.u], numbers.tolist(), strict=True)) | rig.substitution
    exact = float(goal.stage_cost(rig).subs(at))
    np.testing.assert_allclose(goal.stage_function(rig)(*numbers)[0], exact, rtol=1e-14)


def test_the_users_own_stage_cost_and_constraint_are_compiled_in(
    rig: ut.Mechanism, quick: ut.Surface
) -> None:
    """Any Φ(x, u) and w(x, u) ≤ 0 in names of states, inputs and parameters, (21) and (25)."""
    objective = ut.Objective(
        "own",
        lambda v: 2 * v.voltage**2 + v.m * v.phi_dot**2 + (v.states.T * v.states)[0],
        constraints=(ut.Constraint("sum", lambda v: v.voltage + 10 * v.phi - 60),),
    )
    theta, phi, w, p = rig.x
    expected = 2 * rig.u[0] ** 2 + sp.Symbol("m", real=True) * p**2 + theta**2 + phi**2 + w**2
    assert sp.expand(objective.stage_cost(rig) - expected - p**2) == 0
    (margin,) = objective.path_margins(rig)
    assert sp.expand(margin - (60 - rig.u[0] - 10 * phi)) == 0
    loop = interpreted(ut.ClosedLoop(rig, objective))
    x0 = rig.state(phi=0.3)
    batch = loop.batch(x0, [quick], duration=0.004)
    run = loop.simulate(x0, quick, duration=0.004)
    margins = 60 - run.u[:-1, 0] - 10 * run["phi"][:-1]
    assert batch.path[0, 0] == pytest.approx(margins.min(), rel=1e-12)
    x, u = run.x[:-1], run.u[:-1, 0]
    stage = 2 * u**2 + 0.125 * x[:, 3] ** 2 + (x**2).sum(1)
    assert batch.cost[0] == pytest.approx(stage.mean() * 0.004, rel=0.05)


def test_state_boxes_are_bounds_on_moduli(rig: ut.Mechanism) -> None:
    box = ut.state_box(theta=math.radians(60), phi_dot=8.0)
    assert [c.name for c in box] == ["|theta| ≤ 1.0472", "|phi_dot| ≤ 8"]
    objective = ut.Objective("boxed", lambda v: v.voltage**2, constraints=box)
    arm, rate = objective.path_margins(rig)
    at = {rig.x[0]: -1.2, rig.x[3]: 5.0}
    assert float(arm.subs(at)) == pytest.approx(math.radians(60) - 1.2)
    assert float(rate.subs(at)) == 3.0


def test_boxes_need_not_be_symmetric(rig: ut.Mechanism) -> None:
    """low ≤ state ≤ high: the margin is the distance to the nearer end, negative outside."""
    (bound,) = ut.state_box(phi=(-0.2, 0.6))
    assert bound.name == "-0.2 ≤ phi ≤ 0.6"
    (margin,) = ut.MinimumTime(constraints=(bound,)).path_margins(rig)
    found = [float(margin.subs(rig.x[1], phi)) for phi in (-0.3, -0.2, 0.0, 0.5, 0.7)]
    np.testing.assert_allclose(found, [-0.1, 0.0, 0.2, 0.1, -0.1], atol=1e-15)


def test_a_start_outside_is_refused_and_one_that_inputs_decide_is_not(rig: ut.Mechanism) -> None:
    """A margin that depends on the input is no reason to refuse a state."""
    box = ut.state_box(phi=0.2)
    with pytest.raises(InvalidInputError, match=r"\|phi\| ≤ 0.2.*-0\.1"):
        ut.MinimumTime(constraints=box).check_start(rig, rig.state(phi=0.3))
    ut.MinimumTime(constraints=box).check_start(rig, rig.state(phi=0.1))
    power = ut.Constraint("power", lambda v: (v.voltage + v.theta_dot) * v.theta_dot - 1)
    ut.MinimumTime(constraints=(power,)).check_start(rig, rig.state(theta_dot=2.0))


def test_a_constraint_that_the_input_at_the_target_breaks_is_refused() -> None:
    """What hangs on the input is held there by m g = 9.81 N: with less no motion ends there."""
    x, phi = ut.Coordinate("x", "m"), ut.Coordinate("phi")
    kinetic = x.velocity**2 / 2 + phi.velocity**2 / 2 + x.velocity * phi.velocity / 4
    hoist = ut.Mechanism.from_energies(
        "hoist", [x, phi], [ut.Input("force", "N", 20.0)], kinetic, 9.81 * x.symbol
    )
    weak, strong = (
        ut.MinimumTime(constraints=(ut.Constraint("pull", pull),))
        for pull in (lambda v: v.force - 9.0, lambda v: v.force - 10.0)
    )
    with pytest.raises(InvalidInputError, match=r"target x = 0.*'pull': got margin -0.81"):
        weak.check_start(hoist, hoist.state(phi=0.1))
    strong.check_start(hoist, hoist.state(phi=0.1))


def test_a_constraint_that_is_no_real_number_at_the_target_is_refused() -> None:
    """In a cascade, too, which prices the room that a constraint has there."""
    arm = ut.mechanisms.rotary_pendulum()
    late = ut.Constraint("late", lambda v: sp.sqrt(v.phi - 0.3) - 9)
    cascade = ut.Cascade(arm, ut.MinimumEnergy(constraints=(late,)))
    with pytest.raises(InvalidInputError, match=r"target x = 0.*'late': got margin nan"):
        cascade.start(arm.state(phi=0.4))


def test_a_start_where_a_constraint_is_no_number_is_refused(rig: ut.Mechanism) -> None:
    """ln(φ − 5) is complex below 5."""
    odd = ut.Constraint("odd", lambda v: sp.log(v.phi - 5))
    with pytest.raises(InvalidInputError, match="breaks 'odd': got margin nan, must be ≥ 0"):
        ut.MinimumTime(constraints=(odd,)).check_start(rig, rig.state(phi=0.1))


def test_between_tests_a_bound_is_passed_by_no_more_than_the_chord_allows(
    rig: ut.Mechanism, quick: ut.Surface
) -> None:
    """(h²/8) max |q̈|: what `Constraint` says of motions between the starts of steps, h apart."""
    fine = ut.ClosedLoop(rig, step=1e-4).simulate(rig.state(phi=0.3), quick, duration=0.6)
    swing = np.abs(fine["theta"])
    peak = int(np.argmax(swing))
    assert 0 < peak < len(swing) - 1
    rate = rig.accelerations(0.0, fine.x[:-1], fine.u[:-1])[:, 0]
    for stride in (20, 100, 400):  # tests every 2, 10 and 40 ms
        passed = [swing.max() - swing[first::stride].max() for first in range(stride)]
        allowed = (stride * 1e-4) ** 2 / 8 * np.abs(rate).max()
        assert 0 < max(passed) <= allowed


def test_names_are_states_inputs_and_parameters_and_nothing_else(rig: ut.Mechanism) -> None:
    v = Names(rig)
    assert (v.theta, v.phi_dot, v.voltage) == (rig.x[0], rig.x[3], rig.u[0])
    assert v.r_o == sp.Symbol("r_o", real=True)
    assert list(v.states) == list(rig.x)
    assert list(v.inputs) == list(rig.u)
    with pytest.raises(AttributeError, match=r"psi.*theta.*voltage"):
        _ = v.psi


REFUSALS: dict[str, tuple[Callable[[ut.Mechanism], object], str]] = {
    "unknown name in a stage cost": (
        lambda rig: ut.Objective("odd", lambda v: v.psi**2).stage_cost(rig),
        r"stage cost of 'odd' for 'rotary_pendulum'.*'psi'.*theta",
    ),
    "unknown name in a constraint": (
        lambda rig: ut.Objective(
            "odd", lambda v: 1, constraints=(ut.Constraint("far", lambda v: v.psi - 1),)
        ).path_margins(rig),
        r"constraint 'far' for 'rotary_pendulum'.*'psi'",
    ),
    "unknown state of a box": (
        lambda rig: ut.ClosedLoop(
            rig, ut.Objective("odd", lambda v: 1, constraints=ut.state_box(psi=1.0))
        ).batch(rig.state(phi=0.1), np.ones((1, 4))),
        r"\|psi\| ≤ 1.*'psi'.*theta",
    ),
    "foreign symbol": (
        lambda rig: ut.Objective("odd", lambda v: sp.Symbol("k") * v.phi).stage_cost(rig),
        r"stage cost of 'odd'.*k\*phi.*states and inputs",
    ),
    "more than one expression": (
        lambda rig: ut.Objective("odd", lambda v: v.states).stage_cost(rig),
        r"stage cost of 'odd'.*one expression",
    ),
    "cost that no motion changes": (
        lambda rig: ut.Objective("idle", lambda v: v.phi - v.phi).stage_cost(rig),
        r"got 0, must be a cost that depends.*lambda v: 1 for least time",
    ),
    "cost that can be negative": (
        lambda rig: ut.Objective("odd", lambda v: v.voltage * v.theta_dot).stage_cost(rig),
        r"stage cost of 'odd'.*-.*≥ 0",
    ),
    "cost that is no number everywhere": (
        lambda rig: ut.Objective("odd", lambda v: sp.sqrt(v.phi)).stage_cost(rig),
        r"stage cost of 'odd'.*nan",
    ),
    "negative bound": (lambda rig: ut.state_box(theta=-1.0), r"'theta'.*-1\.0.*> 0"),
    "interval without the target": (
        lambda rig: ut.state_box(theta=(0.1, 0.5)),
        r"'theta'.*\(0\.1, 0\.5\).*low < 0 < high",
    ),
    "NaN bound": (lambda rig: ut.state_box(theta=math.nan), r"'theta'.*nan.*finite"),
    "zero horizon": (lambda rig: ut.MinimumTime(horizon=0.0), r"horizon.*0\.0.*> 0"),
    "infinite horizon": (lambda rig: ut.MinimumTime(horizon=math.inf), r"horizon.*inf.*finite"),
    "negative terminal radius": (
        lambda rig: ut.MinimumEnergy(terminal_radius=-0.01),
        r"terminal_radius.*-0\.01.*> 0",
    ),
    "NaN terminal radius": (lambda rig: ut.MinimumEnergy(terminal_radius=math.nan), "nan.*finite"),
    "negative state weight": (
        lambda rig: ut.MinimumEnergy(state_weight=-0.1),
        r"state_weight.*-0\.1.*≥ 0",
    ),
}


@pytest.mark.parametrize("what", REFUSALS)
def test_bad_objectives_are_refused_with_value_limit_and_remedy(
    what: str, rig: ut.Mechanism
) -> None:
    attempt, message = REFUSALS[what]
    with pytest.raises(InvalidInputError, match=message) as caught:
        attempt(rig)
    assert caught.value.value is not None
    assert caught.value.limit is not None
    assert caught.value.remedy


def test_a_constraint_of_one_s_own_may_say_where_it_comes_from(rig: ut.Mechanism) -> None:
    """Whatever has a source was taken for declared travel, and dropped in silence."""
    cart = ut.mechanisms.cart_pendulum()
    mine = ut.Constraint("slow", lambda v: v.x_dot**2 - 4, source="data sheet, page 3")
    goal = ut.MinimumTime(constraints=(mine,))
    for once in (goal.on(cart), goal.on(cart).on(cart), ut.ClosedLoop(cart, goal).objective):
        assert once.constraints[0] is mine
        assert [c.name for c in once.constraints] == ["slow", "|x| ≤ 1.425 m"]
    assert goal.on(rig).constraints == (mine,)
    assert "slow: data sheet, page 3" in goal.meaning(cart)


@pytest.mark.parametrize("field", ["hard_input", "travel", "unit", "name"])
def test_every_field_of_an_objective_is_checked(field: str) -> None:
    """``hard_input="no"`` counted as yes, but for least energy, which checked all of its fields."""
    wrong = 3 if field in ("unit", "name") else "no"
    with pytest.raises(InvalidInputError, match=f"{field} of (Objective|MinimumTime)"):
        ut.MinimumTime(**{field: wrong})  # type: ignore[arg-type]
    given = {"name": "mine", "stage": lambda v: v.phi**2} | {field: wrong}
    with pytest.raises(InvalidInputError, match=f"{field} of Objective"):
        ut.Objective(**given)  # type: ignore[arg-type]


def test_energy_has_the_unit_of_the_inputs_that_it_is_of(rig: ut.Mechanism) -> None:
    """A cart's newtons were shown as V² s in titles, tables and reports, unless told otherwise."""
    cart = ut.mechanisms.cart_pendulum()
    for mechanism, unit in ((rig, "V² s"), (cart, "N² s"), (ut.mechanisms.acrobot(), "(N m)² s")):
        goal = ut.MinimumEnergy()
        assert goal.on(mechanism).unit == ut.ClosedLoop(mechanism).objective.unit == unit
        assert ut.objective_for(mechanism, "energy").unit == unit
        assert f"dt, {unit}, to" in goal.meaning(mechanism)
        assert goal.on(mechanism).on(cart).unit == unit
    assert ut.MinimumEnergy(unit="J").on(cart).unit == "J"
    motion = ut.ClosedLoop(cart).simulate(cart.state(phi=0.1), ut.first_surface(cart), duration=0.1)
    assert motion.cost_unit == motion.columns["cost"][1] == "N² s"


def test_only_declared_travel_is_put_anew(rig: ut.Mechanism) -> None:
    """A constraint of one's own stays, though it is a box with a source that knows its state by
    number; travel of another mechanism goes."""
    cart = ut.mechanisms.cart_pendulum()
    (travel,) = travel_box(cart)
    own = replace(travel, declared=False)
    kept = ut.MinimumTime(constraints=(own,), travel=False).on(cart)
    assert kept.constraints == (own,)
    assert ut.MinimumTime(constraints=(travel,)).on(rig).constraints == ()


def test_a_terminal_set_wider_than_the_range_is_refused() -> None:
    """Of a cart with 0.1 mm of travel any place counted as the target."""
    cart = ut.mechanisms.cart_pendulum()
    rail = replace(cart.coordinates[0], low=-1e-4, high=1e-4)
    small = replace(cart, coordinates=(rail, cart.coordinates[1]))
    with pytest.raises(InvalidInputError, match=r"terminal_radius.*at most 0\.00095"):
        ut.MinimumTime().on(small)
    assert ut.MinimumTime(terminal_radius=1e-5).on(small).constraints
    for name, make in ut.mechanisms.LIBRARY.items():
        mechanism = make()
        for goal in get_args(Goal):
            assert objective_for(mechanism, goal).on(mechanism), (name, goal)
    one_sided = replace(rail, low=0.0, high=1.0)  # the target is at its end: that is no fault
    assert ut.MinimumTime().on(replace(cart, coordinates=(one_sided, cart.coordinates[1])))


def test_a_constraint_that_excludes_the_target_is_refused_before_the_search(
    rig: ut.Mechanism,
) -> None:
    away = ut.Constraint("away", lambda v: 0.1 - v.theta, "rad")
    goal = ut.MinimumTime(constraints=(away,))
    with pytest.raises(InvalidInputError, match=r"target x = 0.*'away'.*margin -0\.1 rad"):
        goal.check_start(rig, rig.state(theta=0.3))


def test_the_room_of_a_constraint_on_the_input_is_that_of_the_held_target(
    rig: ut.Mechanism,
) -> None:
    """A rope that must not go slack would at u = 0, which is not the input at the target."""
    loaded = rig.disturbed({"theta": -0.02})
    (u,) = holding_input(loaded)
    taut = ut.MinimumEnergy(constraints=(ut.Constraint("taut", lambda v: 0.1 - v.voltage),))
    (margin,) = taut.guarded(loaded).path_margins(loaded)
    assert u > 0.1
    assert float(margin.subs({loaded.u[0]: u})) == pytest.approx(0.99 * (u - 0.1))


def test_a_box_of_more_than_a_turn_is_asked_about(rig: ut.Mechanism) -> None:
    """45 were 45 rad without a word; of lengths, velocities and wheels' turns nobody is asked."""
    box = ut.MinimumTime(constraints=ut.state_box(theta=45))
    with pytest.warns(UserWarning, match=r"45 rad, 2578°: write undertow.deg\(45\)"):
        box.on(rig)
    ut.MinimumTime(constraints=ut.state_box(theta=ut.deg(300), phi_dot=45)).on(rig)


def test_a_cost_is_asked_for_at_the_target(rig: ut.Mechanism) -> None:
    """Where most are least: one that is negative there alone passed at random places."""
    dent = ut.Objective("dent", lambda v: v.voltage**2 + v.phi**2 - 1e-6)
    with pytest.raises(InvalidInputError, match=r"stage cost of 'dent': got -1e-06"):
        dent.stage_cost(rig)
    pole = ut.Objective("pole", lambda v: 1 / v.theta**2)  # the cost of a motion from rest was NaN
    with pytest.raises(InvalidInputError, match=r"stage cost of 'pole': got nan"):
        pole.stage_cost(rig)


def test_what_is_said_of_an_effort_tells_of_inputs_without_a_limit() -> None:
    """Of two inputs, one of them unlimited, it read as if both counted in parts of their limits."""
    arm = ut.mechanisms.two_motor_three_link()
    bare = arm.with_input_limit(arm.inputs[0].limit, math.inf)
    name = arm.inputs[1].name
    for word in ("effort", "bench-time"):
        assert f" dt (u_max = 1 N m of {name}, without a limit), s, to" in (
            ut.objective_for(bare, word).meaning(bare)
        )
        assert "(u_max" not in ut.objective_for(arm, word).meaning(arm)
