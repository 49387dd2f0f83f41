"""Every mechanism of the library brought to its target: cost, time, bound and gap in one table.

Nothing is chosen by hand: designed surface, optimisation and cascade are those of
``undertow simulate NAME``, from the mechanism's listed start.  The bound is a local optimum of
the same task over *all* inputs, see :mod:`undertow.bounds`; the gap is what the cascade spends
beyond it.  Where the gap is large, :data:`ABLATIONS` look for its cause: each removes one
restriction, and the table shows what is left of the gap without it.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import median

import numpy as np
from rich.console import RenderableType
from rich.table import Table
from rich.text import Text

from undertow.base import (
    InfeasibleError,
    Progress,
    finite,
    manifest,
    markdown_table,
    no_progress,
    number,
    table,
    to_csv,
)
from undertow.bounds import bound
from undertow.cascade import Cascade, Run, gate_words
from undertow.display.plot import state_words
from undertow.law import Plan, Surface
from undertow.mechanisms import LIBRARY
from undertow.mechanisms.named import named
from undertow.models import FloatArray, Mechanism, linearise
from undertow.objective import TRAVEL, Objective, objective_for
from undertow.optimiser import Budget, DecisionVariables

#: A gap beyond this asks for its cause.
LARGE = 0.10

#: Intervals of the bound's first mesh for each swing of the free motion.
PER_CYCLE = 12


@dataclass(frozen=True)
class Ablation:
    """One restriction taken away from the one-time optimum.

    Parameters
    ----------
    name
        What is different, in words.
    freedom
        What may be chosen.
    budget
        What the optimisation may spend.
    """

    name: str
    freedom: DecisionVariables
    budget: Budget


#: Tried in this order where the gap is large.
ABLATIONS = (
    Ablation("more evaluations (30 000)", DecisionVariables(), Budget(30_000)),
    Ablation("reaching law free (10 000)", DecisionVariables(reaching=True), Budget(10_000)),
    Ablation("both (40 000)", DecisionVariables(reaching=True), Budget(40_000)),
)


@dataclass(frozen=True)
class Entry:
    """One line of the survey.

    Attributes
    ----------
    name, n, m, start, unit
        The mechanism, its start in words, and the unit of cost.
    designed, one_time, cascade
        Cost of the designed surface, of the surface optimised once, and of the cascade;
        ``inf`` where the target was not reached.
    time
        When the cascade reached ‖x‖ ≤ ν, s; ``inf`` where it did not.
    radius
        ‖x‖ at the end of the cascade's motion.
    bound
        Optimal-control bound, NaN where none was asked for or found.
    seconds
        Wall time of all of it, s.
    trials
        Name of each trial made to its cost.
    problem, travel
        What was minimised and who admitted surfaces, and the bounds of travel, in words.
    """

    name: str
    n: int
    m: int
    start: str
    unit: str
    designed: float
    one_time: float
    cascade: float
    time: float
    radius: float
    bound: float
    seconds: float
    trials: Mapping[str, float]
    problem: str = ""
    travel: str = ""

    @property
    def gap(self) -> float:
        """What the cascade spends beyond the bound, relative; NaN without a bound."""
        return self.cascade / self.bound - 1.0

    def gap_of(self, cost: float) -> float:
        """Return the relative gap of another cost to the same bound."""
        return cost / self.bound - 1.0


def survey(
    names: Sequence[str] | None = None,
    *,
    goal: str = "energy",
    horizon: float = 60.0,
    seed: int = 0,
    bounds: bool = True,
    progress: Progress = no_progress,
    done: Callable[[Entry], None] | None = None,
) -> tuple[Entry, ...]:
    """Bring every mechanism from its listed start to its target.

    Parameters
    ----------
    names
        Which; all of the library by default.
    goal
        A word of :func:`undertow.objective_for`.
    horizon
        Longest motion, s.
    seed
        Seed of the optimisers.
    bounds
        Also the optimal-control bound (extra ``bounds``) and, where the gap is large, the
        trials.
    progress
        Called with what is being done and the part that is done.
    done
        Called with each line as it is finished: what an interrupted survey leaves.

    Raises
    ------
    InvalidInputError
        For an unknown mechanism or goal, or one without a usual start, before any work.
    MissingExtraError
        When bounds are asked for without CasADi.
    """
    chosen = [named(name) for name in (LIBRARY if names is None else names)]
    objectives = [objective_for(mechanism, goal, horizon=horizon) for mechanism in chosen]
    for mechanism, objective in zip(chosen, objectives, strict=True):
        objective.check_start(mechanism, mechanism.usual_start)
    entries = []
    for index, (mechanism, objective) in enumerate(zip(chosen, objectives, strict=True)):
        progress(mechanism.name, index / len(chosen))
        entries.append(survey_one(mechanism, objective, seed=seed, bounds=bounds))
        if done is not None:
            done(entries[-1])
    return tuple(entries)


def survey_one(
    mechanism: Mechanism, objective: Objective, *, seed: int = 0, bounds: bool = True
) -> Entry:
    """Bring one mechanism from its listed start to its target; the line of the survey."""
    began = time.perf_counter()
    x0 = mechanism.usual_start
    cascade = Cascade(mechanism, objective, seed=seed, belief="exact")
    loop = cascade.loop
    proposal = cascade.start(x0)[1]
    plan, first = proposal.plan, cascade.optimiser.anchor
    assert plan is not None  # start() raises otherwise
    assert first is not None  # designed when the optimiser was made
    candidates: list[Surface | Plan] = [first, plan]
    costs = loop.batch(x0, candidates)
    run = cascade.simulate(x0)
    limit = math.nan
    trials: dict[str, float] = {}
    if bounds:
        limit = _bound(mechanism, objective, x0, run)
        if run.cost / limit - 1.0 > LARGE:
            trials = _trials(mechanism, objective, x0, seed)
    bare = replace(objective, unit="", constraints=(), travel=False)
    reached = [
        float(cost) if ok else math.inf for cost, ok in zip(costs.cost, costs.reached, strict=True)
    ]
    return Entry(
        name=mechanism.name,
        n=mechanism.n,
        m=mechanism.m,
        start=state_words(mechanism, x0),
        unit=objective.unit,
        designed=reached[0],
        one_time=reached[1],
        cascade=run.cost if run.reached else math.inf,
        time=run.time if run.reached else math.inf,
        radius=float(math.hypot(*run.trajectory.x[-1])),
        bound=limit,
        seconds=time.perf_counter() - began,
        trials=trials,
        problem=f"{bare.meaning(mechanism)}; gate: {gate_words(cascade.gate)}",
        travel=", ".join(constraint.name for constraint in loop.objective.constraints),
    )


def _bound(mechanism: Mechanism, objective: Objective, x0: FloatArray, run: Run) -> float:
    """Return the bound, NaN where none was found; the cascade's own motion is one guess."""
    intervals = max(100, round(PER_CYCLE * _cycles(mechanism, objective.horizon)))
    try:
        found = bound(mechanism, objective, x0, intervals=intervals, guess=run.trajectory)
    except InfeasibleError:
        return math.nan
    return found.cost


