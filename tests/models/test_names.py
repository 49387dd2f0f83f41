"""The model that is meant is the model that runs: names, symbols, and what has no derivative."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pytest
import sympy as sp
from sympy.physics.mechanics import LagrangesMethod, dynamicsymbols

import undertow as ut
from support import interpreted, rest_slow
from undertow.base import InvalidInputError, ModelError, UndertowError
from undertow.checks import check_mechanism
from undertow.display.animation import evaluator
from undertow.display.derivation import derivation
from undertow.display.sketches import Line, Sketch
from undertow.estimators import KalmanFilter
from undertow.mechanisms import LIBRARY
from undertow.models import TIME, has_linear_model, is_smooth, kinks, linearise, require_smooth
from undertow.models import importers as modelling
from undertow.objective.objective import Names
from undertow.runtime.recipe import Recipe

MICRO, MU = "\u00b5", "\u03bc"  # of the keyboard, and Greek
ANGLE = sp.Symbol("phi", real=True)
PHI, CURLY = "\u03c6", "\u03d5"


def cart(
    cart_mass: str = "m_c", rod_mass: str = "m_p", x: str = "x", phi: str = "phi", **rest: Any
) -> ut.Mechanism:
    """A cart pendulum under names of one's own."""
    data = [ut.Parameter(cart_mass, 0.5, "kg"), ut.Parameter(rod_mass, 0.2, "kg")]
    mc, mp = (p.symbol for p in data)
    place, angle = ut.Coordinate(x, "m"), ut.Coordinate(phi)
    v, w, c = place.velocity, angle.velocity, sp.cos(angle.symbol)
    kinetic = (mc + mp) * v**2 / 2 + mp * 0.3 * c * v * w + 0.012 * w**2
    return ut.Mechanism.from_energies(
        "cart", [place, angle], [ut.Input("force", "N", 20.0)], kinetic, mp * 2.94 * c,
        parameters=data, **rest,
    )  # fmt: skip


# -- names -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("names", "points"),
    [
        ({"cart_mass": MU, "rod_mass": MICRO}, ("U+00B5", "U+03BC")),
        ({"phi": PHI, "rod_mass": CURLY}, ("U+03C6", "U+03D5")),
        ({"x": CURLY, "phi": PHI}, ("U+03C6", "U+03D5")),
        ({"rod_mass": "\uff58"}, ("x", "U+FF58")),  # fullwidth, beside the coordinate x
        ({"rod_mass": "\uff58_dot"}, ("x_dot", "U+FF58")),  # beside a velocity
        ({"rod_mass": "\uff54"}, ("t", "U+FF54")),  # beside the time
        ({"rod_mass": "\ufb01", "cart_mass": "fi"}, ("fi", "U+FB01")),
    ],
)
def test_names_that_python_takes_for_one_are_refused_with_both_spellings(
    names: dict[str, str], points: tuple[str, str]
) -> None:
    """Claim: names of one form NFKC meet before anything is derived, and the message tells them
    apart, which the eye cannot."""
    with pytest.raises(ModelError, match="used twice") as refusal:
        cart(**names)
    for point in points:
        assert point in str(refusal.value)
    assert "NFKC" in str(refusal.value)
    assert refusal.value.remedy


def test_inputs_meet_parameters_too() -> None:
    place, angle = ut.Coordinate("x", "m"), ut.Coordinate("phi")
    with pytest.raises(ModelError, match=r"U\+00B5.*U\+03BC"):
        ut.Mechanism(
            "odd", (place, angle), (ut.Input(MICRO, "N"),), sp.eye(2), sp.zeros(2, 1),
            parameters=(ut.Parameter(MU, 1.0, ""),),
        )  # fmt: skip


def test_a_name_with_another_spelling_in_python_works_by_every_spelling() -> None:
    """Claim: a lone µ of the keyboard is the Greek μ that Python makes of it, everywhere."""
    rig = cart(rod_mass=MICRO, phi=CURLY, start={CURLY: 0.1})
    plain = cart()
    assert rig.state_names == ("x", PHI, "x_dot", f"{PHI}_dot")
    assert rig.parameters[1].name == MU
    assert rig.parameters[1].spelling == MICRO
    for spelling in (PHI, CURLY):
        assert rig.state(**{spelling: 0.2})[1] == 0.2
        assert getattr(Names(rig), spelling) == rig.q[1]
    for spelling in (MICRO, MU):
        assert rig.with_parameters(**{spelling: 0.3}).parameter_values[1] == 0.3
    x = np.array([0.1, 0.2, 0.3, 0.4])
    assert rig.accelerations(0.0, x, [1.0]).tolist() == plain.accelerations(0.0, x, [1.0]).tolist()
    # The law compiled for it is that of the same mechanism under plain names.
    surface = ut.first_surface(plain)
    ours, theirs = (ut.SlidingModeLaw(m, surface)(0.0, x) for m in (rig, plain))
    assert ours.u.tolist() == theirs.u.tolist()


