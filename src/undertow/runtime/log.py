"""The log of a run: one SQLite file, written beside the loop, readable after a kill.

The fast loop copies a row of numbers into a ring in memory; a thread empties the ring into
the file every 25 ms, one transaction each time.  SQLite's write-ahead log makes a killed
run readable up to its last transaction by whatever opens the file.  Until the end of the
run nothing waits for the disk: checkpoints are made when the log is closed.

Tables: ``meta`` (key, JSON), ``steps`` (a row a step), ``events`` (what happened, with the
step), ``answers`` (what the slow loop said, with the step that it arrived in).
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import sqlite3
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from undertow.errors import ArtefactError
from undertow.mechanism import FloatArray, Mechanism

__all__ = ["Columns", "Log", "Recording", "check_log", "read_log"]

#: Columns of ``answers``, with their types.
ANSWERS = {
    "k": "INTEGER", "sequence": "INTEGER", "use": "REAL", "accepted": "INTEGER", "reason": "TEXT",
    "status": "TEXT", "cost": "REAL", "incumbent_cost": "REAL", "predicted": "REAL",
    "evaluations": "INTEGER", "seconds": "REAL", "body": "TEXT",
}  # fmt: skip

#: Rows that wait in memory at most.
RING = 8192

#: Time between transactions, s; and rows, where no thread writes.
FLUSH, BATCH = 0.025, 250


#: Values of one line of a table.
Line = tuple[object, ...]


@dataclass(frozen=True)
class Columns:
    """Where each quantity stands in a row of ``steps``.

    Every name of a coordinate, state or input of the mechanism gives a column.
    """

    names: tuple[str, ...]
    q: slice
    v: slice
    x: slice
    s: slice
    demand: slice
    u: slice

    @classmethod
    def of(cls, mechanism: Mechanism) -> Self:
        """Return the columns for a mechanism."""
        names = ["k", "t", "clock", "mode", "surface", "rig_t"]
        places = {}
        states = mechanism.state_names
        inputs = [i.name for i in mechanism.inputs]
        n = mechanism.n
        for key, group in (
            ("q", [f"{name}_measured" for name in states[:n]]),
            ("v", [f"{name}_measured" for name in states[n:]]),
            ("x", list(states)),
            ("s", [f"s_{i}" for i in range(mechanism.m)]),
            ("demand", [f"{name}_demand" for name in inputs]),
            ("u", inputs),
        ):
            places[key] = slice(len(names), len(names) + len(group))
            names += group
        names += ["margin", "late_us", "read_us", "step_us", "write_us"]
        return cls(tuple(names), **places)


class Log:
    """A log that is being written.

    Parameters
    ----------
    path
        The file; an earlier one of that name is moved to ``<name>.1``, ``.2``, …
    columns
        Columns of ``steps``.
    meta
        What the run was: JSON values.
    threaded
        Write in a thread, every 25 ms.  Otherwise write every 250 rows, for simulated time.
    most_bytes
        Size that the file may grow to; the log ends there, and the run goes on.

    Attributes
    ----------
    failure
        Why the file cannot be written any more; empty while it can.
    dropped
        Rows that were lost because the file could not be written, or not fast enough.

    Raises
    ------
    ArtefactError
        When the file cannot be made, or is in use, or is no log: then it is left alone.
    """

    def __init__(
        self,
        path: Path,
        columns: Columns,
        meta: Mapping[str, Any],
        *,
        threaded: bool = True,
        most_bytes: int | None = None,
    ) -> None:
        self.path, self.columns = path, columns
        self.failure, self.dropped = "", 0
        self.row = np.zeros(len(columns.names))
        self._ring = np.zeros((RING, len(columns.names)))
        self._head = self._tail = 0
        self._waiting: deque[tuple[str, Callable[[], Line]]] = deque()
        self._insert = f"INSERT INTO steps VALUES ({', '.join('?' * len(columns.names))})"
        self._over = threading.Event()
        self._lock = threading.Lock()
        check_log(path)
        with _refused(path):
            _move_earlier(path)
            self._file = self._make(meta)
            if most_bytes is not None:
                (page,) = self._file.execute("PRAGMA page_size").fetchone()
                self._file.execute(f"PRAGMA max_page_count={max(1, most_bytes // page)}")
        self._thread: threading.Thread | None = None
        if threaded:
            self._thread = threading.Thread(target=self._write, name="undertow log", daemon=True)
            self._thread.start()

    def _make(self, meta: Mapping[str, Any]) -> sqlite3.Connection:
        file = sqlite3.connect(self.path, isolation_level=None, check_same_thread=False)
        for pragma in ("journal_mode=WAL", "synchronous=NORMAL", "wal_autocheckpoint=0"):
            file.execute(f"PRAGMA {pragma}")
        whole = {"k": "INTEGER PRIMARY KEY", "mode": "INTEGER", "surface": "INTEGER"}
        steps = ", ".join(f'"{name}" {whole.get(name, "REAL")}' for name in self.columns.names)
        answers = ", ".join(f"{name} {kind}" for name, kind in ANSWERS.items())
        file.execute("BEGIN")
        file.execute("CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT)")
        file.execute(f"CREATE TABLE steps ({steps})")
        file.execute("CREATE TABLE events (k INTEGER, t REAL, kind TEXT, text TEXT)")
        file.execute(f"CREATE TABLE answers ({answers})")
        file.executemany(
            "INSERT INTO meta VALUES (?, ?)",
            [(key, json.dumps(value, ensure_ascii=False)) for key, value in meta.items()],
        )
        file.execute("COMMIT")
        return file

    # -- called by the fast loop -----------------------------------------------------------

    def commit_row(self) -> None:
        """Keep a copy of :attr:`row`; never waits."""
        if self._head - self._tail >= RING:
            self.dropped += 1
            return
        self._ring[self._head % RING] = self.row
        self._head += 1
        if self._thread is None and self._head - self._tail >= BATCH:
            self.flush()

    def event(self, k: int, t: float, kind: str, text: str) -> None:
        """Keep a line of ``events``."""
        self._waiting.append(("events", lambda: (k, t, kind, _writable(text))))

    def answer(self, line: Callable[[], Line]) -> None:
        """Keep a line of ``answers``; it is made when it is written, away from the loop."""
        self._waiting.append(("answers", line))

    # -- called by the thread --------------------------------------------------------------

    def _write(self) -> None:
        while not self._over.wait(FLUSH):
            self.flush()

    def flush(self) -> None:
        """Write what waits, in one transaction; a disk that refuses ends the log, not the run."""
        with self._lock:
            head, count = self._head, self._head - self._tail
            waiting = self._lines()
            if not count and not waiting:
                return
            if self.failure:
                self.dropped += count
            else:
                try:
                    self._transact(head, waiting)
                except Exception as error:  # the thread must live, or the ring overflows unseen
                    self.failure = str(error)
                    self.dropped += count
                    with contextlib.suppress(sqlite3.Error):
                        self._file.execute("ROLLBACK")
            self._tail = head

    def _lines(self) -> list[tuple[str, Line]]:
        """Make the lines that wait; one that cannot be written is counted and left out."""
        made = []
        for _ in range(len(self._waiting)):
            table, line = self._waiting.popleft()
            try:
                made.append((table, line()))
            except Exception:  # what an optimiser says may be anything
                self.dropped += 1
        return made

    def _transact(self, head: int, waiting: Sequence[tuple[str, Line]]) -> None:
        places = np.arange(self._tail, head) % RING
        self._file.execute("BEGIN")
        self._file.executemany(self._insert, self._ring[places].tolist())
        for table, values in waiting:
            marks = ", ".join("?" * len(values))
            self._file.execute(f"INSERT INTO {table} VALUES ({marks})", values)
        self._file.execute("COMMIT")

    def close(self) -> None:
        """Write the rest, and leave one file behind."""
        self._over.set()
        if self._thread is not None:
            self._thread.join(timeout=5.0)
        self.flush()
        with contextlib.suppress(sqlite3.Error):
            self._file.execute("PRAGMA wal_checkpoint(TRUNCATE)")
            self._file.execute("PRAGMA journal_mode=DELETE")
        self._file.close()
        if not self.path.exists():
            self.failure, self.dropped = "the file was removed during the run", self._head

    def __enter__(self) -> Self:
        """Return the log."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close the log."""
        self.close()