def _cycles(mechanism: Mechanism, horizon: float) -> float:
    """How often the mechanism swings by itself, near the target, before it rests or time is up."""
    modes = np.linalg.eigvals(linearise(mechanism).A)
    swings = [
        p.imag / math.tau * min(horizon, 5.0 / max(abs(p.real), 1e-12)) for p in modes if p.imag > 0
    ]
    return float(sum(swings))


def _trials(
    mechanism: Mechanism, objective: Objective, x0: FloatArray, seed: int
) -> dict[str, float]:
    costs = {}
    for trial in ABLATIONS:
        cascade = Cascade(
            mechanism,
            objective,
            freedom=trial.freedom,
            cold=trial.budget,
            seed=seed,
            belief="exact",
        )
        proposal = cascade.optimiser.propose(x0)
        costs[trial.name] = math.inf
        if proposal.plan is not None:
            batch = cascade.loop.batch(x0, proposal.plan)
            costs[trial.name] = float(batch.cost[0]) if batch.reached[0] else math.inf
    return costs


def median_gap(entries: Sequence[Entry]) -> float:
    """Return the median of the gaps that are known; NaN where none is."""
    gaps = [entry.gap for entry in entries if math.isfinite(entry.bound)]
    return median(gaps) if gaps else math.nan


# -- what is shown and kept ----------------------------------------------------------------------

_HEAD = ("mechanism", "n, m", "start", "designed", "one-time", "cascade", "bound", "gap", "time")


