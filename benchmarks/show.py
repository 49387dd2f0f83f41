"""The live page: pictures a second in a browser, and what the server takes of a core.

`undertow show` serves a mechanism; a headless browser, Debian's chromium through Playwright where
both are there, looks on for some seconds while it moves, then while it is paused.  Without a
browser the server's share alone is printed.

    python benchmarks/show.py [--quick]
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from harness import command_line, table

BROWSERS = ("chromium", "chromium-browser", "google-chrome")


def seconds_of(process: int) -> float:
    """Seconds of the processor that a process, without its children, has used, s."""
    with open(f"/proc/{process}/stat", encoding="ascii") as file:
        fields = file.read().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


@contextmanager
def serving(name: str) -> Iterator[tuple[int, str]]:
    """Serve a mechanism; the process and the address of its page."""
    command = [sys.executable, "-u", "-m", "undertow", "show", name, "--no-browser", "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None  # it was asked for
        found = re.search(r"http://\S+", process.stdout.readline())
        if found is None:
            sys.exit(f"error: '{' '.join(command)}' served nothing")
        try:
            yield process.pid, found[0]
        finally:
            process.send_signal(signal.SIGINT)


@contextmanager
def page_of(address: str) -> Iterator[Any]:
    """A page in a browser; nothing where there is none."""
    found = next((path for name in BROWSERS if (path := shutil.which(name))), None)
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        found = None
    if found is None:
        yield None
        return
    with sync_playwright() as engine:
        browser = engine.chromium.launch(executable_path=found, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1280, "height": 820})
        page.goto(address)
        yield page
        browser.close()


def measured(page: Any, process: int, seconds: float) -> tuple[float | None, float]:
    """Pictures a second, and the server's share of a core, over some seconds."""
    began, used, rates = time.monotonic(), seconds_of(process), []
    while time.monotonic() < began + seconds:
        time.sleep(1.0)
        if page is not None:
            rates.append(page.evaluate("undertow.state.fps"))
    share = (seconds_of(process) - used) / (time.monotonic() - began)
    return (sum(rates) / len(rates) if rates else None), share


def main() -> int:
    """Show, look, print."""
    options = command_line(__doc__, clocks=False).parse_args()
    seconds = 3.0 if options.quick else 10.0
    rows, rates, shares = [], [], []
    for name in ("rotary_pendulum",) if options.quick else ("rotary_pendulum", "gantry_crane"):
        with serving(name) as (process, address), page_of(address) as page:
            time.sleep(2.0 if options.quick else 20.0)  # what is compiled the first time
            if page is not None:
                page.click("#reset")
                time.sleep(0.5)
            for what in ("moving", "paused"):
                if what == "paused" and page is not None:
                    page.click("#pause")
                rate, share = measured(page, process, seconds)
                shares += [share]
                rates += [] if rate is None else [rate]
                shown = "no browser" if rate is None else f"{rate:.0f}"
                rows.append((name, what, shown, f"{share:.0%}"))
    head = ("mechanism", "", "pictures a second", "server, of a core")
    table("undertow show, looked at", head, rows)
    if rates:
        print(f"least {min(rates):.0f} pictures a second (wanted ≥ 50)")
    print(f"most {max(shares):.0%} of a core without the optimiser's process (wanted ≤ 30 %)")
    return 0


if __name__ == "__main__":
    sys.exit(main())