@pytest.mark.parametrize(
    "name",
    ["lambda", "class", "z_1", "sw_0", "k_0", "int", "double", "self", "np", "E", "I", "S", "pi",
     "None", "q\u0302", "a0"],
)  # fmt: skip
def test_a_name_is_not_refused_for_what_a_generator_does_with_it(name: str) -> None:
    """Claim: keywords, SymPy's own letters and a generator's names are names like any other."""
    rig = cart(phi=name, rod_mass=f"{name}_p")
    plain = cart()
    x = [0.1, 0.2, 0.3, 0.4]
    assert rig.accelerations(0.0, x, [1.0]).tolist() == plain.accelerations(0.0, x, [1.0]).tolist()
    assert rig.state(**{name: 0.1})[1] == 0.1
    assert ut.first_surface(rig) == ut.first_surface(plain)


@pytest.mark.parametrize(
    "name",
    ["", "1", "a b", "x\u200d", "x\u034f", "x\ufe00", "\u3164", "x" * 300, "_a", "_v0", 3, None],
)
def test_what_is_no_name_or_cannot_be_seen_is_refused(name: Any) -> None:
    with pytest.raises(UndertowError) as refusal:
        cart(rod_mass=name)
    assert refusal.value.remedy


def test_letters_of_another_case_are_other_names() -> None:
    """Claim: m and M, which mechanics writes side by side, stay two."""
    assert [p.name for p in cart(cart_mass="M", rod_mass="m").parameters] == ["M", "m"]


@pytest.mark.parametrize("name", ["states", "inputs"])
def test_names_of_the_vectors_of_a_stage_cost_are_refused(name: str) -> None:
    """v.inputs is the vector of inputs: a parameter of that name could not be reached."""
    with pytest.raises(ModelError, match=name):
        cart(rod_mass=name)


# -- symbols -----------------------------------------------------------------------------------

x_, a_ = ut.Coordinate("x", "m"), ut.Coordinate("a")
v_, w_ = x_.velocity, a_.velocity
force_ = ut.Input("F", "N", 20.0)
other_a, other_v = sp.Symbol("a"), sp.Symbol("x_dot")


def energies(
    kinetic: sp.Expr = 0, potential: sp.Expr = 0, dissipation: sp.Expr = 0, **rest: Any
) -> ut.Mechanism:
    T = v_**2 + w_**2 / 10 + sp.cos(a_.symbol) * v_ * w_ / 10
    V = sp.cos(a_.symbol)
    return ut.Mechanism.from_energies(
        "own", [x_, a_], [force_], T + kinetic, V + potential, dissipation=dissipation, **rest
    )


def with_matrix(
    kinetic: sp.Expr = 0, potential: sp.Expr = 0, dissipation: sp.Expr = 0
) -> ut.Mechanism:
    T = v_**2 + w_**2 / 10
    return modelling.from_energies(
        "own", [a_, x_], [force_], T + kinetic, sp.cos(a_.symbol) + potential, sp.Matrix([0, 1]),
        dissipation=dissipation,
    )  # fmt: skip


FOREIGN: dict[str, tuple[Mapping[str, sp.Expr], str]] = {
    "angle in V": ({"potential": 3 * other_a**2}, r"potential.*got a,.*coordinate\.symbol of 'a'"),
    "angle in T": ({"kinetic": other_a**2 * v_**2}, r"kinetic.*coordinate\.symbol"),
    "rate in D": ({"dissipation": other_v**2}, r"dissipation.*coordinate\.velocity of 'x_dot'"),
    "rate in T": ({"kinetic": sp.Symbol("a_dot") ** 2}, r"kinetic.*coordinate\.velocity"),
    "positive": ({"potential": sp.Symbol("a", positive=True)}, r"coordinate\.symbol"),
    "dummy": ({"potential": sp.Dummy("a", real=True)}, "unknown symbols"),
    "fullwidth": ({"potential": sp.Symbol("\uff41", real=True)}, r"U\+FF41.*coordinate\.symbol"),
    "dynamicsymbol": ({"potential": dynamicsymbols("a")}, r"a\(t\).*coordinate\.symbol"),
    "its rate": ({"dissipation": dynamicsymbols("x").diff() ** 2}, r"coordinate\.velocity"),
    "function": ({"potential": sp.Function("h")(a_.symbol)}, r"h\(a\)"),
    "function without code": ({"potential": sp.LambertW(a_.symbol + 1)}, "LambertW"),
    "impulse": ({"potential": sp.DiracDelta(a_.symbol)}, "DiracDelta"),
    "undeclared": ({"potential": sp.Symbol("k", real=True) * a_.symbol**2}, "got k"),
    "input": ({"potential": force_.symbol * a_.symbol}, "got F"),
    "rate in V": ({"potential": w_**2}, "got a_dot"),
    "NaN": ({"potential": sp.nan}, "nan"),
    "division by zero": ({"potential": a_.symbol / sp.Integer(0)}, "zoo"),
    "infinite": ({"potential": sp.oo * a_.symbol}, "oo"),
    "complex": ({"potential": sp.I * a_.symbol}, "real"),
}


