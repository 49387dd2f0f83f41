"""The kernel's enclosures, on thin sets, against 50 digits and against motions in closed form.

Thick sets hide errors in their width, so boxes here are points or nearly so.
"""

from __future__ import annotations

import itertools
import random
from collections.abc import Callable
from fractions import Fraction
from functools import cache
from typing import Any

import mpmath
import numpy as np
import pytest

import undertow as ut
from undertow.proofs.claims.model_data import law_of, model_of
from undertow.proofs.kernel import compiled
from undertow.proofs.kernel.bound import Goal, settle
from undertow.proofs.kernel.compiled import between
from undertow.proofs.kernel.graph import Graph, Node, Span, depends
from undertow.proofs.kernel.model import System
from undertow.proofs.kernel.tube import Field, Tube

#: A function of mpmath's numbers.
Exact = Callable[..., Any]


class TooLargeError(Exception):
    """An argument that is passed over."""


def moderate(f: Exact) -> Exact:
    """The function for arguments of moderate size: mpmath takes its time for others."""

    def of(a: Any) -> Any:
        if not abs(a) < 600:
            raise TooLargeError
        return f(a)

    return of


ONE_OF: dict[str, Exact] = {
    "neg": lambda a: -a, "sqr": lambda a: a * a, "sqrt": mpmath.sqrt, "sin": moderate(mpmath.sin),
    "cos": moderate(mpmath.cos), "exp": moderate(mpmath.exp), "log": mpmath.log, "abs": abs,
}  # fmt: skip
TWO_OF: dict[str, Exact] = {
    "add": lambda a, b: a + b, "sub": lambda a, b: a - b, "mul": lambda a, b: a * b,
    "div": lambda a, b: a / b, "max": max, "min": min,
}  # fmt: skip


def expression(rng: random.Random, graph: Graph, depth: int) -> tuple[Node, Exact]:
    """A random expression in the first two inputs, and the same for mpmath."""
    if depth == 0 or rng.random() < 0.1:
        if rng.random() < 0.7:
            i = rng.randrange(2)
            return graph.inputs[i], lambda *x: x[i]
        c = Fraction(rng.randint(-30, 30), rng.randint(1, 12))
        return graph.number(c), lambda *x: mpmath.mpf(c.numerator) / c.denominator
    kind = rng.choice([*ONE_OF, *TWO_OF, "tanh", "power", "safe"])
    a, f = expression(rng, graph, depth - 1)
    if kind == "tanh":
        return graph.tanh(a), lambda *x: moderate(mpmath.tanh)(f(*x))
    if kind == "power":
        k = rng.randint(2, 6)
        return graph.power(a, k), lambda *x: f(*x) ** k
    if kind == "safe":  # √(2 + a²), defined everywhere
        square = graph.make("add", graph.number(2), graph.make("sqr", a))
        return graph.make("sqrt", square), lambda *x: mpmath.sqrt(2 + f(*x) ** 2)
    if kind in ONE_OF:
        return graph.make(kind, a), lambda *x: ONE_OF[kind](f(*x))
    b, g = expression(rng, graph, depth - 1)
    return graph.make(kind, a, b), lambda *x: TWO_OF[kind](f(*x), g(*x))


def evaluated(f: Exact, *x: Any) -> Any:
    """f there, or None where it is not a real number of moderate size."""
    try:
        value = f(*x)
    except (ZeroDivisionError, ValueError, OverflowError, TypeError):
        return None
    if not (isinstance(value, mpmath.mpf) and mpmath.isfinite(value)):
        return None
    if abs(value) > 1e200:
        raise TooLargeError
    return value


def within(value: complex, true: Any) -> bool:
    """Whether an enclosure holds a number; it is known to some 50 digits, its derivatives to 25."""
    slack = mpmath.mpf(10) ** -25 * (1 + abs(true))
    return bool(mpmath.mpf(value.real) - slack <= true <= mpmath.mpf(value.imag) + slack)


