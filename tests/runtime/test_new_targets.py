"""Another target for a run that goes on: checked, taken by the next step, told again by the log."""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import socket
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import undertow as ut
from runs import run_until, short_searches
from undertow.base import ArtefactError, InvalidInputError
from undertow.cascade import CascadeState
from undertow.law import ReferenceMotion
from undertow.plants import Measurement
from undertow.runtime import (
    Command,
    InlineWorker,
    Inputs,
    Mode,
    Recipe,
    RunTarget,
    Runtime,
    Settings,
    SimulatedClock,
    send_target,
    session,
    target_of_run,
)
from undertow.runtime.encoding import legs_from, legs_to
from undertow.runtime.slow_loop import Request
from undertow.runtime.targets import MOST_BYTES, Listener, address_path, legs_from_here
from undertow.runtime.verdict import Report

RECIPE = Recipe(start=(0.0, 0.2, 0.0, 0.0), evaluations=64)


@cache
def begun() -> tuple[Recipe, CascadeState]:
    """A recipe, and what its cascade starts with."""
    recipe = Recipe(start=(0.0, 0.05, 0.0, 0.0), evaluations=32)
    with short_searches():
        return recipe, recipe.first()


def run_and_ask(
    recipe: Recipe, seconds: float, orders: dict[int, Callable[[Runtime], object]], log: Path
) -> Report:
    """Run in simulated time; when so many steps have been made, do what is ordered."""
    with session(recipe, log=log, simulated=True) as runtime:
        read = runtime.rig.read

        def reading() -> Measurement:
            if runtime.report.steps in orders:
                orders.pop(runtime.report.steps)(runtime)
            return read()

        runtime.rig.read = reading  # type: ignore[method-assign]
        report = runtime.run(seconds)
    assert not orders
    return report


def of_target(report: Report) -> list[tuple[float, str]]:
    return [(round(t, 3), text) for t, what, text in report.events if what == "target"]


@pytest.mark.slow
@short_searches()
def test_a_run_is_given_another_target_and_replayed_to_the_same_bits(tmp_path: Path) -> None:
    """Asked for twice: the second takes the first's place before there is a plan for that."""
    log, found = tmp_path / "run.db", []
    orders: dict[int, Callable[[Runtime], object]] = {
        300: lambda run: run.retarget({"theta": 1.0}),
        500: lambda run: found.append(run.retarget({"theta": -0.4})),
        2000: lambda run: found.append(run.target),
    }
    report = run_and_ask(begun()[0], 3.4, orders, log)
    assert report.verdict.ending == "balanced"
    assert of_target(report) == [
        (0.3, "asked for at 0.3 s: theta = 1"),
        (0.5, "asked for at 0.5 s: theta = -0.4"),
        (1.5, "jumps, asked for at 0.5 s"),
    ]
    asked, reached = found
    assert asked.now == {}
    assert [place for _, place in asked.ahead] == [{"theta": -0.4}]
    assert reached.now == {"theta": -0.4}
    assert reached.ahead == ()
    again = ut.replay(log)
    assert again.identical
    assert again.misjudged == 0
    assert abs(again.recording["theta"][-1] + 0.4) < 0.1
    (told, _) = [one for one in again.recording.events if one[2] == "set-points"]
    assert told[:2] == (300, 0.3)


@pytest.mark.slow
def test_a_log_without_what_was_asked_for_is_another_run(tmp_path: Path) -> None:
    """What was asked for is what the replay goes by."""
    import sqlite3

    log = tmp_path / "run.db"
    run_and_ask(RECIPE, 2.0, {300: lambda run: run.retarget({"theta": 0.5})}, log)
    with sqlite3.connect(log) as book:
        book.execute("DELETE FROM events WHERE kind = 'set-points'")
    book.close()
    assert not ut.replay(log, decisions=False).identical


