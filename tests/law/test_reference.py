"""References: the error's dynamics, the motion asked of the unactuated coordinates, files."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sympy as sp
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicHermiteSpline

import undertow as ut
from undertow.base import ArtefactError, InvalidInputError
from undertow.closed_loop import Event, simulate_along
from undertow.law import Plan, ReferenceMotion
from undertow.law.reference import Ramp, Sine, Spline
from undertow.models import error_dynamics, invariant_coordinates

RIG = ut.mechanisms.rotary_pendulum()
CRANE = ut.mechanisms.overhead_crane()
GANTRY = ut.mechanisms.gantry_crane()
SURFACE = ut.Surface(-1, -1.59, 1.96, 12.1)


def motion(mechanism: ut.Mechanism, reference: ut.Reference, seconds: float) -> ReferenceMotion:
    ((_, found),) = reference.legs(mechanism, seconds)
    return found


@pytest.mark.parametrize("mechanism", [RIG, GANTRY, ut.mechanisms.pendubot()])
def test_the_error_has_the_dynamics_of_the_mechanism(mechanism: ut.Mechanism) -> None:
    """q̃̈ + q̈_r of the error's model is q̈ of the mechanism, at any state, reference and input."""
    n, rng = mechanism.n, np.random.default_rng(0)
    for _ in range(5):
        e, reference, u = (
            rng.normal(size=2 * n),
            rng.normal(size=3 * n),
            rng.normal(size=mechanism.m),
        )
        moved = error_dynamics(mechanism, reference)
        found = moved.accelerations(0.0, e, u) + reference[2 * n :]
        assert found == pytest.approx(
            mechanism.accelerations(0.0, e + reference[: 2 * n], u), rel=1e-9, abs=1e-9
        )


def test_what_is_invariant_is_found_symbolically() -> None:
    """Carts, arms and wheels; what cancels counts, and so does the track on a slope."""
    assert invariant_coordinates(ut.mechanisms.wheeled_inverted_pendulum()) == ("phi",)
    assert invariant_coordinates(ut.mechanisms.reaction_wheel_pendulum()) == ("psi",)
    assert invariant_coordinates(ut.mechanisms.tora()) == ()
    crane = ut.mechanisms.overhead_crane()
    x, phi = crane.q
    for potential, found in ((9.81 * x, ("x",)), (x * sp.sin(phi), ()), (x**2, ())):
        assert invariant_coordinates(replace(crane, potential=potential)) == found
    turn = 1e6 * (sp.cos(x) ** 2 + sp.sin(x) ** 2)
    for push, found in ((turn, ("x",)), (turn + 1e-12 * x, ())):  # large terms, little is left
        assert invariant_coordinates(crane.disturbed({"x": push})) == found


def test_masses_that_may_move_together_alone_are_moved_as_the_refusal_says() -> None:
    """Neither coordinate of two masses on a spring is free by itself: both are in the remedy."""
    a, b = ut.Coordinate("a", "m"), ut.Coordinate("b", "m")
    masses = ut.Mechanism.from_energies(
        "masses", [a, b], [ut.Input("force", "N", 1.0)],
        kinetic=(a.velocity**2 + b.velocity**2) / 2, potential=(a.symbol - b.symbol) ** 2 / 2,
    )  # fmt: skip
    with pytest.raises(InvalidInputError, match=r"move_target\(mechanism, a=1.0, b=1.0\)"):
        ut.SetPoints([(0, {"a": 1.0, "b": 1.0})]).legs(masses, 1.0)
    moved = ut.modelling.move_target(masses, a=1.0, b=1.0)
    assert moved.f(np.zeros(4)) == pytest.approx(masses.f([1.0, 1.0, 0.0, 0.0]), abs=0)


