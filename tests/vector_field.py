"""Any motion ẋ = f(x) for tests of searches, which ask no more of a motion on a surface."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import sympy as sp
from numpy.typing import ArrayLike

from undertow.models import FloatArray


class VectorField:
    """ẋ = rates(x), never singular."""

    surface = "a vector field"

    def __init__(self, states: Sequence[sp.Symbol], rates: Sequence[sp.Expr]) -> None:
        self.states, self.rates = tuple(states), tuple(rates)
        self._function = sp.lambdify(self.states, self.rates, "numpy")
        self._slope = sp.lambdify(self.states, sp.Matrix(self.rates).jacobian(self.states), "numpy")

    @property
    def size(self) -> int:
        """N."""
        return len(self.states)

    @property
    def jacobian(self) -> FloatArray:
        """∂ẋ/∂x at 0, (N, N)."""
        return np.asarray(self._slope(*np.zeros(self.size)), dtype=float)

    def __call__(self, x: ArrayLike) -> FloatArray:
        """Return ẋ at points, (…, N) to (…, N)."""
        columns = np.moveaxis(np.asarray(x, dtype=float), -1, 0)
        values = self._function(*columns)
        return np.stack([np.broadcast_to(v, columns.shape[1:]) for v in values], axis=-1)

    def margin(self, x: ArrayLike) -> FloatArray:
        """Return 1: it is nowhere singular."""
        return np.ones(np.shape(x)[:-1])
