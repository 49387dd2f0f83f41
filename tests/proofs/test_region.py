"""Proved regions on the surface: sound against simulation, tight, refused where they must be."""

from __future__ import annotations

import math
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sympy as sp

import undertow as ut
from undertow.base import InvalidInputError, UnstableSurfaceError
from undertow.law import SlidingModeLaw, sliding_matrix
from undertow.models import TIME
from undertow.proofs.claims.region import reaches, verify_region
from undertow.proofs.claims.words import sentence
from undertow.proofs.claims.written import claim_data
from undertow.proofs.kernel import compiled as ops
from undertow.proofs.kernel.claims import SurfaceRegion, decide, read_claim
from undertow.proofs.kernel.graph import Graph
from undertow.proofs.kernel.model import Law, Model
from undertow.proofs.kernel.reader import Refused, read
from undertow.proofs.kernel.region import Function, Stage, on_the_line
from undertow.proofs.region.lyapunov import LyapunovFunction, first_crossing
from undertow.proofs.region.motion import SurfaceMotion
from undertow.proofs.search.chart import natural_stretch
from undertow.proofs.search.linear_program import minimise_linear
from undertow.proofs.search.region import search_region
from undertow.studies.paper.appendix import CASES, Constants

RIG = ut.mechanisms.rotary_pendulum()
MOTION = SurfaceMotion(RIG, ut.Surface(-1, -1.59, 1.96, 12.1))
CONSTANTS = Constants.of(RIG)
SQUARES = np.array([[2, 0, 0], [0, 2, 0], [0, 0, 2]])


@pytest.fixture(scope="module")
def ellipsoid() -> LyapunovFunction:
    """The quadratic V that the search starts from, a little inside."""
    return search_region(MOTION, (1, 0, 0), degrees=(), slow=False)[0].times(1.03)


def steps(motion: SurfaceMotion, y: np.ndarray, seconds: float, h: float) -> np.ndarray:
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
    """Proved; then 500 motions started inside keep V decreasing and converge."""
    verdict = verify_region(MOTION, ellipsoid)
    assert verdict.kind == "proved"
    y = inside(ellipsoid, 500, seed=3)
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


def test_coordinates_of_very_different_sizes_have_a_first_set() -> None:
    """The reaction wheel turns some thousand times as fast as its pendulum: balanced units."""
    wheel = ut.mechanisms.reaction_wheel_pendulum()
    motion = SurfaceMotion(wheel, ut.first_surface(wheel))
    V = search_region(motion, (1, 0, 0), degrees=(), start="balanced")[0].times(1.1)
    assert verify_region(motion, V).kind == "proved"
    assert reaches(V, [0.5, 0.0, 0.0])


def test_a_level_set_that_crosses_the_singularity_is_not_proved() -> None:
    """Locally fine, but {V ≤ 1} reaches past arccos ε."""
    verdict = verify_region(MOTION, LyapunovFunction(np.diag([1.1, 5.0, 8.0]), SQUARES, np.ones(3)))
    assert verdict.kind in ("refuted", "undecided")


def test_an_unbounded_level_set_is_not_proved() -> None:
    """V that falls again far along w, and V without w: no box holds {V ≤ 1}."""
    falling = np.vstack([SQUARES, [0, 0, 4]])
    V = LyapunovFunction(np.eye(3) * 0.1, falling, np.array([1.0, 1.0, 1.0, -0.5]))
    verdict = verify_region(MOTION, V)
    assert verdict.kind == "undecided"
    assert "no ellipsoid" in verdict.method
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


def alone(acceleration: sp.Expr, *more: ut.Parameter) -> SurfaceMotion:
    """b̈ = acceleration(b, ḃ) and ẇ = −w: M_au = 0 keeps the surface out of b's equation."""
    mechanism = ut.Mechanism(
        "alone", (ut.Coordinate("a"), B), (ut.Input("u", "N m"),),
        sp.ImmutableDenseMatrix([[1, 0], [0, 1]]), sp.ImmutableDenseMatrix([0, acceleration]),
        parameters=more,
    )  # fmt: skip
    return SurfaceMotion(mechanism, ut.Surface(1, 1, 0, 0))


B = ut.Coordinate("b")


