"""Systems of python-control: they move as ours do, and their margins are those of our gate."""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import undertow as ut
from support import rest_slow
from undertow.base import InvalidInputError, MissingExtraError, UnstableSurfaceError
from undertow.cascade.robustness import delay_margin
from undertow.closed_loop import Event
from undertow.export import loop_transfer, phase_plane

control = pytest.importorskip("control")

RIG = ut.mechanisms.rotary_pendulum()
SURFACE = ut.first_surface(RIG)
LOOP = ut.ClosedLoop(RIG, ut.MinimumTime())

#: Methods of high order step over the corner where the boundary layer begins.
EXACTLY = {"rtol": 1e-9, "atol": 1e-12, "method": "RK45"}


def moved(system: Any, t: Any, x: Any, u: Any = 0) -> Any:
    return control.input_output_response(system, t, u, x, solve_ivp_kwargs=EXACTLY)


def test_the_closed_loop_moves_as_ours_does_to_a_millionth() -> None:
    """States and input, from far outside the boundary layer to arrival."""
    run = LOOP.simulate(RIG.state(phi=0.5), SURFACE)
    assert run.event == Event.REACHED
    assert abs(run.s).max() > 20 * 0.1
    system = ut.nlsys(LOOP, SURFACE)
    assert system.output_labels == [*RIG.state_names, "voltage"]
    found = moved(system, run.t, run.x[0])
    np.testing.assert_allclose(found.states.T, run.x, atol=1e-6, rtol=0)
    np.testing.assert_allclose(found.outputs[4:].T, run.u, atol=1e-4, rtol=0)  # gains of 100/rad


def test_belief_and_truth_stay_apart_and_plans_take_turns() -> None:
    heavier = RIG.with_parameters(m=0.15)
    loop = ut.ClosedLoop(RIG, ut.MinimumTime(), plant=heavier)
    plan = ut.Plan((SURFACE, ut.Surface(-1, -0.5, 5, 10)), (0.0, 0.2))
    run = loop.simulate(RIG.state(phi=0.2), plan, duration=0.5)
    found = moved(ut.nlsys(loop, plan), run.t, run.x[0])
    np.testing.assert_allclose(found.states.T, run.x, atol=1e-4, rtol=0)  # a jump of the surface
    alone = LOOP.simulate(RIG.state(phi=0.2), SURFACE, duration=0.5)
    assert abs(alone.x[: len(run.x)] - run.x[: len(alone.x)]).max() > 0.01


@pytest.mark.parametrize("name", ["rotary_pendulum", "two_motor_three_link"])
def test_the_plant_s_linearisation_is_ours(name: str) -> None:
    mechanism = getattr(ut.mechanisms, name)()
    zero = np.zeros(2 * mechanism.n)
    linear = ut.nlsys(mechanism).linearize(zero, np.zeros(mechanism.m))
    ours = mechanism.linearise()
    np.testing.assert_allclose(linear.A, ours.A, atol=1e-3 * abs(ours.A).max())
    np.testing.assert_allclose(linear.B, ours.input, atol=1e-3 * abs(ours.input).max())


def test_a_disturbance_enters_behind_the_actuator() -> None:
    system, x = ut.nlsys(LOOP, SURFACE), RIG.state(phi=0.01)
    u = ut.SlidingModeLaw(RIG, SURFACE)(0.0, x).u
    rate = system.dynamics(0.0, x, [2.0])
    np.testing.assert_allclose(rate[2:], RIG.accelerations(0.0, x, u + 2.0), rtol=1e-12)


