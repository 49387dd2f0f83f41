"""How far the whole closed loop is proved: the appendix's five cases as a table.

Run ``python -m undertow.studies.certification.loop_report`` for the table of
``docs/certificates.md``; ``--cases 2 4`` for some of them, ``--hold 1`` for an input that is held
for a step, ``--uncertain m=5`` for a plant parameter that is off by up to 5 %, ``--out FOLDER``
for the certificates, and ``--claims FILE`` to decide kept claims instead of searching (JSON, "4"
or "4 held" to a claim). Times are process seconds: of search and proof, and of ``undertow verify``
from the file's bytes.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import sympy

from undertow.base import InfeasibleError, inward
from undertow.base.verdict import Verdict
from undertow.certify.claims.certificate import Certificate, Claim, Subject
from undertow.certify.claims.verify import verify
from undertow.certify.closed_loop.claim import LoopClaim, verify_loop
from undertow.certify.closed_loop.search import ProvedLoop, prove_loop
from undertow.certify.surface.appendix import CASES, AppendixCase
from undertow.certify.surface.sampled import sampled_extent
from undertow.closed_loop import ClosedLoop
from undertow.law import ReachingLaw
from undertow.mechanisms import rotary_pendulum
from undertow.models import Mechanism
from undertow.objective import MinimumEnergy

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
    certificate
        The file: one claim.
    verified, seconds
        What ``undertow verify`` says of it, and its process time, s.
    """

    case: AppendixCase
    sampled: Verdict
    proved: ProvedLoop
    certificate: bytes
    verified: Verdict
    seconds: float


def report(
    case: AppendixCase,
    mechanism: Mechanism,
    reach: float = math.radians(46),
    *,
    hold: int = 0,
    uncertain: Mapping[str, tuple[float, float]] | None = None,
    kept: LoopClaim | None = None,
    progress: Callable[[str], None] | None = None,
) -> LoopReport:
    """Sample and prove one case, from rest at φ up to ``reach`` rad; verify the certificate.

    ``hold`` and ``uncertain`` as for :func:`undertow.certify.closed_loop.search.prove_loop`;
    the sampled limit is that of the law at every instant on the plant that it knows.  A ``kept``
    claim is decided instead of searching for one.
    """
    law = ReachingLaw(eta=20.0, layer=0.1)
    loop = ClosedLoop(mechanism, MinimumEnergy(horizon=80.0), law, tail=1e-3)
    sampled = sampled_extent(loop, case.surface, "phi", reach)
    limit = float(sampled.details["extent"])
    if kept is not None:
        verdict = verify_loop(mechanism, case.surface, law, kept, progress=progress)
        proved = ProvedLoop(kept, verdict, math.nan)
    else:
        proved = prove_loop(
            mechanism, case.surface, law, coordinate="phi", reach=limit, hold=hold,
            uncertain=uncertain, progress=progress,
        )  # fmt: skip
    if not proved.verdict:
        raise InfeasibleError(
            f"proof of case {case.number}", value=str(proved.verdict), limit="proved"
        )
    claim = Claim("closed loop", proved.claim.to_dict(), proved.verdict)
    subject = Subject(case.surface, law, (claim,), (sampled,))
    file = Certificate.of(mechanism, [subject], {"sympy": sympy.__version__}).to_bytes()
    began = time.process_time()
    if kept is not None:  # it was decided just now
        return LoopReport(
            case, sampled, proved, file, proved.verdict, proved.verdict.details["seconds"]
        )
    (checked,) = verify(Certificate.from_bytes(file), mechanism, own_parameters=True)
    return LoopReport(case, sampled, proved, file, checked.verdict, time.process_time() - began)


def markdown(reports: Sequence[LoopReport]) -> str:
    """Return the table, angles in degrees."""
    lines = [
        "| case | sampled limit | proved | share | peak demand | boxes | proof | verify |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for r in reports:
        limit = math.degrees(r.sampled.details["extent"])
        extent = math.degrees(r.verified.margin) if r.verified else 0.0
        peak = max(r.verified.details.get("peak_demand", [math.nan]))
        search = "kept" if math.isnan(r.proved.seconds) else f"{r.proved.seconds:.0f} s"
        claim = r.proved.claim
        more = f", held {1e3 * claim.hold * claim.step:g} ms" if claim.hold else ""
        if claim.uncertain:
            more += "".join(f", {name} in a box" for name in claim.uncertain)
        lines.append(
            f"| {r.case.number}, {r.case.title}{more} | {limit:.2f}° | {inward(extent)}° "
            f"| {extent / limit:.0%} | {peak:.1f} V | {len(r.proved.claim.edges) - 1} "
            f"| {search} | {r.seconds:.0f} s |"
        )
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__,
        epilog="Example: python -m undertow.studies.certification.loop_report --cases 2",
    )
    parser.add_argument("--cases", type=int, nargs="*", default=[1, 2, 3, 4, 5])
    parser.add_argument("--damping", type=float, default=0.073, help="d_e, N m s/rad")
    parser.add_argument("--hold", type=int, default=0, help="the input is held for N steps of 1 ms")
    parser.add_argument(
        "--uncertain", nargs="*", default=[], metavar="NAME=PERCENT", help="plant parameters"
    )
    parser.add_argument("--claims", type=Path, help="kept claims to decide: no search")
    parser.add_argument("--out", type=Path, help="folder for the certificates")
    options = parser.parse_args(arguments)
    mechanism = rotary_pendulum(d_e=options.damping)
    own = {p.name: p.value for p in mechanism.parameters}
    uncertain = {}
    for text in options.uncertain:
        name, _, percent = text.partition("=")
        part = float(percent) / 100
        uncertain[name] = (own[name] * (1 - part), own[name] * (1 + part))
    reports = []
    kept: dict[str, LoopClaim | None] = {str(case.number): None for case in CASES}
    if options.claims is not None:
        document = json.loads(options.claims.read_text())
        kept = {name: LoopClaim.from_dict(data) for name, data in document.items()}
    for name, claim in kept.items():
        case = next(c for c in CASES if c.number == int(name.split()[0]))
        if case.number not in options.cases:
            continue

        def say(line: str, name: str = name) -> None:
            print(f"case {name}: {line}", file=sys.stderr)

        try:
            done = report(
                case, mechanism, hold=options.hold, uncertain=uncertain, kept=claim, progress=say
            )
        except InfeasibleError as error:
            say(f"nothing proved: {error}")
            continue
        reports.append(done)
        say(str(done.verified))
        if options.out is not None:
            options.out.mkdir(parents=True, exist_ok=True)
            file = options.out / f"case_{name.replace(' ', '_')}.json"
            file.write_bytes(done.certificate)
    print(markdown(reports))


if __name__ == "__main__":
    main()
