"""Motions to a tolerance: beside SciPy on the plain formulas, with corners and ends located."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import sympy as sp
from scipy.integrate import solve_ivp
from scipy.optimize import brentq, minimize_scalar

import undertow as ut
from support import derivative, interpreted
from undertow.base import InvalidInputError
from undertow.closed_loop import Event
from undertow.closed_loop.adaptive_integrator import BETWEEN, ERROR, LEAST, STAGES, WHEN
from undertow.closed_loop.buffers import RolloutBuffers
from undertow.law import Plan
from undertow.mechanisms import LIBRARY
from undertow.models import FloatArray
from undertow.objective import objective_for

FOLDER = Path(__file__).parents[2] / "benchmarks"

#: One that swings by the target once before it settles there.
PASSING = ut.Surface(-1, -3.688, 1.361, 9.052)


#: A rooted tree, by the trees that grow from its root.
Tree = tuple["Tree", ...]


def forests(size: int, *, largest: int) -> list[Tree]:
    """All sets of rooted trees with so many nodes together, none with more than ``largest``."""
    if size == 0:
        return [()]
    return [
        (first, *rest)
        for nodes in range(min(size, largest), 0, -1)
        for first in forests(nodes - 1, largest=nodes - 1)
        for rest in forests(size - nodes, largest=nodes)
        if not rest or nodes_of(rest[0]) < nodes or rest[0] <= first
    ]


def nodes_of(tree: Tree) -> int:
    return 1 + sum(map(nodes_of, tree))


def density(tree: Tree) -> int:
    return nodes_of(tree) * math.prod(map(density, tree))


def elementary(tree: Tree) -> FloatArray:
    """What the stages make of the elementary differential of a tree, (7,)."""
    A = np.hstack([STAGES, np.zeros((7, 1))])
    return math.prod((A @ elementary(branch) for branch in tree), start=np.ones(7))


def test_the_step_its_error_and_what_is_between_have_their_orders() -> None:
    """Butcher's conditions, tree by tree: 5 for the step, 4 for its companion and the interpolant.

    The error tells one order from the other; the interpolant has the slopes of its ends.
    """
    counts = [len(forests(nodes - 1, largest=nodes)) for nodes in range(1, 6)]
    assert counts == [1, 1, 2, 4, 9]
    step, errors = np.append(STAGES[-1], 0.0), []
    for tree in (tree for nodes in range(5) for tree in forests(nodes, largest=nodes)):
        weights, nodes = elementary(tree), nodes_of(tree)
        assert step @ weights == pytest.approx(1 / density(tree), rel=1e-13)
        errors.append((nodes, abs(float(ERROR @ weights))))
        for part in (0.2, 0.5, 1.0) if nodes < 5 else ():
            between = BETWEEN @ part ** np.arange(1, 5)
            assert between @ weights == pytest.approx(part**nodes / density(tree), rel=1e-12)
    assert max(error for nodes, error in errors if nodes < 5) < 1e-15
    assert max(error for nodes, error in errors if nodes == 5) > 1e-5
    np.testing.assert_allclose(elementary(((),)), WHEN, rtol=1e-14)
    np.testing.assert_array_equal(BETWEEN[:, 0], np.eye(7)[0])
    np.testing.assert_allclose(BETWEEN @ np.arange(1, 5), np.eye(7)[6], atol=1e-12)


@pytest.fixture
def accuracy(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The benchmark with the reference."""
    monkeypatch.syspath_prepend(str(FOLDER))
    import accuracy

    return accuracy


@pytest.mark.slow
@pytest.mark.parametrize("name", ["rotary_pendulum", "pendubot", "two_motor_three_link"])
def test_motions_agree_with_a_reference_that_shares_no_code(
    accuracy: ModuleType, name: str
) -> None:
    """To 1e-7 where 1e-5 is wanted; steps of 2 ms are a hundred times as far off."""
    rig = LIBRARY[name]()
    goal = ut.MinimumEnergy(horizon=30.0, terminal_radius=0.05)
    case = accuracy.Case(name, rig, goal, rig.usual_start, Plan.of(ut.first_surface(rig)))
    exact = accuracy.Reference(case).motion(rtol=1e-11)
    assert exact.reached
    fine, coarse = (
        accuracy.errors(accuracy.simulated(case, rtol=rtol)[0], exact) for rtol in (1e-9, 0.0)
    )
    assert max(fine.cost, fine.time) <= 1e-7
    assert fine.state <= 1e-6
    assert max(coarse.cost, coarse.time) >= 100 * max(fine.cost, fine.time)


