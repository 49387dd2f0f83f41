"""What all commands share: the application, errors in one line, progress, showing, writing."""

from __future__ import annotations

import inspect
import os
import re
import sys
import textwrap
import time
from collections.abc import Callable, Iterator, Mapping, Sized
from contextlib import contextmanager
from contextvars import ContextVar
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn, ParamSpec, get_args, get_origin

import typer
from rich import progress as bars
from rich.console import Console, RenderableType
from rich.measure import Measurement
from rich.text import Text
from typer.core import TyperCommand, TyperGroup

import undertow
from undertow.base import (
    INTERRUPTED,
    ArtefactError,
    InvalidInputError,
    Progress,
    UndertowError,
    by_exception,
    check_folder,
    duration,
    ended_as_interrupted,
    interruptible,
    near,
    printable,
    write_files,
)

if TYPE_CHECKING:
    from undertow.studies.experiment import Experiment

P = ParamSpec("P")

#: Longest line of an example, so that a terminal of 80 columns need not break it.
WIDTH = 76

#: Columns of the widest table.
WIDEST = 1000

#: Part of the work after which its pace tells how long the rest takes: what comes first is often
#: small, and waits for compiled code.
ENOUGH = 0.05


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


#: The command that is carried out, as its parser has it.
_ASKED: ContextVar[Any] = ContextVar("the command that is carried out")


class _Command(_Plain, TyperCommand):
    def invoke(self, ctx: Any) -> Any:
        """Keep what was typed, for :func:`needs`."""
        before = _ASKED.set(ctx)
        try:
            return super().invoke(ctx)
        finally:
            _ASKED.reset(before)


def needs(used: bool, where: str, limit: str, *names: str, remedy: str = "Leave it out") -> None:
    """Refuse options that were typed where nothing uses them, their defaults typed out, too.

    ``names`` are those of the command's parameters; the error says what was typed and ``where``.
    """
    ctx = _ASKED.get()
    for parameter in () if used else ctx.command.params:
        name = parameter.name
        if name not in names or ctx.get_parameter_source(name).name != "COMMANDLINE":
            continue
        value = ctx.params[name]
        options = parameter.secondary_opts if value is False else parameter.opts
        shown = ", ".join(map(str, value)) if isinstance(value, list | tuple) else str(value)
        shown = f"{value:g}" if isinstance(value, float) else shown
        words = where if isinstance(value, bool) else f"{shown}, {where}"
        raise InvalidInputError(options[0], value=words, limit=limit, remedy=remedy)


