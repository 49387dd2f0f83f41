"""One result for each plan on an ensemble: what its members alone say, put together by hand."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

import undertow as ut
from undertow.base import InvalidInputError
from undertow.closed_loop import INADMISSIBLE, Ensemble, Event
from undertow.closed_loop.buffers import RolloutBuffers
from undertow.closed_loop.ensemble import Risk, summarise
from undertow.closed_loop.gate import cost_gate
from undertow.closed_loop.work_array import LANES
from undertow.law import SlidingModeLaw
from undertow.models import FloatArray

HORIZON = 20.0


@pytest.fixture(scope="module")
def plants(rig: ut.Mechanism) -> list[ut.Mechanism]:
    """The nominal plant and five that differ from it."""
    rng, value = np.random.default_rng(7), {p.name: p.value for p in rig.parameters}
    spread = {"m": 0.2, "l": 0.05, "I_e": 0.2, "a_e": 0.1, "d_e": 0.5}
    drawn = [
        {name: value[name] * (1 + rng.uniform(-part, part)) for name, part in spread.items()}
        for _ in range(5)
    ]
    return [rig, *(rig.with_parameters(**values) for values in drawn)]


@pytest.fixture(scope="module")
def loop(rig: ut.Mechanism, plants: list[ut.Mechanism]) -> ut.ClosedLoop:
    """The law of the nominal plant on all of them."""
    values = np.array([plant.parameter_values for plant in plants])
    goal = ut.MinimumEnergy(horizon=HORIZON)
    return ut.ClosedLoop(rig, goal, ensemble=Ensemble(rig, values))


@pytest.fixture(scope="module")
def surfaces(base: ut.Surface, quick: ut.Surface) -> list[ut.Surface]:
    """One that all members survive, one that is slower, one that none survives."""
    return [quick, ut.Surface(-1, -1.2, 1.8, 10.1), ut.Surface(-1, -0.5, 1.0, 0.5)]


def test_each_member_is_the_plant_alone(
    loop: ut.ClosedLoop, plants: list[ut.Mechanism], surfaces: list[ut.Surface]
) -> None:
    """Costs, events and margins come from single plants, to rounding."""
    x = loop.mechanism.state(phi=0.4)
    together = loop.batch(x, surfaces)
    alone = [replace(loop, ensemble=None, plant=plant).batch(x, surfaces) for plant in plants]
    for k in range(2):
        assert all(one.event[k] == Event.REACHED for one in alone)
        assert together.event[k] == Event.REACHED
        costs = [float(one.cost[k]) for one in alone]
        assert together.cost[k] == pytest.approx(math.fsum(costs) / len(costs), rel=1e-12)
        assert together.time[k] == pytest.approx(max(one.time[k] for one in alone), rel=1e-12)
        margins = [one.singular[k] for one in alone]
        assert together.singular[k] == pytest.approx(min(margins), rel=1e-12)
    assert together.event[2] not in (Event.REACHED, Event.HORIZON)
    assert together.time[2] == pytest.approx(min(one.time[2] for one in alone), rel=1e-12)
    assert together.score(HORIZON)[2] >= INADMISSIBLE


def test_inadmissible_on_one_is_inadmissible(
    loop: ut.ClosedLoop, plants: list[ut.Mechanism], quick: ut.Surface
) -> None:
    """From a start that some members survive and others do not, no plan is admissible."""
    angles = np.radians(np.arange(30.0, 52.0, 1.0))
    starts = np.array([loop.mechanism.state(phi=angle) for angle in angles])
    alone = np.array(
        [replace(loop, ensemble=None, plant=one).batch(starts, quick).reached for one in plants]
    )
    together = loop.batch(starts, quick).reached
    assert (alone.any(axis=0) & ~alone.all(axis=0)).any()
    assert (together == alone.all(axis=0)).all()


def test_risk_measures_are_ordered(loop: ut.ClosedLoop, surfaces: list[ut.Surface]) -> None:
    """Mean ≤ mean of the dearest third ≤ dearest, and the last two by hand."""
    x, ensemble = loop.mechanism.state(phi=0.4), loop.ensemble
    assert ensemble is not None
    cost = {
        risk: replace(loop, ensemble=replace(ensemble, risk=risk))
        .batch(x, surfaces[:2])
        .cost.copy()
        for risk in ("mean", "cvar", "worst")
    }
    assert (cost["mean"] < cost["cvar"]).all()
    assert (cost["cvar"] < cost["worst"]).all()
    alone = np.sort(
        [
            replace(loop, ensemble=replace(ensemble, values=one[None])).batch(x, surfaces[:2]).cost
            for one in ensemble.values
        ],
        axis=0,
    )
    assert cost["worst"] == pytest.approx(alone[-1], rel=1e-14)
    assert cost["cvar"] == pytest.approx(alone[-2:].mean(axis=0), rel=1e-14)


def test_weights_count_in_the_cost_alone(
    loop: ut.ClosedLoop, surfaces: list[ut.Surface], quick: ut.Surface
) -> None:
    """Mean and tail by hand; a member without weight still has to arrive."""
    x, ensemble = loop.mechanism.state(phi=0.4), loop.ensemble
    assert ensemble is not None
    weights = np.array([4.0, 0.0, 1.0, 1.0, 3.0, 1.0])
    alone = np.array(
        [
            replace(loop, ensemble=replace(ensemble, values=one[None])).batch(x, quick).cost[0]
            for one in ensemble.values
        ]
    )

    def cost(risk: Risk) -> float:
        weighed = replace(ensemble, risk=risk, weights=weights)
        return float(replace(loop, ensemble=weighed).batch(x, quick).cost[0])

    assert cost("mean") == pytest.approx(weights @ alone / 10.0, rel=1e-12)
    assert cost("worst") == pytest.approx(alone.max(), rel=1e-14)
    drawn = np.repeat(alone, (300 * weights).astype(int))  # 3000 members, the same distribution
    assert cost("cvar") == pytest.approx(np.sort(drawn)[-1000:].mean(), rel=1e-12)
    none = np.eye(6)[0]
    far = [loop.mechanism.state(phi=math.radians(a)) for a in np.arange(30.0, 52.0, 1.0)]
    first_alone = replace(loop, ensemble=replace(ensemble, weights=none)).batch(far, quick).reached
    assert (first_alone == loop.batch(far, quick).reached).all()


def test_the_dearest_counts_as_worst_without_weight_too(
    loop: ut.ClosedLoop, quick: ut.Surface
) -> None:
    x, ensemble = loop.mechanism.state(phi=0.4), loop.ensemble
    assert ensemble is not None
    alone = [
        replace(loop, ensemble=replace(ensemble, values=one[None])).batch(x, quick).cost[0]
        for one in ensemble.values
    ]
    weights = np.ones(6)
    weights[int(np.argmax(alone))] = 0.0
    worst = replace(loop, ensemble=replace(ensemble, risk="worst", weights=weights))
    assert worst.batch(x, quick).cost[0] == pytest.approx(max(alone), rel=1e-14)


def test_one_result_for_each_plan_is_put_together_as_documented() -> None:
    """:func:`summarise` on rows drawn at random, with all events and many ties, and in words.

    What breaks off stands before what is late or dear, the earlier before the later; what is late
    or dear before what arrives, the farther before the nearer; of equals the first member.
    """
    rng, plans, members, margins, states = np.random.default_rng(12), 300, 5, 3, 4
    broken = (Event.CONSTRAINT, Event.SINGULAR, Event.DIVERGED, Event.UNSTABLE)
    rows = rng.integers(0, 4, (plans, members, 7 + margins + 2 * states)).astype(float)
    rows[..., 0] = rng.uniform(0, 9, (plans, members))
    kinds = [[Event.REACHED], [Event.REACHED, Event.HORIZON, Event.COSTLY], list(Event)]
    for k in range(plans):
        rows[k, :, 2] = rng.choice(kinds[k % 3], members)
    weights = np.array([0.1, 0.3, 0.0, 0.25, 0.35])
    for tail in (0.0, 1 / 3, 1.0):
        out = np.empty((plans, rows.shape[-1]))
        summarise(rows.reshape(plans * members, -1), weights, tail, margins, out)
        for all_of_plan, found in zip(rows, out, strict=True):
            events = all_of_plan[:, 2]
            if np.isin(events, broken).any():
                worst = min((k for k in range(members) if events[k] in broken),
                            key=lambda k: all_of_plan[k, 1])  # fmt: skip
            else:
                late = [k for k in range(members) if events[k] != Event.REACHED]
                worst = max(late or range(members), key=lambda k: all_of_plan[k, 3])
            expected = all_of_plan[worst].copy()
            if (events == Event.REACHED).all():
                expected[0] = _dearest_part(all_of_plan[:, 0], weights, tail)
                expected[1] = all_of_plan[:, 1].max()
            expected[4 : 4 + margins] = all_of_plan[:, 4 : 4 + margins].min(axis=0)
            near = slice(4 + margins, 6 + margins + states)
            expected[near] = all_of_plan[int(np.argmax(all_of_plan[:, near.start])), near]
            final = slice(6 + margins + states, 6 + margins + 2 * states)
            expected[final] = all_of_plan[0, final]
            expected[-1] = all_of_plan[:, -1].sum()
            np.testing.assert_allclose(found, expected, rtol=1e-12)


def _dearest_part(costs: FloatArray, weights: FloatArray, tail: float) -> float:
    """Mean over the dearest of ten thousand copies, as many of each as it weighs."""
    if tail == 0.0:
        return float(costs.max())
    copies = np.sort(np.repeat(costs, np.round(6e4 * weights).astype(int)))
    return float(copies[-round(6e4 * tail) :].mean())


def test_blocks_are_filled_with_the_last_lane(loop: ut.ClosedLoop, quick: ut.Surface) -> None:
    """Buffers, those of all members and parts of them: whole blocks, and nothing made up."""
    ensemble, size = loop.ensemble, loop.mechanism.n * 2 + 3
    assert ensemble is not None
    rng = np.random.default_rng(2)
    vectors, states = rng.uniform(1, 2, (7, 2, 4)), rng.uniform(-1, 1, (7, 4))
    laws = rng.uniform(1, 2, (7, 2, 2))
    buffers = RolloutBuffers(loop, 7, 2).fill(states, vectors, laws)
    assert buffers.padded == LANES
    for k in range(LANES):
        own = min(k, 6)
        np.testing.assert_array_equal(buffers.states[k], states[own])
        np.testing.assert_array_equal(buffers.lanes[k, :, :4], vectors[own])
        np.testing.assert_array_equal(buffers.lanes[k, :, 4:6], laws[own])
    members = buffers.spread()
    assert (members.count, members.padded) == (42, 48)
    for k in range(48):
        plan, member = divmod(min(k, 41), 6)
        assert members.member[k] == member
        np.testing.assert_array_equal(members.states[k], states[plan])
        np.testing.assert_array_equal(members.lanes[k, :, :size], buffers.lanes[plan])
        np.testing.assert_array_equal(members.lanes[k, 0, size:], ensemble.values[member])
    chosen = np.array([3, 17, 40])
    part = members.part(chosen)
    assert (part.count, part.padded) == (3, LANES)
    for k in range(LANES):
        own = chosen[min(k, 2)]
        assert part.member[k] == members.member[own]
        np.testing.assert_array_equal(part.lanes[k], members.lanes[own])
        np.testing.assert_array_equal(part.states[k], members.states[own])
    assert len(buffers.part(chosen[:1]).member) == 0
    assert RolloutBuffers(loop, LANES, 1).fill(states[0], vectors[0, :1]).padded == LANES


def test_large_steps_know_each_plant(loop: ut.ClosedLoop, surfaces: list[ut.Surface]) -> None:
    """They agree with small steps to the end, and are far fewer."""
    x = loop.mechanism.state(phi=0.4)
    small = loop.batch(x, surfaces[:2])
    cost, steps = small.cost.copy(), small.steps.copy()
    large = replace(loop, tail_rtol=1e-3).batch(x, surfaces[:2])
    assert large.cost == pytest.approx(cost, rel=1e-3)
    assert (large.steps < 0.7 * steps).all()


def test_linear_model_of_another_plant(
    loop: ut.ClosedLoop, plants: list[ut.Mechanism], quick: ut.Surface
) -> None:
    """It is the Jacobian of plant and law, by central differences of both."""
    end, rig = loop.linear_end, loop.mechanism
    assert end is not None
    buffers = loop.batch(rig.state(phi=0.1), quick)  # what a batch writes is not needed here
    assert buffers.reached[0]
    filled = RolloutBuffers(loop, 1, 1).fill(rig.state(phi=0.1), quick.vector).spread()
    room = end.buffers(filled.padded)
    end.prepare(filled.lanes, None, room, filled.member)
    law = SlidingModeLaw(rig, quick, loop.reaching)

    def rate(plant: ut.Mechanism, x: FloatArray) -> FloatArray:
        return plant.accelerations(0.0, x, law(0.0, x).demand)

    for k, plant in enumerate(plants):
        step = 1e-6
        columns = [(rate(plant, step * e) - rate(plant, -step * e)) / (2 * step) for e in np.eye(4)]
        assert room.A[k] == pytest.approx(np.array(columns).T, rel=1e-6, abs=1e-5)


def test_what_makes_no_ensemble(loop: ut.ClosedLoop, rig: ut.Mechanism) -> None:
    """Wrong shapes, NaN and words; a plant beside it; a motion of it."""
    good = rig.parameter_values
    for values in (good, good[None, 1:], np.empty((0, len(good)))):
        with pytest.raises(InvalidInputError, match="members of an ensemble"):
            Ensemble(rig, values)
    broken = np.where(np.array([p.name for p in rig.parameters]) == "m", np.nan, good)[None]
    with pytest.raises(InvalidInputError, match="parameter 'm' of member 0"):
        Ensemble(rig, broken)
    for values in (good[None, None], np.tile(good, (1, 2))):
        with pytest.raises(InvalidInputError, match="members of an ensemble"):
            Ensemble(rig, values)
    with pytest.raises(InvalidInputError, match="plant of Ensemble"):
        Ensemble("rig", good[None])  # type: ignore[arg-type]
    np.testing.assert_allclose(Ensemble(rig, np.tile(good, (4, 1))).shares, 0.25)
    half = Ensemble(rig, np.tile(good, (3, 1)), weights=np.array([0.0, 2.0, 6.0]))
    np.testing.assert_allclose(half.shares, [0.0, 0.25, 0.75])
    with pytest.raises(InvalidInputError, match="risk"):
        Ensemble(rig, good[None], "median")  # type: ignore[arg-type]
    for weights in ([1.0, 1.0], [-1.0], [0.0], [np.nan]):
        with pytest.raises(InvalidInputError, match="weights"):
            Ensemble(rig, good[None], weights=np.array(weights))
    with pytest.raises(InvalidInputError, match="beside an ensemble"):
        replace(loop, plant=rig)


def test_a_motion_of_a_loop_with_an_ensemble_is_that_of_its_mechanism(
    loop: ut.ClosedLoop, rig: ut.Mechanism
) -> None:
    """One plant moves at a time: what is believed, until another is given."""
    x, surface = rig.state(phi=0.1), ut.Surface(-1, -1.59, 1.96, 12.1)
    alone = replace(loop, ensemble=None).simulate(x, surface)
    assert np.array_equal(loop.simulate(x, surface).x, alone.x)


def test_members_with_errors_of_surface_and_state(loop: ut.ClosedLoop, rig: ut.Mechanism) -> None:
    """A plan on a member that is off is worth what the other plan from the other state is."""
    values = np.tile(rig.parameter_values, (2, 1))
    off, aside = np.array([0.0, 0.02, -0.01, 0.03]), np.array([0.01, -0.02, 0.0, 0.0])
    slips = Ensemble(
        rig, values, "worst", surface_errors=np.stack([0 * off, off]),
        state_errors=np.stack([0 * aside, aside]),
    )  # fmt: skip
    x, vector = rig.state(phi=0.3), np.array([-1, -1.59, 1.96, 12.1])
    both = replace(loop, ensemble=slips).batch(x, vector).cost[0]
    alone = replace(loop, ensemble=None)
    costs = [
        alone.batch(x, vector).cost[0],
        alone.batch(x + aside, vector * (1 + off)).cost[0],
    ]
    assert both == pytest.approx(max(costs), rel=1e-12)
    assert costs[0] != pytest.approx(costs[1], rel=1e-3)
    part = 0.5 * float(np.linalg.norm(aside) / np.linalg.norm(x))
    shorter = replace(loop, ensemble=replace(slips, state_error_part=part)).batch(x, vector)
    half = alone.batch(x + 0.5 * aside, vector * (1 + off)).cost[0]
    assert shorter.cost[0] == pytest.approx(max(costs[0], half), rel=1e-12)
    with pytest.raises(InvalidInputError, match="state_error_part"):
        replace(slips, state_error_part=0.0)
    with pytest.raises(InvalidInputError, match="surface_errors"):
        Ensemble(rig, values, surface_errors=np.zeros((2, 3)))
    with pytest.raises(InvalidInputError, match="state_errors"):
        Ensemble(rig, values, state_errors=np.full((2, 4), np.nan))


def test_of_two_plans_that_fail_the_gate_keeps_the_one_that_all_survive_longer(
    loop: ut.ClosedLoop, base: ut.Surface, quick: ut.Surface
) -> None:
    """A plan that some plausible plant fails may yet save the true one; of one plant it cannot."""
    x, plans = loop.mechanism.state(phi=0.9), (ut.Plan.of(quick), ut.Plan.of(base))
    fails = loop.batch(x, list(plans))
    assert not fails.reached.any()
    assert fails.time[0] < fails.time[1]
    shorter, longer = plans
    admitted = cost_gate(loop, shorter, longer, x, HORIZON)
    assert admitted.accepted
    assert admitted.cost == math.inf
    assert admitted.reason.endswith(f"but longer: singular at {fails.time[1]:.3g} s")
    for judge, old, new in ((loop, longer, shorter), (replace(loop, ensemble=None), *plans)):
        refused = cost_gate(judge, old, new, x, HORIZON)
        assert not refused.accepted
        assert refused.reason.startswith("not feasible from here: singular at")
