"""Motions as pictures: a stick figure at one instant, over time as a GIF, or as a strip of ghosts.

The figure is data, see :mod:`undertow.display.sketches`; its points are evaluated once for the
whole motion and then only drawn.
"""

from __future__ import annotations

import io
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import sympy as sp
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle
from numpy.typing import NDArray
from PIL import Image

from undertow.base import file_name, manifest, positive
from undertow.closed_loop import Trajectory
from undertow.closed_loop.figures import COLOURS, figure_bytes, style
from undertow.display.sketches import Box, Disc, Label, Line, Sketch, projected, sketch
from undertow.models import FloatArray, Mechanism, check_symbols, vocabulary
from undertow.symbolic import compile_expressions

#: A motion is shown until all of it stays within this part of where it has been.
SETTLED = 0.03

_KINDS: dict[str, dict[str, Any]] = {
    "link": {"color": COLOURS["blue"], "linewidth": 4.0, "solid_capstyle": "round"},
    "rope": {"color": COLOURS["black"], "linewidth": 1.2},
    "frame": {"color": COLOURS["grey"], "linewidth": 2.0},
    "ground": {"color": COLOURS["grey"], "linewidth": 2.0},
}


def check_film(*, longest: float, speed: float, fps: float = 25.0) -> None:
    """Refuse a frame rate, a length, s, or a speed that no film has, before any long work.

    Raises
    ------
    InvalidInputError
        For one that is not positive.
    """
    for name, value in (("frame rate", fps), ("length", longest), ("speed", speed)):
        positive(f"{name} of an animation", value)


