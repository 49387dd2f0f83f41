"""Tables 1 and 2 beside the paper's: for the terminal, as CSV, and the manifest."""

from __future__ import annotations

from functools import partial
from math import degrees
from typing import Any

from rich.columns import Columns
from rich.console import Group, RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from undertow.base import facts, number, table, to_csv, to_json, versions
from undertow.closed_loop.figures import figure_files
from undertow.studies.experiment import Experiment
from undertow.studies.paper import appendix_report
from undertow.studies.paper.data import CASES, CONDITIONS, OBJECTIVES, PERIOD, ROWS
from undertow.studies.paper.experiment import (
    FULL,
    Effort,
    LowerBound,
    OwnOptimum,
    Reproduction,
    Row,
    gathered,
    tasks,
)  # fmt: skip
from undertow.studies.paper.figures import figures
from undertow.studies.paper.findings import findings
from undertow.studies.paper.repeats import ANGLE_NOISE, COULOMB_FRICTION, RATE_NOISE, START_SPREAD

COLUMNS = ("condition", "objective", "row", "paper", "printed", "ours", "bound")

#: The two conditions that bear on the totals first, so that they stand side by side.
DISPLAY_ORDER = ("as-printed-40", "matched", "as-printed-45")

TITLES = {
    "energy": "Table 1. Minimum energy: ∫u² dt, V² s",
    "time": "Table 2. Minimum time: t_f, s",
}

CAPTION = (
    "paper: the printed total. printed: the printed surfaces in our simulation. "
    "ours: our base is the surface that the quadratic design gives, our one-time and cascade "
    "are our own optima. bound: the least cost of any control that keeps the pendulum above the "
    "horizontal, by collocation (no proof)."
)


def _values(row: Row) -> list[float | None]:
    return [value for value, _ in row.cells.values()]


def csv(result: Reproduction) -> bytes:
    """Return ``tables.csv``: one line a row, empty cells where a motion fails."""
    lines = (
        [*row.place.values(), *(number(value, ".6g", missing="") for value in _values(row))]
        for row in result.rows
    )
    return to_csv(COLUMNS, lines)


def reasons(result: Reproduction) -> list[dict[str, str]]:
    """Return why each empty cell of the tables is empty."""
    return [
        {**row.place, "column": column, "reason": reason}
        for row in result.rows
        for column, (_, reason) in row.cells.items()
        if reason
    ]


def manifest(result: Reproduction) -> dict[str, Any]:
    """Return what the run was made with, and its results besides the tables."""
    return {
        "what": "undertow reproduce",
        "versions": versions(),
        "seed": result.seed,
        "effort": {
            "first optimisation": f"{result.effort.cold.evaluations} rollouts",
            "re-optimisations": f"{result.effort.warm.evaluations} rollouts",
            "bounds": result.effort.bounds,
        },
        "period_s": PERIOD,
        "conditions": {
            key: {
                "d_e": CONDITIONS[key].d_e,
                "phi_0_degrees": round(degrees(CONDITIONS[key].phi), 6),
                "parameters": {
                    p.name: {"value": p.value, "unit": p.unit, "source": p.source}
                    for p in CONDITIONS[key].mechanism.parameters
                },
            }
            for key in result.effort.conditions
        },
        "objectives": {
            key: {
                "unit": goal.unit,
                "horizon_s": goal.horizon,
                "terminal_radius": goal.terminal_radius,
            }
            for key, goal in OBJECTIVES.items()
        },
        "surfaces": [
            {
                **row.place,
                "ours": [
                    {"from_s": round(t, 9), "vector": surface.vector.tolist()}
                    for t, surface in zip(row.ours.switch_times, row.ours.surfaces, strict=True)
                ],
            }
            for row in result.rows
        ],
        "descent": [
            {
                "condition": key,
                "objective": goal,
                "smallest_slack": min(own.slack),
                "reoptimisations": len(own.slack),
                "admitted": own.accepted - 1,
            }
            for (key, goal), own in result.own.items()
            if own.slack
        ],
        "limits_degrees": [
            {
                "case": limit.case,
                "singular": round(degrees(limit.singular), 3),
                "caught_below": {
                    f"d_e={d:g}": round(degrees(v), 3) for d, v in limit.caught.items()
                },
            }
            for limit in result.limits
        ],
        "own_reach_degrees": {f"d_e={d:g}": round(degrees(v), 2) for d, v in result.reach.items()},
        "figure_3_repeats": {
            "coulomb_friction_N_m": COULOMB_FRICTION,
            "angle_noise_rad": ANGLE_NOISE,
            "rate_noise_rad_s": RATE_NOISE,
            "start_spread_degrees": degrees(START_SPREAD),
            "note": "assumed values; simulated, not measured",
        },
        "reasons": reasons(result),
        "findings": [{"agrees": f.agrees, "text": f.text} for f in findings(result)],
    }


def _tables(result: Reproduction, objective: str) -> RenderableType:
    """Return the tables of all conditions side by side, as far as the terminal is wide."""
    shown, empty = [], []
    for condition in sorted(result.effort.conditions, key=DISPLAY_ORDER.index):
        rows = [result.row(condition, objective, name) for name in ROWS]
        if any(value is not None for row in rows for value in _values(row)[1:]):
            shown.append(Padding(_table(condition, rows), (0, 2, 1, 0)))
        else:
            empty.append(Text(f"{CONDITIONS[condition].title}: no figure at all, see below"))
    return Group(Columns(shown), *empty)


