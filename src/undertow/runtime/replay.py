"""A log through the same build again: the same outputs, bit for bit."""

from __future__ import annotations

import hashlib
import math
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from undertow.errors import ArtefactError
from undertow.mechanism import FloatArray
from undertow.results import versions
from undertow.rig.interface import Measurement
from undertow.runtime.controller import Controller, Inputs
from undertow.runtime.encoding import answer_from, memory_from, memory_to
from undertow.runtime.log import Columns, Recording, read_log
from undertow.runtime.modes import Command
from undertow.runtime.recipe import Recipe
from undertow.runtime.slow import Answer, judge

__all__ = ["Replay", "about", "replay", "replay_controller"]


@dataclass(frozen=True, eq=False)
class Replay:
    """What came of a replay.

    Attributes
    ----------
    recording
        The log.
    steps
        Steps that were made again.
    differing
        Steps whose output, estimate, surface value or state differs in any bit.
    first
        The first of them; ``None`` where there is none.
    judged
        Answers of the slow loop that were judged again.
    misjudged
        Answers that the gate decided otherwise on.
    gap
        Number of a step that the log lost; the replay ends before it.
    u
        Outputs, (steps, m).
    build
        What has changed since the log was written: name to (then, now).
    """

    recording: Recording
    steps: int
    differing: int
    first: int | None
    judged: int
    misjudged: int
    gap: int | None
    u: FloatArray
    build: Mapping[str, tuple[Any, Any]]

    @property
    def identical(self) -> bool:
        """Whether everything that was made again is as it was, bit for bit."""
        return self.steps > 0 and not self.differing and not self.misjudged


def about(controller: Controller, recipe: Recipe | None = None, **more: Any) -> dict[str, Any]:
    """Return what a log must tell of a run, so that it can be replayed.

    Parameters
    ----------
    controller
        Idle, as the run will start with it.
    recipe
        From which it was built; without one, a replay needs the controller from its caller.
    **more
        Further JSON values.
    """
    mechanism = controller.cascade.mechanism
    return {
        "mechanism": mechanism.name,
        "fingerprint": mechanism.fingerprint,
        "units": {i.name: i.unit for i in mechanism.inputs},
        "memory": memory_to(controller.memory),
        "recipe": None if recipe is None else recipe.as_dict(),
        "period": controller.period,
        "versions": build(),
        **more,
    }


@lru_cache(maxsize=1)
def build() -> dict[str, str | None]:
    """Return what shapes the bits of a run: versions, and a hash of this package's own sources."""
    package = Path(__file__).parent.parent
    digest = hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        digest.update(path.relative_to(package).as_posix().encode() + path.read_bytes())
    return {**versions(), "sources": digest.hexdigest()[:12]}


def replay(path: Path, *, decisions: bool = True) -> Replay:
    """Replay a log that carries its recipe.

    Parameters
    ----------
    path
        The log.
    decisions
        Also let the gate judge each recorded answer again.

    Raises
    ------
    ArtefactError
        When the file is no log, or has no recipe.
    """
    recording = read_log(path)
    recipe = recording.meta.get("recipe")
    if recipe is None:
        raise ArtefactError(
            f"log '{path}'",
            value="no recipe: the controller was built in Python",
            remedy="Build it again, and call undertow.runtime.replay_controller",
        )
    memory = memory_from(recording.meta["memory"])
    controller = Recipe.from_dict(recipe).make_controller(memory)
    return replay_controller(recording, controller, decisions=decisions)


def replay_controller(
    recording: Recording, controller: Controller, *, decisions: bool = True
) -> Replay:
    """Replay a log through a controller built as for the run, idle.

    Raises
    ------
    ArtefactError
        When the controller believes in another mechanism than the log.
    """
    mechanism = controller.cascade.mechanism
    if recording.meta["fingerprint"] != mechanism.fingerprint:
        raise ArtefactError(
            f"log '{recording.path}'",
            value=f"a run of {recording.meta['mechanism']} with other equations or numbers",
            limit=f"the mechanism of the controller, {mechanism.name}",
            remedy="Replay with the version of the library that wrote it",
        )
    answers: dict[int, list[Answer]] = defaultdict(list)
    for row in recording.answers:
        answers[row["k"]].append(answer_from(row))
    said: dict[tuple[int, str], str] = {(k, kind): text for k, _, kind, text in recording.events}
    columns = Columns.of(mechanism)
    outputs: list[FloatArray] = []
    differing, first, gap = 0, None, None
    judged = misjudged = 0
    for k, row in enumerate(recording.steps):
        if int(row[0]) != k:
            gap = k
            break
        arrived = answers.get(k, [])
        command = Command[said.get((k, "command"), "NONE")]
        inputs = Inputs(
            float(row[1]),
            _measurement(row, columns),
            arrived[0] if arrived else None,
            command,
            said.get((k, "alarm"), ""),
        )
        u = controller.step(inputs)
        outputs.append(u.copy())
        if decisions:
            for answer in arrived:
                judged += 1
                misjudged += not _same_decision(controller, answer)
        if not _same_step(controller, row, columns):
            differing += 1
            first = k if first is None else first
    then, now = recording.meta.get("versions", {}), build()
    changed = {name: (then.get(name), now[name]) for name in now if then.get(name) != now[name]}
    u_all = np.array(outputs).reshape(len(outputs), mechanism.m)
    return Replay(recording, len(outputs), differing, first, judged, misjudged, gap, u_all, changed)


def _measurement(row: FloatArray, columns: Columns) -> Measurement | None:
    if math.isnan(row[5]) and np.isnan(row[columns.q]).all():
        return None
    v = row[columns.v]
    return Measurement(float(row[5]), row[columns.q], None if np.isnan(v).all() else v)


def _same_step(controller: Controller, row: FloatArray, columns: Columns) -> bool:
    pairs = (
        (controller.u, columns.u),
        (controller.x, columns.x),
        (controller.s, columns.s),
        (controller.demand, columns.demand),
    )
    same = all(np.array_equal(values, row[at], equal_nan=True) for values, at in pairs)
    return same and controller.mode == row[3] and controller.memory.sequence == row[4]


def _same_decision(controller: Controller, answer: Answer) -> bool:
    """Let the gate judge a recorded answer again, or look for the surface that catches."""
    cascade = controller.cascade
    if answer.swing >= 0 and controller.swing_up is not None:
        return controller.swing_up.region.surface(answer.x) == answer.proposal.surface
    if answer.proposal.plan is None and answer.proposal.status not in ("failed", "infeasible"):
        return True  # what the optimiser said could not be written down
    _, admission, lanes = judge(cascade, answer.before, answer.proposal, answer.x, answer.use)
    cost = admission.cost == answer.admission.cost or (
        math.isnan(admission.cost) and math.isnan(answer.admission.cost)
    )
    return (
        admission.accepted == answer.admission.accepted
        and cost
        and np.array_equal(lanes, answer.lanes)
    )
