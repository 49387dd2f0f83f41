"""What is compiled computes what the symbols say, whatever they are called; the check bites."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sympy as sp

import undertow as ut
from agreements import (
    ODD_NAMES,
    SETTLED,
    bypassing_the_door,
    estimator,
    exported_law,
    named,
    rig_stepping,
    settling,
    sliding_motion,
    swing_up,
)
from support import rest_slow, unoptimised
from undertow.base import ModelError
from undertow.checks import agreement, check_mechanism, exact
from undertow.checks.agreement import (
    LIMIT,
    QUICK,
    Difference,
    Subject,
    numpy_functions,
    worst,
)
from undertow.checks.exact import ExactModel, Number, evaluate
from undertow.closed_loop import exponential_integrator, kernel
from undertow.closed_loop.kernel import compile_look, compile_loop
from undertow.closed_loop.linear_blocks import linear_blocks
from undertow.law import inner_loop
from undertow.mechanisms import LIBRARY
from undertow.proofs.claims.terminal_ellipsoid import ClosedLoopProgram
from undertow.symbolic import C99Emitter, Tape, numba
from undertow.symbolic.names import SymbolNames

#: Single precision, relative to the same.
SINGLE = 1e-6


@pytest.fixture
def interpreted(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    """Generated modules run as Python, from a cache of their own: nothing has to be compiled.

    Only their decorator is taken away: numba's own switch would also meet what numba compiles of
    itself for others, and that stays so in this process.
    """
    monkeypatch.setattr(numba, "njit", _as_it_is)
    monkeypatch.setenv("UNDERTOW_CACHE", str(tmp_path / "cache"))
    before = set(sys.modules)
    with np.errstate(divide="ignore"):  # both values of a choice are computed
        yield
    for name in set(sys.modules) - before:
        if str(tmp_path) in str(getattr(sys.modules[name], "__file__", "")):
            del sys.modules[name]  # whoever needs it next wants it compiled
    for made in (compile_loop, compile_look, linear_blocks):
        made.cache_clear()


def _as_it_is(function: Any = None, **_options: Any) -> Any:
    """Decorate nothing, with options or without."""
    return _as_it_is if function is None else function


def agree(differences: Iterator[Difference], limit: float = LIMIT) -> None:
    found = worst(differences)
    assert found is not None
    assert found.relative <= limit, str(found)


# -- exact values --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "text",
    [
        "sin(a)*cos(b) + tan(a/3)", "sqrt(a**2 + b)/a", "exp(-b)*log(a + 4)", "atan2(a, b)",
        "Max(a, b, 0.1) - Min(a, b)", "Abs(a - b)*sign(b - a)", "a**3 - 0.1*a**(-2)", "2**a + pi*E",
        "Piecewise((a, a < b), (b**2, True))", "tanh(a) + sinh(b)/cosh(a) + asin(a/9) + acos(b/9)",
        "Heaviside(a - b) + floor(3*a) + erf(b) + atan(a)",
        "Mod(5*a, b) + sec(a/3) + cot(b/2) + csc(b)",
    ],
)  # fmt: skip
def test_exact_values_are_those_of_sympy(text: str) -> None:
    """Claim: the walk through an expression gives what SymPy gives to 45 digits, and float64 is
    off by no more than a few roundings of the size that comes with it."""
    a, b = sp.symbols("a b", real=True)
    e = sp.sympify(text, {"a": a, "b": b})
    for x, y in ((0.7, 1.9), (1.9, 0.7), (1e-3, 2.5)):
        binary = {a: sp.Rational(*x.as_integer_ratio()), b: sp.Rational(*y.as_integer_ratio())}
        floats = {f: sp.Rational(*float(f).as_integer_ratio()) for f in e.atoms(sp.Float)}
        wanted = sp.N(e.xreplace(floats).subs(binary), 45)
        found = evaluate(e, {a: Number(x), b: Number(y)})
        assert abs(sp.Float(found.value, 45) - wanted) <= abs(wanted) * sp.Float("1e-43")
        assert found.off(float(sp.lambdify((a, b), e, ["math", "scipy"])(x, y))) <= 8 * 2.0**-53


def test_a_value_that_is_none_is_said() -> None:
    """Claim: an undeclared symbol, an unknown function and a root of −1 are refused by name."""
    a = sp.Symbol("a", real=True)
    for e, word in (
        (sp.Symbol("q"), "q"),
        (sp.gamma(a), "gamma"),
        (sp.sqrt(a - 3), "real"),
        (1 / a, "real"),
    ):
        with pytest.raises(ModelError, match=word):
            evaluate(e, {a: Number(0.0)})


# -- the library ---------------------------------------------------------------------------------


@pytest.mark.parametrize("switching", ["tanh", "sign"])
def test_the_other_switching_functions(switching: Any) -> None:
    """Claim: the law with tanh and with sign, as compiled, is that of the symbols."""
    reaching = ut.ReachingLaw(eta=7.0, layer=0.3, switching=switching)
    subject = Subject(ut.mechanisms.rotary_pendulum(), reaching=reaching)
    agree(inner_loop_of(subject))
    agree(numpy_functions(subject))


def inner_loop_of(subject: Subject) -> Iterator[Difference]:
    return QUICK["inner loop"](subject)


def test_inputs_without_a_limit(interpreted: None) -> None:
    """Claim: an actuator that can deliver everything is not clipped, in code or exactly."""
    mechanism = named(["a", "b", "F"], title="no limit").with_input_limit(np.inf)
    subject = Subject(mechanism)
    assert max(abs(float(law.u[0])) for law in subject.laws) > 20.0
    for compare in QUICK.values():
        agree(compare(subject))


def test_the_kernel_of_a_sampled_loop(interpreted: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Claim: it holds the input of the sample over its step; one that forgets to is found."""
    subject = Subject(named(["a", "b", "F"], title="sampled"))
    agree(agreement.kernel(subject, sampled=True))
    compiled = kernel.compile_loop

    def renewed(loop: kernel.LoopEquations) -> Any:
        return compiled(loop._replace(sampled=not loop.sampled))

    monkeypatch.setattr(agreement, "compile_loop", renewed)
    found = worst(agreement.kernel(subject, sampled=True))
    assert found is not None
    assert found.relative > 1e3 * LIMIT