@pytest.mark.slow
@pytest.mark.parametrize("goal", ["energy", "time"])
@pytest.mark.parametrize("name", LIBRARY)
def test_every_mechanism_is_simulated_to_five_digits(
    accuracy: ModuleType, name: str, goal: str
) -> None:
    """Cost and arrival of the cascade's first plan at default settings within 1e-5, relative."""
    rig = LIBRARY[name]()
    cascade = ut.Cascade(rig, objective_for(rig, goal), belief="exact")
    plan = cascade.start(rig.usual_start)[0].plan
    case = accuracy.Case(name, rig, cascade.objective, rig.usual_start, plan)
    exact = accuracy.Reference(case).motion()
    assert exact.reached
    found = accuracy.errors(cascade.loop.simulate(rig.usual_start, plan), exact)
    assert max(found.cost, found.time) <= 1e-5
    assert found.state <= 1e-4


@pytest.mark.slow
def test_the_tolerance_is_a_dial(accuracy: ModuleType, rig: ut.Mechanism) -> None:
    """A thousandth of the tolerance is at most a hundredth of the error."""
    case = accuracy.Case("dial", rig, ut.MinimumTime(), rig.state(phi=0.7), Plan.of(PASSING))
    exact = accuracy.Reference(case).motion(rtol=1e-11)
    assert exact.reached
    errors = [
        accuracy.errors(accuracy.simulated(case, rtol=rtol)[0], exact).time
        for rtol in (1e-4, 1e-7, 1e-10)
    ]
    assert errors[1] <= 0.01 * errors[0]
    assert errors[2] <= max(0.01 * errors[1], 1e-9)


@pytest.mark.slow
def test_a_motion_that_dips_into_the_terminal_set_has_arrived(
    accuracy: ModuleType, rig: ut.Mechanism
) -> None:
    """With a radius a millionth above the nearest pass at the pass; a millionth below, later."""
    x0, plan = rig.state(phi=ut.deg(40)), Plan.of(PASSING)
    loop = ut.ClosedLoop(rig, ut.MinimumTime())
    whole = loop.simulate(x0, plan, terminal=1e-3)
    radii = np.linalg.norm(whole.x, axis=1)
    turns = (radii[1:-1] < radii[:-2]) & (radii[1:-1] < radii[2:]) & (radii[1:-1] < 0.02)
    first = np.flatnonzero(turns)[0] + 1
    assert whole.time > whole.t[first] + 0.1

    low, high = 0.9 * radii[first], 1.1 * radii[first]
    for _ in range(30):
        middle = 0.5 * (low + high)
        passes = loop.simulate(x0, plan, terminal=middle).time < whole.t[first] + 0.01
        low, high = (low, middle) if passes else (middle, high)
    outer, inner = float(high * (1 + 1e-6)), float(low * (1 - 1e-6))
    above, below = (loop.simulate(x0, plan, terminal=radius).time for radius in (outer, inner))
    goal = ut.MinimumTime(terminal_radius=inner)
    exact = accuracy.Reference(accuracy.Case("dip", rig, goal, x0, plan)).motion(rtol=1e-10)

    def beyond(t: float) -> float:
        return float(np.linalg.norm(exact.states([t])[0])) - outer

    around = whole.t[first] - 0.003, whole.t[first] + 0.003
    nearest = minimize_scalar(beyond, bounds=around, method="bounded", options={"xatol": 1e-9}).x
    assert above == pytest.approx(brentq(beyond, around[0], nearest), rel=1e-5)
    assert below > above + 0.01
    assert below == pytest.approx(exact.time, rel=1e-5)


