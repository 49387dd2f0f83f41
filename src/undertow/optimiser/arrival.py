"""The earliest arrival, for many plans at once; knows nothing of control.

The first time at which a motion touches the terminal set is a discontinuous function of the
parameters, and a population search gets stuck on its steps.  Where a motion comes closest to the
target *within a window* [0, T] is smooth but for a change of the pass that is closest.  So: bring
the closest states of a population to zero by Levenberg-Marquardt, all in one batch; where one
arrives, shorten the window below its arrival, drop the worst, and go on until none follows.

Plans that arrive without sliding in at a decaying rate are isolated, or lie on thin sets: that is
why the population is wide at first and many of its members lead nowhere.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

#: The window ends at this part of the last arrival.
SHORTER = 0.97

#: Members that remain after an arrival, as a part; and how many remain at least.
REMAIN, FEWEST = 0.8, 16

#: Steps without any arrival that end a search.
PATIENCE = 6

#: Step of the differences of a Jacobian; the longest step of a member.
PROBE, LONGEST = 1e-4, 0.5

#: What the damping of a member is multiplied by in each of its trials; its least and its most.
TRIALS, LEAST, MOST = np.array([1e-2, 1.0, 1e2]), 1e-8, 1e4


class Approach(NamedTuple):
    """The closest states of N motions, (N, k); how close they are, (N,); and when, (N,), s."""

    state: FloatArray
    distance: FloatArray
    time: FloatArray

    def part(self, rows: NDArray[np.intp]) -> Approach:
        """Return some of them."""
        return Approach(self.state[rows], self.distance[rows], self.time[rows])

    def replaced(self, rows: NDArray[np.bool_], other: Approach) -> Approach:
        """Return these with those of ``other`` in some rows."""
        return Approach(
            np.where(rows[:, None], other.state, self.state),
            np.where(rows, other.distance, self.distance),
            np.where(rows, other.time, self.time),
        )


@dataclass(frozen=True, eq=False)
class ArrivalSearch:
    """Looks for parameters whose motion arrives ever earlier.

    Parameters
    ----------
    approach
        Where motions come closest in a window: parameters (N, d) and T, s, to :class:`Approach`.
        A motion that cannot be judged has an infinite distance.
    admits
        Whether parameters (N, d) whose motions arrive are admissible, (N,).
    radius
        Distance that counts as arrived.
    stop
        Asked before each batch, with its size.
    """

    approach: Callable[[FloatArray, float], Approach]
    admits: Callable[[FloatArray], NDArray[np.bool_]]
    radius: float
    stop: Callable[[int], bool] = lambda _: False

    def run(self, z: FloatArray, T: float, members: int) -> float:
        """Search from the nearest of some parameters (N, d), for arrivals before T, s.

        Returns the end of the last window in which a motion arrived, ∞ for none.
        """
        found, quiet = np.inf, 0
        if self.stop(len(z)):
            return found
        near = self.approach(z, T)
        nearest = np.argsort(near.distance, kind="stable")[:members]
        nearest = nearest[np.isfinite(near.distance[nearest])]
        z, near, damping = z[nearest], near.part(nearest), np.full(len(nearest), 1e-2)
        while quiet < PATIENCE and len(z) and not self.stop(len(z) * (z.shape[1] + len(TRIALS))):
            arrived = near.distance <= self.radius
            if arrived.any():
                good = np.flatnonzero(arrived)[self.admits(z[arrived])]
                left = np.union1d(np.flatnonzero(~arrived), good)
                if not len(good):
                    z, near, damping = z[left], near.part(left), damping[left]
                    continue
                found, quiet = T, 0
                T = SHORTER * float(near.time[good].min())
                z = z[left]
                near = self.approach(z, T)
                most = max(FEWEST, int(REMAIN * len(z)))
                left = np.argsort(near.distance, kind="stable")[:most]
                z, near, damping = z[left], near.part(left), np.full(len(left), 1e-2)
            else:
                quiet += 1
            count, d = z.shape
            probes = self.approach((z[:, None] + PROBE * np.eye(d)).reshape(-1, d), T)
            slopes = (probes.state.reshape(count, d, -1) - near.state[:, None]) / PROBE
            dampings = damping[:, None] * TRIALS
            trials = z[:, None] + _steps(slopes, near.state, dampings)
            tried = self.approach(trials.reshape(-1, d), T)
            rows, best = np.arange(count), tried.distance.reshape(count, -1).argmin(axis=1)
            tried = tried.part(rows * len(TRIALS) + best)
            better = tried.distance < near.distance
            z, near = np.where(better[:, None], trials[rows, best], z), near.replaced(better, tried)
            harder = np.where(better, dampings[rows, best], dampings[:, -1])
            damping = np.clip(harder, LEAST, MOST)
        return found


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
