"""Least squares of a recorded motion: which quantities are free, and ways to the least.

Which parameters are free is decided first: one whose column of the Jacobian is a combination of
those already chosen is held (subset selection; Brun, Reichert, Künsch, *Water Resources Research*
37(4), 2001).  One whose column is nearly that is held in the end, unless the fit needs it.

What a reading is worth: an encoder's error is the same for as long as nothing moves by a count,
unless noise stirs it: a hundred readings at rest are one reading.  Least squares that take them
for a hundred follow the encoder's zero, and their residuals, small and white, do not show it.  How
long a motion dwells is known from its prediction, and each reading weighs accordingly.  J is the
Jacobian of the weighed residuals, (N n, p), its rows coordinate by coordinate.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import scipy.optimize
import scipy.signal

from undertow.base import InvalidInputError, Progress
from undertow.bring_up.motion import MotionRecord, Predictor
from undertow.models import FloatArray, Mechanism, Parameter
from undertow.plants import full_forces

#: Encoder zeros from which a predicted motion is counted.
ZEROS = 200

#: Terms of the Fourier series of a counting error: beyond them less than a hundredth is left.
TERMS = 60


def dwell(y: FloatArray, reach: float) -> FloatArray:
    """Return how many samples around each one stay within reach of it without a break, (N,)."""
    length = np.ones(len(y))
    for way in (1, -1):
        rows, many = y[::way], length[::way]
        staying, k = np.arange(len(y)), 1
        while len(staying):
            staying = staying[staying + k < len(y)]
            staying = staying[np.abs(rows[staying + k] - rows[staying]) < reach]
            many[staying] += 1
            k += 1
    return length


def readings(
    predicted: FloatArray, away: FloatArray, sigma: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return noise beyond counting, (n,), and the variance each reading counts with, (N, n).

    The counting error of a place is a sawtooth of it.  With noise s before a counter of step Δ,
    the part of it that stays is what is left of the sawtooth after smoothing, of variance
    Σ (Δ/(√2 π k))² exp(−(2π k s/Δ)²); all else is new in every sample (Widrow and Kollár,
    *Quantization Noise*, Cambridge 2008, ch. 4 and 17).  Readings that share an error count as
    one: its variance is taken times their number.

    ``predicted`` is the motion, (N, n), rad or m, ``away`` measured less predicted, (N, n), and
    ``sigma`` the standard deviation of a count, (n,): its size by √12.
    """
    step = sigma * math.sqrt(12)
    shared = np.column_stack(
        [dwell(row, 0.5 * size) for row, size in zip(predicted.T, step, strict=True)]
    )
    centred = away - np.average(away, axis=0, weights=1 / shared)
    excess = np.average(centred**2, axis=0, weights=1 / shared) - sigma**2
    noise = np.sqrt(np.maximum(excess, 0.0))
    k = np.arange(1, TERMS + 1)[:, None]
    waves = 0.5 * (step / (np.pi * k)) ** 2 * np.exp(-((2 * np.pi * k * noise / step) ** 2))
    stays = np.minimum(waves.sum(axis=0), sigma**2)
    return noise, noise**2 + sigma**2 - stays + stays * shared


