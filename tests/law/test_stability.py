"""Stability on the surface: the exact condition, (35)-(37), first surfaces, refusals."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.linalg
import sympy as sp
from numpy.typing import NDArray

import undertow as ut
from undertow.base import InvalidInputError, ModelError, SingularSurfaceError, UnstableSurfaceError
from undertow.export import EmbeddedController
from undertow.law import (
    OVERSHOOTS,
    gains_at_target,
    quadratic_designs,
    sliding_matrix,
    stability_margin,
    usual_reaching,
)
from undertow.models import Linearisation, controllability, linearise
from undertow.studies.paper import CASES

Spectrum = NDArray[Any]
SHAPES = [(2, 1), (3, 1), (3, 2), (4, 2), (5, 2), (5, 3)]


def constants(rig: ut.Mechanism) -> tuple[float, float, float]:
    """The paper's b, c and d from the mechanism's own numbers."""
    value = {p.name: p.value for p in rig.parameters}
    b = value["m"] * value["l"] * value["r_o"]
    return b, 4 / 3 * value["m"] * value["l"] ** 2, value["m"] * value["g"] * value["l"]


def random_mechanism(n: int, m: int, rng: np.random.Generator) -> ut.Mechanism:
    """A linear mechanism with random M > 0, stiffness, damping and input matrix."""
    root = rng.standard_normal((n, n))
    M = root @ root.T + n * np.eye(n)
    F, D = rng.standard_normal((n, n)), 0.3 * rng.standard_normal((n, n))
    coordinates = [ut.Coordinate(f"q{i}") for i in range(n)]
    q = sp.Matrix([c.symbol for c in coordinates])
    v = sp.Matrix([c.velocity for c in coordinates])
    B = rng.standard_normal((m, m)) + 2 * np.eye(m)
    return ut.Mechanism(
        f"linear_{n}_{m}",
        tuple(coordinates),
        tuple(ut.Input(f"u{i}", "N m") for i in range(m)),
        sp.ImmutableDenseMatrix((M + M.T) / 2),
        sp.ImmutableDenseMatrix(sp.Matrix(F) * q + sp.Matrix(D) * v),
        sp.ImmutableDenseMatrix(B),
    )


def random_surface(n: int, m: int, rng: np.random.Generator) -> ut.Surface:
    shapes = [(m, m), (m, m), (m, n - m), (m, n - m)]
    alpha_a, lambda_a, alpha_u, lambda_u = (rng.standard_normal(shape) for shape in shapes)
    return ut.Surface(alpha_a - 2 * np.eye(m), lambda_a, alpha_u, lambda_u)


def match_spectra(left: Spectrum, right: Spectrum, tolerance: float) -> None:
    """Assert that two spectra agree, whatever their order."""
    assert left.shape == right.shape
    scale = 1 + np.abs(left).max()
    rest = list(right)
    for value in left:
        nearest = int(np.argmin([abs(value - other) for other in rest]))
        assert abs(value - rest.pop(nearest)) < tolerance * scale


# -- the exact condition -----------------------------------------------------------------


@pytest.mark.parametrize(
    ("case", "expected"),
    [
        ("1 base case", [-0.92 + 3.11j, -0.92 - 3.11j, -0.548]),
        ("2 one-time, energy", [-5.91 + 3.55j, -5.91 - 3.55j, -0.264]),
        ("3 last of cascade, energy", [-5.28 + 1.78j, -5.28 - 1.78j, -0.104]),
        ("4 one-time, time", [-3.81 + 2.58j, -3.81 - 2.58j, -3.72]),
        ("5 last of cascade, time", [-5.17 + 4.13j, -5.17 - 4.13j, -5.54]),
    ],
)
def test_eigenvalues_of_the_five_cases(
    rig: ut.Mechanism, case: str, expected: list[complex]
) -> None:
    """The paper's surfaces slide with the eigenvalues derived by hand for b = 0.0045."""
    found = np.linalg.eigvals(sliding_matrix(rig, CASES[case]))
    match_spectra(found, np.array(expected), 0.002)


