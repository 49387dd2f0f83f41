"""Closed loops in batches: law and plant, continuous or sampled, with costs and events.

The controller's *belief* (the model its law was derived from) and the *truth* (the plant
that moves) are separate arguments everywhere; by default they are the same.

Rollouts are read from buffers and written there (:mod:`undertow.closed_loop.buffers`).  They go in
small Runge-Kutta steps until the law is in its boundary layer and then, where the loop has a
linear model, in large ones (:mod:`undertow.closed_loop.exponential_integrator`).  Motions that
are shown or that decide are integrated to a tolerance, see
:mod:`undertow.closed_loop.adaptive_integrator`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from undertow.base import (
    InvalidInputError,
    at_least,
    between,
    check_fields,
    checked,
    checked_names,
    floats,
    positive,
    require,
)
from undertow.closed_loop.adaptive_integrator import follow
from undertow.closed_loop.buffers import NOTHING, RolloutBuffers
from undertow.closed_loop.ensemble import TAIL, Ensemble, summarise
from undertow.closed_loop.exponential_integrator import GIVEN_BACK
from undertow.closed_loop.kernel import LoopEquations, compile_look, compile_loop
from undertow.closed_loop.linear_model import Prepared, TerminalLinearModel, quadratic_stage
from undertow.closed_loop.threads import shared
from undertow.closed_loop.trajectory import Batch, Event, Trajectory, recorded
from undertow.closed_loop.work_array import LANES
from undertow.law import (
    OVERSHOOTS,
    SUITED,
    LawLayout,
    Plan,
    ReachingLaw,
    Surface,
    check_surface_shape,
    coupling,
    gains_at_target,
    usual_reaching,
)
from undertow.models import FloatArray, Mechanism, has_linear_model, steps_in
from undertow.objective import MinimumEnergy, Objective
from undertow.objective.objective import real_value

#: Relative tolerance of motions that are shown, and that decide.
RTOL = 1e-9

#: The least and the largest that may be asked for: below rounding no step is short enough, and a
#: coarse one sees neither corner nor constraint.
TOLERANCES = 1e-13, 1e-2

#: Longest Runge-Kutta step of a batch in time constants of the plant's fastest mode: beyond 2.7 of
#: them what has long died out would grow.
STABLE = 1.5

#: The smallest margin at the target that the price of being outside of a constraint is made from.
LEAST_ROOM = 1e-9

#: By how much of its margin at the target a constraint may be passed in such a motion: about what
#: the steps of a search, which goes up to its bounds, place a motion wrongly by.
ALLOWED = 1e-4

#: Longest rollout, in steps.
MOST_STEPS = 10_000_000

#: By how much of a step a duration may miss a whole number of them, for rounding.
ROUNDING = 1e-6

#: Small steps before large ones are tried again, s; each time as long again as all before.
CALMER = 0.5

#: Part of its time that a motion counts as near the target, where noise costs what the gains there
#: make of it.  Twice or four times as much costs no less on a rig, and makes surfaces so soft that
#: dry friction moves more than noise did.
NEAR = 0.25

#: Switch steps of a single surface.
_AT_ONCE = np.zeros(1, dtype=np.int64)


class LoopNumbers(NamedTuple):
    """Numbers of a closed loop that its kernels read.

    Plant and belief parameters, input limits, η and ε of the law; X = M_uu⁻¹ M_auᵀ at the target.
    """

    plant: FloatArray
    belief: FloatArray
    limits: FloatArray
    law: FloatArray
    coupling: FloatArray


@checked_names
@dataclass(frozen=True, eq=False)
class ClosedLoop:
    """A mechanism under its sliding-mode law, compiled for batches of rollouts.

    Parameters
    ----------
    mechanism
        The controller's belief, from which the law is derived.
    objective
        Stage cost, terminal set, constraints; the travel that the belief declares joins them, see
        :meth:`undertow.Objective.on`.  Nothing is optimised here: by default the paper's control
        energy is counted.
    reaching
        Reaching law, by default :func:`undertow.law.usual_reaching`; its gains can be
        overridden for each rollout.
    plant
        The truth.  The belief itself by default; must have the same coordinates and inputs.  Its
        motors may be weaker than the belief says; stronger ones are not asked for more.
    step
        Runge-Kutta step of batches, and between the rows of a recorded motion, s.  Where a mode of
        the plant is faster, batches divide it.
    zoh_steps
        Sampled inner loop: the law is evaluated every ``zoh_steps`` steps and held.
        0: continuous law, evaluated in every Runge-Kutta stage.
    escape
        ‖x‖₂ beyond which a motion counts as diverged.
    rtol
        Relative tolerance of motions that are integrated one by one, see
        :mod:`undertow.closed_loop.adaptive_integrator`: those of :meth:`simulate`, and batches that
        ask for it.  0: steps of ``step``, as batches take them; so with ``switching="sign"``.
    tail_rtol
        Relative tolerance of the large steps that a batch takes once the law is in its boundary
        layer, see :mod:`undertow.closed_loop.exponential_integrator`; 0: small steps to the end.
        Used by :meth:`batch` where belief and truth agree, the loop is continuous, all path
        constraints are bounds of states and the stage cost has a second-order model.
    ensemble
        Plausible plants instead of one: every plan is rolled out on all of them, and a batch has
        one result for each plan, see :mod:`undertow.closed_loop.ensemble`.
    threads
        Threads that integrate a large batch, with the same results to the last bit however many:
        one for each processor that is free.  1, for the real-time loops.
    returning
        Whether a motion that begins outside of a path constraint w(x) ≤ 0 may come back inside;
        the constraint counts from then on.  Until then its cost rises by Φ(0, u_max) w/|w(0)|
        per second, so that the shortest way back is the best.  So plans are compared on a rig,
        where a push may carry the state outside.  False: such a motion ends where it begins, as it
        does where w depends on the input: that is for the plan to choose.
    covariance
        Of the error of the estimated state, (2n, 2n), that the law acts on.  Batches count the cost
        of what it makes of it near the target, tr(R K P Kᵀ) per second for a quarter of their time,
        where they have a linear model; motions are without noise.

    Examples
    --------
    >>> import undertow as ut
    >>> rig = ut.mechanisms.rotary_pendulum(d_e=0.025)
    >>> loop = ClosedLoop(rig, ut.MinimumEnergy())
    >>> run = loop.simulate(rig.state(phi=0.5), ut.Surface(-1, -1.59, 1.96, 12.1))
    >>> run.event.name
    'REACHED'
    """

    mechanism: Mechanism
    objective: Objective = MinimumEnergy()
    reaching: ReachingLaw = SUITED
    plant: Mechanism | None = None
    step: float = 0.002
    zoh_steps: int = 0
    escape: float = 200.0
    rtol: float = RTOL
    tail_rtol: float = 0.0
    ensemble: Ensemble | None = None
    covariance: FloatArray | None = None
    threads: int = 1
    returning: bool = False

    #: Whether its parameters are those that were given, not learnt ones.
    _as_given = True

    def __post_init__(self) -> None:
        """Refuse steps that the boundary layer cannot bear and plants of another mechanism."""
        if self.reaching is None:
            check_fields(self, "mechanism", "step", "zoh_steps")
            positive("rollout step, s", self.step)
            object.__setattr__(
                self, "reaching", usual_reaching(self.mechanism, period=self._period)
            )
        check_fields(self)
        object.__setattr__(self, "objective", self.objective.on(self.mechanism))
        for name, remedy in (
            ("escape", "Leave it out for the usual value"),
            ("tail_rtol", "Leave it out for the usual value"),
            ("zoh_steps", "0 is the continuous law"),
        ):
            at_least(f"{name} of a closed loop", getattr(self, name), 0, remedy)
        if self.rtol:
            remedy = "0 is steps of one length; leave it out for the usual value"
            between("rtol of a closed loop", self.rtol, *TOLERANCES, remedy=remedy)
        if self.covariance is not None:
            covariance = _covariance(self.covariance, 2 * self.mechanism.n)
            object.__setattr__(self, "covariance", covariance)
        at_least("threads of a closed loop", self.threads, 1, "1 is the calling thread alone")
        positive("rollout step, s", self.step)
        self._check_law(self.reaching)
        if self.plant is not None and self.ensemble is not None:
            raise InvalidInputError(
                "plant of a closed loop",
                value=f"'{self.plant.name}', beside an ensemble",
                limit="one plant, or an ensemble",
                remedy="Leave one of them out",
            )
        self.mechanism.check_plant(self.truth)

    def _check_law(self, law: ReachingLaw) -> None:
        """Refuse a reaching law whose layer the steps, or samples, of the inner loop cross."""
        what = "sample period of the inner loop" if self.zoh_steps else "rollout step"
        law.check_period(what, self._period, self.mechanism.m)

    def __repr__(self) -> str:
        """Show belief, truth where it is another one, and objective."""
        plant = "" if self.plant is None else f", plant={self.plant.name}"
        return (
            f"ClosedLoop({self.mechanism.name}, {self.objective.name}{plant}, step={self.step:g} s)"
        )

    def __getstate__(self) -> dict[str, Any]:
        """What it was made from: a copy compiles, or finds, the same kernels."""
        made = {field.name: getattr(self, field.name) for field in fields(self)}
        return made | {"objective": self.objective.written(self.mechanism)}

    @property
    def truth(self) -> Mechanism:
        """The plant that moves; of an ensemble its structure."""
        return self._given or self.mechanism

    @property
    def input_limits(self) -> FloatArray:
        """What can reach the plant, (m,): the law keeps to the belief's limits, a motor to its own.

        ``hard_input`` asks that the law demands no more than this.
        """
        return np.minimum(self.mechanism.input_limits, self.truth.input_limits)

    @property
    def _given(self) -> Mechanism | None:
        return self.plant if self.ensemble is None else self.ensemble.plant

    @cached_property
    def equations(self) -> LoopEquations:
        """What its kernels are written from."""
        return LoopEquations(
            self.mechanism, self._given, self.objective, self.reaching.switching,
            self.zoh_steps > 0, self.ensemble is not None,
        )  # fmt: skip

    @cached_property
    def _kernels(self) -> Any:
        return compile_loop(self.equations)

    @cached_property
    def _look(self) -> Any:
        return compile_look(self.equations)

    @cached_property
    def numbers(self) -> LoopNumbers:
        """The numbers that the kernels read."""
        belief, truth = self.mechanism, self.truth
        return LoopNumbers(
            truth.parameter_values,
            belief.parameter_values,
            self.input_limits,
            self.reaching.vector(belief.m),
            coupling(belief, np.zeros(belief.n)),
        )

    @cached_property
    def _alone(self) -> ClosedLoop:
        """Return this loop with its mechanism as the only plant."""
        return replace(self, ensemble=None)

    @cached_property
    def linear_end(self) -> TerminalLinearModel | None:
        """The linear model of this loop at the target, where it has one."""
        if self.zoh_steps or not self.reaching.has_layer or self.plant is not None:
            return None
        if not (has_linear_model(self.mechanism) and has_linear_model(self.truth)):
            return None
        return TerminalLinearModel(self.mechanism, self.objective, self.ensemble)

    @property
    def slides(self) -> bool:
        """Whether the law is discontinuous and acts in continuous time: it does not chatter."""
        return self.equations.slides

    @cached_property
    def price_of_time(self) -> float:
        """What a second costs at rest, where that jumps with the arrival; else 0.

        So it does where Φ(0, 0) > 0 and has no second-order part: the cost is much like a time.
        """
        stage = quadratic_stage(self.mechanism, self.objective.stage_cost(self.mechanism))
        return 0.0 if stage is None or stage.quadratic else stage.rest

    @cached_property
    def takes_large_steps(self) -> bool:
        """Whether rollouts end in large steps, with the linear model."""
        problem = self.objective
        if not self.tail_rtol > 0 or (problem.constraints and not problem.boxes(self.mechanism)):
            return False
        end = self.linear_end
        return end is not None and end.stage is not None

    @cached_property
    def substeps(self) -> int:
        """Runge-Kutta steps of a batch in one step of the loop: several where a mode is fast."""
        return steps_in(self.truth, self.step, self.step, STABLE)

    @checked
    def believing(self, mechanism: Mechanism, ensemble: Ensemble | None = None) -> ClosedLoop:
        """Return this loop with other parameters believed, and another ensemble of its kind.

        The equations stay, and so do the kernels: nothing is compiled or looked up again.
        """
        end = None
        if self.adapts:
            assert self._look is not None  # found once, for all copies
        if self.plant is None and (self.ensemble is None) == (ensemble is None):
            end = self.linear_end and self.linear_end.believing(mechanism, ensemble)
        other = self._changed({"numbers", "linear_end"}, mechanism=mechanism, ensemble=ensemble)
        other.__dict__["_as_given"] = False
        if end is not None:
            other.__dict__["linear_end"] = end
        return other

    @checked
    def with_steps(self, step: float, tail_rtol: float) -> ClosedLoop:
        """Return this loop integrated with other steps; what does not depend on them is shared."""
        if step != self.step:  # may be too long for the boundary layer
            replace(self, step=step)
        return self._changed({"takes_large_steps", "substeps"}, step=step, tail_rtol=tail_rtol)

    def _changed(self, without: set[str], **fields: Any) -> ClosedLoop:
        """Return a copy with other fields, unchecked, and without some of what was computed."""
        assert self._kernels is not None  # found once, for all copies
        assert self.prices is not None
        assert self.price_of_time >= 0
        assert self.substeps > 0
        other = object.__new__(type(self))
        other.__dict__.update(
            {k: v for k, v in vars(self).items() if k not in without | {"_alone", "equations"}},
            **fields,
        )
        return other

    def _switch_steps(self, switch_times: Sequence[float]) -> NDArray[np.int64]:
        """Return the steps at which surfaces take over; the kernel meets them one by one."""
        if len(switch_times) == 1 and switch_times[0] == 0:
            return _AT_ONCE
        steps = np.array([round(t / self.step) for t in switch_times], dtype=np.int64)
        if steps[0] != 0 or not (np.diff(steps) > 0).all():
            raise InvalidInputError(
                "switch_times",
                value=list(switch_times),
                limit=f"0 first, each later than the one before by a step of {self.step:g} s",
                remedy="Leave out the surfaces that never act",
            )
        return steps

    def roll_out(
        self,
        buffers: RolloutBuffers,
        switch_times: Sequence[float],
        duration: float,
        *,
        start: float = 0.0,
        terminal: float | None = None,
        cap: float = math.inf,
        stable_only: bool = False,
        seek: bool = False,
        every: int = 0,
        record: FloatArray = NOTHING,
        noise: FloatArray | None = None,
        precise: bool = False,
    ) -> Batch:
        """Roll out what buffers hold; their numbers are not checked again.

        This is what searches call thousands of times: of what they propose, surfaces whose gains
        (13) the step cannot follow are ``UNSTABLE``.

        Parameters
        ----------
        buffers
            States, surfaces and laws; what is returned is a view of them.
        switch_times, duration
            When surfaces take over, and the length, s.
        start, terminal, cap, stable_only, seek
            As for :meth:`batch` and :meth:`simulate`.
        every, record
            Where every so many steps leave a row, (N, rows, 2n + 2m + 2); 0: nowhere.
        noise
            Measurement noise, (samples, N, 2n).
        precise
            As for :meth:`batch`, where the loop :attr:`adapts`.
        """
        if precise and self.adapts:
            return self._follow(
                buffers, switch_times, duration, start=start, terminal=terminal, cap=cap,
                stable_only=stable_only, every=every, record=record, noise=noise,
            )  # fmt: skip
        switches, steps, parts = (
            self._switch_steps(switch_times), self._steps(duration), self.substeps
        )  # fmt: skip
        if self.ensemble is not None and not len(buffers.member):
            members, size = buffers.spread(), len(self.ensemble)
            plans, out = np.arange(buffers.count), buffers.out
            roll_out = partial(
                self.roll_out, switch_times=switch_times, duration=duration, start=start,
                terminal=terminal, cap=cap, stable_only=stable_only, seek=seek,
            )  # fmt: skip
            if math.isfinite(cap):  # what breaks off or is too dear on the first needs no others
                first = members.part(plans * size)
                roll_out(first)
                out[:] = first.out
                plans = np.flatnonzero(out[: buffers.count, 2] == Event.REACHED)
                if len(plans) < buffers.count:
                    members = members.part((plans[:, None] * size + np.arange(size)).ravel())
            if len(plans):
                roll_out(members)
                weights, tail = self.ensemble.shares, TAIL[self.ensemble.risk]
                margins = 2 + len(self.objective.constraints)
                found = np.empty((len(plans), out.shape[1]))
                summarise(members.out[: members.count], weights, tail, margins, found)
                out[plans] = found
            return buffers.batch(start)
        numbers, end = self.numbers, self.linear_end
        radius = self.objective.terminal_radius if terminal is None else terminal
        # Large steps see no closest approach, and leave nothing to record.
        large = self.takes_large_steps and not every and not seek
        part, calm_from = buffers, 0 if large else steps
        noisy = self.covariance is not None and end is not None and end.counts_cost
        where: NDArray[np.intp] | slice = slice(buffers.count)
        while True:
            live, out = part.live, part.out
            goes_on = calm_from < steps
            linearised = goes_on or (noisy and part is buffers)
            prepared = self._begun(part, stable_only, linearised, moves=every > 0)
            integrate = shared(self._kernels.rollout, self.threads, part.padded, steps)
            integrate(
                0, part.padded, part.states, live, part.lanes, parts * switches, numbers.plant,
                numbers.belief, numbers.limits, part.quiet if noise is None else noise, start,
                self.step / parts, parts * steps, parts * max(1, self.zoh_steps), radius,
                self.escape, cap, 1.0 if seek else 0.0, self.prices, parts * calm_from,
                parts * every, record, out,
            )  # fmt: skip
            if goes_on and prepared is not None and end is not None:
                integrate = shared(self._kernels.etd_integrate, self.threads, part.padded, steps)
                integrate(
                    0, part.padded, part.lanes, numbers.plant, numbers.belief, numbers.limits,
                    start + steps * self.step, radius, self.escape, self.tail_rtol,
                    1.0 if end.counts_cost else 0.0, prepared.A, prepared.P, prepared.powers,
                    prepared.forced, prepared.reach, out,
                )  # fmt: skip
            if part is not buffers:
                taken = buffers.out[where, -1]
                buffers.out[where] = out[: part.count]
                buffers.out[where, -1] += taken
            again = np.flatnonzero(out[: part.count, 2] == GIVEN_BACK)
            if not (goes_on and len(again)):
                if noisy:
                    self._count_noise(buffers, start)
                return buffers.batch(start)
            # Too fast for large steps, or at a limit again: small steps until later.
            failed = round((float(out[again, 1].max()) - start) / self.step)
            calm_from = min(failed + max(round(CALMER / self.step), calm_from), steps)
            part, where = part.part(again), np.arange(buffers.count)[where][again]

    def _follow(
        self, buffers: RolloutBuffers, switch_times: Sequence[float], duration: float, *,
        start: float = 0.0, terminal: float | None = None, cap: float = math.inf,
        stable_only: bool = False, every: int = 0, record: FloatArray = NOTHING,
        noise: FloatArray | None = None,
    ) -> Batch:  # fmt: skip
        """Do what :meth:`roll_out` does to the tolerance of the loop, motion by motion."""
        live, numbers, look = buffers.live, self.numbers, self._look
        noisy = self.covariance is not None and self.linear_end is not None
        self._begun(buffers, stable_only, noisy, moves=every > 0)
        m, nu = self.mechanism.m, self.objective.terminal_radius
        _, seen = self._looked(buffers.lanes[0, 0], np.zeros(2 * self.mechanism.n + 1), start)
        least = -ALLOWED * np.maximum(np.nan_to_num(seen[2 * m :]), 0.0)
        least[0] = 0.0  # beyond (37) there is no law
        follow()(
            look.look, look.decide, buffers.count, buffers.states, live, buffers.lanes,
            self._switch_steps(switch_times), numbers.plant, numbers.belief, numbers.limits,
            buffers.quiet if noise is None else noise, start, self.step,
            self._length(duration), self.zoh_steps, least, nu, nu if terminal is None else terminal,
            self.escape, cap, self.rtol, self.prices, every, record, buffers.out,
        )  # fmt: skip
        if noisy and self.linear_end is not None and self.linear_end.counts_cost:
            self._count_noise(buffers, start)
        return buffers.batch(start)

    def _looked(self, lane: FloatArray, x: FloatArray, t: float) -> tuple[FloatArray, FloatArray]:
        """Return the inputs and what else is seen at a state with its cost, (2n + 1,)."""
        m, numbers = self.mechanism.m, self.numbers
        u, seen = np.zeros(m), np.ones(2 * m + 2 + len(self.objective.constraints))
        for look in (self._look.decide, self._look.look):
            look(
                t, x, lane, numbers.plant, numbers.belief, numbers.limits, u, seen, np.empty(len(x))
            )
        return u, seen

    def _count_noise(self, buffers: RolloutBuffers, start: float) -> None:
        """Add what noise costs near the target to the costs of motions, part of their time."""
        assert self.linear_end is not None
        assert buffers.ends is not None
        assert self.covariance is not None
        rate = self.linear_end.noise_cost(buffers.ends, self.covariance)[: buffers.count]
        out = buffers.out[: buffers.count]  # the others may never have been filled
        out[:, 0] += NEAR * rate * (out[:, 1] - start)

    @cached_property
    def prices(self) -> FloatArray:
        """What it costs to be outside of each path constraint, (w,), cost per s and unit; or zero.

        The whole margin at the target costs what the whole input costs, or 1 where that is free.
        No price lets a plan break a constraint on the input, which no push can do.
        """
        mechanism, objective = self.mechanism, self.objective
        if not self.returning:
            return np.zeros(len(objective.constraints))
        margins, inputs = objective.path_margins(mechanism), {*mechanism.u}
        known = mechanism.substitution | dict.fromkeys([*mechanism.x], 0.0)
        full = known | dict(zip(mechanism.u, self.input_limits.tolist(), strict=True))
        rate = float(objective.stage_cost(mechanism).subs(full))
        room = [
            math.inf if margin.free_symbols & inputs else real_value(margin.subs(known))
            for margin in margins
        ]
        return (rate if 0.0 < rate < math.inf else 1.0) / np.fmax(room, LEAST_ROOM)

    def _begun(
        self, buffers: RolloutBuffers, stable_only: bool, linearised: bool, *, moves: bool
    ) -> Prepared | None:
        """Switch lanes on, but for those that are ruled out; linearise the last surface of each.

        Ruled out are gains (13) that this step cannot follow, unless the motion is one that is
        under way and ``moves`` with them all the same.  Linearised is where that is asked
        for, or where it tells which lanes are stable.
        """
        live = buffers.live
        live.fill(1.0)
        if not moves:
            live[self._fastest(buffers.lanes) >= OVERSHOOTS] = 0.0
        needless = not (linearised or stable_only)
        if needless or self.linear_end is None or buffers.ends is None:
            return None
        gains = None
        if any(self.mechanism.disturbance_bounds):
            last, layout = buffers.lanes[:, -1], buffers.layout
            gains = gains_at_target(self.mechanism, last[:, layout.surface], last[:, layout.eta])
        self.linear_end.prepare(buffers.lanes, gains, buffers.ends, buffers.member)
        if stable_only:
            live *= buffers.ends.stable
        return buffers.ends

    def _fastest(self, lanes: FloatArray) -> FloatArray:
        """Fastest k/ε that the gains (13) ask for near the target, times the period: (N,).

        From 2 on the law, renewed once a period, overshoots ever farther; zero where η and ε
        alone, which were looked at before, say how fast it is.
        """
        if not (self.reaching.has_layer and any(self.mechanism.disturbance_bounds)):
            return np.zeros(len(lanes))
        layout = LawLayout(self.mechanism.n, self.mechanism.m)
        flat = lanes.reshape(-1, lanes.shape[-1])
        gains = gains_at_target(self.mechanism, flat[:, layout.surface], flat[:, layout.eta])
        rate = (gains / flat[:, layout.layer]).max(axis=1).reshape(lanes.shape[:2]).max(axis=1)
        return np.asarray(rate * self._period)

    @property
    def _period(self) -> float:
        """How often the law is renewed, s."""
        return self.step * max(1, self.zoh_steps)

    def _check_gains(self, buffers: RolloutBuffers) -> None:
        """Refuse gains (13) that this step cannot follow, but for those of other parameters.

        Where parameters are learnt, those of a plan that goes on may become a little larger.
        """
        fastest = float(self._fastest(buffers.lanes).max()) if self._as_given else 0.0
        if fastest >= OVERSHOOTS:
            rate = fastest / self._period
            raise InvalidInputError(
                "step for the gains (13) that the disturbance bounds ask for",
                value=f"{self._period:g} s at k/ε = {rate:.4g} 1/s",
                limit=f"below {OVERSHOOTS:g} ε/k = {OVERSHOOTS / rate:.3g} s",
                remedy="Use a boundary layer more than "
                f"{fastest / OVERSHOOTS:.3g} times as thick, reaching=undertow.ReachingLaw"
                "(layer=...), a shorter step or smaller bounds; dry friction in a model file is "
                "such a bound",
            )

    @checked
    def batch(
        self,
        x0: ArrayLike,
        surfaces: ArrayLike | Surface | Plan | Sequence[Surface | Plan],
        *,
        reaching: FloatArray | None = None,
        switch_times: Sequence[float] = (0.0,),
        duration: float | None = None,
        terminal: float | None = None,
        cap: float = math.inf,
        stable_only: bool = False,
        seek: bool = False,
        precise: bool = False,
    ) -> Batch:
        """Roll out a batch: many surfaces or plans, many initial states, or both.

        Parameters
        ----------
        x0
            (2n,) or (N, 2n).
        surfaces
            Surfaces or plans, one for each rollout; or vectors: (2mn,), (N, 2mn), or
            (N, S, 2mn) for S surfaces that take over at ``switch_times``.
        reaching
            With vectors: (N, S, 2m) or broadcastable, η and ε of each.
        switch_times
            With vectors: S times, s, the first 0.
        duration
            Length, s; the objective's horizon by default.  Steps of one length end at the nearest
            whole number of them.
        terminal
            Terminal radius; the objective's by default; 0 never ends.
        cap
            Cost beyond which a rollout is given up (``COSTLY``).
        stable_only
            Do not roll out surfaces that are unstable at the target (``UNSTABLE``); for
            loops with a linear model, see :attr:`linear_end`.
        seek
            Also find where the motion comes closest to the target.
        precise
            Integrate each to ``rtol``, as :meth:`simulate` does; on an ensemble none is.  Not with
            ``seek``.
        """
        self._check_duration(duration)
        plans = _plans(surfaces)
        if plans:
            if reaching is not None or tuple(switch_times) != (0.0,):
                raise InvalidInputError(
                    "batch of surfaces or plans",
                    value="reaching= or switch_times= besides",
                    limit="plans alone, or vectors with both",
                    remedy="Put times and reaching laws into undertow.Plan",
                )
            switch_times, vectors, reaching = Plan.align(plans, self.reaching)
        else:
            vectors = np.atleast_2d(floats("surface vectors of a batch", surfaces))  # type: ignore[arg-type]
            if vectors.ndim == 2:
                vectors = vectors[:, None, :]
        states = np.atleast_2d(self.mechanism.check_state(x0))
        expected = 2 * self.mechanism.m * self.mechanism.n
        if vectors.shape[-1] != expected or vectors.shape[1] != len(switch_times):
            raise InvalidInputError(
                "surface vectors of a batch",
                value=f"shape {vectors.shape}",
                limit=f"(N, {len(switch_times)}, {expected})",
            )
        require(len(vectors), "batch of rollouts", "no surface", "at least one")
        if not np.isfinite(vectors).all():
            raise InvalidInputError(
                "surface vectors of a batch",
                value="NaN or infinity",
                limit="finite numbers",
                remedy="An earlier computation went wrong: look at where they come from",
            )
        if reaching is not None:
            least = float(np.min(reaching))
            positive("reaching gains of a batch", least, "η and ε are positive", infinite=True)
        for what, value in (("terminal", terminal or 0.0), ("cap", cap)):
            at_least(f"{what} of a batch", value, 0, "Leave it out for the usual value")
        count = max(states.shape[0], vectors.shape[0])
        if states.ndim != 2 or {states.shape[0], vectors.shape[0]} - {1, count}:
            raise InvalidInputError(
                "batch of rollouts",
                value=f"{states.shape[:-1]} states and {vectors.shape[0]} surfaces",
                limit="equal numbers, or one of either",
                remedy="Repeat the states or the surfaces",
            )
        if precise and seek:
            raise InvalidInputError(
                "batch of rollouts",
                value="precise=True and seek=True",
                limit="one of them",
                remedy="Look for the closest approach in the steps of the loop",
            )
        buffers = RolloutBuffers(self, count, len(switch_times)).fill(states, vectors, reaching)
        if not stable_only:
            self._check_gains(buffers)
        return self.roll_out(
            buffers,
            switch_times,
            self.objective.horizon if duration is None else duration,
            terminal=terminal,
            cap=cap,
            stable_only=stable_only,
            seek=seek,
            precise=precise,
        )

    @property
    def adapts(self) -> bool:
        """Whether motions are integrated to a tolerance where that is asked for."""
        return self.rtol > 0 and self.reaching.has_layer and self.ensemble is None

    @checked
    def simulate(
        self,
        x0: ArrayLike,
        surfaces: Surface | Plan | Sequence[Surface],
        *,
        switch_times: Sequence[float] = (0.0,),
        duration: float | None = None,
        start: float = 0.0,
        terminal: float | None = None,
        every: int = 1,
        noise: FloatArray | None = None,
    ) -> Trajectory:
        """Simulate and record one motion, with one surface, several of them, or a plan.

        Parameters
        ----------
        x0
            Initial state, (2n,).
        surfaces
            A plan, a surface, or one surface for each of ``switch_times``.
        switch_times
            When each takes over, s after the start, at the nearest step; the first is 0.
        duration
            Length, s; the objective's horizon by default.  The motion ends then, also where that is
            no whole number of steps: with ``rtol=0`` all of them are a little shorter.
        start
            Clock at the start, s (for time-dependent disturbances).
        terminal
            Terminal radius; the objective's by default; 0 never ends.
        every
            Record every so many steps.
        noise
            Measurement noise added to the state that the law sees, (samples, 2n), SI
            units; for a sampled inner loop only.
        """
        self._check_duration(duration)
        at_least("every", every, 1, "Record each step: 1")
        at_least("terminal of a motion", terminal or 0.0, 0, "0 never ends")
        positive("start of a motion, s", abs(start), "0 is the usual clock", zero=True)
        if self.ensemble is not None:
            return self._alone.simulate(
                x0, surfaces, switch_times=switch_times, duration=duration, start=start,
                terminal=terminal, every=every, noise=noise,
            )  # fmt: skip
        plan = Plan.of(surfaces, switch_times)
        for surface, law in zip(plan.surfaces, plan.laws(self.reaching), strict=True):
            check_surface_shape(self.mechanism, surface)
            self._check_law(law)
        if noise is not None:
            if not self.zoh_steps:
                raise InvalidInputError(
                    "measurement noise",
                    value="a continuous inner loop",
                    limit="a sampled one",
                    remedy="Build the loop with zoh_steps ≥ 1",
                )
            noise = np.asarray(noise, dtype=float)
            if noise.ndim != 2 or noise.shape[1] != 2 * self.mechanism.n or noise.size == 0:
                raise InvalidInputError(
                    "measurement noise",
                    value=f"shape {noise.shape}",
                    limit=f"(samples, {2 * self.mechanism.n})",
                )
            noise = np.repeat(self.mechanism.check_state(noise)[:, None, :], LANES, axis=1)
        x0 = self.mechanism.initial_state(x0, {})
        span = self.objective.horizon if duration is None else duration
        step = self.equal_steps(span)[1]
        if step != self.step and not self.adapts:
            return self.with_steps(step, self.tail_rtol).simulate(
                x0, plan, duration=duration, start=start, terminal=terminal, every=every,
                noise=None if noise is None else noise[:, 0],
            )  # fmt: skip
        buffers = RolloutBuffers(self, 1, len(plan.times))
        record = self._record(buffers, -(-self.equal_steps(span)[0] // every))
        self._check_gains(buffers.fill(x0, plan.vectors, plan.gains(self.reaching)))
        batch = self.roll_out(
            buffers,
            plan.times,
            span,
            start=start,
            terminal=terminal,
            every=every,
            record=record,
            noise=noise,
            precise=True,
        )
        last = self._ending(plan, batch, start)
        return self._trajectory(batch, record[0], last, start, every)

    def _record(self, buffers: RolloutBuffers, rows: int) -> FloatArray:
        return np.zeros((buffers.padded, rows, 2 * self.mechanism.n + 2 * self.mechanism.m + 2))

    def _steps(self, duration: float) -> int:
        """Return the number of steps of a rollout, refusing what memory or patience forbid."""
        if 1.0 <= duration / self.step <= MOST_STEPS:
            return round(duration / self.step)
        self._check_duration(duration)
        steps = round(duration / self.step)
        if steps > MOST_STEPS or (steps < 1 and duration > 0):
            raise InvalidInputError(
                "length of a rollout",
                value=f"{duration:g} s",
                limit=f"{self.step:g} s to {MOST_STEPS * self.step:g} s, 1 to {MOST_STEPS} steps",
                remedy="Change the horizon, or the step",
            )
        return steps

    def _length(self, duration: float) -> float:
        """Return the length of a motion that is integrated to the tolerance, s."""
        count, step = self.equal_steps(duration)
        return count * step if step == self.step else duration

    @checked
    def equal_steps(self, duration: float) -> tuple[int, float]:
        """Return how many equal steps make up a duration, s, and how long each is, s.

        That is ``step``, or a little less where the duration is no whole number of them.
        """
        self._check_duration(duration)
        if duration / self.step > MOST_STEPS:
            self._steps(duration)  # says so
        count = math.ceil(duration / self.step - ROUNDING)
        whole = count - duration / self.step <= ROUNDING
        return count, self.step if whole else duration / count

    def _check_duration(self, duration: float | None) -> None:
        if duration is not None:
            remedy = "Leave it out for the objective's horizon"
            positive("duration of a rollout, s", duration, remedy, zero=True)

    def _ending(self, plan: Plan, batch: Batch, start: float) -> FloatArray | None:
        """Return the line of a record for the end of a motion, where the law acts there."""
        if self.zoh_steps or not np.isfinite(batch.x).all():
            return None
        end = float(batch.time[0])
        surface, law = plan.at(end)
        gains = (law or self.reaching).vector(self.mechanism.m)
        buffers = RolloutBuffers(self, 1, 1).fill(batch.x, surface.vector, gains)
        if self.adapts:
            m, x = self.mechanism.m, np.append(batch.x[0], batch.cost[0])
            u, seen = self._looked(buffers.lanes[0, 0], x, start + end)
            return np.concatenate([x[:-1], u, seen[:m], x[-1:], seen[2 * m : 2 * m + 1]])
        record = self._record(buffers, 1)
        self.roll_out(
            buffers, (0.0,), self.step, start=start + end, terminal=0.0, every=1, record=record
        )
        line = record[0, 0]
        return line if np.isfinite(line).all() else None

    def _trajectory(
        self, batch: Batch, record: FloatArray, last: FloatArray | None, start: float, every: int
    ) -> Trajectory:
        n, m = self.mechanism.n, self.mechanism.m
        end = float(batch.time[0])
        times = np.arange(max(len(record), 1)) * (every * self.step)
        rows = record[times[: len(record)] < end - 1e-12]
        if last is None:  # a held input is still the last one
            lines = [*rows[-1:], *record[:1], np.zeros(2 * n + 2 * m + 2)]
            last = lines[0].copy()
        last[: 2 * n], last[2 * n + 2 * m] = batch.x[0], batch.cost[0]
        if len(rows) == 0:
            rows = last[None].copy()
        rows = np.vstack([rows, last])
        t = np.append(times[: len(rows) - 1], end)
        return recorded(self.truth, t + start, rows, int(batch.event[0]), self.objective)


def _covariance(given: FloatArray, size: int) -> FloatArray:
    """Return a covariance, (2n, 2n), or refuse what is none."""
    P = floats("covariance of a closed loop", given)
    square = P.shape == (size, size)
    if not (square and np.isfinite(P).all()):
        value = f"shape {P.shape}" if not square else "NaN or infinity"
    elif np.abs(P - P.T).max() > 1e-6 * np.abs(P).max():
        value = "a matrix that is not symmetric"
    elif (least := float(np.linalg.eigvalsh(P).min())) < -1e-9 * np.abs(P).max():
        value = f"an eigenvalue {least:.3g}"
    else:
        return P
    raise InvalidInputError(
        "covariance of a closed loop",
        value=value,
        limit=f"({size}, {size}), finite, symmetric, without a negative eigenvalue",
        remedy="Take KalmanFilter.noise_covariance, or a diagonal of variances; None is exact",
    )


def _plans(what: object) -> list[Plan]:
    """Return the plans that were given as such or as surfaces; [] for plain numbers."""
    if isinstance(what, Surface | Plan):
        return [Plan.of(what)]
    if isinstance(what, Sequence) and all(isinstance(item, Surface | Plan) for item in what):
        return [Plan.of(item) for item in what]
    return []
