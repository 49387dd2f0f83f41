"""A ledger of results, written one by one: interrupted work continues where it ended."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from types import UnionType
from typing import Any, Generic, TypeVar, get_args, get_origin, get_type_hints

import numpy as np

from undertow.base import ArtefactError, error_text, parse_json, read_file, versions
from undertow.base.errors import or_refused

#: Largest ledger that is read, bytes.
LARGEST = 1 << 28

#: What was done, in words and numbers: one of a ledger's results.
Key = tuple[str | int | float, ...]

V = TypeVar("V")


class Ledger(Generic[V]):
    """Results by what was done; in memory, or in a file of JSON lines.

    ``path`` is the file, continued where there is one, ``None`` keeps nothing.  ``line`` is the
    type of a line: a tuple of the key's parts and, last, the result, made of numbers, words,
    arrays, tuples, mappings and dataclasses of these.  ``settings``, made of the same, are what all
    results have in common: they and the versions are the file's first line.  ``known`` has the
    results. Raises ArtefactError when the file is of other versions or settings, or cannot be read
    or written.
    """

    def __init__(self, path: Path | None, line: Any, settings: Mapping[str, Any]) -> None:
        self.path, self._line = path, line
        self.known: dict[Key, V] = {}
        if path is None:
            return
        head = json.dumps({"settings": plain(settings), "versions": versions()})
        value, limit, cause = "runs of other versions or settings", "those of now", None
        try:
            text = ""
            if os.path.lexists(path):
                text = read_file(path, "ledger", most=LARGEST).decode("utf-8")
            if not text:
                path.parent.mkdir(parents=True, exist_ok=True)
            if not text.endswith("\n"):  # a new one, or a run was killed while it wrote
                self._append("" if text else head)
            first, *lines = text.splitlines() or [head]
            if parse_json(first) == json.loads(head):
                for entry in _whole(lines):
                    self._take(entry)
                return
        except ArtefactError:
            raise
        except (OSError, ValueError, LookupError, TypeError, ArithmeticError) as error:
            cause, value = error, error_text(error)
            limit = "a ledger that can be read and written"
        remedy = "Name another folder, or remove the file"
        raise ArtefactError(f"ledger '{path}'", value=value, limit=limit, remedy=remedy) from cause

    def keep(self, key: Key, result: V) -> None:
        """Keep a result at once, as it would be read again."""
        line = json.dumps([*key, plain(result)], allow_nan=False)
        self._take(parse_json(line))
        if self.path is not None:
            self._append(line)

    def _take(self, entry: Any) -> None:
        *key, result = built(self._line, entry)
        self.known[tuple(key)] = result

    def _append(self, line: str) -> None:
        assert self.path is not None  # who asks has a file
        refusal = "a file that can be written", "Free some space: the same command goes on there"
        with (
            or_refused(f"ledger '{self.path}'", *refusal),
            self.path.open("a", encoding="utf-8") as file,
        ):
            file.write(f"{line}\n")


def _whole(lines: Iterable[str]) -> Iterator[Any]:
    """Yield what lines say, but for those that a run did not finish."""
    for line in lines:
        try:
            entry = parse_json(line)
        except ValueError:
            continue
        yield entry


def plain(value: Any) -> Any:
    """Return a result as JSON values: tables of a dataclass' fields, words for NaN and infinities.

    >>> plain((1, math.inf, np.eye(2)))
    [1, 'inf', [[1.0, 0.0], [0.0, 1.0]]]
    """
    if is_dataclass(value):
        return {f.name: plain(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, Mapping):
        return {name: plain(entry) for name, entry in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, tuple | list):
        return [plain(entry) for entry in value]
    return value if not isinstance(value, float) or math.isfinite(value) else str(value)


def built(kind: Any, said: Any) -> Any:
    """Return what :func:`plain` made JSON values of, by its type; what does not fit is refused.

    >>> built(tuple[str, float | None], ["cost", "inf"])
    ('cost', inf)

    Raises ValueError for a value of another type.
    """
    origin, args = get_origin(kind), get_args(kind)
    if origin is UnionType:
        for one in args:
            try:
                return built(one, said)
            except ValueError:
                continue
    elif origin is tuple and type(said) is list:
        kinds = args[:1] * len(said) if args[-1] is ... else args
        return tuple(built(one, entry) for one, entry in zip(kinds, said, strict=True))
    elif origin is dict and type(said) is dict:
        return {name: built(args[1], entry) for name, entry in said.items()}
    elif origin is np.ndarray and type(said) is list:
        return np.array(said, dtype=float)
    elif is_dataclass(kind) and type(said) is dict:
        hints = get_type_hints(kind)
        if {f.name for f in fields(kind)} == set(said):
            make: Any = kind
            return make(**{name: built(hints[name], entry) for name, entry in said.items()})
    elif kind is float and (type(said) in (int, float) or said in ("nan", "inf", "-inf")):
        return float(said)
    elif type(said) is kind:
        return said
    raise ValueError(f"no {getattr(kind, '__name__', kind)}: {str(said)[:80]}")
