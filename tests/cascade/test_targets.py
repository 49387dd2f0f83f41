"""Targets: a set-point is 0 seen from elsewhere, and a jump is a fresh start."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import undertow as ut
from undertow.base import InvalidInputError
from undertow.cascade import Admission, CascadeState
from undertow.cascade.simulation import legs_to, moments
from undertow.closed_loop import Event, Trajectory
from undertow.closed_loop.along_reference import simulate_along
from undertow.law import ReferenceMotion
from undertow.models import FloatArray
from undertow.runtime import Request, respond

CRANE = ut.mechanisms.overhead_crane()
#: Without its travel: about a target it has the formulas that it has about zero.
FREE = replace(CRANE, coordinates=(ut.Coordinate("x", "m"), CRANE.coordinates[1]))
JUMPS = ut.SetPoints([(0, {"x": 1.0}), (2, {"x": -1.0}), (4, {"x": 0.5})])


@pytest.fixture(scope="module")
def cascade() -> ut.Cascade:
    """Least energy within 8 s, with short searches."""
    objective = ut.MinimumEnergy(horizon=8.0, unit="N² s")
    return ut.Cascade(CRANE, objective, cold=ut.Budget(6144), warm=ut.Budget(96), belief="exact")


class Watch:
    """A planner that remembers when it was asked, s, and how much time it was given, s."""

    def __init__(self, own: ut.Optimiser) -> None:
        self.own, self.asked = own, list[tuple[float, float | None]]()

    def propose(self, x: FloatArray, /, **rest: Any) -> ut.Proposal:
        self.asked.append((rest["computed_for"], rest["horizon"]))
        return self.own.propose(x, **rest)


@pytest.fixture(scope="module")
def swinging(cascade: ut.Cascade) -> ut.Cascade:
    """Least energy within 3 s, without an end of the rail, to a large terminal set."""
    goal = replace(ut.objective_for(FREE, "bench-energy", horizon=3.0), terminal_radius=0.3)
    return replace(cascade, mechanism=FREE, objective=goal, cold=ut.Budget(512), period=0.5)


@pytest.fixture(scope="module")
def run(cascade: ut.Cascade) -> ut.Run:
    return cascade.simulate(CRANE.state(), target=JUMPS, duration=16.0)


def leg(run: ut.Run, begin: float, end: float) -> float:
    """The cost of a run between two times."""
    t, cost = run.trajectory.t, run.trajectory.accumulated_cost
    return float(np.interp(end, t, cost) - np.interp(begin, t, cost))


def test_a_run_that_stayed_at_its_target_does_not_say_that_it_arrived_at_the_end() -> None:
    """Its cost has come to rest by then; of one that ends on arrival it has not."""
    t = np.linspace(0.0, 8.0, 5)
    x, one = np.zeros((5, 2 * CRANE.n)), np.ones((5, 1))
    for last, when in ((2.0, "by"), (3.0, "at")):
        cost = np.array([0.0, 1.0, 2.0, 2.0, last])
        motion = Trajectory(CRANE, t, x, one, one, cost, one[:, 0], Event.REACHED, "s")
        assert f"reached {when} 8 s, cost {last:g}," in repr(ut.Run(motion, ()))


@pytest.mark.slow
def test_the_last_set_point_is_reached_and_held(run: ut.Run) -> None:
    """The load hangs still at the last set-point; travel was kept on the way, absolute."""
    x = run.trajectory.x
    assert run.reached
    assert run.time == pytest.approx(16.0)
    assert abs(x[-1, 0] - 0.5) < 0.01
    assert np.degrees(np.abs(x[run.trajectory.t > 14.0, 1]).max()) < 0.5
    assert np.abs(x[:, 0]).max() <= 0.95 * 1.5


@pytest.mark.slow
@pytest.mark.parametrize(("begin", "end", "goal"), [(0, 2, 1.0), (2, 4, -1.0), (4, 16, 0.5)])
def test_a_jump_costs_what_a_fresh_start_costs(
    cascade: ut.Cascade, run: ut.Run, begin: float, end: float, goal: float
) -> None:
    """From the state at the jump, taken off by hand: the same first prediction, the same cost."""
    at = int(np.searchsorted(run.trajectory.t, begin - 1e-9))
    wide = replace(CRANE, coordinates=(replace(CRANE.coordinates[0], low=-9, high=9),
                                       CRANE.coordinates[1]))  # fmt: skip
    by_hand = replace(cascade, mechanism=wide, objective=replace(cascade.objective, constraints=()))
    fresh = by_hand.simulate(run.trajectory.x[at] - CRANE.state(x=goal))
    (jump,) = (u for u in run.updates if u.t == pytest.approx(begin))
    assert jump.predicted <= 1.02 * fresh.updates[0].predicted
    assert leg(run, begin, end) <= 1.1 * leg(fresh, 0.0, end - begin)


@pytest.mark.slow
def test_a_jump_begins_a_new_task_for_lemma_3(run: ut.Run) -> None:
    """Slack is unknown at the jumps, and not negative elsewhere."""
    tasks = np.array([update.task for update in run.updates])
    assert sorted(set(tasks)) == [0, 1, 2]
    assert (np.isnan(run.lemma3_slack) == (np.diff(tasks) > 0)).all()
    assert np.nanmin(run.lemma3_slack) >= -1e-9


@pytest.mark.slow
def test_to_come_back_there_is_a_whole_horizon(swinging: ut.Cascade) -> None:
    """A load that swings in and out of the terminal set: each time it left, a task afresh."""
    watch = Watch(swinging.optimiser)
    swinging = replace(swinging, planner=watch)
    run = swinging.simulate(CRANE.state(theta_dot=1.0), target={"x": 0.0}, duration=5.0)
    assert [t for t, _ in watch.asked] == [update.t for update in run.updates]
    begun: dict[int, float] = {}
    for update, (t, horizon) in zip(run.updates, watch.asked, strict=True):
        left = 3.0 - (t - begun.setdefault(update.task, t))
        assert (horizon or 3.0) == pytest.approx(left)
    assert len(begun) >= 3


@pytest.mark.slow
def test_a_set_point_is_0_seen_from_elsewhere() -> None:
    """On a plant that changes on the way, too: early decisions, and an end on arrival."""
    rig = ut.mechanisms.rotary_pendulum()
    mass = next(p.value for p in rig.parameters if p.name == "m")
    plant = {0.0: rig.with_parameters(m=1.1 * mass), 0.31: rig.with_parameters(m=2 * mass)}
    cascade = ut.Cascade(rig, ut.MinimumEnergy(horizon=3.0))
    x, away, seen = rig.state(phi=0.5), rig.state(theta=2.0), []
    here = cascade.simulate(x, plant=plant)
    there = cascade.simulate(
        x + away, plant=plant, target={"theta": 2.0}, progress=lambda t, _: seen.append(t)
    )
    assert 0.31 in np.round(seen, 9)
    assert there.reached
    assert there.cost == pytest.approx(here.cost, rel=0.02)  # searches part at a last digit
    assert np.linalg.norm(there.trajectory.x[-1] - away) == pytest.approx(0.01, rel=1e-3)
    late = np.array([update.t for update in there.updates]) % cascade.period
    assert (np.minimum(late, cascade.period - late) > 1e-6).any()
    assert {update.task for update in there.updates} == {0}


@pytest.mark.slow  # two kernels of its own; a map about a target keeps within it, too
def test_what_takes_over_after_a_jump_keeps_within_the_travel_about_a_target_too() -> None:
    """It is what a cart with its rail moved by as much has at x = 0: 95 % of ±1.5 m less 1.2 m."""
    here = ut.mechanisms.cart_pendulum()
    rail, angle = here.coordinates
    moved = replace(rail, low=(-1.425 - 1.2) / 0.95, high=(1.425 - 1.2) / 0.95)
    there = replace(here, coordinates=(moved, angle))
    chosen = []
    for cart, x, to in ((here, 0.9, 1.2), (there, -0.3, 0.0)):
        goal = ut.objective_for(cart, "bench-time", horizon=10.0)
        cascade = ut.Cascade(cart, goal, belief="exact")
        begun = CascadeState(ut.Plan.of(cascade.optimiser.anchor))
        target = ReferenceMotion.at_rest(np.array([to, 0.0])) if to else None
        state = replace(begun, target=target)
        chosen.append(cascade.prepared(state, cart.state(x=x, phi=0.1)).after_jump)
    (slow, plans), (fast, others) = (zip(*some, strict=True) for some in chosen)
    assert plans == others
    assert slow == pytest.approx(fast, rel=1e-12)


@pytest.mark.slow
def test_what_takes_over_after_a_jump_is_chosen_by_its_size() -> None:
    """A small push is not met as a large one is: the cart would spend its whole input on it."""
    cart = ut.mechanisms.cart_pendulum()
    cascade = ut.Cascade(cart, ut.objective_for(cart, "effort"), cold=ut.Budget(256))
    x = cart.usual_start
    state, _ = cascade.start(x)
    assert cascade.after_jump(state, x) == cascade.reserve[-1]  # nothing was asked for before
    state = cascade.prepared(state, x)
    speeds, plans = zip(*state.after_jump, strict=True)
    assert list(speeds) == sorted(speeds)
    p = np.linalg.inv(cart.M(np.zeros(2)))[:, 1]  # by an impulse on the pendulum
    knock = np.concatenate([np.zeros(2), p / p[1]])
    for speed, plan in state.after_jump:
        assert cascade.after_jump(state, -0.99 * speed * knock) == plan
    assert cascade.after_jump(state, 2 * speeds[-1] * knock) == plans[-1]
    loop = cascade.loop_at(state)
    small = loop.batch(speeds[0] * knock, list(plans)).score(loop.objective.horizon)
    assert small[0] == small.min() < 0.9 * small[-1]


def test_what_takes_over_after_a_jump_is_chosen_anew_for_another_target(
    swinging: ut.Cascade,
) -> None:
    """It stayed what had been chosen on the way to the first target."""
    cascade, x = swinging, CRANE.state(theta=0.05)
    stale = ut.Plan.of(cascade.optimiser.anchor)
    memory = replace(CascadeState(stale), after_jump=((math.inf, stale),))
    there = ReferenceMotion.at_rest(np.array([0.5, 0.0]))
    answer = respond(cascade, Request(0.0, x, 0.0, memory, target=there))
    assert answer.jump
    assert answer.memory.after_jump != memory.after_jump
    afresh = replace(answer.memory, after_jump=())
    assert answer.memory.after_jump == cascade.prepared(afresh, x).after_jump


def test_the_pieces_of_a_run_leave_no_gap() -> None:
    """They begin where a decision is due, at a jump, and where the plant changes."""
    cascade = ut.Cascade(CRANE, ut.MinimumTime(horizon=2.0), period=0.05)
    legs = legs_to(cascade, ut.SetPoints([(0, {"x": 0.5}), (0.1234, {"x": 0.0})]), 0.333)
    assert [leg.begin for leg in legs] == pytest.approx([0.0, 0.124])
    marks = {0, 31, 101}
    pieces = list(moments(cascade, legs, marks))
    begins = np.array([t for _, t, _, _ in pieces])
    assert begins + [span for _, _, span, _ in pieces] == pytest.approx([*begins[1:], 0.333])
    assert np.isin([0.062, 0.202], begins.round(9)).all()
    due = [t for _, t, _, due in pieces if due]
    assert due == pytest.approx([0.0, 0.05, 0.1, *np.arange(0.124, 0.333, 0.05)])


def test_targets_are_refused_before_anything_moves(cascade: ut.Cascade) -> None:
    """Names, places where it cannot rest, velocities, travel: each with value, limit, remedy."""
    for target, words in (
        ({"x": 2.0}, "got x = 2 m, must be .x. ≤ 1.425 m: 95 % of the travel"),
        ({"y": 1.0}, "'y', must be one of x, theta"),
        ({"theta": 0.2}, "= 0.2, must be moved along x.*move_target.mechanism, theta=0.2"),
        ({"x_dot": 1.0}, "x_dot = 1, must be velocity 0.*Reference"),
        ({"x": float("nan")}, "nan"),
        (ut.SetPoints([(0, {"x": 1.0}), (3, {"x": -2.0})]), "at 3 s: got x = -2 m"),
    ):
        with pytest.raises(InvalidInputError, match=words):
            cascade.simulate(CRANE.state(), target=target)
        with pytest.raises(InvalidInputError, match=words):
            cascade.start(CRANE.state(), target, 3.0)
    with pytest.raises(InvalidInputError, match="all of its coordinates"):
        ut.Cascade(ut.mechanisms.pendubot(), belief="exact").start([0, 0, 0, 0], {"q_1": 0.1})
    with pytest.raises(InvalidInputError, match="got 5 s, must be before the end of the run, 4 s"):
        cascade.simulate(target=ut.SetPoints([(0, {"x": 1.0}), (5, {"x": 0.0})]), duration=4.0)
    with pytest.raises(InvalidInputError, match="each later than the one before"):
        ut.SetPoints([(1, {"x": 1.0}), (0, {"x": 2.0})])


def test_the_state_machine_takes_the_target_off(cascade: ut.Cascade) -> None:
    """With and without a target: the same plan, the same input, counted from elsewhere."""
    rig = ut.mechanisms.rotary_pendulum(d_e=0.025)  # no travel: nothing is about absolute places
    plain = ut.Cascade(
        rig, ut.MinimumTime(), cold=ut.Budget(6144), warm=ut.Budget(96), belief="exact"
    )
    x, away = rig.state(phi=0.3), rig.state(theta=2.0)
    old, new = plain.start(x)[0], plain.start(x + away, {"theta": 2.0})[0]
    assert new.plan == old.plan
    assert (plain.control(new, 0.0, x + away).u == plain.control(old, 0.0, x).u).all()
    mine, theirs = plain.propose(old, x, 0.1), plain.propose(new, x + away, 0.1)
    assert mine.plan == theirs.plan
    assert plain.apply_gate(old, mine, x)[1] == plain.apply_gate(new, theirs, x + away)[1]
    again, _ = plain.retarget(new, x + away, {"theta": 1.0}, 0.1)
    assert (again.sequence, again.since) == (1, 0.1)
    assert again.error(0.1, x + away) == pytest.approx(x + rig.state(theta=1.0))


@pytest.mark.slow
def test_constraints_are_about_absolute_positions() -> None:
    """A formula of one's own, too: the way to x = 1 keeps |x| ≤ 1.05 m, the error does not."""
    wall = ut.Constraint("wall", lambda v: v.x**2 - 1.05**2)
    objective = ut.MinimumEnergy(horizon=4.0, constraints=(wall,))
    short = ut.Cascade(CRANE, objective, cold=ut.Budget(6144), warm=ut.Budget(96), belief="exact")
    run = short.simulate(CRANE.state(x=-1.0), target={"x": 1.0})
    assert run.reached
    assert np.abs(run.trajectory["x"]).max() <= 1.05 + 1e-4


