"""Validated steps hold the motion, and hardly more: thin sets against references of 50 digits.

A set that is a point shows every error of the series; a thick one hides them in its width.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import mpmath
import numpy as np
import pytest
import sympy as sp

pytest.importorskip("flint", reason="ball arithmetic is the extra undertow[certify]")

import undertow as ut
from motions import Reference, holds
from undertow.models import FloatArray
from undertow.proofs.closed_loop.loop import LoopMotion
from undertow.proofs.closed_loop.sampled_data import SampledDataLoop
from undertow.proofs.closed_loop.tube import Tubes
from undertow.proofs.intervals.batch import Interval, IntervalArithmetic
from undertow.proofs.intervals.interval import compile_outward
from undertow.symbolic import Tape

LAW = ut.ReachingLaw()


# -- motions that are known in closed form ----------------------------------------------------


class Rates(NamedTuple):
    """A toy over boxes."""

    rate: Interval
    slope: Interval
    kinked: np.ndarray[Any, np.dtype[np.bool_]]


@dataclass(frozen=True)
class Toy:
    """ẏ = f(y, p) with a known motion; the first rows are smooth, |y_0| counts as no more."""

    rates: tuple[sp.Expr, ...]
    motion: Callable[..., Sequence[Any]]
    smooth: int
    parameters: tuple[tuple[float, float], ...] = ()

    @property
    def radii(self) -> FloatArray:
        return np.array([radius for _, radius in self.parameters])

    @cached_property
    def symbols(self) -> tuple[list[sp.Symbol], list[sp.Symbol], list[sp.Symbol]]:
        size = len(self.rates)
        return (
            list(sp.symbols(f"y:{size}", real=True)),
            list(sp.symbols(f"v:{size}", real=True)),
            list(sp.symbols(f"p:{len(self.parameters)}", real=True)),
        )

    def compiled(self, block: sp.Matrix, inputs: list[sp.Symbol]) -> Callable[..., Interval]:
        tape = Tape()
        run = compile_outward(tape, inputs, tape.let_all(list(block)), IntervalArithmetic())

        def over(*values: Interval) -> Interval:
            lanes = values[0].lo.shape[0]
            parts = [Interval.of(v) for v in run(*values)]
            low = np.array([np.broadcast_to(v.lo, lanes) for v in parts])
            high = np.array([np.broadcast_to(v.hi, lanes) for v in parts])
            return Interval(low, high).reshape(*block.shape, lanes)

        return over

    @cached_property
    def program(self) -> tuple[Callable[..., Interval], ...]:
        y, v, p = self.symbols
        f = sp.Matrix(self.rates)
        slopes = f.jacobian([*y, *p]).subs(sp.sign(y[0]), sp.Symbol("side", real=True))
        change = sum((slopes[: self.smooth, :].diff(a) * b for a, b in zip(y, v, strict=True)),
                     sp.zeros(self.smooth, slopes.cols))  # fmt: skip
        side = sp.Symbol("side", real=True)
        return (
            self.compiled(f, [*y, *p]),
            self.compiled(slopes, [*y, *p, side]),
            self.compiled(change, [*y, *p, *v]),
        )

    def inputs(self, z: Interval, middle: bool) -> list[Interval]:
        values = [Interval(c) if middle else Interval(c - r, c + r) for c, r in self.parameters]
        lanes = z.lo.shape[1]
        return [
            *(z[i] for i in range(len(self.rates))),
            *(Interval(np.repeat(v.lo, lanes), np.repeat(v.hi, lanes)) for v in values),
        ]

    def over(self, z: Interval, *, middle: bool = False, **rest: Any) -> Rates:
        inputs = self.inputs(z, middle)
        f, slopes, _ = self.program
        side = Interval(np.where(z.lo[0] > 0, 1.0, -1.0), np.where(z.hi[0] < 0, -1.0, 1.0))
        return Rates(f(*inputs)[:, 0], slopes(*inputs, side), np.zeros(z.lo.shape[1], bool))

    def bend(self, z: Interval, rate: Interval) -> Interval:
        speeds = [rate[i] for i in range(len(self.rates))]
        return self.program[2](*self.inputs(z, False), *speeds)


A, B, C, D = sp.symbols("y:4", real=True)
P = sp.Symbol("p0", real=True)
ONE = sp.Integer(1)


def turned(t: Any, a: Any, b: Any, c: Any) -> list[Any]:
    angle = a * t + t**2 / 2
    cos, sin = mpmath.cos(angle), mpmath.sin(angle)
    return [a + t, b * cos + c * sin, c * cos - b * sin]


#: y(t) from (t, y(0), p).  Rates that grow with time, turn, blow up, bend at a corner, and hang on
#: a parameter, in a row by itself and in one that is fed by it.
TOYS = {
    "powers of time": Toy(
        (ONE, A**2 / 2, B),
        lambda t, a, b, c: [
            a + t,
            b + ((a + t) ** 3 - a**3) / 6,
            c + b * t + ((a + t) ** 4 - a**4) / 24 - a**3 * t / 6,
        ],
        3,
    ),
    "a gain that grows": Toy(
        (ONE, A * D, B, sp.Integer(0)),
        lambda t, a, b, c, d: [
            a + t,
            b + d * (a * t + t**2 / 2),
            c + b * t + d * (a * t**2 / 2 + t**3 / 6),
            d,
        ],
        4,
    ),
    "a turn that quickens": Toy((ONE, A * C, -A * B), turned, 3),
    "a turn, no order won": Toy((ONE, A * C, -A * B), turned, 1),
    "a fast decay": Toy((-5 * A,), lambda t, a: [a * mpmath.exp(-5 * t)], 1),
    "a blow-up": Toy((A**2, A * B), lambda t, a, b: [a / (1 - a * t), b / (1 - a * t)], 2),
    "a corner": Toy(
        (ONE, sp.Abs(A)),
        lambda t, a, b: [a + t, b + ((a + t) * abs(a + t) - a * abs(a)) / 2],
        1,
    ),
    "a parameter": Toy(
        (ONE, P * A, P * B),
        lambda t, a, b, c, p: [
            a + t,
            b + p * (a * t + t**2 / 2),
            c + p * b * t + p**2 * (a * t**2 / 2 + t**3 / 6),
        ],
        3,
        ((0.75, 0.25),),
    ),
    "a rate that is a parameter": Toy(
        (P * A, A + P * B),
        lambda t, a, b, p: [a * mpmath.exp(p * t), (b + a * t) * mpmath.exp(p * t)],
        2,
        ((-1.5, 0.5),),
    ),
}

#: Starts of each toy: the last one passes a corner at 0 within the steps below.
STARTS = np.array(
    [[0.5, -0.25, 1.0, 1.0], [-0.75, 2.0, 0.5, -1.0], [0.0, 0.0, 0.0, 0.0], [-0.01, 0.5, -1.0, 2.0]]
)


def corners(toy: Toy, start: FloatArray, radius: float) -> list[tuple[list[Any], list[Any]]]:
    """Ends of a box around a start, with every end of the parameters."""
    size = len(toy.rates)
    ends = [(-1, 1)] * size if radius else [(0,)] * size
    boxes = itertools.product(*ends, *([(-1, 0, 1)] * len(toy.parameters)))
    return [
        (
            [mpmath.mpf(float(v)) + s * radius for v, s in zip(start[:size], signs, strict=False)],
            [c + s * r for s, (c, r) in zip(signs[size:], toy.parameters, strict=True)],
        )
        for signs in ([*map(mpmath.mpf, s)] for s in boxes)
    ]


@pytest.mark.parametrize("radius", [0.0, 2.0**-7], ids=["points", "boxes"])
@pytest.mark.parametrize("name", TOYS)
def test_motions_in_closed_form_stay_inside(name: str, radius: float) -> None:
    """At every corner of the box of starts and parameters, over one and ten steps."""
    toy = TOYS[name]
    size = len(toy.rates)
    middle = STARTS[:, :size].T.copy()
    spread = radius * np.repeat(np.eye(size)[..., None], len(STARTS), axis=2)
    zero = Interval(np.zeros_like(middle))
    for h in (0.125, 2.0**-6, 2.0**-10):
        tubes = Tubes.of(toy, middle, spread, zero)
        for k in range(1, 11):
            tubes, _, _, moved = tubes.advance(h)
            assert moved.all()
            if k not in (1, 10):
                continue
            hull = tubes.hull
            with mpmath.workdps(50):
                for lane, start in enumerate(STARTS):
                    for y, p in corners(toy, start, radius):
                        there = toy.motion(k * mpmath.mpf(h), *y, *p)
                        for i, value in enumerate(there):
                            low, high = float(hull.lo[i, lane]), float(hull.hi[i, lane])
                            assert mpmath.mpf(low) <= value <= mpmath.mpf(high), (h, k, i, y, p)


#: Widths of the images of points after a step of 1/8, and of 1/16 by how much they are less.
EXCESS = {
    "powers of time": 1e-12,
    "a turn that quickens": 8e-4,
    "a turn, no order won": 8e-3,
    "a blow-up": 8e-2,
}


@pytest.mark.parametrize("name", EXCESS)
def test_steps_are_tight(name: str) -> None:
    """A point's image is wide by a stated excess, that falls as h⁴, or h³ without ``bend``."""
    toy = TOYS[name]
    size = len(toy.rates)
    middle = STARTS[:2, :size].T.copy()
    zero = Interval(np.zeros_like(middle))
    widths = []
    for h in (0.125, 0.0625):
        tubes, _, _, _ = Tubes.of(toy, middle, np.zeros((size, 0, 2)), zero).advance(h)
        widths.append(float((tubes.hull.hi - tubes.hull.lo).max()))
    assert widths[0] <= EXCESS[name]
    if widths[1] > 1e-12:
        assert widths[0] / widths[1] >= (11.0 if toy.smooth == size else 5.5)


