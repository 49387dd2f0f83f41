"""A cascade that follows a target: set-points that jump, references that move.

A set-point is a task of its own, as if started afresh from where the last one was left: its first
plan is found by the global search.  Cost counts until the terminal set about the set-point is
reached; then the mechanism is held there, at no cost, until the target jumps.  A reference is one
task: cost counts while the error is outside the terminal set about it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from undertow.base import positive
from undertow.cascade.cascade import Cascade, CascadeState, Run, Update
from undertow.cascade.targets import legs_of
from undertow.closed_loop import ClosedLoop, Event, Trajectory, simulate_along
from undertow.law import Reference, Target, target_of
from undertow.models import FloatArray, Mechanism


def follow(
    cascade: Cascade,
    x: FloatArray,
    target: Target | Mapping[str, float],
    plant: Mechanism | None,
    duration: float | None,
    progress: Callable[[float, float], None] | None,
) -> Run:
    """Simulate a cascade from x, (2n,), along a target, see :meth:`undertow.Cascade.simulate`."""
    goal, longest, stride = target_of(target), cascade.objective.horizon, cascade.step
    stride *= max(1, cascade.zoh_steps)
    last = 0.0 if isinstance(goal, Reference) else goal.times[-1]
    total = last + longest if duration is None else duration
    positive("duration of a run, s", total, "Leave it out for the objective's horizon")
    legs = legs_of(cascade.mechanism, cascade.objective, goal, total)
    # The inner loop meets a jump at its next sample.
    begins = [math.ceil(begin / stride - 1e-6) * stride for begin, _ in legs if begin < total]
    ends = [*begins[1:], total]
    moving = plant or (None if cascade.known is None else cascade.mechanism)
    truth = replace(cascade.loop, plant=moving, ensemble=None)
    updates: list[Update] = []
    pieces: list[Trajectory] = []
    memory: CascadeState | None = None
    task, arrived, decided_with = -1, False, 0
    for begin, end, (_, motion) in zip(begins, ends, legs, strict=False):
        t = since = due = begin
        while end - t > 0.5 * stride:
            error = x - motion.state(t)
            inside = bool(np.linalg.norm(error) <= cascade.objective.terminal_radius)
            since = t if inside else since
            left = min(longest, total - begin) - (t - since)
            is_due = t > due - 0.5 * stride
            due += cascade.period if is_due else 0.0
            decided = memory is None or t == begin
            if memory is not None and not (decided or inside):
                decided = is_due or not cascade.survives(memory, x, t)
            task += t == begin or (decided and arrived)  # left what was reached: another task
            if memory is None:
                memory, proposal = cascade.start_to(x, motion, t)
                admission = cascade.first_admission(memory, x, left)
            elif t == begin:
                memory, proposal = cascade.retarget_to(memory, x, motion, t)
                admission = cascade.first_admission(memory, x, left)
            elif decided:
                if not left > 0.5 * stride:  # a disturbed plant came too late: a new horizon
                    since, left = t, longest
                proposal = cascade.propose(memory, x, t, left)
                memory, admission = cascade.apply_gate(memory, proposal, x, left)
            if decided:
                spent = sum(piece.cost for piece in pieces[decided_with:])
                decided_with = len(pieces)
                updates.append(
                    Update(t, x, proposal, admission, memory.plan, memory.predicted, spent, task)
                )
            span = min(cascade.learning_period, due - t, end - t)
            piece = _piece(cascade, truth, memory, x, t, span)
            pieces.append(piece)
            if cascade.known is not None:
                memory = cascade.learn(memory, piece.t, piece.x, piece.u)
                truth = truth.believing(cascade.loop_at(replace(memory, target=None)).mechanism)
            t += span
            x = piece.x[-1]
            if progress is not None:
                progress(t, total)
            arrived = piece.event == Event.REACHED
            over = arrived and duration is None and not motion.moves and end == ends[-1]
            if over or piece.event not in (Event.HORIZON, Event.REACHED):
                return Run(Trajectory.join(pieces), tuple(updates))
    return Run(Trajectory.join(pieces), tuple(updates))


def _piece(
    cascade: Cascade, truth: ClosedLoop, memory: CascadeState, x: FloatArray, t: float, span: float
) -> Trajectory:
    """Simulate one period; the motion is absolute, and costs nothing once it has arrived."""
    target, plan = memory.target, memory.at(t)
    assert target is not None  # a run along one has one
    if target.moves:
        return simulate_along(truth, x, plan, target, duration=span, start=t)
    loop, error = cascade.about(truth, target, t), memory.error(t, x)
    motion = loop.simulate(error, plan, duration=span, start=t)
    if motion.event == Event.REACHED:
        held = loop.simulate(error, plan, duration=span, start=t, terminal=0.0)
        cost = np.minimum(held.accumulated_cost, motion.cost)
        event = held.event if held.event != Event.HORIZON else motion.event
        motion = replace(held, accumulated_cost=cost, event=event)
    return replace(motion, mechanism=truth.truth, x=motion.x + target.state(t))
