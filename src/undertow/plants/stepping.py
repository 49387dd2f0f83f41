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

import math
from functools import lru_cache
from typing import Any

import sympy as sp

from undertow.models import TIME, FloatArray, Mechanism
from undertow.symbolic import COMPILED, Tape, compiled, function_source, scalar_module, unpacked


@compiled()
def transmit(
    j: int,
    h: float,
    u: FloatArray,
    held: FloatArray,
    delay: int,
    amplifier: FloatArray,
    gap: FloatArray,
    gain: FloatArray,
    drive: FloatArray,
    applied: FloatArray,
) -> None:
    """Amplifier and gear: what of the inputs u reaches the joints in step j, ``applied``.

    ``drive`` holds the amplifier's output, the rotor's place in the gap and its speed there,
    the joint's last acceleration, and whether rotor and joint are apart.  They stay together
    while the rotor pushes: while what the motor gives and its own inertia does not take,
    f − J a, presses it on its side of the gap.
    """
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
            pressing = gain[i] * drive[0, i] - inertia * drive[3, i]
            together = (drive[1, i] >= 0.5 * play and pressing >= 0.0) or (
                drive[1, i] <= -0.5 * play and pressing <= 0.0
            )
            drive[4, i] = 0.0 if together else 1.0
            if not together:
                applied[i] = 0.0


@compiled()
def backlash_separation(
    h: float,
    x: FloatArray,
    before: FloatArray,
    drive: FloatArray,
    gap: FloatArray,
    mobility: FloatArray,
) -> None:
    """Take the rotors that are apart off the step from ``before`` to x, and off the mobility.

    A joint without the rotor's inertia J has, by Sherman and Morrison's formula,
    W + J W e eᵀ W/(1 − J eᵀ W e) for its mobility W.
    """
    n = x.shape[0] // 2
    for i in range(gap.shape[0]):
        play, inertia = gap[i]
        if play > 0.0 and drive[4, i] != 0.0:
            lighter = inertia / (1.0 - inertia * mobility[i * n + i])
            change = lighter * (x[n + i] - before[n + i])
            for k in range(n):
                x[n + k] += mobility[k * n + i] * change
                x[k] += 0.5 * h * mobility[k * n + i] * change
            for k in range(n):
                for j in range(n):
                    if i not in (k, j):
                        more = lighter * mobility[k * n + i] * mobility[i * n + j]
                        mobility[k * n + j] += more
            scale = 1.0 + lighter * mobility[i * n + i]
            for k in range(n):
                if k != i:
                    mobility[k * n + i] *= scale
                    mobility[i * n + k] *= scale
            mobility[i * n + i] *= scale


@compiled()
def backlash_impact(
    h: float,
    x: FloatArray,
    before: FloatArray,
    drive: FloatArray,
    gap: FloatArray,
    gain: FloatArray,
    mobility: FloatArray,
) -> None:
    """Move the rotors that are apart; who lands shares his momentum, without a rebound.

    The mobility is that of :func:`backlash_separation`: the rotor's speed w relative to the joint
    ends by the impulse w/(1/J + eᵀ W e).
    """
    n = x.shape[0] // 2
    for i in range(gap.shape[0]):
        play, inertia = gap[i]
        if play > 0.0:
            rise = x[n + i] - before[n + i]
            drive[3, i] = rise / h
            if drive[4, i] != 0.0:
                drive[2, i] += h * gain[i] * drive[0, i] / inertia - rise
                drive[1, i] += h * drive[2, i]
                if abs(drive[1, i]) >= 0.5 * play:
                    drive[1, i] = max(-0.5 * play, min(0.5 * play, drive[1, i]))
                    knock = drive[2, i] / (1.0 / inertia + mobility[i * n + i])
                    for k in range(n):
                        x[n + k] += mobility[k * n + i] * knock
                    drive[2, i] = 0.0


@compiled()
def dry_friction(
    h: float,
    x: FloatArray,
    before: FloatArray,
    friction: FloatArray,
    mobility: FloatArray,
    impulse: FloatArray,
) -> None:
    """Change velocities by the impulses of dry friction in a step from ``before`` to x.

    Projected Gauss-Seidel.  What sticks has a velocity of exactly zero, and what stuck
    before stays where it was.
    """
    n = x.shape[0] // 2
    impulse[:n] = 0.0
    for _ in range(30):
        largest = 0.0
        for i in range(n):
            coulomb, breakaway, speed = friction[i, 0], friction[i, 1], friction[i, 2]
            if breakaway == 0.0:
                continue
            ratio = before[n + i] / speed
            level = h * (coulomb + (breakaway - coulomb) * math.exp(-ratio * ratio))
            new = impulse[i] - x[n + i] / mobility[i * n + i]
            new = max(-level, min(level, new))
            change = new - impulse[i]
            impulse[i] = new
            for k in range(n):
                x[n + k] += mobility[k * n + i] * change
                x[k] += 0.5 * h * mobility[k * n + i] * change
            if abs(new) < level:
                x[n + i] = 0.0
                if before[n + i] == 0.0:
                    x[i] = before[i]
            largest = max(largest, abs(change) / level)
        if largest < 1e-12:
            break


@compiled()
def end_stops(x: FloatArray, stops: FloatArray, mobility: FloatArray) -> int:
    """Hold the coordinates within their ranges, without a rebound; how many ran into a stop."""
    n, hits = x.shape[0] // 2, 0
    for i in range(n):
        low, high = stops[i]
        if low <= x[i] <= high:
            continue
        x[i] = max(low, min(high, x[i]))
        if (x[n + i] > 0.0) == (x[i] == high):
            hits += 1
            knock = -x[n + i] / mobility[i * n + i]
            for k in range(n):
                x[n + k] += mobility[k * n + i] * knock
            x[n + i] = 0.0
    return hits


