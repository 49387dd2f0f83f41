"""Plants that change during a run: who arrives, and what not knowing of the change costs.

The rotary pendulum and the cart pendulum, leaning at rest; at some time the plant is another one:

- *mass doubles*: of the pendulum, its inertia with it;
- *motor loses 40 %*: of its torque per volt.  The cart is driven by a force, which has no gain: a
  cart that gets 60 % of what is asked for moves as one whose masses, inertias and damping are
  1/0.6 times as large, which is what is changed here;
- *damping triples*: of the driven joint;
- *friction triples*: Coulomb's, in the driven joint, of a model that has it from the start
  (``Mechanism.with_friction``), half a percent of what the full input does;
- *nothing*: for comparison.

*belief* is the default cascade, *exact* the one that takes its model for the plant, *kept* the
optimum for the model from the start, kept to the end.  None is told.  *Knowing* is an exact cascade
of the changed plant, started from the same state at the moment of the change, with the same
deadline: 10 s for energy, 6 s for time.  Printed is the cost from the change on over what knowing
costs; 0 where the knowing one does not arrive, though the other did.  *Lost* left the travel, fell
or met the singularity, *late* was there neither by the deadline.  *Within 10 %*: how long after the
change until what is still to be paid stays within 10 % of what a knowing cascade pays from that
very state, looked at now and then (``AFTER``) for as long as a fifth of it is left: the last steps
of least time compare badly.
"""

from __future__ import annotations

from harness import command_line, progress, table  # isort: skip

import itertools
import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

import undertow as ut
from undertow.base import UndertowError
from undertow.closed_loop import Event, Trajectory
from undertow.mechanisms import LIBRARY
from undertow.models import FloatArray

MECHANISMS = ("rotary_pendulum", "cart_pendulum")
OBJECTIVES = {"energy": ut.MinimumEnergy(horizon=10.0), "time": ut.MinimumTime(horizon=6.0)}
CONTROLLERS = ("belief", "exact", "kept")
#: The largest Coulomb friction that is plausible, N m and N; the model has half of it.
FRICTION = {"rotary_pendulum": {"theta": 0.02}, "cart_pendulum": {"x": 0.2}}
#: What becomes of parameters, times their values.
WEAKER = 1.0 / 0.6
CHANGES: dict[str, dict[str, dict[str, float]]] = {
    "nothing": {"rotary_pendulum": {}, "cart_pendulum": {}},
    "mass doubles": {"rotary_pendulum": {"m": 2.0}, "cart_pendulum": {"m_p": 2.0, "J_p": 2.0}},
    "motor loses 40 %": {
        "rotary_pendulum": {"a_e": 0.6},
        "cart_pendulum": dict.fromkeys(("m_c", "m_p", "J_p", "b_c", "b_p"), WEAKER),
    },
    "damping triples": {"rotary_pendulum": {"d_e": 3.0}, "cart_pendulum": {"b_c": 3.0}},
    "friction triples": {
        "rotary_pendulum": {"friction_theta": 3.0},
        "cart_pendulum": {"friction_x": 3.0},
    },
}
#: When what is still to be paid is compared, s after the change; how much dearer it may be; and
#: the part of the cost since the change that has to be left.
AFTER = (0.0, 0.1, 0.2, 0.3, 0.4, 0.6, 0.8, 1.0, 1.5, 2.0, 3.0)
NEAR, LEFT = 1.1, 0.2


@dataclass(frozen=True)
class Case:
    """A mechanism, an objective, an angle at the start, degrees, a change, and its time, s."""

    mechanism: str
    objective: str
    angle: float
    change: str
    at: float

    @property
    def rig(self) -> ut.Mechanism:
        """The model."""
        return model(self.mechanism, self.change == "friction triples")

    @property
    def plant(self) -> ut.Mechanism:
        """The plant from the change on."""
        return changed(self.mechanism, self.change)

    @property
    def aim(self) -> ut.Objective:
        """What is best."""
        return OBJECTIVES[self.objective]

    @property
    def x0(self) -> FloatArray:
        """The start."""
        return self.rig.state(phi=ut.deg(self.angle))


@dataclass(frozen=True)
class Outcome:
    """What became of a case: how it ended, and what it cost from the change on.

    ``over`` is that over the cost of knowing, ``knowing``; ``settled`` when what was still to be
    paid came to stay near it, s after the change, infinite if never.
    """

    case: Case
    controller: str
    event: str
    knowing: float
    over: float
    settled: float

    @property
    def cells(self) -> list[str]:
        """Ratio and time, for a table."""
        if self.event != "REACHED":
            return ["late" if self.event == "HORIZON" else "lost", "—"]
        return [f"{self.over:.3f}", f"{self.settled:g}" if math.isfinite(self.settled) else "—"]


@cache
def model(name: str, friction: bool) -> ut.Mechanism:
    """Return a mechanism, with Coulomb friction or without."""
    rig = LIBRARY[name]()
    return rig.with_friction(**FRICTION[name]) if friction else rig


@cache
def changed(name: str, change: str) -> ut.Mechanism:
    """Return the plant that a mechanism becomes."""
    rig = model(name, change == "friction triples")
    value = {p.name: p.value for p in rig.parameters}
    return rig.with_parameters(**{k: by * value[k] for k, by in CHANGES[change][name].items()})


@cache
def cascade(name: str, objective: str, friction: bool, controller: str) -> ut.Cascade:
    """Return a cascade that knows the model alone."""
    rig, aim = model(name, friction), OBJECTIVES[objective]
    return ut.Cascade(rig, aim, belief="usual" if controller == "belief" else "exact")


