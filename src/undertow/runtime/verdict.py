"""What came of a run; how it ended, in one word with its reasons; and its exit code."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from undertow.models import FloatArray
from undertow.runtime.clock import Histogram
from undertow.runtime.log import Log
from undertow.runtime.modes import Mode, Reason

__all__ = ["EXIT_CODES", "Ending", "Report", "RunVerdict"]

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

#: Shortest time for which a run must have been settled at its end, s; and how many times as far
#: from home one may be that is on its way there.
SETTLED, ON_ITS_WAY = 0.1, 4.0


@dataclass(eq=False)
class Report:
    """What came of a run.

    Attributes
    ----------
    steps, missed
        Steps made, and steps that ended after their period: output, what follows it, log.
    asleep
        Missed steps that took less than a period, but were woken too late.
    skipped
        Periods in which no step was made, because an earlier one took too long.
    think, whole, late, rest
        Time of the fast step's own computation between reading and writing; from when the
        step was due to when its output was written; to when it began; and what follows the
        output: answers judged, requests made, rows of the log copied.
    shadowed, disagreed
        Steps that the shadow made again, and those in which its output was another.
    mode, stopped_by
        State at the end, and why the run stopped, if it did.
    entered
        How often each state was entered.
    answers
        Verdicts on the answers of the slow loop, in a few words each, with their numbers.
    events
        Everything that happened: (t, what, text).
    variation
        Total variation of the inputs, Σ|u_k − u_{k−1}|, (m,).
    last, settled_for
        State before the stop, and for how long it had been *balance* then, s.
    early
        Whether the operator stopped the run before its time.
    unread, unwritten, missing
        Reads and writes of the rig that failed; steps in which a reading was missing, or not
        believed.
    unsound
        Answers of the slow loop that were none, or refused as unsound: their numbers are not
        those of their plan, or the plan is not stable.
    unreached
        How often the slow loop could not be asked, or nobody was left to take over.
    off, output
        Whether the device took an output of zero at the end; what went wrong with that, or with
        closing it.
    error, cost, unit
        ‖x‖₂ of the last estimate, and ∫ Φ dt over the run, in the objective's unit.
    home, homing
        Of the settings: what a run that ends settled is measured by.
    system
        What the loop asked of the system, and what it got, in words.
    log
        Where everything went.
    """

    steps: int = 0
    missed: int = 0
    asleep: int = 0
    skipped: int = 0
    think: Histogram = field(default_factory=Histogram)
    whole: Histogram = field(default_factory=Histogram)
    late: Histogram = field(default_factory=Histogram)
    rest: Histogram = field(default_factory=Histogram)
    shadowed: int = 0
    disagreed: int = 0
    mode: Mode = Mode.IDLE
    stopped_by: str = ""
    entered: Counter[str] = field(default_factory=Counter)
    answers: Counter[str] = field(default_factory=Counter)
    events: list[tuple[float, str, str]] = field(default_factory=list)
    variation: FloatArray = field(default_factory=lambda: np.zeros(0))
    last: Mode = Mode.IDLE
    settled_for: float = 0.0
    early: bool = False
    unread: int = 0
    unwritten: int = 0
    missing: int = 0
    unsound: int = 0
    unreached: int = 0
    off: bool = True
    output: str = ""
    error: float = math.nan
    cost: float = 0.0
    unit: str = ""
    home: float = math.inf
    homing: float = 0.0
    system: tuple[str, ...] = ()
    log: Log | None = field(default=None, repr=False)

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

    Attributes
    ----------
    ending
        ``balanced``: the law held the mechanism to the end, settled and at home.  ``caught``:
        the law held it to the end, but it was not settled, or not at home.  ``degraded``: one of
        both, but something was wrong on the way.  ``lost``: thrown out, past its travel, or never
        caught.  ``stopped``: by the operator before its time, or by a fault.
    reasons
        Why, in words.
    error
        ‖x‖₂ of the last estimate, whole turns of free joints taken off.
    cost
        ∫ Φ dt of the estimates and outputs over the run, in the objective's unit.
    output
        What is not known to be off: empty when the device took an output of zero at the end,
        and could be closed.
    off
        Whether the device took an output of zero at the end.
    unit
        Of the cost.
    """

    ending: Ending
    reasons: tuple[str, ...]
    error: float
    cost: float
    output: str = ""
    off: bool = True
    unit: str = ""

    @property
    def exit_code(self) -> int:
        """The exit code of ``undertow run``: 0 for ``balanced`` alone."""
        return EXIT_CODES[self.ending if self.off else "output on"]

    def __str__(self) -> str:
        """Return the verdict in one line."""
        reasons = "; ".join(filter(None, (*self.reasons, self.output)))
        cost = f"{self.cost:.4g} {self.unit}".rstrip()
        numbers = f"‖x‖ = {self.error:.3g} at the end, cost {cost}"
        return f"{self.ending}{reasons and f', {reasons}'}; {numbers}"

    @classmethod
    def of(cls, report: Report) -> RunVerdict:
        """Judge a run by its report."""
        ending, reasons = _ending(report)
        if ending in ("balanced", "caught") and (wrong := _wrong(report)):
            ending, reasons = "degraded", [f"{ending}, but {wrong[0]}", *wrong[1:]]
        if not report.off and ending not in ("lost", "stopped"):
            ending = "stopped"
        numbers = report.error, report.cost
        return cls(ending, tuple(reasons), *numbers, report.output, report.off, report.unit)


def _ending(report: Report) -> tuple[Ending, list[str]]:
    """Return how the motion ended, before what went wrong on the way is looked at."""
    why, last = report.stopped_by, report.last
    if why == Reason.THROWN_OUT.text or why.endswith("past its travel"):
        return "lost", [why]
    if why != Reason.STOP.text:
        return "stopped", [why]
    if last == Mode.SWING_UP:
        return "lost", ["not caught by the end"]
    if last not in (Mode.CATCH, Mode.BALANCE):
        return "stopped", [f"{why} before the law took over"]
    if report.early:
        return "stopped", [f"{why} before the end, {last.name.lower()}"]
    if last == Mode.CATCH or report.settled_for < SETTLED:
        return "caught", ["not settled at the end"]
    if report.error <= report.home:
        return "balanced", []
    if report.settled_for <= report.homing and report.error <= ON_ITS_WAY * report.home:
        return "balanced", [f"settled for {report.settled_for:.1f} s, on its way home"]
    return "caught", [f"settled for {report.settled_for:.1f} s, but not at home"]


def _wrong(report: Report) -> Sequence[str]:
    """Return what was wrong with a run that was held to its end."""
    steps = max(1, report.steps)
    missed = (report.missed + report.skipped) / (steps + report.skipped)
    lost = report.lost_rows
    facts = (
        (missed > MISSED, f"{missed:.0%} of the deadlines were missed"),
        (lost > 0, f"{lost:,} rows of the log were lost"),
        (report.log_failure != "", f"the log: {report.log_failure}"),
        (report.disagreed > 0, f"the shadow disagreed in {report.disagreed:,} steps"),
        (report.unsound > 0, f"{report.unsound:,} answers of the optimiser were unsound"),
        (report.unreached > 0, f"{report.unreached:,} times the optimiser could not be reached"),
        (report.unread > FAILED * steps, f"{report.unread:,} reads failed"),
        (report.unwritten > FAILED * steps, f"{report.unwritten:,} writes failed"),
        (
            report.missing > MISSING * steps,
            f"readings were missing in {report.missing / steps:.0%} of the steps",
        ),
        (report.output != "", "the rig was not closed"),
    )
    return [text for true, text in facts if true]
