"""Targets: where a mechanism is to be, at rest or on its way.

A *set-point* is a place where the mechanism rests: a position along coordinates on which neither M
nor f depends.  A *reference* r(t) moves actuated ones of them.  What surface and law see is the
error x − x_r(t), whose dynamics are a mechanism's again
(:func:`undertow.models.error_dynamics`): the law feeds r̈ forward, so that ṡ = −K sw(s/ε) holds
on the way, too.

While r moves, the unactuated coordinates cannot stay at 0: what is asked of them is the bounded
motion φ_r of the internal dynamics that r leaves,

    M_uu φ̈ + M_ua r̈ = f_u(r, φ, ṙ, φ̇),

found on a grid in time by stable inversion (Devasia, Chen, Paden, IEEE Trans. Automatic Control
41 (1996) 930): Fourier series in the place of forward and backward integration, and Newton steps
with the derivative at the target.  For a periodic reference that is the periodic motion, and the
error can be zero throughout.  For others a mode that swings (a hanging load) would swing on for
ever after the reference has stopped: it is given damping, :data:`SWING_DAMPING` of critical, that
the mechanism lacks.  What the mechanism then does otherwise is left to the surface, which trades it
against the actuated error.
"""

from __future__ import annotations

import csv
import io
import itertools
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from undertow.base import (
    InvalidInputError,
    ReadOnly,
    UndertowError,
    check_fields,
    checked,
    checked_names,
    error_text,
    floats,
    one_of,
    positive,
    raised_at,
    read_file,
    require,
)
from undertow.models import (
    FloatArray,
    Mechanism,
    by_names,
    error_dynamics,
    invariant_coordinates,
    linearise,
    normal_name,
    number_of,
)
from undertow.symbolic import brief

#: Damping of swinging modes in the reference of the unactuated coordinates, of critical.
SWING_DAMPING = 0.5

#: Spacing of the grid of a reference, s; what is added before and after it, s.
GRID, REST = 0.01, 10.0

#: Newton steps of the inversion, and the last change that ends them, rad or m.
ROUNDS, ENOUGH = 60, 1e-9

#: Largest file with a reference, bytes.
LARGEST = 1 << 24

#: Most rows of a reference's grid.
MOST_ROWS = 1 << 20

#: Units that a file's header may have: each in SI units, and which.
FILE_UNITS = {
    "s": (1.0, "s"), "ms": (1e-3, "s"), "m": (1.0, "m"), "cm": (1e-2, "m"), "mm": (1e-3, "m"),
    "rad": (1.0, "rad"), "deg": (math.pi / 180, "rad"),
}  # fmt: skip

#: r at the times t, (N,) to (N,).
Function = Callable[[FloatArray], ArrayLike]


@dataclass(frozen=True, eq=False)
class ReferenceMotion:
    """x_r(t) of a mechanism, on a grid: at rest before its first row and after its last.

    Attributes
    ----------
    t
        Times, (N,), s, rising; one row is a set-point.
    q, v, a
        q_r, q̇_r and q̈_r, (N, n) each, SI units.
    """

    t: FloatArray
    q: FloatArray
    v: FloatArray
    a: FloatArray

    @classmethod
    def at_rest(cls, q: FloatArray) -> Self:
        """Return the set-point at the positions q, (n,)."""
        still = np.zeros((1, len(q)))
        return cls(np.zeros(1), np.array(q, dtype=float)[None], still, still)

    @property
    def moves(self) -> bool:
        """Whether it is no set-point."""
        return len(self.t) > 1

    def rows(self, t: ArrayLike) -> FloatArray:
        """Return q_r, q̇_r and q̈_r at the times t, (N,) to (N, 3n); see :func:`reference_row`."""
        times = np.atleast_1d(np.asarray(t, dtype=float))
        rows = np.empty((len(times), 3 * self.q.shape[1]))
        for at, row in zip(times, rows, strict=True):
            reference_row(at, self.t, self.q, self.v, self.a, row)
        return rows

    def position(self, t: float) -> tuple[float, ...]:
        """Return q_r(t), n numbers."""
        return tuple(self.rows(t)[0, : self.q.shape[1]].tolist())

    def state(self, t: float) -> FloatArray:
        """Return x_r(t), (2n,)."""
        return np.asarray(self.rows(t)[0, : 2 * self.q.shape[1]])

    def error_dynamics(self, mechanism: Mechanism, t: float) -> Mechanism:
        """Return the mechanism as the error x − x_r(t) sees it at the time t."""
        if not self.moves:
            return mechanism
        return error_dynamics(mechanism, self.rows(t)[0])


