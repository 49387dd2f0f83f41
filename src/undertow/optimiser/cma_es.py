"""Population search behind one ask/tell face; knows nothing of control.

:class:`CMAES` is the (μ/μ_w, λ) covariance matrix adaptation evolution strategy of
Hansen, "The CMA Evolution Strategy: A Tutorial" (arXiv:1604.00772); equation numbers in
the comments are his.  Whole populations are NumPy arrays, because here one generation is
one batch of rollouts.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Protocol

import numpy as np
from scipy.linalg import lapack

from undertow.base import at_least, positive, require
from undertow.models import FloatArray
from undertow.symbolic import compiled


class Search(Protocol):
    """What every search offers: ask for candidates, tell their costs."""

    best_x: FloatArray
    best_f: float
    converged: bool

    @property
    def spread(self) -> float:
        """How far the next candidates lie apart."""

    def ask(self) -> FloatArray:
        """Return candidates, (N, d)."""

    def tell(self, x: FloatArray, f: FloatArray) -> None:
        """Learn the costs ``f``, (N,), of candidates ``x``, (N, d)."""


def check_start(mean: FloatArray, spread: FloatArray, population: int) -> None:
    """Refuse a first guess, a first spread or a population that no search can use."""
    finite = np.isfinite(mean).all()
    require(finite, "mean of the search", mean, "finite numbers", "Start elsewhere")
    positive("sigma of the search", spread, "0.1 is usual")
    at_least("population of the search", population, 4, "16 fills a block of rollouts")


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
    covariance
        Initial covariance in units of ``sigma``, (d, d); the identity by default.

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
        covariance: FloatArray | None = None,
    ) -> None:
        self.mean = np.array(mean, dtype=float)
        d = self.mean.size
        scale = np.broadcast_to(np.asarray(sigma, dtype=float), (d,)).copy()
        check_start(self.mean, scale, population)
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
        self.C = np.eye(d) if covariance is None else np.array(covariance, dtype=float)
        self._factor()

    def _factor(self) -> None:
        eigenvalues, basis, _ = lapack.dsyevd(self.C, lower=1)
        self._basis = np.ascontiguousarray(basis)
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
        self.generation += 1
        rates = (self.c_sigma, self.d_sigma, self.c_c, self.c_1, self.c_mu, self.mu_eff, self.chi)
        self.sigma = _adapt(
            x[order[: self.weights.size]], self.weights, rates, self.generation, self.scale,
            self.sigma, self.mean, self.path_sigma, self.path_c, self.C, self._basis, self._root,
        )  # fmt: skip
        self._factor()


@compiled()
def _adapt(  # type: ignore[no-untyped-def]
    x, weights, rates, generation, scale, sigma, mean, path_sigma, path_c, C, basis, root
):
    """Update mean, paths and C in place from the best candidates; return the new sigma."""
    c_sigma, d_sigma, c_c, c_1, c_mu, mu_eff, chi = rates
    mu, d = x.shape
    y, step, whitened = np.empty((mu, d)), np.zeros(d), np.zeros(d)
    for i in range(d):
        for k in range(mu):
            y[k, i] = (x[k, i] - mean[i]) / (sigma * scale[i])
            step[i] += weights[k] * y[k, i]  # (41)
        mean[i] += sigma * scale[i] * step[i]  # (42)
    for k in range(d):
        along = 0.0
        for i in range(d):
            along += basis[i, k] * step[i]
        for i in range(d):
            whitened[i] += basis[i, k] * (along / root[k])
    square, pace = 0.0, math.sqrt(c_sigma * (2 - c_sigma) * mu_eff)
    for i in range(d):
        path_sigma[i] = path_sigma[i] * (1 - c_sigma) + pace * whitened[i]  # (43)
        square += path_sigma[i] * path_sigma[i]
    norm = math.sqrt(square)
    expected = math.sqrt(1 - (1 - c_sigma) ** (2 * generation)) * chi
    stalled = 1.0 if norm / expected < 1.4 + 2 / (d + 1) else 0.0
    pace = stalled * math.sqrt(c_c * (2 - c_c) * mu_eff)
    for i in range(d):
        path_c[i] = path_c[i] * (1 - c_c) + pace * step[i]  # (45)
    forget = (1 - stalled) * c_c * (2 - c_c)
    for i in range(d):
        for j in range(d):
            value = (1 + c_1 * forget - c_1 - c_mu) * C[i, j] + c_1 * path_c[i] * path_c[j]
            for k in range(mu):
                value += c_mu * weights[k] * y[k, i] * y[k, j]
            C[i, j] = value  # (47)
    return sigma * math.exp(min(1.0, c_sigma / d_sigma * (norm / chi - 1)))  # (44)


def minimise(
    search: Search,
    cost: Callable[[FloatArray], FloatArray],
    *,
    evaluations: int,
    tolerance: float = 1e-4,
    resolution: float = 0.0,
    relative: float = 0.0,
    patience: int = 4,
    below: float | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> int:
    """Run a search until its budget is spent, it has converged, or ``stop()`` says so.

    ``cost``: (N, d) to (N,). ``evaluations``: budget; the last generation that fits is the last.
    ``tolerance``: converged when the spread of the distribution falls below it. ``resolution``:
    converged when ``patience`` generations together improve the cost by less; 0: never.
    ``relative``: the same as a part of the best cost; whichever is larger counts. ``patience``:
    generations. ``below``: generations count for that from the first one on whose best costs less;
    ``None``: all do. Returns the evaluations spent.
    """
    spent = 0
    bests = [search.best_f]
    while not stop():
        x = search.ask()
        if spent + len(x) > evaluations:
            break
        search.tell(x, cost(x))
        spent += len(x)
        bests.append(search.best_f)
        worth = max(resolution, relative * abs(search.best_f))
        stagnant = len(bests) > patience and not bests[-1 - patience] - bests[-1] > worth
        stagnant = stagnant and (below is None or bests[-1 - patience] < below)
        search.converged = search.spread <= tolerance or (worth > 0 and stagnant)
        if search.converged:
            break
    return spent
