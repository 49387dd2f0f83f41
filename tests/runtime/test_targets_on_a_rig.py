"""Set-points on a rig: the target jumps with the first plan for it, and the log tells it again."""

from __future__ import annotations

import math
import sqlite3
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import undertow as ut
from runs import short_searches
from undertow.base import InvalidInputError
from undertow.law import ReferenceMotion
from undertow.plants import IdealRig, RealisticRig
from undertow.runtime import Recipe, Request, Settings, session

CRANE = ut.mechanisms.overhead_crane()
POINTS = ut.SetPoints([(0, {"x": 0.4}), (2.5, {"x": -0.3})])


@pytest.fixture(scope="module")
def cascade() -> ut.Cascade:
    """Fast, with short searches."""
    objective = ut.objective_for(CRANE, "bench-time", horizon=8.0)
    return ut.Cascade(CRANE, objective, cold=ut.Budget(600), warm=ut.Budget(96), belief="exact")


@pytest.mark.slow
def test_a_run_goes_from_set_point_to_set_point_and_is_replayed(tmp_path: Path) -> None:
    """Each jump at its time, each with a plan of its own; bit for bit from the log, judged too."""
    log = tmp_path / "run.db"
    recipe = Recipe(
        "overhead_crane", start=(-0.2, 0, 0, 0), objective="bench-time", horizon=8.0,
        evaluations=256, target=POINTS.pairs, settings=Settings(lead_time=0.5),
    )  # fmt: skip
    with session(recipe, log=log, simulated=True) as runtime:
        report = runtime.run(6.0)
    assert report.verdict.ending == "balanced"
    jumps = [(t, text) for t, what, text in report.events if what == "target"]
    assert [text for _, text in jumps] == ["jumps, asked for at 2.5 s"]
    assert jumps[0][0] == pytest.approx(2.5, abs=0.003)
    assert report.final_error < 0.12
    with sqlite3.connect(log) as book:
        (x,) = book.execute("SELECT x FROM steps ORDER BY k DESC LIMIT 1").fetchone()
    assert abs(x + 0.3) < 0.12  # absolute, as the rig measures it
    found = ut.replay(log)
    assert found.identical
    assert found.misjudged == 0


def test_a_target_past_the_travel_is_refused_before_the_rig_is_read(cascade: ut.Cascade) -> None:
    rig = IdealRig(ut.mechanisms.rotary_pendulum())
    rig.mechanism = CRANE  # as a rig of a crane says it: nothing is compiled for one that stands
    with pytest.raises(InvalidInputError, match="got x = 2 m"):
        ut.run(cascade, rig, seconds=1.0, x0=CRANE.state(), simulated=True, target={"x": 2.0})
    with pytest.raises(InvalidInputError, match=r"got 2.5 s, must be before the end of the run"):
        ut.run(cascade, rig, seconds=1.0, x0=CRANE.state(), simulated=True, target=POINTS)


@short_searches()
def test_a_jump_is_planned_on_the_estimate_of_its_request() -> None:
    """The slow loop's first plan for a new target, predicted for the plant that was learnt."""
    start = (0.0, 0.1, 0.0, 0.0)
    recipe = Recipe(start=start, objective="bench-energy", evaluations=64)
    memory, known = recipe.first(), recipe.cascade.known
    assert memory.estimate is not None
    assert known is not None
    heavy = replace(memory.estimate, offset=np.full(len(memory.estimate.offset), 0.5))
    there, x = ReferenceMotion.at_rest(np.array([0.6, 0.0])), recipe.belief.state(phi=0.05)
    before, after = (
        recipe.respond(Request(0.0, x, 0.1, replace(memory, estimate=estimate), -1, there))
        for estimate in (memory.estimate, heavy)
    )
    assert before.jump
    assert after.jump
    assert after.memory.estimate is heavy
    loop = recipe.cascade.loop_at(after.memory)
    exact = replace(recipe.cascade, mechanism=known.believed(heavy), belief="exact")
    judged = exact.loop.batch(np.array(after.memory.x), after.memory.plan, precise=True).cost[0]
    believed = known.believed(heavy)
    assert np.array_equal(loop.mechanism.parameter_values, believed.parameter_values)
    assert after.memory.predicted == pytest.approx(judged, rel=0.1)
    assert abs(before.memory.predicted - judged) > 0.1 * judged


def test_a_recipe_with_a_target_is_data() -> None:
    """Through JSON values and back."""
    recipe = Recipe("overhead_crane", target=POINTS.pairs)
    again = Recipe.from_dict(recipe.as_dict())
    assert again == recipe
    assert [begin for begin, _ in again.legs] == [0.0, 2.5]
    assert np.allclose(again.legs[1][1].state(9.0), CRANE.state(x=-0.3))


def test_the_delay_that_a_bench_measures_is_the_estimators_and_the_rigs() -> None:
    """Of the SRV02 in place of its usual 1.5 ms; through JSON values and back."""
    late = Recipe.from_dict(Recipe(rig="realistic", delay=0.005).as_dict())
    timing = late.make_rig().bench.timing
    assert timing.input_delay + timing.measurement_delay == pytest.approx(0.005)
    for recipe, periods in ((late, 5), (Recipe(rig="realistic"), 2)):
        estimator: Any = recipe.make_estimator()
        assert estimator._lead == periods


FEW = {"theta": 2 * math.pi / 200, "phi": 2 * math.pi / 200}


def test_encoders_of_few_counts_are_the_estimators_and_the_rigs() -> None:
    """Of 200 counts a turn; through JSON values and back."""
    told = Recipe.from_dict(Recipe(rig="realistic", encoders=FEW).as_dict())
    assert [told.make_rig().bench.encoders[name].resolution for name in FEW] == [*FEW.values()]
    usual, few = (recipe.make_estimator() for recipe in (Recipe(rig="realistic"), told))
    spread, wide = (np.diag(e.steady_covariance())[:2] for e in (usual, few))
    assert (wide > 10 * spread).all()


@pytest.mark.slow
def test_a_rig_with_few_counts_is_held_by_who_is_told() -> None:
    """The paper's rig on 200 counts a turn; with 4096 taken for granted it is lost."""
    model = ut.mechanisms.rotary_pendulum()
    cascade, begins = ut.Cascade(model, cold=ut.Budget(512)), model.state(phi=0.35)
    endings = []
    for told in (FEW, None):
        rig = RealisticRig(Recipe(rig="realistic", encoders=FEW).bench, begins, 0)
        done = ut.run(cascade, rig, seconds=1.0, simulated=True, x0=begins, encoders=told)
        endings.append(done.verdict.ending)
    assert endings == ["caught", "lost"]


@pytest.mark.parametrize(
    ("encoders", "rig", "match"),
    [
        ({"psi": 0.01}, "realistic", "encoder of a run.*psi.*theta, phi"),
        ({"phi": 0.0}, "realistic", "one count of 'phi'.*> 0"),
        ({"phi": 0.01}, "ideal", "encoders of a run.*ideal rig"),
    ],
)
def test_encoders_that_cannot_be_are_refused(
    encoders: dict[str, float], rig: Any, match: str
) -> None:
    with pytest.raises(InvalidInputError, match=match):
        Recipe(rig=rig, encoders=encoders)


def test_a_target_is_refused_before_a_controller_is_made(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its estimator and gate took seconds to compile, for a run that cannot be."""
    monkeypatch.setattr(Recipe, "make_estimator", lambda _self: pytest.fail("it was made"))
    with pytest.raises(InvalidInputError, match="95 % of the travel"):
        Recipe("overhead_crane", target=((0.0, {"x": 2.0}),))
