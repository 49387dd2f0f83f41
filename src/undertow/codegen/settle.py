"""The second phase of a rollout: large steps, once the law is inside its boundary layer.

There ṡ = −(k/ε) s holds exactly, however far the state is from the target, so that what the
linear model A leaves over, r(x) = ẋ − A x, is not stiff: it is of third order and slow.  An
exponential Runge-Kutta method of second order (ETD2RK; Cox and Matthews, J. Comput. Phys. 176,
2002) takes A exactly and r by

    a = e^{Ah} x + F(h) r(x),   x₊ = a + G(h) (r(a) − r(x)),
    F(h) = ∫₀ʰ e^{As} ds,       G(h) = ∫₀ʰ e^{A(h−s)} s/h ds.

Each lane has a step of its own, a power of two of the unit, that keeps the last term small in
the norm of V = xᵀPx.  With AᵀP + PA = −Q the cost is V(x) − V(x₊) + ∫ (Φ + V̇) dt, whose
integrand is of fourth order: the trapezoidal rule does.  A lane is done when r can no longer
matter: V changes by at most ∫ 2|Px|ᵀ|r| dt because of it, and |Px|ᵀ|r| decays faster than the
slowest mode, e^{−σt}, so that 2|Px|ᵀ|r| ≤ δ σ V leaves a part δ.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from undertow.codegen.linear import SETTLING, UNIT
from undertow.codegen.rows import LANES, Rows

__all__ = ["MOST", "begin_settling", "choose_step", "end_settling", "settling_step"]

#: Steps that a lane may take.
MOST = 4000

#: Largest correction in one step, and part of the cost that the rest may change, both as parts
#: of the tolerance.
CORRECTION, REST = 0.2, 0.2


def _sum(terms: Iterable[str]) -> str:
    return " + ".join(terms)


def _level(r: Rows, x: Sequence[str]) -> list[str]:
    """V = xᵀPx and p = P x."""
    size = len(x)
    return [
        *(
            f"p_{j} = " + _sum(f"{e} * {x[k]}" for k, e in enumerate(r.value[j]))
            for j in range(size)
        ),
        "level = " + _sum(f"p_{j} * {x[j]}" for j in range(size)),
    ]


def begin_settling(r: Rows) -> list[str]:
    """Lanes that handed over begin with the smallest step; their costs include V."""
    return [f"x_{j} = {row}" for j, row in enumerate(r.x)] + [
        *_level(r, [f"x_{j}" for j in range(len(r.x))]),
        f"begins = {r.code} == -1.0",
        f"{r.active} = 1.0 if begins else 0.0",
        f"{r.cost} = {r.cost} + counted * level if begins else {r.cost}",
        f"{r.span} = {UNIT}",
        f"{r.power} = 0.0",
        f"{r.changed} = {r.active}",
        f"{r.recent} = math.inf",
    ]


def choose_step(r: Rows) -> str:
    """Fetch what a step of another length needs, for the lanes that change theirs.

    Not a loop of vectors: which lanes change, and to which power, is different for each.
    """
    size = len(r.x)
    n = size // 2
    parts = [
        (r.flow, "powers[block, power, ", 0),
        (r.force, "forced[block, power, 0, ", n),
        (r.rise, "forced[block, power, 1, ", n),
    ]
    lines = [
        f"{row} = {source}{(j * size + first + k) * LANES} + i]"
        for matrix, source, first in parts
        for j, rows in enumerate(matrix)
        for k, row in enumerate(rows)
    ]
    body = "\n".join(f"        {line}" for line in lines)
    return f"""\
