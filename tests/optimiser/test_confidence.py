"""How likely the best of some minima is the best of all: the posterior, and landscapes drawn."""

from __future__ import annotations

import math
import pickle
from math import lgamma

import numpy as np
import pytest

import undertow as ut
from undertow.optimiser import Budget
from undertow.optimiser.confidence import confidence


def posterior_part(starts: int, seen: int) -> float:
    """E[W/K] by adding up p(K | N, W) ∝ K! (K−1)! / ((K−W)! (N+K−1)!), term by term."""
    k = np.arange(seen, 200_000)
    logs = [
        lgamma(c + 1) + lgamma(c) - lgamma(c - seen + 1) - lgamma(starts + c)
        for c in k.astype(float)
    ]
    weights = np.exp(np.array(logs) - max(logs))
    return float((weights * seen / k).sum() / weights.sum())


@pytest.mark.parametrize(("starts", "seen"), [(12, 1), (12, 2), (12, 6), (8, 3), (5, 1)])
def test_it_is_the_mean_of_the_posterior(starts: int, seen: int) -> None:
    ends = [1.0 + k % seen for k in range(starts)]
    assert confidence(ends) == pytest.approx(posterior_part(starts, seen), rel=2e-3)


def test_ends_within_one_percent_are_one_and_failures_are_none() -> None:
    assert confidence([1.0, 1.009, math.inf, 1.005]) == pytest.approx(1 / 2)
    assert confidence([1.0, 1.02, 1.04]) == confidence([1.0, 2.0]) == 0.0
    assert confidence([-1.0, -1.001, -1.002, -1.003]) == pytest.approx(2 / 3)
    assert confidence([0.0, 0.0, 0.0]) == pytest.approx(1 / 2)


@pytest.mark.parametrize("ends", [[], [1.0], [1.0, math.inf], [math.inf, math.inf]])
def test_fewer_than_two_ends_tell_nothing(ends: list[float]) -> None:
    assert confidence(ends) is None


@pytest.mark.slow
def test_it_comes_true_on_landscapes_drawn_from_its_assumptions() -> None:
    """Minima of random number, size and cost: found as often as said, overall and where it is high.

    Truth is whether the least of all costs is among those that twelve starts met.  Where little
    is said, it matters that there are at most 200 minima here.
    """
    rng = np.random.default_rng(5)
    said, true = [], []
    for _ in range(20_000):
        count = rng.integers(1, 200)
        sizes = rng.dirichlet(np.ones(count))
        costs = 2.0 ** rng.permutation(count)  # none within 1 % of another
        ends = costs[rng.choice(count, 12, p=sizes)]
        sure = confidence(list(ends))
        assert sure is not None
        said.append(sure)
        true.append(ends.min() == costs.min())
    said_, true_ = np.array(said), np.array(true)
    for some in (said_ > 0.3, said_ > 0.6, said_ > 0.9):
        assert some.sum() > 50
        error = 4.0 * math.sqrt(0.25 / some.sum())
        assert true_[some].mean() == pytest.approx(said_[some].mean(), abs=error)


def test_wide_best_basins_are_found_more_often_than_said() -> None:
    """Where good minima have the larger basins, the number errs on the low side, as it says."""
    rng = np.random.default_rng(6)
    said, true = [], []
    for _ in range(4_000):
        count = rng.integers(1, 40)
        sizes = np.sort(rng.dirichlet(np.ones(count)))[::-1]
        ends = 2.0 ** rng.choice(count, 12, p=sizes)
        said.append(confidence(list(ends)))
        true.append(ends.min() == 1.0)
    assert np.mean(true) > np.mean(np.array(said, dtype=float)) + 0.1


@pytest.mark.slow
def test_a_cold_search_says_it_and_a_warm_one_does_not() -> None:
    rig = ut.mechanisms.rotary_pendulum(d_e=0.025)
    optimiser = ut.Cascade(rig, ut.MinimumEnergy(), belief="exact").optimiser
    x0 = rig.state(phi=ut.deg(30))
    cold = optimiser.propose(x0)
    assert cold.confidence is not None
    assert 0.0 <= cold.confidence <= 1.0
    assert f"confidence {cold.confidence:.0%}" in repr(cold)
    assert pickle.loads(pickle.dumps(cold)).confidence == cold.confidence
    warm = optimiser.propose(x0, incumbent=cold.plan)
    assert warm.confidence is None
    assert "confidence" not in repr(warm)
    short = optimiser.propose(x0, budget=Budget(3072))
    assert short.confidence is None


@pytest.mark.slow
def test_the_same_search_says_the_same() -> None:
    rig = ut.mechanisms.rotary_pendulum(d_e=0.025)
    optimiser = ut.Cascade(rig, ut.MinimumEnergy(), belief="exact").optimiser
    once, again = (optimiser.propose(rig.state(phi=ut.deg(30))) for _ in range(2))
    assert (again.confidence, again.cost) == (once.confidence, once.cost)


def test_where_nothing_is_found_nothing_is_said() -> None:
    rig = ut.mechanisms.rotary_pendulum(d_e=0.025)
    optimiser = ut.Cascade(rig, ut.MinimumTime(), belief="exact").optimiser
    answer = optimiser.propose(rig.state(phi=ut.deg(80)), budget=ut.Budget(600))
    assert answer.status == "infeasible"
    assert answer.confidence is None


@pytest.mark.slow
def test_minima_of_single_surfaces_say_nothing_of_a_schedule() -> None:
    """Not where they are those of one of many plants, either: its descent has one end."""
    rig = ut.mechanisms.rotary_pendulum(d_e=0.025)
    schedule = ut.DecisionVariables(reaching=True, schedule=0.5)
    optimiser = ut.Cascade(rig, ut.MinimumEnergy(), freedom=schedule).optimiser
    assert optimiser.loop.ensemble is not None
    answer = optimiser.propose(rig.state(phi=ut.deg(30)), budget=ut.Budget(4096))
    assert answer.plan is not None
    assert answer.confidence is None
