"""The search for a region of attraction: a quadratic set, a chain that grows from it, proofs.

:mod:`undertow.proofs.search.quadratic` finds the first set,
:mod:`undertow.proofs.search.chain` lets it grow, all by samples; here as few functions of
that chain as possible are proved by :func:`undertow.proofs.verify_region`, and the level of the
last one is raised to the largest that is proved.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from undertow.base.errors import InfeasibleError
from undertow.base.verdict import Verdict
from undertow.models.mechanism import FloatArray
from undertow.proofs.claims.region import verify_region
from undertow.proofs.region.lyapunov import LyapunovFunction, extent
from undertow.proofs.region.motion import SurfaceMotion
from undertow.proofs.search.basis import even_exponents
from undertow.proofs.search.chain import SearchBudget, grow
from undertow.proofs.search.chart import natural_stretch
from undertow.proofs.search.quadratic import Start, quadratic

Chain = tuple[LyapunovFunction, ...]

#: How close to the largest level that the checker proves; the first step on the way there.
TIGHT, STRIDE = 1.02, 1.05
#: The largest level that is tried: on a linear motion none is ever refused.
HIGHEST = 100.0

#: Boxes of each function's proof.
MOST_BOXES = 1_000_000

#: Functions of a found chain that one proof tries to leap over, at first.
LEAP = 16


@dataclass(frozen=True)
class ProvedRegion:
    """A proved region of attraction.

    Parameters
    ----------
    motion
        The motion, on a surface in y = (q_u, q̇_u, w).
    way
        The asked direction of y, (N,).
    chain
        Functions from the innermost set to the outermost; the set is the component of
        {V ≤ 1}, V the last, that contains 0.
    verdict
        The proof.
    extent
        How far along the asked direction the set is proved to reach.
    raised
        What the checker says of the last level, at most 2 % higher: never ``proved``, and
        with a witness.  ``None`` where no level up to 100 was refused.
    search_seconds
        How long it was searched for before the proofs, s.
    """

    motion: SurfaceMotion
    way: FloatArray
    chain: Chain
    verdict: Verdict
    extent: float
    raised: Verdict | None
    search_seconds: float = 0.0

    @property
    def function(self) -> LyapunovFunction:
        """The last V of the chain."""
        return self.chain[-1]

    def level(self, y: ArrayLike) -> FloatArray:
        """Return the larger of V and its guard at points y, (…, N): ≤ 1 on what is proved alone.

        {V ≤ 1} may have parts elsewhere, of which nothing is proved.
        """
        guard = self.function.guard
        assert guard is not None
        return np.maximum(self.function(y), guard(y))


def search_region(
    motion: SurfaceMotion,
    direction: ArrayLike,
    *,
    degrees: Sequence[int] = (4, 6),
    programs: int = 300,
    seconds: float = math.inf,
    seed: int = 0,
    start: Start = "round",
    slow: bool = True,
) -> Chain:
    """Find a chain whose last set {V ≤ 1} reaches far along a direction of y, by sampling.

    ``motion``: the sliding dynamics. ``direction``: in y, (N,); on a surface y = (q_u, q̇_u, w), so
    (1, 0, 0) is an angle at rest. ``degrees``: even degrees of the functions, one after the other;
    the first V is quadratic. ``programs``: linear programs at most, shared by the degrees.
    ``seconds``: time at most, likewise. ``start``: the quadratic V to begin with: ``"far"``
    reaches far along the direction and grows little; ``"round"`` starts closer and grows further;
    ``"balanced"`` is for coordinates of very different sizes. ``slow``: on a surface with one
    unactuated coordinate: whether the third of the coordinates of
    :mod:`undertow.proofs.search.chart` is η, not w. Raises UnstableSurfaceError when the surface is
    not locally stable.
    """
    end = time.perf_counter() + seconds
    rng = np.random.default_rng(seed)
    way = np.asarray(direction, dtype=float)
    stretch = natural_stretch(motion, slow=slow)
    # A little inside what samples allow.
    chain = [quadratic(motion, stretch, way, rng, start).times(1.02)]
    pace = 0.0  # time of a linear program, about, over the square of its columns
    for k, degree in enumerate(degrees):
        share = (k + 1) / sum(range(1, len(degrees) + 1))
        part = (k + 1) / sum(range(k + 1, len(degrees) + 1))  # of what time is left
        left, size = part * (end - time.perf_counter()), len(even_exponents(motion.size, degree))
        budget = SearchBudget(math.floor(share * programs), left, pace * size**2)
        chain += grow(motion, chain[-1], way, degree, budget, rng)
        pace = budget.pace / size**2
    return tuple(chain)


def prove_region(
    motion: SurfaceMotion, direction: ArrayLike, *, seconds: float = math.inf, seed: int = 0
) -> ProvedRegion:
    """Search for a region of attraction, prove it, and raise its level as far as that goes.

    Parameters
    ----------
    motion, direction, seed
        As for :func:`search_region`.
    seconds
        Time for the search.  The proofs are not timed: with ``seconds`` left out the work does not
        depend on the machine.

    Returns
    -------
    ProvedRegion
        The largest set found that could be proved.

    Raises
    ------
    InfeasibleError
        When not even the first set could be proved.
    UnstableSurfaceError
        When the surface is not locally stable.
    """
    began = time.perf_counter()
    way = np.asarray(direction, dtype=float)
    search = partial(search_region, motion, direction, seed=seed)
    # Sets that start round grow furthest, but near 0 the far one is proved with far less work.
    far, balanced = search(degrees=(), start="far")[0], search(degrees=(), start="balanced")[0]
    found = search(seconds=seconds - (time.perf_counter() - began))
    searched = time.perf_counter() - began

    def decide(chain: Sequence[LyapunovFunction]) -> Verdict:
        """The last function, those before it being proved."""
        return verify_region(motion, chain, max_boxes=MOST_BOXES, proved=len(chain) - 1)

    chain = _proved_chain((far, found[0], balanced), found, decide)
    if extent(chain[0], way) > extent(chain[-1], way):
        chain = chain[:1]
    level, raised = _tight_level(chain, decide)
    chain[-1] = level
    verdict = verify_region(motion, chain, max_boxes=10**12)
    reach = extent(level, way) * (1 - 1e-9)
    return ProvedRegion(motion, way, tuple(chain), verdict, reach, raised, searched)


Decide = Callable[[Sequence[LyapunovFunction]], Verdict]


def _proved_chain(firsts: Chain, found: Chain, decide: Decide) -> list[LyapunovFunction]:
    """As few functions as prove one another, from a quadratic to the outermost that is proved."""
    for first in (V.times(factor) for factor in (1.0, 1.1, 1.3, 2.0) for V in firsts):
        verdict = decide([first])
        if verdict:
            break
    else:
        raise InfeasibleError(
            "region of attraction",
            value=str(verdict),
            limit="a proved sublevel set",
            remedy="Give the search another seed",
        )
    proved, at, leap = [first], -1, LEAP
    while at < len(found) - 1:
        target = min(at + leap, len(found) - 1)
        if decide([*proved, found[target]]):
            proved.append(found[target])
            at, leap = target, min(2 * leap, LEAP)
        elif target > at + 1:
            leap = (target - at) // 2
        else:
            break
    return proved


def _tight_level(
    chain: Sequence[LyapunovFunction], decide: Decide
) -> tuple[LyapunovFunction, Verdict | None]:
    """The last function with a level that is proved and, 2 % higher, is not: and that verdict.

    Without a verdict where all levels up to the largest that is tried are proved.
    """
    *inner, V = chain
    stride = STRIDE
    level, low, high, refusal = stride, 1.0, math.inf, None
    while low < HIGHEST and high / low > TIGHT:
        verdict = decide([*inner, V.times(1 / level)])
        if verdict:
            low, stride = level, stride**2
        else:
            high, refusal = level, verdict
        level = min(low * stride, HIGHEST) if refusal is None else math.sqrt(low * high)
    return V.times(1 / low), refusal
