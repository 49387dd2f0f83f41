"""One mechanism under control: a motion, an optimum."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from undertow.base import InvalidInputError
from undertow.cascade import Cascade, Gate
from undertow.cli import options
from undertow.cli.parsing import aimed, parse_surface, parse_target, parse_task, parse_values
from undertow.cli.terminal import (
    check_out,
    command,
    exit_unless,
    needs,
    progress_bar,
    show,
    write,
)
from undertow.closed_loop import ClosedLoop
from undertow.law import check_surface, first_surface, usual_reaching
from undertow.objective import USUAL
from undertow.optimiser import Budget, DecisionVariables, Optimiser
from undertow.runtime import default_gate

#: What a cascade does before anything moves, in words.
FIRST_PLAN = "searching for the first plan"


@command(
    "undertow simulate rotary_pendulum --start phi=35deg",
    "undertow simulate rotary_pendulum --start phi=40deg --objective time --set d_e=0.025 "
    "--out motion",
    "undertow simulate rotary_pendulum --start phi=20deg "
    "--surface 'lambda_a=-0.5 alpha_u=5 lambda_u=10'",
    "undertow simulate rotary_pendulum --objective time --control one-time --plant m=0.13",
    "undertow simulate rotary_pendulum --objective time --schedule 0.1",
    "undertow simulate rotary_pendulum --start phi=20deg --box theta=60deg "
    "--limit voltage=8 --hard-input",
    "undertow simulate overhead_crane --target x=1m --target x=-1m@2s --objective bench-time",
    "undertow simulate model.py:bar",
    "undertow simulate robot.urdf:shoulder --target upright",
)
def simulate(
    name: options.AnyName,
    start: options.Start = None,
    target: options.Target = None,
    objective: options.Goal = USUAL,
    control: str | None = None,
    surface: options.SurfaceText = None,
    setting: options.Settings = None,
    plant: list[str] | None = None,
    limit: options.Limits = None,
    hard_input: options.HardInput = False,
    box: options.Box = None,
    horizon: options.Horizon = 60.0,
    period: float = 0.1,
    accept: list[str] | None = None,
    known: Annotated[Literal["usual", "exact"] | None, typer.Option("--belief")] = None,
    schedule: float = 0.0,
    evaluations: int | None = None,
    seed: options.Seed = 0,
    out: Path | None = None,
) -> None:
    """Simulate a mechanism under its sliding-mode law, from a start to the target.

    A target that moves is followed to the end of the horizon, or until the last set-point is
    reached.

    Parameters
    ----------
    control : WORD
        cascade, the default: re-optimised every period. one-time: optimised at the start. designed:
        the designed surface, not optimised.
    plant : NAME=VALUE
        Parameter of the true plant that the controller does not know, SI units. Repeatable.
    period
        Time between re-optimisations, s.
    accept : EVIDENCE
        Evidence that the cascade asks for before it applies a new surface, besides the default gate
        (stable, feasible, cost not raised). region: the present state is in a proved region. dual:
        the predicted motion enters one. sampled: motions from nearby states reach the target.
        local: stability near the target. Repeatable. Default: none.
    known
        What the cascade takes for known. usual: parameters within their tolerances, learnt as it
        goes. exact: the model, as in the paper. Default: usual; exact with --accept, whose evidence
        is of one model, and with --schedule.
    schedule
        Surfaces one after another with free reaching laws; for least time each for so long at most,
        s, following the earliest motion over all inputs. 0.1, the period, is usual. 0: one surface
        at a time.
    evaluations
        Largest number of rollouts of the first search; by default as it needs.
    out
        Folder for motion.csv, motion.png and manifest.json.
    """
    request = {k: v for k, v in locals().items() if k != "out"}
    from undertow.studies.motion import motion_files, motion_report

    options.check_control(control, ("cascade", "one-time", "designed"), surface)
    name, target = aimed(name, target)
    belief, x0, goal = parse_task(name, start, objective, horizon, setting, limit, box, hard_input)
    goes_to = parse_target(belief, target)
    truth = belief.with_parameters(**parse_values(plant)) if plant else None
    given = None if surface is None else parse_surface(belief, surface)
    request["control"] = steering = control or ("cascade" if given is None else "given surface")
    check_out(out)
    run = cascade = None
    loop: Cascade | ClosedLoop
    if goes_to is not None and steering != "cascade":
        raise InvalidInputError(
            f"--target with --control {steering}" if given is None else "--target with --surface",
            value=steering,
            limit="cascade, which follows targets",
            remedy="Leave one of them out",
        )
    needs(
        steering == "cascade", "with one surface", "the cascade, which decides by it",
        "accept", "known", "schedule", "period",
        remedy="Leave it out, or --control and --surface",
    )  # fmt: skip
    needs(
        steering in ("cascade", "one-time"), "without a search",
        "for a cascade, or --control one-time", "evaluations", "seed",
    )  # fmt: skip
    cold = None if evaluations is None else Budget(evaluations)
    if steering == "cascade":
        gate = default_gate() if accept is None else _evidence_gate(accept)
        known = known or ("exact" if accept or schedule else "usual")
        freedom = DecisionVariables(reaching=schedule > 0, schedule=schedule)
        loop = cascade = Cascade(
            belief, goal, period=period, gate=gate, seed=seed, belief=known, freedom=freedom,
            cold=cold,
        )  # fmt: skip
        with progress_bar() as progress:
            run = cascade.simulate(
                x0,
                plant=truth,
                target=goes_to,
                progress=lambda t, end: progress("cascade" if t else FIRST_PLAN, t / end),
            )
        motion, surfaces = run.trajectory, run.surfaces
    else:
        used = given or first_surface(belief)
        loop = ClosedLoop(belief, goal, usual_reaching(belief, used))
        if steering == "one-time":
            with progress_bar() as progress:
                progress("searching for the best surface", 0.0)
                used = Optimiser(loop, cold=cold, seed=seed).require(x0).surface or used
        check_surface(belief, used, x0)
        motion, surfaces = replace(loop, plant=truth).simulate(x0, used), (used,)
    words = ", ".join(target or ())
    said = motion_report(
        belief, goal, x0, motion, surfaces[0], run, cascade, goes_to, words, loop.reaching
    )
    written = write(
        out, lambda: motion_files(request, motion, motion.cost, surfaces, run, loop.reaching), said
    )
    show(said, *written)
    exit_unless(motion.event.name == "REACHED")


def _evidence_gate(accept: list[str]) -> Gate:
    """Return the gate that asks for evidence of these kinds."""
    from undertow.proofs import GatePolicy, certified_gate

    kinds: Any = tuple(accept)
    return certified_gate(GatePolicy(kinds))


@command(
    "undertow optimise rotary_pendulum --start phi=40deg",
    "undertow optimise rotary_pendulum --start phi=41deg --objective time --set d_e=0.025",
    "undertow optimise rotary_pendulum --evaluations 20000 --seed 3 --out answer",
    "undertow optimise cart_pendulum --box x=-0.5m:0.5m --box phi_dot=90deg/s",
)
def optimise(
    name: options.AnyName,
    start: options.Start = None,
    objective: options.Goal = USUAL,
    setting: options.Settings = None,
    limit: options.Limits = None,
    hard_input: options.HardInput = False,
    box: options.Box = None,
    horizon: options.Horizon = 60.0,
    evaluations: int | None = None,
    seed: options.Seed = 0,
    out: Path | None = None,
) -> None:
    """Find the best surface from a start: one global optimisation, with its margins.

    Parameters
    ----------
    evaluations
        Largest number of rollouts of the search. Default: as many as it needs.
    out
        Folder for proposal.json.
    """
    request = {k: v for k, v in locals().items() if k != "out"}
    from undertow.studies.motion import proposal_files, proposal_report

    belief, x0, goal = parse_task(name, start, objective, horizon, setting, limit, box, hard_input)
    check_out(out)
    cold = None if evaluations is None else Budget(evaluations)
    loop = ClosedLoop(belief, goal)
    optimiser = Optimiser(loop, cold=cold, seed=seed)
    with progress_bar() as progress:
        progress("searching for the best surface", 0.0)
        proposal = optimiser.require(x0)
    said = proposal_report(belief, goal, x0, proposal, loop.reaching)
    show(said, *write(out, lambda: proposal_files(request, proposal), said))
