"""The drill: no fault brings the output past its limits or ends the loop without a safe stop."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import undertow as ut
from support import rest_slow
from undertow.cascade import CascadeState
from undertow.law import Plan
from undertow.models import FloatArray
from undertow.plants import IdealRig
from undertow.runtime import Columns, InlineWorker, Recipe, Runtime, SimulatedClock, respond
from undertow.runtime.recording import read_log
from undertow.studies.fault_injection import live
from undertow.studies.fault_injection.cases import CASES, Case, OutputMonitor
from undertow.studies.fault_injection.live import (
    LIVE,
    KillResult,
    _ending,
    kill_drill,
    kill_running,
    live_drill,
)
from undertow.studies.fault_injection.report import drill_table
from undertow.studies.fault_injection.simulated import CaseResult, drill, drill_recipe, run_case

RECIPE = replace(drill_recipe(), evaluations=32, horizon=10.0)
MEMORY = CascadeState(Plan.of(ut.Surface(alpha_a=-1, lambda_a=-0.25, alpha_u=1.6, lambda_u=17.3)))


def case(part: str, name: str) -> Case:
    (found,) = [c for c in CASES if (c.part, c.name) == (part, name)]
    return found


def short(one: Case, folder: Path, seconds: float = 1.0) -> CaseResult:
    return run_case(one, RECIPE, MEMORY, folder / "log.db", since=0.3, seconds=seconds)


QUICK = [
    ("nothing", "all is well"),
    ("optimiser", "gives an unstable surface"),
    ("answer", "forged, λ flipped"),
    ("sensor", "one channel lost for good"),
    ("sensor", "sign swapped"),
    ("actuator", "sign swapped"),
    ("rig", "fails to write for good"),
    ("loop", "estimator raises"),
    ("log", "disk full"),
    ("operator", "stops the run"),
]

#: Those that only the slow tests try at this length, too.
LATER = [
    ("answer", "is none at all"),
    ("sensor", "clock stands still"),
    ("sensor", "clock at twice the speed"),
    ("sensor", "one too many for 10 ms"),
    ("rig", "takes 1.5 ms for each read"),
    ("rig", "hangs for 0.3 s"),
    ("loop", "has no memory left"),
]


@pytest.mark.parametrize(("part", "name"), rest_slow([*QUICK, *LATER], *QUICK))
def test_a_fault_ends_as_it_should(part: str, name: str, tmp_path: Path) -> None:
    """Sound outputs, a safe end, an identical replay, held where possible, and its verdict."""
    seconds = {"actuator": 1.5, "answer": 0.6}.get(part, 1.0)
    outcome = short(case(part, name), tmp_path, seconds)
    assert outcome.passed, outcome.happened
    if not outcome.case.holds:
        assert outcome.after <= 1.2


def test_ctrl_c_ends_the_drill_and_is_no_fault_of_its_list(tmp_path: Path) -> None:
    """A run takes it for its operator's stop; what the run is a part of has to end as well."""

    def interrupted(_: FloatArray) -> FloatArray:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        short(Case("loop", "Ctrl-C", False, estimator=interrupted), tmp_path)