def test_gains_that_declared_disturbances_ask_for() -> None:
    """Claim: the gains (13) are those of the symbols, in every compiled law."""
    mechanism = ut.mechanisms.rotary_pendulum().with_disturbance_bounds(0.01, 0.02)
    subject = Subject(mechanism)
    assert min(float(k) for law in subject.laws for k in law.gains) > 20.0
    for name in ("NumPy functions M, f, q̈ and law", "inner loop", "proof programme"):
        agree(QUICK[name](subject))


REST: dict[str, tuple[Callable[[Subject], Iterator[Difference]], float]] = {
    "rig": (rig_stepping, LIMIT),
    "estimator": (estimator, LIMIT),
    "swing-up": (swing_up, LIMIT),
    "sliding motion": (sliding_motion, LIMIT),
    "large steps, energy": (settling, SETTLED),
    "large steps, time": (partial(settling, objective=ut.MinimumTime(travel=False)), SETTLED),
}
EVERY = [
    pytest.param(name, marks=() if name == "rotary_pendulum" else pytest.mark.slow)
    for name in sorted(LIBRARY)
]


def whatever_its_steps(differences: Iterator[Difference]) -> Iterator[Difference]:
    """Small steps take over where large ones are given up, which is slower and not wrong."""
    return (one for one in differences if "[number of steps]" not in one.what)


@pytest.mark.parametrize(
    "what",
    [
        pytest.param(what, marks=pytest.mark.slow if "large steps" in what else ())
        for what in sorted(REST)
    ],
)
@pytest.mark.parametrize("name", EVERY)
def test_compiled_code_of_the_library_is_that_of_the_symbols(name: str, what: str) -> None:
    """Claim: rig, estimator, swing-up and the programmes of proofs compute M, f, B and the law."""
    mechanism = LIBRARY[name]()
    if what == "swing-up" and (mechanism.m > 1 or mechanism.potential is None):
        pytest.skip("no such swing-up")
    compare, limit = REST[what]
    found = compare(Subject(mechanism))
    agree(found if name == "rotary_pendulum" else whatever_its_steps(found), limit)


