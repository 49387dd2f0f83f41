"""The exported controller's step in Python, and test vectors: what its C must reproduce."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike

from undertow.export.controller import EmbeddedController, plan_text
from undertow.export.estimate import KalmanStep
from undertow.export.names import LARGEST, STALE_SPAN, PlanAnswer, Status
from undertow.law import Control, Plan, SlidingModeLaw, Surface
from undertow.models import FloatArray, Mechanism, steps_in
from undertow.plants import Measurement
from undertow.symbolic import literal


class Twin:
    """The exported controller, in double precision, by the library's own law and estimator."""

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
        self._laws, self._starts = self.controller.laws_of(plan), self.controller.starts(plan)
        self._row, self._clock = 0, 0

    @property
    def law(self) -> SlidingModeLaw:
        """The law in use."""
        return self._laws[self._row]

    def offer(self, plan: Plan, number: int) -> PlanAnswer:
        """Offer another plan; it is in use from the next step on."""
        if self._offered is not None:
            return PlanAnswer.BUSY
        if (self._newest - number) % 2**32 < STALE_SPAN:
            return PlanAnswer.STALE
        self._newest, self._offered = number, plan
        return PlanAnswer.ACCEPTED

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


#: Of a value v: this times max(|v|, scale), scale the input's limit (demands) or 1.
TOLERANCE = {"double": 1e-12, "float": 1e-3}

#: States of the law's test, and periods of the run's.
STATES, PERIODS = 100, 240

#: Where the new plan is offered, the output let on again, and measurements lost: a few, many.
OFFER_AT, ARM_AT = 40, 180
SHORT, LONG = slice(80, 83), slice(150, 165)


def random_states(mechanism: Mechanism, count: int, seed: int = 0) -> FloatArray:
    """Return states drawn evenly: a whole turn or the range of travel, rates to ±10.

    They are (count, 2n), SI units.
    """
    ends = [
        (max(c.low, -np.pi), min(c.high, np.pi)) if c.unit == "rad" else
        (max(c.low, -2.0), min(c.high, 2.0))
        for c in mechanism.coordinates
    ]  # fmt: skip
    low, high = np.array(ends).T
    rng = np.random.default_rng(seed)
    q = rng.uniform(low, high, (count, mechanism.n))
    return np.hstack([q, rng.uniform(-10, 10, (count, mechanism.n))])


def run_positions(controller: EmbeddedController) -> FloatArray:
    """Return the positions of a run as encoders give them, some of them lost, (PERIODS, n).

    The model moves under the twin's own outputs, by the midpoint rule, from a tenth of its
    usual start.
    """
    mechanism, T = controller.mechanism, controller.period
    n = mechanism.n
    twin = Twin(controller)
    x = 0.1 * mechanism.state(**mechanism.start)
    resolution = 2 * np.pi / 2**16
    steps = steps_in(mechanism, T, T)
    h, rows = T / steps, np.empty((PERIODS, n))
    for k in range(PERIODS):
        rows[k] = np.round(x[:n] / resolution) * resolution
        u, _ = twin.step(rows[k])
        for _ in range(steps):
            slope = np.concatenate([x[n:], mechanism.accelerations(0.0, x, u)])
            middle = x + h / 2 * slope
            x = x + h * np.concatenate([middle[n:], mechanism.accelerations(0.0, middle, u)])
    rows[SHORT, 0] = np.nan
    rows[LONG] = np.nan
    return rows


def other_plan(controller: EmbeddedController) -> Plan:
    """Return another plan for the run: the built-in surfaces, a little stiffer."""
    plan = controller.plan
    surfaces = tuple(
        Surface(s.alpha_a, 1.25 * s.lambda_a, s.alpha_u, 1.25 * s.lambda_u) for s in plan.surfaces
    )
    return Plan(surfaces, plan.times, plan.reaching)


def vectors(controller: EmbeddedController) -> dict[str, str]:
    """Return what the template of the vectors asks for."""
    real = controller.real
    mechanism = controller.mechanism
    states = _well_conditioned(controller)
    said = controller.laws[0](0.0, states)
    positions = _rounded(controller, run_positions(controller))
    next_plan = other_plan(controller)
    twin = Twin(controller)
    outputs, statuses, estimates = [], [], []
    resync = isinstance(controller.differentiator, KalmanStep)
    for k, q in enumerate(positions):
        if k == OFFER_AT:
            twin.offer(next_plan, controller.number + 1)
        if k == ARM_AT:
            twin.arm()
        u, status = twin.step(q)
        outputs.append(u)
        estimates.append(twin.x.copy())
        statuses.append(int(status))
    text = plan_text(controller, next_plan, controller.number + 1)

    def table(rows: Iterable[Iterable[float]]) -> str:
        cells = (
            ", ".join("UT_GONE" if np.isnan(v) else literal(v, real) for v in row) for row in rows
        )
        return "\n".join(f"    {{{line}}}," for line in cells)

    def column(values: Iterable[object]) -> str:
        return "\n".join(f"    {value}," for value in values)

    return {
        "tolerance": literal(TOLERANCE[real], real),
        "scale": ", ".join(controller.limit(v) for v in mechanism.input_limits),
        # In single precision a demand at a limit may fall on either side of it.
        "status_mask": str(~(Status.CLIPPED | Status.SLEWED) & 255 if real == "float" else 255),
        "law_count": str(len(states)),
        "law_x": table(states),
        "law_demand": table(said.demand),
        "law_s": table(said.s),
        "law_margin": column(literal(v, real) for v in said.margin),
        "step_count": str(len(positions)),
        "offer_at": str(OFFER_AT),
        "arm_at": str(ARM_AT),
        "next_number": str(controller.number + 1),
        "next_count": text["count"],
        "next_starts": text["starts"],
        "next_plan": text["rows"],
        "step_q": table(positions),
        "step_u": table(outputs),
        "step_status": column(statuses),
        "resync": str(int(resync)),
        "step_x": table(estimates if resync else [np.zeros(2 * mechanism.n)]),
    }


def _rounded(controller: EmbeddedController, values: FloatArray) -> FloatArray:
    """Return numbers that the C can hold exactly."""
    return values.astype(np.float32).astype(float) if controller.real == "float" else values


def _well_conditioned(controller: EmbeddedController) -> FloatArray:
    """Return random states at which det Γ is not small: near its zero no precision is enough."""
    states = _rounded(controller, random_states(controller.mechanism, 40 * STATES, seed=1))
    margin = controller.laws[0](0.0, states).margin
    return states[np.abs(margin) > 0.2][:STATES]
