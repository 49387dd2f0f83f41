"""Parameters from a recorded motion: output error, least squares, confidence intervals.

The model is simulated under the recorded inputs and its positions compared with the measured
ones (output error: noise on the measurement does not bias it; Ljung, *System Identification*,
2nd ed., sec. 7.3).  Which parameters are free is decided first: one whose column of the
Jacobian is nearly a combination of those already chosen is held (subset selection; Brun,
Reichert, Künsch, *Water Resources Research* 37(4), 2001).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
import scipy.optimize
import scipy.signal
import scipy.stats

from undertow.bring_up.intervals import correlated, counted
from undertow.bring_up.motion import Record
from undertow.bring_up.predict import Predictor
from undertow.errors import InvalidInputError
from undertow.mechanism import FloatArray, Mechanism, Parameter

__all__ = ["Estimate", "Identification", "identify"]

#: Sine of the angle to the chosen columns below which a parameter is held.
INDEPENDENT = 0.15

#: Names of what a record begins with: fitted, not reported.
_START, _RATE = "_start", "_rate"

#: Stages of a fit: length of the pieces in which the motion is fitted, s; part of it that is;
#: whether breaking away is fitted, which is sharp and can wait until the rest is nearly right.
Stage = tuple[float, float, bool]

#: Ways to the least squares.  What swings or sticks comes out of step with a model that is a
#: little off, so that a long motion has other minima: where the first way leads to one of them,
#: short pieces of the motion, and then more and more of it, lead past.
ROUTES: tuple[tuple[Stage, ...], ...] = (
    ((math.inf, 1.0, False), (math.inf, 1.0, True)),
    ((0.15, 1.0, False), (0.4, 1.0, False), (math.inf, 0.4, True), (math.inf, 1.0, True)),
    (
        (0.15, 1.0, False), *((math.inf, part, True) for part in (0.25, 0.4, 0.6, 0.8, 1.0)),
    ),
    ((0.1, 1.0, False), (math.inf, 0.15, False), (math.inf, 0.5, True), (math.inf, 1.0, True)),
)  # fmt: skip

#: Share of every coordinate's motion that a way must explain for no other to be tried.
ENOUGH = 0.998

#: Window of the polynomials that a piece's first state is read from, s.
WINDOW = 0.02

#: Central differences in scaled variables.
STEP = 2e-3


@dataclass(frozen=True)
class Estimate:
    """One identified quantity.

    Attributes
    ----------
    name, unit, description
        What it is.
    value
        The estimate.
    error
        Its standard error.
    low, high
        Its 95 % confidence interval.
    nominal
        What the model says; NaN where it says nothing.
    matters
        How much the motion would differ if this were as the model says and all else were fitted
        again, to first order, as a share of the motion.
    """

    name: str
    unit: str
    description: str
    value: float
    error: float
    low: float
    high: float
    nominal: float = math.nan
    matters: float = math.nan

    @property
    def covers_nominal(self) -> bool:
        """Whether the interval holds the model's value."""
        return self.low <= self.nominal <= self.high


@dataclass(frozen=True, eq=False)
class Identification:
    """What a motion says of its mechanism.

    Attributes
    ----------
    estimates
        The identified quantities, by name.
    held
        Parameters kept at their nominal values: the motion does not tell them apart.
    residual
        RMS of measured less predicted, (n,), rad or m.
    before
        The same with the nominal model.
    explained
        Share of the motion that is explained, (n,), 1 for all of it.
    predicted
        What the identified model says of the motion, (N, n), about the same zero as measured.
    mechanism
        The mechanism with the identified parameters.
    """

    estimates: Mapping[str, Estimate]
    held: tuple[str, ...]
    residual: FloatArray
    before: FloatArray
    explained: FloatArray
    predicted: FloatArray
    mechanism: Mechanism


@dataclass(frozen=True)
class _Variable:
    """A free quantity: scaled by ``scale``, counted from ``start``."""

    name: str
    unit: str
    description: str
    start: float
    scale: float
    low: float
    high: float
    nominal: float


def _tell(progress: Callable[[str, float], None], part: float, what: str) -> None:
    progress(what, part)


def _beginning(record: Record) -> tuple[FloatArray, FloatArray]:
    """Return where a motion begins about its middle, and how fast, (n,) each: a first guess."""
    late = min(len(record), 20)
    slope = np.polyfit(record.t[:late] - record.t[0], record.q[:late], 1)[0]
    return record.q[:late].mean(axis=0) - record.q.mean(axis=0), slope


