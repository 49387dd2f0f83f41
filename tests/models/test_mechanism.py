"""Mechanisms: M(q) q̈ = f(q, q̇) + B u obeys mechanics, and refuses what is no mechanism."""

from __future__ import annotations

import copy
import math
import pickle
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import sympy as sp
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from sympy.physics.mechanics import LagrangesMethod, dynamicsymbols

import undertow as ut
from agreements import named
from support import (
    SHAPES,
    derivative,
    observed_order,
    random_mechanism,
    random_states,
    rest_slow,
    runge_kutta,
)
from undertow.base import InvalidInputError, ModelError, UndertowError
from undertow.models import TIME, FloatArray, controllability
from undertow.symbolic import Tape

shapes = pytest.mark.parametrize(("n", "m"), rest_slow(SHAPES, *SHAPES[:3]))


def at_rest_input(m: int) -> Callable[[float, FloatArray], FloatArray]:
    return lambda t, x: np.zeros((*x.shape[:-1], m))


# -- equations of motion ---------------------------------------------------------------------


@shapes
def test_inverse_dynamics_undo_forward_dynamics(n: int, m: int) -> None:
    """M q̈ − f = (B u, 0) for the q̈ that u causes, (1)."""
    mechanism = random_mechanism(n, m)
    x = random_states(mechanism, 500)
    u = np.random.default_rng(1).uniform(-20, 20, (500, m))
    forces = mechanism.forces(0.0, x, mechanism.accelerations(0.0, x, u))
    B = np.array(mechanism.input_matrix, dtype=float)
    np.testing.assert_allclose(forces[:, :m], u @ B.T, atol=1e-10)
    np.testing.assert_allclose(forces[:, m:], 0.0, atol=1e-10)


@shapes
def test_forward_dynamics_undo_inverse_dynamics(n: int, m: int) -> None:
    """Any q̈ that the free rows allow comes back from the inputs that inverse dynamics ask for."""
    mechanism = random_mechanism(n, m)
    x = random_states(mechanism, 500)
    qdd_a = np.random.default_rng(2).uniform(-20, 20, (500, m))
    M, f = mechanism.M(x[:, :n]), mechanism.f(x)
    free = f[:, m:] - np.einsum("kij,kj->ki", M[:, m:, :m], qdd_a)
    qdd_u = np.linalg.solve(M[:, m:, m:], free[..., None])[..., 0]
    qdd = np.hstack([qdd_a, qdd_u])
    B = np.array(mechanism.input_matrix, dtype=float)
    u = np.linalg.solve(B, mechanism.forces(0.0, x, qdd)[:, :m].T).T
    np.testing.assert_allclose(mechanism.accelerations(0.0, x, u), qdd, rtol=1e-8, atol=1e-8)


@shapes
def test_mass_matrix_is_symmetric_and_positive_definite_everywhere(n: int, m: int) -> None:
    mechanism = random_mechanism(n, m)
    M = mechanism.M(random_states(mechanism, 2000, position=10.0)[:, :n])
    np.testing.assert_array_equal(M, np.swapaxes(M, 1, 2))
    assert np.linalg.eigvalsh(M).min() > 0.4  # the diagonal part alone gives 0.5


@shapes
def test_partition_eliminates_the_free_accelerations(n: int, m: int) -> None:
    """S = M_aa − M_au M_uu⁻¹ M_auᵀ, (2), is the Schur complement: det M = det S · det M_uu."""
    mechanism = random_mechanism(n, m)
    tape = Tape()
    part = mechanism.partition(tape)
    q = random_states(mechanism, 1)[0, :n]
    at = dict(zip(mechanism.q, q, strict=True)) | mechanism.substitution
    for line in tape.assignments:
        at[line.symbol] = (
            float(line.expression.subs(at)) if line.expression.free_symbols <= set(at) else sp.nan
        )
    S = np.array(part.S.subs(at), dtype=float)
    M = mechanism.M(q)
    expected = M[:m, :m] - M[:m, m:] @ np.linalg.solve(M[m:, m:], M[m:, :m])
    np.testing.assert_allclose(S, expected, rtol=1e-11, atol=1e-12)


# -- energy ----------------------------------------------------------------------------------


