"""User-defined mechanisms and rigs from Python files, for the command line."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

from undertow.base import (
    ArtefactError,
    InvalidInputError,
    UndertowError,
    a_kind,
    checked,
    error_text,
    near,
    raised_at,
    read_file,
)
from undertow.models.mechanism import Mechanism

#: Largest file that is run, bytes.
LARGEST = 1 << 24


def in_a_file(text: str) -> bool:
    """Whether a command-line argument is ``FILE.py:NAME``, or ``FILE.py`` without a name."""
    return ".py:" in text or text.endswith(".py")


@checked
def mechanism_from_file(text: str) -> Mechanism:
    """Load a user-defined mechanism: ``FILE.py:NAME``, a Mechanism or a function that makes one.

    Raises
    ------
    ArtefactError
        When the file cannot be read or fails.
    InvalidInputError
        When there is no mechanism under that name.
    """
    found = object_from_file(text, "mechanism", _makes_mechanism)
    if not isinstance(found, Mechanism):
        file, _, name = text.rpartition(":")
        raise InvalidInputError(
            f"'{name}' in '{file}'",
            value=f"{found!r}, {a_kind(found)}"[:80],
            limit="undertow.Mechanism, or a function without arguments that returns one",
            remedy="Let the function return the mechanism that it makes",
        )
    return found


def _makes_mechanism(value: object) -> bool:
    """Whether a name of a file may be meant: a mechanism, or a function that could make one."""
    return isinstance(value, Mechanism) or inspect.isfunction(value)


def object_from_file(text: str, what: str, suits: Callable[[object], bool] = callable) -> Any:
    """Run a Python file and return what one of its names holds; a callable is called.

    See :func:`named_in_file`.
    """
    return named_in_file(text, what, suits, lambda found: found() if callable(found) else found)


def named_in_file(
    text: str,
    what: str,
    suits: Callable[[object], bool] = callable,
    use: Callable[[Any], Any] = lambda found: found,
) -> Any:
    """Run a Python file, and return what ``use`` makes of what one of its names holds.

    Without a name in ``FILE.py:NAME`` the message says which there are that ``suits`` says yes to;
    ``what`` is looked for, in a word, for messages. Raises ArtefactError when the file cannot be
    read or fails, with its line; InvalidInputError when the text is of another form, or the file
    has no such name; UndertowError for what the file itself met, with its line.
    """
    file, _, name = (text, "", "") if text.endswith(".py") else text.rpartition(":")
    if not (file.endswith(".py") and (name.isidentifier() or file == text)):
        raise InvalidInputError(
            f"{what} of one's own",
            value=repr(text),
            limit="FILE.py:NAME",
            remedy=f"Name the {what} after the file, like my_file.py:my_{what}",
        )
    path = Path(file)
    if not (name or path.is_file()):
        raise InvalidInputError(
            f"{what} of one's own",
            value=f"{text!r}, which is no file here",
            limit="FILE.py:NAME",
            remedy=f"Check the path, and name the {what} after it, like my_file.py:my_{what}",
        )
    source = read_file(path, f"{what} file", most=LARGEST)
    module = ModuleType(f"undertow_user_{what}")
    module.__file__ = str(path)
    sys.modules[module.__name__] = module  # dataclasses look there
    folder = str(path.resolve().parent)
    if folder not in sys.path:  # as where Python runs the file itself
        sys.path.append(folder)
    try:
        # Not by an import: that would take yesterday's bytecode for a file of the same size
        # and second, and a certificate is about the file as it stands.
        exec(compile(source, str(path), "exec"), vars(module))
        if name not in vars(module):
            raise _nameless(vars(module), name, file, suits)
        return use(vars(module)[name])
    except UndertowError as error:
        where = raised_at(error, str(path))
        if not where:
            raise
        raise type(error)(
            error.what + where, value=error.value, limit=error.limit, remedy=error.remedy
        ) from error
    except (Exception, SystemExit) as error:  # a user's file may do anything
        raise ArtefactError(
            f"{what} file '{file}'",
            value=f"{error_text(error)}{raised_at(error, str(path))}",
            limit="a file that runs",
            remedy="Run it by itself: python FILE.py",
        ) from error


def _nameless(
    names: Mapping[str, object], name: str, file: str, suits: Callable[[object], bool]
) -> InvalidInputError:
    """A name that a file has not, with those that it has."""
    # A function or class has the name of the module where it was made, an object that of its class.
    made = {k: v for k, v in names.items() if inspect.isfunction(v) or inspect.isclass(v)}
    brought = {k for k, v in made.items() if v.__module__ != names["__name__"]}
    here = [
        key
        for key, value in names.items()
        if not key.startswith("_") and key not in brought and suits(value)
    ]
    return InvalidInputError(
        f"'{file}'",
        value=f"no name {name!r}" if name else "no name behind it",
        limit=f"one of {', '.join(here)}" if here else "a file that defines it",
        remedy=near(name, here)
        or f"Name what the file defines: {file}:{here[0] if here else 'NAME'}",
    )
