"""Runs and replays as tables for the terminal, and pictures of their logs."""

from __future__ import annotations

import io
import itertools
import math
from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np
from rich.console import Group
from rich.table import Table

from undertow.base import facts, printable, table
from undertow.models import FloatArray
from undertow.runtime import Columns, Histogram, Mode, Recording, Replay, Report

#: Edges of the histogram of response times, s.
EDGES = (0.0, 50e-6, 100e-6, 200e-6, 500e-6, 1e-3, 2e-3, 5e-3, math.inf)


#: What a replay compares of the processor.
PROCESSOR = ("processor", "target", "features")


def _micro(seconds: float) -> str:
    return f"{1e6 * seconds:,.0f}"


def _times(histograms: Mapping[str, Histogram]) -> Table:
    rows = []
    for name, histogram in histograms.items():
        values = (*(histogram.quantile(p) for p in (0.5, 0.99, 0.999)), histogram.longest)
        rows.append((name, *map(_micro, values)))
    return table(("time, µs", "p50", "p99", "p99.9", "max"), rows, ruled=True)


def _histogram(whole: Histogram) -> Table:
    counts = whole.between(EDGES)
    most, rows = max(1, *counts), []
    for low, high, count in zip(EDGES, EDGES[1:], counts, strict=False):
        label = f"{_micro(low)} to {_micro(high)} µs"
        if math.isinf(high):
            if not count:
                continue
            label = f"over {_micro(low)} µs"
        length = 0 if count == 0 else max(1, round(30 * math.log1p(count) / math.log1p(most)))
        rows.append((label, f"{count:,}", "█" * length))
    return table(("due to written", "steps", ""), rows, left=("",), ruled=True)


def run_table(report: Report, period: float, unit: str, *, simulated: bool) -> Group:
    """Return what came of a run: deadlines, times, states, answers, chattering.

    ``period`` is that of the fast loop, s, ``unit`` that of the inputs; of simulated time no times
    are shown.
    """
    rows = [("steps", f"{report.steps:,}")]
    if not simulated:
        part = report.missed_deadlines / max(1, report.steps)
        rows.append(
            (
                f"missed deadlines, {1e3 * period:g} ms",
                f"{report.missed_deadlines:,} ({part:.3%}), {report.late_wakeups:,} of them woken "
                f"too late by the system; {report.skipped_periods:,} periods skipped",
            )
        )
        if report.lockstep_steps:
            other = report.lockstep_mismatches
            same = f"{other:,} other outputs" if other else "the same outputs"
            rows.append(("lockstep check", f"{report.lockstep_steps:,} steps made again, {same}"))
    for text in report.system:
        what, _, said = text.partition(": ")
        rows.append((what, said))
    states = ["IDLE"]
    states += [t.split(":")[0].split(" → ")[-1] for _, what, t in report.events if what == "state"]
    if len(states) > 10:
        states[6:-3] = [f"{len(states) - 9} more"]
    rows.append(("states", " → ".join(states)))
    if report.mode == Mode.SAFE_STOP:
        rows.append(("stopped by", report.stopped_by))
    failures = Counter(text for _, what, text in report.events if what == "rig")
    rows += [("the rig", f"{count:,} times {text}") for text, count in failures.most_common(3)]
    if report.steps_with_missing_readings:
        rows.append(("readings missing", f"in {report.steps_with_missing_readings:,} steps"))
    verdicts = ", ".join(f"{count} {verdict}" for verdict, count in report.answers.most_common())
    seconds = max(1, report.steps) * period
    variation = ", ".join(f"{v / seconds:.4g}" for v in report.total_variation)
    rows += [
        ("answers of the optimiser", verdicts or "none"),
        ("chattering", f"{variation} {unit or 1}/s of total variation"),
    ]
    lines = facts(rows)
    lines.columns[0].max_width = 24
    if simulated:
        return Group(lines)
    times = {
        "computation of the fast step": report.computation_times,
        "due to written": report.response_times,
        "what follows the output": report.followup_times,
        "woken late": report.wakeup_delays,
    }
    return Group(lines, _times(times), _histogram(report.response_times))


