"""The parts of the searches: monomials, linear programs, crossings, steps from proof to proof.

Nothing that a search finds needs to be right, but one that is wrong finds nothing; so each part
is held against a plain computation of the same, and what drives the proofs against one that
answers as it is told.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import sympy as sp
from numpy.typing import ArrayLike
from scipy.integrate import solve_ivp
from scipy.optimize import linprog

import undertow as ut
from support import rest_slow
from undertow.base import Verdict
from undertow.base.errors import InfeasibleError
from undertow.models import FloatArray
from undertow.proofs.claims.region import reaches
from undertow.proofs.claims.terminal_ellipsoid import TerminalEllipsoid
from undertow.proofs.region.lyapunov import (
    LyapunovFunction,
    directions,
    extent,
    first_crossing,
    unit,
)
from undertow.proofs.region.motion import SurfaceMotion
from undertow.proofs.search.basis import (
    CLEARANCE,
    FARTHEST,
    POLE_PART,
    Basis,
    linear_part,
    slowest_rate,
)
from undertow.proofs.search.chain import (
    SearchBudget,
    _crossing,
    _expansion,
    _on_axis,
    _Ring,
    grow,
)
from undertow.proofs.search.chart import natural_stretch, singular_distance_on_axis
from undertow.proofs.search.linear_program import minimise_linear
from undertow.proofs.search.quadratic import Start, quadratic
from undertow.proofs.search.region import (
    HIGHEST,
    LEAP,
    TIGHT,
    _proved_chain,
    _tight_level,
    search_region,
)
from undertow.proofs.search.terminal_ellipsoid import EllipsoidSearch
from vector_field import VectorField

RIG = ut.mechanisms.rotary_pendulum(d_e=0.025)
SURFACE = ut.Surface(-1, -0.7, 1.5, 9.0)
MOTION = SurfaceMotion(RIG, SURFACE)
RNG = np.random.default_rng(0)


def stretched(degree: int) -> LyapunovFunction:
    """A polynomial with all monomials, in coordinates that are scaled and stretched."""
    stretch = natural_stretch(MOTION, slow=True)
    assert stretch is not None
    scale = np.array([[0.3, 0.1, 0.0], [0.0, 2.0, -0.4], [0.2, 0.0, 4.0]])
    chart = LyapunovFunction.quadratic(scale, *stretch)
    exponents = Basis(MOTION, chart, degree).exponents
    return chart.replaced(np.random.default_rng(1).uniform(0.1, 1, len(exponents)), exponents)


# -- monomials --------------------------------------------------------------------------------


@pytest.mark.parametrize("degree", [2, 4, 6])
def test_monomials_are_all_of_even_degree_and_their_rates_are_derivatives(degree: int) -> None:
    V = stretched(degree)
    basis = Basis(MOTION, V, degree)
    totals = [sum(e) for e in basis.exponents.tolist()]
    counts = [math.comb(d + 2, 2) for d in range(2, degree + 1, 2)]
    assert len({tuple(e) for e in basis.exponents.tolist()}) == sum(counts)
    assert [totals.count(d) for d in range(2, degree + 1, 2)] == counts
    z = RNG.uniform(-0.5, 0.5, (30, 3))
    values = np.array([[math.prod(p**k for p, k in zip(x, e, strict=True))
                        for e in basis.exponents.tolist()] for x in z.tolist()])  # fmt: skip
    np.testing.assert_allclose(basis.values(z), values, rtol=1e-12, atol=1e-15)
    y = V.points(z)
    np.testing.assert_allclose(V(y), values @ V.coefficients, rtol=1e-9)
    h = 1e-6 / np.linalg.norm(MOTION(y), axis=1)[:, None]
    ahead, behind = V.coordinates(y + h * MOTION(y)), V.coordinates(y - h * MOTION(y))
    flow = basis.flow(z)
    np.testing.assert_allclose(flow, (ahead - behind) / (2 * h), rtol=1e-5, atol=1e-5)
    rates = (basis.values(ahead) - basis.values(behind)) / (2 * h)
    np.testing.assert_allclose(
        basis.rates(z, flow), rates, rtol=1e-4, atol=1e-6 * np.abs(rates).max()
    )
    other = basis.function(np.arange(1.0, len(totals) + 1))
    np.testing.assert_allclose(other(y), values @ np.arange(1.0, len(totals) + 1), rtol=1e-9)


def test_the_linear_part_is_the_flow_near_the_target() -> None:
    V = stretched(2)
    A = linear_part(MOTION, V)
    z = 1e-6 * RNG.standard_normal((5, 3))
    np.testing.assert_allclose(Basis(MOTION, V, 2).flow(z), z @ A.T, rtol=1e-4, atol=1e-9)
    assert slowest_rate(MOTION) == pytest.approx(-np.linalg.eigvals(A).real.max(), rel=1e-9)


def test_a_polynomial_is_expanded_in_other_coordinates() -> None:
    """The same function of y, whatever linear map leads from its own z to the basis's."""
    V = stretched(4)
    chart = replace(V, scale=V.scale @ np.array([[1.2, 0.3, 0.0], [0.0, 0.8, 0.1], [0.0, 0, 1.1]]))
    basis = Basis(MOTION, chart, 4)
    again = basis.function(_expansion(V, basis, np.random.default_rng(3)))
    y = V.points(RNG.uniform(-1, 1, (50, 3)))
    np.testing.assert_allclose(again(y), V(y), rtol=1e-9)


