"""Where a mechanism rests when it is left alone."""

from __future__ import annotations

import itertools
import math

import numpy as np

from undertow.base import InfeasibleError
from undertow.models import FloatArray, Mechanism

__all__ = ["rest_state"]


def rest_state(mechanism: Mechanism) -> FloatArray:
    """Return the state, (2n,), in which a mechanism stays with its inputs at zero.

    Angles are tried at 0 and π, slides at 0, for an equilibrium without a growing mode: a
    pendulum hangs.

    Raises
    ------
    InfeasibleError
        When there is none: a ball rolls off its beam.

    Examples
    --------
    >>> import undertow as ut
    >>> rest_state(ut.mechanisms.rotary_pendulum()).round(3).tolist()
    [0.0, 3.142, 0.0, 0.0]
    """
    n = mechanism.n
    choices = [(0.0, math.pi) if c.unit == "rad" else (0.0,) for c in mechanism.coordinates]
    for q in itertools.product(*choices):
        x = np.concatenate([q, np.zeros(n)])
        inside = all(c.low <= v <= c.high for c, v in zip(mechanism.coordinates, q, strict=True))
        still = np.abs(mechanism.accelerations(0.0, x, np.zeros(mechanism.m))).max() < 1e-6
        if inside and still and _growth(mechanism, x) < 1e-3:
            return x
    raise InfeasibleError(
        f"rest of '{mechanism.name}'",
        value="no equilibrium without a growing mode",
        limit="one at angles of 0 or π",
        remedy="Such a mechanism cannot be left alone: hold it, or check it in parts",
    )


def _growth(mechanism: Mechanism, x: FloatArray) -> float:
    """Largest real part of the eigenvalues at an equilibrium, 1/s, by differences."""
    n, step = mechanism.n, 1e-5
    rows = np.vstack([x + step * np.eye(2 * n), x - step * np.eye(2 * n)])
    a = mechanism.accelerations(0.0, rows, np.zeros(mechanism.m))
    below = ((a[: 2 * n] - a[2 * n :]) / (2 * step)).T
    A = np.vstack([np.hstack([np.zeros((n, n)), np.eye(n)]), below])
    return float(np.linalg.eigvals(A).real.max())
