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

from undertow.certify.loop import LoopMotion
from undertow.certify.loop_claim import LoopClaim, run_tubes, start_tubes, verify_loop
from undertow.certify.loop_terminal import TerminalSet, verify_terminal
from undertow.certify.verdict import Verdict
from undertow.errors import InfeasibleError, UnstableSurfaceError
from undertow.mechanism import Mechanism
from undertow.sliding import ReachingLaw, Surface

__all__ = ["ProvedLoop", "follow", "prove_loop", "search_terminal"]

FloatArray = NDArray[np.float64]
Progress = Callable[[str], None] | None


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


def _worst(motion: LoopMotion, T: FloatArray, rays: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the growth of ½‖x‖² on rays, per ‖x‖², and the share of the input's range used."""
    z = np.hstack([rays @ T.T, np.zeros((len(rays), motion.mechanism.m))])
    rate, u = motion(z)
    square = np.sum(rays * rays, axis=1)
    growth = np.sum(rays * np.linalg.solve(T, rate[:, : motion.slow].T).T, axis=1) / square
    return growth, np.abs(u / motion.mechanism.input_limits).max(axis=1)


def _refined(
    motion: LoopMotion, T: FloatArray, rays: FloatArray, rng: np.random.Generator
) -> float:
    """Level with fresh rays, and rays that climb to where the conditions are tightest."""
    count, slow = 8 * len(rays), rays.shape[1]
    fresh = rng.normal(size=(count, slow))
    fresh /= np.linalg.norm(fresh, axis=1, keepdims=True)
    r = _level(motion, T, fresh)
    for width in (0.1, 0.03, 0.01, 0.003, 0.001):
        inner = np.concatenate([r * f * fresh for f in (0.1, 0.4, 0.7, 1.0)])
        growth, share = _worst(motion, T, inner)
        top = np.concatenate([np.argsort(growth)[-150:], np.argsort(share)[-50:]])
        near = np.repeat(inner[top], 12, axis=0)
        near = near / np.linalg.norm(near, axis=1, keepdims=True)
        near = near + width * rng.normal(size=near.shape)
        fresh = near / np.linalg.norm(near, axis=1, keepdims=True)
        while r > 1e-9:
            inner = np.concatenate([r * f * fresh for f in (0.1, 0.4, 0.7, 1.0)])
            growth, share = _worst(motion, T, inner)
            if (growth < 0).all() and (share < 0.985).all():
                break
            r *= 0.97
    return r


def _level(motion: LoopMotion, T: FloatArray, rays: FloatArray) -> float:
    """Largest r with ‖x‖ falling and the demand within 98.5 % of its limits on samples."""

    def holds(r: float) -> bool:
        growth, share = _worst(motion, T, r * rays)
        return bool((growth < 0).all() and (share < 0.985).all())

    r = 1.0
    while not holds(r) and r > 1e-6:
        r /= 2
    while holds(1.05 * r) and r < 1e9:
        r *= 1.05
    return r


def _widths(motion: LoopMotion, T: FloatArray, A: FloatArray) -> FloatArray:
    """σ such that s spends a fifth of the decay of ‖x‖ near 0, at most half a layer."""
    slow = motion.slow
    M = np.linalg.solve(T, A[:slow, :slow] @ T)
    decay = -np.linalg.eigvalsh(0.5 * (M + M.T))[-1]
    drag = np.linalg.norm(np.linalg.solve(T, A[:slow, slow:]), axis=0)
    share = 0.2 * max(decay, 0.0) / (drag * len(drag))
    return np.asarray(np.minimum(share, 0.5 * motion.gains[1]))


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
    A = _jacobian(motion)
    slow = motion.slow
    A_slow = A[:slow, :slow]
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
    best, chosen, root, width = math.inf, None, np.eye(slow), 0.8
    for trial in range(trials):
        change = width * rng.normal(size=(slow, slow))
        attempt = (
            np.diag(np.exp(rng.normal(size=slow)))
            if trial < trials // 4
            else scipy.linalg.expm(0.5 * (change + change.T)) @ root
        )
        # A floor under Q: where ‖x‖ hardly falls at 0, nothing can be proved.
        square = attempt.T @ attempt
        Q = (square + 0.003 * np.trace(square) * np.eye(slow)) / np.outer(units, units)
        P = scipy.linalg.solve_continuous_lyapunov(A_slow.T, -Q)
        try:
            T = np.linalg.inv(np.linalg.cholesky(0.5 * (P + P.T)).T)
        except np.linalg.LinAlgError:
            continue
        size = np.linalg.norm(points @ np.linalg.inv(T).T, axis=-1)
        reach = float(np.log(size).max(axis=1).mean())
        level = _level(motion, T, rays)
        if reach - math.log(level) < best:
            level = min(level, _refined(motion, T, rays, rng))
        T, score = T * level, reach - math.log(level)
        if trial >= trials // 4:
            width *= 1.25 if score < best else 0.94
        if score < best:
            best, chosen, root = score, T, attempt
    verdict = Verdict("a terminal set", "undecided")
    for factor in (0.98, 0.95, 0.9, 0.8, 0.65, 0.5):
        if chosen is None:
            break
        terminal = TerminalSet(chosen * factor, _widths(motion, chosen * factor, A))
        verdict = verify_terminal(motion, terminal, max_seconds=120)
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
    motion = LoopMotion(mechanism, surface, law, dict(uncertain or {}))
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
        coordinate, tuple(edges), terminal, step, horizon + step, dict(uncertain or {})
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
    """Find a terminal set for the motions from up to ``reach``, and where they fail to enter."""
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
    return terminal, float(x[min(far, 63), names.index(coordinate)])


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
