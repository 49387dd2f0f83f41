"""Starting: the first answer after installation, then a second start.

Each start is a process of its own, on a copy of the package as pip leaves it, its modules compiled
to bytecode and nothing else, with a cache folder of its own.  It imports the package, builds a
mechanism from its energies, rolls its closed loop out once, which compiles the kernel, lets the
cascade (exact model, least energy) find its first plan, which compiles the optimiser, and runs the
usual cascade on a simulated rig for a tenth of a second, its first plan the best of 512 candidates,
which compiles rig, estimator and runtime.

Printed side by side for the largest mechanisms (n = 4) and the paper's: seconds of the processor
and of the clock, up to the answer, which is the first plan, and for each part.  The clock counts
what else the machine does; the processor's seconds do not.  The import of the libraries alone is
the least that a start can take.

With ``--quick`` the paper's mechanism alone is started.
"""

from __future__ import annotations

import itertools
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import undertow

from harness import command_line, mechanism_names  # isort: skip

NAMES = ("rotary_pendulum", "gantry_crane", "triple_pendulum_on_a_cart")

LIBRARIES = "import numba, numpy, scipy.linalg, sympy"

START = """
import json, sys, time
marks = [(0.0, float(sys.argv[2]))]
def mark():
    marks.append((time.process_time(), time.time()))
mark()
import undertow as ut
mark()
rig = ut.mechanisms.LIBRARY[sys.argv[1]]()
mark()
loop = ut.ClosedLoop(rig, ut.MinimumEnergy())
loop.simulate(rig.state(**rig.start), ut.first_surface(rig), duration=0.1)
mark()
ut.Cascade(rig, ut.MinimumEnergy(), belief="exact").start(rig.state(**rig.start))
mark()
ut.run(ut.Cascade(rig, cold=ut.Budget(512)), simulated=True, seconds=0.1)
mark()
print(json.dumps(marks))
"""

PARTS = ("interpreter", "import", "mechanism", "kernel", "answer", "run")

PACKAGE = Path(undertow.__file__).parent

#: Seconds of the processor and of the clock for each part.
Parts = list[tuple[float, float]]


def install(folder: Path, package: Path = PACKAGE) -> None:
    """Put a copy of the package into a folder, with its bytecode, as pip does."""
    shutil.copytree(package, folder / "undertow", ignore=shutil.ignore_patterns("__pycache__"))
    subprocess.run([sys.executable, "-m", "compileall", "-q", str(folder)], check=True)


def start(name: str, folder: Path) -> Parts:
    """Start one process with the package in a folder, and return what its parts took."""
    environment = {
        **os.environ,
        "UNDERTOW_CACHE": str(folder / "cache"),
        "PYTHONPATH": os.pathsep.join([str(folder), os.environ.get("PYTHONPATH", "")]),
    }
    answer = subprocess.run(
        [sys.executable, "-c", START, name, repr(time.time())],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    marks = json.loads(answer.stdout)
    return [(b[0] - a[0], b[1] - a[1]) for a, b in itertools.pairwise(marks)]


def libraries() -> tuple[float, float]:
    """Return what importing the libraries alone takes."""
    code = (
        "import time; wall = time.perf_counter()\n"
        f"{LIBRARIES}\n"
        "print(time.process_time(), time.perf_counter() - wall)"
    )
    answer = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    processor, clock = map(float, answer.stdout.split())
    return processor, clock


def row(name: str, parts: Parts) -> None:
    """Print a start: the time to the answer and each part, processor beside clock."""
    answer = tuple(sum(column) for column in zip(*parts[:-1], strict=True))
    cells = [f"{p:8.2f} {c:6.2f}" for p, c in (answer, *parts)]
    print(f"{name:40s}" + " ".join(cells), flush=True)


def main() -> int:
    """Start each mechanism."""
    parser = command_line(__doc__, "acrobot tora", clocks=False)
    mechanism_names(parser)
    options = parser.parse_args()
    chosen = options.names or (NAMES[:1] if options.quick else NAMES)
    heads = " ".join(f"{head:>15s}" for head in ("to the answer", *PARTS))
    print(f"{'s, processor and clock':40s}{heads}")
    for name in chosen:
        with tempfile.TemporaryDirectory() as place:
            folder = Path(place)
            install(folder)
            row(f"{name}, first start", start(name, folder))
            again = [start(name, folder) for _ in range(3)]
            row(f"{name}, second start", min(again, key=lambda parts: sum(p for p, _ in parts)))
    processor, clock = min(libraries() for _ in range(3))
    print(f"{'libraries alone':40s}{processor:8.2f} {clock:6.2f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
