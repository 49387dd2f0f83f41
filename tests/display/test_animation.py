"""Every mechanism has an animation, and what is drawn is where the mechanism is."""

from __future__ import annotations

import io
import itertools
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image
from typer.testing import CliRunner

import undertow as ut
from support import rest_slow
from undertow.base import InvalidInputError
from undertow.cli import app
from undertow.display.animation import Film, evaluator, gif, still
from undertow.display.sketches import Label, Line, sketch
from undertow.mechanisms import LIBRARY
from undertow.models import FloatArray
from undertow.plants.scenes import mujoco_scene
from undertow.studies import gallery

NAMES = sorted(LIBRARY)
#: A rope, and a link with a wheel.
SOME = {"gantry_crane", "reaction_wheel_pendulum"}


def motion(mechanism: ut.Mechanism, seconds: float = 1.0) -> ut.Trajectory:
    """A recorded motion that needs no compiler: the listed start, fading."""
    t = np.linspace(0, seconds, 501)
    fade = np.exp(-5 * t / seconds)[:, None]
    x = mechanism.state(**mechanism.start) * fade
    rows = np.zeros((len(t), mechanism.m))
    u = np.broadcast_to(0.3 * fade, rows.shape) * np.minimum(mechanism.input_limits, 10)
    return ut.Trajectory(mechanism, t, x, u, rows, t, np.ones_like(t), ut.Event.REACHED)


def distance(point: FloatArray, line: FloatArray) -> float:
    """Distance of a point from a polyline."""
    best = np.inf
    for a, b in itertools.pairwise(line):
        along = b - a
        s = np.clip((point - a) @ along / max(along @ along, 1e-30), 0, 1)
        best = min(best, float(np.linalg.norm(point - a - s * along)))
    return best


@pytest.mark.parametrize("name", NAMES)
def test_drawn_links_carry_the_bodies(name: str) -> None:
    """Claim: each moving body's centre of mass, as MuJoCo places it, lies on what is drawn.

    At ten random positions; the scene was written body by body, not from these sketches.  The
    ball is drawn on the beam, its model rolls in it.
    """
    allowed = 0.03 if name == "ball_and_beam" else 0.0
    mujoco: Any = pytest.importorskip("mujoco")
    mechanism = LIBRARY[name]()
    scene = mujoco_scene(mechanism)
    model = mujoco.MjModel.from_xml_string(scene.xml)
    data = mujoco.MjData(model)
    drawn = sketch(mechanism)
    place = evaluator(mechanism, drawn)
    for q in np.random.default_rng(0).uniform(-0.7, 0.7, (10, mechanism.n)):
        data.qpos[:] = scene.joints @ q
        mujoco.mj_forward(model, data)
        points, _, _ = place(q[None])
        shapes = [
            p[0]
            for part, p in zip(drawn.parts, points, strict=True)
            if not (isinstance(part, Line) and part.kind in ("frame", "ground"))
        ]
        for body in range(1, model.nbody):
            centre = data.xipos[body]
            gaps = [
                distance(centre, s) if len(s) > 1 else float(np.linalg.norm(centre - s[0]))
                for s in shapes
            ]
            assert min(gaps) < allowed + 1e-9, mujoco.mj_id2name(model, 1, body)


@pytest.mark.parametrize("name", NAMES)
def test_links_are_rigid(name: str) -> None:
    """Claim: links and ropes with two ends keep their length at random positions."""
    mechanism = LIBRARY[name]()
    drawn = sketch(mechanism)
    q = np.random.default_rng(1).uniform(-1, 1, (20, mechanism.n))
    points, _, _ = evaluator(mechanism, drawn)(q)
    checked = 0
    for part, p in zip(drawn.parts, points, strict=True):
        if isinstance(part, Line) and len(part.points) == 2 and part.kind in ("link", "rope"):
            lengths = np.linalg.norm(p[:, 1] - p[:, 0], axis=1)
            np.testing.assert_allclose(lengths, lengths[0], rtol=1e-12)
            checked += 1
    assert checked


@cache
def film(name: str) -> Film:
    return Film.of(motion(LIBRARY[name]()), fps=5)


@pytest.mark.parametrize("name", rest_slow(NAMES, *SOME))
def test_every_mechanism_moves_in_its_gif(name: str) -> None:
    """Claim: a GIF of as many frames as the film, at its pace, in which something moves."""
    shown = film(name)
    picture = Image.open(io.BytesIO(gif(shown)))
    assert picture.format == "GIF"
    assert getattr(picture, "n_frames", 1) == len(shown.t) >= 5
    assert picture.info["duration"] == 200
    first = np.asarray(picture.convert("L"), dtype=int)
    picture.seek(len(shown.t) - 1)
    last = np.asarray(picture.convert("L"), dtype=int)
    assert (np.abs(first - last) > 60).sum() > 20


