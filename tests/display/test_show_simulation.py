"""The cascade on the live page, in simulated time: what moves, what pokes it, what is refused."""

from __future__ import annotations

import math
import pickle
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest
import sympy as sp
from scipy.integrate import solve_ivp

import undertow as ut
from runs import short_searches
from undertow.base import InvalidInputError
from undertow.display.live import Message
from undertow.display.sketches import sketch
from undertow.runtime import Answer, InlineWorker, Request
from undertow.studies.live import Simulation, of_run
from undertow.studies.live.controls import controls_of
from undertow.studies.live.planner import Task, cascade_for, planner

RIG = ut.mechanisms.rotary_pendulum(d_e=0.025)
TICK = 1.0 / 60.0


class Deferred:
    """Hands out answers when the test says so."""

    def __init__(self, compute: Callable[[Request], Answer]) -> None:
        self.compute, self.asked, self.answers = compute, list[Request](), list[Answer]()

    def ask(self, request: Request) -> None:
        self.asked.append(request)

    def answer(self) -> None:
        self.answers.append(self.compute(self.asked[-1]))

    def take(self, t: float) -> Answer | None:
        return self.answers.pop(0) if self.answers else None

    def replace(self) -> bool:
        return False

    def close(self) -> None:
        pass


def remembering(compute: Callable[[Request], Answer]) -> Callable[[Request], Answer]:
    """Answer a question that was asked before as then: each page of a test begins with the same."""
    known: dict[bytes, Answer] = {}

    def answer(request: Request) -> Answer:
        question = pickle.dumps(request)
        if question not in known:
            with short_searches():
                known[question] = compute(request)
        return known[question]

    return answer


COMPUTE = remembering(planner(RIG))


def shown(**how: object) -> Simulation:
    worker = InlineWorker(COMPUTE, latency=0.0)
    made = Simulation(RIG, sketch(RIG), worker=worker, **how)  # type: ignore[arg-type]
    made.ready.result(120)
    return made


def go(simulation: Simulation, seconds: float) -> list[Message]:
    """Advance by so much time on the clock, in ticks; return all that was said."""
    said = []
    for _ in range(round(seconds / TICK)):
        said += simulation.advance(TICK)
    return said


def plans(said: list[Message]) -> list[Message]:
    return [message for message in said if message["kind"] == "plan"]


@pytest.fixture
def simulation() -> Iterator[Simulation]:
    made = shown()
    yield made
    made.close()


def test_the_pendulum_is_brought_upright_and_its_cost_falls(simulation: Simulation) -> None:
    """Lemma 3: what is predicted falls by at least what was spent, to what is learnt meanwhile."""
    said = go(simulation, 2.2)
    decided = plans(said)
    assert decided[0]["first"]
    assert decided[0]["why"] == "first optimum of a task"
    assert len(decided) > 20
    assert sum(one["accepted"] for one in decided) > 0.8 * len(decided)
    predicted = np.array([one["predicted"] for one in decided])
    assert predicted[-1] < 0.2 * predicted[0]
    assert (np.diff(predicted[2:]) < 0.02 * predicted[2:-1]).all()  # what is learnt changes it
    frames = [message for message in said if message["kind"] == "frame"]
    assert abs(frames[-1]["x"][1]) < 0.02
    assert max(abs(frame["u"][0]) for frame in frames) <= 15.0
    assert frames[-1]["t"] == pytest.approx(2.2, abs=3 * TICK)
    ahead = [f["left"] for f in frames if 1.0 < f["t"] < 2.2]
    assert all(value > 0 for value in ahead)


def test_the_first_prediction_is_for_where_it_starts(simulation: Simulation) -> None:
    """J̃₀ is what SciPy's integrator pays from the start with the first surface: nothing moves
    before there is one, and nothing is paid beforehand."""
    first = plans(go(simulation, 0.2))[0]
    surface = ut.Surface.from_vector(surface_of(first), 2, 1)
    law = ut.SlidingModeLaw(RIG, surface, simulation.law.reaching)

    def rate(t: float, z: np.ndarray) -> np.ndarray:
        x, u = z[:4], law(t, z[:4]).u
        paid = float(u @ u) / 15.0**2 + 0.01 * float(x @ x)
        return np.concatenate([x[2:], RIG.accelerations(t, x, u), [paid]])

    def arrives(t: float, z: np.ndarray) -> float:
        return float(np.linalg.norm(z[:4])) - 0.01

    arrives.terminal = True  # type: ignore[attr-defined]
    begin = np.append(RIG.usual_start, 0.0)
    found = solve_ivp(rate, (0, 20), begin, "LSODA", rtol=1e-7, atol=1e-9, events=arrives)
    assert found.status == 1
    assert first["predicted"] == pytest.approx(found.y[-1, -1], rel=5e-3)


