"""Plants that are not the model: who arrives, how soon, and at what cost.

Mechanisms of the library at rest off their targets, each from two starts.  The rotary pendulum's
mass, half length, inertia, motor and damping (d_e = 0.073) are drawn evenly within ±20, ±5, ±20,
±10 and ±50 % of the model's; everyone else's masses and inertias within ±10 %, lengths within
±3 %, damping within ±50 %, told apart by their units.  Plant number k of a seed is always the same
one.  States are exact; every controller meets the same plants and knows the model alone.

*kept* is the optimum for the model from the start, small errors of state and surface allowed for,
kept to the end; *exact* the cascade that takes its model for the plant; *belief* the cascade with a
belief: an ensemble of what is plausible, learnt as it goes, every 20 ms; *free* the same that may
choose the reaching law, too; *schedule* one that chooses surfaces with reaching laws, each for
0.05 s.  Their law acts continuously, or with ``--hold`` is sampled, its input held.

*lqr* is clipped linear-quadratic feedback, continuous too, the best on the model of 39 weights,
by hindsight.  *predictive* plans anew a hundred times a second and holds its input in between: for
energy the real-time iteration in CasADi (multiple shooting to the deadline, one Gauss-Newton
programme a sample, warm-started), for time multiple shooting with a free final time, converged by
IPOPT at every sample, however long that takes.  *learnt* is the same with the parameters that the
library's ``Belief.learn`` finds in the motion so far.  *scenario* is multi-stage predictive control
in do-mpc, robust horizon 1, over the ensemble of the belief's prior, ten times a second, energy
alone.  *acados* is the real-time iteration of acados, energy alone, where ``--acados`` or
``UNDERTOW_ACADOS`` names a Python that has it.  Predictive control keeps 90 % of the travel that a
mechanism declares, softly.  Nobody is charged for computing; *plan* is the median processor time of
a planning.  Below a table stand the times of our searches after the first, by the clock.

Reached is ‖x‖ ≤ 0.01 by the deadline, 10 s for energy and 6 s for time; cost counts until then.
*Lost* counts plants that met the singularity, left 95 % of the travel or leant by a right angle;
the others, not reached, stayed upright and were late.  *Over the bound* compares with the best
that an input could do on that very plant (collocation that knows it, same deadline), and counts
reached plants alone.  Peers and bounds need CasADi, *scenario* do-mpc.
"""

from __future__ import annotations

from harness import command_line, need, progress, table  # isort: skip  first: one thread

import csv
import math
import multiprocessing
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from time import process_time
from typing import Any, Literal

import numpy as np

import undertow as ut
from predictive import PERIOD, Acados, RealTimeIteration, Sampled
from rivals import Box, DoMPC, Plant, ShootingMPC, tuned
from undertow.base import UndertowError
from undertow.closed_loop.figures import state_words
from undertow.mechanisms import LIBRARY
from undertow.models import FloatArray
from undertow.objective.objective import TRAVEL

#: How far parameters of these units are off, as a part of their values; others are certain.
PARTS = {"kg": 0.1, "kg m²": 0.1, "m": 0.03, "N m s/rad": 0.5, "N s/m": 0.5}
#: The rotary pendulum's own.
ROTARY = {"m": 0.2, "l": 0.05, "I_e": 0.2, "a_e": 0.1, "d_e": 0.5}
#: Times the usual start: the larger one.  The rotary pendulum has angles of its own.
LARGER = {
    "rotary_pendulum": 1.0,
    "cart_pendulum": 1.5,
    "overhead_crane": 2.0,
    "pendubot": 2.0,
    "acrobot": 2.0,
    "reaction_wheel_pendulum": 1.25,
    "wheeled_inverted_pendulum": 2.0,
    "ball_and_beam": 2.0,
    "double_pendulum_on_a_cart": 2.0,
    "two_motor_three_link": 1.5,
}
OBJECTIVES = {"energy": ut.MinimumEnergy(horizon=10.0), "time": ut.MinimumTime(horizon=6.0)}
RADIUS = 0.01
#: What cascades with a belief may choose.
FREEDOMS = {
    "belief": ut.DecisionVariables(),
    "free": ut.DecisionVariables(reaching=True),
    "schedule": ut.DecisionVariables(reaching=True, schedule=0.05),
}
OURS = ("kept", "exact", "belief", "free", "schedule")
PEERS = ("lqr", "predictive", "learnt", "scenario")
CONTROLLERS = (*OURS, *PEERS, "acados")
#: Longest step of a loop whose input is held, s: the library's usual one.
LONGEST = 0.002
#: Of the travel, what predictive control plans with; how far it lets angles lean that it does not
#: drive; and how far they may lean at all.
PLANNED, LEANING, FALLEN = 0.9, math.radians(85), math.pi / 2


