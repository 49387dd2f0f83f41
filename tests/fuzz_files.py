"""Mutated files of every kind that is read: each is read or refused, and runs nothing.

``python tests/fuzz_files.py --count 10000`` makes as many of each kind, ``--kind log`` of one kind
alone.  Every case has a seed of its own and comes out again with ``--seed N --first K --count 1``.
"""

from __future__ import annotations

import argparse
import copy
import faulthandler
import importlib
import json
import math
import os
import random
import shutil
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
import warnings
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any

import undertow as ut
from undertow.base import UndertowError, versions
from undertow.base.artefacts import to_json
from undertow.cascade import CascadeState
from undertow.law import Plan
from undertow.models import importers as modelling
from undertow.models import lagrange
from undertow.models.lagrange import derived
from undertow.runtime import (
    Columns,
    InlineWorker,
    Log,
    Recipe,
    Runtime,
    Settings,
    SimulatedClock,
    about,
    replay,
    respond,
)
from undertow.studies.ledger import Ledger
from undertow.studies.trials.trial import Result
from undertow.symbolic import store
from undertow.symbolic.private import private_folder

# What MuJoCo starts and loads when it is imported is no file's doing.
with suppress(ImportError):
    importlib.import_module("mujoco")

#: Longest time that a file may take, s; after the second the whole fuzzer is ended.
LIMIT, HANG = 10.0, 60.0

#: What a text in a file says to whoever would evaluate it.
MARK = "UNDERTOW_FUZZ_MARK"
PAYLOADS = (
    f"__import__('os').system('touch {MARK}')",
    f"exec(\"open('{MARK}', 'w')\")",
    f'"""\nopen("{MARK}", "w")\n"""',
    "canary_module.py:make",
    "/dev/zero",
    "../../../../etc/passwd",
    "'; DROP TABLE steps; --",
    "%s%n{0.__class__}",
    "\x1b]0;owned\x07",
    "nan",
    "μ",
    "𝔵",
    "",
    "a" * 5000,
)
NUMBERS = (
    None, True, False, 0, -1, 1, 2**31, 2**63, 10**30, 0.0, -0.0, 1e-320, 1e-300, 1e-9, 0.5, 1e9,
    1e300, -1e300, math.nan, math.inf, -math.inf, 12345678901,
)  # fmt: skip

Tree = Any


# -- what must not happen ----------------------------------------------------------------------


@dataclass
class Watch:
    """Hears of everything that Python's audit events tell, while a case is on."""

    on: bool = False
    folder: str = ""
    seen: list[str] = field(default_factory=list)

    #: Where code may come from, and what may be written.
    sources: tuple[str, ...] = ()
    writable: tuple[str, ...] = ()

    FORBIDDEN = (
        "os.system", "os.exec", "os.posix_spawn", "os.spawn", "os.fork", "os.forkpty", "os.kill",
        "subprocess.Popen", "pty.spawn", "socket.connect", "socket.bind", "socket.getaddrinfo",
        "urllib.Request", "ctypes.dlopen", "sqlite3.load_extension",
        "sqlite3.enable_load_extension",
        "webbrowser.open", "ftplib.connect", "smtplib.connect", "http.client.connect",
        "code.__new__", "builtins.breakpoint",
    )  # fmt: skip
    CHANGES = ("os.remove", "os.rename", "os.rmdir", "os.chmod", "os.chown", "os.truncate",
               "shutil.rmtree", "shutil.move", "os.symlink", "os.link")  # fmt: skip

    def __call__(self, event: str, args: tuple[Any, ...]) -> None:
        if not self.on:
            return
        self.on = False  # what is done here is heard too
        try:
            if (said := self._wrong(event, args)) is not None:
                self.seen.append(said)
        finally:
            self.on = True

    def _wrong(self, event: str, args: tuple[Any, ...]) -> str | None:
        if event in self.FORBIDDEN:
            return f"{event} {args!r}"[:200]
        if event == "exec":
            name = str(getattr(args[0], "co_filename", "?"))
            generated = name.startswith("<") and not _parsing()
            if not (generated or name.startswith(self.sources)):
                return f"code of {name}"
        elif event == "compile" and _parsing():
            return f"parsed {args[0]!r}"[:200]
        elif event == "import" and str(args[0]).startswith("canary"):
            return f"import {args[0]}"
        elif event == "pickle.find_class" and "numba" not in _callers():
            return f"pickle {args!r}"
        elif event == "open" and isinstance(args[0], str | bytes):
            written = isinstance(args[1], str) and set(args[1]) & set("wax+")
            flags = args[2] if isinstance(args[2], int) else 0
            if written or flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT):
                return self._outside(event, os.fsdecode(args[0]))
        elif event in self.CHANGES and isinstance(args[0], str | bytes | Path):
            within = args[-1] if isinstance(args[-1], int) and args[-1] >= 0 else None
            base = os.getcwd() if within is None else os.readlink(f"/proc/self/fd/{within}")
            return self._outside(event, os.path.join(base, os.fsdecode(args[0])))
        return None

    def _outside(self, event: str, path: str) -> str | None:
        full = os.path.abspath(path)
        return None if full.startswith(self.writable) else f"{event} {full}"


