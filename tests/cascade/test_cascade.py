"""The cascade: the cost never rises, the last good surface stays, the run can be replayed."""

from __future__ import annotations

import math
import pickle
import sys
import traceback
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import undertow as ut
from undertow.base import (
    InfeasibleError,
    InvalidInputError,
    SingularSurfaceError,
    UnstableSurfaceError,
)
from undertow.cascade import CascadeState, cost_gate
from undertow.closed_loop import kernel, rollout
from undertow.law import Plan
from undertow.optimiser import Budget, Proposal
from undertow.studies.paper import CASES

GOOD = CASES["4 one-time, time"]
BASE = CASES["1 base case"]


@pytest.fixture(scope="module")
def cascade(rig: ut.Mechanism) -> ut.Cascade:
    """Minimum time with short searches: a run takes a fraction of a second."""
    return ut.Cascade(
        rig, ut.MinimumTime(), cold=ut.Budget(600), warm=ut.Budget(96), belief="exact"
    )


@pytest.fixture(scope="module")
def run(cascade: ut.Cascade) -> ut.Run:
    return cascade.simulate(phi=ut.deg(30))


# -- Lemmas 1 to 4, as the run records them ------------------------------------------------


def test_time_to_go_falls_by_the_period_at_each_decision(run: ut.Run) -> None:
    """Theorem 2: t_f,k+1 ≤ t_f,k − Δt, and the terminal set is reached within t_f,0."""
    predicted = np.array([update.predicted for update in run.updates])
    assert run.reached
    assert len(predicted) > 3
    assert (predicted[1:] <= predicted[:-1] - 0.1 + 1e-9).all()
    assert run.time <= predicted[0] + 1e-9
    assert run.lemma3_slack.min() >= -1e-9


def test_cost_to_go_falls_by_what_was_spent(rig: ut.Mechanism) -> None:
    """Lemma 3: J̃ₖ₊₁ ≤ J̃ₖ − spent at every decision of a minimum-energy run."""
    cascade = ut.Cascade(
        rig,
        ut.MinimumEnergy(),
        period=0.5,
        cold=ut.Budget(600),
        warm=ut.Budget(96),
        belief="exact",
    )
    run = cascade.simulate(phi=ut.deg(30))
    assert run.reached
    assert run.lemma3_slack.min() >= -1e-9 * run.updates[0].predicted
    spent = sum(update.spent for update in run.updates)
    assert spent <= run.cost <= run.updates[0].predicted * (1 + 1e-9)
    u, t = run.trajectory.u[:, 0], run.trajectory.t
    assert run.cost == pytest.approx(np.trapezoid(u**2, t), rel=1e-3)


def test_prediction_equals_what_happens_when_nothing_is_replaced(
    rig: ut.Mechanism, cascade: ut.Cascade
) -> None:
    """Belief = truth: with a gate that admits nothing, the run costs what was predicted."""
    shut = replace(
        cascade, gate=lambda loop, old, new, x, span: refuse(cost_gate(loop, old, old, x, span))
    )
    run = shut.simulate(phi=ut.deg(30))
    assert run.cost == pytest.approx(run.updates[0].predicted, rel=1e-9)
    assert len(set(run.surfaces)) == 1
    np.testing.assert_allclose(run.lemma3_slack, 0, atol=1e-9)


def refuse(admission: Any) -> Any:
    return replace(admission, accepted=False, reason="shut")


def test_no_worse_than_the_one_time_optimum(run: ut.Run, cascade: ut.Cascade) -> None:
    """Re-optimising never costs more than keeping the first optimum."""
    once = cascade.loop.simulate(run.trajectory.x[0], run.surfaces[0])
    assert run.cost <= once.cost + 1e-9