def surface_of(plan: Message) -> np.ndarray:
    """The entries of a plan's surface, α_a, λ_a, α_u, λ_u, from its row over (q, q̇)."""
    (row,) = plan["rows"]
    return np.array([row[2], row[0], row[3], row[1]])


def test_time_stops_steps_and_slows(simulation: Simulation) -> None:
    """Pause holds it, a step is a sixtieth of a second, slow motion five times slower."""
    go(simulation, 0.5)
    simulation.hear({"do": "pause", "on": True}, 1)
    t = simulation.t
    go(simulation, 0.5)
    assert simulation.t == t
    simulation.hear({"do": "step"}, 1)
    assert simulation.t - t == pytest.approx(TICK, abs=1e-3)
    simulation.hear({"do": "pause", "on": False}, 1)
    simulation.hear({"do": "speed", "to": 0.2}, 1)
    t = simulation.t
    go(simulation, 1.0)
    assert simulation.t - t == pytest.approx(0.2, abs=2e-3)
    with pytest.raises(InvalidInputError, match="speed"):
        simulation.hear({"do": "speed", "to": 3.0}, 1)


def test_reset_begins_again_with_the_same_first_plan(simulation: Simulation) -> None:
    """Everything goes back to the start; the first optimum is known by then."""
    first = plans(go(simulation, 1.0))[0]
    simulation.hear({"do": "reset"}, 1)
    said = go(simulation, 0.1)
    assert said[0]["kind"] == "reset"
    assert plans(said)[0]["rows"] == first["rows"]
    assert simulation.t == pytest.approx(0.1, abs=2 * TICK)


def test_where_no_surface_is_found_after_a_reset_the_designed_one_is_used() -> None:
    """Not the one that was in use before the reset, of which nothing is shown."""
    worker = Deferred(COMPUTE)
    simulation = Simulation(RIG, sketch(RIG), worker=worker)
    simulation.ready.result(120)
    worker.answer()
    (found,) = worker.answers
    simulation.advance(TICK)
    assert simulation.law.surface != simulation._idle.surface
    simulation.hear({"do": "set", "name": "objective", "value": "bench-time"}, 1)
    simulation.hear({"do": "reset"}, 1)
    simulation.advance(TICK)
    none = replace(found.proposal, plan=None, status="infeasible")
    worker.answers.append(replace(found, sequence=worker.asked[-1].sequence, proposal=none))
    (told,) = plans(simulation.advance(TICK))
    assert told["why"].startswith("no surface from here")
    assert simulation.law.surface == simulation._idle.surface == ut.first_surface(RIG)
    assert told["rows"] == simulation.law.surface.matrix.tolist()
    law = ut.SlidingModeLaw(RIG, simulation.law.surface)
    assert simulation.law(RIG.usual_start) == pytest.approx(law(0.0, RIG.usual_start).u)


def test_a_hand_pulls_with_a_force_at_a_place(simulation: Simulation) -> None:
    """Its generalised force does the work of the force: Q·q̇ = F·ṗ; the tip follows the hand."""
    go(simulation, 2.0)
    scene, x = simulation.scene, simulation.rig.truth
    tip = scene.places(x[:2], RIG.parameter_values)[2 * scene.count - 2 : 2 * scene.count]
    at = tip + np.array([0.05, -0.02])
    simulation.hear({"do": "grab", "at": tip.tolist()}, 1)
    simulation.hear({"do": "drag", "at": at.tolist()}, 1)
    hand = simulation.hands._hands[1]
    grip, mass = hand.grip, hand.mass
    J = scene.slopes(x[:2], RIG.parameter_values, grip)
    force = mass * (18.0**2 * (at - tip) - 2 * 0.7 * 18.0 * (J @ x[2:]))
    np.testing.assert_allclose(
        simulation.hands.force(x, RIG.parameter_values), J.T @ force, rtol=1e-9
    )
    frame = [m for m in go(simulation, 0.1) if m["kind"] == "frame"][-1]
    assert len(frame["held"]) == 1
    after = simulation.scene.held(simulation.rig.truth[:2], RIG.parameter_values, grip)
    assert np.linalg.norm(after - at) < np.linalg.norm(tip - at)
    simulation.hear({"do": "release"}, 1)
    assert "held" not in [m for m in go(simulation, 0.1) if m["kind"] == "frame"][-1]
    with pytest.raises(InvalidInputError, match="nothing near there"):
        simulation.hear({"do": "grab", "at": [9.0, 9.0]}, 1)


