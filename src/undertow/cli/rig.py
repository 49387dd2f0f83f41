"""A controller on a rig: run it against the clock, replay its log, drill its faults."""

from __future__ import annotations

import math
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, cast

import typer

from undertow.base import InvalidInputError
from undertow.base import artefacts as results
from undertow.cascade import problem_words
from undertow.cli import parsing as inputs
from undertow.cli.terminal import (
    AnyName,
    Goal,
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
from undertow.mechanisms.named import from_anywhere
from undertow.models.importers.python_file import in_a_file
from undertow.objective import Goal as OneGoal

if TYPE_CHECKING:
    from undertow.plants import Rig
    from undertow.runtime import Recipe, Report, Runtime

__all__ = ["drill", "replay", "run"]


@app.command(
    epilog=examples(
        "undertow run rotary_pendulum --seconds 60 --lead 0.02",
        "undertow run rotary_pendulum --rig realistic --start phi=30deg --log bench.db",
        "undertow run cart_pendulum --simulated --seconds 10 --log run.db",
        "undertow run rotary_pendulum --rig realistic --swing-up --seconds 20",
        "undertow run rotary_pendulum --rig examples/serial_rig.py:emulated",
    )
)
@reports_errors
def run(
    name: AnyName,
    start: Start = None,
    seconds: Annotated[float, typer.Option(help="Length of the run, s.", min=0.001)] = 10.0,
    rig: Annotated[
        str,
        typer.Option(
            help="ideal: the model. realistic: a bench with all its flaws. mujoco: another engine. "
            "FILE.xml: MJCF of your own. FILE.py:NAME: a driver of your own, a class or a function "
            "that makes one.",
            metavar="RIG",
        ),
    ] = "ideal",
    objective: Goal = "bench-energy",
    swing_up: Annotated[
        bool, typer.Option("--swing-up", help="Begin hanging at rest: swing up, catch, balance.")
    ] = False,
    setting: Settings = None,
    period: Annotated[float, typer.Option(help="Period of the fast loop, s.")] = 0.001,
    lead: Annotated[
        float,
        typer.Option(
            help="Least time from a request to the use of its answer, s; grows where answers "
            "come late. A short one keeps the optimiser busy."
        ),
    ] = 0.1,
    worker: Annotated[
        Literal["process", "thread"], typer.Option(help="Where the optimiser runs.")
    ] = "process",
    shadow: Annotated[
        bool, typer.Option(help="Make every step again before the next: warm caches, a check.")
    ] = True,
    keeper: Annotated[
        bool | None,
        typer.Option(
            "--keeper/--no-keeper",
            help="Hold the rig in a process of its own, which brings the output to zero when this "
            "one hangs or dies. Default: for FILE.py:NAME, where the system can fork.",
        ),
    ] = None,
    simulated: Annotated[
        bool, typer.Option("--simulated", help="In simulated time: as fast as it goes.")
    ] = False,
    log: Annotated[
        Path | None, typer.Option(help="File for the log, an SQLite database.", metavar="FILE")
    ] = None,
    seed: Seed = 0,
) -> None:
    """Run the two-rate controller on a rig, against the clock, and time every step.

    Ends with a verdict, and its exit code:
    0 balanced: held to the end, settled and at home.
    3 caught: held, but not settled or not at home.
    4 lost: thrown out, past its travel, or never caught.
    5 stopped: by a fault, or by the operator before the time.
    6 degraded: held, but with deadlines missed, rows of the log lost,
    reads or writes failed, or unsound answers.
    7: the device did not take an output of zero at the end.
    1 and 2: no run, for the reason that is printed.
    """
    from undertow.runtime import Recipe
    from undertow.runtime import Settings as Patience
    from undertow.runtime.processes import check_resources
    from undertow.runtime.session import session
    from undertow.runtime.tables import run_table

    belief = inputs.mechanism_named(name, setting or ())
    recipe = Recipe(
        mechanism=from_anywhere(name),  # a log of it can be replayed from anywhere
        parameters=inputs.parse_values(setting or ()),
        start=()
        if swing_up and not start
        else tuple(inputs.parse_start(belief, start or ()).tolist()),
        swing_up=swing_up,
        objective=cast(OneGoal, objective),  # the recipe refuses what is none
        rig="realistic" if rig == "realistic" or in_a_file(rig) else "ideal",
        seed=seed,
        period=period,
        seconds=float("inf") if simulated else max(0.01, 0.3 * lead),
        settings=Patience(lead=lead),
    )
    console = terminal()
    if keeper is None:
        keeper = in_a_file(rig) and not simulated and hasattr(os, "fork")
    if keeper and simulated:
        raise InvalidInputError(
            "--keeper with --simulated",
            value="simulated time",
            limit="the wall clock, by which a keeper goes",
            remedy="Leave one of them out",
        )
    forked = 0 if simulated else 3 * (worker == "process") + keeper
    check_resources(processes=forked, log=log is not None)  # before a driver is opened
    plant = _plant(rig, recipe, keeper=keeper)
    with ExitStack() as stack, _let_go_of(plant) as kept:
        with progress_bar() as progress:
            ready = session(
                recipe,
                rig=plant,
                log=log,
                simulated=simulated,
                processes=3 if worker == "process" else 0,
                shadow=shadow,
                progress=progress,
            )
            runtime = stack.enter_context(ready)
        if in_a_file(rig) and sys.stdin.isatty():
            say(console, f"Ready. Hold {name} at its start, press Enter and let go.")
            if not sys.stdin.readline():  # the end of the input is no yes
                runtime.stop()
        stack.enter_context(_seconds_on_terminal(seconds))
        kept.clear()  # the run closes it
        report = _run(runtime, seconds)
    what = "simulated time" if simulated else f"optimiser in another {worker}"
    what += ", the rig in a keeper" if keeper else ""
    where = f"the {rig} rig" if rig in ("ideal", "realistic", "mujoco") else rig
    console.print(f"{name} on {where}, {1 / period:g} Hz, {what}", markup=False)
    say(console, problem_words(belief, recipe.cascade.objective, recipe.cascade.gate))
    unit = ", ".join(sorted({i.unit for i in belief.inputs}))
    console.print(run_table(report, period, unit, simulated=simulated))
    if (book := runtime.log) is not None:
        lost = f", {book.dropped:,} rows lost" if book.dropped else ""
        say(console, f"Log {log}: {book.failure or 'written'}{lost}")
    verdict = report.verdict  # with the log closed
    say(console, f"Verdict: {verdict}.")
    if verdict.exit_code:
        raise typer.Exit(verdict.exit_code)


def _run(runtime: Runtime, seconds: float) -> Report:
    """Run, and report also of a run that a driver left with a way out of the interpreter.

    Its exit code is the verdict's: 0, which ``sys.exit()`` in a driver would give, is *balanced*.
    """
    try:
        return runtime.run(seconds)
    except Exception:
        raise
    except BaseException:  # it was stopped safely, and how is in its report
        return runtime.report


def _plant(rig: str, recipe: Recipe, *, keeper: bool) -> Rig | None:
    """Return the rig that was asked for, or nothing for what the recipe itself makes."""
    from undertow.plants import MuJoCoRig, rig_from_file

    if rig in ("ideal", "realistic"):
        return _kept(recipe.make_rig, recipe) if keeper else None
    if in_a_file(rig):
        plant = rig_from_file(rig, recipe.belief)
        if not math.isclose(plant.period, recipe.period, rel_tol=1e-9):
            plant.close()
            raise InvalidInputError(
                f"period of '{rig}'",
                value=f"{plant.period:g} s",
                limit=f"that of the fast loop, {recipe.period:g} s",
                remedy=f"Write --period {plant.period:g}",
            )
        if not keeper:
            return plant
        plant.close()  # it is one; now the keeper makes it, whose process it stays in
        return _kept(lambda: rig_from_file(rig, recipe.belief), recipe)
    if rig == "mujoco" or rig.endswith(".xml"):
        scene = None if rig == "mujoco" else Path(rig)

        def engine() -> Rig:
            return MuJoCoRig(recipe.belief, recipe.x0, scene=scene, period=recipe.period)

        return _kept(engine, recipe) if keeper else engine()
    raise InvalidInputError(
        "rig",
        value=repr(rig),
        limit="ideal, realistic, mujoco, FILE.xml or FILE.py:NAME",
        remedy="A driver of your own: see examples/serial_rig.py",
    )


def _kept(make: Callable[[], Rig], recipe: Recipe) -> Rig:
    """Return a rig that a process of its own holds."""
    from undertow.runtime.keeper import SupervisedRig

    settings, belief = recipe.settings, recipe.belief
    limits, slew = settings.limits(belief), settings.slew(belief) * recipe.period
    return SupervisedRig(make, recipe.period, limits, slew)


@contextmanager
def _let_go_of(plant: Rig | None) -> Iterator[list[Rig]]:
    """Close a rig that no run has taken over: what fails before may have left it energised."""
    from undertow.runtime.processes import undisturbed

    kept = [] if plant is None else [plant]
    try:
        yield kept
    finally:
        for rig in kept:
            with undisturbed(), suppress(Exception):  # a driver may do anything
                rig.close()


@contextmanager
def _seconds_on_terminal(seconds: float) -> Iterator[None]:
    """Count the seconds on a terminal; a progress bar would cost the fast loop time."""
    from undertow.runtime.processes import Background

    over, began = threading.Event(), time.monotonic()

    def count() -> None:
        while not over.wait(1.0):
            sys.stderr.write(f"\r… running, {time.monotonic() - began:.0f} of {seconds:g} s ")

    if sys.stderr.isatty():
        Background(count, "undertow seconds")
    try:
        yield
    finally:
        over.set()
        if sys.stderr.isatty():
            sys.stderr.write("\r\033[K")


@app.command(
    epilog=examples(
        "undertow replay run.db",
        "undertow replay run.db --out figures",
        "undertow replay run.db --mechanism my_arm.py:arm",
    )
)
@reports_errors
def replay(
    log: Annotated[Path, typer.Argument(help="Log of a run.", metavar="FILE")],
    mechanism: Annotated[
        str | None,
        typer.Option(
            help="A mechanism of your own, FILE.py:NAME, whose run it is. The file that a log "
            "names is not run by itself.",
            metavar="MECHANISM",
        ),
    ] = None,
    decisions: Annotated[
        bool, typer.Option(help="Also let the gate judge the recorded answers again.")
    ] = True,
    out: Annotated[
        Path | None, typer.Option(help="Folder for motion.png, latency.png, chatter.png.")
    ] = None,
) -> None:
    """Replay a log through the same build: the same outputs, bit for bit, or say where not."""
    from undertow import runtime
    from undertow.runtime import figures
    from undertow.runtime.tables import replay_table

    if out is not None:
        results.check_folder(out)
    with progress_bar() as progress:
        progress("replaying", 0.0)
        result = runtime.replay(log, mechanism=mechanism, decisions=decisions)
    console = terminal()
    console.print(replay_table(result))
    if out is not None:
        pictures = {
            "motion.png": figures.motion_figure(result.recording),
            "latency.png": figures.latency_figure(result.recording),
            "chatter.png": figures.chatter_figure(result.recording),
        }
        say(console, write(out, pictures))
    if not result.identical or result.gap is not None:
        raise typer.Exit(1)


@app.command(
    epilog=examples(
        "undertow drill",
        "undertow drill --no-live --seed 3",
        "undertow drill --kills 50 --seed 1",
        "undertow drill --systematic",
        "undertow drill --only write:17:always:ideal",
    )
)
@reports_errors
def drill(
    live: Annotated[
        bool, typer.Option(help="Also the faults that need real time and processes.")
    ] = True,
    kills: Annotated[
        int | None,
        typer.Option(help="Instead: kill -9 so many runs at random moments, and replay.", min=1),
    ] = None,
    systematic: Annotated[
        bool,
        typer.Option(
            "--systematic",
            help="Instead: the n-th call of every kind fails, once and from then on, for every n.",
        ),
    ] = False,
    only: Annotated[
        list[str] | None,
        typer.Option(
            help="Instead: these systematic faults alone. Repeatable.",
            metavar="OPERATION:N:once|always:RIG",
        ),
    ] = None,
    seed: Seed = 0,
) -> None:
    """Put faults into runs on the realistic rig, one at a time, and say what happened."""
    from undertow.runtime import tables
    from undertow.runtime.drill import drill as simulated_drill
    from undertow.runtime.drill_live import kill_drill, live_drill

    console = terminal()
    if systematic or only:
        _systematic(only or (), seed)
        return
    if kills is not None:
        with progress_bar() as progress:
            killed = kill_drill(kills, seed=seed, progress=progress)
        console.print(tables.kill_table(killed))
        sound = sum(one.passed for one in killed if not one.stopped_by)
        say(
            console,
            f"{sound} of {kills} kills of running controllers as they should be, seed {seed}",
        )
        if sound < kills or not all(one.passed for one in killed):
            raise typer.Exit(1)
        return
    with progress_bar() as progress:
        outcomes = simulated_drill(seed=seed, progress=progress)
        lived = live_drill(progress) if live else ()
    console.print(tables.drill_table(outcomes, lived))
    passed = [*(o.passed for o in outcomes), *(o.passed for o in lived)]
    say(console, f"{sum(passed)} of {len(passed)} as they should be, seed {seed}")
    if not all(passed):
        raise typer.Exit(1)


def _systematic(only: Sequence[str], seed: int) -> None:
    """Run systematic faults, all of them or those that are named."""
    from undertow.runtime import tables
    from undertow.runtime.failing import Fault, intercepts_sqlite
    from undertow.runtime.systematic import Systematic

    faults = [Fault.parse(text) for text in only]
    console = terminal()
    with progress_bar() as progress:
        progress("a run without a fault", 0.0)
        cases = Systematic(seed).drill(faults or None, progress)
    console.print(tables.systematic_table(cases))
    if not intercepts_sqlite():
        say(console, "The library of SQLite is out of reach: its own calls were left alone")
    if faults:
        for case in cases:
            say(console, f"{case.fault}: {case.happened}, after {case.steps:,} steps")
    passed = sum(case.passed for case in cases)
    say(console, f"{passed:,} of {len(cases):,} cases as they should be, seed {seed}")
    if passed < len(cases):
        raise typer.Exit(1)
