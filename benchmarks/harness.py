"""What every benchmark here shares: one thread, a command line, clocks, tables, refusals.

Import it before NumPy: it asks the numerical libraries for one thread each.
"""

# ruff: noqa: E402  the environment comes first

from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import argparse
import importlib
import sys
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

__all__ = [
    "Clock",
    "clock",
    "command_line",
    "mechanism_names",
    "need",
    "percentiles",
    "progress",
    "race",
    "table",
]

Clock = Callable[[], float]
Item = TypeVar("Item")


def command_line(
    description: str | None, *examples: str, clocks: bool = True
) -> argparse.ArgumentParser:
    """Return a parser with ``--quick`` and ``--clock``; the module's words are its help.

    Parameters
    ----------
    description
        The docstring of the benchmark.
    *examples
        Further argument lists, shown as examples besides the bare command and ``--quick``.
    clocks
        Whether the benchmark lets its clock be chosen.
    """
    script = Path(sys.argv[0])
    command = f"python {script.parent.name}/{script.name}"
    lines = [f"  {command} {rest}".rstrip() for rest in ("", "--quick", *examples)]
    parser = argparse.ArgumentParser(
        description=description,
        epilog="examples:\n" + "\n".join(lines),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--quick", action="store_true", help="less of everything: does it run?")
    if clocks:
        parser.add_argument(
            "--clock",
            choices=("wall", "cpu"),
            default="wall",
            help="wall: what a user waits for (default); cpu: processor time of this process, "
            "for a machine that others use as well",
        )
    return parser


def mechanism_names(parser: argparse.ArgumentParser) -> None:
    """Let mechanisms of the library be named, as ``names``; others are refused."""
    from undertow.mechanisms import LIBRARY

    def known(name: str) -> str:
        if name not in LIBRARY:
            raise argparse.ArgumentTypeError(
                f"no mechanism {name!r}; there are {', '.join(LIBRARY)}"
            )
        return name

    parser.add_argument("names", nargs="*", metavar="NAME", type=known, help="which mechanisms")


def clock(name: str) -> Clock:
    """Return the clock that was asked for, in s."""
    return time.perf_counter if name == "wall" else time.process_time


def need(module: str, extra: str) -> Any:
    """Import an optional package, or end with one line that says what to install."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # do-mpc warns of each of its own extras
            return importlib.import_module(module)
    except ImportError:
        sys.exit(
            f"error: this benchmark compares with {module}, which is not installed.\n"
            f"Install it: pip install -c constraints.txt -e '.[{extra}]'"
        )


def progress(items: Iterable[Item], what: str, total: int | None = None) -> Iterator[Item]:
    """Yield the items, counting them on standard error where that is a terminal."""
    total = len(items) if total is None and isinstance(items, Sequence) else total
    shown = sys.stderr.isatty()
    for index, item in enumerate(items, 1):
        if shown:
            print(f"\r\033[K{what}: {index}/{total or '?'}", end="", file=sys.stderr, flush=True)
        yield item
    if shown:
        print("\r\033[K", end="", file=sys.stderr, flush=True)


def race(
    entrants: dict[str, Callable[[], Any]], rounds: int, now: Clock, what: str
) -> dict[str, list[float]]:
    """Run the entrants in turn, round after round, and return the seconds of each.

    Noise that lasts longer than a round meets all of them alike.
    """
    times: dict[str, list[float]] = {name: [] for name in entrants}
    for _ in progress(range(rounds), what):
        for name, run in entrants.items():
            began = now()
            run()
            times[name].append(now() - began)
    return times


def percentiles(seconds: Sequence[float]) -> list[str]:
    """Return median, 99th percentile and largest, in ms, as text."""
    ms = 1e3 * np.asarray(seconds)
    return [f"{value:.2f}" for value in (np.median(ms), np.quantile(ms, 0.99), ms.max())]


def table(title: str, header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table: the first column to the left, the others to the right."""
    widths = [max(len(row[i]) for row in [header, *rows]) for i in range(len(header))]
    print(f"\n{title}\n")
    for row in [header, *rows]:
        cells = [row[0].ljust(widths[0])]
        cells += [cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True)]
        print("  ".join(cells).rstrip())
    sys.stdout.flush()