@pytest.mark.parametrize(
    "name",
    rest_slow(["rotary_pendulum", "two_motor_three_link", "cart_pendulum"], "rotary_pendulum"),
)
def test_what_is_within_the_margins_is_stable_and_what_is_beyond_is_not(name: str) -> None:
    """Each margin by itself, on the loop that it was computed from; delays by Nyquist's count."""
    mechanism = getattr(ut.mechanisms, name)()
    surface = ut.first_surface(mechanism)
    for margins in ut.loop_margins(mechanism, surface):
        L = loop_transfer(mechanism, surface, cut=margins.input)

        def stable(factor: float, L: Any = L) -> bool:
            return bool(np.linalg.eigvals(L.A - factor * L.B @ L.C).real.max() < 0)

        low, high = margins.gain
        assert stable(1.0)
        assert stable(1.01 * low)
        assert low == 0.0 or not stable(0.99 * low)
        assert stable(min(0.99 * high, 100.0))
        g, angle = margins.disk
        assert 1 / g >= 0.999 * low
        assert g <= 1.001 * high
        assert angle <= margins.phase + 1e-3
        at = L(1j * margins.crossover)
        assert abs(at) == pytest.approx(1.0, rel=1e-4)
        late = at * np.exp(-1j * margins.crossover * margins.delay)
        assert late == pytest.approx(-1.0, abs=1e-3)


def test_the_delay_margin_is_the_gate_s() -> None:
    """That is of the sampled loop, in whole periods of 0.1 ms."""
    (margins,) = ut.loop_margins(RIG, SURFACE)
    sampled = delay_margin(RIG, SURFACE, period=1e-4)
    assert sampled - 1e-4 < margins.delay < sampled + 2e-4
    assert "voltage: gain × 0.0666 to inf" in str(margins)
    assert math.degrees(margins.phase) == pytest.approx(89.6, abs=0.1)


def test_a_phase_plane_is_a_cut_through_the_field() -> None:
    system = ut.nlsys(LOOP, SURFACE)
    plane = phase_plane(system, "phi", "phi_dot", theta_dot=0.5)
    assert plane.state_labels == ["phi", "phi_dot"]
    whole = system.dynamics(0.0, RIG.state(phi=0.1, phi_dot=-0.2, theta_dot=0.5), [0.0])
    np.testing.assert_array_equal(plane.dynamics(0.0, [0.1, -0.2], []), whole[[1, 3]])


@pytest.mark.parametrize(
    ("made", "error", "said"),
    [
        (lambda: ut.nlsys(LOOP), InvalidInputError, "surfaces of a system"),
        (lambda: ut.nlsys(RIG, SURFACE), InvalidInputError, "surfaces of a system"),
        (
            lambda: ut.nlsys(ut.ClosedLoop(RIG, zoh_steps=1), SURFACE),
            InvalidInputError,
            "the continuous law",
        ),
        (lambda: loop_transfer(RIG, SURFACE, cut="volts"), InvalidInputError, "input to cut at"),
        (
            lambda: ut.loop_margins(RIG, ut.Surface(-1, 0.5, 5, 10)),
            UnstableSurfaceError,
            "stab",
        ),
        (lambda: phase_plane(3, "phi", "phi_dot"), InvalidInputError, "what ut.nlsys returns"),
        (
            lambda: phase_plane(ut.nlsys(RIG), "phi", "phi"),
            InvalidInputError,
            "two different ones",
        ),
    ],
)
def test_bad_arguments_are_refused(made: Any, error: type[Exception], said: str) -> None:
    with pytest.raises(error, match=said):
        made()


def test_a_missing_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "control", None)
    for call in (lambda: ut.nlsys(RIG), lambda: ut.loop_margins(RIG, SURFACE)):
        with pytest.raises(MissingExtraError, match=r"undertow\[interop\]"):
            call()


def test_a_loop_as_a_system_keeps_to_the_smaller_limit() -> None:
    """A plant with a weaker motor than the law believes: what moves is what our loop moves."""
    weak = RIG.with_input_limit(2.0)
    for belief, plant in ((RIG, weak), (weak, RIG)):
        loop = ut.ClosedLoop(belief, ut.MinimumTime(), plant=plant)
        run = loop.simulate(RIG.state(phi=0.2), SURFACE, duration=0.5)
        assert abs(run.u).max() == 2.0
        found = moved(ut.nlsys(loop, SURFACE), run.t, run.x[0])
        np.testing.assert_allclose(found.states.T, run.x, atol=1e-6, rtol=0)


def test_a_name_with_a_dot_is_a_system() -> None:
    """python-control refuses such names, with a ValueError of its own."""
    assert ut.nlsys(replace(ut.mechanisms.tora(), name="tora v0.2")).name == "tora v0_2"
