"""The formulas that people read are the ones that run."""

from __future__ import annotations

import re
from functools import cache, partial

import numpy as np
import pytest
import sympy as sp
from matplotlib.mathtext import MathTextParser
from typer.testing import CliRunner

import undertow as ut
from agreements import named
from support import rest_slow
from undertow.cli import app
from undertow.display.derivation import (
    Derivation,
    derivation,
    hurwitz_minors,
    polynomial_matrix,
)
from undertow.law import sliding_matrix, stability_margin
from undertow.law.sliding import singularity
from undertow.mechanisms import LIBRARY
from undertow.symbolic.formulas import plain, readable, tex

#: A pendulum, four coordinates and two motors; the others are tried by the slow suite.
QUICK = {"rotary_pendulum", "gantry_crane"}
NAMES = [
    name if name in QUICK else pytest.param(name, marks=pytest.mark.slow)
    for name in sorted(LIBRARY)
]
SIGMA = sp.Symbol("sigma", real=True)


@cache
def shown(name: str) -> Derivation:
    return derivation(LIBRARY[name]())


def numeric(formulas: Derivation, surface: ut.Surface, x: np.ndarray) -> dict[sp.Symbol, float]:
    """Values of all symbols that a state, a surface and the parameters fix."""
    m = formulas.mechanism
    values = m.substitution | dict(zip(m.x, x.tolist(), strict=True))
    unit = surface.normalised()
    rows, free = m.m, m.n - m.m
    for name, count in (("lambda_a", rows), ("alpha_u", free), ("lambda_u", free)):
        block = getattr(unit, name)
        for i in range(rows):
            for j in range(count):
                index = (
                    "" if rows == count == 1 else f"_{j + 1}" if rows == 1 else f"_{i + 1}{j + 1}"
                )
                values[sp.Symbol(f"{name}{index}", real=True)] = float(block[i, j])
    for title in ("Mass", "Forces", "Inputs"):
        for e in formulas[title].equations:
            values[e.left] = float(e.right.subs(values))
    return values


