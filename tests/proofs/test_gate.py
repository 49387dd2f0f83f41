"""The gate with verdicts: evidence for each plan that is applied, bad proposals refused."""

from __future__ import annotations

import math
import pickle
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest

import undertow as ut
from undertow.base import InvalidInputError
from undertow.cascade import Admission, cost_gate
from undertow.law import Plan, ProvedSet
from undertow.law.sliding import singularity
from undertow.models import FloatArray
from undertow.proofs.claims.terminal_ellipsoid import TerminalEllipsoid
from undertow.proofs.gate import Evidence, GatePolicy, assess, certified_gate
from undertow.proofs.search.terminal_ellipsoid import search_for

RIG = ut.mechanisms.rotary_pendulum(d_e=0.025)
GOOD = ut.Surface(-1, -1.59, 1.96, 12.1)
SLOW = ut.Surface(-1, -0.5, 5, 10)
DEAR = ut.Surface(-1, -0.02, 5, 10)
UNSTABLE = ut.Surface(-1, 0.5, 5, 10)
LOOP = ut.ClosedLoop(RIG, ut.MinimumTime(horizon=20.0))


def singular_at(angle: float) -> ut.Surface:
    """A stable surface whose law ceases to exist at ±angle, (37): α_u = c/(b cos angle)."""
    M = RIG.M(np.zeros(2))
    alpha_u = float(-M[1, 1] / M[0, 1] / np.cos(angle))
    surface = ut.Surface(-1, -1.0, alpha_u, 8 * alpha_u)
    assert float(singularity(RIG, surface.vector, [0.0, angle])) == pytest.approx(0, abs=1e-12)
    assert ut.law.stability.stability_margin(RIG, surface) > 0
    return surface


@dataclass
class Fake:
    """An optimiser that answers from a list, whatever it is asked."""

    answers: Sequence[ut.Surface | None]
    asked: list[float] = field(default_factory=list)

    def propose(self, x: FloatArray, **rest: Any) -> ut.Proposal:
        if rest["incumbent"] is None:
            return self._proposal(GOOD, 0, 0.0)
        surface = self.answers[len(self.asked) % len(self.answers)]
        self.asked.append(rest["computed_for"])
        return self._proposal(surface, rest["sequence"], rest["computed_for"])

    @staticmethod
    def _proposal(surface: ut.Surface | None, sequence: int, t: float) -> ut.Proposal:
        plan = None if surface is None else Plan.of(surface)
        message = "" if plan is not None else "nothing found"
        return ut.Proposal(plan, "converged", 0.0, 0.0, (), 0, 0.0, sequence, t, message)


def cascade(answers: Sequence[ut.Surface | None], **settings: Any) -> ut.Cascade:
    """A cascade whose optimiser lies: it claims cost 0 for everything."""
    goal = ut.MinimumTime(horizon=20.0)
    gate = certified_gate(GatePolicy())
    return ut.Cascade(
        RIG, goal, gate=gate, first=GOOD, planner=Fake(answers), **settings, belief="exact"
    )


def test_bad_proposals_are_refused_and_the_run_converges() -> None:
    """Unstable, singular on the way, singular just beyond the state, dearer, nothing at all."""
    bad = [UNSTABLE, singular_at(0.05), singular_at(0.32), DEAR, None]
    run = cascade(bad).simulate(phi=0.3)
    assert run.reached
    assert set(run.surfaces) <= {GOOD, DEAR}
    refused = [u for u in run.updates[1:] if not u.admission.accepted]
    for word in ("unstable", "singular", "raises the predicted cost", "nothing found"):
        assert any(word in update.admission.reason for update in refused), word
    assert "singular" in run.updates[2].admission.reason
    near = certified_gate()(LOOP, Plan.of(GOOD), Plan.of(singular_at(0.302)), FAR, 20.0)
    assert not near.accepted
    # No worse than the run that would have been without any proposal.
    alone = LOOP.simulate(RIG.state(phi=0.3), GOOD)
    assert run.time <= alone.time + 1e-9
    assert run.lemma3_slack.min() >= -1e-9


