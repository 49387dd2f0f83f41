"""check_mechanism: passes what is sound, and names what is not, with the numbers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import sympy as sp

import undertow as ut
from undertow.base import ModelError
from undertow.checks import check_mechanism
from undertow.checks.agreement import QUICK
from undertow.mechanisms import LIBRARY
from undertow.mechanisms.chain import chain_energies
from undertow.models import force_scale


@pytest.mark.parametrize("name", sorted(LIBRARY))
def test_every_mechanism_of_the_library_passes(name: str) -> None:
    """Claim: all identities and class conditions hold for every mechanism of the library."""
    report = check_mechanism(LIBRARY[name](), strict=True, compiled=False)
    assert report.passed
    assert len(report.checks) >= 13
    assert name in str(report)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=() if name == "rotary_pendulum" else pytest.mark.slow)
        for name in sorted(LIBRARY)
    ],
)
def test_what_is_compiled_of_the_library_is_what_the_symbols_say(name: str) -> None:
    """Claim: NumPy's functions, the law, the kernel and the proofs' programme, to rounding."""
    mechanism = LIBRARY[name]()
    without = {check.name for check in check_mechanism(mechanism, compiled=False).checks}
    report = check_mechanism(mechanism, strict=True)
    assert len([check for check in report.checks if check.name not in without]) == len(QUICK)


@pytest.mark.parametrize("parameter_set", ["srv02", "qube_servo_2"])
def test_the_quanser_sets_pass(parameter_set: str) -> None:
    """Claim: so do the rotary pendulum's other parameter sets."""
    assert check_mechanism(ut.mechanisms.rotary_pendulum(parameter_set)).passed


def broken(report_of: ut.Mechanism) -> list[str]:
    return [check.name for check in check_mechanism(report_of, compiled=False).failures]


def cart() -> ut.Mechanism:
    return ut.mechanisms.cart_pendulum()


def with_force(mechanism: ut.Mechanism, *extra: sp.Expr | float) -> ut.Mechanism:
    changed = sp.Matrix(mechanism.force) + sp.Matrix(list(extra))
    return replace(mechanism, force=sp.ImmutableDenseMatrix(changed))


def test_a_wrong_coriolis_force_is_found() -> None:
    """Claim: a slip of 1 % in a centrifugal term breaks Lagrange's identity, and only that."""
    rig = cart()
    w, p = rig.x[3], rig.q[1]
    (name,) = broken(with_force(rig, sp.Rational(1, 1000) * sp.sin(p) * w**2, 0))
    assert name.startswith("velocity-dependent forces")


def test_a_workless_but_wrong_force_is_found() -> None:
    """Claim: more than power is checked: a quadratic force with q̇ᵀ c = 0 is found too, while a
    gyroscopic one (odd in q̇, workless) is allowed."""
    rig = cart()
    v, w = rig.x[2:]
    (name,) = broken(with_force(rig, v * w / 1000, -(v**2) / 1000))
    assert name.startswith("velocity-dependent forces")
    assert not broken(with_force(rig, w / 1000, -v / 1000))


def test_a_wrong_potential_is_found() -> None:
    """Claim: a potential that is not that of the forces breaks the energy balance."""
    rig = cart()
    assert rig.potential is not None
    (name,) = broken(replace(rig, potential=rig.potential * sp.Rational(101, 100)))
    assert name.startswith("forces at rest")


def test_damping_with_the_wrong_sign_is_found() -> None:
    """Claim: a force odd in q̇ that feeds energy in is refused."""
    rig = cart()
    (name,) = broken(with_force(rig, rig.x[2] / 2, 0))
    assert name.startswith("damping takes energy")


def test_a_target_that_is_no_equilibrium_is_found() -> None:
    """Claim: f_u(0, 0) ≠ 0 is reported with its size, and the remedy names the tool."""
    off = with_force(cart(), 0, sp.Rational(1, 4))
    report = check_mechanism(off, compiled=False)
    check = report["target x = 0 is an equilibrium"]
    assert not check.passed
    assert check.value == pytest.approx(0.25 / force_scale(off))
    assert "find_equilibrium" in check.remedy


