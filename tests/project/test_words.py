"""One word, one problem: the same objective, bounds, gate and start wherever it is said."""

from __future__ import annotations

import copy
import ctypes
import inspect
import io
import json
import math
import multiprocessing
import pickle
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sympy as sp
from rich.console import Console
from typer.testing import CliRunner

import undertow as ut
from runs import run
from support import interpreted
from undertow.base import InvalidInputError, UndertowError, interruptible
from undertow.bounds import bound
from undertow.cascade import (
    Admission,
    Update,
    cost_gate,
    gate_words,
    problem_words,
    robustness_gate,
)
from undertow.cli import app
from undertow.cli.control import simulate
from undertow.cli.parsing import objective_named, parse_start
from undertow.cli.rig import run as run_on_a_rig
from undertow.cli.show import show
from undertow.display.animation import Film
from undertow.estimators import FilteredDerivative
from undertow.mechanisms import LIBRARY
from undertow.mechanisms.named import from_anywhere, named
from undertow.models import FloatArray
from undertow.objective import Goal, objective_for
from undertow.objective.objective import travel_box
from undertow.optimiser import Proposal
from undertow.plants import srv02_rig
from undertow.runtime import Recipe
from undertow.runtime.controller_defaults import default_gate, estimator_for
from undertow.runtime.encoding import memory_from, memory_to
from undertow.studies import survey
from undertow.studies.motion import ended, motion_report
from undertow.studies.paper.data import BASE
from undertow.studies.trials.balance import controllers
from undertow.studies.trials.steering import CascadeSteering, keeping

RIG = ut.mechanisms.rotary_pendulum(d_e=0.025)
NOWHERE = replace(RIG, start={})

#: Word to stage cost on the rotary pendulum, written by hand, and terminal radius.
V, THETA, PHI = RIG.u[0], *RIG.x[:2]
SQUARES = sum(s**2 for s in RIG.x)
PROBLEMS: dict[Goal, tuple[sp.Expr, float]] = {
    "energy": (V**2, 0.01),
    "time": (sp.Integer(1), 0.01),
    "bench-energy": (V**2 + 0.05 * SQUARES, 0.05),
    "bench-time": (1 + 2.25 * (V / 15) ** 2, 0.05),
    "effort": ((V / 15) ** 2 + 0.01 * SQUARES, 0.01),
}


# -- objectives ----------------------------------------------------------------------------------


@pytest.mark.parametrize("word", PROBLEMS)
def test_a_word_means_one_problem_everywhere(word: Goal) -> None:
    """Library, command line and recipes of runs: the same stage cost, radius and bounds."""
    stage, radius = PROBLEMS[word]
    recipe = Recipe(objective=word, parameters={"d_e": 0.025}, horizon=60.0)
    for problem in (
        ut.objective_for(RIG, word),
        objective_named(word, RIG, 60.0),
        recipe.cascade.objective,
    ):
        assert sp.expand(problem.stage_cost(RIG) - stage) == 0
        assert problem.terminal_radius == radius
        assert problem.name == word
        assert problem == ut.objective_for(RIG, word)


def test_rigs_are_run_for_what_simulations_are_and_take_the_paper_s() -> None:
    """One usual objective, whatever the unit of the inputs; the paper's and the bench's by word."""
    usual = inspect.signature(ut.objective_for).parameters["word"].default
    assert Recipe().objective == usual == "effort"
    for command in (simulate, run_on_a_rig, show):
        assert inspect.signature(command).parameters["objective"].default == usual
    assert Recipe(objective="energy").cascade.objective.stage_cost(RIG) == V**2
    _, out, _ = run("run", "--help")
    assert "bench-energy" in out


def test_an_old_log_s_energy_is_the_bench_s() -> None:
    """A replay runs the problem that was run: words of logs before these are mapped."""
    now = Recipe(objective="energy").as_dict()
    assert Recipe.from_dict(json.loads(json.dumps(now))) == Recipe(objective="energy")
    old = {key: value for key, value in now.items() if key != "words"}
    for word in ("energy", "time"):
        assert Recipe.from_dict(old | {"objective": word}).objective == f"bench-{word}"


