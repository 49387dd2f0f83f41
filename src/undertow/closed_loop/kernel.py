"""The closed loop on one tape, and the compiled kernel that integrates it in blocks."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import sympy as sp

from undertow.closed_loop.adaptive_integrator import look_source
from undertow.closed_loop.kernel_source import kernel_source
from undertow.closed_loop.work_array import LANES, LoopGraph
from undertow.law import LawSymbols, Switching, build_law_graph
from undertow.models import TIME, Mechanism
from undertow.objective import Objective
from undertow.symbolic import Tape, content_key, generated


def slides(switching: Switching, *, sampled: bool) -> bool:
    """Whether a law is discontinuous and acts in continuous time: it does not chatter."""
    return switching == "sign" and not sampled


def build_loop_graph(
    belief: Mechanism,
    plant: Mechanism | None,
    objective: Objective,
    switching: Switching,
    *,
    sampled: bool = False,
    many_plants: bool = False,
) -> LoopGraph:
    """Compose law, plant and objective on one tape.

    With ``plant=None`` both share symbols, so everything they have in common is computed
    once; otherwise the belief keeps its own parameter symbols.  With ``many_plants`` each lane
    brings the parameters of its plant.  Unless it is ``sampled``, a discontinuous law acts in
    continuous time: it slides, and its lanes bring the length of a step in the places of ε.
    """
    truth = belief if plant is None else plant
    x = truth.x
    rename: dict[sp.Symbol, sp.Expr] = dict(zip(belief.x, x, strict=True))
    belief_parameters: tuple[sp.Symbol, ...] = ()
    if plant is not None:
        belief_parameters = tuple(
            sp.Symbol(f"_belief_{s}", real=True) for s in belief.parameter_symbols
        )
        rename |= dict(zip(belief.parameter_symbols, belief_parameters, strict=True))
    symbols = LawSymbols.of(belief.n, belief.m)
    applied = tuple(sp.Symbol(f"_applied_{i}", real=True) for i in range(truth.m))
    limits = tuple(sp.Symbol(f"_limit_{i}", real=True) for i in range(truth.m))
    plant_parameters = () if many_plants else truth.parameter_symbols
    lane_inputs = (*symbols.vector, *(truth.parameter_symbols if many_plants else ()))
    tape = Tape([*plant_parameters, *belief_parameters, *limits, *lane_inputs])
    law = build_law_graph(
        belief.partition(tape, rename), x, symbols, switching, belief.disturbance_bounds,
        implicit=slides(switching, sampled=sampled),
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
    )


@lru_cache(maxsize=64)
def compile_loop(
    belief: Mechanism,
    plant: Mechanism | None,
    objective: Objective,
    switching: Switching,
    sampled: bool,
    many_plants: bool = False,
) -> Any:
    """Return the kernel of a closed loop, from the cache where it is known.

    A module with the functions ``rollout`` and, for continuous loops, ``etd_integrate``; each is
    compiled when it is first called.
    """
    given = belief, plant, objective, switching, sampled, many_plants
    return _generated("loop", kernel_source, *given)


@lru_cache(maxsize=64)
def compile_look(
    belief: Mechanism,
    plant: Mechanism | None,
    objective: Objective,
    switching: Switching,
    sampled: bool,
) -> Any:
    """Return a closed loop as :func:`undertow.closed_loop.adaptive_integrator.follow` wants it.

    A module with the functions ``look`` and ``decide``, compiled.
    """
    return _generated("look", look_source, belief, plant, objective, switching, sampled, False)


def _generated(
    kind: str,
    source: Callable[..., str],
    belief: Mechanism,
    plant: Mechanism | None,
    objective: Objective,
    switching: Switching,
    sampled: bool,
    many_plants: bool,
) -> Any:
    truth = belief if plant is None else plant
    key = content_key(
        belief.structure,
        "the belief" if plant is None else plant.structure,
        sp.srepr([objective.stage_cost(truth), *objective.path_margins(truth)]),
        repr((belief.name, objective.name, objective.hard_input, switching, sampled, LANES)),
        "many plants" if many_plants else "",
        repr(objective.boxes(truth)),
    )

    def write() -> str:
        program = build_loop_graph(
            belief, plant, objective, switching, sampled=sampled, many_plants=many_plants
        )
        header = f"Closed loop of {belief.name}, {objective.name}; generated, do not edit."
        return source(program, sampled=sampled, header=header)

    return generated(kind, belief.name, key, write)
