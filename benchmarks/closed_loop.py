"""What each controller makes of the same plant from the same start: energy and time.

Controllers, all built from the model alone:

* *cascade*: undertow's, re-optimised every 0.1 s; for energy, for time, and for time with the
  reaching law free.  It takes its model for the plant.
* *belief*: the same with what is usually not known of the model, learnt as it goes: the default;
  and for time with a schedule of surfaces, each for 0.05 s.  *plan* is by the wall clock here.
* *LQR, clipped*: u = −K x, continuous; its weights are the best by hindsight on the model, of 39
  pairs, once for energy and once for time.
* *NMPC*: multiple shooting in CasADi with IPOPT, re-planned every 0.1 s, its plan applied
  between; energy with a quadratic cost-to-go over 5 s, or time with a free final time (near the
  target, where its plan ends, linear feedback).
* *do-mpc*: energy, 25 intervals of 0.1 s, inputs held.

Plants: as modelled; all pendulum masses 20 % heavier; and Coulomb friction in the driven joint
besides.  The *bound* is the least that any input could do on the plant itself, by collocation,
and knows the plant; energy over 60 s, pendulums kept above the horizontal.  Both totals count
until ‖x‖ ≤ 0.01.  No controller is charged for its computing time: inputs act at once; *plan*
is what a (re-)planning took, for comparison with the period of 100 ms.  A run
that does not arrive within 60 s (cascade and NMPC for time: 10 s) *falls*, or *stays* at some ‖x‖.
"""

from __future__ import annotations

from harness import Clock, clock, command_line, need, progress, table  # isort: skip

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import sympy as sp

import undertow as ut
from rivals import DoMPC, Outcome, Plant, ShootingMPC, tuned
from undertow.base import UndertowError
from undertow.models import FloatArray, Parameter

HORIZON, RADIUS = 60.0, 0.01

#: A controller that is to be quick is given up after this time, s.
PATIENCE = 10.0


@dataclass(frozen=True, eq=False)
class Scene:
    """A mechanism, its start, and the ways in which the truth departs from it.

    ``masses`` are the parameters that are 20 % larger; ``joint`` the driven coordinate with
    Coulomb friction ``friction``, N m or N, rounded off below ``width``, rad/s or m/s.
    """

    rig: ut.Mechanism
    start: dict[str, float]
    masses: tuple[str, ...]
    joint: str
    friction: float
    width: float
    upright: str

    @property
    def x0(self) -> FloatArray:
        """The initial state."""
        return self.rig.state(**self.start)

    @property
    def title(self) -> str:
        """Mechanism and start in words."""
        angle = math.degrees(self.start[self.upright])
        return f"{self.rig.name}, {self.upright}(0) = {angle:g}°"

    def plants(self) -> dict[str, ut.Mechanism]:
        """Return the truths by name."""
        values = {p.name: p.value for p in self.rig.parameters}
        heavy = self.rig.with_parameters(**{m: 1.2 * values[m] for m in self.masses})
        speed = next(c.velocity for c in heavy.coordinates if c.name == self.joint)
        unit = "N m" if self.rig.coordinates[0].unit == "rad" else "N"
        mu = Parameter("mu", self.friction, unit, "Coulomb friction of the driven joint", 0)
        rough = heavy.disturbed({self.joint: -mu.symbol * sp.tanh(speed / self.width)}, [mu])
        return {
            "as modelled": self.rig,
            "masses + 20 %": heavy,
            f"masses + 20 %, friction {self.friction:g} {unit}": rough,
        }


def scenes() -> dict[str, Scene]:
    """Return the scenes by the names of the command line."""
    rotary, cart = ut.mechanisms.rotary_pendulum(d_e=0.025), ut.mechanisms.cart_pendulum()

    def at(degrees: float) -> dict[str, float]:
        return {"phi": math.radians(degrees)}

    return {
        "rotary-41": Scene(rotary, at(41), ("m",), "theta", 0.02, 0.05, "phi"),
        "rotary-25": Scene(rotary, at(25), ("m",), "theta", 0.02, 0.05, "phi"),
        "cart-20": Scene(cart, at(20), ("m_p",), "x", 0.5, 0.01, "phi"),
    }


