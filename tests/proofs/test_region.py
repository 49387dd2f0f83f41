"""Proved regions on the surface: sound against simulation, tight, refused where they must be."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import sympy as sp

import undertow as ut
from undertow.base import InvalidInputError, UnstableSurfaceError
from undertow.law import SlidingModeLaw, sliding_matrix
from undertow.models import TIME
from undertow.proofs.claims.appendix import CASES, Constants
from undertow.proofs.claims.certificate import read_certificate
from undertow.proofs.claims.region import RegionClaim, reaches
from undertow.proofs.region.lyapunov import LyapunovFunction, extent, first_crossing
from undertow.proofs.region.motion import AutonomousSystem, SurfaceMotion, VectorField
from undertow.proofs.region.region import verify_region
from undertow.proofs.search.chart import natural_stretch
from undertow.proofs.search.linear_program import minimise_linear
from undertow.proofs.search.region import TIGHT, ProvedRegion, prove_region, search_region

pytest.importorskip("flint", reason="ball arithmetic is the extra undertow[certify]")

RIG = ut.mechanisms.rotary_pendulum()
MOTION = SurfaceMotion(RIG, ut.Surface(-1, -1.59, 1.96, 12.1))
CONSTANTS = Constants.of(RIG)
SQUARES = np.array([[2, 0, 0], [0, 2, 0], [0, 0, 2]])


@pytest.fixture(scope="module")
def ellipsoid() -> LyapunovFunction:
    """The quadratic V that the search starts from, a little inside."""
    return search_region(MOTION, (1, 0, 0), degrees=(), slow=False)[0].times(1.03)


def steps(motion: AutonomousSystem, y: np.ndarray, seconds: float, h: float) -> np.ndarray:
    """RK4 states (K, B, N) of a batch on the surface."""
    path = [y]
    for _ in range(round(seconds / h)):
        a = motion(y)
        b = motion(y + 0.5 * h * a)
        c = motion(y + 0.5 * h * b)
        d = motion(y + h * c)
        y = y + h / 6 * (a + 2 * b + 2 * c + d)
        path.append(y)
    return np.array(path)


def inside(V: LyapunovFunction, count: int, seed: int) -> np.ndarray:
    """Points of {V ≤ 1}, half of them on its boundary."""
    rng = np.random.default_rng(seed)
    rays = rng.normal(size=(count, V.exponents.shape[1]))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    part = np.where(rng.random(count) < 0.5, 0.9999, rng.random(count))
    return V.points(rays * (first_crossing(V, rays) * part)[:, None])


def test_the_motion_is_the_mechanisms_on_its_surface() -> None:
    """ẏ equals what the plant does under the unsaturated law with s = 0."""
    surface, mechanism = MOTION.surface, RIG
    law = SlidingModeLaw(mechanism, surface)
    rng = np.random.default_rng(0)
    ratio = float(surface.lambda_u[0, 0] / surface.lambda_a[0, 0])
    for phi, phi_dot, w in rng.uniform(-0.6, 0.6, (20, 3)):
        theta = w - ratio * phi
        theta_dot = -float(
            (surface.lambda_a[0, 0] * w + surface.alpha_u[0, 0] * phi_dot) / surface.alpha_a[0, 0]
        )
        x = np.array([theta, phi, theta_dot, phi_dot])
        qdd = mechanism.accelerations(0.0, x, law(0.0, x).demand)
        expected = [phi_dot, qdd[1], theta_dot + ratio * phi_dot]
        assert MOTION([phi, phi_dot, w]) == pytest.approx(expected, rel=1e-8, abs=1e-8)


def test_its_linearisation_has_the_sliding_eigenvalues() -> None:
    """For another size too, (3, 1): the same spectrum as the sliding matrix."""
    q = [ut.Coordinate(name) for name in ("a", "b", "c")]
    _, b, c = (k.symbol for k in q)
    mechanism = ut.Mechanism(
        "chain", tuple(q), (ut.Input("u", "N m"),),
        sp.ImmutableDenseMatrix([
            [3, sp.cos(b), sp.cos(c) / 2],
            [sp.cos(b), 2, sp.cos(b - c) / 3],
            [sp.cos(c) / 2, sp.cos(b - c) / 3, 1],
        ]),
        sp.ImmutableDenseMatrix([0, 9 * sp.sin(b), 4 * sp.sin(c)]),
    )  # fmt: skip
    surface = ut.first_surface(mechanism)
    motion = SurfaceMotion(mechanism, surface)
    h = 1e-6 * np.eye(5)
    A = (motion(h) - motion(-h)).T / 2e-6
    assert np.sort_complex(np.linalg.eigvals(A)) == pytest.approx(
        np.sort_complex(np.linalg.eigvals(sliding_matrix(mechanism, surface))), rel=1e-6, abs=1e-6
    )


def test_an_ellipsoid_is_proved_and_no_trajectory_leaves(ellipsoid: LyapunovFunction) -> None:
    """Proved; then 2000 motions started inside keep V decreasing and converge."""
    verdict = verify_region(MOTION, ellipsoid)
    assert verdict.kind == "proved"
    y = inside(ellipsoid, 2000, seed=3)
    path = steps(MOTION, y, seconds=3.0, h=0.006)
    values = ellipsoid(path)
    assert values.max() <= 1.0
    assert (np.diff(values[:50], axis=0) < 1e-9).all()
    assert values[-1].max() < 1e-6


def test_a_raised_level_is_refuted_with_a_witness(ellipsoid: LyapunovFunction) -> None:
    """A few per cent more, and the checker names a point where V grows."""
    verdict = verify_region(MOTION, ellipsoid.times(0.85))
    assert verdict.kind == "refuted"
    y = np.array(list(verdict.witness.values()))
    assert ellipsoid(y) <= 1 / 0.85
    step = 1e-6 * MOTION(y)
    assert ellipsoid(y + step) > ellipsoid(y - step)


def test_stretched_coordinates_are_inverted_and_their_rates_are_derivatives() -> None:
    """points(coordinates(y)) = y up to 95 % of the pole; ż by central differences."""
    stretch = natural_stretch(MOTION, slow=True)
    assert stretch is not None
    S, pole = stretch
    V = LyapunovFunction(np.diag([0.3, 2.0, 4.0]), SQUARES, np.ones(3), S, pole)
    y = np.random.default_rng(1).uniform(-0.95, 0.95, (200, 3)) * [pole, 5.0, 5.0]
    assert V.points(V.coordinates(y)) == pytest.approx(y, rel=1e-9, abs=1e-9)
    y_dot = MOTION(y)
    h = 1e-7
    slope = (V.coordinates(y + h * y_dot) - V.coordinates(y - h * y_dot)) / (2 * h)
    rates = V.coordinate_rates(y, y_dot)
    assert slope == pytest.approx(rates, rel=1e-4, abs=1e-4 * np.abs(rates).max())
    assert np.isinf(V([pole, 0.0, 0.0]))
    assert pole == pytest.approx(CASES[3].reduced(CONSTANTS).limit, rel=1e-6)


def test_parts_of_a_level_set_elsewhere_are_not_counted() -> None:
    """V = x² − x⁴/5 is ≤ 1 again beyond |x| = 1.9: the proof is about |x| ≤ 1.18 alone."""
    x = sp.Symbol("x", real=True)
    V = LyapunovFunction(np.eye(1), np.array([[2], [4]]), np.array([1.0, -0.2]))
    motion = VectorField((x,), (-x,))
    verdict = verify_region(motion, V)
    assert verdict.kind == "proved"
    region = ProvedRegion(motion, np.eye(1)[0], (V,), verdict, 1.1, verdict)
    points = np.array([[0.0], [1.17], [1.19], [2.0], [-3.0]])
    assert (V(points) <= 1.0).tolist() == [True, True, False, True, True]
    assert (region.level(points) <= 1.0).tolist() == [True, True, False, False, False]


def test_coordinates_of_very_different_sizes_have_a_first_set() -> None:
    """The reaction wheel turns some thousand times as fast as its pendulum: balanced units."""
    wheel = ut.mechanisms.reaction_wheel_pendulum()
    motion = SurfaceMotion(wheel, ut.first_surface(wheel))
    V = search_region(motion, (1, 0, 0), degrees=(), start="balanced")[0].times(1.1)
    assert verify_region(motion, V).kind == "proved"
    assert reaches(V, [0.5, 0.0, 0.0])


def test_a_level_set_that_crosses_the_singularity_is_not_proved() -> None:
    """Locally fine, but {V ≤ 1} reaches past arccos ε."""
    verdict = verify_region(
        MOTION, LyapunovFunction(np.diag([1.1, 5.0, 8.0]), SQUARES, np.ones(3)), max_seconds=20
    )
    assert verdict.kind in ("refuted", "undecided")


def test_an_unbounded_level_set_is_not_proved() -> None:
    """V that falls again far along w, and V without w: no box holds {V ≤ 1}."""
    falling = np.vstack([SQUARES, [0, 0, 4]])
    V = LyapunovFunction(np.eye(3) * 0.1, falling, np.array([1.0, 1.0, 1.0, -0.5]))
    verdict = verify_region(MOTION, V)
    assert verdict.kind == "undecided"
    assert "no box" in verdict.method or "boundary of the box" in verdict.method
    flat = LyapunovFunction(np.eye(3) * 0.1, SQUARES[:2], np.ones(2))
    assert verify_region(MOTION, flat).kind == "undecided"


def test_a_known_region_is_found_to_its_edge() -> None:
    """ẋ = −x + x³ in each direction: {x² < 1} is the region; 2 % more is refuted.

    The surface motion of a mechanism made for it: with E = 1 and λ_a = α_a the angle's own
    motion is b̈ = −2ḃ − b + (ḃ + b)³, so v = ḃ + b obeys v̇ = −v + v³.
    """
    a, b = ut.Coordinate("a"), ut.Coordinate("b")
    v = b.velocity + b.symbol
    # M_au = 0 keeps the surface out of b's equation: f_u is the motion.
    mechanism = ut.Mechanism(
        "cubic", (a, b), (ut.Input("u", "N m"),), sp.ImmutableDenseMatrix([[1, 0], [0, 1]]),
        sp.ImmutableDenseMatrix([0, -2 * b.velocity - b.symbol + v**3]),
    )  # fmt: skip
    motion = SurfaceMotion(mechanism, ut.Surface(1, 1, 0, 0))

    def cylinder(radius: float) -> LyapunovFunction:
        # y = (b, ḃ, w); V = (v/radius)² + (b/10)² + (w/10)², whose V̇ < 0 iff |v| < 1.
        inverse = np.array([[1 / radius, 1 / radius, 0], [0.1, 0, 0], [0, 0, 0.1]])
        return LyapunovFunction(np.linalg.inv(inverse), SQUARES, np.ones(3))

    assert verify_region(motion, cylinder(0.98)).kind == "proved"
    assert verify_region(motion, cylinder(1.02)).kind == "refuted"


@pytest.mark.parametrize(("radius", "kind"), [(0.98, "proved"), (1.02, "refuted")])
def test_a_plain_vector_field_with_a_known_region(radius: float, kind: str) -> None:
    """ẋ = −x + x³ from its expression: V = (x/r)² serves iff r ≤ 1."""
    x = sp.Symbol("x", real=True)
    motion = VectorField((x,), (-x + x**3,))
    V = LyapunovFunction(np.array([[radius]]), np.array([[2]]), np.ones(1))
    verdict = verify_region(motion, V)
    assert verdict.kind == kind
    if kind == "refuted":
        assert 1.0 < abs(verdict.witness["x"]) <= radius


def test_a_chain_of_different_stretches_is_not_proved() -> None:
    """Beyond the pole of the inner function its formula is small again, and means nothing.

    ẋ = −x + x³/9 has the region |x| < 3; (x/5)² would pass if all that looks inside were.
    """
    x = sp.Symbol("x", real=True)
    motion = VectorField((x,), (-x + x**3 / 9,))
    square, one = np.array([[2]]), np.ones(1)
    inner = LyapunovFunction(np.eye(1), square, one, stretch=np.ones((1, 1, 1)), pole=1.0)
    wide = LyapunovFunction(np.array([[5.0]]), square, one)
    assert verify_region(motion, inner)
    other = LyapunovFunction(np.eye(1), square, one, stretch=np.ones((1, 1, 1)), pole=2.0)
    for outer in (wide, other):
        verdict = verify_region(motion, [inner, outer])
        assert verdict.kind == "undecided"
        assert "different stretches" in verdict.method


@pytest.mark.parametrize("inner", [None, 0.5])
def test_branch_and_bound_alone_proves_no_set_that_is_too_large(
    monkeypatch: pytest.MonkeyPatch, inner: float | None
) -> None:
    """The largest ellipse in which V falls, found on a grid; without the samples that refute.

    A little inside it is proved, as a first function and as one around another.
    """
    monkeypatch.setattr("undertow.proofs.region.region._Proof._sampled_witness", lambda _: None)
    x, y = sp.symbols("x y", real=True)
    motion = VectorField((x, y), (-y, x - (1 - x**2) * y))
    T = np.array([[1.0, 0.0], [0.6, 0.9]])
    unit = LyapunovFunction(T, np.array([[2, 0], [0, 2]]), np.ones(2))
    angle = np.linspace(0.0, np.pi, 2001)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)

    def falls(r: float) -> bool:
        points = unit.points(r * circle)
        return bool((np.sum(circle * unit.coordinate_rates(points, motion(points)), 1) < 0).all())

    radius = next(r for r in np.arange(0.5, 3.0, 2e-3) if not falls(r))
    best = unit.times(1 / radius**2)
    chain = [] if inner is None else [best.times(1 / inner**2)]
    assert verify_region(motion, [*chain, best.times(1.01)]).kind == "proved"
    for level in (1.002, 1.1):
        verdict = verify_region(motion, [*chain, best.times(1 / level)], proved=len(chain))
        assert verdict.kind in ("refuted", "undecided")
        assert set(verdict.witness) == {"x", "y"}


def test_a_set_with_a_ring_inside_that_motions_cannot_cross_is_not_proved(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """ẋ = −x (x² − 0.3)(x² − 0.6): V = x² falls near 0 and on {V = 1}, not in between.

    Only a set inside that holds the ring would do.
    """
    monkeypatch.setattr("undertow.proofs.region.region._Proof._sampled_witness", lambda _: None)
    x = sp.Symbol("x", real=True)
    third, half = sp.Rational(3, 10), sp.Rational(6, 10)
    motion = VectorField((x,), (-x * (x**2 - third) * (x**2 - half),))
    V = LyapunovFunction(np.eye(1), np.array([[2]]), np.ones(1))
    for chain in ([V], [V.times(1 / 0.29), V]):
        verdict = verify_region(motion, chain)
        assert verdict.kind in ("refuted", "undecided")
        assert 0.3 < verdict.witness["x"] ** 2 < 0.6
    assert verify_region(motion, [V.times(1 / 0.61), V], proved=1).kind == "proved"


@pytest.mark.slow
def test_the_reversed_van_der_pol_region_stays_inside_its_limit_cycle() -> None:
    """ẋ = −y, ẏ = x − (1 − x²) y: a proved chain, converging, no larger than the true region.

    Each function serves with those inside it alone, and the last level is as high as it can be.
    """
    x, y = sp.symbols("x y", real=True)
    motion = VectorField((x, y), (-y, x - (1 - x**2) * y))
    found = prove_region(motion, (1, 0), degrees=(4,), programs=30, goal=1.5)
    *inner, last = found.chain
    assert inner
    assert last([found.extent, 0.0]) <= 1.0
    assert 1.4 < found.extent < 2.009  # where the limit cycle crosses y = 0
    path = steps(motion, inside(last, 2000, seed=5), seconds=12.0, h=0.02)
    assert np.min([V(path) for V in found.chain], axis=0).max() <= 1.0
    assert last(path[-1]).max() < 1e-2
    assert found.raised.kind == "refuted"
    point = np.array(list(found.raised.witness.values()))
    assert inner[-1](point) > 1.0
    assert 1.0 < last(point) <= TIGHT
    step = 1e-6 * motion(point)
    assert last(point + step) > last(point - step)
    with pytest.raises(InvalidInputError, match="empty"):
        verify_region(motion, [])


def test_a_vector_field_must_be_closed_and_at_rest() -> None:
    """A stray symbol is refused; a target that is no equilibrium is never proved."""
    x, k = sp.symbols("x k", real=True)
    with pytest.raises(InvalidInputError, match="k"):
        VectorField((x,), (-k * x,))
    V = LyapunovFunction(np.eye(1), np.array([[2]]), np.ones(1))
    verdict = verify_region(VectorField((x,), (-x + sp.Rational(1, 100),)), V)
    assert verdict.kind == "undecided"
    assert "f(0) = 0" in verdict.method


def test_a_repeated_zero_eigenvalue_is_never_proved() -> None:
    """Without gravity or coupling q̈_u = 0: no search, and no function passes."""
    a, b = ut.Coordinate("a"), ut.Coordinate("b")
    mechanism = ut.Mechanism(
        "free", (a, b), (ut.Input("u", "N m"),), sp.ImmutableDenseMatrix([[1, 0], [0, 1]]),
        sp.ImmutableDenseMatrix([0, 0]),
    )  # fmt: skip
    motion = SurfaceMotion(mechanism, ut.Surface(1, 1, 0, 0))
    assert np.sum(np.abs(np.linalg.eigvals(motion.jacobian)) < 1e-9) == 2
    with pytest.raises(UnstableSurfaceError):
        search_region(motion, (1, 0, 0), programs=1)
    verdict = verify_region(motion, LyapunovFunction(np.eye(3), SQUARES, np.ones(3)))
    assert verdict.kind == "undecided"
    assert "not negative definite" in verdict.method


def test_another_plant_in_a_parameter_box(ellipsoid: LyapunovFunction) -> None:
    """±0.5 % in the mass's lever r_o is proved for a smaller set; ±30 % is not."""
    smaller = ellipsoid.times(1.5)
    assert verify_region(MOTION, smaller, parameters={"r_o": (0.2145, 0.2155)})
    assert not verify_region(MOTION, smaller, parameters={"r_o": (0.15, 0.28)}, max_boxes=20_000)
    with pytest.raises(InvalidInputError, match="parameter box"):
        verify_region(MOTION, smaller, parameters={"nothing": (0.0, 1.0)})