@pytest.mark.parametrize(
    ("mechanism", "reference"),
    [
        (CRANE, ut.Reference.sine(0.2, x=0.5)),
        pytest.param(GANTRY, ut.Reference.sine(0.25, x=0.4, y=0.2), marks=pytest.mark.slow),
    ],
)
def test_a_periodic_reference_is_a_motion_of_the_mechanism(
    mechanism: ut.Mechanism, reference: ut.Reference
) -> None:
    """Open loop, with the inputs of the inverse dynamics alone, the crane stays on x_r for 2 s."""
    asked, n, m = motion(mechanism, reference, 4.0), mechanism.n, mechanism.m
    B = np.array(mechanism.input_matrix, dtype=float)

    def rates(t: float, x: np.ndarray) -> np.ndarray:
        row = asked.rows(t)[0]
        force = mechanism.forces(t, row[: 2 * n], row[2 * n :])[:m]
        return np.concatenate([x[n:], mechanism.accelerations(t, x, np.linalg.solve(B, force))])

    solved = solve_ivp(rates, (0, 2), asked.state(0.0), rtol=1e-9, atol=1e-11, max_step=0.05)
    assert np.abs(solved.y[:, -1] - asked.state(2.0)).max() < 2e-4


def test_the_upright_pendulum_leans_before_the_arm_starts() -> None:
    """Stable inversion is not causal: φ_r solves the unactuated equation, bounded on both sides."""
    asked = motion(RIG, ut.Reference.ramp(1.0, start=2.0, theta=1.0), 6.0)
    x = np.hstack([asked.q, asked.v])
    assert np.abs(RIG.forces(0.0, x, asked.a)[:, 1]).max() < 1e-9
    before = (asked.t > 1.8) & (asked.t < 1.99)
    assert np.abs(asked.q[before, 0]).max() == 0.0
    assert np.abs(asked.q[before, 1]).min() > 1e-3
    assert np.abs(asked.q[[0, -1], 1]).max() < 1e-6
    t = np.linspace(0.5, 5.5, 2001)  # rates belong to positions, between rows too
    rows = asked.rows(t)
    assert np.abs(np.gradient(rows[:, 1], t)[1:-1] - rows[1:-1, 3]).max() < 1e-4


def test_between_its_rows_a_motion_is_cubic_and_it_rests_before_and_after() -> None:
    rng = np.random.default_rng(0)
    t = np.cumsum(rng.uniform(0.01, 1.0, 20)) - 2.0
    q, v, a = rng.normal(size=(3, 20, 2))
    asked, inside = ReferenceMotion(t, q, v, a), np.append(rng.uniform(t[0], t[-1], 100), t)
    rows = asked.rows(inside)
    assert rows[:, :2] == pytest.approx(CubicHermiteSpline(t, q, v)(inside), abs=1e-12)
    assert rows[:, 2:4] == pytest.approx(CubicHermiteSpline(t, v, a)(inside), abs=1e-12)
    linear = np.stack([np.interp(inside, t, column) for column in a.T], axis=1)
    assert rows[:, 4:] == pytest.approx(linear, abs=1e-12)
    still = np.zeros(4)
    expected = [[*q[0], *still], [*q[-1], *still]]
    assert asked.rows([t[0] - 5.0, t[-1] + 1e4]).tolist() == expected
    assert ReferenceMotion.at_rest(q[0]).rows(2.0).tolist() == [[*q[0], *still]]


def test_a_swing_is_given_damping_that_it_lacks() -> None:
    """After a path has ended a hanging load is asked to be still within seconds."""
    asked = motion(CRANE, ut.Reference.through([0, 2, 4], x=[0, 1, 0]), 12.0)
    assert np.degrees(np.abs(asked.q[asked.t > 9.0, 1]).max()) < 0.05
    assert asked.rows([30.0])[0, 2:] == pytest.approx(0.0, abs=1e-9)


