"""Objectives: what is best. Stage cost, horizon, terminal set, constraints, (21)-(31).

A stage cost Φ(x, u) and constraints w(x, u) ≤ 0 are SymPy expressions of the mechanism's
own names, so they are compiled into the kernel with the rest of the loop.
"""

from __future__ import annotations

import math
import pickle
import warnings
from collections.abc import Callable, Container, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
import sympy as sp

from undertow.base import (
    InvalidInputError,
    ModelError,
    UndertowError,
    a_kind,
    check_fields,
    checked,
    checked_names,
    error_text,
    near,
    positive,
    raised_at,
)
from undertow.models import (
    Coordinate,
    FloatArray,
    Mechanism,
    by_names,
    check_symbols,
    expression_of,
    normal_name,
    number_of,
    shortened,
    vocabulary,
)
from undertow.models.importers import holding_input
from undertow.symbolic import compile_expressions

#: Part of a coordinate's declared travel that a motion may use: the rest is for what no model
#: knows of, before the end stop.
TRAVEL = 0.95

#: Part of a bound on a state that large steps keep clear of, see
#: :mod:`undertow.closed_loop.exponential_integrator`.
SPARE = 0.05

#: Part of the room of a constraint on the input, of that at the target, that predictions keep where
#: they are about plausible plants.
GUARD = 0.01

#: Radius of a terminal set, at most, over the range of a state.
WIDEST = 10.0


