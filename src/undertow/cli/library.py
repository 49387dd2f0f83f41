"""The library of mechanisms: what there is, formulas, a survey, moving pictures."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

from undertow.base import INTERRUPTED
from undertow.base import artefacts as results
from undertow.cascade import problem_words
from undertow.cli import parsing as inputs
from undertow.cli.terminal import (
    AnyName,
    Box,
    Goal,
    HardInput,
    Horizon,
    Limits,
    Seed,
    Settings,
    Start,
    app,
    examples,
    progress_bar,
    reports_errors,
    say,
    terminal,
    write,
)
from undertow.closed_loop import ClosedLoop
from undertow.mechanisms import LIBRARY
from undertow.optimiser import Optimiser

__all__ = ["animate", "derive", "list_mechanisms", "survey"]


@app.command(
    name="mechanisms", epilog=examples("undertow mechanisms", "undertow mechanisms --out pictures")
)
@reports_errors
def list_mechanisms(
    out: Annotated[
        Path | None, typer.Option(help="Folder for mechanisms.png: all on their way to the target.")
    ] = None,
) -> None:
    """List the mechanisms of the library; with --out also draw them."""
    from undertow.cli import commands

    console = terminal()
    console.width = max(console.width, 80)
    console.print(commands.mechanism_table(console.width))
    if out is not None:
        results.check_folder(out)
        with progress_bar() as progress:
            picture = commands.library_picture(progress)
        say(console, write(out, {"mechanisms.png": picture}))


@app.command(
    epilog=examples(
        "undertow derive rotary_pendulum",
        "undertow derive gantry_crane --latex",
        "undertow derive acrobot --out formulas",
        "undertow derive model.py:bar",
    )
)
@reports_errors
def derive(
    name: AnyName,
    latex: Annotated[bool, typer.Option("--latex", help="Print a LaTeX document.")] = False,
    out: Annotated[Path | None, typer.Option(help="Folder for NAME.txt and NAME.tex.")] = None,
) -> None:
    """Show M, f, the law and the surface conditions as formulas."""
    from undertow.cli import commands

    mechanism = inputs.mechanism_named(name)
    if out is not None:
        results.check_folder(out)
    files = commands.derivation_files(mechanism)
    typer.echo(files[f"{mechanism.name}.{'tex' if latex else 'txt'}"].decode(), nl=False)
    if out is not None:
        say(terminal(stderr=True), write(out, files))


@app.command(
    epilog=examples(
        "undertow survey",
        "undertow survey --out survey",
        "undertow survey --only acrobot --only tora --no-bounds",
    )
)
@reports_errors
def survey(
    only: Annotated[
        list[str] | None, typer.Option(help="This mechanism alone. Repeatable.", metavar="NAME")
    ] = None,
    objective: Goal = "energy",
    horizon: Horizon = 60.0,
    bounds: Annotated[bool, typer.Option(help="Also the optimal-control bounds.")] = True,
    seed: Seed = 0,
    out: Annotated[Path | None, typer.Option(help="Folder for survey.csv and survey.md.")] = None,
) -> None:
    """Bring every mechanism to its target: cost, time, bound and gap of all in one table."""
    from undertow.studies import survey as study

    request = {k: v for k, v in locals().items() if k not in ("study", "out")}
    if out is not None:
        results.check_folder(out)
    began, entries, interrupted = time.perf_counter(), list[study.Entry](), False
    names = only or list(LIBRARY)
    try:
        with progress_bar() as progress:
            study.survey(
                names,
                goal=objective,
                horizon=horizon,
                seed=seed,
                bounds=bounds,
                progress=progress,
                done=entries.append,
            )
    except KeyboardInterrupt:
        if not entries:
            raise
        interrupted = True
    console = terminal()
    written = None if out is None else write(out, study.files(request, entries))
    console.width = max(console.width, 80)
    console.print(study.table(entries), crop=False, soft_wrap=True)
    for line in study.summary(entries):
        say(console, line)
    if written is not None:
        say(console, written)
    say(console, f"Took {time.perf_counter() - began:.0f} s, seed {seed}.")
    if interrupted:
        left = " ".join(f"--only {name}" for name in names[len(entries) :])
        words = f"interrupted: {len(entries)} of {len(names)} are done. The others: undertow survey"
        say(terminal(stderr=True), f"{words} {left} and the options as before")
        raise typer.Exit(INTERRUPTED)


@app.command(
    epilog=examples(
        "undertow animate acrobot",
        "undertow animate rotary_pendulum --start phi=40deg --speed 0.5 --out film",
    )
)
@reports_errors
def animate(
    name: AnyName,
    start: Start = None,
    objective: Goal = "energy",
    setting: Settings = None,
    limit: Limits = None,
    hard_input: HardInput = False,
    box: Box = None,
    horizon: Horizon = 20.0,
    speed: Annotated[float, typer.Option(help="Motion seconds in a second of film.")] = 1.0,
    longest: Annotated[
        float, typer.Option(help="Longest film, s: a longer motion is cut there, and it is said.")
    ] = 8.0,
    seed: Seed = 0,
    out: Annotated[Path, typer.Option(help="Folder for NAME.gif and NAME.png.")] = Path("."),
) -> None:
    """Draw a mechanism on its way to the target, under a surface optimised at the start.

    The film ends where the motion has settled, or after 8 s, see --longest.
    """
    from undertow.cli import commands
    from undertow.cli.report import ended
    from undertow.display.animation import Film

    request = {k: v for k, v in locals().items() if k not in ("commands", "out", "Film", "ended")}
    belief = inputs.mechanism_named(name, setting or (), limit or ())
    x0 = inputs.parse_start(belief, start or ())
    goal = inputs.objective_named(objective, belief, horizon, box or (), hard_input=hard_input)
    goal.check_start(belief, x0)
    results.check_folder(out)
    loop = ClosedLoop(belief, goal)
    plan = Optimiser(loop, seed=seed).require(x0).plan
    assert plan is not None  # require() raises otherwise
    motion = loop.simulate(x0, plan)
    film = Film.of(motion, speed=speed, longest=longest)
    files = commands.animation_files(request, film)
    console = terminal()
    say(console, problem_words(belief, goal))
    say(console, f"{ended(motion, goal)}. Shown: {film.span}")
    if " of " in film.span:
        say(
            console, "The film is cut: --longest shows more of the motion, --speed all of it faster"
        )
    say(console, write(out, files))
