"""Every URDF and MJCF file of a folder: read, compared, balanced, or why not: `undertow models`."""

from __future__ import annotations

import os
import re
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import groupby
from pathlib import Path
from textwrap import shorten

from rich.console import RenderableType

from undertow.base import (
    ArtefactError,
    InvalidInputError,
    ModelError,
    UndertowError,
    markdown_table,
    table,
    to_csv,
)
from undertow.cascade import Cascade
from undertow.closed_loop import Event
from undertow.closed_loop.figures import state_words
from undertow.mechanisms.named import named
from undertow.models import Mechanism
from undertow.models.importers.formats import FORMATS, format_of
from undertow.models.importers.mujoco_compiler import agreement
from undertow.objective import objective_for
from undertow.runtime import default_gate
from undertow.studies.experiment import Experiment

#: Most files of a folder.
MOST = 20_000

#: Most joints of a file without motors of which the first is tried as driven.
_MOST_TRIED = 5

#: What a refusal is about.
_ABOUT = {ModelError: "mechanics", InvalidInputError: "the text", ArtefactError: "a missing file"}

#: Most files of a group that are named.
_SHOWN = 4

#: Columns of the table of files that are read.
HEADS = ("file", "n", "m", "target", "as MuJoCo to", "start", "arrives")

#: Columns of the table of those that are not.
REFUSED = ("files", "number", "refused for", "why")


@dataclass(frozen=True)
class ModelFile:
    """What became of one file.

    ``name``: its path in the folder, with the joints that were named as actuated where it names
    none. ``n``, ``m``: 0 where it was refused. ``target``: in the file's own coordinates.
    ``agreement``: largest difference of accelerations from MuJoCo's, relative; empty where not
    compared. ``end``, ``balanced``: how the motion ended, and whether it arrived within its travel;
    empty and None where none was asked for. ``refused``: what a refusal is about: ``mechanics``,
    ``no model``, ``the text``, ``a missing file``; else empty. ``why``: what was refused and what
    it should have been, or where a motion ended. ``seconds``: wall time, s.
    """

    name: str
    n: int = 0
    m: int = 0
    target: str = ""
    agreement: str = ""
    start: str = ""
    end: str = ""
    balanced: bool | None = None
    refused: str = ""
    why: str = ""
    seconds: float = 0.0


def model_files(
    folder: Path, *, simulate: bool = True, seed: int = 0
) -> Experiment[ModelFile, tuple[ModelFile, ...]]:
    """Return the experiment that reads every URDF and MJCF file below a folder.

    Links are not followed. ``simulate`` balances what can be as ``undertow simulate FILE`` does:
    for the usual objective, from the usual start; ``seed`` is the optimisers'. Raises ArtefactError
    where there is no such folder, or nothing in it, or too much.
    """
    if not folder.is_dir():
        raise ArtefactError(
            f"models in '{folder}'",
            value="a file" if folder.exists() else "no such folder",
            limit="a folder",
            remedy=f"One file: undertow simulate {folder}" if folder.exists() else "Check the path",
        )
    files = sorted(
        Path(place, name)
        for place, _, names in os.walk(folder)
        for name in names
        if Path(name).suffix.lower() in FORMATS
    )
    if not 0 < len(files) <= MOST:
        raise ArtefactError(
            f"models in '{folder}'",
            value=f"{len(files)} files",
            limit=f"1 to {MOST} files that end in {', '.join(FORMATS)}",
            remedy="Name the folder that they are in",
        )
    shorts = {str(file.relative_to(folder)): file for file in files}
    return Experiment(
        "models",
        tuple[str, ModelFile],
        {(short,): partial(_one, file, short, simulate, seed) for short, file in shorts.items()},
        {"simulate": simulate, "seed": seed, "files": [os.lstat(file).st_mtime for file in files]},
        lambda rows: [read_table(rows), refused_table(rows), summary(rows)],
        files_of,
    )


def _one(file: Path, short: str, simulate: bool, seed: int) -> ModelFile:
    began = time.perf_counter()
    row = ModelFile(short)
    try:
        name, mechanism = _read(file)
        row = replace(row, name=short + name[len(str(file)) :])
        row = _reading(row, mechanism)
        if simulate:
            row = _motion(row, mechanism, seed)
    except UndertowError as error:
        what = error.what.replace(f"model file '{file}'", "model file")  # the row names it
        none = what == "model file" and str(error.value).startswith("root")
        about = (
            "no model"
            if none
            else next(
                (word for kind, word in _ABOUT.items() if isinstance(error, kind)), "a motion"
            )
        )
        why = f"{what}: {error.value}" if error.value is not None else what
        row = replace(row, refused=about, why=" ".join(why.replace("|", "/").split()))
    return replace(row, seconds=time.perf_counter() - began)


