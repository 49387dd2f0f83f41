"""Surfaces fitted to a piece of a given motion, by linear least squares.

In its boundary layer the law makes ṡ + r s = 0 with the rate r = η/ε.  Along a motion that is
given, with its accelerations, that is linear in the entries of λ_a, α_u and λ_u: each row of a
surface is the least-squares solution, drawn towards a first surface where the motion leaves it
open.  The layer is as thick as keeps the motion inside it.  How fast r should be and how strongly
to draw is not known: each pair of some gives a surface.
"""

from __future__ import annotations

import itertools

import numpy as np

from undertow.law import Plan, ReachingLaw, Surface
from undertow.models import FloatArray
from undertow.optimiser.search_space import SearchSpace

#: Rates r, 1/s, and how strongly the fit is drawn towards the first surface, in parts of the
#: largest acceleration.
RATES, DRAWN_TO = (15.0, 40.0, 80.0, 150.0, 300.0), (1e-4, 1e-2, 1e-1)

#: Thickness of the layer, in parts of the largest |s| along the motion.
THICK = 2.0


def fits(space: SearchSpace, anchor: Surface, x: FloatArray, qdd: FloatArray) -> FloatArray:
    """Return search coordinates (N, d) of surfaces that follow a piece of a motion.

    Parameters
    ----------
    space
        The coordinates, of one surface with its reaching law.
    anchor
        The first surface.
    x, qdd
        States (2n, K) and accelerations (n, K) along the piece, SI units.
    """
    n, m = space.n, space.m
    q, v = x[:n], x[n:]
    first = anchor.normalised()
    centre = np.hstack([first.lambda_a, first.alpha_u, first.lambda_u])
    width = np.maximum(np.abs(centre), 0.05 * np.abs(centre).max())
    laid = np.vstack([q[:m], v[m:], q[m:]])
    rates = np.vstack([v[:m], qdd[m:], v[m:]])
    found = []
    for r, drawn in itertools.product(RATES, DRAWN_TO):
        rows, layer = np.empty((m, 2 * n - m)), np.empty(m)
        for i in range(m):
            wanted = qdd[i] + r * v[i]
            unit = np.abs(wanted).max() + 1e-12
            terms = ((rates + r * laid) * width[i][:, None]).T / unit
            ridge = drawn * np.eye(len(width[i]))
            sides = np.concatenate([wanted / unit, drawn * centre[i] / width[i]])
            rows[i] = width[i] * np.linalg.lstsq(np.vstack([terms, ridge]), sides, rcond=None)[0]
            layer[i] = THICK * np.abs(rows[i] @ laid - v[i]).max() + 1e-9
        surface = Surface(-np.eye(m), rows[:, :m], rows[:, m:n], rows[:, n:])
        law = ReachingLaw(tuple(r * layer), tuple(layer))
        found.append(space.encode(Plan((surface,), (0.0,), (law,))))
    return np.array(found)
