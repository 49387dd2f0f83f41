"""Every mechanism of the library brought to its target: cost, bound and gaps in one table.

Nothing is chosen by hand: designed surface, optimisation and cascade are those of ``undertow
simulate NAME --objective energy --belief exact``, from the mechanism's listed start; *free* is the
cascade that may choose the reaching law, too, and for least time a schedule of surfaces.  The bound
is a local optimum of the same task over *all* inputs, see :mod:`undertow.bounds`; a gap is what a
cascade spends beyond it.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from statistics import median

import numpy as np
from rich.console import RenderableType
from rich.table import Table
from rich.text import Text

from undertow.base import InfeasibleError, finite, manifest, markdown_table, number, table, to_csv
from undertow.bounds import bound
from undertow.cascade import Cascade, Run, gate_words
from undertow.closed_loop.figures import state_words
from undertow.law import Plan, Surface
from undertow.mechanisms import LIBRARY
from undertow.mechanisms.named import named
from undertow.models import FloatArray, Mechanism, linearise
from undertow.objective import TRAVEL, Constraint, Objective, objective_for
from undertow.optimiser import DecisionVariables
from undertow.studies.experiment import Experiment
from undertow.studies.ledger import Key

#: What is minimised where nothing else is asked for.
GOALS = ("energy", "time")

#: Intervals of the bound's first mesh for each swing of the free motion.
PER_CYCLE = 12


@dataclass(frozen=True)
class Entry:
    """One line of the survey.

    ``goal``: the word of what was minimised. ``designed``, ``one_time``, ``cascade``, ``free``:
    cost of the designed surface, of the surface optimised once, of the cascade, and of the cascade
    with free reaching laws, for least time in a schedule; ``inf`` where the target was not reached.
    ``time``: when the cascade reached ‖x‖ ≤ ν, s; ``inf`` where it did not. ``radius``: ‖x‖ at the
    end of the cascade's motion. ``bound``: optimal-control bound, NaN where none was asked for or
    found. ``seconds``: wall time of all of it, s. ``problem``, ``travel``: what was minimised and
    who admitted surfaces, and the bounds of travel, in words.
    """

    goal: str
    name: str
    n: int
    m: int
    start: str
    unit: str
    designed: float
    one_time: float
    cascade: float
    free: float
    time: float
    radius: float
    bound: float
    seconds: float
    problem: str = ""
    travel: str = ""

    @property
    def gap(self) -> float:
        """What the cascade spends beyond the bound, relative; NaN without a bound above 0."""
        return _gap(self.cascade, self.bound)

    @property
    def free_gap(self) -> float:
        """The same for the cascade with a free reaching law."""
        return _gap(self.free, self.bound)


def _gap(cost: float, bound: float) -> float:
    return cost / bound - 1.0 if bound > 0 else math.nan


def survey(
    names: Sequence[str] | None = None,
    *,
    goals: Sequence[str] = GOALS,
    horizon: float = 60.0,
    seed: int = 0,
    bounds: bool = True,
    request: Mapping[str, object] | None = None,
) -> Experiment[Entry, tuple[Entry, ...]]:
    """Return the experiment that brings every mechanism from its listed start to its target.

    All of the library by default, for each of the ``goals``, words of
    :func:`undertow.objective_for`, within ``horizon``, s; ``bounds`` also computes the
    optimal-control bound (extra ``bounds``). ``request`` is what the manifest says was asked for.
    Raises InvalidInputError for an unknown mechanism or goal, or one without a usual start, before
    any work.
    """
    given = {name: named(name) for name in (LIBRARY if names is None else names)}
    own = Counter(mechanism.name for mechanism in given.values())
    chosen = {m.name if own[m.name] == 1 else name: m for name, m in given.items()}
    tasks: dict[Key, Callable[[], Entry]] = {}
    for goal, (name, mechanism) in product(goals, chosen.items()):
        objective = objective_for(mechanism, goal, horizon=horizon)
        objective.check_start(mechanism, mechanism.usual_start)
        tasks[name, goal] = partial(
            survey_one, mechanism, objective, goal=goal, seed=seed, bounds=bounds, name=name
        )
    models = [mechanism.identity for mechanism in chosen.values()]
    settings = {"horizon": horizon, "seed": seed, "bounds": bounds, "models": models}
    return Experiment(
        "survey", tuple[str, str, Entry], tasks, settings, report,
        partial(files, request or settings),
    )  # fmt: skip


def survey_one(
    mechanism: Mechanism,
    objective: Objective,
    x0: FloatArray | None = None,
    *,
    goal: str = "",
    seed: int = 0,
    bounds: bool = True,
    within: Sequence[Constraint] = (),
    name: str = "",
) -> Entry:
    """Bring one mechanism from a start to its target; one line of the survey.

    From ``x0``, (2n,), the mechanism's listed start by default; ``goal`` is the objective's word,
    and ``name`` the mechanism's, if not its own, for the line. The motion of the bound keeps what
    is ``within`` besides the objective's own constraints: what every surface must keep anyway.
    Raises InvalidInputError for a state that the task does not allow; MissingExtraError when a
    bound is asked for without CasADi.
    """
    began = time.perf_counter()
    x0 = mechanism.initial_state(x0, {})
    cascade = Cascade(mechanism, objective, seed=seed, belief="exact")
    loop = cascade.loop
    loop.objective.check_start(mechanism, x0)
    run = _run(cascade, x0)
    free = replace(cascade, freedom=DecisionVariables(reaching=True, schedule=cascade.period))
    freed = _run(free, x0)
    candidates: list[Surface | Plan] = [cascade.optimiser.anchor]
    if run is not None:
        candidates.append(run.updates[0].plan)
    costs = loop.batch(x0, candidates, precise=True)
    reached = [
        float(cost) if ok else math.inf for cost, ok in zip(costs.cost, costs.reached, strict=True)
    ]
    arrived = run is not None and run.reached
    limit = math.nan
    if bounds:
        counted = cascade.optimiser.counts_time and run is not None
        longest = run.time if run is not None and counted else objective.horizon
        bounded = replace(objective, constraints=(*objective.constraints, *within))
        limit = _bound(mechanism, bounded, x0, [r for r in (run, freed) if r is not None], longest)
    bare = replace(objective, unit="", constraints=(), travel=False)
    return Entry(
        goal=goal,
        name=name or mechanism.name,
        n=mechanism.n,
        m=mechanism.m,
        start=state_words(mechanism, x0),
        unit=objective.unit,
        designed=reached[0],
        one_time=reached[1] if len(reached) > 1 else math.inf,
        cascade=_total(run),
        free=_total(freed),
        time=run.time if run is not None and arrived else math.inf,
        radius=math.nan if run is None else float(math.hypot(*run.trajectory.x[-1])),
        bound=limit,
        seconds=time.perf_counter() - began,
        problem=f"{bare.meaning(mechanism)}; gate: {gate_words(cascade.gate)}",
        travel=", ".join(constraint.name for constraint in loop.objective.constraints),
    )


def _run(cascade: Cascade, x0: FloatArray) -> Run | None:
    """Simulate a cascade; ``None`` where no surface is admissible from here."""
    try:
        return cascade.simulate(x0)
    except InfeasibleError:
        return None


def _total(run: Run | None) -> float:
    """Cost of a run that reached the target, else ``inf``."""
    return run.cost if run is not None and run.reached else math.inf


def _bound(
    mechanism: Mechanism, objective: Objective, x0: FloatArray, runs: Sequence[Run], longest: float
) -> float:
    """Return the bound, NaN where none was found; the cascades' own motions are guesses."""
    intervals = max(100, round(PER_CYCLE * _cycles(mechanism, longest)))
    guesses = [run.trajectory for run in runs]
    try:
        found = bound(mechanism, objective, x0, intervals=intervals, guess=guesses)
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


