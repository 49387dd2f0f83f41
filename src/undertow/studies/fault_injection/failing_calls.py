"""Calls of the system that fail on demand: the n-th of its kind, once or from then on.

What is counted, and fails:

- ``fork`` of this process, the start of a ``thread``, ``open`` of a file and ``fsync`` by Python;
- ``open`` and ``fsync`` by SQLite, and each of its writes to the ``disk``, below its own
  handling of errors: in a virtual file system put between SQLite and the system's;
- an ``insert`` into the log.

Nothing in the library knows of it: names of the standard library are replaced while
:func:`failing` is in force.  A rig counts its own calls, see
:class:`undertow.studies.fault_injection.systematic.Device`.
"""

from __future__ import annotations

import builtins
import contextlib
import ctypes
import errno
import io
import mmap
import os
import sqlite3
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Self

import numpy as np

from undertow.base import InvalidInputError

#: What may fail, in the order of the tables.  A call that was "taken" has had its effect when
#: it fails.
OPERATIONS = (
    "read", "write", "write-taken", "close", "close-taken",
    "fork", "thread", "open", "fsync", "insert", "disk",
)  # fmt: skip

_PLACES = {name: place for place, name in enumerate(OPERATIONS)}


@dataclass(frozen=True, order=True)
class Fault:
    """One fault: the n-th call of an operation fails, once or from then on, on a rig.

    It is the ``n``-th call, from 1, of one of :data:`OPERATIONS`; with ``always`` all later ones
    fail too.
    """

    operation: str
    n: int
    always: bool
    rig: str

    def __str__(self) -> str:
        """Return it as :meth:`parse` takes it."""
        return f"{self.operation}:{self.n}:{'always' if self.always else 'once'}:{self.rig}"

    @classmethod
    def parse(cls, text: str) -> Self:
        """Return the fault that is written as ``write:17:always:ideal``.

        Raises InvalidInputError when it is none.
        """
        parts = text.split(":")
        right = len(parts) == 4 and parts[0] in OPERATIONS and parts[1].isdecimal()
        if not right or int(parts[1]) < 1 or parts[2] not in ("once", "always"):
            raise InvalidInputError(
                "fault",
                value=repr(text),
                limit="OPERATION:N:once|always:RIG, with an operation of " + ", ".join(OPERATIONS),
                remedy="For example write:17:always:ideal",
            )
        return cls(parts[0], int(parts[1]), parts[2] == "always", parts[3])


class Tally:
    """Counts calls in memory that forked processes share, and knows whose turn it is to fail.

    ``counts``: calls of each of :data:`OPERATIONS` so far.
    """

    def __init__(self, fault: Fault | None = None) -> None:
        self.fault = fault
        shared = mmap.mmap(-1, 8 * len(OPERATIONS))
        self.counts = np.frombuffer(shared, dtype=np.int64)

    def due(self, operation: str) -> bool:
        """Count a call; whether it is to fail."""
        place, fault = _PLACES[operation], self.fault
        self.counts[place] += 1
        if fault is None or fault.operation != operation:
            return False
        n = int(self.counts[place])
        return n == fault.n or (fault.always and n > fault.n)

    def check(self, operation: str) -> None:
        """Count a call, and raise if it is to fail.

        Raises OSError when it is.
        """
        if self.due(operation):
            raise OSError(errno.EIO, f"{operation} {int(self.counts[_PLACES[operation]])} fails")

    @property
    def failed(self) -> bool:
        """Whether the fault has come."""
        fault = self.fault
        return fault is not None and int(self.counts[_PLACES[fault.operation]]) >= fault.n


@contextlib.contextmanager
def failing(tally: Tally) -> Iterator[None]:
    """Count the calls of this process, not of those that it forks, and let them fail."""
    owner = os.getpid()

    def guarded(operation: str, honest: Callable[..., Any], error: Callable[[], Exception]) -> Any:
        def call(*args: Any, **options: Any) -> Any:
            if os.getpid() == owner and tally.due(operation):
                raise error()
            return honest(*args, **options)

        return call

    def refusal(number: int) -> Callable[[], Exception]:
        return lambda: OSError(number, os.strerror(number))  # of the class for that number

    class Connection(sqlite3.Connection):
        def execute(self, sql: str, *rest: Any) -> sqlite3.Cursor:
            self._insert(sql)
            return super().execute(sql, *rest)

        def executemany(self, sql: str, *rest: Any) -> sqlite3.Cursor:
            self._insert(sql)
            return super().executemany(sql, *rest)

        def _insert(self, sql: str) -> None:
            if sql.startswith("INSERT") and tally.due("insert"):
                raise sqlite3.OperationalError("disk I/O error")

    connect = sqlite3.connect

    def connected(*args: Any, **options: Any) -> sqlite3.Connection:
        file: sqlite3.Connection = connect(*args, **{"factory": Connection, **options})
        return file

    def no_thread() -> Exception:
        return RuntimeError("can't start new thread")

    opening = guarded("open", builtins.open, refusal(errno.EMFILE))
    places: list[tuple[Any, str, Any]] = [
        (os, "fork", guarded("fork", os.fork, refusal(errno.EAGAIN))),
        (threading.Thread, "start", guarded("thread", threading.Thread.start, no_thread)),
        (builtins, "open", opening),
        (io, "open", opening),
        (os, "open", guarded("open", os.open, refusal(errno.EMFILE))),
        (os, "fsync", guarded("fsync", os.fsync, refusal(errno.EIO))),
        (sqlite3, "connect", connected),
    ]
    before = [(where, name, getattr(where, name)) for where, name, _ in places]
    with _sqlite_through(tally):
        try:
            for where, name, call in places:
                setattr(where, name, call)
            yield
        finally:
            for where, name, call in before:
                setattr(where, name, call)


