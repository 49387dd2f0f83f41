"""Ways in: whatever a mechanism is written in, the same M, f and B come out."""

from __future__ import annotations

import inspect
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import sympy as sp

import undertow as ut
from undertow.base import InvalidInputError, ModelError
from undertow.checks import check_mechanism
from undertow.mechanisms.chain import chain_energies
from undertow.models import FloatArray
from undertow.models import importers as modelling
from undertow.models.importers.coordinates import exact_angle

TIGHT = 1e-10


def states(mechanism: ut.Mechanism, count: int = 40, seed: int = 0) -> FloatArray:
    return np.random.default_rng(seed).uniform(-2, 2, (count, 2 * mechanism.n))


def assert_same(
    ours: ut.Mechanism, theirs: ut.Mechanism, transform: FloatArray | None = None
) -> None:
    """M, f, B of ``ours`` in x are those of ``theirs`` in ``q' = P q``, to 1e-10 relative."""
    n, m = ours.n, ours.m
    P = np.eye(n) if transform is None else transform
    x = states(ours)
    moved = np.hstack([x[:, :n] @ P.T, x[:, n:] @ P.T])
    M, M_other = ours.M(x[:, :n]), P.T @ theirs.M(moved[:, :n]) @ P
    assert np.abs(M - M_other).max() <= TIGHT * np.abs(M).max()
    f, f_other = ours.f(x), theirs.f(moved) @ P
    assert np.abs(f - f_other).max() <= TIGHT * np.abs(f).max()
    push = np.vstack([_input(theirs), np.zeros((n - m, m))])
    wanted = np.vstack([_input(ours), np.zeros((n - m, m))])
    np.testing.assert_allclose(P.T @ push, wanted, atol=1e-12)


def _input(mechanism: ut.Mechanism) -> FloatArray:
    return np.array(mechanism.input_matrix.subs(mechanism.substitution), dtype=np.float64)


# -- inputs that do not act on single coordinates ---------------------------------------------


def absolute_arm() -> tuple[list[ut.Coordinate], sp.Expr, sp.Expr, sp.Expr]:
    """The library's Acrobot in the absolute angles of its links, first link first."""
    p = {p.name: sp.Float(p.value) for p in ut.mechanisms.acrobot().parameters}
    q = [ut.Coordinate("lean_1"), ut.Coordinate("lean_2")]
    w = [c.velocity for c in q]
    T, V = chain_energies(p, [c.symbol for c in q], w)
    return q, T, V, p["b_1"] * w[0] ** 2 / 2 + p["b_2"] * (w[1] - w[0]) ** 2 / 2


def test_an_elbow_torque_in_absolute_angles() -> None:
    """Claim: B = (−1, 1) in absolute angles becomes the Acrobot in (q_2, q_1), to 1e-10."""
    q, T, V, D = absolute_arm()
    arm = modelling.from_energies(
        "arm", q, [ut.Input("torque", "N m", 30.0)], T, V, sp.Matrix([-1, 1]), dissipation=D
    )
    assert [c.name for c in arm.coordinates] == ["lean_2_minus_lean_1", "lean_1"]
    with pytest.raises(InvalidInputError, match="lean_2_minus_lean_1 is lean_2 - lean_1"):
        arm.state(lean_2_dot=0.1)  # what was given in its place is told
    assert_same(arm, ut.mechanisms.acrobot())
    assert check_mechanism(arm, compiled=False).passed


