"""Searches for schedules of surfaces that arrive earlier than a single one can.

From nothing they follow the earliest arrival over all inputs, see
:mod:`undertow.optimiser.open_loop` and :mod:`undertow.optimiser.following`; from a schedule in use
they lead it to the target again, all its surfaces together.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from undertow.closed_loop import INADMISSIBLE, RolloutBuffers
from undertow.closed_loop.trajectory import Batch
from undertow.law import Plan
from undertow.models import FloatArray
from undertow.optimiser.arrival import ArrivalSearch
from undertow.optimiser.fitting import fits
from undertow.optimiser.following import SHORTEST, Follower, refined
from undertow.optimiser.open_loop import EarliestArrival, OpenLoopMotion
from undertow.optimiser.task import EXACT, Optimisation, ends

#: Improvements below this part of the cost do not keep a search going.
WORTHWHILE = 1e-3

#: Spread of draws far and wide.
WIDE = 1.5

#: A schedule as early as this many times the earliest arrival needs no other search.
AS_EARLY = 1.02

#: The parts of the input limits that a motion may take up for a schedule to follow it, one try
#: after another.  At its limits an input has nothing left to correct with: where it switches often,
#: surfaces follow a motion that leaves it some.
ROOM = (1.0, 0.9, 0.75)

#: When a schedule in use is to arrive: in parts of its arrival where it is kept, else of what it
#: promised; and whether the search begins from the designs.
SOONER = ((0.6, True), (0.75, True), (0.88, False), (0.97, False))
LATER = ((1.0, False), (1.1, False), (1.25, False), (1.6, True), (2.5, True), (4.0, True))

#: T after an arrival, as a part of the one before, at first and in the end; members that remain;
#: ways to sway a schedule, and how far they go.
HURRY, UNHURRIED = 0.9, 0.98
FEWEST, WAYS, SWAY = 4, 3, (0.02, 0.5)

#: Draws of a schedule's surfaces: the largest factor of their gain, as its logarithm.
STRONG = 5.0


def follow_earliest(task: Optimisation, keep: int = 0) -> Iterator[bool]:
    """Look for the earliest arrival over all inputs, and for a schedule that follows it.

    Starts from the motion of the best plan, and then elsewhere: what is found is a local
    optimum.  Yields after each whether the plan is as early by now.  So many evaluations are
    left over.
    """
    arrival = earliest_arrival(task, keep)
    motion = earliest_motion(task, arrival)
    if motion is None:
        return
    earliest = motion.time
    _follow(task, motion, keep)
    yield task.best_cost <= AS_EARLY * earliest
    for guess in (motion.faster(), motion.mirrored()):
        other = arrival.improve(guess)
        if other is not None and other.time < earliest / AS_EARLY:
            earliest = other.time
            _follow(task, other, keep)
            yield task.best_cost <= AS_EARLY * earliest


def earliest_motion(task: Optimisation, arrival: EarliestArrival) -> OpenLoopMotion | None:
    """Return the earliest arrival over all inputs near the best plan's; ``None`` without one."""
    loop, best, long = task.loop, task.best, task.best_cost
    if best is None or not np.isfinite(loop.mechanism.input_limits).all():
        return None
    if not long < INADMISSIBLE:
        long = float(loop.batch(task.x, best, duration=task.horizon, seek=True).closest_time[0])
    if long <= loop.step:
        return None
    return arrival.improve(OpenLoopMotion.of(loop.simulate(task.x, best, duration=long), long))


def earliest_arrival(task: Optimisation, keep: int, part: float = 1.0) -> EarliestArrival:
    """Return the task over all inputs, as long as more evaluations than these are left.

    ``part``: of the input limits, that it may take up.
    """
    loop = task.loop
    low, high = loop.objective.range_of(loop.mechanism)
    radius = loop.objective.terminal_radius
    return EarliestArrival(
        loop.mechanism, radius, low, high, lambda: task.left <= keep or task.late(), part
    )


def _follow(task: Optimisation, motion: OpenLoopMotion, keep: int) -> None:
    """Look for a schedule that follows a motion, or one like it with smaller inputs.

    Where that is earlier than the best plan.  Each try has the same share of the evaluations, so
    many of which are left over.
    """
    for k, part in enumerate(ROOM):
        tries = len(ROOM) - k
        kept = keep + max(0, task.left - keep) * (tries - 1) // tries
        arrival = earliest_arrival(task, kept, part)
        followed = motion if part == 1.0 else arrival.improve(motion.with_inputs(part))
        if followed is None:
            continue
        if followed.time >= (1.0 - WORTHWHILE) * task.best_cost - task.resolution:
            break
        plan = _schedule(task, arrival, followed, kept)
        if plan is not None:
            task.consider(plan)
            lead_back(task, plan)
            break


