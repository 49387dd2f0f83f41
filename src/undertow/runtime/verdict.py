"""What came of a run; how it ended, in one word with its reasons; and its exit code."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal, Self

import numpy as np

from undertow.models import FloatArray
from undertow.runtime.clock import Histogram
from undertow.runtime.log import Log
from undertow.runtime.modes import Mode, Reason

#: How a run may end.
Ending = Literal["balanced", "caught", "lost", "stopped", "degraded"]

#: Exit codes of ``undertow run``; 1 and 2 are those of all commands: it failed, or was asked for
#: what cannot be.  7 comes before the others: the device did not take an output of zero.
EXIT_CODES: dict[str, int] = {
    "balanced": 0, "caught": 3, "lost": 4, "stopped": 5, "degraded": 6, "output on": 7,
}  # fmt: skip

#: Share of missed and skipped periods, of failed reads or writes, and of steps with a reading
#: missing, of a whole run above which it counts as degraded.
MISSED, FAILED, MISSING = 0.05, 0.02, 0.2

#: Shortest time for which a run must have been settled at its end, s; and how many times the
#: target's radius away one may be that is converging.
SETTLED, CONVERGING = 0.1, 4.0


@dataclass(eq=False)
class Report:
    """What came of a run.

    Attributes
    ----------
    steps, missed_deadlines
        Steps made, and steps that ended after their period: output, what follows it, log.
    late_wakeups
        Missed steps that took less than a period, but were woken too late.
    skipped_periods
        Periods in which no step was made, because an earlier one took too long.
    computation_times, response_times, wakeup_delays, followup_times
        Time of the fast step's own computation between reading and writing; from when the
        step was due to when its output was written; to when it began; and what follows the
        output: answers judged, requests made, rows of the log copied.
    lockstep_steps, lockstep_mismatches
        Steps that the lockstep check made again, and those in which its output was another.
    mode, stopped_by
        State at the end, and why the run stopped, if it did.
    interrupted
        Whether a signal stopped it, as Ctrl-C does.
    entered
        How often each state was entered.
    answers
        Verdicts on the answers of the slow loop, in a few words each, with their numbers.
    events
        Everything that happened: (t, what, text).
    total_variation
        Total variation of the inputs, Σ|u_k − u_{k−1}|, (m,).
    mode_before_stop, settled_time
        State before the stop, and for how long it had been *balance* then, s.
    failed_reads, failed_writes, steps_with_missing_readings
        Reads and writes of the rig that failed; steps in which a reading was missing, or not
        accepted.
    invalid_answers
        Answers of the slow loop that were none, or refused as unsound: their numbers are not
        those of their plan, or the plan is not stable.
    optimiser_failures
        How often the slow loop could not be asked, or nobody was left to take over.
    output_zero, output_problem
        Whether the device took an output of zero at the end; what went wrong with that, or with
        closing it.
    final_error, cost, unit
        ‖x‖₂ of the last estimate, and ∫ Φ dt over the run, in the objective's unit.
    target_radius, convergence_time
        Of the settings: what a run that ends settled is measured by.
    system
        What the loop asked of the system, and what it got, in words.
    log
        Where everything went.
    """

    steps: int = 0
    missed_deadlines: int = 0
    late_wakeups: int = 0
    skipped_periods: int = 0
    computation_times: Histogram = field(default_factory=Histogram)
    response_times: Histogram = field(default_factory=Histogram)
    wakeup_delays: Histogram = field(default_factory=Histogram)
    followup_times: Histogram = field(default_factory=Histogram)
    lockstep_steps: int = 0
    lockstep_mismatches: int = 0
    mode: Mode = Mode.IDLE
    stopped_by: str = ""
    interrupted: bool = False
    entered: Counter[str] = field(default_factory=Counter)
    answers: Counter[str] = field(default_factory=Counter)
    events: list[tuple[float, str, str]] = field(default_factory=list)
    total_variation: FloatArray = field(default_factory=lambda: np.zeros(0))
    mode_before_stop: Mode = Mode.IDLE
    settled_time: float = 0.0
    failed_reads: int = 0
    failed_writes: int = 0
    steps_with_missing_readings: int = 0
    invalid_answers: int = 0
    optimiser_failures: int = 0
    output_zero: bool = True
    output_problem: str = ""
    final_error: float = math.nan
    cost: float = 0.0
    unit: str = ""
    target_radius: float = math.inf
    convergence_time: float = 0.0
    system: tuple[str, ...] = ()
    log: Log | None = field(default=None, repr=False)

    def __repr__(self) -> str:
        """Show how it ended and what it cost."""
        steps = f"{self.steps} steps, {self.missed_deadlines} missed"
        cost = f"cost {self.cost:.4g} {self.unit}".rstrip()
        return f"Report({self.verdict.ending}, {steps}, {cost})"

    def unless_interrupted(self) -> Self:
        """Return it; where a signal stopped the run, what the run is a part of ends, too.

        Raises
        ------
        KeyboardInterrupt
            Then: a run that was stopped is no result.
        """
        if self.interrupted:
            raise KeyboardInterrupt
        return self

    @property
    def lost_rows(self) -> int:
        """Rows of the log that were lost, also by its closing."""
        return 0 if self.log is None else self.log.dropped

    @property
    def log_failure(self) -> str:
        """Why the log could not be written to its end; empty where it could."""
        return "" if self.log is None else self.log.failure

    @property
    def verdict(self) -> RunVerdict:
        """How the run ended; ask again once the log is closed, which may lose rows."""
        return RunVerdict.of(self)


@dataclass(frozen=True)
class RunVerdict:
    """How a run ended.

    ``ending``: ``balanced``: the law held the mechanism to the end, settled at the target.
    ``caught``: the law held it to the end, but it was not settled, or not at the target.
    ``degraded``: one of both, but something was wrong on the way. ``lost``: thrown out, past its
    travel, or never caught. ``stopped``: by the operator before its time, or by a fault.

    ``final_error``: ‖x‖₂ of the last estimate, whole turns of free joints taken off; ``cost``: ∫ Φ
    dt of the estimates and outputs over the run, in the objective's unit. ``output_zero``: whether
    the device took an output of zero at the end; ``output_problem``: what is not known to be off,
    empty when it did and could be closed.
    """

    ending: Ending
    reasons: tuple[str, ...]
    final_error: float
    cost: float
    output_problem: str = ""
    output_zero: bool = True
    unit: str = ""

    @property
    def exit_code(self) -> int:
        """The exit code of ``undertow run``: 0 for ``balanced`` alone."""
        return EXIT_CODES[self.ending if self.output_zero else "output on"]

    def __str__(self) -> str:
        """Return the verdict in one line."""
        reasons = "; ".join(filter(None, (*self.reasons, self.output_problem)))
        cost = f"{self.cost:.4g} {self.unit}".rstrip()
        numbers = f"‖x‖ = {self.final_error:.3g} at the end, cost {cost}"
        return f"{self.ending}{reasons and f', {reasons}'}; {numbers}"

    @classmethod
    def of(cls, report: Report) -> RunVerdict:
        """Judge a run by its report."""
        ending, reasons = _ending(report)
        if ending in ("balanced", "caught") and (wrong := _wrong(report)):
            ending, reasons = "degraded", [f"{ending}, but {wrong[0]}", *wrong[1:]]
        if not report.output_zero and ending not in ("lost", "stopped"):
            ending = "stopped"
        numbers = report.final_error, report.cost
        return cls(
            ending, tuple(reasons), *numbers, report.output_problem, report.output_zero, report.unit
        )


def _ending(report: Report) -> tuple[Ending, list[str]]:
    """Return how the motion ended, before what went wrong on the way is looked at."""
    why, last = report.stopped_by, report.mode_before_stop
    if why.startswith(Reason.THROWN_OUT.text) or why.endswith("past its travel"):
        return "lost", [why]
    if why not in (Reason.STOP.text, Reason.END.text):
        return "stopped", [why]
    if last == Mode.SWING_UP:
        return "lost", ["not caught by the end"]
    if last not in (Mode.CATCH, Mode.BALANCE):
        return "stopped", [f"{why}, before the law took over"]
    if why == Reason.STOP.text:
        return "stopped", [f"{why} before the end, {last.name.lower()}"]
    if last == Mode.CATCH or report.settled_time < SETTLED:
        return "caught", ["not settled at the end"]
    if report.final_error <= report.target_radius:
        return "balanced", []
    if (
        report.settled_time <= report.convergence_time
        and report.final_error <= CONVERGING * report.target_radius
    ):
        return "balanced", [f"settled for {report.settled_time:.1f} s, converging to the target"]
    return "caught", [f"settled for {report.settled_time:.1f} s, but not at the target"]


def _wrong(report: Report) -> Sequence[str]:
    """Return what was wrong with a run that was held to its end."""
    steps = max(1, report.steps)
    missed = (report.missed_deadlines + report.skipped_periods) / (steps + report.skipped_periods)
    lost, incomplete = report.lost_rows, report.steps_with_missing_readings
    facts = (
        (missed > MISSED, f"{missed:.0%} of the deadlines were missed"),
        (lost > 0, f"{lost:,} rows of the log were lost"),
        (report.log_failure != "", f"the log: {report.log_failure}"),
        (
            report.lockstep_mismatches > 0,
            f"the lockstep check disagreed in {report.lockstep_mismatches:,} steps",
        ),
        (
            report.invalid_answers > 0,
            f"{report.invalid_answers:,} answers of the optimiser were unsound",
        ),
        (
            report.optimiser_failures > 0,
            f"{report.optimiser_failures:,} calls of the optimiser failed: it could not be reached",
        ),
        (report.failed_reads > FAILED * steps, f"{report.failed_reads:,} reads failed"),
        (report.failed_writes > FAILED * steps, f"{report.failed_writes:,} writes failed"),
        (
            incomplete > MISSING * steps,
            f"readings were missing in {incomplete / steps:.0%} of the steps",
        ),
        (report.output_problem != "", "the rig was not closed"),
    )
    return [text for true, text in facts if true]
