"""The kernel's closed loop: coordinates, pieces and corners, and boxes of starts that converge."""

from __future__ import annotations

import math
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import mpmath
import numpy as np
import pytest

import undertow as ut
from undertow.base import InvalidInputError
from undertow.law import ReachingLaw, SlidingModeLaw
from undertow.models import FloatArray
from undertow.proofs.claims.certificate import Certificate
from undertow.proofs.claims.closed_loop import LoopClaim
from undertow.proofs.claims.document import document_bytes
from undertow.proofs.claims.model_data import law_of, model_of
from undertow.proofs.claims.terminal_ellipsoid import TerminalEllipsoid as Ellipsoid
from undertow.proofs.claims.verify import proved_sets, verify
from undertow.proofs.claims.words import sentence
from undertow.proofs.claims.written import claim_data
from undertow.proofs.kernel.claims import (
    STEP,
    ClosedLoop,
    TerminalEllipsoid,
    decide,
    read_claim,
)
from undertow.proofs.kernel.compiled import between
from undertow.proofs.kernel.graph import Graph, Program
from undertow.proofs.kernel.loop import ContinuousLoop
from undertow.proofs.kernel.model import System
from undertow.proofs.kernel.reader import Refused, read
from undertow.proofs.search.closed_loop import _largest_box, _Task, _terminal, prove_loop
from undertow.proofs.search.terminal_ellipsoid import search_for
from undertow.studies.certification import loop_figure
from undertow.studies.paper.appendix import CASES

ROOT = Path(__file__).parents[2]
RIG = ut.mechanisms.rotary_pendulum(d_e=0.073)
SURFACE, LAW = CASES[3].surface, ReachingLaw()
MODEL, NUMBERS = model_of(RIG), law_of(RIG, SURFACE, LAW)
STEERED = SlidingModeLaw(RIG, SURFACE, LAW)


def terminal() -> TerminalEllipsoid:
    search = search_for(RIG, SURFACE, LAW)
    assert search is not None
    found = search.around([-0.0117, 0.0071, 0.053, -0.0265])
    assert found is not None
    W = tuple(tuple(Fraction(float(v)) for v in row) for row in found.W)
    return TerminalEllipsoid(W, Fraction(float(found.radius)))


def claim(**starts: float) -> ClosedLoop:
    box = {name: (-Fraction(v), Fraction(v)) for name, v in starts.items()}
    return ClosedLoop(box, Fraction(0), {}, (Fraction(0),) * 2, Fraction(0), terminal())


def test_derivatives_along_a_motion_are_those_of_the_functions() -> None:
    graph = Graph(2)
    a, b = graph.inputs
    make = graph.make
    one = make("add", make("sqr", make("sin", make("mul", a, b))), graph.number(2))
    root = make("sqrt", one)
    ratio = make("div", make("exp", make("neg", make("cos", a))), make("log", one))
    speeds = {a: graph.number(Fraction(1, 2)), b: graph.number(-3)}
    at = np.array([0.3, 0.7])
    found = graph.program(graph.tangents([root, ratio], speeds))(between(at, at))[:, 0]

    def values(t: object) -> list[object]:
        x, y = 0.3 + t / 2, 0.7 - 3 * t  # type: ignore[operator]
        two = mpmath.sin(x * y) ** 2 + 2
        return [mpmath.sqrt(two), mpmath.exp(-mpmath.cos(x)) / mpmath.log(two)]

    with mpmath.workdps(30):
        for k, value in enumerate(found):
            exact = mpmath.diff(lambda t, k=k: values(t)[k], 0)
            assert value.real <= exact <= value.imag
            assert value.imag - value.real < 1e-12
    with pytest.raises(ArithmeticError, match="max: not smooth"):
        graph.tangents([make("max", a, b)], speeds)


@pytest.mark.parametrize("name", ["rotary_pendulum", "double_pendulum_on_a_cart", "tora"])
def test_the_coordinates_carry_the_plants_own_motion(name: str) -> None:
    """d/dt of (q, p, s) along the mechanism's motion under the clipped law, by differences."""
    rig = ut.mechanisms.LIBRARY[name]()
    surface, n = ut.first_surface(rig), rig.n
    model, law = model_of(rig), law_of(rig, surface, LAW)
    own, plain = System(model, law, momenta=True), System(model, law)
    rates, back = own.graph.program(own.sliding()), own.graph.program(own.x)
    there = plain.graph.program(plain.momentum_and_surface())
    fixed = own.fixed().real

    def at(program: Program, x: FloatArray) -> FloatArray:
        point = np.r_[x, fixed]
        return program(between(point, point))[:, 0].real

    rng, clipped = np.random.default_rng(0), 0
    for _ in range(30):
        x = rng.uniform(-1, 1, 2 * n) * np.repeat([0.4, 20.0], n)
        u = SlidingModeLaw(rig, surface, LAW)(0.0, x)
        clipped += bool((np.abs(u.demand) > rig.input_limits).any())
        x_dot, h = np.r_[x[n:], rig.accelerations(0.0, x, u.u)], 1e-6
        z = at(there, x)
        assert at(back, z) == pytest.approx(x, rel=1e-9, abs=1e-9)
        slope = (at(there, x + h * x_dot) - at(there, x - h * x_dot)) / (2 * h)
        assert at(rates, z) == pytest.approx(slope, rel=1e-4, abs=1e-4)
    assert clipped > 0


