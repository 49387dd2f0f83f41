"""Bring-up of a rig: what is wired wrongly, how late it is, what its parameters are."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from undertow import inputs, results
from undertow.cli.terminal import (
    Name,
    Seed,
    Settings,
    app,
    examples,
    progress_bar,
    reports_errors,
    say,
    terminal,
    write,
)

__all__ = ["bench"]


@app.command(
    epilog=examples(
        "undertow bench rotary_pendulum",
        "undertow bench rotary_pendulum --fault voltage=-1",
        "undertow bench cart_pendulum --fault x=4 --fault delay=0.001 --out findings",
    )
)
@reports_errors
def bench(
    name: Name,
    rig: Annotated[
        Literal["realistic", "ideal"],
        typer.Option(help="The simulated plant: a bench with all its flaws, or its model."),
    ] = "realistic",
    fault: Annotated[
        list[str] | None,
        typer.Option(
            help="Wire the simulated rig wrongly: INPUT=-1 or COORDINATE=2 (a factor, 0: cable "
            "off), swap=COORDINATE,COORDINATE (two encoders), delay=0.0015 (s, besides its own), "
            "friction=12 (times its own). Repeatable.",
            metavar="PART=VALUE",
        ),
    ] = None,
    delay: Annotated[
        float | None,
        typer.Option(
            help="From a write to its effect in a reading, s, as it should be. Default: the "
            "simulated rig's own."
        ),
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Signs, scales and breakaway alone.")
    ] = False,
    setting: Settings = None,
    seed: Seed = 0,
    out: Annotated[
        Path | None, typer.Option(help="Folder for findings.json, motion.csv and motion.png.")
    ] = None,
) -> None:
    """Check a rig at rest by small safe motions: signs, scales, delay, friction, parameters."""
    from undertow.bring_up import bring_up, miswired, rest_state, rubbing
    from undertow.bring_up.report import files, findings_table, parameter_table, summary
    from undertow.rig import IdealRig, RealisticRig
    from undertow.rig.presets import bench_for

    request = {"mechanism": name, "rig": rig, "fault": fault or [], "seed": seed}
    belief = inputs.mechanism_named(name, setting or ())
    rest = rest_state(belief)
    if out is not None:
        results.check_folder(out)
    flaws = rubbing(bench_for(inputs.mechanism_named(name)), fault or ())
    plant = (
        RealisticRig(flaws, rest, seed)
        if rig == "realistic"
        else IdealRig(inputs.mechanism_named(name), rest)
    )
    timing = plant.bench.timing
    expected = timing.input_delay + timing.measurement_delay if delay is None else delay
    with progress_bar() as progress:
        found = bring_up(
            miswired(plant, belief, fault or ()),
            belief,
            delay=expected,
            rest=rest,
            learn=not quick,
            progress=progress,
        )
    console = terminal()
    console.print(findings_table(found))
    if found.identification is not None:
        console.print()
        console.print(parameter_table(found.identification))
    for line in summary(found):
        say(console, line)
    if out is not None:
        say(console, write(out, files(request, belief, rest, found)))
    if found.wrong:
        raise typer.Exit(1)
