"""Terminal ellipsoids of the full closed loop hold, for any n and m."""

from __future__ import annotations

import numpy as np
import pytest
import sympy as sp

import undertow as ut
from undertow.base import InvalidInputError
from undertow.models import FloatArray
from undertow.proofs.claims.terminal_ellipsoid import (
    ClosedLoopProgram,
    TerminalEllipsoid,
)
from undertow.proofs.search.terminal_ellipsoid import search_for
from undertow.studies.paper.data import CASES

RIG = ut.mechanisms.rotary_pendulum()
LAW = ut.ReachingLaw()
SMALL = ("rotary_pendulum", "cart_pendulum", "overhead_crane", "tora", "ball_and_beam")


def largest(rig: ut.Mechanism, surface: ut.Surface) -> TerminalEllipsoid:
    search = search_for(rig, surface, LAW)
    assert search is not None
    found = search.largest()
    assert found is not None
    return found


def test_the_program_is_the_closed_loop() -> None:
    """Its accelerations and inputs are the plant's under the law, where nothing is clipped."""
    for name in ("rotary_pendulum", "gantry_crane", "double_pendulum_on_a_cart"):
        rig = ut.mechanisms.LIBRARY[name]()
        surface = ut.first_surface(rig)
        loop = ClosedLoopProgram.of(rig)
        x = 1e-3 * np.random.default_rng(1).uniform(-1, 1, 2 * rig.n)
        law = ut.SlidingModeLaw(rig, surface, LAW)(0.0, x)
        assert (np.abs(law.s) < 0.1).all()
        at = np.concatenate([x, loop.numbers(rig, surface, LAW)])
        value = loop.over(at, at)[:, 0]
        expected = np.concatenate([rig.accelerations(0.0, x, law.demand), law.demand])
        assert value.mean(axis=1)[: rig.n + rig.m] == pytest.approx(expected, rel=1e-9, abs=1e-9)


def boundary(found: TerminalEllipsoid, count: int) -> FloatArray:
    rays = np.random.default_rng(2).normal(size=(count, len(found.W)))
    rays *= 0.9999 * found.radius / np.linalg.norm(rays, axis=1, keepdims=True)
    return np.asarray(np.linalg.solve(found.W, rays.T).T)


@pytest.mark.parametrize("case", CASES)
def test_no_motion_leaves_a_proved_ellipsoid(case: str) -> None:
    """The full closed loop, layer and clip in place: the level falls and the motion converges."""
    found = largest(RIG, CASES[case])
    assert found.decide(RIG, CASES[case], LAW).kind == "proved"
    loop = ut.ClosedLoop(RIG, step=0.001)
    x = boundary(found, 64)
    level = found.level(x)
    for seconds in (0.002, 0.02, 0.2, 2.0, 20.0):
        batch = loop.batch(x, CASES[case], duration=seconds, terminal=0.0)
        after = found.level(batch.x)
        assert (after < level).all()
        x, level = batch.x, after
    assert level.max() < 0.2


@pytest.mark.slow
def test_a_hundred_thousand_motions_stay_and_converge() -> None:
    """Twenty thousand starts all over each of the five cases' ellipsoids, none leaves."""
    rng = np.random.default_rng(5)
    loop = ut.ClosedLoop(RIG)
    for surface in CASES.values():
        found = largest(RIG, surface)
        rays = rng.normal(size=(20_000, 4))
        rays *= (
            found.radius
            * rng.random((20_000, 1)) ** 0.25
            / np.linalg.norm(rays, axis=1, keepdims=True)
        )
        x = np.linalg.solve(found.W, rays.T).T
        start = level = found.level(x)
        assert 0.99 < level.max() <= 1
        for seconds in (0.004, 0.01, 0.02, 0.04, 0.1, 0.3, 1.0, 4.0):
            x = loop.batch(x, surface, duration=seconds, terminal=0.0).x
            after = found.level(x)
            assert (after < level).all()
            level = after
        assert (level < 0.9 * start).all()


@pytest.mark.parametrize("name", SMALL)
def test_other_mechanisms_have_terminal_ellipsoids(name: str) -> None:
    rig = ut.mechanisms.LIBRARY[name]()
    surface = ut.first_surface(rig)
    found = largest(rig, surface)
    assert found.decide(rig, surface, LAW)
    # Tight: a tenth more, and it is not proved any more.
    wider = TerminalEllipsoid(found.W, found.U, 1.1 * found.radius)
    verdict = wider.decide(rig, surface, LAW)
    assert verdict.kind == "undecided"
    assert "V̇" in verdict.method or "limit" in verdict.method or "layer" in verdict.method


def test_around_a_state_far_along_the_slow_mode() -> None:
    """On the surface, θ may be turns away: the set is made for the state."""
    surface = CASES["3 last of cascade, energy"]
    search = search_for(RIG, surface, LAW)
    assert search is not None
    x = ut.ClosedLoop(RIG).batch(RIG.state(phi=0.5), surface, duration=3.0, terminal=0.0).x[0]
    assert abs(x[0]) > 1
    found = search.around(x)
    assert found is not None
    assert found.contains(x)
    assert found.decide(RIG, surface, LAW)
    assert search.around(RIG.state(phi=0.5)) is None


def test_conditions_that_break_are_named() -> None:
    """The input limit, the layer, an unstable surface, a force that depends on time."""
    surface = CASES["4 one-time, time"]
    found = largest(RIG, surface)
    weak = RIG.with_input_limit(1e-3)
    assert "input limit" in found.decide(weak, surface, LAW).method
    thin = ut.ReachingLaw(eta=2e-3, layer=1e-5)
    assert "layer" in found.decide(RIG, surface, thin).method
    assert search_for(RIG, ut.Surface(-1, 0.5, 5, 10), LAW) is None
    with pytest.raises(InvalidInputError, match="autonomous"):
        search_for(RIG.disturbed({"phi": sp.sin(ut.models.mechanism.TIME)}), surface, LAW)
    with pytest.raises(InvalidInputError, match="shape"):
        TerminalEllipsoid(np.eye(3), np.eye(4), 1.0).decide(RIG, surface, LAW)


def test_a_repeated_zero_eigenvalue_is_no_terminal_set() -> None:
    """λ_a = 0 leaves θ anywhere: nothing is proved."""
    assert search_for(RIG, ut.Surface(-1, 0.0, 1.96, 12.1), LAW) is None


def test_an_ellipsoid_that_is_none_is_refused() -> None:
    """W that is singular proves nothing; U, a guess of the search, does not matter."""
    surface = CASES["4 one-time, time"]
    found = largest(RIG, surface)
    flat = found.W.copy()
    flat[0] = 0.0
    verdict = TerminalEllipsoid(flat, found.U, found.radius).decide(RIG, surface, LAW)
    assert verdict.kind == "undecided"
    assert TerminalEllipsoid(found.W, np.eye(4), found.radius).decide(RIG, surface, LAW)