@pytest.mark.slow
@pytest.mark.parametrize(
    ("objective", "at_most", "spread"),
    [(ut.MinimumEnergy(), 11.9, 0.01), (ut.MinimumTime(), 1.05, 0.1)],
)
def test_cascades_at_41_degrees(
    rig: ut.Mechanism, objective: ut.Objective, at_most: float, spread: float
) -> None:
    """Energy ≤ 11.9 V² s and time ≤ 1.05 s at 41°, d_e = 0.025; first plans of three seeds alike.

    So are the costs of energy; times of arrival part on the way.
    """
    runs = [
        ut.Cascade(rig, objective, seed=seed, belief="exact").simulate(phi=ut.deg(41))
        for seed in range(3)
    ]
    costs = np.array([run.cost for run in runs])
    firsts = np.array([run.updates[0].predicted for run in runs])
    assert all(run.reached for run in runs)
    assert costs.max() <= at_most
    assert np.ptp(costs) <= spread * costs.min()
    assert np.ptp(firsts) <= 0.01 * firsts.min()
    assert min(float(run.lemma3_slack.min()) for run in runs) >= -1e-9 * at_most


# -- determinism ---------------------------------------------------------------------------


def test_same_seed_same_bits(run: ut.Run, cascade: ut.Cascade) -> None:
    """A second run, by a fresh cascade, has the same states and surfaces, bit for bit."""
    again = replace(cascade).simulate(phi=ut.deg(30))
    np.testing.assert_array_equal(again.trajectory.x, run.trajectory.x)
    assert again.surfaces == run.surfaces


def test_replay_of_the_record_gives_the_same_decisions(run: ut.Run, cascade: ut.Cascade) -> None:
    """The recorded states and proposals, passed through the gate again, decide the same."""
    first = run.updates[0]
    state = CascadeState(first.plan, 0, first.predicted)
    for update in run.updates[1:]:
        state, admission = cascade.apply_gate(state, update.proposal, update.x, 60.0 - update.t)
        assert admission == update.admission
        assert state.surface == update.surface


# -- when the optimiser fails ----------------------------------------------------------------


class Faulty:
    """An optimiser whose re-optimisations go wrong; the first one is sound."""

    def __init__(self, sound: ut.Optimiser, fault: Callable[[Proposal], Proposal]) -> None:
        self.sound, self.fault = sound, fault

    def propose(self, x: Any, **question: Any) -> Proposal:
        answer = self.sound.propose(x, **question)
        return answer if question["incumbent"] is None else self.fault(answer)


def crash(_: Proposal) -> Proposal:
    raise RuntimeError("licence server unreachable")


def nothing(answer: Proposal) -> Proposal:
    return replace(answer, plan=None, status="infeasible", message="gave up")


def unstable(answer: Proposal) -> Proposal:
    return replace(answer, plan=Plan.of(ut.Surface(-1, 0.5, 5, 10)), cost=0.0)


def nearly_singular(answer: Proposal) -> Proposal:
    return replace(answer, plan=Plan.of(ut.Surface(-1, -1.0, 1.05, 9.0)), cost=0.0)


def costly(answer: Proposal) -> Proposal:
    return replace(answer, plan=Plan.of(CASES["2 one-time, energy"]), cost=0.0)


def stale(answer: Proposal) -> Proposal:
    return replace(answer, sequence=0)


def with_fault(cascade: ut.Cascade, fault: Callable[[Proposal], Proposal]) -> ut.Cascade:
    """The same cascade with an optimiser whose answers pass through ``fault``."""
    return replace(cascade, planner=Faulty(cascade.optimiser, fault))


@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        (crash, "RuntimeError: licence server unreachable"),
        (nothing, "gave up"),
        (unstable, "unstable: margin"),
        (stale, "stale: number 0"),
    ],
)
def test_last_good_surface_stays_when_the_optimiser_fails(
    cascade: ut.Cascade, run: ut.Run, fault: Callable[[Proposal], Proposal], reason: str
) -> None:
    """Whatever comes back, nothing bad is applied and the motion is the one-time optimum's."""
    faulty = with_fault(cascade, fault).simulate(phi=ut.deg(30))
    assert faulty.reached
    assert set(faulty.surfaces) == {run.surfaces[0]}
    assert faulty.cost == pytest.approx(run.updates[0].predicted, rel=1e-9)
    decisions = [update.admission for update in faulty.updates[1:]]
    assert decisions
    assert all(not d.accepted and reason in d.reason for d in decisions)