def _table(condition: str, rows: list[Row]) -> Table:
    where = CONDITIONS[condition]
    made = table(
        ("", "paper", "printed", "ours", "bound"),
        [
            (row.row, f"{row.paper:.1f}", *(number(v, ".2f") for v in _values(row)[1:]))
            for row in rows
        ],
        title=f"{where.title}, d_e = {where.d_e:g}",
        title_style="",
        padding=(0, 1, 0, 0),
        min_width=None,
    )
    for column in made.columns:
        column.min_width = 8 if column is made.columns[0] else 5
    return made


def _notes(result: Reproduction) -> RenderableType | None:
    """Return why cells are empty, by condition, each reason once."""
    told: dict[tuple[str, str], list[tuple[str, str, str]]] = {}
    for entry in reasons(result):
        place = (entry["column"], entry["objective"], entry["row"])
        told.setdefault((entry["condition"], entry["reason"]), []).append(place)
    lines = []
    order = (tuple(CONDITIONS), ("printed", "ours", "bound"))
    for (condition, reason), places in sorted(
        told.items(), key=lambda item: (order[0].index(item[0][0]), order[1].index(item[1][0][0]))
    ):
        column = places[0][0]
        goals = sorted({goal for _, goal, _ in places})
        rows = [row for row in ROWS if any(row == name for _, _, name in places)]
        words = [CONDITIONS[condition].title, column]
        words += [] if len(rows) == len(ROWS) else [" and ".join(rows)]
        words += [] if len(goals) == len(OBJECTIVES) else goals
        lines.append(f"{', '.join(words)}: {reason}")
    return _bullets(lines)


def _bullets(lines: list[str]) -> RenderableType | None:
    return facts((("–", line) for line in lines), gap=1) if lines else None


def _limits(result: Reproduction) -> Table:
    dampings = sorted(result.limits[0].caught, reverse=True)
    caught = [f"caught at\nd_e {d:g}" for d in dampings]
    heads = ("appendix case", "α_u", "λ_u", "λ_a", "singular\nat", *caught)
    rows = []
    for limit in result.limits:
        surface = CASES[limit.case]
        rows.append(
            (
                limit.case,
                *(f"{v[0, 0]:g}" for v in (surface.alpha_u, surface.lambda_u, surface.lambda_a)),
                f"{degrees(limit.singular):.1f}°",
                *(f"< {degrees(limit.caught[d]):.1f}°" for d in dampings),
            )
        )
    return table(heads, rows, whole=heads)


def _descent(result: Reproduction) -> Table:
    heads = ("our cascade", "smallest slack", "re-optimisations", "admitted")
    rows = [
        (
            f"{CONDITIONS[key].title}, {goal}",
            f"{min(own.slack):.1e} {OBJECTIVES[goal].unit}",
            f"{len(own.slack)}",
            f"{own.accepted - 1}",
        )
        for (key, goal), own in result.own.items()
        if own.slack
    ]
    return table(heads, rows, whole=heads)


def report(result: Reproduction) -> RenderableType:
    """Return the whole report for the terminal."""
    parts: list[RenderableType] = []
    for objective, title in TITLES.items():
        parts += [Text(title, style="bold"), _tables(result, objective), ""]
    parts.append(Text(CAPTION, style="dim"))
    told = findings(result)
    sections = {
        "Empty cells": _notes(result),
        "Reach of the printed surfaces, at rest from φ(0)": _limits(result),
        "Lemma 3: J̃ₖ − spent − J̃ₖ₊₁ ≥ 0, or t_f,k − Δt − t_f,k+1 ≥ 0": _descent(result),
        "What comes out": _bullets([f.text for f in told if f.agrees]),
        "What does not come out, and why": _bullets([f.text for f in told if not f.agrees]),
    }
    for title, content in sections.items():
        if content is not None:
            parts += ["", Text(title, style="bold"), content]
    return Group(*parts)


def files(result: Reproduction) -> dict[str, bytes]:
    """Return everything that a run leaves behind, by file name."""
    wanted = result.effort.appendix and not result.appendix
    return {
        "tables.csv": csv(result),
        "manifest.json": to_json(manifest(result)),
        **figure_files(figures(result), ("png", "pdf")),
        **(appendix_report.files() if wanted else {}),
    }


def reproduction(*, seed: int = 0, effort: Effort = FULL) -> Experiment[Any, Reproduction]:
    """Return the whole experiment.

    ``seed`` is that of the searches and of the noise; the effort is full by default,
    :meth:`Effort.quick` is for a look.
    """
    return Experiment(
        "reproduce",
        tuple[str, str, str, float | OwnOptimum | LowerBound | str],
        tasks(seed, effort),
        {"seed": seed, "effort": effort},
        lambda result: [report(result), ""],
        files,
        lambda result: [result.appendix] if result.appendix else [],
        gather=partial(gathered, seed, effort),
        whole=True,
    )
