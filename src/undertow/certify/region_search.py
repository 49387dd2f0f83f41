"""The search for Lyapunov functions on the surface: samples, a linear program, counterexamples.

Nothing here proves anything: what is found goes to :func:`undertow.certify.region.verify_region`.

A function V, an even polynomial, is linear in its coefficients, and so are its demands at
sampled points: V̇ ≤ −t·|x|² inside a star-shaped candidate set, V ≥ 1 on the set's boundary,
V ≤ 1 on the way to a target point.  The linear program maximises t; points where fresh
samples disagree are added, and the candidate grows step by step from the quadratic V of the
linearisation.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy.linalg
from numpy.typing import ArrayLike, NDArray

from undertow.certify.linear_program import minimise_linear
from undertow.certify.region import LyapunovFunction, SurfaceMotion, first_crossing, verify_region
from undertow.certify.verdict import Verdict
from undertow.errors import InfeasibleError, UnstableSurfaceError

__all__ = ["ProvedRegion", "prove_region", "search_region"]

FloatArray = NDArray[np.float64]
Start = Literal["far", "round"]


@dataclass(frozen=True)
class ProvedRegion:
    """A proved region of attraction on the surface.

    Parameters
    ----------
    motion
        The sliding dynamics, in y = (q_u, q̇_u, w).
    function
        V; the set is the component of {V ≤ 1} that contains 0.
    verdict
        The proof.
    extent
        How far along the asked direction the set is proved to reach.
    """

    motion: SurfaceMotion
    function: LyapunovFunction
    verdict: Verdict
    extent: float


class _Basis:
    """Monomials of x = T⁻¹ y and their rates along the motion."""

    def __init__(self, motion: SurfaceMotion, T: FloatArray, degree: int) -> None:
        self.motion, self.T, self.T_inverse = motion, T, np.linalg.inv(T)
        size = motion.size
        self.exponents = np.array(
            [
                e
                for total in range(2, degree + 1, 2)
                for e in itertools.product(range(total, -1, -1), repeat=size)
                if sum(e) == total
            ]
        )

    def values(self, x: FloatArray) -> FloatArray:
        """Monomials, (B, N) to (B, K)."""
        top = int(self.exponents.max())
        powers = [np.ones_like(x)]
        for _ in range(top):
            powers.append(powers[-1] * x)
        table = np.array(powers)  # (power, B, N)
        out = np.ones((len(x), len(self.exponents)))
        for j in range(x.shape[1]):
            out *= table[self.exponents[:, j], :, j].T
        return out

    def rates(self, x: FloatArray) -> FloatArray:
        """Their time derivatives, (B, K)."""
        x_dot = self.motion(x @ self.T.T) @ self.T_inverse.T
        top = int(self.exponents.max())
        powers = [np.ones_like(x)]
        for _ in range(top):
            powers.append(powers[-1] * x)
        table = np.array(powers)
        out = np.zeros((len(x), len(self.exponents)))
        for j in range(x.shape[1]):
            lowered = self.exponents.copy()
            lowered[:, j] = np.maximum(lowered[:, j] - 1, 0)
            term = self.exponents[:, j] * x_dot[:, j : j + 1]
            for k in range(x.shape[1]):
                term = term * table[lowered[:, k], :, k].T
            out += term
        return out

    def function(self, coefficients: FloatArray) -> LyapunovFunction:
        return LyapunovFunction(self.T, self.exponents, coefficients)


def _quadratic(
    motion: SurfaceMotion, direction: FloatArray, rng: np.random.Generator, start: Start
) -> FloatArray:
    """T with V = |T⁻¹y|² whose set {V ≤ 1} reaches far along the direction."""
    A = _jacobian(motion)
    rate = -np.linalg.eigvals(A).real.max()
    if not rate > 0:
        raise UnstableSurfaceError(
            f"region of attraction of {motion.surface}",
            value=f"slowest rate {rate:.4g} 1/s",
            limit="> 0",
            remedy="Start from undertow.first_surface(mechanism)",
        )
    size = motion.size
    # Units in which the linear motion is about round.
    base = scipy.linalg.solve_continuous_lyapunov(A.T, -np.eye(size))
    units = 1 / np.sqrt(np.diag(base))
    rays = _rays(rng, 800, size)
    if start == "round":
        T = np.linalg.inv(np.linalg.cholesky(base * np.outer(units, units)).T) * units[:, None]
        return np.asarray(T * math.sqrt(_quadratic_level(motion, T, rays)))
    best, chosen, root = -1.0, np.eye(size), np.eye(size)
    width = 0.8
    # A (1+1) evolution strategy over the square root of Q, with the 1/5 success rule.
    for trial in range(240):
        change = width * rng.normal(size=(size, size))
        attempt = (
            np.diag(np.exp(rng.normal(size=size)))
            if trial < 40
            else scipy.linalg.expm(0.5 * (change + change.T)) @ root
        )
        Q = (attempt.T @ attempt + 1e-6 * np.eye(size)) / np.outer(units, units)
        P = scipy.linalg.solve_continuous_lyapunov(A.T, -Q)
        try:
            T = np.linalg.inv(np.linalg.cholesky(0.5 * (P + P.T)).T)
        except np.linalg.LinAlgError:
            continue
        level = _quadratic_level(motion, T, rays)
        reach = math.sqrt(level / float(direction @ P @ direction))
        if trial >= 40:
            width *= 1.25 if reach > best else 0.94
        if reach > best:
            best, chosen, root = reach, T * math.sqrt(level), attempt
    return chosen


def _jacobian(motion: SurfaceMotion, h: float = 1e-6) -> FloatArray:
    steps = h * np.eye(motion.size)
    return np.asarray((motion(steps) - motion(-steps)).T / (2 * h))


def _quadratic_level(motion: SurfaceMotion, T: FloatArray, rays: FloatArray) -> float:
    """Largest r² with V̇ < 0 at samples of |T⁻¹y| ≤ r, inside the non-singular set."""
    inverse = np.linalg.inv(T)
    sign = float(np.sign(motion.determinant(np.zeros(motion.size))))

    def holds(r: float) -> bool:
        y = (r * rays) @ T.T
        rate = np.sum(rays * (motion(y) @ inverse.T), axis=1)
        return bool((rate < 0).all() and (motion.determinant(y) * sign > 0).all())

    r = 1.0
    while not holds(r) and r > 1e-9:
        r /= 2
    grow = r * 1.1
    while holds(grow) and grow < 1e9:
        r, grow = grow, grow * 1.1
    return r * r


def _rays(rng: np.random.Generator, count: int, size: int) -> FloatArray:
    rays = rng.normal(size=(count, size))
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def search_region(
    motion: SurfaceMotion,
    direction: ArrayLike,
    *,
    degrees: Sequence[int] = (4, 6),
    seconds: float = 60.0,
    seed: int = 0,
    start: Start = "far",
    samples: int = 5000,
    progress: Callable[[str], None] | None = None,
) -> LyapunovFunction:
    """Find V whose set {V ≤ 1} reaches far along a direction of y, by sampling.

    Parameters
    ----------
    direction
        In y = (q_u, q̇_u, w), (N,): e.g. (1, 0, 0) for the pendulum's angle at rest.
    degrees
        Even degrees of V, tried one after the other, each starting from the last.
    seconds
        Budget, shared by the degrees.
    start
        The quadratic V to begin with: ``"far"`` reaches far along the direction and grows
        little; ``"round"`` starts closer and often grows further.
    progress
        Called with a line of text after each step.

    Raises
    ------
    UnstableSurfaceError
        When the surface is not locally stable.
    """
    rng = np.random.default_rng(seed)
    way = np.asarray(direction, dtype=float)
    T = _quadratic(motion, way, rng, start)
    # The quadratic's unit ball is made the start; a little inside, so t > 0 is possible.
    coefficients = None
    basis = _Basis(motion, T, 2)
    previous = basis.function((basis.exponents == 2).any(axis=1).astype(float) * 1.02)
    for k, degree in enumerate(degrees):
        basis = _Basis(motion, T, degree)
        coefficients = _lift(previous, basis)
        share = seconds * (k + 1) / sum(range(1, len(degrees) + 1))
        previous = _grow(basis, coefficients, way, rng, share, samples, progress)
    return previous


def _lift(V: LyapunovFunction, basis: _Basis) -> FloatArray:
    """The same function in a larger basis."""
    known = {tuple(e): c for e, c in zip(V.exponents.tolist(), V.coefficients, strict=True)}
    return np.array([known.get(tuple(e), 0.0) for e in basis.exponents.tolist()])


def extent(V: LyapunovFunction, direction: FloatArray) -> float:
    """Return r with V(r·direction) = 1, the first such, in float64."""
    ray = np.asarray(np.linalg.solve(V.scale, direction), dtype=np.float64)
    length = float(np.linalg.norm(ray))
    unit: FloatArray = (ray / length)[None, :]
    return float(first_crossing(V, unit)[0]) / length


class _Grower:
    """The linear program's rows around one candidate."""

    def __init__(self, basis: _Basis, rng: np.random.Generator) -> None:
        self.basis, self.rng = basis, rng
        self.size = basis.motion.size
        self.sign = float(np.sign(basis.motion.determinant(np.zeros(self.size))))
        self.reference = abs(float(basis.motion.determinant(np.zeros(self.size))))

    def shell(self, V: LyapunovFunction, rays: FloatArray, growth: float) -> FloatArray:
        """Boundary points of the candidate: V's set, grown, cut before the singularity."""
        radius = first_crossing(V, rays)
        radius = np.minimum(np.where(np.isfinite(radius), radius, 20.0) * (1 + growth), 20.0)
        for _ in range(200):
            y = (radius[:, None] * rays) @ self.basis.T.T
            bad = self.basis.motion.determinant(y) * self.sign < 0.005 * self.reference
            if not bad.any():
                break
            radius = np.where(bad, 0.97 * radius, radius)
        return np.asarray(radius[:, None] * rays)

    def around(self, V: LyapunovFunction, shell: FloatArray, growth: float) -> FloatArray:
        """Points outside the candidate but in the box that the checker will take."""
        box = 1.1 * np.abs(shell).max(axis=0)
        x = box * self.rng.uniform(-1, 1, (len(shell), self.size))
        limit = np.linalg.norm(self.shell(V, _unit(x), growth), axis=1)
        return np.asarray(x[np.linalg.norm(x, axis=1) > limit])

    def decrease(self, x: FloatArray) -> FloatArray:
        """Rows of V̇/|x|² + t ≤ 0."""
        rows = self.basis.rates(x) / np.sum(x * x, axis=1)[:, None]
        return np.hstack([rows, np.ones((len(x), 1))])

    def boundary(self, x: FloatArray) -> FloatArray:
        """Rows of −V ≤ −(more than 1)."""
        return np.hstack([-self.basis.values(x), np.zeros((len(x), 1))])

    def near_zero(self, coefficients: FloatArray) -> FloatArray:
        """The worst directions of the quadratic part of V̇: exact, where samples miss."""
        h = 1e-4
        steps = h * np.eye(self.size)
        rows = np.zeros((self.size, self.size))

        def rate(x: FloatArray) -> FloatArray:
            return np.asarray(self.basis.rates(x) @ coefficients) / h**2

        single = rate(steps)
        for i, j in itertools.product(range(self.size), repeat=2):
            both = rate((steps[i] + steps[j])[None, :])[0]
            rows[i, j] = 0.5 * (both - single[i] - single[j])
        _, vectors = np.linalg.eigh(0.5 * (rows + rows.T))
        return 1e-3 * vectors.T

    def counterexamples(
        self, V: LyapunovFunction, row: FloatArray, growth: float, t: float
    ) -> tuple[FloatArray, FloatArray]:
        """Fresh points (local ascent included) where decrease or boundary fail."""
        rays = _rays(self.rng, 15000, self.size)
        shell = self.shell(V, rays, growth)
        inner = shell * self.rng.random((len(shell), 1)) ** (1 / 2)
        score = self.basis.rates(inner) @ row / np.sum(inner**2, axis=1)
        for width in (0.05, 0.02, 0.005):
            worst = inner[np.argsort(score)[-150:]]
            near = np.repeat(worst, 8, axis=0)
            near = near * (1 + width * self.rng.normal(size=near.shape))
            near = near + width * self.rng.normal(size=near.shape) * np.linalg.norm(
                near, axis=1, keepdims=True
            )
            limit = np.linalg.norm(self.shell(V, _unit(near), growth), axis=1)
            near = near[np.linalg.norm(near, axis=1) <= limit]
            inner = np.vstack([inner, near])
            score = np.concatenate([score, self.basis.rates(near) @ row / np.sum(near**2, axis=1)])
        bad = inner[score > -0.3 * t]
        # A random part of the offenders: the worst ones crowd together.
        bad = bad[self.rng.permutation(len(bad))[:300]]
        core = self.near_zero(row)
        score = self.basis.rates(core) @ row / np.sum(core**2, axis=1)
        shell = np.vstack([shell, self.around(V, shell, growth)])
        edge = shell[self.basis.values(shell) @ row < 1.0]
        return np.vstack([bad, core[score > -0.3 * t]]), edge[:300]


