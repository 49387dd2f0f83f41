"""Processes beside the fast loop: those that optimise, and the supervisor of a rig."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest

from runs import RECIPE
from undertow.cascade import CascadeState
from undertow.plants import Measurement
from undertow.runtime import (
    background_worker,
    respond,
)
from undertow.runtime.slow_loop import Answer, Request
from undertow.runtime.supervisor import QUEUE, SupervisedRig
from undertow.studies.fault_injection.cases import OutputMonitor


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
    np.testing.assert_array_equal(there.law_vectors, here.law_vectors)
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


def test_a_supervisor_brings_the_output_to_zero_when_its_controller_falls_silent(
    tmp_path: Path,
) -> None:
    """Within the slew rate, and the rig goes on giving measurements."""
    limits, slew = np.array([15.0]), np.array([7.5])

    written = tmp_path / "written"
    written.touch()

    class Watched(OutputMonitor):
        def write(self, u: np.ndarray) -> None:
            super().write(u)
            with written.open("a") as file:
                file.write(f"{float(u[0])} {len(self.faults)}\n")

    rig = SupervisedRig(lambda: Watched(RECIPE.make_rig(), limits, slew), 1e-3, limits, slew)
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


def test_a_supervisor_that_was_held_up_applies_the_newest_output_alone(tmp_path: Path) -> None:
    """Not all that has queued in one rush; and what a terminal sends does not reach it."""
    limits, slew = np.array([15.0]), np.array([7.5])
    written = tmp_path / "written"

    class Told(OutputMonitor):
        def write(self, u: np.ndarray) -> None:
            super().write(u)
            with written.open("a") as file:
                file.write(f"{float(u[0])}\n")

    rig = SupervisedRig(lambda: Told(RECIPE.make_rig(), limits, slew), 1e-3, limits, slew)
    try:
        pid = rig.process.pid or 0
        assert os.getsid(pid) != os.getsid(0)
        os.kill(pid, signal.SIGSTOP)
        for u in (1.0, 2.0, 3.0, 4.0, 5.0):
            rig.write(np.array([u]))
        with pytest.raises(TimeoutError, match="supervisor"):
            rig.read()
        for _ in range(QUEUE - 5):
            rig.write(np.array([5.0]))
        with pytest.raises(TimeoutError, match="supervisor"):  # it never waits
            rig.write(np.array([5.0]))
        os.kill(pid, signal.SIGCONT)
        assert rig._pipe.poll(10.0)
        rig.read()
    finally:
        rig.close()
    assert [float(line) for line in written.read_text().split()] == [5.0, 0.0]


def test_a_supervisor_outlives_a_rig_that_fails_and_says_so() -> None:
    """A failed read or write is the controller's to judge; it comes to zero all the same."""
    limits, slew = np.array([15.0]), np.array([7.5])

    class Failing(OutputMonitor):
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

    rig = SupervisedRig(
        lambda: Failing(RECIPE.make_rig(), limits, slew), 1e-3, limits, slew, controller_timeout=9.0
    )

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
