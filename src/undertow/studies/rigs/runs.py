"""Runs and replays as tables for the terminal."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence

from rich.console import Group
from rich.table import Table

from undertow.base import facts, printable, table
from undertow.runtime import Histogram, Mode, Replay, Report

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


def run_table(report: Report, period: float, units: Sequence[str], *, simulated: bool) -> Group:
    """Return what came of a run: deadlines, times, states, answers, chattering.

    ``period`` is that of the fast loop, s, ``units`` are those of the inputs; of simulated time no
    times are shown.
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
    variation = ", ".join(
        f"{v / seconds:.4g} {unit or 1}/s"
        for v, unit in zip(report.total_variation, units, strict=True)
    )
    rows += [
        ("answers of the optimiser", verdicts or "none"),
        ("chattering", f"{variation} of total variation"),
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
    if not result.steps:
        same = "nothing to compare: no step was made again"
    elif result.differing:
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