def test_a_dip_before_a_corner_is_seen_from_wherever_the_motion_goes_on() -> None:
    """A mast of 20 m is in the terminal set for 0.26 ms; then its law reaches a corner.

    Begun anew on its way it arrives when it was to, whatever the steps are: Lemma 3 needs that.
    """
    x, a = ut.Coordinate("x", "m"), ut.Coordinate("a", "rad")
    v, w = x.velocity, a.velocity
    mast = ut.Mechanism.from_energies(
        "mast", [x, a], [ut.Input("force", "N", 58860.0)],
        kinetic=4000 * v**2 + 2e4 * sp.cos(a.symbol) * v * w + sp.Rational(2, 3) * 2e5 * w**2,
        potential=196200 * sp.cos(a.symbol),
    )  # fmt: skip
    loop = ut.ClosedLoop(mast, ut.MinimumTime(horizon=30.0))
    x0 = [4.7664312914, -0.1861452348, -1.6793983301, 0.0693800483]
    surface = ut.Surface(-1, -0.409293966, -16.1867988, -21.3750603)
    whole = loop.simulate(x0, surface)
    assert whole.event == Event.REACHED
    times = [
        whole.t[k] + loop.simulate(whole.x[k], surface).time for k in range(1, len(whole.t) - 2, 50)
    ]
    assert len(times) > 20
    np.testing.assert_allclose(times, whole.time, atol=1e-6)


def test_the_end_of_a_motion_is_located(rig: ut.Mechanism) -> None:
    """Arrival on the sphere, the singular angle and the end of the travel, to nine digits."""
    loop = ut.ClosedLoop(rig, ut.MinimumTime())
    run = loop.simulate(rig.state(phi=0.5), PASSING)
    assert run.event == Event.REACHED
    assert np.linalg.norm(run.x[-1]) == pytest.approx(0.01, rel=1e-9)
    base = ut.Surface(-1, -0.5, 5, 10)
    lost = loop.simulate(rig.state(phi=math.radians(70), phi_dot=6.0), base, duration=2.0)
    assert lost.event == Event.SINGULAR
    M = rig.M([0, 0])
    assert lost["phi"][-1] == pytest.approx(math.acos(-M[1, 1] / (M[0, 1] * 5.0)), abs=1e-9)
    cart = LIBRARY["cart_pendulum"]()
    x0 = cart.state(x=1.40, x_dot=1.0)
    out = ut.ClosedLoop(cart).simulate(x0, ut.first_surface(cart))
    assert out.event == Event.CONSTRAINT
    assert out["x"][-1] == pytest.approx(1.425 * (1 + 1e-4), abs=1e-9)  # what is allowed
    assert out["x"][-1] > out["x"][:-1].max()


def test_a_bound_that_is_broken_between_two_steps_is_noticed() -> None:
    """Recorded or not, by rows of 2 ms or of 50: no part of a motion lies 1 mm outside."""
    cart = LIBRARY["cart_pendulum"]()
    x0, surface = cart.state(phi=0.3), ut.first_surface(cart)
    free = ut.ClosedLoop(cart, ut.MinimumEnergy(travel=False), rtol=1e-6).simulate(x0, surface)
    most = float(np.abs(free["x"]).max())
    bound = ut.state_box(x=most - 1e-3)
    loop = ut.ClosedLoop(cart, ut.MinimumEnergy(constraints=bound), rtol=1e-6)
    for every in (1, 25):
        assert loop.simulate(x0, surface, every=every).event == Event.CONSTRAINT
    assert loop.batch(x0, surface, precise=True).event[0] == Event.CONSTRAINT


def test_held_inputs_move_a_plant_that_is_pushed_about(rig: ut.Mechanism) -> None:
    """A sampled law on a belief that is wrong, beside SciPy from sample to sample."""
    truth = rig.with_parameters(m=0.15, d_e=0.04)
    loop = ut.ClosedLoop(rig, plant=truth, zoh_steps=4)
    x = rig.state(phi=0.4, theta=0.1)
    noise = np.random.default_rng(6).normal(0, 2e-3, (25, 4))
    run = loop.simulate(x, PASSING, duration=0.2, terminal=0.0, noise=noise)
    law = ut.SlidingModeLaw(rig, PASSING)
    for k in range(25):
        u = law(0.0, x + noise[k]).u
        np.testing.assert_allclose(run.u[4 * k : 4 * k + 4], np.tile(u, (4, 1)), rtol=1e-6)
        x = solve_ivp(
            lambda t, x: derivative(truth, t, x, u),  # noqa: B023
            (0, 0.008), x, method="DOP853", rtol=1e-12, atol=1e-13,
        ).y[:, -1]  # fmt: skip
    np.testing.assert_allclose(run.x[-1], x, atol=1e-7)