# -- where a function reaches a level ---------------------------------------------------------


def test_crossings_of_a_level_are_the_first_on_their_rays() -> None:
    """r² − r⁴/5 reaches 1 at 1.18 and not beyond 1.12; where it never does, infinity says so."""
    exponents = np.array([[2, 0], [0, 2], [4, 0]])
    V = LyapunovFunction(np.eye(2), exponents, np.array([1.0, 0.25, -0.2]))
    rays = unit(np.array([[1.0, 0.0], [-2.0, 0.0], [0.0, 1.0]]))
    first = math.sqrt((1 - math.sqrt(1 - 0.8)) / 0.4)
    np.testing.assert_allclose(first_crossing(V, rays), [first, first, 2.0], rtol=1e-6)
    np.testing.assert_allclose(first_crossing(V, rays, 1.3), [INF, INF, 2 * math.sqrt(1.3)])
    still: Any = VectorField(sp.symbols("a b", real=True), (sp.Symbol("b", real=True),) * 2)
    basis = Basis(still, V, 4)
    row = _expansion(V, basis, np.random.default_rng(0))
    found = _crossing(basis, row, rays, 1.0)
    np.testing.assert_allclose(found, [first, first, 2.0], rtol=1e-6)
    np.testing.assert_allclose(_crossing(basis, row, rays, 1.3)[:2], 8.0)  # as far as it looks
    assert extent(V, [1.0, 0.0]) == pytest.approx(first, rel=1e-9)
    assert extent(V, [0.0, 0.5]) == pytest.approx(4.0, rel=1e-9)
    assert extent(V.replaced(np.array([0.0, 1.0, 0.0])), [1.0, 0.0]) == INF


def test_a_stretched_function_reaches_no_further_than_its_pole() -> None:
    V = stretched(4)
    reach = extent(V, [1.0, 0.0, 0.0])
    assert 0 < reach < V.pole
    assert V(np.array([reach, 0.0, 0.0])) == pytest.approx(1.0, rel=1e-6)
    flat = V.times(1e-12)
    assert extent(flat, [-2.0, 0.0, 0.0]) == pytest.approx(V.pole / 2, rel=0.02)
    np.testing.assert_allclose(V.times(4.0)(V.points([[0.1, 0.2, 0.3]])),
                               4 * V(V.points([[0.1, 0.2, 0.3]])))  # fmt: skip