def test_differential_torques() -> None:
    """Claim: inputs through any constant (n, m) B of rank m get coordinates of their own, and
    the accelerations of the given coordinates stay what they were."""
    q = [ut.Coordinate(name) for name in ("left", "right", "load")]
    w = sp.Matrix([c.velocity for c in q])
    mass = sp.Matrix([[2, 0.3, 0.1], [0.3, 1, 0.2], [0.1, 0.2, 1.5]])
    mass[0, 1] = mass[1, 0] = sp.cos(q[2].symbol) * 3 / 10
    k = ut.Parameter("k_d", 0.7, "", "ratio of the differential", 0)
    B = sp.Matrix([[k.symbol, 1], [-1, k.symbol], [0, 2]])
    V = sum(c.symbol**2 for c in q) / 2 + sp.cos(q[0].symbol - q[2].symbol)
    rig = modelling.from_energies(
        "differential",
        q,
        [ut.Input("u_l", "N m", 9.0), ut.Input("u_r", "N m", 9.0)],
        (w.T * mass * w)[0, 0] / 2,
        V,
        B,
        parameters=[k],
        dissipation=(w.T * w)[0, 0] / 20,
    )
    form = modelling.actuate(q, mass, sp.zeros(3, 1), B, values={k.symbol: k.value})
    T = np.array(form.transform.subs(k.symbol, k.value), dtype=np.float64)
    z = states(rig, 1, 3)[0]
    u = np.array([1.0, -2.0])
    # By hand, in the given coordinates.
    position, rate = T @ z[:3], T @ z[3:]
    at = dict(zip([*(c.symbol for c in q), *w], [*position, *rate], strict=True))
    slopes = [mass.diff(c.symbol) for c in q]
    Mdot = sum((s * v for s, v in zip(slopes, w, strict=True)), sp.zeros(3))
    c = Mdot * w - sp.Matrix([(w.T * s * w)[0, 0] / 2 for s in slopes])
    force = -c - sp.Matrix([sp.diff(V, a.symbol) for a in q]) - w / 10 + B * sp.Matrix(u)
    number = {k.symbol: k.value}
    by_hand = np.linalg.solve(
        np.array(mass.subs(at), dtype=np.float64),
        np.array(force.subs(at).subs(number), dtype=np.float64).ravel(),
    )
    np.testing.assert_allclose(T @ rig.accelerations(0.0, z, u), by_hand, rtol=1e-10)
    assert check_mechanism(rig, compiled=False).passed


def sliding_pair(B: sp.Matrix) -> ut.Mechanism:
    """A load between two sliders with travel, joined to both by springs."""
    q = [ut.Coordinate("load", "m"), *(ut.Coordinate(k, "m", "", -1, 2) for k in ("x", "y"))]
    T = sum(c.velocity**2 for c in q) / 2
    V = sum((q[0].symbol - c.symbol) ** 2 for c in q[1:])
    inputs = [ut.Input(f"u_{j}", "N", 9.0) for j in range(B.cols)]
    return modelling.from_energies("pair", q, inputs, T, V, B)


def test_coordinates_that_inputs_act_on_together_are_kept() -> None:
    """Two winches pull two sliders, both both: what moves is x and y all the same, with travel."""
    pair = sliding_pair(sp.Matrix([[0, 0], [1, -1], [2, 3]]))
    assert [c.name for c in pair.coordinates] == ["y", "x", "load"]
    assert [(c.low, c.high) for c in pair.coordinates[:2]] == [(-1, 2)] * 2
    pushed = pair.accelerations(0.0, np.zeros(6), [1.0, 2.0])  # masses of 1 kg
    np.testing.assert_allclose(pushed, [2 * 1 + 3 * 2, 1 - 2, 0], atol=1e-15)


def test_travel_that_a_combination_takes_the_place_of_is_not_lost_in_silence() -> None:
    with pytest.warns(UserWarning, match="travel of 'x', -1 to 2 m, is not kept: x = x_plus_y - y"):
        pair = sliding_pair(sp.Matrix([0, 1, 1]))
    assert [c.name for c in pair.coordinates] == ["x_plus_y", "load", "y"]


def test_a_combination_is_measured_as_what_it_is_most_of() -> None:
    """A belt moves a cart and turns its roller a little: metres, and no angle."""
    turn, x = ut.Coordinate("turn", "rad"), ut.Coordinate("x", "m")
    form = modelling.actuate([turn, x], sp.eye(2), sp.zeros(2, 1), sp.Matrix([0.1, 2]))
    assert [(c.name, c.unit) for c in form.coordinates] == [("stroke_1", "m"), ("turn", "rad")]


