"""Environments: Gymnasium's own checks, one and many alike, rewards and ends as they are stated."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import undertow as ut
from support import rest_slow
from undertow.base import InvalidInputError, MissingExtraError
from undertow.mechanisms import LIBRARY
from undertow.plants import Bench

gymnasium = pytest.importorskip("gymnasium")
import undertow.export.gym as ours  # noqa: E402 - after Gymnasium was found

RIG = ut.mechanisms.rotary_pendulum()
SOME = "rotary_pendulum"


def test_the_library_is_registered_without_compiling_anything() -> None:
    ids = {name for name in gymnasium.registry if name.startswith("undertow/")}
    kinds = ("", "_realistic")
    assert ids == {f"undertow/{name}{kind}-v0" for name in LIBRARY for kind in kinds}
    made = gymnasium.make("undertow.export.gym:undertow/cart_pendulum-v0", objective="time")
    assert made.unwrapped.task.problem.name == "time"


@pytest.mark.parametrize("realistic", [False, True])
@pytest.mark.parametrize(
    "name", [n if n == SOME else pytest.param(n, marks=pytest.mark.slow) for n in LIBRARY]
)
def test_gymnasium_s_checker_has_nothing_to_say(name: str, realistic: bool) -> None:
    """Warnings of the checker are errors here, as everywhere in these tests."""
    from gymnasium.utils.env_checker import check_env

    kind = "_realistic" if realistic else ""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gymnasium.make(f"undertow/{name}{kind}-v0", render_mode="rgb_array")
        check_env(env.unwrapped)
    env.close()


def test_one_s_own_mechanism_passes_too() -> None:
    from gymnasium.utils.env_checker import check_env

    mine = replace(RIG.with_parameters(m=0.2), name="mine", start={"phi": 0.3})
    env = ut.environment(mine, ut.objective_for(mine, "bench-time"), period=0.01)
    check_env(env, skip_render_check=True)


def test_a_step_is_the_motion_of_the_mechanism_and_costs_what_it_costs() -> None:
    """Beside an integration to a tolerance by SciPy, with the equations as NumPy has them."""
    from scipy.integrate import solve_ivp

    env = ut.environment(RIG, "bench-energy", period=0.01)
    x, _ = env.reset(options={"phi": 0.5, "theta_dot": -2.0})
    u = np.array([0.4]) * RIG.input_limits

    def rates(_t: float, z: Any) -> Any:
        qdd = RIG.accelerations(0.0, z[:4], u)
        return np.concatenate([z[2:4], qdd, [u @ u + 0.05 * z[:4] @ z[:4]]])

    z = np.append(x, 0.0)
    for _ in range(20):
        before = z[-1]
        z = solve_ivp(rates, (0, 0.01), z, rtol=1e-11, atol=1e-12).y[:, -1]
        x, reward, *_ = env.step(np.array([0.4]))
        np.testing.assert_allclose(x, z[:4], rtol=1e-6, atol=1e-7)
        np.testing.assert_allclose(-reward, z[-1] - before, rtol=1e-6)


@pytest.mark.parametrize("damping", rest_slow([0.0, 2000.0], 2000.0))
def test_a_fast_mode_is_followed_too(damping: float) -> None:
    """Motors are fast: the wheels' back-EMF decays by 241/s, a cart's may by thousands."""
    from scipy.integrate import solve_ivp

    mine = ut.mechanisms.wheeled_inverted_pendulum()
    if damping:
        mine = ut.mechanisms.cart_pendulum().with_parameters(b_c=damping).with_input_limit(1e4)
    n, u, env = mine.n, mine.input_limits * 0.3, ut.environment(mine)
    x, _ = env.reset(seed=0)
    stage = env.task.problem.stage_function(mine)

    def rates(_t: float, z: Any) -> Any:
        x = z[:-1]
        return [*x[n:], *mine.accelerations(0.0, x, u), *stage(*x, *u)]

    for _ in range(20):
        z = solve_ivp(rates, (0, 0.005), [*x, 0.0], "LSODA", rtol=1e-10, atol=1e-12).y[:, -1]
        x, reward, terminated, *_ = env.step(np.full(mine.m, 0.3))
        assert not terminated
        np.testing.assert_allclose(x, z[:-1], rtol=1e-4, atol=1e-6)
        np.testing.assert_allclose(-reward, z[-1], rtol=1e-3)


@pytest.mark.parametrize("name", rest_slow(["rotary_pendulum", "cart_pendulum"], "cart_pendulum"))
def test_each_of_many_is_as_it_would_be_alone(name: str) -> None:
    """Gymnasium's own vector of single ones, over ends and new beginnings, to the last bit."""
    count, made = 5, {"objective": "time", "period": 0.02}
    many = gymnasium.make_vec(f"undertow/{name}-v0", num_envs=count, **made)
    assert isinstance(many, ours.VectorEnvironment)
    alone = gymnasium.vector.SyncVectorEnv(
        [lambda: ut.environment(name, "time", period=0.02) for _ in range(count)]
    )
    ends, rng = 0, np.random.default_rng(0)
    first, again = many.reset(seed=7)[0], alone.reset(seed=7)[0]
    np.testing.assert_array_equal(first, again)
    push = rng.uniform(-1, 1, (count, 1))  # each pushes one way: carts run into their ends
    for _ in range(600):
        one, two = many.step(push), alone.step(push)
        for mine, theirs in zip(one[:4], two[:4], strict=True):
            np.testing.assert_array_equal(mine, theirs)
        ended = one[2] | one[3]
        ends += int(ended.sum())
        if ended.any():
            np.testing.assert_array_equal(one[4]["event"][ended], two[4]["event"][ended])
    assert ends >= count
    same = many.reset(seed=[7] * count)[0]
    np.testing.assert_array_equal(same, np.tile(first[0], (count, 1)))


