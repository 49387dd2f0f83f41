"""What the exported C of many mechanisms costs and how far it agrees with Python: two tables."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich import box
from rich.table import Table

from undertow.base import to_csv
from undertow.export.controller import EmbeddedController
from undertow.export.host import Agreement, Build, Footprint
from undertow.export.vectors import run_positions

__all__ = ["Entry", "csv", "measure", "tables"]


@dataclass(frozen=True, eq=False)
class Entry:
    """One mechanism of the table."""

    controller: EmbeddedController
    passed: bool
    said: str
    agreement: Agreement
    footprint: Footprint

    def row(self) -> dict[str, object]:
        """Return the row: column to value."""
        mechanism, cost, near = self.controller.mechanism, self.footprint, self.agreement
        return {
            "mechanism": mechanism.name,
            "n": mechanism.n,
            "m": mechanism.m,
            "own test": "passed" if self.passed else "FAILED",
            "u": f"{near.output:.1e}",
            "demand": f"{near.demand:.1e}",
            "s": f"{near.s:.1e}",
            "margin": f"{near.margin:.1e}",
            "instr.": round(cost.instructions),
            "code": cost.code,
            "const": cost.constants,
            "state": cost.memory,
            "stack": cost.stack,
            "calls": ", ".join(cost.calls),
        }


#: Columns of the two tables, which fit a terminal of 80 columns.
AGREEMENT = ("mechanism", "n", "m", "own test", "u", "demand", "s", "margin")
COST = ("mechanism", "instr.", "code", "const", "state", "stack", "calls")


def measure(
    controllers: Iterable[EmbeddedController],
    *,
    states: int = 100_000,
    compiler: str = "gcc",
    progress: Callable[[str, float], None] | None = None,
) -> list[Entry]:
    """Build, test, compare and count each controller in a folder that is then removed.

    Parameters
    ----------
    controllers
        What to measure.
    states
        Random states of the comparison with Python.
    compiler
        A C compiler that takes GCC's options.
    progress
        Told what is under way, and the fraction done.

    Raises
    ------
    MissingExtraError
        When the compiler, ``size``, ``nm`` or ``valgrind`` is not installed.
    """
    chosen = list(controllers)
    entries = []
    for index, controller in enumerate(chosen):
        if progress is not None:
            progress(controller.mechanism.name, index / len(chosen))
        with tempfile.TemporaryDirectory(prefix="undertow-") as folder:
            build = Build(controller, Path(folder), compiler)
            passed, said = build.self_test()
            positions = run_positions(controller)
            whole = positions[np.isfinite(positions).all(axis=1)]
            entries.append(
                Entry(controller, passed, said, build.agreement(states), build.footprint(whole))
            )
    return entries


def tables(entries: Sequence[Entry]) -> tuple[Table, Table]:
    """Return for a terminal how far the C agrees with Python, and what it costs."""
    shown = []
    for title, columns in (
        ("Largest difference from Python", AGREEMENT),
        ("Instructions of a step, and bytes", COST),
    ):
        table = Table(
            title=title, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD,
            pad_edge=False, padding=(0, 1, 0, 0),
        )  # fmt: skip
        for head in columns:
            left = head in ("mechanism", "own test", "calls")
            table.add_column(head, no_wrap=True, justify="left" if left else "right")
        for entry in entries:
            row = entry.row()
            style = "" if entry.passed else "red"
            table.add_row(*(str(row[head]) for head in columns), style=style)
        shown.append(table)
    return shown[0], shown[1]


def csv(entries: Sequence[Entry]) -> bytes:
    """Return all columns as comma-separated values."""
    rows = [entry.row() for entry in entries]
    return to_csv(list(rows[0]), (list(row.values()) for row in rows))
