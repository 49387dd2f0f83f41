"""Trajectories to axes: pure drawing, no computation, no global state.

Every function draws on the axes it is given; the figure builders return a
:class:`matplotlib.figure.Figure` that belongs to the caller.  Angles are in degrees on
plots, and say so.  Colours are Okabe and Ito's, told apart with any colour vision; line
styles repeat the distinction for print.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import cycle
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from undertow.base import InvalidInputError
from undertow.closed_loop import Trajectory
from undertow.law import Surface
from undertow.models import FloatArray

__all__ = [
    "COLOURS",
    "display",
    "figure_bytes",
    "input_series",
    "motion_figure",
    "phase",
    "state_series",
    "style",
    "surface_trace",
]

#: Okabe and Ito (2008), without yellow, which is too faint for lines.
COLOURS = {
    "black": "#000000",
    "blue": "#0072B2",
    "orange": "#E69F00",
    "green": "#009E73",
    "vermilion": "#D55E00",
    "sky": "#56B4E9",
    "purple": "#CC79A7",
    "grey": "#808080",
}

_STYLE: Any = {
    "font.size": 9.0,
    "axes.titlesize": 9.0,
    "axes.labelsize": 9.0,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e4e4e4",
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.4,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "xtick.labelsize": 8.5,
    "ytick.labelsize": 8.5,
    "xtick.direction": "out",
    "ytick.direction": "out",
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "savefig.dpi": 160,
    "svg.hashsalt": "undertow",
}

_GREEK = {
    "alpha": "α", "beta": "β", "gamma": "γ", "theta": "θ", "phi": "φ", "psi": "ψ",
}  # fmt: skip

_LINES: tuple[dict[str, Any], ...] = (
    {"color": COLOURS["grey"], "linestyle": (0, (4, 2))},
    {"color": COLOURS["blue"], "linestyle": "-"},
    {"color": COLOURS["orange"], "linestyle": "-"},
    {"color": COLOURS["green"], "linestyle": (0, (6, 1.5, 1, 1.5))},
)


@contextmanager
def style() -> Iterator[None]:
    """Draw with the project's style inside a ``with`` block; the caller's stays as it was."""
    with mpl.rc_context(_STYLE):
        yield


def display(unit: str, rate: bool = False) -> tuple[float, str]:
    """Return the factor and the name of the unit in which a coordinate is shown.

    >>> display("rad", rate=True)[1]
    '°/s'
    """
    factor, name = (180 / np.pi, "°") if unit == "rad" else (1.0, unit)
    return factor, f"{name}/s" if rate else name


def _axis(trajectory: Trajectory, name: str) -> tuple[FloatArray, str]:
    """Return the values of a state in display units, and its label."""
    values = trajectory[name]
    coordinates = trajectory.mechanism.coordinates
    index = trajectory.mechanism.state_names.index(name) % len(coordinates)
    rate = name == str(coordinates[index].velocity)
    factor, unit = display(coordinates[index].unit, rate)
    stem = coordinates[index].name
    symbol = _GREEK.get(stem, stem)
    if rate:
        symbol = f"{symbol}\N{COMBINING DOT ABOVE}" if len(symbol) == 1 else f"d{symbol}/dt"
    return factor * values, f"{symbol} ({unit})"


def state_series(axes: Axes, trajectory: Trajectory, name: str, **line: Any) -> None:
    """Draw a state over time, in degrees where it is an angle, and label the axis.

    Parameters
    ----------
    axes
        Where to draw.
    trajectory
        The motion.
    name
        State name, e.g. ``"phi"`` or ``"phi_dot"``.
    **line
        Properties of the line.

    Raises
    ------
    InvalidInputError
        For an unknown state.
    """
    values, label = _axis(trajectory, name)
    axes.plot(trajectory.t, values, **line)
    axes.set_ylabel(label)


def input_series(axes: Axes, trajectory: Trajectory, index: int = 0, **line: Any) -> None:
    """Draw an input over time, as a staircase at the recorded times, and label the axis."""
    channel = trajectory.mechanism.inputs[index]
    axes.plot(trajectory.t, trajectory.u[:, index], drawstyle="steps-post", **line)
    axes.set_ylabel(f"{channel.name} ({channel.unit})")


def phase(axes: Axes, trajectory: Trajectory, name: str, **line: Any) -> None:
    """Draw the velocity of a coordinate over the coordinate and label both axes."""
    x, x_label = _axis(trajectory, name)
    y, y_label = _axis(trajectory, f"{name}_dot")
    axes.plot(x, y, **line)
    axes.set_xlabel(x_label)
    axes.set_ylabel(y_label)


def surface_trace(
    axes: Axes,
    trajectory: Trajectory,
    surfaces: Sequence[Surface],
    switch_times: Sequence[float],
    name: str,
    **line: Any,
) -> None:
    """Draw where the sliding surface lies along a motion, in the phase plane of ``name``.

    With all other states as they are, s = 0 asks for the velocity q̇_i − s/α_i.  The trace
    breaks where another surface takes over; a dotted line joins the two ends.

    Parameters
    ----------
    axes
        Where to draw.
    trajectory
        A motion with one input.
    surfaces
        The surfaces in use, one for each of ``switch_times``, (S,).
    switch_times
        When each takes over, s; the first is the start.
    name
        The coordinate.
    **line
        Properties of the trace.

    Raises
    ------
    InvalidInputError
        When there are several surfaces at once, m > 1: then s = 0 fixes no single velocity.
    """
    mechanism = trajectory.mechanism
    if mechanism.m != 1:
        raise InvalidInputError(
            f"surface trace of '{mechanism.name}'", value=f"m = {mechanism.m}", limit="m = 1"
        )
    x, _ = _axis(trajectory, name)
    y, _ = _axis(trajectory, f"{name}_dot")
    index = [c.name for c in mechanism.coordinates].index(name)
    factor, _ = display(mechanism.coordinates[index].unit)
    # The last moment before each switch still belongs to the old surface.
    used = np.searchsorted(np.asarray(switch_times), trajectory.t + 1e-9, side="right") - 1
    used[-1] = used[-2] if len(used) > 1 else used[-1]
    weights = np.array([surface.velocity_row[0, index] for surface in surfaces])
    trace = y - factor * trajectory.s[:, 0] / weights[used]
    label = line.pop("label", None)
    for number in range(len(surfaces)):
        part = np.flatnonzero(used == number)
        if part.size == 0:
            continue
        axes.plot(x[part], trace[part], label=label, **line)
        label = None
        following = part[-1] + 1
        if following < len(x):
            ends = [part[-1], following]
            axes.plot(x[ends], trace[ends], **(line | {"linestyle": ":", "linewidth": 1.0}))


def motion_figure(
    trajectories: Mapping[str, Trajectory], *, until: float | None = None, title: str = ""
) -> Figure:
    """Return a figure of motions: a row for each coordinate and each input, over time.

    Parameters
    ----------
    trajectories
        Labels to motions of one mechanism.
    until
        Right end of the time axis, s; the longest motion's by default.
    title
        Above the first row.

    Raises
    ------
    InvalidInputError
        When there is nothing to draw.

    Examples
    --------
    >>> import undertow as ut
    >>> rig = ut.mechanisms.rotary_pendulum(d_e=0.025)
    >>> surface = ut.Surface(-1, -1.59, 1.96, 12.1)
    >>> motion = ut.ClosedLoop(rig).simulate(rig.state(phi=0.5), surface)
    >>> len(motion_figure({"printed surface": motion}).axes)
    3
    """
    if not trajectories:
        raise InvalidInputError("motions to draw", value="none", limit="at least one")
    first = next(iter(trajectories.values()))
    mechanism = first.mechanism
    rows = mechanism.n + mechanism.m
    with style():
        figure = Figure(figsize=(6.4, 1.1 + 1.35 * rows), layout="constrained")
        panels = np.atleast_1d(figure.subplots(rows, 1, sharex=True))
        lines = cycle(_LINES if len(trajectories) > 1 else [{"color": COLOURS["blue"]}])
        for (label, trajectory), line in zip(trajectories.items(), lines, strict=False):
            look = {**line, "label": label}
            for panel, coordinate in zip(panels, mechanism.coordinates, strict=False):
                state_series(panel, trajectory, coordinate.name, **look)
            for index in range(mechanism.m):
                input_series(panels[mechanism.n + index], trajectory, index, **look)
        panels[-1].set_xlabel("time (s)")
        panels[-1].set_xlim(0, until or max(t.duration for t in trajectories.values()))
        if title:
            panels[0].set_title(title, loc="left")
        if len(trajectories) > 1:
            handles = panels[0].get_legend_handles_labels()
            figure.legend(*handles, loc="outside upper right", ncols=min(len(trajectories), 4))
        figure.align_ylabels()
    return figure


def figure_bytes(figure: Figure, kind: str = "png") -> bytes:
    """Return a figure as a file's contents; ``kind`` is ``png``, ``pdf`` or ``svg``.

    The same figure gives the same bytes: no date is written.
    """
    metadata: dict[str, Any] = {"png": {"Software": None}, "pdf": {"CreationDate": None}}.get(
        kind, {"Date": None}
    )
    file = io.BytesIO()
    with style():
        figure.savefig(file, format=kind, metadata=metadata)
    return file.getvalue()