def test_coordinates_in_another_order() -> None:
    """Claim: M, f and B in any order of the coordinates give the same mechanism, names kept."""
    rig = ut.mechanisms.double_pendulum_on_a_cart()
    order = [2, 0, 1]
    mass = sp.Matrix(3, 3, lambda i, j: rig.mass_matrix[order[i], order[j]])
    force = sp.Matrix([rig.force[i] for i in order])
    assert rig.potential is not None
    shuffled = modelling.from_matrices(
        "shuffled",
        [rig.coordinates[i] for i in order],
        rig.inputs,
        mass,
        force,
        sp.Matrix([0, 1, 0]),
        parameters=rig.parameters,
        potential=rig.potential,
    )
    assert [c.name for c in shuffled.coordinates] == ["x", "phi_2", "phi_1"]
    assert_same(rig, shuffled, np.eye(3)[[0, 2, 1]])


def test_inputs_that_cannot_be_separated_are_refused() -> None:
    """Claim: two inputs along one direction, none at all, or a direction that turns with the
    state are refused with what could help."""
    q = [ut.Coordinate("a_1"), ut.Coordinate("a_2"), ut.Coordinate("a_3")]
    with pytest.raises(ModelError, match="rank 2"):
        modelling.actuate(q, sp.eye(3), sp.zeros(3, 1), sp.Matrix([[1, 2], [1, 2], [0, 0]]))
    with pytest.raises(ModelError, match="rank 1"):
        modelling.actuate(q, sp.eye(3), sp.zeros(3, 1), sp.zeros(3, 1))
    turning = sp.Matrix([sp.cos(q[0].symbol), 0, 0])
    with pytest.raises(ModelError, match="Choose coordinates along which the inputs act"):
        modelling.actuate(q, sp.eye(3), sp.zeros(3, 1), turning)
    with pytest.raises(ModelError, match="shape"):
        modelling.actuate(q, sp.eye(3), sp.zeros(3, 1), sp.Matrix([1, 0]))


def test_energies_that_are_none_are_refused() -> None:
    """Claim: a kinetic energy that is not quadratic in the velocities is refused."""
    q = [ut.Coordinate("a_1"), ut.Coordinate("a_2")]
    T = q[0].velocity ** 2 + q[1].velocity ** 3
    with pytest.raises(ModelError, match="quadratic form"):
        modelling.from_energies("odd", q, [ut.Input("u", "N m")], T, 0, sp.Matrix([1, 0]))


def test_a_mass_matrix_that_is_not_symmetric_is_refused() -> None:
    """Claim: the upper half is not silently mirrored."""
    q = [ut.Coordinate("a_1"), ut.Coordinate("a_2")]
    with pytest.raises(ModelError, match="symmetric"):
        modelling.from_matrices(
            "skew",
            q,
            [ut.Input("u", "N m")],
            sp.Matrix([[2, 1], [0, 2]]),
            sp.zeros(2, 1),
            sp.Matrix([1, 0]),
        )


# -- targets ----------------------------------------------------------------------------------


def test_the_hanging_cart_pendulum_in_error_coordinates() -> None:
    """Claim: moved to φ = π, the same cart reads zero there, and its state means an error."""
    rig = ut.mechanisms.cart_pendulum()
    hanging = modelling.move_target(rig, phi=math.pi)
    assert check_mechanism(hanging, compiled=False).passed
    x = states(rig)
    shifted = x + np.array([0, math.pi, 0, 0])
    u = np.ones((len(x), 1))
    np.testing.assert_allclose(
        hanging.accelerations(0, x, u), rig.accelerations(0, shifted, u), rtol=1e-9, atol=1e-9
    )
    # Exact: no sin(φ + 3.14…) is left in the equations.
    assert not hanging.force.has(sp.pi)
    assert hanging.force.atoms(sp.sin) == rig.force.atoms(sp.sin)


