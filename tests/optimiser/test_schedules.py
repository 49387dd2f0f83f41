"""Schedules of surfaces: they follow the earliest arrival over all inputs, or save energy."""

from __future__ import annotations

import itertools
import math
from functools import cache

import numpy as np
import pytest

import undertow as ut
from support import rest_slow
from undertow.base import InvalidInputError
from undertow.bounds import bound
from undertow.law import Plan, stability_margin
from undertow.models import FloatArray
from undertow.optimiser.fitting import fits
from undertow.optimiser.following import Follower, refined
from undertow.optimiser.open_loop import NODES, EarliestArrival, OpenLoopMotion
from undertow.optimiser.task import EXACT

FREE = ut.DecisionVariables(reaching=True, schedule=0.1)


def cascade(name: str, **more: object) -> ut.Cascade:
    """A cascade for least time of a mechanism that is taken for the plant."""
    rig = getattr(ut.mechanisms, name)()
    return ut.Cascade(rig, ut.MinimumTime(), belief="exact", freedom=FREE, **more)  # type: ignore[arg-type]


@cache
def earliest(name: str) -> OpenLoopMotion:
    """The earliest arrival from the usual start, from the motion of the designed surface."""
    rig, goal = getattr(ut.mechanisms, name)(), ut.MinimumTime()
    motion = ut.ClosedLoop(rig, goal).simulate(rig.usual_start, ut.first_surface(rig))
    assert motion.event == ut.Event.REACHED
    low, high = goal.on(rig).range_of(rig)
    found = EarliestArrival(rig, 0.01, low, high).improve(OpenLoopMotion.of(motion, motion.time))
    assert found is not None
    return found


def test_surfaces_of_a_schedule_are_drawn_together_and_each_a_little_by_itself() -> None:
    space = cascade("rotary_pendulum").optimiser.space.at((0.0, 0.1, 0.2))
    drawn = space.steps(np.random.default_rng(2), np.full(4000, 0.5)).reshape(4000, 3, -1)
    together = drawn.mean(axis=1, keepdims=True)
    assert 0 < (drawn - together).std() < 0.5 * together.std()
    assert together.std() == pytest.approx(0.5, rel=0.1)


@pytest.mark.parametrize("most", rest_slow([50, 1000], 50))
def test_a_schedule_for_least_time_keeps_to_its_budget(most: int) -> None:
    """But for what checks an answer; of 50 rollouts 320 were spent, of 1000 1243."""
    rig = ut.mechanisms.rotary_pendulum()
    search = ut.Optimiser(
        ut.ClosedLoop(rig, ut.MinimumTime()), cold=ut.Budget(most), freedom=FREE, seed=0
    )
    assert search.propose(rig.state(phi=0.6)).evaluations <= most + 3 * EXACT


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["rotary_pendulum", pytest.param("overhead_crane", marks=pytest.mark.slow)]
)
def test_the_earliest_arrival_is_that_of_a_collocation(name: str) -> None:
    """Collocation shares no code with it: other transcription, other solver."""
    rig, found = getattr(ut.mechanisms, name)(), earliest(name)
    bound = ut.bound(rig, ut.MinimumTime(), rig.usual_start)
    assert 0.99 * bound.cost < found.time < 1.03 * bound.cost
    assert (np.abs(found.u) <= rig.input_limits * (1 + 1e-9)).all()
    assert np.linalg.norm(found.x[-1]) <= 0.01


