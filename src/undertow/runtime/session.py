"""One run from its recipe: optimise, warm up, connect, run, close."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType

from undertow.base import InvalidInputError, checked, positive
from undertow.cascade import Cascade, CascadeState
from undertow.estimators import MakeEstimator
from undertow.law import Reference, SetPoints, Target, target_of
from undertow.mechanisms.named import DataName, origin
from undertow.models import StateLike
from undertow.models.importers.formats import FORMATS, MJCF
from undertow.models.importers.python_file import in_a_file
from undertow.plants import IdealRig, MuJoCoRig, Rig, check_rig, rig_from_file
from undertow.plants.interface import driver_errors
from undertow.runtime.clock import SimulatedClock, WallClock
from undertow.runtime.encoding import Columns
from undertow.runtime.log import Log, check_log
from undertow.runtime.loop import Runtime
from undertow.runtime.processes import (
    check_resources,
    resource_errors,
    signals_deferred,
    signals_handled,
    signals_ignored,
)
from undertow.runtime.recipe import Recipe
from undertow.runtime.replay import about
from undertow.runtime.settings import Settings
from undertow.runtime.slow_loop import Answer, Request
from undertow.runtime.supervisor import SupervisedRig
from undertow.runtime.targets import Listener
from undertow.runtime.verdict import Report
from undertow.runtime.workers import InlineWorker, Worker, background_worker


def rig_named(word: str, recipe: Recipe, *, supervised: bool) -> Rig | None:
    """Return the rig that is asked for, or nothing for one that the recipe itself makes.

    The word is ``ideal``, ``realistic``, ``mujoco``, ``FILE.xml`` or ``FILE.py:NAME``; in MuJoCo a
    mechanism of an MJCF file moves as that file, one of the library as its own scene.
    ``supervised``: a process of its own holds the rig. Raises InvalidInputError for another word,
    and for a driver of another period than the fast loop's; ArtefactError for a driver that cannot
    be made, read and closed.
    """

    def held(make: Callable[[], Rig]) -> Rig:
        return SupervisedRig(make, recipe.period, *recipe.output_bounds)

    if word in ("ideal", "realistic"):
        return held(recipe.make_rig) if supervised else None
    if in_a_file(word):
        plant = rig_from_file(word, recipe.belief)
        with closed_on_failure(plant) as kept:
            if not math.isclose(plant.period, recipe.period, rel_tol=1e-9):
                raise InvalidInputError(
                    f"period of '{word}'",
                    value=f"{plant.period:g} s",
                    limit=f"that of the fast loop, {recipe.period:g} s",
                    remedy=f"Write --period {plant.period:g}",
                )
            kept.clear()
        if not supervised:
            return plant
        with driver_errors(
            f"close() of '{word}', before the run",
            "a rig that is let go of and opened again by the supervisor",
            "Mend it, or write --no-supervisor",
        ):
            plant.close()  # it can be made; now the process that will hold it makes it
        return held(lambda: rig_from_file(word, recipe.belief))
    if word == "mujoco" or _is_mjcf(Path(word)):
        data = DataName.of(recipe.mechanism) if isinstance(recipe.mechanism, str) else None
        own = data.file if data and _is_mjcf(data.file) else None
        scene = own if word == "mujoco" else Path(word)
        at = origin(recipe.mechanism) if scene and isinstance(recipe.mechanism, str) else {}

        def engine() -> Rig:
            return MuJoCoRig(recipe.belief, recipe.x0, scene=scene, target=at, period=recipe.period)

        return held(engine) if supervised else engine()
    raise InvalidInputError(
        "rig",
        value=repr(word),
        limit="ideal, realistic, mujoco, FILE.xml, FILE.mjcf or FILE.py:NAME",
        remedy="A driver of your own: see examples/serial_rig.py",
    )


def _is_mjcf(path: Path) -> bool:
    return FORMATS.get(path.suffix.lower()) is MJCF


@contextmanager
def closed_on_failure(plant: Rig | None) -> Iterator[list[Rig]]:
    """Close a rig that no run has taken over: what fails before may have left it energised.

    Who takes the rig over clears the list that is yielded.
    """
    kept = [] if plant is None else [plant]
    try:
        yield kept
    finally:
        for rig in kept:
            with signals_ignored(), suppress(Exception):  # a driver may do anything
                rig.close()


@contextlib.contextmanager
def session(
    recipe: Recipe,
    *,
    log: Path | None = None,
    simulated: bool = False,
    processes: int = 3,
    rig: Rig | None = None,
    lockstep: bool = True,
    progress: Callable[[str, float], None] | None = None,
) -> Iterator[Runtime]:
    """Make a runtime ready from a recipe: first optimum, everything compiled and connected.

    Parameters
    ----------
    recipe
        What to run.
    log
        File for the log.  A run with one, against the wall clock, takes targets from other
        processes, see :func:`undertow.runtime.send_target`.
    simulated
        In simulated time, as fast as it goes; otherwise against the wall clock.
    processes
        For the optimiser, see :func:`undertow.runtime.background_worker`; 0: a thread.
    rig
        The plant; the recipe's simulated one by default.
    lockstep
        Against the wall clock: make every step again, see :class:`undertow.runtime.Runtime`.
    progress
        Called with (what, fraction) before each part.

    Yields
    ------
    Runtime
        Ready to run; log and worker are closed in the end.

    Raises
    ------
    InfeasibleError
        When the first optimisation finds no admissible surface.
    ArtefactError
        When the log cannot be written.
    ResourceError
        When the system has not enough memory, threads, processes, descriptors or disk.
    KeyboardInterrupt
        When a stop is asked for, by whatever signal, before it is ready.
    """
    tell = progress or (lambda _what, _fraction: None)
    with contextlib.ExitStack() as stack:
        signals = _StopSignals()
        stack.enter_context(signals_handled(signals.stop))  # until the log and all else is closed
        with signals.preparing(), resource_errors("a session"):
            check_resources(processes=0 if simulated else processes, log=log is not None)
            if log is not None:
                check_log(log)  # before the first optimum, which takes a while
            swinging = "swing-up: where none is kept, a search of a minute or more"
            tell(swinging if recipe.swing_up else "first optimum", 0.1)
            plant = recipe.make_rig() if rig is None else rig
            memory = recipe.first()
            tell("warming up", 0.6)
            warm_up(recipe, memory, jumps=not simulated)
            controller = recipe.make_controller(memory)
            meta, book = about(controller, recipe, simulated=simulated), None
            with signals_deferred():  # what is opened is closed
                # First the processes are forked, then threads begin.
                worker: Worker[Request, Answer] = InlineWorker(recipe.respond)
                if not simulated:
                    moving = [] if recipe.reference is None else [recipe.reference]
                    worker = background_worker(recipe.respond, processes=processes, shared=moving)
                stack.callback(worker.close)
                if log is not None:
                    columns = Columns.of(recipe.belief)
                    book = stack.enter_context(Log(log, columns, meta, threaded=not simulated))
            clock = SimulatedClock() if simulated else WallClock()
            double = recipe.make_controller(memory) if lockstep and not simulated else None
            runtime = Runtime(controller, plant, worker, clock=clock, log=book, lockstep=double)
            if log is not None and not simulated:
                with signals_deferred():
                    listener = stack.enter_context(contextlib.closing(Listener(runtime, log)))
                runtime.deaf = listener.failure
            tell("ready", 1.0)
            signals.runtime = runtime
        yield runtime


@checked
def run(
    cascade: Cascade,
    rig: Rig | None = None,
    *,
    seconds: float = 20.0,
    x0: StateLike | None = None,
    log: str | Path | None = None,
    simulated: bool = False,
    processes: int = 3,
    settings: Settings | None = None,
    target: Mapping[str, float] | Target | None = None,
    estimator: MakeEstimator | None = None,
    delay: float | None = None,
    encoders: Mapping[str, float] | None = None,
    progress: Callable[[str, float], None] | None = None,
    **state: float,
) -> Report:
    """Run a cascade on a rig, against the clock, and return how it went.

    What the cascade leaves at its default for exact states is replaced by what suits a rig: its
    gate by :func:`undertow.runtime.controller_defaults.default_gate`, its covariance by the
    estimator's, its reaching law by one with a boundary layer as thick as the sensors need.  The
    estimator learns the parameters that the cascade's belief leaves open.

    Parameters
    ----------
    cascade
        The controller.
    rig
        The plant: anything with a ``period``, s, ``read()``, ``write(u)`` and ``close()``, see
        :class:`undertow.plants.Rig`.  By default a simulated one with friction, encoders and
        delay.  It is closed at the end.
    seconds
        Length of the run, s; then the output is brought to zero.  No plan is to arrive by then: on
        a rig each looks the whole horizon of the objective ahead, however long the run goes on,
        where :meth:`undertow.Cascade.simulate` and :func:`undertow.policy` count what is left.
    x0
        Where the mechanism is held at the start, (2n,), or its non-zero entries by name
        (``phi=0.7``).  With neither, the mechanism's usual ``start``.
    log
        File for the log, an SQLite database.  A run with one takes other targets while it goes on:
        :func:`undertow.runtime.send_target`.
    simulated
        In simulated time, as fast as it goes: for simulated rigs.
    processes
        For the optimiser; 0: a thread.
    settings
        Limits and timeouts of the run; by default ``Settings(lead_time=cascade.period)``: each plan
        is asked for one period ahead, and the next one when it is there, so once in every period.
    target
        Where to, x = 0 by default: coordinates to positions, or :class:`undertow.SetPoints` that
        jump at times since the start of the run, each as soon as there is a plan for it; or a
        :class:`undertow.Reference` to follow, whose time is that of the run.
    estimator
        Makes an :class:`undertow.estimators.Estimator` for the mechanism and the bench that the
        rig is taken for.  By default a Kalman filter, which learns; the log of a run with another
        one is replayed with it, ``replay("run.db", estimator=...)``.
    delay
        From a write to its effect in a reading, s, as :func:`undertow.bring_up.bring_up` measures
        it; by default that of :func:`undertow.plants.bench.bench_for`.
    encoders
        One count of a position sensor by coordinate, rad or m: ``{"phi": 2 * math.pi / 2000}``; by
        default that bench's, 4096 counts a turn or 20 µm.
    progress
        Called with (what, fraction) while the run is prepared.

    Returns
    -------
    Report
        ``report.verdict`` says in one word how it ended.

    Raises
    ------
    InfeasibleError
        When the first optimisation finds no admissible surface.
    InvalidInputError
        For a rig that is none, or has another period than its controller; for a target where the
        mechanism cannot rest or go, or that is due after the end of the run.
    ArtefactError
        When the rig cannot be read, or the log cannot be written.
    """
    mechanism, settings = cascade.mechanism, settings or Settings(lead_time=cascade.period)
    with closed_on_failure(rig) as kept:
        positive("length of a run, s", seconds, "Leave it out for 20 s")
        if rig is not None:
            check_rig(rig, mechanism)
        goal = None if target is None else target_of(target)
        if isinstance(goal, SetPoints):
            goal.check_within(seconds)
        recipe = Recipe(
            mechanism,
            start=tuple(mechanism.initial_state(x0, state).tolist()),
            objective=cascade.objective,
            rig="ideal" if isinstance(rig, IdealRig) else "realistic",
            seed=cascade.seed,
            delay=delay,
            encoders=encoders or {},
            period=0.001 if rig is None else rig.period,
            seconds=math.inf if simulated else max(0.01, 0.3 * settings.lead_time),
            target=goal.pairs if isinstance(goal, SetPoints) else goal or (),
            duration=max(1.0, seconds) if isinstance(goal, Reference) else 60.0,
            learns=cascade.belief != "exact",
            settings=settings,
            design=cascade,
            estimator=estimator,
        )
        prepared = session(
            recipe,
            log=None if log is None else Path(log),
            simulated=simulated,
            processes=processes,
            rig=rig,
            progress=progress,
        )
        with prepared as runtime:
            kept.clear()  # a run closes its rig
            return runtime.run(seconds)


def warm_up(recipe: Recipe, memory: CascadeState, *, jumps: bool = False) -> None:
    """Make a short run in simulated time and throw it away, so that everything is compiled."""
    recipe.precompile(memory, jumps=jumps)
    controller, lead = recipe.make_controller(memory), recipe.settings.lead_time
    worker = InlineWorker(recipe.respond, 0.5 * lead)
    runtime = Runtime(controller, recipe.make_rig(), worker, clock=SimulatedClock())
    runtime.run(min(recipe.settings.sensor_settling_time + 1.2 * lead, 1.0))


class _StopSignals:
    """Lets Ctrl-C, a polite kill and a lost terminal ask for a safe stop; and Ctrl-Z.

    A process that is suspended leaves its output on.  While a session is prepared it is given
    up; from then on, until everything is closed, the run is asked to stop, and nothing else is
    interrupted but a rig that has held its safe stop up for longer than that may take.
    """

    def __init__(self) -> None:
        self.runtime: Runtime | None = None
        self._asked, self._preparing = False, False

    @contextlib.contextmanager
    def preparing(self) -> Iterator[None]:
        """Give up what is being prepared when a stop is asked for."""
        self._preparing = True
        try:
            yield
        finally:
            self._preparing = False
        if self._asked:  # something that cannot be interrupted had kept it to itself
            raise KeyboardInterrupt

    def stop(self, _signal: int, _frame: FrameType | None) -> None:
        """Handle a signal that asks for a stop."""
        self._asked = True
        if self.runtime is not None:
            self.runtime.report.interrupted = True
            self.runtime.stop()
        if self._preparing or (self.runtime is not None and self.runtime.hangs):
            raise KeyboardInterrupt
