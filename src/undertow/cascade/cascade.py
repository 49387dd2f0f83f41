"""The two-rate cascade: sliding-mode law inside, surface optimiser outside, a gate between.

The cascade is a pure state machine: it holds no clock and no thread, and every decision is
a function of its arguments, so a recorded run can be replayed.  The runtime, or
:meth:`Cascade.simulate`, supplies the time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property, lru_cache, partial
from typing import Any, Literal, NamedTuple, cast

import numpy as np
from numpy.typing import ArrayLike

from undertow.base import (
    InvalidInputError,
    at_least,
    check_fields,
    checked,
    error_text,
    one_of,
    positive,
)
from undertow.cascade.robustness import sticking_distance
from undertow.cascade.simulation import (
    Run,
    Update,
    is_news,
    legs_to,
    moments,
    moving_loops,
    simulate_piece,
)
from undertow.cascade.targets import LoopsAbout, legs_of
from undertow.closed_loop import INADMISSIBLE, RTOL, ClosedLoop, Event, Trajectory, simulate_along
from undertow.closed_loop.gate import Admission, Gate, broken_by, cost_gate
from undertow.estimators import Belief, Estimator, ParameterEstimate
from undertow.law import (
    Control,
    Plan,
    ReachingLaw,
    ReferenceMotion,
    SlidingModeLaw,
    Surface,
    Target,
    check_surface,
)
from undertow.models import TIME, FloatArray, Mechanism, StateLike, number_of
from undertow.objective import Objective, objective_for
from undertow.optimiser import Budget, DecisionVariables, Optimiser, Planner, Proposal

#: Stands for the objective that is meant where nobody says, until the mechanism is known.
_USUAL = cast(Objective, None)

#: Relative tolerance of the linear tail in the optimiser's rollouts.
TAIL_RTOL = 2e-3

#: Largest step times rate of the boundary layer in the optimiser's rollouts.
RESOLVED = 1.0

#: How much more a first plan may cost than the search found, as a factor, before it is searched for
#: again in smaller steps; and how much smaller they are.
AGREES, FINER = 1.01, 4

#: How many times the reaching gains and layers of the plans in reserve are the cascade's: near the
#: target all are the same feedback, far from it each asks for more input before it saturates.
STRONGER = (1.0, 2.0, 4.0, 8.0)

#: How far positions may be off what the plan in use predicted for them before an admission says
#: so: this much, rad or m, and this part of how far the plan was to move them meanwhile.  A target
#: that jumps shows in positions at once; what a model does not know shows in velocities first.
JUMP, PART = 0.1, 0.5


@dataclass(frozen=True)
class CascadeState:
    """What the cascade remembers between steps.

    ``plan`` is in use since the time ``since``; ``sequence`` is the number of the last
    proposal considered; ``predicted`` is the predicted cost J̃_k at the last decision;
    ``scale`` that of the first; ``x`` the state at ``since``, empty where it is not known;
    ``estimate`` what is known of the plant's parameters, where the cascade learns them;
    ``target`` where the target is, where it is not at x = 0: ``x`` is counted from it;
    ``disturbance`` how large a matched disturbance is, in the inputs' units, (m,), where it is
    estimated.
    """

    plan: Plan
    sequence: int = 0
    predicted: float = math.inf
    scale: float = 0.0
    since: float = 0.0
    x: tuple[float, ...] = ()
    estimate: ParameterEstimate | None = None
    target: ReferenceMotion | None = None
    disturbance: tuple[float, ...] = ()

    @property
    def surface(self) -> Surface:
        """The first surface of the plan in use."""
        return self.plan.surfaces[0]

    def at(self, t: float) -> Plan:
        """Return what is left of the plan in use at time t, s."""
        return self.plan.shifted(t - self.since)

    def error(self, t: float, x: FloatArray) -> FloatArray:
        """Return how far a state x, (…, 2n), is off the target at time t, s."""
        return x if self.target is None else x - self.target.state(t)

    def absolute(self, t: float, error: FloatArray) -> FloatArray:
        """Return the state that is so far off the target at time t, s: the inverse."""
        return error if self.target is None else error + self.target.state(t)


class FirstTry(NamedTuple):
    """An answer to the search for a first plan, and the cost of its plan where it was judged.

    ``rank`` is 0 where it is good, 1 if it is for every plausible plant, 2 if it is for the
    estimate, 3 where there is none.
    """

    rank: int
    cost: float
    proposal: Proposal


@dataclass(frozen=True, eq=False)
class Cascade:
    """The controller a user runs: law, optimiser and gate.

    Parameters
    ----------
    mechanism
        The controller's belief.
    objective
        What is best; by default ``effort`` of :func:`undertow.objective_for`, as on the command
        line: it means the same for every mechanism, and it arrives, where least energy puts that
        off.  The travel that the mechanism declares joins its constraints, see
        :meth:`undertow.Objective.on`.
    reaching
        Reaching law of the inner loop.
    period
        Δt between re-optimisations, s.
    first
        First surface, checked; designed by itself by default.
    step, zoh_steps
        Runge-Kutta step of the search's rollouts, s, and steps per sample of the inner loop
        (0: continuous), as for :class:`undertow.ClosedLoop`.
    freedom
        What may be chosen besides the paper's surface parameters: reaching gains, a
        schedule of surfaces.  Times of a schedule are multiples of the period.
    cold, warm
        Budgets of the first optimisation and of the later ones; by default as the method
        needs.
    resolution
        Differences in predicted cost below this part of the first one are not worth a
        search.
    gate
        Admission gate: with exact states :func:`cost_gate`, the default everywhere.  For a rig,
        its estimator and its delays :func:`undertow.runtime.controller_defaults.default_gate` adds
        margins.
    seed
        Seed of the optimiser.
    planner
        Proposes plans in the place of :attr:`optimiser`: one of your own.  The gate judges what
        it proposes as it judges the library's.
    belief
        What is not known of the mechanism: by default the tolerances that its parameters carry,
        :meth:`undertow.Belief.usual`.  Plans are judged on an ensemble of plausible plants, and
        what the motion shows narrows it: law, search and gate go on with the estimated parameters,
        and a plan that some plausible plant would not survive is replaced before its period ends.
        Least time is re-optimised for the estimate alone where states are exact, a schedule always,
        and later decisions mend that: one of :attr:`reserve` has to bring every plausible plant
        home after a period.
        ``"exact"``: the mechanism is taken for the plant, as in the paper.
    covariance
        Of the error of the estimated state at the target, (2n, 2n), SI units: predictions count the
        cost of the input that it becomes near the target, see :class:`undertow.ClosedLoop`.
        ``None``: states are exact.
    rtol
        Relative tolerance of simulated motions, and of what the gate predicts with a belief that is
        exact; 0: steps of ``step``.

    Raises
    ------
    InvalidInputError
        For a period that is not a whole number of steps.
    UnstableSurfaceError, SingularSurfaceError
        For a first surface that cannot be used.

    Notes
    -----
    The defaults of ``step``, ``period`` and ``reaching`` are for mechanisms whose motions take
    tenths of seconds or more, the fastest of whose modes (``mechanism.linearise()`` shows them) is
    some 10 1/s.  One that is c times as fast, a pendulum of a millimetre, is balanced with them,
    but later than it could be: divide ``step`` and ``period`` by c, and give a ``reaching`` law
    with c times the η.

    Examples
    --------
    >>> import undertow as ut
    >>> rig = ut.mechanisms.rotary_pendulum(d_e=0.025)
    >>> run = ut.Cascade(rig, ut.MinimumTime()).simulate(phi=ut.deg(20))
    >>> run.reached
    True
    """

    mechanism: Mechanism
    objective: Objective = _USUAL
    reaching: ReachingLaw = ReachingLaw()
    period: float = 0.1
    first: Surface | None = None
    step: float = 0.002
    zoh_steps: int = 0
    freedom: DecisionVariables = DecisionVariables()
    cold: Budget | None = None
    warm: Budget | None = None
    resolution: float = 1e-4
    gate: Gate = cost_gate
    seed: int = 0
    planner: Planner | None = None
    belief: Belief | Literal["usual", "exact"] = "usual"
    covariance: FloatArray | None = None
    rtol: float = RTOL

    def __post_init__(self) -> None:
        """Check all settings before any work starts."""
        if self.objective is None:
            check_fields(self, "mechanism")
            object.__setattr__(self, "objective", objective_for(self.mechanism))
        check_fields(self)
        object.__setattr__(self, "objective", self.objective.on(self.mechanism))
        if TIME in self.mechanism.force.free_symbols:
            raise InvalidInputError(
                f"belief '{self.mechanism.name}' of a cascade",
                value="a force that depends on the time t",
                limit="autonomous",
                remedy="Predictions have no clock: give disturbances to plant= alone",
            )
        positive(
            "resolution of the cascade",
            self.resolution,
            "1e-4 is a ten-thousandth of the first cost",
            zero=True,
        )
        at_least("seed", self.seed, 0)
        assert self.loop is not None  # built here, so that its checks run first
        stride = self.stride
        count = number_of("period of the cascade", self.period) / stride
        if not (math.isfinite(count) and count > 0.5 and abs(count - round(count)) < 1e-6):
            raise InvalidInputError(
                "period of the cascade",
                value=f"{self.period:g} s",
                limit=f"a whole multiple of the inner step, {stride:g} s",
                remedy="Change the period, or the step",
            )
        if any(abs(t / self.period - round(t / self.period)) > 1e-6 for t in self.freedom.times):
            raise InvalidInputError(
                "times of a schedule",
                value=self.freedom.times,
                limit=f"multiples of the period, {self.period:g} s",
                remedy="Then what is left of a plan is a plan again",
            )
        parts = self.period / (self.freedom.schedule or self.period)
        whole = max(parts, 1 / parts)
        if abs(whole - round(whole)) > 1e-6:
            raise InvalidInputError(
                "schedule of the cascade",
                value=f"{self.freedom.schedule:g} s",
                limit=f"a multiple or a whole part of the period, {self.period:g} s",
                remedy="Then what is left of a plan is a plan again",
            )
        if self.planner is not None and not callable(getattr(self.planner, "propose", None)):
            raise InvalidInputError(
                "planner of the cascade",
                value=f"{self.planner!r}, a {type(self.planner).__name__}",
                limit="an object with the method propose, as undertow.Optimiser has it",
                remedy="Leave it out for the library's optimiser",
            )
        if self.first is not None:
            check_surface(self.mechanism, self.first)
        known = self.known
        if known is not None and known.mechanism is not self.mechanism:
            raise InvalidInputError(
                "belief of the cascade",
                value=f"about '{known.mechanism.name}', another object",
                limit=f"about the cascade's own mechanism, '{self.mechanism.name}'",
                remedy="Write Cascade(rig, belief=Belief.relative(rig, m=0.2))",
            )

    @cached_property
    def known(self) -> Belief | None:
        """What is known of the mechanism; ``None`` where it is exact."""
        if not isinstance(self.belief, Belief):
            one_of("belief of the cascade", self.belief, ("usual", "exact"))
        known = Belief.usual(self.mechanism) if self.belief == "usual" else self.belief
        return known if isinstance(known, Belief) and known.tolerances else None

    @cached_property
    def loop(self) -> ClosedLoop:
        """The predicted closed loop, belief as plant, integrated to its end: the gate's."""
        belief, objective = self.known, self.objective
        return ClosedLoop(
            self.mechanism,
            objective if belief is None else objective.guarded(self.mechanism),
            self.reaching,
            step=self.step,
            zoh_steps=self.zoh_steps,
            ensemble=None if belief is None else belief.ensemble(belief.prior),
            covariance=self.covariance,
            rtol=self.rtol,
            returning=True,
        )

    @checked
    def loop_at(self, state: CascadeState, t: float | None = None) -> ClosedLoop:
        """The predicted closed loop with what is known by now of the plant, about the target.

        Where the target is a reference on its way, it is taken to stay where it is at time t, s, by
        default ``state.since``.
        """
        when = state.since if t is None else t
        return self.about(self._loops(state.estimate), state.target, when)

    @checked
    def believed(self, state: CascadeState) -> Mechanism:
        """The mechanism with the parameters that are estimated by now: the law's."""
        return self._loops(state.estimate).mechanism

    @cached_property
    def _loops_about(self) -> LoopsAbout:
        return LoopsAbout(self.mechanism, self.objective)

    @checked
    def about(self, loop: ClosedLoop, target: ReferenceMotion | None, t: float) -> ClosedLoop:
        """A loop of this cascade about a target, as it is at the time t."""
        return loop if target is None else self._loops_about.loop(loop, target.position(t))

    @cached_property
    def _loops(self) -> Callable[[ParameterEstimate | None], ClosedLoop]:
        """The predicted closed loop for an estimate; the latest are kept."""
        belief, prior = self.known, self.loop

        @lru_cache(maxsize=2)
        def loop(estimate: ParameterEstimate | None) -> ClosedLoop:
            if belief is None or estimate is None or estimate is belief.prior:
                return prior
            return prior.believing(belief.believed(estimate), belief.ensemble(estimate))

        return loop

    @cached_property
    def _recourse(self) -> bool:
        """Whether plans are for the estimate alone, and later decisions mend them for the plant.

        What arrives without sliding in does so on one plant only: no mean over an ensemble says
        what it is worth.  Nor does it bear errors of the state, but a schedule is asked for.
        """
        return (
            self.known is not None
            and self.planner is None
            and (self.freedom.schedule > 0 or self.covariance is None)
            and self.loop.counts_time
        )

    @cached_property
    def _estimated(self) -> Callable[[ParameterEstimate | None], ClosedLoop]:
        """The predicted closed loop of an estimate taken for the plant; the latest are kept."""
        alone = replace(self.loop, ensemble=None)

        @lru_cache(maxsize=2)
        def loop(estimate: ParameterEstimate | None) -> ClosedLoop:
            return alone.believing(self._loops(estimate).mechanism)

        return loop

    @checked
    def learns_from(self, estimator: Estimator) -> bool:
        """Whether an estimator learns what this cascade's belief leaves open, in its units."""
        known, its = self.known, estimator.belief
        return known is not None and its is not None and its.tolerances == known.tolerances

    @checked
    def learn(self, state: CascadeState, t: ArrayLike, x: ArrayLike, u: ArrayLike) -> CascadeState:
        """Return the state with what a recorded piece of motion shows of the plant.

        Parameters
        ----------
        state
            Memory of the cascade.
        t, x, u
            Times, (N,), s; states, (N, 2n); inputs after the actuator, (N, m).
        """
        if self.known is None or state.estimate is None:
            return state
        return replace(state, estimate=self.known.learn(state.estimate, t, x, u))

    @cached_property
    def optimiser(self) -> Optimiser:
        """The optimiser of the outer loop; its rollouts end in the exact linear tail.

        Its steps are twice as long where that resolves the boundary layer: the gate integrates
        what it finds again.  A time of arrival is a matter of milliseconds, and is not searched
        for with longer steps than it is judged with.
        """
        single = self._recourse and self.freedom.schedule > 0
        loop = self._estimated(None) if single else self.loop
        return Optimiser(
            self._for_search(loop),
            self.first, self.cold, self.warm, self.freedom, seed=self.seed,
        )  # fmt: skip

    @cached_property
    def _robust(self) -> Optimiser:
        """The optimiser of plans that suit every plausible plant."""
        if self.optimiser.loop.ensemble is not None or not self._recourse:
            return self.optimiser
        freedom = replace(self.freedom, schedule=0.0)
        return replace(self.optimiser, loop=self._for_search(self.loop), freedom=freedom)

    def _for_search(self, loop: ClosedLoop) -> ClosedLoop:
        """Return a predicted closed loop as the optimiser integrates it."""
        end = loop.linear_end
        smooth = end is not None and end.counts_cost and not self.freedom.reaching
        eta, layer = self.reaching.per_surface(self.mechanism.m)
        slow = 2 * self.step * float((eta / layer).max()) <= RESOLVED
        even = all(round(t / self.step) % 2 == 0 for t in self.freedom.times)
        larger = smooth and slow and even and not any(self.mechanism.disturbance_bounds)
        return loop.with_steps(self.step * (2 if larger else 1), TAIL_RTOL)

    def _planner(
        self, exact: ClosedLoop, target: ReferenceMotion | None = None, t: float = 0.0
    ) -> Planner:
        """Who is asked for plans: ``planner``, or else the optimiser of a predicted closed loop."""
        if self.planner is not None:
            return self.planner
        return self._optimiser_of(exact, target, t)

    def _suited(self, loop: ClosedLoop) -> Optimiser:
        """The optimiser for one plant, or for an ensemble of plausible ones."""
        return self.optimiser if loop.ensemble is None else self._robust

    def _optimiser_of(
        self, exact: ClosedLoop, target: ReferenceMotion | None, t: float
    ) -> Optimiser:
        """The optimiser of a predicted closed loop, about a target."""
        optimiser = self._suited(exact)
        if exact is not self.loop:
            optimiser = optimiser.on(self._for_search(exact))
        if target is None:
            return optimiser
        return self._loops_about.optimiser(optimiser, target.position(t))

    def __repr__(self) -> str:
        """Show what is controlled, for what, and how often it is planned anew."""
        return f"Cascade({self.mechanism.name}, {self.objective.name}, period={self.period:g} s)"

    def __getstate__(self) -> dict[str, Any]:
        """What it was made from: a copy compiles, or finds, the same kernels."""
        made = {field.name: getattr(self, field.name) for field in fields(self)}
        return made | {"objective": self.objective.written(self.mechanism)}

    @cached_property
    def reserve(self) -> tuple[Plan, ...]:
        """Plans that are there without a search: the first surface, reached ever more strongly.

        It bears what it was designed for, and a large s brings its law to the limits of the input
        at once, where the cascade's own reaching law is content with η.
        """
        eta, layer = self.reaching.per_surface(self.mechanism.m)
        laws = [
            replace(self.reaching, eta=tuple(c * eta), layer=tuple(c * layer)) for c in STRONGER
        ]
        return tuple(Plan((self.optimiser.anchor,), (0.0,), (law,)) for law in laws)

    def _standing(
        self, state: CascadeState, loop: ClosedLoop, plan: Plan, error: FloatArray, span: float
    ) -> Plan:
        """The plan in use, or where it does not suit every plausible plant the best in reserve.

        A plan with which a joint sticks suits none.  One that is to be mended need not suit all.
        """
        if loop.ensemble is None:
            return plan
        sticks = self._sticks(state, loop, plan) > 0
        if not sticks and self._mendable(state, loop, plan, error, span):
            return plan
        better = self._better_in_reserve(loop, plan, error.tobytes(), span, sticks)
        return plan if better is None else better

    @cached_property
    def _better_in_reserve(
        self,
    ) -> Callable[[ClosedLoop, Plan, bytes, float, bool], Plan | None]:
        """The plan in reserve that is better than one in use, which may stick; ``None``: none is.

        A decision asks twice, for the search and for the gate: the latest answers are kept.
        """

        @lru_cache(maxsize=2)
        def better(
            loop: ClosedLoop, plan: Plan, error: bytes, span: float, sticks: bool
        ) -> Plan | None:
            x = np.frombuffer(error).reshape(-1, 2 * self.mechanism.n)
            if not sticks and loop.batch(x, plan, duration=span).score(span)[0] < INADMISSIBLE:
                return None
            scores = loop.batch(x, [plan, *self.reserve], duration=span).score(span)
            ranks = [(score >= INADMISSIBLE, False, score) for score in scores]
            ranks[0] = (scores[0] >= INADMISSIBLE, sticks, scores[0])
            best = min(range(len(ranks)), key=ranks.__getitem__)
            return self.reserve[best - 1] if best else None

        return better

    def _mendable(
        self, state: CascadeState, loop: ClosedLoop, plan: Plan, error: FloatArray, span: float
    ) -> bool:
        """Whether a plan brings the estimate home, and may be mended for the plant later on."""
        if not self._recourse:
            return False
        estimated = self._estimated_at(state)
        arrives = estimated.batch(error, plan, duration=span, precise=True).reached[0]
        return bool(arrives) and self._recoverable(loop, error, plan)

    def _recoverable(self, loop: ClosedLoop, error: FloatArray, plan: Plan) -> bool:
        """Whether one in reserve would bring every plausible plant home after the next period."""
        k = sum(t < self.period - 1e-9 for t in plan.times)
        plans = [
            Plan(
                plan.surfaces[:k] + last.surfaces,
                (*plan.times[:k], self.period),
                plan.laws(self.reaching)[:k] + last.laws(self.reaching),
            )
            for last in self.reserve
        ]
        return bool(loop.batch(error, plans).reached.any())

    def _estimated_at(self, state: CascadeState) -> ClosedLoop:
        """The predicted closed loop of the estimate taken for the plant, about the target."""
        return self.about(self._estimated(state.estimate), state.target, state.since)

    @cached_property
    def _bounds_input(self) -> bool:
        """Whether a plan may break a bound on the input between two steps of a prediction."""
        return self.known is not None and (
            self.objective.hard_input or self.loop.objective != self.objective
        )

    def _breaks(
        self, state: CascadeState, plans: list[Plan], error: FloatArray, span: float
    ) -> list[tuple[float, str]]:
        """When each plan breaks a constraint on the estimate, s, and which; infinite: none does.

        An input that changes with the plan may pass its bound and be back within a step: what suits
        every plausible plant at the steps of an ensemble is integrated to the tolerance on one.
        """
        if not self._bounds_input:
            return [(math.inf, "")] * len(plans)
        loop = self._estimated_at(state)
        motions = loop.batch(error, plans, duration=span, precise=True)
        names = [broken_by(loop, motions, k) for k in range(len(plans))]
        ends = zip(motions.time.tolist(), names, strict=True)
        return [(t if name else math.inf, name) for t, name in ends]

    def _sticks(self, state: CascadeState, loop: ClosedLoop, plan: Plan) -> float:
        """How far off a joint sticks on the last surface of a plan; 0 within the terminal set."""
        if not state.disturbance or loop.ensemble is None:
            return 0.0
        law = plan.laws(self.reaching)[-1]
        size = np.array(state.disturbance)
        off = sticking_distance(loop.mechanism, plan.surfaces[-1], size, law)
        return off if off > self.objective.terminal_radius else 0.0

    # -- the state machine ----------------------------------------------------------------

    @checked
    def start(
        self,
        x: ArrayLike,
        target: Target | Mapping[str, float] | None = None,
        t: float = 0.0,
    ) -> tuple[CascadeState, Proposal]:
        """Run the first, global optimisation from x: at the start, and again after a jump of x.

        A target that jumps asks for :meth:`retarget`.

        Parameters
        ----------
        x
            State, (2n,), absolute: what it is off the target is taken off by the cascade, here and
            in every other method.
        target
            Where to, see :meth:`simulate`; x = 0 by default.
        t
            When that is, s.

        Raises
        ------
        InfeasibleError
            When no admissible surface was found.
        InvalidInputError
            For a target that cannot be one, see :meth:`simulate`.
        """
        motion = None if target is None else self._target_at(target, t)
        return self.start_to(self.mechanism.check_state(x), motion, t)

    @checked
    def retarget(
        self,
        state: CascadeState,
        x: ArrayLike,
        target: Target | Mapping[str, float],
        t: float = 0.0,
    ) -> tuple[CascadeState, Proposal]:
        """Go for another target from now on: a new task, optimised as afresh.

        The warm search of :meth:`propose` looks near the plan in use, which was for another way:
        after a jump that may cost many times as much.  The number of the decision goes on, and so
        does what was learnt of the plant: the first plan is best for what is estimated by now.

        Parameters
        ----------
        state
            Memory of the cascade.
        x
            State at the time of the jump, (2n,), absolute.
        target
            Where to now, see :meth:`simulate`.
        t
            When that is, s.

        Raises
        ------
        InfeasibleError
            When no admissible surface was found: the old task may go on.
        InvalidInputError
            For a target that cannot be one.
        """
        return self.start_to(self.mechanism.check_state(x), self._target_at(target, t), t, state)

    def _target_at(self, target: Target | Mapping[str, float], t: float) -> ReferenceMotion:
        """The leg of a target that is in force at the time t."""
        positive("time of a target, s", t, "0 is the start", zero=True)
        legs = legs_of(self.mechanism, self.objective, target, t + self.objective.horizon)
        return [motion for begin, motion in legs if begin <= t][-1]

    def start_to(
        self,
        x: FloatArray,
        target: ReferenceMotion | None = None,
        t: float = 0.0,
        before: CascadeState | None = None,
        longest: float = math.inf,
    ) -> tuple[CascadeState, Proposal]:
        """:meth:`start`, or :meth:`retarget` from ``before``, to a leg that was checked before.

        The first plan is to arrive within ``longest``, s, where one does, else within the
        objective's horizon.
        """
        absolute, horizon = x, min(longest, self.objective.horizon)
        short = horizon < self.objective.horizon
        if target is not None:
            x = self.mechanism.check_state(x) - target.state(t)
        number, known = 0, None if self.known is None else self.known.prior
        if before is not None:
            number, known = before.sequence + 1, before.estimate or known
        whole = self._loops(known)
        here = self.about(whole, target, t)
        here.objective.check_start(here.mechanism, x)
        # Where nothing suits every plausible plant, what brings home the estimate, without room for
        # any error: to learn which of the plants it is takes less time than to fall.
        single = None
        if self.known is not None and known is not None:
            single = whole.believing(whole.mechanism, self.known.single(known))
        last = [] if single is None else [(single, None)]
        tries: list[FirstTry] = []
        for loop, fixed in [*self._first_tries(known), *last]:
            if loop is single and tries[-1].proposal.plan is not None:
                break
            about, planner = self.about(loop, target, t), self._planner(loop, target, t)
            if fixed is not None:
                planner = self._suited(fixed).on(self.about(fixed, target, t))
            proposal = planner.propose(
                x, incumbent=None, horizon=horizon if short else None, sequence=0, computed_for=t,
                resolution=0.0,
            )  # fmt: skip
            plan = proposal.plan
            if plan is None:
                tries.append(FirstTry(3, math.inf, proposal))
                continue
            cost = float(about.batch(x, plan, duration=horizon, precise=True).score(horizon)[0])
            cost = cost if cost < INADMISSIBLE else math.inf
            begun = CascadeState(plan, number, cost, cost, t, _kept(x), known, target)
            good = math.isfinite(cost) and math.isinf(self._breaks(begun, [plan], x, horizon)[0][0])
            if loop is not whole:  # every plausible plant lives to see the next decision
                lives = self._survives if loop.ensemble is not None else self._recoverable
                good &= lives(here, x, plan)
            if loop.ensemble is None and self.planner is None:
                good &= cost <= AGREES * proposal.cost
            tries.append(FirstTry(0 if good else 1 if loop is whole else 2, cost, proposal))
            if good:
                break
        best = min(tries, key=lambda one: (one.rank, one.cost))
        if best.proposal.plan is None and short:
            return self.start_to(absolute, target, t, before)
        cost, proposal = best.cost, best.proposal
        plan = proposal.required(here, x).plan
        assert plan is not None  # required
        if target is not None and target.moves:
            plan, cost = self._first_along(whole, plan, x, target, t, horizon)
        begun = CascadeState(plan, number, cost, cost, t, _kept(x), known, target)
        return begun, replace(proposal, sequence=number)

    def _first_along(
        self, loop: ClosedLoop, plan: Plan, error: FloatArray, target: ReferenceMotion, t: float,
        horizon: float,
    ) -> tuple[Plan, float]:  # fmt: skip
        """The first plan, or the designed surface where that is better along a reference."""
        plans = [plan, Plan.of(self.optimiser.anchor)]
        costs = _costs_along(loop, error, plans, target, t, horizon)
        best = int(np.argmin(costs))
        return plans[best], costs[best]

    def _first_tries(
        self, estimate: ParameterEstimate | None
    ) -> list[tuple[ClosedLoop, ClosedLoop | None]]:
        """What the first plan is to be best on, one after the other; and in what steps, if fixed.

        Before anything has moved, what suits every plausible plant suits none of them well: the
        estimate alone comes first, for a plan that the next decision replaces; a schedule for it
        without any error before.  Where its plan does not do what it promised, small steps
        throughout follow: for one plant, which is integrated to the tolerance, smaller ones than
        usual.
        """
        whole = self._loops(estimate)
        if self.planner is not None:
            return [(whole, None)]
        loops = [whole]
        if self.known is not None and estimate is not None:
            loops.insert(0, whole.believing(whole.mechanism, self.known.alone(estimate)))
        if self._recourse and self.freedom.schedule:
            loops.insert(0, self._estimated(estimate))

        def smaller(loop: ClosedLoop) -> ClosedLoop:
            adapts = loop.ensemble is None and not self.zoh_steps
            return loop.with_steps(self.step / FINER, 0.0) if adapts else loop

        return [(loop, fixed) for loop in loops for fixed in (None, smaller(loop))]

    def _judged(
        self, loop: ClosedLoop, old: Plan, new: Plan, x: FloatArray, span: float
    ) -> Admission:
        """What the gate says of a plan, in the place of an old one."""
        said = self.gate(loop, old, new, x, span)
        if not isinstance(said, Admission):
            raise InvalidInputError(
                "what the gate of the cascade returned",
                value=f"{said!r}, a {type(said).__name__}",
                limit="an undertow.cascade.Admission",
                remedy="Return one: of undertow.cascade.cost_gate, with conditions of your own",
            )
        return said

    @checked
    def first_admission(self, state: CascadeState, x: ArrayLike, horizon: float) -> Admission:
        """Put the first plan before the gate: there is no other, so it is used all the same.

        The admission says what the gate would have said; ``accepted`` is always true.
        """
        current = state.error(state.since, self.mechanism.check_state(x))
        loop, plan = self.loop_at(state), state.plan
        if self._mendable(state, loop, plan, current, horizon):
            loop = self._estimated_at(state)
        asked = self._judged(loop, plan, plan, current, horizon)
        reason = "first optimum" if asked.accepted else f"first optimum, although {asked.reason}"
        return Admission(True, reason, state.predicted, asked.verdict)

    @checked
    def control(self, state: CascadeState, t: float, x: ArrayLike) -> Control:
        """Fast step: the input at (t, x) on the surface in use; never NaN, never past limits.

        While the target moves, its acceleration is fed forward: ṡ = −K sw(s/ε) holds on the
        way, too.  It follows the plan in use wherever x is: a target that jumps asks for
        :meth:`retarget`.
        """
        surface, law = state.plan.at(t - state.since)
        believed = self.believed(state)
        if state.target is not None:
            x = state.error(t, self.mechanism.check_state(x))
            believed = state.target.error_dynamics(believed, t)
        return SlidingModeLaw(believed, surface, law or self.reaching)(t, x)

    @checked
    def predicted_error(
        self, state: CascadeState, error: FloatArray, t: float, until: float
    ) -> FloatArray:
        """Return how far off the target the plan in use will have left the state, (2n,).

        Parameters
        ----------
        state
            Memory of the cascade.
        error
            How far the state is off the target, (2n,), at the time t, s.
        t, until
            From when to when, s.  NaN where a motion along a reference breaks off before.
        """
        plan, target = state.at(t), state.target
        if target is None or not target.moves:
            batch = self.loop_at(state, t).batch(error, plan, duration=until - t, terminal=0.0)
            return np.asarray(batch.x[0])
        loop, x = self.loop_at(replace(state, target=None)), state.absolute(t, error)
        motion = simulate_along(loop, x, plan, target, duration=until - t, start=t)
        if motion.event not in (Event.HORIZON, Event.REACHED):
            return np.full_like(error, math.nan)
        return state.error(until, motion.x[-1])

    @checked
    def propose(
        self, state: CascadeState, x: ArrayLike, t: float = 0.0, horizon: float | None = None
    ) -> Proposal:
        """Slow step: re-optimise from x, warm-started; an exception becomes a status.

        Parameters
        ----------
        state
            Memory of the cascade.
        x
            State that the plan is for, (2n,).
        t
            When that is, s.
        horizon
            Time that is left, s.  Without it the plan looks the whole of the objective's horizon
            ahead, each time anew: a task that is to be done by a time needs what is left until
            then, or its end recedes for ever and least energy puts off arriving.

        Notes
        -----
        The search is warm: it looks near the plan in use.  Where the state has jumped, or the
        target, the optimum may be far from it: :meth:`apply_gate` says so, :meth:`retarget` finds
        it.  Of a target that moves, the search leaves the motion out: it sees the error, and the
        target at rest where it is at the time t.  :meth:`apply_gate` sees the motion.
        """
        return self._propose(state, x, t, horizon)

    def _propose(
        self, state: CascadeState, x: ArrayLike, t: float, horizon: float | None
    ) -> Proposal:
        sequence = state.sequence + 1
        try:
            error = state.error(t, self.mechanism.check_state(x))
            span = self.objective.horizon if horizon is None else horizon
            here, loop, used = replace(state, since=t), self.loop_at(state, t), state.at(t)
            ask: dict[str, Any] = {
                "horizon": horizon,
                "sequence": sequence,
                "computed_for": t,
                "resolution": self.resolution * state.scale,
            }
            if self._recourse:
                optimiser = self._optimiser_of(self._estimated(state.estimate), state.target, t)
                admits = partial(self._recoverable, loop, error)
                first = state.predicted == state.scale  # nothing was decided since
                promised = 0.0 if first else state.predicted - (t - state.since)
                found = optimiser.propose(
                    error, incumbent=used, admits=admits, promised=promised, **ask
                )
                plans = [used] if found.plan is None else [found.plan, used]
                if any(self._mendable(here, loop, plan, error, span) for plan in plans):
                    return found
            planner = self._planner(self._loops(state.estimate), state.target, t)
            standing = self._standing(here, loop, used, error, span)
            return planner.propose(error, incumbent=standing, **ask)
        except Exception as error:  # the inner loop must survive whatever the outer loop does
            said = error_text(error)
            return Proposal(None, "failed", math.inf, math.inf, (), 0, 0.0, sequence, t, said)

    @checked
    def apply_gate(
        self,
        state: CascadeState,
        proposal: Proposal,
        x: ArrayLike,
        horizon: float | None = None,
    ) -> tuple[CascadeState, Admission]:
        """Pass a proposal through the gate; the last good surface stays unless it is admitted.

        Proposals that are not newer than the last one considered are refused.  ``horizon`` is
        the time that is left, s, as for :meth:`propose`.

        Where the positions of x are farther from those that the plan in use predicted for this
        moment than ``JUMP`` = 0.1 rad or m and ``PART`` = half of the way that it was to move them
        since, the admission's reason says so: after a jump the cost is compared with that of a plan
        for another task, and "cost not raised" is little.

        Where the plan in use does not suit every plausible plant and one in :attr:`reserve` does,
        or is survived longer, that one is compared with, and takes over unless the proposal does.
        For least time, where states are exact or with a schedule, it need not suit them: it is
        judged on the estimate, as long as one in reserve would bring all of them home after the
        next period.

        Where the target moves, what the gate admits is also rolled out along the reference, as is
        the plan in use: constraints have to hold there, and the cost must not rise.
        """
        span = self.objective.horizon if horizon is None else horizon
        current = self.mechanism.check_state(x)
        if proposal.sequence <= state.sequence:
            stale = f"stale: number {proposal.sequence} after {state.sequence}"
            return state, Admission(False, stale, state.predicted)
        t = proposal.computed_for
        current = state.error(t, current)
        jump = self._jump(state, t, current)
        loop = self.loop_at(state, t)
        used = state.at(t)
        old = self._standing(replace(state, since=t), loop, used, current, span)
        state = replace(state, plan=old, since=t, sequence=proposal.sequence, x=_kept(current))
        mends, mended = (
            plan is not None and self._mendable(state, loop, plan, current, span)
            for plan in (old, proposal.plan)
        )
        judge = self._estimated_at(state) if mends or mended else loop
        if proposal.plan is None or (mends and not mended):
            kept = self._judged(judge, old, old, current, span)
            reason = f"{proposal.status}: {proposal.message or 'no surface'}{jump}"
            if proposal.plan is not None:
                reason = f"some plausible plant would not come home after another period{jump}"
            admission = replace(kept, accepted=False, reason=reason)
            return replace(state, predicted=kept.cost), _reserved(admission, old, used)
        admission = self._judged(judge, old, proposal.plan, current, span)
        off = self._sticks(state, loop, proposal.plan) if admission.accepted else 0.0
        if off > self._sticks(state, loop, old):
            cost = self._judged(loop, old, old, current, span).cost
            most = f"{self.objective.terminal_radius:g} at most"
            words = f"a joint that sticks is freed by {off:.3g} of the others, {most}"
            admission = Admission(False, words, cost)
        if admission.accepted:
            (before, _), (end, name) = self._breaks(state, [old, proposal.plan], current, span)
            if end < before:
                cost = self._judged(loop, old, old, current, span).cost
                words = f"breaks {name} between two steps, at {end:.3g} s"
                admission = Admission(False, words, cost)
        if state.target is not None and state.target.moves:
            admission = self._along(state, old, proposal.plan, admission, span)
        admission = replace(admission, reason=f"{admission.reason}{jump}")
        plan = proposal.plan if admission.accepted else old
        admission = _reserved(admission, plan, used)
        return replace(state, plan=plan, predicted=admission.cost), admission

    def _along(
        self, state: CascadeState, old: Plan, new: Plan, admission: Admission, span: float
    ) -> Admission:
        """Judge again what the gate admitted: both plans along the reference, as it will move."""
        assert state.target is not None  # there is no reference without one
        loop, error = self._loops(state.estimate), np.array(state.x)
        plans = [old, new] if admission.accepted else [old]
        costs = _costs_along(loop, error, plans, state.target, state.since, span)
        if not admission.accepted:
            return replace(admission, cost=costs[0])
        cost, found = costs
        if found <= cost and found < math.inf:
            return replace(admission, cost=found)
        words = f"raises the cost along the reference: {found:.6g} > {cost:.6g}"
        return Admission(False, words, cost, admission.verdict)

    def _jump(self, state: CascadeState, t: float, x: FloatArray) -> str:
        """Say how far a state is off what the plan in use predicted for it, where it is far."""
        if not state.x or not 0 <= t - state.since <= self.objective.horizon:
            return ""
        span = round((t - state.since) / self.step) * self.step
        ahead = self.loop_at(state).batch(state.x, state.plan, duration=span, terminal=0.0).x[0]
        n = self.mechanism.n
        off = float(np.linalg.norm((x - ahead)[:n]))
        moved = float(np.linalg.norm((ahead - state.x)[:n]))
        if not off > JUMP + PART * moved:  # a prediction that ended in NaN says nothing
            return ""
        return f"; the state is {off:.3g} off the plan's prediction: after a jump, call start again"

    @checked
    def survives(self, state: CascadeState, x: ArrayLike, t: float) -> bool:
        """Whether every plausible plant lives to see the next decisions with the plan in use.

        What is learnt between two decisions may show that it does not: then it is time for the
        next one.  Without an ensemble there is nothing to learn, and the answer is yes.

        Parameters
        ----------
        state
            Memory of the cascade.
        x
            Present state, (2n,), absolute.
        t
            When that is, s.
        """
        loop = self.loop_at(state, t)
        if loop.ensemble is None:
            return True
        return self._survives(loop, state.error(t, self.mechanism.check_state(x)), state.at(t))

    def _survives(self, loop: ClosedLoop, error: FloatArray, plan: Plan) -> bool:
        event = loop.batch(error, plan, duration=2 * self.period).event[0]
        return event in (Event.HORIZON, Event.REACHED)

    # -- simulation -----------------------------------------------------------------------

    @property
    def stride(self) -> float:
        """Time between two inputs of the inner loop, or a step of a continuous one, s."""
        return self.step * max(1, self.zoh_steps)

    @checked
    def simulate(
        self,
        x0: StateLike | None = None,
        *,
        plant: Mechanism | Mapping[float, Mechanism] | None = None,
        duration: float | None = None,
        target: Target | Mapping[str, float] | None = None,
        progress: Callable[[float, float], None] | None = None,
        **state: float,
    ) -> Run:
        """Simulate the cascade until the terminal set is reached.

        Parameters
        ----------
        x0
            Initial state, (2n,); or give its non-zero entries by name, ``phi=0.7`` or
            ``{"phi": 0.7}``.  With neither, the mechanism's usual ``start``, where it has one.
        plant
            The truth; the belief by default.  One that changes while it runs is a mapping from the
            time, s, to what the plant is from then on.
        duration
            Longest run, s; the objective's horizon by default.  Predictions end there too, but
            for a first plan where none arrives so soon.
        target
            Where to, x = 0 by default: a mapping of coordinates to positions, rad or m;
            :class:`undertow.SetPoints`, which jump; or a :class:`undertow.Reference`, which moves.
            With a duration the run then goes on to its end, holding what it has reached; without
            one until the last set-point, or the end of a horizon.  See
            :mod:`undertow.cascade.simulation`.
        progress
            Called with (time, duration) each time that it decides or learns.

        Raises
        ------
        InfeasibleError
            When the first optimisation finds no admissible surface.
        InvalidInputError
            For an unknown state name, a state that is not finite, or no start at all; for a target
            where the mechanism cannot rest or go, before anything moves.
        """
        x = self.mechanism.initial_state(x0, state)
        legs, truths = legs_to(self, target, duration), moving_loops(self, plant)
        updates: list[Update] = []
        pieces: list[Trajectory] = []
        memory: CascadeState | None = None
        planned_with: ParameterEstimate | None = None
        truth, task, arrived = truths[0], -1, False
        spent = since = 0.0  # cost since the last decision; when it was last at the target, s
        for leg, t, span, due in moments(self, legs, truths):
            truth = truths.get(round(t / self.stride), truth)
            proposal: Proposal | None = None
            if memory is None or t == leg.begin:
                since = t
                memory, proposal = self.start_to(x, leg.target, t, memory, leg.longest)
                admission = self.first_admission(memory, x, leg.longest)
            elif np.linalg.norm(memory.error(t, x)) <= self.objective.terminal_radius:
                since = t
            elif due or is_news(planned_with, memory.estimate) or not self.survives(memory, x, t):
                left = leg.longest - (t - since)
                if left <= 0.5 * self.step:  # a disturbed plant came too late: a new horizon
                    since, left = t, leg.longest
                proposal = self._propose(memory, x, t, left)
                memory, admission = self.apply_gate(memory, proposal, x, left)
            if proposal is not None:
                task += t == leg.begin or arrived  # left what was reached: another task
                plan, predicted = memory.plan, memory.predicted
                updates.append(Update(t, x, proposal, admission, plan, predicted, spent, task))
                spent, planned_with = 0.0, memory.estimate
            pieces.append(simulate_piece(self, truth, memory, x, t, span, leg.stays))
            motion = pieces[-1]
            memory = self.learn(memory, motion.t, motion.x, motion.u)
            x, spent, arrived = motion.x[-1], spent + motion.cost, motion.event == Event.REACHED
            if progress is not None:
                progress(t + span, legs[-1].end)
            if not (motion.event == Event.HORIZON or (arrived and leg.stays)):
                break
        return Run(Trajectory.join(pieces), tuple(updates))


def _reserved(admission: Admission, plan: Plan, used: Plan) -> Admission:
    """The admission of the plan that stays; where one in reserve took over, that is admitted."""
    if admission.accepted or plan is used:
        return admission
    return replace(admission, accepted=True, reason=f"a plan in reserve: {admission.reason}")


def _kept(x: FloatArray) -> tuple[float, ...]:
    """Return a state as plain numbers; several of them are none."""
    return tuple(x.tolist()) if x.ndim == 1 else ()


def _costs_along(
    loop: ClosedLoop, error: FloatArray, plans: list[Plan], target: ReferenceMotion, t: float,
    span: float,
) -> list[float]:  # fmt: skip
    """What each plan costs along a reference from t on, s; infinite where the motion breaks off."""
    x = error + target.state(t)
    runs = [simulate_along(loop, x, plan, target, duration=span, start=t) for plan in plans]
    return [run.cost if run.event in (Event.HORIZON, Event.REACHED) else math.inf for run in runs]
