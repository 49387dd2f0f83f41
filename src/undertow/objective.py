"""Objectives: what is best. Stage cost, horizon, terminal set, constraints, (21)-(31).

A stage cost Φ(x, u) and constraints w(x, u) ≤ 0 are SymPy expressions of the mechanism's
own names, so they are compiled into the kernel with the rest of the loop.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import sympy as sp

from undertow.codegen.vector import compile_expressions
from undertow.errors import InvalidInputError
from undertow.mechanism import FloatArray, Mechanism

__all__ = [
    "Constraint",
    "MinimumEnergy",
    "MinimumTime",
    "Names",
    "Objective",
    "state_box",
]


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
        if name in symbols:
            return symbols[name]
        message = f"no state, input or parameter '{name}'; there are {', '.join(symbols)}"
        raise AttributeError(message, name=name, obj=self)


Formula = Callable[[Names], Any]

_REMEDIES = {
    "horizon": "Give the longest motion worth waiting for, s",
    "terminal_radius": "Motions end in a small ball around the target; the paper's is 0.01",
}


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

    Notes
    -----
    *Where it is tested.*  A rollout tests w at the start of each of its small Runge-Kutta steps,
    ``ClosedLoop.step`` apart (2 ms unless told otherwise), at the state and the input applied
    there; nothing is tested between them, and a loop with constraints takes no large steps.  A
    motion stops at the first test that fails.  The state at its end, where it enters the terminal
    set or the horizon is over, is tested no more.

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
        low, high = bound if isinstance(bound, tuple) else (-bound, bound)
        if not (math.isfinite(low) and math.isfinite(high) and low < 0 < high):
            alone = not isinstance(bound, tuple)
            raise InvalidInputError(
                f"bound of state '{name}'",
                value=bound,
                limit="finite and > 0" if alone else "finite, low < 0 < high",
                remedy="The box is |state| ≤ bound, or low ≤ state ≤ high around the target; leave "
                "out states without a bound",
            )
        middle, half = (low + high) / 2, (high - low) / 2
        words = f"|{name}| ≤ {high:g}" if middle == 0 else f"{low:g} ≤ {name} ≤ {high:g}"
        return Constraint(words, lambda v: sp.Abs(getattr(v, name) - middle) - half)

    return tuple(bounded(name, bound) for name, bound in bounds.items())


@dataclass(frozen=True)
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

    def __post_init__(self) -> None:
        """Refuse a horizon or terminal radius that is not positive and finite."""
        for field in ("horizon", "terminal_radius"):
            value = getattr(self, field)
            if not (math.isfinite(value) and value > 0):
                raise InvalidInputError(
                    f"{field} of objective '{self.name}'",
                    value=value,
                    limit="finite and > 0",
                    remedy=_REMEDIES[field],
                )

    def stage_cost(self, mechanism: Mechanism) -> sp.Expr:
        """Return Φ(x, u) as an expression.

        Raises
        ------
        InvalidInputError
            For unknown names, and where Φ is negative or no number at one of 256 random
            states and inputs.
        """
        what = f"stage cost of '{self.name}'"
        stage = self._expression(mechanism, what, self.stage)
        lowest = _lowest(mechanism, stage)
        if not lowest >= 0:
            raise InvalidInputError(
                what,
                value=f"{lowest:.3g} for some states and inputs",
                limit="≥ 0 everywhere: (21) is a cost that only grows",
                remedy="Use squares or moduli",
            )
        return stage

    def path_margins(self, mechanism: Mechanism) -> list[sp.Expr]:
        """Return −w(x, u) of every constraint: signed margins, ≥ 0 is satisfied."""
        return [
            -self._expression(mechanism, f"constraint '{c.name}'", c.formula)
            for c in self.constraints
        ]

    def check_start(self, mechanism: Mechanism, x: FloatArray) -> None:
        """Refuse an initial state that breaks a path constraint, whatever the input does.

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
        values = mechanism.substitution | dict(zip(mechanism.x, x.tolist(), strict=True))
        for constraint, margin in zip(self.constraints, self.path_margins(mechanism), strict=True):
            at_start = margin.subs(values)
            if at_start.is_number and float(at_start) < 0:
                raise InvalidInputError(
                    f"initial state of '{mechanism.name}' breaks '{constraint.name}'",
                    value=f"margin {float(at_start):.4g} {constraint.unit}".rstrip(),
                    limit="≥ 0",
                    remedy="Start inside the constraints, or widen them",
                )

    @staticmethod
    def _expression(mechanism: Mechanism, what: str, formula: Formula) -> sp.Expr:
        try:
            value = formula(Names(mechanism))
        except AttributeError as error:
            raise InvalidInputError(
                f"{what} for '{mechanism.name}'",
                value=f"'{error.name}'",
                limit=f"among {', '.join(Names(mechanism))}",
                remedy="Use the mechanism's own names",
            ) from error
        if isinstance(value, sp.MatrixBase) and value.shape == (1, 1):
            value = value[0, 0]
        expression = sp.sympify(value)
        allowed = {*mechanism.x, *mechanism.u, *mechanism.parameter_symbols}
        if (
            not isinstance(expression, sp.Expr)
            or isinstance(expression, sp.MatrixBase)  # which SymPy counts as an expression
            or expression.free_symbols - allowed
        ):
            raise InvalidInputError(
                what,
                value=expression,
                limit="one expression in the mechanism's states and inputs",
                remedy="Take symbols from the argument: lambda v: v.phi**2",
            )
        return expression