@pytest.mark.parametrize("real", rest_slow(["double", "float"], "double"))
@pytest.mark.parametrize("name", EVERY)
def test_exported_c_of_the_library_is_that_of_the_symbols(
    name: str, real: str, tmp_path: Path
) -> None:
    """Claim: the law in C is that of the symbols, and its own test passes."""
    with unoptimised():
        agree(
            exported_law(Subject(LIBRARY[name]()), tmp_path, real),
            LIMIT if real == "double" else SINGLE,
        )


# -- names ---------------------------------------------------------------------------------------


def drawn(seed: int, count: int) -> list[str]:
    """Names for a mechanism: odd ones, none of which is another's velocity."""
    rng = np.random.default_rng(seed)
    return [str(v) for v in rng.choice(np.array(ODD_NAMES), count, replace=False)]


def sets_of_names() -> list[list[str]]:
    """Every odd name, eight at a time."""
    rest = list(ODD_NAMES)
    rest += rest[: -len(rest) % 8]
    return [rest[i : i + 8] for i in range(0, len(rest), 8)]


@pytest.mark.parametrize("names", sets_of_names(), ids=lambda names: names[0][:12])
def test_no_name_of_a_user_meets_one_of_a_generator(names: list[str], interpreted: None) -> None:
    """Claim: under every odd name the law in Python is that of the symbols."""
    subject = Subject(named(names), count=1)
    agree(inner_loop_of(subject))
    agree(numpy_functions(subject))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(13))
def test_names_drawn_at_random(seed: int, interpreted: None, tmp_path: Path) -> None:
    """Claim: so are kernel, rig, estimator, C and programmes, under names drawn at random."""
    like = LIBRARY[sorted(LIBRARY)[seed % len(LIBRARY)]]()
    mechanism = named(drawn(seed, 40), like, f'names "{seed}" """ \\')
    subject = Subject(mechanism, count=1)
    for compare in QUICK.values():
        agree(compare(subject))
    for compare, limit in REST.values():
        if compare is not swing_up or mechanism.m == 1:
            agree(whatever_its_steps(compare(subject)), limit)
    agree(exported_law(subject, tmp_path))


@pytest.mark.slow  # the same as above, but for the compiler
def test_a_mechanism_of_odd_names_compiled(tmp_path: Path) -> None:
    """Claim: names of generators, of C and of Python, compiled: all checks pass, and C agrees.

    On 09076aa proofs of it ended in an error: ``z_1`` and ``sw_0`` were symbols of theirs.
    """
    names = ["z_1", "sw_0", "double", "lambda", "µ", "NAN", "self", "n" * 200]
    mechanism = named(names, title='odd """\\names')
    report = check_mechanism(mechanism)
    assert report.passed, str(report)
    assert mechanism.with_parameters(self=0.01).state(sw_0=0.1)[1] == 0.1
    subject = Subject(mechanism, count=1)
    agree(sliding_motion(subject))
    agree(exported_law(subject, tmp_path))


@pytest.mark.parametrize("name", ["t", "z_1_dot"])
def test_names_that_mean_something_else_are_refused(name: str) -> None:
    """Claim: the time's name, and that of a coordinate's velocity, are refused at the door."""
    names = ["z_1", "sw_0", "double", name, "µ", "NAN", "self", "pi"]
    with pytest.raises(ModelError, match="used twice"):
        named(names)


# -- the check bites -----------------------------------------------------------------------------


def failed(mechanism: ut.Mechanism) -> dict[str, str]:
    """The checks that fail, by the first word of what they compare, and what they say."""
    report = check_mechanism(mechanism)
    return {check.name: check.remedy for check in report.failures}


