"""A ledger of runs, written run by run: interrupted work continues where it ended."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Generic, TypeVar

from undertow.base import ArtefactError, error_text, parse_json, read_file

#: Largest ledger that is read, bytes.
LARGEST = 1 << 28

K = TypeVar("K")
V = TypeVar("V")


class Ledger(Generic[K, V]):
    """Results by what was run; in memory, or in a file of JSON lines.

    ``path`` is the file, continued where there is one, ``None`` keeps nothing; ``head`` what the
    runs have in common, versions and settings: its first line. ``read`` says of a further line
    which run it is, and its result; it raises for a line that is none. ``known`` has the results.

    Raises
    ------
    ArtefactError
        When the file is of other versions or settings, or cannot be read or written.
    """

    def __init__(
        self, path: Path | None, head: Mapping[str, Any], read: Callable[[Any], tuple[K, V]]
    ) -> None:
        self.path = path
        self.known: dict[K, V] = {}
        if path is None:
            return
        value, limit, cause = "runs of other versions or settings", "those of now", None
        try:
            text = ""
            if os.path.lexists(path):
                text = read_file(path, "ledger", most=LARGEST).decode("utf-8")
            if not text:
                path.parent.mkdir(parents=True, exist_ok=True)
            if not text.endswith("\n"):  # a new one, or a run was killed while it wrote
                self._append("" if text else json.dumps(head))
            first, *lines = text.splitlines() or [json.dumps(head)]
            if parse_json(first) == json.loads(json.dumps(head)):
                self.known.update(map(read, _whole(lines)))
                return
        except ArtefactError:
            raise
        except (
            OSError,
            ValueError,
            LookupError,
            TypeError,
            AttributeError,
            ArithmeticError,
        ) as error:
            cause, value = error, error_text(error)
            limit = "a ledger that can be read and written"
        remedy = "Name another folder, or remove the file"
        raise ArtefactError(f"ledger '{path}'", value=value, limit=limit, remedy=remedy) from cause

    def keep(self, key: K, result: V, line: list[Any]) -> V:
        """Keep a result at once, and return it; ``line`` is what is to be read again."""
        self.known[key] = result
        if self.path is not None:
            self._append(json.dumps(line, allow_nan=False))
        return result

    def _append(self, line: str) -> None:
        assert self.path is not None  # who asks has a file
        with self.path.open("a", encoding="utf-8") as file:
            file.write(f"{line}\n")


def _whole(lines: Iterable[str]) -> Iterator[Any]:
    """Yield what lines say, but for those that a run did not finish."""
    for line in lines:
        try:
            entry = parse_json(line)
        except ValueError:
            continue
        yield entry