@pytest.mark.slow
def test_a_swing_up_with_set_points_catches_at_0_and_goes_there(tmp_path: Path) -> None:
    """And back there when it was thrown out, for which it is caught at 0 again."""
    recipe = Recipe(
        rig="realistic", swing_up=True, evaluations=64,
        target=((0.0, {"theta": 0.6}), (6.0, {"theta": -0.3})),
    )  # fmt: skip
    log = tmp_path / "run.db"
    with session(recipe, log=log, simulated=True) as runtime:
        report = runtime.run(16.0)
    assert report.verdict.ending == "balanced"
    texts = [text for _, text in of_target(report)]
    assert texts == ["jumps, asked for at 0 s", "jumps, asked for at 6 s"]
    balanced = next(t for t, _, text in report.events if "→ BALANCE" in text)
    assert of_target(report)[0][0] > balanced
    again = ut.replay(log)
    assert again.identical
    late = again.recording["t"] > 12.0  # friction keeps it wandering about there
    assert abs(again.recording["theta"][late].mean() + 0.3) < 0.15


@short_searches()
def test_thrown_out_the_target_is_asked_for_again() -> None:
    """What catches does so at x = 0: the target that was in force is ahead once more."""
    recipe = Recipe(swing_up=True, evaluations=32)
    controller = recipe.make_controller(recipe.first())
    there = ReferenceMotion.at_rest(np.array([0.6, 0.0]))
    controller.memory = replace(controller.memory, target=there)
    controller.mode = Mode.BALANCE
    controller._change(3.0, Mode.SWING_UP, "thrown out")
    assert controller.ahead == ((3.0, there),)
    asked = Request(3.0, recipe.belief.state(phi=0.02), 3.02, controller.memory, 0)
    answer = recipe.respond(asked)
    assert answer.admission.accepted
    assert answer.memory.target is None


@pytest.mark.slow
def test_where_there_is_no_plan_the_target_stays_and_the_run_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is asked for again after a while, and planned anew where it stands meanwhile."""
    recipe = replace(RECIPE)

    def nothing(*_: object) -> object:
        raise ut.base.InfeasibleError("no surface", remedy="Go elsewhere")

    cascade = recipe.cascade
    memory = recipe.first()
    monkeypatch.setattr(type(cascade), "start_to", nothing)
    controller = recipe.make_controller(memory)
    worker = InlineWorker(recipe.respond, 0.05)
    runtime = Runtime(controller, recipe.make_rig(), worker, clock=SimulatedClock())
    runtime.retarget({"theta": 0.5})
    report = runtime.run(3.0)
    assert report.verdict.ending == "balanced"
    stays = [t for t, text in of_target(report) if text.startswith("stays, there is no plan")]
    assert len(stays) == 3
    assert all(0.9 < after - before < 1.3 for before, after in itertools.pairwise(stays))
    assert report.answers["applied"] > 10
    assert runtime.target.now == {}
    with pytest.raises(InvalidInputError, match="the run has stopped: end of the time asked for"):
        runtime.retarget({"theta": 0.5})


HERE, ELSEWHERE = (ReferenceMotion.at_rest(np.array([q, 0.0])) for q in (0.3, 0.4))


@short_searches()
@pytest.mark.parametrize(
    ("asked", "jump", "target"),
    [
        (False, True, ELSEWHERE), (False, False, ELSEWHERE), (True, True, ELSEWHERE),
        *(pytest.param(*case, marks=pytest.mark.slow)
          for case in ((False, True, None), (True, True, None), (True, True, HERE))),
    ],
)  # fmt: skip
def test_an_answer_for_another_target_is_refused(
    asked: bool, jump: bool, target: ReferenceMotion | None
) -> None:
    """A jump that nobody asked for, one that goes elsewhere, and a target that slips in."""
    recipe, memory = begun()
    controller, rig = recipe.make_controller(memory), recipe.make_rig()
    told = ((0.0, HERE),) if asked else ()
    answer, said, asks = None, [], 0
    for k in range(1200):
        command = Command.START if k == 0 else Command.NONE
        inputs = Inputs(1e-3 * k, rig.read(), answer, command, target=told if k == 5 else ())
        rig.write(controller.step(inputs))
        said += [note.text for note in controller.notes]
        answer, request = None, controller.request
        if request is not None and (request.target is not None) == asked and not asks:
            asks += 1
            honest = recipe.respond(request)
            answer = replace(honest, memory=replace(honest.memory, target=target), jump=jump)
    assert asks == 1
    assert controller.mode is Mode.BALANCE
    good = asked and target is HERE
    assert any("unsound: its plan is for another target" in text for text in said) == (not good)
    assert controller.memory.target is (HERE if good else None)


@pytest.mark.slow
def test_a_jump_is_not_made_where_the_state_is_not_the_expected_one() -> None:
    """The output of that step is the old plan's about the old target."""
    recipe = Recipe(start=(0.0, 0.05, 0.0, 0.0), evaluations=32)
    there = ReferenceMotion.at_rest(np.array([1.0, 0.0]))
    outputs = []
    for told in ((), ((0.0, there),)):
        controller, rig = recipe.make_controller(recipe.first()), recipe.make_rig()
        answer, said, u = None, [], []
        for k in range(1200):
            command = Command.START if k == 0 else Command.NONE
            inputs = Inputs(1e-3 * k, rig.read(), answer, command, target=told if k == 5 else ())
            u.append(controller.step(inputs).copy())
            rig.write(u[-1])
            said += [note.text for note in controller.notes]
            answer = None
            if controller.request is not None and (not told or controller.request.target):
                honest = recipe.respond(controller.request)
                answer = replace(honest, x=honest.x + 1.1) if told else None
        outputs.append(np.array(u))
    assert any("refused, the state is off its prediction by" in text for text in said)
    assert controller.memory.target is None
    assert np.array_equal(outputs[0], outputs[1])