@pytest.mark.slow
def test_the_upright_pendulum_follows_a_sine_of_the_arm() -> None:
    """±45° at 0.5 Hz: from rest onto the reference, and then on it."""
    rig = ut.mechanisms.rotary_pendulum()
    reference = ut.Reference.sine(0.5, theta=ut.deg(45))
    cascade = ut.Cascade(rig, ut.objective_for(rig, "bench-time", horizon=6.0), belief="exact")
    run = cascade.simulate(rig.state(), target=reference, duration=6.0)
    assert run.reached
    late = run.trajectory.t > 4.0
    t, theta = run.trajectory.t[late], run.trajectory["theta"][late]
    assert np.degrees(np.abs(theta - ut.deg(45) * np.sin(np.pi * t)).max()) < 0.5
    assert np.degrees(np.abs(run.trajectory["phi"][late]).max()) < 9.0


@pytest.mark.slow
def test_the_gate_sees_the_reference_move(cascade: ut.Cascade) -> None:
    """A plan that the gate admits about the target at rest is refused where the way breaks it."""
    reference = ut.Reference.sine(0.2, x=1.2)
    state, proposal = cascade.start(CRANE.state(), reference)
    slow = ut.placed_surface(CRANE, [-0.2, -0.21, -0.22])
    other = replace(proposal, plan=ut.Plan.of(slow), sequence=1, computed_for=0.1)
    yes = replace(cascade, gate=lambda *_: Admission(True, "yes", 1.0))
    _, admission = yes.apply_gate(state, other, CRANE.state())
    assert not admission.accepted
    assert "along the reference" in admission.reason
    assert np.isfinite(admission.cost)