@brief()
def reference_row(
    t: float, times: FloatArray, q: FloatArray, v: FloatArray, a: FloatArray, row: FloatArray
) -> None:
    """Write q_r, q̇_r and q̈_r of a :class:`ReferenceMotion` at the time t into a row, (3n,).

    q_r and q̇_r are cubic between its rows, q̈_r is linear; before and after them it rests.
    """
    n, last = q.shape[1], times.shape[0] - 1
    row[n:] = 0.0
    if last == 0:
        for i in range(n):
            row[i] = q[0, i]
        return
    low, high = 0, last - 1
    while low < high:
        middle = (low + high + 1) // 2
        if times[middle] <= t:
            low = middle
        else:
            high = middle - 1
    h = times[low + 1] - times[low]
    z = min(1.0, max(0.0, (t - times[low]) / h))
    y = 1.0 - z
    for i in range(n):
        row[i] = y * y * ((1.0 + 2.0 * z) * q[low, i] + h * z * v[low, i]) + z * z * (
            (3.0 - 2.0 * z) * q[low + 1, i] - h * y * v[low + 1, i]
        )
        if times[0] <= t <= times[last]:
            row[n + i] = y * y * ((1.0 + 2.0 * z) * v[low, i] + h * z * a[low, i]) + z * z * (
                (3.0 - 2.0 * z) * v[low + 1, i] - h * y * a[low + 1, i]
            )
            row[2 * n + i] = y * a[low, i] + z * a[low + 1, i]


# -- set-points ------------------------------------------------------------------------------


@checked_names
@dataclass(frozen=True)
class SetPoints:
    """Places to rest at, one after another, each at once.

    Parameters
    ----------
    points
        Coordinate name to position, rad or m; or pairs (t, such a mapping) with rising times, s.
        Coordinates that are not named stay where the point before had them, at first at 0.

    Raises
    ------
    InvalidInputError
        For times that do not rise, and values that are no numbers.

    Examples
    --------
    >>> SetPoints([(0, {"x": 1.0}), (2, {"x": -1.0})]).times
    (0.0, 2.0)
    """

    points: Mapping[str, float] | Sequence[tuple[float, Mapping[str, float]]]

    def __post_init__(self) -> None:
        """Write a mapping as one point, and check times."""
        check_fields(self)
        given: Any = self.points
        pairs = [(0.0, given)] if isinstance(given, Mapping) else list(given)
        if not all(
            isinstance(p, Sequence) and len(p) == 2 and isinstance(p[1], Mapping) for p in pairs
        ):
            raise InvalidInputError(
                "set-points",
                value=repr(given)[:80],
                limit="coordinates to positions, or pairs (time, such a mapping)",
                remedy='Write SetPoints([(0, {"x": 1.0}), (2, {"x": -1.0})])',
            )
        times = [number_of("time of a set-point", t) for t, _ in pairs]
        rising = all(a < b for a, b in itertools.pairwise(times))
        if not (pairs and rising and times[0] >= 0 and math.isfinite(times[-1])):
            raise InvalidInputError(
                "times of set-points",
                value=times,
                limit="finite, ≥ 0, each later than the one before, s",
                remedy="Put them in order",
            )
        points = [
            (t, {normal_name(str(k)): _position(k, v) for k, v in p.items()})
            for t, (_, p) in zip(times, pairs, strict=True)
        ]
        object.__setattr__(self, "points", tuple(points))

    @property
    def pairs(self) -> tuple[tuple[float, dict[str, float]], ...]:
        """When each is asked for, s, and where it is, by names."""
        pairs: Any = self.points
        return tuple(pairs)

    @property
    def times(self) -> tuple[float, ...]:
        """When each is asked for, s."""
        return tuple(t for t, _ in self.pairs)

    @checked
    def check_within(self, seconds: float) -> None:
        """Refuse a set-point for which a run of so many seconds leaves no time.

        Raises
        ------
        InvalidInputError
            With the time of the set-point, s, and the length of the run.
        """
        require(
            self.times[-1] < seconds,
            "time of a set-point",
            f"{self.times[-1]:g} s",
            f"before the end of the run, {seconds:g} s",
            "Ask for it earlier, or make the run longer",
        )

    @checked
    def legs(
        self, mechanism: Mechanism, seconds: float
    ) -> tuple[tuple[float, ReferenceMotion], ...]:
        """Return when each set-point begins, s, the first at 0, and where it is.

        Raises
        ------
        InvalidInputError
            For a name that the mechanism has not, a velocity that is not zero, and a position where
            it does not rest.
        """
        del seconds  # a rest lasts
        q, found = np.zeros(mechanism.n), []
        names = [c.name for c in mechanism.coordinates]
        if self.times[0] > 0:
            found.append((0.0, ReferenceMotion.at_rest(q)))
        for t, given in self.pairs:
            point = by_names(f"set-point of '{mechanism.name}'", given)
            for name, value in point.items():
                mechanism.check_state_name("set-point", name)
                if name not in names:
                    _refuse_velocity(mechanism, name, value)
                elif value != q[names.index(name)]:
                    _check_invariant(mechanism, name, point)
                    q[names.index(name)] = value
            found.append((t, ReferenceMotion.at_rest(q)))
        return tuple(found)


