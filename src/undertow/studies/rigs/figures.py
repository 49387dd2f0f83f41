"""The log of a run, drawn: its motion, how late its outputs were, how much they chatter."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from undertow.closed_loop.figures import figure_files, style
from undertow.models import FloatArray
from undertow.runtime import Columns, Mode, Recording

#: Colour of each state in the background.
COLOURS = ("#f2f2f2", "#fde9b8", "#e3d4f2", "#d3e5f7", "#d9f0d9", "#f7d0cc")
STATES = dict(zip(Mode, COLOURS, strict=True))

#: Windows in which the total variation of the inputs is shown, s.
WINDOW = 0.1


def pictures(recording: Recording) -> dict[str, bytes]:
    """Return ``motion.png``, ``latency.png`` and ``chatter.png``."""
    with style():
        drawn = {
            "motion": motion_figure(recording),
            "latency": latency_figure(recording),
            "chatter": chatter_figure(recording),
        }
    return figure_files(drawn)


def motion_figure(recording: Recording) -> Figure:
    """Draw positions, inputs and surfaces over time, with the answers taken."""
    t = recording["t"]
    positions, inputs, surfaces = Columns.shown(recording.columns)
    figure = Figure(figsize=(8, 6.5), layout="constrained")
    axes = figure.subplots(3, 1, sharex=True)
    for ax, names, label in (
        (axes[0], positions, "position, rad or m"),
        (axes[1], inputs, f"output, {_unit(recording)}"),
        (axes[2], surfaces, "surface s"),
    ):
        for name in names:
            ax.plot(t, recording[name], lw=0.9, label=name)
        ax.set_ylabel(label)
        ax.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=4)
        _shade(ax, recording)
    axes[0].set_title(f"{recording.meta['mechanism']}: {recording.path.name}", loc="left")
    modes = {mode: colour for mode, colour in STATES.items() if mode in recording["mode"]}
    figure.legend(
        handles=[Patch(color=colour, label=mode.name.replace("_", " ").lower())
                 for mode, colour in modes.items()],
        loc="outside lower center", ncols=6,
    )  # fmt: skip
    axes[-1].set_xlabel("time, s")
    return figure


def _unit(recording: Recording) -> str:
    return ", ".join(sorted(set(recording.meta.get("units", {}).values())))


def _shade(ax: Axes, recording: Recording) -> None:
    """Colour the background by the state."""
    t, modes = recording["t"], recording["mode"]
    changes = [0, *(np.flatnonzero(np.diff(modes)) + 1), len(t) - 1]
    for begin, end in pairwise(changes):
        ax.axvspan(t[begin], t[end], color=STATES[Mode(int(modes[begin]))], lw=0, zorder=0)
    ax.set_xlim(t[0], t[-1])


def latency_figure(recording: Recording) -> Figure:
    """Draw when the output was written, over time and as a distribution."""
    labels = {"late": "woken late", "read": "read", "step": "computation", "write": "write"}
    times = {name: recording[f"{name}_us"] for name in labels}
    whole = np.sum(list(times.values()), axis=0)
    period = 1e6 * float(recording.meta["period"])
    figure = Figure(figsize=(8, 6), layout="constrained")
    top, bottom = figure.subplots(2, 1)
    top.plot(recording["t"], whole, ".", ms=1.5, color="C0", rasterized=True)
    top.axhline(period, color="C3", lw=1, label=f"deadline, {period:g} µs")
    top.set(yscale="log", xlabel="time, s", ylabel="due to written, µs")
    top.legend(loc="upper right")
    bottom.plot(*_exceedance(whole), color="k", lw=1.6, label="due to written")
    for name, values in times.items():
        bottom.plot(*_exceedance(values), lw=1, label=labels[name])
    bottom.axvline(period, color="C3", lw=1)
    bottom.set(xscale="log", yscale="log", xlabel="µs", ylabel="part of the steps that take longer")
    bottom.set_xlim(left=0.5)
    bottom.legend(loc="lower left")
    return figure


def _exceedance(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    ordered = np.sort(np.maximum(values[np.isfinite(values)], 0.1))
    return ordered, 1.0 - np.arange(len(ordered)) / max(1, len(ordered))


def chatter_figure(recording: Recording) -> Figure:
    """Draw the total variation of each input in windows of ``WINDOW`` s."""
    _, inputs, _ = Columns.shown(recording.columns)
    period, units = float(recording.meta["period"]), recording.meta.get("units", {})
    count = max(1, round(WINDOW / period))
    figure = Figure(figsize=(8, 3.2), layout="constrained")
    ax = figure.subplots()
    for name in inputs:
        steps = np.abs(np.diff(recording[name], prepend=0.0))
        whole = len(steps) // count * count
        variation = steps[:whole].reshape(-1, count).sum(axis=1) / (count * period)
        unit = units.get(name, "")
        label = f"{name}, {unit or 1}/s: {f'{steps.sum():.4g} {unit}'.rstrip()} in all"
        ax.step(recording["t"][:whole:count], variation, where="post", label=label, lw=1)
    ax.set(
        xlabel="time, s", ylabel="total variation of each input", yscale="symlog",
        title=f"chattering, in windows of {WINDOW:g} s",
    )  # fmt: skip
    ax.set_ylim(bottom=0)
    ax.legend(loc="upper right")
    return figure
