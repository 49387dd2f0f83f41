"""Surfaces fitted to a given motion, by linear least squares.

In its boundary layer the law makes ṡ + r s = 0 with the rate r = η/ε.  Where a motion is given,
with its accelerations, that is linear in the entries of λ_a, α_u and λ_u: each row of a
surface is the least-squares solution, drawn towards a first surface where the motion leaves it
open.  How fast r should be and how strongly to draw is not known: each pair of some gives a
surface.

A piece of a motion is followed within a layer as thick as keeps it inside (:func:`fits`).  A
motion that is at the limits of its inputs but for its switches is followed where the law, too,
passes through no input at the switching points (:func:`switching_fits`).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator

import numpy as np

from undertow.law import Plan, ReachingLaw, Surface
from undertow.models import FloatArray
from undertow.optimiser.search_space import SearchSpace

#: Rates r, 1/s, and how strongly the fit is drawn towards the first surface, in parts of the
#: largest acceleration.
RATES, DRAWN_TO = (15.0, 40.0, 80.0, 150.0, 300.0), (1e-4, 1e-2, 1e-1)

#: Thickness of the layer, in parts of the largest |s| along the motion.
THICK = 2.0

#: The same of a motion that switches.  At an infinite rate s = 0 at its switching points, whatever
#: the accelerations are; the law has the largest of the others.
SWITCHING_RATES, SWITCHING_DRAWN_TO = (60.0, 100.0, 170.0, 300.0, math.inf), (1e-6, 1e-2, 3e-2)
SWITCHING_THICK = (0.05, 0.3, 2.0)


def fits(space: SearchSpace, anchor: Surface, x: FloatArray, qdd: FloatArray) -> FloatArray:
    """Return search coordinates (N, d) of surfaces that follow a piece of a motion.

    ``space``: the coordinates, of one surface with its reaching law. ``anchor``: the first surface.
    ``x``, ``qdd``: states (2n, K) and accelerations (n, K) along the piece, SI units.
    """
    pairs = itertools.product(RATES, DRAWN_TO)
    return np.array([next(_encoded(space, anchor, x, qdd, x, *pair, (THICK,))) for pair in pairs])


def switching_fits(
    space: SearchSpace, anchor: Surface, x: FloatArray, qdd: FloatArray, along: FloatArray
) -> FloatArray:
    """Return search coordinates (N, d) of surfaces that switch at some points of a motion.

    ``space``, ``anchor``: see :func:`fits`; without reaching laws of their own only the surfaces
    count. ``x``, ``qdd``: states (2n, K) and accelerations (n, K) without input there, SI units.
    ``along``: states (2n, L) along the whole motion.
    """
    pairs = itertools.product(SWITCHING_RATES, SWITCHING_DRAWN_TO)
    return np.vstack(
        [list(_encoded(space, anchor, x, qdd, along, *pair, SWITCHING_THICK)) for pair in pairs]
    )


def _encoded(
    space: SearchSpace,
    anchor: Surface,
    x: FloatArray,
    qdd: FloatArray,
    along: FloatArray,
    r: float,
    drawn: float,
    thick: tuple[float, ...],
) -> Iterator[FloatArray]:
    """Yield the coordinates of a fit with layers in parts of the largest |s| along a motion."""
    n, m = space.n, space.m
    first = anchor.normalised()
    centre = np.hstack([first.lambda_a, first.alpha_u, first.lambda_u])
    width = np.maximum(np.abs(centre), 0.05 * np.abs(centre).max())
    moved, laid = (0.0, 1.0) if math.isinf(r) else (1.0, r)  # parts of ṡ and of s

    def terms(x: FloatArray) -> FloatArray:
        q, v = x[:n], x[n:]
        return np.vstack([q[:m], v[m:], q[m:]])

    v = x[n:]
    rates = np.vstack([v[:m], qdd[m:], v[m:]])
    rows, largest = np.empty((m, 2 * n - m)), np.empty(m)
    for i in range(m):
        wanted = moved * qdd[i] + laid * v[i]
        unit = np.abs(wanted).max() + 1e-12
        sides = ((moved * rates + laid * terms(x)) * width[i][:, None]).T / unit
        ridge = drawn * np.eye(len(width[i]))
        goals = np.concatenate([wanted / unit, drawn * centre[i] / width[i]])
        rows[i] = width[i] * np.linalg.lstsq(np.vstack([sides, ridge]), goals, rcond=None)[0]
        largest[i] = np.abs(rows[i] @ terms(along) - along[n + i]).max() + 1e-9
    surface = Surface(-np.eye(m), rows[:, :m], rows[:, m:n], rows[:, n:])
    rate = min(r, SWITCHING_RATES[-2])
    for part in thick:
        layer = part * largest
        law = ReachingLaw(tuple(rate * layer), tuple(layer))
        yield space.encode(Plan((surface,), (0.0,), (law,)))
