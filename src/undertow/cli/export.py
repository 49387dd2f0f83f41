"""The controller in another language."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import typer
from rich.console import Console

from undertow.base import InvalidInputError
from undertow.base import artefacts as results
from undertow.cli import parsing as inputs
from undertow.cli.terminal import (
    Application,
    Goal,
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
from undertow.export import (
    DerivativeStep,
    EmbeddedController,
    KalmanStep,
    SuperTwistingStep,
    files,
)
from undertow.export.estimate import EstimatorStep
from undertow.export.host import Build
from undertow.law import ReachingLaw, check_surface, first_surface
from undertow.mechanisms import LIBRARY
from undertow.models import FloatArray, Mechanism
from undertow.optimiser import Optimiser
from undertow.plants.presets import bench_for
from undertow.symbolic import Real

__all__ = ["export_c"]

#: Length of a run on a rig, s.
SECONDS = 10.0

export = Application(help="Write the controller in another language.")
app.add_typer(export, name="export")


@export.command(
    name="c",
    epilog=examples(
        "undertow export c rotary_pendulum --out firmware",
        "undertow export c cart_pendulum --control one-time --start phi=20deg --real float "
        "--velocity super-twisting --slew 400 --out firmware",
        "undertow export c gantry_crane --check --rigs 3",
        "undertow export c bar.py:bar --velocity super-twisting --acceleration 80 --out firmware",
        "undertow export c --all --report",
        "undertow export c rotary_pendulum --start phi=35deg --bit-flips",
    ),
)
@reports_errors
def export_c(
    name: Annotated[
        str | None,
        typer.Argument(
            help="Mechanism, e.g. rotary_pendulum, or your own as FILE.py:NAME.",
            show_default=False,
        ),
    ] = None,
    every: Annotated[bool, typer.Option("--all", help="All mechanisms of the library.")] = False,
    out: Annotated[
        Path | None, typer.Option(help="Folder for NAME.c, NAME.h and what tests them.")
    ] = None,
    check: Annotated[
        bool, typer.Option("--check", help="Compile it here and run its own test.")
    ] = False,
    report: Annotated[
        bool,
        typer.Option(
            "--report",
            help="Table of agreement with Python, instructions of a step and size.",
        ),
    ] = False,
    rigs: Annotated[
        int,
        typer.Option(
            "--rigs",
            help="Also run it on so many realistic rigs, as a process of its own over a pipe.",
            min=0,
        ),
    ] = 0,
    bit_flips: Annotated[
        bool,
        typer.Option(
            "--bit-flips",
            help="Also upset every bit of its memory, one in each run on a realistic rig, double "
            "and float: minutes.",
        ),
    ] = False,
    control: Annotated[
        str | None,
        typer.Option(
            help="designed, the default: the surface that is designed. one-time: optimised at the "
            "start.",
            metavar="WORD",
        ),
    ] = None,
    surface: Annotated[
        str | None,
        typer.Option(help="A surface of your own, as for simulate.", metavar="BLOCKS"),
    ] = None,
    start: Start = None,
    objective: Goal = "energy",
    eta: Annotated[float, typer.Option(help="Reaching gain.")] = 20.0,
    layer: Annotated[float, typer.Option(help="Half-width of the boundary layer.")] = 0.1,
    real: Annotated[
        Literal["double", "float"], typer.Option(help="Floating-point type of the C.")
    ] = "double",
    period: Annotated[float, typer.Option(help="Sample period, s.")] = 0.001,
    velocity: Annotated[
        Literal["derivative", "super-twisting", "kalman"],
        typer.Option(
            help="Where velocities come from when positions alone are measured. kalman: the model, "
            "corrected by encoders of 4096 counts a turn or 20 µm."
        ),
    ] = "derivative",
    time_constant: Annotated[float, typer.Option(help="Of the filtered derivative, s.")] = 0.01,
    acceleration: Annotated[
        float,
        typer.Option(help="Bound for super-twisting on every coordinate's, rad/s² or m/s²."),
    ] = 200.0,
    slew: Annotated[
        float | None,
        typer.Option(help="Largest rate of an input, its unit per second. Default: no limit."),
    ] = None,
    missed: Annotated[int, typer.Option(help="Periods bridged without a measurement.")] = 5,
    rows: Annotated[int, typer.Option(help="Most surfaces in a plan.", min=1)] = 1,
    prefix: Annotated[str, typer.Option(help="Beginning of every C name.")] = "ut",
    compiler: Annotated[str, typer.Option(help="C compiler for --check and --report.")] = "gcc",
    states: Annotated[int, typer.Option(help="Random states of --report.", min=1)] = 100_000,
    setting: Settings = None,
    seed: Seed = 0,
) -> None:
    """Write the inner loop in C99: no heap, no dependencies, limits, estimator, surface table."""
    from undertow.export.report import csv, measure, tables

    check_control(control, ("designed", "one-time"))

    if every == (name is not None):
        raise InvalidInputError(
            "mechanism to export",
            value="a name and --all" if every else "neither a name nor --all",
            limit="one of them",
            remedy="Write for instance: undertow export c rotary_pendulum --out firmware",
        )
    if out is None and not (check or report or rigs or bit_flips):
        raise InvalidInputError(
            "what to do with the C",
            value="none of --out, --check, --rigs, --bit-flips, --report",
            limit="one of them at least",
            remedy="Write for instance --out firmware",
        )
    if out is not None:
        results.check_folder(out)

    def estimator(belief: Mechanism) -> EstimatorStep:
        if velocity == "kalman":
            encoders = bench_for(belief).encoders
            counts = [encoders[c.name].resolution for c in belief.coordinates]
            return KalmanStep(tuple(count / math.sqrt(12) for count in counts))
        if velocity == "super-twisting":
            return SuperTwistingStep(acceleration)
        return DerivativeStep(time_constant)

    def controller(belief: Mechanism) -> EmbeddedController:
        x0 = inputs.parse_start(belief, start or ())
        law = ReachingLaw(eta, layer)
        if surface is not None:
            chosen = inputs.parse_surface(belief, surface)
        elif control == "one-time":
            goal = inputs.objective_named(objective, belief, 60.0)
            loop = ClosedLoop(belief, goal, reaching=law)
            best = Optimiser(loop, seed=seed).require(x0).surface
            assert best is not None  # require() raises otherwise
            chosen = best
        else:
            chosen = first_surface(belief)
        check_surface(belief, chosen)
        return EmbeddedController(
            belief,
            chosen,
            law,
            period=period,
            differentiator=estimator(belief),
            slew=slew,
            missed=missed,
            rows=rows,
            real=real,
            prefix=prefix,
        )

    if surface is not None and control is not None:
        raise InvalidInputError(
            "--surface with --control",
            value=control,
            limit="one of them",
            remedy="A surface of your own is kept: leave --control out",
        )
    names = list(LIBRARY) if every else [str(name)]
    chosen = [controller(inputs.mechanism_named(n, setting or ())) for n in names]
    written: dict[str, bytes] = {}
    for one in chosen:
        written |= files(one)
    console = terminal()
    good = True
    if check:
        for one in chosen:
            with tempfile.TemporaryDirectory(prefix="undertow-") as folder:
                passed, said = Build(one, Path(folder), compiler).self_test()
            good &= passed
            say(console, said)
    if rigs:
        for one in chosen:
            x0 = inputs.parse_start(one.mechanism, start or ())
            with progress_bar() as progress:
                held = on_rigs(one, x0, rigs, compiler, progress)
            good &= held == rigs
            words = ", ".join(start or ()) or "its usual start"
            console.print(
                f"{one.mechanism.name}: held on {held} of {rigs} realistic rigs, seeds 0 to "
                f"{rigs - 1}, from {words}, as a process over a pipe, positions alone measured.",
                markup=False,
            )
    if bit_flips:
        for one in chosen:
            x0 = inputs.parse_start(one.mechanism, start or ())
            good &= flip_bits(one, x0, compiler, console)
    if report:
        with progress_bar() as progress:
            entries = measure(chosen, states=states, compiler=compiler, progress=progress)
        good &= all(entry.passed for entry in entries)
        written["report.csv"] = csv(entries)
        console.print(*tables(entries), sep="\n")
        for line in notes(one=chosen[0], states=states, compiler=compiler):
            console.print(line, markup=False)
    if out is not None:
        say(console, write(out, written))
    if not good:
        raise typer.Exit(1)


def on_rigs(
    one: EmbeddedController,
    x0: FloatArray,
    rigs: int,
    compiler: str,
    progress: Callable[[str, float], None],
) -> int:
    """Return on how many realistic rigs the exported controller holds the mechanism."""
    from undertow.export.loop import run_on_rig
    from undertow.plants import RealisticRig

    bench = bench_for(one.mechanism).with_timing(period=one.period)
    held = 0
    with tempfile.TemporaryDirectory(prefix="undertow-") as folder:
        build = Build(one, Path(folder), compiler)
        for seed in range(rigs):
            progress(f"rigs of {one.mechanism.name}", seed / rigs)
            with build.start() as process:
                held += run_on_rig(process, RealisticRig(bench, x0, seed), SECONDS).held
    return held


def flip_bits(one: EmbeddedController, x0: FloatArray, compiler: str, console: Console) -> bool:
    """Upset every bit of the controller's memory, say what came of it: whether limits held."""
    from undertow.export.upsets import upset_every_bit, upsets_table
    from undertow.plants import RealisticRig

    bench = bench_for(one.mechanism).with_timing(period=one.period)
    beyond = 0
    precisions: tuple[Real, ...] = ("double", "float")
    for real in precisions:
        with tempfile.TemporaryDirectory(prefix="undertow-") as folder, progress_bar() as progress:
            upsets = upset_every_bit(
                Build(replace(one, real=real), Path(folder), compiler),
                RealisticRig(bench, x0, seed=0),
                progress=partial(progress, f"bits of {one.mechanism.name}, {real}"),
            )
        console.print(upsets_table(upsets))
        console.print(str(upsets), markup=False)
        beyond += sum(upsets.beyond.values())
    return beyond == 0


def notes(one: EmbeddedController, states: int, compiler: str) -> tuple[str, ...]:
    """Return what the columns of the report mean."""
    from undertow.export.host import FLAGS, NEAREST, version

    nearest = NEAREST[one.real]
    return (
        f"Built by {version(compiler)} with {' '.join(FLAGS)}, real = {one.real}.",
        f"At {states} random states; u and demand by max(|value|, limit), s and margin by "
        "max(|value|, 1). demand: before the limits, times |det Γ(q)/det Γ(0)| where that is below "
        "1, for it has the inverse as a factor."
        + f" States with less than {nearest:g} of it are left out: there its sign is rounding."
        * (nearest > 0),
        "instr.: mean of a run from positions, math.h included, by valgrind's callgrind. stack: "
        "all frames together, without math.h's.",
    )
