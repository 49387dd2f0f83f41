"""The search for Lyapunov functions: samples, a linear program, counterexamples.

Nothing here proves anything: what is found goes to :func:`undertow.certify.region.verify_region`.

A function V, an even polynomial in z, is linear in its coefficients, and so are its demands
at sampled points: V̇ ≤ −t·(|z|² + |z||ż|/ω) inside a star-shaped candidate set, V ≥ 1 on the
set's boundary, V ≤ 1 on the way to a target point.  The linear program maximises t; points
where fresh samples disagree are added, and the candidate grows step by step from the
quadratic V of the linearisation.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import scipy.linalg
from numpy.typing import ArrayLike, NDArray

from undertow.certify.linear_program import minimise_linear
from undertow.certify.lyapunov import LyapunovFunction, extent, first_crossing
from undertow.certify.motion import Motion, SurfaceMotion
from undertow.certify.region import verify_region
from undertow.certify.region_chart import natural_stretch
from undertow.certify.verdict import Verdict
from undertow.errors import InfeasibleError, UnstableSurfaceError

__all__ = ["ProvedRegion", "prove_region", "search_region"]

FloatArray = NDArray[np.float64]
Progress = Callable[[str], None]
Start = Literal["far", "round"]

#: The candidate keeps det f / det f(0) above this, and |y_0| below this part of the pole.
CLEARANCE, POLE_PART = 0.01, 0.985


@dataclass(frozen=True)
class ProvedRegion:
    """A proved region of attraction.

    Parameters
    ----------
    motion
        The motion, on a surface in y = (q_u, q̇_u, w).
    function
        V; the set is the component of {V ≤ 1} that contains 0.
    verdict
        The proof.
    extent
        How far along the asked direction the set is proved to reach.
    raised
        What the checker says of a level at most 2 % higher: never ``proved``, and with a
        witness.
    """

    motion: Motion
    function: LyapunovFunction
    verdict: Verdict
    extent: float
    raised: Verdict


class _Basis:
    """Monomials of z and their rates along the motion."""

    def __init__(self, motion: Motion, chart: LyapunovFunction, degree: int) -> None:
        self.motion, self.chart = motion, chart
        self.size = motion.size
        self.exponents = _even_exponents(self.size, degree)

    def _table(self, z: FloatArray) -> FloatArray:
        top = int(self.exponents.max())
        return np.array([z**k for k in range(top + 1)])  # (power, B, N)

    def values(self, z: FloatArray) -> FloatArray:
        """Monomials, (B, N) to (B, K)."""
        table = self._table(z)
        out = np.ones((len(z), len(self.exponents)))
        for j in range(self.size):
            out *= table[self.exponents[:, j], :, j].T
        return out

    def flow(self, z: FloatArray) -> FloatArray:
        """ż, (B, N)."""
        y = self.chart.points(z)
        return self.chart.coordinate_rates(y, self.motion(y))

    def rates(self, z: FloatArray, z_dot: FloatArray) -> FloatArray:
        """Time derivatives of the monomials, (B, K)."""
        table = self._table(z)
        out = np.zeros((len(z), len(self.exponents)))
        for j in range(self.size):
            lowered = self.exponents.copy()
            lowered[:, j] = np.maximum(lowered[:, j] - 1, 0)
            term = self.exponents[:, j] * z_dot[:, j : j + 1]
            for k in range(self.size):
                term = term * table[lowered[:, k], :, k].T
            out += term
        return out

    def function(self, coefficients: FloatArray) -> LyapunovFunction:
        """The polynomial with these coefficients."""
        return self.chart.replaced(coefficients, self.exponents)


def _even_exponents(size: int, degree: int) -> NDArray[np.int64]:
    return np.array(
        [
            e
            for total in range(2, degree + 1, 2)
            for e in itertools.product(range(total, -1, -1), repeat=size)
            if sum(e) == total
        ]
    )


def _rays(rng: np.random.Generator, count: int, size: int) -> FloatArray:
    return _unit(rng.normal(size=(count, size)))


def _unit(z: FloatArray) -> FloatArray:
    return np.asarray(z / np.linalg.norm(z, axis=1, keepdims=True))


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
    return coordinates.coordinates(np.linspace(0.1, 1.0, 10)[:, None] * (low * way))


class _Candidate:
    """A star-shaped set in z: V's, grown, cut before the singularity and the pole."""

    def __init__(self, basis: _Basis, rng: np.random.Generator) -> None:
        self.basis, self.rng, self.size = basis, rng, basis.size
        self.reference = float(basis.motion.determinant(np.zeros(self.size)))
        self.omega = float(np.linalg.norm(_linear(basis.motion, basis.chart), 2))

    def shell(self, V: LyapunovFunction, rays: FloatArray, growth: float) -> FloatArray:
        """Boundary points along rays."""
        radius = first_crossing(V, rays)
        radius = np.minimum(np.where(np.isfinite(radius), radius, 50.0) * (1 + growth), 50.0)
        out = np.ones(len(radius), dtype=bool)
        for _ in range(300):
            y = self.basis.chart.points(radius[out, None] * rays[out])
            bad = self.basis.motion.determinant(y) / self.reference < CLEARANCE
            bad |= np.abs(y[:, 0]) > POLE_PART * self.basis.chart.pole
            out[out] = bad
            if not bad.any():
                break
            radius[out] *= 0.95
        return np.asarray(radius[:, None] * rays)

    def inside(self, V: LyapunovFunction, z: FloatArray, growth: float) -> NDArray[np.bool_]:
        """Whether points lie in the candidate."""
        limit = np.linalg.norm(self.shell(V, _unit(z), growth), axis=1)
        return np.asarray(np.linalg.norm(z, axis=1) <= limit)

    def around(self, V: LyapunovFunction, shell: FloatArray, growth: float) -> FloatArray:
        """Points outside the candidate but in the box that the checker will take."""
        y = self.basis.chart.points(shell)
        B = np.linalg.cholesky(np.cov(y.T, bias=True).reshape(self.size, self.size))
        reach = 1.08 * np.abs(np.linalg.solve(B, y.T)).max(axis=1)
        points = (reach * self.rng.uniform(-1, 1, (len(shell), self.size))) @ B.T
        points = points[np.abs(points[:, 0]) < 0.998 * self.basis.chart.pole]
        z = self.basis.chart.coordinates(points)
        near = np.linalg.norm(z, axis=1) < 3 * np.linalg.norm(shell, axis=1).max()
        return np.asarray(z[near & ~self.inside(V, z, growth)])

    def decrease(self, z: FloatArray) -> FloatArray:
        """Rows of V̇ + t·(|z|² + |z||ż|/ω) ≤ 0, over that weight."""
        z_dot = self.basis.flow(z)
        length = np.linalg.norm(z, axis=1)
        weight = length * (length + np.linalg.norm(z_dot, axis=1) / self.omega)
        return np.hstack([self.basis.rates(z, z_dot) / weight[:, None], np.ones((len(z), 1))])

    def score(self, z: FloatArray, coefficients: FloatArray) -> FloatArray:
        """V̇ over the weight."""
        return np.asarray(self.decrease(z)[:, :-1] @ coefficients)

    def boundary(self, z: FloatArray) -> FloatArray:
        """Rows of −V ≤ −(more than 1)."""
        return np.hstack([-self.basis.values(z), np.zeros((len(z), 1))])

    def near_zero(self, coefficients: FloatArray) -> FloatArray:
        """The worst directions of the quadratic part of V̇: exact, where samples miss."""
        A = _linear(self.basis.motion, self.basis.chart)
        P = np.zeros((self.size, self.size))
        for e, c in zip(self.basis.exponents, coefficients, strict=True):
            if e.sum() == 2:
                i, j = np.repeat(np.arange(self.size), e)
                P[i, j] += 0.5 * c
                P[j, i] += 0.5 * c
        return np.asarray(1e-3 * np.linalg.eigh(A.T @ P + P @ A)[1].T)

    def counterexamples(
        self, V: LyapunovFunction, row: FloatArray, growth: float, t: float
    ) -> tuple[FloatArray, FloatArray]:
        """Fresh points (local ascent included) where decrease or boundary fail."""
        shell = self.shell(V, _rays(self.rng, 12000, self.size), growth)
        inner = shell * self.rng.random((len(shell), 1)) ** (1 / 2)
        score = self.score(inner, row)
        for width in (0.05, 0.02, 0.005):
            worst = inner[np.argsort(score)[-150:]]
            near = np.repeat(worst, 8, axis=0)
            near = near * (1 + width * self.rng.normal(size=near.shape))
            near = near + width * self.rng.normal(size=near.shape) * np.linalg.norm(
                near, axis=1, keepdims=True
            )
            near = near[self.inside(V, near, growth)]
            inner = np.vstack([inner, near])
            score = np.concatenate([score, self.score(near, row)])
        bad = inner[score > -0.3 * t]
        # A random part of the offenders: the worst ones crowd together.
        bad = bad[self.rng.permutation(len(bad))[:300]]
        core = self.near_zero(row)
        score = self.score(core, row)
        shell = np.vstack([shell, self.around(V, shell, growth)])
        edge = shell[self.basis.values(shell) @ row < 1.0]
        edge = edge[self.rng.permutation(len(edge))[:300]]
        return np.vstack([bad, core[score > -0.3 * t]]), edge


