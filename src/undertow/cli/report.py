"""What `undertow simulate` and `undertow optimise` show and leave behind."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import isfinite
from typing import Any

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from undertow.base import artefacts as results
from undertow.cascade import Gate, Run, Update, problem_words
from undertow.closed_loop import Event, Trajectory
from undertow.display.plot import display, figure_bytes, motion_figure
from undertow.law import Margin, Surface
from undertow.models import FloatArray, Mechanism
from undertow.objective import Objective
from undertow.optimiser import Proposal

__all__ = [
    "ended",
    "motion_files",
    "motion_report",
    "proposal_files",
    "proposal_report",
]

_ENDINGS = {
    Event.REACHED: "reached the target, ‖x‖ ≤ {radius:g}",
    Event.HORIZON: "had not reached ‖x‖ ≤ {radius:g} by the horizon: ‖x‖ = {norm:.3g}",
    Event.CONSTRAINT: "broke {broken}",
    Event.SINGULAR: "met the singularity (37): the law does not exist further on",
    Event.DIVERGED: "diverged",
}


def _facts(rows: Sequence[tuple[str, str]]) -> Table:
    grid = Table.grid(padding=(0, 2))
    grid.add_column(style="dim")
    grid.add_column()
    for name, value in rows:
        grid.add_row(name, Text(value))
    return grid


def _state_words(mechanism: Mechanism, x: FloatArray) -> str:
    """Return the non-zero entries of a state, angles in degrees."""
    words = []
    for index, (name, value) in enumerate(zip(mechanism.state_names, x, strict=True)):
        coordinate = mechanism.coordinates[index % mechanism.n]
        factor, unit = display(coordinate.unit, index >= mechanism.n)
        if value != 0:
            words.append(
                f"{name} = {factor * value:.4g}{'' if unit.startswith('°') else ' '}{unit}"
            )
    return ", ".join(words) or "at the target"


def _surface_words(surface: Surface) -> str:
    return repr(surface).removeprefix("Surface(").removesuffix(")")


def _head(
    mechanism: Mechanism, objective: Objective, start: FloatArray, gate: Gate | None = None
) -> list[tuple[str, str]]:
    problem = problem_words(mechanism, objective, gate).removeprefix("objective ")
    return [
        ("mechanism", f"{mechanism.name}: {mechanism.description}".removesuffix(": ")),
        ("objective", problem),
        ("start", _state_words(mechanism, start)),
    ]


def ended(motion: Trajectory, objective: Objective) -> str:
    """Say in words how a motion ended."""
    if motion.event == Event.REACHED and motion.duration == motion.t[0]:
        return (
            f"started at the target, ‖x‖ ≤ {objective.terminal_radius:g}: there was nothing to do"
        )
    broken = _broken(motion, objective) if motion.event == Event.CONSTRAINT else ""
    words = _ENDINGS[motion.event].format(
        radius=objective.terminal_radius, norm=float(np.linalg.norm(motion.x[-1])), broken=broken
    )
    return f"{words}, at {motion.duration:.3f} s"


def _broken(motion: Trajectory, objective: Objective) -> str:
    """Return the constraints that the last state of a motion breaks, whatever the input is."""
    mechanism = motion.mechanism
    at_end = mechanism.substitution | dict(zip(mechanism.x, motion.x[-1].tolist(), strict=True))
    objective = objective.on(mechanism)
    margins = [margin.subs(at_end) for margin in objective.path_margins(mechanism)]
    names = [
        constraint.words
        for constraint, margin in zip(objective.constraints, margins, strict=True)
        if margin.is_number and margin < 0
    ]
    hard = "the hard input limit" if objective.hard_input else "a constraint on the input"
    return " and ".join(names) or hard


def motion_report(
    mechanism: Mechanism,
    objective: Objective,
    start: FloatArray,
    motion: Trajectory,
    surface: Surface,
    run: Run | None = None,
    gate: Gate | None = None,
) -> RenderableType:
    """Return a simulated motion for the terminal.

    Parameters
    ----------
    mechanism, objective, start
        What was asked for.
    motion
        What the plant did.
    surface
        The (first) surface.
    run
        The cascade's record, where a cascade was run.
    gate
        Who admitted its surfaces.
    """
    rows = _head(mechanism, objective, start, gate)
    if run is None:
        rows.append(("surface", _surface_words(surface)))
    else:
        admitted = sum(update.admission.accepted for update in run.updates)
        rows += [
            ("first optimum", _surface_words(surface)),
            ("last surface", _surface_words(run.surfaces[-1])),
            ("optimisations", f"{len(run.updates)}, {admitted} admitted"),
        ]
        if any(verdict is not None for verdict in run.verdicts):
            rows.append(("evidence", _evidence(run)))
        if len(run.lemma3_slack):
            rows.append(("Lemma 3", _slack_words(run, objective)))
    rows += [
        ("cost", f"{motion.total:.6g} {objective.unit}"),
        (
            "largest input",
            ", ".join(
                f"|{channel.name}| = {abs(motion.u[:, i]).max():.3g} of {channel.limit:g} "
                f"{channel.unit}"
                for i, channel in enumerate(mechanism.inputs)
            ),
        ),
    ]
    good = motion.event == Event.REACHED
    if good and motion.duration == motion.t[0]:
        return Group(_facts(rows), Text(ended(motion, objective)))
    mark = Text("✓ " if good else "✗ ", style="green" if good else "red")
    return Group(_facts(rows), mark + Text(ended(motion, objective)))


def _slack_words(run: Run, objective: Objective) -> str:
    """Say the smallest slack of Lemma 3, and of how many decisions none is known."""
    slack = run.lemma3_slack
    known = slack[np.isfinite(slack)]
    unknown = len(slack) - len(known)
    without = (
        f"; {unknown} of {len(slack)} decisions without a finite prediction" if unknown else ""
    )
    if not len(known):
        return f"no slack is known{without}"
    return f"smallest slack {known.min():.1e} {objective.unit} (≥ 0 wanted, to rounding){without}"


def _evidence(run: Run) -> str:
    """Count what is known of the plan in use at each decision."""
    kinds = [None if v is None else v.details.get("evidence") for v in run.verdicts]
    words = {
        "region": "in a proved set",
        "dual": "predicted into a proved set",
        "sampled": "sampled nearby",
        "local": "stable near the target",
        None: "without accepted evidence",
    }
    counts = [f"{kinds.count(kind)} {text}" for kind, text in words.items() if kinds.count(kind)]
    return ", ".join(counts)


def _decision(update: Update) -> dict[str, object]:
    admission, verdict = update.admission, update.admission.verdict
    return {
        "t": update.t,
        "admitted": admission.accepted,
        "reason": admission.reason,
        "surface": update.surface.vector.tolist(),
        "predicted_cost": admission.cost if isfinite(admission.cost) else None,
        "verdict": None
        if verdict is None
        else {
            "kind": verdict.kind,
            "evidence": verdict.details.get("evidence"),
            "claim": verdict.claim,
            "margin": verdict.margin if isfinite(verdict.margin) else None,
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
) -> dict[str, bytes]:
    """Return a motion's files: ``motion.csv`` (SI units), ``motion.png``, ``manifest.json``.

    Parameters
    ----------
    request
        What was asked for, to be kept in the manifest.
    motion
        The motion.
    cost
        Its total.
    surfaces
        The surfaces in use, in order.
    run
        The cascade's record: every decision with its verdict goes into the manifest.
    """
    mechanism = motion.mechanism
    header = [
        "t",
        *mechanism.state_names,
        *(channel.name for channel in mechanism.inputs),
        *(f"s_{i}" for i in range(mechanism.m)),
        "cost",
        "margin_37",
    ]
    columns = (motion.t, *motion.x.T, *motion.u.T, *motion.s.T, motion.cost, motion.margin)
    table = results.to_csv(
        header, ([f"{value:.9g}" for value in row] for row in zip(*columns, strict=True))
    )
    facts = {
        **_manifest("undertow simulate", request),
        "ended": motion.event.name.lower(),
        "time_s": motion.duration,
        "cost": cost,
        "surfaces": [surface.vector.tolist() for surface in surfaces],
    }
    if run is not None:
        facts["decisions"] = [_decision(update) for update in run.updates]
    return {
        "motion.csv": table,
        "motion.png": figure_bytes(motion_figure({"motion": motion})),
        "manifest.json": results.to_json(facts),
    }


def proposal_report(
    mechanism: Mechanism, objective: Objective, start: FloatArray, proposal: Proposal
) -> RenderableType:
    """Return one optimisation's answer for the terminal, with its margins."""
    assert proposal.surface is not None  # require() raises otherwise
    rows = [
        *_head(mechanism, objective, start),
        ("surface", _surface_words(proposal.surface)),
        ("predicted cost", f"{proposal.cost:.6g} {objective.unit}"),
        ("status", proposal.status),
        ("work", f"{proposal.evaluations} rollouts in {proposal.seconds:.2f} s"),
    ]
    table = Table(box=None, header_style="dim", padding=(0, 2, 0, 0))
    table.add_column("margin (≥ 0 is satisfied)")
    table.add_column("value", justify="right")
    table.add_column("")
    bounds = objective.on(mechanism).constraints
    units = {constraint.name: constraint.unit for constraint in bounds}
    for margin in proposal.margins:
        unit = margin.unit or units.get(margin.name, "")
        factor, shown = 1.0, unit
        if unit in ("rad", "rad/s"):
            factor, shown = display("rad", unit == "rad/s")
        table.add_row(Text(margin.name), f"{factor * margin.value:.4g}", shown)
    return Group(_facts(rows), "", table)


def proposal_files(request: Mapping[str, object], proposal: Proposal) -> dict[str, bytes]:
    """Return one optimisation's answer as ``proposal.json``."""
    surface = proposal.surface
    assert surface is not None  # require() raises otherwise
    return {
        "proposal.json": results.to_json(
            {
                **_manifest("undertow optimise", request),
                "surface": {
                    "alpha_a": surface.alpha_a.tolist(),
                    "lambda_a": surface.lambda_a.tolist(),
                    "alpha_u": surface.alpha_u.tolist(),
                    "lambda_u": surface.lambda_u.tolist(),
                },
                "cost": proposal.cost,
                "status": proposal.status,
                "margins": [_margin(margin) for margin in proposal.margins],
                "evaluations": proposal.evaluations,
                "seconds": round(proposal.seconds, 4),
            }
        )
    }


def _margin(margin: Margin) -> dict[str, Any]:
    value = margin.value if isfinite(margin.value) else None
    return {"name": margin.name, "value": value, "unit": margin.unit}


def _manifest(what: str, request: Mapping[str, object]) -> dict[str, object]:
    return {"what": what, "versions": results.versions(), "request": dict(request)}
