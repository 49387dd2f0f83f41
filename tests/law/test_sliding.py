"""The sliding-mode law: identities (3)-(20), gains, singularity, limits, for any n and m."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import pytest
import sympy as sp
from hypothesis import given, settings
from hypothesis import strategies as st

import undertow as ut
from support import (
    SHAPES,
    corners,
    random_mechanism,
    random_states,
    random_surface,
    rest_slow,
    runge_kutta,
)
from undertow.base import InvalidInputError, SingularSurfaceError, UndertowError
from undertow.law import Switching, gains_at_target
from undertow.law.sliding import singularity
from undertow.models import TIME, FloatArray

shapes = pytest.mark.parametrize(("n", "m"), rest_slow(SHAPES, *SHAPES[:3]))
switchings = pytest.mark.parametrize("switching", ["saturation", "tanh", "sign"])

SWITCHING_FUNCTIONS: dict[str, Callable[[FloatArray], FloatArray]] = {
    "saturation": lambda z: np.clip(z, -1, 1),
    "tanh": np.tanh,
    "sign": np.sign,
}


class Blocks(NamedTuple):
    """The blocks of (1) at K states, and what (2)-(10) make of them, by NumPy alone."""

    M: FloatArray
    M_au: FloatArray
    M_uu: FloatArray
    f_u: FloatArray
    X: FloatArray
    gamma: FloatArray
    E: FloatArray


def blocks(mechanism: ut.Mechanism, surface: ut.Surface, x: FloatArray) -> Blocks:
    n, m = mechanism.n, mechanism.m
    M = mechanism.M(x[:, :n])
    M_au, M_uu = M[:, :m, m:], M[:, m:, m:]
    M_ua = np.swapaxes(M_au, 1, 2)
    X = np.asarray(np.linalg.solve(M_uu, M_ua), dtype=float)
    E = M_uu - M_ua @ np.linalg.solve(surface.alpha_a, surface.alpha_u)
    return Blocks(M, M_au, M_uu, mechanism.f(x)[:, m:], X, surface.alpha_a - surface.alpha_u @ X, E)


def usable_states(mechanism: ut.Mechanism, surface: ut.Surface, count: int = 400) -> FloatArray:
    """Random states at which Γ is not near singular, (37)."""
    x = random_states(mechanism, 2 * count)
    det = singularity(mechanism, surface.vector, x[:, : mechanism.n])
    usable = x[np.abs(det) > 0.1]
    assert len(usable) > count
    return usable[:count]


def s_dot(surface: ut.Surface, x: FloatArray, qdd: FloatArray) -> FloatArray:
    """ṡ by the chain rule from (10)."""
    qd = x[..., surface.n :]
    return np.asarray(qd @ surface.position_row.T + qdd @ surface.velocity_row.T)


# -- the reaching law ------------------------------------------------------------------------


@shapes
@switchings
def test_12_makes_s_decay_as_the_reaching_law_says(n: int, m: int, switching: Switching) -> None:
    """ṡ = −K sw(s/ε) at every state where Γ is regular, unsaturated and undisturbed."""
    mechanism, surface = random_mechanism(n, m), random_surface(n, m)
    eta, layer = tuple(5.0 + i for i in range(m)), tuple(2.0 - 0.5 * i for i in range(m))
    law = ut.SlidingModeLaw(mechanism, surface, ut.ReachingLaw(eta, layer, switching))
    x = usable_states(mechanism, surface)
    control = law(0.0, x)
    np.testing.assert_allclose(control.s, surface.s(x), rtol=1e-12, atol=1e-12)
    expected = -np.array(eta) * SWITCHING_FUNCTIONS[switching](control.s / np.array(layer))
    found = s_dot(surface, x, mechanism.accelerations(0.0, x, control.demand))
    np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-8)
    inside = np.abs(control.s) < np.array(layer)
    assert inside.any()
    assert not inside.all()


@shapes
def test_5_makes_the_actuated_accelerations_equal_v(n: int, m: int) -> None:
    """Partial feedback linearisation (5)-(7): q̈_a = v and q̈_u = M_uu⁻¹ (f_u − M_auᵀ v)."""
    mechanism, surface = random_mechanism(n, m), random_surface(n, m)
    x = usable_states(mechanism, surface)
    k = blocks(mechanism, surface, x)
    control = ut.SlidingModeLaw(mechanism, surface)(0.0, x)
    s_r_dot = x[:, n:] @ surface.position_row.T
    free = np.linalg.solve(k.M_uu, k.f_u[..., None])[..., 0]
    reaching = control.gains * np.clip(control.s / 0.1, -1, 1)
    drive = free @ surface.alpha_u.T + s_r_dot + reaching
    v = -np.linalg.solve(k.gamma, drive[..., None])[..., 0]
    qdd = mechanism.accelerations(0.0, x, control.demand)
    np.testing.assert_allclose(qdd[:, :m], v, rtol=1e-8, atol=1e-8)
    expected = free - np.einsum("kij,kj->ki", k.X, v)
    np.testing.assert_allclose(qdd[:, m:], expected, rtol=1e-8, atol=1e-8)


@switchings
def test_switching_functions_are_odd_bounded_and_agree_with_their_names(
    switching: Switching, rig: ut.Mechanism
) -> None:
    """The reaching part of the demand alone: it vanishes with s and reverses with it."""
    surface = ut.Surface(-1, -0.5, 0, 1)  # α_u = 0: Γ = α_a everywhere
    weak, strong = (
        ut.SlidingModeLaw(rig, surface, ut.ReachingLaw(eta, 0.5, switching)) for eta in (1.0, 3.0)
    )
    s = np.linspace(-2, 2, 41)
    x = np.zeros((41, 4))
    x[:, 0] = s / -0.5  # at rest, upright: s = λ_a θ and nothing else moves
    extra = strong(0.0, x).demand - weak(0.0, x).demand
    shape = SWITCHING_FUNCTIONS[switching](s / 0.5)
    gain = extra[-1, 0] / shape[-1]
    np.testing.assert_allclose(extra[:, 0], gain * shape, rtol=1e-12, atol=1e-12)
    assert extra[20, 0] == 0.0


# -- disturbances and gains ------------------------------------------------------------------


@lru_cache(maxsize=8)
def declared(mechanism: ut.Mechanism) -> ut.Mechanism:
    """The mechanism with disturbance bounds on all coordinates."""
    return mechanism.with_disturbance_bounds(*(0.3 + 0.2 * i for i in range(mechanism.n)))


@shapes
def test_gains_are_those_of_13(n: int, m: int) -> None:
    """k_i = η_i + ‖row_i α_a‖₁ ‖g̃_a‖_∞ + ‖row_i α_u‖₁ ‖g̃_u‖_∞ with (8)-(9) taken by bounds."""
    mechanism, surface = declared(random_mechanism(n, m)), random_surface(n, m)
    x = usable_states(mechanism, surface)
    k = blocks(mechanism, surface, x)
    bounds = np.array(mechanism.disturbance_bounds)
    schur = k.M[:, :m, :m] - k.M_au @ k.X
    coupled = np.abs(k.M_au @ np.linalg.inv(k.M_uu))
    g_a = np.einsum("kij,kj->ki", np.abs(np.linalg.inv(schur)), bounds[:m] + coupled @ bounds[m:])
    g_u = np.abs(np.linalg.inv(k.M_uu)) @ bounds[m:] + np.einsum("kij,kj->ki", np.abs(k.X), g_a)
    eta = np.arange(1.0, m + 1)
    expected = (
        eta
        + np.abs(surface.alpha_a).sum(1) * g_a.max(1)[:, None]
        + np.abs(surface.alpha_u).sum(1) * g_u.max(1)[:, None]
    )
    law = ut.SlidingModeLaw(mechanism, surface, ut.ReachingLaw(eta=tuple(eta)))
    np.testing.assert_allclose(law(0.0, x).gains, expected, rtol=1e-10)


@shapes
def test_gains_at_the_target_are_the_laws_own_there(n: int, m: int) -> None:
    """For many surfaces and η at once, each as a law of its own says at x = 0."""
    mechanism = declared(random_mechanism(n, m))
    surfaces = [random_surface(n, m, seed) for seed in range(4)]
    eta = 1.0 + np.arange(4.0 * m).reshape(4, m)
    together = gains_at_target(mechanism, np.stack([s.vector for s in surfaces]), eta)
    assert together.shape == (4, m)
    for surface, own, found in zip(surfaces, eta, together, strict=True):
        law = ut.SlidingModeLaw(mechanism, surface, ut.ReachingLaw(tuple(own)))
        np.testing.assert_allclose(found, law(0.0, np.zeros(2 * n)).gains, rtol=1e-12)


@shapes
def test_gains_cover_every_disturbance_within_the_bounds(n: int, m: int) -> None:
    """K − η ≥ |α_a g̃_a + α_u g̃_u| for (g̃_a, g̃_u) = M⁻¹ g and all corners of the box of g."""
    mechanism, surface = declared(random_mechanism(n, m)), random_surface(n, m)
    x = usable_states(mechanism, surface)
    gains = ut.SlidingModeLaw(mechanism, surface, ut.ReachingLaw(eta=1.0))(0.0, x).gains
    g = corners(mechanism.disturbance_bounds)
    accelerations = np.linalg.solve(mechanism.M(x[:, :n])[:, None], g[None, ..., None])[..., 0]
    push = np.abs(accelerations @ surface.velocity_row.T).max(axis=1)
    assert (gains - 1.0 >= push - 1e-9).all()
    if (n, m) == (2, 1):
        # One coordinate of each kind: every absolute value in (13) is attained somewhere.
        assert (push / (gains - 1.0)).max() > 0.95


@shapes
def test_16_holds_under_every_disturbance_within_the_bounds(n: int, m: int) -> None:
    """V = ½ sᵀs falls at least as fast as Σ η_i |s_i| with sign switching, disturbed or not."""
    mechanism, surface = declared(random_mechanism(n, m)), random_surface(n, m)
    eta = np.full(m, 0.2)
    x = usable_states(mechanism, surface)
    g = corners(mechanism.disturbance_bounds)
    g = np.vstack([g, np.random.default_rng(9).uniform(-1, 1, (20, n)) * g[-1]])
    push = np.linalg.solve(mechanism.M(x[:, :n])[:, None], g[None, ..., None])[..., 0]

    def worst(believed: ut.Mechanism) -> FloatArray:
        law = ut.SlidingModeLaw(believed, surface, ut.ReachingLaw(tuple(eta), switching="sign"))
        control = law(0.0, x)
        qdd = mechanism.accelerations(0.0, x, control.demand)[:, None] + push
        rate = s_dot(surface, x[:, None], qdd)
        V_dot = np.einsum("kji,ki->kj", rate, control.s)
        bound = -(eta * np.abs(control.s)).sum(1)
        return np.asarray((V_dot - bound[:, None]).max(axis=1))

    assert worst(mechanism).max() <= 1e-9
    # Without declared bounds the same disturbances do break (16): the gains are what holds it.
    assert worst(random_mechanism(n, m)).max() > 0.1


@shapes
def test_s_reaches_zero_within_the_time_of_16_under_disturbance(n: int, m: int) -> None:
    """Sign switching, sinusoidal disturbance at its bounds: s = 0 by ‖s(0)‖₂ / min η."""
    believed, surface = declared(random_mechanism(n, m)), random_surface(n, m)
    plant = believed.disturbed(
        {
            c.name: bound * sp.sin(7 * TIME + i)
            for i, (c, bound) in enumerate(
                zip(believed.coordinates, believed.disturbance_bounds, strict=True)
            )
        }
    )
    eta, step = 10.0, 1e-3
    law = ut.SlidingModeLaw(believed, surface, ut.ReachingLaw(eta=eta, switching="sign"))
    x0 = random_states(believed, 6, position=0.4, speed=0.8)
    s0 = surface.s(x0)
    bounds = np.linalg.norm(s0, axis=-1) / eta
    steps = math.ceil(max(bounds) / step) + 1
    path = runge_kutta(plant, lambda t, x: law(t, x).demand, x0, step, steps)
    s = np.abs(surface.s(path)).max(axis=-1)
    chatter = 2 * step * float(law(0.0, path).gains.max())
    for lane, bound in enumerate(bounds):
        by_then = math.ceil(bound / step)
        assert s[by_then:, lane].max() <= chatter
        assert s[0, lane] > 5 * chatter  # the claim is not empty
    assert law(0.0, path).margin.min() > 0


# -- on the surface --------------------------------------------------------------------------


@shapes
def test_19_and_20_are_inverses_of_E(n: int, m: int) -> None:
    """M̃₁ = E⁻¹, M̃₂ = E⁻¹ M_auᵀ α_a⁻¹ with E = M_uu − M_auᵀ α_a⁻¹ α_u."""
    mechanism, surface = random_mechanism(n, m), random_surface(n, m)
    k = blocks(mechanism, surface, usable_states(mechanism, surface))
    inverse_uu, inverse_gamma = np.linalg.inv(k.M_uu), np.linalg.inv(k.gamma)
    M1 = inverse_uu + k.X @ inverse_gamma @ surface.alpha_u @ inverse_uu
    M2 = k.X @ inverse_gamma
    inverse_E = np.linalg.inv(k.E)
    np.testing.assert_allclose(M1, inverse_E, rtol=1e-8, atol=1e-9)
    expected = inverse_E @ np.swapaxes(k.M_au, 1, 2) @ np.linalg.inv(surface.alpha_a)
    np.testing.assert_allclose(M2, expected, rtol=1e-8, atol=1e-9)


@shapes
def test_gamma_is_singular_exactly_where_E_is(n: int, m: int) -> None:
    """det Γ · det M_uu = det α_a · det E, for near-singular surfaces too."""
    mechanism, surface = random_mechanism(n, m), random_surface(n, m)
    steep = ut.Surface(
        surface.alpha_a, surface.lambda_a, 8 * surface.alpha_u, surface.lambda_u
    )  # its Γ changes sign within the sample
    x = random_states(mechanism, 2000)
    k = blocks(mechanism, steep, x)
    left = np.linalg.det(k.gamma) * np.linalg.det(k.M_uu)
    right = np.linalg.det(steep.alpha_a) * np.linalg.det(k.E)
    np.testing.assert_allclose(left, right, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(
        singularity(mechanism, steep.vector, x[:, :n]), np.linalg.det(k.gamma), rtol=1e-10
    )


@shapes
def test_on_the_surface_matched_disturbances_do_not_appear(n: int, m: int) -> None:
    """With ṡ = 0: E q̈_u = f_u + g_u + M_auᵀ α_a⁻¹ ṡ_r, whatever g_a; (18) as corrected."""
    mechanism, surface = random_mechanism(n, m), random_surface(n, m)
    x = usable_states(mechanism, surface)
    rest = surface.s(x) - x[:, n : n + m] @ surface.alpha_a.T
    x[:, n : n + m] = -np.linalg.solve(surface.alpha_a, rest.T).T  # q̇_a from s = 0, (17)
    np.testing.assert_allclose(surface.s(x), 0.0, atol=1e-12)
    k = blocks(mechanism, surface, x)
    g = np.random.default_rng(3).uniform(-2, 2, (len(x), n))
    s_r_dot = x[:, n:] @ surface.position_row.T
    matched = np.linalg.solve(surface.alpha_a, s_r_dot.T).T
    right = k.f_u + g[:, m:] + np.einsum("kji,kj->ki", k.M_au, matched)
    expected = np.linalg.solve(k.E, right[..., None])[..., 0]

    # The equivalent control: the input that keeps ṡ = 0 in spite of g; ṡ is affine in u.
    def rate(u: FloatArray) -> tuple[FloatArray, FloatArray]:
        push = np.linalg.solve(k.M, g[..., None])[..., 0]
        qdd = mechanism.accelerations(0.0, x, u) + push
        return s_dot(surface, x, qdd), qdd

    zero = np.zeros((len(x), m))
    offset = rate(zero)[0]
    columns = [rate(zero + np.eye(m)[i])[0] - offset for i in range(m)]
    u = np.linalg.solve(np.stack(columns, axis=-1), offset[..., None])[..., 0]
    remaining, qdd = rate(-u.astype(float))
    np.testing.assert_allclose(remaining, 0.0, atol=1e-8)
    np.testing.assert_allclose(qdd[:, m:], expected, rtol=1e-7, atol=1e-7)


# -- singularity -----------------------------------------------------------------------------


@shapes
def test_margin_is_the_determinant_of_gamma_over_that_at_the_target(n: int, m: int) -> None:
    mechanism, surface = random_mechanism(n, m), random_surface(n, m)
    x = random_states(mechanism, 300)
    law = ut.SlidingModeLaw(mechanism, surface)
    k = blocks(mechanism, surface, x)
    at_target = blocks(mechanism, surface, np.zeros((1, 2 * n)))
    expected = np.linalg.det(k.gamma) / np.linalg.det(at_target.gamma)[0]
    np.testing.assert_allclose(law(0.0, x).margin, expected, rtol=1e-9, atol=1e-12)
    assert law(0.0, np.zeros(2 * n)).margin == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("alpha_u", "degrees"), [(5.0, 78.0), (1.94, 57.6), (2.46, 65.0), (1.96, 58.0), (1.49, 45.8)]
)
def test_rotary_pendulum_is_singular_at_arccos_of_epsilon(
    alpha_u: float, degrees: float, rig: ut.Mechanism
) -> None:
    """(37): the margin of the paper's five surfaces changes sign at 78, 57.6, 65, 58, 45.8°."""
    law = ut.SlidingModeLaw(rig, ut.Surface(-1, -0.5, alpha_u, 10))
    M = rig.M([0, 0])
    edge = math.acos(-M[1, 1] / (M[0, 1] * alpha_u))
    assert math.degrees(edge) == pytest.approx(degrees, abs=0.1)
    assert law(0.0, rig.state(phi=edge - 1e-6)).margin > 0
    assert law(0.0, rig.state(phi=edge)).margin == pytest.approx(0.0, abs=1e-12)
    assert law(0.0, rig.state(phi=edge + 1e-6)).margin < 0