def test_effort_runs_out_honestly(ellipsoid: LyapunovFunction) -> None:
    """Too few boxes: undecided, and where."""
    verdict = verify_region(MOTION, ellipsoid, max_boxes=50, chunk=32)
    assert verdict.kind == "undecided"
    assert set(verdict.witness) == {"phi", "phi_dot", "w_theta"}


def test_functions_that_cannot_be_lyapunov_functions_are_refused() -> None:
    """Odd or constant monomials, and a surface that is not stable."""
    for exponents in ([[1, 0, 0]], [[0, 0, 0]], [[1, 2, 0]]):
        with pytest.raises(InvalidInputError, match="even sum"):
            LyapunovFunction(np.eye(3), np.array(exponents), np.ones(1))
    unstable = SurfaceMotion(RIG, ut.Surface(-1, -8.0, 1.96, 12.1))
    with pytest.raises(UnstableSurfaceError):
        search_region(unstable, (1, 0, 0), programs=1)


def test_a_dead_actuated_coordinate_is_refused() -> None:
    """λ_a = 0: w does not exist and θ would not converge."""
    with pytest.raises(InvalidInputError, match="λ_a"):
        SurfaceMotion(RIG, ut.Surface(-1, 0.0, 5, 10))


def test_a_time_dependent_force_is_refused() -> None:
    """A proof for the autonomous motion says nothing about a driven one."""
    plant = RIG.disturbed({"phi": 0.01 * sp.sin(TIME)})
    with pytest.raises(InvalidInputError, match="time"):
        SurfaceMotion(plant, MOTION.surface)


