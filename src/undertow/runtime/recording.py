"""Logs of runs, read: whole once a run has ended or was killed, or as they grow.

To read a log is to read data: nothing in it is run, whoever wrote it.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import os
import re
import shutil
import sqlite3
import tempfile
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from undertow.base import ArtefactError, check_file, parse_json
from undertow.models import FloatArray
from undertow.runtime.log import ANSWERS, EVENTS, VERSION, Line, check_journal, log_error, part_path

#: Where a file of SQLite says how it is written: 2 while there is a write-ahead log.
WRITE_VERSION = 18

#: A log whose run has written no step for so long has ended, s: the run was killed.
SILENCE = 3.0

#: Largest value in a file that is read, bytes.
MAX_VALUE_BYTES = 1 << 26


@dataclass(frozen=True, eq=False)
class Recording:
    """A log that was read.

    Attributes
    ----------
    meta
        What the run was.
    columns
        Where each quantity stands.
    steps
        A row a step, (N, …); NaN where there was nothing.
    events
        (k, t, kind, text) each.
    answers
        What the slow loop said: column name to value.
    """

    path: Path
    meta: dict[str, Any]
    columns: tuple[str, ...]
    steps: FloatArray
    events: tuple[tuple[int, float, str, str], ...]
    answers: tuple[dict[str, Any], ...]

    def __getitem__(self, name: str) -> FloatArray:
        """Return one column of the steps."""
        return self.steps[:, self.columns.index(name)]


def read_log(path: str | Path) -> Recording:
    """Read a log, of a run that ended or was killed, with its further parts.

    Raises
    ------
    ArtefactError
        When it is no log, of a later version, damaged, or was killed before its first line.
    """
    path = Path(path)
    found = _read_part(path)
    if found.meta.get("part", 1) != 1:
        value = f"part {found.meta['part']} of a log"
        remedy = "Name that: the others are read with it"
        raise log_error(path, value, "its first part", remedy)
    steps, events, answers, part = [found.steps], [*found.events], [*found.answers], 2
    while (further := part_path(path, part)).exists() and further.stat().st_size:
        more = _read_part(further)
        if more.meta.get("run") != found.meta.get("run") or more.columns != found.columns:
            break  # of another run
        steps.append(more.steps)
        events += more.events
        answers += more.answers
        part += 1
    for further in _beyond(path, part):  # a part between is missing: its steps will be
        with contextlib.suppress(ArtefactError):
            more = _read_part(further)
            if more.meta.get("run") == found.meta.get("run") and more.columns == found.columns:
                steps.append(more.steps)
    return replace(found, steps=np.concatenate(steps), events=tuple(events), answers=tuple(answers))


def _read_part(path: Path) -> Recording:
    with _read_from(path) as (file, most):
        meta, columns = _heading(file, most)
        steps = _numbers(file, len(columns), most)
        events = _lines_of(file, "events", EVENTS, most)
        answers = _lines_of(file, "answers", ANSWERS, most)
    return Recording(path, meta, columns, steps, _said(events), answers)


@contextlib.contextmanager
def _read_from(path: Path) -> Iterator[tuple[sqlite3.Connection, int]]:
    """Open a log to be read; whatever is wrong with what is read is the log's."""
    try:
        with _opened(path) as (file, most):
            _check_tables(file)
            yield file, most
    except ArtefactError:
        raise
    except (sqlite3.Error, OSError, ValueError, TypeError, OverflowError, MemoryError) as error:
        value = str(error) or type(error).__name__
        limit = "a log of a run, whole and of this version"
        remedy = "A run that was killed before its first step leaves an empty file"
        raise log_error(path, value, limit, remedy) from error


