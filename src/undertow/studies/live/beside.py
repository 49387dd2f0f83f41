"""What is known of a motion beside it: what the best input would pay, and what comes home.

Both take from a tenth of a second to some seconds, so each is computed in a process of its own,
which gives way to all others, and the page shows what there is: the optimal-control bound from
where a task began, and a map of the phase plane through the present state.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib.util import find_spec
from typing import Any

import numpy as np

from undertow.base import UndertowError
from undertow.bounds import Bound, bound
from undertow.cascade import Cascade
from undertow.closed_loop import ClosedLoop
from undertow.display.live import Message
from undertow.law import ReachingLaw, ReferenceMotion, SlidingModeLaw, Surface
from undertow.models import FloatArray, Mechanism
from undertow.objective import Objective
from undertow.proofs import search_for
from undertow.runtime import Worker, background_worker
from undertow.studies.live.planner import Task, cascade_for

#: Cells of a map on each side; intervals of the first mesh of a bound; how nice both are, of 19.
SIDE, INTERVALS, NICE = 17, 50, 19

#: A map is drawn again after so many times as long as it took, between these, s: the first one has
#: compiled what it needs, too.
REST, SOONEST, LATEST = 3.0, 0.4, 3.0

#: Bounds that are remembered.
KEPT = 16

#: What a cell of a map is: lost; brought home with the input at its limit there; brought home.
LOST, LIMITED, HOME = 0, 1, 2


@dataclass(frozen=True, eq=False)
class BoundAsked:
    """From which state, (2n,), for which task, of a plant with which parameters, and since when."""

    t: float
    task: Task
    parameters: FloatArray
    x: FloatArray


@dataclass(frozen=True, eq=False)
class MapAsked:
    """Which plane through a state, for which law.

    ``task``: whose limits count. ``parameters``: of the plant that the controller takes for the
    truth. ``surface``, ``reaching``: its law. ``x``: the state, counted from the target ``goal``,
    (n,). ``axis``: the coordinate that is drawn, and its rate; ``reach``: how far each, SI units.
    """

    t: float
    task: Task
    parameters: FloatArray
    surface: Surface
    reaching: ReachingLaw
    x: FloatArray
    goal: FloatArray
    axis: int
    reach: tuple[float, float]


def bounds_of(mechanism: Mechanism) -> Callable[[BoundAsked], Message]:
    """Return what finds optimal-control bounds of a mechanism; one that is not found says why."""
    found_before: dict[tuple[object, ...], Message] = {}  # after a reset it is asked for again

    def answer(asked: BoundAsked) -> Message:
        key = (asked.t, asked.task, *asked.parameters.tolist(), *asked.x.tolist())
        if key not in found_before:
            if len(found_before) >= KEPT:
                found_before.clear()
            found_before[key] = find(asked)
        return found_before[key]

    def find(asked: BoundAsked) -> Message:
        objective = cascade_for(mechanism, asked.task).objective
        plant = mechanism.with_values(asked.parameters).with_input_limit(*asked.task.limits)
        try:
            found = bound(plant, objective, asked.x, intervals=INTERVALS)
        except (UndertowError, ArithmeticError, RuntimeError) as error:
            return {"kind": "bound", "t": asked.t, "cost": None, "why": str(error)[:300]}
        return bound_message(found, objective, asked.t)

    return answer


def bound_message(found: Bound, objective: Objective, t: float = 0.0) -> Message:
    """Return a bound from the time t on: its cost, and what is left of that along its motion."""
    left = cost_to_go(found, objective)
    return {"kind": "bound", "t": float(t), "cost": float(found.cost), "why": "",
            "times": (t + found.t).tolist(), "left": left.tolist()}  # fmt: skip


def cost_to_go(found: Bound, objective: Objective) -> FloatArray:
    """Return what is left to pay at the nodes of a bound's motion, (2N+1,): its cost first."""
    rate = objective.stage_function(found.mechanism)
    paid = np.array([rate(*x, *u)[0] for x, u in zip(found.x, found.u, strict=True)], dtype=float)
    # Simpson's rule over each interval, whose middle is a node, too.
    steps = np.diff(found.t[::2])
    whole = steps / 6.0 * (paid[:-2:2] + 4.0 * paid[1::2] + paid[2::2])
    first = steps / 24.0 * (5.0 * paid[:-2:2] + 8.0 * paid[1::2] - paid[2::2])
    spent = np.zeros(len(found.t))
    spent[2::2] = np.cumsum(whole)
    spent[1::2] = spent[:-2:2] + first
    return np.maximum(found.cost - spent, 0.0)


