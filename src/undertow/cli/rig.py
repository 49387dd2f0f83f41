"""A controller on a rig: run it against the clock, replay its log, drill its faults."""

from __future__ import annotations

import math
import os
import shlex
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Literal, cast

import typer
from rich.console import RenderableType

from undertow.base import between, printable
from undertow.cascade import problem_words
from undertow.cli import options
from undertow.cli.parsing import (
    aimed,
    mechanism_named,
    parse_encoders,
    parse_limits,
    parse_new_target,
    parse_start,
    parse_target,
    parse_travels,
    parse_values,
)
from undertow.cli.show import open_page
from undertow.cli.terminal import (
    check_out,
    command,
    enter_pressed,
    exit_unless,
    needs,
    progress_bar,
    show,
    write,
)
from undertow.law import Reference, SetPoints
from undertow.mechanisms.named import from_anywhere
from undertow.models.importers.python_file import in_a_file
from undertow.objective import USUAL, Goal

if TYPE_CHECKING:
    from undertow.models import Coordinate
    from undertow.runtime import Report, RunTarget, Runtime
    from undertow.studies.live import Window


@command(
    "undertow run rotary_pendulum --seconds 60 --lead 0.02",
    "undertow run rotary_pendulum --rig realistic --start phi=30deg --log bench.db",
    "undertow run rotary_pendulum --rig realistic --limit voltage=5 --travel theta=90deg",
    "undertow run rotary_pendulum --rig realistic --encoder phi=0.36deg --delay 0.002",
    "undertow run cart_pendulum --simulated --seconds 10 --log run.db",
    "undertow run overhead_crane --target x=0.5m --target x=-0.5m@8s --seconds 16",
    "undertow run rotary_pendulum --target theta=20deg@0.25Hz --seconds 20",
    "undertow run rotary_pendulum --rig realistic --swing-up --seconds 20",
    "undertow run rotary_pendulum --seconds 600 --log run.db --show",
    "undertow run rotary_pendulum --rig examples/serial_rig.py:emulated",
)
def run(
    name: options.AnyName,
    start: options.Start = None,
    target: options.Target = None,
    seconds: Annotated[float, typer.Option(min=0.001)] = 10.0,
    rig: str = "ideal",
    objective: options.Goal = USUAL,
    swing_up: bool = False,
    setting: options.Settings = None,
    limit: options.Limits = None,
    travel: list[str] | None = None,
    known: Annotated[Literal["usual", "exact"], typer.Option("--belief")] = "usual",
    period: float = 0.001,
    delay: float | None = None,
    encoder: list[str] | None = None,
    lead: float = 0.1,
    worker: Literal["process", "thread"] = "process",
    lockstep: bool = True,
    supervisor: bool | None = None,
    simulated: bool = False,
    log: Path | None = None,
    watch: Annotated[bool, typer.Option("--show")] = False,
    seed: options.Seed = 0,
) -> None:
    """Run the two-rate controller on a rig, against the clock, and time every step.

    Ends with a verdict, and its exit code:
    0 balanced: held to the end, settled at the target.
    3 caught: held, but not settled or not at the target.
    4 lost: thrown out, past its travel, or never caught.
    5 stopped: by a fault, or by the operator before the time.
    6 degraded: held, but with deadlines missed, rows of the log lost,
    reads or writes failed, or unsound answers.
    7: the device did not take an output of zero at the end.
    1 and 2: no run, for the reason that is printed.

    Parameters
    ----------
    seconds
        Length of the run, s.
    rig : RIG
        ideal: the model. realistic: a bench with friction, delay and encoders. mujoco: the physics
        engine, on the mechanism's own MJCF file if it has one. FILE.xml: your own MJCF.
        FILE.py:NAME: your own driver, a class or a function that returns one. All but ideal get the
        controller of a usual bench, which reckons with its encoders, delay and friction.
    swing_up
        Begin hanging at rest: swing up, catch, balance.
    travel : COORDINATE=VALUE
        Travel of the rig to both sides of 0, with units: theta=60deg, x=0.3m. The run is stopped
        there, and plans keep to 95 % of it. Repeatable. Default: the mechanism's.
    known
        What the controller takes for known. usual: parameters within their tolerances, learnt as it
        runs. exact: the model.
    period
        Period of the fast loop, s.
    delay
        From a write to its effect in a reading, s, as undertow bench measures it; of any rig but
        ideal. Default: that of a usual bench, 1 ms; of the SRV02 1.5 ms.
    encoder : COORDINATE=VALUE
        One count of a position sensor, with units: phi=0.18deg is 2000 counts a turn, x=0.0001m; of
        any rig but ideal. Repeatable. Default: those of a usual bench, 4096 counts a turn or 20 µm.
    lead
        Shortest time from a request to the optimiser until its answer is applied, s; it is
        increased when answers arrive late. A short one keeps the optimiser busy.
    worker
        Where the optimiser runs.
    lockstep
        Compute every step a second time and compare: this keeps caches warm.
    supervisor
        Drive the rig from a separate process, which sets the output to zero when this one hangs or
        dies. Default: for FILE.py:NAME, where the system can fork.
    simulated
        Run in simulated time, as fast as possible.
    log : FILE
        File for the log, an SQLite database.
    watch
        Show the run on a live page while it goes on: from a process of its own, which reads the log
        and reaches nothing else.
    """
    from undertow.runtime import Recipe, Settings, session
    from undertow.runtime.processes import check_resources
    from undertow.runtime.session import closed_on_failure, rig_named
    from undertow.studies.rigs.runs import run_table

    name, target = aimed(name, target)
    belief = mechanism_named(name, setting)
    limits = parse_limits(belief, limit)
    for channel, most in zip(belief.inputs, limits, strict=True):
        what = f"limit of input '{channel.name}'"
        between(what, most, 0.0, channel.limit, channel.unit, "A rig gets no more than its own")
    settings = Settings(
        lead_time=lead,
        output_limit=limits if limit else math.inf,
        max_travel=parse_travels(belief, travel) if travel else math.inf,
    )
    hanging = swing_up and not start
    goal = parse_target(belief, target)
    if isinstance(goal, SetPoints):
        goal.check_within(seconds)
    recipe = Recipe(
        mechanism=from_anywhere(name),  # a log of it can be replayed from anywhere
        parameters=parse_values(setting),
        start=() if hanging else tuple(parse_start(belief, start).tolist()),
        swing_up=swing_up,
        target=goal.pairs if isinstance(goal, SetPoints) else goal or (),
        duration=max(1.0, seconds) if isinstance(goal, Reference) else 60.0,
        objective=cast(Goal, objective),  # the recipe refuses what is none
        learns=known == "usual",
        rig="ideal" if rig == "ideal" else "realistic",
        seed=seed,
        period=period,
        delay=delay,
        encoders=parse_encoders(belief, encoder),
        seconds=float("inf") if simulated else max(0.01, 0.3 * lead),
        settings=settings,
    )
    if supervisor is None:
        supervisor = in_a_file(rig) and not simulated and hasattr(os, "fork")
    clock = "without it: it is for a run against the clock"
    needs(not simulated, "with --simulated", clock, "worker", "lockstep", "supervisor")
    needs(
        not simulated, "with --simulated", "without it: a person looks by the clock", "watch",
        remedy="Write --log run.db instead, and then undertow show run.db",
    )  # fmt: skip
    processes = 3 if worker == "process" else 0
    forked = 0 if simulated else processes + supervisor + watch
    check_resources(processes=forked, log=log is not None)  # before a driver is opened
    with _watched(name, log) if watch else nullcontext((log, None)) as (book, window):
        plant = rig_named(rig, recipe, supervised=supervisor)
        with ExitStack() as stack, closed_on_failure(plant) as kept:
            with progress_bar() as progress:
                ready = session(
                    recipe,
                    rig=plant,
                    log=book,
                    simulated=simulated,
                    processes=processes,
                    lockstep=lockstep,
                    progress=progress,
                )
                runtime = stack.enter_context(ready)
                if window is not None and book is not None:
                    progress("opening the page", 1.0)
                    address = window.open(book)
            if book is not None and not simulated:
                free = [c for c in belief.coordinates if c.name in runtime.target.units]
                _say_where_to_ask(book, runtime.deaf, free)
            hold = f"Ready. Hold {name} at its start, press Enter and let go."
            if window is not None:
                open_page(f"The run of {name}", address, "It shows the run; it cannot reach it")
                hold = hold if in_a_file(rig) else "Ready. Press Enter to begin."
            if (in_a_file(rig) or window is not None) and not enter_pressed(hold):
                runtime.stop()
            stack.enter_context(_seconds_on_terminal(seconds))
            kept.clear()  # the run closes it
            report = _run(runtime, seconds)
        what = "simulated time" if simulated else f"optimiser in another {worker}"
        what += ", the rig in a supervisor" if supervisor else ""
        where = f"the {rig} rig" if rig in ("ideal", "realistic", "mujoco") else rig
        units = [i.unit for i in belief.inputs]
        show(
            f"{name} on {where}, {1 / period:g} Hz, {what}",
            problem_words(belief, recipe.cascade.objective, recipe.cascade.gate),
            run_table(report, period, units, simulated=simulated),
        )
        if (written := runtime.log) is not None:
            lost = f", {written.dropped:,} rows lost" if written.dropped else ""
            kept_as = f"Log {log}" if log else "Log of the page, not kept (--log run.db keeps it)"
            show(f"{kept_as}: {written.failure or 'written'}{lost}")
            if written.earlier is not None:
                show(f"Earlier log moved to {written.earlier}")
        verdict = report.verdict  # with the log closed
        show(f"Verdict: {verdict}.")
        if verdict.ending == "lost" and in_a_file(rig):
            values = [word for value in setting or () for word in ("--set", value)]
            words = shlex.join(["undertow", "bench", name, "--rig", rig, *values])
            show(f"If it never held: {words} checks signs, scales and delay, from rest.")
    exit_unless(not verdict.exit_code, verdict.exit_code)