def test_an_unknown_word_is_refused_with_the_near_ones() -> None:
    with pytest.raises(InvalidInputError, match="Did you mean bench-energy"):
        ut.objective_for(RIG, "bench_energy")
    with pytest.raises(InvalidInputError, match="Did you mean effort"):
        Recipe(objective="efort")  # type: ignore[arg-type]
    for words in (("simulate", "tora"), ("survey",), ("animate", "tora"), ("run", "tora")):
        code, _, err = run(*words, "--objective", "enrgy")
        assert code == 2
        assert "Did you mean energy" in err


# -- travel --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def cart() -> ut.Mechanism:
    return ut.mechanisms.cart_pendulum()


def test_declared_travel_bounds_every_problem(cart: ut.Mechanism) -> None:
    """In Python as in runs: closed loop, cascade, bound, recipe, whatever the objective is."""
    source = "95 % of the travel that cart_pendulum declares"
    mine = ut.Objective("mine", lambda v: v.force**2)
    for problem in (
        ut.ClosedLoop(cart, ut.MinimumEnergy()).objective,
        ut.ClosedLoop(cart, mine).objective,
        ut.Cascade(cart, ut.MinimumTime(), belief="exact").objective,
        ut.Cascade(cart, belief="exact").optimiser.loop.objective,
        ut.objective_for(cart, "energy"),
        Recipe("cart_pendulum", estimator=lambda at, _: FilteredDerivative(at)).cascade.objective,
    ):
        (kept,) = problem.constraints
        assert kept.words == f"|x| ≤ 1.425 m: {source}"
        assert problem.on(cart) == problem
        assert source in problem.meaning(cart)
        (margin,) = problem.path_margins(cart)
        assert float(margin.subs(cart.x[0], -1.4)) == pytest.approx(0.025)
    with pytest.raises(InvalidInputError, match="95 % of the travel that cart_pendulum declares"):
        bound(cart, mine, cart.state(x=1.45))


def test_a_motion_ends_at_the_travel_in_python_too(cart: ut.Mechanism) -> None:
    """A cart that rolls on at 1 m/s stops at the first test beyond 1.425 m; opted out, it goes."""
    surface = ut.first_surface(cart)
    x0 = cart.state(x=1.40, x_dot=1.0)
    motion = interpreted(ut.ClosedLoop(cart, ut.MinimumEnergy(horizon=0.1))).simulate(x0, surface)
    assert motion.event == ut.Event.CONSTRAINT
    assert motion["x"][-2] <= 1.425 < motion["x"][-1] < 1.428
    free = ut.MinimumEnergy(horizon=0.1, travel=False)
    assert "95 % of the travel that cart_pendulum declares" in ended(motion, ut.MinimumEnergy())
    unbound = interpreted(ut.ClosedLoop(cart, free)).simulate(x0, surface)
    assert unbound.event == ut.Event.HORIZON
    assert unbound["x"][-1] > 1.43


def test_each_side_of_a_range_counts_for_itself(cart: ut.Mechanism) -> None:
    """Uneven ranges, ranges open on one side, and none that leaves the target out."""

    def bounds(low: float, high: float) -> tuple[str, list[float]]:
        """The name of the bound of φ, and its margins at −0.5 and 0.5."""
        x, phi = cart.coordinates
        changed = (replace(x, low=-math.inf, high=math.inf), replace(phi, low=low, high=high))
        mechanism = replace(cart, coordinates=changed, start={})
        (bound,) = travel_box(mechanism)
        (w,) = ut.MinimumEnergy().on(mechanism).path_margins(mechanism)
        return bound.name, [float(w.subs(mechanism.x[1], at)) for at in (-0.5, 0.5)]

    for low, high, name, margins in (
        (-0.4, 1.0, "-21.77° ≤ phi ≤ 54.43°", (-0.12, 0.45)),
        (-math.inf, 0.4, "phi ≤ 21.77°", (0.88, -0.12)),
        (-0.4, math.inf, "-21.77° ≤ phi", (-0.12, 0.88)),
        (-math.pi, math.pi, "|phi| ≤ 171°", (0.95 * math.pi - 0.5,) * 2),
    ):
        shown, found = bounds(low, high)
        assert shown == name
        assert found == pytest.approx(margins)
    with pytest.raises(
        InvalidInputError, match=r"got \[0\.2, 0\.4\] rad.*around the target.*travel=False"
    ):
        bounds(0.2, 0.4)