def median_gap(gaps: Iterable[float]) -> float:
    """Return the median of the gaps that are known, one that did not arrive infinite; or NaN."""
    known = [gap for gap in gaps if not math.isnan(gap)]
    return median(known) if known else math.nan


# -- what is shown and kept ----------------------------------------------------------------------

_HEAD = (
    "mechanism", "n, m", "start", "designed", "one-time", "cascade", "free", "bound", "gap",
    "gap, free", "time",
)  # fmt: skip


def _percent(gap: float) -> str:
    return f"{100 * gap:.1f} %" if math.isfinite(gap) else "—"


def _cells(entry: Entry) -> tuple[str, ...]:
    costs = (entry.designed, entry.one_time, entry.cascade, entry.free, entry.bound)
    designed, one_time, cascade, free, bound = (number(value, ".4g") for value in costs)
    return (
        entry.name,
        f"{entry.n}, {entry.m}",
        entry.start,
        designed,
        one_time,
        f"{cascade} {entry.unit}",
        free,
        bound,
        _percent(entry.gap),
        _percent(entry.free_gap),
        f"{entry.time:.2f} s" if math.isfinite(entry.time) else "not reached",
    )


def survey_table(entries: Sequence[Entry]) -> Table:
    """Return the survey for a terminal of 80 columns: start, gaps and unit on second lines."""
    heads = ("mechanism, start", *_HEAD[3:8], "time, s")
    rows: list[tuple[RenderableType, ...]] = []
    for entry in entries:
        name, _, start, designed, one_time, cascade, free, bound, gap, free_gap, when = _cells(
            entry
        )
        cost, _, unit = cascade.partition(" ")
        rows.append(
            (
                Text(name).append(f"\n{start}", "dim"),
                *(designed, one_time),
                Text(cost).append(f"\n{gap}"),
                Text(free).append(f"\n{free_gap}"),
                Text(bound).append(f"\n{unit}", "dim"),
                when.removesuffix(" s"),
            )
        )
    return table(heads, rows, whole=heads, ratios={heads[0]: 1}, padding=(0, 1, 0, 0))


