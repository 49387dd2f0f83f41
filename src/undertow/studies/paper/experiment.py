"""The paper's experiment, run: printed surfaces, our own optima, bounds, limits, repeats.

Every number of the report is computed here, in the run that prints it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import product
from math import degrees, pi
from typing import Any

from undertow.base import InfeasibleError, MissingExtraError, UndertowError
from undertow.cascade import Cascade, Run
from undertow.closed_loop import ClosedLoop, Event, Trajectory
from undertow.law import Surface, first_surface
from undertow.mechanisms import rotary_pendulum
from undertow.objective import state_box
from undertow.optimiser import Budget
from undertow.studies.ledger import Key
from undertow.studies.paper import appendix_report
from undertow.studies.paper.data import (
    CASES,
    CONDITIONS,
    OBJECTIVES,
    PERIOD,
    PRINTED,
    ROWS,
    Condition,
)  # fmt: skip
from undertow.studies.paper.limits import (
    Limit,
    Sensitivity,
    base_sensitivity,
    catch_limit,
    own_reach,
    singular_angle,
)  # fmt: skip
from undertow.studies.paper.repeats import Repeats, noisy_repeats

#: Dampings d_e for which reach is computed, N m s/rad.
DAMPINGS = sorted({condition.d_e for condition in CONDITIONS.values()})

#: Key of the appendix.
APPENDIX: Key = ("appendix", "", "")


@dataclass(frozen=True, eq=False)
class Motion:
    """A motion of the table: its total, or why there is none.

    ``condition``, ``objective``: where it begins, and what it costs. ``surfaces``: none where none
    was found. ``switch_times``: when each took over, s. ``total``: V² s or s; ``None`` when the
    terminal set is not reached, and ``reason`` says why, in words.
    """

    condition: str
    objective: str
    surfaces: tuple[Surface, ...]
    switch_times: tuple[float, ...]
    total: float | None
    reason: str = ""

    @classmethod
    def of(
        cls, condition: Condition, objective: str, surfaces: Sequence[Surface],
        switch_times: Sequence[float] = (0.0,), run: Trajectory | None = None,
    ) -> Motion:  # fmt: skip
        """Return the motion of surfaces, and what came of it, by default in a simulation."""
        motion = cls(condition.key, objective, tuple(surfaces), tuple(switch_times), None)
        run = motion.trajectory if run is None else run
        assert run is not None  # there are surfaces
        total = run.cost if run.event == Event.REACHED else None
        return replace(motion, total=total, reason=_ending(run))

    @cached_property
    def trajectory(self) -> Trajectory | None:
        """The motion, simulated; ``None`` where no surface was found."""
        if not self.surfaces:
            return None
        place = CONDITIONS[self.condition]
        loop = ClosedLoop(place.mechanism, OBJECTIVES[self.objective])
        return loop.simulate(place.start, self.surfaces, switch_times=self.switch_times)


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
    """What the optimisations may spend, and whether bounds and the appendix are computed."""

    cold: Budget = Budget(3072)
    warm: Budget = Budget(1024)
    bounds: bool = True
    appendix: bool = True
    conditions: tuple[str, ...] = tuple(CONDITIONS)

    @classmethod
    def quick(cls) -> Effort:
        """Return a tenth of the work: *matched* alone, short searches, no bounds, no appendix."""
        return cls(Budget(768), Budget(64), False, False, ("matched",))


#: All of it.
FULL = Effort()


@dataclass(frozen=True, eq=False)
class Reproduction:
    """Everything that one run found.

    ``own``: (condition, objective) to our optima. ``limits``: reach of the printed surfaces.
    ``reach``: d_e to the largest φ(0), rad, for which our search finds an admissible surface.
    ``repeats``: Figure 3. ``sensitivity``: of the base case, *matched*. ``appendix``: why there is
    none, empty where there is.
    """

    rows: tuple[Row, ...]
    own: dict[tuple[str, str], OwnOptimum]
    limits: tuple[Limit, ...]
    reach: dict[float, float]
    repeats: Repeats
    sensitivity: Sensitivity
    seed: int
    effort: Effort
    appendix: str

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


def printed_motion(condition: Condition, objective: str, row: str) -> Motion:
    """Simulate a printed column: its surfaces, one every 0.1 s, the last one kept."""
    printed = PRINTED[objective, row]
    return Motion.of(condition, objective, printed.surfaces, printed.switch_times)


def own_optimum(
    condition: Condition, objective: str, *, seed: int = 0, effort: Effort = FULL
) -> OwnOptimum:
    """Optimise: the designed first surface, the one-time optimum, the cascade.

    Our *base* is the surface that :func:`undertow.first_surface` designs, as the paper's
    base case is the feasible surface that its optimisation starts from.
    """
    rig = condition.mechanism
    motions = {"base": Motion.of(condition, objective, [first_surface(rig)])}
    cascade = Cascade(
        rig, OBJECTIVES[objective],
        period=PERIOD, cold=effort.cold, warm=effort.warm, seed=seed, belief="exact",
    )  # fmt: skip
    try:
        run = cascade.simulate(condition.start)
    except InfeasibleError as error:
        reason = f"no admissible surface: {error.value}"
        missing = Motion(condition.key, objective, (), (), None, reason)
        return OwnOptimum(motions | {"one-time": missing, "cascade": missing})
    motions["one-time"] = Motion.of(condition, objective, run.surfaces[:1])
    motions["cascade"] = Motion.of(condition, objective, *_schedule(run), run.trajectory)
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


def tasks(seed: int, effort: Effort) -> dict[Key, Callable[[], Any]]:
    """Return what is searched for: reach of surfaces, our optima, bounds, the appendix."""
    found: dict[Key, Callable[[], Any]] = {}
    for d in DAMPINGS:
        rig = rotary_pendulum(d_e=d)
        for case, surface in CASES.items():
            found["catch limit", case, f"{d:g}"] = partial(catch_limit, rig, surface)
        found["reach", "", f"{d:g}"] = partial(own_reach, rig, seed=seed, budget=Budget(512))
    for key, goal in product(effort.conditions, OBJECTIVES):
        place = CONDITIONS[key], goal
        found["cascade", key, goal] = partial(own_optimum, *place, seed=seed, effort=effort)
        if effort.bounds:
            found["bound", key, goal] = partial(lower_bound, *place)
    return found | ({APPENDIX: _appendix} if effort.appendix else {})


def _appendix() -> str:
    """Decide the appendix's claims, which are remembered; return why they cannot be."""
    try:
        appendix_report.markdown()
    except MissingExtraError as error:
        return f"Without the appendix. {error}"
    return ""


def gathered(seed: int, effort: Effort, found: Mapping[Key, Any]) -> Reproduction:
    """Return the results, and what is simulated in no time: printed surfaces, repeats."""
    places = list(product(effort.conditions, OBJECTIVES))
    own = {place: found["cascade", *place] for place in places}
    skipped = LowerBound(None, "not computed: --quick")
    rows = tuple(
        Row(
            *place,
            row,
            PRINTED[place[1], row].total,
            printed_motion(CONDITIONS[place[0]], place[1], row),
            own[place].motions[row],
            found.get(("bound", *place), skipped),
        )
        for place, row in product(places, ROWS)
    )
    limits = tuple(
        Limit(
            case,
            singular_angle(rotary_pendulum(), surface),
            {d: found["catch limit", case, f"{d:g}"] for d in DAMPINGS},
        )
        for case, surface in CASES.items()
    )
    return Reproduction(
        rows,
        own,
        limits,
        {d: found["reach", "", f"{d:g}"] for d in DAMPINGS},
        noisy_repeats(CONDITIONS["matched"], seed=seed),
        base_sensitivity(CONDITIONS["matched"]),
        seed,
        effort,
        found.get(APPENDIX, ""),
    )
