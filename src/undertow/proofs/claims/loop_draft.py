"""The closed loop with a held input or a plant in a box, which the kernel does not decide yet.

The starts are at rest, one coordinate anywhere in [−w, w], the others at the target.  They are
cut into boxes; a validated tube from each box, with the boundary layer and the input clip in
place, ends in a terminal set that is proved invariant and attractive.  By oddness of the loop
one half of the line is enough.

Nothing here searches: a claim is a handful of numbers, and :meth:`LoopDraft.decide` decides it
from them and the mechanism alone.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Self

import numpy as np

from undertow.base.verdict import Kind, Verdict, inward, within
from undertow.law import ReachingLaw, Surface
from undertow.models.mechanism import Mechanism
from undertow.proofs.claims.claim import Box, Claim, Readers, box_of, floats_of
from undertow.proofs.claims.terminal_ellipsoid import limits_in_words
from undertow.proofs.closed_loop.loop import LoopMotion
from undertow.proofs.closed_loop.run import run_tubes, start_tubes
from undertow.proofs.closed_loop.terminal import verify_terminal
from undertow.proofs.closed_loop.terminal_set import TerminalSet
from undertow.proofs.intervals.require import require

#: Edges that a claim may have: some kilobytes of memory for each.
MOST_EDGES = 20_000


@dataclass(frozen=True, eq=False)
class LoopDraft(Claim):
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

    kind: ClassVar[str] = "closed loop draft"
    reads: ClassVar[Readers] = {
        "coordinate": str,
        "edges": floats_of,
        "terminal": TerminalSet.from_dict,
        "step": float,
        "horizon": float,
        "uncertain": box_of,
        "hold": lambda value: value,
    }
    coordinate: str
    edges: tuple[float, ...]
    terminal: TerminalSet
    step: float
    horizon: float
    uncertain: Box = field(default_factory=dict)
    hold: int = 0

    def __post_init__(self) -> None:
        """Refuse what claims nothing."""
        edges = np.asarray(self.edges, dtype=float)
        rising = edges.size >= 2 and edges[0] == 0 and (np.diff(edges) > 0).all()
        require(rising, "edges of a claim", list(self.edges)[:4], "rising from 0")
        require(np.isfinite(edges).all(), "edges of a claim", limit="finite")
        most = f"≤ {MOST_EDGES}: all sets move at once"
        require(edges.size <= MOST_EDGES, "edges of a claim", edges.size, most)
        for name in ("step", "horizon"):
            value = getattr(self, name)
            good = math.isfinite(value) and value > 0
            require(good, f"{name} of a claim", value, "finite, > 0 s")
        whole = isinstance(self.hold, int) and not isinstance(self.hold, bool) and self.hold >= 0
        require(whole, "hold of a claim", self.hold, "a whole number ≥ 0")

    @property
    def period(self) -> float:
        """The sampler's period rounded up, s; 0 for a law that acts at every instant."""
        return math.nextafter(self.hold * self.step, math.inf) if self.hold else 0.0

    @property
    def extent(self) -> float:
        """How far the starts reach, SI units."""
        return self.edges[-1]

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """Rebuild from :meth:`to_dict`; what the kernel decides is refused."""
        claim = super().from_dict(data)
        drafted = claim.hold or claim.uncertain
        require(drafted, "draft of a claim", "no held input, no box", "what the kernel leaves")
        return claim

    def _unit(self, mechanism: Mechanism) -> str:
        return next((c.unit for c in mechanism.coordinates if c.name == self.coordinate), "")

    def sentence(self, mechanism: Mechanism) -> str:
        """Return in words what is claimed."""
        unit = self._unit(mechanism)
        text = (
            f"every start at rest with |{self.coordinate}| ≤ {inward(self.extent, 6)} {unit}, the "
            "other coordinates at the target, converges under the law with its boundary layer, its "
            f"input clipped to {limits_in_words(mechanism)} and "
        )
        period = repr(self.hold * self.step)
        text += f"held for {period} s" if self.hold else "renewed at every instant"
        if self.uncertain:
            box = ", ".join(f"{k} in {within(a, b)}" for k, (a, b) in self.uncertain.items())
            text += f", for every plant with {box}"
        return text

    def decide(
        self,
        mechanism: Mechanism,
        surface: Surface,
        law: ReachingLaw,
        *,
        seconds: float = 600.0,
        progress: Callable[[str], None] | None = None,
    ) -> Verdict:
        """Decide it from its numbers and the mechanism alone.

        Parameters
        ----------
        mechanism
            Model of the law, and the plant but for the claim's uncertain parameters.
        surface, law
            The law (5), (12) with saturation (39); inputs are clipped to the mechanism's limits.
        seconds
            Process time before giving up.
        progress
            Called with a line of text now and then.

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
        motion = LoopMotion(mechanism, surface, law, dict(self.uncertain), self.period)
        text, edges = self.sentence(mechanism), self.edges
        unit = self._unit(mechanism)
        method = "validated tubes (Lohner, outward-rounded float64) into a proved terminal set"
        tubes = start_tubes(motion, self.coordinate, edges)
        if not motion.odd:
            return Verdict(text, "undecided", unit=unit, method="the loop is not shown to be odd")
        end = verify_terminal(motion, self.terminal, max_seconds=seconds)
        if not end:
            kind: Kind = "refuted" if end.kind == "refuted" else "undecided"
            why = f"terminal set: {end.kind}, {end.method}"
            return Verdict(
                text, kind, unit=unit, witness=end.witness, method=why, details=end.details
            )
        left = seconds - (time.process_time() - started)
        result = run_tubes(
            motion, tubes, self.terminal, self.step, self.horizon, max_seconds=left,
            progress=progress,
        )  # fmt: skip
        entered = result.entered[np.isfinite(result.entered)]
        details = {
            "seconds": time.process_time() - started,
            "terminal": dict(end.details),
            "tubes": len(edges) - 1,
            "steps": result.steps,
            "entered": float(entered.max()) if len(entered) else None,
            "peak_demand": result.peak.max(axis=0).tolist(),
        }
        missing = np.flatnonzero(np.isnan(result.entered))
        if len(missing):
            # Once one is lost the others are left where they are.
            failed = int(np.argmax(result.lost)) if result.lost.any() else int(missing[0])
            witness = {self.coordinate: 0.5 * (edges[failed] + edges[failed + 1])}
            why = method + ", a tube did not end in the terminal set"
            return Verdict(
                text, "undecided", unit=unit, witness=witness, method=why, details=details
            )
        return Verdict(text, "proved", self.extent, unit, method=method, details=details)
