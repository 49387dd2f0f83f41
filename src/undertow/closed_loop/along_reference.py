"""One motion along a reference that moves: law on the error, plant as it is.

The law acts on the error from x_r(t), with the model of the error's own dynamics
(:func:`undertow.models.error_dynamics`); the plant moves in absolute coordinates, under absolute
constraints.  Runge-Kutta steps of the loop's length, the reference at their ends and middles.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import sympy as sp

from undertow.closed_loop.rollout import ClosedLoop
from undertow.closed_loop.trajectory import Event, Trajectory, recorded
from undertow.law import (
    LawLayout,
    Plan,
    ReferenceMotion,
    SlidingModeLaw,
    law_module,
    pack_law_parameters,
)
from undertow.models import TIME, FloatArray, error_dynamics
from undertow.symbolic import Tape, function_source, scalar_module

_BODY = f"""
@compiled()
def along(
    x, reference, lanes, segments, belief, plant, limits, start, h, steps, hold, radius, escape,
    hard, prices, record,
):
    # Fills a row of record at each step: x, u, s, cost, det Γ(q)/det Γ(0); returns how many, and
    # the event.
    n, m = x.shape[0] // 2, limits.shape[0]
    e, u, demand, s, margin = (
        np.empty(2 * n), np.zeros(m), np.zeros(m), np.zeros(m), np.ones(1)
    )
    rates, acceleration = np.empty(1 + PATH), np.empty(n)
    at, slope, total = np.empty(2 * n), np.empty(2 * n), np.empty(2 * n)
    own = belief.shape[0] - 3 * n
    cost, code = 0.0, {Event.HORIZON:d}
    outside = np.where(prices > 0.0, -1, -2)  # the last row that was, since the first
    for k in range(steps + 1):
        lane = lanes[segments[min(k, steps - 1)]]
        total[:], spent = 0.0, 0.0
        for i in range(2 * n):
            at[i] = x[i]
        for stage in range(4):
            half = 2 * k + (0, 1, 1, 2)[stage]
            if k == steps and stage > 0:
                break
            for i in range(3 * n):
                belief[own + i] = reference[half, i]
            for i in range(2 * n):
                e[i] = at[i] - reference[half, i]
            if hold == 0 or (stage == 0 and k % hold == 0):
                law(e, lane, belief, demand, s, margin)
                for i in range(m):
                    wanted = demand[i] if abs(demand[i]) < math.inf else 0.0
                    u[i] = max(-limits[i], min(limits[i], wanted))
            measures(e, at, u, plant, rates)
            if stage == 0:
                away = math.sqrt((e * e).sum())
                for i in range(2 * n):
                    record[k, i] = x[i]
                for i in range(m):
                    record[k, 2 * n + i], record[k, 2 * n + m + i] = u[i], s[i]
                record[k, 2 * n + 2 * m], record[k, 2 * n + 2 * m + 1] = cost, margin[0]
                if not margin[0] >= 0.0:
                    code = {Event.SINGULAR:d}
                elif not away < escape:
                    code = {Event.DIVERGED:d}
                for i in range(PATH):
                    if not rates[1 + i] >= 0.0:
                        if outside[i] == k - 1:
                            outside[i] = k
                        else:
                            code = {Event.CONSTRAINT:d}
                for i in range(m):
                    if hard and not abs(demand[i]) <= limits[i]:
                        code = {Event.CONSTRAINT:d}
                if code != {Event.HORIZON:d}:
                    return k + 1, code
                if k == steps:
                    return k + 1, {Event.REACHED:d} if away <= radius else code
            flow(start + (k + 0.5 * (half - 2 * k)) * h, at, u, plant, acceleration)
            weight = 1.0 if stage == 0 or stage == 3 else 2.0
            for i in range(n):
                slope[i], slope[n + i] = at[n + i], acceleration[i]
            for i in range(2 * n):
                total[i] += weight * slope[i]
                at[i] = x[i] + (0.5, 0.5, 1.0, 0.0)[stage] * h * slope[i]
            spent += weight * rates[0]
        for i in range(2 * n):
            x[i] += h / 6.0 * total[i]
        if away > radius:
            cost += h / 6.0 * spent
    return steps + 1, code