def _cells(entry: Entry) -> tuple[str, ...]:
    costs = (entry.designed, entry.one_time, entry.cascade, entry.bound)
    designed, one_time, cascade, bound = (number(value, ".4g") for value in costs)
    return (
        entry.name,
        f"{entry.n}, {entry.m}",
        entry.start,
        designed,
        one_time,
        f"{cascade} {entry.unit}",
        bound,
        f"{100 * entry.gap:.1f} %" if math.isfinite(entry.gap) else "—",
        f"{entry.time:.2f} s" if math.isfinite(entry.time) else "not reached",
    )


def _trial_words(entry: Entry) -> str:
    words = [f"{name}: {100 * entry.gap_of(cost):.1f} %" for name, cost in entry.trials.items()]
    return f"{entry.name}, {100 * entry.gap:.1f} %: " + "; ".join(words)


def survey_table(entries: Sequence[Entry]) -> Table:
    """Return the survey for a terminal of 80 columns: start and unit stand on second lines."""
    heads = ("mechanism, start", *_HEAD[3:7], "gap, %", "time, s")
    rows: list[tuple[RenderableType, ...]] = []
    for entry in entries:
        name, _, start, designed, one_time, cascade, bound, gap, when = _cells(entry)
        cost, _, unit = cascade.partition(" ")
        rows.append(
            (
                Text(name).append(f"\n{start}", "dim"),
                *(designed, one_time, cost),
                Text(bound).append(f"\n{unit}", "dim"),
                *(cell.removesuffix(" %").removesuffix(" s") for cell in (gap, when)),
            )
        )
    made = table(heads, rows, whole=heads, padding=(0, 1, 0, 0))
    made.columns[0].no_wrap, made.columns[0].ratio = False, 1
    return made


def summary(entries: Sequence[Entry]) -> list[str]:
    """Return the sentences under the table: how many arrive, median gap, what larger gaps hold."""
    arrived = sum(math.isfinite(entry.time) for entry in entries)
    lines = [f"{arrived} of {len(entries)} reach the target."]
    if math.isfinite(median_gap(entries)):
        lines.append(f"Median gap of the cascade to the bound: {100 * median_gap(entries):.1f} %.")
    if any(entry.trials for entry in entries):
        lines.append("Gap of a one-time optimum where a restriction is taken away:")
        lines += [f"  {_trial_words(entry)}" for entry in entries if entry.trials]
    return lines + _problems(entries)


def _problems(entries: Sequence[Entry]) -> list[str]:
    """Return what was minimised, and within which travel."""
    lines = [f"objective {words}" for words in dict.fromkeys(e.problem for e in entries) if words]
    bounded = [f"{entry.name} {entry.travel}" for entry in entries if entry.travel]
    if bounded:
        part = f"{100 * TRAVEL:g} % of the travel that each declares"
        lines.append(f"Within {part}: {'; '.join(bounded)}.")
    return lines


def markdown(entries: Sequence[Entry]) -> str:
    """Return the survey as a Markdown table, as it stands in the documentation."""
    lines = markdown_table(_HEAD, map(_cells, entries), right=_HEAD[3:])
    return "\n".join(lines) + "\n\n" + "\n\n".join(summary(entries)) + "\n"


def files(request: Mapping[str, object], entries: Sequence[Entry]) -> dict[str, bytes]:
    """Return ``survey.csv``, ``survey.md`` and ``manifest.json``."""
    header = (
        "mechanism", "n", "m", "start", "unit", "designed", "one_time", "cascade", "bound",
        "gap", "time_s", "radius", "seconds", *(trial.name for trial in ABLATIONS),
    )  # fmt: skip
    rows = [
        (
            e.name, e.n, e.m, e.start, e.unit,
            *map(finite, (e.designed, e.one_time, e.cascade, e.bound, e.gap)),
            *map(finite, (e.time, e.radius)),
            round(e.seconds, 2),
            *(finite(e.trials.get(trial.name, math.nan)) for trial in ABLATIONS),
        )
        for e in entries
    ]  # fmt: skip
    made = manifest("undertow survey", request, median_gap=finite(median_gap(entries)))
    return {
        "survey.csv": to_csv(header, rows),
        "survey.md": markdown(entries).encode(),
        "manifest.json": made,
    }
