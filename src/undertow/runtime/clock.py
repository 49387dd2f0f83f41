"""Time for the fast loop: clocks, how long things took, what fails how often."""

from __future__ import annotations

import contextlib
import ctypes
import os
import sys
import time
from collections.abc import Iterator, Sequence
from typing import Protocol

import numpy as np

from undertow.runtime.settings import Settings

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
def real_time_priority() -> Iterator[str]:
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
    """Durations counted in bins of 1 µs up to 20 ms; nothing is allocated by a count."""

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


#: Time over which missed periods, and the rates of clocks, are looked at, s.
SECOND = 1.0


class FailureRatio:
    """The part of the last periods that failed, each weighing less the longer ago it was.

    What failed one ``window``, s, ago weighs e⁻¹; ``period`` is that of the fast loop, s. ``value``
    is from 0 to 1; 0 at first, so that it takes some time until a share is found high.

    Examples
    --------
    >>> share = FailureRatio(0.1, 0.001)
    >>> for k in range(1000):
    ...     share.add(k % 4 == 0)
    >>> round(share.value, 2)
    0.25
    """

    def __init__(self, window: float, period: float) -> None:
        self._keep = max(0.0, 1.0 - period / window)
        self.value = 0.0

    def add(self, failed: int, periods: int = 1) -> None:
        """Count some periods, and how many of them failed."""
        keep = self._keep**periods
        self.value = keep * self.value + (1.0 - keep) * failed / periods


class RigClock:
    """Compares the time that a rig tells with the host's, and with the number of steps.

    The clock of hardware keeps to the host's, that of a simulated rig to the steps that it was
    taken through: both agree but where steps are missed, and a rig's clock may lie between them.
    A reading that runs back or jumps by more than a stall is left out: the sensors' watch judges
    it.  One that stands still, of a sensor slower than the loop or of a rig that took no output,
    may have let that time pass or not.

    The settings give the largest drift in a second and the longest stall, s; ``period`` is that of
    the fast loop, s.
    """

    def __init__(self, settings: Settings, period: float) -> None:
        self._drift, self._stall = settings.max_clock_drift, settings.max_step_interval
        self._period = period
        self._last: tuple[float, float, int] | None = None
        self._rig = self._host = self._steps = self._still = 0.0

    def check(self, stamp: float, now: float, step: int) -> str:
        """Return what is wrong with the rig's clock; empty where nothing is.

        ``stamp`` is the time of a reading on the rig's clock, ``now`` that on the host's, s.
        """
        last, self._last = self._last, (stamp, now, step)
        if last is None or not 0.0 <= stamp - last[0] <= self._stall:
            return ""
        host, steps = now - last[1], self._period * (step - last[2])
        moved, passed = stamp - last[0], max(host, steps)
        if not moved:
            host = steps = 0.0
        keep = max(0.0, 1.0 - passed / SECOND)
        self._still = keep * self._still + (0.0 if moved else passed)
        self._rig = keep * self._rig + moved
        self._host = keep * self._host + host
        self._steps = keep * self._steps + steps
        low, high = min(self._host, self._steps), max(self._host, self._steps) + self._still
        if low - self._drift <= self._rig <= high + self._drift:
            return ""
        off = abs(self._rig - (high if self._rig > high else low))
        rate = moved / passed
        return (
            f"the rig's clock went {1e3 * off:.0f} ms off the host's within a second, "
            f"it runs {rate:.2g} times as fast"
        )
