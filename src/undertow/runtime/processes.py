"""Processes of our own: forked, so that they begin with everything compiled."""

from __future__ import annotations

import multiprocessing
import warnings
from collections.abc import Callable
from multiprocessing.connection import Connection
from multiprocessing.context import ForkProcess
from typing import Any

__all__ = ["fork", "pipe"]


def fork(
    target: Callable[..., None], args: tuple[Any, ...], name: str, *, daemon: bool = True
) -> ForkProcess:
    """Start a function in a process that is a copy of this one.

    Python 3.12 and later warn that threads of this process may hold locks that the copy
    waits for.  Ours are begun after the forks; those of a linear algebra library take care
    of themselves.
    """
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
