"""Surfaces whose motion follows a given one, one after another; knows nothing of plans.

A single surface can seldom do what the best input does.  For a short while it can: its parameters,
with its reaching law, are more than the states.  So each surface is to bring the state, from where
the one before it left it, to where the given motion is a while later, and the last one to the
target.  What no surface does in a whole period is done by several.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from undertow.models import FloatArray
from undertow.optimiser.arrival import closer, nearest
from undertow.optimiser.open_loop import EarliestArrival, OpenLoopMotion

#: Surfaces that are drawn for each piece, those of them that are improved, and the most steps; and
#: how many times as much of all three where nothing else is left.
DRAWN, IMPROVED, STEPS, MANY = 1024, 16, 15, 4

#: Surfaces that are improved further without the errors of a search, how near, in terminal radii,
#: the best has to be for that, and the most steps.
FINAL, PROMISES, FINISH = 2, 3.0, 8

#: Steps of the shortest piece.
SHORTEST = 10

#: What is near enough, in terminal radii: to the motion, so that the search for a piece ends; so
#: that it is accepted; and to the target.
FOLLOWS, ACCEPTED, CLOSE = 0.05, 0.5, 0.97

#: The last piece is up to so many times as long as the others; when to look for its arrival, in
#: parts of what is left of the motion, and how many of these while there may be shorter pieces.
LAST, AFTER, BEFORE = 1.5, (1.0, 1.05, 1.1, 1.2, 1.3, 1.5, 2.0), 2

#: While there may be shorter pieces and none ends nearer than this, in terminal radii, no other
#: arrival is looked for.
FAR = 15.0

#: Pieces of a motion at least, where the steps allow.
PIECES = 6


def refined(times: Sequence[float], period: float, end: float, step: float) -> tuple[float, ...]:
    """Return times before an end, s, with all multiples of a period, and the longest pieces halved.

    Until there are ``PIECES``, or none is longer than ``SHORTEST`` steps.
    """
    multiples = [round(k * period, 9) for k in range(math.ceil(end / period - 1e-9))]
    edges = sorted({*times, *multiples, end})
    while len(edges) <= PIECES:
        k = int(np.argmax(np.diff(edges)))
        middle = step * round((edges[k] + edges[k + 1]) / 2 / step)
        if edges[k + 1] - edges[k] <= SHORTEST * step:
            break
        edges.insert(k + 1, round(middle, 9))
    return tuple(edges[:-1])


@dataclass(frozen=True, eq=False)
class Follower:
    """Looks for surfaces that follow a motion to its end.

    ``draw``: draws search coordinates of so many surfaces, (N, d), some of them near the last one
    (d,). ``fit``: search coordinates (N, d) for states (2n, K) and accelerations (n, K) to be
    followed. ``states``: states (N, 2n) so long, s, after a state x, for search coordinates (N, d);
    infinite for a motion that broke off. ``exact``: the same, integrated without the errors of a
    search. ``arrival``: whose motions are followed, and found anew from where the surfaces lead.
    ``period``: the longest piece, s: one ends at each of its multiples. ``step``: of which pieces
    are multiples, s.
    """

    draw: Callable[[int, FloatArray | None], FloatArray]
    fit: Callable[[FloatArray, FloatArray], FloatArray]
    states: Callable[[FloatArray, FloatArray, float], FloatArray]
    exact: Callable[[FloatArray, FloatArray, float], FloatArray]
    arrival: EarliestArrival
    period: float
    step: float

    def follow(self, motion: OpenLoopMotion) -> tuple[FloatArray, tuple[float, ...], float] | None:
        """Return surfaces (S, d), when each takes over, s, and a multiple of the period, s.

        By that the last one has arrived.  ``None`` where that was not found.
        """
        radius, shortest = self.arrival.radius, SHORTEST * self.step
        scale = np.maximum(np.abs(motion.x).max(axis=0), radius)
        x, left, passed, piece = motion.x[0], motion, 0.0, self.period
        found: list[FloatArray] = []
        times, off = [0.0], 0.0
        while not self.arrival.late():
            before = found[-1] if found else None
            last_leg = left.time - passed < LAST * piece
            if off > ACCEPTED * radius or (last_leg and off > FOLLOWS * radius):
                again = self.arrival.improve(left.after(passed, x))
                left, passed, off = (left, passed, 0.0) if again is None else (again, 0.0, 0.0)
            rest, divisible = left.time - passed, piece > shortest
            if rest < LAST * piece:
                given = self.fit(*self.arrival.along(left, passed, left.time))
                last = self._arrive(x, given, left.x[-1], rest, scale, divisible, before)
                if last is not None:
                    return self._whole([*found, last[0]], times, times[-1] + last[1])
                if not divisible:
                    return None
            multiple = self.period * math.floor(times[-1] / self.period + 1.0 + 1e-9)
            time = min(piece, self._in_steps(multiple - times[-1]))
            beside = math.inf
            if rest > time:
                goal = self.arrival.state_at(left, passed + time)
                given = self.fit(*self.arrival.along(left, passed, passed + time))
                z, ends = self._lead(x, given, goal, time, scale, FOLLOWS * radius, before)
                if len(z):
                    end, beside = ends[0], float(np.linalg.norm(ends[0] - goal))
            if beside > ACCEPTED * radius and divisible:
                piece = max(shortest, self._in_steps(time / 2))
                continue
            lost = beside > ACCEPTED * radius and rest < LAST * self.period
            if lost or not math.isfinite(beside):
                return None
            found.append(z[0])
            times.append(round(times[-1] + time, 9))
            x, passed, piece, off = end, passed + time, self.period, beside
        return None

    def _in_steps(self, time: float) -> float:
        return self.step * round(time / self.step)

    def _arrive(
        self,
        x: FloatArray,
        given: FloatArray,
        end: FloatArray,
        rest: float,
        scale: FloatArray,
        divisible: bool,
        before: FloatArray | None,
    ) -> tuple[FloatArray, float] | None:
        """Return a surface, (d,), that leads from x to the target, and in what time, s."""
        radius, target, closest = self.arrival.radius, np.zeros_like(x), math.inf
        parts = AFTER[:BEFORE] if divisible else AFTER
        for part, measure in itertools.product(parts, (scale, np.full_like(x, radius))):
            time = self.step * math.ceil(part * rest / self.step)
            z, ends = self._lead(
                x, given, end / part, time, measure, CLOSE * radius, before, target,
                1 if divisible else MANY,
            )  # fmt: skip
            if len(z):
                closest = min(closest, float(np.linalg.norm(ends[0])))
            if closest < radius:
                return z[0], time
            if divisible and closest > FAR * radius:
                break
        return None

    def _whole(
        self, z: list[FloatArray], times: list[float], arrives: float
    ) -> tuple[FloatArray, tuple[float, ...], float]:
        """Let the last surface take over again at each multiple of the period until it arrives."""
        end = math.ceil(arrives / self.period - 1e-9)
        multiples = [round(k * self.period, 9) for k in range(1, end)]
        more = [t for t in multiples if t > times[-1] + 1e-9]
        z = [*z, *[z[-1]] * len(more)]
        return np.array(z), (*times, *more), round(end * self.period, 9)

    def _lead(
        self,
        x: FloatArray,
        given: FloatArray,
        goal: FloatArray,
        time: float,
        scale: FloatArray,
        near: float,
        before: FloatArray | None,
        target: FloatArray | None = None,
        effort: int = 1,
    ) -> tuple[FloatArray, FloatArray]:
        """Return surfaces (N, d) that lead from x to a goal in so long, s, the nearest first.

        With the states that they lead to, (N, 2n).  The search, in parts of ``scale``, (2n,),
        begins from some that are given and some that are drawn, and ends at the first that is
        nearer than ``near`` to ``target``, (2n,), by default the goal.  There may be none: all
        motions may break off.
        """
        radius = self.arrival.radius
        beside = np.zeros_like(goal) if target is None else goal - target

        def improved(
            states: Callable[[FloatArray, FloatArray, float], FloatArray],
            z: FloatArray,
            members: int,
            steps: int,
        ) -> tuple[FloatArray, FloatArray]:
            """Return the best of some surfaces after so many steps, and how far off they are."""

            def off(z: FloatArray) -> tuple[FloatArray, FloatArray]:
                return (states(x, z, time) - goal) / scale, np.zeros(len(z))

            z, miss, t = nearest(z, *off(z), members)
            damping = np.full(len(z), 1e-2)
            for _ in range(steps):
                close = len(z) and np.linalg.norm(miss * scale + beside, axis=1).min() < near
                if close or not len(z) or self.arrival.late():
                    break
                z, miss, t, damping = closer(off, z, miss, t, damping)
            order = np.argsort(np.linalg.norm(miss * scale + beside, axis=1), kind="stable")
            return z[order], miss[order] * scale + goal

        z = np.vstack([given, self.draw(effort * DRAWN, before)])
        z, ends = improved(self.states, z, effort * IMPROVED, effort * STEPS)
        if not len(z):
            return z, ends
        promising = np.linalg.norm(ends[0] - goal + beside) < PROMISES * radius
        return improved(self.exact, z[:FINAL], FINAL, FINISH if promising else 0)
