"""Every bit of the exported controller's memory upset, one at a time, in a run on a rig.

The plan in use is not the built-in one, so that a damaged plan is not replaced by itself.  A run is
first replayed on the undisturbed run's measurements: while the outputs are the same bits, so is the
rig, and only where they differ is the rig simulated anew from the upset on.
"""

from __future__ import annotations

import copy
import ctypes
import math
from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from rich import box
from rich.table import Table

from undertow.export.host import Build
from undertow.export.loop import HELD
from undertow.export.sources import prefixed
from undertow.models import FloatArray
from undertow.plants import RealisticRig

__all__ = ["Upsets", "upset_every_bit", "upsets_table"]

#: When a bit is upset, s after the start: in the catch, after it, at rest.
MOMENTS = (0.05, 0.5, 2.0)

#: How long a run goes on after the upset, s.
AFTER = 2.5

_HARNESS = """#include <math.h>
#include "{name}_vectors.h"
unsigned long ut_size(void);
void ut_begin(ut_controller *c);
void ut_replay(ut_controller *c, const ut_real *q, ut_real *u, long count);
unsigned long ut_size(void)
{{
    return sizeof(ut_controller);
}}
void ut_begin(ut_controller *c)
{{
    ut_init(c);
    (void)ut_offer(c, &ut_next_plan);
}}
void ut_replay(ut_controller *c, const ut_real *q, ut_real *u, long count)
{{
    for (long k = 0; k < count; k++) {{
        (void)ut_step(c, q + k * UT_N, u + k * UT_M);
    }}
}}
"""


@dataclass(frozen=True)
class Upsets:
    """What became of the runs.

    Attributes
    ----------
    name, real
        Of the controller.
    bits
        Bits of the controller's memory, unused ones included.
    moments
        When they were upset, s.
    undisturbed
        Whether the run without an upset is held to its end.
    runs, beyond, held
        For each member of the memory: runs, runs with an output beyond a limit or no number at any
        step, and runs that were held in their last second.
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
        source = prefixed(_HARNESS, prefix).format(name=name)
        (build.folder / "harness.c").write_text(source, encoding="ascii")
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

    def step(self, q: FloatArray) -> list[float]:
        """Return the output to one measurement, (n,) to (m,)."""
        self._q[:] = q
        self._replay(self._at, *self._row, 1)
        return [float(u) for u in self._u]


def _copied(rig: RealisticRig) -> RealisticRig:
    """Return a rig that goes on by itself; what never changes is shared."""
    twin = copy.copy(rig)
    for name, value in vars(rig).items():
        if isinstance(value, np.ndarray | np.random.Generator):
            setattr(twin, name, copy.deepcopy(value))
    return twin


def _run(library: _Library, rig: RealisticRig, periods: int) -> tuple[FloatArray, FloatArray]:
    """Return positions (N, n) and outputs (N, m); an output that no rig takes ends the run."""
    positions, outputs = [], []
    for _ in range(periods):
        positions.append(rig.read().q)
        u = library.step(positions[-1])
        outputs.append(u)
        if not all(map(math.isfinite, u)):
            break
        rig.write(u)
    return np.array(positions), np.array(outputs)


def upset_every_bit(
    build: Build,
    rig: RealisticRig,
    *,
    moments: Sequence[float] = MOMENTS,
    after: float = AFTER,
    every: int = 1,
    progress: Callable[[float], None] | None = None,
) -> Upsets:
    """Upset the bits of a controller's memory, one in each run.

    Parameters
    ----------
    build
        The controller, in a folder of its own.
    rig
        At its start; its period is the controller's.
    moments
        When, s after the start, ascending.
    after
        How long a run goes on after the upset, s.
    every
        Upset every so manieth bit.
    progress
        Told the fraction done.
    """
    controller = build.controller
    limit, m = controller.mechanism.input_limits, controller.mechanism.m
    library, rig = _Library(build), _copied(rig)
    with build.start() as process:
        places = process.places
    names, begins = list(places), list(places.values())
    runs, beyond, held = (dict.fromkeys(names, 0) for _ in range(3))
    last = max(1, round(1.0 / rig.period))
    chosen = range(0, library.bits, every)
    undisturbed, done = True, 0
    library.begin()
    for number, moment in enumerate(moments):
        so_far = moments[number - 1] if number else 0.0
        _run(library, rig, round(moment / rig.period) - round(so_far / rig.period))
        memory = library.memory.copy()
        q, u = _run(library, _copied(rig), round(after / rig.period))
        balanced = bool((np.abs(q[-last:, m:]) <= HELD).all())
        undisturbed &= balanced
        for bit in chosen:
            library.memory[:] = memory
            library.flip(bit)
            seen, given = q, library.steps(q)
            if not np.array_equal(given, u):
                library.memory[:] = memory
                library.flip(bit)
                seen, given = _run(library, _copied(rig), len(q))
            name = names[bisect_right(begins, bit // 8) - 1]
            runs[name] += 1
            beyond[name] += not (np.abs(given) <= limit).all()
            held[name] += len(seen) == len(q) and bool((np.abs(seen[-last:, m:]) <= HELD).all())
            done += 1
            if progress is not None and done % 64 == 0:
                progress(done / len(chosen) / len(moments))
        library.memory[:] = memory
    return Upsets(
        controller.mechanism.name, controller.real, library.bits, tuple(moments), undisturbed,
        runs, beyond, held,
    )  # fmt: skip


def upsets_table(upsets: Upsets) -> Table:
    """Return for a terminal what became of the runs, by the member that was upset."""
    table = Table(
        title=f"{upsets.name}, {upsets.real}", title_justify="left",
        title_style="bold", box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0),
    )  # fmt: skip
    for head in ("member", "runs", "beyond a limit", "still balanced"):
        table.add_column(head, no_wrap=True, justify="left" if head == "member" else "right")
    for name, count in upsets.runs.items():
        if count:
            share = f"{upsets.held[name] / count:.1%}"
            table.add_row(name, str(count), str(upsets.beyond[name]), share)
    return table