@contextmanager
def _watched(name: str, log: Path | None) -> Iterator[tuple[Path | None, Window | None]]:
    """Begin a page for a run, which reads its log: where none is to be kept, one that is not."""
    from undertow.studies.live import Window

    with ExitStack() as stack:
        if log is None:
            log = Path(stack.enter_context(TemporaryDirectory(prefix="undertow-"))) / "run.db"
        yield log, stack.enter_context(Window(name if in_a_file(name) else None))


def _run(runtime: Runtime, seconds: float) -> Report:
    """Run, and return the report even where a driver calls ``sys.exit()`` or the like.

    The exit code is then still the verdict's, where 0 means *balanced*.
    """
    try:
        return runtime.run(seconds)
    except Exception:
        raise
    except BaseException:  # it was stopped safely, and how is in its report
        return runtime.report


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


def _say_where_to_ask(log: Path, deaf: str, free: Sequence[Coordinate]) -> None:
    """Say how a run is steered from another terminal while it goes on."""
    if deaf:
        show(f"Other targets are not taken while it runs: {deaf}", stderr=True)
    elif free:
        units = {"rad": "10deg", "m": "0.1m"}
        words = " ".join(f"{c.name}={units.get(c.unit, '1')}" for c in free)
        show(f"Another target while it runs: undertow target {shlex.quote(str(log))} {words}",
             stderr=True)  # fmt: skip


