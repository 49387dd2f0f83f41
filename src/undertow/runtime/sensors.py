"""Which readings can be accepted: gaps, spikes, frozen channels, clocks that run back.

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

from undertow.models import FloatArray, Mechanism, fastest_rate
from undertow.plants import Measurement
from undertow.plants.interface import copy_numbers
from undertow.plants.stepping import compiled_module
from undertow.runtime.settings import Settings
from undertow.symbolic import BRIEF, COMPILED, Workspace, unpacked

#: A model that has run freely for this long starts again, s.
REST = 0.3

#: When nothing has moved for this long a probe begins; it lasts so long, each side of it, s.
PROBE, PROBES, SIDE = 0.2, 0.1, 0.02

#: What :meth:`SensorMonitor.check` found: nothing wrong; no sound reading yet; none for too long; a
#: sensor lost for too long; one that stands still; one that is missing too often; a clock that
#: makes no sense.  What comes after the second is a fault.
SOUND, NOT_YET, NEVER, LOST, FROZEN, SPARSE, TIMELESS = range(7)
LAST_HARMLESS = NOT_YET

#: Where the settings of the watch stand: period, s; weight of a step in a share; parts of a period;
#: and what :class:`.settings.Settings` calls max_innovation, frozen_threshold, sensor_timeout,
#: max_step_interval and max_dropout_ratio.
PERIOD, INNOVATION, STANDSTILL, TIMEOUT, STALL, WEIGHT, DROPOUT, PARTS = range(8)

#: And its times, s: how long it has waited for a first reading; 1 once there was one; our time; the
#: rig's and ours at the last reading whose time made sense; and at the last one at all.
WAITED, BEGUN, NOW, RIG_SOUND, OUR_SOUND, RIG_LAST, OUR_LAST = range(7)

#: What the watch remembers; shares: part of the readings that was missing of late; offs: how far
#: the readings of the last step were off what was expected, 0 where they were not accepted.
_LAYOUT = {
    "settings": "8", "clock": "7", "q": "n", "v": "n", "band": "m", "gain": "n",
    "parameters": "p", "viscous": "n", "W": "n * n", "last": "n", "gaps": "n", "ages": "n",
    "offs": "n",
    "counts": "n", "shares": "n", "quiet": "1", "expected": "2 * n",
    "free": "n, 2 * n", "work": "3, 2 * n",
}  # fmt: skip

_BODY = f"""
{COMPILED}
def heun_step(h, parts, x, u, viscous, parameters, work):
    # Heun's step of the belief, in place, in parts that are short beside its fastest mode:
    # readings are compared to far less than its error.
    n = x.shape[0] // 2
    first, second, ahead = work[0], work[1], work[2]
    part = h / parts
    for _ in range(int(parts)):
        forward(0.0, x, u, viscous, parameters, first)
        for i in range(n):
            ahead[i] = x[i] + part * x[n + i]
            ahead[n + i] = x[n + i] + part * first[i]
        forward(0.0, ahead, u, viscous, parameters, second)
        for i in range(n):
            x[i] += 0.5 * part * (x[n + i] + ahead[n + i])
            x[n + i] += 0.5 * part * (first[i] + second[i])


{COMPILED}
def coulomb_impulse(h, x, band, gain, parameters, W):
    # Impulses of dry friction in the driven joints, of the size of the dead band, in place.
    n = x.shape[0] // 2
    mobility(x, parameters, W)
    for i in range(band.shape[0]):
        most = h * band[i] * abs(gain[i])
        impulse = max(-most, min(most, -x[n + i] / W[i * n + i]))
        for k in range(n):
            x[n + k] += W[k * n + i] * impulse