@pytest.mark.parametrize("build", [energies, with_matrix])
@pytest.mark.parametrize("what", FOREIGN)
def test_what_is_not_of_this_mechanism_is_refused_before_it_is_derived(
    what: str, build: Callable[..., ut.Mechanism]
) -> None:
    """Claim: no term of an energy drops out because its symbol is another one of that name."""
    terms, message = FOREIGN[what]
    with pytest.raises(ModelError, match=message) as refusal:
        build(**terms)
    assert refusal.value.value is not None
    assert refusal.value.limit is not None
    assert refusal.value.remedy


def test_the_symbol_of_another_mechanism_of_that_name_is_the_same() -> None:
    """Claim: what SymPy takes for equal is equal: coordinates of one name share their symbol."""
    ours = energies(potential=sp.Symbol("a", real=True) ** 2)
    theirs = energies(potential=ut.Coordinate("a", description="of another").symbol ** 2)
    assert ours.structure == theirs.structure


@pytest.mark.parametrize(
    "attempt",
    [
        lambda: energies().disturbed({"a": other_a}),
        lambda: ut.Mechanism("own", (x_, a_), (force_,), sp.eye(2), sp.Matrix([0, other_a])),
        lambda: ut.Mechanism(
            "own", (x_, a_), (force_,), sp.eye(2), sp.zeros(2, 1), potential=other_a**2
        ),
        lambda: modelling.from_matrices(
            "own", [a_, x_], [force_], sp.eye(2), sp.Matrix([other_a, 0]), sp.Matrix([0, 1])
        ),
        lambda: ut.Objective("o", lambda v: other_a**2).stage_cost(energies()),
        lambda: ut.Objective(
            "o", lambda v: 1, constraints=(ut.Constraint("c", lambda v: other_a - 1),)
        ).path_margins(energies()),
    ],
)
def test_forces_costs_and_constraints_take_no_foreign_symbol(
    attempt: Callable[[], object],
) -> None:
    with pytest.raises(UndertowError, match=r"[Dd]id you mean coordinate\.symbol"):
        attempt()


def test_a_stick_figure_takes_no_foreign_symbol() -> None:
    """Claim: the points of a sketch are those of this mechanism, or are refused."""
    rig = cart()
    for tip, fine in ((rig.q[0], True), (sp.Symbol("x"), False), (rig.x[2], False)):
        figure = Sketch((Line(((0, 0, 0), (tip, 0, 1))),), (tip, 0, 0))
        if fine:
            assert evaluator(rig, figure)(np.array([[0.5, 0.1]]))[2].tolist() == [[0.5, 0.0, 0.0]]
        else:
            with pytest.raises(ModelError, match="sketch of 'cart'"):
                evaluator(rig, figure)


def test_text_is_no_expression_and_is_never_run() -> None:
    """Claim: SymPy would evaluate text as Python; what is given as text is refused unread."""
    harm = "__import__('sys').exit(3)"
    for attempt in (
        lambda: ut.Mechanism.from_energies("own", [x_, a_], [force_], harm, 0),
        lambda: ut.Mechanism("own", (x_, a_), (force_,), sp.eye(2), [harm, "0"]),
        lambda: energies().disturbed({"a": harm}),
        lambda: ut.Objective("o", lambda v: harm).stage_cost(energies()),
    ):
        with pytest.raises(UndertowError, match="str"):
            attempt()


# -- what has no derivative --------------------------------------------------------------------

X, Y, P = sp.symbols("X Y P", real=True)
ORIGIN = {X: 0.0, Y: 0.0, P: 2.0}
KINKED = (
    sp.Abs(X), sp.sign(X), sp.Max(X, 0), sp.Min(0, X, Y), sp.Heaviside(X), sp.DiracDelta(X),
    sp.Piecewise((X, X > 0), (0, True)), sp.sqrt(X**2), (X**2) ** sp.Rational(3, 4) + sp.floor(X),
    sp.floor(X), sp.ceiling(X), sp.frac(X), sp.Mod(X, 2), sp.Abs(X) * sp.sign(X),
    3 * sp.Max(X, 0) + 3 * sp.Min(X, 0), (1 + X) * sp.Abs(X), sp.sin(sp.Abs(X)), sp.arg(X),
    sp.Function("h")(X), sp.Max(X, Y), sp.Abs(sp.sin(X)), sp.cos(Y) * sp.Abs(X),
)  # fmt: skip
SINGULAR = (
    sp.sqrt(1 - sp.cos(X) ** 2), sp.acos(sp.cos(X)), sp.atan2(Y, X), X ** sp.Rational(1, 3),
    sp.log(X), 1 / X, sp.sqrt(sp.sin(X) ** 2 + Y**2), X**P,
)  # fmt: skip
SMOOTH = (
    X**2, sp.sin(X) * sp.exp(Y), sp.sqrt(X**2 + 1), sp.sqrt(X**2 + 1e-18), sp.Abs(P) * X,
    sp.tanh(X / 0.01), sp.atan2(Y, X + 1), sp.log(1 + X), 2**X, 1 / (1 + X), sp.acos(X),
    X * sp.Abs(X), sp.Abs(X) ** 3, sp.Heaviside(TIME - 1) * X, sp.Max(P, 1) * X,
)  # fmt: skip
AWAY = (
    sp.Abs(X - 1), sp.Max(X, -1), sp.Piecewise((X, X > 5), (Y, True)), sp.Heaviside(X - 1),
    Y * sp.Abs(X), sp.sin(Y) * sp.Abs(X), X * sp.Max(X + 1, 1),
)  # fmt: skip