@pytest.mark.parametrize("case", CASES)
def test_characteristic_polynomial_of_the_rotary_pendulum(rig: ut.Mechanism, case: str) -> None:
    """(α_u b + α_a c)s³ + (bλ_u + cλ_a)s² − α_a d s − λ_a d has the same roots."""
    b, c, d = constants(rig)
    alpha_a, lambda_a, alpha_u, lambda_u = CASES[case].vector
    roots = np.roots(
        [alpha_u * b + alpha_a * c, b * lambda_u + c * lambda_a, -alpha_a * d, -lambda_a * d]
    )
    found = np.linalg.eigvals(sliding_matrix(rig, CASES[case]))
    match_spectra(found, roots, 1e-9)


def test_conditions_35_to_37_at_zero_hold_if_and_only_if_hurwitz(rig: ut.Mechanism) -> None:
    """20,000 random surfaces with α_a = −1: (35)-(37) at φ = 0 ⇔ exponentially stable."""
    b, c, _ = constants(rig)
    rng = np.random.default_rng(35)
    free = rng.standard_normal((20_000, 3)) * [2, 4, 12]
    free[::2] = np.abs(free[::2]) * [-1, 1, 1]  # half of them with the signs of (35)
    lambda_a, alpha_u, lambda_u = free.T
    condition = (
        (lambda_a < 0)
        & (alpha_u > 0)
        & (lambda_u > 0)  # (35)
        & (-lambda_a < lambda_u / alpha_u)  # (36)
        & (-c + b * alpha_u > 0)  # (37) at φ = 0
    )
    vectors = np.column_stack([-np.ones(len(free)), free])
    hurwitz = stability_margin(rig, vectors) > 0
    assert 0.1 < hurwitz.mean() < 0.9
    np.testing.assert_array_equal(condition, hurwitz)


@pytest.mark.parametrize(("n", "m"), SHAPES)
def test_equals_finite_eigenvalues_of_the_pencil(n: int, m: int) -> None:
    """The sliding eigenvalues are the finite ones of [[A − sI, B], [C, 0]], any n and m."""
    rng = np.random.default_rng([n, m])
    mechanism = random_mechanism(n, m, rng)
    lin = linearise(mechanism)
    for _ in range(5):
        surface = random_surface(n, m, rng)
        ours = np.linalg.eigvals(sliding_matrix(mechanism, surface))
        left = np.block([[lin.A, lin.input], [surface.matrix, np.zeros((m, m))]])
        right = scipy.linalg.block_diag(np.eye(2 * n), np.zeros((m, m)))
        pencil = scipy.linalg.eigvals(left, right)
        finite = pencil[np.argsort(np.abs(pencil))[: 2 * n - m]]
        match_spectra(ours, finite, 1e-6)


@pytest.mark.parametrize(("n", "m"), SHAPES)
def test_equals_projected_state_matrix(n: int, m: int) -> None:
    """They are also those of (I − B(CB)⁻¹C)A on ker C, equivalent control, any n and m."""
    rng = np.random.default_rng([m, n])
    mechanism = random_mechanism(n, m, rng)
    lin = linearise(mechanism)
    for _ in range(5):
        surface = random_surface(n, m, rng)
        C = surface.matrix
        projected = lin.A - lin.input @ np.linalg.solve(C @ lin.input, C @ lin.A)
        kernel = scipy.linalg.null_space(C)
        on_kernel = np.linalg.eigvals(kernel.T @ projected @ kernel)
        match_spectra(np.linalg.eigvals(sliding_matrix(mechanism, surface)), on_kernel, 1e-7)


def test_motor_does_not_enter_the_sliding_dynamics() -> None:
    """Damping and gain of the motor and the arm's inertia are matched: they cancel."""
    surface = CASES["4 one-time, time"]
    plain = sliding_matrix(ut.mechanisms.rotary_pendulum(), surface)
    other = ut.mechanisms.rotary_pendulum(d_e=0.5, a_e=1.0, I_e=0.02)
    np.testing.assert_allclose(sliding_matrix(other, surface), plain, rtol=1e-12)


