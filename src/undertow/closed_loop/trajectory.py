"""What rollouts return: how each ended, results of a batch, one recorded motion."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from undertow.base import InvalidInputError, at_least, checked
from undertow.models import FloatArray, Mechanism
from undertow.symbolic import numba

__all__ = ["INADMISSIBLE", "Batch", "Event", "Trajectory"]

#: Scores from here on mark inadmissible motions, see :meth:`Batch.score`.
INADMISSIBLE = 1e8


class Event(IntEnum):
    """Why a rollout ended."""

    HORIZON = 0
    REACHED = 1
    CONSTRAINT = 2
    SINGULAR = 3
    DIVERGED = 4
    COSTLY = 5
    UNSTABLE = 6


@dataclass(frozen=True, eq=False)
class Batch:
    """Results of N rollouts; arrays of length N.

    ``cost`` is ∫Φ dt until the end; ``time`` the end, s; ``event`` an :class:`Event`;
    ``radius`` the final ‖x‖₂; ``singular`` the smallest det Γ(q)/det Γ(0) met;
    ``input`` the smallest u_max − |demand| (only with a hard input limit);
    ``path`` (N, w) the smallest margins of the path constraints; ``x`` (N, 2n) final states.
    ``closest``, ``closest_time`` and ``closest_x`` (N, 2n): the smallest ‖x‖₂ met, when and
    where, if it was asked for.  ``steps``: how many it took, small ones (four evaluations of
    law and plant) and large ones (two) alike.
    """

    cost: FloatArray
    time: FloatArray
    event: NDArray[np.int64]
    radius: FloatArray
    singular: FloatArray
    input: FloatArray
    path: FloatArray
    closest: FloatArray
    closest_time: FloatArray
    closest_x: FloatArray
    x: FloatArray
    steps: FloatArray

    def __repr__(self) -> str:
        """Show how many there are, and how they ended."""
        codes, counts = np.unique(self.event, return_counts=True)
        ends = [
            f"{count} {Event(int(code)).name.lower()}"
            for code, count in zip(codes, counts, strict=True)
        ]
        return f"Batch({len(self.cost)} rollouts: {', '.join(ends)})"

    @property
    def reached(self) -> NDArray[np.bool_]:
        """Whether the terminal set was reached without breaking any constraint."""
        return np.asarray(self.event == Event.REACHED)

    def score(self, horizon: float) -> FloatArray:
        """Return the cost where admissible, else a graded penalty above 1e9.

        The penalty falls with survival time and then with the final distance, so that a
        search can climb out of a region without admissible surfaces.
        """
        scores = np.empty(len(self.cost))
        _score(self.cost, self.time, self.event, self.radius, horizon, scores)
        return scores


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _score(cost, time, event, radius, horizon, scores):  # type: ignore[no-untyped-def]
    for i in range(len(scores)):
        if event[i] == 1:  # reached
            scores[i] = cost[i]
        elif event[i] == 0:  # horizon
            near = math.tanh(radius[i]) if math.isfinite(radius[i]) else 1.0
            scores[i] = 1e9 * (1.0 + near)
        elif event[i] == 6:  # unstable
            scores[i] = 1e10
        else:
            scores[i] = 1e9 * (3.0 - time[i] / horizon)


@dataclass(frozen=True, eq=False)
class Trajectory:
    """One recorded motion.

    Attributes
    ----------
    t
        Times, (N,), s.
    x
        States (q, q̇), (N, 2n), SI units.
    u
        Inputs after the actuator, (N, m).
    s
        Surface values, (N, m).
    cost
        Cost so far, (N,).
    margin
        det Γ(q)/det Γ(0), (N,): positive where the law exists.
    event
        Why it ended.
    """

    mechanism: Mechanism
    t: FloatArray
    x: FloatArray
    u: FloatArray
    s: FloatArray
    cost: FloatArray
    margin: FloatArray
    event: Event

    def __repr__(self) -> str:
        """Show whose it is, how long it is and how it ended."""
        return (
            f"Trajectory({self.mechanism.name}, {len(self.t)} rows, {self.t[0]:g} to "
            f"{self.t[-1]:.4g} s, {self.event.name.lower()}, cost {self.total:.6g})"
        )

    @property
    def total(self) -> float:
        """Total cost; that of a cascade's run is also ``run.cost``."""
        return float(self.cost[-1])

    @property
    def duration(self) -> float:
        """Time at the end, s."""
        return float(self.t[-1])

    def __getitem__(self, name: str) -> FloatArray:
        """Return the time series of a named state."""
        if name not in self.mechanism.state_names:
            raise InvalidInputError(
                "state of a trajectory",
                value=repr(name),
                limit=f"one of {', '.join(self.mechanism.state_names)}",
            )
        return np.asarray(self.x[:, self.mechanism.state_names.index(name)])

    @classmethod
    @checked
    def join(cls, pieces: Sequence[Trajectory]) -> Trajectory:
        """Join consecutive pieces; costs add up, doubled end points are dropped."""
        at_least("number of pieces", len(pieces), 1, "Give at least one")
        first, spent = pieces[0], 0.0
        columns: dict[str, list[FloatArray]] = {k: [] for k in ("t", "x", "u", "s", "margin")}
        costs = []
        for index, piece in enumerate(pieces):
            end = len(piece.t) if index == len(pieces) - 1 else -1
            for key, parts in columns.items():
                parts.append(getattr(piece, key)[:end])
            costs.append(piece.cost[:end] + spent)
            spent += piece.total
        joined = {key: np.concatenate(parts) for key, parts in columns.items()}
        return cls(first.mechanism, **joined, cost=np.concatenate(costs), event=pieces[-1].event)
