"""The drill: each fault of the list is put into a run in simulated time, and judged."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from undertow.base import Progress, each, no_progress
from undertow.cascade import CascadeState
from undertow.estimators import Estimator
from undertow.models import FloatArray
from undertow.plants import Measurement, Push, RealisticRig, Rig
from undertow.runtime import (
    Columns,
    Controller,
    Log,
    Mode,
    Reason,
    Recipe,
    Runtime,
    RunVerdict,
    SimulatedClock,
    about,
    read_log,
    replay_controller,
    respond,
)
from undertow.studies.fault_injection.cases import (
    CASES,
    Case,
    FaultyRig,
    FaultyWorker,
    OutputMonitor,
    corrupt_optimiser,
)

#: Unactuated coordinates within this at the end count as held, rad or m.
HELD = 0.2


@dataclass(frozen=True)
class CaseResult:
    """What happened in one run of the drill.

    It stopped for the reason ``stopped_by``, ``after`` s from the fault (NaN: it never came to a
    safe stop), and was ``held`` to the end of the run or not. ``output_faults`` are outputs that
    were not finite, past their limits or too fast; ``largest`` is the largest |u|/limit;
    ``ended_safely`` says whether the loop ended in a safe stop with the output at zero; ``answers``
    are verdicts on the optimiser's answers, in words. ``replayed``: the log's replay was identical,
    bit for bit; ``verdict``: how the run ended, with its exit code; ``note``: what else is worth
    knowing.
    """

    case: Case
    stopped_by: str
    after: float
    held: bool
    output_faults: tuple[str, ...]
    largest: float
    ended_safely: bool
    answers: str
    replayed: bool
    verdict: RunVerdict
    note: str = ""

    @property
    def happened(self) -> str:
        """What happened, in words."""
        if self.held:
            text = "held to the end"
        elif math.isnan(self.after):
            text = "not held, not stopped"
        else:
            text = f"safe stop after {1e3 * self.after:.0f} ms: {self.stopped_by}"
        answers = self.answers if self.case.part in ("optimiser", "answer") else ""
        return "; ".join(filter(None, (text, answers, *self.output_faults[:1], self.note)))

    @property
    def passed(self) -> bool:
        """Sound outputs, a safe end, an identical replay, and held where that is possible.

        And the verdict says how it ended, with an exit code that is 0 for what balanced alone.
        """
        sound = not self.output_faults and self.ended_safely and self.replayed
        stopped = not math.isnan(self.after)
        sound = sound and self.verdict.output_zero == self.case.off
        sound = sound and self.verdict.ending in self.case.endings
        sound = sound and (self.verdict.exit_code == 0) == (self.verdict.ending == "balanced")
        return sound and (self.held or (stopped and not self.case.holds))


class _FaultyEstimator(Estimator):
    """An estimator that goes wrong from some time on."""

    def __init__(
        self, honest: Estimator, corrupt: Callable[[FloatArray], FloatArray], since: float
    ):
        super().__init__(honest.mechanism, honest.period)
        self.honest, self.corrupt, self.since = honest, corrupt, since
        self.disturbance = honest.disturbance

    @property
    def jumps(self) -> int:
        return self.honest.jumps

    def reset(self, x0: ArrayLike) -> None:
        self.honest.reset(x0)

    def estimate(self, measurement: Measurement, u: FloatArray) -> FloatArray:
        x = self.honest.estimate(measurement, u)
        return self.corrupt(x) if measurement.t >= self.since else x


def drill_recipe(seed: int = 0) -> Recipe:
    """Return the run that the drill disturbs: the paper's bench from 15°, short searches."""
    return Recipe(
        start=(0.0, math.radians(15.0), 0.0, 0.0), rig="realistic", evaluations=96, seed=seed
    )


def run_case(
    case: Case,
    recipe: Recipe,
    memory: CascadeState,
    log: Path,
    *,
    since: float = 0.5,
    seconds: float = 3.0,
) -> CaseResult:
    """Run one fault in simulated time.

    The fault begins at ``since``, s; the run of ``recipe``, with its first optimum in ``memory``,
    takes ``seconds``, s, and is written to the file ``log``.
    """
    clock = SimulatedClock()
    since = since if case.since is None else case.since
    cascade = recipe.cascade
    if case.optimiser is not None:
        cascade = corrupt_optimiser(cascade, case.optimiser, since)

    worker = FaultyWorker(
        lambda request: respond(cascade, request, recipe.swing),
        (lambda answer: [(0.0, answer)]) if case.answers is None else case.answers(),
        since,
    )
    plant = _plant(recipe, case, since)
    rig: Rig = FaultyRig(
        plant,
        since,
        sense=None if case.sensor is None else case.sensor(),
        drive=None if case.actuator is None else case.actuator(),
        hang=case.hang,
        clock=clock,
        slow=case.slow,
    )

    def make_controller() -> Controller:
        controller = recipe.make_controller(memory)
        if case.estimator is not None:
            controller.estimator = _FaultyEstimator(controller.estimator, case.estimator, since)
        return controller

    controller = make_controller()
    monitor = OutputMonitor(rig, controller.limits, controller.slew)
    meta = about(controller, recipe, drill=f"{case.part}: {case.name}")
    with Log(
        log,
        Columns.of(recipe.belief),
        meta,
        threaded=False,
        max_bytes=60_000 if case.disk_full else None,
    ) as book:
        runtime = Runtime(controller, monitor, worker, clock=clock, log=book)
        if case.silent:
            worker.act = worker.waiting.clear
        if case.operator:
            worker.act = runtime.stop
        report = runtime.run(seconds).unless_interrupted()
    stopped = [t for t, what, text in report.events if what == "state" and "SAFE_STOP" in text]
    free = plant.truth[recipe.belief.m : recipe.belief.n]
    held = report.stopped_by == Reason.END.text
    answers = ", ".join(f"{n} {what}" for what, n in report.answers.most_common(2))
    return CaseResult(
        case,
        report.stopped_by,
        math.nan if held or not stopped else max(0.0, stopped[0] - since),
        held and bool((np.abs(free) <= HELD).all()),
        tuple(monitor.faults),
        monitor.largest,
        report.mode == Mode.SAFE_STOP and not monitor.last.any(),
        answers,
        not replay_controller(read_log(log), make_controller(), decisions=False).differing,
        report.verdict,
        f"log: {book.failure}" if book.failure else "",
    )


def _plant(recipe: Recipe, case: Case, since: float) -> RealisticRig:
    plant = recipe.make_rig()
    if not case.push:
        return plant
    bench = recipe.bench if recipe.rig == "realistic" else plant.bench
    last = recipe.belief.coordinates[-1].name
    pushed = replace(bench, pushes=(Push(since, last, case.push),))
    return RealisticRig(pushed, recipe.x0, recipe.seed)


def drill(
    cases: Sequence[Case] = CASES, *, seed: int = 0, progress: Progress = no_progress
) -> tuple[CaseResult, ...]:
    """Run all faults and judge them.

    The seed is the rig's and the optimiser's; ``progress`` is called with (what, fraction) before
    each.
    """
    recipe = drill_recipe(seed)
    memory = recipe.first()
    outcomes = []
    for case in each(cases, progress, lambda case: f"{case.part}: {case.name}"):
        with tempfile.TemporaryDirectory() as folder:
            outcomes.append(run_case(case, recipe, memory, Path(folder) / "log.db"))
    return tuple(outcomes)