def _callers() -> str:
    """Return the files on the stack."""
    frame: FrameType | None = sys._getframe(2)
    names = []
    while frame is not None:
        names.append(frame.f_code.co_filename)
        frame = frame.f_back
    return " ".join(names)


def _parsing() -> bool:
    """Whether SymPy's parser, which evaluates text, is at work."""
    return "sympy_parser" in _callers()


WATCH = Watch()
sys.addaudithook(WATCH)


class TooLong(BaseException):
    """A case took longer than it may."""


@contextmanager
def limited(seconds: float) -> Iterator[None]:
    """End what takes too long; where that does not help, end everything with its stack.

    On a busy machine what counts is the time of the processor; to wait for three times as long
    is too long in any case.
    """
    began, worked = time.monotonic(), time.process_time()

    def late(_signal: int, _frame: FrameType | None) -> None:
        if time.process_time() - worked > 0.8 * seconds or time.monotonic() - began > 3 * seconds:
            raise TooLong
        signal.setitimer(signal.ITIMER_REAL, 0.1 * seconds)

    before = signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    faulthandler.dump_traceback_later(HANG, exit=True)
    try:
        yield
    finally:
        faulthandler.cancel_dump_traceback_later()
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


# -- mutations of values -----------------------------------------------------------------------


def nodes(tree: Tree, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the places of everything in a tree of lists and mappings."""
    yield path
    if isinstance(tree, dict | list):
        for key, value in tree.items() if isinstance(tree, dict) else enumerate(tree):
            yield from nodes(value, (*path, key))


def at(tree: Tree, path: tuple[Any, ...]) -> Tree:
    for key in path:
        tree = tree[key]
    return tree


def odd(rng: random.Random) -> Tree:
    """Return a value that is seldom meant."""
    pick = rng.random()
    if pick < 0.5:
        return rng.choice(NUMBERS)
    if pick < 0.7:
        return rng.choice(PAYLOADS)
    if pick < 0.75:
        return [rng.choice(NUMBERS)] * rng.choice((0, 1, 3, 1000))
    if pick < 0.8:
        return {rng.choice(PAYLOADS): rng.choice(NUMBERS)}
    if pick < 0.85:
        return f"RAW{'[' * 3000}{']' * 3000}WAR"
    if pick < 0.9:
        return f"RAW{'9' * rng.choice((30, 400, 5000))}WAR"
    if pick < 0.95:
        return "RAW1e999WAR"
    return [[[[]]]]


def mutated(tree: Tree, rng: random.Random) -> Tree:
    """Return a tree with one to three changes."""
    tree = copy.deepcopy(tree)
    for _ in range(rng.choice((1, 1, 2, 3))):
        places = list(nodes(tree))
        place = rng.choice(places)
        if not place:
            if rng.random() < 0.1:
                tree = odd(rng)
            continue
        parent, key = at(tree, place[:-1]), place[-1]
        value = parent[key]
        what = rng.randrange(8)
        if what == 0:
            del parent[key]
        elif what == 1 and isinstance(value, int | float) and not isinstance(value, bool):
            parent[key] = value * rng.choice((-1, 0, 0.5, 2, 10, 1e3, 1e-3, 1e12, 1e-12)) + 0
        elif what == 2 and isinstance(parent, dict):
            parent[rng.choice(PAYLOADS)] = parent.pop(key)
        elif what == 3:
            parent[key] = copy.deepcopy(at(tree, rng.choice(places)))
        elif what == 4 and isinstance(value, list):
            parent[key] = value * rng.choice((2, 3, 100))
        elif what == 5 and isinstance(value, int | float):
            parent[key] = str(value)
        elif what == 6 and isinstance(parent, dict):
            parent[f"{key}TWICE"] = odd(rng)  # becomes the same key again
        else:
            parent[key] = odd(rng)
    return tree


def written(tree: Tree) -> str:
    """Return JSON, with what JSON's writer would not write."""
    with suppress(ValueError, RecursionError):
        text = json.dumps(tree)
        return text.replace('"RAW', "").replace('WAR"', "").replace('TWICE"', '"')
    return "null"


def flipped(content: bytes, rng: random.Random) -> bytes:
    """Return bytes with some changed, cut out, repeated or moved."""
    data = bytearray(content)
    for _ in range(rng.choice((1, 1, 2, 8, 64))):
        if not data:
            break
        where, what = rng.randrange(len(data)), rng.randrange(5)
        if what == 0:
            data[where] ^= 1 << rng.randrange(8)
        elif what == 1:
            data[where] = rng.choice((0, 255, 34, 60, 91, 123, rng.randrange(256)))
        elif what == 2:
            del data[where : where + rng.choice((1, 4, 64, 4096))]
        elif what == 3:
            piece = data[where : where + rng.choice((1, 16, 512))]
            data[where:where] = piece * rng.choice((1, 2, 20))
        else:
            data[:] = data[:where] if rng.random() < 0.5 else data[where:] + data[:where]
    return bytes(data)


# -- logs --------------------------------------------------------------------------------------

MEMORY = CascadeState(Plan.of(ut.Surface(alpha_a=-1, lambda_a=-0.25, alpha_u=1.6, lambda_u=17.3)))


def make_log(path: Path, mechanism: str = "rotary_pendulum", **settings: Any) -> None:
    """Write the log of a short run."""
    quick = Settings(lead_time=0.04)
    start = (0.0, 0.2, 0.0, 0.0)
    recipe = Recipe(mechanism=mechanism, evaluations=16, start=start, settings=quick)
    controller = recipe.make_controller(MEMORY)
    worker = InlineWorker(lambda request: respond(recipe.cascade, request))
    columns = Columns.of(recipe.belief)
    with Log(path, columns, about(controller, recipe), threaded=False, **settings) as log:
        rig, clock = recipe.make_rig(), SimulatedClock()
        Runtime(controller, rig, worker, clock=clock, log=log).run(0.12)


def change_log(path: Path, rng: random.Random) -> None:
    """Change what an SQLite file holds, through SQLite.

    A second change may meet what the first has put there: a view without an end, values of 200 MB,
    lists in lists that no parser follows.  SQLite is told when to give up.
    """
    hopeless = (sqlite3.Error, LookupError, ValueError, RecursionError)
    left = iter(range(1000))
    with closing(sqlite3.connect(path, isolation_level=None)) as file, suppress(*hopeless):
        file.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, 80_000_000)
        file.set_progress_handler(lambda: next(left, None) is None, 10_000)
        for _ in range(rng.choice((1, 1, 2))):
            _change(file, rng)


