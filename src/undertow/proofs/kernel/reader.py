"""Reads a certificate: strictly, as ``docs/certificate-format.md`` says, and nothing else."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

from undertow.proofs.kernel.model import Law, Matrix, Model, Quantity

FORMAT, VERSION = "undertow-certificate", 2

#: Limits: bytes, nesting, nodes, positions, parameters, subjects and claims, characters.
LARGEST, DEEPEST, MOST_NODES, MOST_POSITIONS, MOST_PARAMETERS, MOST_CLAIMS = (
    4_000_000, 16, 20_000, 12, 200, 1000,
)  # fmt: skip

_HEX = re.compile(r"-?0x[01]\.[0-9a-f]{13}p[+-](?:0|[1-9][0-9]{0,3})", re.ASCII)
_RATIO = re.compile(r"-?(?:0|[1-9][0-9]*)(?:/(?:0|[1-9][0-9]*))?", re.ASCII)

_LEAST, _MOST = Fraction(1, 2**1074), Fraction(2**1024 - 2**971)  # of doubles

_LEAVES = {"position", "velocity", "parameter"}
_ONE = {"neg", "sqrt", "sin", "cos", "tanh", "exp", "log"}
_TWO = {"add", "sub", "mul", "div"}


class Refused(ValueError):  # noqa: N818
    """A file that is no certificate of this version, and what is wrong with it."""


def require(good: bool, what: str) -> None:
    """Refuse what is not good."""
    if not good:
        raise Refused(what)


def canonical(value: Any) -> bytes:
    """Return the canonical text of a JSON value."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=False).encode()


def digest(value: Any) -> str:
    """Return the hash of a JSON value."""
    return hashlib.sha256(canonical(value)).hexdigest()


# -- values ---------------------------------------------------------------------------------------


def number(text: Any) -> Fraction:
    """Read a number text."""
    require(isinstance(text, str) and len(text) <= 420, "a number text of at most 420 characters")
    if _HEX.fullmatch(text):
        exponent = int(text.partition("p")[2])
        require(-1022 <= exponent <= 1023, f"exponent {exponent} of a binary double")
        value = Fraction(float.fromhex(text))
    else:
        require(_RATIO.fullmatch(text) is not None, f"number {text[:40]!r}")
        above, _, below = text.partition("/")
        require(not below or int(below) > 0, f"number {text[:40]!r}: a divisor of 0")
        value = Fraction(int(above), int(below or 1))
    good = not value or _LEAST <= abs(value) <= _MOST
    require(good, f"number {text[:40]!r}: 0, or of the size of a double")
    return value


def numbers(data: Any, count: int) -> tuple[Fraction, ...]:
    """Read a list of number texts."""
    return tuple(number(v) for v in _list(data, count))


def matrix(data: Any, rows: int, columns: int) -> Matrix:
    """Read a matrix of number texts."""
    return tuple(numbers(row, columns) for row in _list(data, rows))


def interval(data: Any) -> tuple[Fraction, Fraction]:
    """Read [low, high]."""
    low, high = numbers(data, 2)
    require(low <= high, "an interval with low ≤ high")
    return low, high


def box(data: Any, known: Mapping[str, Fraction | None]) -> dict[str, tuple[Fraction, Fraction]]:
    """Read a box of known names, around their values where they have one."""
    require(isinstance(data, dict), "a box: an object")
    out = {}
    for name, ends in data.items():
        require(name in known, f"a box of {name[:64]!r}, which the model does not have there")
        low, high = out[name] = interval(ends)
        inside = known[name]
        good = inside is None or low <= inside <= high
        require(good, f"a box of {name!r} without its {float(inside or 0):g}")
    return out


def fields(data: Any, what: str, keys: Collection[str], more: Collection[str] = ()) -> Any:
    """Check that an object has these keys, and at most some more."""
    require(isinstance(data, dict), f"{what}: an object")
    wrong = sorted({*data} - {*keys, *more}) + sorted({*keys} - {*data})
    require(not wrong, f"{what}: unknown or missing {', '.join(map(repr, wrong))[:80]}")
    return data


