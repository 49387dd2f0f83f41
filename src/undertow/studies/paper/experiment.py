"""The paper's experiment, run: printed surfaces, our own optima, bounds, limits, repeats.

Every number of the report is computed here, in the run that prints it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import product
from math import degrees, pi

from undertow.base import InfeasibleError, MissingExtraError, Progress, UndertowError, no_progress
from undertow.cascade import Cascade, Run
from undertow.closed_loop import ClosedLoop, Event, Trajectory
from undertow.law import Surface, first_surface
from undertow.mechanisms import rotary_pendulum
from undertow.objective import state_box
from undertow.optimiser import Budget
from undertow.studies.paper.data import CONDITIONS, OBJECTIVES, PERIOD, PRINTED, ROWS, Condition
from undertow.studies.paper.limits import (
    Limit,
    Sensitivity,
    base_sensitivity,
    case_limits,
    own_reach,
)
from undertow.studies.paper.repeats import Repeats, noisy_repeats


@dataclass(frozen=True, eq=False)
class Motion:
    """A motion of the table: its total, or why there is none.

    ``switch_times``: when each surface took over, s. ``trajectory``: ``None`` where no surface was
    found. ``total``: V² s or s; ``None`` when the terminal set is not reached, and ``reason`` says
    why, in words.
    """

    surfaces: tuple[Surface, ...]
    switch_times: tuple[float, ...]
    trajectory: Trajectory | None
    total: float | None
    reason: str = ""


@dataclass(frozen=True, eq=False)
class OwnOptimum:
    """Our base, one-time and cascade motions of one condition and objective.

    ``slack`` is J̃_k − spent − J̃_{k+1} at each re-optimisation (Lemma 3; for minimum time
    t_{f,k} − Δt − t_{f,k+1}), (K,); ``predicted`` the first prediction J̃_0;
    ``accepted`` how many proposals the gate let through, the first included.
    """

    motions: dict[str, Motion]
    slack: tuple[float, ...] = ()
    predicted: float = 0.0
    accepted: int = 0


@dataclass(frozen=True)
class LowerBound:
    """The optimal-control lower bound, or why there is none."""

    value: float | None
    reason: str = ""


@dataclass(frozen=True, eq=False)
class Row:
    """One line of ``tables.csv``."""

    condition: str
    objective: str
    row: str
    paper: float
    printed: Motion
    ours: Motion
    bound: LowerBound

    @property
    def place(self) -> dict[str, str]:
        """What tells it from the other lines."""
        return {"condition": self.condition, "objective": self.objective, "row": self.row}

    @property
    def cells(self) -> dict[str, tuple[float | None, str]]:
        """Column to its figure, or to why there is none."""
        return {
            "paper": (self.paper, ""),
            "printed": (self.printed.total, self.printed.reason),
            "ours": (self.ours.total, self.ours.reason),
            "bound": (self.bound.value, self.bound.reason),
        }


@dataclass(frozen=True)
class Effort:
    """What the optimisations may spend, and whether bounds are computed."""

    cold: Budget = Budget(3072)
    warm: Budget = Budget(1024)
    bounds: bool = True
    conditions: tuple[str, ...] = tuple(CONDITIONS)

    @classmethod
    def quick(cls) -> Effort:
        """Return a tenth of the work: *matched* alone, short searches, no bounds."""
        return cls(Budget(768), Budget(64), bounds=False, conditions=("matched",))


@dataclass(frozen=True, eq=False)
class Reproduction:
    """Everything that one run found.

    ``own``: (condition, objective) to our optima. ``limits``: reach of the printed surfaces.
    ``reach``: d_e to the largest φ(0), rad, for which our search finds an admissible surface.
    ``repeats``: Figure 3. ``sensitivity``: of the base case, *matched*. ``seconds``: name of each
    part of the work to its duration, s.
    """

    rows: tuple[Row, ...]
    own: dict[tuple[str, str], OwnOptimum]
    limits: tuple[Limit, ...]
    reach: dict[float, float]
    repeats: Repeats
    sensitivity: Sensitivity
    seconds: dict[str, float]
    seed: int
    effort: Effort

    def row(self, condition: str, objective: str, row: str) -> Row:
        """Return one line of the tables."""
        return next(
            r for r in self.rows if (r.condition, r.objective, r.row) == (condition, objective, row)
        )


def _ending(trajectory: Trajectory) -> str:
    """Say in words why a motion did not reach the terminal set; empty if it did."""
    t = trajectory.time
    angle = degrees(trajectory["phi"][-1])
    return {
        Event.REACHED: "",
        Event.SINGULAR: f"meets the singularity (37) at {t:.2f} s, φ = {angle:.1f}°",
        Event.DIVERGED: f"diverges at {t:.2f} s",
        Event.HORIZON: f"has not reached ‖x‖ ≤ 0.01 after {t:.0f} s",
    }.get(trajectory.event, trajectory.event.name.lower())


def _motion(
    trajectory: Trajectory, surfaces: Sequence[Surface], switch_times: Sequence[float]
) -> Motion:
    reached = trajectory.event == Event.REACHED
    return Motion(
        tuple(surfaces),
        tuple(switch_times),
        trajectory,
        trajectory.cost if reached else None,
        _ending(trajectory),
    )


def printed_motion(condition: Condition, objective: str, row: str) -> Motion:
    """Simulate a printed column: its surfaces, one every 0.1 s, the last one kept."""
    printed = PRINTED[objective, row]
    loop = ClosedLoop(condition.mechanism, OBJECTIVES[objective])
    trajectory = loop.simulate(condition.start, printed.surfaces, switch_times=printed.switch_times)
    return _motion(trajectory, printed.surfaces, printed.switch_times)


def own_optimum(
    condition: Condition,
    objective: str,
    *,
    seed: int = 0,
    effort: Effort | None = None,
    progress: Callable[[float], None] = lambda _: None,
) -> OwnOptimum:
    """Optimise: the designed first surface, the one-time optimum, the cascade.

    Our *base* is the surface that :func:`undertow.first_surface` designs, as the paper's
    base case is the feasible surface that its optimisation starts from.
    """
    effort = Effort() if effort is None else effort
    rig, goal = condition.mechanism, OBJECTIVES[objective]
    loop = ClosedLoop(rig, goal)
    first = first_surface(rig)
    motions = {"base": _motion(loop.simulate(condition.start, first), [first], [0.0])}
    cascade = Cascade(
        rig, goal, period=PERIOD, cold=effort.cold, warm=effort.warm, seed=seed, belief="exact"
    )
    try:
        run = cascade.simulate(condition.start, progress=lambda t, end: progress(t / end))
    except InfeasibleError as error:
        missing = Motion((), (), None, None, f"no admissible surface: {error.value}")
        return OwnOptimum(motions | {"one-time": missing, "cascade": missing})
    once = run.surfaces[0]
    motions["one-time"] = _motion(loop.simulate(condition.start, once), [once], [0.0])
    motions["cascade"] = _motion(run.trajectory, *_schedule(run))
    return OwnOptimum(
        motions,
        tuple(float(v) for v in run.lemma3_slack),
        run.updates[0].predicted,
        sum(update.admission.accepted for update in run.updates),
    )


def _schedule(run: Run) -> tuple[list[Surface], list[float]]:
    """Return the surfaces of a run and their times, without repetitions."""
    surfaces, times = [run.updates[0].surface], [run.updates[0].t]
    for update in run.updates[1:]:
        if update.surface != surfaces[-1]:
            surfaces.append(update.surface)
            times.append(update.t)
    return surfaces, times


def lower_bound(condition: Condition, objective: str) -> LowerBound:
    """Return the optimal-control lower bound by collocation, where CasADi is there.

    The pendulum stays above the horizontal, as (37) makes every stable surface keep it.
    Letting it fall and swing through the bottom costs far less, and is another task.
    """
    from undertow.bounds import bound

    upright = replace(OBJECTIVES[objective], constraints=state_box(phi=pi / 2))
    try:
        found = bound(condition.mechanism, upright, condition.start)
    except MissingExtraError:
        return LowerBound(None, "not computed: pip install 'undertow[bounds]'")
    except UndertowError as error:
        return LowerBound(None, f"no optimal control found ({error.value})")
    return LowerBound(float(found.cost))


class _Clock:
    """Times the parts of the work and reports how much of it is done."""

    def __init__(self, progress: Progress, total: float) -> None:
        self.progress, self.total, self.done = progress, total, 0.0
        self.seconds: dict[str, float] = {}

    @contextmanager
    def part(self, name: str, weight: float) -> Iterator[Callable[[float], None]]:
        """Time a part of the given weight; yields a function that takes its fraction done."""

        def inner(fraction: float) -> None:
            self.progress(name, (self.done + weight * min(fraction, 1.0)) / self.total)

        inner(0.0)
        began = time.perf_counter()
        yield inner
        inner(1.0)
        self.done += weight
        self.seconds[name] = round(time.perf_counter() - began, 3)


def reproduce(
    *,
    seed: int = 0,
    effort: Effort | None = None,
    progress: Progress = no_progress,
) -> Reproduction:
    """Run the whole experiment.

    ``seed`` is that of the searches and of the noise; the effort is full by default,
    :meth:`Effort.quick` is for a look.
    """
    effort = Effort() if effort is None else effort
    tasks = list(product(effort.conditions, OBJECTIVES))
    clock = _Clock(progress, len(tasks) * (3 + 3 * effort.bounds) + 4)

    with clock.part("printed surfaces", 1):
        printed = {
            (key, goal, row): printed_motion(CONDITIONS[key], goal, row)
            for key, goal in tasks
            for row in ROWS
        }
        sensitivity = base_sensitivity(CONDITIONS["matched"])
        repeats = noisy_repeats(CONDITIONS["matched"], seed=seed)
    dampings = sorted({CONDITIONS[key].d_e for key in CONDITIONS})
    with clock.part("catch limits", 3):
        limits = case_limits(dampings)
        reach = {
            d: own_reach(rotary_pendulum(d_e=d), seed=seed, budget=Budget(512)) for d in dampings
        }
    own: dict[tuple[str, str], OwnOptimum] = {}
    bounds: dict[tuple[str, str], LowerBound] = {}
    for key, goal in tasks:
        title = f"{CONDITIONS[key].title}, {goal}"
        with clock.part(f"cascade ({title})", 3) as inner:
            own[key, goal] = own_optimum(
                CONDITIONS[key], goal, seed=seed, effort=effort, progress=inner
            )
        if effort.bounds:
            with clock.part(f"bound ({title})", 3):
                bounds[key, goal] = lower_bound(CONDITIONS[key], goal)
    skipped = LowerBound(None, "not computed: --quick")
    rows = tuple(
        Row(
            key,
            goal,
            row,
            PRINTED[goal, row].total,
            printed[key, goal, row],
            own[key, goal].motions[row],
            bounds.get((key, goal), skipped),
        )
        for key, goal in tasks
        for row in ROWS
    )
    return Reproduction(rows, own, limits, reach, repeats, sensitivity, clock.seconds, seed, effort)
