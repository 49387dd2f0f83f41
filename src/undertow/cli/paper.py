"""The paper's experiment."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

from undertow.base import MissingExtraError
from undertow.base import artefacts as results
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
    """Run the paper's experiment: Tables 1 and 2 beside the paper's, Figures 3 to 6.

    And its appendix, corrected: tables of the five cases and Figures 7 to 11, not with --quick.
    """
    from undertow.studies import paper
    from undertow.studies.paper import appendix_report as appendix

    results.check_folder(out)
    began = time.perf_counter()
    effort = paper.Effort.quick() if quick else paper.Effort()
    with progress_bar() as progress:
        result = paper.reproduce(seed=seed, effort=effort, progress=progress)
        more, missing = {}, ""
        if not quick:
            progress("appendix", 1.0)
            try:
                more = appendix.files()
            except MissingExtraError as error:
                missing = f"\nWithout the appendix. {error}"
    # First the files: a pipe that breaks while the report is printed must not lose them.
    written = write(out, paper.files(result) | more) + missing
    console = terminal()
    console.print(paper.report(result))
    say(console, f"\n{written}\nTook {time.perf_counter() - began:.0f} s, seed {seed}.")
