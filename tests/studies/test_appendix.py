"""The paper's appendix: the corrected system, the exact test, and which claims hold."""

from __future__ import annotations

import math
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

import undertow as ut
from undertow.base import InvalidInputError
from undertow.law import SlidingModeLaw
from undertow.proofs import hurwitz
from undertow.studies.paper.appendix import (
    CASES,
    PRINTED,
    Constants,
    Lyapunov,
    Reduced,
    decay_rate,
    false_bound,
    largest_interval,
    paper_rate,
    two_vertex,
)
from undertow.studies.paper.appendix_report import _rows, figures, report
from undertow.studies.paper.appendix_search import search_interval, search_rate

pytest.importorskip("flint", reason="the appendix's cases take the extra undertow[appendix]")
pytest.importorskip("clarabel", reason="the search is the extra undertow[appendix]")

RIG = ut.mechanisms.rotary_pendulum()
REAL = Constants.of(RIG)
NUMBERED = pytest.mark.parametrize("case", CASES, ids=lambda c: f"case {c.number}")


def to_state(reduced: Reduced, y: np.ndarray) -> np.ndarray:
    """x = (θ, φ, θ̇, φ̇) on the surface for y = (φ, φ̇, θ + (λ_u/λ_a) φ)."""
    ratio = float(reduced.lambda_u / reduced.lambda_a)
    n = reduced.numbers
    return np.array([y[2] - ratio * y[0], y[0], -n["r"] * y[1] - n["k"] * y[2], y[1]])


def mechanism_rate(reduced: Reduced, surface: ut.Surface, y: np.ndarray) -> np.ndarray:
    """ẏ from the mechanism under the law, unsaturated, on the surface."""
    x = to_state(reduced, y)
    assert abs(surface.s(x)[0]) < 1e-9
    accelerations = RIG.accelerations(0.0, x, SlidingModeLaw(RIG, surface)(0.0, x).demand)
    ratio = float(reduced.lambda_u / reduced.lambda_a)
    return np.array([x[3], accelerations[1], x[2] + ratio * x[3]])


def field(reduced: Reduced, y: np.ndarray) -> np.ndarray:
    """(A14)-(A16) as corrected."""
    n = reduced.numbers
    xi = 1 / (1 - n["epsilon"] / math.cos(y[0]))
    theta_dot = -n["r"] * y[1] - n["k"] * y[2]
    bracket = (
        n["drag"] * y[1]
        + n["pull"] * y[2]
        - n["g"] * math.tan(y[0])
        - n["epsilon"] * math.sin(y[0]) * theta_dot**2
    )
    return np.array([y[1], xi * bracket, -n["alpha"] * y[1] - n["k"] * y[2]])


def lyapunov(reduced: Reduced, P: Lyapunov, y: np.ndarray) -> float:
    """V of (A17)."""
    epsilon = float(reduced.epsilon)
    barrier = math.log((math.cos(y[0]) - epsilon) / (1 - epsilon))
    matrix = np.array(P.matrix(), dtype=float)
    return float(0.5 * y @ matrix @ y - float(P.p22 * reduced.g) * barrier)


def random_points(reduced: Reduced, count: int) -> np.ndarray:
    rng = np.random.default_rng(7)
    return rng.uniform(-1, 1, (count, 3)) * (0.9 * reduced.limit, 5.0, 3.0)


# -- the equations -------------------------------------------------------------------------


@NUMBERED
def test_reduced_system_is_the_mechanism_on_its_surface_a14_a16(case) -> None:  # type: ignore[no-untyped-def]
    """(A14)-(A16) with λ_a/α_a and c equal the mechanism's own motion on s = 0."""
    reduced = case.reduced(REAL)
    for y in random_points(reduced, 20):
        expected = mechanism_rate(reduced, case.surface, y)
        assert field(reduced, y) == pytest.approx(expected, rel=1e-7, abs=1e-7)