def test_ends_are_named_and_falling_is_paid_for() -> None:
    cart = ut.mechanisms.cart_pendulum()
    env = ut.environment(cart, "time", penalty=3.0)
    env.reset(options={"x": 1.4, "x_dot": 6.0})
    _, reward, terminated, truncated, info = env.step(np.zeros(1))
    assert (terminated, truncated, info["event"]) == (True, False, "CONSTRAINT")
    assert reward == pytest.approx(-0.005 - 3.0)
    with pytest.raises(InvalidInputError, match="reset"):
        env.step(np.zeros(1))
    env.reset(options={"phi": 0.005, "phi_dot": 0.005})
    _, reward, terminated, _, info = env.step(np.zeros(1))
    assert (terminated, info["event"]) == (True, "REACHED")
    assert reward == pytest.approx(-0.005)
    short = ut.environment(cart, ut.objective_for(cart, "time", horizon=0.01))
    short.reset(seed=0)
    assert short.step(np.zeros(1))[3] is False
    assert short.step(np.zeros(1))[2:4] == (False, True)


def test_a_bench_differs_from_the_model_and_each_episode_from_the_next() -> None:
    """What is observed is counted, what is paid goes by the true state."""
    env = ut.environment(RIG, realistic=True)
    x, info = env.reset(seed=4)
    count = 2 * np.pi / 4096
    assert not np.allclose(x[1], info["x"][1], atol=1e-7)
    assert abs(x[1] - info["x"][1]) < count
    runs: list[Any] = []
    for _ in range(2):
        env.reset(seed=4)
        second, _ = env.reset()
        runs.append([second, *(env.step(np.array([0.3]))[0] for _ in range(20))])
    np.testing.assert_array_equal(runs[0], runs[1])
    assert not np.array_equal(x, runs[0][0])
    _, reward, *_, info = env.step(np.zeros(1))
    assert reward == pytest.approx(-0.005 * 0.01 * info["x"] @ info["x"], rel=0.2)


def test_a_picture_shows_where_it_stands() -> None:
    env = ut.environment("cart_pendulum", render_mode="rgb_array")
    pictures: list[Any] = []
    for phi in (0.0, 0.5):
        env.reset(options={"phi": phi})
        pictures.append(env.render())
    assert pictures[0].shape == (360, 360, 3)
    assert pictures[0].dtype == np.uint8
    assert (pictures[0] != pictures[1]).any()
    assert ut.environment("cart_pendulum").render() is None


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"period": 0.0}, "period of an environment"),
        ({"period": 0.0015, "realistic": True}, "multiple of the bench's"),
        ({"realistic": Bench(ut.mechanisms.cart_pendulum())}, "plant 'cart_pendulum'"),
        ({"penalty": -1.0}, "penalty"),
        ({"objective": "tme"}, "Did you mean time"),
        ({"render_mode": "human"}, "render_mode"),
        ({"mechanism": "rotary_pendulun"}, "Did you mean rotary_pendulum"),
    ],
)
def test_bad_arguments_are_refused(given: dict[str, Any], said: str) -> None:
    with pytest.raises(InvalidInputError, match=said):
        ut.environment(**{"mechanism": RIG, **given})