def _list(data: Any, low: int, high: int | None = None) -> Any:
    most = low if high is None else high
    require(isinstance(data, list) and low <= len(data) <= most, f"a list of {low} to {most}")
    return data


def _name(text: Any) -> str:
    good = isinstance(text, str) and 1 <= len(text) <= 64 and not text[0].isdigit()
    require(good and all(c == "_" or c.isalnum() for c in text), f"name {str(text)[:64]!r}")
    return str(text)


def _short(text: Any, most: int) -> str:
    good = isinstance(text, str) and len(text) <= most and text.isprintable()
    require(good, f"a text of at most {most} printable characters")
    return str(text)


def _index(value: Any, end: int) -> int:
    require(isinstance(value, int) and 0 <= value < end, f"index {value!r} below {end}")
    return int(value)


# -- parts ----------------------------------------------------------------------------------------


def _quantity(data: Any, extra: str = "") -> Quantity:
    fields(data, "a quantity", {"name", "unit", *([extra] if extra else [])})
    value = None if not extra or data[extra] is None else number(data[extra])
    require(extra != "value" or value is not None, "a parameter's value")
    require(extra != "limit" or value is None or value > 0, "an input limit > 0")
    return Quantity(_name(data["name"]), _short(data["unit"], 16), value)


def _node(data: Any, before: int, n: int, parameters: int) -> tuple[Any, ...]:
    _list(data, 1, 3)
    kind, count = data[0], len(data) - 1
    require(isinstance(kind, str), "a node's kind")
    if kind == "number" and count == 1:
        return (kind, number(data[1]))
    if kind in _LEAVES and count == 1:
        return (kind, _index(data[1], parameters if kind == "parameter" else n))
    if kind == "pow" and count == 2:
        power = _index(data[2], 65)
        require(power >= 2, "a power of 2 to 64")
        return (kind, _index(data[1], before), power)
    known = {0: {"pi"}, 1: _ONE, 2: _TWO}[count]
    require(kind in known, f"node {kind[:40]!r} of {count} operands")
    return (kind, *(_index(k, before) for k in data[1:]))


def read_model(data: Any) -> Model:
    """Read a mechanism.

    Raises
    ------
    Refused
        For what this version does not know.
    """
    keys = {"name", "positions", "inputs", "parameters", "nodes", "M", "f", "B"}
    fields(data, "model", keys)
    positions = tuple(_quantity(v) for v in _list(data["positions"], 2, MOST_POSITIONS))
    n = len(positions)
    inputs = tuple(_quantity(v, "limit") for v in _list(data["inputs"], 1, n - 1))
    m = len(inputs)
    parameters = tuple(_quantity(v, "value") for v in _list(data["parameters"], 0, MOST_PARAMETERS))
    nodes = tuple(
        _node(v, k, n, len(parameters)) for k, v in enumerate(_list(data["nodes"], 1, MOST_NODES))
    )
    end = len(nodes)

    def row(indices: Any, count: int) -> tuple[int, ...]:
        return tuple(_index(k, end) for k in _list(indices, count))

    model = Model(
        _short(data["name"], 64), positions, inputs, parameters, nodes,
        tuple(row(r, i + 1) for i, r in enumerate(_list(data["M"], n))),
        row(data["f"], n),
        tuple(row(r, m) for r in _list(data["B"], m)),
    )  # fmt: skip
    names = [*model.states, *(p.name for p in parameters)]
    require(len({*names}) == len(names), "different names of positions, rates and parameters")
    moving = [kind == "velocity" for kind, *_ in nodes]
    for k, (kind, *rest) in enumerate(nodes):
        if kind not in {*_LEAVES, "number"}:
            moving[k] = any(moving[j] for j in (rest[:1] if kind == "pow" else rest))
    still = [k for r in (*model.M, *model.B) for k in r]
    require(not any(moving[k] for k in still), "M and B without velocities")
    return model


