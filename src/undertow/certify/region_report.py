"""Proved regions on the surface as a table: the appendix's five cases and other mechanisms.

Run ``python -m undertow.certify.region_report`` for the table of ``docs/certificates.md``;
``--only 1 4 cart_pendulum`` does some rows alone, ``--boxes`` adds the parameter boxes.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from undertow import mechanisms
from undertow.certify.appendix import CASES
from undertow.certify.lyapunov import LyapunovFunction, extent
from undertow.certify.motion import Motion, SurfaceMotion
from undertow.certify.region import verify_region
from undertow.certify.region_chart import singular_distance_on_axis
from undertow.certify.region_search import ProvedRegion, prove_region
from undertow.certify.verdict import Verdict
from undertow.mechanism import Mechanism
from undertow.stability import first_surface

__all__ = ["Row", "report", "simulated_limit"]

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
    region
        The proof.
    seconds
        Process time of the search, its proofs included.
    raised
        Verdict on the same function with the level at most 2 % up.
    box
        Verdict with the parameter uncertain, and its text.
    """

    title: str
    unit: str
    target: float
    simulated: float
    region: ProvedRegion
    seconds: float
    raised: Verdict
    box: str

    def markdown(self) -> str:
        """One line of the table."""
        degree = int(self.region.function.exponents.sum(axis=1).max())
        return (
            f"| {self.title} | {self.region.extent:.3f} {self.unit} | {self.target:.2f} "
            f"| {self.simulated:.3f} | {degree} | {self.region.verdict.details['boxes']:,} "
            f"| {self.seconds:.0f} s | {self.region.verdict.details['process_seconds']:.0f} s "
            f"| {self.raised.kind} "
            f"| {self.box} |"
        )


HEAD = (
    "| surface | proved from rest | asked | simulated | degree | boxes | search and proof "
    "| check | level +2 % | ±5 % |\n|---|---|---|---|---|---|---|---|---|---|"
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


def motions(only: Sequence[str] = ()) -> list[tuple[str, SurfaceMotion, float, str]]:
    """Title, motion, target and uncertain parameter of each row."""
    rig = mechanisms.rotary_pendulum()
    rows = [
        (str(c.number), f"case {c.number}, {c.title}", SurfaceMotion(rig, c.surface), t, "r_o")
        for c, t in zip(CASES, TARGETS, strict=True)
    ]
    for name, (target, uncertain) in OTHERS.items():
        mechanism: Mechanism = getattr(mechanisms, name)()
        motion = SurfaceMotion(mechanism, first_surface(mechanism))
        rows.append((name, name.replace("_", " "), motion, target, uncertain))
    return [row[1:] for row in rows if not only or row[0] in only]


def _box(
    motion: SurfaceMotion, V: LyapunovFunction, name: str, way: FloatArray, part: float = 0.05
) -> str:
    """Prove a smaller level for every plant with one parameter ±5 %."""
    value = next(p.value for p in motion.parameters if p.name == name)
    interval = {name: (value * (1 - part), value * (1 + part))}
    for factor in (1.05, 1.3, 2.0, 4.0, 10.0):
        smaller = V.times(factor)
        verdict = verify_region(motion, smaller, parameters=interval, max_seconds=200.0)
        if verdict:
            return f"{name}: {extent(smaller, way):.3f}"
    return f"{name}: {verdict.kind}"


def report(
    title: str,
    motion: SurfaceMotion,
    target: float,
    uncertain: str,
    *,
    programs: int = 600,
    boxes: bool = False,
) -> Row:
    """Prove one row, with its parameter box if asked."""
    way = np.eye(motion.size)[0]
    free = motion.mechanism.coordinates[motion.mechanism.m]
    started = time.process_time()
    region = prove_region(motion, way, programs=programs, goal=1.12 * target)
    found = time.process_time()
    top = singular_distance_on_axis(motion, math.pi if free.unit == "rad" else 10 * target)
    return Row(
        title,
        free.unit,
        target,
        simulated_limit(motion, 0.999 * top),
        region,
        found - started,
        region.raised,
        _box(motion, region.function, uncertain, way) if boxes else "",
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="*", default=[], help="rows: 1 … 5, or mechanisms")
    parser.add_argument("--boxes", action="store_true", help="with a parameter ±5 %% as well")
    parser.add_argument("--programs", type=int, default=600, help="linear programs of each search")
    arguments = parser.parse_args()
    print(HEAD, flush=True)
    for row in motions(arguments.only):
        line = report(*row, programs=arguments.programs, boxes=arguments.boxes)
        print(line.markdown(), flush=True)


if __name__ == "__main__":
    main()
