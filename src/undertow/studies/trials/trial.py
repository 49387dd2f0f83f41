"""One controller on one rig, and the same over many seeds."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from undertow.estimators import Belief, Estimator, Record, StateFeedback, compensated, run_recorded
from undertow.models import FloatArray, Mechanism
from undertow.objective import Objective
from undertow.plants import Bench, RealisticRig, Rig
from undertow.runtime import estimator_for

#: Belief and estimated start, (2n,), to a controller for one run.
MakeController = Callable[[FloatArray], StateFeedback]


@runtime_checkable
class TakesEstimator(Protocol):
    """A controller that goes by what an estimator knows besides the state."""

    def listen(self, estimator: Estimator) -> None:
        """Take the estimator of the run that begins."""


def introduce(controller: object, estimator: Estimator) -> None:
    """Let a controller that listens know its estimator."""
    if isinstance(controller, TakesEstimator):
        controller.listen(estimator)


#: Within these of the target a coordinate counts as home: free ones, driven ones (rad or m).
HOME_FREE, HOME_DRIVEN = math.radians(2.0), math.radians(20.0)

#: A run is balanced when everything is home for its last second, s.
LAST = 1.0


@dataclass(frozen=True)
class Result:
    """What came of one run, in numbers.

    ``balanced``: whether every coordinate was home for the last second; ``caught``: whether the
    free ones were, wherever the driven ones had got to. ``settled``: time after which every
    coordinate stayed home, s; infinite if one did not. ``cost``: of the objective, along the true
    motion with the inputs written; NaN without one. ``effort``: ∫ uᵀu dt. ``chatter``: total
    variation of the inputs per second, in their unit. Of an input counts what the plant's actuator
    can give.
    """

    seed: int
    balanced: bool
    caught: bool
    settled: float
    cost: float
    effort: float
    chatter: float


@dataclass(frozen=True, eq=False)
class Outcome(Result):
    """What came of one run, and the ``record`` of it.

    ``approaching``: whether it was caught and the driven coordinates, too, were home when it ended
    or nearer to it than a second before.
    """

    record: Record
    approaching: bool = False

    @property
    def numbers(self) -> Result:
        """The same without the record."""
        return Result(**{one.name: getattr(self, one.name) for one in fields(Result)})


def trial(
    belief: Mechanism,
    bench: Bench,
    make: MakeController,
    x0: ArrayLike,
    seconds: float,
    seed: int,
    *,
    objective: Objective | None = None,
    estimator: Estimator | None = None,
    told: Bench | None = None,
    home: ArrayLike | None = None,
    compensates: Callable[[], bool] = lambda: True,
) -> Outcome:
    """Run a controller on a rig, once.

    The bench is the truth, ``belief`` the controller's model. ``make`` is told where the sensors
    say that the mechanism is held, and returns the controller; the hand means to let go at ``x0``,
    (2n,); the run takes ``seconds``, s.

    The estimator is by default that of :func:`undertow.runtime.controller_defaults.estimator_for`
    the bench, or the one that it is ``told`` of instead, which learns the usual parameters; a
    :class:`TakesEstimator` is given it. What it knows of a matched disturbance is
    taken off the output in each step in which ``compensates`` says so. ``home`` is as for
    :func:`judge`.
    """
    if estimator is None:
        estimator = estimator_for(belief, told or bench, known=Belief.usual(belief))
    rig = RealisticRig(bench, x0, seed)
    record = run_trial(belief, rig, estimator, make, seconds, compensates)
    limits = bench.mechanism.input_limits
    record = replace(record, u=np.clip(record.u, -limits, limits))
    pushed = max((push.t for push in bench.pushes), default=-math.inf)
    return judge(belief, record, seed, objective, home, pushed)


def run_trial(
    belief: Mechanism,
    rig: Rig,
    estimator: Estimator,
    make: MakeController,
    seconds: float,
    compensates: Callable[[], bool] = lambda: True,
) -> Record:
    """Run a controller on any rig that stands at its start, see :func:`trial`."""
    seen = np.concatenate([rig.read().q, np.zeros(belief.n)])
    estimator.reset(seen)
    steering = make(seen)
    introduce(steering, estimator)
    controller = compensated(steering, estimator, belief.input_limits, compensates)
    return run_recorded(rig, estimator, controller, seconds)


def judge(
    mechanism: Mechanism,
    record: Record,
    seed: int = 0,
    objective: Objective | None = None,
    home: ArrayLike | None = None,
    pushed: float = -math.inf,
) -> Outcome:
    """Return what came of a recorded run; ``home``, (n,), is how near the target that is.

    The cost is until the terminal set is reached: after the last push, at the time ``pushed``, s.
    """
    driven = np.arange(mechanism.n) < mechanism.m
    near = np.where(driven, HOME_DRIVEN, HOME_FREE) if home is None else np.asarray(home)
    settled = _settled(record, near)
    last = record.t[-1] - LAST
    caught = bool(_settled(record, np.where(driven, math.inf, near)) <= last)
    before = np.abs(record.truth[np.searchsorted(record.t, last), : mechanism.n])
    now = np.abs(record.truth[-1, : mechanism.n])
    return Outcome(
        seed=seed,
        balanced=bool(settled <= last),
        caught=caught,
        approaching=caught and bool(((now <= near) | (now < before)).all()),
        settled=settled,
        cost=math.nan if objective is None else _cost(mechanism, objective, record, pushed),
        effort=record.effort,
        chatter=record.chatter / float(record.t[-1]),
        record=record,
    )


def balanced(outcomes: Sequence[Result]) -> int:
    """Count the runs that ended balanced."""
    return sum(outcome.balanced for outcome in outcomes)


def _settled(record: Record, home: FloatArray) -> float:
    """Return when the last of the coordinates came home for good, s."""
    away = np.logical_not((np.abs(record.truth[:, : len(home)]) <= home).all(axis=1))
    if away[-1]:
        return math.inf
    return float(record.t[np.flatnonzero(away)[-1] + 1]) if away.any() else 0.0


def _cost(mechanism: Mechanism, objective: Objective, record: Record, pushed: float) -> float:
    """Integrate the stage cost, from sample to sample, until the terminal set is reached."""
    radius = np.linalg.norm(record.truth, axis=1)
    inside = np.flatnonzero((radius <= objective.terminal_radius) & (record.t > pushed))
    end = int(inside[0]) if len(inside) else len(record.t)
    if end == 0:
        return 0.0
    function = objective.stage_function(mechanism)
    values = np.broadcast_to(function(*record.truth.T, *record.u.T)[0], record.t.shape)
    steps = np.diff(record.t, append=2 * record.t[-1] - record.t[-2])
    return float((values * steps)[:end].sum())


@dataclass(frozen=True)
class Spread:
    """Mean and standard deviation of a number over the balanced runs; 0 where there is one."""

    mean: float
    deviation: float

    def __str__(self) -> str:
        """Show as mean ± deviation: two digits of it, and no more than three of the mean."""
        if not math.isfinite(self.mean):
            return "—"
        digits = 2 - math.floor(math.log10(max(abs(self.mean), 1e-9)))
        if not self.deviation > 0:
            return f"{self.mean:.{max(0, digits)}f}"
        digits = max(0, min(digits, 1 - math.floor(math.log10(self.deviation))))
        return f"{self.mean:.{digits}f} ± {self.deviation:.{digits}f}"


def spread(outcomes: Sequence[Result], what: str) -> Spread:
    """Return mean and standard deviation of an attribute over the balanced runs."""
    values = [float(getattr(o, what)) for o in outcomes if o.balanced]
    if not values:
        return Spread(math.nan, math.nan)
    return Spread(float(np.mean(values)), float(np.std(values, ddof=1)) if len(values) > 1 else 0.0)