@NUMBERED
def test_derivative_of_v_a20_is_corrected_by_two_terms(case) -> None:  # type: ignore[no-untyped-def]
    """V̇ = −½yᵀRy − p₁₂ gξ y₁(tan y₁ − y₁) − ξε sin y₁ θ̇²(p₁₂y₁ + p₂₂y₂), by differences."""
    reduced = case.reduced(REAL)
    n = reduced.numbers
    for y in random_points(reduced, 20):
        h = 1e-6 / (1 + np.abs(field(reduced, y)).max())
        forward, back = (y + sign * h * field(reduced, y) for sign in (1, -1))
        slope = (lyapunov(reduced, case.P, forward) - lyapunov(reduced, case.P, back)) / (2 * h)
        found = false_bound(reduced, case.P, y)
        assert found.details["V̇"] == pytest.approx(slope, rel=1e-4, abs=1e-2)
        xi = 1 / (1 - n["epsilon"] / math.cos(y[0]))
        theta_dot = -n["r"] * y[1] - n["k"] * y[2]
        p12, p22 = float(case.P.p12), float(case.P.p22)
        rest = p12 * n["g"] * xi * y[0] * (math.tan(y[0]) - y[0]) + xi * n["epsilon"] * math.sin(
            y[0]
        ) * theta_dot**2 * (p12 * y[0] + p22 * y[1])
        assert found.margin == pytest.approx(rest, rel=1e-9, abs=1e-9)


def test_constants_come_from_the_mechanism() -> None:
    """b = m l r_o, c = (4/3) m l² (not ½), d = m g l."""
    assert [float(v) for v in REAL] == pytest.approx([0.0045016, 0.0046760, 0.20540], rel=1e-4)


@NUMBERED
def test_printed_epsilon_and_beta_need_b_0_0033(case) -> None:  # type: ignore[no-untyped-def]
    """ε and β follow from b = 0.0033, except ε of case 3, which forgets c/b."""
    reduced = case.reduced(PRINTED)
    printed = float(case.epsilon)
    if case.number == 3:
        assert printed == pytest.approx(float(1 / case.alpha_u), abs=5e-5)
        assert float(reduced.epsilon) == pytest.approx(0.576, abs=5e-4)
    else:
        assert printed == pytest.approx(float(reduced.epsilon), abs=1e-3)
    assert float(case.P.p22 * reduced.g) == pytest.approx(float(case.beta), rel=1e-3)
    assert abs(float(case.reduced(REAL).epsilon) - printed) > 0.01


# -- the exact test ------------------------------------------------------------------------


@NUMBERED
@pytest.mark.parametrize("constants", [PRINTED, REAL], ids=["b=0.0033", "b=0.0045"])
def test_two_vertex_test_agrees_with_a_grid(case, constants: Constants) -> None:  # type: ignore[no-untyped-def]
    """The margin is the infimum of λ_min(R) over a fine grid, and the verdict its sign."""
    reduced = case.reduced(constants)
    y1 = np.linspace(0, float(case.half_width), 2001)
    lowest = reduced.R_curve(case.P, y1).min()
    verdict = two_vertex(reduced, case.P, case.half_width)
    assert verdict.kind == ("proved" if lowest > 0 else "refuted")
    assert verdict.margin == pytest.approx(lowest, rel=1e-4)


def test_printed_claims_with_b_0_0033() -> None:
    """Cases 1-4 hold with the theory's margins; case 5 fails on ±0.22, holds on ±0.2157."""
    margins = [two_vertex(c.reduced(PRINTED), c.P, c.half_width) for c in CASES]
    assert [v.kind for v in margins] == ["proved"] * 4 + ["refuted"]
    assert [v.margin for v in margins[:4]] == pytest.approx(
        [0.0099, 0.0015, 0.0015, 0.054], rel=0.05
    )
    last = CASES[4]
    assert two_vertex(last.reduced(PRINTED), last.P, Fraction("0.2157"))
    assert not two_vertex(last.reduced(PRINTED), last.P, Fraction("0.2158"))


