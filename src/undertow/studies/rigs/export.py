"""What the exported C of many mechanisms costs and how far it agrees with Python: two tables."""

from __future__ import annotations

import ctypes
import tempfile
from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from rich.table import Table

from undertow.base import Progress, each, no_progress, table, to_csv
from undertow.export import Agreement, EmbeddedController, Footprint
from undertow.export.host import FLAGS, NEAREST, Build, is_held, run_on_rig, version
from undertow.export.sources import render
from undertow.export.twin import run_positions
from undertow.models import FloatArray
from undertow.plants import RealisticRig, control_loop
from undertow.plants.bench import bench_for
from undertow.symbolic import Real

#: When a bit is upset, s after the start: in the catch, after it, at rest.
MOMENTS = (0.05, 0.5, 2.0)

#: How long a run goes on after the upset, s.
AFTER = 2.5


@dataclass(frozen=True)
class Upsets:
    """What became of the runs.

    ``bits``: of the controller's memory, unused ones included; ``moments``: when they were upset,
    s; ``undisturbed``: whether the run without an upset is held to its end. ``runs``, ``beyond``,
    ``held``: for each member of the memory, runs, runs with an output beyond a limit or no number
    at any step, and runs that were held in their last second.
    """

    name: str
    real: str
    bits: int
    moments: tuple[float, ...]
    undisturbed: bool
    runs: dict[str, int]
    beyond: dict[str, int]
    held: dict[str, int]

    def __str__(self) -> str:
        """Return one sentence."""
        runs, beyond, held = (sum(d.values()) for d in (self.runs, self.beyond, self.held))
        when = ", ".join(f"{t:g}" for t in self.moments)
        return (
            f"{self.name}, {self.real}: {runs} runs, each with one bit of {self.bits} upset at "
            f"{when} s: output beyond its limit in {beyond}; still balanced {held} "
            f"({held / runs:.1%})" + "." * self.undisturbed
            + ", but so is not the run without an upset." * (not self.undisturbed)
        )  # fmt: skip