@shapes
def test_undamped_uncontrolled_motion_conserves_energy_to_the_order_of_the_method(
    n: int, m: int
) -> None:
    """|E(t) − E(0)| of the free motion falls with the fourth power of the step or faster."""
    mechanism = random_mechanism(n, m, damped=False)
    x0 = random_states(mechanism, 8, speed=1.5)
    steps = np.array([0.02, 0.01, 0.005])
    errors = []
    for h in steps:
        x = runge_kutta(mechanism, at_rest_input(m), x0, h, round(0.5 / h))
        errors.append(np.abs(mechanism.energy(x) - mechanism.energy(x0)).max())
    assert observed_order(steps, np.array(errors)) > 3.8
    assert errors[-1] < 1e-5


@shapes
def test_energy_changes_by_input_work_less_dissipation(n: int, m: int) -> None:
    """E(T) − E(0) = ∫ q̇_aᵀ B u dt − ∫ 2 D(q̇) dt, with Rayleigh's D = ½ c |q̇|²."""
    mechanism = random_mechanism(n, m)
    B = np.array(mechanism.input_matrix, dtype=float)
    friction = float(mechanism.parameter_values[1])
    assert friction > 0

    def rate(t: float, z: FloatArray) -> FloatArray:
        x, u = z[:-2], np.array([3 * math.sin(2 * t + i) for i in range(m)])
        power = float(x[n : n + m] @ B @ u)
        return np.array([*derivative(mechanism, t, x, u), power, friction * x[n:] @ x[n:]])

    x0 = random_states(mechanism, 1, seed=3)[0]
    end = solve_ivp(rate, (0, 2), [*x0, 0.0, 0.0], method="DOP853", rtol=1e-10, atol=1e-11).y[:, -1]
    gained = float(mechanism.energy(end[:-2]) - mechanism.energy(x0))
    assert gained == pytest.approx(end[-2] - end[-1], abs=1e-7)
    assert abs(end[-2]) > 1e-2  # both terms take part
    assert end[-1] > 1e-2


@shapes
def test_momentary_power_balance(n: int, m: int) -> None:
    """Ė = q̇_aᵀ B u − c |q̇|² at every state, by differentiating E along ẋ."""
    mechanism = random_mechanism(n, m)
    x = random_states(mechanism, 200)
    u = np.random.default_rng(5).uniform(-5, 5, (200, m))
    xd = derivative(mechanism, 0.0, x, u)
    h = 1e-5
    slope = (mechanism.energy(x + h * xd) - mechanism.energy(x - h * xd)) / (2 * h)
    B = np.array(mechanism.input_matrix, dtype=float)
    friction = float(mechanism.parameter_values[1])
    power = np.einsum("ki,ij,kj->k", x[:, n : n + m], B, u) - friction * (x[:, n:] ** 2).sum(1)
    np.testing.assert_allclose(slope, power, atol=1e-4 * (1 + np.abs(xd).max() ** 2))


def test_energies_give_the_equations_of_sympys_lagranges_method() -> None:
    """Cart pendulum with a damped pivot: M and f agree with an independent derivation."""
    masses = [ut.Parameter(name, 1.0 + i, "kg", low=0) for i, name in enumerate(("M", "m"))]
    l, g, c = (ut.Parameter(s, 0.7, "", low=0) for s in ("l", "g", "c"))  # noqa: E741
    cart, pole = ut.Coordinate("y", "m"), ut.Coordinate("phi", "rad")
    M, m, L, G, C = (p.symbol for p in (*masses, l, g, c))

    def energies(
        y_dot: sp.Expr, phi: sp.Expr, phi_dot: sp.Expr
    ) -> tuple[sp.Expr, sp.Expr, sp.Expr]:
        across, up = y_dot + L * sp.cos(phi) * phi_dot, -L * sp.sin(phi) * phi_dot
        kinetic = M * y_dot**2 / 2 + m * (across**2 + up**2) / 2
        return kinetic, m * G * L * sp.cos(phi), C * phi_dot**2 / 2

    kinetic, potential, dissipation = energies(cart.velocity, pole.symbol, pole.velocity)
    ours = ut.Mechanism.from_energies(
        "cart_pendulum",
        [cart, pole],
        [ut.Input("force", "N")],
        kinetic,
        potential,
        dissipation=dissipation,
        parameters=(*masses, l, g, c),
    )
    y, phi = dynamicsymbols("y phi", real=True)
    y_dot, phi_dot = y.diff(), phi.diff()
    T, V, D = energies(y_dot, phi, phi_dot)
    theirs = LagrangesMethod(T - V, [y, phi])
    theirs.form_lagranges_equations()
    names = {y_dot: cart.velocity, phi_dot: pole.velocity, y: cart.symbol, phi: pole.symbol}

    def renamed(matrix: Any) -> Any:
        return sp.Matrix(matrix).subs(names)

    assert sp.simplify(ours.mass_matrix - renamed(theirs.mass_matrix)) == sp.zeros(2)
    damping = sp.Matrix([D.diff(y_dot), D.diff(phi_dot)])
    force = renamed(theirs.forcing) - renamed(damping)
    assert sp.simplify(ours.force - force) == sp.zeros(2, 1)


