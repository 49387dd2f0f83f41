"""Words of the command line to values of the library: states, parameters, surfaces.

The one place where degrees come in.  Every quantity that is typed carries its unit, so
that no number can be taken for another.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from undertow.base import InvalidInputError, ModelError, between, one_of, require
from undertow.law import Reference, SetPoints, Surface, Target
from undertow.mechanisms.named import DataName, named
from undertow.models import FloatArray, Mechanism, invariant_coordinates, normal_name
from undertow.models.importers.equilibrium import WORDS
from undertow.objective import Constraint, Objective, check_travel, objective_for, state_box

#: Unit as typed to (SI unit of the coordinate, whether it is a rate, factor to SI).
UNITS: Mapping[str, tuple[str, bool, float]] = {
    "deg": ("rad", False, math.pi / 180),
    "rad": ("rad", False, 1.0),
    "m": ("m", False, 1.0),
    "deg/s": ("rad", True, math.pi / 180),
    "rad/s": ("rad", True, 1.0),
    "m/s": ("m", True, 1.0),
}

_QUANTITY = re.compile(r"([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([A-Za-z/]*)")


def mechanism_named(
    name: str, settings: Sequence[str] | None = (), limits: Sequence[str] | None = ()
) -> Mechanism:
    """Return a mechanism of the library or of a file, its parameters and input limits replaced.

    A name is as for :func:`undertow.mechanisms.named.named`; parameters are words ``name=value`` in
    SI units, largest magnitudes of inputs in the input's unit.
    """
    mechanism = named(name).with_parameters(**parse_values(settings))
    return mechanism.with_input_limit(*parse_limits(mechanism, limits)) if limits else mechanism


def parse_limits(mechanism: Mechanism, words: Sequence[str] | None) -> tuple[float, ...]:
    """Return the limit of each input, the mechanism's own where no word ``name=value`` names it."""
    new = parse_values(words, "limit of input", "voltage=10")
    known = {channel.name: channel.limit for channel in mechanism.inputs}
    example = f"Write for instance --limit {next(iter(known))}=10"
    for channel in new:
        one_of(f"input of '{mechanism.name}'", channel, known, example)
    return tuple((known | new).values())


def parse_travels(mechanism: Mechanism, words: Sequence[str] | None) -> tuple[float, ...]:
    """Return the largest magnitude of each coordinate, infinite where no word names it.

    Words are like ``theta=60deg`` or ``x=0.3m``; more than the mechanism declares is refused.

    Examples
    --------
    >>> import undertow as ut
    >>> parse_travels(ut.mechanisms.cart_pendulum(), ["x=0.3m"])
    (0.3, inf)
    """
    declared = {c.name: c for c in mechanism.coordinates}
    most = dict.fromkeys(declared, math.inf)
    for name, text in _pairs(words, f"{next(iter(most))}=LIMIT").items():
        one_of(f"coordinate of '{mechanism.name}'", name, most)
        most[name] = _in_si(mechanism, name, text, "travel of", "--travel", "1")
        own = declared[name]
        farthest = max(-own.low, own.high)
        remedy = f"The mechanism has no more: it declares {own.low:g} to {own.high:g} {own.unit}"
        between(f"travel of '{name}'", most[name], 0.0, farthest, own.unit, remedy)
    return tuple(most.values())


def parse_encoders(mechanism: Mechanism, words: Sequence[str] | None) -> dict[str, float]:
    """Return one count of each position sensor that words name, rad or m.

    Examples
    --------
    >>> import undertow as ut
    >>> parse_encoders(ut.mechanisms.cart_pendulum(), ["x=0.0001m"])
    {'x': 0.0001}
    """
    names, counts = [c.name for c in mechanism.coordinates], {}
    for name, text in _pairs(words, f"{names[0]}=COUNT").items():
        one_of(f"coordinate of '{mechanism.name}'", name, names)
        counts[name] = _in_si(mechanism, name, text, "one count of", "--encoder", "0.1")
    return counts


def aimed(name: str, target: Sequence[str] | None) -> tuple[str, list[str]]:
    """Move words that say at which equilibrium a file's mechanism rests into its name.

    The words are those of ``--target``: ``upright`` and the like; ``JOINT=ANGLE`` along which the
    mechanism cannot rest anywhere; and set-points. Returns the name, and the words that are left;
    equilibria of mechanisms that are in no URDF or MJCF file, and several of them, are refused.
    """
    words = [word for word in target or () if word in WORDS]
    rest = [word for word in target or () if word not in WORDS]
    data = DataName.of(name)
    both = " and ".join(words)
    require(len(words) < 2, "target", both, "one equilibrium", "Keep one of them")
    if data is None and words:
        raise InvalidInputError(
            "target",
            value=repr(words[0]),
            limit="a word about URDF and MJCF files; the target of others is x = 0",
            remedy="A set-point is written --target x=1m",
        )
    if data is None or data.target:
        require(not words, "target", f"{both} beside {name}", "one of them")
        return name, rest
    places = [word for word in rest if "=" in word and "@" not in word and not _is_csv(word)]
    if places and not words:
        try:
            fixed = invariant_coordinates(named(name))
        except ModelError:  # without a target, that is: the places are one
            fixed = ()
        words = [word for word in places if word.partition("=")[0] not in fixed]
        rest = [word for word in rest if word not in words]
    return f"{name}@{','.join(words)}" if words else name, rest