@pytest.mark.parametrize(
    ("fault", "reason"),
    [(costly, "raises the predicted cost"), (nearly_singular, "not feasible from here: singular")],
)
def test_bad_surfaces_are_refused_as_long_as_they_are_bad(
    cascade: ut.Cascade, run: ut.Run, fault: Callable[[Proposal], Proposal], reason: str
) -> None:
    """A surface that costs more, or meets (37) from here, waits until it does no harm."""
    faulty = with_fault(cascade, fault).simulate(phi=ut.deg(30))
    assert faulty.reached
    assert reason in faulty.updates[1].admission.reason
    assert faulty.updates[1].surface == run.surfaces[0]
    assert faulty.lemma3_slack.min() >= -1e-9
    assert faulty.cost <= run.updates[0].predicted + 1e-9


def test_failures_now_and_then_cost_little(cascade: ut.Cascade) -> None:
    """With every other optimisation crashing, the run still improves on the first optimum."""
    calls = iter(range(1000))

    def sometimes(answer: Proposal) -> Proposal:
        return crash(answer) if next(calls) % 2 else answer

    run = with_fault(cascade, sometimes).simulate(phi=ut.deg(30))
    verdicts = [update.admission.accepted for update in run.updates[1:]]
    assert run.reached
    assert any(verdicts)
    assert not all(verdicts)
    assert run.cost < run.updates[0].predicted
    assert run.lemma3_slack.min() >= -1e-9


def test_bad_measurement_is_refused_before_anything_is_decided(cascade: ut.Cascade) -> None:
    """NaN in the state names the sensor's entry; the cascade's memory is untouched."""
    state = CascadeState(Plan.of(GOOD), 3, 1.0)
    proposal = cascade.propose(state, np.array([0.0, np.nan, 0.0, 0.0]))
    assert proposal.status == "failed"
    assert "'phi'" in proposal.message
    with pytest.raises(InvalidInputError, match="'phi'"):
        cascade.apply_gate(state, proposal, np.array([0.0, np.nan, 0.0, 0.0]))


# -- the gate ------------------------------------------------------------------------------


def test_gate_believes_nothing_that_the_optimiser_says(cascade: ut.Cascade) -> None:
    """A proposal that claims cost 0 is judged by a rollout of its own."""
    x = cascade.mechanism.state(phi=ut.deg(30))
    admission = cost_gate(cascade.loop, Plan.of(GOOD), Plan.of(BASE), x, 60.0)
    kept, new = cascade.loop.batch(x, [GOOD, BASE], precise=True).cost
    assert not admission.accepted
    assert admission.cost == kept < new
    swapped = cost_gate(cascade.loop, Plan.of(BASE), Plan.of(GOOD), x, 60.0)
    assert swapped.accepted
    assert swapped.cost == kept


def test_a_plan_that_replaces_one_which_comes_home_too_late_says_so(cascade: ut.Cascade) -> None:
    """Its own cost may be higher than what was predicted of the old one: "not raised" said less."""
    x = cascade.mechanism.state(phi=ut.deg(30))
    times = cascade.loop.batch(x, [GOOD, BASE], precise=True).time
    soon, late = (Plan.of((GOOD, BASE)[k]) for k in np.argsort(times))
    admission = cost_gate(cascade.loop, late, soon, x, float(times.mean()))
    assert admission.accepted
    assert admission.reason == "stable and feasible, as the plan in use no longer is"


