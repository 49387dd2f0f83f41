"""What a mechanism is made of, by name: coordinates, inputs, parameters, and the time."""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from numbers import Real
from typing import Any, TypeAlias

import numpy as np
import sympy as sp
from numpy.typing import ArrayLike, NDArray

from undertow.base import InvalidInputError, a_kind, checked_names, one_of, positive

FloatArray = NDArray[np.float64]

#: A state: all of its numbers, (2n,), or those that are not zero, by name.
StateLike: TypeAlias = ArrayLike | Mapping[str, float]

#: The symbol of time in disturbances, s.
TIME = sp.Symbol("t", real=True)


#: Longest name.
LONGEST = 200

#: Names of symbols that derivations introduce.
_RESERVED = re.compile(r"_(v|y|cse_|viscous_)\d+")


#: Invisible characters that Unicode counts among letters and marks: fillers, joiners, selectors; of
#: those of no width Python 3.13 takes two into names.
_INVISIBLE = re.compile(
    "[\u034f\u115f\u1160\u17b4\u17b5\u180b-\u180f\u200b-\u200f\u3164\ufe00-\ufe0f\uffa0"
    "\U000e0100-\U000e01ef]"
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
    """Return a name with the code points of its non-ASCII characters, to tell look-alikes apart.

    >>> code_points("k_µ")
    'k_µ (U+00B5)'
    """
    points = [f"U+{ord(c):04X}" for c in name if not c.isascii()]
    return f"{name} ({' '.join(points)})" if points else name


def _name(what: str, given: object) -> str:
    """Return a name in normal form; refuse what cannot be an identifier in generated Python.

    Names that derivations introduce, and invisible characters, are refused too.
    """
    name = normal_name(given) if isinstance(given, str) else ""
    invisible = _INVISIBLE.search(name)
    if not name.isidentifier() or invisible or _RESERVED.fullmatch(name) or len(name) > LONGEST:
        raise InvalidInputError(
            what,
            value=f"{given!r} with U+{ord(invisible[0]):04X}, which is invisible"
            if invisible
            else repr(given)[: LONGEST + 2],
            limit="a Python identifier; not _v0, _y0, _cse_0 or the like; "
            f"at most {LONGEST} characters",
            remedy="Use letters, digits and underscores, a letter first",
        )
    return name


def normal_unit(unit: str) -> str:
    """Return a unit as it is written here: ``kg m²`` for ``kg*m^2``, ``kg·m2`` or ``kg m**2``.

    >>> normal_unit("kg*m^2/s")
    'kg m²/s'
    """
    squares = re.sub(r"(?<=[A-Za-z])(?:\^|\*\*)?([23])(?!\d)", lambda n: "²³"[int(n[1]) - 2], unit)
    return re.sub(r"\s*[*·⋅.]\s*", " ", squares).strip()


def number_of(what: str, value: object, *, limit: str = "a number", remedy: str = "") -> float:
    """Return a real number as a float; refuse everything else: text, None, arrays, booleans.

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
        value=f"{value!r}, {a_kind(value)}",
        limit=limit,
        remedy=remedy or "Give a number in SI units: undertow.deg(10) for an angle of 10°",
    )


def deg(angle: float) -> float:
    """Return an angle in degrees in radians.

    Raises
    ------
    InvalidInputError
        For what is no number: text, None, an array.

    Examples
    --------
    >>> deg(180)
    3.141592653589793
    """
    remedy = "Write undertow.deg(10) for 10°; of an array numpy.radians takes each entry"
    return math.radians(number_of("angle", angle, limit="a number, in degrees", remedy=remedy))


class _Named:
    """What has a name in Python's own spelling, and a symbol of that name."""

    name: str

    @property
    def symbol(self) -> sp.Symbol:
        """The SymPy symbol that stands for it."""
        return sp.Symbol(self.name, real=True)

    def _take_name(self, what: str) -> None:
        """Keep the name that was given as ``spelling``, and its normal form."""
        object.__setattr__(self, "spelling", self.name)
        object.__setattr__(self, "name", _name(f"{what} name", self.name))

    def _check_text(self, example: str, *fields: str) -> None:
        """Refuse numbers and the like in the place of a text: an argument is missing before it."""
        kind = type(self).__name__
        for name in fields:
            given = getattr(self, name)
            if not isinstance(given, str):
                raise InvalidInputError(
                    f"{name} of {kind.lower()} '{self.name}'",
                    value=f"{'None' if given is None else f'{given!r}, {a_kind(given)}'}",
                    limit="text",
                    remedy=f"Write for instance {kind}({self.name!r}, {example})",
                )

    def _take_unit(self, unit: str) -> None:
        """Keep a unit in its usual spelling: what is usual of a parameter depends on it."""
        object.__setattr__(self, "unit", normal_unit(unit))


@checked_names
@dataclass(frozen=True)
class Parameter(_Named):
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
        SI unit, as text ("kg m²"; "kg*m^2" is the same).
    description
        What it is, in words.
    low, high
        The open interval of values that make physical sense.
    source
        Where the number was found.
    tolerance
        How far off the value may be, in ``unit``; ``None`` where nobody said, and 0 for what is
        exact.  See :meth:`undertow.Belief.usual`.
    """

    name: str
    value: float
    unit: str
    description: str = ""
    low: float = -math.inf
    high: float = math.inf
    source: str = ""
    tolerance: float | None = None
    spelling: str = field(default="", init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Refuse a value that is not finite or not inside its interval."""
        self._take_name("parameter")
        self._check_text('1.5, "kg", low=0', "unit", "description", "source")
        self._take_unit(self.unit)
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
        if self.tolerance is not None:
            what = f"tolerance of parameter '{self.name}'"
            tolerance = number_of(what, self.tolerance)
            positive(what, tolerance, zero=True)
            object.__setattr__(self, "tolerance", tolerance)

    @property
    def is_gravity(self) -> bool:
        """Whether it is an acceleration, m/s²: no rig has another gravity than its model."""
        return self.unit == "m/s²"


def with_value(parameter: Parameter, value: float) -> Parameter:
    """Return a parameter with another value, SI units; nothing else is checked again.

    Raises InvalidInputError for a value that is not inside the interval.
    """
    if not parameter.low < value < parameter.high:
        return replace(parameter, value=value)  # says what is wrong
    other = object.__new__(Parameter)
    other.__dict__.update(vars(parameter), value=value)
    return other


@checked_names
@dataclass(frozen=True)
class Coordinate(_Named):
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
        """Refuse an invalid name or unit, and an empty range of travel."""
        self._take_name("coordinate")
        self._check_text('"m", low=-1, high=1', "unit", "description")
        for end in ("low", "high"):
            number_of(f"{end} end of coordinate '{self.name}'", getattr(self, end))
        whose = f"unit of coordinate '{self.name}'"
        one_of(whose, self.unit, ("rad", "m"), "Scale other units to SI first")
        if not self.low < self.high:
            raise InvalidInputError(
                f"range of coordinate '{self.name}'",
                value=f"[{self.low:g}, {self.high:g}] {self.unit}",
                limit="low < high",
                remedy="Give the lower end first",
            )

    @property
    def velocity(self) -> sp.Symbol:
        """The SymPy symbol of its time derivative."""
        return sp.Symbol(f"{self.name}_dot", real=True)


@checked_names
@dataclass(frozen=True)
class Input(_Named):
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
        """Refuse a name that is not an identifier and a limit that is not positive."""
        self._take_name("input")
        self._check_text('"N", 10.0', "unit")
        self._take_unit(self.unit)
        whose = f"limit of input '{self.name}'"
        remedy = "Give the largest magnitude that the actuator can deliver, in its unit"
        if not number_of(whose, self.limit, remedy=remedy) > 0:
            value = f"{self.limit:g} {self.unit}"
            raise InvalidInputError(whose, value=value, limit="positive", remedy=remedy)


def in_degrees(coordinates: Sequence[Coordinate], m: int, x: FloatArray) -> str:
    """What to do where a free one of x, (2n,), is more than a turn off zero; empty if none is."""
    for c, angle in zip(coordinates[m:], x[m:].tolist(), strict=False):
        if c.unit == "rad" and abs(angle) > 2 * math.pi:
            turns = f"{c.name} = {angle:.4g} rad is {math.degrees(angle):.0f}°"
            return f"{turns}: if degrees are meant, give undertow.deg({angle:.4g})"
    return ""


def numbers(matrix: Any) -> FloatArray:
    """Return a SymPy matrix without symbols as a float array."""
    return np.array(matrix, dtype=np.float64)