def test_batch_of_surfaces_equals_loop(rig: ut.Mechanism) -> None:
    """One call for many surfaces gives what many calls give; a singular one gives −∞."""
    b, c, _ = constants(rig)
    singular = ut.Surface(-1, -0.5, c / b, 10)
    surfaces = [*CASES.values(), singular]
    together = stability_margin(rig, np.stack([s.vector for s in surfaces]))
    alone = [float(stability_margin(rig, s)) for s in surfaces]
    np.testing.assert_array_equal(together, alone)
    assert together[-1] == -np.inf


def test_linearisation_equals_finite_differences(rig: ut.Mechanism) -> None:
    """A and B at the target equal central differences of the accelerations."""
    lin: Linearisation = linearise(rig)
    h = 1e-6
    steps = np.vstack([np.eye(4), -np.eye(4)]) * h
    rates = rig.accelerations(0.0, steps, np.zeros((8, 1)))
    np.testing.assert_allclose(lin.A[2:], ((rates[:4] - rates[4:]) / (2 * h)).T, atol=1e-5)
    push = rig.accelerations(0.0, np.zeros((2, 4)), np.array([[h], [-h]]))
    np.testing.assert_allclose(lin.input[2:, 0], (push[0] - push[1]) / (2 * h), rtol=1e-8)


# -- first surfaces ------------------------------------------------------------------------


def test_quadratic_design_of_utkin_and_young(rig: ut.Mechanism) -> None:
    """Q = diag(1, 10, 0.1, 0.1) gives λ_a −1.49, α_u 1.72, λ_u 11.9."""
    surface = ut.first_surface(rig, [1, 10, 0.1, 0.1])
    np.testing.assert_allclose(surface.vector, [-1, -1.49, 1.72, 11.9], rtol=5e-3)


@pytest.mark.parametrize("rate", [0.5, 2.0, 5.0])
def test_quadratic_design_keeps_the_rate_asked_for(rig: ut.Mechanism, rate: float) -> None:
    """All eigenvalues lie left of −rate."""
    assert float(stability_margin(rig, ut.first_surface(rig, rate=rate))) >= rate - 1e-9


@pytest.mark.parametrize(("n", "m"), SHAPES)
def test_quadratic_design_stabilises_any_controllable_mechanism(n: int, m: int) -> None:
    """Random (n, m): the designed surface passes the exact condition."""
    mechanism = random_mechanism(n, m, np.random.default_rng([n, m, 1]))
    assert controllability(mechanism) > 1e-6
    assert float(stability_margin(mechanism, ut.first_surface(mechanism))) > 0


@pytest.mark.parametrize(("n", "m"), SHAPES)
def test_pole_placement_places_all_poles(n: int, m: int) -> None:
    """All 2n − m eigenvalues are where they were asked for."""
    mechanism = random_mechanism(n, m, np.random.default_rng([n, m, 2]))
    poles = [-1.0 - 0.7 * k for k in range(2 * n - m)]
    surface = ut.placed_surface(mechanism, poles)
    found = np.sort(np.linalg.eigvals(sliding_matrix(mechanism, surface)).real)
    np.testing.assert_allclose(found, np.sort(poles), rtol=1e-5)


def test_complex_poles_can_be_placed(rig: ut.Mechanism) -> None:
    """Conjugate pairs too."""
    poles = [-4 + 3j, -4 - 3j, -2]
    found = np.linalg.eigvals(sliding_matrix(rig, ut.placed_surface(rig, poles)))
    match_spectra(found, np.array(poles), 1e-9)


