"""The run that the tests of the runtime share, and how tests type commands."""

from __future__ import annotations

from typer.testing import CliRunner

from undertow.cli import app
from undertow.runtime import Recipe

RECIPE = Recipe(parameters={"d_e": 0.025}, evaluations=64, start=(0.0, 0.3, 0.0, 0.0))


def run(*words: str) -> tuple[int, str, str]:
    """Type ``undertow WORDS``; exit status, output, errors."""
    result = CliRunner().invoke(app, list(words), env={"COLUMNS": "100", "TERM": "dumb"})
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, result.stdout, result.stderr
