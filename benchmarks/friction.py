"""Plants that are not the model, on a bench: inputs held, late, and with dry friction.

The rotary pendulums of plants.py.  Each also draws Coulomb friction of its motor axis, evenly from
0 to ``--friction``, and a delay of its input, evenly from 0 to ``--delay`` in quarters of a
millisecond.  The law runs at 1 kHz, its input held from sample to sample; friction sticks (it is
not smoothed).  Positions are measured without noise or counts.  The estimator is what a user of the
library gets on a rig, ``estimator_for`` the bench: a Kalman filter which knows the period and the
delay, rounded to periods, and runs ahead by it; which estimates a matched disturbance, taken off
the law's output; and which learns the parameters that the belief leaves open.  Nobody is told of
the friction.  ``--drift`` sets how fast the disturbance may drift; 0 estimates none.

*kept*, *exact* and *belief* are those of plants.py.  Where they are asked for: *level*, a belief
that has friction in its model, of a level that it learns (``Mechanism.with_friction``), and no
disturbance besides; *free* and *schedule*, beliefs whose plans also choose the reaching law, those
of plants.py.  As in ``Cascade.simulate``, a decision is due every 0.1 s, and after what was learnt
in 20 ms where that is news; it has the time until the deadline, and nobody is charged for
computing.

Reached is ‖x‖ ≤ 0.01 of the true state at a sample, by the deadline, 10 s for energy and 6 s for
time; cost counts the input as written, until then.  *Over the bound* compares with the best that an
input could do on that very plant: it waits for the delay, without any input, and from where that
leaves the pendulum collocation with the friction −F tanh(q̇/w) takes over, with w halved until the
bound moves by less than half a percent.  *Nearest* is the smallest ‖x‖ of a run, the worst of all
plants, and *rest* the largest ‖x‖ in the second after arriving, the worst of those that arrived.
Bounds need CasADi.
"""

from __future__ import annotations

from harness import command_line, need, table  # isort: skip  first: one thread

import math
import os
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import sympy as sp

import undertow as ut
from plants import (
    OBJECTIVES,
    RADIUS,
    ROTARY,
    Task,
    cascade,
    drawn,
    first_optimum,
    model,
    studied,
)
from undertow.base import UndertowError
from undertow.cascade.simulation import LEARNING, is_news
from undertow.closed_loop.figures import state_words
from undertow.estimators import KalmanFilter
from undertow.estimators.recorded_run import compensated
from undertow.law import InnerLoop
from undertow.models import FloatArray
from undertow.plants import Bench, Friction, RealisticRig, Timing
from undertow.runtime import estimator_for

NAME = "rotary_pendulum"
CONTROLLERS = ("kept", "exact", "belief", "level", "free", "schedule")
PERIOD, STEPS = 0.001, 4
#: What is watched after arriving, s; how far the pendulum may lean.
AFTER, FALLEN = 1.0, math.pi / 2
#: Widths of the smoothed friction of the bound, rad/s; and what it may move by, as a part.
WIDTHS, SETTLED = [0.1 / 2**k for k in range(8)], 0.005


@dataclass(frozen=True)
class Plant:
    """A mechanism, the friction of its motor axis, N m, and the delay of its input, s."""

    mechanism: ut.Mechanism
    friction: float
    delay: float

    @property
    def bench(self) -> Bench:
        """The plant as it is controlled."""
        rubs = {"theta": Friction(self.friction)} if self.friction else {}
        timing = Timing(PERIOD, input_delay=self.delay, steps=STEPS)
        return Bench(self.mechanism, friction=rubs, timing=timing)

    def left_alone(self, x0: FloatArray) -> FloatArray:
        """Return where it is once the first input acts."""
        if not self.delay:
            return x0
        timing = Timing(self.delay, steps=round(self.delay * STEPS / PERIOD))
        rig = RealisticRig(replace(self.bench, timing=timing), x0)
        rig.write(np.zeros(self.mechanism.m))
        return rig.truth


@dataclass(frozen=True)
class Outcome:
    """What a controller did to one plant, and the least that this plant allows."""

    task: Task
    controller: str
    plant: int
    friction: float
    delay: float
    event: str
    cost: float
    nearest: float
    rest: float
    bound: float

    @property
    def reached(self) -> bool:
        """Whether it arrived in time."""
        return self.event == "REACHED"


def plant_of(seed: int, number: int, friction: float, delay: float) -> Plant:
    """Return a plant: the mechanism of plants.py, and what this bench adds."""
    rng, step = np.random.default_rng([seed, number, 1]), PERIOD / STEPS
    level, late = friction * rng.uniform(), delay * rng.uniform()
    return Plant(drawn(NAME, seed, number), level, step * round(late / step))


