"""Surfaces, runs and the paper's cases to claims with verdicts, the cheap ones first."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from undertow.base import UndertowError, Verdict, inward
from undertow.cascade import Run
from undertow.certify.claims.certificate import Claim, Subject, ellipsoid_data, function_data
from undertow.certify.claims.gate import Policy, assess
from undertow.certify.claims.verify import reaches, region_words
from undertow.certify.region.motion import SurfaceMotion
from undertow.certify.region.search import ProvedRegion, prove_region
from undertow.certify.surface.appendix import CASES, Constants, two_vertex
from undertow.certify.surface.ellipsoid import verify_ellipsoid
from undertow.certify.surface.ellipsoid_search import search_for
from undertow.certify.surface.reaching import reaching
from undertow.certify.surface.surface import hurwitz, nonsingular, singular_distance
from undertow.closed_loop import ClosedLoop
from undertow.law import Plan, ReachingLaw, Surface
from undertow.models import FloatArray, Mechanism
from undertow.studies.paper.appendix_search import search_rate

__all__ = [
    "Certified",
    "certify_appendix",
    "certify_run",
    "certify_surface",
]

#: Called with (what is being done, part done).
Progress = Callable[[str, float], None]

#: Most coordinates of a motion on the surface for which a region is searched.
LARGEST_REGION = 4

#: Part of what one disturbance alone may be that is claimed: rounding away from the edge.
CLAIMED = 0.999


@dataclass(frozen=True, eq=False)
class Certified:
    """One surface with all that is known of it.

    Parameters
    ----------
    title
        Its name in tables.
    subject
        Claims and remarks, as they go into the certificate.
    region
        The proved region on the surface, where there is one.
    seconds
        How long it took.
    """

    title: str
    subject: Subject
    region: ProvedRegion | None = None
    seconds: float = 0.0


def certify_surface(
    mechanism: Mechanism,
    surface: Surface,
    start: FloatArray,
    *,
    reaching_law: ReachingLaw = ReachingLaw(),
    title: str = "",
    seconds: float = 60.0,
    loop: bool = False,
    hold: int = 0,
    uncertain: Mapping[str, tuple[float, float]] | None = None,
    predict: bool = True,
    progress: Progress | None = None,
) -> Certified:
    """Decide what can be said of a surface.

    Parameters
    ----------
    mechanism
        Belief and plant.
    surface, reaching_law
        The law.
    start
        A state, (2n,): its positions, with both signs, span the region in which the law must
        exist, and say which way the region of attraction should reach.
    title
        For tables; the surface itself by default.
    seconds
        Effort for the region on the surface; 0 leaves it out.
    loop
        Also prove how far off the target the full closed loop may start at rest: minutes.
    hold, uncertain
        For that proof: the input is held for so many steps of 1 ms (0: at every instant), and
        plant parameters lie in [low, high] instead of being the law's own.
    predict
        Also predict the motion from the start, and from random ones up to it (sampled).
    progress
        Called with (what, part done).

    Returns
    -------
    Certified
    """
    began = time.perf_counter()
    tell = progress or (lambda what, part: None)
    claims: list[Claim] = []
    remarks: list[Verdict] = []

    def keep(kind: str, data: Mapping[str, object], verdict: Verdict) -> None:
        if verdict:
            claims.append(Claim(kind, data, verdict))
        else:
            remarks.append(verdict)

    tell("stability", 0.0)
    keep("stability", {}, hurwitz(mechanism, surface))
    region = None
    if claims:
        tell("terminal set", 0.03)
        keep("terminal ellipsoid", *_ellipsoid(mechanism, surface, reaching_law))
        tell("non-singularity", 0.05)
        box = _box(mechanism, start)
        if box:
            keep("nonsingular", {"region": _lists(box)}, _nonsingular(mechanism, surface, box))
        tell("disturbances", 0.08)
        for data, verdict in _disturbances(mechanism, surface, reaching_law, box):
            keep("reaching", data, verdict)
        if seconds > 0:
            tell("region on the surface", 0.1)
            region, data, verdict = _region(mechanism, surface, start, seconds)
            keep("surface region", data, verdict)
        if loop:
            tell("the whole closed loop", 0.5)
            keep("closed loop", *_loop(mechanism, surface, reaching_law, start, hold, uncertain))
        if predict and start.any():
            tell("prediction", 0.95)
            closed = ClosedLoop(mechanism, reaching=reaching_law)
            horizon = closed.objective.horizon
            remarks.append(assess(closed, Plan.of(surface), start, horizon, Policy()))
            tell("random starts", 0.97)
            remarks += _sampled(closed, surface, start)
    subject = Subject(surface, reaching_law, tuple(claims), tuple(remarks))
    return Certified(title or str(surface), subject, region, time.perf_counter() - began)


def _lists(box: Mapping[str, tuple[float, float]]) -> dict[str, list[float]]:
    return {k: list(v) for k, v in box.items()}


def _box(mechanism: Mechanism, start: FloatArray) -> dict[str, tuple[float, float]]:
    return {
        c.name: (-abs(float(v)), abs(float(v)))
        for c, v in zip(mechanism.coordinates, start[: mechanism.n], strict=True)
        if v
    }


def _ellipsoid(
    mechanism: Mechanism, surface: Surface, law: ReachingLaw
) -> tuple[Mapping[str, object], Verdict]:
    claim = "a terminal set of the full closed loop, layer and input limits included"
    search = search_for(mechanism, surface, law)
    found = None if search is None else search.largest()
    if found is None:
        return {}, Verdict(claim, "undecided", method="no ellipsoid of the modes is proved")
    return ellipsoid_data(found), verify_ellipsoid(mechanism, surface, law, found)


def _nonsingular(
    mechanism: Mechanism, surface: Surface, box: Mapping[str, tuple[float, float]]
) -> Verdict:
    verdict = nonsingular(mechanism, surface, box)
    if not verdict:
        return verdict
    factor, _ = singular_distance(mechanism, surface, box, tolerance=1e-3)
    details = {**verdict.details, "may grow by": factor}
    method = f"{verdict.method}; the box may grow {inward(factor)} times"
    return replace(verdict, method=method, details=details)


def _disturbances(
    mechanism: Mechanism,
    surface: Surface,
    law: ReachingLaw,
    box: Mapping[str, tuple[float, float]],
) -> list[tuple[Mapping[str, object], Verdict]]:
    """One claim for each coordinate: what K overcomes there, acting alone."""
    rows: list[tuple[Mapping[str, object], Verdict]] = []
    found = reaching(mechanism, surface, box, law)
    for j, bound in enumerate(found.largest):
        size = bound.proved * CLAIMED
        if not (size > 0 and math.isfinite(size)):
            continue
        load = [size if k == j else 0.0 for k in range(mechanism.n)]
        data = {"region": _lists(box), "eta": [0.0] * mechanism.m, "disturbance": load}
        verdict = reaching(mechanism, surface, box, law, eta=0.0, disturbance=load).verdict
        if bound.input_unit:
            most = f"{inward(bound.as_input * CLAIMED)} {bound.input_unit}"
            verdict = replace(verdict, method=f"{verdict.method}; {most} at the input")
        rows.append((data, verdict))
    return rows


def _region(
    mechanism: Mechanism, surface: Surface, start: FloatArray, seconds: float
) -> tuple[ProvedRegion | None, Mapping[str, object], Verdict]:
    claim = "a region of attraction on the surface"
    free = mechanism.n - mechanism.m
    size = 2 * mechanism.n - mechanism.m
    if size > LARGEST_REGION:
        why = f"{size} coordinates; boxes are searched up to {LARGEST_REGION}"
        return None, {}, Verdict(claim, "undecided", method=why)
    way = np.zeros(size)
    way[:free] = start[mechanism.m : mechanism.n]
    if not way.any():
        way[0] = 1.0
    way /= np.linalg.norm(way)
    try:
        motion = SurfaceMotion(mechanism, surface)
        proved = prove_region(motion, way, seconds=seconds)
    except UndertowError as error:
        return None, {}, Verdict(claim, "undecided", method=str(error))
    point = proved.extent * way
    for _ in range(20):
        if reaches(proved.function, point.tolist()):
            break
        point = 0.999 * point
    else:
        return proved, {}, Verdict(claim, "undecided", method="no start is shown inside")
    data = {"functions": [function_data(V) for V in proved.chain], "start": point.tolist()}
    verdict = Verdict(
        region_words(motion, point.tolist(), {}),
        "proved",
        float(np.linalg.norm(point)) * (1 - 1e-12),
        mechanism.coordinates[mechanism.m].unit,
        dict(zip(motion.names, point.tolist(), strict=True)),
        proved.verdict.method,
        proved.verdict.details,
    )
    return proved, data, verdict


def _loop(
    mechanism: Mechanism,
    surface: Surface,
    law: ReachingLaw,
    start: FloatArray,
    hold: int,
    uncertain: Mapping[str, tuple[float, float]] | None,
) -> tuple[Mapping[str, object], Verdict]:
    from undertow.certify.closed_loop.search import prove_loop

    free = mechanism.coordinates[mechanism.m :]
    away = np.abs(start[mechanism.m : mechanism.n])
    index = int(np.argmax(away))
    reach = float(away[index]) or (1.0 if free[index].unit == "rad" else 0.5)
    try:
        proved = prove_loop(
            mechanism, surface, law, coordinate=free[index].name, reach=reach, hold=hold,
            uncertain=uncertain,
        )  # fmt: skip
    except UndertowError as error:
        claim = "the full closed loop converges from rest"
        return {}, Verdict(claim, "undecided", method=str(error))
    return proved.claim.to_dict(), proved.verdict


#: Random starts of the sampled verdict.
TRIALS = 4000


def _sampled(loop: ClosedLoop, surface: Surface, start: FloatArray) -> list[Verdict]:
    """Whether starts at rest, up to the given one on either side, arrive."""
    from undertow.certify.surface.sampled import box_starts, sampled_region

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
    progress: Progress | None = None,
) -> tuple[Certified, ...]:
    """Decide stability and a terminal set for every surface that a run applied, in order.

    The admissions' verdicts become remarks of the surface that they admitted.
    """
    seen: dict[Surface, list[Verdict]] = {}
    for update in run.updates:
        verdicts = seen.setdefault(update.plan.surfaces[-1], [])
        if update.admission.accepted and update.admission.verdict is not None:
            verdicts.append(update.admission.verdict)
    certified = []
    for index, (surface, verdicts) in enumerate(seen.items()):
        if progress is not None:
            progress("surfaces of the run", index / len(seen))
        base = certify_surface(
            mechanism,
            surface,
            np.zeros(2 * mechanism.n),
            reaching_law=reaching_law,
            seconds=0.0,
            predict=False,
        )
        remarks = (*base.subject.remarks, *(v for v in verdicts if not v))
        subject = Subject(surface, reaching_law, base.subject.claims, remarks)
        certified.append(Certified(f"surface {index + 1}", subject, None, base.seconds))
    return tuple(certified)


def certify_appendix(
    mechanism: Mechanism, *, seconds: float = 0.0, progress: Progress | None = None
) -> tuple[Certified, ...]:
    """Decide the appendix's five cases, with a P of our own, for a rotary pendulum.

    Parameters
    ----------
    seconds
        Effort for each region on the surface; 0 leaves them out.
    """
    constants = Constants.of(mechanism)
    certified = []
    for index, case in enumerate(CASES):
        name = f"case {case.number}, {case.title}"
        if progress is not None:
            progress(name, index / len(CASES))
        start = mechanism.state(phi=float(case.half_width))
        base = certify_surface(
            mechanism, case.surface, start, seconds=seconds, title=name, predict=False
        )
        P, _ = search_rate(case.reduced(constants), case.half_width)
        data = {"P": [str(v) for v in P], "half_width": str(case.half_width)}
        verdict = two_vertex(case.reduced(constants), P, case.half_width)
        claims, remarks = base.subject.claims, base.subject.remarks
        if verdict:
            claims = (*claims, Claim("appendix interval", data, verdict))
        else:
            remarks = (*remarks, verdict)
        subject = Subject(case.surface, ReachingLaw(), claims, remarks)
        certified.append(Certified(name, subject, base.region, base.seconds))
    return tuple(certified)
