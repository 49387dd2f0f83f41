"""What came of injected faults, as tables for the terminal."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence

from rich.console import Group, RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from undertow.base import mark, table
from undertow.studies.fault_injection.failing_calls import OPERATIONS
from undertow.studies.fault_injection.live import KillResult, LiveResult
from undertow.studies.fault_injection.simulated import CaseResult
from undertow.studies.fault_injection.systematic import RIGS, FaultResult

#: Of the table of the drill.
HEADS = ("what fails, and how", "what happened", "verdict", "|u|/limit", "")


def drill_table(outcomes: Sequence[CaseResult], live: Sequence[LiveResult] = ()) -> Table:
    """Return what happened in the drill, a row a fault, under what fails."""
    made = table(HEADS, left=HEADS[1:3], ratios={HEADS[0]: 4, HEADS[1]: 6}, ruled=True)
    part = ""
    for outcome in outcomes:
        case, verdict = outcome.case, outcome.verdict
        if case.part != part:
            part = case.part
            made.add_row(Text(part, style="bold"))
        happened = Text(outcome.happened)
        if not outcome.replayed:
            happened += Text("; ") + Text("its replay differs", style="red")
        ended, largest = f"{verdict.ending} {verdict.exit_code}", f"{outcome.largest:.0%}"
        made.add_row(_indented(case.name), happened, ended, largest, mark(outcome.passed))
    if live:
        made.add_row(Text("against the clock", style="bold"))
    for one in live:
        what = _indented(f"{one.part}: {one.name}")
        made.add_row(what, Text(one.happened), "", "", mark(one.passed))
    return made


def kill_table(killed: Sequence[KillResult]) -> Group:
    """Return what was left of runs that were killed, and of those that had stopped before."""
    running = [one for one in killed if not one.stopped_by]
    rows = [
        (
            f"{one.moment:.3f}",
            f"{one.steps:,}",
            "had stopped" if one.stopped_by else f"{1e3 * one.missing:.0f}",
            "" if one.stopped_by else f"{1e3 * one.idle:.0f}",
            Text("same bits") if one.identical else Text("differs", style="red"),
            f"{1e3 * one.to_zero:.0f}",
            mark(one.passed),
        )
        for one in killed
    ]
    heads = ("killed at, s", "steps", "missing, ms", "idle, ms", "replay", "zero, ms", "")
    made = table(heads, rows, ruled=True)
    made.add_section()
    made.add_row(
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
    return Group(made, *lines)


def systematic_table(cases: Sequence[FaultResult]) -> Group:
    """Return how many systematic faults passed, by operation and rig, and which did not."""
    rows: list[tuple[RenderableType, ...]] = []
    for operation in OPERATIONS:
        here = [case for case in cases if case.fault.operation == operation]
        if here:
            by_rig = [sum(case.fault.rig == rig for case in here) for rig in RIGS]
            passed = sum(case.passed for case in here)
            counts = (f"{n:,}" for n in (*by_rig, len(here), passed))
            rows.append((operation, *counts, mark(passed == len(here))))
    lines = [
        Text(f"{case.fault}: {'; '.join(case.wrong)} ({case.happened})")
        for case in cases
        if not case.passed
    ]
    heads = ("what fails", *RIGS, "cases", "passed", "")
    return Group(table(heads, rows, ruled=True), *lines)


def _indented(text: str) -> Padding:
    return Padding(Text(text), (0, 0, 0, 2))
