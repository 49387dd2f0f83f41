"""The library of mechanisms: what there is, formulas, a survey, moving pictures."""

from __future__ import annotations

from pathlib import Path

import typer

from undertow.cascade import problem_words
from undertow.cli import options
from undertow.cli.parsing import mechanism_named, parse_task
from undertow.cli.terminal import (
    carry_out,
    check_out,
    command,
    needs,
    progress_bar,
    show,
    terminal,
    write,
)
from undertow.closed_loop import ClosedLoop
from undertow.objective import USUAL
from undertow.optimiser import Optimiser


@command("undertow mechanisms", "undertow mechanisms --out pictures", name="mechanisms")
def list_mechanisms(out: Path | None = None) -> None:
    """List the mechanisms of the library; with --out also draw them.

    Parameters
    ----------
    out
        Folder for mechanisms.png and .gif: all on their way.
    """
    from undertow.studies.gallery import library_files, mechanism_table

    width = max(terminal().width, 80)
    show(mechanism_table(width), least=width)
    if out is not None:
        check_out(out)
        with progress_bar() as progress:
            written = write(out, lambda: library_files(progress))
        show(*written)


@command(
    "undertow derive rotary_pendulum",
    "undertow derive gantry_crane --latex",
    "undertow derive acrobot --out formulas",
    "undertow derive model.py:bar",
)
def derive(name: options.AnyName, latex: bool = False, out: Path | None = None) -> None:
    """Show M, f, the law and the surface conditions as formulas.

    Parameters
    ----------
    latex
        Print a LaTeX document.
    out
        Folder for NAME.txt and NAME.tex.
    """
    from undertow.display.derivation import derivation

    mechanism = mechanism_named(name)
    check_out(out)
    with progress_bar() as progress:
        progress("deriving", 0.0)
        formulas = derivation(mechanism)
    written = write(out, formulas.files)
    typer.echo(formulas.latex() if latex else formulas.text(), nl=False)
    show(*written, stderr=True)


@command(
    "undertow survey",
    "undertow survey --out survey",
    "undertow survey --only acrobot --only tora --no-bounds",
    "undertow survey --objective time",
)
def survey(
    only: list[str] | None = None,
    objective: list[str] | None = None,
    horizon: options.Horizon = 60.0,
    bounds: bool = True,
    seed: options.Seed = 0,
    out: Path | None = None,
) -> None:
    """Bring every mechanism to its target: costs, bound and gaps of all in one table.

    The cascade takes the mechanism for the plant; free: it may choose the reaching law, too.

    Parameters
    ----------
    only : NAME
        Survey this mechanism only. Repeatable.
    objective : WORD
        What is minimised, as for simulate; energy, then time. Repeatable.
    bounds
        Also compute the optimal-control bounds.
    out
        Folder for survey.csv and survey.md.
    """
    request = {k: v for k, v in locals().items() if k != "out"}
    from undertow.studies import survey as study

    work = study.survey(
        only or None, goals=objective or study.GOALS, horizon=horizon, seed=seed, bounds=bounds,
        request=request,
    )  # fmt: skip
    carry_out(work, out, seed=seed, least=80, crop=False, soft_wrap=True)


@command("undertow models robots", "undertow models robots --no-simulate --out tables")
def models(
    folder_of_files: Path, simulate: bool = True, seed: options.Seed = 0, out: Path | None = None
) -> None:
    """Read every URDF and MJCF file of a folder: what is balanced, and what is not and why.

    Parameters
    ----------
    folder_of_files : FOLDER
        Folder with URDF and MJCF files.
    simulate
        Also balance what can be, as simulate FILE does.
    out
        Folder for models.csv and models.md.
    """
    from undertow.studies import model_files as study

    needs(simulate, "with --no-simulate", "for the motions that it leaves out", "seed")
    work = study.model_files(folder_of_files, simulate=simulate, seed=seed)
    carry_out(work, out, seed=seed, least=100)


@command(
    "undertow animate acrobot",
    "undertow animate rotary_pendulum --start phi=40deg --speed 0.5 --out film",
)
def animate(
    name: options.AnyName,
    start: options.Start = None,
    objective: options.Goal = USUAL,
    setting: options.Settings = None,
    limit: options.Limits = None,
    hard_input: options.HardInput = False,
    box: options.Box = None,
    horizon: options.Horizon = 20.0,
    speed: float = 1.0,
    longest: float = 8.0,
    seed: options.Seed = 0,
    out: Path = Path("."),
) -> None:
    """Draw a mechanism on its way to the target, under a surface optimised at the start.

    The film ends where the motion has settled, or after 8 s, see --longest.

    Parameters
    ----------
    speed
        Seconds of motion per second of film.
    longest
        Longest film, s. A longer motion is cut there.
    out
        Folder for NAME.gif and NAME.png.
    """
    request = {k: v for k, v in locals().items() if k != "out"}
    from undertow.display.animation import Film, check_film, film_files
    from undertow.studies.motion import ended

    belief, x0, goal = parse_task(name, start, objective, horizon, setting, limit, box, hard_input)
    check_film(longest=longest, speed=speed)
    check_out(out)
    loop = ClosedLoop(belief, goal)
    with progress_bar() as progress:
        progress("searching for the best surface", 0.0)
        plan = Optimiser(loop, seed=seed).require(x0).plan
        assert plan is not None  # require() raises otherwise
        motion = loop.simulate(x0, plan)
        film = Film.of(motion, speed=speed, longest=longest)
        progress("drawing the film", 0.5)
        written = write(out, lambda: film_files(film, request))
    show(problem_words(belief, goal), f"{ended(motion, goal)}. Shown: {film.span}")
    if film.cut:
        show("The film is cut: --longest shows more of the motion, --speed all of it faster")
    show(*written)
