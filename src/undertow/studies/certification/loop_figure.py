"""How far off the target the whole closed loop is proved to start, among simulated motions."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from undertow.closed_loop.figures import COLOURS, display, style, symbol_of
from undertow.law import ReachingLaw, SlidingModeLaw, Surface
from undertow.models import FloatArray, Mechanism
from undertow.proofs import LoopClaim
from undertow.proofs.search.closed_loop import follow

#: Starts on one side, up to this many times the proved ones.
STARTS, BEYOND = 100, 4.0

#: How long motions are followed, s.
LONGEST = 15.0


def loop_figure(
    mechanism: Mechanism, surface: Surface, reaching: ReachingLaw, claim: LoopClaim, title: str
) -> Figure:
    """Draw proved and unproved starts at rest with their motions under the clipped law.

    Left: the first coordinate that varies, over time.  Right: the same coordinate and its rate,
    with the shadow of the terminal set, until a motion enters it.
    """
    box, (W, radius) = claim.box(mechanism), claim.terminal(mechanism, surface)
    index = int((box[:, 1] > box[:, 0]).argmax())
    extent = float(box[index, 1])
    ratio = np.linspace(0.0, BEYOND, STARTS + 1)[1:]
    x = np.zeros((STARTS, 2 * mechanism.n))
    x[:, index] = ratio * extent
    law = SlidingModeLaw(mechanism, surface, reaching)
    path, times = follow(law, x, LONGEST, every=1, period=claim.period)
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
        partner = mechanism.n + index
        for k in range(1, last, max(1, last // 16)):
            _motion(left, times, factor * path[:, k, index], ratio[k], bool(home[k]))
            _motion(right, factor * path[:, k, index], rate * path[:, k, partner], ratio[k], True)
        if not home.all():
            _motion(left, times, factor * path[:, last, index], ratio[last], False)
        wide = factor * extent
        bar = {"color": COLOURS["blue"], "solid_capstyle": "butt"}
        left.plot([0, 0], [-wide, wide], lw=6, clip_on=False, zorder=4, **bar)
        shown = factor * path[:, :last, index]
        left.set_ylim(1.1 * min(shown.min(), -wide), 1.1 * factor * x[last, index])
        left.set_xlim(0.0, shown_time)
        left.set_xlabel("t (s)")
        left.set_ylabel(f"{name} ({unit})")
        right.plot([-wide, wide], [0.0, 0.0], lw=4, **bar)
        edge = _shadow(np.asarray(radius * np.linalg.inv(W)[[index, partner]]))
        right.fill(factor * edge[0], rate * edge[1], color=COLOURS["green"], zorder=5)
        right.set_xlabel(f"{name} ({unit})")
        right.set_ylabel(f"d{name}/dt ({rate_unit})")
        handles = [
            Line2D([], [], color=COLOURS["blue"], lw=5, label="proved starts"),
            Line2D([], [], color=COLOURS["blue"], lw=1.2, label="from there"),
            Line2D([], [], color=COLOURS["sky"], lw=1.2, label="from beyond, arrives"),
            Line2D([], [], color=COLOURS["vermilion"], lw=1.2, label=f"not within {LONGEST:.3g} s"),
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


def _motion(axes: Axes, a: FloatArray, b: FloatArray, ratio: float, home: bool) -> None:
    colour = COLOURS["blue"] if ratio <= 1 else COLOURS["sky"] if home else COLOURS["vermilion"]
    axes.plot(a, b, color=colour, lw=0.9)


def _shadow(rows: FloatArray) -> FloatArray:
    """Edge of {rows x, ‖x‖ ≤ 1} in the plane, (2, 181)."""
    u, s, _ = np.linalg.svd(rows, full_matrices=False)
    angle = np.linspace(0, 2 * np.pi, 181)
    return np.asarray(u @ (s[:, None] * np.array([np.cos(angle), np.sin(angle)])))