class _Group(_Plain, TyperGroup):
    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Name the commands that are like a wrong one."""
        if args and args[0] not in self.commands and not args[0].startswith("-"):
            python = f"In Python: undertow.{args[0]}" if args[0] in undertow.__all__ else ""
            every = f"There are {', '.join(self.commands)}"
            like = near(args[0], self.commands) or python or every
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


app = Application()


def command(
    *examples: str, name: str | None = None, of: Application = app
) -> Callable[[Callable[P, None]], Callable[P, None]]:
    """Register a command: its errors are one line, its help is its docstring, and the examples.

    The examples are lines as they are typed; the name is the function's by default; it belongs to
    the group ``of``.
    """

    def register(function: Callable[P, None]) -> Callable[P, None]:
        words, signature = _documented(function)
        guarded: Any = _with_errors_in_one_line(function)
        guarded.__signature__ = signature
        end = folded(*examples)
        made: Callable[P, None] = of.command(name, cls=_Command, help=words, epilog=end)(guarded)
        return made

    return register


def _documented(function: Callable[..., None]) -> tuple[str, inspect.Signature]:
    """Return the help of a command, and its signature with the help of its own options.

    Under *Parameters* in its docstring they stand as ``name``, or as ``name : VALUE`` where the
    help has a word for the value.
    """
    words, _, listed = inspect.cleandoc(function.__doc__ or "").partition("\n\nParameters\n---")
    signature = inspect.signature(function, eval_str=True)
    said = {}
    for entry in re.split(r"\n(?=\w)", listed)[1:]:
        head, _, text = entry.partition("\n")
        name, _, value = head.partition(" : ")
        said[name] = " ".join(text.split()), value or None
    parameters = []
    for name, given in signature.parameters.items():
        kind, info = given.annotation, None
        if get_origin(kind) is Annotated:
            kind, info = get_args(kind)
        if info is None:
            alone = [f"--{name.replace('_', '-')}"] * (given.default is False)
            needed = given.default is inspect.Parameter.empty
            info = typer.Argument() if needed else typer.Option(*alone)
        if name in said:
            info.help, info.metavar = said[name]
        parameters.append(given.replace(annotation=Annotated[kind, info]))
    return words, signature.replace(parameters=parameters)


def folded(*examples: str) -> str:
    """Return the examples that end a help, broken so that they can be pasted."""
    return "\n".join(map(_folded, examples))


def _folded(line: str) -> str:
    """Break a command between its options, with a backslash at the end of all lines but one."""
    rows = [""]
    for word in re.findall(r"(?:--\S+ )?(?:'[^']*'|[^-\s]\S*)|\S+", line):
        if rows[-1].strip() and len(rows[-1]) + len(word) > WIDTH - 2:
            rows.append("   ")
        rows[-1] += f" {word}" if rows[-1] else word
    return " \\\n".join(rows)


def _with_errors_in_one_line(function: Callable[P, None]) -> Callable[P, None]:
    """Turn a condition into one line on standard error; exit 2 for bad input, else 1.

    Ctrl-C is one line as well, exit 130.
    """

    @wraps(function)
    def guarded(*args: P.args, **kwargs: P.kwargs) -> None:
        try:
            by_exception()
            with interruptible():
                function(*args, **kwargs)
        except KeyboardInterrupt:
            typer.echo("interrupted", err=True)
            raise typer.Exit(INTERRUPTED) from None
        except UndertowError as error:
            _say_error(str(error))
            raise typer.Exit(2 if isinstance(error, ValueError) else 1) from None
        except BrokenPipeError:  # who read the output has gone
            raise
        except OSError as error:  # a full disk behind a redirection, a terminal that is closed
            say_unwritten(error)
            raise typer.Exit(1) from None

    return guarded


def say_unwritten(error: OSError) -> None:
    """Say that something cannot be written, in one line."""
    said, of = error.strerror or str(error), error.filename or "the output"
    _say_error(f"{of}: got {said}, must be a file that can be written. Name another one")


def _say_error(text: str) -> None:
    """Print an error in one line; some of its words may be a file's, and anything."""
    typer.secho("error: ", fg="red", bold=True, nl=False, err=True)
    typer.echo(printable(" ".join(text.split())), err=True)


class _Terminal(Console):
    def on_broken_pipe(self) -> None:
        """Say the rest to nobody: ``| head`` has gone, and the exit status is the command's own."""
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, self.file.fileno())
        os.close(nowhere)


def terminal(*, stderr: bool = False) -> Console:
    """Return the console to print on."""
    return _Terminal(stderr=stderr, highlight=False)


@contextmanager
def progress_bar(*, left: bool = True) -> Iterator[Progress]:
    """Show progress on standard error: a bar on a terminal, else a line for each new part.

    ``left``: say how long the rest takes, if its parts take about as long as those before.
    """
    console = terminal(stderr=True)
    begun: list[tuple[float, float]] = []

    def told(what: str, part: float) -> str:
        """Add how long the rest takes, once enough is done to tell."""
        now = time.monotonic()
        if not begun or part <= begun[0][0]:  # what takes long before any of it is done counts not
            begun[:] = [(part, now)]
        done = part - begun[0][0]
        if not left or done < ENOUGH or part >= 1:
            return what
        return f"{what}, {duration((now - begun[0][1]) * (1 - part) / done)} left"

    if not console.is_terminal:
        said: list[str] = []

        def tell(what: str, part: float) -> None:
            line = told(what, part)
            if what not in said:
                said.append(what)
                show(f"… {line}", stderr=True)

        yield tell
        return
    columns = (
        bars.SpinnerColumn(),
        bars.BarColumn(),
        bars.TimeElapsedColumn(),
        bars.TextColumn("{task.description}"),
    )
    with bars.Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task("", total=1.0)
        yield lambda what, part: bar.update(task, description=told(what, part), completed=part)


