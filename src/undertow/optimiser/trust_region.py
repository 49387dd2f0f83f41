"""Quadratic-model search behind the ask/tell face of :mod:`undertow.optimiser.cma_es`.

Derivative-free trust-region search in the manner of Powell's NEWUOA, but for populations:
each generation is one batch, spread around the place where a quadratic model, fitted to
everything seen so far, expects the minimum.  A smooth cost of a few coordinates needs
fewer generations than a covariance takes to adapt; a rough one is better left to
:class:`undertow.optimiser.CMAES`.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.linalg import lapack

from undertow.closed_loop import INADMISSIBLE
from undertow.models import FloatArray
from undertow.optimiser.cma_es import check_start
from undertow.symbolic import compiled

#: Lengths tried along a step of the model.
STRETCHES = np.array([0.35, 0.7, 1.0, 1.4, 2.0, 3.0])


class TrustRegion:
    """Minimise a smooth function of few coordinates, a batch at a time.

    ``mean``: first guess, (d,). ``radius``: first spread of the samples around it. ``population``:
    candidates per generation; the first one has as many as the model needs. ``rng``: source of
    randomness: the same generator state gives the same search. Raises InvalidInputError for a mean
    that is not finite, or radius or population out of range.
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
        self._count = 0
        self._x, self._f = np.empty((8 * population, d)), np.empty(8 * population)

    @property
    def spread(self) -> float:
        """How far the next samples lie from the best one."""
        return max(self.radius, float(np.abs(self.step).max()))

    def ask(self) -> FloatArray:
        """Return the next candidates, (N, d).

        The first time the mean and a design around it; later steps of several lengths, and a
        design around the place where the model expects the minimum.  A design goes both ways
        along random orthogonal axes, then beyond.
        """
        d, lengths = self.mean.size, STRETCHES[: self.population // 2]
        count = self.population - len(lengths)
        if self.generation == 0:
            lengths = STRETCHES[:1]  # along no step at all: the mean itself
            count = self.population * math.ceil(1.2 * self.terms / self.population) - 1
        drawn = self.rng.standard_normal((1 + max(count - 2 * d, 0), d))
        x = np.empty((len(lengths) + count, d))
        _spread_out(self.best_x, self.step, lengths, self.radius, drawn, x)
        return x

    def tell(self, x: FloatArray, f: FloatArray) -> None:
        """Learn the costs ``f``, (N,), of candidates ``x``, (N, d); NaN counts as +∞."""
        while self._count + len(f) > len(self._f):
            self._x, self._f = np.repeat(self._x, 2, axis=0), np.repeat(self._f, 2)
        self.generation += 1
        self._count, best = _learn(x, f, self._x, self._f, self._count)
        if best >= 0 and f[best] < self.best_f:
            self.best_f, self.best_x = float(f[best]), x[best].copy()
        if self._count < self.terms:
            self.step[:] = 0.0
            self.radius *= 0.5
            return
        known = self._x[: self._count], self._f[: self._count]
        self.step[:] = _model_step(*known, self.best_x, self.best_f)
        length = math.sqrt(float((self.step * self.step).sum()))
        self.radius = min(max(0.5 * length, 0.01), 0.3)


@compiled()
def _spread_out(centre, step, lengths, radius, drawn, x):  # type: ignore[no-untyped-def]
    """Write candidates: lengths along the step, then a design around its end."""
    d, first = len(centre), len(lengths)
    for k in range(first):
        for j in range(d):
            x[k, j] = centre[j] + lengths[k] * step[j]
    norm = np.zeros(len(drawn))
    for k in range(len(drawn)):
        for j in range(d):
            norm[k] += drawn[k, j] * drawn[k, j]
        norm[k] = math.sqrt(norm[k])
    for k in range(first, len(x)):
        axis = k - first
        for j in range(d):
            if axis < 2 * d:  # columns of a reflection: orthogonal
                i = axis % d
                way = (1.0 if i == j else 0.0) - 2.0 * drawn[0, i] * drawn[0, j] / norm[0] ** 2
                way = way if axis < d else -way
            else:
                beyond = 1 + axis - 2 * d
                way = 1.5 * drawn[beyond, j] / norm[beyond]
            x[k, j] = centre[j] + step[j] + radius * way


@compiled()
def _learn(x, f, known_x, known_f, count):  # type: ignore[no-untyped-def]
    """Keep what is no penalty; return how many are known now, and the best of the new ones."""
    best = -1
    for k in range(len(f)):
        if f[k] < np.inf and (best < 0 or f[k] < f[best]):
            best = k
        if f[k] < INADMISSIBLE:  # from there on penalties stay out of the model
            for j in range(x.shape[1]):
                known_x[count, j] = x[k, j]
            known_f[count] = f[k]
            count += 1
    return count, best


def _model_step(
    known_x: FloatArray, known_f: FloatArray, best_x: FloatArray, best_f: float
) -> FloatArray:
    """Fit a quadratic to the costs near the best one; return its trust-region step."""
    d = best_x.size
    terms = (d + 1) * (d + 2) // 2
    away = np.empty(len(known_x))
    _distances(known_x, best_x, away)
    near = away.argsort(kind="stable")[: 3 * terms]
    reach = max(float(away[near[min(len(near) - 1, terms + 3)]]), 1e-6)
    normal, right, H = np.zeros((terms, terms)), np.zeros(terms), np.empty((d, d))
    _normal_equations(known_x, known_f, best_x, best_f, away, near, reach, normal, right)
    _, _, c, singular = lapack.dgesv(normal, right)
    _unpack(c, H)
    curvature, basis, unsolved = lapack.dsyevd(H, lower=1)
    if singular or unsolved:
        return np.zeros(d)
    step = np.empty(d)
    _shorten(curvature, basis, basis.T @ c[1 : d + 1], reach, step)
    return step


@compiled()
def _distances(x, centre, away):  # type: ignore[no-untyped-def]
    for i in range(len(x)):
        total = 0.0
        for j in range(len(centre)):
            total += (x[i, j] - centre[j]) * (x[i, j] - centre[j])
        away[i] = math.sqrt(total)


@compiled()
def _unpack(c, H):  # type: ignore[no-untyped-def]
    """Write the matrix of second derivatives of a quadratic of coefficients c."""
    d = len(H)
    k = d + 1
    for a in range(d):
        for b in range(a, d):
            H[a, b] = c[k]
            H[b, a] = c[k]
            k += 1
        H[a, a] *= 2.0


@compiled()
def _shorten(curvature, basis, slope, reach, step):  # type: ignore[no-untyped-def]
    """Write the step down a slope, in the basis of the curvatures, within the trust region."""
    d = len(slope)
    top = max(abs(curvature[0]), abs(curvature[d - 1]), 1e-300)
    push, size = 0.0, 0.0
    for _ in range(60):
        size = 0.0
        for a in range(d):
            part = slope[a] / (max(curvature[a], 1e-3 * top) + push)
            size += part * part
        size = math.sqrt(size)
        if size <= 1.5:
            break
        push = max(1.5 * push, 1e-3 * top)
    for a in range(d):
        step[a] = 0.0
        if size < 1e3:
            for b in range(d):
                part = -slope[b] / (max(curvature[b], 1e-3 * top) + push)
                step[a] += basis[a, b] * part * reach


@compiled()
def _normal_equations(  # type: ignore[no-untyped-def]
    known_x, known_f, best_x, best_f, away, near, reach, normal, right
):
    """Add up the normal equations, a little regularised, of a quadratic around the best one.

    Its coefficients: the constant, the slopes, and the second-order terms row by row.
    """
    d, terms = len(best_x), len(right)
    row, x = np.empty(terms), np.empty(d)
    for i in near:
        f = known_f[i] - best_f
        for a in range(d):
            x[a] = known_x[i, a] - best_x[a]
        far, high = away[i] / reach, f / (0.5 * abs(best_f) + 1e-9)
        weight = (1.0 / (1.0 + far**4) + 1e-3) / (1.0 + high * high)
        row[0] = 1.0
        k = d + 1
        for a in range(d):
            row[1 + a] = x[a] / reach
            for b in range(a, d):
                row[k] = (x[a] / reach) * (x[b] / reach)
                k += 1
        for a in range(terms):
            w = weight * row[a]
            right[a] += w * f
            for b in range(terms):
                normal[a, b] += w * row[b]
    trace = 0.0
    for a in range(terms):
        trace += normal[a, a]
    for a in range(terms):
        normal[a, a] += 1e-9 * trace / terms
