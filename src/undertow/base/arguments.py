"""Checks of arguments against their annotations.

All public functions use them: :func:`checked` reads the annotations of a function or method,
:func:`checked_names` and :func:`check_fields` the fields of a dataclass.  Ranges and
shapes are checked where values are used.
"""

from __future__ import annotations

import contextlib
import inspect
import math
import sys
import types
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from functools import cache, wraps
from numbers import Complex, Real
from typing import (
    Any,
    Literal,
    ParamSpec,
    TypeVar,
    Union,
    cast,
    get_args,
    get_origin,
    get_type_hints,
)

import numpy as np
import sympy as sp
from numpy.typing import ArrayLike

from undertow.base.errors import InvalidInputError, UndertowError, a_kind, near

#: What to give for a type, by its name.
REMEDIES = {
    "float": "Give a number in SI units: undertow.deg(10) for an angle of 10°",
    "int": "Give a whole number",
    "str": "Write it as text, in quotes",
    "Mechanism": "Make one: undertow.mechanisms.rotary_pendulum(), or of one's own with "
    "undertow.Mechanism.from_energies",
    "Coordinate": 'Write [Coordinate("x", "m"), Coordinate("phi", "rad")]',
    "Input": 'Write [Input("force", "N", 10.0)]',
    "Parameter": 'Write [Parameter("mass", 0.5, "kg")]',
    "Objective": "Make one: undertow.MinimumTime(), undertow.MinimumEnergy(), or "
    'undertow.Objective("my cost", lambda v: v.phi**2)',
    "Constraint": "Write constraints=(*undertow.state_box(phi=1.0), Constraint(...))",
    "Surface": "Design one: undertow.first_surface(mechanism)",
    "ReachingLaw": "Write undertow.ReachingLaw(eta=20.0, layer=0.1)",
    "Budget": "Write undertow.Budget(1024)",
    "DecisionVariables": "Write undertow.DecisionVariables(times=(0.0, 0.1))",
    "SetPoints": 'Write {"x": 0.5}, undertow.SetPoints([(0, {"x": 0.5}), (2, {"x": -0.5})]), or an '
    "undertow.Reference",
    "Plan": "Write undertow.Plan((surface,)), or take the plan of a proposal",
    "CascadeState": "Take the one that Cascade.start returned",
    "Proposal": "Take the one that Cascade.propose returned",
}

#: What compiled code takes for a number, and where there is none.
_PLAIN = (float, int, types.NoneType)

#: What stands for a number that is written in full, and the most of a value that is shown.
_ARRAY, _SHOWN = "array", 80

P = ParamSpec("P")
R = TypeVar("R")
C = TypeVar("C")
K = TypeVar("K")
V = TypeVar("V")


#: What helps who gives states of another kind or size.
BY_NAME = "Set states by name: mechanism.state(name=value)"


def floats(what: str, values: ArrayLike, remedy: str = BY_NAME) -> np.typing.NDArray[np.float64]:
    """Return values as an array of floats, or refuse them.

    Raises InvalidInputError with what was given instead.
    """
    if _is_array(values) and not np.ma.is_masked(values):  # NumPy would hand over what is hidden
        return np.asarray(values, dtype=np.float64)
    raise InvalidInputError(what, value=_shown(values), limit="numbers, in SI units", remedy=remedy)


def checked(function: Callable[P, R]) -> Callable[P, R]:
    """Have every argument of a function or method checked against its annotation.

    Numbers of SymPy and of other kinds become floats where these are asked for. Raises
    InvalidInputError at a call, for an argument of another type, by name.

    Examples
    --------
    >>> @checked
    ... def half(length: float) -> float:
    ...     return length / 2
    >>> half("a")
    Traceback (most recent call last):
        ...
    undertow.base.errors.InvalidInputError: length of half: got 'a', a str, must be a number. \
Give a number in SI units: undertow.deg(10) for an angle of 10°
    """
    parameters = inspect.signature(function).parameters.values()
    # What stands behind * or ** is checked one by one, by its place or its own name.
    more = {p.kind: p.name for p in parameters if p.kind in (p.VAR_POSITIONAL, p.VAR_KEYWORD)}
    rest = more.get(inspect.Parameter.VAR_POSITIONAL)
    others = more.get(inspect.Parameter.VAR_KEYWORD)
    places = [p.name for p in parameters if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)]
    words = {p.name for p in parameters if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)}

    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        tests, last, floating = _tests(function), len(places), _floating(function)
        given: Any = args
        for k, value in enumerate(args):
            parameter = places[k] if k < last else rest
            test = tests.get(parameter)
            if test is not None and not test(value):
                _refuse(function, parameter, value, "" if k < last else f"{k - last}")
            if type(value) not in _PLAIN and parameter in floating:
                given = (*given[:k], float(cast(float, value)), *given[k + 1 :])
        for name, value in kwargs.items():
            if name not in words and others is None:
                one_of(f"argument of {_called(function)}", name, sorted(words - {"self", "cls"}))
            parameter = name if name in words else others
            test = tests.get(parameter)
            if test is not None and not test(value):
                _refuse(function, parameter, value, name)
            if type(value) not in _PLAIN and parameter in floating:
                kwargs[name] = float(cast(float, value))
        return function(*given, **kwargs)  # of a missing name Python itself tells

    return call


