"""The files of the page, and the one file that a motion is saved as."""

from __future__ import annotations

import json
import math
from functools import cache
from pathlib import Path
from typing import Any

#: Where the files of the page are; all that is served is in this folder, by name.
FOLDER = Path(__file__).with_name("page")

#: Name to type.  uPlot is Leon Sorokin's, MIT: ``uPlot.LICENSE``.
FILES = {
    "index.html": "text/html; charset=utf-8",
    "show.css": "text/css; charset=utf-8",
    "show.js": "text/javascript; charset=utf-8",
    "uPlot.min.css": "text/css; charset=utf-8",
    "uPlot.iife.min.js": "text/javascript; charset=utf-8",
    "uPlot.LICENSE": "text/plain; charset=utf-8",
}


@cache
def content(name: str) -> bytes:
    """Return the content of a file of the page."""
    return (FOLDER / name).read_bytes()


def encoded(message: dict[str, Any]) -> str:
    """Return a message as JSON: six digits of each number; nothing for what is not finite."""
    return json.dumps(_short(message), ensure_ascii=False, separators=(",", ":"), allow_nan=False)


def _short(value: Any) -> Any:
    if isinstance(value, float):
        return float(f"{value:.6g}") if math.isfinite(value) else None
    if isinstance(value, dict):
        return {name: _short(one) for name, one in value.items()}
    return [_short(one) for one in value] if isinstance(value, list | tuple) else value


def saved_page(hello: dict[str, Any]) -> bytes:
    """Return a recording as one HTML file, which replays in a browser without any other.

    Parameters
    ----------
    hello
        What a server would say first of the recording: JSON values.
    """
    page = content("index.html").decode()
    for name in ("uPlot.min.css", "show.css"):
        link = f'<link rel="stylesheet" href="{name}">'
        page = page.replace(link, f"<style>\n{content(name).decode()}</style>")
    data = encoded(hello).replace("<", "\\u003c")  # no text of a log ends the script that holds it
    recording = f'<script type="application/json" id="recording">{data}</script>\n'
    licence = f"<!--\n{content('uPlot.LICENSE').decode()}-->\n"
    for name in ("uPlot.iife.min.js", "show.js"):
        script = content(name).decode().replace("</script", "<\\/script")
        before = recording + licence if name.startswith("uPlot") else ""
        tag = f'<script src="{name}"></script>'
        page = page.replace(tag, f"{before}<script>\n{script}\n</script>")
    return page.encode()
