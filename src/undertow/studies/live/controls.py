"""What a viewer can change: each control with its range, its unit as shown, and who it is for."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal, get_args

import numpy as np

from undertow.base import between, one_of
from undertow.closed_loop.figures import display
from undertow.models import FloatArray, Mechanism, Parameter, invariant_coordinates, number_of
from undertow.models.importers import holding_input
from undertow.objective import Goal
from undertow.objective.named import finite_limits
from undertow.plants import Bench
from undertow.plants.bench import Friction
from undertow.studies.live.planner import Task

#: Whose a control is: the controller's, the true plant's, or the hand's that pokes it.
Group = Literal["controller", "plant", "hand"]

#: The words of the controls that belong to the task.
OBJECTIVE, PERIOD, PUSH = "objective", "period", "push"

#: Periods of re-optimisation that can be chosen, s: multiples of the predictions' step.
SHORTEST, LONGEST = 0.05, 1.0

#: How far limits of inputs go, as parts of their values; the least is so many times what holds.
WEAK, STRONG, HOLDS = 0.1, 1.5, 1.25

#: How far masses and inertias, lengths, and damping of the plant go, as parts of their values; and
#: dry friction, as a part of the full input, or of what a lean of 1 rad or m asks of a free joint.
HEAVY, LONG, DAMPED = (0.5, 2.0), (0.8, 1.25), (0.0, 5.0)
ROUGH, ROUGH_FREE = 0.3, 0.05


@dataclass(frozen=True)
class Control:
    """A slider, or a choice of words.

    Parameters
    ----------
    name
        What it is called in messages.
    label
        What it is called on the page.
    group
        Whose it is.
    value
        As it is: in the unit shown, or a word.
    low, high, usual
        Of a slider.
    unit
        As shown.
    factor
        From SI to the unit shown.
    choices
        Words to choose from, in the place of a range.
    main
        Whether it is shown at once; the others are folded away.
    """

    name: str
    label: str
    group: Group
    value: float | str
    low: float = 0.0
    high: float = 1.0
    usual: float | str = 0.0
    unit: str = ""
    factor: float = 1.0
    choices: tuple[str, ...] = ()
    main: bool = True

    @property
    def si(self) -> float:
        """The value in SI units."""
        return float(self.value) / self.factor

    def put(self, value: object) -> Control:
        """Return it with another value.

        Raises
        ------
        InvalidInputError
            For what is no such word, no number, or outside of the range.
        """
        if self.choices:
            one_of(self.label, str(value), self.choices)
            return replace(self, value=str(value))
        number = number_of(self.label, value)
        rounded = 1e-5 * max(abs(self.low), abs(self.high))  # viewers have six digits
        inside = min(max(number, self.low), self.high)
        if not abs(number - inside) <= rounded:
            between(self.label, number, self.low, self.high, self.unit)
        return replace(self, value=inside)

    def shown(self) -> dict[str, Any]:
        """Return it as JSON values."""
        return {name: value for name, value in asdict(self).items() if name != "factor"}


class Controls(dict[str, Control]):
    """Controls by name, and what they make of a mechanism as they stand.

    Parameters
    ----------
    mechanism
        What the controller believes in.
    controls
        All of them.
    """

    def __init__(self, mechanism: Mechanism, controls: Iterable[Control]) -> None:
        super().__init__({control.name: control for control in controls})
        self.mechanism = mechanism

    def _si(self, kind: str, name: str, otherwise: float) -> float:
        """Return the value of a control, if there is such a one, in SI units."""
        control = self.get(f"{kind} {name}")
        return otherwise if control is None else control.si

    @property
    def task(self) -> Task:
        """What the controller shall be best at."""
        limits = tuple(self._si("limit", c.name, c.limit) for c in self.mechanism.inputs)
        period = round(self[PERIOD].si / 0.002) * 0.002
        return Task(str(self[OBJECTIVE].value), limits, period)

    @property
    def target(self) -> FloatArray:
        """Where it shall go, (n,)."""
        return np.array([self._si("target", c.name, 0.0) for c in self.mechanism.coordinates])

    @property
    def plant(self) -> Mechanism:
        """The true plant."""
        names = (p.name for p in self.mechanism.parameters if f"plant {p.name}" in self)
        values = {name: self[f"plant {name}"].si for name in names}
        return self.mechanism.with_parameters(**values).with_input_limit(*self.task.limits)

    @property
    def bench(self) -> Bench:
        """The true plant with its dry friction."""
        names = (c.name for c in self.mechanism.coordinates if f"friction {c.name}" in self)
        friction = {name: Friction(coulomb=self[f"friction {name}"].si) for name in names}
        return Bench(self.plant, friction=friction)

    def changed(self, changed: Iterable[Control]) -> Controls:
        """Return them with some changed."""
        return Controls(self.mechanism, (self | {c.name: c for c in changed}).values())


def controls_of(mechanism: Mechanism, objective: str, period: float) -> Controls:
    """Return the controls of a mechanism as they stand at first."""
    made = [
        *_targets(mechanism),
        Control(
            OBJECTIVE, "what is best", "controller", objective, choices=get_args(Goal),
            usual=objective,
        ),
        Control(
            PERIOD, "re-optimised every", "controller", period, SHORTEST, LONGEST, period, "s"
        ),
        *_limits(mechanism),
        *_frictions(mechanism),
        *_parameters(mechanism.parameters),
        Control(PUSH, "strength of a push", "hand", 1.0, 0.1, 5.0, 1.0, "×"),
    ]  # fmt: skip
    return Controls(mechanism, made)


def _targets(mechanism: Mechanism) -> list[Control]:
    """Where the target can be: along what the dynamics do not depend on, within the travel."""
    made, free = [], invariant_coordinates(mechanism)
    for c in mechanism.coordinates:
        if c.name not in free:
            continue
        factor, unit = display(c.unit)
        usual = math.pi / 2 if c.unit == "rad" else 1.0
        # The travel counts 95 % of each side, and the terminal set has to lie inside.
        low = max(0.85 * c.low, -usual)
        high = min(0.85 * c.high, usual)
        made.append(
            Control(f"target {c.name}", f"target of {c.name}", "controller", 0.0, low * factor,
                    high * factor, 0.0, unit, factor)
        )  # fmt: skip
    return made


def _limits(mechanism: Mechanism) -> list[Control]:
    """Limit of each input, as far down as it still holds the target with something to spare."""
    return [
        Control(
            f"limit {channel.name}", f"limit of {channel.name}", "controller", channel.limit,
            min(max(WEAK * channel.limit, HOLDS * held), channel.limit), STRONG * channel.limit,
            channel.limit, channel.unit,
        )
        for channel, held in zip(mechanism.inputs, np.abs(holding_input(mechanism)), strict=True)
        if math.isfinite(channel.limit)
    ]  # fmt: skip


def _frictions(mechanism: Mechanism) -> list[Control]:
    """Dry friction of each coordinate of the plant."""
    lean = np.zeros(2 * mechanism.n)
    made = []
    for i, c in enumerate(mechanism.coordinates):
        if i < mechanism.m:
            most = ROUGH * float(np.abs(mechanism.B[i]) @ finite_limits(mechanism))
        else:
            lean[i] = 1.0
            most = ROUGH_FREE * float(np.abs(mechanism.f(lean)).max())
            lean[i] = 0.0
        if most > 0:
            most = float(f"{most:.2g}")
            made.append(
                Control(f"friction {c.name}", f"dry friction of {c.name}", "plant", 0.0, 0.0, most,
                        0.0, mechanism.force_units[i], main=i == 0)
            )  # fmt: skip
    return made


def _parameters(parameters: Sequence[Parameter]) -> list[Control]:
    """What the plant weighs, and the rest of its parameters."""
    made = []
    masses = [p.name for p in parameters if p.unit == "kg" and p.value > 0]
    for p in parameters:
        low, high = LONG
        if p.unit in ("kg", "kg m²"):
            low, high = HEAVY
        elif p.unit.startswith("N") and "s" in p.unit.split("/")[0].split():
            low, high = DAMPED
        if not p.value > 0:
            continue
        words = f"{p.name}, {p.description}" if p.description else p.name
        made.append(
            Control(
                f"plant {p.name}", words, "plant", p.value, max(low * p.value, p.low),
                min(high * p.value, p.high), p.value, p.unit, main=p.name in masses[-1:],
            )
        )  # fmt: skip
    return made