def test_a_stretched_set_reaches_the_points_on_its_axis() -> None:
    """Proved on the whole line from 0: up to the edge, not past it, and never at the pole."""
    V = stretched(4)
    reach = extent(V, [1.0, 0.0, 0.0])
    assert reaches(V, [0.98 * reach, 0.0, 0.0])
    assert reaches(V, [-0.98 * reach, 0.0, 0.0])
    assert not reaches(V, [1.02 * reach, 0.0, 0.0])
    assert not reaches(V.times(1e-12), [V.pole, 0.0, 0.0])
    assert not reaches(V, [0.1, 0.0])


def test_points_on_the_way_are_where_they_were_asked_for() -> None:
    """Ten of them, evenly in y, the last at |z| = length; with a pole never past its part."""
    for V, way in ((stretched(2), [1.0, 0.0, 0.0]), (stretched(2), [0.3, -2.0, 1.0])):
        z = _on_axis(V, np.array(way), 0.8)
        assert np.linalg.norm(z[-1]) == pytest.approx(0.8, rel=1e-9)
        y = V.points(z)
        np.testing.assert_allclose(y, np.linspace(0.1, 1, 10)[:, None] * y[-1], atol=1e-9)
        np.testing.assert_allclose(np.cross(y[-1], way), 0.0, atol=1e-8)
    far = V.points(_on_axis(V, np.array([1.0, 0.0, 0.0]), 1e9))
    assert 0.98 * V.pole < far[-1, 0] < V.pole


def test_directions_are_of_length_one_and_everywhere() -> None:
    rays = directions(np.random.default_rng(0), 4000, 3)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1.0)
    np.testing.assert_allclose(rays.T @ rays / 4000, np.eye(3) / 3, atol=0.03)


INF = math.inf


def test_a_guard_holds_the_set_with_room() -> None:
    V = stretched(4)
    guard = V.guard
    assert guard is not None
    rays = directions(np.random.default_rng(5), 2000, 3)
    edge = V.points(rays * first_crossing(V, rays)[:, None])
    assert guard(edge).max() < 1.0
    assert guard(edge).max() > 0.5
    assert V(guard.points(rays)).min() > 1.0
    assert V.replaced(np.zeros(len(V.coefficients))).guard is None


# -- linear programs --------------------------------------------------------------------------


def test_linear_programs_have_the_optimum_of_another_solver() -> None:
    """Random bounded programs of 2 to 12 unknowns, rows and columns of very different sizes."""
    rng = np.random.default_rng(4)
    for n in (2, 3, 7, 12):
        for _ in range(6):
            A = rng.standard_normal((25 * n, n)) * 10.0 ** rng.uniform(-2, 2, n)
            A *= 10.0 ** rng.uniform(-2, 2, (25 * n, 1))
            inside = rng.standard_normal(n) / np.abs(A).max(axis=0)
            b = A @ inside + rng.uniform(0.1, 1, 25 * n) * np.abs(A).max(axis=1)
            c = -rng.uniform(0, 1, 25 * n) @ A  # dual feasible, so bounded
            c /= np.abs(c).max()
            x = minimise_linear(c, A, b)
            exact = linprog(c, A, b, bounds=(None, None))
            assert x is not None
            assert c @ x == pytest.approx(exact.fun, rel=1e-5, abs=1e-7 * np.abs(c * x).max())
            assert ((A @ x - b) / np.abs(A).max(axis=1)).max() < 1e-5


def test_linear_programs_without_a_solution_have_none() -> None:
    """Unbounded, empty; an unknown that no row holds may stay where it is."""
    assert minimise_linear(np.array([-1.0]), np.array([[-1.0]]), np.array([1.0])) is None
    assert minimise_linear(np.array([1.0]), np.array([[1.0], [-1.0]]), -np.ones(2)) is None
    A = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 0.0]])
    x = minimise_linear(np.array([1.0, 0.0]), A, np.array([2.0, 3.0, 1.0]))
    assert x is not None
    assert x[0] == pytest.approx(-3.0, abs=1e-6)
    few = minimise_linear(np.array([1.0, 0.0]), A, np.array([2.0, 3.0, 1.0]), iterations=1)
    assert few is None or abs(few[0] + 3.0) > 1e-3


