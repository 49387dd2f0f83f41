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
from mechanism_motions import STEP, Claimed, claims
from undertow.law import ReachingLaw, SlidingModeLaw
from undertow.proofs import read_certificate, verify
from undertow.proofs.claims.model_data import law_of, model_of
from undertow.proofs.kernel.claims import ClosedLoop, decide, read_claim
from undertow.proofs.kernel.reader import read

KEPT = {p.stem: p for p in (Path(__file__).parents[1] / "data/mechanism_loops").glob("*.json")}

#: Quick ones, of one input and of two.
QUICK = ("tora", "ball_and_beam")


def kept(name: str) -> Claimed:
    (claim,) = claims(json.loads(KEPT[name].read_text()))
    return claim


def test_six_mechanisms_and_more_have_a_kept_claim() -> None:
    """One of them has three positions, one two inputs; the model is that of the library."""
    sizes = set()
    for name, path in KEPT.items():
        rig = ut.mechanisms.LIBRARY[name]()
        document = read(path.read_bytes())
        assert document.model == model_of(rig)
        (subject,) = document.subjects
        assert subject.law == law_of(rig, ut.first_surface(rig), ReachingLaw())
        sizes.add((rig.n, rig.m))
    assert len(KEPT) >= 6
    assert "rotary_pendulum" not in KEPT
    assert {n for n, _ in sizes} >= {2, 3}
    assert {m for _, m in sizes} == {1, 2}


def proved(name: str) -> None:
    rig = ut.mechanisms.LIBRARY[name]()
    (item,) = verify(read_certificate(KEPT[name]), rig)
    assert item.verdict, item.verdict
    assert "every motion from starts with" in item.verdict.claim
    assert "renewed at every instant, the plant the model, no other force" in item.verdict.claim


def test_a_claim_about_starts_of_full_dimension_is_proved_from_its_file() -> None:
    assert (kept("tora").starts[:, 1] > 0).all()
    proved("tora")


@pytest.mark.slow  # up to two minutes of one core each
@pytest.mark.parametrize("name", sorted(KEPT))
def test_kept_loops_are_proved_from_their_files(name: str) -> None:
    proved(name)


# -- by simulation ---------------------------------------------------------------------------------


@pytest.mark.parametrize("name", sorted(KEPT))
def test_the_motions_are_those_of_the_mechanism(name: str) -> None:
    """The graph and the law in NumPy against the mechanism's compiled ones, clip and layer too."""
    claim, rig = kept(name), ut.mechanisms.LIBRARY[name]()
    law, n = SlidingModeLaw(rig, ut.first_surface(rig), ReachingLaw()), rig.n
    rng = np.random.default_rng(0)
    size = np.where(rng.random((200, 1)) < 0.5, 1.0, 0.01) * claim.starts[:, 1].max()
    x = rng.uniform(-1, 1, (200, 2 * n)) * size
    u = law(0.0, x)
    wanted = np.concatenate([x[:, n:], rig.accelerations(0.0, x, u.u)], axis=1)
    assert claim.rates(x) == pytest.approx(wanted, rel=1e-8, abs=1e-8)
    assert (np.abs(u.demand) > rig.input_limits).any() or name in QUICK


@pytest.mark.parametrize("name", sorted(KEPT))
def test_steps_are_fine_enough(name: str) -> None:
    """From a corner, against another method to 1e-10: clip and edge of the layer are passed."""
    claim = kept(name)
    x = claim.starts[None, :, 1].copy()
    end = solve_ivp(
        lambda t, y: claim.rates(y[None])[0], (0.0, 0.5), x[0], "DOP853", rtol=1e-10, atol=1e-12
    ).y[:, -1]
    for _ in range(round(0.5 / STEP)):
        x = claim.moved(x, STEP)
    assert x[0] == pytest.approx(end, rel=1e-3, abs=1e-3 * np.abs(claim.starts).max())


@pytest.mark.parametrize("name", QUICK)
def test_motions_from_the_edges_of_quick_claims_come_home(name: str) -> None:
    assert kept(name).tried(np.random.default_rng(1), 40) == 0


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(KEPT))
def test_motions_from_the_edges_of_all_claims_come_home(name: str) -> None:
    assert kept(name).tried(np.random.default_rng(1), 400) == 0


# -- what is false ---------------------------------------------------------------------------------


def own(name: str) -> tuple[ClosedLoop, Path]:
    document = read(KEPT[name].read_bytes())
    (data,) = document.subjects[0].claims
    claim = read_claim(data, document.model)
    assert isinstance(claim, ClosedLoop)
    return claim, KEPT[name]


@pytest.mark.parametrize(("name", "size"), [("tora", 4), ("ball_and_beam", 3)])
def test_starts_that_do_not_come_home_are_not_proved(name: str, size: int) -> None:
    """Beyond what simulation brings home, from the outermost of the starts alone."""
    claim, path = own(name)
    assert kept(name).tried(np.random.default_rng(2), 40, size) > 0
    document = read(path.read_bytes())
    model, law = document.model, document.subjects[0].law
    far = {k: (size * b, size * b) for k, (_, b) in claim.starts.items()}
    found = decide(model, law, replace(claim, starts=far, cuts={}))
    assert found.kind == "undecided"
    assert "a tube is lost" in found.why


@pytest.mark.parametrize("name", sorted(KEPT))
def test_a_terminal_set_beyond_the_input_limit_is_not_proved(name: str) -> None:
    """Motors a hundred times weaker: the demand of the same set passes their limit."""
    claim, path = own(name)
    document = read(path.read_bytes())
    weak = tuple(
        replace(i, value=None if i.value is None else i.value * Fraction(1, 100))
        for i in document.model.inputs
    )
    model = replace(document.model, inputs=weak)
    found = decide(model, document.subjects[0].law, claim)
    assert found.kind == "undecided"
    assert "the terminal set" in found.why
    weaker = kept(name)
    inputs = [{**i, "limit": float(w.value or 0).hex()}
              for i, w in zip(weaker.model["inputs"], weak, strict=True)]  # fmt: skip
    data = replace(weaker, model={**weaker.model, "inputs": inputs})
    x = data.starts[None, :, 1].copy()
    limits = data.numbers[-1]
    assert (limits < kept(name).numbers[-1]).all()
    assert not data.inside(x).all() or name == "tora"
