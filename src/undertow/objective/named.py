"""Objectives by their words: one home, so that a word means the same problem everywhere.

``energy`` and ``time`` are the paper's.  A rig with stiction and counting encoders ends in no
ball as small as theirs, and leaves its driven coordinates where no cost asks for them: what suits
a bench has words of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import isinf
from typing import Literal, get_args

import numpy as np
import sympy as sp

from undertow.base import checked, one_of
from undertow.models import FloatArray, Mechanism
from undertow.objective.objective import Constraint, MinimumEnergy, MinimumTime, Names, Objective

#: The words.
Goal = Literal["energy", "time", "bench-energy", "bench-time", "effort"]

#: What is meant where nobody says: quick, sparing, and it brings every coordinate home.
USUAL: Goal = "effort"

#: w of minimum energy on a bench: Theorem 1 holds and the driven coordinates come home.
STATE_WEIGHT = 0.05
#: Price of effort in minimum time on a bench, 0.01/V² at 15 V: keeps surfaces from asking what no
#: sampled, delayed loop can do.
ENERGY_PRICE = 2.25
#: Radius of the ball in which a motion ends on a bench: a rig with stiction and counting encoders
#: stays in no smaller one.
TERMINAL = 0.05
#: What xᵀx costs beside the effort, in ``effort``; it ends in the paper's ball.
ERROR_PRICE = 0.01


def finite_limits(mechanism: Mechanism) -> FloatArray:
    """Input limits, 1 where there is none, (m,)."""
    limits = mechanism.input_limits
    return np.where(np.isfinite(limits), limits, 1.0)


@dataclass(frozen=True)
class _Effort:
    """A price of time, one of the effort Σ (u_i/u_max,i)², and one of the error xᵀx."""

    limits: tuple[float, ...]
    time: int
    effort: float
    error: float

    def __call__(self, v: Names) -> sp.Expr:
        inputs = zip(v.inputs, self.limits, strict=True)
        effort = sum((u / limit) ** 2 for u, limit in inputs)
        weighed = effort if self.effort == 1 else self.effort * effort
        error = self.error * (v.states.T * v.states)[0] if self.error else 0
        return self.time + weighed + error


@checked
def objective_for(
    mechanism: Mechanism,
    word: str = USUAL,
    *,
    horizon: float = 60.0,
    constraints: Sequence[Constraint] = (),
    hard_input: bool = False,
) -> Objective:
    """Return the objective that a word means for a mechanism, its unit that of the inputs.

    Whoever takes a word takes it from here: the command line, surveys, trials, recipes of runs.
    The travel that the mechanism declares is among its constraints, see
    :meth:`undertow.Objective.on`.

    Parameters
    ----------
    mechanism
        Whose inputs and states are meant.
    word
        ``energy``: ∫ uᵀu dt, and ``time``: ∫ 1 dt, the paper's (40) and (41), until ‖x‖ ≤ 0.01.
        ``bench-energy``: ∫ (uᵀu + 0.05 xᵀx) dt, and ``bench-time``: ∫ (1 + 2.25 Σ (u/u_max)²) dt,
        until ‖x‖ ≤ 0.05.  ``effort``: ∫ (Σ (u/u_max)² + 0.01 xᵀx) dt, until ‖x‖ ≤ 0.01: the same
        for every mechanism, in whatever unit its inputs are.  Of an input without a limit u_max is
        1.  The weight of ``bench-energy`` suits the paper's bench and its 15 V: beside 400 N it is
        next to nothing, and a cart takes its time to come home.
    horizon
        Longest motion, s.
    constraints
        Path constraints, besides the travel.
    hard_input
        Whether a motion whose law asks for more than the actuator gives is refused.

    Raises
    ------
    InvalidInputError
        For an unknown word, or a horizon that is not positive.

    Examples
    --------
    >>> import undertow as ut
    >>> rig = ut.mechanisms.rotary_pendulum()
    >>> objective_for(rig, "bench-energy").meaning(rig)
    'bench-energy: ∫ (uᵀu + 0.05 xᵀx) dt, V² s, to ‖x‖ ≤ 0.05 within 60 s'
    """
    one_of("objective", word, get_args(Goal))
    limits = tuple(finite_limits(mechanism).tolist())
    free = [f"1 {i.unit}".rstrip() + f" of {i.name}" for i in mechanism.inputs if isinf(i.limit)]
    scaled = f" (u_max = {', '.join(free)}, without a limit)" if free else ""
    energy = MinimumEnergy()
    time = Objective(
        word,
        _Effort(limits, 1, ENERGY_PRICE, 0.0),
        "s",
        formula=f"∫ (1 + {ENERGY_PRICE:g} Σ (u/u_max)²) dt{scaled}",
    )
    effort = Objective(
        word,
        _Effort(limits, 0, 1.0, ERROR_PRICE),
        "s",
        formula=f"∫ (Σ (u/u_max)² + {ERROR_PRICE:g} xᵀx) dt{scaled}",
    )
    made: dict[str, Objective] = {
        "energy": energy,
        "time": MinimumTime(),
        "bench-energy": replace(energy, terminal_radius=TERMINAL, state_weight=STATE_WEIGHT),
        "bench-time": replace(time, terminal_radius=TERMINAL),
        "effort": effort,
    }
    return replace(
        made[word],
        name=word,
        horizon=horizon,
        constraints=tuple(constraints),
        hard_input=hard_input,
    ).on(mechanism)
