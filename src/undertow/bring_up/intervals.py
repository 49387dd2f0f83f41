"""What a reading is worth, and how sure identified quantities are.

An encoder's error is the same for as long as nothing moves by a count, unless noise stirs it:
a hundred readings at rest are one reading.  Least squares that take them for a hundred follow
the encoder's zero, and their residuals, small and white, do not show it.  How long a motion
dwells is known from its prediction, and each reading weighs accordingly.

J is the Jacobian of the weighed residuals, (N n, p), its rows coordinate by coordinate.
"""

from __future__ import annotations

import math

import numpy as np

from undertow.models import FloatArray

__all__ = ["correlated", "counted", "dwell", "readings"]

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

    Parameters
    ----------
    predicted
        Motion, (N, n), rad or m.
    away
        Measured less predicted, (N, n).
    sigma
        Standard deviation of a count, (n,): its size by √12.
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


def counted(
    predicted: FloatArray,
    noise: FloatArray,
    sigma: FloatArray,
    variance: FloatArray,
    J: FloatArray,
) -> FloatArray:
    """Return variances that the encoders alone would make of a predicted motion, (p,).

    The predicted motion is counted from many zeros, with the noise that there is, and each
    time the least squares are followed to first order.

    Parameters
    ----------
    predicted
        Motion, (N, n), rad or m.
    noise, variance
        See :func:`readings`.
    sigma
        Standard deviation of a count, (n,): its size by √12.
    J
        See above.
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
