"""What is known of a plant: its parameters with tolerances, narrowed by what its motion shows.

A belief is a mechanism whose parameters have tolerances.  Measured states and inputs tell more:
over a sample from t to t + h

    q̇(t + h) − q̇(t)  =  ∫ q̈(x, u; θ) dt  ≈  h/2 (q̈(x, u; θ) + q̈(x₊, u₊; θ)),

which is fitted to θ by least squares, sample after sample (an information filter whose new samples
are linearised at their own solution).  What is left uncertain spans an ensemble: the estimate, and
the corners of its confidence ellipsoid that a two-level orthogonal design names.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import get_args

import numpy as np
from numpy.typing import ArrayLike

from undertow.base import InvalidInputError, check_fields, checked, floats, one_of, positive
from undertow.closed_loop import Ensemble, Risk
from undertow.models import FloatArray, Mechanism, number_of

#: Standard deviation of what is evenly spread over ± a tolerance, as a part of it.
EVEN = 1.0 / math.sqrt(3.0)

#: What is never known better, as a part of the tolerance: what the model leaves out looks like an
#: error of its parameters, and least time goes right past singular plants.
LEAST = 0.2

#: Half a percent of the change of velocity over 2 ms at full inputs, s, is noise; and the noise of
#: what no input moves at the target, rad/s or m/s.
SMALL, UNDRIVEN = 0.005 * 0.002, 0.004

#: Relative step of the differences by which accelerations are linearised in the parameters.
STEP = 1e-5

#: Gauss-Newton steps for one batch of samples, and the change of all parameters, as a part of
#: their tolerances, that ends them.
ROUNDS, ENOUGH = 4, 1e-4

#: Mean squared residual, in standard deviations, beyond which the plant has changed: what was
#: learnt before is forgotten then.
CHANGED = 9.0


@dataclass(frozen=True, eq=False)
class ParameterEstimate:
    """What is known of the uncertain parameters at one time.

    Attributes
    ----------
    offset
        θ − θ₀ in units of the tolerances, (p,); within ±1.
    information
        Inverse covariance of ``offset``, (p, p), the prior's included.
    samples
        How many were used.
    """

    offset: FloatArray
    information: FloatArray
    samples: int = 0

    @property
    def deviation(self) -> FloatArray:
        """Standard deviations of ``offset``, (p,): 0.58 where nothing is known."""
        return np.sqrt(np.diag(np.linalg.inv(self.information)))


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

    Raises
    ------
    InvalidInputError
        For unknown parameters, and for tolerances that are not positive or reach beyond what makes
        physical sense.

    Examples
    --------
    >>> import undertow as ut
    >>> rig = ut.mechanisms.rotary_pendulum()
    >>> belief = Belief.relative(rig, m=0.2, l=0.05)
    >>> belief.tolerances["m"]
    0.025
    >>> len(belief.ensemble(belief.prior))
    5
    """

    mechanism: Mechanism
    tolerances: Mapping[str, float]
    noise: float | tuple[float, ...] | None = None
    confidence: float = 1.0
    risk: Risk = "mean"

    def __post_init__(self) -> None:
        """Check names and numbers."""
        check_fields(self)
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
        noise = np.asarray(1.0 if self.noise is None else self.noise, dtype=float)
        if (
            noise.shape not in ((), (self.mechanism.n,))
            or not (np.isfinite(noise) & (noise > 0)).all()
        ):
            raise InvalidInputError(
                "noise of a belief",
                value=self.noise,
                limit=f"one number, or {self.mechanism.n}, finite and > 0",
            )

    @classmethod
    @checked
    def relative(cls, mechanism: Mechanism, /, **tolerances: float) -> Belief:
        """Return a belief whose tolerances are parts of the values: ``m=0.2`` is ±20 %."""
        values = {p.name: abs(p.value) for p in mechanism.parameters}
        for name in tolerances:
            one_of(f"uncertain parameter of '{mechanism.name}'", name, values)
        return cls(mechanism, {name: part * values[name] for name, part in tolerances.items()})

    @cached_property
    def deviations(self) -> FloatArray:
        """Standard deviations of the changes of velocity, (n,)."""
        if self.noise is not None:
            return np.broadcast_to(np.asarray(self.noise, dtype=float), self.mechanism.n)
        limits, rest = self.mechanism.input_limits, np.zeros(2 * self.mechanism.n)
        full = np.diag(np.where(np.isfinite(limits), limits, 1.0))
        still = self.mechanism.accelerations(0.0, rest, 0.0 * limits)
        driven = sum(np.abs(self.mechanism.accelerations(0.0, rest, u) - still) for u in full)
        scale = SMALL * np.asarray(driven, dtype=float)
        return np.where(scale > 0, scale, UNDRIVEN)

    @cached_property
    def _places(self) -> list[int]:
        names = [p.name for p in self.mechanism.parameters]
        return [names.index(name) for name in self.tolerances]

    @cached_property
    def _scale(self) -> FloatArray:
        return np.array([float(t) for t in self.tolerances.values()])

    @cached_property
    def prior(self) -> ParameterEstimate:
        """What is known before anything moves: even spread within the tolerances."""
        size = len(self.tolerances)
        return ParameterEstimate(np.zeros(size), np.eye(size) / EVEN**2)

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
        values[..., self._places] += self._scale * offsets
        return values

    @checked
    def believed(self, estimate: ParameterEstimate) -> Mechanism:
        """Return the mechanism with the estimated parameters."""
        return self.mechanism.with_values(self.values(estimate.offset))

    @checked
    def ensemble(self, estimate: ParameterEstimate) -> Ensemble:
        """Return the estimate and the corners of what is plausible around it.

        The corners are those of a two-level orthogonal design (Hadamard's) in the principal axes of
        the estimate's covariance, kept within the tolerances: every axis is as often high as low,
        and so is every pair of axes.
        """
        from scipy.linalg import hadamard  # slow to import

        size = len(estimate.offset)
        variances, axes = np.linalg.eigh(np.linalg.inv(estimate.information))
        design = hadamard(1 << size.bit_length())[:, 1 : size + 1]
        corners = self.confidence * (design * np.sqrt(variances + LEAST**2)) @ axes.T
        offsets = np.vstack([estimate.offset, np.clip(estimate.offset + corners, -1.0, 1.0)])
        # Of what the corners span, only the estimate's own uncertainty is expected; the rest is a
        # margin: it has to be survived, and costs nothing.
        expected = float(np.mean(variances / (variances + LEAST**2)))
        weights = np.full(len(offsets), expected / (len(offsets) - 1))
        weights[0] = 1.0 - expected
        return Ensemble(self.mechanism, self.values(offsets), self.risk, weights)

    @checked
    def learn(
        self, estimate: ParameterEstimate, t: ArrayLike, x: ArrayLike, u: ArrayLike
    ) -> ParameterEstimate:
        """Return what is known after a recorded piece of motion.

        Parameters
        ----------
        estimate
            What was known before.
        t, x, u
            Times, (N,), s; states, (N, 2n); inputs after the actuator, (N, m).  Between two rows
            the input runs straight from one to the other.
        """
        motion = [
            floats(f"{name} of a motion", value)
            for name, value in zip("txu", (t, x, u), strict=True)
        ]
        rows, mechanism = motion[0].size, self.mechanism
        shapes = [(rows,), (rows, 2 * mechanism.n), (rows, mechanism.m)]
        if [part.shape for part in motion] != shapes:
            raise InvalidInputError(
                "motion to learn from",
                value=f"t, x, u of shapes {', '.join(str(part.shape) for part in motion)}",
                limit=f"(N,), (N, {2 * mechanism.n}), (N, {mechanism.m})",
            )
        if rows < 2 or not self.tolerances:
            return estimate
        found = self._fitted(estimate, *motion)
        if found is None:
            return estimate
        if found[1] > CHANGED:
            again = self._fitted(self.prior, *motion)
            if again is not None and again[1] < found[1]:
                found = again
        return found[0]

    def _fitted(
        self, before: ParameterEstimate, t: FloatArray, x: FloatArray, u: FloatArray
    ) -> tuple[ParameterEstimate, float] | None:
        """Return the estimate after these samples, and its mean squared residual."""
        size, offset = len(before.offset), before.offset
        information = before.information
        for _ in range(ROUNDS):
            around = np.vstack([offset, offset + STEP * np.eye(size)])
            predicted = self._changes(around, t, x, u)
            rest = (np.diff(x[:, self.mechanism.n :], axis=0) - predicted[0]) / self.deviations
            slope = (predicted[1:] - predicted[0]) / (STEP * self.deviations)
            if not (np.isfinite(rest).all() and np.isfinite(slope).all()):
                return None
            slope = slope.reshape(size, -1)
            information = before.information + slope @ slope.T
            pull = before.information @ (before.offset - offset) + slope @ rest.ravel()
            offset, last = _within(offset, information, pull), offset
            if np.abs(offset - last).max() < ENOUGH:
                break
        samples = before.samples + len(t) - 1
        return ParameterEstimate(offset, information, samples), float(np.mean(rest**2))

    def _changes(
        self, offsets: FloatArray, t: FloatArray, x: FloatArray, u: FloatArray
    ) -> FloatArray:
        """Return the predicted changes of velocity over each sample, (K, N − 1, n)."""
        values = self.values(offsets).T[:, :, None]
        rates = self.mechanism.function("dynamics")(t, *x.T, *u.T, *values)
        shape = (len(offsets), len(t))
        qdd = np.stack([np.broadcast_to(rate, shape) for rate in rates], axis=-1)
        change: FloatArray = 0.5 * (qdd[:, 1:] + qdd[:, :-1]) * np.diff(t)[:, None]
        return change


def _within(offset: FloatArray, information: FloatArray, pull: FloatArray) -> FloatArray:
    """Return where a quadratic in the offsets is least within ±1; what is beyond stays at ±1.

    ``information`` is its Hessian, ``pull`` its descent direction at ``offset``.
    """
    free = np.ones(len(offset), dtype=bool)
    new = offset.copy()
    while free.any():
        held = ~free
        rest = pull[free] - information[np.ix_(free, held)] @ (new - offset)[held]
        new[free] = offset[free] + np.linalg.solve(information[np.ix_(free, free)], rest)
        beyond = free & (np.abs(new) > 1.0)
        if not beyond.any():
            break
        new[beyond] = np.sign(new[beyond])
        free &= ~beyond
    return new
