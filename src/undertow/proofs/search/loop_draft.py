"""The search behind a proof of the loop with a held input, or with a plant in a box.

Nothing here proves anything: what is found goes to
:meth:`undertow.proofs.LoopDraft.decide`.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np

from undertow.base.errors import InfeasibleError
from undertow.base.verdict import Verdict
from undertow.law import ReachingLaw, Surface
from undertow.models.mechanism import FloatArray, Mechanism
from undertow.proofs.claims.loop_draft import LoopDraft
from undertow.proofs.closed_loop.loop import LoopMotion
from undertow.proofs.closed_loop.run import run_tubes, start_tubes
from undertow.proofs.closed_loop.terminal_set import TerminalSet
from undertow.proofs.intervals.require import require
from undertow.proofs.search.closed_loop import runge_kutta
from undertow.proofs.search.terminal_set import jacobian, search_terminal

Progress = Callable[[str], None] | None


@dataclass(frozen=True)
class DraftedLoop:
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

    claim: LoopDraft
    verdict: Verdict
    seconds: float


def follow(
    motion: LoopMotion, z: FloatArray, duration: float, step: float, every: int
) -> tuple[FloatArray, FloatArray]:
    """Return float64 RK4 motions of the clipped loop, (K + 1, L, N), and their times."""
    return runge_kutta(lambda z: motion(z)[0], z, duration, step, every)


def draft_loop(
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
) -> DraftedLoop:
    """Prove that a loop with a held input, or with a plant in a box, converges from rest.

    As far as it can, one coordinate off the target.

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
    DraftedLoop
        Its verdict is the checker's on the final claim.

    Raises
    ------
    InvalidInputError
        For neither a held input nor an uncertain plant: :func:`prove_loop` is for that loop.
    InfeasibleError
        When not even the first box could be proved.
    """
    require(hold or uncertain, "draft of a loop", "no held input, no box", limit="prove_loop")
    started = time.process_time()
    law = ReachingLaw() if reaching is None else reaching
    period = math.nextafter(hold * step, math.inf) if hold else 0.0
    motion = LoopMotion(mechanism, surface, law, dict(uncertain or {}), period)

    search = partial(search_terminal, motion, trials=trials, seed=seed, progress=progress)
    attempt = partial(_terminal_for, search, motion, coordinate, step, duration, progress)
    terminal, reach = _terminal(attempt, reach)
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
    claim = LoopDraft(
        coordinate,
        tuple(edges),
        terminal,
        step,
        horizon + max(1, hold) * step,
        dict(uncertain or {}),
        hold,
    )
    verdict = claim.decide(mechanism, surface, law, progress=progress)
    return DraftedLoop(claim, verdict, time.process_time() - started)


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
    attempt: Callable[[float], tuple[TerminalSet, float]], reach: float
) -> tuple[TerminalSet, float]:
    """Find a terminal set for the motions from up to ``reach``, and where they fail to enter.

    A set that is made for motions from afar is not the best for those that can enter in time:
    where many fail it is made again for a shorter reach.
    """
    best: tuple[TerminalSet, float] | None = None
    for _ in range(3):
        try:
            found = attempt(reach)
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
    search: Callable[[FloatArray], TerminalSet],
    motion: LoopMotion,
    coordinate: str,
    step: float,
    duration: float,
    progress: Progress,
    reach: float,
) -> tuple[TerminalSet, float]:
    names = [c.name for c in motion.mechanism.coordinates]
    x = np.zeros((64, motion.size))
    x[:, names.index(coordinate)] = np.linspace(reach / 64, reach, 64)
    every = max(1, round(0.01 / step))
    path, times = follow(motion, motion.from_state(x), duration, step, every)
    slow = motion.slow
    calm = np.all(np.abs(path[..., slow:]) <= 1e-3 * motion.gains[1], axis=-1)
    rates = np.linalg.eigvals(jacobian(motion)[:slow, :slow])
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
    terminal = search(path[keep][:, use])
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