@dataclass(frozen=True, eq=False)
class Film:
    """A motion ready for drawing.

    ``t``: times of the frames, (F,), s. ``q``, ``u``: positions, (F, n), and inputs, (F, m), at
    these times. ``points``: of each part in the plane of the view, (F, k, 2), m; ``angles``: angle
    and radius of each disc, (F, 2), empty for other parts; ``tip``: in the plane of the view, (F,
    2), m. ``whole``: how long the motion takes until it has settled, s: longer than the film where
    that is cut. ``speed``: motion seconds in a second of film.
    """

    mechanism: Mechanism
    sketch: Sketch
    t: FloatArray
    q: FloatArray
    u: FloatArray
    points: tuple[FloatArray, ...]
    angles: tuple[FloatArray, ...]
    tip: FloatArray
    whole: float
    speed: float = 1.0

    @classmethod
    def of(
        cls,
        trajectory: Trajectory,
        *,
        fps: float = 25.0,
        longest: float = 8.0,
        speed: float = 1.0,
        figure: Sketch | None = None,
    ) -> Film:
        """Sample a motion evenly until it has settled, or for ``longest`` seconds of film.

        Parameters
        ----------
        trajectory
            A recorded motion.
        fps
            Frames in a second, 50 at most; the nearest that a GIF can keep, whose frames last
            whole hundredths of a second.
        longest
            Longest film, s.
        speed
            Motion seconds in a second of film: 0.5 is slow motion.
        figure
            What to draw; the mechanism's own stick figure by default, dials for a mechanism
            that is not of the library.

        Raises
        ------
        InvalidInputError
            For a frame rate, length or speed that is not positive.
        """
        check_film(fps=fps, longest=longest, speed=speed)
        fps = 100.0 / max(2, round(100.0 / fps))
        mechanism = trajectory.mechanism
        drawn = sketch(mechanism) if figure is None else figure
        start = trajectory.t[0]
        whole = float(_settled(trajectory) - start)
        end = min(whole, longest * speed)
        count = max(2, math.ceil(end * fps / speed) + 1)
        t = start + np.arange(count) * speed / fps
        x = np.stack([np.interp(t, trajectory.t, column) for column in trajectory.x.T], axis=1)
        index = np.clip(np.searchsorted(trajectory.t, t, side="right") - 1, 0, None)
        place = evaluator(mechanism, drawn)
        q, u = x[:, : mechanism.n], trajectory.u[index]
        return cls._at(mechanism, drawn, place, t, q, u, whole, speed)

    @classmethod
    def _at(
        cls, mechanism: Mechanism, drawn: Sketch, place: Callable[[FloatArray], Places],
        t: FloatArray, q: FloatArray, u: FloatArray, whole: float, speed: float = 1.0,
    ) -> Film:  # fmt: skip
        """Evaluate a sketch at positions, (F, n), see :func:`evaluator`."""
        points, angles, tip = place(q)
        *flat, end = (
            np.stack(projected(tuple(np.moveaxis(p, -1, 0)), drawn.view), axis=-1)
            for p in (*points, tip)
        )
        return cls(mechanism, drawn, t, q, u, tuple(flat), angles, end, whole, speed)

    @property
    def span(self) -> str:
        """Which part of the motion is shown, in words.

        What settles sooner than it ends is shown until then.
        """
        shown = float(self.t[-1] - self.t[0])
        return f"0 to {shown:.3g} s" + (f" of {self.whole:.3g} s" if self.cut else "")

    @property
    def pace(self) -> str:
        """How fast the film is, in words."""
        if self.speed == 1.0:
            return "real time"
        factor = self.speed if self.speed > 1.0 else 1.0 / self.speed
        return f"{factor:.3g} times {'faster' if self.speed > 1.0 else 'slower'}"

    @property
    def cut(self) -> bool:
        """Whether the motion takes longer to settle than the film shows."""
        frames = self.t - self.t[0]
        return bool(self.whole - frames[-1] > frames[1])

    @property
    def window(self) -> tuple[float, float, float, float]:
        """Left, right, bottom and top of everything that is ever drawn, with a margin, m."""
        every = [p.reshape(-1, 2) for p in self.points] + [self.tip]
        sizes = [
            max(part.width, part.height) if isinstance(part, Box) else float(angle[:, 1].max())
            for part, angle in zip(self.sketch.parts, self.angles, strict=True)
            if isinstance(part, Box | Disc)
        ]
        cloud = np.vstack(every)
        low, high = cloud.min(axis=0), cloud.max(axis=0)
        margin = 0.06 * float((high - low).max()) + max(sizes, default=0.0)
        return low[0] - margin, high[0] + margin, low[1] - margin, high[1] + margin

    def draw(self, axes: Axes, frame: int, *, alpha: float = 1.0, trace: bool = True) -> None:
        """Draw one frame on axes of equal scales; ``trace`` adds the tip's path until then."""
        if trace:
            path = self.tip[: frame + 1]
            axes.plot(*path.T, color=COLOURS["orange"], linewidth=1.0, alpha=0.8, zorder=1)
        drawn = zip(self.sketch.parts, self.points, self.angles, strict=True)
        for index, (part, points, angles) in enumerate(drawn):
            here, level = points[frame], 2 + index / len(self.sketch.parts)
            if isinstance(part, Line) and part.kind == "ground":
                axes.axhline(here[0, 1], zorder=0, **_KINDS[part.kind])
            elif isinstance(part, Line):
                fade = 1.0 if part.kind == "frame" else alpha
                axes.plot(*here.T, alpha=fade, zorder=level, **_KINDS[part.kind])
                if part.kind == "link":
                    axes.plot(
                        *here[0], marker="o", markersize=4, color=COLOURS["black"], alpha=fade,
                        zorder=4,
                    )  # fmt: skip
            elif isinstance(part, Label):
                axes.text(here[0, 0], here[0, 1], part.text, ha="center", va="top", alpha=alpha)
            elif isinstance(part, Box):
                corner = here[0] - (part.width, part.height)
                axes.add_patch(
                    Rectangle(
                        (corner[0], corner[1]), 2 * part.width, 2 * part.height,
                        facecolor="#d9e6ef", edgecolor=COLOURS["black"], alpha=alpha, zorder=level,
                    )
                )  # fmt: skip
            else:
                angle, radius = angles[frame]
                rim = here[0] + radius * np.array([math.sin(angle), math.cos(angle)])
                axes.add_patch(
                    Circle(
                        (here[0, 0], here[0, 1]), radius, facecolor="#fbe5cf",
                        edgecolor=COLOURS["black"], alpha=alpha, zorder=level,
                    )
                )  # fmt: skip
                if part.angle != 0:
                    axes.plot(
                        [here[0, 0], rim[0]], [here[0, 1], rim[1]], color=COLOURS["black"],
                        linewidth=1.2, alpha=alpha, zorder=4,
                    )  # fmt: skip

    def frame(self, axes: Axes, words: bool = True) -> None:
        """Set the window on axes and take their ticks away."""
        left, right, bottom, top = self.window
        axes.set_xlim(left, right)
        axes.set_ylim(bottom, top)
        axes.set_aspect("equal")
        axes.axis("off")
        if words:
            axes.set_title(f"{self.mechanism.name.replace('_', ' ')}\n{self.span}")


