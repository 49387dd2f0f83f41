"""Surface certificates: sound, tight, for any n and m, and they fail where they should."""

from __future__ import annotations

import math
from fractions import Fraction
from functools import cache

import numpy as np
import pytest
import scipy.linalg
import sympy as sp

import undertow as ut
from support import rest_slow
from undertow.base import InvalidInputError
from undertow.law import (
    ReachingLaw,
    SlidingModeLaw,
    sliding_matrix,
    stability_margin,
)
from undertow.law.sliding import singularity
from undertow.models import linearise
from undertow.proofs import (
    ReachingCertificate,
    Verdict,
    hurwitz,
    nonsingular,
    reaching,
    singular_distance,
)
from undertow.proofs.claims.model_data import law_of, model_of
from undertow.proofs.exact_model import (
    exact_fraction,
)
from undertow.proofs.kernel.claims import Nonsingular, Reaching, decide

RIG = ut.mechanisms.rotary_pendulum()
BASE = ut.Surface(-1, -0.5, 5, 10)


def linear_mechanism(n: int, m: int, seed: int, symbolic: bool = False) -> ut.Mechanism:
    """A random linear mechanism; ``symbolic`` puts irrational numbers in its matrices."""
    rng = np.random.default_rng(seed)
    L = sp.Matrix(n, n, lambda i, j: sp.Rational(int(rng.integers(-4, 5)), 7))
    M = L * L.T + sp.eye(n) * (sp.sqrt(2) if symbolic else 1)
    F, D = (
        sp.Matrix(n, n, lambda i, j: sp.Rational(int(rng.integers(-9, 10)), 4)) for _ in range(2)
    )
    q = [ut.Coordinate(f"q{i}") for i in range(n)]
    x = sp.Matrix([c.symbol for c in q])
    v = sp.Matrix([c.velocity for c in q])
    return ut.Mechanism(
        "linear",
        tuple(q),
        tuple(ut.Input(f"u{i}", "N m") for i in range(m)),
        sp.ImmutableDenseMatrix(M),
        sp.ImmutableDenseMatrix(F * x - D * D.T * v),
    )


def pencil_margin(mechanism: ut.Mechanism, surface: ut.Surface) -> float:
    """−max Re of the finite eigenvalues of [[A − s, B], [C, 0]]: an independent road."""
    lin = linearise(mechanism)
    size, m = 2 * mechanism.n, mechanism.m
    left = np.block([[lin.A, lin.input], [surface.matrix, np.zeros((m, m))]])
    right = np.zeros_like(left)
    right[:size, :size] = np.eye(size)
    alpha, beta = scipy.linalg.eigvals(left, right, homogeneous_eigvals=True)
    keep = np.abs(beta) > 1e-9 * np.abs(alpha).max()
    return float(-(alpha[keep] / beta[keep]).real.max())


# -- outward rounding ----------------------------------------------------------------------


def test_floats_count_as_the_binary_numbers_that_they_are() -> None:
    """0.1 is not 1/10; what is proved holds for the float."""
    assert exact_fraction(sp.Float(0.1)) == Fraction(0.1) != Fraction(1, 10)


# -- stability -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("n", "m", "symbolic"),
    rest_slow(
        [
            (*size, kind)
            for size in ((2, 1), (3, 1), (3, 2), (4, 2), (5, 2), (5, 3))
            for kind in (False, True)
        ],
        (2, 1, False),
        (3, 2, True),
    ),
)
def test_hurwitz_agrees_with_the_pencil(n: int, m: int, symbolic: bool) -> None:
    """Exact verdict and margin equal those of the pencil's finite eigenvalues."""
    mechanism = linear_mechanism(n, m, seed=10 * n + m, symbolic=symbolic)
    rng = np.random.default_rng(n + m)
    seen = set()
    surfaces = [ut.first_surface(mechanism, rate=rate) for rate in (0.0, 0.5)]
    for _ in range(5):
        surfaces.append(ut.Surface.from_vector(rng.normal(size=2 * m * n), n, m))
    for surface in surfaces:
        margin = pencil_margin(mechanism, surface)
        if abs(margin) < 1e-6:
            continue
        verdict = hurwitz(mechanism, surface)
        assert verdict.kind == ("proved" if margin > 0 else "refuted")
        seen.add(verdict.kind)
        if verdict:
            assert verdict.margin == pytest.approx(margin, rel=1e-4)
            assert verdict.margin <= margin * (1 + 1e-9)
    assert "proved" in seen