def test_printed_claims_with_b_0_0045() -> None:
    """Cases 2, 3, 4 hold, even to 0.99, 1.13, 0.86; 1 and 5 do not, not even at 0."""
    kinds = [two_vertex(c.reduced(REAL), c.P, c.half_width).kind for c in CASES]
    assert kinds == ["refuted", "proved", "proved", "proved", "refuted"]
    widths = [largest_interval(c.reduced(REAL), c.P) for c in CASES]
    assert [w[0] for w in widths] == pytest.approx([0, 0.993, 1.131, 0.856, 0], abs=1e-3)
    for case in (CASES[0], CASES[4]):
        assert two_vertex(case.reduced(REAL), case.P, 0.0).kind == "refuted"


def test_c_as_printed_breaks_four_of_five_claims() -> None:
    """With c = 0.0047, rounded as the appendix prints it, cases 2-5 fail on their Ĩ."""
    literal = PRINTED._replace(c=Fraction("0.0047"))
    kinds = [two_vertex(c.reduced(literal), c.P, c.half_width).kind for c in CASES]
    assert kinds == ["proved"] + ["refuted"] * 4


def test_the_interval_is_tight() -> None:
    """Proved just inside, refuted with a direction just outside."""
    case = CASES[1]
    reduced = case.reduced(REAL)
    proved, refuted = largest_interval(reduced, case.P)
    assert 0 < refuted - proved < 1e-8
    assert two_vertex(reduced, case.P, proved)
    outside = two_vertex(reduced, case.P, refuted + 1e-6)
    assert outside.kind == "refuted"
    v = np.array([outside.witness[f"direction {i}"] for i in (1, 2, 3)])
    xi = 1 / (1 - float(reduced.epsilon) / math.cos(outside.witness["y1"]))
    R0, R1 = (np.array(m, dtype=float) for m in reduced.R(case.P))
    assert v @ (R0 + xi * R1) @ v <= 0


def test_an_interval_past_the_singularity_is_refuted() -> None:
    """R does not exist where cos y₁ ≤ ε, whatever P."""
    case = CASES[1]
    reduced = case.reduced(REAL)
    assert two_vertex(reduced, case.P, reduced.limit + 1e-9).kind == "refuted"


def test_a_p_that_is_not_positive_is_refuted() -> None:
    """R ≻ 0 alone is no proof."""
    case = CASES[1]
    bad = case.P._replace(p33=Fraction(-1))
    assert two_vertex(case.reduced(REAL), bad, 0.1).kind == "refuted"


def test_the_appendix_needs_epsilon_below_one() -> None:
    """A surface that is singular at the target has no interval at all."""
    with pytest.raises(InvalidInputError, match="ε"):
        Reduced(Fraction(-1), Fraction(-1), Fraction(1), Fraction(5), REAL)


# -- rates and the false bound -------------------------------------------------------------


def test_printed_sigma_uses_the_wrong_matrix_a27() -> None:
    """With λ_max(P̃): 3.5e-5, 1.9e-6, 4.5e-7, 1.3e-4 and none, b = 0.0033."""
    rates = [paper_rate(c.reduced(PRINTED), c.P, c.half_width) for c in CASES]
    assert [r.margin for r in rates[:4]] == pytest.approx(
        [3.5e-5, 1.9e-6, 4.5e-7, 1.3e-4], rel=0.05
    )
    assert rates[4].kind == "refuted"


@NUMBERED
def test_the_argument_of_a20_fails_inside_its_own_domain(case) -> None:  # type: ignore[no-untyped-def]
    """In every case a point of D̃ has V̇ > 0 where (A20) claims a negative bound."""
    verdict = report(case, REAL).false_bound
    assert verdict.kind == "refuted"
    assert abs(verdict.witness["y1"]) < float(case.half_width)
    assert verdict.details["V̇"] > 0 > verdict.details["claimed bound"]


def test_known_counterexamples_to_a20() -> None:
    """The theory's two, b = 0.0033: +1584 against −53, +206 against −884."""
    first = false_bound(CASES[0].reduced(PRINTED), CASES[0].P, (-0.3, 5, 0)).details
    fourth = false_bound(CASES[3].reduced(PRINTED), CASES[3].P, (-0.3, 6, 0)).details
    assert [*first.values()] == pytest.approx([1584, -53], rel=0.01)
    assert [*fourth.values()] == pytest.approx([206, -884], rel=0.01)


