"""Quadratic-model search behind the ask/tell face of :mod:`undertow.search`.

Derivative-free trust-region search in the manner of Powell's NEWUOA, but for populations:
each generation is one batch, spread around the place where a quadratic model, fitted to
everything seen so far, expects the minimum.  A smooth cost of a few coordinates needs
fewer generations than a covariance takes to adapt; a rough one is better left to
:class:`undertow.search.CMAES`.
"""

from __future__ import annotations

import math

import numpy as np

from undertow.codegen.machine import numba
from undertow.search import FloatArray, check_start

__all__ = ["TrustRegion"]

#: Lengths tried along a step of the model.
STRETCHES = np.array([0.35, 0.7, 1.0, 1.4, 2.0, 3.0])

#: Costs from here on are penalties and stay out of the model.
PENALTY = 1e8


class TrustRegion:
    """Minimise a smooth function of few coordinates, a batch at a time.

    Parameters
    ----------
    mean
        First guess, (d,).
    radius
        First spread of the samples around it.
    population
        Candidates per generation; the first one has as many as the model needs.
    rng
        Source of randomness: the same generator state gives the same search.

    Raises
    ------
    InvalidInputError
        For a mean that is not finite, or radius or population out of range.
    """

    def __init__(
        self, mean: FloatArray, radius: float, population: int, rng: np.random.Generator
    ) -> None:
        self.mean = np.array(mean, dtype=float)
        check_start(self.mean, np.array([radius]), population)
        self.radius, self.rng = float(radius), rng
        self.best_x, self.best_f = self.mean.copy(), math.inf
        self.generation = 0
        self.converged = False
        self.step = np.zeros_like(self.mean)
        d = self.mean.size
        self.terms = (d + 1) * (d + 2) // 2
        self.population = population
        self._x, self._f = np.empty((0, d)), np.empty(0)

    @property
    def spread(self) -> float:
        """How far the next samples lie from the best one."""
        return max(self.radius, float(np.abs(self.step).max()))

    def ask(self) -> FloatArray:
        """Return the next candidates, (N, d): the first time the mean and a design around it."""
        if self.generation == 0:
            count = self.population * math.ceil(1.2 * self.terms / self.population)
            return np.vstack([self.mean, self._design(self.mean, count - 1)])
        lengths = STRETCHES[: self.population // 2, None]
        ahead = self._design(self.best_x + self.step, self.population - len(lengths))
        return np.vstack([self.best_x + lengths * self.step, ahead])

    def _design(self, centre: FloatArray, count: int) -> FloatArray:
        """Return points around a centre: both ways along random orthogonal axes, then beyond."""
        d = centre.size
        drawn = self.rng.standard_normal((1 + max(count - 2 * d, 0), d))
        drawn /= np.sqrt((drawn * drawn).sum(axis=1, keepdims=True))
        axes = np.eye(d) - 2.0 * np.outer(drawn[0], drawn[0])  # a reflection: orthogonal
        beyond = 1.5 * drawn[1:]
        points = np.concatenate([axes, -axes, beyond])[:count]
        return np.asarray(centre + self.radius * points)

    def tell(self, x: FloatArray, f: FloatArray) -> None:
        """Learn the costs ``f``, (N,), of candidates ``x``, (N, d); NaN counts as +∞."""
        f = np.where(np.isnan(f), np.inf, f)
        best = int(np.argmin(f))
        if f[best] < self.best_f:
            self.best_f, self.best_x = float(f[best]), x[best].copy()
        self.generation += 1
        sound = f < PENALTY
        self._x = np.concatenate([self._x, x[sound]])
        self._f = np.concatenate([self._f, f[sound]])
        if len(self._f) < self.terms:
            self.step[:] = 0.0
            self.radius *= 0.5
            return
        offsets = self._x - self.best_x
        near = np.argsort((offsets * offsets).sum(axis=1), kind="stable")[: 3 * self.terms]
        _model_step(offsets[near], self._f[near] - self.best_f, abs(self.best_f), self.step)
        length = math.sqrt(float(self.step @ self.step))
        self.radius = min(max(0.5 * length, 0.01), 0.3)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _model_step(x, f, scale, step):  # type: ignore[no-untyped-def]
    """Fit a quadratic to costs above the best one, (K,), and write its trust-region step."""
    count, d = x.shape
    terms = (d + 1) * (d + 2) // 2
    distance = np.empty(count)
    for i in range(count):
        distance[i] = math.sqrt(np.sum(x[i] * x[i]))
    reach = max(distance[min(count - 1, terms + 3)], 1e-6)
    normal = np.zeros((terms, terms))
    right = np.zeros(terms)
    row = np.empty(terms)
    for i in range(count):
        far, high = distance[i] / reach, f[i] / (0.5 * scale + 1e-9)
        weight = (1.0 / (1.0 + far**4) + 1e-3) / (1.0 + high * high)
        row[0] = 1.0
        k = d + 1
        for a in range(d):
            row[1 + a] = x[i, a] / reach
            for b in range(a, d):
                row[k] = (x[i, a] / reach) * (x[i, b] / reach)
                k += 1
        for a in range(terms):
            w = weight * row[a]
            right[a] += w * f[i]
            for b in range(terms):
                normal[a, b] += w * row[b]
    trace = 0.0
    for a in range(terms):
        trace += normal[a, a]
    for a in range(terms):
        normal[a, a] += 1e-9 * trace / terms
    c = np.linalg.solve(normal, right)
    H = np.zeros((d, d))
    k = d + 1
    for a in range(d):
        for b in range(a, d):
            H[a, b] += c[k]
            H[b, a] += c[k]
            k += 1
    curvature, basis = np.linalg.eigh(H)
    slope = basis.T @ c[1 : d + 1]
    top = max(abs(curvature[0]), abs(curvature[-1]), 1e-300)
    push, size = 0.0, 0.0
    y = np.empty(d)
    for _ in range(60):
        size = 0.0
        for a in range(d):
            y[a] = -slope[a] / (max(curvature[a], 1e-3 * top) + push)
            size += y[a] * y[a]
        size = math.sqrt(size)
        if size <= 1.5:
            break
        push = max(1.5 * push, 1e-3 * top)
    if not size < 1e3:
        y[:] = 0.0
    for a in range(d):
        step[a] = 0.0
        for b in range(d):
            step[a] += basis[a, b] * y[b] * reach
