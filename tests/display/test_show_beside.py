"""What is shown beside a motion: bounds, maps of what comes home, and plants that are plausible."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import undertow as ut
from runs import short_searches
from undertow.base import InvalidInputError
from undertow.display.live import Message
from undertow.display.sketches import sketch
from undertow.estimators import Belief
from undertow.law import ReachingLaw, first_surface
from undertow.runtime import InlineWorker
from undertow.studies.live import Simulation
from undertow.studies.live.beside import (
    HOME,
    LIMITED,
    LOST,
    SIDE,
    Beside,
    MapAsked,
    bounds_of,
    cost_to_go,
    maps_of,
)
from undertow.studies.live.messages import plausible
from undertow.studies.live.planner import Task, cascade_for, planner

RIG = ut.mechanisms.rotary_pendulum(d_e=0.025)
TASK = Task("bench-energy", tuple(RIG.input_limits.tolist()), 0.1)
TICK = 1.0 / 60.0
COMPUTE, MAPS = planner(RIG), maps_of(RIG)


class Now:
    """Answers at once, and remembers what it was asked."""

    def __init__(self, compute: Callable[[Any], Message]) -> None:
        self.compute, self.asked, self.answers = compute, list[Any](), list[Message]()

    def ask(self, request: Any) -> None:
        self.asked.append(request)
        self.answers.append(self.compute(request))

    def take(self, t: float) -> Message | None:
        return self.answers.pop(0) if self.answers else None

    def replace(self) -> bool:
        return False

    def close(self) -> None:
        pass


def question(reach: tuple[float, float] = (1.2, 8.0), **changed: Any) -> MapAsked:
    parts: dict[str, Any] = {
        "t": 0.0, "task": TASK, "parameters": RIG.parameter_values, "surface": first_surface(RIG),
        "reaching": ReachingLaw(), "x": np.zeros(4), "goal": np.zeros(2), "axis": 1,
    }  # fmt: skip
    return MapAsked(**(parts | changed), reach=reach)


@pytest.mark.slow
def test_cells_of_a_map_are_what_scipy_finds() -> None:
    """Home and lost, and where the law asks for more than the limit: 12 cells integrated by SciPy
    with the law evaluated by itself."""
    asked = question()
    drawn = MAPS(asked)
    cells = np.array([int(c) for c in drawn["cells"]]).reshape(SIDE, SIDE)
    assert {LOST, LIMITED, HOME} == set(cells.ravel().tolist())
    assert cells[SIDE // 2, SIDE // 2] == HOME  # it is at the target
    law = ut.SlidingModeLaw(RIG, asked.surface, asked.reaching)
    middle = (np.arange(SIDE) + 0.5) * 2.0 / SIDE - 1.0
    radius = cascade_for(RIG, TASK).objective.terminal_radius

    def rate(t: float, x: np.ndarray) -> np.ndarray:
        return np.concatenate([x[2:], RIG.accelerations(t, x, law(t, x).u)])

    def arrives(t: float, x: np.ndarray) -> float:
        return float(np.linalg.norm(x)) - radius

    def leaves(t: float, x: np.ndarray) -> float:
        return 30.0 - float(np.linalg.norm(x))

    arrives.terminal = leaves.terminal = True  # type: ignore[attr-defined]
    rng = np.random.default_rng(1)
    for row, column in rng.integers(0, SIDE, (12, 2)):
        x0 = np.array([0.0, 1.2 * middle[column], 0.0, 8.0 * middle[row]])
        found = solve_ivp(
            rate, (0, 20), x0, "LSODA", rtol=1e-7, atol=1e-9, events=[arrives, leaves]
        )
        home = bool(
            np.linalg.norm(found.y[:, -1]) <= 1.001 * radius or np.linalg.norm(x0) <= radius
        )
        assert (cells[row, column] != LOST) == home, (row, column)
        if home:
            limited = abs(float(law(0.0, x0).demand[0])) > RIG.input_limits[0]
            assert (cells[row, column] == LIMITED) == limited


def test_a_smaller_limit_brings_less_home() -> None:
    """The map is of the limits in force."""

    def home(volts: float) -> int:
        task = Task(TASK.objective, (volts,), 0.1)
        return sum(c != "0" for c in MAPS(question(task=task))["cells"])

    assert home(4.0) < home(15.0)


def test_the_proved_set_of_a_map_keeps_what_is_in_it() -> None:
    """States on the rim of {|W x| ≤ 1} go inwards: the rate of |W x|² is negative there."""
    W = np.array(MAPS(question())["proved"])
    law = ut.SlidingModeLaw(RIG, first_surface(RIG), ReachingLaw())
    for way in np.random.default_rng(0).normal(size=(200, 4)):
        x = np.linalg.solve(W, way / np.linalg.norm(way))
        rate = np.concatenate([x[2:], RIG.accelerations(0.0, x, law(0.0, x).u)])
        assert (W @ x) @ (W @ rate) < 0


@pytest.mark.slow
def test_what_a_bound_leaves_falls_from_its_cost_to_nothing() -> None:
    """By Simpson's rule over its own motion; a trapezium of many points says the same."""
    pytest.importorskip("casadi")
    objective = cascade_for(RIG, TASK).objective
    found = ut.bound(RIG, objective, RIG.usual_start, intervals=50)
    left = cost_to_go(found, objective)
    assert left[0] == found.cost
    assert (np.diff(left) <= 1e-12).all()
    assert left[-1] < 1e-3 * found.cost
    t = np.linspace(0.0, 0.3, 20_001)
    x, u = found.state(t), found.input(t)
    paid = np.trapezoid((u**2).sum(1) + 0.05 * (x**2).sum(1), t)
    assert found.cost - np.interp(0.3, found.t, left) == pytest.approx(paid, rel=5e-3)
    said = bounds_of(RIG)(
        type("Asked", (), {"t": 1.0, "task": TASK, "parameters": RIG.parameter_values,
                           "x": RIG.usual_start})()
    )  # fmt: skip
    assert said["cost"] == pytest.approx(found.cost, rel=1e-6)
    assert said["times"][0] == 1.0


