"""The paper's experiment."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

from undertow.base import MissingExtraError
from undertow.cli import options
from undertow.cli.options import folder, option
from undertow.cli.terminal import check_out, command, progress_bar, show, write


@command(
    "undertow reproduce",
    "undertow reproduce --out results --seed 1",
    "undertow reproduce --quick",
)
def reproduce(
    out: Annotated[Path, folder("tables, figures and manifest")] = Path("results"),
    seed: options.Seed = 0,
    quick: Annotated[
        bool, option("--quick", "Quick look: one condition, short searches, no bounds.")
    ] = False,
) -> None:
    """Run the paper's experiment: Tables 1 and 2 beside the paper's, Figures 3 to 6.

    Also its appendix, corrected: tables of the five cases and Figures 7 to 11 (not with --quick).
    """
    from undertow.studies import paper
    from undertow.studies.paper import appendix_report as appendix

    check_out(out)
    began = time.perf_counter()
    effort = paper.Effort.quick() if quick else paper.Effort()
    with progress_bar() as progress:
        result = paper.reproduce(seed=seed, effort=effort, progress=progress)
        more, missing = {}, list[str]()
        if not quick:
            progress("appendix", 1.0)
            try:
                more = appendix.files()
            except MissingExtraError as error:
                missing.append(f"Without the appendix. {error}")
    written = write(out, lambda: paper.files(result) | more)
    took = f"Took {time.perf_counter() - began:.0f} s, seed {seed}."
    show(paper.report(result), "", *written, *missing, took)