def test_swapped_parameters_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """Claim: two parameters exchanged on their way into compiled code fail every comparison, with
    the number, the state and by how much."""
    mechanism = ut.mechanisms.rotary_pendulum()
    assert check_mechanism(mechanism).passed
    packed = mechanism.parameter_values.copy()
    packed[[0, 1]] = packed[[1, 0]]
    monkeypatch.setattr(ut.Mechanism, "parameter_values", property(lambda self: packed))
    found = {k: v for k, v in failed(mechanism).items() if "50 digits" in k}
    assert len(found) == len(QUICK)
    for what, said in found.items():
        assert "exactly" in said, what
        assert "theta = " in said
        assert "off by" in said


SABOTAGED = (("kernel", kernel, "kernel_source"), ("law", inner_loop, "function_source"))


@pytest.mark.parametrize(("kind", "module", "writer"), SABOTAGED, ids=["kernel", "law"])
def test_a_sign_that_flips_in_generated_code_is_found(
    kind: str, module: Any, writer: str, monkeypatch: pytest.MonkeyPatch, interpreted: None
) -> None:
    """Claim: one sign changed in a line of the model fails that comparison, and no other; so does
    what is then kept in the cache, when the generator is right again."""
    mechanism = named(["a", "b", "F", "p1", "p2", "p3", "p4", "p5"], title=f"sabotaged {kind}")
    write = getattr(module, writer)

    def flipped(*args: Any, **rest: Any) -> str:
        text = str(write(*args, **rest))
        line = next(s for s in text.splitlines() if s.strip().startswith("_v") and " + " in s)
        return text.replace(line, line.replace(" + ", " - ", 1))

    with monkeypatch.context() as wrong:
        wrong.setattr(module, writer, flipped)
        once = failed(mechanism)
    for cached in (kernel.compile_loop, inner_loop.law_module):
        cached.cache_clear()
    stale = failed(mechanism)
    word = {"kernel": "rollout kernel", "law": "inner loop"}[kind]
    for found in (once, stale):
        (what,) = found
        assert what.startswith(word)
        assert "off by" in found[what]
    cache_of_the_test = {p.name for p in Path(os.environ["UNDERTOW_CACHE"]).iterdir()}
    assert any(name.startswith("l") for name in cache_of_the_test)


SLOW = pytest.mark.slow
#: One wrong character or name in the generated code of the large steps, and where it is.
MUTANTS = {
    "the cost begins without V": ("begin", "cost + counted * level", "cost"),
    "p is not P x": ("begin", "level = p_0", "level = 2.0 * p_0"),
    "the rates at x are not used": ("first_half", "q_1 = ", "q_1 = 0.0 * "),
    "r changes sign": ("first_half", "] - (", "] + ("),
    "Φ + V̇ without the two": ("first_half", "2.0 * counted", "counted"),
    "a rest that is another's": ("first_half", "q_1 = ", "q_1 = q_0 + "),
    "r(a) + r(x)": ("second_half", "y_1 = ", "y_1 = 2.0 * "),
    "half the cost": ("second_half", "0.5 * (bend + late)", "0.25 * (bend + late)"),
    "the cost of a part is a whole one's": ("second_half", "part * span * mean", "span * mean"),
    "time passes twice": ("second_half", "+ part * span if", "+ 2.0 * part * span if"),
    "time of a part is a whole one's": ("second_half", "+ part * span if", "+ span if"),
    "the terminal set is missed": ("second_half", "part * m_0", "m_0"),
    "V stays in the cost": ("finish", "cost - counted * level", "cost + counted * level"),
}