@pytest.mark.parametrize("expression", KINKED, ids=str)
def test_kinks_are_found_at_the_point_and_everywhere(expression: sp.Expr) -> None:
    assert list(kinks([expression], [X, Y], at=ORIGIN))
    assert list(kinks([expression], [X, Y]))
    with pytest.raises(ModelError, match="not smooth") as refusal:
        require_smooth("force", sp.Matrix([X, expression]), [X, Y], at=ORIGIN)
    assert refusal.value.value is not None
    assert "sqrt(x**2 + e**2)" in refusal.value.remedy


@pytest.mark.parametrize("expression", SINGULAR, ids=str)
def test_roots_and_angles_are_refused_where_they_are_singular(expression: sp.Expr) -> None:
    assert list(kinks([expression], [X, Y], at=ORIGIN))
    elsewhere = {X: 0.5, Y: 0.25, P: 2.0}
    assert not list(kinks([expression], [X, Y], at=elsewhere))


@pytest.mark.parametrize("expression", SMOOTH, ids=str)
def test_what_has_a_derivative_is_not_refused(expression: sp.Expr) -> None:
    """Claim: neither at a point nor everywhere, and the derivative that SymPy gives is the one
    that both sides' differences go to, at 50 digits."""
    assert not list(kinks([expression], [X, Y], at=ORIGIN))
    assert not list(kinks([expression], [X, Y]))
    for symbol in (X, Y):
        _one_slope(expression, symbol)


@pytest.mark.parametrize("expression", AWAY, ids=str)
def test_a_kink_elsewhere_does_no_harm_at_the_point(expression: sp.Expr) -> None:
    assert not list(kinks([expression], [X, Y], at=ORIGIN))
    for symbol in (X, Y):
        _one_slope(expression, symbol)


def _one_slope(expression: sp.Expr, symbol: sp.Symbol) -> None:
    at = {s: sp.Rational(v) for s, v in ORIGIN.items()} | {TIME: sp.Integer(0)}
    slope = sp.diff(expression, symbol).subs(at).evalf(50)
    step = sp.Rational(1, 10**20)
    base = expression.subs(at)
    for side in (step, -step):
        quotient = (expression.subs(at | {symbol: side}) - base).evalf(60) / side
        assert abs(quotient - slope) < 1e-1 * 10**-9


def test_is_smooth_knows_functions_without_a_second_derivative() -> None:
    assert is_smooth(sp.sin(X) * sp.sqrt(1 + Y**2))
    assert not is_smooth(X * sp.Abs(X))
    assert not is_smooth(sp.Heaviside(X))


base = ut.mechanisms.rotary_pendulum()
angle = base.q[1]


def kinked(extra: sp.Expr) -> ut.Mechanism:
    """The rotary pendulum with a force of one's own on the pendulum, given as M, f and B."""
    force = base.force + sp.Matrix([0, extra])
    return ut.Mechanism(
        "kinked", base.coordinates, base.inputs, base.mass_matrix, force, base.input_matrix,
        base.parameters,
    )  # fmt: skip


#: found: -3|φ| was "proved, 3.716 1/s" and fell over; one function written three ways, three rates.
ODD = {
    "modulus": -3 * sp.Abs(angle),
    "modulus times sign": 3 * sp.Abs(angle) * sp.sign(angle),
    "maximum": 3 * sp.Max(angle, 0),
    "maximum and minimum": 3 * sp.Max(0, angle) + 3 * sp.Min(0, angle),
    "cases": 5 * sp.Piecewise((angle, angle > 0), (0, True)),
    "root of a square": 5 * sp.sqrt(angle**2),
    "step": sp.Heaviside(angle) - sp.Rational(1, 2),
    "root that is zero": sp.sqrt(1 - sp.cos(angle) ** 2),
}