def _linear(motion: Motion, chart: LyapunovFunction) -> FloatArray:
    """The linearisation in z."""
    return np.asarray(np.linalg.solve(chart.scale, motion.jacobian @ chart.scale))


# -- the start: a quadratic V -----------------------------------------------------------------


def _slowest(motion: Motion) -> float:
    rate = float(-np.linalg.eigvals(motion.jacobian).real.max())
    if not rate > 0:
        raise UnstableSurfaceError(
            f"region of attraction of {getattr(motion, 'surface', motion.names)}",
            value=f"slowest rate {rate:.4g} 1/s",
            limit="> 0",
            remedy="Start from undertow.first_surface(mechanism)",
        )
    return rate


def _quadratic(
    motion: Motion,
    stretch: tuple[FloatArray, float] | None,
    way: FloatArray,
    rng: np.random.Generator,
    start: Start,
) -> LyapunovFunction:
    """V = |z|², whose set {V ≤ 1} reaches far along the direction."""
    _slowest(motion)
    A, size = motion.jacobian, motion.size
    squares = 2 * np.eye(size, dtype=np.int64)
    S, pole = stretch if stretch is not None else (None, np.inf)
    # Units in which the linear motion is about round.
    base = scipy.linalg.solve_continuous_lyapunov(A.T, -np.eye(size))
    units = 1 / np.sqrt(np.diag(base))
    rays = _rays(rng, 500, size)

    def largest(T: FloatArray, stretched: bool) -> LyapunovFunction:
        """V = |z|², as large as samples allow; the search itself goes without the stretch."""
        bend = (S, pole) if stretched else (None, np.inf)
        r = _quadratic_radius(motion, LyapunovFunction(T, squares, np.ones(size), *bend), rays)
        return LyapunovFunction(r * T, squares, np.ones(size), *bend)

    if start == "round":
        return largest(_root(base), stretched=True)
    best, root, width = -1.0, np.eye(size), 0.8
    chosen: LyapunovFunction | None = None
    # A (1+1) evolution strategy over the square root of Q, with the 1/5 success rule.
    for k in range(240):
        change = width * rng.normal(size=(size, size))
        attempt = (
            np.diag(np.exp(rng.normal(size=size)))
            if k < 40
            else scipy.linalg.expm(0.5 * (change + change.T)) @ root
        )
        Q = (attempt.T @ attempt + 1e-6 * np.eye(size)) / np.outer(units, units)
        V = largest(_root(scipy.linalg.solve_continuous_lyapunov(A.T, -Q)), stretched=False)
        reach = 1 / float(np.linalg.norm(np.linalg.solve(V.scale, way)))
        if k >= 40:
            width *= 1.25 if reach > best else 0.94
        if reach > best:
            best, chosen, root = reach, V, attempt
    assert chosen is not None
    return largest(chosen.scale, stretched=True)