@pytest.mark.parametrize(("n", "m"), SHAPES)
def test_the_usual_weights_are_the_documented_ones(n: int, m: int) -> None:
    """1 on q_a, 10 on q_u and 0.1 on the velocities, and no rate asked for."""
    mechanism = random_mechanism(n, m, np.random.default_rng([n, m, 3]))
    weights = [1.0] * m + [10.0] * (n - m) + [0.1] * n
    assert ut.first_surface(mechanism) == ut.first_surface(mechanism, weights, rate=0.0)
    assert ut.first_surface(mechanism) != ut.first_surface(mechanism, weights, rate=0.001)


@pytest.mark.parametrize(("n", "m"), SHAPES)
def test_quadratic_design_minimises_its_integral_on_the_surface(n: int, m: int) -> None:
    """∫ xᵀQx dt on the surface, by Lyapunov's equation, is stationary and rises on both sides.

    Starts are the states that no input moves at once, one of each: the same for all surfaces.
    """
    mechanism = random_mechanism(n, m, np.random.default_rng([n, m, 4]))
    weights = np.linspace(0.5, 2.0, 2 * n)
    best = ut.first_surface(mechanism, weights.tolist())
    unmoved = scipy.linalg.null_space(linearise(mechanism).input.T).T

    def cost(vector: NDArray[Any]) -> float:
        A_s = sliding_matrix(mechanism, vector)
        x_of_z = np.insert(np.eye(2 * n - m), [n] * m, A_s[:m], axis=0)  # q̇_a on the surface
        P = scipy.linalg.solve_continuous_lyapunov(A_s.T, -x_of_z.T @ np.diag(weights) @ x_of_z)
        z_of_start = np.linalg.inv(unmoved @ x_of_z)
        return float(np.trace(z_of_start.T @ P @ z_of_start))

    least = cost(best.vector)
    for k in range(m * m, 2 * m * n):
        step = 1e-3 * np.eye(2 * m * n)[k]
        below, above = (cost(best.vector + side * step) - least for side in (-1, 1))
        assert min(below, above) > 0
        assert abs(above - below) < 0.1 * (above + below)


