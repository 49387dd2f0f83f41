"""What random starts say of a loop, and the options of its proof."""

from __future__ import annotations

import numpy as np
import pytest
from typer.testing import CliRunner

import undertow as ut
from undertow.base import InvalidInputError
from undertow.cli import app
from undertow.law import ReachingLaw
from undertow.proofs.sampled import (
    box_starts,
    failure_bound,
    sampled_extent,
    sampled_region,
)
from undertow.studies.paper.appendix import CASES

RIG = ut.mechanisms.rotary_pendulum(d_e=0.073)
LAW = ReachingLaw()
SURFACE = CASES[3].surface


def test_the_bound_on_failures_covers() -> None:
    """Clopper-Pearson: for every p, the bound is below p in at most 1 − confidence of cases."""
    rng = np.random.default_rng(7)
    for p in (0.001, 0.02, 0.3):
        counts = rng.binomial(500, p, 2000)
        bounds = {k: failure_bound(int(k), 500, 0.95) for k in np.unique(counts)}
        missed = np.mean([bounds[k] < p for k in counts])
        assert missed <= 0.05 + 3 * np.sqrt(0.05 * 0.95 / 2000)
    for trials in (1, 10, 3000):  # where none fails: (1 − p)^N = 1 − confidence
        assert failure_bound(0, trials, 0.95) == pytest.approx(1 - 0.05 ** (1 / trials), rel=1e-9)
    assert failure_bound(7, 7) == 1.0  # of what never succeeds nothing is known
    for failures, trials, confidence in ((3, 2, 0.9), (0, 0, 0.9), (0, 9, 0.0), (0, 9, 1.0)):
        with pytest.raises(InvalidInputError):
            failure_bound(failures, trials, confidence)


def test_sampled_starts_converge_or_are_refuted_with_a_witness() -> None:
    loop = ut.ClosedLoop(RIG, ut.MinimumEnergy(), LAW, tail_rtol=1e-3)
    verdict = sampled_extent(loop, SURFACE, "phi", np.radians(50), grid=100, trials=1000)
    assert verdict.kind == "sampled"
    assert 44 < np.degrees(verdict.details["extent"]) < 45.5
    assert verdict.details["failure_bound"] == pytest.approx(failure_bound(0, 1000), rel=1e-12)
    wide = sampled_region(loop, SURFACE, box_starts(RIG, phi=(-1, 1)), trials=500)
    assert wide.kind == "refuted"
    again = loop.batch(RIG.state(**wide.witness)[None], SURFACE)
    assert not again.reached[0]


@pytest.mark.parametrize(
    ("words", "what"),
    [
        (["--hold", "1"], "without --loop"),
        (["--loop", "--hold", "-1"], "0 to 100"),
        (["--seconds", "0", "--within", "m=5"], "without a region"),
        (["--loop-seconds", "60"], "without --loop"),
        (["--loop", "--loop-seconds", "0"], "in (0, 100000)"),
        (["--loop", "--within", "m=5"], "a held input"),
        (["--loop", "--hold", "1", "--within", "mass=5"], "mass=5"),
        (["--loop", "--hold", "1", "--within", "m=120"], "m=120"),
    ],
)
def test_options_of_the_loops_proof_are_checked_before_work(words: list[str], what: str) -> None:
    answer = CliRunner().invoke(app, ["certify", "rotary_pendulum", *words])
    assert answer.exit_code == 2
    assert what in answer.output
