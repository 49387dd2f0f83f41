"""Campaigns: rollouts a second, what a shard costs besides its work, and what two of anything win.

*map* computes a region map of the rotary pendulum in a process of its own, tells its peak memory
(wanted: 1 GB at most) and how long 10⁸ rollouts take at that rate.  *overhead* is the time per
shard of a campaign of very small ones, less that of the same work without a store (wanted: 20 ms
at most).  *two* compares two threads with one, and two of dask's workers with one, for the three
kinds of campaign, started before the clock is (wanted: 1.85 times as fast, on two free cores).
*check* integrates random states of the map by SciPy, from the formulas, and counts where motions
end otherwise than in the map.
"""

from __future__ import annotations

from harness import command_line, need, progress, table  # isort: skip

import math
import os
import subprocess
import sys
import tempfile
import time
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from accuracy import Case, Point, Reference, solve
from undertow.closed_loop import Event
from undertow.law import Plan
from undertow.models import FloatArray
from undertow.studies.campaign import Campaign, Definition, compute, executor_for

RIG = "rotary_pendulum"

#: Wanted: bytes, s per shard, and how much faster two are than one.
MEMORY, OVERHEAD, FASTER = 1e9, 0.020, 1.85

#: Time of arrival and cost agree where they differ by less, relative: both are single precision,
#: and the map's steps are of a search's tolerance.
AGREE = 0.02

PARTS = ("map", "overhead", "two", "check")

_number = count()


def region(side: int, shard: int) -> Definition:
    """Return the map of angle and rate of the pendulum with so many states to a side."""
    axes = {
        "phi": {"from": -1.2, "to": 1.2, "count": side},
        "phi_dot": {"from": -8.0, "to": 8.0, "count": side},
    }
    return Definition.of(RIG, kind="region", axes=axes, shard=shard, horizon=20.0)


