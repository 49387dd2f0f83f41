"""A run that is watched: the fast step and its deadlines with ``undertow run --show`` and without.

Runs of the rotary pendulum on the realistic rig against the clock, in turn, each kind first as
often as the others: what else the machine does meets all alike.  *log* keeps a log, which is what
the page is drawn from; *show* is watched, too: somebody reads every picture over a web socket, or
with ``--browser`` a headless chromium draws them, which takes a core of its own.  Below are the
means with their 95 % intervals (Student's), and those of the differences within a round.  A page
costs nothing where the interval of a difference reaches down to zero.

    python benchmarks/watched.py [--quick] [--browser] [--rounds 8] [--seconds 10]
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
from collections.abc import Sequence
from tempfile import TemporaryDirectory
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


def run(seconds: float, words: Sequence[str], browser: bool = False) -> tuple[list[float], int]:
    """Make a run; its figures, and how many pictures were seen of it."""
    command = [sys.executable, "-m", "undertow", "run", "rotary_pendulum", "--rig", "realistic",
               "--seconds", f"{seconds:g}", *words]  # fmt: skip
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


def half_width(values: FloatArray) -> float:
    """Half of the 95 % interval of a mean."""
    spread = values.std(ddof=1) / np.sqrt(len(values))
    return float(student.ppf(0.975, len(values) - 1) * spread)


def interval(values: FloatArray) -> str:
    """Mean and 95 % interval."""
    middle, half = values.mean(), half_width(values)
    return f"{middle:.1f} [{middle - half:.1f}, {middle + half:.1f}]"


def main() -> int:
    """Run in turn, and compare."""
    parser = command_line(__doc__, "--browser", clocks=False)
    parser.add_argument("--rounds", type=int, help="how often each kind runs")
    parser.add_argument("--seconds", type=float, help="length of a run, s")
    parser.add_argument("--browser", action="store_true", help="a chromium looks on and draws")
    options = parser.parse_args()
    rounds = options.rounds or (2 if options.quick else 9)
    seconds = options.seconds or (2.0 if options.quick else 10.0)
    if rounds < 2:
        parser.error(f"--rounds: got {rounds}, must be at least 2: an interval needs a spread")
    found: dict[str, list[list[float]]] = {"plain": [], "log": [], "show": []}
    rows = []
    with TemporaryDirectory() as folder:
        log = ["--log", f"{folder}/run.db"]
        words = {"plain": [], "log": log, "show": [*log, "--show"]}
        run(1.0, words["show"])  # everything is compiled
        for k in progress(range(rounds), "round"):
            pictures = 0
            for i in range(3):
                kind = [*words][(i + k) % 3]
                figures, seen = run(seconds, words[kind], options.browser)
                found[kind].append(figures)
                pictures += seen
            last = zip(*(one[-1] for one in found.values()), strict=True)
            cells = [" / ".join(f"{v:g}" for v in figures) for figures in last]
            rows.append((str(k + 1), *cells, f"{pictures / seconds:.0f}"))
    table(f"plain / log / show, {seconds:g} s each", ("", *FIGURES, "pictures a second"), rows)
    plain, log_, show = (np.array(one) for one in found.values())
    lines, ends = [], []
    for i, name in enumerate(FIGURES):
        differences = [(show - log_)[:, i], (show - plain)[:, i]]
        lines.append((name, *(interval(one[:, i]) for one in (plain, log_, show)),
                      *map(interval, differences)))  # fmt: skip
        ends.append(differences[0].mean() - half_width(differences[0]))
    head = ("", "plain", "log", "show", "show − log", "show − plain")
    table("means, with 95 % intervals", head, lines)
    print(f"\nlargest cost of a page beyond doubt: {max(0.0, *ends):.1f} (wanted 0)")
    return 0


if __name__ == "__main__":
    sys.exit(main())