def test_each_applied_plan_has_its_verdict() -> None:
    """In every decision: sampled by prediction far off, proved near the target."""
    run = cascade([GOOD, UNSTABLE]).simulate(phi=0.3)
    kinds = []
    for verdict in run.verdicts:
        assert verdict is not None
        kinds.append(verdict.kind)
        assert verdict.details["evidence"] == {"sampled": "dual", "proved": "region"}[verdict.kind]
    assert kinds[0] == "sampled"
    assert "not validated" in run.verdicts[0].method  # type: ignore[union-attr]
    assert kinds[-1] == "proved"
    # Once inside a proved set, always inside: it is invariant.
    assert kinds == sorted(kinds, key=["sampled", "proved"].index)


QUICK = [ut.Surface(-1, -2.2, 1.7, 11.0), ut.Surface(-1, -2.0, 1.6, 10.5), SLOW, GOOD]
THRIFTY = [ut.Surface(-1, -0.7, 2.3, 21.8), ut.Surface(-1, -0.69, 2.5, 22.2), SLOW, GOOD]


@pytest.mark.parametrize(
    ("goal", "surfaces"),
    [(ut.MinimumTime(horizon=20.0), QUICK), (ut.MinimumEnergy(horizon=20.0), THRIFTY)],
    ids=["time", "energy"],
)
def test_the_switching_sequence_descends(goal: ut.Objective, surfaces: list[ut.Surface]) -> None:
    """Lemma 3 along the run, with switches in it: J̃ falls by what is spent at least."""
    run = replace(cascade([]), objective=goal, planner=Fake(surfaces)).simulate(phi=0.3)
    assert run.reached
    assert len(set(run.surfaces)) > 1
    assert run.lemma3_slack.min() >= -1e-6 * run.cost
    assert run.cost <= run.updates[0].predicted * (1 + 1e-6)


def test_without_the_gate_the_same_proposals_do_harm() -> None:
    """The trap is a trap: a gate that admits everything lets the run fail."""

    def open_gate(*arguments: Any) -> Admission:
        return Admission(True, "anything goes", math.inf)

    made = replace(cascade([UNSTABLE]), gate=open_gate)
    assert not made.simulate(phi=0.3).reached


NEAR = RIG.state(phi=1e-3)
FAR = RIG.state(phi=0.3)


@pytest.mark.parametrize(
    ("accept", "x", "kind"),
    [
        (("region",), NEAR, "proved"),
        (("region",), FAR, "undecided"),
        (("dual",), FAR, "sampled"),
        (("sampled",), FAR, "sampled"),
        (("local",), FAR, "sampled"),
        (("region", "dual", "sampled", "local"), NEAR, "proved"),
    ],
)
def test_a_policy_says_what_will_do(accept: tuple[Evidence, ...], x: FloatArray, kind: str) -> None:
    verdict = assess(LOOP, Plan.of(GOOD), x, 20.0, GatePolicy(accept))
    assert verdict.kind == kind
    if kind == "undecided":
        assert verdict.details["evidence"] is None
        assert "region: " in verdict.method
    else:
        assert verdict.details["evidence"] == accept[0]
        assert verdict.margin > 0


@pytest.mark.parametrize("kind", ["dual", "sampled"])
def test_evidence_holds_up_to_the_margin_that_it_tells_and_no_further(kind: Evidence) -> None:
    """The smallest det Γ/det Γ(0) on the way is what a policy may ask for at most."""
    policy = GatePolicy((kind,))
    least = assess(LOOP, Plan.of(GOOD), FAR, 20.0, policy).margin
    for part, granted in ((1 - 1e-9, True), (1 + 1e-9, False)):
        asks = replace(policy, singular_margin=part * least)
        verdict = assess(LOOP, Plan.of(GOOD), FAR, 20.0, asks)
        assert (verdict.kind == "sampled") is granted
        assert granted or "singularity margin" in verdict.method


