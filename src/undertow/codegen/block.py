"""Tape to a numba kernel that integrates many closed loops at once in SIMD blocks.

The generated source is a plain Python module: one ``rollout`` function whose innermost
loops run over the lanes of a block, without branches, so that LLVM turns each of them
into vector instructions.  All lane data live in one flat work array at constant offsets,
which is what lets the vectoriser prove that loads and stores do not alias.

Lines of the tape are hoisted by what they depend on: parameters only (once a call),
surface and gains (once a surface), state (every stage).
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import sympy as sp
from sympy.printing.pycode import PythonCodePrinter

from undertow.codegen.tape import Tape

__all__ = ["LANES", "LoopProgram", "block_source"]

#: Closed loops in one block: two AVX-512 registers or four AVX2 registers of float64.
LANES = 16

_SINCOS = """
k_{i} = np.floor({arg} * 0.6366197723675814 + 0.5)
r_{i} = ({arg} - k_{i} * 1.5707963267341256) - k_{i} * 6.077100506506192e-11
z_{i} = r_{i} * r_{i}
ps_{i} = r_{i} + r_{i} * z_{i} * (-0.16666666666666632 + z_{i} * (0.00833333333332249 + z_{i} * (-0.0001984126982985795 + z_{i} * (2.7557313707070068e-06 + z_{i} * (-2.5050760253406863e-08 + z_{i} * 1.58969099521155e-10)))))
pc_{i} = 1.0 - 0.5 * z_{i} + z_{i} * z_{i} * (0.0416666666666666 + z_{i} * (-0.001388888888887411 + z_{i} * (2.480158728947673e-05 + z_{i} * (-2.7557314351390663e-07 + z_{i} * (2.087572321298175e-09 + z_{i} * -1.1359647557788195e-11)))))
h_{i} = np.floor(k_{i} * 0.5)
o_{i} = k_{i} - 2.0 * h_{i}
g_{i} = 1.0 - 2.0 * (h_{i} - 2.0 * np.floor(h_{i} * 0.5))
sin_{i} = g_{i} * (ps_{i} if o_{i} == 0.0 else pc_{i})
cos_{i} = g_{i} * (1.0 - 2.0 * o_{i}) * (pc_{i} if o_{i} == 0.0 else ps_{i})
""".strip()  # noqa: E501


@dataclass(frozen=True)
class LoopProgram:
    """A closed loop on a tape, ready for printing.

    The control part maps (x, surface, gains) to ``demand``, ``s`` and ``margins``; the flow
    part maps (t, x, ``applied``) to ``derivative``, ``stage`` and ``path``.  ``applied`` are
    the symbols that stand for the inputs after the actuator.
    """

    tape: Tape
    time: sp.Symbol
    state: tuple[sp.Symbol, ...]
    applied: tuple[sp.Symbol, ...]
    limits: tuple[sp.Symbol, ...]
    plant_parameters: tuple[sp.Symbol, ...]
    belief_parameters: tuple[sp.Symbol, ...]
    lane_inputs: tuple[sp.Symbol, ...]
    demand: tuple[sp.Expr, ...]
    s: tuple[sp.Expr, ...]
    singular: sp.Expr
    derivative: tuple[sp.Expr, ...]
    stage: sp.Expr
    path: tuple[sp.Expr, ...]
    input_margin: sp.Expr | None


class _Printer(PythonCodePrinter):  # type: ignore[misc]  # SymPy is untyped
    """Python code that numba turns into vector arithmetic."""

    def _print_Pow(self, expr: sp.Pow, **_: object) -> str:
        base, exponent = expr.args
        text = self.parenthesize(base, 100)
        if exponent == sp.Rational(1, 2):
            return f"math.sqrt({self._print(base)})"
        if exponent == sp.Rational(-1, 2):
            return f"(1.0 / math.sqrt({self._print(base)}))"
        if exponent.is_Integer and 0 < abs(int(exponent)) <= 16:
            power = " * ".join([text] * abs(int(exponent)))
            return f"({power})" if int(exponent) > 0 else f"(1.0 / ({power}))"
        return f"math.pow({self._print(base)}, {self._print(exponent)})"

    def _print_Integer(self, expr: sp.Integer) -> str:
        return f"{int(expr)}.0"

    def _print_Rational(self, expr: sp.Rational) -> str:
        return repr(float(expr))

    def _print_Float(self, expr: sp.Float) -> str:
        return repr(float(expr))

    def _print_Abs(self, expr: sp.Abs) -> str:
        return f"abs({self._print(expr.args[0])})"

    def _print_sign(self, expr: sp.sign) -> str:
        x = self._print(expr.args[0])
        return f"((1.0 if {x} > 0.0 else 0.0) - (1.0 if {x} < 0.0 else 0.0))"

    def _print_Max(self, expr: sp.Max) -> str:
        return self._nest("max", expr.args)

    def _print_Min(self, expr: sp.Min) -> str:
        return self._nest("min", expr.args)

    def _nest(self, name: str, args: Sequence[sp.Expr]) -> str:
        text = str(self._print(args[0]))
        for arg in args[1:]:
            text = f"{name}({text}, {self._print(arg)})"
        return text


class _Emitter:
    """Prints tape lines with one sine-cosine evaluation per distinct angle."""

    def __init__(self, tape: Tape) -> None:
        self.tape = tape
        self.printer = _Printer({"fully_qualified_modules": True})
        self.angles: dict[sp.Expr, int] = {}

    def lines(
        self, outputs: Iterable[sp.Expr], given: set[sp.Symbol]
    ) -> tuple[list[str], set[sp.Symbol]]:
        """Return code lines for all live assignments that are not ``given``."""
        outputs = [sp.sympify(o) for o in outputs]
        needed: set[sp.Basic] = set().union(*(o.free_symbols for o in outputs))
        kept = []
        for line in reversed(self.tape.assignments):
            if line.symbol in needed and line.symbol not in given:
                kept.append(line)
                needed |= line.expression.free_symbols
        code: list[str] = []
        done: set[sp.Expr] = set()
        for line in reversed(kept):
            expression = line.expression
            for call in sorted(expression.atoms(sp.sin, sp.cos), key=str):
                angle = call.args[0]
                index = self.angles.setdefault(angle, len(self.angles))
                if angle not in done:
                    done.add(angle)
                    argument = self.printer.doprint(angle)
                    if not angle.is_Symbol:
                        code.append(f"angle_{index} = {argument}")
                        argument = f"angle_{index}"
                    code += _SINCOS.format(i=index, arg=argument).splitlines()
                name = "sin" if isinstance(call, sp.sin) else "cos"
                expression = expression.xreplace({call: sp.Symbol(f"{name}_{index}", real=True)})
            code.append(f"{line.symbol} = {self.text(expression)}")
        return code, {s for s in needed if isinstance(s, sp.Symbol)}

    def text(self, expression: sp.Expr) -> str:
        """Print one expression."""
        return str(self.printer.doprint(sp.sympify(expression)))


class _Rows:
    """Names rows of the flat work array; a row holds one value per lane."""

    def __init__(self) -> None:
        self.count = 0

    def take(self, rows: int = 1) -> list[str]:
        start = self.count
        self.count += rows
        return [f"W[{(start + j) * LANES} + i]" for j in range(rows)]


def block_source(program: LoopProgram, *, sampled: bool, header: str) -> str:
    """Return the source of a module with one function ``rollout``.

    Parameters
    ----------
    program
        The closed loop.
    sampled
        False: the law acts in continuous time, inside every Runge-Kutta stage.  True: it
        is evaluated every ``hold`` steps on the measured state and held in between.
    header
        Text for the module's docstring.
    """
    emit = _Emitter(program.tape)
    hoist = _hoist(program)
    nx, m = len(program.state), len(program.applied)
    nw = len(program.path)
    rows = _Rows()
    X, XS, ACC = rows.take(nx), rows.take(nx), rows.take(nx)
    COST, COST_ACC = rows.take()[0], rows.take()[0]
    LANE = dict(zip(program.lane_inputs, rows.take(len(program.lane_inputs)), strict=True))
    KEEP = dict(zip(hoist.lane, rows.take(len(hoist.lane)), strict=True))
    U, S = rows.take(m), rows.take(m)
    SINGULAR, INPUT = rows.take(2)
    PATH = rows.take(nw)
    MIN = rows.take(2 + nw)
    n = nx // 2
    LINEAR = [rows.take(nx) for _ in range(n)]
    VALUE = [rows.take(nx) for _ in range(nx)]
    RATE, RECENT, EARLIER = rows.take(3)
    ACT, TEND, CODE, RADIUS = rows.take(4)
    names = [str(s) for s in program.state]
    given_call = set(hoist.call)
    given = given_call | set(hoist.lane)

    # -- pieces of text ------------------------------------------------------------------
    call_lines, _ = emit.lines(hoist.call, set())
    lane_lines, lane_needs = emit.lines(hoist.lane, given_call)
    clip = [
        f"u_{j} = max(-limit_{j}, min(limit_{j}, {emit.text(d)}))"
        for j, d in enumerate(program.demand)
    ]

    def loads(needs: set[sp.Symbol], source: list[str]) -> list[str]:
        code = [f"{n} = {row}" for n, row in zip(names, source, strict=True)]
        code += [f"{s} = {row}" for s, row in (LANE | KEEP).items() if s in needs]
        return code

    def control(source: list[str], more: Sequence[sp.Expr]) -> list[str]:
        code, needs = emit.lines([*program.demand, *more], given)
        needs |= set().union(*(sp.sympify(o).free_symbols for o in [*program.demand, *more]))
        return [*loads(needs, source), *code, *clip]

    def flow(outputs: Sequence[sp.Expr], known: set[sp.Symbol]) -> tuple[list[str], set[sp.Symbol]]:
        return emit.lines(outputs, given | known)

    monitored = [*program.s, program.singular]
    if program.input_margin is not None:
        monitored.append(program.input_margin)
    rates = [*program.derivative, program.stage]
    laid = {a.symbol for a in program.tape.live([*program.demand, *monitored])}
    laid_law = {a.symbol for a in program.tape.live(program.demand)}
    held = [f"{a} = {row}" for a, row in zip(program.applied, U, strict=True)]
    bind = [f"{a} = u_{j}" for j, a in enumerate(program.applied)]
    store_u = [f"{row} = u_{j}" for j, row in enumerate(U)]
    store_law = [
        *(f"{row} = {emit.text(e)}" for row, e in zip(S, program.s, strict=True)),
        f"{SINGULAR} = {emit.text(program.singular)}",
        f"{INPUT} = "
        + ("1.0" if program.input_margin is None else emit.text(program.input_margin)),
    ]
    path_out = [f"{row} = {emit.text(e)}" for row, e in zip(PATH, program.path, strict=True)]
    first_out = [
        *(
            f"d_{j} = {emit.text(e)}\n{ACC[j]} = d_{j}\n{XS[j]} = {X[j]} + half * d_{j}"
            for j, e in enumerate(program.derivative)
        ),
        f"{COST_ACC} = {emit.text(program.stage)}",
    ]
    next_out = [
        *(
            f"d_{j} = {emit.text(e)}\n{ACC[j]} = {ACC[j]} + weight * d_{j}\n"
            f"{XS[j]} = {X[j]} + reach * d_{j}"
            for j, e in enumerate(program.derivative)
        ),
        f"{COST_ACC} = {COST_ACC} + weight * ({emit.text(program.stage)})",
    ]
    state_needs = set(program.state)
    if sampled:
        sample = [*control([f"Y_{j}" for j in range(nx)], monitored), *store_u, *store_law]
        measured = [f"Y_{j} = {X[j]} + noise[sample, b + i, {j}] * noisy" for j in range(nx)]
        sample = [*measured, *sample]
        body, needs = flow([*rates, *program.path], set())
        first = [*loads(needs | state_needs, X), *held, *body, *path_out, *first_out]
        body, needs = flow(rates, set())
        later = [*loads(needs | state_needs, XS), *held, *body, *next_out]
    else:
        sample = []
        body, needs = flow([*rates, *program.path], laid)
        first = [
            *control(X, monitored),
            *loads(needs, X)[nx:],
            *bind,
            *body,
            *store_u,
            *store_law,
            *path_out,
            *first_out,
        ]
        body, needs = flow(rates, laid_law)
        later = [*control(XS, []), *loads(needs, XS)[nx:], *bind, *body, *next_out]

    margins = [SINGULAR, INPUT, *PATH]
    watch = [
        "active = " + ACT,
        "worst = " + _smallest(margins),
        *(
            f"{low} = min({low}, {now}) if active > 0.0 else {low}"
            for low, now in zip(MIN, margins, strict=True)
        ),
        "broken = active > 0.0 and not (worst >= 0.0)",
        f"{TEND} = t if broken else {TEND}",
        f"{CODE} = (3.0 if not ({SINGULAR} >= 0.0) else 2.0) if broken else {CODE}",
        f"{ACT} = 0.0 if broken else active",
    ]
    hand_over = [
        *(f"x_{j} = {row}" for j, row in enumerate(X)),
        *(f"p_{j} = " + " + ".join(f"{VALUE[j][k]} * x_{k}" for k in range(nx)) for j in range(nx)),
        *(
            f"r_{j} = {ACC[n + j]} - ("
            + " + ".join(f"{LINEAR[j][k]} * x_{k}" for k in range(nx))
            + ")"
            for j in range(n)
        ),
        "level = " + " + ".join(f"p_{j} * x_{j}" for j in range(nx)),
        "residual = 2.0 * (" + " + ".join(f"abs(p_{n + j} * r_{j})" for j in range(n)) + ")",
        f"{RECENT} = max({RECENT}, residual)",
        f"worst = max({RECENT}, {EARLIER})",
        f"calm = {ACT} > 0.0 and worst <= {RATE} * (tail * (level + counted * {COST}) + slack)",
        *(f"calm = calm and abs({U[j]}) <= 0.5 * limit_{j}" for j in range(m)),
        f"{CODE} = -1.0 if calm else {CODE}",
        f"{ACT} = 0.0 if calm else {ACT}",
    ]
    forget = [f"{EARLIER} = {RECENT}", f"{RECENT} = 0.0"]
    advance = [
        "active = " + ACT,
        *(f"n_{j} = {X[j]} + sixth * {ACC[j]}" for j in range(nx)),
        f"c_new = {COST} + sixth * {COST_ACC}",
        "radius = math.sqrt(" + " + ".join(f"n_{j} * n_{j}" for j in range(nx)) + ")",
        f"before = {RADIUS}",
        "reached = radius <= terminal",
        "span = before - radius",
        "part = (before - terminal) / span if span > 0.0 else 1.0",
        "part = max(0.0, min(1.0, part)) if reached else 1.0",
        "lost = not (radius < escape)",
        *(f"{X[j]} = n_{j} if active > 0.0 else {X[j]}" for j in range(nx)),
        f"{COST} = {COST} + part * (c_new - {COST}) if active > 0.0 else {COST}",
        f"{TEND} = t + part * h if active > 0.0 else {TEND}",
        f"costly = {COST} > cap",
        "code = 4.0 if lost else (1.0 if reached else (5.0 if costly else 0.0))",
        f"{CODE} = code if active > 0.0 else {CODE}",
        f"{RADIUS} = radius if active > 0.0 else before",
        f"{ACT} = 0.0 if (lost or reached or costly) else active",
    ]
    recorded = [*X, *U, *S, COST, SINGULAR]
    out_columns = [COST, TEND, CODE, RADIUS, *MIN, *X]

    def loop(lines: Iterable[str], depth: int) -> str:
        body = "\n".join(lines)
        text = f"for i in range({LANES}):\n" + textwrap.indent(body, "    ")
        return textwrap.indent(text, "    " * depth)

    parameters = "\n".join(
        [
            *(f"    {s} = plant[{j}]" for j, s in enumerate(program.plant_parameters)),
            *(f"    {s} = belief[{j}]" for j, s in enumerate(program.belief_parameters)),
            *(f"    {s} = limits[{j}]" for j, s in enumerate(program.limits)),
            *(f"    {line}" for line in call_lines),
        ]
    )
    load_lane = [
        *(f"{row} = lanes[b + i, segment, {j}]" for j, row in enumerate(LANE.values())),
        *(f"{s} = {row}" for s, row in LANE.items() if s in lane_needs),
        *lane_lines,
        *(f"{row} = {s}" for s, row in KEEP.items()),
    ]
    load_tail = [
        *(f"{LINEAR[j][k]} = linear[b + i, {j}, {k}]" for j in range(n) for k in range(nx)),
        *(f"{VALUE[j][k]} = value[b + i, {j}, {k}]" for j in range(nx) for k in range(nx)),
        f"{RATE} = rate[b + i]",
        f"{RECENT} = math.inf",
        f"{EARLIER} = math.inf",
    ]
    reset = [
        *(f"{row} = x0[b + i, {j}]" for j, row in enumerate(X)),
        "radius = math.sqrt(" + " + ".join(f"{row} * {row}" for row in X) + ")",
        f"{COST} = 0.0",
        f"{TEND} = start",
        f"{RADIUS} = radius",
        f"{CODE} = 1.0 if radius <= terminal else (0.0 if live[b + i] > 0.0 else 6.0)",
        f"{ACT} = 1.0 if {CODE} == 0.0 else 0.0",
        *(f"{row} = math.inf" for row in MIN),
        *(f"{row} = 0.0" for row in [*U, *S, *PATH]),
        f"{SINGULAR} = 1.0",
        f"{INPUT} = 1.0",
    ]
    record = [f"record[b + i, step // every, {j}] = {row}" for j, row in enumerate(recorded)]
    collect = [f"out[b + i, {j}] = {row}" for j, row in enumerate(out_columns)]
    sample_text = (
        f"                if step % hold == 0:\n"
        f"                    sample = min(step // hold, noise.shape[0] - 1)\n{loop(sample, 5)}\n"
        if sampled
        else ""
    )
    first_name = "monitored first stage"
    return f'''"""{header}"""

import math

import numba
import numpy as np

ROWS = {rows.count}
LANES = {LANES}


@numba.njit(
    cache=True, nogil=True, error_model="numpy", fastmath={{"contract", "nsz", "arcp"}}
)
def rollout(
    x0, live, lanes, switch, plant, belief, limits, noise, noisy,
    start, h, steps, hold, terminal, escape, cap, tail, counted, slack,
    linear, value, rate,
    every, record, out,
):
{parameters}
    W = np.empty({rows.count * LANES})
    half, sixth = 0.5 * h, h / 6.0
    for b in range(0, x0.shape[0], {LANES}):
        segment = 0
{loop(reset, 2)}
        if tail > 0.0:
{loop(load_tail, 3)}
        for step in range(steps):
            t = start + step * h
            if segment < switch.shape[0] and step == switch[segment]:
{loop(load_lane, 4)}
                segment += 1
{sample_text.replace("                if step", "            if step", 1) if sampled else ""}\
            # {first_name}
{loop(first, 3)}
{loop(watch, 3)}
            if every > 0 and step % every == 0:
{loop(record, 4)}
            if tail > 0.0 and step % 16 == 0 and segment == switch.shape[0]:
{loop(hand_over, 4)}
                if step % 128 == 0:
{loop(forget, 5)}
            for rk in range(3):
                weight = 1.0 if rk == 2 else 2.0
                reach = half if rk == 0 else h
                t = start + (step + (1.0 if rk == 2 else 0.5)) * h
{loop(later, 4)}
            t = start + step * h
{loop(advance, 3)}
            if step % 8 == 0:
                alive = 0.0
                for i in range({LANES}):
                    alive += {ACT}
                if alive == 0.0:
                    break
{loop(collect, 2)}
'''


def _smallest(rows: Sequence[str]) -> str:
    text = rows[0]
    for row in rows[1:]:
        text = f"min({text}, {row})"
    return text


@dataclass(frozen=True)
class _Hoisted:
    """Tape symbols that need computing once a call, and once a surface."""

    call: list[sp.Symbol]
    lane: list[sp.Symbol]


def _hoist(program: LoopProgram) -> _Hoisted:
    """Classify tape lines by what they depend on and keep those that later lines use."""
    constants = {*program.plant_parameters, *program.belief_parameters, *program.limits}
    per_lane = {*program.lane_inputs}
    level: dict[sp.Symbol, int] = dict.fromkeys(constants, 0) | dict.fromkeys(per_lane, 1)
    outputs = [
        *program.demand,
        *program.s,
        program.singular,
        *program.derivative,
        program.stage,
        *program.path,
        *([] if program.input_margin is None else [program.input_margin]),
    ]
    live = program.tape.live(outputs)
    for line in live:
        level[line.symbol] = max(
            (level.get(s, 2) for s in line.expression.free_symbols if isinstance(s, sp.Symbol)),
            default=0,
        )
    used_by_state: set[sp.Basic] = set().union(*(sp.sympify(o).free_symbols for o in outputs))
    used_by_lane: set[sp.Basic] = set()
    for line in live:
        if level[line.symbol] == 2:
            used_by_state |= line.expression.free_symbols
    lane = [a.symbol for a in live if level[a.symbol] == 1 and a.symbol in used_by_state]
    for line in live:
        if level[line.symbol] == 1:
            used_by_lane |= line.expression.free_symbols
    call = [
        a.symbol for a in live if level[a.symbol] == 0 and a.symbol in used_by_state | used_by_lane
    ]
    return _Hoisted(call, lane)
