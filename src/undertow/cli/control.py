"""One mechanism under control: a motion, an optimum."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from undertow.base import InvalidInputError
from undertow.base import artefacts as results
from undertow.cascade import Cascade, Gate
from undertow.cli import parsing as inputs
from undertow.cli.terminal import (
    AnyName,
    Box,
    Goal,
    HardInput,
    Horizon,
    Limits,
    Seed,
    Settings,
    Start,
    app,
    check_control,
    examples,
    progress_bar,
    reports_errors,
    say,
    terminal,
    write,
)
from undertow.closed_loop import ClosedLoop
from undertow.law import check_surface, first_surface
from undertow.optimiser import Budget, Optimiser
from undertow.runtime.controller_defaults import default_gate

__all__ = ["optimise", "simulate"]


@app.command(
    epilog=examples(
        "undertow simulate rotary_pendulum --start phi=35deg",
        "undertow simulate rotary_pendulum --start phi=40deg --objective time --set d_e=0.025 "
        "--out motion",
        "undertow simulate rotary_pendulum --start phi=20deg "
        "--surface 'lambda_a=-0.5 alpha_u=5 lambda_u=10'",
        "undertow simulate rotary_pendulum --objective time --control one-time --plant m=0.13",
        "undertow simulate rotary_pendulum --start phi=20deg --box theta=60deg "
        "--limit voltage=8 --hard-input",
        "undertow simulate model.py:bar",
    )
)
@reports_errors
def simulate(
    name: AnyName,
    start: Start = None,
    objective: Goal = "energy",
    control: Annotated[
        str | None,
        typer.Option(
            help="cascade, the default: re-optimised every period. one-time: optimised at the "
            "start. designed: the surface that is designed, not optimised.",
            metavar="WORD",
        ),
    ] = None,
    surface: Annotated[
        str | None,
        typer.Option(
            help="A surface of your own instead: 'lambda_a=-0.5 alpha_u=5 lambda_u=10'; commas "
            "between entries of a row, semicolons between rows; alpha_a is -1 if not given.",
            metavar="BLOCKS",
        ),
    ] = None,
    setting: Settings = None,
    plant: Annotated[
        list[str] | None,
        typer.Option(
            help="Parameter of the true plant that the controller does not know of, SI units. "
            "Repeatable.",
            metavar="NAME=VALUE",
        ),
    ] = None,
    limit: Limits = None,
    hard_input: HardInput = False,
    box: Box = None,
    horizon: Horizon = 60.0,
    period: Annotated[float, typer.Option(help="Time between re-optimisations, s.")] = 0.1,
    accept: Annotated[
        list[str] | None,
        typer.Option(
            help="Evidence that a new surface of the cascade needs at the present state, besides "
            "what the default gate asks for: stable, feasible, cost not raised. region: "
            "it is in a proved region. dual: its predicted motion enters one. sampled: states "
            "nearby arrive. local: stability near the target. Repeatable. Default: none.",
            metavar="EVIDENCE",
        ),
    ] = None,
    seed: Seed = 0,
    out: Annotated[
        Path | None, typer.Option(help="Folder for motion.csv, motion.png and manifest.json.")
    ] = None,
) -> None:
    """Simulate a mechanism under its sliding-mode law, from a start to the target."""
    from undertow.cli import report

    request = {k: v for k, v in locals().items() if k not in ("report", "out")}
    check_control(control, ("cascade", "one-time", "designed"))
    belief = inputs.mechanism_named(name, setting or (), limit or ())
    truth = belief.with_parameters(**inputs.parse_values(plant)) if plant else None
    x0 = inputs.parse_start(belief, start or ())
    goal = inputs.objective_named(objective, belief, horizon, box or (), hard_input=hard_input)
    goal.check_start(belief, x0)
    given = None if surface is None else inputs.parse_surface(belief, surface)
    if given is not None and control is not None:
        raise InvalidInputError(
            "--surface with --control",
            value=control,
            limit="one of them",
            remedy="A surface of your own is kept: leave --control out",
        )
    steering: str = control or ("cascade" if given is None else "given surface")
    request["control"] = steering
    if out is not None:
        results.check_folder(out)
    run = None
    gate = None
    if steering == "cascade":
        gate = default_gate() if accept is None else _evidence_gate(accept)
        cascade = Cascade(belief, goal, period=period, gate=gate, seed=seed)
        with progress_bar() as progress:
            run = cascade.simulate(
                x0, plant=truth, progress=lambda t, end: progress("cascade", t / end)
            )
        motion, surfaces = run.trajectory, run.surfaces
    else:
        if given is None:
            given = first_surface(belief)
            if steering == "one-time":
                given = Optimiser(ClosedLoop(belief, goal), seed=seed).require(x0).surface or given
        check_surface(belief, given, x0)
        motion = ClosedLoop(belief, goal, plant=truth).simulate(x0, given)
        surfaces = (given,)
    console = terminal()
    console.print(report.motion_report(belief, goal, x0, motion, surfaces[0], run, gate))
    if out is not None:
        files = report.motion_files(request, motion, motion.total, surfaces, run)
        say(console, write(out, files))
    if motion.event.name != "REACHED":
        raise typer.Exit(1)


def _evidence_gate(accept: list[str]) -> Gate:
    """Return the gate that asks for evidence of these kinds."""
    from undertow.certify.claims.gate import Policy, certified_gate

    kinds: Any = tuple(accept)
    return certified_gate(Policy(kinds))


@app.command(
    epilog=examples(
        "undertow optimise rotary_pendulum --start phi=40deg",
        "undertow optimise rotary_pendulum --start phi=41deg --objective time --set d_e=0.025",
        "undertow optimise rotary_pendulum --evaluations 20000 --seed 3 --out answer",
        "undertow optimise cart_pendulum --box x=-0.5m:0.5m --box phi_dot=90deg/s",
    )
)
@reports_errors
def optimise(
    name: AnyName,
    start: Start = None,
    objective: Goal = "energy",
    setting: Settings = None,
    limit: Limits = None,
    hard_input: HardInput = False,
    box: Box = None,
    horizon: Horizon = 60.0,
    evaluations: Annotated[int, typer.Option(help="Rollouts that the search may spend.")] = 3072,
    seed: Seed = 0,
    out: Annotated[Path | None, typer.Option(help="Folder for proposal.json.")] = None,
) -> None:
    """Find the best surface from a start: one global optimisation, with its margins."""
    from undertow.cli import report

    request: dict[str, Any] = {k: v for k, v in locals().items() if k not in ("report", "out")}
    belief = inputs.mechanism_named(name, setting or (), limit or ())
    x0 = inputs.parse_start(belief, start or ())
    goal = inputs.objective_named(objective, belief, horizon, box or (), hard_input=hard_input)
    goal.check_start(belief, x0)
    if out is not None:
        results.check_folder(out)
    optimiser = Optimiser(ClosedLoop(belief, goal), cold=Budget(evaluations), seed=seed)
    proposal = optimiser.require(x0)
    console = terminal()
    console.print(report.proposal_report(belief, goal, x0, proposal))
    if out is not None:
        say(console, write(out, report.proposal_files(request, proposal)))
