"""Predictive control on the realistic bench: who balances, at what cost, and with how much chatter.

The random rigs of ``undertow trials robustness``: the SRV02 with masses within ±20 %, friction
between nothing and twice as much, up to 5 ms of delay in all, a knock, encoders of 4096 counts,
1 kHz; same starts, same seeds, 10 s each.  Nobody is told of any of it.  All have the same
estimator, a Kalman filter that learns the usual parameters and predicts over the usual delay; what
it knows of a matched disturbance is taken off the output of each, at 1 kHz.

*cascade* is the library's, as in that study; *fixed surface* its first optimum, kept; *NMPC* that
study's, 10 Hz, converged by IPOPT.  *RTI* is the real-time iteration of predictive.py in CasADi
(multiple shooting, 60 intervals, the first one a sample; one Gauss-Newton programme a sample,
warm-started), *acados* the same in acados, where ``--acados`` or ``UNDERTOW_ACADOS`` names a Python
that has it.  They minimise what is counted, ∫ (u² + 0.05 xᵀx) dt, over a horizon that recedes, with
the price of its linear-quadratic regulator at the end.  *Learnt* plan with the parameters that the
filter has learnt, as the cascade does; the others with the model's.  They run at 100 Hz and as fast
as they can: a period is the 99th percentile of the processor time of their own plannings on the
first rig, in whole ms, and so is what each answer comes late; its start is predicted so far ahead.
The cascade's answers come a period late, 0.1 s; NMPC is not charged.  A pendulum that leans by a
right angle is lost, and no iteration plans for it any more.

Balanced: home, the arm within 20° and the pendulum within 2°, for the last second.  The cost
counts until ‖x‖ ≤ 0.05, along the true motion; figures are means over the rigs that all of them
balanced, and *of cascade's* is the median of the ratios to its cost on the same rig; *cheaper*
counts the rigs on which a controller pays less than the cascade.  The second table has when the
cost is paid: ∫u² dt in parts of the motion, and the share of the states.
"""

from __future__ import annotations

from harness import command_line, need, progress, table  # isort: skip  first: one thread

import csv
import math
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np

import undertow as ut
from predictive import PERIOD, Acados, RealTimeIteration
from undertow.estimators import Estimator, KalmanFilter, StateFeedback
from undertow.models import FloatArray
from undertow.objective import objective_for
from undertow.plants import srv02_rig
from undertow.runtime import estimator_for
from undertow.studies.trials.balance import controllers
from undertow.studies.trials.robustness import NAMES, random_bench
from undertow.studies.trials.steering import predictive
from undertow.studies.trials.trial import (
    MakeController,
    Outcome,
    balanced,
    introduce,
    spread,
    trial,
)

BENCH = srv02_rig()
MODEL = BENCH.mechanism
AIM = objective_for(MODEL, "bench-energy")
assert isinstance(AIM, ut.MinimumEnergy)
WEIGHT = AIM.state_weight
KNOWN = ut.Belief.usual(MODEL)
#: Length of a run, s; rollouts that a re-optimisation may spend: as in the study.
SECONDS, BUDGET = 10.0, 256
#: How far plans look ahead, s.
HORIZON = 4.0
#: Names in the tables.
CASCADE, FIXED, NMPC = NAMES[0], NAMES[1], NAMES[3]
#: With the model's parameters and with learnt ones: of which kind, and whether they learn.
KINDS = {"RTI": False, "RTI learnt": True, "acados": False, "acados learnt": True}


#: The parts of a motion, s, by when they end.
PARTS = (0.1, 0.2, 1.0, 3.0, SECONDS)