def test_a_box_of_one_s_own_takes_the_place_of_the_travel(cart: ut.Mechanism) -> None:
    """Tighter or all of the rail, but not beyond; another state's box leaves the travel."""
    assert [c.name for c in objective_named("energy", cart, 9.0, ["x=1.5m"]).constraints] == [
        "|x| ≤ 1.5 m"
    ]
    both = objective_named("energy", cart, 9.0, ["phi=30deg"])
    assert [c.name for c in both.constraints] == ["|phi| ≤ 30°", "|x| ≤ 1.425 m"]
    boxed = ut.ClosedLoop(cart, ut.MinimumTime(constraints=ut.state_box(x=0.3)))
    assert [c.name for c in boxed.objective.constraints] == ["|x| ≤ 0.3"]
    with pytest.raises(InvalidInputError, match=r"'3m'.*travel that cart_pendulum declares"):
        objective_named("energy", cart, 9.0, ["x=3m"])
    moved = replace(boxed, mechanism=RIG, objective=ut.MinimumTime())
    assert moved.objective.constraints == ()


def test_a_box_beyond_the_travel_is_refused_in_python_too(cart: ut.Mechanism) -> None:
    """As by ``--box``: it replaced the travel in silence.  ``travel=False`` is the way out."""
    wide = ut.state_box(x=(-1.0, 3.0))
    for attempt in (
        lambda: ut.ClosedLoop(cart, ut.MinimumTime(constraints=wide)),
        lambda: ut.Cascade(cart, ut.MinimumEnergy(constraints=wide), belief="exact"),
        lambda: objective_for(cart, "energy", constraints=wide),
    ):
        with pytest.raises(
            InvalidInputError, match=r"'-1 ≤ x ≤ 3'.*travel that cart_pendulum.*travel=False"
        ):
            attempt()
    free = ut.ClosedLoop(cart, ut.MinimumTime(constraints=wide, travel=False)).objective
    assert [c.name for c in free.constraints] == ["-1 ≤ x ≤ 3"]
    whole = ut.ClosedLoop(cart, ut.MinimumTime(constraints=ut.state_box(x=1.5))).objective
    assert [c.name for c in whole.constraints] == ["|x| ≤ 1.5"]
    own = ut.Constraint("x far off", lambda v: v.x - 3.0, state="x")
    kept = ut.ClosedLoop(cart, ut.MinimumTime(constraints=(own,))).objective
    assert [c.name for c in kept.constraints] == ["x far off", "|x| ≤ 1.425 m"]


@pytest.mark.slow  # a cascade that has to turn round before the end of the rail
def test_simulate_keeps_the_cart_on_its_rail(cart: ut.Mechanism) -> None:
    """The optimum without the rail needs 6.5 m of it; what is planned stays within 1.425 m."""
    motion = ut.Cascade(cart, objective_for(cart, "energy"), belief="exact").simulate().trajectory
    assert motion.event == ut.Event.REACHED
    assert 1.0 < np.abs(motion["x"]).max() <= 1.425


# -- the gate ------------------------------------------------------------------------------------


def test_one_gate_is_the_default_everywhere() -> None:
    """Exact states: the cost gate; with an estimator the same and the stated margins."""
    assert default_gate() is cost_gate
    assert ut.Cascade(RIG, belief="exact").gate is cost_gate
    bench = srv02_rig()
    filter_ = estimator_for(bench.mechanism, bench)
    recipe = Recipe(rig="realistic")
    steering = controllers(
        bench.mechanism,
        bench,
        objective_for(bench.mechanism, "bench-energy"),
        bench.mechanism.state(phi=0.1),
    )["cascade"](np.zeros(4))
    assert isinstance(steering, CascadeSteering)
    words = gate_words(default_gate(filter_))
    assert words.startswith(f"{gate_words(cost_gate)}, bears 6 ms of delay, does with 15 % less")
    assert gate_words(recipe.cascade.gate) == gate_words(steering.cascade.gate) == words


def test_gates_are_pickled() -> None:
    gate = robustness_gate(0.006, covariance=np.eye(4))
    again = pickle.loads(pickle.dumps(gate))
    assert gate_words(again) == gate_words(gate)


# -- what is printed -----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def simulated() -> tuple[int, str, str]:
    words = ("--start", "phi=5deg", "--objective", "time", "--set", "d_e=0.025")
    return run("simulate", "rotary_pendulum", *words, "--evaluations", "300")


def plain(shown: str) -> str:
    return " ".join(shown.split())


