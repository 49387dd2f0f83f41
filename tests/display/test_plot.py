"""Plots draw what they are given, in degrees, and leave no trace elsewhere."""

from __future__ import annotations

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.figure import Figure

import undertow as ut
from undertow.base import InvalidInputError
from undertow.display import plot
from undertow.studies.paper import CASES, PRINTED


@pytest.fixture(scope="module")
def motion(rig: ut.Mechanism) -> ut.Trajectory:
    loop = ut.ClosedLoop(rig, ut.MinimumTime())
    return loop.simulate(rig.state(phi=ut.deg(20)), CASES["4 one-time, time"])


def test_angles_are_drawn_in_degrees_and_named_so(motion: ut.Trajectory) -> None:
    """The line holds the state times 180/π, and the label says °."""
    axes = Figure().subplots()
    plot.state_series(axes, motion, "phi")
    x, y = (np.asarray(v, dtype=float) for v in axes.lines[0].get_data())
    np.testing.assert_array_equal(x, motion.t)
    np.testing.assert_allclose(y, np.degrees(motion["phi"]))
    assert axes.get_ylabel() == "φ (°)"
    plot.state_series(axes, motion, "theta_dot")
    assert axes.get_ylabel() == "θ̇ (°/s)"


def test_lengths_stay_in_metres() -> None:
    """A coordinate in metres is shown in metres, its rate in m/s."""
    assert plot.display("m") == (1.0, "m")
    assert plot.display("m", rate=True)[1] == "m/s"
    assert plot.display("rad")[0] == pytest.approx(57.29577951308232)


def test_input_is_drawn_in_its_unit(motion: ut.Trajectory) -> None:
    """The voltage is drawn as recorded, with its unit on the axis."""
    axes = Figure().subplots()
    plot.input_series(axes, motion)
    np.testing.assert_array_equal(axes.lines[0].get_ydata(), motion.u[:, 0])
    assert axes.get_ylabel() == "voltage (V)"


def test_surface_trace_is_where_s_vanishes(rig: ut.Mechanism) -> None:
    """Each point of the trace, put back into the state, gives s = 0 on the surface in use."""
    printed = PRINTED["energy", "cascade"]
    motion = ut.ClosedLoop(rig).simulate(
        rig.state(phi=ut.deg(40)), printed.surfaces, switch_times=printed.switch_times
    )
    axes = Figure().subplots()
    plot.surface_trace(axes, motion, printed.surfaces, printed.switch_times, "phi")
    parts = [line for line in axes.lines if line.get_linestyle() != ":"]
    assert len(parts) == len(printed.surfaces)
    end = 0
    for line, surface in zip(parts, printed.surfaces, strict=True):
        phi, phi_dot = (np.radians(v) for v in line.get_data())
        states = motion.x[end : end + len(phi)].copy()
        np.testing.assert_allclose(states[:, 1], phi, atol=1e-12)
        states[:, 3] = phi_dot
        # The last row of a motion is the state at its end, and s that of the step before.
        np.testing.assert_allclose(surface.s(states)[:-1], 0, atol=1e-9)
        end += len(phi)


def test_surface_jumps_are_marked(rig: ut.Mechanism) -> None:
    """Where another surface takes over, a dotted line joins the two ends of the trace."""
    printed = PRINTED["energy", "cascade"]
    motion = ut.ClosedLoop(rig).simulate(
        rig.state(phi=ut.deg(40)), printed.surfaces, switch_times=printed.switch_times
    )
    axes = Figure().subplots()
    plot.surface_trace(axes, motion, printed.surfaces, printed.switch_times, "phi")
    jumps = [line for line in axes.lines if line.get_linestyle() == ":"]
    assert len(jumps) == len(printed.surfaces) - 1


@pytest.mark.parametrize("kind", ["png", "pdf"])
def test_same_motion_same_picture_bit_for_bit(motion: ut.Trajectory, kind: str) -> None:
    """Drawing is deterministic: no date, no random identifier."""
    pictures = [plot.figure_bytes(plot.motion_figure({"motion": motion}), kind) for _ in range(2)]
    assert pictures[0] == pictures[1]
    assert pictures[0].startswith(b"\x89PNG" if kind == "png" else b"%PDF")


def test_drawing_leaves_global_settings_alone(motion: ut.Trajectory) -> None:
    """The caller's matplotlib settings are as before."""
    before = dict(mpl.rcParams)
    plot.figure_bytes(plot.motion_figure({"a": motion, "b": motion}, until=1.0, title="two"))
    assert dict(mpl.rcParams) == before


def test_motion_figure_has_a_row_for_each_coordinate_and_input(motion: ut.Trajectory) -> None:
    """Three rows for the rotary pendulum, a line for each motion in each."""
    figure = plot.motion_figure({"a": motion, "b": motion})
    assert [axes.get_ylabel() for axes in figure.axes] == ["θ (°)", "φ (°)", "voltage (V)"]
    assert all(len(axes.lines) == 2 for axes in figure.axes)
    colours = [line.get_color() for line in figure.axes[0].lines]
    assert len(set(colours)) == 2


def test_nothing_to_draw_is_refused() -> None:
    """An empty mapping, and a state that is not there."""
    with pytest.raises(InvalidInputError, match="motions to draw"):
        plot.motion_figure({})


def test_unknown_state_is_refused(motion: ut.Trajectory) -> None:
    """The names that exist are listed."""
    with pytest.raises(InvalidInputError, match="theta, phi"):
        plot.state_series(Figure().subplots(), motion, "psi")
