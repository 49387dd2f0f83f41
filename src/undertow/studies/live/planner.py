"""Who plans for the live page: the slow loop of a cascade whose task may change at any time.

It runs in a process of its own, see :func:`undertow.runtime.background_worker`, and makes its
cascades there, so that what a new objective has to compile holds nobody up.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from undertow.cascade import Cascade
from undertow.models import FloatArray, Mechanism
from undertow.objective import objective_for
from undertow.optimiser import Budget
from undertow.runtime import Answer, Request, default_gate, respond

#: Longest prediction, s, and the longest that a re-optimisation may take, s.
HORIZON, BUDGET = 20.0, 0.1

#: Rollouts of a re-optimisation at most.
EVALUATIONS = 1024


@dataclass(frozen=True)
class Task:
    """What the controller is to be best at.

    ``objective`` is a word of :func:`undertow.objective_for`; ``limits`` are those of the inputs,
    (m,); ``period`` is Δt between re-optimisations, s.
    """

    objective: str
    limits: tuple[float, ...]
    period: float


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Job(Request):
    """A request, what for, and what was seen of the plant since the one before: t, x and u."""

    task: Task
    seen: tuple[FloatArray, FloatArray, FloatArray] | None = None


def planner(mechanism: Mechanism, seed: int = 0) -> Callable[[Request], Answer]:
    """Return what answers jobs about a mechanism; the cascades of the latest tasks are kept."""

    @lru_cache(maxsize=4)
    def cascade(task: Task) -> Cascade:
        return cascade_for(mechanism, task, seed)

    def answer(request: Request) -> Answer:
        assert isinstance(request, Job)  # the page asks for nothing else
        controller, memory = cascade(request.task), request.memory
        if request.seen is not None and len(request.seen[0]) > 1:
            try:
                memory = controller.learn(memory, *request.seen, held=True)
            except (ArithmeticError, ValueError, np.linalg.LinAlgError):
                memory = request.memory  # motions of a plant that fell may be anything
        return respond(controller, replace(request, memory=memory))

    return answer


def cascade_for(mechanism: Mechanism, task: Task, seed: int = 0) -> Cascade:
    """Return the cascade of a task.

    Raises
    ------
    InvalidInputError
        For an unknown objective, or a period that is no multiple of the step.
    """
    limited = mechanism.with_input_limit(*task.limits)
    return Cascade(
        limited,
        objective_for(limited, task.objective, horizon=HORIZON),
        period=task.period,
        gate=default_gate(),
        warm=Budget(EVALUATIONS, BUDGET),
        seed=seed,
    )
