"""The everyday tasks of docs/everyday.md run as they stand; what they make can be kept."""

from __future__ import annotations

import pickle
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import chdir
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sympy as sp

import undertow as ut
from undertow.base import MissingExtraError
from undertow.plants import IdealRig
from undertow.runtime import Recipe

PAGE = (Path(__file__).parents[2] / "docs" / "everyday.md").read_text(encoding="utf-8")

#: Title to code; what comes before the first title is what all begin with.
TASKS = {
    part.split("\n")[0]: "\n".join(re.findall(r"```python\n(.*?)```", part, re.DOTALL))
    for part in PAGE.split("\n## ")
}

RIG = ut.mechanisms.rotary_pendulum()

#: What makes a task shorter: words of its code, and others in their place.
BUDGETS = "cold=ut.Budget(500), warm=ut.Budget(32)"
QUICK = ("Cascade(rig, ut.MinimumTime())", f"Cascade(rig, ut.MinimumTime(), {BUDGETS})")
COARSE = (
    ("bound(rig, ut.MinimumTime()", "bound(rig, ut.MinimumTime(), intervals=40"),
    ("freedom=free", f"freedom=free, {BUDGETS}"),
)
BRIEF = (('"bench-energy"))', f'"bench-energy"), {BUDGETS})'), ("seconds=2", "seconds=1"))


@pytest.fixture(scope="module")
def names(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Any]]:
    """What the page's first two blocks leave behind, in a folder for files."""
    found: dict[str, Any] = {}
    with chdir(tmp_path_factory.mktemp("everyday")):
        does("# Ten everyday tasks", found)
        yield does("1. ", found, QUICK)


def does(title: str, names: dict[str, Any], *shorter: tuple[str, str]) -> dict[str, Any]:
    """Do a task of the page, as it stands but for the words that make it shorter."""
    (code,) = (code for head, code in TASKS.items() if head.startswith(title))
    for words, instead in shorter:
        assert words in code
        code = code.replace(words, instead)
    exec(compile(code, title, "exec"), names)
    return names


def test_there_are_ten_tasks_of_a_few_lines() -> None:
    """One to three statements each beside the imports, but for what is printed."""
    ten = [code for head, code in TASKS.items() if re.match(r"\d+\. ", head)]
    assert len(ten) == 10
    for code in ten:
        assert 1 <= len(code.strip().splitlines()) <= 5


def test_simulate_and_plot(names: dict[str, Any]) -> None:
    assert names["run"].reached
    does("2.", names)
    assert Path("motion.png").read_bytes().startswith(b"\x89PNG")
    figure = names["run"].plot()
    assert figure._repr_png_().startswith(b"\x89PNG")  # what a notebook shows
    assert len(figure.axes) == RIG.n + RIG.m


def test_tables_hold_the_motion_with_its_units(names: dict[str, Any]) -> None:
    pytest.importorskip("pandas")
    pytest.importorskip("xarray")
    made, motion = does("3.", names), names["run"].trajectory
    assert list(made["frame"]) == [*RIG.state_names, "voltage", "s_0", "cost", "margin"]
    np.testing.assert_array_equal(made["frame"][list(RIG.state_names)].to_numpy(), motion.x)
    np.testing.assert_array_equal(made["frame"].index, motion.t)
    assert made["frame"].attrs["units"]["phi_dot"] == "rad/s"
    np.testing.assert_array_equal(made["data"].voltage, motion.u[:, 0])
    assert {k: v.attrs["units"] for k, v in made["data"].variables.items()} == {
        "t": "s", "theta": "rad", "phi": "rad", "theta_dot": "rad/s", "phi_dot": "rad/s",
        "voltage": "V", "s_0": "", "cost": "s", "margin": "",
    }  # fmt: skip


