"""Motions that are over, for the page with a time bar: a simulated run, and the log of a run."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from undertow.base import (
    InfeasibleError,
    InvalidInputError,
    MissingExtraError,
    Progress,
    no_progress,
)
from undertow.bounds import Bound, bound
from undertow.cascade import Cascade, Run
from undertow.display.live import Message, Scene
from undertow.display.sketches import Sketch, sketch
from undertow.display.tree_sketch import sketch_named
from undertow.models import FloatArray, Mechanism
from undertow.runtime import Columns, Mode, Recording, read_log
from undertow.runtime.encoding import answer_from, memory_from
from undertow.runtime.replay import legible, recorded_recipe
from undertow.studies.live.beside import INTERVALS, bound_message
from undertow.studies.live.messages import (
    ReadOnlyShow,
    described,
    frame_message,
    plan_message,
    plausible,
)
from undertow.studies.live.planner import Task, cascade_for

#: Pictures in a second, and most of them: a long recording has fewer a second.
RATE, MOST = 60.0, 12_000


class Recorded(ReadOnlyShow):
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


def of_run(
    run: Run, cascade: Cascade, figure: Sketch | None = None, least: Bound | None = None
) -> Message:
    """Return a simulated run as a recording.

    Parameters
    ----------
    run
        To the target x = 0.
    cascade
        Whose run it is.
    figure
        What is drawn; the mechanism's own stick figure by default.
    least
        The optimal-control bound from its start, where that is known.
    """
    motion, mechanism = run.trajectory, cascade.mechanism
    plans = []
    for update in run.updates:
        admission = update.admission
        plan = plan_message(
            update.t, admission.accepted, admission.reason, update.plan, update.predicted,
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
    recording = recording_of(
        mechanism, figure or sketch(mechanism), motion.t[rows], motion.x[rows], motion.u[rows],
        motion.u[rows], motion.s[rows], left, plans,
    )  # fmt: skip
    beside = [] if least is None else [bound_message(least, cascade.objective)]
    return recording | {"beside": beside}


def recorded_run(
    name: str, mechanism: Mechanism, x0: FloatArray, objective: str, period: float, seed: int = 0,
    progress: Progress = no_progress,
) -> Message:  # fmt: skip
    """Simulate a mechanism that was asked for by name to its target, and return the recording.

    Raises
    ------
    InvalidInputError
        For a start at the target: there is no motion.
    """
    limits = tuple(mechanism.input_limits.tolist())
    cascade = cascade_for(mechanism, Task(objective, limits, period), seed)
    cascade.objective.check_start(mechanism, x0)
    radius, away = cascade.objective.terminal_radius, float(np.linalg.norm(x0))
    if away <= radius:
        raise InvalidInputError(
            f"start of '{mechanism.name}'",
            value=f"‖x‖ = {away:.3g}",
            limit=f"more than {radius:g}, where {objective} has arrived",
            remedy="Start further off, --start STATE=VALUE, or take another --objective",
        )
    progress("simulating", 0.0)
    run = cascade.simulate(x0, progress=lambda t, end: progress("simulating", t / end))
    least = None
    with suppress(MissingExtraError, InfeasibleError):  # then there is none to compare with
        progress("the bound", 0.9)
        least = bound(
            cascade.mechanism, cascade.objective, x0, intervals=INTERVALS,
            guess=run.trajectory if run.reached else None,
        )  # fmt: skip
    return of_run(run, cascade, sketch_named(name, mechanism), least)


class LoggedRun:
    """A run as its log tells it: what moved, and what was decided.

    Parameters
    ----------
    recording
        The log, or what there is of it.
    mechanism
        For a log of one's own mechanism in a Python file: which one it is.

    Attributes
    ----------
    belief
        The mechanism.
    first
        The decision that the run began with.

    Raises
    ------
    ArtefactError
        When it is no log of a run, or is of a mechanism that has to be named.
    """

    def __init__(self, recording: Recording, mechanism: str | None = None) -> None:
        recipe, _ = recorded_recipe(recording, mechanism)
        self.belief, self._reaching = recipe.belief, recipe.cascade.reaching
        self._reference, self.period = recipe.reference, recipe.period
        self._known = recipe.cascade.known
        self.columns = Columns.of(self.belief)
        with legible(recording.path):
            name = recipe.mechanism if isinstance(recipe.mechanism, str) else ""
            figure = sketch_named(name, self.belief) if name else sketch(self.belief)
            self.scene = Scene(self.belief, figure)
            memory = memory_from(recording.meta["memory"], self._reference)
            self.first = plan_message(
                0.0, True, "first optimum", memory.plan, memory.predicted, self._reaching
            )

    def frames(self, steps: FloatArray) -> list[Message]:
        """Return pictures of steps, (N, …)."""
        c = self.columns
        left = np.full(len(steps), math.nan)
        return _pictures(
            self.belief, self.scene, steps[:, c.t], steps[:, c.x], steps[:, c.u],
            steps[:, c.demand], steps[:, c.s], left,
            [Mode(int(mode)).name.lower().replace("_", " ") for mode in steps[:, c.mode]],
        )  # fmt: skip

    def decisions(self, recording: Recording) -> list[Message]:
        """Return what a log, or a part of it, says of answers and events, in the order of time."""
        plans: list[Message] = []
        for row in recording.answers:
            answer = answer_from(row, self._reference)
            admission = answer.admission
            plan = plan_message(
                answer.use, admission.accepted, admission.reason, answer.memory.plan,
                answer.memory.predicted, self._reaching,
            )  # fmt: skip
            target = answer.memory.target
            goal = [] if target is None else list(target.position(answer.use))
            plan |= {"ms": 1e3 * answer.seconds, "first": answer.jump, "goal": goal}
            plans.append(plan | {"plausible": plausible(self._known, answer.memory.estimate)})
        for _, at, kind, text in recording.events:
            if kind != "answer":  # which is told above
                plans.append({"kind": "event", "t": at, "why": f"{kind}: {text}"})
        return sorted(plans, key=lambda one: float(one["t"]))


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
    run = LoggedRun(recording, mechanism)
    with legible(path):
        steps = recording.steps
        if len(steps) < 2:
            raise ValueError("less than two steps")
        t = steps[:, run.columns.t]
        plans = [run.first | {"t": float(t[0])}, *run.decisions(recording)]
        frames = run.frames(steps[_evenly(t)])
        return _recording(run.belief, run.scene, frames, plans)


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
    scene = Scene(mechanism, figure)
    frames = _pictures(mechanism, scene, t, x, u, demand, s, left)
    return _recording(mechanism, scene, frames, plans)


def _pictures(
    mechanism: Mechanism, scene: Scene, t: FloatArray, x: FloatArray, u: FloatArray,
    demand: FloatArray, s: FloatArray, left: FloatArray, modes: Sequence[str] = (),
) -> list[Message]:  # fmt: skip
    """Return pictures of a motion, one a row; none where the state is not known."""
    frames, values = [], mechanism.parameter_values
    for k, row in enumerate(zip(t, x, u, demand, s, left, strict=True)):
        if not np.isfinite(row[1]).all():
            continue
        frame = frame_message(scene, values, *row)
        if modes:
            frame["mode"] = modes[k]
        frames.append(frame)
    return frames


def _recording(
    mechanism: Mechanism, scene: Scene, frames: list[Message], plans: Sequence[Message]
) -> Message:
    return {
        **described(mechanism, scene), "live": False, "speeds": [1.0, 0.5, 0.2, 0.05],
        "controls": [], "beside": [], "state": {"kind": "state", "mode": "recording"},
        "frames": frames, "plans": [*plans],
    }  # fmt: skip