# -- what is refused -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("target", "words"),
    [
        ({"x": 2.0}, "got x = 2 m"),
        ({"theta": 0.1}, "moved along x, on which neither M nor f depends"),
        ({"x_dot": 0.1}, "velocity 0: a set-point is at rest"),
        ({"y": 0.1}, "got 'y'"),
        ({"x": float("nan")}, "NaN|finite|nan"),
        ({"x": 0.8}, "between -0.75 and 0.75 m, where a run stops"),
    ],
)
def test_what_cannot_be_a_target_is_refused_and_nothing_changes(
    target: dict[str, float], words: str
) -> None:
    crane = ut.mechanisms.overhead_crane()
    objective = ut.objective_for(crane, "bench-time")
    settings, here = Settings(max_travel=0.75), np.zeros(2)
    with pytest.raises(InvalidInputError, match=words):
        legs_from_here(crane, objective, settings, here, ut.SetPoints(target))


def test_coordinates_that_are_not_named_stay_where_the_target_is() -> None:
    crane = ut.mechanisms.gantry_crane()
    objective = ut.objective_for(crane, "bench-time")
    here = np.array([0.3, -0.2, 0.0, 0.0])
    goal = ut.SetPoints([(0, {"y": 0.1}), (2, {"x": 0.0})])
    (_, first), (begin, second) = legs_from_here(crane, objective, Settings(), here, goal)
    assert begin == 2.0
    assert first.q[0].tolist() == [0.3, 0.1, 0.0, 0.0]
    assert second.q[0].tolist() == [0.0, 0.1, 0.0, 0.0]
    ((begin, later),) = legs_from_here(
        crane, objective, Settings(), here, ut.SetPoints([(3, {"x": 0.1})])
    )
    assert (begin, later.q[0].tolist()) == (3.0, [0.1, -0.2, 0.0, 0.0])


def test_what_was_asked_for_is_written_to_the_bit() -> None:
    legs = tuple((k / 3, ReferenceMotion.at_rest(np.array([k / 7, -1e-9]))) for k in range(3))
    again = legs_from(legs_to(legs))
    assert [begin for begin, _ in again] == [begin for begin, _ in legs]
    for (_, a), (_, b) in zip(legs, again, strict=True):
        assert np.array_equal(a.q, b.q)


