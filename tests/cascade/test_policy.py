"""Controllers as policies: what they do in our environments is what they do in our simulations."""

from __future__ import annotations

import pickle
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import undertow as ut
from undertow.base import InvalidInputError
from undertow.models import FloatArray

RIG = ut.mechanisms.rotary_pendulum()
GOAL = ut.objective_for(RIG, "effort", horizon=10.0)
SURFACE = ut.first_surface(RIG)
OTHER = ut.first_surface(ut.mechanisms.double_pendulum_on_a_cart())
FREE = RIG.with_input_limit(np.inf)
QUICK = ut.Plan((SURFACE,), reaching=(ut.ReachingLaw(200.0, 0.2),))


def play(policy: ut.Policy, env: Any, **start: float) -> tuple[float, float, str]:
    """Time, cost and end of an episode."""
    x, _ = env.reset(seed=0, options=start)
    state, cost, k = None, 0.0, 0
    while True:
        action, state = policy.predict(x, state)
        x, reward, terminated, truncated, info = env.step(action)
        cost, k = cost - reward, k + 1
        if terminated or truncated:
            return k * env.task.period, cost, info["event"]


def test_a_loop_as_a_policy_does_what_it_does_in_simulation() -> None:
    """Sampled in both: the environment's rewards add up to the cost of our own motion."""
    pytest.importorskip("gymnasium")
    loop = ut.ClosedLoop(RIG, GOAL, step=0.0025, zoh_steps=2)
    motion = loop.simulate(RIG.state(phi=0.4), SURFACE)
    time, cost, event = play(ut.policy(loop, SURFACE), ut.environment(RIG, GOAL), phi=0.4)
    assert event == motion.event.name == "REACHED"
    assert abs(time - motion.time) <= 0.005  # judged at the end of a step
    assert cost == pytest.approx(motion.cost, rel=1e-3)


def test_a_plan_s_later_surfaces_take_over_and_episodes_are_told_apart() -> None:
    later = ut.Plan((SURFACE, ut.Surface(-1, -0.5, 5, 10)), (0.0, 0.01))
    act = ut.policy(ut.ClosedLoop(RIG), later)
    x = np.stack([RIG.state(phi=0.1), RIG.state(phi=-0.1)])
    laws = [ut.SlidingModeLaw(RIG, s)(0.0, x).u / 15 for s in later.surfaces]
    state = None
    for k in range(4):
        action, state = act.predict(x, state)
        np.testing.assert_allclose(action, laws[k >= 2], rtol=1e-9)
    action, state = act.predict(x, state, episode_start=[True, False])
    np.testing.assert_allclose(action, [laws[0][0], laws[1][1]], rtol=1e-9)
    assert act.predict(x[0])[0].shape == (1,)


@pytest.mark.slow
@pytest.mark.parametrize("belief", ["exact", "usual"])
def test_a_cascade_as_a_policy_decides_learns_and_balances(belief: Any) -> None:
    """Not dearer than its own simulation by more than what sampling costs; what it has learnt."""
    pytest.importorskip("gymnasium")
    cascade = ut.Cascade(RIG, GOAL, belief=belief, cold=ut.Budget(512), warm=ut.Budget(128))
    run = cascade.simulate(phi=0.3)
    _, cost, event = play(ut.policy(cascade), ut.environment(RIG, GOAL), phi=0.3)
    assert event == "REACHED"
    assert cost < 1.1 * run.cost


def test_a_cascade_as_a_policy_arrives_within_the_horizon() -> None:
    """Its end receded from decision to decision, and with it the arrival, for a smooth cost."""
    pytest.importorskip("gymnasium")
    goal = replace(GOAL, horizon=1.5)
    cascade = ut.Cascade(RIG, goal, belief="exact", cold=ut.Budget(400), warm=ut.Budget(64))
    time, _, event = play(ut.policy(cascade), ut.environment(RIG, goal), phi=0.2)
    assert event == "REACHED"
    assert time <= 1.5


def test_a_policy_that_is_as_slow_as_decisions_decides_at_each_step() -> None:
    asked: list[float] = []
    cascade = ut.Cascade(
        RIG, GOAL, belief="exact", period=0.008, cold=ut.Budget(512), warm=ut.Budget(64)
    )

    class Watch:
        def propose(self, x: FloatArray, /, **rest: Any) -> ut.Proposal:
            asked.append(rest["computed_for"])
            return cascade.optimiser.propose(x, **rest)

    act, state = ut.policy(replace(cascade, planner=Watch()), period=cascade.period), None
    for _ in range(3):
        _, state = act.predict(RIG.state(phi=0.1), state)
    assert asked == pytest.approx([0.0, cascade.period, 2 * cascade.period])


