"""Mechanisms by name: the library's, and one's own in a Python, URDF or MJCF file."""

from __future__ import annotations

from pathlib import Path

from undertow.base import one_of
from undertow.mechanisms import LIBRARY
from undertow.models import Mechanism
from undertow.models.importers.mjcf import from_mjcf, read_mjcf
from undertow.models.importers.python_file import in_a_file, mechanism_from_file
from undertow.models.importers.tree import Tree
from undertow.models.importers.urdf import from_urdf, read_urdf

#: Ends of the names of files that are data.
_FILES = {".urdf": from_urdf, ".xml": from_mjcf, ".mjcf": from_mjcf}


def named(name: str) -> Mechanism:
    """Return a mechanism by its name in the library, or one's own from a file.

    Parameters
    ----------
    name
        A name of the library; ``FILE.py:NAME``, which runs the file; or ``FILE.urdf`` or
        ``FILE.xml``, which are data, with ``:JOINT,JOINT`` behind for the actuated joints where
        the file does not say which they are.  The target of a file is all joints at zero.

    Raises
    ------
    InvalidInputError
        For an unknown name.
    ModelError
        When the file describes no such mechanism.
    ArtefactError
        When the file cannot be read or fails.
    """
    if in_a_file(name):
        return mechanism_from_file(name)
    file, joints = _in_data(name)
    if file is not None:
        return _FILES[file.suffix](file, actuated=joints)
    own = "One of your own is FILE.py:NAME, FILE.urdf or FILE.xml"
    one_of("mechanism", name, LIBRARY, own)
    return LIBRARY[name]()


def tree_named(name: str) -> Tree | None:
    """Return the bodies and joints that a name means; ``None`` where it is not such a file.

    Raises
    ------
    InvalidInputError, ModelError, ArtefactError
        As for :func:`named`.
    """
    file, joints = _in_data(name)
    if in_a_file(name) or file is None:
        return None
    return read_urdf(file)[0] if file.suffix == ".urdf" else read_mjcf(file, motors=not joints)


def from_anywhere(name: str) -> str:
    """Return the name of a mechanism as it holds in any folder: paths of files are whole."""
    if in_a_file(name) and not name.endswith(".py"):
        path, _, inside = name.rpartition(":")
        return f"{Path(path).resolve()}:{inside}"
    file, joints = _in_data(name)
    if file is None:
        return name
    return f"{file.resolve()}:{','.join(joints)}" if joints else str(file.resolve())


def _in_data(name: str) -> tuple[Path | None, list[str] | None]:
    """Return the file that holds a mechanism as data, and its actuated joints where given."""
    if Path(name).suffix in _FILES:
        return Path(name), None
    path, _, joints = name.rpartition(":")
    if Path(path).suffix in _FILES and joints:
        return Path(path), joints.split(",")
    return None, None