class Names:
    """The states, inputs and parameters of a mechanism as attributes: ``v.phi``, ``v.voltage``.

    ``v.states`` and ``v.inputs`` are the column matrices of all states and all inputs.
    """

    def __init__(self, mechanism: Mechanism) -> None:
        self.states = sp.Matrix(mechanism.x)
        self.inputs = sp.Matrix(mechanism.u)
        self._symbols = {
            str(s): s for s in (*mechanism.x, *mechanism.u, *mechanism.parameter_symbols)
        }

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names."""
        return iter(self._symbols)

    def __getattr__(self, name: str) -> Any:
        """Return the symbol of that name."""
        symbols = self.__dict__.get("_symbols", {})
        name = normal_name(name)
        if name in symbols:
            return symbols[name]
        hint = near(name, symbols)
        message = f"no state, input or parameter '{name}'; there are {', '.join(symbols)}. {hint}"
        raise AttributeError(message, name=name, obj=self)


class _AnyNames(Names):
    """Names of whatever mechanism a formula is for: each is the symbol that it has there."""

    def __init__(self) -> None:
        pass

    def __iter__(self) -> Iterator[str]:
        raise TypeError("the names are not known without a mechanism")

    def __getattr__(self, name: str) -> sp.Symbol:
        if name in ("states", "inputs"):
            raise TypeError(f"{name} are not known without a mechanism")
        return sp.Symbol(normal_name(name), real=True)


Formula = Callable[[Names], Any]

_REMEDIES = {
    "horizon": "Give the longest motion worth waiting for, s",
    "terminal_radius": "Motions end in a small ball around the target; the paper's is 0.01",
}


@checked_names
@dataclass(frozen=True)
class Constraint:
    """A path constraint w(x, u) ≤ 0, equation (25).

    Parameters
    ----------
    name
        Shown when it is the one that fails.
    formula
        Function of :class:`Names` that returns w as a SymPy expression.
    unit
        Unit of w, for people.
    state
        Name of the state that it bounds, where it is one's range.
    source
        Where it comes from, in words.
    declared
        Whether it is travel that a mechanism declares: :meth:`Objective.on` puts that of the
        mechanism at hand in its place.

    Notes
    -----
    *Where it is tested.*  A rollout tests w at the start of each of its small Runge-Kutta steps,
    ``ClosedLoop.step`` apart (2 ms unless told otherwise), at the state and the input applied
    there; nothing is tested between them.  Large steps (:class:`undertow.ClosedLoop`, ``tail``) are
    taken only where all constraints are bounds of states, :func:`state_box` or declared travel, and
    only where they cannot come near a bound, nor as near as the small steps before them.  A motion
    stops at the first test that fails.  The state at its end, where it enters the terminal set or
    the horizon is over, is tested no more.  What is integrated to a tolerance, ``ClosedLoop.rtol``
    (simulated motions, and what the gate predicts with an exact belief), is tested where its steps
    end and at the instants that are recorded, or 4 ms apart, and stops where w becomes larger than
    1e-4 of what it is below 0 at the target: a search goes up to its bounds, by other steps.

    *What may happen in between.*  Where ẇ is Lipschitz, w exceeds its larger value at two
    neighbouring tests, h apart, by at most (h²/8) max |ẅ| (the error of linear interpolation).
    A bound on a coordinate has ẅ = ± q̈: at h = 2 ms and 200 rad/s², 1e-4 rad.  The input of a
    continuous law has kinks where it saturates: for a bound on it (h/2) max |ẇ| holds.  Who
    needs a bound at every instant tightens it by as much, or takes shorter steps.

    Examples
    --------
    >>> arm = Constraint("arm within 60°", lambda v: v.theta**2 - math.radians(60) ** 2)
    """

    name: str
    formula: Formula
    unit: str = ""
    state: str = ""
    source: str = ""
    declared: bool = False

    @property
    def words(self) -> str:
        """Its name, and where it comes from."""
        return f"{self.name}: {self.source}" if self.source else self.name


@dataclass(frozen=True)
class _Within:
    """w of low ≤ x_i ≤ high, for a state by its name or number; one end may be infinite.

    x_i is counted from the target; ``target`` names the parameter that says where that is.
    """

    state: str | int
    low: float
    high: float
    target: str = ""

    def __call__(self, v: Names) -> sp.Expr:
        x = v.states[self.state] if isinstance(self.state, int) else getattr(v, self.state)
        if self.target:
            x += getattr(v, self.target)
        if not math.isfinite(self.low):
            return x - self.high
        if not math.isfinite(self.high):
            return self.low - x
        return sp.Abs(x - (self.low + self.high) / 2) - (self.high - self.low) / 2

    @property
    def spare(self) -> float:
        """How far from the bound large steps stay."""
        ends = [abs(end) for end in (self.low, self.high) if math.isfinite(end)]
        return SPARE * sum(ends) / len(ends)


@dataclass(frozen=True)
class _Shifted:
    """w of a constraint on absolute positions, as a function of the error: x = error + target."""

    formula: Formula
    targets: tuple[tuple[str, str], ...]

    def __call__(self, v: Names) -> sp.Expr:
        moved = {getattr(v, x): getattr(v, x) + getattr(v, target) for x, target in self.targets}
        return sp.sympify(self.formula(v)).xreplace(moved)


@dataclass(frozen=True)
class _Guarded:
    """w of a constraint that is kept by some margin."""

    formula: Formula
    margin: float

    def __call__(self, v: Names) -> sp.Expr:
        return self.formula(v) + self.margin


def state_box(**bounds: float | tuple[float, float]) -> tuple[Constraint, ...]:
    """Return bounds on the named states, SI units, as constraints: (24)'s x ∈ 𝒳.

    Parameters
    ----------
    **bounds
        A number for |state| ≤ bound, or (low, high) around the target, low < 0 < high.

    Raises
    ------
    InvalidInputError
        For a bound that is not finite, or that excludes the target.

    See Also
    --------
    Constraint : where in a motion they are tested.

    Examples
    --------
    >>> [c.name for c in state_box(theta=1.047, phi=(-0.2, 0.5))]
    ['|theta| ≤ 1.047', '-0.2 ≤ phi ≤ 0.5']
    """

    def bounded(name: str, bound: float | tuple[float, float]) -> Constraint:
        ends = bound if isinstance(bound, tuple) else (bound, bound)
        low, high = (number_of(f"bound of state '{name}'", end) for end in ends)
        low = low if isinstance(bound, tuple) else -low
        if not (math.isfinite(low) and math.isfinite(high) and low < 0 < high):
            alone = not isinstance(bound, tuple)
            raise InvalidInputError(
                f"bound of state '{name}'",
                value=bound,
                limit="finite and > 0" if alone else "finite, low < 0 < high",
                remedy="The box is |state| ≤ bound, or low ≤ state ≤ high around the target; leave "
                "out states without a bound",
            )
        words = f"|{name}| ≤ {high:g}" if low == -high else f"{low:g} ≤ {name} ≤ {high:g}"
        return Constraint(words, _Within(name, low, high), state=name)

    named = by_names("bounds of states", bounds)
    return tuple(bounded(name, bound) for name, bound in named.items())


def travel_box(mechanism: Mechanism, but: Container[str] = ()) -> tuple[Constraint, ...]:
    """Return the ranges of travel that a mechanism declares, as constraints: 95 % of each side.

    The equations know no end stop; what is planned keeps clear of it all the same.  ``but`` names
    coordinates to leave out. Raises InvalidInputError for a range that does not hold the target.

    Examples
    --------
    >>> import undertow as ut
    >>> [c.words for c in travel_box(ut.mechanisms.cart_pendulum())]
    ['|x| ≤ 1.425 m: 95 % of the travel that cart_pendulum declares']
    """
    found = []
    for index, c in enumerate(mechanism.coordinates):
        if c.name in but or (math.isinf(c.low) and math.isinf(c.high)):
            continue
        if not c.low <= 0 <= c.high:
            raise InvalidInputError(
                f"travel of '{c.name}' that '{mechanism.name}' declares",
                value=f"[{c.low:g}, {c.high:g}] {c.unit}",
                limit="around the target, low ≤ 0 ≤ high",
                remedy="Move the target into it, or let the objective have travel=False",
            )
        low, high = TRAVEL * c.low, TRAVEL * c.high
        source = f"{100 * TRAVEL:g} % of the travel that {mechanism.name} declares"
        name, within = range_words(c, low, high), _Within(index, low, high)
        found.append(Constraint(name, within, c.unit, c.name, source, declared=True))
    return tuple(found)


def range_words(c: Coordinate, low: float, high: float) -> str:
    """Return a range of a coordinate, rad or m, in words: ``|phi| ≤ 20°``, ``-1 m ≤ x ≤ 2 m``."""
    factor, unit = (180 / math.pi, "°") if c.unit == "rad" else (1.0, f" {c.unit}")
    ends = [f"{factor * end:.4g}{unit}" for end in (low, high)]
    if low == -high:
        return f"|{c.name}| ≤ {ends[1]}"
    return f"{ends[0]} ≤ " * math.isfinite(low) + c.name + f" ≤ {ends[1]}" * math.isfinite(high)


def check_travel(mechanism: Mechanism, name: str, low: float, high: float, shown: str) -> None:
    """Refuse a box, ``shown`` in words, that reaches beyond the travel of its coordinate.

    Raises
    ------
    InvalidInputError
        With the travel that the mechanism declares.
    """
    for c in mechanism.coordinates:
        if c.name == name and (low < c.low or high > c.high):
            raise InvalidInputError(
                f"box of '{name}'",
                value=repr(shown),
                limit=f"within the travel that {mechanism.name} declares, "
                f"{c.low:g} to {c.high:g} {c.unit}",
                remedy="A longer one is a mechanism of your own, with other ends: FILE.py:NAME; "
                "in Python an objective with travel=False ignores what is declared",
            )


def _warn_of_degrees(mechanism: Mechanism, state: str, most: float) -> None:
    """Warn of a box of an angle that is wider than a turn: it may be meant, as of a wheel's."""
    angles = [c.name for c in mechanism.coordinates if c.unit == "rad"]
    if state in angles and 2 * math.pi < most < math.inf:
        warnings.warn(
            f"the box of '{state}' lets it turn by {most:g} rad, {math.degrees(most):.4g}°: write "
            f"undertow.deg({most:g}) for {most:g}°",
            stacklevel=2,
        )


