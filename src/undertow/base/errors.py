"""Conditions that Undertow raises: each carries the offending value, the limit and the remedy.

One root, :class:`UndertowError`; a few conditions below it. Every message reads
*what is wrong: the value, the limit. The remedy.*
"""

from __future__ import annotations

import importlib
import os
import traceback
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from difflib import get_close_matches
from functools import partial
from typing import Any

#: This package: lines of its own are not where a user's file raised.
PACKAGE = os.path.dirname(os.path.dirname(__file__))


class UndertowError(Exception):
    """Root of all conditions raised by Undertow.

    Parameters
    ----------
    what
        What is wrong, in one clause.
    value
        The value that was met, or ``None`` where there is no single value.
    limit
        The limit that it should have kept, in words or numbers.
    remedy
        What the user can do about it, as a sentence.
    """

    def __init__(
        self, what: str, *, value: object = None, limit: object = None, remedy: str = ""
    ) -> None:
        self.what = what
        self.value = value
        self.limit = limit
        self.remedy = remedy
        facts = [
            f"{label} {fact}"
            for label, fact in (("got", value), ("must be", limit))
            if fact is not None
        ]
        message = what + (": " + ", ".join(facts) if facts else "")
        super().__init__(f"{message}. {remedy}" if remedy else message + ".")

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle it by its parts; value and limit, which may be anything, as text."""
        value, limit = (None if f is None else str(f) for f in (self.value, self.limit))
        return partial(type(self), value=value, limit=limit, remedy=self.remedy), (self.what,)


class InvalidInputError(UndertowError, ValueError):
    """A number, name or shape that was passed in cannot be used."""


class ModelError(UndertowError, ValueError):
    """A mechanism breaks an assumption of the class of systems treated here."""


class UnstableSurfaceError(UndertowError, ValueError):
    """A surface whose sliding dynamics are not exponentially stable, (35)-(36)."""


class SingularSurfaceError(UndertowError, ValueError):
    """The law does not exist: α_a − α_u M_uu⁻¹ M_auᵀ is singular there, (37)."""


class InfeasibleError(UndertowError):
    """No admissible surface was found for the task."""


class CertificateError(UndertowError):
    """A certificate that cannot be used: damaged, of another model, or of an unknown version."""


class MissingExtraError(UndertowError, ImportError):
    """An optional dependency is not installed."""


def require_extra(module: str, extra: str, need: str) -> Any:
    """Import an optional dependency, or say in one line what needs it and how to install it.

    Raises MissingExtraError when it is not installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise MissingExtraError(need, remedy=f"pip install 'undertow[{extra}]'") from error


class ArtefactError(UndertowError, OSError):
    """A file or folder could not be read or written."""


class ResourceError(UndertowError, OSError):
    """The system refuses memory, a thread, a process, a descriptor or room on its disk."""


@contextmanager
def or_refused(what: str, limit: str, remedy: str) -> Iterator[None]:
    """Turn what the system refuses about a file into one condition.

    Raises ArtefactError with the system's own words.
    """
    try:
        yield
    except UndertowError:  # said already
        raise
    except (OSError, ValueError) as error:  # a ValueError: of a zero byte in a name
        said = getattr(error, "strerror", None) or str(error)
        said = said.replace("embedded null byte", "a zero byte in its name")
        raise ArtefactError(what, value=said, limit=limit, remedy=remedy) from error


def printable(text: str) -> str:
    r"""Return a text with "?" for every control character, which a terminal would obey.

    >>> printable("an escape: \x1b[2J")
    'an escape: ?[2J'
    """
    return "".join(c if c.isprintable() else "?" for c in text)


def error_text(error: BaseException) -> str:
    """Return what an error of whatever kind says, after its name.

    >>> error_text(KeyError("x")), error_text(MemoryError())
    ("KeyError: 'x'", 'MemoryError')
    """
    return f"{type(error).__name__}: {error}" if str(error) else type(error).__name__


def a_kind(value: object) -> str:
    """Return the type of a value with its article.

    >>> a_kind(3), a_kind("x")
    ('an int', 'a str')
    """
    name = type(value).__name__
    return f"an {name}" if name[0].lower() in "aeiou" else f"a {name}"


def near(name: str, names: Iterable[str]) -> str:
    """Return "Did you mean …?" with the names that are like a wrong one; nothing where none is.

    >>> near("rotary_pendlum", ["cart_pendulum", "rotary_pendulum", "tora"])
    'Did you mean rotary_pendulum or cart_pendulum?'
    """
    found = get_close_matches(name, list(names), n=3)
    return f"Did you mean {' or '.join(found)}?" if found else ""


def raised_at(error: BaseException, file: str = "") -> str:
    """Return ", FILE line N" of the innermost line of a user's own that an error went through.

    ``error``: with its traceback. ``file``: the user's file; where it is left out, any outside of
    Undertow and of installed packages. Empty where there is no such line.
    """
    if isinstance(error, SyntaxError) and error.lineno and error.filename == file:
        return f", {file} line {error.lineno}"
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        ours = frame.filename.startswith(PACKAGE)
        if frame.filename == file if file else not ours and "-packages" not in frame.filename:
            return f", {frame.filename} line {frame.lineno}"
    return ""