def test_designs_are_kept_on_disk(
    rig: ut.Mechanism, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second time no Riccati equation is solved; many designs are one file, a wish is none."""
    cache = tmp_path / "designs"
    monkeypatch.setenv("UNDERTOW_CACHE", str(cache))
    weights = 10.0 ** np.random.default_rng(0).uniform(-2, 2, (40, 4))
    first, many = ut.first_surface(rig), quadratic_designs(rig, weights)
    assert len(many) == 40
    assert many[7] == ut.first_surface(rig, list(weights[7]))
    assert len(list(cache.rglob("surfaces_*.txt"))) == 2

    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("solved again")

    monkeypatch.setattr(scipy.linalg, "solve_continuous_are", refuse)
    assert ut.first_surface(rig) == first
    assert quadratic_designs(rig, weights) == many
    with pytest.raises(AssertionError, match="solved again"):
        ut.first_surface(rig, rate=0.26)


@pytest.mark.parametrize("weights", [[1.0, 2.0, 3.0, 4.0], [[1.0, 2.0]], [[1.0, 2.0, 0.0, 1.0]]])
def test_weights_of_designs_are_rows_of_positive_numbers(
    rig: ut.Mechanism, weights: list[Any]
) -> None:
    with pytest.raises(InvalidInputError, match=r"\(N, 4\) numbers > 0"):
        quadratic_designs(rig, weights)


def test_poles_whose_placing_is_not_the_best_there_is_are_placed_without_a_word() -> None:
    """SciPy's search for the best conditioning may stop early: that is no warning to a user."""
    mechanism = random_mechanism(5, 2, np.random.default_rng([5, 2, 2]))
    poles = [-1.0, -1.0, -1.1, -1.1, -1.2, -1.2, -30.0, -31.0]
    found = np.sort(
        np.linalg.eigvals(sliding_matrix(mechanism, ut.placed_surface(mechanism, poles))).real
    )
    np.testing.assert_allclose(found, np.sort(poles), rtol=1e-4)


# -- margins ------------------------------------------------------------------------------


def pair(F: list[list[float]], D: list[list[float]], coupling: float = -1.0) -> ut.Mechanism:
    """Two coordinates, one input, M = [[3, c], [c, 2]] and forces F q + D q̇."""
    a, b = ut.Coordinate("a"), ut.Coordinate("b")
    q, v = sp.Matrix([a.symbol, b.symbol]), sp.Matrix([a.velocity, b.velocity])
    return ut.Mechanism(
        "pair",
        (a, b),
        (ut.Input("u", "N m"),),
        sp.ImmutableDenseMatrix([[3, coupling], [coupling, 2]]),
        sp.ImmutableDenseMatrix(sp.Matrix(F) * q + sp.Matrix(D) * v),
    )


NO_DAMPING = [[-0.4, 0.0], [0.0, 0.0]]  # of the free joint; the actuated one may have it


@pytest.mark.parametrize("coupling", [-1.0, 1.0])
def test_35_and_36_are_given_where_the_paper_derives_them(coupling: float) -> None:
    """The free joint falls, nothing damps it and q_a does not push it: four closed forms."""
    mechanism = pair([[0.0, 0.0], [0.0, 0.3]], NO_DAMPING, coupling)
    side = -np.sign(coupling)
    surface = ut.Surface(-2, -1, side * 10, side * 20)
    margins = {m.name: m.value for m in ut.law.surface_margins(mechanism, surface)}
    sign = "" if coupling < 0 else "−"
    assert margins["(35) λ_a < 0 at α_a = −1"] == pytest.approx(0.5)
    assert margins[f"(35) {sign}α_u > 0 at α_a = −1"] == pytest.approx(5.0)
    assert margins[f"(35) {sign}λ_u > 0 at α_a = −1"] == pytest.approx(10.0)
    assert margins["(36) λ_a/α_a < λ_u/α_u"] == pytest.approx(2.0 - 0.5)
    assert float(stability_margin(mechanism, surface)) > 0
    flat = ut.law.surface_margins(mechanism, ut.Surface(-1, -1, 0, 1))
    assert {m.name: m.value for m in flat}["(36) λ_a/α_a < λ_u/α_u"] == -np.inf


@pytest.mark.parametrize(
    ("F", "D"),
    [
        ([[0.0, 0.0], [0.2, 0.3]], NO_DAMPING),  # q_a pushes the free joint
        ([[0.0, 0.0], [0.0, 0.3]], [[0.0, 0.0], [0.0, -0.1]]),  # damped
        ([[0.0, 0.0], [0.0, 0.3]], [[0.0, 0.0], [-0.1, 0.0]]),  # pushed by q̇_a
        ([[0.0, 0.0], [0.0, -0.3]], NO_DAMPING),  # it hangs
        ([[0.0, 0.0], [0.0, 0.0]], NO_DAMPING),  # nothing moves it
    ],
)
def test_35_and_36_are_not_given_where_the_paper_derives_none(
    F: list[list[float]], D: list[list[float]]
) -> None:
    margins = ut.law.surface_margins(pair(F, D), ut.Surface(-1, -0.5, 5, 10))
    assert [m.name.split(":")[0] for m in margins] == ["stability", "(37) singularity"]


def test_37_is_the_worst_of_the_positions_asked_for(rig: ut.Mechanism, base: ut.Surface) -> None:
    """det Γ(q)/det Γ(0) = (α_u b cos φ − c)/(α_u b − c): 1 at the target, less to either side."""
    b, c, _ = constants(rig)
    angles = np.array([0.1, -0.9, 0.4])
    positions = np.column_stack([np.zeros(3), angles])

    def margin(q: NDArray[Any] | None) -> float:
        return ut.law.surface_margins(rig, base, q)[-1].value

    assert margin(None) == pytest.approx(1.0)
    expected = (5 * b * np.cos(angles) - c) / (5 * b - c)
    assert margin(positions) == pytest.approx(expected.min(), rel=1e-12)
    assert margin(positions[2]) == pytest.approx(expected[2], rel=1e-12)
    with pytest.raises(InvalidInputError, match="surface for"):
        ut.law.surface_margins(rig, random_surface(3, 1, np.random.default_rng(0)))


def test_a_surface_that_is_exactly_singular_has_no_margin() -> None:
    """det Γ(0) = 0 in floating point too: −∞ for stability and for (37), alone and in a batch."""
    mechanism = pair([[0.0, 0.0], [0.0, 0.3]], NO_DAMPING)  # X = −1/2
    singular = ut.Surface(-1, -1, 2, 3)
    *_, stability, singularity = ut.law.surface_margins(mechanism, singular)
    assert stability.value == singularity.value == -np.inf
    vectors = np.stack([singular.vector, [0.0, -1, 2, 3], [-1.0, -1, 5, 10]])
    margins = stability_margin(mechanism, vectors)
    np.testing.assert_array_equal(margins[:2], -np.inf)
    assert margins[2] == stability_margin(mechanism, vectors[2]) > 0
    np.testing.assert_array_equal(stability_margin(mechanism, vectors[:2]), -np.inf)


@pytest.mark.parametrize(("n", "m"), SHAPES)
def test_margins_do_not_depend_on_the_units_of_s(n: int, m: int) -> None:
    """A surface whose entries are all small is as stable as it was, and as sound."""
    mechanism = random_mechanism(n, m, np.random.default_rng([n, m, 5]))
    surface = ut.first_surface(mechanism)
    small = ut.Surface.from_vector(1e-6 ** (1 / m) * surface.vector, n, m)
    margin = float(stability_margin(mechanism, surface))
    assert float(stability_margin(mechanism, small)) == pytest.approx(margin, rel=1e-6)
    ut.check_surface(mechanism, small, np.zeros(2 * n))


# -- refusals -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("surface", "what"),
    [
        (ut.Surface(-1, 0.5, 5, 10), r"\(35\) λ_a < 0"),
        (ut.Surface(-1, -0.5, -5, 10), r"\(35\) α_u > 0"),
        (ut.Surface(-1, -0.5, 5, -10), r"\(35\) λ_u > 0"),
        (ut.Surface(-1, -5, 5, 10), r"\(36\)"),
    ],
)
def test_surface_that_violates_35_or_36_is_refused(
    rig: ut.Mechanism, surface: ut.Surface, what: str
) -> None:
    """The message names the condition, the margin and the remedy."""
    with pytest.raises(UnstableSurfaceError, match=what) as caught:
        ut.check_surface(rig, surface)
    assert float(str(caught.value.value).split()[0]) < 0
    assert caught.value.limit == "> 0"
    assert caught.value.remedy