@pytest.mark.parametrize(
    "mutant",
    [
        pytest.param(name, marks=() if place == "finish" else SLOW)
        for name, (place, _, _) in MUTANTS.items()
    ],
)
def test_what_is_wrong_in_the_large_steps_is_found(
    mutant: str, monkeypatch: pytest.MonkeyPatch, interpreted: None
) -> None:
    """Claim: cost and arrival beside SciPy's show each of these; the kernel's step does not."""
    part, right, wrong = MUTANTS[mutant]
    write = getattr(exponential_integrator, part)

    def mutated(*args: Any) -> list[str]:
        lines = "\n".join(write(*args))
        assert right in lines
        return lines.replace(right, wrong, 1).splitlines()

    monkeypatch.setattr(exponential_integrator, part, mutated)
    kernel.compile_loop.cache_clear()
    try:
        subject = Subject(ut.mechanisms.rotary_pendulum(), count=1)
        agree(agreement.kernel(subject))
        problems = (ut.MinimumEnergy(travel=False), ut.MinimumTime(travel=False))
        with np.errstate(all="ignore"):  # a mutant may run away to infinity
            found = (worst(settling(subject, problem)) for problem in problems)
            assert any(d is not None and not d.relative <= SETTLED for d in found)
    finally:
        kernel.compile_loop.cache_clear()


def test_wrong_numbers_in_a_proof_programme_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """Claim: a programme of the proofs with η in the place of ε does not enclose, and is named."""
    numbers = ClosedLoopProgram.numbers

    def swapped(self: ClosedLoopProgram, *args: Any) -> Any:
        row = numbers(self, *args)
        width = 2 * self.m * self.n
        row[[width, width + self.m]] = row[[width + self.m, width]]
        return row

    monkeypatch.setattr(ClosedLoopProgram, "numbers", swapped)
    (what,) = failed(ut.mechanisms.rotary_pendulum())
    assert what.startswith("proof programme")


def look_alike() -> ut.Mechanism:
    """µ (U+00B5) and μ (U+03BC): two symbols, one identifier of Python's."""
    plain = named(["a", "b", "F", "p1", "p2", "p3", "p4", "p5"], title="look-alike")
    return bypassing_the_door(plain, {"p1": "\N{GREEK SMALL LETTER MU}", "p2": "\N{MICRO SIGN}"})


def test_look_alikes_that_pass_the_door_are_told_apart(interpreted: None) -> None:
    """Claim: code that is generated from a model that the door would refuse is still its own:
    two names that are one for Python, and two that agree in their first 299 letters."""
    subject = Subject(bypassing_the_door(look_alike(), {"p3": "n" * 300, "p4": "n" * 299 + "m"}))
    agree(inner_loop_of(subject))
    agree(QUICK["rollout kernel"](subject))


def test_look_alikes_are_found_where_names_are_printed(
    monkeypatch: pytest.MonkeyPatch, interpreted: None
) -> None:
    """Claim: with names printed as on 09076aa the same model fails: the compiled law is another."""
    mechanism = replace_name(look_alike(), "look-alike printed")

    def as_it_is(self: SymbolNames, symbol: sp.Symbol) -> str:
        if symbol in self._given:
            return self._given[symbol]
        return str(symbol.name) if symbol.name.startswith("_") else f"{symbol.name}_"

    monkeypatch.setattr(SymbolNames, "__getitem__", as_it_is)
    found = failed(mechanism)
    assert any(what.startswith("inner loop") for what in found)
    assert any("off by" in said and "a = " in said for said in found.values())


def replace_name(mechanism: ut.Mechanism, title: str) -> ut.Mechanism:
    made = bypassing_the_door(mechanism, {})
    made.__dict__["name"] = title
    return made


def test_one_symbol_for_two_things_is_refused() -> None:
    """Claim: a parameter that is a coordinate too has no exact value, and no compiled one."""
    plain = named(["a", "b", "F", "p1", "p2", "p3", "p4", "p5"])
    double = bypassing_the_door(plain, {"p1": "b"})
    with pytest.raises(ModelError, match="b twice"):
        ExactModel(double)
    with pytest.raises(ModelError, match="b twice"):
        double.M([0.0, 0.1])
    with pytest.raises(ModelError, match="b twice"):
        inner_loop.InnerLoop(double, ut.Surface(-1, -1, 1, 4))(np.zeros(4))


def test_a_model_without_a_value_is_said() -> None:
    """Claim: where M has no real value at random states of the declared ranges, that is refused."""
    plain = named(["a", "b", "F", "p1", "p2", "p3", "p4", "p5"])
    nowhere = bypassing_the_door(plain, {})
    force = sp.Matrix(plain.force) + sp.Matrix([sp.sqrt(-1 - plain.q[1] ** 2), 0])
    nowhere.__dict__["force"] = sp.ImmutableDenseMatrix(force)
    with pytest.raises(ModelError, match="real numbers at 0"):
        Subject(nowhere)