# -- charts and first sets --------------------------------------------------------------------


def test_the_pole_is_the_first_singular_angle() -> None:
    """cos q = M_uu α_a / (M_au α_u), to rounding; where there is none, as far as one looks."""
    M = RIG.M([0, 0])
    edge = math.acos(-M[1, 1] / (M[0, 1] * 1.5))
    assert singular_distance_on_axis(MOTION, math.pi) == pytest.approx(edge, rel=1e-9)
    assert singular_distance_on_axis(MOTION, 0.5 * edge) == 0.5 * edge
    assert natural_stretch(SurfaceMotion(RIG, SURFACE), slow=False) is not None
    crane = ut.mechanisms.overhead_crane()
    assert natural_stretch(SurfaceMotion(crane, ut.first_surface(crane))) is None


def test_where_the_force_restores_no_longer_there_is_no_stretch() -> None:
    """q̈ = −sin 3q does up to q = π/3: enough with a pole there, not with one further away."""

    class Ending(VectorField):
        mechanism, slow, end = RIG, np.ones((1, 1)), 1.0

        def margin(self, z: ArrayLike) -> FloatArray:
            return np.asarray(1 - np.abs(np.asarray(z)[..., 0]) / self.end)

    q, v, w = sp.symbols("q v w", real=True)
    motion: Any = Ending((q, v, w), (v, -sp.sin(3 * q), -w))
    assert natural_stretch(motion) is not None
    motion.end = 1.5
    assert natural_stretch(motion) is None
    repelled: Any = Ending((q, v, w), (v, q, -w))
    assert natural_stretch(repelled) is None


def test_stretched_coordinates_follow_the_conserved_energy() -> None:
    """½ μ q̇² + ∫ −F₀ μ dq of the undamped motion is near ½ (stiffness c₀² + c₁²) at η = 0."""
    S, pole = natural_stretch(MOTION, slow=True) or pytest.fail("no stretch")
    V = LyapunovFunction.quadratic(np.eye(3), S, pole)
    kappa = float(MOTION.slow[0, 0])
    h = 1e-4
    q0 = np.array([1e-3, 0.0, kappa * 1e-3])
    stiffness = -float(MOTION(q0)[1]) / 1e-3

    def undamped(t: float, state: FloatArray) -> list[float]:
        q, speed = state
        at = MOTION(np.array([[q, v, kappa * q] for v in (-h, 0.0, h)]))[:, 1]
        bend = (at[0] + at[2] - 2 * at[1]) / h**2 / 2
        return [speed, at[1] + bend * speed**2]

    path = solve_ivp(undamped, (0, 2.0), [0.75 * pole, 0.0], rtol=1e-8, atol=1e-10).y.T
    c = V.coordinates(np.column_stack([path, kappa * path[:, 0]]))
    energy = stiffness * c[:, 0] ** 2 + c[:, 1] ** 2
    assert np.abs(path[:, 0]).min() < 0.05 * pole  # it swings through
    assert np.ptp(energy) < 0.05 * energy.max()
    np.testing.assert_allclose(c[:, 2], kappa * c[:, 0], atol=1e-9)  # η = w − κ q


@pytest.mark.parametrize(
    ("start", "most"),
    rest_slow([("round", 3**-0.5), ("balanced", 3**-0.5), ("far", 1.0)], ("balanced", 3**-0.5)),
)
def test_first_sets_are_as_large_as_the_fall_allows(start: str, most: float) -> None:
    """V̇ < 0 for |x|, |y| < 1: the set that is round in x² + y²/3 ends at y = 1, a far one at x = 1.

    Every set is within 10 % of what its shape allows.
    """
    x, y = sp.symbols("x y", real=True)
    motion: Any = VectorField((x, y), (-x + x**3, -3 * y + 3 * y**3))
    V = quadratic(motion, None, np.array([1.0, 0.0]), np.random.default_rng(0), start)  # type: ignore[arg-type]
    reach = extent(V, [1.0, 0.0])
    assert 0.9 * most < reach < 1.01 * most
    rays = directions(np.random.default_rng(1), 500, 2)
    edge = V.points(0.97 * rays)
    rates = np.sum(rays * V.coordinate_rates(edge, motion(edge)), axis=1)
    assert (rates < 0).all()


