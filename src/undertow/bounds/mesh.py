"""Meshes in time, and how far a motion on one is from the equations of motion."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.interpolate
import scipy.optimize

from undertow.models import FloatArray, Mechanism


def first_mesh(count: int, dense: float) -> FloatArray:
    """Nodes in [0, 1]: six tenths of them even on [0, dense], then in geometric progression."""
    if dense >= 0.5:
        return np.linspace(0.0, 1.0, count + 1)
    even = round(0.6 * count)
    first = dense / even
    powers = np.arange(1, count - even + 1)

    def excess(ratio: float) -> float:
        return float(first * np.sum(ratio**powers) - (1.0 - dense))

    ratio = 1.0
    if excess(1.0) < 0:
        ratio = float(scipy.optimize.brentq(excess, 1.0, (1.0 / first) ** (1.0 / len(powers)) + 1))
    steps = np.concatenate([np.full(even, first), first * ratio**powers])
    nodes = np.concatenate([[0.0], np.cumsum(steps)])
    return np.asarray(nodes / nodes[-1])


def adapted_mesh(
    mesh: FloatArray, errors: FloatArray, inputs: FloatArray, count: int
) -> FloatArray:
    """Spread ``count`` intervals by the present mesh, the local errors and the input's jumps.

    The local error of an interval of length h is of order h⁵, so its fifth root says how
    many intervals it deserves; a jump of the input is pinned down by short ones.
    """
    jumps = (np.abs(np.diff(inputs, axis=0)) / (1e-12 + np.ptp(inputs, axis=0))).max(axis=1)
    shares = np.full(len(errors), 0.25 / len(errors))
    for weight, share in ((0.45, np.maximum(errors, 1e-14) ** 0.2), (0.3, np.sqrt(jumps + 1e-12))):
        shares += weight * share / share.sum()
    at = np.concatenate([[0.0], np.cumsum(shares)])
    return np.interp(np.linspace(0.0, at[-1], count + 1), at, mesh)


def hermite(mechanism: Mechanism, t: FloatArray, x: FloatArray, u: FloatArray) -> Any:
    """Return the cubic x̃(t) through the nodes with their accelerations as slopes."""
    return scipy.interpolate.CubicHermiteSpline(t, x, _rates(mechanism, t, x, u))


def _rates(mechanism: Mechanism, t: FloatArray, x: FloatArray, u: FloatArray) -> FloatArray:
    """ẋ = (q̇, q̈) from the mechanism's own forward dynamics, (N, 2n)."""
    n = mechanism.n
    # Forward dynamics broadcast over the time as over the states.
    qdd = mechanism.accelerations(t, x, u)  # type: ignore[arg-type]
    return np.concatenate([x[:, n:], qdd], axis=1)


def defects(mechanism: Mechanism, nodes: FloatArray, x: FloatArray, u: FloatArray) -> FloatArray:
    """Largest scaled ∫|ẋ̃ − f(x̃, u)| dt of each interval, (N,): see ``Bound.defect``."""
    spline = hermite(mechanism, nodes, x, u)
    points, weights = np.polynomial.legendre.leggauss(5)
    h = np.diff(nodes)
    t = (nodes[:-1, None] + h[:, None] * (points + 1) / 2).ravel()
    inputs = np.stack([np.interp(t, nodes, column) for column in u.T], axis=-1)
    residual = np.abs(spline(t, 1) - _rates(mechanism, t, spline(t), inputs))
    residual = residual.reshape(len(h), len(points), -1)
    integral = np.einsum("k,p,kpi->ki", h / 2, weights, residual)
    return np.asarray((integral / (1.0 + np.abs(x).max(axis=0))).max(axis=1))
