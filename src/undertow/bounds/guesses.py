"""Motions to start from: recorded, decaying, regulated, swinging."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
import scipy.integrate
import scipy.linalg

from undertow.base import InvalidInputError
from undertow.closed_loop import Trajectory
from undertow.models import FloatArray, Mechanism, linearise
from undertow.models.importers import holding_input
from undertow.objective import finite_limits


class Guess(NamedTuple):
    """A motion to start from: states and inputs at given times, arrays (N,) to (N, …)."""

    name: str
    time: float
    x: Callable[[FloatArray], FloatArray]
    u: Callable[[FloatArray], FloatArray]


def time_scale(mechanism: Mechanism, longest: float) -> float:
    """Ten time constants of the slowest free mode of the unactuated joints, s.

    With the actuated ones held, M_uu q̈_u = F_uu q_u: where things happen, whatever the
    motors' own, often far faster, modes are.
    """
    lin, m = linearise(mechanism), mechanism.m
    rates = np.sqrt(np.abs(np.linalg.eigvals(np.linalg.solve(lin.M[m:, m:], lin.F[m:, m:]))))
    return 10.0 / max(float(rates.min()), 10.0 / longest)


def rests(mechanism: Mechanism) -> bool:
    """Whether the target is stable under the input that holds it: motions may take all the time."""
    return bool(np.linalg.eigvals(linearise(mechanism).A).real.max() <= 1e-9)


def recorded(mechanism: Mechanism, guess: Trajectory | Sequence[Trajectory] | None) -> list[Guess]:
    """Turn recorded motions into guesses, refusing those of another shape."""
    if guess is None:
        return []
    given = [guess] if isinstance(guess, Trajectory) else list(guess)
    out = []
    for index, motion in enumerate(given):
        shape = (motion.x.shape[-1], motion.u.shape[-1])
        wanted = (2 * mechanism.n, mechanism.m)
        finite = np.isfinite(motion.x).all() and np.isfinite(motion.u).all()
        if shape != wanted or not finite or motion.time <= motion.t[0]:
            raise InvalidInputError(
                f"guess {index}",
                value=f"{shape[0]} states, {shape[1]} inputs, {len(motion.t)} samples",
                limit=f"finite, {wanted[0]} states, {wanted[1]} inputs, of some length",
            )
        name, times = f"guess {index}", motion.t - motion.t[0]
        out.append(_sampled(name, times, motion.x, motion.u, holding_input(mechanism)))
    return out


def _sampled(name: str, t: FloatArray, x: FloatArray, u: FloatArray, held: FloatArray) -> Guess:
    """A guess from samples; after their end the last state stays, with the input ``held``."""

    def states(at: FloatArray) -> FloatArray:
        return np.stack([np.interp(at, t, column) for column in x.T], axis=-1)

    def inputs(at: FloatArray) -> FloatArray:
        columns = zip(u.T, held, strict=True)
        return np.stack([np.interp(at, t, column, right=last) for column, last in columns], axis=-1)

    return Guess(name, float(t[-1]), states, inputs)


def built_in(
    mechanism: Mechanism, x0: FloatArray, scale: float, longest: float, swing: bool
) -> Iterator[Guess]:
    """Yield the built-in guesses: decay, saturated linear-quadratic feedback, coasting, swings."""
    held = _held(mechanism)

    def decay(t: FloatArray) -> FloatArray:
        return np.asarray(x0 * np.exp(-4.0 * t[:, None] / scale))

    yield Guess("exponential decay", scale, decay, held)
    for found in (_regulated(mechanism, x0, scale, longest), _coasting(mechanism, x0, longest)):
        if found is not None:
            yield found
    if swing:
        yield from _swings(mechanism, x0, scale, longest)


def _held(mechanism: Mechanism) -> Callable[[FloatArray], FloatArray]:
    """Return the input that holds the target, as a function of times, (N,) to (N, m)."""
    rest = holding_input(mechanism)
    return lambda t: np.tile(rest, (len(t), 1))


def _regulated(mechanism: Mechanism, x0: FloatArray, scale: float, longest: float) -> Guess | None:
    """Simulate linear-quadratic feedback, clipped; None where it does not arrive."""
    lin, limits, rest = linearise(mechanism), mechanism.input_limits, holding_input(mechanism)
    weight = np.diag(1.0 / finite_limits(mechanism) ** 2)
    try:
        P = scipy.linalg.solve_continuous_are(lin.A, lin.input, np.eye(2 * mechanism.n), weight)
    except np.linalg.LinAlgError:
        return None
    gain = np.linalg.solve(weight, lin.input.T @ P)

    def control(x: FloatArray) -> FloatArray:
        return np.clip(rest - x @ gain.T, -limits, limits)

    def rate(t: float, x: FloatArray) -> FloatArray:
        return np.concatenate([x[mechanism.n :], mechanism.accelerations(t, x, control(x))])

    def lost(_t: float, x: FloatArray) -> float:
        return 1e3 * (1.0 + float(np.linalg.norm(x0))) - float(np.linalg.norm(x))

    lost.terminal = True  # type: ignore[attr-defined]
    span = min(3.0 * scale, longest)
    run = scipy.integrate.solve_ivp(
        rate, (0.0, span), x0, rtol=1e-6, atol=1e-8, max_step=scale / 50, events=lost
    )
    x = run.y.T
    if not run.success or run.t[-1] < span or np.linalg.norm(x[-1]) > np.linalg.norm(x0):
        return None
    return _sampled("linear-quadratic feedback", run.t, x, control(x), rest)


def _coasting(mechanism: Mechanism, x0: FloatArray, longest: float) -> Guess | None:
    """Let go: the motion under the input that holds the target; None where that is not stable."""
    if not rests(mechanism):
        return None
    rest = holding_input(mechanism)

    def rate(_t: float, x: FloatArray) -> FloatArray:
        return np.concatenate([x[mechanism.n :], mechanism.accelerations(0.0, x, rest)])

    run = scipy.integrate.solve_ivp(
        rate, (0.0, longest), x0, rtol=1e-8, atol=1e-10, dense_output=True
    )
    motion = run.sol
    if not run.success or motion is None:
        return None
    return Guess("coasting", longest, lambda t: motion(t).T, _held(mechanism))


def _swings(mechanism: Mechanism, x0: FloatArray, scale: float, longest: float) -> Iterator[Guess]:
    """Yield motions in which an unactuated angle falls to its far side and swings back once.

    For an angle that starts at φ₀ on the positive side: φ = π − (π − φ₀) cos(2πt/T), then
    to the target; mirrored on the other side.
    """
    n, held = mechanism.n, _held(mechanism)
    for i in range(mechanism.m, n):
        if mechanism.coordinates[i].unit != "rad":
            continue
        side = math.copysign(1.0, x0[i])

        for period in (scale / 2.0, scale):
            duration = min(1.5 * period, longest)

            def states(
                t: FloatArray, i: int = i, side: float = side, period: float = period
            ) -> FloatArray:
                x = x0 * np.exp(-4.0 * t[:, None] / scale)
                amplitude = math.pi - abs(x0[i])
                angle = 2.0 * math.pi * t / period
                after = np.exp(-8.0 * np.maximum(t - period, 0.0) / period)
                swinging = t < period
                x[:, i] = side * np.where(
                    swinging, math.pi - amplitude * np.cos(angle), abs(x0[i]) * after
                )
                x[:, n + i] = side * np.where(
                    swinging,
                    amplitude * 2.0 * math.pi / period * np.sin(angle),
                    -8.0 / period * abs(x0[i]) * after,
                )
                return x

            name = f"swing of {mechanism.coordinates[i].name}, {period:.3g} s"
            yield Guess(name, duration, states, held)