def closed_forms_hold(mechanism: ut.Mechanism, surface: ut.Surface) -> bool:
    """(35)-(37) at φ = 0 in their general form, for any mechanism with (n, m) = (2, 1).

    The characteristic polynomial a₃s³ + a₂s² + a₁s + a₀ of the sliding dynamics has these
    coefficients, and is Hurwitz iff a₂/a₃ > 0, a₀/a₃ > 0 and a₂a₁ > a₃a₀ (in units of a₃).
    """
    model = linearise(mechanism)
    M_a, M_u = model.M[1]
    (F_a, F_u), (D_a, D_u) = model.F[1], model.D[1]
    alpha_a, lambda_a, alpha_u, lambda_u = surface.vector
    a3 = alpha_a * M_u - alpha_u * M_a
    a2 = lambda_a * M_u - lambda_u * M_a - alpha_a * D_u + alpha_u * D_a
    a1 = -alpha_a * F_u + alpha_u * F_a - lambda_a * D_u + lambda_u * D_a
    a0 = -lambda_a * F_u + lambda_u * F_a
    return bool(a2 / a3 > 0 and a0 / a3 > 0 and a2 * a1 > a3 * a0)


def test_closed_forms_hold_iff_the_hurwitz_test_does() -> None:
    """(35)-(37) at φ = 0 in their general form: no mismatch on random surfaces."""
    rng = np.random.default_rng(5)
    for mechanism in (RIG, linear_mechanism(2, 1, 3)):
        kinds = []
        first = ut.first_surface(mechanism).vector
        for _ in range(24):
            surface = ut.Surface.from_vector(first * (1 + 0.8 * rng.normal(size=4)), 2, 1)
            whole = hurwitz(mechanism, surface).kind
            parts = closed_forms_hold(mechanism, surface)
            assert parts == (whole == "proved")
            kinds.append(whole)
        assert {"proved", "refuted"} <= set(kinds)


def test_the_proved_rate_is_tight() -> None:
    """The margin is the slowest eigenvalue to 1e-9, never above it."""
    verdict = hurwitz(RIG, BASE)
    exact = float(stability_margin(RIG, BASE))
    assert exact * (1 - 1e-9) <= verdict.margin <= exact
    assert verdict.details["critical mode"]["theta"] == 1.0


def test_stability_boundary_is_decided_exactly() -> None:
    """One float beyond the limit of (36), exactly hit with λ_u/α_u = −λ_a, is refuted."""
    # λ_a/α_a = λ_u/α_u makes a₂a₁ = a₃a₀ exactly: an undamped pair.
    assert hurwitz(RIG, ut.Surface(-1, -2.0, 4.0, 8.0)).kind == "refuted"
    above = math.nextafter(8.0, 9.0)
    assert hurwitz(RIG, ut.Surface(-1, -2.0, 4.0, above)).kind == "proved"


def test_repeated_zero_eigenvalue_is_refuted() -> None:
    """λ_a = 0 with two cyclic inputs: a double zero, which no tolerance may pass."""
    n, m = 4, 2
    q = [ut.Coordinate(f"q{i}") for i in range(n)]
    M = sp.eye(n) * 2 + sp.Matrix(n, n, lambda i, j: sp.Rational(1, 2 + i + j))
    force = sp.Matrix([0, 0, 3 * q[2].symbol, 2 * q[3].symbol])
    mechanism = ut.Mechanism(
        "cyclic", tuple(q), (ut.Input("u0", "N m"), ut.Input("u1", "N m")),
        sp.ImmutableDenseMatrix(M), sp.ImmutableDenseMatrix(force),
    )  # fmt: skip
    good = ut.first_surface(mechanism)
    assert hurwitz(mechanism, good)
    flat = ut.Surface(good.alpha_a, np.zeros((m, m)), good.alpha_u, good.lambda_u)
    eigenvalues = np.linalg.eigvals(sliding_matrix(mechanism, flat))
    assert np.sum(np.abs(eigenvalues) < 1e-9) == 2
    verdict = hurwitz(mechanism, flat)
    assert verdict.kind == "refuted"
    assert verdict.margin <= 0


