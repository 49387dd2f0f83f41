"""The optimal-control bound: known optima, the checked table, and the motion rolled out."""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import scipy.integrate
import scipy.interpolate
import scipy.linalg
import scipy.optimize
import sympy as sp

import undertow as ut
from support import rest_slow
from undertow.base import InfeasibleError, InvalidInputError, MissingExtraError, ModelError
from undertow.bounds import Bound, bound
from undertow.bounds.expressions import smooth, translate
from undertow.bounds.guesses import Guess
from undertow.bounds.programme import Programme
from undertow.models import FloatArray, linearise

ca = pytest.importorskip("casadi")

#: d_e, φ(0) in degrees, then least energy within 17 s and 60 s and least time, computed
#: once by an independent script (Hermite-Simpson, other meshes).
TABLE = [
    (0.025, 40.0, 10.217, 10.117, 0.496),
    (0.025, 40.9, 11.663, 11.550, 0.511),
    (0.025, 41.0, 11.839, 11.725, 0.512),
    (0.025, 42.5, 14.949, 14.809, 0.541),
    (0.073, 40.0, 24.112, 23.849, 0.544),
    (0.0, 41.0, 7.352, 7.116, 0.509),
]
#: First intervals of the finer mesh.
FINE = 160
UPRIGHT = ut.state_box(phi=math.pi / 2)


@lru_cache
def pendulum(d_e: float = 0.025) -> ut.Mechanism:
    return ut.mechanisms.rotary_pendulum(d_e=d_e)


@lru_cache
def least_energy(d_e: float, degrees: float, horizon: float, intervals: int = 100) -> Bound:
    rig = pendulum(d_e)
    x0 = rig.state(phi=ut.deg(degrees))
    return bound(rig, ut.MinimumEnergy(), x0, horizon=horizon, intervals=intervals)


@lru_cache
def least_time(d_e: float, degrees: float, intervals: int = 100) -> Bound:
    rig = pendulum(d_e)
    return bound(rig, ut.MinimumTime(), rig.state(phi=ut.deg(degrees)), intervals=intervals)


@lru_cache
def swing() -> Bound:
    rig = pendulum()
    x0 = rig.state(phi=ut.deg(41))
    return bound(rig, ut.MinimumEnergy(), x0, horizon=17, swing=True, intervals=60)


def drive(found: Bound, x0: FloatArray, start: float, end: float) -> FloatArray:
    """Integrate the mechanism under the input that was found, to rounding."""
    n = found.mechanism.n

    def rate(t: float, x: FloatArray) -> FloatArray:
        return np.concatenate([x[n:], found.mechanism.accelerations(t, x, found.input(t))])

    kinks = found.t[::2]
    inner = kinks[(kinks > start) & (kinks < end)]
    x = x0
    for a, b in pairwise([start, *inner, end]):  # smooth pieces only
        x = scipy.integrate.solve_ivp(rate, (a, b), x, method="DOP853", rtol=1e-9, atol=1e-11).y[
            :, -1
        ]
    return np.asarray(x)


def linear_plant(limit: float = math.inf, falling: float = 0.0) -> ut.Mechanism:
    """Two masses and a spring, force on the first: linear, controllable; the second may fall."""
    a, b = ut.Coordinate("a", "m"), ut.Coordinate("b", "m")
    return ut.Mechanism.from_energies(
        "two_masses",
        [a, b],
        [ut.Input("force", "N", limit)],
        kinetic=a.velocity**2 / 2 + 2 * b.velocity**2 / 2,
        potential=3 * (a.symbol - b.symbol) ** 2 / 2 - sp.Float(falling) * b.symbol**2 / 2,
        dissipation=sp.Float(0.1) * b.velocity**2 / 2,
    )


def cart_pendulum(limit: float = 20.0) -> ut.Mechanism:
    """Cart 1 kg, point mass 0.2 kg on a 0.5 m rod, upright at 0."""
    s, p = ut.Coordinate("s", "m"), ut.Coordinate("p", "rad")
    tip = s.velocity**2 + sp.Rational(1, 4) * p.velocity**2
    tip += s.velocity * p.velocity * sp.cos(p.symbol)
    return ut.Mechanism.from_energies(
        "cart_pendulum",
        [s, p],
        [ut.Input("force", "N", limit)],
        kinetic=s.velocity**2 / 2 + sp.Rational(1, 10) * tip,
        potential=sp.Float(0.2 * 9.81 * 0.5) * sp.cos(p.symbol),
    )


# -- against what is known in closed form -------------------------------------------------


def gramian_optimum(mechanism: ut.Mechanism, x0: FloatArray, end: float, radius: float) -> float:
    """min ∫u² dt to ‖x(T)‖ ≤ ν: the nearest point of a ball in the metric of the Gramian."""
    lin = linearise(mechanism)
    A, B = lin.A, lin.input
    size = len(A)
    # Van Loan (1978): exp of the block matrix [[A, BBᵀ], [0, −Aᵀ]].
    block = scipy.linalg.expm(np.block([[A, B @ B.T], [np.zeros((size, size)), -A.T]]) * end)
    transition = block[:size, :size]
    gramian = block[:size, size:] @ transition.T
    metric = np.linalg.inv((gramian + gramian.T) / 2)
    free = transition @ x0

    def end_state(multiplier: float) -> FloatArray:
        return np.asarray(
            np.linalg.solve(metric + multiplier * np.eye(size), metric @ free), dtype=float
        )

    root = scipy.optimize.brentq(
        lambda z: float(np.linalg.norm(end_state(math.exp(z)))) - radius, -10, 40, xtol=1e-12
    )
    gap = end_state(math.exp(root)) - free
    return float(gap @ metric @ gap)


