"""A log through the same build again: the same outputs, bit for bit.

A log is data.  Where its mechanism is one of its author's own, in a Python file, the log only
names that file; whoever replays it names the file to run, and its hash is compared.
"""

from __future__ import annotations

import contextlib
import math
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from undertow.base import ArtefactError, UndertowError, checked, error_text, file_hash, versions
from undertow.estimators import MakeEstimator
from undertow.mechanisms.named import named
from undertow.models import FloatArray, Mechanism
from undertow.models.importers.python_file import in_a_file
from undertow.runtime.controller import Controller, Inputs
from undertow.runtime.encoding import TOLD, Columns, answer_from, legs_from, memory_from, memory_to
from undertow.runtime.modes import Command
from undertow.runtime.recipe import Recipe
from undertow.runtime.recording import Recording, read_log
from undertow.runtime.slow_loop import Answer, judge, law_vectors_of, next_of_swing
from undertow.symbolic import processor, sources_digest


@dataclass(frozen=True, eq=False)
class Replay:
    """What came of a replay.

    ``differing``: of the ``steps`` that were made again, those whose output, estimate, surface
    value or state differs in any bit; ``first``: the first of them. ``judged``, ``misjudged``:
    answers of the slow loop that were judged again, and those that the gate decided otherwise on.
    ``gap``: number of a step that the log lost; the replay ends before it. ``u``: outputs, (steps,
    m). ``build``: what has changed since the log was written, name to (then, now). ``remarks``:
    what else is to be known of it, in sentences.
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
    remarks: tuple[str, ...] = ()

    def __repr__(self) -> str:
        """Show whose run it was, and what came of it."""
        return (
            f"Replay({self.recording.path.name}, {self.steps} steps, {self.differing} differ, "
            f"{self.judged} answers, {self.misjudged} judged otherwise)"
        )

    @property
    def identical(self) -> bool:
        """Whether everything that was made again is as it was, bit for bit."""
        return self.steps > 0 and not self.differing and not self.misjudged


def about(controller: Controller, recipe: Recipe | None = None, **more: Any) -> dict[str, Any]:
    """Return what a log must tell of a run, so that it can be replayed.

    The controller is idle, as the run will start with it. Without a recipe, or with one whose
    mechanism or objective has no name, a replay needs the controller from its caller. ``more`` are
    further JSON values.
    """
    mechanism = controller.cascade.mechanism
    recipe = None if recipe is None else recipe.in_names()
    name = "" if recipe is None else str(recipe.mechanism)
    return {
        "mechanism": mechanism.name,
        "source": _source_hash(name) if in_a_file(name) else None,
        "fingerprint": mechanism.fingerprint,
        "coordinates": {c.name: c.unit for c in mechanism.coordinates},
        "units": {i.name: i.unit for i in mechanism.inputs},
        "memory": memory_to(controller.memory),
        "recipe": None if recipe is None else recipe.as_dict(),
        "period": controller.period,
        "versions": build(),
        **more,
    }


@lru_cache(maxsize=1)
def build() -> dict[str, str | None]:
    """Return what shapes the bits of a run: versions, processor, a hash of our own sources."""
    return {**versions(), **processor(), "sources": sources_digest()[:12]}


@checked
def replay(
    path: str | Path,
    *,
    mechanism: str | Mechanism | None = None,
    estimator: MakeEstimator | None = None,
    decisions: bool = True,
) -> Replay:
    """Replay a log that carries its recipe.

    Parameters
    ----------
    path
        The log.
    mechanism
        A mechanism of one's own, ``FILE.py:NAME`` or itself, whose run it is.  The file that
        the log names is not run: say which one is.
    estimator
        Where the run had an estimator of one's own: what made it, as for :func:`undertow.run`.
    decisions
        Also let the gate judge each recorded answer again.

    Raises
    ------
    ArtefactError
        When the file is no log, is damaged, has no recipe, or is of another mechanism; when it
        is of a mechanism in a file, and none is named; when it is of a run with an estimator of
        one's own, and none is given, or the other way round.
    """
    recording = read_log(Path(path))
    recipe, remarks = recorded_recipe(recording, mechanism, estimator)
    with legible(recording.path):
        memory = memory_from(recording.meta["memory"], recipe.reference)
        controller = recipe.make_controller(memory)
    found = replay_controller(recording, controller, decisions=decisions)
    return replace(found, remarks=(*remarks, *found.remarks))


def recorded_recipe(
    recording: Recording,
    mechanism: str | Mechanism | None = None,
    estimator: MakeEstimator | None = None,
) -> tuple[Recipe, tuple[str, ...]]:
    """Return the recipe that a log carries, and what else is to be known of it, in sentences.

    Raises ArtefactError as for :func:`replay`.
    """
    path = recording.path
    if isinstance(mechanism, str):
        named(mechanism)  # what is wrong with it is not the log's
    with legible(path):
        values = recording.meta.get("recipe")
        if values is None:
            raise ArtefactError(
                f"log '{path}'",
                value="no recipe: the controller was built in Python",
                remedy="Build it again, and call undertow.runtime.replay_controller",
            )
        if bool(values.get("own_estimator")) != (estimator is not None):
            raise ArtefactError(
                f"log '{path}'",
                value="a run with the library's estimator"
                if estimator is not None
                else "a run with an estimator of somebody's own",
                limit="the estimator of the run",
                remedy="Leave estimator out"
                if estimator is not None
                else "Give what made it, in Python: replay(path, estimator=...)",
            )
        remarks: tuple[str, ...] = ()
        if in_a_file(str(values["mechanism"])) or mechanism is not None:
            remarks = _compare_source(recording, mechanism)
        if isinstance(mechanism, str):
            values = {**values, "mechanism": mechanism}
        recipe = replace(Recipe.from_dict(values), estimator=estimator)
        if isinstance(mechanism, Mechanism):
            recipe = replace(recipe, mechanism=mechanism)
        _check_mechanism(recording, recipe.belief)  # before anything is designed for it
        return recipe, remarks


@contextlib.contextmanager
def legible(path: Path) -> Iterator[None]:
    """Say of what cannot be made of a log's content that it is the log's."""
    try:
        yield
    except ArtefactError:
        raise
    except (
        UndertowError, LookupError, TypeError, ValueError, AttributeError, ArithmeticError,
        RecursionError, MemoryError,
    ) as error:  # fmt: skip
        raise ArtefactError(
            f"log '{path}'",
            value=error_text(error),
            limit="complete, with what a run of this version writes",
            remedy="It is damaged, or of another version: replay with the one that wrote it",
        ) from error


def _source_hash(name: str) -> str:
    """Return the hash of the file of ``FILE.py:NAME``."""
    return file_hash(Path(name.rpartition(":")[0]), "mechanism file")


def _compare_source(recording: Recording, mechanism: str | Mechanism | None) -> tuple[str, ...]:
    """Compare the file of a mechanism of one's own with the one of the run; say what differs."""
    written = str(recording.meta["recipe"]["mechanism"])
    if mechanism is None:
        raise ArtefactError(
            f"log '{recording.path}'",
            value=f"a run of a mechanism of somebody's own, {written}",
            limit="a mechanism that you name: what a log names is not run",
            remedy=f"Look into that file, and write --mechanism {written}",
        )
    if isinstance(mechanism, Mechanism) or not in_a_file(mechanism):
        return ()
    then, now = recording.meta.get("source"), _source_hash(mechanism)
    if then is None:
        return (f"the log has no hash of its mechanism's file: {mechanism} may be another",)
    if then != now:
        return (f"{mechanism} has changed since: its hash was {str(then)[:12]}, is {now[:12]}",)
    return ()