def test_simulate_says_what_the_words_meant(simulated: tuple[int, str, str]) -> None:
    """Problem and gate in one line; the first optimum is called what it is."""
    code, out, _ = simulated
    assert code == 0
    gate = "gate: stable, feasible, cost not raised"
    assert f"objective time: ∫ 1 dt, s, to ‖x‖ ≤ 0.01 within 60 s; {gate}" in plain(out)
    assert "first optimum" in out
    assert "first surface" not in out
    assert "evidence" not in out  # nobody asked for any


def test_optimise_and_trials_say_what_the_words_meant(cart: ut.Mechanism) -> None:
    words = ("--evaluations", "200", "--set", "d_e=0.025", "--start", "phi=10deg")
    code, out, _ = run("optimise", "rotary_pendulum", "--objective", "time", *words)
    assert code == 0
    assert "objective time: ∫ 1 dt, s, to ‖x‖ ≤ 0.01 within 60 s" in plain(out)
    said = problem_words(cart, objective_for(cart, "bench-time"), default_gate())
    assert said == (
        "objective bench-time: ∫ (1 + 2.25 Σ (u/u_max)²) dt, s, to ‖x‖ ≤ 0.05 within 60 s; "
        "|x| ≤ 1.425 m: 95 % of the travel that cart_pendulum declares; "
        "gate: stable, feasible, cost not raised"
    )
    mine = ut.Objective("mine", lambda v: v.voltage**2 + 10 * v.phi**2, hard_input=True)
    assert mine.meaning(RIG) == (
        "mine: ∫ (10*phi**2 + voltage**2) dt, to ‖x‖ ≤ 0.01 within 60 s; "
        "|voltage| ≤ 15 V before clipping"
    )


def test_the_designed_surface_is_not_called_the_first() -> None:
    """``--control first`` was one of two: both are named."""
    for words in (("simulate", "rotary_pendulum"), ("export", "c", "rotary_pendulum", "--check")):
        code, out, err = run(*words, "--control", "first")
        assert (code, out) == (2, "")
        assert "'designed'" in err
        assert "'one-time'" in err
    _, shown, _ = run("simulate", "rotary_pendulum", "--control", "designed", "--start", "phi=0deg")
    assert "surface" in shown


def test_unknown_slack_is_said_and_not_printed_as_nan() -> None:
    """A prediction that is infinite has no slack; the others' smallest is shown."""
    t = np.array([0.0, 1.0])
    zero = np.zeros((2, 1))
    motion = ut.Trajectory(
        RIG, t, np.zeros((2, 4)), zero, zero, t, np.ones(2), ut.Event.REACHED
    )  # fmt: skip
    surface = ut.first_surface(RIG)

    def made(*predicted: float) -> str:
        proposal = Proposal(None, "failed", math.inf, math.inf, (), 0, 0.0, 1, 0.0)
        updates = [
            Update(k, np.zeros(4), proposal, Admission(False, "", p), ut.Plan.of(surface), p, 0.0)
            for k, p in enumerate(predicted)
        ]
        console = Console(width=200, record=True, file=io.StringIO())
        found = ut.Run(motion, tuple(updates))
        console.print(motion_report(RIG, ut.MinimumTime(), np.ones(4), motion, surface, found))
        return console.export_text()

    some = made(3.0, 1.0, math.inf, 0.5)
    assert "nan" not in some
    assert "smallest slack 2.0e+00 s" in some
    assert "2 of 3 decisions without a finite prediction" in some
    none = made(math.inf, math.inf)
    assert "nan" not in none
    assert "no slack is known" in none


# -- starts --------------------------------------------------------------------------------------


def test_a_run_without_a_start_is_refused_before_any_work(tmp_path: Path) -> None:
    """In Python, in recipes and on the command line, where the mechanism has no usual one."""
    (tmp_path / "own.py").write_text(
        "from dataclasses import replace\nimport undertow as ut\n"
        "rig = replace(ut.mechanisms.rotary_pendulum(), start={})\n"
    )
    own = f"{tmp_path / 'own.py'}:rig"
    with pytest.raises(InvalidInputError, match=r"start of 'rotary_pendulum'.*--start phi=0\.1rad"):
        ut.Cascade(NOWHERE, belief="exact").simulate()
    with pytest.raises(InvalidInputError, match="start of"):
        _ = Recipe(mechanism=own).x0
    with pytest.raises(InvalidInputError, match="start of"):
        parse_start(NOWHERE, [])
    for command in ("simulate", "optimise", "run", "animate"):
        code, out, err = run(command, own)
        assert (code, out) == (2, "")
        assert "start of 'rotary_pendulum'" in err