@pytest.mark.parametrize("bent", [False, True])
def test_first_sets_keep_clear_of_the_singularity_and_of_the_pole(bent: bool) -> None:
    """Whatever falls beyond: a stable line with a margin that ends at 0.6, a pole at 0.7."""

    class Ending(VectorField):
        def margin(self, z: ArrayLike) -> FloatArray:
            return np.asarray(1.0 if bent else 1 - np.abs(np.asarray(z)[..., 0]) / 0.6)

    x, y = sp.symbols("x y", real=True)
    motion: Any = Ending((x, y), (-x, -y))
    stretch = (np.zeros((1, 2, 2)), 0.7) if bent else None
    V = quadratic(motion, stretch, np.ones(2), np.random.default_rng(0), "round")
    end = 0.7 * POLE_PART if bent else 0.6 * (1 - CLEARANCE)
    assert 0.9 * end < extent(V, [1.0, 0.0]) <= end * (1 + 1e-6)


def test_the_first_set_that_is_searched_for_reaches_the_end_of_the_basin() -> None:
    """Of ẋ = −x + x³ that is 1; the one that is merely as large as samples allow stops short."""
    x = sp.Symbol("x", real=True)
    motion: Any = VectorField((x,), (-x + x**3,))
    far, plain = (
        extent(quadratic(motion, None, np.ones(1), np.random.default_rng(0), start), np.ones(1))
        for start in ("far", "round")
    )
    assert plain < 0.99 < far < 1.0


def test_a_set_grows_and_motions_come_back_through_all_that_is_new() -> None:
    """By one linear program, inside the basin; V falls from its edge to that of the set before."""
    x = sp.Symbol("x", real=True)
    motion: Any = VectorField((x,), (-x + x**3,))
    way, first = np.ones(1), LyapunovFunction.quadratic(np.array([[0.5]]))
    (V,) = grow(motion, first, way, 4, SearchBudget(1, INF), np.random.default_rng(0))
    assert 1.01 * extent(first, way) < extent(V, way) < 1
    new = np.linspace(extent(first, way), extent(V, way), 50)[:, None]
    assert (V(new + 1e-4 * motion(new)) < V(new)).all()
    for far in (0.25 * way, 4.0 * way):  # a direction, however long
        (W,) = grow(motion, first, far, 4, SearchBudget(1, INF), np.random.default_rng(0))
        assert W.coefficients == pytest.approx(V.coefficients, rel=1e-6)


@pytest.mark.slow
def test_a_chain_grows_within_its_budget() -> None:
    """Each set reaches further than the one before; programs are counted."""
    x = sp.Symbol("x", real=True)
    motion: Any = VectorField((x,), (-x + x**3,))
    way = np.ones(1)
    first = LyapunovFunction.quadratic(np.array([[0.5]]))
    budget = SearchBudget(4, math.inf)
    chain = grow(motion, first, way, 4, budget, np.random.default_rng(0))
    reaches = [extent(V, way) for V in (first, *chain)]
    assert len(chain) >= 2
    assert (np.diff(reaches) > 0).all()
    assert budget.programs <= 0
    assert not budget.left
    spent = SearchBudget(8, 0.0)
    assert not spent.left
    assert not grow(motion, first, way, 4, SearchBudget(0, INF), np.random.default_rng(0))


class Ticks:
    """A clock that goes on by so much each time that it is asked."""

    def __init__(self, tick: float) -> None:
        self.now, self.tick = 0.0, tick

    def __call__(self) -> float:
        self.now += self.tick
        return self.now


