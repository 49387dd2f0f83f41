"""Controllers side by side: each on the same plants, from the same start."""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any, TypeVar

from undertow.base import (
    InvalidInputError,
    as_text,
    at_least,
    checked,
    number,
    positive,
    require,
    require_extra,
    table,
)
from undertow.cascade import Cascade
from undertow.estimators import Belief, StateFeedback
from undertow.law import Surface
from undertow.models import FloatArray, Mechanism, StateLike
from undertow.objective import Objective
from undertow.plants import Bench
from undertow.plants.bench import bench_for
from undertow.runtime import estimator_for
from undertow.studies.trials.steering import (
    cascade_and_kept,
    clipped_regulator,
    keeping,
    predictive,
)
from undertow.studies.trials.trial import MakeController, Outcome, trial

#: What :func:`compare` takes for a controller.
Contender = Cascade | Surface | MakeController

#: What a cell of the table means.
NOT_YET = "not yet: still on its way when the run ended; give it more seconds"

T = TypeVar("T")


@checked
def lqr(mechanism: Mechanism) -> MakeController:
    """Return a linear-quadratic regulator at the target, its output clipped, to compare with.

    Q is 1 on q_a, 10 on q_u and 0.1 on the velocities, R is 1/u_max²: what
    :func:`undertow.first_surface` is designed by.  Where gravity or a spring is to be held at the
    target, it acts about the input that does.
    """
    return clipped_regulator(mechanism)


@checked
def nmpc(mechanism: Mechanism, objective: Objective, **settings: Any) -> MakeController:
    """Return nonlinear model-predictive control by multiple shooting at 10 Hz, to compare with.

    It keeps within the limits of the inputs, and knows of no others: not of a travel either.
    ``settings`` are those of :class:`undertow.studies.trials.steering.NMPC`.

    Raises
    ------
    InvalidInputError
        For an objective that does not rise with every input, such as least time, and for one with
        constraints of its own.
    MissingExtraError
        Without CasADi.
    """
    own = ", ".join(c.name for c in objective.constraints if not c.declared)
    require(not own, "constraints of an objective for NMPC", own, "none: it would not keep them")
    return predictive(mechanism, objective.on(mechanism), **settings)


@dataclass(frozen=True, eq=False)
class Comparison:
    """Outcomes by (controller, plant).

    ``outcomes``: names of controller and plant to the run. ``cost_unit``: unit of the outcomes'
    cost.
    """

    outcomes: Mapping[tuple[str, str], Outcome]
    cost_unit: str = ""

    @property
    def rows(self) -> list[dict[str, Any]]:
        """A row for each run: names, whether it balanced, when it settled, what it cost.

        ``approaching`` is whether the free coordinates were home and the driven ones still coming
        nearer when the run ended: a longer one may show that it balances.
        """
        return [
            {
                "controller": controller,
                "plant": plant,
                "balanced": outcome.balanced,
                "approaching": outcome.approaching,
                "settled_s": outcome.settled,
                "cost": outcome.cost,
                "effort": outcome.effort,
                "chatter": outcome.chatter,
            }
            for (controller, plant), outcome in self.outcomes.items()
        ]

    def to_pandas(self) -> Any:
        """Return a ``pandas.DataFrame`` with a row for each run.

        Raises
        ------
        MissingExtraError
            Without pandas.
        """
        pandas = require_extra("pandas", "interop", "data frames need pandas")
        return pandas.DataFrame(self.rows)

    def _cells(self) -> list[list[str]]:
        heads = ["controller", "plant", "balanced", "settled, s"]
        heads.append(f"cost, {self.cost_unit}" if self.cost_unit else "cost")
        lines = [
            [
                row["controller"],
                row["plant"],
                "yes" if row["balanced"] else "not yet" if row["approaching"] else "no",
                f"{row['settled_s']:.3g}",
                number(row["cost"], ".4g"),
            ]
            for row in self.rows
        ]
        return [heads, *lines]

    def __str__(self) -> str:
        """Return the table as text."""
        heads, *lines = self._cells()
        text = as_text(table(heads, lines, left=heads[:3])).decode().rstrip()
        return f"{text}\n{NOT_YET}" if any(line[2] == "not yet" for line in lines) else text

    def __repr__(self) -> str:
        """Show how many balanced."""
        good = sum(outcome.balanced for outcome in self.outcomes.values())
        return f"Comparison({good} of {len(self.outcomes)} runs balanced)"

    def _repr_html_(self) -> str:
        """Show the table in a notebook."""
        lines = [[escape(cell) for cell in line] for line in self._cells()]
        body = "".join(f"<tr><td>{'</td><td>'.join(line)}</td></tr>" for line in lines[1:])
        return f"<table><tr><th>{'</th><th>'.join(lines[0])}</th></tr>{body}</table>"