def enclosures(count: int, seed: int) -> tuple[int, int, int, list[float]]:
    """Values of random expressions on points and thin boxes: misses, seen, unbounded, excess."""
    rng = random.Random(seed)
    misses = seen = unknown = 0
    excess = []
    with mpmath.workdps(50):
        for _ in range(count):
            graph = Graph(2)
            node, f = expression(rng, graph, rng.randint(1, 5))
            program = graph.program([node])
            x = [rng.uniform(-4, 4), rng.choice([0.0, 1.0, rng.uniform(-4, 4), 1e-9])]
            radius = rng.choice([0.0, 0.0, 1e-12, 1e-6])
            low, high = np.array(x) - radius, np.array(x) + radius
            value = complex(program(between(low, high))[0, 0])
            ends = [
                (a, 0.5 * a + 0.5 * b, b) for a, b in zip(low.tolist(), high.tolist(), strict=True)
            ]
            try:
                true = [evaluated(f, *map(mpmath.mpf, p)) for p in itertools.product(*ends)]
            except TooLargeError:
                continue
            if any(v is None for v in true) or np.isnan(value):
                unknown += 1
                # Undefined is never hidden: where a value at a point is not real, so is the answer.
                misses += radius == 0 and true[0] is None and bool(np.isfinite(value))
                continue
            seen += 1
            misses += not all(within(value, v) for v in true)
            spread = float(max(true) - min(true))
            size = max(1e-300, float(max(abs(v) for v in true)))
            if radius == 0:
                excess.append(float(value.imag - value.real - spread) / size)
    return misses, seen, unknown, excess


def test_random_expressions_are_enclosed() -> None:
    """No miss; most points are known to fifteen digits; not many are given up."""
    misses, seen, unknown, excess = enclosures(700, 0)
    assert misses == 0
    assert seen > 4 * unknown / 3
    assert float(np.median(excess)) < 1e-14


@pytest.mark.slow
def test_many_random_expressions_are_enclosed() -> None:
    assert enclosures(100_000, 1)[0] == 0


#: The largest double, and ends of intervals from all over the range, unbounded ones among them.
MOST = float(np.finfo(float).max)
SIZES = (0.0, 5e-324, 1e-308, 1 / 3, 1.0, 1e6 + 1.0, 1e154, MOST, np.inf)
ENDS = sorted({sign * size for sign in (-1.0, 1.0) for size in SIZES})


def members(low: float, high: float) -> set[Fraction]:
    """Numbers of an interval: its ends, the farthest doubles of an unbounded one, and 0."""
    ends = {Fraction(min(max(end, -MOST), MOST)) for end in (low, high)}
    return ends | ({Fraction(0)} if low <= 0 <= high else set())


@pytest.mark.parametrize("kind", ["add", "sub", "mul", "div", "max", "min", "neg", "sqr", "abs"])
def test_operations_hold_exact_results_up_to_the_ends_of_the_doubles(kind: str) -> None:
    """Where they overflow, underflow and are unbounded; undefined is division by 0 and no other."""
    op, f = getattr(compiled, kind.upper()), (TWO_OF | ONE_OF)[kind]
    boxes = [(a, b) for a, b in itertools.combinations_with_replacement(ENDS, 2)
             if (a, b) not in ((np.inf, np.inf), (-np.inf, -np.inf))]  # fmt: skip
    pairs = list(itertools.product(boxes, boxes if kind in TWO_OF else [(1.0, 1.0)]))
    for x, y in random.Random(0).sample(pairs, min(len(pairs), 4000)):
        value = compiled.apply(op, complex(*x), complex(*y))
        if kind == "div" and y[0] <= 0 <= y[1]:
            assert np.isnan(value)
            continue
        sides = (members(*x), members(*y)) if kind in TWO_OF else (members(*x),)
        for values in itertools.product(*sides):
            assert value.real <= f(*values) <= value.imag, (x, y, values)


@pytest.mark.parametrize("kind", ["sqrt", "sin", "cos", "exp", "log"])
def test_functions_hold_their_values_up_to_the_ends_of_the_doubles(kind: str) -> None:
    """At doubles, on the widest intervals and on halves of the line."""
    op = getattr(compiled, kind.upper())
    sizes = [*SIZES[:-1], np.pi / 2, np.pi, 40.0, 699.0, 701.0, 708.9, 709.5, 999999.0]
    points = sorted({sign * size for sign in (-1.0, 1.0) for size in sizes})
    with mpmath.workdps(400):
        f = cache(lambda at: getattr(mpmath, kind)(mpmath.mpf(at)))
        for low, high in itertools.combinations_with_replacement([*points, np.inf], 2):
            if low == np.inf:  # no interval
                continue
            value = compiled.apply(op, complex(low, high), complex(low, high))
            if kind in ("sqrt", "log") and not low > 0:
                assert np.isnan(value)
                continue
            for at in (at for at in points if low <= at <= high):
                assert value.real <= f(at) <= value.imag, (low, high, at)
            assert kind not in ("sin", "cos") or (value.real >= -1 and value.imag <= 1)