def test_a_missing_extra_is_said_in_one_line(
    names: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in ("pandas", "xarray", "control"):
        monkeypatch.setitem(sys.modules, module, None)
    motion = names["run"].trajectory
    for method in (motion.to_pandas, motion.to_xarray, RIG.linearise().ss):
        with pytest.raises(MissingExtraError, match=r"pip install 'undertow\[interop\]'"):
            method()


def test_film(names: dict[str, Any]) -> None:
    names["run"].animate("short.gif", fps=5, longest=0.4)  # as task 4, of fewer frames
    assert Path("short.gif").read_bytes().startswith(b"GIF89a")
    assert TASKS["4. Film"].startswith('run.animate("')


@pytest.mark.parametrize("shorter", [COARSE, pytest.param((), marks=pytest.mark.slow)], ids=len)
def test_bound(names: dict[str, Any], shorter: tuple[tuple[str, str], ...]) -> None:
    pytest.importorskip("casadi")
    if not shorter:
        names = does("1. ", dict(names))
    assert 0 < does("5.", names, *shorter)["least"].cost < names["run"].cost


def test_export(names: dict[str, Any]) -> None:
    does("7.", names)
    assert (Path("firmware") / "rotary_pendulum.c").is_file()


def test_linearise(names: dict[str, Any]) -> None:
    pytest.importorskip("control")
    plant = does("9.", names)["plant"]
    system = plant.ss()
    assert system.name == RIG.name
    assert system.state_labels == list(RIG.state_names)
    np.testing.assert_allclose(system.poles(), np.linalg.eigvals(plant.A))


@pytest.mark.slow
def test_a_run_from_objects_is_replayed_where_they_have_names(tmp_path: Path) -> None:
    """Bit for bit, and with the gate's decisions; a problem of one's own says that it has none."""
    rig = RIG.with_parameters(m=0.13)
    goal = ut.objective_for(rig, "bench-energy", horizon=15.0)
    plant, log = IdealRig(rig, rig.state(phi=0.2), 0.001), tmp_path / "run.db"
    ut.run(ut.Cascade(rig, goal), plant, seconds=0.5, log=log, simulated=True, phi=0.2)
    found = ut.replay(log)
    assert found.identical
    assert found.judged > 0
    assert Recipe(rig, objective=goal).in_names() == Recipe(
        "rotary_pendulum", rig.substitution and {p.name: p.value for p in rig.parameters},
        objective="bench-energy", horizon=15.0,
    )  # fmt: skip
    mine = ut.Objective("mine", lambda v: v.voltage**2 + v.phi**2)
    assert Recipe(rig, objective=mine).in_names() is None
    arm, *rest = rig.coordinates  # another travel is another mechanism, whatever the equations
    shorter = replace(rig, coordinates=(replace(arm, low=-1.0, high=1.0), *rest))
    assert Recipe(shorter, objective="bench-energy").in_names() is None
    assert Recipe(rig, design=ut.Cascade(rig, step=0.001)).in_names() is None


def test_run(names: dict[str, Any]) -> None:
    assert does("8.", names, *BRIEF)["report"].verdict.ending in ("balanced", "caught")


@pytest.mark.slow
def test_compare(names: dict[str, Any]) -> None:
    """On a rig without friction the cascade holds what it caught; the regulator too."""
    does("8.", names)
    table = does("10.", names)["table"]
    assert {row["controller"] for row in table.rows} == {"cascade, bench-energy", "LQR, clipped"}
    assert all(row["balanced"] for row in table.rows)
    assert "balanced" in str(table)


@pytest.mark.slow
def test_a_target_that_moves(names: dict[str, Any]) -> None:
    """The crane rests at the last set-point, the arm is where the sine is."""
    made = does("A target that moves", names)
    moved, swings = made["moved"], made["swings"]
    assert moved.reached
    assert abs(moved.trajectory["x"][-1] + 0.5) < 0.05
    assert swings.reached
    wanted = ut.deg(45) * np.sin(np.pi * swings.time)
    assert abs(swings.trajectory["theta"][-1] - wanted) < 0.05


def test_prove(names: dict[str, Any]) -> None:
    made = does("6.", names)
    assert "stability" in {c.kind for c in made["certificate"].subjects[0].claims}
    again = pickle.loads(pickle.dumps(made["certificate"]))
    assert again == made["certificate"]
    other = RIG.with_parameters(m=0.2)
    with pytest.raises(ut.base.UndertowError, match="'m' of 'rotary_pendulum'"):
        ut.verify("certificate.json", other)


# -- what is made can be kept --------------------------------------------------------------------


def shown(item: Any) -> str:
    """Everything of an object that a copy must have, in words."""
    match item:
        case ut.Mechanism():
            return f"{item.fingerprint} {item.start} {item.description}"
        case ut.Objective():
            problem = item.on(RIG)
            return f"{problem.stage_cost(RIG)} {problem.path_margins(RIG)} {problem!r}"
        case ut.Cascade():
            return f"{shown(item.mechanism)} {shown(item.objective)} {item.seed} {item.warm}"
        case ut.Trajectory():
            return f"{item!r} {[(k, v.tobytes(), u) for k, (v, u) in item.columns.items()]}"
        case ut.Run():
            return f"{shown(item.trajectory)} {item.surfaces} {[u.admission for u in item.updates]}"
        case _:
            return repr(item)


def kept(run: ut.Run) -> list[Any]:
    formula = ut.Objective("mine", lambda v: v.voltage**2 + sp.sin(v.phi) ** 2 * v.g)
    arm = ut.Constraint("arm", lambda v: v.theta**2 - 9)
    return [
        RIG, ut.first_surface(RIG), ut.ReachingLaw(), ut.MinimumTime(), formula,
        ut.MinimumEnergy(constraints=(arm, *ut.state_box(phi=1.0))), ut.Cascade(RIG, formula), run,
        run.trajectory, Recipe(RIG, objective=ut.MinimumTime()), Recipe(), ut.lqr(RIG),
        ut.Reference.sine(0.5, theta=0.3),
    ]  # fmt: skip


#: What a fresh process says: what of this ``import undertow`` imports, then what a file has in it.
LATE = ("undertow.runtime", "undertow.bounds", "undertow.export", "undertow.display", "pandas")
FRESH = f"""import pickle, sys, undertow
print([m for m in {LATE!r} if m in sys.modules])
print(*map(repr, pickle.load(open(sys.argv[1], 'rb'))), sep='\\n')
"""


@pytest.fixture(scope="module")
def fresh(names: dict[str, Any], tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """What a process says that has imported nothing yet."""
    file = tmp_path_factory.mktemp("kept") / "kept"
    file.write_bytes(pickle.dumps(kept(names["run"])))
    done = subprocess.run(
        [sys.executable, "-c", FRESH, str(file)], capture_output=True, text=True, check=True,
        encoding="utf-8", env={**__import__("os").environ, "PYTHONIOENCODING": "utf-8"},
    )  # fmt: skip
    return done.stdout.splitlines()


def test_everything_is_pickled_and_read_in_a_fresh_process(
    names: dict[str, Any], fresh: list[str]
) -> None:
    """The same here, and in a process that has imported nothing yet."""
    items = kept(names["run"])
    for item in items:
        again = pickle.loads(pickle.dumps(item))
        assert type(again) is type(item)
        assert shown(again) == shown(item)
    assert fresh[1:] == [repr(item) for item in items]


def test_a_regulator_that_was_pickled_gives_the_same_inputs() -> None:
    x, make = RIG.state(phi=0.1), ut.lqr(RIG)
    again = pickle.loads(pickle.dumps(make))
    np.testing.assert_array_equal(again(x)(0.0, x), make(x)(0.0, x))


def test_a_predictive_controller_that_was_pickled_gives_the_same_inputs() -> None:
    pytest.importorskip("casadi")
    x, make = RIG.state(phi=0.1), ut.nmpc(RIG, ut.MinimumEnergy())
    again = pickle.loads(pickle.dumps(make))
    np.testing.assert_array_equal(again(x)(0.0, x), make(x)(0.0, x))


def test_reprs_are_short_and_notebooks_show_formulas(names: dict[str, Any]) -> None:
    for item in kept(names["run"]):
        assert len(repr(item)) <= 200, repr(item)
        assert " at 0x" not in repr(item)
    assert r"\ddot{q}" in RIG._repr_latex_()
    assert r"\dot{\varphi}" in RIG._repr_latex_()
    assert ut.Surface(-1, -0.5, 5, 10)._repr_latex_() == (
        r"$\displaystyle s = -1\,\dot{q}_a -0.5\,q_a +5\,\dot{q}_u +10\,q_u$"
    )
    table = names["run"].trajectory._repr_html_()
    assert table.count("<tr>") == 8  # heads, three rows, a gap, three rows
    assert "<th>phi_dot<br>rad/s</th>" in table


def test_every_public_name_is_there_and_imports_late(fresh: list[str]) -> None:
    """Tab completion lists what is imported when it is asked for, and nothing is imported twice."""
    for name in ut.__all__:
        assert name in dir(ut)
        assert getattr(ut, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'simulate'"):
        _ = ut.simulate
    assert fresh[0] == "[]"
