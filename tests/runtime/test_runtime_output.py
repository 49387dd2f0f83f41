"""The output is off when a run says so; what fails too often, too slowly or too fast stops it."""

from __future__ import annotations

import math
import os
import re
import signal
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from itertools import count
from pathlib import Path

import numpy as np
import pytest

from runs import RECIPE
from support import rest_slow
from undertow.base import ArtefactError, ResourceError
from undertow.cascade import CascadeState
from undertow.plants import Measurement, OutputOnError
from undertow.runtime import (
    Columns,
    Controller,
    InlineWorker,
    Log,
    Mode,
    Report,
    Runtime,
    RunVerdict,
    SimulatedClock,
    about,
    background_worker,
    replay,
)
from undertow.runtime.clock import FailureRatio, RigClock
from undertow.runtime.sensors import SOUND, SensorMonitor
from undertow.runtime.session import session
from undertow.runtime.settings import Settings
from undertow.runtime.supervisor import SupervisedRig
from undertow.runtime.verdict import EXIT_CODES


class Device:
    """A simulated rig whose calls may fail, and which remembers what it took last."""

    def __init__(
        self,
        *,
        write: Callable[[int, np.ndarray], None] = lambda k, u: None,
        read: Callable[[int, Measurement], Measurement] = lambda k, m: m,
        close: Exception | None = None,
    ) -> None:
        self.rig = RECIPE.make_rig()
        self.period = self.rig.period
        self.writing, self.reading, self.closing = write, read, close
        self.writes, self.reads, self.closed = 0, 0, 0
        self.accepted = np.zeros(1)

    def read(self) -> Measurement:
        self.reads += 1
        return self.reading(self.reads, self.rig.read())

    def write(self, u: np.ndarray) -> None:
        self.writes += 1
        try:
            self.writing(self.writes, u)
        except BaseException:
            self.rig.write(self.accepted)  # the device goes on with what it has
            raise
        self.rig.write(u)
        self.accepted = np.array(u)

    def close(self) -> None:
        self.closed += 1
        if self.closing is not None:
            raise self.closing


def driven(
    controller: Controller, device: Device, seconds: float = 0.6, log: Path | None = None
) -> Runtime:
    worker, clock = InlineWorker(RECIPE.respond), SimulatedClock()
    if log is None:
        runtime = Runtime(controller, device, worker, clock=clock)
        runtime.run(seconds)
        return runtime
    meta = about(controller, RECIPE)
    with Log(log, Columns.of(RECIPE.belief), meta, threaded=False) as book:
        runtime = Runtime(controller, device, worker, clock=clock, log=book)
        runtime.run(seconds)
    return runtime


def fails(when: Callable[[int], bool], error: BaseException) -> Callable[[int, object], None]:
    def call(k: int, _: object) -> None:
        if when(k):
            raise error

    return call


# -- zero is written until the device has taken it -------------------------------------------------


@pytest.mark.parametrize("every", rest_slow([2, 10, 20], 2))
def test_the_output_is_off_after_a_run_in_which_writes_fail(
    every: int, controller: Controller, tmp_path: Path
) -> None:
    """One of two, ten, twenty writes is taken: the run stops, and goes on until zero is taken."""
    device = Device(write=fails(lambda k: k > 300 and k % every != 0, OSError("bus")))
    report = driven(controller, device, log=tmp_path / "run.db").report
    assert "of the writes failed" in report.stopped_by
    assert not device.accepted.any()
    assert device.closed == 1
    verdict = report.verdict
    assert (verdict.ending, verdict.output_zero, verdict.output_problem) == ("stopped", True, "")
    assert verdict.exit_code == EXIT_CODES["stopped"]
    assert replay(tmp_path / "run.db").identical


