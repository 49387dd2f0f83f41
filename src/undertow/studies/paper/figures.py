"""Figures 3 to 6 of the paper, from the motions of a run; drawing only."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import degrees
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from undertow.closed_loop import Trajectory
from undertow.closed_loop.figures import COLOURS, style
from undertow.display.plot import phase, surface_trace
from undertow.models import FloatArray
from undertow.studies.figures import REPEATS, ROW_LINES, beginning, draw_rows, rows_figure
from undertow.studies.paper.data import CONDITIONS, ROWS
from undertow.studies.paper.experiment import Reproduction
from undertow.studies.paper.repeats import Repeats

#: What Figure 5 shows of the motion, s: later on the surface hardly moves.
PHASE_TIME = 1.0


def figures(result: Reproduction) -> dict[str, Figure]:
    """Return Figures 3 to 6 by file name, without its ending."""
    drawn = {"figure-3-repeats": repeats_figure(result.repeats)}
    key = "matched"
    for number, goal, until in ((4, "energy", (3.0, 20.0)), (6, "time", (4.0, 4.0))):
        printed = {row: result.row(key, goal, row).printed.trajectory for row in ROWS}
        ours = {row: result.row(key, goal, row).ours.trajectory for row in ROWS}
        drawn[f"figure-{number}-{goal}"] = comparison(
            {
                "surfaces of the paper": {k: v for k, v in printed.items() if v is not None},
                "our optima": {k: v for k, v in ours.items() if v is not None},
            },
            until=until,
            title=f"Minimum {goal}, {_where(key)}",
        )
    drawn["figure-5-phase"] = phase_plane(result)
    return drawn


def _where(key: str) -> str:
    condition = CONDITIONS[key]
    return f"φ(0) = {degrees(condition.phi):g}°, d_e = {condition.d_e:g} N m s/rad"


def repeats_figure(repeats: Repeats) -> Figure:
    """Return Figure 3: the ideal motion and the simulated repeats, three rows over time."""
    motions: list[tuple[Trajectory, dict[str, Any]]] = [
        (repeat, {"color": colour, "linewidth": 0.7, "label": f"simulated repeat {number}"})
        for number, (repeat, colour) in enumerate(zip(repeats.repeats, REPEATS, strict=False), 1)
    ]
    look = {"color": "black", "linestyle": (0, (4, 2)), "label": "ideal model"}
    return rows_figure(
        [*motions, (repeats.ideal, look)],
        until=4.0,
        title=f"Table 2's one-time surface, {_where('matched')}\n"
        "repeats: 1 kHz sampling, noise, Coulomb friction, spread start (simulated)",
        columns=2,
    )


def comparison(
    columns: Mapping[str, Mapping[str, Trajectory]], *, until: tuple[float, float], title: str = ""
) -> Figure:
    """Return Figure 4 or 6: base, one-time and cascade; φ, θ and voltage.

    ``columns``: title of each column to its motions by row name. ``until``: right ends of the time
    axes, s: of φ and the voltage, and of θ, which is slower.
    """
    short, long = until
    with style():
        figure = Figure(figsize=(7.2, 5.6), layout="constrained")
        grid = np.asarray(figure.subplots(3, len(columns), sharey="row")).reshape(3, -1)
        for column, (name, motions) in enumerate(columns.items()):
            top, middle, bottom = grid[:, column]
            for row, motion in motions.items():
                draw_rows((top, middle, bottom), motion, **ROW_LINES[row], label=row)
            top.set_title(name, loc="left")
            for axes, end in ((top, short), (middle, long), (bottom, short)):
                axes.set_xlim(0, end)
                axes.locator_params(axis="x", nbins=5)
                axes.set_xlabel("time (s)")
                if column:
                    axes.set_ylabel("")
        grid[0, -1].legend(loc="upper right")
        figure.suptitle(title, x=0.01, ha="left", fontsize=10)
        figure.align_ylabels()
    return figure


def phase_plane(result: Reproduction) -> Figure:
    """Return Figure 5: the pendulum's phase plane and the surface, which jumps at switches."""
    columns = {
        "surfaces of the paper": result.row("matched", "energy", "cascade").printed,
        "our cascade": result.row("matched", "energy", "cascade").ours,
    }
    with style():
        figure = Figure(figsize=(7.2, 3.9), layout="constrained")
        grid = np.asarray(figure.subplots(1, len(columns), sharex=True, sharey=True)).ravel()
        for axes, (name, motion) in zip(grid, columns.items(), strict=True):
            axes.set_title(name, loc="left")
            if motion.trajectory is None:
                axes.text(0.5, 0.5, motion.reason, transform=axes.transAxes, ha="center")
                continue
            trajectory = beginning(
                motion.trajectory, int((motion.trajectory.t < PHASE_TIME - 1e-9).sum())
            )
            surface_trace(
                axes,
                trajectory,
                motion.surfaces,
                motion.switch_times,
                "phi",
                color=COLOURS["vermilion"],
                linewidth=1.2,
                label="sliding surface, s = 0",
            )
            phase(axes, trajectory, "phi", color=COLOURS["blue"], label="motion")
            switches = [t for t in motion.switch_times if 0 < t < PHASE_TIME]
            _mark_switches(axes, trajectory, switches)
        figure.legend(*grid[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
        grid[-1].set_ylabel("")
        figure.suptitle(
            f"Minimum-energy cascade, {_where('matched')}, first {PHASE_TIME:g} s",
            x=0.01,
            ha="left",
            fontsize=10,
        )
    return figure


def _mark_switches(axes: Axes, motion: Trajectory, times: Sequence[float]) -> None:
    """Mark on the motion where another surface takes over, with the time where there is room."""
    rows = np.searchsorted(motion.t, np.asarray(times) - 1e-9)
    points = np.degrees(np.column_stack([motion["phi"][rows], motion["phi_dot"][rows]]))
    axes.plot(
        *points.T, "o",
        color=COLOURS["blue"], markersize=4, markerfacecolor="white", label="surface replaced",
    )  # fmt: skip
    span = np.array([np.ptp(axes.get_xlim()), np.ptp(axes.get_ylim())])
    labelled: list[FloatArray] = [np.zeros(2)]
    for t, here in zip(times, points, strict=True):
        if min(float(np.linalg.norm((here - other) / span)) for other in labelled) > 0.1:
            labelled.append(here)
            axes.annotate(
                f"{t:.1f} s", here, xytext=(6, -11), textcoords="offset points", fontsize=8,
                bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 0.6},
            )  # fmt: skip
