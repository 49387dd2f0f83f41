"""What generated code calls and numba does not have: a choice of two numbers, and memory.

The memory is no array but numbers on the stack: to find one element of an array takes numba many
instructions, which LLVM has to take away again.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir

from undertow.symbolic.machine import numba

#: Modules without types.
llvm: Any = ir
types: Any = numba.types


def select(condition: Any, yes: Any, no: Any) -> Any:
    """``yes if condition else no``, of which compiled code computes both."""
    return yes if condition else no


@numba.extending.type_callable(select)
def _type_of_select(context):  # type: ignore[no-untyped-def]
    def typed(condition, yes, no):  # type: ignore[no-untyped-def]
        kind = context.unify_types(yes, no)
        return kind(types.boolean, kind, kind)

    return typed


#: For any types: what :func:`_type_of_select` lets through.
_ANY = (types.boolean, types.Any, types.Any)


@numba.extending.lower_builtin(select, *_ANY)  # type: ignore[no-untyped-call]
def _generate_select(_context, builder, _signature, values):  # type: ignore[no-untyped-def]
    return builder.select(*values)


def memory(size: int) -> Any:
    """Return room for so many numbers, a constant: in compiled code until the function returns.

    It lies on the stack, from the beginning of a cache line on.
    """
    return np.empty(size)


@numba.extending.type_callable(memory)
def _type_of_memory(context):  # type: ignore[no-untyped-def]
    def typed(size):  # type: ignore[no-untyped-def]
        return types.CPointer(types.float64) if isinstance(size, types.IntegerLiteral) else None

    return typed


@numba.extending.lower_builtin(memory, types.IntegerLiteral)  # type: ignore[no-untyped-call]
def _make_memory(_context, builder, signature, _values):  # type: ignore[no-untyped-def]
    kind = llvm.ArrayType(llvm.DoubleType(), signature.args[0].literal_value)
    with builder.goto_entry_block():
        room = builder.alloca(kind)
    room.align = 64
    return builder.bitcast(room, llvm.DoubleType().as_pointer())
