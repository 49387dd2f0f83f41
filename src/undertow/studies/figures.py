"""What the figures of the paper's experiment and of the trials share: φ, θ and voltage in rows."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from undertow.closed_loop import Trajectory
from undertow.closed_loop.figures import COLOURS, input_series, state_series, style

#: How the motions of the paper's tables are drawn, by row.
ROW_LINES: Mapping[str, dict[str, Any]] = {
    "base": {"color": COLOURS["grey"], "linestyle": (0, (4, 1.5))},
    "one-time": {"color": COLOURS["orange"], "linestyle": "-"},
    "cascade": {"color": COLOURS["blue"], "linestyle": "-"},
}

#: Colours of the repeats in Figure 3.
REPEATS = (COLOURS["orange"], COLOURS["green"], COLOURS["vermilion"])


def draw_rows(axes: Sequence[Axes], motion: Trajectory, **line: Any) -> None:
    """Draw φ, θ and voltage of a motion of the rotary pendulum, each on axes of its own."""
    top, middle, bottom = axes
    state_series(top, motion, "phi", **line)
    state_series(middle, motion, "theta", **line)
    input_series(bottom, motion, **line)


def rows_figure(
    motions: Iterable[tuple[Trajectory, dict[str, Any]]], *, until: float, title: str, columns: int
) -> Figure:
    """Return a figure of motions of the rotary pendulum: φ, θ and voltage over time.

    Each motion comes with the properties of its lines, the label among them; the time axis ends at
    ``until``, s; the legend has so many columns.
    """
    with style():
        figure = Figure(figsize=(6.4, 5.2), layout="constrained")
        axes = figure.subplots(3, 1, sharex=True)
        for motion, line in motions:
            draw_rows(axes, motion, **line)
        axes[2].set_xlabel("time (s)")
        axes[2].set_xlim(0, until)
        axes[0].set_title(title, loc="left")
        axes[0].legend(loc="upper right", ncols=columns)
        figure.align_ylabels()
    return figure


def beginning(motion: Trajectory, count: int) -> Trajectory:
    """Return the first so many records of a motion."""
    columns = ("t", "x", "u", "s", "accumulated_cost", "margin")
    return replace(motion, **{name: getattr(motion, name)[:count] for name in columns})