def rk4(x: FloatArray, duration: float, h: float, law: SlidingModeLaw = STEERED) -> FloatArray:

    def f(x: FloatArray) -> FloatArray:
        return np.hstack([x[:, 2:], RIG.accelerations(0.0, x, law(0.0, x).u)])

    for _ in range(round(duration / h)):
        a = f(x)
        b = f(x + h / 2 * a)
        c = f(x + h / 2 * b)
        x = x + h / 6 * (a + 2 * b + 2 * c + f(x + h * c))
    return x


def test_tubes_hold_motions_across_the_clip_and_the_layer() -> None:
    """Case 2 from 40.5°: 15 V are met and left, and the edge of the layer is passed."""
    law, numbers = SlidingModeLaw(RIG, CASES[1].surface, LAW), law_of(RIG, CASES[1].surface, LAW)
    loop, wide = (
        ContinuousLoop(MODEL, numbers, ((Fraction(0),) * 4,) * 4, Fraction(1), STEP),
        2.0**-13,
    )
    own = System(MODEL, numbers, momenta=True)
    states = own.graph.program(own.x)
    first = math.radians(40.5)
    box = np.array([[0.0, 0.0], [first, first + wide], [0.0, 0.0], [0.0, 0.0]])
    tube = loop.tube(box)
    assert tube.map(loop.coordinates)
    x = np.zeros((5, 4))
    x[:, 1] = np.linspace(first, first + wide, 5)
    met = set[tuple[bool, bool]]()
    assert tube.hull[3].real > 0.1
    for _ in range(64):
        assert loop.advance(tube)
        x = rk4(x, 1 / 128, 1 / 1024, law)
        low, high = tube.image(states).real, tube.image(states).imag
        assert (x >= low - 1e-5).all()
        assert (x <= high + 1e-5).all()
        assert (high - low).max() < 0.3
        clipped, inside = np.abs(law(0.0, x).demand) > 15, np.abs(tube.hull[3:].view(float)) < 0.1
        met.add((bool(clipped.all()), bool(inside.all())))
    assert met >= {(True, False), (False, False), (False, True)}


def test_a_line_of_starts_converges_and_the_sentence_says_what() -> None:
    found = decide(MODEL, NUMBERS, claim(phi=0.01))
    assert found.kind == "proved", found.why
    for words in (
        "every motion from starts with |phi| ≤ 0.01 rad, the other coordinates at the target",
        "its input clipped to |voltage| ≤ 15.0 V and renewed at every instant",
        "the plant the model, no other force",
    ):
        assert words in sentence(claim(phi=0.01), MODEL)


def test_cuts_say_where_tubes_begin_and_decide_nothing() -> None:
    """Points outside of the starts, or twice, cut nothing; what is cut is all followed."""
    whole = claim(phi=0.01)
    cut = replace(whole, cuts={"phi": tuple(Fraction(k, 1000) for k in (7, 3, 3, -5, 20))})
    one, three = decide(MODEL, NUMBERS, whole), decide(MODEL, NUMBERS, cut)
    assert one.kind == three.kind == "proved"
    assert sentence(whole, MODEL) == sentence(cut, MODEL)
    assert three.details["tubes"] == 3 > one.details["tubes"]
    far = replace(cut, starts={"phi": (Fraction(4, 5), Fraction(4, 5))})
    assert decide(MODEL, NUMBERS, far).kind == "undecided"  # 45.8° falls


@pytest.mark.slow
def test_a_proved_line_is_found_written_gated_and_drawn() -> None:
    """The search cuts it for the kernel; the gate's set is it, and a picture shows it."""
    found = prove_loop(RIG, SURFACE, LAW, starts={"phi": 0.05})
    assert found.verdict, found.verdict
    assert found.verdict.margin == 0.05
    starts = found.claim.proved_set(RIG, SURFACE, LAW)
    assert starts is not None
    assert starts.contains(RIG.state(phi=-0.0499))
    assert not starts.contains(RIG.state(phi=0.0501))
    content = document_bytes(RIG, [(SURFACE, LAW, [found.claim.stated(RIG, found.verdict)])], {})
    again = verify(Certificate.from_bytes(content), RIG)
    assert [item.verdict.claim for item in again] == [found.verdict.claim]
    assert proved_sets(RIG, again)[0].contains(RIG.state(phi=0.0499))
    figure = loop_figure(RIG, SURFACE, LAW, found.claim, "case 4")
    left, right = figure.axes
    assert left.get_ylabel() == "φ (°)"
    assert len(left.lines) > 10
    assert right.patches
    for words, wrong in (
        ("one state or more", {}),
        ("state of the starts", {"psi": 0.05}),
        ("size of the starts in phi", {"phi": math.nan}),
    ):
        with pytest.raises(InvalidInputError, match=words):
            prove_loop(RIG, SURFACE, LAW, starts=wrong)


