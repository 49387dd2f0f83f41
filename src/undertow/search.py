"""Population search behind one ask/tell face; knows nothing of control.

:class:`CMAES` is the (μ/μ_w, λ) covariance matrix adaptation evolution strategy of
Hansen, "The CMA Evolution Strategy: A Tutorial" (arXiv:1604.00772); equation numbers in
the comments are his.  Whole populations are NumPy arrays, because here one generation is
one batch of rollouts.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from undertow.errors import InvalidInputError

__all__ = ["CMAES", "minimise"]

FloatArray = NDArray[np.float64]


class CMAES:
    """Covariance matrix adaptation over ℝᵈ: ask for a population, tell its costs.

    Parameters
    ----------
    mean
        First guess, (d,).
    sigma
        Initial standard deviation, one number or one per coordinate, (d,).
    population
        Candidates per generation, at least 4.
    rng
        Source of randomness: the same generator state gives the same search.

    Raises
    ------
    InvalidInputError
        For a mean that is not finite, or sigma or population out of range.
    """

    def __init__(
        self,
        mean: FloatArray,
        sigma: float | FloatArray,
        population: int,
        rng: np.random.Generator,
    ) -> None:
        self.mean = np.array(mean, dtype=float)
        d = self.mean.size
        scale = np.broadcast_to(np.asarray(sigma, dtype=float), (d,)).copy()
        if not np.isfinite(self.mean).all():
            raise InvalidInputError("mean of the search", value=mean, limit="finite numbers")
        if not (np.isfinite(scale).all() and (scale > 0).all()):
            raise InvalidInputError("sigma of the search", value=sigma, limit="finite and > 0")
        if population < 4:
            raise InvalidInputError("population of the search", value=population, limit="≥ 4")
        self.population = population
        self.rng = rng
        self.sigma = 1.0
        self.scale = scale
        self.best_x = self.mean.copy()
        self.best_f = math.inf
        self.generation = 0
        self.converged = False

        mu = population // 2
        raw = math.log((population + 1) / 2) - np.log(np.arange(1, mu + 1))  # (49)
        self.weights = raw / raw.sum()
        self.mu_eff = 1.0 / float((self.weights**2).sum())  # (8)
        e = self.mu_eff
        self.c_sigma = (e + 2) / (d + e + 5)  # (55)
        self.d_sigma = 1 + 2 * max(0.0, math.sqrt((e - 1) / (d + 1)) - 1) + self.c_sigma
        self.c_c = (4 + e / d) / (d + 4 + 2 * e / d)  # (56)
        self.c_1 = 2 / ((d + 1.3) ** 2 + e)  # (57)
        self.c_mu = min(1 - self.c_1, 2 * (e - 2 + 1 / e) / ((d + 2) ** 2 + e))  # (58)
        self.chi = math.sqrt(d) * (1 - 1 / (4 * d) + 1 / (21 * d * d))
        self.path_sigma = np.zeros(d)
        self.path_c = np.zeros(d)
        self.C = np.eye(d)
        self._factor()

    def _factor(self) -> None:
        eigenvalues, self._basis = np.linalg.eigh(self.C)
        self._root = np.sqrt(np.maximum(eigenvalues, 1e-20))

    @property
    def spread(self) -> float:
        """Largest standard deviation of the search distribution, in units of ``sigma``."""
        return float(self.sigma * self._root.max())

    def ask(self) -> FloatArray:
        """Return the next population, (population, d), (38)-(40)."""
        z = self.rng.standard_normal((self.population, self.mean.size))
        self._y = (z * self._root) @ self._basis.T
        return np.asarray(self.mean + self.sigma * self.scale * self._y)

    def tell(self, x: FloatArray, f: FloatArray) -> None:
        """Update from the costs ``f``, (population,), of the population ``x``.

        Members of ``x`` may have been replaced (an injected incumbent); NaN counts as +∞.
        """
        f = np.where(np.isnan(f), np.inf, f)
        order = np.argsort(f, kind="stable")
        if f[order[0]] < self.best_f:
            self.best_f, self.best_x = float(f[order[0]]), x[order[0]].copy()
        y = (x[order[: self.weights.size]] - self.mean) / (self.sigma * self.scale)
        step = self.weights @ y  # (41)
        self.mean = self.mean + self.sigma * self.scale * step  # (42)
        d = self.mean.size
        whitened = self._basis @ ((self._basis.T @ step) / self._root)
        c = self.c_sigma
        self.path_sigma = (1 - c) * self.path_sigma + math.sqrt(
            c * (2 - c) * self.mu_eff
        ) * whitened  # (43)
        self.generation += 1
        norm = float(np.linalg.norm(self.path_sigma))
        expected = math.sqrt(1 - (1 - c) ** (2 * self.generation)) * self.chi
        stalled = 1.0 if norm / expected < 1.4 + 2 / (d + 1) else 0.0
        self.path_c = (1 - self.c_c) * self.path_c + stalled * math.sqrt(
            self.c_c * (2 - self.c_c) * self.mu_eff
        ) * step  # (45)
        forget = (1 - stalled) * self.c_c * (2 - self.c_c)
        self.C = (
            (1 + self.c_1 * forget - self.c_1 - self.c_mu) * self.C
            + self.c_1 * np.outer(self.path_c, self.path_c)
            + self.c_mu * (y.T * self.weights) @ y
        )  # (47)
        self.sigma *= math.exp(min(1.0, c / self.d_sigma * (norm / self.chi - 1)))  # (44)
        self._factor()


def minimise(
    search: CMAES,
    cost: Callable[[FloatArray], FloatArray],
    *,
    evaluations: int,
    tolerance: float = 1e-4,
    resolution: float = 0.0,
    patience: int = 4,
    stop: Callable[[], bool] = lambda: False,
) -> int:
    """Run a search until its budget is spent, it has converged, or ``stop()`` says so.

    Parameters
    ----------
    cost
        (N, d) to (N,).
    evaluations
        Budget; the last generation that fits is the last.
    tolerance
        Converged when the spread of the distribution falls below it.
    resolution
        Converged when ``patience`` generations together improve the cost by less; 0: never.
    patience
        Generations.

    Returns
    -------
    int
        Evaluations spent.
    """
    spent = 0
    bests = [search.best_f]
    while spent + search.population <= evaluations and not stop():
        x = search.ask()
        search.tell(x, cost(x))
        spent += search.population
        bests.append(search.best_f)
        stagnant = len(bests) > patience and not bests[-1 - patience] - bests[-1] > resolution
        search.converged = search.spread <= tolerance or (resolution > 0 and stagnant)
        if search.converged:
            break
    return spent