def run_of(case: Case, controller: str) -> Trajectory:
    """Return the motion of a plant that changes while a controller runs."""
    friction = case.change == "friction triples"
    own = cascade(case.mechanism, case.objective, friction, controller)
    if controller != "kept":
        return own.simulate(case.x0, plant={0.0: case.rig, case.at: case.plant}).trajectory
    surface = own.start(case.x0)[0].surface
    before = own.loop.simulate(case.x0, surface, duration=case.at)
    after = ut.ClosedLoop(case.rig, case.aim, plant=case.plant).simulate(
        before.x[-1], surface, duration=case.aim.horizon - case.at, start=case.at
    )
    return Trajectory.join([before, after])


def knowing(case: Case, x: FloatArray, left: float) -> float:
    """Return what a cascade that knows the changed plant pays from a state, infinite if lost."""
    aim = replace(case.aim, horizon=left)
    try:
        run = ut.Cascade(case.plant, aim, belief="exact").simulate(x)
    except UndertowError:
        return math.inf
    return run.cost if run.reached else math.inf


def outcome(case: Case, controller: str) -> Outcome:
    """Run a controller and compare what it pays with what knowing costs."""
    try:
        motion = run_of(case, controller)
    except UndertowError as error:
        return Outcome(case, controller, type(error).__name__, math.nan, math.inf, math.inf)
    rows = np.searchsorted(motion.t, case.at + np.array(AFTER) - 1e-9)
    if rows[0] >= len(motion.t) - 1:  # it ended before
        return Outcome(case, controller, motion.event.name, math.nan, math.nan, math.inf)
    rest = motion.cost - motion.accumulated_cost[np.minimum(rows, len(motion.t) - 1)]
    arrived = motion.event == Event.REACHED
    looks = int((rest >= LEFT * rest[0]).sum()) if arrived else 1
    moments = zip(AFTER[:looks], motion.x[rows[:looks]], strict=True)
    costs = np.array([knowing(case, x, case.aim.horizon - case.at - t) for t, x in moments])
    over = rest[:looks] / costs
    far = np.flatnonzero(~(over <= NEAR))
    last = int(far[-1]) + 1 if len(far) else 0
    settled = AFTER[last] if arrived and last < looks else math.inf
    return Outcome(case, controller, motion.event.name, costs[0], float(over[0]), settled)


def shown(title: str, some: list[Outcome]) -> None:
    """Print the outcomes of a mechanism and an objective."""
    rows = []
    for case, group in itertools.groupby(some, key=lambda one: one.case):
        three = list(group)
        first = f"{case.change}, {case.angle:g}°, at {case.at:g} s"
        rows.append([first, f"{three[0].knowing:.4g}", *(c for one in three for c in one.cells)])
    header = ["", "knowing", *(word for name in CONTROLLERS for word in (name, "within 10 %, s"))]
    table(title, header, rows)


def summary(found: Iterable[Outcome]) -> None:
    """Print what all of the changes came to."""
    some = [one for one in found if one.case.change != "nothing"]
    rows = []
    for name in CONTROLLERS:
        mine = [one for one in some if one.controller == name]
        there = [one for one in mine if one.event == "REACHED" and math.isfinite(one.over)]
        over = np.array([one.over for one in there])
        near = np.array([one.settled for one in there])
        cells = [f"{value:.3f}" for value in (np.median(over), np.max(over))] if len(over) else []
        rows.append([
            name, f"{len(over)} of {len(mine)}", *(cells or ["—", "—"]),
            str(int((over <= NEAR).sum())), str(int(np.isfinite(near).sum())),
        ])  # fmt: skip
    header = ["", "arrived", "over knowing, median", "worst", "within 10 %", "at some time"]
    table("all changes", header, rows)


def main() -> None:
    """Run the study and print its tables."""
    parser = command_line(
        __doc__, "--mechanism rotary_pendulum --objective time --angle 30 --at 0.2", clocks=False
    )
    parser.add_argument("--mechanism", choices=MECHANISMS, action="append", help="both")
    parser.add_argument("--objective", choices=tuple(OBJECTIVES), action="append", help="both")
    parser.add_argument("--change", choices=tuple(CHANGES), action="append", help="all")
    parser.add_argument("--angle", type=float, action="append", help="degrees; 20 and 30")
    parser.add_argument("--at", type=float, action="append", help="s; 0.05 and 0.2")
    asked = parser.parse_args()
    if not all(0 < t < 6 for t in asked.at or ()):
        parser.error("--at must be after the start and before the deadline, 6 s")
    quick = asked.quick
    names = asked.mechanism or MECHANISMS[: 1 if quick else None]
    aims = asked.objective or list(OBJECTIVES)[1 if quick else 0 :]
    kinds = asked.change or list(CHANGES)[: 2 if quick else None]
    angles = asked.angle or ([30.0] if quick else [20.0, 30.0])
    moments = asked.at or ([0.2] if quick else [0.05, 0.2])
    found: list[Outcome] = []
    for name, aim in itertools.product(names, aims):
        cases = [Case(name, aim, *rest) for rest in itertools.product(angles, kinds, moments)]
        some = [
            outcome(case, controller)
            for case in progress(cases, f"{name}, {aim}: cases")
            for controller in CONTROLLERS
        ]
        unit = ut.objective_for(model(name, False), aim).unit
        shown(f"{name}, {aim}, {unit}: cost from the change on over that of knowing", some)
        found += some
    summary(found)


if __name__ == "__main__":
    main()
