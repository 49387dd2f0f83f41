"""Plants that are not the model: who arrives, how soon, and at what cost.

The rotary pendulum (d_e = 0.073) from rest.  Each plant's mass, half length, inertia, motor and
damping are drawn evenly within ±20, ±5, ±20, ±10 and ±50 % of the model's, plant number k of a seed
always the same one.  States are exact, the law acts continuously; every controller meets the same
plants and knows the model alone.

*kept* is the optimum for the model from the start, kept to the end.  *exact* is the cascade that
takes its model for the plant.  *belief* is the cascade with a belief: an ensemble of what is
plausible, learnt as it goes, every 20 ms.  Energy has a deadline of 10 s, time one of 6 s.

*Lost* counts plants that met the singularity or left the region; the others, not reached, stayed
upright and were late.  *Over the bound* compares with the best that an input could do on that very
plant (collocation that knows it, same deadline), and needs CasADi; it counts reached plants alone.
"""

from __future__ import annotations

from harness import command_line, progress, table  # isort: skip  first: one thread

import csv
import math
import multiprocessing
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

import undertow as ut

SPREAD = {"m": 0.2, "l": 0.05, "I_e": 0.2, "a_e": 0.1, "d_e": 0.5}
RIG = ut.mechanisms.rotary_pendulum()
OBJECTIVES = {"energy": ut.MinimumEnergy(horizon=10.0), "time": ut.MinimumTime(horizon=6.0)}
CONTROLLERS = ("kept", "exact", "belief")


@dataclass(frozen=True)
class Outcome:
    """What a controller did to one plant, and the least that this plant allows."""

    objective: str
    degrees: float
    controller: str
    plant: int
    event: str
    cost: float
    bound: float = math.nan

    @property
    def reached(self) -> bool:
        """Whether it arrived in time."""
        return self.event == "REACHED"

    @property
    def lost(self) -> bool:
        """Whether it fell, rather than being late."""
        return self.event not in ("REACHED", "HORIZON")


def drawn(seed: int, number: int) -> ut.Mechanism:
    """Return a plant."""
    rng = np.random.default_rng([seed, number])
    values = {p.name: p.value for p in RIG.parameters}
    changed = {k: values[k] * (1.0 + rng.uniform(-part, part)) for k, part in SPREAD.items()}
    return RIG.with_parameters(**changed)


@cache
def cascade(objective: str, controller: str) -> ut.Cascade:
    """Return a cascade; one for each process."""
    if controller == "belief":
        belief = ut.Belief.relative(RIG, **SPREAD)
        return ut.Cascade(RIG, OBJECTIVES[objective], belief=belief)
    return ut.Cascade(RIG, OBJECTIVES[objective], belief="exact")


@cache
def first_optimum(objective: str, degrees: float) -> ut.Surface:
    """Return the surface that is best for the model from a start."""
    return cascade(objective, "exact").start(RIG.state(phi=ut.deg(degrees)))[0].plan.surfaces[0]


def least(objective: str, degrees: float, seed: int, number: int) -> float:
    """Return the bound of a plant."""
    plant = drawn(seed, number)
    aim = replace(OBJECTIVES[objective], constraints=ut.state_box(phi=math.pi / 2))
    found = ut.bound(plant, aim, plant.state(phi=ut.deg(degrees)))
    return float(found.cost)


def outcomes(
    job: tuple[str, float, int], controllers: tuple[str, ...], seed: int, bounds: bool
) -> list[Outcome]:
    """Run all controllers on one plant."""
    objective, degrees, number = job
    x0, plant = RIG.state(phi=ut.deg(degrees)), drawn(seed, number)
    lowest = least(objective, degrees, seed, number) if bounds else math.nan
    found = []
    for name in controllers:
        motion: Any
        if name == "kept":
            loop = ut.ClosedLoop(RIG, OBJECTIVES[objective], plant=plant)
            motion = loop.simulate(x0, first_optimum(objective, degrees))
            event, cost = motion.event, motion.cost
        else:
            motion = cascade(objective, name).simulate(x0, plant=plant)
            event, cost = motion.trajectory.event, motion.cost
        found.append(Outcome(objective, degrees, name, number, event.name, float(cost), lowest))
    return found


def every(
    jobs: list[tuple[str, float, int]],
    run: Callable[[tuple[str, float, int]], list[Outcome]],
    workers: int,
) -> Iterator[Outcome]:
    """Run all jobs on all cores; what comes does not depend on how many there are."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=context) as pool:
        for some in progress(pool.map(run, jobs), "plants", len(jobs)):
            yield from some


def row(some: list[Outcome], kept: dict[int, float]) -> list[str]:
    """Return a line of the table."""
    arrived = [one for one in some if one.reached]
    costs = np.array([one.cost for one in arrived])
    cells = [some[0].controller, f"{len(arrived)} of {len(some)}"]
    cells.append(str(sum(one.lost for one in some)))
    if not arrived:
        return [*cells, *["—"] * 6]
    cells += [f"{np.median(costs):.3f}", f"{costs.max():.3f}"]
    usual = np.median(list(kept.values())) if kept else math.nan
    over = np.array([one.cost / one.bound for one in arrived])
    figures = [np.median(costs) / usual, np.median(over), np.quantile(over, 0.99), over.max()]
    return cells + ["—" if math.isnan(value) else f"{value:.3f}" for value in figures]


def main() -> int:
    """Run the study and print its tables."""
    parser = command_line(
        __doc__, "--plants 20 --seed 7 --objective energy --angle 37 --bounds", clocks=False
    )
    parser.add_argument("--plants", type=int, default=60, help="how many are drawn")
    parser.add_argument("--seed", type=int, default=0, help="of the plants")
    parser.add_argument("--angle", type=float, action="append", help="degrees; 30 and 37")
    parser.add_argument("--objective", choices=tuple(OBJECTIVES), action="append", help="both")
    parser.add_argument("--controller", choices=CONTROLLERS, action="append", help="all")
    parser.add_argument("--bounds", action="store_true", help="the bound of every plant, too")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="processes")
    parser.add_argument("--out", type=Path, help="a CSV file for every single outcome")
    asked = parser.parse_args()
    plants = 2 if asked.quick else asked.plants
    if plants < 1 or asked.workers < 1:
        parser.error("--plants and --workers must be at least 1")
    angles = asked.angle or ([30.0] if asked.quick else [30.0, 37.0])
    names = tuple(asked.controller or CONTROLLERS)
    aims = asked.objective or list(OBJECTIVES)
    jobs = [(aim, angle, k) for aim in aims for angle in angles for k in range(plants)]
    run = partial(outcomes, controllers=names, seed=asked.seed, bounds=asked.bounds)
    found = list(every(jobs, run, asked.workers))
    if asked.out:
        with asked.out.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(list(Outcome.__dataclass_fields__))
            writer.writerows(list(vars(one).values()) for one in found)
    header = ["", "reached", "lost", "median", "worst", "of kept's"]
    header += ["over the bound", "99 %", "worst"]
    for aim in aims:
        for angle in angles:
            here = [one for one in found if (one.objective, one.degrees) == (aim, angle)]
            kept = {one.plant: one.cost for one in here if one.controller == "kept" and one.reached}
            unit = "s" if aim == "time" else "V² s"
            rows = [row([one for one in here if one.controller == name], kept) for name in names]
            table(
                f"{aim}, {unit}, from {angle:g}°, {plants} plants, seed {asked.seed}", header, rows
            )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
