"""The commands run, replay and drill."""

from __future__ import annotations

import io
import os
import re
import sqlite3
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from typer.testing import CliRunner

import undertow as ut
from runs import short_searches
from support import rest_slow
from undertow.cli import app
from undertow.runtime import read_log

runner = CliRunner()


def run(*words: str) -> tuple[int, str, str]:
    result = runner.invoke(app, list(words), env={"COLUMNS": "120", "TERM": "dumb"})
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, result.stdout, result.stderr


@pytest.mark.parametrize("command", ["run", "replay", "drill"])
def test_help_has_examples_that_parse(command: str) -> None:
    code, out, _ = run(command, "--help")
    assert code == 0
    before, examples = out.split("Examples")
    assert f"undertow {command}" in examples
    options = set(re.findall(r"--[a-z-]+", before))
    assert set(re.findall(r"--[a-z-]+", examples)) <= options


@pytest.mark.slow
def test_a_run_is_logged_and_its_replay_is_identical(tmp_path: Path) -> None:
    """The log of ``run``, through ``replay``, with pictures; a changed output is found."""
    log = tmp_path / "run.db"
    words = ("--start", "phi=15deg", "--seconds", "0.5", "--simulated", "--log", str(log))
    code, out, _ = run("run", "rotary_pendulum", *words)
    assert code == 0
    assert "end of the time asked for" in out
    assert "Verdict: balanced, settled for 0.2 s, converging to the target; ‖x‖ = " in out
    code, out, _ = run("replay", str(log), "--out", str(tmp_path / "figures"))
    assert code == 0
    assert "identical, bit for bit" in out
    names = {path.name for path in (tmp_path / "figures").iterdir()}
    assert names == {"motion.png", "latency.png", "chatter.png"}
    with sqlite3.connect(log) as file:
        file.execute("UPDATE steps SET voltage = voltage + 1 WHERE k = 100")
    file.close()
    code, out, _ = run("replay", str(log), "--no-decisions")
    assert code == 1
    assert "1 steps differ, the first is 100" in out
    with sqlite3.connect(log) as file:
        file.execute("DELETE FROM steps")
    file.close()
    code, out, _ = run("replay", str(log))
    assert code == 1
    assert "nothing to compare" in out
    assert "identical" not in out


@pytest.mark.parametrize(
    ("words", "value"),
    [
        (("run", "piano"), "'piano'"),
        (("run", "rotary_pendulum", "--start", "phi=40"), "'40'"),
        (("run", "rotary_pendulum", "--lead", "-1"), "-1"),
        (("run", "rotary_pendulum", "--rig", "real"), "FILE.py:NAME"),
        (("run", "rotary_pendulum", "--delay", "0.002"), "on an ideal rig"),
        (("run", "rotary_pendulum", "--rig", "realistic", "--delay", "-1"), "≥ 0"),
        (("run", "rotary_pendulum", "--limit", "voltage=20"), "20 V, must be 0 V to 15 V"),
        (("run", "rotary_pendulum", "--limit", "volt=5"), "one of voltage"),
        (("run", "cart_pendulum", "--travel", "x=3m"), "3 m, must be 0 m to 1.5 m"),
        (("run", "cart_pendulum", "--travel", "x=30"), "--travel x=30m"),
        (("run", "cart_pendulum", "--travel", "x_dot=1m/s"), "one of x, phi"),
        (("run", "cart_pendulum", "--travel", "x=0.2m", "--target", "x=0.5m"), "≤ 0.19 m"),
    ],
)
def test_bad_words_are_refused_in_one_line(words: tuple[str, ...], value: str) -> None:
    code, out, err = run(*words)
    assert code == 2
    assert out == ""
    assert value in err
    assert len(err.strip().splitlines()) == 1


@pytest.mark.slow
def test_a_run_ends_with_a_verdict_and_its_exit_code(tmp_path: Path) -> None:
    """Too short to settle: caught, 3; nothing to hold it with: lost or stopped; help tells all."""
    words = ("run", "rotary_pendulum", "--start", "phi=15deg", "--simulated")
    code, out, _ = run(*words, "--seconds", "0.2")
    assert code == 3
    assert "Verdict: caught, not settled at the end; ‖x‖ = " in out
    code, out, _ = run(*words, "--seconds", "8")
    assert code == 0
    assert re.search(r"Verdict: balanced; ‖x‖ = 0\.\d+ at the end, cost \d", out)
    code, out, _ = run(*words, "--seconds", "0.03", "--rig", "realistic")
    assert code in (3, 5)
    code, out, _ = run("run", "--help")
    for number, word in ((3, "caught"), (4, "lost"), (5, "stopped"), (6, "degraded")):
        assert f"{number} {word}" in " ".join(out.split())


def test_a_supervisor_is_refused_in_simulated_time() -> None:
    code, _, err = run("run", "rotary_pendulum", "--simulated", "--supervisor")
    assert code == 2
    assert "--supervisor: got with --simulated" in err