for lane in range({LANES}):
    i = lane
    if {r.changed} > 0.0:
        power = int({r.power})
{body}
"""


def settling_step(
    r: Rows, at_x: Sequence[str], at_end: Sequence[str], rates: Sequence[str], stage: str
) -> list[str]:
    """One step of every lane that settles.

    Parameters
    ----------
    r
        Rows of the work array.
    at_x, at_end
        Lines that evaluate law and plant at ``r.x`` and at ``r.stage_x``.
    rates, stage
        What these lines call the time derivatives of the state and the stage cost.
    """
    size = len(r.x)
    n = size // 2
    x = [f"x_{j}" for j in range(size)]
    half = range(n)

    def linear(j: int, of: str) -> str:
        return _sum(f"{e} * {of}_{k}" for k, e in enumerate(r.linear[j]))

    return [
        *at_x,
        *(f"x_{j} = {row}" for j, row in enumerate(r.x)),
        *(f"f_{j} = {rate}" for j, rate in enumerate(rates)),
        *_level(r, x),
        *(f"q_{j} = f_{n + j} - ({linear(j, 'x')})" for j in half),
        "residual = 2.0 * (" + _sum(f"abs(p_{n + j} * q_{j})" for j in half) + ")",
        "bend = "
        + stage
        + " + 2.0 * counted * ("
        + _sum(f"p_{j} * f_{j}" for j in range(size))
        + ")",
        "free = " + " & ".join(f"(abs(u_{j}) < _limit_{j})" for j in range(len(r.u))),
        *(
            f"a_{j} = "
            + _sum(f"{e} * x_{k}" for k, e in enumerate(r.flow[j]))
            + " + "
            + _sum(f"{e} * q_{k}" for k, e in enumerate(r.force[j]))
            for j in range(size)
        ),
        *(f"{row} = a_{j}" for j, row in enumerate(r.stage_x)),
        *at_end,
        *(f"f_{j} = {rate}" for j, rate in enumerate(rates)),
        *(f"y_{j} = f_{n + j} - ({linear(j, 'a')}) - q_{j}" for j in half),
        *_level(r, [f"a_{j}" for j in range(size)]),
        "bend = 0.5 * (bend + "
        + stage
        + " + 2.0 * counted * ("
        + _sum(f"p_{j} * f_{j}" for j in range(size))
        + "))",
        "high = level",
        *(f"c_{j} = " + _sum(f"{e} * y_{k}" for k, e in enumerate(r.rise[j])) for j in range(size)),
        *_level(r, [f"c_{j}" for j in range(size)]),
        f"small = ({CORRECTION} * tail) * ({CORRECTION} * tail) * high",
        *(f"a_{j} = a_{j} + c_{j}" for j in range(size)),
        "outer = math.sqrt(" + _sum(f"a_{j} * a_{j}" for j in range(size)) + ")",
        f"span, size, going = {r.span}, {r.power}, {r.active} > 0.0",
        "sound = free & (outer < escape) & ((size > 0.0) | (level <= 16.0 * small))",
        "inside = outer < terminal",
        "taken = going & sound & ((size <= 0.0) | ((level <= small) & (not inside)))",
        # Where the chord of the radius meets that of the terminal set.
        f"part = ({r.radius} - terminal) / ({r.radius} - outer) if inside else 1.0",
        *(
            f"{row} = x_{j} + part * (a_{j} - x_{j}) if taken else x_{j}"
            for j, row in enumerate(r.x)
        ),
        f"cost = {r.cost} + part * span * bend if taken else {r.cost}",
        f"end = {r.end} + part * span if taken else {r.end}",
        f"radius = (terminal if inside else outer) if taken else {r.radius}",
        "up = taken & (64.0 * level <= small) & (size < " + f"{SETTLING - 1}.0)",
        "down = going & (not taken) & (size > 0.0)",
        f"{r.power} = size + (1.0 if up else (-1.0 if down else 0.0))",
        f"{r.span} = span * (2.0 if up else (0.5 if down else 1.0))",
        f"{r.changed} = 1.0 if up | down else 0.0",
        f"recent = max(residual, 0.5 * {r.recent}) if taken else {r.recent}",
        "total = cost if counted > 0.0 else high",
        f"calm = recent <= {r.rate} * ({REST} * tail * total + slack)",
        "near = (radius <= 1.5 * terminal) | calm | (end >= until)",
        f"{r.recent} = recent",
        f"{r.cost} = cost",
        f"{r.end} = end",
        f"{r.radius} = radius",
        f"code = {r.code}",
        f"{r.code} = -2.0 if going & (not sound) else code",
        f"{r.active} = 1.0 if going & sound & (not (taken & near)) else 0.0",
    ]


def end_settling(r: Rows) -> list[str]:
    """Take V out of the costs again; lanes that are not done yet are not done by this way."""
    return [
        *(f"x_{j} = {row}" for j, row in enumerate(r.x)),
        *_level(r, [f"x_{j}" for j in range(len(r.x))]),
        f"code, active = {r.code}, {r.active}",
        f"{r.cost} = {r.cost} - counted * level if code == -1.0 else {r.cost}",
        f"{r.code} = -2.0 if active > 0.0 else code",
    ]
