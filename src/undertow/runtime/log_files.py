"""Logs for other programs: MCAP, which PlotJuggler and Foxglove open, and Parquet, for tables.

What is written is what :func:`undertow.runtime.read_log` reads: the same numbers, with their units.
Times are those since the start of the run: a log has no calendar.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from undertow.base import check_replaces, checked, require_extra, versions
from undertow.base.artefacts import whole
from undertow.base.errors import or_refused
from undertow.mechanisms import LIBRARY
from undertow.runtime.encoding import WHOLE, Columns
from undertow.runtime.log import ANSWERS
from undertow.runtime.recording import Recording

#: Units of the columns that are not of the mechanism.
_UNITS = {
    "t": "s", "clock": "s", "rig_t": "s", "late_us": "µs", "read_us": "µs", "step_us": "µs",
    "write_us": "µs",
}  # fmt: skip

#: What of an answer of the slow loop is shown; all of it is in the log alone.
_ANSWER = tuple(name for name in ANSWERS if name not in ("k", "body"))

#: Units of that; costs have that of the objective.
_OF_ANSWERS = {"use": "s", "seconds": "s"}

#: Foxglove's schema of a line of text, for the panel that shows them; 2 is information, 4 an error.
_LINE = {
    "type": "object",
    "title": "foxglove.Log",
    "properties": {
        "timestamp": {
            "type": "object",
            "title": "time",
            "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}},
        },
        "level": {"type": "integer"},
        "message": {"type": "string"},
        "name": {"type": "string"},
        "file": {"type": "string"},
        "line": {"type": "integer"},
    },
}


def column_units(recording: Recording) -> dict[str, str]:
    """Return the unit of each column of the steps; empty where there is none, or it is unknown.

    Logs of before version 0.3 do not say what their coordinates are measured in: theirs are known
    where the mechanism is one of the library.
    """
    meta = recording.meta
    coordinates, name = meta.get("coordinates", {}), meta.get("mechanism")
    if not coordinates and name in LIBRARY:
        coordinates = {c.name: c.unit for c in LIBRARY[name]().coordinates}
    known = {**coordinates, **meta.get("units", {})}
    groups, found = Columns.groups(recording.columns), {}
    own = {name for topic in ("state", "measured", "input", "demand") for name in groups[topic]}
    for column in recording.columns:
        if column in _UNITS or column not in own:  # the loop's, whatever a coordinate is called
            found[column] = _UNITS.get(column, "")
            continue
        plain = Columns.quantity(column)
        plain = plain if plain in known else plain.rstrip("_")
        rate = known.get(plain.removesuffix("_dot"), "") if plain.endswith("_dot") else ""
        found[column] = known.get(plain) or (f"{rate}/s" if rate else "")
    return found


@checked
def to_parquet(recording: Recording, path: str | Path) -> Path:
    """Write a log as one Parquet file, and return where it is.

    A column a quantity, a row a step; each field's metadata has its ``unit``.  The table's
    metadata ``undertow`` is JSON: ``meta``, ``events`` and ``answers`` of the log, null for what is
    not finite.

    Parameters
    ----------
    recording
        What :func:`undertow.runtime.read_log` returned.
    path
        The file; an earlier one is replaced.

    Raises
    ------
    MissingExtraError
        Without pyarrow.
    ArtefactError
        When it cannot be written.
    """
    need = "Parquet files need pyarrow"
    arrow = require_extra("pyarrow", "logs", need)
    parquet = require_extra("pyarrow.parquet", "logs", need)
    units = column_units(recording)
    fields, arrays = [], []
    for name, values in zip(recording.columns, recording.steps.T, strict=True):
        kind = arrow.int64() if name in WHOLE else arrow.float64()
        fields.append(arrow.field(name, kind, metadata={"unit": units[name]}))
        arrays.append(arrow.array(values, type=kind, from_pandas=name in WHOLE))
    rest = {name: getattr(recording, name) for name in ("meta", "events", "answers")}
    facts = {"undertow": _json(rest)}
    table = arrow.table(arrays, schema=arrow.schema(fields, metadata=facts))
    return _written(Path(path), b"PAR1", lambda stream: parquet.write_table(table, stream))


@checked
def to_mcap(recording: Recording, path: str | Path) -> Path:
    """Write a log as one MCAP file, and return where it is.

    Channels with JSON messages and their JSON schemas, one message a step: ``/state``,
    ``/measured``, ``/input``, ``/demand``, ``/surface`` and ``/loop``; ``/answers`` of the slow
    loop, and ``/events`` as lines of text.  What is not a number is left out.  The log's ``meta``
    is in the file's metadata ``undertow``, null for what is not finite.

    Parameters
    ----------
    recording
        What :func:`undertow.runtime.read_log` returned.
    path
        The file; an earlier one is replaced.

    Raises
    ------
    MissingExtraError
        Without mcap.
    ArtefactError
        When it cannot be written.
    """
    mcap = require_extra("mcap.writer", "logs", "MCAP files need mcap")
    write = lambda stream: _write_mcap(mcap.Writer(stream), recording)  # noqa: E731
    return _written(Path(path), b"\x89MCAP", write)


def _write_mcap(writer: Any, recording: Recording) -> None:
    writer.start(profile="", library=f"undertow {versions()['undertow'] or ''}".strip())
    units, groups = column_units(recording), Columns.groups(recording.columns)
    place = {name: index for index, name in enumerate(recording.columns)}

    def channel(topic: str, schema: dict[str, Any]) -> int:
        name = schema.get("title", f"undertow{topic.replace('/', '.')}")
        data = _json(schema).encode()
        number = writer.register_schema(name=name, encoding="jsonschema", data=data)
        found: int = writer.register_channel(topic=topic, message_encoding="json", schema_id=number)
        return found

    numbered = [
        (channel(f"/{topic}", _numbers({name: units[name] for name in names})),
         [(name, place[name]) for name in names])
        for topic, names in groups.items()
    ]  # fmt: skip
    of_answers = {"k": "", **dict.fromkeys(_ANSWER, ""), **_OF_ANSWERS}
    answers = channel("/answers", _numbers(of_answers, loose=True))
    events = channel("/events", _LINE)
    lines = sorted(_lines(recording, answers, events), key=lambda line: line[0])
    ahead = 0
    for row in recording.steps:
        t = row[place["t"]]
        while ahead < len(lines) and lines[ahead][0] <= t:
            _message(writer, ahead, *lines[ahead])
            ahead += 1
        for number, names in numbered:
            said = {name: row[k] for name, k in names if math.isfinite(row[k])}
            _message(writer, int(row[place["k"]]), t, number, said)
    for k in range(ahead, len(lines)):
        _message(writer, k, *lines[k])
    facts = {key: _json(value) for key, value in recording.meta.items()}
    writer.add_metadata("undertow", facts)
    writer.finish()


def _numbers(units: dict[str, str], *, loose: bool = False) -> dict[str, Any]:
    """Return the JSON schema of numbers by name, their units as descriptions."""
    one = {} if loose else {"type": "number"}
    fields = {name: {**one, "description": unit} for name, unit in units.items()}
    return {"type": "object", "properties": fields}


def _lines(
    recording: Recording, answers: int, events: int
) -> Iterator[tuple[float, int, dict[str, Any]]]:
    """Yield what came between the steps: when, on which channel, and what."""
    times = dict(zip(recording["k"].tolist(), recording["t"].tolist(), strict=True))
    for answer in recording.answers:
        told = {name: answer[name] for name in ("k", *_ANSWER) if _says(answer[name])}
        yield times.get(answer["k"], 0.0), answers, told
    for _, t, kind, text in recording.events:
        sec, part = divmod(t, 1.0)
        yield t, events, {
            "timestamp": {"sec": int(sec), "nsec": int(1e9 * part)},
            "level": 4 if kind in ("alarm", "fault") else 2,
            "message": f"{kind}: {text}", "name": kind, "file": "", "line": 0,
        }  # fmt: skip


def _says(value: object) -> bool:
    """Whether a value says something: nothing, NaN and infinities do not."""
    return value is not None and (not isinstance(value, float) or math.isfinite(value))


def _message(writer: Any, sequence: int, t: float, channel: int, said: dict[str, Any]) -> None:
    when = max(0, round(1e9 * t))
    writer.add_message(
        channel, log_time=when, publish_time=when, sequence=sequence, data=_json(said).encode()
    )


def _json(value: object) -> str:
    return json.dumps(_plain(value), ensure_ascii=False, allow_nan=False)


def _plain(value: Any) -> Any:
    """Return a value as JSON has it: null for NaN and infinities, for which that has no word."""
    if isinstance(value, Mapping):
        return {str(key): _plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(one) for one in value]
    value = value.item() if isinstance(value, np.generic) else value
    if not _says(value):
        return None
    return value if isinstance(value, str | int | float) else str(value)


def _written(path: Path, begins: bytes, write: Callable[[BinaryIO], None]) -> Path:
    """Write a file that appears whole or not at all, and never over one that begins otherwise."""
    refusal = "a file that can be written", "Choose another folder"
    with or_refused(f"file '{path}'", *refusal):
        check_replaces(path, begins)
        with whole(path) as draft, open(draft, "wb") as stream:
            write(stream)
    return path
