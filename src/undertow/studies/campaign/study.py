"""What every kind of campaign shares: axes, shards of a grid over them, and what is recorded."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from rich.console import RenderableType

from undertow.base import InvalidInputError, require
from undertow.models import FloatArray, Mechanism, Parameter
from undertow.studies.campaign.definition import Settings

#: What a shard computes: arrays by the names of the variables.
Arrays = dict[str, NDArray[np.generic]]


@dataclass(frozen=True, eq=False)
class Axis:
    """A dimension of what is recorded: ``name``, ``values`` (N,), and their ``unit``.

    ``words`` are what whole numbers from 0 on stand for.
    """

    name: str
    values: NDArray[np.generic]
    unit: str
    words: tuple[str, ...] = ()

    @classmethod
    def of_words(cls, name: str, words: Sequence[str]) -> Axis:
        """Return a dimension along which things are named."""
        return cls(name, np.arange(len(words)), "1", tuple(words))


@dataclass(frozen=True)
class Variable:
    """A recorded quantity: its ``unit``, SI, what it means, and the type of its numbers.

    ``flags`` are the words of whole numbers, by CF's convention, from 0 on.  What is ``measured``
    of the machine, like time spent, is no function of the definition: two runs may differ in it.
    """

    unit: str
    meaning: str
    dtype: str = "float64"
    flags: tuple[str, ...] = ()
    measured: bool = False

    @property
    def missing(self) -> float:
        """What stands where nothing was computed."""
        return -1 if np.dtype(self.dtype).kind == "i" else math.nan


class Study(ABC):
    """One kind of campaign, made from a mechanism and settings: its result is a grid of arrays.

    The grid is cut into shards along its first axes, so that a shard has at most ``most`` entries
    where the last axes allow it.  Equal settings and shard number give the same bits on
    processors of one kind.

    Attributes
    ----------
    mechanism, mechanisms
        What is studied; where there are several, all of them.
    axes
        Dimensions of every variable.
    variables
        What is recorded, by name.
    most
        Entries of a shard.
    seed
        Of what is drawn at random.
    """

    #: The word for it in a definition.
    kind: ClassVar[str]

    #: Whether shards may run in threads at once: where the kernels do the work.
    threaded: ClassVar[bool] = False

    mechanism: Mechanism
    mechanisms: tuple[Mechanism, ...] = ()
    axes: tuple[Axis, ...]
    variables: Mapping[str, Variable]
    most: int
    seed: int

    @cached_property
    def notes(self) -> list[str]:
        """What is to be said of the shards that were computed here."""
        return []

    @abstractmethod
    def __init__(self, mechanism: Mechanism, settings: Settings) -> None:
        """Take the settings of this kind, and refuse wrong ones before any work."""

    @abstractmethod
    def compute(self, shard: int) -> Arrays:
        """Return every variable on the part of the grid that is :meth:`part` of the shard."""

    def enter(self, code: Sequence[str]) -> None:
        """Take controllers of one's own, ``FILE.py:NAME``.

        Raises
        ------
        InvalidInputError
            Where the kind takes none.
        """
        raise InvalidInputError(
            "controllers entered",
            value=", ".join(code),
            limit=f"none: kind '{self.kind}' takes none",
            remedy='Enter them to a definition with kind = "league"',
        )

    @property
    def studied(self) -> tuple[Mechanism, ...]:
        """Every mechanism that results depend on."""
        return self.mechanisms or (self.mechanism,)

    def unknown(self, shape: tuple[int, ...]) -> Arrays:
        """Return arrays of this size for every variable, with nothing in them yet."""
        return {name: np.full(shape, v.missing, v.dtype) for name, v in self.variables.items()}

    def arrays(self, shape: tuple[int, ...], columns: Any) -> Arrays:
        """Return every variable from its flat column, in the order in which they are declared."""
        return {
            name: column.astype(v.dtype).reshape(shape)
            for (name, v), column in zip(self.variables.items(), columns, strict=True)
        }

    def same_bits(self, arrays: Arrays) -> Arrays:
        """Return the arrays that the definition alone decides."""
        return {k: v for k, v in arrays.items() if not self.variables[k].measured}

    def report(self, data: Any) -> list[RenderableType]:
        """Return tables of what a store has, an ``xarray.Dataset``; none: the usual one."""
        return []

    @property
    def shape(self) -> tuple[int, ...]:
        """Size of the grid."""
        return tuple(len(axis.values) for axis in self.axes)

    @cached_property
    def chunk(self) -> tuple[int, ...]:
        """Size of a shard that is not at an edge."""
        left, sizes = self.most, []
        for size in reversed(self.shape):
            sizes.append(max(1, min(size, left)))
            left //= sizes[-1]
        return tuple(reversed(sizes))

    @cached_property
    def cut(self) -> tuple[int, ...]:
        """Shards along each axis."""
        return tuple(-(-n // c) for n, c in zip(self.shape, self.chunk, strict=True))

    @property
    def shards(self) -> int:
        """Number of shards."""
        return math.prod(self.cut)

    def part(self, shard: int) -> tuple[slice, ...]:
        """Return what a shard is of the grid."""
        place = np.unravel_index(shard, self.cut)
        return tuple(
            slice(int(k) * c, min((int(k) + 1) * c, n))
            for k, c, n in zip(place, self.chunk, self.shape, strict=True)
        )

    def points(self, shard: int) -> tuple[tuple[int, ...], list[FloatArray]]:
        """Return the size of a shard, and every axis' values at its entries, flat."""
        values = [axis.values[part] for axis, part in zip(self.axes, self.part(shard), strict=True)]
        mesh = np.meshgrid(*values, indexing="ij")
        return mesh[0].shape, [np.asarray(v, dtype=float).ravel() for v in mesh]


#: The largest angle on an axis, rad: beyond two turns it is likely to be in degrees.
MOST_ANGLE = 4 * math.pi


def axes_of(settings: Settings, units: Mapping[str, str]) -> tuple[Axis, ...]:
    """Take the ``axes``: tables ``from``, ``to``, ``count``, by names that have units."""
    axes = []
    for name, table in settings.table("axes").tables(units).items():
        first, last = table.number("from"), table.number("to")
        count = table.count("count", low=1, high=10**7)
        if (first == last) != (count == 1):
            raise InvalidInputError(
                table.what("count"),
                value=f"{count} from {first:g} to {last:g}",
                limit="1 where both ends are the same, else at least 2",
            )
        ends, turns = f"{first:g} to {last:g} rad", f"within ±{MOST_ANGLE:.4g} rad, two turns"
        remedy = "Give radians: 90 degrees are 1.5708"
        small = units[name] != "rad" or max(abs(first), abs(last)) <= MOST_ANGLE
        require(small, settings.what(f"axes.{name}"), ends, turns, remedy)
        values = np.linspace(first, last, count)
        table.finish()
        axes.append(Axis(name, values, units[name]))
    return tuple(axes)


def start_of(mechanism: Mechanism, settings: Settings) -> FloatArray:
    """Take ``start``, states by name, as (2n,); the mechanism's usual one by default."""
    start = settings.table("start").by_name(mechanism.state_names)
    return mechanism.state(**start) if start else mechanism.usual_start


def tolerances(parameters: Iterable[Parameter], spread: float) -> dict[str, float]:
    """Return half-widths of parameters by name: the spread, or what room their bounds leave."""
    return {
        p.name: min(spread, 0.99 * min(p.high - p.value, p.value - p.low) / abs(p.value))
        for p in parameters
    }