def _change(file: sqlite3.Connection, rng: random.Random) -> None:
    table = rng.choice(("meta", "steps", "events", "answers", "answers", "meta"))
    columns = [row[1] for row in file.execute(f"PRAGMA table_info({table})")]
    count = file.execute(f"SELECT count(*) FROM {table}").fetchone()[0]
    column, row = rng.choice(columns or ["k"]), rng.randrange(max(1, count))
    what = rng.randrange(14)
    if what <= 3:
        key, value = rng.choice(file.execute("SELECT key, value FROM meta").fetchall())
        with suppress(ValueError):
            text = written(mutated(json.loads(value), rng))
            file.execute("UPDATE meta SET value = ? WHERE key = ?", (text, key))
    elif what <= 5:
        bodies = file.execute("SELECT rowid, body FROM answers").fetchall()
        number, body = rng.choice(bodies)
        text = written(mutated(json.loads(body), rng))
        file.execute("UPDATE answers SET body = ? WHERE rowid = ?", (text, number))
    elif what <= 7:
        value = rng.choice((*NUMBERS[:6], *NUMBERS[9:], *PAYLOADS, b"\x00\xff", b"1.5"))
        query = f'UPDATE {table} SET "{column}" = ? WHERE rowid = ?'
        if table == "steps" or rng.random() < 0.5:
            query = query.replace("rowid", "rowid % 7")
        file.execute(query, (value, row % 7 if "%" in query else row))
    elif what == 8:
        file.execute(f"DELETE FROM {table} WHERE rowid % {rng.choice((1, 2, 50))} = 0")
    elif what == 9:
        file.execute(f"PRAGMA user_version = {rng.choice((-1, 0, 4, 2**31 - 1))}")
    elif what == 10:
        file.execute(f'ALTER TABLE {table} RENAME COLUMN "{column}" TO "{rng.choice(PAYLOADS)}"')
    elif what == 11:
        size = rng.choice((10, 100_000, 100_000, 70_000_000)) if rng.random() < 0.3 else 10
        file.execute(f'UPDATE {table} SET "{column}" = zeroblob({size}) WHERE rowid = {row}')
    elif what == 12:
        file.execute(f"INSERT INTO {table} SELECT * FROM {table} WHERE rowid < 5")
    else:
        _make_up(file, table, rng)


