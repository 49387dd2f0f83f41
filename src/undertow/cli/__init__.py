"""The command line: parse and dispatch only, one file for each group of commands."""

from __future__ import annotations

from typing import Annotated

import typer

from undertow import results
from undertow.cli import bench, certify, control, export, library, paper, rig, trials
from undertow.cli.terminal import app

__all__ = [
    "app",
    "bench",
    "certify",
    "control",
    "export",
    "library",
    "main",
    "paper",
    "rig",
    "trials",
]


def _version(asked: bool) -> None:
    if asked:
        typer.echo(f"undertow {results.versions()['undertow'] or '(from source)'}")
        raise typer.Exit


@app.callback()
def root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    """Optimal sliding-mode cascade control of underactuated mechanisms."""


def main() -> None:
    """Run the command line."""
    app()