def test_a_surface_without_sliding_dynamics_is_refuted() -> None:
    """Det E = 0 at the target: nothing to be stable, and no law of which anything is proved."""
    mechanism = linear_mechanism(2, 1, 3)
    # Exactly singular: α_u = α_a M_uu/M_au with powers of two.
    simple = ut.Mechanism(
        "simple", mechanism.coordinates, mechanism.inputs,
        sp.ImmutableDenseMatrix([[4, 1], [1, 2]]), mechanism.force,
    )  # fmt: skip
    none, other = ut.Surface(1, 1, 2, 1), ut.Surface(1, 1, 1, 1)
    assert hurwitz(simple, none).kind == "refuted"
    assert hurwitz(simple, none).margin < 0
    point = {"q0": (Fraction(0), Fraction(0))}
    claims = (
        Nonsingular(point, Fraction(1, 10)),
        Reaching(point, (Fraction(0),) * 2, (Fraction(0),)),
    )
    model = model_of(simple)
    for claim in claims:
        assert decide(model, law_of(simple, other, ReachingLaw()), claim).kind == "proved"
        found = decide(model, law_of(simple, none, ReachingLaw()), claim)
        assert found.kind == "undecided"
        assert "det Γ may be 0 at the target" in found.why


# -- non-singularity -----------------------------------------------------------------------

CASES = [
    (BASE, 1.3615),
    (ut.Surface(-1, -0.248, 1.94, 11.14), 1.0058),
    (ut.Surface(-1, -0.1, 2.46, 15.25), 1.1348),
    (ut.Surface(-1, -1.59, 1.96, 12.1), 1.0122),
    (ut.Surface(-1, -2.4, 1.49, 9.66), 0.7994),
]


@pytest.mark.parametrize(("surface", "angle"), CASES)
def test_singular_angle_is_arccos_epsilon(surface: ut.Surface, angle: float) -> None:
    """Proved up to arccos(ε) and refuted beyond: tight to 1e-6, (37)."""
    M = RIG.M([0.0, 0.0])
    epsilon = M[1, 1] / (float(surface.alpha_u[0, 0]) * -M[0, 1])
    proved, refuted = singular_distance(RIG, surface, {"phi": (-1.0, 1.0)})
    assert proved < math.acos(epsilon) < refuted
    assert refuted - proved < 2e-6
    assert proved == pytest.approx(angle, abs=1e-4)


def test_a_law_that_exists_everywhere_does() -> None:
    """Ball and beam: Γ does not depend on the position, and is a whole number."""
    rig = ut.mechanisms.ball_and_beam()
    surface = ut.Surface(1, 2, 3, 4)
    for region in ({}, {"r": (-0.5, 0.5)}):
        verdict = nonsingular(rig, surface, region)
        assert verdict
        assert verdict.margin == pytest.approx(1.0, abs=1e-12)
    assert reaching(rig, surface, {}).verdict


def test_a_stable_surface_whose_region_holds_the_singularity_is_refuted() -> None:
    """Locally stable, but the region crosses arccos ε; the witness is on the far side."""
    assert hurwitz(RIG, BASE)
    region = {"theta": (-1.0, 1.0), "phi": (-0.2, 1.37)}
    verdict = nonsingular(RIG, BASE, region)
    assert verdict.kind == "refuted"
    at = [verdict.witness["theta"], verdict.witness["phi"]]
    assert (
        singularity(RIG, BASE.vector, np.array(at)) * singularity(RIG, BASE.vector, np.zeros(2)) < 0
    )
    assert nonsingular(RIG, BASE, {"theta": (-1.0, 1.0), "phi": (-0.2, 1.36)})


@pytest.mark.slow
def test_proved_margins_bound_random_samples() -> None:
    """Two inputs: the ratio is below every sample and near the least."""
    mechanism = two_arm()
    surface = ut.first_surface(mechanism)
    box = {"b": (-0.3, 0.4), "c": (-0.3, 0.3), "d": (-0.3, 0.3)}
    proved, refuted = singular_distance(mechanism, surface, box, tolerance=0.05)
    assert nonsingular(mechanism, surface, _scaled(box, 1.01 * refuted)).kind == "refuted"
    region = _scaled(box, 0.6 * proved)
    verdict = nonsingular(mechanism, surface, region)
    assert verdict.kind == "proved"
    rng = np.random.default_rng(0)
    low, high = np.array([(0.0, 0.0), *region.values()]).T
    q = np.vstack(
        [rng.uniform(low, high, (5000, 4)), np.where(rng.random((5000, 4)) < 0.5, low, high)]
    )
    ratio = singularity(mechanism, surface.vector, q) / singularity(
        mechanism, surface.vector, np.zeros(4)
    )
    assert verdict.margin <= ratio.min()
    assert verdict.margin == pytest.approx(ratio.min(), rel=0.05)


