"""Motions drawn: the numbers given, in degrees, one row for each; no trace elsewhere."""

from __future__ import annotations

import matplotlib as mpl
import numpy as np
import pytest
import sympy as sp
from matplotlib.figure import Figure

import undertow as ut
from support import rest_slow
from undertow.base import InvalidInputError
from undertow.closed_loop import figures


@pytest.fixture(scope="module")
def motion(rig: ut.Mechanism, quick: ut.Surface) -> ut.Trajectory:
    return ut.ClosedLoop(rig).simulate(rig.state(phi=ut.deg(20)), quick, duration=1.0)


def test_angles_are_drawn_in_degrees_and_named_so(motion: ut.Trajectory) -> None:
    """The line holds the state times 180/π, and the label says °."""
    axes = Figure().subplots()
    figures.state_series(axes, motion, "phi")
    x, y = (np.asarray(v, dtype=float) for v in axes.lines[0].get_data())
    np.testing.assert_array_equal(x, motion.t)
    np.testing.assert_allclose(y, np.degrees(motion["phi"]))
    assert axes.get_ylabel() == "φ (°)"
    figures.state_series(axes, motion, "theta_dot")
    assert axes.get_ylabel() == "θ̇ (°/s)"


def test_lengths_stay_in_metres() -> None:
    """A coordinate in metres is shown in metres, its rate in m/s."""
    assert figures.display("m") == (1.0, "m")
    assert figures.display("m", rate=True)[1] == "m/s"
    assert figures.display("rad")[0] == pytest.approx(57.29577951308232)


def test_input_is_drawn_in_its_unit(motion: ut.Trajectory) -> None:
    """The voltage is drawn as recorded, with its unit on the axis."""
    axes = Figure().subplots()
    figures.input_series(axes, motion)
    np.testing.assert_array_equal(axes.lines[0].get_ydata(), motion.u[:, 0])
    assert axes.get_ylabel() == "voltage (V)"


def test_labels_of_the_panels_are_in_line(motion: ut.Trajectory) -> None:
    """However wide the numbers beside them are."""
    figure = figures.motion_figure({"motion": motion})
    figure.draw_without_rendering()
    ends = [panel.yaxis.label.get_window_extent().x1 for panel in figure.axes]
    assert np.ptp(ends) < 1  # pixel


@pytest.mark.parametrize("kind", rest_slow(["png", "pdf"], "png"))
def test_same_motion_same_picture_bit_for_bit(motion: ut.Trajectory, kind: str) -> None:
    """Drawing is deterministic: no date, no random identifier."""
    pictures = [
        figures.figure_bytes(figures.motion_figure({"motion": motion}), kind) for _ in range(2)
    ]
    assert pictures[0] == pictures[1]
    assert pictures[0].startswith(b"\x89PNG" if kind == "png" else b"%PDF")


def test_drawing_leaves_global_settings_alone(motion: ut.Trajectory) -> None:
    """The caller's matplotlib settings are as before."""
    before = dict(mpl.rcParams)
    figures.figure_bytes(figures.motion_figure({"a": motion, "b": motion}, until=1.0, title="two"))
    assert dict(mpl.rcParams) == before


def test_motion_figure_has_a_row_for_each_coordinate_and_input(motion: ut.Trajectory) -> None:
    """Three rows for the rotary pendulum, a line for each motion in each."""
    figure = figures.motion_figure({"a": motion, "b": motion})
    assert [axes.get_ylabel() for axes in figure.axes] == ["θ (°)", "φ (°)", "voltage (V)"]
    assert all(len(axes.lines) == 2 for axes in figure.axes)
    colours = [line.get_color() for line in figure.axes[0].lines]
    assert len(set(colours)) == 2


def test_nothing_to_draw_is_refused() -> None:
    """An empty mapping, and a state that is not there."""
    with pytest.raises(InvalidInputError, match="motions to draw"):
        figures.motion_figure({})


def test_inputs_have_their_names_in_a_motion_too(motion: ut.Trajectory) -> None:
    assert np.array_equal(motion["voltage"], motion.u[:, 0])
    assert np.array_equal(motion["phi_dot"], motion.x[:, 3])
    with pytest.raises(InvalidInputError, match=r"'volt', must be one of theta, .*, voltage"):
        motion["volt"]


def test_unknown_state_is_refused(motion: ut.Trajectory) -> None:
    """The names that exist are listed."""
    with pytest.raises(InvalidInputError, match="theta, phi"):
        figures.state_series(Figure().subplots(), motion, "psi")


@pytest.fixture(scope="module")
def slide(quick: ut.Surface) -> ut.Trajectory:
    """Another motion: of a cart, in metres, with a coordinate that no Greek letter names."""
    cart = ut.mechanisms.cart_pendulum()
    x = np.linspace([0.1, 0.2, 0.3, 0.4], [0.0, 0.1, 0.2, 0.3], 5)
    t = np.linspace(0.0, 2.0, 5)
    return ut.Trajectory(cart, t, x, x[:, :1], x[:, 1:2], t, t, ut.Event.HORIZON)


