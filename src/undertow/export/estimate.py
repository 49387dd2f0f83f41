"""Where the state of the exported controller comes from: one step of an estimator, and its C.

A differentiator follows the same rules as in :mod:`undertow.estimators`, for a fixed period: each
coordinate has a memory of two numbers, a position and the estimated velocity; a step maps (gain,
q, memory) to the new memory, which is the estimate.

The observer of fixed gain moves the state as the model says under the last output; each measured
position then corrects it.  The gain is that to which :class:`undertow.estimators.KalmanFilter`
settles at the target, K = P Hᵀ R⁻¹ (Kalman, *Journal of Basic Engineering* 82(1), 1960), so
nothing is inverted on the target.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import ClassVar, NamedTuple, Protocol

import numpy as np
import sympy as sp
from numpy.typing import ArrayLike

from undertow.base import InvalidInputError, one_for_each
from undertow.estimators import Estimator, FilteredDerivative, KalmanFilter, SuperTwisting
from undertow.export.names import LARGEST, macros, template
from undertow.models import FloatArray, Mechanism, fastest_rate
from undertow.plants import Measurement
from undertow.symbolic import C99Emitter, Real, Tape, literal


class StepSymbols(NamedTuple):
    """Symbols of one step for one coordinate."""

    gain: sp.Symbol
    q: sp.Symbol
    position: sp.Symbol
    velocity: sp.Symbol
    period: sp.Symbol

    @classmethod
    def new(cls) -> StepSymbols:
        """Return the symbols."""
        return cls(*(sp.Symbol(f"_{name}", real=True) for name in cls._fields))


class DifferentiatorStep(Protocol):
    """A differentiator that can be exported."""

    @property
    def description(self) -> str:
        """What it is, in a few words."""
        ...

    @property
    def meaning(self) -> str:
        """What the gains are, with their unit."""
        ...

    def gains(self, n: int) -> FloatArray:
        """Return one gain for each of n coordinates, (n,)."""
        ...

    def build(self, tape: Tape, symbols: StepSymbols) -> tuple[sp.Expr, sp.Expr]:
        """Return the new position and velocity of the memory."""
        ...

    def estimator(self, mechanism: Mechanism, period: float) -> Estimator:
        """Return the library's own, which the exported one must agree with."""
        ...


@dataclass(frozen=True)
class DerivativeStep:
    """Differences behind a first-order filter, s/(τ s + 1), by Tustin's rule.

    ``v⁺ = ((2τ − T) v + 2 (q − q⁻))/(2τ + T)``.

    Parameters
    ----------
    time_constant
        τ, s: one for all coordinates, or one for each.
    """

    time_constant: float | tuple[float, ...] = 0.01

    @property
    def description(self) -> str:
        """What it is, in a few words."""
        shown = ", ".join(f"{v:g}" for v in np.atleast_1d(self.time_constant))
        return f"filtered derivative, time constant {shown} s"

    meaning: ClassVar[str] = "time constants, s"

    def gains(self, n: int) -> FloatArray:
        """Return τ for each coordinate, (n,)."""
        return one_for_each("time_constant of a derivative", self.time_constant, n)

    def build(self, tape: Tape, symbols: StepSymbols) -> tuple[sp.Expr, sp.Expr]:
        """Return the new position and velocity of the memory."""
        gain, q, position, velocity, period = symbols
        ahead = (2 * gain - period) * velocity + 2 * (q - position)
        return q, tape.let(ahead / (2 * gain + period))

    def estimator(self, mechanism: Mechanism, period: float) -> Estimator:
        """Return :class:`undertow.estimators.FilteredDerivative`."""
        return FilteredDerivative(mechanism, period, self.time_constant)


