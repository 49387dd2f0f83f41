"""Growing a chain of Lyapunov functions: samples, linear programs, counterexamples.

Nothing here proves anything: what is found goes to :func:`undertow.proofs.verify_region`.

An even polynomial V is linear in its coefficients, and so are its demands at sampled points.
The next function of a chain has to fall, V̇ ≤ −t (|z|² + |z||ż|/ω), in a ring alone: from a
little inside the last set to a shell a little outside it.  On the shell and from there to a
guard it has to be ≥ 1; inside the ring ≤ the level of the ring's inner edge, so that sets do not
shrink much; at the target point ≤ 1.  Of all such V the linear program takes the one with the
smallest largest coefficient: one that falls as fast as can be is steep or wavy, and leaves no
room for the next.  Points where fresh samples disagree are added.  Before each step the
coordinates are scaled so that the last set is about the unit ball, which keeps the programs
well conditioned however far the sets have come.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np

from undertow.models.mechanism import FloatArray
from undertow.proofs.region.lyapunov import LyapunovFunction, directions, extent, unit
from undertow.proofs.region.motion import SurfaceMotion
from undertow.proofs.search.basis import (
    CLEARANCE,
    FARTHEST,
    POLE_PART,
    Basis,
    linear_part,
    slowest_rate,
)
from undertow.proofs.search.linear_program import minimise_linear

#: V where the ring begins; how far that edge may come in; t over the slowest rate.
INNER, INWARD, DECAY = 0.9, 0.9, 0.03
#: Bounds of V on the shell, and of its coefficients in scaled coordinates.
SHELL, LARGEST = 1.8, 1000.0
#: Rounds of counterexamples, samples of each linear program before them.
ROUNDS, SAMPLES = 10, 3000
#: The search ends where no set that is larger by this part is found.
LEAST_GROWTH = 0.003


class SearchBudget:
    """Linear programs and time that are left; ``pace``: how long the last one took, s."""

    def __init__(
        self,
        programs: int,
        seconds: float,
        pace: float = 0.0,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        """Start now."""
        self.programs, self.pace, self.clock = programs, pace, clock
        self.end = clock() + seconds

    @contextmanager
    def spend(self) -> Iterator[None]:
        """Count one linear program, and how long it takes with what belongs to it."""
        self.programs -= 1
        began = self.clock()
        yield
        self.pace = self.clock() - began

    @property
    def in_time(self) -> bool:
        """Whether one as long as the last would end in time."""
        return self.clock() + self.pace < self.end

    @property
    def left(self) -> bool:
        """Whether another may start."""
        return self.programs > 0 and self.in_time


def grow(
    motion: SurfaceMotion,
    V: LyapunovFunction,
    way: FloatArray,
    degree: int,
    budget: SearchBudget,
    rng: np.random.Generator,
) -> list[LyapunovFunction]:
    """Return functions whose sets reach further and further along ``way``, each for the last.

    ``motion``: the motion. ``V``: the first set, {V ≤ 1}. ``way``: direction in y, (N,).
    ``degree``: even degree of the functions. ``budget``: what may be spent.
    """
    chain: list[LyapunovFunction] = []
    growth, step = 0.06, 0.04
    ring = _Ring(motion, V, degree, rng)
    while growth > LEAST_GROWTH and budget.left:
        reach = extent(V, way)
        if reach >= FARTHEST:
            break
        row = ring.next(way, growth, step, reach, budget)
        found = None if row is None else ring.basis.function(row)
        if found is not None and extent(found, way) > reach * 1.0003:
            V = found
            chain.append(V)
            growth, step = min(1.25 * growth, 0.2), min(1.25 * step, 0.15)
            ring = _Ring(motion, V, degree, rng)
        else:
            growth, step = growth / 1.5, step / 1.5
    return chain


class _Ring:
    """The last set of a chain, in coordinates in which it is about the unit ball."""

    def __init__(
        self, motion: SurfaceMotion, V: LyapunovFunction, degree: int, rng: np.random.Generator
    ) -> None:
        self.motion, self.rng, self.size = motion, rng, motion.size
        chart = V
        for _ in range(2):
            basis = Basis(motion, chart, degree)
            row = _expansion(V, basis, rng)
            rays = directions(rng, 6000, self.size)
            edge = rays * _crossing(basis, row, rays, 1.0)[:, None]
            root = np.linalg.cholesky(edge.T @ edge / len(edge) * self.size)
            chart = LyapunovFunction.quadratic(chart.scale @ root, V.stretch, V.pole)
        self.basis = Basis(motion, chart, degree)
        self.row = _expansion(V, self.basis, rng)
        self.omega = float(np.linalg.norm(linear_part(motion, chart), 2))

    def next(
        self, way: FloatArray, growth: float, step: float, reach: float, budget: SearchBudget
    ) -> FloatArray | None:
        """Coefficients of the next function; None where fresh samples disagree to the end."""
        basis, rng, columns = self.basis, self.rng, len(self.basis.exponents) + 1
        rate = slowest_rate(self.motion)
        rays = directions(rng, SAMPLES, self.size)
        low, high = self._ends(rays, growth)
        shell = rays * high[:, None]
        root = np.linalg.cholesky(shell.T @ shell / len(shell) * self.size)
        guard = np.linalg.inv(root)
        guard /= 1.03 * np.linalg.norm(shell @ guard.T, axis=1).max()
        decrease = self._decrease(
            np.vstack(
                [self._between(rays, low, high), self._between(rays, low, high), 0.999 * shell]
            )
        )
        some = slice(None, None, 2)
        outside = -self._padded(
            np.vstack([shell[some], self._beyond(rays[some], high[some], guard)])
        )
        inside = rays * (low * INWARD * rng.random(len(rays)) ** 0.2)[:, None]
        length = float(np.linalg.norm(basis.chart.coordinates(reach * way)))
        on_way = _on_axis(basis.chart, way, (1 + step) * length)
        size = np.ones((columns - 1, 1))
        bounds = np.vstack([np.hstack([k * np.eye(columns - 1), -size]) for k in (1, -1)])
        fixed = np.vstack(
            [
                self._padded(shell[some]),
                self._padded(on_way),
                self._padded(np.vstack([inside, rays * (low * INWARD)[:, None]])),
                bounds,
            ]
        )
        limits = np.repeat(
            [SHELL, 1.0, INNER, 0.0],
            [len(shell[some]), len(on_way), 2 * len(rays), 2 * (columns - 1)],
        )
        goal = np.zeros(columns)
        goal[-1] = 1.0
        for k in range(ROUNDS):
            if k and not budget.in_time:
                return None
            right = np.concatenate(
                [
                    np.full(len(decrease), -DECAY * rate),
                    np.full(len(outside), -1 - 0.25 * growth),
                    limits,
                ]
            )
            with budget.spend():
                x = minimise_linear(goal, np.vstack([decrease, outside, fixed]), right)
                if x is None or x[-1] > LARGEST:
                    return None
                bad, low_points = self._counterexamples(x[:-1], growth, DECAY * rate, guard)
            if not len(bad) and not len(low_points):
                return np.asarray(x[:-1])
            decrease = np.vstack([decrease, self._decrease(bad)])
            outside = np.vstack([outside, -self._padded(low_points)])
        return None

    def _ends(self, rays: FloatArray, growth: float) -> tuple[FloatArray, FloatArray]:
        """Where the ring begins and ends: before the singularity and the pole."""
        high = _crossing(self.basis, self.row, rays, 1.0) * (1 + growth)
        out = np.ones(len(high), dtype=bool)
        for _ in range(300):
            y = self.basis.chart.points(high[out, None] * rays[out])
            bad = self.motion.margin(y) < CLEARANCE
            bad |= np.abs(y[:, 0]) > POLE_PART * self.basis.chart.pole
            out[out] = bad
            if not bad.any():
                break
            high[out] *= 0.97
        return np.minimum(_crossing(self.basis, self.row, rays, INNER), high), high

    def _between(self, rays: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
        return np.asarray(rays * (low + (high - low) * self.rng.random(len(rays)))[:, None])

    def _beyond(self, rays: FloatArray, high: FloatArray, guard: FloatArray) -> FloatArray:
        """Points from the shell to the guard, and on it."""
        edge = 1 / np.linalg.norm(rays @ guard.T, axis=1)
        return np.vstack([self._between(rays, high, edge), rays * edge[:, None]])

    def _padded(self, z: FloatArray) -> FloatArray:
        """Rows of V, with a column for the size of the coefficients."""
        return np.hstack([self.basis.values(z), np.zeros((len(z), 1))])

    def _decrease(self, z: FloatArray) -> FloatArray:
        """Rows of V̇ over |z|² + |z||ż|/ω."""
        z_dot = self.basis.flow(z)
        length = np.linalg.norm(z, axis=1)
        weight = length * (length + np.linalg.norm(z_dot, axis=1) / self.omega)
        return np.hstack([self.basis.rates(z, z_dot) / weight[:, None], np.zeros((len(z), 1))])

    def _counterexamples(
        self, row: FloatArray, growth: float, t: float, guard: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Fresh points, local ascent included, where the fall or V ≥ 1 fail."""
        rng = self.rng
        rays = directions(rng, 8000, self.size)
        low, high = self._ends(rays, growth)
        points = self._between(rays, low, high)
        score = self._decrease(points)[:, :-1] @ row
        for width in (0.05, 0.02, 0.005):
            near = np.repeat(points[np.argsort(score)[-150:]], 8, axis=0)
            near = near + width * rng.normal(size=near.shape)
            start, end = self._ends(unit(near), growth)
            length = np.linalg.norm(near, axis=1)
            near = near[(length >= start) & (length <= end)]
            points = np.vstack([points, near])
            score = np.concatenate([score, self._decrease(near)[:, :-1] @ row])
        # A random part of the offenders: the worst ones crowd together.
        bad = points[score > -0.3 * t]
        edge = np.vstack([rays * high[:, None], self._beyond(rays, high, guard)])
        edge = edge[self.basis.values(edge) @ row < 1.0]
        return bad[rng.permutation(len(bad))[:300]], edge[rng.permutation(len(edge))[:300]]


