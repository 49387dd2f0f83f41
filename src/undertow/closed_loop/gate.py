"""The gate: what a proposed plan must show before the inner loop may slide on it.

A gate is any function of the predicted closed loop, the plan in use, the proposed one, the state
and the time that is left, that returns an :class:`Admission`.  :func:`cost_gate` is the plainest;
:mod:`undertow.cascade.robustness` and :mod:`undertow.proofs.gate` ask for more.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from undertow.base import Verdict
from undertow.closed_loop.rollout import ClosedLoop
from undertow.closed_loop.trajectory import INADMISSIBLE, Batch, Event, broken_words
from undertow.law import Plan, stability_margin
from undertow.models import FloatArray, Mechanism
from undertow.objective import Objective

#: What :func:`cost_gate` asks for, and says of a plan that it admits.
_ADMITTED = "stable, feasible, cost not raised"


@dataclass(frozen=True)
class Admission:
    """The gate's decision on a proposal: accepted or not, and why.

    ``cost`` is the predicted cost of the plan that stays in use, new or old; ``verdict`` what is
    known of that plan at the present state, where the gate gives one.
    """

    accepted: bool
    reason: str
    cost: float
    verdict: Verdict | None = None


Gate = Callable[[ClosedLoop, Plan, Plan, FloatArray, float], Admission]


def broken_by(loop: ClosedLoop, batch: Batch, k: int) -> str:
    """Return the names of the constraints that ended motion k of a batch; none did: nothing."""
    if batch.event[k] != Event.CONSTRAINT:
        return ""
    return broken_words((c.name for c in loop.objective.constraints), batch.path[k])


def cost_gate(loop: ClosedLoop, old: Plan, new: Plan, x: FloatArray, horizon: float) -> Admission:
    """Admit a plan that is stable, feasible from x, and does not raise the cost.

    Both plans are rolled out afresh from the present state: nothing that the optimiser
    says of them is believed.  This is the step of Lemma 3, J̃_{k+1} ≤ Ĵ_{k+1}.  On an ensemble,
    where neither suits every plausible plant, the one that all survive longer stays in use.

    ``old`` is the plan in use, shifted to now, ``new`` the proposed one; x is the present state,
    (2n,), ``horizon`` the longest prediction, s.
    """
    pair = loop.batch(x, [old, new], duration=horizon, precise=True)
    old_score, new_cost = pair.score(horizon)
    old_cost = float(old_score) if old_score < INADMISSIBLE else math.inf
    stability = float(stability_margin(loop.mechanism, new.surfaces[-1]))
    if not stability > 0:
        return Admission(False, f"unstable: margin {stability:.3g} 1/s", old_cost)
    if new_cost >= INADMISSIBLE:
        event = Event(int(pair.event[1])).name.lower()
        broken = " ".join(filter(None, (event, broken_by(loop, pair, 1))))
        broken += f" at {pair.time[1]:.3g} s"
        if loop.ensemble is not None and new_cost < old_score:  # of two that fail, the later
            return Admission(
                True, f"suits not every plausible plant, but longer: {broken}", old_cost
            )
        return Admission(False, f"not feasible from here: {broken}", old_cost)
    if new_cost > old_cost:
        return Admission(
            False, f"raises the predicted cost: {new_cost:.6g} > {old_cost:.6g}", old_cost
        )
    if math.isinf(old_cost):
        whom = "" if loop.ensemble is None else " for every plausible plant"
        reason = f"stable and feasible{whom}, as the plan in use no longer is"
        return Admission(True, reason, float(new_cost))
    return Admission(True, _ADMITTED, float(new_cost))


def gate_words(gate: Gate) -> str:
    """Return what a gate asks for, in words: its own ``words``, or else its name.

    >>> gate_words(cost_gate)
    'stable, feasible, cost not raised'
    """
    if gate is cost_gate:
        return _ADMITTED
    return getattr(gate, "words", "") or getattr(gate, "__name__", type(gate).__name__)


def problem_words(mechanism: Mechanism, objective: Objective, gate: Gate | None = None) -> str:
    """Return in one line what a word for an objective meant, and who admits what is found.

    >>> import undertow as ut
    >>> print(problem_words(ut.mechanisms.pendubot(), ut.MinimumTime(), cost_gate))
    objective time: ∫ 1 dt, s, to ‖x‖ ≤ 0.01 within 60 s; gate: stable, feasible, cost not raised
    """
    asked = "" if gate is None else f"; gate: {gate_words(gate)}"
    return f"objective {objective.meaning(mechanism)}{asked}"