def test_linear_plant_energy_is_that_of_the_controllability_gramian() -> None:
    """On a linear plant the least energy is known: (x_T − Φx₀)ᵀ W⁻¹ (x_T − Φx₀)."""
    plant, radius = linear_plant(), 0.05
    x0 = np.array([1.0, -0.5, 0.2, 0.3])
    found = bound(plant, ut.MinimumEnergy(terminal_radius=radius), x0, horizon=4.0, intervals=40)
    assert found.cost == pytest.approx(gramian_optimum(plant, x0, 4.0, radius), rel=1e-5)
    assert np.linalg.norm(found.x[-1]) == pytest.approx(radius, rel=1e-5)


def test_energy_is_counted_until_the_terminal_set_is_reached() -> None:
    """A mass that falls away from the target: the least over all final times, in closed form.

    Held inside the terminal set until the horizon they cost more; so would any other time.
    """
    plant, radius, horizon = linear_plant(falling=1.0), 0.2, 8.0
    x0 = np.array([0.3, 0.5, 0.0, 0.0])
    objective = ut.MinimumEnergy(terminal_radius=radius)

    def at(end: float) -> float:
        return gramian_optimum(plant, x0, end, radius)

    least = scipy.optimize.minimize_scalar(at, bounds=(3.0, 6.0), method="bounded")
    assert least.fun < 0.98 * at(horizon)
    found = bound(plant, objective, x0, horizon=horizon)
    assert found.cost == pytest.approx(least.fun, rel=1e-4)
    assert found.time == pytest.approx(least.x, rel=0.02)
    inside = np.linalg.norm(found.x, axis=1) <= radius
    assert not inside[:-1].any()
    late = bound(plant, objective, x0, horizon=0.7 * least.x)
    assert late.time == pytest.approx(0.7 * least.x)
    assert late.cost == pytest.approx(at(0.7 * least.x), rel=1e-4)


def test_where_the_target_is_held_by_an_input_time_costs_that_input() -> None:
    """Least energy against a load c on the first mass is ∫(u + c)² dt of the plant without it."""
    plant, load, x0 = linear_plant(falling=1.0), 2.0, [0.3, 0.2, 0.0, 0.0]
    loaded = plant.disturbed({"a": -load})
    objective = ut.MinimumEnergy(terminal_radius=0.05, horizon=6.0)
    found = bound(loaded, objective, x0, intervals=20)
    same = replace(objective, stage=lambda v: (v.force + load) ** 2)
    assert found.time < 0.5 * objective.horizon
    assert found.cost == pytest.approx(bound(plant, same, x0, intervals=20).cost, rel=1e-3)


@pytest.mark.slow
def test_an_energy_bound_is_what_the_plant_does_with_its_input() -> None:
    """Applied to a rig sample by sample, u(t) costs and arrives as the bound says."""
    plant, period, spent = ut.mechanisms.pendubot(), 5e-5, 0.0
    found = bound(plant, ut.MinimumEnergy())
    rig = ut.plants.IdealRig(plant, found.x[0], period)
    misses = []
    for t in np.arange(0.5 * period, found.time + 0.01, period):
        u = found.input(t) if t < found.time else np.zeros(1)
        rig.write(u)
        spent += float(u @ u) * period
        misses.append(np.linalg.norm(rig.truth))
    assert min(misses) <= 0.01 * 1.02
    arrives = period * (1 + np.argmax(np.array(misses) <= 0.01 * 1.02))
    assert arrives == pytest.approx(found.time, abs=3e-3)
    assert spent == pytest.approx(found.cost, rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["pendubot", "acrobot", "rotary_pendulum"])
def test_no_cascade_costs_less_than_the_bound(name: str) -> None:
    """Energy until arrival, by the best cascade there is: not below the bound, but by its error."""
    plant = getattr(ut.mechanisms, name)()
    freedom = ut.DecisionVariables(reaching=True, schedule=0.1)
    cascade = ut.Cascade(plant, ut.MinimumEnergy(), belief="exact", freedom=freedom)
    run = cascade.simulate(**plant.start)
    assert run.reached
    for guess in (None, run.trajectory):
        found = bound(plant, ut.MinimumEnergy(), guess=guess)
        assert 1.0 - 5e-4 < run.cost / found.cost < 1.02


