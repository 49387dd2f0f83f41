"""Many plants in lanes, each driven by an input of its own that is held: states and costs.

What :mod:`undertow.closed_loop.kernel_source` is for closed loops this is for plants whose inputs
come from outside: a straight-line body over the lanes of a block, which LLVM turns into vector
instructions.  A lane computes the same bits wherever it lies, alone or among thousands.
"""

from __future__ import annotations

import textwrap
from functools import lru_cache
from typing import Any

import sympy as sp

from undertow.closed_loop import LANES
from undertow.models import TIME, Mechanism
from undertow.objective import Objective
from undertow.symbolic import (
    PRIMITIVES,
    Emitter,
    Tape,
    content_key,
    docstring,
    generated,
)

#: Runge-Kutta's fourth-order step: weights of its stages, how far each goes on, and when it is.
_STAGES = ((1.0, 0.5, 0.0), (2.0, 0.5, 0.5), (2.0, 1.0, 0.5), (1.0, 0.0, 1.0))


@lru_cache(maxsize=64)
def driven_plants(mechanism: Mechanism, objective: Objective) -> Any:
    """Return a compiled module with ``advance(x, u, t, cost, margin, plant, h, steps)``.

    Moves states x, (2n, P), in place by so many Runge-Kutta steps of h, s, under inputs u, (m, P);
    P is a multiple of the lanes.  t, (P,), are the times at the start, s; ``plant`` the values of
    the parameters.  ``cost``, (P,), becomes what the steps cost, ``margin``, (P,), the smallest
    margin of the path constraints at their end, infinite where there are none.
    """
    stage, margins = objective.stage_cost(mechanism), objective.path_margins(mechanism)
    key = content_key(mechanism.structure, sp.srepr([stage, *margins]), str(LANES))
    header = f"Plants of {mechanism.name}, {objective.name}; generated, do not edit. {key[:16]}"
    return generated(
        "plants", mechanism.name, key, lambda: _source(mechanism, stage, margins, header)
    )


def _source(mechanism: Mechanism, stage: sp.Expr, margins: list[sp.Expr], header: str) -> str:
    n, m, tape = mechanism.n, mechanism.m, Tape()
    qdd = list(mechanism.partition(tape).accelerations(sp.Matrix(mechanism.u)))
    cost, margin = tape.let_all([stage, sp.Min(*margins)])
    emit = Emitter(tape)
    x, at, slope, u = (
        [f"{name}_{j}" for j in range(size)]
        for name, size in (("x", 2 * n), ("at", 2 * n), ("slope", 2 * n), ("u", m))
    )
    rows = [*x, "cost", *at, *slope, "cost_slope", *u, "t"]
    row = {name: f"W[{index * LANES} + i]" for index, name in enumerate(rows)}

    def loads(needs: set[sp.Symbol], states: list[str]) -> list[str]:
        where = {
            **dict(zip(mechanism.x, (row[name] for name in states), strict=True)),
            **dict(zip(mechanism.u, (row[name] for name in u), strict=True)),
            TIME: f"{row['t']} + into",
        }
        return [f"{emit.text(s)} = {text}" for s, text in where.items() if s in needs]

    code, needs = emit.lines([*qdd, cost], set())
    rates = [emit.text(rate) for rate in (*mechanism.x[n:], *qdd)]
    needs |= {*mechanism.x[n:]}
    stages = [
        *loads(needs, at),
        *code,
        *(f"d_{j} = {rate}" for j, rate in enumerate(rates)),
        *(f"{row[s]} = {row[s]} + weight * d_{j}" for j, s in enumerate(slope)),
        *(
            f"{row[a]} = {row[b]} + reach * d_{j}"
            for j, (a, b) in enumerate(zip(at, x, strict=True))
        ),
        f"{row['cost_slope']} = {row['cost_slope']} + weight * ({emit.text(cost)})",
    ]
    begin = [
        *(f"{row[s]} = 0.0" for s in (*slope, "cost_slope")),
        *(f"{row[a]} = {row[b]}" for a, b in zip(at, x, strict=True)),
    ]
    finish = [
        *(f"{row[b]} = {row[b]} + sixth * {row[s]}" for b, s in zip(x, slope, strict=True)),
        f"{row['cost']} = {row['cost']} + sixth * {row['cost_slope']}",
    ]
    seen, seen_needs = emit.lines([margin], set())
    take = [
        *(f"{row[name]} = x[{j}, b + i]" for j, name in enumerate(x)),
        *(f"{row[name]} = u[{j}, b + i]" for j, name in enumerate(u)),
        f"{row['t']} = t[b + i]",
        f"{row['cost']} = 0.0",
    ]
    give = [
        *(f"x[{j}, b + i] = {row[name]}" for j, name in enumerate(x)),
        f"cost[b + i] = {row['cost']}",
        *loads(seen_needs, x),
        *seen,
        f"margin[b + i] = {emit.text(margin) if margins else 'math.inf'}",
    ]
    constants = [f"{emit.text(s)} = plant[{j}]" for j, s in enumerate(mechanism.parameter_symbols)]
    table = ", ".join(str(part) for part in zip(*_STAGES, strict=True))
    return f"""{docstring(header)}import math

import numpy as np
{PRIMITIVES}

@compiled(fastmath={{"contract", "nsz", "arcp"}})
def advance(x, u, t, cost, margin, plant, h, steps):
{_lines(constants, 1)}
    weights, reaches, places = {table}
    sixth = h / 6.0
    W = memory({len(rows) * LANES})
    for b in range(0, x.shape[1], {LANES}):
{_loop(take, 2)}
        for step in range(steps):
{_loop(begin, 3)}
            for rk in range(4):
                weight, reach = weights[rk], reaches[rk] * h
                into = (step + places[rk]) * h
{_loop(stages, 4)}
{_loop(finish, 3)}
        into = steps * h
{_loop(give, 2)}
"""


def _lines(lines: list[str], depth: int) -> str:
    return textwrap.indent("\n".join(lines), "    " * depth)


def _loop(lines: list[str], depth: int) -> str:
    """Return a loop over the lanes of a block around ``lines``, indented."""
    head = "    " * depth + f"for i in range({LANES}):\n"
    return head + _lines(lines, depth + 1)