@compiled()
def measure(
    index: int,
    past: FloatArray,
    delay: int,
    encoder: FloatArray,
    phase: FloatArray,
    noise: FloatArray,
    q: FloatArray,
) -> None:
    """Read positions of ``delay`` steps ago, disturbed and counted, into q."""
    for i in range(q.shape[0]):
        value = past[max(0, index - delay) % past.shape[0], i] + encoder[i, 1] * noise[i]
        resolution = encoder[i, 0]
        if resolution > 0.0:
            value = (math.floor(value / resolution + phase[i]) - phase[i] + 0.5) * resolution
        q[i] = value


#: Runge-Kutta's step of the smooth dynamics, in place; time goes on by ``elapse`` times the step:
#: 1, or 0 for a model that is taken as it is at the time t.
_RK4 = f"""{COMPILED}
def rk4_step(t, h, elapse, n, x, u, viscous, parameters, stage, total, qdd):
    for i in range(2 * n):
        stage[i] = x[i]
        total[i] = 0.0
    for k in range(4):
        reach = h if k == 2 else 0.5 * h
        weight = 1.0 if k == 0 or k == 3 else 2.0
        forward(t + elapse * (0.0 if k == 0 else (h if k == 3 else 0.5 * h)),
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

#: What a rig is like and remembers; ``late`` and ``old``: delays of inputs and of readings, in
#: steps; ``seen``: how many numbers of the state are kept for readings; ``knocks``: how many pushes
#: there may be.  counts: index of the step, steps per period, stops run into, Runge-Kutta steps per
#: step; friction, stops, amplifier, gap and encoder as :class:`undertow.plants.Bench` has them.
RIG_LAYOUT = {
    "x": "2 * n", "counts": "4", "u": "m", "drive": "5, m", "held": "late + 1, m",
    "past": "old + 1, seen", "parameters": "p", "friction": "n, 4", "stops": "n, 2",
    "amplifier": "m, 4", "gap": "m, 2", "encoder": "n, 2", "phase": "n",
    "pushes": "knocks, 1 + n", "q": "n", "applied": "m", "work": "8, n * n + 2 * n",
}  # fmt: skip

_BODY = f"""
{COMPILED}
def advance(t, length, noise, block, late, old, seen, knocks):
    # One period, with the noise of its reading.
{unpacked(RIG_LAYOUT)}
    h = length / counts[1]
    fine = h / counts[3]
    W, before, impulse, viscous, gain = work[3], work[4], work[5], work[6], work[7]
    gains(parameters, gain)
    rough, bounded, loose = False, False, False
    for i in range(n):
        viscous[i] = friction[i, 3]
        rough = rough or friction[i, 1] > 0.0
        bounded = bounded or stops[i, 1] < math.inf or stops[i, 0] > -math.inf
    for i in range(gap.shape[0]):
        loose = loose or gap[i, 0] > 0.0
    for _ in range(int(counts[1])):
        j = int(counts[0])
        transmit(j, h, u, held, late, amplifier, gap, gain, drive, applied)
        for k in range(knocks):
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
        for k in range(int(counts[3])):
            rk4_step(t + k * fine, fine, 1.0, n, x, applied, viscous, parameters,
                     work[0], work[1], work[2])
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
        for i in range(seen):
            past[(j + 1) % past.shape[0], i] = x[i]
    measure(int(counts[0]), past, old, encoder, phase, noise, q)


{COMPILED}
def play(times, inputs, rows, noise, block, late, old, seen, knocks):
    # Inputs, (N, m), from one of the times to the next; ``rows`` gets the states there.
{unpacked(RIG_LAYOUT, "x", "u")}
    for k in range(times.shape[0]):
        for i in range(2 * n):
            rows[k, i] = x[i]
        if k + 1 < times.shape[0]:
            for i in range(m):
                u[i] = inputs[k, i]
            advance(times[k], times[k + 1] - times[k], noise, block, late, old, seen, knocks)
"""


def dynamics_source(mechanism: Mechanism) -> str:
    """Return compiled ``forward``, ``mobility``, ``gains``, ``rk4_step`` of a mechanism, as source.

    ``forward(t, x, u, viscous, parameters, qdd)`` gives q̈ with joint damping besides;
    ``mobility(x, parameters, W)`` M⁻¹, row by row; ``gains(parameters, b)`` the diagonal of B;
    ``rk4_step(t, h, elapse, n, x, u, viscous, parameters, stage, total, qdd)`` moves x, whose first
    2n numbers are the state, in place.
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
            _RK4,
        ]
    )


def compiled_module(
    mechanism: Mechanism, kind: str, title: str, body: str, imports: str = ""
) -> Any:
    """Return a compiled module of a mechanism's :func:`dynamics_source` and a body that uses it.

    Its n, m and p are known in the body; ``imports`` are of compiled functions.
    """
    sizes = f"n, m, p = {mechanism.n}, {mechanism.m}, {len(mechanism.parameters)}\n"
    depends, head = (mechanism.structure,), f"{imports}{sizes}"

    def functions() -> tuple[str, str]:
        return dynamics_source(mechanism), body

    return scalar_module(kind, title, mechanism.name, depends, functions, head)


@lru_cache(maxsize=64)
def stepping(mechanism: Mechanism) -> Any:
    """Return the compiled module that advances a rig of this mechanism: ``advance``, ``play``."""
    names = "backlash_impact, dry_friction, end_stops, measure, backlash_separation, transmit"
    parts = f"from undertow.plants.stepping import {names}\n"
    return compiled_module(mechanism, "rig", "Rig", _BODY, parts)