def vanishing_gamma() -> tuple[ut.Mechanism, ut.Surface]:
    """Γ = −2 + (1 + z²): regular at the target, and exactly zero at z = 1."""
    y, z = ut.Coordinate("y", "m"), ut.Coordinate("z", "m")
    coupling = 1 + z.symbol**2
    mechanism = ut.Mechanism(
        "vanishing",
        (y, z),
        (ut.Input("push", "N", 7.0),),
        sp.ImmutableDenseMatrix([[1 + coupling**2, coupling], [coupling, 1]]),
        sp.ImmutableDenseMatrix([0, z.symbol]),
    )
    return mechanism, ut.Surface(-2, -1, -1, -3)


@switchings
def test_at_a_singular_state_the_margin_is_zero_and_the_input_finite(switching: Switching) -> None:
    mechanism, surface = vanishing_gamma()
    law = ut.SlidingModeLaw(mechanism, surface, ut.ReachingLaw(switching=switching))
    for x in ([0.2, 1.0, 0.1, -0.3], [0.0, 1.0, 0.0, 0.0], [0.0, -1.0, 5.0, 2.0]):
        control = law(0.0, x)
        assert control.margin == 0.0
        assert np.isfinite(control.demand).all()
        assert (np.abs(control.u) <= 7.0).all()