Result = tuple[Outcome | None, list[float]]


@dataclass
class Timed:
    """An optimiser, and the seconds that each of its answers took."""

    optimiser: ut.Optimiser
    now: Clock
    seconds: list[float]

    def propose(self, x: FloatArray, /, **settings: Any) -> ut.Proposal:
        """Time an optimisation."""
        began = self.now()
        proposal = self.optimiser.propose(x, **settings)
        self.seconds.append(self.now() - began)
        return proposal


def cascade(
    scene: Scene,
    plant: ut.Mechanism,
    objective: ut.Objective,
    freedom: ut.DecisionVariables,
    now: Clock,
    belief: Literal["usual", "exact"] = "exact",
    rubs: bool = False,
) -> Result:
    """Run undertow's cascade; also return the seconds of each optimisation.

    Where it ``rubs``, its model has friction of at most half as much again as the scene's.
    """
    model = scene.rig.with_friction(**{scene.joint: 1.5 * scene.friction}) if rubs else scene.rig
    controller = ut.Cascade(model, objective, freedom=freedom, belief=belief)
    seconds: list[float] = []
    for incumbent in (None, ut.first_surface(model)):  # compile
        controller.optimiser.propose(scene.x0, incumbent=incumbent, budget=ut.Budget(64))
    if belief == "exact":
        controller = replace(controller, planner=Timed(controller.optimiser, now, seconds))
    truth = None if plant is scene.rig else plant
    try:
        run = controller.simulate(scene.x0, plant=truth)
    except UndertowError:
        return None, []
    motion = run.trajectory
    spent = np.sum(motion.u**2, axis=1)
    energy = float(np.sum((spent[1:] + spent[:-1]) / 2 * np.diff(motion.t)))
    if objective.name == "energy":
        energy = run.cost
    radius = float(np.linalg.norm(motion.x[-1]))
    if belief != "exact":
        seconds = [update.proposal.seconds for update in run.updates]
    return Outcome(energy, run.time, radius, run.reached), seconds


def bounds(scene: Scene, plant: ut.Mechanism) -> dict[str, float]:
    """Return the least energy and the least time of any input on this plant."""
    from undertow.bounds import bound

    box = ut.state_box(**{scene.upright: math.pi / 2})
    found = {}
    for name, objective in (
        ("energy", ut.MinimumEnergy(constraints=box)),
        ("time", ut.MinimumTime(constraints=box)),
    ):
        try:
            found[name] = bound(plant, objective, scene.x0).cost
        except UndertowError:
            found[name] = math.nan
    return found