def by_goal(entries: Sequence[Entry]) -> list[list[Entry]]:
    """Return the entries of each goal, in the order in which they were made."""
    return [
        [e for e in entries if e.goal == goal] for goal in dict.fromkeys(e.goal for e in entries)
    ]


def report(entries: Sequence[Entry]) -> list[RenderableType]:
    """Return for each goal its table and the sentences under it."""
    parts: list[RenderableType] = []
    for some in by_goal(entries):
        parts += ["", some[0].goal, survey_table(some), *summary(some)]
    return parts


def summary(entries: Sequence[Entry]) -> list[str]:
    """Return the sentences under the table of one goal: how many arrive, and the gaps."""
    arrived = sum(math.isfinite(entry.time) for entry in entries)
    lines = [f"{arrived} of {len(entries)} reach the target."]
    for words, gaps in (
        ("the cascade", [entry.gap for entry in entries]),
        ("the cascade with a free reaching law", [entry.free_gap for entry in entries]),
    ):
        middle = median_gap(gaps)
        if not math.isnan(middle):
            worst = max(gap for gap in gaps if not math.isnan(gap))
            said = (_percent(g) if math.isfinite(g) else "not reached" for g in (middle, worst))
            lines.append("Gap of {} to the bound: median {}, worst {}.".format(words, *said))
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
    """Return the survey as Markdown tables, one a goal, as they stand in the documentation."""
    parts = []
    for some in by_goal(entries):
        lines = markdown_table(_HEAD, map(_cells, some), right=_HEAD[3:])
        parts.append("\n".join(lines) + "\n\n" + "\n\n".join(summary(some)) + "\n")
    return "\n".join(parts)


def files(request: Mapping[str, object], entries: Sequence[Entry]) -> dict[str, bytes]:
    """Return ``survey.csv``, ``survey.md`` and ``manifest.json``."""
    header = (
        "objective", "mechanism", "n", "m", "start", "unit", "designed", "one_time", "cascade",
        "free", "bound", "gap", "free_gap", "time_s", "radius", "seconds",
    )  # fmt: skip
    rows = [
        (
            e.goal, e.name, e.n, e.m, e.start, e.unit,
            *map(finite, (e.designed, e.one_time, e.cascade, e.free, e.bound, e.gap, e.free_gap)),
            *map(finite, (e.time, e.radius)),
            round(e.seconds, 2),
        )
        for e in entries
    ]  # fmt: skip
    gaps = {some[0].goal: finite(median_gap(e.gap for e in some)) for some in by_goal(entries)}
    return {
        "survey.csv": to_csv(header, rows),
        "survey.md": markdown(entries).encode(),
        "manifest.json": manifest("undertow survey", request, median_gap=gaps),
    }
