"""Targets that move: what jumps cost beside a fresh start, how closely references are followed.

- Set-points every 2 s on the overhead and the gantry crane.  At each jump a fresh start is made
  from the same state to the same set-point; costs are compared until the next jump, or for as
  long as the last one is held.
  Wanted: ≤ 1.1 times the fresh start's; residual swing ≤ 0.5° within 10 s of the last jump.
- A jump met by the warm search alone, which looks near the old plan, beside the cold one.
- Sines and a path from a CSV file on both cranes; ±45° of the arm at 0.5 Hz with the rotary
  pendulum upright.  Errors are those of actuated coordinates, from 5 s on and at most.
"""

from __future__ import annotations

from harness import command_line, table  # isort: skip

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

import undertow as ut

CRANES = {
    "overhead crane": (
        ut.mechanisms.overhead_crane(),
        [{"x": 1.0}, {"x": -1.0}, {"x": 0.5}, {"x": 0.0}],
    ),
    "gantry crane": (
        ut.mechanisms.gantry_crane(),
        [{"x": 1.0}, {"y": -0.8}, {"x": -0.5, "y": 0.5}, {"x": 0.0, "y": 0.0}],
    ),
}
SINES = {
    "overhead crane": ut.Reference.sine(0.2, x=0.5),
    "gantry crane": ut.Reference.sine(0.2, x=0.5, y=0.3),
}
PATH = "t (s), x (cm){y}\n0, 0{b}\n3, 80{a}\n6, -60{b}\n9, 0{b}\n"


def cascade_for(rig: ut.Mechanism, goal: str, horizon: float) -> ut.Cascade:
    """Return a cascade for one of the usual objectives."""
    return ut.Cascade(rig, ut.objective_for(rig, goal, horizon=horizon), belief="exact")


def swing(rig: ut.Mechanism, run: ut.Run, after: float) -> float:
    """Largest angle of an unactuated coordinate from a time on, degrees."""
    late = run.trajectory.t >= after - 1e-9
    return float(np.degrees(np.abs(run.trajectory.x[late, rig.m : rig.n]).max()))


def jumps(quick: bool) -> None:
    """Print what set-points every 2 s cost beside fresh starts."""
    rows = []
    for name, (rig, points) in CRANES.items():
        goals = points[: 2 if quick else None]
        cascade = cascade_for(rig, "bench-energy", 8.0)
        schedule = ut.SetPoints([(2.0 * k, goal) for k, goal in enumerate(goals)])
        last, held = schedule.times[-1], 14.0
        run = cascade.simulate(rig.state(), target=schedule, duration=last + held)
        motion = run.trajectory
        where: dict[str, float] = {}
        for begin, goal in zip(schedule.times, goals, strict=True):
            where |= goal
            x = motion.x[np.searchsorted(motion.t, begin - 1e-9)]
            fresh = cascade.simulate(x, target=where, duration=held).trajectory
            end = begin + 2.0 if begin < last else motion.time
            spent, same = (
                np.interp(b, path.t, path.accumulated_cost)
                - np.interp(a, path.t, path.accumulated_cost)
                for path, a, b in ((motion, begin, end), (fresh, 0.0, end - begin))
            )
            (jump,) = (u for u in run.updates if abs(u.t - begin) < 1e-9)
            rows.append(
                [
                    name,
                    f"{begin:g}",
                    ", ".join(f"{k} = {v:g}" for k, v in where.items()),
                    f"{jump.predicted:.4g}",
                    f"{spent:.4g}",
                    f"{spent / same:.3f}",
                    f"{swing(rig, run, last + 10.0):.2f}" if begin == last else "",
                ]
            )
    header = ["mechanism", "t (s)", "set-point (m)", "predicted", "cost", "/ fresh", "swing (°)"]
    table("Set-points every 2 s; swing from 10 s after the last on", header, rows)