@dataclass(frozen=True)
class MinimumEnergy(Objective):
    """Minimum control energy ∫ uᵀu dt, (40), plus optional state weights.

    The paper's Φ = u² is zero wherever u = 0 and so breaks (27)-(28): Theorem 1 does not
    cover it.  With ``state_weight`` > 0, Φ = uᵀu + w xᵀx, and the theorem applies.
    ``unit`` is that of voltage inputs; pass another one for forces or torques.
    """

    name: str = "energy"
    stage: Formula = lambda v: (v.inputs.T * v.inputs)[0]
    unit: str = "V² s"
    state_weight: float = 0.0

    def __post_init__(self) -> None:
        """Refuse a negative weight, besides what every objective refuses."""
        super().__post_init__()
        if not (math.isfinite(self.state_weight) and self.state_weight >= 0):
            raise InvalidInputError(
                f"state_weight of objective '{self.name}'",
                value=self.state_weight,
                limit="finite and ≥ 0",
                remedy="Theorem 1 wants a small positive one; the paper has 0",
            )

    def stage_cost(self, mechanism: Mechanism) -> sp.Expr:
        """Return Φ(x, u) = uᵀu + w xᵀx."""
        x = sp.Matrix(mechanism.x)
        return super().stage_cost(mechanism) + self.state_weight * (x.T * x)[0]


@dataclass(frozen=True)
class MinimumTime(Objective):
    """Minimum time to the terminal set, ∫ 1 dt = t_f, (29) and (41)."""

    name: str = "time"
    stage: Formula = lambda v: sp.Integer(1)
    unit: str = "s"


def _lowest(mechanism: Mechanism, stage: sp.Expr) -> float:
    """Return the smallest of 256 random values of a stage cost; NaN where one is no number."""
    rng = np.random.default_rng(0)
    symbols = [*mechanism.x, *mechanism.u]
    function = compile_expressions(symbols, [stage.subs(mechanism.substitution)])
    reach = np.ones(len(symbols)) * math.pi
    reach[2 * mechanism.n :] = np.minimum(mechanism.input_limits, 100.0)
    samples = rng.uniform(-1, 1, (256, len(symbols))) * reach
    with np.errstate(all="ignore"):
        return float(np.min(np.real_if_close(function(*samples.T)[0])))
