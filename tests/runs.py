"""The run that the tests of the runtime share, and how tests type commands."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest
from typer.testing import CliRunner

from undertow.cli import app
from undertow.optimiser import Budget, Optimiser
from undertow.runtime import Recipe, Report, Runtime

RECIPE = Recipe(parameters={"d_e": 0.025}, evaluations=64, start=(0.0, 0.3, 0.0, 0.0))


@contextmanager
def short_searches() -> Iterator[None]:
    """First plans are the best of 512 instead of 14,000 candidates.

    On the rotary pendulum they cost hardly more.  Around a test as a decorator, too.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Optimiser, "usual_cold", Budget(512))
        yield


def run(*words: str) -> tuple[int, str, str]:
    """Type ``undertow WORDS``; exit status, output, errors."""
    result = CliRunner().invoke(app, list(words), env={"COLUMNS": "100", "TERM": "dumb"})
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, result.stdout, result.stderr


def run_until(runtime: Runtime, done: Callable[[Report], bool]) -> Report:
    """Run against the clock until something was seen, however late a busy machine makes it."""
    read = runtime.rig.read

    def reading() -> object:
        if done(runtime.report):
            runtime.stop()
        return read()

    runtime.rig.read = reading  # type: ignore[method-assign, assignment]
    report = runtime.run(120.0)
    assert report.stopped_by == "operator: stop"
    return report
