"""Pictures of a log: motion, output and surface; latency; chattering."""

from __future__ import annotations

import io
import itertools
from typing import Any

import numpy as np

from undertow.models import FloatArray
from undertow.runtime.log import Recording
from undertow.runtime.modes import Mode

__all__ = ["chatter_figure", "latency_figure", "motion_figure"]


#: Colour of each state in the background.
STATES = {
    Mode.IDLE: "#f2f2f2",
    Mode.BRING_UP: "#fde9b8",
    Mode.SWING_UP: "#e3d4f2",
    Mode.CATCH: "#d3e5f7",
    Mode.BALANCE: "#d9f0d9",
    Mode.SAFE_STOP: "#f7d0cc",
}


def _shade(ax: Any, recording: Recording) -> None:
    """Colour the background by the state."""
    t, modes = recording["t"], recording["mode"]
    changes = [0, *(np.flatnonzero(np.diff(modes)) + 1), len(t) - 1]
    for begin, end in itertools.pairwise(changes):
        ax.axvspan(t[begin], t[end], color=STATES[Mode(int(modes[begin]))], lw=0, zorder=0)
    ax.set_xlim(t[0], t[-1])


def _png(figure: Any) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=130)
    return buffer.getvalue()


def _columns(recording: Recording, ending: str) -> list[str]:
    return [name for name in recording.columns if name.endswith(ending)]


def motion_figure(recording: Recording) -> bytes:
    """Return a PNG of positions, inputs and surfaces over time, with the answers taken."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    t = recording["t"]
    positions = [name.removesuffix("_measured") for name in _columns(recording, "_measured")]
    positions = [name for name in positions if not name.endswith("_dot")]
    inputs = [name.removesuffix("_demand") for name in _columns(recording, "_demand")]
    surfaces = [name for name in recording.columns if name.startswith("s_")]
    figure = Figure(figsize=(8, 6.5), layout="constrained")
    axes = figure.subplots(3, 1, sharex=True)
    units = recording.meta.get("units", {})
    for ax, names, label in (
        (axes[0], positions, "position, rad or m"),
        (axes[1], inputs, "output, " + ", ".join(sorted(set(units.values())))),
        (axes[2], surfaces, "surface s"),
    ):
        for name in names:
            ax.plot(t, recording[name], lw=0.9, label=name)
        ax.set_ylabel(label)
        ax.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), frameon=False, ncols=4)
        ax.grid(alpha=0.3)
        _shade(ax, recording)
    axes[0].set_title(
        f"{recording.meta['mechanism']}: {recording.path.name}", fontsize=10, loc="left"
    )
    figure.legend(
        handles=[Patch(color=colour, label=mode.name.replace("_", " ").lower())
                 for mode, colour in STATES.items() if mode in recording["mode"]],
        loc="outside lower center", ncols=6, frameon=False, fontsize=9,
    )  # fmt: skip
    axes[-1].set_xlabel("time, s")
    return _png(figure)


def latency_figure(recording: Recording) -> bytes:
    """Return a PNG of when the output was written, over time and as a distribution."""
    from matplotlib.figure import Figure

    parts = ("late_us", "read_us", "step_us", "write_us")
    times = {name.removesuffix("_us"): recording[name] for name in parts}
    whole = np.sum(list(times.values()), axis=0)
    figure = Figure(figsize=(8, 6), layout="constrained")
    top, bottom = figure.subplots(2, 1)
    top.plot(recording["t"], whole, ".", ms=1.5, color="C0", rasterized=True)
    period = 1e6 * float(recording.meta["period"])
    top.axhline(period, color="C3", lw=1, label=f"deadline, {period:g} µs")
    top.set(yscale="log", xlabel="time, s", ylabel="due to written, µs")
    top.legend(loc="upper right", frameon=False)
    labels = {"late": "woken late", "read": "read", "step": "computation", "write": "write"}
    bottom.plot(*_exceedance(whole), color="k", lw=1.6, label="due to written")
    for name, values in times.items():
        bottom.plot(*_exceedance(values), lw=1, label=labels[name])
    bottom.axvline(period, color="C3", lw=1)
    bottom.set(xscale="log", yscale="log", xlabel="µs", ylabel="part of the steps that take longer")
    bottom.set_xlim(left=0.5)
    bottom.legend(loc="lower left", frameon=False)
    for ax in (top, bottom):
        ax.grid(alpha=0.3)
    return _png(figure)


def _exceedance(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    ordered = np.sort(np.maximum(values[np.isfinite(values)], 0.1))
    return ordered, 1.0 - np.arange(len(ordered)) / max(1, len(ordered))


def chatter_figure(recording: Recording, window: float = 0.1) -> bytes:
    """Return a PNG of the total variation of each input in windows of ``window`` s."""
    from matplotlib.figure import Figure

    inputs = [name.removesuffix("_demand") for name in _columns(recording, "_demand")]
    units = recording.meta.get("units", {})
    count = max(1, round(window / float(recording.meta["period"])))
    figure = Figure(figsize=(8, 3.2), layout="constrained")
    ax = figure.subplots()
    total = 0.0
    for name in inputs:
        steps = np.abs(np.diff(recording[name], prepend=0.0))
        whole = len(steps) // count * count
        variation = steps[:whole].reshape(-1, count).sum(axis=1) / (
            count * float(recording.meta["period"])
        )
        total += float(steps.sum())
        ax.step(recording["t"][:whole:count], variation, where="post", label=name, lw=1)
    unit = ", ".join(sorted(set(units.values())))
    ax.set(
        xlabel="time, s", ylabel=f"total variation, {unit}/s", yscale="symlog",
        title=f"chattering: {total:.4g} {unit} in all, in windows of {window:g} s",
    )  # fmt: skip
    ax.title.set_fontsize(10)
    ax.set_ylim(bottom=0)
    ax.legend(loc="upper right", frameon=False)
    ax.grid(alpha=0.3)
    return _png(figure)
