"""No knife's edge: what small changes do to the first plan of least time.

The rotary pendulum at rest, leaning by angles drawn evenly from 15° to 41°; the first plan of the
cascade, with its usual belief and with ``belief="exact"``, kept to the end on the very plant that
the model says.  Then the same with

- *surface*: its parameters off by 10⁻³ of themselves, α_a = −1 apart, which is a matter of scale;
- *state*: the positions at the start off by one count of the encoders, 2π/4096;
- *step*: the Runge-Kutta step of the closed loop 10 % longer or shorter;
- *all*: all of that together,

signs at random, some draws for each start.  Printed is the ratio of the cost to that of the
unchanged plan; what does not arrive any more is inadmissible, and counted apart: draws, and starts
that lose one.  *Premium*: what the plan of the belief costs over the exact one, unchanged;
*premium, run*: the same of the whole cascades, which decide until they arrive.
"""

from __future__ import annotations

from harness import command_line, progress, table  # isort: skip

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

import undertow as ut
from undertow.base import InfeasibleError
from undertow.law import LawLayout
from undertow.models import FloatArray
from undertow.plants.bench import COUNT

#: How far parameters of a surface, as a part of themselves, and steps are off.
PART, STRETCH = 1e-3, 0.1
#: Wanted of the ratios of costs: in the median, and at worst.
MEDIAN, WORST = 1.03, 1.10
BELIEFS: tuple[Literal["usual", "exact"], ...] = ("usual", "exact")
CHANGES = ("surface", "state", "step", "all")


@dataclass
class Found:
    """What the plans of one cascade came to.

    ``cost`` is that of each start's plan, unchanged, s, infinite where there is none; ``ratio``
    those of each change, (draws,) for each start, infinite where the motion does not arrive;
    ``margin`` the smallest det Γ(q)/det Γ(0) on the way, unchanged; ``run`` the time of the
    whole cascade, s, infinite where it does not arrive.
    """

    cost: list[float] = field(default_factory=list)
    run: list[float] = field(default_factory=list)
    ratio: dict[str, list[FloatArray]] = field(
        default_factory=lambda: {name: [] for name in CHANGES}
    )
    margin: list[float] = field(default_factory=list)


def costs(loop: ut.ClosedLoop, x: FloatArray, surfaces: FloatArray) -> FloatArray:
    """Return costs of states, (N, 2n), with surface vectors, (N, 2mn); infinite if lost."""
    batch = loop.batch(x, surfaces)
    return np.where(batch.reached, batch.cost, np.inf)


def changed(
    loop: ut.ClosedLoop, x: FloatArray, surface: ut.Surface, draws: int, rng: np.random.Generator
) -> dict[str, FloatArray]:
    """Return the costs of a surface from a state, (2n,), after each change, (draws,)."""
    n, m = loop.mechanism.n, loop.mechanism.m
    part = PART * rng.choice([-1.0, 1.0], (draws, 2 * m * n))
    LawLayout(n, m).blocks(part).alpha_a[:] = 0.0
    count = np.zeros((draws, 2 * n))
    count[:, :n] = COUNT * rng.choice([-1.0, 1.0], (draws, n))
    other = [loop.with_steps(factor * loop.step, 0.0) for factor in (1 - STRETCH, 1 + STRETCH)]

    def taken(loops: list[ut.ClosedLoop], parts: FloatArray, counts: FloatArray) -> FloatArray:
        states, surfaces = x + counts, surface.vector * (1.0 + parts)
        pieces = np.array_split(np.arange(draws), len(loops))
        each = zip(loops, pieces, strict=True)
        return np.concatenate([costs(one, states[k], surfaces[k]) for one, k in each if len(k)])

    return {
        "surface": taken([loop], part, 0.0 * count),
        "state": taken([loop], 0.0 * part, count),
        "step": taken(other, 0.0 * part, 0.0 * count),
        "all": taken(other, part, count),
    }