def _unit(x: FloatArray) -> FloatArray:
    return np.asarray(x / np.linalg.norm(x, axis=1, keepdims=True))


def _grow(
    basis: _Basis,
    coefficients: FloatArray,
    way: FloatArray,
    rng: np.random.Generator,
    seconds: float,
    samples: int,
    progress: Callable[[str], None] | None,
) -> LyapunovFunction:
    started = time.monotonic()
    grower = _Grower(basis, rng)
    rate = -np.linalg.eigvals(_jacobian(basis.motion)).real.max()
    V = basis.function(coefficients)
    growth, step = 0.06, 0.04
    while growth > 0.004 and time.monotonic() - started < seconds:
        reach = extent(V, way)
        # On the samples of the boundary; between them V must still be ≥ 1.
        edge_value = 1 + 0.25 * growth
        shell = grower.shell(V, _rays(rng, samples, basis.motion.size), growth)
        inner = np.vstack(
            [
                shell * rng.random((len(shell), 1)) ** 0.5,
                0.999 * shell,
                1e-3 * _rays(rng, samples // 4, basis.motion.size),
            ]
        )
        beyond = grower.around(V, shell, growth)[::2]
        targets = np.linspace(0.1, 1.0, 10)[:, None] * (reach * (1 + step) * way)
        on_way = basis.values(targets @ basis.T_inverse.T)
        rows = [
            grower.decrease(inner),
            grower.boundary(np.vstack([shell[::2], beyond])),
            -grower.boundary(shell[::2]),
            np.hstack([on_way, np.zeros((10, 1))]),
            np.eye(1, len(coefficients) + 1, len(coefficients)),
        ]
        count = len(shell[::2])
        right = np.concatenate(
            [
                np.zeros(len(inner)),
                np.full(count + len(beyond), -edge_value),
                np.full(count, 1.8),
                np.linspace(0.1, 1.0, 10),
                [0.5 * rate],
            ]
        )
        A = np.vstack(rows)
        goal = np.zeros(A.shape[1])
        goal[-1] = -1.0
        accepted = None
        for _ in range(7):
            x = minimise_linear(goal, A, right)
            if x is None or x[-1] < 1e-3 * rate:
                break
            inside, edge = grower.counterexamples(V, x[:-1], growth, x[-1])
            if not len(inside) and not len(edge):
                accepted = x
                break
            A = np.vstack([A, grower.decrease(inside), grower.boundary(edge)])
            right = np.concatenate([right, np.zeros(len(inside)), np.full(len(edge), -edge_value)])
        candidate = None if accepted is None else basis.function(accepted[:-1])
        if candidate is not None and extent(candidate, way) > reach * 1.0005:
            V = candidate
            growth, step = min(1.2 * growth, 0.15), min(1.2 * step, 0.1)
            if progress is not None and accepted is not None:
                progress(
                    f"degree {basis.exponents.sum(axis=1).max()}: reach {extent(V, way):.4f}, "
                    f"decay {accepted[-1] / rate:.3f}, {time.monotonic() - started:.0f} s"
                )
        else:
            growth, step = growth / 1.5, step / 1.5
    return V


def prove_region(
    motion: SurfaceMotion,
    direction: ArrayLike,
    *,
    degrees: Sequence[int] = (4, 6),
    seconds: float = 60.0,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> ProvedRegion:
    """Search for a region of attraction on the surface and prove it.

    Parameters
    ----------
    motion, direction, degrees, seconds, seed, progress
        As for :func:`search_region`.

    Returns
    -------
    ProvedRegion
        The larger of two searches with different starts; a set that cannot be proved is shrunk.

    Raises
    ------
    InfeasibleError
        When none of the sets could be proved; the message carries the last verdict.
    UnstableSurfaceError
        When the surface is not locally stable.
    """
    way = np.asarray(direction, dtype=float)
    best, verdict = None, None
    starts: tuple[Start, ...] = ("far", "round")
    for start in starts:
        V = search_region(
            motion,
            direction,
            degrees=degrees,
            seconds=0.5 * seconds,
            seed=seed,
            start=start,
            progress=progress,
        )
        for factor in (1.001, 1.01, 1.03, 1.06, 1.1, 1.3, 2.0):
            candidate = V.times(factor)
            reach = extent(candidate, way) * (1 - 1e-9)
            if best is not None and reach <= best.extent:
                break
            verdict = verify_region(motion, candidate)
            if progress is not None:
                progress(f"level 1/{factor}: {verdict}, {verdict.details.get('boxes')} boxes")
            if verdict:
                best = ProvedRegion(motion, candidate, verdict, reach)
                break
    if best is not None:
        return best
    raise InfeasibleError(
        f"region of attraction of {motion.surface}",
        value=str(verdict),
        limit="a proved sublevel set",
        remedy="Give the search more seconds or another degree",
    )