def _heading(file: sqlite3.Connection, most: int) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Return what the run was, and the columns of its steps."""
    meta = {}
    for key, value in _rows(file, "SELECT key, value FROM meta", most):
        meta[str(key)] = parse_json(str(value), finite=False)
    return meta, tuple(row[1] for row in file.execute("PRAGMA table_xinfo(steps)"))


def _said(events: Iterable[dict[str, Any]]) -> tuple[tuple[int, float, str, str], ...]:
    return tuple((one["k"], one["t"], one["kind"], one["text"]) for one in events)


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[tuple[sqlite3.Connection, int]]:
    """Open a log to be read, and nothing but read; also say how many bytes it has."""
    size = check_file(path, "log", remedy="Name a log of a run")
    waiting = {}
    for end in ("-wal", "-journal"):
        beside = Path(f"{path}{end}")
        if os.path.lexists(beside):
            waiting[end] = check_file(beside, "log")
    writable = os.access(path.parent, os.W_OK)
    with contextlib.ExitStack() as stack:
        mode = "mode=ro"
        if waiting.get("-journal") or (waiting.get("-wal") and not writable):
            # SQLite puts the log together beside it: here beside a copy.
            path, mode = _copied(path, stack), "mode=rw"
        elif not writable:
            mode = "immutable=1"
        file = _connected(f"{path.absolute().as_uri()}?{mode}")
        with contextlib.closing(file):
            yield file, size + sum(waiting.values())


def _copied(path: Path, stack: contextlib.ExitStack) -> Path:
    """Copy a log, with what waits beside it, into a folder of one's own, for as long as it takes.

    A journal that names another one is refused: SQLite would remove the file of that name.
    """
    folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="undertow-")))
    for end in ("", "-wal", "-journal"):
        if os.path.lexists(f"{path}{end}"):
            shutil.copyfile(f"{path}{end}", folder / f"{path.name}{end}")
    check_journal(folder / path.name)
    return folder / path.name


def _beyond(path: Path, part: int) -> list[Path]:
    """Return the parts of a log whose numbers are greater, in their order."""
    beside: list[Path] = []
    with contextlib.suppress(OSError):  # a folder that may not be listed
        beside = list(path.parent.iterdir())
    ends = (one.name.removeprefix(f"{path.name}-") for one in beside)
    numbers = sorted(int(end) for end in ends if re.fullmatch(r"[1-9]\d{0,8}", end))
    return [part_path(path, number) for number in numbers if number > part]


class GrowingLog:
    """A log that a run still writes, read as it grows.

    Each look opens the file to be read alone, and closes it again: who writes it waits for nothing.

    ``path``: its first file.
    """

    def __init__(self, path: Path) -> None:
        self.path, self._part, self._next = path, 1, 0
        self._seen = {"events": 0, "answers": 0}
        self._heard = math.inf

    @property
    def over(self) -> bool:
        """Whether its run has closed it, or has written no step for :data:`SILENCE`.

        Raises
        ------
        ArtefactError
            When it is no file, or not any more.
        """
        path = part_path(self.path, self._part)
        check_file(path, "log", remedy="Name a log of a run")
        with path.open("rb") as file:
            file.seek(WRITE_VERSION)
            closed = file.read(1) != b"\x02" and not part_path(self.path, self._part + 1).exists()
        return closed or time.monotonic() > self._heard + SILENCE

    def news(self, every: int = 1, most: int = 1 << 20) -> Recording:
        """Return what is new since the last look.

        Parameters
        ----------
        every
            Of the steps those whose number is a multiple of it.
        most
            Of the steps those among the last so many of a file.

        Raises
        ------
        ArtefactError
            As :func:`read_log`.
        """
        found = self._look(every, most)
        while part_path(self.path, self._part + 1).exists():
            self._part, self._seen = self._part + 1, dict.fromkeys(self._seen, 0)
            more = self._look(every, most)
            found = replace(
                found, steps=np.concatenate([found.steps, more.steps]),
                events=found.events + more.events, answers=found.answers + more.answers,
            )  # fmt: skip
        if len(found.steps):
            self._heard = time.monotonic()
        return found

    def _look(self, every: int, most: int) -> Recording:
        path = part_path(self.path, self._part)
        with _read_from(path) as (file, size):
            meta, columns = _heading(file, size)
            (last,) = file.execute("SELECT max(k) FROM steps").fetchone()
            after = max(self._next, (last or 0) + 1 - most)
            which = f"WHERE k >= {after} AND k % {every:d} = 0"
            steps = _numbers(file, len(columns), size, which)
            self._next = max(self._next, (-1 if last is None else last) + 1)
            new = {}
            for table, names in (("events", EVENTS), ("answers", ANSWERS)):
                new[table] = _lines_of(file, table, names, size, self._seen[table])
                self._seen[table] += len(new[table])
        return Recording(path, meta, columns, steps, _said(new["events"]), new["answers"])


def _connected(place: str) -> sqlite3.Connection:
    file = sqlite3.connect(place, uri=True, isolation_level=None, timeout=1.0)
    try:
        for pragma in ("trusted_schema=OFF", "query_only=ON", "cell_size_check=ON", "mmap_size=0"):
            file.execute(f"PRAGMA {pragma}")
        file.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_VALUE_BYTES)
        (version,) = file.execute("PRAGMA user_version").fetchone()
        if version > VERSION:
            raise ArtefactError(
                "log of a later version of Undertow",
                value=f"layout {version}",
                limit=f"at most {VERSION}",
                remedy="Read it with the version that wrote it, which its table meta names",
            )
    except BaseException:
        file.close()
        raise
    return file


def _check_tables(file: sqlite3.Connection) -> None:
    """Refuse what a run does not write: views, triggers, tables that others make up."""
    kinds = {}
    for kind, name, text in file.execute("SELECT type, name, sql FROM sqlite_master"):
        plain = kind == "index" or (kind == "table" and str(text)[:13].upper() == "CREATE TABLE ")
        if not plain:
            raise ValueError(f"a {kind} '{name}' that no run writes")
        kinds[name] = kind
    for name in ("meta", "steps", "events", "answers"):
        if kinds.get(name) != "table":
            raise ValueError(f"no table '{name}'")
        if any(row[6] for row in file.execute(f"PRAGMA table_xinfo({name})")):
            raise ValueError(f"table '{name}' has columns that are computed")


def _rows(file: sqlite3.Connection, query: str, most: int) -> Iterator[Line]:
    """Yield rows; more than there are bytes are of a file that leads in circles."""
    for number, row in enumerate(file.execute(query)):
        if number > most:
            raise ValueError("more rows than bytes")
        yield row


def _numbers(file: sqlite3.Connection, width: int, most: int, which: str = "") -> FloatArray:
    """Return the steps, (N, width), or some of them; what is missing is NaN."""
    rows, blocks = _rows(file, f"SELECT * FROM steps {which} ORDER BY k", most), []
    while block := list(itertools.islice(rows, 4096)):
        blocks.append(np.array(block, dtype=float).reshape(len(block), width))
    return np.concatenate(blocks) if blocks else np.empty((0, width))


def _lines_of(
    file: sqlite3.Connection, table: str, names: Iterable[str], most: int, after: int = 0
) -> tuple[dict[str, Any], ...]:
    """Return the rows of a table with their names, in the order in which they were written.

    Those ``after`` so many of them: each row that is written gets the next number.
    """
    names = tuple(names)
    which = f"WHERE rowid > {after}" if after else ""
    query = f"SELECT {', '.join(names)} FROM {table} {which} ORDER BY rowid"
    return tuple(dict(zip(names, row, strict=True)) for row in _rows(file, query, most))
