"""Certificate files: proved again from the file alone; what is damaged or untrue is refused."""

from __future__ import annotations

import ast
import importlib.util
import io
import json
import math
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sympy as sp
from rich.console import Console
from typer.testing import CliRunner

import undertow as ut
from undertow.base import ArtefactError, InvalidInputError, ModelError, Verdict, inward
from undertow.base.errors import CertificateError
from undertow.base.verdict import within
from undertow.cli import app
from undertow.law import Plan
from undertow.models.importers import mechanism_from_file
from undertow.proofs.claims.certificate import (
    Certificate,
    StatedClaim,
    Subject,
    read_certificate,
)
from undertow.proofs.claims.closed_loop import LoopClaim, Starts
from undertow.proofs.claims.model_data import model_of
from undertow.proofs.claims.nonsingular import nonsingular
from undertow.proofs.claims.reaching import ReachingClaim, reaching
from undertow.proofs.claims.region import RegionClaim, reaches, verify_region
from undertow.proofs.claims.stability import hurwitz
from undertow.proofs.claims.terminal_ellipsoid import TerminalEllipsoid
from undertow.proofs.claims.verify import check_settings, match, proved_sets, verify
from undertow.proofs.claims.words import limits_words
from undertow.proofs.claims.written import number_text
from undertow.proofs.gate import GatePolicy, assess
from undertow.proofs.kernel import claims as kernel
from undertow.proofs.kernel.reader import LARGEST, Refused, digest
from undertow.proofs.region.lyapunov import LyapunovFunction
from undertow.proofs.region.motion import SurfaceMotion
from undertow.proofs.search.terminal_ellipsoid import search_for
from undertow.studies.certification import certificate_files, certify_surface, verification_report
from undertow.studies.paper.appendix import CASES, Constants, two_vertex
from undertow.studies.paper.appendix_search import search_rate

pytest.importorskip("flint", reason="the appendix's cases take the extra undertow[appendix]")

RIG = ut.mechanisms.rotary_pendulum()
SURFACE = ut.Surface(-1, -1.59, 1.96, 12.1)
#: V of the sliding dynamics, rounded, and a level at which it is proved in a second.
P = np.array([[30.0, 3.0, -3.0], [3.0, 0.8, 0.4], [-3.0, 0.4, 3.0]])
SQUARES = np.array([[2, 0, 0], [1, 1, 0], [1, 0, 1], [0, 2, 0], [0, 1, 1], [0, 0, 2]])


def quadratic(matrix: np.ndarray, level: float) -> LyapunovFunction:
    values = [matrix[0, 0], 2 * matrix[0, 1], 2 * matrix[0, 2]]
    values += [matrix[1, 1], 2 * matrix[1, 2], matrix[2, 2]]
    return LyapunovFunction(np.eye(3), SQUARES, np.array(values) / level)


def region_claim(level: float, start: float) -> RegionClaim:
    return RegionClaim((quadratic(lyapunov_matrix(), level),), (start, 0.0, 0.0))


def lyapunov_matrix() -> np.ndarray:
    """P of the linear sliding dynamics in y = (φ, φ̇, w)."""
    import scipy.linalg

    from undertow.proofs.region.motion import SurfaceMotion

    A = SurfaceMotion(RIG, SURFACE).jacobian
    return np.asarray(scipy.linalg.solve_continuous_lyapunov(A.T, -np.diag([30.0, 0.3, 3.0])))


@pytest.fixture(scope="module")
def written() -> bytes:
    """A certificate with one claim of each kind that is quick."""
    x0 = RIG.state(phi=0.5)
    one = certify_surface(RIG, SURFACE, x0, seconds=0.0, predict=False)
    region = region_claim(0.02, 0.01)
    verdict = region.decide(RIG, SURFACE, ut.ReachingLaw())
    claims = (*one.subject.claims, StatedClaim(region.stated(RIG, verdict), verdict))
    remark = Verdict("the motion from 30° arrives", "sampled", 0.4)
    subject = Subject(SURFACE, ut.ReachingLaw(), claims, (remark,))
    return Certificate.of(RIG, [subject], {"undertow": "test", "sympy": sp.__version__}).to_bytes()


