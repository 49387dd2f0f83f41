"""Motions that are over, for the page with a time bar: a simulated run, and the log of a run."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from undertow.base import InvalidInputError, Progress, no_progress
from undertow.cascade import Cascade, Run
from undertow.display.live import Message, Scene
from undertow.display.sketches import Sketch, sketch
from undertow.display.tree_sketch import sketch_named
from undertow.models import FloatArray, Mechanism
from undertow.runtime import Columns, Mode, read_log
from undertow.runtime.encoding import answer_from, memory_from
from undertow.runtime.replay import legible, recorded_recipe
from undertow.studies.live.messages import described, frame_message, plan_message
from undertow.studies.live.planner import Task, cascade_for

#: Pictures in a second, and most of them: a long recording has fewer a second.
RATE, MOST = 60.0, 12_000


class Recorded:
    """A recording, shown: every viewer moves the time bar of his own.

    Parameters
    ----------
    hello
        What a viewer is told: the whole recording.
    """

    def __init__(self, hello: Message) -> None:
        self._hello = hello

    def hello(self) -> Message:
        """Return the recording."""
        return self._hello

    def advance(self, seconds: float) -> list[Message]:
        """Nothing is new."""
        return []

    def hear(self, said: Message, viewer: int) -> None:
        """Refuse whatever is asked for: what is over does not change.

        Raises
        ------
        InvalidInputError
            Always.
        """
        raise InvalidInputError("recording", value=repr(said.get("do"))[:40], limit="looked at")

    def gone(self, viewer: int) -> None:
        """Nothing was held."""


def of_run(run: Run, cascade: Cascade, figure: Sketch | None = None) -> Message:
    """Return a simulated run as a recording.

    Parameters
    ----------
    run
        To the target x = 0.
    cascade
        Whose run it is.
    figure
        What is drawn; the mechanism's own stick figure by default.
    """
    motion, mechanism = run.trajectory, cascade.mechanism
    plans = []
    for update in run.updates:
        admission = update.admission
        plan = plan_message(
            update.t, admission.accepted, admission.reason, update.surface, update.predicted,
            cascade.reaching,
        )  # fmt: skip
        plan |= {"ms": 1e3 * update.proposal.seconds, "first": update is run.updates[0],
                 "objective": cascade.objective.name}  # fmt: skip
        plans.append(plan)
    starts = np.array([update.t for update in run.updates])
    predicted = np.array([update.predicted for update in run.updates])
    rows = _evenly(motion.t)
    decided = np.clip(np.searchsorted(starts, motion.t[rows] + 1e-9, side="right") - 1, 0, None)
    paid = np.interp(starts, motion.t, motion.accumulated_cost)
    left = predicted[decided] - (motion.accumulated_cost[rows] - paid[decided])
    return recording_of(
        mechanism, figure or sketch(mechanism), motion.t[rows], motion.x[rows], motion.u[rows],
        motion.u[rows], motion.s[rows], left, plans,
    )  # fmt: skip


def recorded_run(
    name: str, mechanism: Mechanism, x0: FloatArray, objective: str, period: float, seed: int = 0,
    progress: Progress = no_progress,
) -> Message:  # fmt: skip
    """Simulate a mechanism that was asked for by name to its target, and return the recording."""
    limits = tuple(mechanism.input_limits.tolist())
    cascade = cascade_for(mechanism, Task(objective, limits, period), seed)
    progress("simulating", 0.0)
    run = cascade.simulate(x0, progress=lambda t, end: progress("simulating", t / end))
    return of_run(run, cascade, sketch_named(name, mechanism))


def of_log(path: Path, mechanism: str | None = None) -> Message:
    """Return the log of a run as a recording.

    Parameters
    ----------
    path
        The log.
    mechanism
        For a log of one's own mechanism in a Python file: which one it is.

    Raises
    ------
    ArtefactError
        When it is no log of a run, or is of a mechanism that has to be named.
    """
    recording = read_log(path)
    recipe, _ = recorded_recipe(recording, mechanism)
    belief, reaching = recipe.belief, recipe.cascade.reaching
    with legible(path):
        columns, steps = Columns.of(belief), recording.steps
        if len(steps) < 2:
            raise ValueError("less than two steps")
        first = memory_from(recording.meta["memory"], recipe.reference)
        t = steps[:, columns.t]
        plans = [plan_message(float(t[0]), True, "first optimum", first.surface, first.predicted,
                              reaching)]  # fmt: skip
        for row in recording.answers:
            answer = answer_from(row, recipe.reference)
            admission = answer.admission
            plan = plan_message(
                answer.use, admission.accepted, admission.reason, answer.memory.surface,
                answer.memory.predicted, reaching,
            )  # fmt: skip
            target = answer.memory.target
            goal = [] if target is None else list(target.position(answer.use))
            plan |= {"ms": 1e3 * answer.seconds, "first": answer.jump, "goal": goal}
            plans.append(plan)
        for _, at, kind, text in recording.events:
            if kind != "answer":  # which is told above
                plans.append({"kind": "event", "t": at, "why": f"{kind}: {text}"})
        plans.sort(key=lambda one: float(one["t"]))
        rows = _evenly(t)
        frames = steps[rows]
        name = recipe.mechanism if isinstance(recipe.mechanism, str) else ""
        figure = sketch_named(name, belief) if name else sketch(belief)
        left = np.full(len(rows), math.nan)
        message = recording_of(
            belief, figure, t[rows], frames[:, columns.x], frames[:, columns.u],
            frames[:, columns.demand], frames[:, columns.s], left, plans,
        )  # fmt: skip
        for frame, mode in zip(message["frames"], frames[:, columns.mode], strict=True):
            frame["mode"] = Mode(int(mode)).name.lower().replace("_", " ")
        return message


def _evenly(t: FloatArray) -> Any:
    """Return the numbers of rows for even pictures."""
    count = int(min(MOST, max(2, math.ceil((t[-1] - t[0]) * RATE) + 1)))
    wanted = np.linspace(t[0], t[-1], count)
    return np.unique(np.clip(np.searchsorted(t, wanted), 0, len(t) - 1))


def recording_of(
    mechanism: Mechanism, figure: Sketch, t: FloatArray, x: FloatArray, u: FloatArray,
    demand: FloatArray, s: FloatArray, left: FloatArray, plans: Sequence[Message],
) -> Message:  # fmt: skip
    """Return instants of a motion, one a row, and its decisions as a recording."""
    scene, values = Scene(mechanism, figure), mechanism.parameter_values
    frames = []
    for row in zip(t, x, u, demand, s, left, strict=True):
        if not np.isfinite(row[1]).all():
            continue
        frame = frame_message(*row)
        frame["points"] = scene.places(row[1][: mechanism.n], values).tolist()
        frames.append(frame)
    return {
        **described(mechanism, scene), "live": False, "speeds": [1.0, 0.5, 0.2, 0.05],
        "controls": [], "state": {"kind": "state", "mode": "recording"}, "frames": frames,
        "plans": [*plans],
    }  # fmt: skip