def test_the_pieces_of_a_motion_join() -> None:
    """Integrated by SciPy from node to node, and bounds of states are kept."""
    from scipy.integrate import solve_ivp

    rig, found = ut.mechanisms.overhead_crane(), earliest("overhead_crane")
    piece = found.time / NODES
    for k in range(NODES):

        def rate(_: float, x: np.ndarray, k: int = k) -> np.ndarray:
            return np.concatenate([x[rig.n :], rig.accelerations(0.0, x, found.u[k])])

        end = solve_ivp(rate, (0, piece), found.x[k], rtol=1e-9, atol=1e-12).y[:, -1]
        assert np.allclose(end, found.x[k + 1], atol=2e-4 * np.abs(found.x).max())
    low, high = ut.MinimumTime().on(rig).range_of(rig)
    assert math.isfinite(high[0])
    assert (found.x <= high + 1e-9).all()
    assert (found.x >= low - 1e-9).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    ["rotary_pendulum", "pendubot"],
)
def test_a_schedule_is_near_the_earliest_arrival(name: str) -> None:
    """A single surface with its reaching law takes 10 to 50 % longer."""
    made = cascade(name)
    x = made.mechanism.usual_start
    found = made.optimiser.propose(x)
    assert found.plan is not None
    assert len(found.plan.surfaces) > 3
    assert found.cost < 1.05 * earliest(name).time
    last = found.plan.surfaces[-1]
    assert stability_margin(made.mechanism, last.vector[None])[0] > 0


@pytest.mark.slow
def test_another_cascade_finds_the_same_schedule() -> None:
    found, again = (
        made.optimiser.propose(made.mechanism.usual_start)
        for made in (cascade("rotary_pendulum"), cascade("rotary_pendulum"))
    )
    assert again.plan == found.plan


@pytest.mark.slow
def test_what_is_left_of_a_schedule_is_a_schedule() -> None:
    """Each multiple of the period is a time of it, so the promised cost never rises."""
    made = cascade("rotary_pendulum")
    run = made.simulate()
    plan = run.updates[0].proposal.plan
    assert plan is not None
    for k in range(math.ceil(run.time / 0.1)):
        assert min(abs(t - 0.1 * k) for t in plan.times) < 1e-9
    assert run.reached
    assert np.min(run.lemma3_slack) > -1e-9
    assert run.cost <= run.updates[0].predicted + 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("push", [0.0, -0.01, 0.01])
def test_a_pushed_schedule_is_led_back(push: float) -> None:
    """Its surfaces are moved together until they arrive again, within the budget of a period."""
    made = cascade("cart_pendulum")
    rig = made.mechanism
    state, _ = made.start(rig.usual_start)
    x = made.loop.simulate(rig.usual_start, state.plan, duration=0.2).x[-1].copy()
    most = np.abs(made.loop.simulate(rig.usual_start, state.plan).x).max(axis=0)
    x[rig.n :] += push * most[rig.n :]
    incumbent = state.plan.shifted(0.2)
    alone = made.loop.batch(x, incumbent, precise=True)
    kept = alone.time[0] if alone.reached[0] else math.inf
    second = made.optimiser.propose(x, incumbent=incumbent, sequence=1)
    assert second.plan is not None
    assert second.cost <= kept + 1e-9
    assert second.evaluations <= 1.1 * 16384 / rig.n
    motion = made.loop.simulate(x, second.plan, duration=second.cost)
    low, high = made.loop.objective.range_of(rig)
    arrival = EarliestArrival(rig, 0.01, low, high)
    floor = arrival.improve(OpenLoopMotion.of(motion, second.cost))
    assert floor is not None
    assert second.cost < 1.25 * floor.time
    assert push == 0.0 or second.cost < 0.5 * kept


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_two_inputs_that_switch_often_are_followed(seed: int) -> None:
    """Six switchings in a fifth of a second; single surfaces take three times as long."""
    made = cascade("two_motor_three_link", seed=seed)
    answers = made.optimiser.improve(made.mechanism.usual_start)
    assert any(answer.cost < 0.25 for answer in answers)


@pytest.mark.slow
def test_a_motion_with_a_part_of_the_inputs_keeps_to_it() -> None:
    """It leaves the rest for what follows it, and arrives later."""
    rig, whole = ut.mechanisms.rotary_pendulum(), earliest("rotary_pendulum")
    arrival = EarliestArrival(rig, 0.01, *ut.MinimumTime().on(rig).range_of(rig), part=0.75)
    guess = whole.with_inputs(0.75)
    assert np.allclose(guess.x[:, : rig.n], whole.x[:, : rig.n])
    assert np.allclose(guess.x[1:, rig.n :] * guess.time, whole.x[1:, rig.n :] * whole.time)
    found = arrival.improve(guess)
    assert found is not None
    assert np.abs(found.u).max() <= 0.75 * rig.input_limits[0] * (1 + 1e-9)
    assert whole.time < found.time < 1.5 * whole.time


