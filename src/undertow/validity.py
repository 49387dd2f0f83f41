"""Conditions on the parts of a mechanism; each failure names the entry, the limit, the remedy."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from collections.abc import Set as AbstractSet

import numpy as np
import sympy as sp

from undertow.errors import ModelError
from undertow.quantities import TIME, Coordinate, FloatArray

__all__ = ["check_definite", "check_names", "check_symbols", "check_symmetric"]


def check_names(owner: str, names: Sequence[str]) -> None:
    """Refuse names that meet each other, the time's, or those of generated code."""
    every = [*names, TIME.name]
    repeated = sorted({name for name in every if every.count(name) > 1})
    if repeated:
        raise ModelError(
            f"a name of '{owner}' is used twice",
            value=", ".join(repeated),
            limit="unique among coordinates, inputs, parameters and the time t",
            remedy="Rename one of them",
        )
    private = sorted(name for name in every if name.startswith("_"))
    if private:
        raise ModelError(
            f"a name of '{owner}' starts with an underscore",
            value=", ".join(private),
            limit="a letter first",
            remedy="Rename it: such names are kept for generated code",
        )


def check_symbols(what: str, matrix: sp.Matrix, allowed: AbstractSet[sp.Symbol]) -> None:
    """Refuse symbols that nobody declared."""
    unknown = sorted(str(s) for s in matrix.free_symbols - allowed)
    if unknown:
        raise ModelError(
            f"{what} has unknown symbols",
            value=", ".join(unknown),
            limit=f"among {', '.join(sorted(str(s) for s in allowed))}",
            remedy="Declare them as parameters, or as coordinates, with real symbols",
        )


def check_symmetric(what: str, matrix: sp.Matrix) -> None:
    """Refuse a square matrix that differs from its transpose."""
    skew = matrix - matrix.T
    for j, i in itertools.combinations(range(matrix.rows), 2):
        if skew[i, j] != 0 and sp.simplify(skew[i, j]) != 0:
            raise ModelError(
                what,
                value=f"{matrix[j, i]} at [{j}, {i}] and {matrix[i, j]} at [{i}, {j}]",
                limit="symmetric",
                remedy="Derive M from the kinetic energy: Mechanism.from_energies",
            )


def check_definite(
    what: str, coordinates: Sequence[Coordinate], mass: Callable[[FloatArray], FloatArray]
) -> None:
    """Refuse an M(q) that is not positive definite at one of 16 positions, the target first."""
    rng = np.random.default_rng(0)
    spread = np.array([math.pi if c.unit == "rad" else 1.0 for c in coordinates])
    for trial in range(16):
        q = trial * rng.uniform(-spread, spread) / 15
        smallest = float(np.linalg.eigvalsh(mass(q))[0])
        if not smallest > 0:
            where = ", ".join(
                f"{c.name} = {v:.3g} {c.unit}" for c, v in zip(coordinates, q, strict=True)
            )
            raise ModelError(
                f"{what} at {where}",
                value=f"smallest eigenvalue {smallest:.3g}",
                limit="positive",
                remedy="Check masses, lengths and inertias: a massless link has no M > 0",
            )
