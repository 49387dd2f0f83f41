"""The exported controller's step in Python: what its C must reproduce, period by period."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from undertow.export.controller import EmbeddedController
from undertow.export.status import LARGEST, STALE_SPAN, Status, Verdict
from undertow.law import Control, Plan, SlidingModeLaw
from undertow.models import FloatArray
from undertow.plants import Measurement

__all__ = ["Twin"]


class Twin:
    """The exported controller, in double precision, by the library's own law and estimator.

    Parameters
    ----------
    controller
        What was exported.
    """

    def __init__(self, controller: EmbeddedController) -> None:
        self.controller = controller
        mechanism = controller.mechanism
        self._n, self._limit = mechanism.n, mechanism.input_limits
        self._slew = controller.slew_rates * controller.period
        self._estimator = controller.differentiator.estimator(mechanism, controller.period)
        self.x = np.zeros(2 * self._n)
        self.u = np.zeros(mechanism.m)
        self._missed, self._running, self._waiting = 0, False, False
        self._use(controller.plan)
        self._offered: Plan | None = None
        self._newest = controller.number

    def _use(self, plan: Plan) -> None:
        controller = self.controller
        self._laws = [
            SlidingModeLaw(controller.mechanism, surface, plan.at(t)[1] or controller.reaching)
            for surface, t in zip(plan.surfaces, plan.times, strict=True)
        ]
        self._starts = controller.starts(plan)
        self._row, self._clock = 0, 0

    @property
    def law(self) -> SlidingModeLaw:
        """The law in use."""
        return self._laws[self._row]

    def offer(self, plan: Plan, number: int) -> Verdict:
        """Offer another plan; it is in use from the next step on."""
        if self._offered is not None:
            return Verdict.BUSY
        if (self._newest - number) % 2**32 < STALE_SPAN:
            return Verdict.STALE
        self._newest, self._offered = number, plan
        return Verdict.ACCEPTED

    def arm(self) -> None:
        """Let the output on again after ``LOST``; the estimator starts anew."""
        self._missed, self._running, self._waiting = 0, False, False

    def step(self, q: ArrayLike) -> tuple[FloatArray, Status]:
        """One period from measured positions, (n,): the inputs, (m,), and the status."""
        at = np.array(q, dtype=float)
        status = self._repair(at, np.zeros(self._n))
        if status & Status.LOST:
            self._running = False
        else:
            if not self._running:
                self._estimator.reset(np.concatenate([at, np.zeros(self._n)]))
            # One instant for all, so that the estimator takes its usual period.
            self.x = self._sound(self._estimator.estimate(Measurement(0.0, at), self.u), at)
            self._running = True
        return self._control(status)

    def step_state(self, x: ArrayLike) -> tuple[FloatArray, Status]:
        """One period from a state that is measured whole, (2n,)."""
        at, velocity = np.split(np.array(x, dtype=float), 2)
        status = self._repair(at, velocity)
        self._running = not status & Status.LOST
        if self._running:
            self.x = np.concatenate([at, velocity])
            self._estimator.reset(self.x)
        return self._control(status)

    def _sound(self, x: FloatArray, q: FloatArray) -> FloatArray:
        """Return an estimate, begun anew for each coordinate of which it is no number."""
        bad = ~(np.abs(x.reshape(2, -1)) < LARGEST).all(axis=0)
        if bad.any():
            x = np.where(np.tile(bad, 2), np.concatenate([q, np.zeros(self._n)]), x)
            self._estimator.reset(x)
        return x.copy()

    def _repair(self, q: FloatArray, velocity: FloatArray) -> Status:
        rate = ~(np.abs(velocity) < LARGEST)
        velocity[rate] = self.x[self._n :][rate]
        place = ~(np.abs(q) < LARGEST)
        q[place] = (self.x[: self._n] + self.controller.period * self.x[self._n :])[place]
        if not (rate.any() or place.any()):
            self._missed = 0
            return Status.LOST if self._waiting else Status.OK
        self._missed = min(self._missed + 1, self.controller.missed + 1)
        long = self._missed > self.controller.missed
        self._waiting |= long
        good = self._running and not long and (np.abs([q, velocity]) < LARGEST).all()
        return Status.BRIDGED if good and not self._waiting else Status.LOST

    def _control(self, status: Status) -> tuple[FloatArray, Status]:
        if self._offered is not None:
            self._use(self._offered)
            self._offered = None
            status |= Status.SWITCHED
        if self._row + 1 < len(self._laws) and self._clock >= self._starts[self._row + 1]:
            self._row += 1
            status |= Status.SWITCHED
        self._clock += 1
        said: Control = self.law(0.0, self.x)
        if not said.margin > 0:
            status |= Status.SINGULAR
        wanted = np.zeros_like(said.u) if status & Status.LOST else said.u
        low = np.maximum(-self._limit, self.u - self._slew)
        high = np.minimum(self._limit, self.u + self._slew)
        self.u = np.clip(wanted, low, high)
        if (said.u != said.demand).any():
            status |= Status.CLIPPED
        if (self.u != wanted).any():
            status |= Status.SLEWED
        return self.u.copy(), status