class Iterating:
    """A real-time iteration on a rig: each answer is for the state ``late`` seconds ahead.

    Parameters
    ----------
    control
        What plans.
    late
        How long a planning takes, s; at most its period.
    learns
        Whether it plans with the parameters that the estimator learns.
    """

    def __init__(self, control: RealTimeIteration, late: float, learns: bool) -> None:
        self.control, self.late, self.learns = control, late, learns
        self.learning: KalmanFilter | None = None
        self.ticks = 0
        self._u = self._next = np.zeros(MODEL.m)
        self._from = 0.0

    def listen(self, estimator: Estimator) -> None:
        """Go on with the parameters that an estimator learns, if that is wanted."""
        if self.learns and isinstance(estimator, KalmanFilter):
            self.learning = estimator

    def __call__(self, t: float, x: FloatArray) -> FloatArray:
        """Return the input at t."""
        if t >= self._from - 1e-9:
            self._u = self._next
        if not np.all(np.abs(x[MODEL.m : MODEL.n]) < math.pi / 2):  # lost, or no number
            self._u = self._next = np.zeros(MODEL.m)
        elif t >= self.ticks * self.control.period - 1e-9:
            self._plan(self.ticks * self.control.period, x)
            self.ticks += 1
        return self._u

    def _plan(self, t: float, x: FloatArray) -> None:
        """Plan for the state that the answer will find; the first one before anything moves."""
        control = self.control
        if self.learning is not None:
            control.values = self.learning.parameters[KNOWN.places].copy()
        late = self.late if self.ticks else 0.0
        self._from = t + late
        seen = control.ahead(x, self._u, late) if late else x
        self._next = np.clip(control(self._from, seen), -control.limits, control.limits)
        if not late:
            self._u = self._next


class Timed:
    """A controller, and the processor time of its plannings in ``seconds``."""

    def __init__(self, steering: Any, seconds: list[float]) -> None:
        self.steering, self.seconds = steering, seconds

    def listen(self, estimator: Estimator) -> None:
        """Hand the estimator to a controller that listens."""
        introduce(self.steering, estimator)

    def __call__(self, t: float, x: FloatArray) -> FloatArray:
        """Return the input at t."""
        before, began = self._count(), process_time()
        u = self.steering(t, x)
        if self._count() != before:
            self.seconds.append(process_time() - began)
        return np.asarray(u)

    def _count(self) -> float:
        return float(getattr(self.steering, "ticks", getattr(self.steering, "_due", 0.0)))


@dataclass(frozen=True, eq=False)
class Entrant:
    """A controller: how it is made for a run, and the seconds of its plannings so far."""

    name: str
    make: MakeController
    seconds: list[float]


def iteration(kind: str, period: float) -> RealTimeIteration:
    """Return what plans."""
    names = tuple(KNOWN.tolerances) if KINDS[kind] else ()
    if kind.startswith("acados"):
        python = os.environ["UNDERTOW_ACADOS"]
        return Acados(python, MODEL, {}, HORIZON, names=names, period=period, weight=WEIGHT)
    return RealTimeIteration(
        MODEL, {}, HORIZON, names=names, now=process_time, period=period, weight=WEIGHT
    )


def iterating(kind: str, control: RealTimeIteration, late: float) -> Entrant:
    """Return a real-time iteration as an entrant."""

    def make(_start: FloatArray) -> StateFeedback:
        control.forget()
        return Iterating(control, late, KINDS[kind])

    return Entrant(f"{kind}, {1 / control.period:.0f} Hz", make, control.seconds)


def run(entrant: Entrant, x0: FloatArray, seed: int, seconds: float = SECONDS) -> Outcome:
    """Run an entrant on a random rig."""
    told = estimator_for(MODEL, BENCH, known=KNOWN)
    truth = random_bench(BENCH, seed)
    return trial(MODEL, truth, entrant.make, x0, seconds, seed, objective=AIM, estimator=told)


def pace(kind: str, control: RealTimeIteration, x0: FloatArray, seed: int) -> float:
    """Return how long a planning takes, s: 99 of 100 on a rig, rounded up to whole ms."""
    run(iterating(kind, control, 0.0), x0, seed, seconds=3.0)
    longest = float(np.quantile(control.seconds[1:], 0.99))
    control.seconds.clear()
    return math.ceil(1e3 * longest) / 1e3