@pytest.mark.parametrize("what", ODD)
def test_a_kinked_model_is_refused_where_a_derivative_is_needed(what: str) -> None:
    rig, surface = kinked(ODD[what]), ut.first_surface(base)
    assert not has_linear_model(rig)
    for attempt in (
        lambda: linearise(rig),
        lambda: ut.first_surface(rig),
        lambda: ut.placed_surface(rig, [-3, -4, -5]),
        lambda: ut.surface_margins(rig, surface),
        lambda: ut.check_surface(rig, surface),
        lambda: ut.Cascade(rig, first=surface),
        lambda: derivation(rig),
        lambda: check_mechanism(rig, strict=True, compiled=False),
    ):
        with pytest.raises(ModelError, match=r"smooth|derivative"):
            attempt()
    assert not check_mechanism(rig, compiled=False)["forces have a derivative"].passed
    if "root that" not in what:  # which is smooth where the filter is, but for single points
        with pytest.raises(ModelError, match="Kalman"):
            KalmanFilter(rig)


@pytest.mark.parametrize(
    "what", rest_slow(["modulus", "maximum", "cases", "modulus times sign"], "cases")
)
def test_a_kinked_model_is_simulated_where_no_derivative_is_needed(what: str) -> None:
    """Claim: with a surface of one's own it rolls out, as SciPy integrates its equations."""
    from scipy.integrate import solve_ivp

    rig, surface = kinked(ODD[what]), ut.first_surface(base)
    loop = interpreted(ut.ClosedLoop(rig, step=0.0005))
    assert loop.linear_end is None
    x0, span = rig.state(phi=0.02, theta_dot=0.3), 0.05
    run = loop.simulate(x0, surface, duration=span)
    law = ut.SlidingModeLaw(rig, surface)
    f = sp.lambdify([base.x, list(base.parameter_symbols)], list(rig.force), "numpy")

    def rate(t: float, x: np.ndarray) -> np.ndarray:
        u = np.clip(law(t, x).u, -15.0, 15.0)
        forces = np.array(f(x, rig.parameter_values), dtype=float)
        forces[0] += float(rig.parameter_values[5]) * float(u[0])
        return np.concatenate([x[2:], np.linalg.solve(rig.M(x[:2]), forces)])

    theirs = solve_ivp(rate, (0.0, span), x0, rtol=1e-9, atol=1e-11, max_step=1e-3).y[:, -1]
    np.testing.assert_allclose(run.x[-1], theirs, atol=2e-5)


def test_a_kink_in_an_energy_is_refused_and_quadratic_drag_is_not() -> None:
    """Claim: |x| in T, V or D has no derivative; D = c|v|³/3 has, and gives −c v|v|."""
    for term in ("kinetic", "potential", "dissipation"):
        kink = {"kinetic": sp.Abs(a_.symbol) * w_**2, "potential": sp.Abs(a_.symbol)}
        with pytest.raises(ModelError, match=r"not smooth.*Abs"):
            energies(**{term: kink.get(term, sp.Abs(v_))})
    drag = energies(dissipation=sp.Abs(v_) ** 3 / 3)
    assert (drag.f([0, 0, -2.0, 0]) - energies().f([0, 0, -2.0, 0])).tolist() == [4.0, 0.0]


def test_a_lagrangian_with_a_kink_is_refused() -> None:
    place, angle = dynamicsymbols("x phi")
    L = place.diff() ** 2 + angle.diff() ** 2 - sp.cos(angle) - sp.Abs(angle)
    N = sp.physics.mechanics.ReferenceFrame("N")
    point = sp.physics.mechanics.Point("P")
    point.set_vel(N, place.diff() * N.x)
    F = dynamicsymbols("F")
    method = LagrangesMethod(L, [place, angle], forcelist=[(point, F * N.x)], frame=N)
    with pytest.raises(ModelError, match="Lagrangian of 'own' is not smooth"):
        modelling.from_lagrange("own", method, {F: ut.Input("F", "N")})


@pytest.mark.parametrize("name", sorted(LIBRARY))
def test_nothing_of_the_library_is_refused(name: str) -> None:
    """Claim: every mechanism of the library is smooth, its numbers and names pass again."""
    rig = LIBRARY[name]()
    assert has_linear_model(rig)
    assert not list(kinks(rig.force, rig.x))
    assert rig.with_parameters(**{p.name: p.value for p in rig.parameters}).structure == (
        rig.structure
    )


# -- raw exceptions that users met -------------------------------------------------------------

