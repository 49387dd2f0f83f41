"""Time for the fast loop: the wall clock, or simulated time; and how long things took."""

from __future__ import annotations

import contextlib
import ctypes
import os
import sys
import time
from collections.abc import Iterator, Sequence
from typing import Protocol

import numpy as np

__all__ = ["YIELD", "Clock", "Histogram", "SimulatedClock", "WallClock", "locked_memory", "prompt"]


#: After how long a thread that waits for the interpreter's lock asks for it, s: while the fast
#: loop sleeps, which waits itself when it wakes; and while it works, a period at the usual rate.
YIELD, KEEP = 2e-5, 1e-3


class Clock(Protocol):
    """What the fast loop knows of time."""

    simulated: bool

    def now(self) -> float:
        """Return the time, s, from an arbitrary origin."""
        ...

    def sleep_until(self, t: float) -> None:
        """Return at the time t, s, or at once if it is past."""
        ...

    def spin_until(self, t: float) -> None:
        """Like :meth:`sleep_until` for the last moments, without giving the processor away."""
        ...


class WallClock:
    """The monotonic clock of the machine.

    Who sleeps by it gets the interpreter's lock back soon, and is asked for it by other threads
    only when it sleeps again: to be asked in the middle of a step costs that step more than its
    own computation.
    """

    simulated = False
    now = staticmethod(time.perf_counter)

    def sleep_until(self, t: float) -> None:
        """Sleep; the operating system may wake us late, never early."""
        rest = t - time.perf_counter()
        if rest > 0:
            sys.setswitchinterval(YIELD)
            time.sleep(rest)
            sys.setswitchinterval(KEEP)

    def spin_until(self, t: float) -> None:
        """Wait without sleeping: no wake-up to be late for."""
        while time.perf_counter() < t:
            pass


class SimulatedClock:
    """Time that passes when the loop says so: runs are fast and repeatable."""

    simulated = True

    def __init__(self) -> None:
        self.t = 0.0

    def now(self) -> float:
        """Return the simulated time, s."""
        return self.t

    def sleep_until(self, t: float) -> None:
        """Let time pass."""
        self.t = max(self.t, t)

    spin_until = sleep_until


@contextlib.contextmanager
def prompt() -> Iterator[str]:
    """Ask for a real-time priority for this thread; yields what the system said to that."""
    before, said = None, "refused, the system has none"
    if hasattr(os, "sched_setscheduler"):
        try:
            policy = os.sched_getscheduler(0)
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
            before, said = policy, "granted, SCHED_FIFO 1"
        except OSError as error:
            said = f"refused, {error.strerror}: ulimit -r"
    try:
        yield f"real-time priority: {said}"
    finally:
        if before is not None:
            with contextlib.suppress(OSError):
                os.sched_setscheduler(0, before, os.sched_param(0))


#: Of mlockall: what is there, what will come, and each page once it is first used.
CURRENT, FUTURE, ON_FAULT = 1, 2, 4


@contextlib.contextmanager
def locked_memory() -> Iterator[str]:
    """Ask that this process is not paged out; yields what the system said to that.

    What comes later is locked only where there is no limit: else memory would end at the limit.
    """
    library: ctypes.CDLL | None = None
    said = "refused, the system has none"
    if sys.platform == "linux":
        import resource

        endless = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] == resource.RLIM_INFINITY
        with contextlib.suppress(OSError, AttributeError):
            library = ctypes.CDLL(None, use_errno=True)
            flags = CURRENT | ON_FAULT | (FUTURE if endless else 0)
            if library.mlockall(flags) == 0:
                said = "granted" if endless else "granted, for what is in use at the start"
            else:
                said = f"refused, {os.strerror(ctypes.get_errno())}: ulimit -l"
                library = None
    try:
        yield f"memory locked: {said}"
    finally:
        if library is not None:
            library.munlockall()


class Histogram:
    """Durations counted in bins of 1 µs up to 20 ms; nothing is allocated by a count.

    Attributes
    ----------
    longest
        Longest duration, s.
    """

    BINS = 20_000

    def __init__(self) -> None:
        self.counts = np.zeros(self.BINS + 1, dtype=np.int64)
        self.longest = 0.0

    def add(self, seconds: float) -> None:
        """Count one duration, s."""
        place = int(1e6 * seconds)
        self.counts[place if 0 <= place < self.BINS else (0 if place < 0 else self.BINS)] += 1
        self.longest = max(self.longest, seconds)

    def quantile(self, fraction: float) -> float:
        """Return the duration, s, that ``fraction`` of all do not exceed; NaN without any."""
        total = int(self.counts.sum())
        if total == 0:
            return float("nan")
        place = int(np.searchsorted(np.cumsum(self.counts), fraction * total))
        return min((place + 1) * 1e-6, self.longest) if place < self.BINS else self.longest

    def between(self, edges: Sequence[float]) -> list[int]:
        """Return how many durations fall between each two edges, s."""
        places = np.minimum(np.round(1e6 * np.asarray(edges)), self.BINS + 1).astype(int)
        total = np.concatenate([[0], np.cumsum(self.counts)])
        return [int(v) for v in np.diff(total[places])]