def test_the_linear_program_reaches_a_known_optimum() -> None:
    """Max x + 2y on a triangle: the corner; and an empty set gives None."""
    A = np.array([[1.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
    x = minimise_linear(np.array([-1.0, -2.0]), A, np.array([1.0, 0.0, 0.0]))
    assert x == pytest.approx([0.0, 1.0], abs=1e-6)
    empty = minimise_linear(np.array([1.0]), np.array([[1.0], [-1.0]]), np.array([-1.0, -1.0]))
    assert empty is None


REGIONS = Path(__file__).parents[1] / "data" / "regions.json"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("case", "target"), [(1, 0.75), (2, 0.88), (3, 0.95), (4, 0.75), (5, 0.65)]
)
def test_the_five_cases_reach_their_targets(case: int, target: float) -> None:
    """The kept functions are proved, from rest at the asked angle on; a level 5 % up is not.

    Then 20,000 motions, half of them from the boundary, stay inside and converge.
    """
    subject = read_certificate(REGIONS).subjects[case - 1]
    assert subject.surface == CASES[case - 1].surface
    motion = SurfaceMotion(RIG, subject.surface)
    chain = RegionClaim.from_dict(subject.claims[0].data).functions
    verdict = verify_region(motion, chain)
    assert verdict.kind == "proved"
    *inner, V = chain
    far = 0.9999 * extent(V, [1.0, 0.0, 0.0])
    assert far > target
    assert reaches(V, [far, 0.0, 0.0])
    assert not reaches(V, [1.001 * far, 0.0, 0.0])
    raised = verify_region(motion, [*inner, V.times(1 / 1.05)], proved=len(inner))
    assert raised.kind in ("refuted", "undecided")
    assert set(raised.witness) == {"phi", "phi_dot", "w_theta"}
    y = inside(V, 20_000, seed=case)
    slowest = -1 / np.linalg.eigvals(motion.jacobian).real.max()
    fine = 50 * [(0.002, 2e-4)] + 90 * [(0.01, 1e-3)]  # the first second holds what is fast
    for seconds, h in fine + math.ceil(12.0 * slowest / 0.2) * [(0.2, 0.01)]:
        y = steps(motion, y, seconds, h)[-1]
        outside = np.ones(len(y), dtype=bool)
        for U in reversed(chain):
            outside[outside] = U(y[outside]) > 1.0
        assert not outside.any()
        y = y[chain[0](y) > 0.05]  # the others are deep in the innermost set
        if not len(y):
            break
    assert not len(y)
