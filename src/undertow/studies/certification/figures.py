"""What is proved, drawn among simulated motions: a region on the surface, starts of the loop."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from undertow.closed_loop import ClosedLoop
from undertow.closed_loop.figures import COLOURS, display, label_of, style, symbol_of
from undertow.law import ReachingLaw, SlidingModeLaw, Surface
from undertow.models import FloatArray, Mechanism
from undertow.objective import MinimumTime
from undertow.proofs import LoopClaim, ProvedRegion, SurfaceMotion
from undertow.proofs.region.lyapunov import extent
from undertow.proofs.search.closed_loop import follow

#: Points a side of the picture, and of the looks that find how far it reaches.
GRID, COARSE = 101, 25

#: How long motions are followed, s, and how many of each slice are drawn.
LONGEST, DRAWN = 30.0, 14


def held(motion: SurfaceMotion, y: FloatArray) -> FloatArray:
    """Return what the actuators have to spare at points y (…, N) of the surface, (…,).

    On the surface the law asks for what keeps the motion there; the smallest 1 − |u_i|/u_max,i is
    below 0 where that is more than an actuator gives: no motion stays on the surface there.
    """
    x = motion.surface.on_surface(y).reshape(-1, 2 * motion.mechanism.n)
    with np.errstate(all="ignore"):
        demand = SlidingModeLaw(motion.mechanism, motion.surface)(0.0, x).demand
        spare = (1.0 - np.abs(demand) / motion.mechanism.input_limits).min(axis=-1)
    return np.asarray(np.where(np.isnan(spare), -np.inf, spare)).reshape(y.shape[:-1])


def region_figure(region: ProvedRegion, reaching: ReachingLaw, title: str) -> Figure:
    """Draw two slices through the proved region, and which starts on the surface come home.

    Left: the first unactuated coordinate and its velocity; right: the same coordinate and the
    slow coordinate w = q_a + λ_a⁻¹ λ_u q_u; all others zero.  What is simulated is the whole
    closed loop with its input limit, and the picture is as wide as what comes home, at most three
    times as high as what is proved.  What is proved is the motion on the surface, which knows no
    input limit: it is filled where the actuators can keep the motion there.  The motions drawn
    start on that part's edge, leave the slice, and are seen from the side.

    Parameters
    ----------
    region
        What is proved.
    reaching
        The law's reaching part, η and ε.
    title
        What stands above.
    """
    motion = region.motion
    free = motion.mechanism.n - motion.mechanism.m
    loop = ClosedLoop(motion.mechanism, MinimumTime(horizon=LONGEST), reaching=reaching)
    given = ", ".join(f"{i.limit:g} {i.unit}" for i in motion.mechanism.inputs)
    with style():
        figure = Figure(figsize=(8.6, 4.5), layout="constrained")
        left, right = figure.subplots(1, 2)
        _slice(left, region, loop, free)
        _slice(right, region, loop, 2 * free)
        handles = [
            Patch(color=to_rgba(COLOURS["sky"], 0.28), label=f"comes home with {given}, simulated"),
            Line2D([], [], color=COLOURS["blue"], lw=1.2, label="proved, input not limited"),
            Patch(color=to_rgba(COLOURS["blue"], 0.55), label=f"of it: {given} keep the surface"),
            Line2D([], [], color=COLOURS["vermilion"], lw=0.9, label=f"motions with {given}"),
            Line2D([], [], color=COLOURS["green"], lw=1.2, ls=":", label=f"{given} needed"),
            Line2D([], [], color=COLOURS["black"], lw=1, ls=(0, (4, 2)), label="law singular (37)"),
        ]
        figure.legend(handles=handles, loc="outside lower center", ncols=3)
        figure.suptitle(title, fontsize=10)
    return figure


def _slice(axes: Axes, region: ProvedRegion, loop: ClosedLoop, other: int) -> None:
    """Draw the plane of coordinates 0 and ``other``."""
    motion = region.motion
    surface = motion.surface

    def home(y: FloatArray) -> NDArray[np.bool_]:
        """Whether the closed loop comes home from points (B, N)."""
        return loop.batch(surface.on_surface(y), surface.vector).reached

    wide, high = _extents(region, home, other)
    grid = _grid(motion, wide, high, other, GRID)
    flat = grid.reshape(-1, motion.size)
    if motion.odd:  # the picture is the same turned by half a turn
        part = home(flat[: len(flat) // 2 + 1])
        comes = np.concatenate([part, part[:-1][::-1]])
    else:
        comes = home(flat)
    with np.errstate(all="ignore"):
        level = region.level(grid)
    inside = np.where(np.isfinite(level), level, 2.0)
    spare = held(motion, grid)
    ratio = motion.margin(grid)
    (fa, ua), (fb, ub) = _units(motion, 0), _units(motion, other)
    a, b = fa * grid[0, :, 0], fb * grid[:, 0, other]
    sky, blue = (to_rgba(COLOURS[c], part) for c, part in (("sky", 0.28), ("blue", 0.55)))
    axes.contourf(a, b, comes.reshape(GRID, GRID).astype(float), [0.5, 1.5], colors=[sky])
    kept = np.maximum(inside, 1.0 - spare)  # at most 1 where both are so
    axes.contourf(a, b, np.minimum(kept, 9.0), [-1.0, 1.0], colors=[blue])
    axes.contour(a, b, inside, [1.0], colors=COLOURS["blue"], linewidths=1.2)
    for x in surface.on_surface(_edge(region, other)):
        y = surface.sliding_coordinates(loop.simulate(x, surface).x)
        axes.plot(fa * y[:, 0], fb * y[:, other], color=COLOURS["vermilion"], lw=0.8)
        axes.plot(fa * y[0, 0], fb * y[0, other], ".", color=COLOURS["vermilion"], ms=4, zorder=3)
    axes.plot(0, 0, "+", color=COLOURS["black"], ms=7, zorder=4)
    for value, colour, line in (
        (np.where(ratio > 0, np.maximum(spare, -10.0), np.nan), "green", ":"),
        (ratio, "black", "--"),
    ):
        if np.nanmin(value) < 0 < np.nanmax(value):
            axes.contour(
                a, b, value, [0.0], colors=COLOURS[colour], linewidths=1.2, linestyles=line
            )
    axes.set_xlim(-fa * wide, fa * wide)
    axes.set_ylim(-fb * high, fb * high)
    axes.set_xlabel(ua)
    axes.set_ylabel(ub)


def _grid(motion: SurfaceMotion, wide: float, high: float, other: int, side: int) -> FloatArray:
    """Points of a slice, (side, side, N)."""
    grid = np.zeros((side, side, motion.size))
    grid[..., 0], grid[..., other] = np.meshgrid(
        np.linspace(-wide, wide, side), np.linspace(-high, high, side)
    )
    return grid


def _extents(
    region: ProvedRegion, home: Callable[[FloatArray], NDArray[np.bool_]], other: int
) -> tuple[float, float]:
    """Half-sides of the picture: what comes home, with room around; at most 3 × what is proved."""
    motion = region.motion
    reach = np.array([_first(region, 0), _first(region, other)])
    far = np.linspace(0.0, 4.0 * reach[0], 2001)
    line = np.zeros((len(far), motion.size))
    line[:, 0] = far
    singular = far[motion.margin(line) <= 0]
    widest = singular[0] if len(singular) else 2.5 * reach[0]
    sides = np.array([max(float(widest), reach[0]), 3.0 * reach[1]])
    for _ in range(8):
        grid = _grid(motion, sides[0], sides[1], other, COARSE).reshape(-1, motion.size)
        come = np.abs(grid[home(grid)][:, [0, other]])
        if not len(come):
            sides /= 4.0
            continue
        seen = np.minimum(sides, come.max(axis=0) + 2.0 * sides / COARSE)
        if (seen >= 0.5 * sides).all():
            return float(1.1 * seen[0]), float(1.1 * seen[1])
        sides = seen
    return float(sides[0]), float(sides[1])


def _edge(region: ProvedRegion, other: int) -> FloatArray:
    """Points just inside what is proved and kept, in directions spread evenly, (DRAWN, N)."""
    motion = region.motion
    size = np.array([_first(region, 0), _first(region, other)])
    angles = 2 * np.pi * (np.arange(DRAWN) + 0.5) / DRAWN
    rays = np.zeros((DRAWN, motion.size))
    rays[:, 0], rays[:, other] = size[0] * np.cos(angles), size[1] * np.sin(angles)
    parts = np.geomspace(1e-3, 3.0, 600)
    along = parts[:, None, None] * rays
    with np.errstate(all="ignore"):
        beyond = ~(region.level(along) < 1.0) | (held(motion, along) < 0)
    first = np.maximum(beyond.argmax(axis=0) - 1, 0)
    return np.asarray(0.99 * parts[first][:, None] * rays)


def _first(region: ProvedRegion, axis: int) -> float:
    """Where the proved set ends along an axis."""
    way = np.zeros(region.motion.size)
    way[axis] = 1.0
    found = extent(region.function, way)
    return found if np.isfinite(found) else 1.0


def _units(motion: SurfaceMotion, index: int) -> tuple[float, str]:
    """Return the factor to display units and the label of a coordinate of y."""
    mechanism = motion.mechanism
    m, free = mechanism.m, mechanism.n - mechanism.m
    if index < 2 * free:
        return label_of(mechanism.coordinates[m + index % free], index >= free)
    coordinate = mechanism.coordinates[index - 2 * free]
    factor, unit = display(coordinate.unit)
    other = symbol_of(mechanism.coordinates[m].name) if free == 1 else "q_u"
    return factor, f"w = {symbol_of(coordinate.name)} + λₐ⁻¹λᵤ {other} ({unit})"


# -- the whole closed loop -----------------------------------------------------------------------

#: Starts on one side, up to this many times the proved ones.
STARTS, BEYOND = 100, 4.0

#: How long their motions are followed, s.
FOLLOWED = 15.0


def loop_figure(
    mechanism: Mechanism, surface: Surface, reaching: ReachingLaw, claim: LoopClaim, title: str
) -> Figure:
    """Draw proved and unproved starts with their motions under the clipped law.

    Motions begin on the way to the outermost corner of the starts, and beyond it.  Left: the first
    coordinate that varies, itself or its rate, over time.  Right: the same coordinate and its rate,
    with the shadow of the terminal set, until a motion enters it.
    """
    box, (W, radius) = claim.box(mechanism), claim.terminal(mechanism, surface)
    index = int((box[:, 1] > box[:, 0]).argmax()) % mechanism.n
    partner = mechanism.n + index
    ratio = np.linspace(0.0, BEYOND, STARTS + 1)[1:]
    x = ratio[:, None] * box[:, 1]
    law = SlidingModeLaw(mechanism, surface, reaching)
    path, times = follow(law, x, FOLLOWED, every=1, period=claim.period)
    with np.errstate(all="ignore"):
        inside = np.linalg.norm(path @ W.T, axis=-1) <= radius
    home = inside.any(axis=0)
    # Beyond the first start that fails nothing is promised: one more is shown, no others.
    last = STARTS - 1 if home.all() else int(np.argmin(home))
    proved = inside[:, ratio <= 1.0].argmax(axis=0).max()
    shown_time = max(1.0, 1.25 * float(times[proved]))
    coordinate = mechanism.coordinates[index]
    factor, unit = display(coordinate.unit)
    rate, rate_unit = display(coordinate.unit, True)
    name = symbol_of(coordinate.name)
    with style():
        figure = Figure(figsize=(8.6, 4.0), layout="constrained")
        left, right = figure.subplots(1, 2)
        for k in range(1, last, max(1, last // 16)):
            _line(left, times, factor * path[:, k, index], ratio[k], bool(home[k]))
            _line(right, factor * path[:, k, index], rate * path[:, k, partner], ratio[k], True)
        if not home.all():
            _line(left, times, factor * path[:, last, index], ratio[last], False)
        wide, high = factor * box[index, 1], rate * box[partner, 1]
        bar = {"color": COLOURS["blue"], "solid_capstyle": "butt", "solid_joinstyle": "bevel"}
        left.plot([0, 0], [-wide, wide], lw=6, clip_on=False, zorder=4, **bar)
        shown = factor * path[times <= shown_time, :last, index]
        farthest = max(shown.max(), factor * x[last, index])
        left.set_ylim(1.1 * min(shown.min(), -wide), 1.1 * farthest)
        left.set_xlim(0.0, shown_time)
        left.set_xlabel("t (s)")
        left.set_ylabel(f"{name} ({unit})")
        corners = [wide, wide, -wide, -wide, wide], [-high, high, high, -high, -high]
        right.plot(*corners, lw=4, **bar)
        edge = _shadow(np.asarray(radius * np.linalg.inv(W)[[index, partner]]))
        right.fill(factor * edge[0], rate * edge[1], color=COLOURS["green"], zorder=5)
        right.set_xlim(left.get_ylim())
        right.set_xlabel(f"{name} ({unit})")
        right.set_ylabel(f"d{name}/dt ({rate_unit})")
        handles = [
            Line2D([], [], color=COLOURS["blue"], lw=5, label="proved starts"),
            Line2D([], [], color=COLOURS["blue"], lw=1.2, label="from there"),
            Line2D([], [], color=COLOURS["sky"], lw=1.2, label="from beyond, arrives"),
            Line2D(
                [], [], color=COLOURS["vermilion"], lw=1.2, label=f"not within {FOLLOWED:.3g} s"
            ),
            Patch(color=COLOURS["green"], label="proved terminal set"),
        ]
        if home.all():
            del handles[3]
        figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))
        figure.suptitle(f"{title}\n{_conditions(mechanism, claim.period)}", fontsize=10)
    return figure


def _conditions(mechanism: Mechanism, period: float) -> str:
    limits = ", ".join(
        f"|{symbol_of(i.name)}| ≤ {i.limit:g} {i.unit}".rstrip() for i in mechanism.inputs
    )
    return f"{limits}, " + (
        f"held for {1e3 * period:g} ms" if period else "renewed at every instant"
    )


def _line(axes: Axes, a: FloatArray, b: FloatArray, ratio: float, home: bool) -> None:
    colour = COLOURS["blue"] if ratio <= 1 else COLOURS["sky"] if home else COLOURS["vermilion"]
    axes.plot(a, b, color=colour, lw=0.9)


def _shadow(rows: FloatArray) -> FloatArray:
    """Edge of {rows x, ‖x‖ ≤ 1} in the plane, (2, 181)."""
    u, s, _ = np.linalg.svd(rows, full_matrices=False)
    angle = np.linspace(0, 2 * np.pi, 181)
    return np.asarray(u @ (s[:, None] * np.array([np.cos(angle), np.sin(angle)])))
