"""What the exported C of many mechanisms costs and how far it agrees with Python: one table."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.table import Table

from undertow.export.controller import EmbeddedController
from undertow.export.host import Agreement, Build, Footprint
from undertow.export.vectors import run_positions
from undertow.results import to_csv

__all__ = ["Entry", "csv", "measure", "table"]


@dataclass(frozen=True, eq=False)
class Entry:
    """One mechanism of the table."""

    controller: EmbeddedController
    passed: bool
    said: str
    agreement: Agreement
    footprint: Footprint

    def cells(self) -> tuple[object, ...]:
        """Return the row, in the order of :data:`COLUMNS`."""
        mechanism, cost, near = self.controller.mechanism, self.footprint, self.agreement
        return (
            mechanism.name,
            mechanism.n,
            mechanism.m,
            "passed" if self.passed else "FAILED",
            f"{near.output:.1e}",
            f"{near.demand:.1e}",
            round(cost.instructions),
            cost.code,
            cost.constants,
            cost.memory,
            cost.stack,
            ", ".join(cost.calls),
        )


COLUMNS = (
    "mechanism",
    "n",
    "m",
    "own test",
    "u: C - Python",
    "demand",
    "instr./step",
    "code B",
    "const B",
    "state B",
    "stack B",
    "calls",
)


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


def table(entries: Sequence[Entry]) -> Table:
    """Return the table for a terminal."""
    shown = Table(box=None, header_style="dim", padding=(0, 2, 0, 0))
    for head in COLUMNS:
        left = head in ("mechanism", "own test", "calls")
        shown.add_column(head, no_wrap=True, justify="left" if left else "right")
    for entry in entries:
        style = "" if entry.passed else "red"
        shown.add_row(*(str(cell) for cell in entry.cells()), style=style)
    return shown


def csv(entries: Sequence[Entry]) -> bytes:
    """Return the table as comma-separated values."""
    return to_csv(COLUMNS, (entry.cells() for entry in entries))
