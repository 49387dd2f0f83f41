"""Reading of files: plain files only, of a bounded size, checked before they are opened."""

from __future__ import annotations

import hashlib
import json
import math
import os
import stat
from pathlib import Path
from typing import Any

from undertow.base.errors import ArtefactError, or_refused

#: Longest whole number in JSON, digits.
DIGITS = 40

#: Largest file that is hashed, bytes.
HASHED = 1 << 24


def check_file(path: Path, what: str, *, most: int = 1 << 40, remedy: str = "") -> int:
    """Return the size of a plain file, bytes; anything else is refused before it is opened.

    Opening a pipe waits for its writer, reading a device may never end, and opening some devices
    changes their state. ``path``: a file, or a link to one. ``what``: for messages, like ``"log"``.
    ``most``: largest size, bytes. ``remedy``: what to do where there is no such file. Raises
    ArtefactError for what is missing, no plain file, or too large.
    """
    try:
        facts = os.stat(path)
    except (OSError, ValueError) as error:  # ValueError: a name with a zero in it
        value = error.strerror if isinstance(error, OSError) else str(error)
        raise ArtefactError(
            f"{what} '{path}'",
            value=(value or str(error)).lower(),
            limit="a file that can be read",
            remedy=remedy or "Check the path",
        ) from error
    if not stat.S_ISREG(facts.st_mode):
        raise ArtefactError(
            f"{what} '{path}'",
            value=_kind(facts.st_mode),
            limit="a plain file",
            remedy="Copy its content into a file, and name that",
        )
    if facts.st_size > most:
        raise ArtefactError(
            f"{what} '{path}'",
            value=f"{facts.st_size} bytes",
            limit=f"at most {most}",
            remedy="It is damaged or something else",
        )
    return facts.st_size


def _kind(mode: int) -> str:
    kinds = {
        stat.S_IFDIR: "a folder", stat.S_IFIFO: "a pipe", stat.S_IFSOCK: "a socket",
        stat.S_IFCHR: "a device", stat.S_IFBLK: "a device",
    }  # fmt: skip
    return kinds.get(stat.S_IFMT(mode), "no plain file")


def read_file(path: Path, what: str, *, most: int, remedy: str = "") -> bytes:
    """Return the content of a file, see :func:`check_file`.

    Raises ArtefactError for what cannot be read, is no plain file, or too large.
    """
    check_file(path, what, most=most, remedy=remedy)
    with or_refused(f"{what} '{path}'", "a file that can be read", remedy or "Check the path"):
        # What was a file a moment ago may be a pipe now: do not wait for its writer.
        handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0))
        with open(handle, "rb") as file:
            content = file.read(most + 1)
    if len(content) > most:
        raise ArtefactError(f"{what} '{path}'", value="still growing", limit=f"at most {most}")
    return content


def file_hash(path: Path, what: str) -> str:
    """Return SHA-256 of a file's content, in hexadecimal digits.

    Raises ArtefactError as for :func:`read_file`.
    """
    return hashlib.sha256(read_file(path, what, most=HASHED)).hexdigest()


def parse_json(content: str | bytes, *, finite: bool = True) -> Any:
    """Parse JSON strictly: no repeated keys, no overlong numbers, no deep nesting.

    ``content``: text, or its UTF-8. ``finite``: refuse NaN and infinities, which Python's JSON can
    write. Raises ValueError with what is wrong.
    """

    def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        found = dict(pairs)
        if len(found) != len(pairs):
            raise ValueError("a key is repeated")
        return found

    def number(text: str) -> float:
        value = float(text)
        if finite and not math.isfinite(value):
            raise ValueError(f"{text} is not finite")
        return value

    def whole(text: str) -> int:
        if len(text) > DIGITS:
            raise ValueError(f"a whole number of {len(text)} digits")
        return int(text)

    try:
        return json.loads(
            content if isinstance(content, str) else content.decode("utf-8"),
            object_pairs_hook=once,
            parse_constant=number,
            parse_float=number,
            parse_int=whole,
        )
    except RecursionError as error:
        raise ValueError("brackets nested too deep") from error
