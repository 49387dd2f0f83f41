"""The kernel: files of version 2 are read strictly, and what is false is not proved."""

from __future__ import annotations

import ast
import copy
import json
import math
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sympy as sp

import undertow as ut
from undertow.base import ModelError
from undertow.base.errors import CertificateError
from undertow.proofs.claims import terminal_ellipsoid, words
from undertow.proofs.claims.certificate import Certificate
from undertow.proofs.claims.document import document_bytes
from undertow.proofs.claims.model_data import law_of, model_data, model_of
from undertow.proofs.claims.verify import verify
from undertow.proofs.claims.written import number_text
from undertow.proofs.kernel import claims as kernel
from undertow.proofs.kernel.claims import Nonsingular, Reaching, Stability, check, decide
from undertow.proofs.kernel.compiled import between
from undertow.proofs.kernel.model import Law, Model, Quantity
from undertow.proofs.kernel.reader import Refused, digest, number, read, read_model

ROOT = Path(__file__).parents[2]
WRITTEN = (ROOT / "tests/data/certificate_v2.json").read_bytes()
RIG = ut.mechanisms.rotary_pendulum()
SURFACE = ut.Surface(-1, -1.59, 1.96, 12.1)
LAW = ut.ReachingLaw()

Document = dict[str, Any]


def signed(document: Document) -> bytes:
    """The file of a document, with hashes that fit: a forger's."""
    document = {k: v for k, v in document.items() if k != "checksum"}
    document["model_hash"] = digest(document["model"])
    document["checksum"] = digest(document)
    return json.dumps(document, ensure_ascii=False).encode()


def edited(edit: Callable[[Document], Any]) -> bytes:
    document = json.loads(WRITTEN)
    edit(document)
    return signed(document)


def claim_of(document: Document, kind: str) -> Document:
    found: Document = next(c for c in document["subjects"][0]["claims"] if c["kind"] == kind)
    return found


# -- what stands in it ----------------------------------------------------------------------------


def test_the_kept_file_is_proved_from_itself_alone() -> None:
    """Five claims of four kinds; Undertow's library makes the same model again."""
    found = check(read(WRITTEN))
    assert [d.kind for _, _, d in found] == ["proved"] * 5
    assert {c.kind for _, c, _ in found} == {*kernel.KINDS} - {"surface region", "closed loop"}
    assert json.loads(WRITTEN)["model"] == json.loads(json.dumps(model_data(RIG)))
    assert all(item.verdict for item in verify(Certificate.from_bytes(WRITTEN), RIG))


def test_a_file_that_is_written_is_read_again() -> None:
    model, law = model_of(RIG), law_of(RIG, SURFACE, LAW)
    claims = [
        Stability(Fraction(1, 3)),
        Nonsingular({"phi": (Fraction(-1, 7), Fraction(0))}, Fraction(1, 2)),
    ]
    document = read(document_bytes(RIG, [(SURFACE, LAW, claims)], {"undertow": "test"}))
    assert document.model == model
    assert document.subjects[0].law == law
    assert [kernel.read_claim(c, model) for c in document.subjects[0].claims] == claims


@pytest.mark.parametrize(
    ("text", "value"),
    [("0", 0), ("-7/3", Fraction(-7, 3)), ("0x1.999999999999ap-4", Fraction(0.1)),
     ("-0x0.0000000000001p-1022", Fraction(-5e-324)), ("4/2", 2)],
)  # fmt: skip
def test_number_texts_are_exact(text: str, value: Fraction) -> None:
    assert number(text) == value
    assert number(number_text(value)) == value


@pytest.mark.parametrize(
    "text",
    ["", "1.5", "1e3", "+1", "01", "1/0", "nan", "inf", "0x1p3", "0x1.8p+0", " 1", "1 ", "1/-2",
     "0X1.0000000000000p+0", "0x1.0000000000000p+1024", "0x2.0000000000000p+0", "٣", "1" * 421, 3,
     None],
)  # fmt: skip
def test_what_is_no_number_text_is_refused(text: Any) -> None:
    with pytest.raises(Refused):
        number(text)