def test_equal_cost_is_admitted_and_any_more_is_not(cascade: ut.Cascade) -> None:
    """The gate is tight: the surface in use passes, a slightly dearer one does not."""
    x = cascade.mechanism.state(phi=ut.deg(30))
    assert cost_gate(cascade.loop, Plan.of(GOOD), Plan.of(GOOD), x, 60.0).accepted
    worse = ut.Surface(-1, GOOD.lambda_a * 0.999, GOOD.alpha_u, GOOD.lambda_u)
    costs = cascade.loop.batch(x, [GOOD, worse]).cost
    assert costs[1] > costs[0]
    assert not cost_gate(cascade.loop, Plan.of(GOOD), Plan.of(worse), x, 60.0).accepted


def test_proposals_out_of_order_are_refused(cascade: ut.Cascade) -> None:
    """A number that is not newer than the last one considered changes nothing."""
    x = cascade.mechanism.state(phi=ut.deg(30))
    state = CascadeState(Plan.of(BASE), 0, math.inf)
    proposal = cascade.propose(state, x)
    after, admission = cascade.apply_gate(state, proposal, x)
    assert admission.accepted
    again, refused = cascade.apply_gate(after, proposal, x)
    assert again is after
    assert not refused.accepted
    assert refused.reason.startswith("stale")


# -- belief and truth, refusals ----------------------------------------------------------------


def test_truth_may_differ_from_belief(cascade: ut.Cascade) -> None:
    """A plant 8 % heavier and twice as damped is still brought home, unknown to the belief."""
    truth = cascade.mechanism.with_parameters(m=0.135, d_e=0.05)
    run = cascade.simulate(phi=ut.deg(25), plant=truth)
    assert run.reached
    believed = cascade.simulate(phi=ut.deg(25))
    assert run.surfaces[0] == believed.surfaces[0]
    assert not np.array_equal(run.trajectory.x[-1], believed.trajectory.x[-1])


def test_fast_step_is_bounded_and_never_nan(cascade: ut.Cascade) -> None:
    """At any state, singular ones too, the input is a number within the limit."""
    rng = np.random.default_rng(0)
    states = rng.uniform(-1, 1, (2000, 4)) * [10, np.pi, 50, 50]
    control = cascade.control(CascadeState(Plan.of(GOOD)), 0.0, states)
    assert np.isfinite(control.u).all()
    assert np.abs(control.u).max() <= 15.0


@pytest.mark.slow
def test_hard_input_limit_that_no_surface_meets_is_refused(rig: ut.Mechanism) -> None:
    """The first optimisation raises, with value, limit and remedy, before anything moves."""
    cascade = ut.Cascade(
        rig.with_input_limit(0.3),
        ut.MinimumTime(hard_input=True),
        cold=ut.Budget(300),
        belief="exact",
    )
    with pytest.raises(InfeasibleError) as caught:
        cascade.simulate(phi=ut.deg(30))
    assert "hard input limit" in str(caught.value.value)
    assert caught.value.limit
    assert "Raise the actuator limit" in caught.value.remedy


def test_unusable_settings_are_refused(rig: ut.Mechanism) -> None:
    """A period off the step grid, an unstable and a singular first surface, a wrong state."""
    with pytest.raises(InvalidInputError, match="period"):
        ut.Cascade(rig, period=0.0333, belief="exact")
    with pytest.raises(UnstableSurfaceError):
        ut.Cascade(rig, first=ut.Surface(-1, 0.5, 5, 10), belief="exact")
    with pytest.raises((SingularSurfaceError, UnstableSurfaceError)):
        ut.Cascade(rig, first=ut.Surface(-1, -0.5, 0.5, 10), belief="exact")
    with pytest.raises(InvalidInputError, match="'psi'"):
        ut.Cascade(rig, belief="exact").simulate(psi=0.1)


# -- how far down the kernel is ----------------------------------------------------------------