@pytest.mark.slow
def test_a_refusal_tells_what_the_plan_in_use_costs_along_the_reference(
    rig: ut.Mechanism, quick: ut.Surface
) -> None:
    """Not what the gate says of it about the target at rest."""
    cascade = ut.Cascade(
        rig, ut.MinimumTime(), belief="exact",
        gate=lambda *_: Admission(False, "no", 1.0),
    )  # fmt: skip
    target = ut.Reference.sine(0.5, theta=0.3).legs(rig, 4.0)[0][1]
    state, x = CascadeState(ut.Plan.of(quick), target=target), rig.state(phi=0.2)
    unstable = ut.Plan.of(replace(quick, lambda_u=-quick.lambda_u))
    answer = ut.Proposal(unstable, "converged", 0.0, math.inf, (), 0, 0.0, 1, 0.0)
    after, admission = cascade.apply_gate(state, answer, x, 4.0)
    assert not admission.accepted
    assert after.plan == state.plan
    motion = simulate_along(cascade.loop, x, state.plan, target, duration=4.0, start=0.0)
    assert after.predicted == admission.cost == pytest.approx(motion.cost)


def test_references_past_the_travel_are_refused(cascade: ut.Cascade) -> None:
    """With where and when they first do so most."""
    with pytest.raises(InvalidInputError, match=r"at 1.2\d? s: got x = 1.6 m, must be .x."):
        cascade.simulate(CRANE.state(), target=ut.Reference.sine(0.2, x=1.6), duration=5.0)


