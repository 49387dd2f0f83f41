"""Proofs: certify a surface, a run or the paper's cases; verify a certificate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from rich.console import RenderableType

from undertow.base import Progress, one_of, require
from undertow.cascade import Cascade
from undertow.cli import options
from undertow.cli.control import FIRST_PLAN
from undertow.cli.parsing import (
    mechanism_named,
    parse_start,
    parse_surface,
    parse_task,
    parse_values,
)
from undertow.cli.terminal import (
    check_out,
    command,
    completed,
    end_interrupted,
    exit_unless,
    needs,
    progress_bar,
    show,
    write,
)
from undertow.law import first_surface, usual_reaching
from undertow.mechanisms import LIBRARY
from undertow.models import Mechanism
from undertow.models.importers.python_file import in_a_file
from undertow.objective import USUAL

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from undertow.plants import Bench
    from undertow.studies.certification import Certified


def _box(mechanism: Mechanism, within: list[str] | None) -> dict[str, tuple[float, float]]:
    """Return [low, high] of plant parameters from per cents."""
    own = {p.name: p.value for p in mechanism.parameters}
    box = {}
    for name, percent in parse_values(within).items():
        one_of(f"--within {name}={percent:g}", name, own)
        what, limit = f"--within {name}={percent:g}", "between 0 and 100 per cent"
        require(0 < percent < 100, what, f"{percent:g}", limit)
        ends = own[name] * (1 - percent / 100), own[name] * (1 + percent / 100)
        box[name] = (min(ends), max(ends))
    return box


def _bench(mechanism: Mechanism, word: str | None) -> Bench | None:
    """Return the bench of a word, its mechanism's parameters as they are here."""
    if word is None:
        return None
    from undertow.plants.bench import plausible_rig, srv02_rig

    if word == "usual":
        return plausible_rig(mechanism)
    published = srv02_rig()
    name, remedy = published.mechanism.name, "Take --bench usual, of any mechanism"
    require(mechanism.name == name, "--bench srv02", f"of '{mechanism.name}'", name, remedy)
    return replace(published, mechanism=mechanism)


