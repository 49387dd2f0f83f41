"""numba's compiler, with all plain arithmetic past its front end.

numba takes a function through some twenty passes, line by line, which is most of the time that a
kernel takes to compile.  Nearly all lines of this package's compiled functions are plain, see
:mod:`.lowering`; each run of them becomes one call of a :class:`~.lowering.Part`, see
:mod:`.outlining`, and what is left, the making of arrays and the like, goes through numba.  Where a
part turns out to need more than that, numba compiles the function as it is.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

from numba.core import compiler as numba_compiler
from numba.core import errors as numba_errors

from undertow.symbolic.machine import numba

__all__ = ["PRIMITIVES", "brief", "compiled"]

#: What a generated module imports beside :data:`.function.PREAMBLE`.
PRIMITIVES = (
    "from undertow.symbolic.compiler import compiled\n"
    "from undertow.symbolic.primitives import memory, select\n"
)

#: Modules without types.
compiler: Any = numba_compiler
errors: Any = numba_errors


#: Functions that numba compiled as they are because a part of them was not plain after all.
UNSUITED: list[str] = []


class Compiler(compiler.Compiler):  # type: ignore[misc]
    """numba's compiler of functions whose plain lines are parts."""

    #: Attributes of the functions, LLVM's words.
    attributes: tuple[str, ...] = ()

    def compile_extra(self, function: Any) -> Any:
        """Compile a function."""
        from undertow.symbolic.outlining import outline  # with what only compiling needs

        outlined, parts = outline(function)
        for part in parts:
            part.enter(self.state.typingctx, self.state.targetctx, self.attributes)
        try:
            return super().compile_extra(outlined)
        except errors.NumbaError as error:
            if not parts:
                raise
            UNSUITED.append(f"{function.__module__}.{function.__qualname__}: {error}")
            state = self.state
            again = type(self)(
                state.typingctx,
                state.targetctx,
                state.library,
                state.args,
                state.return_type,
                state.flags,
                state.locals,
            )
            return compiler.CompilerBase.compile_extra(again, function)
        finally:
            for part in parts:
                part.leave(self.state.targetctx)


class SmallCompiler(Compiler):
    """The same for as little code as goes: loops over a few coordinates stay loops.

    Unrolled and vectorised, as LLVM does it, they are twice the code and take twice the time to
    compile.
    """

    attributes = ("optsize",)


Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(*signature: Any, small: bool = False, **options: Any) -> Any:
    """Return the decorator of this package's compiled functions: no lock of the interpreter.

    Nor are there exceptions: arithmetic is NumPy's. ``*signature``: types of the arguments, for
    a function that is compiled when it is defined. ``small``: the code is, for what is long and
    has no lanes. ``**options``: numba's.
    """
    pipeline = SmallCompiler if small else Compiler
    usual = {"cache": True, "nogil": True, "no_cfunc_wrapper": True, "pipeline_class": pipeline}
    return numba.njit(*signature, error_model="numpy", **{**usual, **options})


def brief(**options: Any) -> Callable[[Function], Function]:
    """Return the same for small functions, which take about a microsecond.

    They keep the interpreter's lock: to let go of it for so short a time is to hand it to another
    thread, and to wait.
    """
    return cast(Callable[[Function], Function], compiled(nogil=False, small=True, **options))
