"""Rollouts that go on in large steps, against integration to the end: how far off, how much less.

Random admissible surfaces and states of the rotary pendulum (d_e = 0.025): those from which
plain integration, 2 ms steps, 60 s at most, reaches ‖x‖ ≤ 0.01; surfaces whose sliding dynamics
are too fast for such steps, |eigenvalue| > 500/s, are left out.  The same are rolled out with
the tolerance that the cascade's optimiser uses.  Plain integration stops when it arrives; *60 s*
compares with one that does not.  A large step takes two evaluations of law and plant, a small
one four.  *Missed*: arrived by integration alone.  Also timed: both, in turn, as one batch.
"""

from __future__ import annotations

from harness import Clock, clock, command_line, race, table  # isort: skip

import sys
from dataclasses import replace

import numpy as np

import undertow as ut
from undertow.cascade.planners import TAIL_RTOL
from undertow.closed_loop.trajectory import Batch
from undertow.law import sliding_matrix
from undertow.models import FloatArray

RIG = ut.mechanisms.rotary_pendulum(d_e=0.025)


def admissible(exact: ut.ClosedLoop, count: int) -> tuple[FloatArray, FloatArray, Batch]:
    """Draw surfaces (N, 4) and states (N, 4) until ``count`` motions arrive."""
    rng = np.random.default_rng(0)
    states, vectors = np.empty((0, 4)), np.empty((0, 4))
    while len(states) < count:
        p = np.array([-1.5, 1.7, 12.0]) * np.exp(0.7 * rng.standard_normal((4 * count, 3)))
        drawn = np.column_stack([-np.ones(len(p)), p])
        drawn = drawn[fastest(drawn) * exact.step < 1]
        x = rng.uniform([-1, -0.7, -2, -2], [1, 0.7, 2, 2], (len(drawn), 4))
        arrived = exact.batch(x, drawn, stable_only=True).reached
        states = np.vstack([states, x[arrived]])[:count]
        vectors = np.vstack([vectors, drawn[arrived]])[:count]
    return states, vectors, exact.batch(states, vectors)


def fastest(vectors: FloatArray) -> FloatArray:
    """Return the largest |eigenvalue| of the sliding dynamics of surfaces (N, 4), 1/s."""
    return np.asarray(np.abs(np.linalg.eigvals(sliding_matrix(RIG, vectors))).max(axis=-1))


def compare(objective: ut.Objective, count: int, rounds: int, now: Clock) -> tuple[list[str], bool]:
    """Return one row of the table, and whether what is wanted was met."""
    exact = ut.ClosedLoop(RIG, objective)
    ended = replace(exact, tail_rtol=TAIL_RTOL)
    states, vectors, plain = admissible(exact, count)
    batch = ended.batch(states, vectors)
    missed = ~batch.reached
    error = np.where(missed, 0.0, np.abs(batch.cost / plain.cost - 1))
    arriving = float(plain.steps.sum() / batch.steps.sum())
    whole = float(len(states) * objective.horizon / exact.step / batch.steps.sum())
    each = float(np.median(plain.steps / batch.steps))
    seconds = race(
        {
            "plain": lambda: exact.batch(states, vectors),
            "ended": lambda: ended.batch(states, vectors),
        },
        rounds,
        now,
        objective.name,
    )
    faster = float(np.median(seconds["plain"]) / np.median(seconds["ended"]))
    worst = int(np.argmax(error))
    print(
        f"{objective.name}, worst: {ut.Surface.from_vector(vectors[worst], 2, 1)} from "
        f"x = {np.array2string(states[worst], precision=4)}: {batch.cost[worst]:.6g} at "
        f"{batch.time[worst]:.4g} s, integrated {plain.cost[worst]:.6g} at "
        f"{plain.time[worst]:.4g} s"
    )
    row = [
        objective.name, f"{error.max():.1e}", f"{np.quantile(error, 0.99):.1e}",
        f"{np.median(error):.1e}", str(int(missed.sum())), f"{arriving:.1f}", f"{each:.1f}",
        f"{whole:.0f}", f"{faster:.1f}",
    ]  # fmt: skip
    return row, bool(error.max() <= 1e-3 and not missed.any() and whole >= 5)


def main() -> int:
    """Compare and print errors and ratios."""
    parser = command_line(__doc__, "--count 5000")
    parser.add_argument("--count", type=int, help="motions (1000; --quick: 200)")
    parser.add_argument("--rounds", type=int, help="rounds of the race (10; --quick: 3)")
    options = parser.parse_args()
    count, now = options.count or (200 if options.quick else 1000), clock(options.clock)
    rounds = options.rounds or (3 if options.quick else 10)
    found = [compare(o, count, rounds, now) for o in (ut.MinimumEnergy(), ut.MinimumTime())]
    table(
        f"{count} random admissible motions: relative error of the cost; integration over tail",
        ["", "worst error", "p99", "median", "missed", "steps", "median", "60 s", "time"],
        [row for row, _ in found],
    )
    fine = all(met for _, met in found)
    met = "yes" if fine else "no"
    print(f"\nerror at most 0.1 %, five times fewer steps than 60 s of them (wanted: yes): {met}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