RATES = {"b=0.0033": (0.85, 0.48, 0.194, 3.14, 4.74)}


@NUMBERED
def test_our_p_holds_where_the_printed_one_does_not(case) -> None:  # type: ignore[no-untyped-def]
    """b = 0.0045: all five proved on the printed Ĩ and on 99.7 % of (−arccos ε, arccos ε)."""
    reduced = case.reduced(REAL)
    P, verdict = search_rate(reduced, case.half_width)
    assert verdict.kind == "proved"
    assert two_vertex(reduced, P, case.half_width)
    assert 0.5 * reduced.slowest_rate < verdict.margin <= 2 * reduced.slowest_rate
    width, wide, proof = search_interval(reduced)
    assert proof
    assert two_vertex(reduced, wide, width)
    assert width > 0.997 * reduced.limit - 1e-4


@NUMBERED
def test_rates_reached_with_b_0_0033(case) -> None:  # type: ignore[no-untyped-def]
    """The best two-vertex rate on the printed Ĩ: 0.85, 0.48, 0.194, 3.14, 4.74 1/s."""
    reduced = case.reduced(PRINTED)
    _, verdict = search_rate(reduced, case.half_width)
    assert verdict.margin == pytest.approx(RATES["b=0.0033"][case.number - 1], rel=0.01)


def test_the_proved_rate_bounds_the_quadratic_part() -> None:
    """σ P̃ ⪯ R on a grid, and 0.1 % more is too much somewhere: sound and tight."""
    case = CASES[3]
    reduced = case.reduced(REAL)
    P, verdict = search_rate(reduced, case.half_width)
    R0, R1 = (np.array(m, dtype=float) for m in reduced.R(P))
    epsilon, width = float(reduced.epsilon), float(case.half_width)
    barrier = -math.log((math.cos(width) - epsilon) / (1 - epsilon))
    full = np.array(P.matrix(), dtype=float)
    full[0, 0] += 2 * float(P.p22 * reduced.g) * barrier / width**2
    gaps = []
    for y1 in np.linspace(0, width, 101):
        R = R0 + R1 / (1 - epsilon / math.cos(y1))
        assert np.linalg.eigvalsh(R - verdict.margin * full)[0] > 0
        gaps.append(np.linalg.eigvalsh(R - 1.001 * verdict.margin * full)[0])
    assert min(gaps) < 0
    assert decay_rate(reduced, P, case.half_width).margin == verdict.margin


def test_the_slowest_rate_is_the_exact_one() -> None:
    """The reduced system's linearisation has the sliding dynamics' eigenvalues."""
    for case in CASES:
        assert case.reduced(REAL).slowest_rate == pytest.approx(
            hurwitz(RIG, case.surface).margin, rel=1e-9
        )


# -- what people read ----------------------------------------------------------------------


def test_the_page_shows_what_the_command_computes() -> None:
    """``docs/appendix.md`` carries the rows of the printed P as the code decides them now."""
    page = (Path(__file__).parents[2] / "docs" / "appendix.md").read_text(encoding="utf-8")
    for constants in (PRINTED, REAL):
        for row in _rows([report(case, constants) for case in CASES]):
            assert row in page


def test_figures_7_to_11_are_drawn() -> None:
    """One picture per case, with λ_min of R for the printed P before and after, and for ours."""
    drawn = figures()
    assert list(drawn) == [f"figure-{i}-appendix" for i in range(7, 12)]
    for case, figure in zip(CASES, drawn.values(), strict=True):
        _, after, ours, _ = figure.axes[0].get_lines()
        y1 = np.asarray(after.get_xdata())
        curve = case.reduced(REAL).R_curve(case.P, y1)
        np.testing.assert_array_equal(np.asarray(after.get_ydata()), curve)
        assert np.asarray(ours.get_ydata()).min() > 0  # ours holds on the printed interval