@pytest.mark.parametrize("inner", [None, 0.5])
def test_no_set_that_is_too_large_is_proved(inner: float | None) -> None:
    """ẍ = −x − (1 − x²) ẋ: the largest ellipse in which V falls, found on a grid.

    A little inside it is proved, as a first function and as one around another.
    """
    x, v = B.symbol, B.velocity
    motion = alone(-x - (1 - x**2) * v)
    T = np.array([[1.0, 0.0, 0.0], [-0.6, 0.9, 0.0], [0.0, 0.0, 1.0]])
    unit = LyapunovFunction(T, SQUARES, np.ones(3))
    angle = np.linspace(0.0, np.pi, 2001)
    circle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)

    def falls(r: float) -> bool:
        points = unit.points(r * circle)
        return bool((np.sum(circle * unit.coordinate_rates(points, motion(points)), 1) < 0).all())

    radius = next(r for r in np.arange(0.5, 3.0, 2e-3) if not falls(r))
    best = unit.times(1 / radius**2)
    chain = [] if inner is None else [best.times(1 / inner**2)]
    assert verify_region(motion, [*chain, best.times(1.02)]).kind == "proved"
    for level in (1.005, 1.1):
        verdict = verify_region(motion, [*chain, best.times(1 / level)], proved=len(chain))
        assert verdict.kind in ("refuted", "undecided")
        assert {"b", "b_dot"} < set(verdict.witness)


def test_a_ring_inside_that_motions_cannot_cross_is_not_proved() -> None:
    """v = ḃ + b obeys v̇ = −v (v² − 0.3)(v² − 0.6): only a set inside that holds the ring serves."""
    v = B.velocity + B.symbol
    motion = alone(-B.velocity - v * (v**2 - sp.Rational(3, 10)) * (v**2 - sp.Rational(6, 10)))
    inverse = np.array([[1.0, 1.0, 0], [0.05, 0, 0], [0, 0, 0.05]])
    V = LyapunovFunction(np.linalg.inv(inverse), SQUARES, np.ones(3))
    for chain in ([V], [V.times(1 / 0.29), V]):
        verdict = verify_region(motion, chain, max_boxes=50_000)
        assert verdict.kind == "refuted"
        y = np.array([verdict.witness[name] for name in ("b", "b_dot", "w_a")])
        assert V(y) <= 1
        assert len(chain) == 1 or chain[0](y) > 1
        assert V(y + 1e-6 * motion(y)) > V(y)
    assert verify_region(motion, [V.times(1 / 0.61), V], proved=1).kind == "proved"


def test_a_target_that_is_not_at_rest_and_different_stretches_are_not_proved(
    ellipsoid: LyapunovFunction,
) -> None:
    """F(0) = 0 is exact; beyond the pole of an inner function its formula means nothing."""
    motion = alone(-B.symbol - B.velocity + sp.Rational(1, 10**9))
    V = LyapunovFunction(np.diag([0.1, 0.1, 0.1]), SQUARES, np.ones(3))
    assert "F(0) = 0" in verify_region(motion, V).method
    S = np.zeros((1, 3, 3))
    bent = LyapunovFunction(ellipsoid.scale, SQUARES, np.ones(3), S, 2.0)
    verdict = verify_region(MOTION, [bent, ellipsoid], proved=1)
    assert verdict.kind == "undecided"
    assert "different stretches" in verdict.method
    with pytest.raises(InvalidInputError, match="empty"):
        verify_region(MOTION, [])


@pytest.mark.parametrize("ends", [(0.2, 0.1), (math.nan, 0.1), (0.1, math.inf)])
def test_what_is_no_interval_of_a_parameter_is_refused(
    ellipsoid: LyapunovFunction, ends: tuple[float, float]
) -> None:
    with pytest.raises(InvalidInputError, match=r"box of 'm'.*must be finite, low ≤ high"):
        verify_region(MOTION, ellipsoid, parameters={"m": ends})


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
    assert "not shown negative definite" in verdict.method


def test_another_plant_in_a_parameter_box(ellipsoid: LyapunovFunction) -> None:
    """±0.5 % in the mass's lever r_o is proved for a smaller set; ±30 % is not."""
    smaller = ellipsoid.times(1.5)
    assert verify_region(MOTION, smaller, parameters={"r_o": (0.2145, 0.2155)})
    assert not verify_region(MOTION, smaller, parameters={"r_o": (0.15, 0.28)}, max_boxes=20_000)
    with pytest.raises(InvalidInputError, match="parameter box"):
        verify_region(MOTION, smaller, parameters={"nothing": (0.0, 1.0)})


def test_effort_runs_out_honestly(ellipsoid: LyapunovFunction) -> None:
    """Too few boxes: undecided, and where."""
    verdict = verify_region(MOTION, ellipsoid, max_boxes=50)
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


def test_a_surface_of_another_size_is_refused() -> None:
    with pytest.raises(InvalidInputError, match=r"surface for 'rotary_pendulum'.*n = 3, m = 2"):
        SurfaceMotion(RIG, ut.first_surface(ut.mechanisms.two_motor_three_link()))


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


def kept(case: int) -> tuple[Model, Law, SurfaceRegion]:
    """A kept region, from the file alone."""
    document = read(REGIONS.read_bytes())
    subject = document.subjects[case - 1]
    claim = read_claim(subject.claims[0], document.model)
    assert isinstance(claim, SurfaceRegion)
    return document.model, subject.law, claim