def test_a_start_at_the_target_is_no_success_of_control() -> None:
    """Asked for, it is done; and said to be what it is."""
    words = ("--control", "designed", "--start", "phi=0deg")
    code, out, _ = run("simulate", "rotary_pendulum", *words)
    assert code == 0
    assert "started at the target" in out
    assert "✓" not in out
    assert "reached" not in out


# -- a target that jumps ----------------------------------------------------------------------


@pytest.fixture(scope="module")
def steered() -> ut.Cascade:
    """A cascade of small budgets, shared by what follows."""
    goal = ut.MinimumTime(horizon=20.0)
    return ut.Cascade(RIG, goal, cold=ut.Budget(300), warm=ut.Budget(64), belief="exact")


def test_an_admission_says_that_the_target_jumped(steered: ut.Cascade) -> None:
    """After a jump "cost not raised" is not all there is to say; the next decision is usual."""
    x = RIG.state(phi=0.3)
    state, _ = steered.start(x)
    ahead = steered.loop.batch(x, state.plan, duration=0.1, terminal=0.0).x[0]
    for jump, said in ((0.0, False), (0.05, False), (1.0, True), (-2.0, True)):
        here = ahead - RIG.state(theta=jump)
        proposal = steered.propose(state, here, 0.1)
        after, admission = steered.apply_gate(state, proposal, here)
        assert ("off the plan's prediction" in admission.reason) == said
        if said:
            assert f"{abs(jump):g} off" in admission.reason
            assert "call start again" in admission.reason
    later = steered.loop.batch(here, after.plan, duration=0.1, terminal=0.0).x[0]
    _, usual = steered.apply_gate(after, steered.propose(after, later, 0.2), later)
    assert "off the plan" not in usual.reason
    for method in (steered.propose, steered.apply_gate, steered.start):
        assert "jump" in str(method.__doc__)
    assert "horizon" in str(steered.propose.__doc__)


def test_a_plant_of_other_numbers_is_no_jump(steered: ut.Cascade) -> None:
    truth = RIG.with_parameters(m=0.135, d_e=0.05)
    found = steered.simulate(phi=ut.deg(20), plant=truth)
    assert found.reached
    assert not any("off the plan" in update.admission.reason for update in found.updates)


def test_a_memory_keeps_its_state_in_a_log(steered: ut.Cascade) -> None:
    state = steered.start(RIG.state(phi=0.1))[0]
    assert memory_from(json.loads(json.dumps(memory_to(state)))) == state
    old = {key: value for key, value in memory_to(state).items() if key != "x"}
    assert memory_from(old) == replace(state, x=())


# -- what is shown of objects, and sent to other processes -------------------------------------


def test_objects_show_themselves_in_a_few_lines(steered: ut.Cascade) -> None:
    """A notebook prints what is asked for: no arrays of thousands of rows."""
    found = steered.simulate(phi=ut.deg(10))
    update = found.updates[-1]
    batch = steered.loop.batch(RIG.state(phi=0.1), found.surfaces[0])
    for item in (
        found, found.trajectory, update, update.proposal, update.plan, steered, steered.loop, RIG,
        batch, found.surfaces[0], ut.check_mechanism(RIG),
    ):  # fmt: skip
        assert len(repr(item)) <= 200, repr(item)
        assert "array(" not in repr(item)
    assert "reached" in repr(found)


def twice(v: Any) -> Any:
    return v.voltage**2


def optimum(cascade: ut.Cascade, x: FloatArray) -> tuple[float, bytes]:
    proposal = cascade.start(x)[1]
    assert proposal.surface is not None
    return proposal.cost, proposal.surface.vector.tobytes()


#: Objectives of the library, and with formulas that no other process can import.
SENT: dict[str, Callable[[], ut.Objective]] = {
    "energy": lambda: objective_for(RIG, "energy"),
    "bench": lambda: objective_for(RIG, "bench-time"),
    "box": lambda: ut.MinimumTime(constraints=ut.state_box(theta=3.0)),
    "lambda": lambda: ut.Objective("mine", lambda v: v.voltage**2 + v.phi**2),
    "constraint": lambda: ut.MinimumTime(
        constraints=(ut.Constraint("arm", lambda v: v.theta**2 - 9),)
    ),
}


