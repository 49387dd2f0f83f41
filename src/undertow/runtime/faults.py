"""Faults to inject, as data: what goes wrong in the optimiser, its answers, sensors, actuators.

Each fault is a small function at one of the seams of the runtime; the wrappers below put it
there.  They serve the drill, and the tests of a user's own rig.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from undertow.cascade import Cascade
from undertow.models import FloatArray
from undertow.optimiser import Planner, Proposal
from undertow.plants.interface import Measurement, Rig
from undertow.runtime.clock import SimulatedClock
from undertow.runtime.slow import Answer, Request, Worker

__all__ = [
    "Change",
    "Drive",
    "FaultyRig",
    "FaultyWorker",
    "Hang",
    "Sense",
    "Spoil",
    "Witness",
    "spoil_optimiser",
]

#: (time since the fault began, s; measurement) to what the controller gets to see.
Sense = Callable[[float, Measurement], Measurement]

#: (time since the fault began, s; written input, (m,)) to what reaches the plant.
Drive = Callable[[float, FloatArray], FloatArray]

#: An answer to what arrives in its place: (further delay, s; answer) each.
Change = Callable[[Answer], list[tuple[float, Answer]]]

#: (honest proposal) to what the optimiser says instead; may raise.
Spoil = Callable[[Proposal], Any]


class _SpoiltPlanner:
    """An optimiser that goes wrong from some time on."""

    def __init__(self, honest: Planner, spoil: Spoil, since: float) -> None:
        self._honest, self._spoil, self._since = honest, spoil, since

    def require(self, x: FloatArray, /) -> Proposal:
        return self._honest.require(x)

    def propose(self, x: FloatArray, /, **rest: Any) -> Any:
        proposal = self._honest.propose(x, **rest)
        return self._spoil(proposal) if rest["computed_for"] >= self._since else proposal


def spoil_optimiser(cascade: Cascade, spoil: Spoil, since: float) -> Cascade:
    """Return a cascade whose optimiser goes wrong from ``since``, s; its gate is as it was."""
    honest = cascade.planner or cascade.optimiser
    return replace(cascade, planner=_SpoiltPlanner(honest, spoil, since))


class FaultyWorker:
    """A slow loop whose answers are changed, held back or repeated on their way.

    Parameters
    ----------
    worker
        The sound one.
    change
        What arrives in the place of an answer.
    since
        When the fault begins, s.
    """

    def __init__(
        self,
        worker: Worker,
        change: Change,
        since: float,
    ) -> None:
        self.worker, self.change, self.since = worker, change, since
        self._arriving: deque[tuple[float, Answer]] = deque()

    def ask(self, request: Request) -> None:
        """Hand over a request."""
        self.worker.ask(request)

    def take(self, t: float) -> Answer | None:
        """Return what arrives."""
        answer = self.worker.take(t)
        if answer is not None:
            what = self.change(answer) if t >= self.since else [(0.0, answer)]
            arriving = [*self._arriving, *((t + delay, item) for delay, item in what)]
            self._arriving = deque(sorted(arriving, key=lambda pair: pair[0]))
        if self._arriving and self._arriving[0][0] <= t + 1e-9:
            return self._arriving.popleft()[1]
        return None

    def replace(self) -> bool:
        """Give up on the present computation."""
        return self.worker.replace()

    def close(self) -> None:
        """Stop computing."""
        self.worker.close()


@dataclass(frozen=True)
class Hang:
    """A rig that does not return for a while, s, while the world goes on."""

    seconds: float


class FaultyRig:
    """A simulated rig with faults between it and the controller.

    Parameters
    ----------
    rig
        The sound one.
    since
        When the faults begin, s.
    sense, drive
        What happens to measurements and to inputs; either may raise.
    hang
        One call of ``write`` that takes long, with ``clock`` to show it.
    slow
        How long each ``read`` takes from then on, s, while the world goes on.
    """

    def __init__(
        self,
        rig: Rig,
        since: float,
        *,
        sense: Sense | None = None,
        drive: Drive | None = None,
        hang: Hang | None = None,
        clock: SimulatedClock | None = None,
        slow: float = 0.0,
    ) -> None:
        self.rig, self.period, self.since = rig, rig.period, since
        self.slow, self._behind, self._last = slow, 0.0, np.zeros(0)
        self.sense, self.drive, self.hang, self.clock = sense, drive, hang, clock
        self._steps = 0

    @property
    def _elapsed(self) -> float:
        """Time since the fault began, s; negative before."""
        return self._steps * self.period - self.since + 1e-9

    def read(self) -> Measurement:
        """Return what the sensors seem to say."""
        if self.slow and self.clock is not None and self._elapsed >= 0:
            self.clock.t += self.slow
            self._behind += max(0.0, self.slow - self.period)
            while self._behind >= self.period:
                self.rig.write(self._last)
                self._behind -= self.period
        measurement = self.rig.read()
        if self.sense is not None and self._elapsed >= 0:
            return self.sense(self._elapsed, measurement)
        return measurement

    def write(self, u: FloatArray) -> None:
        """Apply what reaches the plant."""
        elapsed = self._elapsed
        self._steps += 1
        applied = u.copy()
        if self.drive is not None and elapsed >= 0:
            applied = self.drive(elapsed, applied)
        self.rig.write(applied)
        self._last = applied
        if self.hang is not None and self.clock is not None and elapsed >= 0:
            periods = round(self.hang.seconds / self.period)
            for _ in range(periods):
                self.rig.write(applied)
            self.clock.t += periods * self.period
            self.hang = None

    def close(self) -> None:
        """Let go of the rig."""
        self.rig.close()


class Witness:
    """Stands nearest to the controller and looks at every output that it writes.

    Parameters
    ----------
    rig
        What it passes everything on to.
    limits, slew
        Largest |u| and largest change from one write to the next, (m,).

    Attributes
    ----------
    faults
        What was wrong with an output, in words; empty when all were sound.
    largest
        Largest |u|/limit written.
    last
        Last output written, (m,).
    """

    def __init__(self, rig: Rig, limits: FloatArray, slew: FloatArray) -> None:
        self.rig, self.period = rig, rig.period
        self.limits, self.slew = limits, slew
        self.faults: list[str] = []
        self.largest = 0.0
        self.last = np.zeros_like(limits)

    def read(self) -> Measurement:
        """Return the measurement."""
        return self.rig.read()

    def write(self, u: FloatArray) -> None:
        """Judge the output, and pass it on."""
        if len(self.faults) < 10:
            if not np.isfinite(u).all():
                self.faults.append(f"not finite: {u.tolist()}")
            elif (np.abs(u) > self.limits).any():
                self.faults.append(f"past its limits: {u.tolist()}")
            elif (np.abs(u - self.last) > self.slew * (1.0 + 1e-9)).any():
                self.faults.append(f"faster than its slew: {self.last.tolist()} to {u.tolist()}")
        part = np.abs(u) / np.where(np.isfinite(self.limits), self.limits, math.inf)
        self.largest = max(self.largest, float(np.max(part)))
        self.last = u.copy()
        self.rig.write(u)

    def close(self) -> None:
        """Let go of the rig."""
        self.rig.close()
