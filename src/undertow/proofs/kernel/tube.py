"""Validated integration: boxes of states that move with ẋ = F(x), by Taylor steps (Lemma 6).

A set is m + C ξ + Q r: ξ the box that it started as, C the derivative of the flow as far as
doubles carry it, Q orthonormal (Lohner), r the box of what has been added since.  The right-hand
side is code; a corner of the clip or of the layer shortens the formula of a step to the second
order and, where no bounds are found, the step.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from undertow.proofs.kernel import compiled as ops
from undertow.proofs.kernel.graph import FloatArray, Program

__all__ = ["Tube"]

#: Coefficients of a step, and the shortest part of a step that is tried.
ORDER, SHORTEST = 12, 2.0**-8


@dataclass
class Tube:
    """One set of states on its way.

    Parameters
    ----------
    program
        Its outputs are F, (N,), of its first N inputs.
    fixed
        Enclosures of its other inputs, (F, 2).
    hull
        A box around the set now, (N, 2).
    """

    program: Program
    fixed: FloatArray
    hull: FloatArray
    m: FloatArray
    C: FloatArray
    xi: FloatArray
    Q: FloatArray
    r: FloatArray

    @classmethod
    def of(cls, program: Program, fixed: FloatArray, box: FloatArray) -> Self:
        """Start from a box of doubles, (N, 2)."""
        n = len(box)
        middle = 0.5 * box[:, 0] + 0.5 * box[:, 1]
        xi = np.array([ops.add(a, b, -v, -v) for (a, b), v in zip(box, middle, strict=True)])
        return cls(
            program, fixed, box.copy(), middle, np.eye(n), xi.reshape(n, 1, 2), np.eye(n),
            np.zeros((n, 1, 2)),
        )  # fmt: skip

    def advance(self, h: float, order: int = ORDER) -> FloatArray | None:
        """Move on by h, in shorter steps where one is not shown.

        Returns
        -------
        ndarray or None
            A box that all motions stay in on the way, (N, 2); None where they may leave the domain
            of F, or no bounds are found.
        """
        whole: FloatArray | None = None
        done, part = 0.0, 1.0
        while done < 1.0:  # parts are powers of two: h · part and their sum are exact
            state = tuple(v.copy() for v in (self.m, self.C, self.Q, self.r))
            stay = self._step(h * part, order, *state)
            if stay is None:
                part *= 0.5
                if part < SHORTEST:
                    return None
                continue
            self.m, self.C, self.Q, self.r = state
            if whole is None:
                whole = stay
            low, high = np.minimum(whole[:, 0], stay[:, 0]), np.maximum(whole[:, 1], stay[:, 1])
            whole = np.column_stack([low, high])
            done += part
            while part < 1.0 and done % (2.0 * part) == 0.0:
                part *= 2.0
        self.hull = ops.hulled(self.m, self.C, self.xi, self.Q, self.r)
        return whole

    def _step(
        self, h: float, order: int, m: FloatArray, C: FloatArray, Q: FloatArray, r: FloatArray
    ) -> FloatArray | None:
        """Move m, C, Q and r on by h; the box that motions stay in, or None."""
        X = ops.hulled(m, C, self.xi, Q, r)
        n, series = len(m), self.program.series
        low, high = np.vstack([X, self.fixed]).T.copy()
        for attempt in range(12):
            rates = self.program(low, high)[:, 0]
            inside = ops.picard(X, rates, low, high, h, 0.1 if attempt < 6 else 0.5)
            if inside:
                break
        if inside != 1:
            return None
        stay = np.column_stack([low[:n], high[:n]])
        rest = series(low, high, order)[:, order, 0]
        if np.isnan(rest).any():  # a corner is inside: the short formula, Clarke's derivatives
            order = 2
            rest = series(low, high, order)[:, order, 0]
        low[:n] = high[:n] = m
        centre = series(low, high, order - 1)[:, :, 0]
        low[:n], high[:n] = X[:, 0], X[:, 1]
        around = series(low, high, order - 1, n)
        moved = ops.taylor_step(rest, centre, around, h, m, C, self.xi, Q, r)
        return stay if moved else None
