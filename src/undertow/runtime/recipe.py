"""A run as data: what it takes to build its controller again, from the command line or a log."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property
from typing import Any, Literal, Self, get_args

from undertow.base import InvalidInputError, UndertowError, near
from undertow.cascade import Cascade, CascadeState, derate_actuator
from undertow.cascade.swing_up import CatchRegion, SwingUpAndCatch, designed, hanging
from undertow.estimators import KalmanFilter
from undertow.law import Plan
from undertow.mechanisms.named import named
from undertow.models import FloatArray, Mechanism, number_of
from undertow.objective import Goal, objective_for
from undertow.optimiser import Budget
from undertow.plants import Bench, IdealRig, RealisticRig
from undertow.plants.presets import bench_for
from undertow.runtime.controller import Controller
from undertow.runtime.controller_defaults import (
    RESERVE,
    default_gate,
    estimator_for,
    provable,
    reaching_for,
)
from undertow.runtime.settings import Settings
from undertow.runtime.slow import Answer, Request, respond

__all__ = ["Recipe"]

#: Shortest period, and longest prediction, of a run, s.
SHORTEST, FARTHEST = 1e-5, 3600.0

#: Which words a recipe's objective is written in.  Logs before had no such number: their
#: "energy" and "time" are "bench-energy" and "bench-time" now.
WORDS = 2


@dataclass(frozen=True)
class Recipe:
    """How to build cascade, estimator, controller and simulated rig of a run.

    Parameters
    ----------
    mechanism
        Name in the library, or ``FILE.py:NAME`` for one's own.
    parameters
        Values that differ from the library's, SI units.
    start
        Initial state, (2n,); the mechanism's usual one by default, where it has one.
    objective
        A word of :func:`undertow.objective_for`; ``"bench-energy"`` suits a rig.
    horizon
        Longest prediction, s.
    rig
        ``"ideal"``, or ``"realistic"``: friction, encoders, delay, jitter, spread.
    seed
        Of the rig and of the optimiser.
    evaluations, seconds
        Budget of a re-optimisation; without ``seconds`` it depends on the seed alone.
    period
        Of the fast loop, s.
    swing_up
        Begin hanging at rest, where no other start is given, and swing up.
    settings
        Limits and patience.

    Raises
    ------
    InvalidInputError
        For a name that the library does not have, or a value that cannot be used.
    """

    mechanism: str = "rotary_pendulum"
    parameters: Mapping[str, float] = field(default_factory=dict)
    start: tuple[float, ...] = ()
    objective: Goal = "bench-energy"
    horizon: float = 20.0
    rig: Literal["ideal", "realistic"] = "ideal"
    seed: int = 0
    evaluations: int = 1024
    seconds: float = math.inf
    period: float = 0.001
    swing_up: bool = False
    settings: Settings = field(default_factory=Settings)

    def __post_init__(self) -> None:
        """Refuse an unknown objective, a period that no loop keeps, and a horizon too far."""
        if self.objective not in get_args(Goal):
            raise InvalidInputError(
                "objective of a run",
                value=repr(self.objective),
                limit=f"one of {', '.join(get_args(Goal))}",
                remedy=near(str(self.objective), get_args(Goal)),
            )
        for what in ("period", "horizon"):
            number_of(f"{what} of a run", getattr(self, what))
        stall = self.settings.stall
        if not SHORTEST <= self.period < stall:
            raise InvalidInputError(
                "period of a run",
                value=f"{self.period:g} s",
                limit=f"≥ {SHORTEST:g} s and less than the longest gap between two steps, "
                f"{stall:g} s",
                remedy="1 ms is usual; a longer one needs Settings(stall=...)",
            )
        if not 0 < self.horizon <= FARTHEST:
            raise InvalidInputError(
                "horizon of a run", value=f"{self.horizon:g} s", limit=f"> 0, ≤ {FARTHEST:g} s"
            )
        if self.rig not in ("ideal", "realistic"):
            raise InvalidInputError("rig of a run", value=self.rig, limit="ideal or realistic")

    @cached_property
    def belief(self) -> Mechanism:
        """The controller's model."""
        return named(self.mechanism).with_parameters(**self.parameters)

    def of(self, mechanism: Mechanism) -> Self:
        """Return the same recipe for a mechanism that is at hand, whatever its name says."""
        other = replace(self)
        vars(other)["belief"] = mechanism.with_parameters(**self.parameters)
        return other

    @cached_property
    def x0(self) -> FloatArray:
        """Initial state, (2n,)."""
        if self.start:
            return self.belief.check_state(self.start)
        if self.swing_up:
            return hanging(self.belief)
        return self.belief.usual_start

    @cached_property
    def cascade(self) -> Cascade:
        """Law, optimiser and gate."""
        estimator = self.make_estimator()
        return Cascade(
            self.belief,
            objective_for(self.belief, self.objective, horizon=self.horizon),
            reaching_for(estimator),
            warm=Budget(self.evaluations, self.seconds),
            gate=default_gate(estimator),
            seed=self.seed,
        )

    @cached_property
    def swing(self) -> SwingUpAndCatch | None:
        """Swing-up and catch, where it is wanted."""
        if not self.swing_up:
            return None
        region = CatchRegion(self.belief, reaching=self.cascade.reaching, prove=provable)
        return SwingUpAndCatch(designed(self.belief), region)

    def first(self) -> CascadeState:
        """Return what the cascade starts with: the first optimum, or what awaits a catch.

        Raises
        ------
        InfeasibleError
            When the first optimisation finds no admissible surface.
        """
        if self.swing is not None:
            return CascadeState(Plan.of(self.swing.region.surfaces[0]))
        return self.cascade.start(self.x0)[0]

    def respond(self, request: Request) -> Answer:
        """Answer a request of the fast loop: what the slow loop computes."""
        return respond(self.cascade, request, self.swing)

    def rehearse(self, memory: CascadeState) -> None:
        """Make everything compile that an answer may need, whatever the gate refuses before.

        A run that begins balanced has most of it from its first optimum; one that swings up
        meets the optimiser in the middle of the run.  ``memory`` is what :meth:`first` returned.
        """
        x, cascade, step = self.belief.state(**self.belief.start), self.cascade, self.cascade.step
        if self.swing is not None:
            with contextlib.suppress(UndertowError):
                memory = cascade.start(x)[0]
            self.respond(Request(0.0, x, step, memory, 0))
        self.respond(Request(0.0, x, step, memory))
        derate_actuator(cascade.loop, RESERVE).batch(x, memory.plan, duration=step)

    @cached_property
    def bench(self) -> Bench:
        """What the realistic rig is like."""
        return bench_for(self.belief).with_timing(period=self.period)

    def make_rig(self) -> RealisticRig:
        """Return the simulated rig, at the start."""
        if self.rig == "ideal":
            return IdealRig(self.belief, self.x0, self.period)
        return RealisticRig(self.bench, self.x0, self.seed)

    def make_estimator(self) -> KalmanFilter:
        """Return the estimator that suits the rig's sensors and delays."""
        if self.rig == "ideal":  # belief is truth: nothing disturbs it
            exact = Bench(self.belief).with_timing(period=self.period)
            return estimator_for(self.belief, exact, drift=0.0)
        return estimator_for(self.belief, self.bench)

    def make_controller(self, memory: CascadeState) -> Controller:
        """Return the controller, idle."""
        return Controller(
            self.cascade,
            memory,
            self.make_estimator(),
            period=self.period,
            settings=self.settings,
            swing_up=self.swing,
        )

    def as_dict(self) -> dict[str, Any]:
        """JSON values from which :meth:`from_dict` makes the recipe again."""
        return asdict(self) | {"words": WORDS}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """Return the recipe that was written to a log, an older one's words as they are now.

        Raises
        ------
        InvalidInputError
            For fields that a recipe has not, or values that are none for them.
        """
        taken = _of_types(cls, _in_words_of_now(values))
        for name, kind in (("start", taken["start"]), ("parameters", taken["parameters"].values())):
            if not all(isinstance(v, int | float) for v in kind):
                raise InvalidInputError(f"{name} of a recipe", value=kind, limit="numbers")
        settings = Settings(**_of_types(Settings, taken["settings"]))
        return cls(**{**taken, "start": tuple(taken["start"]), "settings": settings})


