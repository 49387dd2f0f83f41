"""The controller in another language, a log for other programs."""

from __future__ import annotations

import math
import tempfile
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import typer
from rich.text import Text

from undertow.base import InvalidInputError, one_of
from undertow.cli import options
from undertow.cli.options import option
from undertow.cli.parsing import mechanism_named, objective_named, parse_start, parse_surface
from undertow.cli.terminal import (
    Application,
    app,
    check_out,
    command,
    exit_unless,
    folded,
    needs,
    progress_bar,
    show,
    write,
)
from undertow.closed_loop import ClosedLoop
from undertow.export import EmbeddedController, KalmanStep, carriers, files
from undertow.export.estimate import STEPS, EstimatorStep
from undertow.export.host import Build
from undertow.law import SUITED, ReachingLaw, Surface, check_surface, first_surface
from undertow.mechanisms import LIBRARY
from undertow.models import Mechanism
from undertow.objective import USUAL, Goal
from undertow.optimiser import Optimiser
from undertow.plants.bench import bench_for
from undertow.studies.rigs.export import upsets_table

export = Application()
app.add_typer(export, name="export")


@export.callback(
    epilog=folded(
        "undertow export c rotary_pendulum --out firmware",
        "undertow export log run.db --mcap run.mcap",
    )
)
def what() -> None:
    """Write the controller in C, or the log of a run for other programs."""