{COMPILED}
def gate_measurement(x, u, block):
    # What cannot be accepted becomes NaN; returns how many are missing, where the longest gap
    # is, and which reading is frozen (-1: none).
{unpacked(_LAYOUT)}
    h, jump, frozen = settings[{PERIOD}], settings[{INNOVATION}], settings[{STANDSTILL}]
    for i in range(2 * n):
        expected[i] = x[i]
    heun_step(h, settings[{PARTS}], expected, u, viscous, parameters, work)
    gains(parameters, gain)
    missing, worst, still, moved = 0, 0, -1, False
    probing = quiet[0] >= {PROBE}
    for i in range(n):
        # A knock grows from step to step, by less than a jump in each.
        off, before = q[i] - expected[i], offs[i]
        offs[i] = 0.0
        if min(abs(off), abs(off - before)) <= jump + 2.0 * h * abs(expected[n + i]):
            gaps[i], offs[i] = 0.0, off
            shares[i] -= settings[{WEIGHT}] * shares[i]
        else:
            q[i] = v[i] = math.nan
            gaps[i] += h
            shares[i] += settings[{WEIGHT}] * (1.0 - shares[i])
            missing += 1
        if gaps[i] > gaps[worst]:
            worst = i
        if q[i] == last[i]:
            heun_step(h, settings[{PARTS}], free[i], u, viscous, parameters, work)
            coulomb_impulse(h, free[i], band, gain, parameters, W)
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
    return missing, worst, still


{BRIEF}
def check(stamp, x, u, block):
    # One reading, already in q and v: returns what is wrong, with which sensor, how many are
    # missing, whether this is the first, the time, and what to probe with.  A clock that makes
    # no sense spoils a reading.
{unpacked(_LAYOUT)}
    # It counts from the last reading whose time made sense, so that no period is counted twice that
    # passed without one; or from the last one at all, if somebody has set the clock.
    now = clock[{NOW}] + settings[{PERIOD}]
    soonest = clock[{NOW}] + 1e-3 * settings[{PERIOD}]
    usable = clock[{RIG_LAST}] == -math.inf and abs(stamp) < math.inf
    for rig, ours in (({RIG_SOUND}, {OUR_SOUND}), ({RIG_LAST}, {OUR_LAST})):
        if not usable and 0.0 < stamp - clock[rig] <= settings[{STALL}]:
            now, usable = max(soonest, clock[ours] + stamp - clock[rig]), True
    clock[{NOW}] = now
    if usable:
        clock[{RIG_SOUND}], clock[{OUR_SOUND}] = stamp, now
    if abs(stamp) < math.inf:
        clock[{RIG_LAST}], clock[{OUR_LAST}] = stamp, now
    size = 0.0
    for i in range(n):
        q[i] = q[i] + 0.0 if usable else math.nan  # no −0: a log does not keep its sign
        v[i] = v[i] + 0.0 if usable else math.nan
        size += abs(q[i])
    if clock[{BEGUN}] == 0.0 and size < math.inf:
        clock[{BEGUN}] = 1.0
        for i in range(n):
            last[i] = q[i]
            for j in range(n):
                free[i, j], free[i, n + j] = q[j], 0.0
        return {SOUND}, 0, 0, True, now, 0.0
    if clock[{BEGUN}] == 0.0:
        clock[{WAITED}] += settings[{PERIOD}]
        late = clock[{WAITED}] > settings[{TIMEOUT}]
        return ({NEVER} if late else {NOT_YET}), 0, n, False, now, 0.0
    missing, worst, still = gate_measurement(x, u, block)
    beyond = quiet[0] - {PROBE}
    probe = 0.0 if beyond < 0.0 else 1.0 - 2.0 * (int(beyond / {SIDE}) % 2)
    if gaps[worst] > settings[{TIMEOUT}]:
        return ({LOST} if usable else {TIMELESS}), worst, missing, False, now, probe
    if still >= 0:
        return {FROZEN}, still, missing, False, now, probe
    for i in range(n):
        if shares[i] > settings[{DROPOUT}]:
            return {SPARSE}, i, missing, False, now, probe
    return {SOUND}, 0, missing, False, now, probe