# -- below SQLite --------------------------------------------------------------------------

#: What SQLite's own calls return: a full disk, a sync that failed, a file that cannot be opened.
_FULL, _NO_SYNC, _CANNOT_OPEN = 13, 10 | 4 << 8, 14

_Open = ctypes.CFUNCTYPE(
    ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int, ctypes.c_void_p
)
_Write = ctypes.CFUNCTYPE(
    ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int, ctypes.c_int64
)
_Sync = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_int)


class _System(ctypes.Structure):
    """``sqlite3_vfs`` of SQLite 3, version 3 of the structure."""

    _fields_ = [
        *((name, ctypes.c_int) for name in ("version", "size", "longest")),
        ("following", ctypes.c_void_p),
        ("name", ctypes.c_char_p),
        ("data", ctypes.c_void_p),
        ("open", ctypes.c_void_p),
        ("rest", ctypes.c_void_p * 14),
    ]


class _Methods(ctypes.Structure):
    """``sqlite3_io_methods`` of SQLite 3, version 3 of the structure."""

    _fields_ = [
        ("version", ctypes.c_int),
        *((name, ctypes.c_void_p) for name in ("close", "read", "write", "truncate", "sync")),
        ("rest", ctypes.c_void_p * 13),
    ]


class _FailingSystem:
    """A virtual file system of SQLite that passes everything on to the system's, or fails."""

    def __init__(self, library: ctypes.CDLL) -> None:
        self.tally: Tally | None = None
        self.owner = os.getpid()
        find, self.register = library.sqlite3_vfs_find, library.sqlite3_vfs_register
        find.argtypes, find.restype = [ctypes.c_char_p], ctypes.POINTER(_System)
        self.register.argtypes = [ctypes.POINTER(_System), ctypes.c_int]
        self.leave = library.sqlite3_vfs_unregister
        self.leave.argtypes = [ctypes.POINTER(_System)]
        self.honest = find(None)
        self.vfs = _System.from_buffer_copy(self.honest.contents)
        self.vfs.name = b"undertow failing"
        self._open, self._honest_open = _Open(self._opened), _Open(self.honest.contents.open)
        self.vfs.open = ctypes.cast(self._open, ctypes.c_void_p).value
        #: Address of the methods of a kind of file to what stands in for them.
        self._methods: dict[int, tuple[Any, ...]] = {}

    def due(self, operation: str) -> bool:
        tally = self.tally
        return tally is not None and os.getpid() == self.owner and tally.due(operation)

    def _opened(self, vfs: int, name: int, file: int, flags: int, told: int) -> int:
        """Open a file, and stand in for its methods."""
        if self.due("open"):
            ctypes.c_void_p.from_address(file).value = None
            return _CANNOT_OPEN
        code = int(self._honest_open(vfs, name, file, flags, told))
        methods = ctypes.c_void_p.from_address(file)
        if methods.value:
            methods.value = self._stand_in(methods.value)
        return code

    def _stand_in(self, address: int) -> int:
        if address not in self._methods:
            methods = _Methods.from_buffer_copy(_Methods.from_address(address))
            write = _Write(methods.write)

            def written(file: int, data: int, size: int, place: int) -> int:
                return _FULL if self.due("disk") else int(write(file, data, size, place))

            def synced(_file: int, _flags: int) -> int:
                return _NO_SYNC if self.due("fsync") else 0  # no power is cut here: no wait

            calls = _Write(written), _Sync(synced)
            methods.write, methods.sync = (ctypes.cast(c, ctypes.c_void_p).value for c in calls)
            self._methods[address] = methods, *calls
        return ctypes.addressof(self._methods[address][0])


@lru_cache(maxsize=1)
def _failing_system() -> _FailingSystem | None:
    """Return the one of this process, for files may be open in it for as long as it lives."""
    import _sqlite3

    for place in (None, getattr(_sqlite3, "__file__", None)):
        with contextlib.suppress(AttributeError, OSError, TypeError):
            return _FailingSystem(ctypes.CDLL(place))
    return None


def intercepts_sqlite() -> bool:
    """Whether calls of SQLite to the system can be made to fail: its library must be in reach."""
    return _failing_system() is not None


@contextlib.contextmanager
def _sqlite_through(tally: Tally) -> Iterator[None]:
    system = _failing_system()
    if system is None:
        yield
        return
    system.tally, system.owner = tally, os.getpid()
    system.register(ctypes.byref(system.vfs), 1)
    try:
        yield
    finally:
        system.tally = None
        system.leave(ctypes.byref(system.vfs))
        system.register(system.honest, 1)
