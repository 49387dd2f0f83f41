"""Formulas for reading: short equal forms, one line of text, LaTeX.

:func:`readable` and :func:`rounded` make an expression short, :func:`plain` and :func:`tex`
write it down, :func:`tex_words` writes sentences that hold symbols.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from fractions import Fraction
from functools import lru_cache

import sympy as sp
from sympy.printing.latex import LatexPrinter
from sympy.printing.str import StrPrinter
from sympy.simplify.fu import TR10i

# -- short forms ---------------------------------------------------------------------------------


def readable(expression: sp.Expr | float, rates: Sequence[sp.Symbol] = ()) -> sp.Expr:
    """Return an equal expression that is short to read.

    ``expression``: a polynomial in ``rates`` with coefficients in sines and cosines. ``rates``:
    velocities by whose monomials the terms are collected.
    """
    expression = sp.expand(_with_fractions(sp.sympify(expression)))
    polynomial = sp.Poly(expression, *rates) if rates and expression.is_polynomial(*rates) else None
    if polynomial is None:
        return _shortest(expression)
    return sp.Add(
        *(
            sp.Mul(_shortest(c), sp.Mul(*(r**k for r, k in zip(rates, powers, strict=True))))
            for powers, c in polynomial.terms()
        )
    )


def _with_fractions(expression: sp.Expr) -> sp.Expr:
    """Write numbers that are small fractions as such: 1.0 is 1, 1.333… is 4/3; 9.81 stays."""

    def fraction(number: sp.Float) -> sp.Expr:
        value = float(number)
        short = Fraction(value).limit_denominator(12)
        near = abs(value - short) <= 4e-16 * abs(value)
        return sp.Rational(short.numerator, short.denominator) if near else number

    return expression.xreplace({f: fraction(f) for f in expression.atoms(sp.Float)})


@lru_cache(maxsize=4096)
def _shortest(expression: sp.Expr) -> sp.Expr:
    candidates = [expression]
    for change in (TR10i, _angles):
        candidates.append(change(candidates[-1]))
    candidates += [sp.factor_terms(c) for c in candidates]
    return min(candidates, key=lambda c: (sp.count_ops(c), len(str(c))))


def _angles(expression: sp.Expr) -> sp.Expr:
    """Collect terms by their trigonometric factors, then contract sums of angles."""
    functions = sorted(expression.atoms(sp.sin, sp.cos), key=str)
    products = sorted(
        {
            sp.Mul(*(a for a in sp.Mul.make_args(t) if a.has(*functions)))
            for t in sp.Add.make_args(sp.expand(expression))
            if functions and t.has(*functions)
        },
        key=str,
    )
    return TR10i(sp.collect(sp.expand(expression), products)) if products else expression


def rounded(expression: sp.Expr, digits: int = 5) -> sp.Expr:
    """Return an expression with its numbers rounded; those that round to whole ones are whole."""

    def short(number: sp.Float) -> sp.Expr:
        value = float(f"{float(number):.{digits}g}")
        if abs(value) < 1e-12:
            return sp.Integer(0)
        return sp.Integer(int(value)) if value == int(value) else sp.Float(value, digits)

    whole = sp.sympify(expression)
    return whole.xreplace({f: short(f) for f in whole.atoms(sp.Float)})


# -- printing ------------------------------------------------------------------------------------

_GREEK = {
    "alpha": "α", "beta": "β", "gamma": "γ", "epsilon": "ε", "eta": "η", "theta": "θ",
    "lambda": "λ", "phi": "φ", "psi": "ψ", "sigma": "σ",
}  # fmt: skip
#: Greek letters as TeX names them; other capitals are Latin ones.
_LETTERS: Mapping[str, str] = dict(
    re.findall(
        r"(\S) (\S+)",
        "α alpha β beta γ gamma δ delta ε epsilon ζ zeta η eta θ theta ι iota κ kappa λ lambda "
        "μ mu ν nu ξ xi π pi ρ rho ς varsigma σ sigma τ tau υ upsilon φ phi χ chi ψ psi ω omega "
        "Γ Gamma Δ Delta Θ Theta Λ Lambda Ξ Xi Π Pi Σ Sigma Υ Upsilon Φ Phi Ψ Psi Ω Omega",
    )
)
_DIGITS = str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉")
_POWERS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_DOTS = {"dot": "\N{COMBINING DOT ABOVE}", "ddot": "\N{COMBINING DIAERESIS}"}


def _parts(name: str) -> tuple[str, str, str]:
    """Split ``phi_1_ddot`` into stem, index and dots."""
    match = re.fullmatch(r"(.+?)_(d?dot)", name)
    body, dots = (match[1], match[2]) if match else (name, "")
    stem, _, index = body.partition("_")
    return stem, index, dots


def plain_symbol(name: str) -> str:
    """Return a name with Greek letters, dots and lowered numbers: φ̇₁ of ``phi_1_dot``."""
    stem, index, dots = _parts(name)
    if len(stem) > 1 and stem not in _GREEK and dots:
        return name  # a dot over the last letter of a word says nothing
    letter = _GREEK.get(stem, stem) + _DOTS.get(dots, "")
    if not index:
        return letter
    pieces = (p.translate(_DIGITS) if p.isdigit() else f"_{p}" for p in index.split("_"))
    return letter + "".join(pieces)


def _tex_letter(name: str) -> str:
    return {"phi": r"\varphi", "epsilon": r"\varepsilon"}.get(name, rf"\{name}")


def _tex_letters(word: str) -> str:
    """Return a word with its Greek letters as commands."""
    if len(word) == 1:
        return _tex_letter(_LETTERS[word]) if word in _LETTERS else word
    return "".join(rf"{_tex_letter(_LETTERS[c])}{{}}" if c in _LETTERS else c for c in word)


def _tex_symbol(name: str) -> str:
    stem, index, dots = _parts(name)
    letter = _tex_letter(stem) if stem in _GREEK else _tex_letters(stem)
    if len(stem) > 1 and stem not in _GREEK:
        letter = rf"\mathrm{{{letter}}}"
    if dots:
        letter = rf"\{dots}{{{letter}}}"
    if not index:
        return letter
    pieces = map(_tex_letters, index.split("_"))
    return f"{letter}_{{{','.join(pieces)}}}"


class _Plain(StrPrinter):  # type: ignore[misc]  # SymPy is untyped
    """One line of text with Greek letters, dots and raised powers; a space multiplies."""

    def _print_Symbol(self, expr: sp.Symbol) -> str:
        return plain_symbol(expr.name)

    def _print_Pow(self, expr: sp.Pow, rational: bool = False) -> str:
        base, exponent = expr.args
        if exponent.is_Integer and exponent > 0:
            text = self._print(base)
            closed = base.is_Symbol or isinstance(base, sp.Function)
            power = str(exponent).translate(_POWERS)
            return f"{text}{power}" if closed else f"({text}){power}"
        return str(super()._print_Pow(expr, rational))

    def _print_Mul(self, expr: sp.Mul) -> str:
        return re.sub(r"(?<!\*)\*(?!\*)", " ", super()._print_Mul(expr))


class _Tex(LatexPrinter):  # type: ignore[misc]  # SymPy is untyped
    """LaTeX with dots over velocities and roman words."""

    def _print_Symbol(self, expr: sp.Symbol, style: str = "plain") -> str:
        del style
        return _tex_symbol(expr.name)


def plain(expression: sp.Expr) -> str:
    """Return an expression on one line of text.

    >>> plain(sp.Symbol("phi_1_dot") ** 2 * sp.cos(sp.Symbol("phi_1")))
    'φ̇₁² cos(φ₁)'
    """
    return str(_Plain({"full_prec": False}).doprint(sp.sympify(expression))).replace("-", "−")


def tex(expression: sp.Expr) -> str:
    r"""Return an expression as LaTeX.

    >>> tex(sp.Symbol("phi_dot") ** 2)
    '\\dot{\\varphi}^{2}'
    """
    return str(_Tex({"fold_short_frac": True}).doprint(sp.sympify(expression)))


#: Signs in words to LaTeX, after formulas.
_SIGNS: Mapping[str, str] = {
    "%": r"\%", "&": r"\&", "_": r"\_", "−": "$-$", "≠": r"$\neq$", "≤": r"$\leq$", "±": r"$\pm$",
    "²": "$^2$", "·": r"$\cdot$", "Ω": r"$\Omega$", "…": r"\dots{}", "°": r"$^\circ$",
    ">": "$>$", "<": "$<$", "|": "$|$",
}  # fmt: skip

#: A letter with dots, indices and powers, as words and :func:`plain` write it.
_FORMULA = re.compile(
    r"([A-Za-zα-ω]+)(\u0307|\u0308)?(_[A-Za-z0-9₀-₉]+|[₀-₉]+)?(⁻¹|ᵀ|[²³⁴-⁹])?(?![A-Za-z])"
)
_NORMAL = str.maketrans("₀₁₂₃₄₅₆₇₈₉", "0123456789")
_RAISED = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹", "0123456789")


def tex_words(words: str) -> str:
    """Return words for LaTeX: formulas as mathematics, one line after the other."""

    def formula(match: re.Match[str]) -> str:
        letters, dot, index, power = match.groups()
        if not (dot or index or power or set(letters) & set(_LETTERS)):
            return match[0]
        text = _tex_symbol(letters)
        if dot:
            text = rf"\{'dot' if dot == chr(0x307) else 'ddot'}{{{text}}}"
        if index:
            text += f"_{{{index.lstrip('_').translate(_NORMAL)}}}"
        if power:
            text += {"⁻¹": "^{-1}", "ᵀ": "^{T}"}.get(power) or f"^{power.translate(_RAISED)}"
        return f"\0{text}\0"

    pieces = _FORMULA.sub(formula, words.replace("ṡ", "s\u0307")).split("\0")
    for index in range(0, len(pieces), 2):
        for sign, replacement in _SIGNS.items():
            pieces[index] = pieces[index].replace(sign, replacement)
    text = "".join(f"${p}$" if i % 2 else p for i, p in enumerate(pieces))
    return "\\\\\n".join(line.strip() for line in text.split("\n"))