def controllers(
    scene: Scene, plant: ut.Mechanism, chosen: list[str] | None, now: Clock
) -> dict[str, Callable[[], Result]]:
    """Return everything that can be run on a plant, by name."""
    truth = Plant(plant, RADIUS, HORIZON)
    hasty = Plant(plant, RADIUS, PATIENCE)
    free = ut.DecisionVariables(reaching=True)
    schedule = ut.DecisionVariables(reaching=True, schedule=0.05)

    def predictive(mpc: ShootingMPC | DoMPC) -> Result:
        return (truth if mpc.goal == "energy" else hasty).held(scene.x0, mpc), mpc.seconds

    def regulated(goal: str) -> Result:
        found = tuned(scene.rig, tuple(scene.x0), RADIUS, HORIZON)
        return (truth.regulated(scene.x0, found[goal].K) if found else None), []

    energy, time = ut.MinimumEnergy(horizon=HORIZON), ut.MinimumTime(horizon=PATIENCE)
    everything: dict[str, Callable[[], Result]] = {
        "cascade, energy": lambda: cascade(scene, plant, energy, ut.DecisionVariables(), now),
        "LQR clipped, energy": lambda: regulated("energy"),
        "NMPC 10 Hz, energy": lambda: predictive(ShootingMPC(scene.rig, "energy", now=now)),
        "do-mpc 10 Hz, energy": lambda: predictive(DoMPC(scene.rig, "energy", now=now)),
        "cascade, time": lambda: cascade(scene, plant, time, ut.DecisionVariables(), now),
        "cascade, time, reaching free": lambda: cascade(scene, plant, time, free, now),
        "belief, energy": lambda: cascade(
            scene, plant, energy, ut.DecisionVariables(), now, "usual"
        ),
        "belief, energy, reaching free": lambda: cascade(scene, plant, energy, free, now, "usual"),
        "belief of friction, energy": lambda: cascade(
            scene, plant, energy, ut.DecisionVariables(), now, "usual", rubs=True
        ),
        "belief, time": lambda: cascade(scene, plant, time, ut.DecisionVariables(), now, "usual"),
        "belief, time, reaching free": lambda: cascade(scene, plant, time, free, now, "usual"),
        "belief, time, schedule": lambda: cascade(scene, plant, time, schedule, now, "usual"),
        "LQR clipped, time": lambda: regulated("time"),
        "NMPC 10 Hz, time": lambda: predictive(ShootingMPC(scene.rig, "time", now=now)),
    }
    if chosen is None:
        return everything
    return {
        name: run
        for name, run in everything.items()
        if name in chosen or any(c not in everything and name.startswith(c) for c in chosen)
    }


def row(name: str, result: Result, least: dict[str, float]) -> list[str]:
    """Return one row: totals, their ratios to the bounds, and the time of planning."""
    outcome, seconds = result
    plan = ["—", "—"]
    if seconds:
        plan = [f"{1e3 * np.median(seconds):.1f}", f"{1e3 * max(seconds):.1f}"]
    if outcome is None or not outcome.reached:
        fallen = outcome is None or not outcome.radius < 10
        fate = "falls" if outcome is None or fallen else f"stays at {outcome.radius:.2g}"
        return [name, fate, "", "", "", *plan]
    ratios = [
        f"{value / floor:.2f}"
        for value, floor in ((outcome.energy, least["energy"]), (outcome.time, least["time"]))
    ]
    return [name, f"{outcome.energy:.3f}", ratios[0], f"{outcome.time:.3f}", ratios[1], *plan]


def main() -> int:
    """Run all controllers on all plants and print a table for each."""
    parser = command_line(__doc__, "--scenes rotary-41 --plants 2 --controllers cascade NMPC")
    parser.add_argument("--scenes", nargs="+", choices=list(scenes()), help="mechanism and start")
    parser.add_argument("--plants", nargs="+", type=int, choices=(0, 1, 2),
                        help="0: as modelled, 1: heavier, 2: with friction besides")  # fmt: skip
    parser.add_argument("--controllers", nargs="+", help="names, or their first words")
    options = parser.parse_args()
    need("casadi", "compare")
    need("do_mpc", "compare")
    names = options.scenes or (["rotary-25"] if options.quick else list(scenes()))
    plants = options.plants or ([2] if options.quick else [0, 1, 2])
    if options.quick and options.controllers is None:
        options.controllers = ["cascade, time", "LQR", "do-mpc"]
    for name in names:
        scene = scenes()[name]
        truths = list(scene.plants().items())
        for index in plants:
            title, plant = truths[index]
            least = bounds(scene, plant)
            rows = [
                ["bound", f"{least['energy']:.3f}", "1.00", f"{least['time']:.3f}", "1.00",
                 "—", "—"]
            ]  # fmt: skip
            chosen = controllers(scene, plant, options.controllers, clock(options.clock))
            for kind in progress(list(chosen), f"{scene.title}, {title}"):
                rows.append(row(kind, chosen[kind](), least))
            unit = scene.rig.inputs[0].unit
            table(
                f"{scene.title}, {title}",
                ["", f"∫u² dt, {unit}² s", "/ bound", "time, s", "/ bound", "plan, ms", "worst"],
                rows,
            )
    return 0


if __name__ == "__main__":
    sys.exit(main())
