"""The formulas of a mechanism, for reading: M, f, the law and the conditions on its surface.

The same expressions that everything else is generated from, written with few symbols, as text
or as LaTeX.  The law is shown as the linear equations that it solves, for any n and m:

    M_auᵀ v + M_uu w = f_u,     α_a v + α_u w = −(λ_a q̇_a + λ_u q̇_u + K sw(s/ε)),
    u = B⁻¹ (M_aa v + M_au w − f_a)

with v = q̈_a and w = q̈_u: (1), (10) and (12) without a disturbance, equal to (5)-(9).
"""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import sympy as sp

from undertow.base import checked, file_name
from undertow.law import first_surface, sliding_matrix
from undertow.models import Mechanism, linearise
from undertow.symbolic.formulas import plain, readable, rounded, tex, tex_words

#: Longest line of words.
WIDTH = 79


@dataclass(frozen=True)
class Equation:
    """``left relation right``, SymPy on both sides."""

    left: sp.Expr
    right: sp.Expr
    relation: str = "="


@dataclass(frozen=True)
class Section:
    """A heading, words in front of its equations, and the equations."""

    title: str
    words: str = ""
    equations: tuple[Equation, ...] = ()


def _heading(mechanism: Mechanism) -> str:
    return f"{mechanism.name}: {mechanism.description}".removesuffix(": ")


def _folded(line: str) -> list[str]:
    """Fold a line of words; what goes over is indented a little more than the line is."""
    indent = line[: len(line) - len(line.lstrip())]
    return textwrap.wrap(line, WIDTH, subsequent_indent=f"{indent}  " if indent else "")


@dataclass(frozen=True, eq=False)
class Derivation:
    """The formulas of one mechanism, section by section."""

    mechanism: Mechanism
    sections: tuple[Section, ...]

    def __getitem__(self, title: str) -> Section:
        """Return the section whose title starts so."""
        return next(section for section in self.sections if section.title.startswith(title))

    def text(self) -> str:
        """Return everything as lines of plain text with mathematical signs.

        Words are folded for a terminal of 80 columns; a formula has one line, as long as it is.
        """
        lines = [_heading(self.mechanism)]
        for section in self.sections:
            lines += ["", section.title, "-" * len(section.title)]
            if section.words:
                lines += [part for line in section.words.splitlines() for part in _folded(line)]
            lines += [
                f"  {plain(e.left)} {_RELATIONS[e.relation]} {plain(e.right)}"
                for e in section.equations
            ]
        return "\n".join(lines) + "\n"

    def latex(self) -> str:
        """Return a LaTeX document: amsmath, one ``align*`` for each section."""
        lines = [
            r"\documentclass{article}",
            r"\usepackage{amsmath,amssymb}",
            r"\usepackage[margin=2cm]{geometry}",
            r"\allowdisplaybreaks",
            r"\begin{document}",
            rf"\section*{{{self.mechanism.name.replace('_', ' ')}}}",
            tex_words(self.mechanism.description),
        ]
        for section in self.sections:
            lines.append(rf"\subsection*{{{tex_words(section.title)}}}")
            if section.words:
                lines.append(tex_words(section.words))
            if section.equations:
                rows = [
                    rf"{tex(e.left)} &{_TEX_RELATIONS[e.relation]} {tex(e.right)}"
                    for e in section.equations
                ]
                lines += [r"\begin{align*}", " \\\\\n".join(rows), r"\end{align*}"]
        return "\n".join([*lines, r"\end{document}"]) + "\n"

    def files(self) -> dict[str, bytes]:
        """Return the formulas as ``NAME.txt`` and ``NAME.tex``."""
        name = file_name(self.mechanism.name)
        return {f"{name}.txt": self.text().encode(), f"{name}.tex": self.latex().encode()}


_RELATIONS = {"=": "=", "!=": "≠", ">": ">", "<": "<", "<=": "≤"}
_TEX_RELATIONS = {"=": "=", "!=": r"\neq", ">": ">", "<": "<", "<=": r"\leq"}


# -- the symbols of the formulas -----------------------------------------------------------------


def _symbol(mechanism: Mechanism, name: str) -> sp.Symbol:
    """Return a symbol of the theory, with primes where the mechanism has one that reads alike."""
    own = (*mechanism.x, *mechanism.u, *mechanism.parameter_symbols)
    taken = {plain(symbol) for symbol in own}
    while plain(sp.Symbol(name)) in taken:
        name += "'"
    return sp.Symbol(name, real=True)


def _named(mechanism: Mechanism, stem: str, rows: int, columns: int) -> sp.Matrix:
    return sp.Matrix(rows, columns, lambda i, j: _symbol(mechanism, f"{stem}_{i + 1}{j + 1}"))


