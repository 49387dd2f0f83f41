"""Proofs: certify a surface, a run or the paper's cases; verify a certificate."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from undertow.base import InvalidInputError
from undertow.base import artefacts as results
from undertow.cascade import Cascade
from undertow.cli import parsing as inputs
from undertow.cli.terminal import (
    Goal,
    Horizon,
    Seed,
    Settings,
    Start,
    app,
    examples,
    progress_bar,
    reports_errors,
    say,
    terminal,
    write,
)
from undertow.law import first_surface
from undertow.mechanisms import LIBRARY
from undertow.models import Mechanism
from undertow.models.importers.python_file import in_a_file

__all__ = ["certify", "verify"]


def _box(mechanism: Mechanism, within: list[str] | None) -> dict[str, tuple[float, float]]:
    """Return [low, high] of plant parameters from per cents."""
    own = {p.name: p.value for p in mechanism.parameters}
    box = {}
    for name, percent in inputs.parse_values(within or ()).items():
        if name not in own or not 0 < percent < 100:
            raise InvalidInputError(
                "--within",
                value=f"{name}={percent:g}",
                limit=f"0 to 100 per cent of one of {', '.join(sorted(own))}",
            )
        ends = own[name] * (1 - percent / 100), own[name] * (1 + percent / 100)
        box[name] = (min(ends), max(ends))
    return box


@app.command(
    epilog=examples(
        "undertow certify rotary_pendulum --surface 'lambda_a=-1.59 alpha_u=1.96 lambda_u=12.1'",
        "undertow certify cart_pendulum --seconds 30 --out proof",
        "undertow certify rotary_pendulum --run --start phi=40deg --set d_e=0.025 --out proof",
        "undertow certify rotary_pendulum --loop --seconds 0 --start phi=20deg --out proof",
        "undertow certify rotary_pendulum --loop --seconds 0 --start phi=10deg --hold 1",
        "undertow certify rotary_pendulum --loop --seconds 0 --start phi=10deg --within m=5",
        "undertow certify --appendix",
        "undertow certify model.py:make",
    )
)
@reports_errors
def certify(
    name: Annotated[
        str | None,
        typer.Argument(
            help="Mechanism, e.g. rotary_pendulum, or your own as FILE.py:NAME.", metavar="NAME"
        ),
    ] = None,
    surface: Annotated[
        str | None,
        typer.Option(
            help="The surface: 'lambda_a=-0.5 alpha_u=5 lambda_u=10'. Default: the designed one.",
            metavar="BLOCKS",
        ),
    ] = None,
    start: Start = None,
    setting: Settings = None,
    run: Annotated[
        bool, typer.Option("--run", help="Simulate a cascade and certify what it applied.")
    ] = False,
    appendix: Annotated[
        bool, typer.Option("--appendix", help="The paper's five cases instead.")
    ] = False,
    objective: Goal = "energy",
    horizon: Horizon = 60.0,
    seconds: Annotated[
        float | None,
        typer.Option(help="Search for each region on the surface, s; 0 leaves it out."),
    ] = None,
    loop: Annotated[
        bool,
        typer.Option(
            "--loop",
            help="Also prove from how far the full closed loop, at rest, converges: up to the "
            "start, or where the proof ends. Takes minutes.",
        ),
    ] = False,
    hold: Annotated[
        int,
        typer.Option(help="With --loop: the input is held for this many ms. Default: not held."),
    ] = 0,
    within: Annotated[
        list[str] | None,
        typer.Option(
            help="With --loop: a parameter of the plant that the law knows to so many per cent "
            "only. Repeatable.",
            metavar="NAME=PERCENT",
        ),
    ] = None,
    seed: Seed = 0,
    out: Annotated[
        Path | None, typer.Option(help="Folder for certificate.json and the figures.")
    ] = None,
) -> None:
    """Prove what can be proved: stability, domain, disturbances, terminal sets, regions.

    Exit status 0 when local stability at least is proved for every surface, else 1.
    """
    from undertow.certify.claims.gate import certified_gate
    from undertow.certify.closed_loop.claim import LoopClaim
    from undertow.display.plot import figure_bytes
    from undertow.studies import certification

    if appendix == (name is not None):
        raise InvalidInputError(
            "undertow certify",
            value=f"{name or 'no mechanism'}{' and --appendix' if appendix else ''}",
            limit="a mechanism, or --appendix",
        )
    if run and surface is not None:
        raise InvalidInputError(
            "--surface with --run", value=surface, limit="one of them: a run has its own surfaces"
        )
    if seconds is not None and not 0 <= seconds < 1e5:
        raise InvalidInputError("--seconds", value=seconds, limit="in [0, 100000)")
    if (hold or within) and not loop:
        raise InvalidInputError(
            "--hold and --within", value="without --loop", limit="options of the loop's proof"
        )
    if not 0 <= hold <= 1000:
        raise InvalidInputError("--hold", value=hold, limit="whole ms, 0 to 1000")
    if out is not None:
        results.check_folder(out)
    console = terminal()
    console.width = max(console.width, 80)
    mechanism = inputs.mechanism_named(name or "rotary_pendulum", setting or ())
    report: Any
    figures: dict[str, bytes] = {}
    with progress_bar() as progress:
        if appendix:
            cases = certification.certify_appendix(
                mechanism, seconds=seconds or 0.0, progress=progress
            )
            certified, report = cases, certification.appendix_report(cases)
        elif run:
            x0 = inputs.parse_start(mechanism, start or ())
            goal = inputs.objective_named(objective, mechanism, horizon)
            cascade = Cascade(mechanism, goal, gate=certified_gate(), seed=seed)
            motion = cascade.simulate(x0, progress=lambda t, end: progress("cascade", t / end))
            certified = certification.certify_run(mechanism, motion, progress=progress)
            report = certification.run_report(motion)
        else:
            x0 = inputs.parse_start(mechanism, start or ())
            given = (
                first_surface(mechanism)
                if surface is None
                else inputs.parse_surface(mechanism, surface)
            )
            one = certification.certify_surface(
                mechanism, given, x0, seconds=60.0 if seconds is None else seconds,
                loop=loop, hold=hold, uncertain=_box(mechanism, within), progress=progress,
            )  # fmt: skip
            certified, report = (one,), certification.subject_report(mechanism, one)
        if out is not None:
            for index, item in enumerate(certified):
                title = f"{mechanism.name}: {item.title.removeprefix('Surface').strip('()')}"
                if item.region is not None:
                    progress("figure", 0.95)
                    figure = certification.region_figure(item.region, title)
                    key = "region.png" if len(certified) == 1 else f"region_{index + 1}.png"
                    figures[key] = figure_bytes(figure)
                for claim in (c for c in item.subject.claims if c.kind == "closed loop"):
                    found = LoopClaim.from_dict(claim.data)
                    picture = certification.loop_figure(
                        mechanism, item.subject.surface, item.subject.reaching, found, title
                    )
                    figures["loop.png"] = figure_bytes(picture)
    written = None
    if out is not None:
        written = write(out, certification.certificate_files(mechanism, certified, figures))
    console.print(report)
    if written is not None:
        say(console, written)
    proved = [{c.kind for c in item.subject.claims} for item in certified]
    if not all("stability" in kinds for kinds in proved):
        raise typer.Exit(1)


@app.command(
    epilog=examples(
        "undertow verify proof/certificate.json",
        "undertow verify proof/certificate.json --mechanism model.py:make",
        "undertow verify proof/certificate.json --set m=0.125",
    )
)
@reports_errors
def verify(
    file: Annotated[
        Path, typer.Argument(help="A certificate of undertow certify.", metavar="FILE")
    ],
    mechanism: Annotated[
        str | None,
        typer.Option(
            help="The mechanism it is about: a library name, or FILE.py:NAME for your own, whose "
            "parameters must then be the certificate's. Default: the library's of that name.",
            metavar="MECHANISM",
        ),
    ] = None,
    setting: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            help="A parameter of yours, SI units, that must be the certificate's. Repeatable.",
            metavar="NAME=VALUE",
        ),
    ] = None,
    seconds: Annotated[float, typer.Option(help="Effort for each claim, s.")] = 600.0,
) -> None:
    """Check a certificate again, from the file and the mechanism alone.

    Exit status 0 when every claim is proved again, else 1.
    """
    from undertow.certify.claims.certificate import read_certificate
    from undertow.certify.claims.verify import check_settings
    from undertow.certify.claims.verify import verify as decide
    from undertow.studies import certification

    certificate = read_certificate(file)
    check_settings(certificate, inputs.parse_values(setting or ()))
    if mechanism is None and certificate.name not in LIBRARY:
        raise InvalidInputError(
            "certificate of a mechanism that the library does not have",
            value=certificate.name,
            remedy="Name its file: --mechanism FILE.py:NAME",
        )
    model = inputs.mechanism_named(mechanism or certificate.name)
    own = mechanism is not None and in_a_file(mechanism)
    console = terminal()
    console.width = max(console.width, 80)
    with progress_bar() as progress:
        checked = decide(
            certificate, model, own_parameters=own, max_seconds=seconds, progress=progress
        )
    console.print(certification.verification_report(certificate, checked))
    if not all(item.verdict for item in checked):
        raise typer.Exit(1)