@command(
    "undertow target run.db theta=45deg",
    "undertow target run.db x=0.5m x=-0.5m@8s",
    "undertow target run.db",
)
def target(log: Path, points: Annotated[list[str] | None, typer.Argument()] = None) -> None:
    """Give a run in progress another target.

    The run, started with --log in another terminal of this machine, checks
    the target first. One where it cannot rest, or past its travel, is refused
    with the reason, and nothing changes. The target jumps once the optimiser
    has a plan for it, usually after a second.

    Parameters
    ----------
    log : LOG
        Log of a run in progress.
    points : STATE=VALUE[@TIME]
        Set-points, with units: x=1m, or x=-1m@8s for 8 s from now. They take the place of those
        that are not reached yet; coordinates that are not named stay where the target is. Without
        any: say where the target is.
    """
    from undertow.runtime import send_target, target_of_run

    found = target_of_run(log)
    if points:
        found = send_target(log, parse_new_target(found.units, points))
    show(f"{found.mechanism}, {found.t:.1f} s: the target is {_places(found, found.now)}")
    for begin, place in found.ahead:
        when = "at once" if begin <= found.t else f"from {begin:.1f} s on"
        show(f"asked for, {when}: {_places(found, place)}")
    if not points and found.said:
        show(f"last said of it: {printable(found.said)}")


