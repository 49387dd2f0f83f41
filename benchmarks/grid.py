"""How far the cascades stay from the bound where nobody tuned anything, as heat maps.

Two sheets.  *rotary*: the rotary pendulum from seven angles with five dampings.  *own*: the five
mechanisms of examples/mechanisms.py from 0.6, 1 and 1.4 times their starts.  In each cell, for
least energy and for least time: the cascade with three plain parameters and the one that may
choose the reaching laws, too, for least time in a schedule of surfaces, both with the exact model,
over the optimal-control bound of undertow.bounds from several guesses, the cascades' own motions
among them.  The bound keeps every pendulum above the horizontal, as each stable surface must (37).

A cell is kept in the ledger as soon as it is finished: the same command goes on where it was
interrupted.  A ledger is of one seed and one version of the package: remove it after a change.
"""

from __future__ import annotations

from harness import command_line, need, table  # isort: skip

import math
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure

import undertow as ut
from undertow.base import number, write_files
from undertow.closed_loop.figures import COLOURS, figure_files, state_words, style
from undertow.mechanisms.named import named
from undertow.models import FloatArray
from undertow.objective import objective_for
from undertow.studies.ledger import Ledger
from undertow.studies.survey import survey_one

EXAMPLES = Path(__file__).parents[1] / "examples" / "mechanisms.py"

DAMPINGS = (0.0, 0.01, 0.025, 0.04, 0.073)  # N m s/rad
ANGLES = (30.0, 33.0, 36.0, 38.0, 39.5, 41.0, 43.3)  # degrees

#: Own mechanisms, and the angles that no stable surface lets pass the horizontal.
OWN = {
    "furuta": ("phi",),
    "qube": ("phi",),
    "long_short_pendubot": (),
    "ball_on_a_wheel": ("lean",),
    "pendulum_on_an_inclined_rail": ("lean",),
}
SCALES = (0.6, 1.0, 1.4)

#: Largest gap wanted.
WANTED = {"energy": 0.01, "time": 0.05}
KINDS = {"cascade": "three parameters", "free": "reaching laws free"}

#: Gaps over what is wanted: blue below, orange above, a factor of ten to either end.
SHADES = LinearSegmentedColormap.from_list(
    "gaps", [COLOURS["blue"], COLOURS["sky"], "#ffffff", COLOURS["orange"], COLOURS["vermilion"]]
)


class Task(NamedTuple):
    """A mechanism from a state, and the angles that stay above the horizontal."""

    mechanism: ut.Mechanism
    x0: FloatArray
    upright: tuple[str, ...]


class Sheet(NamedTuple):
    """Tasks in rows and columns, with their labels; ``across`` says what the columns are."""

    title: str
    across: str
    rows: tuple[str, ...]
    columns: tuple[str, ...]
    task: Callable[[int, int], Task]


@dataclass(frozen=True)
class Found:
    """Costs of a cell; ``inf`` where a cascade does not arrive, NaN where no bound was found."""

    cascade: float
    free: float
    bound: float
    seconds: float

    def gap(self, kind: str) -> float:
        """What a kind of cascade spends beyond the bound, relative; NaN where nothing arrives."""
        cost: float = getattr(self, kind)
        return cost / self.bound - 1.0


#: Row, column and goal.
Place = tuple[str, int, int, str]
Cells = Mapping[tuple[int, int, str], Found]


def rotary_sheet() -> Sheet:
    """Return angles and dampings of the rotary pendulum."""

    def task(row: int, column: int) -> Task:
        rig = ut.mechanisms.rotary_pendulum(d_e=DAMPINGS[row])
        return Task(rig, rig.state(phi=ut.deg(ANGLES[column])), ("phi",))

    rows = tuple(f"d_e = {value:g}" for value in DAMPINGS)
    columns = tuple(f"{value:g}°" for value in ANGLES)
    return Sheet("rotary pendulum", "φ(0)", rows, columns, task)


