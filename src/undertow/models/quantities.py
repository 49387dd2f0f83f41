"""What a mechanism is made of, by name: coordinates, inputs, parameters, and the time."""

from __future__ import annotations

import math
import re
import unicodedata
from contextlib import suppress
from dataclasses import dataclass, field
from numbers import Real
from typing import Any

import numpy as np
import sympy as sp
from numpy.typing import NDArray

from undertow.base import InvalidInputError

__all__ = [
    "TIME",
    "Coordinate",
    "FloatArray",
    "Input",
    "Parameter",
    "code_points",
    "normal_name",
    "number_of",
    "numbers",
]

FloatArray = NDArray[np.float64]

#: The symbol of time in disturbances, s.
TIME = sp.Symbol("t", real=True)


#: Longest name.
LONGEST = 200

#: Names of symbols that derivations make up.
_RESERVED = re.compile(r"_(v|y|cse_|viscous_)\d+")


#: Letters that nobody sees, besides those whose category says so: fillers, joiners, selectors.
_UNSEEN = re.compile(
    "[\u034f\u115f\u1160\u17b4\u17b5\u180b-\u180f\u3164\ufe00-\ufe0f\uffa0\U000e0100-\U000e01ef]"
)


def normal_name(name: str) -> str:
    """Return a name as Python spells it, in Unicode's normal form NFKC.

    Python takes ``µ`` (U+00B5, on keyboards) for ``μ`` (U+03BC, Greek) wherever it is written as
    an identifier, SymPy does not: there is one spelling here, Python's.

    >>> normal_name("µ") == "μ"
    True
    """
    return unicodedata.normalize("NFKC", name)


def code_points(name: str) -> str:
    """Return a name with the code points of what is not ASCII in it, which tell look-alikes apart.

    >>> code_points("k_µ")
    'k_µ (U+00B5)'
    """
    points = [f"U+{ord(c):04X}" for c in name if not c.isascii()]
    return f"{name} ({' '.join(points)})" if points else name


def _name(what: str, given: object) -> str:
    """Return a name in its normal form; refuse what is no name that Python's code could bear.

    Refused is also what a derivation could take for a symbol of its own, and letters that cannot
    be seen.
    """
    name = normal_name(given) if isinstance(given, str) else ""
    unseen = _UNSEEN.search(name)
    if not name.isidentifier() or unseen or _RESERVED.fullmatch(name) or len(name) > LONGEST:
        raise InvalidInputError(
            what,
            value=f"{given!r} with U+{ord(unseen[0]):04X}, which is not seen"
            if unseen
            else repr(given)[: LONGEST + 2],
            limit="a Python identifier; not _v0, _y0, _cse_0 or the like; "
            f"at most {LONGEST} characters",
            remedy="Use letters, digits and underscores, a letter first",
        )
    return name


def number_of(what: str, value: object, *, limit: str = "a number", remedy: str = "") -> float:
    """Return a real number as a float, and refuse all else: text, None, arrays, truth values.

    Raises
    ------
    InvalidInputError
        With what was given instead.
    """
    if isinstance(value, sp.Expr) and value.is_number and value.is_real:
        return float(value)
    if isinstance(value, np.ndarray) and value.ndim == 0:
        value = value[()]
    with suppress(OverflowError):  # whole numbers of more digits than a float has
        if isinstance(value, Real) and not isinstance(value, bool | np.bool_):
            return float(value)
    raise InvalidInputError(
        what,
        value=f"{value!r}, a {type(value).__name__}",
        limit=limit,
        remedy=remedy or "Give a number in SI units: undertow.deg(10) for an angle of 10°",
    )


@dataclass(frozen=True)
class Parameter:
    """A physical parameter: a number with its unit, its bounds and where it comes from.

    Parameters
    ----------
    name
        Identifier; also the name of the SymPy symbol.  Names are kept in Python's own spelling,
        NFKC: ``µ`` from a keyboard (U+00B5) is the Greek ``μ`` (U+03BC).  ``spelling`` is what
        was given.
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
    spelling: str = field(default="", init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Refuse a value that is not finite or not inside its interval."""
        object.__setattr__(self, "spelling", self.name)
        object.__setattr__(self, "name", _name("parameter name", self.name))
        for end in ("value", "low", "high"):
            given = getattr(self, end)
            number = number_of(
                f"{end} of parameter '{self.name}'",
                given,
                limit=f"a number, in {self.unit}" if self.unit else "a number",
                remedy=f"Write Parameter({self.name!r}, 1.5, unit): a number, then its SI unit",
            )
            if not isinstance(given, float | int):
                object.__setattr__(self, end, number)
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
    spelling: str = field(default="", init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Refuse a name or unit of another kind, and an empty range of travel."""
        object.__setattr__(self, "spelling", self.name)
        object.__setattr__(self, "name", _name("coordinate name", self.name))
        for end in ("low", "high"):
            number_of(f"{end} end of coordinate '{self.name}'", getattr(self, end))
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
    spelling: str = field(default="", init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Refuse a name that is no identifier and a limit that is not positive."""
        object.__setattr__(self, "spelling", self.name)
        object.__setattr__(self, "name", _name("input name", self.name))
        number_of(
            f"limit of input '{self.name}'",
            self.limit,
            remedy="Give the largest magnitude that the actuator can deliver, in its unit",
        )
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