def _rate(mechanism: Mechanism) -> sp.Symbol:
    """Return the variable of characteristic polynomials, 1/s; s is taken by the surface."""
    return _symbol(mechanism, "sigma")


@dataclass(frozen=True, eq=False)
class Symbols:
    """Named entries in which law and conditions are written; indices count from 1."""

    M: sp.Matrix
    f: sp.Matrix
    B: sp.Matrix
    alpha_a: sp.Matrix
    lambda_a: sp.Matrix
    alpha_u: sp.Matrix
    lambda_u: sp.Matrix
    surface: sp.Matrix
    eta: sp.Matrix
    layer: sp.Matrix
    v: sp.Matrix
    w: sp.Matrix

    @classmethod
    def of(cls, mechanism: Mechanism) -> Symbols:
        """Return the symbols; α_a = −I and zeros of M and B are written as such."""
        n, m = mechanism.n, mechanism.m

        def grid(stem: str, rows: int, columns: int) -> sp.Matrix:
            if rows == 1:
                return column(stem, columns).T
            return _named(mechanism, stem, rows, columns)

        def column(stem: str, count: int) -> sp.Matrix:
            names = [stem] if count == 1 else [f"{stem}_{i + 1}" for i in range(count)]
            return sp.Matrix([_symbol(mechanism, name) for name in names])

        M, B = mechanism.mass_matrix, mechanism.input_matrix
        return cls(
            M=sp.Matrix(n, n, lambda i, j: _entry(mechanism, "M", min(i, j), max(i, j), M)),
            f=sp.Matrix([_entry(mechanism, "f", i, None, mechanism.force) for i in range(n)]),
            B=sp.Matrix(m, m, lambda i, j: _entry(mechanism, "B", i, j, B)),
            alpha_a=-sp.eye(m),
            lambda_a=grid("lambda_a", m, m),
            alpha_u=grid("alpha_u", m, n - m),
            lambda_u=grid("lambda_u", m, n - m),
            surface=column("s", m),
            eta=column("eta", m),
            layer=column("epsilon", m),
            v=sp.Matrix([_symbol(mechanism, f"{c.name}_ddot") for c in mechanism.coordinates[:m]]),
            w=sp.Matrix([_symbol(mechanism, f"{c.name}_ddot") for c in mechanism.coordinates[m:]]),
        )


def _entry(mechanism: Mechanism, stem: str, i: int, j: int | None, matrix: sp.Matrix) -> sp.Expr:
    value = matrix[i] if j is None else matrix[i, j]
    if value.is_number:
        return value
    return _symbol(mechanism, f"{stem}_{i + 1}" if j is None else f"{stem}_{i + 1}{j + 1}")


# -- the derivation ------------------------------------------------------------------------------


@checked
def derivation(mechanism: Mechanism) -> Derivation:
    """Return the formulas of a mechanism, in the order of the theory.

    Parameters
    ----------
    mechanism
        Any n and m.

    Returns
    -------
    Derivation
        Sections: coordinates, M, f, B, the surface (10), the law (5) with (12), when the law
        exists (37), when the surface is stable ((35)-(36) and their general form), and a first
        surface with the eigenvalues of its sliding dynamics.

    Raises
    ------
    ModelError
        When no surface can stabilise the mechanism.

    Examples
    --------
    >>> import undertow as ut
    >>> print(derivation(ut.mechanisms.rotary_pendulum())["Mass"].equations[1].right)
    -l*m*r_o*cos(phi)
    """
    symbols = Symbols.of(mechanism)
    return Derivation(
        mechanism,
        (
            _coordinates(mechanism),
            Section(
                "Mass matrix M(q)",
                "M q̈ = f + (B u, 0), symmetric.",
                _entries(mechanism, "M", mechanism.mass_matrix, readable),
            ),
            Section("Forces f(q, q̇)", "", _force(mechanism)),
            Section("Inputs B", "", _entries(mechanism, "B", mechanism.input_matrix, readable)),
            _surface(mechanism, symbols),
            _law(mechanism, symbols),
            _existence(mechanism, symbols),
            _stability(mechanism, symbols),
            _example(mechanism),
        ),
    )


def _coordinates(mechanism: Mechanism) -> Section:
    m = mechanism.m
    lines = [
        f"  {plain(c.symbol)} ({c.unit}, {'actuated' if i < m else 'free'}): {c.description}"
        for i, c in enumerate(mechanism.coordinates)
    ]
    lines += [f"  {plain(c.symbol)} ({c.unit or 1}): input, |{plain(c.symbol)}| ≤ {c.limit:g}"
              for c in mechanism.inputs]  # fmt: skip
    lines += [
        f"  {plain(p.symbol)} = {f'{p.value:.6g} {p.unit}'.strip()}: {p.description}"
        for p in mechanism.parameters
    ]
    return Section("Coordinates, inputs, parameters", "\n".join(lines))