def test_cost_converges_with_the_order_of_a_piecewise_linear_input() -> None:
    """The cost error of a linear u is the square of its own, h²: order 4, here on even meshes."""
    plant, radius, end = linear_plant(), 0.05, 4.0
    x0 = np.array([1.0, -0.5, 0.2, 0.3])
    exact = gramian_optimum(plant, x0, end, radius)
    programme = Programme(ca, plant, ut.MinimumEnergy(terminal_radius=radius), x0, end)
    start = Guess("rest", end, lambda t: np.zeros((len(t), 4)), lambda t: np.zeros((len(t), 1)))
    counts = np.array([8, 16, 32])
    errors = [
        programme.solve(np.linspace(0, 1, k + 1), start, programme.cost, fixed=end).cost - exact
        for k in counts
    ]
    order = -np.polyfit(np.log(counts), np.log(np.abs(errors)), 1)[0]
    assert order == pytest.approx(4.0, abs=0.5)


@pytest.mark.parametrize("price", [1e-6, 1e6])
def test_a_bound_is_the_same_in_any_unit_of_cost(price: float) -> None:
    """IPOPT's tolerances are absolute: effort in MN² is as well resolved as in N², and says so."""

    def effort(factor: float) -> ut.Objective:
        return ut.Objective("effort", lambda v: factor * v.inputs[0] ** 2)

    plant, x0 = linear_plant(), np.array([1.0, -0.5, 0.2, 0.3])
    start = Guess("rest", 4.0, lambda t: np.zeros((len(t), 4)), lambda t: np.zeros((len(t), 1)))
    mesh, found = np.linspace(0, 1, 17), []
    for factor in (1.0, price):
        programme = Programme(ca, plant, effort(factor), x0, 4.0)
        found.append(programme.solve(mesh, start, programme.cost, fixed=4.0))
    assert found[1].cost / price == pytest.approx(found[0].cost, rel=1e-6)
    assert found[1].stationarity < 1e-6


@pytest.mark.slow
def test_a_bound_is_the_same_in_any_unit_of_the_input() -> None:
    """In 2²⁰ N: unknowns are parts of the limits, and the search is the same."""
    plant, unit = linear_plant(2.0), 2.0**20
    large = replace(
        plant, inputs=(replace(plant.inputs[0], limit=2.0 / unit),), input_matrix=[[unit]]
    )
    one, other = (
        bound(m, ut.MinimumTime(horizon=9.0), [0.3, 0.2, 0.0, 0.0], intervals=10)
        for m in (plant, large)
    )
    assert one.iterations == other.iterations
    assert one.cost == pytest.approx(other.cost, rel=1e-10)
    np.testing.assert_allclose(one.u, unit * other.u, atol=1e-6)


@pytest.mark.slow
def test_inputs_of_very_different_limits_are_bounded() -> None:
    """A cart of 30 N, and a wheel of 0.02 N m on the pendulum that it carries."""
    x, w, p = ut.Coordinate("x", "m"), ut.Coordinate("w", "rad"), ut.Coordinate("p", "rad")
    tip = x.velocity + sp.Float(0.4) * sp.cos(p.symbol) * p.velocity
    fall = sp.Float(0.4) * sp.sin(p.symbol) * p.velocity
    cart = ut.Mechanism.from_energies(
        "cart_with_wheel",
        [x, w, p],
        [ut.Input("force", "N", 30.0), ut.Input("torque", "N m", 0.02)],
        kinetic=x.velocity**2 / 2
        + sp.Float(0.2) * (tip**2 + fall**2)
        + sp.Float(0.005) * p.velocity**2
        + sp.Float(0.002) * (p.velocity + w.velocity) ** 2,
        potential=sp.Float(0.4 * 9.81 * 0.4) * sp.cos(p.symbol),
    )
    objective = ut.MinimumTime(horizon=10.0)
    x0 = cart.state(p=0.08)
    slides = ut.ClosedLoop(cart, objective).simulate(x0, ut.first_surface(cart))
    assert 0.3 < bound(cart, objective, x0).cost < slides.time


def test_double_integrator_takes_twice_the_root_of_distance_over_limit() -> None:
    """Minimum time of ẍ = u, |u| ≤ U from rest at d is 2√(d/U), bang-bang.

    The second coordinate rests and is not moved by the first: (A, B) is uncontrollable, so
    the linear-quadratic guess must be missing without harm.
    """
    a, b = ut.Coordinate("a", "m"), ut.Coordinate("b", "m")
    plant = ut.Mechanism.from_energies(
        "two_blocks",
        [a, b],
        [ut.Input("force", "N", 2.0)],
        kinetic=(a.velocity**2 + b.velocity**2) / 2,
        potential=sp.Integer(0),
    )
    objective = ut.MinimumTime(terminal_radius=1e-4, horizon=20.0)
    found = bound(plant, objective, [3.0, 0, 0, 0], intervals=40)
    assert found.cost == pytest.approx(found.time, rel=1e-12)
    assert found.cost == pytest.approx(2 * math.sqrt(3.0 / 2.0), rel=2e-3)
    early = found.u[found.t < 0.45 * found.time, 0]
    late = found.u[found.t > 0.55 * found.time, 0]
    np.testing.assert_allclose(early, -2.0, rtol=1e-3)
    np.testing.assert_allclose(late[:-2], 2.0, rtol=1e-3)