def correlated(J: FloatArray, r: FloatArray, n: int) -> FloatArray:
    """Return variances that residuals correlated in time make, (p,): Newey and West.

    The diagonal of (JᵀJ)⁻¹ S (JᵀJ)⁻¹, S with Bartlett's weights; rows coordinate by coordinate.
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
    return np.asarray(np.diag(freedom * inverse @ S @ inverse))


def clustered(J: FloatArray, r: FloatArray, n: int) -> FloatArray:
    """Return variances that residuals correlated within each of ``PARTS`` of a motion make, (p,).

    The diagonal of (JᵀJ)⁻¹ S (JᵀJ)⁻¹, S the sum of g gᵀ with g the sum of all scores in a part
    (Liang and Zeger, *Biometrika* 73(1), 1986); rows coordinate by coordinate. What the model
    leaves out, say a friction of another form, makes residuals far below a count that are alike for
    a whole push: from sample to sample they do not show.
    """
    inverse = np.linalg.pinv(J.T @ J)
    scores = sum(np.split(J * r[:, None], n))
    sums = np.array([part.sum(axis=0) for part in np.array_split(scores, PARTS)])
    spread = sums.T @ sums * PARTS / (PARTS - 1)
    return np.asarray(np.diag(inverse @ spread @ inverse))


def counted(
    predicted: FloatArray, noise: FloatArray, sigma: FloatArray, variance: FloatArray, J: FloatArray
) -> FloatArray:
    """Return variances that the encoders alone would make of a predicted motion, (p,).

    The predicted motion is counted from many zeros, with the noise that there is, and each
    time the least squares are followed to first order.

    ``predicted`` is the motion, (N, n), rad or m; ``noise`` and ``variance`` are those of
    :func:`readings`, ``sigma`` is the standard deviation of a count, (n,), and J see above.
    """
    rng = np.random.default_rng(0)
    step, solve, draws = sigma * math.sqrt(12), np.linalg.pinv(J), []
    for _ in range(ZEROS):
        zero = rng.uniform(size=len(step))
        true = predicted + noise * rng.standard_normal(predicted.shape)
        error = (np.floor(true / step + zero) - zero + 0.5) * step - predicted
        error -= np.average(error, axis=0, weights=1 / variance)
        draws.append(solve @ (error / np.sqrt(variance)).T.ravel())
    return np.asarray(np.var(draws, axis=0, ddof=1))


#: Parts of a motion that :func:`clustered` takes for independent.
PARTS = 16

#: Names of what a record begins with: fitted, not reported.
START, RATE = "_start", "_rate"


@dataclass(frozen=True)
class Quantity:
    """A free quantity: scaled by ``scale``, counted from ``start``."""

    name: str
    unit: str
    description: str
    start: float
    scale: float
    nominal: float = math.nan
    low: float = 0.0
    high: float = math.inf


def _beginning(record: MotionRecord) -> tuple[FloatArray, FloatArray]:
    """Return where a motion begins about its middle, and how fast, (n,) each: a first guess."""
    late = min(len(record), 20)
    slope = np.polyfit(record.t[:late] - record.t[0], record.q[:late], 1)[0]
    return record.q[:late].mean(axis=0) - record.q.mean(axis=0), slope


def candidates(mechanism: Mechanism, coulomb: float, record: MotionRecord) -> list[Quantity]:
    """Return what may be free, in order of preference.

    Delay, dry friction, damping, inertias and motor constants first; then damping that the
    model leaves out, factors of the inputs, lengths, and masses last.
    """
    levels = full_forces(mechanism)
    what = "from a write to its effect in a reading"
    variables = [Quantity("delay", "s", what, 1e-3, 1e-3, high=0.1)]
    for i, c in enumerate(mechanism.coordinates):
        unit = mechanism.force_units[i]
        size = 0.01 * float(levels[i]) if i < mechanism.m else coulomb
        what = f"dry friction of {c.name}"
        variables.append(Quantity(f"friction_{c.name}", unit, what, 0.3 * size, size))
        if i < mechanism.m:
            what = f"what it takes besides to break {c.name} away"
            variables.append(Quantity(f"breakaway_{c.name}", unit, what, 0.1 * size, size))

    def of(p: Parameter) -> Quantity:
        scale = abs(p.value) or 1e-3
        return Quantity(p.name, p.unit, p.description, p.value, scale, p.value, p.low, p.high)

    ranks = {"m": 1, "kg": 2, "m/s²": 3, "": 3}
    named = [
        [of(p) for p in mechanism.parameters if ranks.get(p.unit, 0) == rank and p.value]
        for rank in range(3)
    ]
    gains = [
        Quantity(f"gain_{i.name}", "", f"factor of {i.name}", 1.0, 1.0, 1.0)
        for i in mechanism.inputs
    ]
    dampers = []
    for c in mechanism.coordinates[mechanism.m :]:
        unit = "N m s/rad" if c.unit == "rad" else "N s/m"
        what = f"damping of {c.name} besides the model's"
        dampers.append(Quantity(f"damping_{c.name}", unit, what, 0.0, coulomb, 0.0))
    # A passive joint may still swing when the record begins.
    place, speed = _beginning(record)
    begins = [
        Quantity(f"{stem}_{c.name}", c.unit + unit, "", guess[i], scale, 0.0, -np.inf)
        for i, c in enumerate(mechanism.coordinates)
        for stem, unit, scale, guess in ((START, "", 0.01, place), (RATE, "/s", 0.05, speed))
        if i >= mechanism.m
    ]
    motors = {str(symbol) for symbol in mechanism.input_matrix.free_symbols}
    named[0].sort(key=lambda v: v.name not in motors)
    return [*begins, *variables, *named[0], *dampers, *gains, *named[1], *named[2]]


#: Sine of the angle to the chosen columns below which a parameter is held, and below which it is
#: held in the end unless the fit needs it.
INDEPENDENT, DOUBTFUL = 0.05, 0.15

#: The fit needs a parameter where holding it makes the sum of squares larger by this part.  One
#: that is in proportion to others does not change it, however exact the motion is.
NEEDED = 0.1

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

#: Mean square of the residuals, in standard deviations of a count, at which no other way is
#: tried: a motion that is followed to a few counts has not come out of step.
ENOUGH = 10.0

#: Names of what a fit is begun again without begin with.
SHARP = ("delay", "friction_", "breakaway_")

#: Window of the polynomials that a piece's first state is read from, s.
WINDOW = 0.02

#: Central differences in scaled variables.
STEP = 2e-3


def _values(free: list[Quantity], z: FloatArray) -> dict[str, float]:
    return {v.name: float(a) * v.scale for v, a in zip(free, z, strict=True)}


class Fit:
    """Residuals and Jacobians of one record."""

    def __init__(self, mechanism: Mechanism, x0: FloatArray, record: MotionRecord) -> None:
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
        self.noise = np.zeros(mechanism.n)
        self.variance = self.sigma[None, :] ** 2
        passive = float(np.abs(mechanism.forces(0.0, x0 + 0.1, np.zeros(mechanism.n))).max())
        self.candidates = candidates(mechanism, 0.01 * max(passive, 1e-3), record)

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
        self.record = MotionRecord(whole.t[:count], whole.q[:count], whole.u[:count])
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
            start[i] += values.get(f"{START}_{c.name}", 0.0)
            start[mechanism.n + i] += values.get(f"{RATE}_{c.name}", 0.0)
        friction = np.stack([coulomb, coulomb + excess])
        if self.pieces:
            rows = np.empty((len(self.record), mechanism.n))
            for first in range(0, len(rows), self.length):
                few = slice(first, first + self.length)
                record = MotionRecord(self.record.t[few], self.record.q[few], self.record.u[few])
                states = self.predictor.states(
                    record, parameters, friction, viscous, gain, self.read[first]
                )
                rows[few] = states[:, : mechanism.n]
            return np.asarray(rows - self.predictor.x0[: mechanism.n])
        states = self.predictor.states(self.record, parameters, friction, viscous, gain, start)
        q = self.predictor.positions(self.record, states, values.get("delay", 0.0))
        return np.asarray(q - self.predictor.x0[: mechanism.n])

    def difference(self, free: list[Quantity], z: FloatArray) -> FloatArray:
        """Measured less predicted, (N, n), each coordinate about its mean: its zero is free."""
        away = self.moved - self._simulate(_values(free, z))
        return np.asarray(away - away.mean(axis=0))

    @np.errstate(over="ignore", invalid="ignore")  # a guess that runs away is only far off
    def residual(self, free: list[Quantity], z: FloatArray) -> FloatArray:
        """The same, each in its standard deviation, one coordinate after the other."""
        away = self.difference(free, z)
        weights = np.broadcast_to(1.0 / self.variance, away.shape)
        away -= (weights * away).sum(axis=0) / weights.sum(axis=0)
        away = np.nan_to_num(away * np.sqrt(weights), nan=1e6, posinf=1e6, neginf=-1e6)
        return np.asarray(np.clip(away, -1e6, 1e6).T.ravel())

    def cost(self, free: list[Quantity], z: FloatArray) -> float:
        """The sum of their squares."""
        return float((self.residual(free, z) ** 2).sum())

    def jacobian(
        self, free: list[Quantity], z: FloatArray, here: FloatArray | None = None
    ) -> FloatArray:
        """Differences in the scaled variables: central, or from the residuals ``here``."""
        columns = []
        for k, v in enumerate(free):
            ahead, behind = z.copy(), z.copy()
            ahead[k] += STEP
            up = self.residual(free, ahead)
            if here is not None:
                columns.append((up - here) / STEP)
                continue
            behind[k] = max(z[k] - STEP, v.low / v.scale + 1e-12)
            columns.append((up - self.residual(free, behind)) / (ahead[k] - behind[k]))
        return (
            np.array(columns).reshape(len(free), -1).T if free else np.empty((self.moved.size, 0))
        )

    def without(self, v: Quantity, free: list[Quantity], z: FloatArray) -> dict[str, float]:
        """Values of the others, to first order, where a free quantity is held at the model's."""
        fewer = [other for other in free if other is not v]
        kept = np.array([a for a, other in zip(z, free, strict=True) if other is not v])
        change = v.nominal / v.scale - float(z[free.index(v)])
        return _values(fewer, kept + change * self.shifts(fewer, kept, [v])[:, 0])

    def shifts(self, free: list[Quantity], z: FloatArray, held: list[Quantity]) -> FloatArray:
        """Change of the scaled variables by all of a held one more, to first order, (p, h)."""
        start = self._start(held, {v.name: v.nominal for v in held})
        J = self.jacobian([*free, *held], np.concatenate([z, start]))
        return np.asarray(-np.linalg.pinv(J[:, : len(free)]) @ J[:, len(free) :])

    def _start(self, variables: list[Quantity], values: Mapping[str, float]) -> FloatArray:
        start = [values.get(v.name, v.start) / v.scale for v in variables]
        return np.clip(start, *self._bounds(variables))

    def _bounds(self, variables: list[Quantity]) -> FloatArray:
        ends = np.array([[v.low / v.scale + 1e-9, v.high / v.scale - 1e-9] for v in variables])
        return ends.T

    def solve(
        self, free: list[Quantity], values: Mapping[str, float], tolerance: float
    ) -> FloatArray:
        """Return the scaled variables of the least squares, starting from some values."""
        if not free:
            return np.empty(0)  # a motion that is nothing like the model's tells nothing
        fine = tolerance < 1e-6
        low, high = self._bounds(free)

        def residual(z: FloatArray) -> FloatArray:
            return self.residual(free, z)

        def jacobian(z: FloatArray) -> FloatArray:
            return self.jacobian(free, z, None if fine else self.residual(free, z))

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

    def weigh(self, free: list[Quantity], z: FloatArray) -> FloatArray:
        """Let every reading count for what it is worth from now on, and fit again."""
        away = self.difference(free, z)
        self.noise, self.variance = readings(self.moved - away, away, self.sigma)
        return self.solve(free, _values(free, z), 1e-9)

    def explained(self, free: list[Quantity], z: FloatArray) -> FloatArray:
        """Share of each coordinate's motion that is explained, (n,)."""
        swing = np.maximum(self.moved.std(axis=0), 1e-300)
        return np.asarray(1.0 - (self.difference(free, z).std(axis=0) / swing) ** 2)

    def search(self, progress: Progress) -> tuple[list[Quantity], FloatArray]:
        """Return the least squares of the best of the ways: of the first, if that will do.

        What is sharp, delay and dry friction, leaves minima beside the least: from each of them
        at zero the fit is begun again.
        """
        best: tuple[float, list[Quantity], FloatArray] | None = None
        for number, route in enumerate(ROUTES):
            part = number / len(ROUTES)
            progress("which quantities the motion tells apart", part)
            free, z = self.follow(route, progress, part)
            cost = self.cost(free, z)
            if best is None or cost < best[0]:
                best = cost, free, z
            if best[0] <= ENOUGH * self.moved.size:
                break
        assert best is not None  # there are ways
        cost, free, z = best
        sure = self.choose(_values(free, z), [], (), DOUBTFUL)
        for v in reversed([v for v in free if v not in sure and math.isfinite(v.nominal)]):
            fewer = [other for other in free if other is not v]
            rest = self.solve(fewer, self.without(v, free, z), 1e-5)
            higher = self.cost(fewer, rest)
            if higher < cost:  # so the least squares had not been reached
                z = self.solve(free, _values(fewer, rest) | {v.name: v.nominal}, 1e-5)
                cost = self.cost(free, z)
            if higher < (1 + NEEDED) * cost:
                cost, free, z = higher, fewer, rest
        progress("beginning again beside it", 1 - 0.5 / len(ROUTES))
        for v in free:
            values = _values(free, z)
            if v.name.startswith(SHARP) and values[v.name] > 0:
                other = self.solve(free, values | {v.name: 0.0}, 1e-5)
                lower = self.cost(free, other)
                if lower < cost:
                    cost, z = lower, other
        return free, z

    def follow(
        self, route: tuple[Stage, ...], progress: Progress, part_done: float
    ) -> tuple[list[Quantity], FloatArray]:
        """Fit stage by stage; what a whole motion told apart once stays free."""
        values: dict[str, float] = {}
        free: list[Quantity] = []
        self.pieces = True
        for number, (piece, part, sharp) in enumerate(route):
            first = [] if self.pieces else free
            self.look_at(piece, part)
            free = self.choose(values, first, () if sharp else ("breakaway_",))
            progress(f"identifying {len(free)} quantities", part_done)
            z = self.solve(free, values, 1e-9 if number == len(route) - 1 else 1e-4)
            values = _values(free, z)
        return free, z

    def choose(
        self,
        values: Mapping[str, float],
        first: list[Quantity],
        without: tuple[str, ...],
        independent: float = INDEPENDENT,
    ) -> list[Quantity]:
        """Return the free variables: each tells something that those before it do not."""
        held = (*without, "_", "delay") if self.pieces else without
        rest = [v for v in self.candidates if v not in first and not v.name.startswith(held)]
        offered = [*first, *rest]
        J = self.jacobian(offered, self._start(offered, values))
        free: list[Quantity] = []
        basis = np.zeros((len(J), 0))
        for v, column in zip(offered, J.T, strict=True):
            length = float(np.linalg.norm(column))
            rest = column - basis @ (basis.T @ column)
            rest -= basis @ (basis.T @ rest)
            # A change by its whole size must be seen against one count in every sample.
            if length > math.sqrt(len(J)) / 3 and np.linalg.norm(rest) > independent * length:
                free.append(v)
                basis = np.column_stack([basis, rest / np.linalg.norm(rest)])
        return free