def _rows(left: Iterable[sp.Expr], right: Iterable[sp.Expr]) -> tuple[Equation, ...]:
    """Two columns as equations, row by row."""
    return tuple(Equation(*row) for row in zip(left, right, strict=True))


def _entries(
    mechanism: Mechanism, stem: str, matrix: sp.Matrix, shown: Callable[[sp.Expr], sp.Expr]
) -> tuple[Equation, ...]:
    """The entries of a matrix with their names, above the diagonal alone where it is symmetric."""
    rows, columns = matrix.shape
    return tuple(
        Equation(_symbol(mechanism, f"{stem}_{i + 1}{j + 1}"), shown(matrix[i, j]))
        for i in range(rows)
        for j in range(i if stem == "M" else 0, columns)
    )


def _force(mechanism: Mechanism) -> tuple[Equation, ...]:
    rates = mechanism.x[mechanism.n :]
    names = [_symbol(mechanism, f"f_{i + 1}") for i in range(mechanism.n)]
    return _rows(names, [readable(f, rates) for f in mechanism.force])


def _surface(mechanism: Mechanism, y: Symbols) -> Section:
    n, m = mechanism.n, mechanism.m
    q_a, q_u = sp.Matrix(mechanism.q[:m]), sp.Matrix(mechanism.q[m:])
    qd_a, qd_u = sp.Matrix(mechanism.x[n : n + m]), sp.Matrix(mechanism.x[n + m :])
    s = y.alpha_a * qd_a + y.lambda_a * q_a + y.alpha_u * qd_u + y.lambda_u * q_u
    return Section("Sliding surface (10)", "Normalised, α_a = −I.", _rows(y.surface, s))


def _law(mechanism: Mechanism, y: Symbols) -> Section:
    """The law as the linear equations that it solves; explicit for n = 2, m = 1."""
    n, m = mechanism.n, mechanism.m
    qd_a, qd_u = sp.Matrix(mechanism.x[n : n + m]), sp.Matrix(mechanism.x[n + m :])
    sat, rows = sp.Function("sat"), zip(y.eta, y.surface, y.layer, strict=True)
    switch = sp.Matrix([e * sat(s / width) for e, s, width in rows])
    reach = -(y.lambda_a * qd_a + y.lambda_u * qd_u + switch)
    M_aa, M_au, M_uu = y.M[:m, :m], y.M[:m, m:], y.M[m:, m:]
    free = _rows(M_au.T * y.v + M_uu * y.w, y.f[m:, :])
    sliding = _rows(y.alpha_a * y.v + y.alpha_u * y.w, reach)
    inputs = _rows(y.B * sp.Matrix(mechanism.u), M_aa * y.v + M_au * y.w - y.f[:m, :])
    words = (
        "Wanted accelerations from the free rows of (1) and from ṡ = −η sat(s/ε) (12); then the "
        "input that makes them (5). Gains: η where no disturbance is declared, else (13)."
    )
    if (n, m) == (2, 1):
        row = y.alpha_a[0] * y.M[1, 1] - y.alpha_u[0] * y.M[0, 1]
        explicit = (y.M[1, 1] * reach[0] - y.alpha_u[0] * y.f[1]) / row
        sliding = (*sliding, Equation(y.v[0], explicit))
    return Section("Law (5), (12)", words, (*free, *sliding, *inputs))


def _existence(mechanism: Mechanism, y: Symbols) -> Section:
    """(37) as det E(q) ≠ 0 with E = M_uu + M_auᵀ α_u, for α_a = −I."""
    m, n = mechanism.m, mechanism.n
    M = sp.Matrix(mechanism.mass_matrix)
    E = M[m:, m:] + M[:m, m:].T * y.alpha_u
    words = (
        "The law exists where det E(q) ≠ 0, E = M_uu − M_auᵀ α_a⁻¹ α_u, equivalent to "
        "det(α_a − α_u M_uu⁻¹ M_auᵀ) ≠ 0; det E must keep its sign along the motion."
    )
    if n - m == 1:
        return Section("Existence of the law (37)", words, (Equation(readable(E[0]), 0, "!="),))
    entries = _entries(mechanism, "E", E, readable)
    names = _named(mechanism, "E", n - m, n - m)
    whole = Equation(names.det(method="berkowitz").expand(), sp.Integer(0), "!=")
    return Section("Existence of the law (37)", words, (*entries, whole))