def test_a_cascade_as_a_policy_learns_the_plant_that_it_meets() -> None:
    """From the environment's samples alone, inputs held; a hundredth of the error is left."""
    pytest.importorskip("gymnasium")
    belief = ut.Belief.relative(RIG, m=0.3)
    cascade = ut.Cascade(RIG, GOAL, belief=belief, cold=ut.Budget(256), warm=ut.Budget(64))
    heavier = RIG.with_parameters(m=1.2 * RIG.substitution[sym("m")])
    env, act = ut.environment(heavier, GOAL), ut.policy(cascade)
    x, _ = env.reset(options={"phi": 0.3})
    state: Any = None
    for _ in range(60):
        action, state = act.predict(x, state)
        x = env.step(action)[0]
    learnt = cascade.believed(state[0]._memory).substitution[sym("m")]
    assert learnt == pytest.approx(heavier.substitution[sym("m")], rel=0.002)


def test_what_a_policy_learns_calls_for_a_plan_before_the_first_is_due() -> None:
    """As in simulation: of a plant a quarter heavier the first samples tell enough."""
    pytest.importorskip("gymnasium")
    asked: list[float] = []
    cascade = ut.Cascade(RIG, GOAL, belief=ut.Belief.relative(RIG, m=0.3), cold=ut.Budget(64))

    class Watch:
        def propose(self, x: FloatArray, /, **rest: Any) -> ut.Proposal:
            asked.append(rest["computed_for"])
            return cascade.optimiser.propose(x, **rest)

    env = ut.environment(RIG.with_parameters(m=1.25 * RIG.substitution[sym("m")]), GOAL)
    act, state = ut.policy(replace(cascade, planner=Watch())), None
    x, _ = env.reset(options={"phi": 0.3})
    for _ in range(6):
        action, state = act.predict(x, state)
        x = env.step(action)[0]
    assert asked == pytest.approx([0.0, 0.02])


def sym(name: str) -> Any:
    return next(p.symbol for p in RIG.parameters if p.name == name)


def test_stable_baselines3_s_loop_over_a_vector_balances() -> None:
    """As its ``evaluate_policy`` calls it."""
    pytest.importorskip("gymnasium")
    envs = ut.vector_environment(RIG, GOAL, num_envs=3)
    act = ut.policy(ut.ClosedLoop(RIG), SURFACE)
    x, _ = envs.reset(seed=1)
    state: Any = None
    begins, reached = np.ones(3, dtype=bool), 0
    for _ in range(1500):
        action, state = act.predict(x, state=state, episode_start=begins, deterministic=True)
        x, _, terminated, truncated, _ = envs.step(action)
        begins = terminated | truncated
        assert not truncated.any()
        reached += int(terminated.sum())
    assert reached >= 3


@pytest.mark.parametrize(
    ("made", "said"),
    [
        (lambda: ut.policy(ut.ClosedLoop(RIG)), "surfaces of a policy"),
        (lambda: ut.policy(ut.Cascade(RIG), SURFACE), "surfaces of a policy"),
        (lambda: ut.policy(ut.ClosedLoop(RIG), OTHER), "n = 3, m = 1, must be n = 2, m = 1"),
        (lambda: ut.policy(ut.ClosedLoop(RIG), SURFACE, period=0.01), "below 2 ε/η = 0.01"),
        (lambda: ut.policy(ut.ClosedLoop(RIG), QUICK), "below 2 ε/η = 0.002"),
        (lambda: ut.policy(ut.Cascade(RIG), period=0.003), "a whole part of the cascade's"),
        (lambda: ut.policy(ut.ClosedLoop(RIG), SURFACE).predict(np.zeros((2, 4)), ()), "episodes"),
        # Its actions, inputs over their limits, were all 0.
        (lambda: ut.policy(ut.ClosedLoop(FREE), SURFACE), "an action of 1 is the whole input"),
    ],
)
def test_bad_arguments_are_refused(made: Any, said: str) -> None:
    with pytest.raises(InvalidInputError, match=said):
        made()


def test_a_policy_keeps_what_it_saw_where_the_observation_s_array_is_used_again() -> None:
    """Environments with ``copy=False`` fill the same array; what is learnt is about what was."""
    cascade = ut.Cascade(RIG, GOAL, belief="exact", cold=ut.Budget(64), warm=ut.Budget(64))
    seen = RIG.state(phi=0.1)
    _, (episode,) = ut.policy(cascade).predict(seen)
    seen[:] = np.nan
    (kept,) = vars(episode)["_x"]
    assert (kept == RIG.state(phi=0.1)).all()


def test_policies_can_be_pickled() -> None:
    act = ut.policy(ut.ClosedLoop(RIG, GOAL), SURFACE)
    x = RIG.state(phi=0.1)
    again = pickle.loads(pickle.dumps(act))
    assert (again.predict(x)[0] == act.predict(x)[0]).all()
