"""Surfaces, runs and the paper's cases to claims with verdicts, the cheap ones first."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from undertow.base import Progress, UndertowError, Verdict, each, inward, no_progress
from undertow.cascade import Run
from undertow.closed_loop import ClosedLoop
from undertow.law import Plan, ReachingLaw, Surface
from undertow.models import FloatArray, Mechanism
from undertow.objective import MinimumEnergy
from undertow.proofs import (
    Claim,
    GatePolicy,
    LyapunovFunction,
    NonsingularClaim,
    ProvedRegion,
    ReachingClaim,
    RegionClaim,
    StabilityClaim,
    StatedClaim,
    Subject,
    SurfaceMotion,
    assess,
    box_starts,
    prove_loop,
    prove_region,
    reaching,
    sampled_extent,
    sampled_region,
    search_for,
    singular_distance,
    verify_region,
)
from undertow.proofs.claims.claim import Box
from undertow.proofs.claims.region import reaches
from undertow.proofs.region.lyapunov import extent
from undertow.studies.paper.appendix import CASES, Constants, two_vertex
from undertow.studies.paper.appendix_search import search_rate

#: Most coordinates of a motion on the surface for which a region is searched.
LARGEST_REGION = 4

#: Boxes of the proof of one function of a region for every plant of a box.
MOST_BOXES = 3_000_000

#: How far random starts of the appendix's cases are looked for, rad.
FAR = math.radians(46)

#: Process time of a search for starts of the whole closed loop, s; their proof takes as much again.
LOOP_SECONDS = 300.0

#: Part of what one disturbance alone may be that is claimed: rounding away from the edge.
CLAIMED = 0.999

#: About how long what comes first takes once it is compiled, and what is sampled at last, s.
FIRST, LAST = 0.6, 5.0


@dataclass(frozen=True, eq=False)
class Certified:
    """One surface with all that is known of it.

    ``title``: its name in tables. ``subject``: claims and remarks, as they go into the certificate.
    ``region``: the proved region on the surface, where there is one. ``interval``: for a case of
    the appendix, whether R ≻ 0 on its Ĩ. ``seconds``: how long it took, s; ``region_seconds``: of
    it the region, search and proof. ``left_out``: what the loop of a bench has and no proof here,
    by name.
    """

    title: str
    subject: Subject
    region: ProvedRegion | None = None
    interval: Verdict | None = None
    seconds: float = 0.0
    region_seconds: float = 0.0
    left_out: Mapping[str, str] = field(default_factory=dict)


#: Takes what is known of a surface by now.
Kept = Callable[[Certified], None]


def no_keeping(_: Certified) -> None:
    """Keep nothing."""


def certify_surface(
    mechanism: Mechanism,
    surface: Surface,
    start: FloatArray,
    *,
    reaching_law: ReachingLaw = ReachingLaw(),
    title: str = "",
    seconds: float = 60.0,
    loop: bool = False,
    loop_seconds: float = LOOP_SECONDS,
    hold: int = 0,
    uncertain: Mapping[str, tuple[float, float]] | None = None,
    predict: bool = True,
    kept: Kept = no_keeping,
    progress: Progress = no_progress,
) -> Certified:
    """Decide what can be said of a surface.

    The positions of ``start``, (2n,), with both signs, span the region in which the law must exist,
    and say which way the region of attraction should reach; ``seconds``, s, is the effort for its
    search, 0 leaves it out. ``loop`` also proves from how much of the start the full closed loop
    converges, all of its states at once with both signs, in a search of ``loop_seconds`` and a
    proof of about as long; for that the input is held for ``hold`` ms (0: renewed at every
    instant). ``uncertain`` plant parameters lie in [low, high] instead of being the law's
    own: for the closed loop with a held input, and for a second region on the surface. ``predict``
    also predicts the motion from the start, and from random ones up to it (sampled). The ``title``
    is for tables, the surface itself by default. ``kept`` is called after each decision with all
    that is known by then: what an interruption leaves.
    """
    began = time.perf_counter()
    first = FIRST if seconds or loop else LAST  # beside a search what comes first is little
    most = first + seconds + (2 * loop_seconds if loop else 0.0) + (LAST if predict else 0.0)

    def tell(what: str, after: float) -> None:
        """Say what comes after so many of the seconds that all may take."""
        progress(what, after / most)

    tell("stability", 0.0)
    decide = _Decisions(mechanism, surface, reaching_law, start, dict(uncertain or {}))
    region, for_region = None, 0.0

    def so_far() -> Certified:
        subject = Subject(surface, reaching_law, tuple(decide.claims), tuple(decide.remarks))
        spent = time.perf_counter() - began
        return Certified(title or str(surface), subject, region, None, spent, for_region)

    def keep(claim: Claim | None, verdict: Verdict) -> None:
        decide.keep(claim, verdict)
        kept(so_far())

    keep(*decide.own(StabilityClaim()))
    if decide.claims:
        tell("terminal set", 0.3 * first)
        keep(*decide.ellipsoid())
        tell("non-singularity", 0.5 * first)
        if decide.box:
            keep(*decide.nonsingular())
        tell("disturbances", 0.8 * first)
        for claim, verdict in decide.disturbances():
            keep(claim, verdict)
        if seconds > 0:
            tell(f"region on the surface, a search of {seconds:g} s and a proof", first)
            before = time.perf_counter()
            region, found, verdict = decide.region(seconds)
            for_region = time.perf_counter() - before
            keep(found, verdict)
            if region is not None and uncertain:
                keep(*decide.region_in_box(region))
        if loop:
            searched = f"a search of {loop_seconds:g} s and a proof of about as long"
            tell(f"the whole closed loop, {searched}", first + seconds)
            keep(*decide.loop(hold, loop_seconds))
        if predict and start.any():
            tell("prediction", most - LAST)
            closed = ClosedLoop(mechanism, reaching=reaching_law)
            horizon = closed.objective.horizon
            try:
                decide.remarks.append(
                    assess(closed, Plan.of(surface), start, horizon, GatePolicy())
                )
                tell("random starts", most - 0.5 * LAST)
                decide.remarks.extend(_sampled(closed, surface, start))
            except UndertowError as error:  # what is proved stays
                words = "the predicted motion from the start"
                decide.remarks.append(Verdict(words, "undecided", method=str(error)))
    return so_far()


def _box(mechanism: Mechanism, start: FloatArray) -> dict[str, tuple[float, float]]:
    return {
        c.name: (-abs(float(v)), abs(float(v)))
        for c, v in zip(mechanism.coordinates, start[: mechanism.n], strict=True)
        if v
    }


#: A claim, or none that could be made, and its verdict.
_Decided = tuple[Claim | None, Verdict]


@dataclass(frozen=True, eq=False)
class _Decisions:
    """The claims on one surface, each with its verdict; what is kept of them, and what is not."""

    mechanism: Mechanism
    surface: Surface
    law: ReachingLaw
    start: FloatArray
    uncertain: Box
    claims: list[StatedClaim] = field(default_factory=list)
    remarks: list[Verdict] = field(default_factory=list)

    def keep(self, claim: Claim | None, verdict: Verdict) -> None:
        """Add to the claims what is proved, to the remarks what is not."""
        if claim is not None and verdict:
            self.claims.append(StatedClaim(claim.stated(self.mechanism, verdict), verdict))
        else:
            self.remarks.append(verdict)

    @property
    def box(self) -> Box:
        """The positions up to the start, on either side."""
        return _box(self.mechanism, self.start)

    def own(self, claim: Claim) -> _Decided:
        return claim, claim.decide(self.mechanism, self.surface, self.law)

    def ellipsoid(self) -> _Decided:
        words = "a terminal set of the full closed loop, layer and input limits included"
        search = search_for(self.mechanism, self.surface, self.law)
        found = None if search is None else search.largest()
        if found is None:
            return None, Verdict(words, "undecided", method="no ellipsoid of the modes is proved")
        return self.own(found)

    def nonsingular(self) -> _Decided:
        claim, verdict = self.own(NonsingularClaim(self.box))
        if not verdict:
            return claim, verdict
        factor, _ = singular_distance(self.mechanism, self.surface, self.box, tolerance=1e-3)
        details = {**verdict.details, "may grow by": factor}
        method = f"{verdict.method}; the box may grow {inward(factor)} times"
        return claim, replace(verdict, method=method, details=details)

    def disturbances(self) -> Iterator[_Decided]:
        """One claim for each coordinate: what K overcomes there, acting alone."""
        n, m = self.mechanism.n, self.mechanism.m
        found = reaching(self.mechanism, self.surface, self.box, self.law)
        for j, bound in enumerate(found.largest):
            size = bound.proved * CLAIMED
            if not (size > 0 and math.isfinite(size)):
                continue
            load = tuple(size if k == j else 0.0 for k in range(n))
            claim, verdict = self.own(ReachingClaim(self.box, (0.0,) * m, load))
            if bound.input_unit:
                most = f"{inward(bound.as_input * CLAIMED)} {bound.input_unit}"
                verdict = replace(verdict, method=f"{verdict.method}; {most} at the input")
            yield claim, verdict

    def region(self, seconds: float) -> tuple[ProvedRegion | None, Claim | None, Verdict]:
        words, mechanism = "a region of attraction on the surface", self.mechanism
        n, m = mechanism.n, mechanism.m
        if 2 * n - m > LARGEST_REGION:
            why = f"{2 * n - m} coordinates; boxes are searched up to {LARGEST_REGION}"
            return None, None, Verdict(words, "undecided", method=why)
        way = np.zeros(2 * n - m)
        way[: n - m] = self.start[m:n]
        if not way.any():
            way[0] = 1.0
        way /= np.linalg.norm(way)
        try:
            motion = SurfaceMotion(mechanism, self.surface)
            proved = prove_region(motion, way, seconds=seconds)
        except UndertowError as error:
            return None, None, Verdict(words, "undecided", method=str(error))
        point = _inside(proved.function, proved.extent * way)
        if point is None:
            return proved, None, Verdict(words, "undecided", method="no start is shown inside")
        return proved, *self.own(RegionClaim(proved.chain, point))

    def region_in_box(self, region: ProvedRegion) -> _Decided:
        """The region for every plant of a box: as many functions of the chain as hold there."""
        words = "a region of attraction for every plant of the box"
        box = self.uncertain
        chain: tuple[LyapunovFunction, ...] = ()
        for V in region.chain:
            tried, known = (*chain, V), len(chain)
            verdict = verify_region(
                region.motion, tried, parameters=box, max_boxes=MOST_BOXES, proved=known
            )
            if not verdict:
                break
            chain = tried
        if not chain:
            return None, replace(verdict, claim=words)
        point = _inside(chain[-1], extent(chain[-1], region.way) * region.way)
        if point is None:
            return None, Verdict(words, "undecided", method="no start is shown inside")
        return self.own(RegionClaim(chain, point, box))

    def loop(self, hold: int, seconds: float) -> _Decided:
        """How far off the target the states that the start is off may be, all at once."""
        mechanism = self.mechanism
        off = zip(mechanism.state_names, np.abs(self.start).tolist(), strict=True)
        starts = {name: size for name, size in off if size}
        if not starts:
            free = mechanism.coordinates[mechanism.m]
            starts = {free.name: 1.0 if free.unit == "rad" else 0.5}
        try:
            proved = prove_loop(
                mechanism, self.surface, self.law, starts=starts, period=hold / 1000,
                plant=self.uncertain, seconds=seconds,
            )  # fmt: skip
        except UndertowError as error:
            words = "the full closed loop converges from around the target"
            return None, Verdict(words, "undecided", method=str(error))
        return proved.claim, proved.verdict


def _inside(V: LyapunovFunction, point: FloatArray) -> tuple[float, ...] | None:
    """A point a little nearer to 0 that is shown inside {V ≤ 1}, or none."""
    for _ in range(20):
        if reaches(V, point.tolist()):
            return tuple(point.tolist())
        point = 0.999 * point
    return None


#: Random starts of the sampled verdict.
TRIALS = 4000


def _sampled(loop: ClosedLoop, surface: Surface, start: FloatArray) -> list[Verdict]:
    """Whether starts at rest, up to the given one on either side, arrive."""
    box = _box(loop.mechanism, start)
    if not box:
        return []
    ranges = ", ".join(f"|{name}| ≤ {high:.4g}" for name, (_, high) in box.items())
    starts = box_starts(loop.mechanism, **box)
    words = f"starts at rest with {ranges}"
    return [sampled_region(loop, surface, starts, trials=TRIALS, what=words)]


def certify_run(
    mechanism: Mechanism,
    run: Run,
    *,
    reaching_law: ReachingLaw = ReachingLaw(),
    kept: Kept = no_keeping,
    progress: Progress = no_progress,
) -> tuple[Certified, ...]:
    """Decide stability and a terminal set for every surface that a run applied, in order.

    ``reaching_law`` is that of the cascade that ran, for plans that have none of their own. The
    admissions' verdicts become remarks of the surface that they admitted; ``kept`` is as for
    :func:`certify_surface`.
    """
    seen: dict[tuple[Surface, ReachingLaw], list[Verdict]] = {}
    for update in run.updates:
        last = update.plan.surfaces[-1], update.plan.laws(reaching_law)[-1]
        verdicts = seen.setdefault(last, [])
        if update.admission.accepted and update.admission.verdict is not None:
            verdicts.append(update.admission.verdict)
    certified: list[Certified] = []
    for (surface, law), verdicts in each(seen.items(), progress, lambda _: "surfaces of the run"):
        base = certify_surface(
            mechanism, surface, np.zeros(2 * mechanism.n), title=f"surface {len(certified) + 1}",
            reaching_law=law, seconds=0.0, predict=False, kept=kept,
        )  # fmt: skip
        remarks = (*base.subject.remarks, *(v for v in verdicts if not v))
        certified.append(replace(base, subject=replace(base.subject, remarks=remarks)))
    return tuple(certified)


def certify_appendix(
    mechanism: Mechanism,
    *,
    seconds: float = 0.0,
    loop: bool = False,
    loop_seconds: float = LOOP_SECONDS,
    hold: int = 0,
    uncertain: Mapping[str, tuple[float, float]] | None = None,
    kept: Kept = no_keeping,
    progress: Progress = no_progress,
) -> tuple[Certified, ...]:
    """Decide the appendix's five cases, with a P of our own, for a rotary pendulum.

    ``seconds``, ``loop_seconds``, ``hold``, ``uncertain`` and ``kept`` are as for
    :func:`certify_surface`.
    ``loop`` also proves how far off the target the full closed loop may start at rest, up to where
    random starts of the law at every instant, on the plant that it knows, still converge; their
    verdict is a remark. Minutes for each case.
    """
    constants = Constants.of(mechanism)
    certified = []
    for index, case in enumerate(CASES):
        name = f"case {case.number}, {case.title}"
        progress(name, index / len(CASES))
        start = mechanism.state(phi=float(case.half_width))
        base = certify_surface(
            mechanism, case.surface, start, seconds=seconds, uncertain=uncertain, title=name,
            predict=False, kept=kept,
        )  # fmt: skip
        P, _ = search_rate(case.reduced(constants), case.half_width)
        interval = two_vertex(case.reduced(constants), P, case.half_width)
        subject = base.subject
        if loop:
            law = ReachingLaw()
            closed = ClosedLoop(mechanism, MinimumEnergy(horizon=80.0), law, tail_rtol=1e-3)
            sampled = sampled_extent(closed, case.surface, "phi", FAR)
            limit = mechanism.state(phi=float(sampled.details["extent"]))
            decide = _Decisions(mechanism, case.surface, law, limit, dict(uncertain or {}))
            decide.keep(*decide.loop(hold, loop_seconds))
            subject = replace(
                subject,
                claims=(*subject.claims, *decide.claims),
                remarks=(*subject.remarks, *decide.remarks, sampled),
            )
        certified.append(replace(base, subject=subject, interval=interval))
        kept(certified[-1])
    return tuple(certified)