def test_the_law_feeds_the_acceleration_forward() -> None:
    """On x_r the law asks for the input of the inverse dynamics, and off it ṡ = −K sw(s/ε)."""
    asked, surface, t = motion(RIG, ut.Reference.sine(0.5, theta=0.7), 4.0), SURFACE, 1.3
    row = asked.rows(t)[0]
    law = ut.SlidingModeLaw(asked.error_dynamics(RIG, t), surface)
    force = RIG.forces(t, row[:4], row[4:])[0]
    assert law(t, np.zeros(4)).demand == pytest.approx(force / 0.1285, rel=1e-6)
    for e in ([0.3, 0.1, -0.5, 0.4], [0.01, 0.002, 0.0, 0.01]):
        control = law(t, e)
        acceleration = RIG.accelerations(t, row[:4] + e, control.demand) - row[4:]
        s_dot = surface.matrix @ np.concatenate([np.array(e)[2:], acceleration])
        eta, layer = ut.ReachingLaw().vector(1)
        assert s_dot == pytest.approx(-eta * np.clip(control.s / layer, -1, 1), rel=1e-6)


def test_a_motion_along_a_reference_is_that_of_the_equations() -> None:
    """The compiled motion against solve_ivp of the mechanism's own dynamics under the law."""
    asked = motion(RIG, ut.Reference.sine(0.5, theta=0.7), 4.0)
    loop, x0 = ut.ClosedLoop(RIG, ut.MinimumTime()), RIG.state(theta=0.1, phi=0.15)

    def rates(t: float, x: np.ndarray) -> np.ndarray:
        law = ut.SlidingModeLaw(asked.error_dynamics(RIG, t), SURFACE)
        u = law(t, x - asked.state(t)).u
        return np.concatenate([x[2:], RIG.accelerations(t, x, u)])

    solved = solve_ivp(rates, (0, 0.25), x0, rtol=1e-7, atol=1e-9, max_step=0.01)
    run = simulate_along(loop, x0, Plan.of(SURFACE), asked, duration=0.25)
    assert run.x[-1] == pytest.approx(solved.y[:, -1], abs=2e-4)
    far = simulate_along(loop, x0, Plan.of(SURFACE), asked, duration=4.0)
    assert far.event == Event.REACHED
    away = np.linalg.norm(far.x - asked.rows(far.t)[:, :4], axis=1)
    assert away[-1] < 0.01
    assert far.cost == pytest.approx(far.t[away > 0.01].max(), abs=0.01)  # time outside the ball


def test_a_file_is_read_with_its_units(tmp_path: Path) -> None:
    file = tmp_path / "way.csv"
    file.write_text(
        "t (ms), x (cm), y [m]\n0, 0, 0\n2000, 50, 0.1\n\n4000, 0, 0\n", encoding="utf-8"
    )
    read = ut.Reference.read(file)
    same = ut.Reference.through([0, 2, 4], x=[0, 0.5, 0], y=[0, 0.1, 0])
    assert read.paths == same.paths


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("t, x (m)\n0,0\n1,1\n", "column 't'.*a name with its unit"),
        ("t (s), x (miles)\n0,0\n1,1\n", "column 'x .miles.'"),
        ("t (s), x (m)\n0,0\n1,one\n", "line 3 of"),
        ("t (s), x (m)\n0,0\n1,nan\n", "line 3 of"),
        ("t (s), x (m)\n0,0\n1\n", "line 3 of"),
        ("t (s), x (m)\n1,0\n0,1\n", "times of a reference"),
        ("t (s), x (m)\n0,0\n", "times of a reference"),
        ("t (s), x (m)\n0,0\n1,1\n1,2\n", "times of a reference"),
        ("t (s), x (m)\n0,0\n\n2,1\n1,2\n", "times of a reference, line 5.*: got 1, must be ≥ 0"),
        ("t (s), x (m)\n-1,0\n2,1\n", "times of a reference, line 2.*: got -1, must be ≥ 0"),
        ("t (m), x (m)\n0,0\n1,1\n", "column 't .m.'.*one of s, ms"),
        ("x (m), y (m)\n0,0\n1,1\n", "column 'x .m.'.*one of s, ms"),
        ("t (s), x (ms)\n0,0\n1,1\n", "column 'x .ms.'.*one of m, cm"),
        ("t (s)\n0\n1\n", "the time and one coordinate"),
        ("", "the time and one coordinate"),
    ],
)
def test_a_file_that_is_no_reference_is_refused(tmp_path: Path, text: str, words: str) -> None:
    file = tmp_path / "way.csv"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(InvalidInputError, match=words):
        ut.Reference.read(file)


