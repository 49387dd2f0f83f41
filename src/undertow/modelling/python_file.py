"""A mechanism, or a rig, of one's own from a Python file, for the command line."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType
from typing import Any

from undertow.errors import ArtefactError, InvalidInputError, UndertowError
from undertow.mechanism import Mechanism

__all__ = ["in_a_file", "mechanism_from_file", "object_from_file"]


def in_a_file(text: str) -> bool:
    """Whether a word of the command line is ``FILE.py:NAME``."""
    return ".py:" in text


def mechanism_from_file(text: str) -> Mechanism:
    """Load a mechanism of one's own: ``FILE.py:NAME``, a Mechanism or a function that makes one.

    Raises
    ------
    ArtefactError
        When the file cannot be read or fails.
    InvalidInputError
        When there is no mechanism under that name.
    """
    found = object_from_file(text, "mechanism")
    if not isinstance(found, Mechanism):
        file, _, name = text.rpartition(":")
        raise InvalidInputError(
            f"'{name}' in '{file}'",
            value=type(found).__name__,
            limit="undertow.Mechanism, or a function without arguments that returns one",
        )
    return found


def object_from_file(text: str, what: str) -> Any:
    """Run a Python file and return what one of its names holds; a callable is called.

    Parameters
    ----------
    text
        ``FILE.py:NAME``.
    what
        What is looked for, in a word, for messages.

    Raises
    ------
    ArtefactError
        When the file cannot be read or fails.
    InvalidInputError
        When the text is of another form.
    """
    file, colon, name = text.rpartition(":")
    if not (colon and file.endswith(".py") and name.isidentifier()):
        raise InvalidInputError(f"{what} of one's own", value=repr(text), limit="FILE.py:NAME")
    path = Path(file)
    module = ModuleType(f"undertow_user_{what}")
    module.__file__ = str(path)
    sys.modules[module.__name__] = module  # dataclasses look there
    folder = str(path.resolve().parent)
    if folder not in sys.path:  # as where Python runs the file itself
        sys.path.append(folder)
    try:
        # Not by an import: that would take yesterday's bytecode for a file of the same size
        # and second, and a certificate is about the file as it stands.
        exec(compile(path.read_bytes(), str(path), "exec"), vars(module))
        found = getattr(module, name, None)
        return found() if callable(found) else found
    except UndertowError:
        raise
    except Exception as error:  # a user's file may do anything
        raise ArtefactError(
            f"{what} file '{file}'",
            value=f"{type(error).__name__}: {error}",
            limit="a file that runs",
        ) from error