def test_a_step_takes_a_target_with_the_lockstep_check() -> None:
    """Inputs hold it, so that a step that is made twice is made with it."""
    legs = ((0.0, ReferenceMotion.at_rest(np.array([0.5, 0.0]))),)
    recipe, start = begun()
    controller = recipe.make_controller(start)
    controller.step(Inputs(0.0, None, target=legs))
    assert controller.ahead == legs
    assert controller.aim.tolist() == [0.5, 0.0]


# -- from another process --------------------------------------------------------------------


class Told:
    """A run that keeps what it was asked for."""

    def __init__(self) -> None:
        self.goals: list[ut.SetPoints] = []
        self.target = RunTarget("crane", {"x": "m"}, 1.5, {"x": 0.25}, ((2.0, {"x": 1 / 3}),), "…")

    def retarget(self, target: ut.SetPoints) -> RunTarget:
        if target.pairs[0][1].get("x", 0.0) > 1:
            raise InvalidInputError("target", value="x = 2 m", limit="< 1 m", remedy="Stay inside")
        if target.pairs[0][1].get("x") == 0.5:
            raise RuntimeError("something of ours")
        self.goals.append(target)
        return replace(self.target, now={})


@pytest.fixture
def told() -> Told:
    return Told()


@pytest.fixture
def log(told: Told, tmp_path: Path) -> Iterator[Path]:
    """The log of a run that listens."""
    path = tmp_path / "run.db"
    with contextlib.closing(Listener(told, path)) as listener:
        assert not listener.failure
        yield path
    assert not address_path(path).exists()


def test_another_process_asks_for_a_target(log: Path, told: Told) -> None:
    """And where it is; numbers to the bit, and the reason where it is refused."""
    assert target_of_run(log) == told.target
    goal = ut.SetPoints([(0, {"x": 1 / 3}), (0.1, {"x": -1e-3})])
    found = send_target(log, goal)
    assert (found.now, found.ahead) == ({}, told.target.ahead)
    assert told.goals == [goal]
    with pytest.raises(InvalidInputError, match=r"got x = 2 m, must be < 1 m\. Stay inside"):
        send_target(str(log), {"x": 2.0})
    with pytest.raises(InvalidInputError, match="RuntimeError: something of ours"):
        send_target(log, {"x": 0.5})
    assert send_target(log, {"x": 0.1}).t == 1.5  # it goes on
    if os.name == "posix":
        assert address_path(log).stat().st_mode & 0o777 == 0o600


def said(log: Path, line: bytes) -> bytes:
    """Say a line, whatever it is, and return what is answered."""
    port = json.loads(address_path(log).read_text())["port"]
    with socket.create_connection(("127.0.0.1", port), timeout=5.0) as visitor:
        visitor.sendall(line)
        visitor.shutdown(socket.SHUT_WR)
        answer = b""
        try:
            while part := visitor.recv(1 << 16):
                answer += part
        except ConnectionError:
            pass
        return answer


@pytest.mark.parametrize(
    ("line", "answer"),
    [
        (b"GET / HTTP/1.1\r\n\r\n", b"must be JSON"),
        (b"\xff\xfe\n", b"must be JSON"),
        (b'{"points": [[0, {"x": 0.1}]]}\n', b"another one"),
        (b'{"token": "0123", "points": [[0, {"x": 0.1}]]}\n', b"another one"),
        (b'{"token": "\xc3\xa4"}\n', b"another one"),
        (b"[" * 2000 + b"\n", b"JSON"),
        (b"x" * (MOST_BYTES + 2), b""),
        (b'{"token"', b""),
        (b"", b""),
    ],
    ids=range(9),
)
def test_who_has_no_token_is_told_nothing_and_changes_nothing(
    log: Path, told: Told, line: bytes, answer: bytes
) -> None:
    found = said(log, line)
    assert answer.replace(b"must be ", b"") in found
    assert b"crane" not in found
    assert told.goals == []
    assert target_of_run(log) == told.target  # it still listens


@pytest.mark.parametrize(
    "points", [3, "x=1", [[0, "x"]], [[0, {"x": "a"}]], [[-1, {"x": 0}]], [], {"x": True}, [[0]]]
)
def test_with_the_token_what_are_no_set_points_is_refused(
    log: Path, told: Told, points: object
) -> None:
    token = json.loads(address_path(log).read_text())["token"]
    answer = said(log, json.dumps({"token": token, "points": points}).encode() + b"\n")
    assert "error" in json.loads(answer)
    assert told.goals == []