def test_zero_is_insisted_on_for_a_stated_time(controller: Controller) -> None:
    """A device that takes no zero for 0.5 s: off within the second; one that never does: told."""

    def stubborn(until: float) -> Device:
        refused = count(1)

        def write(_: int, u: np.ndarray) -> None:
            if not u.any() and device.accepted.any() and next(refused) < until:
                message = "not now"
                raise OSError(message)

        device = Device(write=write)
        return device

    late = stubborn(500)
    report = driven(controller, late, 0.2).report
    assert report.output_zero
    assert not late.accepted.any()
    never = stubborn(math.inf)
    verdict = driven(RECIPE.make_controller(controller.memory), never, 0.2).report.verdict
    assert never.accepted.any()
    assert not verdict.output_zero
    assert (
        "did not take an output of zero: asked for 1 s, OSError: not now" in verdict.output_problem
    )
    assert verdict.exit_code == EXIT_CODES["output on"]
    assert "did not take" in str(verdict)
    assert never.closed == 1


def test_a_close_that_fails_is_told(controller: Controller) -> None:
    """Also where it is known by the driver that its inputs are not at zero."""
    report = driven(controller, Device(close=OSError("bus")), 0.2).report
    assert report.output_zero
    assert "close: OSError: bus" in report.verdict.output_problem
    assert report.verdict.exit_code == EXIT_CODES["degraded"]
    known = Device(close=OutputOnError("relay stuck"))
    verdict = driven(RECIPE.make_controller(controller.memory), known, 0.2).report.verdict
    assert not verdict.output_zero
    assert verdict.exit_code == EXIT_CODES["output on"]