# -- the rotary pendulum of Sec. 4 -----------------------------------------------------------


def test_rotary_pendulum_obeys_32_and_33_term_by_term() -> None:
    """(32) as printed; (33) with φ̈ for the printed φ̇ in its first term, and b_e = d_e."""
    rig = ut.mechanisms.rotary_pendulum()
    l, r_o, m, I_e, d_e, a_e, g = rig.parameter_symbols  # noqa: E741
    a, b, c, d = I_e + m * r_o**2, m * l * r_o, sp.Rational(4, 3) * m * l**2, m * g * l
    theta_dd, phi_dd = sp.symbols("theta_dd phi_dd", real=True)
    _, phi, w, p = rig.x
    (u,) = rig.u
    row_33, row_32 = (
        rig.mass_matrix * sp.Matrix([theta_dd, phi_dd])
        - rig.force
        - sp.Matrix([rig.input_matrix[0, 0] * u, 0])
    )
    printed_32 = (
        c * phi_dd
        - b * sp.cos(phi) * theta_dd
        - d * sp.sin(phi)
        - c * sp.sin(phi) * sp.cos(phi) * w**2
    )
    corrected_33 = (
        -b * sp.cos(phi) * phi_dd
        + (a + c * sp.sin(phi) ** 2) * theta_dd
        + b * sp.sin(phi) * p**2
        + 2 * c * sp.sin(phi) * sp.cos(phi) * p * w
        + d_e * w
        - a_e * u
    )
    unknowns = (theta_dd, phi_dd, w, p, u)
    for ours, theirs in ((row_32, printed_32), (row_33, corrected_33)):
        found, expected = (sp.Poly(sp.expand(e), *unknowns) for e in (ours, theirs))
        terms = set(found.monoms()) | set(expected.monoms())
        for powers in terms:
            difference = found.coeff_monomial(powers) - expected.coeff_monomial(powers)
            assert sp.simplify(difference) == 0, (powers, difference)


def test_rotary_pendulum_has_the_constants_a_b_c_d() -> None:
    """a, b, c, d from the parameters of Sec. 4: the numbers that the theory page derives."""
    rig = ut.mechanisms.rotary_pendulum()
    M = rig.M([0.3, 0.0])
    assert M[0, 0] == pytest.approx(0.009378, abs=5e-7)  # a
    assert -M[0, 1] == pytest.approx(0.0045016, abs=5e-8)  # b
    assert M[1, 1] == pytest.approx(0.0046760, abs=5e-8)  # c
    assert rig.f(rig.state(phi=math.pi / 2))[1] == pytest.approx(0.20540, abs=5e-6)  # d
    assert rig.M([0.0, math.pi / 2])[0, 0] == pytest.approx(0.009378 + 0.0046760, abs=1e-6)
    assert rig.input_limits == [15.0]
    assert rig.with_parameters(d_e=0.025).f(rig.state(theta_dot=2.0))[0] == pytest.approx(-0.05)


positive = st.floats(0.05, 5.0)
angle, speed = st.floats(-7, 7), st.floats(-20, 20)


