"""The log of a run: one SQLite file, written beside the loop, readable after a kill.

The fast loop copies a row of numbers into a ring in memory; a thread empties the ring into
the file every 25 ms, one transaction each time.  SQLite's write-ahead log makes a killed
run readable up to its last transaction by whatever opens the file.  Every half second the
thread also has the disk take what was written, and moves it from the write-ahead log into
the file: that is what a power cut costs, and the write-ahead log stays small.  A log that has
grown large goes on in another file, ``run.db-2``, ``run.db-3``, …, which are read as one.

Tables: ``meta`` (key, JSON), ``steps`` (a row a step), ``events`` (what happened, with the
step), ``answers`` (what the slow loop said, with the step that it arrived in).
:mod:`undertow.runtime.recording` reads them.
"""

from __future__ import annotations

import contextlib
import errno
import itertools
import json
import os
import shutil
import sqlite3
import tempfile
import threading
import time
import uuid
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np

from undertow.base import ArtefactError, ResourceError
from undertow.runtime.encoding import Columns, sql_type
from undertow.runtime.processes import Background

#: Columns of ``answers``, with their types.
ANSWERS = {
    "k": "INTEGER", "sequence": "INTEGER", "use": "REAL", "accepted": "INTEGER", "reason": "TEXT",
    "status": "TEXT", "cost": "REAL", "incumbent_cost": "REAL", "predicted": "REAL",
    "evaluations": "INTEGER", "seconds": "REAL", "body": "TEXT",
}  # fmt: skip

#: Columns of ``events``.
EVENTS = ("k", "t", "kind", "text")

#: Layout of the file, SQLite's ``user_version``; logs of before it was kept have 0; those of
#: before Undertow 0.2.0, with other names of settings, at most 2.
VERSION = 3

#: Rows that wait in memory at most.
RING_ROWS = 8192

#: Time between transactions, s; and rows, where no thread writes.
FLUSH_INTERVAL, BATCH_ROWS = 0.025, 250

#: Time from what was written to when the disk is asked to take it, s.
SYNC_INTERVAL = 0.5

#: Size at which a log goes on in another file, bytes: about an hour at 1 kHz.
PART_BYTES = 1 << 30

#: How long a disk may take over the last rows, s.
CLOSE_TIMEOUT = 5.0

#: How long the end of a log waits for who looks at it, s.
LOOKED_AT = 0.3

#: Free space without which no log is begun, bytes.
MIN_FREE_SPACE = 1 << 24

#: What is in the way of a log.
NO_LOG = "something else of that name, not a log"

#: What ends a journal of SQLite that belongs to another one.
JOURNAL = bytes.fromhex("d9d505f920a163d7")