def test_the_travel_is_a_constraint_about_a_target_too() -> None:
    """Where it ends is as far from the target as it was from zero, less the target."""
    cascade = ut.Cascade(CRANE, ut.MinimumEnergy(horizon=8.0), belief="exact")
    (leg,) = legs_to(cascade, ut.SetPoints({"x": 1.0}), 8.0)
    (travel,) = cascade.about(cascade.loop, leg.target, 0.0).objective.constraints
    assert "1.425 m" in travel.name


@pytest.mark.slow  # a kernel of its own
def test_about_a_target_plausible_plants_have_their_errors_too() -> None:
    """Small ones of state and surface, which a belief adds: about x = 0 nothing is otherwise."""
    cart = ut.mechanisms.cart_pendulum()
    cascade, x = ut.Cascade(cart, ut.objective_for(cart, "effort", horizon=10.0)), cart.usual_start
    still = ReferenceMotion.at_rest(np.zeros(2))
    costs = [
        loop.batch(x, list(cascade.reserve)).cost
        for loop in (cascade.loop, cascade.about(cascade.loop, still, 0.0))
    ]
    assert costs[1] == pytest.approx(costs[0], rel=1e-9)


def test_each_target_is_seen_from_itself() -> None:
    """Of two targets in turn each has its own distance to the stops, of one set of formulas."""
    cascade = ut.Cascade(CRANE, ut.MinimumEnergy(horizon=8.0), belief="exact")
    legs = [legs_to(cascade, ut.SetPoints({"x": x}), 8.0)[0] for x in (1.0, -0.5, 1.0)]
    loops = [cascade.about(cascade.loop, leg.target, 0.0) for leg in legs]
    assert [loop.mechanism.parameter_values[-1] for loop in loops] == [1.0, -0.5, 1.0]
    assert [loop.mechanism.structure for loop in loops[1:]] == 2 * [loops[0].mechanism.structure]
    assert all(loop.objective is loops[0].objective for loop in loops)


