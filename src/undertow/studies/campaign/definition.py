"""What a campaign is, as data: read strictly from a TOML file, carried to every worker."""

from __future__ import annotations

import hashlib
import json
import math
import tomllib
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, get_args

from undertow.base import ArtefactError, InvalidInputError, near, one_of, read_file
from undertow.mechanisms.named import DataName, from_anywhere, named
from undertow.models import Mechanism, by_names
from undertow.models.importers.formats import file_words
from undertow.models.importers.python_file import in_a_file
from undertow.objective import Goal, Objective, objective_for

#: Largest definition, bytes.
LARGEST = 1 << 20

#: Stands for a value that has to be there.
_NEEDED: Any = object()


@dataclass(frozen=True)
class Definition:
    """A campaign as data.

    ``mechanism``: its name, as for :func:`undertow.mechanisms.named.named`; paths are whole.
    ``text``: everything else that the file says, as JSON. ``code``: controllers of one's own that
    are entered, ``FILE.py:NAME`` with whole paths.
    """

    mechanism: str
    text: str
    code: tuple[str, ...] = ()

    @classmethod
    def read(cls, path: Path, mechanism: str | None = None, code: Sequence[str] = ()) -> Definition:
        """Read a TOML file.

        ``mechanism`` names the mechanism instead of the file.  It and ``code`` alone may be
        ``FILE.py:NAME``: a definition is data, and nothing that it says is run.

        Raises
        ------
        ArtefactError
            For a file that cannot be read or is no TOML.
        InvalidInputError
            For a mechanism that is missing, and for one in a Python file, which only
            ``mechanism`` may name.
        """
        content = read_file(path, "definition of a campaign", most=LARGEST)
        try:
            said = tomllib.loads(content.decode())
        except ValueError as error:  # of the text, or of its encoding
            raise ArtefactError(
                f"definition of a campaign '{path}'",
                value=str(error),
                limit="TOML",
                remedy="docs/campaigns.md shows one",
            ) from error
        several = said.get("mechanisms")
        first = several[0] if isinstance(several, list) and several else None
        name = said.pop("mechanism", first) if mechanism is None else mechanism
        said.pop("mechanism", None)
        if mechanism is not None:
            said.pop("mechanisms", None)
        if not isinstance(name, str):
            raise InvalidInputError(
                f"mechanism of the campaign '{path}'",
                value="none" if name is None else name,
                limit="a name, like 'acrobot'",
                remedy="Say mechanism = 'acrobot' in the file, or --mechanism",
            )
        if mechanism is None:
            name = _of_data(name, path)
            if isinstance(several, list):
                said["mechanisms"] = [
                    _of_data(one, path) if isinstance(one, str) else one for one in several
                ]
        whole = tuple(from_anywhere(one) for one in code)
        return replace(cls.of(from_anywhere(name), **said), code=whole)

    @classmethod
    def of(cls, mechanism: str, **said: Any) -> Definition:
        """Return the definition with these settings, plain numbers, words, lists and tables."""
        try:
            return cls(mechanism, json.dumps(said))
        except (TypeError, ValueError) as error:
            raise InvalidInputError(
                "settings of a campaign", value=str(error), limit="numbers, words, lists and tables"
            ) from error

    @property
    def said(self) -> dict[str, Any]:
        """What the file says, but for the mechanism."""
        found: dict[str, Any] = json.loads(self.text)
        return found

    @property
    def code_hashes(self) -> tuple[str, ...]:
        """SHA-256 of every file of ``code``, in its order."""
        files = (Path(one.rpartition(":")[0]) for one in self.code)
        read = (read_file(file, "a controller's file", most=LARGEST) for file in files)
        return tuple(hashlib.sha256(content).hexdigest() for content in read)

    @property
    def settings(self) -> Settings:
        """The same, to be taken one by one."""
        return Settings(self.said, "")


def _of_data(name: str, definition: Path) -> str:
    """Return the whole name of a mechanism that a definition names; files may lie beside it.

    Raises InvalidInputError for one in a Python file.
    """
    if in_a_file(name):
        raise InvalidInputError(
            f"mechanism of the campaign '{definition}'",
            value=name,
            limit=f"a name of the library, {file_words()}",
            remedy=f"Code of your own is named where it is run: --mechanism {name}",
        )
    data = DataName.of(name)
    if data is not None and (definition.parent / data.file).exists():
        name = str(definition.parent / name)
    return from_anywhere(name)


def _each_once(value: Any) -> bool:
    """Whether a value is a list of words, all different."""
    words = isinstance(value, list) and all(isinstance(one, str) for one in value)
    return words and len(set(value)) == len(value)


