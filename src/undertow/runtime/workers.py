"""Who computes the answers of the slow loop: at once, in a thread, or in other processes."""

from __future__ import annotations

import contextlib
import ctypes
import io
import os
import pickle
import signal
from collections import deque
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from queue import SimpleQueue
from typing import Any, Generic, Protocol, TypeVar

from undertow.base import ResourceError
from undertow.runtime.processes import START_TIMEOUT, STOPPING, Background, fork, pipe
from undertow.runtime.slow_loop import Answer, Compute, Request

#: The first that a process says which is to compute.
BEGUN = "begun"


class Packer:
    """Writes what goes between two processes; motions that both of them have go by number.

    ``shared`` is what the other process has, too, for it was forked from this one.
    """

    def __init__(self, shared: Sequence[object] = ()) -> None:
        self.shared = tuple(shared)
        self._numbers = {id(one): number for number, one in enumerate(self.shared)}

    def pack(self, what: object) -> bytes:
        """Return bytes from which :meth:`unpack` makes it again."""
        if not self.shared:
            return pickle.dumps(what, pickle.HIGHEST_PROTOCOL)
        numbers, buffer = self._numbers, io.BytesIO()

        class Pickler(pickle.Pickler):
            def persistent_id(self, one: object) -> int | None:
                return numbers.get(id(one))

        Pickler(buffer, pickle.HIGHEST_PROTOCOL).dump(what)
        return buffer.getvalue()

    def unpack(self, content: bytes) -> Any:
        """Return what was written."""
        shared = self.shared

        class Unpickler(pickle.Unpickler):
            def persistent_load(self, number: int) -> object:
                return shared[number]

        return Unpickler(io.BytesIO(content)).load()


#: What asks the fast loop for a stop, which decides when its processes end, by SIGTERM.
OTHERS = tuple(number for number in STOPPING if number != signal.SIGTERM)


#: What a worker is asked, and what it answers.
Asked_contra = TypeVar("Asked_contra", contravariant=True)
Said_co = TypeVar("Said_co", covariant=True)


class Worker(Protocol[Asked_contra, Said_co]):
    """Who computes answers: the fast loop asks, and takes what is there, never waiting."""

    def ask(self, request: Asked_contra) -> None:
        """Hand over a request."""
        ...

    def take(self, t: float) -> Said_co | None:
        """Return the next answer that has arrived by the time t, s, if there is one."""
        ...

    def replace(self) -> bool:
        """Give up on the present computation; whether there is someone to take over."""
        ...

    def close(self) -> None:
        """Stop computing."""
        ...


class InlineWorker:
    """Computes at once, and answers after a latency of simulated time.

    ``latency`` is the simulated time from request to answer, s: by default less than
    :data:`undertow.runtime.controller.EARLY_LEAD`, so that what is asked for so soon is in time.
    """

    def __init__(self, compute: Compute, latency: float = 0.015) -> None:
        self.compute, self.latency = compute, latency
        self.waiting: deque[tuple[float, Answer]] = deque()

    def ask(self, request: Request) -> None:
        """Compute the answer."""
        self.waiting.append((request.t + self.latency, self.compute(request)))

    def take(self, t: float) -> Answer | None:
        """Return the answer once its latency has passed."""
        if self.waiting and self.waiting[0][0] <= t + 1e-9:
            return self.waiting.popleft()[1]
        return None

    def replace(self) -> bool:
        """Forget what was asked."""
        self.waiting.clear()
        return True

    def close(self) -> None:
        """Nothing to stop."""


#: What a background worker is asked, and what it answers: for a slow loop these two.
Asked = TypeVar("Asked")
Said = TypeVar("Said")


class BackgroundWorker(Generic[Asked, Said]):
    """Computes in other threads, which may in turn wait for other processes.

    Every computer has its thread from the beginning: a run that needs the next one asks the
    system for nothing.
    """

    def __init__(self, computers: list[_Computer[Asked, Said]]) -> None:
        self.computers = computers
        try:
            for computer in computers:
                computer.begin()
        except ResourceError:
            self.close()
            raise

    @property
    def processes(self) -> list[int]:
        """Process ids of the computers, the one that computes first."""
        return [c.process.pid or 0 for c in self.computers if isinstance(c, _Child)]

    def ask(self, request: Asked) -> None:
        """Hand the request over; costs some microseconds."""
        self.computers[0].requests.put(request)

    def take(self, t: float) -> Said | None:
        """Return an answer that has arrived."""
        answers = self.computers[0].answers
        return answers.popleft() if answers else None

    def replace(self) -> bool:
        """End the present computation and let the next computer take over."""
        if len(self.computers) < 2:
            return False
        self.computers.pop(0).close()
        return True

    def close(self) -> None:
        """End all computers."""
        for computer in self.computers:
            computer.close()


