"""Memory and import time of fresh processes.

Each job runs in a process of its own, after a first run that fills the cache of generated
kernels.  *Peak* is the largest resident set that the system has seen of it; *import* is the
time of ``import undertow`` alone, by clocks inside the process, the median of several.
"""

from __future__ import annotations

from harness import command_line, progress, table  # isort: skip

import os
import statistics
import subprocess
import sys

RIG = "import undertow as ut; rig = ut.mechanisms.rotary_pendulum(d_e=0.025); "
JOBS = {
    "import": "import undertow",
    "one optimum, energy": RIG + "ut.Optimiser(ut.Cascade(rig, belief='exact').optimiser.loop)"
    ".require(rig.state(phi=ut.deg(41)))",
    "cascade, energy": RIG + "ut.Cascade(rig, belief='exact').simulate(phi=ut.deg(41))",
    "cascade, time": RIG + "ut.Cascade(rig, ut.MinimumTime(), belief='exact')"
    ".simulate(phi=ut.deg(41))",
    "cascade, time, reaching free": RIG + "ut.Cascade(rig, ut.MinimumTime(), "
    "freedom=ut.DecisionVariables(reaching=True), warm=ut.Budget(4000), belief='exact')"
    ".simulate(phi=ut.deg(41))",
    "cascade, energy, n = 4": "import undertow as ut; "
    "ut.Cascade(ut.mechanisms.triple_pendulum_on_a_cart(), belief='exact').simulate(duration=1.0)",
    "20,000 rollouts at once": RIG + "import numpy as np; p = np.tile([-1, -1.59, 1.96, 12.1], "
    "(20000, 1)); ut.ClosedLoop(rig).batch(rig.state(phi=0.5), p)",
}
TIMED = (
    "import time; wall, cpu = time.perf_counter(), time.process_time(); import undertow; "
    "print(time.perf_counter() - wall, time.process_time() - cpu)"
)


def peak(code: str) -> float:
    """Run a job in a fresh process and return its largest resident set, MB."""
    process = subprocess.Popen([sys.executable, "-c", code])
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        sys.exit(f"error: the job failed with status {process.returncode}:\n{code}")
    # Linux counts in KiB, macOS in bytes.
    return usage.ru_maxrss * (1024 if sys.platform != "darwin" else 1) / 1e6


def main() -> int:
    """Measure and print."""
    options = command_line(__doc__, clocks=False).parse_args()
    jobs = dict(list(JOBS.items())[:3]) if options.quick else JOBS
    rows = []
    for name, code in progress(list(jobs.items()), "jobs"):
        subprocess.run([sys.executable, "-c", code], check=True)
        rows.append((name, peak(code)))
    times = [
        [float(word) for word in subprocess.check_output([sys.executable, "-c", TIMED]).split()]
        for _ in progress(range(3 if options.quick else 9), "imports")
    ]
    title = "largest resident set of a fresh process"
    table(title, ["job", "peak, MB"], [[name, f"{size:.0f}"] for name, size in rows])
    largest = max(size for _, size in rows)
    wall, cpu = (statistics.median(column) for column in zip(*times, strict=True))
    print(f"\nlargest {largest:.0f} MB (wanted: below 500)")
    print(f"import, warm: median {wall:.2f} s, of the processor {cpu:.2f} s (wanted: below 1)")
    return 0


if __name__ == "__main__":
    sys.exit(main())
