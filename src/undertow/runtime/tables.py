"""Runs and replays as tables for the terminal."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from rich.console import Group
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from undertow.runtime.clock import Histogram
from undertow.runtime.drill import Outcome
from undertow.runtime.drill_live import Killed, LiveOutcome
from undertow.runtime.loop import Report
from undertow.runtime.modes import Mode
from undertow.runtime.replay import Replay

__all__ = ["drill_table", "kill_table", "replay_table", "run_table"]

#: Edges of the histogram of response times, s.
EDGES = (0.0, 50e-6, 100e-6, 200e-6, 500e-6, 1e-3, 2e-3, 5e-3, math.inf)


def _micro(seconds: float) -> str:
    return f"{1e6 * seconds:,.0f}"


def _times(rows: Iterable[tuple[str, Histogram]]) -> Table:
    table = Table("time, µs", "p50", "p99", "p99.9", "max", title_justify="left")
    for column in table.columns[1:]:
        column.justify = "right"
    for name, histogram in rows:
        values = [histogram.quantile(p) for p in (0.5, 0.99, 0.999)]
        table.add_row(name, *map(_micro, (*values, histogram.longest)))
    return table


def _histogram(whole: Histogram) -> Table:
    table = Table("due to written", "steps", "", title_justify="left")
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
    lines.add_row("steps", f"{report.steps:,}")
    if not simulated:
        part = report.missed / max(1, report.steps)
        lines.add_row(
            f"missed deadlines of {1e3 * period:g} ms",
            f"{report.missed:,} ({part:.3%}), {report.asleep:,} of them woken too late by the "
            f"system; {report.skipped:,} periods skipped",
        )
        same = "the same outputs" if not report.disagreed else f"{report.disagreed:,} other outputs"
        if report.shadowed:
            lines.add_row("shadow", f"{report.shadowed:,} steps made again, {same}")
    path = " → ".join(
        text.split(":")[0].split(" → ")[-1] for _, what, text in report.events if what == "state"
    )
    lines.add_row("states", f"IDLE → {path}" if path else "IDLE")
    if report.mode == Mode.SAFE_STOP:
        lines.add_row("stopped by", report.stopped_by)
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
    return Group(lines, Text(), times, Text(), _histogram(report.whole))


def replay_table(result: Replay) -> Table:
    """Return what came of a replay."""
    table = Table.grid(padding=(0, 2))
    recording = result.recording
    table.add_row("log", f"{recording.path}: {recording.meta['mechanism']}")
    table.add_row("steps made again", f"{result.steps:,}")
    table.add_row(
        "outputs, estimates, states",
        "identical, bit for bit"
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
        table.add_row("another build", f"{name} {then} then, {now} now")
    return table


def drill_table(outcomes: Sequence[Outcome], live: Sequence[LiveOutcome] = ()) -> Table:
    """Return what happened in the drill, a row a fault."""
    table = Table("what fails", "how", "what happened", "largest |u|", "replay", "")
    table.columns[0].no_wrap = table.columns[1].no_wrap = True
    part = ""
    for outcome in outcomes:
        case = outcome.case
        if case.part != part:
            table.add_section()
        table.add_row(
            case.part if case.part != part else "",
            case.name,
            escape(outcome.happened),
            f"{outcome.largest:.0%} of the limit",
            "same bits" if outcome.replayed else "[red]differs[/red]",
            _mark(outcome.passed),
        )
        part = case.part
    table.add_section()
    for one in live:
        table.add_row(one.part, one.name, escape(one.happened), "", "", _mark(one.passed))
    return table


def kill_table(killed: Sequence[Killed]) -> Table:
    """Return what was left of runs that were killed."""
    table = Table(
        "killed at, s", "steps in the log", "missing, ms", "replay", "output zero, ms", ""
    )
    for column in table.columns[:5]:
        column.justify = "right"
    for one in killed:
        table.add_row(
            f"{one.moment:.3f}",
            f"{one.steps:,}",
            f"{1e3 * one.missing:.0f}",
            "same bits" if one.identical else "[red]differs[/red]",
            f"{1e3 * one.to_zero:.0f}",
            _mark(one.passed),
        )
    table.add_section()
    table.add_row(
        f"{len(killed)} runs",
        "",
        f"at most {1e3 * max(one.missing for one in killed):.0f}",
        f"{sum(one.identical for one in killed)} same",
        f"at most {1e3 * max(one.to_zero for one in killed):.0f}",
        f"{sum(one.passed for one in killed)} of {len(killed)}",
    )
    return table


def _mark(passed: bool) -> str:
    return "[green]✓[/green]" if passed else "[red]✗[/red]"