@switchings
def test_12_holds_where_gamma_is_small_one_or_a_number_like_any_other(
    switching: Switching,
) -> None:
    """Zero alone is singular: ṡ = −η sw(s/ε) at det Γ = 1 and at 1e-5, and a leap at 0."""
    mechanism, _ = vanishing_gamma()
    surface = ut.Surface(-1, -1, -2, -3)  # Γ = −1 + 2 (1 + z²): 1 at the target
    reaching = ut.ReachingLaw(4.0, 0.5, switching)
    law = ut.SlidingModeLaw(mechanism, surface, reaching)
    x = np.array([0.2, 0.0, 0.1, -0.3])
    assert law.gamma_target == 1.0
    control = law(0.0, x)
    qdd = mechanism.accelerations(0.0, x, control.demand)
    expected = -4.0 * SWITCHING_FUNCTIONS[switching](control.s / 0.5)
    np.testing.assert_allclose(s_dot(surface, x, qdd), expected, rtol=1e-10)
    near = ut.Surface(-2, -1, -2 * (1 - 5e-6), -3)  # det Γ(0) = −1e-5
    control = ut.SlidingModeLaw(mechanism, near, reaching)(0.0, x)
    qdd = mechanism.accelerations(0.0, x, control.demand)
    expected = -4.0 * SWITCHING_FUNCTIONS[switching](control.s / 0.5)
    np.testing.assert_allclose(s_dot(near, x, qdd), expected, rtol=1e-6)
    singular = ut.SlidingModeLaw(mechanism, ut.Surface(-2, -1, -1, -3), reaching)
    assert abs(singular(0.0, [0.2, 1.0, 0.1, -0.3]).demand[0]) > 1e200