Edit = Callable[[dict[str, Any]], Any]


def edited(content: bytes, edit: Edit) -> bytes:
    """The file after a change, signed again."""
    document = json.loads(content)
    edit(document)
    document["model_hash"] = digest(document["model"])
    document["checksum"] = digest({k: v for k, v in document.items() if k != "checksum"})
    return json.dumps(document, ensure_ascii=False).encode()


def only(kind: str) -> Edit:
    def keep(document: dict[str, Any]) -> None:
        claims = document["subjects"][0]["claims"]
        document["subjects"][0]["claims"] = [c for c in claims if c["kind"] == kind]

    return keep


@pytest.mark.slow
def test_all_claims_are_proved_again(written: bytes) -> None:
    certificate = Certificate.from_bytes(written)
    assert certificate.to_bytes() == written
    checked = verify(certificate, RIG)
    kinds = {item.claim.kind for item in checked}
    assert kinds >= {
        "stability", "terminal ellipsoid", "nonsingular", "reaching", "surface region"
    }  # fmt: skip
    assert [item.verdict.kind for item in checked] == ["proved"] * len(checked)
    assert not certificate.subjects[0].remarks  # no proofs: the file does not keep them


def test_untrue_regions_meet_the_proof() -> None:
    """A level too high, across the singularity, or without bound; a start that is outside."""

    def claim(matrix: np.ndarray, level: float, start: float = 0.01) -> Verdict:
        function = quadratic(matrix, level)
        return RegionClaim((function,), (start, 0.0, 0.0)).decide(RIG, SURFACE, ut.ReachingLaw())

    good = lyapunov_matrix()
    assert claim(good, 0.02).kind == "proved"
    assert "contains phi = 0.01" in claim(good, 0.02).claim
    high = claim(good, 20.0)
    assert high.kind == "refuted"
    assert high.witness
    assert claim(np.diag([1.0, 1.0, 1.0]), 1.5).kind != "proved"  # beyond arccos ε
    assert "on the line" in claim(good, 0.02, start=0.5).method
    assert claim(np.diag([1.0, 1.0, 0.0]), 0.01).kind == "undecided"


def test_a_region_for_other_plants_alone_is_refused() -> None:
    """A box of parameters must hold the mechanism's own values, and the claim says it."""

    def claim(low: float, high: float) -> Verdict:
        one = replace(region_claim(0.01, 0.01), parameters={"r_o": (low, high)})
        return one.decide(RIG, SURFACE, ut.ReachingLaw())

    near = claim(0.2149, 0.2151)
    assert near.kind == "proved"
    assert "for every r_o in [0.2149, 0.2151]" in near.claim
    with pytest.raises(Refused, match=r"without its 0\.215"):
        claim(0.3, 0.31)


def test_a_file_of_version_1_is_refused_with_what_to_do(tmp_path: Path) -> None:
    old = tmp_path / "certificate.json"
    old.write_text('{"format": "undertow-certificate", "version": 1, "subjects": []}')
    answer = CliRunner(env={"COLUMNS": "300"}).invoke(app, ["verify", str(old)])
    assert answer.exit_code == 1
    assert "version 1" in answer.output
    assert "certify again" in answer.output


def test_what_is_not_proved_has_no_file(tmp_path: Path) -> None:
    """Of an unstable surface there is a certificate that says so, and cannot be saved."""
    falling = ut.Surface(-1, 1.59, 1.96, 12.1)
    certificate = ut.certify(RIG, falling, seconds=0)
    assert "refuted" in str(certificate)
    with pytest.raises(CertificateError, match="no proved claim"):
        certificate.save(tmp_path / "certificate.json")
    with pytest.raises(CertificateError, match="no proved claim"):
        ut.verify(certificate, RIG)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"hold": 1}, "hold: got 1, without loop=True"),
        ({"loop_seconds": 3.0}, "loop_seconds: got 3, without loop=True"),
        ({"uncertain": {"m": (0.1, 0.2)}}, "a region to prove it for"),
        ({"uncertain": {"m": (0.1, 0.2)}, "loop": True}, "a held input"),
    ],
)
def test_a_setting_of_a_proof_that_is_not_asked_for_is_refused(
    settings: dict[str, Any], said: str
) -> None:
    """The certificate would have been the same without it."""
    with pytest.raises(InvalidInputError, match=said):
        ut.certify(RIG, SURFACE, seconds=0, **settings)


