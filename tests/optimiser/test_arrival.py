"""Earliest arrivals: known optima are approached, whatever is inadmissible stays out."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import undertow as ut
from support import rest_slow
from undertow.models import FloatArray
from undertow.optimiser.arrival import ArrivalSearch, _steps, closer

RADIUS = 1e-3


class Push:
    """A unit mass pushed over a unit distance, |force| ≤ 1, even over each half of the time.

    From rest to rest that takes 2 at least: accelerate, then brake (L. S. Pontryagin).
    """

    def __init__(self, most: int = 100_000, forbidden: float = -np.inf) -> None:
        self.left, self.forbidden = most, forbidden
        self.best, self.last = np.inf, np.inf

    def states(self, z: FloatArray, T: float) -> tuple[FloatArray, FloatArray]:
        self.left -= len(z)
        self.last = T
        first, then = np.tanh(z).T
        half = 0.5 * T
        speed = half * first
        position = 0.5 * half * speed - 1.0 + speed * half + 0.5 * then * half**2
        x = np.column_stack([position, speed + half * then])
        x[np.abs(z).max(axis=1) > 20.0] = np.inf
        return x, np.full(len(z), T)

    def admits(self, z: FloatArray) -> np.ndarray:
        good: np.ndarray = np.tanh(z[:, 1]) > self.forbidden
        if good.any():
            self.best = min(self.best, self.last)
        return good

    def search(self, members: int = 16) -> float:
        z = np.random.default_rng(1).normal(size=(64, 2))
        ArrivalSearch(self.states, self.admits, RADIUS, lambda n: self.left < n).run(
            z, 4.0, members
        )
        return self.best


def test_a_mass_is_pushed_in_next_to_the_least_time() -> None:
    """Two is what the maximum principle says; the last window that was tried is 3 % shorter."""
    assert 2.0 - RADIUS < Push().search() < 2.0 * 1.04


def test_what_is_not_admitted_is_no_arrival() -> None:
    """With brakes of half the force at most: u then −u/2 over equal halves never ends at rest."""
    assert Push(forbidden=-0.5).search() > 2.7


@pytest.mark.parametrize("most", [0, 63, 64, 200, 1000])
def test_no_more_is_spent_than_there_is(most: int) -> None:
    push = Push(most)
    push.search()
    assert push.left >= 0


def test_where_every_motion_breaks_off_nothing_is_found() -> None:
    def nowhere(z: FloatArray, T: float) -> tuple[FloatArray, FloatArray]:
        return np.full((len(z), 2), np.inf), np.full(len(z), T)

    ArrivalSearch(nowhere, lambda z: np.zeros(len(z), dtype=bool), RADIUS).run(
        np.ones((8, 3)), 1.0, 4
    )


def test_steps_are_those_of_the_normal_equations() -> None:
    """(JᵀJ + λ I) step = −Jᵀ x, solved directly, and shortened to the longest that is allowed."""
    rng = np.random.default_rng(0)
    J, x, damping = (
        rng.normal(size=(5, 4, 3)),
        rng.normal(size=(5, 4)),
        np.array([[1e-3, 10.0]] * 5),
    )
    steps = _steps(J.swapaxes(1, 2), x, damping)
    for k in range(5):
        for j in range(2):
            wanted = -np.linalg.solve(J[k].T @ J[k] + damping[k, j] * np.eye(3), J[k].T @ x[k])
            wanted *= min(1.0, 0.5 / np.linalg.norm(wanted))
            np.testing.assert_allclose(steps[k, j], wanted, rtol=1e-9)


def test_damping_falls_with_a_step_that_helps_and_rises_with_one_that_does_not() -> None:
    """Marquardt's rule (1963): steps of Newton where the model holds, else short ones downhill."""
    z, t, damping = np.full((3, 2), 0.1), np.zeros(3), np.array([1e-2, 1e-1, 1.0])
    _, x, _, after = closer(lambda z: (z, np.zeros(len(z))), z, z, t, damping)
    assert (np.linalg.norm(x, axis=1) < np.linalg.norm(z, axis=1)).all()
    assert (after < damping).all()
    flat = np.ones_like(z)
    same, x, _, after = closer(lambda z: (np.ones_like(z), np.zeros(len(z))), z, flat, t, damping)
    np.testing.assert_array_equal(same, z)
    np.testing.assert_array_equal(x, flat)
    assert (after > damping).all()


SEEDS = range(1), pytest.param(range(1, 14), marks=pytest.mark.slow)


