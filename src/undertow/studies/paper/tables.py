"""Tables 1 and 2 beside the paper's: for the terminal, as CSV, and the manifest."""

from __future__ import annotations

from math import degrees
from typing import Any

from rich.columns import Columns
from rich.console import Group, RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from undertow.base import artefacts as results
from undertow.display.plot import figure_bytes
from undertow.optimiser import Budget
from undertow.studies.paper.data import CASES, CONDITIONS, OBJECTIVES, PERIOD, ROWS
from undertow.studies.paper.experiment import Reproduction, Row
from undertow.studies.paper.figures import figures
from undertow.studies.paper.findings import findings
from undertow.studies.paper.repeats import ANGLE_NOISE, COULOMB_FRICTION, RATE_NOISE, START_SPREAD

__all__ = ["COLUMNS", "csv", "files", "manifest", "report"]

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


def _values(row: Row) -> tuple[float, float | None, float | None, float | None]:
    return row.paper, row.printed.total, row.ours.total, row.bound.value


def csv(result: Reproduction) -> bytes:
    """Return ``tables.csv``: one line a row, empty cells where a motion fails."""
    return results.to_csv(
        COLUMNS,
        [
            [
                row.condition,
                row.objective,
                row.row,
                *("" if value is None else f"{value:.6g}" for value in _values(row)),
            ]
            for row in result.rows
        ],
    )


def reasons(result: Reproduction) -> list[dict[str, str]]:
    """Return why each empty cell of the tables is empty."""
    return [
        {
            "condition": row.condition,
            "objective": row.objective,
            "row": row.row,
            "column": column,
            "reason": reason,
        }
        for row in result.rows
        for column, reason in (
            ("printed", row.printed.reason),
            ("ours", row.ours.reason),
            ("bound", row.bound.reason),
        )
        if reason
    ]


def _budget(budget: Budget | None) -> str:
    return "the cascade's own" if budget is None else f"{budget.evaluations} rollouts"


def manifest(result: Reproduction) -> dict[str, Any]:
    """Return what the run was made with, and what the tables have no room for."""
    return {
        "what": "undertow reproduce",
        "versions": results.versions(),
        "seed": result.seed,
        "effort": {
            "first optimisation": _budget(result.effort.cold),
            "re-optimisations": _budget(result.effort.warm),
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
                "condition": row.condition,
                "objective": row.objective,
                "row": row.row,
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
        "seconds": result.seconds,
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
    table = Table(
        title=f"{where.title}, d_e = {where.d_e:g}",
        title_style="",
        title_justify="left",
        box=None,
        header_style="dim",
        padding=(0, 1, 0, 0),
        pad_edge=False,
    )
    table.add_column("", min_width=8)
    for name in ("paper", "printed", "ours", "bound"):
        table.add_column(name, justify="right", min_width=5)
    for row in rows:
        cells = [f"{row.paper:.1f}"] + [
            Text("—", style="dim") if value is None else f"{value:.2f}"
            for value in _values(row)[1:]
        ]
        table.add_row(row.row, *cells)
    return table


def _notes(result: Reproduction) -> RenderableType:
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


def _bullets(lines: list[str], mark: str = "–") -> RenderableType:
    grid = Table.grid(padding=(0, 1))
    grid.add_column()
    grid.add_column()
    for line in lines:
        grid.add_row(mark, line)
    return grid


def _limits(result: Reproduction) -> Table:
    table = Table(box=None, header_style="dim", padding=(0, 2, 0, 0), pad_edge=False)
    table.add_column("appendix case", no_wrap=True)
    for name in ("α_u", "λ_u", "λ_a", "singular\nat"):
        table.add_column(name, justify="right", no_wrap=True)
    dampings = sorted(result.limits[0].caught, reverse=True)
    for d in dampings:
        table.add_column(f"caught at\nd_e {d:g}", justify="right", no_wrap=True)
    for limit in result.limits:
        surface = CASES[limit.case]
        table.add_row(
            limit.case,
            *(f"{v[0, 0]:g}" for v in (surface.alpha_u, surface.lambda_u, surface.lambda_a)),
            f"{degrees(limit.singular):.1f}°",
            *(f"< {degrees(limit.caught[d]):.1f}°" for d in dampings),
        )
    return table


def _descent(result: Reproduction) -> Table:
    table = Table(box=None, header_style="dim", padding=(0, 2, 0, 0), pad_edge=False)
    table.add_column("our cascade", no_wrap=True)
    for name in ("smallest slack", "re-optimisations", "admitted"):
        table.add_column(name, justify="right", no_wrap=True)
    for (key, goal), own in result.own.items():
        if own.slack:
            table.add_row(
                f"{CONDITIONS[key].title}, {goal}",
                f"{min(own.slack):.1e} {OBJECTIVES[goal].unit}",
                f"{len(own.slack)}",
                f"{own.accepted - 1}",
            )
    return table


def report(result: Reproduction) -> RenderableType:
    """Return the whole report for the terminal."""
    parts: list[RenderableType] = []
    for objective, title in TITLES.items():
        parts += [
            Text(title, style="bold"),
            _tables(result, objective),
            "",
        ]
    parts.append(Text(CAPTION, style="dim"))
    if reasons(result):
        parts += ["", Text("Empty cells", style="bold"), _notes(result)]
    parts += ["", Text("Reach of the printed surfaces, at rest from φ(0)", style="bold")]
    parts += [
        _limits(result),
        "",
        Text("Lemma 3: J̃ₖ − spent − J̃ₖ₊₁ ≥ 0, or t_f,k − Δt − t_f,k+1 ≥ 0", style="bold"),
        _descent(result),
    ]
    told = findings(result)
    good = [f.text for f in told if f.agrees]
    bad = [f.text for f in told if not f.agrees]
    if good:
        parts += ["", Text("What comes out", style="bold"), _bullets(good)]
    if bad:
        parts += ["", Text("What does not come out, and why", style="bold"), _bullets(bad)]
    return Group(*parts)


def files(result: Reproduction) -> dict[str, bytes]:
    """Return everything that a run leaves behind, by file name."""
    made = {
        f"{name}.{kind}": figure_bytes(figure, kind)
        for name, figure in figures(result).items()
        for kind in ("png", "pdf")
    }
    return {"tables.csv": csv(result), "manifest.json": results.to_json(manifest(result)), **made}