def test_a_function_without_an_exact_value_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    """Claim: what cannot be compared counts as not passed, with the reason, and raises nothing."""
    known = {k: v for k, v in exact._FUNCTIONS.items() if k not in (sp.sin, sp.cos)}
    monkeypatch.setattr(exact, "_FUNCTIONS", known)
    report = check_mechanism(named(["a", "b", "F"], title="sines are not known"))
    (check,) = report.failures
    assert check.name.startswith("compiled code")
    assert "real numbers at 0" in check.remedy


def test_a_plant_that_depends_on_time(interpreted: None) -> None:
    """Claim: it has no law and no kernel of its own; M, f and q̈ are compared."""
    plain = named(["a", "b", "F"], title="pushed")
    plant = plain.disturbed({"b": sp.Rational(1, 100) * sp.sin(3 * ut.models.mechanism.TIME)})
    report = check_mechanism(plant)
    assert sum("50 digits" in check.name for check in report.checks) == 1
    agree(numpy_functions(Subject(plant)))


def test_a_model_that_no_proof_can_be_about(interpreted: None) -> None:
    """Claim: where proofs refuse a function, everything else is compared all the same."""
    plain = named(["a", "b", "F"], title="arctangents")
    force = sp.Matrix(plain.force) - sp.Matrix([sp.atan(plain.x[2]) / 50, 0])
    report = check_mechanism(replace(plain, force=sp.ImmutableDenseMatrix(force)))
    assert report.passed, str(report)
    assert sum("50 digits" in check.name for check in report.checks) == len(QUICK) - 1


def test_the_quick_part_can_be_left_out() -> None:
    """Claim: without it the identities alone are reported."""
    mechanism = ut.mechanisms.rotary_pendulum()
    whole, brief = (check_mechanism(mechanism, compiled=flag) for flag in (True, False))
    assert len(whole.checks) == len(brief.checks) + len(QUICK)
    assert replace(whole, checks=whole.checks[: len(brief.checks)]) == brief


FUNCTIONS = (
    "a*frac(b)", "-frac(a)", "a*Mod(b, 2)", "Mod(a, -3)**2", "acot(b + 2)", "sech(b)",
    "b*csch(a + 2)", "coth(a + 2)", "sinc(b)", "sec(b)*tan(b)", "csc(b + 2)*cot(b + 2)",
    "floor(a) - ceiling(b)", "Heaviside(b)*a",
)  # fmt: skip


@pytest.mark.parametrize("text", rest_slow(FUNCTIONS, *FUNCTIONS[::3]))
def test_functions_that_code_is_written_for(text: str, interpreted: None) -> None:
    """Claim: each is compiled as it is meant, also as a factor and of negative arguments."""
    plain = named(["a", "b", "F"], title=f"force {text}")
    extra = sp.sympify(text, {"a": plain.q[0], "b": plain.q[1]}) / 50
    force = sp.Matrix(plain.force) + sp.Matrix([extra, 0])
    subject = Subject(replace(plain, force=sp.ImmutableDenseMatrix(force), potential=None))
    agree(inner_loop_of(subject))
    agree(QUICK["rollout kernel"](subject))
    agree(numpy_functions(subject))


@pytest.mark.parametrize("real", ["double", "float"])
def test_a_remainder_in_c_has_the_sign_of_the_divisor(real: Any) -> None:
    """Claim: C's fmod(−1, 2) is −1, where SymPy and Python have 1."""
    x = sp.Symbol("x", real=True)
    text = C99Emitter(Tape(), {x: "x"}, real).text(x * sp.Mod(x, 2))
    ends = {"double": ("fmod(x, 2.0)", "2.0"), "float": ("fmodf(x, 2.0f)", "2.0f")}[real]
    assert text == f"x*(ut_mod({ends[0]}, {ends[1]}))"