@pytest.mark.parametrize("name", NAMES)
def test_nothing_leaves_the_window(name: str) -> None:
    """Claim: all drawn points of all frames lie inside the window."""
    shown = film(name)
    left, right, bottom, top = shown.window
    for p in (*shown.points, shown.tip):
        assert left < p[..., 0].min() <= p[..., 0].max() < right
        assert bottom < p[..., 1].min() <= p[..., 1].max() < top


def test_film_ends_when_the_motion_has_settled() -> None:
    """Claim: the slow end of a motion is left out, and slow motion has more frames."""
    rig = LIBRARY["acrobot"]()
    long = motion(rig, 20.0)
    settled = Film.of(long, longest=60.0)
    assert 10 < settled.t[-1] < 16  # e^(−t/4) reaches 3 % at 14 s, half a second more
    assert Film.of(long, longest=2.0).t[-1] == pytest.approx(2.0, abs=0.05)
    slow = Film.of(motion(rig), speed=0.5)
    assert len(slow.t) == pytest.approx(2 * len(Film.of(motion(rig)).t), abs=2)
    for fps, longest, speed in ((0.0, 8.0, 1.0), (25.0, np.nan, 1.0), (25.0, 8.0, -1.0)):
        with pytest.raises(InvalidInputError, match="of an animation"):
            Film.of(long, fps=fps, longest=longest, speed=speed)


def test_any_mechanism_has_dials() -> None:
    """Claim: a mechanism that is not of the library is drawn too: a hand or a bead each, named."""
    from support import random_mechanism

    one = random_mechanism(3, 1, prismatic=True)
    drawn = sketch(one)
    assert len(drawn.parts) == 3 * one.n
    named = [part.text for part in drawn.parts if isinstance(part, Label)]
    assert named == ["q0, m", "q1, °", "q2, °"]  # as in charts
    points, _, _ = evaluator(one, drawn)(np.array([[0.5, 0.0, np.pi / 2]]))
    np.testing.assert_allclose(points[1][0, 0], [0.5, 0, 0])
    np.testing.assert_allclose(points[5][0, 1] - points[5][0, 0], [1, 0, 0], atol=1e-12)


def test_still_shows_ghosts() -> None:
    """Claim: a still has the last pose and fainter ones before it."""
    axes = Figure().add_subplot()
    still(axes, film("cart_pendulum"), ghosts=4)
    assert len({line.get_alpha() for line in axes.lines}) >= 4


@pytest.mark.slow
def test_animate_on_the_command_line(tmp_path: Path) -> None:
    """Claim: one command leaves the film and the still, from the listed start."""
    words = ["animate", "pendubot", "--out", str(tmp_path)]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 0, result.output
    assert (tmp_path / "pendubot.gif").read_bytes().startswith(b"GIF8")
    assert (tmp_path / "pendubot.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("speed", "fps"),
    rest_slow([(1.0, 10.0), (0.5, 10.0), (2.0, 10.0), (1.0, 30.0), (0.5, 200.0)], (0.5, 10.0)),
)
def test_a_film_lasts_as_long_as_it_says(speed: float, fps: float) -> None:
    """Half the speed takes twice as long; the last picture stays a second.

    A GIF counts hundredths of a second: at 30 frames a second the film was a tenth too fast.
    """
    film = Film.of(motion(LIBRARY["cart_pendulum"](), 0.5), fps=fps, speed=speed)
    with Image.open(io.BytesIO(gif(film))) as image:
        lengths = []
        for k in range(getattr(image, "n_frames", 1)):
            image.seek(k)
            lengths.append(image.info["duration"] / 1000.0)
    assert sum(lengths[:-1]) == pytest.approx((film.t[-1] - film.t[0]) / speed, rel=0.02)
    assert film.pace == {1.0: "real time", 0.5: "2 times slower", 2.0: "2 times faster"}[speed]


@pytest.mark.slow
def test_the_library_is_filmed_side_by_side(monkeypatch: pytest.MonkeyPatch) -> None:
    """One clock, a third of real time, until the last one is there: here of two mechanisms."""
    names = ("rotary_pendulum", "acrobot")
    monkeypatch.setattr(gallery, "LIBRARY", {name: LIBRARY[name] for name in names})
    files = gallery.library_files()
    assert files["mechanisms.png"].startswith(b"\x89PNG")
    with Image.open(io.BytesIO(files["mechanisms.gif"])) as image:
        count = getattr(image, "n_frames", 1)
        assert image.info["duration"] == round(1000 / gallery.FPS)
    times = []
    for name in names:
        rig = LIBRARY[name]()
        loop = ut.ClosedLoop(rig, ut.MinimumTime())
        plan = ut.Optimiser(loop).require(rig.usual_start).plan
        assert plan is not None
        times.append(loop.simulate(rig.usual_start, plan).time)
    assert count == pytest.approx(max(times) * gallery.FPS / gallery.SPEED, abs=3)