def put(*path: Any) -> Callable[[Any], Callable[[Document], None]]:
    """Return a maker of edits that put a value at a path."""

    def of(value: Any) -> Callable[[Document], None]:
        def edit(document: Document) -> None:
            place = document
            for key in path[:-1]:
                place = place[key]
            place[path[-1]] = value

        return edit

    return of


LAW_AT, CLAIM_AT = ("subjects", 0, "law"), ("subjects", 0, "claims", 0)

WRONG: dict[str, tuple[Callable[[Document], Any], str]] = {
    "another format": (put("format")("x"), "format"),
    "the old version": (put("version")(1), "certify again"),
    "a later version": (put("version")(3), "version 3"),
    "an unknown key": (put("note")("believe me"), "note"),
    "prose in a claim": (put(*CLAIM_AT, "claim")("every start converges"), "claim"),
    "an unknown claim": (put(*CLAIM_AT, "kind")("everything"), "unknown kind"),
    "a float": (put(*CLAIM_AT, "rate")(0.5), "not whole"),
    "a rate below 0": (put(*CLAIM_AT, "rate")("-1"), "rate ≥ 0"),
    "a node of its own": (put("model", "nodes", 3)(["pow", 3, 2]), "index 3 below 3"),
    "a later node": (put("model", "nodes", 4)(["mul", 1, 30]), "index 30 below 4"),
    "an unknown node": (put("model", "nodes", 3)(["abs", 2]), "'abs'"),
    "a power of 65": (put("model", "nodes", 3)(["pow", 2, 65]), "index 65"),
    "a velocity in M": (put("model", "M", 0)([22]), "without velocities"),
    "M with an entry less": (put("model", "M", 1)([20]), "a list of 2"),
    "another position": (put("model", "nodes", 11)(["position", 2]), "index 2 below 2"),
    "no limit above 0": (put("model", "inputs", 0, "limit")("0"), "limit"),
    "two names alike": (put("model", "positions", 1, "name")("theta"), "different names"),
    "a name that is a sentence": (put("model", "positions", 1, "name")("phi converges"), "name"),
    "a layer of 0": (put(*LAW_AT, "layer")(["0"]), "layer"),
    "an unknown switching": (put(*LAW_AT, "switching")("relay"), "switching"),
    "a formula of the law": (put(*LAW_AT, "u")([3]), "'u'"),
    "no subject": (put("subjects")([]), "a list of 1"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_what_is_signed_and_means_nothing_is_refused(name: str) -> None:
    edit, said = WRONG[name]
    with pytest.raises(CertificateError):
        Certificate.from_bytes(edited(edit))
    with pytest.raises(Refused, match=said):
        check(read(edited(edit)))


@pytest.mark.parametrize(
    "content",
    [b"", b"[]", b"{", WRITTEN[:500], WRITTEN.replace(b"0x1.8333", b"0x1.8334", 1),
     WRITTEN.replace(b'"rate": "', b'"rate": "-', 1), b'{"a": ' + b"[" * 20 + b"]" * 20 + b"}",
     b'{"a": 1, "a": 2}', b'{"a": NaN}', b'{"a": 1.0}', b'{"a": "\\u0041"}', b"\xff",
     b" " * 4_000_001],
    ids=["nothing", "a list", "half", "cut off", "a digit", "a sign", "deep", "a key twice", "NaN",
         "a float", "an escape", "no UTF-8", "too large"],
)  # fmt: skip
def test_what_is_damaged_is_refused(content: bytes) -> None:
    with pytest.raises(Refused):
        read(content)


def test_another_mechanism_is_refused() -> None:
    """Other equations under the same name, another value, another limit."""
    certificate = Certificate.from_bytes(WRITTEN)
    cart = ut.mechanisms.cart_pendulum()
    with pytest.raises(CertificateError, match="another mechanism"):
        verify(certificate, cart)
    with pytest.raises(CertificateError, match="'m' of 'rotary_pendulum'"):
        verify(certificate, RIG.with_parameters(m=0.2), own_parameters=True)

    def turned(document: Document) -> None:
        document["model"]["nodes"][18] = ["sin", 11]

    with pytest.raises(CertificateError, match="equations"):
        verify(Certificate.from_bytes(edited(turned)), RIG)


def test_the_law_is_made_of_its_numbers() -> None:
    """Another gain in the file is another law: what was proved of the first is decided again."""

    def weaker(document: Document) -> None:
        document["subjects"][0]["law"]["eta"] = ["1/100"]

    kinds = {c.kind: d.kind for _, c, d in check(read(edited(weaker)))}
    assert kinds["reaching"] == "refuted"
    assert kinds["stability"] == "proved"  # it hangs on the surface alone


# -- what is false --------------------------------------------------------------------------------


def inflated(kind: str, key: str, factor: float) -> Callable[[Document], None]:
    def edit(document: Document) -> None:
        claim = claim_of(document, kind)
        value = claim[key]

        def grown(text: str) -> str:
            return number_text(number(text) * Fraction(factor))

        if isinstance(value, str):
            claim[key] = grown(value)
        elif isinstance(value, list):
            claim[key] = [grown(v) for v in value]
        else:
            claim[key] = {k: [grown(v) for v in ends] for k, ends in value.items()}

    return edit


@pytest.mark.parametrize(
    ("kind", "key", "factor", "verdict"),
    [
        ("stability", "rate", 1.0001, "refuted"),
        ("nonsingular", "ratio", 1.001, "refuted"),
        ("nonsingular", "region", 4.0, "refuted"),
        ("reaching", "disturbance", 1.01, "refuted"),
        ("terminal ellipsoid", "radius", 3.0, "undecided"),
    ],
)
def test_claims_that_say_more_are_not_proved(
    kind: str, key: str, factor: float, verdict: str
) -> None:
    """Each number a little beyond what holds; the sentence states the numbers of the claim."""
    document = read(edited(inflated(kind, key, factor)))
    found = next(d for _, c, d in check(document) if c.kind == kind)
    assert found.kind == verdict
    assert found.why


@pytest.mark.parametrize("seed", range(12))
def test_random_laws_are_judged_as_their_eigenvalues_say(seed: int) -> None:
    """Stability and its rate, by eigenvalues of another code; false ones are never proved."""
    from undertow.law.stability import sliding_matrix

    rng = np.random.default_rng(seed)
    names = sorted(ut.mechanisms.LIBRARY)
    rig = ut.mechanisms.LIBRARY[names[seed % len(names)]]()
    size = 2 * rig.m * rig.n
    surface = ut.Surface.from_vector(
        ut.first_surface(rig).vector * (1 + 0.7 * rng.normal(size=size)), rig.n, rig.m
    )
    margin = -float(np.linalg.eigvals(sliding_matrix(rig, surface)).real.max())
    model, law = model_of(rig), law_of(rig, surface, LAW)
    for factor in (0.0, 0.999, 1.001, 2.0):
        rate = abs(margin) * factor
        kind = decide(model, law, Stability(Fraction(rate))).kind
        if abs(margin - rate) > 1e-6:
            assert kind == ("proved" if rate < margin else "refuted"), (rig.name, factor)


# -- the breaks that an outside look found --------------------------------------------------------


def changed(extra: Any, name: str = "broken") -> ut.Mechanism:
    """The rotary pendulum with a force on φ more."""
    force = RIG.force + sp.Matrix([0, extra])
    return ut.Mechanism(
        name, RIG.coordinates, RIG.inputs, RIG.mass_matrix, force, RIG.input_matrix, RIG.parameters
    )


PHI = RIG.q[1]

KINKS = {
    "|φ|": -3 * sp.Abs(PHI),
    "|φ| sign φ": 3 * sp.Abs(PHI) * sp.sign(PHI),
    "max": 3 * sp.Max(PHI, 0),
    "piecewise": 5 * sp.Piecewise((PHI, PHI > 0), (0, True)),
    "root of a square": 5 * sp.sqrt(PHI**2),
}


def test_the_ball_of_an_ellipsoid_is_the_largest_inside() -> None:
    """ρ/‖W‖₂ by singular values, and not more."""
    for size in (1e-3, 1.0, 1e3):
        W = size * np.random.default_rng(4).normal(size=(4, 4))
        exact = tuple(tuple(Fraction(v) for v in row) for row in W)
        found = terminal_ellipsoid.ball(kernel.TerminalEllipsoid(exact, Fraction(2)))
        largest = 2 / np.linalg.norm(W, 2)
        assert (1 - 1e-9) * largest < found <= largest


@pytest.mark.parametrize("name", KINKS)
def test_a_kinked_model_cannot_be_written(name: str) -> None:
    with pytest.raises(ModelError):
        model_data(changed(KINKS[name]))


def test_a_kink_that_is_written_as_a_root_is_not_defined_at_the_target() -> None:
    """√(φ²) in the file itself: undecided because it is not defined there, for every claim."""

    def kinked(document: Document) -> None:
        model = document["model"]
        start = len(model["nodes"])
        model["nodes"] += [["pow", 11, 2], ["sqrt", start], ["add", 46, start + 1]]
        model["f"][1] = start + 2

    found = {c.kind: d for _, c, d in check(read(edited(kinked)))}
    for kind in ("stability", "terminal ellipsoid"):
        assert found[kind].kind == "undecided"
        assert "undefined" in found[kind].why or "may be 0" in found[kind].why


@pytest.mark.parametrize("shift", [2.0**-13, 1e-9, 2.0**-60, 5e-324])
def test_an_equilibrium_that_is_off_is_seen_however_little(shift: float) -> None:
    """A (1 + x)² − A x² − 2 A x − A is 0 in rational numbers, and rounds to anything in floats."""
    big = sp.Float(2.0**53)
    nothing = big * (1 + PHI) ** 2 - big * PHI**2 - 2 * big * PHI - big
    model = model_of(changed(nothing + sp.Float(shift) * sp.cos(PHI), "off"))
    law = law_of(RIG, SURFACE, LAW)
    found = decide(model, law, Stability(Fraction(0)))
    assert found.kind == "undecided"
    assert "f_u(0, 0) = 0" in found.why
    home = model_of(changed(nothing, "home"))
    assert decide(home, law, Stability(Fraction(0))).kind == "proved"


@pytest.mark.parametrize(
    ("ends", "said"),
    [
        ((0, 0), "at the target"),
        ((-0.125, 0.125), "for |phi| ≤ 0.125 rad"),
        ((0, 0.125), "for phi in [0, 0.125] rad"),
        ((-0.125, 0), "for phi in [-0.125, 0] rad"),
    ],
)
def test_a_region_on_one_side_of_the_target_is_said(ends: tuple[float, float], said: str) -> None:
    """A claim for starts on one side would else read as one for the target alone."""
    positions = Quantity("theta", "rad"), Quantity("phi", "rad")
    box = {"theta": (Fraction(0), Fraction(0)), "phi": (Fraction(ends[0]), Fraction(ends[1]))}
    rest = ", the other coordinates at the target" if any(ends) else ""
    assert words.region_words(positions, box) == said + rest


def test_a_file_has_no_sentence_to_believe() -> None:
    """Texts of the file are not printed: the sentence is the checker's own, of its own numbers."""

    def boast(document: Document) -> None:
        document["made_with"] = {"python": "every start converges"}
        document["model"]["name"] = "proved: every start at rest converges"
        claim_of(document, "stability")["rate"] = "1/2"

    found = check(read(edited(boast)))
    model = read(edited(boast)).model
    said = {c.kind: words.sentence(c, model) for _, c, _ in found}
    assert all("every start" not in text for text in said.values())
    assert "at a rate of at least 0.5 1/s" in said["stability"]
    with pytest.raises(Refused, match="text"):
        check(read(edited(lambda d: claim_of(d, "stability").update(text="every start converges"))))


def test_reaching_ends_at_the_singularity_and_names_its_region() -> None:
    model, law = model_of(RIG), law_of(RIG, SURFACE, LAW)
    load = (Fraction(1, 1000), Fraction(0))

    def over(end: float) -> Reaching:
        return Reaching({"phi": (Fraction(-end), Fraction(end))}, load, (Fraction(1),))

    assert decide(model, law, over(0.9)).kind == "proved"
    assert "|phi| ≤ 0.9 rad" in words.sentence(over(0.9), model)
    far = decide(model, law, over(1.1))
    assert far.kind == "refuted"
    assert "non-singular" in far.why
    tanh = law_of(RIG, SURFACE, ut.ReachingLaw(switching="tanh"))
    region = {"phi": (Fraction(0), Fraction(0))}
    assert decide(model, tanh, Reaching(region, load, (Fraction(0),))).kind == "undecided"


# -- what it is -----------------------------------------------------------------------------------


def code_lines(path: Path) -> int:
    """Lines of code: no blank line, comment or docstring."""
    text = path.read_text(encoding="utf-8")
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef)
    docs = set[int]()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, documented) and ast.get_docstring(node) is not None:
            first = node.body[0]
            docs |= set(range(first.lineno, int(first.end_lineno or 0) + 1))
    lines = enumerate(text.splitlines(), start=1)
    return sum(
        bool(s.strip()) and not s.strip().startswith("#") and i not in docs for i, s in lines
    )