rotary = ut.mechanisms.rotary_pendulum()
RAW: dict[str, tuple[Callable[[], object], str]] = {
    "name for a mechanism": (lambda: ut.Cascade("rotary_pendulum"), "rotary_pendulum'.*a str"),  # type: ignore[arg-type]
    "word for an objective": (lambda: ut.Cascade(rotary, "time"), "MinimumTime"),  # type: ignore[arg-type]
    "name for a loop's mechanism": (lambda: ut.ClosedLoop("x"), "undertow.Mechanism"),  # type: ignore[arg-type]
    "name for a plant": (lambda: ut.ClosedLoop(rotary, plant="x"), "plant"),  # type: ignore[arg-type]
    "name for a design": (lambda: ut.first_surface("x"), "undertow.Mechanism"),  # type: ignore[arg-type]
    "name for a check": (lambda: check_mechanism("x"), "undertow.Mechanism"),  # type: ignore[arg-type]
    "text for a value": (lambda: ut.Parameter("m", "1.0", "kg"), "'1.0'.*a number, in kg"),  # type: ignore[arg-type]
    "no value": (lambda: ut.Parameter("m", None, "kg"), "None"),  # type: ignore[arg-type]
    "truth for a value": (lambda: ut.Parameter("m", True, "kg"), "True"),
    "endless digits": (lambda: ut.Parameter("m", 10**400, "kg"), "number"),
    "text for a bound": (lambda: ut.Parameter("m", 1.0, "kg", low="0"), "low"),  # type: ignore[arg-type]
    "text for a range": (lambda: ut.Coordinate("x", low="0"), "low"),  # type: ignore[arg-type]
    "text for a limit": (lambda: ut.Input("u", "N", "5"), "limit"),  # type: ignore[arg-type]
    "text for a state": (lambda: rotary.state(phi="10deg"), r"'10deg'.*undertow\.deg"),  # type: ignore[arg-type]
    "near state": (lambda: rotary.state(phi_do=1.0), "Did you mean phi_dot"),
    "near parameter": (lambda: rotary.with_parameters(I_ee=1.0), "Did you mean I_e"),
    "near coordinate": (lambda: rotary.disturbed({"thet": 1.0}), "Did you mean theta"),
    "near state of a cost": (
        lambda: ut.Objective("o", lambda v: v.phi_do**2).stage_cost(rotary),
        "Did you mean phi_dot",
    ),
    "state for positions": (
        lambda: rotary.M(rotary.state(phi=0.1)),
        r"shape \(4,\).*theta, phi.*x\[:2\]",
    ),
    "text for positions": (lambda: rotary.M("a"), "str"),
    "names for a state": (lambda: rotary.f({"phi": 0.1}), "dict"),  # type: ignore[arg-type]
    "too many inputs": (lambda: rotary.accelerations(0.0, rotary.state(), [1, 2]), "voltage"),
    "text for a parameter": (lambda: rotary.with_parameters(l="1"), "'1'"),  # type: ignore[arg-type]
    "text for an input limit": (lambda: rotary.with_input_limit("1"), "'1'"),  # type: ignore[arg-type]
    "one bound": (lambda: rotary.with_disturbance_bounds("a"), "'a'"),  # type: ignore[arg-type]
    "names for coordinates": (
        lambda: ut.Mechanism.from_energies("o", ["x", "a"], [force_], v_**2, 0),  # type: ignore[list-item]
        r'Write \[Coordinate\("x", "m"\)',
    ),
    "one input": (
        lambda: ut.Mechanism.from_energies("o", [x_, a_], force_, v_**2, sp.Integer(0)),  # type: ignore[arg-type]
        "sequence of undertow.Input",
    ),
    "names for parameters": (lambda: energies(parameters=["m"]), "undertow.Parameter"),
    "number for a cost": (lambda: ut.Objective("o", 3.0), "3.0, a float.*lambda v"),  # type: ignore[arg-type]
    "NumPy in a cost": (
        lambda: ut.Objective("o", lambda v: np.sin(v.phi) ** 2).stage_cost(rotary),
        r"test_names\.py line \d+.*sympy\.sin",
    ),
    "math in a cost": (
        lambda: ut.Objective("o", lambda v: math.cos(v.phi)).stage_cost(rotary),
        "sympy",
    ),
    "a condition in a cost": (
        lambda: ut.Objective("o", lambda v: 1 if v.phi > 0 else 2).stage_cost(rotary),
        "Piecewise",
    ),
    "an array for a cost": (
        lambda: ut.Objective("o", lambda v: np.dot(v.inputs.T, v.inputs)).stage_cost(rotary),
        "one expression",
    ),
    "text for a horizon": (lambda: ut.MinimumTime(horizon="5"), "'5'"),  # type: ignore[arg-type]
    "near actuated": (
        lambda: modelling.find_equilibrium(rotary, thet=0.1),
        "Did you mean theta",
    ),
    "motor near": (
        lambda: modelling.voltage_driven(
            ut.mechanisms.cart_pendulum(), {"forc": modelling.DCMotor(0.1, 1.0)}
        ),
        "Did you mean force",
    ),
}


@pytest.mark.parametrize("what", RAW)
def test_what_ended_in_a_raw_exception_is_a_condition(what: str) -> None:
    attempt, message = RAW[what]
    with pytest.raises(UndertowError, match=message) as refusal:
        attempt()
    assert isinstance(refusal.value, InvalidInputError | ModelError)
    assert refusal.value.value is not None
    assert refusal.value.limit is not None
    assert refusal.value.remedy


