"""Controllers for rigs in simulated time: a law that stays, and the two-rate cascade."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from undertow.cascade import Cascade, CascadeState
from undertow.law import InnerLoop
from undertow.models import FloatArray
from undertow.optimiser import Proposal

__all__ = ["CascadeSteering", "steady"]


def steady(law: InnerLoop) -> Callable[[float, FloatArray], FloatArray]:
    """Return the controller that keeps one surface."""
    return lambda t, x: law(x)


class CascadeSteering:
    """The cascade in simulated time, with the optimiser a period behind as it is in life.

    At every multiple of the period the answer asked for one period ago is judged from the
    present state, then the next one is asked for: for the state predicted one period ahead.

    Parameters
    ----------
    cascade
        The two-rate controller.
    start
        What :meth:`Cascade.start` returned: the first optimisation is made before the run, as
        on a bench.

    Attributes
    ----------
    admitted, refused
        How many answers passed the gate, and how many did not.
    """

    def __init__(self, cascade: Cascade, start: tuple[CascadeState, Proposal]) -> None:
        self.cascade = cascade
        self.memory = start[0]
        self.law = InnerLoop(cascade.mechanism, self.memory.surface, cascade.reaching)
        self.waiting: Proposal | None = None
        self.ticks = self.admitted = self.refused = 0

    def __call__(self, t: float, x: FloatArray) -> FloatArray:
        """Return the input at (t, x)."""
        if t >= self.ticks * self.cascade.period - 1e-9:
            self._slow(self.ticks * self.cascade.period, x)
            self.ticks += 1
        if len(self.memory.plan.surfaces) > 1:
            self._use(t)
        return self.law(x)

    def _use(self, t: float) -> None:
        surface, reaching = self.memory.plan.at(t - self.memory.since)
        if surface != self.law.surface or (reaching or self.law.reaching) != self.law.reaching:
            self.law.use(surface, reaching)

    def _slow(self, t: float, x: FloatArray) -> None:
        cascade = self.cascade
        if not np.isfinite(x).all():
            return
        if self.waiting is not None:
            self.memory, admission = cascade.apply_gate(self.memory, self.waiting, x)
            self.admitted += admission.accepted
            self.refused += not admission.accepted
            self._use(t)
        later = t + cascade.period
        ahead = cascade.loop.batch(x, self.memory.at(t), duration=cascade.period, terminal=0.0)
        self.waiting = cascade.propose(self.memory, ahead.x[0], later)