@pytest.mark.parametrize("seeds", SEEDS)
@pytest.mark.parametrize("reaching", rest_slow([False, True], False))
@pytest.mark.parametrize("name", rest_slow(["rotary_pendulum", "cart_pendulum"], "rotary_pendulum"))
def test_no_first_answer_promises_an_arrival_that_only_its_own_steps_see(
    name: str, reaching: bool, seeds: range
) -> None:
    """Integrated to a tolerance each arrives when it says; a grazing pass of the target is none.

    Of these 56 searches 27 promised up to 0.8 s too little when the steps of a search decided.
    """
    mechanism = ut.mechanisms.LIBRARY[name]()
    loop = ut.ClosedLoop(mechanism, ut.MinimumTime().on(mechanism))
    x0 = mechanism.state(phi=ut.deg(30 if name == "rotary_pendulum" else 20))
    freedom = ut.DecisionVariables(reaching=reaching)
    for seed in seeds:
        answer = ut.Optimiser(loop, seed=seed, freedom=freedom).propose(x0)
        assert answer.plan is not None
        assert loop.simulate(x0, answer.plan).cost == pytest.approx(answer.cost, rel=1e-6)


@pytest.mark.parametrize("reaching", [False, True])
def test_plans_of_a_search_do_what_they_promise(reaching: bool) -> None:
    """Simulated by itself, in the same steps, each arrives when it says; the last not later."""
    rig = ut.mechanisms.rotary_pendulum(d_e=0.025)
    freedom = ut.DecisionVariables(reaching=reaching)
    cascade = ut.Cascade(rig, ut.MinimumTime(), freedom=freedom, belief="exact")
    x = rig.state(phi=ut.deg(35))
    first, last = cascade.optimiser.improve(x, budget=ut.Budget(6000))
    assert last.cost <= first.cost
    assert last.evaluations <= 6000
    for answer in (first, last):
        assert answer.plan is not None
        motion = cascade.loop.simulate(x, answer.plan)
        assert motion.event.name == "REACHED"
        assert motion.cost == pytest.approx(answer.cost, rel=0.02)


@pytest.mark.slow
def test_the_better_basin_is_found() -> None:
    """From 40° three parameters arrive in 1.09 s; the search near the designs ends at 1.49 s."""
    rig = ut.mechanisms.rotary_pendulum(d_e=0.025)
    optimiser = ut.Cascade(rig, ut.MinimumTime(), belief="exact").optimiser
    first, last = optimiser.improve(rig.state(phi=ut.deg(40)))
    assert first.cost > 1.4
    assert last.cost < 1.15


@pytest.mark.slow
@pytest.mark.parametrize(
    "other",
    [
        pytest.param({"step": 0.001, "zoh_steps": 1}, id="held for 1 ms"),
        pytest.param({"reaching": ut.ReachingLaw(switching="sign")}, id="discontinuous"),
        pytest.param(
            {"plant": ut.mechanisms.rotary_pendulum(d_e=0.025).with_parameters(m=0.13)},
            id="on another plant",
        ),
    ],
)
def test_a_loop_without_a_linear_model_arrives_about_as_early(other: dict[str, Any]) -> None:
    """An input held, a law that switches, a plant that is not the model: arrivals all the same."""
    rig = ut.mechanisms.rotary_pendulum(d_e=0.025)
    x0, few = rig.state(phi=ut.deg(20)), ut.Budget(8192)
    usual, found = (
        ut.Optimiser(ut.ClosedLoop(rig, ut.MinimumTime(), **how)).propose(x0, budget=few)
        for how in ({}, other)
    )
    assert found.cost <= 1.02 * usual.cost


@pytest.mark.slow  # a kernel of its own
def test_where_no_design_arrives_descents_from_draws_find_what_does() -> None:
    """A wheel that leans nearly as far as its voltage bears: these seeds found nothing without."""
    rig = ut.mechanisms.reaction_wheel_pendulum()
    cascade = ut.Cascade(rig, ut.MinimumTime(horizon=6.0), belief="exact")
    optimiser, x0 = cascade.optimiser, rig.state(phi=ut.deg(2.6))
    designs = [ut.Plan.of(design) for design in optimiser.designs]
    assert not cascade.loop.batch(x0, designs).reached.any()
    for seed in (0, 2, 3):
        found = replace(optimiser, seed=seed).propose(x0, budget=ut.Budget(8000))
        assert found.plan is not None
        assert cascade.loop.batch(x0, found.plan, precise=True).reached[0]


@pytest.mark.slow
@pytest.mark.parametrize(("degrees", "known"), [(40.0, 1.0911), (30.0, 0.7750)])
def test_the_cold_search_finds_the_basin_that_keeps_away_from_the_singularity(
    degrees: float, known: float
) -> None:
    """Three parameters: not the later arrival on the edge of (37), at 1.493 and 0.937 s.

    The known times are those of searches of 12,000 rollouts, one seed in three.
    """
    rig = ut.mechanisms.rotary_pendulum(d_e=0.025)
    cascade = ut.Cascade(rig, ut.MinimumTime(), belief="exact")
    x0 = rig.state(phi=ut.deg(degrees))
    found = cascade.optimiser.propose(x0)
    assert found.plan is not None
    motion = cascade.loop.batch(x0, found.plan, precise=True)
    assert motion.reached[0]
    assert motion.cost[0] <= 1.002 * known
