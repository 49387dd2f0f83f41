"""What a mechanism is made of, by name: coordinates, inputs, parameters, and the time."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Any

import numpy as np
import sympy as sp
from numpy.typing import NDArray

from undertow.errors import InvalidInputError

__all__ = ["TIME", "Coordinate", "FloatArray", "Input", "Parameter", "numbers"]

FloatArray = NDArray[np.float64]

#: The symbol of time in disturbances, s.
TIME = sp.Symbol("t", real=True)


#: Names of symbols that derivations make up.
_RESERVED = re.compile(r"_(v|y|cse_|viscous_)\d+")


def _check_name(what: str, name: str) -> None:
    """Refuse what is no identifier, and what a derivation could take for a symbol of its own."""
    if not name.isidentifier() or _RESERVED.fullmatch(name):
        raise InvalidInputError(
            what,
            value=repr(name),
            limit="a Python identifier; not _v0, _y0, _cse_0 or the like",
            remedy="Use letters, digits and underscores, a letter first",
        )


@dataclass(frozen=True)
class Parameter:
    """A physical parameter: a number with its unit, its bounds and where it comes from.

    Parameters
    ----------
    name
        Identifier; also the name of the SymPy symbol.
    value
        The value, in ``unit``.
    unit
        SI unit, as text ("kg m²").
    description
        What it is, in words.
    low, high
        The open interval of values that make physical sense.
    source
        Where the number was found.
    """

    name: str
    value: float
    unit: str
    description: str = ""
    low: float = -math.inf
    high: float = math.inf
    source: str = ""

    def __post_init__(self) -> None:
        """Refuse a value that is not finite or not inside its interval."""
        _check_name("parameter name", self.name)
        if not math.isfinite(self.value) or not self.low < self.value < self.high:
            interval = f"finite and inside ({self.low:g}, {self.high:g}) {self.unit}".rstrip()
            raise InvalidInputError(
                f"parameter '{self.name}'" + f" ({self.description})" * bool(self.description),
                value=f"{self.value:g}",
                limit=interval,
                remedy="Give a value inside the interval",
            )

    @property
    def symbol(self) -> sp.Symbol:
        """The SymPy symbol that stands for this parameter."""
        return sp.Symbol(self.name, real=True)


@dataclass(frozen=True)
class Coordinate:
    """A generalised coordinate; its velocity is named ``<name>_dot``.

    Parameters
    ----------
    name
        Identifier, e.g. ``"phi"``.
    unit
        ``"rad"`` or ``"m"``.
    description
        What it measures, with the sense that counts as positive.
    low, high
        Range of travel, in ``unit``; infinite where nothing stops the joint.  Data for
        constraints, checks and pictures: the equations know no end stop.
    """

    name: str
    unit: str = "rad"
    description: str = ""
    low: float = -math.inf
    high: float = math.inf

    def __post_init__(self) -> None:
        """Refuse a name or unit of another kind, and an empty range of travel."""
        _check_name("coordinate name", self.name)
        if self.unit not in ("rad", "m"):
            raise InvalidInputError(
                f"unit of coordinate '{self.name}'",
                value=repr(self.unit),
                limit="rad or m",
                remedy="Scale other units to SI first",
            )
        if not self.low < self.high:
            raise InvalidInputError(
                f"range of coordinate '{self.name}'",
                value=f"[{self.low:g}, {self.high:g}] {self.unit}",
                limit="low < high",
                remedy="Give the lower end first",
            )

    @property
    def symbol(self) -> sp.Symbol:
        """The SymPy symbol of the coordinate."""
        return sp.Symbol(self.name, real=True)

    @property
    def velocity(self) -> sp.Symbol:
        """The SymPy symbol of its time derivative."""
        return sp.Symbol(f"{self.name}_dot", real=True)


@dataclass(frozen=True)
class Input:
    """An actuator input u_i with its symmetric limit ``|u_i| ≤ limit``, (38).

    Parameters
    ----------
    name
        Identifier, e.g. ``"voltage"``.
    unit
        SI unit, e.g. ``"V"`` or ``"N m"``.
    limit
        Largest magnitude that the actuator can deliver; ``inf`` for none.
    """

    name: str
    unit: str
    limit: float = math.inf

    def __post_init__(self) -> None:
        """Refuse a name that is no identifier and a limit that is not positive."""
        _check_name("input name", self.name)
        if not self.limit > 0:
            raise InvalidInputError(
                f"limit of input '{self.name}'",
                value=f"{self.limit:g} {self.unit}",
                limit="positive",
                remedy="Give the largest magnitude that the actuator can deliver",
            )

    @property
    def symbol(self) -> sp.Symbol:
        """The SymPy symbol of the input."""
        return sp.Symbol(self.name, real=True)


def numbers(matrix: Any) -> FloatArray:
    """Return a SymPy matrix without symbols as a float array."""
    return np.array(matrix, dtype=np.float64)