def _check_mechanism(recording: Recording, mechanism: Mechanism) -> None:
    """Refuse a log of other equations, numbers or columns."""
    meta, columns = recording.meta, Columns.of(mechanism).names
    if meta.get("fingerprint") != mechanism.fingerprint:
        raise ArtefactError(
            f"log '{recording.path}'",
            value=f"a run of {meta.get('mechanism')} with other equations or numbers",
            limit=f"the mechanism of the controller, {mechanism.name}",
            remedy="Replay with the version of the library, or of the file, that wrote it",
        )
    if recording.columns != columns:
        raise ArtefactError(
            f"log '{recording.path}'",
            value=f"columns {', '.join(recording.columns)[:200]}",
            limit=", ".join(columns),
            remedy="Replay with the version of the library that wrote it",
        )


def replay_controller(
    recording: Recording, controller: Controller, *, decisions: bool = True
) -> Replay:
    """Replay a log through a controller built as for the run, idle.

    Raises
    ------
    ArtefactError
        When the controller believes in another mechanism than the log, or the log is damaged.
    """
    _check_mechanism(recording, controller.cascade.mechanism)
    with legible(recording.path):
        return _replayed(recording, controller, decisions=decisions)


def _replayed(recording: Recording, controller: Controller, *, decisions: bool) -> Replay:
    mechanism = controller.cascade.mechanism
    answers: dict[int, list[Answer]] = defaultdict(list)
    for row in recording.answers:
        answers[row["k"]].append(answer_from(row, controller.reference))
    said: dict[tuple[int, str], str] = {(k, kind): text for k, _, kind, text in recording.events}
    columns = Columns.of(mechanism)
    velocities = columns.measures_velocities(recording.steps)
    outputs: list[FloatArray] = []
    differing, first, gap = 0, None, None
    judged = misjudged = 0
    for k, row in enumerate(recording.steps):
        if int(row[columns.k]) != k:
            gap = k
            break
        arrived = answers.get(k, [])
        command = Command[said.get((k, "command"), "NONE")]
        inputs = Inputs(
            float(row[columns.t]),
            columns.measurement(row, velocities=velocities),
            arrived[0] if arrived else None,
            command,
            said.get((k, "alarm"), ""),
            legs_from(said.get((k, TOLD), "[]")),
        )
        u = controller.step(inputs)
        outputs.append(u.copy())
        if decisions:
            for answer in arrived:
                judged += 1
                misjudged += not _same_decision(controller, answer)
        if not columns.agrees(row, controller):
            differing += 1
            first = k if first is None else first
    changed = _changes(recording.meta.get("versions", {}), build())
    u_all = np.array(outputs).reshape(len(outputs), mechanism.m)
    return Replay(recording, len(outputs), differing, first, judged, misjudged, gap, u_all, changed)