class Settings:
    """A table of settings that are taken one by one; what is left over is refused."""

    def __init__(self, values: Mapping[str, Any], where: str) -> None:
        self.where = where
        self._values = by_names("settings of a campaign", values)
        self._known: list[str] = []

    def what(self, name: str) -> str:
        """Say for a message which setting is meant."""
        return f"setting '{self.where}{name}' of the campaign"

    def _take(self, name: str, default: Any, limit: str, fits: Callable[[Any], bool]) -> Any:
        self._known.append(name)
        value = self._values.pop(name, default)
        if value is _NEEDED or not fits(value):
            shown = "nothing" if value is _NEEDED else value
            raise InvalidInputError(self.what(name), value=shown, limit=limit)
        return value

    def number(
        self, name: str, default: float = _NEEDED, *, low: float = -math.inf, high: float = math.inf
    ) -> float:
        """Take a number from ``low`` to ``high``."""
        limit = "a finite number"
        if low > -math.inf or high < math.inf:
            limit = f"a number from {low:g} to {high:g}"
        fits = lambda v: type(v) in (int, float) and math.isfinite(v) and low <= v <= high  # noqa: E731
        return float(self._take(name, default, limit, fits))

    def count(self, name: str, default: int = _NEEDED, *, low: int = 1, high: int = 10**9) -> int:
        """Take a whole number from ``low`` to ``high``."""
        limit = f"a whole number from {low} to {high}"
        return int(self._take(name, default, limit, lambda v: type(v) is int and low <= v <= high))

    def word(self, name: str, known: Collection[str], default: str = _NEEDED) -> str:
        """Take one of some words."""
        value = self._take(name, default, f"one of {', '.join(known)}", lambda _: True)
        one_of(self.what(name), value, known)
        return str(value)

    def flag(self, name: str) -> bool:
        """Take true or false; false by default."""
        return bool(self._take(name, False, "true or false", lambda v: type(v) is bool))

    def numbers(self, name: str, size: int) -> tuple[float, ...] | None:
        """Take a list of so many numbers, where there is one."""

        def fits(v: Any) -> bool:
            good = isinstance(v, list) and len(v) == size
            return good and all(type(x) in (int, float) and math.isfinite(x) for x in v)

        value = self._take(name, None, f"{size} numbers", lambda v: v is None or fits(v))
        return None if value is None else tuple(map(float, value))

    def words(self, name: str, known: Collection[str]) -> tuple[str, ...]:
        """Take a list of some of the words, all of them by default."""
        limit = f"a list, each once, from {', '.join(known)}"
        value = self._take(name, list(known), limit, lambda v: bool(v) and _each_once(v))
        for word in value:
            one_of(self.what(name), word, known)
        return tuple(value)

    def names(self, name: str) -> tuple[str, ...]:
        """Take a list of words, each once; an empty one by default."""
        return tuple(self._take(name, [], "a list of names, each once", _each_once))

    def table(self, name: str) -> Settings:
        """Take a table; an empty one by default."""
        value = self._take(name, {}, "a table", lambda v: isinstance(v, dict))
        return Settings(value, f"{self.where}{name}.")

    def by_name(self, known: Collection[str]) -> dict[str, float]:
        """Take all that is left as numbers by name."""
        for name in self._values:
            one_of(self.where.rstrip(".") or "settings", name, known)
        return {name: self.number(name) for name in list(self._values)}

    def tables(self, known: Collection[str]) -> dict[str, Settings]:
        """Take all that is left as tables by name."""
        for name in self._values:
            one_of(self.where.rstrip(".") or "settings", name, known)
        return {name: self.table(name) for name in list(self._values)}

    def finish(self) -> None:
        """Refuse what nobody has asked for."""
        for name, value in self._values.items():
            raise InvalidInputError(
                self.what(name),
                value=value,
                limit=f"one of {', '.join(self._known)}",
                remedy=near(name, self._known),
            )


def mechanism_of(definition: Definition, settings: Settings) -> Mechanism:
    """Return the mechanism, with the ``parameters`` and input ``limits`` that the settings give."""
    mechanism = named(definition.mechanism)
    values = settings.table("parameters").by_name([p.name for p in mechanism.parameters])
    limits = settings.table("limits").by_name([i.name for i in mechanism.inputs])
    mechanism = mechanism.with_parameters(**values)
    if limits:
        known = {i.name: i.limit for i in mechanism.inputs}
        mechanism = mechanism.with_input_limit(*(known | limits).values())
    return mechanism


def objective_of(
    mechanism: Mechanism, settings: Settings, horizon: float, usual: Goal = "energy"
) -> Objective:
    """Return what ``objective`` and ``horizon``, s, mean; both have a usual value."""
    word = settings.word("objective", get_args(Goal), usual)
    longest = settings.number("horizon", horizon, low=1e-3, high=1e4)
    return objective_for(mechanism, word, horizon=longest)
