"""The page of a run in a process of its own, which shares nothing with the run but its log."""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Self

from undertow.base import ArtefactError, UndertowError, require_extra
from undertow.display.live import serve
from undertow.runtime.processes import Background
from undertow.studies.live.watched import Watched

#: How much this process gives way to others, its niceness.
POLITE = 10

#: How long it may take to begin, s; how long it stays to tell what came of the run.
BEGIN, LINGER = 120.0, 10.0


class Window:
    """A page that shows a run while it goes on, from another process.

    It is begun before the run is prepared: what it has to load is loaded when the run begins.  It
    ends once the run is over and its viewers have been told all of it.

    Parameters
    ----------
    mechanism
        For one's own mechanism in a Python file: which one it is.

    Raises
    ------
    MissingExtraError
        Where ``websockets`` is not installed.
    """

    def __init__(self, mechanism: str | None = None) -> None:
        require_extra("websockets", "show", "the live page needs websockets")
        context = multiprocessing.get_context("spawn")  # no lock or driver of ours is copied
        self._line, theirs = context.Pipe()
        self._process = context.Process(
            target=_show, args=(theirs, mechanism), name="undertow show", daemon=True
        )
        with _safe_path():
            self._process.start()
        theirs.close()

    def open(self, log: Path) -> str:
        """Show the run that writes this log, and return the address of the page.

        Raises
        ------
        ArtefactError
            Where it cannot be shown.
        """
        address, problem = None, "its process has ended"
        with suppress(EOFError, OSError):  # then it has
            self._line.send(log)
            if self._line.poll(BEGIN):
                address, problem = self._line.recv()
            else:
                problem = f"its process has not begun after {BEGIN:g} s"
        if address is None:
            raise ArtefactError(
                "page of a run", value=problem, limit="one that can be opened",
                remedy="Leave --show out, and look from another terminal: undertow show LOG",
            )  # fmt: skip
        return str(address)

    def __enter__(self) -> Self:
        """Return the window."""
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Let it tell what came of the run, and end it."""
        self._line.close()
        if kind is None:
            self._process.join(LINGER)
        self._process.terminate()
        self._process.join(LINGER)


@contextmanager
def _safe_path() -> Iterator[None]:
    """Let Python begin without the working directory among its modules: a signal.py may lie there.

    ``spawn`` starts ``python -c``, which looks there first.
    """
    name = "PYTHONSAFEPATH"
    before = os.environ.get(name)
    os.environ[name] = "1"
    try:
        yield
    finally:
        del os.environ[name]
        if before is not None:
            os.environ[name] = before


def _show(line: Connection, mechanism: str | None) -> None:
    """Show the run whose log is named over the line; end with it."""
    if hasattr(os, "setsid"):
        os.setsid()  # Ctrl-C in the terminal is for the run alone
    if hasattr(os, "nice"):
        os.nice(POLITE)
    Background(_end_with_the_run, "undertow parent")
    try:
        show = Watched(line.recv(), mechanism)
        serve(show, lambda address: line.send((address, "")), port=0, over=lambda: show.over)
    except UndertowError as error:
        line.send((None, str(error)))
    except EOFError:
        pass  # there was no run


def _end_with_the_run() -> None:
    """End when the process of the run does, a while later: its viewers are told."""
    parent = multiprocessing.parent_process()
    assert parent is not None  # this one was spawned
    parent.join()
    time.sleep(LINGER)
    os._exit(0)
