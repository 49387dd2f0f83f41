"""Tape to a numba kernel that integrates many closed loops at once in SIMD blocks.

The generated source is a plain Python module: one ``rollout`` function whose innermost
loops run over the lanes of a block, without branches, so that LLVM turns each of them
into vector instructions.  All lane data live in one flat work array ``W`` at constant
offsets, which is what lets the vectoriser prove that loads and stores do not alias.

What few steps need (where a motion enters the terminal set, why it broke off) is a loop of its own,
for steps that end a motion; whether one does is counted in whole numbers, in any order the same.

Lines of the tape are hoisted by what they depend on: parameters only (once a call),
surface and gains (once a surface), state (every stage).
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Sequence

import sympy as sp

from undertow.closed_loop import exponential_integrator
from undertow.closed_loop.trajectory import Event
from undertow.closed_loop.work_array import (
    ENTERED,
    GROUPS,
    LANES,
    LoopGraph,
    WorkArray,
    code,
    entrance,
    total,
)
from undertow.symbolic import PRIMITIVES, Emitter, distinct, docstring

#: Whether a lane may hand over is looked at in these intervals, s.
WATCH = 0.032


class _Writer:
    """Writes the bodies of the lane loops of one closed loop."""

    def __init__(self, program: LoopGraph) -> None:
        self.program = program
        distinct((*program.state, *program.plant_parameters, program.time))
        self.emit = Emitter(program.tape)
        self.time = self.emit.text(program.time)
        self.limits = [self.emit.text(limit) for limit in program.limits]
        self.of_call, self.of_lane = _hoist(program)
        self.rows = WorkArray(program, self.of_lane)
        self.constant = {*self.of_call, *self.of_lane}
        self.rates = [*program.derivative, program.stage]
        self.monitored = [*program.s, program.singular]
        now, least = [self.rows.singular, *self.rows.path], list(self.rows.smallest)
        if program.input_margin is not None:
            self.monitored.append(program.input_margin)
            now.insert(1, self.rows.input)
        else:
            least.pop(1)
        #: Margins of the present step, each with the smallest so far.
        self.watched = list(zip(now, least, strict=True))

    # -- once a call, once a block, once a surface ---------------------------------------

    def constants(self) -> list[str]:
        """Everything that depends on parameters alone."""
        program = self.program
        return [
            *(f"{self.emit.text(s)} = plant[{j}]" for j, s in enumerate(program.plant_parameters)),
            *(
                f"{self.emit.text(s)} = belief[{j}]"
                for j, s in enumerate(program.belief_parameters)
            ),
            *(f"{self.emit.text(s)} = limits[{j}]" for j, s in enumerate(program.limits)),
            *self.emit.lines(self.of_call, set())[0],
        ]

    def reset(self) -> list[str]:
        """Initial states and counters of a block."""
        r = self.rows
        return [
            *(f"{row} = x0[b + i, {j}]" for j, row in enumerate(r.x)),
            "square = " + total(f"{row} * {row}" for row in r.x),
            "radius = math.sqrt(square)",
            f"{r.cost} = 0.0",
            f"{r.end} = start",
            f"{r.square} = square",
            f"{r.code} = {code(Event.REACHED)} if radius <= terminal else "
            f"({code(Event.HORIZON)} if live[b + i] > 0.0 else {code(Event.UNSTABLE)})",
            f"{r.active} = 1.0 if {r.code} == {code(Event.HORIZON)} else 0.0",
            f"{r.near} = radius",
            f"{r.near_time} = start",
            *(f"{near} = {x}" for near, x in zip(r.near_x, r.x, strict=True)),
            *(f"{row} = 1.0" for row in r.smallest),
            *(f"{row} = math.inf" for _, row in self.watched),
            *(f"{row} = 0.0" for row in [*r.u, *r.s, *r.path]),
            *(f"{row} = -1.0 if prices[{k}] > 0.0 else -2.0" for k, row in enumerate(r.outside)),
            f"{r.singular} = 1.0",
        ]

    def load_surface(self) -> list[str]:
        """The surface that takes over, and what depends on it alone."""
        r = self.rows
        lines, needs = self.emit.lines(self.of_lane, set(self.of_call))
        return [
            *(f"{row} = lanes[b + i, segment, {j}]" for j, row in enumerate(r.lane.values())),
            *(f"{self.emit.text(s)} = {row}" for s, row in r.lane.items() if s in needs),
            *lines,
            *(f"{row} = {self.emit.text(s)}" for s, row in r.kept.items()),
        ]

    # -- the law and the plant -----------------------------------------------------------

    def _load(self, needs: set[sp.Symbol], source: Sequence[str]) -> list[str]:
        """Bring the state from ``source`` and the lane constants into scalars."""
        state = zip(self.program.state, source, strict=True)
        constants = (self.rows.lane | self.rows.kept).items()
        return [
            *(f"{self.emit.text(s)} = {row}" for s, row in state if s in needs),
            *(f"{self.emit.text(s)} = {row}" for s, row in constants if s in needs),
        ]

    def _law(self, source: Sequence[str], more: Sequence[sp.Expr]) -> list[str]:
        """Evaluate the law at the state in ``source`` and clip its demand: ``u_j``."""
        demand = self.program.demand
        code, needs = self.emit.lines([*demand, *more], self.constant)
        clip = [
            f"u_{j} = max(-{limit}, min({limit}, {self.emit.text(d)}))"
            for j, (d, limit) in enumerate(zip(demand, self.limits, strict=True))
        ]
        return [*self._load(needs, source), *code, *clip]

    def _flow(
        self, source: Sequence[str], outputs: Sequence[sp.Expr], known: set[sp.Symbol]
    ) -> list[str]:
        """Evaluate rates and margins of the plant at the state in ``source``."""
        code, needs = self.emit.lines(outputs, self.constant | known)
        return [*self._load(needs, source), *code]

    def _laid(self, outputs: Sequence[sp.Expr]) -> set[sp.Symbol]:
        return {line.symbol for line in self.program.tape.live(outputs)}

    def _store_law(self) -> list[str]:
        r, text = self.rows, self.emit.text
        return [
            *(f"{row} = u_{j}" for j, row in enumerate(r.u)),
            *(
                f"{row} = {text(e)}"
                for row, e in zip([*r.s, r.singular, r.input], self.monitored, strict=False)
            ),
        ]

    def sample(self) -> list[str]:
        """The sampled law on the measured state; its input is held until the next sample."""
        measured = [f"y_{j}" for j in range(len(self.rows.x))]
        return [
            *(
                f"{y} = {x} + noise[sample, b + i, {j}]"
                for j, (y, x) in enumerate(zip(measured, self.rows.x, strict=True))
            ),
            *self._law(measured, self.monitored),
            *self._store_law(),
        ]

    def first_stage(self) -> list[str]:
        """First Runge-Kutta stage, with everything that is watched."""
        r, program, text = self.rows, self.program, self.emit.text
        outputs = [*self.rates, *program.path]
        if program.sampled:
            law, known = self._apply(r.u), set[sp.Symbol]()
        else:
            law = [*self._law(r.x, self.monitored), *self._store_law(), *self._apply()]
            known = self._laid([*program.demand, *self.monitored])
        return [
            *law,
            *self._flow(r.x, outputs, known),
            *(f"{row} = {text(e)}" for row, e in zip(r.path, program.path, strict=True)),
            *self._slopes("{slope} = {d}", "half"),
            f"{r.cost_slope} = {text(program.stage)}",
        ]

    def later_stage(self) -> list[str]:
        """Runge-Kutta stages two to four; ``weight`` and ``reach`` tell them apart."""
        r = self.rows
        if self.program.sampled:
            held = [*self._apply(r.u), *self._flow(r.stage_x, self.rates, set())]
        else:
            held = self._evaluate(r.stage_x)
        return [
            *held,
            *self._slopes("{slope} = {slope} + weight * {d}", "reach"),
            f"{r.cost_slope} = {r.cost_slope} + weight * ({self.emit.text(self.program.stage)})",
        ]

    def _slopes(self, add: str, way: str) -> list[str]:
        """Add the rates to the slopes of a step, and go some way along them to the next stage."""
        r, lines = self.rows, list[str]()
        for j, rate in enumerate(self.program.derivative):
            lines += [
                f"d_{j} = {self.emit.text(rate)}",
                add.format(slope=r.slope[j], d=f"d_{j}"),
                f"{r.stage_x[j]} = {r.x[j]} + {way} * d_{j}",
            ]
        return lines

    def _evaluate(self, source: Sequence[str], more: Sequence[sp.Expr] = ()) -> list[str]:
        """Evaluate the continuous law, the rates of the plant under it, and ``more``."""
        known = self._laid(self.program.demand)
        return [
            *self._law(source, []),
            *self._apply(),
            *self._flow(source, [*self.rates, *more], known),
        ]

    def _apply(self, rows: Sequence[str] = ()) -> list[str]:
        """Apply the inputs that lie in rows, or else those that the law has just given."""
        held = rows or [f"u_{j}" for j in range(len(self.program.applied))]
        return [
            f"{self.emit.text(a)} = {u}" for a, u in zip(self.program.applied, held, strict=True)
        ]

    # -- events ----------------------------------------------------------------------------

    def watch(self) -> list[str]:
        """Keep the smallest margins; count the lanes that have a negative one in ``broken``.

        Rows are read before they are chosen between: a choice between two elements of ``W``
        would be compiled as a choice between two addresses, and the loop not as vectors.
        """
        r, count = self.rows, range(len(self.watched))
        return [
            f"active = {r.active} > 0.0",
            *(f"now_{j}, low_{j} = {now}, {low}" for j, (now, low) in enumerate(self.watched)),
            # Written so that a margin that is not a number counts as broken, and is kept.
            *(
                f"{low} = low_{j} if (now_{j} >= low_{j}) | (not active) else now_{j}"
                for j, (_, low) in enumerate(self.watched)
            ),
            "sound = " + " & ".join(f"(now_{j} >= 0.0)" for j in count),
            "broken += 0 if sound | (not active) else 1",
        ]

    def break_off(self) -> list[str]:
        """Stop the lanes that have a negative margin, but for motions that are on their way back.

        Those have been outside of a path constraint with a price ever since they began: the row
        ``outside`` holds the last step in which they were.
        """
        r, now = self.rows, [row for row, _ in self.watched]
        margins = [row for row in now if row not in r.path]
        paths = list(enumerate(zip(r.outside, r.path, strict=True)))
        return [
            f"active, code, end = {r.active}, {r.code}, {r.end}",
            "sound = " + " & ".join(f"({row} >= 0.0)" for row in margins),
            *(f"since_{j}, path_{j} = {o}, {p}" for j, (o, p) in paths),
            *(f"back_{j} = since_{j} == step - 1.0" for j, _ in paths),
            *(f"sound = sound & ((path_{j} >= 0.0) | back_{j})" for j, _ in paths),
            *(
                f"{o} = step if back_{j} & (not path_{j} >= 0.0) else since_{j}"
                for j, (o, _) in paths
            ),
            *(
                f"{r.cost} = {r.cost} + (h * prices[{j}] * max(0.0, -path_{j}) "
                "if active > 0.0 else 0.0)"
                for j, _ in paths
            ),
            "stops = (active > 0.0) & (not sound)",
            f"kind = {code(Event.CONSTRAINT)} if {now[0]} >= 0.0 else {code(Event.SINGULAR)}",
            f"{r.end} = {self.time} if stops else end",
            f"{r.code} = kind if stops else code",
            f"{r.active} = 0.0 if stops else active",
        ]

    def hand_over(self) -> list[str]:
        """Stop a lane (code ``HANDED_OVER``) that is well inside its boundary layer and its limits.

        The rest is left to :mod:`undertow.closed_loop.exponential_integrator`.
        """
        r, m, boxes = self.rows, len(self.rows.u), self.program.boxes
        eta = 2 * m * len(r.x) // 2
        layers = [r.lane[symbol] for symbol in self.program.lane_inputs[eta + m : eta + 2 * m]]
        return [
            f"calm = {r.active} > 0.0",
            *(f"calm = calm & (abs({s}) <= 0.1 * {e})" for s, e in zip(r.s, layers, strict=True)),
            *(
                f"calm = calm & (abs({row}) <= 0.5 * {limit})"
                for row, limit in zip(r.u, self.limits, strict=True)
            ),
            *(
                f"calm = calm & ({row} > {spare!r})"
                for row, (_, spare) in zip(r.path, boxes, strict=bool(boxes))
            ),
            f"code, active, end = {r.code}, {r.active}, {r.end}",
            f"{r.end} = {self.time} if calm else end",
            f"{r.code} = {exponential_integrator.HANDED_OVER} if calm else code",
            f"{r.active} = 0.0 if calm else active",
        ]

    def rates_at_stage(self) -> list[str]:
        """Law and plant at the state of a stage: input, rates and stage cost into their rows.

        Where large steps know bounds of states, the margins to them, too.
        """
        r, text = self.rows, self.emit.text
        path = self.program.path if self.program.boxes else ()
        return [
            *self._evaluate(r.stage_x, path),
            *(f"{row} = {text(e)}" for row, e in zip(r.path, path, strict=bool(path))),
            *(f"{row} = u_{j}" for j, row in enumerate(r.u)),
            *(
                f"{row} = {text(rate)}"
                for row, rate in zip(r.slope, self.program.derivative, strict=True)
            ),
            f"{r.cost_slope} = {text(self.program.stage)}",
        ]

    def approach(self) -> list[str]:
        """Keep the point of the motion that is closest to the target, on the chord of a step."""
        r = self.rows
        nx = len(r.x)
        return [
            *(f"m_{j} = sixth * {slope}" for j, slope in enumerate(r.slope)),
            "chord = " + total(f"m_{j} * m_{j}" for j in range(nx)),
            "slant = -(" + total(f"{x} * m_{j}" for j, x in enumerate(r.x)) + ")",
            "part = max(0.0, min(1.0, slant / chord)) if chord > 0.0 else 0.0",
            *(f"m_{j} = {x} + part * m_{j}" for j, x in enumerate(r.x)),
            "near = math.sqrt(" + total(f"m_{j} * m_{j}" for j in range(nx)) + ")",
            f"nearer = {r.active} > 0.0 and near < {r.near}",
            f"{r.near} = near if nearer else {r.near}",
            f"{r.near_time} = {self.time} + part * h if nearer else {r.near_time}",
            *(f"{row} = m_{j} if nearer else {row}" for j, row in enumerate(r.near_x)),
        ]

    def advance(self) -> list[str]:
        """Complete the step; count the lanes that it ends in ``ended``.

        Those are the ones that reach the terminal set, are lost or too costly.
        """
        r = self.rows
        new = [f"n_{j}" for j in range(len(r.x))]
        old = [f"x_{j}" for j in range(len(r.x))]
        return [
            f"active, cost, before = {r.active} > 0.0, {r.cost}, {r.square}",
            *(f"{name} = {x}" for name, x in zip(old, r.x, strict=True)),
            *(f"{n} = {x} + sixth * {d}" for n, x, d in zip(new, old, r.slope, strict=True)),
            f"c_new = cost + sixth * {r.cost_slope}",
            *(f"m_{j} = {n} - {x}" for j, (n, x) in enumerate(zip(new, old, strict=True))),
            "outer = " + total(f"{n} * {n}" for n in new),
            *entrance(old, "before"),
            "reached = (outer <= terminal * terminal) | passed",
            "lost = not (outer < escape * escape)",
            "ended += 1 if active & (reached | lost | (c_new > cap)) else 0",
            f"{r.passed} = 1.0 if passed else 0.0",
            *(f"{row} = {x}" for row, x in zip(r.past_x, old, strict=True)),
            f"{r.past_cost} = cost",
            f"{r.past_square} = before",
            *(f"{row} = {n} if active else {x}" for row, n, x in zip(r.x, new, old, strict=True)),
            f"{r.cost} = c_new if active else cost",
            f"{r.square} = outer if active else before",
        ]

    def end(self) -> list[str]:
        """Stop the lanes that a step ends, those that reach the terminal set at its edge."""
        r = self.rows
        old = [f"x_{j}" for j in range(len(r.x))]
        return [
            f"active, before, outer = {r.active}, {r.past_square}, {r.square}",
            f"c_old, c_new, end = {r.past_cost}, {r.cost}, {r.end}",
            f"there, lost, code = {r.passed} > 0.0, not (outer < escape * escape), {r.code}",
            "there = (there | (outer <= terminal * terminal)) & (not lost)",
            "ends = (active > 0.0) & (there | lost | (c_new > cap))",
            "reached = ends & there",
            f"kind = {code(Event.DIVERGED)} if lost else "
            f"({code(Event.REACHED)} if there else {code(Event.COSTLY)})",
            f"{r.code} = kind if ends else code",
            *(f"{name} = {row}" for name, row in zip(old, r.past_x, strict=True)),
            *(f"n_{j} = {row}" for j, row in enumerate(r.x)),
            *(f"m_{j} = n_{j} - {x}" for j, x in enumerate(old)),
            *entrance(old, "before"),
            *ENTERED,
            "part = part if reached else 1.0",
            *(
                f"{row} = {x} + part * m_{j} if reached else n_{j}"
                for j, (row, x) in enumerate(zip(r.x, old, strict=True))
            ),
            f"{r.cost} = c_old + part * (c_new - c_old) if reached else c_new",
            f"{r.square} = min(outer, terminal * terminal) if reached else outer",
            f"{r.end} = {self.time} + part * h if ends else end",
            f"{r.active} = 0.0 if ends else active",
        ]

    def record(self) -> list[str]:
        """One line of a recorded trajectory: x, u, s, cost, det Γ(q)/det Γ(0)."""
        r = self.rows
        columns = [*r.x, *r.u, *r.s, r.cost, r.singular]
        return [f"record[b + i, step // every, {j}] = {row}" for j, row in enumerate(columns)]

    def collect(self) -> list[str]:
        """One line of results: cost, end, code, radius, closest, margins, final x, steps."""
        r = self.rows
        columns = [
            r.cost,
            "end",
            r.code,
            f"math.sqrt({r.square})",
            *r.smallest,
            r.near,
            r.near_time,
        ]
        return [
            f"end = last if {r.active} > 0.0 else {r.end}",
            *(f"out[b + i, {j}] = {row}" for j, row in enumerate([*columns, *r.near_x, *r.x])),
            f"out[b + i, {len(columns) + 2 * len(r.x)}] = (end - start) / h",
        ]


def kernel_source(program: LoopGraph, *, header: str) -> str:
    """Return the source of a module with one function ``rollout``.

    It and ``etd_integrate`` do the lanes from one number to another, whole groups of them: threads
    share a batch. ``program``: the closed loop. ``header``: text for the module's docstring.
    """
    w = _Writer(program)
    sampling = ""
    if program.sampled:
        sampling = f"""\
            if step % zoh_steps == 0:
                sample = min(step // zoh_steps, noise.shape[0] - 1)
{_groups(w.sample(), 4)}
"""
    return f"""{docstring(header)}import math

import numpy as np
{PRIMITIVES}

@compiled(fastmath={{"contract", "nsz", "arcp"}})
def rollout(
    from_lane, to_lane, x0, live, lanes, switch, plant, belief, limits, noise,
    start, h, steps, zoh_steps, terminal, escape, cap, seek, prices, calm_from, every, record, out,
):
{textwrap.indent(chr(10).join(w.constants()), "    ")}
{w.rows.allocate()}
    half, sixth = 0.5 * h, h / 6.0
    stride = max(1, round({WATCH} / h))
    for b in range(from_lane, to_lane, {GROUPS * LANES}):
        groups = min({GROUPS}, (to_lane - b) // {LANES})
        segment, last, fewer = 0, start, True
{_groups(w.reset(), 2)}
        for step in range(steps):
            {w.time} = start + step * h
            if segment < switch.shape[0] and step == switch[segment]:
{_groups(w.load_surface(), 4)}
                segment += 1
            broken = 0
{sampling}\
{_groups([*w.first_stage(), *w.watch()], 3)}
            if broken > 0:
                fewer = True
{_groups(w.break_off(), 4)}
            if every > 0 and step % every == 0:
{_groups(w.record(), 4)}
            if step >= calm_from and step % stride == 0 and segment == switch.shape[0]:
                fewer = True
{_groups(w.hand_over(), 4)}
            for rk in range(3):
                weight = 1.0 if rk == 2 else 2.0
                reach = half if rk == 0 else h
                {w.time} = start + (step + (1.0 if rk == 2 else 0.5)) * h
{_groups(w.later_stage(), 4)}
            {w.time} = start + step * h
            last = {w.time} + h
            if seek > 0.0:
{_groups(w.approach(), 4)}
            ended = 0
{_groups(w.advance(), 3)}
            if ended > 0:
                fewer = True
{_groups(w.end(), 4)}
            if fewer:
                going, fewer = 0, False
                for i in range({LANES} * groups):
                    going = i + 1 if {w.rows.active} > 0.0 else going
                groups = (going + {LANES - 1}) // {LANES}
                if groups == 0:
                    break
        groups = min({GROUPS}, (to_lane - b) // {LANES})
{_groups(w.collect(), 2)}
{"" if program.sampled else _etd_integrate(w)}"""


def _etd_integrate(w: _Writer) -> str:
    """Return the function that ends rollouts in large steps, see :mod:`.exponential_integrator`."""
    return f"""

@compiled(fastmath={{"contract", "nsz", "arcp"}})
def etd_integrate(
    from_lane, to_lane, lanes, plant, belief, limits, until, terminal, escape, tail, counted,
    linear, value, powers, forced, reach, out,
):
{textwrap.indent(chr(10).join(w.constants()), "    ")}
{w.rows.allocate()}
    {w.time} = 0.0
    segment = lanes.shape[1] - 1
    for b in range(from_lane, to_lane, {LANES}):
        block = b // {LANES}
{_lanes(w.load_surface(), 2)}
{textwrap.indent(exponential_integrator.fetch(w.rows), " " * 8)}\
{_lanes(exponential_integrator.begin(w.rows), 2)}
        for step in range({exponential_integrator.MOST}):
            alive = 0.0
            for i in range({LANES}):
                alive += {w.rows.active}
            if alive == 0.0:
                break
{textwrap.indent(exponential_integrator.choose_step(w.rows), " " * 12)}\
            for half in range(2):
{_lanes(w.rates_at_stage(), 4)}
                if half == 0:
{_lanes(exponential_integrator.first_half(w.rows, w.limits), 5)}
{_lanes(exponential_integrator.second_half(w.rows), 3)}
{_lanes(exponential_integrator.finish(w.rows), 2)}
"""


def _groups(lines: Iterable[str], depth: int) -> str:
    """Return a loop over the lanes of the groups that go on around ``lines``, indented.

    There is at least one group: a compiler that is told so leaves no scalars over.
    """
    return _lanes(lines, depth, f"max({LANES}, {LANES} * groups)")


def _lanes(lines: Iterable[str], depth: int, count: str = str(LANES)) -> str:
    """Return a loop over ``count`` lanes around ``lines``, indented."""
    text = f"for i in range({count}):\n" + textwrap.indent("\n".join(lines), "    ")
    return textwrap.indent(text, "    " * depth)


def _hoist(program: LoopGraph) -> tuple[list[sp.Symbol], list[sp.Symbol]]:
    """Return the symbols of the tape to be computed once a call, and once a surface.

    Lines are told apart by what they depend on; those are kept that later lines use.
    """
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
    return call, lane
