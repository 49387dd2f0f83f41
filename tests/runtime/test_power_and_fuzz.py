"""Seeded parts of two campaigns: power cuts, and mutated files; the whole ones are commands."""

from __future__ import annotations

import os
import random
import shutil
import sys
from pathlib import Path

import pytest

import fuzz_files
import power_cuts

ALARM = pytest.mark.skipif(
    sys.platform == "win32", reason="the alarm that ends what takes too long"
)


def cases(kind: str, count: int) -> None:
    summary = fuzz_files.fuzz(kind, count)
    assert summary.count == count
    assert summary.failures == []
    assert summary.read + sum(summary.refused.values()) > 0


@ALARM
@pytest.mark.parametrize("kind", ["manifest", "urdf", "mjcf", "ledger", "cache"])
def test_some_mutated_files_are_read_or_refused_and_run_nothing(kind: str) -> None:
    """``python tests/fuzz_files.py --count 10000`` makes all."""
    cases(kind, 10)


@ALARM
@pytest.mark.slow
@pytest.mark.parametrize("kind", sorted(fuzz_files.KINDS))
def test_mutated_files_are_read_or_refused_and_run_nothing(kind: str) -> None:
    cases(kind, 200)


@pytest.mark.parametrize(
    "crime",
    ["__import__('os').system('true')", "exec(compile('1', 'x.py', 'exec'))",
     "open('/tmp/undertow-fuzz-crime', 'a').close()", "__import__('canary_module')",
     "__import__('sympy').sympify('1 + 1')", "__import__('subprocess').run(['true'])",
     "__import__('pickle').loads(b'cos\\nsystem\\n.')"],
)  # fmt: skip
def test_the_watch_sees_what_a_file_would_do(tmp_path: Path, crime: str) -> None:
    """The fuzzer's proof that nothing is run is one: each of these is seen."""

    class Criminal:
        def make(self, _case: Path, _rng: object) -> object:
            return lambda: eval(crime)

    summary = fuzz_files.Summary("crime")
    fuzz_files.WATCH.sources, fuzz_files.WATCH.writable = (sys.prefix, sys.base_prefix), ()
    fuzz_files._one(Criminal(), tmp_path / "case", random.Random(0), summary)
    assert any(one.startswith("it did: ") for one in summary.failures), summary.failures
    Path("/tmp/undertow-fuzz-crime").unlink(missing_ok=True)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="LD_PRELOAD and /proc")
def test_a_power_cut_costs_a_second_at_most() -> None:
    """``python tests/power_cuts.py --count 1000`` cuts as often.  The log was written by a run
    that went on in further files, and was synced only where 09076aa did at its end."""
    if shutil.which("gcc") is None:
        pytest.skip("needs gcc")
    summary = power_cuts.power_cuts(120, seconds=5.0, part_bytes=700_000)
    assert summary.failures == []
    assert summary.opened == summary.cuts == 120
    assert max(summary.missing) <= power_cuts.LOST
    assert max(summary.missing) > 0.0  # or nothing was cut


def test_a_cut_leaves_of_unsynced_writes_any_sectors(tmp_path: Path) -> None:
    """And all of synced ones: the disk of the simulation against one worked out by hand."""
    folder = tmp_path / "logs"
    folder.mkdir()
    disk, inode = power_cuts.Disk(folder), os.stat(folder).st_ino
    note = power_cuts.Note
    disk.take(note(0.0, power_cuts.NAME, 7, 0, b"/x/run.db\0"))
    disk.take(note(0.0, power_cuts.WRITE, 7, 0, b"a" * 1024))
    disk.take(note(0.0, power_cuts.SYNC, 7, 0, b""))
    disk.take(note(0.0, power_cuts.SYNC, inode, 0, b""))
    disk.take(note(0.0, power_cuts.WRITE, 7, 0, b"b" * 1536))
    seen = set()
    for seed in range(200):
        left = tmp_path / str(seed)
        left.mkdir()
        disk.cut(random.Random(seed), left)
        content = (left / "run.db").read_bytes()
        assert len(content) in (1024, 1536)
        seen.add(bytes(content[i] for i in range(0, len(content), 512)))
    assert seen == {b"aa", b"ab", b"ba", b"bb", b"aab", b"abb", b"bab", b"bbb"}
