"""Mechanisms by name: the library's, and one's own in a Python, URDF or MJCF file."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from pathlib import Path

from undertow.base import InvalidInputError, one_of
from undertow.mechanisms import LIBRARY
from undertow.models import Mechanism
from undertow.models.importers.equilibrium import WORDS, at_equilibrium, where
from undertow.models.importers.formats import FORMATS, file_words, format_of
from undertow.models.importers.python_file import in_a_file, mechanism_from_file
from undertow.models.importers.tree import Tree

_BEHIND = r"(?::(?P<joints>[^@]*))?(?:@(?P<target>.+))?"
_ENDS = "|".join(suffix.removeprefix(".") for suffix in FORMATS)
_DATA = re.compile(rf"(?P<file>.+?\.(?:{_ENDS})){_BEHIND}", re.IGNORECASE)
#: What looks like a file, of whatever format.
_FILE = re.compile(rf"(?P<file>.*?\.[A-Za-z]\w*){_BEHIND}")
_PLACE = re.compile(r"([^=]+)=([-+]?[\d.]+(?:[eE][-+]?\d+)?)(deg|rad|m)")


def named(name: str) -> Mechanism:
    """Return a mechanism by its name in the library, or one's own from a file.

    ``name``: a name of the library; ``FILE.py:NAME``, which runs the file; or ``FILE.urdf`` or
    ``FILE.xml``, which are data.  Behind those ``:JOINT,JOINT`` names the actuated joints where the
    file does not say which they are, ``:-JOINT`` freezes one; ``@upright``, ``@hanging``,
    ``@nearest`` or ``@JOINT=180deg`` says which equilibrium is the target, see
    :func:`~undertow.models.importers.at_equilibrium`. Raises InvalidInputError for an unknown name,
    and for a file of another format; ModelError when the file describes no such mechanism;
    ArtefactError when the file cannot be read or fails.
    """
    if in_a_file(name):
        return mechanism_from_file(name)
    data = DataName.of(name)
    if data is not None:
        read = format_of(data.file).mechanism
        driven, target = data.actuated or None, data.equilibrium
        if isinstance(target, str):
            return read(data.file, actuated=driven, frozen=data.frozen, equilibrium=target)
        return at_equilibrium(read(data.file, actuated=driven, frozen=data.frozen), target)
    if name not in LIBRARY and (file := _FILE.fullmatch(name)) is not None:
        format_of(Path(file["file"]))
    own = f"One of your own is FILE.py:NAME, {file_words()}"
    one_of("mechanism", name, LIBRARY, own)
    return LIBRARY[name]()


def tree_named(name: str) -> Tree | None:
    """Return the bodies and joints that a name means; ``None`` where it is not such a file.

    Joints that are frozen are fixed.

    Raises InvalidInputError, ModelError or ArtefactError as for :func:`named`.
    """
    data = DataName.of(name)
    if in_a_file(name) or data is None:
        return None
    tree = format_of(data.file).tree(data.file, not data.actuated)
    fixed = (replace(j, kind="fixed") if j.name in data.frozen else j for j in tree.joints)
    return replace(tree, joints=tuple(fixed))


def origin(name: str) -> dict[str, float]:
    """Where the target of a mechanism from a URDF or MJCF file is, in the file's coordinates.

    Raises InvalidInputError, ModelError or ArtefactError as for :func:`named`.
    """
    data = DataName.of(name)
    if data is None:
        return {}
    read = format_of(data.file).mechanism
    drawn = read(data.file, actuated=data.actuated or None, frozen=data.frozen)
    return where(drawn, data.equilibrium)[0]


def from_anywhere(name: str) -> str:
    """Return the name of a mechanism as it holds in any folder: paths of files are whole."""
    if in_a_file(name) and not name.endswith(".py"):
        path, _, inside = name.rpartition(":")
        return f"{Path(path).resolve()}:{inside}"
    data = DataName.of(name)
    return name if data is None else str(data.file.resolve()) + name[len(str(data.file)) :]


@dataclass(frozen=True)
class DataName:
    """What the name of a mechanism in a URDF or MJCF file says.

    ``actuated``, ``frozen``: names of joints; ``target``: its words, none for the nearest
    equilibrium that will do.
    """

    file: Path
    actuated: tuple[str, ...] = ()
    frozen: tuple[str, ...] = ()
    target: str = ""

    @classmethod
    def of(cls, name: str) -> DataName | None:
        """Take a name apart; None for one of another kind."""
        match = _DATA.fullmatch(name)
        if match is None:
            return None
        joints = [joint for joint in (match["joints"] or "").split(",") if joint]
        actuated = tuple(joint for joint in joints if not joint.startswith("-"))
        frozen = tuple(joint[1:] for joint in joints if joint.startswith("-"))
        return cls(Path(match["file"]), actuated, frozen, match["target"] or "")

    @property
    def equilibrium(self) -> str | dict[str, float]:
        """The target as :func:`~undertow.models.importers.at_equilibrium` takes it."""
        if not self.target or self.target in WORDS:
            return self.target
        places = {}
        for word in self.target.split(","):
            match = _PLACE.fullmatch(word)
            if match is None:
                raise InvalidInputError(
                    f"target of '{self.file.name}'",
                    value=repr(word),
                    limit=f"{', '.join(WORDS)}, or JOINT=VALUE with its unit, deg, rad or m",
                    remedy=f"Write for instance {self.file.name}@upright",
                )
            value = float(match[2])
            places[match[1]] = math.radians(value) if match[3] == "deg" else value
        return places