@pytest.mark.parametrize("start", [1.5, 2.0, 2.5, 3.0])
def test_boxes_hold_the_whole_step(start: float) -> None:
    """A motion that quickens leaves the box that its first speed suggests: wider, or no step."""
    toy = TOYS["a blow-up"]
    middle = np.array([[start], [1.0]])
    zero = Interval(np.zeros((2, 1)))
    for h in (0.0625, 0.125, 0.25):
        tubes = Tubes.of(toy, middle, np.zeros((2, 0, 1)), zero)
        with np.errstate(all="ignore"):  # what found no box may overflow
            tubes, outer, rates, moved = tubes.advance(h)
        if not moved[0]:
            continue
        for part in np.linspace(0.0, 1.0, 17):
            a, b = toy.motion(part * h, start, 1.0)
            assert outer.lo[0, 0] <= a <= outer.hi[0, 0]
            assert outer.lo[1, 0] <= b <= outer.hi[1, 0]
            assert rates.rate.lo[0, 0] <= a * a <= rates.rate.hi[0, 0]
        assert tubes.hull.lo[0, 0] <= a <= tubes.hull.hi[0, 0]


def test_ends_of_a_box_keep_to_each_other() -> None:
    """From a line the motion makes a line: in every direction its image holds both ends."""
    toy = TOYS["a gain that grows"]
    middle, spread = np.zeros((4, 1)), np.zeros((4, 1, 1))
    spread[3] = 1.0
    rng = np.random.default_rng(0)
    for h in (0.25, 0.03125):
        tubes, _, _, _ = Tubes.of(toy, middle, spread, Interval(np.zeros((4, 1)))).advance(h)
        end = np.array([h, h**2 / 2, h**3 / 6, 1.0])
        rows = np.round(rng.uniform(-1, 1, (4000, 4)) * 2**20) / 2**20
        rows = rows * np.array([0, 2.0 * h**-2, 4.0 * h**-3, 0])  # of one size; exact in float64
        image = _image(tubes, rows)
        there = rows @ (end - np.array([h, 0, 0, 0]))
        slack = 1e-12
        assert (image.hi >= np.abs(there) - slack).all()
        assert (image.lo <= -np.abs(there) + slack).all()
        # The third row is only known to be in [0, h³/2]: so much more may be said.
        assert (image.hi <= np.abs(there) + 1.5).all()