@checked
def compare(
    mechanism: Mechanism,
    controllers: Sequence[Contender] | Mapping[str, Contender],
    *,
    plants: Sequence[Bench | Mechanism] | Mapping[str, Bench | Mechanism] = (),
    objective: Objective | None = None,
    x0: StateLike | None = None,
    seconds: float = 10.0,
    seed: int = 0,
    **state: float,
) -> Comparison:
    """Run each controller on each plant from the same start, in simulated time.

    All have the same kind of estimator, and what it knows of a disturbance at the inputs is taken
    off the output of each.  It learns the usual parameters, for a cascade those that its belief
    leaves open.  A cascade with the gate and the reaching law of exact states is made fit for what
    is known of each plant's sensors and delays, as :func:`undertow.run` does.

    Parameters
    ----------
    mechanism
        What every controller believes.
    controllers
        Cascades, surfaces to be kept, :func:`lqr`, :func:`nmpc`, or whatever returns a function of
        t and x that gives u, (m,), when it is called with the measured start; with names of your
        own in a mapping.
    plants
        Benches, or mechanisms that move as they are; by default the mechanism itself and
        a bench with friction, encoders and delay.
    objective
        What the cost is counted by; the first cascade's by default.
    x0
        Initial state, (2n,), or its non-zero entries by name (``phi=0.7``).  With neither, the
        mechanism's usual ``start``.
    seconds
        Length of a run, s.  As with :func:`undertow.run` no plan is to arrive by its end.
    seed
        Of the benches.

    Raises
    ------
    InfeasibleError
        When a cascade finds no admissible surface.
    InvalidInputError
        When there is nothing to compare.
    """
    require(controllers, "controllers to compare", "none", "at least one")
    positive("length of a trial, s", seconds)
    at_least("seed", seed, 0)
    start = mechanism.initial_state(x0, state)
    named = controllers
    if not isinstance(named, Mapping):
        named = _numbered([(_name(item), item) for item in named])
    for controller in named.values():
        _check_maker(controller)
        if isinstance(controller, Cascade):
            mechanism.check_plant(controller.mechanism)
    meets: Mapping[str, Bench | Mechanism]
    if isinstance(plants, Mapping):
        meets = plants
    elif plants:
        named_plants = [(_plant_name(mechanism, plant), plant) for plant in plants]
        meets = _numbered(named_plants)
    else:
        meets = {"as believed": mechanism, "realistic bench": bench_for(mechanism)}
    if objective is None:
        objective = next((c.objective for c in named.values() if isinstance(c, Cascade)), None)
    outcomes = {}
    for name, controller in named.items():
        makers: dict[object, MakeController] = {}
        for place, plant in meets.items():
            bench = Bench(plant) if isinstance(plant, Mechanism) else plant
            mechanism.check_plant(bench.mechanism)
            told = bench.timing, frozenset(bench.encoders.items())  # one search for all alike
            if told not in makers:
                makers[told] = _maker(mechanism, controller, bench, start)
            known = controller.known if isinstance(controller, Cascade) else Belief.usual(mechanism)
            outcomes[name, place] = trial(
                mechanism, bench, makers[told], start, seconds, seed,
                objective=objective, estimator=estimator_for(mechanism, bench, known=known),
            )  # fmt: skip
    return Comparison(outcomes, "" if objective is None else objective.on(mechanism).unit)


def _maker(
    mechanism: Mechanism, controller: Contender, bench: Bench, start: FloatArray
) -> MakeController:
    """Return what makes the controller of one run."""
    if isinstance(controller, Cascade):
        return cascade_and_kept(controller, bench, start)[0]
    if isinstance(controller, Surface):
        return keeping(mechanism, controller)

    def make(seen: FloatArray) -> StateFeedback:
        made = controller(seen)
        if not callable(made):
            raise _no_maker(controller, f"{made!r} when called with the start")
        return made

    return make


def _check_maker(controller: Contender) -> None:
    """Refuse a function that cannot be called with a start alone, such as a law u(t, x)."""
    if isinstance(controller, Cascade | Surface):
        return
    try:
        taken = inspect.signature(controller)
    except ValueError:  # some functions of C do not say what they take
        return
    try:
        taken.bind(None)
    except TypeError:
        raise _no_maker(controller, f"a function that takes {taken}") from None


def _no_maker(controller: Contender, value: str) -> InvalidInputError:
    return InvalidInputError(
        f"controller '{_name(controller)}' of compare",
        value=value,
        limit="a function of the measured start that returns a function of t and x",
        remedy="Of a law u(t, x) write lambda start: law",
    )


def _name(controller: Contender) -> str:
    if isinstance(controller, Cascade):
        return f"cascade, {controller.objective.name}"
    if isinstance(controller, Surface):
        return "fixed surface"
    return str(getattr(controller, "__name__", type(controller).__name__))


def _plant_name(mechanism: Mechanism, plant: Bench | Mechanism) -> str:
    if plant is mechanism:
        return "as believed"
    return plant.name if isinstance(plant, Mechanism) else f"bench of {plant.mechanism.name}"


def _numbered(items: Sequence[tuple[str, T]]) -> dict[str, T]:
    """Return items by names that are told apart: the second of one name is its name and 2."""
    found: dict[str, T] = {}
    for name, item in items:
        unique, number = name, 2
        while unique in found:
            unique, number = f"{name} {number}", number + 1
        found[unique] = item
    return found
