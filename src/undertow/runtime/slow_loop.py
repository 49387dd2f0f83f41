"""The slow loop: one request of the fast loop to one answer, and who computes it where.

A request is a state and the plan in use; the answer is computed for the state *predicted*
for the time of use.  Everything here is a function of the request, so that a recorded
answer can be judged again without a clock.
"""

from __future__ import annotations

import contextlib
import ctypes
import io
import math
import os
import pickle
import signal
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from queue import SimpleQueue
from typing import Any, Generic, Protocol, TypeGuard, TypeVar

import numpy as np

from undertow.base import ResourceError
from undertow.cascade import Admission, Cascade, CascadeState
from undertow.cascade.swing_up import SwingUpAndCatch
from undertow.closed_loop import Event
from undertow.closed_loop.along_reference import simulate_along
from undertow.law import Plan, ReferenceMotion, SlidingModeLaw, pack_law_parameters
from undertow.models import FloatArray
from undertow.optimiser import Proposal
from undertow.runtime.processes import START_TIMEOUT, STOPPING, Background, fork, pipe

#: The first that a process says which is to compute.
BEGUN = "begun"


class Packer:
    """Writes what goes between two processes; motions that both of them have go by number.

    ``shared`` is what the other process has, too, for it was forked from this one.
    """

    def __init__(self, shared: Sequence[object] = ()) -> None:
        self.shared = tuple(shared)
        self._numbers = {id(one): number for number, one in enumerate(self.shared)}

    def pack(self, what: object) -> bytes:
        """Return bytes from which :meth:`unpack` makes it again."""
        if not self.shared:
            return pickle.dumps(what, pickle.HIGHEST_PROTOCOL)
        numbers, buffer = self._numbers, io.BytesIO()

        class Pickler(pickle.Pickler):
            def persistent_id(self, one: object) -> int | None:
                return numbers.get(id(one))

        Pickler(buffer, pickle.HIGHEST_PROTOCOL).dump(what)
        return buffer.getvalue()

    def unpack(self, content: bytes) -> Any:
        """Return what was written."""
        shared = self.shared

        class Unpickler(pickle.Unpickler):
            def persistent_load(self, number: int) -> object:
                return shared[number]

        return Unpickler(io.BytesIO(content)).load()


#: What asks the fast loop for a stop, which decides when its processes end, by SIGTERM.
OTHERS = tuple(number for number in STOPPING if number != signal.SIGTERM)


@dataclass(frozen=True, slots=True, eq=False)
class Request:
    """What the fast loop asks: re-optimise ``memory.plan`` from x at t for use at ``use``, s.

    x is counted from ``memory.target``.  With ``target`` the target jumps there at the time of use:
    the plan is for a new task.  With ``swing`` ≥ 0 the mechanism is being swung up, with these
    gains: is there a surface that catches it?
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
    use: ``x`` is counted from the new one.
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


Compute = Callable[[Request], Answer]

#: What a background worker is asked, and what it answers: for a slow loop these two.
Asked = TypeVar("Asked")
Said = TypeVar("Said")


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
        and all(
            isinstance(part, np.ndarray) and part.dtype == float
            for part in (said.x, said.law_vectors)
        )
    )


def law_vectors_of(cascade: Cascade, memory: CascadeState) -> FloatArray:
    """Return the numbers of the compiled law for each surface of its plan, (S, 2mn + 2m + 1).

    Raises
    ------
    UndertowError
        For a plan that does not fit the mechanism, or is singular at the target.
    """
    plan, believed = memory.plan, cascade.believed(memory)
    pairs = zip(plan.surfaces, plan.laws(cascade.reaching), strict=True)
    return np.stack([pack_law_parameters(SlidingModeLaw(believed, s, law)) for s, law in pairs])


def respond(cascade: Cascade, request: Request, swing_up: SwingUpAndCatch | None = None) -> Answer:
    """Predict, re-optimise, judge; never raises.

    In a swing-up: predict, and look for a surface that catches.
    """
    began = time.perf_counter()
    if request.swing >= 0 and swing_up is not None:
        return _catch(cascade, request, swing_up, began)
    x = _predicted(cascade, request)
    memory = request.memory
    if request.target is not None:
        return _retarget(cascade, request, x, began)
    proposal: object = cascade.propose(memory, memory.absolute(request.use, x), request.use)
    if not isinstance(proposal, Proposal):
        proposal = _failed(request, f"not a proposal but a {type(proposal).__name__}")
    judged = judge(cascade, memory, proposal, x, request.use)
    return _answer(request, x, proposal, *judged, began)


def _retarget(cascade: Cascade, request: Request, x: FloatArray, began: float) -> Answer:
    """Return an answer with the first plan for a new target; without one the old one stays."""
    memory, use = request.memory, request.use
    assert request.target is not None  # who asks for another target gives one
    try:
        place = memory.absolute(use, x)
        after, proposal = cascade.start_to(place, request.target, use, memory)
        admission = Admission(True, "first optimum for another target", after.predicted)
        answer = _answer(
            request, after.error(use, place), proposal, after, admission,
            law_vectors_of(cascade, after), began,
        )  # fmt: skip
        return replace(answer, jump=True)
    except Exception as error:
        proposal = _failed(request, f"{type(error).__name__}: {error}")
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


def _catch(cascade: Cascade, request: Request, swing_up: SwingUpAndCatch, began: float) -> Answer:
    """Return an answer whose plan is the surface that catches, if there is one."""
    try:
        x = swing_up.ahead(request.x, request.use - request.t, request.swing)
        home = x - swing_up.region.turns(x)
        surface = swing_up.region.surface(home)
    except Exception:
        home, surface = np.full_like(request.x, math.nan), None
    memory = request.memory
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
    return _answer(request, home, proposal, after, admission, vectors, began)


def judge(
    cascade: Cascade, memory: CascadeState, proposal: Proposal, x: FloatArray, use: float
) -> tuple[CascadeState, Admission, FloatArray]:
    """Pass a proposal through the cascade's gate; whatever goes wrong refuses it."""
    try:
        after, admission = cascade.apply_gate(memory, proposal, memory.absolute(use, x))
        return after, admission, law_vectors_of(cascade, after)
    except Exception as error:  # an optimiser's answer may be anything
        reason = f"gate: {type(error).__name__}: {error}"
        admission = Admission(False, reason, memory.predicted)
        number = memory.sequence + 1
        after = replace(memory, plan=memory.at(use), since=use, sequence=number, x=())
        return after, admission, law_vectors_of(cascade, after)