def test_a_motor_too_weak_for_the_target_is_found() -> None:
    """Claim: a target on a slope of 5 N needs 5 N; with ±4 N it cannot be held."""
    slope = with_force(cart(), 5, 0)
    tilted = replace(slope, potential=None)
    assert check_mechanism(tilted, compiled=False).passed
    report = check_mechanism(tilted.with_input_limit(4.0), compiled=False)
    assert [c.name for c in report.failures] == [report["inputs can hold"].name]
    assert report["inputs can hold"].value == pytest.approx(1.25)


def test_a_start_outside_its_range_is_found() -> None:
    """Claim: start states obey the ranges of travel."""
    (name,) = broken(replace(cart(), start={"x": 2.0}))
    assert name.startswith("start state lies within")


def vessel() -> ut.Mechanism:
    """A planar vessel in body axes (surge, yaw, sway), driven by surge force and yaw moment."""
    surge, yaw = ut.Coordinate("surge", "m"), ut.Coordinate("yaw")
    sway = ut.Coordinate("sway", "m")
    u, r, v = surge.velocity, yaw.velocity, sway.velocity
    m_11, m_22, m_33 = 25.8, 33.8, 2.76
    return ut.Mechanism(
        "vessel",
        (surge, yaw, sway),
        (ut.Input("thrust", "N", 10.0), ut.Input("moment", "N m", 5.0)),
        sp.ImmutableDenseMatrix(sp.diag(m_11, m_33, m_22)),
        sp.ImmutableDenseMatrix(
            [m_22 * v * r - 0.7 * u, (m_11 - m_22) * u * v - 0.5 * r, -m_11 * u * r - 7 * v]
        ),
    )


def free_arm() -> ut.Mechanism:
    """A free-floating two-link arm about its centre of mass: attitude free, joint driven."""
    joint, base = ut.Coordinate("joint"), ut.Coordinate("base")
    w, s = base.velocity, joint.velocity
    coupled = sp.cos(joint.symbol) * w * (w + s) / 2
    return ut.Mechanism.from_energies(
        "free_arm",
        [joint, base],
        [ut.Input("torque", "N m", 1.0)],
        kinetic=w**2 + (w + s) ** 2 + coupled,
        potential=0,
    )


@pytest.mark.parametrize("build", [vessel, free_arm])
def test_mechanisms_without_potential_are_refused(build: object) -> None:
    """Claim: vessel and free-floating arm are refused for infinitely many equilibria (Remark 3),
    with the dimension of their manifold."""
    mechanism = build()  # type: ignore[operator]
    report = check_mechanism(mechanism, compiled=False)
    check = report["equilibria near the target"]
    assert not check.passed
    assert check.value == mechanism.n > mechanism.m
    if build is free_arm:
        with pytest.raises(ModelError, match="every position is an equilibrium") as caught:
            check_mechanism(mechanism, strict=True, compiled=False)
        assert "Remark 3" in str(caught.value)


def twin_pendulums(second: float) -> ut.Mechanism:
    """Two pendulums side by side on one cart, 0.3 m and ``second`` m long."""
    x = ut.Coordinate("x", "m")
    rods = [ut.Coordinate("phi_1"), ut.Coordinate("phi_2")]
    T = x.velocity**2 / 2
    V = sp.Integer(0)
    for rod, length in zip(rods, (0.3, second), strict=True):
        link = {"m_1": 0.2, "J_1": 0.006, "a_1": length, "g": 9.81}
        kinetic, potential = chain_energies(link, [rod.symbol], [rod.velocity], x.velocity)
        T, V = T + kinetic, V + potential
    return ut.Mechanism.from_energies(
        "twin_pendulums", [x, *rods], [ut.Input("force", "N", 20.0)], T, V
    )