def test_a_target_that_needs_torque() -> None:
    """Claim: the Pendubot with link 1 at 30° and link 2 upright is found from a rough guess, is
    an equilibrium of the free link, and needs the torque of statics."""
    rig = ut.mechanisms.pendubot()
    found = modelling.find_equilibrium(rig, q_1=math.radians(30), q_2=-0.4)
    assert found["q_2"] == pytest.approx(-math.radians(30), abs=1e-9)
    leaning = modelling.move_target(rig, **found)
    p = {p.name: p.value for p in rig.parameters}
    gravity = p["m_1"] * p["a_1"] + p["m_2"] * p["l_1"]
    torque = -gravity * p["g"] * math.sin(math.radians(30))
    assert modelling.holding_input(leaning)[0] == pytest.approx(torque)
    assert check_mechanism(leaning, compiled=False)["inputs can hold"].value == pytest.approx(
        abs(torque) / 3.5
    )
    assert leaning.f(leaning.state())[1] == pytest.approx(0, abs=1e-9)


def test_targets_that_are_no_equilibria_are_refused() -> None:
    """Claim: a target on which an unbalanced force acts, and a guess without equilibrium, are
    refused with the force."""
    rig = ut.mechanisms.cart_pendulum()
    with pytest.raises(ModelError, match=r"force of 0\.58.* on 'phi'"):
        modelling.move_target(rig, phi=1.5)
    with pytest.raises(InvalidInputError, match="psi"):
        modelling.move_target(rig, psi=1.0)
    with pytest.raises(InvalidInputError, match="finite"):
        modelling.find_equilibrium(rig, phi=math.nan)
    ball = ut.mechanisms.ball_and_beam()
    with pytest.raises(ModelError, match=r"near .*theta"):
        modelling.find_equilibrium(ball, theta=0.3)


def test_a_target_that_seems_to_be_in_degrees_is_told_of() -> None:
    """phi=180 was said to have no equilibrium near; a guess of 180 found one at 179.07 rad."""
    rig = ut.mechanisms.cart_pendulum()
    words = r"phi = 180 rad is 10313°: if degrees are meant, give undertow\.deg\(180\)"
    with pytest.raises(ModelError, match=words):
        modelling.move_target(rig, phi=180)
    with pytest.raises(ModelError, match=words):
        modelling.from_matrices(
            "hanging", rig.coordinates, rig.inputs, sp.Matrix(rig.mass_matrix),
            sp.Matrix(rig.force), [[1], [0]], parameters=rig.parameters, equilibrium={"phi": 180},
        )  # fmt: skip
    for search in (
        lambda: modelling.find_equilibrium(rig, phi=180.0),
        lambda: modelling.at_equilibrium(rig, {"phi": 180.0}),
    ):
        with pytest.warns(UserWarning, match=words):
            search()
    moved = modelling.move_target(rig, phi=3 * math.pi)  # hanging, and meant: without a word
    assert abs(moved.f(moved.state())).max() < 1e-9


def test_targets_in_from_matrices() -> None:
    """Claim: the equilibrium may be given while building: ranges and coordinates shift with it."""
    rig = ut.mechanisms.cart_pendulum()
    built = modelling.from_matrices(
        "hanging",
        rig.coordinates,
        rig.inputs,
        sp.Matrix(rig.mass_matrix),
        sp.Matrix(rig.force),
        sp.Matrix([1, 0]),
        parameters=rig.parameters,
        potential=rig.potential,
        equilibrium={"phi": math.pi, "x": 0.5},
    )
    assert (built.coordinates[0].low, built.coordinates[0].high) == (-2.0, 1.0)
    assert_same(modelling.move_target(rig, phi=math.pi, x=0.5), built)


def test_angles_are_recognised() -> None:
    """Claim: multiples of π/12 become exact, other numbers stay."""
    assert exact_angle(math.pi / 6) == sp.pi / 6
    assert exact_angle(-math.pi) == -sp.pi
    assert exact_angle(0.3) == sp.Float(0.3)


