"""The search behind a proof of the closed loop: a terminal set, and how to cut a line of starts.

Nothing here proves anything: what is found is decided by
:meth:`undertow.proofs.LoopClaim.decide`, from its numbers alone.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from undertow.base.errors import InfeasibleError
from undertow.base.verdict import Verdict
from undertow.law import ReachingLaw, SlidingModeLaw, Surface
from undertow.models.mechanism import FloatArray, Mechanism
from undertow.proofs.claims.closed_loop import LoopClaim
from undertow.proofs.claims.model_data import law_of, model_of
from undertow.proofs.claims.terminal_ellipsoid import TerminalEllipsoid
from undertow.proofs.intervals.require import require
from undertow.proofs.kernel.claims import ClosedLoop
from undertow.proofs.kernel.loop import Loop
from undertow.proofs.search.terminal_ellipsoid import EllipsoidSearch, search_for

#: Motions that are simulated for the terminal set; the thinnest box of starts, of the reach.
MOTIONS, THINNEST = 24, 2.0**-13


@dataclass(frozen=True)
class ProvedLoop:
    """A line of starts.

    Parameters
    ----------
    claim
        What was found.
    verdict
        Its verdict, by the kernel.
    seconds
        Process time of search and proof together.
    """

    claim: LoopClaim
    verdict: Verdict
    seconds: float


def runge_kutta(
    rate: Callable[[FloatArray], FloatArray],
    x: FloatArray,
    duration: float,
    step: float,
    every: int,
) -> tuple[FloatArray, FloatArray]:
    """Return float64 RK4 motions from states (L, N), (K + 1, L, N) every so many steps, and times.

    ``rate`` is of the states; ``duration`` and ``step`` are in s.
    """
    path, times = [x], [0.0]
    with np.errstate(all="ignore"):
        for k in range(1, max(1, round(duration / step)) + 1):
            a = rate(x)
            b = rate(x + 0.5 * step * a)
            c = rate(x + 0.5 * step * b)
            x = x + step / 6 * (a + 2 * b + 2 * c + rate(x + step * c))
            if k % every == 0:
                path.append(x)
                times.append(k * step)
    return np.array(path), np.array(times)


def follow(
    law: SlidingModeLaw, x: FloatArray, duration: float, every: int = 4
) -> tuple[FloatArray, FloatArray]:
    """Return float64 RK4 motions of the clipped loop from states (L, 2n), and their times.

    Steps are of ε/η, the time in which s decays in the layer, and of 5 ms at most.

    Returns
    -------
    tuple of ndarray
        States (K + 1, L, 2n), every so many steps, and times (K + 1,), s.
    """
    n = law.mechanism.n
    eta, layer = law.reaching.per_surface(law.mechanism.m)
    step = float(min(0.005, np.min(layer / eta)))

    def rate(x: FloatArray) -> FloatArray:
        q_dd = law.mechanism.accelerations(0.0, x, law(0.0, x).u)
        return np.concatenate([x[..., n:], q_dd], axis=-1)

    return runge_kutta(rate, x, duration, step, every)


def prove_loop(
    mechanism: Mechanism,
    surface: Surface,
    reaching: ReachingLaw | None = None,
    *,
    coordinate: str,
    reach: float,
    duration: float = 15.0,
    seconds: float = 300.0,
    progress: Callable[[str], None] | None = None,
) -> ProvedLoop:
    """Prove that the loop converges from rest, one coordinate off the target, as far as it can.

    The law acts at every instant on the plant that it knows; for a held input, or a plant in a
    box, see :func:`undertow.proofs.draft_loop`.

    Parameters
    ----------
    coordinate
        Which one.
    reach
        Starts beyond this are not tried, SI units.
    duration
        Longest motion, s.
    seconds
        Process time of the search; the proof takes about as much again.

    Returns
    -------
    ProvedLoop
        Its verdict is the kernel's on the final claim.

    Raises
    ------
    InvalidInputError
        For a coordinate that the mechanism does not have, or a reach that is not positive.
    InfeasibleError
        When not even the first box could be proved.
    """
    started, names = time.process_time(), [c.name for c in mechanism.coordinates]
    require(coordinate in names, "coordinate of the starts", coordinate, ", ".join(names))
    for what, value in (("reach of the starts", reach), ("duration", duration)):
        require(np.isfinite(value) and value > 0, what, value, "finite, > 0")
    law = ReachingLaw() if reaching is None else reaching
    index = names.index(coordinate)
    sliding, search = SlidingModeLaw(mechanism, surface, law), search_for(mechanism, surface, law)
    terminal = None
    if search is not None:
        x = np.zeros((MOTIONS, 2 * mechanism.n))
        x[:, index] = np.linspace(reach / MOTIONS, reach, MOTIONS)
        terminal = _terminal(search, follow(sliding, x, duration)[0])
    if terminal is None:
        raise InfeasibleError(
            f"terminal set of {surface}",
            value="no motion enters a proved ellipsoid",
            limit=f"from rest up to {coordinate} = {reach:.4g}, within {duration:g} s",
            remedy="Take a longer duration or a smaller reach",
        )
    own = terminal.stated(mechanism, None)
    zero, still = Fraction(0), (Fraction(0),) * mechanism.n
    claim = ClosedLoop({}, zero, {}, still, zero, own)
    loop = Loop(model_of(mechanism), law_of(mechanism, surface, law), own.W, own.radius)
    # Around the edge of the layer a box is a small part of it, or its tube crosses for long.
    weight = np.abs(surface.position_row[:, index]).max()
    width = min(reach / 32, 0.15 * float(np.min(law.layer)) / max(weight, 1e-12))
    edges, box = [0.0], np.zeros((2 * mechanism.n, 2))
    while edges[-1] < reach and width > reach * THINNEST:
        box[index] = edges[-1], min(edges[-1] + width, reach)
        if time.process_time() - started > seconds:
            break
        _, there = loop.follow(box, float(claim.step))
        if there:
            edges.append(float(box[index, 1]))
            if progress is not None and len(edges) % 20 == 0:
                progress(f"proved up to {coordinate} = {edges[-1]:.4g}")
        width *= 1.5 if there else 0.5
    if len(edges) < 2:
        raise InfeasibleError(
            f"proved starts of the loop with {surface}",
            value="no tube ended in the terminal set",
            limit=f"boxes down to {reach * THINNEST:.2g} of {coordinate}",
            remedy="Give a smaller reach",
        )
    end = Fraction(edges[-1])
    cuts = {coordinate: tuple(Fraction(v) for v in edges[1:-1])}
    found = LoopClaim(
        ClosedLoop({coordinate: (-end, end)}, zero, {}, still, zero, own, cuts).data()
    )
    verdict = found.decide(mechanism, surface, law)
    return ProvedLoop(found, verdict, time.process_time() - started)


def _terminal(search: EllipsoidSearch, path: FloatArray) -> TerminalEllipsoid | None:
    """A proved ellipsoid that the motions (K, L, 2n) of as many starts as may be enter early.

    Each of some motions, the farthest first, proposes the one around its first state that has one.
    """
    best: tuple[int, int] | None = None
    chosen, count = None, path.shape[1]
    for j in dict.fromkeys(round(part * (count - 1)) for part in (1.0, 0.93, 0.86, 0.75, 0.6, 0.4)):
        for state in path[:, j]:
            if not np.isfinite(state).all() or (found := search.around(state)) is None:
                continue
            with np.errstate(all="ignore"):
                inside = np.linalg.norm(path @ found.W.T, axis=-1) < 0.98 * found.radius
            enters = inside.any(axis=0)
            far = count if enters.all() else int(enters.argmin())
            score = far, -int(inside[:, :far].argmax(axis=0).max(initial=0))
            if far and (best is None or score > best):
                best, chosen = score, found
            break
    return chosen
