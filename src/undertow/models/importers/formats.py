"""Formats of the files that describe mechanisms, by the ends of their names: the one list of them.

A format is one line of :data:`FORMATS`; names on the command line, folders of models, campaigns and
help texts go by it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from undertow.base import one_of
from undertow.models.importers.mjcf import from_mjcf, read_mjcf
from undertow.models.importers.tree import Tree
from undertow.models.importers.urdf import from_urdf, read_urdf
from undertow.models.mechanism import Mechanism


@dataclass(frozen=True)
class Format:
    """How a format is read.

    ``name``: what people call it. ``mechanism``: a file to a mechanism, with ``actuated``,
    ``frozen`` and ``equilibrium``. ``tree``: a file to its bodies and joints, without the motors
    that it names where the second argument is false. ``motors``: whether every file says which
    joints are driven.
    """

    name: str
    mechanism: Callable[..., Mechanism]
    tree: Callable[[Path, bool], Tree]
    motors: bool


URDF = Format("URDF", from_urdf, lambda path, _: read_urdf(path)[0], motors=False)
MJCF = Format("MJCF", from_mjcf, lambda path, motors: read_mjcf(path, motors=motors), motors=True)

#: By the end of a file's name, in small letters.
FORMATS: Mapping[str, Format] = {".urdf": URDF, ".xml": MJCF, ".mjcf": MJCF}


def format_of(path: Path) -> Format:
    """Return the format of a file, by the end of its name.

    Raises InvalidInputError for one that is not in the list.

    Examples
    --------
    >>> format_of(Path("robot.URDF")).name
    'URDF'
    """
    suffix = path.suffix.lower()
    one_of(f"format of '{path.name}'", suffix, FORMATS, "Files that are run are FILE.py:NAME")
    return FORMATS[suffix]


def file_words() -> str:
    """Return how a file is written, for help and messages.

    >>> file_words()
    'FILE.urdf, FILE.xml or FILE.mjcf'
    """
    *first, last = (f"FILE{suffix}" for suffix in FORMATS)
    return f"{', '.join(first)} or {last}"