@cache
def level_cascade(objective: str, friction: float) -> ut.Cascade:
    """Return a cascade whose belief knows that there is friction of at most some level."""
    rig = model(NAME).with_friction(theta=friction)
    known = {p.name: p.value for p in rig.parameters}
    tolerances = {name: part * known[name] for name, part in ROTARY.items()}
    tolerances["friction_theta"] = known["friction_theta"]
    return ut.Cascade(rig, OBJECTIVES[objective], belief=ut.Belief(rig, tolerances))


class Steering:
    """A cascade in simulated time, its decisions as in ``Cascade.simulate``, on estimates.

    As there, the law goes on with learnt parameters once it has been seen whether the plan bears
    them: taken over at every sample, they turn the input's sign near a singular plant.
    """

    def __init__(self, run: ut.Cascade, x0: FloatArray, estimator: KalmanFilter) -> None:
        self.run, self.estimator, self.deadline = run, estimator, run.objective.horizon
        self.memory, _ = run.start(x0)
        self.in_use = surface, reaching = self.memory.plan.at(0.0)
        self.law = InnerLoop(run.mechanism, surface, reaching or run.reaching)
        self.planned_with, self.ticks = self.memory.estimate, 1

    def __call__(self, t: float, x: FloatArray) -> FloatArray:
        """Return the input at (t, x)."""
        if t >= self.ticks * LEARNING - 1e-9:
            self._decide(self.ticks * LEARNING, x)
            self.ticks += 1
        surface, reaching = use = self.memory.plan.at(t - self.memory.since + 1e-9)
        if use != self.in_use:
            self.in_use = use
            self.law.use(surface, reaching or self.run.reaching)
        return self.law(x)

    def _decide(self, t: float, x: FloatArray) -> None:
        run = self.run
        if run.known is not None:
            self.memory = replace(self.memory, estimate=self.estimator.learnt)
            self.law.parameters[:] = self.estimator.parameters
        due = self.ticks % round(run.period / LEARNING) == 0
        left = self.deadline - t
        if left <= 0.5 * run.step or np.linalg.norm(x) <= run.objective.terminal_radius:
            return
        news = is_news(self.planned_with, self.memory.estimate)
        if due or news or not run.survives(self.memory, x, t):
            proposal = run.propose(self.memory, x, t, left)
            self.memory, _ = run.apply_gate(self.memory, proposal, x, left)
            self.planned_with = self.memory.estimate


def steered(
    task: Task, controller: str, plant: Plant, most: float, drift: float | None = None
) -> Outcome:
    """Run a controller on a plant."""
    rig, x0 = RealisticRig(plant.bench, task.x0), task.x0
    law: Any
    if controller == "kept":
        estimator = estimator_for(task.rig, plant.bench, drift, ut.Belief.usual(task.rig))
        kept = InnerLoop(task.rig, first_optimum(task))
        law = lambda t, x: kept(x)  # noqa: E731
    else:
        if controller == "level":
            run = level_cascade(task.objective, most)
        else:
            run = cascade(NAME, task.objective, controller)
        drift = 0.0 if controller == "level" else drift
        estimator = estimator_for(run.mechanism, plant.bench, drift, run.known)
        law = Steering(run, x0, estimator)
    estimator.reset(x0)
    law = compensated(law, estimator, task.rig.input_limits)
    u, spent, event, cost = np.zeros(task.rig.m), 0.0, "HORIZON", math.inf
    nearest, rest, end = math.inf, 0.0, task.aim.horizon
    while rig.t < end - 0.5 * PERIOD:
        away = float(np.linalg.norm(rig.truth))
        nearest = min(nearest, away)
        if event == "REACHED":
            rest = max(rest, away)
        elif away <= RADIUS:
            event, cost, end = "REACHED", spent, rig.t + AFTER
        if not abs(rig.truth[1]) < FALLEN:
            event = "FALLEN" if event == "HORIZON" else event
            break
        u = np.array(law(rig.t, estimator.estimate(rig.read(), u)))
        spent += PERIOD * (float(u @ u) if task.objective == "energy" else 1.0)
        rig.write(u)
    return Outcome(
        task, controller, -1, plant.friction, plant.delay, event, cost, nearest, rest, math.nan
    )


def least(task: Task, plant: Plant) -> float:
    """Return the bound of a plant; NaN where none was found."""
    start = plant.left_alone(task.x0)
    inside = ut.state_box(phi=FALLEN)
    aim = replace(task.aim, constraints=inside, horizon=task.aim.horizon - plant.delay)
    velocity = plant.mechanism.coordinates[0].velocity
    idle = plant.delay if task.objective == "time" else 0.0
    before = math.nan
    try:
        if not plant.friction:
            return idle + float(ut.bound(plant.mechanism, aim, start).cost)
        for width in WIDTHS:
            force = -plant.friction * sp.tanh(velocity / width)
            found = ut.bound(plant.mechanism.disturbed({"theta": force}), aim, start)
            now = idle + float(found.cost)
            if abs(now - before) < SETTLED * now:
                return now
            before = now
    except UndertowError:
        pass
    return math.nan