def maps_of(mechanism: Mechanism) -> Callable[[MapAsked], Message]:
    """Return what maps the phase plane of a mechanism: every cell is simulated to its end."""

    @lru_cache(maxsize=4)
    def loop_for(task: Task) -> tuple[Cascade, ClosedLoop]:
        cascade = cascade_for(mechanism, task)
        objective, law = cascade.objective, cascade.reaching
        return cascade, ClosedLoop(cascade.mechanism, objective, law, step=cascade.step)

    def answer(asked: MapAsked) -> Message:
        n, (far, fast) = mechanism.n, asked.reach
        believed = mechanism.with_values(asked.parameters).with_input_limit(*asked.task.limits)
        middle = (np.arange(SIDE) + 0.5) * 2.0 / SIDE - 1.0
        starts = np.tile(asked.x, (SIDE * SIDE, 1))
        starts[:, asked.axis] = np.tile(far * middle, SIDE) - asked.goal[asked.axis]
        starts[:, n + asked.axis] = np.repeat(fast * middle, SIDE)
        eta_and_layer = asked.reaching.vector(mechanism.m)[None, None, :]
        cascade, loop = loop_for(asked.task)
        # The travel is not counted from the target.
        goal = ReferenceMotion.at_rest(asked.goal) if asked.goal.any() else None
        batch = cascade.about(loop.believing(believed), goal, 0.0).batch(
            starts, asked.surface.vector[None, None, :], reaching=eta_and_layer
        )  # fmt: skip
        law = SlidingModeLaw(believed, asked.surface, asked.reaching)
        with np.errstate(all="ignore"):  # at a singularity it asks for anything
            within = (np.abs(law(0.0, starts).demand) <= believed.input_limits).all(axis=-1)
        cells = np.where(batch.reached, np.where(within, HOME, LIMITED), LOST)
        return {
            "kind": "region", "t": float(asked.t), "axis": asked.axis, "reach": [far, fast],
            "side": SIDE, "cells": "".join(map(str, cells.tolist())),
            "proved": _proved(believed, asked.surface, asked.reaching),
        }  # fmt: skip

    return answer


def _proved(mechanism: Mechanism, surface: Surface, reaching: ReachingLaw) -> list[list[float]]:
    """Return W/ρ of a proved terminal set {|W x| ≤ ρ}, rows of 2n; none where none is found."""
    with contextlib.suppress(UndertowError):
        search = search_for(mechanism, surface, reaching)
        found = None if search is None else search.largest(2)
        if found is not None:
            rows: list[list[float]] = (found.W / found.radius).tolist()
            return rows
    return []


class Beside:
    """Asks for bounds and maps, one of each at a time, and hands out what came of them.

    Parameters
    ----------
    bounds, maps
        Who computes; ``None``: nobody does.
    """

    def __init__(
        self,
        bounds: Worker[BoundAsked, Message] | None,
        maps: Worker[MapAsked, Message] | None,
    ) -> None:
        self._bounds, self._maps = bounds, maps
        self._wanted: BoundAsked | None = None  # once the one before has been answered
        self._bounding = self._stale = False
        self._mapping: float | None = None  # since when by the clock, s
        self._due, self._drawn = 0.0, np.empty(0)

    def begin(self, asked: BoundAsked | None) -> None:
        """Ask for the bound of what has just begun; of what went before none is wanted."""
        self._stale, self._wanted = self._bounding, asked
        self._next()

    def forget(self) -> None:
        """Begin anew: whatever is still computed is for what is over."""
        self.begin(None)
        self._drawn = np.empty(0)

    def _next(self) -> None:
        if self._bounds is not None and self._wanted is not None and not self._bounding:
            self._bounds.ask(self._wanted)
            self._wanted, self._bounding = None, True

    def draw(self, clock: float, asked: Callable[[], MapAsked]) -> None:
        """Ask for the map that is wanted now, where one is due and would not be the last again."""
        if self._maps is None or self._mapping is not None or clock < self._due:
            return
        wanted = asked()
        numbers = _numbers(wanted)
        if np.array_equal(numbers, self._drawn):
            return
        self._drawn, self._mapping = numbers, clock
        self._maps.ask(wanted)

    def take(self, clock: float) -> list[Message]:
        """Return what has been found since."""
        said = []
        if self._bounds is not None and (found := self._bounds.take(clock)) is not None:
            if not self._stale:
                said.append(found)
            self._bounding = self._stale = False
            self._next()
        if self._maps is not None and (drawn := self._maps.take(clock)) is not None:
            if len(self._drawn):  # else it is of what is over
                said.append(drawn)
            took = clock - (clock if self._mapping is None else self._mapping)
            self._mapping, self._due = None, clock + min(max(SOONEST, REST * took), LATEST)
        return said

    def close(self) -> None:
        """End both."""
        for one in (self._bounds, self._maps):
            if one is not None:
                one.close()


def _numbers(asked: MapAsked) -> FloatArray:
    """Return all that a map depends on, as it counts: states to a thousandth of the picture."""
    far, fast = asked.reach
    n, scale = len(asked.goal), 1e3 / np.array([far, fast])
    x = asked.x * np.repeat(scale, n)
    law = np.append(asked.surface.vector, asked.reaching.vector(asked.surface.m))
    own: Sequence[float] = (asked.axis, far, fast, *asked.task.limits, hash(asked.task) % 2**31)
    return np.concatenate([own, np.rint(x), asked.goal, asked.parameters, law])


def beside(mechanism: Mechanism) -> Beside:
    """Return both for a mechanism, in processes of their own; no bounds without their solver."""

    def politely(compute: Callable[[Any], Message]) -> Callable[[Any], Message]:
        def computed(asked: Any) -> Message:
            if hasattr(os, "setpriority"):  # every other process goes first
                with contextlib.suppress(OSError):
                    os.setpriority(os.PRIO_PROCESS, 0, NICE)
            return compute(asked)

        return computed

    solver = find_spec("casadi") is not None
    bounds = background_worker(politely(bounds_of(mechanism)), processes=1) if solver else None
    return Beside(bounds, background_worker(politely(maps_of(mechanism)), processes=1))
