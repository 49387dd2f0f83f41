"""Proved regions on the surface as a table: the appendix's five cases and other mechanisms.

Run ``python -m undertow.studies.certification.region_report`` for the table of
``docs/certificates.md``; ``--only 1 4 cart_pendulum`` does some rows alone, ``--boxes`` adds the
parameter boxes, ``--out regions.json`` keeps the functions, ``--claims regions.json`` proves kept
ones without a search.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from undertow import mechanisms
from undertow.base import InfeasibleError, inward
from undertow.base.verdict import Verdict
from undertow.certify.claims.certificate import function_data, function_of
from undertow.certify.region.chain import Progress
from undertow.certify.region.chart import singular_distance_on_axis
from undertow.certify.region.lyapunov import LyapunovFunction, extent
from undertow.certify.region.motion import Motion, SurfaceMotion
from undertow.certify.region.region import verify_region
from undertow.certify.region.search import prove_region
from undertow.certify.surface.appendix import CASES
from undertow.law import first_surface
from undertow.models import Mechanism

__all__ = ["Row", "motions", "read_chains", "report", "simulated_limit"]

FloatArray = NDArray[np.float64]

#: rad: what issue 5's five cases are to reach, in order.
TARGETS = (0.75, 0.88, 0.95, 0.75, 0.65)

#: Mechanisms with their first surface, how far a useful region reaches in the unactuated
#: coordinate (rad or m), and a plant parameter that is uncertain by ±5 %.
OTHERS: dict[str, tuple[float, str]] = {
    "cart_pendulum": (0.6, "m_p"),
    "overhead_crane": (1.0, "m_p"),
    "pendubot": (0.3, "b_2"),
    "ball_and_beam": (0.2, "m_b"),
    "reaction_wheel_pendulum": (0.5, "b_p"),
}


@dataclass(frozen=True)
class Row:
    """One proved region.

    Parameters
    ----------
    title, unit
        Which surface; unit of the unactuated coordinate.
    target, simulated
        What is asked for, and how far simulated motions from rest converge.
    chain, extent
        The functions, and how far along y_0 their set is proved to reach.
    verdict, raised
        The proof; the verdict with the last level raised.
    seconds
        Process time of the search, its proofs included; NaN where it was not searched for.
    box
        Verdict with the parameter uncertain, and its text.
    """

    title: str
    unit: str
    target: float
    simulated: float
    chain: tuple[LyapunovFunction, ...]
    extent: float
    verdict: Verdict
    raised: Verdict
    seconds: float
    box: str

    def markdown(self) -> str:
        """One line of the table."""
        degree = max(int(V.exponents.sum(axis=1).max()) for V in self.chain)
        searched = "" if math.isnan(self.seconds) else f"{self.seconds:.0f} s"
        return (
            f"| {self.title} | {inward(self.extent, 4)} {self.unit} | {self.target:.2f} "
            f"| {self.simulated:.3f} | {len(self.chain)}, {degree} "
            f"| {self.verdict.details['boxes']:,} | {searched} "
            f"| {self.verdict.kind}, {self.verdict.details['process_seconds']:.0f} s "
            f"| {self.raised.kind} | {self.box} |"
        )


HEAD = (
    "| surface | proved from rest | asked | simulated | functions, degree | boxes "
    "| search and proof | check | level raised | ±5 % |\n|---|---|---|---|---|---|---|---|---|---|"
)


def simulated_limit(motion: Motion, top: float, points: int = 100) -> float:
    """Return how far along y_0, at rest, simulated motions converge (a grid up to ``top``).

    Runge-Kutta 4 with steps of 1/20 of the fastest linear time constant, 0.5 ms at most, for five
    slowest time constants; a motion that passes a singularity does not count.
    """
    eigenvalues = np.linalg.eigvals(motion.jacobian)
    fast, slow = np.abs(eigenvalues).max(), -eigenvalues.real.max()
    h = min(0.05 / fast, 5e-4)
    start = np.zeros((points, motion.size))
    start[:, 0] = top * np.arange(1, points + 1) / points
    y, good = start.copy(), np.ones(points, dtype=bool)
    reference = motion.determinant(np.zeros(motion.size))
    with np.errstate(all="ignore"):
        for _ in range(math.ceil(5.0 / slow / h)):
            a = motion(y)
            b = motion(y + 0.5 * h * a)
            c = motion(y + 0.5 * h * b)
            d = motion(y + h * c)
            y = y + h / 6 * (a + 2 * b + 2 * c + d)
            good &= motion.determinant(y) / reference > 0
            y[~good] = 0.0
    good &= np.isfinite(y).all(axis=1) & (np.abs(y[:, 0]) < 0.2 * start[:, 0])
    return float(start[good.argmin() - 1, 0]) if not good.all() else top


def motions(only: Sequence[str] = ()) -> list[tuple[str, str, SurfaceMotion, float, str]]:
    """Name, title, motion, target and uncertain parameter of each row."""
    rig = mechanisms.rotary_pendulum()
    rows = [
        (str(c.number), f"case {c.number}, {c.title}", SurfaceMotion(rig, c.surface), t, "r_o")
        for c, t in zip(CASES, TARGETS, strict=True)
    ]
    for name, (target, uncertain) in OTHERS.items():
        mechanism: Mechanism = getattr(mechanisms, name)()
        motion = SurfaceMotion(mechanism, first_surface(mechanism))
        rows.append((name, name.replace("_", " "), motion, target, uncertain))
    return [row for row in rows if not only or row[0] in only]


def _box(
    motion: SurfaceMotion,
    chain: tuple[LyapunovFunction, ...],
    name: str,
    way: FloatArray,
    part: float = 0.05,
) -> str:
    """Prove as many functions as go for every plant with one parameter ±5 %."""
    value = next(p.value for p in motion.parameters if p.name == name)
    interval = {name: (value * (1 - part), value * (1 + part))}
    for k in range(len(chain)):
        verdict = verify_region(
            motion, chain[: k + 1], parameters=interval, max_boxes=3_000_000, proved=k
        )
        if not verdict:
            break
        reach = extent(chain[k], way)
    else:
        k += 1
    return f"{name}: {inward(reach, 4)}" if k else f"{name}: {verdict.kind}"


def report(
    title: str,
    motion: SurfaceMotion,
    target: float,
    uncertain: str,
    *,
    programs: int = 300,
    boxes: bool = False,
    chain: tuple[LyapunovFunction, ...] = (),
    progress: Progress | None = None,
    keep: Callable[[tuple[LyapunovFunction, ...]], None] | None = None,
) -> Row:
    """Search for one row and prove it, or prove the chain that is given.

    ``keep`` is as for :func:`undertow.certify.prove_region`.
    """
    way = np.eye(motion.size)[0]
    free = motion.mechanism.coordinates[motion.mechanism.m]
    top = singular_distance_on_axis(motion, math.pi if free.unit == "rad" else 10 * target)
    started = time.process_time()
    if chain:
        verdict = verify_region(motion, chain)
        raised = verify_region(
            motion, [*chain[:-1], chain[-1].times(1 / 1.05)], proved=len(chain) - 1
        )
        seconds = math.nan
    else:
        region = prove_region(
            motion, way, programs=programs, goal=1.15 * target, progress=progress, keep=keep
        )
        chain, verdict, raised = region.chain, region.verdict, region.raised
        seconds = time.process_time() - started
    reach = extent(chain[-1], way) * (1 - 1e-9) if verdict else 0.0
    return Row(
        title,
        free.unit,
        target,
        simulated_limit(motion, 0.999 * top),
        chain,
        reach,
        verdict,
        raised,
        seconds,
        _box(motion, chain, uncertain, way) if boxes else "",
    )


def read_chains(file: Path) -> dict[str, tuple[LyapunovFunction, ...]]:
    """Return the chains of a file that ``--out`` wrote, by the names of their rows."""
    claims = json.loads(file.read_text(encoding="utf-8"))
    return {k: tuple(function_of(f) for f in v["functions"]) for k, v in claims.items()}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", nargs="*", default=[], help="rows: 1 … 5, or mechanisms")
    parser.add_argument("--boxes", action="store_true", help="with a parameter ±5 %% as well")
    parser.add_argument("--programs", type=int, default=300, help="linear programs of each search")
    parser.add_argument("--claims", type=Path, help="prove the functions of this file, no search")
    parser.add_argument("--out", type=Path, help="write the functions to this JSON file")
    arguments = parser.parse_args()
    known = read_chains(arguments.claims) if arguments.claims else {}
    claims: dict[str, object] = {}

    def keep(name: str, chain: tuple[LyapunovFunction, ...]) -> None:
        """Write what is proved as soon as it is: a run that is stopped loses nothing."""
        if arguments.out:
            claims[name] = {"functions": [function_data(V) for V in chain]}
            arguments.out.write_text(json.dumps(claims) + "\n", encoding="utf-8")

    print(HEAD, flush=True)
    for name, title, motion, target, uncertain in motions(arguments.only):
        if known and name not in known:
            continue
        try:
            row = report(
                title,
                motion,
                target,
                uncertain,
                programs=arguments.programs,
                boxes=arguments.boxes,
                chain=known.get(name, ()),
                progress=lambda line: print(line, file=sys.stderr, flush=True),
                keep=partial(keep, name),
            )
        except InfeasibleError as error:
            print(f"| {title} | not proved | {target:.2f} | {error} |", flush=True)
            continue
        print(row.markdown(), flush=True)
        keep(name, row.chain)


if __name__ == "__main__":
    main()
