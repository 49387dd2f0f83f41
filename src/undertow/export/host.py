"""The exported C on this machine: built, tested, spoken to over a pipe, counted.

What is needed: a C compiler; for counts also ``valgrind``, ``size`` and ``nm``.
"""

from __future__ import annotations

import contextlib
import re
import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Self

import numpy as np
from numpy.typing import ArrayLike

from undertow.base import ArtefactError, MissingExtraError
from undertow.export.controller import EmbeddedController, checksums, plan_numbers
from undertow.export.names import PlanAnswer, Status
from undertow.export.sources import files
from undertow.export.twin import random_states
from undertow.law import Plan
from undertow.models import FloatArray
from undertow.plants import Measurement, Rig, control_loop

#: How the C is compiled: every warning is an error.
FLAGS = ("-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-O2")


#: |det Γ(q)/det Γ(0)| from which on the law is compared, by precision.
NEAREST = {"double": 0.0, "float": 1e-4}


def tool(name: str) -> str:
    """Return the path of a program.

    Raises MissingExtraError when it is not installed.
    """
    path = shutil.which(name)
    if path is None:
        raise MissingExtraError(
            f"program '{name}'",
            value="not found",
            limit="on the PATH",
            remedy=f"Install {name} from the system's packages",
        )
    return path


def version(compiler: str) -> str:
    """Return the first line of what a compiler says of itself."""
    return _run(tool(compiler), "--version", cwd=Path.cwd()).stdout.partition("\n")[0]


def compile_c(
    compiler: str, folder: Path, sources: Sequence[str], program: str, *more: str
) -> Path:
    """Compile files of a folder, there, into a program or a library.

    Raises MissingExtraError when there is no such compiler; ArtefactError when the C does not
    compile, with the compiler's first complaint.
    """
    done = _run(tool(compiler), *FLAGS, *sources, "-o", program, *more, "-lm", cwd=folder)
    if done.returncode != 0:
        first = next((line for line in done.stderr.splitlines() if "error" in line), "")
        raise ArtefactError(
            f"C of '{program}'",
            value=first or done.stderr[-200:],
            limit=f"accepted by {Path(compiler).name}",
            remedy="Report it: generated code must compile",
        )
    return folder / program


def _run(*command: str, cwd: Path, text: str | None = None) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command, cwd=cwd, input=text, capture_output=True, text=True, check=False, timeout=600
    )


@dataclass(frozen=True)
class Agreement:
    """Largest differences between C and Python over random states, relative.

    ``output`` and ``demand`` by max(|value|, the input's limit), ``s`` and ``margin`` by
    max(|value|, 1).  A demand has 1/det Γ as a factor, and with it the rounding of sines and
    cosines, which differs between libraries: where det Γ(q)/det Γ(0) is below 1 in magnitude,
    its difference is multiplied by that.  States nearer to the singularity than :data:`NEAREST`
    are left out: there the sign of det Γ is rounding, and with it that of the demand.
    """

    states: int
    left_out: int
    output: float
    demand: float
    s: float
    margin: float


@dataclass(frozen=True)
class Footprint:
    """What a controller costs on this machine.

    ``instructions``: of one step from positions, math.h included: the mean over a run. ``code``,
    ``constants``, ``memory``: bytes of machine code, of constant data, and of one controller's
    state. ``stack``: bytes: all frames of the controller's functions together, so a bound on its
    depth but for math.h's. ``calls``: names that the object file asks of the standard library.
    """

    instructions: float
    code: int
    constants: int
    memory: int
    stack: int
    calls: tuple[str, ...]