def test_the_kernel_is_small_and_stands_alone() -> None:
    """At most 2,400 lines of code; the standard library, NumPy, numba and itself."""
    folder = ROOT / "src/undertow/proofs/kernel"
    files = sorted(folder.glob("*.py"))
    assert 500 < sum(map(code_lines, files)) <= 2400
    used = set[str]()
    for path in files:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                used |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                used.add(str(node.module))
    assert {u for u in used if u.startswith("undertow")} <= {
        f"undertow.proofs.kernel{end}" for end in ("", *(f".{p.stem}" for p in files))
    }
    assert not used & {"sympy", "scipy", "flint", "mpmath"}


def test_all_compiled_code_is_in_one_file() -> None:
    """numba's cache does not see a change of what a function calls in another file."""
    folder = ROOT / "src/undertow/proofs/kernel"
    assert [p.name for p in sorted(folder.glob("*.py")) if "njit" in p.read_text()] == [
        "compiled.py"
    ]


def test_models_of_the_whole_library_are_read() -> None:
    """Each is written and read again, and M, f and B are those of its own functions."""
    from undertow.proofs.kernel.model import System

    for name, make in ut.mechanisms.LIBRARY.items():
        rig = make()
        model: Model = read_model(json.loads(json.dumps(model_data(rig))))
        law: Law = law_of(rig, ut.first_surface(rig), LAW)
        own = System(model, law)
        x = np.random.default_rng(3).uniform(-0.4, 0.4, 2 * rig.n)
        nodes = [*(v for row in own.M for v in row), *own.f]
        at = np.concatenate([between(x, x), own.fixed()])
        found = own.graph.program(nodes)(at)[:, 0].real
        wanted = [*rig.M(x[: rig.n]).ravel(), *rig.f(x)]
        assert found == pytest.approx(wanted, rel=1e-12, abs=1e-12), name
        assert math.isfinite(found.sum())
    assert copy.copy(model) == model