@settings(max_examples=15)
@given(st.tuples(*[positive] * 6), st.tuples(angle, angle, speed, speed), st.floats(-15, 15))
def test_rotary_pendulum_accelerates_as_hand_written_equations_do(
    values: tuple[float, ...], x: tuple[float, ...], u: float
) -> None:
    """Whatever the parameters inside their bounds, (32)-(33) solved by NumPy give q̈."""
    l, r_o, m, I_e, d_e, a_e = values  # noqa: E741
    rig = ut.mechanisms.rotary_pendulum(l=l, r_o=r_o, m=m, I_e=I_e, d_e=d_e, a_e=a_e)
    a, b, c, d = I_e + m * r_o**2, m * l * r_o, 4 / 3 * m * l**2, m * 9.81 * l
    _, phi, w, p = x
    sin, cos = math.sin(phi), math.cos(phi)
    M = np.array([[a + c * sin**2, -b * cos], [-b * cos, c]])
    f = np.array(
        [
            -b * sin * p**2 - 2 * c * sin * cos * p * w - d_e * w + a_e * u,
            d * sin + c * sin * cos * w**2,
        ]
    )
    expected = np.linalg.solve(M, f)
    np.testing.assert_allclose(
        rig.accelerations(0.0, x, [u]), expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max()
    )


# -- what acts on it -------------------------------------------------------------------------


def test_disturbances_act_as_generalised_forces() -> None:
    """M q̈ = f + (B u, 0) + g(t): the accelerations change by M⁻¹ g."""
    rig = ut.mechanisms.rotary_pendulum()
    push = ut.Parameter("push", 0.3, "N m")
    plant = rig.disturbed({"phi": push.symbol * sp.sin(2 * TIME)}, [push])
    x, u, t = random_states(rig, 20), np.ones((20, 1)), 0.4
    g = np.array([0.0, 0.3 * math.sin(0.8)])
    expected = rig.accelerations(t, x, u) + np.linalg.solve(rig.M(x[:, :2]), g)
    np.testing.assert_allclose(plant.accelerations(t, x, u), expected, rtol=1e-9, atol=1e-9)


def test_changed_numbers_make_a_new_mechanism_and_leave_the_old_one() -> None:
    rig = ut.mechanisms.rotary_pendulum()
    heavier = rig.with_parameters(m=0.2)
    assert rig.parameter_values[2] == 0.125
    assert heavier.parameter_values[2] == 0.2
    assert heavier.fingerprint != rig.fingerprint
    assert heavier.with_parameters(m=0.125).fingerprint == rig.fingerprint
    weaker = rig.with_input_limit(3.0)
    assert weaker.input_limits == [3.0]
    assert weaker.fingerprint != rig.fingerprint
    assert weaker.structure == rig.structure
    assert weaker.with_input_limit(15.0).fingerprint == rig.fingerprint
    assert rig.with_disturbance_bounds(0.1, 0.2).disturbance_bounds == (0.1, 0.2)


def test_nobody_moves_the_start_of_a_mechanism_that_is_there() -> None:
    """A controller in a league has the mechanism that all the others are judged with."""
    start = {"theta": 0.2}
    crane = replace(ut.mechanisms.overhead_crane(), start=start)
    start["theta"] = 0.1
    with pytest.raises(TypeError, match="item assignment"):
        crane.start["theta"] = 0.0  # type: ignore[index]
    again = pickle.loads(pickle.dumps(crane))
    with pytest.raises(TypeError, match="item assignment"):
        again.start["theta"] = 0.0
    for one in (crane, again, copy.deepcopy(crane), crane.with_parameters(l=0.5)):
        assert one.start == {"theta": 0.2}


def test_columns_with_names_are_found_by_their_names() -> None:
    """A row of a table knows which state is which; in its own order it is another state."""
    pandas = pytest.importorskip("pandas")
    crane = ut.mechanisms.overhead_crane()
    frame = pandas.DataFrame(
        {"theta": [0.1, 0.2], "x": [0.3, 0.4], "cost": 9.0, "theta_dot": 0.5, "x_dot": 0.6}
    )
    x = np.array([[0.3, 0.1, 0.6, 0.5], [0.4, 0.2, 0.6, 0.5]])
    assert (crane.check_state(frame) == x).all()
    assert (crane.f(frame.iloc[1]) == crane.f(x[1])).all()
    assert (crane.check_state(pandas.Series(x[0])) == x[0]).all()
    with pytest.raises(InvalidInputError, match=r"got theta, x, must be x, theta, x_dot"):
        crane.check_state(frame[["theta", "x"]])