def checked_names(owner: type[C]) -> type[C]:
    """Have a keyword that is no field of a dataclass refused, with those that are like it.

    What the fields themselves are is for :func:`check_fields`.  Raises InvalidInputError where one
    is made.
    """
    made: Any = owner.__init__
    words = sorted(set(inspect.signature(made).parameters) - {"self"})

    @wraps(made)
    def init(self: C, *args: Any, **kwargs: Any) -> None:
        for name in kwargs:
            if name not in words:
                one_of(f"argument of {_called(owner)}", name, words)
        made(self, *args, **kwargs)

    owner.__init__ = init  # type: ignore[assignment]
    return owner


class ReadOnly(Mapping[K, V]):
    """A copy of a mapping that nobody can write to; it can be pickled and copied."""

    __slots__ = ("_items",)

    def __init__(self, mapping: Mapping[K, V]) -> None:
        self._items = dict(mapping)

    def __getitem__(self, key: K) -> V:
        """Return what stands under a key."""
        return self._items[key]

    def __iter__(self) -> Iterator[K]:
        """Return the keys, in their order."""
        return iter(self._items)

    def __len__(self) -> int:
        """Return how many there are."""
        return len(self._items)

    def __or__(self, other: Mapping[K, V]) -> dict[K, V]:
        """Return a new dictionary with what is in either; the other counts."""
        return self._items | dict(other)

    def __repr__(self) -> str:
        """Show what is in it."""
        return repr(self._items)


def require(
    good: object,
    what: str,
    value: object = None,
    limit: object = None,
    remedy: str = "",
    error: type[UndertowError] = InvalidInputError,
) -> None:
    """Refuse what is not as it has to be.

    Raises InvalidInputError or another ``error``, with the value, the limit and the remedy.
    """
    if not good:
        raise error(what, value=value, limit=limit, remedy=remedy)


def at_least(what: str, value: float, low: float, remedy: str = "") -> None:
    """Refuse a number below a limit, and NaN.

    Raises InvalidInputError with the value and the limit.
    """
    if not value >= low:  # in loops: the words are made where they are needed
        remedy = remedy or f"Any whole number from {low:g} will do"
        raise InvalidInputError(what, value=value, limit=f"≥ {low:g}", remedy=remedy)


def between(
    what: str, value: float, low: float, high: float, unit: str = "", remedy: str = ""
) -> None:
    """Refuse a number outside of an interval, and NaN.

    Raises InvalidInputError with the value and the limits.
    """
    if not low <= value <= high:
        shown = (f"{number:g} {unit}".rstrip() for number in (value, low, high))
        got, *ends = shown
        raise InvalidInputError(what, value=got, limit=" to ".join(ends), remedy=remedy)


def instant(t: float) -> None:
    """Refuse a time that is not finite.

    Raises InvalidInputError with the value.
    """
    require(math.isfinite(t), "time, s", t, "a finite number", "Give the clock's, s from the start")


def positive(
    what: str, value: ArrayLike, remedy: str = "", *, zero: bool = False, infinite: bool = False
) -> None:
    """Refuse numbers that are not finite and > 0, NaN always.

    ``what``: what the number is, for the message. ``value``: a number or an array. ``remedy``: what
    to do, as a sentence. ``zero``, ``infinite``: allow 0; allow infinity. Raises InvalidInputError
    with the value and the limit.
    """
    if isinstance(value, float) and 0.0 < value < math.inf:
        return  # the usual case, in loops
    numbers = np.asarray(value, dtype=np.float64)
    good = (numbers >= 0 if zero else numbers > 0) & (infinite | np.isfinite(numbers))
    if not good.all():
        limit = f"{'' if infinite else 'finite and '}{'≥ 0' if zero else '> 0'}"
        raise InvalidInputError(what, value=value, limit=limit, remedy=remedy)


