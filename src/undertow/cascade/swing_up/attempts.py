"""Swings of the energy law on plants, and whether a regulator would bring them home: compiled."""

from __future__ import annotations

from dataclasses import astuple
from functools import lru_cache
from typing import Any

import numpy as np

from undertow.cascade.swing_up.law import Gains, periods, swing_source
from undertow.models import FloatArray, Mechanism, linearise
from undertow.plants.stepping import dynamics_source
from undertow.symbolic import COMPILED, PREAMBLE, content_key, docstring, generated

#: A swing may take so long, s, before other gains are tried; its law is held for so long, s.
SECONDS, STEP = 4.0, 0.002

#: From a state with xᵀPx up to this many times what the regulator holds without clipping it is
#: tried whether it comes home, clipped, every so many steps, within so long, s.
REACH, EVERY, HOME = 4.0, 5, 3.0

_BODY = f"""
{COMPILED}
def advance(x, force, plant, drag, limit, gain, stops, h, viscous, u, stages):
    # A smooth step with dry friction of the driven joint; whether it met no stop.
    n = x.shape[0] // 2
    u[0] = force - drag * limit * math.tanh(x[n] / 0.02) * (1.0 if gain > 0.0 else -1.0)
    rk4_step(0.0, h, 1.0, n, x, u, viscous, plant, stages[0], stages[1], stages[2])
    for i in range(n):
        if not stops[i, 0] < x[i] < stops[i, 1]:
            return False
    return True


{COMPILED}
def distance(x, P):
    total = 0.0
    for i in range(x.shape[0]):
        for j in range(x.shape[0]):
            total += x[i] * P[i, j] * x[j]
    return total


{COMPILED}
def attempt(x, gains, belief, plant, drag, limit, stops, P, level, k, wraps, seconds, h, out):
    # Time from which the regulator brings it home, infinite where there is none; least xᵀPx/level.
    # It leaves x where it ended; where it met a stop, as it was.
    n = x.shape[0] // 2
    x0, near, stages = x.copy(), x.copy(), np.zeros((3, 2 * n))
    viscous, u, work = np.zeros(n), np.zeros(1), np.zeros(6)
    out[0], out[1] = math.inf, math.inf
    wait = 0
    for step in range(int(seconds / h)):
        force = swing(x, gains, belief, limit, 0.0, work)
        gain = work[4]
        if not advance(x, force, plant, drag, limit, gain, stops, h, viscous, u, stages):
            out[1] = math.inf
            for i in range(2 * n):
                x[i] = x0[i]
            return
        for i in range(n):
            turn = wraps[i]
            near[i] = x[i] - turn * math.floor(x[i] / turn + 0.5) if turn > 0.0 else x[i]
            near[n + i] = x[n + i]
        ratio = distance(near, P) / level
        out[1] = min(out[1], ratio)
        wait -= 1
        if ratio > {REACH} or wait > 0:
            continue
        wait = {EVERY}
        for _ in range(int({HOME} / h)):
            force = 0.0
            for i in range(2 * n):
                force += k[i] * near[i]
            force = max(-limit, min(limit, force))
            if not advance(near, force, plant, drag, limit, gain, stops, h, viscous, u, stages):
                break
            ratio = distance(near, P) / level
            if ratio > 10.0 * {REACH}:
                break
            if ratio < 0.05:
                out[0] = step * h
                return


{COMPILED}
def attempts(
    starts, gains, belief, plants, drags, limit, stops, P, level, k, wraps, seconds, h, out
):
    for i in range(out.shape[0]):
        attempt(
            starts[i], gains, belief, plants[i], drags[i], limit, stops, P, level, k, wraps,
            seconds, h, out[i],
        )
"""


def unclipped(mechanism: Mechanism) -> tuple[FloatArray, float, FloatArray]:
    """Return P of a linear-quadratic regulator, the largest level at which it never clips, k.

    With R = 1/u_max² and u = k x, |k x| ≤ u_max on xᵀPx ≤ 1/(u_max² BᵀPB).
    """
    from scipy.linalg import solve_continuous_are  # slow to import

    lin = linearise(mechanism)
    n, m = mechanism.n, mechanism.m
    limit = mechanism.inputs[0].limit
    Q = np.diag([0.1] * m + [1.0] * (n - m) + [0.01] * n)
    P = np.asarray(solve_continuous_are(lin.A, lin.input, Q, np.eye(m) / limit**2), np.float64)
    k = -(limit**2) * (lin.input.T @ P)[0]
    return P, float(1.0 / (limit**2 * (lin.input.T @ P @ lin.input)[0, 0])), k


@lru_cache(maxsize=32)
def _module(mechanism: Mechanism) -> Any:
    key = content_key(mechanism.structure, mechanism.name)

    def write() -> str:
        words = docstring(f"Swings of {mechanism.name}; generated, do not edit.")
        head = f"{words}{PREAMBLE}"
        parts = (head, dynamics_source(mechanism), swing_source(mechanism), _BODY)
        return "\n\n".join(parts)

    return generated("attempts", mechanism.name, key, write)


class Attempts:
    """Swings with the energy law of a mechanism, on plants of its structure.

    A swing arrives when a linear-quadratic regulator would bring it home from where it has got to.

    Attributes
    ----------
    wraps
        2π for coordinates that turn freely, 0 for the others, (n,).
    stops
        End stops that a swing must not meet, a little before the real ones, (n, 2).
    """

    def __init__(self, mechanism: Mechanism) -> None:
        self._P, self._level, self._k = unclipped(mechanism)
        self.wraps = periods(mechanism)
        self.stops = np.array([[0.97 * c.low, 0.97 * c.high] for c in mechanism.coordinates])
        self._module, self._limit = _module(mechanism), mechanism.inputs[0].limit
        self._belief = mechanism.parameter_values

    def __call__(
        self, gains: FloatArray, starts: FloatArray, plants: FloatArray, drags: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return times and nearest distances, (N, 2), and where swings have got to, (N, 2n).

        Gains are (5,), starts (N, 2n), the plants' parameters (N, P), dry friction of the driven
        joint (N,), as parts of the input's limit.  A time is infinite where a swing does not
        arrive.
        """
        out, states = np.empty((len(starts), 2)), starts.copy()
        self._module.attempts(
            states, gains, self._belief, plants, drags, self._limit, self.stops, self._P,
            self._level, self._k, self.wraps, SECONDS, STEP, out,
        )  # fmt: skip
        return out, states

    def times(self, choices: tuple[Gains, ...], x: FloatArray, plant: FloatArray) -> FloatArray:
        """Return when each choice of gains brings a state x, (2n,), home, s: infinite, if not.

        The plant's parameters are (P,); nothing rubs.
        """
        rows = [np.array(astuple(gains)) for gains in choices]
        return np.array([self(row, x[None], plant[None], np.zeros(1))[0][0, 0] for row in rows])
