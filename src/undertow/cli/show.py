"""A page that moves: a mechanism under its cascade, live, or what was recorded of it."""

from __future__ import annotations

import os
import sys
import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from undertow.base import check_folder, check_place, require_extra, write_file
from undertow.cli import options
from undertow.cli.parsing import mechanism_named, parse_start
from undertow.cli.terminal import command, needs, progress_bar
from undertow.cli.terminal import show as say
from undertow.models import Mechanism
from undertow.models.importers.formats import file_words
from undertow.objective import USUAL

if TYPE_CHECKING:
    from undertow.display.live import Show

#: How a log begins: an SQLite database.
SQLITE = b"SQLite format 3\0"


def _is_log(name: str) -> bool:
    """Whether a name is that of a log: by its ending, or by how the file begins."""
    path = Path(name)
    if not path.is_file():
        return name.endswith(".db")
    with path.open("rb") as file:
        return file.read(len(SQLITE)) == SQLITE


def _a_little_off(mechanism: Mechanism) -> list[str] | None:
    """Return a start near the target for a mechanism that has no usual one."""
    if mechanism.start:
        return None
    last = mechanism.coordinates[-1]
    return [f"{last.name}={'3deg' if last.unit == 'rad' else '0.05m'}"]


def _has_windows() -> bool:
    """Whether a browser would open a window, not take over the terminal."""
    shown = "DISPLAY" in os.environ or "WAYLAND_DISPLAY" in os.environ
    return shown or sys.platform in ("darwin", "win32")


def open_page(what: str, address: str, words: str, *, browser: bool = True) -> None:
    """Say where a page is, and open it where that opens a window."""
    say(f"{what} at {address}", words)
    if browser and _has_windows():
        webbrowser.open(address)


@command(
    "undertow show rotary_pendulum",
    "undertow show overhead_crane --objective bench-time",
    "undertow show robot.urdf:shoulder --start elbow=5deg",
    "undertow show run.db",
    "undertow show rotary_pendulum --save page.html",
)
def show(
    name: Annotated[
        str,
        typer.Argument(
            help=f"Mechanism of the library, or your own: FILE.py:NAME, {file_words()}, with "
            ":JOINT,JOINT for the actuated joints where the file does not name them; or the log "
            "of a run, FILE.db, also of one in progress.",
            metavar="NAME|LOG",
        ),
    ] = "rotary_pendulum",
    start: options.Start = None,
    objective: options.Goal = USUAL,
    setting: options.Settings = None,
    limit: options.Limits = None,
    period: float = 0.1,
    port: Annotated[int | None, typer.Option(min=0, max=65535)] = None,
    browser: bool = True,
    mechanism: str | None = None,
    save: Path | None = None,
    seed: options.Seed = 0,
) -> None:
    """Show a mechanism and its controller on a live page, on this machine alone.

    Pull it with the mouse, change its plant and its target, watch the surface jump. Ctrl-C ends it.

    Parameters
    ----------
    period
        Time between re-optimisations, s.
    port
        Port of 127.0.0.1; 0: any free one. Default: 8417, or another if that is taken.
    browser
        Open the page in the browser of this machine.
    mechanism : MECHANISM
        Your own mechanism that a log is about, FILE.py:NAME. The file that a log names is never run
        by itself.
    save : FILE.html
        Write one file that replays the log, or a simulated motion to the target, in any browser,
        and end.
    """
    from undertow.display.live import check_port, saved_page, serve
    from undertow.runtime import GrowingLog
    from undertow.studies import live

    if save is None:
        require_extra("websockets", "show", "the live page needs websockets")
        check_port(port or 0)
    else:
        check_folder(save.parent, "--save")
        check_place(save, b"<!do")
    log = _is_log(name)
    needs(log, "without a log", "for a log, FILE.db", "mechanism")
    needs(
        not log, "with a log", "for a mechanism: what a log shows has been",
        "start", "setting", "limit", "objective", "period", "seed",
    )  # fmt: skip
    needs(save is None, "with --save", "for a page that is served", "port", "browser")
    shown: Show
    with progress_bar() as progress:
        if log:
            progress(f"reading {name}", 0.3)
            if save is None and not GrowingLog(Path(name)).over:
                shown = live.Watched(Path(name), mechanism)
            else:
                recording = live.of_log(Path(name), mechanism)
                shown = live.Recorded(recording)
        else:
            model = mechanism_named(name, setting, limit)
            x0 = parse_start(model, start or _a_little_off(model))
            if save is not None:
                recording = live.recorded_run(name, model, x0, objective, period, seed, progress)
            else:
                progress("making ready", 0.3)
                shown = live.simulation(name, model, x0, objective, period, seed)
    if save is not None:
        written = write_file(save, saved_page(recording))
        say(f"Written to {written}: open it in a browser; it needs no other file")
        return

    def ready(address: str) -> None:
        open_page(name, address, "On this machine alone. Ctrl-C ends it", browser=browser)

    try:
        serve(shown, ready, port=port)
    finally:
        if isinstance(shown, live.Simulation):
            shown.close()