# -- SymPy's own mechanics --------------------------------------------------------------------


def cart_numbers() -> list[ut.Parameter]:
    return list(ut.mechanisms.cart_pendulum().parameters)


def test_lagranges_method() -> None:
    """Claim: SymPy's LagrangesMethod with forces and damping gives the library's cart pendulum."""
    mechanics: Any = pytest.importorskip("sympy.physics.mechanics")
    x, phi, F = mechanics.dynamicsymbols("x phi F")
    m_c, m_p, l, J_p, b_c, b_p, g = sp.symbols("m_c m_p l J_p b_c b_p g")  # noqa: E741
    N = mechanics.ReferenceFrame("N")
    rod = N.orientnew("R", "Axis", [phi, N.z])
    cart = mechanics.Point("C")
    cart.set_vel(N, x.diff() * N.x)
    T = (m_c + m_p) * x.diff() ** 2 / 2 + m_p * l * sp.cos(phi) * x.diff() * phi.diff()
    T += (J_p + m_p * l**2) * phi.diff() ** 2 / 2
    method = mechanics.LagrangesMethod(
        T - m_p * g * l * sp.cos(phi),
        [phi, x],
        forcelist=[(cart, (F - b_c * x.diff()) * N.x), (rod, -b_p * phi.diff() * N.z)],
        frame=N,
    )
    built = modelling.from_lagrange(
        "cart",
        method,
        {F: ut.Input("force", "N", 20.0)},
        parameters=cart_numbers(),
        units={"x": "m"},
    )
    assert [c.name for c in built.coordinates] == ["x", "phi"]
    assert_same(ut.mechanisms.cart_pendulum(), built)
    assert check_mechanism(built, compiled=False).passed
    with pytest.raises(InvalidInputError, match="b_p"):
        modelling.from_lagrange(
            "cart",
            method,
            {F: ut.Input("force", "N")},
            parameters=[p for p in cart_numbers() if p.name != "b_p"],
        )
    with pytest.raises(InvalidInputError, match="units"):
        modelling.from_lagrange(
            "cart", method, {F: ut.Input("f", "N")}, parameters=cart_numbers(), units={"y": "m"}
        )


def test_inputs_that_do_not_enter_linearly_are_refused() -> None:
    """Claim: F² in the forces is no input of this class; constraints are none either."""
    mechanics: Any = pytest.importorskip("sympy.physics.mechanics")
    x, phi, F = mechanics.dynamicsymbols("x phi F")
    N = mechanics.ReferenceFrame("N")
    cart = mechanics.Point("C")
    cart.set_vel(N, x.diff() * N.x)
    L = x.diff() ** 2 + x.diff() * phi.diff() * sp.cos(phi) + phi.diff() ** 2 - sp.cos(phi)
    method = mechanics.LagrangesMethod(L, [x, phi], forcelist=[(cart, F**2 * N.x)], frame=N)
    with pytest.raises(ModelError, match="not linear"):
        modelling.from_lagrange("squared", method, {F: ut.Input("force", "N")})
    held = mechanics.LagrangesMethod(
        L, [x, phi], forcelist=[(cart, F * N.x)], frame=N, hol_coneqs=[x - phi]
    )
    with pytest.raises(ModelError, match="independent coordinates"):
        modelling.from_lagrange("held", held, {F: ut.Input("force", "N")})