def polynomial(claim: SurfaceRegion, V: Function) -> LyapunovFunction:
    """A function of the kernel in floats."""
    S = np.array(claim.stretch.S, dtype=float)
    A, coefficients = np.array(V.A, dtype=float), np.array(V.coefficients, dtype=float)
    pole = float(claim.stretch.L or 1)
    return LyapunovFunction(np.linalg.inv(A), np.array(V.exponents), coefficients, S, pole)


def up(claim: SurfaceRegion, level: float) -> Function:
    """The last function with a higher level, in a wider guard."""
    V, wide = claim.functions[-1], Fraction(level)
    G = tuple(tuple(v / wide for v in row) for row in V.G)
    return replace(V, G=G, coefficients=tuple(c / wide for c in V.coefficients))


def first_two(case: int) -> tuple[Model, Law, SurfaceRegion]:
    model, law, claim = kept(case)
    short = (claim.contains[0] / 50, *claim.contains[1:])
    return model, law, replace(claim, functions=claim.functions[:2], contains=short)


def test_the_graphs_of_a_stage_are_the_motion_and_its_function() -> None:
    """V, V̇, |G c|² and the pivots at points, against float64; V is even, so is what is decided."""
    model, law, claim = kept(4)
    stage = Stage(model, law, claim.stretch, claim.functions[1], claim.functions[0], {})
    assert stage.even
    V, inner = polynomial(claim, claim.functions[1]), polynomial(claim, claim.functions[0])
    motion = SurfaceMotion(RIG, CASES[3].surface)
    rng = np.random.default_rng(0)
    for x in rng.uniform(-1.0, 1.0, (20, 3)) * [float(v) for v in stage.sides]:
        values, y = stage.program(ops.between(x, x))[:, 0], stage.y(ops.between(x, x))[:, 0].real
        z, z_dot = V.coordinates(y), V.coordinate_rates(y, motion(y))
        h = 1e-6
        slope = (V.monomials(z + h * z_dot) - V.monomials(z - h * z_dot)) @ V.coefficients / (2 * h)
        expected = [slope, float(V(y)), float(inner(y))]
        assert values[:3].real == pytest.approx(expected, rel=1e-6)
        assert (values.imag - values.real < 1e-9 * (1 + abs(slope))).all()
        assert (values[-2:].real > 0).all()


@pytest.mark.parametrize("width", [0.0, 1e-12, 1e-3, 0.3])
def test_models_of_thin_and_wide_boxes_hold_their_functions(width: float) -> None:
    """All operations at points of boxes, against 50 digits; on thin ones nothing hides an error."""
    mpmath = pytest.importorskip("mpmath")
    graph = Graph(2)
    x, y = graph.inputs
    make, number = graph.make, graph.number
    product = make("mul", x, y)
    nodes = [
        make("sin", make("add", x, product)), make("cos", make("sub", y, x)), make("exp", product),
        make("log", make("add", number(3), x)), make("sqrt", make("add", number(2), y)),
        make("div", x, make("add", number(3), product)), graph.power(make("sin", x), 5),
        make("mul", number(Fraction(1, 3)), make("neg", graph.power(y, 3))),
        make("div", y, number(7)),
    ]  # fmt: skip
    f: list[Any] = [
        lambda u, v: mpmath.sin(u + u * v), lambda u, v: mpmath.cos(v - u),
        lambda u, v: mpmath.exp(u * v), lambda u, v: mpmath.log(3 + u),
        lambda u, v: mpmath.sqrt(2 + v), lambda u, v: u / (3 + u * v),
        lambda u, v: mpmath.sin(u) ** 5, lambda u, v: -(v**3) / 3, lambda u, v: v / 7,
    ]  # fmt: skip
    program = graph.program(nodes)
    rng = np.random.default_rng(1)
    low = rng.uniform(-1.0, 1.0, (2, 200))
    high = low + width
    found = ops.models(program.code, program.constants, program.outputs, low, high)
    ends, _ = ops.ranges(found, 2)
    with mpmath.workdps(50):
        for box in range(200):
            for t, s in ((0.0, 0.0), (1.0, 0.0), (0.5, 0.5), (1.0, 1.0), (0.25, 0.9)):
                u = low[0, box] + t * (high[0, box] - low[0, box])
                v = low[1, box] + s * (high[1, box] - low[1, box])
                u, v = min(u, high[0, box]), min(v, high[1, box])
                for o, function in enumerate(f):
                    value = function(mpmath.mpf(u), mpmath.mpf(v))
                    assert ends[box, o].real <= value <= ends[box, o].imag
    assert (ends.imag - ends.real).max() < 1e-12 + 20 * width  # and hardly more


