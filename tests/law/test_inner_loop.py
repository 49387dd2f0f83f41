"""The compiled step equals the law, and never leaves its limits."""

from __future__ import annotations

import math

import numpy as np
import pytest

import undertow as ut
from undertow.base import InvalidInputError
from undertow.law import InnerLoop, LawLayout, feedback_at_target, pack_law_parameters


@pytest.mark.parametrize("name", ["rotary_pendulum", "two_motor_three_link"])
def test_the_compiled_step_equals_the_law(name: str) -> None:
    mechanism = ut.mechanisms.LIBRARY[name]()
    surface = ut.first_surface(mechanism)
    law, fast = ut.SlidingModeLaw(mechanism, surface), InnerLoop(mechanism, surface)
    for x in np.random.default_rng(0).normal(0.0, 0.5, (60, 2 * mechanism.n)):
        wanted = law(0.0, x)
        fast(x)
        np.testing.assert_allclose(fast.s, wanted.s, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(fast.demand, wanted.demand, rtol=1e-9)
        np.testing.assert_allclose(fast.u, wanted.u, rtol=1e-9)
        assert fast.margin[0] == pytest.approx(float(wanted.margin), rel=1e-9)


@pytest.mark.parametrize("name", ["rotary_pendulum", "two_motor_three_link"])
def test_a_law_vector_lies_where_its_layout_says(name: str) -> None:
    """The parts of a law vector, taken by their slices, are what the law was made of."""
    mechanism = ut.mechanisms.LIBRARY[name]()
    n, m = mechanism.n, mechanism.m
    reaching = ut.ReachingLaw(tuple(3.0 + k for k in range(m)), tuple(0.4 + k for k in range(m)))
    law = ut.SlidingModeLaw(mechanism, ut.first_surface(mechanism), reaching)
    vector, layout = pack_law_parameters(law), LawLayout(n, m)
    assert vector.shape == (layout.size,)
    np.testing.assert_array_equal(vector[layout.surface], law.surface.vector)
    np.testing.assert_array_equal(vector[layout.eta], reaching.eta)
    np.testing.assert_array_equal(vector[layout.layer], reaching.layer)
    np.testing.assert_array_equal(vector[layout.reaching], reaching.vector(m))
    assert vector[-1] == law.gamma_target
    rows = np.stack([vector, 2 * vector])
    for k, row in enumerate(rows):
        surface = ut.Surface(*(block[k] for block in layout.blocks(rows)))
        np.testing.assert_array_equal(surface.vector, row[layout.surface])


def test_a_reaching_law_is_exchanged_with_the_surface_or_stays(
    rig: ut.Mechanism, base: ut.Surface, quick: ut.Surface
) -> None:
    """What is not given is kept, and so are the limits of the mechanism's inputs."""
    x, soft = rig.state(phi=0.02, theta=0.1), ut.ReachingLaw(3.0, 0.5)
    law = InnerLoop(rig, base, soft)
    law.use(quick)
    assert law.reaching == soft
    assert law(x)[0] == pytest.approx(float(ut.SlidingModeLaw(rig, quick, soft)(0.0, x).u[0]))
    hard = ut.ReachingLaw(8.0, 0.2)
    law.use(quick, hard)
    assert law(x)[0] == pytest.approx(float(ut.SlidingModeLaw(rig, quick, hard)(0.0, x).u[0]))
    assert law(rig.state(phi=0.9)).tolist() == [-rig.inputs[0].limit]  # of 37 V that it asks for
    smooth = ut.ReachingLaw(8.0, 0.2, "tanh")
    law.use(quick, smooth)
    assert law(x)[0] == pytest.approx(float(ut.SlidingModeLaw(rig, quick, smooth)(0.0, x).u[0]))


def test_along_a_plan_the_surface_in_force_is_obeyed(
    rig: ut.Mechanism, base: ut.Surface, quick: ut.Surface
) -> None:
    """With the plan's reaching law where it has one for the surface, or else with the other one."""
    x, soft, other = (
        rig.state(phi=0.02, theta=0.1),
        ut.ReachingLaw(3.0, 0.5),
        ut.ReachingLaw(8.0, 0.2),
    )
    for laws in (None, (soft, soft)):
        plan, law = ut.Plan((base, quick), (0.0, 0.5), laws), InnerLoop(rig, base)
        for elapsed, surface in ((0.1, base), (0.6, quick), (0.2, base)):
            law.follow(plan, elapsed, other)
            wanted = ut.SlidingModeLaw(rig, surface, soft if laws else other)(0.0, x).u[0]
            assert law(x)[0] == pytest.approx(float(wanted))


def test_no_state_brings_the_input_past_its_limits_or_to_nan(
    rig: ut.Mechanism, base: ut.Surface
) -> None:
    law = InnerLoop(rig, base)
    for value in (math.nan, math.inf, -math.inf, 1e300):
        for i in range(4):
            x = np.zeros(4)
            x[i] = value
            assert abs(law(x)[0]) <= rig.inputs[0].limit


def test_a_surface_is_exchanged_between_steps_or_refused(
    rig: ut.Mechanism, base: ut.Surface, quick: ut.Surface
) -> None:
    law, x = InnerLoop(rig, base), rig.state(phi=0.05)
    before = float(law(x)[0])
    law.use(quick)
    assert law(x)[0] == pytest.approx(float(ut.SlidingModeLaw(rig, quick)(0.0, x).u[0]))
    assert law(x)[0] != before
    with pytest.raises(InvalidInputError, match="surface for"):
        law.use(ut.Surface(-np.eye(2), np.eye(2), np.ones((2, 1)), np.ones((2, 1))))
    assert law.surface == quick


def test_parameters_with_which_the_input_would_turn_are_not_taken_over() -> None:
    """Close to where a surface is singular, what is learnt waits for the next surface."""
    rig = ut.mechanisms.rotary_pendulum()
    belief = ut.Belief.relative(rig, m=0.2, l=0.05, I_e=0.2, a_e=0.1, d_e=0.5)
    learnt = belief.values([0.4, 0.14, 0.32, -0.34, 0.02])
    law = InnerLoop(rig, ut.Surface(-1, -4.039, 1.306, 8.926))
    x, home = rig.state(phi=ut.deg(37)), rig.state(phi=ut.deg(10))
    before = float(law(x)[0])
    assert not law.believe(learnt, x)
    assert float(law(x)[0]) == before
    np.testing.assert_array_equal(law.parameters, rig.parameter_values)
    law.parameters[:] = learnt
    assert float(law(x)[0]) == -before
    law.parameters[:] = rig.parameter_values
    assert law.believe(learnt, home)
    np.testing.assert_array_equal(law.parameters, learnt)
    law.parameters[:] = rig.parameter_values
    assert law.believe(learnt, rig.state(phi=ut.deg(60)))  # singular in any case


@pytest.mark.parametrize("name", ["rotary_pendulum", "two_motor_three_link"])
def test_near_the_target_the_law_is_its_linear_feedback(name: str) -> None:
    """u = k x to second order in x, for every coordinate and rate and every input."""
    mechanism = ut.mechanisms.LIBRARY[name]()
    law = ut.SlidingModeLaw(mechanism, ut.first_surface(mechanism))
    k = feedback_at_target(mechanism, law.surface)
    assert k.shape == (mechanism.m, 2 * mechanism.n)
    for x in np.random.default_rng(0).normal(0.0, 1e-6, (20, 2 * mechanism.n)):
        np.testing.assert_allclose(law(0.0, x).demand, k @ x, atol=1e-4 * np.abs(k).max() * 1e-6)


def test_what_is_kept_for_all_is_read_only(rig: ut.Mechanism, base: ut.Surface) -> None:
    """A caller who writes into the feedback would change it for every other."""
    k = feedback_at_target(rig, base)
    with pytest.raises(ValueError, match="read-only"):
        k[0, 0] = 0.0