@pytest.mark.slow
def test_another_mechanism_is_proved_by_the_same_code() -> None:
    """A cart pendulum, from its own expressions, with the surface found for it."""
    cart = ut.mechanisms.cart_pendulum()
    name = cart.coordinates[1].name
    found = prove_loop(cart, ut.first_surface(cart), LAW, starts={name: 0.4})
    assert found.verdict, found.verdict
    assert found.verdict.margin > 0.1


@pytest.mark.slow
def test_a_box_that_is_lost_is_made_thinner_whatever_the_reach() -> None:
    """Of a known plant there is nothing else to cut: the search got stuck at 0.026 rad here."""
    crane = ut.mechanisms.overhead_crane()
    found = prove_loop(crane, ut.first_surface(crane), starts={"theta": 1.0}, seconds=12)
    assert found.verdict.margin > 0.04


class Balls:
    """Proves the balls of the state space that are no larger than one."""

    def __init__(self, largest: float) -> None:
        self.largest = largest

    def around(self, state: FloatArray) -> Ellipsoid | None:
        size, one = float(np.linalg.norm(state)), np.eye(len(state))
        return Ellipsoid(one, one, size) if size <= self.largest else None


def test_the_terminal_set_is_one_that_the_motions_enter() -> None:
    """Of eight that shrink alike, from ever farther starts; the farthest breaks off."""
    sizes, fall = np.linspace(0.1, 0.8, 8), 0.9 ** np.arange(60)
    path = fall[:, None, None] * sizes[:, None] * np.array([0.5, -0.5, 0.5, 0.5])
    path[20:, -1] = np.nan
    found = _terminal(Balls(0.2), path)  # type: ignore[arg-type]
    assert found is not None
    assert found.radius <= 0.2
    for motion in path[:, :-1].swapaxes(0, 1):
        assert any(found.contains(x) for x in motion)
    assert _terminal(Balls(0.0), path) is None  # type: ignore[arg-type]


class Thin:
    """A loop whose tubes arrive where φ is at most so wide, and so far off; θ never matters."""

    step = complex(0.01, 0.01)

    def __init__(self) -> None:
        self.met: list[FloatArray] = []

    def follow(self, box: FloatArray, most: int) -> tuple[int, bool]:
        self.met.append(box)
        wide, far = np.ptp(box[1]), np.abs(box[1]).max()
        return int(1 / (wide + 1e-9)), bool(wide <= 0.011 and far <= 0.1)


def test_a_box_grows_as_far_as_its_pieces_arrive_cut_where_that_helps() -> None:
    """The pieces that are met cover what is claimed, on one side of θ; φ alone is cut finely."""
    task = _Task(RIG, SURFACE, LAW, {"theta": 0.4, "phi": 0.2, "phi_dot": 0.1}, Fraction(0), {})
    loop = Thin()
    part, cuts = _largest_box(task, loop, math.inf, lambda _: None)  # type: ignore[arg-type]
    assert 0.98 * 0.5 <= part <= 0.5
    assert set(cuts) == {"theta", "phi"}  # θ at 0 only, the edge of the side that is followed
    assert cuts["theta"] == [0.0]
    assert 17 <= len(cuts["phi"]) < 36  # 18 pieces at least
    edges = np.array([-0.2 * part, *cuts["phi"], 0.2 * part])
    assert (np.diff(edges) <= 0.011).all()
    last = np.array([box for box in loop.met if box[0, 1] == pytest.approx(0.4 * part)])
    assert {*last[:, 1, 0]} >= {*edges[:-1]}
    assert (last[:, 0, 0] == 0.0).all()
    assert _largest_box(task, loop, 0.0, lambda _: None)[0] == 0.0  # type: ignore[arg-type]