def test_a_motion_to_a_tolerance_is_the_same_each_time(rig: ut.Mechanism) -> None:
    """Whoever asks, with whom, and however often rows are recorded."""
    x0 = rig.state(phi=0.6)
    loops = [ut.ClosedLoop(rig, ut.MinimumEnergy()) for _ in range(2)]
    runs = [loop.simulate(x0, PASSING) for loop in loops]
    np.testing.assert_array_equal(runs[0].x, runs[1].x)
    batch = loops[0].batch(x0, [PASSING, ut.first_surface(rig), PASSING], precise=True)
    assert {runs[0].cost} == {batch.cost[0], batch.cost[2]}
    assert loops[0].simulate(x0, PASSING, every=10).time == runs[0].time == batch.time[0]


def test_a_motion_ends_before_a_surface_that_takes_over_later(rig: ut.Mechanism) -> None:
    """A plan's first piece alone is the same with the rest of the plan and without it."""
    x0, loop = rig.state(phi=0.3), ut.ClosedLoop(rig, ut.MinimumEnergy())
    plan = Plan((PASSING, ut.first_surface(rig)), (0.0, 30.0))
    piece, alone = (loop.simulate(x0, what, duration=0.1) for what in (plan, PASSING))
    assert piece.time == alone.time == pytest.approx(0.1)
    np.testing.assert_array_equal(piece.x, alone.x)


def test_fixed_steps_remain_for_those_who_want_them(rig: ut.Mechanism) -> None:
    """``rtol=0`` simulates as batches do; what cannot be asked is refused."""
    x0 = rig.state(phi=0.4)
    loop = interpreted(ut.ClosedLoop(rig, rtol=0.0))
    run, batch = loop.simulate(x0, PASSING, duration=0.05), loop.batch(x0, PASSING, duration=0.05)
    assert run.cost == batch.cost[0]
    np.testing.assert_array_equal(loop.batch(x0, PASSING, duration=0.05, precise=True).x, batch.x)
    with pytest.raises(InvalidInputError, match="precise=True and seek=True"):
        ut.ClosedLoop(rig).batch(x0, PASSING, precise=True, seek=True)
    with pytest.raises(InvalidInputError, match=r"rtol of a closed loop.*-1"):
        ut.ClosedLoop(rig, rtol=-1.0)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cart_pendulum"])
def test_a_first_plan_does_what_it_promises(accuracy: ModuleType, name: str) -> None:
    """Least time, from a search in steps of 2 ms: the optimiser's own answer and a cascade's."""
    rig = LIBRARY[name]()
    cascade = ut.Cascade(rig, objective_for(rig, "time"), belief="exact")
    answer = cascade.optimiser.require(rig.usual_start)
    state, proposal = cascade.start(rig.usual_start)
    case = accuracy.Case(name, rig, cascade.objective, rig.usual_start, answer.plan)
    for plan, promised in ((answer.plan, answer.cost), (state.plan, state.predicted)):
        exact = accuracy.Reference(replace(case, plan=plan)).motion()
        assert exact.reached
        assert exact.cost == pytest.approx(promised, rel=1e-5)
        assert exact.cost <= 1.01 * proposal.cost


@pytest.mark.parametrize("settings", [{}, {"rtol": 0.0}, {"zoh_steps": 3}])
@pytest.mark.parametrize("duration", [0.0335, 0.0007, 0.02 + 0.01])
def test_a_motion_ends_when_it_was_asked_to(
    rig: ut.Mechanism, settings: dict[str, float], duration: float
) -> None:
    """Not at the last whole step; beside SciPy on the formulas, held inputs sample by sample."""
    loop = ut.ClosedLoop(rig, **settings)  # type: ignore[arg-type]
    loop = loop if loop.adapts else interpreted(loop)
    x = rig.state(phi=0.4, theta_dot=-1.0)
    run = loop.simulate(x, PASSING, duration=duration, terminal=0.0)
    assert run.time == pytest.approx(duration, abs=1e-15)
    assert (np.diff(run.t) > 1e-9).all()
    law, held = ut.SlidingModeLaw(rig, PASSING), 0.002 * loop.zoh_steps
    begins = np.arange(0.0, duration - 1e-9, held) if held else [0.0]
    for begin in begins:
        end = min(begin + held, duration) if held else duration
        u = law(0.0, x).u

        def rate(t: float, x: np.ndarray, u: np.ndarray = u) -> np.ndarray:
            return derivative(rig, t, x, u if held else law(t, x).u)

        x = solve_ivp(rate, (begin, end), x, "DOP853", rtol=1e-11, atol=1e-12).y[:, -1]
    tolerance = 1e-8 if loop.adapts else 1e-5  # steps of one length see no corner
    np.testing.assert_allclose(run.x[-1], x, atol=tolerance)


