"""The two-rate cascade: sliding-mode law inside, surface optimiser outside, a gate between.

The cascade is a pure state machine: it holds no clock and no thread, and every decision is
a function of its arguments, so a recorded run can be replayed.  The runtime, or
:meth:`Cascade.simulate`, supplies the time.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, Literal, cast

from numpy.typing import ArrayLike

from undertow.base import (
    InvalidInputError,
    a_kind,
    at_least,
    between,
    check_fields,
    checked,
    checked_names,
    instant,
    one_of,
    positive,
)
from undertow.cascade.judge import Judge
from undertow.cascade.planners import Planners, searched
from undertow.cascade.planning import Planning
from undertow.cascade.predictions import Predictions
from undertow.cascade.reserve import Reserve, speed_of
from undertow.cascade.simulation import (
    Run,
    Update,
    is_news,
    legs_to,
    moments,
    moving_loops,
    simulate_piece,
)
from undertow.cascade.state import CascadeState
from undertow.cascade.targets import legs_of
from undertow.closed_loop import RTOL, ClosedLoop, Event, Trajectory
from undertow.closed_loop.gate import Admission, Gate, cost_gate
from undertow.closed_loop.rollout import MOST_STEPS
from undertow.estimators import Belief, Estimator, ParameterEstimate
from undertow.law import (
    SUITED,
    Control,
    Plan,
    ReachingLaw,
    ReferenceMotion,
    SlidingModeLaw,
    Surface,
    Target,
    check_surface,
    usual_reaching,
)
from undertow.models import TIME, FloatArray, Mechanism, StateLike, number_of
from undertow.objective import Objective, objective_for
from undertow.optimiser import Budget, DecisionVariables, Optimiser, Planner, Proposal

#: Stands for the objective that is meant where nobody says, until the mechanism is known.
_USUAL = cast(Objective, None)


@checked_names
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
        Reaching law of the inner loop; by default :func:`undertow.law.usual_reaching`: the paper's,
        its boundary layer as thick as the mechanism's disturbance bounds ask for.
    period
        Δt between re-optimisations, s; of a run on a rig the lead time where no settings say
        another, see :func:`undertow.run`.
    first
        First surface, checked; designed by itself by default.
    step, zoh_steps
        Runge-Kutta step of the search's rollouts, s, and steps per sample of the inner loop
        (0: continuous), as for :class:`undertow.ClosedLoop`.
    freedom
        What may be chosen besides the paper's surface parameters: reaching gains, a
        schedule of surfaces.  Times of a schedule are multiples of the period.  By default the
        rates at which surfaces are reached, too, where the cost weighs errors as ``effort`` does,
        or more, see :meth:`undertow.DecisionVariables.for_loop`.  With reaching gains
        a smooth cost comes near the bound of each plant, by laws so gentle that friction which
        nobody estimates may keep them from arriving.
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
        home after a period.  The first of these decisions begins, too, with what the first search
        found to be best for the estimate by then.
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
    reaching: ReachingLaw = SUITED
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
        if self.reaching is None:
            check_fields(self, "mechanism", "first", "step", "zoh_steps")
            positive("rollout step, s", self.step)
            sample = self.step * max(1, self.zoh_steps)
            law = usual_reaching(self.mechanism, self.first, period=sample)
            object.__setattr__(self, "reaching", law)
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
        longest = 0.5 * MOST_STEPS * self.loop.step  # two of them are looked ahead
        if not (count > 0.5 and self.period <= longest and abs(count - round(count)) < 1e-6):
            raise InvalidInputError(
                "period of the cascade",
                value=f"{self.period:g} s",
                limit=f"a whole multiple of the inner step, {stride:g} s, up to {longest:g} s",
                remedy="Change the period, or the step",
            )
        if any(abs(t / self.period - round(t / self.period)) > 1e-6 for t in self.freedom.times):
            raise InvalidInputError(
                "times of a schedule",
                value=self.freedom.times,
                limit=f"multiples of the period, {self.period:g} s",
                remedy="Then what is left of a plan is a plan again",
            )
        horizon, latest = self.objective.horizon, max(self.freedom.schedule, *self.freedom.times)
        remedy = f"The period, {self.period:g} s, is usual; or take a longer horizon"
        between("schedule of the cascade", latest, 0.0, horizon, "s", remedy)
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
                value=f"{self.planner!r}, {a_kind(self.planner)}",
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

    @cached_property
    def recourse(self) -> bool:
        """Whether plans are for the estimate alone, and later decisions mend them for the plant.

        What arrives without sliding in does so on one plant only: no mean over an ensemble says
        what it is worth.  And what suits every plausible plant costs more than what is planned
        anew as the plant is learnt.  But such plans do not bear errors of the state, so single
        surfaces have recourse where states are exact; schedules have it for least time alone.
        """
        scheduled = self.freedom.schedule > 0
        bears = self.loop.price_of_time > 0 if scheduled else self.covariance is None
        return self.known is not None and self.planner is None and bears

    # -- what it is made of -----------------------------------------------------------------

    @cached_property
    def predictions(self) -> Predictions:
        """The loops that it predicts with."""
        return Predictions(self.loop, self.known, self.objective)

    @cached_property
    def optimiser(self) -> Optimiser:
        """The optimiser of the outer loop; its rollouts end in the exact linear tail."""
        single = self.recourse and self.freedom.schedule > 0
        loop = self.predictions.estimated(None) if single else self.loop
        return Optimiser(
            searched(loop, self.freedom),
            self.first, self.cold, self.warm, self.freedom.for_loop(loop), seed=self.seed,
        )  # fmt: skip

    @cached_property
    def _reserve(self) -> Reserve:
        return Reserve(self.optimiser.anchor, self.reaching, self.period)

    @property
    def reserve(self) -> tuple[Plan, ...]:
        """Plans that are there without a search: the first surface, reached ever more strongly."""
        return self._reserve.plans

    @checked
    def prepared(self, state: CascadeState, x: ArrayLike) -> CascadeState:
        """Choose what takes over when velocities jump, by rollouts; return it with the memory.

        One plan for each of some speeds to which they may jump.

        Candidates are the plan in use, then the first optimum from x, (2n,), and those of
        :attr:`reserve`, both reached ever more strongly.  Who steers a plant that may be pushed
        asks for it after each first plan: before the run, and for every other target.
        """
        error = state.error(state.since, self.mechanism.check_state(x))
        known = state.estimate
        loop = self.predictions.single(known) or self.predictions.plausible(known)
        loop = self.about(loop, state.target, state.since)  # whose travel is not counted from it
        return replace(state, after_jump=self._reserve.after_jump(loop, state.plan, error))

    @checked
    def after_jump(self, state: CascadeState, error: FloatArray) -> Plan:
        """Return the plan that takes over when velocities have jumped, see :meth:`prepared`.

        ``error`` is how far the state is off the target since, (2n,).
        """
        if not state.after_jump:
            return self.reserve[-1]
        speed = speed_of(self.mechanism, error[self.mechanism.n :])
        slower = (plan for most, plan in state.after_jump if speed <= most)
        return next(slower, state.after_jump[-1][1])

    @cached_property
    def _judge(self) -> Judge:
        return Judge(self.predictions, self._reserve, self.gate, self.objective, self.recourse)

    @cached_property
    def _planning(self) -> Planning:
        planners = Planners(self.predictions, self.optimiser, self.planner, self.recourse)
        return Planning(planners, self._judge, self.resolution)

    # -- what it knows ----------------------------------------------------------------------

    @checked
    def loop_at(self, state: CascadeState, t: float | None = None) -> ClosedLoop:
        """The predicted closed loop with what is known by now of the plant, about the target.

        Where the target is a reference on its way, it is taken to stay where it is at time t, s, by
        default ``state.since``.
        """
        return self.predictions.at(state, state.since if t is None else t)

    @checked
    def believed(self, state: CascadeState) -> Mechanism:
        """The mechanism with the parameters that are estimated by now: the law's."""
        return self.predictions.plausible(state.estimate).mechanism

    @checked
    def about(self, loop: ClosedLoop, target: ReferenceMotion | None, t: float) -> ClosedLoop:
        """A loop of this cascade about a target, as it is at the time t."""
        return self.predictions.about(loop, target, t)

    @checked
    def learns_from(self, estimator: Estimator) -> bool:
        """Whether an estimator learns what this cascade's belief leaves open, in its units."""
        known, its = self.known, estimator.belief
        return known is not None and its is not None and its.tolerances == known.tolerances

    @checked
    def learn(
        self, state: CascadeState, t: ArrayLike, x: ArrayLike, u: ArrayLike, held: bool = False
    ) -> CascadeState:
        """Return the state with what a recorded piece of motion shows of the plant.

        Parameters
        ----------
        state
            Memory of the cascade.
        t, x, u
            Times, (N,), s; states, (N, 2n); inputs after the actuator, (N, m).
        held
            Whether the input is held from row to row; it runs straight otherwise.
        """
        if self.known is None or state.estimate is None:
            return state
        return replace(state, estimate=self.known.learn(state.estimate, t, x, u, held))

    def __repr__(self) -> str:
        """Show what is controlled, for what, and how often it is planned anew."""
        return f"Cascade({self.mechanism.name}, {self.objective.name}, period={self.period:g} s)"

    def __getstate__(self) -> dict[str, Any]:
        """What it was made from: a copy compiles, or finds, the same kernels."""
        made = {field.name: getattr(self, field.name) for field in fields(self)}
        return made | {"objective": self.objective.written(self.mechanism)}

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
            For a target that cannot be one, see :meth:`simulate`; a time that is not finite.
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
    ) -> tuple[CascadeState, Proposal]:
        """:meth:`start`, or :meth:`retarget` from ``before``, to a leg that was checked before."""
        instant(t)
        return self._planning.first(x, target, t, before)

    @checked
    def first_admission(self, state: CascadeState, x: ArrayLike, horizon: float) -> Admission:
        """Put the first plan before the gate: there is no other, so it is used all the same.

        The admission says what the gate would have said; ``accepted`` is always true.
        """
        error = state.error(state.since, self.mechanism.check_state(x))
        return self._judge.first(state, error, horizon)

    @checked
    def control(self, state: CascadeState, t: float, x: ArrayLike) -> Control:
        """Fast step: the input at (t, x) on the surface in use; never NaN, never past limits.

        While the target moves, its acceleration is fed forward: ṡ = −K sw(s/ε) holds on the
        way, too.  It follows the plan in use wherever x is: a target that jumps asks for
        :meth:`retarget`.
        """
        instant(t)
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
        return self.predictions.error_at(state, error, t, until)

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
        instant(t)
        return self._planning.next(state, x, t, horizon)

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

        A plan in use that brings the estimate home stays as long as one in :attr:`reserve` would
        bring every plausible plant home after the next period.  Else, where it does not suit all of
        them and one in reserve does, or is survived longer, that one is compared with, and takes
        over unless the proposal does.  A proposal has to suit them all; but where states are exact,
        or for least time with a schedule, it is judged as the plan in use is, both on the estimate.
        Where states have errors, but for that least time, and the last prediction was off by more
        than three tenths of the cost, it also has to gain three tenths of that: less is within the
        errors of prediction.  And a plan in use that some plausible plant does not bear to the end,
        but that can be left for one in reserve a period later, gives way to none that costs the
        estimate a tenth more.

        Where the target moves, what the gate admits is also rolled out along the reference, as is
        the plan in use: constraints have to hold there, and the cost must not rise.
        """
        span = self.objective.horizon if horizon is None else horizon
        current = self.mechanism.check_state(x)
        if proposal.sequence <= state.sequence:
            stale = f"stale: number {proposal.sequence} after {state.sequence}"
            return state, Admission(False, stale, state.predicted)
        error = state.error(proposal.computed_for, current)
        return self._judge.decide(state, proposal, error, span)

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
        return self._judge.survives(
            loop, state.error(t, self.mechanism.check_state(x)), state.at(t)
        )

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
            With a duration the run then goes on to its end, holding what it has reached, see
            :mod:`undertow.cascade.holding`; without one until the last set-point, or the end of a
            horizon.  See :mod:`undertow.cascade.simulation`.
        progress
            Called with (time, duration) before the first search and after it, at the time 0, and
            then each time that it decides or learns.

        Raises
        ------
        InfeasibleError
            When the first optimisation finds no admissible surface.
        InvalidInputError
            For an unknown state name, a state that is not finite, or no start at all; for a target
            where the mechanism cannot rest or go, or that is due after the end of the run, before
            anything moves.
        """
        x = self.mechanism.initial_state(x0, state)
        legs, plants = legs_to(self, target, duration), moving_loops(self, plant)
        updates: list[Update] = []
        pieces: list[Trajectory] = []
        memory: CascadeState | None = None
        planned_with: ParameterEstimate | None = None
        truth, task, arrived = plants[0], -1, False
        holding = self._planning.planners.holding
        spent = since = 0.0  # cost since the last decision; when it was last at the target, s
        for leg, t, span, due in moments(self, legs, plants):
            truth = plants.get(round(t / self.stride), truth)
            proposal: Proposal | None = None
            home = memory is not None and holding.at_home(memory, memory.error(t, x), t)
            if t == leg.begin or home or arrived:  # to leave what was reached begins another task
                since = t
            if progress is not None and memory is None:
                progress(0.0, legs[-1].end)
            if memory is None or t == leg.begin:
                memory, proposal = self._planning.first(x, leg.target, t, memory, leg.longest)
                admission = self.first_admission(memory, x, leg.longest)
            elif home:
                if leg.stays:
                    proposal = self._planning.hold(memory, memory.error(t, x), t)
                if proposal is not None:
                    memory, admission = self.apply_gate(memory, proposal, x, leg.longest)
            elif due or is_news(planned_with, memory.estimate) or not self.survives(memory, x, t):
                left = leg.longest - (t - since)
                if left <= 0.5 * self.step:  # a disturbed plant came too late: a new horizon
                    since, left = t, leg.longest
                proposal = self._planning.next(memory, x, t, left)
                memory, admission = self.apply_gate(memory, proposal, x, left)
            if proposal is not None:
                begins = t == leg.begin or not home  # to hold what was reached begins no task
                task += not updates or (begins and since > updates[-1].t)
                plan, predicted = memory.plan, memory.predicted
                updates.append(Update(t, x, proposal, admission, plan, predicted, spent, task))
                spent, planned_with = 0.0, memory.estimate
            if progress is not None and not pieces:
                progress(0.0, legs[-1].end)
            pieces.append(simulate_piece(self, truth, memory, x, t, span, leg.stays))
            motion = pieces[-1]
            memory = self.learn(memory, motion.t, motion.x, motion.u, held=self.zoh_steps > 0)
            x, spent, arrived = motion.x[-1], spent + motion.cost, motion.event == Event.REACHED
            if progress is not None:
                progress(t + span, legs[-1].end)
            if not (motion.event == Event.HORIZON or (arrived and leg.stays)):
                break
        return Run(Trajectory.join(pieces), tuple(updates))