@pytest.mark.parametrize("kind", SENT)
def test_copies_of_a_cascade_are_made_of_the_same(kind: str) -> None:
    """Pickled or copied: the same problem, mechanism and gate, so the same kernel."""
    cascade = ut.Cascade(RIG, SENT[kind](), belief="exact")
    for again in (
        pickle.loads(pickle.dumps(cascade)),
        pickle.loads(pickle.dumps(cascade.loop)),
        copy.deepcopy(cascade),
        copy.copy(cascade.loop),
    ):
        goal = again.objective
        assert goal.stage_cost(again.mechanism) == cascade.objective.stage_cost(RIG)
        assert goal.path_margins(again.mechanism) == cascade.objective.path_margins(RIG)
        assert goal.horizon == cascade.objective.horizon
        assert again.mechanism.fingerprint == RIG.fingerprint


def test_copies_compute_the_same_bits(steered: ut.Cascade) -> None:
    x = RIG.state(phi=0.2)
    steered.start(x)  # a copy carries nothing of what was computed
    again = pickle.loads(pickle.dumps(steered))
    assert optimum(again, x) == optimum(steered, x)
    found = steered.simulate(phi=0.1)
    kept = pickle.loads(pickle.dumps(found))
    np.testing.assert_array_equal(kept.trajectory.x, found.trajectory.x)
    assert kept.surfaces == found.surfaces
    state = steered.start(x)[0]
    assert pickle.loads(pickle.dumps(state)) == state


@pytest.mark.slow  # another interpreter
def test_another_process_computes_the_same_bits(steered: ut.Cascade) -> None:
    x = RIG.state(phi=0.2)
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        assert pool.apply(optimum, (steered, x)) == optimum(steered, x)


def test_a_formula_that_nobody_can_import_is_said() -> None:
    """A lambda alone has no mechanism: names are symbols anywhere, all inputs are not known."""
    whole = ut.Objective("mine", lambda v: (v.inputs.T * v.inputs)[0])
    with pytest.raises(InvalidInputError, match=r"mine.*<lambda>.*def at the top of a module"):
        pickle.dumps(whole)
    named = SENT["lambda"]()
    assert pickle.loads(pickle.dumps(named)).stage_cost(RIG) == named.stage_cost(RIG)
    assert pickle.loads(pickle.dumps(ut.Objective("def", twice))) == ut.Objective("def", twice)
    mine = SENT["lambda"]()
    assert copy.deepcopy(mine) == mine


# -- pictures ------------------------------------------------------------------------------------


def test_a_film_says_which_part_of_a_motion_it_shows() -> None:
    t = np.linspace(0, 20, 2001)
    x = RIG.state(phi=0.5) * np.cos(t)[:, None]
    u = np.zeros((len(t), 1))
    motion = ut.Trajectory(RIG, t, x, u, u, t, np.ones_like(t), ut.Event.HORIZON)
    assert Film.of(motion).span == "0 to 8 s of 20 s"
    assert Film.of(motion, longest=30.0).span == "0 to 20 s"
    assert Film.of(motion, speed=2.0).span == "0 to 16 s of 20 s"
    _, out, _ = run("animate", "--help")
    assert "8 s" in plain(out)
    assert "--longest" in out


# -- names ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "meant"),
    [
        (("simlate",), "simulate"),
        (("simulate", "rotary_pendlum"), "rotary_pendulum"),
        (("export", "d"), "c"),
        (("simulate", "tora", "--start", "thta=1deg"), "theta"),
        (("simulate", "rotary_pendulum", "--limit", "volage=3"), "voltage"),
        (("simulate", "tora", "--objectve", "time"), "--objective"),
        (("simulate", "tora", "--control", "onetime"), "one-time"),
    ],
)
def test_a_wrong_name_is_told_the_near_ones(words: tuple[str, ...], meant: str) -> None:
    code, out, err = run(*words)
    assert (code, out) == (2, "")
    assert meant in err


