"""Ctrl-C in the command line's first second: one line, no traceback.

Importing takes a second, in which an exception may surface anywhere in other people's modules.
While nothing is under way yet there is nothing to clean up: the process says so and ends.
"""

from __future__ import annotations

import os
import signal
import sys
from contextlib import suppress
from types import FrameType

#: Exit status of a command that Ctrl-C ended, as shells have it.
INTERRUPTED = 130


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
