"""Processes and threads of our own, and whether the system has what a run needs.

Processes are forked, so that they begin with everything compiled.  What the system refuses
(memory, threads, processes, descriptors, disk) is a :class:`undertow.base.ResourceError`.
"""

from __future__ import annotations

import contextlib
import errno
import math
import mmap
import multiprocessing
import os
import signal
import threading
import warnings
from collections.abc import Callable, Collection, Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, Any

from undertow.base import InvalidInputError, ResourceError, error_text

if TYPE_CHECKING:  # not on Windows
    from multiprocessing.context import ForkProcess

try:
    import resource
except ImportError:  # not on Windows
    resource = None  # type: ignore[assignment]


#: Signals that ask for a safe stop, where the system has them.
STOPPING = tuple(
    getattr(signal, name)
    for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGTSTP", "SIGQUIT")
    if hasattr(signal, name)
)

#: The longest that a thread may take to begin, s.
START_TIMEOUT = 5.0

#: Memory that a run needs besides what its process has when it begins, bytes: for itself, and
#: for each process that it forks, which shares what neither of them changes.
MEMORY, MEMORY_EACH = 128 << 20, 48 << 20

#: Descriptors that a run needs: for itself, and for each process that it forks.
FILES, FILES_EACH = 16, 8

#: How large a log may grow at least, bytes: a run of a minute.
FILE = 32 << 20

#: What the system says when it has not enough of something.
_SHORT = {
    errno.EMFILE, errno.ENFILE, errno.EAGAIN, errno.ENOMEM, errno.ENOSPC, errno.EFBIG,
    getattr(errno, "EDQUOT", errno.ENOSPC),
}  # fmt: skip


def _limit(name: str, option: str) -> str:
    """Return what the system allows, in words: ``at most 100 (ulimit -u)``."""
    soft = _soft_limit(name)
    if soft == math.inf:
        return f"no limit of this process (ulimit {option}), so it is the system's own"
    return f"at most {soft:,} (ulimit {option})"


def _soft_limit(name: str) -> float:
    """Return a limit of this process; inf if there is none."""
    if resource is None:
        return math.inf
    soft, _ = resource.getrlimit(getattr(resource, name))
    return math.inf if soft == resource.RLIM_INFINITY else soft


def fork(
    target: Callable[..., None],
    args: tuple[Any, ...],
    name: str,
    *,
    daemon: bool = True,
    ignores: Collection[int] = (),
) -> ForkProcess:
    """Start a function in a process that is a copy of this one.

    Python 3.12 and later warn that threads of this process may hold locks that the copy
    waits for.  Ours are begun after the forks; those of a linear algebra library take care
    of themselves.

    ``daemon``: whether it is ended with this process, by SIGTERM; otherwise this one waits for it.
    ``ignores``: which of :data:`STOPPING` it ignores from the beginning, in a session of its own:
    Ctrl-C, Ctrl-Z and a lost connection reach every process of a terminal, and a supervisor that is
    stopped or ended with its controller keeps nothing. The others end it. A stop that is asked for
    meanwhile reaches this process once the other has begun. Raises InvalidInputError on a system
    that cannot copy a process; ResourceError when the system has no process more, or no memory for
    it.
    """
    if not hasattr(os, "fork"):
        raise InvalidInputError(
            name,
            value="a system that cannot fork",
            limit="Linux or macOS",
            remedy="Write --worker thread, or run in simulated time",
        )
    process = multiprocessing.get_context("fork").Process(
        target=_begin, args=(target, args, ignores), name=name, daemon=daemon
    )
    with signals_deferred(), _blocked(), warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        try:
            process.start()
        except (OSError, MemoryError) as error:
            raise ResourceError(
                f"process '{name}'",
                value=error_text(error),
                limit=f"a process more, {_limit('RLIMIT_NPROC', '-u')}",
                remedy="End other processes of this user, raise the limit, or run the optimiser "
                "in a thread: --worker thread",
            ) from error
    return process


