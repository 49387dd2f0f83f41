"""The fast loop: pure, always within limits, never stopped without a safe stop."""

from __future__ import annotations

import math
import os
import signal
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import undertow as ut
from undertow.cascade import Admission, CascadeState
from undertow.errors import InvalidInputError
from undertow.plan import Plan
from undertow.rig import Measurement, Push, RealisticRig
from undertow.runtime import (
    Columns,
    Command,
    Controller,
    InlineWorker,
    Inputs,
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
from undertow.runtime.clock import Histogram
from undertow.runtime.faults import Witness
from undertow.runtime.keeper import KeptRig
from undertow.runtime.modes import Reason, successor
from undertow.runtime.session import session
from undertow.runtime.slow import Answer, Request

RECIPE = Recipe(parameters={"d_e": 0.025}, evaluations=64, start=(0.0, 0.3, 0.0, 0.0))


@pytest.fixture
def memory(quick: ut.Surface) -> CascadeState:
    return CascadeState(Plan.of(quick))


@pytest.fixture
def controller(memory: CascadeState) -> Controller:
    return RECIPE.make_controller(memory)


def settled(controller: Controller, steps: int = 30) -> int:
    """Bring the controller under its law on an ideal rig; return the number of steps made."""
    rig = RECIPE.make_rig()
    for k in range(steps):
        command = Command.START if k == 0 else Command.NONE
        rig.write(controller.step(Inputs(1e-3 * k, rig.read(), None, command)))
    assert controller.mode == Mode.CATCH
    return steps


# -- states and guards -----------------------------------------------------------------------


@pytest.mark.parametrize("mode", [m for m in Mode if m not in (Mode.IDLE, Mode.SAFE_STOP)])
def test_faults_and_the_operator_come_before_everything(mode: Mode) -> None:
    assert successor(mode, fault=True, inside=True) == (Mode.SAFE_STOP, Reason.FAULT)
    assert successor(mode, Command.STOP, inside=True) == (Mode.SAFE_STOP, Reason.STOP)


def test_nothing_but_the_operator_leads_out_of_a_safe_stop() -> None:
    every = partial(successor, Mode.SAFE_STOP, ready=True, inside=True, settled=True, swings=True)
    for command in (Command.NONE, Command.START, Command.STOP):
        assert every(command) == (Mode.SAFE_STOP, Reason.NONE)
    assert every(Command.RESET) == (Mode.IDLE, Reason.RESET)
    assert every(Command.RESET, fault=True) == (Mode.SAFE_STOP, Reason.NONE)


def test_the_law_takes_over_inside_its_region_alone_and_hands_back() -> None:
    assert successor(Mode.BRING_UP, ready=True, swings=True)[0] == Mode.SWING_UP
    assert successor(Mode.BRING_UP, ready=True)[0] == Mode.BRING_UP
    assert successor(Mode.SWING_UP, ready=True, swings=True)[0] == Mode.SWING_UP
    assert successor(Mode.SWING_UP, inside=True, swings=True)[0] == Mode.CATCH
    assert successor(Mode.CATCH, settled=True)[0] == Mode.BALANCE
    assert successor(Mode.BALANCE) == (Mode.CATCH, Reason.DISTURBED)
    for mode in (Mode.CATCH, Mode.BALANCE):
        assert successor(mode, lost=True, swings=True)[0] == Mode.SWING_UP
        assert successor(mode, lost=True)[0] == Mode.SAFE_STOP


def test_a_step_never_compiles_anything(controller: Controller) -> None:
    """Whatever a driver's numbers are made of: one machine code for each compiled part."""
    settled(controller)
    readings = (
        Measurement(0.030, np.array([0.0, 0.3])),
        Measurement(np.float32(0.031), [0.0, 0.3]),  # type: ignore[arg-type]
        Measurement(np.float64(0.032), np.array([0.0, 0.3], dtype=np.float32)),
        Measurement(1, np.array([0.0, 9.0, 0.3, 9.0])[::2]),
        None,
    )
    for k, measurement in enumerate(readings):
        controller.step(Inputs(0.03 + 1e-3 * k, measurement))
    parts = controller._act, controller._law, controller.sensors._check
    assert [len(part.signatures) for part in parts] == [1, 1, 1]


@pytest.mark.parametrize("q", [[0.3], [0.0, 0.3, 0.0], 0.3, [[0.0, 0.3]]])
def test_a_measurement_of_another_shape_is_a_safe_stop(controller: Controller, q: object) -> None:
    k = settled(controller)
    controller.step(Inputs(1e-3 * k, Measurement(1e-3 * k, q)))  # type: ignore[arg-type]
    assert controller.mode == Mode.SAFE_STOP
    assert controller.stopped_by


def test_from_hanging_to_balance_through_the_states_and_the_same_again(tmp_path: Path) -> None:
    """Realistic rig, positions alone; the slow loop finds what catches; the replay agrees."""
    recipe = Recipe(rig="realistic", swing_up=True, evaluations=32)
    with session(recipe, simulated=True, log=tmp_path / "run.db") as runtime:
        report = runtime.run(4.0)
        end = runtime.rig.truth  # type: ignore[attr-defined]
    states = [text.split(":")[0] for _, what, text in report.events if what == "state"]
    assert states[:4] == [
        "IDLE → BRING_UP", "BRING_UP → SWING_UP", "SWING_UP → CATCH", "CATCH → BALANCE",
    ]  # fmt: skip
    assert report.stopped_by == "operator: stop"
    assert math.cos(end[1]) > 0.999
    again = replay(tmp_path / "run.db")
    assert again.identical
    assert again.judged > 10


def test_thrown_out_it_swings_up_again_within_limits() -> None:
    """Knocked over while it balances: safe outputs throughout, and back to the top."""
    recipe = Recipe(rig="realistic", swing_up=True, evaluations=32)
    bench = replace(recipe.bench, pushes=(Push(4.0, "phi", 0.06),))
    rig = RealisticRig(bench, recipe.x0, 0)
    controller = recipe.make_controller(recipe.first())
    witness = Witness(rig, controller.limits, controller.slew)
    worker = InlineWorker(recipe.respond, 0.01)
    report = Runtime(controller, witness, worker, clock=SimulatedClock()).run(9.0)
    assert not witness.faults
    assert report.entered["SWING_UP"] >= 2
    assert report.stopped_by == "operator: stop"
    assert math.cos(rig.truth[1]) > 0.999


def test_a_catch_is_refused_where_the_state_is_not_the_predicted_one() -> None:
    """An answer for another state, or for another mode, is never put to use."""
    recipe = Recipe(rig="realistic", swing_up=True, evaluations=32)
    controller, rig = recipe.make_controller(recipe.first()), recipe.make_rig()
    answers = 0
    for k in range(3000):
        answer = None
        if controller.request is not None and controller.request.swing >= 0:
            honest = recipe.respond(controller.request)
            answers += honest.admission.accepted
            answer = replace(honest, x=honest.x + 0.5)
        command = Command.START if k == 0 else Command.NONE
        rig.write(controller.step(Inputs(1e-3 * k, rig.read(), answer, command)))
        if answers:
            break
    assert answers == 1
    for i in range(40):
        rig.write(controller.step(Inputs(1e-3 * (k + 1 + i), rig.read())))
        assert controller.mode == Mode.SWING_UP


def test_the_two_halves_of_a_step_are_the_step(memory: CascadeState) -> None:
    """Bookkeeping after the output, at once or with the next step: the same bits."""
    whole, late = RECIPE.make_controller(memory), RECIPE.make_controller(memory)
    rig, answer = RECIPE.make_rig(), None
    for k in range(300):
        inputs = Inputs(1e-3 * k, rig.read(), answer, Command(1 if k == 0 else 0))
        u = whole.step(inputs).copy()
        assert np.array_equal(late.decide(inputs), u)
        request = whole.request
        answer = RECIPE.respond(request) if request is not None else None
        rig.write(u)
    late.follow_up()
    assert whole.memory == late.memory
    assert whole.memory.sequence > 0


# -- the output ------------------------------------------------------------------------------


@given(
    readings=st.lists(
        st.tuples(st.floats(width=64), st.floats(width=64), st.floats(width=64)),
        min_size=1,
        max_size=40,
    ),
    alarm=st.sampled_from(["", "", "", "the sky falls"]),
)
@settings(max_examples=50)
def test_no_measurement_brings_the_output_past_limits_slew_or_to_nan(
    readings: list[tuple[float, float, float]], alarm: str
) -> None:
    """Any numbers whatever, NaN and infinity among them, as positions and times."""
    quick = ut.Surface(alpha_a=-1, lambda_a=-1.59, alpha_u=1.96, lambda_u=12.1)
    controller = RECIPE.make_controller(CascadeState(Plan.of(quick)))
    k = settled(controller)
    before = controller.u.copy()
    for i, (t, theta, phi) in enumerate(readings):
        measurement = Measurement(t, np.array([theta, phi]))
        u = controller.step(Inputs(1e-3 * (k + i), measurement, None, Command.NONE, alarm))
        assert np.isfinite(u).all()
        assert abs(u[0]) <= 15.0
        assert abs(u[0] - before[0]) <= controller.slew[0] * (1 + 1e-12)
        before = u.copy()


def test_the_fast_step_is_the_law_of_the_cascade(
    controller: Controller, memory: CascadeState
) -> None:
    """Away from limits the output is Cascade.control at the estimate."""
    settled(controller, 400)
    wanted = RECIPE.cascade.control(memory, 0.4, controller.x)
    assert controller.u[0] == pytest.approx(float(wanted.u[0]), rel=1e-9)


def test_a_safe_stop_brings_the_output_to_zero_within_the_slew_rate(
    controller: Controller,
) -> None:
    k = settled(controller)
    assert abs(controller.u[0]) > 1.0
    outputs = [controller.u[0]]
    while controller.u[0] != 0.0:
        inputs = Inputs(1e-3 * k, None, None, Command.STOP)
        outputs.append(controller.step(inputs)[0])
        assert len(outputs) < 10
    assert controller.mode == Mode.SAFE_STOP
    assert np.abs(np.diff(outputs)).max() <= controller.slew[0]


@pytest.mark.parametrize("name", ["lead", "patience", "stall", "slew_time"])
def test_settings_refuse_what_is_not_positive(name: str) -> None:
    with pytest.raises(InvalidInputError, match=name):
        Settings(**{name: -1.0})


# -- answers of the slow loop ------------------------------------------------------------------


def asked(controller: Controller) -> tuple[Request, RealisticRig, int]:
    """The first request of a run."""
    rig = RECIPE.make_rig()
    for k in range(100):
        command = Command.START if k == 0 else Command.NONE
        rig.write(controller.step(Inputs(1e-3 * k, rig.read(), None, command)))
        if controller.request is not None:
            return controller.request, rig, k + 1
    raise AssertionError


def answered(request: Request, surface: ut.Surface) -> Answer:
    """An answer that changes the surface, admitted."""
    plan = Plan.of(surface)
    honest = respond(RECIPE.cascade, request)
    after = replace(request.memory, plan=plan, since=request.use, sequence=request.sequence)
    admission = Admission(True, "for the test", 1.0)
    lanes = honest.lanes.copy()
    lanes[0, : len(surface.vector)] = surface.vector
    return replace(honest, admission=admission, memory=after, lanes=lanes)


OTHER = ut.Surface(alpha_a=-1, lambda_a=-1.2, alpha_u=2.1, lambda_u=12.0)


def test_an_answer_is_computed_for_the_predicted_state_and_used_at_its_time(
    controller: Controller,
) -> None:
    """Belief = truth: at the time of use the state is the predicted one, and not before."""
    request, rig, k = asked(controller)
    answer = answered(request, OTHER)
    ahead = RECIPE.cascade.loop.simulate(
        request.x, request.memory.plan, duration=request.use - request.t, terminal=0.0
    )
    np.testing.assert_allclose(answer.x, ahead.x[-1], atol=1e-9)
    before = controller.memory.surface
    for i in range(k, k + 101):
        given = answer if i == k else None
        rig.write(controller.step(Inputs(1e-3 * i, rig.read(), given)))
        used = controller.memory.surface == OTHER
        assert used == (1e-3 * i >= request.use - 5e-4)
        if not used:
            assert controller.memory.surface == before
    np.testing.assert_allclose(controller.x, answer.x, atol=0.03)
    assert any("applied" in note.text for note in controller.notes) or used


def given_to(controller: Controller, answer: Answer, t: float, rig: RealisticRig) -> str:
    rig.write(controller.step(Inputs(t, rig.read(), answer)))
    return "; ".join(note.text for note in controller.notes if note.kind == "answer")


def test_answers_late_stale_twice_or_not_asked_for_are_refused(controller: Controller) -> None:
    request, rig, k = asked(controller)
    answer = answered(request, OTHER)
    t = 1e-3 * k
    assert "not asked for" in given_to(controller, replace(answer, sequence=9), t, rig)
    assert "stale" in given_to(controller, replace(answer, sequence=0), t + 0.001, rig)
    assert given_to(controller, answer, t + 0.002, rig) == ""  # kept for its time
    assert "twice" in given_to(controller, answer, t + 0.003, rig)
    assert controller.memory.surface != OTHER


def test_a_late_answer_is_refused_and_the_next_one_has_a_higher_number(
    controller: Controller,
) -> None:
    request, rig, k = asked(controller)
    answer = answered(request, OTHER)
    for i in range(k, k + 110):
        rig.write(controller.step(Inputs(1e-3 * i, rig.read())))
    assert "late by" in given_to(controller, answer, 1e-3 * (k + 110), rig)
    assert controller.memory.surface != OTHER
    rig.write(controller.step(Inputs(1e-3 * (k + 111), rig.read())))
    assert controller.request is not None
    assert controller.request.sequence > request.sequence
    assert controller.request.use - controller.request.t > request.use - request.t


@pytest.mark.parametrize(
    "spoil",
    [
        lambda a: replace(a, lanes=a.lanes * math.nan),
        lambda a: replace(a, lanes=a.lanes[:, 1:]),
        lambda a: replace(a, lanes=np.vstack([a.lanes, a.lanes])),
        lambda a: replace(a, use=a.use + 1.0),
    ],
)
def test_an_answer_that_was_damaged_on_its_way_is_refused(controller: Controller, spoil) -> None:  # type: ignore[no-untyped-def]
    request, rig, k = asked(controller)
    said = given_to(controller, spoil(answered(request, OTHER)), 1e-3 * k, rig)
    assert "refused" in said


def test_an_answer_for_another_state_is_refused_at_its_time(controller: Controller) -> None:
    request, rig, k = asked(controller)
    answer = replace(answered(request, OTHER), x=np.full(4, 3.0))
    texts = [given_to(controller, answer, 1e-3 * k, rig)]
    for i in range(k + 1, k + 110):
        rig.write(controller.step(Inputs(1e-3 * i, rig.read())))
        texts += [note.text for note in controller.notes]
    assert any("off its prediction" in text for text in texts)
    assert controller.memory.surface != OTHER


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
    assert report.missed == 2
    assert report.skipped == 2
    assert report.steps == 200 - 2 + 1  # the last one stops
    assert report.whole.longest == pytest.approx(3.5e-3)
    assert sum(report.whole.between((0.0, 1e-3, math.inf))) == report.steps
    assert report.stopped_by == "operator: stop"


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
            assert runtime.run(0.3).stopped_by == "operator: stop"
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
    assert report.stopped_by == "operator: stop"
    assert ("optimiser", "OSError: no line") in {(what, text) for _, what, text in report.events}


def test_a_stop_before_the_run_is_kept_and_a_second_run_refused(controller: Controller) -> None:
    runtime = Runtime(
        controller, RECIPE.make_rig(), InlineWorker(RECIPE.respond), clock=SimulatedClock()
    )
    runtime.stop()
    assert runtime.run(1.0).stopped_by == "operator: stop"
    assert runtime.report.steps == 1
    with pytest.raises(InvalidInputError, match="another session"):
        runtime.run(1.0)


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


# -- processes ------------------------------------------------------------------------------------


def take(worker, seconds: float = 10.0):  # type: ignore[no-untyped-def]
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        if (answer := worker.take(0.0)) is not None:
            return answer
        time.sleep(0.002)
    return None


def echo(request: Request) -> Answer:
    """An answer without any work; hangs when asked from a negative time."""
    if request.t < 0:
        time.sleep(60.0)
    return respond(RECIPE.cascade, request)


@pytest.mark.parametrize("processes", [0, 2])
def test_a_worker_in_the_background_gives_the_same_bits(
    memory: CascadeState, processes: int
) -> None:
    request = Request(0.0, RECIPE.x0, 0.1, memory)
    here = echo(request)
    worker = background_worker(echo, processes=processes)
    try:
        worker.ask(request)
        there = take(worker)
    finally:
        worker.close()
    assert there is not None
    assert there.proposal.plan == here.proposal.plan
    np.testing.assert_array_equal(there.lanes, here.lanes)
    np.testing.assert_array_equal(there.x, here.x)


@pytest.mark.parametrize("how", ["hangs", "dies"])
def test_another_process_takes_over_from_one_that_hangs_or_dies(
    memory: CascadeState, how: str
) -> None:
    worker = background_worker(echo, processes=2)
    try:
        if how == "dies":
            os.kill(worker.processes[0], signal.SIGKILL)
        worker.ask(Request(-1.0 if how == "hangs" else 0.0, RECIPE.x0, 0.1, memory))
        assert take(worker, 0.3) is None
        assert worker.replace()
        worker.ask(Request(0.0, RECIPE.x0, 0.1, memory))
        assert take(worker) is not None
        assert not worker.replace()  # nobody is left
    finally:
        worker.close()


def test_a_keeper_brings_the_output_to_zero_when_its_controller_falls_silent(
    tmp_path: Path,
) -> None:
    """Within the slew rate, and the rig goes on giving measurements."""
    limits, slew = np.array([15.0]), np.array([7.5])

    written = tmp_path / "written"
    written.touch()

    class Watched(Witness):
        def write(self, u: np.ndarray) -> None:
            super().write(u)
            with written.open("a") as file:
                file.write(f"{float(u[0])} {len(self.faults)}\n")

    rig = KeptRig(lambda: Watched(RECIPE.make_rig(), limits, slew), 1e-3, limits, slew)
    try:
        first = rig.read()
        rig.write(np.array([5.0]))
        deadline = time.monotonic() + 10.0
        lines: list[str] = []
        while time.monotonic() < deadline and not (len(lines) > 1 and lines[-1].startswith("0.0")):
            time.sleep(0.01)
            lines = written.read_text().splitlines()
        assert [line.split() for line in lines] == [["5.0", "0"], ["0.0", "0"]]
        assert rig.read().t == pytest.approx(first.t + 1e-3)
    finally:
        rig.close()
    assert not rig.process.is_alive()


def test_a_keeper_that_was_held_up_applies_the_newest_output_alone(tmp_path: Path) -> None:
    """Not all that has queued in one rush; and what a terminal sends does not reach it."""
    limits, slew = np.array([15.0]), np.array([7.5])
    written = tmp_path / "written"

    class Told(Witness):
        def write(self, u: np.ndarray) -> None:
            super().write(u)
            with written.open("a") as file:
                file.write(f"{float(u[0])}\n")

    rig = KeptRig(lambda: Told(RECIPE.make_rig(), limits, slew), 1e-3, limits, slew)
    try:
        pid = rig.process.pid or 0
        assert os.getsid(pid) != os.getsid(0)
        os.kill(pid, signal.SIGSTOP)
        for u in (1.0, 2.0, 3.0, 4.0, 5.0):
            rig.write(np.array([u]))
        with pytest.raises(TimeoutError, match="keeper"):
            rig.read()
        os.kill(pid, signal.SIGCONT)
    finally:
        rig.close()
    assert [float(line) for line in written.read_text().split()] == [5.0, 0.0]


def test_a_keeper_outlives_a_rig_that_fails_and_says_so() -> None:
    """A failed read or write is the controller's to judge; it comes to zero all the same."""
    limits, slew = np.array([15.0]), np.array([7.5])

    class Failing(Witness):
        calls = 0

        def read(self) -> Measurement:
            self.calls += 1
            if self.calls == 2:
                message = "no reading"
                raise OSError(message)
            return super().read()

        def write(self, u: np.ndarray) -> None:
            if self.calls == 2:
                self.calls += 1
                message = "no output"
                raise OSError(message)
            super().write(u)

    rig = KeptRig(lambda: Failing(RECIPE.make_rig(), limits, slew), 1e-3, limits, slew, silence=9.0)

    def read() -> Measurement:
        assert rig._pipe.poll(10.0)
        return rig.read()

    try:
        rig.write(np.array([5.0]))
        with pytest.raises(OSError, match="no reading"):
            read()
        rig.write(np.array([5.0]))
        assert read().q.shape == (2,)
        with pytest.raises(OSError, match="no output"):
            rig.write(np.array([5.0]))
        read()
        rig.write(np.array([5.0]))
    finally:
        rig.close()
    assert not rig.process.is_alive()
    assert rig.process.exitcode == 0


@pytest.mark.slow
def test_a_mechanism_with_two_inputs_is_held_on_its_realistic_rig() -> None:
    """Motors that stick, encoders too coarse for the paper's boundary layer: held to the end.

    `undertow trials library` does the same for all.
    """
    recipe = Recipe(mechanism="two_motor_three_link", rig="realistic", evaluations=256, seed=2)
    with session(recipe, simulated=True) as runtime:
        report = runtime.run(6.0)
    assert report.stopped_by == "operator: stop"
    assert "BALANCE" in report.entered
    assert float(np.max(recipe.cascade.reaching.layer)) > 0.1


@pytest.mark.slow
def test_a_pendulum_that_falls_is_let_go_of() -> None:
    """A reaction wheel beyond what its motor can do: a safe stop at a right angle."""
    recipe = Recipe(mechanism="reaction_wheel_pendulum", rig="realistic", evaluations=64, seed=0)
    with session(recipe, simulated=True) as runtime:
        report = runtime.run(3.0)
    assert report.stopped_by == "thrown out"
