"""How sure identified quantities are: variances of least squares from measured motions.

J is the Jacobian of the residuals, (N n, p), in standard deviations of a count, its rows
coordinate by coordinate.
"""

from __future__ import annotations

import math

import numpy as np

from undertow.mechanism import FloatArray

__all__ = ["correlated", "counted"]

#: Encoder zeros from which a predicted motion is counted.
ZEROS = 200


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
    predicted: FloatArray, away: FloatArray, sigma: FloatArray, J: FloatArray
) -> FloatArray:
    """Return variances that the encoders alone would make of a predicted motion, (p,).

    A count is off by the same while nothing moves: its error is as random as the encoder's
    zero is, and no more, and residuals that are small and look white say nothing of that.
    The predicted motion is counted from many zeros, with as much noise as the residuals have
    beyond that of counts, and each time the least squares are followed to first order.

    Parameters
    ----------
    predicted
        Motion, (N, n), rad or m.
    away
        Measured less predicted, (N, n).
    sigma
        Standard deviation of a count, (n,): its size by √12.
    J
        See above.
    """
    rng = np.random.default_rng(0)
    step, noise = sigma * math.sqrt(12), np.sqrt(np.maximum(away.var(axis=0) - sigma**2, 0.0))
    solve, draws = np.linalg.pinv(J), []
    for _ in range(ZEROS):
        zero = rng.uniform(size=len(step))
        true = predicted + noise * rng.standard_normal(predicted.shape)
        error = (np.floor(true / step + zero) - zero + 0.5) * step - predicted
        draws.append(solve @ ((error - error.mean(axis=0)) / sigma).T.ravel())
    return np.asarray(np.var(draws, axis=0, ddof=1))
