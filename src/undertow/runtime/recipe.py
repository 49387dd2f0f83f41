"""A run as data: what it takes to build its controller again, from the command line or a log."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property
from typing import Any, Literal, Self, get_args

import numpy as np

from undertow.base import (
    InvalidInputError,
    UndertowError,
    a_kind,
    check_fields,
    checked_names,
    one_of,
    positive,
)
from undertow.cascade import Cascade, CascadeState, Legs, derate_actuator
from undertow.cascade.swing_up import CatchRegion, SwingUpAndCatch, designed, hanging
from undertow.estimators import Belief, Estimator, MakeEstimator
from undertow.law import Plan, Reference, ReferenceMotion, SetPoints
from undertow.mechanisms import LIBRARY
from undertow.mechanisms.named import named
from undertow.models import FloatArray, Mechanism, invariant_coordinates
from undertow.objective import USUAL, Goal, Objective, objective_for
from undertow.optimiser import Budget
from undertow.plants import Bench, IdealRig, RealisticRig
from undertow.plants.bench import bench_for
from undertow.runtime.controller import Controller
from undertow.runtime.controller_defaults import (
    RESERVE,
    estimator_for,
    for_rig,
)
from undertow.runtime.encoding import MOVING, reference_from, reference_to
from undertow.runtime.settings import Settings
from undertow.runtime.slow_loop import Answer, Request, respond
from undertow.runtime.targets import checked_legs

#: Shortest period, and longest prediction, of a run, s.
SHORTEST, FARTHEST = 1e-5, 3600.0

#: Evaluations of a search for another target that only has to make everything compile.
COMPILES = 512

#: Which words a recipe's objective is written in.  Logs before had no such number: their
#: "energy" and "time" are "bench-energy" and "bench-time" now.  Runs before 3 took their mechanism
#: for exact.
WORDS = 3

#: What to do about a log with fields that are not known.
_ANOTHER_VERSION = "It was written by another version of Undertow: replay it with that"

#: Names of settings in logs before version 0.2.0, and what they are now.
OLD_SETTINGS = {
    "lead": "lead_time", "longest_lead": "max_lead_time", "silence": "optimiser_timeout",
    "surprise": "max_prediction_error", "patience": "sensor_timeout", "jump": "max_innovation",
    "frozen": "frozen_threshold", "settle": "sensor_settling_time", "near": "settled_radius",
    "margin": "min_margin", "travel": "max_travel", "lost": "fall_angle",
    "escape": "max_state_norm", "stall": "max_step_interval", "window": "fault_window",
    "failing": "max_failure_ratio", "sparse": "max_dropout_ratio",
    "overrun": "max_deadline_miss_ratio", "drift": "max_clock_drift",
    "bring_up": "bring_up_timeout", "insist": "zero_output_timeout", "home": "target_radius",
    "homing": "convergence_time",
}  # fmt: skip


@checked_names
@dataclass(frozen=True)
class Recipe:
    """How to build cascade, estimator, controller and simulated rig of a run.

    Parameters
    ----------
    mechanism
        A mechanism, or a name: in the library, or ``FILE.py:NAME`` for one's own.
    parameters
        Values that differ from the library's, SI units.
    start
        Initial state, (2n,); the mechanism's usual one by default, where it has one.
    objective
        An objective, or a word of :func:`undertow.objective_for`.
    horizon
        Longest prediction, s; an objective brings its own.
    rig
        ``"ideal"``, or ``"realistic"``: friction, encoders, delay, jitter, spread.
    seed
        Of the rig and of the optimiser.
    evaluations, seconds
        Budget of a re-optimisation; without ``seconds`` it depends on the seed alone.
    period
        Of the fast loop, s.
    delay
        From a write to its effect in a reading, s, as ``undertow bench`` measures it: the estimator
        reckons with it, and a realistic rig has it.  By default the bench's own.
    encoders
        One count of a position sensor by coordinate, rad or m: the estimator reckons with it, and a
        realistic rig has it.  By default the bench's own.
    swing_up
        Begin hanging at rest, where no other start is given, and swing up.
    target
        Set-points, pairs of a time, s, and coordinates with positions, rad or m, see
        :class:`undertow.SetPoints`; without any x = 0.  Times count from the start of the run, and
        the target jumps once there is a plan for it; after a swing-up once it balances at x = 0.
        Or a :class:`undertow.Reference`, which is followed from the start of the run on.
    duration
        How long a reference is followed, s; then it rests.
    learns
        Whether the mechanism's parameters, within their tolerances, are learnt as it runs;
        otherwise they are exact.
    settings
        Limits and timeouts.
    design
        A cascade with further settings, for the same mechanism and objective.  Its gate,
        covariance and reaching law are kept if they are not the defaults, which are for exact
        states.
    estimator
        Makes an estimator for the controller's model and the bench that it is told of; by default
        :func:`undertow.runtime.controller_defaults.estimator_for`, a Kalman filter, which learns.

    Raises
    ------
    InvalidInputError
        For a name that the library does not have, or a value that cannot be used.
    """

    mechanism: str | Mechanism = "rotary_pendulum"
    parameters: Mapping[str, float] = field(default_factory=dict)
    start: tuple[float, ...] = ()
    objective: Goal | Objective = USUAL
    horizon: float = 20.0
    rig: Literal["ideal", "realistic"] = "ideal"
    seed: int = 0
    evaluations: int = 1024
    seconds: float = math.inf
    period: float = 0.001
    delay: float | None = None
    encoders: Mapping[str, float] = field(default_factory=dict)
    swing_up: bool = False
    target: tuple[tuple[float, Mapping[str, float]], ...] | Reference = ()
    duration: float = 60.0
    learns: bool = True
    settings: Settings = field(default_factory=Settings)
    design: Cascade | None = None
    estimator: MakeEstimator | None = None

    def __repr__(self) -> str:
        """Show what is run, for what, and where."""
        goal = self.objective if isinstance(self.objective, str) else self.objective.name
        name = self.mechanism if isinstance(self.mechanism, str) else self.mechanism.name
        return (
            f"Recipe({name}, {goal}, {self.rig} rig, period={self.period:g} s, seed={self.seed}"
            f"{', swing_up=True' if self.swing_up else ''})"
        )

    def __post_init__(self) -> None:
        """Refuse an unknown objective, a period that no loop keeps, and a horizon too far."""
        if not isinstance(self.objective, Objective):
            one_of("objective of a run", self.objective, get_args(Goal))
        one_of("rig of a run", self.rig, ("ideal", "realistic"))
        check_fields(self)
        if self.delay is not None:
            positive("delay of a run, s", self.delay, "0.002 is 2 ms", zero=True)
        for name, count in self.encoders.items():
            one_of("encoder of a run", name, [c.name for c in self.belief.coordinates])
            positive(f"one count of '{name}'", count, "2π/4096 is that of 4096 counts a turn")
        counts = ", ".join(f"{name}={count:g}" for name, count in self.encoders.items())
        told = {"delay": "" if self.delay is None else f"{self.delay:g} s", "encoders": counts}
        for what, value in told.items():
            if value and self.rig == "ideal":
                raise InvalidInputError(
                    f"{what} of a run",
                    value=f"{value}, on an ideal rig",
                    limit="a rig that has such: realistic, or your own driver",
                    remedy="Leave it out",
                )
        stall = self.settings.max_step_interval
        if not SHORTEST <= self.period < stall:
            raise InvalidInputError(
                "period of a run",
                value=f"{self.period:g} s",
                limit=f"≥ {SHORTEST:g} s and less than the longest gap between two steps, "
                f"{stall:g} s",
                remedy="1 ms is usual; a longer one needs Settings(max_step_interval=...)",
            )
        for what, span, remedy in (
            ("horizon of a run", self.horizon, ""),
            ("length of a reference", self.duration, "Make the run shorter, or give set-points"),
        ):
            if not 0 < span <= FARTHEST:
                limit = f"> 0, ≤ {FARTHEST:g} s"
                raise InvalidInputError(what, value=f"{span:g} s", limit=limit, remedy=remedy)
        assert self.legs is not None  # found here, so that its checks run before anything moves

    @cached_property
    def belief(self) -> Mechanism:
        """The controller's model, its inputs limited as the settings have it."""
        whole, limits = self._whole, self.settings.limits(self._whole)
        return whole.with_input_limit(*limits) if (limits < whole.input_limits).any() else whole

    @cached_property
    def _whole(self) -> Mechanism:
        """The same with the whole of its inputs, which words for an objective are about."""
        known = named(self.mechanism) if isinstance(self.mechanism, str) else self.mechanism
        return known.with_parameters(**self.parameters)

    def in_names(self) -> Self | None:
        """Return the same recipe with names in place of objects; None where they have none."""
        belief, made = self.belief, self
        if isinstance(self.mechanism, Mechanism):
            known = LIBRARY[belief.name]() if belief.name in LIBRARY else None
            if known is None or known.structure != belief.structure:
                return None
            values = {p.name: p.value for p in belief.parameters}
            made = replace(made, mechanism=belief.name, parameters=values)
            if any(
                getattr(made.belief, part) != getattr(belief, part)
                for part in ("fingerprint", "coordinates", "parameters")
            ):
                return None
        goal = self.objective
        if isinstance(goal, Objective):
            known_goals = (
                word
                for word in get_args(Goal)
                if objective_for(made._whole, word, horizon=goal.horizon) == goal.on(belief)
            )
            named_goal = next(known_goals, None)
            if named_goal is None or goal.horizon > FARTHEST:
                return None
            made = replace(made, objective=named_goal, horizon=goal.horizon)
        if isinstance(self.target, Reference) and reference_to(self.target) is None:
            return None
        if self.design is not None:
            usual = Cascade(
                self.design.mechanism,
                self.design.objective,
                seed=self.seed,
                belief="usual" if self.learns else "exact",
            )
            others = ("mechanism", "objective")
            settings = [f.name for f in fields(usual) if f.name not in others]
            if any(getattr(self.design, name) != getattr(usual, name) for name in settings):
                return None
        return replace(made, design=None)

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
        suited = for_rig(self._designed, self.make_estimator())
        return replace(suited, warm=suited.warm or Budget(self.evaluations, self.seconds))

    @cached_property
    def _designed(self) -> Cascade:
        """The cascade as it is for exact states."""
        design = self.design
        if design is not None:
            goal = self.settings.bounded(design.objective, self._whole)
            if goal is not design.objective:
                design = replace(design, objective=goal)
            if (design.mechanism.input_limits == self.belief.input_limits).all():
                return design
            about = design.belief
            if isinstance(about, Belief):
                about = replace(about, mechanism=self.belief)
            return replace(design, mechanism=self.belief, belief=about)
        wanted = self.objective
        if not isinstance(wanted, Objective):
            wanted = objective_for(self._whole, wanted, horizon=self.horizon)
        known: Literal["usual", "exact"] = "usual" if self.learns else "exact"
        goal = self.settings.bounded(wanted, self._whole)
        return Cascade(self.belief, goal, seed=self.seed, belief=known)

    @cached_property
    def swing(self) -> SwingUpAndCatch | None:
        """Swing-up and catch, where it is wanted."""
        if not self.swing_up:
            return None
        from undertow.proofs import terminal_sets

        region = CatchRegion(self.belief, reaching=self.cascade.reaching, prove=terminal_sets)
        return SwingUpAndCatch(designed(self.belief), region)

    @cached_property
    def legs(self) -> Legs:
        """When the target jumps, s, and where to; empty for x = 0."""
        if not self.target:
            return ()
        objective, settings, goal = self._designed.objective, self.settings, self.target
        if not isinstance(goal, Reference):
            return checked_legs(self.belief, objective, settings, SetPoints(goal))
        return checked_legs(self.belief, objective, settings, goal, self.duration)

    @property
    def reference(self) -> ReferenceMotion | None:
        """The target that moves, if one does."""
        return next((motion for _, motion in self.legs if motion.moves), None)

    def first(self) -> CascadeState:
        """Return what the cascade starts with: the first optimum, or what awaits a catch.

        Raises
        ------
        InfeasibleError
            When the first optimisation finds no admissible surface.
        """
        if self.swing is not None:
            return CascadeState(Plan.of(self.swing.region.surfaces[0]))
        target = self.legs[0][1] if self.legs else None
        state, _ = self.cascade.start_to(self.belief.check_state(self.x0), target)
        return self.cascade.prepared(state, self.x0)

    def respond(self, request: Request) -> Answer:
        """Answer a request of the fast loop: what the slow loop computes."""
        return respond(self.cascade, request, self.swing)

    def precompile(self, memory: CascadeState, *, jumps: bool = False) -> None:
        """Make everything compile that an answer may need, whatever the gate refuses before.

        A run that begins balanced has most of it from its first optimum; one that swings up
        meets the optimiser in the middle of the run.  ``memory`` is what :meth:`first` returned.
        ``jumps``: the target may jump, also where no set-point says so yet.
        """
        x, cascade, step = self.belief.state(**self.belief.start), self.cascade, self.cascade.step
        if self.swing is not None:
            with contextlib.suppress(UndertowError):
                memory = cascade.start(x)[0]
            for place in (hanging(self.belief), x):
                self.respond(Request(0.0, place, step, memory, 0))
        self.respond(Request(0.0, x, step, memory))
        if self.legs or (jumps and invariant_coordinates(self.belief)):
            home = SetPoints({})
            checked_legs(self.belief, cascade.objective, self.settings, home)
            still = ReferenceMotion.at_rest(np.zeros(self.belief.n))
            jump = Request(0.0, x, step, memory, -1, still)
            answer = respond(replace(cascade, cold=Budget(COMPILES)), jump, self.swing)
            there = (answer if answer.jump else self.respond(jump)).memory
            self.respond(Request(step, x, 2 * step, there))
        derate_actuator(cascade.loop_at(memory), RESERVE).batch(x, memory.plan, duration=step)

    @property
    def output_bounds(self) -> tuple[FloatArray, FloatArray]:
        """Largest |u|, and largest change of u in one period, (m,) each."""
        settings = self.settings
        return settings.limits(self.belief), settings.slew(self.belief) * self.period

    @cached_property
    def bench(self) -> Bench:
        """What the realistic rig is like."""
        usual = bench_for(self.belief).with_timing(period=self.period)
        usual = usual.with_encoders(self.encoders)
        return usual if self.delay is None else usual.with_delay(self.delay)

    def make_rig(self) -> RealisticRig:
        """Return the simulated rig, at the start."""
        if self.rig == "ideal":
            return IdealRig(self.belief, self.x0, self.period)
        return RealisticRig(self.bench, self.x0, self.seed)

    def make_estimator(self) -> Estimator:
        """Return the estimator that suits the rig's sensors and delays, or the one of one's own.

        Raises
        ------
        InvalidInputError
            Where what is made is none.
        """
        known, ideal = self._designed.known, self.rig == "ideal"
        bench = Bench(self.belief).with_timing(period=self.period) if ideal else self.bench
        if self.estimator is None:  # on the ideal rig belief is truth: nothing disturbs it
            return estimator_for(self.belief, bench, 0.0 if ideal else None, known)
        made: object = self.estimator(self.belief, bench)
        if not isinstance(made, Estimator) or not hasattr(made, "mechanism"):
            raise InvalidInputError(
                "estimator of a run",
                value=f"{made!r}, {a_kind(made)}"[:80],
                limit="an undertow.estimators.Estimator that its own __init__ has begun",
                remedy="Derive your own from it: a run asks more of it than reset and estimate",
            )
        return made

    def make_controller(self, memory: CascadeState) -> Controller:
        """Return the controller, idle."""
        return Controller(
            self.cascade,
            memory,
            self.make_estimator(),
            period=self.period,
            settings=self.settings,
            swing_up=self.swing,
            legs=self.legs,
        )

    def as_dict(self) -> dict[str, Any]:
        """JSON values from which :meth:`from_dict` makes the recipe again, if it is all data.

        Of an estimator of one's own they say that there was one.
        """
        values = {item.name: getattr(self, item.name) for item in fields(self)}
        del values["design"], values["estimator"]  # objects
        values["own_estimator"] = self.estimator is not None
        if isinstance(self.target, Reference):
            values["target"] = [MOVING, reference_to(self.target)]
        return values | {"settings": asdict(self.settings), "words": WORDS}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """Return the recipe that was written to a log, an older one's words as they are now.

        Raises
        ------
        InvalidInputError
            For fields that a recipe has not, or values that are none for them.
        """
        taken = _in_words_of_now(values)
        taken.pop("own_estimator", None)
        settings = {
            OLD_SETTINGS.get(name, name): value for name, value in taken.get("settings", {}).items()
        }
        for made, given in ((cls, taken), (Settings, settings)):
            known = [item.name for item in fields(made) if item.name not in ("design", "estimator")]
            for name in given:
                one_of(f"field of a log's {made.__name__}", name, known, _ANOTHER_VERSION)
        settings |= {name: tuple(v) for name, v in settings.items() if isinstance(v, list)}
        target: Any = taken.get("target", ())
        if len(target) == 2 and target[0] == MOVING:
            target = reference_from(target[1])
        else:
            target = SetPoints(target).pairs if target else ()
        start = tuple(taken.get("start", ()))
        changed = {"start": start, "target": target, "settings": Settings(**settings)}
        return cls(**{**taken, **changed})


def _in_words_of_now(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return a recipe's values, those of an older one as they are written now."""
    known = dict(values)
    words = known.pop("words", None)
    if words is None and "objective" in known:
        known["objective"] = f"bench-{known['objective']}"
    if words is None or words < WORDS:
        known["learns"] = False
    return known