@dataclass(frozen=True)
class SuperTwistingStep:
    """Levant's super-twisting differentiator, discretised implicitly: it does not chatter.

    With ``e = z₀ + T z₁ − q``, ``d = 1.1 L T²`` and ``c = 1.5 √L T`` the backward Euler step is
    explicit: ``√|σ⁺| = (−c + √(c² + 4 max(0, |e| − d)))/2``, ``z₀⁺ = q + σ⁺`` and
    ``z₁⁺ = z₁ − clip(e, ±d)/T``; sources: :class:`undertow.estimators.SuperTwisting`.

    Parameters
    ----------
    acceleration
        L, a bound on |q̈|, rad/s² or m/s²: one for all coordinates, or one for each.
    """

    acceleration: float | tuple[float, ...] = 200.0

    description: ClassVar[str] = "super-twisting differentiator, implicit"
    meaning: ClassVar[str] = "bounds on the accelerations, rad/s^2 or m/s^2"

    def gains(self, n: int) -> FloatArray:
        """Return L for each coordinate, (n,)."""
        return one_for_each("acceleration of a differentiator", self.acceleration, n)

    def build(self, tape: Tape, symbols: StepSymbols) -> tuple[sp.Expr, sp.Expr]:
        """Return the new position and velocity of the memory."""
        gain, q, position, velocity, period = symbols
        error = tape.let(position + period * velocity - q)
        inside = tape.let(sp.Rational(11, 10) * gain * period**2)
        slope = tape.let(sp.Rational(3, 2) * sp.sqrt(gain) * period)
        excess = tape.let(sp.Max(0, tape.let(sp.Abs(error) - inside)))
        root = tape.let((tape.let(sp.sqrt(slope**2 + 4 * excess)) - slope) / 2)
        clipped = tape.let(sp.Max(-inside, sp.Min(inside, error)))
        return tape.let(q + root**2 * sp.sign(error)), tape.let(velocity - clipped / period)

    def estimator(self, mechanism: Mechanism, period: float) -> Estimator:
        """Return :class:`undertow.estimators.SuperTwisting`."""
        return SuperTwisting(mechanism, period, self.acceleration)


@dataclass(frozen=True)
class KalmanStep:
    """The observer of fixed gain: a step of the model, corrected by the positions.

    ``x⁻ = (q + T v + ½ T² q̈(x, u), v + T q̈(x, u))``, ``x⁺ = x⁻ + K (q_measured − q⁻)``.

    Parameters
    ----------
    position_noise
        Standard deviation of a position, rad or m, one or one for each coordinate; an encoder
        of resolution r has r/√12.
    acceleration_noise
        Density of what the model does not know of the accelerations, rad/s²/√Hz or m/s²/√Hz,
        one or one for each coordinate.
    """

    position_noise: float | tuple[float, ...] = 4.5e-4
    acceleration_noise: float | tuple[float, ...] = 0.5

    description: ClassVar[str] = "Kalman filter of fixed gain on the model"
    meaning: ClassVar[str] = "state on position, rows of the state"

    def noises(self, n: int) -> tuple[FloatArray, FloatArray]:
        """Return the noises of positions and accelerations, (n,) each; both must be positive."""
        return (
            one_for_each("position_noise", self.position_noise, n),
            one_for_each("acceleration_noise", self.acceleration_noise, n),
        )

    def gains(self, mechanism: Mechanism, period: float) -> FloatArray:
        """Return K, (2n, n), settled at the target."""
        n, fastest = mechanism.n, fastest_rate(mechanism)
        if not period * fastest < 2.0:  # its step of the velocities is Euler's
            raise InvalidInputError(
                f"period of an exported Kalman filter for '{mechanism.name}'",
                value=f"{period:g} s",
                limit=f"below {2.0 / fastest:.3g} s, twice the time constant of its fastest mode",
                remedy="Use a shorter period, or a differentiator: --velocity derivative",
            )
        noise, unknown = self.noises(n)
        filter_ = KalmanFilter(mechanism, period, position_noise=noise, acceleration_noise=unknown)
        return np.asarray(filter_.steady_covariance()[:, :n] / noise**2)

    def estimator(self, mechanism: Mechanism, period: float) -> Observer:
        """Return the same in Python."""
        return Observer(mechanism, period, self.gains(mechanism, period))


