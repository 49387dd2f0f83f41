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

import numpy as np
import scipy.optimize
import scipy.stats

from undertow.bring_up.motion import Record
from undertow.bring_up.predict import Predictor
from undertow.errors import InvalidInputError
from undertow.mechanism import FloatArray, Mechanism, Parameter

__all__ = ["Estimate", "Identification", "identify"]

#: Sine of the angle to the chosen columns below which a parameter is held.
INDEPENDENT = 0.15

#: Names of what a record begins with: fitted, not reported.
_START, _RATE = "_start", "_rate"

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
    """

    name: str
    unit: str
    description: str
    value: float
    error: float
    low: float
    high: float
    nominal: float = math.nan

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


def _candidates(mechanism: Mechanism, coulomb: float) -> list[_Variable]:
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
    # A passive joint may still swing a little when the record begins.
    begins = [
        _Variable(f"{stem}_{c.name}", c.unit + unit, "", 0.0, scale, -np.inf, np.inf, 0.0)
        for c in mechanism.coordinates[mechanism.m :]
        for stem, unit, scale in ((_START, "", 0.01), (_RATE, "/s", 0.05))
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
        correlated in time (Newey and West, *Econometrica* 55(3), 1987).

    Raises
    ------
    InvalidInputError
        When nothing moved.
    """
    fit = _Fit(mechanism, x0, record)
    if progress is not None:
        progress("which quantities the motion tells apart", 0.0)
    values: dict[str, float] = {}
    # Breaking away is sharp: it is added when the rest is nearly right.
    for stage, smooth in enumerate((True, False)):
        free = fit.choose(values, without="breakaway_" if smooth else None)
        if progress is not None:
            progress(f"identifying {len(free)} quantities", 0.2 + 0.4 * stage)
        z = fit.solve(free, values, 1e-4 if smooth else 1e-9)
        values = {v.name: float(a) * v.scale for v, a in zip(free, z, strict=True)}
    J, r = fit.jacobian(free, z), fit.residual(free, z)
    covariance = _covariance(J, r, mechanism.n)
    quantile = float(scipy.stats.norm.ppf(0.5 + confidence / 2))
    estimates = {}
    for v, scaled, variance in zip(free, z, np.diag(covariance), strict=True):
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
        )
    known = {p.name for p in mechanism.parameters}
    changed = {k: e.value for k, e in estimates.items() if k in known}
    held = tuple(p.name for p in mechanism.parameters if p.name not in changed)
    after = fit.difference(free, z).std(axis=0)
    swing = np.maximum(record.moved.std(axis=0), 1e-300)
    return Identification(
        estimates,
        held,
        after,
        fit.difference([], np.zeros(0)).std(axis=0),
        1.0 - (after / swing) ** 2,
        record.moved - fit.difference(free, z),
        mechanism.with_parameters(**changed),
    )


def _covariance(J: FloatArray, r: FloatArray, n: int) -> FloatArray:
    """(JᵀJ)⁻¹ S (JᵀJ)⁻¹, S with Bartlett's weights; rows come coordinate by coordinate.

    How far the weights reach follows from the residuals (Andrews, *Econometrica* 59(3), 1991,
    (5.3), (6.2) and (6.4)): a reach that white ones do not need only makes S smaller.
    """
    inverse = np.linalg.pinv(J.T @ J)
    S = np.zeros_like(inverse)
    for part, rest in zip(np.split(J, n), np.split(r, n), strict=True):
        scores = part * rest[:, None]
        S += scores.T @ scores
        power = float(rest @ rest)
        near = float(rest[1:] @ rest[:-1]) / power if power > 0 else 0.0
        alpha = 4 * near**2 / max((1 - near**2) ** 2, 1e-12)
        window = min(math.ceil(1.1447 * (alpha * len(rest)) ** (1 / 3)), len(rest) // 4)
        for lag in range(1, window):
            overlap = scores[lag:].T @ scores[:-lag]
            S += (1 - lag / window) * (overlap + overlap.T)
    freedom = len(r) / max(1, len(r) - J.shape[1])
    return np.asarray(freedom * inverse @ S @ inverse)


class _Fit:
    """Residuals and Jacobians of one record."""

    def __init__(self, mechanism: Mechanism, x0: FloatArray, record: Record) -> None:
        self.mechanism, self.record = mechanism, record
        self.predictor = Predictor(mechanism, x0)
        self.moved = record.moved
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
        self.candidates = _candidates(mechanism, 0.01 * max(passive, 1e-3))

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
        states = self.predictor.states(
            self.record, parameters, np.stack([coulomb, coulomb + excess]), viscous, gain, start
        )
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

    def choose(self, values: Mapping[str, float], without: str | None) -> list[_Variable]:
        """Return the free variables: each tells something that those before it do not."""
        offered = [v for v in self.candidates if without is None or not v.name.startswith(without)]
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
