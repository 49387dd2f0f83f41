"""The whole loop: enclosures hold, tubes contain, proofs are sound, false claims are refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import undertow as ut
from undertow.base import InvalidInputError
from undertow.cli import app
from undertow.law import ReachingLaw, SlidingModeLaw, Surface
from undertow.models import FloatArray
from undertow.proofs.claims.appendix import CASES
from undertow.proofs.claims.certificate import read_certificate
from undertow.proofs.claims.loop_draft import LoopDraft
from undertow.proofs.closed_loop.loop import LoopMotion
from undertow.proofs.closed_loop.run import run_tubes, start_tubes
from undertow.proofs.closed_loop.sampled_data import SampledDataLoop
from undertow.proofs.closed_loop.terminal import verify_terminal
from undertow.proofs.closed_loop.terminal_set import TerminalSet
from undertow.proofs.closed_loop.tube import bracket
from undertow.proofs.intervals.batch import Interval
from undertow.proofs.sampled import (
    box_starts,
    failure_bound,
    sampled_extent,
    sampled_region,
)
from undertow.proofs.search.loop_draft import draft_loop, follow

RIG = ut.mechanisms.rotary_pendulum(d_e=0.073)
LAW = ReachingLaw()
SURFACE = CASES[3].surface
MOTION = LoopMotion(RIG, SURFACE, LAW)

#: A set that the search found for case 4, shrunk by 2 %; proved afresh by the tests.
TERMINAL = TerminalSet(
    [[2.8621, 1.1269, 8.1203], [0.0, 0.4452, -0.3344], [0.0, 0.0, 14.3863]],
    [0.002],
)


def states(count: int, seed: int, size: float = 0.75) -> FloatArray:
    rng = np.random.default_rng(seed)
    return np.asarray(rng.uniform(-size, size, (count, 4)) * [2, 1, 6, 6])


@pytest.mark.parametrize("uncertain", [{}, {"m": (0.12, 0.13), "d_e": (0.07, 0.08)}])
def test_the_coordinates_carry_the_plants_own_motion(
    uncertain: dict[str, tuple[float, float]],
) -> None:
    """ż agrees with the mechanism under the clipped law, and the enclosures hold it."""
    motion = LoopMotion(RIG, SURFACE, LAW, uncertain)
    x = states(200, 0)
    law = SlidingModeLaw(RIG, SURFACE, LAW)(0.0, x)
    assert (np.abs(law.demand) > 15).any()
    x_dot = np.hstack([x[:, 2:], RIG.accelerations(0.0, x, law.u)])
    h = 1e-6
    expected = (motion.from_state(x + h * x_dot) - motion.from_state(x - h * x_dot)) / (2 * h)
    z = motion.from_state(x)
    rate, demand = motion(z)
    assert rate == pytest.approx(expected, rel=1e-6, abs=1e-6)
    assert demand == pytest.approx(law.demand, rel=1e-9, abs=1e-9)
    boxes = motion.over(Interval(z.T - 1e-4, z.T + 1e-4))
    near = z + np.random.default_rng(1).uniform(-1e-4, 1e-4, z.shape)
    there, u = motion(near)
    assert (boxes.rate.lo <= there.T).all()
    assert (boxes.rate.hi >= there.T).all()
    assert (boxes.demand.lo <= u.T).all()
    assert (boxes.demand.hi >= u.T).all()


def test_slopes_hold_every_difference_quotient() -> None:
    """f(z) − f(z') ∈ J (z − z') across the corners of sat and clip too."""
    rng = np.random.default_rng(2)
    z = MOTION.from_state(states(300, 3))
    z[:150, 3] = rng.choice([-0.1, 0.1], 150)  # at the corner of the layer
    other = z + rng.uniform(-0.02, 0.02, z.shape)
    low, high = np.minimum(z, other).T, np.maximum(z, other).T
    rates = MOTION.over(Interval(low, high))
    change = (MOTION(other)[0] - MOTION(z)[0]).T
    way = (other - z).T
    low_sum = np.zeros_like(change)
    high_sum = np.zeros_like(change)
    for j in range(4):
        ends = rates.slope.lo[:, j] * way[j], rates.slope.hi[:, j] * way[j]
        low_sum += np.minimum(*ends)
        high_sum += np.maximum(*ends)
    assert (low_sum <= change + 1e-9).all()
    assert (change <= high_sum + 1e-9).all()


@pytest.mark.slow
def test_tubes_hold_the_motions_from_their_starts() -> None:
    """RK4 at a tenth of the step stays inside, through clip, layer and sliding."""
    edges = np.radians([20.0, 20.1, 38.0, 38.02])
    tubes = start_tubes(MOTION, "phi", edges).take(np.array([True, False, True]))
    rng = np.random.default_rng(4)
    x = np.zeros((40, 4))
    x[:20, 1] = rng.uniform(edges[0], edges[1], 20)
    x[20:, 1] = rng.uniform(edges[2], edges[3], 20)
    path, _ = follow(MOTION, MOTION.from_state(x), 0.15, 1e-4, 10)
    lane = np.repeat([0, 1], 20)
    for k in range(1, 151):
        tubes, _, _, moved = tubes.advance(0.001)
        assert moved.all()
        hull = tubes.hull
        assert (hull.lo[:, lane] <= path[k].T + 1e-9).all()
        assert (hull.hi[:, lane] + 1e-9 >= path[k].T).all()
    assert (hull.hi - hull.lo).max() < 0.2


def test_brackets_hold_their_ends() -> None:
    rng = np.random.default_rng(5)
    low = rng.normal(size=1000)
    high = low + rng.exponential(size=1000)
    middle, radius = bracket(low, high)
    assert (middle - radius <= low).all()
    assert (middle + radius >= high).all()


@pytest.fixture(scope="module")
def claim() -> LoopDraft:
    """Starts up to 0.9°, twice the layer: cheap."""
    return LoopDraft(
        "phi", tuple(np.radians(np.linspace(0, 0.9, 13)).tolist()), TERMINAL, 0.001, 0.8
    )


@pytest.mark.slow
def test_the_terminal_set_is_proved_and_its_motions_converge() -> None:
    """W falls along simulated motions from its boundary, and they end at the target."""
    verdict = verify_terminal(MOTION, TERMINAL)
    assert verdict, verdict
    rng = np.random.default_rng(6)
    rays = rng.normal(size=(400, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    s = rng.uniform(-1, 1, (400, 1)) * TERMINAL.widths
    z = np.hstack([0.9999 * rays @ TERMINAL.scale.T, s])
    path, _ = follow(MOTION, z, 3.0, 0.001, 20)
    W = TERMINAL.value(path)
    assert (np.diff(W, axis=0) < 1e-9).all()
    assert W[-1].max() < 0.05
    assert np.abs(MOTION(z)[1]).max() <= 15


def test_a_terminal_set_grown_is_refused_with_a_witness() -> None:
    """Tight: a set that is larger by a tenth holds a point that leaves or clips."""
    verdict = verify_terminal(MOTION, TERMINAL.times(1.3), max_seconds=30)
    assert verdict.kind == "refuted"
    z = np.array([verdict.witness[name] for name in MOTION.names])
    assert TERMINAL.times(1.3).value(z) <= 1
    rate, u = MOTION(z)
    x = np.linalg.solve(TERMINAL.scale, z[:3])
    grows = x @ np.linalg.solve(TERMINAL.scale, rate[:3]) > 0
    assert grows or np.abs(u).max() > 15


def test_what_the_kernel_decides_is_no_draft(claim: LoopDraft) -> None:
    with pytest.raises(InvalidInputError, match="what the kernel leaves"):
        LoopDraft.from_dict(json.loads(json.dumps(claim.to_dict())))
    with pytest.raises(InvalidInputError, match="prove_loop"):
        draft_loop(RIG, SURFACE, LAW, coordinate="phi", reach=0.1)


@pytest.mark.slow
def test_what_does_not_follow_is_not_proved(claim: LoopDraft) -> None:
    """Too short a horizon, a start beyond the singularity, another gain, a grown set."""
    assert not replace(claim, horizon=0.01).decide(RIG, SURFACE, LAW)
    beyond = replace(claim, edges=(0.0, 1.2))
    verdict = beyond.decide(RIG, SURFACE, LAW)
    assert verdict.kind == "undecided"
    assert verdict.witness == {"phi": 0.6}
    assert not claim.decide(RIG, SURFACE, ReachingLaw(eta=0.5))
    assert not replace(claim, terminal=TERMINAL.times(1.5)).decide(RIG, SURFACE, LAW)
    weak = replace(RIG, inputs=(replace(RIG.inputs[0], limit=0.2),))
    assert not claim.decide(weak, SURFACE, LAW)


def test_an_unstable_or_ill_formed_claim_is_refused(claim: LoopDraft) -> None:
    unstable = Surface(-1, -1.59, 0.5, 12.1)
    assert not claim.decide(RIG, unstable, LAW)
    with pytest.raises(InvalidInputError, match="all sets move at once"):
        replace(claim, edges=tuple(np.linspace(0.0, 0.5, 30_000)))
    with pytest.raises(InvalidInputError, match="rising from 0"):
        LoopDraft("phi", (0.1, 0.2), TERMINAL, 0.001, 1.0)
    with pytest.raises(InvalidInputError, match="coordinate"):
        replace(claim, coordinate="psi").decide(RIG, SURFACE, LAW)
    with pytest.raises(InvalidInputError, match="singular"):
        TerminalSet(np.zeros((3, 3)), [0.1])
    with pytest.raises(InvalidInputError, match="saturation"):
        LoopMotion(RIG, SURFACE, ReachingLaw(switching="sign"))
    with pytest.raises(InvalidInputError, match="uncertain"):
        LoopMotion(RIG, SURFACE, LAW, {"mass": (0.1, 0.2)})


def test_lost_tubes_are_told_apart() -> None:
    """One tube over the singularity, one that ends well, in one batch."""
    edges = [0.01, 0.012, 1.0, 1.01]
    tubes = start_tubes(MOTION, "phi", edges).take(np.array([True, False, True]))
    end = run_tubes(MOTION, tubes, TERMINAL, 0.002, 0.8, stop_early=False)
    assert np.isfinite(end.entered[0])
    assert np.isnan(end.entered[1])
    given_up = run_tubes(MOTION, tubes, TERMINAL, 0.002, 0.8)
    assert np.isnan(given_up.entered).all()
    assert given_up.lost.tolist() == end.lost.tolist() == [False, True]
    for horizon, steps in ((0.0005, 1), (0.002, 1), (0.004, 2)):
        short = run_tubes(MOTION, tubes.take(np.array([True, False])), TERMINAL, 0.002, horizon)
        assert short.steps == steps
        assert (short.peak > 0).all()
    assert given_up.steps < end.steps == round(float(end.entered[0]) / 0.002)


# -- a held input, a plant in a box ----------------------------------------------------------

#: The law at 1 kHz; a terminal set for it, thicker in s: there the lag must be made good.
HELD = LoopMotion(RIG, SURFACE, LAW, period=0.001)
THICK = TerminalSet(0.4 * TERMINAL.scale, [0.0034])


def held_motion(x: FloatArray, period: float, count: int) -> FloatArray:
    """Positions and velocities at the samples of a law that is held, (count + 1, L, 4)."""
    law, path = SlidingModeLaw(RIG, SURFACE, LAW), [x]
    parts = max(4, round(period / 0.00025))
    h = period / parts
    for _ in range(count):
        u = law(0.0, x).u

        def f(x: FloatArray, u: FloatArray = u) -> FloatArray:
            return np.hstack([x[:, 2:], RIG.accelerations(0.0, x, u)])

        for _ in range(parts):
            a = f(x)
            b = f(x + h / 2 * a)
            c = f(x + h / 2 * b)
            x = x + h / 6 * (a + 2 * b + 2 * c + f(x + h * c))
        path.append(x)
    return np.array(path)


@pytest.mark.slow
def test_held_tubes_hold_the_motions_of_the_sampled_loop() -> None:
    """Far off, and through the edge of the layer; no room for a continuous law's motions."""
    edges = np.radians([0.8, 0.81, 25.0, 25.05])
    held = SampledDataLoop(HELD)
    tubes = held.begin(start_tubes(HELD, "phi", edges).take(np.array([True, False, True])))
    x = np.zeros((20, 4))
    x[:, 1] = np.repeat(edges[::2], 10) + np.tile(np.linspace(0, 1, 10), 2) * np.repeat(
        np.diff(edges)[::2], 10
    )
    path = HELD.from_state(held_motion(x, 0.001, 60))
    lane = np.repeat([0, 1], 10)
    for k in range(60):
        tubes, demand = held.sample(tubes)
        u = HELD(path[k])[1].T
        assert (demand.lo[:, lane] <= u + 1e-9).all()
        assert (u <= demand.hi[:, lane] + 1e-9).all()
        tubes, _, _, moved = tubes.advance(0.001)
        assert moved.all()
        hull = tubes.hull[:4]
        assert (hull.lo[:, lane] <= path[k + 1].T + 1e-9).all()
        assert (hull.hi[:, lane] + 1e-9 >= path[k + 1].T).all()
    assert (hull.hi - hull.lo).max() < 0.02
    continuous, _ = follow(HELD, HELD.from_state(x), 0.01, 1e-4, 100)
    assert np.abs(continuous[-1] - path[10]).max() > 1e-4