def _expansion(V: LyapunovFunction, basis: Basis, rng: np.random.Generator) -> FloatArray:
    """V's coefficients in a basis whose coordinates are a linear map of V's: exact but rounding."""
    count = 4 * len(basis.exponents) + 50
    z = directions(rng, count, basis.size) * rng.uniform(0.3, 1.2, (count, 1))
    own = z @ np.linalg.solve(V.scale, basis.chart.scale).T
    values = np.prod(own[:, None, :] ** V.exponents, axis=-1) @ V.coefficients
    return np.asarray(np.linalg.lstsq(basis.values(z), values, rcond=None)[0])


def _crossing(basis: Basis, row: FloatArray, rays: FloatArray, level: float) -> FloatArray:
    """First r with V = level along unit rays, by a scan in 4 % steps; 8 at most."""
    totals = basis.exponents.sum(axis=1)
    powers = basis.values(rays)
    parts = {int(d): powers[:, totals == d] @ row[totals == d] for d in np.unique(totals)}

    def value(r: FloatArray) -> FloatArray:
        return np.asarray(sum(part * r**d for d, part in parts.items()))

    grid = np.geomspace(0.03, 8.0, 140)
    above = value(grid[:, None]) >= level
    first, any_above = above.argmax(axis=0), above.any(axis=0)
    high = np.where(any_above, grid[first], grid[-1])
    low = np.where(first > 0, grid[np.maximum(first - 1, 0)], 0.0)
    for _ in range(24):
        middle = 0.5 * (low + high)
        up = value(middle) >= level
        high, low = np.where(up, middle, high), np.where(up, low, middle)
    return np.asarray(np.where(any_above, high, grid[-1]))


def _on_axis(coordinates: LyapunovFunction, way: FloatArray, length: float) -> FloatArray:
    """Points of z on the way, as far as |z| = length or the pole's part, (10, N)."""
    top = POLE_PART * coordinates.pole / abs(way[0]) if way[0] else np.inf
    low, high = 0.0, min(top, 1.0)
    while high < top and np.linalg.norm(coordinates.coordinates(high * way)) < length:
        high = min(2 * high, top)
    for _ in range(50):
        middle = 0.5 * (low + high)
        short = np.linalg.norm(coordinates.coordinates(middle * way)) < length
        low, high = (middle, high) if short else (low, middle)
    parts = np.linspace(0.1, 1.0, 10)[:, None]
    return coordinates.coordinates(parts * (low * way))
