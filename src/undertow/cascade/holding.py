"""How a target is held once it was reached.

In the terminal set nothing costs anything: what arrives there for least energy hardly damps, sways
on, and leaves it again.  There another law takes over, as in dual-mode predictive control
(Michalska and Mayne, *IEEE Trans. Automatic Control* 38(11), 1993, 1623-1633): the designed
surface, reached as fast as the motion on it decays, unless the plan in use brings the motion to
rest as well.  Near the target the closed loop is ẋ = Ax, and

    V(x) = xᵀPx = ∫₀^∞ xᵀx dt,    AᵀP + PA = −I,

says which of them does.  V falls along the motion: for as long as it does the target is held,
within the terminal set or on a way back to it.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from undertow.cascade.predictions import Predictions
from undertow.cascade.state import CascadeState
from undertow.closed_loop import ClosedLoop, Event
from undertow.law import Plan, ReachingLaw, Surface, matrix_at_target, stability_margin
from undertow.models import FloatArray, Mechanism


@lru_cache(maxsize=16)
def regulation(mechanism: Mechanism, surface: Surface, reaching: ReachingLaw) -> FloatArray:
    """Return P, (2n, 2n), with xᵀPx = ∫ xᵀx dt near the target; NaN where it is unstable."""
    from scipy.linalg import solve_continuous_lyapunov  # slow to import

    A = matrix_at_target(mechanism, surface, reaching)
    if not np.linalg.eigvals(A).real.max() < 0:
        return np.full(A.shape, np.nan)
    return np.asarray(solve_continuous_lyapunov(A.T, -np.eye(len(A))), np.float64)


class Holding:
    """Says whether a target is held, and with what.

    Parameters
    ----------
    predictions
        The predicted loops.
    surface
        The designed one.
    """

    def __init__(self, predictions: Predictions, surface: Surface) -> None:
        self.predictions, loop = predictions, predictions.prior
        self.radius = loop.objective.terminal_radius
        eta, _ = loop.reaching.per_surface(surface.m)
        layer = eta / float(stability_margin(loop.mechanism, surface))
        self.plan = Plan((surface,), (0.0,), (replace(loop.reaching, layer=tuple(layer.tolist())),))

    def _left(self, loop: ClosedLoop, plan: Plan, error: FloatArray) -> float:
        """V of a state with what a plan ends in."""
        P = regulation(loop.mechanism, plan.surfaces[-1], plan.laws(loop.reaching)[-1])
        return float(error @ P @ error)

    def at_home(self, state: CascadeState, error: FloatArray, t: float) -> bool:
        """Whether the target is reached at the time t, s, or held: V is no more than it was."""
        if np.linalg.norm(error) <= self.radius:
            return True
        if state.plan != self.plan or not state.x:
            return False
        loop = self.predictions.at(state, t)
        now, before = (self._left(loop, self.plan, x) for x in (error, np.array(state.x)))
        return now <= before

    def best(self, state: CascadeState, error: FloatArray, t: float) -> Plan | None:
        """The plan to hold what was reached with; ``None``: the one in use, or the target moves.

        It has to keep every plausible plant there, with the inputs that it has.
        """
        if state.plan == self.plan or (state.target is not None and state.target.moves):
            return None
        loop, used = self.predictions.at(state, t), state.at(t)
        held, kept = (self._left(loop, plan, error) for plan in (self.plan, used))
        if used != self.plan and not (held < kept or np.isnan(kept)):
            return None
        motion = loop.batch(error, self.plan, terminal=0.0)
        stays = motion.event[0] == Event.HORIZON and motion.radius[0] <= self.radius
        return self.plan if stays else None