def one_for_each(
    what: str, values: ArrayLike, count: int, *, zero: bool = False, infinite: bool = False
) -> np.typing.NDArray[np.float64]:
    """Return positive numbers, (count,), from one for all of them or one for each.

    ``zero``: it may be 0, ``infinite``: infinity too. Raises InvalidInputError for another shape,
    and for what :func:`positive` refuses.
    """
    numbers, remedy = np.asarray(values, dtype=np.float64), "One number serves all"
    if numbers.shape not in ((), (count,)):
        raise InvalidInputError(what, value=values, limit=f"one number or {count}", remedy=remedy)
    positive(what, values, remedy, zero=zero, infinite=infinite)
    return np.array(np.broadcast_to(numbers, (count,)))


def one_of(
    what: str,
    name: str,
    names: Iterable[str],
    remedy: str = "",
    error: type[UndertowError] = InvalidInputError,
) -> None:
    """Refuse a name that is none of those known; the message names those that are like it.

    Raises InvalidInputError or another ``error``, with all that are known.
    """
    known = list(names)
    if name not in known:
        remedy = f"{near(str(name), known)} {remedy}".strip()
        limit = f"one of {', '.join(known)}" if known else "left out: there are none"
        raise error(what, value=repr(name), limit=limit, remedy=remedy)


def check_fields(instance: Any, *names: str) -> None:
    """Check the fields of a dataclass, all or those named, against their annotations.

    As in :func:`checked` numbers become floats where these are asked for. Raises InvalidInputError
    for a field of another type, by name.
    """
    owner: Any = type(instance)
    tests = _tests(owner)
    for name in names or _fields(owner):
        value = getattr(instance, name)
        if not tests[name](value):
            _refuse(owner, name, value)
        if type(value) not in _PLAIN and name in _floating(owner):
            object.__setattr__(instance, name, float(value))


@cache
def _fields(owner: Any) -> tuple[str, ...]:
    return tuple(f.name for f in owner.__dataclass_fields__.values() if f.init)


@cache
def _hints(of: Any) -> dict[str, Any]:
    try:
        return get_type_hints(of)
    except NameError:  # a name that is imported for type checkers alone: that one is not checked
        found: dict[str, Any] = {}
        for name, hint in of.__annotations__.items():
            alone = types.SimpleNamespace(__annotations__={name: hint})
            with contextlib.suppress(NameError):
                found |= get_type_hints(alone, of.__globals__)
        return found


@cache
def _tests(of: Any) -> dict[str | None, Callable[[Any], bool]]:
    """Return the test of each annotation, by the name of what it annotates."""
    return {name: _test(hint) for name, hint in _hints(of).items()}


@cache
def _floating(of: Any) -> frozenset[str | None]:
    """Return the names whose annotation is a float, or none."""
    return frozenset(n for n, hint in _hints(of).items() if hint in (float, float | None))


def _refuse(of: Any, parameter: str | None, value: object, name: str = "") -> None:
    """Raise with what an argument or a field is, and what its annotation asks for.

    ``name`` is its own where it is one of those behind ``parameter``.
    """
    hint = _hints(of)[str(parameter)]
    members = [m for m in _members(hint) if m is not types.NoneType]
    remedies: Iterable[str | None] = (
        REMEDIES.get(_name(m)) for member in members for m in (member, *_contents(member))
    )
    if isinstance(value, str) and "a sequence of names" in map(_words, members):
        remedies = [f"Write [{value!r}]"]
    raise InvalidInputError(
        f"{name or parameter} of {_called(of)}",
        value=_shown(value),
        limit=" or ".join(_words(m) for m in members),
        remedy=next((r for r in remedies if r), "Its documentation shows what it takes"),
    )


def _called(of: Any) -> str:
    """Return the name that a function or class is called by."""
    return str(of.__qualname__).removesuffix(".__init__")


def _shown(value: object) -> str:
    text = " ".join(repr(value).split())
    text = text if len(text) <= _SHOWN else f"{text[:_SHOWN]}…"
    return f"{text}, {a_kind(value)}"


def _members(hint: Any) -> list[Any]:
    """Return what a hint allows, one by one; what NumPy calls ``ArrayLike`` is one."""
    if hint is ArrayLike:
        return [_ARRAY]
    if get_origin(hint) not in (Union, types.UnionType):
        return [hint]
    members, arrays = list(get_args(hint)), set(get_args(ArrayLike))
    if arrays and arrays <= set(members):
        return [_ARRAY, *(m for m in members if m not in arrays)]
    return members