def replay_table(result: Replay) -> Table:
    """Return what came of a replay; what a log says may be anybody's."""
    recording = result.recording
    rows = [("log", f"{recording.path}: {recording.meta['mechanism']}")]
    stops = [(t, text) for _, t, kind, text in recording.events if kind == "state"]
    stopped = "nothing in the log: it was cut off"
    if stops and "SAFE_STOP" in stops[-1][1]:
        t, text = stops[-1]
        stopped = f"{text.partition('SAFE_STOP: ')[2]}, at {t:.3f} s"
    same = f"identical, bit for bit{', to the gap' if result.gap is not None else ''}"
    if result.differing:
        same = f"{result.differing:,} steps differ, the first is {result.first}"
    otherwise = f"{result.misjudged:,} otherwise" if result.misjudged else "all as before"
    rows += [
        ("stopped by", stopped),
        ("steps made again", f"{result.steps:,}"),
        ("outputs, estimates, states", same),
        ("decisions of the gate", f"{result.judged:,} judged again, {otherwise}"),
    ]
    if result.gap is not None:
        rows.append(("gap", f"the log lost step {result.gap}: the replay ends there"))
    for name, (then, now) in result.build.items():
        what = "another processor" if name in PROCESSOR else "another build"
        rows.append((what, f"{name} {then or 'unknown'} then, {now or 'none'} now"))
    rows += [("mechanism", remark) for remark in result.remarks]
    return facts((what, printable(text)) for what, text in rows)


#: Colour of each state in the background.
COLOURS = ("#f2f2f2", "#fde9b8", "#e3d4f2", "#d3e5f7", "#d9f0d9", "#f7d0cc")
STATES = dict(zip(Mode, COLOURS, strict=True))


def _shade(ax: Any, recording: Recording) -> None:
    """Colour the background by the state."""
    t, modes = recording["t"], recording["mode"]
    changes = [0, *(np.flatnonzero(np.diff(modes)) + 1), len(t) - 1]
    for begin, end in itertools.pairwise(changes):
        ax.axvspan(t[begin], t[end], color=STATES[Mode(int(modes[begin]))], lw=0, zorder=0)
    ax.set_xlim(t[0], t[-1])


def _figure(height: float) -> Any:
    from matplotlib.figure import Figure  # takes time, which a run is not worth

    return Figure(figsize=(8, height), layout="constrained")


def _png(figure: Any) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=130)
    return buffer.getvalue()


def motion_figure(recording: Recording) -> bytes:
    """Return a PNG of positions, inputs and surfaces over time, with the answers taken."""
    from matplotlib.patches import Patch

    t = recording["t"]
    positions, inputs, surfaces = Columns.shown(recording.columns)
    figure = _figure(6.5)
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
    parts = ("late_us", "read_us", "step_us", "write_us")
    times = {name.removesuffix("_us"): recording[name] for name in parts}
    whole = np.sum(list(times.values()), axis=0)
    figure = _figure(6)
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


#: Windows in which the total variation of the inputs is shown, s.
WINDOW = 0.1


def chatter_figure(recording: Recording) -> bytes:
    """Return a PNG of the total variation of each input in windows of ``WINDOW`` s."""
    _, inputs, _ = Columns.shown(recording.columns)
    units = recording.meta.get("units", {})
    count = max(1, round(WINDOW / float(recording.meta["period"])))
    figure = _figure(3.2)
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
        xlabel="time, s", ylabel=f"total variation, {unit or 1}/s", yscale="symlog",
        title=f"chattering: {f'{total:.4g} {unit}'.rstrip()} in all, in windows of {WINDOW:g} s",
    )  # fmt: skip
    ax.title.set_fontsize(10)
    ax.set_ylim(bottom=0)
    ax.legend(loc="upper right", frameon=False)
    ax.grid(alpha=0.3)
    return _png(figure)