@pytest.mark.parametrize("where", ["read", "write", "take", "follow_up", "decide"])
@pytest.mark.parametrize("error", [KeyboardInterrupt(), SystemExit(3), MemoryError()])
def test_whatever_ends_the_loop_the_output_comes_to_zero_within_its_slew(
    where: str, error: BaseException, controller: Controller, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An interrupt inside a driver, a way out of the interpreter, no memory: anywhere in a step."""
    outputs = [0.0]

    def write(k: int, u: np.ndarray) -> None:
        if where == "write" and k == 100:
            raise error
        outputs.append(float(u[0]))

    def read(k: int, m: Measurement) -> Measurement:
        if where == "read" and k == 100:
            raise error
        return m

    device = Device(write=write, read=read)
    runtime = Runtime(controller, device, InlineWorker(RECIPE.respond), clock=SimulatedClock())
    if where in ("follow_up", "decide"):
        honest, calls = getattr(controller, where), count(1)

        def part(*arguments: object) -> object:
            if next(calls) == 100:
                raise error
            return honest(*arguments)

        monkeypatch.setattr(controller, where, part)
    elif where == "take":
        honest_take, takes = runtime.worker.take, count(1)

        def take(t: float) -> object:
            if next(takes) == 100:
                raise error
            return honest_take(t)

        monkeypatch.setattr(runtime.worker, "take", take)
    if isinstance(error, SystemExit):
        with pytest.raises(SystemExit):
            runtime.run(0.3)
    else:
        runtime.run(0.3)
    report = runtime.report
    assert max(map(abs, outputs)) > 1.0
    assert not device.accepted.any()
    assert device.closed == 1
    assert report.output_zero
    assert report.mode == Mode.SAFE_STOP
    # A write that failed may have been taken: two steps of the slew rate from what was before.
    most = controller.slew[0] * (2 if where == "write" else 1)
    assert np.abs(np.diff(outputs)).max() <= most * (1 + 1e-12)
    survives = isinstance(error, MemoryError) and where in ("read", "write", "take")
    assert report.verdict.ending in (("caught", "degraded") if survives else ("stopped",))
    if isinstance(error, KeyboardInterrupt):
        assert report.stopped_by == "operator: interrupt"
        assert report.interrupted


def test_a_zero_write_that_hangs_is_left_to_the_watchdog(controller: Controller) -> None:
    """The rig is let go of from outside, and the verdict says that zero was not taken."""
    hung: list[float] = []
    closed = threading.Event()

    def write(_: int, u: np.ndarray) -> None:
        if not u.any() and device.accepted.any():
            hung.append(time.perf_counter())
            assert closed.wait(20.0)  # it hangs until the rig is let go of
            hung.append(time.perf_counter())
            message = "timed out"
            raise OSError(message)

    class Timed(Device):
        def close(self) -> None:
            closed.set()
            super().close()

    device = Timed(write=write)
    worker = background_worker(RECIPE.respond, processes=0)
    report = Runtime(controller, device, worker).run(0.2)
    begin, end = hung
    assert end - begin > 0.1
    assert not report.verdict.output_zero
    assert "watchdog" in report.verdict.output_problem
    assert report.verdict.exit_code == EXIT_CODES["output on"]


def test_a_rig_is_closed_when_the_run_cannot_begin(
    controller: Controller, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No thread for the watchdog: a condition before the rig moves, and the rig is let go of."""

    def start(_: object) -> None:
        message = "can't start new thread"
        raise RuntimeError(message)

    device = Device()
    runtime = Runtime(controller, device, InlineWorker(RECIPE.respond))
    monkeypatch.setattr("undertow.runtime.loop.threading.Thread.start", start)
    with pytest.raises(ResourceError, match="thread 'undertow watchdog'"):
        runtime.run(0.1)
    assert (device.writes, device.closed) == (0, 1)


# -- shares ----------------------------------------------------------------------------------------


def test_a_share_is_that_of_the_last_window() -> None:
    share = FailureRatio(0.1, 0.001)
    for k in range(1000):
        share.add(int(k % 3 == 0))
    assert share.value == pytest.approx(1 / 3, abs=0.01)
    for _ in range(500):
        share.add(0)
    assert share.value < 0.01
    whole, parts = FailureRatio(0.1, 0.001), FailureRatio(0.1, 0.001)
    whole.add(7, 7)
    for _ in range(7):
        parts.add(1)
    assert whole.value == pytest.approx(parts.value)


@pytest.mark.slow
def test_reads_that_fail_too_often_stop_the_run(controller: Controller) -> None:
    """One in three raises, and no gap is as long as the patience; one in ten is bridged."""

    def failing(every: int) -> Device:
        def read(k: int, m: Measurement) -> Measurement:
            if k > 100 and k % every == 0:
                message = "no answer"
                raise OSError(message)
            return m

        return Device(read=read)

    report = driven(controller, failing(3)).report
    assert "of the reads failed, read: OSError: no answer" in report.stopped_by
    rare = driven(RECIPE.make_controller(controller.memory), failing(10)).report
    assert rare.stopped_by == "end of the time asked for"
    assert rare.verdict.ending == "degraded"
    assert "reads failed" in str(rare.verdict)


@pytest.mark.parametrize(("channels", "stops"), [((0, 1), True), ((1,), True), ((), False)])
def test_a_sensor_that_is_mostly_missing_stops_the_run(
    channels: tuple[int, ...], stops: bool, controller: Controller
) -> None:
    """Nineteen readings of twenty are missing: no gap of 20 ms, and no run either."""

    def read(k: int, m: Measurement) -> Measurement:
        if k > 100 and k % 20:
            m.q[list(channels)] = np.nan
        return m

    report = driven(controller, Device(read=read)).report
    assert ("missing in" in report.stopped_by) == stops
    if stops:
        name = RECIPE.belief.coordinates[channels[0]].name
        assert f"sensor '{name}' missing in 60% of the readings" in report.stopped_by


@pytest.mark.parametrize("every", rest_slow([19, 7, 3], 19, 3))
def test_a_reading_that_is_missing_now_and_then_does_not_keep_the_law_from_taking_over(
    every: int, controller: Controller
) -> None:
    """One in nineteen from the start: bring-up bridges it; the mechanism does not fall."""

    def read(k: int, m: Measurement) -> Measurement:
        if k % every == 0:
            m.q[:] = np.nan
        return m

    device = Device(read=read)
    report = driven(controller, device).report
    assert report.entered["CATCH"] >= 1
    assert abs(device.rig.truth[1]) < 0.3
    assert report.stopped_by == "end of the time asked for"


def test_bring_up_ends_after_a_stated_time_with_what_is_missing(memory: CascadeState) -> None:
    """One sensor gives seven readings of ten too few; nobody brings the mechanism near."""

    def read(k: int, m: Measurement) -> Measurement:
        if k > 1 and k % 10 < 7:
            m.q[1] = np.nan
        return m

    patient = replace(RECIPE, settings=Settings(fault_window=5.0, bring_up_timeout=0.5))
    device = Device(read=read)
    report = driven(patient.make_controller(memory), device, 2.0).report
    assert report.stopped_by == (
        "bring-up: no 20 ms of sound readings within 0.5 s; "
        "sensor 'phi' missing in 70% of the readings"
    )
    assert report.verdict.exit_code == EXIT_CODES["stopped"]
    assert (report.entered["CATCH"], device.writes) == (0, report.steps)


@pytest.mark.parametrize("phi", [3.0, 2 * math.pi + 0.1], ids=["hangs", "counted a turn"])
def test_the_law_does_not_take_over_where_it_could_not_hold(
    phi: float, memory: CascadeState
) -> None:
    """The pendulum hangs; or a hand holds it, and the counter began a turn off: no output."""
    written: list[float] = []
    far = replace(RECIPE, start=(0.0, phi, 0.0, 0.0))
    device = Device(
        read=lambda k, m: Measurement(m.t, np.array([0.0, phi + 1e-4 * (k % 2)])),
        write=lambda _, u: written.append(float(np.abs(u).max())),
    )
    report = driven(far.make_controller(memory), device, 5.0).report
    assert report.stopped_by.startswith(
        f"bring-up: not where the law can take over, phi = {phi:.3g}"
    )
    assert "within 2 s" in report.stopped_by
    assert max(written) == 0.0


# -- deadlines and clocks --------------------------------------------------------------------------


class Slow(Device):
    """A rig whose reads cost time, while the world goes on or stands still."""

    def __init__(self, clock: SimulatedClock, cost: Callable[[int], float]) -> None:
        super().__init__()
        self.clock, self.cost = clock, cost

    def read(self) -> Measurement:
        self.clock.t += self.cost(self.reads)
        return super().read()


@pytest.mark.parametrize(
    ("cost", "stops"),
    [
        (lambda k: 1.5e-3 if k > 100 else 0.0, True),
        *(
            pytest.param(*case, marks=pytest.mark.slow)
            for case in (
                (lambda k: 0.05 if k == 200 else 0.0, False),  # a host that stands still for once
                (lambda k: 8e-3 if k > 100 else 0.0, True),
                (lambda k: 3e-3 if k > 100 and k % 4 == 0 else 0.0, True),
                (lambda k: 0.9e-3, False),
                (lambda k: 0.02 if k % 200 == 100 else 0.0, False),
            )
        ),
    ],
)
def test_deadlines_missed_beyond_a_share_of_a_second_stop_the_run(
    cost: Callable[[int], float], stops: bool, controller: Controller, tmp_path: Path
) -> None:
    clock = SimulatedClock()
    device = Slow(clock, cost)
    meta = about(controller, RECIPE)
    with Log(tmp_path / "run.db", Columns.of(RECIPE.belief), meta, threaded=False) as book:
        worker = InlineWorker(RECIPE.respond)
        runtime = Runtime(controller, device, worker, clock=clock, log=book)
        report = runtime.run(1.5)
    verdict = report.verdict
    if stops:
        assert report.stopped_by.startswith("deadlines missed in 30% of the last second")
        assert verdict.exit_code == EXIT_CODES["stopped"]
    else:
        assert report.stopped_by == "end of the time asked for"
        assert verdict.ending in ("balanced", "caught", "degraded")
    assert not device.accepted.any()
    assert replay(tmp_path / "run.db").identical


@pytest.mark.parametrize("rate", rest_slow([0.5, 1.2, 2.0, 5.0, 50.0], 0.5, 50.0))
def test_a_rig_whose_clock_runs_at_another_rate_stops_the_run(
    rate: float, controller: Controller, tmp_path: Path
) -> None:
    device = Device(read=lambda k, m: replace(m, t=rate * m.t))
    report = driven(controller, device, 1.5, tmp_path / "run.db").report
    assert "the rig's clock went" in report.stopped_by
    assert f"runs {rate:.2g} times as fast" in report.stopped_by
    assert replay(tmp_path / "run.db").identical


def test_a_rigs_clock_may_jump_jitter_and_stop_with_the_host() -> None:
    """Started late, off by an hour, jittering by half a period, jumping once: it is the same."""
    rng, settings = np.random.default_rng(0), Settings()
    clock, host = RigClock(settings, 0.001), 0.0
    for k in range(5000):
        gap = 0.09 if k % 1000 == 500 else 0.0
        host += 0.001 + gap
        stamp = 3600.0 + host + rng.uniform(0, 5e-4) - (5.0 if k > 2500 else 0.0)
        assert clock.check(stamp, host, k) == ""
    simulated, host = RigClock(settings, 0.001), 0.0
    for k in range(5000):  # a simulated rig knows of no gap
        host += 0.001 + (0.09 if k % 300 == 100 else 0.0)
        assert simulated.check(0.001 * k, host, k) == ""
    slow = RigClock(settings, 0.001)
    for k in range(5000):  # a sensor of half the rate tells when it measured, twice
        assert slow.check(0.002 * (k // 2), 0.001 * k, k) == ""
    refusing = RigClock(settings, 0.001)
    for k in range(5000):  # a simulated rig that takes half of what is written stands still
        assert refusing.check(0.001 * (k // 2), 0.001 * k, k) == ""
    fast = RigClock(settings, 0.001)
    texts = [fast.check(5.0 + 0.002 * k, 0.001 * k, k) for k in range(300)]
    first = next(k for k, text in enumerate(texts) if text)
    assert 90 < first < 120
    assert "runs 2 times as fast" in texts[first]


@pytest.mark.parametrize(
    ("stamps", "times"),
    [
        ((0, 1, 2, math.nan, 4, 5), (1, 2, 3, 4, 5, 6)),  # one is lost
        ((0, 1, 2, -50, 4, 5), (1, 2, 3, 4, 5, 6)),  # one runs back
        ((500, 501, 502, 0, 1, 2), (1, 2, 3, 4, 5, 6)),  # somebody sets the clock
        ((500, 501, math.nan, 0, math.nan, 2), (1, 2, 3, 4, 5, 6)),
        ((0, 0, 2, 2, 4, 4, 6), (1, 2, 3, 4, 5, 6, 7)),  # a sensor slower than the loop
        ((0, 1, 11, 12), (1, 2, 12, 13)),  # nothing was read for a while
    ],
)
def test_no_time_is_counted_twice(stamps: tuple[float, ...], times: tuple[float, ...]) -> None:
    """What passes without a reading whose time makes sense is counted once, in ms."""
    monitor, x, u = SensorMonitor(RECIPE.belief, Settings(), 0.001), np.zeros(4), np.zeros(1)
    counted = []
    for stamp in stamps:
        accepted, found, _ = monitor.check(Measurement(1e-3 * stamp, np.zeros(2)), x, u)
        assert accepted is not None
        assert found == SOUND
        counted.append(1e3 * accepted.t)
    assert counted == pytest.approx(times)


def test_a_read_that_fails_once_is_no_knock(controller: Controller) -> None:
    """The velocities have not jumped: the plan in use goes on, the input changes little."""

    def read(k: int, m: Measurement) -> Measurement:
        if k == 400:
            message = "bus"
            raise OSError(message)
        if k == 500:
            m.t -= 0.05
        return m

    report = driven(controller, Device(read=read)).report
    assert report.steps_with_missing_readings == 2
    assert not [text for _, kind, text in report.events if kind == "jump"]


@pytest.mark.parametrize("told", [lambda t: 1e3 * t, lambda t: min(t, 0.1), lambda _: math.nan])
def test_a_clock_that_makes_no_sense_is_named(
    told: Callable[[float], float], controller: Controller
) -> None:
    """Milliseconds for seconds, a time that stands still, none: no sensor is lost but the clock."""

    def read(k: int, m: Measurement) -> Measurement:
        m.t = told(m.t) if k > 1 else m.t
        return m

    why = driven(controller, Device(read=read)).report.stopped_by
    assert "the rig's clock made no sense for 2" in why
    assert "later than the last one's, by 0.1 s at most" in why


def test_a_device_that_falls_silent_is_not_taken_for_a_wrong_clock(controller: Controller) -> None:
    """Lost readings of the example drivers have no time either."""

    def read(k: int, m: Measurement) -> Measurement:
        return Measurement(math.nan, np.full_like(m.q, math.nan)) if k > 50 else m

    why = driven(controller, Device(read=read)).report.stopped_by
    assert re.search(r"no sensor gave anything for 2\d ms, last at 0\.0", why)


# -- how it ended ----------------------------------------------------------------------------------


GOOD = Report(
    steps=10_000, stopped_by="end of the time asked for", mode_before_stop=Mode.BALANCE,
    settled_time=8.0, final_error=0.01, target_radius=0.35, convergence_time=5.0, cost=3.0,
)  # fmt: skip


@pytest.mark.parametrize(
    ("change", "ending", "code", "words"),
    [
        ({}, "balanced", 0, "‖x‖ = 0.01"),
        ({"final_error": 1.0, "settled_time": 0.5}, "balanced", 0, "converging to the target"),
        ({"final_error": 3.0, "settled_time": 0.5}, "caught", 3, "not at the target"),
        ({"final_error": 1.0}, "caught", 3, "not at the target"),
        ({"settled_time": 0.01}, "caught", 3, "not settled"),
        ({"mode_before_stop": Mode.CATCH}, "caught", 3, "not settled"),
        ({"final_error": math.nan}, "caught", 3, "not at the target"),
        ({"mode_before_stop": Mode.SWING_UP}, "lost", 4, "not caught"),
        ({"stopped_by": "thrown out"}, "lost", 4, "thrown out"),
        ({"stopped_by": "'phi' at 3, past its travel"}, "lost", 4, "travel"),
        ({"mode_before_stop": Mode.BRING_UP}, "stopped", 5, "before the law took over"),
        ({"stopped_by": "operator: stop"}, "stopped", 5, "before the end"),
        ({"stopped_by": "sensor 'phi' frozen"}, "stopped", 5, "frozen"),
        ({"missed_deadlines": 900}, "degraded", 6, "9% of the deadlines"),
        ({"lockstep_mismatches": 1}, "degraded", 6, "lockstep"),
        ({"invalid_answers": 1}, "degraded", 6, "unsound"),
        ({"optimiser_failures": 1}, "degraded", 6, "could not be reached"),
        ({"unit": "V² s"}, "balanced", 0, "cost 3 V² s"),
        ({"failed_writes": 300}, "degraded", 6, "300 writes failed"),
        ({"steps_with_missing_readings": 3000}, "degraded", 6, "missing in 30%"),
        ({"output_problem": "close: OSError: bus"}, "degraded", 6, "bus"),
        ({"output_zero": False, "output_problem": "not taken"}, "stopped", 7, "not taken"),
        ({"output_zero": False, "stopped_by": "thrown out"}, "lost", 7, "thrown out"),
    ],
)
def test_a_verdict_says_how_a_run_ended(
    change: dict[str, object], ending: str, code: int, words: str
) -> None:
    verdict = replace(GOOD, **change).verdict  # type: ignore[arg-type]
    assert isinstance(verdict, RunVerdict)
    assert (verdict.ending, verdict.exit_code) == (ending, code)
    assert words in str(verdict)
    with pytest.raises(AttributeError):
        verdict.ending = "balanced"  # type: ignore[misc]


def test_rows_lost_from_the_log_are_told_and_degrade_the_run(
    controller: Controller, tmp_path: Path
) -> None:
    """While it runs as an event, at the end in the verdict; the mechanism is held all the same."""
    meta = about(controller, RECIPE)
    columns = Columns.of(RECIPE.belief)
    with Log(tmp_path / "run.db", columns, meta, threaded=False, max_bytes=40_000) as book:
        runtime = Runtime(
            controller, Device(), InlineWorker(RECIPE.respond), clock=SimulatedClock(), log=book
        )
        report = runtime.run(1.0)
    assert report.stopped_by == "end of the time asked for"
    assert any(kind == "log" and "rows are lost" in text for _, kind, text in report.events)
    assert report.lost_rows > 0
    assert report.verdict.ending == "degraded"
    assert f"{report.lost_rows:,} rows of the log were lost" in str(report.verdict)


def test_the_cost_of_a_run_is_the_integral_of_its_stage_cost(
    controller: Controller, tmp_path: Path
) -> None:
    """Against the log: Φ = (u/15)² + 0.01 xᵀx, and ‖x‖ of the last estimate."""
    from undertow.runtime import read_log

    report = driven(controller, Device(), 0.5, tmp_path / "run.db").report
    recording = read_log(tmp_path / "run.db")
    x = np.column_stack([recording[name] for name in RECIPE.belief.state_names])
    stage = (recording["voltage"] / 15.0) ** 2 + 0.01 * (x**2).sum(axis=1)
    assert report.cost == pytest.approx(float(stage[:-1] @ np.diff(recording["t"])), rel=1e-9)
    assert report.final_error == pytest.approx(float(np.linalg.norm(x[-1])))


# -- the supervisor -----------------------------------------------------------------------------


LIMITS, SLEW = np.array([15.0]), np.array([7.5])


def test_a_supervisor_says_that_its_rig_did_not_take_zero() -> None:
    """What it writes itself has nobody who sees it fail: closing says so."""
    never = Device(write=fails(lambda k: k > 1, OSError("bus")))
    rig = SupervisedRig(lambda: never, 1e-3, LIMITS, SLEW)
    rig.write(np.array([5.0]))
    time.sleep(0.05)
    with pytest.raises(OutputOnError, match="did not take an output of zero: OSError: bus"):
        rig.close()
    rig.close()  # once is enough
    shut = SupervisedRig(lambda: Device(close=OSError("stuck")), 1e-3, LIMITS, SLEW)
    with pytest.raises(OSError, match=r"^stuck$") as told:
        shut.close()
    assert not isinstance(told.value, OutputOnError)


def test_what_failed_in_a_supervisor_names_its_kind_once() -> None:
    """The loop shows an error with its kind; the supervisor had shown it so before."""
    rig = SupervisedRig(
        lambda: Device(write=fails(lambda _: True, OSError("bus"))), 1e-3, LIMITS, SLEW
    )
    rig.write(np.array([5.0]))
    rig.read()
    with pytest.raises(OSError, match=r"^bus$"):
        rig.write(np.array([5.0]))
    with pytest.raises(OutputOnError, match=r"^the device did not take .* zero: OSError: bus$"):
        rig.close()
    on = SupervisedRig(lambda: Device(close=OutputOnError("relay stuck")), 1e-3, LIMITS, SLEW)
    with pytest.raises(OutputOnError, match=r"^relay stuck$"):
        on.close()


def test_a_supervisor_whose_rig_hangs_is_ended_and_what_is_known_is_told(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It would keep the controller's process from ending, and the device from everybody else."""
    monkeypatch.setattr("undertow.runtime.supervisor.CLOSE_TIMEOUT", 0.2)
    monkeypatch.setattr("undertow.runtime.supervisor.ZERO_TIMEOUT", 0.2)

    class Hanging(Device):
        def close(self) -> None:
            time.sleep(60.0)

    def hang(k: int, _: np.ndarray) -> None:
        time.sleep(60.0 if k > 1 else 0.0)

    for rig, kind, said in (
        (lambda: Device(write=hang), OutputOnError, "is not known"),
        (Hanging, OSError, "does not come to an end"),
    ):
        kept = SupervisedRig(rig, 1e-3, LIMITS, SLEW)
        kept.write(np.array([0.0]))
        kept.write(np.array([0.0]))
        time.sleep(0.05)
        kept.write(np.array([0.0]))
        with pytest.raises(kind, match=said) as told:
            kept.close()
        assert type(told.value) is kind
        kept.process.join(5.0)
        assert not kept.process.is_alive()


def test_who_only_writes_to_a_supervisor_is_told_what_came_of_it() -> None:
    """After a safe stop nothing is read any more: an early failure must not hide that zero came."""
    rig = SupervisedRig(
        lambda: Device(write=fails(lambda k: k < 20, OSError("bus"))), 1e-3, LIMITS, SLEW
    )
    failed = 0
    try:
        rig.write(np.zeros(1))
        assert rig._pipe.poll(10.0)
        rig.read()
        for _ in range(300):
            try:
                rig.write(np.zeros(1))
            except OSError:
                failed += 1
                time.sleep(0.002)
            else:
                break
    finally:
        rig.close()
    assert 1 <= failed < 300


def test_a_supervisor_that_is_gone_leaves_the_output_unknown(controller: Controller) -> None:
    """Killed from outside: the run says that nobody knows whether the output is at zero."""
    rig = SupervisedRig(RECIPE.make_rig, 1e-3, LIMITS, SLEW)
    worker = background_worker(RECIPE.respond, processes=0)
    runtime = Runtime(controller, rig, worker)
    honest, calls = rig.write, count(1)

    def write(u: np.ndarray) -> None:
        if next(calls) == 200:
            rig.process.kill()
        honest(u)

    rig.write = write  # type: ignore[method-assign]
    verdict = runtime.run(2.0).verdict
    assert verdict.exit_code == EXIT_CODES["output on"]
    # Which of the two depends on whether the last writes still went into the pipe.
    told = ("did not take an output of zero", "whether the output is at zero is not known")
    assert any(words in verdict.output_problem for words in told)


def test_a_rig_that_cannot_be_made_is_refused_with_its_own_condition() -> None:
    def make() -> Device:
        raise ArtefactError("port", value="no such port", remedy="Plug it in")

    with pytest.raises(ArtefactError, match=r"port: got no such port\. Plug it in"):
        SupervisedRig(make, 1e-3, LIMITS, SLEW)


def test_the_first_reading_of_a_supervisor_is_not_an_old_one() -> None:
    """The mechanism was moved by hand between the making of the rig and the run."""

    class Moving(Device):
        def read(self) -> Measurement:
            return Measurement(time.perf_counter(), np.zeros(2))

    rig = SupervisedRig(Moving, 1e-3, LIMITS, SLEW)
    try:
        time.sleep(0.2)
        now = time.perf_counter()
        assert rig.read().t >= now
    finally:
        rig.close()


@pytest.mark.slow  # against the clock, and the rig is given its second
@pytest.mark.skipif(not hasattr(signal, "SIGTERM"), reason="asks by signals")
@pytest.mark.parametrize("call", ["write", "close"])
def test_a_second_signal_ends_a_rig_that_never_returns(call: str) -> None:
    """The first asks for a safe stop; one that comes a second after that interrupts the rig."""

    hanging = threading.Event()

    def never(k: int = 300, _: object = None) -> None:
        if k == 300:
            hanging.set()
            time.sleep(60.0)

    def ask() -> None:
        if call == "write":  # `close` comes only after a stop
            hanging.wait(30.0)
        for pause in (1.0, 2.5, 2.5):
            if over.wait(pause):
                return
            os.kill(os.getpid(), signal.SIGTERM)

    device = Device(write=never if call == "write" else lambda _k, _u: None)
    if call == "close":
        device.close = never  # type: ignore[method-assign]
    over = threading.Event()
    with session(RECIPE, rig=device, processes=0, lockstep=False) as runtime:
        asking = threading.Thread(target=ask)
        asking.start()
        began = time.monotonic()
        verdict = runtime.run(30.0).verdict
        assert time.monotonic() - began < 15.0
        over.set()
        asking.join()
    assert runtime.report.interrupted
    if call == "write":
        assert verdict.exit_code == EXIT_CODES["output on"]
    else:
        assert "KeyboardInterrupt" in verdict.output_problem