"""


#: Modules by what they are made of.
_MODULES: dict[object, Any] = {}


def _module(loop: ClosedLoop) -> Any:
    """Return the compiled module of a loop along references: ``along``."""
    key = (
        loop.mechanism.structure, loop.mechanism.name, loop.truth.structure, loop.objective,
        loop.reaching.switching, loop.slides,
    )  # fmt: skip
    if key not in _MODULES:
        _MODULES[key] = _made(loop)
    return _MODULES[key]


def _made(loop: ClosedLoop) -> Any:
    plant, objective = loop.truth, loop.objective
    believed, switching = error_dynamics(loop.mechanism), loop.reaching.switching
    law = law_module(believed, switching, implicit=loop.slides)
    stage, path = objective.stage_cost(plant), objective.path_margins(plant)

    def functions() -> tuple[str, str, str]:
        tape = Tape()
        flow = function_source(
            "flow",
            tape,
            {"t": TIME, "x": plant.x, "u": plant.u, "parameters": plant.parameter_symbols},
            {"out": plant.partition(tape).accelerations(sp.Matrix(plant.u))},
        )
        errors = [sp.Symbol(f"_error_{i}", real=True) for i in range(2 * plant.n)]
        tape = Tape()
        measures = function_source(
            "measures",
            tape,
            {"e": errors, "x": plant.x, "u": plant.u, "parameters": plant.parameter_symbols},
            {"out": tape.let_all([stage.xreplace(dict(zip(plant.x, errors, strict=True))), *path])},
        )
        return flow, measures, _BODY

    head = f"from {law.__name__} import law\n\nPATH = {len(path)}\n"
    depends = law.__name__, plant.structure, sp.srepr([stage, *path])
    return scalar_module("along", "Motions", plant.name, depends, functions, head)


def simulate_along(
    loop: ClosedLoop,
    x: FloatArray,
    plan: Plan,
    motion: ReferenceMotion,
    *,
    duration: float,
    start: float = 0.0,
) -> Trajectory:
    """Simulate and record one motion along a reference, in absolute coordinates.

    Parameters
    ----------
    loop
        Law, plant and objective; about x = 0.  Of an ensemble the belief alone moves.
    x
        Initial state, (2n,), absolute.
    plan
        What is slid on, counted from the reference.
    motion
        Where the target is at which time.
    duration, start
        Length, and clock at the start, s.

    Returns
    -------
    Trajectory
        Its event is ``REACHED`` where it ends within the terminal radius of the reference; cost
        counts while it is outside.
    """
    loop = loop if loop.ensemble is None else replace(loop, ensemble=None)
    steps, step = loop.equal_steps(duration)
    parts = loop.substeps
    steps, step = parts * steps, step / parts
    plain, plant, m = loop.mechanism, loop.truth, loop.mechanism.m
    laws = zip(plan.surfaces, plan.laws(loop.reaching), strict=True)
    lanes = np.stack([pack_law_parameters(SlidingModeLaw(plain, s, law)) for s, law in laws])
    if loop.slides:
        lanes[:, LawLayout(plain.n, m).layer] = step
    times = np.arange(steps) * step
    segments = np.searchsorted(plan.times, times + 1e-9, side="right") - 1
    halves = start + np.arange(2 * steps + 1) * (0.5 * step)
    record = np.empty((steps + 1, 2 * plain.n + 2 * m + 2))
    rows, code = _module(loop).along(
        np.array(x, dtype=float), motion.rows(halves), lanes, segments,
        np.append(plain.parameter_values, np.zeros(3 * plain.n)), plant.parameter_values,
        loop.input_limits, start, step, steps, parts * loop.zoh_steps,
        loop.objective.terminal_radius, loop.escape, loop.objective.hard_input, loop.prices,
        record,
    )  # fmt: skip
    kept = np.append(np.arange(0, rows - 1, parts), rows - 1)
    return recorded(plant, start + kept * step, record[kept], code, loop.objective)
