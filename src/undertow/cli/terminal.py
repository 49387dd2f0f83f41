"""What all commands share: the application, options, errors in one line, progress, writing."""

from __future__ import annotations

import io
import re
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, ParamSpec, TypeVar

import typer
from rich.console import Console, RenderableType
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.text import Text
from typer.core import TyperCommand, TyperGroup

from undertow.base import INTERRUPTED, InvalidInputError, UndertowError, near, printable
from undertow.base import artefacts as results

__all__ = [
    "AnyName",
    "Application",
    "Box",
    "Goal",
    "HardInput",
    "Horizon",
    "Limits",
    "Name",
    "Seed",
    "Settings",
    "Start",
    "app",
    "as_text",
    "check_control",
    "examples",
    "progress_bar",
    "reports_errors",
    "say",
    "terminal",
    "write",
]

P = ParamSpec("P")
R = TypeVar("R")

#: Longest line of an example, so that a terminal of 80 columns need not break it.
WIDTH = 76


class _Plain:
    """Help that shows no type for flags, which take no value, and examples as they are typed."""

    epilog: str | None

    def get_params(self, ctx: Any) -> Any:
        params = super().get_params(ctx)  # type: ignore[misc]
        for param in params:
            if getattr(param, "is_flag", False):
                param.metavar = ""
        return params

    def format_help(self, ctx: Any, formatter: Any) -> None:
        epilog, self.epilog = self.epilog, None
        super().format_help(ctx, formatter)  # type: ignore[misc]
        self.epilog = epilog
        if epilog:  # not padded to the width: nothing may follow a backslash
            console = terminal()
            console.print(Text(" Examples\n", style="bold"))
            console.print(Text(textwrap.indent(f"{epilog}\n", " ")), soft_wrap=True)


class _Command(_Plain, TyperCommand):
    pass


class _Group(_Plain, TyperGroup):
    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Name the commands that are like a wrong one."""
        if args and args[0] not in self.commands and not args[0].startswith("-"):
            like = near(args[0], self.commands) or f"There are {', '.join(self.commands)}"
            ctx.fail(f"No such command '{args[0]}'. {like}")
        return super().resolve_command(ctx, args)


class Application(typer.Typer):
    """A group of commands whose help shows what they take, and nothing that they do not."""

    def __init__(self, **options: Any) -> None:
        super().__init__(
            cls=_Group,
            no_args_is_help=True,
            add_completion=False,
            rich_markup_mode="rich",
            pretty_exceptions_enable=False,
            context_settings={"help_option_names": ["-h", "--help"]},
            **options,
        )

    def command(self, name: str | None = None, **options: Any) -> Any:
        """Register a command, as :class:`typer.Typer` does."""
        return super().command(name, cls=_Command, **options)


app = Application()


def examples(*lines: str) -> str:
    """Return the examples that end a command's help, folded so that they can be pasted."""
    return "\n".join(map(_folded, lines))


def _folded(line: str) -> str:
    """Break a command between its options, with a backslash at the end of all lines but one."""
    rows = [""]
    for word in re.findall(r"(?:--\S+ )?(?:'[^']*'|[^-\s]\S*)|\S+", line):
        if rows[-1].strip() and len(rows[-1]) + len(word) > WIDTH - 2:
            rows.append("   ")
        rows[-1] += f" {word}" if rows[-1] else word
    return " \\\n".join(rows)


def reports_errors(command: Callable[P, R]) -> Callable[P, R]:
    """Turn a condition into one line on standard error; exit 2 for bad input, else 1.

    Ctrl-C is one line as well, exit 130.
    """

    @wraps(command)
    def guarded(*args: P.args, **kwargs: P.kwargs) -> R:
        try:
            return command(*args, **kwargs)
        except KeyboardInterrupt:
            typer.echo("interrupted", err=True)
            raise typer.Exit(INTERRUPTED) from None
        except UndertowError as error:
            typer.secho("error: ", fg="red", bold=True, nl=False, err=True)
            words = " ".join(str(error).split())  # some may be a file's, and anything
            typer.echo(printable(words), err=True)
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


def check_control(word: str | None, words: Sequence[str]) -> None:
    """Refuse a word of ``--control`` that is none of these."""
    if word is None or word in words:
        return
    both = "The surface that is designed is 'designed', the first optimum is 'one-time'"
    raise InvalidInputError(
        "--control",
        value=repr(word),
        limit=f"one of {', '.join(words)}",
        remedy=both if word == "first" else near(word, words),
    )


def as_text(shown: RenderableType) -> bytes:
    """Return what a terminal of 100 columns would show, as plain text."""
    console = Console(width=100, highlight=False, file=io.StringIO())
    console.print(shown)
    return str(console.file.getvalue()).encode()  # type: ignore[attr-defined]


def say(console: Console, text: str) -> None:
    """Print plain text, as long as it is."""
    console.print(text, soft_wrap=True, markup=False)


Name = Annotated[str, typer.Argument(help="Mechanism, e.g. rotary_pendulum.", metavar="NAME")]
AnyName = Annotated[
    str,
    typer.Argument(
        help="Mechanism, e.g. rotary_pendulum, or your own as FILE.py:NAME, FILE.urdf or FILE.xml; "
        "with :JOINT,JOINT behind the last two where they do not say what is actuated.",
        metavar="NAME",
    ),
]
Start = Annotated[
    list[str] | None,
    typer.Option(
        help="Initial state, with its unit: phi=40deg, theta_dot=10deg/s, x=0.2m. Repeatable; "
        "what is not named is zero. Default: the mechanism's usual start, where it has one.",
        metavar="STATE=VALUE",
    ),
]
Settings = Annotated[
    list[str] | None,
    typer.Option("--set", help="Parameter in SI units. Repeatable.", metavar="NAME=VALUE"),
]
Limits = Annotated[
    list[str] | None,
    typer.Option(
        "--limit",
        help="Largest magnitude of an input, in its own unit: voltage=10. Repeatable. Default: "
        "the mechanism's.",
        metavar="INPUT=VALUE",
    ),
]
HardInput = Annotated[
    bool,
    typer.Option(
        "--hard-input",
        help="Refuse motions whose law asks for more than the limit. Default: the actuator clips.",
    ),
]
Box = Annotated[
    list[str] | None,
    typer.Option(
        help="Bounds that a state must keep on its way, with units: theta=60deg for both sides, "
        "or x=-0.2m:0.5m. Repeatable. Tested every 2 ms. Default: 95 % of the travel that the "
        "mechanism declares.",
        metavar="STATE=LOW:HIGH",
    ),
]
Goal = Annotated[
    str,
    typer.Option(
        "--objective",
        help="What is minimised. energy: ∫uᵀu dt, and time: as the paper has them, to a radius of "
        "0.01. bench-energy, bench-time: ∫(uᵀu + 0.05 xᵀx)dt and ∫(1 + 2.25 Σ(u/u_max)²)dt, to "
        "0.05. effort: ∫(Σ(u/u_max)² + 0.01 xᵀx)dt, to 0.02.",
        metavar="WORD",
    ),
]
Horizon = Annotated[float, typer.Option(help="Longest motion, s.")]
Seed = Annotated[int, typer.Option(help="Seed of everything random.", min=0)]