@dataclass(frozen=True)
class Task:
    """A mechanism, an objective, a start, (2n,), and for how long our law's input is held, s."""

    mechanism: str
    objective: Literal["energy", "time"]
    start: tuple[float, ...]
    hold: float = 0.0

    @property
    def rig(self) -> ut.Mechanism:
        """The model."""
        return model(self.mechanism)

    @property
    def aim(self) -> ut.Objective:
        """What is best."""
        return OBJECTIVES[self.objective]

    @property
    def x0(self) -> FloatArray:
        """The start."""
        return np.array(self.start)

    @property
    def steps(self) -> dict[str, Any]:
        """Steps of our loops, 2 ms or a little less, some in a sample where the input is held."""
        if not self.hold:
            return {}
        count = math.ceil(self.hold / LONGEST - 1e-9)
        return {"step": self.hold / count, "zoh_steps": count}


Job = tuple[Task, int]


@dataclass(frozen=True)
class Outcome:
    """What a controller did to one plant, and the least that this plant allows.

    ``plans`` are the seconds of its plannings, of ours those after the first plan.
    """

    task: Task
    controller: str
    plant: int
    event: str
    cost: float
    plans: tuple[float, ...] = ()
    bound: float = math.nan

    @property
    def plan(self) -> float:
        """The median of its plannings, s; NaN without any."""
        return float(np.median(self.plans)) if self.plans else math.nan

    @property
    def reached(self) -> bool:
        """Whether it arrived in time."""
        return self.event == "REACHED"

    @property
    def lost(self) -> bool:
        """Whether it fell, or could not even be started, rather than being late."""
        return self.event not in ("REACHED", "HORIZON")


@cache
def model(name: str) -> ut.Mechanism:
    """Return a mechanism; one for each process."""
    return LIBRARY[name]()


@cache
def spread(name: str) -> dict[str, float]:
    """Return the uncertain parameters of a mechanism, and how far they are off, as parts."""
    if name == "rotary_pendulum":
        return ROTARY
    known = model(name).parameters
    return {p.name: PARTS[p.unit] for p in known if p.unit in PARTS and p.value != 0}


@cache
def belief(name: str) -> ut.Belief:
    """Return what is known of a mechanism before it moves."""
    return ut.Belief.relative(model(name), **spread(name))


def drawn(name: str, seed: int, number: int) -> ut.Mechanism:
    """Return a plant."""
    rng, rig = np.random.default_rng([seed, number]), model(name)
    values = {p.name: p.value for p in rig.parameters}
    parts = spread(name).items()
    return rig.with_parameters(**{k: values[k] * (1.0 + rng.uniform(-p, p)) for k, p in parts})


def box(name: str, travel: float, lean: float) -> Box:
    """Return a part of the travel that is declared, and how far what is not driven may lean."""
    rig = model(name)
    found: dict[str, tuple[float, float]] = {
        c.name: (-lean, lean) for c in rig.coordinates[rig.m :] if c.unit == "rad"
    }
    for c in rig.coordinates:
        if math.isfinite(c.low) or math.isfinite(c.high):
            found[c.name] = (travel * c.low, travel * c.high)
    return found


@cache
def cascade(name: str, objective: str, controller: str, hold: float = 0.0) -> ut.Cascade:
    """Return a cascade; one for each process."""
    rig, aim = model(name), OBJECTIVES[objective]
    steps = Task(name, objective, (), hold).steps  # type: ignore[arg-type]
    if controller in FREEDOMS:
        return ut.Cascade(rig, aim, belief=belief(name), freedom=FREEDOMS[controller], **steps)
    return ut.Cascade(rig, aim, belief="exact", **steps)