@pytest.mark.parametrize(
    ("surface", "horizon", "words"),
    [
        (UNSTABLE, 20.0, "unstable, margin"),
        (GOOD, 0.1, "motion ends: horizon"),
        (singular_at(0.2), 20.0, "motion ends: singular"),
    ],
)
def test_local_evidence_is_a_motion_that_arrives_where_the_loop_is_stable(
    surface: ut.Surface, horizon: float, words: str
) -> None:
    """Its margin is the slowest rate there; without either there is none, and it says why."""
    policy = GatePolicy(("local",))
    margin = float(ut.law.stability_margin(RIG, GOOD))
    assert assess(LOOP, Plan.of(GOOD), FAR, 20.0, policy).margin == pytest.approx(margin)
    verdict = assess(LOOP, Plan.of(surface), FAR, horizon, policy)
    assert verdict.kind == "undecided"
    assert words in verdict.method


def test_local_evidence_keeps_to_the_margins_of_the_policy() -> None:
    """The smallest det Γ/det Γ(0) of the predicted motion counts there, too."""
    least = float(LOOP.batch(FAR, GOOD).singular[0])
    for part, granted in ((0.999, True), (1.001, False)):
        verdict = assess(LOOP, Plan.of(GOOD), FAR, 20.0, GatePolicy(("local",), part * least))
        assert (verdict.kind == "sampled") is granted
        assert granted or "singularity margin" in verdict.method


@pytest.mark.slow
def test_margins_of_the_policy_count() -> None:
    """A singularity close to the path, a constraint, a hard input limit."""
    near = singular_at(0.32)
    assert assess(LOOP, Plan.of(near), FAR, 20.0, GatePolicy(("dual",))).kind == "undecided"
    strict = GatePolicy(("dual",), singular_margin=0.92)
    assert "singularity margin" in assess(LOOP, Plan.of(GOOD), FAR, 20.0, strict).method
    box = ut.state_box(phi_dot=4.0)
    goal = ut.MinimumTime(horizon=20.0, constraints=box, hard_input=True)
    loop = ut.ClosedLoop(RIG.with_input_limit(100.0), goal)
    free = loop.batch(FAR, GOOD)
    assert free.reached
    path, spare = float(free.path.min()), float(free.input.min())

    def answer(constraint_margin: float = 0.0, input_margin: float = 0.0) -> str:
        policy = GatePolicy(("dual",), 0.05, constraint_margin, input_margin)
        verdict = assess(loop, Plan.of(GOOD), FAR, 20.0, policy)
        return verdict.method if verdict.kind == "undecided" else verdict.kind

    assert answer(constraint_margin=0.9 * path, input_margin=0.9 * spare) == "sampled"
    assert "phi_dot" in answer(constraint_margin=1.1 * path)
    assert "input margin" in answer(input_margin=1.1 * spare)


@pytest.mark.slow
def test_a_sampled_loop_has_no_terminal_set() -> None:
    """The sets are proved for the continuous law; with a held input the gate says so."""
    held = replace(LOOP, zoh_steps=1)
    verdict = assess(held, Plan.of(GOOD), FAR, 20.0)
    assert verdict.kind == "undecided"
    assert "continuous law" in verdict.method
    assert assess(held, Plan.of(GOOD), FAR, 20.0, GatePolicy(("sampled",))).kind == "sampled"


def test_nearby_states_that_fail_are_counted() -> None:
    wide = GatePolicy(("sampled",), samples=32, spread=1.5)
    assert "nearby states fail" in assess(LOOP, Plan.of(GOOD), FAR, 20.0, wide).method


@dataclass
class Known:
    """States of a set that was proved before."""

    inside: Callable[[FloatArray], bool]

    def contains(self, x: FloatArray) -> bool:
        return self.inside(x)


def test_sets_that_were_proved_before_are_used() -> None:
    """For the same surface and law alone."""
    here = ProvedSet(GOOD, ut.ReachingLaw(), Known(lambda x: bool(abs(x[1]) < 0.4)))
    other = ProvedSet(SLOW, ut.ReachingLaw(), Known(lambda x: True))
    only = GatePolicy(("region",))
    assert assess(LOOP, Plan.of(GOOD), FAR, 20.0, only, [other]).kind == "undecided"
    assert assess(LOOP, Plan.of(GOOD), FAR, 20.0, only, [other, here]).kind == "proved"
    faster = ut.ReachingLaw(eta=40.0)
    plan = Plan((GOOD,), (0.0,), (faster,))
    assert assess(LOOP, plan, FAR, 20.0, only, [here]).kind == "undecided"
    assert assess(LOOP, plan, FAR, 20.0, only, [replace(here, reaching=faster)]).kind == "proved"
    same = Plan((GOOD,), (0.0,), (ut.ReachingLaw((20.0,), (0.1,)),))  # as an optimiser writes it
    assert assess(LOOP, same, FAR, 20.0, only, [here]).kind == "proved"


