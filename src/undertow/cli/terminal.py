"""What all commands share: the application, options, errors in one line, progress, writing."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from typing import Annotated, Literal, ParamSpec, TypeVar

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from undertow import results
from undertow.errors import UndertowError

__all__ = [
    "Goal",
    "Horizon",
    "Name",
    "Seed",
    "Settings",
    "Start",
    "app",
    "examples",
    "progress_bar",
    "reports_errors",
    "say",
    "terminal",
    "write",
]

P = ParamSpec("P")
R = TypeVar("R")

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def examples(*lines: str) -> str:
    """Return the examples that end a command's help."""
    return "\n\n".join(["[bold]Examples[/bold]", *lines])


def reports_errors(command: Callable[P, R]) -> Callable[P, R]:
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


def terminal(*, stderr: bool = False) -> Console:
    """Return the console to print on."""
    return Console(stderr=stderr, highlight=False)


@contextmanager
def progress_bar() -> Iterator[Callable[[str, float], None]]:
    """Show progress on standard error: a bar on a terminal, else a line for each new part."""
    console = terminal(stderr=True)
    if not console.is_terminal:
        told: list[str] = []

        def tell(what: str, _fraction: float) -> None:
            if what not in told:
                told.append(what)
                say(console, f"… {what}")

        yield tell
        return
    columns = (SpinnerColumn(), BarColumn(), TimeElapsedColumn(), TextColumn("{task.description}"))
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task("", total=1.0)
        yield lambda what, fraction: bar.update(task, description=what, completed=fraction)


def write(out: Path, files: Mapping[str, bytes]) -> str:
    """Write results and return the sentence that says where they went."""
    earlier = results.write_files(out, files)
    moved = "" if earlier is None else f"Earlier results moved to {earlier}/\n"
    return f"{moved}Written to {out}/: {', '.join(files)}"


def say(console: Console, text: str) -> None:
    """Print plain text, as long as it is."""
    console.print(text, soft_wrap=True, markup=False)


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
