"""Compiled lines for coverage, which does not see them: what is compiled also runs in Python.

A function of ours that Python calls first runs as it is written, on copies of its arrays; what it
returns is thrown away, and the compiled one gives the answer, so that a run says what it always
says.  So do those that its body calls, and the functions of generated modules that call some of
ours; the lines of all other generated modules are in no file of ours.
"""

from __future__ import annotations

import contextlib
import time
from collections import defaultdict
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numba.core.registry import CPUDispatcher

import undertow

#: How long one function also runs in Python in one test, s of processor time; then no more calls.
SECONDS = 0.03

_PACKAGE = str(Path(undertow.__file__).parent)

_spent: defaultdict[Any, float] = defaultdict(float)


def count_compiled() -> None:
    """Let compiled functions run in Python, too, from now on."""
    dispatcher: Any = CPUDispatcher
    compiled = dispatcher.__call__

    def call(self: Any, *args: Any) -> Any:
        if not _has_lines_of_ours(self):
            return compiled(self, *args)
        if self.targetoptions.get("no_cpython_wrapper"):  # has no way in but from compiled code
            return self.py_func(*args)
        if _spent[self] < SECONDS:
            began = time.thread_time()
            # Python refuses what compiled arithmetic does not: that body ends there.
            with contextlib.suppress(Exception), np.errstate(all="ignore"):
                self.py_func(*map(_copy, args))
            _spent[self] += time.thread_time() - began
        return compiled(self, *args)

    dispatcher.__call__ = call


def begin_test() -> None:
    """Give each function its time anew."""
    _spent.clear()


@cache
def _has_lines_of_ours(function: Any) -> bool:
    """Whether a compiled function is in the package, or generated and calls one that is."""
    names = function.py_func.__globals__.values()
    called = (each for each in names if isinstance(each, CPUDispatcher))
    return _is_ours(function) or any(map(_is_ours, called))


def _is_ours(function: Any) -> bool:
    return str(function.py_func.__code__.co_filename).startswith(_PACKAGE)


def _copy(value: Any) -> Any:
    """Return an argument as compiled code has it: arrays to write to, numbers that divide by 0."""
    if isinstance(value, np.ndarray):
        return value.copy()
    if isinstance(value, tuple) and type(value) is tuple:
        return tuple(map(_copy, value))
    return np.float64(value) if isinstance(value, float) else value
