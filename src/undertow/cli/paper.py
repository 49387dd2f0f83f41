"""The paper's experiment."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

from undertow import results
from undertow.cli.terminal import (
    Seed,
    app,
    examples,
    progress_bar,
    reports_errors,
    say,
    terminal,
    write,
)

__all__ = ["reproduce"]


@app.command(
    epilog=examples(
        "undertow reproduce",
        "undertow reproduce --out results --seed 1",
        "undertow reproduce --quick",
    )
)
@reports_errors
def reproduce(
    out: Annotated[Path, typer.Option(help="Folder for tables, figures and manifest.")] = Path(
        "results"
    ),
    seed: Seed = 0,
    quick: Annotated[
        bool, typer.Option("--quick", help="A look: one condition, short searches, no bounds.")
    ] = False,
) -> None:
    """Run the paper's experiment: Tables 1 and 2 beside the paper's, Figures 3 to 6."""
    from undertow import paper

    results.check_folder(out)
    began = time.perf_counter()
    effort = paper.Effort.quick() if quick else paper.Effort()
    with progress_bar() as progress:
        result = paper.reproduce(seed=seed, effort=effort, progress=progress)
    # First the files: a pipe that breaks while the report is printed must not lose them.
    written = write(out, paper.files(result))
    console = terminal()
    console.print(paper.report(result))
    say(console, f"\n{written}\nTook {time.perf_counter() - began:.0f} s, seed {seed}.")