def polynomial_matrix(mechanism: Mechanism, *, symbolic: bool) -> sp.Matrix:
    """Return P(σ) whose determinant's roots are the eigenvalues of the sliding dynamics.

    ``P = [[α_a σ + λ_a, α_u σ + λ_u], [M_auᵀ σ² − D_a σ − F_a, M_uu σ² − D_u σ − F_u]]`` at
    the target, with the linearisation's numbers or in the mechanism's parameters.
    """
    n, m, rate = mechanism.n, mechanism.m, _rate(mechanism)
    y = Symbols.of(mechanism)
    lin = linearise(mechanism)  # refuses what has no derivative at the target
    if symbolic:
        at_target = dict.fromkeys(mechanism.x, 0)
        M = mechanism.mass_matrix.subs(at_target)
        slope = mechanism.force.jacobian(list(mechanism.x)).subs(at_target)
        F, D = slope[:, :n], slope[:, n:]
    else:
        M, F, D = (sp.Matrix(a) for a in (lin.M, lin.F, lin.D))
    top = sp.Matrix.hstack(y.alpha_a * rate + y.lambda_a, y.alpha_u * rate + y.lambda_u)
    return sp.Matrix.vstack(top, (M * rate**2 - D * rate - F)[m:, :])


def _stability(mechanism: Mechanism, y: Symbols) -> Section:
    n, m, rate = mechanism.n, mechanism.m, _rate(mechanism)
    degree = 2 * n - m
    title = "Stability on the surface (35)-(36)"
    general = (
        "Exponentially stable on the surface, near the target, exactly where all roots of "
        f"det P(σ) have negative real parts; degree {degree}."
    )
    if m > 1:
        P = polynomial_matrix(mechanism, symbolic=False)
        return Section(title, general, _entries(mechanism, "P", P, rounded))
    symbolic = n == 2
    P = polynomial_matrix(mechanism, symbolic=symbolic)
    polynomial = sp.Poly(P.det(method="berkowitz").expand(), rate)
    coefficients = [polynomial.coeff_monomial(rate**k) for k in range(degree + 1)]
    sign = _leading_sign(mechanism, y, coefficients)
    names = [_symbol(mechanism, f"p_{k}") for k in range(degree + 1)]
    shown = [
        Equation(a, readable(sign * c) if symbolic else rounded(sign * c))
        for a, c in zip(reversed(names), reversed(coefficients), strict=True)
    ]
    hurwitz = [Equation(a, sp.Integer(0), ">") for a in reversed(names)]
    hurwitz += [
        Equation(minor, sp.Integer(0), ">") for minor in hurwitz_minors(names) if minor.is_Add
    ]
    leading = plain(names[-1] * rate**degree)
    words = (
        f"{general} With det P = ±({leading} + … + p₀): where all p_k have one sign "
        "(that of a first surface is written as positive) and Hurwitz's minors are positive:"
    )
    return Section(title, words, (*shown, *hurwitz))


def _leading_sign(mechanism: Mechanism, y: Symbols, coefficients: Sequence[sp.Expr]) -> int:
    """Sign of the leading coefficient of det P for the first surface, −1 or 1."""
    surface = first_surface(mechanism).normalised()
    values = mechanism.substitution
    for name in ("lambda_a", "alpha_u", "lambda_u"):
        numbers = getattr(surface, name).ravel().tolist()
        values |= dict(zip(getattr(y, name), numbers, strict=True))
    return 1 if float(coefficients[-1].subs(values)) > 0 else -1


def hurwitz_minors(a: Sequence[sp.Expr]) -> list[sp.Expr]:
    """Leading minors of Hurwitz's matrix that are needed besides all a_k > 0.

    Liénard and Chipart: with all coefficients positive, every other minor suffices; those of
    order N−1, N−3, … are returned, a_k the coefficient of s^k.
    """
    N = len(a) - 1
    H = sp.Matrix(N, N, lambda i, j: a[N - 2 * (j + 1) + i + 1]
                  if 0 <= N - 2 * (j + 1) + i + 1 <= N else 0)  # fmt: skip
    return [H[:k, :k].det(method="berkowitz").expand() for k in range(N - 1, 1, -2)]


def _example(mechanism: Mechanism) -> Section:
    surface = first_surface(mechanism).normalised()
    poles = np.linalg.eigvals(sliding_matrix(mechanism, surface))
    ordered = sorted(poles, key=lambda p: (p.real, p.imag))
    shown = ", ".join(
        f"{p.real:.4g}" if abs(p.imag) < 1e-9 else f"{p.real:.4g}±{abs(p.imag):.4g}i"
        for p in ordered
        if p.imag > -1e-9
    ).replace("-", "−")
    y = Symbols.of(mechanism)
    pairs: list[Equation] = []
    for name in ("lambda_a", "alpha_u", "lambda_u"):
        values = getattr(surface, name).ravel().tolist()
        pairs += _rows(getattr(y, name), [rounded(sp.Float(value)) for value in values])
    words = f"Quadratic design of Utkin and Young; eigenvalues of its sliding motion, 1/s: {shown}."
    return Section("A first surface", words, tuple(pairs))