URDF = """<robot name="pendulum_on_a_cart"><link name="rail"/>
  <link name="cart"><inertial><mass value="0.5"/>
    <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="rod"><inertial><origin xyz="0 0 0.3"/><mass value="0.2"/>
    <inertia ixx="0.006" iyy="0.006" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="x" type="prismatic"><parent link="rail"/><child link="cart"/><axis xyz="1 0 0"/>
    <dynamics damping="0.1"/><limit effort="20" lower="-1.5" upper="1.5" velocity="9"/></joint>
  <joint name="phi" type="continuous"><parent link="cart"/><child link="rod"/>
    <axis xyz="0 1 0"/><dynamics damping="0.001"/></joint></robot>"""


def test_the_command_line_takes_urdf_and_mjcf(tmp_path: Path) -> None:
    """As data; the joints that are driven follow where the file does not say."""
    file = tmp_path / "cart.urdf"
    file.write_text(URDF)
    mechanism = named(f"{file}:x")
    same = ut.modelling.from_urdf(file, actuated=["x"])
    assert mechanism.fingerprint == same.fingerprint
    code, out, err = run("derive", f"{file}:x")
    assert code == 0, err
    assert "pendulum_on_a_cart" in out
    code, out, err = run("simulate", f"{file}:x", "--control", "designed", "--horizon", "10")
    assert code == 0, err
    assert "phi = 5°" in out
    assert from_anywhere(f"{file}:x") == f"{file.resolve()}:x"
    assert from_anywhere("tora") == "tora"
    (tmp_path / "empty.xml").write_text("<mujoco/>")
    with pytest.raises(UndertowError):
        named(str(tmp_path / "empty.xml"))


# -- Ctrl-C --------------------------------------------------------------------------------------

_COMMAND = ("-m", "undertow", "survey", "--only", "pendubot", "--no-bounds")


def _interrupted(moment: str) -> tuple[int, list[str]]:
    """Interrupt a survey once a word has been on standard error, where Python tells its imports."""
    with subprocess.Popen(
        (sys.executable, "-X", "importtime", *_COMMAND),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        encoding="utf-8",
        # What is started in the background ignores Ctrl-C, and so do its children.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # noqa: PLW1509
    ) as process:
        assert process.stderr is not None
        lines = []
        for line in process.stderr:
            lines.append(line)
            if moment in line:
                process.send_signal(signal.SIGINT)
                break
        lines += process.stderr.readlines()
    said = [line.strip() for line in lines if not line.startswith("import time:")]
    return process.returncode, said


@pytest.mark.parametrize(
    "moment",
    [" numpy.version\n", pytest.param(" undertow.closed_loop.kernel\n", marks=pytest.mark.slow)],
)
def test_ctrl_c_while_importing_is_one_line(moment: str) -> None:
    """Among the first modules of others, and among our own."""
    assert _interrupted(moment) == (130, ["interrupted"])


@pytest.mark.slow  # a process for each moment
@pytest.mark.parametrize(
    "moment",
    [" sympy", " numba", " typer", " undertow.cli\n", " undertow.studies.survey\n", "… pendubot"],
)
def test_ctrl_c_at_any_moment_is_one_line(moment: str) -> None:
    """Imports of others, the command line's own, what a command imports, and its work."""
    code, said = _interrupted(moment)
    assert code == 130
    assert said[-1].startswith("interrupted")
    assert not any("Traceback" in line for line in said)