def _position(name: str, value: object) -> float:
    what = f"set-point of '{name}'"
    position = number_of(what, value)
    if not math.isfinite(position):
        raise InvalidInputError(
            what,
            value=f"{position:g}",
            limit="a finite number, in m or rad",
            remedy="An earlier computation gave NaN or infinity",
        )
    return position


def _refuse_velocity(mechanism: Mechanism, name: str, value: float) -> None:
    if value != 0:
        raise InvalidInputError(
            f"set-point of '{mechanism.name}'",
            value=f"{name} = {value:g}",
            limit="velocity 0: a set-point is at rest",
            remedy="What moves is a reference: undertow.Reference.through(times, ...)",
        )


def _check_invariant(
    mechanism: Mechanism, name: str, point: Mapping[str, float] | None = None
) -> None:
    """Refuse a target, or a reference, along a coordinate on which the equations depend."""
    free = invariant_coordinates(mechanism)
    if name not in free:
        place = ", ".join(f"{c}={v!r}" for c, v in (point or {}).items())
        raise InvalidInputError(
            f"target of '{mechanism.name}'",
            value=f"a reference of '{name}'" if point is None else f"{name} = {point[name]:g}",
            limit=f"moved along {', '.join(free)}, on which neither M nor f depends"
            if free
            else "x = 0: its equations depend on all of its coordinates",
            remedy=""
            if point is None
            else "Another equilibrium is the target of a mechanism of its own: "
            f"undertow.modelling.move_target(mechanism, {place})",
        )


# -- references ------------------------------------------------------------------------------


