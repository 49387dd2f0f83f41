"""Mechanisms by name: the library's, and one's own in a Python file."""

from __future__ import annotations

from undertow.errors import InvalidInputError, near
from undertow.mechanism import Mechanism
from undertow.mechanisms import LIBRARY
from undertow.modelling.python_file import in_a_file, mechanism_from_file

__all__ = ["named"]


def named(name: str) -> Mechanism:
    """Return a mechanism by its name in the library, or one's own by ``FILE.py:NAME``.

    Raises
    ------
    InvalidInputError
        For an unknown name.
    ArtefactError
        When the file cannot be read or fails.
    """
    if in_a_file(name):
        return mechanism_from_file(name)
    if name not in LIBRARY:
        raise InvalidInputError(
            "mechanism",
            value=repr(name),
            limit=f"one of {', '.join(LIBRARY)}",
            remedy=near(name, LIBRARY) or "One of your own is FILE.py:NAME",
        )
    return LIBRARY[name]()
