"""Expressions to running code: the tape, its linear algebra, and the printers."""

from undertow.codegen.tape import Tape
from undertow.codegen.vector import compile_numpy

__all__ = ["Tape", "compile_numpy"]