def test_ctrl_c_that_meets_a_function_which_c_calls_is_not_lost(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Compilers call Python: what they miss afterwards is no error of theirs."""
    call = ctypes.CFUNCTYPE(None)(lambda: signal.raise_signal(signal.SIGINT))

    def compile_something(*_: Any, **__: Any) -> None:
        call()
        raise RuntimeError("no compiled object yet")

    @interruptible()
    def pass_it_over() -> None:
        call()
        for _ in range(1000):
            time.sleep(0.01)

    monkeypatch.setattr(survey, "survey_one", compile_something)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        code, _, err = run("survey", "--only", "tora", "--no-bounds")
        with pytest.raises(KeyboardInterrupt):
            pass_it_over()
    finally:
        signal.signal(signal.SIGINT, before)
    assert (code, err.splitlines()[-1]) == (130, "interrupted")


def test_an_interrupted_survey_keeps_its_rows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Shown, on disk, and gone on with by the same command; the exit status is a shell's."""
    made: list[str] = []

    def one(mechanism: ut.Mechanism, objective: ut.Objective, goal: str, **_: Any) -> survey.Entry:
        made.append(f"{goal},{mechanism.name}")
        if len(made) == 2:
            raise KeyboardInterrupt
        return survey.Entry(
            goal, mechanism.name, 2, 1, "", "", 3.0, 2.0, 1.0, 1.0, 4.0, 0.01, math.nan, 0.5
        )

    monkeypatch.setattr(survey, "survey_one", one)
    words = ["survey", "--only", "tora", "--only", "acrobot", "--only", "pendubot"]
    words += ["--no-bounds", "--out", str(tmp_path)]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 130
    assert "1 of 1" in result.stdout
    kept = tmp_path / "survey.jsonl"
    said = f"interrupted: 1 of 6 are done, they are in {kept}; the same command goes on there"
    assert said in result.stderr.splitlines()
    rows = (tmp_path / "survey.csv").read_text().splitlines()
    assert len(rows) == 2
    assert rows[1].startswith("energy,tora")
    refused = CliRunner().invoke(app, [*words, "--seed", "1"])
    assert refused.exit_code == 1
    assert "other versions or settings" in refused.stderr
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 0, result.output
    assert len(made) == 1 + 6  # the one that was interrupted, and every other once
    assert "energy,tora" not in made[1:]
    rows = (tmp_path / "survey.csv").read_text().splitlines()
    assert [",".join(row.split(",")[:2]) for row in rows[1:]] == [made[0], *made[2:]]
    assert not kept.exists()  # all of it is in the table


@pytest.mark.parametrize(
    ("words", "takers"),
    [(["robustness", "--angle", "30"], "balance"), (["mujoco", "--quick"], "balance, swing-up"),
     (["library", "--fresh", "1"], "swing-up"), (["balance", "--no-single"], "robustness")],
)  # fmt: skip
def test_options_of_other_trials_are_refused(words: list[str], takers: str) -> None:
    """They were passed over without a word."""
    result = CliRunner(env={"COLUMNS": "300"}).invoke(app, ["trials", *words])
    assert result.exit_code == 2
    assert f"{words[1].replace('--no-', '--')} with undertow trials" in result.stderr
    assert f"an option of {takers}" in result.stderr


def test_interrupted_trials_keep_their_rows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from undertow.studies.trials import library
    from undertow.studies.trials.library import LibraryRow

    def some(name: str, **_: Any) -> LibraryRow:
        if name != next(iter(LIBRARY)):
            raise KeyboardInterrupt
        return LibraryRow("tora", 1, 0.1, 1, 1, {}, 3.0, 0.5)

    monkeypatch.setattr(library, "through_the_runtime", some)
    result = CliRunner().invoke(app, ["trials", "library", "--out", str(tmp_path)])
    assert result.exit_code == 130
    assert "tora" in result.stdout
    assert "interrupted: 1 of 13 are done" in result.stderr
    kept = (tmp_path / "library.txt").read_text()
    assert "tora" in kept
    assert "bench-energy: ∫ (uᵀu + 0.05 xᵀx) dt" in plain(kept)


def test_interrupted_balance_keeps_what_is_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The row that was finished is in the table and in balance.csv; figures need all of them."""
    from undertow.studies.trials import balance

    calls = iter(range(100))
    honest = vars(balance)["trial"]
    unsearched = {"base": keeping(RIG, BASE), "one-time": None}

    def some(*words: Any, **more: Any) -> Any:
        if next(calls) > 1:
            raise KeyboardInterrupt
        return honest(*words, **more)

    monkeypatch.setattr(balance, "trial", some)
    monkeypatch.setattr(balance, "makers", lambda *_: unsearched)
    words = ["trials", "balance", "--seeds", "1", "--no-limits", "--out", str(tmp_path)]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 130, result.output
    names = ["balance.csv", "balance.jsonl", "balance.txt"]
    assert sorted(path.name for path in tmp_path.iterdir()) == names
    rows = (tmp_path / "balance.csv").read_text().splitlines()
    assert rows[1].startswith("bench-energy,base,0,")
    assert len(rows) == 2


def test_every_mechanism_of_the_library_says_its_travel() -> None:
    """Those with ends have bounds, the others none."""
    for build in LIBRARY.values():
        mechanism = build()
        bounded = [c.name for c in mechanism.coordinates if math.isfinite(c.high)]
        assert [c.state for c in travel_box(mechanism)] == bounded
