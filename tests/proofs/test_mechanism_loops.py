"""Kept claims about whole closed loops of other mechanisms than the rotary pendulum."""

from __future__ import annotations

import json
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import undertow as ut
from mechanism_motions import COARSER, STEP, Claimed, claims
from support import rest_slow
from undertow.law import ReachingLaw, SlidingModeLaw
from undertow.models import FloatArray
from undertow.proofs import read_certificate, verify
from undertow.proofs.claims.model_data import law_of, model_of
from undertow.proofs.kernel.claims import ClosedLoop, Decision, decide, read_claim
from undertow.proofs.kernel.model import Law
from undertow.proofs.kernel.reader import read

KEPT = {p.stem: p for p in (Path(__file__).parents[1] / "data/mechanism_loops").glob("*.json")}


def kept(name: str) -> list[Claimed]:
    return claims(json.loads(KEPT[name].read_text()))


def numbers(law: Law) -> list[float]:
    parts = law.alpha_a, law.lambda_a, law.alpha_u, law.lambda_u, law.eta, law.layer
    return [float(v) for part in parts for v in np.array(part, dtype=float).flat]


def test_mechanisms_of_several_sizes_have_kept_claims() -> None:
    """At least six, one with n = 3 and one with m = 2; model and law are those of the library."""
    sizes = []
    for name, path in KEPT.items():
        rig = ut.mechanisms.LIBRARY[name]()
        document = read(path.read_bytes())
        assert document.model == model_of(rig)
        (subject,) = document.subjects
        designed = law_of(rig, ut.first_surface(rig), ReachingLaw())
        of_file, of_library = numbers(subject.law), numbers(designed)
        # A processor's linear algebra decides the last digits of a design.
        np.testing.assert_allclose(of_file, of_library, rtol=1e-12)
        assert subject.law.switching == designed.switching
        assert subject.law.disturbance == designed.disturbance
        assert {claim["kind"] for claim in subject.claims} == {"closed loop"}
        sizes.append((rig.n, rig.m))
    assert len(KEPT) >= 6
    assert "rotary_pendulum" not in KEPT
    assert 3 in {n for n, _ in sizes}
    assert 2 in {m for _, m in sizes}


def test_a_file_tells_the_parameters_and_limits_that_it_is_about() -> None:
    """Those that are zero, too."""
    rig = ut.mechanisms.reaction_wheel_pendulum()
    certificate = read_certificate(KEPT["reaction_wheel_pendulum"])
    assert certificate.parameters == {p.name: p.value for p in rig.parameters}
    assert 0.0 in certificate.parameters.values()
    assert certificate.input_limits == tuple(rig.input_limits)


def proved(name: str) -> None:
    items = verify(read_certificate(KEPT[name]), ut.mechanisms.LIBRARY[name]())
    assert items
    for item in items:
        assert item.verdict, item.verdict
        assert item.verdict.claim.startswith("every motion from starts with")
        for words in ("renewed at every instant, the plant the model, no other force",
                      "exists for ever and converges to the target"):  # fmt: skip
            assert words in item.verdict.claim


def test_starts_of_full_dimension_are_proved_from_their_file() -> None:
    """What is decided is the half of each state's interval, without a cut."""
    assert (kept("tora")[0].starts[:, 1] >= [0.284, 0.1136, 0.426, 0.142]).all()
    assert (kept("cart_pendulum")[1].starts[:, 1] >= [0.0568, 0.1136, 0.1136, 0.1136]).all()
    document = read(KEPT["tora"].read_bytes())
    claim = read_claim(document.subjects[0].claims[0], document.model)
    assert isinstance(claim, ClosedLoop)
    half = {k: (low / 2, high / 2) for k, (low, high) in claim.starts.items()}
    found = decide(document.model, document.subjects[0].law, replace(claim, starts=half, cuts={}))
    assert found.kind == "proved", found.why


@pytest.mark.slow  # up to a minute of one core each
@pytest.mark.parametrize("name", sorted(KEPT))
def test_kept_loops_are_proved_from_their_files(name: str) -> None:
    proved(name)


# -- by simulation --------------------------------------------------------------------------------


