"""The proved region on the surface inside the simulated one, with motions."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from undertow.closed_loop.figures import COLOURS, display, style, symbol_of
from undertow.law import SlidingModeLaw
from undertow.models import FloatArray
from undertow.proofs import ProvedRegion, SurfaceMotion
from undertow.proofs.region.lyapunov import extent

#: Points a side of the picture of the simulated region.
GRID = 101


def simulated(region: ProvedRegion, y: FloatArray, *, limit: float = 30.0) -> FloatArray:
    """Whether motions on the surface from points (B, N) enter the proved set, by simulation.

    A motion that has not within ``limit`` seconds, or meets the singularity, does not.
    """
    motion = region.motion
    home = np.zeros(len(y), dtype=bool)
    alive = np.arange(len(y))
    state = y.copy()
    fastest = float(np.abs(np.linalg.eigvals(motion.jacobian)).max())
    step = 0.01 / max(1.0, fastest / 20.0)
    with np.errstate(all="ignore"):
        for _ in range(int(limit / step)):
            inside = region.level(state) < 1.0
            home[alive[inside]] = True
            ratio = motion.margin(state)
            sound = (ratio > 0) & np.isfinite(state).all(axis=1) & (np.abs(state[:, 0]) < 1e3)
            keep = ~inside & sound
            alive, state, ratio = alive[keep], state[keep], ratio[keep]
            if not len(alive):
                break
            state = _step(motion, state, step * _hurry(state, ratio))
    return home


def held(motion: SurfaceMotion, y: FloatArray) -> FloatArray:
    """Return what the actuators have to spare at points y (…, N) of the surface, (…,).

    On the surface the law asks for what keeps the motion there; the smallest 1 − |u_i|/u_max,i is
    below 0 where that is more than an actuator gives: no motion stays on the surface there.
    """
    mechanism, surface = motion.mechanism, motion.surface
    m, free = mechanism.m, mechanism.n - mechanism.m
    flat = y.reshape(-1, motion.size)
    q_u, v_u, w = flat[:, :free], flat[:, free : 2 * free], flat[:, 2 * free :]
    q_a = w - q_u @ np.linalg.solve(surface.lambda_a, surface.lambda_u).T
    pull = w @ surface.lambda_a.T + v_u @ surface.alpha_u.T
    v_a = -np.linalg.solve(surface.alpha_a, pull.T).T
    x = np.hstack([q_a[:, :m], q_u, v_a, v_u])
    with np.errstate(all="ignore"):
        demand = SlidingModeLaw(mechanism, surface)(0.0, x).demand
    spare = (1.0 - np.abs(demand) / mechanism.input_limits).min(axis=-1)
    return np.asarray(np.where(np.isnan(spare), -np.inf, spare)).reshape(y.shape[:-1])


def _hurry(y: FloatArray, ratio: FloatArray) -> FloatArray:
    """Parts of a step, (B, 1), shorter near the singularity and at speed.

    Motions then need not keep the same time.
    """
    return np.asarray(np.clip(ratio, 0.01, 1.0) / (1.0 + 0.3 * np.abs(y).max(axis=1)))[:, None]


def _step(motion: SurfaceMotion, y: FloatArray, h: float | FloatArray) -> FloatArray:
    a = motion(y)
    b = motion(y + 0.5 * h * a)
    c = motion(y + 0.5 * h * b)
    d = motion(y + h * c)
    return np.asarray(y + h / 6 * (a + 2 * b + 2 * c + d))


def region_figure(region: ProvedRegion, title: str) -> Figure:
    """Draw two slices through the proved region, the simulated one, and motions.

    Left: the first unactuated coordinate and its velocity; right: the same coordinate and the
    slow coordinate w = q_a + λ_a⁻¹ λ_u q_u; all others zero.  The motions start on the edge of
    the proved set in the slice, leave the slice, and are seen from the side.

    The motion on the surface knows no input limit.  Where what is drawn has states that the
    actuators cannot hold there, the title says so and a line shows where they end.
    """
    motion = region.motion
    assert isinstance(motion, SurfaceMotion)
    free = motion.mechanism.n - motion.mechanism.m
    with style():
        figure = Figure(figsize=(8.6, 4.3), layout="constrained")
        left, right = figure.subplots(1, 2)
        within = _slice(left, region, free) & _slice(right, region, 2 * free)
        handles = [
            Patch(color=to_rgba(COLOURS["sky"], 0.28), label="simulated: enters the proved set"),
            Patch(color=to_rgba(COLOURS["blue"], 0.55), label="proved region of attraction"),
            Line2D([], [], color=COLOURS["vermilion"], lw=0.9, label="motions on the surface"),
            Line2D([], [], color=COLOURS["black"], lw=1, ls=(0, (4, 2)), label="law singular (37)"),
        ]
        if not within:
            limits = ", ".join(f"{i.limit:g} {i.unit}" for i in motion.mechanism.inputs)
            line = Line2D([], [], color=COLOURS["green"], lw=1.2, ls=":")
            line.set_label(f"beyond: more than {limits} needed")
            handles.append(line)
            title = f"{title}\ninput limit ignored: not all of this can be held with {limits}"
        figure.legend(handles=handles, loc="outside lower center", ncols=3 if not within else 4)
        figure.suptitle(title, fontsize=10)
    return figure


def _slice(axes: Axes, region: ProvedRegion, other: int) -> bool:
    """Draw the plane of coordinates 0 and ``other``; whether the actuators hold all that is filled.

    Both the proved and the simulated set count.
    """
    motion = region.motion
    assert isinstance(motion, SurfaceMotion)
    wide, high = _extents(region, other)
    a, b = np.linspace(-wide, wide, GRID), np.linspace(-high, high, GRID)
    points = np.zeros((GRID, GRID, motion.size))
    points[..., 0], points[..., other] = np.meshgrid(a, b)
    with np.errstate(all="ignore"):
        proved = region.level(points)
    flat = points.reshape(-1, motion.size)
    if motion.odd:  # the picture is the same turned by half a turn
        part = simulated(region, flat[: len(flat) // 2 + 1])
        home = np.concatenate([part, part[:-1][::-1]]).reshape(GRID, GRID)
    else:
        home = simulated(region, flat).reshape(GRID, GRID)
    (fa, ua), (fb, ub) = _units(motion, 0), _units(motion, other)
    axes.contourf(
        fa * a, fb * b, home.astype(float), [0.5, 1.5], colors=[to_rgba(COLOURS["sky"], 0.28)]
    )
    inside = np.where(np.isfinite(proved), proved, 2.0)
    axes.contourf(fa * a, fb * b, inside, [-1.0, 1.0], colors=[to_rgba(COLOURS["blue"], 0.55)])
    axes.contour(fa * a, fb * b, inside, [1.0], colors=COLOURS["blue"], linewidths=1.2)
    edge = _edge(region, other)
    path = [edge]
    for _ in range(6000):
        hurry = _hurry(path[-1], motion.margin(path[-1]))
        path.append(_step(motion, path[-1], 0.01 * hurry))
    lines = np.array(path)
    for k in range(lines.shape[1]):
        axes.plot(fa * lines[:, k, 0], fb * lines[:, k, other], color=COLOURS["vermilion"], lw=0.8)
    axes.plot(fa * edge[:, 0], fb * edge[:, other], ".", color=COLOURS["vermilion"], ms=4, zorder=3)
    axes.plot(0, 0, "+", color=COLOURS["black"], ms=7, zorder=4)
    side = np.sign(float(motion.determinant(np.zeros(motion.size))))
    ratio = side * motion.determinant(points)
    if (ratio <= 0).any():
        axes.contour(
            fa * a, fb * b, ratio, [0.0], colors=COLOURS["black"], linewidths=1.0, linestyles="--"
        )
    spare = held(motion, points)
    within = bool((spare[home | (inside <= 1.0)] >= 0).all())
    if not within:
        shown = np.where(ratio > 0, np.maximum(spare, -10.0), np.nan)
        axes.contour(
            fa * a, fb * b, shown, [0.0], colors=COLOURS["green"], linewidths=1.2, linestyles=":"
        )
    axes.set_xlim(-fa * wide, fa * wide)
    axes.set_ylim(-fb * high, fb * high)
    axes.set_xlabel(ua)
    axes.set_ylabel(ub)
    return within


def _extents(region: ProvedRegion, other: int) -> tuple[float, float]:
    """Half-sides of the picture: what is proved, with room around."""
    edge = _edge(region, other, 64)
    reach = np.abs(edge).max(axis=0)
    motion = region.motion
    far = np.linspace(0.0, 4.0 * reach[0], 2001)
    points = np.zeros((len(far), motion.size))
    points[:, 0] = far
    side = np.sign(float(motion.determinant(np.zeros(motion.size))))
    singular = far[side * motion.determinant(points) <= 0]
    wide = 1.15 * singular[0] if len(singular) else 2.5 * reach[0]
    return max(float(wide), 1.2 * float(reach[0])), 3.2 * float(reach[other])


def _edge(region: ProvedRegion, other: int, count: int = 14) -> FloatArray:
    """Points just inside V = 1 in the slice, in directions spread evenly, (count, N)."""
    motion = region.motion
    size = np.array([_first(region, 0), _first(region, other)])
    angles = 2 * np.pi * (np.arange(count) + 0.5) / count
    rays = np.zeros((count, motion.size))
    rays[:, 0], rays[:, other] = size[0] * np.cos(angles), size[1] * np.sin(angles)
    parts = np.linspace(0.0, 3.0, 1201)
    with np.errstate(all="ignore"):
        above = ~(region.level(parts[:, None, None] * rays) < 1.0)
    first = np.maximum(above.argmax(axis=0) - 1, 0)
    return np.asarray(0.999 * parts[first][:, None] * rays)


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
        coordinate = mechanism.coordinates[m + index % free]
        factor, unit = display(coordinate.unit, index >= free)
        return factor, f"{symbol_of(coordinate.name, index >= free)} ({unit})"
    coordinate = mechanism.coordinates[index - 2 * free]
    factor, unit = display(coordinate.unit)
    other = symbol_of(mechanism.coordinates[m].name) if free == 1 else "q_u"
    return factor, f"w = {symbol_of(coordinate.name)} + λₐ⁻¹λᵤ {other} ({unit})"
