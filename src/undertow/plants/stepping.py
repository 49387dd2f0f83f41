"""One period of a simulated rig, compiled for a mechanism.

The smooth part (equations of motion, viscous friction, drives) is integrated with
Runge-Kutta's fourth-order step.  Dry friction and end stops follow as impulses (Moreau's
time stepping; Acary and Brogliato, *Numerical Methods for Nonsmooth Dynamical Systems*,
Springer 2008, ch. 10): the impulse p of a step is the one that satisfies

    v⁺ = v* + M⁻¹ p,    p_i ∈ −h F_i(v_i) Sign(v_i⁺),

solved by projected Gauss-Seidel.  A joint that sticks has v_i⁺ = 0 exactly, friction never
drives, and no stiffness has to be invented.  The position moves with the mean velocity,
q⁺ = q* + ½ h M⁻¹ p, so that what sticks does not creep.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import sympy as sp

from undertow.models import TIME, Mechanism
from undertow.symbolic import (
    COMPILED,
    PREAMBLE,
    Tape,
    content_key,
    docstring,
    function_source,
    generated,
)

__all__ = ["SMOOTH", "dynamics_source", "stepping"]

#: Calls what :func:`dynamics_source` compiles.
SMOOTH = f"""
{COMPILED}
def smooth(t, h, x, u, viscous, parameters, work):
    # Runge-Kutta's step of the smooth dynamics, in place.
    n = x.shape[0] // 2
    stage, total, qdd = work[0], work[1], work[2]
    for i in range(2 * n):
        stage[i] = x[i]
        total[i] = 0.0
    for k in range(4):
        reach = h if k == 2 else 0.5 * h
        weight = 1.0 if k == 0 or k == 3 else 2.0
        forward(t + (0.0 if k == 0 else (h if k == 3 else 0.5 * h)),
                stage, u, viscous, parameters, qdd)
        for i in range(n):
            d, dd = stage[n + i], qdd[i]
            total[i] += weight * d
            total[n + i] += weight * dd
            stage[i] = x[i] + reach * d
            stage[n + i] = x[n + i] + reach * dd
    for i in range(2 * n):
        x[i] += h / 6.0 * total[i]
"""

_BODY = f"""
{SMOOTH}

{COMPILED}
def advance(
    t, length, counts, x, u, drive, held, past, delays, parameters, friction, stops, amplifier,
    gap, encoder, phase, pushes, noise, q, applied, work,
):
    # One period: ``counts`` holds the index of the step, steps per period, stops run into.
    n = x.shape[0] // 2
    h = length / counts[1]
    W, before, impulse, viscous, gain = work[3], work[4], work[5], work[6], work[7]
    gains(parameters, gain)
    rough, bounded, loose = False, False, False
    for i in range(n):
        viscous[i] = friction[i, 3]
        rough = rough or friction[i, 1] > 0.0
        bounded = bounded or stops[i, 1] < math.inf or stops[i, 0] > -math.inf
    for i in range(gap.shape[0]):
        loose = loose or gap[i, 0] > 0.0
    for _ in range(counts[1]):
        j = counts[0]
        transmit(j, h, u, held, delays[0], amplifier, gap, gain, drive, applied)
        for k in range(pushes.shape[0]):
            if pushes[k, 0] < t + h:
                pushes[k, 0] = math.inf  # once, whatever the rounding of t
                mobility(x, parameters, W)
                for i in range(n):
                    for l in range(n):
                        x[n + i] += W[i * n + l] * pushes[k, 1 + l]
        for i in range(2 * n):
            before[i] = x[i]
        if rough or bounded or loose:
            mobility(x, parameters, W)
        smooth(t, h, x, applied, viscous, parameters, work)
        if loose:
            backlash_separation(h, x, before, drive, gap, W)
        if rough:
            dry_friction(h, x, before, friction, W, impulse)
        if bounded:
            counts[2] += end_stops(x, stops, W)
        if loose:
            backlash_impact(h, x, before, drive, gap, gain, W)
        t += h
        counts[0] = j + 1
        for i in range(past.shape[1]):
            past[(j + 1) % past.shape[0], i] = x[i]
    measure(counts[0], past, delays[1], encoder, phase, noise, q)
    return t


{COMPILED}
def play(
    times, inputs, rows, counts, x, drive, held, past, delays, parameters, friction, stops,
    amplifier, gap, encoder, phase, pushes, noise, q, applied, work,
):
    # Inputs, (N, m), from one of the times to the next; ``rows`` gets the states there.
    rows[0] = x
    for k in range(times.shape[0] - 1):
        advance(
            times[k], times[k + 1] - times[k], counts, x, inputs[k], drive, held, past, delays,
            parameters, friction, stops, amplifier, gap, encoder, phase, pushes, noise, q,
            applied, work,
        )
        rows[k + 1] = x
"""


def dynamics_source(mechanism: Mechanism) -> str:
    """Return compiled ``forward``, ``mobility`` and ``gains`` of a mechanism, as source.

    ``forward(t, x, u, viscous, parameters, qdd)`` gives q̈ with joint damping besides;
    ``mobility(x, parameters, W)`` M⁻¹, row by row; ``gains(parameters, b)`` the diagonal of B.
    """
    n, m = mechanism.n, mechanism.m
    tape = Tape()
    viscous = [sp.Symbol(f"_viscous_{i}", real=True) for i in range(n)]
    M = sp.Matrix(n, n, tape.let_all(list(mechanism.mass_matrix)))
    factor = tape.cholesky(sp.Matrix(n, n, lambda i, j: M[min(i, j), max(i, j)]))
    driven = mechanism.input_matrix * sp.Matrix(mechanism.u)
    total = [
        force - damping * velocity + (driven[i] if i < m else 0)
        for i, (force, damping, velocity) in enumerate(
            zip(mechanism.force, viscous, mechanism.x[n:], strict=True)
        )
    ]
    qdd = factor.solve(sp.Matrix(tape.let_all(total)))
    inverse = factor.solve(sp.eye(n))
    parameters = {"parameters": mechanism.parameter_symbols}
    state = {"x": mechanism.x}
    diagonal = tape.let_all([mechanism.input_matrix[i, i] for i in range(m)])
    forward = {"t": TIME, **state, "u": mechanism.u, "viscous": viscous, **parameters}
    return "\n\n".join(
        [
            function_source("forward", tape, forward, {"qdd": list(qdd)}),
            function_source("mobility", tape, state | parameters, {"W": list(inverse)}),
            function_source("gains", tape, parameters, {"b": diagonal}),
        ]
    )


@lru_cache(maxsize=64)
def stepping(mechanism: Mechanism) -> Any:
    """Return the compiled module that advances a rig of this mechanism: ``advance``, ``play``."""
    key = content_key(mechanism.structure, mechanism.name)

    def write() -> str:
        # numba's cache does not notice that an imported function has changed: the key does.
        header = docstring(f"Rig of {mechanism.name}; generated, do not edit. {key[:16]}")
        names = "backlash_impact, dry_friction, end_stops, measure, backlash_separation, transmit"
        parts = f"from undertow.plants.parts import {names}\n"
        return f"{header}{PREAMBLE}{parts}\n\n{dynamics_source(mechanism)}\n{_BODY}"

    return generated("rig", mechanism.name, key, write)
