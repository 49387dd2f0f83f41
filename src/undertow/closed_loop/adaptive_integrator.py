"""Motions one by one, to a tolerance: steps that adapt, and end where the law has a corner.

The pair of Dormand and Prince, 5(4) (J. Comput. Appl. Math. 6, 1980): the error of each step, as
the two orders differ, stays below rtol ‖x‖₂, near the target below rtol ν, and that of the cost
below rtol of the cost so far.  Such estimates are for smooth right-hand sides, and the law has
corners: at the edge of the boundary layer, where an input meets its limit or leaves it.  A step at
whose two ends something else holds is bisected until it ends just beyond the corner; in the same
way a motion ends at the moment when it arrives, loses the law or breaks a constraint.  One that
dips into the terminal set and leaves it within a step has arrived, too; constraints are also looked
at on the way, at the instants that are recorded.

What :mod:`.kernel_source` does for thousands of motions in steps of one length is done here for the
few that are shown, and that decide.  A mechanism's part is one function, :func:`look_source`; the
rest is compiled once for all of them.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
import sympy as sp

from undertow.closed_loop.trajectory import Event
from undertow.closed_loop.work_array import LoopGraph
from undertow.symbolic import PREAMBLE, PRIMITIVES, Emitter, compiled, docstring, numba

#: Dormand and Prince: stages, the last of which is the step; its error; when each stage is.
STAGES = np.array([
    [0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
    [1 / 5, 0.0, 0.0, 0.0, 0.0, 0.0],
    [3 / 40, 9 / 40, 0.0, 0.0, 0.0, 0.0],
    [44 / 45, -56 / 15, 32 / 9, 0.0, 0.0, 0.0],
    [19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729, 0.0, 0.0],
    [9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656, 0.0],
    [35 / 384, 0.0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84],
])  # fmt: skip
ERROR = np.array([71 / 57600, 0.0, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40])
WHEN = np.array([0.0, 1 / 5, 3 / 10, 4 / 5, 8 / 9, 1.0, 1.0])
#: Their interpolant of fourth order (Shampine, Math. Comp. 46, 1986): powers of the part of a step,
#: for each stage.
BETWEEN = np.array([
    [1.0, -8048581381 / 2820520608, 8663915743 / 2820520608, -12715105075 / 11282082432],
    [0.0, 0.0, 0.0, 0.0],
    [0.0, 131558114200 / 32700410799, -68118460800 / 10900136933, 87487479700 / 32700410799],
    [0.0, -1754552775 / 470086768, 14199869525 / 1410260304, -10690763975 / 1880347072],
    [0.0, 127303824393 / 49829197408, -318862633887 / 49829197408, 701980252875 / 199316789632],
    [0.0, -282668133 / 205662961, 2019193451 / 616988883, -1453857185 / 822651844],
    [0.0, 40617522 / 29380423, -110615467 / 29380423, 69997945 / 29380423],
])  # fmt: skip

#: Corners are located to this part of a step of the loop.
CORNER = 1e-10
#: No step is shortened for its error to less than this part of a step of the loop.
LEAST = 1 / 256
#: What a length may exceed a whole number of steps by, for rounding, as a part of it.
WHOLE = 1e-12
#: Steps of the loop after which constraints are looked at where nothing is recorded.
PACE = 2

#: Events as plain numbers, for compiled code.
_HORIZON, _REACHED, _CONSTRAINT, _SINGULAR, _DIVERGED, _COSTLY, _UNSTABLE = (int(e) for e in Event)

_ROW = numba.float64[::1]
#: ``look`` and ``decide`` of a mechanism: t, x, lane, plant, belief, limits, u, seen, rates.
LOOK = numba.void(numba.float64, *[_ROW] * 8)
_LOOK = f"numba.void(numba.float64, {', '.join(['numba.float64[::1]'] * 8)})"

_inlined = compiled(forceinline=True, no_cpython_wrapper=True)


@_inlined
def _marks(seen, least, radius, layers, limits, terminal, escape):  # type: ignore[no-untyped-def]
    """What holds at a state, a bit each: where it changes there is a corner, or the end."""
    held, bit, m = 0, 1, len(limits)
    for i in range(m):
        held += bit if abs(seen[i]) > layers[i] else 0
        held += 2 * bit if seen[m + i] > limits[i] else 0
        held += 4 * bit if seen[m + i] < -limits[i] else 0
        bit *= 8
    for i in range(len(least)):
        held += 0 if seen[2 * m + i] >= least[i] else bit
        bit *= 2
    return held + bit * ((1 if radius <= terminal else 0) + (0 if radius < escape else 2))


@_inlined
def _event(margins, least, cost, radius, terminal, escape, cap):  # type: ignore[no-untyped-def]
    """The event that a state is; ``HORIZON`` while there is none."""
    if not margins[0] >= least[0]:
        return _SINGULAR
    for i in range(1, len(margins)):
        if not margins[i] >= least[i]:
            return _CONSTRAINT
    if not radius < escape:
        return _DIVERGED
    if radius <= terminal:
        return _REACHED
    return _COSTLY if cost > cap else _HORIZON


@_inlined
def _penalty(margins, least, prices):  # type: ignore[no-untyped-def]
    """What it costs a second to be outside of those constraints that do not count yet."""
    total = 0.0
    for j in range(len(prices)):
        if least[2 + j] == -math.inf:
            total += prices[j] * max(0.0, -margins[2 + j])
    return total


@_inlined
def _distance(x):  # type: ignore[no-untyped-def]
    """‖x‖₂ of a state with the cost behind it."""
    total = 0.0
    for j in range(len(x) - 1):
        total += x[j] * x[j]
    return math.sqrt(total)


@_inlined
def _keep_lowest(low, margins):  # type: ignore[no-untyped-def]
    for j in range(len(low)):
        low[j] = low[j] if margins[j] >= low[j] else margins[j]


@_inlined
def _interpolate(x, slopes, size, part, at):  # type: ignore[no-untyped-def]
    """State and cost after a part of a step."""
    for j in range(len(x)):
        total = 0.0
        for i in range(7):
            rising = BETWEEN[i, 2] + part * BETWEEN[i, 3]
            total += (BETWEEN[i, 0] + part * (BETWEEN[i, 1] + part * rising)) * slopes[i, j]
        at[j] = x[j] + size * part * total


@_inlined
def _error(x, slopes, new, size, rtol, nu):  # type: ignore[no-untyped-def]
    """The error of a step, as a part of what is allowed."""
    most, last = 0.0, len(x) - 1
    for j in range(len(x)):
        slope = 0.0
        for i in range(7):
            slope += ERROR[i] * slopes[i, j]
        allowed = rtol * (max(_distance(x), nu) if j < last else max(new[last], 1e-300))
        part = abs(size * slope) / allowed
        most = most if part <= most else part  # what is not a number is kept
    return most


@_inlined
def _dip(x, slopes, new, size, terminal, at):  # type: ignore[no-untyped-def]
    """After what part of a step the motion is nearest to the target, where it is arrived then.

    Infinity where it is nearest at an end of the step, or outside of the terminal set.
    """
    falling, rising = 0.0, 0.0
    for j in range(len(x) - 1):
        falling += x[j] * slopes[0, j]
        rising += new[j] * slopes[6, j]
    if not (falling < 0.0 and rising > 0.0 and terminal > 0.0):
        return math.inf
    low, high, nearer, found, part = 0.0, 1.0, math.inf, math.inf, 0.5
    for k in range(80):
        third = k % 2 == 0
        part = low + (high - low) * (1.0 / 3.0 if third else 0.5)
        _interpolate(x, slopes, size, part, at)
        found = _distance(at)
        if third:
            nearer = found
        elif nearer <= found:
            high = part
        else:
            low += (high - low) / 3.0
    return part if found <= terminal else math.inf


def _follow(  # type: ignore[no-untyped-def]
    look, decide, count, x0, live, lanes, switch, plant, belief, limits, noise, start, step, length,
    zoh_steps, usual_least, nu, terminal, escape, cap, rtol, prices, every, record, out,
):  # fmt: skip
    """Integrate lanes one after the other; arguments and results are those of a rollout kernel.

    But for ``length``, s, in the place of a number of steps: the last one may be a part of one.
    """
    steps = math.ceil(length / step * (1.0 - WHOLE))
    size_x, m = x0.shape[1], len(limits)
    paths = out.shape[1] - 9 - 2 * size_x
    x, new, at, rates = (
        np.empty(size_x + 1), np.empty(size_x + 1), np.empty(size_x + 1), np.empty(size_x + 1)
    )  # fmt: skip
    slopes, u = np.empty((7, size_x + 1)), np.empty(m)
    seen, low = np.empty(2 * m + 2 + paths), np.empty(2 + paths)
    margins, least = seen[2 * m :], np.empty(2 + paths)
    pace = every if every > 0 else (PACE if paths > 0 else steps + 1)
    for b in range(count):
        for j in range(size_x):
            x[j] = x0[b, j]
        x[size_x] = 0.0
        for j in range(len(low)):
            low[j], least[j] = math.inf, usual_least[j]
        radius = _distance(x)
        code = _REACHED if radius <= terminal else (_HORIZON if live[b] > 0.0 else _UNSTABLE)
        t, tick, segment, row, taken, held = 0.0, 0, 0, 0, 0, 0
        usual, lane = step, lanes[b, 0]
        outside = False  # of a path constraint as it begins: at a price until it is inside
        if prices.any():
            for j in range(size_x + 1):
                new[j] = x[j]
            if zoh_steps > 0:
                decide(start, new, lane, plant, belief, limits, u, seen, rates)
            look(start, new, lane, plant, belief, limits, u, seen, rates)
            for j in range(2, len(low)):
                if prices[j - 2] > 0.0 and not margins[j] >= least[j]:
                    least[j], outside = -math.inf, True
        while code == _HORIZON and tick < steps:
            # Surfaces change, and samples are taken, at whole steps of the loop.
            if segment < len(switch) and tick == switch[segment]:
                lane = lanes[b, segment]
                segment += 1
            until = min(switch[segment], steps) if segment < len(switch) else steps
            if zoh_steps > 0:
                if tick % zoh_steps == 0:
                    sample = min(tick // zoh_steps, noise.shape[0] - 1)
                    for j in range(size_x):
                        at[j] = x[j] + noise[sample, b, j]
                    decide(start + t, at, lane, plant, belief, limits, u, seen, rates)
                until = min(until, tick - tick % zoh_steps + zoh_steps)
            layers = lane[m * size_x + m : m * size_x + 2 * m]
            stop, fresh = min(until * step, length), True
            while code == _HORIZON and t < stop:
                size = usual if t + 1.1 * usual < stop else stop - t
                before, beyond = 0.0, math.inf  # lengths with a corner between, if there is one
                while True:
                    taken += 1
                    for i in range(0 if fresh else 1, 7):
                        for j in range(size_x + 1):
                            slope = 0.0
                            for earlier in range(i):
                                slope += STAGES[i, earlier] * slopes[earlier, j]
                            new[j] = x[j] + size * slope
                        clock = start + t + WHEN[i] * size
                        look(clock, new, lane, plant, belief, limits, u, seen, slopes[i])
                        if outside:
                            slopes[i, size_x] += _penalty(margins, least, prices)
                        if i == 0:
                            held = _marks(seen, least, radius, layers, limits, terminal, escape)
                            code = _event(margins, least, x[size_x], radius, terminal, escape, cap)
                            _keep_lowest(low, margins)
                    if fresh and code != _HORIZON:
                        break
                    fresh = False
                    off = _error(x, slopes, new, size, rtol, nu)
                    if beyond == math.inf and size > LEAST * step and not off <= 1.0:
                        size *= max(0.2, 0.9 * off**-0.2) if off < math.inf else 0.2
                        usual = size
                        continue
                    outer = _distance(new)
                    now = _marks(seen, least, outer, layers, limits, terminal, escape)
                    if now != held:
                        beyond = size
                    elif beyond == math.inf:
                        beyond = size * _dip(x, slopes, new, size, terminal, at)
                    else:
                        before = size
                    if beyond < math.inf and beyond - before > CORNER * step:
                        size = 0.5 * (before + beyond)
                        continue
                    if beyond < math.inf and size != beyond:
                        size = beyond
                        continue
                    ends = _event(margins, least, new[size_x], outer, terminal, escape, cap)
                    if beyond < math.inf and ends != _REACHED:  # it may dip before the corner
                        part = _dip(x, slopes, new, size, terminal, at)
                        if part < 1.0:
                            before, beyond = 0.0, size * part
                            size = 0.5 * beyond
                            continue
                    _keep_lowest(low, margins)
                    broken, instant = math.inf, row
                    while instant * pace * step < t + size and broken == math.inf:
                        into = instant * pace * step - t
                        _interpolate(x, slopes, size, into / size, at)
                        look(start + t + into, at, lane, plant, belief, limits, u, seen, rates)
                        if every > 0:
                            for j in range(size_x):
                                record[b, instant, j] = at[j]
                            for j in range(m):
                                record[b, instant, size_x + j] = u[j]
                                record[b, instant, size_x + m + j] = seen[j]
                            record[b, instant, size_x + 2 * m] = at[size_x]
                            record[b, instant, size_x + 2 * m + 1] = margins[0]
                        if into > 0.0:
                            _keep_lowest(low, margins)
                            for j in range(len(margins)):
                                broken = broken if margins[j] >= least[j] else into
                        instant += 1
                    if beyond == math.inf and broken < math.inf:
                        beyond, size = broken, 0.5 * broken
                        continue
                    if beyond == math.inf:
                        longer = size * min(5.0, 0.9 * max(off, 1e-10) ** -0.2)
                        longer = longer if longer >= LEAST * step else LEAST * step
                        usual = longer if size >= usual else max(usual, longer)
                    if outside:
                        for j in range(2, len(low)):
                            inside = margins[j] >= usual_least[j]
                            least[j] = usual_least[j] if inside else least[j]
                    row, held, code, radius = instant, now, ends, outer
                    t = stop if size >= stop - t else t + size
                    for j in range(size_x + 1):
                        x[j] = new[j]
                        slopes[0, j] = slopes[6, j]
                    break
            tick = until
        out[b, 0], out[b, 1], out[b, 2] = x[size_x], start + t, code
        out[b, 3] = min(radius, terminal) if code == _REACHED else radius
        for j in range(len(low)):
            out[b, 4 + j] = low[j]
        for j in range(6 + paths, 8 + paths + size_x):
            out[b, j] = 0.0
        for j in range(size_x):
            out[b, 8 + paths + size_x + j] = x[j]
        out[b, -1] = taken


@lru_cache(maxsize=1)
def follow() -> Any:
    """Return the integrator, compiled for any mechanism: it calls what it is given.

    Its arguments are those of a rollout kernel, behind the mechanism's ``look`` and ``decide`` and
    the number of lanes, but for ``length``, s; ``zoh_steps`` is 0 for a continuous loop,
    ``usual_least`` the margins of (37), a hard input limit and the path below which a motion has
    broken them, and ``nu`` the objective's terminal radius.
    """
    whole, real, look = numba.int64, numba.float64, numba.types.FunctionType(LOOK)
    table, block = numba.float64[:, ::1], numba.float64[:, :, ::1]
    signature = numba.void(
        look, look, whole, table, _ROW, block, numba.int64[::1], _ROW, _ROW, _ROW, block, real,
        real, real, whole, _ROW, *[real] * 5, _ROW, whole, block, table,
    )  # fmt: skip
    return compiled(signature, small=True)(_follow)


def look_source(program: LoopGraph, *, header: str) -> str:
    """Return the source of a module with ``look`` and ``decide`` of a closed loop.

    ``decide`` evaluates the law at a state: u, and into ``seen`` s, demand, det Γ(q)/det Γ(0), the
    margin of a hard input limit and, behind them, those of the path constraints.  ``look`` gives
    the rates of state and cost and the margins of the path; a continuous one decides first.
    ``program``: the closed loop. ``header``: text for the module's docstring.
    """
    emit, one = Emitter(program.tape), sp.Float(1.0)
    margin = one if program.input_margin is None else program.input_margin
    seen = [*program.s, *program.demand, program.singular, margin]
    rates = [*program.derivative, program.stage]
    law, law_needs = emit.lines(seen, set())
    known = set() if program.sampled else {line.symbol for line in program.tape.live(seen)}
    flow, flow_needs = emit.lines([*rates, *program.path], known)
    places = {program.time: "t"} | {
        symbol: f"{argument}[{j}]"
        for argument, symbols in (
            ("x", program.state),
            ("lane", program.lane_inputs),
            ("plant", program.plant_parameters),
            ("belief", program.belief_parameters),
            ("limits", program.limits),
        )
        for j, symbol in enumerate(symbols)
    }

    def loads(needs: set[sp.Symbol]) -> list[str]:
        return [f"{emit.text(s)} = {place}" for s, place in places.items() if s in needs]

    def stores(row: str, first: int, values: Sequence[sp.Expr]) -> list[str]:
        return [f"{row}[{first + j}] = {emit.text(value)}" for j, value in enumerate(values)]

    decided = [
        *law,
        *(
            f"u[{j}] = max(-limits[{j}], min(limits[{j}], {emit.text(demand)}))"
            for j, demand in enumerate(program.demand)
        ),
        *stores("seen", 0, seen),
    ]
    moved = [
        *(f"{emit.text(applied)} = u[{j}]" for j, applied in enumerate(program.applied)),
        *flow,
        *stores("rates", 0, rates),
        *stores("seen", len(seen), program.path),
    ]
    looked = [*loads(flow_needs | law_needs), *decided, *moved]
    functions = {
        "decide": [*loads(law_needs), *decided] if program.sampled else ["pass"],
        "look": [*loads(flow_needs), *moved] if program.sampled else looked,
    }
    return f"{docstring(header)}{PREAMBLE}{PRIMITIVES}" + "".join(
        f"\n\n@compiled({_LOOK}, no_cfunc_wrapper=False, fastmath={{'contract', 'nsz', 'arcp'}})\n"
        f"def {name}(t, x, lane, plant, belief, limits, u, seen, rates):\n"
        f"{textwrap.indent(chr(10).join(lines), '    ')}\n"
        for name, lines in functions.items()
    )