@pytest.mark.parametrize(
    "path",
    [
        Ramp(0.3, -0.5, 0.2, 1.6),
        Sine(0.4, 0.7, 0.3, 1.0),
        Spline((0.0, 0.5, 2.0), (0.1, -0.4, 0.6)),
    ],
)
def test_rates_of_a_path_are_its_derivatives(path: Ramp | Sine | Spline) -> None:
    """By central differences, before, along and after it; what has ends is at rest there."""
    t, h = np.linspace(-0.33, 2.4, 90), 1e-5
    before, (_, v, a), after = (path(t + step) for step in (-h, 0.0, h))
    np.testing.assert_allclose((after[0] - before[0]) / (2 * h), v, atol=1e-6)
    np.testing.assert_allclose((after[1] - before[1]) / (2 * h), a, atol=1e-5)
    if not isinstance(path, Sine):
        first, last = (0.3, -0.5) if isinstance(path, Ramp) else (0.1, 0.6)
        r, *rates = path(t[[0, -1]])
        np.testing.assert_allclose(r, [first, last])
        np.testing.assert_allclose(rates, 0.0, atol=1e-12)


def test_of_many_times_the_first_one_out_of_order_is_named() -> None:
    """And not all of them."""
    times = [*range(500), 7, *range(500, 900)]
    with pytest.raises(InvalidInputError, match=r"got 7 s as number 501 of 901, must be two"):
        ut.Reference.through(times, x=times)


def test_references_are_refused_by_name() -> None:
    """No file, unactuated coordinates, those that the equations depend on, no numbers, too fast."""
    with pytest.raises(ArtefactError):
        ut.Reference.read("nowhere.csv")
    for mechanism, reference, words in (
        (CRANE, ut.Reference.sine(0.2, theta=0.1), "'theta', must be one of x"),
        (CRANE, ut.Reference.of(x=lambda t: t * np.nan), "NaN or infinity"),
        (ut.mechanisms.pendubot(), ut.Reference.sine(0.2, q_1=0.1), "of 'q_1', must.*on all"),
        (RIG, ut.Reference.sine(5.0, theta=3.0), r"by 2\.96e\+03 rad/s².*slower"),
    ):
        with pytest.raises(InvalidInputError, match=words):
            reference.legs(mechanism, 4.0)
    with pytest.raises(InvalidInputError, match="finite and > 0"):
        ut.Reference.sine(0.0, x=1.0)


def test_a_function_of_ones_own_is_differentiated_twice() -> None:
    """Also one that is written for a single time."""
    import math

    t = np.linspace(0.0, 3.0, 7)
    for f in (lambda t: 0.3 * np.sin(t), lambda t: 0.3 * math.sin(t)):
        r, v, a = ut.Reference.of(x=f).paths["x"](t)
        assert r == pytest.approx(0.3 * np.sin(t))
        assert v == pytest.approx(0.3 * np.cos(t), abs=1e-6)
        assert a == pytest.approx(-0.3 * np.sin(t), abs=1e-6)


def test_a_ramp_takes_its_ends_as_any_pair() -> None:
    pairs: list[Any] = [(0.2, 1.0), [0.2, 1.0], np.array([0.2, 1.0])]
    first, *others = (motion(RIG, ut.Reference.ramp(1.0, theta=ends), 2.0).q for ends in pairs)
    assert first[0, 0] == pytest.approx(0.2)
    for other in others:
        np.testing.assert_array_equal(other, first)