def test_a_schedule_is_judged_by_its_last_surface() -> None:
    """Prediction goes through the changes; no region is claimed before the last one acts."""
    plan = Plan((SLOW, GOOD), (0.0, 0.2))
    assert assess(LOOP, plan, FAR, 20.0).details["evidence"] == "dual"
    assert "changes surfaces" in assess(LOOP, plan, NEAR, 20.0, GatePolicy(("region",))).method
    broken = Plan((GOOD, UNSTABLE), (0.0, 0.2))
    assert assess(LOOP, broken, FAR, 20.0).kind == "undecided"


def test_the_refusal_keeps_the_old_plans_cost_and_verdict() -> None:
    """Stable, cheaper, and still refused: its path passes the singularity too closely."""
    policy = GatePolicy(("dual",), singular_margin=0.9)
    fast = ut.Surface(-1, -3.0, 1.42, 9.2)
    gate = certified_gate(policy)
    cheap = cost_gate(LOOP, Plan.of(SLOW), Plan.of(fast), FAR, 20.0)
    assert cheap.accepted
    admission = gate(LOOP, Plan.of(SLOW), Plan.of(fast), FAR, 20.0)
    assert not admission.accepted
    assert "no accepted evidence" in admission.reason
    assert admission.cost == pytest.approx(float(LOOP.batch(FAR, SLOW).time[0]))
    assert admission.verdict is not None
    assert admission.verdict.details["evidence"] == "dual"


@pytest.mark.slow  # an interpreter of its own
def test_a_gate_travels_to_another_process() -> None:
    """The optimiser may run in a process of its own: what it decides there is the same."""
    gate = certified_gate(GatePolicy(("dual",), singular_margin=0.1), tail=5e-3)
    there = pickle.loads(pickle.dumps(gate))
    assert there == gate
    question = (LOOP, Plan.of(SLOW), Plan.of(GOOD), FAR, 20.0)
    assert there(*question) == gate(*question)


def test_the_first_plan_is_used_and_judged() -> None:
    """There is no other: the log says what the gate thinks of it."""
    strict = certified_gate(GatePolicy(("region",)))
    made = replace(cascade([None]), gate=strict)
    run = made.simulate(phi=0.3)
    first = run.updates[0].admission
    assert first.accepted
    assert first.reason.startswith("first optimum, although no accepted evidence")
    assert run.verdicts[-1]


def test_ellipsoids_of_the_gate_are_invariant_under_switching_back() -> None:
    """The level of the set that admitted a plan falls along the motion that follows."""
    search = search_for(RIG, GOOD, ut.ReachingLaw())
    assert search is not None
    x = LOOP.batch(FAR, GOOD, duration=2.0, terminal=0.0).x[0]
    found = search.around(x)
    assert isinstance(found, TerminalEllipsoid)
    levels = []
    for _ in range(10):
        levels.append(float(found.level(x)))
        x = LOOP.batch(x, GOOD, duration=0.1, terminal=0.0).x[0]
    assert levels[0] <= 1
    assert (np.diff(levels) < 0).all()


@pytest.mark.parametrize(
    "settings",
    [
        {"accept": ()},
        {"accept": ("faith",)},
        {"singular_margin": 1.0},
        {"constraint_margin": math.nan},
        {"input_margin": -1.0},
        {"spread": math.inf},
        {"samples": 0},
    ],
)
def test_policies_that_mean_nothing_are_refused(settings: dict[str, Any]) -> None:
    with pytest.raises(InvalidInputError, match="polic"):
        GatePolicy(**settings)