def test_names_that_are_no_letters_are_spelt(slide: ut.Trajectory) -> None:
    """ẋ as a letter with a dot; the unit is the coordinate's, a rate's per second."""
    for name, factor, label in (
        ("x", 1.0, "x (m)"),
        ("phi", 180 / np.pi, "φ (°)"),
        ("x_dot", 1.0, "x\N{COMBINING DOT ABOVE} (m/s)"),
        ("phi_dot", 180 / np.pi, "φ\N{COMBINING DOT ABOVE} (°/s)"),
    ):
        values, shown = figures.axis(slide, name)
        assert shown == label
        np.testing.assert_allclose(values, factor * slide[name])
    long = ut.Mechanism(
        "long",
        (ut.Coordinate("arm"), ut.Coordinate("rod")),
        (ut.Input("push", "N"),),
        sp.ImmutableDenseMatrix(sp.eye(2)),
        sp.ImmutableDenseMatrix([0, 0]),
    )
    run = ut.Trajectory(
        long, slide.t, slide.x, slide.u, slide.s, slide.t, slide.margin, slide.event
    )
    assert figures.axis(run, "rod_dot")[1] == "drod/dt (°/s)"
    assert figures.axis(run, "arm")[1] == "arm (°)"


def test_a_motion_figure_shows_all_of_every_motion(motion: ut.Trajectory) -> None:
    """Each row the state or input of its label, to the longest motion's end, titled and named."""
    short = ut.ClosedLoop(motion.mechanism).simulate(
        motion.x[0], ut.Surface(-1, -1.59, 1.96, 12.1), duration=0.5
    )
    figure = figures.motion_figure({"long": motion, "short": short}, title="two motions")
    theta, phi, voltage = figure.axes
    for axes, name in ((theta, "theta"), (phi, "phi")):
        for line, run in zip(axes.lines, (motion, short), strict=True):
            np.testing.assert_array_equal(line.get_xdata(), run.t)
            np.testing.assert_allclose(np.asarray(line.get_ydata()), np.degrees(run[name]))
    for line, run in zip(voltage.lines, (motion, short), strict=True):
        np.testing.assert_array_equal(line.get_ydata(), run.u[:, 0])
    assert [axes.get_xlabel() for axes in figure.axes] == ["", "", "time (s)"]
    assert {axes.get_xlim() for axes in figure.axes} == {(0.0, motion.time)}
    assert theta.get_title(loc="left") == "two motions"
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["long", "short"]
    early = figures.motion_figure({"long": motion}, until=0.25)
    assert early.axes[0].get_xlim() == (0.0, 0.25)
    assert early.axes[0].get_title(loc="left") == ""
    assert not early.legends
    ratio = np.diff(figures.motion_figure({"a": motion}).get_size_inches())[0]
    assert ratio < 0  # wider than high: three rows


def test_up_to_four_motions_look_different_in_colour_and_in_print(motion: ut.Trajectory) -> None:
    figure = figures.motion_figure(dict.fromkeys("abcd", motion))
    for axes in figure.axes:
        assert len({line.get_color() for line in axes.lines}) == 4
        assert len({str(line.get_linestyle()) for line in axes.lines}) > 1


def test_a_figure_is_drawn_in_the_projects_style_whatever_the_callers(
    motion: ut.Trajectory,
) -> None:
    """The same bytes under other settings; what the style leaves out is the caller's."""
    with mpl.rc_context({"axes.grid": True, "lines.linewidth": 9.0, "font.size": 30.0}):
        with figures.style():
            inside = dict(mpl.rcParams)
        other = dict(mpl.rcParams)
    assert inside["font.size"] != 30.0
    assert other["font.size"] == 30.0
    with mpl.rc_context({"savefig.directory": "elsewhere"}), figures.style():
        assert mpl.rcParams["savefig.directory"] == "elsewhere"


def test_a_state_in_words(rig: ut.Mechanism) -> None:
    """What is not zero, angles in degrees without a space, rates per second."""
    cart = ut.mechanisms.cart_pendulum()
    state = cart.state(x=0.5, phi_dot=ut.deg(-30), x_dot=1e-3)
    assert figures.state_words(cart, state) == "x = 0.5 m, x_dot = 0.001 m/s, phi_dot = -30°/s"
    assert figures.state_words(rig, rig.state(theta=ut.deg(90))) == "theta = 90°"
    assert figures.state_words(rig, rig.state(theta=1.0, phi=1.0)).count(",") == 1
    assert figures.state_words(rig, rig.state()) == "at the target"


def test_figures_become_files_of_each_kind(motion: ut.Trajectory) -> None:
    files = figures.figure_files({"one": figures.motion_figure({"a": motion})}, ("png", "svg"))
    assert sorted(files) == ["one.png", "one.svg"]
    assert files["one.png"].startswith(b"\x89PNG")
    assert b"<svg" in files["one.svg"]
    assert b"<dc:date>" not in files["one.svg"]
    assert figures.motion_figure({"a": motion})._repr_png_() == files["one.png"]


def test_what_the_style_does_not_say_is_the_users() -> None:
    """A user's settings hold in our pictures, but for those that make the style."""
    with mpl.rc_context({"lines.markersize": 11.0, "axes.grid": False}), figures.style():
        assert mpl.rcParams["lines.markersize"] == 11.0
        assert mpl.rcParams["axes.grid"]