#: Values of one line of a table.
Line = tuple[object, ...]


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
    max_bytes
        Size that the file may grow to; the log ends there, and the run goes on.
    part_bytes
        Size at which the log goes on in another file, :func:`part_path`.

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
    ResourceError
        When the system has no thread for it.
    """

    def __init__(
        self,
        path: Path,
        columns: Columns,
        meta: Mapping[str, Any],
        *,
        threaded: bool = True,
        max_bytes: int | None = None,
        part_bytes: int = PART_BYTES,
    ) -> None:
        self.path, self.columns = path, columns
        self.failure, self.dropped = "", 0
        self.row = np.zeros(len(columns.names))
        self._ring = np.zeros((RING_ROWS, len(columns.names)))
        self._head = self._tail = 0
        self._waiting: deque[tuple[str, Callable[[], Line]]] = deque()
        self._insert = f"INSERT INTO steps VALUES ({', '.join('?' * len(columns.names))})"
        self._over = threading.Event()
        self._lock = threading.Lock()
        self._meta = {**meta, "run": uuid.uuid4().hex}
        self._part, self._part_bytes, self._most_bytes = 1, part_bytes, max_bytes
        self._unsynced, self._synced = False, time.monotonic()
        check_log(path)
        with _refused(path):
            #: Where an earlier log of the same name is now.
            self.earlier = _move_earlier(path)
            self._file = self._make(1)
        self._thread: Background | None = None
        if threaded:
            try:
                self._thread = Background(self._write, "undertow log")
            except ResourceError:
                _end(self._file)
                raise

    def _make(self, part: int) -> sqlite3.Connection:
        """Begin a file; it is whole, and on the disk, before it has its name."""
        path = part_path(self.path, part)
        if part > 1 and os.path.lexists(path):
            _claim(path)
            _move_earlier(path)
        for companion in ("-wal", "-shm", "-journal"):  # of a log that was removed, or anybody's
            Path(f"{path}{companion}").unlink(missing_ok=True)
        os.close(os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600))  # nobody else's
        draft = path
        try:
            handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")  # 0600
            os.close(handle)
            draft = Path(name)
            with contextlib.closing(sqlite3.connect(draft, isolation_level=None)) as file:
                self._lay_tables(file, {**self._meta, "part": part})
            os.replace(draft, path)
            _sync_folder(path.parent)
            file = sqlite3.connect(path, isolation_level=None, check_same_thread=False)
        except BaseException:
            for rest in {draft, path}:
                rest.unlink(missing_ok=True)
            raise
        for pragma in (
            "synchronous=NORMAL", "wal_autocheckpoint=0", "checkpoint_fullfsync=ON",
        ):  # fmt: skip
            file.execute(f"PRAGMA {pragma}")
        if self._most_bytes is not None:
            (page,) = file.execute("PRAGMA page_size").fetchone()
            file.execute(f"PRAGMA max_page_count={max(1, self._most_bytes // page)}")
        return file

    def _lay_tables(self, file: sqlite3.Connection, meta: Mapping[str, Any]) -> None:
        steps = ", ".join(f'"{name}" {sql_type(name)}' for name in self.columns.names)
        answers = ", ".join(f"{name} {kind}" for name, kind in ANSWERS.items())
        file.execute("PRAGMA synchronous=FULL")
        file.execute("BEGIN")
        file.execute(f"PRAGMA user_version={VERSION}")
        file.execute("CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT)")
        file.execute(f"CREATE TABLE steps ({steps})")
        file.execute("CREATE TABLE events (k INTEGER, t REAL, kind TEXT, text TEXT)")
        file.execute(f"CREATE TABLE answers ({answers})")
        file.executemany(
            "INSERT INTO meta VALUES (?, ?)",
            [(key, json.dumps(value, ensure_ascii=False)) for key, value in meta.items()],
        )
        file.execute("COMMIT")
        file.execute("PRAGMA journal_mode=WAL")

    # -- called by the fast loop -----------------------------------------------------------

    def commit_row(self) -> None:
        """Keep a copy of :attr:`row`; never waits."""
        if self._head - self._tail >= RING_ROWS:
            self.dropped += 1
            return
        self._ring[self._head % RING_ROWS] = self.row
        self._head += 1
        if self._thread is None and self._head - self._tail >= BATCH_ROWS:
            self.flush()

    def event(self, k: int, t: float, kind: str, text: str) -> None:
        """Keep a line of ``events``."""
        self._waiting.append(("events", lambda: (k, t, kind, _writable(text))))

    def answer(self, line: Callable[[], Line]) -> None:
        """Keep a line of ``answers``; it is made when it is written, away from the loop."""
        self._waiting.append(("answers", line))

    # -- called by the thread --------------------------------------------------------------

    def _write(self) -> None:
        while not self._over.wait(FLUSH_INTERVAL):
            self.flush()

    def flush(self) -> None:
        """Write what waits, in one transaction; a disk that refuses ends the log, not the run."""
        with self._lock:
            head, count = self._head, self._head - self._tail
            waiting = self._lines()
            if self.failure:
                self.dropped += count
            else:
                try:
                    if count or waiting:
                        self._transact(head, waiting)
                        self._tail, self._unsynced = head, True
                    self._keep_safe()
                except Exception as error:  # the thread must live, or the ring overflows unseen
                    self.failure = str(error) or type(error).__name__
                    self.dropped += head - self._tail
                    with contextlib.suppress(sqlite3.Error):
                        self._file.execute("ROLLBACK")
            self._tail = head

    def _keep_safe(self) -> None:
        """Every half second: have the disk take what was written; go on in another file."""
        now = time.monotonic()
        if not self._unsynced or now < self._synced + SYNC_INTERVAL:
            return
        self._unsynced, self._synced = False, now
        path = part_path(self.path, self._part)
        _, written, moved = self._file.execute("PRAGMA wal_checkpoint(PASSIVE)").fetchone()
        if moved < written:  # who reads the log holds its end where it is, and off the disk
            _sync_file(Path(f"{path}-wal"))
        if _size(path) > self._part_bytes:
            more = self._make(self._part + 1)
            _end(self._file)
            self._file, self._part = more, self._part + 1

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
        places = np.arange(self._tail, head) % RING_ROWS
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
            self._thread.join(timeout=CLOSE_TIMEOUT)
            if self._thread.is_alive():  # to wait for its lock would be to hang with it
                self.failure = f"the disk has not answered for {CLOSE_TIMEOUT:g} s"
                self.dropped += self._head - self._tail
                return
        self.flush()
        _end(self._file)
        if not self.path.exists():
            self.failure, self.dropped = "the file was removed during the run", self._head

    def __enter__(self) -> Self:
        """Return the log."""
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def log_error(path: Path, value: str, limit: str | None, remedy: str) -> ArtefactError:
    """Return what is wrong with a log as an error."""
    return ArtefactError(f"log '{path}'", value=value, limit=limit, remedy=remedy)


def _writable(text: str) -> str:
    """Return a text as a file can hold it: what a rig says of itself may be anything."""
    return text.encode("utf-8", "replace").decode()


@contextlib.contextmanager
def _refused(path: Path) -> Iterator[None]:
    """Say of what the system refuses which log it was for."""
    try:
        yield
    except (OSError, sqlite3.Error, MemoryError) as error:
        value, remedy = str(error) or type(error).__name__, "Name another one with --log"
        raise log_error(path, value, "a file that can be written", remedy) from error


def check_log(path: Path) -> None:
    """Make the folder of a log, and see that no other run and no other file is in its way.

    Raises ArtefactError when the log could not be made.
    """
    with _refused(path):
        if "\0" in str(path):
            raise OSError(errno.EINVAL, "a zero byte in its name")
        path.parent.mkdir(parents=True, exist_ok=True)
        if not os.access(path.parent, os.W_OK):
            raise PermissionError("its folder cannot be written")
        disk = shutil.disk_usage(path.parent)
        if disk.total and disk.free < MIN_FREE_SPACE:
            raise OSError(
                errno.ENOSPC, f"less than {MIN_FREE_SPACE >> 20} MiB are free on its disk"
            )
        for earlier in parts_of(path):
            _claim(earlier)
            if not _is_log(earlier):
                raise FileExistsError(NO_LOG)


def part_path(path: Path, part: int) -> Path:
    """Return the path of a part of a log: ``run.db``, ``run.db-2``, ``run.db-3`` and so on."""
    return path if part == 1 else Path(f"{path}-{part}")


def parts_of(path: Path) -> list[Path]:
    """Return what there is of a log: its first file, and those that it goes on in."""
    further = itertools.takewhile(os.path.lexists, (part_path(path, n) for n in itertools.count(2)))
    return [*([path] if os.path.lexists(path) else []), *further]


def _size(path: Path) -> int:
    """Return the size of a log's file with what waits beside it, bytes."""
    beside = Path(f"{path}-wal")
    return path.stat().st_size + (beside.stat().st_size if beside.exists() else 0)