def test_ctrl_c_ends_what_a_drill_was_about_to_kill(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It ran on for a minute, and the drill waited for it."""

    class Victim:
        ended = 0

        def kill(self) -> None:
            self.ended += 1
            (tmp_path / "supervisor.json").touch()  # as its rig's process does, which is not killed

        def join(self) -> None:
            self.ended += 1

    def interrupted(*_: object) -> float:
        raise KeyboardInterrupt

    victim = Victim()
    monkeypatch.setattr(live, "fork", lambda *_, **__: victim)
    monkeypatch.setattr(live, "_first_line", interrupted)
    with pytest.raises(KeyboardInterrupt):
        live.kill_run(RECIPE, 0.1, tmp_path)
    assert victim.ended == 2


def test_the_list_is_long_and_covers_every_part() -> None:
    parts = Counter(c.part for c in CASES)
    assert len(CASES) >= 25
    assert set(parts) >= {
        "optimiser", "answer", "sensor", "actuator", "rig", "loop", "log", "operator",
    }  # fmt: skip
    assert len({(c.part, c.name) for c in CASES}) == len(CASES)
    assert any(c.holds for c in CASES)
    assert any(not c.holds for c in CASES)


def test_the_witness_sees_what_is_wrong() -> None:
    """NaN, past the limits, too fast: none of them goes by, and sound outputs do."""
    rig = IdealRig(RECIPE.belief)
    for wrong, word in ((np.nan, "finite"), (16.0, "limits"), (9.0, "slew")):
        witness = OutputMonitor(rig, np.array([15.0]), np.array([5.0]))
        for sound in (4.0, 8.0, 3.5):
            witness.write(np.array([sound]))
        assert not witness.faults
        try:
            witness.write(np.array([wrong]))
        except ut.base.errors.InvalidInputError:
            assert np.isnan(wrong)  # no rig takes that
        assert word in witness.faults[0]


def test_an_outcome_with_one_bad_output_does_not_pass(tmp_path: Path) -> None:
    """The verdict is no rubber stamp: each of its conditions can fail it."""
    good = short(case("nothing", "all is well"), tmp_path, 0.6)
    assert good.passed
    for spoilt in (
        replace(good, output_faults=("past its limits",)),
        replace(good, ended_safely=False),
        replace(good, replayed=False),
        replace(good, held=False),
        replace(good, verdict=replace(good.verdict, output_zero=False)),
        replace(good, verdict=replace(good.verdict, ending="degraded")),
        replace(good, verdict=replace(good.verdict, ending="stopped")),
    ):
        assert not spoilt.passed
    assert drill_table([good]).row_count == 2  # what fails, and how


def test_the_drill_looks_at_the_slew_rate(tmp_path: Path) -> None:
    """A tenth of the slew rate declared to the witness, and the same run is not sound."""
    controller = RECIPE.make_controller(MEMORY)
    witness = OutputMonitor(RECIPE.make_rig(), controller.limits, 0.1 * controller.slew)
    worker = InlineWorker(lambda request: respond(RECIPE.cascade, request))
    Runtime(controller, witness, worker, clock=SimulatedClock()).run(0.1)
    assert any("slew" in fault for fault in witness.faults)


def test_a_run_that_stopped_by_itself_is_told_from_one_that_was_killed(tmp_path: Path) -> None:
    """From its log: the reason of its stop; but a log that is cut off anywhere tells of none."""
    assert short(case("rig", "fails to read for good"), tmp_path).passed
    recording, columns = read_log(tmp_path / "log.db"), Columns.of(RECIPE.belief)
    assert "no answer from the card" in _ending(recording, columns)
    for rows in (1, 100, len(recording.steps) - 1):
        assert _ending(replace(recording, steps=recording.steps[:rows]), columns) == ""
    one = KillResult(1.7, 388, 1.3, 0.0, True, 0.02)
    assert not one.passed
    assert replace(one, stopped_by="lost").passed
    assert not replace(one, stopped_by="lost", identical=False).passed
    assert not replace(one, stopped_by="lost", to_zero=0.2).passed


# -- the whole of it --------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_the_whole_drill_passes(seed: int) -> None:
    outcomes = drill(seed=seed)
    assert [(o.case.name, o.happened) for o in outcomes if not o.passed] == []


@pytest.mark.slow
def test_no_fault_is_unsafe_while_it_swings_up(tmp_path: Path) -> None:
    """On a cart between its stops: sound outputs, a safe end and an identical replay in all."""
    recipe = Recipe("cart_pendulum", rig="realistic", evaluations=32, swing_up=True)
    memory = recipe.first()
    for number, one in enumerate(CASES):
        log = tmp_path / f"{number}.db"
        outcome = run_case(one, recipe, memory, log, since=0.6, seconds=1.5)
        sound = not outcome.output_faults and outcome.ended_safely and outcome.replayed
        assert sound, (one.name, outcome.happened, outcome.output_faults)


@pytest.mark.parametrize(
    ("name", "ending", "code"),
    rest_slow(
        [
            ("takes 1.5 ms for each read", "stopped", 5),
            ("fails in every second write", "stopped", 5),
            ("fails to write for good", "stopped", 7),
            ("is knocked over", "lost", 4),
            ("hangs for 25 ms", "balanced", 0),
        ],
        ("fails to write for good", "stopped", 7),
        ("is knocked over", "lost", 4),
    ),
)
def test_a_rig_that_fails_gives_the_verdict_and_exit_code_it_should(
    name: str, ending: str, code: int, tmp_path: Path
) -> None:
    outcome = short(case("rig", name), tmp_path, 0.9)
    assert (outcome.verdict.ending, outcome.verdict.exit_code) == (ending, code)


def test_a_run_whose_log_cannot_be_made_does_not_begin() -> None:
    """The one case of the live part that takes no time."""
    said, passed = LIVE["log", "cannot be made"]()
    assert passed
    assert said.startswith("refused before the run: ")


@pytest.mark.slow
def test_the_live_part_of_the_drill_passes() -> None:
    """Processes killed or stopped, a call that blocks, a log that cannot be made."""
    assert [one for one in live_drill() if not one.passed] == []


@pytest.mark.slow
def test_fifty_runs_killed_at_random_moments() -> None:
    """Every log opens, at most 0.1 s is missing, every replay is identical bit for bit.

    All 50 are going on when they are killed: what had stopped by itself comes on top.
    """
    killed = kill_drill(50)
    late = [one for one in killed if not one.passed]
    # A machine that was busy for a moment is none the next time; a fault comes again.
    assert len(late) <= 2
    recipe = drill_recipe(0)
    again = [kill_running(recipe, one.moment)[-1] for one in late]
    assert [one for one in again if not one.passed] == []
    assert sum(not one.stopped_by for one in killed) == 50
