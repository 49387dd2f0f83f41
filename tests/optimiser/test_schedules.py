"""Schedules of surfaces that follow the earliest arrival over all inputs."""

from __future__ import annotations

import math

import numpy as np
import pytest

import undertow as ut
from undertow.base import InvalidInputError
from undertow.law import Plan, stability_margin
from undertow.optimiser.fitting import fits
from undertow.optimiser.following import refined
from undertow.optimiser.open_loop import NODES, EarliestArrival, OpenLoopMotion

FREE = ut.DecisionVariables(reaching=True, schedule=0.1)


def cascade(name: str, **more: object) -> ut.Cascade:
    """A cascade for least time of a mechanism that is taken for the plant."""
    rig = getattr(ut.mechanisms, name)()
    return ut.Cascade(rig, ut.MinimumTime(), belief="exact", freedom=FREE, **more)  # type: ignore[arg-type]


def earliest(made: ut.Cascade) -> OpenLoopMotion:
    """The earliest arrival from the usual start, from the motion of a first plan."""
    rig, x = made.mechanism, made.mechanism.usual_start
    plain = ut.Cascade(rig, ut.MinimumTime(), belief="exact").optimiser
    first = next(iter(plain.improve(x)))
    assert first.plan is not None
    motion = plain.loop.simulate(x, first.plan, duration=first.cost)
    low, high = made.loop.objective.range_of(rig)
    found = EarliestArrival(rig, 0.01, low, high).improve(OpenLoopMotion.of(motion, first.cost))
    assert found is not None
    return found


@pytest.mark.parametrize("name", ["rotary_pendulum", "overhead_crane"])
def test_the_earliest_arrival_is_that_of_a_collocation(name: str) -> None:
    """Collocation shares no code with it: other transcription, other solver."""
    made = cascade(name)
    rig, found = made.mechanism, earliest(made)
    bound = ut.bound(rig, ut.MinimumTime(), rig.usual_start)
    assert 0.99 * bound.cost < found.time < 1.03 * bound.cost
    assert (np.abs(found.u) <= rig.input_limits * (1 + 1e-9)).all()
    assert np.linalg.norm(found.x[-1]) <= 0.01


def test_the_pieces_of_a_motion_join() -> None:
    """Integrated by SciPy from node to node, and bounds of states are kept."""
    from scipy.integrate import solve_ivp

    made = cascade("overhead_crane")
    rig, found = made.mechanism, earliest(made)
    piece = found.time / NODES
    for k in range(NODES):

        def rate(_: float, x: np.ndarray, k: int = k) -> np.ndarray:
            return np.concatenate([x[rig.n :], rig.accelerations(0.0, x, found.u[k])])

        end = solve_ivp(rate, (0, piece), found.x[k], rtol=1e-9, atol=1e-12).y[:, -1]
        assert np.allclose(end, found.x[k + 1], atol=2e-4 * np.abs(found.x).max())
    low, high = made.loop.objective.range_of(rig)
    assert math.isfinite(high[0])
    assert (found.x <= high + 1e-9).all()
    assert (found.x >= low - 1e-9).all()


@pytest.mark.parametrize("name", ["rotary_pendulum", "pendubot"])
def test_a_schedule_is_near_the_earliest_arrival(name: str) -> None:
    """A single surface with its reaching law takes 10 to 50 % longer."""
    made = cascade(name)
    x = made.mechanism.usual_start
    found = made.optimiser.propose(x)
    assert found.plan is not None
    assert len(found.plan.surfaces) > 3
    assert found.cost < 1.05 * earliest(made).time
    again = cascade(name).optimiser.propose(x)
    assert again.plan == found.plan
    last = found.plan.surfaces[-1]
    assert stability_margin(made.mechanism, last.vector[None])[0] > 0


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


@pytest.mark.parametrize("push", [0.0, 0.01, -0.01])
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


def test_two_inputs_that_switch_often_are_followed() -> None:
    """Six switchings in a fifth of a second; single surfaces take three times as long."""
    made = cascade("two_motor_three_link")
    answers = made.optimiser.improve(made.mechanism.usual_start)
    assert any(answer.cost < 0.25 for answer in answers)


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
    """The same path faster, and the other way round."""
    motion = earliest(cascade("rotary_pendulum"))
    for guess in (motion.faster(), motion.mirrored()):
        assert np.allclose(guess.x[0], motion.x[0])
        assert guess.x.shape == motion.x.shape
    assert motion.faster().time < motion.time
    assert np.allclose(motion.mirrored().mirrored().x, motion.x)


def test_times_are_refined() -> None:
    """All multiples of the period, and more while there are few."""
    assert refined([0.05], 0.1, 0.62, 0.002)[:4] == (0.0, 0.05, 0.1, 0.2)
    few = refined([], 0.1, 0.15, 0.002)
    assert len(few) == 6
    assert {0.0, 0.1} <= set(few)
    assert refined([], 0.1, 0.004, 0.002) == (0.0,)


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
    for made in (
        ut.Cascade(rig, ut.MinimumEnergy(), belief="exact", freedom=FREE),
        ut.Cascade(rig, ut.MinimumTime(), freedom=FREE),
    ):
        with pytest.raises(InvalidInputError, match="least time"):
            made.optimiser.propose(rig.usual_start)
