"""The command line: parse and dispatch only, one file for each group of commands.

A command is a function under ``@command`` (:mod:`.terminal`), its help its docstring; options that
several share are in :mod:`.options`, words of users become values in :mod:`.parsing`. The work is
done in :mod:`undertow.studies` and below.
"""

from __future__ import annotations

import io
import os
import sys
from contextlib import suppress
from typing import Annotated

import typer

from undertow.base import INTERRUPTED, at_once, versions
from undertow.cli import (  # noqa: F401 - each registers its commands
    bench,
    campaign,
    certify,
    control,
    doctor,
    export,
    library,
    paper,
    rig,
    show,
    trials,
)
from undertow.cli.terminal import app, folded, say_unwritten

__all__ = ["app", "main"]

#: The order in which help shows the commands: look, steer, prove, run, repeat.
_ORDER = (
    "mechanisms", "models", "derive", "show", "animate", "survey", "optimise", "simulate",
    "certify", "verify", "bench", "run", "target", "replay", "drill", "trials", "campaign",
    "reproduce", "doctor",
)  # fmt: skip


def _place(name: str) -> int:
    """Where help shows a command; one that is not in the order comes last."""
    return _ORDER.index(name) if name in _ORDER else len(_ORDER)


app.registered_commands.sort(
    key=lambda command: _place(str(command.name or getattr(command.callback, "__name__", "")))
)


def _version(asked: bool) -> None:
    if asked:
        typer.echo(f"undertow {versions()['undertow'] or '(from source)'}")
        raise typer.Exit


@app.callback(
    epilog=folded(
        "undertow show rotary_pendulum             # watch it live, push it",
        "undertow simulate rotary_pendulum         # balance it, with numbers",
        "undertow mechanisms                       # what else there is",
        "undertow doctor                           # what is installed, and a test",
        "undertow simulate --help                  # each command has examples",
    )
)
def root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    """Optimal sliding-mode cascade control of underactuated mechanisms."""


def main() -> None:
    """Run the command line."""
    if os.environ.get("COLUMNS") == "0":  # of a terminal whose width is not known
        del os.environ["COLUMNS"]
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:  # closed by who started it: no file may come in its place
            setattr(sys, name, open(os.devnull, mode, encoding="utf-8"))  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # what a terminal cannot show costs no result
            stream.reconfigure(errors="replace")
    try:
        app(prog_name="undertow")
    except KeyboardInterrupt:  # after a command, which says so itself
        sys.stderr.write("interrupted\n")
        raise SystemExit(INTERRUPTED) from None
    except OSError as error:  # in a help or before a command, which says so itself
        say_unwritten(error)
        raise SystemExit(1) from None
    finally:  # what is left is to end
        # An interrupt that met somebody's exec() stays marked as unhandled, and Python would end
        # by the signal instead of the exit status.  The next exec unmarks it.
        exec("")
        with suppress(OSError, ValueError, AttributeError):  # it may be closed, or none at all
            sys.stdout.flush()
        at_once()