@pytest.mark.parametrize("name", NAMES)
def test_mass_and_forces_as_shown_are_those_that_run(name: str) -> None:
    """Claim: every entry of M, f and B as printed equals the mechanism's, at a random state."""
    formulas = shown(name)
    m = formulas.mechanism
    x = np.random.default_rng(1).uniform(-1, 1, 2 * m.n)
    values = m.substitution | dict(zip(m.x, x.tolist(), strict=True))
    M = [float(e.right.subs(values)) for e in formulas["Mass"].equations]
    np.testing.assert_allclose(M, m.M(x[: m.n])[np.triu_indices(m.n)], rtol=1e-12, atol=1e-15)
    f = [float(e.right.subs(values)) for e in formulas["Forces"].equations]
    np.testing.assert_allclose(f, m.f(x), rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("name", NAMES)
def test_law_as_shown_is_the_law(name: str) -> None:
    """Claim: solving the equations of the law as printed gives the law's demand."""
    formulas = shown(name)
    m = formulas.mechanism
    surface, reaching = ut.first_surface(m).normalised(), ut.ReachingLaw(3.0, 0.5)
    x = np.random.default_rng(2).uniform(-0.02, 0.02, 2 * m.n)
    values = numeric(formulas, surface, x)
    for e in formulas["Sliding"].equations:
        values[e.left] = float(e.right.subs(values))
    for i in range(m.m):
        index = "" if m.m == 1 else f"_{i + 1}"
        values[sp.Symbol(f"eta{index}", real=True)] = 3.0
        values[sp.Symbol(f"epsilon{index}", real=True)] = 0.5
    control = ut.SlidingModeLaw(m, surface, reaching)(0.0, x)
    np.testing.assert_allclose(
        [values[e.left] for e in formulas["Sliding"].equations], control.s, rtol=1e-10
    )
    sat = sp.Function("sat")
    unknown = [*(sp.Symbol(f"{c.name}_ddot", real=True) for c in m.coordinates), *m.u]
    equations = [
        (e.left - e.right).subs(values).replace(sat, lambda r: max(-1, min(1, r)))
        for e in formulas["Law"].equations
    ]
    A, b = sp.linear_eq_to_matrix(equations, unknown)
    solution, *_ = np.linalg.lstsq(
        np.array(A, dtype=float), np.array(b, dtype=float).ravel(), rcond=None
    )
    np.testing.assert_allclose(solution[m.n :], control.demand, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_existence_as_shown_is_the_singularity(name: str) -> None:
    """Claim: det E as printed is proportional to det Γ det M_uu, at a random position."""
    formulas = shown(name)
    m = formulas.mechanism
    surface = ut.first_surface(m).normalised()
    for seed in (3, 4):
        x = np.random.default_rng(seed).uniform(-0.6, 0.6, 2 * m.n)
        values = numeric(formulas, surface, x)
        *entries, whole = formulas["Existence"].equations
        values |= {e.left: float(e.right.subs(values)) for e in entries}
        M_uu = m.M(x[: m.n])[m.m :, m.m :]
        gamma = float(singularity(m, surface.vector, x[: m.n]))
        expected = gamma * (-1) ** m.m * np.linalg.det(M_uu)
        assert float(whole.left.subs(values)) == pytest.approx(expected, rel=1e-8)


@pytest.mark.parametrize("name", NAMES)
def test_roots_of_the_polynomial_are_the_sliding_eigenvalues(name: str) -> None:
    """Claim: det P(σ) has the eigenvalues of the sliding dynamics as its roots."""
    formulas = shown(name)
    m = formulas.mechanism
    surface = ut.first_surface(m).normalised()
    values = numeric(formulas, surface, np.zeros(2 * m.n))
    P = polynomial_matrix(m, symbolic=False).subs(values)
    poles = np.linalg.eigvals(sliding_matrix(m, surface))
    determinant = sp.lambdify(SIGMA, P.det(method="berkowitz"), "numpy")
    scale = abs(determinant(10j * np.abs(poles).max()))
    assert np.abs(determinant(poles)).max() < 1e-7 * scale


@pytest.mark.parametrize(
    "name",
    rest_slow(["rotary_pendulum", "double_pendulum_on_a_cart"], "rotary_pendulum"),
)
def test_conditions_as_shown_decide_stability(name: str) -> None:
    """Claim: the printed inequalities hold exactly where the exact margin is positive."""
    formulas = shown(name)
    m = formulas.mechanism
    base = ut.first_surface(m).normalised().vector
    section = formulas["Stability"].equations
    known = numeric(formulas, ut.Surface.from_vector(base, m.n, m.m), np.zeros(2 * m.n))
    named = {e.left: e.right for e in section if e.relation == "="}
    inequalities = [e.left.subs(named) for e in section if e.relation == ">"]
    conditions = sp.lambdify([[*known]], inequalities, "numpy", cse=True)
    rng = np.random.default_rng(5)
    verdicts = []
    for _ in range(30):
        vector = base * rng.uniform(0.2, 1.8, base.size)
        vector[0] = -1.0
        surface = ut.Surface.from_vector(vector, m.n, m.m)
        values = numeric(formulas, surface, np.zeros(2 * m.n))
        claimed = min(conditions([values[symbol] for symbol in known])) > 0
        margin = float(stability_margin(m, surface))
        if abs(margin) > 1e-3:
            assert claimed == (margin > 0)
            verdicts.append(claimed)
    assert {True, False} == set(verdicts)


def test_hurwitz_minors_of_a_cubic_and_a_quintic() -> None:
    """Claim: Liénard and Chipart's minors: a₁a₂ − a₀a₃ for a cubic, two for a quintic."""
    a = sp.symbols("a0:6", real=True)
    assert hurwitz_minors(a[:4]) == [a[1] * a[2] - a[0] * a[3]]
    assert len(hurwitz_minors(a)) == 2
    assert hurwitz_minors(a)[1] == a[3] * a[4] - a[2] * a[5]


@pytest.mark.parametrize("name", rest_slow(sorted(LIBRARY), "rotary_pendulum"))
def test_every_formula_is_latex_that_a_typesetter_takes(name: str) -> None:
    """Claim: each equation is typeset; the document's braces and environments close."""
    parser = MathTextParser("path")
    formulas = shown(name)
    for section in formulas.sections:
        for e in section.equations:
            parser.parse(f"${tex(e.left)}$")
            parser.parse(f"${tex(e.right)}$")
    document = formulas.latex()
    assert document.count("{") == document.count("}")
    assert document.count(r"\begin{align*}") == document.count(r"\end{align*}") >= 8
    assert not re.search(r"[^\x00-\x7f]", document)


def test_names_as_people_write_them() -> None:
    """Claim: Greek, dots, indices and powers, in both forms."""
    q, v = sp.Symbol("theta_x", real=True), sp.Symbol("phi_1_dot", real=True)
    assert plain(v**2 * sp.cos(q)) == "φ̇₁² cos(θ_x)"
    assert tex(v**2) == r"\dot{\varphi}_{1}^{2}"
    assert tex(sp.Symbol("voltage")) == r"\mathrm{voltage}"
    assert plain(sp.Symbol("tilt_dot")) == "tilt_dot"
    assert plain(sp.Symbol("torque_k_t")) == "torque_k_t"


def test_numbers_in_energies_are_shown_as_people_write_them() -> None:
    """Claim: 1.0 and 4/3 as a decimal are written 1 and 4/3, and stay equal; 9.81 stays."""
    h = sp.Symbol("h", real=True)
    shown = readable(1.0 * h + 4.0 / 3.0 * h**2 + 9.81)
    assert plain(shown) == "4 h²/3 + h + 9.81"


def test_words_fit_a_terminal_and_lists_stay_lists() -> None:
    """Claim: no line of words is longer than 79; each coordinate and parameter has its own."""
    formulas = shown("gantry_crane")
    lines = formulas.text().splitlines()
    for section in formulas.sections:
        at = lines.index(section.title) + 2
        words = lines[at : at + len(section.words.splitlines())]
        assert all(len(line) <= 79 for line in words)
    mechanism = formulas.mechanism
    for name in [i.name for i in mechanism.inputs] + [p.name for p in mechanism.parameters]:
        assert any(re.match(rf"  {name} ", line) for line in lines), name


def test_derive_on_the_command_line(tmp_path: object) -> None:
    """Claim: text by default, LaTeX on request, both files with --out."""
    words = ["derive", "cart_pendulum"]
    text = CliRunner().invoke(app, [*words, "--out", str(tmp_path)])
    assert text.exit_code == 0
    assert "M₁₂ = l m_p cos(φ)" in text.stdout
    assert r"\begin{align*}" in CliRunner().invoke(app, [*words, "--latex"]).stdout
    assert CliRunner().invoke(app, ["derive", "piano"]).exit_code == 2


def test_symbols_of_the_theory_step_aside_for_those_of_the_mechanism() -> None:
    """Claim: a parameter called sigma, eta or alpha_u is not taken for the theory's: the formulas
    are those under plain names, with the theory's symbols primed."""
    plain_names, taken = ["x", "phi", "F", "c_1", "c_2", "c_3"], ["x", "phi", "F"]
    taken += ["sigma", "eta", "alpha_u"]
    usual, odd = (derivation(named(names)) for names in (plain_names, taken))
    before = [*plain_names, *taken[3:]]
    after = [*taken, "sigma'", "eta'", "alpha_u'"]
    symbols = (map(partial(sp.Symbol, real=True), names) for names in (before, after))
    rename = dict(zip(*symbols, strict=True))
    for left, right in zip(usual.sections, odd.sections, strict=True):
        for a, b in zip(left.equations, right.equations, strict=True):
            for wanted, found in ((a.left, b.left), (a.right, b.right)):
                assert sp.expand(sp.sympify(wanted).xreplace(rename) - found) == 0
    assert "α_u'" in odd.text()
    assert r"\alpha_{u'}" in odd.latex()


def test_greek_names_and_bare_numbers_are_written_down() -> None:
    """LaTeX knows no φ in formulas; a number that stands alone has the digits that it was given."""
    push, lean = ut.Coordinate("δ_1", "m"), ut.Coordinate("φ", "rad")
    v, w = push.velocity, lean.velocity
    pole = ut.Mechanism.from_energies(
        "pole", [push, lean], [ut.Input("F", "N", 10.0)],
        kinetic=0.85 * v**2 / 2 + 0.1 * sp.cos(lean.symbol) * v * w + w**2 / 2,
        potential=sp.cos(lean.symbol),
    )  # fmt: skip
    shown = ut.derivation(pole)
    assert shown.latex().isascii()
    assert r"\dot{\delta}_{1}" in shown.latex()
    assert "M₁₁ = 0.85\n" in shown.text()
