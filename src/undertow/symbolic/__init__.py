"""Expressions to running code: the tape, its linear algebra, the printers, and the cache."""

from undertow.symbolic.block import block_source
from undertow.symbolic.c99 import C99Emitter, Real, literal
from undertow.symbolic.expressions import parse_expression
from undertow.symbolic.function import COMPILED, PREAMBLE, function_source
from undertow.symbolic.linear import SETTLING, UNIT, linear_source
from undertow.symbolic.machine import numba, processor
from undertow.symbolic.names import docstring
from undertow.symbolic.rows import LANES, LoopProgram
from undertow.symbolic.settle import UNSETTLED
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
    "LANES",
    "PREAMBLE",
    "SETTLING",
    "UNIT",
    "UNSETTLED",
    "C99Emitter",
    "LoopProgram",
    "Real",
    "Tape",
    "Workspace",
    "block_source",
    "compile_expressions",
    "compile_numpy",
    "content_key",
    "docstring",
    "function_source",
    "generated",
    "linear_source",
    "literal",
    "load_module",
    "numba",
    "parse_expression",
    "processor",
    "recall",
    "remember",
    "sources_digest",
    "unpacked",
]
