"""What is known of a plant: its parameters with tolerances, narrowed by what its motion shows.

A belief is a mechanism whose parameters have tolerances.  Measured states and inputs tell more:
over a sample from t to t + h

    q̇(t + h) − q̇(t)  =  ∫ q̈(x, u; θ) dt  ≈  h/2 (q̈(x, u; θ) + q̈(x₊, u₊; θ)),

which is fitted to θ by least squares, sample after sample (an information filter whose new samples
are linearised at their own solution).  What is left uncertain spans an ensemble: the estimate, and
the corners of its confidence ellipsoid that a two-level orthogonal design names.

Where the largest change of velocity that the model does not explain is known, each sample says more
than that something is likely: all θ outside a slab are impossible.  What all slabs leave lies in a
box, which the estimate does not leave and the ensemble spans (bounded-error estimation).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import get_args

import numpy as np
from numpy.typing import ArrayLike

from undertow.base import (
    InvalidInputError,
    ModelError,
    ReadOnly,
    check_fields,
    checked,
    checked_names,
    floats,
    one_for_each,
    one_of,
    positive,
)
from undertow.closed_loop import Ensemble, Risk
from undertow.law import LawLayout
from undertow.models import (
    AT_REST,
    FloatArray,
    Mechanism,
    Parameter,
    force_scale,
    full_accelerations,
    linear_accelerations,
    number_of,
)

#: Standard deviation of what is evenly spread over ± a tolerance, as a part of it.
EVEN = 1.0 / math.sqrt(3.0)

#: What is never known better, as a part of the tolerance: what the model leaves out looks like an
#: error of its parameters, and least time goes right past singular plants.
LEAST = 0.2

#: How far a parameter is usually off where nobody says, as a part of its value, by its unit.
#: What has no unit, gravity and zeros count as exact.
USUAL = {"kg": 0.2, "kg m²": 0.2, "m": 0.05, "N m s/rad": 0.5, "N s/m": 0.5}
OTHERS, EXACT = 0.1, ("", "m/s²")

#: How many axes of what is uncertain span an ensemble, at most: those that matter most.
AXES = 7

#: Members with small errors of state and surface; the errors, as a part of a surface's entries,
#: and of positions, rad and m, but this part of the travel on either side where that is less: a
#: mechanism may be smaller than the usual error.
SLIPS = 16
SLIP_OF_SURFACE = 1e-3
SLIP_OF_STATE, SLIP_OF_TRAVEL = {"rad": 2e-3, "m": 2e-4}, 0.01
#: A state is off by this part of its distance from the target at most.  Nearly home, a larger error
#: would have to be made good anew at each decision in what little time is left, and is never there.
SLIP_OF_DISTANCE = 0.01
#: Half a percent of the change of velocity over 2 ms at full inputs, s, is noise; and the noise of
#: what no input moves at the target, rad/s or m/s.
SMALL, UNDRIVEN = 0.005 * 0.002, 0.004

#: Relative step of the differences by which accelerations are linearised in the parameters.
STEP = 1e-5

#: Part of how much an acceleration changes over a sample that its mean may be off.
CORNER = 0.2

#: How much an acceleration's mean over a sample may be off at most, in that part: one that runs one
#: way, or jumps, is between the rectangles.  What a model bends over a box of parameters counts so
#: many times its second differences.  A box that narrows by less than this part of its sides has
#: come to rest, and so many sweeps over the slabs are made at most.
RECTANGLES, BENT, RESTS, SWEEPS = 0.5, 1.5, 0.02, 20

#: Gauss-Newton steps for one batch of samples, and the change of all parameters, as a part of
#: their tolerances, that ends them.
ROUNDS, ENOUGH = 4, 1e-4

#: Median of squared residuals, in standard deviations, beyond which the plant has changed: what
#: was learnt before is forgotten then.  A few bad samples are no change.  Where nothing within the
#: tolerances explains what is seen, plants farther off do, up to so many tolerances.
CHANGED = 9.0
BEYOND = 6.0


@dataclass(frozen=True, eq=False)
class ParameterEstimate:
    """What is known of the uncertain parameters at one time.

    Attributes
    ----------
    offset
        θ − θ₀ in units of the tolerances, (p,); within ±1, unless the motion says otherwise.
    information
        Inverse covariance of ``offset``, (p, p), the prior's included.
    samples
        How many were used.
    low, high
        Between which offsets the truth is, (p,), if the bound of the belief holds; empty where it
        has none.
    contradictions
        How often no plant in the box explained a motion: bound or tolerances are too small, or
        the plant has changed.  The box was widened to the tolerances then.
    """

    offset: FloatArray
    information: FloatArray
    samples: int = 0
    low: FloatArray = field(default_factory=lambda: np.empty(0))
    high: FloatArray = field(default_factory=lambda: np.empty(0))
    contradictions: int = 0

    @property
    def deviation(self) -> FloatArray:
        """Standard deviations of ``offset``, (p,): 0.58 where nothing is known."""
        return np.sqrt(np.diag(np.linalg.inv(self.information)))


def _moves_target(mechanism: Mechanism, place: int, change: float) -> bool:
    """Whether a change of one parameter leaves the target a force that no input balances."""
    values = mechanism.parameter_values.copy()
    values[place] += change
    force = mechanism.function("force")(0.0, *np.zeros(2 * mechanism.n), *values)
    return max(abs(float(f)) for f in force[mechanism.m :]) > AT_REST * force_scale(mechanism)


@checked_names
@dataclass(frozen=True, eq=False)
class Belief:
    """A mechanism and what is not known of it.

    Parameters
    ----------
    mechanism
        The mechanism with its most plausible parameters.
    tolerances
        Names of uncertain parameters and how far they may be off, SI units.
    noise
        Standard deviation of how a velocity changes over one sample beyond what the model says, in
        the units of the velocities: one number, or one for each coordinate.  By default half a
        percent of what the full inputs do to each of them in 2 ms at the target: 0.004 rad/s for
        the rotary pendulum's, 0.0001 m/s for the cart of a crane.
    confidence
        How many standard deviations from the estimate the members of the ensemble stand; a
        deviation counts as a fifth of the tolerance at least.
    risk
        How costs on the members count, see :class:`undertow.closed_loop.Ensemble`.
    bound
        The largest change of velocity over one sample that the model does not explain, rad/s or
        m/s: one number, or one for each coordinate.  Parameters that contradict it are ruled out,
        and the ensemble spans all that are not; ``confidence`` does not count then.  A plant that
        changes is followed as soon as a motion contradicts all that was left.  ``None``: nothing is
        ruled out.

    Raises
    ------
    InvalidInputError
        For unknown parameters, and for tolerances that are not positive or reach beyond what makes
        physical sense, where M is not positive definite for instance; for a noise or a bound that
        is not positive.

    Examples
    --------
    >>> import undertow as ut
    >>> rig = ut.mechanisms.rotary_pendulum()
    >>> belief = Belief.relative(rig, m=0.2, l=0.05)
    >>> belief.tolerances["m"]
    0.025
    >>> len(belief.ensemble(belief.prior))
    21
    """

    mechanism: Mechanism
    tolerances: Mapping[str, float]
    noise: float | tuple[float, ...] | None = None
    confidence: float = 1.0
    risk: Risk = "mean"
    bound: float | tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        """Check names and numbers, and keep a copy of the tolerances."""
        check_fields(self)
        object.__setattr__(self, "tolerances", ReadOnly(self.tolerances))
        one_of("risk of a belief", self.risk, get_args(Risk))
        positive("confidence of a belief", self.confidence, "1 is usual", zero=True)
        known = {p.name: p for p in self.mechanism.parameters}
        for name, given in self.tolerances.items():
            one_of(f"uncertain parameter of '{self.mechanism.name}'", name, known)
            tolerance, parameter = number_of(f"tolerance of '{name}'", given), known[name]
            room = min(parameter.value - parameter.low, parameter.high - parameter.value)
            if not 0 < tolerance < room:
                raise InvalidInputError(
                    f"tolerance of parameter '{name}'",
                    value=f"{tolerance:g} {parameter.unit}",
                    limit=f"positive and below {room:g} {parameter.unit}, what its value "
                    f"{parameter.value:g} leaves",
                    remedy="Leave certain parameters out",
                )
            self._check_plants(parameter, tolerance)
        for name, most in (("noise", self.noise), ("bound", self.bound)):
            if most is not None:
                one_for_each(f"{name} of a belief", most, self.mechanism.n)

    def _check_plants(self, parameter: Parameter, tolerance: float) -> None:
        """Refuse a tolerance at one of whose ends there is no mechanism: a negative mass, say."""
        place = [p.name for p in self.mechanism.parameters].index(parameter.name)
        for change in (-tolerance, tolerance):
            values = self.mechanism.parameter_values
            values[place] += change
            try:
                self.mechanism.with_values(values)
            except ModelError as error:
                raise InvalidInputError(
                    f"tolerance of parameter '{parameter.name}'",
                    value=f"{tolerance:g} {parameter.unit}".rstrip(),
                    limit="one that leaves M(q) positive definite: with "
                    f"{parameter.name} = {values[place]:g} it has the {error.value}",
                    remedy="Give a smaller one; Parameter(low=0.0) says what must stay positive",
                ) from error

    @classmethod
    @checked
    def relative(cls, mechanism: Mechanism, /, **tolerances: float) -> Belief:
        """Return a belief whose tolerances are parts of the values: ``m=0.2`` is ±20 %."""
        values = {p.name: abs(p.value) for p in mechanism.parameters}
        for name in tolerances:
            one_of(f"uncertain parameter of '{mechanism.name}'", name, values)
        return cls(mechanism, {name: part * values[name] for name, part in tolerances.items()})

    @classmethod
    @checked
    def usual(cls, mechanism: Mechanism) -> Belief:
        """Return the belief of a mechanism whose parameters carry tolerances, or the usual ones.

        Usual is ±20 % of masses and inertias, ±5 % of lengths, ±50 % of damping and ±10 % of all
        else, gravity and numbers without a unit apart; and parameters that would move the
        target, which is then no equilibrium: an offset centre of mass, say.  Those are taken as
        known.
        """
        found: dict[str, float] = {}
        for place, p in enumerate(mechanism.parameters):
            part = 0.0 if p.unit in EXACT else USUAL.get(p.unit, OTHERS)
            tolerance = abs(p.value) * part if p.tolerance is None else p.tolerance
            room = min(p.value - p.low, p.high - p.value)
            if p.tolerance is None and not tolerance < room:
                tolerance = 0.5 * room
            if tolerance > 0 and not _moves_target(mechanism, place, tolerance):
                found[p.name] = tolerance
        return cls(mechanism, found)

    @cached_property
    def deviations(self) -> FloatArray:
        """Standard deviations of the changes of velocity, (n,)."""
        if self.noise is not None:
            return np.broadcast_to(np.asarray(self.noise, dtype=float), self.mechanism.n)
        scale = SMALL * full_accelerations(self.mechanism)
        return np.where(scale > 0, scale, UNDRIVEN)

    @cached_property
    def places(self) -> list[int]:
        """Which of the mechanism's parameters are uncertain."""
        names = [p.name for p in self.mechanism.parameters]
        return [names.index(name) for name in self.tolerances]

    @cached_property
    def _scale(self) -> FloatArray:
        return np.array([float(t) for t in self.tolerances.values()])

    @cached_property
    def prior(self) -> ParameterEstimate:
        """What is known before anything moves: even spread within the tolerances."""
        size = len(self.tolerances)
        side = np.ones(0 if self.bound is None else size)
        return ParameterEstimate(np.zeros(size), np.eye(size) / EVEN**2, low=-side, high=side)

    def values(self, offsets: ArrayLike) -> FloatArray:
        """Return the values of all parameters, (…, P), at some offsets, (…, p)."""
        offsets = floats("offsets of a belief", offsets)
        if offsets.ndim == 0 or offsets.shape[-1] != len(self.tolerances):
            raise InvalidInputError(
                "offsets of a belief",
                value=f"shape {offsets.shape}",
                limit=f"(…, {len(self.tolerances)}), in the order {', '.join(self.tolerances)}",
            )
        nominal = self.mechanism.parameter_values
        values = np.broadcast_to(nominal, (*offsets.shape[:-1], len(nominal))).copy()
        values[..., self.places] += self._scale * offsets
        return values

    @checked
    def believed(self, estimate: ParameterEstimate) -> Mechanism:
        """Return the mechanism with the estimated parameters."""
        return self.mechanism.with_values(self.values(estimate.offset))

    @checked
    def ensemble(self, estimate: ParameterEstimate) -> Ensemble:
        """Return the estimate and the corners of what is plausible around it.

        The corners are those of a two-level orthogonal design (Hadamard's) in the axes of the
        estimate's covariance, kept within the tolerances: every axis is as often high as low, and
        so is every pair of axes.  Of more than ``AXES`` parameters the axes that change the
        accelerations near the target most span the ensemble.

        With a bound they are corners of the estimate's box instead, a fifth of a tolerance out at
        least: each side is reached, by half of them.  They are not all its corners, 8 of 32 for
        five parameters, so a plan that suits them all is not proven for what is between.  Of more
        than ``AXES`` parameters those that matter least stay as estimated.
        """
        size, offset = len(estimate.offset), estimate.offset
        variances, axes = np.linalg.eigh(np.linalg.inv(estimate.information))
        if self.bound is None:
            axes = axes * np.sqrt(variances + LEAST**2)
            if size > AXES:
                axes = axes @ np.linalg.svd(self._effects(offset) @ axes)[2][:AXES].T
            corners = self.confidence * (_design(axes.shape[1]) @ axes.T)
            high = np.maximum(1.0, np.abs(offset))
            low = -high
        else:
            low, high = self._box(estimate)
            axes = np.eye(size)
            if size > AXES:
                matters = np.linalg.norm(self._effects(offset), axis=0) * (high - low)
                axes = axes[np.argsort(-matters, kind="stable")[:AXES]]
            signs = _design(len(axes)) @ axes
            corners = signs * np.maximum(np.where(signs > 0, high - offset, offset - low), LEAST)
            low, high = np.minimum(low, -1.0), np.maximum(high, 1.0)
        around = np.clip(offset + corners, low, high)
        offsets = np.vstack([np.tile(offset, (1 + SLIPS, 1)), around])
        # Of what the corners span, only the estimate's own uncertainty is expected; the rest is a
        # margin: it has to be survived, and costs nothing.
        expected = float(np.mean(variances / (variances + LEAST**2)))
        weights = np.full(len(offsets), expected / len(around))
        weights[: 1 + SLIPS] = (1.0 - expected) / (1 + SLIPS)
        return self._slipping(self.values(offsets), weights)

    @checked
    def alone(self, estimate: ParameterEstimate) -> Ensemble:
        """Return an ensemble of the estimate alone, with small errors of state and surface."""
        values = self.values(np.tile(estimate.offset, (1 + SLIPS, 1)))
        return self._slipping(values, np.ones(len(values)))

    @checked
    def single(self, estimate: ParameterEstimate) -> Ensemble:
        """Return an ensemble of one member, the estimate, without any error."""
        return Ensemble(self.mechanism, self.values(estimate.offset[None]), self.risk)

    def _slipping(self, values: FloatArray, weights: FloatArray) -> Ensemble:
        """Return an ensemble whose members 1 to ``SLIPS`` have small errors of state and surface.

        What is best for exact numbers alone may stand on a knife's edge: least time into a small
        ball does.  Half of them are designed, the others are their opposites, so that any three of
        up to eight errors have all patterns of signs.
        """
        mechanism = self.mechanism
        n, m = mechanism.n, mechanism.m
        scale = [
            min(
                SLIP_OF_STATE[c.unit],
                *(SLIP_OF_TRAVEL * abs(end) for end in (c.low, c.high) if end),
            )
            for c in mechanism.coordinates
        ]
        surface_errors = np.zeros((len(values), 2 * m * n))
        state_errors = np.zeros((len(values), 2 * n))
        free = np.ones(2 * m * n, dtype=bool)
        LawLayout(n, m).blocks(free).alpha_a[:] = False
        signs, half = _signs(2 * m * n - m * m + n), SLIPS // 2
        surface_errors[1 : 1 + half, free] = SLIP_OF_SURFACE * signs[:, :-n]
        state_errors[1 : 1 + half, :n] = scale * signs[:, -n:]
        for errors in (surface_errors, state_errors):
            errors[1 + half : 1 + SLIPS] = -errors[1 : 1 + half]
        return Ensemble(
            mechanism, values, self.risk, weights, surface_errors, state_errors, SLIP_OF_DISTANCE
        )

    def _effects(self, offset: FloatArray) -> FloatArray:
        """Return how accelerations near the target depend on the offsets, (E, p), relative."""
        size = len(offset)
        values = self.values(np.vstack([offset, offset + STEP * np.eye(size)]))
        effects = []
        for side in linear_accelerations(self.mechanism, values):
            rates = side.reshape(size + 1, -1)
            effects.append((rates[1:] - rates[0]).T / (STEP * max(np.abs(rates[0]).max(), 1e-12)))
        return np.vstack(effects)

    @checked
    def learn(
        self,
        estimate: ParameterEstimate,
        t: ArrayLike,
        x: ArrayLike,
        u: ArrayLike,
        held: bool = False,
    ) -> ParameterEstimate:
        """Return what is known after a recorded piece of motion.

        Parameters
        ----------
        estimate
            What was known before.
        t, x, u
            Times, (N,), s; states, (N, 2n); inputs after the actuator, (N, m).  Between two rows
            the input runs straight from one to the other.
        held
            True: it keeps the value of the first row until the next, as that of a sampled law does.

        Returns
        -------
        ParameterEstimate
            The one from before where a state or input is NaN or infinite: nothing is learnt then.

        Raises
        ------
        InvalidInputError
            For other shapes, and for times that fall or are no numbers.
        """
        motion = (
            floats("t of a motion", t), floats("x of a motion", x), floats("u of a motion", u)
        )  # fmt: skip
        rows, mechanism = motion[0].size, self.mechanism
        shapes = [(rows,), (rows, 2 * mechanism.n), (rows, mechanism.m)]
        if [part.shape for part in motion] != shapes:
            raise InvalidInputError(
                "motion to learn from",
                value=f"t, x, u of shapes {', '.join(str(part.shape) for part in motion)}",
                limit=f"(N,), (N, {2 * mechanism.n}), (N, {mechanism.m})",
            )
        if not (np.diff(motion[0]) >= 0).all():
            raise InvalidInputError(
                "times of a motion to learn from",
                value=f"{motion[0][0]:g} to {motion[0][-1]:g} s",
                limit="numbers that do not fall",
                remedy="Put the rows in the order in which they were",
            )
        if rows < 2 or motion[0][-1] == motion[0][0] or not self.tolerances:
            return estimate
        if held:  # a row before and one after each jump of the input
            times, states = (np.repeat(part, 2, axis=0)[1:-1] for part in motion[:2])
            motion = times, states, np.repeat(motion[2][:-1], 2, axis=0)
        box, contradictions = None, estimate.contradictions
        if self.bound is not None:
            box = self._narrowed(*self._box(estimate), *motion)
            if box is None:
                contradictions += 1
                box = self._narrowed(self.prior.low, self.prior.high, *motion)
        found = self._fitted(estimate, *motion, box=box)
        if found is None:
            return estimate
        for prior, reach in ((self.prior, 1.0), (self._beyond, BEYOND)):
            if found[1] > CHANGED:
                again = self._fitted(prior, *motion, reach=reach, box=box)
                if again is not None and again[1] < found[1]:
                    found = again
        if self.bound is None:
            return found[0]
        if box is None:  # no plant within the tolerances explains it
            offset = found[0].offset
            box = np.minimum(self.prior.low, offset), np.maximum(self.prior.high, offset)
        return replace(found[0], low=box[0], high=box[1], contradictions=contradictions)

    def _box(self, estimate: ParameterEstimate) -> tuple[FloatArray, FloatArray]:
        """Return between which offsets the truth is, or refuse an estimate that does not say."""
        if not len(estimate.low) == len(estimate.high) == len(self.tolerances):
            raise InvalidInputError(
                "estimate of a belief with a bound",
                value="one without low and high",
                limit="one that such a belief learnt",
                remedy="Begin with Belief.prior, or leave the bound out",
            )
        return estimate.low, estimate.high

    def _narrowed(
        self, low: FloatArray, high: FloatArray, t: FloatArray, x: FloatArray, u: FloatArray
    ) -> tuple[FloatArray, FloatArray] | None:
        """Return a box of offsets, (p,) each, without what the motion rules out; None if all."""
        for _ in range(ROUNDS):
            slope, rest, width = self._slabs(low, high, t, x, u)
            if not (np.isfinite(slope).all() and np.isfinite(rest + width).all()):
                break
            half = 0.5 * (high - low)
            sides = _contracted(slope, rest, width)
            if sides is None:
                return None
            low, high = low + half * (sides[0] + 1.0), high + half * (sides[1] - 1.0)
            if max((sides[0] + 1.0).max(), (1.0 - sides[1]).max()) < RESTS:
                break
        return low, high

    def _slabs(
        self, low: FloatArray, high: FloatArray, t: FloatArray, x: FloatArray, u: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return slope, (S, p), rest and width, (S,), of |rest − slope z| ≤ width, z from −1 to 1.

        One for each sample and coordinate; z are offsets in half the sides of the box, from its
        middle.  M(q; θ) (Δq̇ − predicted(θ)) is small: it bends much less in θ than the prediction,
        which has the inverse of M.  What is not linear in z is at most half the sum of all second
        differences, to third order; ``BENT`` stands for what is beyond.
        """
        size, n = len(low), self.mechanism.n
        first, second = np.triu_indices(size, 1)
        unit = np.eye(size)
        z = np.vstack([np.zeros(size), unit, -unit, unit[first] + unit[second]])
        offsets = 0.5 * (low + high) + 0.5 * (high - low) * z
        changes, corners = self._changes(offsets, t, x, u)
        middle = 0.5 * (x[1:] + x[:-1])
        entries = self.mechanism.function("mass")(
            0.5 * (t[1:] + t[:-1]), *middle.T, *self.values(offsets).T[:, :, None]
        )
        mass = np.stack([np.broadcast_to(one, changes.shape[:2]) for one in entries], axis=-1)
        mass = mass.reshape(*changes.shape, n)
        error = (mass @ (np.diff(x[:, n:], axis=0) - changes)[..., None])[..., 0]
        most = np.asarray(self.bound) + (RECTANGLES / CORNER) * corners
        allowed = (np.abs(mass) @ most[..., None])[..., 0]
        centre, up, down, both = np.split(error, [1, 1 + size, 1 + 2 * size])
        width, farther, nearer, _ = np.split(allowed, [1, 1 + size, 1 + 2 * size])
        bent = 0.5 * np.abs(up + down - 2.0 * centre).sum(axis=0)
        bent += np.abs(both - up[first] - up[second] + centre).sum(axis=0)
        more = (np.maximum(farther, nearer) - width).clip(0.0).sum(axis=0)
        wide = (1.0 + 1e-9) * (width[0] + more + BENT * bent)
        return -0.5 * (up - down).reshape(size, -1).T, centre.ravel(), wide.ravel()

    @cached_property
    def _beyond(self) -> ParameterEstimate:
        """Even spread over much more than the tolerances."""
        return replace(self.prior, information=self.prior.information / BEYOND**2)

    @cached_property
    def room(self) -> FloatArray:
        """How far parameters may be off at all, in tolerances, (p,): within their intervals."""
        p = [self.mechanism.parameters[place] for place in self.places]
        room = [min(each.value - each.low, each.high - each.value) for each in p]
        return np.maximum(1.0, 0.95 * np.array(room) / self._scale)

    def _fitted(
        self,
        before: ParameterEstimate,
        t: FloatArray,
        x: FloatArray,
        u: FloatArray,
        reach: float = 1.0,
        box: tuple[FloatArray, FloatArray] | None = None,
    ) -> tuple[ParameterEstimate, float] | None:
        """Return the estimate after these samples, and the median of their squared residuals.

        It stays within a box, or else ``reach`` tolerances, or as far out as it was before.
        """
        size, offset = len(before.offset), before.offset
        limits = np.minimum(self.room, np.maximum(reach, np.abs(offset)))
        low, high = (-limits, limits) if box is None else box
        information = before.information
        for _ in range(ROUNDS):
            around = np.vstack([offset, offset + STEP * np.eye(size)])
            predicted, corners = self._changes(around, t, x, u)
            deviations = np.hypot(self.deviations, corners[0])
            rest = (np.diff(x[:, self.mechanism.n :], axis=0) - predicted[0]) / deviations
            slope = (predicted[1:] - predicted[0]) / (STEP * deviations)
            if not (np.isfinite(rest).all() and np.isfinite(slope).all()):
                return None
            slope = slope.reshape(size, -1)
            information = before.information + slope @ slope.T
            pull = before.information @ (before.offset - offset) + slope @ rest.ravel()
            offset, last = _within(offset, information, pull, low, high), offset
            if np.abs(offset - last).max() < ENOUGH:
                break
        moved = np.diff(t) > 0
        samples = before.samples + int(moved.sum())
        return ParameterEstimate(offset, information, samples), float(np.median(rest[moved] ** 2))

    def _changes(
        self, offsets: FloatArray, t: FloatArray, x: FloatArray, u: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the predicted changes of velocity over each sample, (K, N − 1, n).

        And how far the trapezoidal rule may be off in each of them, (K, N − 1, n): an acceleration
        that runs up within a sample need not run straight.
        """
        values = self.values(offsets).T[:, :, None]
        rates = self.mechanism.function("dynamics")(t, *x.T, *u.T, *values)
        shape = (len(offsets), len(t))
        qdd = np.stack([np.broadcast_to(rate, shape) for rate in rates], axis=-1)
        span = np.diff(t)[:, None]
        change: FloatArray = 0.5 * (qdd[:, 1:] + qdd[:, :-1]) * span
        return change, CORNER * np.abs(np.diff(qdd, axis=1)) * span


def _design(count: int) -> FloatArray:
    """Return signs, (C, count), whose columns are at right angles: Sylvester's matrix."""
    signs = np.ones((1, 1))
    while len(signs) <= count:
        signs = np.block([[signs, signs], [signs, -signs]])
    return signs[:, 1 : count + 1]


def _signs(count: int) -> FloatArray:
    """Return signs, (SLIPS / 2, count): up to eight columns are at right angles.

    Of up to sixteen, with those times a quadratic Boolean function, none are nearer than 60°.
    """
    signs = np.hstack([np.ones((SLIPS // 2, 1)), _design(SLIPS // 2 - 1)])
    bent = 0.5 * (signs[:, 0] + signs[:, 1] + signs[:, 2] - signs[:, 3])
    return np.hstack([signs, bent[:, None] * signs])[:, np.arange(count) % SLIPS]


def _contracted(
    slope: FloatArray, rest: FloatArray, width: FloatArray
) -> tuple[FloatArray, FloatArray] | None:
    """Return a box, (p,) low and high, of all z from −1 to 1 with |rest − slope z| ≤ width.

    Each slab bounds each z by what the others leave it, until nothing moves.  None if no z is left.
    """
    low, high = -np.ones(slope.shape[1]), np.ones(slope.shape[1])
    sizes = np.abs(slope)
    for _ in range(SWEEPS):
        middle, half = 0.5 * (low + high), 0.5 * (high - low)
        left = (rest - slope @ middle)[:, None]
        reach = width + sizes @ half
        if (np.abs(left[:, 0]) > reach).any():
            return None
        room = reach[:, None] - sizes * half
        with np.errstate(divide="ignore", invalid="ignore"):
            ends = np.stack([left - room, left + room]) / slope
        ends = np.where(sizes > 0, np.sort(ends, axis=0), [[[-np.inf]], [[np.inf]]])
        new_low = np.maximum(low, middle + ends[0].max(axis=0))
        new_high = np.minimum(high, middle + ends[1].min(axis=0))
        if (new_low > new_high).any():
            return None
        moved = max((new_low - low).max(), (high - new_high).max())
        low, high = new_low, new_high
        if moved < RESTS:
            break
    return low, high


def _within(
    offset: FloatArray, information: FloatArray, pull: FloatArray, low: FloatArray, high: FloatArray
) -> FloatArray:
    """Return where a quadratic in the offsets is least in a box; what is beyond stays there.

    ``information`` is its Hessian, ``pull`` its descent direction at ``offset``.
    """
    free = np.ones(len(offset), dtype=bool)
    new = offset.copy()
    while free.any():
        held = ~free
        rest = pull[free] - information[np.ix_(free, held)] @ (new - offset)[held]
        new[free] = offset[free] + np.linalg.solve(information[np.ix_(free, free)], rest)
        beyond = free & ((new < low) | (new > high))
        if not beyond.any():
            break
        new[beyond] = np.clip(new, low, high)[beyond]
        free &= ~beyond
    return new