def kinds(shards: int) -> dict[str, Definition]:
    """Return a campaign of each kind, of so many shards that take a second or more."""
    side = round(math.sqrt(shards * 150_000))
    designs = {"l": {"from": 0.15, "to": 0.19, "count": shards}}
    return {
        "region": region(side, side * -(-side // shards)),
        "plants": Definition.of(RIG, kind="plants", plants=shards, shard=1, seconds=4.0),
        "designs": Definition.of(RIG, kind="designs", axes=designs, start={"phi": 0.5}),
    }


def timed(definition: Definition, folder: Path, pool: Any, width: int) -> tuple[float, int]:
    """Return how long a campaign takes, s, and its number of shards."""
    outcome = Campaign(definition, folder / f"store-{next(_number)}").run(pool, width=width)
    if not outcome.complete:
        sys.exit(f"error: {outcome.failures}")
    return outcome.seconds, outcome.shards


def warm(definition: Definition, folder: Path, pool: Any, width: int) -> None:
    """Let every worker compile what it will need, and forget the results."""
    timed(definition, folder, pool, width)


def map_of(rollouts: int, folder: Path, threads: int) -> list[str]:
    """Compute a map in a process of its own."""
    side = math.ceil(math.sqrt(rollouts))
    definition = region(side, max(rollouts // 1000, 4096))
    code = (
        "import sys; from pathlib import Path; from undertow.studies.campaign import *\n"
        "d, path, n = Definition(*sys.argv[1:3]), Path(sys.argv[3]), int(sys.argv[4])\n"
        "with executor_for(threads=n) as (pool, width):\n"
        "    o = Campaign(d, path).run(pool, width=width)\n"
        "print(o.seconds, o.shards, o.complete)\n"
    )
    told = [definition.mechanism, definition.text, str(folder / "map"), str(threads)]
    with subprocess.Popen([sys.executable, "-c", code, *told], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        said = process.stdout.read().split()
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode or said[2] != b"True":
        sys.exit(f"error: the map failed with status {process.returncode}")
    seconds, shards = float(said[0]), int(said[1])
    peak = usage.ru_maxrss * (1024 if sys.platform != "darwin" else 1)
    size = sum(file.stat().st_size for file in (folder / "map").rglob("*") if file.is_file())
    rate = side * side / seconds
    row = [
        f"{side * side:.3g} states", f"{threads}", f"{shards}", f"{seconds:.1f}", f"{rate:,.0f}",
        f"{1e8 / rate / 60:.0f}", f"{peak / 1e6:.0f}", f"{size / 1e6:.1f}",
    ]  # fmt: skip
    heads = ["", "threads", "shards", "s", "rollouts/s", "10⁸, min", "peak, MB", "store, MB"]
    table("region map, compiled within the time", heads, [row])
    good = "yes" if peak <= MEMORY else "no"
    return [f"map: peak memory {peak / 1e6:.0f} MB (wanted: {MEMORY / 1e6:.0f}): {good}"]


def overhead(shards: int, folder: Path) -> list[str]:
    """Compare very small shards with and without a store and an executor."""
    side = round(math.sqrt(8 * shards))
    definition = region(side, 8)
    compute(definition, 0)
    clock = time.perf_counter()
    real = Campaign(definition, folder / "none").study.shards
    for shard in range(real):
        compute(definition, shard)
    bare = (time.perf_counter() - clock) / real
    rows, lines = [], []
    ways: dict[str, dict[str, Any]] = {"one thread": {"threads": 1}, "one worker": {"workers": 1}}
    for name, how in ways.items():
        with executor_for(**how) as (pool, width):
            warm(region(8, 8), folder, pool, width)
            seconds, shards = timed(definition, folder, pool, width)
        spent = seconds / shards - bare
        cells = [f"{1e3 * v:.1f}" for v in (bare, seconds / shards, spent)]
        rows.append([name, str(shards), *cells])
        good = "yes" if spent <= OVERHEAD else "no"
        lines.append(
            f"overhead, {name}: {1e3 * spent:.1f} ms a shard (wanted: {1e3 * OVERHEAD:.0f}): {good}"
        )
    table("very small shards", ["", "shards", "work, ms", "in all, ms", "overhead, ms"], rows)
    return lines


def two(shards: int, folder: Path) -> list[str]:
    """Compare two threads and two workers with one of each."""
    rows, lines = [], []
    for what, names in (("threads", ("region",)), ("workers", ("region", "plants", "designs"))):
        spent: dict[tuple[str, int], float] = {}
        for width in (1, 2):
            how: dict[str, Any] = {what: width}
            with executor_for(**how) as (pool, _):
                for name in names:
                    definition = kinds(shards)[name]
                    warm(kinds(2)[name], folder, pool, width)
                    spent[name, width], _ = timed(definition, folder, pool, width)
        for name in names:
            one, both = spent[name, 1], spent[name, 2]
            rows.append(
                [f"{name}, {what}", str(shards), f"{one:.1f}", f"{both:.1f}", f"{one / both:.2f}"]
            )
            good = "yes" if one / both >= FASTER else "no"
            lines.append(
                f"two {what}, {name}: {one / both:.2f} times as fast (wanted: {FASTER}): {good}"
            )
    table("two against one", ["", "shards", "one, s", "two, s", "ratio"], rows)
    return lines


def motion(study: Any, x0: FloatArray) -> tuple[float, float] | None:
    """Integrate a motion from the formulas; return its time, s, and cost, None where it is lost."""
    objective, surface = study.loop.objective, study.surface
    reference = Reference(Case(RIG, study.mechanism, objective, x0, Plan.of(surface)))
    law = study.loop.reaching.vector(study.mechanism.m)

    def at(x: FloatArray) -> Point:
        return reference.evaluate(x, surface, law, reference.modes(x, surface, law))

    def lost(_: float, x: FloatArray) -> float:
        try:
            return float(np.min(at(x).margins))
        except np.linalg.LinAlgError:  # at the singularity itself
            return 0.0

    def arrives(_: float, x: FloatArray) -> float:
        return float(np.linalg.norm(x[:-1])) - float(objective.terminal_radius)

    lost.terminal = arrives.terminal = True  # type: ignore[attr-defined]  # as SciPy wants it
    start = np.append(x0, 0.0)
    if lost(0.0, start) <= 0:
        return None
    found = solve(
        lambda _, x: at(x).rates, (0.0, objective.horizon), start, method="DOP853", rtol=1e-7,
        atol=1e-9, events=[lost, arrives], first_step=1e-4, max_step=0.05,
    )  # fmt: skip
    if not found.success:
        sys.exit(f"error: SciPy, from {x0}: {found.message}")
    return (float(found.t[-1]), float(found.y[-1, -1])) if len(found.t_events[1]) else None


def check(states: int, folder: Path) -> list[str]:
    """Integrate random states of a map by another integrator."""
    definition = region(200, 40_000)
    study: Any = Campaign(definition, folder / "none").study
    arrays = compute(definition, 0)
    _, x0 = study.states(0)
    rng = np.random.default_rng(0)
    chosen = rng.choice(len(x0), states, replace=False)
    ends, off = 0, [0.0, 0.0]
    for k in progress(chosen.tolist(), "check"):
        exact = motion(study, x0[k])
        home = exact is not None
        if home != (arrays["event"].flat[k] == Event.REACHED):
            ends += 1
        elif exact is not None:
            time_off = abs(float(arrays["time"].flat[k]) / exact[0] - 1)
            cost_off = abs(float(arrays["cost"].flat[k]) / exact[1] - 1)
            off = [max(off[0], time_off), max(off[1], cost_off)]
    row = [str(states), str(ends), f"{100 * off[0]:.2f}", f"{100 * off[1]:.2f}"]
    table(
        "random states, integrated by SciPy", ["states", "other ends", "time, %", "cost, %"], [row]
    )
    good = "yes" if ends == 0 and max(off) <= AGREE else "no"
    return [
        f"check: {ends} of {states} end otherwise, at most {100 * max(off):.2f} % off in time and "
        f"cost (wanted: none, {100 * AGREE:g}): {good}"
    ]


def main() -> int:
    """Run the parts that are asked for."""
    examples = "map --rollouts 10000000 --threads 2", "two --shards 16"
    parser = command_line(__doc__, *examples, clocks=False)
    parser.add_argument("parts", nargs="*", metavar="PART", help=", ".join(PARTS))
    parser.add_argument("--rollouts", type=float, default=1e6, help="of the map (10⁶)")
    parser.add_argument("--threads", type=int, default=2, help="of the map (2)")
    parser.add_argument("--shards", type=int, default=8, help="of each kind in two (8)")
    parser.add_argument("--states", type=int, default=1000, help="that are checked (1000)")
    options = parser.parse_args()
    for part in options.parts:
        if part not in PARTS:
            parser.error(f"no part named {part}; there are {', '.join(PARTS)}")
    need("zarr", "campaign")
    need("distributed", "campaign")
    parts, quick, lines = options.parts or PARTS, options.quick, list[str]()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if "map" in parts:
            lines += map_of(10_000 if quick else int(options.rollouts), folder, options.threads)
        if "overhead" in parts:
            lines += overhead(20 if quick else 200, folder)
        if "two" in parts:
            lines += two(2 if quick else options.shards, folder)
        if "check" in parts:
            lines += check(5 if quick else options.states, folder)
    print("", *lines, sep="\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