def _is_csv(word: str) -> bool:
    """Whether a word of ``--target`` names a file, in whose path an equals sign may stand."""
    return word.lower().endswith(".csv")


def objective_named(
    name: str,
    mechanism: Mechanism,
    horizon: float,
    box: Sequence[str] | None = (),
    *,
    hard_input: bool = False,
) -> Objective:
    """Return the objective that a word means, within bounds that are words too.

    See :func:`undertow.objective_for` and :func:`parse_box`; the horizon is in s.
    """
    constraints = parse_box(mechanism, box)
    return objective_for(
        mechanism, name, horizon=horizon, constraints=constraints, hard_input=hard_input
    )


def parse_task(
    name: str,
    start: Sequence[str] | None,
    objective: str,
    horizon: float,
    settings: Sequence[str] | None = (),
    limits: Sequence[str] | None = (),
    box: Sequence[str] | None = (),
    hard_input: bool = False,
) -> tuple[Mechanism, FloatArray, Objective]:
    """Return what is to be steered, from where, and what is minimised on the way.

    See :func:`mechanism_named`, :func:`parse_start` and :func:`objective_named`.
    """
    mechanism = mechanism_named(name, settings, limits)
    x0 = parse_start(mechanism, start)
    goal = objective_named(objective, mechanism, horizon, box, hard_input=hard_input)
    goal.check_start(mechanism, x0)
    return mechanism, x0, goal


def _split(word: str, example: str) -> tuple[str, str]:
    name, equals, value = word.partition("=")
    if not (equals and name.strip() and value.strip()):
        raise InvalidInputError("setting", value=repr(word), limit=f"name=value, like {example}")
    return normal_name(name.strip()), value.strip()


def _pairs(words: Sequence[str] | None, example: str) -> dict[str, str]:
    """Split ``name=value`` words, refusing a name that is given twice."""
    found: dict[str, str] = {}
    for word in words or ():
        name, value = _split(word, example)
        require(name not in found, "settings", f"'{name}' twice", "each name once", "Keep one")
        found[name] = value
    return found


