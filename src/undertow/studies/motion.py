"""One motion and one optimum, as text and as files: `undertow simulate`, `undertow optimise`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from rich.console import Group, RenderableType
from rich.text import Text

from undertow.base import facts, finite, manifest, mark, table, to_csv
from undertow.cascade import Cascade, Gate, Run, Update, problem_words
from undertow.closed_loop import Event, Trajectory
from undertow.closed_loop.figures import display, figure_bytes, motion_figure, state_words
from undertow.law import Plan, ReachingLaw, Surface, Target
from undertow.models import FloatArray, Mechanism
from undertow.objective import Objective
from undertow.optimiser import Proposal

#: Part of an input's limit from which on a disturbance that is left out is worth a sentence.
NOTABLE = 0.1

_ENDINGS = {
    Event.REACHED: "reached the target, {off} ≤ {radius:g}",
    Event.HORIZON: "had not reached {off} ≤ {radius:g} by the horizon: {off} = {norm:.3g}",
    Event.CONSTRAINT: "broke {broken}",
    Event.SINGULAR: "met the singularity (37): the law does not exist further on",
    Event.DIVERGED: "diverged",
}

#: The same of a motion along a reference.
_ALONG = {
    Event.REACHED: "followed the reference to the end, where {off} ≤ {radius:g}",
    Event.HORIZON: "was off the reference at the end: {off} = {norm:.3g}, not ≤ {radius:g}",
}


def _surface_words(surface: Surface) -> str:
    return repr(surface).removeprefix("Surface(").removesuffix(")")


def _plan_words(plan: Plan) -> str:
    """The surface that a plan begins with, and how it is reached where the plan says that."""
    surface, law = plan.at(0.0)
    if law is None:
        return _surface_words(surface)
    eta, layer = law.per_surface(surface.m)
    rates = ", ".join(f"{rate:.3g}" for rate in eta / layer)
    return f"{_surface_words(surface)}; reached at η/ε = {rates} 1/s"


def _head(
    mechanism: Mechanism,
    objective: Objective,
    start: FloatArray,
    gate: Gate | None = None,
    reaching: ReachingLaw = ReachingLaw(),
) -> list[tuple[str, str]]:
    problem = problem_words(mechanism, objective, gate).removeprefix("objective ")
    rows = [
        ("mechanism", f"{mechanism.name}: {mechanism.description}".removesuffix(": ")),
        ("objective", problem),
        ("start", state_words(mechanism, start)),
    ]
    if reaching != ReachingLaw():
        rows.append(("reaching law", _thickness(reaching)))
    return rows


def _thickness(reaching: ReachingLaw) -> str:
    """Say how thick a boundary layer is, beside the usual one."""
    layer, usual = (float(np.max(law.layer)) for law in (reaching, ReachingLaw()))
    return (
        f"boundary layer {layer:g}, {layer / usual:g} times as thick as usual: the gains (13) that "
        "the disturbance bounds, such as dry friction, ask for"
    )


def ended(motion: Trajectory, objective: Objective, target: Target | None = None) -> str:
    """Say in words how a motion ended.

    With a ``target`` that is not x = 0 what counts is how far it is off that.
    """
    words, off, error, radius = _ENDINGS, "‖x‖", motion.x[-1], objective.terminal_radius
    if target is not None:
        legs = target.legs(motion.mechanism, max(motion.time, objective.horizon))
        leg = [leg for begin, leg in legs if begin <= motion.time][-1]
        words = _ENDINGS | _ALONG if leg.moves else _ENDINGS
        off, error = "‖x − x_r‖", error - leg.state(motion.time)
    elif motion.event == Event.REACHED and motion.time == motion.t[0]:
        return f"started at the target, ‖x‖ ≤ {radius:g}: there was nothing to do"
    norm = float(np.linalg.norm(error))
    said = words[motion.event].format(off=off, radius=radius, norm=norm, broken=motion.broken)
    return f"{said}, at {motion.time:.3f} s"


def motion_report(
    mechanism: Mechanism,
    objective: Objective,
    start: FloatArray,
    motion: Trajectory,
    surface: Surface,
    run: Run | None = None,
    cascade: Cascade | None = None,
    target: Target | None = None,
    words: str = "",
    reaching: ReachingLaw = ReachingLaw(),
) -> RenderableType:
    """Return a simulated motion for the terminal.

    ``surface`` is that of a motion without a ``run``, which is the record of ``cascade``;
    ``target`` where to, and in ``words``, where that is not x = 0; ``reaching`` how surfaces are
    reached.
    """
    rows = _head(mechanism, objective, start, None if cascade is None else cascade.gate, reaching)
    if target is not None:
        rows.append(("target", words))
    if run is None:
        rows.append(("surface", _surface_words(surface)))
    else:
        admitted = sum(update.admission.accepted for update in run.updates)
        rows += [
            ("first optimum", _plan_words(run.plans[0])),
            ("last surface", _plan_words(run.plans[-1])),
            ("optimisations", f"{len(run.updates)}, {admitted} admitted"),
        ]
        if any(verdict is not None for verdict in run.verdicts):
            rows.append(("evidence", evidence_counts(run)))
        if len(run.lemma3_slack):
            learns = bool(cascade and cascade.known)
            rows.append(_descent(run, objective, _risen(mechanism, run, target, learns=learns)))
    good = motion.event == Event.REACHED
    rows += [
        ("cost", f"{motion.cost:.6g} {objective.unit}" + ", without arriving" * (not good)),
        (
            "largest input",
            ", ".join(
                f"|{channel.name}| = {abs(motion.u[:, i]).max():.3g}"
                + f" of {channel.limit:g}" * math.isfinite(channel.limit)
                + f" {channel.unit}".rstrip()
                for i, channel in enumerate(mechanism.inputs)
            ),
        ),
    ]
    said = ended(motion, objective, target)
    end = Text(said) if good and motion.time == motion.t[0] else mark(good) + Text(f" {said}")
    return Group(facts(rows), end, *map(Text, _undisturbed(mechanism)))


def _undisturbed(mechanism: Mechanism) -> list[str]:
    """Say of disturbance bounds that are a good part of an input what the motion leaves out."""
    large = []
    for c, bound, row in zip(
        mechanism.coordinates, mechanism.disturbance_bounds, np.abs(mechanism.B), strict=False
    ):
        force = sum(b * most for b, most in zip(row, mechanism.input_limits, strict=True) if b)
        if bound >= NOTABLE * force:
            large.append(f"{c.name}, {bound / force:.0%}")
    if not large:
        return []
    return [
        "The plant was simulated without disturbances: dry friction, or what else the mechanism's "
        f"disturbance bounds are for, may take this part of the input's limit: {'; '.join(large)}."
    ]


def _risen(mechanism: Mechanism, run: Run, target: Target | None, *, learns: bool) -> str:
    """Say what may raise predictions; nothing where Lemma 3 is about the run.

    It is of one model, which moves as predicted, and of a target that rests.
    """
    plant = run.trajectory.mechanism
    end = max(run.time, 1.0)
    if learns:
        return "what was learnt"
    if plant.identity != mechanism.identity:
        return "the plant, which is not the model,"
    if target is not None and any(leg.moves for _, leg in target.legs(mechanism, end)):
        return "the moving target"
    return ""


def _descent(run: Run, objective: Objective, risen: str) -> tuple[str, str]:
    """Say by how much predictions fall at least, or rise, from one decision to the next.

    ``risen``: what may raise them, where it is not the case of Lemma 3.
    """
    slack = run.lemma3_slack
    known = slack[np.isfinite(slack)]
    unknown = len(slack) - len(known)
    name = "prediction" if risen else "Lemma 3"
    without = (
        f"; {unknown} of {len(slack)} decisions begin another task or lack a finite prediction"
        if unknown and run.updates[-1].task
        else f"; {unknown} of {len(slack)} decisions without a finite prediction"
        if unknown
        else ""
    )
    if not len(known):
        return name, f"no slack is known{without}"
    least = f"{known.min():.1e} {objective.unit}"
    if not risen:
        return name, f"smallest slack {least} (≥ 0 wanted, to rounding){without}"
    rise = f"{max(0.0, -known.min()):.1e} {objective.unit}"
    return name, f"{risen} raised it by {rise} at most, from one decision to the next{without}"


#: Kinds of evidence, in words.
_EVIDENCE = {
    "region": "in a proved set",
    "dual": "predicted into a proved set",
    "sampled": "sampled nearby",
    "local": "stable near the target",
}


def evidence_counts(run: Run, words: Mapping[str, str] = _EVIDENCE) -> str:
    """Count what is known of the plan in use at each decision."""
    kinds = [None if v is None else v.details.get("evidence") for v in run.verdicts]
    rows = (*words.items(), (None, "without accepted evidence"))
    return ", ".join(f"{kinds.count(kind)} {text}" for kind, text in rows if kinds.count(kind))


def _surfaces_of(plan: Plan, reaching: ReachingLaw) -> list[dict[str, object]]:
    """Return the surfaces of a plan, each with when it takes over, s, and how it is reached."""
    m = plan.surfaces[0].m
    rows = zip(plan.times, plan.vectors.tolist(), plan.gains(reaching).tolist(), strict=True)
    return [
        {"from": begin, "surface": surface, "eta": gains[:m], "layer": gains[m:]}
        for begin, surface, gains in rows
    ]


def _decision(update: Update, reaching: ReachingLaw) -> dict[str, object]:
    admission, verdict = update.admission, update.admission.verdict
    return {
        "t": update.t,
        "admitted": admission.accepted,
        "reason": admission.reason,
        "surface": update.surface.vector.tolist(),
        "plan": _surfaces_of(update.plan, reaching),
        "predicted_cost": finite(admission.cost),
        "verdict": None
        if verdict is None
        else {
            "kind": verdict.kind,
            "evidence": verdict.details.get("evidence"),
            "claim": verdict.claim,
            "margin": finite(verdict.margin),
            "unit": verdict.unit,
            "method": verdict.method,
        },
    }


def motion_files(
    request: Mapping[str, object],
    motion: Trajectory,
    cost: float,
    surfaces: Sequence[Surface],
    run: Run | None = None,
    reaching: ReachingLaw = ReachingLaw(),
) -> dict[str, bytes]:
    """Return a motion's files: ``motion.csv`` (SI units), ``motion.png``, ``manifest.json``.

    The manifest keeps the request, and of a cascade's ``run`` every decision with its verdict and
    the whole plan; ``reaching`` is how plans are reached that do not say it themselves.
    """
    *names, _ = motion.columns
    columns = (motion.t, *(values for values, _ in motion.columns.values()))
    content = [[f"{value:.9g}" for value in row] for row in zip(*columns, strict=True)]
    more: dict[str, object] = {
        "ended": motion.event.name.lower(),
        "time_s": motion.time,
        "cost": cost,
        "surfaces": [surface.vector.tolist() for surface in surfaces],
    }
    if run is not None:
        more["decisions"] = [_decision(update, reaching) for update in run.updates]
    return {
        "motion.csv": to_csv(["t", *names, "margin_37"], content),
        "motion.png": figure_bytes(motion_figure({"motion": motion})),
        "manifest.json": manifest("undertow simulate", request, **more),
    }


def _confidence_row(proposal: Proposal) -> list[tuple[str, str]]:
    if proposal.confidence is None:
        return []
    return [("confidence", f"{proposal.confidence:.0%} that no surface costs over 1 % less")]


def proposal_report(
    mechanism: Mechanism,
    objective: Objective,
    start: FloatArray,
    proposal: Proposal,
    reaching: ReachingLaw = ReachingLaw(),
) -> RenderableType:
    """Return one optimisation's answer for the terminal, with its margins."""
    assert proposal.surface is not None  # require() raises otherwise
    rows = [
        *_head(mechanism, objective, start, reaching=reaching),
        ("surface", _surface_words(proposal.surface)),
        ("predicted cost", f"{proposal.cost:.6g} {objective.unit}"),
        ("status", proposal.status),
        *_confidence_row(proposal),
        ("work", f"{proposal.evaluations} rollouts in {proposal.seconds:.2f} s"),
    ]
    bounds = objective.on(mechanism).constraints
    units = {constraint.name: constraint.unit for constraint in bounds}
    margins = []
    for margin in proposal.margins:
        unit = margin.unit or units.get(margin.name, "")
        factor, shown = 1.0, unit
        if unit in ("rad", "rad/s"):
            factor, shown = display("rad", unit == "rad/s")
        margins.append((margin.name, f"{factor * margin.value:.4g}", shown))
    heads = ("margin (≥ 0 is satisfied)", "value", "")
    return Group(facts(rows), "", table(heads, margins, left=("",)))


def proposal_files(request: Mapping[str, object], proposal: Proposal) -> dict[str, bytes]:
    """Return one optimisation's answer as ``proposal.json``."""
    surface = proposal.surface
    assert surface is not None  # require() raises otherwise
    blocks = ("alpha_a", "lambda_a", "alpha_u", "lambda_u")
    content = manifest(
        "undertow optimise",
        request,
        surface={name: getattr(surface, name).tolist() for name in blocks},
        cost=proposal.cost,
        status=proposal.status,
        margins=[
            {"name": m.name, "value": finite(m.value), "unit": m.unit} for m in proposal.margins
        ],
        confidence=proposal.confidence,
        evaluations=proposal.evaluations,
        seconds=round(proposal.seconds, 4),
    )
    return {"proposal.json": content}