# -- against the checked numbers ----------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("d_e", "degrees", "energy_17", "energy_60", "duration"),
    [pytest.param(*row, id=str(row[:2])) for row in TABLE],
)
def test_rotary_pendulum_table(
    d_e: float, degrees: float, energy_17: float, energy_60: float, duration: float
) -> None:
    """The table of independently computed optima comes out, within 0.1 % and its rounding."""
    assert least_energy(d_e, degrees, 17.0, 40).cost == pytest.approx(energy_17, rel=1e-3)
    assert least_energy(d_e, degrees, 60.0).cost == pytest.approx(energy_60, rel=1e-3)
    assert least_time(d_e, degrees).cost == pytest.approx(duration, rel=1e-3, abs=5e-4)


def hoisting_crane() -> ut.Mechanism:
    """A trolley of 5 kg with a load of 3 kg on a rope of 1.5 m that is pulled in and let out."""
    x, rope, swing = (
        ut.Coordinate("x", "m"), ut.Coordinate("rope", "m"), ut.Coordinate("swing", "rad")
    )  # fmt: skip
    length, sine, cosine = 1.5 + rope.symbol, sp.sin(swing.symbol), sp.cos(swing.symbol)
    right = x.velocity + rope.velocity * sine + length * cosine * swing.velocity
    down = rope.velocity * cosine - length * sine * swing.velocity
    return ut.Mechanism.from_energies(
        "hoisting_crane",
        [x, rope, swing],
        [ut.Input("force", "N", 20.0), ut.Input("pull", "N", 60.0)],  # beyond the load's weight
        kinetic=sp.Rational(5, 2) * x.velocity**2 + sp.Rational(3, 2) * (right**2 + down**2),
        potential=3 * sp.Float(9.81) * (rope.symbol - length * cosine),
        dissipation=x.velocity**2 / 2 + 2 * rope.velocity**2 + sp.Float(0.01) * swing.velocity**2,
    )


@pytest.mark.slow
def test_a_motion_is_refined_where_it_is() -> None:
    """Two inputs that switch often: solved on the first mesh, it was lost on every finer one."""
    crane = hoisting_crane()
    assert bound(crane, ut.MinimumTime(), x=-0.5, rope=0.3).cost < 1.32


@pytest.mark.slow
def test_a_guess_that_arrives_is_not_made_worse() -> None:
    """Solved near it, whatever the built-in guesses find."""
    crane = hoisting_crane()
    schedule = ut.DecisionVariables(reaching=True, schedule=0.1)
    run = ut.Cascade(crane, ut.MinimumTime(), belief="exact", freedom=schedule).simulate(
        x=-0.5, rope=0.3
    )
    near = bound(crane, ut.MinimumTime(), x=-0.5, rope=0.3, guess=run.trajectory)
    assert near.cost < run.cost