def test_states_are_set_by_name_and_functions_broadcast() -> None:
    rig = ut.mechanisms.rotary_pendulum()
    np.testing.assert_array_equal(rig.state(phi=0.2, theta_dot=-1), [0, 0.2, -1, 0])
    x = random_states(rig, 12).reshape(3, 4, 4)
    u = np.linspace(-1, 1, 12).reshape(3, 4, 1)
    together = rig.accelerations(0.0, x, u)
    assert together.shape == (3, 4, 2)
    for index in np.ndindex(3, 4):
        one = rig.accelerations(0.0, x[index], u[index])
        np.testing.assert_allclose(together[index], one, rtol=1e-12)
    assert rig.energy(x).shape == (3, 4)


def test_a_start_that_seems_to_be_in_degrees_is_told_of_before_any_work() -> None:
    """phi=20 was said to be 1146° after a search of 49,000 candidates."""
    rig = ut.mechanisms.rotary_pendulum()
    cascade = ut.Cascade(rig)
    for start in ({"phi": 20.0}, {"x0": {"phi": -20.0}}):
        with (
            pytest.raises(InvalidInputError, match="duration"),
            pytest.warns(UserWarning, match=r"rad is -?1146°.*undertow\.deg\(-?20\)") as told,
        ):
            cascade.simulate(**start, duration=-1.0)
        assert [one.filename for one in told] == [__file__]
    assert rig.initial_state(None, {"theta": 20.0, "phi": -2 * math.pi}).any()  # without a word


def test_an_unknown_field_is_refused_with_those_that_there_are() -> None:
    """Python told of a keyword argument that __init__ does not know."""
    x, phi = ut.Coordinate("x", "m"), ut.Coordinate("phi", "rad")
    energy = x.velocity**2 + phi.velocity**2
    for wrong, words in (
        ("B", "one of dissipation, input_matrix"),
        ("start_", "Did you mean start"),
    ):
        with pytest.raises(InvalidInputError, match=f"from_energies: got '{wrong}'.*{words}"):
            ut.Mechanism.from_energies(
                "rig", [x, phi], [ut.Input("push", "N")], energy, phi.symbol**2, **{wrong: 1}
            )


# -- refusals --------------------------------------------------------------------------------

y, z = ut.Coordinate("y", "m"), ut.Coordinate("z", "m")
push = ut.Input("push", "N")
no_force = sp.ImmutableDenseMatrix([0, 0])
unit_mass = sp.ImmutableDenseMatrix(sp.eye(2))


def build(**changes: Any) -> ut.Mechanism:
    fields: dict[str, Any] = {
        "name": "odd",
        "coordinates": (y, z),
        "inputs": (push,),
        "mass_matrix": unit_mass,
        "force": no_force,
    }
    return ut.Mechanism(**(fields | changes))


def lagrangian(kinetic: sp.Expr, **changes: Any) -> ut.Mechanism:
    return ut.Mechanism.from_energies("odd", [y, z], [push], kinetic, sp.Integer(0), **changes)


y_dot, z_dot = y.velocity, z.velocity
rotary = ut.mechanisms.rotary_pendulum