def _read(file: Path) -> tuple[str, Mechanism]:
    """Return the mechanism of a file and its name; with its first joint driven, if it names none.

    URDF has no place for motors but in ``<transmission>``, which many files leave out.
    """
    try:
        return str(file), named(str(file))
    except ModelError as error:
        if "names no actuator" not in error.what or format_of(file).motors:
            raise
        joints = format_of(file).tree(file, False).moving
        if not 1 < len(joints) <= _MOST_TRIED:
            raise
        name = f"{file}:{joints[0].name}"
        with suppress(UndertowError):
            return name, named(name)
        raise


def _reading(row: ModelFile, mechanism: Mechanism) -> ModelFile:
    place = mechanism.description.rpartition("\ntarget ")[2]
    return replace(
        row,
        n=mechanism.n,
        m=mechanism.m,
        target=place.replace(" of the file", ""),
        agreement=agreement(mechanism),
        start=state_words(mechanism, mechanism.usual_start),
    )


def _motion(row: ModelFile, mechanism: Mechanism, seed: int) -> ModelFile:
    goal = objective_for(mechanism, horizon=60.0)
    try:
        cascade = Cascade(mechanism, goal, gate=default_gate(), seed=seed, belief="usual")
        motion = cascade.simulate().trajectory
    except UndertowError as error:
        return replace(row, balanced=False, end="no", why=str(error))
    balanced = motion.event == Event.REACHED
    end = f"{motion.time:.1f} s" if balanced else motion.event.name.lower()
    return replace(row, balanced=balanced, end=end)


def read_table(rows: Sequence[ModelFile]) -> RenderableType:
    """Return the files that were read, for the terminal."""
    return table(HEADS, map(_cells, _kept(rows)), left=("target", "start", "arrives"))


def _cells(row: ModelFile) -> tuple[str, ...]:
    counts = (str(row.n), str(row.m))
    return row.name, *counts, row.target, row.agreement or "—", row.start, row.end or "—"


def _kept(rows: Sequence[ModelFile]) -> list[ModelFile]:
    return [row for row in rows if not row.refused]


def refused_groups(rows: Sequence[ModelFile]) -> Iterator[tuple[str, str, str, int]]:
    """Gather the files below one folder that are refused alike.

    Yields the first files, what their refusal is about, the first one's reason, how many there are.
    """

    def alike(row: ModelFile) -> tuple[str, str, str]:
        return Path(row.name).parts[0], row.refused, _kind(row.why)

    refused = sorted((row for row in rows if row.refused), key=lambda row: (*alike(row), row.name))
    for (_, about, _), group in groupby(refused, alike):
        some = list(group)
        names = [row.name for row in some]
        more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
        why = shorten(some[0].why, 110, placeholder=" …")
        yield ", ".join(names[:_SHOWN]) + more, about, why, len(some)


def _kind(why: str) -> str:
    """A reason without what is quoted, named or counted in it."""
    return re.sub(r"'[^']*'|joint \S+:|joints .*|moments .*|[-\d.e]+", "", why)


def refused_table(rows: Sequence[ModelFile]) -> RenderableType:
    """Return the files that were refused, for the terminal, those refused alike in one row."""
    cells = ((names, str(count), about, why) for names, about, why, count in refused_groups(rows))
    return table(REFUSED, cells, left=("refused for", "why"))


def summary(rows: Sequence[ModelFile]) -> str:
    """Say how many were read, balanced and refused."""
    kept = _kept(rows)
    balanced = sum(row.balanced is True for row in kept)
    tried = f", {balanced} balanced" if any(row.balanced is not None for row in kept) else ""
    about = Counter(row.refused for row in rows if row.refused)
    refusals = ", ".join(f"{count} for {word}" for word, count in about.most_common())
    return f"{len(rows)} files: {len(kept)} read{tried}; refused {refusals or 'none'}"


def files_of(rows: Sequence[ModelFile]) -> dict[str, bytes]:
    """Return the tables as files: every row as CSV, and both tables as Markdown."""
    columns = (*HEADS, "balanced", "refused for", "why", "time (s)")
    data = [
        (*_cells(row), row.balanced, row.refused, row.why, round(row.seconds, 2)) for row in rows
    ]
    text = [summary(rows), "", *markdown_table(HEADS, map(_cells, _kept(rows)), ("n", "m")), ""]
    refused = ((names, count, about, why) for names, about, why, count in refused_groups(rows))
    text += [line.replace("<", "&lt;") for line in markdown_table(REFUSED, refused, ("number",))]
    return {"models.csv": to_csv(columns, data), "models.md": ("\n".join(text) + "\n").encode()}