def _places(run: RunTarget, q: Mapping[str, float]) -> str:
    """Return positions in words, angles in degrees."""
    words = []
    for name, value in q.items():
        degrees = run.units.get(name) == "rad"
        shown = f"{math.degrees(value):.4g}°" if degrees else f"{value:.4g} m"
        words.append(f"{name} = {shown}")
    return ", ".join(words) or "x = 0"


@command(
    "undertow replay run.db",
    "undertow replay run.db --out figures",
    "undertow replay run.db --mechanism my_arm.py:arm",
)
def replay(
    log: Path, mechanism: str | None = None, decisions: bool = True, out: Path | None = None
) -> None:
    """Replay a log with the same build, and compare the outputs bit for bit.

    Parameters
    ----------
    log : FILE
        Log of a run.
    mechanism : MECHANISM
        Your own mechanism that the log is about, FILE.py:NAME. The file that a log names is never
        run by itself.
    decisions
        Also judge the recorded answers by the gate again.
    out
        Folder for motion.png, latency.png, chatter.png.
    """
    from undertow import runtime
    from undertow.studies.rigs import runs

    check_out(out)
    with progress_bar() as progress:
        progress("replaying", 0.0)
        result = runtime.replay(log, mechanism=mechanism, decisions=decisions)

    def pictures() -> dict[str, bytes]:
        from undertow.studies.rigs.figures import pictures  # takes time, which no table is worth

        return pictures(result.recording)

    table = runs.replay_table(result)
    show(table, *write(out, pictures, table))
    exit_unless(result.identical and result.gap is None)


@command(
    "undertow drill",
    "undertow drill --no-live --seed 3",
    "undertow drill --kills 50 --seed 1",
    "undertow drill --systematic",
    "undertow drill --only write:17:always:ideal",
)
def drill(
    live: bool = True,
    kills: Annotated[int | None, typer.Option(min=1)] = None,
    systematic: bool = False,
    only: list[str] | None = None,
    seed: options.Seed = 0,
) -> None:
    """Inject faults into runs on the realistic rig, one at a time, and report what happened.

    Parameters
    ----------
    live
        Also inject the faults that need real time and processes.
    kills
        Instead: kill this many runs at random moments (kill -9), and replay their logs.
    systematic
        Instead: let the n-th call of every kind fail, once or from then on, for every n.
    only : OPERATION:N:once|always:RIG
        Instead: inject these systematic faults only. Repeatable.
    """
    from undertow.studies import fault_injection

    other = systematic or bool(only)
    needs(not other, "with --systematic or --only", "one of them", "kills")
    drills = "for the drill of single faults: those others are live or not by themselves"
    needs(kills is None and not other, "with another drill", drills, "live")
    if systematic or only:
        _systematic(only or (), seed)
        return
    table: RenderableType
    with progress_bar() as progress:
        if kills is not None:
            killed = fault_injection.kill_drill(kills, seed=seed, progress=progress)
            table, good = fault_injection.kill_table(killed), all(one.passed for one in killed)
            sound = sum(one.passed for one in killed if not one.stopped_by)
            said = f"{sound} of {kills} kills of running controllers as they should be"
            good &= sound == kills
        else:
            outcomes = fault_injection.drill(seed=seed, progress=progress)
            lived = fault_injection.live_drill(progress) if live else ()
            table = fault_injection.drill_table(outcomes, lived)
            passed = [*(o.passed for o in outcomes), *(o.passed for o in lived)]
            said, good = f"{sum(passed)} of {len(passed)} as they should be", all(passed)
    show(table, f"{said}, seed {seed}")
    exit_unless(good)


def _systematic(only: Sequence[str], seed: int) -> None:
    """Run systematic faults, all of them or those that are named."""
    from undertow.studies import fault_injection

    faults = [fault_injection.Fault.parse(text) for text in only]
    with progress_bar() as progress:
        progress("a run without a fault", 0.0)
        cases = fault_injection.Systematic(seed).drill(faults or None, progress)
    show(fault_injection.systematic_table(cases))
    if not fault_injection.intercepts_sqlite():
        show("SQLite's own calls could not be intercepted here: no faults were put into them")
    if faults:
        show(*(f"{case.fault}: {case.happened}, after {case.steps:,} steps" for case in cases))
    passed = sum(case.passed for case in cases)
    show(f"{passed:,} of {len(cases):,} cases as they should be, seed {seed}")
    exit_unless(passed == len(cases))