@command(
    "undertow certify rotary_pendulum --surface 'lambda_a=-1.59 alpha_u=1.96 lambda_u=12.1'",
    "undertow certify cart_pendulum --seconds 30 --out proof",
    "undertow certify rotary_pendulum --run --start phi=40deg --set d_e=0.025 --out proof",
    "undertow certify rotary_pendulum --loop --seconds 0 --start phi=20deg --out proof",
    "undertow certify tora --loop --seconds 0 --start theta=0.3rad --start x=0.02m --out proof",
    "undertow certify rotary_pendulum --loop --seconds 0 --start phi=10deg --hold 1",
    "undertow certify rotary_pendulum --loop --seconds 0 --start phi=5deg --hold 1 --within m=2",
    "undertow certify rotary_pendulum --bench srv02 --out proof",
    "undertow certify --appendix",
    "undertow certify --appendix --loop --set d_e=0.073 --out proof",
    "undertow certify model.py:make",
)
def certify(
    name: options.OneName = None,
    surface: str | None = None,
    start: options.Start = None,
    setting: options.Settings = None,
    run: bool = False,
    appendix: bool = False,
    objective: options.Goal = USUAL,
    horizon: options.Horizon = 60.0,
    seconds: float | None = None,
    loop: bool = False,
    loop_seconds: float | None = None,
    hold: int = 0,
    within: list[str] | None = None,
    bench: Literal["srv02", "usual"] | None = None,
    seed: options.Seed = 0,
    out: Path | None = None,
) -> None:
    """Prove what can be proved: stability, domain, disturbances, terminal sets, regions.

    Exit status 0 when local stability at least is proved for every surface, else 1.

    Parameters
    ----------
    surface : BLOCKS
        The surface: 'lambda_a=-0.5 alpha_u=5 lambda_u=10'. Default: the designed one.
    run
        Simulate a cascade and certify what it applied.
    appendix
        The paper's five cases instead.
    seconds
        Time to search for each region on the surface, s, by default 60, or 0 with --appendix; 0
        leaves regions out. The proof of what is found comes on top, with three coordinates minutes,
        and so do the figures of --out.
    loop
        Also prove from how far off the target the closed loop converges: along a line up to the
        start where that names one state, else in a box of all that it names, each with both signs;
        as much of it as the search gets to.
    loop_seconds
        With --loop: time to search for that, s; 300 by default. The proof takes about as much
        again.
    hold
        With --loop: how long the input is held, whole ms; 0 is a continuous input.
    within : NAME=PERCENT
        A parameter of the plant that is known only to within so many per cent: the region on the
        surface is proved once more with it, and the loop. Repeatable.
    bench
        Certify the loop that undertow run closes on this bench, keeping the surface: its period and
        boundary layer, and --loop. What is not in the proof is said above it; law and exported C
        are tried with that on random rigs. srv02: the paper's, of the rotary pendulum. usual: of
        usual quality, of any mechanism. --seconds is 0, and --loop-seconds 150, by default.
    out
        Folder for certificate.json and the figures.
    """
    from undertow.proofs import certified_gate
    from undertow.studies import certification

    given = f"{name or 'no mechanism'}{' and --appendix' if appendix else ''}"
    alone, whole = "one of them: a run has its own surfaces", "whole ms, 0 to 100"
    brief = "left out: of a run, stability and terminal sets are proved"
    timed, own = seconds is None or 0 <= seconds < 1e5, "an option of the loop's proof"
    usual_effort = certification.SEARCH if bench else certification.LOOP_SECONDS
    effort = usual_effort if loop_seconds is None else loop_seconds
    region = not run and (bool(seconds) if seconds is not None or appendix or bench else True)
    require(appendix == (name is None), "undertow certify", given, "a mechanism, or --appendix")
    require(not (run and surface is not None), "--surface with --run", surface, alone)
    given = "left out: the paper's cases have surfaces and starts of their own"
    needs(not appendix, "with --appendix", given, "run", "surface", "start")
    ways = "with --run, whose cascade it is for"
    needs(run, "without --run", ways, "objective", "horizon", "seed")
    require(timed, "--seconds", seconds, "in [0, 100000)")
    require(not (run and seconds), "--seconds", f"{seconds} s, with --run", brief)
    require(not (run and loop), "--loop", "with --run", brief)
    require(0 < effort < 1e5, "--loop-seconds", loop_seconds, "in (0, 100000)")
    needs(bench is None, "with --bench", "left out", "run", "appendix", "loop", "hold")
    loop = loop or bench is not None
    needs(loop, "without --loop", own, "loop_seconds", "hold")
    bears = loop or region or not within
    require(bears, "--within", "without a region and --loop", "an option of their proofs")
    require(0 <= hold <= 100, "--hold", hold, whole)
    held = not (loop and within) or hold or bench is not None
    require(held, "--within with --loop", "no --hold", "a held input")
    check_out(out)
    found: dict[str, Certified] = {}
    reports: list[RenderableType] = []
    task = x0 = used = None
    if run:
        task = parse_task(str(name), start, objective, horizon, settings=setting)
    mechanism = task[0] if task else mechanism_named(str(name or "rotary_pendulum"), setting)
    uncertain, place = _box(mechanism, within), _bench(mechanism, bench)
    if not (run or appendix):
        usual = bool(start or mechanism.start)  # without a start there is stability to prove
        x0 = parse_start(mechanism, start) if usual else mechanism.state()
        used = parse_surface(mechanism, surface) if surface else first_surface(mechanism)

    def keep(one: Certified) -> None:
        found[one.title] = one

    def prove(progress: Progress) -> None:
        if task is not None:
            _, begin, goal = task
            cascade = Cascade(mechanism, goal, gate=certified_gate(), seed=seed, belief="exact")
            motion = cascade.simulate(
                begin,
                progress=lambda t, end: progress("cascade" if t else FIRST_PLAN, t / end),
            )
            for one in certification.certify_run(
                mechanism, motion, reaching_law=cascade.reaching, kept=keep, progress=progress
            ):
                keep(one)
            reports.append(certification.run_report(motion))
        elif x0 is None or used is None:
            cases = certification.certify_appendix(
                mechanism, seconds=seconds or 0.0, loop=loop, loop_seconds=effort, hold=hold,
                uncertain=uncertain, kept=keep, progress=progress,
            )  # fmt: skip
            reports.append(certification.appendix_report(cases))
        elif place is not None:
            one = certification.certify_bench(
                place, used, x0, seconds=seconds or 0.0, loop_seconds=effort,
                uncertain=uncertain, kept=keep, progress=progress,
            )  # fmt: skip
            keep(one)
        else:
            one = certification.certify_surface(
                mechanism, used, x0, reaching_law=usual_reaching(mechanism, used),
                seconds=60.0 if seconds is None else seconds,
                loop=loop, loop_seconds=effort, hold=hold, uncertain=uncertain, kept=keep,
                progress=progress,
            )  # fmt: skip
            keep(one)

    every = completed(prove, found)
    certified = [*found.values()]
    if not reports:
        reports.extend(certification.subject_report(mechanism, one) for one in certified)
    with progress_bar() as progress:
        began = perf_counter()
        written = write(out, lambda: _files(mechanism, certified, progress), *reports, least=80)
    if written:
        written = (*written, f"Certificate and figures took {perf_counter() - began:.1f} s")
    show(*reports, *written, least=80)
    if not every:
        count = sum(len(one.subject.claims) for one in certified)
        where = f"in {out}/certificate.json" if out and count else "not written"
        end_interrupted(
            f"interrupted: {count} claims had been proved, they are {where}. The same command "
            "proves all anew; with less of --seconds and --loop-seconds it ends sooner"
        )
    proved = [{c.kind for c in item.subject.claims} for item in certified]
    exit_unless(all("stability" in kinds for kinds in proved))


