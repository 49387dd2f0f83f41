"""Processes of our own: forked, so that they begin with everything compiled."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import warnings
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING, Any

from undertow.errors import InvalidInputError

if TYPE_CHECKING:  # not on Windows
    from multiprocessing.context import ForkProcess

__all__ = ["fork", "pipe", "withdraw"]


def fork(
    target: Callable[..., None], args: tuple[Any, ...], name: str, *, daemon: bool = True
) -> ForkProcess:
    """Start a function in a process that is a copy of this one.

    Python 3.12 and later warn that threads of this process may hold locks that the copy
    waits for.  Ours are begun after the forks; those of a linear algebra library take care
    of themselves.

    Raises
    ------
    InvalidInputError
        On a system that cannot copy a process.
    """
    if not hasattr(os, "fork"):
        raise InvalidInputError(
            name,
            value="a system that cannot fork",
            limit="Linux or macOS",
            remedy="Write --worker thread, or run in simulated time",
        )
    process = multiprocessing.get_context("fork").Process(
        target=target, args=args, name=name, daemon=daemon
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        process.start()
    return process


def pipe() -> tuple[Connection, Connection]:
    """Return the two ends of a pipe."""
    return multiprocessing.get_context("fork").Pipe()


def withdraw() -> None:
    """Leave this process to its own: what a terminal sends is for the one that controls.

    Ctrl-C, Ctrl-Z and a lost connection reach every process of a session: a keeper that is
    stopped or ended with its controller keeps nothing.
    """
    with contextlib.suppress(OSError):
        os.setsid()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
