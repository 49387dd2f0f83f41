"""Every mechanism reaches its target with no further choice; the documented table is a run's."""

from __future__ import annotations

import csv
import io
import math
import re
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import undertow as ut
from undertow.base import InvalidInputError
from undertow.cli import app
from undertow.mechanisms import LIBRARY
from undertow.studies import survey

DOCS = Path(__file__).parents[2] / "docs"
NAMES = sorted(LIBRARY)
#: The mechanism of the quick tests: other tests have its kernels compiled.
PROMPT = "rotary_pendulum"


@cache
def entry(name: str, bounds: bool = False, goal: str = "energy") -> survey.Entry:
    return survey.survey([name], goals=[goal], bounds=bounds).run()[0]


def documented(goal: str = "energy") -> dict[str, list[str]]:
    """Rows of a table in the documentation by mechanism."""
    text = (DOCS / "mechanisms.md").read_text(encoding="utf-8")
    text = text.partition(f"### Least {goal}\n")[2].partition("\n#")[0]
    rows = re.findall(r"^\| (\w+) \| \d, \d \|.*$", text, re.MULTILINE)
    lines = [line for line in text.splitlines() if re.match(r"\| \w+ \| \d, \d \|", line)]
    return {
        name: [cell.strip() for cell in line.strip("|").split("|")]
        for name, line in zip(rows, lines, strict=True)
    }


def check_simulate(name: str) -> None:
    result = CliRunner().invoke(
        app, ["simulate", name, "--objective", "energy", "--belief", "exact"]
    )
    assert result.exit_code == 0, result.output
    assert "reached the target" in result.stdout
    found = re.search(r"cost +([\d.e-]+)", result.stdout)
    assert found is not None
    assert float(found[1]) == pytest.approx(float(documented()[name][5].split()[0]), rel=0.03)


@pytest.mark.slow  # kernels of its own
def test_simulate_with_no_further_choice() -> None:
    """Claim: ``undertow simulate NAME --objective energy --belief exact`` costs what is said."""
    check_simulate(PROMPT)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in NAMES if name != PROMPT])
def test_simulate_every_other_with_no_further_choice(name: str) -> None:
    """Claim: the same for all others; most of them creep to their target until the horizon."""
    check_simulate(name)


@pytest.mark.slow
@pytest.mark.parametrize("name", [PROMPT, "acrobot"])
def test_costs_fall_from_first_surface_to_cascade(name: str) -> None:
    """Claim: optimising once never costs more than the first surface, the cascade not more yet."""
    pytest.importorskip("casadi")
    line = entry(name, bounds=True)
    assert line.cascade <= line.one_time * (1 + 1e-3)
    assert line.one_time <= line.designed
    assert math.isfinite(line.time)
    assert line.radius <= 0.01 + 1e-9


@pytest.mark.parametrize("goal", survey.GOALS)
def test_documented_table_is_of_all_mechanisms(goal: str) -> None:
    """Claim: docs/mechanisms.md has one row for each mechanism and goal, and each arrives."""
    rows = documented(goal)
    assert sorted(rows) == NAMES
    assert all(float(row[10].split()[0]) <= 60.0 for row in rows.values())


@pytest.mark.parametrize("goal", survey.GOALS)
def test_documented_gaps_are_those_of_the_rows(goal: str) -> None:
    """Claim: medians and worst gaps that the page names follow from its rows."""
    text = (DOCS / "mechanisms.md").read_text(encoding="utf-8")
    text = text.partition(f"### Least {goal}\n")[2].partition("\n#")[0]
    named = re.findall(
        r"Gap of the cascade.* to the bound: median ([\d.]+) %, worst ([\d.]+)", text
    )
    assert len(named) == 2
    for column, (middle, worst) in zip((8, 9), named, strict=True):
        gaps = [float(row[column].split()[0]) for row in documented(goal).values() if "%" in row[8]]
        assert float(middle) == pytest.approx(float(np.median(gaps)), abs=0.06)
        assert float(worst) == pytest.approx(max(gaps), abs=0.06)


@pytest.mark.slow
def test_bound_is_below_the_cascade() -> None:
    """Claim: the bound of the quick mechanism is below its cascades, by what the page says."""
    pytest.importorskip("casadi")
    line = entry(PROMPT, bounds=True)
    assert 0 < line.bound < line.cascade
    assert line.free > 0.998 * line.bound  # itself exact to its mesh alone
    assert 100 * line.gap == pytest.approx(float(documented()[PROMPT][8].split()[0]), abs=0.2)


@pytest.mark.slow
@pytest.mark.parametrize(("goal", "least", "most"), [("energy", 0.3, 0.03), ("time", 0.05, 0.2)])
def test_a_free_reaching_law_closes_most_of_the_acrobots_gap(
    goal: str, least: float, most: float
) -> None:
    """Claim: of energy nearly all of it; of time it leaves a part."""
    pytest.importorskip("casadi")
    line = entry("acrobot", bounds=True, goal=goal)
    assert line.gap > least
    assert line.free_gap < min(most, line.gap)


