"""Phase planes and sliding surfaces drawn."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from undertow.base import require
from undertow.closed_loop import Trajectory
from undertow.closed_loop.figures import axis, display
from undertow.law import Surface


def phase(axes: Axes, trajectory: Trajectory, name: str, **line: Any) -> None:
    """Draw the velocity of a coordinate over the coordinate and label both axes."""
    x, x_label = axis(trajectory, name)
    y, y_label = axis(trajectory, f"{name}_dot")
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

    The motion has one input; each of the surfaces, (S,), takes over at its time, s, the first at
    the start; ``line`` has properties of the trace.

    Raises
    ------
    InvalidInputError
        When there are several surfaces at once, m > 1: then s = 0 fixes no single velocity.
    """
    mechanism, m = trajectory.mechanism, trajectory.mechanism.m
    require(m == 1, f"surface trace of '{mechanism.name}'", f"m = {m}", "m = 1")
    x, _ = axis(trajectory, name)
    y, _ = axis(trajectory, f"{name}_dot")
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