def _files(
    mechanism: Mechanism, certified: Sequence[Certified], progress: Progress
) -> dict[str, bytes]:
    """Return the certificate, and figures of what has one: regions, and the closed loop."""
    from undertow.closed_loop.figures import figure_files
    from undertow.proofs import LoopClaim
    from undertow.studies import certification

    figures: dict[str, Figure] = {}
    for index, item in enumerate(certified):
        title = f"{mechanism.name}: {item.title.removeprefix('Surface').strip('()')}"
        if item.region is not None:
            progress("figure", 0.95)
            key = "region" if len(certified) == 1 else f"region_{index + 1}"
            figures[key] = certification.region_figure(item.region, item.subject.reaching, title)
        for claim in (c for c in item.subject.claims if c.kind == "closed loop"):
            found, subject = LoopClaim.of(claim.claim), item.subject
            key = "loop" if len(certified) == 1 else f"loop_{index + 1}"
            figures[key] = certification.loop_figure(
                mechanism, subject.surface, subject.reaching, found, title
            )
    return certification.certificate_files(mechanism, certified, figure_files(figures))


@command(
    "undertow verify proof/certificate.json",
    "undertow verify proof/certificate.json --mechanism model.py:make",
    "undertow verify proof/certificate.json --set m=0.125",
)
def verify(
    file: Path,
    mechanism: str | None = None,
    setting: Annotated[list[str] | None, typer.Option("--set")] = None,
    both: Annotated[bool, typer.Option("--both/--no-both")] = False,
    seconds: float = 600.0,
) -> None:
    """Check a certificate again, from the file and the mechanism alone.

    The file holds its model; where the library has none of that name, and none is given, it is
    decided for the model of the file.

    Exit status 0 when every claim is proved again, else 1.

    Parameters
    ----------
    file : FILE
        Certificate written by undertow certify.
    mechanism : MECHANISM
        Mechanism that the certificate is about: a name of the library, or FILE.py:NAME for your
        own, whose parameters must equal the certificate's. Default: the library's mechanism of that
        name.
    setting : NAME=VALUE
        Value that a parameter must have in the certificate, SI units. Repeatable.
    both
        Ask the second checker too (make checker), and fail where they differ.
    seconds
        With --both: time limit of the second checker, s.
    """
    from undertow.proofs import check_settings, read_certificate
    from undertow.proofs import verify as decide
    from undertow.studies import certification
    from undertow.studies.second_checker import agreement_table, decide_again

    needs(both, "without --both", "with the second checker", "seconds")
    certificate = read_certificate(file)
    check_settings(certificate, parse_values(setting))
    known = mechanism is not None or certificate.name in LIBRARY
    model = mechanism_named(mechanism or certificate.name) if known else None
    own = mechanism is not None and in_a_file(mechanism)
    again: list[tuple[str, float]] = []
    if both:
        again = decide_again(file, seconds=seconds)
    started: list[float] = []
    with progress_bar() as progress:

        def timed(what: str, fraction: float) -> None:
            started.append(perf_counter())
            progress(what, fraction)

        checked = decide(certificate, model, own_parameters=own, progress=timed)
    show(certification.verification_report(certificate, checked), least=80)
    alike = True
    if both:
        ends = [*started[1 : len(checked)], perf_counter()]
        ours = [
            (item.verdict.kind, end - start)
            for item, start, end in zip(checked, started, ends, strict=False)
        ]
        table, alike = agreement_table([item.claim.kind for item in checked], ours, again)
        show(table)
    exit_unless(alike and all(item.verdict for item in checked))