@pytest.mark.parametrize("mixed", [False, True])
def test_kanes_method(mixed: bool) -> None:
    """Claim: KanesMethod gives the same, with plain speeds and with speeds that are combinations
    of the q̇ that change with q (the speed of the pendulum's tip)."""
    mechanics: Any = pytest.importorskip("sympy.physics.mechanics")
    x, phi, F, u1, u2 = mechanics.dynamicsymbols("x phi F u1 u2")
    m_c, m_p, l, J_p, b_c, b_p, g = sp.symbols("m_c m_p l J_p b_c b_p g")  # noqa: E741
    N = mechanics.ReferenceFrame("N")
    R = N.orientnew("R", "Axis", [-phi, N.z])
    origin = mechanics.Point("O")
    origin.set_vel(N, 0)
    cart = origin.locatenew("C", x * N.x)
    tip = cart.locatenew("P", l * R.y)
    speeds = [u1 - x.diff(), u2 - phi.diff()]
    if mixed:
        speeds = [u1 - x.diff(), u2 - x.diff() - l * sp.cos(phi) * phi.diff()]
    rates = sp.solve(speeds, [x.diff(), phi.diff()])
    cart.set_vel(N, rates[x.diff()] * N.x)
    R.set_ang_vel(N, -rates[phi.diff()] * N.z)
    tip.v2pt_theory(cart, N, R)
    inertia = (mechanics.inertia(R, 0, 0, J_p), tip)
    bodies = [
        mechanics.Particle("cart", cart, m_c),
        mechanics.RigidBody("rod", tip, R, m_p, inertia),
    ]
    loads = [
        (cart, (F - b_c * rates[x.diff()]) * N.x),
        (tip, -m_p * g * N.y),
        (R, b_p * rates[phi.diff()] * N.z),
    ]
    method = mechanics.KanesMethod(N, q_ind=[x, phi], u_ind=[u1, u2], kd_eqs=speeds)
    method.kanes_equations(bodies, loads)
    built = modelling.from_kane(
        "cart",
        method,
        {F: ut.Input("force", "N", 20.0)},
        parameters=cart_numbers(),
        units={"x": "m"},
    )
    assert_same(ut.mechanisms.cart_pendulum(), built)


# -- drives -----------------------------------------------------------------------------------


def test_a_motor_turns_volts_into_torque() -> None:
    """Claim: behind a motor, the torque at rest is a V, at speed it loses b ω, and the rotor adds
    its reflected inertia: the formulas of the data sheet, one by one."""
    motor = modelling.DCMotor(
        torque_constant=0.0077,
        resistance=2.6,
        back_emf_constant=0.0080,
        gear_ratio=70.0,
        motor_efficiency=0.69,
        gear_efficiency=0.9,
        viscous_friction=0.004,
        rotor_inertia=4e-7,
        voltage_limit=6.0,
    )
    rig = ut.mechanisms.pendubot()
    driven = modelling.voltage_driven(rig, motor)
    assert driven.inputs[0] == ut.Input("voltage", "V", 6.0)
    x = states(rig)
    omega, volts = x[:, 2], 3.0
    current = (volts - 0.0080 * 70 * omega) / 2.6
    torque = 0.9 * 0.69 * 70 * 0.0077 * current - 0.004 * omega
    extra = driven.f(x) - rig.f(x)
    extra[:, 0] += volts * _input(driven)[0, 0]
    np.testing.assert_allclose(extra[:, 0], torque, rtol=1e-12)
    np.testing.assert_allclose(extra[:, 1], 0, atol=1e-15)
    gained = driven.M(x[:, :2]) - rig.M(x[:, :2])
    np.testing.assert_allclose(gained[:, 0, 0], 0.9 * 70**2 * 4e-7, rtol=1e-9)
    assert check_mechanism(driven, compiled=False).passed
    assert driven.with_parameters(torque_R=5.2).parameters[-6].value == 5.2