def test_a_duration_near_a_whole_number_of_steps_is_one(rig: ut.Mechanism) -> None:
    """Rounding makes no step of its own; a part of a step does, and shortens all where they are
    equal."""
    loop = ut.ClosedLoop(rig)
    assert loop.equal_steps(0.1 + 0.2) == (150, 0.002)
    assert loop.equal_steps(0.0) == (0, 0.002)
    count, step = loop.equal_steps(0.333)
    assert count == 167
    assert count * step == pytest.approx(0.333, abs=1e-15)


@pytest.mark.parametrize("rtol", [1e-300, 1e-14, 0.1, math.inf, math.nan, -1e-9])
def test_tolerances_that_no_step_can_keep_are_refused(rig: ut.Mechanism, rtol: float) -> None:
    """Below rounding the first motion never ended; at 1 it went through what it was to see."""
    with pytest.raises(InvalidInputError, match=r"rtol of a closed loop.*1e-13 to 0\.01"):
        ut.ClosedLoop(rig, rtol=rtol)


def test_no_step_is_shorter_than_a_part_of_the_loops(rig: ut.Mechanism) -> None:
    """Whatever is asked for: below rounding each step would be a part of the one before."""
    loop = ut.ClosedLoop(rig)
    object.__setattr__(loop, "rtol", 1e-20)
    run = loop.batch(rig.state(phi=0.4), PASSING, duration=0.004, terminal=0.0, precise=True)
    assert run.time == 0.004
    assert run.steps[0] <= 2 / LEAST + 16  # two steps of the loop, and what was tried at first


def test_what_noise_costs_is_counted_of_motions_alone(rig: ut.Mechanism) -> None:
    """Lanes that stand for none hold what was in memory before: no warning comes of them."""
    loop, x = ut.ClosedLoop(rig, covariance=1e-8 * np.eye(4)), rig.state(phi=0.1)
    buffers = RolloutBuffers(loop, 1, 1).fill(x, PASSING.vector)
    buffers.out[:, 0], buffers.out[:, 1] = -math.inf, math.inf
    with np.errstate(invalid="raise"):
        motion = loop.roll_out(buffers, (0.0,), 0.1, precise=True)
    alone = loop.batch(x, PASSING, duration=0.1, precise=True)
    quiet = ut.ClosedLoop(rig).batch(x, PASSING, duration=0.1, precise=True)
    assert motion.cost[0] == alone.cost[0] > quiet.cost[0]


@pytest.mark.parametrize(
    ("covariance", "word"),
    [
        (np.eye(3), "shape"),
        (-np.eye(4), "eigenvalue -1"),
        (np.triu(np.ones((4, 4))), "not symmetric"),
        (np.eye(4) + 1e-4 * np.eye(4, k=1), "not symmetric"),
        (np.diag([1.0, 1.0, 1.0, math.nan]), "NaN"),
    ],
)
def test_what_is_no_covariance_is_refused(
    rig: ut.Mechanism, covariance: np.ndarray, word: str
) -> None:
    """A negative one made costs negative, one of another shape broke off within a search."""
    for make in (ut.ClosedLoop, ut.Cascade):
        with pytest.raises(InvalidInputError, match=f"covariance.*{word}"):
            make(rig, covariance=covariance)
    for fine in (np.zeros((4, 4)), np.eye(4) + 1e-15 * np.eye(4, k=1)):  # rounded, as sums are
        assert ut.ClosedLoop(rig, covariance=fine).covariance is not None


@pytest.mark.parametrize(
    ("wrong", "word"),
    [
        ({"terminal": -1.0}, "terminal of a motion"),
        ({"terminal": math.nan}, "terminal of a motion"),
        ({"start": math.nan}, "start of a motion"),
    ],
)
def test_a_motion_with_no_clock_or_radius_is_refused(
    rig: ut.Mechanism, wrong: dict[str, float], word: str
) -> None:
    """It went on past the target, or had NaN for its times."""
    with pytest.raises(InvalidInputError, match=word):
        ut.ClosedLoop(rig).simulate(rig.state(phi=0.3), PASSING, **wrong)  # type: ignore[arg-type]