def _predicted(cascade: Cascade, request: Request) -> FloatArray:
    memory, plan, span = request.memory, request.memory.at(request.t), request.use - request.t
    target = memory.target
    if span == 0.0:
        return request.x.copy()
    try:
        if target is not None and target.moves:
            still = cascade.loop_at(replace(memory, target=None))
            x = memory.absolute(request.t, request.x)
            motion = simulate_along(still, x, plan, target, duration=span, start=request.t)
            if motion.event not in (Event.HORIZON, Event.REACHED):  # it broke off before
                return np.full_like(request.x, math.nan)
            return memory.error(request.use, motion.x[-1])
        loop = cascade.loop_at(request.memory, request.t)
        batch = loop.batch(request.x, plan, duration=span, terminal=0.0)
        return np.asarray(batch.x[0])
    except Exception:  # then the optimiser fails on it too, and says so
        return np.full_like(request.x, math.nan)


class Worker(Protocol):
    """Who computes answers: the fast loop asks, and takes what is there, never waiting."""

    def ask(self, request: Request) -> None:
        """Hand over a request."""
        ...

    def take(self, t: float) -> Answer | None:
        """Return the next answer that has arrived by the time t, s, if there is one."""
        ...

    def replace(self) -> bool:
        """Give up on the present computation; whether there is someone to take over."""
        ...

    def close(self) -> None:
        """Stop computing."""
        ...


class InlineWorker:
    """Computes at once, and answers after a latency of simulated time.

    ``latency`` is the simulated time from request to answer, s.
    """

    def __init__(self, compute: Compute, latency: float = 0.05) -> None:
        self.compute, self.latency = compute, latency
        self.waiting: deque[tuple[float, Answer]] = deque()

    def ask(self, request: Request) -> None:
        """Compute the answer."""
        self.waiting.append((request.t + self.latency, self.compute(request)))

    def take(self, t: float) -> Answer | None:
        """Return the answer once its latency has passed."""
        if self.waiting and self.waiting[0][0] <= t + 1e-9:
            return self.waiting.popleft()[1]
        return None

    def replace(self) -> bool:
        """Forget what was asked."""
        self.waiting.clear()
        return True

    def close(self) -> None:
        """Nothing to stop."""