@cache
def first_optimum(task: Task) -> ut.Surface:
    """Return the first surface of the cascade with a belief."""
    memory, _ = cascade(task.mechanism, task.objective, "belief", task.hold).start(task.x0)
    return memory.plan.surfaces[0]


def ours(task: Task, controller: str, plant: ut.Mechanism) -> tuple[str, float, tuple[float, ...]]:
    """Run one of the library's controllers; return how it ended, its cost, and its plannings, s."""
    motion: Any
    plans: tuple[float, ...] = ()
    try:
        if controller == "kept":
            loop = ut.ClosedLoop(task.rig, task.aim, plant=plant, **task.steps)
            motion = loop.simulate(task.x0, first_optimum(task))
        else:
            made = cascade(task.mechanism, task.objective, controller, task.hold)
            run = made.simulate(task.x0, plant=plant)
            motion = run.trajectory
            plans = tuple(update.proposal.seconds for update in run.updates[1:])
    except UndertowError as error:
        return type(error).__name__, math.inf, ()
    return motion.event.name, float(motion.cost), plans


@cache
def predictive(name: str, objective: str, controller: str, start: tuple[float, ...]) -> Any:
    """Return a predictive controller; one for each process."""
    rig, room = model(name), box(name, PLANNED, LEANING)
    deadline = OBJECTIVES[objective].horizon
    names = tuple(spread(name)) if controller in ("learnt", "scenario") else ()
    if controller == "acados":
        return Acados(os.environ["UNDERTOW_ACADOS"], rig, room, deadline, RADIUS)
    if controller == "scenario":
        members = belief(name).ensemble(belief(name).prior).values
        known = [p.name for p in rig.parameters]
        members = members[:, [known.index(one) for one in names]]
        regulators = tuned(rig, start, RADIUS, deadline, tuple(room.items()))
        best = regulators.get("energy")
        return DoMPC(
            rig, "energy", RADIUS, now=process_time, members=members, names=names, box=room,
            regulator=best,
        )  # fmt: skip
    if objective == "energy":
        return RealTimeIteration(rig, room, deadline, RADIUS, names, now=process_time)
    return ShootingMPC(
        rig, "time", RADIUS, now=process_time, period=PERIOD, hold=PERIOD, box=room, names=names
    )


def peers(task: Task, controller: str, plant: ut.Mechanism) -> tuple[str, float, tuple[float, ...]]:
    """Run a peer; return how it ended, its cost, and its plannings, s."""
    name, energy = task.mechanism, task.objective == "energy"
    room = box(name, TRAVEL, FALLEN)
    truth = Plant(plant, RADIUS, task.aim.horizon, room)
    if controller == "lqr":
        found = tuned(task.rig, task.start, RADIUS, task.aim.horizon, tuple(room.items()))
        if not found:
            return "NONE", math.inf, ()
        outcome, plans = truth.regulated(task.x0, found[task.objective].K), ()
    else:
        start = task.start if controller == "scenario" else ()
        mpc = predictive(name, task.objective, controller, start)
        mpc.forget()
        mpc.seconds.clear()
        learning = belief(name) if controller == "learnt" else None
        control = mpc
        if controller != "scenario":
            control = Sampled(mpc, task.rig.input_limits, learning)
        outcome, plans = truth.held(task.x0, control), tuple(mpc.seconds)
    return outcome.event, outcome.energy if energy else outcome.time, plans


def least(task: Task, plant: ut.Mechanism) -> float:
    """Return the bound of a plant; NaN where none was found."""
    lean = {
        c.name: FALLEN for c in plant.coordinates[plant.m :] if c.unit == "rad" and c.low < -FALLEN
    }
    aim = replace(task.aim, constraints=ut.state_box(**lean))
    try:
        return float(ut.bound(plant, aim, task.x0).cost)
    except UndertowError:
        return math.nan


