"""The loop around the fast step: deadlines, rigs and workers that misbehave, the watchdog."""

from __future__ import annotations

import gc
import json
import math
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import undertow as ut
from runs import RECIPE
from support import rest_slow
from undertow.base import InvalidInputError
from undertow.cascade import CascadeState
from undertow.estimators import Measured
from undertow.plants import Measurement, RealisticRig
from undertow.runtime import (
    Columns,
    Controller,
    InlineWorker,
    Log,
    Mode,
    Recipe,
    Runtime,
    Settings,
    SimulatedClock,
    about,
    background_worker,
    read_log,
    replay,
    respond,
)
from undertow.runtime.clock import Histogram, WallClock
from undertow.runtime.loop import _quiet_interpreter
from undertow.runtime.slow_loop import Answer, Request


@pytest.mark.parametrize(("frozen", "released"), [(0, 1), (1000, 0)])
def test_what_was_frozen_before_a_run_stays_so(
    frozen: int, released: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each collection after a run went through all that its caller had kept out of them."""
    said: list[str] = []
    for name in ("collect", "freeze", "unfreeze"):
        monkeypatch.setattr(gc, name, lambda *_, name=name: said.append(name))
    monkeypatch.setattr(gc, "get_freeze_count", lambda: frozen)
    with _quiet_interpreter(WallClock()):
        assert not gc.isenabled()
    assert gc.isenabled()
    assert said == ["collect", "freeze", *["unfreeze"] * released]


# -- deadlines, by a clock that is told to jump ---------------------------------------------------


class Slow:
    """A rig that costs time."""

    def __init__(self, rig: RealisticRig, clock: SimulatedClock, cost: dict[int, float]) -> None:
        self.rig, self.clock, self.cost, self.period = rig, clock, cost, rig.period
        self.calls, self.closed = 0, False

    def read(self) -> Measurement:
        self.clock.t += self.cost.get(self.calls, 0.0)
        self.calls += 1
        return self.rig.read()

    def write(self, u: np.ndarray) -> None:
        self.rig.write(u)

    def close(self) -> None:
        self.closed = True


def run_slow(controller: Controller, cost: dict[int, float], seconds: float = 0.2) -> Runtime:
    clock = SimulatedClock()
    rig = Slow(RECIPE.make_rig(), clock, cost)
    worker = InlineWorker(lambda request: respond(RECIPE.cascade, request))
    runtime = Runtime(controller, rig, worker, clock=clock)
    runtime.run(seconds)
    assert rig.closed
    return runtime


def test_deadlines_are_counted_and_missed_periods_skipped(controller: Controller) -> None:
    """2.5 periods late: a miss, and two periods without a step; 0.5 late: a miss; else none."""
    report = run_slow(controller, {50: 3.5e-3, 100: 0.5e-3, 150: 1.5e-3}).report
    assert report.missed_deadlines == 2
    assert report.skipped_periods == 2
    assert report.steps == 200 - 2 + 1  # the last one stops
    assert report.response_times.longest == pytest.approx(3.5e-3)
    assert sum(report.response_times.between((0.0, 1e-3, math.inf))) == report.steps
    assert report.stopped_by == "end of the time asked for"


def test_a_stalled_loop_stops_safely(controller: Controller) -> None:
    report = run_slow(controller, {50: 0.2}, 1.0).report
    assert report.mode == Mode.SAFE_STOP
    assert "no step for" in report.stopped_by


def test_histogram_quantiles_are_right_to_a_microsecond() -> None:
    histogram, rng = Histogram(), np.random.default_rng(0)
    times = rng.exponential(100e-6, 5000)
    for value in times:
        histogram.add(value)
    for fraction in (0.5, 0.99):
        assert histogram.quantile(fraction) == pytest.approx(
            float(np.quantile(times, fraction, method="inverted_cdf")), abs=2e-6
        )
    assert histogram.longest == times.max()
    assert math.isnan(Histogram().quantile(0.5))


class Careless:
    """A rig that keeps what it is given, changes it, and writes over what it gave."""

    def __init__(self, rig: RealisticRig) -> None:
        self.rig, self.period = rig, rig.period
        self.q, self.calls = np.zeros(2), list[str]()

    def read(self) -> Measurement:
        measurement = self.rig.read()
        self.q[:] = measurement.q
        return replace(measurement, q=self.q)

    def write(self, u: np.ndarray) -> None:
        self.rig.write(u)
        self.q += 0.1
        u *= -2.0

    def close(self) -> None:
        message = "cannot be closed"
        raise RuntimeError(message)


def test_a_careless_rig_changes_neither_the_run_nor_its_log(
    memory: CascadeState, tmp_path: Path
) -> None:
    """The loop owns its readings and its outputs; a rig that cannot be closed ends no run."""
    outputs = []
    for careless in (False, True):
        controller = RECIPE.make_controller(memory)
        rig = Careless(RECIPE.make_rig()) if careless else RECIPE.make_rig()
        worker = InlineWorker(RECIPE.respond)
        path = tmp_path / f"{careless}.db"
        columns = Columns.of(RECIPE.belief)
        with Log(path, columns, about(controller, RECIPE), threaded=False) as log:
            runtime = Runtime(controller, rig, worker, clock=SimulatedClock(), log=log)
            assert runtime.run(0.2).stopped_by == "end of the time asked for"
        assert replay(path).identical
        outputs.append(read_log(path)["voltage"])
    np.testing.assert_array_equal(outputs[0], outputs[1])


class Broken:
    """A worker that fails in all it is asked."""

    def ask(self, request: Request) -> None:
        message = "no line"
        raise OSError(message)

    def take(self, t: float) -> Answer | None:
        message = "no line"
        raise OSError(message)

    def replace(self) -> bool:
        message = "no line"
        raise OSError(message)

    def close(self) -> None:
        """Nothing to stop."""


def test_a_worker_that_fails_leaves_the_last_plan(controller: Controller) -> None:
    report = Runtime(controller, RECIPE.make_rig(), Broken(), clock=SimulatedClock()).run(0.8)
    assert report.stopped_by == "end of the time asked for"
    assert ("optimiser", "OSError: no line") in {(what, text) for _, what, text in report.events}


@pytest.mark.parametrize(
    "wrong",
    rest_slow(
        [{"law_vectors": None}, {"x": [0.0] * 4}, {"sequence": "1"}, {"memory": None}, None],
        {"law_vectors": None},
        {"sequence": "1"},
        None,
    ),
)
def test_what_is_no_whole_answer_is_not_looked_at(
    wrong: dict[str, object] | None, memory: CascadeState, tmp_path: Path
) -> None:
    """Of whatever types a worker's answers are: the last plan stays, and the replay agrees."""

    def compute(request: Request) -> Answer:
        answer = RECIPE.respond(request)
        return replace(answer, **wrong) if wrong else "later"  # type: ignore[arg-type, return-value]

    controller = RECIPE.make_controller(memory)
    path = tmp_path / "run.db"
    meta = about(controller, RECIPE)
    with Log(path, Columns.of(RECIPE.belief), meta, threaded=False) as log:
        runtime = Runtime(
            controller, RECIPE.make_rig(), InlineWorker(compute), clock=SimulatedClock(), log=log
        )
        report = runtime.run(0.3)
    assert report.stopped_by == "end of the time asked for"
    assert any("no whole answer" in text for _, _, text in report.events)
    assert replay(path).identical


def test_a_stop_before_the_run_is_kept_and_a_second_run_refused(controller: Controller) -> None:
    runtime = Runtime(
        controller, RECIPE.make_rig(), InlineWorker(RECIPE.respond), clock=SimulatedClock()
    )
    runtime.stop()
    assert runtime.run(1.0).stopped_by == "operator: stop"
    assert runtime.report.steps == 1
    with pytest.raises(InvalidInputError, match="another session"):
        runtime.run(1.0)


@pytest.mark.parametrize("designed", [False, True])
def test_plans_are_made_with_the_output_that_the_settings_leave(designed: bool) -> None:
    """They counted on the whole input, and a run with a third of it was lost by their plans."""
    rig = ut.mechanisms.rotary_pendulum()
    cascade = ut.Cascade(rig, ut.MinimumTime(), belief=ut.Belief.relative(rig, m=0.2))
    recipe = Recipe(
        rig, objective=cascade.objective, design=cascade if designed else None,
        settings=Settings(output_limit=5.0),
    )  # fmt: skip
    suited = recipe.cascade
    assert suited.loop.input_limits == recipe.make_estimator().mechanism.input_limits == [5.0]
    assert suited.known is not None
    assert suited.known.mechanism is suited.mechanism
    assert not designed or list(suited.known.tolerances) == ["m"]
    assert rig.input_limits == [15.0]
    whole = replace(recipe, settings=Settings(output_limit=20.0))
    assert whole.cascade.loop.input_limits == [15.0]


def test_a_limit_of_the_output_leaves_the_objective_as_it_is() -> None:
    """What an input costs, as a part of the mechanism's own limit; and a log can still name it."""
    rig = ut.mechanisms.rotary_pendulum()
    cascade = ut.Cascade(rig)
    recipe = Recipe(
        rig, objective=cascade.objective, horizon=60.0, design=cascade,
        settings=Settings(output_limit=5.0),
    )  # fmt: skip
    written = recipe.in_names()
    assert written is not None
    again = Recipe.from_dict(written.as_dict())
    assert again.belief.fingerprint == recipe.belief.fingerprint
    assert again.cascade.objective == recipe.cascade.objective == cascade.objective


def test_each_input_may_have_a_limit_of_its_own() -> None:
    """Through a log's words, too; one for each, or one for all."""
    arm = ut.mechanisms.two_motor_three_link()
    recipe = Recipe("two_motor_three_link", settings=Settings(output_limit=(12.0, 40.0)))
    again = Recipe.from_dict(json.loads(json.dumps(recipe.as_dict())))
    assert again.settings == recipe.settings
    assert again.settings.limits(arm).tolist() == [12.0, 20.0]
    assert Settings(output_limit=25.0).limits(arm).tolist() == [25.0, 20.0]
    with pytest.raises(InvalidInputError, match=r"output_limit: .*one number or 2"):
        Settings(output_limit=(1.0, 2.0, 3.0)).limits(arm)


@pytest.mark.parametrize("designed", [False, True])
def test_plans_are_made_within_the_travel_that_the_settings_leave(designed: bool) -> None:
    """They went up to the mechanism's own, past where the run is stopped; a log still has it."""
    cart = ut.mechanisms.cart_pendulum()
    cascade = ut.Cascade(cart, ut.objective_for(cart, constraints=ut.state_box(phi=0.5)))
    recipe = Recipe(
        cart, objective=cascade.objective, horizon=60.0, design=cascade if designed else None,
        settings=Settings(max_travel=1.0), estimator=lambda model, _: Measured(model),
    )  # fmt: skip
    words = [c.words for c in recipe.cascade.loop.objective.constraints]
    assert "|x| ≤ 0.95 m: 95 % of the max_travel of the run" in words
    assert "|phi| ≤ 0.5" in words
    assert not any("1.425" in word for word in words)
    wide = replace(recipe, settings=Settings(max_travel=30.0))
    assert wide.cascade.objective.range_of(cart)[1][0] == pytest.approx(1.425)
    named = replace(recipe, objective=ut.objective_for(cart, horizon=60.0), design=None)
    written = named.in_names()
    assert written is not None
    again = replace(Recipe.from_dict(written.as_dict()), estimator=named.estimator)
    assert again.cascade.objective == named.cascade.objective


@pytest.mark.slow
def test_each_coordinate_may_have_a_travel_of_its_own() -> None:
    """Through a log's words, too; one for each, or one for all; ranges apply besides."""
    cart = ut.mechanisms.cart_pendulum()
    recipe = Recipe("cart_pendulum", settings=Settings(max_travel=(0.4, math.inf)))
    again = Recipe.from_dict(json.loads(json.dumps(recipe.as_dict())))
    assert again.settings == recipe.settings
    assert again.settings.travels(cart).tolist() == [[-0.4, 0.4], [-math.inf, math.inf]]
    words = [c.words for c in recipe.cascade.objective.constraints]
    assert words == ["|x| ≤ 0.38 m: 95 % of the max_travel of the run"]
    hinge = Settings(max_travel=(2.0, ut.deg(20.0)))
    assert hinge.travels(cart)[0].tolist() == [-1.5, 1.5]
    bounded = hinge.bounded(ut.objective_for(cart), cart)
    assert "|phi| ≤ 19°" in [c.name for c in bounded.constraints]
    with pytest.raises(InvalidInputError, match=r"max_travel: .*one number or 2"):
        Settings(max_travel=(1.0, 2.0, 3.0)).travels(cart)


@pytest.mark.parametrize("period", [0.0, 0.15, float("nan")])
def test_a_period_that_is_itself_a_stall_is_refused(period: float) -> None:
    with pytest.raises(InvalidInputError, match="period of a run"):
        Recipe(period=period)


def test_a_rig_of_another_period_is_refused(controller: Controller) -> None:
    rig = replace(RECIPE, period=0.002).make_rig()
    with pytest.raises(InvalidInputError, match="period of the rig"):
        Runtime(controller, rig, InlineWorker(RECIPE.respond), clock=SimulatedClock())


def test_what_the_watchdog_let_go_of_is_neither_read_nor_written_again(
    controller: Controller,
) -> None:
    """A read that blocks: the run ends in a safe stop whose reason is in its events."""

    class Blocking(Careless):
        def read(self) -> Measurement:
            self.calls.append("read")
            if len(self.calls) == 101:
                time.sleep(0.4)
            return self.rig.read()

        def write(self, u: np.ndarray) -> None:
            self.calls.append("write")
            self.rig.write(u)

        def close(self) -> None:
            self.calls.append("close")

    rig = Blocking(RECIPE.make_rig())
    report = Runtime(controller, rig, background_worker(RECIPE.respond, processes=0)).run(1.0)
    assert "watchdog" in report.stopped_by
    assert report.mode == Mode.SAFE_STOP
    assert any("watchdog" in text for _, what, text in report.events if what == "state")
    assert set(rig.calls[rig.calls.index("close") :]) == {"close"}
