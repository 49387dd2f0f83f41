"""Runs and replays as tables for the terminal."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

from rich import box
from rich.console import Group
from rich.markup import escape
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from undertow.base import printable
from undertow.runtime.clock import Histogram
from undertow.runtime.drill import Outcome
from undertow.runtime.drill_live import Killed, LiveOutcome
from undertow.runtime.failing import OPERATIONS
from undertow.runtime.modes import Mode
from undertow.runtime.replay import Replay
from undertow.runtime.systematic import RIGS, Case
from undertow.runtime.verdict import Report

__all__ = ["drill_table", "kill_table", "replay_table", "run_table", "systematic_table"]

#: Edges of the histogram of response times, s.
EDGES = (0.0, 50e-6, 100e-6, 200e-6, 500e-6, 1e-3, 2e-3, 5e-3, math.inf)


#: Look of every table: no frame, as in the trials.
_PLAIN: dict[str, Any] = {"box": box.SIMPLE_HEAD, "pad_edge": False, "padding": (0, 1, 0, 0)}


#: What a replay compares of the processor.
PROCESSOR = ("processor", "target", "features")


def _shown(text: str) -> str:
    """Return what a log says as a terminal may show it: it may be anybody's."""
    return escape(printable(text))


def _micro(seconds: float) -> str:
    return f"{1e6 * seconds:,.0f}"


def _times(rows: Iterable[tuple[str, Histogram]]) -> Table:
    table = Table("time, µs", "p50", "p99", "p99.9", "max", **_PLAIN)
    for column in table.columns[1:]:
        column.justify = "right"
    for name, histogram in rows:
        values = [histogram.quantile(p) for p in (0.5, 0.99, 0.999)]
        table.add_row(name, *map(_micro, (*values, histogram.longest)))
    return table


def _histogram(whole: Histogram) -> Table:
    table = Table("due to written", "steps", "", **_PLAIN)
    table.columns[1].justify = "right"
    counts = whole.between(EDGES)
    most = max(1, *counts)
    for low, high, count in zip(EDGES, EDGES[1:], counts, strict=False):
        label = (
            f"over {_micro(low)} µs" if math.isinf(high) else f"{_micro(low)} to {_micro(high)} µs"
        )
        if math.isinf(high) and not count:
            continue
        length = 0 if count == 0 else max(1, round(30 * math.log1p(count) / math.log1p(most)))
        table.add_row(label, f"{count:,}", "█" * length)
    return table


def run_table(report: Report, period: float, unit: str, *, simulated: bool) -> Group:
    """Return what came of a run: deadlines, times, states, answers, chattering.

    Parameters
    ----------
    report
        The run.
    period
        Of the fast loop, s.
    unit
        Of the inputs.
    simulated
        Whether the time was simulated: then no times are shown.
    """
    lines = Table.grid(padding=(0, 2))
    lines.add_column(max_width=24)
    lines.add_row("steps", f"{report.steps:,}")
    if not simulated:
        part = report.missed / max(1, report.steps)
        lines.add_row(
            f"missed deadlines, {1e3 * period:g} ms",
            f"{report.missed:,} ({part:.3%}), {report.asleep:,} of them woken too late by the "
            f"system; {report.skipped:,} periods skipped",
        )
        same = "the same outputs" if not report.disagreed else f"{report.disagreed:,} other outputs"
        if report.shadowed:
            lines.add_row("shadow", f"{report.shadowed:,} steps made again, {same}")
    for text in report.system:
        what, _, said = text.partition(": ")
        lines.add_row(what, escape(said))
    states = ["IDLE"]
    states += [t.split(":")[0].split(" → ")[-1] for _, what, t in report.events if what == "state"]
    if len(states) > 10:
        states[6:-3] = [f"{len(states) - 9} more"]
    lines.add_row("states", " → ".join(states))
    if report.mode == Mode.SAFE_STOP:
        lines.add_row("stopped by", escape(report.stopped_by))
    failures = Counter(text for _, what, text in report.events if what == "rig")
    for text, count in failures.most_common(3):
        lines.add_row("the rig", escape(f"{count:,} times {text}"))
    if report.missing:
        lines.add_row("readings missing", f"in {report.missing:,} steps")
    verdicts = ", ".join(f"{count} {verdict}" for verdict, count in report.answers.most_common())
    lines.add_row("answers of the optimiser", verdicts or "none")
    seconds = max(1, report.steps) * period
    variation = ", ".join(f"{v / seconds:.4g}" for v in report.variation)
    lines.add_row("chattering", f"{variation} {unit}/s of total variation")
    if simulated:
        return Group(lines)
    times = _times(
        (
            ("computation of the fast step", report.think),
            ("due to written", report.whole),
            ("what follows the output", report.rest),
            ("woken late", report.late),
        )
    )
    return Group(lines, times, _histogram(report.whole))


