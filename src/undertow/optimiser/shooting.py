"""Minimum time as a shrinking sequence of hitting problems; knows nothing of control.

The first time at which a motion touches the terminal set is a discontinuous function of
the parameters, and a population search gets stuck on its steps.  The state at a *fixed*
time T is smooth.  So: find parameters with x(T) = 0 by Levenberg-Marquardt, shorten T,
correct, and go on until no correction is found; then change a part of the parameters, correct
the rest, and try again.  A Jacobian is one batch of rollouts.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

#: Miss of N parameter vectors at time T: (N, d), T to (N, k).
Miss = Callable[[FloatArray, float], FloatArray]


@dataclass(eq=False)
class Shooting:
    """Shrinks the time at which a miss can be brought to zero.

    Parameters
    ----------
    miss
        Residuals at a time T, vectorised over parameters; more parameters than residuals.
    tolerance
        ‖miss‖₂ below which a shot has hit.
    grid
        Times are tried on multiples of it, s.
    stop
        Asked before each batch; the best so far stands when it says True.
    """

    miss: Miss
    tolerance: float
    grid: float
    stop: Callable[[], bool] = lambda: False

    def correct(self, z: FloatArray, T: float, iterations: int) -> FloatArray | None:
        """Return parameters near z that hit at T, or ``None``.

        Levenberg-Marquardt with the damping searched over a batch, step length at most 1.
        """
        d = z.size
        probe = 1e-4 * np.vstack([np.eye(d), -np.eye(d)])
        damping = 1e-2
        residual = self.miss(z[None], T)[0]
        error = float(np.linalg.norm(residual))
        for _ in range(iterations):
            if error <= self.tolerance:
                break
            if self.stop():
                return None
            shots = self.miss(z + probe, T)
            jacobian = ((shots[:d] - shots[d:]) / 2e-4).T
            if not np.isfinite(jacobian).all():
                return None
            U, sigma, Vt = np.linalg.svd(jacobian, full_matrices=False)
            dampings = damping * np.array([1e-2, 1e-1, 1.0, 1e1, 1e2, 1e3])
            filters = sigma / (sigma**2 + dampings[:, None])
            steps = -(filters * (U.T @ residual)) @ Vt
            length = np.linalg.norm(steps, axis=1, keepdims=True)
            steps *= np.minimum(1.0, 1.0 / np.maximum(length, 1e-12))
            misses = self.miss(z + steps, T)
            errors = np.linalg.norm(misses, axis=1)
            best = int(np.argmin(errors))
            if errors[best] < 0.9995 * error:
                z, residual, error = z + steps[best], misses[best], float(errors[best])
                damping = float(np.clip(dampings[best], 1e-8, 1e4))
            else:
                damping *= 100.0
                if damping > 1e6:
                    return None
        return z if error <= self.tolerance else None

    def shrink(self, z: FloatArray, T: float) -> tuple[FloatArray, float]:
        """Shorten T as far as corrections follow; z must hit at T."""
        step = 20 * self.grid
        while step >= self.grid and not self.stop():
            shorter = max(round((T - step) / self.grid), 1) * self.grid
            corrected = self.correct(z, shorter, 12) if shorter < T else None
            if corrected is None:
                step /= 2
            else:
                z, T = corrected, shorter
        return z, T

    def on_grid(self, T: float) -> float:
        """Return the multiple of the grid that is nearest to T, at least one."""
        return max(1, round(T / self.grid)) * self.grid

    def nearest(
        self, z: FloatArray, T: float, tries: int, iterations: int = 20
    ) -> tuple[FloatArray, float] | None:
        """Correct the candidates (N, d) that miss least at T, and return the first that hits."""
        misses = np.linalg.norm(self.miss(z, T), axis=1)
        for k in np.argsort(misses, kind="stable")[:tries]:
            hit = self.correct(z[k], T, iterations)
            if hit is not None:
                return hit, T
        return None
