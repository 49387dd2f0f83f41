"""Bring-up of a rig: what is wired wrongly, how late it is, what its parameters are."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from undertow.base import InvalidInputError
from undertow.base import artefacts as results
from undertow.cli import parsing as inputs
from undertow.cli.terminal import (
    AnyName,
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
from undertow.models.importers.python_file import in_a_file

if TYPE_CHECKING:
    from undertow.models import FloatArray, Mechanism
    from undertow.plants import Rig

__all__ = ["bench"]


@app.command(
    epilog=examples(
        "undertow bench rotary_pendulum",
        "undertow bench rotary_pendulum --fault voltage=-1",
        "undertow bench cart_pendulum --fault x=4 --fault delay=0.001 --out findings",
        "undertow bench my_arm.py:arm --rig my_driver.py:Driver --out findings",
    )
)
@reports_errors
def bench(
    name: AnyName,
    rig: Annotated[
        str,
        typer.Option(
            help="realistic: a simulated bench with all its flaws. ideal: the model. "
            "FILE.py:NAME: a driver of your own, a class or a function that makes one.",
            metavar="RIG",
        ),
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
            "simulated rig's own; of your own rig it is measured, and compared with nothing."
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
    from undertow.bring_up import bring_up, miswired, rest_state
    from undertow.bring_up.report import files, findings_table, parameter_table, summary
    from undertow.plants import RealisticRig

    request = {"mechanism": name, "rig": rig, "fault": fault or [], "seed": seed}
    belief = inputs.mechanism_named(name, setting or ())
    rest = rest_state(belief)
    if out is not None:
        results.check_folder(out)
    faults = fault or ()
    plant = _plant(rig, name, belief, rest, faults, seed)
    if delay is None and isinstance(plant, RealisticRig):
        delay = plant.bench.timing.input_delay + plant.bench.timing.measurement_delay
    with closing(plant):
        if in_a_file(rig) and sys.stdin.isatty():
            say(terminal(), f"Ready. Let {name} come to rest, hands off, and press Enter.")
            if not sys.stdin.readline():  # the end of the input is no yes
                raise typer.Exit(1)
        with progress_bar() as progress:
            found = bring_up(
                miswired(plant, belief, faults),
                belief,
                delay=delay,
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


def _plant(
    rig: str, name: str, belief: Mechanism, rest: FloatArray, faults: Sequence[str], seed: int
) -> Rig:
    """Return the rig that was asked for; a simulated one moves as the library's numbers say."""
    from undertow.bring_up import rubbing
    from undertow.plants import IdealRig, Paced, RealisticRig, rig_from_file
    from undertow.plants.presets import bench_for

    if in_a_file(rig):
        if faults:
            raise InvalidInputError(
                "--fault",
                value=", ".join(faults),
                limit="a simulated rig",
                remedy="What is wrong with your own is for the wizard to find",
            )
        return Paced(rig_from_file(rig, belief))
    model = inputs.mechanism_named(name)
    if rig == "realistic":
        return RealisticRig(rubbing(bench_for(model), faults), rest, seed)
    if rig == "ideal":
        return IdealRig(model, rest)
    raise InvalidInputError(
        "rig",
        value=repr(rig),
        limit="realistic, ideal or FILE.py:NAME",
        remedy="A driver of your own: see examples/serial_rig.py",
    )