def _number(text: str, what: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        remedy = "Write the number alone, in the unit that the mechanism gives for it"
        raise InvalidInputError(what, value=repr(text), limit="a finite number", remedy=remedy)
    return value


def parse_values(
    words: Sequence[str] | None, what: str = "parameter", example: str = "d_e=0.025"
) -> dict[str, float]:
    """Read ``name=value`` words, SI units.

    >>> parse_values(["d_e=0.025"])
    {'d_e': 0.025}
    """
    pairs = _pairs(words, example)
    return {name: _number(value, f"{what} '{name}'") for name, value in pairs.items()}


def _units_of(mechanism: Mechanism, name: str, what: str) -> tuple[str, ...]:
    """Return the units in which a state may be typed."""
    mechanism.check_state_name(what, name)
    index = mechanism.state_names.index(name)
    return _units_like(mechanism.coordinates[index % mechanism.n].unit, rate=index >= mechanism.n)


def _units_like(si: str, *, rate: bool = False) -> tuple[str, ...]:
    """Return the units in which a quantity with this unit, or its rate of change, is typed."""
    return tuple(unit for unit, (base, per_s, _) in UNITS.items() if (base, per_s) == (si, rate))


def _shown(number: float, unit: str) -> str:
    """Return a typed quantity as it is shown.

    >>> _shown(60.0, "deg"), _shown(-4.0, "rad/s")
    ('60°', '-4 rad/s')
    """
    return f"{number:g}{'' if unit.startswith('deg') else ' '}{unit.replace('deg', '°')}"


def _quantity(text: str, units: Sequence[str], what: str, example: str) -> tuple[float, str]:
    """Return the number and the unit of a quantity, refusing others than ``units``."""
    match = _QUANTITY.fullmatch(text.strip())
    if match is None or match[2] not in units:
        raise InvalidInputError(
            what,
            value=repr(text),
            limit=f"a number with its unit, {' or '.join(units)}",
            remedy=f"Write for instance {example}",
        )
    return float(match[1]), match[2]


def _bare(text: str, other: str) -> str:
    """Return a number that was typed without its unit, to be shown with it; else another."""
    match = _QUANTITY.fullmatch(text.strip())
    return match[1] if match and not match[2] else other


def _in_si(mechanism: Mechanism, name: str, text: str, what: str, option: str, usual: str) -> float:
    """Return what an ``option`` says of a coordinate or a rate; ``usual``: an example's number."""
    units = _units_of(mechanism, name, what)
    example = f"{option} {name}={_bare(text, usual)}{units[0]}"
    number, unit = _quantity(text, units, f"{what} '{name}'", example)
    return number * UNITS[unit][2]


def parse_start(mechanism: Mechanism, words: Sequence[str] | None) -> FloatArray:
    """Read an initial state from ``name=value`` words with units; the rest is zero.

    Words are like ``phi=40deg``, ``theta_dot=10deg/s`` or ``x=0.2m``; without any, the mechanism's
    usual start.

    Examples
    --------
    >>> import undertow as ut
    >>> rig = ut.mechanisms.rotary_pendulum()
    >>> parse_start(rig, ["phi=90deg"]).round(3).tolist()
    [0.0, 1.571, 0.0, 0.0]
    """
    if not words:
        return mechanism.usual_start
    values: dict[str, float] = {}
    for name, text in _pairs(words, f"{mechanism.coordinates[-1].name}=40deg").items():
        values[name] = _in_si(mechanism, name, text, "initial state", "--start", "10")
    return mechanism.state(**values)


def parse_target(mechanism: Mechanism, words: Sequence[str] | None) -> Target | None:
    """Read a target from words with units; ``None`` without any: x = 0.

    Words are set-points, ``x=2m`` from the start or ``x=-1m@2s`` from a time on; sines of the same
    frequency about 0, ``theta=45deg@0.5Hz``; or one CSV file with a path, see
    :meth:`undertow.Reference.read`.

    Examples
    --------
    >>> import undertow as ut
    >>> crane = ut.mechanisms.overhead_crane()
    >>> parse_target(crane, ["x=1m", "x=-50cm@2s"])
    Traceback (most recent call last):
        ...
    undertow.base.errors.InvalidInputError: target 'x': got '-50cm', must be a number with its \
unit, m. Write for instance --target x=1m
    >>> parse_target(crane, ["x=1m", "x=-0.5m@2s"]).times
    (0.0, 2.0)
    """
    if not words:
        return None
    if len(words) == 1 and ("=" not in words[0] or _is_csv(words[0])):
        return Reference.read(words[0])
    return _target_of_words(words, lambda name: _units_of(mechanism, name, "target"), "--target ")


def parse_new_target(units: Mapping[str, str], words: Sequence[str]) -> SetPoints:
    """Read set-points for a run that goes on; their times count from now.

    ``units`` are of the coordinates along which they may be, SI: ``m`` or ``rad``; words are like
    ``x=2m``, or ``x=-1m@5s``.

    Examples
    --------
    >>> parse_new_target({"theta": "rad"}, ["theta=90deg", "theta=0deg@5s"]).times
    (0.0, 5.0)
    """

    def units_of(name: str) -> tuple[str, ...]:
        one_of("target", name, tuple(units))
        return _units_like(units[name])

    if not units:
        raise InvalidInputError(
            "target of a run that goes on",
            value=" ".join(words),
            limit="x = 0: the mechanism's equations depend on all of its coordinates",
            remedy="Another equilibrium is the target of a mechanism of its own: "
            "undertow.modelling.move_target",
        )
    found = _target_of_words(words, units_of, "")
    if isinstance(found, Reference):
        raise InvalidInputError(
            "target of a run that goes on",
            value=" ".join(words),
            limit="set-points: x=2m, x=-1m@5s",
            remedy="A reference is given before the start: undertow run --target",
        )
    return found


def _target_of_words(
    words: Sequence[str], units_of: Callable[[str], tuple[str, ...]], option: str
) -> Target:
    """Return the set-points or sines of words, with the units in which each may be."""
    points: dict[float, dict[str, float]] = {}
    sines: dict[float, dict[str, float]] = {}
    for word in words:
        name, text = _split(word, "x=1m")
        value, at, when = text.partition("@")
        units = units_of(name)
        one = f"{option}{name}={_bare(value, '1')}{units[0]}"
        number, unit = _quantity(value, units, f"target '{name}'", one)
        example = f"{one}@2s or {one}@0.5Hz"
        time, kind = _quantity(when, ("s", "Hz"), f"target '{name}'", example) if at else (0.0, "s")
        group = (points if kind == "s" else sines).setdefault(time, {})
        require(name not in group, "target", f"'{name}' twice", "each name once at a time")
        group[name] = number * UNITS[unit][2]
    if sines and (points or len(sines) > 1):
        raise InvalidInputError(
            "target",
            value=" ".join(words),
            limit="set-points, or sines of one frequency",
            remedy="Other references: a CSV file, or undertow.Reference in Python",
        )
    if sines:
        ((frequency, amplitudes),) = sines.items()
        return Reference.sine(frequency, **amplitudes)
    return SetPoints(sorted(points.items()))


def parse_box(mechanism: Mechanism, words: Sequence[str] | None) -> tuple[Constraint, ...]:
    """Read bounds on states from words with units.

    Words are like ``theta=60deg``, which is |theta| ≤ 60°, or ``x=-0.2m:0.5m``. What they bound,
    the mechanism's declared travel bounds no more; they cannot reach beyond it.

    Examples
    --------
    >>> import undertow as ut
    >>> rig = ut.mechanisms.rotary_pendulum()
    >>> [c.name for c in parse_box(rig, ["theta=60deg", "phi_dot=-4rad/s:5rad/s"])]
    ['|theta| ≤ 60°', '-4 rad/s ≤ phi_dot ≤ 5 rad/s']
    """
    found = []
    for name, text in _pairs(words, f"{mechanism.coordinates[0].name}=LOW:HIGH").items():
        units = _units_of(mechanism, name, "box")
        example = f"--box {name}=-10{units[0]}:20{units[0]}"
        parts = [_quantity(p, units, f"box of '{name}'", example) for p in text.split(":")]
        ends = [number * UNITS[unit][2] for number, unit in parts]
        low, high = (-ends[0], ends[0]) if len(ends) == 1 else (ends[0], ends[-1])
        if len(ends) > 2 or not low < 0 < high:
            raise InvalidInputError(
                f"box of '{name}'",
                value=repr(text),
                limit="one bound > 0, or LOW:HIGH around the target, LOW < 0 < HIGH",
                remedy=f"Write for instance {example}",
            )
        si, rate, _ = UNITS[units[0]]
        check_travel(mechanism, name, low, high, text)
        shown = [_shown(*part) for part in parts]
        (bound,) = state_box(**{name: (low, high)})
        label = f"|{name}| ≤ {shown[0]}" if len(ends) == 1 else f"{shown[0]} ≤ {name} ≤ {shown[1]}"
        found.append(replace(bound, name=label, unit=f"{si}/s" if rate else si))
    return tuple(found)


def parse_surface(mechanism: Mechanism, text: str) -> Surface:
    """Read a surface from its blocks; α_a is −I where it is not given.

    ``"lambda_a=-0.5 alpha_u=5 lambda_u=10"``; entries of a row are joined by commas, rows by
    semicolons. What prints as a surface is one, too: ``alpha_a=-1, lambda_a=[[-1.0, 0.0], …``. A
    block of another size than the mechanism's is refused, with one that has it.
    """
    blocks: dict[str, FloatArray] = {"alpha_a": -np.eye(mechanism.m)}
    driven, free = mechanism.m, mechanism.n - mechanism.m
    sizes = {"alpha_a": driven, "lambda_a": driven, "alpha_u": free, "lambda_u": free}
    # Blocks of the right size and no more than that: undertow.first_surface designs good ones.
    sample = {
        name: ";".join(",".join(f"{v:g}" for v in row) for row in 0 - np.eye(driven, columns))
        for name, columns in sizes.items()
    }
    example = " ".join(f"{name}={block}" for name, block in sample.items() if name != "alpha_a")
    bare = text.strip().removeprefix("Surface(").removesuffix(")")
    bare = re.sub(r"\]\s*,\s*\[", ";", bare).translate({ord(c): None for c in "[]"})
    bare = re.sub(r"\s*([,;])\s*(?![^\W\d])", r"\1", bare)  # within a block: no name follows
    for name, value in _pairs(re.sub(r",\s", " ", bare).split(), example).items():
        one_of("surface block", name, sizes)
        rows = [
            [_number(v, f"surface block {name}") for v in r.split(",")] for r in value.split(";")
        ]
        lengths = {len(row) for row in rows}
        if len(rows) != driven or lengths != {sizes[name]}:
            same = len(lengths) == 1
            here = f"{len(rows)}×{lengths.pop()}" if same else "rows that are not equally long"
            raise InvalidInputError(
                f"surface block {name} for '{mechanism.name}'",
                value=f"{value!r}, {here}",
                limit=f"{driven}×{sizes[name]}",
                remedy=f"Write for instance {name}={sample[name]}: a row for each driven "
                f"coordinate, an entry for each {'driven' if name.endswith('_a') else 'free'} one",
            )
        blocks[name] = np.array(rows)
    missing = [name for name in sizes if name not in blocks]
    if missing:
        raise InvalidInputError(
            "surface",
            value=f"{text!r}, with {', '.join(missing)} missing",
            limit="complete",
            remedy=f"Write for instance --surface '{example}'",
        )
    return Surface(**blocks)
