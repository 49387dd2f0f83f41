"""The closed loop on one tape, and the compiled kernel that integrates it in blocks."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import sympy as sp

from undertow.closed_loop.adaptive_integrator import look_source
from undertow.closed_loop.kernel_source import kernel_source
from undertow.closed_loop.work_array import LANES, LoopGraph
from undertow.law import LawSymbols, Switching, build_law_graph
from undertow.models import TIME, Mechanism
from undertow.objective import Objective
from undertow.symbolic import Tape, content_key, generated


class LoopEquations(NamedTuple):
    """What a closed loop's kernels are written from: all of it but the values of its numbers.

    Without a ``plant`` belief and plant share symbols, so everything they have in common is
    computed once; otherwise the belief keeps its own parameter symbols.  With ``many_plants`` each
    lane brings the parameters of its plant.
    """

    belief: Mechanism
    plant: Mechanism | None
    objective: Objective
    switching: Switching
    sampled: bool = False
    many_plants: bool = False

    @property
    def truth(self) -> Mechanism:
        """The plant that moves."""
        return self.belief if self.plant is None else self.plant

    @property
    def slides(self) -> bool:
        """Whether the law is discontinuous and acts in continuous time: it does not chatter."""
        return self.switching == "sign" and not self.sampled

    @property
    def key(self) -> str:
        """What tells the kernels' source from any other, for the cache on disk."""
        truth, objective = self.truth, self.objective
        return content_key(
            self.belief.structure,
            "the belief" if self.plant is None else self.plant.structure,
            sp.srepr([objective.stage_cost(truth), *objective.path_margins(truth)]),
            repr((self.belief.name, objective.name, objective.hard_input, self.switching,
                  self.sampled, LANES)),
            "many plants" if self.many_plants else "",
            repr(objective.boxes(truth)),
        )  # fmt: skip


def build_loop_graph(loop: LoopEquations) -> LoopGraph:
    """Compose law, plant and objective on one tape.

    Unless it is sampled, a discontinuous law acts in continuous time: it slides, and its lanes
    bring the length of a step in the places of ε.
    """
    belief, truth, objective = loop.belief, loop.truth, loop.objective
    x = truth.x
    rename: dict[sp.Symbol, sp.Expr] = dict(zip(belief.x, x, strict=True))
    belief_parameters: tuple[sp.Symbol, ...] = ()
    if loop.plant is not None:
        belief_parameters = tuple(
            sp.Symbol(f"_belief_{s}", real=True) for s in belief.parameter_symbols
        )
        rename |= dict(zip(belief.parameter_symbols, belief_parameters, strict=True))
    symbols = LawSymbols.of(belief.n, belief.m)
    applied = tuple(sp.Symbol(f"_applied_{i}", real=True) for i in range(truth.m))
    limits = tuple(sp.Symbol(f"_limit_{i}", real=True) for i in range(truth.m))
    plant_parameters = () if loop.many_plants else truth.parameter_symbols
    lane_inputs = (*symbols.vector, *(truth.parameter_symbols if loop.many_plants else ()))
    tape = Tape([*plant_parameters, *belief_parameters, *limits, *lane_inputs])
    law = build_law_graph(
        belief.partition(tape, rename), x, symbols, loop.switching, belief.disturbance_bounds,
        implicit=loop.slides,
    )  # fmt: skip
    inputs = dict(zip(truth.u, applied, strict=True))
    qdd = truth.partition(tape).accelerations(sp.Matrix(applied))
    stage, *path = tape.let_all(
        [e.xreplace(inputs) for e in (objective.stage_cost(truth), *objective.path_margins(truth))]
    )
    input_margin = None
    if objective.hard_input:
        margins = [limit - sp.Abs(d) for limit, d in zip(limits, law.u, strict=True)]
        input_margin = tape.let(sp.Min(*margins))
    return LoopGraph(
        tape=tape,
        time=TIME,
        state=x,
        applied=applied,
        limits=limits,
        plant_parameters=plant_parameters,
        belief_parameters=belief_parameters,
        lane_inputs=lane_inputs,
        demand=tuple(law.u),
        s=tuple(law.s),
        singular=law.margin,
        derivative=(*x[truth.n :], *qdd),
        stage=stage,
        path=tuple(path),
        input_margin=input_margin,
        boxes=objective.boxes(truth),
        sampled=loop.sampled,
    )


@lru_cache(maxsize=64)
def compile_loop(loop: LoopEquations) -> Any:
    """Return the kernel of a closed loop, from the cache where it is known.

    A module with the functions ``rollout`` and, for continuous loops, ``etd_integrate``; each is
    compiled when it is first called.
    """
    return _generated("loop", kernel_source, loop)


@lru_cache(maxsize=64)
def compile_look(loop: LoopEquations) -> Any:
    """Return a closed loop as :func:`undertow.closed_loop.adaptive_integrator.follow` wants it.

    A module with the functions ``look`` and ``decide``, compiled.
    """
    return _generated("look", look_source, loop)


def _generated(kind: str, source: Callable[..., str], loop: LoopEquations) -> Any:
    name = loop.belief.name

    def write() -> str:
        header = f"Closed loop of {name}, {loop.objective.name}; generated, do not edit."
        return source(build_loop_graph(loop), header=header)

    return generated(kind, name, loop.key, write)
