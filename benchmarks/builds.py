"""Two builds of this library in turn: what a change of its source has cost or won.

    python benchmarks/builds.py FOLDER [--quick] [--rounds N]

FOLDER is another checkout (``git worktree add FOLDER COMMIT``).  Each build works in a process of
its own, on one thread, with a cache of its own; they are asked in turn, in changing order, round
after round.  A ratio is this build's seconds over the other's in one round; printed are its
geometric mean and the 95 % interval of it.  Both must give the same costs, bit for bit, or the row
says how far this build's is above the other's, as a part of it.  Every fourth part of the rounds
has a pair of new processes: where the system puts a process's memory moves its times by several per
cent.
"""

from __future__ import annotations

from harness import command_line, progress, table  # isort: skip  first: one thread

import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from operator import methodcaller
from pathlib import Path

import numpy as np
from scipy.stats import t as student

from start import install

HERE = Path(__file__).resolve().parents[1]

#: Pairs of processes, one after another.
PAIRS = 4

#: Reads the name of a job from every line and writes the seconds that it took, and its result.
WORKER = """
import json, sys, time
import numpy as np
import undertow as ut

rig = ut.mechanisms.rotary_pendulum(d_e=0.025)
loop = ut.ClosedLoop(rig, ut.MinimumEnergy(), step=0.002)
x0 = rig.state(phi=ut.deg(30))
spread = 1 + 0.05 * np.random.default_rng(0).standard_normal((256, 4)) * np.array([0, 1, 1, 1])
vectors = np.array([-1.0, -1.59, 1.96, 12.1]) * spread
exact = {"belief": "exact"} if hasattr(ut, "Belief") else {}
cascades = {o.name: ut.Cascade(rig, o, **exact) for o in (ut.MinimumEnergy(), ut.MinimumTime())}
tasks = {}
for name, cascade in cascades.items():
    surface = cascade.optimiser.propose(x0).surface
    x = cascade.loop.simulate(x0, surface, duration=0.1).x[-1]
    tasks[name] = (x, surface)

def kernel():
    return loop.batch(x0, vectors, duration=5.0, terminal=0.0).cost.sum()

def cold(name):
    return sum(cascades[name].optimiser.propose(x0, sequence=j).cost for j in range(2))

def warm(name):
    x, surface = tasks[name]
    ask = cascades[name].optimiser.propose
    return sum(ask(x, incumbent=surface, sequence=j).cost for j in range(20))

def many():
    return ut.Cascade(rig, ut.MinimumEnergy()).optimiser.propose(x0).cost

for line in sys.stdin:
    job, *rest = line.split()
    began = time.perf_counter()
    result = globals()[job](*rest)
    print(json.dumps([time.perf_counter() - began, float(result).hex()]), flush=True)
"""

JOBS = {
    "kernel, 256 surfaces": "kernel",
    "re-optimisation, energy, warm": "warm energy",
    "re-optimisation, energy, cold": "cold energy",
    "re-optimisation, time, warm": "warm time",
    "re-optimisation, time, cold": "cold time",
    "first plan, many plants": "many",
}

IMPORT = "import undertow"

START = """
import undertow as ut
rig = ut.mechanisms.rotary_pendulum()
loop = ut.ClosedLoop(rig, ut.MinimumEnergy())
loop.simulate(rig.state(phi=ut.deg(30)), ut.first_surface(rig), duration=0.1)
"""

FIRST = f"{START}\nut.Cascade(rig, ut.MinimumEnergy()).start(rig.state(phi=ut.deg(30)))\n"