def read_law(data: Any, model: Model) -> Law:
    """Read a law."""
    keys = ("alpha_a", "lambda_a", "alpha_u", "lambda_u", "eta", "layer", "switching")
    fields(data, "law", {*keys, "disturbance"})
    n, m = model.n, model.m
    a, b, c, d = (matrix(data[k], m, m if k.endswith("_a") else n - m) for k in keys[:4])
    law = Law(
        a, b, c, d, numbers(data["eta"], m), numbers(data["layer"], m), data["switching"],
        numbers(data["disturbance"], n),
    )  # fmt: skip
    require(min(*law.eta, *law.layer) > 0, "η and the layer > 0")
    require(min(law.disturbance) >= 0, "bounds of disturbances ≥ 0")
    require(law.switching in ("saturation", "tanh", "sign"), "a known switching function")
    return law


@dataclass(frozen=True)
class Subject:
    """A law, and the claims on it as they stand in the file."""

    law: Law
    claims: tuple[Mapping[str, Any], ...]


@dataclass(frozen=True)
class Document:
    """A certificate that was read: everything in it that can decide something."""

    model: Model
    model_hash: str
    subjects: tuple[Subject, ...]
    made_with: Mapping[str, str | None] = field(default_factory=dict)


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    require(len({k for k, _ in pairs}) == len(pairs), "a key that stands twice in one object")
    return dict(pairs)


def _refuse(text: str) -> Any:
    raise Refused(f"a JSON number that is not whole: {text[:40]}")


def _whole(text: str) -> int:
    require(text.isdigit() and len(text) <= 10 and int(text) < 2**31, f"whole number {text[:20]}")
    return int(text)


def parse(content: bytes) -> dict[str, Any]:
    """Parse the JSON of a certificate."""
    require(len(content) <= LARGEST, f"{len(content)} bytes, more than {LARGEST}")
    try:
        text = content.decode("utf-8")
    except UnicodeDecodeError as error:
        raise Refused(f"no UTF-8: {error.reason}") from error
    require("\\" not in text, "a backslash: no text needs one")
    level = 0
    for piece in re.findall(r'"[^"]*"|[\[\]{}]|true|false', text):
        level += {"[": 1, "{": 1, "]": -1, "}": -1}.get(piece, 0)
        require(level <= DEEPEST, f"nested deeper than {DEEPEST}")
        require(piece not in ("true", "false"), f"{piece}, which no certificate has")
    try:
        data = json.loads(
            text, object_pairs_hook=_object, parse_int=_whole,
            parse_float=_refuse, parse_constant=_refuse,
        )  # fmt: skip
    except (json.JSONDecodeError, RecursionError) as error:
        raise Refused(f"no JSON: {error}") from error
    require(isinstance(data, dict), "no JSON object")
    return data  # type: ignore[no-any-return]


def read(content: bytes) -> Document:
    """Read a certificate file.

    Raises
    ------
    Refused
        For what is damaged, edited, too large, of another version, or unknown.
    """
    data = parse(content)
    require(data.get("format") == FORMAT, f"format {str(data.get('format'))[:40]!r}")
    version = data.get("version")
    again = "certify again with this version: undertow certify NAME --out FOLDER"
    require(version == VERSION, f"version {version!r} where {VERSION} is read: {again}")
    keys = {"format", "version", "model", "model_hash", "subjects", "made_with", "checksum"}
    fields(data, "certificate", keys)
    rest = {k: v for k, v in data.items() if k != "checksum"}
    fits = data["checksum"] == digest(rest) and data["model_hash"] == digest(data["model"])
    require(fits, "a checksum that does not fit its content: it was edited or damaged")
    model = read_model(data["model"])
    subjects = []
    for item in _list(data["subjects"], 1, MOST_CLAIMS):
        fields(item, "subject", {"law", "claims"})
        claims = _list(item["claims"], 0, MOST_CLAIMS)
        for claim in claims:
            require(isinstance(claim, dict) and "kind" in claim, "a claim with its kind")
        subjects.append(Subject(read_law(item["law"], model), tuple(claims)))
    count = sum(len(s.claims) for s in subjects)
    require(1 <= count <= MOST_CLAIMS, f"{count} claims: at least one, at most {MOST_CLAIMS}")
    require(isinstance(data["made_with"], dict), "made_with: an object")
    made_with = {
        _name(k): None if v is None else _short(v, 64) for k, v in data["made_with"].items()
    }
    return Document(model, data["model_hash"], tuple(subjects), made_with)