def _image(tubes: Tubes, rows: FloatArray) -> Interval:
    parts = [tubes.image(Interval(rows[i : i + 4])) for i in range(0, len(rows), 4)]
    return Interval(
        np.concatenate([p.lo[:, 0] for p in parts]), np.concatenate([p.hi[:, 0] for p in parts])
    )


def test_a_set_knows_which_parameter_a_point_has() -> None:
    """Slopes times the way from the middle hold it at every corner, for parameters beside states.

    A point and its parameter are on the same side: of their difference little is left.
    """
    toy = TOYS["a parameter"]
    start = np.array([0.5, -0.25, 1.0])
    tubes = Tubes.of(
        toy, start[:, None], np.zeros((3, 0, 1)), Interval(np.zeros((3, 1)), np.zeros((3, 1)))
    )
    for _ in range(4):
        tubes, _, _, _ = tubes.advance(2.0**-6)
    middle, radius = toy.parameters[0]
    slope = np.zeros((1, 4, 1))
    slope[0, 1], slope[0, 3] = -16.0, 0.5
    held = tubes.way(Interval(slope))
    for side in (-1, 1):
        there = toy.motion(mpmath.mpf(2) ** -4, *map(float, start), middle + side * radius)
        value = slope[0, 1, 0] * (there[1] - tubes.middle[1, 0]) + 0.5 * side * radius
        assert float(held.lo[0, 0]) <= value <= float(held.hi[0, 0])
    assert float((held.hi - held.lo)[0, 0]) <= 0.02


#: A box's image after a turn in ten steps of 1/32 is larger than the truth by this part.
GROWTH = 4e-4


