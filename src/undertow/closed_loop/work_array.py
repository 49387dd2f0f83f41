"""What a kernel works on: a closed loop on a tape, and the rows of its work array."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import sympy as sp

from undertow.closed_loop.trajectory import Event
from undertow.symbolic import Tape

#: Closed loops in one group: two AVX-512 registers or four AVX2 registers of float64.
LANES = 16

#: Groups that a rollout takes through each stage together: the operations on a lane wait for one
#: another, and so long the processor works on other lanes.
GROUPS = 2


@dataclass(frozen=True)
class LoopGraph:
    """A closed loop on a tape, ready for printing.

    The control part maps (x, surface, gains) to ``demand``, ``s`` and ``margins``; the flow
    part maps (t, x, ``applied``) to ``derivative``, ``stage`` and ``path``.  ``applied`` are
    the symbols that stand for the inputs after the actuator.  ``boxes`` are, where all of ``path``
    are bounds of one state, its number and how far from the bound large steps stay.  The law of a
    ``sampled`` loop is evaluated every ``zoh_steps`` steps on the measured state and held in
    between; else it acts in continuous time, inside every Runge-Kutta stage.

    ``lane_inputs`` are what a lane brings with it: the law vector, and behind it the parameters of
    its plant where every lane has one of its own; ``plant_parameters`` are empty then.
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
    boxes: tuple[tuple[int, float], ...] = ()
    sampled: bool = False


class WorkArray:
    """The rows of the flat work array, by name; a row holds one value per lane.

    Every attribute is the text of an element, ``W[offset + i]``, or a list of them.
    """

    def __init__(self, program: LoopGraph, kept: Sequence[sp.Symbol]) -> None:
        self.count = 0
        nx, m, nw = len(program.state), len(program.applied), len(program.path)
        self.x, self.stage_x, self.slope = self._take(nx), self._take(nx), self._take(nx)
        self.cost, self.cost_slope, self.square = self._take(3)
        self.past_x = self._take(nx)
        self.past_cost, self.past_square, self.passed = self._take(3)
        lane_inputs = program.lane_inputs
        self.lane = dict(zip(lane_inputs, self._take(len(lane_inputs)), strict=True))
        self.kept = dict(zip(kept, self._take(len(kept)), strict=True))
        self.u, self.s = self._take(m), self._take(m)
        self.singular, self.input = self._take(2)
        self.path, self.outside = self._take(nw), self._take(nw)
        self.smallest = self._take(2 + nw)
        self.linear = [self._take(nx) for _ in range(nx // 2)]
        self.value = [self._take(nx) for _ in range(nx)]
        self.span, self.power, self.changed, self.bend, self.last, self.ago = self._take(6)
        self.speed, self.free, self.begun = self._take(3)
        self.rest = self._take(nx // 2)
        self.flow = [self._take(nx) for _ in range(nx)]
        self.force = [self._take(nx // 2) for _ in range(nx)]
        self.rise = [self._take(nx // 2) for _ in range(nx)]
        self.active, self.end, self.code, self.radius, self.steps = self._take(5)
        self.near, self.near_time = self._take(2)
        self.near_x = self._take(nx)
        self.boxes = program.boxes
        self.reach = [self._take(nx) for _ in program.boxes]
        self.room = self._take(len(program.boxes))
        self.low = self.smallest[2:] if program.boxes else []
        self.pull = self._take(nx // 2) if program.boxes else []

    def _take(self, rows: int) -> list[str]:
        start = self.count
        self.count += rows
        return [f"W[{(start + j) * GROUPS * LANES} + i]" for j in range(rows)]

    def allocate(self) -> str:
        """Return the line that makes the array."""
        return f"    W = memory({self.count * GROUPS * LANES})"


def entry(matrix: Sequence[Sequence[str]]) -> str:
    """Return the text of entry (j, k) of a matrix whose rows were taken one after another."""
    return matrix[0][0].replace("+", f"+ {GROUPS * LANES} * (j * {len(matrix[0])} + k) +")


def code(event: Event) -> str:
    """Return the number that stands for an event in a kernel, as text."""
    return repr(float(event))


def total(terms: Iterable[str]) -> str:
    """Return the sum of terms, as text."""
    return " + ".join(terms)


def entrance(x: Sequence[str], square: str) -> list[str]:
    """Whether the chord m of a step from x, ‖x‖² = ``square``, ``passed`` the terminal ball."""
    return [
        "chord = " + total(f"m_{j} * m_{j}" for j in range(len(x))),
        "slant = -(" + total(f"{e} * m_{j}" for j, e in enumerate(x)) + ")",
        f"depth = slant * slant - chord * ({square} - terminal * terminal)",
        "passed = (slant > 0.0) & (depth >= 0.0) & (slant <= chord)",
    ]


#: The part of the chord up to the ball: the smaller root of ‖x + part m‖² = terminal², in [0, 1].
ENTERED = [
    "part = (slant - math.sqrt(max(depth, 0.0))) / chord if chord > 0.0 else 1.0",
    "part = max(0.0, min(1.0, part))",
]