def test_no_linear_program_begins_that_would_end_too_late() -> None:
    """One is taken to be as long as the last, the next of a step that has begun too."""
    clock = Ticks(0.0)
    budget = SearchBudget(10, 20.0, clock=clock)
    assert budget.left
    with budget.spend():
        clock.now += 7.0
    assert budget.left
    with budget.spend():
        clock.now += 7.0
    assert not budget.left
    assert not budget.in_time
    assert budget.programs == 8
    assert not SearchBudget(10, 20.0, 21.0, clock).left


def test_a_step_ends_with_its_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """A step whose samples keep disagreeing goes on for as long as there is time, no longer."""
    x = sp.Symbol("x", real=True)
    motion: Any = VectorField((x,), (-x + x**3,))
    bad = np.array([[0.5]])
    monkeypatch.setattr(_Ring, "_counterexamples", lambda *_: (bad, bad[:0]))
    first = LyapunovFunction.quadratic(np.array([[0.5]]))
    for seconds, programs in ((INF, 10), (5.0, 2), (9.0, 3)):
        ring = _Ring(motion, first, 4, np.random.default_rng(0))
        budget = SearchBudget(100, seconds, clock=Ticks(1.0))
        assert ring.next(np.ones(1), 0.06, 0.04, 0.5, budget) is None
        assert 100 - budget.programs == programs


# -- from proof to proof ----------------------------------------------------------------------


def line(reach: float) -> LyapunovFunction:
    """V = (x/reach)² in one variable."""
    return LyapunovFunction.quadratic(np.array([[reach]]))


def reach_of(V: LyapunovFunction) -> float:
    return float(V.scale[0, 0] / math.sqrt(V.coefficients[0]))


class Told:
    """Proves what is no further than ``factor`` from the function before, and up to ``most``."""

    def __init__(self, factor: float, most: float = INF, first: float = 1.0) -> None:
        self.factor, self.most, self.first = factor, most, first
        self.asked: list[list[float]] = []

    def __call__(self, chain: Sequence[LyapunovFunction]) -> Verdict:
        reaches = [reach_of(V) for V in chain]
        self.asked.append(reaches)
        before = reaches[-2] if len(reaches) > 1 else self.first
        good = reaches[-1] <= min(before * self.factor, self.most) * (1 + 1e-12)
        return Verdict("told", "proved" if good else "undecided", method="told")


@pytest.mark.parametrize("hop", [1, 2, 3, 7, 40])
def test_a_chain_is_proved_in_as_long_leaps_as_go(hop: int) -> None:
    """From the first set to the last, none longer than is proved, not many more than need be."""
    found = tuple(line(1.1 ** (k + 1)) for k in range(40))
    decide = Told(1.1**hop)
    proved = _proved_chain((line(1.0),), found, decide)
    assert [reach_of(proved[0]), reach_of(proved[-1])] == pytest.approx([1.0, 1.1**40])
    steps = np.diff(np.log([reach_of(V) for V in proved]) / math.log(1.1)).round()
    assert steps.max() <= min(hop, LEAP)
    assert len(steps) <= 2 * 40 / min(hop, LEAP) + 1
    assert len(decide.asked) <= 3 * len(steps) + 8


def test_a_chain_ends_where_no_next_is_proved() -> None:
    found = tuple(line(1.1 ** (k + 1)) for k in range(20))
    proved = _proved_chain((line(1.0),), found, Told(1.1**3, most=1.1**11))
    assert reach_of(proved[-1]) == pytest.approx(1.1**11)
    alone = _proved_chain((line(1.0),), found, Told(1.01))
    assert [reach_of(V) for V in alone] == [1.0]


def test_a_chain_begins_with_the_first_set_that_is_proved() -> None:
    """In the order given, then smaller and smaller; without any the refusal says why."""
    decide = Told(1.0, first=0.9)
    proved = _proved_chain((line(1.2), line(1.0)), (), decide)
    assert len(proved) == 1
    assert reach_of(proved[0]) == pytest.approx(1 / math.sqrt(1.3))
    asked = [reaches[0] for reaches in decide.asked]
    sizes = [s / math.sqrt(f) for f in (1.0, 1.1, 1.3, 2.0) for s in (1.2, 1.0)]
    assert asked == pytest.approx(sizes[: len(asked)])
    with pytest.raises(InfeasibleError, match="another seed"):
        _proved_chain((line(1.2),), (), Told(1.0, first=0.1))


