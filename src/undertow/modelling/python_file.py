"""A mechanism of one's own from a Python file, for the command line."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

from undertow.errors import ArtefactError, InvalidInputError, UndertowError
from undertow.mechanism import Mechanism

__all__ = ["mechanism_from_file"]


def mechanism_from_file(text: str) -> Mechanism:
    """Load a mechanism of one's own: ``FILE.py:NAME``, a Mechanism or a function that makes one.

    Raises
    ------
    ArtefactError
        When the file cannot be read or fails.
    InvalidInputError
        When there is no mechanism under that name.
    """
    file, colon, name = text.rpartition(":")
    if not (colon and file.endswith(".py") and name.isidentifier()):
        raise InvalidInputError("mechanism of one's own", value=repr(text), limit="FILE.py:NAME")
    path = Path(file)
    module = ModuleType("undertow_user_mechanism")
    module.__file__ = str(path)
    try:
        # Not by an import: that would take yesterday's bytecode for a file of the same size
        # and second, and a certificate is about the file as it stands.
        exec(compile(path.read_bytes(), str(path), "exec"), vars(module))
        found = getattr(module, name, None)
        if callable(found):
            found = found()
    except UndertowError:
        raise
    except Exception as error:  # a user's file may do anything
        raise ArtefactError(
            f"mechanism file '{file}'", value=f"{type(error).__name__}: {error}", limit="it runs"
        ) from error
    if not isinstance(found, Mechanism):
        raise InvalidInputError(
            f"'{name}' in '{file}'",
            value=type(found).__name__,
            limit="undertow.Mechanism, or a function without arguments that returns one",
        )
    return found