@checked_names
@dataclass(frozen=True, repr=False)
class Objective:
    """A stage cost with its horizon, terminal set and constraints.

    Parameters
    ----------
    name
        Short name for tables.
    stage
        Φ(x, u) of (21) as a function of :class:`Names`; must be ≥ 0.
    unit
        Unit of the total cost.
    horizon
        Longest prediction, s; a motion that has not reached the terminal set by then is
        not admissible.
    terminal_radius
        ν of the terminal set ‖x‖₂ ≤ ν, (31); the cost is counted until it is reached.
    constraints
        Path constraints w(x, u) ≤ 0, (25); :class:`Constraint` says where they are tested.
    hard_input
        False: the actuator clips (38).  True: |u| ≤ u_max is a constraint on the
        *unclipped* law, and a motion that would saturate is not admissible.  It is tested where
        the others are; in a sampled loop at the samples.
    travel
        True: the ranges of travel that the mechanism declares are constraints too, 95 % of each
        side, but for a coordinate that a :func:`state_box` among the constraints bounds anew,
        up to all of the travel; one that reaches beyond it is refused.
        False: only what ``constraints`` say.
    formula
        What is integrated, in words; by default the expression itself.

    Examples
    --------
    >>> quadratic = Objective("quadratic", lambda v: v.voltage**2 + 10 * v.phi**2)
    """

    name: str
    stage: Formula
    unit: str = ""
    horizon: float = 60.0
    terminal_radius: float = 0.01
    constraints: tuple[Constraint, ...] = ()
    hard_input: bool = False
    travel: bool = True
    formula: str = ""

    def __post_init__(self) -> None:
        """Refuse a stage cost that is no function, and a horizon or radius that is not positive."""
        if not callable(self.stage):
            raise InvalidInputError(
                f"stage cost of '{self.name}'",
                value=f"{self.stage!r}, {a_kind(self.stage)}",
                limit="a function of the mechanism's names that returns an expression",
                remedy="Write lambda v: v.inputs[0]**2, or lambda v: 1 for a constant",
            )
        words = ("name", "unit", "constraints", "hard_input", "travel", "formula")
        check_fields(self, *words)
        object.__setattr__(self, "constraints", tuple(self.constraints))
        for field in ("horizon", "terminal_radius"):
            value = number_of(f"{field} of objective '{self.name}'", getattr(self, field))
            positive(f"{field} of objective '{self.name}'", value, _REMEDIES[field])

    @checked
    def on(self, mechanism: Mechanism) -> Self:
        """Return the problem as it is for a mechanism: with the travel that it declares.

        The one rule for ranges of travel: :class:`undertow.ClosedLoop`, the cascade and the bound
        all apply it to what they are given, and applying it twice changes nothing.

        Raises
        ------
        InvalidInputError
            For a declared range that does not hold the target, for a :func:`state_box` that reaches
            beyond one, and for a range that is nothing beside the terminal set.

        Warns
        -----
        UserWarning
            Of a :func:`state_box` that lets an angle turn more than once: degrees, probably.
        """
        own = tuple(c for c in self.constraints if not c.declared)
        boxes = {c.state: c for c in own if isinstance(c.formula, _Within)}
        declared = travel_box(mechanism, boxes) if self.travel else ()
        for state, box in boxes.items():
            ends: Any = box.formula
            if self.travel:
                check_travel(mechanism, state, ends.low, ends.high, box.name)
            if not box.source:  # somebody's own numbers
                _warn_of_degrees(mechanism, state, max(-ends.low, ends.high))
        constraints = own + declared
        self._check_terminal_set(mechanism, constraints)
        return self if constraints == self.constraints else replace(self, constraints=constraints)

    def _check_terminal_set(self, mechanism: Mechanism, constraints: Iterable[Constraint]) -> None:
        """Refuse a terminal set beside which a range is nothing: all that is in it has arrived.

        A ball that is somewhat wider than one coordinate's travel is a matter of taste: the TORA's
        cart moves 2.5 cm, and may come to rest within 5 cm, rad and their rates. Raises
        InvalidInputError with the range.
        """
        for c in constraints:
            box: Any = c.formula
            if isinstance(box, _Within) and not box.target:
                most = max(-box.low, box.high)
                if WIDEST * most < self.terminal_radius:
                    raise InvalidInputError(
                        f"terminal_radius of objective '{self.name}' for '{mechanism.name}'",
                        value=f"{self.terminal_radius:g}",
                        limit=f"at most {WIDEST * most:g}, {WIDEST:g} times the range: a motion "
                        f"with {c.words} would have arrived wherever it is",
                        remedy="Give a smaller terminal_radius, or lengths and times in units of "
                        "the mechanism's own size",
                    )

    @checked
    def about(self, mechanism: Mechanism, names: Sequence[str]) -> Self:
        """Return the problem in the error from a target that lies elsewhere along some coordinates.

        Stage cost and terminal set are about the error; constraints stay about absolute positions.

        Parameters
        ----------
        mechanism
            Whose travel joins the constraints.
        names
            Coordinates whose target is a parameter, ``<name>_target``, see
            :func:`undertow.models.with_positions`.
        """
        targets = {name: f"{name}_target" for name in names}

        def moved(c: Constraint) -> Constraint:
            within = isinstance(c.formula, _Within)
            formula: Formula = c.formula
            if within and c.state in targets:
                formula = replace(c.formula, target=targets[c.state])  # type: ignore[type-var]
            elif not within:
                formula = _Shifted(c.formula, tuple(targets.items()))
            return Constraint(c.words, formula, c.unit, c.state)

        constraints = tuple(moved(c) for c in self.on(mechanism).constraints)
        return replace(self, constraints=constraints, travel=False)

    @checked
    def guarded(self, mechanism: Mechanism) -> Self:
        """Return the problem with 1 % of the room of each constraint on the input kept.

        The room is −w(0, u), the margin at the target under the input that holds it.  What the
        input of a law is follows the state: a plan that goes up to such a constraint on one plant
        breaks it on the next, where one that goes up to a bound of a state is a little late, if
        anything.
        """
        held = dict(zip(mechanism.u, holding_input(mechanism).tolist(), strict=True))
        at_target = mechanism.substitution | dict.fromkeys(mechanism.x, 0.0) | held

        def kept(c: Constraint, margin: sp.Expr) -> Constraint:
            room = margin.subs(at_target)
            if not (margin.free_symbols & {*mechanism.u} and room.is_finite and room > 0):
                return c
            return replace(c, formula=_Guarded(c.formula, GUARD * float(room)))

        margins = self.path_margins(mechanism)
        return replace(self, constraints=tuple(map(kept, self.constraints, margins)))

    @checked
    def range_of(self, mechanism: Mechanism) -> tuple[FloatArray, FloatArray]:
        """Return the least and the largest value of each state, (2n,), that boxes among them allow.

        Infinite where there is none; constraints that are no box are not in it.
        """
        names = list(mechanism.state_names)
        low, high = np.full(len(names), -math.inf), np.full(len(names), math.inf)
        for constraint in self.on(mechanism).constraints:
            box: Any = constraint.formula
            if isinstance(box, _Within) and not box.target:
                index = box.state if isinstance(box.state, int) else names.index(box.state)
                low[index], high[index] = max(low[index], box.low), min(high[index], box.high)
        return low, high

    @checked
    def meaning(self, mechanism: Mechanism) -> str:
        """Return in one line what is minimised, until when, and within which bounds.

        Examples
        --------
        >>> import undertow as ut
        >>> ut.MinimumEnergy().meaning(ut.mechanisms.cart_pendulum())
        ... # doctest: +NORMALIZE_WHITESPACE
        'energy: ∫ uᵀu dt, N² s, to ‖x‖ ≤ 0.01 within 60 s;
         |x| ≤ 1.425 m: 95 % of the travel that cart_pendulum declares'
        """
        problem = self.on(mechanism)
        unit = f", {problem.unit}" if problem.unit else ""
        bounds = [c.words for c in problem.constraints]
        if self.hard_input:
            bounds += [
                f"|{i.name}| ≤ {i.limit:g} {i.unit} before clipping" for i in mechanism.inputs
            ]
        return "; ".join(
            (
                f"{self.name}: {self._formula(mechanism)}{unit}, "
                f"to ‖x‖ ≤ {self.terminal_radius:g} within {self.horizon:g} s",
                *bounds,
            )
        )

    def _words(self) -> str:
        """Return what is integrated as far as it can be said without a mechanism."""
        return self.formula

    def _formula(self, mechanism: Mechanism) -> str:
        return self._words() or f"∫ ({self.stage_cost(mechanism)}) dt"

    @checked
    def written(self, mechanism: Mechanism) -> Self:
        """Return the same objective with what no other process can import as expressions.

        A lambda cannot be pickled; its expression in a mechanism's own names can.
        """
        changed = self._formulas(lambda what, f: self._expression(mechanism, what, f))
        same = changed == {"stage": self.stage, "constraints": self.constraints}
        return self if same else replace(self, **changed)

    def _formulas(self, write: Callable[[str, Formula], sp.Expr]) -> dict[str, Any]:
        """Return stage and constraints, written down where no other process can import them."""

        def taken(what: str, formula: Formula) -> Formula:
            return formula if _importable(formula) else _Written(write(what, formula))

        constraints = (replace(c, formula=taken(c.name, c.formula)) for c in self.constraints)
        return {"stage": taken("stage cost", self.stage), "constraints": tuple(constraints)}

    def __repr__(self) -> str:
        """Show its name, what is integrated, where a motion ends, and the constraints."""
        words = self._words()
        what = f"{words}, " if words else ""
        unit = f"{self.unit}, " if self.unit else ""
        bounds = "".join(f"; {c.name}" for c in self.constraints)
        return (
            f"{type(self).__name__}({self.name}: {what}{unit}to ‖x‖ ≤ {self.terminal_radius:g} "
            f"within {self.horizon:g} s{bounds})"
        )

    def __getstate__(self) -> dict[str, Any]:
        """Take along formulas that no other process can import as expressions in plain names."""
        return {**vars(self), **self._formulas(self._portable)}

    def _portable(self, what: str, formula: Formula) -> sp.Expr:
        try:
            return expression_of(what, formula(_AnyNames()))
        except Exception as error:  # a user's function may do anything
            raise InvalidInputError(
                f"'{what}' of objective '{self.name}' for another process or a file",
                value=getattr(formula, "__qualname__", type(formula).__name__),
                limit="a function of states, inputs and parameters by name, or one that can be "
                "imported there",
                remedy="Write it as a def at the top of a module, or send the ClosedLoop or "
                "the Cascade, which take its expression along",
            ) from error

    def __copy__(self) -> Self:
        return self

    def __deepcopy__(self, _memo: object) -> Self:
        return self

    def stage_function(self, mechanism: Mechanism) -> Callable[..., Any]:
        """Return [Φ] as a function of the states and inputs, one by one, for a mechanism's numbers.

        Raises
        ------
        InvalidInputError
            As for :meth:`stage_cost`.
        """
        stage = self.stage_cost(mechanism).subs(mechanism.substitution)
        return compile_expressions([*mechanism.x, *mechanism.u], [stage])

    @checked
    def stage_cost(self, mechanism: Mechanism) -> sp.Expr:
        """Return Φ(x, u) as an expression.

        Raises
        ------
        InvalidInputError
            For unknown names, for Φ = 0, and where Φ is negative or no number at the target or at
            one of 255 random states and inputs.
        """
        what = f"stage cost of '{self.name}'"
        stage = self._expression(mechanism, what, self.stage)
        if stage.is_zero:
            raise InvalidInputError(
                what,
                value="0",
                limit="a cost that depends on the motion",
                remedy="Write lambda v: 1 for least time, lambda v: v.inputs[0]**2 for least "
                "energy",
            )
        lowest = _lowest(mechanism, stage)
        if not lowest >= 0:
            raise InvalidInputError(
                what,
                value=f"{lowest:.3g} for some states and inputs",
                limit="≥ 0 everywhere: (21) is a cost that only grows",
                remedy="Use squares or moduli",
            )
        return stage

    @checked
    def path_margins(self, mechanism: Mechanism) -> list[sp.Expr]:
        """Return −w(x, u) of every constraint: signed margins, ≥ 0 is satisfied."""
        return [
            -self._expression(mechanism, f"constraint '{c.name}'", c.formula)
            for c in self.constraints
        ]

    @checked
    def boxes(self, mechanism: Mechanism) -> tuple[tuple[int, float], ...]:
        """Return which state each constraint bounds, and how far large steps stay from the bound.

        Empty where there are none, and where one is no :func:`state_box` and no travel.
        """
        found, data = [], {*mechanism.parameter_symbols}
        for constraint, margin in zip(self.constraints, self.path_margins(mechanism), strict=True):
            free = margin.free_symbols - data
            bounded = [i for i, x in enumerate(mechanism.x) if free == {x}]
            if not (bounded and isinstance(constraint.formula, _Within)):
                return ()
            found.append((bounded[0], constraint.formula.spare))
        return tuple(found)

    @checked
    def check_start(self, mechanism: Mechanism, x: FloatArray) -> None:
        """Refuse an initial state that breaks a path constraint, whatever the input does.

        So is one that the target breaks, at rest there under the input that holds it.

        Parameters
        ----------
        mechanism
            Whose state it is.
        x
            State, (2n,).

        Raises
        ------
        InvalidInputError
            With the constraint and its margin.
        """
        problem, start = self.on(mechanism), mechanism.check_state(x)
        self._check_resolved(mechanism, start)
        margins = [*zip(problem.constraints, problem.path_margins(mechanism), strict=True)]
        held = dict(zip(mechanism.u, holding_input(mechanism).tolist(), strict=True))
        for state, u, which, remedy in (
            (start, {}, "initial state", "Start inside the constraints, or widen them"),
            (0 * start, held, "target x = 0", "No motion may end there: widen the constraint"),
        ):
            at = dict(zip(mechanism.x, state.tolist(), strict=True))
            values = mechanism.substitution | at | u
            for constraint, margin in margins:
                found = margin.subs(values)
                if not found.is_number:
                    continue  # it depends on the input
                value = real_value(found)
                if not value >= 0:
                    raise InvalidInputError(
                        f"{which} of '{mechanism.name}' breaks '{constraint.words}'",
                        value=f"margin {value:.4g} {constraint.unit}".rstrip(),
                        limit="≥ 0",
                        remedy=remedy,
                    )

    def _check_resolved(self, mechanism: Mechanism, start: FloatArray) -> None:
        """Refuse a state so large that neighbouring numbers are farther apart than the target."""
        resolved = self.terminal_radius * 2.0**52
        sizes = np.abs(start)
        worst = int(np.argmax(sizes))
        if sizes[worst] > resolved:
            c = mechanism.coordinates[worst % mechanism.n]
            unit = f"{c.unit}{'/s' if worst >= mechanism.n else ''}"
            raise InvalidInputError(
                f"initial state '{mechanism.state_names[worst]}' of '{mechanism.name}'",
                value=f"{start[worst]:g} {unit}",
                limit=f"within ±{resolved:.3g} {unit}: floating-point numbers beyond are farther "
                f"apart than the terminal radius {self.terminal_radius:g}",
                remedy="Start closer to the target",
            )

    @staticmethod
    def _expression(mechanism: Mechanism, what: str, formula: Formula) -> sp.Expr:
        names = Names(mechanism)
        try:
            value = formula(names)
        except UndertowError:
            raise
        except AttributeError as error:
            if error.obj is not names:
                raise _failed(what, error) from error
            raise InvalidInputError(
                f"{what} for '{mechanism.name}'",
                value=f"'{error.name}'",
                limit=f"among {', '.join(names)}",
                remedy=near(str(error.name), names) or "Use the mechanism's own names",
            ) from error
        except Exception as error:  # a user's function may do anything
            raise _failed(what, error) from error
        try:
            expression = expression_of(what, value)
            known = vocabulary(
                mechanism.coordinates, mechanism.inputs, mechanism.parameters, time=False
            )
            check_symbols(what, [expression], known)
        except ModelError as error:
            raise InvalidInputError(
                what,
                value=f"{shortened(value)}, with {error.value}",
                limit="one expression in the mechanism's states and inputs",
                remedy=f"Take symbols from the argument: lambda v: v.phi**2. {error.remedy}",
            ) from error
        return expression