REFUSALS: dict[str, tuple[Callable[[], object], type[UndertowError], tuple[str, ...]]] = {
    "zero mass": (lambda: rotary(m=0.0), InvalidInputError, ("'m'", "got 0", "(0, inf) kg")),
    "negative mass": (lambda: rotary(m=-0.125), InvalidInputError, ("'m'", "-0.125", "(0, inf)")),
    "negative damping": (lambda: rotary(d_e=-0.1), InvalidInputError, ("'d_e'", "-0.1")),
    "NaN parameter": (lambda: rotary(l=math.nan), InvalidInputError, ("'l'", "nan", "finite")),
    "infinite parameter": (lambda: rotary(g=math.inf), InvalidInputError, ("'g'", "inf")),
    "unknown parameter": (
        lambda: rotary(mass=1.0),
        InvalidInputError,
        ("unknown parameter", "'mass'", "l, r_o, m, I_e"),
    ),
    "unknown state": (
        lambda: rotary().state(psi=1.0),
        InvalidInputError,
        ("unknown state", "'psi'", "theta, phi, theta_dot, phi_dot"),
    ),
    "NaN state": (
        lambda: rotary().state(phi_dot=math.nan),
        InvalidInputError,
        ("phi_dot", "nan", "finite"),
    ),
    "NaN among states": (
        lambda: rotary().check_state([[0.0, 0.0, 0.0, 0.0], [0.0, math.inf, 0.0, 0.0]]),
        InvalidInputError,
        ("'phi'", "inf", "finite"),
    ),
    "state too short": (
        lambda: rotary().f([0.1, 0.2]),
        InvalidInputError,
        ("(2,)", "4", "theta, phi"),
    ),
    "NaN start": (lambda: build(start={"y": math.nan}), InvalidInputError, ("'y'", "nan")),
    "name used twice": (
        lambda: build(parameters=(ut.Parameter("y", 1.0, "m"),)),
        ModelError,
        ("used twice", "got y", "unique"),
    ),
    "name of the time": (
        lambda: build(parameters=(ut.Parameter("t", 1.0, "s"),)),
        ModelError,
        ("used twice", "got t"),
    ),
    "name of a derivation's own symbols": (
        lambda: build(parameters=(ut.Parameter("_v0", 1.0, "m"),)),
        InvalidInputError,
        ("parameter name", "_v0"),
    ),
    "undeclared symbol": (
        lambda: build(mass_matrix=unit_mass * sp.Symbol("k", real=True)),
        ModelError,
        ("mass_matrix", "unknown symbols", "got k"),
    ),
    "asymmetric M": (
        lambda: build(mass_matrix=sp.Matrix([[2, 1], [0, 2]])),
        ModelError,
        ("mass_matrix", "1 at [0, 1] and 0 at [1, 0]", "symmetric"),
    ),
    "indefinite M": (
        lambda: build(mass_matrix=sp.Matrix([[1, 2], [2, 1]])),
        ModelError,
        ("smallest eigenvalue -1", "must be positive", "y = 0"),
    ),
    "M indefinite away from the target": (
        lambda: build(mass_matrix=sp.Matrix([[1, 0], [0, 1 - 2 * z.symbol**2]])),
        ModelError,
        ("smallest eigenvalue -", "must be positive", "z = "),
    ),
    "massless link": (
        lambda: lagrangian(y_dot**2),
        ModelError,
        ("smallest eigenvalue 0", "must be positive", "massless link"),
    ),
    "as many inputs as coordinates": (
        lambda: build(inputs=(push, ut.Input("pull", "N"))),
        ModelError,
        ("not underactuated", "2 coordinates and 2 inputs", "fewer inputs"),
    ),
    "no input": (lambda: build(inputs=()), ModelError, ("2 coordinates and 0 inputs",)),
    "singular input matrix": (
        lambda: build(input_matrix=sp.Matrix([[0]])),
        ModelError,
        ("input_matrix", "[[0.0]]", "invertible"),
    ),
    "wrong shape": (
        lambda: build(force=sp.Matrix([0, 0, 0])),
        ModelError,
        ("force", "(3, 1)", "(2, 1)"),
    ),
    "linear kinetic energy": (
        lambda: lagrangian(y_dot**2 + z_dot**2 + y_dot),
        ModelError,
        ("kinetic energy", "quadratic"),
    ),
    "cubic kinetic energy": (
        lambda: lagrangian(y_dot**2 + z_dot**2 + y_dot**4),
        ModelError,
        ("kinetic energy", "quadratic"),
    ),
    "negative disturbance bound": (
        lambda: build(disturbance_bounds=(0.1, -0.1)),
        InvalidInputError,
        ("disturbance_bounds", "-0.1", "≥ 0"),
    ),
    "too few disturbance bounds": (
        lambda: rotary().with_disturbance_bounds(0.1),
        InvalidInputError,
        ("(0.1,)", "2 finite numbers"),
    ),
    "disturbance on an unknown coordinate": (
        lambda: rotary().disturbed({"psi": 1.0}),
        InvalidInputError,
        ("unknown coordinate", "psi", "theta, phi"),
    ),
    "too many input limits": (
        lambda: rotary().with_input_limit(1.0, 2.0),
        InvalidInputError,
        ("(1.0, 2.0)", "1 number"),
    ),
    "zero input limit": (
        lambda: rotary().with_input_limit(0.0),
        InvalidInputError,
        ("voltage", "got 0 V", "positive"),
    ),
    "NaN input limit": (lambda: rotary().with_input_limit(math.nan), InvalidInputError, ("nan",)),
    "energy without a potential": (
        lambda: build().energy([0, 0, 1, 0]),
        ModelError,
        ("no potential energy",),
    ),
    "parameter that is no name": (
        lambda: ut.Parameter("2m", 1.0, "kg"),
        InvalidInputError,
        ("'2m'", "identifier"),
    ),
}