def test_models_hold_functions_of_what_no_parabola_follows() -> None:
    """All of a cube on [−1, 1] is error of its model: its square counts where slopes are zero."""
    mpmath = pytest.importorskip("mpmath")
    graph = Graph(1)
    make, cube = graph.make, graph.power(graph.inputs[0], 3)
    shifted = make("add", graph.number(2), cube)
    nodes = [make("cos", cube), make("sin", cube), make("exp", cube), make("log", shifted),
             make("sqrt", shifted), make("div", graph.number(1), shifted)]  # fmt: skip
    f: list[Any] = [
        mpmath.cos, mpmath.sin, mpmath.exp, lambda u: mpmath.log(2 + u),
        lambda u: mpmath.sqrt(2 + u), lambda u: 1 / (2 + u),
    ]  # fmt: skip
    program = graph.program(nodes)
    for wide in (0.1, 0.5, 1.0):
        low, high = np.array([[-wide]]), np.array([[wide]])
        found = ops.models(program.code, program.constants, program.outputs, low, high)
        ends, _ = ops.ranges(found, 1)
        for o, function in enumerate(f):
            for x in np.linspace(-wide, wide, 21):
                assert ends[0, o].real <= function(mpmath.mpf(x) ** 3) <= ends[0, o].imag


def test_what_is_undefined_on_a_box_has_no_model() -> None:
    """1/0, √−1, log 0 and kinks prove nothing."""
    graph = Graph(1)
    x = graph.inputs[0]
    nodes = [graph.make("div", graph.number(1), x), graph.make("sqrt", x), graph.make("log", x),
             graph.make("abs", x)]  # fmt: skip
    program = graph.program(nodes)
    found = ops.models(
        program.code, program.constants, program.outputs, np.array([[-1.0]]), np.array([[1.0]])
    )
    ends, _ = ops.ranges(found, 1)
    assert not np.isfinite(ends).any()
    assert not ops.excluded(found[:, :3], 1).any()


def test_a_file_says_all_and_false_claims_are_not_proved() -> None:
    """Two kept functions, as a file has them; then larger, steeper, shifted or elsewhere."""
    model, law, claim = first_two(4)
    assert read_claim(claim_data(claim), model) == claim
    proved = decide(model, law, claim, 20_000)
    assert proved.kind == "proved"
    assert "inputs not limited" in sentence(claim, model)
    assert " with phi_dot = w_theta = 0, w = q_a + λ_a⁻¹ λ_u q_u," in sentence(claim, model)
    moving = replace(claim, contains=(claim.contains[0], Fraction(1, 64), Fraction(-1, 128)))
    assert "phi_dot = 0.015625, w_theta = -0.0078125, w =" in sentence(moving, model)
    first, second = claim.functions
    far = replace(claim, contains=(claim.contains[0] * 55, *claim.contains[1:]))
    assert decide(model, law, far, 20_000).kind == "refuted"
    half = tuple(c / 4 for c in first.coefficients)
    negative = tuple(-c for c in second.coefficients)
    mutants = [
        replace(claim, functions=(replace(first, coefficients=half), second)),
        replace(claim, functions=(second,)),
        replace(claim, functions=(first, up(claim, 1.6))),
        replace(claim, functions=(first, replace(second, coefficients=negative))),
        replace(claim, functions=(replace(first, A=first.A[::-1]), second)),
    ]  # fmt: skip
    kinds = [decide(model, law, mutant, 1000).kind for mutant in mutants]
    assert "proved" not in kinds
    assert "refuted" in kinds
    unstable = replace(law, lambda_u=tuple(tuple(-v for v in row) for row in law.lambda_u))
    assert decide(model, unstable, claim, 1000).kind != "proved"
    full = claim_data(claim)["functions"][0] | {"G": [["1"] * 3] * 3}
    with pytest.raises(Refused, match="lower triangular"):
        read_claim({**claim_data(claim), "functions": [full]}, model)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("case", "target"), [(1, 0.75), (2, 0.88), (3, 0.95), (4, 0.75), (5, 0.65)]
)
def test_the_five_cases_reach_their_targets(case: int, target: float) -> None:
    """The kept functions are proved, from rest at the asked angle on; a level 5 % up is not.

    Then 20,000 motions, half of them from the boundary, stay inside and converge.
    """
    model, law, claim = kept(case)
    assert decide(model, law, claim).kind == "proved"
    assert float(claim.contains[0]) > target
    motion = SurfaceMotion(RIG, CASES[case - 1].surface)
    chain = [polynomial(claim, V) for V in claim.functions]
    V = chain[-1]
    raised = Stage(model, law, claim.stretch, up(claim, 1.05), claim.functions[-2], {})
    assert raised.decide(400_000).kind in ("refuted", "undecided")
    line = on_the_line(
        claim.stretch,
        claim.functions[-1],
        (claim.contains[0] * Fraction("1.001"), Fraction(0), Fraction(0)),
        1000,
    )
    assert line.kind == "refuted"
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