def test_what_python_saves_the_command_line_verifies(tmp_path: Path) -> None:
    file = ut.certify(RIG, SURFACE, seconds=0).save(tmp_path / "certificate.json")
    assert ut.verify(file, RIG)
    answer = CliRunner().invoke(app, ["verify", str(file)])
    assert answer.exit_code == 0, answer.output


def test_reaching_a_point_is_proved_in_intervals() -> None:
    V = quadratic(np.diag([4.0, 1.0, 1.0]), 1.0)
    assert reaches(V, [0.4999, 0.0, 0.0])
    assert not reaches(V, [0.5001, 0.0, 0.0])
    assert not reaches(V, [0.1, 0.1])
    # {V ≤ 1} again beyond a ridge is another component.
    ridge = LyapunovFunction(np.eye(1), np.array([[2], [4], [6]]), np.array([4.0, -4.4, 1.21]))
    assert float(ridge([1.35])) < 1 < float(ridge([0.7]))
    assert not reaches(ridge, [1.35])


def test_another_model_is_refused(written: bytes) -> None:
    """Another mechanism, other equations under the same name, a parameter, an input limit."""
    certificate = Certificate.from_bytes(written)
    cart = ut.mechanisms.cart_pendulum()
    with pytest.raises(CertificateError, match="another mechanism"):
        verify(certificate, cart)
    pushed = RIG.disturbed({"phi": sp.Rational(1, 1000) * RIG.x[1]})
    with pytest.raises(CertificateError, match="equations"):
        verify(certificate, pushed)
    with pytest.raises(CertificateError, match=r"got .*friction_theta.*verify --mechanism"):
        verify(certificate, RIG.with_friction(theta=0.02))
    heavier = RIG.with_parameters(m=0.3)
    with pytest.raises(CertificateError, match=r"parameter 'm'.*got 0\.3, .*0\.125"):
        verify(certificate, heavier, own_parameters=True)
    with pytest.raises(CertificateError, match="input limits"):
        verify(certificate, RIG.with_input_limit(10.0))
    # By name alone the file's parameters count, and the proof is about them.
    checked = verify(Certificate.from_bytes(edited(written, only("stability"))), heavier)
    assert checked[0].verdict
    certified = match(certificate, heavier)
    assert {p.name: p.value for p in certified.parameters}["m"] == 0.125


def test_settings_are_those_that_the_proof_is_about(written: bytes) -> None:
    """Of another value, with the one that was proved; of a name that it does not have."""
    certificate = Certificate.from_bytes(written)
    check_settings(certificate, certificate.parameters)
    with pytest.raises(CertificateError, match=r"'m'.*got 0\.3, must be 0\.125, as proved"):
        check_settings(certificate, {"m": 0.3})
    with pytest.raises(CertificateError, match=r"'bananas'.*must be one of the certificate's"):
        check_settings(certificate, {"bananas": 1.0})


def test_a_parameter_changed_and_signed_again_meets_the_proof(written: bytes) -> None:
    """With another length the old numbers are another claim: decided, not believed."""

    def longer(document: dict[str, Any]) -> None:
        only("stability")(document)
        own = next(p for p in document["model"]["parameters"] if p["name"] == "l")
        own["value"] = number_text(Fraction(0.4))

    verdict = verify(Certificate.from_bytes(edited(written, longer)), RIG)[0].verdict
    longer_rig = RIG.with_parameters(l=0.4)
    slowest = [np.linalg.eigvals(SurfaceMotion(one, SURFACE).jacobian).real.max()
               for one in (RIG, longer_rig)]  # fmt: skip
    assert slowest[0] < 0 < slowest[1]
    assert verdict.kind == "refuted"

    def weightless(document: dict[str, Any]) -> None:
        own = next(p for p in document["model"]["parameters"] if p["name"] == "m")
        own["value"] = "-1"

    with pytest.raises(CertificateError, match="parameters of a certificate"):
        verify(Certificate.from_bytes(edited(written, weightless)), RIG)