@pytest.mark.slow
def test_a_run_in_mujoco_has_one_estimator_in_python_and_on_the_command_line(
    tmp_path: Path,
) -> None:
    """That of a usual bench: the command line had the one for exact states."""
    pytest.importorskip("mujoco")
    from undertow.plants import MuJoCoRig

    typed, called = tmp_path / "typed.db", tmp_path / "called.db"
    words = ("--rig", "mujoco", "--simulated", "--seconds", "0.05", "--delay", "0.002")
    run("run", "rotary_pendulum", *words, "--log", str(typed))
    rig = ut.mechanisms.rotary_pendulum()
    ut.run(ut.Cascade(rig), MuJoCoRig(rig), seconds=0.05, simulated=True, log=called, delay=0.002)
    kinds = [read_log(log).meta["recipe"]["rig"] for log in (typed, called)]
    assert kinds == ["realistic", "realistic"]


KEPT = """
import os
from pathlib import Path
import numpy as np
from undertow import mechanisms
from undertow.plants import IdealRig

class Arm(IdealRig):
    def __init__(self):
        m = mechanisms.rotary_pendulum()
        super().__init__(m, m.state(phi=0.2))
        self.note("made", os.getpid())

    def note(self, what, number):
        with open(Path(__file__).parent / "notes", "a") as file:
            file.write(f"{what} {number}\\n")

    def write(self, u):
        super().write(u)
        self.last = float(u[0])

    def close(self):
        self.note("last", getattr(self, "last", 0.0))
        self.note("closed", os.getpid())
"""


@short_searches()
@pytest.mark.skipif(not hasattr(os, "fork"), reason="a supervisor is a forked process")
@pytest.mark.parametrize("supervisor", rest_slow([None, "--no-supervisor"], None))
def test_a_rig_of_ones_own_is_kept_by_another_process_unless_told_otherwise(
    supervisor: str | None, tmp_path: Path
) -> None:
    """Read once here, then made again where it stays; and closed at zero there."""
    (tmp_path / "arm.py").write_text(KEPT)
    words = [
        "run",
        "rotary_pendulum",
        "--rig",
        f"{tmp_path / 'arm.py'}:Arm",
        "--start",
        "phi=0.2rad",
    ]
    _, out, _ = run(*words, "--seconds", "0.1", *([supervisor] if supervisor else []))
    notes = [line.split() for line in (tmp_path / "notes").read_text().splitlines()]
    makers = [number for what, number in notes if what == "made"]
    assert [number for what, number in notes if what == "closed"] == makers
    assert notes[-2] == ["last", "0.0"]
    assert makers[0] == str(os.getpid())
    assert ("the rig in a supervisor" in " ".join(out.split())) == (supervisor is None)
    assert len(makers) == (2 if supervisor is None else 1)
    assert makers[-1] != makers[0] or supervisor is not None
    assert "real-time priority" in out
    assert "memory locked" in out
    assert re.search(r"(granted|refused), ", out)


REVERSED = """
import numpy as np
from undertow import mechanisms
from undertow.plants import IdealRig, Measurement

class Arm(IdealRig):
    def __init__(self):
        m = mechanisms.rotary_pendulum()
        super().__init__(m, m.state(phi=0.2))

    def read(self):
        found = super().read()
        return Measurement(found.t, -found.q)
"""


@pytest.mark.slow
@short_searches()
def test_who_has_reversed_encoders_is_shown_the_way_to_the_bench(tmp_path: Path) -> None:
    """Lost at once, where the law is singular: the run knows the place, the bench the reason."""
    (tmp_path / "arm.py").write_text(REVERSED)
    place = f"{tmp_path / 'arm.py'}:Arm"
    code, out, _ = run(
        "run", "rotary_pendulum", "--rig", place, "--set", "m=0.13", "--simulated", "--seconds", "2"
    )
    assert code == 4
    said = " ".join(out.split())
    assert re.search(r"thrown out: (the law is singular at phi = |phi is )-?\d", said)
    assert f"undertow bench rotary_pendulum --rig {place} --set m=0.13 checks signs" in said


LEAVES = """
import sys
import numpy as np
from undertow import mechanisms
from undertow.plants import IdealRig

class Arm(IdealRig):
    count = 0
    def __init__(self):
        m = mechanisms.rotary_pendulum()
        super().__init__(m, m.state(phi=0.2))

    def write(self, u):
        self.count += 1
        if self.count == STEP:
            sys.exit(0)
        super().write(u)
"""


@short_searches()
@pytest.mark.parametrize(
    ("step", "code"),
    [("150", 5), pytest.param("150 or self.count > 150", 7, marks=pytest.mark.slow)],
)
def test_a_driver_that_leaves_the_interpreter_does_not_choose_the_exit_code(
    step: str, code: int, tmp_path: Path
) -> None:
    """``sys.exit(0)`` in a driver would otherwise be *balanced*, with the output left on."""
    (tmp_path / "arm.py").write_text(LEAVES.replace("STEP", step))
    place = f"{tmp_path / 'arm.py'}:Arm"
    words = ("--start", "phi=0.2rad", "--seconds", "0.5", "--simulated")
    got, out, _ = run("run", "rotary_pendulum", "--rig", place, *words)
    assert got == code
    assert "Verdict: stopped, loop: SystemExit: 0" in out