def _make_up(file: sqlite3.Connection, table: str, rng: random.Random) -> None:
    """Put something in a table's place that SQLite would compute."""
    endless = "WITH RECURSIVE r(k) AS (SELECT 1 UNION ALL SELECT k + 1 FROM r) SELECT k FROM r"
    choice = rng.randrange(6)
    if choice == 0:
        file.execute(f"DROP TABLE {table}")
        file.execute(f"CREATE VIEW {table} AS {endless}")
    elif choice == 1:
        file.execute(f"CREATE VIEW other AS {endless}")
    elif choice == 2:
        file.execute(
            f"CREATE TRIGGER t AFTER INSERT ON {table} BEGIN SELECT load_extension('canary'); END"
        )
    elif choice == 3:
        file.execute(f"DROP TABLE {table}")
        file.execute(f"CREATE VIRTUAL TABLE {table} USING fts5(key, value, k, t, kind, text)")
    elif choice == 4:
        file.execute(f"ALTER TABLE {table} ADD COLUMN more AS (hex(zeroblob(100000000))) VIRTUAL")
    else:
        file.execute(f"DROP TABLE {table}")
        if rng.random() < 0.5:
            file.execute(f"CREATE TABLE {table} (k, value)")


class Logs:
    """Logs of a run: of the library, of a mechanism of somebody's own, in two parts."""

    def __init__(self, folder: Path) -> None:
        self.plain, self.own, self.long = (folder / f"{n}.db" for n in ("plain", "own", "long"))
        model = folder / "own_model.py"
        model.write_text("import undertow as ut\n\ndef make():\n    return ut.mechanisms.tora()\n")
        make_log(self.plain)
        make_log(self.own, f"{model}:make")
        shutil.copy(self.plain, self.long)
        shutil.copy(self.plain, f"{self.long}-2")
        for part in (1, 2):
            with closing(sqlite3.connect(self.long if part == 1 else f"{self.long}-2")) as file:
                file.execute("UPDATE meta SET value = ? WHERE key = 'part'", (str(part),))
                file.execute(f"DELETE FROM steps WHERE (k > 60) = {part == 1}")
                file.execute(f"DELETE FROM answers WHERE (k > 60) = {part == 1}")
                file.commit()
        model.write_text(f'open("{MARK}", "w")\nraise SystemExit("a file was run")\n')

    def make(self, case: Path, rng: random.Random) -> Callable[[], object]:
        sample = rng.choice((self.plain, self.plain, self.plain, self.own, self.long))
        target = case / "run.db"
        for end in ("", "-2"):
            if Path(f"{sample}{end}").exists():
                shutil.copy(f"{sample}{end}", f"{target}{end}")
        victim = Path(f"{target}{rng.choice(('', '-2'))}") if sample == self.long else target
        if rng.random() < 0.75:
            change_log(victim, rng)
        if rng.random() < 0.3:
            victim.write_bytes(flipped(victim.read_bytes(), rng))
        if rng.random() < 0.05:
            beside = Path(f"{target}{rng.choice(('-wal', '-shm', '-journal'))}")
            beside.write_bytes(flipped(victim.read_bytes()[:8192], rng))
        return lambda: replay(target)