def test_who_says_nothing_keeps_others_waiting_for_a_while_alone(
    log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("undertow.runtime.targets.LINE_TIMEOUT", 0.3)
    port = json.loads(address_path(log).read_text())["port"]
    with socket.create_connection(("127.0.0.1", port)):
        assert target_of_run(log).t == 1.5


def test_nobody_who_listens_is_said_in_one_line(tmp_path: Path) -> None:
    """Ended, killed, or something else of that name."""
    log = tmp_path / "run.db"
    with pytest.raises(ArtefactError, match="no such log"):
        send_target(log, {"x": 0.1})
    log.touch()
    with pytest.raises(ArtefactError, match="one that has ended, has not begun, or is"):
        send_target(log, {"x": 0.1})
    with socket.socket() as door:
        door.bind(("127.0.0.1", 0))
        port = door.getsockname()[1]
    for text, words in [
        (json.dumps({"port": port, "token": "0"}), "no answer, .*: it was killed, or is busy"),
        ("nothing", "is no address"),
        ('{"port": 0, "token": ""}', "no port and token"),
        ("[1]", "is no address"),
        ("x" * 2000, "1024"),
    ]:
        address_path(log).write_text(text)
        with pytest.raises(ArtefactError, match=words):
            target_of_run(log)


def test_an_answer_that_is_none_is_refused(tmp_path: Path) -> None:
    """Another program may have the port of a run that was killed."""
    log = tmp_path / "run.db"
    for reply in (b"{}\n", b"[]\n", b'{"target": {"t": 1}}\n', b"3\n", b"HTTP/1.1 400\n"):
        with socket.create_server(("127.0.0.1", 0)) as door:
            port = door.getsockname()[1]
            address_path(log).write_text(json.dumps({"port": port, "token": "0"}))

            def serve(door: socket.socket = door, reply: bytes = reply) -> None:
                visitor, _ = door.accept()
                with visitor:
                    visitor.recv(1000)
                    visitor.sendall(reply)

            thread = threading.Thread(target=serve)
            thread.start()
            with pytest.raises(ArtefactError, match=r"an answer that is none|no answer"):
                target_of_run(log)
            thread.join()


def test_a_run_that_cannot_listen_goes_on(tmp_path: Path, told: Told) -> None:
    """A folder in the place of the address: the reason is kept."""
    address_path(tmp_path / "run.db").mkdir()
    with contextlib.closing(Listener(told, tmp_path / "run.db")) as listener:
        assert listener.failure
    assert address_path(tmp_path / "run.db").is_dir()


@pytest.mark.slow
def test_against_the_clock_another_process_steers_the_run(tmp_path: Path) -> None:
    """From its log's name alone; what is past the travel is refused with the run's own reason."""
    log, found = tmp_path / "run.db", []

    def ask() -> None:
        threading.Event().wait(1.0)
        with pytest.raises(InvalidInputError, match="95 % of the max_travel of the run"):
            send_target(log, {"theta": 3.0})
        found.append(send_target(log, {"theta": 0.4}))

    # The model is taken for the plant: with a bound many plausible plants take a search seconds.
    recipe = replace(RECIPE, settings=Settings(max_travel=2.0), seconds=0.03, learns=False)
    with session(recipe, log=log, processes=1) as runtime:
        assert runtime.deaf == ""
        asking = threading.Thread(target=ask)
        asking.start()
        report = run_until(
            runtime,
            lambda report: (
                report.steps > 5000 and any("jumps" in text for _, text in of_target(report))
            ),
        )
        asking.join()
    assert found[0].ahead[0][1] == {"theta": 0.4}
    assert "jumps" in of_target(report)[-1][1]
    assert not report.lockstep_mismatches
    assert ut.replay(log).identical
    with pytest.raises(ArtefactError):
        target_of_run(log)
