"""Results as tables, text and files: one look, written whole, never overwritten.

Files of an earlier run under the same names are moved into ``earlier-1``, ``earlier-2``, …
inside the folder, so no result is lost.  Figures are saved by
:mod:`undertow.closed_loop.figures`.
"""

from __future__ import annotations

import csv
import errno
import io
import json
import math
import os
import platform
import re
import tempfile
import threading
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

from undertow.base.errors import ArtefactError, or_refused

if TYPE_CHECKING:  # Rich takes time to import, which a table is worth and an import is not
    from rich.console import RenderableType
    from rich.table import Table
    from rich.text import Text

#: What pictures are written: how their names end, by how their contents begin.
PICTURES = {b"\x89PNG": ".png", b"GIF8": ".gif"}

#: What a file has to be, and what to do where it is not.
_WRITABLE = "a file that can be written", "Choose another folder or name"

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


def manifest(what: str, request: Mapping[str, object], **more: object) -> bytes:
    """Return as JSON what made a result: the command, its versions and request, and more facts.

    Paths in the request are written as text; a number that is not finite is ``null``: no result is
    lost because one of its numbers is none.
    """
    asked = {k: str(v) if isinstance(v, Path) else v for k, v in request.items()}
    facts = _finite_only({"request": asked, **more})
    return to_json({"what": what, "versions": versions(), **facts})


def _finite_only(value: Any) -> Any:
    """Return JSON values with ``None`` for every number that is not finite."""
    if isinstance(value, Mapping):
        return {name: _finite_only(entry) for name, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_finite_only(entry) for entry in value]
    return finite(value) if isinstance(value, float) else value


def finite(value: float) -> float | None:
    """Return a number for a file; ``None``, an empty cell, where it is not finite."""
    return float(value) if math.isfinite(value) else None


def number(value: float | None, form: str, missing: str = "—") -> str:
    """Return a number for people in a format like ``".2f"``; a dash where there is none.

    >>> number(2.345, ".1f"), number(math.inf, ".4g"), number(None, "")
    ('2.3', '—', '—')
    """
    return missing if value is None or not math.isfinite(value) else format(value, form)


def table(
    heads: Sequence[str],
    rows: Iterable[Sequence[RenderableType]] = (),
    *,
    title: str = "",
    note: str = "",
    left: Collection[str] = (),
    whole: Collection[str] = (),
    ratios: Mapping[str, int] | None = None,
    ruled: bool = False,
    **look: Any,
) -> Table:
    """Return a table for the terminal, without a frame.

    Parameters
    ----------
    heads
        Of the columns.
    rows
        Cells; text is shown as it is, without markup.
    title, note
        Above and below the table; the title is bold.
    left
        Heads of columns that begin at the left, besides the first; numbers end at the right.
    whole
        Heads of columns whose cells are never broken, besides the first.
    ratios
        Heads of columns that share what width there is, the first one perhaps, in which parts:
        their cells may be broken.
    ruled
        Draw a line below the heads, which are bold then, and dim without it.
    **look
        Further properties of :class:`rich.table.Table`.
    """
    from rich import box
    from rich.cells import cell_len
    from rich.table import Table
    from rich.text import Text

    shape: dict[str, Any] = {"padding": (0, 2, 0, 0), "pad_edge": False, "box": None}
    if ruled:
        shape |= {"padding": (0, 1, 0, 0), "show_edge": False, "box": box.SIMPLE_HEAD}
    else:
        shape["header_style"] = "dim"
    if title:
        shown = f"{title}\n" if ruled else title
        shape |= {"title": shown, "title_style": "bold", "title_justify": "left"}
        shape["min_width"] = max(map(len, title.splitlines()))
    if note:
        shape |= {"caption": f"\n{note}\n", "caption_justify": "left"}
    made = Table(**shape | look)
    lines = [[Text(cell) if isinstance(cell, str) else cell for cell in row] for row in rows]
    for index, head in enumerate(heads):
        first = index == 0
        ratio = (ratios or {}).get(head)
        unbroken = ratio is None and (first or head in whole)
        column = [cell for line in lines for cell in line[index : index + 1]]  # a row may be short
        cells = [head, *(str(cell) for cell in column if isinstance(cell, Text))]
        widest = max(map(cell_len, "\n".join(cells).splitlines()), default=0)
        made.add_column(
            head,
            justify="left" if first or head in left else "right",
            no_wrap=unbroken,
            min_width=widest if unbroken else None,
            ratio=ratio,
        )
    for line in lines:
        made.add_row(*line)
    return made


def facts(rows: Iterable[tuple[RenderableType, RenderableType]], gap: int = 2) -> Table:
    """Return names, dim, and what they are, as two columns without heads."""
    from rich.table import Table
    from rich.text import Text

    grid = Table.grid(padding=(0, gap))
    grid.add_column(style="dim")
    grid.add_column()
    for row in rows:
        grid.add_row(*(Text(cell) if isinstance(cell, str) else cell for cell in row))
    return grid


def mark(good: bool) -> Text:
    """Return a green ✓ or a red ✗."""
    from rich.text import Text

    return Text("✓", style="green") if good else Text("✗", style="red")


