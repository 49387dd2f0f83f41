"""Power cuts, simulated: what a run's log is worth when only what was synced has reached the disk.

A run is recorded while it writes its log: every write, truncation, sync, and change of a name.  At
a random moment the power goes: of each file what was synced is there, of each 512-byte sector that
was written since, the old or the new content; names that no sync of the folder has made sure of
may be missing.  The log that is left must open, without a gap, and miss little.

``python tests/power_cuts.py --count 1000`` prints the summary.  Needs Linux and gcc.
"""

from __future__ import annotations

import argparse
import copy
import os
import random
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from undertow.base import ArtefactError
from undertow.models import FloatArray
from undertow.runtime.recording import Recording, read_log

HERE = Path(__file__).parent
SECTOR = 512

#: Longest time that may be missing, s.
LOST = 1.0

WRITE, TRUNCATE, SYNC, NAME, UNNAME, RENAME = range(1, 7)
NOTE = struct.Struct("dqqqq")

RUN = """
import sys
from pathlib import Path
from undertow.runtime import Recipe, Settings
from undertow.runtime.log import Log
from undertow.runtime.session import session

Log.__init__.__kwdefaults__["part_bytes"] = int(sys.argv[3])
patient = Settings(max_step_interval=5.0, sensor_timeout=5.0)
recipe = Recipe(evaluations=64, start=(0.0, 0.2, 0.0, 0.0), settings=patient)
with session(recipe, log=Path(sys.argv[1]), processes=1, lockstep=False) as runtime:
    print("ready", flush=True)
    runtime.run(float(sys.argv[2]))
"""


@dataclass(frozen=True)
class Note:
    """One thing that was done to a file."""

    t: float
    op: int
    file: int
    offset: int
    data: bytes


@dataclass
class Disk:
    """What has reached the disk, and what is on its way, by the numbers of files."""

    folder: Path
    safe: dict[int, bytearray] = field(default_factory=dict)
    pending: dict[int, list[Note]] = field(default_factory=dict)
    names: dict[str, int] = field(default_factory=dict)
    unsafe_names: list[Note] = field(default_factory=list)
    known: dict[str, int] = field(default_factory=dict)

    def take(self, note: Note) -> None:
        """Do what was done."""
        if note.op in (WRITE, TRUNCATE):
            self.pending.setdefault(note.file, []).append(note)
        elif note.op == SYNC and note.file == self.folder.stat().st_ino:
            for one in self.unsafe_names:
                _rename(self.names, one)
            self.unsafe_names.clear()
        elif note.op == SYNC:
            content = self.safe.setdefault(note.file, bytearray())
            for one in self.pending.pop(note.file, []):
                _apply(content, one, None, 1.0)
        else:
            self.unsafe_names.append(note)

    def cut(self, rng: random.Random, to: Path) -> None:
        """Write what a power cut leaves into another folder."""
        names = dict(self.names)
        for note in self.unsafe_names[: rng.randint(0, len(self.unsafe_names))]:
            _rename(names, note)
        share = rng.choice((0.0, 1.0, rng.random(), rng.random()))
        for name, file in names.items():
            if name.endswith("-shm"):  # in memory alone; anything may be left of an earlier one
                if rng.random() < 0.3:
                    (to / name).write_bytes(rng.randbytes(32768))
                continue
            content = copy.copy(self.safe.get(file, bytearray()))
            for note in self.pending.get(file, ()):
                _apply(content, note, rng, share)
            (to / name).write_bytes(content)


def _rename(names: dict[str, int], note: Note) -> None:
    paths = [Path(part.decode()).name for part in note.data.split(b"\0")[:-1]]
    if note.op == NAME:
        names[paths[0]] = note.file
    elif note.op == UNNAME:
        names.pop(paths[0], None)
    elif paths[0] in names:
        names[paths[1]] = names.pop(paths[0])