def test_a_verified_certificate_serves_the_gate(written: bytes) -> None:
    """Its ellipsoid is evidence for its own surface, and only what was proved again counts."""
    checked = verify(Certificate.from_bytes(edited(written, only("terminal ellipsoid"))), RIG)
    sets = proved_sets(RIG, checked)
    assert len(sets) == 1
    x = 1e-4 * np.array([1.0, -1.0, 1.0, 1.0])
    assert sets[0].contains(x)
    assert not sets[0].contains(RIG.state(phi=0.3))
    verdict = assess(ut.ClosedLoop(RIG), Plan.of(SURFACE), x, 20.0, GatePolicy(("region",)), sets)
    assert "proved before" in verdict.method
    doubtful = [replace(item, verdict=Verdict("x", "undecided")) for item in checked]
    assert proved_sets(RIG, doubtful) == ()


def test_proved_sets_are_of_one_mechanism(written: bytes) -> None:
    """What was proved for other parameters is no evidence, in one step or the other."""
    heavy = RIG.with_input_limit(14.0)
    checked = verify(Certificate.from_bytes(edited(written, only("terminal ellipsoid"))), RIG)
    with pytest.raises(CertificateError, match="other equations, parameters or limits"):
        proved_sets(heavy, checked)
    sets, x = proved_sets(RIG, checked), 1e-4 * np.array([1.0, -1.0, 1.0, 1.0])
    verdict = assess(ut.ClosedLoop(heavy), Plan.of(SURFACE), x, 20.0, GatePolicy(("region",)), sets)
    assert "proved before" not in verdict.method


def test_a_claim_of_a_held_input_is_no_set_of_the_continuous_loop(written: bytes) -> None:
    starts: dict[str, Any] = {"starts": {"phi": ["-1/10", "1/10"]}, "plant": {}, "ball": "0"}
    item = verify(Certificate.from_bytes(edited(written, only("stability"))), RIG)[0]
    model = model_of(RIG)
    for period, force, count in (("0", "0", 1), ("1/1000", "0", 0), ("0", "1", 0)):
        data = starts | {"period": period, "disturbance": [force, "0"]}
        claim = kernel.read_claim({"kind": "closed loop", **data}, model)
        assert len(proved_sets(RIG, [replace(item, claim=claim)])) == count


def test_starts_at_rest_are_a_set() -> None:
    box = np.array([[0.0, 0.0], [-0.3, 0.3], [0.0, 0.0], [0.0, 0.0]])
    starts = Starts(box)
    assert starts.contains(RIG.state(phi=-0.3))
    assert not starts.contains(RIG.state(phi=0.31))
    assert not starts.contains(RIG.state(phi=0.1, phi_dot=1e-9))


def test_only_proofs_become_claims() -> None:
    claim = StatedClaim(kernel.Stability(Fraction(1)), Verdict("x", "sampled", 1.0))
    with pytest.raises(CertificateError, match="proved"):
        Certificate.of(RIG, [Subject(SURFACE, ut.ReachingLaw(), (claim,))])


def test_unreadable_and_huge_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(ArtefactError, match="certificate"):
        read_certificate(tmp_path / "nothing.json")
    (tmp_path / "other.py").write_text("import undertow")
    with pytest.raises(CertificateError, match=r"other\.py': got no JSON"):
        read_certificate(tmp_path / "other.py")
    huge = tmp_path / "huge.json"
    for size, said in ((LARGEST + 1, "at most"), (LARGEST, "JSON")):
        with huge.open("wb") as file:
            file.truncate(size)
        with pytest.raises(CertificateError, match=said):
            read_certificate(huge)


# -- what is printed -----------------------------------------------------------------------------


def printed(content: bytes, mechanism: ut.Mechanism = RIG) -> str:
    """What the command line prints of a certificate, on one line."""
    certificate = Certificate.from_bytes(content)
    console = Console(width=4000, record=True, file=io.StringIO())
    console.print(verification_report(certificate, verify(certificate, mechanism)))
    return " ".join(console.export_text().split())