def _root(P: NDArray[Any]) -> FloatArray:
    """T with P = (T Tᵀ)⁻¹, lower triangular."""
    return np.asarray(np.linalg.cholesky(np.linalg.inv(0.5 * (P + P.T))))


def _quadratic_radius(motion: Motion, V: LyapunovFunction, rays: FloatArray) -> float:
    """Largest r with V̇ < 0 at samples of |z| ≤ r, inside the non-singular set."""
    reference = float(motion.determinant(np.zeros(motion.size)))

    def holds(r: float) -> bool:
        y = V.points(r * rays)
        rate = np.sum(rays * V.coordinate_rates(y, motion(y)), axis=1)
        return bool(
            (rate < 0).all()
            and (motion.determinant(y) / reference > CLEARANCE).all()
            and (np.abs(y[:, 0]) < POLE_PART * V.pole).all()
        )

    r = 1.0
    while not holds(r) and r > 1e-9:
        r /= 2
    grow = r * 1.1
    while holds(grow) and grow < 1e9:
        r, grow = grow, grow * 1.1
    return r


# -- growing ------------------------------------------------------------------------------------


def search_region(
    motion: Motion,
    direction: ArrayLike,
    *,
    degrees: Sequence[int] = (2, 4, 6),
    programs: int = 200,
    seconds: float = math.inf,
    seed: int = 0,
    start: Start = "far",
    goal: float = math.inf,
    samples: int = 5000,
    slow: bool = False,
    progress: Progress | None = None,
) -> LyapunovFunction:
    """Find V whose set {V ≤ 1} reaches far along a direction of y, by sampling.

    Parameters
    ----------
    motion
        The sliding dynamics, or any vector field.
    direction
        In y, (N,); on a surface y = (q_u, q̇_u, w), so (1, 0, 0) is an angle at rest.
    degrees
        Even degrees of V, tried one after the other, each starting from the last.
    programs
        Linear programs at most, shared by the degrees: the same on every machine.
    seconds
        Process time at most, likewise.
    start
        The quadratic V to begin with: ``"far"`` reaches far along the direction and grows
        little; ``"round"`` starts closer and often grows further.
    goal
        Stop when the set reaches so far along the direction.
    samples
        Points of each linear program, before counterexamples.
    slow
        On a surface with one unactuated coordinate: whether the third of the coordinates of
        :mod:`undertow.certify.region_chart` is η, not w.
    progress
        Called with a line of text after each step.

    Raises
    ------
    UnstableSurfaceError
        When the surface is not locally stable.
    """
    rng = np.random.default_rng(seed)
    way = np.asarray(direction, dtype=float)
    stretch = None
    if isinstance(motion, SurfaceMotion):
        stretch = natural_stretch(motion, slow=slow)
    # The quadratic's set is made the unit ball; a little inside, so that t > 0 is possible.
    V = _quadratic(motion, stretch, way, rng, start).times(1.02)
    for k, degree in enumerate(degrees):
        share = (k + 1) / sum(range(1, len(degrees) + 1))
        budget = _Budget(math.ceil(share * programs), share * seconds)
        V = _grow(_Basis(motion, V, degree), V, way, rng, budget, goal, samples, progress)
        if extent(V, way) >= goal:
            break
    return V