def _candidates(mechanism: Mechanism, coulomb: float, record: Record) -> list[_Variable]:
    """Return what may be free, in order of preference.

    Delay, dry friction, damping, inertias and motor constants first; then damping that the
    model leaves out, factors of the inputs, lengths, and masses last.
    """
    levels = (
        np.abs(np.array(mechanism.input_matrix.subs(mechanism.substitution), dtype=float))
        @ mechanism.input_limits
    )
    variables = [
        _Variable("delay", "s", "from a write to its effect in a reading", 1e-3, 1e-3, 0, 0.1,
                  math.nan)
    ]  # fmt: skip
    for i, c in enumerate(mechanism.coordinates):
        unit = "N m" if c.unit == "rad" else "N"
        size = 0.01 * float(levels[i]) if i < mechanism.m else coulomb
        what = f"dry friction of {c.name}"
        variables.append(
            _Variable(f"friction_{c.name}", unit, what, 0.3 * size, size, 0, np.inf, math.nan)
        )
        if i < mechanism.m:
            what = f"what it takes besides to break {c.name} away"
            variables.append(
                _Variable(f"breakaway_{c.name}", unit, what, 0.1 * size, size, 0, np.inf, math.nan)
            )

    def of(p: Parameter) -> _Variable:
        scale = abs(p.value) or 1e-3
        return _Variable(p.name, p.unit, p.description, p.value, scale, p.low, p.high, p.value)

    ranks = {"m": 1, "kg": 2, "m/s²": 3, "": 3}
    named = [
        [of(p) for p in mechanism.parameters if ranks.get(p.unit, 0) == rank and p.value]
        for rank in range(3)
    ]
    gains = [
        _Variable(f"gain_{i.name}", "", f"factor of {i.name}", 1.0, 1.0, 0.0, np.inf, 1.0)
        for i in mechanism.inputs
    ]
    dampers = [
        _Variable(
            f"damping_{c.name}",
            "N m s/rad" if c.unit == "rad" else "N s/m",
            f"damping of {c.name} besides the model's",
            0.0,
            coulomb,
            0,
            np.inf,
            0.0,
        )
        for c in mechanism.coordinates[mechanism.m :]
    ]
    # A passive joint may still swing when the record begins.
    place, speed = _beginning(record)
    begins = [
        _Variable(f"{stem}_{c.name}", c.unit + unit, "", guess[i], scale, -np.inf, np.inf, 0.0)
        for i, c in enumerate(mechanism.coordinates)
        for stem, unit, scale, guess in ((_START, "", 0.01, place), (_RATE, "/s", 0.05, speed))
        if i >= mechanism.m
    ]
    motors = {str(symbol) for symbol in mechanism.input_matrix.free_symbols}
    named[0].sort(key=lambda v: v.name not in motors)
    return [*begins, *variables, *named[0], *dampers, *gains, *named[1], *named[2]]


def identify(
    mechanism: Mechanism,
    x0: FloatArray,
    record: Record,
    *,
    confidence: float = 0.95,
    progress: Callable[[str, float], None] | None = None,
) -> Identification:
    """Identify parameters of a mechanism from a motion that begins at rest.

    Parameters
    ----------
    mechanism
        The model, whose parameter values are the first guess.
    x0
        Where it rests, (2n,).
    record
        Inputs and measured positions; wired as the model.
    confidence
        Of the intervals.
    progress
        Told what is under way.

    Returns
    -------
    Identification
        Estimates with confidence intervals from the Jacobian, corrected for residuals that are
        correlated in time (Newey and West, *Econometrica* 55(3), 1987), and no narrower than
        what the counting of the encoders alone would make them.

    Raises
    ------
    InvalidInputError
        When nothing moved.
    """
    fit = _Fit(mechanism, x0, record)
    free, z = fit.search(progress or (lambda _what, _fraction: None))
    J, r = fit.jacobian(free, z), fit.residual(free, z)
    away = fit.difference(free, z)
    variances = np.maximum(
        correlated(J, r, mechanism.n), counted(fit.moved - away, away, fit.sigma, J)
    )
    quantile = float(scipy.stats.norm.ppf(0.5 + confidence / 2))
    estimates = {}
    alone = 1.0 / np.sqrt(np.diag(np.linalg.pinv(J.T @ J)))  # of each column, the rest fitted
    motion = float(np.linalg.norm((fit.moved - fit.moved.mean(axis=0)) / fit.sigma))
    for v, scaled, variance, size in zip(free, z, variances, alone, strict=True):
        if v.name.startswith("_"):
            continue
        value, error = float(scaled * v.scale), float(math.sqrt(variance) * v.scale)
        estimates[v.name] = Estimate(
            v.name,
            v.unit,
            v.description,
            value,
            error,
            value - quantile * error,
            value + quantile * error,
            v.nominal,
            abs(value - v.nominal) / v.scale * float(size) / motion,
        )
    known = {p.name for p in mechanism.parameters}
    changed = {k: e.value for k, e in estimates.items() if k in known}
    held = tuple(p.name for p in mechanism.parameters if p.name not in changed)
    return Identification(
        estimates,
        held,
        fit.difference(free, z).std(axis=0),
        fit.difference([], np.zeros(0)).std(axis=0),
        fit.explained(free, z),
        record.moved - fit.difference(free, z),
        mechanism.with_parameters(**changed),
    )