def test_a_motor_on_a_coupled_input() -> None:
    """Claim: where B is no identity the motor turns with Bᵀ q̇_a, so that energy balances: the
    power of the shaft is what the joints receive."""
    crane = ut.mechanisms.gantry_crane()
    B = sp.ImmutableDenseMatrix([[2, 1], [0, 3]])
    geared = modelling.from_matrices(
        "geared",
        crane.coordinates,
        crane.inputs,
        sp.Matrix(crane.mass_matrix),
        sp.Matrix(crane.force),
        sp.Matrix.vstack(sp.eye(2), sp.zeros(2)),
        parameters=crane.parameters,
    )
    geared = ut.Mechanism(
        "geared",
        geared.coordinates,
        geared.inputs,
        geared.mass_matrix,
        geared.force,
        B,
        parameters=geared.parameters,
    )
    motor = modelling.DCMotor(torque_constant=0.5, resistance=2.0, gear_ratio=4.0)
    driven = modelling.voltage_driven(geared, {"force_x": motor})
    assert [i.unit for i in driven.inputs] == ["V", "N"]
    x = states(crane)
    drag = driven.f(x) - geared.f(x)
    shaft = x[:, 4:6] @ np.array(B, dtype=float)[:, 0]
    power = np.einsum("si,si->s", drag, x[:, 4:])
    np.testing.assert_allclose(power, -motor.damping * shaft**2, rtol=1e-9)
    assert _input(driven)[:, 0].tolist() == [2 * motor.torque_per_volt, 0]
    assert _input(driven)[:, 1].tolist() == [1, 3]


def test_motors_that_do_not_exist_are_refused() -> None:
    """Claim: wrong data and wrong places are refused."""
    with pytest.raises(InvalidInputError, match="resistance"):
        modelling.DCMotor(torque_constant=1.0, resistance=0.0)
    with pytest.raises(InvalidInputError, match="motor_efficiency"):
        modelling.DCMotor(torque_constant=1.0, resistance=1.0, motor_efficiency=1.2)
    with pytest.raises(InvalidInputError, match="rotor_inertia"):
        modelling.DCMotor(torque_constant=1.0, resistance=1.0, rotor_inertia=-1.0)
    motor = modelling.DCMotor(torque_constant=1.0, resistance=1.0)
    with pytest.raises(InvalidInputError, match="'elbow'"):
        modelling.voltage_driven(ut.mechanisms.pendubot(), {"elbow": motor})
    with pytest.raises(ModelError, match="in V already"):
        modelling.voltage_driven(ut.mechanisms.rotary_pendulum(), motor)
    cart = ut.mechanisms.cart_pendulum()
    tonnes = replace(cart, inputs=(ut.Input("force", "kN", 0.1),), input_matrix=[[1000]])
    with pytest.raises(ModelError, match="got in kN, must be a torque in N m or a force in N"):
        modelling.voltage_driven(tonnes, motor)
    dotted = replace(cart, inputs=(ut.Input("torque", "N·m", 100.0),))
    assert modelling.voltage_driven(dotted, motor).inputs[0].unit == "V"


# -- one's own mechanism ----------------------------------------------------------------------


def own_mechanism() -> ut.Mechanism:
    """A pendulum on a skater who is pushed along a spring."""
    x = ut.Coordinate("x", "m", "skater")
    phi = ut.Coordinate("phi", "rad", "pole, from the upright")
    data = [
        ut.Parameter("m_s", 60.0, "kg", "skater", 0),
        ut.Parameter("m_p", 5.0, "kg", "pole", 0),
        ut.Parameter("l", 1.2, "m", "half the pole", 0),
        ut.Parameter("k", 50.0, "N/m", "spring", 0),
    ]
    m_s, m_p, l, k = (p.symbol for p in data)  # noqa: E741
    v, w, c = x.velocity, phi.velocity, sp.cos(phi.symbol)
    return ut.Mechanism.from_energies(
        "skater",
        [x, phi],
        [ut.Input("push", "N", 300.0)],
        kinetic=(m_s + m_p) * v**2 / 2 + m_p * l * c * v * w + m_p * l**2 * w**2 * 2 / 3,
        potential=m_p * 9.81 * l * c + k * x.symbol**2 / 2,
        parameters=tuple(data),
        start={"phi": 0.1},
    )


def test_a_mechanism_of_ones_own_takes_under_25_lines() -> None:
    """Claim: under 25 lines give a mechanism that passes every check and has a surface."""
    assert len(inspect.getsource(own_mechanism).splitlines()) < 25
    rig = own_mechanism()
    assert check_mechanism(rig, compiled=False).passed
    assert ut.first_surface(rig).n == 2