class _Computer(Generic[Asked, Said]):
    """A computation, and a thread that carries requests there and answers back."""

    def __init__(self, compute: Callable[[Asked], Said]) -> None:
        self.compute = compute
        self.requests: SimpleQueue[Asked | None] = SimpleQueue()
        self.answers: deque[Said] = deque()

    def begin(self) -> None:
        """Start the thread; processes are forked before."""
        Background(self._carry, "undertow slow loop")

    def _carry(self) -> None:
        with contextlib.suppress(EOFError, OSError):  # gone, or ended while it is asked
            while (request := self.requests.get()) is not None:
                self.answers.append(self.compute(request))

    def close(self) -> None:
        """Ask for no more; a thread cannot be ended from outside: it is left behind."""
        self.requests.put(None)


class _Child(_Computer[Asked, Said]):
    """A forked process: it has everything compiled already, and can be ended at any time."""

    def __init__(self, compute: Callable[[Asked], Said], packer: Packer) -> None:
        self.pipe, theirs = pipe()
        self._packer = packer
        try:
            self.process = fork(
                _serve, (compute, theirs, self.pipe, packer), "undertow slow loop", ignores=OTHERS
            )
        except BaseException:
            self.pipe.close()  # which ends it
            raise
        finally:
            theirs.close()
        super().__init__(self._exchange)
        if not self._begun():
            self.process.kill()
            self.pipe.close()
            self.process.join(START_TIMEOUT)
            raise ResourceError(
                "process 'undertow slow loop'",
                value=f"it ended with exit code {self.process.exitcode}",
                limit=f"one that answers within {START_TIMEOUT:g} s",
                remedy="The system ends processes for lack of memory: end other programs",
            )

    def _begun(self) -> bool:
        with contextlib.suppress(EOFError, OSError):
            return self.pipe.poll(START_TIMEOUT) and self.pipe.recv() == BEGUN
        return False

    def _carry(self) -> None:
        with self.pipe:  # closed by the thread that reads it: a descriptor read by one and closed
            super()._carry()  # by another may by then belong to another file

    def _exchange(self, request: Asked) -> Said:
        self.pipe.send_bytes(self._packer.pack(request))
        answer: Said = self._packer.unpack(self.pipe.recv_bytes())
        return answer

    def close(self) -> None:
        """Kill the process, and do not wait for it."""
        self.process.kill()  # which ends what the thread reads
        super().close()


def _serve(
    compute: Callable[[Any], Any], ours: Connection, theirs: Connection, packer: Packer
) -> None:
    """Answer requests until the other end is gone."""
    theirs.close()
    with contextlib.suppress(OSError, AttributeError):  # Linux: do not outlive the fast loop
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)
    with contextlib.suppress(EOFError, OSError):
        ours.send(BEGUN)
        while True:
            ours.send_bytes(packer.pack(compute(packer.unpack(ours.recv_bytes()))))


def background_worker(
    compute: Callable[[Asked], Said], *, processes: int = 3, shared: Sequence[object] = ()
) -> BackgroundWorker[Asked, Said]:
    """Return a worker on another core: one process computes, the others stand by.

    ``compute`` has been called once before, so that everything is compiled. ``processes`` are
    forked now, while the fast loop does not run yet: one to compute, the rest to take over from one
    that hangs or dies; 0: a thread of this process. ``shared`` is what requests and answers hold
    that both sides have: a long reference.

    Raises
    ------
    ResourceError
        When the system has no process or thread more.
    """
    forked = processes >= 1 and hasattr(os, "fork")
    computers: list[_Computer[Asked, Said]] = []
    try:
        for _ in range(max(1, processes)):
            computers.append(_Child(compute, Packer(shared)) if forked else _Computer(compute))
    except BaseException:
        for computer in computers:
            computer.close()
        raise
    return BackgroundWorker(computers)
