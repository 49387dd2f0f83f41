"""Campaigns: rollouts a second, what a shard costs besides its work, and what two of anything win.

*map* computes a region map of the rotary pendulum in a process of its own, tells its peak memory
(wanted: 1 GB at most) and how long 10⁸ rollouts take at that rate.  *overhead* is the time per
shard of a campaign of very small ones, less that of the same work without a store (wanted: 20 ms
at most).  *two* compares two threads with one, and two of dask's workers with one, for the three
kinds of campaign, started before the clock is (wanted: 1.85 times as fast, on two free cores).
*check* integrates random states of maps by NumPy, from the formulas, and counts where motions
end otherwise than in the map: of the maps in ``examples/campaigns``, or those of ``--maps``.
"""

from __future__ import annotations

from harness import command_line, need, progress, table  # isort: skip

import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import sympy as sp

from undertow.closed_loop import Event
from undertow.models import FloatArray
from undertow.studies.campaign import Campaign, Definition, compute, executor_for

RIG = "rotary_pendulum"

#: Wanted: bytes, s per shard, and how much faster two are than one.
MEMORY, OVERHEAD, FASTER = 1e9, 0.020, 1.85

#: Time of arrival and cost agree where they differ by less, relative: both are single precision,
#: and the map's steps are of a search's tolerance.
AGREE = 0.02

#: Step of the motions that maps are checked by, s.
STEP = 5e-4

#: Shards of a map from which states are drawn, at most.
SHARDS = 10

#: The maps of the documentation.
MAPS = sorted(
    path
    for path in (Path(__file__).parents[1] / "examples" / "campaigns").glob("*.toml")
    if path.stem != "league"
)

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