@shapes
def test_a_surface_in_other_units_is_the_same_surface(n: int, m: int) -> None:
    """With s, η and ε a millionth of what they were nothing else changes: law, margins, checks."""
    mechanism, surface = random_mechanism(n, m), random_surface(n, m)
    small = ut.Surface.from_vector(1e-6 * surface.vector / (1e-6 ** (1 - 1 / m)), n, m)
    scale = float(small.vector[0] / surface.vector[0])
    x = usable_states(mechanism, surface, 50)
    one = ut.SlidingModeLaw(mechanism, surface, ut.ReachingLaw(5.0, 0.5))(0.0, x)
    other = ut.SlidingModeLaw(mechanism, small, ut.ReachingLaw(5.0 * scale, 0.5 * scale))(0.0, x)
    np.testing.assert_allclose(other.demand, one.demand, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(other.s, scale * one.s, rtol=1e-12)
    np.testing.assert_allclose(other.margin, one.margin, rtol=1e-9)


def test_demands_beyond_all_numbers_keep_their_sign() -> None:
    """The law of the rotary pendulum is odd, and stays so where its demand overflows."""
    law = limited_law("saturation")
    x = np.random.default_rng(3).uniform(-1, 1, (200, 4)) * [0.3, 0.3, 0.0, 1e160]
    one, other = law(0.0, x), law(0.0, -x)
    assert (np.abs(one.demand) > 1e299).any()
    np.testing.assert_array_equal(one.u, -other.u)
    assert (np.abs(one.u) == 15.0).any()


def test_what_is_not_a_number_in_the_end_is_no_input() -> None:
    """∞ − ∞ in the law gives no force at all, in NumPy as in the compiled step."""
    law = limited_law("saturation")
    x = np.array([0.0, 1e300, 1e300, -1e300])
    assert law(0.0, x).demand[0] == 0.0
    assert law(0.0, x).u[0] == 0.0


def test_a_surface_singular_at_the_target_is_refused() -> None:
    mechanism, _ = vanishing_gamma()
    with pytest.raises(SingularSurfaceError) as caught:
        ut.SlidingModeLaw(mechanism, ut.Surface(-2, -1, -2, -3))
    assert "determinant 0" in str(caught.value)
    assert caught.value.limit is not None
    assert caught.value.remedy


# -- limits ----------------------------------------------------------------------------------

huge = st.floats(-1e300, 1e300, allow_nan=False)


@lru_cache
def limited_law(switching: Switching) -> ut.SlidingModeLaw:
    mechanism = ut.mechanisms.rotary_pendulum().with_disturbance_bounds(0.1, 0.1)
    return ut.SlidingModeLaw(
        mechanism, ut.Surface(-1, -0.5, 5, 10), ut.ReachingLaw(switching=switching)
    )


@lru_cache
def limited_law_of_two() -> ut.SlidingModeLaw:
    return ut.SlidingModeLaw(
        random_mechanism(4, 2).with_input_limit(3.0, 0.5), random_surface(4, 2)
    )


@given(st.tuples(huge, huge, huge, huge), st.sampled_from(["saturation", "tanh", "sign"]))
def test_the_input_never_leaves_its_limits_and_is_never_nan(
    x: tuple[float, ...], switching: Switching
) -> None:
    control = limited_law(switching)(0.0, x)
    assert abs(control.u[0]) <= 15.0
    assert np.isfinite(control.demand).all()
    assert not any(np.isnan(field).any() for field in control)


@settings(max_examples=60)
@given(st.lists(huge, min_size=8, max_size=8))
def test_two_inputs_never_leave_their_limits_and_are_never_nan(x: list[float]) -> None:
    control = limited_law_of_two()(0.0, x)
    assert abs(control.u[0]) <= 3.0
    assert abs(control.u[1]) <= 0.5
    assert np.isfinite(control.demand).all()
    assert not any(np.isnan(field).any() for field in control)


def test_the_input_is_the_demand_until_the_limit_is_met(
    rig: ut.Mechanism, base: ut.Surface
) -> None:
    law = ut.SlidingModeLaw(rig, base)
    x = random_states(rig, 300, position=1.0, speed=8.0)
    control = law(0.0, x)
    within = np.abs(control.demand) <= 15.0
    assert within.any()
    assert not within.all()
    np.testing.assert_array_equal(control.u[within], control.demand[within])
    np.testing.assert_array_equal(control.u[~within], 15.0 * np.sign(control.demand[~within]))


def test_batches_of_states_equal_single_states(rig: ut.Mechanism, base: ut.Surface) -> None:
    law = ut.SlidingModeLaw(rig.with_disturbance_bounds(0.1, 0.05), base)
    x = random_states(rig, 12).reshape(3, 4, 4)
    together = law(0.0, x)
    for index in np.ndindex(3, 4):
        alone = law(0.0, x[index])
        for batch, single in zip(together, alone, strict=True):
            np.testing.assert_allclose(batch[index], single, rtol=1e-13, atol=1e-13)


# -- surfaces --------------------------------------------------------------------------------


@shapes
def test_a_surface_comes_back_from_its_2mn_entries(n: int, m: int) -> None:
    surface = random_surface(n, m)
    assert surface.vector.shape == (2 * m * n,)
    again = ut.Surface.from_vector(surface.vector, n, m)
    assert again == surface
    assert hash(again) == hash(surface)
    assert (again.n, again.m) == (n, m)
    x = np.random.default_rng(0).standard_normal((5, 2 * n))
    q_a, q_u, qd_a, qd_u = np.split(x, [m, n, n + m], axis=1)
    expected = (
        qd_a @ surface.alpha_a.T
        + q_a @ surface.lambda_a.T
        + qd_u @ surface.alpha_u.T
        + q_u @ surface.lambda_u.T
    )
    np.testing.assert_allclose(surface.s(x), expected, rtol=1e-12, atol=1e-13)


@shapes
def test_normalising_keeps_the_surface_as_a_set(n: int, m: int) -> None:
    """α_a = −I, and s = 0 at the same states: 2mn − m² entries are free."""
    surface = random_surface(n, m)
    normal = surface.normalised()
    np.testing.assert_allclose(normal.alpha_a, -np.eye(m), atol=1e-14)
    kernel = np.linalg.svd(surface.matrix)[2][m:]
    np.testing.assert_allclose(normal.matrix @ kernel.T, 0.0, atol=1e-12)


def test_a_surface_equals_its_like_alone(base: ut.Surface, quick: ut.Surface) -> None:
    """Entry by entry, and nothing that is no surface; one that is normal stays as it is."""
    assert base != quick
    assert base != ut.Surface(-1, -0.5, 5, 10.5)
    assert base != base.vector.tolist()
    assert base.normalised() is base
    np.testing.assert_array_equal(ut.Surface(1, 0.5, -5, -10).normalised().vector, base.vector)


def test_two_surfaces_may_be_tied_crosswise() -> None:
    """α_a with zeros on its diagonal is regular; with equal rows it is not."""
    swapped = ut.Surface([[0, 1], [1, 0]], np.eye(2), [[1], [2]], [[3], [4]])
    np.testing.assert_allclose(swapped.normalised().alpha_u, [[-2], [-1]])
    with pytest.raises(InvalidInputError, match="invertible"):
        ut.Surface([[1, 1], [1, 1]], np.eye(2), [[1], [2]], [[3], [4]])


def test_a_notebook_shows_the_equation_of_a_surface() -> None:
    """Each block stands before what it weighs: numbers for one input, rows of numbers for two."""
    latex = ut.Surface(-1, -0.5, 5, 10)._repr_latex_()
    for number, what in (
        ("-1", r"\dot{q}_a"),
        ("-0.5", "q_a"),
        ("+5", r"\dot{q}_u"),
        ("+10", "q_u"),
    ):
        assert rf"{number}\,{what}" in latex
    surface = ut.Surface(
        np.array([[-1, 0.5], [0, -2]]), -np.eye(2), np.array([[3], [4]]), np.array([[5], [6]])
    )
    latex = surface._repr_latex_()
    assert r"{pmatrix} -1 & 0.5 \\ 0 & -2 \end{pmatrix}\,\dot{q}_a" in latex
    assert r"{pmatrix} 5 \\ 6 \end{pmatrix}\,q_u" in latex


def test_surfaces_cannot_be_changed_by_accident() -> None:
    entries = np.array([[5.0]])
    surface = ut.Surface(-1, -0.5, entries, 10)
    entries[0, 0] = 1.0
    assert surface.alpha_u[0, 0] == 5.0
    with pytest.raises(ValueError, match="read-only"):
        surface.alpha_u[0, 0] = 1.0


REFUSALS: dict[str, tuple[Callable[[], object], tuple[str, ...]]] = {
    "NaN": (lambda: ut.Surface(-1, math.nan, 5, 10), ("lambda_a", "nan", "finite")),
    "singular α_a": (lambda: ut.Surface(0, -1, 5, 10), ("alpha_a", "[[0.0]]", "invertible")),
    "shape": (
        lambda: ut.Surface(-np.eye(2), -np.eye(2), np.ones((2, 2)), np.ones((2, 1))),
        ("lambda_u", "(2, 1)", "(2, 2)"),
    ),
    "another n": (
        lambda: ut.SlidingModeLaw(ut.mechanisms.rotary_pendulum(), random_surface(3, 1)),
        ("rotary_pendulum", "n = 3, m = 1", "n = 2, m = 1"),
    ),
    "zero η": (lambda: ut.ReachingLaw(eta=0.0), ("eta", "got 0.0", "> 0")),
    "NaN ε": (lambda: ut.ReachingLaw(layer=math.nan), ("layer", "nan", "finite")),
    "unknown switching": (
        lambda: ut.ReachingLaw(switching="smooth"),  # type: ignore[arg-type]
        ("'smooth'", "saturation, tanh, sign"),
    ),
    "a law that is none": (
        lambda: ut.SlidingModeLaw(
            ut.mechanisms.rotary_pendulum(),
            ut.Surface(-1, -0.5, 5, 10),
            0.1,  # type: ignore[arg-type]
        ),
        ("reaching", "0.1", "ReachingLaw"),
    ),
    "a plant that depends on time": (
        lambda: ut.SlidingModeLaw(
            ut.mechanisms.rotary_pendulum().disturbed({"phi": sp.sin(TIME)}),
            ut.Surface(-1, -0.5, 5, 10),
        ),
        ("time", "autonomous"),
    ),
    "too few entries": (
        lambda: ut.Surface.from_vector([-1, -0.5, 5], 2, 1),
        ("shape (3,)", "(4,)"),
    ),
    "no inputs": (lambda: ut.Surface.from_vector([], 2, 0), ("number of inputs", "0")),
    "no free coordinate": (
        lambda: ut.Surface.from_vector([-1, -0.5], 1, 1),
        ("number of coordinates", "1", "2"),
    ),
    "a state of another length": (
        lambda: ut.Surface(-1, -0.5, 5, 10).s([0.1, 0.2, 0.3]),
        ("states of a surface", "(3,)", "4"),
    ),
    "one number for a state": (
        lambda: ut.Surface(-1, -0.5, 5, 10).s(0.1),
        ("states of a surface", "()", "4"),
    ),
    "gains of no inputs": (lambda: ut.ReachingLaw().vector(0), ("number of inputs", "0")),
    "text for a gain": (
        lambda: ut.ReachingLaw(eta="20"),  # type: ignore[arg-type]
        ("eta", "'20'"),
    ),
    "too many η": (
        lambda: ut.ReachingLaw(eta=(1.0, 2.0)).vector(1),
        ("eta", "got 2 numbers", "must be 1."),
    ),
}


@pytest.mark.parametrize("what", REFUSALS)
def test_bad_input_is_refused_with_value_limit_and_remedy(what: str) -> None:
    attempt, facts = REFUSALS[what]
    with pytest.raises(InvalidInputError) as caught:
        attempt()
    error = caught.value
    for fact in facts:
        assert fact in str(error), str(error)
    assert error.value is not None
    assert error.limit is not None
    assert error.remedy, str(error)
    assert isinstance(error, UndertowError)


def test_a_state_that_is_nan_is_refused(rig: ut.Mechanism, base: ut.Surface) -> None:
    with pytest.raises(InvalidInputError, match=r"phi_dot.*nan"):
        ut.SlidingModeLaw(rig, base)(0.0, [0.0, 0.1, 0.0, math.nan])


@shapes
def test_sliding_coordinates_are_those_of_the_states_on_the_surface(n: int, m: int) -> None:
    """s = 0 there by the law itself; back and forth are inverses."""
    mechanism, surface = random_mechanism(n, m), random_surface(n, m)
    y = np.random.default_rng(n).uniform(-0.2, 0.2, (3, 4, 2 * n - m))
    x = surface.on_surface(y)
    assert x.shape == (3, 4, 2 * n)
    law = ut.SlidingModeLaw(mechanism, surface)
    assert np.abs(law(0.0, x.reshape(-1, 2 * n)).s).max() < 1e-12 * np.abs(surface.matrix).max()
    np.testing.assert_allclose(surface.sliding_coordinates(x), y, atol=1e-11)
    with pytest.raises(InvalidInputError, match=r"sliding coordinates.*shape"):
        surface.on_surface(y[..., 1:])
    singular = ut.Surface(surface.alpha_a, np.zeros((m, m)), surface.alpha_u, surface.lambda_u)
    with pytest.raises(InvalidInputError, match="lambda_a of a surface"):
        singular.sliding_coordinates(x)
