"""Controllers on realistic rigs, many seeds: tables and figures."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from rich.console import RenderableType

from undertow.base import INTERRUPTED
from undertow.base import artefacts as results
from undertow.cli.terminal import (
    app,
    as_text,
    examples,
    progress_bar,
    reports_errors,
    say,
    terminal,
    write,
)

__all__ = ["trials"]


@app.command(
    epilog=examples(
        "undertow trials balance --out bench",
        "undertow trials balance --quick",
        "undertow trials swing-up",
        "undertow trials swing-up --fresh 1",
        "undertow trials mujoco",
        "undertow trials library --seeds 3",
        "undertow trials coverage --seeds 60 --out bench",
        "undertow trials robustness --rigs 50 --out bench",
    )
)
@reports_errors
def trials(
    what: Annotated[
        Literal["balance", "swing-up", "mujoco", "robustness", "estimators", "library", "coverage"],
        typer.Argument(
            help="balance: the paper's experiment on the SRV02 bench. swing-up: from hanging at "
            "rest to balanced. mujoco: MuJoCo as the truth, no retuning. "
            "robustness: random rigs, and what breaks whom. estimators: the same law with each. "
            "library: every mechanism through the runtime. coverage: how often the intervals of "
            "the bring-up wizard hold the truth.",
            metavar="WHAT",
            show_choices=False,
        ),
    ],
    seeds: Annotated[int, typer.Option(help="Rigs, one for each seed.", min=1)] = 20,
    angle: Annotated[
        float, typer.Option(help="balance: start of the pendulum, degrees from the upright.")
    ] = 35.0,
    rigs: Annotated[int, typer.Option(help="robustness: random rigs.", min=1)] = 200,
    single: Annotated[
        bool,
        typer.Option(help="robustness: also look for the largest single change that is survived."),
    ] = True,
    limits: Annotated[
        bool, typer.Option(help="balance: also search for the catch limits, which takes longest.")
    ] = True,
    quick: Annotated[
        bool, typer.Option("--quick", help="A look: three rigs, no search for catch limits.")
    ] = False,
    fresh: Annotated[
        int | None,
        typer.Option(
            help="swing-up: search for the gains anew, with this seed, and use no kept ones.",
            metavar="SEED",
            min=0,
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="balance: folder for balance.csv and the figures. robustness: folder for "
            "robustness.jsonl, every run as it is made: called again, it goes on from there. "
            "coverage: the same, coverage.jsonl. swing-up: folder for gains.json, the gains as the "
            "library keeps them. The tables of the others as text."
        ),
    ] = None,
) -> None:
    """Run controllers on realistic rigs, over and over, and print what came of it."""
    from undertow.bring_up.coverage import coverage
    from undertow.bring_up.report import coverage_table
    from undertow.cascade.swing_up import SwingUp
    from undertow.cascade.swing_up.search import KEPT, as_kept
    from undertow.studies.trials import balance as experiment
    from undertow.studies.trials import estimation, report, upright
    from undertow.studies.trials import robustness as stress
    from undertow.studies.trials.library import through_the_runtime

    if out is not None:
        results.check_folder(out)
    seeds = min(seeds, 3) if quick else seeds
    console = terminal()
    rows: list[Any] = []  # what is finished, of experiments that are shown row by row
    by_rows: dict[str, Callable[[list[Any]], RenderableType]] = {
        "balance": lambda made: report.balance_report(made[0]),
        "swing-up": lambda made: report.swing_report(made, upright.SWING_SECONDS),
        "estimators": report.estimator_report,
        "library": report.library_report,
        "mujoco": report.engine_report,
    }
    shown: RenderableType | None = None
    files: dict[str, bytes] = {}
    interrupted = False
    try:
        with progress_bar() as progress:
            if what == "balance":
                experiment.balance(
                    angle=math.radians(angle),
                    seeds=seeds,
                    limits=limits and not quick,
                    progress=progress,
                    begun=rows.append,
                )
            elif what == "swing-up":
                searched = upright.searched(upright.SWINGING, fresh, progress)
                files[KEPT.name] = as_kept(searched).encode()
                for i, (mechanism, found) in enumerate(searched.items()):
                    progress(mechanism.name, i / len(searched))
                    swing = SwingUp(mechanism, tuple(one.gains for one in found))
                    rows.append(upright.swing_trials(mechanism, swing=swing, seeds=seeds))
            elif what == "estimators":
                progress("estimators", 0.0)
                estimation.compared(seeds=min(seeds, 5), done=rows.append)
            elif what == "coverage":
                file = None if out is None else out / "coverage.jsonl"
                shown = coverage_table(coverage(seeds, keep=file, progress=progress))
            elif what == "library":
                through_the_runtime(seeds=min(seeds, 5), progress=progress, done=rows.append)
            elif what == "robustness":
                shown = report.robustness_report(
                    stress.robustness(
                        rigs=min(rigs, 10) if quick else rigs,
                        seeds=3 if single and not quick else 0,
                        ledger=None if out is None else out / "robustness.jsonl",
                        progress=progress,
                    )
                )
            else:
                for i, mechanism in enumerate(upright.all_of(upright.ENGINES)):
                    progress(mechanism.name, i / len(upright.ENGINES))
                    rows.append(upright.engine_trial(mechanism))
    except KeyboardInterrupt:
        interrupted = True
    if what in by_rows and rows:
        shown = by_rows[what](rows)
    if shown is not None:
        console.print(shown)
        if out is not None and what in by_rows:
            files[f"{what}.txt"] = as_text(shown)
    if what == "balance" and rows:
        files |= report.balance_files(rows[0])
    if out is not None and files:
        say(console, write(out, files))
    if interrupted:
        say(terminal(stderr=True), _how_to_go_on(what, out))
        raise typer.Exit(INTERRUPTED)


def _how_to_go_on(what: str, out: Path | None) -> str:
    """Say what an interrupted experiment left, and how it is finished."""
    if what not in ("robustness", "coverage"):
        return "interrupted: what is shown is finished; the same command begins again"
    if out is None:
        return "interrupted: nothing was kept; with --out every run is, as it is made"
    return f"interrupted: finished runs are in {out / what}.jsonl; the same command goes on there"