@pytest.mark.slow
def test_halving_the_mesh_does_not_move_the_cost() -> None:
    """First meshes of 80 and 160 intervals agree within 0.1 %, as ``change`` foretells."""
    for coarse, fine in (
        [least_energy(0.025, 41.0, 60.0, k) for k in (FINE // 2, FINE)],
        [least_time(0.025, 41.0, k) for k in (FINE // 2, FINE)],
    ):
        assert fine.intervals > 1.4 * coarse.intervals
        assert coarse.cost == pytest.approx(fine.cost, rel=1e-3)
        assert max(coarse.change, fine.change) < 1e-3


@pytest.mark.slow
def test_more_time_and_a_weaker_actuator_never_help_and_hurt() -> None:
    """A longer horizon cannot raise the optimum; a lower input limit cannot lower it."""
    assert least_energy(0.025, 41.0, 60.0).cost < least_energy(0.025, 41.0, 17.0).cost
    rig = pendulum()
    x0 = rig.state(phi=ut.deg(41))
    stronger = bound(rig.with_input_limit(20.0), ut.MinimumTime(), x0, intervals=40)
    assert stronger.cost < least_time(0.025, 41.0).cost


@pytest.mark.slow
def test_of_a_plant_that_swings_the_cheapest_swing_is_found() -> None:
    """Two carts and a spring: the error costs, so that every half swing is a valley of the cost in
    the final time; more time never costs more, and no closed loop costs less than the bound."""
    x, y = ut.Coordinate("x", "m"), ut.Coordinate("y", "m")
    plant = ut.Mechanism.from_energies(
        "carts", [x, y], [ut.Input("push", "N", 5.0)],
        kinetic=(x.velocity**2 + y.velocity**2) / 3, potential=4 * (x.symbol - y.symbol) ** 2,
        dissipation=(x.velocity**2 + y.velocity**2) / 40, start={"y": 0.1},
    )  # fmt: skip
    objective = ut.objective_for(plant, "bench-energy", horizon=60.0)
    costs = [bound(plant, objective, horizon=h, intervals=50).cost for h in (5.0, 12.0, 60.0)]
    assert costs[1] <= costs[0] * (1 + 1e-3)
    assert costs[2] <= costs[1] * (1 + 1e-3)
    run = ut.Cascade(plant, objective).simulate(plant.start)
    assert run.reached
    assert costs[2] <= run.cost
    assert bound(plant, objective, guess=run.trajectory, intervals=50).cost <= run.cost


def test_a_motion_that_arrives_is_followed_to_the_optimum_beside_it() -> None:
    """On a linear plant the optimum comes back, a little later; what stays away is no help."""
    plant, objective = linear_plant(), ut.MinimumEnergy(terminal_radius=0.05)
    x0 = np.array([1.0, -0.5, 0.2, 0.3])
    found = bound(plant, objective, x0, horizon=4.0, intervals=20)
    motion = Guess(
        "motion",
        found.time,
        scipy.interpolate.make_interp_spline(found.t, found.x, k=1),
        scipy.interpolate.make_interp_spline(found.t, found.u, k=1),
    )
    programme = Programme(ca, plant, objective, x0, 5.0)
    near = programme.near(motion, 20)
    assert near is not None
    assert near.cost < found.cost  # it may take a little longer
    assert near.time > found.time
    assert programme.near(motion._replace(time=0.5 * found.time), 20) is None


# -- the result checks itself -------------------------------------------------------------


@pytest.mark.parametrize("which", rest_slow(["energy", "time", "swing"], "energy"))
def test_result_carries_its_own_optimality(which: str) -> None:
    """Feasible, stationary, between the nodes too; u within its limit at every instant."""
    found = swing() if which == "swing" else least_time(0.025, 41.0)
    if which == "energy":
        found = least_energy(0.025, 41.0, 60.0)
    assert found.status == "optimal"
    assert found.violation < 1e-6
    assert found.stationarity < 1e-6
    assert found.defect < 1e-3
    assert found.t.shape == (2 * found.intervals + 1,)
    assert found.x.shape == (len(found.t), 4)
    assert found.u.shape == (len(found.t), 1)
    assert (np.diff(found.t) > 0).all()
    assert np.linalg.norm(found.x[-1]) <= 0.01 * (1 + 1e-5)
    instants = np.linspace(0, found.time, 20_001)
    assert np.abs(found.input(instants)).max() <= 15.0 * (1 + 1e-6)
    np.testing.assert_allclose(found.state(found.t[::2]), found.x[::2], atol=1e-9)


def test_energy_is_the_integral_of_the_input_squared() -> None:
    """The cost is that of the u(t) returned: exact quadrature of a piecewise linear input."""
    found = least_energy(0.025, 41.0, 60.0)
    u, h = found.u[::2, 0], np.diff(found.t[::2])
    exact = float(np.sum(h * (u[:-1] ** 2 + u[:-1] * u[1:] + u[1:] ** 2) / 3))
    assert found.cost == pytest.approx(exact, rel=1e-9)


def test_minimum_time_input_is_bang_bang() -> None:
    """Pontryagin: a time-optimal input sits at ±15 V but for the switches."""
    found = least_time(0.025, 41.0)
    instants = np.linspace(0, found.time, 10_001)
    assert np.mean(np.abs(found.input(instants)) > 0.999 * 15.0) > 0.98


# -- an accurate integrator agrees --------------------------------------------------------


@pytest.mark.slow
def test_minimum_time_input_drives_the_plant_into_the_terminal_set() -> None:
    """Integrated open loop over all its 0.51 s, u(t) ends at the edge of the terminal set.

    On the finer mesh: the plant multiplies the defects, here by 70 on the way, and its
    states pass through 30 rad/s.
    """
    found = least_time(0.025, 41.0, FINE)
    end = drive(found, found.x[0], 0.0, found.time)
    assert np.linalg.norm(end) <= 0.01 * 1.05
    np.testing.assert_allclose(end, found.x[-1], atol=4e-3)


@pytest.mark.slow
def test_minimum_energy_input_drives_the_plant_for_the_first_second() -> None:
    """Integrated open loop for 1 s, the state stays on the motion that was found.

    The plant's pole at +8.2 1/s multiplies an early error by 3,600 in that second, and by
    13 million in two: from there on the motion can only be checked piece by piece, as below.
    """
    found = least_energy(0.025, 41.0, 60.0, FINE)
    end = drive(found, found.x[0], 0.0, 1.0)
    np.testing.assert_allclose(end, found.state(1.0), atol=5e-3)
    assert abs(end[1]) < 0.2  # the pendulum was at 0.716 rad


@pytest.mark.slow
@pytest.mark.parametrize("which", ["energy", "swing"])
def test_every_piece_of_the_motion_is_one_of_the_plant(which: str) -> None:
    """From states 0.25 s apart on the motion, u(t) leads to the next one, all the way."""
    moves_as_the_plant(least_energy(0.025, 41.0, 17.0) if which == "energy" else swing())


def moves_as_the_plant(found: Bound) -> None:
    stops = np.linspace(0.0, found.time, 1 + math.ceil(found.time / 0.25))
    for start, end in pairwise(stops):
        reached = drive(found, found.state(start), start, end)
        np.testing.assert_allclose(reached, found.state(end), atol=4e-3)


# -- basins, constraints and guesses ------------------------------------------------------


@pytest.mark.slow
def test_swinging_through_the_bottom_costs_a_twentieth() -> None:
    """The direct optimum is local: another basin is far cheaper, and it is a real motion."""
    found = swing()
    assert "swing" in found.guess
    assert found.cost < least_energy(0.025, 41.0, 17.0).cost / 20
    assert np.abs(found.x[:, 1]).max() > math.pi


@pytest.mark.slow
def test_direct_optimum_is_that_of_all_motions_above_the_horizontal() -> None:
    """With |φ| ≤ 90°, where every stable surface lives, the swing is out and 11.839 stands."""
    rig = pendulum()
    objective = ut.MinimumEnergy(constraints=UPRIGHT)
    x0 = rig.state(phi=ut.deg(41))
    found = bound(rig, objective, x0, horizon=17, swing=True, intervals=60)
    assert found.cost == pytest.approx(least_energy(0.025, 41.0, 17.0).cost, rel=1e-3)


@pytest.mark.slow
def test_active_path_constraint_holds_and_costs() -> None:
    """|θ| ≤ 5 rad, broken by the free optimum, holds at all nodes and raises the cost."""
    rig = pendulum()
    free = least_energy(0.025, 41.0, 17.0)
    assert np.abs(free.x[:, 0]).max() > 5.0
    objective = ut.MinimumEnergy(constraints=ut.state_box(theta=5.0))
    found = bound(rig, objective, rig.state(phi=ut.deg(41)), horizon=17)
    assert np.abs(found.x[:, 0]).max() <= 5.0 + 1e-6
    assert np.abs(found.state(np.linspace(0, 17, 5001))[:, 0]).max() <= 5.0 + 5e-3
    assert found.cost > free.cost * 1.01


@pytest.mark.slow
def test_as_printed_no_input_catches_45_degrees_above_the_horizontal() -> None:
    """d_e = 0.073: 44.5° can be caught within ±15 V, 45° cannot, unless by a swing."""
    rig = pendulum(0.073)
    upright = ut.MinimumTime(constraints=UPRIGHT)
    caught = bound(rig, upright, rig.state(phi=ut.deg(44.5)))
    assert np.abs(caught.x[:, 1]).max() <= math.pi / 2
    moves_as_the_plant(caught)
    x0 = rig.state(phi=ut.deg(45))
    with pytest.raises(InfeasibleError, match="no optimal control found"):
        bound(rig, upright, x0)
    swung = bound(rig, ut.MinimumTime(), x0, swing=True)
    assert np.abs(swung.x[:, 1]).max() > math.pi / 2
    assert swung.time < caught.time  # of least time from lower down, and the other way round
    moves_as_the_plant(swung)
    assert np.abs(bound(rig, ut.MinimumEnergy(), x0, swing=True).x[:, 1]).max() > math.pi / 2


@pytest.mark.slow
def test_simulated_closed_loop_as_guess_costs_no_less_than_the_bound() -> None:
    """A sliding-mode motion is admissible, so it cannot cost less; as a guess it leads there."""
    rig = pendulum()
    x0 = rig.state(phi=ut.deg(41))
    surface = ut.Surface(-1, -2.0, 1.6, 10.0)
    for objective, known in (
        (ut.MinimumEnergy(horizon=17.0), least_energy(0.025, 41.0, 17.0)),
        (ut.MinimumTime(), least_time(0.025, 41.0)),
    ):
        motion = ut.ClosedLoop(rig, objective).simulate(x0, surface)
        assert motion.event is ut.Event.REACHED
        found = bound(rig, objective, x0, guess=motion, intervals=60)
        assert found.cost < motion.cost
        assert found.cost == pytest.approx(known.cost, rel=2e-3)


# -- any n and m --------------------------------------------------------------------------


@pytest.mark.slow
def test_cart_pendulum() -> None:
    """Another mechanism: caught from 30°, checked by integration."""
    plant = cart_pendulum()
    x0 = plant.state(p=ut.deg(30))
    found = bound(plant, ut.MinimumTime(horizon=10.0), x0)
    assert found.status == "optimal"
    np.testing.assert_allclose(drive(found, x0, 0.0, found.time), found.x[-1], atol=1e-3)
    cheap = bound(plant, ut.MinimumEnergy(horizon=10.0), x0)
    assert cheap.time == 10.0
    assert cheap.cost < 20.0**2 * found.time


@pytest.mark.slow
def test_three_coordinates_two_inputs() -> None:
    """n = 3, m = 2: a pendulum between two carts on a spring; each input keeps its limit."""
    s, r, p = ut.Coordinate("s", "m"), ut.Coordinate("r", "m"), ut.Coordinate("p", "rad")
    tip = s.velocity**2 + p.velocity**2 + 2 * s.velocity * p.velocity * sp.cos(p.symbol)
    plant = ut.Mechanism.from_energies(
        "two_carts",
        [s, r, p],
        [ut.Input("left", "N", 12.0), ut.Input("right", "N", 4.0)],
        kinetic=s.velocity**2 / 2 + r.velocity**2 / 2 + sp.Rational(1, 10) * tip,
        potential=4 * (s.symbol - r.symbol) ** 2 + sp.Float(0.2 * 9.81) * sp.cos(p.symbol),
    )
    x0 = plant.state(s=0.2, p=0.3)
    found = bound(plant, ut.MinimumTime(horizon=20.0), x0, intervals=60)
    instants = np.linspace(0, found.time, 5001)
    assert (np.abs(found.input(instants)).max(axis=0) <= np.array([12.0, 4.0]) * (1 + 1e-6)).all()
    np.testing.assert_allclose(drive(found, x0, 0.0, found.time), found.x[-1], atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["acrobot", "ball_and_beam", "double_pendulum_on_a_cart", "gantry_crane"]
)
def test_mechanisms_of_the_library(name: str) -> None:
    """From its usual start each is brought to its target, by an integrator's account too."""
    plant = getattr(ut.mechanisms, name)()
    x0 = plant.state(**plant.start)
    found = bound(plant, ut.MinimumTime(), x0, intervals=200)
    assert (np.abs(found.u) <= plant.input_limits * (1 + 1e-6)).all()
    np.testing.assert_allclose(drive(found, x0, 0.0, found.time), found.x[-1], atol=2e-3)


@pytest.mark.slow
def test_running_cost_that_counts_rest_frees_the_final_time() -> None:
    """Φ = 1 + 0.01 u² is not zero at rest: t_f is free, and the cost above minimum time."""
    rig = pendulum()
    mixed = ut.Objective("mixed", lambda v: 1 + sp.Float(0.01) * v.voltage**2)
    found = bound(rig, mixed, rig.state(phi=ut.deg(41)), intervals=60)
    fastest = least_time(0.025, 41.0)
    assert fastest.time < found.time < 5.0
    assert fastest.cost < found.cost < fastest.cost * (1 + 0.01 * 15.0**2)


@pytest.mark.slow
def test_disturbance_that_depends_on_time_is_met() -> None:
    """A plant with an explicit t in its forces: the motion is one of that plant."""
    plant = linear_plant(5.0).disturbed({"b": sp.sin(3 * ut.models.mechanism.TIME)})
    found = bound(plant, ut.MinimumEnergy(terminal_radius=0.05), [0.5, 0, 0, 0], horizon=3.0)
    end = drive(found, found.x[0], 0.0, found.time)
    np.testing.assert_allclose(end, found.x[-1], atol=1e-5)


# -- expressions --------------------------------------------------------------------------


def test_translation_agrees_with_sympy() -> None:
    """CasADi computes what SymPy means, for every kind of expression that is let through."""
    x, y = sp.symbols("x y", real=True)
    expressions: list[sp.Expr] = [
        sp.sin(x) * sp.cos(y) / (1 + x**2) - sp.sqrt(1 + y**2),
        sp.exp(-x) + sp.tanh(y) * sp.Abs(x) + sp.sign(x - y),
        sp.Min(x, y, 0) + sp.Max(x, 2 * y) + sp.atan2(y, x),
        sp.Piecewise((x, x > y), (y**3, sp.And(x < 0, y > 0)), (sp.pi, True)),
        sp.Rational(1, 3) * x**-2 + sp.E,
    ]
    a, b = ca.SX.sym("a"), ca.SX.sym("b")
    rng = np.random.default_rng(0)
    for expression in expressions:
        value = ca.Function("f", [a, b], [translate(ca, expression, {x: a, y: b})])
        for px, py in rng.normal(size=(15, 2)):
            assert float(value(px, py)) == pytest.approx(
                float(expression.subs({x: px, y: py})), rel=1e-12, abs=1e-12
            )


def test_function_that_cannot_be_translated_is_refused() -> None:
    """A stage cost outside the list is refused by name."""
    rig = pendulum()
    odd = ut.Objective("odd", lambda v: sp.sinc(v.phi) ** 2)
    with pytest.raises(InvalidInputError, match="sinc"):
        bound(rig, odd, rig.state(phi=0.1))


def test_absolute_values_split_into_smooth_margins_that_mean_the_same() -> None:
    """c − |x| − 2|y| ≥ 0 exactly where its four smooth parts are ≥ 0; c + |x| is left alone."""
    x, y = sp.symbols("x y", real=True)
    margin = 1 - sp.Abs(x) - 2 * sp.Abs(y)
    parts = smooth(margin)
    assert len(parts) == 4
    assert not any(part.has(sp.Abs) for part in parts)
    for px, py in np.random.default_rng(1).normal(size=(50, 2)):
        at = {x: px, y: py}
        assert min(float(p.subs(at)) for p in parts) == pytest.approx(float(margin.subs(at)))
    assert smooth(sp.Abs(x) - 1) == [sp.Abs(x) - 1]


# -- refusals -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"x0": [0.0, math.nan, 0.0, 0.0]}, "phi"),
        ({"x0": [0.0, 0.7, 0.0]}, "shape"),
        ({"x0": np.zeros((2, 4))}, "one state"),
        ({"horizon": -1.0}, "horizon"),
        ({"horizon": math.inf}, "horizon"),
        ({"intervals": 3}, "intervals"),
    ],
)
def test_bad_input_is_refused(change: dict[str, Any], message: str) -> None:
    """What cannot be solved is refused with value and limit."""
    rig = pendulum()
    with pytest.raises(InvalidInputError, match=message):
        bound(rig, ut.MinimumEnergy(), **({"x0": rig.state(phi=0.7)} | change))


def test_start_outside_the_constraints_or_the_joint_range_is_refused() -> None:
    """A state that breaks a path constraint, or the travel of a joint, is no start."""
    rig = pendulum()
    boxed = ut.MinimumEnergy(constraints=ut.state_box(phi=0.5))
    with pytest.raises(InvalidInputError, match=r"\|phi\| ≤ 0.5"):
        bound(rig, boxed, rig.state(phi=0.7))
    arm, rod = rig.coordinates
    short = replace(rig, coordinates=(replace(arm, low=-1.0, high=1.0), rod))
    with pytest.raises(InvalidInputError, match="theta"):
        bound(short, ut.MinimumEnergy(), short.state(theta=2.0))


def test_where_the_travel_does_not_count_a_start_may_be_past_it() -> None:
    cart, far = ut.mechanisms.cart_pendulum(), ut.MinimumEnergy(horizon=4.0, travel=False)
    found = bound(cart, far, x=1.6, intervals=20)
    assert found.x[0, 0] == 1.6 > cart.coordinates[0].high


def test_guess_of_another_mechanism_is_refused() -> None:
    """A recorded motion with another number of states is refused before any solve."""
    rig = pendulum()
    zeros = np.zeros((3, 1))
    other = ut.Trajectory(
        rig, np.arange(3.0), np.zeros((3, 6)), zeros, zeros, zeros[:, 0], zeros[:, 0], ut.Event(1)
    )
    with pytest.raises(InvalidInputError, match="6 states"):
        bound(rig, ut.MinimumEnergy(), rig.state(phi=0.7), guess=other)


def test_impulse_is_refused() -> None:
    """Least time with an unlimited input has no optimum: the input must be limited or paid."""
    with pytest.raises(InvalidInputError, match=r"'force'.*with_input_limit"):
        bound(linear_plant(), ut.MinimumTime(), [1.0, 0, 0, 0])


def test_task_beyond_the_actuator_is_infeasible() -> None:
    """1 V cannot catch 41°: said so, with each guess and a remedy."""
    rig = pendulum().with_input_limit(1.0)
    objective = ut.MinimumEnergy(constraints=UPRIGHT)
    with pytest.raises(InfeasibleError, match=r"exponential decay.*guess="):
        bound(rig, objective, rig.state(phi=ut.deg(41)), horizon=3.0, intervals=40)


def test_degrees_that_are_taken_for_radians_are_pointed_out() -> None:
    words = r"40 rad is 2292°.*undertow\.deg\(40\)"
    with pytest.raises(InfeasibleError, match=words), pytest.warns(UserWarning, match=words):
        bound(pendulum(), ut.MinimumTime(), horizon=0.5, intervals=10, phi=40.0)


def test_start_inside_the_terminal_set_costs_nothing() -> None:
    """‖x₀‖ ≤ ν: the answer is 0 at once, with the same fields."""
    rig = pendulum()
    found = bound(rig, ut.MinimumTime(), rig.state(phi=0.005))
    assert (found.cost, found.time, found.iterations) == (0.0, 0.0, 0)
    assert found.state([0.0, 1.0]).shape == (2, 4)
    assert found.input(0.5).shape == (1,)


def test_without_casadi_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """No CasADi: one line that says what to install."""
    monkeypatch.setitem(sys.modules, "casadi", None)
    rig = pendulum()
    with pytest.raises(MissingExtraError, match=r"undertow\[bounds\]"):
        bound(rig, ut.MinimumTime(), rig.state(phi=0.7))


@pytest.mark.slow
def test_solver_is_silent_and_repeatable(capfd: pytest.CaptureFixture[str]) -> None:
    """Nothing is printed, and the same question has bit for bit the same answer."""
    first, second = (
        bound(linear_plant(), ut.MinimumEnergy(), [1.0, 0, 0, 0], horizon=3.0) for _ in range(2)
    )
    assert capfd.readouterr() == ("", "")
    np.testing.assert_array_equal(first.u, second.u)
    np.testing.assert_array_equal(first.x, second.x)


@pytest.mark.parametrize("where", ["cost", "jump", "constraint", "force"])
def test_what_has_kinks_has_no_bound(where: str) -> None:
    """Claim: of a cost of 1 + sign(phi), IPOPT, to which its slope is 0, calls anything optimal."""
    rig = ut.mechanisms.cart_pendulum()
    widest = ut.Constraint("the wider", lambda v: sp.Max(v.phi, -v.x) - 0.3)
    energy = ut.MinimumEnergy(horizon=3.0)
    problem = {
        "cost": ut.Objective("modulus", lambda v: sp.Abs(v.force), horizon=3.0),
        "jump": ut.Objective("jump", lambda v: 1 + sp.sign(v.phi), horizon=3.0),
        "constraint": replace(energy, constraints=(widest,)),
    }
    if where == "force":
        rig = rig.disturbed({"phi": sp.Max(rig.q[1] - 0.1, 0)})
    with pytest.raises(ModelError, match="not smooth"):
        bound(rig, problem.get(where, energy), rig.state(phi=0.2))