class Observer(Estimator):
    """What the exported observer must agree with."""

    def __init__(self, mechanism: Mechanism, period: float, gains: FloatArray) -> None:
        super().__init__(mechanism, period)
        self.gains = gains
        self._x = np.zeros(2 * mechanism.n)

    def reset(self, x0: ArrayLike) -> None:
        """Start again from the state x0, (2n,)."""
        self._x = np.array(x0, dtype=float)

    def estimate(self, measurement: Measurement, u: FloatArray) -> FloatArray:
        """Return the state after a measurement that is whole, (2n,)."""
        n, T, q = self.mechanism.n, self.period, measurement.q
        rate = self.mechanism.accelerations(0.0, self._x, u)
        v = self._x[n:]
        ahead = np.concatenate([self._x[:n] + T * (v + 0.5 * T * rate), v + T * rate])
        x: FloatArray = ahead + self.gains @ (q - ahead[:n])
        if not (np.abs(x) < LARGEST).all():
            x = np.concatenate([q, np.zeros(n)])
        self._x = x
        return x


def acceleration_code(mechanism: Mechanism, parameters: Mapping[sp.Symbol, str], real: Real) -> str:
    """Return the C of q̈(x, u), (3)-(4), into ``rate``; ``parameters`` are the texts of theirs."""
    n, m, tape = mechanism.n, mechanism.m, Tape()
    M = sp.Matrix(n, n, tape.let_all(list(mechanism.mass_matrix)))
    factor = tape.cholesky(sp.Matrix(n, n, lambda i, j: M[min(i, j), max(i, j)]))
    driven = mechanism.input_matrix * sp.Matrix(mechanism.u)
    total = [f + (driven[i] if i < m else 0) for i, f in enumerate(mechanism.force)]
    rates = factor.solve(sp.Matrix(tape.let_all(total)))
    names = {x: f"x[{i}]" for i, x in enumerate(mechanism.x)}
    names |= {u: f"u[{i}]" for i, u in enumerate(mechanism.u)}
    emitter = C99Emitter(tape, {**names, **parameters}, real)
    return emitter.statements({f"rate[{i}]": a for i, a in enumerate(rates)})


EstimatorStep = DifferentiatorStep | KalmanStep

#: Those that can be exported, by name.
STEPS: Mapping[str, Callable[..., EstimatorStep]] = {
    "derivative": DerivativeStep,
    "super-twisting": SuperTwistingStep,
    "kalman": KalmanStep,
}


def estimate_code(
    step: EstimatorStep, mechanism: Mechanism, period: float, real: Real
) -> dict[str, str]:
    """Return the parts of the templates that make the state from positions.

    ``period`` is the controller's, s.
    """

    def row(values: list[float]) -> str:
        return ", ".join(literal(v, real) for v in values)

    if isinstance(step, KalmanStep):
        body = acceleration_code(mechanism, macros(mechanism.parameters), real)
        rows = [f"    {{{row(r)}}}," for r in step.gains(mechanism, period).tolist()]
        values = {"gains": "\n".join(rows), "step": body, "half": literal(0.5, real)}
        text = template("observer.c").substitute(values)
        return {"estimate": text.rstrip(), "memory": "", "place": "", "remember": ""}
    tape, symbols = Tape(), StepSymbols.new()
    position, velocity = step.build(tape, symbols)
    names = {
        symbols.gain: "gain",
        symbols.q: "q",
        symbols.position: "filter[0]",
        symbols.velocity: "filter[1]",
        symbols.period: "UT_PERIOD",
    }
    places = {"filter[0]": position, "filter[1]": velocity}
    body = C99Emitter(tape, names, real).statements(places)
    text = template("differentiator.c").substitute(
        gains=row(step.gains(mechanism.n).tolist()), step=body
    )
    return {
        "estimate": text.rstrip(),
        "memory": "    ut_real filter[UT_N][2];       "
        "/* memory of the estimator, for each coordinate */\n",
        "place": "UT_PLACE(filter), ",
        "remember": "            c->filter[i % UT_N][i / UT_N] = at[i]; "
        "/* where ut_step would go on */\n",
    }