class _Fit:
    """Residuals and Jacobians of one record."""

    def __init__(self, mechanism: Mechanism, x0: FloatArray, record: Record) -> None:
        self.mechanism, self.whole = mechanism, record
        self.predictor = Predictor(mechanism, x0)
        self.look_at(math.inf, 1.0)
        if not (np.abs(self.moved).max(axis=0) > 0).any():
            raise InvalidInputError(
                "motion to identify from",
                value="nothing moved",
                limit="some motion",
                remedy="Use a larger input",
            )
        steps = np.abs(np.diff(record.q, axis=0))
        counts = [s[s > 0].min() if (s > 0).any() else np.inf for s in steps.T]
        least = 1e-4 * np.abs(self.moved).max(axis=0)
        self.sigma = np.maximum(np.array(counts) / math.sqrt(12), least)
        passive = float(np.abs(mechanism.forces(0.0, x0 + 0.1, np.zeros(mechanism.n))).max())
        self.candidates = _candidates(mechanism, 0.01 * max(passive, 1e-3), record)

    def look_at(self, piece: float, part: float) -> None:
        """Fit the first part of the motion from here on, in pieces so long, s.

        A piece begins in a state that is read from the measurement, and what only matters
        between pieces is held: how the motion begins, the delay, breaking away.
        """
        whole = self.whole
        self.pieces = math.isfinite(piece)
        period = float(np.median(np.diff(whole.t)))
        self.length = round(piece / period) if self.pieces else 0
        if self.pieces:
            window = 2 * max(3, round(0.5 * WINDOW / period)) + 1
            q = whole.moved + self.predictor.x0[: self.mechanism.n]
            smooth = [
                scipy.signal.savgol_filter(q, window, 3, deriv=d, delta=period, axis=0)
                for d in (0, 1)
            ]
            self.read = np.hstack(smooth)
        begins = int(np.argmax(np.abs(whole.u).max(axis=1) > 0))
        count = begins + math.ceil(part * (len(whole) - begins))
        self.record = Record(whole.t[:count], whole.q[:count], whole.u[:count])
        self.moved = whole.moved[:count]

    def _simulate(self, values: Mapping[str, float]) -> FloatArray:
        mechanism = self.mechanism
        parameters = np.array([values.get(p.name, p.value) for p in mechanism.parameters])
        coulomb = np.array([values.get(f"friction_{c.name}", 0.0) for c in mechanism.coordinates])
        excess = [values.get(f"breakaway_{c.name}", 0.0) for c in mechanism.coordinates]
        gain = np.array([values.get(f"gain_{i.name}", 1.0) for i in mechanism.inputs])
        viscous = np.array([values.get(f"damping_{c.name}", 0.0) for c in mechanism.coordinates])
        start = self.predictor.x0.copy()
        for i, c in enumerate(mechanism.coordinates):
            start[i] += values.get(f"{_START}_{c.name}", 0.0)
            start[mechanism.n + i] += values.get(f"{_RATE}_{c.name}", 0.0)
        friction = np.stack([coulomb, coulomb + excess])
        if self.pieces:
            rows = np.empty((len(self.record), mechanism.n))
            for first in range(0, len(rows), self.length):
                few = slice(first, first + self.length)
                record = Record(self.record.t[few], self.record.q[few], self.record.u[few])
                states = self.predictor.states(
                    record, parameters, friction, viscous, gain, self.read[first]
                )
                rows[few] = states[:, : mechanism.n]
            return np.asarray(rows - self.predictor.x0[: mechanism.n])
        states = self.predictor.states(self.record, parameters, friction, viscous, gain, start)
        q = self.predictor.positions(self.record, states, values.get("delay", 0.0))
        return np.asarray(q - self.predictor.x0[: mechanism.n])

    def difference(self, free: list[_Variable], z: FloatArray) -> FloatArray:
        """Measured less predicted, (N, n), each coordinate about its mean: its zero is free."""
        values = {v.name: float(a) * v.scale for v, a in zip(free, z, strict=True)}
        away = self.moved - self._simulate(values)
        return np.asarray(away - away.mean(axis=0))

    def residual(self, free: list[_Variable], z: FloatArray) -> FloatArray:
        """The same in standard deviations of a count, one coordinate after the other."""
        away = np.nan_to_num(
            self.difference(free, z) / self.sigma, nan=0.0, posinf=1e6, neginf=-1e6
        )
        return np.asarray(np.clip(away, -1e6, 1e6).T.ravel())

    def jacobian(self, free: list[_Variable], z: FloatArray) -> FloatArray:
        """Central differences in the scaled variables."""
        columns = []
        for k, v in enumerate(free):
            ahead, behind = z.copy(), z.copy()
            ahead[k] += STEP
            behind[k] = max(z[k] - STEP, v.low / v.scale + 1e-12)
            up, down = self.residual(free, ahead), self.residual(free, behind)
            columns.append((up - down) / (ahead[k] - behind[k]))
        return np.array(columns).T

    def _start(self, variables: list[_Variable], values: Mapping[str, float]) -> FloatArray:
        start = [values.get(v.name, v.start) / v.scale for v in variables]
        return np.clip(start, *self._bounds(variables))

    def _bounds(self, variables: list[_Variable]) -> FloatArray:
        ends = np.array([[v.low / v.scale + 1e-9, v.high / v.scale - 1e-9] for v in variables])
        return ends.T

    def solve(
        self, free: list[_Variable], values: Mapping[str, float], tolerance: float
    ) -> FloatArray:
        """Return the scaled variables of the least squares, starting from some values."""
        low, high = self._bounds(free)

        def residual(z: FloatArray) -> FloatArray:
            return self.residual(free, z)

        def jacobian(z: FloatArray) -> FloatArray:
            return self.jacobian(free, z)

        # Quantities differ in how sharply they are seen by four decades: without the scale of
        # the Jacobian's columns the search creeps, and stops short of the least squares by
        # more than the intervals are wide.
        found = scipy.optimize.least_squares(
            residual,
            self._start(free, values),
            jac=jacobian,
            bounds=(low, high),
            x_scale="jac",
            ftol=tolerance,
            xtol=tolerance,
            max_nfev=60,
        )
        return np.asarray(found.x)

    def explained(self, free: list[_Variable], z: FloatArray) -> FloatArray:
        """Share of each coordinate's motion that is explained, (n,)."""
        swing = np.maximum(self.moved.std(axis=0), 1e-300)
        return np.asarray(1.0 - (self.difference(free, z).std(axis=0) / swing) ** 2)

    def search(self, progress: Callable[[str, float], None]) -> tuple[list[_Variable], FloatArray]:
        """Return the least squares of the best of the ways: of the first, if that will do."""
        best: tuple[float, list[_Variable], FloatArray] | None = None
        for number, route in enumerate(ROUTES):
            progress("which quantities the motion tells apart", number / len(ROUTES))
            free, z = self.follow(route, partial(_tell, progress, number / len(ROUTES)))
            cost = float((self.residual(free, z) ** 2).sum())
            if best is None or cost < best[0]:
                best = cost, free, z
            if (self.explained(best[1], best[2]) > ENOUGH).all():
                break
        assert best is not None  # there are ways
        return best[1], best[2]

    def follow(
        self, route: tuple[Stage, ...], tell: Callable[[str], None]
    ) -> tuple[list[_Variable], FloatArray]:
        """Fit stage by stage; what a whole motion told apart once stays free."""
        values: dict[str, float] = {}
        free: list[_Variable] = []
        self.pieces = True
        for number, (piece, part, sharp) in enumerate(route):
            first = [] if self.pieces else free
            self.look_at(piece, part)
            free = self.choose(values, first, () if sharp else ("breakaway_",))
            tell(f"identifying {len(free)} quantities")
            z = self.solve(free, values, 1e-9 if number == len(route) - 1 else 1e-4)
            values = {v.name: float(a) * v.scale for v, a in zip(free, z, strict=True)}
        return free, z

    def choose(
        self, values: Mapping[str, float], first: list[_Variable], without: tuple[str, ...]
    ) -> list[_Variable]:
        """Return the free variables: each tells something that those before it do not."""
        held = (*without, "_", "delay") if self.pieces else without
        rest = [v for v in self.candidates if v not in first and not v.name.startswith(held)]
        offered = [*first, *rest]
        J = self.jacobian(offered, self._start(offered, values))
        free: list[_Variable] = []
        basis = np.zeros((len(J), 0))
        for v, column in zip(offered, J.T, strict=True):
            length = float(np.linalg.norm(column))
            rest = column - basis @ (basis.T @ column)
            rest -= basis @ (basis.T @ rest)
            # A change by its whole size must be seen against one count in every sample.
            if length > math.sqrt(len(J)) / 3 and np.linalg.norm(rest) > INDEPENDENT * length:
                free.append(v)
                basis = np.column_stack([basis, rest / np.linalg.norm(rest)])
        return free