def smooth(rng: random.Random, graph: Graph) -> tuple[Node, Exact]:
    """A random expression that has derivatives."""
    while True:
        node, f = expression(rng, graph, rng.randint(2, 4))
        kinds = {k.kind for k in depends([node])}
        if not kinds & {"abs", "max", "min"} and node.number is None:
            return node, f


def derivatives(count: int, seed: int) -> tuple[int, int]:
    """First derivatives, and coefficients in time along ẋ = (1, ½), at points: misses, seen."""
    rng = random.Random(seed)
    misses = seen = 0
    with mpmath.workdps(50):
        for _ in range(count):
            graph = Graph(3)
            node, f = smooth(rng, graph)
            program = graph.program([graph.number(1), graph.number(Fraction(1, 2)), node])
            x = np.array([rng.uniform(-3, 3), rng.uniform(-3, 3), 0.0])
            a, b = (mpmath.mpf(v) for v in x[:2].tolist())
            try:
                if evaluated(f, a, b) is None:
                    continue
            except TooLargeError:
                continue
            slopes = program(between(x, x), 2)[2, 1:]
            series = program.series(between(x, x), 6)[2, 1:, 0]
            if not (np.isfinite(slopes).all() and np.isfinite(series).all()):
                continue
            size = np.abs(np.concatenate([slopes, series]).view(float)).max()
            if not size < 1e15:
                continue
            true = [mpmath.diff(f, (a, b), (1, 0)), mpmath.diff(f, (a, b), (0, 1))]
            taylor = mpmath.taylor(lambda t: f(a + t, b + t / 2), 0, 5)  # noqa: B023
            seen += 1
            misses += not all(within(v, t) for v, t in zip(slopes, true, strict=True))
            misses += not all(
                within(v, t / (k + 1)) for k, (v, t) in enumerate(zip(series, taylor, strict=True))
            )
    return misses, seen


def test_derivatives_and_taylor_coefficients_are_enclosed() -> None:
    misses, seen = derivatives(250, 0)
    assert seen > 60
    assert misses == 0


@pytest.mark.slow
def test_many_derivatives_are_enclosed() -> None:
    assert derivatives(5000, 1)[0] == 0


def test_zero_times_undefined_is_undefined() -> None:
    """0 · (1/x) is not defined at 0, folded or not; 0 · x is 0."""
    graph = Graph(1)
    x = graph.inputs[0]
    inverse = graph.make("div", graph.number(1), x)
    nodes = [graph.make("mul", graph.number(0), v) for v in (inverse, x, graph.make("log", x))]
    values = graph.program(nodes)(between([-1.0], [1.0]))[:, 0]
    assert np.isnan(values[0])
    assert nodes[1].number == 0
    assert np.isnan(values[2])


def test_formulas_on_arrays_are_those_of_their_nodes() -> None:
    """Equal ones are one object, with numbers and arrays on either side; 0 · y falls away."""
    graph = Graph(2)
    x, y = graph.inputs
    make = graph.make
    first, second = np.array([[x, graph.number(0)], [y, 1 / x]], dtype=object) @ graph.inputs
    assert first is make("sqr", x)
    assert second is make("add", make("mul", y, x), make("mul", make("div", 1, x), y))
    assert list(2 - graph.inputs) == [make("sub", 2, x), make("sub", 2, y)]
    assert list(y / graph.inputs) == [make("div", y, x), make("div", y, y)]
    thirds = graph.numbers([Fraction(1, 3), 2])
    assert thirds @ -abs(graph.inputs) is make(
        "add",
        make("mul", Fraction(1, 3), make("neg", make("abs", x))),
        make("mul", 2, make("neg", make("abs", y))),
    )


@pytest.mark.parametrize(("kind", "at"), [("log", 0), ("log", -1), ("sqrt", -1), ("exp", 1000)])
def test_no_number_is_made_of_what_is_undefined_or_too_large(kind: str, at: int) -> None:
    """Whether one of its ends is no number or both are."""
    graph = Graph(1)
    with pytest.raises(ZeroDivisionError, match=f"{kind} of a number"):
        graph.exact([graph.make(kind, graph.inputs[0])], [Span(Fraction(at))])