def test_surface_singular_at_the_target_is_refused(rig: ut.Mechanism) -> None:
    """α_u b = c makes α_a − α_u M_uu⁻¹ M_auᵀ vanish."""
    b, c, _ = constants(rig)
    with pytest.raises(SingularSurfaceError, match="at the target"):
        ut.check_surface(rig, ut.Surface(-1, -0.5, c / b, 10))


@pytest.mark.parametrize("case", CASES)
def test_condition_37_at_the_initial_state_is_tight(rig: ut.Mechanism, case: str) -> None:
    """Just inside arccos ε a surface passes, just outside it is refused."""
    b, c, _ = constants(rig)
    surface = CASES[case]
    edge = float(np.arccos(-surface.alpha_a[0, 0] * c / (surface.alpha_u[0, 0] * b)))
    ut.check_surface(rig, surface, rig.state(phi=edge - 1e-6))
    with pytest.raises(SingularSurfaceError, match="initial state") as caught:
        ut.check_surface(rig, surface, rig.state(phi=edge + 1e-6))
    assert "Start closer" in caught.value.remedy


def test_uncontrollable_linearisation_is_refused() -> None:
    """A free coordinate that no input reaches: the Hautus distance is zero, and said so."""
    a, b = ut.Coordinate("a"), ut.Coordinate("b")
    mechanism = ut.Mechanism(
        "two_rooms",
        (a, b),
        (ut.Input("u", "N m"),),
        sp.ImmutableDenseMatrix(sp.eye(2)),
        sp.ImmutableDenseMatrix([0, 3 * b.symbol]),
    )
    assert controllability(mechanism) < 1e-12
    with pytest.raises(ModelError, match="uncontrollable pair"):
        ut.first_surface(mechanism)


