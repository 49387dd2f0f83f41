"""The claim that the whole closed loop converges from a line of starts, and its verification.

The starts are at rest, one coordinate anywhere in [−w, w], the others at the target.  They are
cut into boxes; a validated tube from each box, with the boundary layer and the input clip in
place, ends in a terminal set that is proved invariant and attractive.  By oddness of the loop
one half of the line is enough.

Nothing here searches: a claim is a handful of numbers, and :func:`verify_loop` decides it from
them and the mechanism alone.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Self, cast

import numpy as np
from numpy.typing import NDArray

from undertow.base.errors import InvalidInputError
from undertow.base.verdict import Kind, Verdict, inward, within
from undertow.certify.closed_loop.loop import LoopMotion, LoopRates
from undertow.certify.closed_loop.sampled_data import SampledDataLoop
from undertow.certify.closed_loop.terminal import TerminalSet, exact_inverse, verify_terminal
from undertow.certify.closed_loop.tube import Tubes, bracket
from undertow.certify.intervals.batch import Interval
from undertow.certify.surface.ellipsoid import limits_in_words
from undertow.law.sliding import ReachingLaw, Surface
from undertow.models.mechanism import Mechanism

__all__ = ["LoopClaim", "TubeEnd", "run_tubes", "start_tubes", "verify_loop"]

FloatArray = NDArray[np.float64]


#: Edges that a claim may have: some kilobytes of memory for each.
MOST_EDGES = 20_000


@dataclass(frozen=True, eq=False)
class LoopClaim:
    """Every start at rest with |coordinate| ≤ edges[−1] converges under the clipped law.

    Parameters
    ----------
    coordinate
        Name of the coordinate that is off the target, SI units.
    edges
        0 = e_0 < e_1 < …: tubes start from [e_k, e_{k+1}].
    terminal
        The set in which the tubes end.
    step
        Step of the validated integration, s.
    horizon
        Latest time at which every tube is inside the terminal set, s.
    uncertain
        Plant parameters that are only known to lie in [low, high]; the law has its own.
    hold
        The law is evaluated every ``hold`` steps, first at 0, and its input held between;
        0: at every instant.

    Raises
    ------
    InvalidInputError
        For edges that do not rise from 0, a step or horizon that is not positive, or a hold
        that is no whole number.
    """

    coordinate: str
    edges: tuple[float, ...]
    terminal: TerminalSet
    step: float
    horizon: float
    uncertain: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    hold: int = 0

    def __post_init__(self) -> None:
        """Refuse what claims nothing."""
        edges = np.asarray(self.edges, dtype=float)
        if edges.size < 2 or edges[0] != 0 or not (np.diff(edges) > 0).all():
            raise InvalidInputError(
                "edges of a claim", value=list(self.edges)[:4], limit="rising from 0"
            )
        if not np.isfinite(edges).all():
            raise InvalidInputError("edges of a claim", limit="finite")
        if edges.size > MOST_EDGES:
            raise InvalidInputError(
                "edges of a claim", value=edges.size, limit=f"≤ {MOST_EDGES}: all sets move at once"
            )
        for name in ("step", "horizon"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise InvalidInputError(f"{name} of a claim", value=value, limit="finite, > 0 s")
        if isinstance(self.hold, bool) or not isinstance(self.hold, int) or self.hold < 0:
            raise InvalidInputError("hold of a claim", value=self.hold, limit="a whole number ≥ 0")

    @property
    def period(self) -> float:
        """The sampler's period rounded up, s; 0 for a law that acts at every instant."""
        return math.nextafter(self.hold * self.step, math.inf) if self.hold else 0.0

    @property
    def extent(self) -> float:
        """How far the starts reach, SI units."""
        return self.edges[-1]

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers, texts and lists."""
        return {
            "coordinate": self.coordinate,
            "edges": list(self.edges),
            "terminal": self.terminal.to_dict(),
            "step": self.step,
            "horizon": self.horizon,
            "uncertain": {name: list(pair) for name, pair in self.uncertain.items()},
            "hold": self.hold,
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """Rebuild from :meth:`to_dict`; a hold that is no whole number is refused."""
        return cls(
            str(data["coordinate"]),
            tuple(float(v) for v in data["edges"]),
            TerminalSet.from_dict(data["terminal"]),
            float(data["step"]),
            float(data["horizon"]),
            {str(k): (float(v[0]), float(v[1])) for k, v in data.get("uncertain", {}).items()},
            data.get("hold", 0),
        )


class TubeEnd(NamedTuple):
    """What became of L tubes.

    ``entered`` (L,) is the time at which each was inside the terminal set, NaN if it was not;
    ``peak`` (L, m) bounds the demand on the way; ``steps`` counts steps of the longest; ``lost``
    (L,) marks those that burst.
    """

    entered: FloatArray
    peak: FloatArray
    steps: int
    lost: NDArray[np.bool_]


def start_tubes(motion: LoopMotion, coordinate: str, edges: Sequence[float] | FloatArray) -> Tubes:
    """Return the sets of starts at rest between neighbouring edges.

    Raises
    ------
    InvalidInputError
        For a coordinate that the mechanism does not have.
    """
    names = [c.name for c in motion.mechanism.coordinates]
    if coordinate not in names:
        raise InvalidInputError(
            f"coordinate of '{motion.mechanism.name}'",
            value=repr(coordinate),
            limit=f"one of {', '.join(names)}",
        )
    index = names.index(coordinate)
    grid = np.asarray(edges, dtype=float)
    middle, radius = bracket(grid[:-1], grid[1:])
    lanes, size, slow = len(middle), motion.size, motion.slow
    centre, spread = np.zeros((size, lanes)), np.zeros((size, 1, lanes))
    centre[index], spread[index, 0] = middle, radius
    rest = Interval(np.zeros((size, lanes)), np.zeros((size, lanes)))
    for i, weight in enumerate(motion.surface.position_row[:, index]):
        # s = λ q: what rounding loses goes to the remainder.
        one = Interval(float(weight))
        centre[slow + i] = weight * middle
        spread[slow + i, 0] = weight * radius
        lost = (one * Interval(middle) - Interval(centre[slow + i])) + (
            one * Interval(radius) - Interval(spread[slow + i, 0])
        ) * Interval(-1.0, 1.0)
        rest.lo[slow + i], rest.hi[slow + i] = lost.lo, lost.hi
    return Tubes.of(motion, centre, spread, rest)


def run_tubes(
    motion: LoopMotion,
    tubes: Tubes,
    terminal: TerminalSet,
    step: float,
    horizon: float,
    *,
    max_seconds: float = math.inf,
    stop_early: bool = True,
    progress: Callable[[str], None] | None = None,
) -> TubeEnd:
    """Follow tubes until they lie in the terminal set, at a sample where the input is held.

    Parameters
    ----------
    stop_early
        Give up on all once one is lost: a claim needs every one.
    progress
        Called with a line of text now and then.
    """
    started = time.process_time()
    lanes, m = tubes.middle.shape[1], motion.mechanism.m
    entered, peak = np.full(lanes, np.nan), np.zeros((lanes, m))
    lost = np.zeros(lanes, dtype=bool)
    active = np.arange(lanes)
    inverse = exact_inverse(terminal.scale)
    square = (motion.size, motion.size)
    rows = Interval(np.zeros(square), np.zeros(square))
    rows.lo[: motion.slow, : motion.slow], rows.hi[: motion.slow, : motion.slow] = (
        inverse.lo, inverse.hi,
    )  # fmt: skip
    for i in range(m):
        rows.lo[motion.slow + i, motion.slow + i] = 1.0
        rows.hi[motion.slow + i, motion.slow + i] = 1.0
    held = SampledDataLoop(motion) if motion.period else None
    parts = max(1, round(motion.period / step))
    if held is not None:
        tubes = held.begin(tubes)
        rows = Interval(
            *(np.concatenate([a, np.zeros((motion.size, m))], axis=1) for a in (rows.lo, rows.hi))
        )
    k, count = 0, max(1, round(horizon / step))
    while k < count and len(active):
        if time.process_time() - started > max_seconds:
            break
        u = None
        if held is not None and k % parts == 0:
            tubes, u = held.sample(tubes)
        tubes, _, rates, moved = tubes.advance(step)
        k += 1
        if held is None:
            u = cast(LoopRates, rates).demand
        if u is not None:
            demand = np.maximum(np.abs(u.lo), np.abs(u.hi)).T
            peak[active] = np.maximum(peak[active], demand)
        inside = moved & _inside(tubes.image(rows), motion.slow, terminal.widths)
        inside &= k % parts == 0
        entered[active[inside]] = k * step
        lost[active[~moved]] = True
        keep = moved & ~inside
        if not moved.all() and stop_early:
            break
        if not keep.all():
            tubes, active = tubes.take(keep), active[keep]
        if progress is not None and k % 100 == 0:
            progress(f"{k * step:.3f} s: {len(active)} of {lanes} tubes on their way")
    return TubeEnd(entered, peak, k, lost)


def _inside(image: Interval, slow: int, widths: FloatArray) -> NDArray[np.bool_]:
    """Whether (x, s) boxes lie in {‖x‖ ≤ 1, |s_i| ≤ σ_i}."""
    square = Interval(0.0)
    for i in range(slow):
        square = square + image[i] ** 2
    s = np.maximum(np.abs(image.lo[slow:]), np.abs(image.hi[slow:]))
    return np.asarray((square.hi <= 1.0) & (s <= widths[:, None]).all(axis=0))


def verify_loop(
    mechanism: Mechanism,
    surface: Surface,
    reaching: ReachingLaw,
    claim: LoopClaim,
    *,
    max_seconds: float = 600.0,
    progress: Callable[[str], None] | None = None,
) -> Verdict:
    """Decide a claim from its numbers and the mechanism alone.

    Parameters
    ----------
    mechanism
        Model of the law, and the plant but for the claim's uncertain parameters.
    surface, reaching
        The law (5), (12) with saturation (39); inputs are clipped to the mechanism's limits.
    claim
        What is claimed.
    max_seconds
        Process time before giving up.

    Returns
    -------
    Verdict
        ``proved`` with the proved extent as margin; ``refuted`` where the terminal set is
        none (with its witness); else ``undecided`` with the start of the tube that failed.

    Raises
    ------
    InvalidInputError
        For a claim that does not fit the mechanism.
    """
    started = time.process_time()
    motion = LoopMotion(mechanism, surface, reaching, dict(claim.uncertain), claim.period)
    where = next((c for c in mechanism.coordinates if c.name == claim.coordinate), None)
    unit = where.unit if where is not None else ""
    text = (
        f"every start at rest with |{claim.coordinate}| ≤ {inward(claim.extent, 6)} {unit}, the "
        "other coordinates at the target, converges under the law with its boundary layer, its "
        f"input clipped to {limits_in_words(mechanism)} and "
    )
    held = f"held for {claim.hold * claim.step!r} s" if claim.hold else "renewed at every instant"
    text += held
    if claim.uncertain:
        box = ", ".join(f"{k} in {within(a, b)}" for k, (a, b) in claim.uncertain.items())
        text += f", for every plant with {box}"
    method = "validated tubes (Lohner, outward-rounded float64) into a proved terminal set"
    tubes = start_tubes(motion, claim.coordinate, claim.edges)
    if not motion.odd:
        return Verdict(text, "undecided", unit=unit, method="the loop is not shown to be odd")
    end = verify_terminal(motion, claim.terminal, max_seconds=max_seconds)
    if not end:
        kind: Kind = "refuted" if end.kind == "refuted" else "undecided"
        why = f"terminal set: {end.kind}, {end.method}"
        return Verdict(text, kind, unit=unit, witness=end.witness, method=why, details=end.details)
    left = max_seconds - (time.process_time() - started)
    result = run_tubes(
        motion,
        tubes,
        claim.terminal,
        claim.step,
        claim.horizon,
        max_seconds=left,
        progress=progress,
    )
    details = {
        "seconds": time.process_time() - started,
        "terminal": dict(end.details),
        "tubes": len(claim.edges) - 1,
        "steps": result.steps,
        "entered": float(np.nanmax(result.entered)) if np.isfinite(result.entered).any() else None,
        "peak_demand": result.peak.max(axis=0).tolist(),
    }
    missing = np.flatnonzero(np.isnan(result.entered))
    if len(missing):
        # Once one is lost the others are left where they are.
        where_to = int(np.argmax(result.lost)) if result.lost.any() else int(missing[0])
        first = 0.5 * (claim.edges[where_to] + claim.edges[where_to + 1])
        why = method + ", a tube did not end in the terminal set"
        witness = {claim.coordinate: first}
        return Verdict(text, "undecided", unit=unit, witness=witness, method=why, details=details)
    return Verdict(text, "proved", claim.extent, unit, method=method, details=details)