def iterations(kind: str, x0: FloatArray, seed: int, period: float | None) -> list[Entrant]:
    """Return a kind at 100 Hz, and as fast as it can run or at a period that is asked for."""
    usual = iteration(kind, PERIOD)
    late = min(PERIOD, pace(kind, usual, x0, seed) if period is None else period)
    found = [iterating(kind, usual, late)]
    if late < PERIOD:
        fast = iteration(kind, late)
        if period is None:  # short intervals may take longer
            fast.period = late = min(PERIOD, max(late, pace(kind, fast, x0, seed)))
        found.append(iterating(kind, fast, late))
    return found


def ours(x0: FloatArray, names: tuple[str, ...]) -> list[Entrant]:
    """Return the entrants of the study."""
    made = controllers(MODEL, BENCH, AIM, x0, budget=BUDGET)
    makers: dict[str, Callable[[], MakeController]] = {
        CASCADE: lambda: made["cascade"],
        FIXED: lambda: made["one-time"],
        NMPC: lambda: predictive(MODEL, AIM),
    }
    found = []
    for name in names:
        make, seconds = makers[name](), list[float]()

        def timed(
            start: FloatArray, make: MakeController = make, seconds: list[float] = seconds
        ) -> StateFeedback:
            return Timed(make(start), seconds)

        found.append(Entrant(name, timed, seconds))
    return found


def paid(outcome: Outcome) -> FloatArray:
    """Return ∫u² dt of each part of a motion, and ∫ 0.05 xᵀx dt: what adds up to its cost."""
    record = outcome.record
    inside = np.flatnonzero(np.linalg.norm(record.truth, axis=1) <= AIM.terminal_radius)
    end = int(inside[0]) if len(inside) else len(record.t)
    steps = np.diff(record.t, append=2 * record.t[-1] - record.t[-2])[:end]
    inputs = (record.u[:end] ** 2).sum(axis=1) * steps
    states = WEIGHT * (record.truth[:end] ** 2).sum(axis=1) @ steps
    place = np.searchsorted(PARTS, record.t[:end], side="right")
    parts = np.bincount(place, inputs, minlength=len(PARTS) + 1)
    return np.append(parts[: len(PARTS)], states)


def when(
    entrants: list[Entrant], found: dict[str, list[Outcome]], parts: dict[str, list[FloatArray]]
) -> None:
    """Print when the cost was paid."""
    fair = [all(one.balanced for one in group) for group in zip(*found.values(), strict=True)]
    rows = []
    for entrant in entrants:
        some = np.array(parts[entrant.name])[fair]
        if len(some):
            rows.append([entrant.name, *(f"{value:.2f}" for value in some.mean(axis=0))])
    ends = (0.0, *PARTS)
    heads = [f"{low:g} to {high:g} s" for low, high in zip(ends, PARTS, strict=False)]
    table("∫u² dt of each part, V² s; mean", ["", *heads, "∫ 0.05 xᵀx dt"], rows)


def shown(title: str, entrants: list[Entrant], found: dict[str, list[Outcome]]) -> None:
    """Print the table."""
    runs = list(zip(*found.values(), strict=True))
    fair = [all(one.balanced for one in group) for group in runs]
    header = ["", "balanced", "cost, V² s", "of cascade's", "cheaper", "∫u² dt, V² s"]
    header += ["settled, s", "chatter, V/s", "plan, ms", "99 %"]
    rows = []
    for entrant in entrants:
        mine = found[entrant.name]
        some = [one for one, keep in zip(mine, fair, strict=True) if keep]
        cells = [entrant.name, f"{balanced(mine)} of {len(mine)}", str(spread(some, "cost"))]
        rivals = [one for one, keep in zip(found.get(CASCADE, []), fair, strict=False) if keep]
        ratio = np.array([one.cost / r.cost for one, r in zip(some, rivals, strict=False)])
        known = len(ratio) > 0 and entrant.name != CASCADE
        cells.append(f"{np.median(ratio):.3f}" if known else "—")
        cells.append(f"{int((ratio < 1).sum())} of {len(ratio)}" if known else "—")
        cells += [str(spread(some, what)) for what in ("effort", "settled", "chatter")]
        ms = 1e3 * np.array(entrant.seconds[1:])
        cells += [f"{np.quantile(ms, part):.2f}" for part in (0.5, 0.99)] if len(ms) else ["—"] * 2
        rows.append(cells)
    table(f"{title}; means over the {sum(fair)} that all balanced", header, rows)