def outcomes(job: Job, controllers: tuple[str, ...], seed: int, bounds: bool) -> list[Outcome]:
    """Run all controllers on one plant."""
    task, number = job
    plant = drawn(task.mechanism, seed, number)
    lowest = least(task, plant) if bounds else math.nan
    found = []
    for name in controllers:
        if name in ("scenario", "acados") and task.objective == "time":
            continue
        event, cost, plans = (ours if name in OURS else peers)(task, name, plant)
        found.append(Outcome(task, name, number, event, cost, plans, lowest))
    return found


def every(
    jobs: list[Job], run: Callable[[Job], list[Outcome]], workers: int
) -> Iterator[list[Outcome]]:
    """Run all jobs on all cores; what comes does not depend on how many there are."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=context) as pool:
        yield from progress(pool.map(run, jobs), "plants", len(jobs))


def row(some: list[Outcome], kept: dict[int, float]) -> list[str]:
    """Return a line of the table."""
    arrived = [one for one in some if one.reached]
    costs = np.array([one.cost for one in arrived])
    cells = [some[0].controller, f"{len(arrived)} of {len(some)}"]
    cells.append(str(sum(one.lost for one in some)))
    plan = math.nan if some[0].controller in OURS else np.median([one.plan for one in some])
    last = "—" if math.isnan(plan) else f"{1e3 * plan:.1f}"
    if not arrived:
        return [*cells, *["—"] * 6, last]
    cells += [f"{np.median(costs):.4g}", f"{costs.max():.4g}"]
    usual = np.median(list(kept.values())) if kept else math.nan
    over = np.array([one.cost / one.bound for one in arrived])
    over = over if np.isnan(over).all() else over[~np.isnan(over)]
    figures = [np.median(costs) / usual, np.median(over), np.quantile(over, 0.99), over.max()]
    cells += ["—" if math.isnan(value) else f"{value:.3f}" for value in figures]
    return [*cells, last]


def shown(task: Task, here: list[Outcome], seed: str) -> None:
    """Print the table of a task."""
    header = ["", "reached", "lost", "median", "worst", "of kept's"]
    header += ["over the bound", "99 %", "worst", "plan, ms"]
    kept = {one.plant: one.cost for one in here if one.controller == "kept" and one.reached}
    groups = [[o for o in here if o.controller == name] for name in CONTROLLERS]
    unit = ut.objective_for(task.rig, task.objective).unit
    plants = len({one.plant for one in here})
    title = f"{task.mechanism}, {task.objective}, {unit}, from "
    title += f"{state_words(task.rig, task.x0)}, {plants} plants, {seed}"
    title += f", our input held for {1e3 * task.hold:g} ms" if task.hold else ""
    table(title, header, [row(group, kept) for group in groups if group])
    for group in groups:
        seconds = 1e3 * np.array([t for one in group for t in one.plans])
        if len(seconds) and group[0].controller in OURS:
            median, most = np.quantile(seconds, [0.5, 0.95])
            words = f"{median:.1f} ms in the median, {most:.1f} ms in 95 %, {seconds.max():.0f} ms"
            print(f"{group[0].controller}: {words} at most, of {len(seconds):,} searches")


def starts(name: str, factors: list[float] | None, angles: list[float]) -> list[FloatArray]:
    """Return the starts of a mechanism: the rotary pendulum's by angles, of others by factors."""
    rig = model(name)
    if name == "rotary_pendulum" and factors is None:
        return [rig.state(phi=ut.deg(angle)) for angle in angles]
    return [factor * rig.usual_start for factor in factors or [1.0, LARGER[name]]]


def uncertain(names: list[str]) -> None:
    """Print what is uncertain of each mechanism."""
    rows = []
    for name in names:
        rig = model(name)
        parts: dict[float, list[str]] = {}
        for parameter, part in spread(name).items():
            parts.setdefault(part, []).append(parameter)
        said = "; ".join(f"±{100 * part:g} % {', '.join(those)}" for part, those in parts.items())
        members = len(belief(name).ensemble(belief(name).prior))
        rows.append([name, f"{rig.n}, {rig.m}", str(members), said])
    table("what is uncertain", ["", "n, m", "members", "parameters"], rows)