@pytest.mark.parametrize("what", REFUSALS)
def test_bad_input_is_refused_with_value_limit_and_remedy(what: str) -> None:
    attempt, condition, facts = REFUSALS[what]
    with pytest.raises(condition) as caught:
        attempt()
    error = caught.value
    for fact in facts:
        assert fact in str(error), str(error)
    assert error.limit is not None, str(error)
    assert error.remedy, str(error)
    assert error.remedy in str(error)
    assert isinstance(error, UndertowError)


# -- scales ----------------------------------------------------------------------------------


def scaled(mass: float, length: float, lean: float) -> ut.Mechanism:
    """A cart with a uniform rod of this mass and half-length, whose upright is at phi = −lean."""
    x, phi = ut.Coordinate("x", "m"), ut.Coordinate("phi")
    v, a, w = x.velocity, phi.symbol + lean, phi.velocity
    return ut.Mechanism.from_energies(
        "scaled",
        [x, phi],
        [ut.Input("force", "N", 25 * mass * 9.81)],
        kinetic=3 * mass * v**2 + mass * length * sp.cos(a) * v * w + mass * length**2 * w**2,
        potential=mass * 9.81 * length * sp.cos(a),
        dissipation=mass * v**2,
    )


@pytest.mark.parametrize(
    ("mass", "length"), [(2e-8, 1e-3), (0.1, 0.3), (3e3, 10.0)], ids=["20 µg", "100 g", "3 t"]
)
def test_what_rests_at_its_target_is_a_matter_of_no_scale(mass: float, length: float) -> None:
    """0.001 rad off the upright is no equilibrium, of 20 µg neither; the upright is one, of 3 t."""
    upright = scaled(mass, length, 0.0)
    assert ut.check_mechanism(upright, compiled=False).passed
    modes = np.sort(upright.linearise().A.real.ravel())
    assert np.isfinite(modes).all()
    leaning = scaled(mass, length, 1e-3)
    with pytest.raises(ModelError, match=r"phi=-0\.00"):
        ut.first_surface(leaning)
    failed = ut.check_mechanism(leaning, compiled=False).failures
    assert [check.name for check in failed] == [
        "target x = 0 is an equilibrium of the free coordinates, |f_u(0, 0)|"
    ]


@pytest.mark.parametrize("unit", [1.0, 1e-6, 1e6, 1e-200, 1e200])
def test_how_controllable_a_mechanism_is_does_not_depend_on_the_unit_of_its_input(
    unit: float,
) -> None:
    cart = ut.mechanisms.cart_pendulum()
    other = ut.Mechanism(
        "other", cart.coordinates, cart.inputs, cart.mass_matrix, cart.force,
        sp.ImmutableDenseMatrix(cart.input_matrix * unit), parameters=cart.parameters,
    )  # fmt: skip
    assert controllability(other) == pytest.approx(controllability(cart), rel=1e-9)


def test_coordinates_may_be_called_like_keywords() -> None:
    """A mapping names what a keyword of the same function hides."""
    # Kernels know places alone: under the library's title it has the library's.
    like = ut.mechanisms.rotary_pendulum()
    arm = named(("target", "duration", "plant"), like, title="rotary_pendulum")
    cascade = ut.Cascade(arm, ut.MinimumTime(), belief="exact", cold=ut.Budget(64))
    run = cascade.simulate({"duration": 0.1, "target": 0.02}, duration=0.01)
    assert run.trajectory.x[0].tolist() == [0.02, 0.1, 0.0, 0.0]
    with pytest.raises(InvalidInputError, match="initial state: got x0 and target_dot"):
        cascade.simulate({"target": 0.1}, target_dot=0.1)
    unknown = r"unknown state of 'rotary_pendulum': got 'tarjet'"
    with pytest.raises(InvalidInputError, match=unknown):
        cascade.simulate({"tarjet": 0.1})