class Picture:
    """A mechanism's stick figure at one instant after another, as pixels, in one window.

    The window holds what turning each angle, and moving each slide along its travel, can reach;
    it follows what leaves it.
    """

    def __init__(self, mechanism: Mechanism) -> None:
        self._mechanism, self._sketch = mechanism, sketch(mechanism)
        self._place = evaluator(mechanism, self._sketch)
        self._window = self._film(_reach(mechanism)).window
        self._figure = Figure(figsize=(3.6, 3.6), dpi=100)
        self._canvas: Any = FigureCanvasAgg(self._figure)
        self._axes = self._figure.add_axes((0, 0, 1, 1))

    def _film(self, q: FloatArray) -> Film:
        """Return poses, (F, n), as the frames of a film."""
        t, u = np.zeros(len(q)), np.zeros((len(q), self._mechanism.m))
        return Film._at(self._mechanism, self._sketch, self._place, t, q, u, 0.0)

    def pixels(self, q: FloatArray) -> NDArray[np.uint8]:
        """Return the figure at positions, (n,), as red, green, blue: (height, width, 3)."""
        film, axes = self._film(q[None]), self._axes
        left, right, bottom, top = self._window
        here = film.tip[0]
        across = here[0] - np.clip(here[0], left, right)
        along = here[1] - np.clip(here[1], bottom, top)
        axes.clear()
        film.draw(axes, 0, trace=False)
        axes.set_xlim(left + across, right + across)
        axes.set_ylim(bottom + along, top + along)
        axes.set_aspect("equal")
        axes.axis("off")
        self._canvas.draw()
        return np.array(self._canvas.buffer_rgba())[:, :, :3]


def _reach(mechanism: Mechanism) -> FloatArray:
    """Return poses at the edges of what a mechanism can reach, (F, n)."""
    n, turns = mechanism.n, np.linspace(-math.pi, math.pi, 16)
    angles = [c.unit == "rad" for c in mechanism.coordinates]
    alone = [turns[:, None] * np.eye(n)[i] for i in range(n) if angles[i]]
    together = turns[:, None] * np.array(angles, dtype=float)
    ends = [
        (0.0,) if c.unit == "rad" else (max(c.low, -1.0), 0.0, min(c.high, 1.0))
        for c in mechanism.coordinates
    ]
    slides = np.array(list(itertools.product(*ends)))
    turned = np.vstack([np.zeros((1, n)), *alone, together])
    return np.asarray((slides[:, None] + turned[None]).reshape(-1, n))


#: Points of the parts, (F, k, 3), angles and radii of the discs, (F, 2), and the tip, (F, 3).
Places = tuple[tuple[FloatArray, ...], tuple[FloatArray, ...], FloatArray]


def evaluator(mechanism: Mechanism, figure: Sketch) -> Callable[[FloatArray], Places]:
    """Compile the points of a sketch for positions (F, n)."""
    points: list[list[sp.Expr]] = []
    discs: list[list[sp.Expr]] = []
    for part in figure.parts:
        places = part.points if isinstance(part, Line) else (part.centre,)
        points.append([sp.sympify(c) for place in places for c in place])
        round_ = (part.angle, part.radius) if isinstance(part, Disc) else ()
        discs.append([sp.sympify(e) for e in round_])
    tip = [sp.sympify(c) for c in figure.tip]
    everything = [e for row in (*points, *discs, tip) for e in row]
    known = vocabulary(
        mechanism.coordinates, (), mechanism.parameters, velocities=False, time=False
    )
    check_symbols(f"sketch of '{mechanism.name}'", everything, known)
    values = mechanism.substitution
    function = compile_expressions(mechanism.q, [e.xreplace(values) for e in everything])

    def place(q: FloatArray) -> Places:
        columns = [np.broadcast_to(v, len(q)).astype(float) for v in function(*q.T)]
        taken = iter(columns)

        def take(count: int) -> FloatArray:
            rows = [next(taken) for _ in range(count)]
            return np.stack(rows, axis=-1) if rows else np.zeros((len(q), 0))

        at = tuple(take(len(row)).reshape(len(q), -1, 3) for row in points)
        turned = tuple(take(len(row)) for row in discs)
        return at, turned, take(3)

    return place


def _settled(trajectory: Trajectory) -> float:
    """Time from which on all positions stay near the target, and half a second more, s."""
    q = np.abs(trajectory.x[:, : trajectory.mechanism.n])
    scale = np.maximum(q.max(axis=0), 0.2 * q.max())
    moving = np.flatnonzero((q > SETTLED * scale).any(axis=1))
    last = trajectory.t[moving[-1]] if len(moving) else trajectory.t[0]
    return min(float(last) + 0.5, float(trajectory.t[-1]))