@pytest.mark.parametrize("name", sorted(KEPT))
def test_the_motions_are_those_of_the_mechanism(name: str) -> None:
    """The graph and the law in NumPy against the mechanism's own, clip and layer too."""
    claim, rig = kept(name)[0], ut.mechanisms.LIBRARY[name]()
    law, n = SlidingModeLaw(rig, ut.first_surface(rig), ReachingLaw()), rig.n
    rng = np.random.default_rng(0)
    size = np.where(rng.random((200, 1)) < 0.5, 1.0, 0.01) * claim.starts[:, 1].max()
    x = rng.uniform(-1, 1, (200, 2 * n)) * size * np.repeat([1.0, 30.0], n)
    u = law(0.0, x)
    wanted = np.concatenate([x[:, n:], rig.accelerations(0.0, x, u.u)], axis=1)
    assert claim.rates(x) == pytest.approx(wanted, rel=1e-8, abs=1e-8)
    assert (np.abs(u.demand) > rig.input_limits).any()


def finely(claim: Claimed, x: FloatArray, duration: float) -> FloatArray:
    def rate(t: float, x: FloatArray) -> FloatArray:
        found: FloatArray = claim.rates(x[None])[0]
        return found

    found = solve_ivp(rate, (0.0, duration), x, method="DOP853", rtol=1e-10, atol=1e-12)
    return np.asarray(found.y[:, -1])


@pytest.mark.parametrize("name", rest_slow(sorted(KEPT), "tora"))
def test_steps_are_fine_enough(name: str) -> None:
    """From the outermost start, by another method to 1e-10, over clip and edge of the layer."""
    for claim in kept(name):
        x = claim.starts[None, :, 1].copy()
        end = finely(claim, x[0], 0.3)
        for _ in range(round(0.3 / STEP)):
            x = claim.moved(x, STEP)
        assert x[0] == pytest.approx(end, rel=1e-3, abs=1e-3 * np.abs(end).max())


@pytest.mark.parametrize("name", rest_slow(["tora", "ball_and_beam"], "tora"))
def test_motions_from_the_edges_of_quick_claims_come_home(name: str) -> None:
    for claim in kept(name):
        assert claim.tried(np.random.default_rng(1), 40, COARSER * STEP) == 0


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(KEPT))
def test_motions_from_the_edges_of_all_claims_come_home(name: str) -> None:
    for claim in kept(name):
        assert claim.tried(np.random.default_rng(1), 400) == 0


# -- what is false --------------------------------------------------------------------------------


def changed(name: str, size: int = 1, power: int = 1) -> tuple[Decision, Claimed, FloatArray]:
    """Decide a claim about starts so many times as large alone, or with motors so much weaker.

    Also: the same for the simulator, and the outermost of these starts.
    """
    document = read(KEPT[name].read_bytes())
    claim = read_claim(document.subjects[0].claims[0], document.model)
    assert isinstance(claim, ClosedLoop)
    far = {k: (size * b, size * b) for k, (_, b) in claim.starts.items()}
    weak = tuple(
        replace(i, value=None if i.value is None else i.value * Fraction(1, power))
        for i in document.model.inputs
    )
    model = replace(document.model, inputs=weak)
    law = document.subjects[0].law
    found = decide(model, law, replace(claim, starts=far, cuts={}))
    (simulated, *_) = kept(name)
    limits = [{"limit": None if i.value is None else str(i.value)} for i in weak]
    simulated = replace(simulated, model={**simulated.model, "inputs": limits})
    return found, simulated, size * simulated.starts[None, :, 1]


@pytest.mark.slow  # motions that go on for 20 s
@pytest.mark.parametrize(
    ("name", "size", "power"),
    [("tora", 4, 1), ("cart_pendulum", 2, 1), ("wheeled_inverted_pendulum", 2, 1),
     ("cart_pendulum", 1, 20)],
)  # fmt: skip
def test_what_does_not_come_home_is_not_proved(name: str, size: int, power: int) -> None:
    found, simulated, x = changed(name, size, power)
    assert simulated.failed(x, COARSER * STEP).all()
    assert found.kind == "undecided"


@pytest.mark.parametrize("name", sorted(KEPT))
def test_nothing_is_proved_of_motors_that_are_too_weak(name: str) -> None:
    """A hundred times weaker: the terminal set is none, or motions do not reach it."""
    found, _, _ = changed(name, power=100)
    assert found.kind == "undecided"
    assert "an input limit is met" in found.why or "a tube is lost" in found.why