def _of_types(made: type, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return values for the fields of a data class; refuse others, and those of other types.

    Raises
    ------
    InvalidInputError
        With the first that is refused.
    """
    usual = {item.name: getattr(made(), item.name) for item in fields(made)}
    for name, value in values.items():
        if name not in usual:
            raise InvalidInputError(
                f"{made.__name__} of a log",
                value=f"field {name!r}",
                limit=f"one of {', '.join(usual)}",
                remedy="It was written by another version of Undertow: replay it with that",
            )
        kinds = _KINDS.get(type(usual[name]), (dict,))
        if type(value) not in kinds or (isinstance(value, float) and math.isnan(value)):
            raise InvalidInputError(
                f"{name} of a log", value=repr(value)[:80], limit=f"a {kinds[0].__name__}"
            )
    return {name: values.get(name, usual[name]) for name in usual}


#: What JSON has for values of a type.
_KINDS: Mapping[type, tuple[type, ...]] = {
    bool: (bool,), int: (int,), float: (int, float), str: (str,), tuple: (list, tuple),
}  # fmt: skip


def _in_words_of_now(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return a recipe's values, the objective of an older one by the word that it has now."""
    known = dict(values)
    if known.pop("words", None) is None and "objective" in known:
        known["objective"] = f"bench-{known['objective']}"
    return known
