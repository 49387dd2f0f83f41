"""The search behind a proof of the whole loop: a terminal set, and boxes of starts.

Nothing here proves anything: what is found goes to :func:`undertow.certify.loop_claim.verify_loop`.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from undertow.certify.batch import Interval
from undertow.certify.loop import LoopMotion
from undertow.certify.loop_claim import LoopClaim, run_tubes, start_tubes, verify_loop
from undertow.certify.loop_terminal import HOLD_SHARE, TerminalSet, verify_terminal
from undertow.certify.verdict import Verdict
from undertow.errors import InfeasibleError, UnstableSurfaceError
from undertow.mechanism import Mechanism
from undertow.sliding import ReachingLaw, Surface

__all__ = ["ProvedLoop", "follow", "prove_loop", "search_terminal"]

FloatArray = NDArray[np.float64]
Progress = Callable[[str], None] | None

#: Widths of terminal sets that are tried, as multiples of what they have to be at the target.
MORE = (1.35, 1.12, 1.8)


@dataclass(frozen=True)
class ProvedLoop:
    """A proved line of starts.

    Parameters
    ----------
    claim
        What was proved.
    verdict
        Its verdict, by the checker.
    seconds
        Process time of search and proof together.
    """

    claim: LoopClaim
    verdict: Verdict
    seconds: float


def follow(
    motion: LoopMotion, z: FloatArray, duration: float, step: float, every: int
) -> tuple[FloatArray, FloatArray]:
    """Return float64 RK4 motions of the clipped loop, (K + 1, L, N), and their times."""
    path, times = [z], [0.0]
    with np.errstate(all="ignore"):
        for k in range(max(1, round(duration / step))):
            a = motion(z)[0]
            b = motion(z + 0.5 * step * a)[0]
            c = motion(z + 0.5 * step * b)[0]
            d = motion(z + step * c)[0]
            z = z + step / 6 * (a + 2 * b + 2 * c + d)
            if (k + 1) % every == 0:
                path.append(z)
                times.append((k + 1) * step)
    return np.array(path), np.array(times)


def _jacobian(motion: LoopMotion, h: float = 1e-6) -> FloatArray:
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
        fresh = rng.normal(size=(8 * len(rays), rays.shape[1]))
        fresh /= np.linalg.norm(fresh, axis=1, keepdims=True)
        r = self.level(fresh)
        for width in (0.1, 0.03, 0.01, 0.003, 0.001):
            inner = np.concatenate([r * f * fresh for f in (0.1, 0.4, 0.7, 1.0)])
            growth, share = self.worst(inner)
            top = np.concatenate([np.argsort(growth)[-150:], np.argsort(share)[-50:]])
            near = np.repeat(inner[top], 12, axis=0)
            near = near / np.linalg.norm(near, axis=1, keepdims=True)
            near = near + width * rng.normal(size=near.shape)
            fresh = near / np.linalg.norm(near, axis=1, keepdims=True)
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
        push = rates.push_slope[:, : motion.size, 0]
        size = np.maximum(np.abs(push.lo), np.abs(push.hi))
        return cls(motion, _jacobian(motion), slope, 0.5 * (rates.W.lo + rates.W.hi)[..., 0], size)

    def widths(self, T: FloatArray, more: float = MORE[0]) -> FloatArray:
        """σ for T: s spends a fifth of the decay of ‖x‖ at 0, or as much as it has to.

        It has to where the plant is uncertain or the input held: the bounds of
        :mod:`undertow.certify.loop_terminal`, linear at the target, times ``more``.
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
    rays = rng.normal(size=(400 * slow, slow))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
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


def prove_loop(
    mechanism: Mechanism,
    surface: Surface,
    reaching: ReachingLaw | None = None,
    *,
    coordinate: str,
    reach: float,
    step: float = 0.001,
    duration: float = 3.0,
    uncertain: Mapping[str, tuple[float, float]] | None = None,
    hold: int = 0,
    widest: float | None = None,
    splits: int = 1,
    trials: int = 150,
    seed: int = 0,
    progress: Progress = None,
) -> ProvedLoop:
    """Prove that the loop converges from rest, one coordinate off the target, as far as it can.

    Parameters
    ----------
    coordinate
        Which one.
    reach
        Starts beyond this are not tried, SI units.
    step
        Step of the validated integration, s.
    duration
        Longest tube, s.
    uncertain
        Plant parameters known to lie in [low, high].
    hold
        The law is evaluated every ``hold`` steps and its input held; 0: at every instant.
    widest
        Widest box of starts, at the target; a 350th of the reach by default.
    splits
        How often a box whose tube fails is halved.

    Returns
    -------
    ProvedLoop
        Its verdict is the checker's on the final claim.

    Raises
    ------
    InfeasibleError
        When not even the first box could be proved.
    """
    started = time.process_time()
    law = ReachingLaw() if reaching is None else reaching
    period = math.nextafter(hold * step, math.inf) if hold else 0.0
    motion = LoopMotion(mechanism, surface, law, dict(uncertain or {}), period)
    terminal, reach = _terminal(motion, coordinate, reach, step, duration, trials, seed, progress)
    pending = _boxes(motion, coordinate, reach, widest)
    done: list[tuple[float, float]] = []
    horizon, barrier = 0.0, math.inf
    for level in range(splits + 1):
        lows, highs = (np.array(v) for v in zip(*pending, strict=True))
        ends = _ends(motion, coordinate, lows, highs, terminal, step, duration)
        good = ~np.isnan(ends)
        done += [p for p, ok in zip(pending, good, strict=True) if ok]
        horizon = max(horizon, float(np.nanmax(ends, initial=0.0)))
        failed = [p for p, ok in zip(pending, good, strict=True) if not ok]
        if progress is not None:
            progress(f"boxes halved {level} times: {good.sum()} of {len(pending)} tubes end well")
        if not failed or level == splits:
            barrier = min([barrier, *(a for a, _ in failed)])
            break
        pending = [h for a, b in failed for h in ((a, 0.5 * (a + b)), (0.5 * (a + b), b))]
        # Far above the first failure little is to be won: keep a window above it.
        window = 0.15 * reach
        pending = [p for p in pending if p[0] <= failed[0][0] + window]
        beyond = [p for p in failed if p[0] > failed[0][0] + window]
        barrier = min([barrier, *(a for a, _ in beyond)])
    kept = sorted(p for p in done if p[1] <= barrier + 1e-15)
    edges = [0.0]
    for a, b in kept:
        if a != edges[-1]:
            break
        edges.append(b)
    if len(edges) < 2:
        raise InfeasibleError(
            f"proved region of the loop with {surface}",
            value="no tube ended in the terminal set",
            limit=f"within {duration:g} s, steps of {step:g} s",
            remedy="Take a smaller step, narrower boxes or a longer duration",
        )
    claim = LoopClaim(
        coordinate,
        tuple(edges),
        terminal,
        step,
        horizon + max(1, hold) * step,
        dict(uncertain or {}),
        hold,
    )
    verdict = verify_loop(mechanism, surface, law, claim, progress=progress)
    return ProvedLoop(claim, verdict, time.process_time() - started)


