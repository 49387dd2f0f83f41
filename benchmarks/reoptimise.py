"""One re-optimisation: how long, how good; and the exact linear end of the horizon.

States and incumbents are those of cascade runs from several starts, rotary pendulum,
d_e = 0.025, receding horizon of 60 s.  *Converged* is the best of long searches from the
same state.  Printed side by side in one run:

* a re-optimisation with the default budget: median and 99th percentile of its time, and in
  how many states it ends within 1 % of the converged cost (or 0.1 % of the run's first
  cost, where little is left to gain);
* how far a budget of 2 ms is overrun, and whether an answer was ever worse than the
  incumbent;
* a cold, global optimisation;
* the linear end against plain integration on random admissible surfaces and states.

    python benchmarks/reoptimise.py [--quick]
"""

from __future__ import annotations

import sys
import time
from dataclasses import replace

import numpy as np

import undertow as ut
from undertow.cascade import TAIL
from undertow.mechanism import FloatArray
from undertow.rollout import Event

RIG = ut.mechanisms.rotary_pendulum(d_e=0.025)
STARTS = (20.0, 30.0, 35.0, 38.0, 40.0, 41.0, 42.0)
PERIOD = 0.1

#: A state, the incumbent, the converged cost, and what counts as no difference.
Case = tuple[FloatArray, ut.Surface, float, float]


def cases(objective: ut.Objective, starts: tuple[float, ...], steps: int) -> list[Case]:
    """Collect re-optimisation tasks along cascade runs."""
    exact = ut.ClosedLoop(RIG, objective)
    optimiser = ut.Optimiser(replace(exact, tail=TAIL))
    found = []
    for start in starts:
        x = RIG.state(phi=ut.deg(start))
        proposal = optimiser.require(x)
        surface, scale = proposal.surface, proposal.cost
        for k in range(1, steps):
            x = exact.simulate(x, surface, duration=PERIOD).x[-1]
            long = [
                optimiser.propose(
                    x, incumbent=surface, sequence=100 * k + j, budget=ut.Budget(6000)
                )
                for j in range(2)
            ]
            best = min(long, key=lambda p: p.cost)
            if best.surface is None or best.cost < 1e-3 * scale:
                break
            slack = 1e-3 * scale if objective.name == "energy" else 0.0
            found.append((x, surface, best.cost, slack))
            surface = best.surface
    return found


def row(name: str, seconds: list[float], more: str) -> None:
    """Print one line: median, 99th percentile and worst in ms."""
    ms = 1e3 * np.array(seconds)
    print(f"{name:34s} {np.median(ms):9.2f} {np.quantile(ms, 0.99):9.2f} {ms.max():9.2f}  {more}")


def warm(objective: ut.Objective, tasks: list[Case], repeats: int) -> None:
    """Time default re-optimisations and 2 ms ones."""
    optimiser = ut.Optimiser(ut.ClosedLoop(RIG, objective, tail=TAIL))
    seconds, good, over, worse = [], 0, [], 0
    for repeat in range(repeats):
        for k, (x, surface, converged, slack) in enumerate(tasks):
            number = 1000 * repeat + k + 1
            proposal = optimiser.propose(
                x, incumbent=surface, sequence=number, resolution=max(slack, 1e-4) / 10
            )
            seconds.append(proposal.seconds)
            good += proposal.cost <= 1.01 * converged + slack
            began = time.perf_counter()
            quick = optimiser.propose(
                x, incumbent=surface, sequence=number, budget=ut.Budget(100_000, 0.002)
            )
            over.append(time.perf_counter() - began - 0.002)
            worse += quick.cost > quick.incumbent_cost
    part = good / len(seconds)
    row(f"{objective.name}: default budget", seconds, f"within 1 % of converged: {part:.0%}")
    row(f"{objective.name}: over a 2 ms budget", over, f"worse than the incumbent: {worse}")


def cold(objective: ut.Objective) -> None:
    """Time global optimisations."""
    optimiser = ut.Optimiser(ut.ClosedLoop(RIG, objective, tail=TAIL))
    x = RIG.state(phi=ut.deg(41))
    answers = [optimiser.propose(x, sequence=k) for k in range(10)]
    costs = [a.cost for a in answers]
    row(
        f"{objective.name}: cold, 41°",
        [a.seconds for a in answers],
        f"cost {min(costs):.4f} to {max(costs):.4f}",
    )


def tail(objective: ut.Objective, count: int) -> None:
    """Compare the linear end with integration on random admissible surfaces and states."""
    rng = np.random.default_rng(0)
    exact = ut.ClosedLoop(RIG, objective)
    ended = replace(exact, tail=TAIL)
    p = np.array([-1.5, 1.7, 12.0]) * np.exp(0.7 * rng.standard_normal((20 * count, 3)))
    vectors = np.column_stack([-np.ones(len(p)), p])
    states = rng.uniform([-1, -0.7, -2, -2], [1, 0.7, 2, 2], (len(p), 4))
    plain = exact.batch(states[: 4 * count], vectors[: 4 * count], stable_only=True)
    chosen = np.flatnonzero(plain.event == Event.REACHED)[:count]
    states, vectors = states[chosen], vectors[chosen]
    times = []
    for loop in (exact, ended):
        loop.batch(states[:16], vectors[:16])
        began = time.perf_counter()
        result = loop.batch(states, vectors)
        times.append(time.perf_counter() - began)
    error = np.abs(result.cost - plain.cost[chosen]) / plain.cost[chosen]
    print(
        f"{objective.name}: linear end on {len(chosen)} random surfaces: largest error "
        f"{np.nanmax(error):.1e}, 99 % below {np.nanquantile(error, 0.99):.1e}, "
        f"{times[0] / times[1]:.1f} times faster"
    )


def main() -> int:
    """Run everything."""
    quick = "--quick" in sys.argv[1:]
    starts = STARTS[-2:] if quick else STARTS
    print(f"{'':34s} {'median':>9s} {'p99':>9s} {'worst':>9s}  ms, one thread")
    for objective in (ut.MinimumEnergy(), ut.MinimumTime()):
        tasks = cases(objective, starts, 4 if quick else 8)
        warm(objective, tasks, 1 if quick else 5)
        cold(objective)
    for objective in (ut.MinimumEnergy(), ut.MinimumTime()):
        tail(objective, 100 if quick else 1000)
    return 0


if __name__ == "__main__":
    sys.exit(main())