@command(
    "undertow export c rotary_pendulum --out firmware",
    "undertow export c cart_pendulum --control one-time --start phi=20deg --real float "
    "--velocity super-twisting --slew 400 --out firmware",
    "undertow export c gantry_crane --check --rigs 3",
    "undertow export c bar.py:bar --velocity super-twisting --acceleration 80 --out firmware",
    "undertow export c --all --report",
    "undertow export c rotary_pendulum --start phi=35deg --bit-flips",
    "undertow export c rotary_pendulum --for fmi --for simulink --out units",
    name="c",
    of=export,
)
def export_c(
    name: options.OneName = None,
    every: Annotated[bool, typer.Option("--all")] = False,
    out: Path | None = None,
    check: bool = False,
    report: bool = False,
    rigs: Annotated[int, typer.Option(min=0)] = 0,
    bit_flips: bool = False,
    platforms: Annotated[list[str] | None, typer.Option("--for")] = None,
    control: str | None = None,
    surface: options.SurfaceText = None,
    start: options.Start = None,
    objective: options.Goal = USUAL,
    eta: float | None = None,
    layer: float | None = None,
    real: Literal["double", "float"] = "double",
    period: float = 0.001,
    velocity: Annotated[
        str,
        option(
            f"Where velocities come from when only positions are measured: {', '.join(STEPS)}. "
            "kalman: the model, corrected by encoders of 4096 counts a turn or 20 µm.",
            metavar="WORD",
        ),
    ] = "derivative",
    time_constant: float | None = None,
    acceleration: float | None = None,
    slew: float | None = None,
    missed: int = 5,
    rows: Annotated[int, typer.Option(min=1)] = 1,
    prefix: str = "ut",
    compiler: str = "gcc",
    states: Annotated[int, typer.Option(min=1)] = 100_000,
    setting: options.Settings = None,
    limit: options.Limits = None,
    seed: options.Seed = 0,
) -> None:
    """Write the inner loop in C99: no heap, no dependencies, limits, estimator, surface table.

    Parameters
    ----------
    every
        Export all mechanisms of the library.
    out
        Folder for NAME.c, NAME.h and what tests them.
    check
        Compile it and run its self-test.
    report
        Print a table: agreement with Python, instructions of a step, size.
    rigs
        Also run it on this many realistic rigs, as a separate process over a pipe.
    bit_flips
        Also flip every bit of its memory, one in each run on a realistic rig, in double and in
        float. Takes minutes.
    platforms : WORD
        Also write what carries it elsewhere: fmi: co-simulation units of controller and plant, FMI
        3.0, built here. ros2: a package with a ros2_control controller. simulink: a Level-2
        S-function. May be repeated.
    control : WORD
        designed, the default: the designed surface. one-time: optimised at the start.
    eta
        Reaching gain. Default: 20.
    layer
        Half-width of the boundary layer. Default: 0.1; with neither this nor --eta as thick as
        disturbance bounds ask for, such as dry friction of a model file.
    real
        Floating-point type of the C.
    period
        Sample period, s.
    time_constant
        derivative: time constant of its filter, s. Default: 0.01.
    acceleration
        super-twisting: bound on every coordinate's acceleration, rad/s² or m/s². Default: 200.
    slew
        Largest rate of change of an input, in its unit per second. Default: no limit.
    missed
        Sample periods without a measurement that are bridged.
    rows
        Largest number of surfaces in a plan.
    prefix
        Prefix of every C name.
    compiler
        C compiler for --check, --report, --rigs, --bit-flips, --for fmi.
    states
        Number of random states for --report.
    """
    from undertow.studies.rigs.export import csv, flip_bits, held_on_rigs, measure, notes, tables

    options.check_control(control, ("designed", "one-time"), surface)
    wanted = check or report or bool(rigs) or bit_flips
    _check_request(name, out, every=every, wanted=wanted, carried=bool(platforms))
    one_of("objective", objective, get_args(Goal))
    words = "with --control one-time, which looks for the best surface"
    needs(control == "one-time", "without a search", words, "objective", "seed")
    needs(report, "without a report", "with --report", "states")
    built = wanted or "fmi" in (platforms or ())
    compiles = "with --check, --report, --rigs, --bit-flips or --for fmi"
    needs(built, "where nothing is compiled", compiles, "compiler")
    check_out(out)
    given: dict[str, Any] = {k: v for k, v in (("eta", eta), ("layer", layer)) if v is not None}
    law = ReachingLaw(**given) if given else SUITED

    def controller(belief: Mechanism) -> EmbeddedController:
        if surface is not None:
            used = parse_surface(belief, surface)
        elif control == "one-time":
            used = _first_optimum(belief, objective, law, start, seed)
        else:
            used = first_surface(belief)
        check_surface(belief, used)
        return EmbeddedController(
            belief,
            used,
            law,
            period=period,
            differentiator=_estimator(belief, velocity, time_constant, acceleration),
            slew=slew,
            missed=missed,
            rows=rows,
            real=real,
            prefix=prefix,
        )

    names = list(LIBRARY) if every else [str(name)]
    made = [controller(mechanism_named(n, setting, limit)) for n in names]
    starts = (
        [parse_start(one.mechanism, start) for one in made] if start or rigs or bit_flips else []
    )
    begun = bool(control == "one-time" or rigs or bit_flips or platforms)
    words = "with --control one-time, --rigs, --bit-flips or --for fmi"
    needs(begun, "where nothing moves", words, "start")
    written = {file: content for one in made for file, content in files(one).items()}
    for one in made if platforms else ():
        x0 = parse_start(one.mechanism, start) if start else None
        written |= carriers(one, platforms or (), compiler, x0)
    good = True
    for one in made if check else ():
        with tempfile.TemporaryDirectory(prefix="undertow-") as place:
            passed, said = Build(one, Path(place), compiler).self_test()
        good &= passed
        show(said)
    for one, x0 in zip(made, starts, strict=True) if rigs else ():
        with progress_bar() as progress:
            held = held_on_rigs(one, x0, rigs, compiler, progress)
        good &= held == rigs
        show(
            f"{one.mechanism.name}: held on {held} of {rigs} realistic rigs, seeds 0 to "
            f"{rigs - 1}, from {', '.join(start or ()) or 'its usual start'}, as a process over "
            "a pipe, positions alone measured."
        )
    for one, x0 in zip(made, starts, strict=True) if bit_flips else ():
        with progress_bar() as progress:
            upsets = flip_bits(one, x0, compiler, progress)
        for one_kind in upsets:
            show(upsets_table(one_kind), str(one_kind))
            good &= not sum(one_kind.beyond.values())
    if report:
        with progress_bar() as progress:
            entries = measure(made, states=states, compiler=compiler, progress=progress)
        good &= all(entry.passed for entry in entries)
        written["report.csv"] = csv(entries)
        show(*tables(entries), *map(Text, notes(made[0].real, states, compiler)))
    show(*write(out, lambda: written))
    exit_unless(good)