# -- certificates ------------------------------------------------------------------------------


class Certificates:
    """Certificates with a claim of each kind; most of the mutated ones have a checksum again."""

    def __init__(self, _folder: Path) -> None:
        from undertow.proofs.claims.certificate import Certificate, Subject
        from undertow.proofs.claims.verify import verify
        from undertow.studies.certification import certify_surface

        rig, surface = ut.mechanisms.rotary_pendulum(), ut.Surface(-1, -1.59, 1.96, 12.1)
        one = certify_surface(rig, surface, rig.state(phi=0.5), seconds=0.0, predict=False)
        self.samples = []
        for claims in (one.subject.claims, *((claim,) for claim in one.subject.claims)):
            subject = Subject(surface, ut.ReachingLaw(), claims, ())
            content = Certificate.of(rig, [subject], {"undertow": "fuzz"}).to_bytes()
            self.samples.append(json.loads(content))
            verify(Certificate.from_bytes(content), rig)  # compiles what it needs

    def make(self, case: Path, rng: random.Random) -> Callable[[], object]:
        from undertow.mechanisms import LIBRARY
        from undertow.proofs.claims.certificate import read_certificate
        from undertow.proofs.claims.verify import verify
        from undertow.proofs.kernel.reader import digest

        document, target = mutated(rng.choice(self.samples), rng), case / "certificate.json"
        text = written(document)
        if rng.random() < 0.8:
            with suppress(Exception):
                signed = json.loads(text)
                signed["model_hash"] = digest(signed["model"])
                signed["checksum"] = digest({k: v for k, v in signed.items() if k != "checksum"})
                text = written(signed)
        content = text.encode("utf-8", "surrogatepass")
        target.write_bytes(flipped(content, rng) if rng.random() < 0.1 else content)

        def read() -> object:
            certificate = read_certificate(target)
            return verify(certificate, LIBRARY["rotary_pendulum"]())

        return read


# -- manifests and ledgers ---------------------------------------------------------------------

SETTINGS = {"angle": 0.5, "seconds": 10.0}
RESULT = {
    "seed": 4, "balanced": True, "caught": True, "settled": "inf", "cost": 2.5, "effort": 1.5,
    "chatter": 20.0,
}  # fmt: skip


def ledger(path: Path) -> Ledger[Result]:
    """Read one."""
    return Ledger(path, tuple[str, str, float, Result], SETTINGS)


class Ledgers:
    """Ledgers of trials."""

    def __init__(self, _folder: Path) -> None:
        self.lines: list[Tree] = [{"settings": SETTINGS, "versions": versions()}]
        self.lines += [["cascade", "delay", 0.25 * k, {**RESULT, "seed": k}] for k in range(4)]

    def make(self, case: Path, rng: random.Random) -> Callable[[], object]:
        lines = mutated(self.lines, rng)
        if not isinstance(lines, list):
            lines = [lines]
        content = "\n".join(map(written, lines)).encode("utf-8", "surrogatepass") + b"\n"
        target = case / "ledger.jsonl"
        target.write_bytes(flipped(content, rng) if rng.random() < 0.2 else content)
        return lambda: ledger(target)


