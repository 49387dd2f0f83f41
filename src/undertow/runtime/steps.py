"""The arithmetic of the fast loop, compiled: from an estimate to the next state and output."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import lru_cache
from typing import Any

import numpy as np
import sympy as sp

from undertow.law import LAYOUT, Switching, law_module
from undertow.models import FloatArray, Mechanism
from undertow.objective import Objective
from undertow.runtime.modes import Mode
from undertow.runtime.settings import Settings
from undertow.symbolic import (
    BRIEF,
    Tape,
    Workspace,
    brief,
    function_source,
    scalar_module,
    unpacked,
)

#: What a step may find wrong by itself: an estimate that is no number, a coordinate past its
#: travel.
NOT_FINITE, BEYOND_TRAVEL = 1, 2

#: What a step remembers, after what the law does; settings: margin, escape, near, fall angle,
#: settling time of the sensors, period, what a missing reading takes off the time that they were
#: sound; off: by how much the state is off the expected one, and the margin of a new law there.
_LAYOUT = LAYOUT | {
    "x": "2 * n", "wrapped": "2 * n", "turn": "2 * n", "wanted": "m", "output": "m", "slew": "m",
    "settings": "7", "low": "n", "high": "n", "angles": "n", "band": "m", "since": "1",
    "expected": "2 * n", "off": "2",
}  # fmt: skip

_BODY = f"""
{BRIEF}
def act(
    estimate, disturbance, law_vector, new, max_error, block, mode, command, wrong, missing, swings,
    probe,
):
    # From an estimate to the next state and the output.  A new surface is put to use if the state
    # is off the one expected by at most ``max_error``, and if its law is sound there: it is then
    # the law of this step.  Returns whether it is, the state, the reason for a change, what is
    # wrong with the estimate and with which coordinate.  While it swings up, the output is left to
    # the caller.
{unpacked(_LAYOUT)}
    what, where = 0, 0
    if not accept_estimate(estimate, turn, x, wrapped):
        what = {NOT_FINITE}
    else:
        for i in range(n):
            if what == 0 and not (low[i] <= x[i] <= high[i]):
                what, where = {BEYOND_TRAVEL}, i
    fault = wrong or what != 0
    used = False
    off[0] = off[1] = math.nan
    if max_error >= 0.0:
        off[0] = relative_error(wrapped, expected)
        if off[0] <= max_error:
            law(wrapped, new, block)
            off[1] = margin[0]
            used = margin[0] > settings[0]
    if not used:
        law(wrapped, law_vector, block)
    part = whole = away = 0.0
    for i in range(2 * n):
        square = wrapped[i] * wrapped[i]
        whole += square
        if i % n >= m:
            part += square
        if i < n and angles[i] > 0.0:
            away = max(away, abs(wrapped[i]))
    if missing:
        since[0] = max(0.0, since[0] - settings[6])
    else:
        since[0] = min(since[0], settings[4]) + settings[5]
    if fault:
        since[0] = 0.0
    allowed = margin[0] > settings[0]
    lost = not allowed or not math.sqrt(whole) < settings[1] or away > settings[3]
    inside = used if swings else not lost
    near = settings[2] * (2.0 if mode == {Mode.BALANCE:d} else 1.0)
    after, reason = transition(
        mode, command, fault, since[0] >= settings[4], inside, lost, math.sqrt(part) <= near, swings
    )
    if after == {Mode.CATCH:d} or after == {Mode.BALANCE:d}:
        subtract_disturbance(demand, disturbance, limits, wanted)
        for i in range(m):
            wanted[i] += 2.0 * probe * band[i]
    else:
        wanted[:] = 0.0
    if after != {Mode.SWING_UP:d}:
        limit_output(wanted, output, limits, slew)
    return used, after, reason, what, where
