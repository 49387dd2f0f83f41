"""The league: stabilisation of underactuated mechanisms, controllers side by side, others' too."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any, ClassVar, get_args

import numpy as np
from rich.console import RenderableType

from undertow.base import (
    InvalidInputError,
    MissingExtraError,
    UndertowError,
    error_text,
    printable,
    raised_at,
)
from undertow.bounds import bound
from undertow.mechanisms.named import named
from undertow.models import FloatArray, Mechanism, linearise
from undertow.objective import Goal, Objective, objective_for
from undertow.objective.named import finite_limits
from undertow.plants import Bench, Encoder, Push, RealisticRig
from undertow.plants.bench import bench_for
from undertow.studies.campaign import league_report
from undertow.studies.campaign.definition import Settings
from undertow.studies.campaign.entrants import (
    FAULTS,
    OURS,
    Entry,
    ForfeitError,
    Refereed,
    Setting,
    spent,
)
from undertow.studies.campaign.study import Arrays, Axis, Study, Variable, tolerances
from undertow.studies.trials.trial import Outcome, trial

#: Of the definition of tasks and scores: a change of either makes it another one.
VERSION = 2

#: The tasks: see :meth:`League.bench`.
TASKS = ("exact", "plants", "friction", "delay", "noise", "push", "bench")

#: Entrants that are scored by hindsight: what the plant itself allows.
HINDSIGHT = "bound"

#: Half-width of the parameters in ``plants``; friction in ``friction``, of the bench's; delay in
#: all, s; counts of an encoder's turn, and their size along a slide, m; when a push comes, s.
SPREAD, FRICTION, DELAY, COUNTS, SLIDE, PUSHED = 0.10, 2.0, 0.005, 1024, 1e-4, 3.0

#: Plants on which settings are chosen, and the seed that tells them from those that are scored.
TUNED_ON, TUNING = 1, 1_000_003

#: Where coordinates are home: free ones, driven ones; rad and m.  Free ones are no farther from
#: their target than this part of the largest |q_i(0)|.
FREE, DRIVEN, PART = (
    {"rad": math.radians(2.0), "m": 0.01},
    {"rad": math.radians(20.0), "m": 0.05},
    0.5,
)


class League(Study):
    """A benchmark that others can enter: mechanisms × entrants × tasks × plants.

    Every run begins at the mechanism's usual start.  All entrants have the same estimator, which
    knows the usual bench and the encoders of the run; what it knows of a disturbance at the inputs
    is taken off the output of each.  A run is won when everything is home for its last second, see
    :func:`home`.  The cost is that of the objective, along the true motion, until the terminal set
    is reached: after the push, where there is one.  Entrant ``bound`` is what the plant itself
    allows with hindsight, without friction, noise, delay or push.

    Settings: ``mechanisms``, names, by default the one of the campaign; ``tasks`` and ``entrants``,
    lists, by default all; ``plants`` of each task; ``objective``, by default ``effort``;
    ``horizon`` and ``seconds`` of a run; ``seed``.  A shard is one entrant on one mechanism.
    """

    kind: ClassVar[str] = "league"

    def __init__(self, mechanism: Mechanism, settings: Settings) -> None:
        self.seed = settings.count("seed", 0, low=0)
        self.mechanism = mechanism
        names = settings.names("mechanisms")
        self.mechanisms = tuple(named(name) for name in names) or (mechanism,)
        if mechanism.identity != self.mechanisms[0].identity:
            raise InvalidInputError(
                settings.what("mechanisms"),
                value=f"{', '.join(names)} besides a 'mechanism', 'parameters' or 'limits'",
                limit="the mechanisms as the library or their files have them",
                remedy="Name a changed one alone, with mechanism = …",
            )
        self.tasks = settings.words("tasks", TASKS)
        self.plants = settings.count("plants", 8, high=10**5)
        least = 1.5 if "push" not in self.tasks else PUSHED + 1.0
        self.length = settings.number("seconds", 10.0, low=least, high=1e4)
        horizon = settings.number("horizon", 60.0, low=1e-3, high=1e4)
        word = settings.word("objective", get_args(Goal), "effort")
        self.objectives = tuple(objective_for(m, word, horizon=horizon) for m in self.mechanisms)
        for m, objective in zip(self.mechanisms, self.objectives, strict=True):
            objective.check_start(m, m.usual_start)
        self._axes([Entry.of(name) for name in settings.words("entrants", OURS)])
        self.variables = {
            "won": Variable("1", "home for the last second", "int8"),
            "cost": Variable("1", "cost of the motion, in the objective's unit"),
            "settled": Variable("s", "time after which it stayed home"),
            "chatter": Variable("1/s", "variation of the inputs, of their limits"),
            "fault": Variable("1", "why no input was given", "int8", FAULTS),
            "setting": Variable("1", "number of the setting that was chosen", "int8"),
            "step_mean": Variable("s", "processor time of a step, mean", measured=True),
            "step_most": Variable("s", "processor time of a step, longest", measured=True),
        }

    def _axes(self, entries: list[Entry]) -> None:
        self.entries = entries
        words = [HINDSIGHT, *(entry.name for entry in entries)]
        if len(set(words)) < len(words):
            raise InvalidInputError(
                "names of the entrants", value=", ".join(words), limit="each once"
            )
        self.axes = (
            Axis.of_words("mechanism", [m.name for m in self.mechanisms]),
            Axis.of_words("entrant", words),
            Axis.of_words("task", self.tasks),
            Axis("plant", np.arange(self.plants), "1"),
        )
        self.most = len(self.tasks) * self.plants

    def enter(self, code: Sequence[str]) -> None:
        """Take controllers of one's own, ``FILE.py:NAME``."""
        self._axes([*self.entries, *(Entry.of(name) for name in code)])

    def report(self, data: Any) -> list[RenderableType]:
        """Return the league table."""
        return league_report.tables(data)

    def bench(self, mechanism: Mechanism, task: str) -> Bench:
        """Return the truth of a task.

        ``exact``: the model, its state measured; ``plants``: every parameter but gravity within
        ±10 %; ``friction``: twice the dry friction of the usual bench; ``delay``: 5 ms from
        measurement to action; ``noise``: encoders of 1024 counts a turn, or 0.1 mm, with one count
        of noise; ``push``: after 3 s an impulse on the first free coordinate, which alone would
        bring it as far as half of the start; ``bench``: the usual bench, with all it has.
        """
        usual, ideal = bench_for(mechanism), Bench(mechanism)
        match task:
            case "plants":
                varied = (p for p in mechanism.parameters if p.value and not p.is_gravity)
                return replace(ideal, tolerance=tolerances(varied, SPREAD))
            case "friction":
                return replace(ideal, friction=usual.with_friction(FRICTION).friction)
            case "delay":
                return ideal.with_delay(DELAY)
            case "noise":
                return replace(
                    ideal, encoders={c.name: _coarse(c.unit) for c in mechanism.coordinates}
                )
            case "push":
                return replace(ideal, pushes=(_push(mechanism),))
            case "bench":
                return usual
        return ideal

    def compute(self, shard: int) -> Arrays:
        """Run one entrant on one mechanism: all tasks, all plants."""
        place = self.part(shard)
        number, who = place[0].start, place[1].start
        mechanism, objective = self.mechanisms[number], self.objectives[number]
        found = self.unknown((1, 1, len(self.tasks), self.plants))
        chosen = 0
        if who:
            entry = self.entries[who - 1]
            chosen = self._choose(mechanism, objective, entry)
        for i, task in enumerate(self.tasks):
            for k in range(self.plants):
                if who == 0:
                    row = self._hindsight(mechanism, objective, task, k)
                else:
                    row = self._run(
                        mechanism, objective, entry, entry.settings[chosen], task, self._seed(k)
                    )
                    row["setting"] = chosen
                for name, value in row.items():
                    found[name][0, 0, i, k] = value
        return found

    def _seed(self, plant: int) -> int:
        return int(np.random.default_rng([self.seed, plant]).integers(2**31))

    def _choose(self, mechanism: Mechanism, objective: Objective, entry: Entry) -> int:
        """Return which setting wins most on plants of their own, and among those at least cost."""
        if len(entry.settings) == 1:
            return 0
        scores = []
        for setting in entry.settings:
            rows = [
                self._run(mechanism, objective, entry, setting, task, TUNING + self._seed(k))
                for task in ("plants", "bench")
                for k in range(TUNED_ON)
            ]
            cost = sum(row["cost"] for row in rows if row["won"])
            scores.append((-sum(row["won"] for row in rows), cost))
        return scores.index(min(scores))

    def _run(
        self, mechanism: Mechanism, objective: Objective, entry: Entry, setting: Setting, task: str,
        seed: int,
    ) -> dict[str, float]:  # fmt: skip
        """Return the scores of a run."""
        try:
            entrant = entry.make(mechanism, objective, **setting)
        except MissingExtraError:
            raise
        # Of somebody's code: it has no controller for this mechanism.
        except (Exception, SystemExit) as error:
            return self._forfeit(ForfeitError(1, f"{error_text(error)}{raised_at(error)}"))
        referee: list[Refereed] = []

        def make(x0: FloatArray) -> Refereed:
            referee.append(Refereed(entrant, x0, mechanism.m))
            return referee[0]

        truth, told = self.bench(mechanism, task), bench_for(mechanism)
        if task == "noise":  # the data sheet of an encoder is at hand
            told = replace(told, encoders=truth.encoders)
        try:
            outcome = trial(
                mechanism, truth, make, mechanism.usual_start, self.length, seed,
                objective=objective, told=told,
                home=home(mechanism),
            )  # fmt: skip
        except ForfeitError as forfeit:
            return self._forfeit(forfeit)
        return _scores(mechanism, outcome) | dict(
            zip(("step_mean", "step_most"), spent(referee[0].seconds), strict=True)
        )

    def _forfeit(self, forfeit: ForfeitError) -> dict[str, float]:
        """Return the scores of a run that was given up, and note why."""
        words = " ".join(f"forfeited: {forfeit}".split())
        if words not in self.notes:
            self.notes.append(printable(words))
        return {"won": 0, "fault": forfeit.fault}

    def _hindsight(
        self, mechanism: Mechanism, objective: Objective, task: str, plant: int
    ) -> dict[str, float]:
        """Return what the plant of a run allows."""
        rig = RealisticRig(self.bench(mechanism, task), mechanism.usual_start, self._seed(plant))
        try:
            least = bounded(rig.mechanism, objective, rig.truth.tobytes())
        except UndertowError:  # none was found, or there is no CasADi
            return {}
        return {"cost": least, "won": 1}


