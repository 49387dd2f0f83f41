"""Plots draw what they are given, in degrees, and leave no trace elsewhere."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.figure import Figure

import undertow as ut
from undertow.display import plot
from undertow.studies.paper import CASES, PRINTED


@pytest.fixture(scope="module")
def motion(rig: ut.Mechanism) -> ut.Trajectory:
    loop = ut.ClosedLoop(rig, ut.MinimumTime())
    return loop.simulate(rig.state(phi=ut.deg(20)), CASES["4 one-time, time"])


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