def test_poles_that_cannot_be_placed_are_refused(rig: ut.Mechanism) -> None:
    """No input reaches the free coordinate, or there are more equal poles than inputs."""
    a, b = ut.Coordinate("a"), ut.Coordinate("b")
    rooms = ut.Mechanism(
        "two_rooms",
        (a, b),
        (ut.Input("u", "N m"),),
        sp.ImmutableDenseMatrix(sp.eye(2)),
        sp.ImmutableDenseMatrix([0, 3 * b.symbol]),
    )
    with pytest.raises(ModelError, match="uncontrollable pair"):
        ut.placed_surface(rooms, [-1.0, -2.0, -3.0])
    with pytest.raises(InvalidInputError, match=r"each at most 1 times.*a little apart"):
        ut.placed_surface(rig, [-1.0, -1.0, -3.0])


def test_target_that_is_no_equilibrium_is_refused() -> None:
    """f_u(0, 0) ≠ 0 is named with its value."""
    a, b = ut.Coordinate("a"), ut.Coordinate("b")
    mechanism = ut.Mechanism(
        "tilted",
        (a, b),
        (ut.Input("u", "N m"),),
        sp.ImmutableDenseMatrix([[2, 1], [1, 2]]),
        sp.ImmutableDenseMatrix([0, sp.cos(b.symbol)]),
    )
    with pytest.raises(ModelError, match="equilibrium"):
        linearise(mechanism)


@pytest.mark.parametrize("rate", [-1.0, np.nan, np.inf])
def test_an_unusable_rate_is_refused(rig: ut.Mechanism, rate: float) -> None:
    with pytest.raises(InvalidInputError, match="convergence rate"):
        ut.first_surface(rig, rate=rate)


@pytest.mark.parametrize(
    "weights", [[1, 10, 0.1], [1, 10, 0.1, 0], [1, 10, 0.1, np.nan], [1, 10, 0.1, -1]]
)
def test_unusable_weights_are_refused(rig: ut.Mechanism, weights: list[float]) -> None:
    """Wrong length, zero, NaN and negative weights."""
    with pytest.raises(InvalidInputError, match="weights"):
        ut.first_surface(rig, weights)


@pytest.mark.parametrize("poles", [[-1, -2], [-1, -2, 0.5], [-1, -2, 0], [-1, -2, -3, -4]])
def test_unusable_poles_are_refused(rig: ut.Mechanism, poles: list[complex]) -> None:
    """Wrong number, or not left of the imaginary axis."""
    with pytest.raises(InvalidInputError, match="poles"):
        ut.placed_surface(rig, poles)


def twin_pendulums(*, coupled: bool = True, damping: float = 0.0) -> ut.Mechanism:
    """Two equal pendulums on a cart, which its force cannot tell apart; or one that none moves."""
    names = ("p", "r") if coupled else ("p",)
    x, *swings = ut.Coordinate("x", "m"), *(ut.Coordinate(name) for name in names)
    kinetic = 2 * x.velocity**2 + sum(0.05 * c.velocity**2 for c in swings)
    for c in swings if coupled else ():
        kinetic += 0.2 * sp.cos(c.symbol) * x.velocity * c.velocity
    potential = sum(sp.cos(c.symbol) for c in swings) * (1 if coupled else -1)
    drag = damping * sum(c.velocity**2 for c in swings) / 2
    return ut.Mechanism.from_energies(
        "twins", [x, *swings], [ut.Input("force", "N", 10.0)], kinetic, potential, dissipation=drag
    )


