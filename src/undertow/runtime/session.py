"""One run from its recipe: optimise, warm up, connect, run, close."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any, Self

from undertow.cascade import CascadeState
from undertow.plants.interface import Rig
from undertow.runtime.clock import SimulatedClock, WallClock
from undertow.runtime.log import Columns, Log, check_log
from undertow.runtime.loop import Runtime
from undertow.runtime.processes import (
    STOPPING,
    check_resources,
    held_back,
    refused_by_the_system,
)
from undertow.runtime.recipe import Recipe
from undertow.runtime.replay import about
from undertow.runtime.slow import (
    Compute,
    InlineWorker,
    Worker,
    background_worker,
)

__all__ = ["session", "warm_up"]


@contextlib.contextmanager
def session(
    recipe: Recipe,
    *,
    log: Path | None = None,
    simulated: bool = False,
    processes: int = 3,
    rig: Rig | None = None,
    shadow: bool = True,
    progress: Callable[[str, float], None] | None = None,
) -> Iterator[Runtime]:
    """Make a runtime ready from a recipe: first optimum, everything compiled and connected.

    Parameters
    ----------
    recipe
        What to run.
    log
        File for the log.
    simulated
        In simulated time, as fast as it goes; otherwise against the wall clock.
    processes
        For the optimiser, see :func:`undertow.runtime.background_worker`; 0: a thread.
    rig
        The plant; the recipe's simulated one by default.
    shadow
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
    with contextlib.ExitStack() as stack:
        operator = stack.enter_context(_Operator())  # until the log and all else is closed
        with operator.preparing(), refused_by_the_system("a session"):
            runtime = _prepared(recipe, stack, log, simulated, processes, rig, shadow, progress)
            operator.runtime = runtime
        yield runtime


def _prepared(
    recipe: Recipe,
    stack: contextlib.ExitStack,
    log: Path | None,
    simulated: bool,
    processes: int,
    rig: Rig | None,
    shadow: bool,
    progress: Callable[[str, float], None] | None,
) -> Runtime:
    """Make a runtime ready; what is to be closed goes on the stack."""

    def tell(what: str, fraction: float) -> None:
        if progress is not None:
            progress(what, fraction)

    check_resources(processes=0 if simulated else processes, log=log is not None)
    if log is not None:
        check_log(log)  # before the first optimum, which takes a while
    compute = recipe.respond
    tell("first optimum", 0.1)
    plant = recipe.make_rig() if rig is None else rig
    memory = recipe.first()
    tell("warming up", 0.6)
    warm_up(recipe, memory, compute)
    controller = recipe.make_controller(memory)
    meta, book = about(controller, recipe, simulated=simulated), None
    with held_back():  # what is opened is closed
        # First the processes are forked, then threads begin.
        worker: Worker = InlineWorker(compute)
        if not simulated:
            worker = background_worker(compute, processes=processes)
        stack.callback(worker.close)
        if log is not None:
            columns = Columns.of(recipe.belief)
            book = stack.enter_context(Log(log, columns, meta, threaded=not simulated))
    clock = SimulatedClock() if simulated else WallClock()
    double = recipe.make_controller(memory) if shadow and not simulated else None
    runtime = Runtime(controller, plant, worker, clock=clock, log=book, shadow=double)
    tell("ready", 1.0)
    return runtime


def warm_up(recipe: Recipe, memory: CascadeState, compute: Compute) -> None:
    """Make a short run in simulated time and throw it away, so that everything is compiled."""
    recipe.rehearse(memory)
    controller, lead = recipe.make_controller(memory), recipe.settings.lead
    worker = InlineWorker(compute, 0.5 * lead)
    runtime = Runtime(controller, recipe.make_rig(), worker, clock=SimulatedClock())
    runtime.run(min(recipe.settings.settle + 1.2 * lead, 1.0))


class _Operator:
    """Lets Ctrl-C, a polite kill and a lost terminal ask for a safe stop; and Ctrl-Z.

    A process that is suspended leaves its output on.  While a session is prepared it is given
    up; from then on, until everything is closed, the run is asked to stop, and nothing else is
    interrupted but a rig that has held its safe stop up for longer than that may take.
    """

    def __init__(self) -> None:
        self.runtime: Runtime | None = None
        self._asked, self._preparing = False, False
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            for number in STOPPING:
                if signal.getsignal(number) is not signal.SIG_IGN:  # `nohup` wants it so
                    self._before[number] = signal.signal(number, self._stop)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

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

    def _stop(self, _signal: int, _frame: FrameType | None) -> None:
        self._asked = True
        if self.runtime is not None:
            self.runtime.stop()
        if self._preparing or (self.runtime is not None and self.runtime.hangs):
            raise KeyboardInterrupt
