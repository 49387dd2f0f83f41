"""The command line: parse and dispatch only."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, Literal, ParamSpec, TypeVar

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from undertow import inputs, results
from undertow.cascade import Cascade
from undertow.errors import InvalidInputError, UndertowError
from undertow.optimiser import Budget, Optimiser
from undertow.rollout import ClosedLoop
from undertow.stability import check_surface, first_surface

__all__ = ["app", "main"]

P = ParamSpec("P")
R = TypeVar("R")

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _examples(*lines: str) -> str:
    return "\n\n".join(["[bold]Examples[/bold]", *lines])


def _reports_errors(command: Callable[P, R]) -> Callable[P, R]:
    """Turn a condition into one line on standard error; exit 2 for bad input, else 1."""

    @wraps(command)
    def guarded(*args: P.args, **kwargs: P.kwargs) -> R:
        try:
            return command(*args, **kwargs)
        except UndertowError as error:
            typer.secho("error: ", fg="red", bold=True, nl=False, err=True)
            typer.echo(" ".join(str(error).split()), err=True)
            raise typer.Exit(2 if isinstance(error, ValueError) else 1) from None

    return guarded


def _console(*, stderr: bool = False) -> Console:
    return Console(stderr=stderr, highlight=False)


@contextmanager
def _progress() -> Iterator[Callable[[str, float], None]]:
    """Show progress on standard error: a bar on a terminal, else a line for each new part."""
    console = _console(stderr=True)
    if not console.is_terminal:
        told: list[str] = []

        def tell(what: str, _fraction: float) -> None:
            if what not in told:
                told.append(what)
                _say(console, f"… {what}")

        yield tell
        return
    columns = (SpinnerColumn(), BarColumn(), TimeElapsedColumn(), TextColumn("{task.description}"))
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task("", total=1.0)
        yield lambda what, fraction: bar.update(task, description=what, completed=fraction)


def _write(out: Path, files: Mapping[str, bytes]) -> str:
    """Write results and return the sentence that says where they went."""
    earlier = results.write_files(out, files)
    moved = "" if earlier is None else f"Earlier results moved to {earlier}/\n"
    return f"{moved}Written to {out}/: {', '.join(files)}"


def _say(console: Console, text: str) -> None:
    console.print(text, soft_wrap=True, markup=False)


def _version(asked: bool) -> None:
    if asked:
        typer.echo(f"undertow {results.versions()['undertow'] or '(from source)'}")
        raise typer.Exit


Name = Annotated[str, typer.Argument(help="Mechanism, e.g. rotary_pendulum.")]
Start = Annotated[
    list[str] | None,
    typer.Option(
        help="Initial state, with its unit: phi=40deg, theta_dot=10deg/s, x=0.2m. Repeatable; "
        "what is not named is zero. Default: the mechanism's usual start.",
        metavar="STATE=VALUE",
    ),
]
Settings = Annotated[
    list[str] | None,
    typer.Option("--set", help="Parameter in SI units. Repeatable.", metavar="NAME=VALUE"),
]
Goal = Annotated[Literal["energy", "time"], typer.Option(help="What is minimised.")]
Horizon = Annotated[float, typer.Option(help="Longest motion, s.")]
Seed = Annotated[int, typer.Option(help="Seed of everything random.", min=0)]


@app.callback()
def root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    """Optimal sliding-mode cascade control of underactuated mechanisms."""


@app.command(
    epilog=_examples(
        "undertow reproduce",
        "undertow reproduce --out results --seed 1",
        "undertow reproduce --quick",
    )
)
@_reports_errors
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
    with _progress() as progress:
        result = paper.reproduce(seed=seed, effort=effort, progress=progress)
    # First the files: a pipe that breaks while the report is printed must not lose them.
    written = _write(out, paper.files(result))
    console = _console()
    console.print(paper.report(result))
    _say(console, f"\n{written}\nTook {time.perf_counter() - began:.0f} s, seed {seed}.")


@app.command(
    epilog=_examples(
        "undertow simulate rotary_pendulum --start phi=35deg",
        "undertow simulate rotary_pendulum --start phi=40deg --objective time --set d_e=0.025 "
        "--out motion",
        "undertow simulate rotary_pendulum --start phi=20deg "
        "--surface 'lambda_a=-0.5 alpha_u=5 lambda_u=10'",
        "undertow simulate rotary_pendulum --control one-time --plant m=0.15",
    )
)
@_reports_errors
def simulate(
    name: Name,
    start: Start = None,
    objective: Goal = "energy",
    control: Annotated[
        Literal["cascade", "one-time", "first"] | None,
        typer.Option(
            help="cascade, the default: re-optimised every period. one-time: optimised at the "
            "start. first: the designed surface."
        ),
    ] = None,
    surface: Annotated[
        str | None,
        typer.Option(
            help="A surface of your own instead: 'lambda_a=-0.5 alpha_u=5 lambda_u=10'; commas "
            "between entries of a row, semicolons between rows; alpha_a is -1 if not given.",
            metavar="BLOCKS",
        ),
    ] = None,
    setting: Settings = None,
    plant: Annotated[
        list[str] | None,
        typer.Option(
            help="Parameter of the true plant that the controller does not know of, SI units. "
            "Repeatable.",
            metavar="NAME=VALUE",
        ),
    ] = None,
    horizon: Horizon = 60.0,
    period: Annotated[float, typer.Option(help="Time between re-optimisations, s.")] = 0.1,
    seed: Seed = 0,
    out: Annotated[
        Path | None, typer.Option(help="Folder for motion.csv, motion.png and manifest.json.")
    ] = None,
) -> None:
    """Simulate a mechanism under its sliding-mode law, from a start to the target."""
    from undertow import report

    request = {k: v for k, v in locals().items() if k not in ("report", "out")}
    belief = inputs.mechanism_named(name, setting or ())
    truth = belief.with_parameters(**inputs.parse_values(plant)) if plant else None
    x0 = inputs.parse_start(belief, start or ())
    goal = inputs.objective_named(objective, belief, horizon)
    given = None if surface is None else inputs.parse_surface(belief, surface)
    if given is not None and control is not None:
        raise InvalidInputError(
            "--surface with --control",
            value=control,
            limit="one of them",
            remedy="A surface of your own is kept: leave --control out",
        )
    steering: str = control or ("cascade" if given is None else "given surface")
    request["control"] = steering
    if out is not None:
        results.check_folder(out)
    run = None
    if steering == "cascade":
        cascade = Cascade(belief, goal, period=period, seed=seed)
        with _progress() as progress:
            run = cascade.simulate(
                x0, plant=truth, progress=lambda t, end: progress("cascade", t / end)
            )
        motion, surfaces = run.trajectory, run.surfaces
    else:
        if given is None:
            given = first_surface(belief)
            if steering == "one-time":
                given = Optimiser(ClosedLoop(belief, goal), seed=seed).require(x0).surface or given
        check_surface(belief, given, x0)
        motion = ClosedLoop(belief, goal, plant=truth).simulate(x0, given)
        surfaces = (given,)
    console = _console()
    console.print(report.motion_report(belief, goal, x0, motion, surfaces[0], run))
    if out is not None:
        files = report.motion_files(request, motion, motion.total, surfaces)
        _say(console, _write(out, files))
    if motion.event.name != "REACHED":
        raise typer.Exit(1)


@app.command(
    epilog=_examples(
        "undertow optimise rotary_pendulum --start phi=40deg",
        "undertow optimise rotary_pendulum --start phi=41deg --objective time --set d_e=0.025",
        "undertow optimise rotary_pendulum --evaluations 20000 --seed 3 --out answer",
    )
)
@_reports_errors
def optimise(
    name: Name,
    start: Start = None,
    objective: Goal = "energy",
    setting: Settings = None,
    horizon: Horizon = 60.0,
    evaluations: Annotated[int, typer.Option(help="Rollouts that the search may spend.")] = 3072,
    seed: Seed = 0,
    out: Annotated[Path | None, typer.Option(help="Folder for proposal.json.")] = None,
) -> None:
    """Find the best surface from a start: one global optimisation, with its margins."""
    from undertow import report

    request: dict[str, Any] = {k: v for k, v in locals().items() if k not in ("report", "out")}
    belief = inputs.mechanism_named(name, setting or ())
    x0 = inputs.parse_start(belief, start or ())
    goal = inputs.objective_named(objective, belief, horizon)
    if out is not None:
        results.check_folder(out)
    optimiser = Optimiser(ClosedLoop(belief, goal), cold=Budget(evaluations), seed=seed)
    proposal = optimiser.require(x0)
    console = _console()
    console.print(report.proposal_report(belief, goal, x0, proposal))
    if out is not None:
        _say(console, _write(out, report.proposal_files(request, proposal)))


@app.command(name="mechanisms", epilog=_examples("undertow mechanisms"))
@_reports_errors
def list_mechanisms() -> None:
    """List the mechanisms of the library."""
    from undertow import commands

    console = _console()
    console.width = max(console.width, 150)  # rows may wrap, but no cell is cut
    console.print(commands.mechanism_table(), crop=False, soft_wrap=True)


@app.command(
    epilog=_examples(
        "undertow derive rotary_pendulum",
        "undertow derive gantry_crane --latex",
        "undertow derive acrobot --out formulas",
    )
)
@_reports_errors
def derive(
    name: Name,
    latex: Annotated[bool, typer.Option("--latex", help="Print a LaTeX document.")] = False,
    out: Annotated[Path | None, typer.Option(help="Folder for NAME.txt and NAME.tex.")] = None,
) -> None:
    """Show M, f, the law and the surface conditions as formulas."""
    from undertow import commands

    mechanism = inputs.mechanism_named(name)
    if out is not None:
        results.check_folder(out)
    files = commands.derivation_files(mechanism)
    typer.echo(files[f"{name}.tex" if latex else f"{name}.txt"].decode(), nl=False)
    if out is not None:
        _say(_console(stderr=True), _write(out, files))


@app.command(
    epilog=_examples(
        "undertow survey",
        "undertow survey --out survey",
        "undertow survey --only acrobot --only tora --no-bounds",
    )
)
@_reports_errors
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
    from undertow import survey as study

    request = {k: v for k, v in locals().items() if k not in ("study", "out")}
    if out is not None:
        results.check_folder(out)
    began = time.perf_counter()
    with _progress() as progress:
        entries = study.survey(
            only, goal=objective, horizon=horizon, seed=seed, bounds=bounds, progress=progress
        )
    console = _console()
    written = None if out is None else _write(out, study.files(request, entries))
    console.width = max(console.width, 150)
    console.print(study.table(entries), crop=False, soft_wrap=True)
    for line in study.summary(entries):
        _say(console, line)
    if written is not None:
        _say(console, written)
    _say(console, f"Took {time.perf_counter() - began:.0f} s, seed {seed}.")


@app.command(
    epilog=_examples(
        "undertow animate acrobot",
        "undertow animate rotary_pendulum --start phi=40deg --speed 0.5 --out film",
    )
)
@_reports_errors
def animate(
    name: Name,
    start: Start = None,
    objective: Goal = "energy",
    setting: Settings = None,
    horizon: Horizon = 20.0,
    speed: Annotated[float, typer.Option(help="Motion seconds in a second of film.")] = 1.0,
    seed: Seed = 0,
    out: Annotated[Path, typer.Option(help="Folder for NAME.gif and NAME.png.")] = Path("."),
) -> None:
    """Draw a mechanism on its way to the target, under a surface optimised at the start."""
    from undertow import commands

    request = {k: v for k, v in locals().items() if k not in ("commands", "out")}
    belief = inputs.mechanism_named(name, setting or ())
    x0 = inputs.parse_start(belief, start or ())
    goal = inputs.objective_named(objective, belief, horizon)
    results.check_folder(out)
    loop = ClosedLoop(belief, goal)
    plan = Optimiser(loop, seed=seed).require(x0).plan
    assert plan is not None  # require() raises otherwise
    motion = loop.simulate(x0, plan)
    files = commands.animation_files(request, motion, speed=speed)
    _say(_console(), _write(out, files))


def main() -> None:
    """Run the command line."""
    app()