@pytest.fixture
def cart() -> ut.Mechanism:
    """One coordinate in m that targets move along, one in rad."""
    return ut.mechanisms.cart_pendulum()


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_set_point_that_is_no_number_says_so(value: float) -> None:
    """Not that it were to be moved along the very coordinate that it names."""
    with pytest.raises(InvalidInputError, match=r"set-point of 'x'.*a finite number"):
        ut.SetPoints({"x": value})


@pytest.mark.parametrize(
    ("reference", "seconds"),
    [
        (ut.Reference.sine(1e-6, x=0.1), 3.0),
        (ut.Reference.sine(1e9, x=0.1), 3.0),
        (ut.Reference.ramp(1.0, x=0.1), 1e9),
    ],
)
def test_a_reference_whose_grid_fills_the_memory_is_refused(
    cart: ut.Mechanism, reference: ut.Reference, seconds: float
) -> None:
    with pytest.raises(InvalidInputError, match="at most 1048576 rows"):
        reference.legs(cart, seconds)


@pytest.mark.parametrize(
    ("path", "word"),
    [
        (lambda t: 1 / 0, "ZeroDivisionError: division by zero, .*test_reference.py line"),
        (lambda t: "far", "ValueError"),
        (lambda t: np.ones((len(t), 2)), "ValueError"),
        (lambda t: -np.sqrt(t - 1), "NaN"),
    ],
)
def test_a_function_of_ones_own_that_fails_says_where(
    cart: ut.Mechanism, path: Any, word: str
) -> None:
    with pytest.raises(InvalidInputError, match=f"(?s)reference of 'x'.*{word}"):
        ut.Reference.of(x=path).legs(cart, 2.0)


def test_a_path_without_its_derivatives_is_refused(cart: ut.Mechanism) -> None:
    with pytest.raises(InvalidInputError, match=r"returns 2 rows.*Reference.of\(x=function\)"):
        ut.Reference({"x": lambda t: (t, t)}).legs(cart, 2.0)  # type: ignore[dict-item, return-value]


def test_a_function_of_time_begins_at_zero(cart: ut.Mechanism) -> None:
    """One that is not defined before is differentiated from its beginning on: here t²."""
    asked: list[float] = []

    def r(t: Any) -> float:  # of one time
        root = math.sqrt(t)
        asked.append(t)
        return 0.1 * root**4

    ((_, motion),) = ut.Reference.of(x=r).legs(cart, 1.0)
    assert min(asked) == 0.0
    at = (motion.t >= 0) & (motion.t < 1.0)
    np.testing.assert_allclose(motion.v[at, 0], 0.2 * motion.t[at], atol=1e-9)
    np.testing.assert_allclose(motion.a[at, 0], 0.2, atol=1e-6)


@pytest.mark.parametrize(
    ("head", "word"),
    [
        ("t (s),x (deg)", "reference of 'x': got in rad, must be in m"),
        ("t (m),x (m)", "column 't .m.'.*one of s, ms"),
        ("t (s),x (s)", "column 'x .s.'.*one of m, cm, mm, rad, deg"),
    ],
)
def test_units_of_a_file_are_those_of_its_quantities(
    cart: ut.Mechanism, tmp_path: Path, head: str, word: str
) -> None:
    """50° were 0.87 m."""
    path = tmp_path / "reference.csv"
    path.write_text(f"{head}\n0,0\n1,0.5\n")
    with pytest.raises(InvalidInputError, match=word):
        ut.Reference.read(path).legs(cart, 2.0)


def test_a_reference_that_moves_nothing_is_refused() -> None:
    with pytest.raises(InvalidInputError, match="paths of a reference: got none"):
        ut.Reference.sine(0.5)


@pytest.mark.parametrize("start", [math.nan, math.inf, -1.0])
def test_a_ramp_begins_at_a_time(start: float) -> None:
    with pytest.raises(InvalidInputError, match="start of a ramp, s"):
        ut.Reference.ramp(1.0, start=start, x=0.1)