def made(name: str = "a", gap: float = 0.05, **more: object) -> survey.Entry:
    values: dict[str, object] = {
        "goal": "energy", "name": name, "n": 2, "m": 1, "start": "x = 1 m", "unit": "N² s",
        "designed": 3.0, "one_time": 2.0, "cascade": 1.0 + gap, "free": 1.02, "time": 4.0,
        "radius": 0.01, "bound": 1.0, "seconds": 0.5,
    }  # fmt: skip
    return survey.Entry(**{**values, **more})  # type: ignore[arg-type]


def test_table_and_files_say_what_was_found() -> None:
    """Claim: gap, median and failures appear as such, nowhere NaN."""
    entries = [
        made("a", 0.05),
        made("b", 0.50),
        made("c", designed=math.inf, time=math.inf, cascade=math.inf, bound=math.nan),
        made("d", 0.2),
        made("e", 0.3, goal="time"),
    ]
    assert survey.median_gap(e.gap for e in entries[:4]) == pytest.approx(0.2)
    assert math.isnan(survey.median_gap([math.nan]))
    text = survey.markdown(entries)
    assert "2 of 4" not in text
    assert "3 of 4 reach the target" in text
    assert "Gap of the cascade to the bound: median 20.0 %, worst 50.0 %." in text
    assert "Gap of the cascade with a free reaching law to the bound: median 2.0 %" in text
    assert "1 of 1 reach the target" in text
    assert "| not reached |" in text
    files = survey.files({"seed": 0}, entries)
    rows = list(csv.DictReader(io.StringIO(files["survey.csv"].decode())))
    assert [row["mechanism"] for row in rows] == ["a", "b", "c", "d", "e"]
    assert rows[2]["bound"] == rows[2]["time_s"] == ""
    assert float(rows[1]["gap"]) == pytest.approx(0.5)
    assert not re.search(r"nan|inf\b", "".join(f.decode() for f in files.values()))


def test_what_does_not_arrive_counts_in_the_median() -> None:
    """Claim: it is worse than any that does; without a bound, or one of 0, there is no gap."""
    lost = [made(name, time=math.inf, cascade=math.inf) for name in "bc"]
    words = "Gap of the cascade to the bound: median {}, worst not reached."
    assert words.format("20.0 %") in survey.summary([made("a"), made("d", 0.2), lost[0]])
    assert words.format("not reached") in survey.summary([made("a"), *lost])
    assert math.isnan(made("there", cascade=0.0, bound=0.0).gap)


@pytest.mark.slow
def test_a_start_inside_the_terminal_set_costs_nothing() -> None:
    """Claim: its line is one of the table; the cart of the TORA begins within 5 cm."""
    pytest.importorskip("casadi")
    line = entry("tora", bounds=True, goal="bench-energy")
    assert line.cascade == line.bound == line.time == 0


def test_survey_on_the_command_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Claim: one command prints the table, here of a line of ours, and leaves it as files."""
    line = made(PROMPT, start="phi = 35°")
    monkeypatch.setattr(survey, "survey_one", lambda *_, **__: line)
    words = ["survey", "--only", PROMPT, "--no-bounds", "--objective", "energy"]
    words += ["--out", str(tmp_path)]
    result = CliRunner().invoke(app, words, env={"COLUMNS": "60"})
    assert result.exit_code == 0, result.output
    assert re.search(r"^rotary_pendulum +\d.*\nphi = 35°", result.stdout, re.MULTILINE)
    shown = result.stdout.partition("1 of 1")[0].splitlines()
    assert max(map(len, shown)) <= 80
    assert (tmp_path / "survey.csv").exists()
    listed = CliRunner().invoke(app, ["mechanisms"], env={"COLUMNS": "60"})
    assert listed.exit_code == 0
    assert all(name in listed.stdout for name in NAMES)


@pytest.mark.slow
def test_a_start_from_which_nothing_is_admissible_is_a_line_too() -> None:
    """Claim: where no surface is, and no motion at all, the line says so and is no error."""
    weak = ut.mechanisms.rotary_pendulum(d_e=0.025).with_input_limit(0.5)
    x0 = weak.state(phi=ut.deg(30))
    line = survey.survey_one(weak, ut.MinimumEnergy(), x0, bounds=False)
    assert line.start == "phi = 30°"
    assert line.designed == line.one_time == line.cascade == line.free == line.time == math.inf


def test_unknown_names_are_refused_before_any_work() -> None:
    """Claim: a wrong name ends the survey at once."""
    with pytest.raises(InvalidInputError, match="'piano'"):
        survey.survey(["rotary_pendulum", "piano"])


def test_mechanisms_of_one_name_are_told_apart(tmp_path: Path) -> None:
    """Two files whose mechanisms have one name: the second one took the first one's line."""
    text = "import undertow as ut\nrig = ut.mechanisms.cart_pendulum(){}\n"
    (tmp_path / "a.py").write_text(text.format(""), encoding="utf-8")
    (tmp_path / "b.py").write_text(text.format(".with_parameters(m_p=0.2)"), encoding="utf-8")
    given = [str(tmp_path / "a.py:rig"), str(tmp_path / "b.py:rig"), "acrobot"]
    both = survey.survey(given, goals=["time"], bounds=False)
    assert [name for name, _ in both.tasks] == given
    alone = survey.survey(given[1:], goals=["time"], bounds=False)
    assert [name for name, _ in alone.tasks] == ["cart_pendulum", "acrobot"]
