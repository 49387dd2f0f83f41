"""Motions drawn: a row for each coordinate and each input, over time.

Every function draws on the axes that it is given; the figure belongs to the caller and is
registered nowhere.  Angles are in degrees on plots, and say so.  Colours are Okabe and Ito's, told
apart with any colour vision; line styles repeat the distinction for print.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import cycle
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from undertow.base import require
from undertow.closed_loop.trajectory import Trajectory
from undertow.models import Coordinate, FloatArray, Mechanism
from undertow.symbolic.formulas import plain_symbol

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

#: Matplotlib's properties, as data.
_STYLE: Any = mpl.rc_params_from_file(
    Path(__file__).with_name("undertow.mplstyle"), use_default_template=False
)

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


def symbol_of(name: str, rate: bool = False) -> str:
    """Return a coordinate, or its rate, as it is written on plots.

    >>> symbol_of("phi_2"), symbol_of("rod_1", rate=True)
    ('φ₂', 'drod₁/dt')
    """
    symbol, dotted = plain_symbol(name), plain_symbol(f"{name}_dot")
    if not rate:
        return symbol
    return f"d{symbol}/dt" if dotted.endswith("_dot") else dotted


def label_of(coordinate: Coordinate, rate: bool = False) -> tuple[float, str]:
    """Return the factor to display units, and the label of an axis for a coordinate or its rate."""
    factor, unit = display(coordinate.unit, rate)
    return factor, f"{symbol_of(coordinate.name, rate)} ({unit})"


def axis(trajectory: Trajectory, name: str) -> tuple[FloatArray, str]:
    """Return the values of a state in display units, and its label."""
    values = trajectory[name]
    coordinates = trajectory.mechanism.coordinates
    index = trajectory.mechanism.state_names.index(name) % len(coordinates)
    rate = name == str(coordinates[index].velocity)
    factor, label = label_of(coordinates[index], rate)
    return factor * values, label


def state_series(axes: Axes, trajectory: Trajectory, name: str, **line: Any) -> None:
    """Draw a state over time, in degrees where it is an angle, and label the axis.

    ``axes``: where to draw. ``trajectory``: the motion. ``name``: state name, e.g. ``"phi"`` or
    ``"phi_dot"``. ``**line``: properties of the line. Raises InvalidInputError for an unknown
    state.
    """
    values, label = axis(trajectory, name)
    axes.plot(trajectory.t, values, **line)
    axes.set_ylabel(label)


def input_series(axes: Axes, trajectory: Trajectory, index: int = 0, **line: Any) -> None:
    """Draw an input over time, as a staircase at the recorded times, and label the axis."""
    channel = trajectory.mechanism.inputs[index]
    axes.plot(trajectory.t, trajectory.u[:, index], drawstyle="steps-post", **line)
    axes.set_ylabel(f"{channel.name} ({channel.unit})")


class MotionFigure(Figure):
    """A figure that a notebook shows as it is, without pyplot."""

    def _repr_png_(self) -> bytes:
        return figure_bytes(self)


def motion_figure(
    trajectories: Mapping[str, Trajectory], *, until: float | None = None, title: str = ""
) -> MotionFigure:
    """Return a figure of motions: a row for each coordinate and each input, over time.

    ``trajectories``: labels to motions of one mechanism. ``until``: right end of the time axis, s;
    the longest motion's by default. ``title``: above the first row. Raises InvalidInputError when
    there is nothing to draw.

    Examples
    --------
    >>> import undertow as ut
    >>> rig = ut.mechanisms.rotary_pendulum(d_e=0.025)
    >>> surface = ut.Surface(-1, -1.59, 1.96, 12.1)
    >>> motion = ut.ClosedLoop(rig).simulate(rig.state(phi=0.5), surface)
    >>> len(motion_figure({"printed surface": motion}).axes)
    3
    """
    require(trajectories, "motions to draw", "none", "at least one")
    first = next(iter(trajectories.values()))
    mechanism = first.mechanism
    rows = mechanism.n + mechanism.m
    with style():
        figure = MotionFigure(figsize=(6.4, 1.1 + 1.35 * rows), layout="constrained")
        panels = np.atleast_1d(figure.subplots(rows, 1, sharex=True))
        lines = cycle(_LINES if len(trajectories) > 1 else [{"color": COLOURS["blue"]}])
        for (label, trajectory), line in zip(trajectories.items(), lines, strict=False):
            look = {**line, "label": label}
            for panel, coordinate in zip(panels, mechanism.coordinates, strict=False):
                state_series(panel, trajectory, coordinate.name, **look)
            for index in range(mechanism.m):
                input_series(panels[mechanism.n + index], trajectory, index, **look)
        panels[-1].set_xlabel("time (s)")
        end = until or max(t.time for t in trajectories.values())
        panels[-1].set_xlim(0, end or None)
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


def state_words(mechanism: Mechanism, x: FloatArray) -> str:
    """Return the entries of a state that are not zero, in words, angles in degrees.

    >>> import undertow as ut
    >>> rig = ut.mechanisms.cart_pendulum()
    >>> state_words(rig, rig.state(x=0.2, phi=ut.deg(20)))
    'x = 0.2 m, phi = 20°'
    """
    words = []
    for index, (name, value) in enumerate(zip(mechanism.state_names, x, strict=True)):
        rate = index >= mechanism.n
        factor, unit = display(mechanism.coordinates[index % mechanism.n].unit, rate)
        if value != 0:
            space = "" if unit.startswith("°") else " "
            words.append(f"{name} = {factor * value:.4g}{space}{unit}")
    return ", ".join(words) or "at the target"


def figure_files(
    figures: Mapping[str, Figure], kinds: Sequence[str] = ("png",)
) -> dict[str, bytes]:
    """Return figures as files, ``NAME.KIND`` for each of the kinds, see :func:`figure_bytes`."""
    return {
        f"{name}.{kind}": figure_bytes(figure, kind)
        for name, figure in figures.items()
        for kind in kinds
    }