def _scaled(box: dict[str, tuple[float, float]], factor: float) -> dict[str, tuple[float, float]]:
    return {k: (a * factor, b * factor) for k, (a, b) in box.items()}


def two_arm() -> ut.Mechanism:
    """Two driven joints and two free links, inertias that depend on position."""
    names = ["a", "b", "c", "d"]
    q = [ut.Coordinate(name) for name in names]
    _, b, c, d = (k.symbol for k in q)
    M = sp.Matrix(
        [
            [3, 0, sp.cos(c) / 2, sp.cos(d) / 3],
            [0, 2, sp.cos(c - b) / 2, sp.cos(d) / 4],
            [sp.cos(c) / 2, sp.cos(c - b) / 2, 1, sp.cos(c - d) / 5],
            [sp.cos(d) / 3, sp.cos(d) / 4, sp.cos(c - d) / 5, 1],
        ]
    )
    force = sp.Matrix([0, 0, 6 * sp.sin(c), 9 * sp.sin(d)])
    return ut.Mechanism(
        "two arm", tuple(q), (ut.Input("u0", "N m", 20.0), ut.Input("u1", "N m", 20.0)),
        sp.ImmutableDenseMatrix(M), sp.ImmutableDenseMatrix(force),
    )  # fmt: skip


def test_effort_runs_out_honestly() -> None:
    """Right at the singularity the method gives up, says so and where, and proves nothing."""
    M = RIG.M([0.0, 0.0])
    angle = math.acos(M[1, 1] / (5 * -M[0, 1]))
    verdict = nonsingular(RIG, BASE, {"phi": (0.0, angle * (1 - 1e-15))}, max_boxes=40)
    assert verdict.kind in ("undecided", "refuted")
    assert not verdict
    assert verdict.witness["phi"] == pytest.approx(angle, abs=1e-2)


def test_regions_must_hold_the_target() -> None:
    """Unknown names and regions without the target are refused."""
    for region in ({"psi": (-1.0, 1.0)}, {"phi": (0.1, 0.2)}, {"phi": (-math.inf, 1.0)}):
        with pytest.raises(InvalidInputError, match="region"):
            nonsingular(RIG, BASE, region)


# -- reaching ------------------------------------------------------------------------------

REGION = {"phi": (-0.8, 0.8)}


@cache
def carried() -> ReachingCertificate:
    """What K = 20 carries there."""
    return reaching(RIG, BASE, REGION, 20.0)


def surface_rate(
    mechanism: ut.Mechanism, surface: ut.Surface, q: np.ndarray, g: np.ndarray
) -> np.ndarray:
    """ṡ + K sign(s) for a disturbance g: from the plant's own equations, (m,)."""
    m = mechanism.m
    law = SlidingModeLaw(mechanism, surface, ReachingLaw(eta=1.0))
    x = np.concatenate([q, np.zeros(mechanism.n)])
    # At this velocity s = 0 (inside the layer nothing pushes), so ṡ is all disturbance.
    x[mechanism.n : mechanism.n + m] = np.linalg.solve(surface.alpha_a, -surface.position_row @ q)
    u = law(0.0, x).demand
    plant = mechanism.disturbed(
        dict(zip([c.name for c in mechanism.coordinates], g.tolist(), strict=True))
    )
    return np.asarray(
        surface.velocity_row @ plant.accelerations(0.0, x, u)
        + surface.position_row @ x[mechanism.n :]
    )


@pytest.mark.parametrize("coordinate", [0, 1])
def test_largest_disturbance_is_tight_against_the_plant(coordinate: int) -> None:
    """At the witness the refuted disturbance beats K = 20, the proved one does not."""
    found = carried().largest[coordinate]
    assert found.proved <= found.refuted <= found.proved * 1.002
    assert found.unit == "N m"
    q = np.array(list(found.witness.values()))
    g = np.zeros(2)
    g[coordinate] = found.refuted
    assert 20.0 <= abs(surface_rate(RIG, BASE, q, g)[0]) <= 20.0 * 1.002
    rng = np.random.default_rng(0)
    for phi in rng.uniform(-0.8, 0.8, 12):
        g[coordinate] = found.proved
        assert abs(surface_rate(RIG, BASE, np.array([0.3, phi]), g)[0]) <= 20.0