def test_a_box_is_carried_without_growing() -> None:
    """A turn by 1/5 rad leaves a thick set's size, but for a stated part."""
    toy = TOYS["a turn that quickens"]
    middle = np.array([[0.5], [1.0], [-2.0]])
    spread = np.zeros((3, 2, 1))
    spread[1, 0], spread[2, 1] = 0.25, 0.125
    tubes = Tubes.of(toy, middle, spread, Interval(np.zeros((3, 1))))
    for _ in range(10):
        tubes, _, _, _ = tubes.advance(2.0**-5)
    angle = 0.5 * 10 / 32 + (10 / 32) ** 2 / 2
    cos, sin = np.cos(angle), np.sin(angle)
    true = np.array([0.25 * cos + 0.125 * sin, 0.125 * cos + 0.25 * sin])
    half = 0.5 * (tubes.hull.hi - tubes.hull.lo)[1:, 0]
    assert (half >= true).all()
    assert (half <= (1 + GROWTH) * true).all()


# -- the loop of every mechanism ----------------------------------------------------------------


def points(mechanism: ut.Mechanism, count: int, seed: int) -> FloatArray:
    """States near and far: in the layer, beyond it, at the limit of the input."""
    n = mechanism.n
    rng = np.random.default_rng(seed)
    x = rng.uniform(-1, 1, (count, 2 * n)) * np.r_[np.full(n, 0.3), np.ones(n)]
    x[::2] *= 0.02
    return np.asarray(x)


#: Median width of the images of 40 points after 1 ms, twice what it is.
WIDTH = {"ball_and_beam": 1.4e-9, "tora": 4.2e-10, "reaction_wheel_pendulum": 1.2e-12}


@dataclass(frozen=True)
class Loop:
    """A mechanism under its first surface, as tubes see it and as power series do."""

    mechanism: ut.Mechanism

    @cached_property
    def surface(self) -> ut.Surface:
        return ut.first_surface(self.mechanism)

    @cached_property
    def motion(self) -> LoopMotion:
        return LoopMotion(self.mechanism, self.surface, LAW)

    def misses(
        self, count: int, seed: int, steps: Sequence[float], *, held: bool = False
    ) -> tuple[int, int, FloatArray]:
        """Thin tubes that miss the motion, how many were compared, the widths of the last."""
        reference = Reference(self.mechanism, self.surface, LAW)
        motion, size = self.motion, self.motion.size
        z = motion.from_state(points(self.mechanism, count, seed))
        truth = [reference.after(row, steps, held=held) for row in z]
        wrong, seen = 0, 0
        zero = Interval(np.zeros_like(z.T))
        for k, h in enumerate(steps):
            tubes = Tubes.of(motion, z.T.copy(), np.zeros((size, 0, count)), zero)
            if held:
                tubes, _ = SampledDataLoop(motion).sample(SampledDataLoop(motion).begin(tubes))
            tubes, _, _, moved = tubes.advance(h)
            hull = tubes.hull[:size]
            for lane in np.flatnonzero(moved):
                there = truth[lane][k]
                if there is None:
                    continue
                seen += 1
                wrong += not holds(hull.lo[:, lane], hull.hi[:, lane], there)
        return wrong, seen, np.asarray((hull.hi - hull.lo).max(axis=0))


@pytest.mark.parametrize("name", ["ball_and_beam", "tora", "reaction_wheel_pendulum"])
def test_thin_tubes_hold_the_loops_motion(name: str) -> None:
    """Of no point the image misses the motion, and the images are thin."""
    loop = Loop(ut.mechanisms.LIBRARY[name]())
    wrong, seen, widths = loop.misses(40, 0, [0.0005, 0.001])
    assert seen >= 40
    assert wrong == 0
    assert float(np.median(widths)) <= WIDTH[name]


def test_thin_tubes_hold_the_sampled_loops_motion() -> None:
    loop = Loop(ut.mechanisms.ball_and_beam())
    wrong, seen, _ = loop.misses(30, 1, [0.0005, 0.001], held=True)
    assert seen >= 50
    assert wrong == 0


@pytest.mark.slow
@pytest.mark.parametrize("name", ut.mechanisms.LIBRARY)
def test_thin_tubes_hold_the_motion_of_every_mechanism(name: str) -> None:
    """Some hundred points of each, at four steps, held or not: nine thousand tubes in all."""
    loop = Loop(ut.mechanisms.LIBRARY[name]())
    count = 120 if loop.mechanism.n == 2 else 12
    for held in (False, True):
        wrong, seen, _ = loop.misses(count, 2, [0.0003, 0.0007, 0.001, 0.002], held=held)
        assert seen >= count // 3
        assert wrong == 0