def written(found: dict[str, list[Outcome]], path: Path) -> None:
    """Write every outcome to a CSV file."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        numbers = ["seed", "balanced", "caught", "settled", "cost", "effort", "chatter"]
        writer.writerow(["controller", *numbers])
        for name, outcomes in found.items():
            writer.writerows([name, *(getattr(one, n) for n in numbers)] for one in outcomes)


def main() -> int:
    """Run the study and print its table."""
    parser = command_line(
        __doc__,
        "--rigs 40 --every 5 --acados PYTHON",
        "--rigs 1 --first 17 --controller cascade --controller 'RTI learnt'",
        clocks=False,
    )
    names = (CASCADE, FIXED, NMPC, *KINDS)
    parser.add_argument("--rigs", type=int, default=40, help="how many; 40")
    parser.add_argument("--first", type=int, default=0, help="seed of the first rig; 0")
    parser.add_argument("--every", type=int, default=5, help="from seed to seed; 5")
    parser.add_argument("--angle", type=float, default=35.0, help="φ(0), degrees; 35")
    parser.add_argument("--controller", choices=names, action="append", help="all that are there")
    parser.add_argument(
        "--period", type=float, help="of the fastest iterations and how late they are, ms; measured"
    )
    parser.add_argument("--acados", help="a Python that has acados; $UNDERTOW_ACADOS")
    parser.add_argument("--out", type=Path, help="a CSV file for every single outcome")
    asked = parser.parse_args()
    if asked.rigs < 1 or asked.first < 0 or asked.every < 1:
        parser.error("--rigs and --every must be at least 1, --first at least 0")
    if asked.period is not None and not 1 <= asked.period <= 1e3 * PERIOD:
        parser.error("--period must be from 1 to 10")
    if asked.acados:
        os.environ["UNDERTOW_ACADOS"] = asked.acados
    there = [n for n in names if "UNDERTOW_ACADOS" in os.environ or not n.startswith("acados")]
    chosen = asked.controller or (there[:4] if asked.quick else there)
    if not set(chosen) <= set(there):
        parser.error("acados needs --acados, a Python that has it")
    if set(chosen) - {CASCADE, FIXED}:
        need("casadi", "compare")
    x0 = MODEL.state(phi=ut.deg(asked.angle))
    seeds = [asked.first + asked.every * k for k in range(1 if asked.quick else asked.rigs)]
    entrants = ours(x0, tuple(n for n in (CASCADE, FIXED, NMPC) if n in chosen))
    period = None if asked.period is None else asked.period / 1e3
    for kind in (kind for kind in KINDS if kind in chosen):
        entrants += iterations(kind, x0, seeds[0], period)
    found: dict[str, list[Outcome]] = {entrant.name: [] for entrant in entrants}
    parts: dict[str, list[FloatArray]] = {entrant.name: [] for entrant in entrants}
    for seed in progress(seeds, "rigs"):
        for entrant in entrants:
            one = run(entrant, x0, seed)
            parts[entrant.name].append(paid(one))
            found[entrant.name].append(replace(one, record=one.record.last()))
        if asked.out:
            written(found, asked.out)
    last = f" to {seeds[-1]} by {asked.every}" if len(seeds) > 1 else ""
    shown(f"SRV02, φ(0) = {asked.angle:g}°, random rigs {seeds[0]}{last}", entrants, found)
    when(entrants, found, parts)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