class _Budget:
    """Linear programs and process time that are left."""

    def __init__(self, programs: int, seconds: float) -> None:
        self.programs, self.started, self.seconds = programs, time.process_time(), seconds

    def spend(self) -> None:
        """Count one linear program."""
        self.programs -= 1

    @property
    def left(self) -> bool:
        """Whether another may start."""
        return self.programs > 0 and time.process_time() - self.started < self.seconds


def _grow(
    basis: _Basis,
    V: LyapunovFunction,
    way: FloatArray,
    rng: np.random.Generator,
    budget: _Budget,
    goal: float,
    samples: int,
    progress: Progress | None,
) -> LyapunovFunction:
    candidate = _Candidate(basis, rng)
    rate = _slowest(basis.motion)
    growth, step = 0.06, 0.04
    while growth > 0.004 and budget.left:
        reach = extent(V, way)
        if reach >= goal:
            break
        accepted = _step(candidate, V, way, growth, step, reach, rate, samples, budget)
        if accepted is not None and extent(basis.function(accepted[:-1]), way) > reach * 1.0005:
            V = basis.function(accepted[:-1])
            growth, step = min(1.2 * growth, 0.15), min(1.2 * step, 0.1)
            if progress is not None:
                progress(
                    f"degree {basis.exponents.sum(axis=1).max()}: reach {extent(V, way):.4f}, "
                    f"decay {accepted[-1] / rate:.3f}, {budget.programs} programs left"
                )
        else:
            growth, step = growth / 1.5, step / 1.5
    return V