@pytest.mark.parametrize("target", [None, ut.Reference.sine(0.5, theta=0.3)], ids=["0", "sine"])
def test_what_is_predicted_in_one_go_is_predicted_in_two(
    rig: ut.Mechanism, quick: ut.Surface, target: ut.Reference | None
) -> None:
    """Flows compose, whenever they begin; beside a target that moves, too."""
    cascade = ut.Cascade(rig, ut.MinimumTime(), belief="exact")
    motion = None if target is None else target.legs(rig, 4.0)[0][1]
    state, error = CascadeState(ut.Plan.of(quick), target=motion), rig.state(phi=0.2)
    halfway = cascade.predicted_error(state, error, 1.0, 1.2)
    later = cascade.predicted_error(state, error, 1.0, 1.5)
    assert np.linalg.norm(later - error) > 0.1
    assert cascade.predicted_error(state, halfway, 1.2, 1.5) == pytest.approx(later, rel=1e-5)


def test_what_was_reached_comes_to_rest() -> None:
    """What arrives for least energy hardly damps: once home another surface holds it."""
    cascade = ut.Cascade(FREE, ut.objective_for(FREE, "bench-energy", horizon=4.0), belief="exact")
    run = cascade.simulate(CRANE.state(x=0.2), target={"x": 0.0}, duration=9.0)
    assert run.reached
    assert np.linalg.norm(run.trajectory.x[-1]) < 0.1 * cascade.objective.terminal_radius