def test_a_surface_is_found_again_from_its_motion() -> None:
    """With its own rate, inside the layer, what is fitted moves as what was simulated."""
    made = cascade("rotary_pendulum")
    rig, loop = made.mechanism, made.optimiser.loop
    surface, law = made.optimiser.anchor, ut.ReachingLaw(eta=4000.0, layer=100.0)
    plan = Plan((surface,), (0.0,), (law,))
    x = rig.state(phi=0.05)
    motion = loop.simulate(x, plan, duration=0.1, terminal=0.0)
    assert np.abs(motion.u).max() < rig.input_limits[0]
    qdd = np.array([rig.accelerations(0.0, x, u) for x, u in zip(motion.x, motion.u, strict=True)])
    found = fits(made.optimiser.space, surface, motion.x.T, qdd.T)
    vectors, gains = made.optimiser.space.decode(found)
    ends = loop.batch(x, vectors, reaching=gains, duration=0.1, terminal=0.0).x
    assert np.linalg.norm(ends - motion.x[-1], axis=1).min() < 1e-3 * np.abs(motion.x).max()


def test_guesses_elsewhere_begin_at_the_same_state() -> None:
    """The same path faster, with the velocities of that, and the other way round."""
    motion, n = earliest("rotary_pendulum"), 2
    for guess in (motion.faster(), motion.mirrored()):
        assert np.allclose(guess.x[0], motion.x[0])
        assert guess.x.shape == motion.x.shape
    sooner = motion.faster()
    assert sooner.time < motion.time
    assert np.allclose(sooner.x[:, :n], motion.x[:, :n])
    assert np.allclose(sooner.x[1:, n:] * sooner.time, motion.x[1:, n:] * motion.time)
    assert np.allclose(motion.mirrored().mirrored().x, motion.x)


def test_times_are_refined() -> None:
    """All multiples of the period, and more while there are few."""
    assert refined([0.05], 0.1, 0.62, 0.002)[:4] == (0.0, 0.05, 0.1, 0.2)
    few = refined([], 0.1, 0.15, 0.002)
    assert len(few) == 6
    assert {0.0, 0.1} <= set(few)
    assert refined([], 0.1, 0.004, 0.002) == (0.0,)


@pytest.mark.slow
@pytest.mark.parametrize(("d_e", "degrees"), [(0.073, 41.0), (0.04, 33.0)])
def test_several_surfaces_are_nearer_to_the_bound_of_energy(d_e: float, degrees: float) -> None:
    """A part of what one surface wastes remains, and each later decision keeps it or gains."""
    rig = ut.mechanisms.rotary_pendulum(d_e=d_e)
    x0, goal = rig.state(phi=ut.deg(degrees)), ut.MinimumEnergy(horizon=20.0)
    single, several = (
        ut.Cascade(rig, goal, belief="exact", freedom=freedom)
        for freedom in (ut.DecisionVariables(reaching=True), FREE)
    )
    least = bound(rig, goal, x0, intervals=200).cost
    one, _ = single.start(x0)
    run = several.simulate(x0)
    plan = run.updates[0].plan
    assert len(plan.surfaces) == 5
    assert plan.times[1] in (0.1, 0.2)
    wasted = several.loop.simulate(x0, plan).cost / least - 1.0
    assert wasted < min(0.5 * (one.predicted / least - 1.0), 0.01)
    assert run.reached
    assert run.cost / least - 1.0 < wasted + 1e-3
    later = [update.plan.times for update in run.updates if update.t < plan.times[-1]]
    assert all(len(a) >= len(b) for a, b in itertools.pairwise(later))