class Formulas:
    """A map's mechanism under its law, by NumPy from the formulas, for N states at once."""

    def __init__(self, study: Any) -> None:
        rig, loop = study.mechanism, study.loop
        assert not any(rig.disturbance_bounds)  # the gains (13) are η
        self.n, self.m, self.surface, self.problem = rig.n, rig.m, study.surface, loop.objective
        self.limits, self.law = rig.input_limits, np.split(loop.reaching.vector(rig.m), 2)
        values, both = rig.substitution, [*rig.x, *rig.u]
        margins = sp.Matrix([self.problem.path_margins(rig)])
        self.M, self.f, self.B, self.stage, self.path = (
            _numpy(symbols, sp.Matrix(formula).subs(values))
            for symbols, formula in (
                (rig.x, rig.mass_matrix), (rig.x, rig.force), (rig.x, rig.input_matrix),
                (both, [self.problem.stage_cost(rig)]), (both, margins),
            )
        )  # fmt: skip
        self.at_target = np.linalg.det(self._partial(np.zeros((1, 2 * rig.n)))[0])

    def _partial(self, x: FloatArray) -> tuple[FloatArray, ...]:
        """Return Γ, M, f, B, and the drift of the free joints, of states (N, 2n)."""
        m, surface = self.m, self.surface
        M, f, B = self.M(x), self.f(x), self.B(x)
        solved = np.linalg.solve(M[:, m:, m:], np.concatenate([M[:, m:, :m], f[:, m:]], axis=2))
        X, drift = solved[:, :, :m], solved[:, :, m]
        return surface.alpha_a - surface.alpha_u @ X, M, f[:, :, 0], B, X, drift

    def __call__(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the rates of x = (state, cost), (N, 2n + 1), and the least margins, (N,)."""
        n, m, surface, (eta, layer), state = self.n, self.m, self.surface, self.law, x[:, :-1]
        gamma, M, f, B, X, drift = self._partial(state)
        q_a, q_u, v_a, v_u = np.split(state, [m, n, n + m], axis=1)
        s = v_a @ surface.alpha_a.T + q_a @ surface.lambda_a.T
        s = s + v_u @ surface.alpha_u.T + q_u @ surface.lambda_u.T
        drive = drift @ surface.alpha_u.T + v_a @ surface.lambda_a.T + v_u @ surface.lambda_u.T
        drive = drive + eta * np.clip(s / layer, -1, 1)
        wanted = -np.linalg.solve(gamma, drive[:, :, None])[:, :, 0]
        force = np.einsum("kij,kj->ki", M[:, :m, :m] - M[:, :m, m:] @ X, wanted) - f[:, :m]
        force += np.einsum("kij,kj->ki", M[:, :m, m:], drift)
        u = np.clip(np.linalg.solve(B, force[:, :, None])[:, :, 0], -self.limits, self.limits)
        pushed = f.copy()
        pushed[:, :m] += np.einsum("kij,kj->ki", B, u)
        accelerations = np.linalg.solve(M, pushed[:, :, None])[:, :, 0]
        both = np.concatenate([state, u], axis=1)
        stage, path = self.stage(both)[:, :, 0], self.path(both)[:, 0]
        singular = np.linalg.det(gamma)[:, None] / self.at_target
        margins = np.concatenate([singular, path], axis=1)
        return np.concatenate([state[:, n:], accelerations, stage], axis=1), margins.min(axis=1)


def _numpy(symbols: Sequence[sp.Symbol], matrix: sp.Matrix) -> Any:
    """Return a function from numbers (N, symbols) to matrices (N, rows, columns)."""
    entries = sp.lambdify(symbols, [*matrix], "numpy", cse=True)

    def at(x: FloatArray) -> FloatArray:
        columns = [np.broadcast_to(v, len(x)) for v in entries(*x.T)]
        return np.reshape(np.array(columns, dtype=float).T, (len(x), *matrix.shape))

    return at


def motions(study: Any, x0: FloatArray) -> FloatArray:
    """Return times of arrival, s, and costs, (N, 2), or NaN, by Runge and Kutta's method."""
    rates, radius = Formulas(study), float(study.loop.objective.terminal_radius)
    found, alive = np.full((len(x0), 2), np.nan), np.arange(len(x0))
    x = np.pad(x0, [(0, 0), (0, 1)])
    k, margin = rates(x)
    for step in progress(range(round(study.loop.objective.horizon / STEP)), study.mechanism.name):
        go_on = margin > 0
        alive, x, k = alive[go_on], x[go_on], k[go_on]
        if not len(alive):
            break
        total, slope = k / 6, k
        for part, weight in ((0.5, 3), (0.5, 3), (1.0, 6)):
            slope, _ = rates(x + part * STEP * slope)
            total = total + slope / weight
        before, x = np.linalg.norm(x[:, :-1], axis=1), x + STEP * total
        after = np.linalg.norm(x[:, :-1], axis=1)
        k, margin = rates(x)
        home = (after <= radius) & (margin > 0)
        part = np.clip((before - radius) / np.maximum(before - after, 1e-300), 0, 1)
        cost = x[:, -1] - (1 - part) * STEP * k[:, -1]
        found[alive[home]] = np.stack([(step + part) * STEP, cost], axis=1)[home]
        margin[home] = -1.0
    return found


def check(maps: Sequence[Path], states: int, folder: Path) -> list[str]:
    """Integrate random states of maps from the formulas."""
    rows, lines = [], []
    for path in maps:
        definition, rng = Definition.read(path), np.random.default_rng(0)
        study: Any = Campaign(definition, folder / "none").study
        shards = rng.choice(study.shards, min(SHARDS, study.shards), replace=False)
        drawn, mapped = [], []
        for shard in shards.tolist():
            arrays, (_, x0) = compute(definition, shard), study.states(shard)
            k = rng.choice(len(x0), min(math.ceil(states / len(shards)), len(x0)), replace=False)
            drawn.append(x0[k])
            mapped.append(np.array([arrays[what].flat[k] for what in ("event", "time", "cost")]).T)
        x0, (event, *came) = np.concatenate(drawn)[:states], np.concatenate(mapped)[:states].T
        exact = motions(study, x0)
        reached, home = event == Event.REACHED, np.isfinite(exact[:, 0])
        other = int((reached != home).sum())
        both = reached & home
        off = np.abs(np.stack(came, axis=1)[both] / exact[both] - 1).max(axis=0, initial=0.0)
        cells = [len(x0), int(home.sum()), other, *(f"{100 * v:.2f}" for v in off)]
        rows.append([path.stem, *map(str, cells)])
        good = "yes" if other == 0 and off.max() <= AGREE else "no"
        lines.append(
            f"check, {path.stem}: {other} of {len(x0)} end otherwise, at most "
            f"{100 * off.max():.2f} % off in time and cost (wanted: none, {100 * AGREE:g}): {good}"
        )
    heads = ["", "states", "come home", "other ends", "time, %", "cost, %"]
    table("random states, integrated from the formulas", heads, rows)
    return lines


def main() -> int:
    """Run the parts that are asked for."""
    examples = "map --rollouts 10000000 --threads 2", "two --shards 16"
    parser = command_line(__doc__, *examples, clocks=False)
    parser.add_argument("parts", nargs="*", metavar="PART", help=", ".join(PARTS))
    parser.add_argument("--rollouts", type=float, default=1e6, help="of the map (10⁶)")
    parser.add_argument("--threads", type=int, default=2, help="of the map (2)")
    parser.add_argument("--shards", type=int, default=8, help="of each kind in two (8)")
    parser.add_argument("--states", type=int, default=1000, help="of each map (1000)")
    told = "definitions of the maps that are checked (those of examples/campaigns)"
    parser.add_argument("--maps", nargs="+", type=Path, default=MAPS, metavar="FILE", help=told)
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
            lines += check(options.maps, 5 if quick else options.states, folder)
    print("", *lines, sep="\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