def test_a_root_of_a_square_is_no_way_round_a_kink() -> None:
    """√(x²) is refused where x may be 0, and is |x| elsewhere."""
    graph = Graph(1)
    root = graph.program([graph.make("sqrt", graph.make("sqr", graph.inputs[0]))])
    assert np.isnan(root(between([-1e-9], [1e-9]))).all()
    value = root(between([-2.0], [-1.0]))[0, 0]
    assert value.real <= 1.0
    assert 2.0 <= value.imag < 2.0001


def test_what_touches_its_bound_is_left_open_where_it_does() -> None:
    """(x² − 2)² > 0 but at √2, which is no double: boxes around it are not halved for ever."""
    graph = Graph(1)
    gap = graph.make("sub", graph.make("sqr", graph.inputs[0]), graph.number(2))
    program = graph.program([graph.make("sqr", gap)])
    box, none = [(Fraction(1), Fraction(2))], np.empty(0, dtype=complex)
    found = settle(program, box, none, [Goal("more than 0")], max_boxes=5000)
    assert (found.kind, found.why) == ("undecided", "more than 0")
    assert found.point[0] == pytest.approx(2**0.5, rel=1e-6)
    assert found.boxes < 1000
    beside = settle(program, [(Fraction(1), Fraction(7, 5))], none, [Goal("more than 0")], 5000)
    assert beside.kind == "proved"


# -- tubes ----------------------------------------------------------------------------------------


def decay(graph: Graph) -> list[Node]:
    return [graph.make("mul", graph.number(-5), graph.inputs[0])]


def powers(graph: Graph) -> list[Node]:
    """The three rates whose drift an earlier integrator lost: (1, y₁²/2, y₂)."""
    a, b, _ = graph.inputs
    return [
        graph.number(1),
        graph.make("mul", graph.number(Fraction(1, 2)), graph.make("sqr", a)),
        b,
    ]


def turning(graph: Graph) -> list[Node]:
    a, b, c = graph.inputs
    return [graph.number(1), graph.make("mul", a, c), graph.make("neg", graph.make("mul", a, b))]


def blow_up(graph: Graph) -> list[Node]:
    a, b = graph.inputs
    return [graph.make("sqr", a), graph.make("mul", a, b)]


def corner(graph: Graph) -> list[Node]:
    a, _ = graph.inputs
    return [graph.number(1), graph.make("abs", a)]


def growth(graph: Graph) -> list[Node]:
    """ẏ = e^(−y): y = log(e^a + t)."""
    return [graph.make("exp", graph.make("neg", graph.inputs[0]))]


def turned(t: Any, a: Any, b: Any, c: Any) -> list[Any]:
    angle = a * t + t**2 / 2
    cos, sin = mpmath.cos(angle), mpmath.sin(angle)
    return [a + t, b * cos + c * sin, c * cos - b * sin]


def raised(t: Any, a: Any, b: Any, c: Any) -> list[Any]:
    end = a + t
    return [end, b + (end**3 - a**3) / 6, c + b * t + (end**4 - a**4) / 24 - a**3 * t / 6]


#: Rates, the solution from (t, y(0)), and the width allowed for a point after ten steps of 1/8.
TOYS: dict[str, tuple[Callable[[Graph], list[Node]], Exact, int, float]] = {
    "a fast decay": (decay, lambda t, a: [a * mpmath.exp(-5 * t)], 1, 1e-11),
    "powers of time": (powers, raised, 3, 1e-11),
    "a turn that quickens": (turning, turned, 3, 1e-11),
    "a blow-up": (blow_up, lambda t, a, b: [a / (1 - a * t), b / (1 - a * t)], 2, 1e-8),
    "a corner": (
        corner, lambda t, a, b: [a + t, b + ((a + t) * abs(a + t) - a * abs(a)) / 2], 2, 0.05
    ),
    "a logarithm": (growth, lambda t, a: [mpmath.log(mpmath.exp(a) + t)], 1, 1e-8),
}  # fmt: skip

#: The last passes a corner at 0 on its way.
STARTS = ([0.5, -0.25, 1.0], [-0.75, 2.0, 0.5], [0.0, 0.0, 0.0], [-0.01, 0.5, -1.0])