@dataclass(frozen=True)
class Sine:
    """r(t) = centre + amplitude sin(2π frequency t + phase)."""

    amplitude: float
    frequency: float
    phase: float = 0.0
    centre: float = 0.0

    def __call__(self, t: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return r, ṙ and r̈."""
        w = 2 * math.pi * self.frequency
        s, c = np.sin(w * t + self.phase), np.cos(w * t + self.phase)
        A = self.amplitude
        return self.centre + A * s, A * w * c, -A * w**2 * s


@dataclass(frozen=True)
class Spline:
    """The cubic spline through points, at rest at both ends."""

    times: tuple[float, ...]
    values: tuple[float, ...]

    def __call__(self, t: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return r, ṙ and r̈."""
        from scipy.interpolate import CubicSpline

        spline = CubicSpline(self.times, self.values, bc_type="clamped")
        inside = (t >= self.times[0]) & (t <= self.times[-1])
        at = np.clip(t, self.times[0], self.times[-1])
        return spline(at), inside * spline(at, 1), inside * spline(at, 2)


@dataclass(frozen=True)
class Ramp:
    """From one value to another, as the polynomial of least jerk: at rest at both ends."""

    begin: float
    end: float
    start: float
    seconds: float

    def __call__(self, t: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return r, ṙ and r̈."""
        z, T = np.clip((t - self.start) / self.seconds, 0.0, 1.0), self.seconds
        way = self.end - self.begin
        return (
            self.begin + way * z**3 * (10 - 15 * z + 6 * z**2),
            way * 30 * z**2 * (1 - z) ** 2 / T,
            way * 60 * z * (1 - z) * (1 - 2 * z) / T**2,
        )


#: r, ṙ and r̈ at the times t, (N,) each.
ReferencePath = Callable[[FloatArray], tuple[FloatArray, FloatArray, FloatArray]]


@dataclass(frozen=True)
class Differentiated:
    """A function r(t) of one's own, for t ≥ 0; its derivatives are differences over 1 ms.

    Central ones; in the first millisecond what those of the next two say for it: a function of time
    need not be defined before 0.
    """

    function: Function

    def __call__(self, t: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return r, ṙ and r̈."""
        h = 1e-3

        def r(at: FloatArray) -> FloatArray:
            try:
                values = np.asarray(self.function(at), dtype=float)
            except (TypeError, ValueError):  # written for one time, with math.sin
                values = np.array([self.function(one) for one in at], dtype=float)
            return np.broadcast_to(values, at.shape).astype(float)

        def slopes(at: FloatArray) -> FloatArray:
            before, now, after = r(at - h), r(at), r(at + h)
            return np.array([(after - before) / (2 * h), (after - 2 * now + before) / h**2])

        centre, early = np.maximum(t, h), t < h
        found = slopes(centre)
        if early.any():
            later = slopes(centre[early] + h)
            found[:, early] += (t - centre)[early] / h * (later - found[:, early])
        return r(t), *found


@checked_names
@dataclass(frozen=True)
class Reference:
    """What actuated coordinates are to do over time: r(t) with two derivatives.

    Parameters
    ----------
    paths
        Coordinate name to a function of times, (N,), s, that returns r, ṙ and r̈, (N,) each,
        SI units.  Other actuated coordinates stay at 0.
    period
        After which it repeats itself, s; 0: never.
    units
        Coordinate name to the unit that its path is in, ``"rad"`` or ``"m"``, where that is known:
        of a file.

    See Also
    --------
    Reference.sine, Reference.through, Reference.ramp, Reference.of, Reference.read

    Examples
    --------
    >>> import undertow as ut
    >>> rig = ut.mechanisms.rotary_pendulum()
    >>> reference = Reference.sine(0.5, theta=ut.deg(45))
    >>> ((_, motion),) = reference.legs(rig, 4.0)
    >>> bool(abs(motion.q[:, 1]).max() < ut.deg(10))  # how far the pendulum leans meanwhile
    True
    """

    paths: Mapping[str, ReferencePath]
    period: float = 0.0
    units: Mapping[str, str] = field(default_factory=dict, compare=False)

    def __post_init__(self) -> None:
        """Refuse what is no function of time; keep copies."""
        check_fields(self)
        for name in ("paths", "units"):
            object.__setattr__(self, name, ReadOnly(getattr(self, name)))
        positive("period of a reference, s", self.period, "0 never repeats", zero=True)
        if not self.paths:
            raise InvalidInputError(
                "paths of a reference",
                value="none",
                limit="one coordinate or more that moves",
                remedy="Name it: Reference.sine(0.5, theta=0.3); to stay there is a set-point",
            )
        for name, path in by_names("paths of a reference", self.paths).items():
            if not callable(path):
                raise InvalidInputError(
                    f"path of '{name}'",
                    value=repr(path)[:80],
                    limit="a function of times that returns r, its velocity and its acceleration",
                    remedy=f"Reference.of({name}=function) differentiates one that returns r alone",
                )

    @classmethod
    @checked
    def sine(cls, frequency: float, **amplitudes: float) -> Self:
        """Return amplitude · sin(2π frequency t), Hz and rad or m, for each named coordinate."""
        positive("frequency of a reference, Hz", frequency, "0.5 is once in two seconds")
        named = by_names("amplitudes of a reference", amplitudes)
        return cls({name: Sine(a, frequency) for name, a in named.items()}, 1 / frequency)

    @classmethod
    @checked
    def through(cls, times: ArrayLike, **values: ArrayLike) -> Self:
        """Return the cubic splines through points at these times, s, at rest at both ends."""
        t = floats("times of a reference", times)
        limit = "two or more, finite, ≥ 0, rising"
        require(t.ndim == 1 and len(t) > 1, "times of a reference", f"shape {t.shape}", limit)
        with np.errstate(invalid="ignore"):  # of two that are infinite
            good = (t >= 0) & np.isfinite(t) & (np.diff(t, prepend=-1) > 0)
        first = int(good.argmin())
        remedy = "Put the points in the order of their times, each time once"
        value = f"{t[first]:g} s as number {first + 1} of {len(t)}"
        require(good.all(), "times of a reference", value, limit, remedy)
        paths = {}
        for name, given in by_names("points of a reference", values).items():
            r = floats(f"points of '{name}'", given)
            if r.shape != t.shape or not np.isfinite(r).all():
                raise InvalidInputError(
                    f"points of '{name}'",
                    value=f"shape {r.shape}" if r.shape != t.shape else "NaN or infinity",
                    limit=f"{len(t)} finite numbers, one for each time",
                )
            paths[name] = Spline(tuple(t.tolist()), tuple(r.tolist()))
        return cls(paths)

    @classmethod
    @checked
    def ramp(cls, seconds: float, start: float = 0.0, **ends: float | tuple[float, float]) -> Self:
        """Return ways from 0, or (begin, end), of least jerk within so many s after ``start``."""
        positive("length of a ramp, s", seconds)
        positive("start of a ramp, s", start, "It moves from then on", zero=True)
        paths = {}
        for name, end in by_names("ends of a ramp", ends).items():
            low, high = end if isinstance(end, Sequence | np.ndarray) else (0.0, end)
            paths[name] = Ramp(low, high, start, seconds)
        return cls(paths)

    @classmethod
    @checked
    def of(cls, **functions: Function) -> Self:
        """Return functions r(t) of one's own, differentiated twice by central differences."""
        return cls({name: Differentiated(f) for name, f in functions.items()})

    @classmethod
    @checked
    def read(cls, path: str | Path) -> Self:
        """Return the cubic splines through the points of a CSV file.

        Parameters
        ----------
        path
            The first line names the columns with their units, ``t (s), x (m), theta (deg)``; the
            first column is the time.  Units: s, ms; m, cm, mm; rad, deg.

        Raises
        ------
        ArtefactError
            For a file that cannot be read, or is too large.
        InvalidInputError
            For a header, a number or times that cannot be used, with the line.
        """
        path = Path(path)
        try:
            text = read_file(path, "reference", most=LARGEST).decode("utf-8-sig")
        except UnicodeDecodeError as error:
            raise InvalidInputError(
                f"reference '{path}'", value="no UTF-8 text", limit="comma-separated values"
            ) from error
        times, values, units = _columns(path, text)
        return cls(cls.through(times, **values).paths, units=units)

    def __repr__(self) -> str:
        """Show what moves."""
        return (
            f"Reference({', '.join(self.paths)}{f', period={self.period:g} s' * (self.period > 0)})"
        )

    @checked
    def legs(
        self, mechanism: Mechanism, seconds: float
    ) -> tuple[tuple[float, ReferenceMotion], ...]:
        """Return 0 and the motion x_r that is asked for from 0 to ``seconds``.

        Raises
        ------
        InvalidInputError
            For a coordinate that is not actuated, that is measured in another unit, or that the
            equations depend on; for values that are no finite numbers; for a length or a period
            whose grid is too large; and where the unactuated coordinates have no bounded motion.
        """
        positive("length of a reference, s", seconds, "Give duration=")
        window = self.period if self.period else seconds + 2 * REST
        times = math.ceil(seconds / self.period) + 1 if self.period else 1
        if not times * max(64.0, window / GRID) <= MOST_ROWS:
            raise InvalidInputError(
                f"reference of '{mechanism.name}'",
                value=f"{seconds:g} s" + f" with a period of {self.period:g} s" * bool(self.period),
                limit=f"at most {MOST_ROWS} rows, {GRID:g} s apart or 64 in a period",
                remedy="Shorten the run; a slower reference is one without a period, Reference.of",
            )
        count = max(64, math.ceil(window / GRID))
        count += count % 2
        before = 0.0 if self.period else REST
        t = np.linspace(-before, window - before, count, endpoint=False)
        q, v, a = (np.zeros((count, mechanism.n)) for _ in range(3))
        names = [c.name for c in mechanism.coordinates]
        inside = np.ones(count, bool) if self.period else (t >= 0) & (t <= seconds)
        for name, path in by_names(f"reference of '{mechanism.name}'", self.paths).items():
            one_of(f"reference of '{mechanism.name}'", name, names[: mechanism.m])
            _check_invariant(mechanism, name)
            k = names.index(name)
            self._check_unit(mechanism, k)
            at = t if self.period else np.clip(t, 0.0, seconds)
            q[:, k], v[:, k], a[:, k] = _asked(name, path, at)
            for part in (v, a):
                part[~inside, k] = 0.0
            if not np.isfinite(q[:, k] + v[:, k] + a[:, k]).all():
                raise InvalidInputError(
                    f"reference of '{name}'", value="NaN or infinity", limit="finite numbers"
                )
        _stable_inversion(mechanism, window, q, v, a, periodic=self.period > 0)
        if self.period:
            t = np.linspace(0.0, times * window, times * count + 1)
            q, v, a = (np.vstack([*[part] * times, part[:1]]) for part in (q, v, a))
        keep = (t >= -GRID) & (t <= seconds + REST)
        return ((0.0, ReferenceMotion(t[keep], q[keep], v[keep], a[keep])),)

    def _check_unit(self, mechanism: Mechanism, place: int) -> None:
        coordinate = mechanism.coordinates[place]
        unit = self.units.get(coordinate.name, coordinate.unit)
        if unit != coordinate.unit:
            raise InvalidInputError(
                f"reference of '{coordinate.name}'",
                value=f"in {unit}",
                limit=f"in {coordinate.unit}, as '{mechanism.name}' measures it",
                remedy="Correct the unit in the head of its column",
            )


def _asked(name: str, path: ReferencePath, t: FloatArray) -> FloatArray:
    """Return what a path gives at the times t, (3, N)."""
    what = f"reference of '{name}'"
    try:
        with np.errstate(all="ignore"):  # what is no number is refused
            found = tuple(path(t))
            rows = [np.broadcast_to(np.asarray(r, dtype=float), t.shape) for r in found]
    except UndertowError:
        raise
    except Exception as error:  # a user's function may do anything
        raise InvalidInputError(
            what,
            value=f"{error_text(error)}{raised_at(error)}",
            limit="a function of the time t ≥ 0, s, that returns a number for each",
            remedy="Write it with NumPy's functions, or for one time",
        ) from error
    if len(rows) != 3:
        raise InvalidInputError(
            what,
            value=f"a path that returns {len(rows)} rows of numbers",
            limit="r, its velocity and its acceleration",
            remedy=f"Reference.of({name}=function) differentiates one that returns r alone",
        )
    return np.array(rows)


def _columns(path: Path, text: str) -> tuple[FloatArray, dict[str, FloatArray], dict[str, str]]:
    """Return times, the other columns of a file by name, SI units, and the units of those."""
    lines = csv.reader(io.StringIO(text))
    head = [cell.strip() for cell in next(lines, [])]
    columns: list[tuple[str, float, str]] = []
    for cell in head:
        match = re.fullmatch(r"(\w+)\s*[(\[]\s*(\w+)\s*[)\]]", cell)
        allowed = [u for u, (_, si) in FILE_UNITS.items() if (si == "s") == (not columns)]
        if match is None or match[2] not in allowed:
            raise InvalidInputError(
                f"column '{cell}' of '{path}'",
                value=repr(cell),
                limit=f"a name with its unit, one of {', '.join(allowed)}",
                remedy="Write the first line like: t (s), x (m), theta (deg)",
            )
        columns.append((normal_name(match[1]), *FILE_UNITS[match[2]]))
    names = [name for name, _, _ in columns]
    if len(set(names)) < 2 or len(set(names)) < len(names):
        raise InvalidInputError(
            f"columns of '{path}'",
            value=", ".join(head) or "none",
            limit="the time and one coordinate or more, each once",
        )
    rows: list[list[float]] = []
    for number, line in enumerate(lines, 2):
        if not "".join(line).strip():
            continue
        try:
            row = [float(cell) for cell in line]
        except ValueError:
            row = []
        if len(row) != len(names) or not np.isfinite(row).all():
            raise InvalidInputError(
                f"line {number} of '{path}'",
                value=repr(",".join(line))[:60],
                limit=f"{len(names)} finite numbers",
            )
        time = row[0]
        if not time >= 0 or (rows and not time > rows[-1][0]):
            raise InvalidInputError(
                f"times of a reference, line {number} of '{path}'",
                value=line[0].strip(),
                limit="≥ 0, and later than the one before",
                remedy="Put the lines in the order of their times, each time once",
            )
        rows.append(row)
    if len(rows) < 2:
        raise InvalidInputError(
            f"times of a reference in '{path}'",
            value=len(rows),
            limit="two or more",
            remedy="A place to stay at is a set-point: target={name: position}",
        )
    table = np.array(rows).reshape(-1, len(names)) * [factor for _, factor, _ in columns]
    units = {name: unit for name, _, unit in columns[1:]}
    return table[:, 0], dict(zip(units, table.T[1:], strict=True)), units


def _stable_inversion(
    mechanism: Mechanism,
    window: float,
    q: FloatArray,
    v: FloatArray,
    a: FloatArray,
    *,
    periodic: bool,
) -> None:
    """Fill in the unactuated columns of q, v and a, (N, n), with what the actuated ones leave.

    Raises InvalidInputError where there is no bounded motion, or the reference is too fast to find
    it.
    """
    m = mechanism.m
    linear = linearise(mechanism)
    mass, stiffness, drag = linear.M[m:, m:], -linear.F[m:, m:], -linear.D[m:, m:]
    damping = np.zeros_like(mass) if periodic else _swing_damping(mass, stiffness)
    rate = 2 * math.pi * np.fft.rfftfreq(len(q), window / len(q))
    jw = 1j * rate[:, None, None]
    operator = jw**2 * mass + jw * (drag + damping) + stiffness
    if np.linalg.cond(operator).max() > 1e8:
        raise InvalidInputError(
            f"reference of '{mechanism.name}'",
            value="unactuated coordinates without a bounded motion of their own",
            limit="an internal dynamics whose modes grow, fade or swing",
            remedy="Give set-points, undertow.SetPoints",
        )
    shape = np.zeros((len(rate), mechanism.n - m), dtype=complex)
    change = math.inf
    for _ in range(ROUNDS):
        for part, power in ((q, 0), (v, 1), (a, 2)):
            part[:, m:] = np.fft.irfft((1j * rate[:, None]) ** power * shape, len(q), axis=0)
        rest = mechanism.forces(0.0, np.hstack([q, v]), a)[:, m:] + v[:, m:] @ damping.T
        if change < ENOUGH:
            break
        step = np.linalg.solve(operator, np.fft.rfft(rest, axis=0)[..., None])[..., 0]
        shape -= step
        change = float(np.abs(np.fft.irfft(step, len(q), axis=0)).max())
        if not change < 1e6:
            break
    if not change < ENOUGH:
        most = np.abs(a[:, :m]).max(axis=0)
        fastest = mechanism.coordinates[int(most.argmax())]
        raise InvalidInputError(
            f"reference of '{mechanism.name}'",
            value=f"'{fastest.name}' accelerated by {most.max():.3g} {fastest.unit}/s²",
            limit="one that the unactuated coordinates can follow, bounded",
            remedy="Make the reference slower",
        )
    # q̈_u from the equations themselves: where r̈ jumps, so does it, and no series does.
    a[:, m:] = 0.0
    left = mechanism.forces(0.0, np.hstack([q, v]), a)[:, m:] + v[:, m:] @ damping.T
    a[:, m:] = -np.linalg.solve(mechanism.M(q)[:, m:, m:], left[..., None])[..., 0]


def _swing_damping(mass: FloatArray, stiffness: FloatArray) -> FloatArray:
    """Return 2ζ M^½ (M^-½ K M^-½)₊^½ M^½: damping of the modes with positive stiffness alone."""
    values, vectors = np.linalg.eigh(mass)
    root = vectors * np.sqrt(values) @ vectors.T
    inverse = np.linalg.inv(root)
    squares, modes = np.linalg.eigh(inverse @ ((stiffness + stiffness.T) / 2) @ inverse)
    rates = np.sqrt(np.maximum(squares, 0.0))
    return np.asarray(2 * SWING_DAMPING * root @ (modes * rates @ modes.T) @ root)


#: What may be given as a target.
Target = SetPoints | Reference


def target_of(given: Target | Mapping[str, float] | Iterable[Any]) -> Target:
    """Return a target as it is, a mapping or pairs (t, mapping) as :class:`SetPoints`."""
    if isinstance(given, SetPoints | Reference):
        return given
    return SetPoints(given)  # type: ignore[arg-type]