@dataclass(frozen=True)
class _Written:
    """A formula that was written down as an expression in a mechanism's own names."""

    expression: sp.Expr

    def __call__(self, _v: Names) -> sp.Expr:
        return self.expression


def _importable(formula: Formula) -> bool:
    """Whether another process can have a formula by its name, or as data."""
    try:
        pickle.dumps(formula)
    except Exception:  # pickle raises what it likes
        return False
    return True


def _energy_unit(mechanism: Mechanism) -> str:
    """Return the unit of ∫uᵀu dt."""
    units = {channel.unit for channel in mechanism.inputs}
    unit = units.pop() if len(units) == 1 else "mixed units"
    if not unit:  # of a motor of an MJCF file, whose input is a number
        return "s"
    return f"({unit})² s" if " " in unit else f"{unit}² s"


def _squares(v: Names) -> sp.Expr:
    """Return uᵀu."""
    return (v.inputs.T * v.inputs)[0]


def _one(_v: Names) -> sp.Expr:
    """Return 1."""
    return sp.Integer(1)


@checked_names
@dataclass(frozen=True, repr=False)
class MinimumEnergy(Objective):
    """Minimum control energy ∫ uᵀu dt, (40), plus optional state weights.

    The paper's Φ = u² is zero wherever u = 0 and so breaks (27)-(28): Theorem 1 does not
    cover it.  With ``state_weight`` > 0, Φ = uᵀu + w xᵀx, and the theorem applies.
    ``unit`` is the square of the inputs' by default, times s, once it is known of what mechanism.
    """

    name: str = "energy"
    stage: Formula = _squares
    unit: str = ""
    state_weight: float = 0.0

    def __post_init__(self) -> None:
        """Refuse a negative weight, besides what every objective refuses."""
        check_fields(self)
        super().__post_init__()
        positive(
            f"state_weight of objective '{self.name}'",
            self.state_weight,
            "Theorem 1 wants a small positive one; the paper has 0",
            zero=True,
        )

    @checked
    def on(self, mechanism: Mechanism) -> Self:
        """Return the problem as it is for a mechanism: with its travel, and the unit of uᵀu."""
        whole = super().on(mechanism)
        return whole if whole.unit else replace(whole, unit=_energy_unit(mechanism))

    @checked
    def stage_cost(self, mechanism: Mechanism) -> sp.Expr:
        """Return Φ(x, u) = uᵀu + w xᵀx."""
        x = sp.Matrix(mechanism.x)
        return super().stage_cost(mechanism) + self.state_weight * (x.T * x)[0]

    def _words(self) -> str:
        if self.formula or self.stage is not _squares:
            return self.formula
        weight = self.state_weight
        return f"∫ (uᵀu + {weight:g} xᵀx) dt" if weight else "∫ uᵀu dt"