def test_surfaces_that_can_lead_anywhere_follow_the_motion_to_the_target() -> None:
    """Each moves the state along a straight line of its own: corners on the motion, end at home.

    From the start they break off after 0.08 s; all multiples of the period are corners even so.
    """
    rig, motion, period = ut.mechanisms.rotary_pendulum(), earliest("rotary_pendulum"), 0.1
    arrival = EarliestArrival(rig, 0.01, *ut.MinimumTime().on(rig).range_of(rig))
    rates = np.abs(motion.x).max(axis=0) / period

    def states(x: FloatArray, z: FloatArray, time: float) -> FloatArray:
        broken = time > 0.08 and np.array_equal(x, motion.x[0])
        return np.full(z.shape, np.inf) if broken else np.asarray(x + time * rates * z)

    follower = Follower(
        lambda count, before: np.zeros((count, 2 * rig.n)), lambda x, qdd: np.zeros((1, 2 * rig.n)),
        states, states, arrival, period, 0.002,
    )  # fmt: skip
    found = follower.follow(motion)
    assert found is not None
    z, times, end = found
    assert end / period == pytest.approx(round(end / period))
    multiples = period * np.arange(round(end / period))
    assert np.abs(np.subtract.outer(multiples, times)).min(axis=1).max() < 1e-9
    x, leads = motion.x[0], len({row.tobytes() for row in z})
    for k in range(leads - 1):
        x = states(x, z[k], times[k + 1] - times[k])
        assert np.linalg.norm(x - arrival.state_at(motion, times[k + 1])) <= 0.5 * arrival.radius
    last = [states(x, z[-1], t) for t in np.arange(0.002, end - times[leads - 1] + 1e-9, 0.002)]
    assert np.linalg.norm(last, axis=1).min() < arrival.radius


def test_where_all_motions_break_off_there_is_no_schedule() -> None:
    """And nothing is asked to be integrated exactly."""
    made = cascade("rotary_pendulum")
    motion, size = earliest("rotary_pendulum"), made.optimiser.space.size

    def broken(x: FloatArray, z: FloatArray, time: float) -> FloatArray:
        return np.full((len(z), len(x)), np.inf)

    def never(x: FloatArray, z: FloatArray, time: float) -> FloatArray:
        raise AssertionError("asked for")

    arrival = EarliestArrival(made.mechanism, 0.01, *made.loop.objective.range_of(made.mechanism))
    follower = Follower(
        lambda count, before: np.zeros((count, size)), lambda x, qdd: np.zeros((1, size)),
        broken, never, arrival, 0.1, made.loop.step,
    )  # fmt: skip
    assert follower.follow(motion) is None


def test_refusals() -> None:
    """Each names the value and what to write."""
    with pytest.raises(InvalidInputError, match="reaching=True, schedule="):
        ut.DecisionVariables(schedule=0.1)
    with pytest.raises(InvalidInputError, match="free reaching laws, no other times"):
        ut.DecisionVariables(reaching=True, times=(0.0, 0.1), schedule=0.1)
    with pytest.raises(InvalidInputError, match="schedule"):
        ut.DecisionVariables(reaching=True, schedule=-0.1)
    rig = ut.mechanisms.rotary_pendulum()
    with pytest.raises(InvalidInputError, match="whole part of the period"):
        ut.Cascade(rig, ut.MinimumTime(), belief="exact",
                   freedom=ut.DecisionVariables(reaching=True, schedule=0.07))  # fmt: skip
    free = ut.DecisionVariables
    for beyond in free(reaching=True, schedule=100.0), free(times=(0.0, 100.0)):
        with pytest.raises(InvalidInputError, match="100 s, must be 0 s to 60 s"):
            ut.Cascade(rig, ut.MinimumEnergy(horizon=60.0), freedom=beyond)
    with pytest.raises(InvalidInputError, match="least time"):
        ut.Optimiser(ut.Cascade(rig, ut.MinimumTime()).loop, freedom=FREE).propose(rig.usual_start)