def own_sheet() -> Sheet:
    """Return the mechanisms of the examples from multiples of their starts."""
    mechanisms = [named(f"{EXAMPLES}:{name}") for name in OWN]

    def task(row: int, column: int) -> Task:
        mechanism = mechanisms[row]
        return Task(mechanism, SCALES[column] * mechanism.usual_start, OWN[mechanism.name])

    rows = tuple(f"{m.name.replace('_', ' ')}\n{state_words(m, m.usual_start)}" for m in mechanisms)
    columns = tuple(f"{scale:g} ×" for scale in SCALES)
    return Sheet("mechanisms of the examples", "the start on the left, times", rows, columns, task)


SHEETS: dict[str, Callable[[], Sheet]] = {"rotary": rotary_sheet, "own": own_sheet}


def ledger(path: Path | None, seed: int) -> Ledger[Found]:
    """Return what is known already."""
    return Ledger(path, tuple[str, int, int, str, Found], {"grid": True, "seed": seed})


def fill(
    name: str,
    sheet: Sheet,
    kept: Ledger[Found],
    places: Iterable[tuple[int, int]],
    seed: int,
) -> dict[tuple[int, int, str], Found]:
    """Return the cells of a sheet, row by row; those that are not known are run now."""
    cells = {}
    for row, column in places:
        for goal in WANTED:
            place = (name, row, column, goal)
            if place not in kept.known:
                mechanism, x0, upright = sheet.task(row, column)
                e = survey_one(
                    mechanism,
                    objective_for(mechanism, goal),
                    x0,
                    goal=goal,
                    seed=seed,
                    within=ut.state_box(**dict.fromkeys(upright, math.pi / 2)),
                )
                found = Found(e.cascade, e.free, e.bound, e.seconds)
                kept.keep(place, found)
                gaps = ", ".join(f"{KINDS[kind]} {percent(found.gap(kind))}" for kind in KINDS)
                print(f"{mechanism.name} {sheet.rows[row].splitlines()[0]}, "
                      f"{sheet.columns[column]}, {goal}: bound {found.bound:.5g}, {gaps} "
                      f"({found.seconds:.0f} s)", file=sys.stderr, flush=True)  # fmt: skip
            cells[row, column, goal] = kept.known[place]
    return cells


def percent(gap: float, fails: str = "fails", nothing: str = "—") -> str:
    """Return a gap for people, and what stands where none arrives or no motion was found."""
    return fails if gap == math.inf else number(100 * gap, ".1f", nothing).replace("-0.0", "0.0")


def tables(sheet: Sheet, cells: Cells) -> None:
    """Print the gaps and the bounds of a sheet, a table for each goal."""
    width = max(len(line) for row in sheet.rows for line in row.splitlines())
    for goal in WANTED:
        rows = []
        for row, label in enumerate(sheet.rows):
            name, _, start = label.partition("\n")
            found = [cells.get((row, c, goal)) for c in range(len(sheet.columns))]
            for first, kind in zip((name, start), KINDS, strict=True):
                gaps = ["" if f is None else percent(f.gap(kind)) for f in found]
                rows.append([f"{first:{width}}  {KINDS[kind]}", *gaps])
            bounds = ["" if f is None else number(f.bound, ".4g") for f in found]
            rows.append([f"{'':{width}}  bound", *bounds])
        table(f"{sheet.title}, {goal}: % above the bound", ["", *sheet.columns], rows)


def verdicts(sheet: Sheet, cells: Cells) -> list[str]:
    """Return a sentence for each goal and kind: in how many cells the gap is as wanted."""
    lines = []
    for goal, limit in WANTED.items():
        some = [f for (_, _, g), f in cells.items() if g == goal and not math.isnan(f.bound)]
        for kind, words in KINDS.items():
            gaps = [f.gap(kind) for f in some]
            if gaps:
                met = sum(gap <= limit for gap in gaps)
                lines.append(
                    f"{sheet.title}, {goal}, {words}: {met} of {len(gaps)} cells within "
                    f"{100 * limit:g} %, median {percent(float(np.median(gaps)))} %, worst "
                    f"{percent(max(gaps))} (wanted: all)"
                )
    return lines