@pytest.mark.slow
def test_a_terminal_set_of_the_sampled_loop() -> None:
    """Proved at 1 kHz, where W falls from sample to sample; thin or slow sets are not."""
    verdict = verify_terminal(HELD, THICK, max_seconds=60)
    assert verdict, verdict
    rng = np.random.default_rng(8)
    rays = rng.normal(size=(200, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    s = rng.uniform(-1, 1, (200, 1)) * THICK.widths
    z = np.hstack([0.9999 * rays @ THICK.scale.T, s])
    x = np.hstack([z[:, :2], np.zeros((200, 2))])
    for row, goal in zip(x, z, strict=True):  # (q, p, s) are linear in q̇ at given q
        base = HELD.from_state(row)
        unit = np.array([HELD.from_state(row + e) - base for e in np.eye(4)[2:]])
        row[2:] = np.linalg.solve(unit[:, 2:].T, (goal - base)[2:])
    W = THICK.value(HELD.from_state(held_motion(x, 0.001, 300)))
    assert W[0].max() <= 1
    assert (np.diff(W, axis=0) < 1e-12).all()
    thin = TerminalSet(THICK.scale, 0.3 * THICK.widths)
    assert not verify_terminal(HELD, thin, max_seconds=30)


@pytest.mark.slow
def test_a_hold_that_is_too_long_is_not_proved(claim: LoopDraft) -> None:
    """At 20 ms the law is past its stable period 2 ε/η = 10 ms: simulation rings, no proof."""
    loop = ut.ClosedLoop(RIG, ut.MinimumEnergy(), LAW, zoh_steps=1)
    assert loop.batch(RIG.state(phi=0.01), SURFACE).reached
    rings = held_motion(RIG.state(phi=0.01)[None], 0.02, 100)
    assert np.abs(HELD.from_state(rings[-20:])[..., 3]).max() > 2 * LAW.vector(1)[1]
    slow = LoopMotion(RIG, SURFACE, LAW, period=0.02)
    for factor in (1.0, 0.03):
        assert not verify_terminal(slow, THICK.times(factor), max_seconds=30)
    held = replace(claim, terminal=THICK, step=0.002, hold=10)
    assert not held.decide(RIG, SURFACE, LAW)
    with pytest.raises(InvalidInputError, match="hold"):
        replace(claim, hold=-1)
    with pytest.raises(InvalidInputError, match="period"):
        LoopMotion(RIG, SURFACE, LAW, period=-0.001)


@pytest.mark.slow
def test_a_held_claim_is_verified_from_its_numbers_alone(claim: LoopDraft) -> None:
    """0.45° at 1 kHz; the same in a plant whose mass is off by up to 5 %, held or not."""
    near = replace(claim, edges=claim.edges[:7], terminal=THICK, hold=1)
    again = LoopDraft.from_dict(json.loads(json.dumps(near.to_dict())))
    verdict = again.decide(RIG, SURFACE, LAW)
    assert verdict, verdict
    assert "held for 0.001 s" in verdict.claim


BOX = {"m": (0.95 * 0.125, 1.05 * 0.125)}
#: Thicker still: there what the law does not know must be made good.
BLUNT = TerminalSet(
    [[0.8444, 0.506, 1.0743], [0.0, 0.1602, -0.1017], [0.0, 0.0, 3.1547]], [0.00735]
)


@pytest.mark.slow
def test_a_plant_in_a_box_is_proved_and_a_larger_box_is_not(claim: LoopDraft) -> None:
    """The mass within 5 %: a terminal set, and tubes that end in it.  Within 40 %: none."""
    near = replace(claim, edges=claim.edges[:7], terminal=BLUNT, uncertain=BOX)
    verdict = near.decide(RIG, SURFACE, LAW)
    assert verdict, verdict
    assert "m in [0.11875, 0.13125]" in verdict.claim
    wide = LoopMotion(RIG, SURFACE, LAW, {"m": (0.6 * 0.125, 1.4 * 0.125)})
    assert not verify_terminal(wide, BLUNT, max_seconds=30)
    with pytest.raises(InvalidInputError, match="uncertain"):
        LoopMotion(RIG, SURFACE, LAW, {"m": (0.2, 0.3)})


def test_the_gap_is_enclosed_sharply() -> None:
    """What the law does not know, against 5 % of mass: within a factor 2 of its size at 0."""
    motion = LoopMotion(RIG, SURFACE, LAW, BOX)
    slope = motion.over(Interval(np.zeros((4, 1)))).push_slope[0, :4, 0]
    found = np.maximum(np.abs(slope.lo), np.abs(slope.hi))
    for m in (BOX["m"][0], BOX["m"][1]):
        plant = LoopMotion(RIG.with_parameters(m=m), SURFACE, LAW)
        x = 1e-6 * np.eye(4)
        u = SlidingModeLaw(RIG, SURFACE, LAW)(0.0, x).u
        v = RIG.with_parameters(m=m).accelerations(0.0, x, u)
        s_dot = np.hstack([x[:, 2:], v]) @ np.concatenate(
            [SURFACE.position_row[0], SURFACE.velocity_row[0]]
        )
        z = plant.from_state(x)
        push = s_dot + 200.0 * z[:, 3]
        true = np.abs(np.linalg.solve(z, push))
        assert (true <= found * (1 + 1e-6) + 1e-6).all()
        assert (found <= 2 * true + 0.2).all()


# -- sampled ---------------------------------------------------------------------------------


def test_the_bound_on_failures_covers() -> None:
    """Clopper-Pearson: for every p, the bound is below p in at most 1 − confidence of cases."""
    rng = np.random.default_rng(7)
    for p in (0.001, 0.02, 0.3):
        counts = rng.binomial(500, p, 2000)
        bounds = {k: failure_bound(int(k), 500, 0.95) for k in np.unique(counts)}
        missed = np.mean([bounds[k] < p for k in counts])
        assert missed <= 0.05 + 3 * np.sqrt(0.05 * 0.95 / 2000)
    with pytest.raises(InvalidInputError):
        failure_bound(3, 2)


def test_sampled_starts_converge_or_are_refuted_with_a_witness() -> None:
    loop = ut.ClosedLoop(RIG, ut.MinimumEnergy(), LAW, tail_rtol=1e-3)
    verdict = sampled_extent(loop, SURFACE, "phi", np.radians(50), grid=100, trials=1000)
    assert verdict.kind == "sampled"
    assert 44 < np.degrees(verdict.details["extent"]) < 45.5
    assert verdict.details["failure_bound"] == pytest.approx(failure_bound(0, 1000), rel=1e-12)
    wide = sampled_region(loop, SURFACE, box_starts(RIG, phi=(-1, 1)), trials=500)
    assert wide.kind == "refuted"
    again = loop.batch(RIG.state(**wide.witness)[None], SURFACE)
    assert not again.reached[0]


# -- slow: the search, soundness at large ----------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(("name", "degrees"), [("4 held", 30.6), ("4 mass", 5.0), ("5 held", 19.7)])
def test_the_appendix_cases_are_proved_this_far(name: str, degrees: float) -> None:
    """Kept claims, decided afresh: at 1 kHz; much less for every plant with a mass within 5 %."""
    certificate = read_certificate(Path(__file__).parents[1] / "data" / "loops.json")
    subject = certificate.subjects[int(name[0]) - 4]
    assert subject.surface == CASES[int(name[0]) - 1].surface
    assert subject.reaching == LAW
    claims = [LoopDraft.from_dict(stated.data) for stated in subject.claims]
    kind = (int("held" in name), BOX if "mass" in name else {})
    (kept,) = (claim for claim in claims if (claim.hold, dict(claim.uncertain)) == kind)
    verdict = kept.decide(RIG, subject.surface, LAW)
    assert verdict, verdict
    assert np.degrees(verdict.margin) >= degrees


@pytest.mark.parametrize(
    ("words", "what"),
    [
        (["--hold", "1"], "without --loop"),
        (["--loop", "--hold", "-1"], "0 to 1000"),
        (["--seconds", "0", "--within", "m=5"], "without a region"),
        (["--loop", "--within", "mass=5"], "mass=5"),
        (["--loop", "--within", "m=120"], "m=120"),
    ],
)
def test_options_of_the_loops_proof_are_checked_before_work(words: list[str], what: str) -> None:
    answer = CliRunner().invoke(app, ["certify", "rotary_pendulum", *words])
    assert answer.exit_code == 2
    assert what in answer.output
