"""Which readings can be believed: gaps, spikes, frozen channels, clocks that run back.

Each reading is compared with what the belief expects one period after the last estimate.
A reading that stands still is compared with the model running freely from when it last
moved: encoders repeat themselves, but not while the mechanism moves.  So that what sticks
in its friction is not taken for a broken sensor, the driven joints of the free model have dry
friction as large as a dead band of the input, and it starts again after a while, what stands
still at rest.  When no reading at all has
moved for some time, the mechanism is either at rest or unseen: a small probe on the inputs
tells which.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np

from undertow.codegen.function import COMPILED, PREAMBLE
from undertow.codegen.store import content_key, generated, generators
from undertow.mechanism import FloatArray, Mechanism
from undertow.memory import BRIEF, Memory, unpacked
from undertow.rig.interface import Measurement
from undertow.rig.stepping import dynamics_source
from undertow.runtime.settings import Settings

__all__ = ["SensorWatch"]

#: A model that has run freely for this long starts again, s.
REST = 0.3

#: When nothing has moved for this long a probe begins; it lasts so long, each side of it, s.
PROBE, PROBES, SIDE = 0.2, 0.1, 0.02

#: What the watch remembers; settings: period, jump, frozen.
_LAYOUT = {
    "settings": "3", "band": "m", "gain": "n", "parameters": "p", "viscous": "n", "W": "n * n",
    "last": "n", "gaps": "n", "ages": "n", "counts": "n", "quiet": "1", "expected": "2 * n",
    "free": "n, 2 * n", "work": "3, 2 * n",
}  # fmt: skip

_BODY = f"""
{COMPILED}
def roll(h, x, u, viscous, parameters, work):
    # Heun's step of the belief, in place: readings are compared to far less than its error.
    n = x.shape[0] // 2
    first, second, ahead = work[0], work[1], work[2]
    forward(0.0, x, u, viscous, parameters, first)
    for i in range(n):
        ahead[i] = x[i] + h * x[n + i]
        ahead[n + i] = x[n + i] + h * first[i]
    forward(0.0, ahead, u, viscous, parameters, second)
    for i in range(n):
        x[i] += 0.5 * h * (x[n + i] + ahead[n + i])
        x[n + i] += 0.5 * h * (first[i] + second[i])


{COMPILED}
def slow(h, x, band, gain, parameters, W):
    # Impulses of dry friction in the driven joints, of the size of the dead band, in place.
    n = x.shape[0] // 2
    mobility(x, parameters, W)
    for i in range(band.shape[0]):
        most = h * band[i] * abs(gain[i])
        impulse = max(-most, min(most, -x[n + i] / W[i * n + i]))
        for k in range(n):
            x[n + k] += W[k * n + i] * impulse


{BRIEF}
def believe(q, x, u, block):
    # What is not believable becomes NaN; returns how many are missing, the longest gap and
    # where, and which reading is frozen (-1: none).
{unpacked(_LAYOUT)}
    h, jump, frozen = settings[0], settings[1], settings[2]
    for i in range(2 * n):
        expected[i] = x[i]
    roll(h, expected, u, viscous, parameters, work)
    gains(parameters, gain)
    missing, worst, still, moved = 0, 0, -1, False
    probing = quiet[0] >= {PROBE}
    for i in range(n):
        if abs(q[i] - expected[i]) <= jump + 2.0 * h * abs(expected[n + i]):
            gaps[i] = 0.0
        else:
            q[i] = math.nan
            gaps[i] += h
            missing += 1
        if gaps[i] > gaps[worst]:
            worst = i
        if q[i] == last[i]:
            roll(h, free[i], u, viscous, parameters, work)
            slow(h, free[i], band, gain, parameters, W)
            ages[i] += h
            if abs(free[i, i] - q[i]) > frozen:
                still = i
            if probing and i < u.shape[0] and abs(free[i, i] - q[i]) > 4.0 * counts[i]:
                still = i
            if ages[i] > {REST} or (quiet[0] < {PROBE} <= quiet[0] + h):
                ages[i] = 0.0
                for j in range(2 * n):
                    free[i, j] = x[j]
                free[i, i], free[i, n + i] = q[i], 0.0
        elif q[i] == q[i]:
            moved = True
            counts[i] = min(counts[i], abs(q[i] - last[i]))
            ages[i] = 0.0
            for j in range(2 * n):
                free[i, j] = x[j]
            free[i, i] = last[i] = q[i]
    quiet[0] = 0.0 if moved or quiet[0] > {PROBE + PROBES} else quiet[0] + h
    return missing, worst, gaps[worst], still