def _writable(text: str) -> str:
    """Return a text as a file can hold it: what a rig says of itself may be anything."""
    return text.encode("utf-8", "replace").decode()


@contextlib.contextmanager
def _refused(path: Path) -> Iterator[None]:
    """Say of what the system refuses which log it was for."""
    try:
        yield
    except (OSError, sqlite3.Error) as error:
        raise ArtefactError(
            f"log '{path}'",
            value=str(error),
            limit="a file that can be written",
            remedy="Name another one with --log",
        ) from error


def check_log(path: Path) -> None:
    """Make the folder of a log, and see that no other run and no other file is in its way.

    Raises
    ------
    ArtefactError
        When the log could not be made.
    """
    with _refused(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        if not os.access(path.parent, os.W_OK):
            message = "its folder cannot be written"
            raise PermissionError(message)
        if path.exists():
            _claim(path)


def _claim(path: Path) -> None:
    """See that an earlier log is nobody's any more: two runs would write to one's files."""
    message = "something else of that name, not a log"
    if not path.is_file():
        raise FileExistsError(message)
    with contextlib.closing(sqlite3.connect(path, timeout=0.0)) as file:
        try:
            file.execute("PRAGMA journal_mode=DELETE")  # one file, and nobody else has it open
        except sqlite3.OperationalError as error:
            message = f"a log that a run still writes, or a program has open ({error})"
            raise FileExistsError(message) from error
        except sqlite3.DatabaseError as error:
            raise FileExistsError(message) from error


def _move_earlier(path: Path) -> None:
    """Keep an earlier log of the same name."""
    if not path.exists():
        return
    number = 1
    while Path(f"{path}.{number}").exists():
        number += 1
    path.rename(f"{path}.{number}")


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


def read_log(path: Path) -> Recording:
    """Read a log, of a run that ended or was killed.

    Raises
    ------
    ArtefactError
        When it is no log, or was killed before its first line.
    """
    if not path.is_file():
        raise ArtefactError(f"log '{path}'", value="no such file", remedy="Name a log of a run")
    try:
        with contextlib.closing(sqlite3.connect(path)) as file:
            meta = {k: json.loads(v) for k, v in file.execute("SELECT key, value FROM meta")}
            cursor = file.execute("SELECT * FROM steps ORDER BY k")
            columns = tuple(item[0] for item in cursor.description)
            rows = [[math.nan if v is None else v for v in row] for row in cursor]
            events = tuple(file.execute("SELECT * FROM events ORDER BY rowid"))
            names = ", ".join(ANSWERS)
            answers = tuple(
                dict(zip(ANSWERS, row, strict=True))
                for row in file.execute(f"SELECT {names} FROM answers ORDER BY rowid")
            )
    except sqlite3.Error as error:
        raise ArtefactError(
            f"log '{path}'",
            value=str(error),
            limit="a log of a run",
            remedy="A run that was killed before its first step leaves an empty file",
        ) from error
    steps = np.array(rows, dtype=float).reshape(len(rows), len(columns))
    return Recording(path, meta, columns, steps, events, answers)