def studied(
    rig: ut.Mechanism, belief: Literal["usual", "exact"], angles: FloatArray, draws: int, seed: int
) -> Found:
    """Plan from every angle, rad, and change what was planned."""
    cascade = ut.Cascade(rig, ut.MinimumTime(), belief=belief)
    loop = ut.ClosedLoop(rig, cascade.objective, step=cascade.step)
    rng, found = np.random.default_rng([seed, 1]), Found()
    for angle in progress(list(angles), f"{belief}: starts"):
        x = rig.state(phi=angle)
        try:
            surface = cascade.start(x)[0].surface
            alone = loop.batch(x, surface)
            cost = float(alone.cost[0]) if alone.reached[0] else np.inf
        except InfeasibleError:
            cost = np.inf
        found.cost.append(cost)
        run = cascade.simulate(x) if np.isfinite(cost) else None
        found.run.append(run.time if run is not None and run.reached else np.inf)
        if np.isfinite(cost):
            found.margin.append(float(alone.singular[0]))
            for name, values in changed(loop, x, surface, draws, rng).items():
                found.ratio[name].append(values / cost)
    return found


def figures(ratios: FloatArray) -> tuple[float, float, float]:
    """Return median, 95 % and worst of the admissible ratios."""
    good = ratios[np.isfinite(ratios)]
    if not len(good):
        return np.nan, np.nan, np.nan
    median, most = np.quantile(good, [0.5, 0.95])
    return float(median), float(most), float(good.max())


def row(name: str, ratios: FloatArray) -> list[str]:
    """Return a line of the table for ratios, (starts, draws)."""
    good = np.isfinite(ratios)
    counts = [(good & (ratios > WORST)).sum(), (~good).sum(), (~good).any(axis=1).sum()]
    return [name, *(f"{value:.3f}" for value in figures(ratios)), *(str(n) for n in counts)]


def main() -> None:
    """Run the study and print its tables."""
    parser = command_line(__doc__, "--starts 50 --seed 3 --damping 0.073", clocks=False)
    parser.add_argument("--starts", type=int, default=200, help="how many are drawn")
    parser.add_argument("--draws", type=int, default=8, help="of every change, for each start")
    parser.add_argument("--seed", type=int, default=0, help="of starts and changes")
    parser.add_argument(
        "--damping", type=float, action="append", help="d_e, N m s/rad; 0.025 and 0.073"
    )
    asked = parser.parse_args()
    if asked.starts < 1 or asked.draws < 1:
        parser.error("--starts and --draws must be at least 1")
    starts = 4 if asked.quick else asked.starts
    rng = np.random.default_rng([asked.seed, 0])
    angles = np.radians(rng.uniform(15.0, 41.0, starts))
    lines = []
    for damping in asked.damping or (0.025, 0.073):
        rig = ut.mechanisms.rotary_pendulum(d_e=damping)
        found = {one: studied(rig, one, angles, asked.draws, asked.seed) for one in BELIEFS}
        rows = []
        for belief, one in found.items():
            for name, ratios in one.ratio.items():
                rows.append(row(f"{belief}, {name}", np.reshape(ratios, (-1, asked.draws))))
            least, middle = np.quantile(one.margin, [0.0, 0.5])
            lines.append(
                f"{belief}, d_e = {damping:g}: least det Γ/det Γ(0) on the way {least:.3f}, "
                f"in the median {middle:.3f}"
            )
        every = np.reshape([found["usual"].ratio[name] for name in CHANGES], -1)
        median, _, worst = figures(every)
        lost = int(np.isinf(every).sum() + np.isinf(found["usual"].cost).sum())
        met = median <= MEDIAN and worst <= WORST and lost == 0
        lines.append(
            f"usual, d_e = {damping:g}: median {median:.3f}, worst {worst:.3f}, {lost} "
            f"inadmissible (wanted: {MEDIAN:.2f}, {WORST:.2f}, 0): {'yes' if met else 'no'}"
        )
        for name in ("cost", "run"):
            usual, exact = (np.array(getattr(found[one], name)) for one in BELIEFS)
            both = np.isfinite(usual) & np.isfinite(exact)
            kind = "premium, run" if name == "run" else "premium"
            rows.append(row(kind, (usual[both] / exact[both])[:, None]))
        title = (
            f"least time, d_e = {damping:g}, {starts} starts, {asked.draws} draws: ratio of costs"
        )
        table(title, ["", "median", "95 %", "worst", "> 1.10", "inadmissible", "of starts"], rows)
    print()
    for line in lines:
        print(line)


if __name__ == "__main__":
    main()