@pytest.mark.parametrize("radius", [0.0, 2.0**-30, 2.0**-7], ids=["points", "thin", "boxes"])
@pytest.mark.parametrize("name", TOYS)
def test_motions_in_closed_form_stay_inside(name: str, radius: float) -> None:
    """At every corner of the box of starts, after one and after ten steps."""
    rates, solution, size, width = TOYS[name]
    graph = Graph(size)
    field = Field(graph, rates(graph))
    none = np.zeros(0, dtype=complex)
    for h, start in itertools.product((0.125, 2.0**-6, 2.0**-10), STARTS):
        middle = np.array(start[:size])
        tube = Tube.of(none, np.column_stack([middle - radius, middle + radius]))
        for k in range(1, 11):
            assert field.advance(tube, h) is not None
            if k not in (1, 10):
                continue
            with mpmath.workdps(50):
                for signs in itertools.product((-1, 0, 1), repeat=size):
                    y = [mpmath.mpf(v) + s * radius for v, s in zip(start, signs, strict=False)]
                    for own, value in zip(tube.hull, solution(k * mpmath.mpf(h), *y), strict=True):
                        assert mpmath.mpf(own.real) <= value <= mpmath.mpf(own.imag), (
                            name,
                            h,
                            k,
                            start,
                            signs,
                        )
        if radius == 0:
            assert (tube.hull.imag - tube.hull.real).max() <= width


def test_a_motion_that_leaves_the_domain_has_no_tube() -> None:
    """ẏ = −1/(2y) reaches 0 at t = y(0)², ẏ = y² escapes at 1/y(0): no enclosure past it."""
    for falls in (True, False):
        graph = Graph(1)
        x = graph.inputs[0]
        half = graph.number(Fraction(-1, 2))
        rate = graph.make("div", half, x) if falls else graph.make("sqr", x)
        field = Field(graph, [rate])
        tube = Tube.of(np.zeros(0, dtype=complex), np.array([[1.0, 1.0]]))
        steps = 0
        while steps < 200 and field.advance(tube, 1 / 64) is not None:
            steps += 1
        assert 32 < steps <= 64


def loop_misses(
    name: str, count: int, seed: int, times: tuple[float, ...]
) -> tuple[int, int, list[float]]:
    """Thin tubes of a mechanism's clipped closed loop against power series of 60 digits.

    In the coordinates (q, p, s); what the reference has of q and q̇ is compared with their image.
    """
    flint = pytest.importorskip("flint", reason="the reference takes the extra undertow[appendix]")
    from motions import BITS, ORDER, Reference, exact

    rig = ut.mechanisms.LIBRARY[name]()
    surface, reaching = ut.first_surface(rig), ut.ReachingLaw()
    model = model_of(rig)
    law, n = law_of(rig, surface, reaching), model.n
    own, plain = System(model, law, momenta=True), System(model, law)
    field, states = Field(own.graph, own.sliding()), own.graph.program(own.x)
    coordinates = plain.graph.program(plain.momentum_and_surface())
    reference = Reference(rig, surface, reaching)
    rng = np.random.default_rng(seed)
    misses, seen, widths = 0, 0, []
    for k in range(count):
        x = rng.uniform(-1, 1, 2 * n) * np.r_[np.full(n, 0.3), np.ones(n)] * (0.02 if k % 2 else 1)
        tube = Tube.of(own.fixed(), np.column_stack([x, x]))
        assert tube.map(coordinates)
        with flint.ctx.workprec(BITS):
            x0 = [exact(v) for v in x]
            pieces = reference.pieces(x0)
            series = reference.motion(x0, lambda x: reference.rate(x, *pieces))  # noqa: B023
            before = 0.0
            for t in times:
                if field.advance(tube, t - before) is None:
                    break
                before = t
                there = [sum(v[j] * exact(t) ** j for j in range(ORDER)) for v in series]
                if reference.pieces(there) != pieces:
                    break
                seen += 1
                misses += not all(
                    exact(own.real) <= v <= exact(own.imag)
                    for v, own in zip(there, tube.image(states), strict=True)
                )
                widths.append(float((tube.hull.imag - tube.hull.real).max()))
    return misses, seen, widths


@pytest.mark.parametrize("name", ["rotary_pendulum", "ball_and_beam", "tora"])
def test_thin_tubes_hold_the_motion_of_the_loop(name: str) -> None:
    misses, seen, widths = loop_misses(name, 16, 0, (2.0**-11, 2.0**-10))
    assert misses == 0
    assert seen >= 16
    assert float(np.median(widths)) < 1e-10


@pytest.mark.slow
@pytest.mark.parametrize("name", ut.mechanisms.LIBRARY)
def test_thin_tubes_hold_the_motion_of_every_mechanism(name: str) -> None:
    misses, seen, _ = loop_misses(name, 60, 1, (2.0**-12, 2.0**-11, 2.0**-10, 2.0**-9))
    assert misses == 0
    assert seen >= 30