@pytest.mark.parametrize("coupled", [True, False])
def test_designs_say_that_no_linear_feedback_can_do_it(coupled: bool) -> None:
    """Not that α_a is singular, nor to start from the design that has just failed."""
    twins = twin_pendulums(coupled=coupled)
    poles = -1.0 - np.arange(2 * twins.n - 1)
    for design in (
        lambda: ut.first_surface(twins),
        lambda: ut.placed_surface(twins, poles.tolist()),
        lambda: ut.lqr(twins),
    ):
        with pytest.raises(ModelError, match="uncontrollable pair"):
            design()


def test_what_rests_by_itself_need_not_be_controllable() -> None:
    """A hanging pendulum with friction comes to rest whatever the cart does."""
    hanging = twin_pendulums(coupled=False, damping=0.05)
    assert controllability(hanging) < 1e-9
    assert ut.surface_margins(hanging, ut.first_surface(hanging))[-2].value > 0


def test_weights_that_no_riccati_equation_bears_are_refused(rig: ut.Mechanism) -> None:
    with pytest.raises(InvalidInputError, match=r"weights of the quadratic design.*is a design"):
        ut.first_surface(rig, [1e300] * 4)


def test_poles_are_finite(rig: ut.Mechanism) -> None:
    with pytest.raises(InvalidInputError, match="3 finite numbers"):
        ut.placed_surface(rig, [-1.0, -2.0, -math.inf])


def test_a_surface_shows_no_negative_zeros() -> None:
    assert repr(ut.Surface(-np.eye(2), -np.eye(2), [[-0.8], [-0.0]], [[3.4], [0.0]])) == (
        "Surface(alpha_a=[[-1.0, 0.0], [0.0, -1.0]], lambda_a=[[-1.0, 0.0], [0.0, -1.0]], "
        "alpha_u=[[-0.8], [0.0]], lambda_u=[[3.4], [0.0]])"
    )


def test_a_boundary_layer_is_as_thick_as_disturbances_ask_for() -> None:
    """The gains (13) of a tenth of the input: doubled until k/ε is below 2 per period, no more."""
    rig = ut.mechanisms.rotary_pendulum()
    assert usual_reaching(rig) == ut.ReachingLaw()
    rubbing = replace(rig, disturbance_bounds=(0.5, 0.0))
    surface = ut.first_surface(rubbing)
    for period in (0.002, 0.02):
        law = usual_reaching(rubbing, period=period)
        layer = float(np.max(law.layer))
        gain = gains_at_target(rubbing, surface.vector[None], np.array([[20.0]])).max()
        assert gain / layer * period < OVERSHOOTS <= gain / (layer / 2) * period
        assert ut.Cascade(rubbing, step=period, period=0.2).reaching == law
    own = ut.ReachingLaw(layer=0.3)
    assert ut.Cascade(rubbing, reaching=own).reaching is own
    with pytest.raises(InvalidInputError, match="period of the law"):
        usual_reaching(rubbing, period=0.0)


def test_what_is_given_no_law_takes_the_usual_one() -> None:
    """A loop, a certificate and the exported C began with a layer that friction makes too thin."""
    rubbing = replace(ut.mechanisms.rotary_pendulum(), disturbance_bounds=(0.5, 0.0))
    surface = ut.first_surface(rubbing)
    usual = usual_reaching(rubbing, surface)
    assert usual != ut.ReachingLaw()
    assert ut.ClosedLoop(rubbing).reaching == usual
    slow = ut.ClosedLoop(rubbing, step=0.005, zoh_steps=2)
    assert slow.reaching == usual_reaching(rubbing, period=0.01)
    assert ut.certify(rubbing, surface, seconds=0, x0=rubbing.state()).subjects[0].reaching == usual
    for period in (0.001, 0.004):
        law = EmbeddedController(rubbing, surface, period=period).reaching
        assert law == usual_reaching(rubbing, surface, period=period)