def outcomes(
    job: tuple[Task, int], controllers: tuple[str, ...], seed: int, friction: float, delay: float,
    drift: float | None, bounds: bool,
) -> list[Any]:  # fmt: skip
    """Run all controllers on one plant."""
    task, number = job
    plant = plant_of(seed, number, friction, delay)
    lowest = least(task, plant) if bounds else math.nan
    found = []
    for name in controllers:
        one = steered(task, name, plant, friction, drift)
        found.append(replace(one, plant=number, bound=lowest))
    return found


def row(some: list[Outcome]) -> list[str]:
    """Return a line of the table."""
    arrived = [one for one in some if one.reached]
    lost = sum(one.event == "FALLEN" for one in some)
    cells = [some[0].controller, f"{len(arrived)} of {len(some)}", str(lost)]
    nearest = f"{max(one.nearest for one in some):.2g}"
    if not arrived:
        return [*cells, *["—"] * 5, nearest, "—"]
    costs = np.array([one.cost for one in arrived])
    over = np.array([one.cost / one.bound for one in arrived])
    over = over if np.isnan(over).all() else over[~np.isnan(over)]
    figures = [np.median(over), np.quantile(over, 0.9), over.max()]
    cells += [f"{np.median(costs):.4g}", f"{costs.max():.4g}"]
    cells += ["—" if math.isnan(value) else f"{value:.3f}" for value in figures]
    return [*cells, nearest, f"{max(one.rest for one in arrived):.2g}"]


def shown(task: Task, here: list[Outcome], what: str) -> None:
    """Print the table of a task."""
    header = ["", "reached", "lost", "median", "worst"]
    header += ["over the bound", "90 %", "worst", "nearest", "rest"]
    groups = [[one for one in here if one.controller == name] for name in CONTROLLERS]
    unit = ut.objective_for(task.rig, task.objective).unit
    title = f"{task.objective}, {unit}, from {state_words(task.rig, task.x0)}, {what}"
    table(title, header, [row(group) for group in groups if group])


def main() -> int:
    """Run the study and print its tables."""
    parser = command_line(
        __doc__,
        "--friction 0 --delay 0 --plants 60",
        "--objective time --controller belief --controller free",
        "--plants 10 --seed 7 --objective energy --angle 37 --controller belief --drift 0",
        clocks=False,
    )
    parser.add_argument("--plants", type=int, default=30, help="how many are drawn")
    parser.add_argument("--seed", type=int, default=0, help="of the plants")
    parser.add_argument("--friction", type=float, default=0.02, help="at most, N m")
    parser.add_argument("--delay", type=float, default=0.003, help="at most, s")
    parser.add_argument("--drift", type=float, help="of the disturbance, V/√s; the filter's 1.5")
    parser.add_argument("--angle", type=float, action="append", help="degrees; 30 and 37")
    parser.add_argument("--objective", choices=tuple(OBJECTIVES), action="append", help="both")
    parser.add_argument("--controller", choices=CONTROLLERS, action="append",
                        help="kept, exact and belief")  # fmt: skip
    parser.add_argument("--no-bounds", action="store_true", help="no bound of any plant")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="processes")
    parser.add_argument("--out", type=Path, help="a CSV file for every single outcome")
    asked = parser.parse_args()
    plants = 2 if asked.quick else asked.plants
    if plants < 1 or asked.workers < 1 or min(asked.friction, asked.delay) < 0:
        parser.error("--plants and --workers must be at least 1, --friction and --delay 0")
    if not asked.no_bounds:
        need("casadi", "compare")
    controllers = tuple(asked.controller or CONTROLLERS[:3])
    if "level" in controllers and not asked.friction:
        parser.error("level needs --friction")
    angles = asked.angle or ([30.0] if asked.quick else [30.0, 37.0])
    aims: list[Any] = asked.objective or list(OBJECTIVES)
    rig = model(NAME)
    tasks = [
        Task(NAME, aim, tuple(map(float, rig.state(phi=ut.deg(angle)))))
        for aim in aims
        for angle in angles
    ]
    run: Any = partial(
        outcomes, controllers=controllers, seed=asked.seed, friction=asked.friction,
        delay=asked.delay, drift=asked.drift, bounds=not asked.no_bounds,
    )  # fmt: skip
    jobs = [(task, k) for task in tasks for k in range(plants)]
    what = f"{plants} plants, seed {asked.seed}, friction to {asked.friction:g} N m, "
    what += f"delay to {1e3 * asked.delay:g} ms"
    what += "" if asked.drift is None else f", drift {asked.drift:g} V/√s"
    studied(jobs, run, asked.workers, asked.out, partial(shown, what=what))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