def _changes(then: Mapping[str, Any], now: Mapping[str, Any]) -> dict[str, tuple[object, object]]:
    """Return what is otherwise now; of the processor's features those that only one has."""
    changed = {name: (then.get(name), now[name]) for name in now if then.get(name) != now[name]}
    if "features" in changed and then.get("features") is not None:
        before, after = (set(str(side).split()) for side in changed["features"])
        changed["features"] = (
            " ".join(sorted(before - after)) or None,
            " ".join(sorted(after - before)) or None,
        )
    return changed


def _same_decision(controller: Controller, answer: Answer) -> bool:
    """Let the gate judge a recorded answer again, or look for what goes on with a swing-up."""
    cascade, swing_up = controller.cascade, controller.swing_up
    if answer.swing >= 0 and swing_up is not None:
        found = next_of_swing(cascade, swing_up, answer.before, answer.x, answer.swing)
        return found == (answer.proposal.surface, answer.gains)
    if answer.proposal.plan is None and answer.proposal.status not in ("failed", "infeasible"):
        return True  # what the optimiser said could not be written down
    if answer.jump:  # the first plan of a task is compared with none
        return np.array_equal(law_vectors_of(cascade, answer.memory), answer.law_vectors)
    _, admission, law_vectors = judge(cascade, answer.before, answer.proposal, answer.x, answer.use)
    cost = admission.cost == answer.admission.cost or (
        math.isnan(admission.cost) and math.isnan(answer.admission.cost)
    )
    return (
        admission.accepted == answer.admission.accepted
        and cost
        and np.array_equal(law_vectors, answer.law_vectors)
    )