def test_an_uncontrollable_linearisation_is_refused() -> None:
    """Claim: two equal pendulums on one cart cannot be balanced together; unequal ones can."""
    with pytest.raises(ModelError, match="controllable") as caught:
        check_mechanism(twin_pendulums(0.3), strict=True, compiled=False)
    assert "actuate another joint" in str(caught.value)
    assert check_mechanism(twin_pendulums(0.5), compiled=False).passed


def test_a_free_coordinate_without_stiffness_is_refused() -> None:
    """Claim: a potential that starts at fourth order leaves too many equilibria to first order."""
    x, y = ut.Coordinate("x", "m"), ut.Coordinate("y", "m")
    flat = ut.Mechanism.from_energies(
        "flat",
        [x, y],
        [ut.Input("force", "N", 1.0)],
        kinetic=x.velocity**2 + x.velocity * y.velocity / 2 + y.velocity**2,
        potential=y.symbol**4,
    )
    report = check_mechanism(flat, compiled=False)
    assert not report["equilibria near the target"].passed
    assert report["equilibria near the target"].value == 2


def test_a_massless_link_is_refused() -> None:
    """Claim: a pendulum without mass has no M > 0, and is refused when it is built."""
    x, p = ut.Coordinate("x", "m"), ut.Coordinate("phi")
    link = {"m_1": 0.0, "J_1": 0.0, "a_1": 0.3, "g": 9.81}
    T, V = chain_energies(link, [p.symbol], [p.velocity], x.velocity)
    with pytest.raises(ModelError, match="massless link"):
        ut.Mechanism.from_energies(
            "massless", [x, p], [ut.Input("force", "N", 1.0)], T + x.velocity**2 / 2, V
        )


def test_a_nearly_massless_direction_is_reported() -> None:
    """Claim: the scale-free eigenvalue catches what an absolute one lets pass."""
    x, y = ut.Coordinate("x", "m"), ut.Coordinate("y", "m")
    almost = ut.Mechanism.from_energies(
        "almost",
        [x, y],
        [ut.Input("force", "N", 1.0)],
        kinetic=(x.velocity + y.velocity) ** 2 / 2 + sp.Float(1e-12) * x.velocity**2,
        potential=y.symbol**2,
    )
    assert not check_mechanism(almost, compiled=False)["M > 0"].passed


@pytest.mark.slow
def test_strict_names_the_condition_with_its_numbers() -> None:
    """Claim: the error carries the value, the limit and the remedy."""
    pushed = with_force(cart(), 0, sp.Rational(1, 4))
    with pytest.raises(ModelError) as caught:
        check_mechanism(replace(pushed, potential=None), strict=True)
    assert caught.value.value == f"{0.25 / force_scale(pushed):.4g}"
    assert "1e-09" in str(caught.value.limit)
    assert "move_target" in str(caught.value)


def test_a_mass_matrix_in_rows_of_another_order_is_refused() -> None:
    """Claim: M that is not symmetric does not pass for a mass matrix."""
    rig = cart()
    swapped = sp.Matrix(rig.mass_matrix)
    swapped[0, 1] *= 2
    with pytest.raises(ModelError, match="symmetric"):
        replace(rig, mass_matrix=sp.ImmutableDenseMatrix(swapped))


def test_the_report_prints_one_line_a_condition() -> None:
    """Claim: failures are marked and say what could help."""
    text = str(check_mechanism(with_force(cart(), 0, sp.Rational(1, 4)), compiled=False))
    failing = [line for line in text.splitlines() if "FAIL" in line]
    assert len(failing) == 2  # the equilibrium, and the potential it now disagrees with
    assert all(line.rstrip().endswith(("it out", "move_target")) for line in failing)
    assert np.isfinite(
        [c.value for c in check_mechanism(ut.mechanisms.rotary_pendulum()).checks]
    ).all()
