"""A folder of results: checked before long work, written whole, never overwritten.

Files of an earlier run under the same names are moved into ``earlier-1``, ``earlier-2``, …
inside the folder, so no result is lost.
"""

from __future__ import annotations

import csv
import io
import json
import os
import platform
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from importlib import metadata
from pathlib import Path

from undertow.base.errors import ArtefactError

__all__ = ["check_folder", "to_csv", "to_json", "versions", "write_files"]

PACKAGES = ("undertow", "numpy", "scipy", "sympy", "numba", "matplotlib", "casadi")


def versions() -> dict[str, str | None]:
    """Return the versions of everything that shapes a result; ``None`` where absent."""
    found: dict[str, str | None] = {
        "python": platform.python_version(),
        "machine": f"{platform.system()} {platform.machine()}",
    }
    for package in PACKAGES:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            found[package] = None
    return found


def to_json(value: Mapping[str, object]) -> bytes:
    """Return a mapping as JSON text; NaN and infinity are refused."""
    return (json.dumps(value, indent=2, ensure_ascii=False, allow_nan=False) + "\n").encode()


def to_csv(header: Sequence[str], rows: Iterable[Sequence[object]]) -> bytes:
    """Return rows under a header as comma-separated values; ``None`` is an empty cell."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    return text.getvalue().encode()


def check_folder(folder: Path) -> None:
    """Make the folder and prove that it can be written, before any long work.

    Raises
    ------
    ArtefactError
        When it cannot.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise ArtefactError(
            f"results folder '{folder}'",
            value=error.strerror or str(error),
            limit="a folder that can be written",
            remedy="Name another one with --out",
        ) from error


def write_files(folder: Path, files: Mapping[str, bytes]) -> Path | None:
    """Write files, each whole or not at all, after moving earlier ones of the same names.

    Parameters
    ----------
    folder
        Made where it is not there.
    files
        Names to contents.

    Returns
    -------
    Path or None
        The folder that earlier files were moved to, if there were any.

    Raises
    ------
    ArtefactError
        When the disk refuses.
    """
    check_folder(folder)
    try:
        earlier = _keep_earlier(folder, files)
        for name, content in files.items():
            temporary = folder / f".{name}.{os.getpid()}.tmp"
            try:
                temporary.write_bytes(content)
                temporary.replace(folder / name)
            finally:
                temporary.unlink(missing_ok=True)
    except OSError as error:
        raise ArtefactError(
            f"results in '{folder}'",
            value=f"{error.strerror} ({error.filename})",
            limit="files that can be written",
            remedy="Free some space, or name another folder with --out",
        ) from error
    return earlier


def _keep_earlier(folder: Path, names: Iterable[str]) -> Path | None:
    present = [folder / name for name in names if (folder / name).exists()]
    if not present:
        return None
    number = 1
    while (folder / f"earlier-{number}").exists():
        number += 1
    earlier = folder / f"earlier-{number}"
    earlier.mkdir()
    for path in present:
        path.replace(earlier / path.name)
    return earlier