def _apply(content: bytearray, note: Note, rng: random.Random | None, share: float) -> None:
    """Do a write, sector by sector, or a truncation; each with a chance unless it is sure."""
    if note.op == TRUNCATE:
        if rng is None or rng.random() < share:
            del content[note.offset :]
            content.extend(bytes(note.offset - len(content)))
        return
    end = note.offset + len(note.data)
    at = note.offset
    while at < end:
        until = end if rng is None else min(end, (at // SECTOR + 1) * SECTOR)
        if rng is None or rng.random() < share:
            content.extend(bytes(max(0, until - len(content))))
            content[at:until] = note.data[at - note.offset : until - note.offset]
        at = until


def recorded(folder: Path, seconds: float, part_bytes: int) -> tuple[list[Note], Recording]:
    """Run the controller against the clock, and return what it wrote, and its whole log."""
    library, record, logs = folder / "power_cuts.so", folder / "record", folder / "logs"
    logs.mkdir()
    source = str(HERE / "power_cuts.c")
    command = ["gcc", "-O1", "-shared", "-fPIC", "-o", str(library), source, "-ldl", "-lpthread"]
    subprocess.run(command, check=True)
    paths = os.pathsep.join(filter(None, sys.path))
    here = {
        **os.environ, "LD_PRELOAD": str(library), "CUT_FOLDER": str(logs.resolve()),
        "CUT_RECORD": str(record), "PYTHONPATH": paths,
    }  # fmt: skip
    log = logs.resolve() / "run.db"
    words = [sys.executable, "-c", RUN, str(log), str(seconds), str(part_bytes)]
    subprocess.run(words, env=here, check=True, capture_output=True)
    return list(_notes(record.read_bytes())), read_log(log)


def _notes(content: bytes) -> Iterator[Note]:
    """Yield what was noted; a number that the system gives to another file becomes a new one."""
    at, fresh = 0, 1 << 62
    numbers: dict[int, int] = {}
    names: dict[str, int] = {}
    while at < len(content):
        t, op, inode, offset, length = NOTE.unpack_from(content, at)
        at += NOTE.size
        data = content[at : at + length]
        at += length
        paths = [Path(part.decode()).name for part in data.split(b"\0")[:-1]] if op >= NAME else []
        if op == NAME and names.get(paths[0]) != inode:
            numbers[inode] = fresh = fresh + 1
            names[paths[0]] = inode
        elif op == UNNAME:
            names.pop(paths[0], None)
        elif op == RENAME and paths[0] in names:
            names[paths[1]] = names.pop(paths[0])
        yield Note(t, op, numbers.get(inode, inode), offset, data)


@dataclass
class Summary:
    """What became of the logs."""

    cuts: int = 0
    opened: int = 0
    missing: list[float] = field(default_factory=list)
    failures: list[str] = field(default_factory=list)
    about: str = ""

    def __str__(self) -> str:
        lost = np.array(self.missing or [np.nan])
        return (
            f"{self.about}\n{self.opened} of {self.cuts} logs opened after a power cut\n"
            f"missing: {np.median(lost):.2f} s in the median, {lost.max():.2f} s at most "
            f"(limit {LOST:g} s); {len(self.failures)} failures"
        )


def power_cuts(
    count: int, *, seed: int = 0, seconds: float = 12.0, part_bytes: int = 1_500_000
) -> Summary:
    """Record a run, cut its power ``count`` times, and open what is left of its log each time."""
    rng, summary = random.Random(seed), Summary()
    with tempfile.TemporaryDirectory(prefix="cuts-") as name:
        folder = Path(name)
        notes, whole = recorded(folder, seconds, part_bytes)
        clock = whole["clock"]
        kinds = [note.op for note in notes]
        parts = len([p for p in (folder / "logs").iterdir() if p.is_file()])
        summary.about = (
            f"A run of {clock[-1] - clock[0]:.1f} s: {kinds.count(WRITE)} writes, "
            f"{kinds.count(SYNC)} syncs, {parts} files of the log"
        )
        disk, at = Disk(folder / "logs"), 0
        last = notes[-1].t
        for number, moment in enumerate(sorted(rng.uniform(clock[0], last) for _ in range(count))):
            while at < len(notes) and notes[at].t <= moment:
                disk.take(notes[at])
                at += 1
            with tempfile.TemporaryDirectory(dir=folder) as left:
                disk.cut(rng, Path(left))
                _judge(Path(left) / "run.db", clock, moment, number, summary)
    return summary


def _judge(log: Path, clock: FloatArray, moment: float, number: int, summary: Summary) -> None:
    summary.cuts += 1
    made = int(np.searchsorted(clock, moment, side="right"))
    try:
        left = read_log(log)
    except ArtefactError as error:
        summary.failures.append(f"#{number} at {moment - clock[0]:.3f} s: {error}")
        return
    summary.opened += 1
    rows = len(left.steps)
    missing = clock[made - 1] - (clock[rows - 1] if rows else clock[0])
    summary.missing.append(max(0.0, float(missing)))
    if not np.array_equal(left.steps[:, 0], np.arange(rows)) or (
        rows and not np.array_equal(left["clock"], clock[:rows])
    ):
        summary.failures.append(f"#{number}: steps are missing in between, or are others")
    if missing > LOST:
        summary.failures.append(f"#{number}: {missing:.2f} s are missing")


def main() -> int:
    """Cut the power from the command line; exit status 1 when a log failed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=12.0, help="length of the run")
    asked = parser.parse_args()
    began = time.perf_counter()
    summary = power_cuts(asked.count, seed=asked.seed, seconds=asked.seconds)
    print(summary)
    for failure in summary.failures[:20]:
        print(f"  {failure}")
    print(f"Took {time.perf_counter() - began:.0f} s, seed {asked.seed}.")
    return 1 if summary.failures else 0


if __name__ == "__main__":
    raise SystemExit(main())