"""


def step_memory(
    mechanism: Mechanism, settings: Settings, period: float, fall_angle: float
) -> Workspace:
    """Return what a step of the fast loop works on, its settings filled in.

    ``period`` is that of the fast loop, s; a free angle further than ``fall_angle``, rad, from the
    target has been thrown out.
    """
    n, m = mechanism.n, mechanism.m
    memory = Workspace(_LAYOUT, n=n, m=m, p=len(mechanism.parameters))
    memory["parameters"][:] = mechanism.parameter_values
    limits = memory["limits"]
    limits[:] = settings.limits(mechanism)
    slew = settings.slew(mechanism) * period
    memory["slew"][:] = np.where(np.isfinite(slew), slew, np.inf)
    memory["settings"][:] = (
        settings.min_margin, settings.max_state_norm, settings.settled_radius, fall_angle,
        settings.sensor_settling_time, period,
        period * max(0.0, 1.0 / settings.max_dropout_ratio - 1.0),
    )  # fmt: skip
    memory["low"][:], memory["high"][:] = settings.travels(mechanism).T
    memory["angles"][m:] = [c.unit == "rad" for c in mechanism.coordinates[m:]]
    memory["band"][:] = settings.bands(mechanism)
    return memory


@lru_cache(maxsize=64)
def step_module(mechanism: Mechanism, switching: Switching) -> Any:
    """Return the compiled module of a fast step: ``act`` on a :func:`step_memory`."""
    law = law_module(mechanism, switching)
    head = (
        f"from {law.__name__} import step as law\n"
        "from undertow.estimators.recorded_run import subtract_disturbance\n"
        "from undertow.runtime.modes import transition\n"
        "from undertow.runtime.steps import limit_output, relative_error, accept_estimate\n"
        f"\np, n, m = {len(mechanism.parameters)}, {mechanism.n}, {mechanism.m}\n"
    )
    depends = mechanism.structure, law.__name__
    return scalar_module("step", "Fast step", mechanism.name, depends, lambda: [_BODY], head)


@brief()
def limit_output(wanted: FloatArray, u: FloatArray, limits: FloatArray, slew: FloatArray) -> None:
    """Bring u, (m,), towards ``wanted`` within limits and within ``slew`` of where it was.

    Whatever is no number counts as zero.
    """
    for i in range(u.shape[0]):
        aim = wanted[i] if math.isfinite(wanted[i]) else 0.0
        aim = max(u[i] - slew[i], min(u[i] + slew[i], aim))
        u[i] = max(-limits[i], min(limits[i], aim)) + 0.0  # no −0: a log does not keep its sign


@brief()
def relative_error(x: FloatArray, expected: FloatArray) -> float:
    """Return the largest |x_i − e_i| / (1 + |e_i|); infinite where that is no number."""
    worst = 0.0
    for i in range(x.shape[0]):
        part = abs(x[i] - expected[i]) / (1.0 + abs(expected[i]))
        if not part <= worst:
            worst = part if part < math.inf else math.inf
    return worst


@brief()
def all_finite(numbers: FloatArray) -> bool:
    """Whether all numbers, (S, …), are finite, and so is their sum."""
    size = 0.0
    for value in numbers.flat:
        size += abs(value)
    return size < math.inf


@brief()
def accept_estimate(
    estimate: FloatArray, turn: FloatArray, x: FloatArray, wrapped: FloatArray
) -> bool:
    """Copy a finite estimate into x, and less ``turn`` into ``wrapped``; whether it was finite."""
    size = 0.0
    for i in range(x.shape[0]):
        size += abs(estimate[i])
    if not size < math.inf:
        return False
    for i in range(x.shape[0]):
        x[i] = estimate[i]
        wrapped[i] = estimate[i] - turn[i]
    return True


@lru_cache(maxsize=64)
def stage_module(mechanism: Mechanism, objective: Objective) -> Any:
    """Return the compiled module of Φ(x, u), (21): ``stage(x, u, parameters, cost)``.

    ``cost``, (1,), is filled.
    """
    stage = objective.stage_cost(mechanism)

    def functions() -> Iterator[str]:
        tape = Tape()
        yield function_source(
            "stage",
            tape,
            {"x": mechanism.x, "u": mechanism.u, "parameters": mechanism.parameter_symbols},
            {"cost": tape.let_all([stage])},
        )

    depends = mechanism.structure, sp.srepr(stage)
    return scalar_module("stage", "Stage cost", mechanism.name, depends, functions)