def written(found: list[Any], path: Path) -> None:
    """Write every outcome to a CSV file: its task, and its other fields."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        fields = [name for name in found[0].__dataclass_fields__ if name != "task"]
        fields = ["plan" if name == "plans" else name for name in fields]
        writer.writerow(["mechanism", "objective", "start", *fields])
        for one in found:
            task = one.task
            first = [task.mechanism, task.objective, state_words(task.rig, task.x0)]
            writer.writerow([*first, *(getattr(one, field) for field in fields)])


def studied(
    jobs: list[Job], run: Callable[[Job], list[Any]], workers: int, out: Path | None,
    tell: Callable[[Task, list[Any]], None],
) -> None:  # fmt: skip
    """Run all jobs, keep their outcomes in a file, and tell of each task when it is done."""
    found: list[Any] = []
    for index, some in enumerate(every(jobs, run, workers), 1):
        found += some
        if out:
            written(found, out)
        task = jobs[index - 1][0]
        if index == len(jobs) or jobs[index][0] != task:
            tell(task, [one for one in found if one.task == task])


def main() -> int:
    """Run the study and print its tables."""
    parser = command_line(
        __doc__,
        "--plants 20 --seed 7 --objective energy --angle 37 --bounds",
        "--mechanism cart_pendulum --mechanism acrobot --controller belief --controller learnt",
        "--mechanism all --plants 6 --bounds --out outcomes.csv",
        clocks=False,
    )
    parser.add_argument(
        "--mechanism", choices=(*LARGER, "all"), action="append", help="rotary_pendulum"
    )
    parser.add_argument("--plants", type=int, default=60, help="how many are drawn")
    parser.add_argument("--seed", type=int, default=0, help="of the plants")
    parser.add_argument(
        "--angle", type=float, action="append", help="of the rotary pendulum, degrees; 30 and 37"
    )
    parser.add_argument(
        "--start", type=float, action="append", help="times the usual start; 1 and a larger one"
    )
    parser.add_argument("--objective", choices=tuple(OBJECTIVES), action="append", help="both")
    parser.add_argument(
        "--hold", type=float, default=0.0, help="ms for which our input is held; 0: continuous"
    )
    parser.add_argument(
        "--controller", choices=CONTROLLERS, action="append", help="all that are there"
    )
    parser.add_argument("--acados", help="a Python that has acados; $UNDERTOW_ACADOS")
    parser.add_argument("--bounds", action="store_true", help="the bound of every plant, too")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="processes")
    parser.add_argument("--out", type=Path, help="a CSV file for every single outcome")
    asked = parser.parse_args()
    plants = 2 if asked.quick else asked.plants
    if not 0 <= asked.hold <= 100:
        parser.error("--hold must be 0 to 100 ms: 0 is continuous, 1 a loop of 1 kHz")
    if plants < 1 or asked.workers < 1:
        parser.error("--plants and --workers must be at least 1")
    if asked.acados:
        os.environ["UNDERTOW_ACADOS"] = asked.acados
    there = (*OURS, *PEERS, *(["acados"] if "UNDERTOW_ACADOS" in os.environ else []))
    usual = tuple(name for name in there if name != "scenario") if asked.quick else there
    controllers = tuple(asked.controller or usual)
    if "acados" in controllers and "acados" not in there:
        parser.error("acados needs --acados, a Python that has it")
    if set(controllers) - set(OURS) or asked.bounds:
        need("casadi", "compare")
    if "scenario" in controllers:
        need("do_mpc", "compare")
    names = list(dict.fromkeys(asked.mechanism or ["rotary_pendulum"]))
    names = list(LARGER) if "all" in names else names
    angles = asked.angle or ([30.0] if asked.quick else [30.0, 37.0])
    factors = asked.start or ([1.0] if asked.quick and asked.mechanism else None)
    aims: list[Any] = asked.objective or list(OBJECTIVES)[: 1 if asked.quick else None]
    tasks = [
        Task(name, aim, tuple(map(float, x0)), 1e-3 * asked.hold)
        for name in names
        for aim in aims
        for x0 in starts(name, factors, angles)
    ]
    uncertain(names)
    jobs = [(task, k) for task in tasks for k in range(plants)]
    run = partial(outcomes, controllers=controllers, seed=asked.seed, bounds=asked.bounds)
    studied(jobs, run, asked.workers, asked.out, partial(shown, seed=f"seed {asked.seed}"))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