DRIVERS = """
from dataclasses import dataclass
import numpy as np
from undertow.plants import Measurement

class NoRead:
    period = 0.001
    def write(self, u): pass
    def close(self): print("let go")

@dataclass
class Three(NoRead):
    count: int = 3
    def read(self): return Measurement(0.0, np.zeros(self.count))

class Quick(Three):
    period = 0.0005
    def __init__(self): super().__init__(2)

class Dead(Three):
    def read(self): raise OSError(5, "unplugged")

class Port(Three):
    def __init__(self): raise OSError(2, "no such port")

class Clings(Three):
    def __init__(self): super().__init__(2)
    def close(self):
        super().close()
        raise OSError(16, "busy")
"""


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("NoRead", "without read"),
        ("Three", "q of shape (3,), must be undertow.plants.Measurement with q = (theta, phi)"),
        ("Quick", "--period 0.0005"),
        ("Dead", "unplugged"),
        ("Port", "no such port"),
        ("Clings", "close() of"),
        ("Nobody", "no name 'Nobody', must be one of NoRead, Three, Quick, Dead, Port, "),
    ],
)
def test_what_is_no_driver_is_refused_before_anything_runs(
    name: str, words: str, tmp_path: Path
) -> None:
    (tmp_path / "drivers.py").write_text(DRIVERS)
    code, out, err = run("run", "rotary_pendulum", "--rig", f"{tmp_path / 'drivers.py'}:{name}")
    assert code in (1, 2)
    assert out == ("" if name in ("Port", "Nobody") else "let go\n")
    assert words in err
    assert len(err.strip().splitlines()) == 1


def test_screens_fit_80_columns() -> None:
    """Tables of made-up runs, whose words are long, at the usual width of a terminal."""
    from undertow.runtime import Report
    from undertow.studies import fault_injection
    from undertow.studies.fault_injection import Fault, FaultResult, KillResult, LiveResult
    from undertow.studies.rigs.runs import run_table

    report = Report(
        steps=60_000, missed_deadlines=47, late_wakeups=44, stopped_by="sensor 'theta' lost " * 5
    )
    report.events = [(0.1, "rig", "read: OSError: [Errno 5] Input/output error " * 3)] * 9
    live = [LiveResult("optimiser", "a read blocks for 1 s", "what happened, " * 12, True)]
    killed = [KillResult(0.123, 1234, 0.01, 0.001, True, 0.02)]
    fault = Fault("write-taken", 12345, True, "realistic")
    hard = [
        FaultResult(fault, ("the output stays at [-1.234], and nothing says so",), "long " * 30)
    ]
    console = Console(width=80, record=True, file=io.StringIO())
    for shown in (
        run_table(report, 1e-3, [], simulated=False),
        fault_injection.drill_table([], live),
        fault_injection.kill_table(killed),
        fault_injection.systematic_table(hard),
    ):
        console.print(shown)
    text = console.export_text()
    assert max(map(len, text.splitlines())) <= 80
    assert "…" not in text
    assert "9 times read: OSError" in text


def test_chattering_of_each_input_is_in_its_own_unit() -> None:
    """The units were sorted, the numbers not: a torque stood there as a force."""
    from undertow.runtime import Report
    from undertow.studies.rigs.runs import run_table

    report = Report(steps=500, total_variation=np.array([1.5, 9.0]))
    console = Console(width=200, record=True, file=io.StringIO())
    console.print(run_table(report, 1e-3, ["N m", "N"], simulated=True))
    assert "3 N m/s, 18 N/s of total variation" in console.export_text()


def test_a_systematic_fault_that_is_none_is_refused() -> None:
    code, _, err = run("drill", "--only", "write:17:twice:ideal")
    assert code == 2
    assert "OPERATION:N:once|always:RIG" in err


@pytest.mark.slow
def test_single_systematic_faults_are_made_again() -> None:
    """Each says what happened; a rig that there is none of is refused."""
    code, out, err = run("drill", "--only", "write:60:always:ideal", "--only", "fork:1:once:kept")
    assert code == 0
    assert "2 of 2 cases as they should be, seed 0" in out
    assert "the device did not take an output of zero" in out
    assert "fork:1:once:kept: refused: process 'undertow" in out
    code, _, err = run("drill", "--only", "write:60:always:mine")
    assert code == 2
    assert "ideal or realistic or kept" in err


def test_a_missing_log_is_refused(tmp_path: Path) -> None:
    code, _, err = run("replay", str(tmp_path / "none.db"))
    assert code == 1
    assert "no such file" in err


@pytest.mark.slow
def test_a_run_keeps_to_a_limit_of_the_output(tmp_path: Path) -> None:
    """Also where the mechanism allows more; its replay knows it."""
    log = tmp_path / "run.db"
    words = ("--start", "phi=15deg", "--seconds", "0.3", "--simulated", "--log", str(log))
    assert run("run", "rotary_pendulum", "--limit", "voltage=4", *words)[0] in (0, 3)
    assert np.abs(read_log(log)["voltage"]).max() == 4.0
    assert run("replay", str(log))[0] == 0