@pytest.mark.slow
def test_a_push_is_an_impulse_and_is_recovered_from(simulation: Simulation) -> None:
    """The pendulum gets 0.7 rad/s, is planned for at once, and comes back."""
    go(simulation, 2.0)
    simulation.controls["period"] = simulation.controls["period"].put(1.0)
    go(simulation, 1.5)
    t = simulation.t
    before = simulation.rig.truth
    simulation.hear({"do": "push", "side": 1}, 1)
    simulation._step()
    assert simulation.rig.truth[3] - before[3] == pytest.approx(0.7, abs=0.1)
    memory, error = simulation.memory, simulation._error(simulation.rig.truth)
    assert memory is not None
    chosen = simulation._cascade(simulation.controls.task).after_jump(memory, error)
    reserve, *decided = plans(go(simulation, 2.0))
    assert reserve["why"] == "a plan in reserve: the velocities have jumped"
    assert reserve["rows"] == chosen.surfaces[0].matrix.tolist()
    assert decided[0]["t"] < t + 0.3
    assert simulation.mode == "running"
    assert abs(simulation.rig.truth[1]) < 0.05


@pytest.mark.slow
def test_pushes_at_rest_never_throw_it() -> None:
    """Plans at rest save next to nothing and may bear little: a push is met by one that does.

    Without, one in fifteen pushes makes the rod turn at 2 to 5 rad/s here.
    """

    class Slow(InlineWorker):
        """Answers some pictures after it was asked."""

        def ask(self, request: Request) -> None:
            super().ask(request)
            self.left = round(1e3 * request.use) % 5

        def take(self, t: float) -> Answer | None:
            self.left -= 1
            return super().take(t) if self.left < 0 else None

    made = Simulation(RIG, sketch(RIG), worker=Slow(COMPUTE, latency=0.0))
    made.ready.result(120)
    go(made, 4.0)
    for k in range(24):
        made.hear({"do": "push", "side": (1, -1, -1)[k % 3]}, 1)
        said = go(made, 0.6 + 0.37 * (k % 5))
        turned = [abs(m["x"][3]) for m in said if m["kind"] == "frame"]
        assert max(turned) < 1.3, k
    assert made.mode == "running"
    made.close()


@pytest.mark.slow
def test_what_has_fallen_says_so_and_is_caught_again(simulation: Simulation) -> None:
    """Beyond the law there is no input; near the upright it takes over by itself."""
    go(simulation, 0.5)
    simulation.hear({"do": "set", "name": "push", "value": 5.0}, 1)
    for _ in range(8):
        simulation.hear({"do": "push", "side": 1}, 1)
        simulation._step()
    said = go(simulation, 1.0)
    states = [message for message in said if message["kind"] == "state"]
    assert states[-1]["mode"] == "fallen"
    assert states[-1]["why"]
    assert [m for m in said if m["kind"] == "frame"][-1]["u"] == [0.0]
    assert abs(simulation.rig.truth[1]) < 2 * math.pi + 0.1  # turns are taken off
    # Upright, but on its way through: 0.1 rad, and 4 rad/s that carry it beyond what is caught.
    simulation.rig = simulation._rig(RIG.state(phi=0.1, phi_dot=4.0))
    simulation._step()
    assert simulation.mode == "fallen"
    # Three turns of the arm are none.
    simulation.rig = simulation._rig(RIG.state(theta=6 * math.pi + 0.2, phi=0.1))
    go(simulation, 2.0)
    assert simulation.mode == "running"
    assert np.abs(simulation.rig.truth[:2]).max() < 0.25


