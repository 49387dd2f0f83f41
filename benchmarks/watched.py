"""A run that is watched: the fast step and its deadlines with ``undertow run --show`` and without.

Runs of the rotary pendulum on the realistic rig against the clock, in turn, first one and then the
other in front: what else the machine does meets both alike.  Somebody looks on over a web socket
and reads every picture; with ``--browser`` a headless chromium draws them, which takes a core of
its own.  Each row is a pair; below are the means with their 95 % intervals (Student's), and those
of the differences.  A page costs nothing where the interval of a difference reaches down to zero.

    python benchmarks/watched.py [--quick] [--browser] [--pairs 8] [--seconds 10]
"""

from __future__ import annotations

from harness import command_line, need, progress, table  # isort: skip  first: one thread

import json
import os
import re
import shutil
import subprocess
import sys
import threading
from typing import IO

import numpy as np
from scipy.stats import t as student

from undertow.models import FloatArray

#: What is measured of a run, and its unit; where it stands in what the run prints.
FIGURES = {
    "p99 of the fast step, µs": r"computation of the fast step +[\d,]+ +([\d,]+)",
    "p99, due to written, µs": r"due to written +[\d,]+ +([\d,]+)",
    "missed deadlines": r"missed deadlines[^\n]*? ([\d,]+) \(",
    "skipped periods": r"([\d,]+)\s+periods\s+skipped",
}


def look(address: str, browser: bool, seen: list[int]) -> None:
    """Look at a page until its run is over, and count the pictures that came."""
    if browser:
        found = next(filter(None, map(shutil.which, ("chromium", "google-chrome"))), None)
        with need("playwright.sync_api", "dev").sync_playwright() as engine:
            page = engine.chromium.launch(executable_path=found, args=["--no-sandbox"]).new_page()
            page.goto(address)
            while page.evaluate("undertow.state.live"):
                page.wait_for_timeout(500)
            seen.append(page.evaluate("undertow.frames.length"))
        return
    client = need("websockets.sync.client", "show")
    origin, count = address[: address.index("/", 8)], 0
    with client.connect(
        address.replace("http", "ws") + "socket", origin=origin, proxy=None, max_size=None
    ) as socket:
        for text in socket:
            message = json.loads(text)
            count += message["kind"] == "frame"
            if message["kind"] == "hello" and not message["live"]:
                break  # the run is over, and this is all of it
    seen.append(count)


def run(seconds: float, watched: bool, browser: bool) -> tuple[list[float], int]:
    """Make a run; its figures, and how many pictures were seen of it."""
    command = [sys.executable, "-m", "undertow", "run", "rotary_pendulum", "--rig", "realistic",
               "--seconds", f"{seconds:g}", *["--show"] * watched]  # fmt: skip
    environment = {**os.environ, "COLUMNS": "200", "PYTHONUNBUFFERED": "1"}
    printed, seen, viewer = "", list[int](), None
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, stdin=subprocess.DEVNULL,
        text=True, env=environment,
    ) as process:  # fmt: skip
        output: IO[str] | None = process.stdout
        assert output is not None  # it was asked for
        for line in output:
            printed += line
            if viewer is None and (found := re.search(r"http://\S+", line)):
                viewer = threading.Thread(target=look, args=(found[0], browser, seen))
                viewer.start()
    if viewer is not None:
        viewer.join()
    figures = [re.search(pattern, printed) for pattern in FIGURES.values()]
    if not all(figures):
        sys.exit(f"error: '{' '.join(command)}' ended with {process.returncode}:\n{printed}")
    return [float(one[1].replace(",", "")) for one in figures if one], sum(seen)


def interval(values: FloatArray) -> str:
    """Mean and 95 % interval."""
    half = student.ppf(0.975, len(values) - 1) * values.std(ddof=1) / np.sqrt(len(values))
    return f"{values.mean():.1f} [{values.mean() - half:.1f}, {values.mean() + half:.1f}]"


def main() -> int:
    """Run in turn, and compare."""
    parser = command_line(__doc__, "--browser", clocks=False)
    parser.add_argument("--pairs", type=int, help="pairs of runs")
    parser.add_argument("--seconds", type=float, help="length of a run, s")
    parser.add_argument("--browser", action="store_true", help="a chromium looks on and draws")
    options = parser.parse_args()
    pairs = options.pairs or (2 if options.quick else 8)
    seconds = options.seconds or (2.0 if options.quick else 10.0)
    if pairs < 2:
        parser.error(f"--pairs: got {pairs}, must be at least 2: an interval needs a spread")
    run(1.0, True, False)  # everything is compiled
    without, beside, rows = [], [], []
    for k in progress(range(pairs), "pair"):
        both = {w: run(seconds, w, options.browser) for w in ((False, True), (True, False))[k % 2]}
        without.append(both[False][0])
        beside.append(both[True][0])
        cells = [f"{a:g} / {b:g}" for a, b in zip(without[-1], beside[-1], strict=True)]
        rows.append((str(k + 1), *cells, f"{both[True][1] / seconds:.0f}"))
    table(f"without / with --show, {seconds:g} s each", ("", *FIGURES, "pictures a second"), rows)
    plain, shown = np.array(without), np.array(beside)
    more = shown - plain
    lines = [
        (name, interval(plain[:, i]), interval(shown[:, i]), interval(more[:, i]))
        for i, name in enumerate(FIGURES)
    ]
    table("means, with 95 % intervals", ("", "without", "with --show", "difference"), lines)
    low = [float(interval(column).split("[")[1].split(",")[0]) for column in more.T]
    print(f"\nlowest ends of the differences' intervals: largest {max(low):.1f} (wanted ≤ 0)")
    return 0


if __name__ == "__main__":
    sys.exit(main())