@contextlib.contextmanager
def _blocked() -> Iterator[None]:
    """Let what asks a process for a stop wait in the system while it is being copied.

    Python forgets the signals that reach the copy before it has begun.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, STOPPING)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _begin(target: Callable[..., None], args: tuple[Any, ...], ignores: Collection[int]) -> None:
    """Run what was forked, with signals of its own."""
    if ignores:
        with contextlib.suppress(OSError):
            os.setsid()
    for number in STOPPING:
        signal.signal(number, signal.SIG_IGN if number in ignores else signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, STOPPING)
    target(*args)


def pipe() -> tuple[Connection, Connection]:
    """Return the two ends of a pipe.

    Raises ResourceError when this process may have no more files open.
    """
    try:
        return multiprocessing.get_context("fork").Pipe()
    except OSError as error:
        raise _no_files(error) from error


@contextlib.contextmanager
def signals_deferred() -> Iterator[None]:
    """Let signals that ask for a stop wait until what is being opened can also be closed."""
    heard: list[int] = []
    try:
        with signals_handled(lambda number, _: heard.append(number)):
            yield
    finally:
        for number in dict.fromkeys(heard):
            os.kill(os.getpid(), number)


@contextlib.contextmanager
def signals_ignored() -> Iterator[None]:
    """Let no signal that asks for a stop interrupt what is being closed."""
    with signals_handled(signal.SIG_IGN):
        yield


@contextlib.contextmanager
def signals_handled(handler: Callable[[int, Any], None] | signal.Handlers) -> Iterator[None]:
    """Handle the signals that ask for a stop in another way, but for those that are ignored."""
    with contextlib.ExitStack() as stack:  # restores the rest, too, when a handler raises
        if threading.current_thread() is threading.main_thread():
            for number in STOPPING:
                before = signal.getsignal(number)
                if before not in (signal.SIG_IGN, None):  # None: not Python's own
                    stack.callback(signal.signal, number, before)
                    signal.signal(number, handler)
        yield


class Background(threading.Thread):
    """A thread beside the fast loop that has begun when it is made, or is refused in time.

    :meth:`threading.Thread.start` waits without end for a thread that the system made but had
    no memory to begin with.

    The process does not wait for ``target`` when it ends. Raises ResourceError when it does not
    begin.
    """

    def __init__(self, target: Callable[[], None], name: str) -> None:
        super().__init__(name=name, daemon=True)
        self._work, self._begun = target, threading.Event()
        self._started = _BoundedEvent()  # what `start` waits for
        try:
            self.start()
        except (RuntimeError, MemoryError) as error:
            raise self._refused(error_text(error)) from error
        if not self._begun.wait(START_TIMEOUT):
            raise self._refused(f"it has not begun after {START_TIMEOUT:g} s")

    def run(self) -> None:
        """Work, once it is known to have begun."""
        self._begun.set()
        self._work()

    def _refused(self, value: str) -> ResourceError:
        return ResourceError(
            f"thread '{self.name}'",
            value=value,
            limit=f"a thread more: memory for its stack (ulimit -v); of threads and processes "
            f"{_limit('RLIMIT_NPROC', '-u')}",
            remedy="End other programs of this user, or raise the limit",
        )


class _BoundedEvent(threading.Event):
    """An event that nobody waits for without end."""

    def wait(self, timeout: float | None = None) -> bool:
        return super().wait(START_TIMEOUT if timeout is None else timeout)


def check_resources(*, processes: int, log: bool = False) -> None:
    """See that the system has what a run needs, before anything of a rig is touched.

    It will fork so many processes; what the disk of a log has free is
    :func:`undertow.runtime.log.check_log`'s. Raises ResourceError when it has not.
    """
    _check_memory(MEMORY + processes * MEMORY_EACH)
    _check_files(FILES + processes * FILES_EACH)
    if log:
        _check_file_size()


def _check_memory(need: int) -> None:
    free = _available()
    try:
        with contextlib.closing(mmap.mmap(-1, need)):  # address space, not touched
            pass
    except (OSError, ValueError) as error:
        limit, what = _limit("RLIMIT_AS", "-v"), error_text(error)
    else:
        if free >= need:
            return
        limit, what = "what the machine or its container has", f"{free / 2**20:,.0f} MiB free"
    raise ResourceError(
        "memory for a run",
        value=what,
        limit=f"{need / 2**20:,.0f} MiB free; {limit}",
        remedy="End other programs, raise the limit, or fork no processes: --worker thread",
    )


def _available() -> float:
    """Return how much memory the machine or its container can give, bytes; inf if unknown."""
    free = math.inf
    with contextlib.suppress(OSError, ValueError, IndexError):
        text = Path("/proc/meminfo").read_text(encoding="ascii")
        free = 1024.0 * int(text.split("MemAvailable:")[1].split()[0])
    with contextlib.suppress(OSError, ValueError):
        group = Path("/sys/fs/cgroup")
        most, used = ((group / f"memory.{name}").read_text("ascii") for name in ("max", "current"))
        kept = (group / "memory.stat").read_text("ascii").split("inactive_file ")[1].split()[0]
        free = min(free, float(int(most) - int(used) + int(kept)))
    return free


def _check_files(need: int) -> None:
    opened: list[int] = []
    try:
        opened.append(os.open(os.devnull, os.O_RDONLY))
        opened.extend(os.dup(opened[0]) for _ in range(need - 1))
    except OSError as error:
        raise _no_files(error, need) from error
    finally:
        for number in opened:
            os.close(number)


def _no_files(error: OSError, need: int = 2) -> ResourceError:
    return ResourceError(
        "open files of this process",
        value=error_text(error),
        limit=f"{need} more; {_limit('RLIMIT_NOFILE', '-n')}",
        remedy="Raise the limit: ulimit -n 1024",
    )


def _check_file_size() -> None:
    largest = _soft_limit("RLIMIT_FSIZE")
    if largest < FILE:
        raise ResourceError(
            "size of a file of this process",
            value=f"at most {largest / 2**20:,.1f} MiB",
            limit=f"{FILE / 2**20:g} MiB, a log of a minute",
            remedy="Raise the limit: ulimit -f unlimited",
        )


@contextlib.contextmanager
def resource_errors(what: str) -> Iterator[None]:
    """Say of what the system refuses for lack of something what it was for.

    Raises ResourceError in the place of a MemoryError, and of an OSError for lack of memory,
    processes, descriptors or disk.
    """
    try:
        yield
    except (MemoryError, OSError) as error:
        if isinstance(error, OSError) and error.errno not in _SHORT:
            raise
        raise ResourceError(
            what,
            value=error_text(error),
            limit="what the system gives: ulimit -a, free -m, df",
            remedy="End other programs, or raise the limit",
        ) from error