def completed(work: Callable[[Progress], object], kept: Sized = (1,)) -> bool:
    """Work under a progress bar; false where Ctrl-C ended it and something is kept to be shown.

    SIGTERM ends it as Ctrl-C does.
    """
    try:
        with ended_as_interrupted(), progress_bar() as progress, interruptible():
            work(progress)
    except KeyboardInterrupt:
        if not kept:
            raise
        return False
    return True


def carry_out(
    work: Experiment[Any, Any], out: Path | None, *, seed: int | None = None, **how: Any
) -> None:
    """Do the tasks of an experiment, show what came of them and write it to a folder.

    Tasks that are finished are kept there until all are, and the next time not done again; Ctrl-C
    leaves what can be shown of them.  ``seed`` is named at the end with the time taken; ``how``
    is for :func:`show`.
    """
    check_out(out)
    began, ledger = time.perf_counter(), work.ledger(out)
    every = completed(lambda told: work.run(ledger, progress=told), ledger.known)
    found = work.finished(ledger)
    parts: list[RenderableType] = []
    if every or not work.whole:
        result = work.gather(found)
        said = [*work.report(result)]
        written = write(out, lambda: work.files(result), *said, **how)
        parts = [*said, *written, *work.notes(result)]
        if every and written and ledger.path is not None:
            ledger.path.unlink()
    if seed is not None:
        parts.append(f"Took {time.perf_counter() - began:.0f} s, seed {seed}.")
    show(*parts, **how)
    if not every:
        kept = "nothing was kept; with --out every result is, as it is found"
        if ledger.path is not None:
            kept = f"they are in {ledger.path}; the same command goes on there"
        done = f"{len(found)} of {len(work.tasks)} are done"
        show(f"interrupted: {done}, {kept}", stderr=True)
        raise typer.Exit(INTERRUPTED)


def show(*parts: RenderableType, stderr: bool = False, least: int = 0, **how: Any) -> None:
    """Print tables, at least so many columns wide, and text without markup or folding.

    A table that needs more columns than the terminal has gets them: no name is cut short.
    """
    console = terminal(stderr=stderr)
    width = max(console.width, least)
    for part in parts:
        if isinstance(part, str):
            console.print(part, soft_wrap=True, markup=False)
            continue
        room = console.options.update(max_width=WIDEST)
        console.width = max(width, Measurement.get(console, room, part).minimum)
        console.print(part, **how)


def check_out(out: Path | None) -> None:
    """Refuse a folder that cannot be written, before any long work."""
    if out is not None:
        check_folder(out, "--out")


def write(
    out: Path | None, files: Callable[[], Mapping[str, bytes]], *parts: RenderableType, **how: Any
) -> tuple[str, ...]:
    """Write results where a folder is named, and return the sentences that say where they are.

    Where the disk refuses, ``parts`` are shown first, as :func:`show` does: what was found is not
    lost.
    """
    if out is None:
        return ()
    made = files()
    if not made:
        return ()
    try:
        earlier = write_files(out, made)
    except ArtefactError:
        show(*parts, **how)
        raise
    written = f"Written to {out}/: {', '.join(made)}"
    return (written,) if earlier is None else (f"Earlier results moved to {earlier}/", written)


def enter_pressed(question: str) -> bool:
    """Ask for Enter; false at the end of the input, true where there is no terminal to ask."""
    if not sys.stdin.isatty():
        return True
    show(question)
    return bool(sys.stdin.readline())


def end_interrupted(*lines: str) -> NoReturn:
    """End a command that Ctrl-C has cut short, with what is to be said of it."""
    show(*lines, stderr=True)
    raise typer.Exit(INTERRUPTED)


def exit_unless(good: bool, code: int = 1) -> None:
    """End the command with an exit code where a result is not as it should be."""
    if not good:
        raise typer.Exit(code)