def searches(quick: bool) -> None:
    """Print what the searches find for a jump while running: warm, cold, and a fresh start."""
    rows = []
    crane, pendulum = ut.mechanisms.overhead_crane(), ut.mechanisms.rotary_pendulum()
    for name, rig, objective, start, goal in (
        ("overhead crane", crane, "bench-energy", {"x": -0.5}, {"x": 1.2}),
        ("overhead crane", crane, "bench-time", {"x": -0.5}, {"x": 1.2}),
        ("rotary pendulum", pendulum, "bench-energy", {"phi": 0.5}, {"theta": 2.0}),
        ("rotary pendulum", pendulum, "bench-energy", {"phi": 0.1}, {"theta": 6.0}),
        ("rotary pendulum", pendulum, "bench-time", {"phi": 0.5}, {"theta": 6.0}),
    )[: 1 if quick else None]:
        cascade = cascade_for(rig, objective, 8.0)
        x, t = rig.state(**start), 1.0
        state, _ = cascade.start(x, dict.fromkeys(goal, 0.0))
        x = cascade.loop_at(state).batch(x, state.plan, duration=t, terminal=0.0).x[0]
        cold, _ = cascade.retarget(state, x, goal, t)
        fresh, _ = cascade.start(x, goal)
        # The same plan and the new target: what the warm search makes of it.
        moved = replace(state, target=cold.target, x=())
        warm, _ = cascade.apply_gate(moved, cascade.propose(moved, x, t), x)
        costs = [s.predicted for s in (fresh, cold, warm)]
        rows.append(
            [
                f"{name}, {objective}",
                *(f"{c:.4g}" for c in costs),
                *(f"{c / costs[0]:.2f}" for c in costs[1:]),
            ]
        )
    header = [
        "mechanism",
        "fresh start",
        "jump, cold",
        "jump, warm",
        "cold / fresh",
        "warm / fresh",
    ]
    table("Predicted cost after a jump at 1 s", header, rows)


def references(quick: bool) -> None:
    """Print how closely references are followed."""
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        tasks = []
        for name, (rig, _) in CRANES.items():
            tasks.append((name, "sine, 0.2 Hz", rig, SINES[name], 0.0))
            file = Path(folder) / f"{name}.csv"
            both = rig.m > 1
            file.write_text(
                PATH.format(y=", y (m)" * both, a=", 0.5" * both, b=", 0" * both), encoding="utf-8"
            )
            tasks.append((name, "path from CSV, 9 s", rig, ut.Reference.read(file), 9.0))
        pendulum = ut.mechanisms.rotary_pendulum()
        sine = ut.Reference.sine(0.5, theta=ut.deg(45))
        tasks.append(("rotary pendulum", "±45° at 0.5 Hz", pendulum, sine, 0.0))
        for name, what, rig, reference, end in tasks[:: 4 if quick else 1]:
            cascade = cascade_for(rig, "bench-time", 10.0)
            run = cascade.simulate(rig.state(), target=reference, duration=end + 12.0)
            motion = run.trajectory
            ((_, asked),) = reference.legs(rig, motion.time)
            wanted = asked.rows(motion.t)
            error = np.abs(motion.x[:, : rig.m] - wanted[:, : rig.m]).max(axis=1)
            radians = rig.coordinates[0].unit == "rad"
            unit, factor = ("°", 180 / np.pi) if radians else (" mm", 1e3)
            rows.append(
                [
                    name,
                    what,
                    f"{factor * error.max():.1f}{unit}",
                    f"{factor * error[motion.t >= 5.0].max():.2f}{unit}",
                    f"{np.degrees(np.abs(wanted[:, rig.m : rig.n]).max()):.1f}°",
                    f"{swing(rig, run, 0.0):.1f}°",
                    f"{swing(rig, run, end + 10.0):.2f}°" if end else "",
                    motion.event.name.lower(),
                ]
            )
    header = [
        "mechanism", "reference", "error", "from 5 s", "swing asked", "swing", "10 s after",
        "ended",
    ]  # fmt: skip
    table("References; bench-time", header, rows)


def main() -> None:
    """Print the tables."""
    quick = command_line(__doc__, clocks=False).parse_args().quick
    jumps(quick)
    searches(quick)
    references(quick)


if __name__ == "__main__":
    main()
