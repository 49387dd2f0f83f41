"""Check words of a plan: what ``ut_plan_seal`` computes in C, for who makes plans in Python.

A change of any single word changes its row's check word for certain, since every step of the sum
can be undone; other damage does but for one case in 2³² (single precision) or 2⁶⁴.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from undertow.symbolic import Real, literal

__all__ = ["FACTOR", "WIDTH", "as_held", "seals"]

#: Bits of a word, and the odd factor of each step, by precision.
WIDTH = {"double": 64, "float": 32}
FACTOR = {"double": 0x9E3779B97F4A7C15, "float": 0x9E3779B1}


def as_held(value: float, real: Real) -> float:
    """Return a number as the C holds it."""
    return float(np.float32(literal(value, real).rstrip("f")) if real == "float" else value)


def seals(
    number: int, starts: Sequence[int], rows: Sequence[tuple[ArrayLike, ...]], real: Real
) -> list[int]:
    """Return the check word of each row.

    Parameters
    ----------
    number
        Of the plan.
    starts
        Periods at which the rows take over, ascending from 0.
    rows
        Numbers of each row, as ``as_held`` gives them: surface (2mn,), η (m,) and ε (m,).
    real
        Floating-point type of the C.
    """
    width = WIDTH[real]
    mask = (1 << width) - 1
    kind, unsigned = (np.float32, np.uint32) if real == "float" else (np.float64, np.uint64)

    def folded(value: int) -> int:
        return (value ^ value >> 32) & mask

    words = []
    for k, ((start, following), (surface, eta, layer)) in enumerate(
        zip(pairwise([*starts, 0]), rows, strict=True)
    ):
        gains = np.stack([np.asarray(eta), np.asarray(layer)], axis=1)
        values = np.concatenate([np.asarray(surface), gains.ravel()]).astype(kind)
        total = folded(number)
        for word in (
            len(rows),
            k,
            folded(start),
            folded(following),
            *values.view(unsigned).tolist(),
        ):
            turned = (total << 5 | total >> width - 5) & mask
            total = (turned ^ word) * FACTOR[real] & mask
        words.append(total)
    return words
