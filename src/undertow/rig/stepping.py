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
from pathlib import Path
from typing import Any

import sympy as sp

from undertow.codegen.function import COMPILED, PREAMBLE, function_source
from undertow.codegen.store import content_key, load_module, recall, remember
from undertow.codegen.tape import Tape
from undertow.mechanism import TIME, Mechanism

__all__ = ["dynamics_source", "stepping"]

_BODY = f"""
{COMPILED}
def motor(j, h, u, held, delay, amplifier, gap, gain, drive, applied):
    # Amplifier and transmission: what reaches the joints in this step.
    for i in range(u.shape[0]):
        held[j % held.shape[0], i] = u[i]
        wanted = held[(j - delay) % held.shape[0], i] if j >= delay else 0.0
        limit, resolution, dead_band, rest = amplifier[i]
        if abs(wanted) <= dead_band:
            wanted = 0.0
        if resolution > 0.0:
            wanted = math.floor(wanted / resolution + 0.5) * resolution
        wanted = max(-limit, min(limit, wanted))
        part = 1.0 if rest == 0.0 else 1.0 - math.exp(-h / rest)
        drive[0, i] += part * (wanted - drive[0, i])
        applied[i] = drive[0, i]
        play, inertia = gap[i]
        if play > 0.0:
            force = gain[i] * drive[0, i]
            side = 0.5 * play
            if not ((drive[1, i] >= side and force >= 0.0)
                    or (drive[1, i] <= -side and force <= 0.0)):
                drive[2, i] += h * force / inertia
                drive[1, i] += h * drive[2, i]
                applied[i] = 0.0
            if abs(drive[1, i]) >= side:
                drive[1, i] = max(-side, min(side, drive[1, i]))
                drive[2, i] = 0.0


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


{COMPILED}
def dry(h, x, before, friction, stops, mobility_, impulse, hits):
    # Friction and end stops, as impulses.
    n = x.shape[0] // 2
    rough = False
    for i in range(n):
        impulse[i] = 0.0
        rough = rough or friction[i, 1] > 0.0
    if rough:
        for sweep in range(30):
            largest = 0.0
            for i in range(n):
                coulomb, breakaway, speed = friction[i, 0], friction[i, 1], friction[i, 2]
                if breakaway > 0.0:
                    ratio = before[i] / speed
                    level = h * (coulomb + (breakaway - coulomb) * math.exp(-ratio * ratio))
                    new = impulse[i] - x[n + i] / mobility_[i * n + i]
                    new = max(-level, min(level, new))
                    change = new - impulse[i]
                    impulse[i] = new
                    for k in range(n):
                        x[n + k] += mobility_[k * n + i] * change
                        x[k] += 0.5 * h * mobility_[k * n + i] * change
                    largest = max(largest, abs(change) / level)
            if largest < 1e-12:
                break
    for i in range(n):
        outside = x[i] > stops[i, 1] or x[i] < stops[i, 0]
        if outside:
            x[i] = max(stops[i, 0], min(stops[i, 1], x[i]))
            outwards = x[n + i] > 0.0 if x[i] == stops[i, 1] else x[n + i] < 0.0
            if outwards:
                hits[0] += 1
                knock = -x[n + i] / mobility_[i * n + i]
                for k in range(n):
                    x[n + k] += mobility_[k * n + i] * knock


{COMPILED}
def measure(index, past, delay, encoder, phase, noise, q):
    # Old positions, disturbed, counted.
    for i in range(q.shape[0]):
        value = past[max(0, index - delay) % past.shape[0], i] + encoder[i, 1] * noise[i]
        resolution = encoder[i, 0]
        if resolution > 0.0:
            value = (math.floor(value / resolution + phase[i]) - phase[i] + 0.5) * resolution
        q[i] = value


{COMPILED}
def advance(
    t, length, counts, x, u, drive, held, past, delays, parameters, friction, stops, amplifier,
    gap, encoder, phase, pushes, noise, q, applied, work,
):
    # One period: ``counts`` holds the index of the step, steps per period, hits of stops.
    n = x.shape[0] // 2
    h = length / counts[1]
    mobility_, before, impulse, viscous, gain = work[3], work[4], work[5], work[6], work[7]
    gains(parameters, gain)
    for i in range(n):
        viscous[i] = friction[i, 3]
    needed = False
    for i in range(n):
        needed = needed or friction[i, 1] > 0.0 or stops[i, 1] < math.inf or stops[i, 0] > -math.inf
    for _ in range(counts[1]):
        j = counts[0]
        motor(j, h, u, held, delays[0], amplifier, gap, gain, drive, applied)
        for k in range(pushes.shape[0]):
            if t <= pushes[k, 0] < t + h:
                mobility(x, parameters, mobility_)
                for i in range(n):
                    for l in range(n):
                        x[n + i] += mobility_[i * n + l] * pushes[k, 1 + l]
        for i in range(n):
            before[i] = x[n + i]
        if needed:
            mobility(x, parameters, mobility_)
        smooth(t, h, x, applied, viscous, parameters, work)
        if needed:
            dry(h, x, before, friction, stops, mobility_, impulse, counts[2:])
        t += h
        counts[0] = j + 1
        for i in range(n):
            past[(j + 1) % past.shape[0], i] = x[i]
    measure(counts[0], past, delays[1], encoder, phase, noise, q)
    return t
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


_GENERATOR = tuple(
    str(Path(__file__).parent.parent / name)
    for name in (
        "rig/stepping.py",
        "mechanism.py",
        "codegen/function.py",
        "codegen/scalar.py",
        "codegen/tape.py",
    )
)


@lru_cache(maxsize=64)
def stepping(mechanism: Mechanism) -> Any:
    """Return the compiled module that advances a rig of this mechanism: ``advance``."""
    key = content_key(mechanism.structure, mechanism.name, sources=_GENERATOR)
    source = recall("rig", key)
    if source is None:
        header = f'"""Rig of {mechanism.name}; generated, do not edit."""\n\n'
        source = f"{header}{PREAMBLE}\n\n{dynamics_source(mechanism)}\n{_BODY}"
        remember("rig", key, source)
    return load_module(f"rig_{mechanism.name}", source)
