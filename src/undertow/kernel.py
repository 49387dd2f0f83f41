"""The closed loop on one tape, and the compiled kernel that integrates it in blocks."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import sympy as sp

from undertow.codegen.block import block_source
from undertow.codegen.rows import LANES, LoopProgram
from undertow.codegen.store import content_key, generators, load_module, recall, remember
from undertow.codegen.tape import Tape
from undertow.mechanism import TIME, Mechanism
from undertow.objective import Objective
from undertow.sliding import LawSymbols, Switching, lay_law

__all__ = ["compile_loop", "lay_loop"]


def lay_loop(
    belief: Mechanism, plant: Mechanism | None, objective: Objective, switching: Switching
) -> LoopProgram:
    """Compose law, plant and objective on one tape.

    With ``plant=None`` both share symbols, so everything they have in common is computed
    once; otherwise the belief keeps its own parameter symbols.
    """
    tape = Tape()
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
    law = lay_law(belief.partition(tape, rename), x, symbols, switching, belief.disturbance_bounds)
    applied = tuple(sp.Symbol(f"_applied_{i}", real=True) for i in range(truth.m))
    limits = tuple(sp.Symbol(f"_limit_{i}", real=True) for i in range(truth.m))
    inputs = dict(zip(truth.u, applied, strict=True))
    qdd = truth.partition(tape).accelerations(sp.Matrix(applied))
    stage, *path = tape.let_all(
        [e.xreplace(inputs) for e in (objective.stage_cost(truth), *objective.path_margins(truth))]
    )
    input_margin = None
    if objective.hard_input:
        margins = [limit - sp.Abs(d) for limit, d in zip(limits, law.u, strict=True)]
        input_margin = tape.let(sp.Min(*margins))
    return LoopProgram(
        tape=tape,
        time=TIME,
        state=x,
        applied=applied,
        limits=limits,
        plant_parameters=truth.parameter_symbols,
        belief_parameters=belief_parameters,
        lane_inputs=(*symbols.surface, *symbols.eta, *symbols.layer, symbols.gamma_target),
        demand=tuple(law.u),
        s=tuple(law.s),
        singular=law.margin,
        derivative=(*x[truth.n :], *qdd),
        stage=stage,
        path=tuple(path),
        input_margin=input_margin,
        boxes=objective.boxes(truth),
    )


#: The files that write kernels: a kept source is theirs no more once one of them changes.
GENERATOR = generators(
    "arguments.py",
    "kernel.py",
    "objective.py",
    "sliding.py",
    "validity.py",
    "codegen/block.py",
    "codegen/linear.py",
    "codegen/rows.py",
    "codegen/settle.py",
    "codegen/vector.py",
)


@lru_cache(maxsize=64)
def compile_loop(
    belief: Mechanism,
    plant: Mechanism | None,
    objective: Objective,
    switching: Switching,
    sampled: bool,
) -> Any:
    """Return the kernel of a closed loop, from the cache where it is known.

    A module with the functions ``rollout`` and, for continuous loops, ``settle``; each is
    compiled when it is first called.
    """
    truth = belief if plant is None else plant
    key = content_key(
        belief.structure,
        "the belief" if plant is None else plant.structure,
        sp.srepr([objective.stage_cost(truth), *objective.path_margins(truth)]),
        repr((belief.name, objective.name, objective.hard_input, switching, sampled, LANES)),
        repr(objective.boxes(truth)),
        sources=GENERATOR,
    )
    source = recall("loop", key)
    if source is None:
        program = lay_loop(belief, plant, objective, switching)
        source = block_source(
            program,
            sampled=sampled,
            header=f"Closed loop of {belief.name}, {objective.name}; generated, do not edit.",
        )
        remember("loop", key, source)
    return load_module(f"loop_{belief.name}", source)