@checked_names
@dataclass(frozen=True, repr=False)
class MinimumTime(Objective):
    """Minimum time to the terminal set, ∫ 1 dt = t_f, (29) and (41)."""

    name: str = "time"
    stage: Formula = _one
    unit: str = "s"
    formula: str = "∫ 1 dt"


def margins_at(
    objective: Objective, mechanism: Mechanism, x: FloatArray, u: FloatArray
) -> list[float]:
    """Return the constraints' margins at a state, (2n,), under an input, (m,); NaN for none."""
    values = zip([*mechanism.x, *mechanism.u], [*x.tolist(), *u.tolist()], strict=True)
    known = mechanism.substitution | dict(values)
    return [real_value(margin.subs(known)) for margin in objective.path_margins(mechanism)]


def real_value(value: sp.Expr) -> float:
    """Return a number as it is, NaN for one that is complex or infinite."""
    return float(value) if value.is_real else math.nan


def _failed(what: str, error: Exception) -> InvalidInputError:
    """A formula of the user's that raised, with what it said and where."""
    return InvalidInputError(
        what,
        value=f"{error_text(error)}{raised_at(error)}",
        limit="a function that returns a SymPy expression of its argument's names",
        remedy="Write it with SymPy's functions, sympy.sin(v.phi) for math.sin or numpy.sin, and "
        "sympy.Piecewise for conditions",
    )


def _lowest(mechanism: Mechanism, stage: sp.Expr) -> float:
    """Return the smallest of a stage cost's values at the target and at 255 random places.

    NaN where one is no number, or that at the target not finite: nothing could end there.
    """
    rng = np.random.default_rng(0)
    symbols = [*mechanism.x, *mechanism.u]
    function = compile_expressions(symbols, [stage.subs(mechanism.substitution)])
    reach = np.ones(len(symbols)) * math.pi
    reach[2 * mechanism.n :] = np.minimum(mechanism.input_limits, 100.0)
    samples = rng.uniform(-1, 1, (256, len(symbols))) * reach
    samples[0] = 0.0  # where most costs are least
    with np.errstate(all="ignore"):
        values = np.broadcast_to(np.real_if_close(function(*samples.T)[0]), len(samples))
    return float(np.min(values)) if np.isfinite(values[0]) else math.nan