def test_the_ensemble_closes_in_on_what_moves() -> None:
    """Every parameter's members span its tolerance at first, and less once it has been seen."""
    belief = Belief.usual(RIG)
    before = plausible(belief, None)
    assert [row["name"] for row in before] == list(belief.tolerances)
    loop = ut.ClosedLoop(RIG, ut.MinimumEnergy(horizon=2.0))
    motion = loop.simulate(RIG.usual_start, first_surface(RIG))
    after = plausible(belief, belief.learn(belief.prior, motion.t, motion.x, motion.u))
    spans = [[np.ptp(row["members"]) for row in rows] for rows in (before, after)]
    assert sum(spans[1]) < 0.8 * sum(spans[0])
    for row in before:
        assert min(row["members"]) < row["estimate"] < max(row["members"])
        assert row["low"] < row["estimate"] < row["high"]
    assert plausible(None, None) == []


@pytest.fixture
def looked_at() -> Iterator[tuple[Simulation, Now, Now]]:
    bounds = Now(lambda asked: {"kind": "bound", "t": asked.t, "cost": 1.0, "why": "",
                                "times": [asked.t], "left": [1.0]})  # fmt: skip
    maps = Now(MAPS)
    made = Simulation(
        RIG, sketch(RIG), worker=InlineWorker(COMPUTE, latency=0.0), beside=Beside(bounds, maps)
    )
    made.ready.result(120)
    with short_searches():
        yield made, bounds, maps


def go(simulation: Simulation, seconds: float) -> list[Message]:
    return [m for _ in range(round(seconds / TICK)) for m in simulation.advance(TICK)]