def lead_back(task: Optimisation, incumbent: Plan) -> bool:
    """Look for earlier arrivals of a plan in use, moving all its surfaces together.

    Where it arrives no more as promised, because the state was pushed, later arrivals than that
    come first.  Returns whether it was kept or there is an arrival now.
    """
    promised, before = incumbent.times[-1], task.best_cost
    kept = before <= promised or (not promised and before < INADMISSIBLE)
    if not (kept or promised) or before <= SHORTEST * task.loop.step:  # nothing, all but there
        return kept
    first, tries = (before, SOONER) if kept else (promised, LATER)
    for part, designs in tries:
        T = min(part * first, task.horizon)
        _lead_back(task, incumbent, T, HURRY, designs)
        if task.best_cost < before:
            break
    while task.best is not None and task.best_cost < (1.0 - WORTHWHILE) * before:
        before = task.best_cost
        _lead_back(task, task.best, UNHURRIED * before, UNHURRIED)
    return kept or task.best_cost <= T


def _lead_back(
    task: Optimisation, incumbent: Plan, T: float, shorter: float, designs: bool = False
) -> None:
    """Search for arrivals until T, s, around a plan and the same plan, stretched.

    Or around the designs.
    """
    loop, period = task.loop, task.optimiser.freedom.schedule
    T = max(T, 2 * loop.step)
    times = refined([t for t in incumbent.times[:-1] if t < T], period, T, loop.step)
    space = task.space.at(times)
    laws, end = incumbent.laws(loop.reaching), max(1, len(incumbent.times) - 1)
    moving = Plan(incumbent.surfaces[:end], incumbent.times[:end], laws[:end])
    slower = T / max(incumbent.times[-1], loop.step) if end > 1 else 1.0
    stretched = replace(moving, times=tuple(t * slower for t in moving.times))
    z = np.array([space.encode(moving), space.encode(stretched)])
    near = np.geomspace(*SWAY, WAYS)
    z = np.vstack([z, z.repeat(WAYS, axis=0) + space.steps(task.rng, np.tile(near, len(z)))])
    if designs:
        z = np.tile(task.optimiser.firsts, space.segments)

    def admits(z: FloatArray) -> NDArray[np.bool_]:
        task.evaluations += EXACT * len(z)
        batch = space.batch(task.x, z, duration=T, precise=True)
        arrives = np.array(batch.reached)
        for k in np.argsort(np.where(arrives, batch.time, np.inf))[: arrives.sum()]:
            if task.consider(_ended(task, space.plan(z[k]), float(batch.time[k]))):
                break
            arrives[k] = False
        return arrives

    search = ArrivalSearch(
        partial(task.states, space=space),
        admits,
        0.9 * loop.objective.terminal_radius,
        lambda evaluations: task.left < evaluations or task.late(),
        shorter,
        FEWEST,
    )
    search.run(z, T, FEWEST)


def _ended(task: Optimisation, plan: Plan, arrives: float) -> Plan:
    """Return a plan with the first design taking over at the next multiple of the period."""
    period = task.optimiser.freedom.schedule
    end = round(period * math.ceil(arrives / period - 1e-9), 9)
    count = sum(t < end - 1e-9 for t in plan.times)
    anchor = task.space.plan(task.optimiser.firsts[0])
    laws = plan.laws(task.loop.reaching)[:count] + anchor.laws(task.loop.reaching)
    return Plan(plan.surfaces[:count] + anchor.surfaces, (*plan.times[:count], end), laws)


def _schedule(
    task: Optimisation, arrival: EarliestArrival, motion: OpenLoopMotion, keep: int
) -> Plan | None:
    """Return surfaces that follow a motion, the last but one of which arrives.

    From the next multiple of the period on the first design takes over: that is stable, as the
    last surface of a plan must be.  So many evaluations are left over.
    """
    loop, space, period = task.loop, task.space, task.optimiser.freedom.schedule
    m = loop.mechanism.m

    def draw(count: int, before: FloatArray | None) -> FloatArray:
        z = task.firsts[0] + space.steps(task.rng, np.full(count, WIDE))
        z[:, -2 * m : -m] += task.rng.uniform(0.0, STRONG, (count, m))
        if before is not None:
            near = np.geomspace(1e-3, 1.0, count // 8)
            z[: len(near)] = before + space.steps(task.rng, near)
        return np.asarray(z)

    def afforded(roll_out: Callable[[FloatArray], Batch], z: FloatArray, time: float) -> FloatArray:
        """States at the end, (N, 2n): infinite for those that the budget has no room for."""
        each, found = time / motion.time, np.full((len(z), 2 * loop.mechanism.n), np.inf)
        z = z[: max(0, math.floor((task.left - keep) / each))]
        task.evaluations += math.ceil(len(z) * each)
        if len(z):
            found[: len(z)] = ends(roll_out(z))
        return found

    def states(x: FloatArray, z: FloatArray, time: float) -> FloatArray:
        def roll_out(z: FloatArray) -> Batch:
            buffers = RolloutBuffers(loop, len(z), 1).fill(x, *space.decode(z))
            return loop.roll_out(buffers, (0.0,), time, terminal=0.0)

        return afforded(roll_out, z, time)

    def exact(x: FloatArray, z: FloatArray, time: float) -> FloatArray:
        return afforded(partial(space.batch, x, duration=time, terminal=0.0, precise=True), z, time)

    fit = partial(fits, space, task.optimiser.anchor)
    follower = Follower(draw, fit, states, exact, arrival, period, loop.step)
    found = follower.follow(motion)
    if found is None:
        return None
    z, times, end = found
    return _ended(task, space.at(times).plan(z.ravel()), end)