def test_a_mechanism_without_a_limit_or_a_start_says_what_to_give() -> None:
    free = replace(RIG, inputs=(ut.Input("voltage", "V"),))
    with pytest.raises(InvalidInputError, match="limit of input 'voltage'"):
        ut.environment(free)
    with pytest.raises(InvalidInputError, match="start"):
        ut.environment(replace(RIG, start={}))


def test_a_missing_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "gymnasium", None)
    with pytest.raises(MissingExtraError, match=r"undertow\[gym\]"):
        ut.environment(RIG)


def test_episodes_begin_within_the_travel(monkeypatch: pytest.MonkeyPatch) -> None:
    """The usual start may be mirrored only where that is inside, too: travel need not be even."""
    cart = ut.mechanisms.cart_pendulum()
    track = replace(cart.coordinates[0], low=-0.1, high=1.5)
    uneven = replace(cart, coordinates=(track, cart.coordinates[1]), start={"x": 0.5, "phi": 0.1})
    task = ut.export.BalancingTask(uneven)
    rng = np.random.default_rng(0)
    begins = np.array([task.start(rng) for _ in range(200)])
    assert begins[:, 0].min() >= 0.25
    assert begins[:, 0].max() <= 0.5
    even = ut.export.BalancingTask(replace(cart, start={"x": 0.5, "phi": 0.1}))
    assert (np.array([even.start(rng)[0] for _ in range(20)]) < 0).any()


def test_what_does_not_end_an_episode_is_observed_as_it_is() -> None:
    """Without travel among the constraints, positions beyond it are not cut off."""
    cart = ut.mechanisms.cart_pendulum()
    kept, free = (ut.export.BalancingTask(cart, ut.MinimumTime(travel=t)) for t in (True, False))
    assert kept.box[1][0] == 1.5
    assert free.box[1][0] == free.escape


@pytest.mark.parametrize(
    "action", [["left"], [None], [1j], [math.nan], [math.inf], [0.1, 0.2], 0.1, [[0.1]], {}]
)
def test_an_action_that_is_none_is_refused_in_one_environment_as_in_many(action: Any) -> None:
    """Text and complex numbers were raw errors; in many environments NaN became the state."""
    env, many = ut.environment(RIG), ut.vector_environment(RIG, num_envs=2)
    env.reset(seed=0)
    begun = many.reset(seed=0)[0].copy()
    with pytest.raises(InvalidInputError, match="action of an environment"):
        env.step(action)
    with pytest.raises(InvalidInputError, match="actions of a vector environment"):
        many.step([[0.0], action])  # type: ignore[arg-type]
    assert (many._lanes.x == begun).all()


def test_a_step_before_reset_is_refused_in_one_environment_as_in_many() -> None:
    """Many began by themselves, from starts that no seed gave."""
    many = ut.vector_environment(RIG, num_envs=2)
    for step in (
        lambda: ut.environment(RIG).step(np.zeros(1)),
        lambda: many.step(np.zeros((2, 1))),
    ):
        with pytest.raises(InvalidInputError, match=r"Call reset\(\) first"):
            step()


def test_seeds_and_options_that_are_none_are_refused() -> None:
    """A seed of 1.5 was 1; options that are no mapping, and 2.0 environments, raw errors."""
    many = ut.vector_environment(RIG, num_envs=2.0)  # type: ignore[arg-type]
    assert many.num_envs == 2
    for seed in (1.5, "a", True, [1, 2, 3], [1.0, 2.0]):
        with pytest.raises(InvalidInputError, match="seeds of a vector environment"):
            many.reset(seed=seed)  # type: ignore[arg-type]
    for env in (many, ut.environment(RIG)):
        with pytest.raises(InvalidInputError, match="options of reset"):
            env.reset(options=[0.3])  # type: ignore[arg-type]
    assert (many.reset(seed=7)[0] == many.reset(seed=[7, 8])[0]).all()


def test_an_input_that_the_bench_cannot_give_is_not_paid_for() -> None:
    """Its motor takes 3 V of the 15 that are asked for."""
    bench = Bench(RIG.with_input_limit(3.0))
    env = ut.environment(RIG, ut.MinimumEnergy(), realistic=bench)
    env.reset(seed=0)
    assert env.step(np.array([1.0]))[1] == pytest.approx(-(3.0**2) * env.task.period)
