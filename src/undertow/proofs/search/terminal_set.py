"""The search for terminal sets of the whole loop: ellipsoids tried by an evolution strategy.

Nothing here proves anything: what is found goes to
:func:`undertow.proofs.closed_loop.terminal.verify_terminal`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from undertow.base.errors import InfeasibleError, UnstableSurfaceError
from undertow.base.verdict import Verdict
from undertow.models.mechanism import FloatArray
from undertow.proofs.closed_loop.loop import LoopMotion
from undertow.proofs.closed_loop.terminal import HOLD_SHARE, verify_terminal
from undertow.proofs.closed_loop.terminal_set import TerminalSet
from undertow.proofs.intervals.batch import Interval
from undertow.proofs.region.lyapunov import directions, unit

Progress = Callable[[str], None] | None

#: Widths of terminal sets that are tried, as multiples of what they have to be at the target.
MORE = (1.35, 1.12, 1.8)


def jacobian(motion: LoopMotion, h: float = 1e-6) -> FloatArray:
    """Return ∂ż/∂z at the target, (N, N), by central differences."""
    steps = h * np.eye(motion.size)
    return np.asarray((motion(steps)[0] - motion(-steps)[0]).T / (2 * h))


@dataclass(frozen=True)
class _Trial:
    """A candidate {‖x‖ ≤ r, |s_i| ≤ σ_i r}, y = T x, judged on samples."""

    motion: LoopMotion
    T: FloatArray
    widths: FloatArray

    def worst(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the growth of ½‖x‖² at points x, per ‖x‖², for the worst |s_i| ≤ σ_i ‖x‖.

        And the share of the input's range used, s = 0.
        """
        motion, T, m = self.motion, self.T, self.motion.mechanism.m
        size = np.linalg.norm(points, axis=1)
        rows = np.linalg.solve(T, np.eye(len(T)))
        s = np.zeros((len(points), m))
        rate, u = motion(np.hstack([points @ T.T, s]))

        def growth(rate: FloatArray) -> FloatArray:
            x_rate = rate[:, : motion.slow] @ rows.T
            return np.asarray(np.sum(points * x_rate, axis=1) / size**2)

        total = growth(rate)
        for j in range(m):
            s[:, j] = self.widths[j] * size
            up, down = (growth(motion(np.hstack([points @ T.T, d * s]))[0]) for d in (1, -1))
            total = total + 0.5 * np.abs(up - down)
            s[:, j] = 0.0
        return total, np.abs(u / motion.mechanism.input_limits).max(axis=1)

    def holds(self, points: FloatArray) -> bool:
        """Whether ‖x‖ falls and the demand is within 98.5 % of its limits at points."""
        growth, share = self.worst(points)
        return bool((growth < 0).all() and (share < 0.985).all())

    def level(self, rays: FloatArray) -> float:
        """Largest r that holds on rays; 0 where ‖x‖ grows next to the target."""
        r = 1.0
        while not self.holds(r * rays):
            r /= 2
            if r < 1e-6:
                return 0.0
        while self.holds(1.05 * r * rays) and r < 1e9:
            r *= 1.05
        return r

    def refined(self, rays: FloatArray, rng: np.random.Generator) -> float:
        """Level with fresh rays, and rays that climb to where the conditions are tightest."""
        fresh = directions(rng, 8 * len(rays), rays.shape[1])
        r = self.level(fresh)
        for width in (0.1, 0.03, 0.01, 0.003, 0.001):
            inner = np.concatenate([r * f * fresh for f in (0.1, 0.4, 0.7, 1.0)])
            growth, share = self.worst(inner)
            top = np.concatenate([np.argsort(growth)[-150:], np.argsort(share)[-50:]])
            near = unit(np.repeat(inner[top], 12, axis=0))
            fresh = unit(near + width * rng.normal(size=near.shape))
            while r > 1e-9:
                inner = np.concatenate([r * f * fresh for f in (0.1, 0.4, 0.7, 1.0)])
                if self.holds(inner):
                    break
                r *= 0.97
        return r


@dataclass(frozen=True)
class _Linear:
    """The loop at the target: what sets how thin a terminal set may be."""

    motion: LoopMotion
    A: FloatArray
    u_slope: FloatArray
    W: FloatArray
    unknown: FloatArray

    @classmethod
    def of(cls, motion: LoopMotion) -> _Linear:
        zero = Interval(np.zeros((motion.size, 1)))
        rates, h = motion.over(zero), 1e-6
        steps = h * np.eye(motion.size)
        slope = (motion(steps)[1] - motion(-steps)[1]).T / (2 * h)
        size = rates.push_slope[:, : motion.size, 0].magnitude
        return cls(motion, jacobian(motion), slope, rates.W.middle[..., 0], size)

    def widths(self, T: FloatArray, more: float = MORE[0]) -> FloatArray:
        """σ for T: s spends a fifth of the decay of ‖x‖ at 0, or as much as it has to.

        It has to where the plant is uncertain or the input held: the bounds of
        :mod:`undertow.proofs.closed_loop.terminal`, linear at the target, times ``more``.
        """
        motion, slow, A = self.motion, self.motion.slow, self.A
        eta, layer = motion.gains
        M = np.linalg.solve(T, A[:slow, :slow] @ T)
        decay = -np.linalg.eigvalsh(0.5 * (M + M.T))[-1]
        drag = np.linalg.norm(np.linalg.solve(T, A[:slow, slow:]), axis=0)
        free = np.minimum(0.2 * max(decay, 0.0) / (drag * len(drag)), 0.5 * layer)
        held, blind = motion.period > 0, len(motion.radii) > 0
        share = 1.0 if not blind else HOLD_SHARE if held else 0.0
        needed = np.zeros(len(eta))
        if held:
            reach = motion.period * np.abs(self.W)
            creep = np.linalg.norm(self.u_slope[:, :slow] @ A[:slow, :slow] @ T, axis=1)
            own = np.abs(self.u_slope[:, :slow] @ A[:slow, slow:])
            own = own + 2 * np.abs(self.u_slope[:, slow:]) * (eta / layer)
            left = share * eta / layer - np.diag(reach @ own)
            needed = np.where(left > 0, reach @ creep / np.maximum(left, 1e-300), np.inf)
        if blind:
            gain = np.linalg.norm(self.unknown[:, :slow] @ np.abs(T), axis=1)
            left = (1 - share) * eta / layer - np.diag(self.unknown[:, slow:])
            blindly = np.where(left > 0, gain / np.maximum(left, 1e-300), np.inf)
            needed = np.maximum(needed, blindly)
        return np.asarray(np.maximum(free, more * needed))


