"""Ctrl-C in the command line: one line, no traceback, in its first second and in a compiler.

Importing takes a second, in which an exception may surface anywhere in other people's modules.
While nothing is under way yet there is nothing to clean up: the process says so and ends.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Any

#: Exit status of a command that Ctrl-C ended, as shells have it.
INTERRUPTED = 130

#: After which a Ctrl-C that was swallowed comes again, s.
AGAIN = 0.2


def _leave(_signal: int, _frame: FrameType | None) -> None:
    os.write(2, b"interrupted\n")
    os._exit(INTERRUPTED)


def _is_command_line() -> bool:
    """Whether this process is ``undertow …`` or ``python -m undertow …``, and starting."""
    first = sys.argv[0] if sys.argv else ""
    if first == "-m":  # as long as Python looks for the module
        return "undertow" in sys.orig_argv or "-mundertow" in sys.orig_argv
    name = os.path.splitext(os.path.basename(first))[0]
    return name == "undertow" and first in sys.orig_argv  # children of a process have other words


def at_once() -> None:
    """Let Ctrl-C end the process at once, where it is the command line and nothing else asks."""
    if _is_command_line() and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        with suppress(ValueError):  # not the main thread
            signal.signal(signal.SIGINT, _leave)


def by_exception() -> None:
    """Let Ctrl-C be Python's own KeyboardInterrupt again: commands clean up after themselves."""
    if signal.getsignal(signal.SIGINT) is _leave:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@contextmanager
def ended_as_interrupted() -> Iterator[None]:
    """Let SIGTERM, with which systems end what has run too long, end what is done in it as Ctrl-C.

    So it does where Ctrl-C itself is ignored, as shells have it for jobs in the background.  Where
    somebody else handles SIGTERM, and in other threads than the main one, nothing changes.
    """
    mine = signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    if not mine or threading.current_thread() is not threading.main_thread():
        yield
        return
    signal.signal(signal.SIGTERM, _end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


def _end(number: int, frame: FrameType | None) -> None:
    asked = signal.getsignal(signal.SIGINT)
    if not callable(asked):
        raise KeyboardInterrupt
    asked(number, frame)


def _once_more() -> None:
    heard = callable(signal.getsignal(signal.SIGINT))
    signal.raise_signal(signal.SIGINT if heard else signal.SIGTERM)


@contextmanager
def interruptible() -> Iterator[None]:
    """Let Ctrl-C end what is done in it, also where it meets a function that C calls.

    Python looks for Ctrl-C between two of its own steps; while a compiler works the next one is in
    a function that the compiler calls, through which no exception can pass: Python passes it over.
    What then fails for want of what that function should have done has been interrupted; where
    nothing fails, Ctrl-C comes again.
    """
    again: list[threading.Timer] = []
    before = sys.unraisablehook

    def note(met: Any) -> None:
        if met.exc_type is not KeyboardInterrupt:
            before(met)
        elif not (again and again[-1].is_alive()):
            again.append(threading.Timer(AGAIN, _once_more))
            again[-1].daemon = True
            again[-1].start()

    sys.unraisablehook = note
    try:
        yield
    except Exception:
        if again:
            raise KeyboardInterrupt from None
        raise
    finally:
        sys.unraisablehook = before
        for timer in again:
            timer.cancel()
