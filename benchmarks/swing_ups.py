"""From hanging at rest to balanced, on plants that are not the model.

The mechanisms of the library that have a swing-up, at rest where they hang; 30 s.  The energy law
with the gains that the library keeps, the catch and the law that balances know the model alone.
Plants are those of plants.py: the rotary pendulum's mass, half length, inertia, motor and damping
within ±20, ±5, ±20, ±10 and ±50 % of the model's, everyone else's masses and inertias within
±10 %, lengths within ±3 %, damping within ±50 %.  Plant number k of a seed is always the same one.

States are exact, and inputs act at once, a thousand times a second.  With ``--rig`` the plant
stands on a realistic bench: encoders, delay, jitter, dry friction, a Kalman filter that knows the
model and learns what is usually uncertain of it; the law balances with that.  With ``--run`` the
same rigs are run as ``undertow run NAME --rig realistic --swing-up --simulated`` runs its own: the
runtime swings up and catches, and its cascade goes on.

*Balanced* was home for the last second: what is not driven within 2°, what is driven within 20° or
0.35 m.  *Caught* is the last hand-over to the law, *thrown out* how often one was lost again, in
all, *end stop* how many plants ran into one.
"""

from __future__ import annotations

from harness import command_line, progress, table  # isort: skip  first: one thread

from dataclasses import replace
from functools import cache, partial

import numpy as np

from plants import drawn, model
from undertow.cascade import CascadeState
from undertow.cascade.swing_up import CatchRegion, SwingUp, designed
from undertow.estimators import Measured, Record
from undertow.models import FloatArray
from undertow.plants import Bench, RealisticRig, RigWrapper
from undertow.plants.bench import bench_for
from undertow.runtime import InlineWorker, Recipe, Runtime, SimulatedClock
from undertow.studies.trials.trial import judge
from undertow.studies.trials.upright import SWING_SECONDS, SWINGING, SwingRun, swing_trial

#: Part of the plants that is to end balanced.
WANTED = 0.99


@cache
def designs(name: str) -> tuple[SwingUp, CatchRegion]:
    """Return the energy law and the catch for a model; one for each process."""
    return designed(model(name)), CatchRegion(model(name))


def swung(name: str, seed: int, number: int, rig: bool) -> SwingRun:
    """Swing a plant up, with ideal states or on a realistic rig."""
    plant = drawn(name, seed, number)
    if rig:
        bench = replace(bench_for(model(name)), mechanism=plant, tolerance={})
        return swing_trial(bench, *designs(name), seed=number)
    bench = Bench(plant, tachometers={}).with_timing(steps=1)
    return swing_trial(bench, *designs(name), estimator=Measured(model(name)))


class Recorder(RigWrapper):
    """A simulated rig of which times, true states and inputs are kept."""

    def __init__(self, rig: RealisticRig) -> None:
        super().__init__(rig)
        self.plant = rig
        self.rows: list[tuple[float, FloatArray, FloatArray]] = []

    def write(self, u: FloatArray) -> None:
        """Keep what there is, and pass the input on."""
        self.rows.append((self.plant.t, self.plant.truth, u.copy()))
        self.rig.write(u)


@cache
def prepared(name: str) -> tuple[Recipe, CascadeState]:
    """Return what a run is made of, and what its cascade starts with; one for each process."""
    recipe = Recipe(model(name), rig="realistic", swing_up=True)
    memory = recipe.first()
    recipe.precompile(memory)
    return recipe, memory


def run(name: str, seed: int, number: int) -> SwingRun:
    """Swing a plant up by the runtime, in simulated time."""
    recipe, memory = prepared(name)
    mechanism, bench = recipe.belief, replace(recipe.bench, mechanism=drawn(name, seed, number))
    rig = Recorder(RealisticRig(replace(bench, tolerance={}), recipe.x0, number))
    controller, worker = recipe.make_controller(memory), InlineWorker(recipe.respond)
    report = Runtime(controller, rig, worker, clock=SimulatedClock()).run(SWING_SECONDS)
    rows = [row for row in rig.rows if row[0] < SWING_SECONDS]
    t, truth, u = (np.array(column) for column in zip(*rows, strict=True))
    upright = truth - designs(name)[1].turns(truth[-1])
    outcome = judge(mechanism, Record(t, truth[:, : mechanism.n], truth, u, upright), number)
    caught = [t for t, _, text in report.events if "SWING_UP → CATCH" in text]
    thrown, stopped = max(0, report.entered["SWING_UP"] - 1), rig.plant.stops_hit > 0
    return SwingRun(outcome, caught[-1] if caught else np.nan, thrown, stopped)


def row(name: str, runs: list[SwingRun]) -> list[str]:
    """Return a line of the table."""
    caught = np.array([run.catch for run in runs if run.outcome.balanced])
    times = [f"{value:.2f}" for value in (np.median(caught), caught.max())] if len(caught) else []
    counts = (sum(run.thrown for run in runs), sum(run.stop for run in runs))
    return [name, f"{len(caught)} of {len(runs)}", *(times or ["—", "—"]), *map(str, counts)]


def main() -> None:
    """Run the study and print its table."""
    parser = command_line(
        __doc__, "--plants 20 --seed 7 --only pendubot", "--rig --plants 20", clocks=False
    )
    parser.add_argument("--plants", type=int, default=100, help="how many of each mechanism")
    parser.add_argument("--seed", type=int, default=0, help="of the plants")
    parser.add_argument("--only", choices=SWINGING, action="append", help="a mechanism; all")
    how = parser.add_mutually_exclusive_group()
    how.add_argument("--rig", action="store_true", help="realistic rigs, positions only")
    how.add_argument("--run", action="store_true", help="the same rigs, by the runtime")
    asked = parser.parse_args()
    if asked.plants < 1 or asked.seed < 0:
        parser.error("--plants must be at least 1, --seed at least 0")
    plants = 2 if asked.quick else asked.plants
    rows, lines = [], []
    for name in asked.only or SWINGING:
        numbers = progress(range(plants), name)
        swing = run if asked.run else partial(swung, rig=asked.rig)
        runs = [swing(name, asked.seed, number) for number in numbers]
        rows.append(row(name, runs))
        fallen = [str(k) for k, run in enumerate(runs) if not run.outcome.balanced]
        part = 1.0 - len(fallen) / plants
        met = "yes" if part >= WANTED else "no"
        which = f"; not: {', '.join(fallen)}" if fallen else ""
        lines.append(f"{name}: {part:.1%} balanced (wanted: {WANTED:.0%}): {met}{which}")
    states = "ideal states"
    if asked.rig or asked.run:
        states = "realistic rigs" + ", the runtime" * asked.run
    title = f"From hanging to balanced, {states}, {SWING_SECONDS:g} s, {plants} plants each, "
    header = ["", "balanced", "caught after, median s", "longest", "thrown out", "end stop"]
    table(f"{title}seed {asked.seed}", header, rows)
    print("\n" + "\n".join(lines))


if __name__ == "__main__":
    main()