def replay_table(result: Replay) -> Table:
    """Return what came of a replay."""
    table = Table.grid(padding=(0, 2))
    recording = result.recording
    table.add_row("log", _shown(f"{recording.path}: {recording.meta['mechanism']}"))
    stops = [(t, text) for _, t, kind, text in recording.events if kind == "state"]
    if stops and "SAFE_STOP" in stops[-1][1]:
        t, text = stops[-1]
        table.add_row("stopped by", _shown(f"{text.partition('SAFE_STOP: ')[2]}, at {t:.3f} s"))
    else:
        table.add_row("stopped by", "nothing in the log: it was cut off")
    table.add_row("steps made again", f"{result.steps:,}")
    table.add_row(
        "outputs, estimates, states",
        f"identical, bit for bit{', to the gap' if result.gap is not None else ''}"
        if not result.differing
        else f"{result.differing:,} steps differ, the first is {result.first}",
    )
    table.add_row(
        "decisions of the gate",
        f"{result.judged:,} judged again, "
        + ("all as before" if not result.misjudged else f"{result.misjudged:,} otherwise"),
    )
    if result.gap is not None:
        table.add_row("gap", f"the log lost step {result.gap}: the replay ends there")
    for name, (then, now) in result.build.items():
        what = "another processor" if name in PROCESSOR else "another build"
        table.add_row(what, _shown(f"{name} {then or 'unknown'} then, {now or 'none'} now"))
    for remark in result.remarks:
        table.add_row("mechanism", _shown(remark))
    return table


def drill_table(outcomes: Sequence[Outcome], live: Sequence[LiveOutcome] = ()) -> Table:
    """Return what happened in the drill, a row a fault, under what fails."""
    table = Table("what fails, and how", "what happened", "verdict", "|u|/limit", "", **_PLAIN)
    table.columns[0].ratio, table.columns[1].ratio = 4, 6
    table.columns[3].justify = "right"
    part = ""
    for outcome in outcomes:
        case = outcome.case
        if case.part != part:
            part = case.part
            table.add_row(f"[bold]{part}[/bold]")
        happened = escape(outcome.happened)
        if not outcome.replayed:
            happened += "; [red]its replay differs[/red]"
        table.add_row(
            _indented(case.name),
            happened,
            f"{outcome.verdict.ending} {outcome.verdict.exit_code}",
            f"{outcome.largest:.0%}",
            _mark(outcome.passed),
        )
    for number, one in enumerate(live):
        if number == 0:
            table.add_row("[bold]against the clock[/bold]")
        table.add_row(
            _indented(f"{one.part}: {one.name}"), escape(one.happened), "", "", _mark(one.passed)
        )
    return table


def kill_table(killed: Sequence[Killed]) -> Group:
    """Return what was left of runs that were killed, and of those that had stopped before."""
    table = Table(
        "killed at, s", "steps", "missing, ms", "idle, ms", "replay", "zero, ms", "", **_PLAIN
    )
    for column in table.columns[:6]:
        column.justify = "right"
    running = [one for one in killed if not one.stopped_by]
    for one in killed:
        table.add_row(
            f"{one.moment:.3f}",
            f"{one.steps:,}",
            "had stopped" if one.stopped_by else f"{1e3 * one.missing:.0f}",
            "" if one.stopped_by else f"{1e3 * one.idle:.0f}",
            "same bits" if one.identical else "[red]differs[/red]",
            f"{1e3 * one.to_zero:.0f}",
            _mark(one.passed),
        )
    table.add_section()
    table.add_row(
        f"{len(killed)} runs",
        "",
        f"≤ {1e3 * max((one.missing for one in running), default=math.nan):.0f}",
        f"≤ {1e3 * max((one.idle for one in running), default=math.nan):.0f}",
        f"{sum(one.identical for one in killed)} same",
        f"≤ {1e3 * max(one.to_zero for one in killed):.0f}",
        f"{sum(one.passed for one in killed)} of {len(killed)}",
    )
    reasons = Counter(one.stopped_by for one in killed if one.stopped_by)
    lines = [
        Text(f"{count} had stopped safely before the kill, and another was killed: {reason}")
        for reason, count in reasons.most_common()
    ]
    return Group(table, *lines)


def systematic_table(cases: Sequence[Case]) -> Group:
    """Return how many systematic faults passed, by operation and rig, and which did not."""
    table = Table("what fails", *RIGS, "cases", "passed", "", **_PLAIN)
    for column in table.columns[1:-1]:
        column.justify = "right"
    for operation in OPERATIONS:
        here = [case for case in cases if case.fault.operation == operation]
        if not here:
            continue
        by_rig = [sum(case.fault.rig == rig for case in here) for rig in RIGS]
        passed = sum(case.passed for case in here)
        counts = [f"{n:,}" for n in (*by_rig, len(here), passed)]
        table.add_row(operation, *counts, _mark(passed == len(here)))
    lines = [
        Text(f"{case.fault}: {'; '.join(case.wrong)} ({case.happened})")
        for case in cases
        if not case.passed
    ]
    return Group(table, *lines)


def _indented(text: str) -> Padding:
    return Padding(escape(text), (0, 0, 0, 2))


def _mark(passed: bool) -> str:
    return "[green]✓[/green]" if passed else "[red]✗[/red]"
