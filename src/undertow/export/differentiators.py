"""Velocities from measured positions, as expressions: one step of a differentiator.

Each coordinate has a memory of two numbers: a position and the estimated velocity.  The step
maps (gain, q, memory) to the new memory.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
import sympy as sp
from numpy.typing import ArrayLike

from undertow.codegen.tape import Tape
from undertow.errors import InvalidInputError
from undertow.mechanism import FloatArray, Mechanism

__all__ = ["Differentiator", "FilteredDerivative", "StepSymbols", "SuperTwisting"]


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


class Differentiator(Protocol):
    """A first-order differentiator in discrete time."""

    @property
    def description(self) -> str:
        """What it is, in a few words."""
        ...

    @property
    def meaning(self) -> str:
        """What the gains are, with their unit."""
        ...

    def gains(self, mechanism: Mechanism, period: float) -> FloatArray:
        """Return one gain for each coordinate, (n,)."""
        ...

    def lay(self, tape: Tape, symbols: StepSymbols) -> tuple[sp.Expr, sp.Expr]:
        """Return the new position and velocity of the memory."""
        ...


def _per_coordinate(what: str, value: ArrayLike, n: int) -> FloatArray:
    values = np.atleast_1d(np.asarray(value, dtype=float))
    if values.shape not in {(1,), (n,)} or not (np.isfinite(values).all() and (values > 0).all()):
        raise InvalidInputError(
            what,
            value=value,
            limit=f"one number > 0, or {n} of them",
            remedy="Give one for all coordinates, or one for each",
        )
    return np.array(np.broadcast_to(values, (n,)))


@dataclass(frozen=True)
class FilteredDerivative:
    """Difference quotient behind a first-order low-pass.

    ``v⁺ = v + (1 − a) ((q − q⁻)/T − v)``, ``a = exp(−T/τ)``: the zero-order-hold equivalent of
    s/(τ s + 1) at the samples.

    Parameters
    ----------
    time_constant
        τ, s: one for all coordinates, or one for each.
    """

    time_constant: float | tuple[float, ...] = 0.005

    @property
    def description(self) -> str:
        """What it is, in a few words."""
        return f"filtered derivative, time constant {_listed(self.time_constant)} s"

    @property
    def meaning(self) -> str:
        """What the gains are."""
        return "1 - exp(-period / time constant)"

    def gains(self, mechanism: Mechanism, period: float) -> FloatArray:
        """Return 1 − a for each coordinate, (n,)."""
        tau = _per_coordinate("time constant of the derivative", self.time_constant, mechanism.n)
        return np.asarray(-np.expm1(-period / tau))

    def lay(self, tape: Tape, symbols: StepSymbols) -> tuple[sp.Expr, sp.Expr]:
        """Return the new position and velocity of the memory."""
        gain, q, position, velocity, period = symbols
        quotient = tape.let((q - position) / period)
        return q, tape.let(velocity + gain * tape.let(quotient - velocity))


@dataclass(frozen=True)
class SuperTwisting:
    """Levant's super-twisting differentiator, discretised implicitly.

    ``ż₀ = z₁ − 1.5 √L |σ|^½ sign σ``, ``ż₁ = −1.1 L sign σ``, σ = z₀ − q [1]_, by the backward
    Euler rule, in which the sign becomes a value in [−1, 1] and nothing chatters [2]_.  With
    ``e = z₀ + T z₁ − q`` and ``d = 1.1 L T²`` the step is explicit:
    ``√|σ⁺| = (−c + √(c² + 4 max(0, |e| − d)))/2``, ``c = 1.5 √L T``, and
    ``z₁⁺ = z₁ − clip(e, ±d)/T``.

    Parameters
    ----------
    acceleration
        L, a bound on |q̈|, rad/s² or m/s²: one for all coordinates, or one for each.  By
        default twice the largest that the model makes from rest, at the target and at its
        usual start, under full inputs of either sign.

    References
    ----------
    .. [1] A. Levant, Robust exact differentiation via sliding mode technique, Automatica 34
       (1998) 379-384.
    .. [2] M. R. Mojallizadeh et al., Time-discretizations of differentiators, Int. J. Robust
       Nonlinear Control 31 (2021) 7679-7723.
    """

    acceleration: float | tuple[float, ...] | None = None

    @property
    def description(self) -> str:
        """What it is, in a few words."""
        return "super-twisting differentiator (implicit)"

    @property
    def meaning(self) -> str:
        """What the gains are."""
        return "bounds on the accelerations, rad/s^2 or m/s^2"

    def gains(self, mechanism: Mechanism, period: float) -> FloatArray:
        """Return L for each coordinate, (n,)."""
        del period
        if self.acceleration is not None:
            what = "bound on the acceleration"
            return _per_coordinate(what, self.acceleration, mechanism.n)
        n, m = mechanism.n, mechanism.m
        rest = np.stack([np.zeros(2 * n), mechanism.state(**mechanism.start)])
        rest[:, n:] = 0.0
        signs = np.array(np.meshgrid(*[(-1.0, 1.0)] * m)).reshape(m, -1).T
        largest = [
            np.abs(mechanism.accelerations(0.0, x, mechanism.input_limits * sign))
            for x in rest
            for sign in signs
        ]
        return np.asarray(2.0 * np.max(largest, axis=0))

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


def _listed(value: float | Sequence[float]) -> str:
    values = [value] if isinstance(value, float | int) else list(value)
    return ", ".join(f"{v:g}" for v in values if math.isfinite(v))
