"""A ledger of runs: each is written down as it is made; long work goes on where it ended."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from undertow.base import ArtefactError, parse_json, read_file, versions
from undertow.studies.trials.trial import Outcome, Result

__all__ = ["Ledger"]


def _numbers(outcome: Outcome) -> Result:
    """Return what is kept of an outcome: all but its record."""
    return Result(**{field.name: getattr(outcome, field.name) for field in fields(Result)})


#: Types of the numbers of a result.
_KINDS: Mapping[str, tuple[type, ...]] = {
    field.name: {"int": (int,), "bool": (bool,)}.get(str(field.type), (int, float))
    for field in fields(Result)
}

#: Largest ledger that is read, bytes.
LARGEST = 1 << 28


class Ledger:
    """Results by controller, what was changed, by how much, and seed; in memory or in a file.

    Parameters
    ----------
    path
        File of JSON lines, continued where there is one; ``None`` keeps nothing.
    settings
        What the runs have in common: JSON values.

    Raises
    ------
    ArtefactError
        When the file is of other versions or settings, or cannot be written.
    """

    def __init__(self, path: Path | None, settings: Mapping[str, Any]) -> None:
        self.path = path
        self._known: dict[tuple[str, str, float, int], Result] = {}
        if path is None:
            return
        head = {"settings": dict(settings), "versions": versions()}
        try:
            text = ""
            if os.path.lexists(path):
                text = read_file(path, "ledger", most=LARGEST).decode("utf-8")
            lines = text.splitlines()
            if text and not text.endswith("\n"):  # a run was killed while it wrote
                with path.open("a", encoding="utf-8") as file:
                    file.write("\n")
            if not lines:
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(json.dumps(head) + "\n", encoding="utf-8")
            elif parse_json(lines[0]) != json.loads(json.dumps(head)):
                raise ArtefactError(
                    f"ledger '{path}'",
                    value="runs of other versions or settings",
                    limit="those of now",
                    remedy="Name another folder, or remove the file",
                )
            for line in lines[1:]:
                self._take(line)
        except ArtefactError:
            raise
        except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
            raise ArtefactError(
                f"ledger '{path}'",
                value=f"{type(error).__name__}: {error}",
                limit="a ledger that can be read and written",
                remedy="Name another folder, or remove the file",
            ) from error

    def _take(self, line: str) -> None:
        try:
            entry = parse_json(line)
        except ValueError:  # the last line of a run that was killed
            return
        name, what, value, numbers = entry
        kept: dict[str, Any] = {k: math.inf if v is None else v for k, v in numbers.items()}
        result = Result(**kept)
        whole = all(type(getattr(result, key)) in kinds for key, kinds in _KINDS.items())
        if not (isinstance(name, str) and isinstance(what, str) and whole):
            raise ValueError(f"a line that is no result: {line[:80]}")
        self._known[name, what, float(value), result.seed] = result

    def find(self, name: str, what: str, value: float, seed: int) -> Result | None:
        """Return the result of a run that was made already."""
        return self._known.get((name, what, value, seed))

    def keep(self, name: str, what: str, value: float, outcome: Outcome) -> Result:
        """Keep the result of a run at once."""
        result = self._known[name, what, value, outcome.seed] = _numbers(outcome)
        if self.path is not None:
            numbers = {k: v if math.isfinite(v) else None for k, v in asdict(result).items()}
            line = json.dumps([name, what, value, numbers], allow_nan=False)
            with self.path.open("a", encoding="utf-8") as file:
                file.write(f"{line}\n")
        return result