@pytest.mark.parametrize("kind", ["stability", "nonsingular", "reaching", "terminal ellipsoid",
                                  "surface region"])  # fmt: skip
def test_a_verdict_says_what_was_decided(written: bytes, kind: str) -> None:
    line = printed(edited(written, only(kind)))
    words = {
        "stability": "motions on the surface near the target",
        "nonsingular": "the law exists for |phi| ≤ 0.5 rad, the other coordinates at the target",
        "reaching": "the law overcomes every disturbance on theta: ",
        "terminal ellipsoid": "its input renewed at every instant",
        "surface region": "contains phi = 0.01",
    }
    assert words[kind] in line
    assert "alpha_a = [[-1.0]], lambda_a = [[-1.59]], alpha_u = [[1.96]]" in line
    assert "eta = 20.0, layer = 0.1, saturation" in line
    assert "m = 0.125" in line


def test_what_is_decided_is_in_the_sentence() -> None:
    """Another box, load or limit is another sentence; a proof of one says so."""
    box = nonsingular(RIG, SURFACE, {"phi": (-0.1, 0.25)})
    assert "phi in [-0.1, 0.25] rad" in box.claim
    claim = ReachingClaim({"phi": (-0.5, 0.5)}, (0.0,), (0.001, 0.0))
    load = claim.decide(RIG, SURFACE, ut.ReachingLaw())
    assert "on theta: 0.001 N m at most" in load.claim
    assert "for |phi| ≤ 0.5 rad, the other coordinates at the target" in load.claim
    assert (
        "the plant the model, the inputs renewed at every instant and not limited; motions that "
        "leave these positions are not covered" in load.claim
    )
    weak = RIG.with_input_limit(12.345678901)
    search = search_for(weak, SURFACE, ut.ReachingLaw())
    assert search is not None
    found = search.largest()
    assert found is not None
    assert "|voltage| ≤ 12.345678901 V" in found.decide(weak, SURFACE, ut.ReachingLaw()).claim


def test_margins_are_rounded_towards_zero() -> None:
    """No more is printed than was proved, whatever the last digit."""
    known = {3.71689: "3.716", 0.99999: "0.9999", 0.5: "0.5", -1.23459: "-1.234"}
    for value, text in known.items():
        assert inward(value) == text
    assert within(0.95 * 0.125, 1.05 * 0.125) == "[0.11875, 0.13125]"
    assert within(-0.87266462, 0.87266462) == "[-0.872664, 0.872664]"
    assert within(0.12345678, 0.12345679) == "[0.12345678, 0.12345679]"
    rng = np.random.default_rng(0)
    for value in 10.0 ** rng.uniform(-12, 12, 300) * rng.choice([-1.0, 1.0], 300):
        for digits in (1, 4, 6):
            shown = float(inward(value, digits))
            assert abs(shown) <= abs(value)
            assert abs(value - shown) <= 10.0 ** (1 - digits) * abs(value)
    proof = hurwitz(RIG, SURFACE)
    shown = float(str(proof).split("margin ")[1].split()[0])
    assert proof.margin * (1 - 1e-3) <= shown <= proof.margin


# -- models that are not what they seem ------------------------------------------------------------


def kinked(extra: sp.Expr) -> ut.Mechanism:
    """The rotary pendulum with a torque on the pendulum that has a kink at the target."""
    force = RIG.force + sp.Matrix([0, extra])
    return replace(RIG, name="kinked", force=sp.ImmutableDenseMatrix(force))