class Manifests:
    """What ``--out`` writes beside results.  Nothing reads one: all readers are given it."""

    def __init__(self, _folder: Path) -> None:
        decision = {"t": 0.1, "accepted": True, "reason": "cheaper", "cost": 20.5}
        request = {"mechanism": "rotary_pendulum", "start": ["phi=35deg"], "seed": 0}
        facts = {"request": request, "versions": versions(), "decisions": [decision] * 3}
        self.sample = json.loads(to_json(facts))

    def make(self, case: Path, rng: random.Random) -> Callable[[], object]:
        from undertow.proofs.claims.certificate import read_certificate

        target = case / "manifest.json"
        content = written(mutated(self.sample, rng)).encode("utf-8", "surrogatepass")
        target.write_bytes(flipped(content, rng) if rng.random() < 0.3 else content)
        readers: tuple[Callable[[Path], object], ...] = (
            read_certificate, replay, ledger,
            modelling.from_urdf, modelling.from_mjcf,
        )  # fmt: skip
        reader = rng.choice(readers)
        return lambda: reader(target)


# -- models ------------------------------------------------------------------------------------

URDF = """
<robot name="cart_pendulum">
  <link name="rail"/>
  <link name="cart"><inertial><mass value="0.5"/><inertia ixx="1" iyy="1" izz="1"/></inertial></link>
  <link name="rod"><inertial><origin xyz="0 0 0.3" rpy="0 0 0"/><mass value="0.2"/>
    <inertia ixx="0.006" iyy="0.006" izz="0.001"/></inertial></link>
  <joint name="x" type="prismatic"><parent link="rail"/><child link="cart"/><axis xyz="1 0 0"/>
    <dynamics damping="0.1" friction="0.01"/><limit effort="20" lower="-1.5" upper="1.5"/></joint>
  <joint name="phi" type="continuous"><parent link="cart"/><child link="rod"/>
    <axis xyz="0 1 0"/><dynamics damping="0.001"/></joint>
  <transmission name="drive"><joint name="x"/><actuator name="motor"/></transmission>
</robot>
"""  # noqa: E501

MJCF = """
<mujoco model="cart_pendulum">
  <compiler angle="radian"/><option gravity="0 0 -9.8"/>
  <default><joint damping="0.1"/><default class="soft"><joint stiffness="0.1"/></default></default>
  <worldbody><body name="cart"><joint name="x" type="slide" axis="1 0 0" range="-1.5 1.5"/>
    <inertial mass="0.5" pos="0 0 0" diaginertia="1 1 1"/>
    <body name="rod" pos="0 0 0" euler="0 0 0"><joint name="phi" axis="0 1 0" class="soft"/>
      <geom type="capsule" size="0.01" fromto="0 0 0 0 0 0.6" mass="0.2"/></body></body></worldbody>
  <tendon><fixed name="t"><joint joint="x" coef="1"/></fixed></tendon>
  <actuator><motor name="force" joint="x" ctrlrange="-20 20" gear="1"/></actuator>
</mujoco>
"""


def change_xml(text: str, rng: random.Random) -> str:
    """Return XML with elements and attributes changed, moved, doubled, renamed or nested."""
    root = ET.fromstring(text)
    for _ in range(rng.choice((1, 1, 2, 3))):
        every = list(root.iter())
        element, what = rng.choice(every), rng.randrange(9)
        if what <= 3 and element.attrib:
            name = rng.choice(sorted(element.attrib))
            words = element.attrib[name].split() or [""]
            new = str(odd(rng)) if rng.random() < 0.7 else rng.choice(every).get(name, "world")
            if rng.random() < 0.6:
                words[rng.randrange(len(words))] = new
                new = " ".join(words)
            element.set(name, _of_xml(new))
        elif what == 4 and element.attrib:
            del element.attrib[rng.choice(sorted(element.attrib))]
        elif what == 5 and len(element):
            element.remove(rng.choice(list(element)))
        elif what == 6:
            with suppress(RecursionError):
                element.append(copy.deepcopy(rng.choice(every)))
        elif what == 7:
            element.tag = rng.choice((*(e.tag for e in every), "include", "mimic", "freejoint"))
        elif what == 8 and rng.random() < 0.3:
            inner = element
            for _ in range(rng.choice((10, 100, 3000))):
                inner = ET.SubElement(inner, element.tag, dict(element.attrib))
    try:
        text = ET.tostring(root, encoding="unicode")
    except RecursionError:
        text = "<mujoco>" * 4000 + "</mujoco>" * 4000
    if rng.random() < 0.03:
        text = f'<!DOCTYPE r [<!ENTITY a "{"x" * 100}"><!ENTITY b "{"&a;" * 100}">]>{text}'
    return text


