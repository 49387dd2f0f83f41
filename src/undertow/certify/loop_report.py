"""How far the whole closed loop is proved: the appendix's five cases as a table.

Run ``python -m undertow.certify.loop_report`` for the table of ``docs/certificates.md``;
``--cases 2 4`` for some of them, ``--out FOLDER`` to write the claims as JSON.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from undertow.certify.appendix import CASES, AppendixCase
from undertow.certify.loop_search import ProvedLoop, prove_loop
from undertow.certify.sampled import sampled_extent
from undertow.certify.verdict import Verdict
from undertow.mechanism import Mechanism
from undertow.mechanisms import rotary_pendulum
from undertow.objective import MinimumEnergy
from undertow.rollout import ClosedLoop
from undertow.sliding import ReachingLaw

__all__ = ["LoopReport", "markdown", "report"]


@dataclass(frozen=True)
class LoopReport:
    """One case: sampled and proved starts at rest.

    Parameters
    ----------
    case
        Which.
    sampled
        Verdict of the random trials; ``details["extent"]`` is the simulated limit, rad.
    proved
        The search's claim with the checker's verdict, decided from the claim's numbers alone.
    """

    case: AppendixCase
    sampled: Verdict
    proved: ProvedLoop


def report(
    case: AppendixCase,
    mechanism: Mechanism,
    reach: float = math.radians(46),
    progress: Callable[[str], None] | None = None,
) -> LoopReport:
    """Sample and prove one case, from rest at φ up to ``reach`` rad."""
    law = ReachingLaw(eta=20.0, layer=0.1)
    loop = ClosedLoop(mechanism, MinimumEnergy(horizon=80.0), law, tail=1e-3)
    sampled = sampled_extent(loop, case.surface, "phi", reach)
    limit = float(sampled.details["extent"])
    proved = prove_loop(
        mechanism, case.surface, law, coordinate="phi", reach=limit, progress=progress
    )
    return LoopReport(case, sampled, proved)


def markdown(reports: Sequence[LoopReport]) -> str:
    """Return the table, angles in degrees."""
    lines = [
        "| case | sampled limit | proved | share | peak demand | boxes | with search | check |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for r in reports:
        limit = math.degrees(r.sampled.details["extent"])
        extent = math.degrees(r.proved.verdict.margin) if r.proved.verdict else 0.0
        details = r.proved.verdict.details
        peak = max(details.get("peak_demand", [math.nan]))
        lines.append(
            f"| {r.case.number}, {r.case.title} | {limit:.2f}° | {extent:.2f}° "
            f"| {extent / limit:.0%} | {peak:.1f} V | {len(r.proved.claim.edges) - 1} "
            f"| {r.proved.seconds:.0f} s | {details['seconds']:.0f} s |"
        )
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, epilog="Example: python -m undertow.certify.loop_report --cases 2"
    )
    parser.add_argument("--cases", type=int, nargs="*", default=[1, 2, 3, 4, 5])
    parser.add_argument("--damping", type=float, default=0.073, help="d_e, N m s/rad")
    parser.add_argument("--out", type=Path, help="folder for the claims as JSON")
    options = parser.parse_args(arguments)
    mechanism = rotary_pendulum(d_e=options.damping)
    reports = []
    for case in CASES:
        if case.number not in options.cases:
            continue

        def say(line: str, number: int = case.number) -> None:
            print(f"case {number}: {line}", file=sys.stderr)

        reports.append(report(case, mechanism, progress=say))
        print(reports[-1].proved.verdict, file=sys.stderr)
        if options.out is not None:
            options.out.mkdir(parents=True, exist_ok=True)
            text = json.dumps(reports[-1].proved.claim.to_dict(), indent=1)
            (options.out / f"case_{case.number}.json").write_text(text + "\n")
    print(markdown(reports))


if __name__ == "__main__":
    main()