class BackgroundWorker(Generic[Asked, Said]):
    """Computes in other threads, which may in turn wait for other processes.

    Every computer has its thread from the beginning: a run that needs the next one asks the
    system for nothing.
    """

    def __init__(self, computers: list[_Computer[Asked, Said]]) -> None:
        self.computers = computers
        try:
            for computer in computers:
                computer.begin()
        except ResourceError:
            self.close()
            raise

    @property
    def processes(self) -> list[int]:
        """Process ids of the computers, the one that computes first."""
        return [c.process.pid or 0 for c in self.computers if isinstance(c, _Child)]

    def ask(self, request: Asked) -> None:
        """Hand the request over; costs some microseconds."""
        self.computers[0].requests.put(request)

    def take(self, t: float) -> Said | None:
        """Return an answer that has arrived."""
        answers = self.computers[0].answers
        return answers.popleft() if answers else None

    def replace(self) -> bool:
        """End the present computation and let the next computer take over."""
        if len(self.computers) < 2:
            return False
        self.computers.pop(0).close()
        return True

    def close(self) -> None:
        """End all computers."""
        for computer in self.computers:
            computer.close()


class _Computer(Generic[Asked, Said]):
    """A computation, and a thread that carries requests there and answers back."""

    def __init__(self, compute: Callable[[Asked], Said]) -> None:
        self.compute = compute
        self.requests: SimpleQueue[Asked | None] = SimpleQueue()
        self.answers: deque[Said] = deque()

    def begin(self) -> None:
        """Start the thread; processes are forked before."""
        Background(self._carry, "undertow slow loop")

    def _carry(self) -> None:
        with contextlib.suppress(EOFError, OSError):  # gone, or ended while it is asked
            while (request := self.requests.get()) is not None:
                self.answers.append(self.compute(request))

    def close(self) -> None:
        """Ask for no more; a thread cannot be ended from outside: it is left behind."""
        self.requests.put(None)


class _Child(_Computer[Asked, Said]):
    """A forked process: it has everything compiled already, and can be ended at any time."""

    def __init__(self, compute: Callable[[Asked], Said], packer: Packer) -> None:
        self.pipe, theirs = pipe()
        self._packer = packer
        try:
            self.process = fork(
                _serve, (compute, theirs, self.pipe, packer), "undertow slow loop", ignores=OTHERS
            )
        except BaseException:
            self.pipe.close()  # which ends it
            raise
        finally:
            theirs.close()
        super().__init__(self._exchange)
        if not self._begun():
            self.process.kill()
            self.pipe.close()
            self.process.join(START_TIMEOUT)
            raise ResourceError(
                "process 'undertow slow loop'",
                value=f"it ended with exit code {self.process.exitcode}",
                limit=f"one that answers within {START_TIMEOUT:g} s",
                remedy="The system ends processes for lack of memory: end other programs",
            )

    def _begun(self) -> bool:
        with contextlib.suppress(EOFError, OSError):
            return self.pipe.poll(START_TIMEOUT) and self.pipe.recv() == BEGUN
        return False

    def _carry(self) -> None:
        with self.pipe:  # closed by the thread that reads it: a descriptor read by one and closed
            super()._carry()  # by another may by then belong to another file

    def _exchange(self, request: Asked) -> Said:
        self.pipe.send_bytes(self._packer.pack(request))
        answer: Said = self._packer.unpack(self.pipe.recv_bytes())
        return answer

    def close(self) -> None:
        """Kill the process, and do not wait for it."""
        self.process.kill()  # which ends what the thread reads
        super().close()


def _serve(
    compute: Callable[[Any], Any], ours: Connection, theirs: Connection, packer: Packer
) -> None:
    """Answer requests until the other end is gone."""
    theirs.close()
    with contextlib.suppress(OSError, AttributeError):  # Linux: do not outlive the fast loop
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)
    with contextlib.suppress(EOFError, OSError):
        ours.send(BEGUN)
        while True:
            ours.send_bytes(packer.pack(compute(packer.unpack(ours.recv_bytes()))))


def background_worker(
    compute: Callable[[Asked], Said], *, processes: int = 3, shared: Sequence[object] = ()
) -> BackgroundWorker[Asked, Said]:
    """Return a worker on another core: one process computes, the others stand by.

    ``compute`` has been called once before, so that everything is compiled. ``processes`` are
    forked now, while the fast loop does not run yet: one to compute, the rest to take over from one
    that hangs or dies; 0: a thread of this process. ``shared`` is what requests and answers hold
    that both sides have: a long reference.

    Raises
    ------
    ResourceError
        When the system has no process or thread more.
    """
    forked = processes >= 1 and hasattr(os, "fork")
    computers: list[_Computer[Asked, Said]] = []
    try:
        for _ in range(max(1, processes)):
            computers.append(_Child(compute, Packer(shared)) if forked else _Computer(compute))
    except BaseException:
        for computer in computers:
            computer.close()
        raise
    return BackgroundWorker(computers)
