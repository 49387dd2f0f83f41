"""What rollouts read and write: buffers of whole blocks of lanes."""

from __future__ import annotations

import math
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from undertow.closed_loop.linear_model import NOBODY, Prepared
from undertow.closed_loop.trajectory import Batch
from undertow.closed_loop.work_array import LANES
from undertow.law import LawLayout, gamma_determinant
from undertow.models import FloatArray

if TYPE_CHECKING:
    from undertow.closed_loop.rollout import ClosedLoop

#: Stands in for arrays that are not there.
NOTHING = np.zeros((1, 1, 1))


class RolloutBuffers:
    """What one call of the kernel reads and writes: whole blocks of lanes.

    A lane is a row of ``lanes``: for each of S surfaces its vector, η and ε, and det Γ at the
    target.

    Parameters
    ----------
    loop
        The closed loop.
    count
        Rollouts, N; what is added to fill whole blocks repeats the last of them.
    segments
        Surfaces of each, S.
    plants
        Whether each lane brings a plant: its parameters lie behind the law vector, and
        ``member``, (N,), says which of the ensemble it is.
    """

    def __init__(
        self, loop: ClosedLoop, count: int, segments: int, *, plants: bool = False
    ) -> None:
        n, m, w = loop.mechanism.n, loop.mechanism.m, len(loop.objective.constraints)
        self.loop, self.layout = loop, LawLayout(n, m)
        self.count, self.padded = count, -(-count // LANES) * LANES
        self.member = np.zeros(self.padded, dtype=np.int64) if plants else NOBODY
        behind = len(loop.truth.parameters) if plants else 0
        self.lanes = np.empty((self.padded, segments, self.layout.size + behind))
        self.states = np.empty((self.padded, 2 * n))
        self.live = np.ones(self.padded)
        self.out = np.empty((self.padded, 9 + w + 4 * n))
        # A sampled kernel reads the noise of every lane.
        self.quiet = np.zeros((1, self.padded, 2 * n)) if loop.zoh_steps else NOTHING
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

    @cached_property
    def ends(self) -> Prepared | None:
        """Where the linear ends of the lanes are written, for loops that have them."""
        end = self.loop.linear_end
        return None if end is None else end.buffers(self.padded)

    def fill(
        self, states: FloatArray, surfaces: FloatArray, laws: FloatArray | None = None
    ) -> RolloutBuffers:
        """Take states (…, 2n), surfaces (…, S, 2mn) and laws (…, S, 2m), by default the loop's."""
        lanes, count, numbers = self.lanes, self.count, self.loop.numbers
        *_, eta, _ = self.layout.starts
        last = self.layout.size - 1
        lanes[:count, :, :eta] = surfaces
        lanes[:count, :, eta:last] = numbers.law if laws is None else laws
        if self.loop.slides:
            lanes[:count, :, self.layout.layer] = self.loop.step
        lanes[:count, :, last] = gamma_determinant(numbers.coupling, surfaces)
        self.states[:count] = states
        if self.padded > count:
            lanes[count:] = lanes[count - 1]
            self.states[count:] = self.states[count - 1]
        return self

    def part(self, which: NDArray[np.intp]) -> RolloutBuffers:
        """Return new buffers with some of the lanes."""
        plants = len(self.member) > 0
        buffers = RolloutBuffers(self.loop, len(which), self.lanes.shape[1], plants=plants)
        pad = np.append(which, np.repeat(which[-1:], buffers.padded - len(which)))
        buffers.lanes[:], buffers.states[:] = self.lanes[pad], self.states[pad]
        if plants:
            buffers.member[:] = self.member[pad]
        return buffers

    @cached_property
    def members(self) -> RolloutBuffers:
        """Buffers of every plan on every member of the loop's ensemble, (N·K,) lanes."""
        ensemble = self.loop.ensemble
        assert ensemble is not None
        count, size = self.count * len(ensemble), self.layout.size
        buffers = RolloutBuffers(self.loop, count, self.lanes.shape[1], plants=True)
        buffers.member[:count] = np.tile(np.arange(len(ensemble)), self.count)
        buffers.member[count:] = buffers.member[count - 1]
        buffers.lanes[:, :, size:] = ensemble.values[buffers.member][:, None]
        return buffers

    def spread(self) -> RolloutBuffers:
        """Fill :attr:`members` with the plans of these buffers."""
        buffers, size = self.members, self.layout.size
        size_of_ensemble = buffers.count // self.count
        plan = np.minimum(np.arange(buffers.padded) // size_of_ensemble, self.count - 1)
        buffers.lanes[:, :, :size] = self.lanes[plan]
        buffers.states[:] = self.states[plan]
        ensemble = self.loop.ensemble
        assert ensemble is not None
        if ensemble.surface_errors.size:
            surfaces = buffers.lanes[:, :, self.layout.surface]
            surfaces *= 1.0 + ensemble.surface_errors[buffers.member][:, None]
            coupling = self.loop.numbers.coupling
            buffers.lanes[:, :, size - 1] = gamma_determinant(coupling, surfaces)
        if ensemble.state_errors.size:
            errors = ensemble.state_errors[buffers.member]
            if ensemble.state_error_part < math.inf:
                most = ensemble.state_error_part * np.linalg.norm(buffers.states, axis=1)
                sizes = np.maximum(np.linalg.norm(errors, axis=1), np.finfo(float).tiny)
                errors = (np.minimum(sizes, most) / sizes)[:, None] * errors
            buffers.states += errors
        return buffers

    def batch(self, start: float) -> Batch:
        """Return the results as named views."""
        batch = self._batch
        batch.event[:] = self.out[: self.count, 2]
        if start != 0.0:
            batch.time[:] -= start
            batch.closest_time[:] -= start
        return batch
