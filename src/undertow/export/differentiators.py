"""Velocities from measured positions, as expressions: one step of a differentiator.

The same rules as in :mod:`undertow.estimators`, for a fixed period.  Each coordinate has a
memory of two numbers, a position and the estimated velocity; a step maps (gain, q, memory) to
the new memory, which is the estimate.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
import sympy as sp

from undertow.estimators import Estimator, FilteredDerivative, SuperTwisting
from undertow.estimators.interface import positive
from undertow.models import FloatArray, Mechanism
from undertow.symbolic import Tape

__all__ = ["DerivativeStep", "DifferentiatorStep", "StepSymbols", "SuperTwistingStep"]


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

    def lay(self, tape: Tape, symbols: StepSymbols) -> tuple[sp.Expr, sp.Expr]:
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

    @property
    def meaning(self) -> str:
        """What the gains are."""
        return "time constants, s"

    def gains(self, n: int) -> FloatArray:
        """Return τ for each coordinate, (n,)."""
        return positive("time_constant of a derivative", self.time_constant, n)

    def lay(self, tape: Tape, symbols: StepSymbols) -> tuple[sp.Expr, sp.Expr]:
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

    @property
    def description(self) -> str:
        """What it is, in a few words."""
        return "super-twisting differentiator, implicit"

    @property
    def meaning(self) -> str:
        """What the gains are."""
        return "bounds on the accelerations, rad/s^2 or m/s^2"

    def gains(self, n: int) -> FloatArray:
        """Return L for each coordinate, (n,)."""
        return positive("acceleration of a differentiator", self.acceleration, n)

    def lay(self, tape: Tape, symbols: StepSymbols) -> tuple[sp.Expr, sp.Expr]:
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