def _contents(hint: Any) -> tuple[Any, ...]:
    """Return what a container is of; of a mapping the values."""
    origin, inner = get_origin(hint), get_args(hint)
    return inner[1:] if isinstance(origin, type) and issubclass(origin, Mapping) else inner


def _name(hint: Any) -> str:
    return getattr(hint, "__name__", "")


def _words(hint: Any) -> str:
    """Return in words what a hint that is no union allows."""
    origin, inner = get_origin(hint), get_args(hint)
    if hint is _ARRAY or origin is np.ndarray:
        return "numbers"
    if origin is Literal:
        return " or ".join(map(repr, inner))
    if origin is not None and issubclass(origin, Mapping):
        return f"a mapping of {_several(inner[0])} to {_several(inner[1])}"
    if origin is not None and issubclass(origin, Iterable):
        return f"a sequence of {_several(inner[0])}"
    if origin is Callable or callable is hint:
        return "a function"
    plain = {
        float: "a number",
        complex: "a number",
        int: "a whole number",
        str: "text",
        bool: "True or False",
    }
    name = plain.get(hint) or _name(hint)
    return (
        f"an undertow.{name}"
        if str(getattr(hint, "__module__", "")).startswith("undertow")
        else name
    )


def _several(hint: Any) -> str:
    members = [m for m in _members(hint) if m is not types.NoneType]
    plain = {float: "numbers", complex: "numbers", int: "whole numbers", str: "names"}
    return " or ".join(plain.get(m) or _words(m).removeprefix("an ") for m in members)


@cache
def _test(hint: Any) -> Callable[[Any], bool]:
    """Return the test of whether a value is of a type, written as users write it."""
    origin, inner = get_origin(hint), get_args(hint)
    if hint is _ARRAY or origin is np.ndarray:
        return _is_array
    if hint is ArrayLike or origin in (Union, types.UnionType):
        tests = [_test(member) for member in _members(hint)]
        return lambda value: any(test(value) for test in tests)
    if origin is Literal:
        return lambda value: any(type(value) is type(one) and value == one for one in inner)
    if origin is Callable:
        return callable
    if isinstance(origin, type) and issubclass(origin, Mapping):
        of_value = _test(inner[1])
        return lambda value: isinstance(value, Mapping) and all(map(of_value, value.values()))
    if isinstance(origin, type) and issubclass(origin, Iterable):
        parts = tuple(_test(one) for one in inner if one is not Ellipsis)
        return lambda value: _is_sequence(value, parts)
    if hint in (float, int, complex):
        return lambda value: _is_number(value, hint)
    if hint is bool:
        return lambda value: isinstance(value, bool | np.bool_)
    if hint is Any or not isinstance(hint, type) or hint.__module__.startswith("sympy"):
        return lambda _: True  # expressions are for those who know the symbols
    if getattr(hint, "_is_protocol", False):
        return lambda _: True
    return lambda value: isinstance(value, hint)


def _is_array(value: Any) -> bool:
    if value is None or isinstance(value, str):
        return False
    try:
        given = np.asarray(value)  # of a complex number the imaginary part would be dropped
        return given.dtype.kind in "biufO" and np.asarray(given, dtype=np.float64) is not None
    except (TypeError, ValueError, OverflowError):
        return False


def _is_sequence(value: Any, parts: tuple[Callable[[Any], bool], ...]) -> bool:
    if isinstance(value, str | Mapping) or not isinstance(value, Iterable):
        return False
    if isinstance(value, np.ndarray) and value.ndim == 0:
        return False
    if not isinstance(value, Collection):
        return True  # looking at the parts would use them up
    if len(parts) > 1:
        return len(value) == len(parts) and all(
            test(one) for test, one in zip(parts, value, strict=True)
        )
    return all(map(parts[0], value))


def _is_number(value: Any, hint: type) -> bool:
    if isinstance(value, np.ndarray) and value.ndim == 0:
        value = value[()]
    if isinstance(value, sp.Expr):
        return bool(value.is_number and (hint is complex or value.is_real))
    if isinstance(value, bool | np.bool_):
        return False
    if hint is int:
        return isinstance(value, Real) and bool(value == value // 1)
    if isinstance(value, int) and value.bit_length() >= sys.float_info.max_exp:
        return False  # more digits than a float has
    return isinstance(value, Complex if hint is complex else Real)