def test_a_stage_cost_may_be_a_constant() -> None:
    """Claim: a function that returns a number is a cost like any other, and so is |x| by NumPy."""
    assert ut.Objective("o", lambda v: 3.0).stage_cost(rotary) == 3.0
    assert ut.Objective("o", lambda v: np.abs(v.phi)).stage_cost(rotary) == sp.Abs(rotary.q[1])


def test_a_potential_may_depend_on_time_and_its_energy_says_when() -> None:
    rig = energies(potential=sp.sin(TIME) * x_.symbol)
    assert rig.energy([2.0, 0, 0, 0], t=math.pi / 2) - rig.energy([2.0, 0, 0, 0]) == 2.0


# -- values by names ---------------------------------------------------------------------------


@pytest.mark.parametrize("what", ["parameters", "state", "forces", "equilibrium", "target"])
def test_values_under_two_spellings_of_one_name_are_refused(what: str) -> None:
    model, both = cart(x=MU, rod_mass="Å"), {MICRO: 0.1, MU: 0.2}
    acts: Mapping[str, Callable[[], Any]] = {
        "parameters": lambda: model.with_parameters(**{"\u00c5": 0.1, "\u212b": 0.2}),
        "state": lambda: model.state(**both),
        "forces": lambda: model.disturbed(both),
        "equilibrium": lambda: modelling.find_equilibrium(model, **both),
        "target": lambda: modelling.move_target(model, **both),
    }
    with pytest.raises(InvalidInputError, match=r"U\+.* and .*U\+.*one name"):
        acts[what]()


def test_a_usual_start_under_two_spellings_is_refused() -> None:
    with pytest.raises(InvalidInputError, match="one name"):
        cart(x=MU, start={MICRO: 0.1, MU: 0.2})


def test_forces_by_a_symbol_are_refused_as_no_name() -> None:
    with pytest.raises(InvalidInputError, match="a Symbol"):
        cart().disturbed({sp.Symbol("x"): 1.0})


def test_a_coordinate_may_be_called_mechanism() -> None:
    model = cart(x="mechanism")
    assert modelling.find_equilibrium(model, mechanism=0.5)["mechanism"] == 0.5
    assert modelling.move_target(model, mechanism=0.5).state_names[0] == "mechanism"


def test_a_motor_is_put_on_an_input_by_any_spelling() -> None:
    matrices = sp.Matrix([[2, 1], [1, 2]]), sp.zeros(2, 1), sp.Matrix([1, 0])
    pair = [ut.Coordinate("x", "m"), ut.Coordinate("phi")]
    model = modelling.from_matrices("pair", pair, [ut.Input(MU, "N", 1.0)], *matrices)
    motor = modelling.DCMotor(0.1, 1.0, voltage_limit=10.0)
    driven = modelling.voltage_driven(model, {MICRO: motor})
    assert driven.inputs[0].unit == "V"
    with pytest.raises(InvalidInputError, match="DCMotor"):
        modelling.voltage_driven(model, {MU: 3})  # type: ignore[dict-item]


# -- SymPy's mechanics takes plain symbols for constants -----------------------------------------


def lagranges(extra: Callable[[Any, Any], Any]) -> ut.Mechanism:
    """A cart with a rod from a Lagrangian, with a term more."""
    x, phi, push = dynamicsymbols("x phi F")
    mass = sp.Symbol(MICRO)
    rates = x.diff() ** 2 + x.diff() * phi.diff() * sp.cos(phi) / 2 + mass * phi.diff() ** 2
    frame, point = sp.physics.mechanics.ReferenceFrame("N"), sp.physics.mechanics.Point("P")
    point.set_vel(frame, x.diff() * frame.x)
    method = LagrangesMethod(
        rates + extra(x, phi), [x, phi], forcelist=[(point, push * frame.x)], frame=frame
    )
    data = [ut.Parameter(MICRO, 1.0, "kg")]
    return modelling.from_lagrange(
        "rod", method, {push: ut.Input("F", "N", 5.0)}, parameters=data, units={"x": "m"}
    )


def test_a_parameter_of_a_lagrangian_may_be_spelt_as_keyboards_do() -> None:
    model = lagranges(lambda x, phi: -(phi**2))
    assert model.M(np.zeros(2))[1, 1] == 2.0


@pytest.mark.parametrize("term", ["potential", "kinetic", "alike"])
def test_a_plain_symbol_of_a_coordinates_name_is_refused_in_a_lagrangian(term: str) -> None:
    plain = sp.Symbol("phi", real=True)  # ut.Coordinate("phi").symbol
    terms: Mapping[str, Callable[[Any, Any], Any]] = {
        "potential": lambda x, phi: -5 * plain**2,  # has no derivative by phi(t): no force
        "kinetic": lambda x, phi: plain**2 * phi.diff() ** 2,
        "alike": lambda x, phi: -sp.Symbol(MU) * x**2,  # beside the other spelling
    }
    with pytest.raises(ModelError, match="one name" if term == "alike" else "phi as plain"):
        lagranges(terms[term])


