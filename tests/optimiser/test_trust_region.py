"""The quadratic-model search: what it solves, and that it keeps the face of every search."""

from __future__ import annotations

import numpy as np
import pytest

from undertow.base import InvalidInputError
from undertow.closed_loop import UNSTABLE
from undertow.models import FloatArray
from undertow.optimiser import CMAES
from undertow.optimiser.cma_es import minimise
from undertow.optimiser.trust_region import TrustRegion, _normal_equations, _shorten


def _bowl(x: FloatArray) -> FloatArray:
    """A tilted quadratic, 1 at its minimum at (0.3, 0.3, …)."""
    y = x - 0.3
    turned = y @ np.tri(x.shape[1])
    return np.asarray(1.0 + (turned * turned).sum(axis=1))


def _bent(x: FloatArray) -> FloatArray:
    """Smooth, but not quadratic."""
    return np.asarray(_bowl(x) + 0.3 * np.sin(3.0 * x).sum(axis=1) ** 2)


@pytest.mark.parametrize("d", [1, 3, 5, 7])
def test_a_quadratic_takes_a_few_generations(d: int) -> None:
    """The model is exact, so what limits it is the first step length."""
    search = TrustRegion(np.zeros(d), 0.1, 16, np.random.default_rng(0))
    minimise(search, _bowl, evaluations=400, tolerance=1e-12)
    assert search.best_f == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize("d", [1, 2, 5])
def test_a_step_is_newtons_within_the_region_and_leads_down_to_its_edge_beyond(d: int) -> None:
    """Quadratics drawn at random, of either curvature, in parts of the region's radius."""
    rng = np.random.default_rng(d)

    def shortened(curvature: FloatArray, slope: FloatArray, reach: float) -> FloatArray:
        step = np.full(d, np.nan)
        _shorten(curvature, basis, basis.T @ slope, reach, step)
        return step

    for reach in (1e-3, 1.0, 50.0):
        basis, _ = np.linalg.qr(rng.standard_normal((d, d)))
        curvature, slope = np.sort(rng.uniform(0.5, 2.0, d)), rng.standard_normal(d)
        newton = -np.linalg.solve(basis * curvature @ basis.T, slope)
        within = slope / np.linalg.norm(newton)
        step = shortened(curvature, within, reach)
        np.testing.assert_allclose(step, reach * newton / np.linalg.norm(newton), rtol=1e-9)
        for bent in (curvature, np.sort(rng.standard_normal(d))):
            beyond = shortened(bent, 1e3 * within, reach)
            assert np.linalg.norm(beyond) <= 1.5 * reach * (1 + 1e-12)
            assert np.linalg.norm(beyond) >= 0.5 * reach
            assert slope @ beyond < 0
        assert not shortened(curvature, np.zeros(d), reach).any()


def test_fewer_evaluations_than_a_covariance_takes() -> None:
    """On a smooth function of three coordinates, at equal quality, over ten seeds."""

    def spent(search: TrustRegion | CMAES) -> int:
        used = 0
        while search.best_f > 1.002 * best and used < 2000:
            x = search.ask()
            search.tell(x, _bent(x))
            used += len(x)
        return used

    grid = np.stack(np.meshgrid(*[np.linspace(-0.5, 1.0, 61)] * 3), -1).reshape(-1, 3)
    best = float(_bent(grid).min())
    seeds = range(10)
    model = [spent(TrustRegion(np.ones(3), 0.1, 16, np.random.default_rng(s))) for s in seeds]
    covariance = [spent(CMAES(np.ones(3), 0.1, 16, np.random.default_rng(s))) for s in seeds]
    assert np.median(model) <= np.median(covariance)


def test_whatever_is_far_away_counts_for_the_model_not_against_it() -> None:
    """The equations are those of weighted least squares: positive definite at any distance."""
    rng = np.random.default_rng(0)
    x, terms = rng.standard_normal((40, 2)), 6
    f, away, near = _bowl(x), np.linalg.norm(x, axis=1), np.arange(40)
    for reach in (10.0, 1.0, 0.1, 0.01):
        normal, right = np.zeros((terms, terms)), np.zeros(terms)
        _normal_equations(x, f, np.zeros(2), 1.0, away, near, reach, normal, right)
        assert np.linalg.eigvalsh(normal).min() > 0


def test_until_something_is_admissible_it_looks_ever_nearer() -> None:
    """A half ball, a hundredth as wide as the first samples; its face goes through the mean."""

    def narrow(x: FloatArray) -> FloatArray:
        inside = (np.linalg.norm(x, axis=1) < 1e-3) & (x[:, 0] > 0)
        return np.where(inside, _bowl(x), np.inf)

    search = TrustRegion(np.zeros(3), 0.1, 16, np.random.default_rng(0))
    minimise(search, narrow, evaluations=400, tolerance=0.0)
    assert search.best_f < np.inf


def test_penalties_and_nan_stay_out_of_the_model() -> None:
    """A wall through the region leaves the best admissible candidate, and never a NaN."""

    def walled(x: FloatArray) -> FloatArray:
        cost = np.where(x[:, 0] > 0.1, UNSTABLE, _bowl(x))
        return np.where(x[:, 1] > 0.9, np.nan, cost)

    search = TrustRegion(np.zeros(3), 0.2, 16, np.random.default_rng(1))
    minimise(search, walled, evaluations=320, tolerance=1e-12)
    assert np.isfinite(search.best_f)
    assert search.best_f < float(walled(np.zeros((1, 3)))[0])
    assert search.best_x[0] <= 0.1


def test_same_seed_same_bits() -> None:
    """Nothing but the seed decides."""
    runs = []
    for _ in range(2):
        search = TrustRegion(np.ones(4), 0.1, 16, np.random.default_rng(7))
        minimise(search, _bent, evaluations=200)
        runs.append(search.best_x)
    np.testing.assert_array_equal(runs[0], runs[1])


@pytest.mark.parametrize(
    ("mean", "radius", "population"),
    [([np.nan], 0.1, 16), ([0.0], 0.0, 16), ([0.0], np.inf, 16), ([0.0], 0.1, 3)],
)
def test_refuses_unusable_settings(mean: list[float], radius: float, population: int) -> None:
    """As the other searches do."""
    with pytest.raises(InvalidInputError, match="search"):
        TrustRegion(np.array(mean), radius, population, np.random.default_rng(0))