def test_inputs_through_a_whole_matrix_are_sent_where_they_are_taken() -> None:
    x, a = ut.Coordinate("x", "m"), ut.Coordinate("a", "rad")
    with pytest.raises(ModelError, match=r"must be \(1, 1\).*modelling.from_energies"):
        ut.Mechanism(
            "z", (x, a), (ut.Input("f", "N"),), sp.eye(2), sp.zeros(2, 1), sp.Matrix([1, -1])
        )


def test_a_matrix_of_what_it_may_not_hold_says_what_it_may() -> None:
    """Not to declare a coordinate as a coordinate."""
    x, p = ut.Coordinate("x", "m"), ut.Coordinate("phi")
    force, mass = ut.Input("force", "N", 10.0), sp.Matrix([[2, 0.3], [0.3, 0.5]])
    f = sp.Matrix([0, -p.symbol])
    for matrix, word in (
        ({"input_matrix": sp.Matrix([[sp.cos(p.symbol)]])}, "made of phi.*B is constant"),
        ({"mass_matrix": mass * (1 + p.velocity**2)}, "made of phi_dot.*belongs to f"),
        ({"mass_matrix": mass * (1 + TIME**2)}, "made of t, must be made of positions"),
    ):
        with pytest.raises(ModelError, match=word):
            ut.Mechanism("own", (x, p), (force,), **{"mass_matrix": mass, "force": f} | matrix)


@pytest.mark.parametrize(
    ("unit", "gain", "units"),
    [("N", 1, ("N", "N m")), ("kN", -1, ("kN", "kN m")), ("kN", 1000, ("N", "N m")),
     ("V", 1, ("N", "N m"))],
)  # fmt: skip
def test_forces_are_in_the_unit_of_an_input_that_acts_as_it_is(
    unit: str, gain: int, units: tuple[str, ...]
) -> None:
    """Masses in tonnes, input in kN: no friction or disturbance is 1000 times what is printed."""
    cart = ut.mechanisms.cart_pendulum()
    inputs = (ut.Input("force", unit, 20.0),)
    made = replace(cart, inputs=inputs, input_matrix=sp.Matrix([[gain]]))
    assert made.force_units == units
    assert made.with_friction(x=0.1).parameters[-1].unit == units[0]


#: What stands where a text is asked for.
WRONG: tuple[Any, ...] = (10.0, -1, None)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: ut.Input("F", WRONG[0]), "unit of input 'F': got 10.0, a float"),
        (
            lambda: ut.Coordinate("x", "m", WRONG[1], 1),
            "description of coordinate 'x': got -1, an int",
        ),
        (lambda: ut.Parameter("m", 1.0, WRONG[2]), "unit of parameter 'm': got None, must be text"),
    ],
)
def test_a_number_in_the_place_of_a_text_is_refused(make: Any, words: str) -> None:
    """A limit in the place of the unit made an actuator without any limit, without a word."""
    with pytest.raises(UndertowError, match=words) as refusal:
        make()
    assert "Write for instance" in str(refusal.value)


@pytest.mark.parametrize("name", ["", "  ", "a\nb", "\x1b[2J"])
def test_a_mechanism_has_a_name_that_can_be_shown(name: str) -> None:
    """Errors about '' say nothing, and a terminal obeys control characters."""
    with pytest.raises(UndertowError, match="name of a mechanism"):
        replace(ut.mechanisms.rotary_pendulum(), name=name)


def test_a_parameter_of_a_mechanism_without_any_is_told_how_one_is_declared() -> None:
    """The refusal had read "must be one of ."."""
    x, y = ut.Coordinate("x", "m"), ut.Coordinate("y", "m")
    fixed = ut.Mechanism.from_energies(
        "fixed",
        [x, y],
        [ut.Input("F", "N")],
        kinetic=x.velocity**2 + y.velocity**2,
        potential=(x.symbol - y.symbol) ** 2,
    )
    with pytest.raises(UndertowError, match=r"there are none. .* parameters=\[Parameter"):
        fixed.with_parameters(m=0.2)
