"""Predictions about a target that lies elsewhere, and what may be a target at all.

The error from a set-point has the dynamics of the mechanism itself; what moves with the target are
the constraints, which are about absolute positions: travel, state boxes.  Their shift is a
parameter of the predicted loop, so that a new target compiles nothing.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache

import numpy as np
import sympy as sp

from undertow.base import InvalidInputError
from undertow.closed_loop import ClosedLoop
from undertow.law import ReferenceMotion, Target, target_of
from undertow.models import FloatArray, Mechanism, invariant_coordinates, with_positions
from undertow.objective import Objective
from undertow.optimiser import Optimiser
from undertow.symbolic import compile_expressions

#: When a leg of a target begins, s, and where the target is then.
Legs = tuple[tuple[float, ReferenceMotion], ...]


def legs_of(
    mechanism: Mechanism,
    objective: Objective,
    target: Target | Mapping[str, float],
    seconds: float,
) -> Legs:
    """Return the legs of a target up to ``seconds``, each checked before anything moves.

    Raises
    ------
    InvalidInputError
        For what the mechanism cannot rest at or follow, and for a target that the constraints
        exclude: its terminal set, ‖x − x_r‖ ≤ ν, has to lie inside them.
    """
    legs = target_of(target).legs(mechanism, seconds)
    problem = objective.on(mechanism)
    for constraint, w in zip(problem.constraints, problem.path_margins(mechanism), strict=True):
        margin = w.subs(mechanism.substitution)
        if margin.free_symbols & {*mechanism.u}:
            continue  # what the input is on the way is not known before
        for begin, motion in legs:
            x = np.hstack([motion.q, motion.v])
            values = np.asarray(_compiled(mechanism, margin)(*x.T)[0], dtype=float)
            values = np.broadcast_to(values, len(x))
            worst = int(np.argmin(values))
            if not values[worst] >= objective.terminal_radius:
                state = constraint.state
                value = (
                    f"{state} = {x[worst, mechanism.state_names.index(state)]:.4g}"
                    if state in mechanism.state_names
                    else f"margin {values[worst]:.4g}"
                )
                when = begin + (motion.t[worst] if motion.moves else 0.0)
                raise InvalidInputError(
                    f"target of '{mechanism.name}' at {when:g} s",
                    value=f"{value} {constraint.unit}".rstrip(),
                    limit=f"{constraint.words}, by {objective.terminal_radius:g} or more, the "
                    "radius of the terminal set",
                    remedy="Choose a target further inside, or widen what bounds it",
                )
    return legs


def _compiled(mechanism: Mechanism, margin: sp.Expr):  # type: ignore[no-untyped-def]
    return compile_expressions([*mechanism.x], [margin])


class LoopsAbout:
    """The closed loops of a cascade as they are about targets elsewhere.

    ``names`` are the invariant coordinates that constraints know of: those whose target is a
    parameter.
    """

    def __init__(self, mechanism: Mechanism, objective: Objective) -> None:
        self.mechanism = mechanism
        known = set().union(*(w.free_symbols for w in objective.path_margins(mechanism)))
        symbols = {c.name: c.symbol for c in mechanism.coordinates}
        self.names = tuple(n for n in invariant_coordinates(mechanism) if symbols[n] in known)
        self._places = [mechanism.state_names.index(name) for name in self.names]
        self._bases: dict[object, Mechanism] = {}
        self._prototypes: dict[object, ClosedLoop] = {}
        self.loop = lru_cache(maxsize=8)(self._loop)
        self.optimiser = lru_cache(maxsize=2)(self._optimiser)

    def _mechanism(self, mechanism: Mechanism, positions: FloatArray) -> Mechanism:
        key = mechanism.structure, mechanism.name, mechanism.input_limits.tobytes()
        if key not in self._bases:
            self._bases[key] = with_positions(mechanism, self.names)
        return self._bases[key].with_values(np.append(mechanism.parameter_values, positions))

    def _loop(self, loop: ClosedLoop, q: tuple[float, ...]) -> ClosedLoop:
        """Return a closed loop as it is about the target at the positions q, n numbers."""
        if not self.names:
            return loop
        positions = np.array(q)[self._places]
        believed, ensemble = self._mechanism(loop.mechanism, positions), loop.ensemble
        if ensemble is not None:
            values = np.hstack([ensemble.values, np.tile(positions, (len(ensemble), 1))])
            plant = self._mechanism(ensemble.plant, positions)
            ensemble = replace(ensemble, plant=plant, values=values)
        moved = None if loop.plant is None else self._mechanism(loop.plant, positions)
        key = (
            loop.reaching, loop.step, loop.zoh_steps, loop.rtol, loop.tail_rtol, loop.escape,
            loop.plant, loop.ensemble is None, loop.threads, loop.objective, loop.returning,
        )  # fmt: skip
        if moved is not None or key not in self._prototypes:
            problem = loop.objective.about(self.mechanism, self.names)
            made = replace(
                loop, mechanism=believed, ensemble=ensemble, plant=moved, objective=problem
            )
            return made if moved is not None else self._prototypes.setdefault(key, made)
        return self._prototypes[key].believing(believed, ensemble)

    def _optimiser(self, optimiser: Optimiser, q: tuple[float, ...]) -> Optimiser:
        """Return an optimiser of plans for the target at the positions q."""
        if not self.names:
            return optimiser
        return optimiser.on(self.loop(optimiser.loop, q))