class _Library:
    """The controller's C in this process, its memory laid open."""

    def __init__(self, build: Build) -> None:
        controller = build.controller
        prefix, name = controller.prefix, controller.stem
        (build.folder / "harness.c").write_bytes(render("harness.c", {"name": name}, prefix))
        path = build.compile([f"{name}.c", "harness.c"], "harness.so", "-shared", "-fPIC")
        library = ctypes.CDLL(str(path))
        size = getattr(library, f"{prefix}_size")
        size.restype = ctypes.c_ulong
        self._begin = getattr(library, f"{prefix}_begin")
        self._begin.argtypes = [ctypes.c_void_p]
        self._replay = getattr(library, f"{prefix}_replay")
        self._replay.argtypes = [ctypes.c_void_p] * 3 + [ctypes.c_long]
        self._kind = np.float32 if controller.real == "float" else np.float64
        self._m = controller.mechanism.m
        self.memory = np.zeros(-(-size() // 8), dtype=np.uint64).view(np.uint8)
        self.bits, self._at = 8 * size(), self.memory.ctypes.data
        self._q = np.zeros(controller.mechanism.n, dtype=self._kind)
        self._u = np.zeros(self._m, dtype=self._kind)
        self._row = self._q.ctypes.data, self._u.ctypes.data

    def begin(self) -> None:
        """Start, with another plan offered than the built-in one."""
        self._begin(self._at)

    def flip(self, bit: int) -> None:
        """Upset one bit."""
        self.memory[bit // 8] ^= np.uint8(1 << bit % 8)

    def steps(self, q: FloatArray) -> FloatArray:
        """Return the outputs to measured positions, (N, n) to (N, m)."""
        held = q.astype(self._kind)
        u = np.full((len(held), self._m), np.nan, dtype=self._kind)
        self._replay(self._at, held.ctypes.data, u.ctypes.data, len(held))
        return u.astype(float)

    def step(self, q: FloatArray) -> FloatArray:
        """Return the output to one measurement, (n,) to (m,)."""
        self._q[:] = q
        self._replay(self._at, *self._row, 1)
        return self._u.astype(float)


def _run(library: _Library, rig: RealisticRig, periods: int) -> tuple[FloatArray, FloatArray]:
    """Return positions (N, n) and outputs (N, m); an output that no rig takes ends the run."""
    positions, outputs = [], []
    for measurement, u in control_loop(rig, lambda seen: library.step(seen.q), periods):
        positions.append(measurement.q)
        outputs.append(u)
        if not np.isfinite(u).all():
            break
    return np.array(positions), np.array(outputs)


def upset_every_bit(
    build: Build,
    rig: RealisticRig,
    *,
    moments: Sequence[float] = MOMENTS,
    after: float = AFTER,
    every: int = 1,
    progress: Callable[[float], None] = lambda _part: None,
) -> Upsets:
    """Upset the bits of a controller's memory, one in each run.

    The build has a folder of its own; the rig is at its start, its period the controller's. Every
    so manieth bit is upset at each of the ``moments``, s, ascending, and the run goes on for
    ``after``, s.
    """
    controller = build.controller
    limit, m = controller.mechanism.input_limits, controller.mechanism.m
    library, rig = _Library(build), rig.copied()
    with build.start() as process:
        places = process.places
    names, begins = list(places), list(places.values())
    runs, beyond, held = (dict.fromkeys(names, 0) for _ in range(3))
    chosen = range(0, library.bits, every)
    undisturbed, done = True, 0
    library.begin()
    for number, moment in enumerate(moments):
        so_far = moments[number - 1] if number else 0.0
        _run(library, rig, round(moment / rig.period) - round(so_far / rig.period))
        memory = library.memory.copy()
        q, u = _run(library, rig.copied(), round(after / rig.period))
        undisturbed &= is_held(q, m, rig.period)
        for bit in chosen:
            library.memory[:] = memory
            library.flip(bit)
            seen, given = q, library.steps(q)
            if not np.array_equal(given, u):
                library.memory[:] = memory
                library.flip(bit)
                seen, given = _run(library, rig.copied(), len(q))
            name = names[bisect_right(begins, bit // 8) - 1]
            runs[name] += 1
            beyond[name] += not (np.abs(given) <= limit).all()
            held[name] += len(seen) == len(q) and is_held(seen, m, rig.period)
            done += 1
            if done % 64 == 0:
                progress(done / len(chosen) / len(moments))
        library.memory[:] = memory
    return Upsets(
        controller.mechanism.name, controller.real, library.bits, tuple(moments), undisturbed,
        runs, beyond, held,
    )  # fmt: skip


def upsets_table(upsets: Upsets) -> Table:
    """Return for a terminal what became of the runs, by the member that was upset."""
    rows = [
        (name, str(count), str(upsets.beyond[name]), f"{upsets.held[name] / count:.1%}")
        for name, count in upsets.runs.items()
        if count
    ]
    heads = ("member", "runs", "beyond a limit", "still balanced")
    return table(heads, rows, title=f"{upsets.name}, {upsets.real}", ruled=True, whole=heads)


@dataclass(frozen=True, eq=False)
class ExportRow:
    """One mechanism of the table."""

    controller: EmbeddedController
    passed: bool
    said: str
    agreement: Agreement
    footprint: Footprint

    def row(self) -> dict[str, object]:
        """Return the row: column to value."""
        mechanism, cost, near = self.controller.mechanism, self.footprint, self.agreement
        return {
            "mechanism": mechanism.name,
            "n": mechanism.n,
            "m": mechanism.m,
            "own test": "passed" if self.passed else "FAILED",
            "u": f"{near.output:.1e}",
            "demand": f"{near.demand:.1e}",
            "s": f"{near.s:.1e}",
            "margin": f"{near.margin:.1e}",
            "instr.": round(cost.instructions),
            "code": cost.code,
            "const": cost.constants,
            "state": cost.memory,
            "stack": cost.stack,
            "calls": ", ".join(cost.calls),
        }


#: Columns of the two tables, which fit a terminal of 80 columns.
AGREEMENT = ("mechanism", "n", "m", "own test", "u", "demand", "s", "margin")
COST = ("mechanism", "instr.", "code", "const", "state", "stack", "calls")


def measure(
    controllers: Sequence[EmbeddedController],
    *,
    states: int = 100_000,
    compiler: str = "gcc",
    progress: Progress = no_progress,
) -> list[ExportRow]:
    """Build, test, compare and count each controller in a folder that is then removed.

    ``states`` random ones are compared with Python; the compiler takes GCC's options. Raises
    MissingExtraError when the compiler, ``size``, ``nm`` or ``valgrind`` is not installed.
    """
    entries = []
    for controller in each(controllers, progress, lambda one: one.mechanism.name):
        with tempfile.TemporaryDirectory(prefix="undertow-") as folder:
            build = Build(controller, Path(folder), compiler)
            passed, said = build.self_test()
            positions = run_positions(controller)
            whole = positions[np.isfinite(positions).all(axis=1)]
            entries.append(
                ExportRow(controller, passed, said, build.agreement(states), build.footprint(whole))
            )
    return entries


def tables(entries: Sequence[ExportRow]) -> tuple[Table, Table]:
    """Return for a terminal how far the C agrees with Python, and what it costs."""

    def shown(title: str, heads: tuple[str, ...]) -> Table:
        left = ("own test", "calls")
        made = table(heads, title=title, left=left, whole=heads, ruled=True)
        for entry in entries:
            row, style = entry.row(), "" if entry.passed else "red"
            made.add_row(*(str(row[head]) for head in heads), style=style)
        return made

    return (
        shown("Largest difference from Python", AGREEMENT),
        shown("Instructions of a step, and bytes", COST),
    )


def csv(entries: Sequence[ExportRow]) -> bytes:
    """Return all columns as comma-separated values."""
    rows = [entry.row() for entry in entries]
    return to_csv(list(rows[0]), (list(row.values()) for row in rows))


def notes(real: Real, states: int, compiler: str) -> tuple[str, ...]:
    """Return what the columns of the tables mean, and how the C was built."""
    nearest = NEAREST[real]
    return (
        f"Built by {version(compiler)} with {' '.join(FLAGS)}, real = {real}.",
        f"At {states} random states; u and demand by max(|value|, limit), s and margin by "
        "max(|value|, 1). demand: before the limits, times |det Γ(q)/det Γ(0)| where that is below "
        "1, for it has the inverse as a factor."
        + f" States with less than {nearest:g} of it are left out: there its sign is rounding."
        * (nearest > 0),
        "instr.: mean of a run from positions, math.h included, by valgrind's callgrind. stack: "
        "all frames together, without math.h's.",
    )


#: Length of a run on a rig, s.
SECONDS = 10.0


def held_on_rigs(
    one: EmbeddedController, x0: FloatArray, rigs: int, compiler: str, progress: Progress
) -> int:
    """Return on how many realistic rigs the exported controller holds the mechanism.

    It runs as a process over a pipe, from ``x0``, (2n,), on one rig for each seed.
    """
    bench = bench_for(one.mechanism).with_timing(period=one.period)
    held = 0
    with tempfile.TemporaryDirectory(prefix="undertow-") as folder:
        build = Build(one, Path(folder), compiler)
        for seed in each(range(rigs), progress, lambda _: f"rigs of {one.mechanism.name}"):
            with build.start() as process:
                held += run_on_rig(process, RealisticRig(bench, x0, seed), SECONDS).held
    return held


def flip_bits(
    one: EmbeddedController, x0: FloatArray, compiler: str, progress: Progress
) -> list[Upsets]:
    """Flip every bit of the controller's memory, one in each run, in double and in float."""
    bench = bench_for(one.mechanism).with_timing(period=one.period)
    precisions: tuple[Real, ...] = ("double", "float")
    found = []
    for real in precisions:
        with tempfile.TemporaryDirectory(prefix="undertow-") as folder:
            found.append(
                upset_every_bit(
                    Build(replace(one, real=real), Path(folder), compiler),
                    RealisticRig(bench, x0, seed=0),
                    progress=partial(progress, f"bits of {one.mechanism.name}, {real}"),
                )
            )
    return found