@pytest.mark.slow
@pytest.mark.parametrize("name", ["reaction_wheel_pendulum", "wheeled_inverted_pendulum"])
def test_a_turn_of_a_wheel_on_the_ground_is_a_way(name: str) -> None:
    """Turns are taken off where they are none to see: of a flywheel, and not of a rolling one."""
    mechanism = getattr(ut.mechanisms, name)()
    worker = InlineWorker(planner(mechanism), latency=0.0)
    simulation = Simulation(mechanism, sketch(mechanism), worker=worker)
    simulation.rig = simulation._rig(np.array([20.0, 0.5, 0.0, 0.0]))
    simulation._unwind()
    rolls = name == "wheeled_inverted_pendulum"
    assert simulation.rig.truth[0] == pytest.approx(20.0 if rolls else 20.0 - 6 * math.pi)
    simulation.close()


@pytest.mark.slow
def test_controls_do_what_they_say(simulation: Simulation) -> None:
    """Target, objective, period and limit of the controller; mass and friction of the plant."""
    go(simulation, 1.0)
    simulation.hear({"do": "set", "name": "target theta", "value": 30.0}, 1)
    decided = plans(go(simulation, 0.3))
    assert decided[-1]["goal"] == [pytest.approx(math.radians(30)), 0.0]
    simulation.hear({"do": "set", "name": "objective", "value": "energy"}, 1)
    assert plans(go(simulation, 0.3))[-1]["objective"] == "energy"
    simulation.hear({"do": "set", "name": "limit voltage", "value": 6.0}, 1)
    simulation.hear({"do": "push", "side": -1}, 1)
    frames = [m for m in go(simulation, 0.5) if m["kind"] == "frame"]
    assert max(abs(frame["u"][0]) for frame in frames) <= 6.0
    simulation.hear({"do": "set", "name": "period", "value": 0.3}, 1)
    go(simulation, 0.5)
    simulation.hear({"do": "push", "side": 1}, 1)
    times = [one["t"] for one in plans(go(simulation, 2.0)) if not one["first"]]
    assert np.median(np.diff(times)) == pytest.approx(0.3, abs=0.02)
    simulation.hear({"do": "set", "name": "plant m", "value": 0.2}, 1)
    simulation.hear({"do": "set", "name": "friction theta", "value": 0.1}, 1)
    plant = simulation.rig.bench
    assert plant.mechanism.substitution[RIG.parameters[2].symbol] == 0.2
    assert plant.friction["theta"].coulomb == 0.1
    simulation.hear({"do": "defaults"}, 1)
    assert simulation.controls.plant.parameter_values.tolist() == RIG.parameter_values.tolist()
    for name, value in (("plant m", 99.0), ("plant m", "heavy"), ("nothing", 1.0),
                        ("objective", "glory"), ("period", math.nan)):  # fmt: skip
        with pytest.raises(InvalidInputError):
            simulation.hear({"do": "set", "name": name, "value": value}, 1)
    with pytest.raises(InvalidInputError, match="what a viewer asks for"):
        simulation.hear({"do": "explode"}, 1)


@pytest.mark.slow
def test_a_heavier_plant_is_learnt() -> None:
    """A motion of a plant with more mass moves the estimate that the law goes by towards it."""
    simulation = shown()
    simulation.hear({"do": "set", "name": "plant m", "value": 0.15}, 1)
    learnt = [one["learnt"]["m"] for one in plans(go(simulation, 1.5)) if one["learnt"]]
    assert abs(learnt[-1] - 0.15) < abs(RIG.parameters[2].value - 0.15)


def test_late_and_surprised_answers_are_refused() -> None:
    """An answer for a state that is not there, or for a time that is over, changes no surface."""
    worker = Deferred(COMPUTE)
    simulation = Simulation(RIG, sketch(RIG), worker=worker)
    simulation.ready.result(120)
    assert simulation.mode == "waiting"
    go(simulation, 0.3)
    assert simulation.t == 0.0  # held at the start until there is a plan
    worker.answer()
    go(simulation, 0.3)
    assert simulation.mode == "running"
    surface = simulation.law.surface
    go(simulation, 0.5)
    worker.answer()
    late = plans(go(simulation, 0.05))
    assert "late by" in late[-1]["why"]
    assert late[-1]["predicted"] != late[-1]["predicted"]  # no prediction for a plan not in use
    assert simulation.law.surface is surface
    simulation.rig.knock(np.array([0.0, 0.05]))
    worker.answer()
    refused = plans(go(simulation, 0.4))
    assert "off what was predicted" in refused[0]["why"]
    asked = len(worker.asked)
    simulation.reset()
    worker.answers.append(COMPUTE(worker.asked[asked - 1]))  # of before the reset
    go(simulation, 0.1)
    assert simulation.t < 0.2