@lru_cache(maxsize=4096)
def bounded(mechanism: Mechanism, objective: Objective, start: bytes) -> float:
    """Return the least cost that optimal control finds from a start, (2n,) float64."""
    return bound(mechanism, objective, np.frombuffer(start)).cost


def home(mechanism: Mechanism) -> FloatArray:
    """Return how far each coordinate is from its target at most where it is home, (n,)."""
    m, units = mechanism.m, [c.unit for c in mechanism.coordinates]
    most = PART * float(np.abs(mechanism.usual_start[: mechanism.n]).max())
    free = [min(FREE[unit], most) for unit in units[m:]]
    return np.array([DRIVEN[unit] for unit in units[:m]] + free)


def _coarse(unit: str) -> Encoder:
    count = 2 * math.pi / COUNTS if unit == "rad" else SLIDE
    return Encoder(count, noise=count)


def _push(mechanism: Mechanism) -> Push:
    """Return an impulse on the first free coordinate that moves it by half of the start."""
    n, m = mechanism.n, mechanism.m
    speed = 0.5 * linearise(mechanism).fastest * float(np.abs(mechanism.usual_start[:n]).max())
    inertia = mechanism.M(np.zeros(n))
    # An impulse J on one coordinate changes the velocities by M⁻¹ e J.
    return Push(PUSHED, mechanism.coordinates[m].name, speed / float(np.linalg.inv(inertia)[m, m]))


def _scores(mechanism: Mechanism, outcome: Outcome) -> dict[str, float]:
    record = outcome.record
    return {
        "won": int(outcome.balanced),
        "settled": outcome.settled if math.isfinite(outcome.settled) else math.nan,
        "cost": outcome.cost if math.isfinite(outcome.cost) else math.nan,
        "chatter": float(
            np.abs(np.diff(record.u, axis=0) / finite_limits(mechanism)).sum() / record.t[-1]
        ),
        "fault": 0,
    }
