"""The earliest arrival, for many plans at once; knows nothing of control.

The first time at which a motion touches the terminal set is a discontinuous function of the
parameters, and a population search gets stuck on its steps.  Where it comes *closest* until a fixed
time T is smooth, but for jumps from one approach to another.  So: bring the closest states of a
population to zero by Levenberg-Marquardt, all in one batch; where one arrives, shorten T, drop
those that are farthest, and go on until none follows.

Plans that arrive without sliding in at a decaying rate are isolated, or lie on thin sets: that is
why the population is wide at first and many of its members lead nowhere.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from undertow.models import FloatArray

#: T after an arrival, as a part of the one before.
SHORTER = 0.97

#: Members that remain after an arrival, as a part; and how many remain at least.
REMAIN, FEWEST = 0.8, 16

#: Steps without any arrival that end a search.
PATIENCE = 6

#: Step of the differences of a Jacobian; the longest step of a member.
PROBE, LONGEST = 1e-4, 0.5

#: What the damping of a member is multiplied by in each of its trials; its least and its most.
TRIALS, LEAST, MOST = np.array([1e-2, 1.0, 1e2]), 1e-8, 1e4


class States(Protocol):
    """See :class:`ArrivalSearch`."""

    def __call__(self, z: FloatArray, T: float) -> tuple[FloatArray, FloatArray]:
        """Return the states that are closest to zero until T, and when they are reached."""
        ...


@dataclass(frozen=True, eq=False)
class ArrivalSearch:
    """Looks for parameters whose motion arrives ever earlier.

    ``states``: the closest states until T, s, for parameters (N, d): (N, k), infinite for a motion
    that broke off before; and when that is, (N,). ``admits``: whether parameters (N, d) whose
    motions arrive are admissible, (N,). ``radius``: ‖state‖₂ that counts as arrived. ``without``:
    whether so many evaluations cannot be had any more. ``shorter``, ``fewest``: T after an arrival,
    as a part of the one before; how many members remain at least.
    """

    states: States
    admits: Callable[[FloatArray], NDArray[np.bool_]]
    radius: float
    without: Callable[[int], bool] = lambda _: False
    shorter: float = SHORTER
    fewest: int = FEWEST

    def run(self, z: FloatArray, T: float, members: int) -> float:
        """Search from those of some parameters (N, d) that come nearest until T, s.

        Returns the earliest arrival that was found, s.
        """
        if self.without(len(z)):
            return np.inf
        z, x, t = nearest(z, *self.states(z, T), members)
        damping, quiet, earliest = np.full(len(z), 1e-2), 0, np.inf
        while quiet < PATIENCE and len(z) and not self.without(len(z) * (z.shape[1] + len(TRIALS))):
            arrived = np.linalg.norm(x, axis=1) <= self.radius
            if arrived.any():
                good = np.zeros(len(z), dtype=bool)
                good[arrived] = self.admits(z[arrived])
                left = good | ~arrived
                if not good.any():
                    z, x, t, damping = z[left], x[left], t[left], damping[left]
                    continue
                now = float(t[good].min())
                # In whole steps a short T may stay as it is: then an arrival is no news.
                quiet, earliest = 0 if now < earliest else quiet + 1, min(now, earliest)
                T, z = self.shorter * now, z[left]
                z, x, t = nearest(z, *self.states(z, T), max(self.fewest, int(REMAIN * len(z))))
                damping = np.full(len(z), 1e-2)
            else:
                quiet += 1
            z, x, t, damping = closer(partial(self.states, T=T), z, x, t, damping)
        return float(earliest)


def closer(
    states: Callable[[FloatArray], tuple[FloatArray, FloatArray]],
    z: FloatArray,
    x: FloatArray,
    t: FloatArray,
    damping: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """One step of Levenberg and Marquardt for each of some parameters (N, d), all in one batch.

    It brings their states x, (N, k), nearer to zero, or leaves them; ``states`` also tells when
    they are reached, t (N,).  Returns parameters, states, times and dampings (N,) after the step.
    """
    count, d = z.shape
    probes, _ = states((z[:, None] + PROBE * np.eye(d)).reshape(-1, d))
    slopes = (probes.reshape(count, d, -1) - x[:, None]) / PROBE
    dampings = damping[:, None] * TRIALS
    trials = z[:, None] + _steps(slopes, x, dampings)
    tried, when = states(trials.reshape(-1, d))
    misses = np.linalg.norm(tried, axis=1).reshape(count, -1)
    rows, best = np.arange(count), misses.argmin(axis=1)
    better = misses[rows, best] < np.linalg.norm(x, axis=1)
    taken = (rows * len(TRIALS) + best)[better]
    z, x, t = z.copy(), x.copy(), t.copy()
    z[better], x[better], t[better] = trials[better, best[better]], tried[taken], when[taken]
    harder = np.where(better, dampings[rows, best], dampings[:, -1])
    return z, x, t, np.clip(harder, LEAST, MOST)


def nearest(
    z: FloatArray, x: FloatArray, t: FloatArray, most: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the parameters, so many at most, whose states are nearest to zero, with both."""
    miss = np.linalg.norm(x, axis=1)
    rows = np.argsort(miss, kind="stable")[:most]
    rows = rows[np.isfinite(miss[rows])]
    return z[rows], x[rows], t[rows]


def _steps(slopes: FloatArray, states: FloatArray, dampings: FloatArray) -> FloatArray:
    """Return Levenberg-Marquardt steps that bring states to zero, (N, t, d), not too long.

    ``slopes`` are transposed Jacobians, (N, d, k), of ``states``, (N, k); ``dampings`` (N, t).
    """
    V, sigma, Ut = np.linalg.svd(np.where(np.isfinite(slopes), slopes, 0.0), full_matrices=False)
    filters = sigma[:, None] / (sigma[:, None] ** 2 + dampings[:, :, None])
    along = (Ut @ states[:, :, None])[:, None, :, 0]
    steps = -(filters * along) @ V.swapaxes(1, 2)
    length = np.linalg.norm(steps, axis=2, keepdims=True)
    return np.asarray(steps * np.minimum(1.0, LONGEST / np.maximum(length, 1e-12)))
