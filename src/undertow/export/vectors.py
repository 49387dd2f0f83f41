"""Test vectors of an exported controller, computed by its twin in double precision."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from undertow.export.controller import EmbeddedController
from undertow.export.observer import KalmanStep
from undertow.export.plans import plan_text
from undertow.export.status import Status
from undertow.export.twin import Twin
from undertow.law import Plan, Surface
from undertow.models import FloatArray, Mechanism
from undertow.symbolic import literal

__all__ = ["TOLERANCE", "random_states", "run_positions", "vectors"]

#: Of a value v: this times max(|v|, scale), scale the input's limit (demands) or 1.
TOLERANCE = {"double": 1e-12, "float": 1e-3}

#: States of the law's test, and periods of the run's.
STATES, PERIODS = 100, 240

#: Where the new plan is offered, the output let on again, and measurements lost: a few, many.
OFFER_AT, ARM_AT = 40, 180
SHORT, LONG = slice(80, 83), slice(150, 165)


def random_states(mechanism: Mechanism, count: int, seed: int = 0) -> FloatArray:
    """Return states drawn evenly: a whole turn or the range of travel, rates to ±10.

    Parameters
    ----------
    count
        How many.
    seed
        Of the draw.

    Returns
    -------
    numpy.ndarray
        (count, 2n), SI units.
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


def run_positions(controller: EmbeddedController, periods: int = PERIODS) -> FloatArray:
    """Return the positions of a run as encoders give them, some of them lost, (periods, n).

    The model moves under the twin's own outputs, by the midpoint rule, from a tenth of its
    usual start.
    """
    mechanism, T = controller.mechanism, controller.period
    n = mechanism.n
    twin = Twin(controller)
    x = 0.1 * mechanism.state(**mechanism.start)
    resolution = 2 * np.pi / 2**16
    rows = np.empty((periods, n))
    for k in range(periods):
        rows[k] = np.round(x[:n] / resolution) * resolution
        u, _ = twin.step(rows[k])
        slope = np.concatenate([x[n:], mechanism.accelerations(0.0, x, u)])
        middle = x + T / 2 * slope
        x = x + T * np.concatenate([middle[n:], mechanism.accelerations(0.0, middle, u)])
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
