"""Expressions to running code: SymPy in; NumPy, numba, C99 or CUDA out; and the cache of all that.

Formulas become a :class:`~undertow.symbolic.tape.Tape`, a straight-line program of small
assignments with its linear algebra unrolled. The printers make code of it: :mod:`.function` and
:mod:`.vector` for Python, :mod:`.scalar` for the kernels' loops, :mod:`.c99`, :mod:`.cuda`.
:mod:`.store` keeps what was generated, :mod:`.machine` sets numba up.
"""

from undertow.symbolic.c99 import C99Emitter, Real, literal
from undertow.symbolic.compiler import PRIMITIVES, brief, compiled
from undertow.symbolic.expressions import parse_expression
from undertow.symbolic.function import COMPILED, PREAMBLE, function_source, scalar_module
from undertow.symbolic.machine import numba, processor
from undertow.symbolic.names import distinct, docstring
from undertow.symbolic.scalar import Emitter
from undertow.symbolic.store import (
    content_key,
    generated,
    load_module,
    recall,
    remember,
    sources_digest,
)
from undertow.symbolic.tape import Tape
from undertow.symbolic.vector import compile_expressions, compile_numpy
from undertow.symbolic.workspace import BRIEF, Workspace, unpacked

__all__ = [
    "BRIEF",
    "COMPILED",
    "PREAMBLE",
    "PRIMITIVES",
    "C99Emitter",
    "Emitter",
    "Real",
    "Tape",
    "Workspace",
    "brief",
    "compile_expressions",
    "compile_numpy",
    "compiled",
    "content_key",
    "distinct",
    "docstring",
    "function_source",
    "generated",
    "literal",
    "load_module",
    "numba",
    "parse_expression",
    "processor",
    "recall",
    "remember",
    "scalar_module",
    "sources_digest",
    "unpacked",
]