def _step(
    candidate: _Candidate,
    V: LyapunovFunction,
    way: FloatArray,
    growth: float,
    step: float,
    reach: float,
    rate: float,
    samples: int,
    budget: _Budget,
) -> FloatArray | None:
    """Coefficients and t on V's set, grown; None where fresh samples keep disagreeing."""
    basis, rng = candidate.basis, candidate.rng
    # On the samples of the boundary; between them V must still be ≥ 1.
    edge_value = 1 + 0.25 * growth
    shell = candidate.shell(V, _rays(rng, samples, basis.size), growth)
    inner = np.vstack(
        [
            shell * rng.random((len(shell), 1)) ** 0.5,
            0.999 * shell,
            1e-3 * _rays(rng, samples // 4, basis.size),
        ]
    )
    outer = np.vstack([shell[::2], candidate.around(V, shell, growth)[::2]])
    length = float(np.linalg.norm(V.coordinates(reach * way)))
    on_way = basis.values(_on_axis(V, way, (1 + step) * length))
    columns = len(basis.exponents) + 1
    fixed = np.vstack(
        [
            -candidate.boundary(shell[::2]),
            np.hstack([on_way, np.zeros((10, 1))]),
            np.eye(1, columns, columns - 1),
        ]
    )
    limits = np.concatenate(
        [np.full(len(shell[::2]), 1.8), np.linspace(0.1, 1.0, 10), [0.5 * rate]]
    )
    edge = candidate.boundary(outer)
    decrease = candidate.decrease(inner)
    goal = np.zeros(columns)
    goal[-1] = -1.0
    for _ in range(8):
        A = np.vstack([decrease, edge, fixed])
        right = np.concatenate([np.zeros(len(decrease)), np.full(len(edge), -edge_value), limits])
        budget.spend()
        x = minimise_linear(goal, A, right)
        if x is None or x[-1] < 1e-3 * rate:
            return None
        more, out = candidate.counterexamples(V, x[:-1], growth, x[-1])
        if not len(more) and not len(out):
            return x
        decrease = np.vstack([decrease, candidate.decrease(more)])
        edge = np.vstack([edge, candidate.boundary(out)])
    return None


#: How close to the largest level that the checker proves; the first step on the way there.
TIGHT, STRIDE = 1.02, 1.05


def _tight_level(
    verdict_on: Callable[[LyapunovFunction], Verdict],
    V: LyapunovFunction,
    wanted: Callable[[LyapunovFunction], bool],
) -> tuple[LyapunovFunction, Verdict, Verdict] | None:
    """The set of V with a level that is proved and, 2 % higher, is not: both verdicts.

    None where nothing that is wanted is proved.
    """
    level, stride = 1.0, STRIDE
    proof = refusal = None
    while proof is None or refusal is None or refusal[0] / proof[0] > TIGHT:
        if proof is not None and refusal is not None:
            level = math.sqrt(proof[0] * refusal[0])
        candidate = V.times(1 / level)
        if proof is None and not (wanted(candidate) and level > 0.3):
            return None
        verdict = verdict_on(candidate)
        if verdict:
            proof = (level, verdict)
            level *= stride
        else:
            refusal = (level, verdict)
            level /= stride
            stride **= 1.0 if proof else 1.4
    return V.times(1 / proof[0]), proof[1], refusal[1]


def prove_region(
    motion: Motion,
    direction: ArrayLike,
    *,
    degrees: Sequence[int] = (2, 4, 6),
    programs: int = 600,
    seconds: float = math.inf,
    seed: int = 0,
    goal: float = math.inf,
    parameters: Mapping[str, tuple[float, float]] | None = None,
    max_boxes: int = 20_000_000,
    progress: Progress | None = None,
) -> ProvedRegion:
    """Search for a region of attraction, prove it, and raise its level as far as that goes.

    Parameters
    ----------
    motion, direction, degrees, programs, seconds, seed, goal, progress
        As for :func:`search_region`; the budget is shared by three searches with different
        starts and coordinates, which end when one meets the goal.
    parameters
        Intervals of uncertain parameters, as for :func:`undertow.certify.verify_region`.
    max_boxes
        Of each proof.  The proofs are not timed: with ``seconds`` left out the result is
        the same on every machine.

    Returns
    -------
    ProvedRegion
        The largest set found that could be proved; one that cannot be is shrunk.

    Raises
    ------
    InfeasibleError
        When none of the sets could be proved; the message carries the last verdict.
    UnstableSurfaceError
        When the surface is not locally stable.
    """
    way = np.asarray(direction, dtype=float)
    attempts: list[tuple[Start, bool]] = [("round", False), ("far", False), ("far", True)]
    found = []
    for start, slow in attempts:
        V = search_region(
            motion,
            direction,
            degrees=degrees,
            programs=math.ceil(programs / len(attempts)),
            seconds=seconds / len(attempts),
            seed=seed,
            start=start,
            slow=slow,
            goal=goal,
            progress=progress,
        )
        found.append(V)
        if extent(V, way) >= goal:
            break

    def verdict_on(V: LyapunovFunction) -> Verdict:
        verdict = verify_region(
            motion, V, parameters=parameters, max_boxes=max_boxes, max_seconds=math.inf
        )
        if progress is not None:
            boxes = verdict.details.get("boxes")
            progress(f"reach {extent(V, way):.4f}: {verdict.kind}, {boxes} boxes")
        return verdict

    best: ProvedRegion | None = None
    for V in sorted(found, key=lambda V: -extent(V, way)):
        least = best.extent if best is not None else 0.0
        tight = _tight_level(verdict_on, V, lambda W: extent(W, way) > least)  # noqa: B023
        if tight is not None:
            function, proof, raised = tight
            reach = extent(function, way) * (1 - 1e-9)
            best = ProvedRegion(motion, function, proof, reach, raised)
    if best is not None:
        return best
    raise InfeasibleError(
        f"region of attraction of {getattr(motion, 'surface', motion.names)}",
        value=f"{len(found)} functions found",
        limit="a proved sublevel set",
        remedy="Give the search more programs or another degree",
    )
