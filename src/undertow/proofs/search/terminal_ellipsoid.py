"""The search for terminal ellipsoids: modes of the linear closed loop, weighted.

Nothing here proves anything: every set that is returned is one that the kernel of
:mod:`undertow.proofs.kernel.claims` has accepted.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from undertow.base.errors import ModelError
from undertow.law import ProvedSet, ReachingLaw, Surface
from undertow.models.mechanism import FloatArray, Mechanism
from undertow.proofs.claims.terminal_ellipsoid import ClosedLoopProgram, TerminalEllipsoid, prove
from undertow.proofs.kernel.compiled import between

#: Smallest semi-axes, relative to the largest, that are tried first.
FLOORS = (0.02, 0.005, 0.001)

#: Margin from which no search for weights comes back.
HOPELESS = -2.0

#: Proofs that are tried around a state, some ten microseconds each.
EFFORT = 60


@dataclass(frozen=True, eq=False)
class EllipsoidSearch:
    """Ellipsoids whose axes are the modes of one closed loop.

    ``margin``: the kernel's margin of a candidate, at most 0 where it is not proved. ``C``,
    ``layer``: s = C x, (m, 2n), and the half-widths of the layer, (m,). ``T``, ``T_inverse``: real
    modal matrix with columns of unit length, (2n, 2n), and its inverse. ``rates``: decay rate of
    each column, (2n,), 1/s. ``modes``: the number of the mode of each column, (2n,): a complex pair
    shares one.
    """

    margin: Callable[[TerminalEllipsoid], float]
    C: FloatArray
    layer: FloatArray
    T: FloatArray
    T_inverse: FloatArray
    rates: FloatArray
    modes: NDArray[np.int64]

    @classmethod
    def of(
        cls, margin: Callable[[TerminalEllipsoid], float], A: FloatArray, C: FloatArray,
        layer: FloatArray, period: float = 0.0,
    ) -> Self | None:  # fmt: skip
        """Take the modes of ẋ = A x or, with a period, of x(period) = A x(0).

        ``None`` where it is not stable, or has no full set of modes.
        """
        if not np.isfinite(A).all():
            return None
        values, vectors = np.linalg.eig(A)
        with np.errstate(divide="ignore"):
            decay = -np.log(np.abs(values)) / period if period else -values.real
        decay = np.minimum(decay, 1e6)  # of a mode that is gone after one period
        if not (decay > 0).all():
            return None
        columns: list[FloatArray] = []
        rates: list[float] = []
        modes: list[int] = []
        for value, rate, vector in zip(values, decay, vectors.T, strict=True):
            if value.imag < 0:
                continue  # the conjugate has been taken
            new = [vector.real] if value.imag == 0 else [vector.real, vector.imag]
            modes += [modes[-1] + 1 if modes else 0] * len(new)
            columns += [v / np.linalg.norm(vector) for v in new]
            rates += [rate] * len(new)
        T = np.array(columns, dtype=np.float64).T
        if not np.linalg.cond(T) < 1e12:
            return None
        inverse = np.asarray(np.linalg.inv(T), dtype=np.float64)
        return cls(margin, C, layer, T, inverse, np.array(rates), np.array(modes))

    def _candidate(self, weights: FloatArray, radius: float) -> TerminalEllipsoid:
        """Return {|W x| ≤ ρ} with semi-axes ρ·exp(weight) along the modes."""
        d = np.exp(weights)[self.modes]
        return TerminalEllipsoid(
            self.T_inverse / d[:, None], self.T * (d / np.sqrt(self.rates)), radius
        )

    def around(self, x: ArrayLike) -> TerminalEllipsoid | None:
        """Return a proved terminal set that contains the state x, (2n,), or ``None``."""
        state = np.asarray(x, dtype=float)
        if not np.any(state):
            return self.largest()
        if (np.abs(self.C @ state) > self.layer).any():
            return None  # an ellipsoid around 0 that holds the state leaves the layer
        z = self.T_inverse @ state
        square = np.zeros(self.modes[-1] + 1)
        np.add.at(square, self.modes, z * z)
        size = np.sqrt(square)

        def through(weights: FloatArray) -> TerminalEllipsoid:
            radius = float(np.sqrt(np.sum(square * np.exp(-2.0 * weights))))
            return self._candidate(weights, radius * (1 + 1e-9))

        best = -np.inf
        for floor in FLOORS:
            # Modes that are all but gone still need some room for what the others stir up.
            trial = np.log(np.maximum(size, floor * size.max()))
            candidate = through(trial)
            margin = self.margin(candidate)
            if margin > 0:
                return candidate
            if margin > best:
                weights, best = trial, margin
        tried, step = 0, 1.0
        while best > HOPELESS and tried < EFFORT and step > 0.1:
            before = best
            for j, sign in ((j, s) for j in range(len(weights)) for s in (1, -1)):
                trial = weights.copy()
                trial[j] += sign * step
                candidate = through(trial)
                margin = self.margin(candidate)
                if margin > 0:
                    return candidate
                tried += 1
                if margin > best:
                    weights, best = trial, margin
            if not best > before:
                step *= 0.5
        return None

    @cached_property
    def succeeds(self) -> bool:
        """Whether some ellipsoid is proved at all, however small."""
        return self.largest(0) is not None

    def largest(self, rounds: int = 3) -> TerminalEllipsoid | None:
        """Return the proved terminal set with the largest ball that a short search finds.

        ``rounds``: rounds of the search for weights of the modes; 0 takes them all alike.
        """
        weights = np.zeros(self.modes[-1] + 1)
        radius = self._widest(weights, 0.01, 1.1)
        if radius == 0:
            # Slow modes that the fast ones disturb: give them room, and try once more.
            each = np.array([self.rates[self.modes == k].mean() for k in range(len(weights))])
            weights = -0.5 * np.log(each / each.min())
            radius = self._widest(weights, 0.01, 1.1)
        if radius == 0:
            return None
        ball, step = self._candidate(weights, radius).ball, 1.0
        for _ in range(rounds):
            before = ball
            for j, sign in ((j, s) for j in range(len(weights)) for s in (1, -1)):
                trial = weights.copy()
                trial[j] += sign * step
                # Worth a bisection only if a larger ball is proved.
                need = radius * 1.05 * ball / self._candidate(trial, radius).ball
                if self.margin(self._candidate(trial, need)) > 0:
                    radius = self._widest(trial, need, 1.1)
                    weights, ball = trial, self._candidate(trial, radius).ball
            if ball < 1.02 * before:
                step *= 0.5
        return self._candidate(weights, self._widest(weights, radius, 1.01))

    def _widest(self, weights: FloatArray, start: float, precision: float) -> float:
        """Largest radius that is proved, within a factor; 0 where none is."""
        low, high, radius = 0.0, np.inf, start
        for _ in range(40):
            if self.margin(self._candidate(weights, radius)) > 0:
                low = radius
            else:
                high = radius
            if (low > 0 and high < precision * low) or high < 1e-9 * start:
                break
            radius = 4.0 * low if np.isinf(high) else float(np.sqrt(max(low, high / 16) * high))
        return low


@lru_cache(maxsize=1024)
def search_for(
    mechanism: Mechanism, surface: Surface, reaching: ReachingLaw
) -> EllipsoidSearch | None:
    """Prepare the search for one closed loop, continuous, belief equal to plant.

    Returns
    -------
    EllipsoidSearch or None
        ``None`` where the model is not smooth, or the linear closed loop is not stable or has
        no full set of modes.
    """
    try:
        loop = ClosedLoopProgram.of(mechanism, reaching.switching)
    except ModelError:  # not smooth: nothing is proved of it
        return None
    if not loop.at_rest(mechanism):
        return None
    numbers = loop.numbers(mechanism, surface, reaching)
    at_target = loop.at_target(numbers)
    gradients = at_target[:, 1:]
    n, rows = loop.n, loop.rows(numbers)
    A = np.vstack([np.eye(n, 2 * n, n), gradients[:n].mean(axis=-1)])
    limits, centre = mechanism.input_limits, between(*at_target[:, 0].T)

    def margin(candidate: TerminalEllipsoid) -> float:
        why, found, _ = prove(loop, numbers, rows, limits, candidate, centre)
        return min(found, 0.0) if why else found

    return EllipsoidSearch.of(margin, A, *rows)


def terminal_sets(
    mechanism: Mechanism, surfaces: Iterable[Surface], reaching: ReachingLaw
) -> tuple[ProvedSet, ...]:
    """Return the terminal sets of surfaces, one for each that a proof is found for.

    Raises
    ------
    InvalidInputError
        For a force that depends on time, or a switching function that is not smooth at 0.
    """
    found = []
    for surface in surfaces:
        search = search_for(mechanism, surface, reaching)
        ellipsoid = None if search is None else search.largest()
        if ellipsoid is not None:
            found.append(ProvedSet(surface, reaching, ellipsoid, mechanism.fingerprint))
    return tuple(found)
