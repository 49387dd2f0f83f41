"""The list of the drill: what can go wrong, and whether the mechanism can still be held.

Each fault is a small function at one of the seams of the runtime (optimiser, its answers, sensors,
actuators); the wrappers put it there.  They serve the drill, and the tests of a user's own rig.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from undertow.cascade import Admission, Cascade
from undertow.law import Plan, Surface
from undertow.models import FloatArray
from undertow.optimiser import Planner, Proposal
from undertow.plants import Measurement, Rig, RigWrapper
from undertow.runtime import Answer, Ending, InlineWorker, SimulatedClock
from undertow.runtime.slow_loop import Compute

#: (time since the fault began, s; measurement) to what the controller gets to see.
Sense = Callable[[float, Measurement], Measurement]

#: (time since the fault began, s; written input, (m,)) to what reaches the plant.
Drive = Callable[[float, FloatArray], FloatArray]

#: An answer to what arrives in its place: (further delay, s; answer) each.
Change = Callable[[Answer], list[tuple[float, Answer]]]

#: (honest proposal) to what the optimiser says instead; may raise.
Corrupt = Callable[[Proposal], Any]


class _FaultyPlanner:
    """An optimiser that goes wrong from some time on."""

    def __init__(self, honest: Planner, corrupt: Corrupt, since: float) -> None:
        self._honest, self._corrupt, self._since = honest, corrupt, since

    def propose(self, x: FloatArray, /, **rest: Any) -> Any:
        proposal = self._honest.propose(x, **rest)
        spoilt = rest["incumbent"] is not None and rest["computed_for"] >= self._since
        return self._corrupt(proposal) if spoilt else proposal


def corrupt_optimiser(cascade: Cascade, corrupt: Corrupt, since: float) -> Cascade:
    """Return a cascade whose optimiser goes wrong from ``since``, s; its gate is as it was."""
    planner = cascade.planner or cascade.optimiser
    return replace(cascade, planner=_FaultyPlanner(planner, corrupt, since))


class FaultyWorker(InlineWorker):
    """A slow loop whose answers are changed, held back or repeated on their way.

    ``change`` says what arrives in the place of an answer from ``since``, s, on; ``act`` is called
    from then on before each look for an answer.
    """

    def __init__(self, compute: Compute, change: Change, since: float) -> None:
        super().__init__(compute)
        self.change, self.since = change, since
        self.act: Callable[[], None] = lambda: None
        self._arriving: list[tuple[float, Answer]] = []

    def take(self, t: float) -> Answer | None:
        """Return what arrives."""
        if t >= self.since:
            self.act()
        answer = super().take(t)
        if answer is not None:
            what = self.change(answer) if t >= self.since else [(0.0, answer)]
            self._arriving += ((t + delay, item) for delay, item in what)
            self._arriving.sort(key=lambda pair: pair[0])
        if self._arriving and self._arriving[0][0] <= t + 1e-9:
            return self._arriving.pop(0)[1]
        return None


class FaultyRig(RigWrapper):
    """A simulated rig with faults between it and the controller.

    From ``since``, s, on: ``sense`` and ``drive`` change measurements and inputs, and may raise;
    one call of ``write`` takes ``hang``, s, and each ``read`` ``slow``, s, while the world goes on,
    which ``clock`` shows.
    """

    def __init__(
        self,
        rig: Rig,
        since: float,
        *,
        sense: Sense | None = None,
        drive: Drive | None = None,
        hang: float = 0.0,
        clock: SimulatedClock | None = None,
        slow: float = 0.0,
    ) -> None:
        super().__init__(rig)
        self.since = since
        self.slow, self._behind, self._last = slow, 0.0, np.zeros(0)
        self.sense, self.drive, self.hang, self.clock = sense, drive, hang, clock
        self._steps = 0

    @property
    def _elapsed(self) -> float:
        """Time since the fault began, s; negative before."""
        return self._steps * self.period - self.since + 1e-9

    def read(self) -> Measurement:
        """Return what the sensors seem to say."""
        if self.slow and self.clock is not None and self._elapsed >= 0:
            self.clock.t += self.slow
            self._behind += max(0.0, self.slow - self.period)
            while self._behind >= self.period:
                self.rig.write(self._last)
                self._behind -= self.period
        measurement = self.rig.read()
        if self.sense is not None and self._elapsed >= 0:
            return self.sense(self._elapsed, measurement)
        return measurement

    def write(self, u: FloatArray) -> None:
        """Apply what reaches the plant."""
        elapsed = self._elapsed
        self._steps += 1
        applied = u.copy()
        if self.drive is not None and elapsed >= 0:
            applied = self.drive(elapsed, applied)
        self.rig.write(applied)
        self._last = applied
        if self.hang and self.clock is not None and elapsed >= 0:
            periods = round(self.hang / self.period)
            for _ in range(periods):
                self.rig.write(applied)
            self.clock.t += periods * self.period
            self.hang = 0.0


class OutputMonitor(RigWrapper):
    """Stands nearest to the controller and looks at every output that it writes.

    ``limits`` and ``slew``: largest |u| and largest change from one write to the next, (m,).
    ``faults``: what was wrong with an output, in words, empty when all were sound; ``largest``:
    largest |u|/limit written; ``last``: last output written, (m,).
    """

    def __init__(self, rig: Rig, limits: FloatArray, slew: FloatArray) -> None:
        super().__init__(rig)
        self.limits, self.slew = limits, slew
        self.faults: list[str] = []
        self.largest = 0.0
        self.last = np.zeros_like(limits)

    def write(self, u: FloatArray) -> None:
        """Judge the output, and pass it on."""
        if len(self.faults) < 10:
            if not np.isfinite(u).all():
                self.faults.append(f"not finite: {u.tolist()}")
            elif (np.abs(u) > self.limits).any():
                self.faults.append(f"past its limits: {u.tolist()}")
            elif (np.abs(u - self.last) > self.slew * (1.0 + 1e-9)).any():
                self.faults.append(f"faster than its slew: {self.last.tolist()} to {u.tolist()}")
        self.largest = max(self.largest, float(np.max(np.abs(u) / self.limits)))
        self.last = u.copy()
        self.rig.write(u)


@dataclass(frozen=True)
class Case:
    """One fault of the drill.

    ``part``: what fails. ``name``: how. ``holds``: whether the mechanism can still be held;
    otherwise the run must stop safely. ``optimiser``, ``answers``, ``sensor``, ``actuator``,
    ``hang``, ``estimator``: what happens, at which seam. ``silent``: the optimiser answers no more.
    ``push``: impulse on the last coordinate, N m s or N s. ``slow``: how long each read takes from
    then on, s. ``operator``, ``disk_full``: the operator stops the run; the disk takes no more of
    the log. ``since``: when the fault begins, s, if not with the others. ``ends``: how the run may
    end; by default balanced or caught where it holds, else stopped or lost. ``off``: whether the
    device can take an output of zero at the end.
    """

    part: str
    name: str
    holds: bool
    optimiser: Corrupt | None = None
    answers: Callable[[], Change] | None = None
    sensor: Callable[[], Sense] | None = None
    actuator: Callable[[], Drive] | None = None
    estimator: Callable[[FloatArray], FloatArray] | None = None
    hang: float = 0.0
    silent: bool = False
    push: float = 0.0
    operator: bool = False
    disk_full: bool = False
    slow: float = 0.0
    since: float | None = None
    ends: tuple[Ending, ...] = ()
    off: bool = True

    @property
    def endings(self) -> tuple[Ending, ...]:
        """How the run may end."""
        return self.ends or (("balanced", "caught") if self.holds else ("stopped", "lost"))


# -- optimisers ------------------------------------------------------------------------------


def _raises(kind: type[Exception], *words: str) -> Callable[[object], Any]:
    def broken(_: object) -> Any:
        raise kind(*words)

    return broken


def _with_surface(change: Callable[[Surface], Surface]) -> Corrupt:
    """Claim that a changed surface costs nothing."""

    def corrupt(proposal: Proposal) -> Proposal:
        if proposal.plan is None:
            return proposal
        return replace(proposal, plan=Plan.of(change(proposal.plan.surfaces[0])), cost=0.0)

    return corrupt


def _not_a_number(surface: Surface) -> Surface:
    block = surface.lambda_u.copy()
    corrupted = Surface(surface.alpha_a, surface.lambda_a, surface.alpha_u, surface.lambda_u)
    object.__setattr__(corrupted, "lambda_u", block * math.nan)  # as a bit flip would
    return corrupted


def _scaled(alpha_a: float = 1, lambda_a: float = 1, alpha_u: float = 1) -> Corrupt:
    return _with_surface(
        lambda s: Surface(
            alpha_a * s.alpha_a, lambda_a * s.lambda_a, alpha_u * s.alpha_u, s.lambda_u
        )
    )


def _wrong_shape(surface: Surface) -> Surface:
    m, free = surface.m + 1, surface.n - surface.m
    return Surface(-np.eye(m), -np.eye(m), np.ones((m, free)), np.ones((m, free)))


def _nothing(proposal: Proposal) -> Proposal:
    return replace(proposal, plan=None, status="infeasible", cost=math.inf, message="none found")


def _text(_: object) -> Any:
    return "a surface, surely"


# -- answers on their way ----------------------------------------------------------------------


def _arrives(*delays: float, change: Callable[[Answer], Any] = lambda a: a) -> Any:
    """Each answer arrives, changed, after each of the delays, s."""
    return lambda: lambda answer: [(delay, change(answer)) for delay in delays]


def _old_first() -> Change:
    """Before each answer the one before it arrives again."""
    kept: list[Answer] = []

    def change(answer: Answer) -> list[tuple[float, Answer]]:
        kept.append(answer)
        return [(0.001 * i, a) for i, a in enumerate(kept[-2:])]

    return change


def _forged(answer: Answer) -> Answer:
    """Flip λ in plan and numbers alike, and have it admitted."""
    s = answer.memory.plan.surfaces[0]
    flipped = Surface(s.alpha_a, -s.lambda_a, s.alpha_u, -s.lambda_u)
    vectors = answer.law_vectors.copy()
    vectors[:, : flipped.vector.size] = flipped.vector
    memory = replace(answer.memory, plan=Plan.of(flipped), since=answer.use)
    return replace(
        answer, admission=Admission(True, "forged", 0.0), memory=memory, law_vectors=vectors
    )


def _other_numbers(answer: Answer) -> Answer:
    """Flip the sign of all numbers of the surface, and not of the plan; have it admitted."""
    vectors = answer.law_vectors.copy()
    vectors[:, :4] *= -1.0
    memory = replace(answer.memory, since=answer.use)
    admission = Admission(True, "forged", 0.0)
    return replace(answer, admission=admission, memory=memory, law_vectors=vectors)


# -- sensors -------------------------------------------------------------------------------------


def _sensor(
    change: Callable[[float, FloatArray], FloatArray], until: float = math.inf
) -> Callable[[], Sense]:
    """Change the positions of each measurement, for a while."""

    def make() -> Sense:
        def sense(t: float, m: Measurement) -> Measurement:
            return replace(m, q=change(t, m.q.copy())) if t <= until else m

        return sense

    return make


def _lost(channel: int | None = None) -> Callable[[float, FloatArray], FloatArray]:
    def change(_: float, q: FloatArray) -> FloatArray:
        q[slice(None) if channel is None else channel] = math.nan
        return q

    return change


def _frozen(channel: int | None = None) -> Callable[[], Sense]:
    def make() -> Sense:
        kept: list[FloatArray] = []

        def sense(_: float, m: Measurement) -> Measurement:
            kept.append(m.q.copy())
            q = m.q.copy()
            where = slice(None) if channel is None else channel
            q[where] = kept[0][where]
            return replace(m, q=q)

        return sense

    return make


def _every(k: int, value: float) -> Callable[[], Sense]:
    """Add a value to one reading in k: NaN and infinity replace it."""
    return _sensor(lambda t, q: q + value if round(1000 * t) % k == 0 else q)


def _last(change: Callable[[float, float], float]) -> Callable[[], Sense]:
    """Change the position of the last coordinate for good."""
    return _sensor(lambda t, q: np.append(q[:-1], change(t, q[-1])))


def _clock(shift: Callable[[float], float], until: float = math.inf) -> Callable[[], Sense]:
    return lambda: lambda t, m: replace(m, t=m.t + shift(t)) if t <= until else m


def _one_too_many(until: float = math.inf) -> Callable[[], Sense]:
    return lambda: lambda t, m: replace(m, q=np.append(m.q, 0.0)) if t <= until else m


def _fails(until: float = math.inf, every: int = 1) -> Callable[[], Callable[[float, Any], Any]]:
    """Let a call of the rig fail for a while, each or one in so many."""

    def seam(t: float, what: Any) -> Any:
        if t <= until and round(1000 * t) % every == every - 1:
            raise OSError("no answer from the card")
        return what

    return lambda: seam


# -- actuators -------------------------------------------------------------------------------------


def _sticks() -> Drive:
    kept: list[FloatArray] = []

    def drive(_: float, u: FloatArray) -> FloatArray:
        kept.append(u.copy())
        return kept[0]

    return drive


#: What can go wrong.
CASES: tuple[Case, ...] = (
    Case("nothing", "all is well", True),
    Case("optimiser", "raises", True, optimiser=_raises(RuntimeError, "it broke")),
    Case("optimiser", "hangs for good", True, silent=True),
    Case("optimiser", "finds nothing", True, optimiser=_nothing),
    Case("optimiser", "gives NaN", True, optimiser=_with_surface(_not_a_number)),
    Case("optimiser", "gives an unstable surface", True, optimiser=_scaled(lambda_a=-1)),
    Case("optimiser", "gives a singular surface", True, optimiser=_scaled(alpha_u=1e-3)),
    Case("optimiser", "gives huge parameters", True, optimiser=_scaled(lambda_a=1e9)),
    Case("optimiser", "gives the wrong shape", True, optimiser=_with_surface(_wrong_shape)),
    Case("optimiser", "gives a text", True, optimiser=_text),
    Case("optimiser", "has no memory left", True, optimiser=_raises(MemoryError)),
    Case("answer", "late by 80 ms", True, answers=_arrives(0.08)),
    Case("answer", "late by 3 s", True, answers=_arrives(3.0)),
    Case("answer", "twice", True, answers=_arrives(0.0, 0.001)),
    Case("answer", "out of order", True, answers=_old_first),
    Case(
        "answer", "numbered ahead", True,
        answers=_arrives(0.0, change=lambda a: replace(a, sequence=a.sequence + 5)),
    ),
    Case(
        "answer", "for another state", True,
        answers=_arrives(0.0, change=lambda a: replace(a, x=a.x + 2.0)),
    ),
    Case(
        "answer", "numbers turned to NaN", True,
        answers=_arrives(0.0, change=lambda a: replace(a, law_vectors=a.law_vectors * math.nan)),
        ends=("degraded",),
    ),
    Case(
        "answer", "is none at all", True, answers=_arrives(0.0, change=_text), ends=("degraded",)
    ),
    Case(
        "answer", "cut short", True,
        answers=_arrives(0.0, change=lambda a: replace(a, law_vectors=a.law_vectors[:, 1:])),
        ends=("degraded",),
    ),
    Case(
        "answer", "forged, λ flipped", True,
        answers=_arrives(0.0, change=_forged), ends=("degraded",),
    ),
    Case(
        "answer", "numbers not of its plan", True,
        answers=_arrives(0.0, change=_other_numbers), ends=("degraded",),
    ),
    Case("sensor", "drops out for 10 ms", True, sensor=_sensor(_lost(), 0.01)),
    Case("sensor", "one channel out for 10 ms", True, sensor=_sensor(_lost(-1), 0.01)),
    Case("sensor", "one reading in 19 missing", True, sensor=_every(19, math.nan), since=0.0),
    Case("sensor", "lost for good", False, sensor=_sensor(_lost())),
    Case("sensor", "one channel lost for good", False, sensor=_sensor(_lost(-1))),
    Case("sensor", "all channels freeze", False, sensor=_frozen()),
    Case("sensor", "one channel freezes", False, sensor=_frozen(-1)),
    Case("sensor", "one too many for 10 ms", True, sensor=_one_too_many(0.01)),
    Case("sensor", "one too many for good", False, sensor=_one_too_many()),
    Case("sensor", "spikes of 1 rad", True, sensor=_every(37, 1.0)),
    Case("sensor", "infinite now and then", True, sensor=_every(37, math.inf)),
    Case("sensor", "sign swapped", False, sensor=_last(lambda _, v: -v)),
    Case("sensor", "jumps by 0.3 rad for good", False, sensor=_last(lambda _, v: v + 0.3)),
    Case("sensor", "drifts by 2 rad/s", False, sensor=_last(lambda t, v: v + 2.0 * t)),
    Case("sensor", "clock goes back once", True, sensor=_clock(lambda _: -5.0)),
    Case("sensor", "clock runs backwards", False, sensor=_clock(lambda t: -2.0 * t)),
    Case("sensor", "clock is no number for 10 ms", True, sensor=_clock(lambda _: math.nan, 0.01)),
    Case("sensor", "clock stands still", False, sensor=_clock(lambda t: -t)),
    Case("sensor", "clock at twice the speed", False, sensor=_clock(lambda t: t)),
    Case("actuator", "gives 75 % of what is asked", True, actuator=lambda: lambda _, u: 0.75 * u),
    Case("actuator", "gives 40 % of what is asked", True, actuator=lambda: lambda _, u: 0.4 * u),
    Case("actuator", "gives 5 % of what is asked", False, actuator=lambda: lambda _, u: 0.05 * u),
    Case("actuator", "saturates at 3", True, actuator=lambda: lambda _, u: np.clip(u, -3, 3)),
    Case("actuator", "dies", False, actuator=lambda: lambda _, u: 0.0 * u),
    Case("actuator", "sign swapped", False, actuator=lambda: lambda _, u: -u),
    Case("actuator", "sticks", False, actuator=_sticks),
    Case("rig", "fails to read for 10 ms", True, sensor=_fails(0.01)),
    Case("rig", "fails to read for good", False, sensor=_fails()),
    Case("rig", "fails to write for 10 ms", True, actuator=_fails(0.01)),
    Case("rig", "fails to write for good", False, actuator=_fails(), off=False),
    Case("rig", "fails in every second write", False, actuator=_fails(every=2)),
    Case("rig", "takes 1.5 ms for each read", False, slow=0.0015),
    Case("rig", "takes 8 ms for each read", False, slow=0.008),
    Case("rig", "hangs for 25 ms", True, hang=0.025),
    Case(
        "rig", "hangs for 90 ms", True, hang=0.09, ends=("balanced", "caught", "degraded")
    ),
    Case("rig", "hangs for 0.3 s", False, hang=0.3),
    Case("rig", "is pushed", True, push=0.01),
    Case("rig", "is knocked over", False, push=0.08),
    Case("loop", "one step takes 10 ms", True, hang=0.01),
    Case("loop", "estimator raises", False, estimator=_raises(ZeroDivisionError, "it broke")),
    Case("loop", "has no memory left", False, estimator=_raises(MemoryError)),
    Case("loop", "estimate is NaN", False, estimator=lambda x: x * math.nan),
    Case("log", "disk full", True, disk_full=True, ends=("degraded",)),
    Case("operator", "stops the run", False, operator=True, ends=("stopped",)),
)  # fmt: skip