"""

_GENERATOR = generators("runtime/sensors.py", "memory.py", "rig/stepping.py", "codegen/function.py")


@lru_cache(maxsize=64)
def _module(mechanism: Mechanism) -> Any:
    key = content_key(mechanism.structure, mechanism.name, sources=_GENERATOR)

    def write() -> str:
        header = f'"""Sensor watch of {mechanism.name}; generated, do not edit."""\n\n'
        sizes = f"n, m, p = {mechanism.n}, {mechanism.m}, {len(mechanism.parameters)}\n"
        return f"{header}{PREAMBLE}{sizes}\n\n{dynamics_source(mechanism)}\n{_BODY}"

    return generated("watch", mechanism.name, key, write)


class SensorWatch:
    """Compares readings with what the model expects; short gaps are left to the estimator.

    Parameters
    ----------
    mechanism
        The controller's belief.
    settings
        How far and how long to believe.
    period
        Of the fast loop, s.

    Attributes
    ----------
    missing
        Readings of the last step that are missing or not believed.
    first
        Whether the last step was the first with a sound reading.
    """

    def __init__(self, mechanism: Mechanism, settings: Settings, period: float) -> None:
        self.settings, self.period = settings, period
        self.names = [c.name for c in mechanism.coordinates]
        n = mechanism.n
        self._believe = _module(mechanism).believe
        memory = Memory(_LAYOUT, n=n, m=mechanism.m, p=len(mechanism.parameters))
        self._block, self._last, self._free = memory.block, memory["last"], memory["free"]
        self._gaps, self._ages, self._quiet = memory["gaps"], memory["ages"], memory["quiet"]
        memory["settings"][:] = period, settings.jump, settings.frozen
        memory["parameters"][:] = mechanism.parameter_values
        memory["counts"][:] = 0.01
        limits = settings.limits(mechanism)
        self.band = memory["band"]
        self.band[:] = np.where(np.isfinite(limits), settings.dead_band * limits, 0.0)
        self._q, self._nothing = np.zeros(n), np.full(n, math.nan)
        low, high = settings.travels(mechanism).T
        self._low, self._high = low.tolist(), high.tolist()
        self._bounded = bool(np.isfinite([low, high]).any())
        self.forget()

    def forget(self) -> None:
        """Start afresh: the next sound reading is the first."""
        self.missing, self.first, self._known = 0, False, False
        self._rig_time, self._time, self._waited = -math.inf, 0.0, 0.0
        self._gaps[:] = self._ages[:] = self._quiet[:] = 0.0

    @property
    def probe(self) -> float:
        """−1, 0 or 1: what to add to the inputs, in units of twice their dead band."""
        beyond = float(self._quiet[0]) - PROBE
        if beyond < 0:
            return 0.0
        return 1.0 if int(beyond / SIDE) % 2 == 0 else -1.0

    def check(
        self, measurement: Measurement | None, x: FloatArray, u: FloatArray
    ) -> tuple[Measurement | None, str]:
        """Return what can be believed of a measurement, and what is wrong for too long.

        Parameters
        ----------
        measurement
            Of this step; ``None`` when the rig failed.
        x
            Estimate of the last step, (2n,).
        u
            Input since then, (m,).

        Returns
        -------
        Measurement or None
            With NaN for what is missing; ``None`` before the first sound reading.
        str
            The fault, or ``""``.
        """
        elapsed = None if measurement is None else self._elapsed(measurement.t)
        v = None
        if measurement is None or elapsed is None:
            self._q[:] = math.nan
            self._time += self.period
            if measurement is not None and measurement.v is not None:
                v = self._nothing
        else:
            np.add(measurement.q, 0.0, out=self._q)  # no −0: a log does not keep its sign
            self._time += elapsed
            if measurement.v is not None:
                v = measurement.v + 0.0
        self.first = False
        if not self._known and not self._meet():
            return None, self._wait()
        settings = self.settings
        self.missing, worst, gap, still = self._believe(
            self._q, self._free[0] if self.first else x, u, self._block
        )
        fault = ""
        if gap > settings.patience:
            fault = f"sensor '{self.names[worst]}' lost for {1e3 * gap:.0f} ms"
        elif still >= 0:
            fault = f"sensor '{self.names[still]}' frozen"
        if self.missing and v is not None:
            v = np.where(np.isnan(self._q), math.nan, v)
        return Measurement(self._time, self._q, v), fault

    def _meet(self) -> bool:
        """Take the first sound reading as it is."""
        if not np.isfinite(self._q).all():
            return False
        self._known = self.first = True
        self._last[:] = self._q
        self._free[:, : len(self._q)], self._free[:, len(self._q) :] = self._q, 0.0
        return True

    def _wait(self) -> str:
        """Wait for the first sound reading, as long as patience lasts."""
        self.missing = len(self._q)
        self._waited += self.period
        return "no sound reading yet" if self._waited > self.settings.patience else ""

    def _elapsed(self, t: float) -> float | None:
        """Time since the reading before, s; ``None`` where the rig's clock makes no sense."""
        if not math.isfinite(t):
            return None
        before, self._rig_time = self._rig_time, t
        if before == -math.inf:
            return self.period
        elapsed = t - before
        return elapsed if 0.0 < elapsed <= self.settings.stall else None

    def beyond(self, x: FloatArray) -> str:
        """Return which coordinate is past its range of travel, or ``""``."""
        if self._bounded:
            for i, name in enumerate(self.names):
                if not self._low[i] <= x[i] <= self._high[i]:
                    return f"'{name}' at {x[i]:.3g}, past its travel"
        return ""