@pytest.mark.parametrize("objective", [ut.MinimumEnergy(horizon=2.0), ut.MinimumTime()])
def test_ten_frames_lie_between_simulate_and_the_kernel(
    objective: ut.Objective, rig: ut.Mechanism, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whoever looks for what is slow, or wrong, reads ten functions: doors included."""
    compiled, depths = kernel.compile_loop, []

    def watched(*args: Any) -> SimpleNamespace:
        kernels = compiled(*args)

        def run(name: str, *numbers: Any) -> None:
            depths.append(sum(1 for _ in traceback.walk_stack(sys._getframe(1))) - outside)
            getattr(kernels, name)(*numbers)

        return SimpleNamespace(
            rollout=partial(run, "rollout"), etd_integrate=partial(run, "etd_integrate")
        )

    monkeypatch.setattr(rollout, "compile_loop", watched)
    few = ut.Budget(200)
    cascade = ut.Cascade(rig, objective, cold=few, warm=few, belief="exact")
    outside = sum(1 for _ in traceback.walk_stack(sys._getframe()))
    cascade.simulate(phi=ut.deg(20))
    assert 5 < max(depths) <= 10


def test_a_run_that_ends_early_is_planned_to_arrive_by_then(rig: ut.Mechanism) -> None:
    """The first plan looks no farther than the run: as if the horizon were as short."""
    given: Any = {"cold": ut.Budget(600), "warm": ut.Budget(96), "belief": "exact"}
    x = rig.state(phi=ut.deg(30))
    run = ut.Cascade(rig, ut.MinimumEnergy(horizon=10.0), **given).simulate(x, duration=1.5)
    by_horizon = ut.Cascade(rig, ut.MinimumEnergy(horizon=1.5), **given).simulate(x)
    assert run.reached
    assert run.updates[0].admission.reason == "first optimum"
    assert run.updates[0].predicted == by_horizon.updates[0].predicted
    assert run.cost == pytest.approx(by_horizon.cost, rel=1e-3)
    assert np.nanmin(run.lemma3_slack) > -1e-6
    assert np.isfinite(run.lemma3_slack).all()


def test_a_run_that_ends_before_anything_can_arrive_begins_all_the_same(
    cascade: ut.Cascade,
) -> None:
    run = cascade.simulate(phi=ut.deg(30), duration=0.2)
    assert run.time == pytest.approx(0.2)
    assert run.trajectory.event.name == "HORIZON"
    with pytest.raises(InvalidInputError, match="duration of a run"):
        cascade.simulate(phi=ut.deg(30), duration=1e-4)
    with pytest.raises(
        InvalidInputError, match=r"duration of a run, s: got 0\.002, must be ≥ 0\.004"
    ):
        cascade.simulate(phi=ut.deg(30), duration=cascade.step)


@pytest.mark.slow
def test_a_target_that_the_inputs_cannot_hold_is_named(rig: ut.Mechanism) -> None:
    """No search finds a surface then; to start closer, as other refusals advise, would not help."""
    pushed = rig.disturbed({"theta": 0.5})
    need = float(abs(ut.modelling.holding_input(pushed)[0]))
    weak = pushed.with_input_limit(0.9 * need)
    cascade = ut.Cascade(weak, ut.MinimumTime(horizon=2.0), cold=ut.Budget(64), belief="exact")
    with pytest.raises(InfeasibleError) as caught:
        cascade.simulate(phi=0.1)
    said = f"got {need:.3g} V, must be below its limit of {0.9 * need:.3g}"
    assert said in str(caught.value)
    assert "input 'voltage' that holds the target" in str(caught.value)


def test_a_cascade_is_for_the_usual_objective_where_nobody_says(rig: ut.Mechanism) -> None:
    """In Python as on the command line."""
    usual, stated = ut.Cascade(rig).objective, ut.objective_for(rig)
    assert (usual, usual.name) == (stated, "effort")
    assert pickle.loads(pickle.dumps(ut.Cascade(rig))).objective == usual
    with pytest.raises(InvalidInputError, match="mechanism of Cascade"):
        ut.Cascade("rotary_pendulum")  # type: ignore[arg-type]


@pytest.mark.parametrize("duration", [0.0335, 0.0301])
def test_a_run_ends_when_it_was_asked_to(rig: ut.Mechanism, duration: float) -> None:
    cascade = ut.Cascade(rig, ut.MinimumEnergy(), belief="exact", cold=Budget(32), warm=Budget(8))
    run = cascade.simulate(phi=0.3, duration=duration)
    assert run.time == pytest.approx(duration, abs=1e-15)
    assert len(run.trajectory.t) == 18 if duration > 0.033 else 17


def test_what_is_no_figure_is_not_filmed(run: ut.Run, tmp_path: Path) -> None:
    film = tmp_path / "film.gif"
    figure: Any = "stick"
    with pytest.raises(InvalidInputError, match="figure of an animation"):
        run.animate(film, figure=figure)
    assert not film.exists()


def test_what_is_no_planner_or_no_verdict_of_a_gate_is_refused(rig: ut.Mechanism) -> None:
    """By name, and not as a missing attribute of None after the first search."""
    with pytest.raises(InvalidInputError, match=r"planner of the cascade.*the method propose"):
        ut.Cascade(rig, planner=lambda _x: None)  # type: ignore[arg-type]
    wordless = ut.Cascade(rig, planner=SimpleNamespace(propose=lambda *_, **__: None))
    with pytest.raises(
        InvalidInputError, match=r"planner: got a NoneType, must be an undertow\.Proposal"
    ):
        wordless.simulate(phi=0.1)
    silent: Any = lambda *_: None  # noqa: E731
    cascade = ut.Cascade(rig, ut.MinimumTime(), belief="exact", gate=silent, cold=Budget(32))
    with pytest.raises(InvalidInputError, match=r"gate of the cascade returned.*None.*Admission"):
        cascade.simulate(phi=0.2, duration=0.1)


@pytest.mark.slow
@pytest.mark.parametrize(("x_dot", "farthest"), [(0.0, 0.36), (0.4, 0.52)])
def test_a_state_beyond_a_constraint_is_planned_back(x_dot: float, farthest: float) -> None:
    """As after a push on a rig: plans are admitted out there, and lead back inside."""
    cart = ut.mechanisms.cart_pendulum()
    box = ut.state_box(x=0.3)
    cascade = ut.Cascade(cart, ut.MinimumEnergy(constraints=box), belief="exact")
    state, _ = cascade.start(cart.state(x=0.1))
    x, admitted = cart.state(x=0.33, x_dot=x_dot), 0
    places = [x[0]]
    free = ut.ClosedLoop(cart, ut.MinimumEnergy(travel=False))
    for k in range(20):
        t = 0.1 * k
        proposal = cascade.propose(state, x, t)
        state, admission = cascade.apply_gate(state, proposal, x)
        admitted += admission.accepted
        assert "constraint" not in admission.reason
        motion = free.simulate(x, state.at(t), duration=0.1, terminal=0.0)
        x = motion.x[-1]
        places += [*motion["x"]]
    assert admitted > 1
    assert abs(x[0]) < 0.3
    assert max(places) < farthest  # to go back it leans that way first


@pytest.mark.parametrize("t", [math.nan, math.inf, -math.inf])
def test_a_time_that_is_none_is_refused(rig: ut.Mechanism, t: float) -> None:
    """A plan would begin then, and never go on to its next surface."""
    cascade = ut.Cascade(rig, ut.MinimumTime(), belief="exact", cold=ut.Budget(64))
    x = rig.state(phi=0.1)
    state, _ = cascade.start(x)
    for ask in (
        lambda: cascade.start(x, t=t),
        lambda: cascade.propose(state, x, t),
        lambda: cascade.control(state, t, x),
    ):
        with pytest.raises(InvalidInputError, match=rf"time, s: got {t}"):
            ask()


def test_a_period_that_no_rollout_can_have_is_refused_for_that() -> None:
    """It was taken, and the simulation then complained of the horizon."""
    rig = ut.mechanisms.rotary_pendulum()
    with pytest.raises(InvalidInputError, match=r"inner step, 0.002 s, up to 10000 s"):
        ut.Cascade(rig, period=1e9)