def as_text(*shown: RenderableType) -> bytes:
    """Return what a terminal of 100 columns would show, as plain text."""
    from rich.console import Console

    text = io.StringIO()
    Console(width=100, highlight=False, file=text).print(*shown, sep="\n")
    return text.getvalue().encode()


def markdown_table(
    heads: Sequence[str], rows: Iterable[Sequence[object]], right: Collection[str] = ()
) -> list[str]:
    """Return the lines of a Markdown table; ``right`` are the heads of columns of numbers."""
    rule = ["---:" if head in right else "---" for head in heads]
    return [f"| {' | '.join(map(str, row))} |" for row in (heads, rule, *rows)]


def file_name(name: str) -> str:
    """Return a name of somebody's as the beginning of a file's: no folder, no control character.

    >>> file_name("../cart pole"), file_name("Wagen ü"), file_name("")
    ('__cart pole', 'Wagen ü', '_')
    """
    plain = re.sub(r'[/\\:*?"<>|]|^\.+', "_", name)
    return "".join(c if c.isprintable() else "_" for c in plain)[:100] or "_"


def check_folder(folder: Path, option: str = "") -> None:
    """Make the folder and prove that it can be written, before any long work.

    ``option``: of the command line, by which another one is named. Raises ArtefactError when it
    cannot.
    """
    what = "results folder" if option in ("", "--out") else f"folder of {option}"
    another = f"Name another one with {option}" if option else "Name another one"
    with or_refused(f"{what} '{folder}'", "a folder that can be written", another):
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()


@contextmanager
def whole(path: Path) -> Iterator[Path]:
    """Give a place to write to; what is there at the end becomes the file, or nothing does."""
    # Without the file's name, which may be as long as names can be.
    temporary = path.with_name(f".{os.getpid()}.{threading.get_ident()}.tmp")
    try:
        yield temporary
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def check_replaces(path: Path, begins: bytes) -> None:
    """Refuse to write over a file of another kind: one that does not begin as the new one does.

    A log or a definition that is named by mistake is not lost. Raises ArtefactError where there is
    one.
    """
    if not path.is_file():
        return
    with path.open("rb") as file:
        there = file.read(len(begins))
    if there not in (b"", begins):
        raise ArtefactError(
            f"file '{path}'",
            value="one of another kind, which is there already",
            limit="a new file, or an earlier one of the same kind",
            remedy="Choose another name",
        )


def check_place(path: Path, begins: bytes) -> None:
    """Prove that a file that begins so can be written at a place, before any long work.

    Raises ArtefactError as for :func:`write_file`.
    """
    _check_kind(path, begins)
    with or_refused(f"file '{path}'", *_WRITABLE):
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        check_replaces(path, begins)
        if path.is_file() or not path.exists():
            tempfile.TemporaryFile(dir=path.resolve().parent).close()


def _check_kind(path: Path, begins: bytes) -> None:
    """Refuse a picture that begins so under a name that ends as that of another kind."""
    kind = next((end for begin, end in PICTURES.items() if begins.startswith(begin)), "")
    if kind and path.suffix and path.suffix.lower() != kind:
        raise ArtefactError(
            f"picture '{path}'",
            value=f"a name that ends in {path.suffix}",
            limit=f"one in {kind}, which is what is written",
            remedy=f"Name it {path.with_suffix(kind)}",
        )


def write_file(path: Path, content: bytes) -> Path:
    """Write one file, whole or not at all, in place of an earlier one; return where it is.

    Raises ArtefactError when it cannot be written, where a file of another kind is there, and for a
    picture whose name ends as that of another kind.
    """
    begins = content[: 1 if content.startswith(b"{") else 4]  # JSON may be laid out in several ways
    _check_kind(path, begins)
    with or_refused(f"file '{path}'", *_WRITABLE):
        check_replaces(path, begins)
        if path.exists() and not path.is_file():  # a device or a pipe
            path.write_bytes(content)
        else:
            with whole(path.resolve()) as temporary:
                temporary.write_bytes(content)
    return path


def write_files(folder: Path, files: Mapping[str, bytes]) -> Path | None:
    """Write files, each whole or not at all, after moving earlier ones of the same names.

    ``folder``: made where it is not there. ``files``: names to contents; a name may have folders in
    it, divided by "/". Returns the folder that earlier files were moved to, if there were any.
    Raises ArtefactError when the disk refuses.
    """
    check_folder(folder)
    try:
        name = ""
        earlier = _keep_earlier(folder, files)
        for name, content in files.items():
            target = folder / name
            target.parent.mkdir(parents=True, exist_ok=True)
            with whole(target) as temporary:
                temporary.write_bytes(content)
    except OSError as error:
        raise ArtefactError(
            f"results in '{folder}'",
            value=f"{error.strerror} ({error.filename or folder / name})",
            limit="files that can be written",
            remedy="Free some space, or name another folder",
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
        kept = earlier / path.relative_to(folder)
        kept.parent.mkdir(parents=True, exist_ok=True)
        path.replace(kept)
    return earlier