def _check_request(
    name: str | None, out: Path | None, *, every: bool, wanted: bool, carried: bool
) -> None:
    """Refuse options of ``export c`` that leave open what is to be done, or with what."""
    if every == (name is not None):
        raise InvalidInputError(
            "mechanism to export",
            value="a name and --all" if every else "neither a name nor --all",
            limit="one of them",
            remedy="Write for instance: undertow export c rotary_pendulum --out firmware",
        )
    if out is None and not wanted:
        raise InvalidInputError(
            "what to do with the C",
            value="none of --out, --check, --rigs, --bit-flips, --report",
            limit="one of them at least",
            remedy="Write for instance --out firmware",
        )
    if carried and out is None:
        raise InvalidInputError(
            "what to do with --for",
            value="no --out",
            limit="a folder for what is written",
            remedy="Write for instance --out units",
        )


def _first_optimum(
    belief: Mechanism, objective: str, law: ReachingLaw, start: list[str] | None, seed: int
) -> Surface:
    """Return the surface that is best from the start, and say what it costs."""
    from undertow.studies.motion import proposal_report

    goal, x0 = objective_named(objective, belief, 60.0), parse_start(belief, start)
    loop = ClosedLoop(belief, goal, reaching=law)
    with progress_bar() as progress:
        progress("searching for the best surface", 0.0)
        proposal = Optimiser(loop, seed=seed).require(x0)
    show(proposal_report(belief, goal, x0, proposal, loop.reaching))
    assert proposal.surface is not None  # require() raises otherwise
    return proposal.surface


def _estimator(
    belief: Mechanism, velocity: str, time_constant: float | None, acceleration: float | None
) -> EstimatorStep:
    """Return where velocities come from, by its name; a setting of another one is refused."""
    one_of("--velocity", velocity, STEPS)
    settings = {"derivative": time_constant, "super-twisting": acceleration}
    for other, value in settings.items():
        if value is not None and other != velocity:
            raise InvalidInputError(
                f"setting of --velocity {other}",
                value=f"{value:g}, with --velocity {velocity}",
                limit=f"with --velocity {other}",
                remedy="Leave one of them out",
            )
    if velocity == "kalman":
        encoders = bench_for(belief).encoders
        counts = [encoders[c.name].resolution for c in belief.coordinates]
        return KalmanStep(tuple(count / math.sqrt(12) for count in counts))
    setting = settings.get(velocity)
    return STEPS[velocity]() if setting is None else STEPS[velocity](setting)


@command(
    "undertow export log run.db --mcap run.mcap",
    "undertow export log run.db --parquet run.parquet",
    name="log",
    of=export,
)
def export_log(log: Path, mcap: Path | None = None, parquet: Path | None = None) -> None:
    """Write the log of a run for other programs, with units: every step, answer and event.

    Parameters
    ----------
    log : LOG
        Log of a run.
    mcap : FILE
        MCAP file, for PlotJuggler and Foxglove.
    parquet : FILE
        Parquet file, for pandas and the like.
    """
    from undertow.runtime import read_log, to_mcap, to_parquet

    wanted = [(to_mcap, mcap), (to_parquet, parquet)]
    if mcap is None and parquet is None:
        raise InvalidInputError(
            "what to write of the log",
            value="neither --mcap nor --parquet",
            limit="one of them at least",
            remedy="Write for instance --mcap run.mcap",
        )
    recording = read_log(log)
    for write_to, path in wanted:
        if path is not None:
            made = write_to(recording, path)
            size = made.stat().st_size / 1e6
            show(f"Written to {made}: {len(recording.steps):,} steps, {size:.3g} MB")