TILT = RIG.q[1]
KINKS = {
    "Abs": -3 * sp.Abs(TILT),
    "Abs times sign": 3 * sp.Abs(TILT) * sp.sign(TILT),
    "Max": 3 * sp.Max(TILT, 0),
    "Max and Min": 3 * sp.Max(0, TILT) + 3 * sp.Min(0, TILT),
    "Piecewise": 5 * sp.Piecewise((TILT, TILT > 0), (0, True)),
    "Piecewise the other way": 5 * sp.Piecewise((0, sp.Not(TILT > 0)), (TILT, True)),
    "Piecewise of three": sp.Piecewise((-TILT, TILT < 0), (0, sp.Eq(TILT, 0)), (TILT, True)),
    "Heaviside": TILT * sp.Heaviside(TILT),
    "a root": 5 * sp.sqrt(TILT**2),
    "a root of a square in disguise": sp.sqrt(TILT**2 + 2 * TILT * RIG.q[0] + RIG.q[0] ** 2),
    "a root of sines": sp.sqrt(sp.sin(TILT) ** 2 + 0.0 * TILT),
    "a fourth root": (TILT**4) ** sp.Rational(1, 4),
    "arccos of cos": sp.acos(sp.cos(TILT)),
    "a kink in the mass's slope": sp.sin(sp.Abs(RIG.x[3])) * RIG.x[3],
    "drag, a kink that a factor softens": -0.01 * sp.Abs(RIG.x[3]) * RIG.x[3],
    "arccot, which jumps at 0": -3 * TILT * sp.acot(TILT),
    "arctan of cot": TILT * sp.atan(sp.cot(TILT)),
    "a pole in disguise": TILT * sp.tanh(sp.tan(TILT + sp.pi / 2)),
    "Abs of sin": sp.Abs(sp.sin(TILT)) + TILT**2,
}


@pytest.mark.parametrize("name", KINKS)
def test_a_model_with_a_kink_is_refused_by_every_claim(name: str) -> None:
    """SymPy's derivative of |x| at 0 is 0; a proof with it "held" for a pendulum that falls."""
    model = kinked(KINKS[name])
    law = ut.ReachingLaw()
    ellipsoid = TerminalEllipsoid(np.eye(4), np.eye(4), 0.01)
    loop = LoopClaim(
        {"starts": {}, "period": "0", "plant": {}, "disturbance": ["0"] * 2, "ball": "0"}
    )
    box = {"phi": (-0.1, 0.1)}
    for decide in (
        lambda: hurwitz(model, SURFACE),
        lambda: nonsingular(model, SURFACE, box),
        lambda: reaching(model, SURFACE, box),
        lambda: verify_region(SurfaceMotion(model, SURFACE), quadratic(np.eye(3), 0.01)),
        lambda: ellipsoid.decide(model, SURFACE, law),
        lambda: loop.decide(model, SURFACE, law),
        lambda: certify_surface(model, SURFACE, np.zeros(4), seconds=0.0, predict=False),
    ):
        with pytest.raises(ModelError, match="not smooth"):
            decide()


def test_a_kink_of_parameters_alone_is_none() -> None:
    """|m| is a number, and x**2.0 is x²."""
    mass = RIG.parameters[2].symbol
    smooth = kinked(0.001 * sp.Abs(mass - 1) * TILT + 0.001 * TILT**3.0)
    assert hurwitz(smooth, SURFACE)


X = sp.Symbol("x", real=True)


@pytest.mark.parametrize("shift", [2.0**-13, 2.0**-9])
def test_an_equilibrium_that_is_off_is_not_rounded_home(shift: float) -> None:
    """Floats of 53 bits lose the shift beside 2⁵³; in rationals it is there, and nothing proved."""
    big = float(2.0 ** np.ceil(np.log2(shift * 2.0**53.9)))
    rest = big * (1 + X) ** 2 - big * X**2 - 2 * big * X - big + shift * sp.cos(X)
    # No claim about the target, which is no equilibrium.
    off = kinked(rest.xreplace({X: TILT}))
    assert not hurwitz(off, SURFACE)
    assert not verify_region(SurfaceMotion(off, SURFACE), quadratic(np.eye(3), 0.01))
    found = TerminalEllipsoid(np.eye(4), np.eye(4), 1e-3)
    assert "f_u(0, 0) = 0" in found.decide(off, SURFACE, ut.ReachingLaw()).method


