"""numba, set up for the widest vectors that the processor has, with a cache of one's own.

LLVM avoids 512-bit registers on most processors that have them, because they once lowered
the clock.  For lane loops of double arithmetic they are a quarter faster, see
``benchmarks/kernel.py``.  A user's own ``NUMBA_CPU_FEATURES`` is left alone, and numba's
cache keys on the features, so kernels of either kind never mix.

What numba keeps of compiled functions are pickles, and to load one is to run it.  By itself it
keeps them beside the source, or in a folder that is named by the environment, whoever may write
there, and refuses to decorate a function where it finds no place.  Those of this package and of
its generated modules are kept where nobody else can write, see :mod:`undertow.symbolic.private`.

Before numba loads what it keeps it imports all that it would need to compile, for a quarter of a
second and 25 MB; machine code needs its runtime alone, and here gets no more.

What numba builds while it compiles is there until the end: looking for garbage in it would take a
tenth of the time.  So would functions for callers in C, which :data:`~.compiler.compiled` leaves
out.  All of this is for functions of this package alone; other people's are compiled as ever.
"""

from __future__ import annotations

import gc
import hashlib
import os
import platform
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any

import llvmlite.binding as llvm
import numba
from numba.core import caching as numba_caching
from numba.core import event as numba_event
from numba.core.runtime.nrt import rtsys

from undertow.symbolic.private import is_private, private_folder

__all__ = ["numba", "processor"]

PACKAGE = Path(__file__).resolve().parent.parent

#: numba's own modules have no types.
caching: Any = numba_caching
event: Any = numba_event


def _widen() -> None:
    features = llvm.get_host_cpu_features()
    if features.get("avx512f") and "NUMBA_CPU_FEATURES" not in os.environ:
        vars(numba.config)["CPU_FEATURES"] = features.flatten() + ",-prefer-256-bit"


class _PrivateLocator(caching._SourceFileBackedLocatorMixin, caching._CacheLocator):  # type: ignore[misc]
    """Where numba keeps what it compiles of this package and of its generated modules."""

    def __init__(self, function: Any, file: str) -> None:
        self._py_file, self._lineno = file, function.__code__.co_firstlineno
        self._cache_path = _cache_of(str(Path(file).resolve().parent))

    def get_cache_path(self) -> str:
        return self._cache_path

    def get_source_stamp(self) -> Any:
        """Return what says that a source has changed, or this folder, which makes code of it."""
        return super().get_source_stamp(), _compiler_stamp()

    @classmethod
    def from_function(cls, function: Any, file: str) -> Any:
        return super().from_function(function, file) if _is_ours(file) else None


@lru_cache(maxsize=1)
def _compiler_stamp() -> str:
    files = sorted(Path(__file__).parent.glob("*.py"))
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()


def _is_ours(file: str) -> bool:
    """Whether a source is of this package or one of its generated modules."""
    path = Path(file).resolve()
    return path.is_relative_to(PACKAGE) or path.parent == private_folder()


@lru_cache(maxsize=64)
def _cache_of(folder: str) -> str:
    """Return the folder of what is compiled of the sources in a folder: beside them if private."""
    beside = Path(folder) / "__pycache__"
    if os.access(beside if beside.exists() else folder, os.W_OK):
        try:
            beside.mkdir(mode=0o700, exist_ok=True)
        except OSError:
            pass
        else:
            if is_private(beside):
                return str(beside)
    name = caching._CacheLocator.get_suitable_cache_subpath(str(Path(folder) / "of.py"))
    return str(private_folder() / "numba" / name)


def processor() -> dict[str, str]:
    """Return what of the processor shapes machine code: its name, and what LLVM compiles for.

    ``features`` are those of LLVM that are switched on.
    """
    features = vars(numba.config).get("CPU_FEATURES") or llvm.get_host_cpu_features().flatten()
    return {
        "processor": _model(),
        "target": str(vars(numba.config).get("CPU_NAME") or llvm.get_host_cpu_name()),
        "features": " ".join(sorted(f[1:] for f in features.split(",") if f.startswith("+"))),
    }


def _model() -> str:
    """Return the name that the processor has for people."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    named = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(named, "") or platform.processor() or platform.machine()


def _loading(usual: Any) -> Any:
    """Return how numba loads what it keeps, for our functions without what compiling needs.

    What is damaged, by a full disk or a lost power, is not there.
    """

    def load_overload(cache: Any, signature: Any, target: Any) -> Any:
        if not isinstance(cache._impl.locator, _PrivateLocator):
            return usual(cache, signature, target)
        rtsys.initialize(target)
        try:
            return cache._load_overload(signature, target)
        except Exception:  # a pickle that is cut off may raise anything
            with suppress(OSError):
                cache.flush()
            return None

    return load_overload


def _saving(usual: Any) -> Any:
    """Return how numba keeps what it compiles; a disk that refuses ours only costs time later.

    numba numbers the files of a function in the order in which they come.  Two processes that
    compile it at once for arguments of different types would both begin with the first, and an
    index of the one could lead to the code of the other.  Ours are named by their types.
    """

    def save_overload(cache: Any, signature: Any, data: Any) -> None:
        if not isinstance(cache._impl.locator, _PrivateLocator):
            usual(cache, signature, data)
            return
        types = hashlib.sha256(repr(cache._index_key(signature, data.codegen)).encode())
        name = f"{cache._impl.filename_base}.{types.hexdigest()[:16]}"
        cache._cache_file._data_name_pattern = name + ".{number:d}.nbc"
        with suppress(OSError):
            usual(cache, signature, data)

    return save_overload


class _Sooner(event.Listener):  # type: ignore[misc]
    """While a function of ours is compiled there is no collection of garbage."""

    def __init__(self) -> None:
        self._inside: list[bool] = []
        self._collects = False

    def on_start(self, event: Any) -> None:
        ours = any(self._inside) or _is_ours(event.data["dispatcher"].py_func.__code__.co_filename)
        if ours and not any(self._inside):
            self._collects = gc.isenabled()
            gc.disable()
        self._inside.append(ours)

    def on_end(self, event: Any) -> None:
        if self._inside.pop() and not any(self._inside) and self._collects:
            gc.enable()


_widen()
event.register("numba:compile", _Sooner())
caching.Cache.load_overload = _loading(caching.Cache.load_overload)
caching.Cache.save_overload = _saving(caching.Cache.save_overload)
# The list is searched from its beginning; other people's functions pass ours by.
(getattr(caching, "CacheImpl", None) or caching._CacheImpl)._locator_classes.insert(
    0, _PrivateLocator
)