def _modes(A: FloatArray) -> tuple[NDArray[np.complex128], NDArray[np.intp]]:
    """Return left eigenvectors as rows, and which modes share a weight: conjugate pairs."""
    values, vectors = np.linalg.eig(A.astype(complex))
    pairs = np.argmin(np.abs(values[:, None] - values[None].conj()), axis=1)
    return np.linalg.inv(vectors), np.minimum(pairs, np.arange(len(A)))


def search_terminal(
    motion: LoopMotion,
    paths: FloatArray,
    *,
    trials: int = 150,
    seed: int = 0,
    progress: Progress = None,
) -> TerminalSet:
    """Find a terminal set that motions enter early, and prove it.

    Parameters
    ----------
    paths
        Points of motions after they reached the surface, (K, L, N): the set is made to hold
        as many of them, as early as it can.
    trials
        Quadratic functions tried, by a (1+1) evolution strategy over the square root of Q
        in the Lyapunov equation.

    Raises
    ------
    UnstableSurfaceError
        When the loop is not stable at the target.
    InfeasibleError
        When no candidate could be proved.
    """
    linear = _Linear.of(motion)
    slow = motion.slow
    A_slow = linear.A[:slow, :slow]
    rate = -np.linalg.eigvals(A_slow).real.max()
    if not rate > 0:
        raise UnstableSurfaceError(
            f"terminal set of {motion.surface}",
            value=f"slowest rate {rate:.4g} 1/s",
            limit="> 0",
            remedy="Start from undertow.first_surface(mechanism)",
        )
    rng = np.random.default_rng(seed)
    rays = directions(rng, 400 * slow, slow)
    base = scipy.linalg.solve_continuous_lyapunov(A_slow.T, -np.eye(slow))
    units = 1 / np.sqrt(np.diag(base))
    points = paths[..., :slow]
    modes = _modes(A_slow)
    best, chosen, root, width = math.inf, None, np.eye(slow), 0.8
    for trial in range(trials):
        change = width * rng.normal(size=(slow, slow))
        if trial >= trials // 4:
            attempt = scipy.linalg.expm(0.5 * (change + change.T)) @ root
        elif trial % 2:
            attempt = np.diag(np.exp(rng.normal(size=slow)))
        else:  # an ellipsoid of the modes: as long as it likes along a slow one
            weights = np.exp(2 * rng.normal(size=slow))[modes[1]]
            P = np.real(modes[0].conj().T @ np.diag(weights) @ modes[0])
            Q = -(A_slow.T @ P + P @ A_slow) * np.outer(units, units)
            attempt = np.linalg.cholesky(Q + 1e-9 * np.trace(Q) * np.eye(slow)).T
        # A floor under Q: where ‖x‖ hardly falls at 0, nothing can be proved.
        square = attempt.T @ attempt
        Q = (square + 0.003 * np.trace(square) * np.eye(slow)) / np.outer(units, units)
        P = scipy.linalg.solve_continuous_lyapunov(A_slow.T, -Q)
        try:
            T = np.linalg.inv(np.linalg.cholesky(0.5 * (P + P.T)).T)
        except np.linalg.LinAlgError:
            continue
        widths = linear.widths(T)
        if not np.isfinite(widths).all():
            continue
        candidate = _Trial(motion, T, widths)
        size = np.linalg.norm(points @ np.linalg.inv(T).T, axis=-1)
        reach = float(np.log(size).max(axis=1).mean())
        level = min(candidate.level(rays), float(np.min(motion.gains[1] / widths)))
        if level > 0 and reach - math.log(level) < best:
            level = min(level, candidate.refined(rays, rng))
        # Where nothing holds: how far from it.
        score = (
            reach - math.log(level)
            if level > 0
            else 1e3 + float(candidate.worst(1e-6 * rays)[0].max())
        )
        T = T * max(level, 1e-9)
        if trial >= trials // 4:
            width *= 1.25 if score < best else 0.94
        if score < best:
            best, chosen, root = score, T, attempt
    verdict = Verdict("a terminal set", "undecided")
    for factor in (0.98, 0.95, 0.9, 0.8, 0.65, 0.5, 0.35, 0.2, 0.1):
        if chosen is None or best >= 1e3:
            break
        tried = [linear.widths(chosen * factor, more) for more in MORE]
        different = [w for k, w in enumerate(tried) if not any((w == v).all() for v in tried[:k])]
        for sigma in different:
            terminal = TerminalSet(chosen * factor, sigma)
            verdict = verify_terminal(motion, terminal, max_seconds=60)
            if progress is not None:
                progress(f"terminal set at {factor:g} of the sampled size: {verdict.kind}")
            if verdict:
                return terminal
    raise InfeasibleError(
        f"terminal set of {motion.surface}",
        value=str(verdict),
        limit="a proved set",
        remedy="Give the search more trials, or a larger decay rate to the surface",
    )