def test_reaching_names_its_region_and_ends_at_the_singularity() -> None:
    """Beyond arccos ε = 58° there is no law that could overcome anything."""
    inside = reaching(RIG, SURFACE, {"phi": (-0.9, 0.9)}, eta=1.0, disturbance=[0.001, 0.0])
    assert inside.verdict
    assert "|phi| ≤ 0.9 rad" in inside.verdict.claim
    across = reaching(RIG, SURFACE, {"phi": (-1.1, 1.1)}, eta=1.0, disturbance=[0.001, 0.0])
    assert across.verdict.kind == "refuted"
    assert "exist" in across.verdict.method
    assert abs(across.verdict.witness["phi"]) > 1.0
    assert across.scale == 0.0
    assert [bound.proved for bound in across.largest] == [0.0, 0.0]


def test_an_interval_beyond_the_singular_angle_is_refuted_wherever_its_end_is() -> None:
    """cos 31.2 > ε, but R does not exist on the way there."""
    case = CASES[3]
    P, _ = search_rate(case.reduced(Constants.of(RIG)), case.half_width)
    reduced = case.reduced(Constants.of(RIG))
    assert two_vertex(reduced, P, case.half_width)
    for width in (31.2, 6.3, 1.2, 3.2):
        assert two_vertex(reduced, P, width).kind == "refuted"
    with pytest.raises(InvalidInputError, match="half-width"):
        two_vertex(reduced, P, -0.5)


# -- independence ------------------------------------------------------------------------------