@pytest.mark.parametrize("edge", [1.0, 1.013, 1.3, 4.0])
def test_a_level_is_raised_to_within_two_per_cent_of_what_is_proved(edge: float) -> None:
    """V ≤ level, proved; at most 2 % above it, refused, and that is the verdict returned."""
    decide = Told(1.0, first=math.sqrt(edge))
    V, refusal = _tight_level([line(1.0)], decide)
    level = reach_of(V) ** 2
    assert 1.0 <= level <= edge * (1 + 1e-9)
    refused = [a[-1] ** 2 for a in decide.asked if a[-1] ** 2 > edge * (1 + 1e-9)]
    assert min(refused) <= TIGHT * level * (1 + 1e-9)
    assert refusal is not None
    assert refusal.kind == "undecided"
    assert len(decide.asked) < 20


def test_a_level_that_is_never_refused_is_raised_no_further_than_the_highest() -> None:
    """On a linear motion every level is proved: to raise it until one is refused never ended."""
    asked: list[float] = []

    def decide(chain: Sequence[LyapunovFunction]) -> Verdict:
        asked.append(reach_of(chain[-1]) ** 2)
        assert len(asked) < 20, f"levels {asked}"
        return Verdict("told", "proved", method="told")

    V, refusal = _tight_level([line(1.0)], decide)
    assert refusal is None
    assert max(asked) == pytest.approx(reach_of(V) ** 2) == pytest.approx(HIGHEST)


# -- terminal ellipsoids ------------------------------------------------------------------------


@pytest.mark.parametrize(("slow_room", "alike"), [(1.0, True), (5.0, False)])
def test_slow_modes_have_room_where_alike_nothing_is_proved(slow_room: float, alike: bool) -> None:
    """Rates 1/s and 100/s; the proof asks for a slow semi-axis so many times the fast one."""

    def axes(candidate: TerminalEllipsoid) -> FloatArray:
        return np.asarray(candidate.radius / np.abs(np.diag(candidate.W)))

    def margin(candidate: TerminalEllipsoid) -> float:
        slow, fast = axes(candidate)
        return 1.0 if slow >= slow_room * fast and slow <= 0.3 else -1.0

    search = EllipsoidSearch.of(margin, np.diag([-1.0, -100.0]), np.eye(2), np.ones(2))
    assert search is not None
    found = search.largest(0)
    assert found is not None
    slow, fast = axes(found)
    assert 0.3 / 1.01 <= slow <= 0.3
    assert fast == pytest.approx(slow if alike else slow / 10)  # by the root of the rates


def carts_on_a_spring() -> SurfaceMotion:
    """Two carts, one of them driven: a linear mechanism, whose motion converges from anywhere."""
    x, y = ut.Coordinate("x", "m"), ut.Coordinate("y", "m")
    v, w = x.velocity, y.velocity
    pair = ut.Mechanism.from_energies(
        "carts", [x, y], [ut.Input("force", "N", 10.0)],
        kinetic=v**2 / 2 + (v + w) ** 2 / 4, potential=10 * y.symbol**2,
        dissipation=0.1 * v**2 + 0.05 * w**2,
    )  # fmt: skip
    return SurfaceMotion(pair, ut.first_surface(pair))


@pytest.mark.parametrize("start", rest_slow(["far", "round", "balanced"], "round", "balanced"))
def test_the_region_of_a_linear_motion_ends_where_nobody_goes(start: Start) -> None:
    """All sets of it are as good: one reached over 4.8e21 m."""
    way = np.array([1.0, 0.0, 0.0])
    chain = search_region(carts_on_a_spring(), way, programs=6, start=start)
    reach = [extent(V, way) for V in chain]
    assert 10.0 < reach[-1] < 1.3 * FARTHEST