def _sync_file(path: Path) -> None:
    handle = os.open(path, os.O_RDWR)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _sync_folder(folder: Path) -> None:
    """Have the disk take the names in a folder, where the system can."""
    if not hasattr(os, "O_DIRECTORY"):
        return
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno != errno.EINVAL:  # some file systems keep names by themselves
            raise
    finally:
        os.close(handle)


def _end(file: sqlite3.Connection) -> None:
    """Close a log, leaving one file; what the disk refuses is left for whoever opens it next."""
    with contextlib.suppress(sqlite3.Error):
        file.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    until = time.monotonic() + LOOKED_AT
    while True:
        try:
            file.execute("PRAGMA journal_mode=DELETE")
            break
        except sqlite3.OperationalError as error:  # somebody may look at it: see GrowingLog
            if "locked" not in str(error) or time.monotonic() > until:
                break
            time.sleep(0.01)
        except sqlite3.Error:
            break
    with contextlib.suppress(sqlite3.Error):
        file.close()


def _claim(path: Path) -> None:
    """See that an earlier log is nobody's any more: two runs would write to one's files."""
    if not path.is_file():
        raise FileExistsError(NO_LOG)
    check_journal(path)
    with contextlib.closing(sqlite3.connect(path, timeout=0.0)) as file:
        try:
            file.execute("PRAGMA journal_mode=DELETE")  # one file, and nobody else has it open
        except sqlite3.OperationalError as error:
            message = f"a log that a run still writes, or a program has open ({error})"
            raise FileExistsError(message) from error
        except sqlite3.DatabaseError as error:
            raise FileExistsError(NO_LOG) from error


def _is_log(path: Path) -> bool:
    """Whether a file is a log, or the empty one that comes before it."""
    if not path.stat().st_size:
        return True
    with contextlib.closing(sqlite3.connect(path)) as file:  # of a few letters: empty
        return bool(file.execute("SELECT 1 FROM sqlite_master WHERE name = 'steps'").fetchone())


def check_journal(path: Path) -> None:
    """Refuse a journal beside a log that belongs to another one: SQLite would act on that."""
    journal = Path(f"{path}-journal")
    if journal.is_file() and journal.read_bytes()[-8:] == JOURNAL:
        raise FileExistsError("a journal that names another one, which no run writes")


def _move_earlier(path: Path) -> Path | None:
    """Keep an earlier log of the same name, with its parts; return where, if there is one."""
    earlier = parts_of(path)
    if not earlier:
        return None
    number = 1
    while parts_of(Path(f"{path}.{number}")):
        number += 1
    for one in earlier:
        one.rename(f"{path}.{number}{one.name.removeprefix(path.name)}")
    return Path(f"{path}.{number}")