"""


@lru_cache(maxsize=64)
def _module(mechanism: Mechanism) -> Any:
    return compiled_module(mechanism, "watch", "Sensor watch", _BODY)


class SensorMonitor:
    """Compares readings with what the model expects; short gaps are left to the estimator.

    Of the last step ``missing`` says which readings are missing or not accepted, and ``first``
    whether it was the first with a sound reading; ``probe`` is −1, 0 or 1: what to add to the
    inputs, in units of twice their dead band. ``period`` is that of the fast loop, s.
    """

    def __init__(self, mechanism: Mechanism, settings: Settings, period: float) -> None:
        self.names = [c.name for c in mechanism.coordinates]
        n = mechanism.n
        self._check = _module(mechanism).check
        memory = Workspace(_LAYOUT, n=n, m=mechanism.m, p=len(mechanism.parameters))
        self._block, self._clock, self._gaps = memory.block, memory["clock"], memory["gaps"]
        self._ages, self._quiet, self._shares = memory["ages"], memory["quiet"], memory["shares"]
        memory["settings"][:] = (  # in the order of their names
            period, settings.max_innovation, settings.frozen_threshold, settings.sensor_timeout,
            settings.max_step_interval, min(1.0, period / settings.fault_window),
            settings.max_dropout_ratio, max(1, math.ceil(period * fastest_rate(mechanism) - 1e-9)),
        )  # fmt: skip
        memory["parameters"][:] = mechanism.parameter_values
        memory["counts"][:] = 0.01
        memory["band"][:] = settings.bands(mechanism)
        self._q, self._v, self._window = memory["q"], memory["v"], settings.fault_window
        self._stall = settings.max_step_interval
        self._accepted = Measurement(0.0, self._q)
        self.forget()

    def forget(self) -> None:
        """Start afresh: the next sound reading is the first."""
        self.missing, self.first, self.probe, self._silent = 0, False, 0.0, False
        self._clock[:] = 0.0
        self._clock[[RIG_SOUND, RIG_LAST]] = -math.inf
        self._gaps[:] = self._ages[:] = self._quiet[:] = self._shares[:] = 0.0

    def check(
        self, measurement: Measurement | None, x: FloatArray, u: FloatArray
    ) -> tuple[Measurement | None, int, int]:
        """Return what can be accepted of a measurement, and what is wrong for too long.

        The measurement is ``None`` when the rig failed; x, (2n,), is the estimate of the last step
        and u, (m,), the input since then. What comes back has NaN for what is missing, is ``None``
        before the first sound reading, and is written over by the next call. Two numbers say what
        was found, a fault if above ``LAST_HARMLESS``, and at which sensor: :meth:`describe` says it
        in words. Raises InvalidInputError when the rig does not give one number per coordinate.
        """
        stamp, accepted = math.nan, self._accepted
        if measurement is not None:
            stamp = float(measurement.t)
            copy_numbers(measurement.q, self._q, "measured q")
            if measurement.v is not None:
                copy_numbers(measurement.v, self._v, "measured v")
            accepted.v = None if measurement.v is None else self._v
        self._silent = math.isnan(stamp) and all(map(math.isnan, self._q))
        found, where, self.missing, self.first, accepted.t, self.probe = self._check(
            stamp, x, u, self._block
        )
        return (None if found in (NOT_YET, NEVER) else accepted), found, where

    def describe(self, found: int, where: int) -> str:
        """Return in words what :meth:`check` found."""
        if found == NEVER:
            return "no sound reading yet"
        if found == LOST:
            return f"sensor '{self.names[where]}' lost for {1e3 * self._gaps[where]:.0f} ms"
        if found == TIMELESS:
            gap, last = self._clock[NOW] - self._clock[OUR_SOUND], self._clock[RIG_LAST]
            if self._silent:
                return f"no sensor gave anything for {1e3 * gap:.0f} ms, last at {last:g} s"
            return (
                f"the rig's clock made no sense for {1e3 * gap:.0f} ms, last at {last:g} s: "
                "the time of a reading must be later than the last one's, by "
                f"{self._stall:g} s at most"
            )
        if found == SPARSE:
            return f"sensor {self._missing(where, self._shares[where])}"
        return f"sensor '{self.names[where]}' frozen" if found == FROZEN else ""

    def worst(self, elapsed: float) -> str:
        """Return in words which sensor was missing most often; empty if none was.

        ``elapsed``: time since the watch started afresh, s: of it no more than a window is looked
        at.
        """
        where, looked_at = int(self._shares.argmax()), -math.expm1(-elapsed / self._window)
        share = min(1.0, self._shares[where] / looked_at)
        return f"sensor {self._missing(where, share)}" if share > 0.01 else ""

    def _missing(self, where: int, share: float) -> str:
        return f"'{self.names[where]}' missing in {share:.0%} of the readings"