def gif(film: Film) -> bytes:
    """Return a film as an endless GIF: the figure, the time, and the inputs as bars."""
    left, right, bottom, top = film.window
    width = 4.2  # inches
    height = float(np.clip(width * (top - bottom) / (right - left), 0.5 * width, 1.3 * width))
    limits = film.mechanism.input_limits
    bar = np.where(np.isfinite(limits), limits, np.abs(film.u).max(axis=0) + 1e-12)
    images = []
    with style():
        figure = Figure(figsize=(width, height + 0.7))
        canvas: Any = FigureCanvasAgg(figure)
        grid = figure.add_gridspec(2, 1, height_ratios=(height, 0.35 * film.mechanism.m))
        scene, gauge = figure.add_subplot(grid[0]), figure.add_subplot(grid[1])
        figure.subplots_adjust(left=0.02, right=0.98, bottom=0.06, top=0.98, hspace=0.02)
        for k in range(len(film.t)):
            scene.clear()
            film.draw(scene, k)
            film.frame(scene, words=False)
            scene.text(
                0.02, 0.98, f"{film.t[k] - film.t[0]:5.2f} s ({film.span}, {film.pace})",
                transform=scene.transAxes, va="top",
            )  # fmt: skip
            gauge.clear()
            _gauge(gauge, film, k, bar)
            canvas.draw()
            images.append(snapshot(canvas))
    return gif_of(images, float(film.t[1] - film.t[0]) / film.speed)


def snapshot(canvas: Any) -> Image.Image:
    """Return what is drawn on a canvas as a picture of few colours."""
    size, data = canvas.get_width_height(), bytes(canvas.buffer_rgba())
    image = Image.frombuffer("RGBA", size, data, "raw", "RGBA", 0, 1)
    return image.convert("RGB").quantize(64, dither=Image.Dither.NONE)


def gif_of(images: Sequence[Image.Image], step: float) -> bytes:
    """Return pictures, ``step`` s apart, as an endless GIF that stays a second on the last one."""
    out = io.BytesIO()
    lengths = [max(20, round(1000.0 * step))] * (len(images) - 1) + [1000]
    images[0].save(
        out, "GIF", save_all=True, append_images=images[1:], duration=lengths, loop=0, optimize=True
    )
    return out.getvalue()


def _gauge(axes: Axes, film: Film, k: int, bar: FloatArray) -> None:
    """Bars of the inputs, full width at the limit, beside their names and values."""
    m = film.mechanism.m
    axes.barh(range(m), film.u[k] / bar, height=0.5, color=COLOURS["vermilion"])
    axes.axvline(0, color=COLOURS["grey"], linewidth=0.8)
    axes.set_xlim(-2.0, 1.02)
    axes.set_ylim(m - 0.5, -0.5)
    for index, channel in enumerate(film.mechanism.inputs):
        text = f"{channel.name} {film.u[k, index]:+.2g} of ±{bar[index]:.3g} {channel.unit}"
        axes.text(-2.0, index, text, va="center", fontsize=7.5, color=COLOURS["black"])
    axes.axis("off")


def still(axes: Axes, film: Film, ghosts: int = 6) -> None:
    """Draw a motion in one picture: faint poses from the start, the last one in full.

    There are so many ghosts besides the last pose, evenly spaced along the tip's path.
    """
    steps = np.linalg.norm(np.diff(film.tip, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(steps)])
    wanted = np.linspace(0, along[-1], ghosts + 1)[:-1]
    picked = sorted({int(np.searchsorted(along, w)) for w in wanted})
    last = len(film.t) - 1
    for place, frame in enumerate(picked):
        if frame < last:
            film.draw(axes, frame, alpha=0.15 + 0.25 * place / max(1, ghosts), trace=False)
    film.draw(axes, last)
    film.frame(axes)


def film_files(film: Film, request: Mapping[str, object]) -> dict[str, bytes]:
    """Return a film as ``NAME.gif`` and ``NAME.png``, and how it was made as ``NAME.json``."""
    with style():
        figure = Figure(figsize=(4.5, 4.5))
        still(figure.add_subplot(), film)
        picture = figure_bytes(figure)
    name = file_name(film.mechanism.name)
    return {
        f"{name}.gif": gif(film),
        f"{name}.png": picture,
        f"{name}.json": manifest("undertow animate", request, frames=len(film.t), shows=film.span),
    }