# -- what the target must be -------------------------------------------------------------------


def pair(force: sp.Expr, **rest: Any) -> ut.Mechanism:
    """Two masses, the free one under a force of one's own, in phi."""
    mass = sp.Matrix([[2, 1], [1, 2]])
    both = [ut.Coordinate("x", "m"), ut.Coordinate("phi")]
    return modelling.from_matrices(
        "pair", both, [ut.Input("push", "N", 5.0)], mass, sp.Matrix([0, force]),
        sp.Matrix([1, 0]), **rest,
    )  # fmt: skip


@pytest.mark.parametrize(
    "force",
    [
        ANGLE**2 * sp.cot(ANGLE),  # 0/0 where it is programmed
        ANGLE**3 * sp.csc(ANGLE) ** 2,
        sp.tan(ANGLE + sp.pi / 2),
        ANGLE * sp.sqrt(ANGLE - 1),
        ANGLE * sp.log(ANGLE - 1),  # of a complex number, π i, it would be 0
        sp.acot(ANGLE) - sp.pi / 2,  # jumps by π
    ],
)
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_what_is_no_number_at_the_target_has_no_linear_model(force: sp.Expr) -> None:
    with pytest.raises(ModelError, match="at the target"):
        linearise(pair(force))


def test_a_target_a_little_off_names_the_nearest_equilibrium() -> None:
    leaning = pair(3 * sp.sin(ANGLE - 0.002))
    with pytest.raises(ModelError, match=r"off by phi=0\.002") as off:
        linearise(leaning)
    assert "off by phi=0.002" in str(check_mechanism(leaning, compiled=False))
    with pytest.raises(ModelError, match=r"off by phi=-0\.09\d*: add this") as moved:
        modelling.move_target(leaning, phi=0.1)
    assert "move_target" not in str(moved.value)  # of the mechanism that nobody has
    found = float(str(off.value).rsplit("phi=", 1)[1].rstrip(")."))
    assert linearise(modelling.move_target(leaning, phi=found)).F[1, 1] == pytest.approx(3.0)
    with pytest.raises(ModelError, match="No equilibrium was found"):
        linearise(pair(3 + sp.sin(ANGLE)))


@pytest.mark.parametrize("word", ["hanging", "upright", "nearest"])
def test_a_mechanism_without_an_equilibrium_is_refused_as_one(word: str) -> None:
    """Whichever is asked for: there is nothing to take instead."""
    with pytest.raises(ModelError, match="equilibria of 'pair': got none that was found"):
        modelling.at_equilibrium(pair(3 + sp.sin(ANGLE)), word)


def test_an_input_matrix_takes_no_time_and_a_force_has_all_rows() -> None:
    both = [ut.Coordinate("x", "m"), ut.Coordinate("phi")]
    push = [ut.Input("push", "N", 5.0)]
    for force, matrix in ((sp.zeros(2, 1), [TIME, 0]), (sp.zeros(1, 1), [1, 0])):
        with pytest.raises(ModelError):
            modelling.from_matrices("pair", both, push, sp.eye(2), force, sp.Matrix(matrix))


def test_a_box_is_of_names_and_numbers_and_constraints_are_a_tuple_of_them() -> None:
    assert ut.state_box(**{MICRO: 1.0})[0].state == MU
    with pytest.raises(InvalidInputError, match="one name"):
        ut.state_box(**{MICRO: 1.0, MU: 2.0})
    with pytest.raises(InvalidInputError, match="a number"):
        ut.state_box(phi="1")  # type: ignore[arg-type]
    (box,) = ut.state_box(phi=1.0)
    assert ut.MinimumTime(constraints=[box]).constraints == (box,)  # type: ignore[arg-type]
    for wrong in (box, (box, 3)):
        with pytest.raises(InvalidInputError, match=r"undertow\.Constraint"):
            ut.MinimumTime(constraints=wrong)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "act",
    [
        lambda: ut.objective_for(cart(), None),  # type: ignore[arg-type]
        lambda: ut.Cascade(cart(), period="1"),  # type: ignore[arg-type]
        lambda: ut.Cascade(cart(), first=3),  # type: ignore[arg-type]
        lambda: ut.SlidingModeLaw(cart(), 3),  # type: ignore[arg-type]
        lambda: Recipe(horizon="20"),  # type: ignore[arg-type]
        lambda: Recipe(period="1"),  # type: ignore[arg-type]
        lambda: modelling.DCMotor("0.1", 1.0),  # type: ignore[arg-type]
    ],
)
def test_arguments_of_another_kind_are_conditions(act: Callable[[], Any]) -> None:
    with pytest.raises(InvalidInputError):
        act()