def _of_xml(text: str) -> str:
    return "".join(c for c in text if c.isprintable() or c == "\n").replace("RAW", "")


class Models:
    """URDF or MJCF."""

    def __init__(self, text: str, reader: Callable[[Path], ut.Mechanism]) -> None:
        self.text, self.reader = text, reader

    def make(self, case: Path, rng: random.Random) -> Callable[[], object]:
        target = case / "model.xml"
        content = change_xml(self.text, rng).encode("utf-8", "surrogatepass")
        target.write_bytes(flipped(content, rng) if rng.random() < 0.15 else content)
        return lambda: self.reader(target).name


# -- caches ------------------------------------------------------------------------------------


class Caches:
    """What is kept of equations: whatever the file holds, the right ones come back."""

    def __init__(self, _folder: Path) -> None:
        import sympy as sp

        q, v = sp.symbols("q_0 q_1", real=True), sp.symbols("v_0 v_1", real=True)
        kinetic = (v[0] ** 2 + v[1] ** 2 + v[0] * v[1] * sp.cos(q[1])) / 2
        self.given = ("fuzz", q, v, kinetic, sp.cos(q[1]), v[0] ** 2 / 100)
        self.right = derived(*self.given)
        self.text = "\n".join(sp.srepr(part) for part in self.right)

    def make(self, _case: Path, rng: random.Random) -> Callable[[], object]:
        text = flipped(self.text.encode(), rng).decode("utf-8", "replace")
        if rng.random() < 0.7:
            words = self.text.replace("(", " ( ").split(" ")
            words[rng.randrange(len(words))] = rng.choice((*PAYLOADS, "sympify", "S", "Lambda"))
            text = "".join(words)
        before = store.recall

        def read() -> object:
            module = vars(lagrange)
            module["recall"] = lambda _name, _key: text
            try:
                assert derived(*self.given) == self.right or "(" in text
                return None
            finally:
                module["recall"] = before

        return read


KINDS: dict[str, Callable[[Path], Any]] = {
    "log": Logs,
    "certificate": Certificates,
    "manifest": Manifests,
    "urdf": lambda _: Models(URDF, modelling.from_urdf),
    "mjcf": lambda _: Models(MJCF, modelling.from_mjcf),
    "ledger": Ledgers,
    "cache": Caches,
}


# -- the run -----------------------------------------------------------------------------------


@dataclass
class Summary:
    """What became of the cases of one kind."""

    kind: str
    count: int = 0
    read: int = 0
    refused: Counter[str] = field(default_factory=Counter)
    failures: list[str] = field(default_factory=list)
    longest: float = 0.0
    slowest: int = 0
    seconds: float = 0.0

    def __str__(self) -> str:
        refusals = ", ".join(f"{n} {name}" for name, n in self.refused.most_common())
        return (
            f"{self.kind}: {self.count} files, {self.read} read, {refusals or 'none refused'}; "
            f"{len(self.failures)} failures; longest {self.longest:.2f} s (#{self.slowest}), "
            f"all {self.seconds:.0f} s"
        )


