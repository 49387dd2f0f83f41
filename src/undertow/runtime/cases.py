"""The list of the drill: what can go wrong, and whether the mechanism can still be held."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from undertow.cascade import Admission
from undertow.law import Plan, Surface
from undertow.models import FloatArray
from undertow.optimiser import Proposal
from undertow.plants.interface import Measurement
from undertow.runtime.faults import Change, Drive, Hang, Sense, Spoil
from undertow.runtime.slow import Answer
from undertow.runtime.verdict import Ending

__all__ = ["CASES", "Case"]


@dataclass(frozen=True)
class Case:
    """One fault of the drill.

    Parameters
    ----------
    part
        What fails.
    name
        How.
    holds
        Whether the mechanism can still be held; otherwise the run must stop safely.
    optimiser, answers, sensor, actuator, hang, estimator
        What happens, at which seam.
    latency
        Of the optimiser, s.
    push
        Impulse on the last coordinate, N m s or N s.
    slow
        How long each read takes from then on, s.
    operator, disk_full
        The operator stops the run; the disk takes no more of the log.
    since
        When the fault begins, s, if not with the others.
    ends
        How the run may end; by default balanced or caught where it holds, else stopped or lost.
    off
        Whether the device can take an output of zero at the end.
    """

    part: str
    name: str
    holds: bool
    optimiser: Spoil | None = None
    answers: Callable[[], Change] | None = None
    sensor: Callable[[], Sense] | None = None
    actuator: Callable[[], Drive] | None = None
    estimator: Callable[[FloatArray], FloatArray] | None = None
    hang: Hang | None = None
    latency: float = 0.05
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


def _raises(_: Proposal) -> Proposal:
    message = "the optimiser broke"
    raise RuntimeError(message)


def _no_memory(_: object) -> Any:
    raise MemoryError


def _with_surface(change: Callable[[Surface], Surface]) -> Spoil:
    """Claim that a changed surface costs nothing."""

    def spoil(proposal: Proposal) -> Proposal:
        if proposal.plan is None:
            return proposal
        return replace(proposal, plan=Plan.of(change(proposal.plan.surfaces[0])), cost=0.0)

    return spoil


def _not_a_number(surface: Surface) -> Surface:
    block = surface.lambda_u.copy()
    spoilt = Surface(surface.alpha_a, surface.lambda_a, surface.alpha_u, surface.lambda_u)
    object.__setattr__(spoilt, "lambda_u", block * math.nan)  # as a bit flip would
    return spoilt


def _scaled(alpha_a: float = 1, lambda_a: float = 1, alpha_u: float = 1) -> Spoil:
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
    lanes = answer.lanes.copy()
    lanes[:, : flipped.vector.size] = flipped.vector
    memory = replace(answer.memory, plan=Plan.of(flipped), since=answer.use)
    return replace(answer, admission=Admission(True, "forged", 0.0), memory=memory, lanes=lanes)


def _other_numbers(answer: Answer) -> Answer:
    """Flip the sign of all numbers of the surface, and not of the plan; have it admitted."""
    lanes = answer.lanes * np.where(np.arange(answer.lanes.shape[1]) < 4, -1.0, 1.0)
    memory = replace(answer.memory, since=answer.use)
    return replace(answer, admission=Admission(True, "forged", 0.0), memory=memory, lanes=lanes)


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
            kept.append(m.q.copy()) if not kept else None
            q = m.q.copy()
            where = slice(None) if channel is None else channel
            q[where] = kept[0][where]
            return replace(m, q=q)

        return sense

    return make


def _spikes(t: float, q: FloatArray) -> FloatArray:
    if round(1000 * t) % 37 == 0:
        q += 1.0
    return q


def _one_in_19(t: float, q: FloatArray) -> FloatArray:
    if round(1000 * t) % 19 == 0:
        q[:] = math.nan
    return q


def _infinite(t: float, q: FloatArray) -> FloatArray:
    if round(1000 * t) % 37 == 0:
        q[:] = math.inf
    return q


def _flipped(_: float, q: FloatArray) -> FloatArray:
    q[-1] = -q[-1]
    return q


def _offset(_: float, q: FloatArray) -> FloatArray:
    q[-1] += 0.3
    return q


def _drift(t: float, q: FloatArray) -> FloatArray:
    q[-1] += 2.0 * t
    return q


def _clock(shift: Callable[[float], float], until: float = math.inf) -> Callable[[], Sense]:
    return lambda: lambda t, m: replace(m, t=m.t + shift(t)) if t <= until else m


def _one_too_many(until: float = math.inf) -> Callable[[], Sense]:
    return lambda: lambda t, m: replace(m, q=np.append(m.q, 0.0)) if t <= until else m


def _read_fails(until: float) -> Callable[[], Sense]:
    def sense(t: float, m: Measurement) -> Measurement:
        if t <= until:
            message = "no answer from the card"
            raise OSError(message)
        return m

    return lambda: sense


# -- actuators -------------------------------------------------------------------------------------


def _sticks() -> Drive:
    kept: list[FloatArray] = []

    def drive(_: float, u: FloatArray) -> FloatArray:
        kept.append(u.copy()) if not kept else None
        return kept[0]

    return drive


def _write_fails(until: float) -> Callable[[], Drive]:
    def drive(t: float, u: FloatArray) -> FloatArray:
        if t <= until:
            message = "no answer from the card"
            raise OSError(message)
        return u

    return lambda: drive


def _every_second_write_fails() -> Drive:
    def drive(t: float, u: FloatArray) -> FloatArray:
        if round(1000 * t) % 2:
            message = "no answer from the card"
            raise OSError(message)
        return u

    return drive


def _estimator_raises(_: FloatArray) -> FloatArray:
    message = "the estimator broke"
    raise ZeroDivisionError(message)


#: What can go wrong.
CASES: tuple[Case, ...] = (
    Case("nothing", "all is well", True),
    Case("optimiser", "raises", True, optimiser=_raises),
    Case("optimiser", "hangs for good", True, latency=math.inf),
    Case("optimiser", "finds nothing", True, optimiser=_nothing),
    Case("optimiser", "gives NaN", True, optimiser=_with_surface(_not_a_number)),
    Case("optimiser", "gives an unstable surface", True, optimiser=_scaled(lambda_a=-1)),
    Case("optimiser", "gives a singular surface", True, optimiser=_scaled(alpha_u=1e-3)),
    Case("optimiser", "gives huge parameters", True, optimiser=_scaled(lambda_a=1e9)),
    Case("optimiser", "gives the wrong shape", True, optimiser=_with_surface(_wrong_shape)),
    Case("optimiser", "gives a text", True, optimiser=_text),
    Case("optimiser", "has no memory left", True, optimiser=_no_memory),
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
        answers=_arrives(0.0, change=lambda a: replace(a, lanes=a.lanes * math.nan)),
        ends=("degraded",),
    ),
    Case(
        "answer", "is none at all", True, answers=_arrives(0.0, change=_text), ends=("degraded",)
    ),
    Case(
        "answer", "cut short", True,
        answers=_arrives(0.0, change=lambda a: replace(a, lanes=a.lanes[:, 1:])),
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
    Case("sensor", "one reading in 19 missing", True, sensor=_sensor(_one_in_19), since=0.0),
    Case("sensor", "lost for good", False, sensor=_sensor(_lost())),
    Case("sensor", "one channel lost for good", False, sensor=_sensor(_lost(-1))),
    Case("sensor", "all channels freeze", False, sensor=_frozen()),
    Case("sensor", "one channel freezes", False, sensor=_frozen(-1)),
    Case("sensor", "one too many for 10 ms", True, sensor=_one_too_many(0.01)),
    Case("sensor", "one too many for good", False, sensor=_one_too_many()),
    Case("sensor", "spikes of 1 rad", True, sensor=_sensor(_spikes)),
    Case("sensor", "infinite now and then", True, sensor=_sensor(_infinite)),
    Case("sensor", "sign swapped", False, sensor=_sensor(_flipped)),
    Case("sensor", "jumps by 0.3 rad for good", False, sensor=_sensor(_offset)),
    Case("sensor", "drifts by 2 rad/s", False, sensor=_sensor(_drift)),
    Case("sensor", "clock goes back once", True, sensor=_clock(lambda _: -5.0)),
    Case("sensor", "clock runs backwards", False, sensor=_clock(lambda t: -2.0 * t)),
    Case("sensor", "clock is no number for 10 ms", True, sensor=_clock(lambda _: math.nan, 0.01)),
    Case("sensor", "clock stands still", False, sensor=_clock(lambda t: -t)),
    Case("sensor", "clock at twice the speed", False, sensor=_clock(lambda t: t)),
    Case(
        "actuator", "gives 75 % of what is asked", True,
        actuator=lambda: lambda _, u: 0.75 * u,
    ),
    Case(
        "actuator", "gives 40 % of what is asked", True,
        actuator=lambda: lambda _, u: 0.4 * u,
    ),
    Case("actuator", "gives 5 % of what is asked", False, actuator=lambda: lambda _, u: 0.05 * u),
    Case("actuator", "saturates at 3", True, actuator=lambda: lambda _, u: np.clip(u, -3, 3)),
    Case("actuator", "dies", False, actuator=lambda: lambda _, u: 0.0 * u),
    Case("actuator", "sign swapped", False, actuator=lambda: lambda _, u: -u),
    Case("actuator", "sticks", False, actuator=_sticks),
    Case("rig", "fails to read for 10 ms", True, sensor=_read_fails(0.01)),
    Case("rig", "fails to read for good", False, sensor=_read_fails(math.inf)),
    Case("rig", "fails to write for 10 ms", True, actuator=_write_fails(0.01)),
    Case("rig", "fails to write for good", False, actuator=_write_fails(math.inf), off=False),
    Case("rig", "fails in every second write", False, actuator=_every_second_write_fails),
    Case("rig", "takes 1.5 ms for each read", False, slow=0.0015),
    Case("rig", "takes 8 ms for each read", False, slow=0.008),
    Case("rig", "hangs for 25 ms", True, hang=Hang(0.025)),
    Case(
        "rig", "hangs for 90 ms", True, hang=Hang(0.09), ends=("balanced", "caught", "degraded")
    ),
    Case("rig", "hangs for 0.3 s", False, hang=Hang(0.3)),
    Case("rig", "is pushed", True, push=0.01),
    Case("rig", "is knocked over", False, push=0.08),
    Case("loop", "one step takes 10 ms", True, hang=Hang(0.01)),
    Case("loop", "estimator raises", False, estimator=_estimator_raises),
    Case("loop", "has no memory left", False, estimator=_no_memory),
    Case("loop", "estimate is NaN", False, estimator=lambda x: x * math.nan),
    Case("log", "disk full", True, disk_full=True, ends=("degraded",)),
    Case("operator", "stops the run", False, operator=True, ends=("stopped",)),
)  # fmt: skip
