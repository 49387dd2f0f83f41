"""What rollouts read and write: buffers of whole blocks of lanes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from undertow.closed_loop.terminal_model import TerminalLinearModel
from undertow.closed_loop.trajectory import Batch
from undertow.law import gamma_determinant
from undertow.models import FloatArray
from undertow.symbolic import LANES

__all__ = ["NOTHING", "RolloutBuffers", "Shape"]

#: Stands in for arrays that are not there.
NOTHING = np.zeros((1, 1, 1))


class Shape(NamedTuple):
    """What of a closed loop its buffers depend on.

    Numbers of coordinates, inputs and path constraints; X = M_uu⁻¹ M_auᵀ at the target; the
    linear model, if there is one; whether the inner loop is sampled.
    """

    n: int
    m: int
    constraints: int
    at_target: FloatArray
    linear_end: TerminalLinearModel | None
    sampled: bool


class RolloutBuffers:
    """What one call of the kernel reads and writes: whole blocks of lanes.

    A lane is a row of ``lanes``: for each of S surfaces its vector, η and ε, and det Γ at the
    target.
    """

    def __init__(self, shape: Shape, count: int, segments: int) -> None:
        n, m, w = shape.n, shape.m, shape.constraints
        self.shape, self.width = shape, 2 * m * n
        self.count, self.padded = count, -(-count // LANES) * LANES
        self.lanes = np.empty((self.padded, segments, self.width + 2 * m + 1))
        self.states = np.empty((self.padded, 2 * n))
        self.live = np.ones(self.padded)
        self.ends = None if shape.linear_end is None else shape.linear_end.buffers(self.padded)
        self.out = np.empty((self.padded, 9 + w + 4 * n))
        # A sampled kernel reads the noise of every lane.
        self.quiet = np.zeros((1, self.padded, 2 * n)) if shape.sampled else NOTHING
        out = self.out[:count]
        self._batch = Batch(
            cost=out[:, 0],
            time=out[:, 1],
            event=np.empty(count, dtype=np.int64),
            radius=out[:, 3],
            singular=out[:, 4],
            input=out[:, 5],
            path=out[:, 6 : 6 + w],
            closest=out[:, 6 + w],
            closest_time=out[:, 7 + w],
            closest_x=out[:, 8 + w : 8 + w + 2 * n],
            x=out[:, 8 + w + 2 * n : -1],
            steps=out[:, -1],
        )

    def fill(self, states: FloatArray, surfaces: FloatArray, laws: FloatArray) -> None:
        """Take states (…, 2n), surfaces (…, S, 2mn) and laws (…, S, 2m); the last fills up."""
        lanes, count = self.lanes, self.count
        lanes[:count, :, : self.width] = surfaces
        lanes[:count, :, self.width : -1] = laws
        lanes[:count, :, -1] = gamma_determinant(self.shape.at_target, surfaces)
        self.states[:count] = states
        if self.padded > count:
            lanes[count:] = lanes[count - 1]
            self.states[count:] = self.states[count - 1]

    def part(self, which: NDArray[np.intp]) -> RolloutBuffers:
        """Return room for some of the lanes, filled alike."""
        buffers = RolloutBuffers(self.shape, len(which), self.lanes.shape[1])
        lanes, width = self.lanes[which], self.width
        buffers.fill(self.states[which], lanes[:, :, :width], lanes[:, :, width:-1])
        return buffers

    def batch(self, start: float) -> Batch:
        """Return the results as named views."""
        batch = self._batch
        batch.event[:] = self.out[: self.count, 2]
        if start != 0.0:
            batch.time[:] -= start
            batch.closest_time[:] -= start
        return batch