def fuzz(kind: str, count: int, seed: int = 0, first: int = 0) -> Summary:
    """Read ``count`` mutated files of a kind."""
    summary = Summary(kind)
    began = time.perf_counter()
    prefixes = (sys.prefix, sys.base_prefix, str(Path(ut.__file__).parent), str(private_folder()))
    before, temporary = os.getcwd(), tempfile.tempdir
    with tempfile.TemporaryDirectory(prefix="fuzz-") as name:
        folder = Path(name).resolve()
        os.chdir(folder)
        try:
            samples = KINDS[kind](folder)
            tempfile.tempdir = str(folder / "case")
            WATCH.sources = tuple(str(Path(p).resolve()) for p in prefixes) + prefixes
            WATCH.writable = (
                str(folder / "case"), str(private_folder()), str(Path(ut.__file__).parent),
                "/dev/null", os.path.abspath(os.devnull),
            )  # fmt: skip
            for number in range(first, first + count):
                before_it = summary.longest
                _one(samples, folder / "case", random.Random(f"{kind} {seed} {number}"), summary)
                if summary.longest > before_it:
                    summary.slowest = number
                if (folder / MARK).exists():
                    summary.failures.append("a file's text was run")
                    (folder / MARK).unlink()
                summary.failures = [
                    one if one.startswith("#") else f"#{number}: {one}" for one in summary.failures
                ]
        finally:
            os.chdir(before)
            tempfile.tempdir = temporary
    summary.seconds = time.perf_counter() - began
    return summary


def _one(samples: Any, case: Path, rng: random.Random, summary: Summary) -> None:
    shutil.rmtree(case, ignore_errors=True)
    case.mkdir()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        read = samples.make(case, rng)
        began = time.perf_counter()
        WATCH.seen.clear()
        try:
            with limited(LIMIT):
                WATCH.on = True
                read()
            summary.read += 1
        except UndertowError as error:
            WATCH.on = False
            summary.refused[type(error).__name__] += 1
            if not str(error).strip():
                summary.failures.append("an error without words")
        except TooLong:
            WATCH.on = False
            summary.failures.append(f"more than {LIMIT:g} s")
        except BaseException as error:
            WATCH.on = False
            if isinstance(error, KeyboardInterrupt):
                raise
            trace, where = error.__traceback__, ""
            while trace is not None:
                where = f"{Path(trace.tb_frame.f_code.co_filename).name}:{trace.tb_lineno}"
                trace = trace.tb_next
            summary.failures.append(f"{type(error).__name__}: {str(error)[:150]} at {where}")
        finally:
            WATCH.on = False
    summary.failures += [f"it did: {one}" for one in WATCH.seen]
    summary.count += 1
    summary.longest = max(summary.longest, time.perf_counter() - began)


def _part(kind: str, first: int, count: int, seed: int) -> tuple[int, str]:
    """Fuzz a part in a process of its own; return its exit status and what it said."""
    words = ["--kind", kind, "--first", first, "--count", count, "--seed", seed, "--jobs", 1]
    done = subprocess.run(
        [sys.executable, __file__, *map(str, words)], capture_output=True, text=True, check=False
    )
    return done.returncode, done.stdout + done.stderr


def main() -> int:
    """Fuzz from the command line; exit status 1 when anything failed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=10_000, help="files of each kind")
    parser.add_argument("--kind", choices=("all", *KINDS), default="all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes")
    asked = parser.parse_args()
    if asked.jobs > 1 or asked.kind == "all":
        kinds = KINDS if asked.kind == "all" else (asked.kind,)
        end, step = asked.first + asked.count, 500
        parts = [
            (kind, first, min(step, end - first), asked.seed)
            for kind in kinds
            for first in range(asked.first, end, step)
        ]
        worst = 0
        with ThreadPoolExecutor(asked.jobs) as pool:
            for done, (status, said) in enumerate(pool.map(lambda part: _part(*part), parts), 1):
                print(f"{done} of {len(parts)}: {said}", end="", flush=True)
                worst = max(worst, abs(status))
        print(f"{asked.count} of each kind, seed {asked.seed}: {'FAILED' if worst else 'all well'}")
        return 1 if worst else 0
    summary = fuzz(asked.kind, asked.count, asked.seed, asked.first)
    print(summary, flush=True)
    for failure in summary.failures[:40]:
        print(f"  {failure}")
    return 1 if summary.failures else 0


if __name__ == "__main__":
    raise SystemExit(main())