class Build:
    """A controller's C in a folder, compiled there.

    The folder has its files, or they are written there; the compiler takes GCC's options.

    Raises MissingExtraError when there is no such compiler; ArtefactError when the C does not
    compile, with the compiler's first complaint.
    """

    def __init__(self, controller: EmbeddedController, folder: Path, compiler: str = "gcc") -> None:
        self.controller, self.folder = controller, folder
        self.name = controller.stem
        self._compiler = tool(compiler)
        for name, content in files(controller).items():
            if not (folder / name).exists():
                (folder / name).write_bytes(content)

    def compile(self, sources: Sequence[str], program: str, *more: str) -> Path:
        """Compile files of the folder into a program."""
        return compile_c(self._compiler, self.folder, sources, program, *more)

    def self_test(self) -> tuple[bool, str]:
        """Build and run the test against the vectors: whether it passes, and what it says."""
        program = self.compile([f"{self.name}.c", f"{self.name}_test.c"], f"{self.name}_test")
        done = _run(str(program), cwd=self.folder)
        return done.returncode == 0, done.stdout.strip()

    def pipe(self) -> Path:
        """Build the program that is spoken to over a pipe."""
        return self.compile([f"{self.name}.c", f"{self.name}_pipe.c"], f"{self.name}_pipe")

    def start(self) -> HostProcess:
        """Start the controller as a process of its own."""
        return HostProcess(self.controller, self.pipe())

    def agreement(self, count: int = 100_000) -> Agreement:
        """Compare the law with :class:`undertow.SlidingModeLaw` at random states."""
        mechanism = self.controller.mechanism
        states = random_states(mechanism, count)
        if self.controller.real == "float":
            states = states.astype(np.float32).astype(float)
        lines = "\n".join("l " + " ".join(map(repr, row)) for row in states.tolist())
        done = _run(str(self.pipe()), cwd=self.folder, text=lines + "\n")
        got = np.array([row.split() for row in done.stdout.splitlines()], dtype=float)
        demand, s, margin = np.split(got, [mechanism.m, 2 * mechanism.m], axis=1)
        said = self.controller.laws[0](0.0, states)
        limit = mechanism.input_limits
        near = np.abs(said.margin) < NEAREST[self.controller.real]

        def largest(
            value: FloatArray,
            expected: FloatArray,
            scale: float | FloatArray,
            weight: float | FloatArray = 1.0,
        ) -> float:
            error = np.abs(value - expected) / np.maximum(np.abs(expected), scale)
            return float(np.max((error * weight)[~near], initial=0.0))

        return Agreement(
            count,
            int(near.sum()),
            largest(np.clip(demand, -limit, limit), said.u, limit),
            largest(demand, said.demand, limit, np.minimum(1.0, np.abs(said.margin))[:, None]),
            largest(s, said.s, 1.0),
            largest(margin[:, 0], said.margin, 1.0),
        )

    def footprint(self, positions: FloatArray) -> Footprint:
        """Count instructions, bytes and frames; positions (N, n) are what the steps see."""
        source, unit = f"{self.name}.c", f"{self.name}.o"
        self.compile([source], unit, "-c", "-fstack-usage")
        columns = _run(tool("size"), unit, cwd=self.folder).stdout.splitlines()[1].split()
        sections = _run(tool("size"), "-A", unit, cwd=self.folder).stdout
        code = sum(int(n) for n in re.findall(r"^\.text\S*\s+(\d+)", sections, re.MULTILINE))
        constants = sum(int(n) for n in re.findall(r"^\.rodata\S*\s+(\d+)", sections, re.MULTILINE))
        assert code + constants <= int(columns[0]) + int(columns[1])
        usage = [
            line.split("\t") for line in (self.folder / f"{self.name}.su").read_text().splitlines()
        ]
        if any(kind != "static" for _, _, kind in usage):
            raise ArtefactError(
                f"stack of '{self.name}'",
                value=[row[0] for row in usage if row[2] != "static"],
                limit="bounded when compiled",
                remedy="Report it: generated code must not grow its stack",
            )
        undefined = _run(tool("nm"), "-u", unit, cwd=self.folder).stdout.split()
        with self.start() as process:
            memory = process.memory
        return Footprint(
            self._instructions(positions),
            code,
            constants,
            memory,
            sum(int(size) for _, size, _ in usage),
            tuple(sorted(name for name in undefined if name not in {"U", "_GLOBAL_OFFSET_TABLE_"})),
        )

    def _instructions(self, positions: FloatArray) -> float:
        """Mean number of instructions of a step, by callgrind."""
        text = "".join("q " + " ".join(map(repr, row)) + "\n" for row in positions.tolist())
        step = f"{self.controller.prefix}_step"
        done = _run(
            tool("valgrind"),
            "--tool=callgrind",
            "--callgrind-out-file=/dev/null",
            "--collect-atstart=no",
            f"--toggle-collect={step}",
            str(self.pipe()),
            cwd=self.folder,
            text=text,
        )
        found = re.search(r"Collected : (\d+)", done.stderr)
        if found is None:
            raise ArtefactError(
                "instruction count",
                value=done.stderr[-200:],
                limit="a count by valgrind",
                remedy="See whether valgrind runs here at all",
            )
        return int(found[1]) / len(positions)


