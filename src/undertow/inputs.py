"""Words of the command line to values of the library: states, parameters, surfaces.

The one place where degrees come in.  Every quantity that is typed carries its unit, so
that no number can be taken for another.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence

import numpy as np

from undertow import mechanisms
from undertow.errors import InvalidInputError
from undertow.mechanism import FloatArray, Mechanism
from undertow.objective import MinimumEnergy, MinimumTime, Objective
from undertow.sliding import Surface

__all__ = ["mechanism_named", "objective_named", "parse_start", "parse_surface", "parse_values"]

#: Unit as typed to (SI unit of the coordinate, whether it is a rate, factor to SI).
UNITS: Mapping[str, tuple[str, bool, float]] = {
    "deg": ("rad", False, math.pi / 180),
    "rad": ("rad", False, 1.0),
    "m": ("m", False, 1.0),
    "deg/s": ("rad", True, math.pi / 180),
    "rad/s": ("rad", True, 1.0),
    "m/s": ("m", True, 1.0),
}

_QUANTITY = re.compile(r"([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([a-z/]*)")


def mechanism_named(name: str, settings: Sequence[str] = ()) -> Mechanism:
    """Return a mechanism of the library, with parameters replaced by ``name=value``.

    Raises
    ------
    InvalidInputError
        For an unknown mechanism or parameter, or a value outside its bounds.
    """
    if name not in mechanisms.LIBRARY:
        raise InvalidInputError(
            "mechanism", value=repr(name), limit=f"one of {', '.join(mechanisms.LIBRARY)}"
        )
    mechanism = mechanisms.LIBRARY[name]()
    return mechanism.with_parameters(**parse_values(settings)) if settings else mechanism


def objective_named(name: str, mechanism: Mechanism, horizon: float) -> Objective:
    """Return the objective called ``energy`` or ``time``, its unit that of the inputs."""
    if name == "time":
        return MinimumTime(horizon=horizon)
    if name != "energy":
        raise InvalidInputError("objective", value=repr(name), limit="one of energy, time")
    units = {channel.unit for channel in mechanism.inputs}
    unit = units.pop() if len(units) == 1 else "mixed units"
    return MinimumEnergy(horizon=horizon, unit=f"({unit})² s" if " " in unit else f"{unit}² s")


def _split(word: str, example: str) -> tuple[str, str]:
    name, equals, value = word.partition("=")
    if not (equals and name.strip() and value.strip()):
        raise InvalidInputError("setting", value=repr(word), limit=f"name=value, like {example}")
    return name.strip(), value.strip()


def _number(text: str, what: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InvalidInputError(what, value=repr(text), limit="a finite number")
    return value


def parse_values(words: Sequence[str]) -> dict[str, float]:
    """Read ``name=value`` words, SI units.

    >>> parse_values(["d_e=0.025"])
    {'d_e': 0.025}
    """
    pairs = [_split(word, "d_e=0.025") for word in words]
    return {name: _number(value, f"parameter '{name}'") for name, value in pairs}


def parse_start(mechanism: Mechanism, words: Sequence[str]) -> FloatArray:
    """Read an initial state from ``name=value`` words with units; the rest is zero.

    Parameters
    ----------
    mechanism
        Whose states they are.
    words
        Like ``phi=40deg``, ``theta_dot=10deg/s`` or ``x=0.2m``.  Without any word, the
        mechanism's usual start.

    Raises
    ------
    InvalidInputError
        For an unknown state, a missing or wrong unit, or what is no number.

    Examples
    --------
    >>> rig = mechanisms.rotary_pendulum()
    >>> parse_start(rig, ["phi=90deg"]).round(3).tolist()
    [0.0, 1.571, 0.0, 0.0]
    """
    if not words:
        return mechanism.state(**mechanism.start)
    values: dict[str, float] = {}
    for word in words:
        name, text = _split(word, f"{mechanism.coordinates[-1].name}=40deg")
        if name not in mechanism.state_names:
            raise InvalidInputError(
                f"initial state of '{mechanism.name}'",
                value=repr(name),
                limit=f"one of {', '.join(mechanism.state_names)}",
            )
        index = mechanism.state_names.index(name)
        kind = (mechanism.coordinates[index % mechanism.n].unit, index >= mechanism.n)
        units = [unit for unit, (si, rate, _) in UNITS.items() if (si, rate) == kind]
        match = _QUANTITY.fullmatch(text)
        if match is None or match[2] not in units:
            raise InvalidInputError(
                f"initial state '{name}'",
                value=repr(text),
                limit=f"a number with its unit, {' or '.join(units)}",
                remedy=f"Write for instance --start {name}=10{units[0]}",
            )
        values[name] = float(match[1]) * UNITS[match[2]][2]
    return mechanism.state(**values)


def parse_surface(mechanism: Mechanism, text: str) -> Surface:
    """Read a surface from its blocks; α_a is −I where it is not given.

    Parameters
    ----------
    mechanism
        For the shapes.
    text
        ``"lambda_a=-0.5 alpha_u=5 lambda_u=10"``; entries of a row are joined by commas,
        rows by semicolons.

    Raises
    ------
    InvalidInputError
        For a missing, unknown or ill-shaped block.
    """
    blocks: dict[str, FloatArray] = {"alpha_a": -np.eye(mechanism.m)}
    names = ("alpha_a", "lambda_a", "alpha_u", "lambda_u")
    example = "lambda_a=-0.5 alpha_u=5 lambda_u=10"
    for word in text.split():
        name, value = _split(word, example)
        if name not in names:
            raise InvalidInputError(
                "surface block", value=repr(name), limit=f"one of {', '.join(names)}"
            )
        rows = [
            [_number(v, f"surface block {name}") for v in r.split(",")] for r in value.split(";")
        ]
        if len({len(row) for row in rows}) != 1:
            raise InvalidInputError(
                f"surface block {name}", value=repr(value), limit="rows of equal length"
            )
        blocks[name] = np.array(rows)
    missing = [name for name in names if name not in blocks]
    if missing:
        raise InvalidInputError(
            "surface",
            value=repr(text),
            limit=f"complete; {', '.join(missing)} is missing",
            remedy=f"Write for instance --surface '{example}'",
        )
    return Surface(**blocks)