class Build:
    """A checkout, and a process that works from its source."""

    def __init__(self, tree: Path, cache: Path) -> None:
        self.package = tree / "src" / "undertow"
        self.environment = os.environ | {
            "PYTHONPATH": str(tree / "src"), "UNDERTOW_CACHE": str(cache),
            "PYTHONDONTWRITEBYTECODE": "",
        }  # fmt: skip
        self.process = self._begin()

    def _begin(self) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [sys.executable, "-c", WORKER],
            env=self.environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip

    def again(self) -> None:
        """Go on in another process."""
        self.process.terminate()
        self.process = self._begin()

    def ask(self, job: str) -> tuple[float, str]:
        """Return the seconds of a job, the least of three, and its result."""
        return min(self._asked(job) for _ in range(3))

    def _asked(self, job: str) -> tuple[float, str]:
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        print(job, file=self.process.stdin, flush=True)
        line = self.process.stdout.readline()
        if not line:
            sys.exit(f"error: the build of {self.environment['PYTHONPATH']} has ended")
        seconds, result = json.loads(line)
        return float(seconds), str(result)

    def start(self, code: str, *, empty: bool) -> tuple[float, str]:
        """Return the seconds of a process that runs some code, with an empty cache or its own."""
        with tempfile.TemporaryDirectory() as folder:
            environment = self.environment | ({"UNDERTOW_CACHE": folder} if empty else {})
            began = time.perf_counter()
            subprocess.run([sys.executable, "-c", code], env=environment, check=True)
            return time.perf_counter() - began, ""

    def first_answer(self) -> tuple[float, str]:
        """Return the seconds to the first plan of a copy as pip leaves it, nothing compiled."""
        with tempfile.TemporaryDirectory() as folder:
            install(Path(folder), self.package)
            environment = self.environment | {
                "PYTHONPATH": folder, "UNDERTOW_CACHE": str(Path(folder) / "cache")
            }  # fmt: skip
            began = time.perf_counter()
            subprocess.run([sys.executable, "-c", FIRST], env=environment, check=True)
            return time.perf_counter() - began, ""


#: What is timed: seconds and result of one run.
Run = Callable[[Build], tuple[float, str]]


def interval(ours: list[float], theirs: list[float]) -> tuple[float, float, float]:
    """Return geometric mean and 95 % interval of the paired ratios."""
    logs = np.log(np.asarray(ours) / np.asarray(theirs))
    half = student.ppf(0.975, len(logs) - 1) * logs.std(ddof=1) / math.sqrt(len(logs))
    mean = logs.mean()
    return math.exp(mean), math.exp(mean - half), math.exp(mean + half)


def main() -> int:
    """Compare two builds; exit status 1 when their results differ."""
    parser = command_line(__doc__, clocks=False)
    parser.epilog = (
        "example:\n  git worktree add ../before HEAD~5\n"
        "  python benchmarks/builds.py ../before --rounds 60"
    )
    parser.add_argument("other", type=Path, metavar="FOLDER", help="the other checkout")
    parser.add_argument(
        "--rounds",
        type=int,
        default=60,
        help="of the quick jobs; half for import, a sixth for a cold start",
    )
    asked = parser.parse_args()
    if not (asked.other / "src" / "undertow").is_dir():
        parser.error(f"{asked.other} is no checkout: it has no folder src/undertow")
    rounds = 2 * PAIRS if asked.quick else asked.rounds
    rows, same = [], True
    with tempfile.TemporaryDirectory() as folder:
        new = Build(HERE, Path(folder) / "new")
        old = Build(asked.other.resolve(), Path(folder) / "old")
        plans: list[tuple[str, int, Run]] = [
            *((name, rounds, methodcaller("ask", job)) for name, job in JOBS.items()),
            ("import", rounds // 2, methodcaller("start", IMPORT, empty=False)),
            ("start, second", rounds // 2, methodcaller("start", START, empty=False)),
            ("start, empty cache", max(3, rounds // 6), methodcaller("start", START, empty=True)),
            ("first plan, as installed", max(3, rounds // 12), methodcaller("first_answer")),
        ]
        seconds: dict[str, dict[Build, list[float]]] = {}
        results: dict[str, dict[Build, str]] = {}
        for _ in progress(range(PAIRS), "pairs of processes"):
            for name, count, run in plans:
                took = seconds.setdefault(name, {new: [], old: []})
                for build in (new, old):
                    run(build)
                for k in range(max(1, count // PAIRS)):
                    for build in (new, old) if k % 2 else (old, new):
                        one, results.setdefault(name, {})[build] = run(build)
                        took[build].append(one)
            for build in (new, old):
                build.again()
        for build in (new, old):
            build.process.terminate()
        for name, took in seconds.items():
            mean, low, high = interval(took[new], took[old])
            ours, theirs = (results[name][build] for build in (new, old))
            told = "same"
            if ours != theirs:
                same, told = False, f"{float.fromhex(ours) / float.fromhex(theirs) - 1:+.1e}"
            rows.append([
                name, str(len(took[new])),
                *(f"{1e3 * np.median(took[b]):.2f}" for b in (new, old)),
                f"{mean:.3f}", f"{low:.3f} to {high:.3f}", told,
            ])  # fmt: skip
    header = ["", "rounds", "this, ms", "other, ms", "ratio", "95 % interval", "results"]
    table("this build against another, in turn, one thread", header, rows)
    return 0 if same else 1


if __name__ == "__main__":
    sys.exit(main())