@pytest.mark.slow
def test_a_page_is_told_of_bound_and_region(looked_at: tuple[Simulation, Now, Now]) -> None:
    """The bound is from where the task began; a map is drawn of the plane that is looked at, as
    the surface jumps; a push ends the bound, and who comes later is told both."""
    simulation, bounds, maps = looked_at
    go(simulation, 0.3)
    assert not maps.asked  # nobody looks
    simulation.hear({"do": "look", "axis": 1, "reach": [0.7, 5.0]}, 1)
    said = go(simulation, 2.0)
    assert len(bounds.asked) == 1
    assert bounds.asked[0].x == pytest.approx(RIG.usual_start, abs=0.05)
    drawn = [m for m in said if m["kind"] == "region"]
    assert 2 <= len(drawn) <= 6
    assert drawn[-1]["axis"] == 1
    assert maps.asked[-1].x == pytest.approx(simulation.rig.truth, abs=0.5)
    kinds = {m["kind"]: m for m in simulation.hello()["beside"]}
    assert kinds["bound"]["cost"] == 1.0
    assert kinds["region"] == drawn[-1]
    simulation.hear({"do": "push", "side": 1}, 1)
    ended = [m for m in go(simulation, 0.1) if m["kind"] == "bound"]
    assert [m["cost"] for m in ended] == [None]
    simulation.hear({"do": "reset"}, 1)
    assert simulation.hello()["beside"] == []
    assert [m["cost"] for m in go(simulation, 0.3) if m["kind"] == "bound"] == [1.0]


def test_a_map_that_took_long_at_first_is_soon_drawn_again() -> None:
    """What it had to compile once is not waited for again: within seconds there is another."""

    class Slow(Now):
        def take(self, t: float) -> Message | None:
            return super().take(t) if t >= 60.0 else None

    maps = Slow(lambda asked: {"kind": "region"})
    looked = Beside(None, maps)
    clock = 0.0
    while clock < 65.0:
        looked.take(clock)
        looked.draw(clock, lambda: question(x=np.full(4, clock)))  # noqa: B023 - called at once
        clock += TICK
    assert 2 <= len(maps.asked) <= 20


def test_a_map_is_drawn_again_for_another_reaching_law() -> None:
    """As a plan in reserve has it, whose surface may be that of the plan in use."""
    maps = Now(lambda asked: {"kind": "region"})
    looked = Beside(None, maps)
    for clock, law in enumerate((ReachingLaw(), ReachingLaw(), ReachingLaw(80.0, 0.4))):
        looked.draw(10.0 * clock, lambda: question(reaching=law))  # noqa: B023 - called at once
        looked.take(10.0 * clock)
    assert [asked.reaching for asked in maps.asked] == [ReachingLaw(), ReachingLaw(80.0, 0.4)]


@pytest.mark.slow
def test_a_map_about_a_target_keeps_within_the_travel() -> None:
    """What begins past the end of the rail, 95 % of 1.5 m, is lost wherever the target is."""
    cart = ut.mechanisms.cart_pendulum()
    asked = question(
        (1.7, 0.1), task=Task("bench-energy", (20.0,), 0.1), parameters=cart.parameter_values,
        surface=first_surface(cart), goal=np.array([1.0, 0.0]), x=np.zeros(4), axis=0,
    )  # fmt: skip
    row = np.array([int(c) for c in maps_of(cart)(asked)["cells"]]).reshape(SIDE, SIDE)[SIDE // 2]
    place = 1.7 * ((np.arange(SIDE) + 0.5) * 2.0 / SIDE - 1.0)
    assert (row[np.abs(place) > 0.95 * 1.5] == LOST).all()
    assert row[np.argmin(np.abs(place - 1.0))] == HOME


def test_a_plane_that_is_none_is_refused(looked_at: tuple[Simulation, Now, Now]) -> None:
    no_axis = ((axis, [1, 1]) for axis in (2, 0.5, "0"))
    no_reach = ((0, reach) for reach in ([1], [0, 1], [1, 1e9], None))
    for axis, reach in (*no_axis, *no_reach):
        with pytest.raises(InvalidInputError):
            looked_at[0].hear({"do": "look", "axis": axis, "reach": reach}, 1)


def test_a_page_that_was_held_up_is_told_what_moved_meanwhile(
    looked_at: tuple[Simulation, Now, Now],
) -> None:
    """A tenth of a second late, there are pictures of it, a sixtieth apart."""
    simulation = looked_at[0]
    go(simulation, 0.3)
    frames = [m["t"] for m in simulation.advance(0.1) if m["kind"] == "frame"]
    assert len(frames) >= 4
    assert np.diff(frames).max() < 2.1 * TICK