@pytest.mark.slow
def test_a_box_of_full_dimension_is_found_and_proved() -> None:
    """TORA's, as large as one that was cut by hand, from nothing but its shape."""
    rig = ut.mechanisms.tora()
    shape = {"theta": 0.4, "x": 0.16, "theta_dot": 0.6, "x_dot": 0.2}
    found = prove_loop(rig, ut.first_surface(rig), starts=shape, seconds=40)
    assert found.verdict, found.verdict
    ends = found.claim.box(rig)
    assert ends[:, 1] == pytest.approx(found.verdict.margin / 0.4 * np.array([*shape.values()]))
    assert ends[:, 0] == pytest.approx(-ends[:, 1])
    assert found.verdict.margin >= 0.27
    data = dict(found.claim.data)
    alone = {"starts": {"theta_dot": data["starts"]["theta_dot"]}}
    rate = LoopClaim({**data, **alone, "hint": {"terminal": data["hint"]["terminal"]}})
    for claim, wide in ((found.claim, True), (rate, False)):
        left, right = loop_figure(rig, ut.first_surface(rig), LAW, claim, "").axes
        assert (left.get_ylabel(), right.get_ylabel()) == ("θ (°)", "dθ/dt (°/s)")
        bar = max(right.lines, key=lambda line: line.get_linewidth()).get_xydata()
        ends = np.degrees(found.claim.box(rig)[[0, 2], 1]) * [wide, 1]
        assert np.abs(bar).max(axis=0) == pytest.approx(ends)


def test_starts_of_full_dimension_converge() -> None:
    """A box of states, all four off the target, is one tube."""
    loop = ContinuousLoop(MODEL, NUMBERS, terminal().W, terminal().radius, STEP)
    box = np.array([[0.02, 0.021], [0.1, 0.1005], [-0.1, -0.099], [0.05, 0.051]])
    steps, there = loop.follow(box)
    assert there
    assert 50 < steps < 500


def test_what_is_false_or_not_decided_is_not_proved() -> None:
    """45.5° falls in simulation; a larger ellipsoid is no terminal set."""
    last = rk4(np.array([[0.0, math.radians(45.5), 0.0, 0.0]]), 1.0, 5e-3)
    assert not abs(last[0, 1]) < 0.5
    loop = ContinuousLoop(MODEL, NUMBERS, terminal().W, terminal().radius, STEP)
    end = math.radians(45.5)
    assert not loop.follow(np.array([[0.0, 0.0], [end, end], [0.0, 0.0], [0.0, 0.0]]))[1]
    good = claim(phi=0.01)
    assert good.terminal is not None
    grown = replace(good, terminal=replace(good.terminal, radius=100 * good.terminal.radius))
    for bad, why in (
        (grown, "terminal set"),
        (replace(good, terminal=None), "a terminal set are needed"),
        (replace(good, plant={"m": (Fraction(0), Fraction(1))}), "other plants under an input"),
        (replace(good, disturbance=(Fraction(1), Fraction(0))), "forces"),
    ):
        found = decide(MODEL, NUMBERS, bad)
        assert found.kind == "undecided"
        assert why in found.why


def test_a_claim_is_written_and_read_again() -> None:
    own = replace(claim(phi=0.01, phi_dot=0.02), cuts={"phi": (Fraction(1, 200),)})
    data = claim_data(own)
    assert read_claim(data, MODEL) == own
    for key, value in (
        ("starts", {"psi": ["0", "1"]}),
        ("plant", {"m": ["0", "1/1000"]}),
        ("ball", "1"),
        ("hint", {"step": "0"}),
        ("hint", {"boxes": {"theta": ["0"]}}),
        ("hint", {"boxes": {"phi": ["0"] * 20_000}}),
    ):
        with pytest.raises(Refused):
            read_claim({**data, key: value}, MODEL)


def test_an_odd_loop_is_known_by_its_nodes() -> None:
    """Of the library, the pendulums and cranes around an upright or hanging rest are odd."""
    assert System(MODEL, NUMBERS).odd
    for node, wrong in ((("number", Fraction(1)), False), (("position", 1), True)):
        k = len(MODEL.nodes)
        nodes = (*MODEL.nodes, node, ("add", MODEL.f[1], k))
        changed = replace(MODEL, nodes=nodes, f=(MODEL.f[0], k + 1))
        assert System(changed, NUMBERS).odd is wrong


@pytest.mark.slow  # up to five minutes of one core
@pytest.mark.parametrize(
    ("case", "degrees"), [(1, 35.80), (2, 44.38), (3, 40.39), (4, 43.48), (5, 40.38)]
)
def test_the_kept_lines_of_starts_are_proved_from_their_file(case: int, degrees: float) -> None:
    document = read((ROOT / "tests/data/closed_loop_v2.json").read_bytes())
    assert document.model == MODEL
    subject = document.subjects[case - 1]
    assert subject.law == law_of(RIG, CASES[case - 1].surface, LAW)
    (data,) = subject.claims
    own = read_claim(data, MODEL)
    found = decide(MODEL, subject.law, own)
    assert found.kind == "proved", found.why
    assert isinstance(own, ClosedLoop)
    assert -own.starts["phi"][0] == own.starts["phi"][1] >= math.radians(degrees)