def test_a_new_viewer_is_told_what_was(simulation: Simulation) -> None:
    """Controls, figure, the latest frames and decisions, all of it JSON."""
    go(simulation, 1.0)
    hello = simulation.hello()
    assert hello["frames"][-1]["t"] == pytest.approx(simulation.t)
    assert len(hello["plans"]) >= 5
    assert {
        "target theta",
        "objective",
        "period",
        "limit voltage",
        "friction theta",
        "plant m",
    } <= {one["name"] for one in hello["controls"]}
    assert len(hello["frames"][0]["points"]) >= 2 * hello["count"]


def test_sliders_go_no_farther_than_what_holds_the_target_and_count_every_input() -> None:
    """A load of 2 kg on a hoist asks for 19.62 N; inputs in another order have friction, too."""
    x, z, phi = ut.Coordinate("x", "m"), ut.Coordinate("z", "m"), ut.Coordinate("phi")
    kinetic = x.velocity**2 + z.velocity**2 + phi.velocity**2 + x.velocity * phi.velocity / 2
    hoist = ut.Mechanism.from_energies(
        "hoist", [x, z, phi], [ut.Input("lift", "N", 40.0), ut.Input("pull", "N", 10.0)],
        kinetic, 2 * 9.81 * z.symbol - sp.cos(phi.symbol), input_matrix=sp.Matrix([[0, 1], [1, 0]]),
    )  # fmt: skip
    controls = controls_of(hoist, "bench-energy", 0.1)
    assert 2 * 9.81 < controls["limit lift"].low < controls["limit lift"].high
    assert controls["limit pull"].low == pytest.approx(1.0)
    assert controls["friction x"].high == pytest.approx(0.3 * 10.0)
    assert controls["friction z"].high == pytest.approx(0.3 * 40.0)


def test_a_mechanism_that_cannot_be_shown_is_refused_at_once() -> None:
    """An unknown objective, and a start outside of what is allowed."""
    with pytest.raises(InvalidInputError, match="objective"):
        shown(objective="glory")
    crane = ut.mechanisms.overhead_crane()
    with pytest.raises(InvalidInputError):
        Simulation(crane, sketch(crane), crane.state(x=9.0), worker=InlineWorker(planner(crane)))


def test_a_recording_shows_the_layers_of_the_plans_own_reaching_laws() -> None:
    small = ut.Budget(64)
    cascade = ut.Cascade(RIG, ut.MinimumTime(), belief="exact", cold=small, warm=small)
    run = cascade.simulate(phi=ut.deg(5), duration=0.02)
    plan, own = run.updates[0].plan, ut.ReachingLaw(30.0, 0.5)
    free = replace(plan, reaching=(own,) * len(plan.surfaces))
    updates = [replace(run.updates[0], plan=one) for one in (replace(plan, reaching=None), free)]
    message = of_run(replace(run, updates=tuple(updates)), cascade)
    assert [one["layer"] for one in message["plans"]] == [[0.1], [0.5]]


@pytest.mark.slow
def test_a_simulated_run_becomes_a_recording() -> None:
    """Frames a sixtieth of a second apart, the surfaces in use, the cost that is left: ≥ 0."""
    cascade = cascade_for(RIG, Task("bench-energy", (15.0,), 0.1))
    run = cascade.simulate(phi=ut.deg(10))
    message = of_run(run, cascade)
    frames = message["frames"]
    assert message["live"] is False
    assert frames[-1]["t"] == pytest.approx(run.time)
    assert np.diff([frame["t"] for frame in frames]).max() < 0.02
    assert [one["rows"] for one in message["plans"]] == [s.matrix.tolist() for s in run.surfaces]
    assert min(frame["left"] for frame in frames) > -0.02 * frames[0]["left"]
