"""The slow loop: one request of the fast loop to one answer.

A request is a state and the plan in use; the answer is computed for the state *predicted*
for the time of use.  Everything here is a function of the request, so that a recorded
answer can be judged again without a clock.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeGuard

import numpy as np

from undertow.base import a_kind, error_text
from undertow.cascade import Admission, Cascade, CascadeState
from undertow.cascade.swing_up import SwingUpAndCatch
from undertow.law import Plan, ReferenceMotion, SlidingModeLaw, Surface, pack_law_parameters
from undertow.models import FloatArray
from undertow.optimiser import Proposal


@dataclass(frozen=True, slots=True, eq=False)
class Request:
    """What the fast loop asks: re-optimise ``memory.plan`` from x at t for use at ``use``, s.

    x is counted from ``memory.target``.  With ``target`` the target jumps there at the time of use:
    the plan is for a new task.  With ``swing`` ≥ 0 the mechanism is being swung up, with these
    gains: is there a surface that catches it, and where it is not within reach, which gains are to
    go on?
    """

    t: float
    x: FloatArray
    use: float
    memory: CascadeState
    swing: int = -1
    target: ReferenceMotion | None = None

    @property
    def sequence(self) -> int:
        """Number that the answer must carry."""
        return self.memory.sequence + 1


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """What the slow loop says.

    ``sequence``, ``use``, ``swing``: number, time of use, s, and swing of the request. ``x``: state
    predicted for the time of use, (2n,). ``proposal``, ``admission``: the optimiser's answer and
    the gate's decision. ``before``, ``memory``: the cascade's memory as it was asked, and from the
    time of use on. ``law_vectors``: numbers of the law for each surface of the plan, (S, 2mn + 2m +
    1). ``seconds``: from request to answer, s. ``jump``: whether the target jumps at the time of
    use: ``x`` is counted from the new one. ``gains``: in a swing-up, those to go on with from then
    on.
    """

    sequence: int
    use: float
    x: FloatArray
    proposal: Proposal
    admission: Admission
    before: CascadeState
    memory: CascadeState
    law_vectors: FloatArray
    seconds: float
    swing: int = -1
    jump: bool = False
    gains: int = -1


Compute = Callable[[Request], Answer]


class LeadTime:
    """How far ahead answers are asked for, ``seconds``: from a request to the use of its answer.

    It grows by half after an answer that came late, to ``most`` s at most, and shrinks by a tenth
    after one that came early, to ``least`` s, in whole ``step``, s.
    """

    def __init__(
        self, seconds: float, most: float, step: float, least: float | None = None
    ) -> None:
        self.seconds, self.most, self.step = seconds, most, step
        self.least = seconds if least is None else least

    def late(self) -> None:
        """Take note of an answer that came late, or never."""
        self._scale(1.5)

    def early(self) -> None:
        """Take note of an answer that came in less than half of the time."""
        self._scale(0.9)

    def _scale(self, factor: float) -> None:
        seconds = max(self.least, min(self.most, factor * self.seconds))
        self.seconds = math.ceil(seconds / self.step - 1e-9) * self.step


def is_answer(said: object) -> TypeGuard[Answer]:
    """Whether what a worker gave has all that a step reads of an answer, of the right types."""
    return (
        isinstance(said, Answer)
        and isinstance(said.sequence, int)
        and isinstance(said.use, float)
        and isinstance(said.admission, Admission)
        and isinstance(said.memory, CascadeState)
        and isinstance(said.memory.plan, Plan)
        and isinstance(said.memory.target, ReferenceMotion | None)
        and isinstance(said.jump, bool)
        and isinstance(said.gains, int)
        and all(
            isinstance(part, np.ndarray) and part.dtype == float
            for part in (said.x, said.law_vectors)
        )
    )


def law_vectors_of(cascade: Cascade, memory: CascadeState) -> FloatArray:
    """Return the numbers of the compiled law for each surface of its plan, (S, 2mn + 2m + 1).

    Raises UndertowError for for a plan that does not fit the mechanism, or is singular at the
    target.
    """
    plan, believed = memory.plan, cascade.believed(memory)
    pairs = zip(plan.surfaces, plan.laws(cascade.reaching), strict=True)
    return np.stack([pack_law_parameters(SlidingModeLaw(believed, s, law)) for s, law in pairs])


def respond(cascade: Cascade, request: Request, swing_up: SwingUpAndCatch | None = None) -> Answer:
    """Predict, re-optimise, judge; never raises.

    In a swing-up: predict, and look for a surface that catches, or for gains that lead to one.
    """
    began = time.perf_counter()
    if request.swing >= 0 and swing_up is not None:
        return _swing(cascade, request, swing_up, began)
    x = _predicted(cascade, request)
    memory = request.memory
    if request.target is not None:
        return _retarget(cascade, request, x, began)
    proposal: object = cascade.propose(memory, memory.absolute(request.use, x), request.use)
    if not isinstance(proposal, Proposal):
        proposal = _failed(request, f"not a proposal but {a_kind(proposal)}")
    judged = judge(cascade, memory, proposal, x, request.use)
    return _answer(request, x, proposal, *judged, began)


def _retarget(cascade: Cascade, request: Request, x: FloatArray, began: float) -> Answer:
    """Return an answer with the first plan for a new target; without one the old one stays."""
    memory, use = request.memory, request.use
    assert request.target is not None  # who asks for another target gives one
    try:
        place = memory.absolute(use, x)
        after, proposal = cascade.start_to(place, request.target, use, memory)
        after = cascade.prepared(after, place)
        admission = Admission(True, "first optimum for another target", after.predicted)
        answer = _answer(
            request, after.error(use, place), proposal, after, admission,
            law_vectors_of(cascade, after), began,
        )  # fmt: skip
        return replace(answer, jump=True)
    except Exception as error:
        proposal = _failed(request, error_text(error))
        return _answer(request, x, proposal, *judge(cascade, memory, proposal, x, use), began)


def _failed(request: Request, why: str) -> Proposal:
    number, use = request.sequence, request.use
    return Proposal(None, "failed", math.inf, math.inf, (), 0, 0.0, number, use, why)


def _answer(
    request: Request, x: FloatArray, proposal: Proposal, after: CascadeState, admission: Admission,
    law_vectors: FloatArray, began: float,
) -> Answer:  # fmt: skip
    seconds, asked = time.perf_counter() - began, request.memory
    return Answer(
        request.sequence, request.use, x, proposal, admission, asked, after, law_vectors, seconds,
        request.swing,
    )  # fmt: skip


def next_of_swing(
    cascade: Cascade, swing_up: SwingUpAndCatch, memory: CascadeState, home: FloatArray, used: int
) -> tuple[Surface | None, int]:
    """Return the surface that catches from a state, (2n,), if any, and the gains to go on with.

    Gains are looked for where the state is not within reach of a catch, for what has been learnt of
    the plant.  ``used`` are those in use; the state has whole turns taken off.
    """
    if swing_up.worth_asking(home):
        return swing_up.region.surface(home), used
    parameters = np.array(cascade.believed(memory).parameter_values)
    return None, swing_up.choice(home, used, parameters)


def _swing(cascade: Cascade, request: Request, swing_up: SwingUpAndCatch, began: float) -> Answer:
    """Return an answer whose plan is the surface that catches, if there is one."""
    memory, gains = request.memory, request.swing
    try:
        x = swing_up.ahead(request.x, request.use - request.t, gains)
        home = x - swing_up.region.turns(x)
        surface, gains = next_of_swing(cascade, swing_up, memory, home, gains)
    except Exception:
        home, surface = np.full_like(request.x, math.nan), None
    plan = memory.plan if surface is None else Plan.of(surface)
    proposal = Proposal(
        None if surface is None else plan,
        "infeasible" if surface is None else "converged",
        math.inf,
        math.inf,
        (),
        0,
        time.perf_counter() - began,
        request.sequence,
        request.use,
    )
    words = "not to be caught from here" if surface is None else "comes home from here"
    after = replace(
        memory, plan=plan, since=request.use, sequence=request.sequence, x=(), target=None
    )
    admission = Admission(surface is not None, words, math.inf)
    vectors = law_vectors_of(cascade, after)
    answer = _answer(request, home, proposal, after, admission, vectors, began)
    return replace(answer, gains=gains)


def judge(
    cascade: Cascade, memory: CascadeState, proposal: Proposal, x: FloatArray, use: float
) -> tuple[CascadeState, Admission, FloatArray]:
    """Pass a proposal through the cascade's gate; whatever goes wrong refuses it."""
    try:
        after, admission = cascade.apply_gate(memory, proposal, memory.absolute(use, x))
        return after, admission, law_vectors_of(cascade, after)
    except Exception as error:  # an optimiser's answer may be anything
        reason = f"gate: {error_text(error)}"
        admission = Admission(False, reason, memory.predicted)
        number = memory.sequence + 1
        after = replace(memory, plan=memory.at(use), since=use, sequence=number, x=())
        return after, admission, law_vectors_of(cascade, after)


def _predicted(cascade: Cascade, request: Request) -> FloatArray:
    if request.use == request.t:
        return request.x.copy()
    try:
        return cascade.predicted_error(request.memory, request.x, request.t, request.use)
    except Exception:  # then the optimiser fails on it too, and says so
        return np.full_like(request.x, math.nan)
