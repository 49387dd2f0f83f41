"""The parts of a simulated rig that are alike for all mechanisms, compiled once.

Arrays are filled in place; nothing is allocated.  ``x`` is (2n,), ``mobility`` M⁻¹ row by
row, (n²,).
"""

from __future__ import annotations

import math

from undertow.models import FloatArray
from undertow.symbolic import numba

__all__ = [
    "backlash_impact",
    "backlash_separation",
    "dry_friction",
    "end_stops",
    "measure",
    "transmit",
]


@numba.njit(cache=True, nogil=True, error_model="numpy")
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


@numba.njit(cache=True, nogil=True, error_model="numpy")
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


@numba.njit(cache=True, nogil=True, error_model="numpy")
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


@numba.njit(cache=True, nogil=True, error_model="numpy")
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
    for i in range(n):
        impulse[i] = 0.0
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


@numba.njit(cache=True, nogil=True, error_model="numpy")
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


@numba.njit(cache=True, nogil=True, error_model="numpy")
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