def test_matched_disturbance_in_volts() -> None:
    """The matched bound, as a voltage: torque over the motor's constant."""
    matched, unmatched = carried().largest
    assert matched.as_input == pytest.approx(matched.proved / 0.1285)
    assert matched.input_unit == "V"
    assert math.isnan(unmatched.as_input)


def test_a_gain_too_small_for_the_disturbance_is_refuted() -> None:
    """K = 20 carries 0.02 N m on the arm with η = 4 left, but not with η = 6."""
    loaded = RIG.with_disturbance_bounds(0.02, 0.0)
    assert reaching(loaded, BASE, REGION, 20.0, eta=4.0).verdict
    found = reaching(loaded, BASE, REGION, 20.0, eta=6.0)
    assert found.verdict.kind == "refuted"
    assert found.verdict.margin < 0
    assert found.scale == 0.0


def test_a_stated_disturbance_that_k_does_not_carry_is_refused_in_engineering_units() -> None:
    """0.3 N m on the arm, 2.3 V at the input, against K = 20: s grows in the plant itself."""
    stated = [0.3, 0.0]
    found = reaching(RIG, BASE, REGION, 20.0, disturbance=stated)
    assert found.verdict.kind == "refuted"
    assert found.scale == 0.0
    assert "theta: 0.3 N m" in found.verdict.claim
    alone = found.largest[0]
    assert alone.refuted < 0.3
    for words in (f"{alone.proved:.4g} N m", f"{alone.as_input:.4g} V", "falls short by"):
        assert words in found.verdict.method
    q = np.array(list(found.verdict.witness.values()))
    excess = abs(surface_rate(RIG, BASE, q, np.array(stated))[0]) - 20.0
    assert excess == pytest.approx(-found.verdict.margin, rel=2e-3)
    assert excess > 0
    enough = 20.0 - found.verdict.margin
    assert reaching(RIG, BASE, REGION, 1.001 * enough, disturbance=stated).verdict


def test_the_laws_own_gains_always_suffice() -> None:
    """Gains (13) for declared bounds leave η: proved, with room (they use norms)."""
    loaded = RIG.with_disturbance_bounds(0.05, 0.005)
    certificate = reaching(loaded, BASE, REGION, ReachingLaw(eta=20.0), eta=20.0)
    assert certificate.verdict
    assert 1.0 <= certificate.scale < 3.0
    grown = [certificate.scale * 1.01 * b for b in loaded.disturbance_bounds]
    again = reaching(loaded, BASE, REGION, ReachingLaw(eta=20.0), eta=20.0, disturbance=grown)
    assert again.verdict.kind == "refuted"


@pytest.mark.slow
def test_reaching_with_two_inputs() -> None:
    """m = 2: the bound holds for the plant at random positions, every surface."""
    mechanism = two_arm()
    surface = ut.first_surface(mechanism)
    region = {"c": (-0.3, 0.3), "d": (-0.3, 0.3)}
    found = reaching(mechanism, surface, region, [5.0, 8.0], tolerance=0.02)
    rng = np.random.default_rng(2)
    closest = 0.0
    for j, bound in enumerate(found.largest):
        assert 0 < bound.proved <= bound.refuted
        g = np.zeros(4)
        g[j] = bound.proved
        for c, d in rng.uniform(-0.3, 0.3, (10, 2)):
            load = np.abs(surface_rate(mechanism, surface, np.array([0, 0, c, d]), g))
            assert (load <= [5.0, 8.0]).all()
            closest = max(closest, float((load / [5.0, 8.0]).max()))
    assert closest > 0.9


def test_verdicts_read_well() -> None:
    """One line: kind, claim, margin with unit, and the witness of a refutation."""
    verdict = Verdict("K suffices", "refuted", -1.5, "1/s", {"phi": 0.25})
    assert str(verdict) == "refuted: K suffices (margin -1.5 1/s) at phi = 0.25"
    assert not verdict
