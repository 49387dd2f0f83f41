"""The benchmarks run, refuse clearly, and compare with controllers that are what they say."""

from __future__ import annotations

import ast
import os
import re
import shutil
import subprocess
import sys
from collections import defaultdict
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

import undertow as ut
from undertow.base import UndertowError
from undertow.studies import survey

FOLDER = Path(__file__).parents[2] / "benchmarks"
SCRIPTS = sorted(path.stem for path in FOLDER.glob("*.py"))
HELPERS = {"__main__", "builds", "harness", "rivals", "predictive", "acados_server", "entrants"}


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Run Python on the benchmarks' folder or one of its files."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    return subprocess.run(
        [sys.executable, *arguments], capture_output=True, text=True, check=False, env=environment
    )


@pytest.fixture
def harness(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The module that every benchmark imports first."""
    monkeypatch.syspath_prepend(str(FOLDER))
    import harness

    return harness


@pytest.fixture
def rivals(harness: ModuleType) -> ModuleType:
    """The controllers to compare with."""
    pytest.importorskip("casadi")
    import rivals

    return rivals


@pytest.fixture
def predictive(rivals: ModuleType) -> ModuleType:
    """Predictive control at 100 Hz."""
    import predictive

    return predictive


def test_the_one_command_knows_every_benchmark() -> None:
    shown = run(str(FOLDER), "--help")
    assert shown.returncode == 0
    assert "examples:" in shown.stdout
    words = shown.stdout.replace(",", " ").split()
    assert set(SCRIPTS) - HELPERS <= set(words)


@pytest.mark.parametrize("script", SCRIPTS)
def test_the_help_of_every_option_can_be_printed(script: str) -> None:
    """argparse formats it with %: a per cent sign of its own is doubled."""
    tree = ast.parse((FOLDER / f"{script}.py").read_text(encoding="utf-8"))
    for call in (node for node in ast.walk(tree) if isinstance(node, ast.Call)):
        for given in call.keywords:
            if given.arg == "help" and isinstance(given.value, ast.Constant):
                assert str(given.value.value) % defaultdict(int)


@pytest.mark.parametrize("script", sorted(set(SCRIPTS) - HELPERS))
def test_every_benchmark_has_help_with_examples(script: str) -> None:
    """They would run for minutes where somebody asks what they do."""
    text = (FOLDER / f"{script}.py").read_text(encoding="utf-8")
    assert re.search(r"^    .*(command_line|argparse.ArgumentParser)\(", text, re.MULTILINE)
    assert "sys.argv[1:]" not in text


@pytest.mark.slow
def test_a_mechanism_that_is_none_is_refused_by_a_benchmark() -> None:
    refused = run(str(FOLDER / "regulator.py"), "tra")
    assert refused.returncode == 2
    assert "no mechanism 'tra'; there are rotary_pendulum" in refused.stderr


def test_an_unknown_benchmark_is_refused_with_the_known_ones() -> None:
    refused = run(str(FOLDER), "kernal")
    assert refused.returncode == 2
    assert "no benchmark named kernal; there are kernel" in refused.stderr


def test_a_missing_extra_says_what_to_install(harness: ModuleType) -> None:
    with pytest.raises(SystemExit, match=r"not installed.\nInstall it: .*\[compare\]"):
        harness.need("no_such_package", "compare")


def test_entrants_of_a_race_take_turns(harness: ModuleType) -> None:
    order: list[str] = []
    ticks = iter(range(100))
    times = harness.race(
        {"a": lambda: order.append("a"), "b": lambda: order.append("b")},
        3,
        lambda: float(next(ticks)),
        "",
    )
    assert order == ["a", "b"] * 3
    assert times == {"a": [1.0] * 3, "b": [1.0] * 3}


def test_rivals_move_by_the_mechanisms_own_equations(rivals: ModuleType, rig: ut.Mechanism) -> None:
    import casadi as ca

    rng = np.random.default_rng(0)
    rates = rivals.dynamics(ca, rig)
    for _ in range(20):
        x, u = rng.uniform(-2, 2, 4), rng.uniform(-15, 15, 1)
        expected = np.concatenate([x[2:], rig.accelerations(0.0, x, u)])
        np.testing.assert_allclose(np.array(rates(x, u)).ravel(), expected, rtol=1e-10)


def test_the_regulator_solves_its_riccati_equation(rivals: ModuleType, rig: ut.Mechanism) -> None:
    from undertow.models import linearise

    lin, (P, K) = linearise(rig), rivals.riccati(rig, 0.1)
    residual = lin.A.T @ P + P @ lin.A - P @ lin.input @ lin.input.T @ P + 0.1 * np.eye(4)
    assert np.abs(residual).max() < 1e-8 * np.abs(P).max()
    assert np.linalg.eigvals(lin.A - lin.input @ K).real.max() < 0


@pytest.mark.slow
def test_a_plan_of_least_time_arrives_when_it_says(rivals: ModuleType, rig: ut.Mechanism) -> None:
    x = rig.state(phi=ut.deg(10))
    mpc = rivals.ShootingMPC(rig, "time")
    assert mpc.plan(0.0, x)
    promised = mpc.cost
    mpc.forget()
    outcome = rivals.Plant(rig, 0.01, 3.0).held(x, mpc)
    assert outcome.reached
    assert abs(outcome.time - promised) < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("goal", ["energy", "time"])
def test_fatrop_finds_the_plan_of_ipopt(rivals: ModuleType, rig: ut.Mechanism, goal: str) -> None:
    if shutil.which("gcc") is None:
        pytest.skip("needs gcc")
    ipopt = rivals.ShootingMPC(rig, goal, tolerance=1e-8)
    fatrop = rivals.ShootingMPC(rig, goal, tolerance=1e-8, solver="fatrop", compiled=True)
    for t, angle in ((0.0, 30.0), (0.1, 27.0)):  # from cold, and warm
        x = rig.state(phi=ut.deg(angle))
        assert ipopt.plan(t, x)
        assert fatrop.plan(t, x)
        np.testing.assert_allclose(fatrop.cost, ipopt.cost, rtol=1e-4)
        np.testing.assert_allclose(fatrop._plan[0], ipopt._plan[0], atol=1e-4)
    if goal == "energy":
        assert fatrop.iterations[1] < fatrop.iterations[0]


def test_acados_finds_the_plan_of_ipopt(predictive: ModuleType, rig: ut.Mechanism) -> None:
    python = os.environ.get("UNDERTOW_ACADOS")
    if not python:
        pytest.skip("needs $UNDERTOW_ACADOS, a Python that has acados")
    ipopt = predictive.ShootingMPC(rig, "energy", tolerance=1e-8)
    acados = predictive.AcadosShooting(python, rig)
    x = rig.state(phi=ut.deg(30))
    for t, most in ((0.0, 1e-4), (0.1, 0.01)):  # converged, then one real-time iteration
        assert ipopt.plan(t, x)
        assert acados.plan(t, x)
        assert -1e-4 < acados.cost / ipopt.cost - 1 < most
        x = ipopt._plan[0][5]  # 0.1 s later
    assert acados.iterations[1] == 1
    acados.server.close()


@pytest.mark.slow
def test_predictive_control_of_least_time_is_near_the_bound(
    rivals: ModuleType, rig: ut.Mechanism
) -> None:
    from undertow.bounds import bound

    x = rig.state(phi=ut.deg(15))
    box = ut.state_box(phi=np.pi / 2)
    least = bound(rig, ut.MinimumTime(constraints=box), x).cost
    outcome = rivals.Plant(rig, 0.01, 3.0).held(x, rivals.ShootingMPC(rig, "time"))
    assert outcome.reached
    assert 0.98 * least < outcome.time < 1.15 * least


@pytest.mark.parametrize("span", [0.01, 0.3, 0.6, 2.0, 9.8])
def test_the_intervals_of_a_plan_fill_its_span(predictive: ModuleType, span: float) -> None:
    lengths = predictive.grid(span)
    assert len(lengths) == predictive.INTERVALS
    assert abs(lengths.sum() - span) < 1e-12
    assert (np.diff(lengths) > -1e-12).all()
    assert lengths.max() <= max(predictive.LONGEST, 1.5 * span / predictive.INTERVALS) + 1e-9


def test_a_real_time_iteration_stays_at_a_converged_plan(
    predictive: ModuleType, rig: ut.Mechanism
) -> None:
    x = rig.state(phi=ut.deg(20))
    control = predictive.RealTimeIteration(rig, {"phi": (-1.5, 1.5)}, 3.0)
    assert control.plan(0.0, x)
    before = control._plan
    assert control.plan(0.0, x)
    assert control.failures == 0
    np.testing.assert_allclose(control._plan[0], before[0], atol=1e-4)
    np.testing.assert_allclose(control._plan[1], before[1], atol=1e-4)


@pytest.mark.slow
def test_what_predictive_control_learns_is_the_librarys_belief(
    predictive: ModuleType, rivals: ModuleType, rig: ut.Mechanism
) -> None:
    belief = ut.Belief.relative(rig, m=0.2, d_e=0.5)
    m, damping = (p.value for p in rig.parameters if p.name in ("m", "d_e"))
    plant = rig.with_parameters(m=1.15 * m, d_e=0.7 * damping)
    control = predictive.RealTimeIteration(
        rig, {"phi": (-1.5, 1.5)}, 3.0, names=tuple(belief.tolerances)
    )
    wrapped = predictive.Sampled(control, rig.input_limits, belief)
    outcome = rivals.Plant(plant, 0.01, 3.0).held(rig.state(phi=ut.deg(30)), wrapped)
    assert outcome.event == "REACHED"
    np.testing.assert_allclose(control.values, [1.15 * m, 0.7 * damping], rtol=0.03)


def test_a_plant_that_leaves_its_box_is_lost(rivals: ModuleType, rig: ut.Mechanism) -> None:
    plant = rivals.Plant(rig, 0.01, 3.0, {"phi": (-1.0, 1.0)})
    outcome = plant.held(rig.state(phi=ut.deg(30)), lambda _t, _x: np.zeros(1))
    assert outcome.event == "CONSTRAINT"
    assert outcome.time < 1.0


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(set(SCRIPTS) - HELPERS))
def test_quick_run(name: str) -> None:
    if name in (
        "kernel", "reoptimise", "closed_loop", "gap", "grid", "searchers", "plants", "rig_peers",
    ):  # fmt: skip
        pytest.importorskip("casadi")
    finished = run(str(FOLDER / f"{name}.py"), "--quick")
    assert finished.returncode == 0, finished.stderr
    assert "Traceback" not in finished.stderr
    assert len(finished.stdout.split()) > 5


@pytest.fixture
def grid(harness: ModuleType) -> ModuleType:
    """The heat maps."""
    import grid

    return grid


def test_cells_are_kept_as_they_are_finished(
    grid: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Claim: a cell that was finished is not run again, nor is one of another seed taken for it."""
    made: list[float] = []

    def measured(
        mechanism: ut.Mechanism, _objective: ut.Objective, x0: np.ndarray, **_more: object
    ) -> survey.Entry:
        made.append(float(x0[1]))
        return survey.Entry(
            "", mechanism.name, 2, 1, "", "", 3.0, 2.0, np.inf, 1.02, 4.0, 0.01, 1.0, 0.5
        )

    monkeypatch.setattr(grid, "survey_one", measured)
    sheet, path = grid.rotary_sheet(), tmp_path / "grid.jsonl"
    first = grid.fill("rotary", sheet, grid.ledger(path, 0), [(0, 0)], 0)
    both = grid.fill("rotary", sheet, grid.ledger(path, 0), [(0, 0), (4, 6)], 0)
    assert made == pytest.approx(np.radians([30, 30, 43.3, 43.3]))  # energy and time each
    assert both[0, 0, "time"] == first[0, 0, "time"]
    assert both[4, 6, "energy"].gap("cascade") == np.inf
    assert both[4, 6, "energy"].gap("free") == pytest.approx(0.02)
    with pytest.raises(UndertowError, match="other versions or settings"):
        grid.ledger(path, 1)


def test_a_grid_counts_what_fails_and_leaves_out_what_nothing_can(
    grid: ModuleType, capsys: pytest.CaptureFixture[str]
) -> None:
    """Claim: a cascade that does not arrive misses the bound; where none was found nothing does."""
    sheet = grid.rotary_sheet()
    found = [(1.005, 1.0, 1.0), (np.inf, 1.5, 1.0), (np.inf, np.inf, np.nan)]
    cells = {(0, c, "energy"): grid.Found(*costs, 1.0) for c, costs in enumerate(found)}
    three, free = grid.verdicts(sheet, cells)
    assert "three parameters: 1 of 2 cells within 1 %" in three
    assert three.endswith("worst fails (wanted: all)")
    assert free.endswith("1 of 2 cells within 1 %, median 25.0 %, worst 50.0 (wanted: all)")
    grid.tables(sheet, cells)
    assert re.search(r"d_e = 0 +three parameters +0\.5 +fails +—\n", capsys.readouterr().out)
    drawn = grid.heat_map(sheet, cells).axes[0]
    assert [text.get_text() for text in drawn.texts] == ["0.5", "×", ""]
    within, missed, nothing = (bar.get_facecolor() for bar in drawn.patches)
    assert within[2] > within[0] + 0.05  # blue
    assert missed[0] > missed[2] + 0.5  # vermilion
    assert nothing[:3] == (1.0, 1.0, 1.0)
    assert drawn.patches[2].get_hatch()


@pytest.mark.slow
def test_swing_ups_meet_the_plant_that_a_seed_says(harness: ModuleType) -> None:
    """The plant moves, not the model; the same number of the same seed does the same again."""
    import plants
    import swing_ups

    first, again = (swing_ups.swung("rotary_pendulum", 5, 1, rig=False) for _ in range(2))
    assert first.outcome.balanced
    np.testing.assert_array_equal(first.outcome.record.truth, again.outcome.record.truth)
    record, plant = first.outcome.record, plants.drawn("rotary_pendulum", 5, 1)
    assert plant.fingerprint != plants.model("rotary_pendulum").fingerprint
    rig = ut.plants.IdealRig(plant, record.truth[300], 0.001)
    rig.write(record.u[300])
    np.testing.assert_allclose(rig.truth, record.truth[301], atol=1e-12)
    assert swing_ups.row("rotary_pendulum", [first])[1] == "1 of 1"


@pytest.fixture
def basins(harness: ModuleType) -> ModuleType:
    """The cold search against long ones."""
    import basins

    return basins


def test_basins_go_on_where_they_were_interrupted(
    basins: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Claim: a search that is in the ledger is not run again; more of them only add."""
    ran = []

    def search(_task: object, name: str) -> object:
        ran.append(name)
        return basins.Found(2.0 if name == basins.DEFAULT else 1.0, 0.1)

    monkeypatch.setattr(basins.Task, "run", search)
    kind, path = basins.Kind("rotary_pendulum", "time", "three"), tmp_path / "basins.jsonl"
    names = basins.named_searches(3, ["ours", "cmaes"])
    assert names == ["default", "ours 1", "cmaes 1", "ours 2"]
    basins.fill(basins.ledger(path, 0), [kind], 1, names[:2], 0)
    kept = basins.ledger(path, 0)
    basins.fill(kept, [kind], 1, names, 0)
    assert ran == names
    (tally,) = basins.tallies(kept.known, [kind], 1, names)
    assert tally.missed
    assert tally.loss == pytest.approx(1.0)
    with pytest.raises(UndertowError, match="other versions or settings"):
        basins.ledger(path, 1)


def test_basins_count_what_only_others_find_and_leave_out_what_nobody_does(
    basins: ModuleType, capsys: pytest.CaptureFixture[str]
) -> None:
    """Claim: where only a long search arrives the default has missed; where none does, nobody."""
    kind = basins.Kind("cart_pendulum", "energy", "free")
    costs = [(1.0, 0.995), (1.02, 1.0), (np.inf, 3.0), (np.inf, np.inf)]
    sure = (0.91, 0.95, None, 0.5)
    every = [
        basins.Tally(kind, k, {"default": a, "ours 1": b}, said)
        for k, ((a, b), said) in enumerate(zip(costs, sure, strict=True))
    ]
    assert [t.missed for t in every] == [False, True, True, False]
    good, count, low, high = basins.share(every)
    assert (good, count) == (1, 3)
    assert low == pytest.approx(0.0615, abs=1e-3)  # Wilson's interval of 1 of 3
    assert high == pytest.approx(0.7923, abs=1e-3)
    basins.report(every, [kind], 0)
    shown = capsys.readouterr().out
    assert re.search(r"cart_pendulum, energy, free +4 +1 +1 of 2 +1 of 3 .* fails", shown)
    assert "2 of 4 answers, 1 of them within 1 %" in shown
    assert "1 of 3 starts, 33.3 %" in shown


def test_a_start_of_basins_depends_on_its_number_and_seed_alone(basins: ModuleType) -> None:
    """Random angles, rates and damping; every start is one that the task allows."""
    for name in basins.DRAWS:
        first, again, other = (basins.drawn(name, k, 3) for k in (5, 5, 6))
        np.testing.assert_array_equal(first.x0, again.x0)
        assert first.mechanism.fingerprint == again.mechanism.fingerprint
        assert first.mechanism.fingerprint != other.mechanism.fingerprint
        assert (first.x0 != other.x0).all()


@pytest.mark.slow
@pytest.mark.parametrize("method", ["ours", "many", "cmaes", "evolution", "annealing"])
def test_long_searches_of_basins_arrive(basins: ModuleType, method: str) -> None:
    """From an easy start each method finds about what the others do: the tasks are the same."""
    pytest.importorskip("cmaes")
    task = basins.Task(basins.drawn("rotary_pendulum", 0, 0), "energy", "three")
    usual = task.run(basins.DEFAULT).cost
    assert 0.9 * usual < task.run(f"{method} 1").cost < 1.1 * usual
