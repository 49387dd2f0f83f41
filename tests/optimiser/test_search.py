"""Population search: solves the standard problems, keeps CMA-ES's invariances."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from undertow.base import InvalidInputError
from undertow.closed_loop import INADMISSIBLE
from undertow.models import FloatArray
from undertow.optimiser import CMAES
from undertow.optimiser.cma_es import minimise
from undertow.optimiser.search import LONG_PAUSE, _descend

Cost = Callable[[FloatArray], FloatArray]


def sphere(x: FloatArray) -> FloatArray:
    return np.asarray((x**2).sum(axis=1))


def ellipsoid(x: FloatArray) -> FloatArray:
    d = x.shape[1]
    return np.asarray((x**2) @ 10 ** (6 * np.arange(d) / (d - 1)))


def rosenbrock(x: FloatArray) -> FloatArray:
    return np.asarray((100 * (x[:, 1:] - x[:, :-1] ** 2) ** 2 + (1 - x[:, :-1]) ** 2).sum(axis=1))


def evaluations_to(cost: Cost, d: int, target: float, seed: int, limit: int = 40_000) -> int:
    """Evaluations that our search needs to get below ``target``; ``limit`` if it does not."""
    search = CMAES(np.full(d, 3.0), 1.0, 4 + int(3 * np.log(d)), np.random.default_rng(seed))
    spent = 0
    while spent < limit and search.best_f > target:
        x = search.ask()
        search.tell(x, cost(x))
        spent += search.population
    return spent


def peer_evaluations_to(cost: Cost, d: int, target: float, seed: int, limit: int = 40_000) -> int:
    """The same for the ``cmaes`` package, with the same population, start and σ."""
    cmaes = pytest.importorskip("cmaes")
    peer = cmaes.CMA(
        mean=np.full(d, 3.0), sigma=1.0, seed=seed, population_size=4 + int(3 * np.log(d))
    )
    spent, best = 0, np.inf
    while spent < limit and best > target:
        members = [peer.ask() for _ in range(peer.population_size)]
        values = cost(np.array(members))
        best = min(best, float(values.min()))
        peer.tell([(x, float(f)) for x, f in zip(members, values, strict=True)])
        spent += peer.population_size
    return spent


@pytest.mark.parametrize("cost", [sphere, ellipsoid, rosenbrock])
@pytest.mark.parametrize("d", [2, 6])
def test_solves_the_standard_problems(cost: Cost, d: int) -> None:
    """Sphere, ellipsoid of condition 1e6 and Rosenbrock are solved to 1e-10."""
    spent = [evaluations_to(cost, d, 1e-10, seed) for seed in range(3)]
    # Rosenbrock in six dimensions has a local minimum, in which a run in three may end.
    assert (min if cost is rosenbrock and d > 3 else max)(spent) < 4_000


@pytest.mark.parametrize(
    ("cost", "d"), [(ellipsoid, 5), pytest.param(rosenbrock, 4, marks=pytest.mark.slow)]
)
def test_matches_the_cmaes_package(cost: Cost, d: int) -> None:
    """Evaluations to 1e-8 like the ``cmaes`` package's, in the median of nine seeds.

    Its *active* update (negative weights) saves it about a quarter on ill-conditioned
    problems; on curved ones there is no difference.
    """
    ours = np.median([evaluations_to(cost, d, 1e-8, seed) for seed in range(9)])
    theirs = np.median([peer_evaluations_to(cost, d, 1e-8, seed) for seed in range(9)])
    assert ours <= 1.4 * theirs


def trace(
    cost: Cost, mean: FloatArray, sigma: float | FloatArray, generations: int = 30
) -> FloatArray:
    """All points that a search visits."""
    search = CMAES(mean, sigma, 12, np.random.default_rng(7))
    visited = []
    for _ in range(generations):
        x = search.ask()
        search.tell(x, cost(x))
        visited.append(x)
    return np.array(visited)


def test_invariant_to_monotone_transformation_of_the_cost() -> None:
    """Only ranks count: f and exp(f/1e7) − 3 give the same points, bit for bit."""
    plain = trace(ellipsoid, np.ones(4), 0.5)
    bent = trace(lambda x: np.exp(ellipsoid(x) / 1e7) - 3, np.ones(4), 0.5)
    np.testing.assert_array_equal(plain, bent)


@settings(max_examples=20, deadline=None)
@given(st.lists(st.floats(-5, 5), min_size=3, max_size=3))
def test_invariant_to_translation(shift: list[float]) -> None:
    """f(x − c) from x₀ + c visits the points of f(x) from x₀, moved by c."""
    c = np.array(shift)
    plain = trace(sphere, np.ones(3), 0.5, 15)
    moved = trace(lambda x: sphere(x - c), np.ones(3) + c, 0.5, 15)
    np.testing.assert_allclose(moved - c, plain, atol=1e-9)


def test_invariant_to_scale_of_the_coordinates() -> None:
    """f(x/w) with standard deviations σ w visits the points of f(x), scaled by w."""
    w = np.array([1e-3, 1.0, 50.0])
    plain = trace(ellipsoid, np.ones(3), 0.5)
    scaled = trace(lambda x: ellipsoid(x / w), w.copy(), 0.5 * w)
    np.testing.assert_allclose(scaled / w, plain, rtol=1e-6, atol=1e-9)


def test_rotated_ellipsoid_costs_no_more() -> None:
    """A rotation of the coordinates does not slow it: the covariance is learnt."""
    q, _ = np.linalg.qr(np.random.default_rng(0).standard_normal((5, 5)))
    plain = np.median([evaluations_to(ellipsoid, 5, 1e-8, s) for s in range(7)])
    turned = np.median([evaluations_to(lambda x: ellipsoid(x @ q), 5, 1e-8, s) for s in range(7)])
    assert turned <= 1.25 * plain


@pytest.mark.parametrize(("d", "population", "extra"), [(10, 10, False), (2, 200, True)])
def test_the_step_size_is_damped_more_only_with_many_candidates(
    d: int, population: int, extra: bool
) -> None:
    """(55): d_σ = 1 + c_σ, and beyond that where the effective number of parents exceeds d + 2."""
    search = CMAES(np.zeros(d), 1.0, population, np.random.default_rng(0))
    assert (search.mu_eff > d + 2) == extra
    more = math.sqrt((search.mu_eff - 1) / (d + 1)) - 1 if extra else 0.0
    assert search.d_sigma == 1 + 2 * more + search.c_sigma


def test_same_seed_same_bits() -> None:
    """The same generator state gives the same search."""
    np.testing.assert_array_equal(
        trace(rosenbrock, np.zeros(3), 0.3), trace(rosenbrock, np.zeros(3), 0.3)
    )


def test_nan_counts_as_infinitely_bad() -> None:
    """A cost of NaN never becomes the best and never spoils the state."""
    search = CMAES(np.ones(2), 0.5, 8, np.random.default_rng(0))
    for _ in range(80):
        x = search.ask()
        f = sphere(x)
        f[::3] = np.nan
        search.tell(x, f)
    assert np.isfinite(search.mean).all()
    assert search.best_f < 1e-8


def test_budget_is_kept_and_best_never_worsens() -> None:
    """Never more evaluations than allowed; the best cost falls monotonically."""
    spent = 0
    bests = [np.inf]
    search = CMAES(np.full(3, 2.0), 0.5, 10, np.random.default_rng(0))

    def cost(x: FloatArray) -> FloatArray:
        nonlocal spent
        spent += len(x)
        bests.append(min(bests[-1], float(sphere(x).min())))
        return sphere(x)

    reported = minimise(search, cost, evaluations=137, tolerance=0.0)
    assert reported == spent == 130
    assert search.best_f == bests[-1]
    assert all(after <= before for before, after in pairwise(bests))


def test_stops_when_converged_or_told() -> None:
    """A converged search stops by itself; ``stop`` ends it at once."""
    search = CMAES(np.ones(2), 0.5, 8, np.random.default_rng(0))
    spent = minimise(search, sphere, evaluations=100_000, tolerance=1e-6)
    assert spent < 5_000
    assert search.spread <= 1e-6
    assert minimise(search, sphere, evaluations=1000, tolerance=0.0, stop=lambda: True) == 0


@pytest.mark.parametrize(
    ("mean", "sigma", "population"),
    [([np.nan, 0.0], 0.5, 8), ([0.0, 0.0], -1.0, 8), ([0.0, 0.0], np.inf, 8), ([0.0], 0.5, 3)],
)
def test_refuses_unusable_settings(mean: list[float], sigma: float, population: int) -> None:
    """NaN, a negative or infinite σ and a tiny population are refused."""
    with pytest.raises(InvalidInputError, match="of the search"):
        CMAES(np.array(mean), sigma, population, np.random.default_rng(0))


@pytest.mark.parametrize("plants", [1, 17])
def test_a_descent_on_many_plants_ends_where_it_gains_no_more(plants: int) -> None:
    """A pause ends it there, but for one on the way to a first plan that arrives; alone it goes on.

    The spread of a descent along a valley is no sign that it is done: on 17 plants each generation
    takes 17 times as long.
    """
    spent: list[float] = []

    def cost(z: FloatArray) -> FloatArray:
        values = 1.0 + 1e-9 * (z**2).sum(axis=1)
        late = len(spent) < 45 * len(z)  # nothing arrives, and hardly anything comes nearer
        found = np.where(late, 10 * INADMISSIBLE * (1.0 + 1e-9 * values), values)
        spent.extend(found.tolist())
        return np.asarray(found)

    task = SimpleNamespace(
        optimiser=SimpleNamespace(population=8, counts_time=False),
        rng=np.random.default_rng(5), cost=cost, resolution=0.0, warm=False, left=8 * 200,
        plants=plants, late=lambda: False,
    )  # fmt: skip
    converged = _descend(cast(Any, task), np.full(3, 5.0), 1.0, 8 * 200, 0.0)
    generations = len(spent) / 8
    assert min(spent) < INADMISSIBLE
    if plants == 1:
        assert (generations, converged) == (200, False)
    else:
        assert (generations, converged) == (46 + LONG_PAUSE, True)