def heat_map(sheet: Sheet, cells: Cells) -> Figure:
    """Draw the gaps: energy and time side by side, a row of panels for each kind of cascade."""
    height, width = len(sheet.rows), len(sheet.columns)
    with style():
        side = 0.9 + 0.055 * max(len(line) for row in sheet.rows for line in row.splitlines())
        size = (side + 2 * max(0.55 * width, 2.3), 0.9 + 2 * (0.36 * height + 0.35))
        figure = Figure(figsize=size, layout="constrained")
        panels = figure.subplots(len(KINDS), len(WANTED), sharex=True, sharey=True, squeeze=False)
        for line, (kind, words) in zip(panels, KINDS.items(), strict=True):
            for axes, (goal, limit) in zip(line, WANTED.items(), strict=True):
                for (row, column, g), found in cells.items():
                    if g == goal:
                        _cell(axes, row, column, found.gap(kind), limit)
                axes.set_title(f"{goal}, {words}", loc="left")
                axes.set_xlim(-0.5, width - 0.5)
                axes.set_ylim(height - 0.5, -0.5)
                axes.set_xticks(range(width), sheet.columns)
                axes.set_yticks(range(height), sheet.rows)
                axes.tick_params(length=0)
                axes.grid(visible=False)
                axes.spines[:].set_visible(False)
        for axes in panels[-1]:
            axes.set_xlabel(sheet.across)
        figure.suptitle(f"{sheet.title}: % above the bound", fontsize=10)
        wanted = " and ".join(f"{100 * limit:g} % of {goal}" for goal, limit in WANTED.items())
        figure.supxlabel(
            f"White: the wanted {wanted}. Blue: less, orange and bold: more, to ten times.\n"
            "×: does not arrive. Hatched: no motion was found.",
            fontsize=8,
        )
    return figure


def _cell(axes: Axes, row: int, column: int, gap: float, limit: float) -> None:
    """Draw one cell: its colour says how the gap compares with what is wanted."""
    box: dict[str, Any] = {"edgecolor": "white", "linewidth": 1.5}
    text, ink = percent(gap, "×", ""), "black"
    if math.isnan(gap):
        box |= {"facecolor": "white", "edgecolor": COLOURS["grey"], "hatch": "////", "linewidth": 0}
    else:
        part = math.log10(max(gap / limit, 0.1)) if gap < math.inf else 1.0
        box["facecolor"] = SHADES(0.5 + 0.5 * min(part, 1.0))
        ink = "white" if abs(part) > 0.75 else "black"
    axes.bar(column, 1, width=1, bottom=row - 0.5, **box)
    weight = "bold" if gap > limit else "normal"
    axes.text(column, row, text, ha="center", va="center", color=ink, fontweight=weight)


def main() -> int:
    """Run what is not known, print tables and sentences, draw the heat maps."""
    parser = command_line(__doc__, "--only own --out docs --ledger grid.jsonl", clocks=False)
    parser.add_argument("--only", choices=list(SHEETS), help="this sheet only")
    parser.add_argument("--seed", type=int, default=0, help="seed of the searches (0)")
    parser.add_argument("--ledger", type=Path, help="file of finished cells, continued")
    parser.add_argument("--out", type=Path, help="folder for grid-rotary.png and grid-own.png")
    options = parser.parse_args()
    need("casadi", "compare")
    kept = ledger(options.ledger, options.seed)
    findings, figures = [], {}
    for name in [options.only] if options.only else SHEETS:
        sheet = SHEETS[name]()
        rows, columns = len(sheet.rows), len(sheet.columns)
        places = [(r, c) for r in range(rows) for c in range(columns)]
        cells = fill(name, sheet, kept, places[:1] if options.quick else places, options.seed)
        tables(sheet, cells)
        findings += verdicts(sheet, cells)
        figures[f"grid-{name}"] = heat_map(sheet, cells)
    print("", *findings, sep="\n")
    if options.out is not None:
        write_files(options.out, figure_files(figures))
    return 0


if __name__ == "__main__":
    sys.exit(main())