class HostProcess:
    """The exported controller as a process of its own, spoken to over a pipe.

    ``program`` is the built ``<name>_pipe``.
    """

    def __init__(self, controller: EmbeddedController, program: Path) -> None:
        self.controller = controller
        self._process = subprocess.Popen(
            [str(program)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1
        )

    def _ask(self, line: str) -> list[str]:
        to, back = self._process.stdin, self._process.stdout
        assert to is not None  # both were asked for
        assert back is not None
        try:
            to.write(line + "\n")
            to.flush()
            answer = back.readline().split()
        except OSError:
            answer = []
        if not answer or answer == ["?"]:
            raise ArtefactError(
                "exported controller's process",
                value=f"no answer to '{line[:60]}'",
                limit="one line for each line",
                remedy="Start it anew",
            )
        return answer

    def _period(self, letter: Literal["q", "x"], values: ArrayLike) -> tuple[FloatArray, Status]:
        numbers = np.asarray(values, dtype=float).ravel().tolist()
        status, *u = self._ask(" ".join([letter, *map(repr, numbers)]))
        return np.array(u, dtype=float), Status(int(status))

    def step(self, q: ArrayLike) -> tuple[FloatArray, Status]:
        """One period from measured positions, (n,): the inputs, (m,), and the status."""
        return self._period("q", q)

    def step_state(self, x: ArrayLike) -> tuple[FloatArray, Status]:
        """One period from a state that is measured whole, (2n,)."""
        return self._period("x", x)

    def offer(self, plan: Plan, number: int) -> PlanAnswer:
        """Offer another plan; it is in use from the next step on."""
        starts, rows = self.controller.starts(plan), plan_numbers(self.controller, plan)
        words = ["p", str(number), str(len(rows))]
        for start, row in zip(starts, rows, strict=True):
            words += [str(start), *map(repr, np.concatenate(row).tolist())]
        words += map(str, checksums(number, starts, rows, self.controller.real))
        return PlanAnswer(int(self._ask(" ".join(words))[0]))

    def arm(self) -> None:
        """Let the output on again after a lost sensor or a fault."""
        self._ask("a")

    @property
    def memory(self) -> int:
        """Bytes of the controller's state."""
        return int(self._ask("m")[0])

    @property
    def places(self) -> dict[str, int]:
        """Where each member of the controller's state begins, bytes."""
        _, *words = self._ask("m")
        return {name: int(at) for name, at in zip(words[::2], words[1::2], strict=True)}

    def close(self) -> None:
        """End the process."""
        for stream in (self._process.stdin, self._process.stdout):
            with contextlib.suppress(OSError):  # what it can no longer read
                if stream is not None:
                    stream.close()
        self._process.wait(timeout=10)

    def __enter__(self) -> Self:
        """Use it in a ``with`` block."""
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


#: Distance of an unactuated coordinate from the target up to which it counts as held, rad or m.
HELD = 0.1


def is_held(q: FloatArray, m: int, period: float) -> bool:
    """Whether all but the m driven of the positions, (N, n), were held for the last second."""
    last = max(1, round(1.0 / period))
    return bool((np.abs(q[-last:, m:]) <= HELD).all())


@dataclass(frozen=True, eq=False)
class RigRun:
    """One run on a rig, period by period.

    ``q``, ``u``: measured positions, (N, n), and outputs, (N, m); ``status``: what the controller
    said of each period; ``held``: whether the unactuated coordinates stayed within :data:`HELD` in
    the last second.
    """

    q: FloatArray
    u: FloatArray
    status: tuple[Status, ...]
    held: bool


def run_on_rig(process: HostProcess, rig: Rig, seconds: float) -> RigRun:
    """Let an exported controller steer a rig, from measured positions alone.

    The rig's period is the controller's; ``seconds`` are of the rig's clock.
    """
    m = process.controller.mechanism.m
    positions, outputs, status = [], [], []

    def step(measurement: Measurement) -> FloatArray:
        u, said = process.step(measurement.q)
        status.append(said)
        return u

    for measurement, u in control_loop(rig, step, round(seconds / rig.period)):
        positions.append(measurement.q)
        outputs.append(u)
    q = np.array(positions)
    return RigRun(q, np.array(outputs), tuple(status), is_held(q, m, rig.period))