def imports_of(module: str) -> set[str]:
    """Modules that a module's own text imports, wherever in it."""
    spec = importlib.util.find_spec(module)
    assert spec is not None
    assert spec.origin is not None
    found = set()
    for node in ast.walk(ast.parse(Path(spec.origin).read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            names = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= {node.module} | {n for n in names if _is_module(n)}
    return found


def _is_module(name: str) -> bool:
    try:
        return name.startswith("undertow") and importlib.util.find_spec(name) is not None
    except ModuleNotFoundError:
        return False


def test_the_verifier_shares_nothing_with_the_searches() -> None:
    """All that it reaches: no search, no linear program, no semidefinite or other optimiser."""
    todo, seen = ["undertow.proofs.claims.verify"], set[str]()
    while todo:
        module = todo.pop()
        if module in seen:
            continue
        seen.add(module)
        # Package files that only collect names are not what is used of a package.
        if module.split(".")[0] == "undertow" and module not in (
            "undertow", "undertow.proofs", "undertow.models.importers", "undertow.mechanisms"
        ):  # fmt: skip
            todo += imports_of(module)
    ours = {name for name in seen if name.startswith("undertow")}
    assert "undertow.proofs.kernel.region" in ours
    assert not [n for n in ours if "search" in n or "optimis" in n or "linear_program" in n]
    foreign = seen - ours
    assert not [n for n in foreign if n.split(".")[0] in ("clarabel", "cvxpy", "cmaes", "casadi")]
    assert not [n for n in foreign if n.startswith(("scipy.optimize", "scipy.stats"))]


# -- the command line --------------------------------------------------------------------------


OWN = """
import undertow as ut

def make():
    return ut.mechanisms.rotary_pendulum().with_parameters(m={m})

number = 3
"""


def test_certify_and_verify_from_the_command_line(tmp_path: Path) -> None:
    """0 for proved, 1 for a file that is not, 2 for a wrong request; own mechanisms too."""
    run = CliRunner(env={"COLUMNS": "140"}).invoke
    out = tmp_path / "proof"
    words = ["certify", "rotary_pendulum", "--start", "phi=20deg", "--seconds", "0"]
    surface = ["--surface", "lambda_a=-1.59 alpha_u=1.96 lambda_u=12.1"]
    answer = run(app, [*words, *surface, "--out", str(out)])
    assert answer.exit_code == 0, answer.output
    assert "disturbance on theta" in answer.output
    file = out / "certificate.json"
    answer = run(app, ["verify", str(file)])
    assert answer.exit_code == 0, answer.output
    assert "claims proved again" in answer.output
    assert run(app, ["verify", str(file), "--set", "m=0.125"]).exit_code == 0
    changed = run(app, ["verify", str(file), "--set", "m=0.126"])
    assert changed.exit_code == 1
    assert "0.126" in changed.output
    assert run(app, ["verify", str(file), "--mechanism", "cart_pendulum"]).exit_code == 1
    for m, code in ((0.125, 0), (0.126, 1)):
        (tmp_path / "model.py").write_text(OWN.format(m=m))
        answer = run(app, ["verify", str(file), "--mechanism", f"{tmp_path}/model.py:make"])
        assert answer.exit_code == code, answer.output
    (out / "edited.json").write_bytes(file.read_bytes().replace(b"0x1.8333", b"0x1.8334", 1))
    damaged = run(app, ["verify", str(out / "edited.json")])
    assert damaged.exit_code == 1
    assert "checksum" in damaged.output
    unstable = ["--surface", "lambda_a=1.59 alpha_u=1.96 lambda_u=12.1"]
    assert run(app, [*words, *unstable]).exit_code == 1
    assert run(app, ["certify"]).exit_code == 2
    assert run(app, ["certify", "rotary_pendulum", "--appendix"]).exit_code == 2


BAR = """
import sympy as sp
import undertow as ut

x, tilt = ut.Coordinate("x", "m"), ut.Coordinate("tilt")
v, w, a = x.velocity, tilt.velocity, tilt.symbol
bar = ut.Mechanism.from_energies(
    "sprung_bar", [x, tilt], [ut.Input("force", "N", 10.0)],
    kinetic=1.1 * v**2 / 2 + 0.075 * sp.cos(a) * v * w + 0.0125 * w**2,
    potential=0.73575 * sp.cos(a) + 0.1 * a**2, start={"tilt": 0.2},
)
"""


@pytest.mark.slow
def test_a_mechanism_of_ones_own_is_certified_and_verified(tmp_path: Path) -> None:
    """Nothing of the library is needed: the file brings the model both times."""
    run = CliRunner().invoke
    model, out = tmp_path / "model.py", tmp_path / "proof"
    model.write_text(BAR)
    words = ["certify", f"{model}:bar", "--seconds", "0", "--out", str(out)]
    answer = run(app, words)
    assert answer.exit_code == 0, answer.output
    file = str(out / "certificate.json")
    assert run(app, ["verify", file, "--mechanism", f"{model}:bar"]).exit_code == 0
    answer = run(app, ["verify", file])  # the file holds its model
    assert answer.exit_code == 0
    assert "the model is the file's own, not compared" in " ".join(answer.output.split())
    model.write_text(BAR.replace("0.1 * a**2", "0.2 * a**2"))
    answer = run(app, ["verify", file, "--mechanism", f"{model}:bar"])
    assert answer.exit_code == 1
    assert "equations" in answer.output


def test_own_mechanisms_are_loaded_or_named(tmp_path: Path) -> None:
    model = tmp_path / "model.py"
    model.write_text(OWN.format(m=0.2))
    assert mechanism_from_file(f"{model}:make").parameter_values[2] == 0.2
    for text in ("model.py", f"{model}:number", f"{model}:absent"):
        with pytest.raises(InvalidInputError):
            mechanism_from_file(text)
    model.write_text("1 / 0")
    with pytest.raises(ArtefactError, match="ZeroDivisionError"):
        mechanism_from_file(f"{model}:make")


@pytest.mark.parametrize("name", ["cart_pendulum", "overhead_crane", "gantry_crane", "tora"])
def test_other_mechanisms_get_certificates(name: str) -> None:
    """Written, read, proved again: stability and a terminal set of the full loop, at least."""
    rig = ut.mechanisms.LIBRARY[name]()
    one = certify_surface(
        rig, ut.first_surface(rig), rig.state(**rig.start), seconds=0.0, predict=False
    )
    content = certificate_files(rig, [one])["certificate.json"]
    checked = verify(Certificate.from_bytes(content), ut.mechanisms.LIBRARY[name]())
    assert {"stability", "terminal ellipsoid"} <= {item.claim.kind for item in checked}
    assert all(item.verdict for item in checked)


def test_an_input_without_a_limit_is_said_to_have_none() -> None:
    """It read |voltage| ≤ inf V."""
    assert limits_words(model_of(RIG.with_input_limit(math.inf))) == "no limit on voltage"
    assert limits_words(model_of(RIG.with_input_limit(2.5))) == "|voltage| ≤ 2.5 V"