def _boxes(
    motion: LoopMotion, coordinate: str, reach: float, widest: float | None
) -> list[tuple[float, float]]:
    """Neighbouring boxes of [0, reach], narrower where the motions are faster.

    Around the edge of the layer they are a small part of it: a set that lies on both sides
    of the corner of sat loses its contraction.
    """
    first = reach / 350 if widest is None else widest
    index = [c.name for c in motion.mechanism.coordinates].index(coordinate)
    weights = np.abs(motion.surface.position_row[:, index])
    layer = float(np.min(motion.gains[1] / np.maximum(weights, 1e-12)))
    edges = [0.0]
    while edges[-1] < reach:
        left = 1 - edges[-1] / reach
        width = first * (0.4 + 0.6 * left)
        if edges[-1] < 2 * layer:
            width = min(width, 0.15 * layer)
        edges.append(min(edges[-1] + width, reach))
    return list(itertools.pairwise(edges))


def _terminal(
    motion: LoopMotion,
    coordinate: str,
    reach: float,
    step: float,
    duration: float,
    trials: int,
    seed: int,
    progress: Progress,
) -> tuple[TerminalSet, float]:
    """Find a terminal set for the motions from up to ``reach``, and where they fail to enter.

    A set that is made for motions from afar is not the best for those that can enter in time:
    where many fail it is made again for a shorter reach.
    """
    best: tuple[TerminalSet, float] | None = None
    for _ in range(3):
        try:
            found = _terminal_for(motion, coordinate, reach, step, duration, trials, seed, progress)
        except InfeasibleError:
            if best is None:
                raise
            break
        if best is not None and found[1] <= best[1]:
            break
        best = found
        if found[1] > 0.85 * reach:
            break
        reach = 1.2 * found[1]
    assert best is not None
    return best


def _terminal_for(
    motion: LoopMotion,
    coordinate: str,
    reach: float,
    step: float,
    duration: float,
    trials: int,
    seed: int,
    progress: Progress,
) -> tuple[TerminalSet, float]:
    names = [c.name for c in motion.mechanism.coordinates]
    x = np.zeros((64, motion.size))
    x[:, names.index(coordinate)] = np.linspace(reach / 64, reach, 64)
    every = max(1, round(0.01 / step))
    path, times = follow(motion, motion.from_state(x), duration, step, every)
    slow = motion.slow
    calm = np.all(np.abs(path[..., slow:]) <= 1e-3 * motion.gains[1], axis=-1)
    rates = np.linalg.eigvals(_jacobian(motion)[:slow, :slow])
    alive = np.all(np.isfinite(path), axis=(0, 2)) & calm[-1]
    # The first start whose motion never settles ends the line.
    last = len(alive) if alive.all() else int(np.argmin(alive))
    if last == 0:
        raise InfeasibleError(
            "simulated motions",
            value="none reaches the surface",
            limit=f"within {duration:g} s",
            remedy="Take a longer duration or a smaller reach",
        )
    use = slice(max(1, last // 3), max(2, round(0.93 * last)))
    begin = int(np.argmax(np.all(calm[:, use], axis=1)))
    window = 4 / np.abs(rates).max()
    keep = (np.arange(len(times)) >= begin) & (times <= times[begin] + window)
    terminal = search_terminal(
        motion, path[keep][:, use], trials=trials, seed=seed, progress=progress
    )
    enters = np.any(terminal.value(path) <= 1, axis=0)
    far = len(enters) if enters.all() else int(np.argmin(enters))
    end = float(x[min(far, 63), names.index(coordinate)])
    if progress is not None:
        progress(f"simulated motions from up to {end:.4g} enter within {duration:g} s")
    return terminal, end


def _ends(
    motion: LoopMotion,
    coordinate: str,
    lows: FloatArray,
    highs: FloatArray,
    terminal: TerminalSet,
    step: float,
    duration: float,
) -> FloatArray:
    """Times at which the tubes of boxes (not neighbours) enter, NaN where they do not."""
    edges = np.stack([lows, highs], axis=1).ravel()
    tubes = start_tubes(motion, coordinate, edges)
    return run_tubes(
        motion, tubes.take(np.arange(len(edges) - 1) % 2 == 0), terminal, step, duration,
        stop_early=False,
    ).entered  # fmt: skip
