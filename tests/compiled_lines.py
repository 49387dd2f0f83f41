"""Compiled lines for coverage, which does not see them: what is compiled also runs in Python.

A function of ours that Python calls first runs as it is written, on copies of its arrays; what it
returns is thrown away, and the compiled one gives the answer, so that a run says what it always
says.  So do those that its body calls, and the functions of generated modules that call some of
ours; the lines of all other generated modules are in no file of ours.
"""

from __future__ import annotations

import contextlib
import math
import time
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numba.core.registry import CPUDispatcher

import undertow

#: How long what a body calls runs in Python, too, s: then only the compiled functions answer it.
SECONDS = 0.01
#: Times as long as a body took until the next one: what happens in real time has to go on.
REST = 4.0

_PACKAGE = str(Path(undertow.__file__).parent)


def count_compiled() -> None:
    """Let compiled functions run in Python, too, from now on."""
    dispatcher: Any = CPUDispatcher
    compiled, resting, nested = dispatcher.__call__, -math.inf, -math.inf  # until when

    def call(self: Any, *args: Any) -> Any:
        nonlocal resting, nested
        if not _has_lines_of_ours(self):
            return compiled(self, *args)
        if self.targetoptions.get("no_cpython_wrapper"):  # has no way in but from compiled code
            return self.py_func(*args)
        began = time.perf_counter()
        outermost = began >= resting
        if outermost:
            resting, nested = math.inf, began + SECONDS
        if began < nested:
            # Python refuses what compiled arithmetic does not: that body ends there.
            with contextlib.suppress(Exception), np.errstate(all="ignore"):
                self.py_func(*map(_copy, args))
        if outermost:
            ended = time.perf_counter()
            resting, nested = ended + REST * (ended - began), -math.inf
        return compiled(self, *args)

    dispatcher.__call__ = call


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
